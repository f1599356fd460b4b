// light.h - how the light around a rope falls on its sides.
#pragma once
#include <vector>

#include "chainsplat/capture.h"
#include "chainsplat/chain.h"
#include "chainsplat/splat.h"
#include "src/recognition/frames.h"

namespace chainsplat::recognition {

// Where a rope swings, turns or rolls, its texture goes along and the light on it stays: from that the two are told
// apart. Least squares over texture and light in turns, beginning with a texture that is the same all over. `states`
// with rolls, where there are any. A light that is not known() where it explains too little of the colors to be
// believed. Mathematics.md 2.4.
splat::Light light_on(const chain::Chain& chain, const capture::Capture& capture, const std::vector<FrameViews>& frames,
                      const chain::States& states);

}  // namespace chainsplat::recognition
