// The views of a frame as normal equations: the projected chain, which mask pixels and outline points see it, sums.
#pragma once
#include <vector>

#include "chainsplat/image_model.h"
#include "src/silhouette/frame.h"

namespace chainsplat::silhouette {

using image_model::kNear;

constexpr double kLeastCut = 2.5;             // px, Tukey's cut-off is this at least,
constexpr double kLargestCut = 12.0;          // px, and this at most: no outline point farther from the tube counts
constexpr double kHiddenReach = 1.5;          // diameters beside a link within which some of it is seen, if it is
constexpr double kLinkOffsetDeviation = 0.2;  // px, of a link's outline in one view about the common offset

// Tukey's cut-off that residuals of these absolute sizes call for (reorders them): 95 % efficient on Gaussian ones.
inline double robust_cut(std::vector<double>& sizes) {
  constexpr double kTukey = 4.685;               // standard deviations
  constexpr double kDeviationOfMedian = 1.4826;  // standard deviation over the median of absolute values
  return kTukey * kDeviationOfMedian * math::median(sizes);
}

using Vector9 = Eigen::Matrix<double, 9, 1>;
using Matrix9 = Eigen::Matrix<double, 9, 9>;

// One link's segment seen by one camera.
struct Segment {
  int link = 0;
  math::Vector3 a, b;        // camera frame, m
  Vector2 from, step;        // px: image of a, and from there to the image of b
  Vector2 tangent, normal;   // unit
  double per_length2 = 0.0;  // 1 / |step|^2
  bool hidden = false;       // ViewWork::hidden
};
// Sets where it lies, m in the camera frame, and its image; both ends are in front of the camera.
void place(Segment& segment, const capture::Camera& camera, const math::Vector3& a, const math::Vector3& b);

// Normal equations of one view by link, in camera coordinates: a row is (x cross g, g, derivatives by the edge offset
// and by the mask's shift in x and y), mathematics.md 2.3.
struct LinkSums {
  std::vector<Matrix9> normal;
  std::vector<Vector9> right;
};

struct ViewWork {
  const FrameView* view = nullptr;
  math::Pose camera_from_base;
  std::vector<Segment> segments;
  LinkSums sums;
  std::vector<char> active;         // by blob
  std::vector<char> hidden;         // by link: no mask shows it, so that no outline is its own; empty: not known
  Vector2 shift = Vector2::Zero();  // px, by which the mask is thought to be shifted
  double diameter = 0.0;            // px, at the depth of the base
};

struct Problem {
  const chain::Chain* chain = nullptr;
  std::vector<ViewWork> views;
  std::vector<char> held;  // by angle: twist, which silhouettes do not show
  math::MatrixX axes;      // 6 x n in the base frame, at the angles of the last pose()
  bool shifts = false;     // the masks' shifts are unknowns too
  // Unknowns: the angles, with `shifts` two a view, the edge offset.
  int unknowns() const { return chain->angles() + (shifts ? 2 * static_cast<int>(views.size()) : 0) + 1; }
  math::MatrixX normal;
  math::VectorX right;
  std::vector<double> sizes;  // work space; after fine_equations the residuals' absolute values, px
};

struct FineSums {
  double weighted_square = 0.0, weight = 0.0;  // of the residuals, px^2
  double capped_square = 0.0, length = 0.0;    // of all outline points, those without a place too, up to kLargestCut
};

// Puts the chain at theta into every view.
void pose(Problem& problem, const math::VectorX& theta);

// Keeps the blobs whose median pixel is within `reach` diameters of the posed chain; without any, those at the grasp.
void choose_blobs(Problem& problem, double reach);

// Finds the links that something hides from each view: where the posed chain covers nearly all of a mask to `reach`
// diameters or `least` px, whichever is more, no mask lies within that beside a hidden link. Elsewhere the chain may be
// off, and nothing is known of what is hidden.
void find_hidden(Problem& problem, double reach, double least);

// Equations of the posed chain in `problem.normal` and `.right`. Coarse: mask pixels and centerline samples, Huber cut.
void coarse_equations(Problem& problem, double cut);
// Fine: outline points about masks wider by `offset` than the tube, Tukey's cut; residuals' sizes in `problem.sizes`.
FineSums fine_equations(Problem& problem, double offset, double cut);

// Cost and shares of the posed chain (FrameSolution::cost, mask_pixels; FrameFit::covered, inside).
void judge(const Problem& problem, FrameSolution& out);

}  // namespace chainsplat::silhouette
