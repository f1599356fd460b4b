#include "help.h"

#include <CLI/CLI.hpp>
#include <cctype>
#include <sstream>

namespace chainsplat::tools {

namespace {

constexpr std::size_t kWidth = 80, kColumn = 26;  // of a terminal, and where descriptions begin

// 'newton: outlines, ...': a short name without spaces and a colon.
bool is_item(const std::string& line) {
  const std::size_t colon = line.find(": ");
  if (colon == std::string::npos || colon == 0) return false;
  for (std::size_t i = 0; i < colon; ++i)
    if (!std::isalnum(static_cast<unsigned char>(line[i])) && line[i] != '-') return false;
  return true;
}

std::string entry(const std::string& head, const std::string& text) {
  std::string out = wrapped("  " + head, kWidth, 4);
  const std::size_t last = out.size() - (out.rfind('\n') == std::string::npos ? 0 : out.rfind('\n') + 1);
  out += last + 2 > kColumn ? "\n" + std::string(kColumn, ' ') : std::string(kColumn - last, ' ');
  return out + wrapped(text, kWidth - kColumn, kColumn) + "\n";
}

}  // namespace

std::string wrapped(const std::string& text, std::size_t width, std::size_t indent) {
  std::string out;
  std::istringstream lines(text);
  std::size_t column = 0;
  for (std::string line; std::getline(lines, line);) {
    const std::size_t margin = line.find_first_not_of(' ') == std::string::npos ? 0 : line.find_first_not_of(' ');
    if (column > 0 && is_item(line)) {
      out += "\n" + std::string(indent, ' ');
      column = 0;
    } else if (column == 0) {
      out += std::string(margin, ' ');
      column = margin;
    }
    std::istringstream words(line);
    for (std::string word; words >> word;) {
      const bool first = out.empty() || out.back() == ' ';
      if (!first && column + 1 + word.size() > width) {
        out += "\n" + std::string(indent, ' ');
        column = 0;
      } else if (!first) {
        out += ' ';
        ++column;
      }
      out += word;
      column += word.size();
    }
  }
  return out;
}

std::string Help::make_option(const CLI::Option* option, bool positional) const {
  return entry(make_option_name(option, positional) + make_option_opts(option), make_option_desc(option));
}

std::string Help::make_subcommand(const CLI::App* command) const {
  return entry(command->get_display_name(true), command->get_description());
}

std::string Help::make_description(const CLI::App* app) const {
  return wrapped(app->get_description(), kWidth, 0) + "\n";
}

std::string Help::make_footer(const CLI::App* app) const {
  std::string out;
  std::istringstream paragraphs(app->get_footer());
  for (std::string paragraph; std::getline(paragraphs, paragraph);) out += wrapped(paragraph, kWidth, 0) + "\n";
  return out;
}

}  // namespace chainsplat::tools
