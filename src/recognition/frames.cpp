#include "src/recognition/frames.h"

#include <algorithm>
#include <cmath>
#include <numeric>

namespace chainsplat::recognition {

std::vector<FrameViews> assign_views(const capture::Capture& capture, const std::vector<double>& times) {
  const std::vector<std::vector<int>> views = capture::views_at(capture, times);
  std::vector<FrameViews> frames(times.size());
  for (std::size_t k = 0; k < times.size(); ++k) {
    frames[k].time = times[k];
    for (const int v : views[k])
      if (capture.views[v].width > 0) frames[k].views.push_back(v);
  }
  return frames;
}

std::vector<math::Pose> view_motions(const chain::Chain& chain, const capture::Capture& capture,
                                     const chain::States& states, const FrameViews& frame, int frame_index,
                                     const math::VectorX& theta, const capture::ViewPlace& view) {
  constexpr double kSameTime = 1e-6;  // s
  math::VectorX at_view = theta;
  if (std::abs(view.time - frame.time) > kSameTime)
    at_view += chain::interpolate(states, view.time) - states.theta[frame_index];
  return chain::material_motions(chain, at_view, chain::roll_at(states, view.time), capture.base.pose(view.time));
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

splat::ViewSpec view_spec(const capture::Capture& capture, const capture::ViewPlace& view,
                          std::vector<math::Pose> motions) {
  return {&capture.cameras[view.camera], view.x0, view.y0, view.width, view.height, std::move(motions)};
}

}  // namespace chainsplat::recognition
