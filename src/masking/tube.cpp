#include "src/masking/tube.h"

#include <algorithm>
#include <cmath>

#include "chainsplat/image_model.h"

namespace chainsplat::masking {

using math::Vector2;
using math::Vector3;

namespace {

constexpr double kSpacing = 0.003;  // m along the rope between the tube's samples, well below usual ropes' radius,
constexpr int kMostSamples = 4096;  // but no more samples than this in all, which bounds ropes longer than 12 m,
constexpr double kNotBelow = 0.05;  // and at least this many diameters apart, because each visits all pixels around it

}  // namespace

Axis axis(const chain::Chain& chain, const math::Pose& base, const math::VectorX& theta, const capture::Camera& camera,
          double from, double to) {
  Axis out;
  // sample the centerline
  const double spacing = std::max(kSpacing, kNotBelow * chain.diameter);
  const int count = std::max(2, static_cast<int>(std::min<double>(kMostSamples, std::ceil((to - from) / spacing))) + 1);
  std::vector<double> arclengths(count);
  for (int i = 0; i < count; ++i) arclengths[i] = from + (to - from) * i / (count - 1);
  const std::vector<math::Pose> motions = chain::link_motions(chain, theta, base);
  math::MatrixX line = chain::centerline(chain, motions, arclengths);
  for (int i = 0; i < count; ++i)
    if (arclengths[i] > chain.length) line.col(i) = motions.back() * Vector3(arclengths[i] * chain.direction);
  // project them
  const math::Pose camera_from_world = camera.world_from_camera.inverse();
  for (int i = 0; i < count; ++i) {
    const Vector3 p = camera_from_world * Vector3(line.col(i));
    if (p.z() < image_model::kNear) continue;
    out.points.push_back(
        {capture::project(camera, p), 0.25 * chain.diameter * (camera.fx + camera.fy) / p.z(), arclengths[i]});
    if (i > 0) {
      const Vector3 along = camera_from_world.rotation * Vector3(line.col(i) - line.col(i - 1));
      out.bulge = std::abs(along.normalized().dot(p.normalized()));
    }
  }
  if (out.points.size() < 2) out.points.clear();
  return out;
}

Tube tube(const chain::Chain& chain, const math::Pose& base, const math::VectorX& theta, const capture::Camera& camera,
          double from, double to, double reach) {
  return tube(axis(chain, base, theta, camera, from, to), camera.width, camera.height, reach);
}

Tube tube(const Axis& axis, int width, int height, double reach) {
  Tube out;
  const std::vector<AxisPoint>& samples = axis.points;
  if (samples.size() < 2) return out;
  // bound the tube's pixels
  const double bulge = axis.bulge;
  double x0 = 1e9, y0 = 1e9, x1 = -1e9, y1 = -1e9;
  for (const AxisPoint& s : samples) {
    const double around = s.radius + reach + 1.0;
    x0 = std::min(x0, s.at.x() - around), x1 = std::max(x1, s.at.x() + around);
    y0 = std::min(y0, s.at.y() - around), y1 = std::max(y1, s.at.y() + around);
    out.radius += s.radius;
  }
  out.radius /= static_cast<double>(samples.size());
  const auto whole = [](double value, int size) { return static_cast<int>(std::clamp(value, 0.0, 1.0 * size)); };
  out.box = {whole(std::floor(x0), width), whole(std::floor(y0), height), whole(std::ceil(x1), width),
             whole(std::ceil(y1), height)};
  if (out.box.empty()) return out;
  out.outside.assign(static_cast<std::size_t>(out.box.width()) * out.box.height(), Tube::kFar);
  out.along.assign(out.outside.size(), 0.0f);
  out.left.assign(out.outside.size(), 0);
  // px by which the free end's disc reaches beyond its center along the rope, at offset `d` from the center
  const auto disc = [&](const Vector2& d, const Vector2& along, bool free_end, double radius) {
    const double share = (d.x() * along.y() - d.y() * along.x()) / radius;
    return free_end ? bulge * radius * std::sqrt(std::max(0.0, 1.0 - share * share)) : 0.0;
  };
  // px beyond a segment's end up to which its points are nearer than the next segment's, on the outer side of the bend
  const auto wedge = [&](std::size_t joint, double around) {
    const Vector2 before = samples[joint].at - samples[joint - 1].at, after = samples[joint + 1].at - samples[joint].at;
    const double cosine = before.dot(after) / std::max(1e-9, before.norm() * after.norm());
    return 1.0 + around * std::sqrt(0.5 * std::max(0.0, 1.0 - cosine));
  };
  // keep for each pixel near a segment the least distance from the outline
  for (std::size_t i = 0; i + 1 < samples.size(); ++i) {
    const Vector2 a = samples[i].at, step = samples[i + 1].at - a;
    const double length = step.norm();
    if (length < 1e-9) continue;
    const Vector2 along = step / length;
    const bool begins = i == 0, ends = i + 2 == samples.size();
    const double around = std::max(samples[i].radius, samples[i + 1].radius) + reach;
    const int left = std::max(out.box.x0, static_cast<int>(std::min(a.x(), a.x() + step.x()) - around));
    const int right = std::min(out.box.x1, static_cast<int>(std::max(a.x(), a.x() + step.x()) + around) + 1);
    const int top = std::max(out.box.y0, static_cast<int>(std::min(a.y(), a.y() + step.y()) - around));
    const int bottom = std::min(out.box.y1, static_cast<int>(std::max(a.y(), a.y() + step.y()) + around) + 1);
    const double first = begins ? -around : -wedge(i, around), last = length + (ends ? around : wedge(i + 1, around));
    for (int y = top; y < bottom; ++y) {
      // the row's pixels from `first` to `last` along the segment
      int x_begin = left, x_end = right;
      if (std::abs(along.x()) > 1e-6) {
        const double in_row = (y + 0.5 - a.y()) * along.y();
        const double u = a.x() + (first - in_row) / along.x(), v = a.x() + (last - in_row) / along.x();
        x_begin = static_cast<int>(std::max<double>(left, std::floor(std::min(u, v))));
        x_end = static_cast<int>(std::min<double>(right, std::ceil(std::max(u, v)) + 1.0));
      }
      for (int x = x_begin; x < x_end; ++x) {
        const Vector2 d = Vector2(x + 0.5, y + 0.5) - a;
        const double t = d.dot(along);
        // beyond an end of the rope the distance is along it; between segments round joints close the gaps
        double distance;
        const double share = std::clamp(t / length, 0.0, 1.0);
        const double radius = samples[i].radius + share * (samples[i + 1].radius - samples[i].radius);
        const double across = std::abs(d.x() * along.y() - d.y() * along.x()) - radius;
        const double beyond = std::max(-t, t - length);
        if (beyond <= 0.0)
          distance = across;
        else if ((begins && t < 0.0) || (ends && t > length))
          distance = across > 0.0 ? std::sqrt(across * across + beyond * beyond)
                                  : std::max(across, beyond - disc(d, along, t > 0.0, radius));
        else
          distance = std::sqrt((across + radius) * (across + radius) + beyond * beyond) - radius;
        if (distance > reach) continue;
        const std::size_t at = static_cast<std::size_t>(y - out.box.y0) * out.box.width() + (x - out.box.x0);
        if (distance >= out.outside[at]) continue;
        out.outside[at] = static_cast<float>(distance);
        out.left[at] = d.x() * along.y() > d.y() * along.x();
        out.along[at] =
            static_cast<float>(samples[i].arclength + share * (samples[i + 1].arclength - samples[i].arclength));
      }
    }
  }
  // near an end, pixels inside are no deeper than the end is near, and pixels beyond it are at least that far outside,
  // even where the round joint of the previous segment reaches
  const auto cap = [&](const AxisPoint& end, const Vector2& outward, bool free_end) {
    const double around = end.radius + reach;
    const double near = 2.0 * around * (samples.back().arclength - samples.front().arclength) /
                        std::max(1.0, (samples.back().at - samples.front().at).norm());  // m
    const int x_first = std::max(out.box.x0, static_cast<int>(end.at.x() - around)),
              x_last = std::min(out.box.x1, static_cast<int>(end.at.x() + around) + 1);
    for (int y = std::max(out.box.y0, static_cast<int>(end.at.y() - around));
         y < std::min(out.box.y1, static_cast<int>(end.at.y() + around) + 1); ++y)
      for (int x = x_first; x < x_last; ++x) {
        const std::size_t at = static_cast<std::size_t>(y - out.box.y0) * out.box.width() + (x - out.box.x0);
        float& value = out.outside[at];
        if (value == Tube::kFar || std::abs(out.along[at] - end.arclength) > near) continue;
        const Vector2 d = Vector2(x + 0.5, y + 0.5) - end.at;
        const double depth = d.dot(outward) - disc(d, outward, free_end, end.radius);
        const bool inside = value < 0.0f && depth < 0.0 && (d - d.dot(outward) * outward).norm() < end.radius;
        if (inside || depth >= 0.0) value = std::max(value, static_cast<float>(depth));
      }
  };
  const std::size_t last = samples.size() - 1;
  cap(samples[0], (samples[0].at - samples[1].at).normalized(), false);
  cap(samples[last], (samples[last].at - samples[last - 1].at).normalized(), true);
  return out;
}

}  // namespace chainsplat::masking
