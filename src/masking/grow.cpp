#include "src/masking/grow.h"

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>

#include "chainsplat/image_model.h"

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
constexpr std::array kBeside = {1.3, 1.7, 2.1};       // radii, clear of an outline that is a little off,
constexpr std::array kLeastBeside = {0.8, 1.3, 1.8};  // and at least so many px beyond it, clear of its blur
constexpr double kWidest = 4.0;     // px, radius beyond which pictures are made smaller: texture and noise average out
constexpr double kSpacing = 0.5;    // radii between stations along the rope,
constexpr int kMostStations = 256;  // but no more stations than this, so that a thin rope is sampled sparsely
constexpr double kHiddenByGripper = 1.0;  // diameters of rope at the grasp that are not sampled
constexpr double kSeenFromSide = 0.3;     // share of a link's length; one that appears shorter shows no sides
// the beam search over the joints' angles, and its refinement
constexpr int kBeam = 48;          // number of ropes that are kept per link,
constexpr int kBroadBeam = 128;    // and where the grasp is uncertain, so that there are many beginnings
constexpr double kSameTip = 0.25;  // diameters; of ropes whose tips are nearer than this only the best is kept
constexpr double kElsewhere = 4.0, kElsewhereShare = 0.06;  // diameters, share of the length: tips farther apart differ
constexpr double kPlanarStep = 5.0 * M_PI / 180, kSpatialStep = 7.5 * M_PI / 180;
constexpr int kPlanarSteps = 9, kSpatialSteps = 4;  // number of angles tried on either side, per axis of a joint
constexpr double kBend = 15.0 * M_PI / 180;         // prior standard deviation of a joint's angle
constexpr double kSamplesPerFact = 4.0;  // neighboring samples are correlated, so that this many count as one
constexpr std::array kRefinements = {5.0 * M_PI / 180, 2.5 * M_PI / 180, 1.2 * M_PI / 180};
constexpr int kSweeps = 2;  // over all angles per refinement
// how a rope hangs: it turns down along its length, and up only as far as it was bent before
constexpr double kRise = 5.0 * M_PI / 180;  // standard deviation of a joint's turn away from gravity
// where the grasp is uncertain
constexpr double kFarthestGrasp = 2.5;                        // deviations that are tried,
constexpr double kGraspStep = 0.7;                            // in steps of this many diameters,
constexpr int kMostGraspSteps = 3;                            // but at most so many on either side
constexpr std::array kGraspRefinements = {0.35, 0.18, 0.09};  // diameters
// What an angle costs that is found and not known: the log of how much wider its prior is than what pictures tell.
constexpr double kFoundAngle = 2.0;  // nats
// evidence of the outlines
constexpr int kRandomPlaces = 4000;
constexpr double kSurprise = 1.0;          // nats, the mean of a random place, which counts as nothing
constexpr double kMostSurprise = 4.0;      // nats
constexpr double kFactsPerDiameter = 1.0;  // stations within a diameter see the same edges
// what the user says
constexpr double kOnRope = 1e4;       // nats for each point that the rope runs through: more than pictures ever say,
constexpr double kOnRopeRadii = 2.0;  // to within so many radii,
constexpr double kFromMiddle = 0.32;  // radii, deviation of the rope's middle from a point
// Weight of the picture's evidence where the user points, since it misleads there: a long edge counts many times, and
// the rope's shape shall decide what lies between the points.
constexpr double kTrustBesidePoints = 0.25;
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

// The samples of one link in one picture: color bins on the tube and on either side of it, and the outlines' evidence.
struct Samples {
  std::vector<int> inside, beside[2];
  double outlines = 0.0;
};

// A picture in which the rope is at most kWidest wide on either side, and how often places of it contrast with both
// sides.
struct Reduced {
  std::vector<std::uint8_t> pixels;  // RGB; empty: the picture itself serves
  Picture picture;
  capture::Camera camera;
  std::vector<double> contrasts;  // gray levels, ascending, of places taken at random
  int factor = 1;
};

// Mean color differences of a place from its two sides: the smaller one, gray levels.
struct Station {
  int sums[3][3] = {};  // left, inside, right x channels
  int counts[3] = {};
  void add(int part, const std::uint8_t* rgb) {
    for (int c = 0; c < 3; ++c) sums[part][c] += rgb[c];
    ++counts[part];
  }
  double contrast() const {
    if (!counts[0] || !counts[1] || !counts[2]) return -1.0;
    double least = 1e9;
    for (const int side : {0, 2}) {
      double square = 0.0;
      for (int c = 0; c < 3; ++c) {
        const double d = sums[1][c] / (1.0 * counts[1]) - sums[side][c] / (1.0 * counts[side]);
        square += d * d / 3.0;
      }
      least = std::min(least, std::sqrt(square));
    }
    return least;
  }
};

// The offset from the axis, px, of the k-th sample beside a tube.
double beside_at(int k, double radius) { return std::max(kBeside[k] * radius, radius + kLeastBeside[k]); }

const std::uint8_t* pixel_at(const Picture& picture, const Vector2& at) {
  const int x = static_cast<int>(std::floor(at.x())), y = static_cast<int>(std::floor(at.y()));
  if (x < 0 || y < 0 || x >= picture.width || y >= picture.height) return nullptr;
  return pixel(picture, x, y);
}

// Calls body(part, rgb) for the samples across a tube: parts 0 and 2 are its sides, 1 is inside.
template <class Body>
void across_tube(const Picture& picture, const Vector2& center, const Vector2& across, double radius,
                 const Body& body) {
  for (const double u : kInside)
    if (const std::uint8_t* const rgb = pixel_at(picture, center + u * radius * across)) body(1, rgb);
  for (int k = 0; k < static_cast<int>(kBeside.size()); ++k)
    for (const double sign : {-1.0, 1.0})
      if (const std::uint8_t* const rgb = pixel_at(picture, center + sign * beside_at(k, radius) * across))
        body(sign < 0.0 ? 0 : 2, rgb);
}

Reduced reduced(const chain::Chain& chain, const Shot& shot) {
  Reduced out;
  out.picture = shot.picture, out.camera = *shot.camera;
  const double depth = std::max(image_model::kNear, shot.camera_from_base.translation.z());
  const double radius = 0.5 * chain.diameter * shot.camera->fx / depth;
  out.factor = std::clamp(static_cast<int>(radius / kWidest), 1, 64);
  if (out.factor > 1) {
    const int f = out.factor, width = shot.picture.width / f, height = shot.picture.height / f;
    if (width < 1 || height < 1) return out;
    out.pixels.resize(static_cast<std::size_t>(3) * width * height);
    for (int y = 0; y < height; ++y)
      for (int x = 0; x < width; ++x) {
        int sum[3] = {};
        for (int v = 0; v < f; ++v)
          for (int u = 0; u < f; ++u)
            for (int c = 0; c < 3; ++c) sum[c] += pixel(shot.picture, f * x + u, f * y + v)[c];
        for (int c = 0; c < 3; ++c)
          out.pixels[3 * (static_cast<std::size_t>(y) * width + x) + c] =
              static_cast<std::uint8_t>((sum[c] + f * f / 2) / (f * f));
      }
    out.picture = {out.pixels.data(), width, height, 3};
    out.camera.width = width, out.camera.height = height;
    for (double* const value : {&out.camera.fx, &out.camera.fy, &out.camera.cx, &out.camera.cy}) *value /= f;
  }
  // places within the rope's reach, by a fixed generator
  const Reach where = reach(chain, out.camera.world_from_camera * shot.camera_from_base, out.camera);
  if (where.box.empty()) return out;
  std::uint64_t state = 0x9e3779b97f4a7c15ull;
  const auto uniform = [&state] {
    state ^= state << 13, state ^= state >> 7, state ^= state << 17;
    return static_cast<double>(state >> 11) * 0x1p-53;
  };
  const double r = radius / out.factor;
  for (int i = 0; i < kRandomPlaces; ++i) {
    const Vector2 center(where.box.x0 + uniform() * where.box.width(), where.box.y0 + uniform() * where.box.height());
    const double angle = M_PI * uniform();
    Station station;
    across_tube(out.picture, center, Vector2(std::cos(angle), std::sin(angle)), r,
                [&](int part, const std::uint8_t* rgb) { station.add(part, rgb); });
    if (const double one = station.contrast(); one >= 0.0) out.contrasts.push_back(one);
  }
  std::sort(out.contrasts.begin(), out.contrasts.end());
  return out;
}

// Evaluates chains against the pictures.
struct Search {
  Search(const chain::Chain& rope, std::span<const Shot> pictures, const Clues& given)
      : chain(rope), shots(pictures), clues(given) {
    for (const Shot& shot : shots) small.push_back(reduced(chain, shot));
    for (const Shot& shot : shots) points += static_cast<int>(shot.on_rope.size());
    if (points > 0) trust = kTrustBesidePoints;
  }
  const chain::Chain& chain;
  std::span<const Shot> shots;
  const Clues& clues;
  std::vector<Reduced> small;  // by shot
  int points = 0;              // on the rope, of all shots
  double trust = 1.0;          // weight of the pictures' evidence
  double radius = 0.5 * chain.diameter;
  double spacing = std::max(kSpacing * radius, chain.length / kMostStations);  // m, between stations
  Vector3 second = chain.direction.cross(chain.bending_axis);
  bool planar = !chain::bends_in_space(chain);
  mutable Samples samples;
  mutable std::int64_t looked_at = 0;  // number of samples so far
  mutable double by_color = 0.0;       // nats of the colors alone so far

  // The evidence of a station's outlines, nats: how seldom chance contrasts as much.
  double surprise(const Reduced& in, double contrast) const {
    if (in.contrasts.empty()) return 0.0;
    if (contrast < 0.0) return -kSurprise;
    const auto above = in.contrasts.end() - std::lower_bound(in.contrasts.begin(), in.contrasts.end(), contrast);
    const double share = (static_cast<double>(above) + 1.0) / (static_cast<double>(in.contrasts.size()) + 1.0);
    return std::min(-std::log(share), kMostSurprise) - kSurprise;
  }

  // Samples the link from arclength `begin` to `end`, which starts at `from` in direction `along` (base frame), into
  // `samples`; none where the link is behind the camera or points at it.
  void sample(std::size_t i, const Vector3& from, const Vector3& along, double begin, double end) const {
    samples.inside.clear(), samples.beside[0].clear(), samples.beside[1].clear();
    samples.outlines = 0.0;
    const Shot& shot = shots[i];
    const Reduced& in = small[i];
    const Vector3 a = shot.camera_from_base * from;
    const Vector3 step = shot.camera_from_base.rotation * along;
    const double length = end - begin;
    const Vector3 b = a + length * step;
    if (a.z() < image_model::kNear || b.z() < image_model::kNear) return;
    const Vector2 in_picture = capture::project(in.camera, b) - capture::project(in.camera, a);
    const double long_enough = kSeenFromSide * length * in.camera.fx / a.z();
    if (in_picture.norm() < long_enough) return;
    const Vector2 forward = in_picture.normalized(), across(-forward.y(), forward.x());
    const double hidden = kHiddenByGripper * chain.diameter;
    const double facts = kFactsPerDiameter * std::min(1.0, spacing / chain.diameter);
    for (int k = static_cast<int>(std::ceil(std::max(begin, hidden) / spacing)); k * spacing < end; ++k) {
      const Vector3 p = a + (k * spacing - begin) * step;
      const Vector2 center = capture::project(in.camera, p);
      Station station;
      across_tube(in.picture, center, across, radius * in.camera.fx / p.z(), [&](int part, const std::uint8_t* rgb) {
        station.add(part, rgb);
        (part == 1 ? samples.inside : samples.beside[part / 2]).push_back(coarse(rgb));
      });
      samples.outlines += facts * surprise(in, station.contrast());
      if (shot.bounds && pixel_outside(*shot.bounds, center * in.factor)) samples.outlines -= facts * kMostSurprise;
    }
    // beyond the free end
    if (end < chain.length - 1e-9) return;
    const Vector2 tip = capture::project(in.camera, b);
    const double pixels = radius * in.camera.fx / b.z();
    int turn = 0;
    for (const double u : kInside)
      for (int k = 0; k < static_cast<int>(kBeside.size()); ++k)
        if (const auto* const rgb = pixel_at(in.picture, tip + pixels * u * across + beside_at(k, pixels) * forward))
          samples.beside[turn++ % 2].push_back(coarse(rgb));
  }
  static bool pixel_outside(const math::Rectangle& box, const Vector2& at) {
    return at.x() < box.x0 || at.y() < box.y0 || at.x() >= box.x1 || at.y() >= box.y1;
  }

  // Adds the user's points that the link runs through to `reached`, as bits in the order of the shots. `nearest`: by
  // point, lowered to the distance of the link, radii.
  void reach_points(const Vector3& from, const Vector3& to, std::uint64_t& reached,
                    std::vector<double>* nearest = nullptr) const {
    int bit = 0;
    for (const Shot& shot : shots) {
      if (shot.on_rope.empty()) continue;
      const Vector3 a = shot.camera_from_base * from, b = shot.camera_from_base * to;
      const bool seen = a.z() > image_model::kNear && b.z() > image_model::kNear;
      const Vector2 u = seen ? capture::project(*shot.camera, a) : Vector2::Zero();
      const Vector2 v = seen ? capture::project(*shot.camera, b) : Vector2::Zero();
      const double one = std::max(1.0, radius * shot.camera->fx / std::max(image_model::kNear, a.z()));
      for (const Vector2& point : shot.on_rope) {
        const double t = std::clamp((point - u).dot(v - u) / std::max(1e-9, (v - u).squaredNorm()), 0.0, 1.0);
        const double away = (u + t * (v - u) - point).norm() / one;
        if (seen && away < kOnRopeRadii) reached |= std::uint64_t{1} << std::min(bit, 63);
        if (seen && nearest) (*nearest)[bit] = std::min((*nearest)[bit], away);
        ++bit;
      }
    }
  }

  // Nats by which two populations explain the new samples better than one, given the tally.
  double gain_of(const Tally& tally, const std::vector<int>& inside, const std::vector<int>& beside) const {
    const Tables& t = tables();
    const int all = tally.inside_sum + tally.beside_sum;
    const int more_inside = static_cast<int>(inside.size()), more_beside = static_cast<int>(beside.size());
    double gain = t.all[all + more_inside + more_beside] - t.all[all] -
                  (t.side[tally.inside_sum + more_inside] - t.side[tally.inside_sum]) -
                  (t.side[tally.beside_sum + more_beside] - t.side[tally.beside_sum]);
    for (const int i : inside) {
      gain += t.color[tally.inside[i] + fresh_inside[i]] -
              t.color_of_all[tally.inside[i] + tally.beside[i] + fresh_inside[i]];
      ++fresh_inside[i];
    }
    for (const int i : beside) {
      gain += t.color[tally.beside[i] + fresh_beside[i]] -
              t.color_of_all[tally.inside[i] + tally.beside[i] + fresh_inside[i] + fresh_beside[i]];
      ++fresh_beside[i];
    }
    for (const int i : inside) fresh_inside[i] = 0;
    for (const int i : beside) fresh_beside[i] = 0;
    return gain;
  }
  mutable std::vector<int> fresh_inside = std::vector<int>(kBins, 0), fresh_beside = fresh_inside;

  // Returns the gain in evidence of `samples`, in nats, and adds them to the tally if `keep`. Where there is no gain,
  // the samples stem from one population (something hides the rope, or it is a step between two colors): they are not
  // added, and the gain is 0.
  double count(Tally& tally, bool keep) const {
    if (samples.inside.empty() || samples.beside[0].empty() || samples.beside[1].empty()) return 0.0;
    const int more_inside = static_cast<int>(samples.inside.size()),
              more_beside = static_cast<int>(samples.beside[0].size() + samples.beside[1].size());
    const int all = tally.inside_sum + tally.beside_sum + more_inside + more_beside;
    CHAINSPLAT_CHECK(all < kMostSamples, std::to_string(all));
    double least = 1e300;
    for (const std::vector<int>& side : samples.beside) least = std::min(least, gain_of(tally, samples.inside, side));
    const double gain = 2.0 * least * more_beside / (more_beside + more_inside);
    if (gain <= 0.0) return 0.0;
    if (keep) {
      for (const int i : samples.inside) ++tally.inside[i];
      for (const std::vector<int>& side : samples.beside)
        for (const int i : side) ++tally.beside[i];
      tally.inside_sum += more_inside, tally.beside_sum += more_beside;
    }
    return gain;
  }

  // Returns the evidence of a link in all pictures; `keep` false: leaves the tallies as they were.
  double link(std::vector<Tally>& tallies, const Vector3& from, const Vector3& along, double begin, double end,
              bool keep) const {
    double gain = 0.0, outlines = 0.0;
    for (std::size_t i = 0; i < shots.size(); ++i) {
      sample(i, from, along, begin, end);
      looked_at +=
          static_cast<std::int64_t>(samples.inside.size() + samples.beside[0].size() + samples.beside[1].size());
      gain += count(tallies[i], keep);
      outlines += samples.outlines;
    }
    by_color += gain;
    return trust * (gain / kSamplesPerFact + outlines);
  }

  Matrix3 turned(const Matrix3& rotation, double first, double other) const {
    Matrix3 out = rotation * Eigen::AngleAxisd(first, chain.bending_axis).toRotationMatrix();
    if (!planar) out = out * Eigen::AngleAxisd(other, second).toRotationMatrix();
    return out;
  }
  // The log prior of joint j's turn from one direction of the rope to the next, up to a constant; `theta` holds the
  // angles of the joints before it. The first joint is where the gripper may hold the rope askew.
  double believed(int j, const VectorX& theta, double first, double other, const Vector3& before,
                  const Vector3& after) const {
    double sum = -0.5 * (first * first + other * other) / (kBend * kBend);
    const int axes = planar ? 1 : 2, last = axes * (j - 2);
    if (clues.bend_change > 0.0 && j > 2) {
      double change = (first - theta[last]) * (first - theta[last]);
      if (!planar) change += (other - theta[last + 1]) * (other - theta[last + 1]);
      sum -= 0.5 * change / (clues.bend_change * clues.bend_change);
    }
    if (clues.down.isZero()) return sum;
    const auto from_down = [&](const Vector3& v) { return std::acos(std::clamp(v.dot(clues.down), -1.0, 1.0)); };
    const double rise = std::max(0.0, from_down(after) - from_down(before));
    return sum - 0.5 * rise * rise / (kRise * kRise);
  }
  double believed(const Vector3& shift) const {
    return clues.grasp_deviation > 0.0
               ? -0.5 * (shift - clues.grasp).squaredNorm() / (clues.grasp_deviation * clues.grasp_deviation)
               : 0.0;
  }
  double hints(std::uint64_t reached) const { return kOnRope * std::popcount(reached); }

  // Returns the evidence and the log prior of a whole chain whose grasp is off by `shift`. `tallies` begin with the
  // known colors.
  double whole(const VectorX& theta, const Vector3& shift, std::vector<Tally>& tallies) const {
    double sum = believed(shift);
    std::uint64_t reached = 0;
    std::vector<double> nearest(points, kOnRopeRadii);
    Matrix3 rotation = Matrix3::Identity();
    Vector3 before = chain.direction, at = shift + chain.link_end(0) * chain.direction;
    if (chain.link_end(0) > 0.0) sum += link(tallies, shift, chain.direction, 0.0, chain.link_end(0), true);
    if (points) reach_points(shift, at, reached, &nearest);
    const int axes = planar ? 1 : 2;
    for (int j = 1; j < chain.links(); ++j) {
      const int k = axes * (j - 1);
      rotation = turned(rotation, theta[k], planar ? 0.0 : theta[k + 1]);
      const Vector3 along = rotation * chain.direction;
      sum += believed(j, theta, theta[k], planar ? 0.0 : theta[k + 1], before, along);
      sum += link(tallies, at, along, chain.link_start(j), chain.link_end(j), true);
      const Vector3 next = at + (chain.link_end(j) - chain.link_start(j)) * along;
      if (points) reach_points(at, next, reached, &nearest);
      before = along, at = next;
    }
    for (const double radii : nearest) sum -= 0.5 * radii * radii / (kFromMiddle * kFromMiddle);
    return sum + hints(reached);
  }
};

struct Rope {  // the part of a rope that has grown so far
  VectorX theta;
  Matrix3 rotation = Matrix3::Identity();
  Vector3 shift = Vector3::Zero(), tip;
  double score = 0.0;
  std::uint64_t reached = 0;  // the user's points, as bits
  std::vector<Tally> tallies;
};
struct Candidate {
  int parent;
  double first, other, score;
  Vector3 tip;
  std::uint64_t reached;
};

// Places of the grasp to begin at: on a grid about the given one; of one camera only across its view, since depth is
// not seen.
std::vector<Vector3> beginnings(const chain::Chain& chain, std::span<const Shot> shots, const Clues& clues) {
  if (clues.grasp_deviation <= 0.0) return {clues.grasp};
  const double farthest = kFarthestGrasp * clues.grasp_deviation;
  const double step = std::max(kGraspStep * chain.diameter, farthest / kMostGraspSteps);
  const int steps = static_cast<int>(farthest / step);
  const Matrix3 axes = shots[0].camera_from_base.rotation.transpose();
  std::vector<Vector3> out;
  for (int x = -steps; x <= steps; ++x)
    for (int y = -steps; y <= steps; ++y)
      for (int z = shots.size() > 1 ? -steps : 0; z <= (shots.size() > 1 ? steps : 0); ++z) {
        const Vector3 shift = step * (axes * Vector3(x, y, z));
        if (shift.norm() <= farthest + 1e-12) out.push_back(clues.grasp + shift);
      }
  return out;
}

// The directions in which the grasp is sought, base frame.
std::vector<Vector3> view_axes(std::span<const Shot> shots) {
  const Matrix3 axes = shots[0].camera_from_base.rotation.transpose();
  std::vector<Vector3> out{axes.col(0), axes.col(1)};  // of one camera only across its view, as above
  if (shots.size() > 1) out.push_back(axes.col(2));
  return out;
}

// The score of a rope of that shape, and by how much its beginning is off.
std::pair<double, Vector3> placed(const Search& search, const std::vector<Tally>& begin, const VectorX& theta) {
  std::pair<double, Vector3> best{-std::numeric_limits<double>::infinity(), Vector3::Zero()};
  const auto try_it = [&](const Vector3& shift) {
    std::vector<Tally> tallies = begin;
    const double score = search.whole(theta, shift, tallies);
    if (score > best.first) best = {score, shift};
  };
  for (const Vector3& shift : beginnings(search.chain, search.shots, search.clues)) try_it(shift);
  if (search.clues.grasp_deviation <= 0.0) return best;
  for (const double step : kGraspRefinements)
    for (int sweep = 0; sweep < kSweeps; ++sweep)
      for (const Vector3& axis : view_axes(search.shots))
        for (const double sign : {1.0, -1.0}) try_it(best.second + sign * step * search.chain.diameter * axis);
  return best;
}

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

Grown grow(const chain::Chain& chain, std::span<const Shot> shots, std::span<const Tally> known, const Clues& clues) {
  const Search search{chain, shots, clues};
  std::vector<Tally> begin;
  for (std::size_t i = 0; i < shots.size(); ++i)
    begin.push_back(i < known.size() && !known[i].inside.empty() ? known[i] : empty_tally());

  // grow link by link: try a grid of angles at the tip of every kept rope, keep the best ropes with different tips
  std::vector<Rope> beam;
  for (const Vector3& shift : beginnings(chain, shots, clues)) {
    Rope rope;
    rope.theta = VectorX::Zero(chain.angles());
    rope.shift = shift;
    rope.tip = shift + chain.link_end(0) * chain.direction;
    rope.tallies = begin;
    rope.score = search.believed(shift);
    if (chain.link_end(0) > 0.0)
      rope.score += search.link(rope.tallies, shift, chain.direction, 0.0, chain.link_end(0), true);
    if (search.points) search.reach_points(shift, rope.tip, rope.reached);
    rope.score += search.hints(rope.reached);
    beam.push_back(std::move(rope));
  }
  const std::size_t broad = beam.size() > 1 ? kBroadBeam : kBeam;
  const int axes = search.planar ? 1 : 2;
  for (int j = 1; j < chain.links(); ++j) {
    const double length = chain.link_end(j) - chain.link_start(j);
    std::vector<Candidate> candidates;
    const int steps = search.planar ? kPlanarSteps : kSpatialSteps;
    const double step = search.planar ? kPlanarStep : kSpatialStep;
    for (int parent = 0; parent < static_cast<int>(beam.size()); ++parent) {
      Rope& rope = beam[parent];
      const Vector3 before = rope.rotation * chain.direction;
      for (int u = -steps; u <= steps; ++u)
        for (int v = search.planar ? 0 : -steps; v <= (search.planar ? 0 : steps); ++v) {
          const double first = u * step, other = v * step;
          const Vector3 along = search.turned(rope.rotation, first, other) * chain.direction;
          const double gain = search.link(rope.tallies, rope.tip, along, chain.link_start(j), chain.link_end(j), false);
          const Vector3 tip = rope.tip + length * along;
          std::uint64_t reached = rope.reached;
          if (search.points) search.reach_points(rope.tip, tip, reached);
          candidates.push_back({parent, first, other,
                                rope.score + gain + search.believed(j, rope.theta, first, other, before, along) +
                                    search.hints(reached) - search.hints(rope.reached),
                                tip, reached});
        }
    }
    std::stable_sort(candidates.begin(), candidates.end(),
                     [](const Candidate& a, const Candidate& b) { return a.score > b.score; });
    // ropes that have reached fewer of the user's points than others may reach them yet, and have room of their own
    std::vector<Rope> next;
    for (int points = search.points; points >= 0; --points) {
      const std::size_t first = next.size();
      for (const Candidate& c : candidates) {
        if (next.size() == first + broad) break;
        if (std::popcount(c.reached) != points) continue;
        const bool same = std::any_of(next.begin() + first, next.end(), [&](const Rope& rope) {
          return (rope.tip - c.tip).norm() < kSameTip * chain.diameter;
        });
        if (same) continue;
        Rope rope = beam[c.parent];
        rope.theta[axes * (j - 1)] = c.first;
        if (axes == 2) rope.theta[axes * (j - 1) + 1] = c.other;
        const Matrix3 rotation = search.turned(rope.rotation, c.first, c.other);
        search.link(rope.tallies, rope.tip, rotation * chain.direction, chain.link_start(j), chain.link_end(j), true);
        rope.rotation = rotation, rope.tip = c.tip, rope.score = c.score, rope.reached = c.reached;
        next.push_back(std::move(rope));
      }
    }
    beam = std::move(next);
  }

  Grown out;
  for (const Rope& rope : beam)
    if ((rope.tip - beam[0].tip).norm() > std::max(kElsewhere * chain.diameter, kElsewhereShare * chain.length))
      out.margin = std::min(out.margin, (beam[0].score - rope.score) / search.trust);

  // refine the best: its beginning, single angles, pairs of angles that shift the rest of the rope, triples that move
  // one link
  VectorX theta = beam[0].theta;
  Vector3 shift = beam[0].shift;
  std::vector<Tally> tallies = begin;
  double best = search.whole(theta, shift, tallies);
  const auto try_it = [&](const VectorX& angles, const Vector3& moved) {
    tallies = begin;
    const double score = search.whole(angles, moved, tallies);
    if (score > best) best = score, theta = angles, shift = moved;
  };
  for (std::size_t round = 0; round < kRefinements.size(); ++round)
    for (int sweep = 0; sweep < kSweeps; ++sweep) {
      if (clues.grasp_deviation > 0.0)
        for (const Vector3& axis : view_axes(shots))
          for (const double sign : {1.0, -1.0})
            try_it(theta, shift + sign * kGraspRefinements[round] * chain.diameter * axis);
      for (int k = 0; k < chain.angles(); ++k)
        for (int shape = 0; shape < 3; ++shape) {
          if (k + shape * axes >= chain.angles()) continue;
          for (const double sign : {1.0, -1.0}) {
            const double step = kRefinements[round];
            VectorX other = theta;
            other[k] += sign * step;
            if (shape == 1) other[k + axes] -= sign * step;
            if (shape == 2) other[k + axes] -= 2 * sign * step, other[k + 2 * axes] += sign * step;
            try_it(other, shift);
          }
        }
    }
  if (clues.shape.size() == chain.angles()) {
    const auto [score, begins] = placed(search, begin, clues.shape);
    if (score > best - kFoundAngle * static_cast<double>(chain.angles())) theta = clues.shape, shift = begins;
  }
  out.theta = theta;
  out.shift = shift;
  // the evidence and the tallies of this moment alone
  out.tallies.assign(shots.size(), empty_tally());
  search.looked_at = 0;
  search.by_color = 0.0;
  search.whole(theta, shift, out.tallies);
  out.evidence = search.looked_at ? search.by_color / static_cast<double>(search.looked_at) : 0.0;
  return out;
}

}  // namespace chainsplat::masking
