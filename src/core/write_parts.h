// src/core/write_parts.h - writing a file that is too large to be in memory as one text.
#pragma once
#include <functional>
#include <string_view>

#include "chainsplat/core.h"

namespace chainsplat::core {

// As write_file(), part by part: `next` gives the bytes that follow, which it may change at its next call, and none at
// the end.
void write_parts(const Path& path, const std::function<std::string_view()>& next);

}  // namespace chainsplat::core
