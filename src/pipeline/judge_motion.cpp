// judge_motion.cpp - how far the recognized and the identified motion can be trusted, in plain words.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <span>
#include <string>
#include <vector>

#include "pipeline/stages.h"
#include "recognition/viewpoint.h"

namespace chainsplat::pipeline {
namespace {

using capture::Finding;

constexpr const char *kMisfit = "identification-misfit", *kUnexplainedCode = "unexplained", *kUnexcited = "unexcited",
                     *kOutOfPlane = "out-of-plane", *kHidden = "hidden";
// Share of the length by which the identified motion misses the recognized one, RMS over nodes and frames. Ropes that
// the model can follow leave 0.1 to 0.4 %; a base one frame late, taken as given, 3 %.
constexpr double kDoubtful = 0.01, kUseless = 0.02;
// What the fit leaves, in units of what is expected: recognized ropes that the model can follow leave 0.1, markers on
// measured cables, of which more is expected, up to 0.9.
constexpr double kUnexplained = 1.5;
constexpr double kStill = 2.0;  // of an angle's variation over its noise; swings leave 4 and more at the free end
constexpr std::size_t kFramesOfMotion = 15;  // half a second
// Share of the length by which a rope may leave its plane unseen before that is told: what three cameras are off by.
constexpr double kUnseen = 0.005;
// Share of the length by which ropes do leave it: simulated ones that are moved in a plane by 1 %, bent cables by 3 %.
constexpr double kLeavesPlane = 0.02;
// Share of a rope's points that no camera shows in a frame which is told. Simulated ropes whose end is to be seen leave
// up to 0.06; those whose end or middle goes behind the gripper in all cameras, 0.2.
constexpr double kOutOfSight = 0.1;
constexpr int kPointsAlong = 97;
constexpr int kFramesHidden = 3;       // least number of such frames; single masks may fail
constexpr double kMostlyHidden = 0.2;  // share of the frames beyond which the twin is not to be trusted
constexpr double kMillimeters = 1e3;

struct Misfit {
  double rms = 0.0;  // m
  std::size_t worst = 0;
};
Misfit misfit_of(const twin::Twin& twin, const trajectory::Trajectory& base) {
  Misfit out;
  double sum = 0.0, worst = -1.0, count = 0.0;
  for (std::size_t i = 0; i < twin.states.time.size(); ++i) {
    const math::Pose pose = base.pose(twin.states.time[i]);
    const auto nodes = [&](const math::VectorX& theta) {
      return chain::nodes(twin.chain, chain::link_motions(twin.chain, theta, pose));
    };
    const math::MatrixX apart = nodes(twin.states.theta[i]) - nodes(twin.rollout.theta[i]);
    const double square = apart.squaredNorm();
    sum += square, count += static_cast<double>(apart.cols() - 1);  // the grasp is the same
    if (square > worst) worst = square, out.worst = i;
  }
  out.rms = std::sqrt(sum / std::max(1.0, count));
  return out;
}

void judge_misfit(twin::Twin& twin, const trajectory::Trajectory& base) {
  if (twin.states.time.empty() || twin.rollout.time.size() != twin.states.time.size()) return;
  const Misfit misfit = misfit_of(twin, base);
  if (misfit.rms < kDoubtful * twin.chain.length) return;
  const bool useless = misfit.rms > kUseless * twin.chain.length;
  char text[256];
  std::snprintf(text, sizeof text, "the identified motion misses the recognized one by %.1f mm RMS, most at %.2f s: %s",
                kMillimeters * misfit.rms, twin.states.time[misfit.worst],
                useless ? "do not trust its dynamics; base motion, clock or the rope's kind is not what was given"
                        : "its predictions are no better than that");
  twin.verdict.push_back({kMisfit, "object", kMillimeters * misfit.rms, 0.0, "mm", false, !useless, false,
                          static_cast<int>(misfit.worst), text});
}

// A fit may follow the motion within a share of the length and still leave more than the angles are off: then numbers
// of the model have taken the place of what it lacks, and their standard errors do not know.
void judge_unexplained(twin::Twin& twin) {
  const double misfit = twin.estimates.misfit;
  if (!(misfit > kUnexplained)) return;
  char text[256];
  std::snprintf(text, sizeof text,
                "the identified motion misses the recognized one by %.1f times what its errors explain: something acts "
                "on the rope that the model lacks, and what is identified may stand for it",
                misfit);
  twin.verdict.push_back({kUnexplainedCode, "object", misfit, 0.0, "1", false, true, false, -1, text});
}

// Joints that the motion hardly bends, from 1: their angles vary little more than their noise, which second differences
// tell from a motion that many frames show.
std::vector<int> still_joints(const twin::Twin& twin) {
  const chain::Chain& chain = twin.chain;
  const std::vector<math::VectorX>& theta = twin.states.theta;
  std::vector<int> out;
  if (theta.size() < kFramesOfMotion) return out;
  const auto count = static_cast<double>(theta.size());
  std::vector<double> moved(chain.links(), 0.0), noise(chain.links(), 0.0);  // rad^2
  for (int k = 0; k < chain.angles(); ++k) {
    double mean = 0.0, square = 0.0, jumps = 0.0;
    for (std::size_t i = 0; i < theta.size(); ++i) {
      mean += theta[i][k] / count, square += theta[i][k] * theta[i][k] / count;
      if (i < 2) continue;
      const double jump = theta[i][k] - 2.0 * theta[i - 1][k] + theta[i - 2][k];
      jumps += jump * jump / (count - 2.0);
    }
    moved[chain.child_link[k]] += square - mean * mean;
    noise[chain.child_link[k]] += jumps / 6.0;  // 1 + 4 + 1 times the variance of independent noise
  }
  for (int joint = 1; joint < chain.links(); ++joint)
    if (moved[joint] < kStill * kStill * noise[joint]) out.push_back(joint);
  return out;
}

void judge_excitation(twin::Twin& twin) {
  const std::vector<int> still = still_joints(twin);
  if (still.empty()) return;
  std::string joints;
  for (const int joint : still) joints += (joints.empty() ? "" : ", ") + std::to_string(joint);
  twin.verdict.push_back({kUnexcited, "object", static_cast<double>(still.size()), 0.0, "1", false, true, false, -1,
                          "the motion hardly bends joint" + std::string(still.size() > 1 ? "s " : " ") + joints +
                              ": stiffness and damping there are guesses; `chainsplat excite` proposes a motion"});
}

// Share of the rope's points that lie in none of these views' masks.
double hidden_share(const twin::Twin& twin, const capture::Capture& capture, std::span<const int> views,
                    const math::VectorX& theta) {
  const std::vector<double> along = chain::equal_arclengths(twin.chain, kPointsAlong);
  std::vector<char> seen(along.size(), 0);
  for (const int v : views) {
    const capture::View view = capture::unpacked(capture.views[v]);
    const capture::Camera& camera = capture.cameras[view.camera];
    const auto motions = chain::link_motions(twin.chain, theta, capture.base.pose(view.time));
    const std::vector<char> here = recognition::shown(twin.chain, camera, view, motions, along);
    for (std::size_t i = 0; i < along.size(); ++i) seen[i] |= here[i];
  }
  return static_cast<double>(std::count(seen.begin(), seen.end(), 0)) / static_cast<double>(along.size());
}

// m RMS by which the rope may leave the plane of a planar twin without being seen to; 0 where that is little.
double unseen_bend(const twin::Twin& twin, const silhouette::BendingChoice& choice) {
  const double unseen = std::hypot(choice.out_of_plane_rms, choice.deviation);
  return choice.bending != chain::Bending::planar || unseen < kUnseen * twin.chain.length ? 0.0 : unseen;
}

}  // namespace

void judge_hidden(twin::Twin& twin, const capture::Capture& capture) {
  const std::vector<std::vector<int>> views = capture::views_at(capture, twin.states.time);
  std::vector<double> hidden(views.size(), 0.0);
  core::parallel_for(static_cast<std::int64_t>(views.size()), [&](std::int64_t k) {
    std::vector<int> shown = views[k];  // empty masks tell of nothing that hides a part
    std::erase_if(shown, [&](int v) { return !capture::shows_object(capture.views[v]); });
    if (!shown.empty()) hidden[k] = hidden_share(twin, capture, shown, twin.states.theta[k]);
  });
  const auto frames = std::count_if(hidden.begin(), hidden.end(), [](double share) { return share > kOutOfSight; });
  if (frames < kFramesHidden) return;
  const auto worst = std::max_element(hidden.begin(), hidden.end());
  // corrections may stand for what is hidden; without any, ropes with a quarter hidden were found as well as whole ones
  const bool corrected =
      std::any_of(twin.verdict.begin(), twin.verdict.end(), [](const Finding& f) { return f.corrected; });
  const bool doubtful = corrected && static_cast<double>(frames) > kMostlyHidden * static_cast<double>(hidden.size());
  char text[320];
  std::snprintf(
      text, sizeof text,
      "up to %.0f %% of the rope is out of sight of all cameras, most at %.2f s, and more than %.0f %% in %d of "
      "%zu frames: what is recognized there is a guess%s",
      100.0 * *worst, twin.states.time[worst - hidden.begin()], 100.0 * kOutOfSight, static_cast<int>(frames),
      hidden.size(), doubtful ? ", and what was corrected may be one, too: do not trust this twin" : "");
  twin.verdict.push_back({kHidden, "object", *worst, 0.0, "share", false, !doubtful, false,
                          static_cast<int>(worst - hidden.begin()), text});
}

void judge_bending(twin::Twin& twin, const silhouette::BendingChoice& choice) {
  const double unseen = unseen_bend(twin, choice);
  if (unseen == 0.0) return;
  char text[320];
  std::snprintf(
      text, sizeof text,
      "the cameras do not tell whether the rope stays in a plane: leaving it by %.1f mm RMS would look nearly the "
      "same, and the twin's places are not known better than that; a second camera tells, and where the rope does "
      "leave its plane `bending` spatial is nearer",
      kMillimeters * unseen);
  twin.verdict.push_back({kOutOfPlane, "object", kMillimeters * choice.out_of_plane_rms,
                          kMillimeters * choice.deviation, "mm", false, true, false, -1, text});
}

void widen_by_unseen_bends(twin::Twin& twin, const silhouette::BendingChoice& choice) {
  const double deviation = std::min(unseen_bend(twin, choice), kLeavesPlane * twin.chain.length);
  if (deviation == 0.0) return;
  for (std::size_t k = 0; k < twin.states.covariance.size(); ++k)
    twin.states.covariance[k] += chain::bend_covariance(twin.chain, deviation, twin.states.theta[k]);
}

void judge_motion(twin::Twin& twin, const trajectory::Trajectory& base) {
  std::erase_if(twin.verdict, [](const Finding& f) {
    return f.code == kMisfit || f.code == kUnexplainedCode || f.code == kUnexcited;
  });
  judge_misfit(twin, base);
  judge_unexplained(twin);
  judge_excitation(twin);
}

}  // namespace chainsplat::pipeline
