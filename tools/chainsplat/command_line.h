// command_line.h - commands and their options. This is CLI11 without its templates, which took half of the time that a
// small file of the program needs to compile (design.md, 'Compile time').
#pragma once
#include <functional>
#include <string>
#include <vector>

namespace CLI {
class App;
class Option;
}  // namespace CLI

namespace chainsplat::tools {

// An option or argument of a command. Copies mean the same option.
class Option {
 public:
  explicit Option(CLI::Option* option) : option_(option) {}
  Option& required();
  Option& type_name(const std::string& name);  // what it takes, as --help shows it
  Option& shows_default();                     // in --help, beside what it takes
  // What its value may be.
  Option& in_range(int least, int most);
  Option& in_range(double least, double most);
  Option& positive();
  Option& not_negative();
  Option& one_of(const std::vector<std::string>& words);
  // Of an option with several values: what stands between them, and how many there are. `one_each`: a single one where
  // the option is named; it may be named again.
  Option& delimiter(char letter);
  Option& expected(int count);
  Option& expected(int least, int most);
  Option& one_each();
  Option& excludes(const Option& other);
  Option& excludes(const std::string& name);
  Option& needs(const Option& other);

 private:
  CLI::Option* option_;
};

// The program or one of its commands. Copies mean the same command.
class Command {
 public:
  explicit Command(CLI::App* app) : app_(app) {}
  Command add_command(const std::string& name, const std::string& help);
  // `name`: "-o,--output", or "RUN" for an argument. `into` is what it changes where it is given; T: std::string, Path,
  // int, double, std::uint64_t, or a vector of strings or doubles.
  template <class T>
  Option add_option(const std::string& name, T& into, const std::string& help);
  Option add_flag(const std::string& name, bool& into, const std::string& help);
  void callback(std::function<void()> named);  // called where the command was named, when all options are read

 private:
  CLI::App* app_;
};

}  // namespace chainsplat::tools
