// What a recording was given wrongly, put into the demo capture by hand and looked for.
#include "chainsplat/correction_fit.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>

#include "src/silhouette/correction_priors.h"

namespace {

using namespace chainsplat;
using math::Vector3;

constexpr double kDegree = 3.14159265358979323846 / 180.0;

const capture::Capture& demo() {
  static const capture::Capture capture = capture::load(Path(CHAINSPLAT_SOURCE_DIR) / "assets/demo_free_30");
  return capture;
}

silhouette::CorrectionFit fit(const capture::Capture& capture, const silhouette::CorrectionOptions& options = {}) {
  constexpr int kJoints = 16;
  const chain::Chain chain = chain::make_chain(capture.length, capture.diameter, capture.direction,
                                               capture.bending_axis, kJoints, chain::Bending::spatial, false);
  return silhouette::fit_corrections(chain, capture, silhouette::fit_sequence(chain, capture), options);
}

capture::Capture with_late_base(double late) {
  capture::Capture capture = demo();
  const trajectory::Trajectory& base = capture.base;
  std::vector<trajectory::Sample> samples = base.samples();
  for (trajectory::Sample& sample : samples) sample.pose = base.pose(sample.time - late);
  capture.base = trajectory::fit(samples, "test");
  return capture;
}

TEST_CASE("priors of where masks begin are densities, and seldom before the grasp") {
  const capture::CorrectedQuantity& start = capture::corrected_quantity("camera", "mask_start");
  const silhouette::Layout layout{{{&start, 0, 0, 0, start.deviation}}, 1, 1};
  const math::MatrixX none = math::MatrixX::Zero(1, 0), cost = math::MatrixX::Zero(1, 1);
  constexpr double kStep = 1e-4;                     // mm
  for (const double untold : {0.0, 0.001, 0.003}) {  // m; the last one tells nothing of the cut face
    const auto surprise = [&](double at) {           // mm
      const math::VectorX x = math::VectorX::Constant(1, 1e-3 * at / start.deviation);
      return silhouette::surprise_of(layout, none, cost, x, {untold});
    };
    double before = 0.0, all = 0.0;
    for (double at = -100.0; at < 100.0; at += 0.01) {
      all += 0.01 * std::exp(-surprise(at));
      if (at < -3.0 * std::hypot(0.5, 1e3 * untold)) before += 0.01 * std::exp(-surprise(at));
    }
    CHECK(all == doctest::Approx(1.0).epsilon(1e-3));
    CHECK(before < 0.02);
    for (const double at : {-12.0, -3.0, -1.0, -0.2, 0.3, 1.0, 2.5, 15.0}) {
      const silhouette::SharedPrior prior = silhouette::shared_prior(
          layout, math::VectorX::Constant(1, 1e-3 * at / start.deviation), silhouette::Starts::at_grasp, {untold});
      const double slope = (surprise(at + kStep) - surprise(at - kStep)) / (2e-3 * kStep);  // 1/m
      CHECK(prior.gradient[0] == doctest::Approx(start.deviation * slope).epsilon(1e-5));
      CHECK(prior.information[0] > 0.0);
    }
    for (const double at : {-3000.0, 3000.0}) {  // a camera that is far off puts them there
      const silhouette::SharedPrior prior = silhouette::shared_prior(
          layout, math::VectorX::Constant(1, 1e-3 * at / start.deviation), silhouette::Starts::at_grasp, {untold});
      CHECK(std::isfinite(surprise(at)));
      CHECK(at * prior.gradient[0] > 0.0);  // back to the grasp
    }
  }
}

TEST_CASE("nothing is found wrong with a recording that is right") {
  const silhouette::CorrectionFit found = fit(demo());
  CHECK(found.evidence < 0.1);
  CHECK(std::abs(capture::value_of(found.corrections, "base", "time")) < 2e-3);
  CHECK(std::abs(capture::value_of(found.corrections, "object", "length")) < 0.005 * demo().length);
  for (const silhouette::OutlineMisfit& misfit : found.misfits) {
    CHECK(misfit.rms < 0.6);
    CHECK(std::abs(misfit.mean) < 0.05);
  }
}

// Corrections are fitted to whole recordings: of the suite "whole".
TEST_CASE("a late base, a wrong length and a turned camera are each found to be what they are" *
          doctest::test_suite("whole")) {
  constexpr double kLate = 1.0 / 30.0, kRatio = 0.97, kTurn = 0.5 * kDegree;
  const silhouette::CorrectionFit late = fit(with_late_base(kLate));
  CHECK(late.evidence > 2.0);
  const capture::Correction& clock = *capture::find(late.corrections, "base", "time");
  CHECK(clock.value[0] == doctest::Approx(kLate).epsilon(0.1));
  CHECK(std::abs(clock.value[0] - kLate) < 3.0 * clock.deviation[0]);
  CHECK(clock.state == capture::CorrectionState::free);

  capture::Capture shorter = demo();
  shorter.length *= kRatio;
  const silhouette::CorrectionFit length = fit(shorter);
  const capture::Correction& object = *capture::find(length.corrections, "object", "length");
  CHECK(object.value[0] == doctest::Approx(demo().length - shorter.length).epsilon(0.2));
  CHECK(length.chain.length == doctest::Approx(demo().length).epsilon(0.006));
  CHECK(std::abs(capture::value_of(length.corrections, "base", "time")) < 2e-3);

  capture::Capture turned = demo();
  turned.cameras[1].world_from_camera.rotation =
      turned.cameras[1].world_from_camera.rotation * math::exp_so3(kTurn * Vector3(0.0, 1.0, 0.0));
  const silhouette::CorrectionFit pose = fit(turned);
  const math::VectorX found = capture::find(pose.corrections, "cam1", "rotation")->value;
  CHECK((found / kTurn + Vector3(0.0, 1.0, 0.0)).norm() < 0.35);
  CHECK(capture::find(pose.corrections, "cam0", "rotation")->value.norm() < 0.35 * kTurn);
  CHECK(capture::find(pose.corrections, "grasp", "rotation")->value.isZero(0.0));  // the first joint takes it
}

TEST_CASE("a rope that bends in a plane tells how the gripper turned it, and a table tells it better") {
  const Vector3 turn = 1.5 * kDegree * Vector3(1.0, 0.0, 0.0);  // out of the plane in which the demo nearly swings
  capture::Capture turned = demo();
  std::vector<trajectory::Sample> samples = turned.base.samples();
  for (trajectory::Sample& sample : samples) sample.pose.rotation = sample.pose.rotation * math::exp_so3(turn);
  turned.base = trajectory::fit(samples, "test");
  const chain::Chain chain = chain::make_chain(turned.length, turned.diameter, turned.direction, turned.bending_axis,
                                               16, chain::Bending::planar, false);
  const auto found = [&](const capture::Capture& capture) {
    const silhouette::CorrectionFit fit =
        silhouette::fit_corrections(chain, capture, silhouette::fit_sequence(chain, capture));
    return *capture::find(fit.corrections, "grasp", "rotation");
  };
  const capture::Correction before = found(demo()), after = found(turned);
  CHECK((after.value - before.value + turn).norm() < 0.25 * turn.norm());
  turned.table = capture::Table{Vector3::Zero(), Vector3(0.0, 1.0, 0.0)};
  const capture::Correction table = found(turned);
  CHECK(std::abs(table.value[0] + turn[0]) < std::abs(after.value[0] + turn[0]));
}

// Corrections are fitted to whole recordings: of the suite "whole".
TEST_CASE("where masks begin parts cameras that are all too low from a longer rope, unless fingers hide it" *
          doctest::test_suite("whole")) {
  const auto length_error = [](const capture::Capture& capture, const silhouette::CorrectionOptions& options = {}) {
    return std::abs(capture::value_of(fit(capture, options).corrections, "object", "length"));
  };
  capture::Capture low = demo();
  for (capture::Camera& camera : low.cameras) camera.world_from_camera.translation.z() -= 0.002;
  CHECK(length_error(low) < 0.5 * length_error(low, {.held = {"masks"}}));

  constexpr double kFingers = 0.008;  // m of the rope that they hide
  capture::Capture held = demo();
  for (capture::PackedView& packed : held.views) {
    capture::View view = capture::unpacked(packed);
    const math::Pose base = held.base.pose(view.time);
    const math::Vector3 seen =
        held.cameras[view.camera].world_from_camera.inverse() * (base * Vector3(kFingers * held.direction));
    const capture::Camera& camera = held.cameras[view.camera];
    const int below = static_cast<int>(std::lround(camera.fy * seen.y() / seen.z() + camera.cy)) - view.y0;
    for (int y = 0; y < std::min(below, view.height); ++y)
      std::fill_n(view.rgba.begin() + 4 * static_cast<std::ptrdiff_t>(y) * view.width, 4 * view.width, std::uint8_t{0});
    packed = capture::packed(view);
  }
  const silhouette::CorrectionFit found = fit(held);
  CHECK(capture::value_of(found.corrections, "cam0", "mask_start") == doctest::Approx(kFingers).epsilon(0.2));
  CHECK(std::abs(capture::value_of(found.corrections, "object", "length")) < 0.005 * demo().length);
  CHECK(found.evidence < 0.2);  // nothing else was given wrongly
}

TEST_CASE("a group that is held stays as given") {
  const silhouette::CorrectionFit held = fit(with_late_base(0.02), {.held = {"time", "length"}});
  for (const auto& [subject, quantity] : {std::pair("base", "time"), std::pair("object", "length")}) {
    const capture::Correction& c = *capture::find(held.corrections, subject, quantity);
    CHECK(c.value[0] == 0.0);
    CHECK(c.state == capture::CorrectionState::held);
  }
}

TEST_CASE("of one camera the rope's way from its gripper to its end tells clock and length") {
  const auto alone = [](capture::Capture capture) {
    capture.cameras.resize(1);
    capture.times.resize(1);
    std::erase_if(capture.views, [](const capture::PackedView& view) { return view.camera != 0; });
    return capture;
  };
  const auto in_plane = [](const capture::Capture& capture) {
    const chain::Chain chain = chain::make_chain(capture.length, capture.diameter, capture.direction,
                                                 capture.bending_axis, 16, chain::Bending::planar, false);
    return silhouette::fit_corrections(chain, capture, silhouette::fit_sequence(chain, capture),
                                       {.prior_weight = silhouette::kAsRecognized});
  };
  const silhouette::CorrectionFit right = in_plane(alone(demo()));
  CHECK(right.evidence < 0.15);
  CHECK(capture::find(right.corrections, "cam0", "translation")->state == capture::CorrectionState::prior);
  const silhouette::CorrectionFit late = in_plane(alone(with_late_base(0.02)));
  const capture::Correction& clock = *capture::find(late.corrections, "base", "time");
  CHECK(std::abs(clock.value[0] - 0.02) < 3.0 * clock.deviation[0]);
  CHECK(clock.deviation[0] < 0.005);
  capture::Capture shorter = alone(demo());
  shorter.length *= 0.97;
  const silhouette::CorrectionFit length = in_plane(shorter);
  const capture::Correction& object = *capture::find(length.corrections, "object", "length");
  CHECK(length.evidence > 1.0);
  CHECK(std::abs(object.value[0] - 0.03 * demo().length) < 3.0 * object.deviation[0]);
  CHECK(object.deviation[0] < 0.007 * demo().length);
}

}  // namespace
