// frames.h - which views show which frame, and where the links are in each of them.
#pragma once
#include <vector>

#include "chainsplat/capture.h"
#include "chainsplat/chain.h"
#include "chainsplat/core.h"
#include "chainsplat/splat.h"

namespace chainsplat::recognition {

// One frame time of the first camera and the views of that moment (capture::views_at()).
struct FrameViews {
  double time = 0.0;
  std::vector<int> views;  // indices into Capture::views, empty masks left out
};

// One entry a state, in order.
std::vector<FrameViews> assign_views(const capture::Capture& capture, const std::vector<double>& times);

// Where the material of the links is in a view, at its own time: cubic in theta where its camera is not synchronous with
// the first one.
std::vector<math::Pose> view_motions(const chain::Chain& chain, const capture::Capture& capture,
                                     const chain::States& states, const FrameViews& frame, int frame_index,
                                     const math::VectorX& theta, const capture::ViewPlace& view);

void shuffle(std::vector<int>& order, core::Random& random);

// Draws views without repetition until all were used, then anew in another order.
struct ViewDeck {
  std::vector<int> order;
  std::size_t next = 0;
};
// `size` of `count` views; fewer where there are not so many.
std::vector<int> draw_batch(ViewDeck& deck, int size, int count, core::Random& random);

splat::ViewSpec view_spec(const capture::Capture& capture, const capture::ViewPlace& view,
                          std::vector<math::Pose> motions);

}  // namespace chainsplat::recognition
