#include "table.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <ctime>

#include "chainsplat/media.h"
#include "document.h"

namespace chainsplat::importing {

namespace {

constexpr double kUnixSeconds = 1e8;  // 1973; no recording is timed from a start so long ago by another clock

// The cells of a line; quotes about a cell are dropped.
std::vector<std::string_view> cells_of(std::string_view line, char separator) {
  std::vector<std::string_view> cells;
  const auto add = [&](std::string_view cell) {
    while (!cell.empty() && (cell.front() == ' ' || cell.front() == '\t')) cell.remove_prefix(1);
    while (!cell.empty() && (cell.back() == ' ' || cell.back() == '\t' || cell.back() == '\r')) cell.remove_suffix(1);
    if (cell.size() >= 2 && cell.front() == '"' && cell.back() == '"') cell = cell.substr(1, cell.size() - 2);
    cells.push_back(cell);
  };
  if (separator != ' ') {
    for (std::size_t begin = 0; begin <= line.size();) {
      const std::size_t end = std::min(line.find(separator, begin), line.size());
      add(line.substr(begin, end - begin));
      begin = end + 1;
    }
    return cells;
  }
  for (std::size_t at = 0; at < line.size();) {
    const std::size_t from = line.find_first_not_of(" \t\r", at);
    if (from == std::string_view::npos) break;
    at = std::min(line.find_first_of(" \t\r", from), line.size());
    add(line.substr(from, at - from));
  }
  return cells;
}

char separator_of(std::string_view line) {
  for (const char c : {';', '\t', ','})
    if (line.find(c) != std::string_view::npos) return c;
  return ' ';
}

// In tables with semicolons some languages write 0,5 for 0.5.
std::optional<double> cell_number(std::string_view cell, bool decimal_comma) {
  if (!decimal_comma) return number_of(cell);
  std::string text(cell);
  std::replace(text.begin(), text.end(), ',', '.');
  return number_of(text);
}

// '2026-11-22T14:05:09.25+01:00' (a space for the T, no zone for UTC) as Unix time, s.
std::optional<double> date_time(std::string_view cell) {
  const std::string text(cell);
  std::tm parts{};
  int used = 0;
  if (std::sscanf(text.c_str(), "%4d-%2d-%2d%*1[T ]%2d:%2d:%n", &parts.tm_year, &parts.tm_mon, &parts.tm_mday,
                  &parts.tm_hour, &parts.tm_min, &used) != 5 ||
      used == 0)
    return std::nullopt;
  parts.tm_year -= 1900, parts.tm_mon -= 1;
  std::string rest = text.substr(static_cast<std::size_t>(used));
  const std::size_t zone = rest.find_first_of("Z+-");
  double offset = 0.0;
  if (zone != std::string::npos && rest[zone] != 'Z') {
    int hours = 0, minutes = 0;
    if (std::sscanf(rest.c_str() + zone + 1, "%2d:%2d", &hours, &minutes) < 1) return std::nullopt;
    offset = (rest[zone] == '-' ? -1.0 : 1.0) * (3600.0 * hours + 60.0 * minutes);
  }
  const auto seconds = number_of(std::string_view(rest).substr(0, zone));
  if (!seconds) return std::nullopt;
  return static_cast<double>(timegm(&parts)) + *seconds - offset;
}

bool only_numbers(std::string_view line, char separator) {
  const std::vector<std::string_view> cells = cells_of(line, separator);
  return !cells.empty() && std::all_of(cells.begin(), cells.end(), [&](std::string_view cell) {
    return cell_number(cell, separator == ';').has_value() || date_time(cell).has_value() || lower(cell) == "nan";
  });
}

}  // namespace

Table read_table(const Path& file) {
  Table table;
  table.file = file;
  table.text = std::make_shared<const std::string>(core::read_file(file));
  std::string_view names;
  for (const core::TableLine& line : core::table_lines(*table.text)) {
    const std::size_t first = line.text.find_first_not_of(" \t");
    const bool comment = first != std::string_view::npos && (line.text[first] == '#' || line.text[first] == '%');
    if (comment) {
      // '%time,field.x' of rostopic and '# t x y z' name columns
      if (table.lines.empty()) names = line.text.substr(line.text[first] == '#' ? first + 1 : first);
      continue;
    }
    table.lines.push_back(line);
  }
  if (table.lines.empty()) throw InputError(file.string(), "has no line of numbers", "give the robot's log");
  const std::string_view first = table.lines.front().text;
  if (!only_numbers(first, separator_of(first))) {
    names = first;
    table.lines.erase(table.lines.begin());
    table.named = true;
  }
  if (table.lines.empty())
    throw InputError(file.string(), "has names of columns, but no line of numbers", "give the robot's log");
  table.separator = separator_of(table.lines.front().text);
  table.decimal_comma = table.separator == ';' && table.lines.front().text.find(',') != std::string_view::npos;
  const std::size_t columns = cells_of(table.lines.front().text, table.separator).size();
  std::vector<std::string_view> cells = cells_of(names, separator_of(names));
  if (cells.size() == columns)
    table.named = true;
  else if (table.named)
    throw InputError(file.string(),
                     "names " + std::to_string(cells.size()) + " columns, and the first line of numbers has " +
                         std::to_string(columns),
                     "write one name per column");
  for (std::size_t i = 0; i < columns; ++i)
    table.names.push_back(table.named ? std::string(cells[i]) : std::to_string(i + 1));
  return table;
}

std::vector<double> column(const Table& table, std::size_t index) {
  std::vector<double> values;
  values.reserve(table.lines.size());
  for (const core::TableLine& line : table.lines) {
    const std::vector<std::string_view> cells = cells_of(line.text, table.separator);
    const auto value = index < cells.size() ? cell_number(cells[index], table.decimal_comma) : std::nullopt;
    if (!value)
      throw InputError(table.file.string() + ":" + std::to_string(line.number),
                       "column '" + table.names[index] + "' is no number", "remove the line or fill it in");
    values.push_back(*value);
  }
  return values;
}

std::optional<std::size_t> column_named(const Table& table, const std::string& name) {
  for (std::size_t i = 0; i < table.names.size(); ++i)
    if (table.names[i] == name) return i;
  for (std::size_t i = 0; i < table.names.size(); ++i)
    if (lower(table.names[i]) == lower(name)) return i;
  return std::nullopt;
}

double unit_scale(const std::string& unit) {
  struct Unit {
    const char* name;
    double scale;
  };
  constexpr Unit kUnits[] = {{"m", 1.0},     {"meter", 1.0},  {"meters", 1.0}, {"cm", 1e-2},     {"mm", 1e-3},
                             {"s", 1.0},     {"sec", 1.0},    {"secs", 1.0},   {"seconds", 1.0}, {"ms", 1e-3},
                             {"msec", 1e-3}, {"us", 1e-6},    {"usec", 1e-6},  {"ns", 1e-9},     {"nsec", 1e-9},
                             {"rad", 1.0},   {"radians", 1.0}};
  if (unit == "deg" || unit == "degrees" || unit == "°") return 0.017453292519943295;
  for (const Unit& known : kUnits)
    if (unit == known.name) return known.scale;
  return 0.0;
}

ColumnName parse_column(const std::string& name) {
  ColumnName out;
  std::string rest = name;
  for (const auto& [open, close] : {std::pair('[', ']'), {'(', ')'}, {'<', '>'}}) {
    const std::size_t from = rest.find(open), to = rest.find(close, from);
    if (from == std::string::npos || to == std::string::npos) continue;
    const std::string inside = lower(rest.substr(from + 1, to - from - 1));
    if (unit_scale(inside) == 0.0) continue;
    out.unit = inside;
    rest = rest.substr(0, from) + rest.substr(to + 1);
  }
  out.words = words(rest);
  // a unit as the last word, but for names of one word: 's' alone and 'm' alone are names
  if (out.unit.empty() && out.words.size() > 1) {
    const std::string last = out.words.back();
    const bool stamp = last == "sec" || last == "secs" || last == "nsec" || last == "seconds";  // time parts of ROS
    if (unit_scale(last) != 0.0 && !stamp) {
      out.unit = last;
      out.words.pop_back();
    }
  }
  return out;
}

std::string stamp_unit(const std::vector<double>& stamps) {
  const double first = std::abs(stamps.front());
  for (const char* unit : {"ns", "us", "ms"})
    if (first * unit_scale(unit) > kUnixSeconds) return unit;
  return "s";
}

std::optional<std::size_t> time_column(const Table& table) {
  // the stamp of the message before the time it was written down
  std::optional<std::size_t> best;
  int rank = 0;
  for (std::size_t i = 0; i < table.names.size(); ++i) {
    const ColumnName name = parse_column(table.names[i]);
    if (name.words.empty()) continue;
    const std::string& last = name.words.back();
    const bool header = std::find(name.words.begin(), name.words.end(), "header") != name.words.end();
    int here = 0;
    if (last == "stamp" || last == "secs" || last == "sec") here = header ? 4 : 3;
    if (last == "timestamp" || last == "timestamps" || last == "time") here = header ? 4 : 3;
    if (last == "t" || last == "seconds" || last == "ts" || last == "clock") here = 2;
    if (here == 0 &&
        (name.words.front() == "time" || name.words.front() == "timestamp" || name.words.front() == "stamp"))
      here = 1;
    if (here > rank) rank = here, best = i;
  }
  return best;
}

std::vector<double> times_of(const Table& table, std::size_t index, const std::string& unit, std::string& note) {
  if (const std::vector<std::string_view> first = cells_of(table.lines.front().text, table.separator);
      index < first.size() && date_time(first[index])) {
    std::vector<double> times;
    for (const core::TableLine& line : table.lines) {
      const std::vector<std::string_view> cells = cells_of(line.text, table.separator);
      const auto time = index < cells.size() ? date_time(cells[index]) : std::nullopt;
      if (!time)
        throw InputError(table.file.string() + ":" + std::to_string(line.number),
                         "its time is no date and time like the others", "remove the line");
      times.push_back(*time);
    }
    note = "times: column '" + table.names[index] + "', dates as Unix time";
    return times;
  }
  std::vector<double> times = column(table, index);
  const std::string& name = table.names[index];
  const ColumnName parsed = parse_column(name);
  // ROS writes whole seconds and nanoseconds in two columns
  if (!parsed.words.empty() && (parsed.words.back() == "sec" || parsed.words.back() == "secs"))
    for (std::size_t i = 0; i < table.names.size(); ++i) {
      std::vector<std::string> other = parse_column(table.names[i]).words;
      if (other.empty() || i == index) continue;
      const std::string last = other.back();
      other.back() = parsed.words.back();
      if (other != parsed.words || (last != "nanosec" && last != "nsecs" && last != "nsec" && last != "nanosecs"))
        continue;
      const std::vector<double> parts = column(table, i);
      for (std::size_t k = 0; k < times.size(); ++k) times[k] += 1e-9 * parts[k];
      note = "times: columns '" + name + "' and '" + table.names[i] + "'";
      return times;
    }
  const std::string used = !unit.empty() ? unit : !parsed.unit.empty() ? parsed.unit : stamp_unit(times);
  for (double& time : times) time *= unit_scale(used);
  note = "times: column '" + name + "' in " + used +
         (!unit.empty()          ? ", as asked"
          : !parsed.unit.empty() ? ", by its name"
                                 : ", by their size");
  return times;
}

std::vector<double> read_stamps(const Path& file, const std::string& key, const std::string& unit, std::string& note) {
  const Table table = read_table(file);
  std::optional<std::size_t> index;
  if (!key.empty()) {
    index = column_named(table, key);
    if (!index) throw InputError(file.string(), "has no column '" + key + "'", "it has " + list_of(table.names));
  } else if (table.named) {
    index = time_column(table);
  }
  if (!index && (table.names.size() == 1 || !table.named)) index = 0;
  if (!index)
    throw InputError(file.string(), "no column is called like a time",
                     "name it with #COLUMN; it has " + list_of(table.names));
  return times_of(table, *index, unit, note);
}

}  // namespace chainsplat::importing
