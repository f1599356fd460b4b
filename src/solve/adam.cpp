#include <cmath>

#include "chainsplat/solve.h"

namespace chainsplat::solve {

void check(const AdamOptions& options) {
  const auto refuse = [](const char* field, double value, const char* mend) {
    throw InputError(std::string("solve::AdamOptions.") + field, "is " + core::exact(value), mend);
  };
  if (!(options.rate > 0.0) || !std::isfinite(options.rate)) refuse("rate", options.rate, "give a number > 0");
  if (!(options.beta1 >= 0.0 && options.beta1 < 1.0)) refuse("beta1", options.beta1, "give a number from 0 to below 1");
  if (!(options.beta2 >= 0.0 && options.beta2 < 1.0)) refuse("beta2", options.beta2, "give a number from 0 to below 1");
  if (!(options.epsilon >= 0.0)) refuse("epsilon", options.epsilon, "give a number >= 0");
}

void adam_step(AdamState& state, const VectorX& gradient, const AdamOptions& options, VectorX& x) {
  if (state.first.size() == 0) {
    check(options);
    state.first = state.second = VectorX::Zero(gradient.size());
  }
  ++state.steps;
  state.first = options.beta1 * state.first + (1.0 - options.beta1) * gradient;
  state.second = options.beta2 * state.second + (1.0 - options.beta2) * gradient.cwiseAbs2();
  const double correction1 = 1.0 - std::pow(options.beta1, state.steps);
  const double correction2 = 1.0 - std::pow(options.beta2, state.steps);
  x.array() -= options.rate * (state.first.array() / correction1) /
               ((state.second.array() / correction2).sqrt() + options.epsilon);
}

}  // namespace chainsplat::solve
