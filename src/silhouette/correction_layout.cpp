#include "src/silhouette/correction_layout.h"

#include <algorithm>

#include "chainsplat/core.h"

namespace chainsplat::silhouette {

using capture::Correction;
using math::MatrixX;
using math::VectorX;

namespace {

bool is_held(const capture::CorrectedQuantity& quantity, const capture::Capture& capture, const chain::Chain& chain,
             int camera, const CorrectionOptions& options) {
  const std::vector<std::string>& held = options.held;
  const std::string group = quantity.group;
  const bool clock = quantity.name == std::string("time");
  if (std::find(held.begin(), held.end(), group) != held.end()) return true;
  if (quantity.name == std::string("readout")) return !options.readout;
  if (clock && camera == 0) return true;  // the others count from its clock
  if (group == "table" && !options.lying) return true;
  if (clock && camera < 0 && capture.base.samples().size() < 2) return true;
  // the first joint of a chain that bends in space takes the grasp's rotation, that of a planar one does not
  return group == "grasp" && quantity.name == std::string("rotation") && chain::bends_in_space(chain);
}

}  // namespace

bool is(const Column& column, const char* name) { return column.quantity->name == std::string(name); }
bool is_mask_start(const Column& column) { return is(column, "mask_start"); }

bool of_colors(const capture::CorrectedQuantity& quantity) { return quantity.group == std::string("colors"); }

Layout layout_of(const capture::Capture& capture, const chain::Chain& chain, const CorrectionOptions& options) {
  Layout layout;
  int readout = -1;  // of all cameras
  const auto add = [&](const capture::CorrectedQuantity& quantity, int camera) {
    const double deviation = capture::prior_deviation(capture, camera, quantity);
    const bool held = deviation == 0.0 || is_held(quantity, capture, chain, camera, options);
    const bool again = !held && quantity.name == std::string("readout") && readout >= 0;
    layout.columns.push_back({&quantity, camera, layout.numbers, held ? -1 : again ? readout : layout.size, deviation});
    layout.numbers += quantity.size;
    if (quantity.name == std::string("readout")) readout = layout.columns.back().first;
    if (!held && !again) layout.size += quantity.size;
  };
  for (const auto& quantity : capture::corrected_quantities()) {
    if (of_colors(quantity)) continue;
    if (quantity.subject == std::string("camera")) {
      for (int c = 0; c < static_cast<int>(capture.cameras.size()); ++c) add(quantity, c);
    } else {
      add(quantity, -1);
    }
  }
  return layout;
}

std::vector<SharedPlaces> places_of(const Layout& layout, int cameras) {
  std::vector<SharedPlaces> out(cameras);
  for (int c = 0; c < cameras; ++c) {
    int at = 0;
    for (const Column& column : layout.columns) {
      if (column.camera >= 0 && column.camera != c) continue;
      for (int i = 0; i < column.quantity->size; ++i, ++at) {
        CHAINSPLAT_CHECK(at < kSharedOfView, "quantities");
        out[c].at[at] = column.first < 0 ? -1 : column.first + i;
        out[c].unit[at] = column.first < 0 ? 0.0 : column.deviation;
      }
    }
    CHAINSPLAT_CHECK(at == kSharedOfView, "quantities " + std::to_string(at));
  }
  return out;
}

capture::Corrections corrections_at(const Layout& layout, const std::vector<capture::Camera>& cameras,
                                    const VectorX& x) {
  capture::Corrections out;
  for (const Column& column : layout.columns) {
    const capture::CorrectedQuantity& q = *column.quantity;
    Correction c;
    c.quantity = &q;
    c.subject = column.camera < 0 ? std::string(q.subject) : cameras[column.camera].name;
    c.value = column.first < 0 ? VectorX::Zero(q.size) : VectorX(column.deviation * x.segment(column.first, q.size));
    c.deviation = VectorX::Zero(q.size);
    if (column.camera >= 0) c.calibration = capture::calibration_text(cameras[column.camera]);
    out.push_back(std::move(c));
  }
  return out;
}

VectorX shared_of(const Layout& layout, const std::vector<capture::Camera>& cameras,
                  const capture::Corrections& corrections) {
  VectorX out = VectorX::Zero(layout.size);
  for (const Column& column : layout.columns) {
    const std::string subject = column.camera < 0 ? std::string(column.quantity->subject) : cameras[column.camera].name;
    const Correction* const found = capture::find(corrections, subject, column.quantity->name);
    if (found && column.first >= 0) out.segment(column.first, column.quantity->size) = found->value / column.deviation;
  }
  return out;
}

MatrixX covariance_of_numbers(const Layout& layout, const MatrixX& shared) {
  MatrixX unit = MatrixX::Zero(layout.numbers, layout.size);
  for (const Column& column : layout.columns)
    for (int i = 0; column.first >= 0 && i < column.quantity->size; ++i)
      unit(column.number + i, column.first + i) = column.deviation;
  return unit * shared * unit.transpose();
}

std::vector<Direction> single_causes(const Layout& layout, const std::vector<capture::Camera>& cameras) {
  std::vector<Direction> out;
  const auto add = [&](const std::string& name, const auto& belongs, const std::string& in_doubt = {}) {
    std::vector<int> numbers;
    for (const Column& column : layout.columns)
      for (int i = 0; column.first >= 0 && belongs(column) && i < column.quantity->size; ++i)
        if (numbers.empty() || numbers.back() != column.first + i) numbers.push_back(column.first + i);
    if (numbers.empty()) return;
    MatrixX directions = MatrixX::Zero(layout.size, static_cast<Eigen::Index>(numbers.size()));
    for (std::size_t k = 0; k < numbers.size(); ++k) directions(numbers[k], static_cast<Eigen::Index>(k)) = 1.0;
    out.push_back({name, in_doubt.empty() ? name : in_doubt, std::move(directions)});
  };
  const auto of = [](const char* subject, const char* name) {
    return [=](const Column& column) { return column.quantity->subject == std::string(subject) && is(column, name); };
  };
  add("base.time", of("base", "time"));
  // a grasp that is off along the rope looks like another length: where one of them is free the other is, too
  const std::string both_of_them = "grasp and length";
  add("grasp", of("grasp", "translation"), both_of_them);
  add("length", of("object", "length"), both_of_them);
  add(both_of_them, [](const Column& column) {
    return (column.quantity->subject == std::string("grasp") && is(column, "translation")) || is(column, "length");
  });
  add("grasp.rotation", of("grasp", "rotation"));
  add("diameter", of("object", "diameter"));
  add("table", of("table", "height"));
  add("focal", of("camera", "focal"));
  add("readout", of("camera", "readout"));
  add("base.time and readout",
      [](const Column& column) { return is(column, "readout") || (column.camera < 0 && is(column, "time")); });
  for (int c = 0; c < static_cast<int>(cameras.size()); ++c) {
    add(cameras[c].name + ".pose", [=](const Column& column) {
      return column.camera == c && (is(column, "rotation") || is(column, "translation"));
    });
    add(cameras[c].name + ".time", [=](const Column& column) { return column.camera == c && is(column, "time"); });
  }
  // clocks count from the first camera's: where that one is wrong all others are, by as much
  MatrixX first = MatrixX::Zero(layout.size, 1);
  for (const Column& column : layout.columns)
    if (column.first >= 0 && is(column, "time")) first(column.first, 0) = 1.0 / column.deviation;
  if (first.any()) out.push_back({cameras[0].name + ".time", cameras[0].name + ".time", std::move(first)});

  const std::size_t alone = out.size();
  add("masks", of("camera", "mask_offset"));
  for (std::size_t i = 0; out.size() > alone && i < alone; ++i) {
    MatrixX both(layout.size, out[i].directions.cols() + out[alone].directions.cols());
    both << out[i].directions, out[alone].directions;
    out.push_back({out[i].name + ", masks", out[i].in_doubt + ", masks", std::move(both)});
  }
  return out;
}

}  // namespace chainsplat::silhouette
