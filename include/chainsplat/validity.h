// chainsplat/validity.h - the motion that a twin's dynamics were identified in, and motion that goes beyond it.
#pragma once
#include <optional>
#include <string>

#include "chainsplat/chain.h"
#include "chainsplat/trajectory.h"

namespace chainsplat::twin {

// The largest of a motion.
struct Validity {
  double acceleration = 0.0;  // m/s^2, of the grasp, gravity left out
  double speed = 0.0;         // m/s, of a joint or the free end
  double curvature = 0.0;     // 1/m, bend of a joint over the length of rope that it stands for
};

// Of a rope under that base motion. `states` needs no rates: speeds are those between its times.
Validity validity_of(const chain::Chain& chain, const trajectory::Trajectory& base, const chain::States& states);
Validity larger(const Validity& one, const Validity& other);
// What a motion has most in excess of what is known, in one clause without a full stop ("the grasp accelerates by 25
// m/s^2, 4.1 times what the twin was identified in"); empty where nothing exceeds it by half, which is how far twins
// have followed ropes as well as in what they were made from (figures.md, 'Motions that no fit has seen').
std::string beyond(const Validity& known, const Validity& motion);
// Warns of it; `where`: whose motion it is. Nothing where nothing is known.
void warn_beyond(const std::optional<Validity>& known, const Validity& motion, const std::string& where);

}  // namespace chainsplat::twin
