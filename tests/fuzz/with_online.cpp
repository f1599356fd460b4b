// Fuzzes the lines of `estimate` as `identify --online` reads them.
#include "readers.h"
#include "chainsplat/adaptation.h"
#include "chainsplat/estimate_lines.h"

namespace chainsplat::fuzz {

void online(std::string_view bytes) {
  dynamics::Estimates known;
  known.names = {"log_stiffness"};
  known.values = {-7.0};
  known.standard_errors = {0.1};
  known.covariance = math::MatrixX::Constant(1, 1, 0.01);
  const auto line = estimation::read_estimate_line(std::string(bytes), "line", two_joints().angles(), -1e300);
  if (!line) return;
  const adaptation::Observation seen{line->time, line->theta, line->thetadot, line->sigma};
  adaptation::ParameterFilter filter(two_joints(), parameters_of_two_joints(), known, {});
  filter.observe(seen, [](double) { return dynamics::at_rest({}); });
}

}  // namespace chainsplat::fuzz
