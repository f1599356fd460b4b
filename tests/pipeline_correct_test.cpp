// Conventions and exposures that a capture was given or recorded wrongly, put into the demo by hand. Cases that correct
// more than one whole recording are of the suite "whole".
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>

#include "chainsplat/correction_fit.h"
#include "pipeline/stages.h"

using namespace chainsplat;

namespace {

capture::Capture demo() {
  static const capture::Capture capture = capture::load(Path(CHAINSPLAT_SOURCE_DIR) / "assets/demo_free_30");
  return capture;
}

const capture::Finding* finding(const std::vector<capture::Finding>& verdict, const std::string& code,
                                const std::string& subject) {
  for (const capture::Finding& f : verdict)
    if (f.code == code && f.subject == subject) return &f;
  return nullptr;
}

TEST_CASE("half a pixel is named and taken back, and is not found where there is none" * doctest::test_suite("whole")) {
  for (const double shift : {-0.5, 0.5}) {
    capture::Capture capture = demo();
    for (capture::Camera& camera : capture.cameras) camera.cx += shift, camera.cy += shift;
    const pipeline::Corrected found = pipeline::correct(capture, {}, false);
    const capture::Finding* const said = finding(found.verdict, "half-pixel", "cameras");
    REQUIRE(said);
    CHECK(said->value == -shift);
    CHECK(said->corrected);
    CHECK(said->trusted);
    // the middle of the picture is where it was with the right numbers
    for (std::size_t c = 0; c < capture.cameras.size(); ++c) {
      const capture::Camera &mended = capture.cameras[c], right = demo().cameras[c];
      const math::Vector3 seen = right.world_from_camera * math::Vector3(0, 0, 1);
      const math::Vector2 at = capture::project(mended, mended.world_from_camera.inverse() * seen);
      CHECK((at - math::Vector2(right.cx, right.cy)).norm() < 1e-3);
    }
  }
  capture::Capture right = demo();
  const pipeline::Corrected nothing = pipeline::correct(right, {}, false);
  CHECK(!finding(nothing.verdict, "half-pixel", "cameras"));
  for (const capture::Camera& camera : right.cameras) {
    CHECK(camera.gain.isOnes(0.0));
    CHECK(camera.bias.isZero(0.0));
  }
}

TEST_CASE("a base that no camera sees is a problem, not a crash" * doctest::test_suite("whole")) {
  for (const double far : {30.0, 5e5}) {  // m, no unit's factor
    capture::Capture capture = demo();
    std::vector<trajectory::Sample> samples = capture.base.samples();
    for (trajectory::Sample& sample : samples) sample.pose.translation.z() += far;
    capture.base = trajectory::fit(samples, "base.tum");
    const pipeline::Corrected found = pipeline::correct(capture, {}, false);
    const capture::Finding* const said = finding(found.verdict, "unseen", "base");
    REQUIRE(said);
    CHECK(said->impossible);
    CHECK(found.corrections.empty());
    CHECK(pipeline::correct(capture, {}, true).corrections.empty());
  }
}

// The plane in which the demo swings as a table, given so much higher, m.
capture::Capture on_table(double table_higher) {
  capture::Capture capture = demo();
  const math::Pose grasp = capture.base.pose(capture.base.start());
  const math::Vector3 normal = grasp.rotation * capture.bending_axis;
  capture.tabletop = true;
  capture.table = capture::Table{grasp.translation + (table_higher - 0.5 * capture.diameter) * normal, normal};
  return capture;
}

// Masks of a chain of 24 joints, all bent alike by `bend(time)`, in the place of the demo's.
template <typename Bend>
void draw(const std::vector<double>& lift, const Bend& bend, capture::Capture& capture) {
  chain::Chain chain = chain::make_chain(capture.length, capture.diameter, capture.direction, capture.bending_axis, 24,
                                         chain::Bending::planar, false);
  chain.lift = lift;
  std::vector<double> arclengths = chain::equal_arclengths(chain, 300);
  const double radius_of_end = 0.5 * capture.diameter;  // balls are drawn: the last ones touch the ends
  for (double& s : arclengths) s = radius_of_end + s * (1.0 - capture.diameter / capture.length);
  for (capture::PackedView& packed : capture.views) {
    const capture::Camera& camera = capture.cameras[packed.camera];
    capture::View view = capture::unpacked(packed);
    view.x0 = view.y0 = 0, view.width = camera.width, view.height = camera.height;
    view.rgba.assign(std::size_t{4} * camera.width * camera.height, 0);
    const math::VectorX theta = math::VectorX::Constant(chain.angles(), bend(view.time));
    const math::MatrixX line =
        chain::centerline(chain, chain::link_motions(chain, theta, capture.base.pose(view.time)), arclengths);
    for (Eigen::Index i = 0; i < line.cols(); ++i) {
      const math::Vector3 x = camera.world_from_camera.inverse() * math::Vector3(line.col(i));
      const math::Vector2 at = capture::project(camera, x);
      const double radius = 0.5 * capture.diameter * camera.fx / x.z();
      for (int v = std::max(0, int(at.y() - radius)); v < std::min(view.height, int(at.y() + radius) + 2); ++v)
        for (int u = std::max(0, int(at.x() - radius)); u < std::min(view.width, int(at.x() + radius) + 2); ++u)
          if (std::hypot(u + 0.5 - at.x(), v + 0.5 - at.y()) < radius) view.rgba[4 * (v * view.width + u) + 3] = 255;
    }
    packed = capture::packed(view);
  }
}

// A rope in that plane that is held so far above where it lies on the table, m, and comes down as a rope of usual
// stiffness, or in so many times its arclength.
capture::Capture lying(double held, double reach = 1.0) {
  capture::Capture capture = on_table(-held);
  const chain::Chain chain = chain::make_chain(capture.length, capture.diameter, capture.direction,
                                               capture.bending_axis, 24, chain::Bending::planar, false);
  draw(
      silhouette::lying_down(chain, -held, reach), [](double time) { return 0.03 * std::sin(3.0 * time); }, capture);
  return capture;
}

bool is_of_masks(const capture::Correction& correction) { return correction.quantity->group == std::string("masks"); }

double size_of(const pipeline::Corrected& found, const char* subject, const char* quantity) {
  return capture::find(found.corrections, subject, quantity)->value.norm();
}

TEST_CASE("one thing that explains all that is wrong is corrected alone" * doctest::test_suite("whole")) {
  const auto late = [](capture::Capture& capture, double seconds) {
    std::vector<trajectory::Sample> samples = capture.base.samples();
    for (trajectory::Sample& sample : samples) sample.time += seconds;
    capture.base = trajectory::fit(samples, "base.tum");
  };
  {
    capture::Capture capture = demo();
    late(capture, 0.02);
    const pipeline::Corrected found = pipeline::correct(capture, {}, false);
    CHECK(std::abs(size_of(found, "base", "time") - 0.02) < 0.003);
    for (const capture::Correction& correction : found.corrections)
      if (correction.subject == "grasp" || correction.subject == "object" ||
          correction.quantity->name == std::string("rotation"))
        CHECK(correction.value.isZero(0.0));
    CHECK(capture::find(found.corrections, "object", "length")->deviation[0] > 1e-4);  // it could be off by that
  }
  {
    // the same with a camera that is turned: it takes more than one thing
    capture::Capture capture = demo();
    late(capture, 0.02);
    math::Pose& pose = capture.cameras[1].world_from_camera;
    pose.rotation = pose.rotation * math::exp_so3(math::Vector3(0.01, -0.005, 0.0));
    const pipeline::Corrected found = pipeline::correct(capture, {}, false);
    CHECK(std::abs(size_of(found, "base", "time") - 0.02) < 0.004);
    CHECK(size_of(found, capture.cameras[1].name.c_str(), "rotation") > 0.005);
    CHECK(size_of(found, "object", "length") > 0.0);
  }
}

TEST_CASE("a base that is late by less than outlines tell is found by the rope's motion, and is no rolling shutter" *
          doctest::test_suite("whole")) {
  for (const double late : {-0.004, 0.008}) {
    CAPTURE(late);
    capture::Capture capture = demo();
    std::vector<trajectory::Sample> samples = capture.base.samples();
    for (trajectory::Sample& sample : samples) sample.time += late;
    capture.base = trajectory::fit(samples, "base.tum");
    const pipeline::Corrected found = pipeline::correct(capture, {}, false);
    const capture::Correction& clock = *capture::find(found.corrections, "base", "time");
    CHECK(std::abs(clock.value[0] - late) < 0.002);
    CHECK(std::abs(clock.value[0] - late) < 3.0 * clock.deviation[0]);
    CHECK(clock.state == capture::CorrectionState::free);
    const capture::Finding* const said = finding(found.verdict, "base-time", "base");
    REQUIRE(said);
    CHECK(said->value == doctest::Approx(1e3 * clock.value[0]));
    CHECK(!finding(found.verdict, "rolling-shutter", "cameras"));
    CHECK(found.covariance.diagonal().maxCoeff() >= clock.deviation[0] * clock.deviation[0] * (1.0 - 1e-9));
    // a twin mends the recording again in the same way
    capture::Capture again = demo();
    again.base = trajectory::fit(std::move(samples), "base.tum");
    capture::apply(found.corrections, again);
    for (const double t : {0.3, 1.0, 1.7})
      CHECK((again.base.pose(t).translation - capture.base.pose(t).translation).norm() < 1e-6);
  }
}

TEST_CASE("a thicker rope lies higher on its table, which is no other table") {
  capture::Capture capture = lying(0.0);
  capture.diameter *= 1.1;
  const pipeline::Corrected found = pipeline::correct(capture, {}, false);
  CHECK(std::abs(capture.diameter / demo().diameter - 1.0) < 0.03);
  CHECK(size_of(found, "table", "height") == 0.0);
  CHECK(size_of(found, "grasp", "translation") == 0.0);
}

TEST_CASE("a grasp that is off along the rope and a wrong length are told apart where masks begin" *
          doctest::test_suite("whole")) {
  constexpr double kOff = 0.004;  // m
  const auto drawn = [] {
    capture::Capture capture = demo();
    draw(
        {}, [](double time) { return 0.02 * std::sin(3.0 * time); }, capture);
    return capture;
  };
  {
    capture::Capture capture = drawn();
    std::vector<trajectory::Sample> samples = capture.base.samples();
    for (trajectory::Sample& sample : samples)
      sample.pose.translation -= kOff * (sample.pose.rotation * capture.direction);
    capture.base = trajectory::fit(samples, "base.tum");
    const pipeline::Corrected found = pipeline::correct(capture, {}, false);
    CHECK(size_of(found, "grasp", "translation") == doctest::Approx(kOff).epsilon(0.3));
    CHECK(size_of(found, "object", "length") < 0.3 * kOff);
    CHECK(capture::find(found.corrections, "object", "length")->deviation[0] > 0.1 * kOff);  // it may have been this
  }
  {
    capture::Capture capture = drawn();
    capture.length -= kOff;
    const pipeline::Corrected found = pipeline::correct(capture, {}, false);
    CHECK(size_of(found, "object", "length") == doctest::Approx(kOff).epsilon(0.3));
    CHECK(size_of(found, "grasp", "translation") < 0.3 * kOff);
  }
}

TEST_CASE("straight links do not make a bent rope shorter") {
  const auto found = [](double bend) {  // m, of the length, all else held; rad by all joints
    capture::Capture capture = demo();
    draw(
        {}, [&](double) { return bend / 24.0; }, capture);
    const chain::Chain chain = chain::make_chain(capture.length, capture.diameter, capture.direction,
                                                 capture.bending_axis, 6, chain::Bending::planar, false);
    const silhouette::CorrectionFit fit =
        silhouette::fit_corrections(chain, capture, silhouette::fit_sequence(chain, capture),
                                    {.held = {"cameras", "focal", "time", "masks", "grasp", "diameter"}});
    return capture::value_of(fit.corrections, "object", "length");
  };
  // six chords of an arc of 3 rad are 1 % shorter than it; both differ from 0 by the round end that is drawn
  CHECK(std::abs(found(3.0) - found(0.3)) < 0.005 * demo().length);
}

void raise_grasp(double height, capture::Capture& capture) {
  std::vector<trajectory::Sample> samples = capture.base.samples();
  for (trajectory::Sample& sample : samples) sample.pose.translation += height * capture.table->normal;
  capture.base = trajectory::fit(samples, "base.tum");
}

TEST_CASE("a grasp that is given too high above its table is lowered, and one that is truly held so high stays" *
          doctest::test_suite("whole")) {
  constexpr double kOff = 0.003;  // m
  for (const double held : {0.0, kOff}) {
    capture::Capture right = lying(held);
    const pipeline::Corrected nothing = pipeline::correct(right, {}, false);
    CHECK(capture::find(nothing.corrections, "grasp", "translation")->value.isZero(0.0));
    CHECK(!finding(nothing.verdict, "grasp", "table"));
    // it comes down otherwise than is assumed: what may be wrong instead counts in the deviations
    if (held > 0.0) CHECK((nothing.covariance.size() > 0 && nothing.covariance.diagonal().maxCoeff() > 0.0));
  }
  capture::Capture high = lying(0.0);
  const std::vector<capture::Camera> given = high.cameras;
  raise_grasp(kOff, high);
  const pipeline::Corrected lowered = pipeline::correct(high, {}, false);
  const capture::Finding* const said = finding(lowered.verdict, "grasp", "grasp");
  REQUIRE(said);
  CHECK(said->value == doctest::Approx(1e3 * kOff).epsilon(0.25));
  CHECK(std::abs(said->value - 1e3 * kOff) < 3.0 * said->deviation);
  CHECK(said->corrected);
  for (std::size_t c = 0; c < given.size(); ++c)  // and that alone
    CHECK(high.cameras[c].world_from_camera.translation == given[c].world_from_camera.translation);
}

TEST_CASE("a rope held high above its table, a grasp given so high and a table given so low are told apart" *
          doctest::test_suite("whole")) {
  constexpr double kFar = 0.012;  // m
  for (const double reach : {1.0, 1.6}) {
    capture::Capture held = lying(kFar, reach);
    const std::vector<capture::Camera> given = held.cameras;
    const pipeline::Corrected as_given = pipeline::correct(held, {}, false);
    const capture::Finding* const said = finding(as_given.verdict, "held-high", "object");
    REQUIRE(said);
    CHECK(said->value == doctest::Approx(1e3 * kFar).epsilon(0.2));
    CHECK(!said->trusted);
    CHECK(as_given.corrections.empty());
    for (std::size_t c = 0; c < given.size(); ++c)
      CHECK(held.cameras[c].world_from_camera.translation == given[c].world_from_camera.translation);
  }
  for (const double off : {kFar, -kFar}) {
    capture::Capture grasp = lying(0.0);
    raise_grasp(off, grasp);
    const pipeline::Corrected found = pipeline::correct(grasp, {}, false);
    CHECK(!finding(found.verdict, "held-high", "object"));
    const capture::Correction* const shift = capture::find(found.corrections, "grasp", "translation");
    const double error = -off - shift->value.dot(on_table(0.0).bending_axis);
    CHECK(std::abs(error) < 0.001);
    CHECK(std::abs(error) < 3.0 * shift->deviation.maxCoeff());
  }
  capture::Capture table = lying(0.0);
  table.table->point -= kFar * table.table->normal;
  const pipeline::Corrected found = pipeline::correct(table, {}, false);
  const capture::Finding* const said = finding(found.verdict, "table", "table");
  REQUIRE(said);
  CHECK(said->value == doctest::Approx(1e3 * kFar).epsilon(0.1));
  for (const capture::Correction& correction : found.corrections)
    CHECK((correction.subject == "table" || is_of_masks(correction) || correction.value.isZero(0.0)));
}

TEST_CASE("frames that cameras lost are named, and their clocks go on where they were" * doctest::test_suite("whole")) {
  capture::Capture right = demo();
  pipeline::correct(right, {}, false);
  const std::vector<std::vector<double>> times = right.times;
  capture::Capture capture = demo();
  const double interval = capture::frame_interval(capture, 1);
  const std::vector<std::pair<int, int>> lost = {{1, 20}, {2, 35}};  // camera, frame
  for (const auto& [camera, frame] : lost) {
    for (std::size_t f = frame; f < capture.times[camera].size(); ++f) capture.times[camera][f] -= interval;
    for (capture::PackedView& view : capture.views)
      if (view.camera == camera && view.frame >= frame) view.time -= interval;
  }
  const std::vector<std::vector<double>> given = capture.times;
  const pipeline::Corrected found = pipeline::correct(capture, {}, false);
  for (const auto& [camera, frame] : lost) {
    const capture::Finding* const said = finding(found.verdict, "lost-frames", capture.cameras[camera].name);
    REQUIRE(said);
    CHECK(said->value == 1.0);
    CHECK(std::abs(said->frame - frame) <= 2);
    CHECK(capture.times[camera].back() == doctest::Approx(times[camera].back()).epsilon(1e-3));
  }
  CHECK(!finding(found.verdict, "lost-frames", capture.cameras[0].name));
  // what a twin carries does the same to the recording, and nothing to another one
  for (const bool same : {true, false}) {
    capture::Capture again = demo();
    again.times = given;
    if (!same) ++again.hash;
    capture::apply(found.corrections, again);
    CHECK((again.times[1].back() == capture.times[1].back()) == same);
  }
}

TEST_CASE("where the grasp is to be taken as given, one that is above the table is named" *
          doctest::test_suite("whole")) {
  for (const double high : {0.0, 0.0025}) {  // m
    capture::Capture capture = on_table(-high);
    const pipeline::Corrected found = pipeline::correct(capture, {"grasp", "table"}, false);
    const capture::Finding* const said = finding(found.verdict, "grasp", "table");
    CHECK((said != nullptr) == (high > 0.0));
    if (!said) continue;
    CHECK(said->value == doctest::Approx(1e3 * high).epsilon(0.3));
    CHECK(!said->corrected);
    CHECK(said->trusted);
  }
}

TEST_CASE("a darker camera is named, and its pictures stay as they are" * doctest::test_suite("whole")) {
  constexpr double kDark = 0.7;
  capture::Capture capture = demo();
  for (capture::PackedView& view : capture.views) {
    if (view.camera != 1) continue;
    for (std::size_t i = 0; i < view.rgba.size(); i += 4)
      for (int c = 0; c < 3; ++c) view.rgba[i + c] = static_cast<std::uint8_t>(std::lround(kDark * view.rgba[i + c]));
  }
  const std::vector<capture::PackedView> recorded = capture.views;
  const pipeline::Corrected found = pipeline::correct(capture, {}, false);
  const capture::Finding* const said = finding(found.verdict, "camera-color", "cam1");
  REQUIRE(said);
  CHECK(said->value < -15.0);
  CHECK(said->corrected);
  const double others = 0.5 * (capture.cameras[0].gain.mean() + capture.cameras[2].gain.mean());
  CHECK(capture.cameras[1].gain.mean() / others == doctest::Approx(kDark).epsilon(0.05));
  CHECK(std::equal(recorded.begin(), recorded.end(), capture.views.begin(),
                   [](const capture::PackedView& a, const capture::PackedView& b) { return a.rgba == b.rgba; }));

  capture::Capture held = demo();
  held.views = recorded;
  const pipeline::Corrected as_given = pipeline::correct(held, {"colors"}, false);
  CHECK(!finding(as_given.verdict, "camera-color", "cam1"));
  CHECK(held.cameras[1].gain.isOnes(0.0));
}

}  // namespace
