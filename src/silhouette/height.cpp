// How far a rope on a table lies beside the plane in which its grasp moves.
#include <algorithm>
#include <cmath>

#include "src/silhouette/correction_equations.h"
#include "src/silhouette/frame.h"

namespace chainsplat::silhouette {

using math::VectorX;

namespace {

constexpr std::size_t kMostFrames = 16;
constexpr int kMostSteps = 6;
constexpr double kTried = 0.05;                      // diameters to either side of the best height so far
constexpr double kFarthest = 0.1, kNearest = 0.005;  // diameters: of one step, and of the last one
constexpr double kFar = 0.25;                        // diameters, from which on the first height is not the only start
// Bending stiffness over weight per length times the cube of the length: where between the grasp and the table a rope
// lies down depends on its fourth root only.
constexpr double kSoftness = 0.006;

// Arclength at which a rope that lies so far beside the plane of its grasp has come down to the table, m.
double until(const chain::Chain& chain, double height, double reach = 1.0) {
  return reach * std::pow(72.0 * kSoftness * std::pow(chain.length, 3) * std::abs(height), 0.25);
}

// Of a link's middle, as a share of `until`. The first link leaves the grasp in its plane.
double place(const chain::Chain& chain, int link, double until) {
  if (link == 0) return 0.0;
  const double middle = 0.5 * (chain.link_start(link) + chain.link_end(link));
  return middle < until ? middle / until : 1.0;
}

}  // namespace

std::vector<double> lying_down(const chain::Chain& chain, double height, double reach) {
  if (height == 0.0) return {};
  std::vector<double> out;
  for (int link = 0; link < chain.links(); ++link) {
    const double x = place(chain, link, until(chain, height, reach));
    out.push_back(height * x * x * (6.0 - 8.0 * x + 3.0 * x * x));
  }
  return out;
}

double lying_slope(const chain::Chain& chain, double height, int link) {
  const double x = place(chain, link, until(chain, height));
  return x * x * (3.0 - 2.0 * x);
}

std::optional<Lying> lying_on_table(const capture::Capture& capture) {
  constexpr double kHighest = 0.3;  // lengths of rope above the table: a rope that is held higher hangs
  constexpr double kAbove = 1.0;    // diameters that a table may be given too high
  if (!capture.tabletop || !capture.table || capture.base.samples().empty()) return std::nullopt;
  const math::Pose grasp = capture.base.pose(capture.base.start());
  const double above = capture.table->normal.dot(grasp.translation - capture.table->point) - 0.5 * capture.diameter;
  if (above > kHighest * capture.length || above < -kAbove * capture.diameter) return std::nullopt;
  return Lying{-above * (grasp.rotation * capture.bending_axis).dot(capture.table->normal),
               grasp.rotation.transpose() * capture.table->normal};
}

double height_by_table(const capture::Capture& capture) {
  const std::optional<Lying> lying = lying_on_table(capture);
  return lying ? lying->height : 0.0;
}

double height_with(const chain::Chain& chain, const Lying& lying, const math::Vector3& grasp_shift,
                   double table_shift) {
  const double up = chain.bending_axis.dot(lying.normal);  // 1, or -1 where the axis points into the table
  return lying.height - up * (lying.normal.dot(grasp_shift) - table_shift);
}

double fit_height(const chain::Chain& chain, const capture::Capture& capture, const SequenceFit& fit, double first) {
  const Frames frames = frames_of(capture);
  std::vector<std::size_t> seen;
  for (std::size_t f = 0; f < fit.frames.size(); ++f)
    if (fit.frames[f].residual_pixels > 0.0 && frames.views[f].size() > 1) seen.push_back(f);
  if (seen.empty()) return first;  // one camera alone sees it as turns of the joints
  std::vector<std::size_t> chosen;
  const std::size_t count = std::min(kMostFrames, seen.size());
  for (std::size_t i = 0; i < count; ++i) chosen.push_back(seen[i * seen.size() / count]);

  // mean square distance of the outlines, px^2, of a rope that lies so far beside its grasp
  const auto misfit = [&](double height) {
    chain::Chain lying = chain;
    lying.lift = lying_down(chain, height);
    std::vector<double> squares(count);
    core::parallel_for(static_cast<std::int64_t>(count), [&](std::int64_t i) {
      const std::size_t f = chosen[i];
      std::vector<capture::View> views;
      for (const int v : frames.views[f]) views.push_back(capture::unpacked(capture.views[v]));
      std::vector<const capture::View*> pointers;
      for (const capture::View& view : views) pointers.push_back(&view);
      const FrameFit found =
          fit_frame(lying, capture.base.pose(frames.times[f]), pointers, capture.cameras, fit.states.theta[f], true);
      squares[i] = found.residual_pixels * found.residual_pixels;
    });
    double sum = 0.0;
    for (const double square : squares) sum += square;
    return sum / static_cast<double>(count);
  };
  const double tried = kTried * chain.diameter;
  const auto best_from = [&](double height) {
    for (int step = 0; step < kMostSteps; ++step) {
      const double below = misfit(height - tried), here = misfit(height), above = misfit(height + tried);
      const double slope = above - below, curvature = below - 2.0 * here + above;
      const double farthest = kFarthest * chain.diameter;
      const double move = curvature > 0.0 ? std::clamp(-0.5 * tried * slope / curvature, -farthest, farthest)
                                          : std::copysign(farthest, -slope);
      height += move;
      if (std::abs(move) < kNearest * chain.diameter) break;
    }
    return height;
  };
  double height = best_from(first);
  // a table that is given too low by much is as likely as a rope that is held so high
  if (std::abs(first) > kFar * chain.diameter)
    if (const double flat = best_from(0.0); misfit(flat) < misfit(height)) height = flat;
  // what is known already stays, and costs no further fit
  return std::abs(height - first) < 2.0 * kNearest * chain.diameter ? first : height;
}

}  // namespace chainsplat::silhouette
