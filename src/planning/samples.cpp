// Parameter sets drawn from what identification knows (SPEC 8, robustness).
#include <algorithm>
#include <cmath>

#include "chainsplat/planning.h"

namespace chainsplat::planning {
namespace {

// The number at the end of "name_12", from 0; -1 where the name has none.
int index_of(const std::string& name, const std::string& stem) {
  if (name.size() <= stem.size() + 1 || name.compare(0, stem.size(), stem) != 0 || name[stem.size()] != '_') return -1;
  const std::string digits = name.substr(stem.size() + 1);
  if (!std::all_of(digits.begin(), digits.end(), [](char c) { return c >= '0' && c <= '9'; })) return -1;
  return std::stoi(digits) - 1;
}

}  // namespace

std::vector<dynamics::Parameters> draw_parameters(const chain::Chain& chain, const dynamics::Parameters& parameters,
                                                  const dynamics::Estimates& estimates, int count, std::uint64_t seed) {
  const auto size = static_cast<Eigen::Index>(estimates.names.size());
  if (size == 0 || estimates.covariance.rows() != size || estimates.covariance.cols() != size ||
      !estimates.covariance.allFinite())
    throw InputError("--samples", "the twin knows no covariance of its parameters",
                     "identify it again or leave --samples out");
  // a covariance that was written and read may be off positive by rounding
  const Eigen::SelfAdjointEigenSolver<MatrixX> eigen(0.5 * (estimates.covariance + estimates.covariance.transpose()));
  const MatrixX root = eigen.eigenvectors() * eigen.eigenvalues().cwiseMax(0.0).cwiseSqrt().asDiagonal();
  core::Random random(seed);
  std::vector<dynamics::Parameters> out;
  const int links = chain.links() - 1;
  for (int sample = 0; sample < count; ++sample) {
    VectorX z(size);
    for (Eigen::Index i = 0; i < size; ++i) z[i] = random.normal();
    const VectorX change = root * z;
    dynamics::Parameters p = parameters;
    double mass = p.tip_mass;
    for (double m : p.link_mass) mass += m;
    for (Eigen::Index i = 0; i < size; ++i) {
      const std::string& name = estimates.names[i];
      const double factor = std::exp(change[i]);
      const auto joints = [&](std::vector<double>& values, int joint) {
        for (int k = 0; k < chain.angles(); ++k)
          if (joint < 0 || chain.child_link[k] == joint + 1) values[k] *= factor;
      };
      const auto link = [&](std::vector<double>& values, const char* stem) {
        const int j = index_of(name, stem);
        if (j >= 0 && j < links) values[j] *= factor;
      };
      if (name == "log_stiffness") joints(p.stiffness, -1);
      if (name == "log_damping") joints(p.damping, -1);
      if (name == "log_twist_stiffness_ratio")
        for (int k = 0; k < chain.angles(); ++k)
          if (std::abs(chain.axes[k].head<3>().dot(chain.direction)) > 0.5) p.stiffness[k] *= factor;
      if (const int j = index_of(name, "log_stiffness_joint"); j >= 0) joints(p.stiffness, j);
      if (const int j = index_of(name, "log_damping_joint"); j >= 0) joints(p.damping, j);
      link(p.link_mass, "log_mass_link");
      link(p.coulomb_friction, "log_coulomb_friction_link");
      link(p.viscous_friction, "log_viscous_friction_link");
      if (name == "log_drag")
        for (double& c : p.air_quadratic) c *= factor;
      if (name == "logit_tip_mass_fraction" && p.tip_mass > 0.0 && p.tip_mass < mass) {
        const double odds = p.tip_mass / (mass - p.tip_mass) * factor;
        p.tip_mass = mass * odds / (1.0 + odds);
      }
      if (const int k = index_of(name, "rest_angle"); k >= 0 && k < chain.angles()) p.rest_angle[k] += change[i];
    }
    // the total mass is held
    double links_mass = 0.0;
    for (double m : p.link_mass) links_mass += m;
    for (double& m : p.link_mass) m *= (mass - p.tip_mass) / links_mass;
    out.push_back(std::move(p));
  }
  return out;
}

}  // namespace chainsplat::planning
