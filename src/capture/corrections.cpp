#include "chainsplat/corrections.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>

namespace chainsplat::capture {

using math::Pose;
using math::Vector3;
using math::Vector6;
using math::VectorX;

namespace {

constexpr double kLeastShare = 0.1;  // of a given size or focal length: less left is no correction

}  // namespace

const std::vector<CorrectedQuantity>& corrected_quantities() {
  // What a careful laboratory reaches. The priors have heavy tails, so that a fault of ten times that is still found.
  static const std::vector<CorrectedQuantity> quantities = {
      {"camera", "rotation", "cameras", "rad", 3, 0.002, 0.0, 3.2},
      {"camera", "translation", "cameras", "m", 3, 0.001, 0.0, 100.0},
      {"camera", "focal", "focal", "px", 1, 0.0, 0.001, 1e6},
      {"camera", "time", "time", "s", 1, 0.001, 0.0, 10.0},
      {"camera", "mask_offset", "masks", "px", 1, 0.3, 0.0, 1e3},
      {"camera", "mask_start", "masks", "m", 1, 0.0005, 0.0, 100.0},
      {"camera", "gain", "colors", "1", 3, 0.2, 0.0, 10.0},
      {"camera", "bias", "colors", "1", 3, 0.03, 0.0, 1.0},
      {"base", "time", "time", "s", 1, 0.002, 0.0, 10.0},
      {"grasp", "translation", "grasp", "m", 3, 0.0005, 0.0, 100.0},
      {"grasp", "rotation", "grasp", "rad", 3, 0.005, 0.0, 3.2},
      {"object", "length", "length", "m", 1, 0.0, 0.01, 100.0},
      {"object", "diameter", "diameter", "m", 1, 0.0, 0.01, 100.0},
      {"table", "height", "table", "m", 1, 0.001, 0.0, 100.0},
      {"camera", "readout", "time", "s", 1, 0.02, 0.0, kLongestReadout},
  };
  return quantities;
}

const CorrectedQuantity& lost_frames() {
  static const CorrectedQuantity quantity = {"camera", "lost_frames", "time", "1", 0, 0.0, 0.0, kMostFrames};
  return quantity;
}

std::string hash_text(std::uint64_t hash) {
  char text[17];
  std::snprintf(text, sizeof text, "%016llx", static_cast<unsigned long long>(hash));
  return text;
}

const CorrectedQuantity& corrected_quantity(const std::string& subject, const std::string& name) {
  const auto& all = corrected_quantities();
  const auto at =
      std::find_if(all.begin(), all.end(), [&](const auto& q) { return q.subject == subject && q.name == name; });
  CHAINSPLAT_CHECK(at != all.end(), "corrected quantity " + name);
  return *at;
}

double prior_deviation(const Capture& capture, int camera, const CorrectedQuantity& quantity) {
  const std::string subject = camera < 0 ? std::string(quantity.subject) : capture.cameras[camera].name;
  for (const GivenSigma& given : capture.sigma)
    if (given.subject == subject && given.quantity == quantity.name) return given.deviation;
  if (quantity.relative == 0.0) return quantity.deviation;
  const std::string group = quantity.group;
  return quantity.relative * (group == "length"     ? capture.length
                              : group == "diameter" ? capture.diameter
                                                    : capture.cameras[camera].fx);
}

const char* name(CorrectionState state) {
  return state == CorrectionState::free ? "free" : state == CorrectionState::prior ? "prior" : "held";
}

const Correction* find(const Corrections& corrections, const std::string& subject, const std::string& quantity) {
  const auto at = std::find_if(corrections.begin(), corrections.end(), [&](const Correction& c) {
    return c.subject == subject && c.quantity->name == quantity;
  });
  return at == corrections.end() ? nullptr : &*at;
}

double value_of(const Corrections& corrections, const std::string& subject, const std::string& quantity) {
  const Correction* const found = find(corrections, subject, quantity);
  return found ? found->value[0] : 0.0;
}

bool any_correction(const Corrections& corrections) {
  return std::any_of(corrections.begin(), corrections.end(), [](const Correction& c) { return !c.value.isZero(0.0); });
}

std::string calibration_text(const Camera& camera) {
  std::array<double, 14> numbers{};
  Eigen::Map<math::Matrix3>(numbers.data()) = camera.world_from_camera.rotation;
  Eigen::Map<Vector3>(numbers.data() + 9) = camera.world_from_camera.translation;
  numbers[12] = camera.fx;
  numbers[13] = camera.fy;
  char text[17];
  std::snprintf(
      text, sizeof text, "%016llx",
      static_cast<unsigned long long>(core::fnv1a({reinterpret_cast<const char*>(numbers.data()), sizeof numbers})));
  return text;
}

math::Pose grasp_in_base(const Corrections& corrections) {
  Pose out;
  if (const Correction* const turn = find(corrections, "grasp", "rotation")) out.rotation = math::exp_so3(turn->value);
  if (const Correction* const shift = find(corrections, "grasp", "translation")) out.translation = shift->value;
  return out;
}

Pose moved(const Pose& world_from_camera, const Vector3& rotation, const Vector3& translation) {
  return {world_from_camera.rotation * math::exp_so3(rotation), world_from_camera.translation + translation};
}

Camera corrected(const Corrections& corrections, Camera camera) {
  const Correction* const turn = find(corrections, camera.name, "rotation");
  const Correction* const shift = find(corrections, camera.name, "translation");
  const Vector3 none = Vector3::Zero();
  camera.world_from_camera =
      moved(camera.world_from_camera, turn ? Vector3(turn->value) : none, shift ? Vector3(shift->value) : none);
  const double scale = 1.0 + value_of(corrections, camera.name, "focal") / camera.fx;
  if (!(scale > kLeastShare))
    throw InputError(camera.name, "the twin's correction leaves nothing of its focal length", "train again");
  camera.fx *= scale;
  camera.fy *= scale;
  if (const Correction* const gain = find(corrections, camera.name, "gain")) camera.gain += gain->value;
  if (const Correction* const bias = find(corrections, camera.name, "bias")) camera.bias += bias->value;
  camera.mask_offset += value_of(corrections, camera.name, "mask_offset");
  if (!(camera.gain.minCoeff() > kLeastShare))
    throw InputError(camera.name, "the twin's correction leaves nothing of its colors", "train again");
  return camera;
}

trajectory::Trajectory corrected(const Corrections& corrections, const trajectory::Trajectory& base, double first,
                                 double last) {
  const double late = value_of(corrections, "base", "time");
  const Pose grasp = grasp_in_base(corrections);
  if (late == 0.0 && grasp.translation.isZero(0.0) && grasp.rotation.isIdentity(0.0)) return base;

  // a clock that was wrong leaves frames without a base
  std::vector<trajectory::Sample> samples = trajectory::continued(base, first + late, last + late);
  for (trajectory::Sample& sample : samples) {
    sample.time -= late;
    sample.pose = sample.pose * grasp;
  }
  return trajectory::fit(std::move(samples), "the corrected base");
}

void restore_lost(const VectorX& frames, int camera, Capture& capture) {
  const double interval = frame_interval(capture, camera);
  const auto later = [&](int frame) { return interval * static_cast<double>((frames.array() <= frame).count()); };
  std::vector<double>& times = capture.times[camera];
  for (std::size_t f = 0; f < times.size(); ++f) times[f] += later(static_cast<int>(f));
  for (PackedView& view : capture.views)
    if (view.camera == camera) view.time += later(view.frame);
}

void apply(const Corrections& corrections, Capture& capture) {
  if (!any_correction(corrections)) return;
  const CorrectedQuantity& readout_of_camera = corrected_quantity("camera", "readout");
  double first = 1e300, last = -1e300;
  for (std::size_t c = 0; c < capture.cameras.size(); ++c) {
    const Correction* const lost = find(corrections, capture.cameras[c].name, lost_frames().name);
    if (lost && lost->calibration == hash_text(capture.hash)) restore_lost(lost->value, static_cast<int>(c), capture);
    // one that this capture gives stays; else a frame's time moves to that of its middle row
    double& readout = capture.cameras[c].readout;
    const bool open = readout == 0.0 && prior_deviation(capture, static_cast<int>(c), readout_of_camera) > 0.0;
    if (open) readout = value_of(corrections, capture.cameras[c].name, "readout");
    const double late =
        value_of(corrections, capture.cameras[c].name, "time") - (open ? 0.5 * std::abs(readout) : 0.0);
    if (late != 0.0) {
      for (double& time : capture.times[c]) time -= late;
      for (PackedView& view : capture.views)
        if (view.camera == static_cast<int>(c)) view.time -= late;
    }
    if (!capture.times[c].empty()) {
      first = std::min(first, capture.times[c].front());
      last = std::max(last, capture.times[c].back());
    }
    Camera& camera = capture.cameras[c];
    const Correction* const turn = find(corrections, camera.name, "rotation");
    if (turn && !turn->calibration.empty() && turn->calibration != calibration_text(camera)) {
      core::warn(camera.name + ": is calibrated otherwise than when the twin was made; it is taken as given");
      continue;
    }
    camera = corrected(corrections, camera);
  }
  capture.base = corrected(corrections, capture.base, first, last);
  const auto resize = [&](double& size, const char* quantity) {
    const double corrected = size + value_of(corrections, "object", quantity);
    if (!(corrected > kLeastShare * size))
      throw InputError("object." + std::string(quantity), "the twin's correction leaves nothing of it", "train again");
    size = corrected;
  };
  resize(capture.length, "length");
  resize(capture.diameter, "diameter");
  if (capture.table) capture.table->point += value_of(corrections, "table", "height") * capture.table->normal;
}

}  // namespace chainsplat::capture
