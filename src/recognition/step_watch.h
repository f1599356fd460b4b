// step_watch.h - tells from the losses of Adam's steps whether the optimization runs away. Both modes use it.
#pragma once
#include "chainsplat/core.h"

namespace chainsplat::recognition {

struct StepWatch {
  double smooth_loss = -1.0;  // of the round, relative; negative: none yet
  double least_loss = -1.0;   // of smooth_loss in this round
  int losses = 0;             // taken in this round
  int bad_steps = 0;          // steps of the whole job in which a gradient was not finite; those were skipped
  int bad_in_a_row = 0;
  int restarts = 0;  // after running away: each repeats the round with smaller steps
};

// Step size of the job after `restarts`, of the first one.
double step_scale(const StepWatch& watch);

enum class Course { fine, diverged };

// Takes the loss of one step relative to that of empty pictures of the same views: what else the masks show is never
// explained, and in some views there is more of it. Diverged when it is not finite, has become twice the round's least,
// or is no better than the empty picture's (Gaussians ran out of all views).
Course watch_loss(StepWatch& watch, double relative_loss);
void begin_round(StepWatch& watch);  // losses of different rounds are not compared

// Takes the number of parameters whose gradient was not finite in one step (they were not moved): diverged when that
// has gone on for many steps in a row. Warns at the first one.
Course watch_gradients(StepWatch& watch, int not_finite, int step);

}  // namespace chainsplat::recognition
