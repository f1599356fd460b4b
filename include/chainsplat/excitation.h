// chainsplat/excitation.h - what to record next: base motions that make the parameters best observable (paper, first of
// the open problems of identification; D-optimal experiments).
//
// What a recording can tell is the information of its frames, the sum of J^T J / sd^2 with J the derivatives of points
// of the rope by the parameters (variational equation), less what is spent on the unknown initial state. The motion
// maximizes log det(what is known + that): the volume of what remains uncertain shrinks most.
#pragma once
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "chainsplat/dynamics/parametrization.h"
#include "chainsplat/planning.h"

namespace chainsplat::excitation {

using math::MatrixX;
using math::VectorX;

struct Options {
  std::vector<planning::Axis> axes;  // empty: x in free space for a planar chain, x and y for a spatial one; on a table
                                     // x, y and yaw
  double duration = 5.0;             // s
  planning::Limits limits;           // `stroke` too: keep the rope inside of what the cameras see
  double frame_rate = 30.0;          // 1/s, of the recording
  // m, sd of a recorded point's coordinate about the model; without: as large as it was in the recording that was
  // identified, by what its covariance says that it told
  std::optional<double> noise;
  // rad, of one angle from where it starts, and at most a bend around two diameters of the rope: beyond, recognition is
  // not to be trusted
  double max_bend = 1.2;
  int starts = 24;       // random motions, of which the best is refined
  int generations = 24;  // of eight changes of it each
  std::uint64_t seed = 0;

  void check() const;  // throws InputError whose `where` names the wrong field
};

struct Problem {
  dynamics::Model model;
  bool tabletop = false;
  math::Pose base;                 // at the start
  dynamics::InitialState initial;  // at rest
  dynamics::Estimates estimates;   // what is known: names, covariance
  // Base motion of the recording that was identified, to compare with and to know its noise by; may be empty.
  dynamics::BaseFunction recorded;
  double recorded_start = 0.0, recorded_end = 0.0;  // s
};

// One entry a parameter; initial states are none.
struct Prediction {
  std::vector<std::string> names;
  std::vector<double> now;       // standard error, in the units of the name
  std::vector<double> excited;   // after one recording of the motion
  std::vector<double> repeated;  // after one more recording of the old motion as long as it was; empty without it
  double gain = 0.0;             // decrease of the log of the uncertain volume a parameter, by the motion
  double repeated_gain = 0.0;
};

struct Result {
  planning::Motion motion;
  planning::Peaks peaks;
  chain::States states;  // predicted, at the frame rate
  double noise = 0.0;    // m, that was reckoned with
  double spread = 0.0;   // m, of the prediction, as Forecast says
  Prediction prediction;
};

// Same seed, same motion. Throws InputError as Options::check() and where the twin knows no covariance, WorkError where
// no motion keeps the rope within `max_bend` and the twin able to predict it.
Result excite(const Problem& problem, const Options& options);

// What a recording would show and tell (mathematics.md 5.7).
struct Forecast {
  chain::States states;  // predicted
  // About the parameters, n x n, with the initial state known as well as recognition knows it and left out of the sum;
  // empty where the rollout diverges.
  MatrixX information;
  // m: where the uncertain parameters take the rope's points, RMS over them, at the time at which it is largest.
  double spread = 0.0;
};

// Of the base motion `base` at `times`, with points of the centerline off by noise of the given sd (m per coordinate).
// `covariance`: of the parameters.
Forecast forecast(const dynamics::Model& model, std::span<const dynamics::Unknown> parameters,
                  const MatrixX& covariance, const dynamics::BaseFunction& base, const dynamics::InitialState& initial,
                  const std::vector<double>& times, double noise);

}  // namespace chainsplat::excitation
