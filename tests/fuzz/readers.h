// tests/fuzz/readers.h - what the files of the fuzzed readers share.
//
// A reader takes bytes as they come from outside. It may throw InputError (and WorkError where its header says so);
// anything else, a crash, five seconds or a gigabyte are defects. What is accepted is written and read again where that
// is cheap. Readers that live in unnamed namespaces are reached by including that file.
#pragma once
#include <string_view>

#include "chainsplat/core.h"
#include "chainsplat/twin.h"

namespace chainsplat::fuzz {

// A folder of this process under the system's temporary one (tools/fuzz puts that into memory), removed at the end.
const Path& folder();
// Writes in place, without core::write_file's fsync.
void put(const Path& file, std::string_view bytes);
// Throws std::logic_error: what was read does not come back, or is not what its reader promises.
void require(bool condition, const char* promise);
// A chain of two planar joints, and what its dynamics need.
const chain::Chain& two_joints();
dynamics::Parameters parameters_of_two_joints();

using Read = void (*)(std::string_view);
void batch(std::string_view bytes);
void checkpoint(std::string_view bytes);
void contacts(std::string_view bytes);
void estimates(std::string_view bytes);
void metrics(std::string_view bytes);
void online(std::string_view bytes);

}  // namespace chainsplat::fuzz
