#include "src/masking/grow.h"

#include <algorithm>
#include <array>
#include <cmath>

#include "chainsplat/image_model.h"
#include "src/masking/look.h"

namespace chainsplat::masking {

using math::Matrix3;
using math::MatrixX;
using math::Vector2;
using math::Vector3;
using math::VectorX;

namespace {

constexpr int kBins = 8 * 8 * 8;
// where colors are sampled
constexpr double kHeard = 0.05;                                          // concentration per color, Dirichlet prior
constexpr std::array kInside = {-0.75, -0.45, -0.15, 0.15, 0.45, 0.75};  // radii across the rope
constexpr std::array kBeside = {-2.1, -1.7, -1.3, 1.3, 1.7, 2.1};  // radii, clear of an outline that is a little off
constexpr double kSpacing = 0.5;                                   // radii between stations along the rope,
constexpr int kMostStations = 256;        // but no more stations than this, so that a thin rope is sampled sparsely
constexpr double kHiddenByGripper = 1.0;  // diameters of rope at the grasp that are not sampled
constexpr double kSeenFromSide = 0.3;     // share of a link's length; one that appears shorter shows no sides
// the beam search over the joints' angles, and its refinement
constexpr int kBeam = 48;          // number of ropes that are kept per link
constexpr double kSameTip = 0.25;  // diameters; of ropes whose tips are nearer than this only the best is kept
constexpr double kPlanarStep = 5.0 * M_PI / 180, kSpatialStep = 7.5 * M_PI / 180;
constexpr int kPlanarSteps = 9, kSpatialSteps = 4;  // number of angles tried on either side, per axis of a joint
constexpr double kBend = 15.0 * M_PI / 180;         // prior standard deviation of a joint's angle
constexpr double kSamplesPerFact = 4.0;  // neighboring samples are correlated, so that this many count as one
constexpr std::array kRefinements = {5.0 * M_PI / 180, 2.5 * M_PI / 180, 1.2 * M_PI / 180};
constexpr int kSweeps = 2;  // over all angles per refinement
// Bounds memory and time for any rope: the colors known from other moments count for some 1,000 samples per side
// (kKnownSamples, each of kBins rounded), and a chain adds 12 samples per station and 18 at the tip.
constexpr int kMostSamples = 1 << 14;

// Logarithms of the Dirichlet-multinomial likelihood, for counts n below kMostSamples.
struct Tables {
  std::vector<double> color, color_of_all;  // log(n + kHeard), log(n + 2 kHeard)
  std::vector<double> side, all;            // sums over i < n of log(i + kBins kHeard), log(i + 2 kBins kHeard)
};
const Tables& tables() {
  static const Tables made = [] {
    Tables t;
    t.side = t.all = {0.0};
    for (int n = 0; n < kMostSamples; ++n) {
      t.color.push_back(std::log(n + kHeard));
      t.color_of_all.push_back(std::log(n + 2 * kHeard));
      t.side.push_back(t.side.back() + std::log(n + kBins * kHeard));
      t.all.push_back(t.all.back() + std::log(n + 2 * kBins * kHeard));
    }
    return t;
  }();
  return made;
}

// The bin of a color, 8 steps per channel.
int coarse(const std::uint8_t* rgb) { return (rgb[0] >> 5) << 6 | (rgb[1] >> 5) << 3 | rgb[2] >> 5; }

Tally empty_tally() { return {std::vector<int>(kBins, 0), std::vector<int>(kBins, 0), 0, 0}; }

// The sampled color bins of one link in one picture.
struct Samples {
  std::vector<int> inside, beside;
};

// Evaluates chains against the pictures.
struct Search {
  Search(const chain::Chain& rope, std::span<const Shot> pictures) : chain(rope), shots(pictures) {}
  const chain::Chain& chain;
  std::span<const Shot> shots;
  double radius = 0.5 * chain.diameter;
  double spacing = std::max(kSpacing * radius, chain.length / kMostStations);  // m, between stations
  Vector3 second = chain.direction.cross(chain.bending_axis);
  bool planar = chain.angles() == chain.links() - 1;
  mutable Samples samples;
  mutable std::int64_t looked_at = 0;  // number of samples so far

  // Samples the link from arclength `begin` to `end`, which starts at `from` in direction `along` (base frame), into
  // `samples`; none where the link is behind the camera or points at it.
  void sample(const Shot& shot, const Vector3& from, const Vector3& along, double begin, double end) const {
    samples.inside.clear(), samples.beside.clear();
    const Vector3 a = shot.camera_from_base * from;
    const Vector3 step = shot.camera_from_base.rotation * along;
    const double length = end - begin;
    const Vector3 b = a + length * step;
    if (a.z() < image_model::kNear || b.z() < image_model::kNear) return;
    const Vector2 in_picture = capture::project(*shot.camera, b) - capture::project(*shot.camera, a);
    const double long_enough = kSeenFromSide * length * shot.camera->fx / a.z();
    if (in_picture.norm() < long_enough) return;
    const Vector2 forward = in_picture.normalized(), across(-forward.y(), forward.x());
    const auto add_color = [&](const Vector2& at, std::vector<int>& into) {
      const int x = static_cast<int>(std::floor(at.x())), y = static_cast<int>(std::floor(at.y()));
      if (x < 0 || y < 0 || x >= shot.picture.width || y >= shot.picture.height) return;
      into.push_back(coarse(pixel(shot.picture, x, y)));
    };
    const double hidden = kHiddenByGripper * chain.diameter;
    for (int k = static_cast<int>(std::ceil(std::max(begin, hidden) / spacing)); k * spacing < end; ++k) {
      const Vector3 p = a + (k * spacing - begin) * step;
      const Vector2 center = capture::project(*shot.camera, p);
      const double pixels = radius * shot.camera->fx / p.z();
      for (const double u : kInside) add_color(center + u * pixels * across, samples.inside);
      for (const double u : kBeside) add_color(center + u * pixels * across, samples.beside);
    }
    // beyond the free end
    if (end < chain.length - 1e-9) return;
    const Vector2 tip = capture::project(*shot.camera, b);
    const double pixels = radius * shot.camera->fx / b.z();
    for (const double u : kInside)
      for (const double v : kBeside)
        if (v > 0.0) add_color(tip + pixels * (u * across + v * forward), samples.beside);
  }

  // Adds `samples` to the tally and returns the gain in evidence, in nats. Where there is no gain, the samples stem
  // from one population (something hides the rope): they are not added, and the gain is 0.
  double count(Tally& tally) const {
    const Tables& t = tables();
    if (samples.inside.empty() || samples.beside.empty()) return 0.0;
    const int inside = tally.inside_sum, beside = tally.beside_sum;
    const int more_inside = static_cast<int>(samples.inside.size()),
              more_beside = static_cast<int>(samples.beside.size());
    const int all = inside + beside, more = more_inside + more_beside;
    CHAINSPLAT_CHECK(all + more < kMostSamples, std::to_string(all + more));
    double gain = t.all[all + more] - t.all[all] - (t.side[inside + more_inside] - t.side[inside]) -
                  (t.side[beside + more_beside] - t.side[beside]);
    for (const int i : samples.inside) {
      gain += t.color[tally.inside[i]] - t.color_of_all[tally.inside[i] + tally.beside[i]];
      ++tally.inside[i];
    }
    for (const int i : samples.beside) {
      gain += t.color[tally.beside[i]] - t.color_of_all[tally.inside[i] + tally.beside[i]];
      ++tally.beside[i];
    }
    if (gain > 0.0) {
      tally.inside_sum += more_inside, tally.beside_sum += more_beside;
      return gain;
    }
    undo(tally);
    return 0.0;
  }
  void undo(Tally& tally) const {
    for (const int i : samples.inside) --tally.inside[i];
    for (const int i : samples.beside) --tally.beside[i];
  }

  // Returns the evidence of a link in all pictures; `keep` false: leaves the tallies as they were.
  double link(std::vector<Tally>& tallies, const Vector3& from, const Vector3& along, double begin, double end,
              bool keep) const {
    double gain = 0.0;
    for (std::size_t i = 0; i < shots.size(); ++i) {
      sample(shots[i], from, along, begin, end);
      looked_at += static_cast<std::int64_t>(samples.inside.size() + samples.beside.size());
      const double one = count(tallies[i]);
      gain += one;
      if (!keep && one > 0.0) {
        undo(tallies[i]);
        tallies[i].inside_sum -= static_cast<int>(samples.inside.size());
        tallies[i].beside_sum -= static_cast<int>(samples.beside.size());
      }
    }
    return gain / kSamplesPerFact;
  }

  Matrix3 turned(const Matrix3& rotation, double first, double other) const {
    Matrix3 out = rotation * Eigen::AngleAxisd(first, chain.bending_axis).toRotationMatrix();
    if (!planar) out = out * Eigen::AngleAxisd(other, second).toRotationMatrix();
    return out;
  }
  // The log prior of the angles, up to a constant.
  double believed(const VectorX& theta) const { return -0.5 * theta.squaredNorm() / (kBend * kBend); }

  // Returns the evidence and the log prior of a whole chain. `tallies` begin with the known colors.
  double whole(const VectorX& theta, std::vector<Tally>& tallies) const {
    double sum = believed(theta);
    Matrix3 rotation = Matrix3::Identity();
    Vector3 at = chain.link_end(0) * chain.direction;
    if (chain.link_end(0) > 0.0) sum += link(tallies, Vector3::Zero(), chain.direction, 0.0, chain.link_end(0), true);
    const int axes = planar ? 1 : 2;
    for (int j = 1; j < chain.links(); ++j) {
      const int k = axes * (j - 1);
      rotation = turned(rotation, theta[k], planar ? 0.0 : theta[k + 1]);
      const Vector3 along = rotation * chain.direction;
      sum += link(tallies, at, along, chain.link_start(j), chain.link_end(j), true);
      at += (chain.link_end(j) - chain.link_start(j)) * along;
    }
    return sum;
  }
};

struct Rope {  // the part of a rope that has grown so far
  VectorX theta;
  Matrix3 rotation = Matrix3::Identity();
  Vector3 tip;
  double score = 0.0;
  std::vector<Tally> tallies;
};
struct Candidate {
  int parent;
  double first, other, score;
  Vector3 tip;
};

}  // namespace

void add(Tally& tally, const Tally& other) {
  if (tally.inside.empty()) tally = empty_tally();
  for (int i = 0; i < kBins; ++i) tally.inside[i] += other.inside[i], tally.beside[i] += other.beside[i];
  tally.inside_sum += other.inside_sum, tally.beside_sum += other.beside_sum;
}

Tally scaled(const Tally& tally, int samples) {
  Tally out = empty_tally();
  for (int i = 0; i < kBins; ++i) {
    if (tally.inside_sum > 0)
      out.inside[i] = static_cast<int>(std::lround(tally.inside[i] * (samples / (1.0 * tally.inside_sum))));
    if (tally.beside_sum > 0)
      out.beside[i] = static_cast<int>(std::lround(tally.beside[i] * (samples / (1.0 * tally.beside_sum))));
    out.inside_sum += out.inside[i], out.beside_sum += out.beside[i];
  }
  return out;
}

Grown grow(const chain::Chain& chain, std::span<const Shot> shots, std::span<const Tally> known) {
  const Search search{chain, shots};
  std::vector<Tally> begin;
  for (std::size_t i = 0; i < shots.size(); ++i)
    begin.push_back(i < known.size() && !known[i].inside.empty() ? known[i] : empty_tally());

  // grow link by link: try a grid of angles at the tip of every kept rope, keep the best ropes with different tips
  std::vector<Rope> beam(1);
  beam[0].theta = VectorX::Zero(chain.angles());
  beam[0].tip = chain.link_end(0) * chain.direction;
  beam[0].tallies = begin;
  if (chain.link_end(0) > 0.0)
    beam[0].score = search.link(beam[0].tallies, Vector3::Zero(), chain.direction, 0.0, chain.link_end(0), true);
  const int axes = search.planar ? 1 : 2;
  for (int j = 1; j < chain.links(); ++j) {
    const double length = chain.link_end(j) - chain.link_start(j);
    std::vector<Candidate> candidates;
    const int steps = search.planar ? kPlanarSteps : kSpatialSteps;
    const double step = search.planar ? kPlanarStep : kSpatialStep;
    for (int parent = 0; parent < static_cast<int>(beam.size()); ++parent) {
      Rope& rope = beam[parent];
      for (int u = -steps; u <= steps; ++u)
        for (int v = search.planar ? 0 : -steps; v <= (search.planar ? 0 : steps); ++v) {
          const double first = u * step, other = v * step;
          const Vector3 along = search.turned(rope.rotation, first, other) * chain.direction;
          const double gain = search.link(rope.tallies, rope.tip, along, chain.link_start(j), chain.link_end(j), false);
          const double belief = -0.5 * (first * first + other * other) / (kBend * kBend);
          candidates.push_back({parent, first, other, rope.score + gain + belief, rope.tip + length * along});
        }
    }
    std::stable_sort(candidates.begin(), candidates.end(),
                     [](const Candidate& a, const Candidate& b) { return a.score > b.score; });
    std::vector<Rope> next;
    for (const Candidate& c : candidates) {
      if (next.size() == kBeam) break;
      const bool same = std::any_of(next.begin(), next.end(), [&](const Rope& rope) {
        return (rope.tip - c.tip).norm() < kSameTip * chain.diameter;
      });
      if (same) continue;
      Rope rope = beam[c.parent];
      rope.theta[axes * (j - 1)] = c.first;
      if (axes == 2) rope.theta[axes * (j - 1) + 1] = c.other;
      const Matrix3 rotation = search.turned(rope.rotation, c.first, c.other);
      search.link(rope.tallies, rope.tip, rotation * chain.direction, chain.link_start(j), chain.link_end(j), true);
      rope.rotation = rotation, rope.tip = c.tip, rope.score = c.score;
      next.push_back(std::move(rope));
    }
    beam = std::move(next);
  }

  // refine the best: single angles, pairs of angles that shift the rest of the rope, triples that move one link
  VectorX theta = beam[0].theta;
  std::vector<Tally> tallies = begin;
  double best = search.whole(theta, tallies);
  for (const double step : kRefinements)
    for (int sweep = 0; sweep < kSweeps; ++sweep)
      for (int k = 0; k < chain.angles(); ++k)
        for (int shape = 0; shape < 3; ++shape) {
          if (k + shape * axes >= chain.angles()) continue;
          for (const double sign : {1.0, -1.0}) {
            VectorX other = theta;
            other[k] += sign * step;
            if (shape == 1) other[k + axes] -= sign * step;
            if (shape == 2) other[k + axes] -= 2 * sign * step, other[k + 2 * axes] += sign * step;
            tallies = begin;
            const double score = search.whole(other, tallies);
            if (score > best) best = score, theta = other;
          }
        }
  Grown out;
  out.theta = theta;
  // the evidence and the tallies of this moment alone
  out.tallies.assign(shots.size(), empty_tally());
  search.looked_at = 0;
  const double score = search.whole(theta, out.tallies) - search.believed(theta);
  out.evidence = search.looked_at ? score * kSamplesPerFact / static_cast<double>(search.looked_at) : 0.0;
  return out;
}

}  // namespace chainsplat::masking
