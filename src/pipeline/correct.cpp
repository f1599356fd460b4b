// correct.cpp - what a capture was given wrongly by a little, found before the long work, and said in plain words.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdarg>
#include <cstdio>
#include <numbers>
#include <optional>

#include "chainsplat/camera_colors.h"
#include "chainsplat/silhouette.h"
#include "pipeline/clocks.h"
#include "pipeline/mistakes.h"
#include "pipeline/stages.h"

namespace chainsplat::pipeline {

namespace {

using capture::Finding;

constexpr int kReadoutRounds = 3;  // of a readout and all else in turn; the first leaves a tenth or two of it
// Share by which the outlines' square residuals must be larger with what was given before anything is changed. Straight
// links alone leave up to 0.1 on right recordings. Correcting all that may be wrong leaves half a millimeter on a table,
// so that more must be wrong there (design.md, 'Corrections').
constexpr double kNothingWrong = 0.15, kNothingWrongOnTable = 1.0;
double nothing_wrong(const capture::Capture& capture) {
  return capture.tabletop ? kNothingWrongOnTable : kNothingWrong;
}
// Below this evidence no cause is looked for. Pixel centers are counted from (0, 0) by most other tools: taking this
// back must leave at most this share of the evidence.
constexpr double kLeastEvidence = kNothingWrong;
constexpr std::array kShifts = {0.5, -0.5};  // px
constexpr double kLeftOfHalfPixel = 0.2;     // share
// Any other thing alone is corrected if it leaves at most kLeftOfOne of the evidence, to which each of its numbers adds
// kPerNumber, since many numbers explain a part of anything; and less than kRight, from which on more would be wrong.
constexpr double kLeftOfOne = 0.25, kPerNumber = 0.03;
constexpr double kRight = kNothingWrong, kRightOnTable = 0.5;
constexpr double kAsWell = 0.05;  // evidence by which explanations of right recordings differ, since links are straight
constexpr double kAboveTable = 0.001;  // m, from which on a rope is said to be held above its table
// Standard deviations from which a correction is told (something is wrong, and this may be it), and told as certain.
constexpr double kPossible = 1.5, kCertain = 3.0;
constexpr double kMeters = 1e3, kSeconds = 1e3, kDegrees = 180.0 / std::numbers::pi;  // to mm, ms, degrees
// What a correction must be, at least, to be worth a line.
constexpr double kClock = 2.0;      // ms
constexpr double kTurn = 0.1;       // degrees
constexpr double kShift = 2.0;      // mm, of a camera
constexpr double kFocal = 0.3;      // %
constexpr double kGrasp = 1.0;      // mm
constexpr double kGraspTurn = 0.4;  // degrees
constexpr double kLength = 0.5;     // %
constexpr double kDiameter = 3.0;   // %
constexpr double kFringe = 0.6;     // px
constexpr double kBrightness = 5.0;  // %
// What no correction explains.
constexpr double kMisfit = 1.5;    // px RMS of a camera's outlines, of which straight links leave 0.3 to 0.4
constexpr double kForeign = 0.25;  // share of the outline that is not the rope's: blobs, occluders, or a wrong length
constexpr double kFold = 2.4;      // rad over two joints: no rope bends so far at one place
constexpr double kLightest = 15.0, kHeaviest = 20000.0;  // kg/m^3; foam and tungsten
constexpr double kFartherThanAny = 0.15;                 // share of the length by which no ruler is wrong

bool is_fixed(const std::vector<std::string>& fixed, const char* group) {
  return std::find(fixed.begin(), fixed.end(), group) != fixed.end();
}

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
  return std::abs(size.value) >= least && std::abs(size.value) > kPossible * size.deviation;
}
bool certain(const Size& size) { return std::abs(size.value) > kCertain * size.deviation; }
const char* is(const Size& size) { return certain(size) ? "is" : "may be"; }

void judge_clocks(const capture::Corrections& found, const capture::Capture& given, std::vector<Finding>& verdict) {
  const auto say = [&](const std::string& code, const std::string& subject, const std::string& words) {
    const Size late = size_of(capture::find(found, subject, "time"), kSeconds);
    if (!worth_saying(late, kClock)) return;
    verdict.push_back({code, subject, late.value, late.deviation, "ms", true, true, false, -1,
                       words + text(" %s %.1f +- %.1f ms %s: corrected", is(late), std::abs(late.value), late.deviation,
                                    late.value > 0.0 ? "late" : "early")});
  };
  say("base-time", "base", "the base's clock");
  for (const capture::Camera& camera : given.cameras) say("camera-time", camera.name, camera.name + "'s clock");
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

// Of the colors in the middle of the range: a bias and a gain seldom come alone.
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
    if (misfit.rms > kMisfit)
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

// Bends of a whole stretch of rope that no rope makes: the chain is longer than what is seen, and lies double.
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

// Of all that ropes, cables and hoses are made of, air in foam and steel included.
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

// Pictures that stand for later ones, which are left out.
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

// Turns of all cameras that shift their images by `shift` px to the right and down, as a larger cx and cy would.
capture::Corrections shifted_images(const capture::Capture& given, double shift) {
  capture::Corrections out;
  for (const capture::Camera& camera : given.cameras) {
    capture::Correction turn;
    turn.quantity = &capture::corrected_quantity("camera", "rotation");
    turn.subject = camera.name;
    turn.value = math::Vector3(shift / camera.fy, -shift / camera.fx, 0.0);
    out.push_back(std::move(turn));
  }
  return out;
}

bool is_half_pixel(const silhouette::CorrectionFit& fit) {
  const auto least = std::min_element(fit.evidence_after.begin(), fit.evidence_after.end());
  return fit.evidence > kLeastEvidence && *least < kLeftOfHalfPixel * fit.evidence;
}

// The one thing that explains what is wrong; null where it takes more. Of those that may be mistaken for each other it
// is the likeliest.
const silhouette::Cause* single_cause(const silhouette::CorrectionFit& fit, bool tabletop) {
  if (fit.evidence < kLeastEvidence) return nullptr;
  const silhouette::Cause* best = nullptr;
  double least = kLeftOfOne * fit.evidence;
  for (const silhouette::Cause& cause : fit.causes) {
    const double left = cause.evidence + kPerNumber * cause.numbers * fit.evidence;
    if (cause.evidence >= (tabletop ? kRightOnTable : kRight) || left >= least) continue;
    best = &cause;
    least = left;
  }
  if (!best) return nullptr;
  const double as_well = best->evidence + kAsWell;
  for (const silhouette::Cause& cause : fit.causes)
    if (cause.in_doubt == best->in_doubt && cause.evidence <= as_well && cause.surprise < best->surprise) best = &cause;
  return best;
}

// Whether a rope that is not known to hang lies on its table, as far as table and grasp tell, with these corrections.
bool lies(capture::Capture capture, const capture::Corrections& corrections) {
  capture::apply(corrections, capture);
  return std::abs(silhouette::height_by_table(capture)) <= kAboveTable;
}

// Corrections of one cause alone, or of it and what it may be mistaken for, whichever is likelier. The deviations say
// how far the two are apart.
silhouette::CorrectionFit fit_alone(const chain::Chain& chain, const capture::Capture& capture,
                                    const silhouette::SequenceFit& sequence, const silhouette::Cause& cause,
                                    silhouette::CorrectionOptions options) {
  options.only = cause.name;
  silhouette::CorrectionFit one = silhouette::fit_corrections(chain, capture, sequence, options);
  if (cause.in_doubt == cause.name) return one;
  options.then = cause.in_doubt;
  silhouette::CorrectionFit other = silhouette::fit_corrections(chain, capture, sequence, options);
  if (other.surprise < one.surprise) std::swap(one, other);
  const double share = 1.0 / (1.0 + std::exp(other.surprise - one.surprise));  // how likely the other is
  math::VectorX apart(one.covariance.rows());
  Eigen::Index at = 0;
  for (std::size_t i = 0; i < one.corrections.size(); ++i) {
    capture::Correction& correction = one.corrections[i];
    if (correction.state == capture::CorrectionState::held) {
      correction.value.setZero();
      correction.state = other.corrections[i].state;
    }
    const math::VectorX difference = other.corrections[i].value - correction.value;
    correction.deviation = (correction.deviation.array().square() + share * difference.array().square()).sqrt();
    apart.segment(at, difference.size()) = difference;
    at += difference.size();
  }
  one.covariance += share * apart * apart.transpose();
  return one;
}

// What is corrected when one thing explains all: `alone` was fitted with that one free, `all` with all. The deviations
// of the others say what the recording tells of them.
void keep_given(silhouette::CorrectionFit& alone, const silhouette::CorrectionFit& all) {
  for (std::size_t i = 0; i < alone.corrections.size(); ++i) {
    capture::Correction& correction = alone.corrections[i];
    if (correction.state != capture::CorrectionState::held) continue;
    correction.value.setZero();
    correction.deviation = all.corrections[i].deviation;
    correction.state = all.corrections[i].state;
  }
}

// Half a pixel is the only correction.
void correct_half_pixel(const silhouette::CorrectionFit& fit, const silhouette::CorrectionOptions& options,
                        Corrected& out) {
  const auto which =
      std::min_element(fit.evidence_after.begin(), fit.evidence_after.end()) - fit.evidence_after.begin();
  for (capture::Correction& correction : out.corrections)
    if (const auto* const turn = capture::find(options.mistakes[which], correction.subject, correction.quantity->name))
      correction.value = turn->value;
  out.verdict.push_back(
      {"half-pixel", "cameras", kShifts[which], 0.0, "px", true, true, false, -1,
       text("the cameras' cx and cy are half a pixel too %s%s: corrected", kShifts[which] > 0.0 ? "small" : "large",
            kShifts[which] > 0.0 ? " (they count pixel centers from 0, 0; here from 0.5, 0.5)" : "")});
}

// Adds how the cameras' colors differ to the corrections and mends it in `capture`, whose cameras are corrected
// already.
void correct_colors(const silhouette::CorrectionFit& fit, const std::vector<std::string>& fixed,
                    capture::Capture& capture, Corrected& out) {
  const bool varied = capture.cameras.size() > 1 && !is_fixed(fixed, "colors");
  silhouette::CameraColors colors;
  if (varied) colors = silhouette::fit_camera_colors(fit.chain, capture, {fit.time, fit.theta, {}, {}});
  bool differ = false;
  for (Eigen::Index c = 0; c < colors.gain.cols(); ++c)
    for (int i = 0; i < 3; ++i) {
      const double gain = std::abs(colors.gain(i, c) - 1.0), bias = std::abs(colors.bias(i, c));
      differ = differ || gain > kCertain * colors.gain_deviation(i, c) || bias > kCertain * colors.bias_deviation(i, c);
    }
  capture::Corrections found;
  for (std::size_t c = 0; c < capture.cameras.size(); ++c)
    for (const char* const name : {"gain", "bias"}) {
      capture::Correction correction;
      correction.quantity = &capture::corrected_quantity("camera", name);
      correction.subject = capture.cameras[c].name;
      correction.value = correction.deviation = math::Vector3::Zero();
      correction.calibration = capture::find(out.corrections, correction.subject, "rotation")->calibration;
      if (varied) {
        const bool gain = name == std::string("gain");
        correction.state = capture::CorrectionState::free;
        correction.deviation = (gain ? colors.gain_deviation : colors.bias_deviation).col(c);
        if (differ) correction.value = gain ? math::Vector3(colors.gain.col(c).array() - 1.0) : colors.bias.col(c);
      }
      found.push_back(std::move(correction));
    }
  capture::apply(found, capture);
  if (differ) judge_colors(colors, capture, out.verdict);
  out.corrections.insert(out.corrections.end(), found.begin(), found.end());
}

// m above where it lies on the table, from which on corrections make up for how a rope is assumed to come down: held 15 mm
// above it, cameras were found to be off by 10 degrees. Faults of base and grasp alone are less.
double high(const capture::Capture& capture) { return std::max(0.25 * capture.diameter, 0.005); }

// A rope that is held a little above its table looks like one whose grasp, or table, is given wrong by as much, where
// one camera alone sees how it comes down or the grasp is to be taken as given.
void judge_height(const capture::Corrections& found, const capture::Capture& capture, std::vector<Finding>& verdict) {
  if (capture::find(found, "grasp", "translation")->state != capture::CorrectionState::held) return;
  const double above = std::abs(silhouette::height_by_table(capture));
  if (above < kAboveTable || above > high(capture)) return;
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

capture::Capture with(const capture::Correction& correction, const capture::Capture& given) {
  capture::Capture out = given;
  capture::apply({correction}, out);
  return out;
}

capture::Correction shift_of(const char* subject, const char* name, const math::VectorX& value) {
  capture::Correction shift;
  shift.quantity = &capture::corrected_quantity(subject, name);
  shift.subject = subject;
  shift.value = value;
  return shift;
}

// How the rope and its table may be, and all corrections where they are so.
struct Hypothesis {
  std::optional<capture::Correction> shift;  // of table or grasp, where one of them was given wrong by much
  silhouette::CorrectionFit fit;
};

Hypothesis supposing(const capture::Capture& given, const chain::Chain& chain, silhouette::CorrectionOptions options,
                     std::optional<capture::Correction> shift) {
  const capture::Capture capture = shift ? with(*shift, given) : given;
  silhouette::CorrectionFit fit =
      silhouette::fit_corrections(chain, capture, silhouette::fit_sequence(chain, capture), options);
  return {std::move(shift), std::move(fit)};
}

// A rope that lies far beside the plane of its grasp, by table and grasp, is held so, or one of the two was given wrong by
// as much. Outlines tell: where the table was, the rope is flat and in that plane; where the grasp was, it is flat beside
// it; else it comes down as a rod of some stiffness does. They are judged by what is left with all corrections, since
// wrong cameras hide the difference. None: it is held so, or may be. `sequence` is fitted to `chain`.
constexpr std::array kReaches = {0.3, 0.5, 0.8, 1.25, 2.0};  // of ropes from 1 % to 16 times as stiff as usual
constexpr double kClearly = 0.6;  // of the cost that is left with the rope held so; found: 0.26 to 0.42, or 0.88 and more
std::optional<Hypothesis> misplaced(const capture::Capture& capture, const chain::Chain& chain,
                                    const silhouette::SequenceFit& sequence,
                                    const silhouette::CorrectionOptions& options) {
  if (capture.cameras.size() < 2) return std::nullopt;  // one sees it as turns of the joints
  const double height = options.lying->height, up = chain.bending_axis.dot(options.lying->normal);
  chain::Chain held = chain;
  silhouette::CorrectionOptions as_held = options;
  as_held.lying.reset();  // its lift stays as it is
  double cost = INFINITY;
  for (const double reach : kReaches) {
    held.lift = silhouette::lying_down(chain, height, reach);
    cost = std::min(cost, supposing(capture, held, as_held, std::nullopt).fit.summary.final_cost);
  }

  chain::Chain flat = chain;
  silhouette::CorrectionOptions as_flat = options;
  std::optional<Hypothesis> best;
  const auto consider = [&](const capture::Correction& shift) {
    flat.lift = silhouette::lying_down(chain, as_flat.lying->height);
    Hypothesis other = supposing(capture, flat, as_flat, shift);
    if (other.fit.summary.final_cost < (best ? best->fit.summary.final_cost : kClearly * cost)) best = std::move(other);
  };
  if (!is_fixed(options.held, "table")) {
    as_flat.lying->height = silhouette::fit_height(chain, capture, sequence, 0.0);
    consider(shift_of("table", "height", math::VectorX::Constant(1, up * (as_flat.lying->height - height))));
  }
  if (!is_fixed(options.held, "grasp")) {
    as_flat.lying->height = 0.0;
    consider(shift_of("grasp", "translation", up * height * options.lying->normal));
  }
  return best;
}

// What is corrected, and by which fit.
struct Decision {
  silhouette::CorrectionFit fit;
  bool corrected = false;                    // by what it found; else nothing is, but for the next two
  bool half_pixel = false;                   // by this alone
  std::optional<capture::Correction> shift;  // beside what it found: of table or grasp
};

// None: the rope is held above its table, or may be.
std::optional<Decision> decide(const capture::Capture& capture, const chain::Chain& chain,
                               const silhouette::SequenceFit& sequence, const silhouette::CorrectionOptions& options) {
  silhouette::CorrectionOptions judging = options;
  judging.prior_weight = silhouette::kAsRecognized;
  Decision out;
  out.fit = silhouette::fit_corrections(chain, capture, sequence, judging);
  out.half_pixel = is_half_pixel(out.fit);
  if (out.half_pixel) return out;

  // one thing alone
  if (const silhouette::Cause* const cause = single_cause(out.fit, capture.tabletop)) {
    silhouette::CorrectionFit alone = fit_alone(chain, capture, sequence, *cause, judging);
    // where a rope is held above its table, how it comes down is assumed, which other faults would make up for
    if (lies(capture, alone.corrections)) {
      core::say_more("correct: " + cause->name + " alone explains what is wrong");
      keep_given(alone, out.fit);
      out.fit = std::move(alone);
      out.corrected = true;
      return out;
    }
  }

  // table or grasp by much, and others
  if (options.lying && std::abs(options.lying->height) > high(capture)) {
    std::optional<Hypothesis> found = misplaced(capture, chain, sequence, options);
    if (!found) return std::nullopt;
    out.fit = std::move(found->fit);
    out.shift = std::move(found->shift);
    out.corrected = out.shift->subject == "grasp" || out.fit.evidence >= nothing_wrong(capture);
    return out;
  }

  // all that may be wrong
  out.corrected = out.fit.evidence >= nothing_wrong(capture);
  if (out.corrected) out.fit = silhouette::fit_corrections(chain, capture, sequence, options);
  return out;
}

}  // namespace

FirstFit first_fit(const capture::Capture& capture, int joints) {
  const auto chain_of = [&](chain::Bending kind) {
    return chain::make_chain(capture.length, capture.diameter, capture.direction, capture.bending_axis, joints, kind,
                             false);
  };
  FirstFit out;
  out.chain = chain_of(capture.tabletop ? chain::Bending::planar : chain::Bending::spatial);
  out.chain.lift = silhouette::lying_down(out.chain, silhouette::height_by_table(capture));
  out.sequence = silhouette::fit_sequence(out.chain, capture);
  // one camera does not see depth, into which a chain that bends in space would fold
  if (!capture.tabletop && capture.cameras.size() == 1 &&
      silhouette::choose_bending(out.chain, capture, out.sequence).bending == chain::Bending::planar) {
    out.chain = chain_of(chain::Bending::planar);
    out.sequence = silhouette::fit_sequence(out.chain, capture);
  }
  return out;
}

namespace {

// What is left to correct of a capture whose rows were read at once.
Corrected correct_all_but_readout(capture::Capture& capture, const std::vector<std::string>& fixed, FirstFit fit_by_now) {
  Corrected out;
  auto& [chain, sequence] = fit_by_now;
  if (std::none_of(sequence.frames.begin(), sequence.frames.end(),
                   [](const auto& f) { return f.residual_pixels > 0.0; })) {
    out.verdict.push_back({"unseen", "base", 0.0, 0.0, "share", false, false, true, -1,
                           "no camera sees the rope where the base's motion and the grasp put it: the base and the "
                           "cameras are not in one world, or not all in meters"});
    return out;
  }
  capture::Corrections lost;
  if (!is_fixed(fixed, "time")) lost = restore_lost_frames(chain, capture, sequence, out.verdict);
  silhouette::CorrectionOptions options;
  options.lying = silhouette::lying_on_table(capture);
  options.held = fixed;
  for (const double pixels : kShifts) options.mistakes.push_back(shifted_images(capture, pixels));
  std::optional<Decision> decision = decide(capture, chain, sequence, options);
  if (!decision) {
    out.verdict.push_back(held_high(std::abs(options.lying->height)));
    out.corrections = std::move(lost);
    return out;
  }
  auto& [fit, corrected, half_pixel, shift] = *decision;
  tell_fit("correct", fit.summary);
  out.corrections = std::move(fit.corrections);
  if (corrected)
    out.covariance = std::move(fit.covariance);
  else
    for (capture::Correction& correction : out.corrections) correction.value.setZero();
  if (half_pixel) correct_half_pixel(fit, options, out);
  if (shift)
    for (capture::Correction& correction : out.corrections)
      if (correction.subject == shift->subject && correction.quantity == shift->quantity) correction.value += shift->value;
  judge_clocks(out.corrections, capture, out.verdict);
  if (!half_pixel) judge_cameras(out.corrections, capture, out.verdict);
  judge_rope(out.corrections, capture, out.verdict);
  judge_outlines(fit, capture, out.verdict);
  judge_folds(fit, out.verdict);
  capture::apply(out.corrections, capture);
  judge_height(out.corrections, capture, out.verdict);
  correct_colors(fit, fixed, capture, out);
  out.corrections.insert(out.corrections.end(), lost.begin(), lost.end());
  return out;
}

bool impossible(const Corrected& found) {
  return std::any_of(found.verdict.begin(), found.verdict.end(), [](const Finding& f) { return f.impossible; });
}

void add(Corrected found, Corrected& out) {
  out.corrections = std::move(found.corrections);
  out.covariance = std::move(found.covariance);
  out.verdict.insert(out.verdict.end(), found.verdict.begin(), found.verdict.end());
}

bool any_but_colors(const capture::Corrections& corrections) {
  return std::any_of(corrections.begin(), corrections.end(), [](const capture::Correction& c) {
    return c.quantity->group != std::string("colors") && !c.value.isZero(0.0);
  });
}

// Adds a readout that was found, or may be there, to what else was.
void add_readout(const Readout& readout, Corrected& out) {
  if (readout.value == 0.0 && readout.doubt.isZero(0.0)) return;
  Eigen::Index numbers = 0;
  std::vector<Eigen::Index> of_base, of_rows;
  for (capture::Correction& correction : out.corrections) {
    // of which the covariance says nothing
    if (correction.quantity->group == std::string("colors") || correction.quantity == &capture::lost_frames()) continue;
    if (correction.quantity == &capture::corrected_quantity("base", "time")) {
      of_base.push_back(numbers);
      correction.deviation.setConstant(std::hypot(correction.deviation[0], std::sqrt(readout.doubt(0, 0))));
    }
    if (correction.quantity == &capture::corrected_quantity("camera", "readout")) {
      of_rows.push_back(numbers);
      correction.value.setConstant(readout.value);
      correction.deviation.setConstant(std::hypot(readout.deviation, std::sqrt(readout.doubt(1, 1))));
      correction.state = capture::CorrectionState::free;
    }
    numbers += correction.value.size();
  }
  if (of_rows.empty()) return;
  if (out.covariance.size() == 0) out.covariance = math::MatrixX::Zero(numbers, numbers);
  const double own = readout.value == 0.0 ? 0.0 : readout.deviation * readout.deviation;
  const auto add = [&](const std::vector<Eigen::Index>& rows, const std::vector<Eigen::Index>& columns, double value) {
    for (const Eigen::Index a : rows)
      for (const Eigen::Index b : columns) out.covariance(a, b) += value;
  };
  add(of_base, of_base, readout.doubt(0, 0));
  add(of_base, of_rows, readout.doubt(0, 1));
  add(of_rows, of_base, readout.doubt(1, 0));
  add(of_rows, of_rows, readout.doubt(1, 1) + own);
  if (readout.value == 0.0) return;
  const Size size{kSeconds * readout.value, kSeconds * std::hypot(readout.deviation, std::sqrt(readout.doubt(1, 1)))};
  out.verdict.push_back(
      {"rolling-shutter", "cameras", size.value, size.deviation, "ms", true, true, false, -1,
       text("the cameras %s their rows one after the other, in %.1f +- %.1f ms: corrected; give it as `readout`",
            certain(size) ? "read" : "may read", size.value, size.deviation)});
}

}  // namespace

Corrected correct(capture::Capture& capture, const std::vector<std::string>& fixed, bool anyway) {
  Corrected out;
  out.verdict = find_mistakes(capture);
  judge_mass(capture, out.verdict);
  if (!out.verdict.empty() && !anyway) return out;
  judge_repeated(capture, out.verdict);
  FirstFit fit = first_fit(capture);
  if (!readout_is_open(capture, fixed)) {
    add(correct_all_but_readout(capture, fixed, fit), out);
    return out;
  }
  const capture::Capture given = capture;
  Readout readout;
  Corrected found;
  const auto correct_the_rest = [&] {
    if (readout.value != 0.0) {
      capture = with_readout(given, readout.value);
      fit = first_fit(capture);
    }
    found = correct_all_but_readout(capture, fixed, fit);
  };
  const auto more_readout = [&]() -> std::optional<Readout> {
    if (impossible(found)) return std::nullopt;
    const bool clock_was_late = capture::value_of(found.corrections, "base", "time") != 0.0;
    if (!capture.tabletop) return more_by_motion(capture, clock_was_late);
    if (readout.value == 0.0 && !any_but_colors(found.corrections)) return std::nullopt;
    return more_by_outlines(readout.value == 0.0 ? given : with_readout(given, readout.value), fixed,
                            found.corrections);
  };
  correct_the_rest();
  for (int round = 0; round < kReadoutRounds; ++round) {
    const std::optional<Readout> more = more_readout();
    if (more) readout.doubt = more->doubt;
    if (!more || more->value == 0.0) break;
    readout.value += more->value;
    readout.deviation = more->deviation;
    correct_the_rest();
  }
  if (readout.value != 0.0)
    core::say_more(text("correct: the rows are read in %.1f ms", kSeconds * readout.value));
  add(std::move(found), out);
  add_readout(readout, out);
  if (readout.value == 0.0) return out;
  capture.views = given.views;
  for (capture::PackedView& view : capture.views) view.time = capture.times[view.camera][view.frame];
  read_at_once(capture);
  return out;
}

Examination examine(const Path& path, const core::Listener& listener) {
  const core::ListenerScope scope(listener);
  capture::Capture capture = capture::load(path);
  read_at_once(capture);
  Corrected found = correct(capture, {}, false);
  return {std::move(found.corrections), std::move(found.verdict)};
}

}  // namespace chainsplat::pipeline
