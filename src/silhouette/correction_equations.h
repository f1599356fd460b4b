// Outlines of one frame as equations of its angles and of what the recording was given wrongly (mathematics.md 6.10).
#pragma once
#include <array>
#include <functional>
#include <vector>

#include "chainsplat/correction_fit.h"
#include "src/silhouette/outline.h"

namespace chainsplat::silhouette {

// What one view depends on beside the angles, in the order of capture::corrected_quantities().
enum SharedOfView {
  kRotation = 0,
  kTranslation = 3,
  kFocal = 6,
  kCameraTime = 7,
  kMaskOffset = 8,
  kMaskStart = 9,
  kBaseTime = 10,
  kGrasp = 11,
  kGraspRotation = 14,
  kLength = 17,
  kDiameter = 18,
  kTableHeight = 19,
  kReadout = 20,  // s, from the first row, which is read at the view's time, to the last
  kSharedOfView = 21
};
using SharedRow = Eigen::Matrix<double, kSharedOfView, 1>;

// Where the quantities of one camera's views stand among the shared unknowns, which are in units of their deviations.
struct SharedPlaces {
  std::array<int, kSharedOfView> at{};  // -1: held
  SharedRow unit = SharedRow::Zero();   // deviation of the unknown in the quantity's unit; 0: held
};

struct CorrectedFrame {
  double time = 0.0;       // s, as given
  math::VectorX thetadot;  // rad/s
  std::vector<int> views;
  std::vector<MaskPoints> masks;  // by view
};

// Equations of one frame: shared x shared, own x shared, own x own.
struct FrameEquations {
  math::MatrixX shared;
  math::VectorX shared_gradient;
  solve::ArrowEquations::Local local;
  double cost = 0.0;
  std::vector<double> sizes;  // px, residuals' absolute values
  struct Sums {
    double weight = 0.0, first = 0.0, second = 0.0;  // of the weights, times the residual, times its square
    double length = 0.0, cut = 0.0;                  // px of outline, and of it what does not count
    double start_weight = 0.0, start_first = 0.0, start_second = 0.0;  // the same of where the masks begin
    double start_speed = 0.0;                                          // of weights times px per m along the rope
    double start_bulge = 0.0;  // of weights times px by which the cut face, seen at an angle, reaches beyond its middle
  };
  std::vector<Sums> sums;  // by camera
};

struct CorrectionProblem {
  std::vector<const capture::ViewPlace*> views;
  const std::vector<capture::Camera>& cameras;
  std::function<trajectory::BaseMotion(double time)> base;
  std::vector<SharedPlaces> places;  // by camera
  int shared = 0;                    // number of shared unknowns
  std::vector<CorrectedFrame> frames;
  math::MatrixX prior;           // of the angles
  std::vector<char> held;        // by angle
  double cut = 0.0;              // px, of Tukey's loss
  double end_reach = kEndReach;  // half widths from the chain's ends within which those of the rope are sought
  std::optional<Lying> lying = {};
};

// Of a capture: what CorrectionProblem and CorrectedFrame take of its views.
std::vector<const capture::ViewPlace*> views_of(const capture::Capture& capture);
MaskPoints mask_of(const capture::Capture& capture, int view);

// The height at which a rope lies where its grasp is shifted, m, recorded base frame, and its table is higher, m, than
// they were given.
double height_with(const chain::Chain& chain, const Lying& lying, const math::Vector3& grasp_shift, double table_shift);
// How fast a link's lift changes with that height.
double lying_slope(const chain::Chain& chain, double height, int link);

// `corrections`: where the shared unknowns are now; `chain`: with the rope's size and lift there.
FrameEquations frame_equations(const CorrectionProblem& problem, const CorrectedFrame& frame,
                               const capture::Corrections& corrections, const chain::Chain& chain,
                               const math::VectorX& theta);

}  // namespace chainsplat::silhouette
