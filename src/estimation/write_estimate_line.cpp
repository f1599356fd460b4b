// write_estimate_line.cpp - an estimate as a line of JSON.
#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <nlohmann/json.hpp>

#include "chainsplat/estimation.h"

namespace chainsplat::estimation {

using math::VectorX;

namespace {

// Rounds to nine digits, because most of a line is its covariance.
double rounded(double value) {
  char text[32];
  const int size = std::snprintf(text, sizeof text, "%.9g", value);
  std::from_chars(text, text + size, value);
  return value;
}

}  // namespace

const char* status(const Estimate& estimate) {
  return estimate.lost ? "lost" : estimate.doubtful ? "doubtful" : "following";
}

std::string to_json(const Estimate& estimate, double latency, bool rates) {
  using Json = nlohmann::ordered_json;
  const auto list = [](const VectorX& values) { return Json(std::vector<double>(values.begin(), values.end())); };
  const int n = static_cast<int>(estimate.theta.size());
  Json covariance = Json::array();
  const Eigen::Index rows = std::min<Eigen::Index>(estimate.covariance.rows(), rates ? 2 * n : n);
  for (Eigen::Index row = 0; row < rows; ++row)
    for (Eigen::Index column = 0; column <= row; ++column)
      covariance.push_back(rounded(estimate.covariance(row, column)));
  Json by_late = Json::array();
  for (const double value : estimate.theta_by_late) by_late.push_back(rounded(value));
  VectorX variance;  // none by Adam
  if (estimate.covariance.size() > 0) variance = estimate.covariance.diagonal().head(n);
  const Json line{{"frame", estimate.frame},
                  {"time", estimate.time},
                  {"theta", list(estimate.theta)},
                  {"thetadot", list(estimate.thetadot)},
                  {"sigma", list(variance.cwiseSqrt())},
                  {"centerline_sigma", rows > 0 ? Json(estimate.centerline_sigma) : Json()},
                  {"iou", estimate.iou},
                  {"residual", estimate.residual},
                  {"color_residual", estimate.color_residual},
                  {"surprise", estimate.surprise},
                  {"covariance", std::move(covariance)},
                  {"lost", estimate.lost},
                  {"status", status(estimate)},
                  {"base_late", estimate.base.late},
                  {"base_late_sigma", rounded(estimate.late_sigma)},
                  {"theta_by_base_late", std::move(by_late)},
                  {"grasp_rotation", list(math::log_so3(estimate.base.grasp.rotation))},
                  {"grasp_shift", list(estimate.base.grasp.translation)},
                  {"settling", estimate.settling},
                  {"latency_ms", std::round(1e6 * latency) / 1e3}};
  return line.dump();
}

}  // namespace chainsplat::estimation
