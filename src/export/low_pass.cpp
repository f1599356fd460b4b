// The renderer adds a variance to every splat on the image (mathematics.md 2.5), and Gaussians are trained with it.
// Viewers do not add it, and would draw the rope thinner and full of gaps.
#include <algorithm>
#include <cmath>
#include <limits>

#include "chainsplat/export.h"
#include "chainsplat/image_model.h"

namespace chainsplat::exports {

namespace {

// What a pixel covers of each Gaussian at the nearest that it comes to a camera, m; infinite where no camera has it in
// front.
std::vector<double> nearest_pixels(const splat::Gaussians& gaussians, const chain::Chain& chain,
                                   const chain::States& motion, const trajectory::Trajectory& base,
                                   const std::vector<capture::Camera>& cameras) {
  std::vector<double> least(gaussians.count, std::numeric_limits<double>::infinity());
  for (std::size_t k = 0; k < motion.time.size(); ++k) {
    const math::Pose at = base.samples().empty() ? math::Pose() : base.pose(motion.time[k]);
    const std::vector<math::Pose> motions = chain::link_motions(chain, motion.theta[k], at);
    for (const capture::Camera& camera : cameras) {
      const math::Pose camera_from_world = camera.world_from_camera.inverse();
      const double focal = std::sqrt(camera.fx * camera.fy);
      for (int i = 0; i < gaussians.count; ++i) {
        const math::Vector3 home(gaussians.mean[3 * i], gaussians.mean[3 * i + 1], gaussians.mean[3 * i + 2]);
        const double z = (camera_from_world * (motions[surest_link(gaussians, i)] * home)).z();
        if (z >= image_model::kNear) least[i] = std::min(least[i], z / focal);
      }
    }
  }
  return least;
}

}  // namespace

splat::Gaussians with_low_pass(const splat::Gaussians& gaussians, const chain::Chain& chain,
                               const chain::States& motion, const trajectory::Trajectory& base,
                               const std::vector<capture::Camera>& cameras) {
  splat::Gaussians out = gaussians;
  const std::vector<double> pixels = gaussians.pixel_footprint > 0.0
                                         ? std::vector<double>(gaussians.count, gaussians.pixel_footprint)
                                         : nearest_pixels(gaussians, chain, motion, base, cameras);
  for (int i = 0; i < gaussians.count; ++i) {
    if (!std::isfinite(pixels[i])) continue;
    const double variance = image_model::kLowPass * pixels[i] * pixels[i];
    for (int c = 0; c < 3; ++c) {
      float& scale = out.log_scale[3 * i + c];
      scale = static_cast<float>(0.5 * std::log(std::exp(2.0 * scale) + variance));
    }
  }
  return out;
}

}  // namespace chainsplat::exports
