// Fuzzes the input of `force`: the lines of `estimate`, and points of contact.
#include <limits>
#include <sstream>

#include "chainsplat/estimate_lines.h"
#include "readers.h"
#include "src/pipeline/contact_file.h"

namespace chainsplat::fuzz {

void estimates(std::string_view bytes) {
  std::istringstream lines{std::string(bytes)};
  double before = -std::numeric_limits<double>::infinity();
  for (std::string line; std::getline(lines, line);) {
    const auto state = estimation::read_estimate_line(line, "line", two_joints().angles(), before);
    if (!state) continue;
    before = state->time;
    require(state->theta.size() == 2 && state->theta.allFinite(), "finite angles of the twin");
  }
}

void contacts(std::string_view bytes) {
  static const Path file = folder() / "contacts.csv";
  put(file, bytes);
  pipeline::read_contacts(file);
}

}  // namespace chainsplat::fuzz
