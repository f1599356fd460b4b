// judge_capture.h - what was given wrongly, and what could not be explained, said in plain words.
#pragma once
#include <string>
#include <vector>

#include "chainsplat/camera_colors.h"
#include "chainsplat/correction_fit.h"

namespace chainsplat::pipeline {

inline constexpr double kMeters = 1e3, kSeconds = 1e3;  // to mm and ms, in which findings are said
inline constexpr double kCertain = 3.0;  // standard deviations from which a correction is told as certain

// Each of these adds lines to the verdict. `given`: the capture before it was corrected; `found`: all corrections.
void judge_base_clock(const capture::Corrections& found, std::vector<capture::Finding>& verdict);
void judge_camera_clocks(const capture::Corrections& found, const capture::Capture& given,
                         std::vector<capture::Finding>& verdict);
// Poses, focal lengths and the width of masks.
void judge_cameras(const capture::Corrections& found, const capture::Capture& given,
                   std::vector<capture::Finding>& verdict);
// Of the colors in the middle of the range: a bias and a gain seldom come alone.
void judge_colors(const silhouette::CameraColors& colors, const capture::Capture& given,
                  std::vector<capture::Finding>& verdict);
// Grasp, table, length and diameter.
void judge_rope(const capture::Corrections& found, const capture::Capture& given,
                std::vector<capture::Finding>& verdict);
// Outlines that no correction explains.
void judge_outlines(const silhouette::CorrectionFit& fit, const capture::Capture& given,
                    std::vector<capture::Finding>& verdict);
// Bends of a whole stretch of rope that no rope makes: the chain is longer than what is seen, and lies double.
void judge_folds(const silhouette::CorrectionFit& fit, std::vector<capture::Finding>& verdict);
// Of all that ropes, cables and hoses are made of, air in foam and steel included.
void judge_mass(const capture::Capture& given, std::vector<capture::Finding>& verdict);
// Pictures that stand for later ones, which are left out.
void judge_repeated(const capture::Capture& given, std::vector<capture::Finding>& verdict);
// Seconds.
void judge_readout(double readout, double deviation, std::vector<capture::Finding>& verdict);
// What was found of a quantity that is held as given: a correction that is not made. No twin is trusted that goes by
// what the outlines surely contradict; colors and the width of masks move no rope.
capture::Finding not_corrected(capture::Finding found);
// The group of corrected_quantities() that a finding is of; "" of those that are about none.
std::string group_of(const capture::Finding& found);
// A grasp that is `above` meters from where the rope would lie on its table, and no outline tells which is wrong.
void judge_height(double above, std::vector<capture::Finding>& verdict);
// Meters. How such a rope comes down to its table is assumed, and nothing else could be checked.
capture::Finding held_high(double above);

// printf into a string of up to 255 characters.
std::string text(const char* format, ...) __attribute__((format(printf, 1, 2)));

}  // namespace chainsplat::pipeline
