#include <algorithm>
#include <cmath>
#include <cstdio>
#include <nlohmann/json.hpp>

#include "chainsplat/calibration.h"
#include "chainsplat/json.h"
#include "chainsplat/text.h"
#include "tags.h"

namespace chainsplat::calibration {

using Json = nlohmann::ordered_json;

namespace {

constexpr const char* kFormat = "chainsplat-board/1";
constexpr double kSmallestTag = 1e-3, kLargestTag = 10.0;  // m
constexpr double kRuler = 0.1;                             // m

std::string mm(double meters) {
  char text[32];
  std::snprintf(text, sizeof text, "%.3f", 1e3 * meters);
  return text;
}

}  // namespace

math::Vector3 Board::corner(int id, int index) const {
  const int n = id - first_id, column = n % columns, row = n / columns;
  const double pitch = tag_size + spacing;
  const double x = (column - 0.5 * (columns - 1)) * pitch, y = (0.5 * (rows - 1) - row) * pitch;
  const double right = index == 1 || index == 2 ? 0.5 : -0.5, up = index >= 2 ? 0.5 : -0.5;
  return {x + right * tag_size, y + up * tag_size, 0.0};
}

void Board::check() const {
  const auto refuse = [](const char* field, const std::string& what, const std::string& mend) {
    throw InputError(std::string("`") + field + "`", what, mend);
  };
  if (columns < 1) refuse("columns", "is " + std::to_string(columns), "give 1 or more");
  if (rows < 1) refuse("rows", "is " + std::to_string(rows), "give 1 or more");
  if (!(tag_size >= kSmallestTag && tag_size <= kLargestTag))
    refuse("tag_size", core::brief(tag_size) + " m is no size of a tag", "give meters, from 0.001 to 10");
  if (!(spacing >= tag_size / kCells && spacing <= kLargestTag))
    refuse("spacing", core::brief(spacing) + " m is too little white about a tag of " + core::brief(tag_size) + " m",
           "give at least an eighth of the tag");
  const int most = tags_in_family();
  if (columns > most || rows > most || first_id < 0 || first_id > most - static_cast<long>(columns) * rows)
    refuse("first_id",
           std::to_string(columns) + " x " + std::to_string(rows) + " tags from " + std::to_string(first_id) +
               " on are more than there are",
           "tag36h11 has the tags 0 to " + std::to_string(most - 1));
}

Board read_board(const Path& file) {
  const std::string where = file.string();
  const Json json = core::parse_json_or_discard(core::read_file(file));
  if (json.is_discarded() || !json.is_object())
    throw InputError(where, "is no board", "write one: chainsplat calibrate --board-svg board.svg");
  Board board;
  std::vector<std::string> missing{"format", "family", "columns", "rows", "tag_size", "spacing", "first_id"};
  const std::string known = "format, family, columns, rows, tag_size, spacing, first_id";
  for (const auto& item : json.items()) {
    const std::string& key = item.key();
    const Json& value = item.value();
    const auto refuse = [&](const std::string& what, const std::string& mend) {
      throw InputError(where + ": " + key, what, mend);
    };
    const auto whole = [&](int& into) {
      if (!value.is_number_integer() || value.get<double>() < 0 || value.get<double>() > 1e6)
        refuse(value.dump() + " is no whole number", "write one from 0 on");
      into = value.get<int>();
    };
    const auto length = [&](double& into) {
      if (!value.is_number()) refuse(value.dump() + " is no number", "write meters");
      into = value.get<double>();
    };
    if (std::find(missing.begin(), missing.end(), key) == missing.end())
      throw InputError(where, "has the unknown key '" + key + "'", "known are " + known);
    missing.erase(std::find(missing.begin(), missing.end(), key));
    if (key == "format" && value != kFormat) refuse("is not " + std::string(kFormat), "write a board with --board-svg");
    if (key == "family" && value != "tag36h11") refuse(value.dump() + " is not supported", "print tags of tag36h11");
    if (key == "columns") whole(board.columns);
    if (key == "rows") whole(board.rows);
    if (key == "first_id") whole(board.first_id);
    if (key == "tag_size") length(board.tag_size);
    if (key == "spacing") length(board.spacing);
  }
  if (!missing.empty()) throw InputError(where, "has no key '" + missing[0] + "'", "a board has " + known);
  try {
    board.check();
  } catch (const InputError& error) {  // the field is a key here
    throw InputError(where + ": " + error.where.substr(1, error.where.size() - 2), error.problem, error.mend);
  }
  return board;
}

std::string write_board(const Board& board) {
  const Json json{{"format", kFormat},         {"family", "tag36h11"},       {"columns", board.columns},
                  {"rows", board.rows},        {"tag_size", board.tag_size}, {"spacing", board.spacing},
                  {"first_id", board.first_id}};
  return json.dump(1) + "\n";
}

std::string board_svg(const Board& board) {
  board.check();
  // a margin of white as between tags, a strip for ruler and text below
  const double pitch = board.tag_size + board.spacing, margin = std::max(board.spacing, 0.005);
  const double left = margin, top = margin, wide = board.columns * pitch - board.spacing;
  const double width = std::max(wide, kRuler) + 2 * margin, below = top + board.rows * pitch - board.spacing + margin;
  const double height = below + 0.016;
  std::string svg = "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"" + mm(width) + "mm\" height=\"" + mm(height) +
                    "mm\" viewBox=\"0 0 " + mm(width) + " " + mm(height) + "\">\n" +
                    "<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n";
  const auto rectangle = [&](double x, double y, double w, double h) {
    svg += "M" + mm(x) + " " + mm(y) + "h" + mm(w) + "v" + mm(h) + "h" + mm(-w) + "z";
  };
  const double cell = board.tag_size / kCells;
  for (int n = 0; n < board.tags(); ++n) {
    const int row = n / board.columns, column = n % board.columns;
    const double x0 = left + column * pitch, y0 = top + row * pitch;
    const auto black = black_cells(board.first_id + n);
    svg += "<path id=\"tag" + std::to_string(board.first_id + n) + "\" d=\"";
    for (int y = 0; y < kCells; ++y)
      for (int x = 0; x < kCells; ++x) {  // runs of black, drawn once
        if (!black[y * kCells + x]) continue;
        int run = 1;
        while (x + run < kCells && black[y * kCells + x + run]) ++run;
        rectangle(x0 + x * cell, y0 + y * cell, run * cell, cell);
        x += run;
      }
    svg += "\"/>\n";
  }
  // the ruler
  svg += "<path id=\"ruler\" d=\"";
  constexpr double kThin = 0.0002;
  for (int tick = 0; tick <= 100; ++tick)
    rectangle(left + 1e-3 * tick - 0.5 * kThin, below, kThin, tick % 10 == 0 ? 0.005 : tick % 5 == 0 ? 0.0035 : 0.0025);
  rectangle(left, below, kRuler, kThin);
  char text[300];
  std::snprintf(text, sizeof text,
                "tag36h11 %d to %d, %d x %d, edge of a black square %s mm, between squares %s mm. The ruler is 100 mm: "
                "print at 100 %%, then measure.",
                board.first_id, board.first_id + board.tags() - 1, board.columns, board.rows,
                core::brief(1e3 * board.tag_size).c_str(), core::brief(1e3 * board.spacing).c_str());
  svg += "\"/>\n<text x=\"" + mm(left) + "\" y=\"" + mm(below + 0.009) +
         "\" font-family=\"sans-serif\" font-size=\"2.5\">" + text + "</text>\n</svg>\n";
  return svg;
}

}  // namespace chainsplat::calibration
