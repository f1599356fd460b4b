// Other viewers know nothing of the light that stays where it is while a rope rolls under it: they get the mean of what
// each Gaussian has of it.
#include "chainsplat/export.h"
#include "chainsplat/image_model.h"

namespace chainsplat::exports {

splat::Gaussians in_mean_light(const splat::Gaussians& gaussians, const chain::Chain& chain,
                               const chain::States& motion, const trajectory::Trajectory& base) {
  if (!gaussians.light.known()) return gaussians;
  splat::Gaussians out = gaussians;
  out.light = {};
  chain::States states = motion;
  if (states.time.empty()) {  // at home
    states.time.push_back(0.0);
    states.theta.push_back(math::VectorX::Zero(chain.angles()));
  }
  std::vector<double> sums(gaussians.count, 0.0);
  for (const double time : states.time) {
    const math::Pose at = base.samples().empty() ? math::Pose() : base.pose(time);
    const auto motions = chain::material_motions(chain, states, time, at);
    for (int i = 0; i < gaussians.count; ++i)
      sums[i] += splat::brightness(gaussians, i, motions[splat::surest_link(gaussians, i)].rotation);
  }
  const std::size_t values = 3 * static_cast<std::size_t>(gaussians.sh_coefficients());
  for (int i = 0; i < gaussians.count; ++i) {
    const double mean = sums[i] / static_cast<double>(states.time.size());
    for (std::size_t c = 0; c < values; ++c) {
      float& value = out.sh[values * i + c];
      const double gray = c < 3 ? 0.5 / image_model::kSh0 : 0.0;  // what a coefficient of 0 stands for
      value = static_cast<float>(mean * (value + gray) - gray);
    }
  }
  return out;
}

}  // namespace chainsplat::exports
