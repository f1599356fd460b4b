// help.h - what --help prints, in lines that fit a terminal of 80 columns.
#pragma once
#include <CLI/Formatter.hpp>
#include <string>

namespace chainsplat::tools {

// Words in lines of at most `width` columns, of which all but the first begin with `indent` spaces. A line feed in
// `text` begins a new line only before an item, 'newton: ...'; elsewhere it is a space.
std::string wrapped(const std::string& text, std::size_t width, std::size_t indent);

// CLI11's own lines, wrapped.
class Help : public CLI::Formatter {
 public:
  std::string make_option(const CLI::Option* option, bool positional) const override;
  std::string make_subcommand(const CLI::App* command) const override;
  std::string make_description(const CLI::App* app) const override;
  std::string make_footer(const CLI::App* app) const override;
};

}  // namespace chainsplat::tools
