// mistakes.h - mistakes that people make when they write a capture: poses the other way round, other axes, millimeters.
#pragma once
#include <vector>

#include "chainsplat/corrections.h"

namespace chainsplat::pipeline {

// Tries the mistakes one after the other where the rope cannot be found in the masks with what was given, and names
// that which explains them (two together where one alone does not). Empty where the rope is found, or where none
// explains it. The findings are `impossible`: what follows from such a capture is not worth having.
std::vector<capture::Finding> find_mistakes(const capture::Capture& capture);

}  // namespace chainsplat::pipeline
