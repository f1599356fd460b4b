#include "chainsplat/validity.h"

#include <algorithm>
#include <cmath>
#include <cstdio>

namespace chainsplat::twin {
namespace {

constexpr double kBeyond = 1.5;

}  // namespace

Validity validity_of(const chain::Chain& chain, const trajectory::Trajectory& base, const chain::States& states) {
  Validity out;
  math::MatrixX before;
  for (std::size_t i = 0; i < states.time.size(); ++i) {
    const math::VectorX& theta = states.theta[i];
    const trajectory::BaseMotion motion = base.at(states.time[i]);
    const math::Vector3 turn = motion.velocity.head<3>(), speed = motion.velocity.tail<3>();
    out.acceleration = std::max(out.acceleration, (motion.acceleration.tail<3>() + turn.cross(speed)).norm());
    for (int k = 0; k < chain.angles();) {
      const int joint = chain.child_link[k];
      double square = 0.0;
      for (; k < chain.angles() && chain.child_link[k] == joint; ++k)
        if (!chain::is_twist(chain, k)) square += theta[k] * theta[k];
      out.curvature = std::max(out.curvature, std::sqrt(square) / chain::bent_length(chain, joint));
    }
    const math::MatrixX nodes = chain::nodes(chain, chain::link_motions(chain, theta, motion.pose));
    if (i > 0 && states.time[i] > states.time[i - 1])
      out.speed =
          std::max(out.speed, (nodes - before).colwise().norm().maxCoeff() / (states.time[i] - states.time[i - 1]));
    before = nodes;
  }
  return out;
}

Validity larger(const Validity& one, const Validity& other) {
  return {std::max(one.acceleration, other.acceleration), std::max(one.speed, other.speed),
          std::max(one.curvature, other.curvature)};
}

std::string beyond(const Validity& known, const Validity& motion) {
  struct Quantity {
    const char *what, *unit;
    double known, now;
  };
  const Quantity all[] = {{"the grasp accelerates by", "m/s^2", known.acceleration, motion.acceleration},
                          {"the rope moves at", "m/s", known.speed, motion.speed},
                          {"the rope bends by", "1/m", known.curvature, motion.curvature}};
  const Quantity* worst = nullptr;
  double ratio = kBeyond;
  for (const Quantity& q : all)
    if (q.known > 0.0 && q.now / q.known > ratio) worst = &q, ratio = q.now / q.known;
  if (!worst) return {};
  char text[160];
  std::snprintf(text, sizeof text, "%s %.3g %s, %.1f times what the twin was identified in", worst->what, worst->now,
                worst->unit, ratio);
  return text;
}

void warn_beyond(const std::optional<Validity>& known, const Validity& motion, const std::string& where) {
  const std::string excess = known ? beyond(*known, motion) : "";
  if (!excess.empty())
    core::warn(where + ": " + excess +
               "; the prediction may be worse than its errors say: identify from such a motion, too");
}

}  // namespace chainsplat::twin
