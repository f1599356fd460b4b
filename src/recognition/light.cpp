#include "src/recognition/light.h"

#include <algorithm>
#include <cmath>

#include "chainsplat/core.h"
#include "src/recognition/layout.h"

namespace chainsplat::recognition {

namespace {

using math::Vector3;

constexpr int kTurns = 4;                 // of texture and light
constexpr std::size_t kMostFrames = 200;  // evenly over the recording: many times more than nine numbers need
constexpr double kCellNoise = 0.1;        // of the mean color, in a cell
constexpr double kCellOutlier = 3.0;      // kCellNoise beyond which a residual, such as a highlight, counts less
constexpr double kEven = 1e-3;            // of all weight, toward a light that is the same on every side
constexpr double kBrightest = 0.99;       // quantile of the brightness that was seen, which becomes 1
constexpr float kDarkest = 0.05f;         // of the same unit as the mean color's light, while it is being found
constexpr double kBelieved = 0.1;         // least share of what is left without a light that it must explain

// 1, and the polynomials of first and second order whose mean over the sphere is 0.
constexpr int kTerms = 9;
using Terms = Eigen::Matrix<double, kTerms, 1>;
Terms terms(const Vector3& n) {
  Terms out;
  out << 1.0, n.x(), n.y(), n.z(), n.x() * n.y(), n.x() * n.z(), n.y() * n.z(), n.x() * n.x() - n.y() * n.y(),
      3.0 * n.z() * n.z() - 1.0;
  return out;
}
splat::Light light_of(const Terms& c, const Vector3& axis) {
  splat::Light light{axis, c[0] - c[8], c.segment<3>(1), {}};
  light.quadratic << c[7], 0.5 * c[4], 0.5 * c[5],  //
      0.5 * c[4], -c[7], 0.5 * c[6],                //
      0.5 * c[5], 0.5 * c[6], 3.0 * c[8];
  return light;
}

// A cell of a layout.
struct Sample {
  Color color;
  float weight;
  std::size_t first, second;  // cells of the texture
  float share;                // of the second
  int normal;                 // index of its normal
};
struct Samples {
  std::vector<Sample> all;
  std::vector<Terms> normals;
};

Samples samples_of(const Grid& grid, const capture::Capture& capture, const std::vector<FrameViews>& frames,
                   const chain::States& states) {
  const chain::Chain& chain = grid.chain;
  chain::States still;  // of links alone
  still.time = states.time, still.theta = states.theta;
  const std::size_t most = std::clamp<std::size_t>(kCellsTogether / grid.size(), 1, kMostFrames);
  const std::size_t every = (frames.size() + most - 1) / most;
  std::vector<std::size_t> used;
  for (std::size_t k = 0; k < frames.size(); k += every) used.push_back(k);
  std::vector<Samples> parts(used.size());
  core::parallel_for(static_cast<std::int64_t>(used.size()), [&](std::int64_t i) {
    const std::size_t k = used[i];
    const Layout layout = laid_out(grid, capture, frames[k], static_cast<int>(k), still);
    const auto motions = chain::link_motions(chain, states.theta[k], capture.base.pose(frames[k].time));
    for (const math::Pose& motion : motions)
      for (int column = 0; column < kColumns; ++column)
        parts[i].normals.push_back(terms(motion.rotation * grid.normal(Grid::angle(column))));
    for (int row = 0; row < grid.rows; ++row)
      for (int column = 0; column < kColumns; ++column) {
        const std::size_t cell = grid.cell(row, column);
        if (layout.weight[cell] <= 0.0f) continue;
        const int link = grid.link[row];
        const MaterialColumn at = material_column(column, states.roll.empty() ? 0.0 : states.roll[k][link]);
        parts[i].all.push_back({layout.color[cell], layout.weight[cell], grid.cell(row, at.first),
                                grid.cell(row, at.second), at.share, kColumns * link + column});
      }
  });
  Samples out;
  for (Samples& part : parts) {
    for (Sample sample : part.all) {
      sample.normal += static_cast<int>(out.normals.size());
      out.all.push_back(sample);
    }
    out.normals.insert(out.normals.end(), part.normals.begin(), part.normals.end());
    part = {};
  }
  return out;
}

// Colors of the material, of which each sample shows so much.
struct LitTexture {
  std::vector<Color> sum;
  std::vector<float> weight;
  LitTexture(std::size_t cells, const Samples& samples, const std::vector<float>& brightness)
      : sum(cells, Color::Zero()), weight(cells, 0.0f) {
    for (const Sample& s : samples.all) {
      const float light = brightness[s.normal];
      const auto put = [&](std::size_t cell, float share) {
        sum[cell] += share * s.weight * light * s.color;
        weight[cell] += share * s.weight * light * light;
      };
      put(s.first, 1.0f - s.share);
      put(s.second, s.share);
    }
  }
  Color at(std::size_t cell) const { return weight[cell] > 0.0f ? Color(sum[cell] / weight[cell]) : Color::Zero(); }
  Color of(const Sample& s) const { return (1.0f - s.share) * at(s.first) + s.share * at(s.second); }
};

// What the texture in that light leaves of the colors: mean square.
double left_of(const Samples& samples, const LitTexture& texture, const std::vector<float>& brightness) {
  double square = 0.0, weight = 0.0;
  for (const Sample& s : samples.all) {
    square += s.weight * (s.color - brightness[s.normal] * texture.of(s)).squaredNorm();
    weight += s.weight;
  }
  return square / weight;
}

std::vector<float> brightness_of(const Samples& samples, const Terms& found) {
  std::vector<float> out;
  for (const Terms& normal : samples.normals) out.push_back(std::max(kDarkest, static_cast<float>(normal.dot(found))));
  return out;
}

}  // namespace

splat::Light light_on(const chain::Chain& chain, const capture::Capture& capture, const std::vector<FrameViews>& frames,
                      const chain::States& states) {
  const Grid grid(chain);
  const Samples samples = samples_of(grid, capture, frames, states);
  if (samples.all.empty()) return {};
  Color mean = Color::Zero();
  float weight = 0.0f;
  for (const Sample& s : samples.all) mean += s.weight * s.color, weight += s.weight;
  mean /= weight;
  const double noise = kCellNoise * mean.norm(), outlier = kCellOutlier * noise;

  Terms found = Terms::Zero();
  const std::vector<float> even(samples.normals.size(), 1.0f);
  std::vector<float> brightness = even;
  const double without = left_of(samples, LitTexture(grid.size(), samples, even), even);
  for (int turn = 0; turn < kTurns; ++turn) {
    const LitTexture texture(grid.size(), samples, brightness);
    Eigen::Matrix<double, kTerms, kTerms> normal = Eigen::Matrix<double, kTerms, kTerms>::Zero();
    Terms right = Terms::Zero();
    for (const Sample& s : samples.all) {
      const Color color = turn == 0 ? mean : texture.of(s);  // at first the same all over
      const Color residual = s.color - brightness[s.normal] * color;
      const double counts = turn == 0 ? s.weight : s.weight / (1.0 + residual.squaredNorm() / (outlier * outlier));
      normal.selfadjointView<Eigen::Lower>().rankUpdate(samples.normals[s.normal], counts * color.squaredNorm());
      right += counts * color.dot(s.color) * samples.normals[s.normal];
    }
    normal.diagonal().tail<kTerms - 1>().array() += kEven * normal(0, 0);
    found = normal.selfadjointView<Eigen::Lower>().ldlt().solve(right);
    brightness = brightness_of(samples, found);
  }
  const double left = left_of(samples, LitTexture(grid.size(), samples, brightness), brightness);
  if (!(left < (1.0 - kBelieved) * without)) return {};

  std::vector<float> seen;
  for (const Sample& s : samples.all) seen.push_back(brightness[s.normal]);
  const auto brightest = seen.begin() + static_cast<std::ptrdiff_t>(kBrightest * static_cast<double>(seen.size() - 1));
  std::nth_element(seen.begin(), brightest, seen.end());
  return light_of(found / *brightest, chain.direction);
}

}  // namespace chainsplat::recognition
