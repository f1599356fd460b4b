// Fuzzes the input of `force`: the lines of `estimate`, and points of contact; and its output, which `report` reads.
#include <cmath>
#include <limits>
#include <sstream>

#include "chainsplat/estimate_lines.h"
#include "chainsplat/force.h"
#include "chainsplat/report.h"
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

// What is accepted is written and read again.
void forces(std::string_view bytes) {
  std::istringstream lines{std::string(bytes)};
  double before = -std::numeric_limits<double>::infinity();
  for (std::string line; std::getline(lines, line);) {
    const force::Line read = force::from_json(line, "line", two_joints(), before);
    const force::Estimate& e = read.estimate;
    require(force::is_finite(e) && e.time > before, "finite numbers, later than before");
    require(e.contact.link >= 0 && e.contact.link < two_joints().links(), "a contact on the chain");
    require(math::is_covariance(e.covariance), "a covariance");
    const report::ForceSize size = report::size_of(e);
    require(size.least >= 0.0 && size.least <= size.value && size.value <= size.most && std::isfinite(size.most),
            "a finite size between its bounds");
    const std::string written = force::to_json(e, read.known_mass);
    const force::Line again = force::from_json(written, "again", two_joints(), before);
    require(force::to_json(again.estimate, again.known_mass) == written, "the same force comes back");
    before = e.time;
  }
}

void contacts(std::string_view bytes) {
  static const Path file = folder() / "contacts.csv";
  put(file, bytes);
  pipeline::read_contacts(file);
}

}  // namespace chainsplat::fuzz
