// predict.h - the belief in a rope that nobody looks at, moved by the twin's dynamics (mathematics.md 6.3).
#pragma once
#include <utility>

#include "src/estimation/state.h"

namespace chainsplat::estimation {

// The angles and rates that the twin predicts for a rope that was at rest when the base's motion began; at rest still
// where its dynamics are not known. `base`: as it is believed to move.
std::pair<math::VectorX, math::VectorX> motion_from_rest(const Given& given, const dynamics::BaseFunction& base,
                                                         double time);

// Returns a wide belief around that motion.
Belief first_belief(const State& state, double time);

// The same for a rope that is known to hang untouched: a narrow belief.
Belief resting_belief(const State& state, double time);

// What may have happened to the rope in a step: nothing beyond the model, a force that changes as under a hand, or also
// a blow, when the rope runs into something or is released.
enum class Contact { none, touched, struck };

// Returns the mean of a belief at a later time, without a measurement. It is most of what a prediction costs, and does
// not depend on what may have happened.
Motion move(const State& state, const Belief& belief, double time);
// Returns the belief at the time to which it was moved.
Belief predict(const State& state, const Belief& belief, const Motion& motion, Contact contact);

// Whether the motion until that time is known already.
bool is_ahead(const State& state, double time);
// As Filter::expected(). The motion is kept for the frame of that time.
std::optional<math::VectorX> expected(State& state, double time);

}  // namespace chainsplat::estimation
