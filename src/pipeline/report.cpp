// report.cpp - the page of a run, from what stands in its folder and from its capture.
#include "chainsplat/report.h"
#include "chainsplat/json.h"

#include <algorithm>
#include <cmath>
#include <fstream>
#include <limits>
#include <nlohmann/json.hpp>

#include "chainsplat/run_folder.h"
#include "pipeline/stages.h"
#include "pipeline/streams.h"

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

// Whether the base moves as in the recording that the twin was made from.
bool moves_as(const trajectory::Trajectory& own, const report::Followed& followed, double diameter) {
  if (own.samples().empty()) return false;
  constexpr double kSlack = 1.0 / 30.0;  // s, a frame beyond the last sample
  for (std::size_t k = 0; k < followed.base.size(); ++k) {
    const double time = followed.states.time[k];
    if (own.samples().size() > 1 && (time < own.start() - kSlack || time > own.end() + kSlack)) return false;
    // what training and following find of the grasp differs by millimeters, two motions soon by more than a rope
    if ((own.pose(time).translation - followed.base[k].translation).norm() > diameter) return false;
  }
  return true;
}

// Every line must be of one of the `times`, in order.
std::vector<force::Estimate> read_forces(const Path& file, const twin::Twin& twin, const std::vector<double>& times) {
  const std::string name = file.string();
  std::ifstream in(input_path(file));
  if (!in) throw InputError(name, "cannot be read", "give the output of force, or - for standard input");
  std::vector<force::Estimate> out;
  double before = -std::numeric_limits<double>::infinity();
  std::string line;
  for (int number = 1; estimation::next_line(in, line, name, "force"); ++number) {
    core::stop_if_requested();
    if (line.empty()) continue;
    const std::string where = name + ": line " + std::to_string(number);
    const force::Line read = force::from_json(line, where, twin.chain, before);
    before = read.estimate.time;
    if (read.known_mass != twin.known_mass)
      throw InputError(
          where + ": unit",
          twin.known_mass ? "is N/kg, but the twin's mass is known" : "is N, but the twin's mass is not known",
          "give forces of this twin");
    if (!std::binary_search(times.begin(), times.end(), read.estimate.time))
      throw InputError(where + ": time", core::exact(read.estimate.time) + " s is no time of the estimates",
                       "give forces of these estimates");
    out.push_back(read.estimate);
  }
  if (out.empty()) throw InputError(name, "has no line", "give the output of force");
  return out;
}

report::Followed read_followed(const Path& run, const ReportOptions& options, const twin::Twin& twin,
                               const trajectory::Trajectory& own) {
  constexpr std::size_t kMost = 1'000'000;  // states, nine hours at 30 Hz: bounds the memory
  report::Followed out;
  StreamBase base(run, twin, options.base);
  each_estimate(options.estimate, twin.chain.angles(), [&](const estimation::EstimateLine& line) {
    if (out.states.time.size() == kMost)
      throw InputError(options.estimate.string(), "has more than a million states", "give a part of it");
    base.mend(line.time, line.base);
    out.states.time.push_back(line.time);
    out.states.theta.push_back(line.theta);
    if (line.sigma.size() > 0) out.sigma.push_back(line.sigma);
  });
  const std::vector<double>& times = out.states.time;
  if (times.empty())
    throw InputError(options.estimate.string(), "has no frame in which the rope was followed",
                     "give the output of estimate where it is not lost");
  base.check_covers(times.front(), times.back());
  for (const double time : times) out.base.push_back(base.at(time).pose);
  out.own_recording = options.base.empty() || moves_as(own, out, twin.chain.diameter);
  if (options.forces.empty()) return out;
  model_of(twin, run);  // forces are of an identified twin
  out.forces = read_forces(options.forces, twin, times);
  return out;
}

// `anyhow`: also without the capture, where it is another one by now.
std::string page_of(const Path& run, const ReportOptions& options, bool anyhow) {
  report::Contents contents;
  Path folder;
  contents.twin = load_twin(run);
  contents.base = own_base(run, contents.twin.states);
  contents.twin.states.covariance = read_covariances(run / kCovarianceFile, contents.twin.states);
  contents.metrics = read_metrics(run / kMetricsFile);
  if (!options.estimate.empty()) contents.followed = read_followed(run, options, contents.twin, contents.base);
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

void ReportOptions::check() const {
  if (estimate.empty() && !forces.empty())
    throw InputError("`forces`", "no `estimate` is given", "give the estimates that the forces were told from");
  if (estimate.empty() && !base.empty())
    throw InputError("`base`", "no `estimate` is given", "give the estimates that it is the base motion of");
  if ((estimate == "-") + (forces == "-") + (base == "-") > 1)
    throw InputError("`estimate`, `forces`, `base`", "more than one is standard input", "give files");
}

std::string report(const Path& run, const ReportOptions& options, const core::Listener& listener) {
  const core::ListenerScope scope(listener);
  options.check();
  constexpr bool kAnyhow = false;
  return page_of(run, options, kAnyhow);
}

void write_report(const Path& run) {
  constexpr bool kAnyhow = true;  // the page comes last, when the twin is saved
  core::write_file(run / kReportFile, page_of(run, {}, kAnyhow));
}

}  // namespace chainsplat::pipeline
