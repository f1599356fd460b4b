// src/importing/table.h - a table of numbers with named columns, whatever program wrote it: CSV with commas,
// semicolons, tabs or spaces, names with units.
#pragma once
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "chainsplat/core.h"

namespace chainsplat::importing {

struct Table {
  Path file;
  std::vector<std::string> names;  // of the columns; "1", "2", ... where the file has none
  bool named = false;
  std::shared_ptr<const std::string> text;  // the lines refer to it
  std::vector<core::TableLine> lines;       // below the names
  char separator = ',';                     // ' ': any number of spaces and tabs
  bool decimal_comma = false;
};

// Lines that begin with '#' or '%' are comments, but for a last one before the numbers that names the columns.
Table read_table(const Path& file);
// The numbers of one column, one per line. Throws InputError that names line and column for any other cell.
std::vector<double> column(const Table& table, std::size_t index);
std::optional<std::size_t> column_named(const Table& table, const std::string& name);  // whatever its case

// A column's name in parts: what it measures, and its unit.
struct ColumnName {
  std::vector<std::string> words;  // of the name without the unit
  std::string unit;                // m, cm, mm, s, ms, us, ns, deg, rad; empty: not said
};
ColumnName parse_column(const std::string& name);

// What a number in `unit` is in m, s or rad; 0 for an unknown unit.
double unit_scale(const std::string& unit);
// The unit in which these are plausible as stamps, by their size alone: Unix times in s, ms, us or ns; s where they
// are not Unix times.
std::string stamp_unit(const std::vector<double>& stamps);

// The column of a table that holds the time, by its name.
std::optional<std::size_t> time_column(const Table& table);
// The times of a table in s, from one column or from seconds and nanoseconds in two. `note`: how they were read.
std::vector<double> times_of(const Table& table, std::size_t index, const std::string& unit, std::string& note);

}  // namespace chainsplat::importing
