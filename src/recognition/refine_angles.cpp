#include "src/recognition/refine_angles.h"

#include <algorithm>
#include <cmath>

#include "src/math/decompositions.h"
#include "src/splat/color_model.h"

namespace chainsplat::recognition {

namespace {

constexpr double kGradientFloor = 1e-4;  // squared image gradient below which a pixel says nothing

// Depth of the drawn surface, spread a few pixels over the silhouette's edge, where there is gradient but no depth:
// each pass gives a pixel without depth the mean of its neighbors'.
std::vector<float> spread_depth(const splat::Picture& picture) {
  constexpr int kPasses = 3;  // px: width of the soft edge of a splatted silhouette
  std::vector<float> depth = picture.depth;
  const int w = picture.width, h = picture.height;
  // calls visit(pixel) for the neighbors of pixel k
  const auto each_neighbor = [&](int k, const auto& visit) {
    const int x = k % w, y = k / w;
    for (int v = std::max(0, y - 1); v <= std::min(h - 1, y + 1); ++v)
      for (int u = std::max(0, x - 1); u <= std::min(w - 1, x + 1); ++u)
        if (v * w + u != k) visit(v * w + u);
  };
  // only beside pixels that got their depth in the pass before is there something to do
  std::vector<int> edge;
  for (int y = 0, k = 0; y < h; ++y)
    for (int x = 0; x < w; ++x, ++k) {
      if (depth[k] <= 0) continue;
      const bool inside = x > 0 && y > 0 && x < w - 1 && y < h - 1 && depth[k - 1] > 0 && depth[k + 1] > 0 &&
                          depth[k - w] > 0 && depth[k + w] > 0 && depth[k - w - 1] > 0 && depth[k - w + 1] > 0 &&
                          depth[k + w - 1] > 0 && depth[k + w + 1] > 0;
      if (!inside) edge.push_back(k);
    }
  std::vector<char> taken(depth.size(), 0);
  for (int pass = 0; pass < kPasses; ++pass) {
    std::vector<int> next;
    for (const int k : edge)
      each_neighbor(k, [&](int n) {
        if (depth[n] > 0 || taken[n]) return;
        taken[n] = 1;
        next.push_back(n);
      });
    std::vector<float> means;
    for (const int k : next) {
      float sum = 0;
      int count = 0;
      each_neighbor(k, [&](int n) {
        if (depth[n] <= 0) return;
        sum += depth[n];
        ++count;
      });
      means.push_back(sum / static_cast<float>(count));
    }
    for (std::size_t i = 0; i < next.size(); ++i) depth[next[i]] = means[i];
    edge = std::move(next);
  }
  return depth;
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
  const splat::LinkAxes axes = splat::link_axes(chain, motions);
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
        const double scale = (c == 3 ? mask_weight : 1.0) / shared::kColorNoise;  // large residuals count as they are
        const double residual = shown[4 * k + c] - wanted[4 * k + c] * kByte;
        const double weight = scale * splat::color_weight(residual);
        out.cost += scale * splat::color_loss(residual);
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
      const math::Vector3 point = splat::surface_point(camera, view.x0 + x + 0.5, view.y0 + y + 0.5, depth[k]);
      const int link = splat::nearest_link(axes, camera.world_from_camera * point);
      const Eigen::Matrix<double, 2, 6> flow = splat::pixel_motion(camera, point);
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
  solve::Descent descent;
  solve::NormalEquations equations;  // about descent.x
};

solve::Options solver_options(const RefineOptions& options) {
  solve::Options out;
  out.steps = solve::Options::kAny;
  out.trials = options.iterations;
  out.trusted = options.trusted;
  out.negligible = 2e-5;  // rad: 6 micrometers at the end of a 30 cm rope
  out.longest = 0.3;      // rad: beyond it the linearization means nothing
  out.damping.first = 0.3 * 1e-3;
  out.damping.lower = 0.3;
  out.damping.least = 1e-6;
  return out;
}

}  // namespace

Refined refine_angles(const chain::Chain& chain, const capture::Capture& capture, const std::vector<FrameViews>& frames,
                      std::span<const int> selected, const Draw& draw, const RefineOptions& options,
                      const AnglePrior& prior, chain::States& states) {
  const solve::Options solver = solver_options(options);
  std::vector<FrameState> work(selected.size());
  for (std::size_t f = 0; f < selected.size(); ++f) work[f].descent = solve::begin(states.theta[selected[f]], solver);
  const math::MatrixX alike =
      chain::curvature_information(chain, chain::neighbor_difference(chain, options.smooth_sigma));

  for (;;) {
    // draw every trial
    std::vector<int> views;
    std::vector<std::vector<math::Pose>> motions;
    for (std::size_t f = 0; f < selected.size(); ++f) {
      if (work[f].descent.done) continue;
      for (const int v : frames[selected[f]].views) {
        views.push_back(v);
        motions.push_back(view_motions(chain, capture, states, frames[selected[f]], selected[f], work[f].descent.trial,
                                       capture.views[v]));
      }
    }
    if (views.empty()) break;
    const std::vector<splat::Picture> pictures = draw(views, motions);
    std::vector<LinkEquations> equations(views.size());
    core::parallel_for(static_cast<std::int64_t>(views.size()), [&](std::int64_t s) {
      const capture::View view = capture::unpacked(capture.views[views[s]]);
      equations[s] =
          link_equations(chain, capture.cameras[view.camera], view, motions[s], pictures[s], options.mask_weight);
    });
    // one Levenberg-Marquardt decision per frame
    std::size_t s = 0;
    for (std::size_t f = 0; f < selected.size(); ++f) {
      FrameState& state = work[f];
      solve::Descent& descent = state.descent;
      if (descent.done) continue;
      const int n = chain.angles();
      solve::NormalEquations next{math::MatrixX::Zero(n, n), math::VectorX::Zero(n)};
      double cost = 0.0;
      for (const int v : frames[selected[f]].views) {
        const LinkEquations& view_equations = equations[s];
        const math::MatrixX axes = chain::world_axes(chain, descent.trial, capture.base.pose(capture.views[v].time));
        for (int j = 1; j < chain.links(); ++j) {
          const int columns = chain.last_angle(j) + 1;
          const auto moved = axes.leftCols(columns);
          next.matrix.topLeftCorner(columns, columns).noalias() += moved.transpose() * view_equations.normal[j] * moved;
          next.gradient.head(columns).noalias() += moved.transpose() * view_equations.right[j];
        }
        cost += view_equations.cost;
        ++s;
      }
      const math::VectorX bends = alike * descent.trial;
      cost += 0.5 * descent.trial.dot(bends);
      next.matrix += alike;
      next.gradient += bends;
      if (!prior.mean.empty()) {
        const math::VectorX away = descent.trial - prior.mean[selected[f]];
        const math::VectorX pull = prior.information[selected[f]] * away;
        cost += 0.5 * away.dot(pull);
        next.matrix += prior.information[selected[f]];
        next.gradient += pull;
      }
      if (solve::judge(descent, cost, solver)) state.equations = std::move(next);
      if (descent.done) continue;
      const auto step = [&](double damping, math::VectorX& move) {
        math::MatrixX damped = state.equations.matrix;
        damped.diagonal() *= 1.0 + damping;
        // an angle that no view shows has no row
        damped.diagonal().array() += 1e-9 * (1.0 + state.equations.matrix.diagonal().maxCoeff());
        move = -damped.ldlt().solve(state.equations.gradient);
        return true;
      };
      solve::propose(descent, step, solver);
    }
  }
  Refined out;
  std::vector<solve::Summary> summaries;
  for (std::size_t f = 0; f < selected.size(); ++f) {
    states.theta[selected[f]] = work[f].descent.x;
    summaries.push_back(work[f].descent.summary);
    out.steps += work[f].descent.taken;
    const math::MatrixX& normal = work[f].equations.matrix;
    const math::MatrixX unit = math::MatrixX::Identity(chain.angles(), chain.angles());
    out.covariances.push_back(normal.size() > 0 ? math::MatrixX((normal + 1e-6 * unit).inverse()) : unit);
    // where a part of the rope is hardly seen, elimination without symmetry loses the sign of small variances
    if (!math::is_covariance(out.covariances.back()))
      out.covariances.back() = math::MatrixX(normal + 1e-6 * unit).ldlt().solve(unit);
  }
  out.summary = solve::together(summaries);
  return out;
}

}  // namespace chainsplat::recognition
