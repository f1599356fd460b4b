#include "chainsplat/math.h"

#include <doctest/doctest.h>

#include <fstream>
#include <nlohmann/json.hpp>

using namespace chainsplat;

namespace {

nlohmann::json vectors(const std::string& name) {
  std::ifstream file(std::string(CHAINSPLAT_SOURCE_DIR) + "/tests/data/vectors/" + name);
  REQUIRE(file.good());
  return nlohmann::json::parse(file);
}

}  // namespace

TEST_CASE("exp and log are inverse, also near zero") {
  for (double size : {0.0, 1e-8, 1e-3, 9.9e-3, 1.01e-2, 1.0, 3.0}) {
    const math::Vector6 s = size * math::Vector6::Constant(0.4);
    CHECK((math::log_se3(math::exp_se3(s)) - s).norm() <= 1e-12 * (1.0 + size));
  }
}

TEST_CASE("adjoint moves twists and the coadjoint swaps the arguments of ad") {
  const math::Vector6 x = math::Vector6::LinSpaced(-1, 2), y = math::Vector6::LinSpaced(0.3, -0.7);
  const math::Pose pose = math::exp_se3(0.7 * y);
  CHECK((math::adjoint(pose) * x - math::transform_twist(pose, x)).norm() <= 1e-14);
  CHECK((math::ad(x).transpose() * y - math::coadjoint(y) * x).norm() <= 1e-14);
  CHECK((math::ad(x) * y + math::ad(y) * x).norm() <= 1e-14);
}

TEST_CASE("exp, Ad and ad equal the 60-digit vectors") {
  const auto file = vectors("se3.json");
  const auto& cases = file["cases"];
  REQUIRE(cases.size() >= 50);
  for (const auto& c : cases) {
    math::Vector6 twist;
    const auto& t = c["xi"];
    for (int i = 0; i < 6; ++i) twist[i] = t[i].get<double>();
    const math::Pose pose = math::exp_se3(twist);
    const auto& T = c["T"];
    double error = 0.0;
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) error = std::max(error, std::abs(pose.rotation(i, j) - T[i][j].get<double>()));
      error = std::max(error, std::abs(pose.translation[i] - T[i][3].get<double>()));
    }
    CHECK(error <= 1e-14 * (1.0 + twist.norm()));
  }
}
