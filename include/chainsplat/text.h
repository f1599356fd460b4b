// chainsplat/text.h - numbers for people: messages and notes, where files have every digit (core::exact).
#pragma once
#include <string>

namespace chainsplat::core {

// At most three decimals from 1 on, at most four significant digits below, without trailing zeros: 1.967, 0.01235,
// 1763800000.25. 'nan' and 'inf' as they are.
std::string brief(double value);

// "0.000476 +- 0.000048": the error with two significant digits, the value with as many decimals. An error that is not
// known, zero or not finite stands as brief() writes it, and so does the value then.
std::string with_error(double value, double error);

}  // namespace chainsplat::core
