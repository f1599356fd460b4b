// chainsplat/corrections.h - what a recording was given wrongly by a little: poses, focal lengths and clocks of its
// cameras, the clock of its base, the place of the grasp, the size of the rope (mathematics.md 6.10).
//
// silhouette::fit_corrections() estimates them together with the angles of all frames; apply() mends the capture, and
// everything downstream works on the mended one. A twin carries them, so that later work on the same cameras mends
// what it loads in the same way. Corrected = given + value. Clocks: a positive time means that the stamps are late;
// the true time is the stamp minus the value.
#pragma once
#include <string>
#include <vector>

#include "chainsplat/capture.h"

namespace chainsplat::capture {

// A kind of correction: what `subject` (a camera, "base", "grasp" or "object") may be wrong in.
struct CorrectedQuantity {
  const char* subject;  // "camera" stands for each of them
  const char* name;     // as in twin.json
  const char* group;    // by which it is held: cameras, focal, time, length, diameter, grasp, masks, colors
  const char* unit;     // rad, m, s, px or 1
  int size;             // numbers
  double deviation;     // standard deviation before anything was seen, in the unit,
  double relative;      // or as a share of the given value
  double most;          // in the unit: more in a file is no correction
};
// rotation: rotation vector of a camera in its own frame (world_from_camera's rotation times its exponential), of the
// grasp in the base frame; translation: of a camera in the world frame, of the grasp in the base frame; focal: of fx,
// with fy in proportion; mask_offset: by how much the camera's masks are wider than the rope on each side; mask_start:
// how far from the grasp along the rope its masks begin; readout: of Camera::readout, with which the frames' times move
// to their middle rows; gain, bias: recorded = (1 + gain) color + bias of red, green
// and blue, colors in 0..1.
const std::vector<CorrectedQuantity>& corrected_quantities();
// Frames of a camera, as its video counts them, before each of which it lost one: a number may stand there several
// times. The stamps of those after it are early by a frame. Known of one recording, which Correction::calibration names
// then.
const CorrectedQuantity& lost_frames();
// A recording by its Capture::hash: 16 hexadecimal digits.
std::string hash_text(std::uint64_t hash);
// The one of this name; `subject` as in CorrectedQuantity.
const CorrectedQuantity& corrected_quantity(const std::string& subject, const std::string& name);
// Its standard deviation before anything was seen, in its unit: what the capture says, or else what a careful
// laboratory reaches. 0: what is given is exact. `camera`: an index, -1 for what is not a camera's.
double prior_deviation(const Capture& capture, int camera, const CorrectedQuantity& quantity);

// free: the recording determines it. prior: it may vary, but the recording says little beyond the given value. held:
// not varied.
enum class CorrectionState { free, prior, held };
const char* name(CorrectionState state);

struct Correction {
  const CorrectedQuantity* quantity = nullptr;
  std::string subject;      // a camera's name, "base", "grasp" or "object"
  math::VectorX value;      // in the quantity's unit
  math::VectorX deviation;  // one standard deviation of `value` after the fit
  CorrectionState state = CorrectionState::held;
  std::string calibration;  // of a camera: what it was given as; another calibration is not corrected by this
};

using Corrections = std::vector<Correction>;

// What is wrong with a recording or doubtful about a twin, in plain words and as numbers. formats.md 2 lists the codes.
struct Finding {
  std::string code;         // "base-time", "camera-pose", "length", "outline-misfit", "fold", ...
  std::string subject;      // a camera's name, "base", "grasp" or "object"
  double value = 0.0;       // in `unit`
  double deviation = 0.0;   // one standard deviation, 0: none
  std::string unit;         // "ms", "deg", "mm", "%", "px", "rad"
  bool corrected = false;   // the twin is made as if it were right
  bool trusted = true;      // false: do not trust this twin
  bool impossible = false;  // a mistake in how the capture was written: no twin is made of it unless that is asked for
  int frame = -1;           // of the subject, where it shows most; -1: everywhere
  std::string text;         // one line
};

// Text of a camera's pose and focal length as given, by which a calibration is known again.
std::string calibration_text(const Camera& camera);

// Null where there is none.
const Correction* find(const Corrections& corrections, const std::string& subject, const std::string& quantity);
// The first number of a correction, 0 where there is none.
double value_of(const Corrections& corrections, const std::string& subject, const std::string& quantity);
// Whether one of them is not 0.
bool any_correction(const Corrections& corrections);

// Makes a camera's stamps later by a frame from each of these frames on.
void restore_lost(const math::VectorX& frames, int camera, Capture& capture);
// Mends poses, focal lengths and colors of the cameras, the times of cameras and views, the base's motion, and the
// rope's length and diameter. A base whose samples then end before the last frame (or begin after the first) is
// continued with its last velocity and acceleration. Views keep their pixels. Cameras without corrections stay as they
// are, and so do those that are calibrated otherwise than the corrected ones were, which is warned of.
void apply(const Corrections& corrections, Capture& capture);
// What the base's poses are multiplied by.
math::Pose grasp_in_base(const Corrections& corrections);
// A camera's pose, corrected as the quantities say.
math::Pose moved(const math::Pose& world_from_camera, const math::Vector3& rotation, const math::Vector3& translation);
// The parts of it: one camera (without its clock and readout), and a base whose clock and grasp were off.
Camera corrected(const Corrections& corrections, Camera camera);
trajectory::Trajectory corrected(const Corrections& corrections, const trajectory::Trajectory& base, double first,
                                 double last);

}  // namespace chainsplat::capture
