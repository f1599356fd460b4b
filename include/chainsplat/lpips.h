// chainsplat/lpips.h - LPIPS, the learned distance of two images of Zhang et al. (CVPR 2018), version 0.1 on AlexNet
// (mathematics.md 9).
//
// A trunk, AlexNet's five convolutions as the user's own file, gives features of both images; the distance is the
// weighted sum of their squared differences. The weights are a part of this library, the trunk is not:
// tools/lpips_trunk makes its file (formats.md 2.7) from the weights of torchvision.
#pragma once
#include <memory>
#include <vector>

#include "chainsplat/core.h"
#include "chainsplat/rectangle.h"

namespace chainsplat::eval {

// Pixels; the least width and height of an image. In less, the last features have no or hardly a place.
inline constexpr int kLeastLpipsSide = 64;

class LpipsTrunk;  // an opened trunk; it may be used from several threads, each of which takes the memory of a network
struct LpipsTrunkDeleter {
  void operator()(LpipsTrunk*) const;
};
using LpipsTrunkPtr = std::unique_ptr<LpipsTrunk, LpipsTrunkDeleter>;

// Opens the file of a trunk and tries it on a small image. Throws InputError for what is no trunk: another format,
// other outputs than five with 64, 192, 384, 256 and 256 channels, values that are not finite; WorkError in a build
// without networks (the wheel).
LpipsTrunkPtr open_lpips_trunk(const Path& file);

// LPIPS of two images of full_width x full_height pixels, both black outside a crop of lpips_crop(); 0 for equal
// images. The arguments hold the crop of width x height: interleaved RGB, values in [0, 1]. Where it is the whole
// image, this is the number of the authors' program to 1e-6 of it; from a crop it is to some 0.6 %. All sides: at least
// kLeastLpipsSide.
double lpips(const LpipsTrunk& trunk, const std::vector<float>& a_rgb, const std::vector<float>& b_rgb, int width,
             int height, int full_width, int full_height);

// What of an image of width x height lpips() needs, where all outside of `object` (in the image, not empty) is black.
math::Rectangle lpips_crop(const math::Rectangle& object, int width, int height);

}  // namespace chainsplat::eval
