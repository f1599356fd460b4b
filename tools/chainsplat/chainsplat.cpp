// chainsplat.cpp - the program: global options, commands, and what becomes of an error.
#include <malloc.h>

#include <CLI/CLI.hpp>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <system_error>

#include "chainsplat/run_folder.h"
#include "cli.h"
#include "command_line.h"
#include "help.h"

using namespace chainsplat;

namespace {

constexpr int kDone = 0, kWorkFailed = 1, kWrongRequest = 2;

// Memory that short-lived threads have freed stays in their arenas: 0.8 MiB more a training in one process with glibc's
// eight a core, 0.1 MiB with one.
void keep_memory_together() {
#ifdef __GLIBC__
  mallopt(M_ARENA_MAX, 1);
#endif
}

// The one line that every failure ends with.
int fail(int code, const std::string& message) {
  std::string text = tools::with_options(message);
  for (char& letter : text)
    if (letter == '\n' || letter == '\r') letter = ' ';
  if (text.starts_with(": ")) text.insert(0, "''");  // an empty file name
  tools::end_progress();
  std::fprintf(stderr, "chainsplat: error: %s\n", core::printable(text).c_str());
  return code;
}

// "did you mean 'train'? ", empty where nothing is near.
std::string did_you_mean(const CLI::App& app, const std::string& word) {
  const std::string best = tools::meant(app, word);
  return best.empty() ? "" : "did you mean '" + best + "'? ";
}

std::string command_line_error(const CLI::App& app, const CLI::ParseError& error) {
  const auto chosen = app.get_subcommands();
  std::string what = error.what();
  while (!what.empty() && (what.back() == '.' || what.back() == '\n')) what.pop_back();
  if (chosen.empty()) {
    for (const std::string& word : app.remaining())
      if (word[0] != '-')
        return word + ": is not a command; " + did_you_mean(app, word) + "see 'chainsplat --help' for those there are";
    return "command line: " + what + "; see 'chainsplat --help'";
  }
  const std::string command = chosen.front()->get_name();
  if (const auto* extras = dynamic_cast<const CLI::ExtrasError*>(&error); extras)
    for (const std::string& word : app.remaining(true))
      if (word[0] == '-' && !tools::meant(app, word).empty())
        return "chainsplat " + command + ": " + word + ": is not an option; " + did_you_mean(app, word) +
               "see 'chainsplat " + command + " --help'";
  return "chainsplat " + command + ": " + what + "; see 'chainsplat " + command + " --help'";
}

// An empty name, as of a variable that a script has not set, would mean the folder one stands in, or nothing.
void refuse_empty_output(const CLI::App& app) {
  for (const CLI::App* command : app.get_subcommands()) {
    const CLI::Option* output = command->get_option_no_throw("--output");
    if (output && output->count() > 0 && output->as<std::string>().empty())
      throw InputError("--output", "is empty", "name the file or folder to write");
  }
}

int run(int argc, char** argv) {
  tools::Globals globals;
  tools::Job job;
  CLI::App app{
      "Turns videos of a moving rope into a twin: an open chain of screw joints that moves like the rope and carries\n"
      "Gaussians that look like it.",
      "chainsplat"};
  app.set_version_flag("--version", "chainsplat " CHAINSPLAT_VERSION, "Print the version and leave");
  app.require_subcommand(1);
  app.fallthrough();
  app.formatter(std::make_shared<tools::Help>());
  app.add_option("--device", globals.device,
                 "Vulkan device: its number or a part of its name (see doctor; environment: CHAINSPLAT_DEVICE)")
      ->type_name("N|NAME");
  app.add_option("--threads", globals.threads, "Host threads; 0: all cores. Results do not depend on it")
      ->check(CLI::Range(0, 4096))
      ->type_name("N");
  app.add_option("--seed", globals.seed, "Seed of the random numbers (default 0)")->type_name("N");
  app.add_flag("-q,--quiet", globals.quiet, "No progress and no messages; warnings, errors and results remain");
  app.add_flag("-v,--verbose", globals.verbose, "Say more: the device, seconds by stage");
  app.add_option("--log", globals.log, "Add a JSON record an interval: stage, iteration, loss, psnr, seconds")
      ->type_name("FILE.jsonl");
  app.add_flag("--no-progress", globals.no_progress, "No progress, but messages");
  app.add_flag("--json", globals.json, "Standard output is one JSON document and nothing else");
  const tools::Command program(&app);
  tools::add_training_commands(program, globals, job);
  tools::add_identify_command(program, globals, job);
  tools::add_motion_commands(program, globals, job);
  tools::add_result_commands(program, globals, job);
  tools::add_estimation_commands(program, globals, job);
  tools::add_force_commands(program, globals, job);
  tools::add_planning_commands(program, globals, job);
  tools::add_excite_command(program, globals, job);
  tools::add_inspection_commands(program, globals, job);
  tools::add_batch_command(program, globals, job);
  tools::add_diff_command(program, globals, job);
  tools::add_new_command(program, globals, job);
  tools::add_import_command(program, globals, job);
  tools::add_calibrate_command(program, globals, job);
  tools::add_mask_command(program, globals, job);
  tools::add_bench_command(program, globals, job);
  tools::add_describe_commands(app, job);
  for (CLI::App* command : app.get_subcommands({}))
    command->footer(
        "Global options (--device, --threads, --seed, -q, -v, --log, --no-progress, --json): chainsplat --help");
  app.footer(
      "Lengths in meters, angles in radians, time in seconds, mass in kilograms, forces in newtons.\n"
      "Exit codes: 0 done; 1 the work failed, what exists is kept; 2 the request or its input is wrong, nothing "
      "written; "
      "130, 143 interrupted, a checkpoint was left (SIGUSR1: the same and 0); 141 nobody reads the output any more.");
  try {
    app.parse(argc, argv);
  } catch (const CLI::Success& success) {
    const int code = app.exit(success);
    tools::flush_output();
    return code;
  } catch (const CLI::ParseError& error) {
    return fail(kWrongRequest, command_line_error(app, error));
  }
  refuse_empty_output(app);
  tools::start_listening(globals);
  core::set_threads(globals.threads);
  // the CPU driver of Mesa has threads of its own
  if (globals.threads > 0) setenv("LP_NUM_THREADS", std::to_string(globals.threads).c_str(), 0);
  if (!globals.log.empty()) {
    pipeline::check_output_file(globals.log);
    tools::log_to(globals.log);
  }
  job();
  tools::end_progress();
  tools::flush_output();
  return kDone;
}

}  // namespace

int main(int argc, char** argv) {
  keep_memory_together();
  tools::prepare_output();
  std::signal(SIGXFSZ, SIG_IGN);  // a file size limit is an error of write(), not an end without a word
  try {
    return run(argc, argv);
  } catch (const InputError& error) {
    return fail(kWrongRequest, error.what());
  } catch (const WorkError& error) {
    return fail(kWorkFailed, error.what());
  } catch (const Interrupted& interrupted) {
    tools::end_progress();
    return interrupted.signal == SIGUSR1 ? kDone : 128 + interrupted.signal;
  } catch (const std::bad_alloc&) {
    return fail(kWorkFailed, "memory: there is not enough of it; use fewer --frames or a machine with more");
  } catch (const std::system_error& error) {  // of a thread or a file
    return fail(kWorkFailed, std::string("system: ") + error.what() + "; see what it allows with 'ulimit -a' and df");
  } catch (const std::exception& error) {
    return fail(kWorkFailed,
                std::string("internal: ") + error.what() + "; this is a defect, please report the command");
  }
}
