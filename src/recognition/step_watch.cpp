#include "src/recognition/step_watch.h"

#include <algorithm>
#include <cmath>

namespace chainsplat::recognition {

double step_scale(const StepWatch& watch) {
  constexpr double kSmaller = 0.25;
  return std::pow(kSmaller, watch.restarts);
}

void begin_round(StepWatch& watch) { watch.smooth_loss = watch.least_loss = -1.0, watch.losses = 0; }

Course watch_loss(StepWatch& watch, double relative_loss) {
  // A loss is that of a few views, and views differ. In sound trainings of six captures (free and on a table, 20 and
  // 30 cm, 320x240 and 640x480) the smoothed one was at most 1.26 times the least before it.
  constexpr double kNew = 0.3, kTooMuch = 2.0;
  constexpr double kNothing = 0.95;
  constexpr int kBegun = 5;  // losses
  if (!std::isfinite(relative_loss)) return Course::diverged;
  watch.smooth_loss = watch.smooth_loss < 0 ? relative_loss : (1 - kNew) * watch.smooth_loss + kNew * relative_loss;
  watch.least_loss = watch.least_loss < 0 ? watch.smooth_loss : std::min(watch.least_loss, watch.smooth_loss);
  if (++watch.losses >= kBegun && watch.smooth_loss > kNothing) return Course::diverged;
  return watch.smooth_loss > kTooMuch * watch.least_loss ? Course::diverged : Course::fine;
}

Course watch_gradients(StepWatch& watch, int not_finite, int step) {
  constexpr int kPersistent = 20;  // steps: transient trouble passes sooner
  if (not_finite == 0) {
    watch.bad_in_a_row = 0;
    return Course::fine;
  }
  if (watch.bad_steps++ == 0)
    core::warn("recognize: at step " + std::to_string(step) + " the gradient of " + std::to_string(not_finite) +
               " parameters is not finite; they are left as they are");
  return ++watch.bad_in_a_row >= kPersistent ? Course::diverged : Course::fine;
}

}  // namespace chainsplat::recognition
