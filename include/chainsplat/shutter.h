// chainsplat/shutter.h - cameras that read their rows one after the other (a rolling shutter): their pictures as if all
// rows had been read when the middle one was, and how long a reading takes (mathematics.md 6.15).
//
// A rope that moves is seen by each row at another time. Where its motion is known, so that it can be said where each
// point of the rope was when its row was read, the picture at one time follows from the recorded one by moving pixels
// along with the rope beside which they lie. What is not the rope moves with it.
#pragma once
#include <functional>

#include "chainsplat/silhouette.h"

namespace chainsplat::silhouette {

// Nodes of the rope from the grasp to the free end at a time, s: 3 x count, world frame, m.
using NodesAt = std::function<math::MatrixX(double time)>;

// `view` as if all its rows had been read at its time. `pixels`: what its pixels are. A view of a camera that reads all
// rows at once is returned as it is, and so is one in which a node is not in front of the camera.
capture::View as_read_at_once(const capture::View& view, const capture::Camera& camera, capture::Pixels pixels,
                              const NodesAt& nodes);

// Whether one of these cameras reads its rows one after the other.
bool has_rolling_shutter(const std::vector<capture::Camera>& cameras);
// The same for all views of a capture. `states`: the motion of `chain` in it.
void read_at_once(capture::Capture& capture, const chain::Chain& chain, const chain::States& states);

// By frame of `sequence`, which is fitted to `chain`, how its angles would change if the cameras took longer to read
// their rows than is given, all as much, so that each row was read later than its view's time: rad/s.
std::vector<math::VectorX> readout_slopes(const chain::Chain& chain, const capture::Capture& capture,
                                          const SequenceFit& sequence);

}  // namespace chainsplat::silhouette
