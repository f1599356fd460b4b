#include "chainsplat/text.h"

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

}  // namespace chainsplat::core
