#include "src/masking/ribbon.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <utility>

#include "src/masking/rims.h"
#include "src/masking/shadow.h"

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
// of outlines that have a place of the user's not between them: more than all else together
constexpr double kPastPoint = 1e6;
constexpr double kSmooth = 2.0;    // radii on either side, within which an outline is taken for straight
constexpr double kLeastRim = 1.5;  // px, of a radius below which there are no rims to be seen
constexpr double kRimPiece = 8.0;  // px, or a radius: length over which colors about the outlines are averaged
constexpr double kRimPart = 6.0;   // radii, length over which an outline is moved as one
// the ends
constexpr double kEndSigma = 0.4;  // of the slack
constexpr double kEndStep = 4.0;   // of a full step of color along the rope there

// the evidence
constexpr double kSeen = 10.0;              // gray levels, the least contrast that is one
constexpr double kBlurWidth = 4.0;          // px, that the blur of a step may be wide,
constexpr double kBlurred = 2.0;            // and gray levels, by which it differs from mixtures of both sides
constexpr double kLeastSpread = 6.0;        // gray levels, of the rope's colors along it,
constexpr int kParts = 6, kOtherParts = 3;  // of the rope; in so many others a color must come back,
constexpr double kAlike = 14.0;             // to within so many gray levels
constexpr double kUnlike = 4.0;             // and times their usual spread, from where on it is another color
// gray levels, of a step of color along the rope, and times what its colors differ from those on their side of it: from
// both on the rope goes over to something else there. Marks come back, and light changes by less (up to 29 on 90
// stills).
constexpr double kStepAlong = 40.0, kStepUnlike = 2.0;

double square(double x) { return x * x; }

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

// How far a color is from all mixtures of two others: the blur of a step from one to the other has those, and looks
// like a thin rope along the step.
double from_blur(const Color& color, const Color& a, const Color& b) {
  double both = 0.0, all = 1e-9;
  for (int c = 0; c < 3; ++c) both += static_cast<double>(color[c] - a[c]) * (b[c] - a[c]), all += square(b[c] - a[c]);
  const auto share = static_cast<float>(std::clamp(both / all, 0.0, 1.0));
  Color mixed;
  for (int c = 0; c < 3; ++c) mixed[c] = a[c] + share * (b[c] - a[c]);
  return difference(color, mixed);
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

// Keeps the order of the values.
double median_of(std::vector<double> values) { return math::median(values); }

// The picture straightened along the axis: a row for every station, columns across it.
struct Straight {
  std::vector<Station> stations;
  double length;              // m, of the rope
  double radius;              // px, of the given axis
  double du;                  // px, between columns
  double ds;                  // px, between stations
  int half, columns;          // columns on either side of the axis, and all
  int about;                  // stations per radius
  std::vector<Color> colors;  // by station and column
  std::vector<double> odds;   // log odds of the colors for the rope
  std::vector<double> steps;  // change of color between a column and the one before it, 0 to 1

  int count() const { return static_cast<int>(stations.size()); }
  std::size_t at(int i, int k) const { return static_cast<std::size_t>(i) * columns + k; }
  double weight() const { return ds / radius; }  // facts of one station
};

Straight straighten(const Look& look, const Picture& picture, const Axis& along, double length,
                    const RibbonOptions& options) {
  Straight out{};
  out.length = length;
  for (const AxisPoint& p : along.points) out.radius += p.radius / static_cast<double>(along.points.size());
  out.radius = std::max(0.5, out.radius);
  out.stations = stations_of(along, -options.slack, length + options.slack, out.radius);
  const double reach = kReach * options.width * out.radius + kMoreReach;
  out.du = std::max({kAcross * out.radius, kLeastAcross, 2.0 * reach / kMostAcross});
  out.half = static_cast<int>(reach / out.du), out.columns = 2 * out.half + 1;
  out.ds = (out.stations[1].at - out.stations[0].at).norm();
  out.about = std::max(1, static_cast<int>(out.radius / std::max(0.1, out.ds)));
  out.colors.resize(static_cast<std::size_t>(out.count()) * out.columns);
  out.odds.resize(out.colors.size());
  for (int i = 0; i < out.count(); ++i) {
    const Station& s = out.stations[i];
    const Colors& known = s.arclength < 0.5 * length ? look.near : look.far;
    for (int k = 0; k < out.columns; ++k) {
      const Vector2 place = s.at + (k - out.half) * out.du * s.across;
      out.colors[out.at(i, k)] = color_at(picture, place);
      const int x = std::clamp(static_cast<int>(place.x()), 0, picture.width - 1),
                y = std::clamp(static_cast<int>(place.y()), 0, picture.height - 1);
      out.odds[out.at(i, k)] =
          std::clamp(color_odds(known, pixel(picture, x, y)) + 2.0 * difference_odds(look.background, picture, x, y),
                     -kMostOdds, kMostOdds);
    }
  }
  return out;
}

// Takes the rope's shadow away.
void unshade(Straight& s, double usual) {
  Strip strip;
  strip.colors = s.colors;
  for (int k = 0; k < s.columns; ++k) strip.across.push_back((k - s.half) * s.du / usual);
  const auto before = [&](double arclength) {
    return static_cast<int>(std::count_if(s.stations.begin(), s.stations.end(),
                                          [&](const Station& one) { return one.arclength < arclength; }));
  };
  strip.begin = before(0.0), strip.end = before(s.length);
  strip.about = s.about;
  Shadowless seen = without_shadow(strip);
  s.colors = std::move(seen.colors);
  for (std::size_t at = 0; at < s.odds.size(); ++at) s.odds[at] = std::max(-kMostOdds, s.odds[at] + seen.odds[at]);
}

// Steps between columns: of the colors on either side, averaged over a radius of length. A full step counts fully at
// its steepest place only, which is where the outline is.
void find_steps(Straight& s) {
  std::vector<Color> mean(s.colors.size());
  for (int k = 0; k < s.columns; ++k)
    for (int i = 0; i < s.count(); ++i) {
      Color sum{};
      int n = 0;
      for (int j = std::max(0, i - s.about); j <= std::min(s.count() - 1, i + s.about); ++j, ++n)
        for (int c = 0; c < 3; ++c) sum[c] += s.colors[s.at(j, k)][c];
      for (int c = 0; c < 3; ++c) mean[s.at(i, k)][c] = sum[c] / static_cast<float>(n);
    }
  const int apart = std::max(1, static_cast<int>(std::lround(std::max(0.75, 0.2 * s.radius) / s.du)));
  const int near = std::max(1, static_cast<int>(kSteepest * s.radius / s.du));
  s.steps.assign(s.colors.size(), 0.0);
  std::vector<double> across(s.columns, 0.0);
  for (int i = 0; i < s.count(); ++i) {
    for (int k = 1; k < s.columns; ++k)  // between the columns k - 1 and k
      across[k] =
          difference(mean[s.at(i, std::max(0, k - apart))], mean[s.at(i, std::min(s.columns - 1, k + apart - 1))]);
    for (int k = 1; k < s.columns; ++k) {
      const auto first = across.begin() + std::max(1, k - near),
                 last = across.begin() + std::min(s.columns, k + near + 1);
      const double d = across[k];
      s.steps[s.at(i, k)] = d * d / (std::max(1e-9, *std::max_element(first, last)) * (d + kFullStep));
    }
  }
}

// A pair of outlines at one station: the left one lies before column a, the right one before column b.
struct Outlines {
  int a, b;
};

// All pairs of a believable width and place, and their numbers by (a, b); -1: none.
struct Choices {
  std::vector<Outlines> all;
  std::vector<int> number;
  int columns = 0;
  int at(int a, int b) const { return number[static_cast<std::size_t>(a) * (columns + 1) + b]; }
};

Choices choices_of(const Straight& s, const RibbonOptions& options) {
  Choices out;
  out.columns = s.columns;
  out.number.assign(static_cast<std::size_t>(s.columns + 1) * (s.columns + 1), -1);
  const double usual = options.width * s.radius;  // px
  for (int a = 1; a < s.columns; ++a)
    for (int b = a + 1; b < s.columns; ++b) {
      const double wide = 0.5 * (b - a) * s.du / usual,
                   middle = std::abs((0.5 * (a + b) - 0.5 - s.half) * s.du) / usual;
      if (wide < kLeastWidth || wide > kMostWidth || middle > 2.0) continue;
      out.number[static_cast<std::size_t>(a) * (s.columns + 1) + b] = static_cast<int>(out.all.size());
      out.all.push_back({a, b});
    }
  return out;
}

// Where a connector may be.
bool in_tip(const Straight& s, int i) { return s.stations[i].arclength > (1.0 - kTipShare) * s.length; }

// The columns, by station, that lie between the outlines since the user says so; -1: none.
std::vector<int> columns_through(const Straight& s, const std::vector<Vector2>& places) {
  std::vector<int> out(s.count(), -1);
  for (const Vector2& place : places) {
    const auto nearest =
        std::min_element(s.stations.begin(), s.stations.end(), [&](const Station& a, const Station& b) {
          return (a.at - place).squaredNorm() < (b.at - place).squaredNorm();
        });
    const int column = s.half + static_cast<int>(std::lround((place - nearest->at).dot(nearest->across) / s.du));
    if (column >= 0 && column < s.columns) out[nearest - s.stations.begin()] = column;
  }
  return out;
}

// What speaks against a pair at station i. `sums`: of the odds of the columns before each.
double cost_of(const Straight& s, const RibbonOptions& options, int i, const Outlines& pair,
               const std::vector<double>& sums) {
  const double expected = options.width * std::max(0.5, s.stations[i].radius);
  const double wide = 0.5 * (pair.b - pair.a) * s.du / expected,
               middle = (0.5 * (pair.a + pair.b) - 0.5 - s.half) * s.du / expected;
  const double width =
      in_tip(s, i) && wide > 1.0 ? kWiderTip * (wide - 1.0) : 0.5 * square((wide - 1.0) / options.width_deviation);
  return s.weight() *
         (width + 0.5 * square(middle / kCenter) - kColor * (sums[pair.b] - sums[pair.a]) * s.du / s.radius -
          kEdge * (s.steps[s.at(i, pair.a)] + s.steps[s.at(i, pair.b)]));
}

// The cheapest way of both outlines from station to station, each by one column at most (dynamic programming).
std::vector<Outlines> cheapest_way(const Straight& s, const Choices& choices, const RibbonOptions& options) {
  const std::vector<int> through = columns_through(s, options.through);
  constexpr int kMoves = 9, kStay = 4;  // by -1, 0 or 1 of the left and of the right outline
  const auto from = [&](const Outlines& pair, int move) {
    return Outlines{pair.a + move / 3 - 1, pair.b + move % 3 - 1};
  };
  const int many = static_cast<int>(choices.all.size());
  std::vector<double> best(many), next(many), sums(s.columns + 1, 0.0);
  std::vector<std::uint8_t> came(static_cast<std::size_t>(s.count()) * many, kStay);
  for (int i = 0; i < s.count(); ++i) {
    for (int k = 0; k < s.columns; ++k) {
      const double odds = s.odds[s.at(i, k)];
      sums[k + 1] = sums[k] + (in_tip(s, i) ? std::max(0.0, odds) : odds);  // a connector has colors of its own
    }
    for (int n = 0; n < many; ++n) {
      double least = i ? std::numeric_limits<double>::max() : 0.0;
      std::uint8_t by = kStay;
      for (int move = 0; i && move < kMoves; ++move) {
        const auto [a, b] = from(choices.all[n], move);
        if (a < 1 || b >= s.columns || b <= a) continue;
        const int m = choices.at(a, b);
        if (m < 0) continue;
        const double one = best[m] + kMove * ((move / 3 != 1) + (move % 3 != 1));
        if (one < least) least = one, by = static_cast<std::uint8_t>(move);
      }
      const auto [left, right] = choices.all[n];
      const bool past = through[i] >= 0 && (through[i] < left || through[i] >= right);
      next[n] = least + cost_of(s, options, i, choices.all[n], sums) + (past ? kPastPoint : 0.0);
      came[static_cast<std::size_t>(i) * many + n] = by;
    }
    std::swap(best, next);
  }
  std::vector<Outlines> way(s.count());
  int n = static_cast<int>(std::min_element(best.begin(), best.end()) - best.begin());
  for (int i = s.count() - 1; i >= 0; --i) {
    way[i] = choices.all[n];
    const auto [a, b] = from(way[i], came[static_cast<std::size_t>(i) * many + n]);
    if (i) n = choices.at(a, b);
  }
  return way;
}

// Where the outlines are, in px across the axis.
struct FineOutlines {
  std::vector<double> left, right;
};

// The columns of the outlines without their steps: a line through those within kSmooth radii.
FineOutlines smoothed(const Straight& s, const std::vector<Outlines>& way) {
  FineOutlines out{std::vector<double>(s.count()), std::vector<double>(s.count())};
  const int around = std::max(1, static_cast<int>(kSmooth * s.radius / std::max(0.1, s.ds)));
  for (int i = 0; i < s.count(); ++i) {
    const int first = std::max(0, i - around), last = std::min(s.count() - 1, i + around);
    double x = 0.0, xx = 0.0, n = last - first + 1.0, a = 0.0, b = 0.0, xa = 0.0, xb = 0.0;
    for (int j = first; j <= last; ++j) {
      const double at = j - i;
      x += at, xx += at * at, a += way[j].a, b += way[j].b, xa += at * way[j].a, xb += at * way[j].b;
    }
    const double det = n * xx - x * x;
    out.left[i] = ((xx * a - x * xa) / det - 0.5 - s.half) * s.du;
    out.right[i] = ((xx * b - x * xb) / det - 0.5 - s.half) * s.du;
  }
  return out;
}

// The outlines moved to where the rims of a tube fit best.
void move_to_rims(const Straight& s, FineOutlines& fine, int begin, int end) {
  std::vector<double> radii;
  for (int i = begin; i < end; ++i)
    if (!in_tip(s, i)) radii.push_back(0.5 * (fine.right[i] - fine.left[i]));
  if (radii.empty()) return;
  const double radius = math::median(radii);
  if (radius < kLeastRim) return;
  const auto stations = [&](double pixels) { return std::max(1, static_cast<int>(pixels / std::max(0.1, s.ds))); };
  const int piece = stations(std::max(s.radius, kRimPiece)), count = end - begin,
            parts = std::max(1, count / stations(kRimPart * s.radius));
  for (const bool right : {false, true}) {
    std::vector<double>& line = right ? fine.right : fine.left;
    std::vector<Rim> rims;
    for (int first = begin; first + piece <= end && !in_tip(s, first + piece - 1); first += piece) {
      Rim rim{(first + piece / 2 - begin) * parts / count, std::vector<Color>(rim_bins(radius), Color{})};
      std::vector<int> samples(rim.colors.size(), 0);
      for (int i = first; i < first + piece; ++i)
        for (int k = 0; k < s.columns; ++k) {
          const double across = (k - s.half) * s.du;
          if ((across > 0.5 * (fine.left[i] + fine.right[i])) != right) continue;
          const int bin = rim_bin(radius, right ? line[i] - across : across - line[i]);
          if (bin < 0 || bin >= static_cast<int>(samples.size())) continue;
          ++samples[bin];
          for (int c = 0; c < 3; ++c) rim.colors[bin][c] += s.colors[s.at(i, k)][c];
        }
      for (std::size_t bin = 0; bin < samples.size(); ++bin)
        for (float& value : rim.colors[bin])
          value = samples[bin] ? value / static_cast<float>(samples[bin]) : std::numeric_limits<float>::quiet_NaN();
      rims.push_back(std::move(rim));
    }
    const std::vector<double> beyond = fit_rims(rims, parts, radius);
    for (int i = begin; i < end; ++i) {  // linear between the middles of the parts
      const double at = std::clamp((i - begin + 0.5) * parts / count - 0.5, 0.0, parts - 1.0);
      const int before = static_cast<int>(at), after = std::min(before + 1, parts - 1);
      const double by = beyond[before] + (at - before) * (beyond[after] - beyond[before]);
      line[i] += right ? by : -by;
    }
  }
}

// What each station says for the rope between the outlines.
std::vector<double> words_for_rope(const Straight& s, const std::vector<Outlines>& way) {
  std::vector<double> edges, out(s.count());
  for (int i = 0; i < s.count(); ++i) edges.push_back(std::min(s.steps[s.at(i, way[i].a)], s.steps[s.at(i, way[i].b)]));
  const double typical = std::max(0.05, median_of(edges));
  for (int i = 0; i < s.count(); ++i) {
    double inside = 0.0;
    for (int k = way[i].a; k < way[i].b; ++k) inside += s.odds[s.at(i, k)] / (way[i].b - way[i].a);
    out[i] = s.weight() * (std::clamp(inside, -1.0, 1.0) + std::clamp(edges[i] / typical - 0.5, -0.5, 0.5));
  }
  return out;
}

// The change of color along the rope, from the radius before a station to the one from it on; by station, and after the
// last.
std::vector<double> changes_along(const Straight& s, const std::vector<Outlines>& way) {
  std::vector<Color> middle(s.count());
  for (int i = 0; i < s.count(); ++i) {
    const int center = (way[i].a + way[i].b) / 2, around = (way[i].b - way[i].a) / 4;
    for (int k = center - around; k <= center + around; ++k)
      for (int c = 0; c < 3; ++c) middle[i][c] += s.colors[s.at(i, k)][c] / static_cast<float>(2 * around + 1);
  }
  std::vector<double> out(s.count() + 1, 0.0);
  for (int i = s.about; i + s.about <= s.count(); ++i) {
    Color before{}, after{};
    for (int j = 0; j < s.about; ++j)
      for (int c = 0; c < 3; ++c) {
        before[c] += middle[i - 1 - j][c] / static_cast<float>(s.about);
        after[c] += middle[i + j][c] / static_cast<float>(s.about);
      }
    const double d = difference(before, after);
    out[i] = kEndStep * d / (d + kFullStep);
  }
  return out;
}

// Where the rope begins and ends: the stations that speak for it, summed up, the change of color at its ends, and the
// given length.
std::pair<int, int> ends_of(const Straight& s, const std::vector<Outlines>& way, const RibbonOptions& options) {
  const std::vector<double> speaks = words_for_rope(s, way), change = changes_along(s, way);
  const double sigma = std::max(1e-4, kEndSigma * options.slack);
  int begin = 0, end = s.count();
  double most = std::numeric_limits<double>::lowest(), sum = 0.0;
  for (int i = s.count() - 1; i >= 0 && s.stations[i].arclength > -options.slack; --i) {
    sum += speaks[i];
    if (s.stations[i].arclength > 2.0 * options.slack) continue;
    const double value = sum + change[i] - 0.5 * square(std::max(0.0, -s.stations[i].arclength) / sigma);
    if (value > most) most = value, begin = i;
  }
  most = std::numeric_limits<double>::lowest(), sum = 0.0;
  for (int i = 0; i < s.count(); ++i) {
    sum += speaks[i];
    if (s.stations[i].arclength < s.length - options.slack) continue;
    const double value = sum + change[i + 1] - 0.5 * square((s.stations[i].arclength - s.length) / sigma);
    if (value > most) most = value, end = i + 1;
  }
  return {begin, end};
}

}  // namespace

Ribbon find_ribbon(const Look& look, const Picture& picture, const Axis& along, double length,
                   const RibbonOptions& options) {
  constexpr int kFewest = 4;  // stations of a ribbon
  Ribbon out;
  if (along.points.size() < 2) return out;
  Straight s = straighten(look, picture, along, length, options);
  if (options.shadow) unshade(s, options.width * s.radius);
  find_steps(s);
  const Choices choices = choices_of(s, options);
  if (choices.all.empty()) return out;
  const std::vector<Outlines> way = cheapest_way(s, choices, options);
  const auto [begin, end] = ends_of(s, way, options);
  if (end - begin < kFewest) return out;

  FineOutlines fine = smoothed(s, way);
  if (options.rims) move_to_rims(s, fine, begin, end);
  std::vector<double> widths;
  for (int i = begin; i < end; ++i) {
    const Station& station = s.stations[i];
    const double left = fine.left[i], right = fine.right[i];
    out.axis.points.push_back(
        {station.at + 0.5 * (left + right) * station.across, 0.5 * (right - left), station.arclength});
    if (station.arclength < (1.0 - kTipShare) * length) widths.push_back(0.5 * (right - left) / station.radius);
  }
  out.axis.bulge = along.bulge;
  out.width = widths.empty() ? 1.0 : math::median(widths);
  return out;
}

namespace {

// The larger share of the colors along the rope where one step parts them, or 1 where none does.
double before_step(const std::vector<Color>& colors) {
  const int count = static_cast<int>(colors.size()), least = std::max(1, count / kParts);
  double lowest = std::numeric_limits<double>::max(), share = 1.0;
  for (int i = least; i <= count - least; ++i) {
    Color means[2] = {};
    for (int j = 0; j < count; ++j)
      for (int c = 0; c < 3; ++c) means[j >= i][c] += colors[j][c] / static_cast<float>(j < i ? i : count - i);
    double within = 0.0;
    for (int j = 0; j < count; ++j) within += square(difference(colors[j], means[j >= i])) / count;
    if (within >= lowest) continue;
    lowest = within;
    const bool step = difference(means[0], means[1]) > std::max(kStepAlong, kStepUnlike * std::sqrt(within));
    share = step ? std::max(i, count - i) / (1.0 * count) : 1.0;
  }
  return share;
}

}  // namespace

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
    usual[c] = static_cast<float>(math::median(values));
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
    const Color &left = sides[0][i], &own = sides[1][i], &right = sides[2][i];
    const bool blur = 2.0 * radius < kBlurWidth && from_blur(own, left, right) < kBlurred;
    const bool seen = std::min(difference(own, left), difference(own, right)) > kSeen && !blur;
    out.edges += seen / (1.0 * count);
    out.steady += (spread[i] < kUnlike * typical || elsewhere(i)) / (1.0 * count);
  }
  const auto tip = sides[1].begin() + static_cast<std::ptrdiff_t>((1.0 - kTipShare) * count);  // a connector may be
  out.steady = std::min(out.steady, before_step({sides[1].begin(), tip}));
  return out;
}

// A stretch that does not differ from what is beside it may still be the rope, one of another color hardly is.
double score(const Evidence& e) { return std::clamp(std::sqrt(e.edges) * e.steady * e.steady, 0.0, 1.0); }

}  // namespace chainsplat::masking
