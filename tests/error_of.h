// tests/error_of.h - the words of an error that is expected.
#pragma once
#include <functional>
#include <string>

#include "chainsplat/core.h"

namespace chainsplat::test {

// What the program would say of bad input or of work that failed; empty where nothing is thrown.
inline std::string error_of(const std::function<void()>& act) {
  try {
    act();
  } catch (const Error& error) {
    return error.what();
  }
  return "";
}

inline bool contains(const std::string& text, const std::string& part) { return text.find(part) != std::string::npos; }

}  // namespace chainsplat::test
