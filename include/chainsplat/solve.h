// chainsplat/solve.h - damped least squares and Adam: the loops that fit something, and what they say of their end.
//
// The caller builds its normal equations itself, J^T W J and J^T W r with robust weights and priors: what is summed in
// which order, and on how many threads, is its own. Here is what follows: damping (Levenberg, Marquardt), the linear
// solve, which step is taken, when to stop, and a Summary of it. Nothing here runs on several threads. A place that
// cannot be evaluated has a cost that is not finite (a returned value, as with Ceres); it is no exception.
#pragma once
#include <functional>
#include <limits>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "chainsplat/core.h"
#include "chainsplat/math.h"

namespace chainsplat::solve {

using math::MatrixX;
using math::VectorX;

// --- how a fit ended -------------------------------------------------------------------------------------------------

// From the best to the worst.
enum class Reason {
  goal,            // the caller's own test: good enough
  gradient,        // converged: the gradient is below the tolerance
  step,            // converged: the step is below the tolerance
  cost,            // converged: the step lowered the cost by less than the tolerance
  no_decrease,     // no step, however damped, lowered the cost: a minimum up to rounding, or wrong derivatives
  last_iteration,  // not converged within the iterations that were allowed
  singular,        // no damping made the equations positive definite
  not_finite,      // the cost at the start, or a step, is not finite
  cancelled,       // core::stop_requested()
};

struct Summary {
  Reason reason = Reason::last_iteration;
  int iterations = 0;                                                // steps tried, those not taken among them
  double initial_cost = std::numeric_limits<double>::quiet_NaN();  // in the caller's units; NaN: not known
  double final_cost = std::numeric_limits<double>::quiet_NaN();
  double worst_step = 0.0;  // length of the last step that was taken: what the result still moved by
};

bool converged(const Summary& summary);  // by goal, gradient, step or cost
const char* name(Reason reason);         // as in JSON: "last_iteration"
std::optional<Reason> reason_of(const std::string& name);
// One line: "stopped at its last iteration (25): cost 3.1 to 1.2, last step 0.004".
std::string describe(const Summary& summary);
// Several fits told as one: the worst reason, the most iterations, the sums of the costs, the longest last step.
Summary together(std::span<const Summary> fits);

// --- options ---------------------------------------------------------------------------------------------------------

struct Damping {
  enum class Rule {
    none,      // Gauss-Newton
    fixed,     // `first` on the diagonal, always
    multiply,  // Marquardt: the diagonal times 1 + damping
    shift,     // Levenberg: damping on the diagonal, as much as makes the matrix positive definite (Cholesky)
  };
  Rule rule = Rule::multiply;
  double first = 1e-3;
  double raise = 10.0, lower = 0.1;  // factors after a step that did not help, and after one that did
  double least_raised = 0.0;         // raised, it is this at least
  double least = 1e-12;              // lowered, it is this at least; with `shift` it is 0 where it would be less
};

struct Options {
  static constexpr int kAny = std::numeric_limits<int>::max();
  int steps = 50;       // at most, that are taken
  int trials = kAny;    // at most, that are tried
  int attempts = 50;    // at most, that are tried from one place
  bool checked = true;  // a step is taken only where it lowers the cost; else every step is
  bool ties = false;    // a step that leaves the cost as it is may be taken too,
  double rounding = 0.0;            // or one that raises it by less than this
  double cost_tolerance = 0.0;      // relative: a step that lowers the cost by less is the last
  double decrease_tolerance = 0.0;  // the same, absolute; of half a sum of squared whitened residuals, a likelihood's
  double gradient_tolerance = 0.0;  // of the gradient's Euclidean norm
  double step_tolerance = 0.0;      // a shorter step is the last, taken or not
  double trusted = 0.0;             // the first step from a place, no longer than this, is taken unchecked and the last
  double negligible = 0.0;          // a step no longer than this is not even taken, and the last
  double longest = std::numeric_limits<double>::infinity();  // longer steps are shortened to it
  bool euclidean = false;    // the length of a step is its Euclidean norm; else its largest component
  int measured = 0;          // so many unknowns, the first, make the length; 0: all
  bool eager = false;        // derivatives are asked for with each first trial: worth it where most succeed
  bool cancellable = false;  // ends where core::stop_requested()
  Damping damping{};
};

// Throws InputError that names the field with a value that means nothing.
void check(const Options& options);

// --- equations -------------------------------------------------------------------------------------------------------

struct NormalEquations {
  MatrixX matrix;    // J^T W J, symmetric
  VectorX gradient;  // J^T W r
};

// The arrow form of joint problems: unknowns that all share, then those of each local block, which knows nothing of the
// other blocks. In this order are the unknowns.
struct ArrowEquations {
  struct Local {
    MatrixX matrix;    // own x own
    MatrixX coupling;  // own x shared
    VectorX gradient;  // own
  };
  MatrixX shared;    // shared x shared
  VectorX gradient;  // shared
  std::vector<Local> local;
};
NormalEquations dense(const ArrowEquations& arrow);
// What is left of the shared block when the local unknowns are eliminated: the Schur complement and its gradient.
NormalEquations reduced(const ArrowEquations& arrow);

// -(matrix + damping)^-1 gradient by L D L^T, with `shift` by L L^T. False: with this damping the matrix is not
// positive definite (`shift` only).
bool damped_step(const NormalEquations& equations, const Damping& rule, double damping, VectorX& step);
// The same by the Schur complement, the blocks in their order: time is linear in their number. One block alone is
// solved as a dense matrix.
bool damped_step(const ArrowEquations& equations, const Damping& rule, double damping, VectorX& step);

// --- least squares ---------------------------------------------------------------------------------------------------

// Finds the least cost from `x` on, and leaves it there. `evaluate` gives the cost at x, and fills the equations about
// x where asked to (null: the cost alone).
Summary least_squares(VectorX& x, const std::function<double(const VectorX& x, NormalEquations* equations)>& evaluate,
                      const Options& options);
Summary least_squares(VectorX& x, const std::function<double(const VectorX& x, ArrowEquations* equations)>& evaluate,
                      const Options& options);

// The same for equations that are the caller's own.
struct Callbacks {
  // Cost at x; with `derivatives` the equations about x are made too. They count once accepted() is called.
  std::function<double(const VectorX& x, bool derivatives)> evaluate;
  // The damped step from the last place that was accepted. False: the damping is too little.
  std::function<bool(double damping, VectorX& step)> step;
  // Optional. The last place evaluated with derivatives, the first one too, is where to go on from. A reason ends it.
  // `decrease`: of the cost; infinity at the start.
  std::function<std::optional<Reason>(double decrease)> accepted;
  // Optional. `step` did not lower the cost.
  std::function<std::optional<Reason>(const VectorX& step)> rejected;
};
Summary least_squares(VectorX& x, const Callbacks& callbacks, const Options& options);

// The loop between two evaluations, for callers that evaluate many fits at once: evaluate `trial`, judge() its cost,
// propose() the next.
struct Descent {
  VectorX x;                // the best place so far
  VectorX trial;            // to be evaluated next,
  bool derivatives = true;  // with derivatives; without, accepted places are evaluated once more
  bool done = false;
  Summary summary;
  // its own
  double cost = std::numeric_limits<double>::infinity(), decrease = 0.0, damping = 0.0, length = 0.0;
  int taken = 0, attempt = 0;
  bool started = false;
  VectorX step;
};
Descent begin(const VectorX& x, const Options& options);
// True where `trial` with this cost became `x`.
bool judge(Descent& descent, double cost, const Options& options);
void propose(Descent& descent, const std::function<bool(double damping, VectorX& step)>& step, const Options& options);

// --- Adam (Kingma and Ba 2015, Algorithm 1) --------------------------------------------------------------------------

struct AdamOptions {
  double rate = 1e-3;                  // alpha, in the unknowns' units
  double beta1 = 0.9, beta2 = 0.999;   // decay of the two moments
  double epsilon = 1e-15;              // 3DGS'; the paper's is 1e-8
};
struct AdamState {
  VectorX first, second;  // moments; empty before the first step
  int steps = 0;
};
// Throws InputError that names the field.
void check(const AdamOptions& options);
// One step down `gradient`. The first one checks the options.
void adam_step(AdamState& state, const VectorX& gradient, const AdamOptions& options, VectorX& x);

}  // namespace chainsplat::solve
