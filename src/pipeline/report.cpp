// report.cpp - the page of a run, from what stands in its folder and from its capture.
#include "chainsplat/json.h"
#include "chainsplat/report.h"

#include <cmath>
#include <nlohmann/json.hpp>

#include "chainsplat/run_folder.h"
#include "pipeline/stages.h"

namespace chainsplat::pipeline {

namespace {

// Of metrics.json the parts that the page shows. Throws InputError where one is missing.
nlohmann::ordered_json read_metrics(const Path& file) {
  std::error_code error;
  if (!std::filesystem::exists(file, error)) return {};
  const auto refuse = [&] {
    throw InputError(file.string(), "is damaged or of another program", "make it again with 'chainsplat eval'");
  };
  nlohmann::ordered_json metrics = core::parse_json_or_discard(core::read_file(file));
  if (!metrics.is_object()) refuse();
  for (const auto& [name, each] : metrics.items()) {
    if (!each.is_object() || !each.contains("mean") || !each.contains("cameras") || !each.contains("frames")) refuse();
    if (!each["mean"].is_object() || !each["cameras"].is_object() || !each["frames"].is_array()) refuse();
    for (const auto& frame : each["frames"]) {
      const bool sound = frame.is_object() && frame.contains("camera") && frame["camera"].is_string() &&
                         frame.contains("time") && frame["time"].is_number() && frame.contains("iou") &&
                         frame["iou"].is_number() && frame.contains("frame") && frame["frame"].is_number_integer();
      if (!sound) refuse();
    }
  }
  return metrics;
}

// `anyhow`: also without the capture, where it is another one by now.
std::string page_of(const Path& run, const ReportOptions& options, bool anyhow) {
  report::Contents contents;
  Path folder;
  contents.twin = load_twin(run);
  contents.base = own_base(run, contents.twin.states);
  contents.twin.states.covariance = read_covariances(run / kCovarianceFile, contents.twin.states);
  contents.metrics = read_metrics(run / kMetricsFile);
  std::optional<capture::Capture> facts;
  std::string why = "its capture is not there any more";
  try {
    facts = own_recording(contents.twin, run, options.capture);
  } catch (const InputError& error) {
    if (!anyhow) throw;
    why = error.what();
  }
  if (facts) {
    contents.cameras = std::move(facts->cameras);
    contents.times = std::move(facts->times);
    folder = facts->folder;
  } else if (!options.videos.empty()) {
    throw InputError("`video`", "the capture of " + run.string() + " is not there any more", "name it with `capture`");
  } else {
    core::warn(run.string() + ": " + why + "; the report shows no cameras");
  }
  for (const std::string& camera : options.videos) {
    core::report({"video", 0, 0, NAN, NAN, "frames of " + camera});
    contents.videos.push_back(report::read_video(folder, camera, contents.twin));
  }
  return report::page(contents);
}

}  // namespace

std::string report(const Path& run, const ReportOptions& options, const core::Listener& listener) {
  const core::ListenerScope scope(listener);
  constexpr bool kAnyhow = false;
  return page_of(run, options, kAnyhow);
}

void write_report(const Path& run) {
  constexpr bool kAnyhow = true;  // the page comes last, when the twin is saved
  core::write_file(run / kReportFile, page_of(run, {}, kAnyhow));
}

}  // namespace chainsplat::pipeline
