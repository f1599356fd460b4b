// online.h - identify --online.
#pragma once
#include <string>

#include "cli.h"

namespace chainsplat::tools {

struct OnlineRequest {
  std::string run, file;  // "-": standard input
  std::string base;       // TUM; empty: the capture's own
  double memory = 5.0;    // s
};
// Updates the twin in its folder. Throws InputError with the line.
void identify_online(const Globals& globals, const OnlineRequest& request);

}  // namespace chainsplat::tools
