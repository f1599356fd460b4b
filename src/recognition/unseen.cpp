#include "src/recognition/unseen.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <optional>
#include <vector>

namespace chainsplat::recognition {

namespace {

using math::Vector3;

constexpr double kTurn = 2.0 * std::numbers::pi;
constexpr int kColumns = 36;          // of cells around the tube
constexpr double kCellLength = 0.15;  // diameters along it
constexpr double kUnseen = -0.2;  // largest cosine between surface normal and view ray of what no camera saw: what lies
                                  // just behind the limb still shapes the outline
constexpr double kTrusted = 0.4;  // least cosine of a color that others are taken from
constexpr double kReach = 0.12;   // diameters, over which colors are averaged
constexpr double kInside = 0.4;   // of the radius: what is closer to the axis has no side
constexpr double kThickness = 0.04;  // diameters, sigma across the surface
constexpr double kCoverage = 0.5;    // sigma along the surface in units of the spacing
constexpr float kOpaque = 3.0f;      // logit, 0.95
constexpr double kSteepest = 4.0;    // radii per radian, of a helix
constexpr int kSlopes = 161;         // that are tried
constexpr double kRepeats = 0.3;     // least correlation of a texture with itself along a helix

// Cells of the surface at home: row i of arclength, column j of angle about the axis, from the bending axis on.
struct Surface {
  const chain::Chain& chain;
  int rows = 1;
  std::vector<double> facing;                 // best cosine of any view
  std::vector<std::optional<Vector3>> color;  // of trusted cells

  explicit Surface(const chain::Chain& of)
      : chain(of), rows(std::max(2, static_cast<int>(std::ceil(of.length / (kCellLength * of.diameter))))) {
    facing.assign(static_cast<std::size_t>(rows) * kColumns, -1.0);
    color.resize(facing.size());
  }
  double arclength(int row) const { return (row + 0.5) * chain.length / rows; }
  static double angle(int column) { return (column + 0.5) * kTurn / kColumns; }
  Vector3 normal(double at) const {
    return std::cos(at) * chain.bending_axis + std::sin(at) * chain.direction.cross(chain.bending_axis);
  }
  std::size_t cell(int row, int column) const { return static_cast<std::size_t>(row) * kColumns + column; }
  std::size_t cell_at(double arclength, double angle) const {
    const int row = static_cast<int>(std::floor(arclength / chain.length * rows));
    const int column = static_cast<int>(std::floor(angle / kTurn * kColumns));
    return cell(std::clamp(row, 0, rows - 1), ((column % kColumns) + kColumns) % kColumns);
  }
  // Between two rows; none where neither has a color.
  std::optional<Vector3> color_at(double arclength, int column) const {
    const double at = std::clamp(arclength / chain.length * rows - 0.5, 0.0, rows - 1.001);
    const int row = static_cast<int>(at);
    const std::optional<Vector3>&a = color[cell(row, column)], &b = color[cell(row + 1, column)];
    if (a && b) return Vector3((row + 1 - at) * *a + (at - row) * *b);
    return a ? a : b;
  }
};

// A Gaussian's center about the axis.
struct Place {
  double arclength, angle, radius;
};
Place place_of(const Surface& surface, const splat::Gaussians& g, int i) {
  const Vector3 mean(g.mean[3 * i], g.mean[3 * i + 1], g.mean[3 * i + 2]);
  const double x = mean.dot(surface.normal(0.0)), y = mean.dot(surface.normal(0.25 * kTurn));
  const double angle = std::atan2(y, x);
  return {mean.dot(surface.chain.direction), angle < 0.0 ? angle + kTurn : angle, std::hypot(x, y)};
}

void look(std::span<const Viewpoint> views, Surface& surface) {
  const double radius = 0.5 * surface.chain.diameter;
  for (int row = 0; row < surface.rows; ++row) {
    const double s = surface.arclength(row);
    const int link = chain::link_at(surface.chain, s);
    for (int column = 0; column < kColumns; ++column) {
      const Vector3 normal = surface.normal(Surface::angle(column));
      const Vector3 point = s * surface.chain.direction + radius * normal;
      double& best = surface.facing[surface.cell(row, column)];
      for (const Viewpoint& view : views) {
        const math::Pose& motion = view.motions[link];
        best = std::max(best, (motion.rotation * normal).dot((view.center - motion * point).normalized()));
      }
    }
  }
}

void color_trusted(const splat::Gaussians& g, const std::vector<Place>& places, double radius, Surface& surface) {
  const double reach = kReach * surface.chain.diameter;
  std::vector<Vector3> sums(surface.facing.size(), Vector3::Zero());
  std::vector<double> weights(surface.facing.size(), 0.0);
  const double row_length = surface.chain.length / surface.rows;
  for (int i = 0; i < g.count; ++i) {
    if (surface.facing[surface.cell_at(places[i].arclength, places[i].angle)] < kTrusted) continue;
    const Vector3 mean(g.mean[3 * i], g.mean[3 * i + 1], g.mean[3 * i + 2]);
    const Vector3 color = splat::base_color(g, i);
    const double opacity = 1.0 / (1.0 + std::exp(-static_cast<double>(g.opacity_logit[i])));
    const int near = static_cast<int>(places[i].arclength / row_length),
              span = static_cast<int>(4.0 * reach / row_length) + 1;
    for (int row = std::max(0, near - span); row <= std::min(surface.rows - 1, near + span); ++row)
      for (int column = 0; column < kColumns; ++column) {
        const std::size_t cell = surface.cell(row, column);
        if (surface.facing[cell] < kTrusted) continue;
        const Vector3 point =
            surface.arclength(row) * surface.chain.direction + radius * surface.normal(Surface::angle(column));
        const double weight = opacity * std::exp(-0.5 * (mean - point).squaredNorm() / (reach * reach));
        sums[cell] += weight * color;
        weights[cell] += weight;
      }
  }
  constexpr double kLeast = 1e-3;  // weight: nothing is there
  for (std::size_t cell = 0; cell < sums.size(); ++cell)
    if (weights[cell] > kLeast) surface.color[cell] = sums[cell] / weights[cell];
}

// Correlation of the colors with those some columns further and `slope` times that angle along, m per rad.
double repetition(const Surface& surface, double slope) {
  constexpr int kNearest = 3, kFarthest = 9;  // columns: what touches is alike anyway
  Vector3 sum = Vector3::Zero();
  double products = 0.0, squares = 0.0, count = 0.0;
  for (int row = 0; row < surface.rows; ++row)
    for (int column = 0; column < kColumns; ++column) {
      const std::optional<Vector3>& here = surface.color[surface.cell(row, column)];
      for (int apart = kNearest; here && apart <= kFarthest; ++apart) {
        const double s = surface.arclength(row) + slope * apart * kTurn / kColumns;
        if (s < 0.0 || s > surface.chain.length) continue;
        const std::optional<Vector3> there = surface.color_at(s, (column + apart) % kColumns);
        if (!there) continue;
        sum += *here + *there;
        products += 2.0 * here->dot(*there);
        squares += here->squaredNorm() + there->squaredNorm();
        count += 2.0;
      }
    }
  const double mean = count > 0.0 ? sum.squaredNorm() / count : 0.0;
  return squares > mean ? (products - mean) / (squares - mean) : 0.0;
}

double slope_of_texture(const Surface& surface) {
  const double steepest = kSteepest * 0.5 * surface.chain.diameter;
  double best = kRepeats, slope = 0.0;
  for (int i = 0; i < kSlopes; ++i) {
    const double tried = steepest * (2.0 * i / (kSlopes - 1) - 1.0), found = repetition(surface, tried);
    if (found > best) best = found, slope = tried;
  }
  return slope;
}

// From the nearest colors along the helix in both directions, the nearer the more.
std::optional<Vector3> guessed(const Surface& surface, double arclength, double angle, double slope) {
  const int column = static_cast<int>(angle / kTurn * kColumns);
  Vector3 sum = Vector3::Zero();
  double weight = 0.0;
  for (const int direction : {1, -1})
    for (int apart = 1; apart < kColumns; ++apart) {
      const int there = ((column + direction * apart) % kColumns + kColumns) % kColumns;
      const double turn = direction * apart * kTurn / kColumns, s = arclength + slope * turn;
      const std::optional<Vector3> color =
          s >= 0.0 && s <= surface.chain.length ? surface.color_at(s, there) : std::nullopt;
      if (!color) continue;
      sum += *color / (turn * turn);
      weight += 1.0 / (turn * turn);
      break;
    }
  if (weight == 0.0) return {};
  return Vector3(sum / weight);
}

}  // namespace

int finish_unseen(const chain::Chain& chain, std::span<const Viewpoint> views, splat::Gaussians& gaussians) {
  Surface surface(chain);
  look(views, surface);
  const double full = 0.5 * chain.diameter;
  std::vector<Place> places;
  std::vector<int> unseen;
  std::vector<double> radii;
  for (int i = 0; i < gaussians.count; ++i) {
    const Place at = place_of(surface, gaussians, i);
    places.push_back(at);
    if (at.radius < kInside * full || at.arclength < 0.0 || at.arclength > chain.length) continue;
    const bool tip = at.arclength > chain.length - kInside * full;  // its face is seen from below
    if (!tip && surface.facing[surface.cell_at(at.arclength, at.angle)] < kUnseen) unseen.push_back(i);
    if (surface.facing[surface.cell_at(at.arclength, at.angle)] >= kTrusted) radii.push_back(at.radius);
  }
  if (unseen.empty() || radii.empty()) return 0;
  const double radius = math::median(radii);
  color_trusted(gaussians, places, radius, surface);
  const double slope = slope_of_texture(surface);
  const double cells = static_cast<double>(
      std::count_if(surface.facing.begin(), surface.facing.end(), [](double f) { return f < kUnseen; }));
  const double area = cells / static_cast<double>(surface.facing.size()) * kTurn * radius * chain.length;
  const double spacing = std::sqrt(area / static_cast<double>(unseen.size()));
  const int terms = gaussians.sh_coefficients();
  for (const int i : unseen) {
    const std::optional<Vector3> color = guessed(surface, places[i].arclength, places[i].angle, slope);
    if (!color) continue;
    const Vector3 normal = surface.normal(places[i].angle);
    const Vector3 mean = places[i].arclength * chain.direction + radius * normal;
    math::Matrix3 axes;  // along the rope, around it, across the surface
    axes << chain.direction, normal.cross(chain.direction), normal;
    const Eigen::Quaterniond turn(axes);
    const double sizes[3] = {kCoverage * spacing, kCoverage * spacing, kThickness * chain.diameter};
    for (int c = 0; c < 3; ++c) {
      gaussians.mean[3 * i + c] = static_cast<float>(mean[c]);
      gaussians.log_scale[3 * i + c] = static_cast<float>(std::log(sizes[c]));
    }
    const double wxyz[4] = {turn.w(), turn.x(), turn.y(), turn.z()};
    for (int c = 0; c < 4; ++c) gaussians.rotation[4 * i + c] = static_cast<float>(wxyz[c]);
    gaussians.opacity_logit[i] = kOpaque;
    std::fill_n(&gaussians.sh[3 * static_cast<std::size_t>(terms) * i], 3 * terms, 0.0f);
    splat::set_base_color(gaussians, i, *color);
  }
  return static_cast<int>(unseen.size());
}

}  // namespace chainsplat::recognition
