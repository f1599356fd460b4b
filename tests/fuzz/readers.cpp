// readers.cpp - one fuzzing entry point for all readers of outside data. The environment variable CHAINSPLAT_READER
// names the reader.
#include "readers.h"

#include <fcntl.h>
#include <unistd.h>

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <map>
#include <memory>

#include "chainsplat/batch.h"
#include "chainsplat/capture.h"
#include "chainsplat/marker_files.h"
#include "chainsplat/motion_files.h"
#include "chainsplat/run_folder.h"
#include "src/capture/frame_stream.h"
#include "src/capture/image_files.h"
#include "src/capture/jpeg.h"
#include "tools/chainsplat/cli.h"

namespace chainsplat::fuzz {

const Path& folder() {
  static const struct Folder {
    Path path = std::filesystem::temp_directory_path() / ("chainsplat_readers_" + std::to_string(::getpid()));
    Folder() { std::filesystem::create_directories(path); }
    ~Folder() {
      std::error_code ignored;
      std::filesystem::remove_all(path, ignored);
    }
  } folder;
  return folder.path;
}

void put(const Path& file, std::string_view bytes) {
  const int opened = ::open(file.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0600);
  const bool written = opened >= 0 && ::write(opened, bytes.data(), bytes.size()) == static_cast<ssize_t>(bytes.size());
  if (opened >= 0) ::close(opened);
  if (!written) {
    std::fprintf(stderr, "%s cannot be written\n", file.c_str());
    std::exit(1);  // the machine's failure, not the reader's
  }
}

void require(bool condition, const char* promise) {
  if (!condition) throw std::logic_error(promise);
}

const chain::Chain& two_joints() {
  static const chain::Chain chain =
      chain::make_chain(0.2, 0.02, {0, 0, -1}, {0, 1, 0}, 2, chain::Bending::planar, false);
  return chain;
}

dynamics::Parameters parameters_of_two_joints() {
  dynamics::Parameters p;
  p.link_mass = {0.02, 0.02};
  p.viscous_friction = p.coulomb_friction = p.air_linear = p.air_quadratic = {0.0, 0.0};
  p.stiffness = {1e-3, 1e-3};
  p.rest_angle = {0.0, 0.0};
  p.damping = {1e-4, 1e-4};
  p.radius = 0.01;
  return p;
}

namespace {

constexpr std::string_view kBase = "0 0 0 0.55 0 0 0 1\n";  // a single pose, because fitting several takes time

// Makes a capture's folder with all files that capture.json may name; its four images are empty, since they are only
// counted.
Path small_capture(const char* name) {
  const Path capture = folder() / name;
  for (const char* images : {"cam0", "masks", "depth"}) {
    std::filesystem::create_directories(capture / images);
    for (const char* frame : {"000000.png", "000001.png", "000002.png", "000003.png"})
      put(capture / images / frame, "");
  }
  put(capture / "base.tum", kBase);
  put(capture / "cam0.txt", "0\n0.02\n0.04\n0.06\n");
  return capture;
}

// Loads a capture without its images.
capture::Capture load_headers(const Path& capture) {
  capture::LoadOptions options;
  options.images = false;
  return capture::load(capture, options);
}

void manifest(std::string_view bytes) {
  static const Path capture = small_capture("manifest");
  put(capture / "capture.json", bytes);
  load_headers(capture);
}

void camera(std::string_view bytes) {
  static const Path file = folder() / "camera.json";
  put(file, bytes);
  capture::read_calibration(file);
}

void timestamps(std::string_view bytes) {
  static const Path capture = [] {
    const Path made = small_capture("timestamps");
    put(made / "capture.json", R"({"format": "chainsplat-capture/1", "name": "a", "scenario": "free",
      "gravity": [0, 0, -9.81], "object": {"length": 0.3, "diameter": 0.02},
      "grasp": {"direction": [0, 0, -1], "bending_axis": [0, 1, 0]}, "base": "base.tum",
      "cameras": [{"name": "cam0", "width": 64, "height": 48, "fx": 60, "fy": 60, "cx": 32, "cy": 24,
        "world_from_camera": [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1], "images": "cam0/%06d.png", "timestamps": "cam0.txt"}]})");
    return made;
  }();
  put(capture / "cam0.txt", bytes);
  const capture::Capture read = load_headers(capture);
  for (std::size_t k = 1; k < read.times[0].size(); ++k)
    require(read.times[0][k] > read.times[0][k - 1], "times increase");
}

void tum(std::string_view bytes) {
  static const Path file = folder() / "base.tum";
  put(file, bytes);
  const std::vector<trajectory::Sample> samples = trajectory::read_tum(file);
  put(file, trajectory::write_tum(samples));
  const std::vector<trajectory::Sample> again = trajectory::read_tum(file);
  require(again.size() == samples.size(), "as many poses come back");
  constexpr double kTurn = 1e-9;  // error of a rotation that is written as a quaternion and read back
  for (std::size_t k = 0; k < samples.size(); ++k)
    require(again[k].time == samples[k].time && again[k].pose.translation == samples[k].pose.translation &&
                (again[k].pose.rotation - samples[k].pose.rotation).cwiseAbs().maxCoeff() < kTurn,
            "the same poses come back");
  // fit a few poses only, because the fit's time is not the reader's
  constexpr std::size_t kMost = 32;
  if (samples.size() > kMost) return;
  const trajectory::Trajectory fitted = trajectory::fit(samples, "base.tum");
  for (const double time : {fitted.start(), 0.5 * fitted.start() + 0.5 * fitted.end(), fitted.end()}) {
    const trajectory::BaseMotion motion = fitted.at(time);
    require(motion.pose.translation.allFinite() && motion.pose.rotation.allFinite(), "a pose is finite");
  }
}

void truth(std::string_view bytes) {
  static const Path capture = [] {
    const Path made = folder() / "truth";
    std::filesystem::create_directories(made / "truth");
    return made;
  }();
  put(capture / "truth" / "centreline.csv", bytes);
  const auto read = capture::load_true_centerline(capture);
  require(read && read->time.size() == read->points.size(), "a time a row");
}

void markers(std::string_view bytes) {
  static const Path file = folder() / "markers.csv";
  put(file, bytes);
  const identification::MarkerFile read = identification::read_markers(file);
  for (const math::MatrixX& world : read.markers.world)
    require(world.cols() == static_cast<Eigen::Index>(read.markers.arclengths.size()), "a point a marker");
}

bool same(const math::VectorX& a, const math::VectorX& b) { return a.size() == b.size() && a == b; }

void require_same(const chain::States& a, const chain::States& b) {
  require(a.time == b.time && a.theta.size() == b.theta.size() && a.thetadot.size() == b.thetadot.size(),
          "as many states come back");
  for (std::size_t k = 0; k < a.theta.size(); ++k) require(same(a.theta[k], b.theta[k]), "the same angles come back");
  for (std::size_t k = 0; k < a.thetadot.size(); ++k)
    require(same(a.thetadot[k], b.thetadot[k]), "the same rates come back");
}

// Reads twin.json beside intact files that it names.
void twin(std::string_view bytes) {
  static const Path run = [] {
    const Path made = folder() / "run";
    std::filesystem::create_directories(made);
    splat::Gaussians gaussians;
    gaussians.resize(2, two_joints().links(), 0);
    for (int i = 0; i < gaussians.count; ++i) gaussians.rotation[4 * i] = 1.0f;
    put(made / "gaussians.ply", twin::gaussians_ply(gaussians));
    put(made / "states.csv", "time,theta_1,theta_2\n0,0.1,0.2\n0.1,0.2,0.3\n");
    put(made / "rollout.csv", "time,theta_1,theta_2,thetadot_1,thetadot_2\n0,0.1,0.2,0,0\n");
    return made;
  }();
  static const Path again = folder() / "again", third = folder() / "third";
  put(run / "twin.json", bytes);
  const twin::Twin read = twin::load(run);
  twin::save(read, again);
  const twin::Twin second = twin::load(again);
  twin::save(second, third);
  require(core::read_file(again / "twin.json") == core::read_file(third / "twin.json"), "the same twin comes back");
  require_same(read.states, second.states);
  require_same(read.rollout, second.rollout);
  if (read.parameters) dynamics::make_model(read.chain, *read.parameters);
}

void ply(std::string_view bytes) {
  static const Path file = folder() / "gaussians.ply";
  put(file, bytes);
  const splat::Gaussians read = twin::read_ply(file);
  const std::string written = twin::gaussians_ply(read);
  put(file, written);
  require(twin::gaussians_ply(twin::read_ply(file)) == written, "the same Gaussians come back");
}

void points(std::string_view bytes) {
  static const Path file = folder() / "points.ply";
  put(file, bytes);
  require(twin::read_points(file).allFinite(), "points are finite");
}

// Reads states of a chain with as many angles as the first line names.
void states(std::string_view bytes) {
  static const Path file = folder() / "states.csv";
  constexpr int kMost = 12;
  int angles = 0;
  std::size_t at = 0;
  const std::string_view head = bytes.substr(0, bytes.find('\n'));
  while (angles < kMost && (at = head.find("theta_", at)) != std::string_view::npos) ++angles, ++at;
  put(file, bytes);
  const chain::Chain chain =
      chain::make_chain(0.3, 0.02, {0, 0, -1}, {0, 1, 0}, std::max(1, angles), chain::Bending::planar, false);
  const chain::States read = twin::read_states(file, chain);
  put(file, twin::states_csv(read));
  require_same(read, twin::read_states(file, chain));
}

void covariance(std::string_view bytes) {
  static const Path file = folder() / "covariance.csv";
  chain::States states{{0.0, 0.1, 0.2}, std::vector<math::VectorX>(3, math::VectorX::Zero(2)), {}, {}};
  put(file, bytes);
  const std::vector<math::MatrixX> read = states.covariance = pipeline::read_covariances(file, states);
  put(file, pipeline::covariance_csv(states));
  const std::vector<math::MatrixX> again = pipeline::read_covariances(file, states);
  for (std::size_t k = 0; k < read.size(); ++k) require(again[k] == read[k], "the same covariances come back");
}

void jobs(std::string_view bytes) {
  static const Path file = [] {
    for (const char* name : {"captures/a", "captures/b"}) std::filesystem::create_directories(folder() / "jobs" / name);
    return folder() / "jobs" / "jobs.toml";
  }();
  put(file, bytes);
  const pipeline::BatchPlan plan = pipeline::read_job_file(file);
  for (const pipeline::BatchJob& job : plan.jobs)
    require(Path(job.name).filename() == job.name && job.name != "..", "a job's name is that of one folder");
}

// Parses texts of the command line; the first byte chooses the parser.
void values(std::string_view bytes) {
  if (bytes.empty()) return;
  const std::string text(bytes.substr(1));
  switch (bytes[0]) {
    case 'f': {
      const auto [first, last] = capture::read_frame_range(text, "frames");
      require(first >= 0 && (last == -1 || last > first), "a range of frames");
      break;
    }
    case 'c':
      tools::split_camera(text);
      break;
    case 'a':
      planning::parse_axes(text);
      break;
    case 'n':
      require(tools::numbers(text, "--target", 3).size() == 3, "as many numbers as were asked for");
      break;
    case 'm':
      require(!tools::numbers(text, "--terminal", 0).empty(), "at least one number");
      break;
    default:
      break;
  }
}

// Returns the PNG with correct checksums of its chunks, which otherwise would reject every change of it.
std::string with_checksums(std::string bytes) {
  const auto sum = [](std::string_view data) {
    std::uint32_t crc = ~0u;
    for (const char byte : data) {
      crc ^= static_cast<unsigned char>(byte);
      for (int bit = 0; bit < 8; ++bit) crc = crc & 1u ? 0xedb88320u ^ (crc >> 1) : crc >> 1;
    }
    return ~crc;
  };
  for (std::size_t at = 8; at + 12 <= bytes.size();) {
    std::size_t length = 0;
    for (int i = 0; i < 4; ++i) length = length << 8u | static_cast<unsigned char>(bytes[at + i]);
    if (length > bytes.size() - at - 12) break;
    const std::uint32_t crc = sum(std::string_view(bytes).substr(at + 4, length + 4));
    for (int i = 0; i < 4; ++i) bytes[at + 8 + length + i] = static_cast<char>(crc >> (24 - 8 * i));
    at += length + 12;
  }
  return bytes;
}

void image(std::string_view bytes) {
  static const Path file = folder() / "image.png";
  const bool mend = bytes.starts_with("\x89PNG") && bytes.size() % 4 != 0;
  put(file, mend ? with_checksums(std::string(bytes)) : bytes);
  const capture::Image8 read = capture::read_image8(file);
  require(read.pixels.size() == static_cast<std::size_t>(read.width) * read.height * read.channels,
          "as many pixels as the size says");
  capture::read_mask(file, read.width, read.height);
  capture::read_rgb(file, read.width, read.height);
  capture::read_depth(file, read.width, read.height, read.height, 1e-4);
}

void video(std::string_view bytes) {
  static const Path file = folder() / "video.mp4";
  put(file, bytes);
  capture::video_facts(file);
  capture::VideoReader reader(file);
  capture::Image8 picture;
  constexpr int kMost = 8;  // frames that are decoded
  for (int k = 0; k < kMost && reader.next(picture); ++k)
    require(picture.pixels.size() == static_cast<std::size_t>(picture.width) * picture.height * 3,
            "as many pixels as the size says");
}

// A stream of frames that are not compressed; where it does not begin as Y4M they are bare, of 3 x 2 pixels.
void y4m(std::string_view bytes) {
  static const Path file = folder() / "stream.y4m";
  put(file, bytes);
  capture::FrameStream stream(capture::Descriptor(::open(file.c_str(), O_RDONLY | O_CLOEXEC)), file.string(), 3, 2);
  capture::Image8 picture;
  constexpr int kMost = 8;  // frames that are converted
  while (stream.frames() < kMost && stream.next(&picture))
    require(picture.pixels.size() == static_cast<std::size_t>(stream.width()) * stream.height() * 3,
            "as many pixels as the size says");
}

// A frame of a camera, whose size the driver tells: the first two bytes.
void jpeg(std::string_view bytes) {
  if (bytes.size() < 2) return;
  const auto* const data = reinterpret_cast<const std::uint8_t*>(bytes.data());
  const int width = 1 + data[0], height = 1 + data[1];
  capture::Image8 picture;
  if (capture::read_jpeg({data + 2, bytes.size() - 2}, width, height, picture))
    require(picture.pixels.size() == static_cast<std::size_t>(width) * height * 3, "as many pixels as the size says");
}

const std::map<std::string, Read> kReaders = {
    {"batch", batch},
    {"board", board},
    {"calibration", calibration},
    {"camera", camera},
    {"checkpoint", checkpoint},
    {"colmap", colmap},
    {"contacts", contacts},
    {"covariance", covariance},
    {"estimates", estimates},
    {"forces", forces},
    {"image", image},
    {"jobs", jobs},
    {"jpeg", jpeg},
    {"manifest", manifest},
    {"markers", markers},
    {"metrics", metrics},
    {"online", online},
    {"ply", ply},
    {"points", points},
    {"pose", pose},
    {"robot_log", robot_log},
    {"states", states},
    {"timestamps", timestamps},
    {"truth", truth},
    {"tum", tum},
    {"twin", twin},
    {"urdf", urdf},
    {"values", values},
    {"video", video},
    {"y4m", y4m},
};

Read reader_of_environment() {
  const char* const name = std::getenv("CHAINSPLAT_READER");
  const auto found = kReaders.find(name ? name : "");
  if (found != kReaders.end()) return found->second;
  std::fprintf(stderr, "CHAINSPLAT_READER names no reader. There are");
  for (const auto& [known, read] : kReaders) std::fprintf(stderr, " %s", known.c_str());
  std::fprintf(stderr, "\n");
  std::exit(2);
}

}  // namespace
}  // namespace chainsplat::fuzz

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  using namespace chainsplat;
  static const fuzz::Read read = [] {
    core::set_threads(1);
    return fuzz::reader_of_environment();
  }();
  try {
    read({reinterpret_cast<const char*>(data), size});
  } catch (const InputError& error) {
    fuzz::require(!error.where.empty() && !error.problem.empty() && !error.mend.empty(), "WHERE: PROBLEM; MEND");
  }
  return 0;
}
