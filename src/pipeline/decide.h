// decide.h - which of all that may be given wrongly explains what the outlines show.
#pragma once
#include <array>
#include <optional>
#include <string>
#include <vector>

#include "chainsplat/correction_fit.h"

namespace chainsplat::pipeline {

// Pixel centers are counted from (0, 0) by most other tools: what is added to cx and cy to take that back, or the
// opposite of it, px.
inline constexpr std::array kHalfPixels = {0.5, -0.5};

// What is corrected, and by which fit.
struct Decision {
  silhouette::CorrectionFit fit;
  bool corrected = false;   // by what it found; else nothing is, but for the next two
  bool half_pixel = false;  // by this alone
  double doubt = 0.0;       // where nothing is: how likely it is, 0 to 1, that something has to be, by the fit
  std::optional<capture::Correction> shift;  // beside what it found: of table or grasp
};

// None: the rope is held above its table, or may be. `sequence` is fitted to `chain`. The decision's `fit` has in
// evidence_after how well each of kHalfPixels explains all.
std::optional<Decision> decide(const capture::Capture& capture, const chain::Chain& chain,
                               const silhouette::SequenceFit& sequence, const silhouette::CorrectionOptions& options);

// The one thing that explains what is wrong; null where nothing is, or where it takes more. Of those that may be
// mistaken for each other it is the likeliest.
const silhouette::Cause* single_cause(const silhouette::CorrectionFit& fit, bool tabletop);

// Turns of all cameras that shift their images by `shift` px to the right and down, as a larger cx and cy would.
capture::Corrections shifted_images(const capture::Capture& given, double shift);

// m that a rope which lies on its table is held above (or below) it by what was given. None: hardly any, or so much
// that corrections would make up for how a rope is assumed to come down.
std::optional<double> given_above_table(const capture::Capture& capture);

bool is_fixed(const std::vector<std::string>& fixed, const char* group);

}  // namespace chainsplat::pipeline
