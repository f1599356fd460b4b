#include "chainsplat/run_folder.h"

#include <fcntl.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <nlohmann/json.hpp>

#include "chainsplat/json.h"
#include "chainsplat/recognition.h"
#include "chainsplat/text.h"
#include "pipeline/stages.h"
#include "src/core/write_parts.h"

namespace chainsplat::pipeline {

twin::Twin twin_in_scene(const capture::Capture& capture) {
  twin::Twin twin;
  twin.tabletop = capture.tabletop;
  twin.gravity = capture.gravity;
  if (capture.table) {
    twin.table_point = capture.table->point;
    twin.table_normal = capture.table->normal;
  }
  twin.known_mass = capture.mass.has_value();
  twin.provenance.mass = capture.mass;
  twin.provenance.payload = capture.payload;
  return twin;
}

FolderLock::FolderLock(const Path& file) : file_(::open(file.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, 0644)) {
  if (file_ < 0)
    throw WorkError(file.string(), std::string("cannot be made (") + std::strerror(errno) + ")",
                    "make room or choose a folder that can be written");
  const int refused = ::flock(file_, LOCK_EX | LOCK_NB) == 0 ? 0 : errno;
  // the file can be gone since it was opened: its owner removes it when all is done
  struct stat held = {}, named = {};
  const bool gone = ::fstat(file_, &held) != 0 || ::stat(file.c_str(), &named) != 0 || held.st_ino != named.st_ino;
  if (refused == EWOULDBLOCK || gone) {
    ::close(file_);
    throw InputError(file.parent_path().parent_path().string(), "another process works in this folder",
                     "wait for it to end, or name another folder");
  }
  if (refused)
    core::warn(file.string() + ": cannot be locked (" + std::strerror(refused) +
               "); see to it that no other process works in this folder");
}

FolderLock::~FolderLock() { ::close(file_); }

bool is_locked(const Path& file) {
  const int opened = ::open(file.c_str(), O_RDONLY | O_CLOEXEC);
  if (opened < 0) return false;
  const bool locked = ::flock(opened, LOCK_SH | LOCK_NB) != 0 && errno == EWOULDBLOCK;
  ::close(opened);
  return locked;
}

void check_run_files(const Path& run) {
  std::error_code error;
  for (const char* name : kRunFiles)
    if (std::filesystem::is_directory(run / name, error))
      throw InputError((run / name).string(), "is a folder, and a file is to be written there",
                       "move it away, or name another run folder");
  const Path checkpoint = run / kCheckpointFolder;
  if (std::filesystem::exists(checkpoint, error) && !std::filesystem::is_directory(checkpoint, error))
    throw InputError(checkpoint.string(), "is no folder, and checkpoints are to be written there",
                     "move it away, or name another run folder");
}

void remove_run_files(const Path& run) {
  std::error_code ignored;
  for (const char* name : kRunFiles) std::filesystem::remove(run / name, ignored);
}

void remove_checkpoint_folder(const Path& run) {
  std::error_code ignored;
  recognition::remove_checkpoint(run / kCheckpointFolder);
  std::filesystem::remove(run / kLockFile, ignored);
  std::filesystem::remove(run / kCheckpointFolder, ignored);  // only where it is empty
}

void remove_half_written(const Path& run) {
  std::error_code ignored;
  for (const Path& folder : {run, run / kCheckpointFolder})
    for (const auto& entry : std::filesystem::directory_iterator(folder, ignored)) {
      const std::string ending = entry.path().extension().string(), name = entry.path().stem().string();
      const bool ours = std::find(std::begin(kRunFiles), std::end(kRunFiles), name) != std::end(kRunFiles) ||
                        recognition::is_checkpoint(name);
      if (ours && ending.starts_with(".tmp") && ending.size() > 4 &&
          ending.find_first_not_of("0123456789", 4) == std::string::npos)
        std::filesystem::remove(entry.path(), ignored);
    }
}

twin::Twin load_twin(const Path& run) {
  twin::Twin twin = twin::load(run);
  if (twin.states.time.empty())
    throw InputError(run.string(), "holds no recognized states",
                     "finish 'chainsplat recognize' or 'chainsplat train' first");
  return twin;
}

void check_drawable(const twin::Twin& twin, const Path& run) {
  if (twin.gaussians.count == 0)
    throw InputError(run.string(), "has no Gaussians to draw", "recognize it from images first");
}

Path input_path(const Path& name) { return name == "-" ? Path("/dev/stdin") : name; }

trajectory::Trajectory read_base(const Path& file) {
  return trajectory::fit(trajectory::read_tum(file), file.string());
}

trajectory::Trajectory own_base(const Path& run) {
  const Path file = run / kBaseFile;
  std::error_code error;
  if (!std::filesystem::exists(file, error))
    throw InputError(file.string(), "is missing",
                     "give the base motion as `base`, or copy the capture's base file there");
  return read_base(file);
}

trajectory::Trajectory own_base(const Path& run, const chain::States& states) {
  trajectory::Trajectory base = own_base(run);
  const double first = states.time.front(), last = states.time.back();
  // as of a capture, half a frame
  const double slack = 0.5 * (last - first) / static_cast<double>(std::max<std::size_t>(states.time.size() - 1, 1));
  if (first < base.start() - slack || last > base.end() + slack)
    throw InputError((run / kBaseFile).string(),
                     "covers " + core::brief(base.start()) + " to " + core::brief(base.end()) +
                         " s, but the states are at " + core::brief(first) + " to " + core::brief(last) + " s",
                     "copy the whole base file of the capture there");
  return base;
}

std::optional<capture::Capture> own_recording(const twin::Twin& twin, const Path& run, const Path& moved) {
  Path folder = moved;
  std::error_code error;
  if (folder.empty()) {
    if (!twin.provenance.path) return {};
    folder = (run / *twin.provenance.path).lexically_normal();
    if (!std::filesystem::exists(folder, error)) return {};
  }
  capture::LoadOptions load;
  load.last = 0;
  capture::Capture facts = capture::load(folder, load);
  if (twin.provenance.capture_hash != capture::hash_text(facts.hash))
    throw InputError(folder.string(), "is not the capture that the twin was made from, or has changed since",
                     "name the capture of this run");
  capture::apply(twin.corrections, facts);
  return facts;
}

dynamics::Model model_of(const twin::Twin& twin, const Path& run) {
  if (!twin.parameters)
    throw InputError((run / "twin.json").string(), "its dynamics are not identified",
                     "run 'chainsplat identify' on it first");
  return dynamics::make_model(twin.chain, *twin.parameters);
}

namespace {

std::string covariance_head(Eigen::Index angles) {
  std::string text = "time";
  for (Eigen::Index row = 0; row < angles; ++row)
    for (Eigen::Index column = 0; column <= row; ++column)
      text.append(",c_").append(std::to_string(row + 1)).append("_").append(std::to_string(column + 1));
  return text + "\n";
}

std::string covariance_row(double time, const math::MatrixX& covariance) {
  std::string text = core::exact(time);
  for (Eigen::Index row = 0; row < covariance.rows(); ++row)
    for (Eigen::Index column = 0; column <= row; ++column)
      text.append(",").append(core::exact(covariance(row, column)));
  return text + "\n";
}

}  // namespace

std::string covariance_csv(const chain::States& states) {
  std::string text = covariance_head(states.covariance.front().rows());
  for (std::size_t k = 0; k < states.covariance.size(); ++k)
    text += covariance_row(states.time[k], states.covariance[k]);
  return text;
}

void write_covariances(const Path& file, const chain::States& states) {
  std::string part = covariance_head(states.covariance.front().rows());
  core::write_parts(file, [&, next = std::size_t{0}]() mutable {
    if (next > 0)
      part = next <= states.covariance.size() ? covariance_row(states.time[next - 1], states.covariance[next - 1]) : "";
    ++next;
    return std::string_view(part);
  });
}

std::vector<math::MatrixX> read_covariances(const Path& file, const chain::States& states) {
  std::error_code error;
  if (!std::filesystem::exists(file, error)) return {};
  const std::string text = core::read_file(file);
  const std::string mend = "remove the file (the weights of the frames are then equal) or recognize again";
  const Eigen::Index angles = states.theta.front().size();
  const std::size_t columns = static_cast<std::size_t>(1 + angles * (angles + 1) / 2);
  std::vector<math::MatrixX> covariances;
  const std::vector<core::TableLine> lines = core::table_lines(text);
  for (std::size_t k = 1; k < lines.size(); ++k) {  // below the head
    const std::vector<double> numbers = core::table_numbers(file, lines[k], columns, mend);
    if (covariances.size() >= states.time.size() || numbers[0] != states.time[covariances.size()])
      throw InputError(file.string() + ":" + std::to_string(lines[k].number), "does not fit states.csv", mend);
    math::MatrixX covariance(angles, angles);
    std::size_t next = 1;
    for (Eigen::Index row = 0; row < angles; ++row)
      for (Eigen::Index column = 0; column <= row; ++column)
        covariance(row, column) = covariance(column, row) = numbers[next++];
    if (!math::is_covariance(covariance))
      throw InputError(file.string() + ":" + std::to_string(lines[k].number),
                       "its numbers are no covariance: not positive semidefinite", mend);
    covariances.push_back(std::move(covariance));
  }
  if (covariances.size() != states.time.size())
    throw InputError(file.string(), "has not as many rows as states.csv", mend);
  return covariances;
}

std::string metrics_json(const eval::Metrics* recognized, const eval::Metrics* rollout) {
  std::string text = "{";
  if (recognized) text += "\"recognized\": " + eval::to_json(*recognized);
  if (recognized && rollout) text += ",\n";
  if (rollout) text += "\"rollout\": " + eval::to_json(*rollout);
  return text + "}\n";
}

void check_output_folder(const Path& folder, bool overwrite, const std::string& mend) {
  std::error_code error;
  if (std::filesystem::exists(folder, error) && !std::filesystem::is_directory(folder, error))
    throw InputError(folder.string(), "is a file, not a folder", "name another folder");
  if (std::filesystem::is_symlink(folder, error) && !std::filesystem::exists(folder, error))
    throw InputError(folder.string(), "is a link to nothing", "name another folder");
  if (std::filesystem::is_directory(folder, error) && !std::filesystem::is_empty(folder, error) && !overwrite)
    throw InputError(folder.string(), "is there already and not empty", mend);
  Path above = std::filesystem::absolute(folder).lexically_normal();
  while (!std::filesystem::exists(above, error) && above.has_relative_path()) above = above.parent_path();
  if (!std::filesystem::is_directory(above, error) || ::access(above.c_str(), W_OK | X_OK) != 0)
    throw InputError(folder.string(), "cannot be made in " + above.string(), "name a folder that can be written");
}

void check_not_capture(const Path& folder, const Path& capture) {
  std::error_code error;
  if (std::filesystem::equivalent(folder, capture, error))
    throw InputError(folder.string(), "is the capture's own folder", "name another folder");
}

void check_output_file(const std::string& file) {
  std::error_code error;
  if (file == "-") return;
  if (std::filesystem::is_directory(file, error)) throw InputError(file, "is a folder, not a file", "name a file");
  const Path folder = std::filesystem::absolute(file).parent_path();
  if (!std::filesystem::is_directory(folder, error))
    throw InputError(file, "its folder does not exist", "make the folder or name another file");
  if (::access(folder.c_str(), W_OK | X_OK) != 0 && !std::filesystem::exists(file, error))
    throw InputError(file, "its folder cannot be written", "name another file");
}

WorkError broken_off(const Error& error, const std::string& kept) {
  return {error.where, error.problem, error.mend + "; " + kept};
}

ProgressLog::ProgressLog(const Path& file) : file_(file, std::ios::app) {
  if (!file_)
    throw InputError(file.string(), "the log cannot be opened for writing", "name a file that can be written");
}

void ProgressLog::write(const core::Progress& progress) {
  constexpr double kInterval = 1.0;  // s, between records of one stage
  const double now = core::seconds_now();
  const bool fresh = progress.stage != stage_, last = progress.total > 0 && progress.step >= progress.total;
  if (!fresh && !last && now - last_ < kInterval) return;
  stage_ = progress.stage;
  last_ = now;
  nlohmann::ordered_json record;
  record["stage"] = progress.stage;
  record["iteration"] = progress.step;
  record["total"] = progress.total;
  record["loss"] = progress.loss;  // NaN is written as null
  record["psnr"] = progress.psnr;
  write(core::json_text(record, -1));
}

void ProgressLog::write(const std::string& json) {
  nlohmann::ordered_json entry = core::parse_json(json);
  entry["seconds"] = std::round((core::seconds_now() - opened_) * 1e3) / 1e3;
  file_ << core::json_text(entry, -1) << std::endl;
}

}  // namespace chainsplat::pipeline
