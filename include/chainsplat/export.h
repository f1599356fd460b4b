// chainsplat/export.h - a twin in other programs' formats, by file ending (INTERFACE 1).
//
//   .glb .gltf  glTF 2.0 with KHR_gaussian_splatting: root node (turns z-up to glTF's y-up), below it the chain, one
//               node a link (each the child of the one before), in the link frames of SPEC 2.2 (home pose: translation
//               only). A link's mesh has one POINTS primitive with the Gaussians whose largest link probability is that
//               link's, in the link frame. The motion is one animation: translation and rotation of the base, rotation
//               of each link; its time starts at 0. One file: buffers are inside.
//   .ply        gaussians.ply of the run folder: home configuration, base frame. y is down in viewers that take PLY so.
//   .csv        the states, and beside them NAME.centerline.csv: the nodes in the world frame.
// The namespace is not `export`: that is a keyword.
#pragma once
#include <string>
#include <vector>
#include "chainsplat/chain.h"
#include "chainsplat/trajectory.h"
#include "chainsplat/twin.h"

namespace chainsplat::exports {

// What write() understands: ".glb", ".gltf", ...
const std::vector<std::string>& endings();

// `motion` may be empty: home configuration, no animation. `base` may be default-made: at rest at the world origin.
// Throws InputError for an unknown ending (lists the known ones) and for a twin that lacks what the file needs,
// WorkError when the file cannot be written.
void write(const twin::Twin& twin, const chain::States& motion, const trajectory::Trajectory& base, const Path& file);

// Bytes of a .glb (`binary`) or .gltf.
std::string gltf(const splat::Gaussians& gaussians, const chain::Chain& chain, const chain::States& motion,
                 const trajectory::Trajectory& base, bool binary);

}  // namespace chainsplat::exports
