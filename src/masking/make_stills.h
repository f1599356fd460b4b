// src/masking/make_stills.h - masks of a few stills: no background to learn, no motion to smooth, and each is judged by
// itself.
#pragma once
#include "src/masking/recording.h"

namespace chainsplat::masking {

constexpr int kStills = 8;  // frames per camera, up to which a capture is one of stills

// Ribbons about chains that are grown in every moment. `samples`: all frames, by camera. Throws InputError where nothing
// is like the rope.
Summary make_stills(const Recording& recording, const chain::Chain& chain, const std::vector<Samples>& samples,
                    const Sink& sink);

}  // namespace chainsplat::masking
