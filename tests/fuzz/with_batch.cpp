// The plan, the ends, the logs and the results that a batch finds in its folder.
#include "readers.h"
#include "tools/chainsplat/batch_collect.cpp"
#include "tools/chainsplat/cli.h"

#include <CLI/CLI.hpp>

namespace chainsplat::tools {

// A few options of train in the place of all of it: read_job_file() asks for their names and tries values.
void add_training_commands(CLI::App& app, const Globals&, Job&) {
  static std::string capture, out, bending;
  static int joints, every;
  static bool twist;
  CLI::App& command = *app.add_subcommand("train");
  command.add_option("CAPTURE", capture)->required();
  command.add_option("-o,--output", out)->required();
  command.add_option("--joints", joints)->check(CLI::Range(1, 64));
  command.add_option("--every", every);
  command.add_option("--bending", bending)->check(CLI::IsMember({"auto", "planar", "spatial"}));
  command.add_flag("--twist", twist);
}

}  // namespace chainsplat::tools

namespace chainsplat::fuzz {

// The first byte chooses which file it is.
void batch(std::string_view bytes) {
  static const tools::BatchJob job{.name = "job", .capture = "a", .settings = "", .seed = 0, .arguments = {}};
  static const std::string end =
      R"({"arguments": ["--joints=3"], "code": 0, "stopped": false, "seconds": 1.5, "error": ""})";
  static const std::string whole = R"({"chain": {"scenario": "free", "length": 0.3},
    "provenance": {"version": "0.1.0", "device": "llvmpipe"}})";
  static const Path here = [] {
    for (const char* name : {"batch/job", "batch/logs"}) std::filesystem::create_directories(folder() / name);
    return folder() / "batch";
  }();
  static const Path run = here / job.name, end_file = here / "logs" / "job.json";
  if (bytes.empty()) return;
  const std::string_view text = bytes.substr(1);
  switch (bytes[0]) {
    case 'p': {
      put(here / "batch.json", text);
      const tools::BatchPlan plan = tools::load_plan(here);
      tools::save_plan(plan, here);
      require(tools::load_plan(here).jobs.size() == plan.jobs.size(), "the same plan comes back");
      break;
    }
    case 'e': {
      put(end_file, text);
      tools::JobEnd found;
      tools::load_end(here, job, found);
      break;
    }
    case 'l':
      put(run / tools::kLogFile, text);
      tools::progress_of(run);
      break;
    case 'm':
    case 't':
      put(end_file, end);
      put(run / "twin.json", bytes[0] == 't' ? text : std::string_view(whole));
      put(run / tools::kMetricsFile, bytes[0] == 'm' ? text : std::string_view("{}"));
      tools::read_row(job, here);
      break;
    default:
      break;
  }
}

}  // namespace chainsplat::fuzz
