#include "src/estimation/color.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace chainsplat::estimation {

using math::MatrixX;
using math::Pose;
using math::Vector2;
using math::Vector3;
using math::VectorX;

namespace {

using Vector8 = Eigen::Matrix<double, 8, 1>;  // of a link: world twist about the world origin, gain, bias
using Matrix8 = Eigen::Matrix<double, 8, 8>;

constexpr int kEdge = 2;            // px from the mask's outline within which a color is mixed with the background's
constexpr float kOpaque = 0.95f;    // drawn coverage of a pixel that counts
constexpr double kNoise = 0.05;     // intensity, Huber's cut: beyond it stains, shadows, what hides the rope
constexpr double kGainWeight = 10;  // pixels' worth of belief that the gain is 1 (keeps a gray rope's solvable),
constexpr double kBiasWeight = 40;  // and that the bias is 0
constexpr int kExposurePasses = 2;  // robust weights depend on the exposure
constexpr float kByte = 1.0f / 255.0f;
constexpr std::size_t kLeastPixels = 100;  // fewer are not compared,
constexpr double kLeastContrast = 0.06;    // nor a rope on which less is to see: standard deviation of the drawn colors

// Pixels of the view that count.
std::vector<int> interior(const capture::View& view, const splat::Picture& drawn) {
  const auto inside = [&](int x, int y) {
    return view.rgba[4 * (static_cast<std::size_t>(y) * view.width + x) + 3] >= 128;
  };
  std::vector<int> pixels;
  for (int y = kEdge; y < view.height - kEdge; ++y) {
    for (int x = kEdge; x < view.width - kEdge; ++x) {
      const int k = y * view.width + x;
      if (!inside(x, y) || drawn.rgba[4 * k + 3] < kOpaque || drawn.depth[k] <= 0.0f) continue;
      bool all = true;
      for (int dy = -kEdge; all && dy <= kEdge; ++dy)
        for (int dx = -kEdge; all && dx <= kEdge; ++dx) all = inside(x + dx, y + dy);
      if (all) pixels.push_back(k);
    }
  }
  return pixels;
}

// Where a link is: its start and direction in the world.
struct Placed {
  Vector3 start, along;
  double length;
};

int nearest_link(const std::vector<Placed>& links, const Vector3& point) {
  int best = 0;
  double least = std::numeric_limits<double>::infinity();
  for (std::size_t j = 0; j < links.size(); ++j) {
    const Vector3 from = point - links[j].start;
    const double s = std::clamp(from.dot(links[j].along), 0.0, links[j].length);
    const double distance2 = (from - s * links[j].along).squaredNorm();
    if (distance2 >= least) continue;
    least = distance2;
    best = static_cast<int>(j);
  }
  return best;
}

struct Pixel {
  int index, link;
  Eigen::Matrix<double, 2, 6> flow;  // px a twist of the link
};

// Of the colors in the pixels, each channel without its mean: whatever the exposure, what has no marks where the twin
// has them is not the rope.
std::optional<double> likeness_of(const capture::View& view, const splat::Picture& drawn,
                                  const std::vector<Pixel>& pixels) {
  if (pixels.size() < kLeastPixels) return {};
  const auto count = static_cast<double>(pixels.size());
  double product = 0.0, shown2 = 0.0, seen2 = 0.0;
  for (int c = 0; c < 3; ++c) {
    double shown_mean = 0.0, seen_mean = 0.0;
    for (const Pixel& pixel : pixels) {
      shown_mean += drawn.rgba[4 * pixel.index + c] / count;
      seen_mean += view.rgba[4 * pixel.index + c] * kByte / count;
    }
    for (const Pixel& pixel : pixels) {
      const double shown = drawn.rgba[4 * pixel.index + c] - shown_mean;
      const double seen = view.rgba[4 * pixel.index + c] * kByte - seen_mean;
      product += shown * seen, shown2 += shown * shown, seen2 += seen * seen;
    }
  }
  if (shown2 < 3.0 * count * kLeastContrast * kLeastContrast) return {};
  return product / std::sqrt(shown2 * std::max(seen2, 1e-12));
}

}  // namespace

ColorEquations color_equations(const chain::Chain& chain, const Pose& base, const VectorX& theta,
                               const capture::Camera& camera, const capture::View& view, const splat::Picture& drawn) {
  const int w = view.width, n = chain.angles();
  const std::vector<Pose> motions = chain::link_motions(chain, theta, base);
  std::vector<Placed> links;
  for (int j = 0; j < chain.links(); ++j)
    links.push_back({motions[j] * Vector3(chain.link_start(j) * chain.direction), motions[j].rotation * chain.direction,
                     chain.link_end(j) - chain.link_start(j)});
  const math::Matrix3 camera_from_world = camera.world_from_camera.rotation.transpose();

  std::vector<Pixel> pixels;
  for (const int k : interior(view, drawn)) {
    const double z = drawn.depth[k];
    const Vector3 x((view.x0 + k % w + 0.5 - camera.cx) / camera.fx * z,
                    (view.y0 + k / w + 0.5 - camera.cy) / camera.fy * z, z);
    const Vector3 world = camera.world_from_camera * x;
    Eigen::Matrix<double, 2, 3> projection;
    projection << camera.fx / z, 0, -camera.fx * x.x() / (z * z), 0, camera.fy / z, -camera.fy * x.y() / (z * z);
    const Eigen::Matrix<double, 2, 3> by_point = projection * camera_from_world;
    Pixel pixel{k, nearest_link(links, world), {}};
    pixel.flow << -by_point * math::hat(world), by_point;
    pixels.push_back(pixel);
  }

  ColorEquations out;
  out.likeness = likeness_of(view, drawn, pixels);
  const MatrixX axes = chain::world_axes(chain, theta, base);
  const float* const shown = drawn.rgba.data();
  const std::uint8_t* const seen = view.rgba.data();
  for (int pass = 0; pass < kExposurePasses; ++pass) {
    std::vector<Matrix8> normal(chain.links(), Matrix8::Zero());
    std::vector<Vector8> right(chain.links(), Vector8::Zero());
    out.weight = out.square = 0.0;
    for (const Pixel& pixel : pixels) {
      for (int c = 0; c < 3; ++c) {
        const int k = 4 * pixel.index + c;
        const double residual = out.gain * shown[k] + out.bias - seen[k] * kByte;
        const double weight = std::abs(residual) <= kNoise ? 1.0 : kNoise / std::abs(residual);
        const auto slope = [&](int step) {
          return 0.25 * (out.gain * (shown[k + step] - shown[k - step]) +
                         kByte * (static_cast<float>(seen[k + step]) - static_cast<float>(seen[k - step])));
        };
        Vector8 row;
        row << -pixel.flow.transpose() * Vector2(slope(4), slope(4 * w)), shown[k], 1.0;
        normal[pixel.link].noalias() += (weight * row) * row.transpose();
        right[pixel.link] += (weight * residual) * row;
        out.weight += weight;
        out.square += weight * residual * residual;
      }
    }
    // links to angles (SPEC 2.3), exposure last
    MatrixX full = MatrixX::Zero(n + 2, n + 2);
    VectorX pull = VectorX::Zero(n + 2);
    MatrixX columns = MatrixX::Zero(8, n + 2);
    columns(6, n) = columns(7, n + 1) = 1.0;
    for (int j = 0; j < chain.links(); ++j) {
      const int count = j == 0 ? 0 : chain.last_angle(j) + 1;
      columns.topLeftCorner(6, count) = axes.leftCols(count);
      full.noalias() += columns.transpose() * normal[j] * columns;
      pull.noalias() += columns.transpose() * right[j];
    }
    full(n, n) += kGainWeight;
    full(n + 1, n + 1) += kBiasWeight;
    pull[n] += kGainWeight * (out.gain - 1.0);
    pull[n + 1] += kBiasWeight * out.bias;
    const Eigen::Matrix2d exposure = full.bottomRightCorner<2, 2>().inverse();
    if (pass + 1 < kExposurePasses) {
      const Vector2 change = -exposure * pull.tail<2>();
      out.gain += change[0];
      out.bias += change[1];
      continue;
    }
    const MatrixX coupling = full.topRightCorner(n, 2);
    out.normal = full.topLeftCorner(n, n) - coupling * exposure * coupling.transpose();
    out.right = pull.head(n) - coupling * (exposure * pull.tail<2>());
  }
  return out;
}

}  // namespace chainsplat::estimation
