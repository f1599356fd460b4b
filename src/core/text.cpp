#include "chainsplat/text.h"

#include <algorithm>
#include <cmath>
#include <cstdio>

namespace chainsplat::core {

std::string brief(double value) {
  char text[400];  // the largest double has 309 digits before the point
  if (!(std::abs(value) >= 1.0) || !std::isfinite(value)) {
    std::snprintf(text, sizeof text, "%.4g", value);
    return text;
  }
  std::snprintf(text, sizeof text, "%.3f", value);
  std::string out = text;
  out.erase(out.find_last_not_of('0') + 1);
  if (out.back() == '.') out.pop_back();
  return out;
}

std::string with_error(double value, double error) {
  if (!(error > 0.0) || !std::isfinite(error) || !std::isfinite(value)) return brief(value) + " +- " + brief(error);
  constexpr int kMostDecimals = 15;
  const int decimals = std::clamp(1 - static_cast<int>(std::floor(std::log10(error))), 0, kMostDecimals);
  char text[700];  // two numbers of up to 309 digits before the point
  std::snprintf(text, sizeof text, "%.*f +- %.*f", decimals, value, decimals, error);
  return text;
}

}  // namespace chainsplat::core
