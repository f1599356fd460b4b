// chainsplat/export.h - writes a finished twin in formats of other programs, chosen by the file's ending
// (formats.md 5.5).
//
//   .glb .gltf  glTF 2.0 with KHR_gaussian_splatting: a root node (turns z-up to glTF's y-up) and below it the chain,
//               with one node per link (each the child of the one before) in the link frames of mathematics.md 2.2 (a
//               pure translation at home). The mesh of a link has one POINTS primitive with the Gaussians that are most
//               probable on this link, in the link frame. The motion is one animation: translation and rotation of the
//               base, rotation of each link; its time starts at 0. The file contains its buffers.
//   .ply        gaussians.ply of the run folder: home configuration, base frame. Some PLY viewers show it with y down.
//   .csv        the states, and beside them NAME.centerline.csv: the nodes in the world frame.
// The namespace is not `export`, which is a keyword.
#pragma once
#include <string>
#include <vector>
#include "chainsplat/chain.h"
#include "chainsplat/trajectory.h"
#include "chainsplat/twin.h"

namespace chainsplat::exports {

// The endings that write() knows: ".glb", ".gltf", ...
const std::vector<std::string>& endings();

// Writes `file`. An empty `motion` means the home configuration without animation; a default-constructed `base` is at
// rest at the world origin. Throws InputError for an unknown ending (listing the known ones) and for a twin without the
// data that the format needs, WorkError if the file cannot be written.
void write(const twin::Twin& twin, const chain::States& motion, const trajectory::Trajectory& base, const Path& file);

// Returns the bytes of a .glb (`binary`) or .gltf file.
std::string gltf(const splat::Gaussians& gaussians, const chain::Chain& chain, const chain::States& motion,
                 const trajectory::Trajectory& base, bool binary);

}  // namespace chainsplat::exports
