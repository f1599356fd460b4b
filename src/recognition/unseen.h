// unseen.h - what no camera saw of a rope, so that it looks like a rope from there, too.
#pragma once
#include <optional>
#include <span>
#include <vector>

#include "chainsplat/chain.h"
#include "chainsplat/splat.h"
#include "src/recognition/viewpoint.h"

namespace chainsplat::recognition {

// Gaussians on the side of the tube that faces none of `views`, or few of them, have hardly a gradient: they stay as
// they were placed, and Adam moves them at random. Others take their place, in an even layer on the surface at the
// radius of those that were seen, with the colors that the texture has around the axis there: ropes are laid or
// braided, so that what repeats does so along a helix, whose slope is found from what was seen; where nothing repeats,
// the color at the same arclength. The light of that side is found from how brightness changes around what was seen.
// What was seen only at a slant keeps its shape and gets colors by the same rule, the more the flatter it was seen.
// Where masks show that something hides the rope, as a gripper does, all stays. design.md, 'Recognition'. The new ones
// are marked kGuessed in Gaussians::guessed, those seen only at a slant kSlanted. Returns how many new ones there are.
inline constexpr std::uint8_t kGuessed = 1, kSlanted = 2;
int finish_unseen(const chain::Chain& chain, std::span<const Viewpoint> views, splat::Gaussians& gaussians);

// What the texture around it says of a Gaussian's color, and how flatly the cameras saw its place: the best cosine
// between surface normal and view ray, but for a few views. None near the axis, behind what hides the rope and where no
// color is known.
struct TextureColor {
  math::Vector3 color;  // RGB, [0, 1]
  double facing;
};
std::vector<std::optional<TextureColor>> texture_colors(const chain::Chain& chain, std::span<const Viewpoint> views,
                                                        const splat::Gaussians& gaussians);

// Puts back, after more training, those of `before` that are guessed, and the colors of those seen only at a slant,
// whose mark ends here. Both have the same count and degree.
void keep_guessed(const splat::Gaussians& before, splat::Gaussians& trained);

}  // namespace chainsplat::recognition
