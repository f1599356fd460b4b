#include <limits>

#include "chainsplat/capture.h"
#include <doctest/doctest.h>

using namespace chainsplat;

namespace {

constexpr double kEver = std::numeric_limits<double>::infinity();

// A capture of empty views at these times, by camera.
capture::Capture views_of(const std::vector<std::vector<double>>& times) {
  capture::Capture capture;
  capture.cameras.resize(times.size());
  for (std::size_t c = 0; c < times.size(); ++c)
    for (const double time : times[c]) {
      capture.views.emplace_back();
      capture.views.back().camera = static_cast<int>(c);
      capture.views.back().time = time;
    }
  return capture;
}

}  // namespace

TEST_CASE("a moment takes of every camera the nearest frame within half an interval") {
  using Frames = std::vector<int>;
  const std::vector<double> moments{0.0, 0.1, 0.2};
  const double reach = capture::moment_reach(moments);
  CHECK(reach == doctest::Approx(0.05));
  CHECK(capture::frames_at(moments, {0.01, 0.12, 0.19}, reach) == Frames{0, 1, 2});
  CHECK(capture::frames_at(moments, {0.0, 0.04, 0.11, 0.12}, reach) == Frames{0, 2, -1});  // twice as fast
  CHECK(capture::frames_at(moments, {0.05, 0.16}, reach) == Frames{0, 0, 1});              // in the middle
  CHECK(capture::frames_at(moments, {-0.06, 0.26}, reach) == Frames{-1, -1, -1});
  CHECK(capture::frames_at({0.0, 0.1}, {}, 1.0) == Frames{-1, -1});
  CHECK(capture::moment_reach({0.3}) == kEver);
  CHECK(capture::frames_at({0.3}, {7.0}, kEver) == Frames{0});
  CHECK(capture::views_at(views_of({{0.0, 0.1, 0.2}, {0.13, 0.24}, {}}), moments) ==
        std::vector<Frames>{{0}, {1, 3}, {2, 4}});
}
