// The corners that libapriltag reports have a convention of their own and, in smaller images, errors of a fraction of a
// pixel. They are only where the search for the edges begins.
#include "tags.h"

#include <apriltag/apriltag.h>
#include <apriltag/tag16h5.h>
#include <apriltag/tag25h9.h>
#include <apriltag/tag36h10.h>
#include <apriltag/tag36h11.h>
#include <apriltag/tagCircle21h7.h>
#include <apriltag/tagStandard41h12.h>
#include <apriltag/tagStandard52h13.h>

#include <algorithm>
#include <cmath>
#include <memory>

#include "src/math/decompositions.h"

namespace chainsplat::calibration {

using math::Vector2;

namespace {

constexpr int kCorrectedBits = 1;         // more lets chance through
constexpr double kClearest = 35.0;        // gray levels between a bit and the threshold; what is less is no tag
constexpr int kLargeImage = 1600 * 1200;  // px; in larger ones quads are sought at half the size
constexpr double kEnds = 0.15;            // of an edge, at either end, that are not measured: the corner rounds it
constexpr double kWindow = 0.5;           // of a cell: how far from the edge is looked
constexpr double kWideWindow = 0.8;       // of a cell, where nothing else is near
constexpr double kWidestWindow = 4.0, kNarrowestWindow = 1.2;  // px
constexpr double kStep = 0.25;                                 // px, between samples across the edge
constexpr int kRounds = 12;                                    // of centering the window
constexpr double kCentered = 0.003;                            // px
constexpr double kLeastContrast = 20.0;                        // gray levels across an edge
constexpr int kDepth = 3;                 // cells behind an edge that blur may bring into its window
constexpr std::size_t kFewestPoints = 5;  // of an edge
constexpr double kOutlier = 3.5;          // standard deviations from the line
constexpr double kFloor = 0.02;           // px: what light and blur do to a line as a whole

struct Family {
  const char* name;
  apriltag_family_t* (*create)();
  void (*destroy)(apriltag_family_t*);
};
constexpr Family kFamily{"tag36h11", tag36h11_create, tag36h11_destroy};
constexpr Family kOthers[] = {{"tag25h9", tag25h9_create, tag25h9_destroy},
                              {"tag16h5", tag16h5_create, tag16h5_destroy},
                              {"tag36h10", tag36h10_create, tag36h10_destroy},
                              {"tagStandard41h12", tagStandard41h12_create, tagStandard41h12_destroy},
                              {"tagCircle21h7", tagCircle21h7_create, tagCircle21h7_destroy}};

using FamilyPointer = std::unique_ptr<apriltag_family_t, void (*)(apriltag_family_t*)>;

struct Found {
  int id;
  std::array<Vector2, 4> corners;  // from the lower left one against the clock, as seen
};

std::vector<Found> detect(const Gray& image, const Family& family, int bits) {
  const FamilyPointer tags(family.create(), family.destroy);
  const std::unique_ptr<apriltag_detector_t, void (*)(apriltag_detector_t*)> detector(apriltag_detector_create(),
                                                                                      apriltag_detector_destroy);
  apriltag_detector_add_family_bits(detector.get(), tags.get(), bits);
  detector->nthreads = 1;
  detector->quad_decimate = image.width * image.height > kLargeImage ? 2.0f : 1.0f;
  image_u8_t view{image.width, image.height, image.width, const_cast<std::uint8_t*>(image.pixels.data())};
  const std::unique_ptr<zarray_t, void (*)(zarray_t*)> all(apriltag_detector_detect(detector.get(), &view),
                                                           apriltag_detections_destroy);
  std::vector<Found> found;
  for (int i = 0; i < zarray_size(all.get()); ++i) {
    apriltag_detection_t* one = nullptr;
    zarray_get(all.get(), i, &one);
    if (one->decision_margin < kClearest) continue;
    Found tag{one->id, {}};
    for (int k = 0; k < 4; ++k) tag.corners[k] = {one->p[k][0], one->p[k][1]};
    found.push_back(tag);
  }
  return found;
}

// Between the centers of pixels; NaN outside of the image.
double intensity(const Gray& image, const Vector2& at) {
  const double x = at.x() - 0.5, y = at.y() - 0.5;
  const int i = static_cast<int>(std::floor(x)), j = static_cast<int>(std::floor(y));
  if (i < 0 || j < 0 || i + 1 >= image.width || j + 1 >= image.height) return NAN;
  const std::uint8_t* p = &image.pixels[static_cast<std::size_t>(j) * image.width + i];
  const double u = x - i, v = y - j;
  return (1 - v) * ((1 - u) * p[0] + u * p[1]) + v * ((1 - u) * p[image.width] + u * p[image.width + 1]);
}

double bell(double s, double sigma) {
  return std::exp(-0.5 * s * s / (sigma * sigma)) / (sigma * std::sqrt(2.0 * M_PI));
}
double ramp(double s, double sigma) { return 0.5 * std::erfc(-s / (sigma * M_SQRT2)); }

// The steps of brightness behind an edge, deeper in the tag, which blur brings into the window.
struct Behind {
  double cell = 0.0;                  // px, between them
  std::array<double, kDepth> rise{};  // of brightness, outward, at 1, 2, ... cells inside; of the edge's own
};
struct Step {
  double at = NAN;    // px, along the normal
  double blur = NAN;  // px, standard deviation of the slope
};

// Where along `outward` (unit) from `from` the step from black to white is: the center of gravity of the slope, in a
// bell-shaped window that is centered on it, without the slopes of the steps behind it under a blur of `blur` (0: not
// known). Blur that is alike on both sides does not move it.
Step step_along(const Gray& image, const Vector2& from, const Vector2& outward, double window, const Behind& behind,
                double blur) {
  const int half = static_cast<int>(std::ceil(1.5 * window / kStep));  // three of its standard deviations
  const double narrow = 0.25 * window * window;                        // variance of the window
  Step out;
  double at = 0.0;
  for (int round = 0; round < kRounds; ++round) {
    double sum = 0.0, moment = 0.0, square = 0.0, contrast = 0.0, own = 0.0, other = 0.0, other_moment = 0.0,
           other_square = 0.0;
    double before = intensity(image, from + (at - (half + 0.5) * kStep) * outward);
    for (int i = -half; i <= half; ++i) {
      const double after = intensity(image, from + (at + (i + 0.5) * kStep) * outward);
      const double s = i * kStep, slope = after - before, w = std::exp(-2.0 * s * s / (window * window));
      sum += w * slope, moment += w * slope * s, square += w * slope * s * s, contrast += slope;
      before = after;
      if (!(blur > 0.0)) continue;
      own += w * bell(s, blur);
      for (int k = 0; k < kDepth; ++k) {
        const double extra = behind.rise[k] * bell(s + (k + 1) * behind.cell, blur);
        other += w * extra, other_moment += w * extra * s, other_square += w * extra * s * s;
      }
    }
    if (!(contrast > kLeastContrast) || !(sum > 0.0)) return {};
    double variance = std::clamp(square / sum, 0.0, 0.9 * narrow);  // of the slope in the window
    if (blur > 0.0) {
      const double size = sum / (own + other);  // brightness of the edge's own step, by the sample's length
      moment -= size * other_moment, sum -= size * other, square -= size * other_square;
      if (!(sum > 0.0)) return {};
      variance = std::clamp(square / sum, 0.0, 0.9 * narrow);
    }
    // the window draws the center of gravity to its own middle: by as much as it narrows the slope
    const double move = moment / sum / (1.0 - variance / narrow);
    at += std::clamp(move, -0.5 * window, 0.5 * window);
    if (!(std::abs(at) < 1.5 * window)) return {};
    if (std::abs(move) >= kCentered) continue;
    out.at = at, out.blur = 1.0 / std::sqrt(std::max(1.0 / variance - 1.0 / narrow, 1e-3));
    break;
  }
  return out;
}

double cross(const Vector2& a, const Vector2& b) { return a.x() * b.y() - a.y() * b.x(); }

// Whether the cell is white that lies `along` an edge from its first corner and `deep` in the tag.
bool white(const std::array<bool, kCells * kCells>& black, int edge, int along, int deep) {
  const int last = kCells - 1;
  const int row = edge == 0 ? last - deep : edge == 1 ? last - along : edge == 2 ? deep : along;
  const int column = edge == 0 ? along : edge == 1 ? last - deep : edge == 2 ? last - along : deep;
  return !black[row * kCells + column];
}

std::vector<Vector2> edge_points(const Gray& image, const Tag& tag, int k) {
  const std::array<Vector2, 4>& quad = tag.rough;
  const Vector2 a = quad[k], b = quad[(k + 1) % 4], along = b - a;
  const double length = along.norm();
  if (!(length > 1.0)) return {};
  Vector2 outward(along.y() / length, -along.x() / length);
  const Vector2 center = 0.25 * (quad[0] + quad[1] + quad[2] + quad[3]);
  if (outward.dot(center - a) > 0) outward = -outward;
  const Vector2 c = quad[(k + 2) % 4], d = quad[(k + 3) % 4];
  const double cell = 0.5 * (std::abs(cross(along, c - a)) + std::abs(cross(along, d - a))) / length / kCells;
  const double window = std::clamp(kWindow * cell, kNarrowestWindow, kWidestWindow);
  const int count = static_cast<int>(std::clamp((1.0 - 2.0 * kEnds) * length, 1.0, 100.0));
  const auto place = [&](int i) { return kEnds + (1.0 - 2.0 * kEnds) * (i + 0.5) / count; };
  const auto black = black_cells(tag.id);
  // brightness of the tag behind the edge, blurred along it; a tilted tag's cells lie aslant behind it
  const double aslant = (0.5 * (c + d) - 0.5 * (a + b)).dot(along) / length / kCells;  // px, from cell to cell
  const auto behind = [&](int i, double blur) {
    Behind out{cell, {}};
    for (int deep = 1; deep <= kDepth; ++deep) {
      const double at = place(i) * length - deep * aslant;
      const auto light = [&](int row) {
        double sum = 0.0;
        for (int column = 0; column < kCells; ++column)
          if (white(black, k, column, row)) {
            const double u = at - column * length / kCells;
            sum += blur > 0.0 ? ramp(u, blur) - ramp(u - length / kCells, blur) : u >= 0 && u < length / kCells;
          }
        return sum;
      };
      out.rise[deep - 1] = light(deep - 1) - light(deep);
    }
    return out;
  };
  // the blur is seen best where black reaches deeper than the border; then with what else there is
  const double wide = std::clamp(kWideWindow * cell, kNarrowestWindow, kWidestWindow);
  double blur = 0.0;
  for (const double lightest : {0.1, 0.3, 0.3}) {
    std::vector<double> blurs;
    for (int i = 0; i < count; ++i) {
      const Behind other = behind(i, blur > 0.0 ? blur : 0.3 * cell);
      if (other.rise[0] < -lightest) continue;
      const Step step = step_along(image, a + place(i) * along, outward, wide, other, blur);
      if (std::isfinite(step.at)) blurs.push_back(step.blur);
    }
    blur = blurs.empty() ? std::max(blur, 0.2 * cell) : std::clamp(math::median(blurs), 0.3, cell);
  }
  std::vector<Vector2> points;
  for (int i = 0; i < count; ++i) {
    const Vector2 from = a + place(i) * along;
    const Step step = step_along(image, from, outward, window, behind(i, blur), blur);
    if (std::isfinite(step.at)) points.push_back(from + step.at * outward);
  }
  if (2 * points.size() < static_cast<std::size_t>(count) || points.size() < kFewestPoints) points.clear();
  return points;
}

struct Line {
  Vector2 middle, direction, normal;
  double scatter = 0.0, spread = 0.0;  // px, RMS across and along
  std::size_t count = 0;
  double variance(const Vector2& at) const {  // of the line's place across, at a point along it
    const double s = direction.dot(at - middle) / spread;
    return scatter * scatter / static_cast<double>(count) * (1.0 + s * s) + kFloor * kFloor;
  }
};

std::optional<Line> fit_line(std::vector<Vector2> points) {
  Line line;
  for (int round = 0; round < 3; ++round) {
    if (points.size() < kFewestPoints) return {};
    line.count = points.size();
    line.middle.setZero();
    for (const Vector2& p : points) line.middle += p / static_cast<double>(line.count);
    Eigen::Matrix2d moments = Eigen::Matrix2d::Zero();
    for (const Vector2& p : points) moments += (p - line.middle) * (p - line.middle).transpose();
    const Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d> axes(moments);
    line.normal = axes.eigenvectors().col(0), line.direction = axes.eigenvectors().col(1);
    line.scatter = std::sqrt(std::max(axes.eigenvalues()(0), 0.0) / static_cast<double>(line.count - 2));
    line.spread = std::sqrt(axes.eigenvalues()(1) / static_cast<double>(line.count));
    const double most = kOutlier * std::max(line.scatter, 1e-3);
    const auto kept = std::remove_if(points.begin(), points.end(), [&](const Vector2& p) {
      return std::abs(line.normal.dot(p - line.middle)) > most;
    });
    if (kept == points.end()) break;
    points.erase(kept, points.end());
  }
  if (!(line.spread > 0.0)) return {};
  return line;
}

}  // namespace

Gray gray(const capture::Image8& image) {
  Gray out{image.width, image.height, {}};
  out.pixels.resize(static_cast<std::size_t>(image.width) * image.height);
  for (std::size_t i = 0; i < out.pixels.size(); ++i) {
    const std::uint8_t* p = &image.pixels[i * image.channels];
    out.pixels[i] =
        image.channels >= 3 ? static_cast<std::uint8_t>((77 * p[0] + 150 * p[1] + 29 * p[2] + 128) >> 8) : p[0];
  }
  return out;
}

namespace {

using Cells = std::array<bool, kCells * kCells>;

// All tags of the family. All is black, the border of one cell too, but for a code's ones, of which the first is the
// highest.
const std::vector<Cells>& all_cells() {
  static const std::vector<Cells> all = [] {
    const FamilyPointer tags(kFamily.create(), kFamily.destroy);
    CHAINSPLAT_CHECK(tags->width_at_border == kCells, std::to_string(tags->width_at_border));
    std::vector<Cells> out(tags->ncodes);
    for (std::uint32_t id = 0; id < tags->ncodes; ++id) {
      out[id].fill(true);
      for (std::uint32_t bit = 0; bit < tags->nbits; ++bit)
        if (tags->codes[id] >> (tags->nbits - 1 - bit) & 1)
          out[id][tags->bit_y[bit] * kCells + tags->bit_x[bit]] = false;
    }
    return out;
  }();
  return all;
}

}  // namespace

int tags_in_family() { return static_cast<int>(all_cells().size()); }
Cells black_cells(int id) { return all_cells().at(id); }

std::vector<Tag> find_tags(const Gray& image, const Board& board, std::map<int, int>& others) {
  std::map<int, std::vector<Found>> by_id;
  for (const Found& found : detect(image, kFamily, kCorrectedBits)) by_id[found.id].push_back(found);
  std::vector<Tag> tags;
  for (const auto& [id, found] : by_id) {
    if (!board.has(id)) others[id] += 1;
    if (!board.has(id) || found.size() != 1) continue;
    Tag tag{id, found[0].corners, {}};
    for (int k = 0; k < 4; ++k) tag.edges[k] = edge_points(image, tag, k);
    tags.push_back(std::move(tag));
  }
  return tags;
}

std::vector<std::string> other_families(const Gray& image) {
  std::vector<std::string> out;
  for (const Family& family : kOthers) {
    std::string ids;
    int listed = 0;
    for (const Found& found : detect(image, family, 0))
      if (++listed <= 4) ids += (ids.empty() ? "" : ", ") + std::to_string(found.id);
    if (!ids.empty()) out.push_back(std::string(family.name) + " (" + ids + (listed > 4 ? ", ..." : "") + ")");
  }
  return out;
}

std::optional<std::array<Corner, 4>> corners(const Tag& tag, const capture::Camera& lens) {
  std::array<Line, 4> lines;
  for (int k = 0; k < 4; ++k) {
    std::vector<Vector2> points = tag.edges[k];
    if (lens.distorted())
      for (Vector2& p : points) p = capture::undistort(lens, p);
    const auto line = fit_line(std::move(points));
    if (!line) return {};
    lines[k] = *line;
  }
  std::array<Corner, 4> out;
  for (int k = 0; k < 4; ++k) {
    const Line &a = lines[(k + 3) % 4], &b = lines[k];
    Eigen::Matrix2d normals;
    normals << a.normal.transpose(), b.normal.transpose();
    if (std::abs(normals.determinant()) < 0.05) return {};
    const Eigen::Matrix2d inverse = normals.inverse();
    const Vector2 at = inverse * Vector2(a.normal.dot(a.middle), b.normal.dot(b.middle));
    const Vector2 variance(a.variance(at), b.variance(at));
    out[k].deviation = std::sqrt(0.5 * (inverse * variance.asDiagonal() * inverse.transpose()).trace());
    out[k].pixel = lens.distorted() ? capture::distort(lens, at) : at;
    if (!out[k].pixel.allFinite() || !std::isfinite(out[k].deviation)) return {};
  }
  return out;
}

}  // namespace chainsplat::calibration
