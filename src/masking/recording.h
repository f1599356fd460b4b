// src/masking/recording.h - a capture whose masks are made: its frames, those of them that are learned from, and the
// moments in which the cameras together show the rope. Pictures are whole and undistorted.
#pragma once
#include <functional>
#include <vector>

#include "chainsplat/masking.h"
#include "src/masking/grow.h"
#include "src/masking/hints.h"
#include "src/masking/look.h"

namespace chainsplat::masking {

constexpr double kAboutPixels = 24.0;  // px around a tube whose colors count as the rope's surroundings
// radii, by which the tube of a grown chain may be off, and px, by which that of a fitted chain may: pixels on its
// outline show both sides; a wider margin left the rope's dark underside and its contact shadow unlearned
constexpr double kGrownMargin = 0.4, kFitMargin = 0.5;
// Share of the best moment's evidence from which on its colors are learned, and the number of samples per side as which
// the colors of other moments count.
constexpr double kTrusted = 0.75;
constexpr int kKnownSamples = 1000;

struct Recording {
  const Path& path;
  const capture::Capture& capture;       // without views
  std::vector<capture::Camera> pinholes;  // the cameras of undistorted pictures
  const Help& help;
  int first, last;  // frames of each camera; last < 0: to the end
};

int frames_of(const Recording& recording, int camera);
double frame_bytes(const capture::Camera& camera);  // in memory
// Calls `body` with the undistorted frames of one camera, some at a time for many threads. Throws Interrupted.
void each_block(const Recording& recording, int camera, const std::function<void(std::vector<capture::Frame>&)>& body);
Picture picture_of(const capture::Frame& frame);

// Some whole frames of one camera, from which its appearance is learned.
struct Samples {
  std::vector<capture::Frame> frames;
  std::vector<Picture> pictures() const;
};

// Pictures taken at one time.
struct Moment {
  double time = 0.0;  // s
  std::vector<Shot> shots;
  std::vector<int> cameras;                  // by shot
  std::vector<capture::Image8> differences;  // that shots show where the empty scene is known
};
// The moments of the first camera that has samples (by camera), together with the other cameras' pictures of that
// moment, and with the user's help.
std::vector<Moment> moments_of(const Recording& recording, const std::vector<Samples>& samples);

// Grows a chain in every moment, at first from its own colors, then also from those of the moments that show the rope
// best. `clues_of`: what is known beforehand in a moment, in pass 0 or 1; `again`, if not empty, is told the chains of
// the first pass, and whether there is a second. Throws InputError where the best moment has less than `least` nats per
// sample.
struct GrownMoments {
  std::vector<Grown> grown;  // by moment
  double best = 0.0;         // evidence
};
using CluesOf = std::function<Clues(const Moment& moment, int pass)>;
GrownMoments grow_moments(const Recording& recording, const chain::Chain& chain, const std::vector<Moment>& moments,
                          double least, const CluesOf& clues_of,
                          const std::function<bool(const std::vector<Grown>&)>& again = {});

// Whether a crop has a pixel of the whole picture in its mask.
bool masked_at(const capture::View& view, int x, int y);
// Returns the mask of an undistorted crop as a whole image of recorded pixels.
capture::Image8 recorded_mask(const capture::View& view, const capture::Camera& camera);

[[noreturn]] void throw_nothing(const Recording& recording);

}  // namespace chainsplat::masking
