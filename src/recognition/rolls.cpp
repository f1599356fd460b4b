#include "src/recognition/rolls.h"

#include <algorithm>
#include <cmath>

#include "chainsplat/core.h"
#include "src/math/tridiagonal.h"
#include "src/recognition/layout.h"

namespace chainsplat::recognition {

namespace {

constexpr double kRollNoise = 0.1;    // of a cell's color, in units of the mean color: what neighbors share
constexpr double kRollOutlier = 3.0;  // kRollNoise beyond which a residual counts less
constexpr double kAlong = 0.15;       // rad per root of a diameter: turns of neighboring links differ by so much
constexpr double kInTime = 1.0;       // rad per root of a second
constexpr double kLeastLength = 0.1;  // diameters between middles of links, where the first joint is at the grasp
constexpr double kLeastTime = 1e-3;   // s between frames
constexpr int kPasses = 3;            // the first goes through the frames in time, and learns the texture on the way
constexpr int kIterations = 4;        // Gauss-Newton steps a frame and pass
constexpr double kBelieved = 0.25;    // least share of what is left without rolls that they must explain

// The texture that the frames agree on, by the material's angle.
struct RolledTexture {
  std::vector<Color> sum;
  std::vector<float> weight;
  explicit RolledTexture(const Grid& grid) : sum(grid.size(), Color::Zero()), weight(grid.size(), 0.0f) {}
};

void add(const Grid& grid, const Layout& layout, const math::VectorX& roll, RolledTexture& texture) {
  for (int row = 0; row < grid.rows; ++row)
    for (int column = 0; column < kColumns; ++column) {
      const std::size_t from = grid.cell(row, column);
      const float weight = layout.weight[from];
      if (weight <= 0.0f) continue;
      const MaterialColumn at = material_column(column, roll[grid.link[row]]);
      const auto put = [&](int to, float share) {
        texture.sum[grid.cell(row, to)] += share * weight * layout.color[from];
        texture.weight[grid.cell(row, to)] += share * weight;
      };
      put(at.first, 1.0f - at.share);
      put(at.second, at.share);
    }
}

// What is left of the colors of one frame: weighted squares and their weights.
struct Left {
  double square = 0.0, weight = 0.0;
};

Left left_of(const Grid& grid, const Layout& layout, const RolledTexture& still) {
  Left left;
  for (std::size_t cell = 0; cell < grid.size(); ++cell) {
    if (layout.weight[cell] <= 0.0f) continue;
    left.square += layout.weight[cell] * (layout.color[cell] - still.sum[cell] / still.weight[cell]).squaredNorm();
    left.weight += layout.weight[cell];
  }
  return left;
}

// Least squares over the turns of one frame's links, from `roll` on, which stay near `before`, `apart` seconds away.
Left align(const Grid& grid, const Layout& layout, const RolledTexture& texture, const math::VectorX* before,
           double apart, math::VectorX& roll) {
  constexpr float kKnown = 0.2f;  // least weight of a texture's cell
  constexpr double kInverseVariance = 1.0 / (kRollNoise * kRollNoise);
  const int links = grid.chain.links();
  for (int iteration = 0;; ++iteration) {
    math::Tridiagonal normal{0.0, math::VectorX::Zero(links), math::VectorX::Zero(links)};
    math::VectorX gradient = math::VectorX::Zero(links);
    Left left;
    for (int row = 0; row < grid.rows; ++row) {
      const int link = grid.link[row];
      for (int column = 0; column < kColumns; ++column) {
        const std::size_t from = grid.cell(row, column);
        if (layout.weight[from] <= 0.0f) continue;
        const MaterialColumn at = material_column(column, roll[link]);
        const std::size_t a = grid.cell(row, at.first), b = grid.cell(row, at.second);
        if (texture.weight[a] < kKnown || texture.weight[b] < kKnown) continue;
        const Color first = texture.sum[a] / texture.weight[a], second = texture.sum[b] / texture.weight[b];
        const Color residual = layout.color[from] - (1.0f - at.share) * first - at.share * second;
        const Color slope = (second - first) * static_cast<float>(kColumns / kTurn);  // of the residual
        const double square = residual.squaredNorm();
        const double weight =
            kInverseVariance * layout.weight[from] / (1.0 + square * kInverseVariance / (kRollOutlier * kRollOutlier));
        normal.diagonal[link] += weight * slope.squaredNorm();
        gradient[link] += weight * slope.dot(residual);
        left.square += layout.weight[from] * square;
        left.weight += layout.weight[from];
      }
    }
    if (iteration == kIterations) return left;
    for (int link = 0; link < links; ++link) {
      const double middles = 0.5 * (grid.chain.link_end(link) - grid.chain.link_start(std::max(0, link - 1)));
      const double tie =
          grid.chain.diameter / (kAlong * kAlong * std::max(middles, kLeastLength * grid.chain.diameter));
      const double difference = roll[link] - (link > 0 ? roll[link - 1] : 0.0);  // the grasp holds the rope
      normal.diagonal[link] += tie;
      gradient[link] += tie * difference;
      if (link > 0) {
        normal.diagonal[link - 1] += tie;
        normal.beside[link] -= tie;
        gradient[link - 1] -= tie * difference;
      }
      if (before) {
        const double slow = 1.0 / (kInTime * kInTime * std::max(apart, kLeastTime));
        normal.diagonal[link] += slow;
        gradient[link] += slow * (roll[link] - (*before)[link]);
      }
    }
    normal.factor();
    normal.solve(gradient);
    roll -= gradient;
  }
}

// A part of the frames laid out, in the light that each side of the rope has on the mean.
std::vector<Layout> laid_out(const Grid& grid, const capture::Capture& capture, const std::vector<FrameViews>& frames,
                             std::size_t first, std::size_t count, const chain::States& states) {
  constexpr float kDarkest = 0.02f;
  std::vector<Layout> layouts(count);
  core::parallel_for(static_cast<std::int64_t>(count), [&](std::int64_t k) {
    layouts[k] = laid_out(grid, capture, frames[first + k], static_cast<int>(first + k), states);
  });
  std::vector<Color> light(kColumns, Color::Zero());
  std::vector<float> weights(kColumns, 0.0f);
  for (const Layout& layout : layouts)
    for (std::size_t cell = 0; cell < grid.size(); ++cell) {
      light[cell % kColumns] += layout.weight[cell] * layout.color[cell];
      weights[cell % kColumns] += layout.weight[cell];
    }
  for (int column = 0; column < kColumns; ++column)
    if (weights[column] > 0.0f) light[column] = (light[column] / weights[column]).cwiseMax(kDarkest);
  for (Layout& layout : layouts)
    for (std::size_t cell = 0; cell < grid.size(); ++cell)
      if (layout.weight[cell] > 0.0f) layout.color[cell] = layout.color[cell].cwiseQuotient(light[cell % kColumns]);
  return layouts;
}

}  // namespace

std::vector<math::VectorX> rolls_in(const chain::Chain& chain, const capture::Capture& capture,
                                    const std::vector<FrameViews>& frames, const chain::States& given) {
  chain::States states;  // of links alone
  states.time = given.time, states.theta = given.theta;
  const Grid grid(chain);
  const std::size_t count = frames.size(), part = std::max<std::size_t>(1, kCellsTogether / grid.size());
  const math::VectorX none = math::VectorX::Zero(chain.links());
  std::vector<math::VectorX> rolls(count, none);
  const auto apart = [&](std::size_t k) { return frames[k].time - frames[k - 1].time; };
  std::vector<Layout> layouts;
  RolledTexture texture(grid), still(grid);
  Left turned, unturned;
  for (int pass = 0; pass < kPasses; ++pass) {
    RolledTexture next(grid);
    for (std::size_t first = 0; first < count; first += part) {
      const std::size_t size = std::min(part, count - first);
      if (pass == 0 || size < count) layouts = laid_out(grid, capture, frames, first, size, states);
      for (std::size_t i = 0; i < size; ++i) {
        const std::size_t k = first + i;
        const math::VectorX* before = k > 0 ? &rolls[k - 1] : nullptr;
        if (pass == 0 && before) rolls[k] = *before;
        const Left left = align(grid, layouts[i], pass == 0 ? next : texture, before, k > 0 ? apart(k) : 0.0, rolls[k]);
        add(grid, layouts[i], rolls[k], next);
        if (pass == 0) add(grid, layouts[i], none, still);
        if (pass + 1 < kPasses) continue;
        turned.square += left.square, turned.weight += left.weight;
        const Left without = left_of(grid, layouts[i], still);
        unturned.square += without.square, unturned.weight += without.weight;
      }
    }
    texture = std::move(next);
  }
  if (!(turned.square * unturned.weight < (1.0 - kBelieved) * unturned.square * turned.weight)) return {};
  math::VectorX mean = none;
  for (const math::VectorX& roll : rolls) mean += roll / static_cast<double>(count);
  for (math::VectorX& roll : rolls) roll -= mean;
  return rolls;
}

}  // namespace chainsplat::recognition
