// correct.cpp - what a capture was given wrongly by a little, found before the long work, and said in plain words.
#include <algorithm>
#include <cmath>
#include <cstdarg>
#include <cstdio>
#include <numbers>

#include "chainsplat/silhouette.h"
#include "pipeline/stages.h"

namespace chainsplat::pipeline {

namespace {

using capture::Finding;

constexpr int kJoints = 16;  // with eight, the clamp's bend is taken for a wrong length (design.md, 'Corrections')
// Share by which the outlines' square residuals must be larger with what was given before anything is changed. Straight
// links alone leave up to 0.05 on clean recordings of hanging ropes and 0.5 on a table, a grasp 3 mm off 1.5 and more
// (design.md, 'Corrections').
constexpr double kNothingWrong = 1.0;
constexpr double kSure = 1.5;  // standard deviations from which a correction is told, since something is wrong
constexpr double kMeters = 1e3, kSeconds = 1e3, kDegrees = 180.0 / std::numbers::pi;  // to mm, ms, degrees
// What a correction must be, at least, to be worth a line.
constexpr double kClock = 2.0;     // ms
constexpr double kTurn = 0.1;      // degrees
constexpr double kShift = 2.0;     // mm, of a camera
constexpr double kFocal = 0.3;     // %
constexpr double kGrasp = 1.0;     // mm
constexpr double kLength = 0.5;    // %
constexpr double kDiameter = 3.0;  // %
constexpr double kFringe = 0.6;    // px
// What no correction explains.
constexpr double kMisfit = 1.5;    // px RMS of a camera's outlines, of which straight links leave 0.3 to 0.4
constexpr double kForeign = 0.25;  // share of the outline that is not the rope's: blobs, occluders, or a wrong length
constexpr double kFold = 2.4;      // rad at one of the user's joints: no rope bends so far at one place
constexpr double kFartherThanAny = 0.15;  // share of the length by which no ruler is wrong

std::string text(const char* format, ...) __attribute__((format(printf, 1, 2)));
std::string text(const char* format, ...) {
  char line[256];
  va_list arguments;
  va_start(arguments, format);
  std::vsnprintf(line, sizeof line, format, arguments);
  va_end(arguments);
  return line;
}

// Size and deviation of a correction, in the units of the findings.
struct Size {
  double value = 0.0, deviation = 0.0;
};
Size size_of(const capture::Correction* correction, double unit) {
  if (!correction) return {};
  const double length = correction->value.size() == 1 ? correction->value[0] : correction->value.norm();
  double deviation = correction->deviation.maxCoeff();
  if (correction->value.size() > 1 && length > 0.0)  // along its own direction
    deviation = correction->deviation.cwiseProduct(correction->value / length).norm();
  return {unit * length, unit * deviation};
}

bool worth_saying(const Size& size, double least) {
  return std::abs(size.value) >= least && std::abs(size.value) > kSure * size.deviation;
}

void judge_clocks(const capture::Corrections& found, const capture::Capture& given, std::vector<Finding>& verdict) {
  const auto say = [&](const std::string& code, const std::string& subject, const std::string& words) {
    const Size late = size_of(capture::find(found, subject, "time"), kSeconds);
    if (!worth_saying(late, kClock)) return;
    verdict.push_back({code, subject, late.value, late.deviation, "ms", true, true, -1,
                       words + text(" %.1f +- %.1f ms %s: corrected", std::abs(late.value), late.deviation,
                                    late.value > 0.0 ? "late" : "early")});
  };
  say("base-time", "base", "the base's clock is");
  for (const capture::Camera& camera : given.cameras) say("camera-time", camera.name, camera.name + "'s clock is");
}

void judge_cameras(const capture::Corrections& found, const capture::Capture& given, std::vector<Finding>& verdict) {
  for (const capture::Camera& camera : given.cameras) {
    const Size turn = size_of(capture::find(found, camera.name, "rotation"), kDegrees);
    const Size shift = size_of(capture::find(found, camera.name, "translation"), kMeters);
    if (worth_saying(turn, kTurn))
      verdict.push_back({"camera-pose", camera.name, turn.value, turn.deviation, "deg", true, true, -1,
                         camera.name + text(" is turned by %.2f +- %.2f degrees: corrected; recalibrate it", turn.value,
                                            turn.deviation)});
    else if (worth_saying(shift, kShift))
      verdict.push_back({"camera-pose", camera.name, shift.value, shift.deviation, "mm", true, true, -1,
                         camera.name + text(" is %.1f +- %.1f mm from where it was given: corrected; recalibrate it",
                                            shift.value, shift.deviation)});
    const Size focal = size_of(capture::find(found, camera.name, "focal"), 100.0 / camera.fx);
    if (worth_saying(focal, kFocal))
      verdict.push_back(
          {"focal", camera.name, focal.value, focal.deviation, "%", true, true, -1,
           camera.name + text("'s focal length is %.2f +- %.2f %% %s than given: corrected", std::abs(focal.value),
                              focal.deviation, focal.value > 0.0 ? "longer" : "shorter")});
    const Size fringe = size_of(capture::find(found, camera.name, "mask_offset"), 1.0);
    if (worth_saying(fringe, kFringe))
      verdict.push_back(
          {"mask-offset", camera.name, fringe.value, fringe.deviation, "px", false, true, -1,
           camera.name + text("'s masks are %.1f +- %.1f px %s than the rope on each side", std::abs(fringe.value),
                              fringe.deviation, fringe.value > 0.0 ? "wider" : "narrower")});
  }
}

void judge_rope(const capture::Corrections& found, const capture::Capture& given, std::vector<Finding>& verdict) {
  const Size grasp = size_of(capture::find(found, "grasp", "translation"), kMeters);
  if (worth_saying(grasp, kGrasp))
    verdict.push_back(
        {"grasp", "grasp", grasp.value, grasp.deviation, "mm", true, true, -1,
         text("the rope is held %.1f +- %.1f mm from where it was given: corrected", grasp.value, grasp.deviation)});
  const Size length = size_of(capture::find(found, "object", "length"), 100.0 / given.length);
  if (worth_saying(length, kLength)) {
    const bool possible = std::abs(length.value) < 100.0 * kFartherThanAny;
    verdict.push_back({"length", "object", length.value, length.deviation, "%", true, possible, -1,
                       text("the rope is %.1f +- %.1f %% %s than %.3f m: corrected%s", std::abs(length.value),
                            length.deviation, length.value > 0.0 ? "longer" : "shorter", given.length,
                            possible ? "" : "; so much is no slip of a ruler: measure it, do not trust this twin")});
  }
  const Size diameter = size_of(capture::find(found, "object", "diameter"), 100.0 / given.diameter);
  if (worth_saying(diameter, kDiameter))
    verdict.push_back(
        {"diameter", "object", diameter.value, diameter.deviation, "%", true, true, -1,
         text("the rope is %.1f +- %.1f %% %s than %.2f mm: corrected", std::abs(diameter.value), diameter.deviation,
              diameter.value > 0.0 ? "thicker" : "thinner", kMeters * given.diameter)});
}

void judge_outlines(const silhouette::CorrectionFit& fit, const capture::Capture& given,
                    std::vector<Finding>& verdict) {
  for (std::size_t c = 0; c < fit.misfits.size(); ++c) {
    const silhouette::OutlineMisfit& misfit = fit.misfits[c];
    const std::string& name = given.cameras[c].name;
    if (misfit.rms > kMisfit)
      verdict.push_back(
          {"outline-misfit", name, misfit.rms, 0.0, "px", false, false, misfit.worst_frame,
           name + text("'s outlines still miss the rope by %.1f px (worst in frame %d): do not trust this "
                       "twin",
                       misfit.rms, misfit.worst_frame)});
    else if (misfit.cut > kForeign)
      verdict.push_back({"outline-misfit", name, 100.0 * misfit.cut, 0.0, "%", false, true, misfit.worst_frame,
                         name + text(": %.0f %% of the masks' outline is not the rope's", 100.0 * misfit.cut)});
  }
}

// Bends of a whole stretch of rope that no rope makes: the chain is longer than what is seen, and lies double.
void judge_folds(const silhouette::CorrectionFit& fit, std::vector<Finding>& verdict) {
  const chain::Chain& chain = fit.chain;
  double worst = 0.0;
  int joint = 0, frame = -1;
  for (std::size_t f = 0; f < fit.theta.size(); ++f) {
    for (int k = 0; k < chain.angles(); ++k) {
      if (chain::is_twist(chain, k) || chain.child_link[k] == 1) continue;  // the first turns in the gripper
      double bend = fit.theta[f][k];  // over a joint of the user's: this one and the next about the same axis
      for (int l = k + 1; l < chain.angles(); ++l) {
        if (chain.child_link[l] != chain.child_link[k] + 1) continue;
        if (std::abs(chain.axes[l].head<3>().dot(chain.axes[k].head<3>())) < 0.5) continue;
        bend += fit.theta[f][l];
      }
      if (std::abs(bend) <= worst) continue;
      worst = std::abs(bend);
      joint = chain.child_link[k];
      frame = static_cast<int>(f);
    }
  }
  if (worst < kFold) return;
  const double from_grasp = chain.link_start(joint);
  verdict.push_back(
      {"fold", "object", worst, 0.0, "rad", false, false, -1,
       text("the rope folds back by %.1f rad at %.0f mm from the grasp (%.2f s): its length is wrong, do not "
            "trust this twin",
            worst, kMeters * from_grasp, fit.time[frame])});
}

}  // namespace

capture::Corrections correct(capture::Capture& capture, const std::vector<std::string>& fixed,
                             std::vector<Finding>& verdict) {
  verdict.clear();
  const chain::Bending kind = capture.tabletop ? chain::Bending::planar : chain::Bending::spatial;
  const chain::Chain chain = chain::make_chain(capture.length, capture.diameter, capture.direction,
                                               capture.bending_axis, kJoints, kind, false);
  const silhouette::SequenceFit sequence = silhouette::fit_sequence(chain, capture);
  silhouette::CorrectionOptions options;
  options.held = fixed;
  const silhouette::CorrectionFit fit = silhouette::fit_corrections(chain, capture, sequence, options);
  tell_fit("correct", fit.summary);
  capture::Corrections found = fit.corrections;
  // where nothing is surely wrong, what was given is better known than what was found
  if (fit.evidence < kNothingWrong)
    for (capture::Correction& correction : found) correction.value.setZero();
  judge_clocks(found, capture, verdict);
  judge_cameras(found, capture, verdict);
  judge_rope(found, capture, verdict);
  judge_outlines(fit, capture, verdict);
  judge_folds(fit, verdict);
  capture::apply(found, capture);
  return found;
}

Examination examine(const Path& path, const core::Listener& listener) {
  const core::ListenerScope scope(listener);
  capture::Capture capture = capture::load(path);
  Examination out;
  out.corrections = correct(capture, {}, out.verdict);
  return out;
}

}  // namespace chainsplat::pipeline
