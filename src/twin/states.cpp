// States and centerlines as CSV.
#include <algorithm>

#include "chainsplat/twin.h"

namespace chainsplat::twin {

namespace {

void append_number(std::string& text, double value) { text.append(1, ',').append(core::exact(value)); }

std::string header(int angles, bool with_rates) {
  std::string text = "time";
  for (int k = 1; k <= angles; ++k) text += ",theta_" + std::to_string(k);
  for (int k = 1; with_rates && k <= angles; ++k) text += ",thetadot_" + std::to_string(k);
  return text;
}

}  // namespace

std::string states_csv(const chain::States& states) {
  const bool with_rates = !states.thetadot.empty();
  CHAINSPLAT_CHECK(states.theta.size() == states.time.size(), std::to_string(states.theta.size()));
  CHAINSPLAT_CHECK(!with_rates || states.thetadot.size() == states.time.size(), std::to_string(states.thetadot.size()));
  std::string text = header(states.theta.empty() ? 0 : static_cast<int>(states.theta[0].size()), with_rates) + "\n";
  for (std::size_t i = 0; i < states.time.size(); ++i) {
    text += core::exact(states.time[i]);
    for (const double angle : states.theta[i]) append_number(text, angle);
    if (with_rates)
      for (const double rate : states.thetadot[i]) append_number(text, rate);
    text += '\n';
  }
  return text;
}

chain::States read_states(const Path& file, int angles) {
  const std::string text = core::read_file(file);
  const std::string form = "write '" + header(angles, true) + "' (the second half may be missing)";
  chain::States states;
  std::size_t columns = 0;
  for (const core::TableLine& line : core::table_lines(text)) {
    const auto fail = [&](const std::string& what, const std::string& mend) {
      throw InputError(file.string() + ":" + std::to_string(line.number), what, mend);
    };
    if (columns == 0) {
      columns = static_cast<std::size_t>(std::count(line.text.begin(), line.text.end(), ',')) + 1;
      if (line.text != header(angles, true) && line.text != header(angles, false)) {
        const bool other = line.text == header(static_cast<int>(columns) - 1, false) ||
                           (columns % 2 == 1 && line.text == header(static_cast<int>(columns) / 2, true));
        if (other)
          fail("is not of this chain, which has " + std::to_string(angles) + " angles",
               "take the states of the same twin");
        fail("is not the header of states", form);
      }
      continue;
    }
    const std::vector<double> numbers = core::table_numbers(file, line, columns, "mend the line or remove it");
    if (!states.time.empty() && !(numbers[0] > states.time.back()))
      fail("its time does not come after the one before it", "sort the rows by time");
    states.time.push_back(numbers[0]);
    states.theta.emplace_back(Eigen::Map<const math::VectorX>(numbers.data() + 1, angles));
    if (columns > 1 + static_cast<std::size_t>(angles))
      states.thetadot.emplace_back(Eigen::Map<const math::VectorX>(numbers.data() + 1 + angles, angles));
  }
  if (states.time.empty()) throw InputError(file.string(), "no state in it", form + " and a row a time");
  return states;
}

std::string centerline_csv(const chain::Chain& chain, const chain::States& states, const trajectory::Trajectory& base) {
  std::vector<math::Pose> poses;
  for (const double time : states.time) poses.push_back(base.pose(time));
  return centerline_csv(chain, states, poses);
}

std::string centerline_csv(const chain::Chain& chain, const chain::States& states, std::span<const math::Pose> base) {
  std::string text = "time";
  for (int i = 0; i <= chain.links(); ++i) {
    const std::string number = std::to_string(i);
    text += ",x_" + number + ",y_" + number + ",z_" + number;
  }
  text += '\n';
  for (std::size_t i = 0; i < states.time.size(); ++i) {
    const math::MatrixX nodes = chain::nodes(chain, chain::link_motions(chain, states.theta[i], base[i]));
    text += core::exact(states.time[i]);
    for (const double coordinate : nodes.reshaped()) append_number(text, coordinate);
    text += '\n';
  }
  return text;
}

}  // namespace chainsplat::twin
