#include "src/recognition/frames.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

namespace chainsplat::recognition {

std::vector<FrameViews> assign_views(const capture::Capture& capture, const std::vector<double>& times) {
  std::vector<FrameViews> frames(times.size());
  for (std::size_t k = 0; k < times.size(); ++k) frames[k].time = times[k];
  const double period = times.size() > 1 ? (times.back() - times.front()) / static_cast<double>(times.size() - 1)
                                         : std::numeric_limits<double>::infinity();
  // each frame takes every camera's nearest view
  for (std::size_t camera = 0; camera < capture.cameras.size(); ++camera) {
    std::vector<int> nearest(times.size(), -1);
    for (int v = 0; v < static_cast<int>(capture.views.size()); ++v) {
      const capture::View& view = capture.views[v];
      if (view.camera != static_cast<int>(camera) || view.width == 0) continue;
      const auto above = std::lower_bound(times.begin(), times.end(), view.time);
      for (auto at = above == times.begin() ? above : above - 1; at != times.end() && at <= above; ++at) {
        const auto k = static_cast<std::size_t>(at - times.begin());
        const double away = std::abs(view.time - times[k]);
        if (away > 0.5 * period * (1.0 + 1e-6)) continue;
        if (nearest[k] < 0 || away < std::abs(capture.views[nearest[k]].time - times[k])) nearest[k] = v;
      }
    }
    for (std::size_t k = 0; k < times.size(); ++k)
      if (nearest[k] >= 0) frames[k].views.push_back(nearest[k]);
  }
  return frames;
}

std::vector<math::Pose> view_motions(const chain::Chain& chain, const capture::Capture& capture,
                                     const chain::States& states, const FrameViews& frame, int frame_index,
                                     const math::VectorX& theta, const capture::View& view) {
  constexpr double kSameTime = 1e-6;  // s
  math::VectorX at_view = theta;
  if (std::abs(view.time - frame.time) > kSameTime)
    at_view += chain::interpolate(states, view.time) - states.theta[frame_index];
  return chain::link_motions(chain, at_view, capture.base.pose(view.time));
}

void shuffle(std::vector<int>& order, core::Random& random) {
  for (std::size_t i = order.size(); i-- > 1;) std::swap(order[i], order[random.next() % (i + 1)]);
}

std::vector<int> draw_batch(ViewDeck& deck, int size, int count, core::Random& random) {
  if (deck.order.empty()) {
    deck.order.resize(count);
    std::iota(deck.order.begin(), deck.order.end(), 0);
    deck.next = deck.order.size();
  }
  std::vector<int> batch;
  while (static_cast<int>(batch.size()) < std::min(size, count)) {
    if (deck.next == deck.order.size()) {
      shuffle(deck.order, random);
      deck.next = 0;
    }
    batch.push_back(deck.order[deck.next++]);
  }
  return batch;
}

splat::ViewSpec view_spec(const capture::Capture& capture, const capture::View& view, std::vector<math::Pose> motions) {
  return {&capture.cameras[view.camera], view.x0, view.y0, view.width, view.height, std::move(motions)};
}

}  // namespace chainsplat::recognition
