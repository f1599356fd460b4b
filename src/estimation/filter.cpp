// filter.cpp - what the filter does with a frame: predict, measure, judge, learn, report.
#include <algorithm>
#include <cmath>
#include <future>
#include <tuple>
#include <utility>

#include "src/estimation/color.h"
#include "src/estimation/measure.h"
#include "src/estimation/predict.h"
#include "src/estimation/setup.h"
#include "src/estimation/state.h"
#include "src/estimation/tube.h"
#include "src/estimation/unknown_force.h"

namespace chainsplat::estimation {

using math::MatrixX;
using math::Pose;
using math::VectorX;

namespace {

// A frame whose innovation exceeds kSurprise times the model's expectation is processed again with the force free to
// change, and so are the following frames, for a while and as long as the estimated force is a share of the rope's
// weight. Where this does not explain the frame either, the rope was struck: a swinging rope that meets a finger loses
// its velocity in one frame, by a force of many times its weight. Such forces act along the rope's path, so that the
// motion that one camera sees determines the motion along its rays, which it does not see.
constexpr double kSurprise = 1.5;

// Share of the last frames, fading over a time, s, and five frames at least, that nothing explains, from which on it is
// not the rope that moves so: what is seen is laid double, or is something else. A pushed rope explains itself after
// two frames, at most six at 30 Hz.
constexpr double kMostSurprising = 0.6, kSurpriseTime = 0.25, kSurpriseFrames = 5.0;

constexpr double kLongUnseen = 0.5;  // s without a mask, after which the rope counts as lost
// Standard deviations that are added for the search of a lost rope.
constexpr double kLostAngle = 0.5;  // rad
constexpr double kLostRate = 5.0;   // rad/s

// The least standard deviation of the masks' edge offset, and the number of frames over which it is learned.
constexpr double kLeastOffsetDeviation = 0.05;  // px
constexpr double kOffsetFrames = 30.0;

constexpr double kUnlike = 0.5;  // likeness of drawn and recorded colors, below which the object is not the rope
// Share of the rope that the masks must show of what they should show: less, and they end too early. The rope would be
// laid double into them, or be turned toward the camera.
constexpr double kShown = 0.7;
constexpr double kLongHidden = 2.0;  // s after which a rope that was never seen whole is followed as it is seen
constexpr int kFirstRounds = 3;      // of masks and setup in turn, in the first frame
// Share of the masks that the rope covers, below which something else is in them, and the rope is sought elsewhere,
// too; there it must cover so much more.
constexpr double kUnexplained = 0.8, kBetter = 0.1;
constexpr int kFirstFrames = 8;        // frames that teach the setup even if their colors are unlike the twin's
constexpr double kDoubtAngle = 0.2;    // rad, added to the deviations of a doubtful rope's angles
constexpr double kDoubtMemory = 0.15;  // s without a reason to doubt, after which a rope is not doubtful any more
constexpr double kLongUnlike = 0.2;    // s of such frames, after which the rope counts as lost

// The share of the masks that is not the rope's: what lies apart from a rope that is seen nearly whole.
double foreign_share(const silhouette::FrameFit& fit) { return fit.inside >= kUnexplained ? fit.foreign : 0.0; }

bool explains(const silhouette::FrameFit& fit) {
  return fit.covered >= kLostShare * (1.0 - foreign_share(fit)) && fit.theta.allFinite();
}

// Whether there is something in the masks that cannot be told from the rope.
bool has_more(const silhouette::FrameFit& fit) { return fit.covered < kUnexplained * (1.0 - foreign_share(fit)); }

// Returns the standard deviation of the centerline in m, RMS over the rope: by the angles' `covariance` and by the
// shape variances, which include directions in which no angle moves a link.
double centerline_deviation(const chain::Chain& chain, const VectorX& theta, const MatrixX& covariance,
                            const std::vector<double>& shape) {
  const std::vector<MatrixX> jacobians = chain::link_end_jacobians(chain, theta, Pose{});
  // a link's end stands for half of each adjacent link
  double variance = 0.0;
  for (std::size_t i = 0; i < jacobians.size(); ++i) {
    const int link = static_cast<int>(i) + 1;
    const double next = link + 1 < chain.links() ? chain.link_end(link + 1) - chain.link_start(link + 1) : 0.0;
    const double share = 0.5 * (chain.link_end(link) - chain.link_start(link) + next) / chain.length;
    variance += share * ((jacobians[i] * covariance * jacobians[i].transpose()).trace() + 3.0 * shape[i]);
  }
  return std::sqrt(variance);
}

struct Attempt {
  Belief predicted;
  Measured measured;
};

// Predicts and measures; where the model does not explain the frame, again with a force that may change, and then with
// a blow; where the masks are not explained, or not all of them, from a wide belief.
Attempt measure_frame(State& state, Belief predicted, const Motion& motion,
                      std::span<const capture::View* const> views) {
  const double time = views.front()->time;
  const bool first = !state.belief, in_contact = time <= state.contact_until;
  const auto surprising = [](const Measured& m) { return m.surprise > kSurprise || !explains(m.fit); };
  Attempt out{std::move(predicted), {}};
  out.measured = measure(state, out.predicted, views, !first);
  if (!first && surprising(out.measured)) {
    state.contact_until = time + kContactMemory;
    const auto try_with = [&](Contact contact) {
      out.predicted = predict(state, *state.belief, motion, contact);
      out.measured = measure(state, out.predicted, views, true);
    };
    if (!in_contact) try_with(Contact::touched);
    if (state.given.shifts && surprising(out.measured)) try_with(Contact::struck);
  }
  if (!explains(out.measured.fit) || has_more(out.measured.fit)) {
    const int n = state.given.model.chain.angles();
    Belief wide = first_belief(state, time);
    wide.covariance.diagonal().head(n).array() += kLostAngle * kLostAngle;
    wide.covariance.diagonal().segment(n, n).array() += kLostRate * kLostRate;
    Measured again = measure(state, wide, views, false);
    if (explains(again.fit) && again.fit.covered > out.measured.fit.covered + kBetter) out.measured = std::move(again);
  }
  return out;
}

// The first frame: masks of cameras that are off bend the rope toward them, so that it is measured several times, each
// time with the setup that the time before has found. All this counts once, when the frame is learned from.
Attempt measure_first(State& state, const Belief& predicted, std::span<const capture::View* const> views) {
  Attempt out = measure_frame(state, predicted, {}, views);
  for (int round = 0; round < kFirstRounds && explains(out.measured.fit); ++round) {
    const Setup before = state.setup;
    const std::optional<silhouette::SetupEquations> looked =
        look_at_setup(state, views, out.predicted, out.measured.fit.theta);
    if (looked) learn_setup(state, *looked, out.predicted);
    state.setup.information = before.information;
    state.setup.right = before.right;
    state.setup.frames = before.frames;
    out = measure_frame(state, predicted, {}, views);
  }
  return out;
}

// The first frame as that of a rope that nobody touches: it hangs as the twin knows, and what is off is the camera.
// None where this does not explain the frame, or no camera may be off; the setup is then as it was. On a table friction
// holds a rope wherever it was laid.
std::optional<Attempt> measure_resting(State& state, double time, std::span<const capture::View* const> views) {
  const Given& given = state.given;
  const bool may_be_off = std::find(state.setup.posed.begin(), state.setup.posed.end(), 1) != state.setup.posed.end();
  if (!may_be_off || !given.identified || given.table_normal) return {};
  const auto before = std::pair(state.setup, state.cameras);
  Attempt out = measure_first(state, resting_belief(state, time), views);
  const silhouette::FrameFit& fit = out.measured.fit;
  if (out.measured.surprise <= kSurprise && explains(fit) && !has_more(fit)) return out;
  std::tie(state.setup, state.cameras) = before;
  return {};
}

// Whether the frame is believed: its masks are explained, and by a rope that is seen as a whole.
bool judge(State& state, std::span<const capture::View* const> views, const Attempt& attempt, Estimate& out) {
  const silhouette::FrameFit& fit = attempt.measured.fit;
  out.lost = !explains(fit);
  out.residual = fit.residual_pixels;
  out.surprise = attempt.measured.surprise;
  const bool folded =
      shown_share(state, views, fit.theta, fit.edge_offset) * fit.covered < kShown * std::max(fit.inside, kLostShare);
  // a first mask that shows less rope than there is must not be believed: any shape that fits it is wrong
  const int n = state.given.model.chain.angles();
  if (!state.whole && !out.lost && !folded)
    state.whole = shown_share(state, views, attempt.predicted.mean.head(n), state.edge_offset) > kShown;
  if (!state.whole && state.hidden_since == kNever) state.hidden_since = out.time;
  const bool hidden = !state.whole && out.time - state.hidden_since < kLongHidden;
  const double fresh = std::min(1.0 / kSurpriseFrames, (out.time - state.setup.last) / kSurpriseTime);
  state.surprising += fresh * ((out.surprise > kSurprise && !out.lost ? 1.0 : 0.0) - state.surprising);
  if (!state.whole || folded || has_more(fit) || state.surprising > kMostSurprising) state.last_misfit = out.time;
  if (state.last_misfit == out.time || state.frames < state.options.doubtful_frames) state.last_doubt = out.time;
  out.doubtful = out.time - state.last_doubt < kDoubtMemory;
  ++state.frames;
  const bool believed = !out.lost && !folded && !hidden;
  if (!out.lost && !believed) state.last_like = state.last_seen = out.time;  // something of the rope is there
  return believed;
}

// Takes state, colors, force, clock and the masks' edge offset from a frame that is explained.
void learn(State& state, std::span<const capture::View* const> views, const Attempt& attempt, bool first,
           Estimate& out) {
  state.last_seen = out.time;
  state.belief = attempt.measured.belief;
  if (state.roller)
    state.roll = state.roller->advance(out.time, base_at(state, out.time).pose,
                                       state.belief->mean.head(state.given.model.chain.angles()));
  // What the outlines say of the setup is computed while the device compares colors. It reads nothing that the colors
  // change, so that the numbers are those of one after the other.
  const VectorX& theta = attempt.measured.fit.theta;
  auto looking = std::async(state.compare_colors ? std::launch::async : std::launch::deferred,
                            [&] { return look_at_setup(state, views, attempt.predicted, theta); });
  ColorEvidence colors;
  if (state.compare_colors) colors = look_at_colors(state, views, *state.belief, out);
  std::optional<silhouette::SetupEquations> looked = looking.get();
  MatrixX& by_setup = state.belief->by_setup;
  const auto n = theta.size();
  if (looked) {
    by_setup += attempt.measured.gain * (looked->angles - attempt.predicted.by_setup.topRows(n));
    add_colors(colors, by_setup, *looked);
  }
  if (first || out.likeness.value_or(1.0) >= kUnlike) state.last_like = out.time;
  learn_force(state, out.time);
  // where the fit may be wrong, a camera that is moved would make it right; at first it is the camera that may be wrong
  const bool fits = out.time - state.last_misfit >= kDoubtMemory;
  if (looked && fits && (!out.doubtful || state.frames <= kFirstFrames)) learn_setup(state, *looked, attempt.predicted);
  const double gain = 1.0 / kOffsetFrames;
  state.edge_offset += gain * (attempt.measured.fit.edge_offset - state.edge_offset);
  state.edge_offset_variance =
      std::max(kLeastOffsetDeviation * kLeastOffsetDeviation, state.edge_offset_variance * (1.0 - gain));
}

// What is believed, with the uncertainty of the model's shape.
void report(const State& state, std::span<const capture::View* const> views, Estimate& out) {
  const int n = state.given.model.chain.angles();
  out.base = base_correction(state.setup.mean);
  out.late_sigma = late_deviation(state.setup);
  out.theta = state.belief->mean.head(n);
  out.theta_by_late = state.belief->by_setup.col(silhouette::SetupEquations::kClock).head(n);
  out.thetadot = state.belief->mean.segment(n, n);
  out.covariance = state.belief->covariance.topLeftCorner(2 * n, 2 * n);
  if (out.doubtful) out.covariance.diagonal().head(n).array() += kDoubtAngle * kDoubtAngle;
  std::vector<double> shape = chain::shape_variances(state.given.model.chain, out.theta);
  const MatrixX by_setup = state.belief->by_setup.topRows(2 * n);
  out.covariance += by_setup * covariance(state.setup) * by_setup.transpose();
  out.centerline_sigma =
      centerline_deviation(state.given.model.chain, out.theta, out.covariance.topLeftCorner(n, n), shape);
  out.covariance.topLeftCorner(n, n) += chain::shape_covariance(state.given.model.chain, shape, out.theta);
  for (const capture::View* const v : views)
    out.iou +=
        tube_iou(state.given.model.chain, base_at(state, out.time).pose, out.theta, *v, state.cameras.at(v->camera)) /
        static_cast<double>(views.size());
}

}  // namespace

Estimate update(State& state, std::span<const capture::View* const> views) {
  CHAINSPLAT_CHECK(!views.empty(), "no view");
  const capture::View& view = *views.front();
  const bool first = !state.belief;
  Motion motion;
  if (!first) motion = is_ahead(state, view.time) ? std::move(*state.ahead) : move(state, *state.belief, view.time);
  motion.time = view.time;
  state.ahead.reset();
  Belief predicted = first ? first_belief(state, view.time)
                           : predict(state, *state.belief, motion,
                                     view.time <= state.contact_until ? Contact::touched : Contact::none);
  if (first) state.last_seen = view.time;

  Estimate out;
  out.frame = view.frame;
  out.time = view.time;
  out.seen = std::any_of(views.begin(), views.end(), [](const capture::View* v) { return has_mask(*v); });
  bool believed = false;
  if (out.seen) {
    const auto given = first ? std::optional(std::pair(state.setup, state.cameras)) : std::nullopt;
    Attempt attempt;
    if (first) {
      std::optional<Attempt> resting = measure_resting(state, view.time, views);
      attempt = resting ? std::move(*resting) : measure_first(state, predicted, views);
    } else {
      attempt = measure_frame(state, predicted, motion, views);
    }
    believed = judge(state, views, attempt, out);
    if (believed) learn(state, views, attempt, first, out);
    if (given && !believed) std::tie(state.setup, state.cameras) = *given;  // nothing is learned of such masks
    predicted = attempt.predicted;
  }
  if (!believed) {
    state.belief = std::move(predicted);
    out.lost = out.lost || view.time - state.last_seen > kLongUnseen;
  } else if (view.time - state.last_like > kLongUnlike) {  // search again where the twin alone would be
    state.belief = first_belief(state, view.time);
    out.lost = true;
  }
  if (out.likeness.value_or(1.0) < kUnlike) state.last_doubt = out.time;
  out.doubtful = !out.lost && out.time - state.last_doubt < kDoubtMemory;
  out.settling = view.time < state.setup.settling_until || may_go_otherwise(state, view.time);
  state.setup.last = view.time;
  if (out.lost) state.whole = false, state.hidden_since = kNever;
  state.lost = out.lost;
  report(state, views, out);
  return out;
}

Filter::Filter(const twin::Twin& twin, const std::vector<capture::Camera>& cameras, dynamics::BaseFunction base,
               double base_start, const Options& options, const std::vector<char>& unverified,
               CompareColors compare_colors)
    : state_(std::make_unique<State>(
          start(twin, cameras, std::move(base), base_start, options, unverified, std::move(compare_colors)))) {}

Filter::~Filter() = default;
Filter::Filter(Filter&&) noexcept = default;
Filter& Filter::operator=(Filter&&) noexcept = default;

Estimate Filter::update(std::span<const capture::View* const> views) { return estimation::update(*state_, views); }
void Filter::set_options(const Options& options) { state_->options = options; }
std::optional<VectorX> Filter::expected(double time) const { return estimation::expected(*state_, time); }
trajectory::BaseMotion Filter::base_at(double time) const { return estimation::base_at(*state_, time); }
std::vector<capture::Finding> Filter::findings() const { return estimation::findings(*state_); }
const dynamics::Model& Filter::model() const { return state_->given.model; }
const std::vector<capture::Camera>& Filter::cameras() const { return state_->cameras; }
const VectorX& Filter::rest() const { return state_->given.rest; }

}  // namespace chainsplat::estimation
