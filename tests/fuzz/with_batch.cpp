// Fuzzes the files that a batch finds in its folder: the plan, the ends and logs of jobs, and their results.
#include "readers.h"
#include "src/pipeline/batch_collect.cpp"

namespace chainsplat::fuzz {

// The first byte chooses the file.
void batch(std::string_view bytes) {
  static const pipeline::BatchJob job{.name = "job", .capture = "a", .settings = "", .seed = 0, .arguments = {}};
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
      const pipeline::BatchPlan plan = pipeline::load_plan(here);
      pipeline::save_plan(plan, here);
      require(pipeline::load_plan(here).jobs.size() == plan.jobs.size(), "the same plan comes back");
      break;
    }
    case 'e': {
      put(end_file, text);
      pipeline::JobEnd found;
      pipeline::load_end(here, job, found);
      break;
    }
    case 'l':
      put(run / pipeline::kLogFile, text);
      pipeline::progress_of(run);
      break;
    case 'm':
    case 't':
      put(end_file, end);
      put(run / "twin.json", bytes[0] == 't' ? text : std::string_view(whole));
      put(run / pipeline::kMetricsFile, bytes[0] == 'm' ? text : std::string_view("{}"));
      pipeline::read_row(job, here);
      break;
    default:
      break;
  }
}

}  // namespace chainsplat::fuzz
