#include "parts.h"

#include <algorithm>
#include <cmath>

#include "chainsplat/export.h"
#include "xml_text.h"

namespace chainsplat::exports {

using math::Matrix3;
using math::Vector3;

std::vector<math::Pose> local_poses(const chain::Chain& chain, const math::VectorX& theta, const math::VectorX& roll,
                                    const math::Pose& base) {
  const std::vector<math::Pose> motions = chain::material_motions(chain, theta, roll, base);
  std::vector<math::Pose> world, local;
  for (int j = 0; j < chain.links(); ++j) {
    const math::Pose home{math::Matrix3::Identity(), chain.link_start(j) * chain.direction};
    world.push_back(motions[j] * home);
    local.push_back(j == 0 ? world[0] : world[j - 1].inverse() * world[j]);
  }
  return local;
}

std::vector<math::Pose> local_poses(const chain::Chain& chain, const chain::States& states, std::size_t k,
                                    const math::Pose& base) {
  return local_poses(chain, states.theta[k], states.roll.empty() ? math::VectorX() : states.roll[k], base);
}

Matrix3 point_inertia(double mass, const Vector3& arm) {
  return mass * (arm.squaredNorm() * Matrix3::Identity() - arm * arm.transpose());
}

Inertia inertia_of(const chain::Chain& chain, const dynamics::Parameters& p, int link) {
  const double mass = p.link_mass[link - 1], length = chain.link_end(link) - chain.link_start(link);
  const Vector3& d = chain.direction;
  const double across = mass * (length * length / 12.0 + p.radius * p.radius / 4.0);
  const Matrix3 along = d * d.transpose();
  const double about_itself = std::max(0.5 * mass * p.radius * p.radius, kLeastInertia);
  Inertia out{mass, 0.5 * length * d, across * (Matrix3::Identity() - along) + about_itself * along};
  if (link + 1 < chain.links() || p.tip_mass <= 0.0) return out;
  const Vector3 tip = (length + 0.5 * p.tip_length) * d,
                center = (mass * out.center + p.tip_mass * tip) / (mass + p.tip_mass);
  out.about += point_inertia(mass, out.center - center) + point_inertia(p.tip_mass, tip - center) +
               p.tip_mass * p.tip_length * p.tip_length / 12.0 * (Matrix3::Identity() - along);
  out.mass += p.tip_mass;
  out.center = center;
  return out;
}

Vector3 gravity_felt(const dynamics::Parameters& p) {
  if (!p.table_normal || !p.table_carries_weight) return p.gravity;
  return p.gravity - p.table_normal->dot(p.gravity) * *p.table_normal;
}

std::array<double, 4> color_of_link(const splat::Gaussians& g, int link) {
  std::array<double, 4> sum{0, 0, 0, 1};
  double weight = 0.0;
  for (int i = 0; i < g.count; ++i) {
    if (surest_link(g, i) != link) continue;
    const double opacity = 1.0 / (1.0 + std::exp(-static_cast<double>(g.opacity_logit[i])));
    weight += opacity;
    const Vector3 color = splat::base_color(g, i);
    for (int c = 0; c < 3; ++c) sum[c] += opacity * color[c];
  }
  for (int c = 0; c < 3; ++c) sum[c] = weight > 0.0 ? std::round(1e3 * sum[c] / weight) / 1e3 : 0.5;
  return sum;
}

double linear_from_srgb(double value) {
  return value <= 0.04045 ? value / 12.92 : std::pow((value + 0.055) / 1.055, 2.4);
}

std::string what_it_is(const twin::Twin& twin) {
  return "The rope " + escaped(twin.provenance.capture) +
         " as identified by chainsplat " CHAINSPLAT_VERSION ". SI units" +
         (twin.known_mass ? "" : ", but the whole mass counts as 1 kg");
}

}  // namespace chainsplat::exports
