// step_watch.h - tells from the losses of Adam's steps whether the optimization runs away. Both modes use it.
#pragma once
#include "chainsplat/core.h"

namespace chainsplat::recognition {

struct StepWatch {
  double smooth_loss = -1.0;  // of the round; negative: none yet
  double least_loss = -1.0;   // of smooth_loss in this round
  double first_loss = -1.0;   // of the whole job
  int losses = 0;             // taken in this round
  int bad_steps = 0;          // steps of the whole job in which a gradient was not finite; those were skipped
  int bad_in_a_row = 0;
  int restarts = 0;  // after running away: each repeats the round with smaller steps
};

// Step size of the job after `restarts`, of the first one.
double step_scale(const StepWatch& watch);

enum class Course { fine, diverged };

// Takes the loss of one step: diverged when it is not finite, has become twice the round's least, or is no better than
// where the job began (Gaussians that ran out of all views leave an empty image's).
Course watch_loss(StepWatch& watch, double loss);
void begin_round(StepWatch& watch);  // losses of different rounds are not compared

// Takes the number of parameters whose gradient was not finite in one step (they were not moved): diverged when that
// has gone on for many steps in a row. Warns at the first one.
Course watch_gradients(StepWatch& watch, int not_finite, int step);

}  // namespace chainsplat::recognition
