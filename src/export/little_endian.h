// little_endian.h - numbers as the formats of this module have them, whose bytes are all little-endian.
#pragma once
#include <bit>
#include <cstring>
#include <string>

namespace chainsplat::exports {

static_assert(std::endian::native == std::endian::little);

template <class Number>
void put(std::string& out, Number value) {
  char bytes[sizeof value];
  std::memcpy(bytes, &value, sizeof value);
  out.append(bytes, sizeof value);
}

}  // namespace chainsplat::exports
