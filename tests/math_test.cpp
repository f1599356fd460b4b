#include "chainsplat/math.h"
#include "chainsplat/rectangle.h"
#include "src/math/decompositions.h"

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

TEST_CASE("a covariance is finite, symmetric and positive semidefinite, in any units") {
  math::MatrixX good(3, 3);
  good << 4, 2e-6, 0, 2e-6, 1e-12, 0, 0, 0, 0;  // two fully correlated variables and one without variance
  CHECK(math::is_covariance(good));
  CHECK(math::is_covariance(math::MatrixX()));
  const auto with = [&](int row, int column, double value) {
    math::MatrixX m = good;
    m(row, column) = m(column, row) = value;
    return m;
  };
  CHECK(math::is_covariance(with(0, 1, 2e-6 * (1.0 + 1e-8))));  // within rounding
  CHECK_FALSE(math::is_covariance(with(0, 1, 2.1e-6)));
  CHECK_FALSE(math::is_covariance(with(1, 1, -1e-30)));
  CHECK_FALSE(math::is_covariance(with(2, 0, 1e-30)));
  CHECK_FALSE(math::is_covariance(with(2, 2, NAN)));
  CHECK_FALSE(math::is_covariance(with(2, 2, INFINITY)));
  math::MatrixX skew = good;
  skew(0, 1) = -skew(1, 0);
  CHECK_FALSE(math::is_covariance(skew));
  CHECK_FALSE(math::is_covariance(math::MatrixX::Identity(2, 3)));
  math::MatrixX large = 1e308 * math::MatrixX::Identity(2, 2);
  CHECK(math::is_covariance(large));
  large(0, 1) = large(1, 0) = 1.1e308;
  CHECK_FALSE(math::is_covariance(large));
}

TEST_CASE("the known part of a covariance has no gap") {
  math::MatrixX m = math::MatrixX::Identity(4, 4);
  CHECK(math::known_part(m) == std::vector<Eigen::Index>{0, 1, 2, 3});
  m.row(1).setConstant(NAN), m.col(1).setConstant(NAN);
  m(3, 0) = INFINITY;
  const auto kept = math::known_part(m);
  CHECK(kept.size() == 2);
  CHECK(m(kept, kept).allFinite());
  CHECK(math::known_part(math::MatrixX::Constant(2, 2, NAN)).empty());
}

TEST_CASE("factors of what is not positive definite are told apart") {
  math::MatrixX m = math::MatrixX::Identity(2, 2);
  const auto both = [&](bool positive) {
    return math::is_positive(Eigen::LLT<math::MatrixX>(m)) == positive &&
           math::is_positive(Eigen::LDLT<math::MatrixX>(m)) == positive;
  };
  CHECK(both(true));
  for (const double value : {0.0, -1.0, static_cast<double>(NAN), static_cast<double>(INFINITY)}) {
    m(1, 1) = value;
    CHECK(both(false));
  }
}

TEST_CASE("rectangles of pixels") {
  using math::Rectangle;
  const auto same = [](const Rectangle& a, const Rectangle& b) {
    return a.x0 == b.x0 && a.y0 == b.y0 && a.x1 == b.x1 && a.y1 == b.y1;
  };
  const Rectangle a{1, 2, 5, 8}, b{4, 0, 9, 3}, apart{7, 7, 9, 9};
  CHECK(a.width() == 4);
  CHECK(a.height() == 6);
  CHECK(same(math::intersection(a, b), {4, 2, 5, 3}));
  CHECK(math::intersection(a, apart).empty());
  CHECK(same(math::enclosing(a, b), {1, 0, 9, 8}));
  CHECK(same(math::enclosing({}, b), b));
  CHECK(same(math::enclosing(a, {3, 3, 3, 4}), a));
  CHECK(same(math::grown(a, 2), {-1, 0, 7, 10}));
}
