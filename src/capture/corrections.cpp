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

constexpr double kLongestExtrapolation = 0.2;  // s by which a base is continued at either end

}  // namespace

const std::vector<CorrectedQuantity>& corrected_quantities() {
  // What a careful laboratory reaches. The priors have heavy tails, so that a fault of ten times that is still found.
  static const std::vector<CorrectedQuantity> quantities = {
      {"camera", "rotation", "cameras", "rad", 3, 0.002, 0.0}, {"camera", "translation", "cameras", "m", 3, 0.001, 0.0},
      {"camera", "focal", "focal", "px", 1, 0.0, 0.001},       {"camera", "time", "time", "s", 1, 0.001, 0.0},
      {"camera", "mask_offset", "masks", "px", 1, 0.3, 0.0},   {"base", "time", "time", "s", 1, 0.002, 0.0},
      {"grasp", "translation", "grasp", "m", 3, 0.0005, 0.0},  {"object", "length", "length", "m", 1, 0.0, 0.01},
      {"object", "diameter", "diameter", "m", 1, 0.0, 0.01},
  };
  return quantities;
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

Camera corrected(const Corrections& corrections, Camera camera) {
  Pose& pose = camera.world_from_camera;
  if (const Correction* const turn = find(corrections, camera.name, "rotation"))
    pose.rotation = pose.rotation * math::exp_so3(turn->value);
  if (const Correction* const shift = find(corrections, camera.name, "translation")) pose.translation += shift->value;
  const double scale = 1.0 + value_of(corrections, camera.name, "focal") / camera.fx;
  camera.fx *= scale;
  camera.fy *= scale;
  return camera;
}

trajectory::Trajectory corrected(const Corrections& corrections, const trajectory::Trajectory& base, double first,
                                 double last) {
  const double late = value_of(corrections, "base", "time");
  const Correction* const grasp = find(corrections, "grasp", "translation");
  if (late == 0.0 && (!grasp || grasp->value.isZero(0.0))) return base;
  const Pose grasp_in_base{math::Matrix3::Identity(), grasp ? Vector3(grasp->value) : Vector3::Zero()};

  // samples beyond the recorded ones, one interval apart, where a clock that was wrong leaves frames without a base
  std::vector<trajectory::Sample> samples = base.samples();
  if (samples.size() > 1) {
    const double interval = (base.end() - base.start()) / static_cast<double>(samples.size() - 1);
    const auto beyond = [&](double needed, double from, double direction) {
      std::vector<trajectory::Sample> out;
      const trajectory::BaseMotion motion = base.at(from);
      const int count = static_cast<int>(std::ceil(std::min(needed, kLongestExtrapolation) / interval));
      for (int i = 1; i <= count; ++i) {
        const double t = direction * i * interval;
        const Vector6 twist = t * motion.velocity + 0.5 * t * t * motion.acceleration;
        out.push_back({from + t, motion.pose * math::exp_se3(twist)});
      }
      return out;
    };
    const std::vector<trajectory::Sample> after = beyond(last + late - base.end(), base.end(), 1.0);
    std::vector<trajectory::Sample> before = beyond(base.start() - first - late, base.start(), -1.0);
    std::reverse(before.begin(), before.end());
    samples.insert(samples.end(), after.begin(), after.end());
    samples.insert(samples.begin(), before.begin(), before.end());
  }
  for (trajectory::Sample& sample : samples) {
    sample.time -= late;
    sample.pose = sample.pose * grasp_in_base;
  }
  return trajectory::fit(std::move(samples), "the corrected base");
}

void apply(const Corrections& corrections, Capture& capture) {
  if (std::all_of(corrections.begin(), corrections.end(), [](const Correction& c) { return c.value.isZero(0.0); }))
    return;
  double first = 1e300, last = -1e300;
  for (std::size_t c = 0; c < capture.cameras.size(); ++c) {
    const double late = value_of(corrections, capture.cameras[c].name, "time");
    if (late != 0.0) {
      for (double& time : capture.times[c]) time -= late;
      for (View& view : capture.views)
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
  capture.length += value_of(corrections, "object", "length");
  capture.diameter += value_of(corrections, "object", "diameter");
}

}  // namespace chainsplat::capture
