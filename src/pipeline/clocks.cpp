#include "pipeline/clocks.h"

#include <algorithm>
#include <cmath>

#include "chainsplat/identification.h"
#include "chainsplat/run_folder.h"
#include "chainsplat/shutter.h"
#include "pipeline/decide.h"

namespace chainsplat::pipeline {

using math::MatrixX;
using math::VectorX;

namespace {

// Of what identification leaves, in units of what is expected: right recordings leave 0.2, a readout of 15 ms 2.2,
// and 1.1 where most of it was taken for the base's clock.
constexpr double kExplained = 0.4;
// What a readout, or a clock, must explain of that, since no model is right.
constexpr double kLeastExplained = 0.3;
constexpr double kLeastClock = 0.0015;   // s, one that is less is nothing
constexpr double kLeastChange = 0.0005;  // s, of one that is known by then
constexpr double kTriedClock = 0.004;    // s, by which the slope is found: the motion it adds is a few millimeters
// What is left of them has so many independent parts at least, of its hundreds of frames and joints: what any of them
// can pretend is that much less than all together.
constexpr double kIndependent = 10.0;
constexpr int kFewJoints = 8;              // identified in half a second; more explain no more of a readout
constexpr std::size_t kLeastMoments = 30;  // of fewer, parameters explain any motion

}  // namespace

void read_at_once(capture::Capture& capture) {
  constexpr int kRounds = 2;  // the first motion is off by what rows read late add to it, a few millimeters
  if (!silhouette::has_rolling_shutter(capture.cameras)) return;
  const std::vector<capture::PackedView> views = capture.views;
  for (int round = 0; round < kRounds; ++round) {
    const FirstFit fit = first_fit(capture);
    capture.views = views;
    silhouette::read_at_once(capture, fit.chain, fit.sequence.states);
  }
}

namespace {

capture::Correction clock_of(const std::string& subject, const capture::CorrectedQuantity& quantity, double value) {
  capture::Correction out;
  out.quantity = &quantity;
  out.subject = subject;
  out.value = VectorX::Constant(1, value);
  return out;
}

capture::Capture with_base_late(capture::Capture capture, double late) {
  capture::apply({clock_of("base", capture::corrected_quantity("base", "time"), late)}, capture);
  return capture;
}

}  // namespace

capture::Capture with_clocks(const capture::Capture& capture, const Clocks& clocks) {
  capture::Corrections corrections;
  for (const capture::Camera& camera : capture.cameras)
    corrections.push_back(clock_of(camera.name, capture::corrected_quantity("camera", "readout"), clocks.readout));
  capture::Capture out = clocks.late == 0.0 ? capture : with_base_late(capture, clocks.late);
  capture::apply(corrections, out);
  read_at_once(out);
  return out;
}

double longest_readout(const capture::Capture& capture) {
  constexpr double kMargin = 1.2;  // for the error of a readout that is found
  double out = capture::kLongestReadout;
  for (const std::vector<double>& times : capture.times) {
    std::vector<double> apart;  // stamps jitter, and a frame may be lost
    for (std::size_t k = 1; k < times.size(); ++k) apart.push_back(times[k] - times[k - 1]);
    if (!apart.empty()) out = std::min(out, kMargin * math::median(apart));
  }
  return out;
}

bool clocks_are_open(const capture::Capture& capture, const std::vector<std::string>& fixed) {
  if (is_fixed(fixed, "time") || capture.base.samples().size() < 2) return false;
  for (std::size_t c = 0; c < capture.cameras.size(); ++c)
    if (capture::prior_deviation(capture, static_cast<int>(c), capture::corrected_quantity("camera", "readout")) == 0.0)
      return false;
  return true;
}

namespace {

struct Unexplained {
  VectorX apart;        // m, of nodes, between the motion that outlines show and the one that a rope makes
  double misfit = 0.0;  // identification::Estimates::misfit
};

// What a rope of the best parameters leaves. `states`: of `chain`; `uniform`: with the same stiffness all along, which
// is quick.
Unexplained left_by_motion(const chain::Chain& chain, const capture::Capture& capture, const chain::States& states,
                           bool uniform = true) {
  identification::Options options = identification_options(twin_in_scene(capture), false, 0);
  if (uniform) options.per_joint = options.ask_for_more = false;
  const identification::Result found = identification::identify(chain, capture.base, states, options);
  const auto nodes = [&](const VectorX& theta) { return chain::nodes(chain, chain::link_motions(chain, theta, {})); };
  std::vector<double> out;
  for (std::size_t k = 0; k < states.theta.size(); ++k) {
    const MatrixX apart = nodes(states.theta[k]) - nodes(found.rollout.theta[k]);
    out.insert(out.end(), apart.reshaped().begin(), apart.reshaped().end());
  }
  return {Eigen::Map<VectorX>(out.data(), static_cast<Eigen::Index>(out.size())), found.estimates.misfit};
}

chain::States states_of(const FirstFit& fit) {
  chain::States out = fit.sequence.states;
  for (const silhouette::FrameFit& frame : fit.sequence.frames) out.covariance.push_back(frame.covariance);
  return out;
}

// px^2, mean square distance of the outlines over the frames.
double outlines_miss(const silhouette::SequenceFit& sequence) {
  double sum = 0.0, count = 0.0;
  for (const silhouette::FrameFit& frame : sequence.frames)
    if (frame.residual_pixels > 0.0) sum += frame.residual_pixels * frame.residual_pixels, count += 1.0;
  return sum / std::max(1.0, count);
}

// All fitted again by other clocks.
struct Refit {
  VectorX left;                 // what these leave
  bool told_otherwise = false;  // a payload, friction in bending or stiffness that varies explain as much without them
};

// None where the base's clock is changed alone and outlines, which begin at the grasp, do not agree: bases 2.5 to 5 ms
// late made them miss by 2 to 5 % more. What is left must be less than `most` of what other explanations leave.
std::optional<Refit> refit(const capture::Capture& capture, const FirstFit& fit, const chain::States& seen,
                           const Clocks& clocks, double most) {
  constexpr bool kUniform = false;
  const capture::Capture mended = with_clocks(capture, clocks);
  const FirstFit again = first_fit(mended, kFewJoints);
  if (clocks.readout == 0.0 && outlines_miss(again.sequence) >= outlines_miss(fit.sequence)) return std::nullopt;
  const chain::States states = states_of(again);
  Refit out{left_by_motion(again.chain, mended, states).apart, false};
  const double otherwise = left_by_motion(fit.chain, capture, seen, kUniform).apart.squaredNorm();
  out.told_otherwise = !(out.left.squaredNorm() < most * otherwise ||
                         left_by_motion(again.chain, mended, states, kUniform).apart.squaredNorm() < most * otherwise);
  return out;
}

enum class Wrong { rows, base, both };

// The Gauss-Newton step of the readout and, where it varies, the base's clock.
struct Step {
  MatrixX information;  // by s^2
  VectorX pull;         // by s
  double square;        // of what is left without a step

  // Of the information about those that are wrong; 0 elsewhere.
  MatrixX inverse(Wrong wrong) const {
    if (wrong == Wrong::both) return information.inverse();
    const Eigen::Index i = wrong == Wrong::rows ? 0 : 1;
    MatrixX out = MatrixX::Zero(information.rows(), information.cols());
    out(i, i) = 1.0 / information(i, i);
    return out;
  }
  double left(Wrong wrong) const { return square - pull.dot(inverse(wrong) * pull); }
};

// One of the two alone, or both where that leaves less than `most` of what the better one leaves. A base's clock that
// was found as if there were no readout is as late as the grasp's rows: then it is no readout alone.
Wrong likeliest(const Step& step, bool clock_was_late, double most) {
  const Wrong one = clock_was_late || step.left(Wrong::base) < step.left(Wrong::rows) ? Wrong::base : Wrong::rows;
  return step.left(Wrong::both) < most * step.left(one) ? Wrong::both : one;
}

// Nothing is changed, but it may be so.
Clocks perhaps(const Clocks& found) {
  constexpr double kAsLikelyAsNot = 0.5;
  const math::Vector2 apart(found.late, found.readout);
  Clocks out;
  out.doubt = kAsLikelyAsNot * apart * apart.transpose();
  return out;
}

}  // namespace

std::optional<Clocks> more_by_motion(const capture::Capture& capture, bool clock_was_late) try {
  const FirstFit fit = first_fit(capture, kFewJoints);
  if (fit.sequence.states.time.size() < kLeastMoments) return std::nullopt;
  const chain::States seen = states_of(fit);
  const Unexplained given = left_by_motion(fit.chain, capture, seen);
  const bool known = silhouette::has_rolling_shutter(capture.cameras);  // then every gain is one
  if (given.misfit < kExplained) return std::nullopt;
  const std::vector<VectorX> slopes = silhouette::readout_slopes(fit.chain, capture, fit.sequence);
  const auto left = [&](const Clocks& clocks) {
    const bool moved = clocks.late != 0.0;
    const capture::Capture mended = moved ? with_base_late(capture, clocks.late) : capture::Capture();
    chain::States states = moved ? states_of(first_fit(mended, kFewJoints)) : seen;
    for (std::size_t k = 0; k < states.theta.size(); ++k) states.theta[k] += clocks.readout * slopes[k];
    return left_by_motion(fit.chain, moved ? mended : capture, states).apart;
  };
  const VectorX& before = given.apart;
  MatrixX slope(before.size(), 1);
  slope.col(0) = (left({kTriedClock}) - before) / kTriedClock;
  bool clock_varies = clock_was_late || !known;
  if (clock_varies) {
    const VectorX by_clock = (left({0.0, 0.0, kTriedClock}) - before) / kTriedClock;
    clock_varies = !by_clock.isZero(0.0);  // of a base at rest no clock is late
    if (clock_varies) slope.conservativeResize(Eigen::NoChange, 2), slope.col(1) = by_clock;
  }
  const Step step{slope.transpose() * slope, -slope.transpose() * before, before.squaredNorm()};
  const double most = known ? 1.0 : 1.0 - kLeastExplained;
  const Wrong wrong = !clock_varies ? Wrong::rows : known ? Wrong::both : likeliest(step, clock_was_late, most);
  const MatrixX inverse = step.inverse(wrong);
  Clocks found;
  found.readout = inverse.row(0) * step.pull;
  if (clock_varies) found.late = inverse.row(1) * step.pull;
  if (wrong == Wrong::base && clock_was_late) return std::nullopt;  // as late as outlines tell
  const double size = std::abs(wrong == Wrong::base ? found.late : found.readout);
  if (!(size >= (known ? kLeastChange : kLeastClock) && std::abs(found.readout) <= longest_readout(capture)))
    return std::nullopt;
  VectorX now = left(found);
  if (!(now.squaredNorm() < most * step.square)) return std::nullopt;
  if (!known) {  // by now the rows were read, or the base is, a few milliseconds later
    std::optional<Refit> by_clocks = refit(capture, fit, seen, found, most);
    if (!by_clocks) return std::nullopt;
    if (by_clocks->told_otherwise) return perhaps(found);
    now = std::move(by_clocks->left);
  }
  const double unit = now.squaredNorm() / kIndependent;
  found.readout_deviation = std::sqrt(unit * inverse(0, 0));
  if (clock_varies) found.late_deviation = std::sqrt(unit * inverse(1, 1));
  if (clock_was_late) found.late = found.late_deviation = 0.0;  // outlines tell it once the rows are mended
  return found;
} catch (const WorkError&) {
  return std::nullopt;  // no parameters move the rope at all: identification, which follows, says so
}

namespace {

// One way in which the base's clock and the rows of all cameras may be wrong.
struct Way {
  math::Vector2 late = math::Vector2::Zero();  // s, the base's clock and the readout
  double deviation = 0.0;                      // s, of the readout
  double surprise = 0.0;                       // -ln of how likely it is, but for a constant
};

}  // namespace

Clocks more_by_outlines(const capture::Capture& given, const std::vector<std::string>& fixed,
                        capture::Corrections found) {
  constexpr double kUnlikely = 0.02;  // share of one of them, below which it is left out
  for (capture::Correction& correction : found)
    if (correction.subject == "base") correction.value.setZero();
  capture::Capture by_given_clocks = given;
  capture::apply(found, by_given_clocks);
  const FirstFit fit = first_fit(by_given_clocks);
  silhouette::CorrectionOptions options;
  options.held = fixed;
  options.lying = silhouette::lying_on_table(by_given_clocks);
  options.prior_weight = silhouette::kAsRecognized;
  options.readout = true;
  const std::string& camera = given.cameras[0].name;
  const bool known = silhouette::has_rolling_shutter(given.cameras);
  const double longest = longest_readout(given);
  std::vector<Way> ways;
  for (const char* const only : {"base.time", "readout", "base.time and readout"}) {
    options.only = only;
    const silhouette::CorrectionFit of = silhouette::fit_corrections(fit.chain, by_given_clocks, fit.sequence, options);
    const capture::Correction& readout = *capture::find(of.corrections, camera, "readout");
    const double least = known ? readout.deviation[0] : kLeastClock;
    const double value = std::abs(readout.value[0]) < least ? 0.0 : readout.value[0];
    if (std::abs(value) > longest) continue;
    ways.push_back({{capture::value_of(of.corrections, "base", "time"), value},
                    readout.deviation[0],
                    of.unexplained + of.surprise});
  }
  const Way best =
      *std::min_element(ways.begin(), ways.end(), [](const Way& a, const Way& b) { return a.surprise < b.surprise; });
  double all = 0.0;
  for (const Way& way : ways) all += std::exp(best.surprise - way.surprise);
  Clocks out{best.late[1], best.deviation};
  for (const Way& way : ways) {
    const double share = std::exp(best.surprise - way.surprise) / all;
    const math::Vector2 apart = way.late - best.late;
    if (share >= kUnlikely) out.doubt += share * apart * apart.transpose();
  }
  return out;
}

}  // namespace chainsplat::pipeline
