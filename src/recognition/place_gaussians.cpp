#include "src/recognition/place_gaussians.h"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "chainsplat/image_model.h"
#include "src/math/decompositions.h"

namespace chainsplat::recognition {

namespace {

constexpr float kOwnLinkLogit = 12.0f;  // softmax of 12 against zeros: other links below 1/255 by far
constexpr double kShell = 0.75;         // of the radius, where Gaussians start: most of what is seen is the surface
constexpr double kCoverage = 0.55;      // sigma in units of the spacing on the shell: neighbors overlap
constexpr float kStartOpacity = 2.0f;   // logit, 0.88: ropes are opaque
constexpr double kFacing = 0.35;        // least cosine between surface normal and view ray for a color sample
constexpr float kLeastOpacity = -3.9f;  // logit, 0.02
constexpr double kLargest = 1.5;        // of the rope's diameter: a larger Gaussian explains something else

void set_gaussian(splat::Gaussians& g, int i, const math::Vector3& mean, double sigma, float opacity,
                  const math::Vector3& color, int link) {
  for (int c = 0; c < 3; ++c) {
    g.mean[3 * i + c] = static_cast<float>(mean[c]);
    g.log_scale[3 * i + c] = static_cast<float>(std::log(sigma));
  }
  splat::set_base_color(g, i, color);
  g.opacity_logit[i] = opacity;
  for (int j = 0; j < g.links; ++j) g.link_logits[g.links * i + j] = j == link ? kOwnLinkLogit : 0.0f;
}

// Color under a crop pixel position; false outside the object.
bool sample(const capture::View& view, const math::Vector2& image_pixel, math::Vector3& color) {
  const int x = static_cast<int>(std::floor(image_pixel.x())) - view.x0;
  const int y = static_cast<int>(std::floor(image_pixel.y())) - view.y0;
  if (x < 0 || y < 0 || x >= view.width || y >= view.height) return false;
  const std::uint8_t* p = &view.rgba[4 * (static_cast<std::size_t>(y) * view.width + x)];
  if (p[3] < image_model::kObjectMask) return false;
  color = math::Vector3(p[0], p[1], p[2]) / 255.0;
  return true;
}

}  // namespace

splat::Gaussians place_along_chain(const chain::Chain& chain, const capture::Capture& capture,
                                   const chain::States& states, const std::vector<FrameViews>& frames,
                                   std::span<const int> training, const splat::Light& light, int count,
                                   core::Random& random) {
  splat::Gaussians g;
  g.resize(count, chain.links(), 0);
  g.light = light;
  const double radius = 0.5 * chain.diameter * kShell;
  const double spacing = std::sqrt(2.0 * std::numbers::pi * radius * chain.length / count);
  const math::Vector3 side = chain.bending_axis, other = chain.direction.cross(chain.bending_axis);

  math::Vector3 mean_color = math::Vector3::Constant(0.5);
  std::vector<math::Vector3> sums(count, math::Vector3::Zero());  // of the colors seen
  std::vector<double> weights(count, 0.0);
  std::vector<math::Vector3> means(count), normals(count);
  std::vector<int> links(count);
  // golden-angle spiral along the tube: even coverage; jitter breaks the pattern
  constexpr double kGoldenAngle = 2.399963229728653;
  for (int i = 0; i < count; ++i) {
    const double arclength = chain.length * (i + random.uniform()) / count;
    const double angle = kGoldenAngle * i + random.uniform(-0.3, 0.3);
    normals[i] = std::cos(angle) * side + std::sin(angle) * other;
    means[i] = arclength * chain.direction + radius * normals[i];
    links[i] = chain::link_at(chain, std::min(arclength, chain.length * (1.0 - 1e-9)));
  }
  for (const int k : training) {
    for (const int v : frames[k].views) {
      const capture::View view = capture::unpacked(capture.views[v]);
      const std::vector<math::Pose> motions = view_motions(chain, capture, states, frames[k], k, states.theta[k], view);
      const capture::Camera& camera = capture.cameras[view.camera];
      const math::Pose camera_from_world = camera.world_from_camera.inverse();
      for (int i = 0; i < count; ++i) {
        const math::Pose& motion = motions[links[i]];
        const math::Vector3 x = camera_from_world * (motion * means[i]);
        const math::Vector3 n = camera.world_from_camera.rotation.transpose() * (motion.rotation * normals[i]);
        const double facing = -n.dot(x.normalized());
        math::Vector3 color;
        if (facing < kFacing || x.z() <= 0 || !sample(view, capture::project(camera, x), color)) continue;
        sums[i] += facing / splat::brightness(light, motion.rotation * normals[i]) * color;
        weights[i] += facing;
      }
    }
  }
  math::Vector3 sum = math::Vector3::Zero();
  int seen = 0;
  for (int i = 0; i < count; ++i) {
    if (weights[i] <= 0.0) continue;
    sums[i] /= weights[i];
    sum += sums[i];
    ++seen;
  }
  if (seen > 0) mean_color = sum / seen;
  for (int i = 0; i < count; ++i)
    set_gaussian(g, i, means[i], kCoverage * spacing, kStartOpacity, weights[i] > 0.0 ? sums[i] : mean_color, links[i]);
  return g;
}

Unexplained unexplained(const capture::PackedView& packed, const splat::Picture& picture,
                        const std::vector<math::Pose>& motions) {
  // codec and sensor noise, squared, three channels: not worth a Gaussian
  constexpr double kNoise = 0.03 * 0.03 * 3;
  const capture::View view = capture::unpacked(packed);
  Unexplained out{motions, {}, {}};
  for (int k = 0; k < view.width * view.height; ++k) {
    if (view.rgba[4 * k + 3] < image_model::kObjectMask) continue;
    double error = std::pow(1.0 - picture.rgba[4 * k + 3], 2);
    for (int c = 0; c < 3; ++c) error += std::pow(picture.rgba[4 * k + c] - view.rgba[4 * k + c] / 255.0, 2);
    if (error < kNoise) continue;
    out.pixels.push_back(k);
    out.errors.push_back(error);
  }
  return out;
}

Changed add_and_prune(splat::Gaussians& gaussians, const chain::Chain& chain, const capture::Capture& capture,
                      std::span<const Drawn> drawn, int budget, int most_added, core::Random& random) {
  Changed changed;
  // prune
  std::vector<int> kept;
  const float largest = static_cast<float>(std::log(kLargest * chain.diameter));
  for (int i = 0; i < gaussians.count; ++i) {
    const float scale =
        std::max({gaussians.log_scale[3 * i], gaussians.log_scale[3 * i + 1], gaussians.log_scale[3 * i + 2]});
    if (gaussians.opacity_logit[i] >= kLeastOpacity && scale <= largest && std::isfinite(gaussians.mean[3 * i]))
      kept.push_back(i);
  }
  changed.removed = gaussians.count - static_cast<int>(kept.size());
  const int room = std::min(most_added, budget - static_cast<int>(kept.size()));

  // candidates: pixels of all pictures, weighted by their squared error
  std::vector<std::size_t> first;  // of each picture, among all
  std::vector<double> cumulative;
  double total = 0.0;
  for (const Drawn& one : drawn) {
    first.push_back(cumulative.size());
    for (const double error : one.left->errors) {
      total += error;
      cumulative.push_back(total);
    }
  }
  const int added = cumulative.empty() ? 0 : std::max(0, room);
  gaussians = rows_of(gaussians, kept, added);
  const double spacing = std::sqrt(std::numbers::pi * chain.diameter * chain.length / std::max(1, gaussians.count));
  int next = static_cast<int>(kept.size());
  for (int a = 0; a < added; ++a) {
    const auto at = std::lower_bound(cumulative.begin(), cumulative.end(), random.uniform() * total);
    const auto candidate = std::min<std::size_t>(at - cumulative.begin(), cumulative.size() - 1);
    const std::size_t which = std::upper_bound(first.begin(), first.end(), candidate) - first.begin() - 1;
    const Drawn& source = drawn[which];
    const int pixel = source.left->pixels[candidate - first[which]];
    const capture::View view = capture::unpacked(*source.view);
    const capture::Camera& camera = capture.cameras[view.camera];
    const int column = pixel % view.width, row = pixel / view.width;
    const math::Vector3 ray((view.x0 + column + 0.5 - camera.cx) / camera.fx,
                            (view.y0 + row + 0.5 - camera.cy) / camera.fy, 1.0);
    const math::Vector3 origin = camera.world_from_camera.translation;
    const math::Vector3 along = (camera.world_from_camera.rotation * ray).normalized();
    // the point of the ray nearest to the centerline, moved to the tube's near side
    const std::vector<math::Pose>& motions = source.left->motions;
    double best = std::numeric_limits<double>::infinity();
    math::Vector3 point = origin;
    int link = 1;
    for (int j = 1; j < chain.links(); ++j) {
      const math::Vector3 a0 = motions[j] * (chain.link_start(j) * chain.direction);
      const math::Vector3 u = motions[j].rotation * chain.direction;
      const double length = chain.link_end(j) - chain.link_start(j);
      // closest points of a ray and a segment
      const math::Vector3 w = origin - a0;
      const double b = along.dot(u), d = along.dot(w), e = u.dot(w), det = std::max(1e-12, 1.0 - b * b);
      const double s = std::clamp((e - b * d) / det, 0.0, length);
      const double t = (a0 + s * u - origin).dot(along);
      const double distance = (origin + t * along - a0 - s * u).norm();
      if (distance < best) {
        best = distance;
        link = j;
        const double half = 0.5 * chain.diameter * kShell;
        point = origin + (t - std::sqrt(std::max(0.0, half * half - distance * distance))) * along;
      }
    }
    constexpr double kReach = 1.2;  // of the radius: farther from the chain it is not rope
    if (best > kReach * 0.5 * chain.diameter) continue;
    const std::uint8_t* p = &view.rgba[4 * static_cast<std::size_t>(pixel)];
    constexpr float kNewOpacity = 0.0f;  // logit: half
    const math::Vector3 color = math::Vector3(p[0], p[1], p[2]) / 255.0;
    set_gaussian(gaussians, next, motions[link].inverse() * point, 0.5 * kCoverage * spacing, kNewOpacity, color, link);
    splat::set_base_color(gaussians, next, color / splat::brightness(gaussians, next, motions[link].rotation));
    ++next;
  }
  changed.added = next - static_cast<int>(kept.size());
  gaussians.resize(next, gaussians.links, gaussians.degree);
  return changed;
}

namespace {

math::Matrix3 root_of_covariance(const splat::Gaussians& gaussians, int i) {
  const float* q = &gaussians.rotation[4 * i];
  math::Matrix3 root = Eigen::Quaterniond(q[0], q[1], q[2], q[3]).normalized().toRotationMatrix();
  for (int c = 0; c < 3; ++c) root.col(c) *= std::exp(static_cast<double>(gaussians.log_scale[3 * i + c]));
  return root;
}

void set_covariance(splat::Gaussians& gaussians, int i, const math::Matrix3& root) {
  const Eigen::SelfAdjointEigenSolver<math::MatrixX> found(math::MatrixX(root * root.transpose()));
  math::Matrix3 axes = found.eigenvectors();
  if (axes.determinant() < 0.0) axes.col(0) *= -1.0;
  const Eigen::Quaterniond turn(axes);
  const double wxyz[4] = {turn.w(), turn.x(), turn.y(), turn.z()};
  for (int c = 0; c < 4; ++c) gaussians.rotation[4 * i + c] = static_cast<float>(wxyz[c]);
  for (int c = 0; c < 3; ++c)
    gaussians.log_scale[3 * i + c] = static_cast<float>(0.5 * std::log(std::max(found.eigenvalues()[c], 1e-12)));
}

// Compresses a Gaussian along a unit direction to this standard deviation; false where it has no more.
bool compress(const math::Vector3& direction, double most, math::Matrix3& root) {
  const double sigma = (root.transpose() * direction).norm();
  if (sigma <= most) return false;
  root += (most / sigma - 1.0) * direction * (direction.transpose() * root);
  return true;
}

}  // namespace

void bound_gaussians(const chain::Chain& chain, splat::Gaussians& gaussians, double past, const Radii* radii) {
  constexpr double kWidths = 2.0;  // standard deviations that count as a Gaussian's reach along the rope,
  constexpr double kAcross = 1.0;  // and across it, where it fades into the outline
  constexpr double kWider = 1.1;   // of the rope's radius: how far it may reach, and
  constexpr double kFlat = 0.15;   // what of that its deviation across may be, however far out it is
  for (int i = 0; i < gaussians.count; ++i) {
    splat::set_base_color(gaussians, i, splat::base_color(gaussians, i).cwiseMax(0.0).cwiseMin(1.0));
    const math::Vector3 mean(gaussians.mean[3 * i], gaussians.mean[3 * i + 1], gaussians.mean[3 * i + 2]);
    const double s = mean.dot(chain.direction);
    float* logits = &gaussians.link_logits[static_cast<std::size_t>(gaussians.links) * i];
    const int own = splat::surest_link(gaussians, i);
    const int link = std::clamp(chain::link_at(chain, s), 1, gaussians.links - 1);
    std::swap(logits[own], logits[link]);

    math::Matrix3 root = root_of_covariance(gaussians, i);
    const double before = link > 1 ? s - chain.link_start(link) : chain.length;
    const double after = link + 1 < gaussians.links ? chain.link_end(link) - s : chain.length;
    bool changed = compress(chain.direction, (past + std::min(before, after)) / kWidths, root);
    const math::Vector3 off = mean - s * chain.direction;
    if (const double from_axis = off.norm(); radii && from_axis > 0.0) {
      const math::Vector3 outward = off / from_axis;
      const double most = kWider * radii->at(s);
      changed |= compress(outward, std::max(kFlat * most, (most - from_axis) / kAcross), root);
      const double inside = most - kAcross * (root.transpose() * outward).norm();
      const math::Vector3 moved = s * chain.direction + std::min(from_axis, inside) * outward;
      for (int c = 0; c < 3; ++c) gaussians.mean[3 * i + c] = static_cast<float>(moved[c]);
    }
    if (changed) set_covariance(gaussians, i, root);
  }
}

}  // namespace chainsplat::recognition
