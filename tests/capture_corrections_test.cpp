// Corrections applied to a capture, against what they are defined to be.
#include "chainsplat/corrections.h"

#include <doctest/doctest.h>

#include <cmath>

namespace {

using namespace chainsplat;
using capture::Correction;
using capture::Corrections;
using math::Pose;
using math::Vector3;
using math::VectorX;

Correction correction(const std::string& subject, const char* kind, const char* quantity, const VectorX& value) {
  Correction c;
  for (const auto& q : capture::corrected_quantities())
    if (std::string(q.subject) == kind && std::string(q.name) == quantity) c.quantity = &q;
  REQUIRE(c.quantity);
  REQUIRE(c.quantity->size == value.size());
  c.subject = subject;
  c.value = value;
  c.deviation = VectorX::Ones(value.size());
  c.state = capture::CorrectionState::free;
  return c;
}

VectorX one(double value) { return VectorX::Constant(1, value); }

capture::Capture recording() {
  capture::Capture out;
  out.length = 0.3;
  out.diameter = 0.02;
  for (const char* const name : {"left", "right"}) {
    capture::Camera camera;
    camera.name = name;
    camera.fx = 600.0;
    camera.fy = 590.0;
    camera.world_from_camera = {math::exp_so3(Vector3(0.3, -0.2, 0.5)), Vector3(0.1, 0.2, 0.3)};
    out.cameras.push_back(camera);
    out.times.push_back({0.0, 0.1, 0.2, 0.3});
  }
  for (int c = 0; c < 2; ++c)
    for (int f = 0; f < 4; ++f) {
      capture::PackedView view;
      view.camera = c;
      view.frame = f;
      view.time = 0.1 * f;
      out.views.push_back(view);
    }
  std::vector<trajectory::Sample> samples;
  for (int i = 0; i <= 60; ++i) {
    const double t = 0.005 * i;
    samples.push_back({t, {math::exp_so3(Vector3(0.0, 0.4 * t, 0.0)), Vector3(0.2 * std::sin(4.0 * t), 0.1 * t, 0.5)}});
  }
  out.base = trajectory::fit(samples, "test");
  return out;
}

TEST_CASE("a mended capture is given + value, and stamps that are late are moved back") {
  const capture::Capture given = recording();
  capture::Capture mended = given;
  const Vector3 turn(0.01, -0.02, 0.005), shift(0.001, 0.002, -0.003), grasp(0.0, 0.002, 0.001);
  const double late = 0.02;
  capture::apply(
      {correction("left", "camera", "rotation", turn), correction("left", "camera", "translation", shift),
       correction("left", "camera", "focal", one(6.0)), correction("right", "camera", "time", one(0.01)),
       correction("base", "base", "time", one(late)), correction("grasp", "grasp", "translation", grasp),
       correction("object", "object", "length", one(0.009)), correction("object", "object", "diameter", one(-0.001))},
      mended);
  const Pose &before = given.cameras[0].world_from_camera, &after = mended.cameras[0].world_from_camera;
  CHECK((after.rotation - before.rotation * math::exp_so3(turn)).norm() < 1e-12);
  CHECK((after.translation - before.translation - shift).norm() < 1e-12);
  CHECK(mended.cameras[0].fx == doctest::Approx(606.0));
  CHECK(mended.cameras[0].fy == doctest::Approx(590.0 * 1.01));
  CHECK(mended.cameras[1].fx == 600.0);
  CHECK(mended.times[0] == given.times[0]);
  CHECK(mended.times[1][2] == doctest::Approx(0.19));
  CHECK(mended.views[5].time == doctest::Approx(0.09));
  CHECK(mended.length == doctest::Approx(0.309));
  CHECK(mended.diameter == doctest::Approx(0.019));
  // what happened at t stands at t + late, and its grasp was elsewhere
  for (const double t : {0.05, 0.15, 0.25}) {
    const Pose was = given.base.pose(t + late), is = mended.base.pose(t);
    CHECK((is.translation - was * grasp).norm() < 2e-5);
    CHECK((is.rotation - was.rotation).norm() < 2e-4);
  }
}

TEST_CASE("a base that ends before the last frame once its clock is right goes on as it moved") {
  capture::Capture mended = recording();
  capture::apply({correction("base", "base", "time", one(0.02))}, mended);
  CHECK(mended.base.end() >= 0.3);
  const Vector3 expected(0.2 * std::sin(4.0 * 0.32), 0.1 * 0.32, 0.5);  // where the true motion is 20 ms after the end
  CHECK((mended.base.pose(0.3).translation - expected).norm() < 1e-4);
}

TEST_CASE("a camera that was calibrated anew is left alone") {
  const capture::Capture given = recording();
  Correction turn = correction("left", "camera", "rotation", Vector3(0.1, 0.0, 0.0));
  turn.calibration = capture::calibration_text(given.cameras[0]);
  capture::Capture same = given, other = given;
  other.cameras[0].world_from_camera.translation.x() += 1e-3;
  int warnings = 0;
  core::Listener listener;
  listener.warning = [&](const std::string&) { ++warnings; };
  const core::ListenerScope scope(listener);
  capture::apply({turn}, same);
  CHECK(warnings == 0);
  CHECK((same.cameras[0].world_from_camera.rotation - given.cameras[0].world_from_camera.rotation).norm() > 0.05);
  capture::apply({turn}, other);
  CHECK(warnings == 1);
  CHECK(other.cameras[0].world_from_camera.rotation == given.cameras[0].world_from_camera.rotation);
}

}  // namespace
