#include <algorithm>
#include <cmath>

#include "chainsplat/solve.h"

namespace chainsplat::solve {
namespace {

void end(Descent& descent, Reason reason) {
  descent.done = true;
  descent.summary.reason = reason;
}

// Whether another damping gives another step.
bool adapts(const Damping& rule) { return rule.rule == Damping::Rule::multiply || rule.rule == Damping::Rule::shift; }

void raise(Descent& descent, const Damping& rule) {
  descent.damping = std::max(rule.raise * descent.damping, rule.least_raised);
}

void lower(Descent& descent, const Damping& rule) {
  if (!adapts(rule)) return;
  const double damping = rule.lower * descent.damping;
  descent.damping = damping >= rule.least ? damping : rule.rule == Damping::Rule::shift ? 0.0 : rule.least;
}

double length_of(const VectorX& step, const Options& options) {
  const auto measured = step.head(options.measured > 0 ? options.measured : step.size());
  if (measured.size() == 0) return 0.0;
  return options.euclidean ? measured.norm() : measured.cwiseAbs().maxCoeff();
}

void accept(Descent& descent) {
  descent.x = descent.trial;
  descent.summary.worst_step = descent.length;
  ++descent.taken;
}

template <class Equations>
Summary over(VectorX& x, const std::function<double(const VectorX&, Equations*)>& evaluate, const Options& options) {
  Equations now, next;
  Callbacks callbacks;
  callbacks.evaluate = [&](const VectorX& place, bool derivatives) {
    return evaluate(place, derivatives ? &next : nullptr);
  };
  callbacks.step = [&](double damping, VectorX& step) { return damped_step(now, options.damping, damping, step); };
  callbacks.accepted = [&](double) -> std::optional<Reason> {
    std::swap(now, next);
    if (!(options.gradient_tolerance > 0.0)) return {};
    double square = now.gradient.squaredNorm();
    if constexpr (requires { now.local; })
      for (const auto& local : now.local) square += local.gradient.squaredNorm();
    return std::sqrt(square) <= options.gradient_tolerance ? std::optional(Reason::gradient) : std::nullopt;
  };
  return least_squares(x, callbacks, options);
}

}  // namespace

void check(const Options& options) {
  const auto refuse = [](const char* field, double value, const char* mend) {
    throw InputError(std::string("solve::Options.") + field, "is " + core::exact(value), mend);
  };
  const auto count = [&](const char* field, int value) {
    if (value < 0) refuse(field, value, "give a number >= 0");
  };
  const auto size = [&](const char* field, double value) {
    if (!(value >= 0.0)) refuse(field, value, "give a number >= 0");
  };
  count("steps", options.steps), count("trials", options.trials), count("measured", options.measured);
  if (options.attempts < 1) refuse("attempts", options.attempts, "give a number >= 1");
  size("rounding", options.rounding), size("cost_tolerance", options.cost_tolerance);
  size("decrease_tolerance", options.decrease_tolerance);
  size("gradient_tolerance", options.gradient_tolerance), size("step_tolerance", options.step_tolerance);
  size("trusted", options.trusted), size("negligible", options.negligible);
  if (!(options.longest > 0.0)) refuse("longest", options.longest, "give a number > 0");
  const Damping& damping = options.damping;
  size("damping.first", damping.first), size("damping.least_raised", damping.least_raised);
  size("damping.least", damping.least), size("damping.lower", damping.lower);
  if (!(damping.raise > 1.0)) refuse("damping.raise", damping.raise, "give a number > 1");
  if (!(damping.lower < 1.0)) refuse("damping.lower", damping.lower, "give a number < 1");
}

Descent begin(const VectorX& x, const Options& options) {
  check(options);
  Descent descent;
  descent.x = descent.trial = x;
  descent.damping = options.damping.first;
  return descent;
}

bool judge(Descent& descent, double cost, const Options& options) {
  Summary& summary = descent.summary;
  if (!descent.started || !options.checked) {
    if (!descent.started) summary.initial_cost = cost;
    summary.final_cost = descent.cost = cost;
    descent.decrease = std::numeric_limits<double>::infinity();
    const bool good = !options.checked || std::isfinite(cost);
    if (!good)
      end(descent, Reason::not_finite);
    else if (descent.taken >= options.steps || options.trials == 0)
      end(descent, Reason::last_iteration);
    descent.started = true;
    return good;
  }
  const bool better = cost < descent.cost + options.rounding || (options.ties && cost == descent.cost);
  if (better) {
    descent.decrease = descent.cost - cost;
    summary.final_cost = descent.cost = cost;
    accept(descent);
    descent.attempt = 0;
    lower(descent, options.damping);
    // without a tolerance a step within `rounding`, which may raise the cost, is no end
    const double least = std::max(options.cost_tolerance * std::abs(cost), options.decrease_tolerance);
    if (least > 0.0 && descent.decrease < least) end(descent, Reason::cost);
  } else {
    raise(descent, options.damping);
    if (++descent.attempt >= options.attempts || !adapts(options.damping)) end(descent, Reason::no_decrease);
  }
  if (!descent.done && descent.length < options.step_tolerance) end(descent, Reason::step);
  if (!descent.done && (descent.taken >= options.steps || summary.iterations >= options.trials))
    end(descent, Reason::last_iteration);
  return better;
}

void propose(Descent& descent, const std::function<bool(double damping, VectorX& step)>& step, const Options& options) {
  while (!step(descent.damping, descent.step)) {
    raise(descent, options.damping);
    if (++descent.attempt >= options.attempts) return end(descent, Reason::singular);
  }
  if (!descent.step.allFinite()) return end(descent, Reason::not_finite);
  descent.length = length_of(descent.step, options);
  if (descent.length <= options.negligible) return end(descent, Reason::step);
  if (descent.length > options.longest) {
    descent.step *= options.longest / descent.length;
    descent.length = options.longest;
  }
  descent.trial = descent.x + descent.step;
  ++descent.summary.iterations;
  if (!options.checked) {
    accept(descent);
    if (descent.length < options.step_tolerance)
      end(descent, Reason::step);
    else if (descent.taken >= options.steps)
      end(descent, Reason::last_iteration);
    return;
  }
  // near a minimum the full step is right; a step that damping made short says nothing
  const bool full = descent.attempt == 0 && (options.damping.rule != Damping::Rule::shift || descent.damping == 0.0);
  if (full && descent.length <= options.trusted) {
    accept(descent);
    return end(descent, Reason::step);
  }
  descent.derivatives = options.eager && descent.attempt == 0 && descent.taken + 1 < options.steps;
}

Summary least_squares(VectorX& x, const Callbacks& callbacks, const Options& options) {
  Descent descent = begin(x, options);
  while (!descent.done) {
    if (options.cancellable && core::stop_requested()) {
      end(descent, Reason::cancelled);
      break;
    }
    std::optional<Reason> reason;
    if (judge(descent, callbacks.evaluate(descent.trial, descent.derivatives), options)) {
      if (!descent.done && !descent.derivatives && !std::isfinite(callbacks.evaluate(descent.x, true)))
        end(descent, Reason::not_finite);
      if (!descent.done && callbacks.accepted) reason = callbacks.accepted(descent.decrease);
    } else if (!descent.done && callbacks.rejected) {
      reason = callbacks.rejected(descent.step);
    }
    if (reason) end(descent, *reason);
    if (!descent.done) propose(descent, callbacks.step, options);
  }
  x = std::move(descent.x);
  return descent.summary;
}

Summary least_squares(VectorX& x, const std::function<double(const VectorX&, NormalEquations*)>& evaluate,
                      const Options& options) {
  return over(x, evaluate, options);
}

Summary least_squares(VectorX& x, const std::function<double(const VectorX&, ArrowEquations*)>& evaluate,
                      const Options& options) {
  return over(x, evaluate, options);
}

}  // namespace chainsplat::solve
