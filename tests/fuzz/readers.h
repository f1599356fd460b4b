// tests/fuzz/readers.h - the declarations that the files of the fuzzed readers share.
//
// A reader takes bytes as they come from outside. It may throw InputError (and WorkError where its header says so); any
// other exception, a crash, more than five seconds or more than a gigabyte are defects. Accepted input is written and
// read again where that is cheap. Readers in unnamed namespaces are reached by including their file.
#pragma once
#include <string_view>

#include "chainsplat/core.h"
#include "chainsplat/twin.h"

namespace chainsplat::fuzz {

// Returns this process's folder under the system's temporary one (which tools/fuzz keeps in memory), removed at the
// end.
const Path& folder();
// Writes a file in place, without core::write_file's fsync.
void put(const Path& file, std::string_view bytes);
// Throws std::logic_error where the condition does not hold: input is not what its reader promises, or does not survive
// writing and reading.
void require(bool condition, const char* promise);
// A chain of two planar joints, and parameters of its dynamics.
const chain::Chain& two_joints();
dynamics::Parameters parameters_of_two_joints();

using Read = void (*)(std::string_view);
void batch(std::string_view bytes);
void board(std::string_view bytes);
void calibration(std::string_view bytes);
void checkpoint(std::string_view bytes);
void colmap(std::string_view bytes);
void contacts(std::string_view bytes);
void estimates(std::string_view bytes);
void forces(std::string_view bytes);
void metrics(std::string_view bytes);
void online(std::string_view bytes);
void pose(std::string_view bytes);
void robot_log(std::string_view bytes);
void urdf(std::string_view bytes);

}  // namespace chainsplat::fuzz
