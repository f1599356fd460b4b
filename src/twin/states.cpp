// States and centerlines as CSV.
#include <optional>
#include <string_view>

#include "chainsplat/twin.h"

namespace chainsplat::twin {

namespace {

void append_number(std::string& text, double value) { text.append(1, ',').append(core::exact(value)); }

// A state's columns after its time.
struct Columns {
  int angles = 0;
  bool rates = false;
  int rolls = 0;  // links, or 0

  std::size_t count() const { return static_cast<std::size_t>(angles) * (rates ? 2 : 1) + rolls; }
};

std::string header(const Columns& columns) {
  std::string text = "time";
  for (int k = 1; k <= columns.angles; ++k) text += ",theta_" + std::to_string(k);
  for (int k = 1; columns.rates && k <= columns.angles; ++k) text += ",thetadot_" + std::to_string(k);
  for (int j = 0; j < columns.rolls; ++j) text += ",roll_" + std::to_string(j);
  return text;
}

// Which of the forms that states have this head line is; none: of none for such a number of angles and links.
std::optional<Columns> columns_of(std::string_view line, int angles, int links) {
  for (const bool rates : {true, false})
    for (const int rolls : {0, links})
      if (const Columns columns{angles, rates, rolls}; line == header(columns)) return columns;
  return std::nullopt;
}

// Is it the head line of another chain's states?
bool of_another_chain(std::string_view line) {
  const auto starting = [&](std::string_view name) {
    int count = 0;
    for (std::size_t at = line.find(name); at != line.npos; at = line.find(name, at + 1)) ++count;
    return count;
  };
  const int angles = starting(",theta_");
  return angles > 0 && columns_of(line, angles, starting(",roll_")).has_value();
}

}  // namespace

std::string states_csv(const chain::States& states) {
  const std::size_t count = states.time.size();
  CHAINSPLAT_CHECK(states.theta.size() == count, std::to_string(states.theta.size()));
  CHAINSPLAT_CHECK(states.thetadot.empty() || states.thetadot.size() == count, std::to_string(states.thetadot.size()));
  CHAINSPLAT_CHECK(states.roll.empty() || states.roll.size() == count, std::to_string(states.roll.size()));
  Columns columns;
  columns.angles = states.theta.empty() ? 0 : static_cast<int>(states.theta[0].size());
  columns.rates = !states.thetadot.empty();
  columns.rolls = states.roll.empty() ? 0 : static_cast<int>(states.roll[0].size());
  std::string text = header(columns) + "\n";
  for (std::size_t i = 0; i < count; ++i) {
    text += core::exact(states.time[i]);
    for (const double angle : states.theta[i]) append_number(text, angle);
    if (columns.rates)
      for (const double rate : states.thetadot[i]) append_number(text, rate);
    if (columns.rolls > 0)
      for (const double roll : states.roll[i]) append_number(text, roll);
    text += '\n';
  }
  return text;
}

chain::States read_states(const Path& file, const chain::Chain& chain) {
  const int angles = chain.angles(), links = chain.links();
  const std::string text = core::read_file(file);
  const std::string form = "write '" + header({angles, true, links}) + "' (thetadot and roll may be missing)";
  chain::States states;
  std::optional<Columns> columns;
  for (const core::TableLine& line : core::table_lines(text)) {
    const auto fail = [&](const std::string& what, const std::string& mend) {
      throw InputError(file.string() + ":" + std::to_string(line.number), what, mend);
    };
    if (!columns) {
      columns = columns_of(line.text, angles, links);
      if (columns) continue;
      if (of_another_chain(line.text))
        fail("is not of this chain, which has " + std::to_string(angles) + " angles and " + std::to_string(links) +
                 " links",
             "take the states of the same twin");
      fail("is not the header of states", form);
    }
    const std::vector<double> numbers =
        core::table_numbers(file, line, 1 + columns->count(), "mend the line or remove it");
    if (!states.time.empty() && !(numbers[0] > states.time.back()))
      fail("its time does not come after the one before it", "sort the rows by time");
    states.time.push_back(numbers[0]);
    const double* from = numbers.data() + 1;
    const auto next = [&](std::vector<math::VectorX>& rows, int size) {
      rows.emplace_back(Eigen::Map<const math::VectorX>(from, size));
      from += size;
    };
    next(states.theta, angles);
    if (columns->rates) next(states.thetadot, angles);
    if (columns->rolls > 0) next(states.roll, links);
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
