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
//   .npz        NumPy arrays of everything (states, covariances, poses, parameters, Gaussians), and beside them
//               NAME.py, which poses the twin.
//   .mcap       a recording for Foxglove and rerun (mcap.h).
//   .xml        MJCF for MuJoCo, and beside it NAME_base.csv and NAME_play.py, which plays it as the twin moves.
//   .urdf       URDF for robots' programs: links, joints, shapes and inertias; the file says what URDF has no word for.
//   .usda       USD as text: a capsule per link, colored, and the motion; no physics, no Gaussians.
// The namespace is not `export`, which is a keyword.
#pragma once
#include <string>
#include <vector>
#include "chainsplat/capture.h"
#include "chainsplat/chain.h"
#include "chainsplat/properties.h"
#include "chainsplat/trajectory.h"
#include "chainsplat/twin.h"

namespace chainsplat::exports {

// The endings that write() knows: ".glb", ".gltf", ...
const std::vector<std::string>& endings();

// Of a file, in lower case. Throws InputError for one that is not known, with those that are.
std::string ending(const Path& file);

// All files that write() makes for this one, itself first. Throws InputError for an unknown ending.
std::vector<Path> files(const Path& file);

bool for_viewers(const Path& file);  // whether it is a format in which others draw the Gaussians: .glb, .gltf, .ply

// What a file holds beside the rope and its motion.
struct Options {
  bool mesh = false;  // glTF: the rope as a skinned tube
  // That colors are to hold the light for (with_baked_light); glTF: what its cameras lack (lens, principal point)
  // stands in their extras.
  std::vector<capture::Camera> cameras;
  std::vector<twin::Property> properties = {};  // glTF: in the extras of the root node
  Path capture = {};                            // MCAP: whose pictures it shows; empty: none
};

// Writes them. An empty `motion` means the home configuration without animation; a default-constructed `base` is at
// rest at the world origin. Throws InputError for an unknown ending (listing the known ones) and for a twin without the
// data that the format needs, WorkError if the file cannot be written.
void write(const twin::Twin& twin, const chain::States& motion, const trajectory::Trajectory& base, const Path& file,
           const Options& options = {});

// Returns the bytes of a .glb (`binary`) or .gltf file.
std::string gltf(const splat::Gaussians& gaussians, const chain::Chain& chain, const chain::States& motion,
                 const trajectory::Trajectory& base, bool binary, const Options& options = {});

// Gaussians that look in other viewers as they do here: their scales hold what the renderer adds on the image,
// sqrt(0.3) of Gaussians::pixel_footprint. Only where that is not known, motion and cameras say what it is: a pixel at
// the nearest that each Gaussian comes to a camera in the motion.
splat::Gaussians with_low_pass(const splat::Gaussians& gaussians, const chain::Chain& chain,
                               const chain::States& motion, const trajectory::Trajectory& base,
                               const std::vector<capture::Camera>& cameras);

// Gaussians without a light of their own: to these cameras they look in this motion (empty: at home) as they do in it,
// as far as spherical harmonics of degree 2 can, and from elsewhere they have the mean of what each has of it.
splat::Gaussians with_baked_light(const splat::Gaussians& gaussians, const chain::Chain& chain,
                                  const chain::States& motion, const trajectory::Trajectory& base,
                                  const std::vector<capture::Camera>& cameras);

// A zip archive of .npy arrays (formats.md 5.5), and the text of the module that reads it.
std::string npz(const twin::Twin& twin, const chain::States& motion, const trajectory::Trajectory& base);
std::string npz_script();

// The rope as a MuJoCo model: universal joints as hinges in one body, quadratic drag as massless ellipsoids, the base
// on heavy joints. `base` by rows of 1/240 s, and the player that sets it and adds what MJCF has no law for: friction
// on a table, and linear drag. Left out: contacts, and the smoothing of drag at speeds below a millimeter per second.
// `stem`: of the files' names. The twin must be identified.
struct MujocoFiles {
  std::string model, base, player;
};
MujocoFiles mujoco(const twin::Twin& twin, const trajectory::Trajectory& base, const std::string& stem);

// The rope as URDF, links and joints named as MuJoCo's, link_0 the root. Angles with a common joint have a link
// `cross_K` between them; all its mass, and that of link_0, is taken from the next link's joint, so that the mass
// matrix is the twin's to 1e-5. Left out, and told with its size at the file's head: stiffness (which
// Gazebo reads from elements of its own), rest angles, drag, friction on a table, how friction in bending builds up,
// the motion. The twin must be identified.
std::string urdf(const twin::Twin& twin);

// The rope as a USD stage in text, z up, meters: prim `rope`, in it `link_0` with `link_1` in it and so on, in the link
// frames of mathematics.md 2.2, each with a capsule `shape` in the mean color of its Gaussians, as thick as the rope.
// The motion is time samples; time codes are its frames, counted from 0 at its rate (rounded to whole ones a second).
// Never fails: without motion the rope is at home, without Gaussians gray.
std::string usd(const twin::Twin& twin, const chain::States& motion, const trajectory::Trajectory& base);

}  // namespace chainsplat::exports
