// describe.cpp - the command line described by itself: manual pages, completions for shells, and what may have been
// meant.
#include <CLI/CLI.hpp>
#include <algorithm>
#include <iostream>
#include <memory>
#include <numeric>

#include "cli.h"

namespace chainsplat::tools {

namespace {

// An option or argument as the texts need it.
struct Described {
  std::vector<std::string> names;  // with their dashes; an argument's alone
  std::string value, text;         // what it takes, empty for a flag; what it does, one line
  bool argument = false;
};

std::string one_line(std::string text) {
  std::replace(text.begin(), text.end(), '\n', ' ');
  return text;
}

std::vector<Described> options_of(const CLI::App& command) {
  std::vector<Described> out;
  for (const CLI::Option* option : command.get_options()) {
    Described each;
    each.argument = !option->nonpositional();
    if (each.argument) each.names.push_back(option->get_name());
    for (const std::string& name : option->get_snames()) each.names.push_back("-" + name);
    for (const std::string& name : option->get_lnames()) each.names.push_back("--" + name);
    if (option->get_expected_max() > 0 && option->get_items_expected_max() > 0 && !each.argument)
      each.value = option->get_type_name();
    each.text = one_line(option->get_description());
    out.push_back(std::move(each));
  }
  return out;
}

std::vector<const CLI::App*> commands_of(const CLI::App& app) {
  std::vector<const CLI::App*> out;
  for (const CLI::App* command : app.get_subcommands([](const CLI::App* each) { return !each->get_group().empty(); }))
    out.push_back(command);
  return out;
}

std::string joined(const std::vector<std::string>& words, const std::string& between) {
  std::string out;
  for (const std::string& word : words) out += (out.empty() ? "" : between) + word;
  return out;
}

// --- manual ------------------------------------------------------------------------------------------------------

// Text for troff: backslashes and dashes are its own, and so is a line that begins with a dot or an apostrophe.
std::string roff(const std::string& text) {
  std::string out;
  for (const char letter : text) {
    if ((letter == '.' || letter == '\'') && (out.empty() || out.back() == '\n')) out += "\\&";
    out += letter == '\\' ? "\\e" : letter == '-' ? "\\-" : std::string(1, letter);
  }
  return out;
}

std::string manual_options(const CLI::App& command) {
  std::string out;
  for (const Described& option : options_of(command))
    out += ".TP\n\\fB" + roff(joined(option.names, ", ")) + "\\fR" +
           (option.value.empty() ? "" : " \\fI" + roff(option.value) + "\\fR") + "\n" + roff(option.text) + "\n";
  return out;
}

std::string manual(const CLI::App& app, const std::string& name) {
  const CLI::App* command = name.empty() ? &app : nullptr;
  for (const CLI::App* each : commands_of(app))
    if (each->get_name() == name) command = each;
  if (!command) throw InputError(name, "is not a command", "see 'chainsplat --help' for those there are");
  const std::string title = name.empty() ? "chainsplat" : "chainsplat-" + name;
  std::string out = ".TH " + title + " 1 \"\" \"chainsplat " CHAINSPLAT_VERSION "\" \"User Commands\"\n.SH NAME\n" +
                    roff(title) + " \\- " + roff(one_line(command->get_description())) +
                    "\n.SH SYNOPSIS\n.B chainsplat" + (name.empty() ? "" : " " + roff(name)) + "\n";
  for (const Described& option : options_of(*command))
    if (option.argument) out += ".I " + roff(option.names[0]) + "\n";
  out += name.empty() ? ".I COMMAND\n[options]\n.SH COMMANDS\n" : "[options]\n";
  if (name.empty())
    for (const CLI::App* each : commands_of(app))
      out += ".TP\n\\fB" + roff(each->get_name()) + "\\fR\n" + roff(one_line(each->get_description())) + "\n";
  out += ".SH OPTIONS\n" + manual_options(*command);
  if (!name.empty()) out += ".PP\nGlobal options: see\n.BR chainsplat (1).\n";
  return out +
         ".SH EXIT STATUS\n0 done; 1 the work failed, what exists is kept; 2 the request or its input is wrong,\n"
         "nothing written; 130, 143 interrupted; 141 nobody reads the output any more.\n";
}

// --- completions -------------------------------------------------------------------------------------------------

std::vector<std::string> words_of(const CLI::App& command) {
  std::vector<std::string> out;
  for (const Described& option : options_of(command))
    if (!option.argument) out.insert(out.end(), option.names.begin(), option.names.end());
  return out;
}

std::string bash_completions(const CLI::App& app) {
  std::string names, cases;
  for (const CLI::App* command : commands_of(app)) {
    names += (names.empty() ? "" : " ") + command->get_name();
    cases += "    " + command->get_name() + ") options=\"$options " + joined(words_of(*command), " ") + "\" ;;\n";
  }
  return "# bash completions of chainsplat: source this file\n_chainsplat() {\n  local word=${COMP_WORDS[COMP_CWORD]} "
         "command= each\n  local options=\"" +
         joined(words_of(app), " ") + "\" commands=\"" + names +
         "\"\n  for each in \"${COMP_WORDS[@]:1:COMP_CWORD-1}\"; do\n"
         "    [[ \" $commands \" == *\" $each \"* ]] && command=$each && break\n  done\n  case $command in\n" +
         cases +
         "  esac\n  if [[ $word == -* ]]; then\n    COMPREPLY=($(compgen -W \"$options\" -- \"$word\"))\n"
         "  elif [[ -z $command ]]; then\n    COMPREPLY=($(compgen -W \"$commands\" -- \"$word\"))\n  else\n"
         "    COMPREPLY=($(compgen -f -- \"$word\"))\n  fi\n}\ncomplete -o filenames -F _chainsplat chainsplat\n";
}

std::string zsh_completions(const CLI::App& app) {
  std::string list, cases;
  for (const CLI::App* command : commands_of(app)) {
    list += "    " + shell_quoted(command->get_name() + ":" + one_line(command->get_description())) + "\n";
    cases += "    " + command->get_name() + ") _arguments '*:file:_files'";
    for (const CLI::App* from : {command, &app})
      for (const Described& option : options_of(*from))
        for (const std::string& name : option.names)
          if (!option.argument) {
            const std::string text = shell_quoted(option.text, "[]:\\");
            cases += " \\\n      " + name + "'['" + text + "']'" + (option.value.empty() ? "" : "':value:_files'");
          }
    cases += " ;;\n";
  }
  return "#compdef chainsplat\n_chainsplat() {\n  local -a commands\n  commands=(\n" + list +
         "  )\n  if (( CURRENT == 2 )); then\n    _describe command commands\n    return\n  fi\n  local "
         "command=$words[2]\n"
         "  case $command in\n" +
         cases + "  esac\n}\ncompdef _chainsplat chainsplat\n";
}

std::string fish_completions(const CLI::App& app) {
  std::string out = "# fish completions of chainsplat\n";
  const auto options = [&](const CLI::App& command, const std::string& condition) {
    for (const Described& option : options_of(command)) {
      if (option.argument) continue;
      out += "complete -c chainsplat" + condition;
      for (const std::string& name : option.names)
        out += name.starts_with("--") ? " -l " + name.substr(2) : " -s " + name.substr(1);
      out += (option.value.empty() ? "" : " -r") + std::string(" -d ") + shell_quoted(option.text) + "\n";
    }
  };
  options(app, "");
  for (const CLI::App* command : commands_of(app)) {
    out += "complete -c chainsplat -f -n __fish_use_subcommand -a " + command->get_name() + " -d " +
           shell_quoted(one_line(command->get_description())) + "\n";
    options(*command, " -n '__fish_seen_subcommand_from " + command->get_name() + "'");
  }
  return out;
}

// How many letters one has to change, add or leave out to make the one of the other.
std::size_t distance(const std::string& a, const std::string& b) {
  std::vector<std::size_t> row(b.size() + 1);
  std::iota(row.begin(), row.end(), std::size_t{0});
  for (std::size_t i = 1; i <= a.size(); ++i) {
    std::size_t corner = row[0];
    row[0] = i;
    for (std::size_t j = 1; j <= b.size(); ++j) {
      const std::size_t above = row[j];
      row[j] = std::min({row[j] + 1, row[j - 1] + 1, corner + (a[i - 1] == b[j - 1] ? 0 : 1)});
      corner = above;
    }
  }
  return row.back();
}

}  // namespace

std::string meant(const CLI::App& app, const std::string& word) {
  std::vector<std::string> known;
  if (word.starts_with("-")) {
    for (const CLI::App* command : app.get_subcommands()) known = words_of(*command);
    const std::vector<std::string> global = words_of(app);
    known.insert(known.end(), global.begin(), global.end());
  } else {
    for (const CLI::App* command : commands_of(app)) known.push_back(command->get_name());
  }
  const std::string name = word.substr(0, word.find('='));
  std::string best;
  std::size_t least = 1 + name.size() / 3;  // a third of the letters may be wrong, and one in any case
  for (const std::string& each : known)
    if (const std::size_t far = distance(name, each); far <= least && far < std::max(name.size(), each.size()) - 1) {
      if (far == least && !best.empty()) continue;
      best = each, least = far;
    }
  return best;
}

void add_describe_commands(CLI::App& app, Job& job) {
  CLI::App* completer = app.add_subcommand("completions", "Print completions of commands and options for a shell");
  auto shell = std::make_shared<std::string>();
  completer->add_option("SHELL", *shell, "bash, zsh or fish")
      ->required()
      ->check(CLI::IsMember({"bash", "zsh", "fish"}));
  completer->callback([&app, &job, shell] {
    job = [&app, shell] {
      std::cout << (*shell == "bash"  ? bash_completions(app)
                    : *shell == "zsh" ? zsh_completions(app)
                                      : fish_completions(app));
    };
  });
  CLI::App* writer = app.add_subcommand("manual", "Print a manual page, for 'man -l -'");
  auto name = std::make_shared<std::string>();
  writer->add_option("COMMAND", *name, "Of this command (default: of the program)");
  writer->callback([&app, &job, name] { job = [&app, name] { std::cout << manual(app, *name); }; });
}

}  // namespace chainsplat::tools
