// moments.cpp - which frames of several cameras were taken together.
#include <algorithm>
#include <cmath>
#include <limits>

#include "chainsplat/capture.h"

namespace chainsplat::capture {

double moment_reach(const std::vector<double>& moments) {
  constexpr double kRounding = 1.0 + 1e-6;  // stamps that are written in decimals still meet in the middle
  if (moments.size() < 2) return std::numeric_limits<double>::infinity();
  return 0.5 * kRounding * (moments.back() - moments.front()) / static_cast<double>(moments.size() - 1);
}

double frame_interval(const Capture& capture, int camera) {
  const std::vector<double>& times = capture.times[camera];
  if (times.size() < 2) return 0.0;
  std::vector<double> intervals;
  for (std::size_t f = 1; f < times.size(); ++f) intervals.push_back(times[f] - times[f - 1]);
  return math::median(intervals);
}

std::vector<int> frames_at(const std::vector<double>& moments, const std::vector<double>& times, double reach) {
  std::vector<int> nearest(moments.size(), -1);
  for (std::size_t f = 0; f < times.size(); ++f) {
    const auto above = std::lower_bound(moments.begin(), moments.end(), times[f]);
    for (auto at = above == moments.begin() ? above : above - 1; at != moments.end() && at <= above; ++at) {
      int& best = nearest[at - moments.begin()];
      const double away = std::abs(times[f] - *at);
      if (away <= reach && (best < 0 || away < std::abs(times[best] - *at))) best = static_cast<int>(f);
    }
  }
  return nearest;
}

std::vector<std::vector<int>> views_at(const Capture& capture, const std::vector<double>& moments) {
  std::vector<std::vector<int>> out(moments.size());
  const double reach = moment_reach(moments);
  for (std::size_t camera = 0; camera < capture.cameras.size(); ++camera) {
    std::vector<int> views;
    std::vector<double> times;
    for (std::size_t v = 0; v < capture.views.size(); ++v) {
      if (capture.views[v].camera != static_cast<int>(camera)) continue;
      views.push_back(static_cast<int>(v));
      times.push_back(capture.views[v].time);
    }
    const std::vector<int> nearest = frames_at(moments, times, reach);
    for (std::size_t m = 0; m < moments.size(); ++m)
      if (nearest[m] >= 0) out[m].push_back(views[nearest[m]]);
  }
  return out;
}

}  // namespace chainsplat::capture
