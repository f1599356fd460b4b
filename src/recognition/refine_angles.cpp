#include "src/recognition/refine_angles.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace chainsplat::recognition {

namespace {

constexpr double kNoise = 0.04;  // intensity below which a residual counts as noise (quadratic), above: absolute
constexpr double kGradientFloor = 1e-4;  // squared image gradient below which a pixel says nothing

// Depth of the drawn surface, spread a few pixels over the silhouette's edge, where there is gradient but no depth.
std::vector<float> spread_depth(const splat::Picture& picture) {
  constexpr int kPasses = 3;  // px: width of the soft edge of a splatted silhouette
  std::vector<float> depth = picture.depth;
  const int w = picture.width, h = picture.height;
  for (int pass = 0; pass < kPasses; ++pass) {
    std::vector<float> next = depth;
    for (int y = 0; y < h; ++y) {
      for (int x = 0; x < w; ++x) {
        if (depth[y * w + x] > 0) continue;
        float sum = 0;
        int count = 0;
        for (int dy = -1; dy <= 1; ++dy) {
          for (int dx = -1; dx <= 1; ++dx) {
            if (x + dx < 0 || y + dy < 0 || x + dx >= w || y + dy >= h) continue;
            const float d = depth[(y + dy) * w + x + dx];
            if (d > 0) {
              sum += d;
              ++count;
            }
          }
        }
        if (count > 0) next[y * w + x] = sum / static_cast<float>(count);
      }
    }
    depth = std::move(next);
  }
  return depth;
}

// Charbonnier-like: quadratic below kNoise, absolute above; returns the weight, adds to the cost.
double robust(double residual, double& cost) {
  const double size = std::abs(residual);
  if (size <= kNoise) {
    cost += 0.5 * residual * residual / kNoise;
    return 1.0 / kNoise;
  }
  cost += size - 0.5 * kNoise;
  return 1.0 / size;
}

}  // namespace

LinkEquations link_equations(const chain::Chain& chain, const capture::Camera& camera, const capture::View& view,
                             const std::vector<math::Pose>& motions, const splat::Picture& picture,
                             double mask_weight) {
  LinkEquations out;
  out.normal.assign(chain.links(), math::Matrix6::Zero());
  out.right.assign(chain.links(), math::Vector6::Zero());
  const int w = picture.width, h = picture.height;
  const std::vector<float> depth = spread_depth(picture);
  const math::Pose camera_from_world = camera.world_from_camera.inverse();
  std::vector<math::Vector3> start(chain.links()), along(chain.links());
  for (int j = 0; j < chain.links(); ++j) {
    start[j] = motions[j] * (chain.link_start(j) * chain.direction);
    along[j] = motions[j].rotation * chain.direction;
  }
  const float* shown = picture.rgba.data();
  const std::uint8_t* wanted = view.rgba.data();
  constexpr float kByte = 1.0f / 255.0f;
  for (int y = 0; y < h; ++y) {
    for (int x = 0; x < w; ++x) {
      const int k = y * w + x;
      if (shown[4 * k + 3] < 1e-4f && wanted[4 * k + 3] == 0) continue;
      // residuals and weights of the four channels; gradient: mean of drawn and seen picture (second-order accurate
      // step)
      math::Vector2 right = math::Vector2::Zero();
      double gxx = 0, gxy = 0, gyy = 0;
      const bool border = x == 0 || y == 0 || x == w - 1 || y == h - 1;
      for (int c = 0; c < 4; ++c) {
        const double scale = c == 3 ? mask_weight : 1.0;
        const double residual = shown[4 * k + c] - wanted[4 * k + c] * kByte;
        double cost = 0.0;
        const double weight = scale * robust(residual, cost);
        out.cost += scale * cost;
        if (border) continue;
        const double gx = 0.25 * (shown[4 * (k + 1) + c] - shown[4 * (k - 1) + c] +
                                  kByte * (wanted[4 * (k + 1) + c] - wanted[4 * (k - 1) + c]));
        const double gy = 0.25 * (shown[4 * (k + w) + c] - shown[4 * (k - w) + c] +
                                  kByte * (wanted[4 * (k + w) + c] - wanted[4 * (k - w) + c]));
        gxx += weight * gx * gx;
        gxy += weight * gx * gy;
        gyy += weight * gy * gy;
        right += weight * residual * math::Vector2(gx, gy);
      }
      if (border || gxx + gyy < kGradientFloor || depth[k] <= 0) continue;
      // surface point and its link
      const double z = depth[k];
      const math::Vector3 xc((view.x0 + x + 0.5 - camera.cx) / camera.fx * z,
                             (view.y0 + y + 0.5 - camera.cy) / camera.fy * z, z);
      const math::Vector3 xw = camera.world_from_camera * xc;
      int link = 1;
      double nearest = std::numeric_limits<double>::infinity();
      for (int j = 1; j < chain.links(); ++j) {
        const math::Vector3 from = xw - start[j];
        const double s = std::clamp(from.dot(along[j]), 0.0, chain.link_end(j) - chain.link_start(j));
        const double distance = (from - s * along[j]).squaredNorm();
        if (distance < nearest) {
          nearest = distance;
          link = j;
        }
      }
      // flow = P [w; v], P = dpi/dx R_cw [-[x], I]
      Eigen::Matrix<double, 2, 3> projection;
      projection << camera.fx / z, 0, -camera.fx * xc.x() / (z * z), 0, camera.fy / z, -camera.fy * xc.y() / (z * z);
      const Eigen::Matrix<double, 2, 3> by_point = projection * camera_from_world.rotation;
      Eigen::Matrix<double, 2, 6> flow;
      flow.leftCols<3>() = -by_point * math::hat(xw);
      flow.rightCols<3>() = by_point;
      Eigen::Matrix2d gradient;
      gradient << gxx, gxy, gxy, gyy;
      // dI^/dxi = -grad . flow
      out.normal[link].noalias() += flow.transpose() * (gradient * flow);
      out.right[link].noalias() -= flow.transpose() * right;
    }
  }
  return out;
}

namespace {

struct FrameState {
  math::VectorX theta, trial;
  math::MatrixX normal;
  math::VectorX right;
  double cost = std::numeric_limits<double>::infinity();
  double damping = 1e-3;
  bool done = false;
};

double smoothness(const chain::Chain& chain, const math::VectorX& theta, double sigma, math::MatrixX* normal,
                  math::VectorX* right) {
  // differences of neighboring joints' angles about the same axis direction
  const int a_joint = chain.angles() / (chain.links() - 1);
  const double weight = 1.0 / (sigma * sigma);
  double cost = 0.0;
  for (int k = a_joint; k < chain.angles(); ++k) {
    const double difference = theta[k] - theta[k - a_joint];
    cost += 0.5 * weight * difference * difference;
    if (!normal) continue;
    (*normal)(k, k) += weight;
    (*normal)(k - a_joint, k - a_joint) += weight;
    (*normal)(k, k - a_joint) -= weight;
    (*normal)(k - a_joint, k) -= weight;
    (*right)[k] += weight * difference;
    (*right)[k - a_joint] -= weight * difference;
  }
  return cost;
}

}  // namespace

RefineSummary refine_angles(const chain::Chain& chain, const capture::Capture& capture,
                            const std::vector<FrameViews>& frames, std::span<const int> selected, const Draw& draw,
                            const RefineOptions& options, const AnglePrior& prior, chain::States& states) {
  RefineSummary summary;
  std::vector<FrameState> work(selected.size());
  for (std::size_t f = 0; f < selected.size(); ++f) work[f].trial = work[f].theta = states.theta[selected[f]];

  for (int iteration = 0; iteration <= options.iterations; ++iteration) {
    // draw every trial
    std::vector<int> views;
    std::vector<std::vector<math::Pose>> motions;
    for (std::size_t f = 0; f < selected.size(); ++f) {
      if (work[f].done) continue;
      for (const int v : frames[selected[f]].views) {
        views.push_back(v);
        motions.push_back(
            view_motions(chain, capture, states, frames[selected[f]], selected[f], work[f].trial, capture.views[v]));
      }
    }
    if (views.empty()) break;
    const std::vector<splat::Picture> pictures = draw(views, motions);
    std::vector<LinkEquations> equations(views.size());
    core::parallel_for(static_cast<std::int64_t>(views.size()), [&](std::int64_t s) {
      const capture::View& view = capture.views[views[s]];
      equations[s] =
          link_equations(chain, capture.cameras[view.camera], view, motions[s], pictures[s], options.mask_weight);
    });
    // one Levenberg-Marquardt decision a frame
    std::size_t s = 0;
    for (std::size_t f = 0; f < selected.size(); ++f) {
      FrameState& state = work[f];
      if (state.done) continue;
      const int n = chain.angles();
      math::MatrixX normal = math::MatrixX::Zero(n, n);
      math::VectorX right = math::VectorX::Zero(n);
      double cost = 0.0;
      for (const int v : frames[selected[f]].views) {
        const LinkEquations& view_equations = equations[s];
        const math::MatrixX axes = chain::world_axes(chain, state.trial, capture.base.pose(capture.views[v].time));
        for (int j = 1; j < chain.links(); ++j) {
          const int columns = chain.last_angle(j) + 1;
          const auto moved = axes.leftCols(columns);
          normal.topLeftCorner(columns, columns).noalias() += moved.transpose() * view_equations.normal[j] * moved;
          right.head(columns).noalias() += moved.transpose() * view_equations.right[j];
        }
        cost += view_equations.cost;
        ++s;
      }
      cost += smoothness(chain, state.trial, options.smooth_sigma, &normal, &right);
      if (!prior.mean.empty()) {
        const math::VectorX away = state.trial - prior.mean[selected[f]];
        const math::VectorX pull = prior.information[selected[f]] * away;
        cost += 0.5 * away.dot(pull);
        normal += prior.information[selected[f]];
        right += pull;
      }
      if (iteration == 0) summary.cost_before += cost;
      const bool better = cost < state.cost;
      if (better) {
        if (iteration > 0) ++summary.accepted;
        state.theta = state.trial;
        state.cost = cost;
        state.normal = normal;
        state.right = right;
        state.damping = std::max(1e-6, 0.3 * state.damping);
      } else {
        ++summary.rejected;
        state.damping *= 10.0;
      }
      math::MatrixX damped = state.normal;
      damped.diagonal() *= 1.0 + state.damping;
      damped.diagonal().array() += 1e-9 * (1.0 + state.normal.diagonal().maxCoeff());
      const math::VectorX move = -damped.ldlt().solve(state.right);
      constexpr double kConverged = 2e-5;  // rad: 6 micrometers at the end of a 30 cm rope
      constexpr double kLongest = 0.3;     // rad: beyond it the linearization means nothing
      const double longest = move.lpNorm<Eigen::Infinity>();
      if (!(longest > kConverged)) state.done = true;
      state.trial = state.theta + move * std::min(1.0, kLongest / std::max(longest, 1e-12));
      if (better && !state.done && longest <= options.trusted && iteration < options.iterations) {
        ++summary.accepted;
        state.theta = state.trial;
        state.done = true;
      }
    }
  }
  for (std::size_t f = 0; f < selected.size(); ++f) {
    states.theta[selected[f]] = work[f].theta;
    summary.cost_after += work[f].cost;
    const math::MatrixX unit = math::MatrixX::Identity(chain.angles(), chain.angles());
    summary.covariances.push_back(work[f].normal.size() > 0 ? math::MatrixX((work[f].normal + 1e-6 * unit).inverse())
                                                            : unit);
    // where a part of the rope is hardly seen, elimination without symmetry loses the sign of small variances
    if (!math::is_covariance(summary.covariances.back()))
      summary.covariances.back() = (work[f].normal + 1e-6 * unit).ldlt().solve(unit);
  }
  return summary;
}

}  // namespace chainsplat::recognition
