// forces.cpp - the force that the outside exerts on a rope: along states in memory, and from the files of a run.
#include <algorithm>
#include <cmath>
#include <limits>

#include "chainsplat/estimate_lines.h"
#include "chainsplat/pipeline.h"
#include "chainsplat/rope.h"
#include "chainsplat/run_folder.h"
#include "pipeline/contact_file.h"
#include "pipeline/streams.h"

namespace chainsplat::pipeline {

namespace {

constexpr double kNear = 3.0;       // diameters from the rope within which something may touch it
constexpr double kLiveApart = 0.1;  // s, how far from a state a line of a contact file may be, where states come in
constexpr const char* kFew = "has fewer than three states";
constexpr const char* kMore = "give more: forces need accelerations";

// What touches is nearest to one of the `points` (m, world, columns).
force::ContactAt contact_near(const twin::Twin& twin, const dynamics::BaseFunction& base, const math::MatrixX& points) {
  return [&twin, base, points](double time, const math::VectorX& theta) {
    return force::nearest_contact(twin.chain, twin.gaussians, base(time).pose, theta, points);
  };
}

// One a time of `motion`; empty for an empty `contact`.
std::vector<std::optional<force::Contact>> contacts_along(const force::Motion& motion,
                                                          const force::ContactAt& contact) {
  std::vector<std::optional<force::Contact>> out;
  for (std::size_t f = 0; contact && f < motion.time.size(); ++f)
    out.push_back(contact(motion.time[f], motion.theta[f]));
  return out;
}

// A state, and the covariance of the error that stays for many frames, if that is known.
struct State {
  double time = 0.0;
  math::VectorX theta;
  math::MatrixX standing;                            // n x n, or empty
  std::optional<estimation::BaseCorrection> base{};  // what the line says of the base
  force::Clock clock{};                              // what of its clock is not known
};

// Gives every state to `take`, as soon as its line is there.
void each_state(const ForceOptions& options, const chain::Chain& chain, const std::function<void(const State&)>& take) {
  if (options.estimate.empty()) {
    const chain::States states = twin::read_states(input_path(options.states), chain);
    for (std::size_t f = 0; f < states.time.size(); ++f) take({states.time[f], states.theta[f], {}});
    return;
  }
  each_estimate(options.estimate, chain.angles(), [&](const estimation::EstimateLine& line) {
    State state{line.time, line.theta, {}, line.base, {line.late_sigma, line.theta_by_late}};
    if (line.sigma.size() > 0)  // estimate's solver adam writes none
      state.standing =
          line.covariance.size() > 0 ? line.covariance : force::angle_covariance(chain, line.theta, line.sigma);
    take(state);
  });
}

// One call: what it was given, and what it has come to.
class Work {
 public:
  Work(const Path& run, const ForceOptions& options, const EachForce& each);
  Work(const Work&) = delete;  // its functions look into it
  Work& operator=(const Work&) = delete;
  void live();   // tells while states come in
  void whole();  // tells when all are there
  const ForceResult& result() const { return result_; }

 private:
  force::ContactAt named_contact(double apart) const;
  force::ContactAt contact(double apart);
  void check_near() const;
  void check_finite(const force::Estimate& estimate) const;
  void tell(const force::Estimate& estimate);

  const ForceOptions& options_;
  const EachForce& each_;
  std::string source_;  // of the states, for messages
  twin::Twin twin_;
  dynamics::Model model_;
  StreamBase base_;
  std::vector<dynamics::Model> deviations_;
  double least_ = std::numeric_limits<double>::infinity();  // m, of what is said to touch, from the rope
  ForceResult result_;
};

Work::Work(const Path& run, const ForceOptions& options, const EachForce& each)
    : options_(options),
      each_(each),
      source_((options.estimate.empty() ? options.states : options.estimate).string()),
      twin_(load_twin(run)),
      model_(model_of(twin_, run)),
      base_(run, twin_, options.base) {
  deviations_ = force::deviations(model_, twin_.estimates);
  result_.known_mass = twin_.known_mass;
}

// What is said to touch; empty: automatic. `apart`: s, how far from a time a line of a file may be.
force::ContactAt Work::named_contact(double apart) const {
  const dynamics::BaseFunction base = [this](double time) { return base_.at(time); };
  if (!options_.hand.empty()) {
    const math::MatrixX points = twin::read_points(options_.hand);
    if (points.cols() == 0) throw InputError(options_.hand.string(), "has no point", "give a point cloud of the hand");
    return contact_near(twin_, base, points);
  }
  if (options_.contact) return contact_near(twin_, base, *options_.contact);
  if (options_.contacts.empty()) return {};
  return [=, this, given = read_contacts(options_.contacts)](
             double time, const math::VectorX& theta) -> std::optional<force::Contact> {
    const auto at = std::min_element(given.begin(), given.end(), [&](const ContactPoint& a, const ContactPoint& b) {
      return std::abs(a.time - time) < std::abs(b.time - time);
    });
    if (!at->point || std::abs(at->time - time) > apart) return {};
    return contact_near(twin_, base, *at->point)(time, theta);
  };
}

// What is far from the rope does not touch it; what always is was meant otherwise (check_near()).
force::ContactAt Work::contact(double apart) {
  const force::ContactAt named = named_contact(apart);
  if (!named) return {};
  return [this, named](double time, const math::VectorX& theta) {
    std::optional<force::Contact> out = named(time, theta);
    if (!out) return out;
    least_ = std::min(least_, out->distance);
    if (out->distance > kNear * twin_.chain.diameter) out.reset();
    return out;
  };
}

void Work::check_near() const {
  const std::string where = !options_.hand.empty() ? options_.hand.string()
                            : options_.contact     ? "`contact`"
                                                   : options_.contacts.string();
  if (!std::isfinite(least_)) throw InputError(where, "names no contact at any of the states' times", "correct it");
  if (least_ > kNear * twin_.chain.diameter)
    throw InputError(where, "never comes nearer to the rope than " + core::exact(least_) + " m",
                     "give meters in the world frame, and the base motion of the states");
}

void Work::check_finite(const force::Estimate& estimate) const {
  if (!force::is_finite(estimate))
    throw InputError(source_, "the force at " + core::exact(estimate.time) + " s is not a finite number",
                     "check the states about that time and the twin's parameters");
}

void Work::tell(const force::Estimate& estimate) {
  check_finite(estimate);
  each_(estimate, twin_.known_mass);
  ++result_.states;
  result_.touching += estimate.touching;
}

void Work::live() {
  const force::ContactAt touched = contact(kLiveApart);
  force::LiveForce live(
      model_, deviations_, [this](double time) { return base_.at(time); }, touched);
  double first = std::numeric_limits<double>::infinity();
  try {
    each_state(options_, twin_.chain, [&](const State& state) {
      first = std::min(first, state.time);
      base_.check_covers(first, state.time);
      base_.forget();  // it goes for the few states before it, too
      base_.mend(state.time, state.base);
      if (const auto estimate = live.update(state.time, state.theta, state.standing, state.clock)) tell(*estimate);
    });
    if (live.taken() < 3) throw InputError(source_, kFew, kMore);
    for (const force::Estimate& estimate : live.finish()) tell(estimate);
  } catch (const InputError& error) {
    if (result_.states == 0) throw;
    throw broken_off(error, "the lines so far are kept");
  }
  if (touched) check_near();
}

void Work::whole() {
  chain::States states;
  std::vector<force::Clock> clocks;
  each_state(options_, twin_.chain, [&](const State& state) {
    base_.mend(state.time, state.base);
    states.time.push_back(state.time);
    states.theta.push_back(state.theta);
    if (state.standing.size() > 0) states.covariance.push_back(state.standing);
    clocks.push_back(state.clock);
  });
  const std::size_t count = states.time.size();
  if (count < 3) throw InputError(source_, kFew, kMore);
  base_.check_covers(states.time.front(), states.time.back());
  twin::warn_beyond(twin_.validity, twin::validity_of(twin_.chain, base_.given(), states), source_);
  const force::Motion motion = force::smooth(states, clocks);
  const force::ContactAt touched = contact((states.time.back() - states.time.front()) / (count - 1.0));
  const std::vector<std::optional<force::Contact>> contacts = contacts_along(motion, touched);
  if (touched) check_near();
  const std::vector<force::Estimate> found = force::estimate(
      model_, deviations_, [this](double time) { return base_.at(time); }, motion, contacts);
  for (const force::Estimate& estimate : found) check_finite(estimate);
  for (const force::Estimate& estimate : found) tell(estimate);
}

}  // namespace

void ForceOptions::check() const {
  if (states.empty() == estimate.empty())
    throw InputError("`states`, `estimate`", "one of the two is needed", "give the angles over time");
  if (contact.has_value() + !contacts.empty() + !hand.empty() > 1)
    throw InputError("`contact`, `contacts`, `hand`", "more than one is given", "give what touches the rope once");
  if (contact && !contact->allFinite())
    throw InputError("`contact`", "is no point", "give three finite numbers, in meters");
}

ForceResult forces(const Path& run, const ForceOptions& options, const EachForce& each,
                   const core::Listener& listener) {
  const core::ListenerScope scope(listener);
  options.check();
  Work work(run, options, each);
  if (options.live)
    work.live();
  else
    work.whole();
  if (!work.result().known_mass)
    core::warn(run.string() + ": the rope's mass is not known; forces are per kilogram of rope");
  return work.result();
}

std::vector<force::Estimate> forces(const Rope& rope, const chain::States& states, const trajectory::Trajectory& base,
                                    const std::optional<math::Vector3>& contact) {
  const dynamics::Model& model = model_of(rope);
  if (states.time.size() < 3) throw InputError("`states`", kFew, kMore);
  check_covered(base, states.time.front(), states.time.back(), "`base`", "give the base motion of these states");
  const dynamics::BaseFunction base_at = [&base](double time) { return base.at(time); };
  const force::Motion motion = force::smooth(states);
  const force::ContactAt touched = contact ? contact_near(rope.twin, base_at, *contact) : nullptr;
  return force::estimate(model, force::deviations(model, rope.twin.estimates), base_at, motion,
                         contacts_along(motion, touched));
}

}  // namespace chainsplat::pipeline
