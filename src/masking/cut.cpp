// The mask of one picture: log odds per pixel, then a graph cut that puts contours where the picture has edges.
#include "src/masking/cut.h"

#include <algorithm>
#include <cmath>
#include <future>
#include <numeric>
#include <opencv2/core.hpp>
#include <opencv2/imgproc.hpp>
#include <opencv2/imgproc/detail/gcgraph.hpp>

namespace chainsplat::masking {

namespace {

// the log odds of place, from the distance to the tube's outline, which is accurate to about a pixel or two
constexpr double kPlacePixels = 0.6;                         // px per unit of log odds
constexpr double kSurelyInside = 4.0, kSurelyOutside = 8.0;  // inside, evidence of occlusion can outweigh the place
constexpr double kBand = 8.0;                                // px outside the tube, beyond which no pixel is labeled
// where the rope is hidden along its length
constexpr double kInsideFrom = 0.3, kBesideTo = 1.5;  // radii from the outline, so that the outline itself is left out
constexpr double kHiddenStep = 0.25;                  // diameters along the rope per step,
constexpr int kMostHiddenSteps = 4096;                // but no more steps than this, to bound memory for thin ropes
constexpr int kHiddenSteps = 2;                       // steps on either side that are pooled
constexpr double kSeen = 0.4;          // share of the usual log odds or of their usual change, below which it is hidden
constexpr double kSurelyHidden = 6.0;  // log odds
// where the picture lacks the rope's marks
constexpr int kUnusualWindow = 5;        // px, window for the share of unusual pixels inside the tube,
constexpr int kBesideWindow = 11;        // px, and beside the tube
constexpr double kFewUnusual = 0.5;      // share up to which the chain may merely be a little off
constexpr double kMostUnusual = 0.75;    // share of the whole tube beyond which the marks themselves must be wrong
constexpr double kSurelyUnusual = 12.0;  // log odds, enough to outweigh place and color
constexpr double kSurelyRope = 2.0;      // log odds of a color that is certainly the rope's
// the result
constexpr double kSpeck = 0.02;      // share of the largest part's area, below which a part is noise
constexpr double kLeastShare = 0.1;  // of the tube's area, below which the mask is not the rope
constexpr int kMargin = 24;          // px around the mask, as capture::load leaves

double squared_difference(const Picture& picture, int x, int y, int u, int v) {
  const std::uint8_t *a = pixel(picture, x, y), *b = pixel(picture, u, v);
  double sum = 0.0;
  for (int c = 0; c < 3; ++c) sum += (a[c] - b[c]) * (a[c] - b[c]);
  return sum;
}

// Of the eight neighbors of a pixel four are ahead of it; it is ahead of the other four.
constexpr int kAhead = 4;
constexpr int kNeighbors[kAhead][2] = {{1, 0}, {0, 1}, {1, 1}, {-1, 1}};

enum class Label : signed char { none, undecided, outside, inside };  // none: certainly outside, no part of the cut

// The pixels of a box, row by row, as nodes of a graph whose minimum cut is the outline.
struct Grid {
  int width = 0, height = 0;
  std::vector<Label> label;
  std::vector<double> odds;  // log odds for the inside, with what decided neighbors add
  std::vector<double>
      weight;  // cost of a contour between a pixel and each of the neighbors ahead; negative: none there

  // Calls body(neighbor, weight) for all that a pixel has.
  template <typename Body>
  void each_neighbor(std::size_t pixel, const Body& body) const {
    const int column = static_cast<int>(pixel % width), row = static_cast<int>(pixel / width);
    for (int k = 0; k < kAhead; ++k) {
      const std::ptrdiff_t step = kNeighbors[k][1] * width + kNeighbors[k][0];
      if (const double ahead = weight[kAhead * pixel + k]; ahead >= 0.0) body(pixel + step, ahead);
      const int x = column - kNeighbors[k][0], y = row - kNeighbors[k][1];
      if (x < 0 || x >= width || y < 0) continue;
      if (const double behind = weight[kAhead * (pixel - step) + k]; behind >= 0.0) body(pixel - step, behind);
    }
  }
};

// Turns squared differences of colors, whole numbers, into costs. As in GrabCut they are scaled by the picture's own
// mean difference, `mean`.
void weigh(std::vector<double>& weight, double mean) {
  const double beta = mean > 0.0 ? 1.0 / (2.0 * mean) : 0.0;
  // most differences are small: their exponentials are computed once
  constexpr std::size_t kTable = 2048;
  std::vector<double> table(std::min(kTable, weight.size()));
  for (std::size_t d = 0; d < table.size(); ++d) table[d] = kContour * std::exp(-beta * static_cast<double>(d));
  for (std::size_t at = 0; at < weight.size(); ++at) {
    const double difference = weight[at];
    if (difference < 0.0) continue;
    const auto whole = static_cast<std::size_t>(difference);
    const double straight = whole < table.size() ? table[whole] : kContour * std::exp(-beta * difference);
    weight[at] = straight * (at % kAhead < 2 ? 1.0 : M_SQRT1_2);
  }
}

Grid grid_of(const Picture& picture, const math::Rectangle& box, const std::vector<float>& odds) {
  Grid grid{box.width(), box.height(), std::vector<Label>(odds.size(), Label::none), {odds.begin(), odds.end()}, {}};
  for (std::size_t i = 0; i < odds.size(); ++i)
    if (!std::isnan(odds[i])) grid.label[i] = Label::undecided;
  grid.weight.assign(kAhead * odds.size(), -1.0);
  std::vector<double> sums(grid.height, 0.0);  // per row, of whole numbers: exact in any order
  std::vector<int> numbers(grid.height, 0);
  cv::parallel_for_({0, grid.height}, [&](const cv::Range& rows) {
    for (int y = rows.start; y < rows.end; ++y)
      for (int x = 0; x < grid.width; ++x) {
        const std::size_t i = static_cast<std::size_t>(y) * grid.width + x;
        if (grid.label[i] == Label::none) continue;
        for (int k = 0; k < kAhead; ++k) {
          const int u = x + kNeighbors[k][0], v = y + kNeighbors[k][1];
          if (u < 0 || u >= grid.width || v >= grid.height) continue;
          if (grid.label[static_cast<std::size_t>(v) * grid.width + u] == Label::none) continue;
          const double difference = squared_difference(picture, box.x0 + x, box.y0 + y, box.x0 + u, box.y0 + v);
          grid.weight[kAhead * i + k] = difference;
          sums[y] += difference, ++numbers[y];
        }
      }
  });
  const double sum = std::accumulate(sums.begin(), sums.end(), 0.0);
  const int pairs = std::accumulate(numbers.begin(), numbers.end(), 0);
  weigh(grid.weight, pairs > 0 ? sum / pairs : 0.0);
  return grid;
}

// Labels the pixels whose odds outweigh all contours that there could be to undecided neighbors: no minimum cut has
// them otherwise. Most pixels are such; what remains is a band about the outline.
void decide(Grid& grid) {
  constexpr double kMostContours = kAhead * kContour * (1.0 + M_SQRT1_2);
  constexpr double kRounding = 1e-9;  // of sums of weights
  const auto settle = [&](std::size_t i, double contours) {
    if (std::abs(grid.odds[i]) <= contours + kRounding) return false;
    grid.label[i] = grid.odds[i] > 0.0 ? Label::inside : Label::outside;
    return true;
  };
  std::vector<std::size_t> band;
  for (std::size_t i = 0; i < grid.label.size(); ++i)
    if (grid.label[i] == Label::undecided && !settle(i, kMostContours)) band.push_back(i);
  std::vector<double> contours(grid.label.size());  // to undecided neighbors
  for (const std::size_t i : band)
    grid.each_neighbor(i, [&](std::size_t other, double weight) {
      if (grid.label[other] == Label::undecided)
        contours[i] += weight;
      else
        grid.odds[i] += grid.label[other] == Label::inside ? weight : -weight;
    });
  while (!band.empty()) {  // a pixel that is decided may decide its neighbors
    const std::size_t i = band.back();
    band.pop_back();
    if (grid.label[i] != Label::undecided || !settle(i, contours[i])) continue;
    grid.each_neighbor(i, [&](std::size_t other, double weight) {
      if (grid.label[other] != Label::undecided) return;
      contours[other] -= weight;
      grid.odds[other] += grid.label[i] == Label::inside ? weight : -weight;
      band.push_back(other);
    });
  }
}

// Labels the pixels that are left.
void cut_band(Grid& grid) {
  std::vector<int> node(grid.label.size(), -1);
  std::vector<std::size_t> band;
  for (std::size_t i = 0; i < grid.label.size(); ++i)
    if (grid.label[i] == Label::undecided) {
      node[i] = static_cast<int>(band.size());
      band.push_back(i);
    }
  cv::detail::GCGraph<double> graph(static_cast<unsigned>(band.size()),
                                    static_cast<unsigned>(2 * kAhead * band.size()));
  for (const std::size_t i : band) {
    graph.addVtx();
    graph.addTermWeights(node[i], std::max(0.0, grid.odds[i]), std::max(0.0, -grid.odds[i]));
  }
  bool joined = false;
  for (const std::size_t i : band)
    for (int k = 0; k < kAhead; ++k) {
      const double weight = grid.weight[kAhead * i + k];
      if (weight < 0.0) continue;
      const std::size_t other = i + kNeighbors[k][1] * grid.width + kNeighbors[k][0];
      if (grid.label[other] != Label::undecided) continue;
      graph.addEdges(node[i], node[other], weight, weight);
      joined = true;
    }
  if (!joined) return;  // either label costs these pixels the same: they count as outside
  graph.maxFlow();
  for (const std::size_t i : band) grid.label[i] = graph.inSourceSegment(node[i]) ? Label::inside : Label::outside;
}

const Colors& colors_at(const Look& appearance, const chain::Chain& chain, double arclength) {
  return arclength < 0.5 * chain.length ? appearance.near : appearance.far;
}

// Where a hand hides the rope, the tube does not have the rope's colors and the picture does not change at the tube's
// outline as it does elsewhere. Returns log odds per arclength, in steps of `step` m; they are 0 or negative.
std::vector<double> hidden_odds(const Look& appearance, const Picture& picture, const Tube& place,
                                const chain::Chain& chain, double step) {
  struct Sum {
    double odds = 0.0;
    int pixels = 0;
  };
  // sum the colors' log odds inside and beside the tube, per step and its neighbors
  const int steps = static_cast<int>(chain.length / step) + 1;
  std::vector<Sum> inside(steps), beside(steps);
  for (int y = place.box.y0; y < place.box.y1; ++y)
    for (int x = place.box.x0; x < place.box.x1; ++x) {
      const double outside = place.at(x, y) / place.radius;
      if (outside > kBesideTo || (outside > -kInsideFrom && outside < kInsideFrom)) continue;
      const double arclength = place.arclength(x, y);
      const double odds = color_odds(colors_at(appearance, chain, arclength), pixel(picture, x, y));
      const int at = static_cast<int>(arclength / step);
      for (int k = std::max(0, at - kHiddenSteps); k <= std::min(steps - 1, at + kHiddenSteps); ++k) {
        Sum& sum = (outside < 0.0 ? inside : beside)[k];
        sum.odds += odds, ++sum.pixels;
      }
    }
  // compare them with what is usual
  std::vector<double> out(steps, 0.0);
  for (int k = 0; k < steps; ++k) {
    const Colors& colors = colors_at(appearance, chain, k * step);
    if (inside[k].pixels == 0 || beside[k].pixels == 0 || colors.usual <= 0.0) continue;
    const double mean = inside[k].odds / inside[k].pixels;
    const double separation = mean - beside[k].odds / beside[k].pixels;
    // a hand beside the rope lowers the second share but not the first
    const double visibility = std::max(mean / colors.usual, separation / colors.separation);
    out[k] = std::clamp((visibility / kSeen - 1.0) * kSurelyHidden, -kSurelyHidden, 0.0);
  }
  return out;
}

// Where the tube does not have the rope's marks, something may hide it. Returns log odds per pixel of the box, 0 or
// negative; empty where the marks themselves must be wrong. Colors that are certainly the rope's do not count as
// hidden, whatever the marks, because the rope may have turned about itself.
cv::Mat unusual_odds(const Look& appearance, const Picture& picture, const Tube& place, const chain::Chain& chain) {
  // mark the tube's pixels and those among them without the marks
  const math::Rectangle& box = place.box;
  cv::Mat in_tube(box.height(), box.width(), CV_32F, cv::Scalar(0)), other = in_tube.clone();
  int pixels = 0, unusual = 0;
  for (int y = box.y0; y < box.y1; ++y)
    for (int x = box.x0; x < box.x1; ++x) {
      if (place.at(x, y) >= 0.0f) continue;
      const Colors& colors = colors_at(appearance, chain, place.arclength(x, y));
      const bool is_other =
          !usual(appearance.marks, place, picture, x, y) && color_odds(colors, pixel(picture, x, y)) < kSurelyRope;
      in_tube.at<float>(y - box.y0, x - box.x0) = 1.0f;
      other.at<float>(y - box.y0, x - box.x0) = is_other;
      ++pixels, unusual += is_other;
    }
  if (unusual > kMostUnusual * pixels) return {};
  const auto mean_about = [](const cv::Mat& values, int window) {
    cv::Mat mean;
    cv::boxFilter(values, mean, -1, cv::Size(window, window));
    return mean;
  };
  // the share of such pixels nearby, beside the tube too, because what hides a piece of the tube goes on beside it
  const cv::Mat near_tube = mean_about(in_tube, kUnusualWindow), near_other = mean_about(other, kUnusualWindow);
  const cv::Mat far_tube = mean_about(in_tube, kBesideWindow), far_other = mean_about(other, kBesideWindow);
  cv::Mat odds(box.height(), box.width(), CV_32F);
  for (int y = 0; y < box.height(); ++y)
    for (int x = 0; x < box.width(); ++x) {
      const bool inside = in_tube.at<float>(y, x) > 0.0f;
      const float all = (inside ? near_tube : far_tube).at<float>(y, x);
      const double share = (inside ? near_other : far_other).at<float>(y, x) / std::max(1e-6f, all);
      odds.at<float>(y, x) =
          static_cast<float>(-kSurelyUnusual * std::clamp((share - kFewUnusual) / (1.0 - kFewUnusual), 0.0, 1.0));
    }
  return odds;
}

// Removes small parts and returns the area that remains.
int without_specks(cv::Mat& labels) {
  cv::Mat parts, facts, centers;
  const int count = cv::connectedComponentsWithStats(labels, parts, facts, centers, 8);
  int largest = 0, area = 0;
  for (int i = 1; i < count; ++i) largest = std::max(largest, facts.at<int>(i, cv::CC_STAT_AREA));
  for (int y = 0; y < labels.rows; ++y)
    for (int x = 0; x < labels.cols; ++x) {
      std::uint8_t& label = labels.at<std::uint8_t>(y, x);
      if (label && facts.at<int>(parts.at<int>(y, x), cv::CC_STAT_AREA) < kSpeck * largest) label = 0;
      area += label != 0;
    }
  return area;
}

}  // namespace

std::vector<std::uint8_t> least_cut(const Picture& picture, const math::Rectangle& box,
                                    const std::vector<float>& odds) {
  Grid grid = grid_of(picture, box, odds);
  decide(grid);
  cut_band(grid);
  std::vector<std::uint8_t> labels(grid.label.size());
  std::transform(grid.label.begin(), grid.label.end(), labels.begin(),
                 [](Label label) { return label == Label::inside ? 255 : 0; });
  return labels;
}

Tube expected_tube(const chain::Chain& chain, const math::Pose& base, const math::VectorX& theta,
                   const capture::Camera& camera, double doubt) {
  return tube(chain, base, theta, camera, 0.0, chain.length, kBand + (doubt - 1.0) * 2.0 * kPlacePixels);
}

capture::View cut(const Look& appearance, const Picture& picture, const capture::Camera& camera,
                  const chain::Chain& chain, const math::Pose& base, const Tube* place, double doubt) {
  // where the rope is expected, and where it may be hidden
  const Reach where = reach(chain, base, camera);
  const math::Rectangle box = place ? place->box : where.box;
  capture::View view;
  if (box.empty()) return view;
  std::vector<float> odds(static_cast<std::size_t>(box.width()) * box.height(), std::nanf(""));
  const double step = std::max(kHiddenStep * chain.diameter, chain.length / kMostHiddenSteps);
  std::future<std::vector<double>> hiding;
  if (place)
    hiding = std::async(std::launch::async, [&] { return hidden_odds(appearance, picture, *place, chain, step); });
  cv::Mat unusual;
  if (place && appearance.marks.along > 0) unusual = unusual_odds(appearance, picture, *place, chain);
  const std::vector<double> hidden = place ? hiding.get() : std::vector<double>();
  // add the log odds of place, color, occlusion and background per pixel
  std::vector<int> inside(box.height(), 0);
  cv::parallel_for_({box.y0, box.y1}, [&](const cv::Range& rows) {
    for (int y = rows.start; y < rows.end; ++y)
      for (int x = box.x0; x < box.x1; ++x) {
        double sum = 0.0;
        if (place) {
          const float outside = place->at(x, y);
          if (outside == Tube::kFar) continue;
          inside[y - box.y0] += outside < 0.0f;
          sum = std::clamp(-outside / (doubt * kPlacePixels), -kSurelyOutside, kSurelyInside);
        } else if (!where.holds(x, y)) {
          continue;
        }
        const std::uint8_t* const rgb = pixel(picture, x, y);
        if (place) {
          const double arclength = place->arclength(x, y);
          sum += color_odds(colors_at(appearance, chain, arclength), rgb) +
                 hidden[static_cast<std::size_t>(std::min(arclength, chain.length) / step)];
          if (!unusual.empty()) sum += unusual.at<float>(y - box.y0, x - box.x0);
        } else {
          sum += std::max(color_odds(appearance.near, rgb), color_odds(appearance.far, rgb));
        }
        sum += difference_odds(appearance.background, picture, x, y);
        odds[static_cast<std::size_t>(y - box.y0) * box.width() + (x - box.x0)] = static_cast<float>(sum);
      }
  });
  const double tube_area = std::accumulate(inside.begin(), inside.end(), 0);
  // label the pixels
  cv::Mat labels;
  if (place) {
    cv::Mat(box.height(), box.width(), CV_8U, least_cut(picture, box, odds).data()).copyTo(labels);
  } else {  // rough odds over a large area: the majority of each neighborhood decides
    labels = cv::Mat(box.height(), box.width(), CV_8U, cv::Scalar(0));
    for (std::size_t i = 0; i < odds.size(); ++i) labels.data[i] = odds[i] > 0.0f ? 255 : 0;
    cv::medianBlur(labels, labels, 5);
  }
  const int area = without_specks(labels);
  if (area == 0 || area < kLeastShare * tube_area) return view;
  // crop
  const cv::Rect bounds = cv::boundingRect(labels);
  view.x0 = std::max(0, box.x0 + bounds.x - kMargin), view.y0 = std::max(0, box.y0 + bounds.y - kMargin);
  view.width = std::min(camera.width, box.x0 + bounds.x + bounds.width + kMargin) - view.x0;
  view.height = std::min(camera.height, box.y0 + bounds.y + bounds.height + kMargin) - view.y0;
  view.rgba.assign(static_cast<std::size_t>(4) * view.width * view.height, 0);
  for (int y = bounds.y; y < bounds.y + bounds.height; ++y)
    for (int x = bounds.x; x < bounds.x + bounds.width; ++x) {
      if (labels.at<std::uint8_t>(y, x) == 0) continue;
      std::uint8_t* const out =
          &view.rgba[4 * (static_cast<std::size_t>(box.y0 + y - view.y0) * view.width + box.x0 + x - view.x0)];
      std::copy_n(pixel(picture, box.x0 + x, box.y0 + y), 3, out);
      out[3] = 255;
    }
  return view;
}

capture::View cut(const Look& appearance, const Picture& picture, const capture::Camera& camera,
                  const chain::Chain& chain, const math::Pose& base, const math::VectorX& theta, double doubt) {
  const Tube place = expected_tube(chain, base, theta, camera, doubt);
  return cut(appearance, picture, camera, chain, base, &place, doubt);
}

}  // namespace chainsplat::masking
