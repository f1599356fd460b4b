// chainsplat/solve_json.h - how a fit ended, as JSON. Not installed, as json.h.
#pragma once
#include <nlohmann/json_fwd.hpp>

#include "chainsplat/solve.h"

namespace chainsplat::solve {

// {"reason", "iterations", "initial_cost", "final_cost", "worst_step"}; costs that are not known are null.
void to_json(nlohmann::ordered_json& out, const Summary& summary);

}  // namespace chainsplat::solve
