#include <doctest/doctest.h>
#include <array>
#include <cmath>
#include <random>

#include "pipeline/judge_capture.h"
#include "pipeline/stages.h"

using namespace chainsplat;

namespace {

constexpr int kJoints = 4, kFrames = 60;
constexpr double kNoise = 1e-3;  // rad

// A rope of 0.4 m whose first two joints swing and whose others do not, seen with noise, and predicted without.
twin::Twin make_twin(double swing, double prediction) {
  twin::Twin twin;
  twin.chain = chain::make_chain(0.4, 0.01, -math::Vector3::UnitZ(), math::Vector3::UnitY(), kJoints,
                                 chain::Bending::planar, false, 0.0);
  std::mt19937 random(7);
  std::normal_distribution<double> normal(0.0, kNoise);
  for (int i = 0; i < kFrames; ++i) {
    const double t = i / 30.0, angle = swing * std::sin(6.0 * t);
    math::VectorX theta = math::VectorX::Zero(kJoints);
    theta[0] = theta[1] = angle;
    twin.rollout.time.push_back(t), twin.states.time.push_back(t);
    twin.rollout.theta.push_back(theta);
    twin.rollout.theta.back()[0] += prediction;
    for (int k = 0; k < kJoints; ++k) theta[k] += normal(random);
    twin.states.theta.push_back(theta);
  }
  return twin;
}

const trajectory::Trajectory& still_base() {
  static const trajectory::Trajectory base = trajectory::fit({{0.0, {}}}, "base");
  return base;
}

const capture::Finding* finding(const twin::Twin& twin, const std::string& code) {
  for (const capture::Finding& f : twin.verdict)
    if (f.code == code) return &f;
  return nullptr;
}

}  // namespace

TEST_CASE("joints that no motion bends are named") {
  twin::Twin twin = make_twin(0.2, 0.0);
  pipeline::judge_motion(twin, still_base());
  REQUIRE(twin.verdict.size() == 1);
  const capture::Finding* const found = finding(twin, "unexcited");
  REQUIRE(found);
  CHECK(found->value == 2.0);
  CHECK(found->trusted);
  CHECK(found->text.find("joints 3, 4:") != std::string::npos);
  pipeline::judge_motion(twin, still_base());
  CHECK(twin.verdict.size() == 1);  // anew, not beside the old one
  twin = make_twin(0.0, 0.0);
  pipeline::judge_motion(twin, still_base());
  CHECK(finding(twin, "unexcited")->value == kJoints);
}

TEST_CASE("a motion that misses what was recognized is doubted, and then not trusted") {
  // a turn about the grasp by a moves points at s by a s: RMS over four equal links a 0.4 m sqrt((1 + 4 + 9 + 16)/64)
  const double reach = 0.4 * std::sqrt(30.0 / 64.0 * 4.0 / 5.0);  // the first joint, at the grasp, is a node, too
  for (const double share : {0.005, 0.015, 0.03}) {
    twin::Twin twin = make_twin(0.2, share * 0.4 / reach);
    pipeline::judge_motion(twin, still_base());
    const capture::Finding* const found = finding(twin, "identification-misfit");
    REQUIRE((found != nullptr) == (share > 0.01));
    if (!found) continue;
    CHECK(found->value == doctest::Approx(1e3 * share * 0.4).epsilon(0.05));
    CHECK(found->trusted == (share < 0.02));
    CHECK(twin.trusted() == found->trusted);
  }
}

TEST_CASE("a fit that leaves more than the angles' errors is doubted, however little that is of the length") {
  for (const double misfit : {0.9, 2.3, std::nan("")}) {
    twin::Twin twin = make_twin(0.2, 0.0);
    twin.estimates.misfit = misfit;
    for (int time = 0; time < 2; ++time) {  // anew, not beside the old one
      pipeline::judge_motion(twin, still_base());
      const capture::Finding* const found = finding(twin, "unexplained");
      REQUIRE((found != nullptr) == (misfit > 1.5));
      CHECK(twin.verdict.size() == (found ? 2 : 1));  // "unexcited" beside it
      if (!found) continue;
      CHECK(found->value == misfit);
      CHECK(found->trusted);
      CHECK(found->text.find("2.3 times") != std::string::npos);
    }
  }
}

TEST_CASE("what is held although the outlines say otherwise is told, and not trusted where it moves the rope") {
  const capture::Finding length = {
      "length", "object", 3.0,   0.2, "%",
      true,     true,     false, -1,  "the rope is 3.0 +- 0.2 % longer than 0.300 m: corrected"};
  CHECK(pipeline::group_of(length) == "length");
  const capture::Finding held = pipeline::not_corrected(length);
  CHECK_FALSE(held.corrected);
  CHECK_FALSE(held.trusted);
  CHECK(held.value == length.value);
  CHECK(held.text ==
        "the rope is 3.0 +- 0.2 % longer than 0.300 m: held as given, which the outlines contradict: do not trust "
        "this twin");

  capture::Finding unsure = length;  // within three deviations
  unsure.deviation = 1.2;
  CHECK(pipeline::not_corrected(unsure).trusted);
  CHECK(pipeline::not_corrected(unsure).text.ends_with(": held as given"));

  const capture::Finding dark = {
      "camera-color", "cam0", -20.0, 1.0, "%",
      true,           true,   false, -1,  "cam0's pictures are 20 +- 1 % darker than all cameras' mean: corrected"};
  CHECK(pipeline::group_of(dark) == "colors");
  CHECK(pipeline::not_corrected(dark).trusted);

  // every group by a finding of its own, and those that are about nothing that may be held
  for (const auto& [code, subject, group] : {std::array{"base-time", "base", "time"},
                                             {"camera-time", "cam1", "time"},
                                             {"camera-pose", "cam1", "cameras"},
                                             {"focal", "cam1", "focal"},
                                             {"grasp", "grasp", "grasp"},
                                             {"table", "table", "table"},
                                             {"grasp", "table", "table"},
                                             {"diameter", "object", "diameter"},
                                             {"mask-offset", "cam0", "masks"},
                                             {"outline-misfit", "cam0", ""},
                                             {"fold", "object", ""}})
    CHECK(pipeline::group_of({code, subject, 1.0, 0.0, "1", true, true, false, -1, ""}) == group);
}

TEST_CASE("a plane that the views do not tell is told") {
  using chain::Bending;
  const auto judged = [](Bending bending, double out_of_plane, double deviation) {
    twin::Twin twin = make_twin(0.2, 0.0);
    pipeline::judge_bending(twin, {bending, out_of_plane, deviation});
    return twin;
  };
  // three cameras that see a rope in its plane; a table; a rope that is modeled in space
  CHECK(judged(Bending::planar, 0.6e-3, 0.3e-3).verdict.empty());
  CHECK(judged(Bending::planar, 0.0, 0.0).verdict.empty());
  CHECK(judged(Bending::spatial, 30e-3, 1e-3).verdict.empty());
  // one camera: much is found, or nothing is known
  for (const auto& [out_of_plane, deviation] : {std::pair{6e-3, 0.5e-3}, {0.0, 6e-3}}) {
    const twin::Twin twin = judged(Bending::planar, out_of_plane, deviation);
    const capture::Finding* const found = finding(twin, "out-of-plane");
    REQUIRE(found);
    CHECK(found->value == doctest::Approx(1e3 * out_of_plane));
    CHECK(found->deviation == doctest::Approx(1e3 * deviation));
    CHECK(found->text.find("6.0 mm") != std::string::npos);
    CHECK(found->trusted);
  }
}

TEST_CASE("what may leave the plane counts in the deviations, as far as ropes do leave it") {
  constexpr int kDraws = 4000;
  for (const auto& [deviation, expected] : {std::pair{3e-3, 3e-3}, {0.1, 8e-3}, {1e-3, 0.0}}) {  // m, of 0.4 m
    twin::Twin twin = make_twin(0.0, 0.0);
    twin.states.covariance.assign(kFrames, math::MatrixX::Zero(kJoints, kJoints));
    pipeline::widen_by_unseen_bends(twin, {chain::Bending::planar, 0.0, deviation});
    // by how much the links' ends move where angles are drawn from the covariance
    const math::MatrixX root = twin.states.covariance.back().cwiseSqrt(),
                        straight =
                            chain::nodes(twin.chain, chain::link_motions(twin.chain, math::VectorX::Zero(kJoints), {}));
    std::mt19937 random(3);
    std::normal_distribution<double> normal;
    double square = 0.0;
    for (int draw = 0; draw < kDraws; ++draw) {
      const math::VectorX theta = root * math::VectorX::NullaryExpr(kJoints, [&](auto) { return normal(random); });
      const math::MatrixX moved = chain::nodes(twin.chain, chain::link_motions(twin.chain, theta, {})) - straight;
      square += moved.squaredNorm() / (kDraws * kJoints);
    }
    CHECK(std::sqrt(square) == doctest::Approx(expected).epsilon(0.05));
  }
}

TEST_CASE("a rope that no camera sees in a part is told, with the frame, and its corrections are not trusted") {
  twin::Twin twin = make_twin(0.1, 0.0);
  capture::Capture capture;
  capture.base = still_base();
  capture::Camera camera;
  camera.name = "cam0", camera.width = 200, camera.height = 200, camera.fx = camera.fy = 300, camera.cx = 100,
  camera.cy = 40;
  camera.world_from_camera = {math::Matrix3{{1, 0, 0}, {0, 0, 1}, {0, -1, 0}},
                              {0, -1, 0}};  // z is down in its pictures
  capture.cameras = {camera};
  capture.times = {twin.states.time};
  const auto show = [&](int frames,
                        int rows) {  // in the first `frames` only the pictures' upper `rows` are in the mask
    capture.views.clear();
    for (int k = 0; k < kFrames; ++k) {
      capture::View view;
      view.frame = k, view.time = twin.states.time[k], view.width = view.height = 200;
      view.rgba.assign(4 * 200 * 200, 0);
      for (int y = 0; y < (k < frames ? rows : 200); ++y)
        for (int x = 0; x < 200; ++x)
          for (int c = 0; c < 4; ++c) view.rgba[4 * (200 * y + x) + c] = 255;
      capture.views.push_back(capture::packed(view));
    }
    twin.verdict.clear();
  };
  // the rope of 0.4 m reaches 120 pixels down from row 40
  show(kFrames, 200);
  pipeline::judge_hidden(twin, capture);
  CHECK(twin.verdict.empty());
  show(2, 100);
  pipeline::judge_hidden(twin, capture);
  CHECK(twin.verdict.empty());  // single masks fail
  show(5, 100);
  pipeline::judge_hidden(twin, capture);
  REQUIRE(finding(twin, "hidden"));
  CHECK(finding(twin, "hidden")->value == doctest::Approx(0.5).epsilon(0.05));
  CHECK(finding(twin, "hidden")->frame < 5);
  CHECK(finding(twin, "hidden")->trusted);
  show(20, 100);
  pipeline::judge_hidden(twin, capture);
  CHECK(finding(twin, "hidden")->trusted);
  show(20, 100);
  twin.verdict.push_back({"length", "object", 1.0, 0.1, "%", true, true, false, -1, "the rope is longer"});
  pipeline::judge_hidden(twin, capture);
  CHECK_FALSE(finding(twin, "hidden")->trusted);
  // nor is an empty mask one that hides something
  show(20, 0);
  pipeline::judge_hidden(twin, capture);
  CHECK(twin.verdict.empty());
}
