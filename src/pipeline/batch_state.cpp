// batch_state.cpp - how far the jobs of a batch are.
#include <array>
#include <cmath>
#include <fstream>
#include <nlohmann/json.hpp>

#include "chainsplat/batch.h"
#include "chainsplat/json.h"
#include "chainsplat/run_folder.h"

namespace chainsplat::pipeline {

namespace {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;
using Kind = JobState::Kind;

Path end_file(const Path& folder, const BatchJob& job) { return folder / "logs" / (job.name + ".json"); }

}  // namespace

const char* kind_name(Kind kind) {
  constexpr std::array<const char*, 5> kNames = {"done", "running", "stopped", "failed", "waiting"};
  return kNames[static_cast<std::size_t>(kind)];
}

std::string progress_of(const Path& run) {
  // the last whole line, of a file that may be long
  constexpr std::streamoff kTail = 4096;
  std::ifstream file(run / kLogFile, std::ios::binary | std::ios::ate);
  if (!file) return "";
  const std::streamoff size = file.tellg(), from = std::max<std::streamoff>(0, size - kTail);
  file.seekg(from);
  std::string tail(static_cast<std::size_t>(size - from), '\0');
  file.read(tail.data(), size - from);
  const std::size_t end = tail.rfind('\n');
  if (end == std::string::npos) return "";
  const std::size_t begin = end == 0 ? std::string::npos : tail.rfind('\n', end - 1);
  const std::string line = tail.substr(begin == std::string::npos ? 0 : begin + 1, end);
  const Json record = core::parse_json_or_discard(line);
  try {
    std::string text = record.at("stage");
    const auto number = [&](const char* key) { return record.contains(key) ? core::whole_number(record[key]) : 0; };
    const int step = number("iteration"), total = number("total");
    if (total > 0) text += " " + std::to_string(step) + "/" + std::to_string(total);
    return text;
  } catch (const Json::exception&) {  // the line is not of our making
    return "";
  }
}

void save_end(const Path& folder, const BatchJob& job, const JobEnd& end) {
  const Json document{{"arguments", end.arguments},
                      {"code", end.code},
                      {"stopped", end.stopped},
                      {"seconds", std::round(end.seconds * 1e3) / 1e3},
                      {"error", end.error}};
  core::write_file(end_file(folder, job), core::json_text(document) + "\n");
}

bool load_end(const Path& folder, const BatchJob& job, JobEnd& end) {
  std::error_code error;
  if (!fs::exists(end_file(folder, job), error)) return false;
  const Json document = core::parse_json_or_discard(core::read_file(end_file(folder, job)));
  try {
    end = {document.at("arguments").get<std::vector<std::string>>(), core::whole_number(document.at("code")),
           document.at("stopped"), document.at("seconds"), document.at("error")};
  } catch (const Json::exception&) {
    return false;  // then it counts as not ended, and is resumed
  }
  return true;
}

JobState state_of(const Path& folder, const BatchJob& job) {
  const Path run = folder / job.name;
  JobState state;
  JobEnd end;
  const bool ended = load_end(folder, job, end);
  if (ended) state.seconds = end.seconds;
  std::error_code error;
  const bool begun = fs::exists(run / kCheckpointFolder, error);
  if (is_locked(run / kLockFile)) {
    state.kind = Kind::running;
    state.detail = progress_of(run);
  } else if (ended && end.code == 0 && !end.stopped && !begun && fs::exists(run / "twin.json", error)) {
    state.kind = Kind::done;
  } else if (ended && !end.stopped && end.code != 0) {
    state.kind = Kind::failed;
    state.detail = end.error;
  } else if (begun) {
    state.kind = Kind::stopped;
    state.detail = progress_of(run);
  }
  return state;
}

}  // namespace chainsplat::pipeline
