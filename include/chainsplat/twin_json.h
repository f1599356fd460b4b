// chainsplat/twin_json.h - parts of twin.json for other documents. Not installed, as json.h.
#pragma once
#include <nlohmann/json_fwd.hpp>
#include <vector>

#include "chainsplat/corrections.h"

namespace chainsplat::twin {

// The findings and the corrections as twin.json has them.
nlohmann::ordered_json to_json(const std::vector<capture::Finding>& verdict);
nlohmann::ordered_json to_json(const capture::Corrections& corrections);

}  // namespace chainsplat::twin
