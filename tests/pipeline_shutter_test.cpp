// A rope that swings, seen by cameras whose rows are drawn each at its own time. Cases that look for a readout draw and
// correct whole recordings, so they are of the suite "whole".
#include "chainsplat/shutter.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <map>

#include "chainsplat/dynamics.h"
#include "pipeline/clocks.h"
#include "pipeline/stages.h"

using namespace chainsplat;

namespace {

using math::MatrixX;
using math::Vector2;
using math::Vector3;
using math::VectorX;

const capture::Capture& demo() {
  static const capture::Capture capture = capture::load(Path(CHAINSPLAT_SOURCE_DIR) / "assets/demo_free_30");
  return capture;
}

chain::Chain rope() {
  return chain::make_chain(demo().length, demo().diameter, demo().direction, demo().bending_axis, 12,
                           chain::Bending::spatial, false);
}

enum class Rope { plain, loaded };  // with a payload, friction in bending and half the stiffness at its tip

// The rope moved by the demo's base.
const chain::States& swing(Rope kind) {
  static const auto made = [](Rope of) {
    const chain::Chain chain = rope();
    dynamics::Parameters p;
    const int moving = chain.links() - 1;
    p.link_mass.assign(moving, 0.05 / moving);
    for (auto* friction : {&p.viscous_friction, &p.coulomb_friction, &p.air_linear, &p.air_quadratic})
      friction->assign(moving, 0.0);
    p.stiffness.assign(chain.angles(), 0.02);
    p.damping.assign(chain.angles(), 2e-4);
    p.rest_angle.assign(chain.angles(), 0.0);
    p.radius = 0.5 * chain.diameter;
    if (of == Rope::loaded) {
      p.tip_mass = 0.015;
      p.bending_friction.assign(chain.angles(), 3e-4);
      p.bending_friction_angle.assign(chain.angles(), 0.03);
      for (int k = 0; k < chain.angles(); ++k) p.stiffness[k] *= 1.0 - 0.5 * k / chain.angles();
    }
    const dynamics::Model model = dynamics::make_model(chain, p);
    std::vector<double> times;
    const double first = demo().base.start(), last = demo().base.end();
    for (double time = first; time < last; time += 1.0 / 240.0) times.push_back(time);
    dynamics::InitialState initial;
    initial.time = first;
    initial.theta = dynamics::static_equilibrium(model, demo().base.pose(first)).theta;
    initial.thetadot = VectorX::Zero(chain.angles());
    return dynamics::rollout(model, demo().base, initial, times);
  };
  static const chain::States plain = made(Rope::plain), loaded = made(Rope::loaded);
  return kind == Rope::plain ? plain : loaded;
}

MatrixX nodes_of(Rope kind, double time) {
  const chain::Chain chain = rope();
  const MatrixX nodes =
      chain::nodes(chain, chain::link_motions(chain, chain::interpolate(swing(kind), time), demo().base.pose(time)));
  return nodes.rightCols(nodes.cols() - 1);  // the grasp is twice there
}

MatrixX nodes_at(double time) { return nodes_of(Rope::plain, time); }

double away(const Vector2& from, const Vector2& to, const Vector2& pixel) {
  const Vector2 step = to - from;
  return (pixel - from - std::clamp((pixel - from).dot(step) / step.squaredNorm(), 0.0, 1.0) * step).norm();
}

using NodesAt = silhouette::NodesAt;

// Rows [first, last) of what the camera sees: a tube about the nodes that is cut off flat enough at its ends.
void draw_rows(const MatrixX& nodes, const capture::Camera& camera, int first, int last, capture::View& view) {
  std::vector<Vector2> line;
  double radius = 0.0;
  for (Eigen::Index i = 0; i < nodes.cols(); ++i) {
    const Vector3 x = camera.world_from_camera.inverse() * Vector3(nodes.col(i));
    line.push_back(capture::project(camera, x));
    radius = 0.5 * demo().diameter * camera.fx / x.z();
  }
  // rounded ends reach as far as the rope
  line.front() += radius * (line[1] - line[0]).normalized();
  line.back() += radius * (line[line.size() - 2] - line.back()).normalized();
  Vector2 low = line.front(), high = line.front();
  for (const Vector2& point : line) low = low.cwiseMin(point), high = high.cwiseMax(point);
  const int left = std::max(0, static_cast<int>(low.x() - radius)),
            right = std::min(view.width, static_cast<int>(high.x() + radius) + 1);
  if (low.y() - radius > last || high.y() + radius < first) return;
  for (int v = first; v < last; ++v)
    for (int u = left; u < right; ++u) {
      double least = INFINITY;
      for (std::size_t i = 0; i + 1 < line.size(); ++i)
        least = std::min(least, away(line[i], line[i + 1], Vector2(u + 0.5, v + 0.5)));
      if (least < radius)
        for (int c = 0; c < 4; ++c) view.rgba[4 * (std::size_t(v) * view.width + u) + c] = c == 3 ? 255 : 128;
    }
}

// All its rows, which take so long from the first to the last; at `time` the middle one is read.
capture::View drawn(const capture::ViewPlace& place, const capture::Camera& camera, double time, double readout,
                    const NodesAt& nodes) {
  capture::View view;
  static_cast<capture::ViewPlace&>(view) = place;
  view.time = time;
  view.x0 = view.y0 = 0, view.width = camera.width, view.height = camera.height;
  view.rgba.assign(std::size_t{4} * camera.width * camera.height, 0);
  constexpr int kTogether = 4;  // rows
  for (int v = 0; v < view.height; v += kTogether)
    draw_rows(nodes(time + ((v + 0.5 * kTogether) / camera.height - 0.5) * readout), camera, v, v + kTogether, view);
  return view;
}

// The demo with the rope that swings in the place of its own. Its frames are stamped when their first rows are read.
capture::Capture recorded(double readout, Rope kind = Rope::plain) {
  static std::map<std::pair<double, Rope>, capture::Capture> kept;
  const auto found = kept.find({readout, kind});
  if (found != kept.end()) return found->second;
  capture::Capture out = demo();
  core::parallel_for(static_cast<std::int64_t>(out.views.size()), [&](std::int64_t i) {
    capture::PackedView& view = out.views[i];
    const double stamp = view.time;
    view = capture::packed(drawn(view, out.cameras[view.camera], stamp + 0.5 * readout, readout,
                                 [&](double time) { return nodes_of(kind, time); }));
    view.time = stamp;
  });
  return kept[{readout, kind}] = out;
}

// Three cameras over a table, with their rows in different directions, and a rope that a base moves about on it. It
// bends as it likes: outlines alone are looked at here.
capture::Capture on_table(double readout, double base_late) {
  constexpr double kInterval = 1.0 / 30.0;
  constexpr int kFrames = 60;
  capture::Capture out;
  out.name = "table";
  out.tabletop = true;
  out.length = 0.3, out.diameter = demo().diameter;
  out.direction = Vector3::UnitX(), out.bending_axis = Vector3::UnitZ();
  out.table = capture::Table{};
  const auto base = [](double time) {
    return math::Pose{math::Matrix3::Identity(),
                      {0.08 * std::sin(5.5 * time), 0.06 * std::sin(3.7 * time), 0.5 * demo().diameter}};
  };
  std::vector<trajectory::Sample> samples;
  for (double time = -0.2; time < kFrames * kInterval + 0.2; time += 1.0 / 120.0)
    samples.push_back({time + base_late, base(time)});
  out.base = trajectory::fit(std::move(samples), "the test's base");
  const chain::Chain chain =
      chain::make_chain(out.length, out.diameter, out.direction, out.bending_axis, 16, chain::Bending::planar, false);
  const NodesAt nodes = [&](double time) {
    VectorX theta(chain.angles());
    for (int k = 0; k < chain.angles(); ++k) theta[k] = 0.2 * std::sin(5.0 * time - 0.3 * k);
    theta[0] *= 0.5;  // the joint at the clamp stands for half a link
    const MatrixX all = chain::nodes(chain, chain::link_motions(chain, theta, base(time)));
    return MatrixX(all.rightCols(all.cols() - 1));
  };
  for (int c = 0; c < 3; ++c) {
    capture::Camera camera;
    camera.name = "cam" + std::to_string(c);
    camera.width = 400, camera.height = 400;
    camera.fx = camera.fy = 420.0, camera.cx = camera.cy = 200.0;
    const Vector3 target(0.13, 0.0, 0.0), eye = target + Vector3(0.2 * (c - 1), 0.15 * (c % 2) - 0.2, 0.7);
    const Vector3 forward = (target - eye).normalized();
    const Vector3 right = forward.cross(Vector3(std::cos(2.0 * c), std::sin(2.0 * c), 0.0)).normalized();
    camera.world_from_camera.rotation << right, forward.cross(right), forward;
    camera.world_from_camera.translation = eye;
    out.cameras.push_back(camera);
    out.times.emplace_back();
    for (int k = 0; k < kFrames; ++k) {
      capture::PackedView view;
      view.camera = c, view.frame = k, view.time = k * kInterval;
      out.times.back().push_back(view.time);
      out.views.push_back(view);
    }
  }
  core::parallel_for(static_cast<std::int64_t>(out.views.size()), [&](std::int64_t i) {
    capture::PackedView& view = out.views[i];
    const double stamp = view.time;
    view = capture::packed(drawn(view, out.cameras[view.camera], stamp + 0.5 * readout, readout, nodes));
    view.time = stamp;
  });
  return out;
}

double overlap(const capture::View& a, const capture::View& b, const capture::Camera& camera) {
  const auto shows = [](const capture::View& view, int u, int v) {
    u -= view.x0, v -= view.y0;
    return u >= 0 && v >= 0 && u < view.width && v < view.height &&
           view.rgba[4 * (std::size_t(v) * view.width + u) + 3] >= 128;
  };
  int both = 0, any = 0;
  for (int v = 0; v < camera.height; ++v)
    for (int u = 0; u < camera.width; ++u) {
      both += shows(a, u, v) && shows(b, u, v);
      any += shows(a, u, v) || shows(b, u, v);
    }
  return static_cast<double>(both) / any;
}

const capture::Finding* rolling(const pipeline::Corrected& found) {
  for (const capture::Finding& f : found.verdict)
    if (f.code == "rolling-shutter") return &f;
  return nullptr;
}

TEST_CASE("rows that were read one after the other are put where they were at one time") {
  constexpr double kTime = 0.6;
  constexpr int kLarger = 3;  // than the demo's pictures, in which the rope goes by a few pixels
  for (const double readout : {0.03, -0.03}) {
    capture::Camera camera = demo().cameras[0];
    for (double* const size : {&camera.fx, &camera.fy, &camera.cx, &camera.cy}) *size *= kLarger;
    camera.width *= kLarger, camera.height *= kLarger;
    const capture::View right = drawn({}, camera, kTime, 0.0, nodes_at);
    const capture::View late = drawn({}, camera, kTime, readout, nodes_at);
    camera.readout = readout;
    const capture::View mended = silhouette::as_read_at_once(late, camera, capture::Pixels::undistorted, nodes_at);
    CHECK(overlap(late, right, camera) < 0.88);
    CHECK(overlap(mended, right, camera) > 0.96);
    camera.readout = 0.0;
    CHECK(silhouette::as_read_at_once(late, camera, capture::Pixels::undistorted, nodes_at).rgba == late.rgba);
  }
}

TEST_CASE("no readout is longer than from frame to frame of the quickest camera, whatever was lost") {
  capture::Capture capture;
  CHECK(pipeline::longest_readout(capture) == capture::kLongestReadout);
  capture.times = {{0.0, 0.1, 0.2, 0.3}, {0.0, 0.02, 0.04, 0.1, 0.1001, 0.12, 0.14}, {}, {0.5}};
  CHECK(pipeline::longest_readout(capture) == doctest::Approx(1.2 * 0.02));
  capture.times = {{0.0, 1.0, 2.0}};
  CHECK(pipeline::longest_readout(capture) == capture::kLongestReadout);
}

TEST_CASE("a rolling shutter is found where there is one" * doctest::test_suite("whole")) {
  {
    constexpr double readout = 0.025;
    capture::Capture capture = recorded(readout);
    const pipeline::Corrected found = pipeline::correct(capture, {}, false);
    const capture::Finding* const said = rolling(found);
    REQUIRE(said);
    CHECK(said->corrected);
    CHECK(std::abs(said->value - 1e3 * readout) < 3.0 * said->deviation);
    CHECK(said->value == doctest::Approx(1e3 * readout).epsilon(0.2));
    const capture::Correction& camera = *capture::find(found.corrections, "cam1", "readout");
    CHECK(camera.value[0] == doctest::Approx(1e-3 * said->value));
    CHECK(camera.state == capture::CorrectionState::free);
    CHECK(capture.cameras[1].readout == camera.value[0]);
    CHECK(capture.times[1][3] == doctest::Approx(demo().times[1][3] + 0.5 * camera.value[0]));
    CHECK(std::abs(capture::value_of(found.corrections, "base", "time")) < 0.002);
    // a twin mends the recording again in the same way
    capture::Capture again = recorded(readout);
    capture::apply(found.corrections, again);
    CHECK(again.times == capture.times);
    CHECK(again.cameras[2].readout == capture.cameras[2].readout);
    // what another recording gives stays
    capture::Capture other = recorded(readout);
    other.cameras[0].readout = 0.02;
    other.sigma.push_back({"cam1", "readout", 0.0});
    capture::apply(found.corrections, other);
    CHECK(other.cameras[0].readout == 0.02);
    CHECK(other.cameras[1].readout == 0.0);
    CHECK(other.times[1] == demo().times[1]);
    // and how sure it is counts: of one number for all cameras, beside nothing else that was corrected
    REQUIRE(found.covariance.rows() == found.covariance.cols());
    Eigen::Index numbers = 0;
    for (const capture::Correction& c : found.corrections)
      if (c.quantity->group != std::string("colors")) numbers += c.value.size();
    CHECK(found.covariance.rows() == numbers);
  }
  capture::Capture right = recorded(0.0);
  capture::Capture loaded = recorded(0.0, Rope::loaded);  // other reasons to move otherwise than a plain rope
  for (capture::Capture* const one : {&right, &loaded}) {
    const pipeline::Corrected found = pipeline::correct(*one, {}, false);
    CHECK_FALSE(rolling(found));
    CHECK(one->cameras[0].readout == 0.0);
    CHECK(capture::value_of(found.corrections, "base", "time") == 0.0);
  }
}

TEST_CASE("outlines on a table tell rows that are read late from a base that is late" * doctest::test_suite("whole")) {
  constexpr double kReadout = 0.03, kLate = 0.015;
  capture::Capture rows = on_table(kReadout, 0.0);
  const pipeline::Corrected of_rows = pipeline::correct(rows, {}, false);
  const capture::Finding* const said = rolling(of_rows);
  REQUIRE(said);
  CHECK(said->value == doctest::Approx(1e3 * kReadout).epsilon(0.2));
  CHECK(std::abs(said->value - 1e3 * kReadout) < 3.0 * said->deviation);
  CHECK(std::abs(capture::value_of(of_rows.corrections, "base", "time")) < 0.002);
  CHECK(rows.cameras[2].readout == doctest::Approx(1e-3 * said->value));
  capture::Capture base = on_table(0.0, kLate);
  const pipeline::Corrected of_base = pipeline::correct(base, {}, false);
  CHECK_FALSE(rolling(of_base));
  CHECK(base.cameras[0].readout == 0.0);
  CHECK(1e3 * capture::value_of(of_base.corrections, "base", "time") == doctest::Approx(1e3 * kLate).epsilon(0.1));
}

TEST_CASE("a rolling shutter and a base that is late at a time are told apart by the motion" *
          doctest::test_suite("whole")) {
  constexpr double kReadout = 0.025, kLate = 0.033;
  capture::Capture both = recorded(kReadout);
  std::vector<trajectory::Sample> samples = both.base.samples();
  for (trajectory::Sample& sample : samples) sample.time += kLate;
  both.base = trajectory::fit(std::move(samples), "a late base");
  const pipeline::Corrected found = pipeline::correct(both, {}, false);
  const capture::Finding* const said = rolling(found);
  REQUIRE(said);
  CHECK(said->value == doctest::Approx(1e3 * kReadout).epsilon(0.25));
  CHECK(1e3 * capture::value_of(found.corrections, "base", "time") == doctest::Approx(1e3 * kLate).epsilon(0.15));
}

TEST_CASE("a readout that is given, or to be taken as given, is not looked for" * doctest::test_suite("whole")) {
  capture::Capture held = recorded(0.025);
  CHECK_FALSE(rolling(pipeline::correct(held, {"time"}, false)));
  capture::Capture exact = recorded(0.025);
  exact.sigma.push_back({"cam0", "readout", 0.0});
  CHECK_FALSE(rolling(pipeline::correct(exact, {}, false)));
}

}  // namespace
