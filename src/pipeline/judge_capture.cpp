#include "pipeline/judge_capture.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdarg>
#include <cstdio>
#include <numbers>

namespace chainsplat::pipeline {

using capture::Finding;

namespace {

constexpr double kDegrees = 180.0 / std::numbers::pi;
// Standard deviations from which a correction is told (something is wrong, and this may be it), and told as certain.
constexpr double kPossible = 1.5;
// What a correction must be, at least, to be worth a line.
constexpr double kClock = 2.0;       // ms
constexpr double kTurn = 0.1;        // degrees
constexpr double kShift = 2.0;       // mm, of a camera
constexpr double kFocal = 0.3;       // %
constexpr double kGrasp = 1.0;       // mm
constexpr double kGraspTurn = 0.4;   // degrees
constexpr double kLength = 0.5;      // %
constexpr double kDiameter = 3.0;    // %
constexpr double kFringe = 0.6;      // px
constexpr double kBrightness = 5.0;  // %
// What no correction explains.
constexpr double kMostMissed = 1.5;  // px RMS of a camera's outlines, of which straight links leave 0.3 to 0.4
constexpr double kForeign = 0.25;    // share of the outline that is not the rope's: blobs, occluders, or a wrong length
constexpr double kFold = 2.4;        // rad over two joints: no rope bends so far at one place
constexpr double kLightest = 15.0, kHeaviest = 20000.0;  // kg/m^3; foam and tungsten
constexpr double kFartherThanAny = 0.15;                 // share of the length by which no ruler is wrong

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
  return std::abs(size.value) >= least && std::abs(size.value) > kPossible * size.deviation;
}
bool certain(const Size& size) { return std::abs(size.value) > kCertain * size.deviation; }
const char* is(const Size& size) { return certain(size) ? "is" : "may be"; }

}  // namespace

std::string text(const char* format, ...) {
  char line[256];
  va_list arguments;
  va_start(arguments, format);
  std::vsnprintf(line, sizeof line, format, arguments);
  va_end(arguments);
  return line;
}

namespace {

void judge_clock(const capture::Corrections& found, const std::string& code, const std::string& subject,
                 const std::string& words, std::vector<Finding>& verdict) {
  const Size late = size_of(capture::find(found, subject, "time"), kSeconds);
  if (!worth_saying(late, kClock)) return;
  verdict.push_back({code, subject, late.value, late.deviation, "ms", true, true, false, -1,
                     words + text(" %s %.1f +- %.1f ms %s: corrected", is(late), std::abs(late.value), late.deviation,
                                  late.value > 0.0 ? "late" : "early")});
}

}  // namespace

void judge_base_clock(const capture::Corrections& found, std::vector<Finding>& verdict) {
  judge_clock(found, "base-time", "base", "the base's clock", verdict);
}

void judge_camera_clocks(const capture::Corrections& found, const capture::Capture& given,
                         std::vector<Finding>& verdict) {
  for (const capture::Camera& camera : given.cameras)
    judge_clock(found, "camera-time", camera.name, camera.name + "'s clock", verdict);
}

void judge_cameras(const capture::Corrections& found, const capture::Capture& given, std::vector<Finding>& verdict) {
  for (const capture::Camera& camera : given.cameras) {
    const Size turn = size_of(capture::find(found, camera.name, "rotation"), kDegrees);
    const Size shift = size_of(capture::find(found, camera.name, "translation"), kMeters);
    const auto moved = [&](const Size& size, const char* unit, const std::string& words) {
      verdict.push_back(
          {"camera-pose", camera.name, size.value, size.deviation, unit, true, true, false, -1,
           camera.name + " " + is(size) + words + ": corrected" + (certain(size) ? "; recalibrate it" : "")});
    };
    if (worth_saying(turn, kTurn))
      moved(turn, "deg", text(" turned by %.2f +- %.2f degrees", turn.value, turn.deviation));
    else if (worth_saying(shift, kShift))
      moved(shift, "mm", text(" %.1f +- %.1f mm from where it was given", shift.value, shift.deviation));
    const Size focal = size_of(capture::find(found, camera.name, "focal"), 100.0 / camera.fx);
    if (worth_saying(focal, kFocal))
      verdict.push_back(
          {"focal", camera.name, focal.value, focal.deviation, "%", true, true, false, -1,
           camera.name + text("'s focal length %s %.2f +- %.2f %% %s than given: corrected", is(focal),
                              std::abs(focal.value), focal.deviation, focal.value > 0.0 ? "longer" : "shorter")});
    const Size fringe = size_of(capture::find(found, camera.name, "mask_offset"), 1.0);
    if (worth_saying(fringe, kFringe))
      verdict.push_back({"mask-offset", camera.name, fringe.value, fringe.deviation, "px", false, true, false, -1,
                         camera.name + text("'s masks %s %.1f +- %.1f px %s than the rope on each side",
                                            certain(fringe) ? "are" : "may be", std::abs(fringe.value),
                                            fringe.deviation, fringe.value > 0.0 ? "wider" : "narrower")});
  }
}

void judge_colors(const silhouette::CameraColors& colors, const capture::Capture& given,
                  std::vector<Finding>& verdict) {
  constexpr double kMiddle = 0.5;
  for (std::size_t c = 0; c < given.cameras.size(); ++c) {
    const auto column = static_cast<Eigen::Index>(c);
    const math::Vector3 brighter =
        100.0 * (colors.gain.col(column).array() - 1.0 + colors.bias.col(column).array() / kMiddle);
    const double mean = brighter.mean(), deviation = 100.0 * colors.gain_deviation.col(column).mean();
    const double cast = brighter.maxCoeff() - brighter.minCoeff();
    if (std::abs(mean) >= kBrightness && std::abs(mean) > kPossible * deviation)
      verdict.push_back(
          {"camera-color", given.cameras[c].name, mean, deviation, "%", true, true, false, -1,
           given.cameras[c].name + text("'s pictures are %.0f +- %.0f %% %s than all cameras' mean: corrected",
                                        std::abs(mean), deviation, mean > 0.0 ? "brighter" : "darker")});
    else if (cast >= kBrightness && cast > kPossible * deviation)
      verdict.push_back(
          {"camera-color", given.cameras[c].name, cast, deviation, "%", true, true, false, -1,
           given.cameras[c].name + text("'s white balance is not the other cameras' (red %+.0f %%, green %+.0f %%, "
                                        "blue %+.0f %% of their mean): corrected",
                                        brighter[0], brighter[1], brighter[2])});
  }
}

void judge_rope(const capture::Corrections& found, const capture::Capture& given, std::vector<Finding>& verdict) {
  const Size grasp = size_of(capture::find(found, "grasp", "translation"), kMeters);
  if (worth_saying(grasp, kGrasp))
    verdict.push_back({"grasp", "grasp", grasp.value, grasp.deviation, "mm", true, true, false, -1,
                       text("the rope %s held %.1f +- %.1f mm from where it was given: corrected", is(grasp),
                            grasp.value, grasp.deviation)});
  const Size turn = size_of(capture::find(found, "grasp", "rotation"), kDegrees);
  if (worth_saying(turn, kGraspTurn))
    verdict.push_back({"grasp", "grasp", turn.value, turn.deviation, "deg", true, true, false, -1,
                       text("the rope %s held turned by %.1f +- %.1f degrees from how it was given: corrected",
                            is(turn), turn.value, turn.deviation)});
  const Size table = size_of(capture::find(found, "table", "height"), kMeters);
  if (worth_saying(table, kGrasp))
    verdict.push_back({"table", "table", table.value, table.deviation, "mm", true, true, false, -1,
                       text("the table %s %.1f +- %.1f mm %s than it was given, or the grasp as much %s: corrected",
                            is(table), std::abs(table.value), table.deviation, table.value > 0.0 ? "higher" : "lower",
                            table.value > 0.0 ? "lower" : "higher")});
  const Size length = size_of(capture::find(found, "object", "length"), 100.0 / given.length);
  if (worth_saying(length, kLength)) {
    const bool possible = std::abs(length.value) < 100.0 * kFartherThanAny;
    verdict.push_back(
        {"length", "object", length.value, length.deviation, "%", true, possible, false, -1,
         text("the rope %s %.1f +- %.1f %% %s than %.3f m: corrected%s", is(length), std::abs(length.value),
              length.deviation, length.value > 0.0 ? "longer" : "shorter", given.length,
              possible ? "" : "; so much is no slip of a ruler: measure it, do not trust this twin")});
  }
  const Size diameter = size_of(capture::find(found, "object", "diameter"), 100.0 / given.diameter);
  if (worth_saying(diameter, kDiameter))
    verdict.push_back(
        {"diameter", "object", diameter.value, diameter.deviation, "%", true, true, false, -1,
         text("the rope %s %.1f +- %.1f %% %s than %.2f mm: corrected", is(diameter), std::abs(diameter.value),
              diameter.deviation, diameter.value > 0.0 ? "thicker" : "thinner", kMeters * given.diameter)});
}

void judge_outlines(const silhouette::CorrectionFit& fit, const capture::Capture& given,
                    std::vector<Finding>& verdict) {
  for (std::size_t c = 0; c < fit.misfits.size(); ++c) {
    const silhouette::OutlineMisfit& misfit = fit.misfits[c];
    const std::string& name = given.cameras[c].name;
    if (misfit.rms > kMostMissed)
      verdict.push_back(
          {"outline-misfit", name, misfit.rms, 0.0, "px", false, false, false, misfit.worst_frame,
           name + text("'s outlines still miss the rope by %.1f px (worst in frame %d): do not trust this "
                       "twin",
                       misfit.rms, misfit.worst_frame)});
    else if (misfit.cut > kForeign)
      verdict.push_back({"outline-misfit", name, 100.0 * misfit.cut, 0.0, "%", false, true, false, misfit.worst_frame,
                         name + text(": %.0f %% of the masks' outline is not the rope's", 100.0 * misfit.cut)});
  }
}

void judge_folds(const silhouette::CorrectionFit& fit, std::vector<Finding>& verdict) {
  const chain::Chain& chain = fit.chain;
  double worst = 0.0;
  int joint = 0, frame = -1;
  for (std::size_t f = 0; f < fit.theta.size(); ++f) {
    for (int k = 0; k < chain.angles(); ++k) {
      if (chain::is_twist(chain, k) || chain.child_link[k] == 1) continue;  // the first turns in the gripper
      double bend = fit.theta[f][k];  // over two: this one and the next about the same axis
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
      {"fold", "object", worst, 0.0, "rad", false, false, false, -1,
       text("the rope folds back by %.1f rad at %.0f mm from the grasp (%.2f s): its length is wrong, do not "
            "trust this twin",
            worst, kMeters * from_grasp, fit.time[frame])});
}

void judge_mass(const capture::Capture& given, std::vector<Finding>& verdict) {
  if (!given.mass) return;
  const double volume = 0.25 * std::numbers::pi * given.diameter * given.diameter * given.length;
  const double density = *given.mass / volume;
  if (density >= kLightest && density <= kHeaviest) return;
  verdict.push_back(
      {"mass", "object", density, 0.0, "kg/m^3", false, false, true, -1,
       text("%.3g kg in a rope of %.3f m and %.1f mm are %.3g kg/m^3, which no rope has: check mass, length "
            "and diameter",
            *given.mass, given.length, kMeters * given.diameter, density)});
}

void judge_repeated(const capture::Capture& given, std::vector<Finding>& verdict) {
  for (std::size_t c = 0; c < given.cameras.size(); ++c) {
    int count = 0, first = -1;
    for (const capture::ViewPlace& view : given.repeated) {
      if (view.camera != static_cast<int>(c)) continue;
      if (count++ == 0) first = view.frame;
    }
    if (count == 0) continue;
    verdict.push_back({"repeated-frames", given.cameras[c].name, static_cast<double>(count), 0.0, "frames", true, true,
                       false, first,
                       given.cameras[c].name + text(" repeats the picture before in %d frame%s (%d first) though the "
                                                    "base moves on: left out",
                                                    count, count > 1 ? "s" : "", first)});
  }
}

void judge_readout(double readout, double deviation, std::vector<Finding>& verdict) {
  const Size size{kSeconds * readout, kSeconds * deviation};
  verdict.push_back(
      {"rolling-shutter", "cameras", size.value, size.deviation, "ms", true, true, false, -1,
       text("the cameras %s their rows one after the other, in %.1f +- %.1f ms: corrected; give it as `readout`",
            certain(size) ? "read" : "may read", size.value, size.deviation)});
}

std::string group_of(const Finding& found) {
  static const std::array<std::pair<const char*, const char*>, 11> groups = {{{"base-time", "time"},
                                                                              {"camera-time", "time"},
                                                                              {"rolling-shutter", "time"},
                                                                              {"lost-frames", "time"},
                                                                              {"camera-pose", "cameras"},
                                                                              {"half-pixel", "cameras"},
                                                                              {"focal", "focal"},
                                                                              {"mask-offset", "masks"},
                                                                              {"length", "length"},
                                                                              {"diameter", "diameter"},
                                                                              {"camera-color", "colors"}}};
  if (found.code == "grasp" || found.code == "table") return found.subject;
  const auto at = std::find_if(groups.begin(), groups.end(), [&](const auto& one) { return found.code == one.first; });
  return at == groups.end() ? "" : at->second;
}

Finding not_corrected(Finding found) {
  const std::string group = group_of(found);
  const bool moves_rope = group != "colors" && group != "masks";
  const bool sure = moves_rope && std::abs(found.value) > kCertain * found.deviation;
  const std::size_t end = found.text.find(": corrected");
  found.text = found.text.substr(0, end) + ": held as given" +
               (sure ? ", which the outlines contradict: do not trust this twin" : "");
  found.corrected = false;
  found.trusted = found.trusted && !sure;
  return found;
}

void judge_height(double above, std::vector<Finding>& verdict) {
  verdict.push_back({"grasp", "table", kMeters * above, 0.0, "mm", false, true, false, -1,
                     text("the grasp is given %.1f mm above (or below) where the rope would lie on the table: either "
                          "the rope is held so, as it is in the twin, or the grasp or the table is given wrong by as "
                          "much, and the twin is wrong by as much relative to the grasp",
                          kMeters * above)});
}

Finding held_high(double above) {
  return {
      "held-high",
      "object",
      kMeters * above,
      0.0,
      "mm",
      false,
      false,
      false,
      -1,
      text("the rope is held %.0f mm above where it lies on the table: how it comes down is known roughly, and nothing "
           "that was given could be checked: do not trust it to a few millimeters",
           kMeters * above)};
}

}  // namespace chainsplat::pipeline
