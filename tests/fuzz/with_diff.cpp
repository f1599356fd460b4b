// Fuzzes metrics.json as `diff` reads it.
#include "readers.h"
#include "tools/chainsplat/diff.cpp"

namespace chainsplat::fuzz {

void metrics(std::string_view bytes) {
  static const Path run = [] {
    std::filesystem::create_directories(folder() / "metrics");
    return folder() / "metrics";
  }();
  put(run / pipeline::kMetricsFile, bytes);
  const tools::Json read = tools::mean_metrics(run);
  tools::Comparison comparison;
  tools::compare_metrics(comparison, read, tools::Json::object());
}

}  // namespace chainsplat::fuzz
