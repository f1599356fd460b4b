// cli.h - what the files of the program share: global options, how a command is registered, progress, results.
#pragma once
#include <cstdint>
#include <functional>
#include <nlohmann/json.hpp>
#include <optional>
#include <string>
#include <vector>

#include "chainsplat/core.h"

namespace CLI {
class App;
}
namespace chainsplat::eval {
struct FrameMetrics;
}
namespace chainsplat::capture {
struct Payload;
}

namespace chainsplat::tools {

class Command;

// Options that stand before or after any command.
struct Globals {
  std::string device;  // number or part of a name; empty: chosen
  int threads = 0;     // 0: all cores
  std::uint64_t seed = 0;
  bool quiet = false, verbose = false, no_progress = false, json = false;
  std::string log;  // file for one JSON record an interval
};

using Job = std::function<void()>;

// Each adds its commands to `app`; the one that was named sets `job`.
void add_training_commands(Command app, const Globals& globals, Job& job);  // train, recognize
void add_identify_command(Command app, const Globals& globals, Job& job);
void add_motion_commands(Command app, const Globals& globals, Job& job);      // rollout, render
void add_result_commands(Command app, const Globals& globals, Job& job);      // eval, report, export, synth
void add_inspection_commands(Command app, const Globals& globals, Job& job);  // check, doctor
void add_planning_commands(Command app, const Globals& globals, Job& job);    // plan
void add_excite_command(Command app, const Globals& globals, Job& job);
void add_estimation_commands(Command app, const Globals& globals, Job& job);  // estimate
void add_force_commands(Command app, const Globals& globals, Job& job);       // force
void add_new_command(Command app, const Globals& globals, Job& job);
void add_batch_command(Command app, const Globals& globals, Job& job);  // batch
void add_diff_command(Command app, const Globals& globals, Job& job);   // diff
void add_mask_command(Command app, const Globals& globals, Job& job);
void add_import_command(Command app, const Globals& globals, Job& job);
void add_calibrate_command(Command app, const Globals& globals, Job& job);
void add_bench_command(Command app, const Globals& globals, Job& job);
void add_describe_commands(CLI::App& app, Job& job);  // completions, manual

// --- describe.cpp --------------------------------------------------------------------------------
// The command, or of the command that was named the option, that `word` may be a slip of; empty where none is near.
std::string meant(const CLI::App& app, const std::string& word);

// --- progress.cpp --------------------------------------------------------------------------------
// Warnings, messages and progress go to standard error from now on, progress as a redrawn line on a terminal, else as a
// plain line every 5 s.
void start_listening(const Globals& globals);
// The same, for a call of the library.
core::Listener terminal();
// One JSON record an interval is added to `file` from now on. Throws InputError when it cannot be opened.
void log_to(const Path& file);
void end_progress();                     // leaves the redrawn line
void say(const std::string& line);       // a message on standard error, unless -q
void say_more(const std::string& line);  // only with -v
// SIGINT, SIGTERM and SIGUSR1 ask long work to stop; a second SIGINT or SIGTERM quits at once, and so does the first
// as long as there is nothing to keep.
void watch_signals(bool nothing_to_keep = false);
// Standard input, output and error as the program needs them: none of them is closed, and a pipe that nobody reads is
// an error of writing, not an end without a word.
void prepare_output();
// What was printed is out. Throws Interrupted (SIGPIPE) where nobody reads it any more, else WorkError.
void flush_output();

// --- options.cpp ----------------------------------------------------------------------------------
// A text of the library, in which fields of options structs stand in backquotes, with the options of the command line
// in their place: `frames` becomes --frames.
std::string with_options(const std::string& text);
// --tip-mass KG[,SIGMA] and --tip-length M, and what they say: nothing without a mass. Throws InputError.
struct PayloadRequest {
  std::vector<double> mass, length;  // kg, and its deviation; m; empty: unknown
};
void add_payload_options(Command command, PayloadRequest& request);
std::optional<capture::Payload> payload_of(const PayloadRequest& request);

// --- inspect.cpp --------------------------------------------------------------------------------
// What `check` finds: as lines, and as the document of --json. `with_masks` false: of a capture whose masks are still
// to be made, which cannot be judged by its images.
// NOLINTNEXTLINE(bugprone-exception-escape): the document's own move constructor checks itself when debugged
struct CheckReport {
  std::string text;
  nlohmann::ordered_json document;
  int problems = 0;
};
CheckReport check_report(const std::string& path, bool with_masks);

// --- results.cpp --------------------------------------------------------------------------------
// "X,Y,Z": numbers between commas, `count` of them (0: one or more). Throws InputError with `where`.
std::vector<double> numbers(const std::string& text, const std::string& where, std::size_t count);
// Writes `bytes` to standard output ("-"), into a device or pipe that exists, else as a file in one step.
void write_result(const std::string& name, const std::string& bytes);
// The base motion that is kept beside a file of states: NAME.base.tum beside NAME.csv, as rollout writes it, or
// base.tum beside the states.csv or rollout.csv of a run or plan. Empty: there is none.
Path base_beside(const std::string& states);
// Throws InputError where `output` is one of `inputs` (empty and "-": none), or also a file of the run folder.
void check_not_input(const std::string& output, const std::vector<std::string>& inputs);
void check_not_input(const std::string& output, const Path& run, std::vector<std::string> inputs);
// Throws InputError where `output` is standard output and --json wants it, too.
void check_one_wants_standard_output(const Globals& globals, const std::string& output);
// CAPTURE[:camera] as the two; the second is empty for all cameras. A folder whose own name has a colon is taken as it
// is.
std::pair<std::string, std::string> split_camera(const std::string& text);
// A text in single quotes of a shell, whatever it holds; `also` escaped by backslashes.
std::string shell_quoted(const std::string& text, const std::string& also = "");
// One named row of metrics a line, with the head line; NaN as '-'.
struct MetricsRow {
  std::string name;
  const eval::FrameMetrics* metrics;
};
std::string metrics_table(const std::vector<MetricsRow>& rows);

}  // namespace chainsplat::tools
