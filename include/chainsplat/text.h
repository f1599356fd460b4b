// chainsplat/text.h - numbers for people: messages and notes, where files have every digit (core::exact).
#pragma once
#include <string>

namespace chainsplat::core {

// At most three decimals from 1 on, at most four significant digits below, without trailing zeros: 1.967, 0.01235,
// 1763800000.25. 'nan' and 'inf' as they are.
std::string brief(double value);

}  // namespace chainsplat::core
