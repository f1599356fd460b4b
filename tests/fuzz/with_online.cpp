// Fuzzes the lines of `estimate` as `identify --online` reads them.
#include "readers.h"
#include "tools/online.cpp"

namespace chainsplat::fuzz {

void online(std::string_view bytes) {
  dynamics::Estimates known;
  known.names = {"log_stiffness"};
  known.values = {-7.0};
  known.standard_errors = {0.1};
  known.covariance = math::MatrixX::Constant(1, 1, 0.01);
  adaptation::Observation observation;
#if __has_include("tools/estimate_lines.h")
  const auto line = tools::read_estimate_line(std::string(bytes), "line", two_joints().angles(), -1e300);
  if (!line) return;
  observation = {line->time, line->theta, line->thetadot, line->sigma};
#else
  if (!tools::read_line(std::string(bytes), "line", observation)) return;
#endif
  adaptation::ParameterFilter filter(two_joints(), parameters_of_two_joints(), known, {});
  filter.observe(observation, [](double) { return dynamics::at_rest({}); });
}

}  // namespace chainsplat::fuzz
