#include "src/masking/ribbon.h"

#include <algorithm>
#include <array>
#include <cmath>

namespace chainsplat::masking {

using math::Vector2;

namespace {

// the straightened picture, in usual radii
constexpr double kStep = 0.5, kLeastStep = 0.7;        // along: radii, and at least so many px
constexpr double kAcross = 0.16, kLeastAcross = 0.25;  // across: radii, and px
constexpr double kReach = 3.2, kMoreReach = 2.0;       // on either side: radii, and so many px more
constexpr int kMostStations = 4096, kMostAcross = 64;
// what counts, per radius of length
constexpr double kColor = 0.25;     // per unit of log odds and radius of width
constexpr double kMostOdds = 2.5;   // of one sample
constexpr double kEdge = 1.6;       // of a full step at one outline,
constexpr double kFullStep = 25.0;  // gray levels at which a step counts half
constexpr double kSteepest = 0.5;   // radii, about a place, among which the steepest counts
constexpr double kCenter = 0.8;     // radii, deviation of the rope's middle from the axis
constexpr double kWiderTip = 0.3;   // deviation of the width where a connector may be, per unit of width
constexpr double kTipShare = 0.15;  // of the length
constexpr double kMove = 0.35;      // for each step of an outline across, from one station to the next
constexpr double kLeastWidth = 0.5, kMostWidth = 2.9;  // of the usual one
// the ends
constexpr double kEndSigma = 0.4;  // of the slack
constexpr double kEndStep = 4.0;   // of a full step of color along the rope there

// the evidence
constexpr double kSeen = 10.0;              // gray levels, the least contrast that is one
constexpr double kLeastSpread = 6.0;        // gray levels, of the rope's colors along it,
constexpr int kParts = 6, kOtherParts = 3;  // of the rope; in so many others a color must come back,
constexpr double kAlike = 14.0;             // to within so many gray levels
constexpr double kUnlike = 4.0;             // and times their usual spread, from where on it is another color

double square(double x) { return x * x; }

using Color = std::array<float, 3>;

Color color_at(const Picture& picture, const Vector2& at) {
  const double x = std::clamp(at.x() - 0.5, 0.0, picture.width - 1.001),
               y = std::clamp(at.y() - 0.5, 0.0, picture.height - 1.001);
  const int u = static_cast<int>(x), v = static_cast<int>(y);
  const double a = x - u, b = y - v;
  const int right = std::min(u + 1, picture.width - 1), below = std::min(v + 1, picture.height - 1);
  const std::uint8_t *const p = pixel(picture, u, v), *const q = pixel(picture, right, v),
                            *const r = pixel(picture, u, below), *const s = pixel(picture, right, below);
  Color out;
  for (int c = 0; c < 3; ++c)
    out[c] = static_cast<float>((1 - b) * ((1 - a) * p[c] + a * q[c]) + b * ((1 - a) * r[c] + a * s[c]));
  return out;
}

double difference(const Color& a, const Color& b) {
  double sum = 0.0;
  for (int c = 0; c < 3; ++c) sum += square(a[c] - b[c]);
  return std::sqrt(sum / 3.0);
}

struct Station {
  Vector2 at, across;
  double arclength = 0.0, radius = 0.0;
};

// Stations at even steps along the axis, which is rounded at its corners and goes on straight beyond both ends.
std::vector<Station> stations_of(const Axis& axis, double from, double to, double radius) {
  const std::vector<AxisPoint>& points = axis.points;
  double pixels = 0.0;
  for (std::size_t i = 1; i < points.size(); ++i) pixels += (points[i].at - points[i - 1].at).norm();
  const double span = points.back().arclength - points.front().arclength;
  const double per_meter = pixels / std::max(1e-9, span);
  const double step = std::max({kStep * radius, kLeastStep, (to - from) * per_meter / kMostStations});
  const int count = std::max(8, static_cast<int>((to - from) * per_meter / step) + 1);
  std::vector<Station> out(count);
  std::size_t k = 0;
  for (int i = 0; i < count; ++i) {
    Station& s = out[i];
    s.arclength = from + (to - from) * i / (count - 1);
    while (k + 2 < points.size() && points[k + 1].arclength < s.arclength) ++k;
    const AxisPoint &a = points[k], &b = points[k + 1];
    const double t = (s.arclength - a.arclength) / std::max(1e-12, b.arclength - a.arclength);
    s.at = a.at + t * (b.at - a.at);
    s.radius = a.radius + std::clamp(t, 0.0, 1.0) * (b.radius - a.radius);
  }
  // corners of links become bends
  const int about = std::max(1, static_cast<int>(std::lround(0.04 * count)));
  std::vector<Vector2> round(count);
  for (int i = 0; i < count; ++i) {
    const int reach = std::min({about, i, count - 1 - i});
    Vector2 sum = Vector2::Zero();
    for (int j = i - reach; j <= i + reach; ++j) sum += out[j].at;
    round[i] = sum / (2 * reach + 1);
  }
  for (int i = 0; i < count; ++i) {
    out[i].at = round[i];
    const Vector2 along = round[std::min(count - 1, i + 2)] - round[std::max(0, i - 2)];
    const double norm = along.norm();
    out[i].across = norm > 1e-9 ? Vector2(-along.y() / norm, along.x() / norm) : Vector2(1.0, 0.0);
  }
  return out;
}

double median_of(std::vector<double> values) {
  if (values.empty()) return 0.0;
  std::nth_element(values.begin(), values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2), values.end());
  return values[values.size() / 2];
}

}  // namespace

Ribbon find_ribbon(const Look& look, const Picture& picture, const Axis& along, double length,
                   const RibbonOptions& options) {
  Ribbon out;
  if (along.points.size() < 2) return out;
  double radius = 0.0;  // px, of the given axis
  for (const AxisPoint& p : along.points) radius += p.radius / static_cast<double>(along.points.size());
  radius = std::max(0.5, radius);
  const std::vector<Station> stations = stations_of(along, -options.slack, length + options.slack, radius);
  const int count = static_cast<int>(stations.size());
  // straighten the picture
  const double reach = kReach * options.width * radius + kMoreReach;
  const double du = std::max({kAcross * radius, kLeastAcross, 2.0 * reach / kMostAcross});  // px
  const int half = static_cast<int>(reach / du), columns = 2 * half + 1;
  std::vector<Color> colors(static_cast<std::size_t>(count) * columns);
  std::vector<double> odds(colors.size()), steps(colors.size(), 0.0);
  const auto at = [&](int i, int k) { return static_cast<std::size_t>(i) * columns + k; };
  for (int i = 0; i < count; ++i) {
    const Station& s = stations[i];
    const Colors& known = s.arclength < 0.5 * length ? look.near : look.far;
    for (int k = 0; k < columns; ++k) {
      const Vector2 place = s.at + (k - half) * du * s.across;
      colors[at(i, k)] = color_at(picture, place);
      const int x = std::clamp(static_cast<int>(place.x()), 0, picture.width - 1),
                y = std::clamp(static_cast<int>(place.y()), 0, picture.height - 1);
      odds[at(i, k)] =
          std::clamp(color_odds(known, pixel(picture, x, y)) + 2.0 * difference_odds(look.background, picture, x, y),
                     -kMostOdds, kMostOdds);
    }
  }
  // steps between columns: the colors on either side, averaged over a radius of length
  const int apart = std::max(1, static_cast<int>(std::lround(std::max(0.75, 0.2 * radius) / du)));
  const double ds = (stations[1].at - stations[0].at).norm();  // px
  const int about = std::max(1, static_cast<int>(radius / std::max(0.1, ds)));
  std::vector<Color> mean(colors.size());
  for (int k = 0; k < columns; ++k)
    for (int i = 0; i < count; ++i) {
      Color sum{};
      int n = 0;
      for (int j = std::max(0, i - about); j <= std::min(count - 1, i + about); ++j, ++n)
        for (int c = 0; c < 3; ++c) sum[c] += colors[at(j, k)][c];
      for (int c = 0; c < 3; ++c) mean[at(i, k)][c] = sum[c] / static_cast<float>(n);
    }
  // a full step counts fully at its steepest place only, which is where the outline is
  const int near = std::max(1, static_cast<int>(kSteepest * radius / du));
  std::vector<double> across(columns, 0.0);
  for (int i = 0; i < count; ++i) {
    for (int k = 1; k < columns; ++k)  // between the columns k - 1 and k
      across[k] = difference(mean[at(i, std::max(0, k - apart))], mean[at(i, std::min(columns - 1, k + apart - 1))]);
    for (int k = 1; k < columns; ++k) {
      const auto first = across.begin() + std::max(1, k - near),
                 last = across.begin() + std::min(columns, k + near + 1);
      const double d = across[k];
      steps[at(i, k)] = d * d / (std::max(1e-9, *std::max_element(first, last)) * (d + kFullStep));
    }
  }
  // states: the left outline lies before column a, the right one before column b
  struct State {
    int a, b;
  };
  const double usual = options.width * radius;  // px
  const auto usual_at = [&](int i) { return options.width * std::max(0.5, stations[i].radius); };
  std::vector<State> states;
  std::vector<int> index(static_cast<std::size_t>(columns + 1) * (columns + 1), -1);
  for (int a = 1; a < columns; ++a)
    for (int b = a + 1; b < columns; ++b) {
      const double wide = 0.5 * (b - a) * du / usual, middle = std::abs((0.5 * (a + b) - 0.5 - half) * du) / usual;
      if (wide < kLeastWidth || wide > kMostWidth || middle > 2.0) continue;
      index[static_cast<std::size_t>(a) * (columns + 1) + b] = static_cast<int>(states.size());
      states.push_back({a, b});
    }
  if (states.empty()) return out;
  const double weight = ds / radius;  // facts of one station
  const auto cost_of = [&](int i, const State& s, const std::vector<double>& sums) {
    const double expected = usual_at(i);
    const double wide = 0.5 * (s.b - s.a) * du / expected, middle = (0.5 * (s.a + s.b) - 0.5 - half) * du / expected;
    const bool tip = stations[i].arclength > (1.0 - kTipShare) * length && wide > 1.0;
    const double width = tip ? kWiderTip * (wide - 1.0) : 0.5 * square((wide - 1.0) / options.width_deviation);
    return weight * (width + 0.5 * square(middle / kCenter) - kColor * (sums[s.b] - sums[s.a]) * du / radius -
                     kEdge * (steps[at(i, s.a)] + steps[at(i, s.b)]));
  };
  // the cheapest way
  const int many = static_cast<int>(states.size());
  std::vector<double> best(many), next(many);
  std::vector<std::uint8_t> came(static_cast<std::size_t>(count) * many, 4);
  std::vector<double> sums(columns + 1, 0.0);
  for (int i = 0; i < count; ++i) {
    for (int k = 0; k < columns; ++k) sums[k + 1] = sums[k] + odds[at(i, k)];
    for (int n = 0; n < many; ++n) {
      double least = i ? 1e300 : 0.0;
      std::uint8_t from = 4;
      for (int move = 0; i && move < 9; ++move) {
        const int a = states[n].a + move / 3 - 1, b = states[n].b + move % 3 - 1;
        if (a < 1 || b >= columns || b <= a) continue;
        const int m = index[static_cast<std::size_t>(a) * (columns + 1) + b];
        if (m < 0) continue;
        const double one = best[m] + kMove * ((move / 3 != 1) + (move % 3 != 1));
        if (one < least) least = one, from = static_cast<std::uint8_t>(move);
      }
      next[n] = least + cost_of(i, states[n], sums);
      came[static_cast<std::size_t>(i) * many + n] = from;
    }
    std::swap(best, next);
  }
  std::vector<State> way(count);
  int n = static_cast<int>(std::min_element(best.begin(), best.end()) - best.begin());
  for (int i = count - 1; i >= 0; --i) {
    way[i] = states[n];
    const int move = came[static_cast<std::size_t>(i) * many + n];
    if (i) n = index[static_cast<std::size_t>(states[n].a + move / 3 - 1) * (columns + 1) + states[n].b + move % 3 - 1];
  }
  // where it begins and ends: what each station says for the rope, summed up
  std::vector<double> edges, speaks(count);
  for (int i = 0; i < count; ++i) edges.push_back(std::min(steps[at(i, way[i].a)], steps[at(i, way[i].b)]));
  const double typical = std::max(0.05, median_of(edges));
  for (int i = 0; i < count; ++i) {
    double inside = 0.0;
    for (int k = way[i].a; k < way[i].b; ++k) inside += odds[at(i, k)] / (way[i].b - way[i].a);
    speaks[i] = weight * (std::clamp(inside, -1.0, 1.0) + std::clamp(edges[i] / typical - 0.5, -0.5, 0.5));
  }
  // the change of color along the rope, from the radius before a station to the one from it on
  std::vector<Color> middle(count);
  for (int i = 0; i < count; ++i) {
    const int center = (way[i].a + way[i].b) / 2, around = (way[i].b - way[i].a) / 4;
    for (int k = center - around; k <= center + around; ++k)
      for (int c = 0; c < 3; ++c) middle[i][c] += colors[at(i, k)][c] / static_cast<float>(2 * around + 1);
  }
  const auto change = [&](int i) {
    Color before{}, after{};
    if (i - about < 0 || i + about > count) return 0.0;
    for (int j = 0; j < about; ++j)
      for (int c = 0; c < 3; ++c) {
        before[c] += middle[i - 1 - j][c] / static_cast<float>(about);
        after[c] += middle[i + j][c] / static_cast<float>(about);
      }
    const double d = difference(before, after);
    return kEndStep * d / (d + kFullStep);
  };
  const double sigma = std::max(1e-4, kEndSigma * options.slack);
  int begin = 0, end = count;
  double most = -1e300, sum = 0.0;
  for (int i = count - 1; i >= 0 && stations[i].arclength > -options.slack; --i) {
    sum += speaks[i];
    if (stations[i].arclength > 2.0 * options.slack) continue;
    const double value = sum + change(i) - 0.5 * square(std::max(0.0, -stations[i].arclength) / sigma);
    if (value > most) most = value, begin = i;
  }
  most = -1e300, sum = 0.0;
  for (int i = 0; i < count; ++i) {
    sum += speaks[i];
    if (stations[i].arclength < length - options.slack) continue;
    const double value = sum + change(i + 1) - 0.5 * square((stations[i].arclength - length) / sigma);
    if (value > most) most = value, end = i + 1;
  }
  if (end - begin < 4) return out;
  std::vector<double> widths;
  for (int i = begin; i < end; ++i) {
    const double left = (way[i].a - 0.5 - half) * du, right = (way[i].b - 0.5 - half) * du;
    out.axis.points.push_back(
        {stations[i].at + 0.5 * (left + right) * stations[i].across, 0.5 * (right - left), stations[i].arclength});
    if (stations[i].arclength < (1.0 - kTipShare) * length) widths.push_back(0.5 * (right - left) / stations[i].radius);
  }
  out.axis.bulge = along.bulge;
  out.width = widths.empty() ? 1.0 : median_of(widths);
  return out;
}

Evidence evidence(const Picture& picture, const Axis& axis) {
  Evidence out;
  const std::vector<AxisPoint>& points = axis.points;
  const int count = static_cast<int>(points.size());
  if (count < 4) return out;
  // the colors inside and on either side, averaged over about a diameter of length
  std::vector<Color> sides[3];
  double pixels = 0.0;
  for (int i = 1; i < count; ++i) pixels += (points[i].at - points[i - 1].at).norm();
  double radius = 0.0;
  for (const AxisPoint& p : points) radius += p.radius / count;
  const int about = std::max(1, static_cast<int>(radius / std::max(0.1, pixels / count)));
  for (int i = 0; i < count; ++i) {
    const AxisPoint& p = points[i];
    const Vector2 along = (points[std::min(count - 1, i + 2)].at - points[std::max(0, i - 2)].at).normalized();
    const Vector2 across(-along.y(), along.x());
    for (int part = 0; part < 3; ++part) {
      Color sum{};
      int n = 0;
      for (const double u : {-0.5, 0.0, 0.5}) {
        const double off =
            part == 1 ? u * p.radius : (part - 1) * (p.radius + std::max(1.2, (0.5 + 0.5 * u) * p.radius));
        const Color one = color_at(picture, p.at + off * across);
        for (int c = 0; c < 3; ++c) sum[c] += one[c];
        ++n;
      }
      for (float& value : sum) value /= static_cast<float>(n);
      sides[part].push_back(sum);
    }
  }
  for (std::vector<Color>& side : sides) {
    const std::vector<Color> old = side;
    for (int i = 0; i < count; ++i) {
      Color sum{};
      int n = 0;
      for (int j = std::max(0, i - about); j <= std::min(count - 1, i + about); ++j, ++n)
        for (int c = 0; c < 3; ++c) sum[c] += old[j][c];
      for (int c = 0; c < 3; ++c) side[i][c] = sum[c] / static_cast<float>(n);
    }
  }
  Color usual;
  for (int c = 0; c < 3; ++c) {
    std::vector<double> values;
    for (const Color& one : sides[1]) values.push_back(one[c]);
    usual[c] = static_cast<float>(median_of(values));
  }
  std::vector<double> spread;
  for (const Color& one : sides[1]) spread.push_back(difference(one, usual));
  const double typical = std::max(kLeastSpread, median_of(spread));
  // a rope with marks has several colors, but each of them in several places
  const auto elsewhere = [&](int i) {
    std::array<bool, kParts> has{};
    const int own = i * kParts / count;
    for (int j = 0; j < count; ++j)
      if (j * kParts / count != own && difference(sides[1][i], sides[1][j]) < kAlike) has[j * kParts / count] = true;
    return std::count(has.begin(), has.end(), true) >= kOtherParts;
  };
  for (int i = 0; i < count; ++i) {
    const double left = difference(sides[1][i], sides[0][i]), right = difference(sides[1][i], sides[2][i]);
    out.edges += (std::min(left, right) > kSeen) / (1.0 * count);
    out.steady += (spread[i] < kUnlike * typical || elsewhere(i)) / (1.0 * count);
  }
  return out;
}

// A stretch that does not differ from what is beside it may still be the rope, one of another color hardly is.
double score(const Evidence& e) { return std::clamp(std::sqrt(e.edges) * e.steady * e.steady, 0.0, 1.0); }

}  // namespace chainsplat::masking
