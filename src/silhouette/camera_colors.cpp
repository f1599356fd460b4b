#include "chainsplat/camera_colors.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

#include "chainsplat/core.h"
#include "chainsplat/corrections.h"
#include "chainsplat/image_model.h"
#include "src/math/decompositions.h"
#include "src/silhouette/frame.h"

namespace chainsplat::silhouette {

using math::MatrixX;
using math::Pose;
using math::Vector2;
using math::Vector3;
using math::VectorX;

namespace {

constexpr int kMostColorFrames = 40;
// Patches of the rope's surface, along it and around it: as wide as a few pixels of usual cameras, so that half a pixel
// of error hardly matters. A color is the mean over kSamples x kSamples points of its patch.
constexpr int kAlong = 48, kAround = 12, kSamples = 3;
constexpr double kEnd = 0.06;         // share of the length left out at either end, where gripper and cut face are
constexpr double kLeastFacing = 0.5;  // cosine of the angle between surface and view: grazing views show the edge
constexpr double kDark = 0.01, kBright = 0.98;  // colors beyond are cut off by the camera
constexpr int kIterations = 12;
constexpr double kCut = 4.685;  // Tukey's, of the residuals' robust deviation: highlights, shadows of the gripper
constexpr double kLeastSpread = 0.004;  // of the residuals: one step of 8 bits
// What one patch counts against the priors: neighbors share their errors.
constexpr double kSampleEvidence = 0.1;
// Highlights, and a lamp at the camera, change colors from camera to camera: on recordings whose cameras are alike
// gains of 0.02 are found, and colors that are cut off move a part of a gain into the bias.
constexpr double kModelGain = 0.03, kModelBias = 0.015;
constexpr double kExact = 1e-6;    // a prior's deviation where what is given is exact
constexpr double kTied = 1e6;      // information that ties the means over the cameras
constexpr int kRopeStretches = 8;  // of the rope, whose scatter tells what the equations do not know

// A patch's color in each camera that sees it.
struct Patch {
  int stretch = 0;
  std::vector<int> cameras;
  std::vector<Vector3> colors;
};

// The mean color of the patch in the view, if the view shows all of it; `points` and `normals` in the world frame.
bool color_of(const capture::Camera& camera, const capture::View& view, const std::vector<Vector3>& points,
              const std::vector<Vector3>& normals, Vector3& color) {
  const Pose camera_from_world = camera.world_from_camera.inverse();
  const Vector3& eye = camera.world_from_camera.translation;
  color.setZero();
  for (std::size_t i = 0; i < points.size(); ++i) {
    if (normals[i].dot((eye - points[i]).normalized()) < kLeastFacing) return false;
    const Vector3 seen = camera_from_world * points[i];
    if (seen.z() <= image_model::kNear) return false;
    // bilinear, pixel centers at +0.5
    const Vector2 at = capture::project(camera, seen) - Vector2(view.x0 + 0.5, view.y0 + 0.5);
    const int x = static_cast<int>(std::floor(at.x())), y = static_cast<int>(std::floor(at.y()));
    if (x < 0 || y < 0 || x + 1 >= view.width || y + 1 >= view.height) return false;
    const double right = at.x() - x, down = at.y() - y;
    for (const int row : {0, 1})
      for (const int column : {0, 1}) {
        const std::uint8_t* const pixel = &view.rgba[4 * (static_cast<std::size_t>(y + row) * view.width + x + column)];
        if (pixel[3] < image_model::kObjectMask) return false;
        const double weight = (column ? right : 1.0 - right) * (row ? down : 1.0 - down);
        color += weight / 255.0 * Vector3(pixel[0], pixel[1], pixel[2]);
      }
  }
  color /= static_cast<double>(points.size());
  return true;
}

// Views of one time, with the rope's pose at each view's own.
struct Moment {
  struct Seen {
    const capture::PackedView* view;
    std::vector<Pose> motions;
  };
  std::vector<Seen> seen;
};

std::vector<Patch> patches_of(const chain::Chain& chain, const capture::Capture& capture, const Moment& moment) {
  std::vector<Patch> out;
  const double length = (1.0 - 2.0 * kEnd) * chain.length / kAlong, turn = 2.0 * std::numbers::pi / kAround;
  const Vector3 across = chain.bending_axis, beside = chain.direction.cross(across);
  std::vector<capture::View> views;
  for (const Moment::Seen& seen : moment.seen) views.push_back(capture::unpacked(*seen.view));
  std::vector<Vector3> points(kSamples * kSamples), normals(points.size());
  for (int i = 0; i < kAlong; ++i)
    for (int j = 0; j < kAround; ++j) {
      Patch patch{i * kRopeStretches / kAlong, {}, {}};
      for (std::size_t v = 0; v < views.size(); ++v) {
        const Moment::Seen& seen = moment.seen[v];
        for (int a = 0; a < kSamples; ++a) {
          const double s = kEnd * chain.length + (i + (a + 0.5) / kSamples) * length;
          const int link = chain::link_at(chain, s);
          const Pose& motion = seen.motions[link];
          for (int b = 0; b < kSamples; ++b) {
            const double angle = (j + (b + 0.5) / kSamples) * turn;
            const Vector3 normal = std::cos(angle) * across + std::sin(angle) * beside;
            normals[a * kSamples + b] = motion.rotation * normal;
            points[a * kSamples + b] = motion * Vector3(s * chain.direction + 0.5 * chain.diameter * normal);
          }
        }
        Vector3 color;
        if (!color_of(capture.cameras[seen.view->camera], views[v], points, normals, color)) continue;
        patch.cameras.push_back(seen.view->camera);
        patch.colors.push_back(color);
      }
      if (patch.cameras.size() > 1) out.push_back(std::move(patch));
    }
  return out;
}

std::vector<Moment> moments_of(const chain::Chain& chain, const capture::Capture& capture,
                               const chain::States& states) {
  const Frames frames = frames_of(capture);
  const double apart = states.time.size() < 2
                           ? 0.0
                           : (states.time.back() - states.time.front()) / static_cast<double>(states.time.size() - 1);
  std::vector<Moment> all;
  for (std::size_t f = 0; f < frames.times.size(); ++f) {
    Moment moment;
    for (const int v : frames.views[f]) {
      const capture::PackedView& view = capture.views[v];
      const bool known = std::any_of(states.time.begin(), states.time.end(),
                                     [&](double time) { return std::abs(time - view.time) <= apart + 1e-9; });
      if (view.width == 0 || !known) continue;
      moment.seen.push_back({&view, {}});
    }
    if (moment.seen.size() > 1) all.push_back(std::move(moment));
  }
  std::vector<Moment> out;
  const std::size_t every = std::max<std::size_t>(1, (all.size() + kMostColorFrames - 1) / kMostColorFrames);
  for (std::size_t f = 0; f < all.size(); f += every) out.push_back(std::move(all[f]));
  for (Moment& moment : out)
    for (Moment::Seen& seen : moment.seen) {
      const double time = seen.view->time;
      seen.motions = chain::link_motions(chain, chain::interpolate(states, time), capture.base.pose(time));
    }
  return out;
}

// The unknowns of one channel are the gains less 1, then the biases.
struct Channel {
  VectorX value, deviation;
};

// Least squares with the colors of the patches, which are unknown too, eliminated from each step (Gauss-Newton).
Channel fit_channel(const std::vector<Patch>& patches, int channel, const VectorX& prior_deviation) {
  const int cameras = static_cast<int>(prior_deviation.size() / 2);
  MatrixX prior = prior_deviation.cwiseAbs2().cwiseInverse().asDiagonal();
  prior.topLeftCorner(cameras, cameras).array() += kTied;
  prior.bottomRightCorner(cameras, cameras).array() += kTied;
  VectorX x = VectorX::Zero(2 * cameras);
  double spread = 0.1;
  std::array<MatrixX, kRopeStretches> normal;
  std::array<VectorX, kRopeStretches> right;
  MatrixX covariance;
  for (int iteration = 0; iteration < kIterations; ++iteration) {
    normal.fill(MatrixX::Zero(2 * cameras, 2 * cameras));
    right.fill(VectorX::Zero(2 * cameras));
    std::vector<double> sizes;
    for (const Patch& patch : patches) {
      const int count = static_cast<int>(patch.cameras.size());
      double pull = 0.0, slope = 0.0;
      bool cut_off = false;
      for (int i = 0; i < count; ++i) {
        const double gain = 1.0 + x[patch.cameras[i]], color = patch.colors[i][channel];
        cut_off = cut_off || color < kDark || color > kBright;
        pull += gain * (color - x[cameras + patch.cameras[i]]);
        slope += gain * gain;
      }
      if (cut_off) continue;
      const double color = pull / slope;
      VectorX residual(count);
      for (int i = 0; i < count; ++i)
        residual[i] = patch.colors[i][channel] - (1.0 + x[patch.cameras[i]]) * color - x[cameras + patch.cameras[i]];
      const double size = residual.norm() / std::sqrt(count - 1.0);
      sizes.push_back(size);
      const double outside = size / (kCut * spread), inside = std::max(0.0, 1.0 - outside * outside);
      const double weight = kSampleEvidence * inside * inside / (spread * spread);
      MatrixX row = MatrixX::Zero(count, 2 * cameras);
      VectorX of_color(count);
      for (int i = 0; i < count; ++i) {
        row(i, patch.cameras[i]) = color;
        row(i, cameras + patch.cameras[i]) = 1.0;
        of_color[i] = 1.0 + x[patch.cameras[i]];
      }
      const MatrixX freed = row - of_color * (of_color.transpose() * row) / slope;
      normal[patch.stretch] += weight * row.transpose() * freed;
      right[patch.stretch] += weight * freed.transpose() * residual;
    }
    if (sizes.empty()) break;
    std::nth_element(sizes.begin(), sizes.begin() + static_cast<long>(sizes.size() / 2), sizes.end());
    spread = std::max(kLeastSpread, 1.4826 * sizes[sizes.size() / 2]);
    MatrixX sum = prior;
    VectorX pull = -prior * x;
    for (int s = 0; s < kRopeStretches; ++s) sum += normal[s], pull += right[s];
    x += sum.ldlt().solve(pull);
  }
  // what each stretch pulls is known only by the scatter between them: a jackknife
  MatrixX sum = prior;
  for (const MatrixX& one : normal)
    if (one.size() > 0) sum += one;
  covariance = sum.inverse();
  VectorX variance = covariance.diagonal().cwiseMax(0.0);
  for (int s = 0; s < kRopeStretches && normal[s].size() > 0; ++s) {
    const VectorX without = MatrixX(sum - normal[s]).ldlt().solve(right[s]);
    variance += (kRopeStretches - 1.0) / kRopeStretches * without.cwiseAbs2();
  }
  return {x, variance.cwiseSqrt()};
}

}  // namespace

CameraColors fit_camera_colors(const chain::Chain& chain, const capture::Capture& capture,
                               const chain::States& states) {
  const int cameras = static_cast<int>(capture.cameras.size());
  CameraColors out;
  out.gain = out.gain_deviation = out.bias = out.bias_deviation = Eigen::Matrix3Xd::Zero(3, cameras);
  const capture::CorrectedQuantity &gain = capture::corrected_quantity("camera", "gain"),
                                   &bias = capture::corrected_quantity("camera", "bias");
  VectorX prior(2 * cameras);
  for (int c = 0; c < cameras; ++c) {
    prior[c] = std::max(kExact, capture::prior_deviation(capture, c, gain));
    prior[cameras + c] = std::max(kExact, capture::prior_deviation(capture, c, bias));
  }
  const std::vector<Moment> moments = moments_of(chain, capture, states);
  std::vector<std::vector<Patch>> by_moment(moments.size());
  core::parallel_for(static_cast<std::int64_t>(moments.size()),
                     [&](std::int64_t m) { by_moment[m] = patches_of(chain, capture, moments[m]); });
  std::vector<Patch> patches;
  for (std::vector<Patch>& some : by_moment)
    patches.insert(patches.end(), std::make_move_iterator(some.begin()), std::make_move_iterator(some.end()));
  out.patches = static_cast<int>(patches.size());
  for (int channel = 0; channel < 3; ++channel) {
    const Channel fit = fit_channel(patches, channel, prior);
    out.gain.row(channel) = fit.value.head(cameras).array() + 1.0;
    out.bias.row(channel) = fit.value.tail(cameras);
    out.gain_deviation.row(channel) = (fit.deviation.head(cameras).array().square() + kModelGain * kModelGain).sqrt();
    out.bias_deviation.row(channel) = (fit.deviation.tail(cameras).array().square() + kModelBias * kModelBias).sqrt();
  }
  return out;
}

}  // namespace chainsplat::silhouette
