// src/core/own_library.h - shared libraries of the program's own, loaded at first use, because what they link (FFmpeg,
// OpenImageIO, OpenCV's networks) is large and most commands need none of it.
//
// Such a library is NAME.so. It exports one table of functions, under its own name, which begins with the `version` of
// the program that it was built with. It throws the program's exceptions and has a copy of `core` to itself, so that
// what belongs to the process as a whole (listener, request to stop) reaches it through arguments.
#pragma once
#include <dlfcn.h>

#include <cstring>
#include <string>

#include "chainsplat/core.h"

namespace chainsplat::core {

// Returns the table of a library, which lies where the program's run path says: beside it in the build folder, in a
// folder of the program's own where it is installed. It stays loaded until the process ends. Throws WorkError, with the
// advice `mend`, where it is missing or of another version.
template <class Table>
const Table& own_library(const std::string& name, const std::string& mend) {
  const std::string file = name + ".so";
  void* const library = ::dlopen(file.c_str(), RTLD_LAZY | RTLD_LOCAL);
  const void* const found = library ? ::dlsym(library, name.c_str()) : nullptr;
  if (!found) {
    const char* const reason = ::dlerror();
    throw WorkError(file, std::string("cannot be loaded (") + (reason ? reason : "it is empty") + ")", mend);
  }
  const auto& table = *static_cast<const Table*>(found);
  if (std::strcmp(table.version, CHAINSPLAT_VERSION) != 0)
    throw WorkError(file, std::string("is of version ") + table.version + ", the program of " CHAINSPLAT_VERSION, mend);
  return table;
}

}  // namespace chainsplat::core
