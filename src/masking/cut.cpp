// The mask of one picture: log odds per pixel, then a graph cut that puts contours where the picture has edges.
#include "src/masking/cut.h"

#include <algorithm>
#include <cmath>
#include <opencv2/core.hpp>
#include <opencv2/imgproc.hpp>
#include <opencv2/imgproc/detail/gcgraph.hpp>

namespace chainsplat::masking {

namespace {

// the log odds of place, from the distance to the tube's outline, which is accurate to about a pixel or two
constexpr double kPlacePixels = 0.6;                         // px per unit of log odds
constexpr double kSurelyInside = 4.0, kSurelyOutside = 8.0;  // inside, evidence of occlusion can outweigh the place
constexpr double kBand = 8.0;                                // px outside the tube, beyond which no pixel is labeled
// the graph cut
constexpr double kContour = 2.0;  // cost per pixel of a contour through a plain area
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

constexpr int kNeighbors[4][2] = {{1, 0}, {0, 1}, {1, 1}, {-1, 1}};

// Returns the labels (0 or 255) of the box's pixels by a minimum cut. `odds`: log odds per pixel, NaN where the pixel
// is certainly outside.
cv::Mat least_cut(const Picture& picture, const math::Rectangle& box, const std::vector<float>& odds) {
  const int width = box.width(), height = box.height();
  // one node per undecided pixel
  std::vector<int> node(odds.size(), -1);
  int nodes = 0;
  for (std::size_t i = 0; i < odds.size(); ++i)
    if (!std::isnan(odds[i])) node[i] = nodes++;
  // as in GrabCut, differences between neighbors are scaled by the picture's own mean difference
  double sum = 0.0;
  int pairs = 0;
  const auto each_pair = [&](const auto& body) {
    for (int y = 0; y < height; ++y)
      for (int x = 0; x < width; ++x) {
        const int i = y * width + x;
        if (node[i] < 0) continue;
        for (const auto& step : kNeighbors) {
          const int u = x + step[0], v = y + step[1];
          if (u < 0 || u >= width || v >= height || node[v * width + u] < 0) continue;
          body(i, v * width + u, squared_difference(picture, box.x0 + x, box.y0 + y, box.x0 + u, box.y0 + v),
               step[0] != 0 && step[1] != 0);
        }
      }
  };
  each_pair([&](int, int, double difference, bool) { sum += difference, ++pairs; });
  const double beta = sum > 0.0 ? pairs / (2.0 * sum) : 0.0;
  // build the graph, cut it and read the labels
  cv::detail::GCGraph<double> graph(nodes, 2 * pairs);
  for (std::size_t i = 0; i < odds.size(); ++i) {
    if (node[i] < 0) continue;
    graph.addVtx();
    graph.addTermWeights(node[i], std::max(0.0f, odds[i]), std::max(0.0f, -odds[i]));
  }
  each_pair([&](int i, int j, double difference, bool diagonal) {
    const double weight = kContour * std::exp(-beta * difference) * (diagonal ? M_SQRT1_2 : 1.0);
    graph.addEdges(node[i], node[j], weight, weight);
  });
  graph.maxFlow();
  cv::Mat labels(height, width, CV_8U, cv::Scalar(0));
  for (int i = 0; i < width * height; ++i)
    if (node[i] >= 0 && graph.inSourceSegment(node[i])) labels.data[i] = 255;
  return labels;
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

capture::View cut(const Look& appearance, const Picture& picture, const capture::Camera& camera,
                  const chain::Chain& chain, const math::Pose& base, const std::optional<math::VectorX>& theta,
                  double doubt) {
  // where the rope is expected, and where it may be hidden
  const Reach where = reach(chain, base, camera);
  Tube place;
  if (theta) place = tube(chain, base, *theta, camera, 0.0, chain.length, kBand + (doubt - 1.0) * 2.0 * kPlacePixels);
  const math::Rectangle box = theta ? place.box : where.box;
  capture::View view;
  if (box.empty()) return view;
  std::vector<float> odds(static_cast<std::size_t>(box.width()) * box.height(), std::nanf(""));
  const double step = std::max(kHiddenStep * chain.diameter, chain.length / kMostHiddenSteps);
  std::vector<double> hidden;
  if (theta) hidden = hidden_odds(appearance, picture, place, chain, step);
  cv::Mat unusual;
  if (theta && appearance.marks.along > 0) unusual = unusual_odds(appearance, picture, place, chain);
  // add the log odds of place, color, occlusion and background per pixel
  double tube_area = 0.0;
  for (int y = box.y0; y < box.y1; ++y)
    for (int x = box.x0; x < box.x1; ++x) {
      double sum = 0.0;
      if (theta) {
        const float outside = place.at(x, y);
        if (outside == Tube::kFar) continue;
        tube_area += outside < 0.0f;
        sum = std::clamp(-outside / (doubt * kPlacePixels), -kSurelyOutside, kSurelyInside);
      } else if (!where.holds(x, y)) {
        continue;
      }
      const std::uint8_t* const rgb = pixel(picture, x, y);
      if (theta) {
        const double arclength = place.arclength(x, y);
        sum += color_odds(colors_at(appearance, chain, arclength), rgb) +
               hidden[static_cast<std::size_t>(std::min(arclength, chain.length) / step)];
        if (!unusual.empty()) sum += unusual.at<float>(y - box.y0, x - box.x0);
      } else {
        sum += std::max(color_odds(appearance.near, rgb), color_odds(appearance.far, rgb));
      }
      sum += difference_odds(appearance.background, picture, x, y);
      odds[static_cast<std::size_t>(y - box.y0) * box.width() + (x - box.x0)] = static_cast<float>(sum);
    }
  // label the pixels
  cv::Mat labels;
  if (theta) {
    labels = least_cut(picture, box, odds);
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

}  // namespace chainsplat::masking
