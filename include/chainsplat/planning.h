// chainsplat/planning.h - base motions that bring the rope to a target (mathematics.md 8; paper, "Model-based
// trajectory optimization").
//
// The base moves along world axes and turns about the vertical, from rest to rest, in a stretch of radial basis
// functions for every target. The rope follows by the identified dynamics; the weights are found by Gauss-Newton on a
// soft minimum of the distance to the target that is sharpened step by step, from many starts.
#pragma once
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "chainsplat/dynamics.h"

namespace chainsplat::planning {

using math::MatrixX;
using math::Vector3;
using math::VectorX;

enum class Axis { x, y, z, yaw };

// s^3 (1 - s)^3 with a quintic between the ends: starts and ends without acceleration (mathematics.md 8 [D]); or s^2 (1
// - s)^2 with a cubic, as in the paper.
enum class Window { smooth, paper };

// What of the rope is to hit: the free end, the nearest point of the last link's centerline, or of the whole rope's.
enum class Part { tip, last_link, rope };

// What the arm can do. Speeds are of the translation (norm of the vector); those of yaw are separate. Stroke: farthest
// offset from the start along each axis. Yaw's are of a wrist like the UR5e's (180 deg/s).
struct Limits {
  double velocity = 1.5, acceleration = 10.0, jerk = 200.0, stroke = 0.6;            // m, s
  double yaw_velocity = 3.1, yaw_acceleration = 20.0, yaw_jerk = 400.0, turn = 1.6;  // rad, s
};

inline constexpr int kBasisCount = 8;  // B of mathematics.md 8

// One stretch: coordinate c moves by terminal[c] * blend(s) + scale * window(s) * sum_i phi_i(s) weights(i, c).
struct Piece {
  double start = 0.0, duration = 0.0;  // s
  MatrixX weights;                     // kBasisCount x axes, m or rad
  VectorX terminal;                    // axes, m or rad
};

// The sum of all pieces; each rests at its terminal value after its end.
struct Motion {
  math::Pose origin;              // base pose where all coordinates are 0
  Vector3 up = Vector3::UnitZ();  // unit, world; yaw turns about it
  std::vector<Axis> axes;
  Window window = Window::smooth;
  std::vector<Piece> pieces;
  double end() const;  // s
};
// World position and yaw with their first three derivatives: rows x, y, z, yaw; columns value, 1st, 2nd, 3rd.
using Coordinates = Eigen::Matrix4d;
Coordinates coordinates(const Motion& motion, double time);
trajectory::BaseMotion base_at(const Motion& motion, double time);

struct Peaks {
  double velocity = 0.0, acceleration = 0.0, jerk = 0.0, stroke = 0.0;
  double yaw_velocity = 0.0, yaw_acceleration = 0.0, yaw_jerk = 0.0, turn = 0.0;
  std::string over;  // the first limit that is exceeded, empty: none
};
// On a grid of `step` s and where the jerk jumps.
Peaks peaks(const Motion& motion, double from, double to, const Limits& limits, double step = 1e-3);

// Rope and gripper stay out of these. Box: axis-aligned in the world.
struct Sphere {
  Vector3 center;
  double radius = 0.0;  // m
};
struct Box {
  Vector3 low, high;
};

struct Options {
  std::vector<Axis> axes;  // empty: x for a planar chain, else x and y
  Window window = Window::smooth;
  std::optional<Part> part;         // none: the tip in free space, the whole rope on a table
  double horizon = 3.0;             // s, for each target
  bool free_horizon = false;        // the shortest of a set of horizons that reaches it; `horizon` is the longest
  std::optional<VectorX> terminal;  // offset from the start at the end, one an axis; none: free
  Limits limits;
  std::vector<Sphere> spheres;
  std::vector<Box> boxes;
  double gripper_radius = 0.04;  // m, of the sphere about the base that must stay out of them
  double tolerance = 0.001;      // m, a smaller miss counts as reached
  int starts = 24;               // random motions that are tried before the best ones are optimized
  int samples = 0;               // parameter sets drawn from the covariance; 0: the identified one alone
  bool worst_case = false;       // of the samples, instead of their mean
  std::uint64_t seed = 0;
};

// Where the rope (what of it, Options say) is to be brought. On a table: at the end of the stretch, at rest; the target
// is taken at the rope's height. In free space: at any time.
struct Problem {
  dynamics::Model model;
  bool tabletop = false;
  std::optional<Vector3> table_point;  // m, world
  math::Pose base;                     // at the start
  dynamics::InitialState initial;
  std::vector<Vector3> targets;   // m, world; reached one after the other
  dynamics::Estimates estimates;  // for `samples`
};

struct Hit {
  double miss = 0.0;                         // m, hard minimum, between the steps too
  double time = 0.0;                         // s
  Vector3 point = Vector3::Zero();           // of the rope, m, world
  double arclength = 0.0;                    // m, of that point from the grasp
  double mean_miss = 0.0, worst_miss = 0.0;  // over the samples; the miss itself without them
};

struct Plan {
  Motion motion;
  std::vector<Hit> hits;  // one a target
  bool reached = false;
  std::string reason;  // why not
  Peaks peaks;
  int starts = 0, iterations = 0;
  solve::Summary summary;  // of the last fit of each stretch together; m^2, m (norm of the weights)
  double seconds = 0.0;
};

// Throws InputError for targets that are not finite or under the table, and limits that contradict each other. A target
// that cannot be reached is no error: reached is false, and the motion is the one that comes nearest.
Plan plan(const Problem& problem, const Options& options);

// Lower bound of the miss from geometry alone: rope length, stroke, the plane of a planar chain. m.
double unreachable_distance(const Problem& problem, const Options& options, const Vector3& target);

// A target that the rope passes in a random motion within the limits (on a table: at its end). Another stream of random
// numbers than plan()'s.
Vector3 random_target(const Problem& problem, const Options& options, std::uint64_t seed);

// Predicted states at `times` under the motion. Throws WorkError where they diverge.
chain::States predict(const Problem& problem, const Motion& motion, const std::vector<double>& times);

// `count` parameter sets drawn from the covariance of what was identified.
std::vector<dynamics::Parameters> draw_parameters(const chain::Chain& chain, const dynamics::Parameters& parameters,
                                                  const dynamics::Estimates& estimates, int count, std::uint64_t seed);

// The angles of `chain` whose centerline comes nearest to `points` (3 x count, world) at `arclengths`, from `start`, by
// Gauss-Newton; and with the points' velocities the rates that go with them.
struct StateFit {
  dynamics::InitialState state;
  solve::Summary summary;  // m^2, rad (norm)
};
StateFit fit_state(const chain::Chain& chain, const trajectory::BaseMotion& base, const std::vector<double>& arclengths,
                   const MatrixX& points, const MatrixX& velocities, const VectorX& start);

// Replanning while another chain plays the rope's part. What is seen of it are points of its centerline and their
// speeds, without noise; from them come the twin's state and, by what the model did not foretell since the last look,
// common factors of its stiffness, damping, friction and drag. A replan is two steps of Gauss-Newton from the motion so
// far; the correction is taken as far as it keeps the limits, so that the executed motion keeps them where the plan
// did.
struct LoopOptions {
  bool feedback = true;                       // else the plan is played as it is
  double rate = 10.0;                         // replans per second
  Vector3 target_velocity = Vector3::Zero();  // m/s; seen by the replanning only, the plan knows the first place
};
struct LoopResult {
  Motion motion;         // as executed
  chain::States states;  // of the true chain
  Hit hit;               // of the true chain, against the target where it is then
  Peaks peaks;
  int replans = 0;
  double longest_replan = 0.0, mean_replan = 0.0;  // s of one core
  double foretold = 0.0;                           // m, miss as the last replan expected it
  double out_of_reach = 0.0;                       // m, unreachable_distance() of the target as it moves, at best
  // Of the replans together: two steps each, so most end at the last. Without feedback 0 iterations.
  solve::Summary summary;
};
// Plays `plan` (of one target) on `truth`, from rest: in free space in its own equilibrium, on a table with the shape
// of the problem's initial state.
LoopResult closed_loop(const Problem& problem, const Options& options, const Plan& plan, const dynamics::Model& truth,
                       const LoopOptions& loop);

// Base path, rope at a few times, targets and obstacles: a side view (free space) or the view from above (table).
std::string picture_svg(const Problem& problem, const Options& options, const Plan& plan);

}  // namespace chainsplat::planning
