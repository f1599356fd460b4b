// bench.cpp - fixed benchmarks of drawing and training, defined here and seeded, so that two machines measure the same
// work.
#include <sys/resource.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <fstream>
#include <iomanip>
#include <iostream>
#include <map>
#include <memory>
#include <nlohmann/json.hpp>
#include <numbers>
#include <numeric>
#include <sstream>

#include "chainsplat/estimation.h"
#include "chainsplat/eval.h"
#include "chainsplat/image_model.h"
#include "chainsplat/json.h"
#include "chainsplat/pipeline.h"
#include "chainsplat/recognition.h"
#include "chainsplat/render.h"
#include "chainsplat/run_folder.h"
#include "chainsplat/splat.h"
#include "cli.h"
#include "command_line.h"
#include "machine.h"

namespace chainsplat::tools {

namespace {

using Json = nlohmann::ordered_json;

struct BenchRequest {
  std::string gaussians, views;  // empty: the fixed cases
  std::string scene = "both", capture;
  bool whole = false, only_capture = false;
  int repeats = 9, trainings = 1;
};

// What is measured: one scene, defined by these numbers and a seed.
struct Case {
  bool close = false;
  int gaussians = 0, views = 0, joints = 8;
  bool whole = false;  // uncropped images
};

// The README's cases: sizes of one step, a whole batch, the number of links, and few views against many.
constexpr std::array kCases = {Case{true, 2000, 1, 8, true},    Case{true, 20000, 1, 8, true},
                               Case{true, 90000, 1, 8, true},   Case{false, 1000, 1, 8, false},
                               Case{false, 1000, 9, 8, false},  Case{false, 1000, 90, 8, false},
                               Case{false, 2000, 9, 3, false},  Case{false, 2000, 9, 7, false},
                               Case{false, 2000, 9, 15, false}, Case{false, 2000, 9, 31, false}};

// A bent rope of 30 cm, 2 cm thick, seen by cameras on a half circle: `far`, 1 m away, fills about 1 % of 640x480;
// `close` fills about 8 %.
struct Scene {
  std::vector<capture::Camera> cameras;
  std::vector<splat::ViewSpec> views;
  splat::Gaussians gaussians;
};

capture::Camera camera_at(const math::Vector3& eye, const math::Vector3& target, double focal) {
  capture::Camera camera;
  camera.width = 640;
  camera.height = 480;
  camera.fx = camera.fy = focal;
  camera.cx = 320;
  camera.cy = 240;
  const math::Vector3 forward = (target - eye).normalized();
  const math::Vector3 right = forward.cross(math::Vector3::UnitZ()).normalized();
  camera.world_from_camera.rotation.col(0) = right;
  camera.world_from_camera.rotation.col(1) = forward.cross(right);
  camera.world_from_camera.rotation.col(2) = forward;
  camera.world_from_camera.translation = eye;
  return camera;
}

Scene make_scene(const Case& what, std::uint64_t seed) {
  const int count = what.gaussians, views = what.views;
  constexpr double kLength = 0.3, kDiameter = 0.02, kFocal = 615.0;  // m, m, px
  Scene scene;
  const chain::Chain chain = chain::make_chain(kLength, kDiameter, -math::Vector3::UnitZ(), math::Vector3::UnitY(),
                                               what.joints, chain::Bending::planar, false);
  core::Random random(seed);
  splat::Gaussians& g = scene.gaussians;
  g.resize(count, chain.links(), 0);
  const double spacing = std::sqrt(std::numbers::pi * kDiameter * kLength / count);
  for (int i = 0; i < count; ++i) {
    const double s = kLength * (i + random.uniform()) / count, angle = random.uniform(0.0, 2.0 * std::numbers::pi);
    const math::Vector3 mean(0.4 * kDiameter * std::cos(angle), 0.4 * kDiameter * std::sin(angle), -s);
    for (int c = 0; c < 3; ++c) {
      g.mean[3 * i + c] = static_cast<float>(mean[c]);
      g.log_scale[3 * i + c] = static_cast<float>(std::log(0.6 * spacing) + 0.2 * random.normal());
      g.sh[3 * i + c] = static_cast<float>(random.normal());
    }
    for (int c = 0; c < 4; ++c) g.rotation[4 * i + c] = static_cast<float>(random.normal());
    g.opacity_logit[i] = static_cast<float>(random.uniform(0.0, 3.0));
    g.link_logits[g.links * i + chain::link_at(chain, std::min(s, kLength * (1 - 1e-9)))] =
        12.0f;  // one live replica each
  }
  const double distance = what.close ? 0.36 : 1.0;
  scene.cameras.reserve(views);
  std::vector<math::VectorX> theta;
  for (int v = 0; v < views; ++v) {
    const double around = std::numbers::pi * (v + 0.5) / views;
    scene.cameras.push_back(
        camera_at({distance * std::cos(around), distance * std::sin(around), -0.15}, {0, 0, -0.15}, kFocal));
    const math::VectorX bent = math::VectorX::Constant(chain.angles(), 0.8 / what.joints * std::sin(1.0 + v));
    const auto motions = chain::link_motions(chain, bent, math::Pose{});
    if (what.whole) {
      scene.views.push_back({&scene.cameras[v], 0, 0, scene.cameras[v].width, scene.cameras[v].height, motions});
      continue;
    }
    // the crop: the rope's projection and 24 px
    const math::MatrixX points = chain::centerline(chain, motions, chain::equal_arclengths(chain, 33));
    math::Vector2 low = math::Vector2::Constant(1e9), high = -low;
    for (int p = 0; p < points.cols(); ++p) {
      const math::Vector3 x = scene.cameras[v].world_from_camera.inverse() * math::Vector3(points.col(p));
      const math::Vector2 u = capture::project(scene.cameras[v], x);
      low = low.cwiseMin(u);
      high = high.cwiseMax(u);
    }
    const double margin = 24.0 + 0.5 * kDiameter * kFocal / distance;
    const int x0 = std::max(0, static_cast<int>(low.x() - margin)),
              y0 = std::max(0, static_cast<int>(low.y() - margin));
    const int x1 = std::min(640, static_cast<int>(high.x() + margin)),
              y1 = std::min(480, static_cast<int>(high.y() + margin));
    scene.views.push_back({&scene.cameras[v], x0, y0, x1 - x0, y1 - y0, motions});
  }
  return scene;
}

double median(std::vector<double> values) {
  std::sort(values.begin(), values.end());
  return values.empty() ? 0.0 : values[values.size() / 2];
}

// `most`: what memory is meant for.
std::vector<int> counts(const std::string& text, const char* option, int most) {
  std::vector<int> out;
  std::istringstream words(text);
  std::string word;
  while (std::getline(words, word, ',')) {
    try {
      out.push_back(std::stoi(word));
    } catch (const std::exception&) {
      out.push_back(0);
    }
    if (out.back() < 1)
      throw InputError(option, "'" + word + "' is not a positive number", "give numbers with commas between");
    if (out.back() > most)
      throw InputError(option, "'" + word + "' is more than " + std::to_string(most) + ", which would fill the memory",
                       "give smaller numbers with commas between");
  }
  return out;
}

// User and system time of all of the process' threads, s. Unlike the clock it says what the work costs on a busy
// machine.
double processor_seconds() {
  rusage usage{};
  getrusage(RUSAGE_SELF, &usage);
  const auto seconds = [](const timeval& t) { return static_cast<double>(t.tv_sec) + 1e-6 * t.tv_usec; };
  return seconds(usage.ru_utime) + seconds(usage.ru_stime);
}

double peak_memory_mib() {
  rusage usage{};
  getrusage(RUSAGE_SELF, &usage);
  constexpr double kKibPerMib = 1024.0;
  return static_cast<double>(usage.ru_maxrss) / kKibPerMib;
}

// What the process holds now, MiB; 0 where the system does not say. What was freed is handed back first: how much of it
// malloc keeps for later changes from time to time.
double memory_mib() {
  core::trim_memory();
  std::ifstream file("/proc/self/statm");
  double all = 0.0, resident = 0.0;
  file >> all >> resident;
  return resident * static_cast<double>(sysconf(_SC_PAGESIZE)) / (1024.0 * 1024.0);
}

struct Measured {
  double median = 0, least = 0, processor = 0;  // ms; processor: median
  std::map<std::string, double> passes;         // median ms on the device
};

template <class Work>
Measured measure(const splat::Engine& engine, int repeats, Work&& work) {
  constexpr int kWarm = 2;  // kernels compile and buffers grow
  std::vector<double> clock, processor;
  std::map<std::string, std::vector<double>> passes;
  for (int k = 0; k < kWarm + repeats; ++k) {
    if (const int signal = core::stop_requested()) throw Interrupted(signal);
    const double start = core::seconds_now(), used = processor_seconds();
    work();
    if (k < kWarm) continue;
    clock.push_back(1e3 * (core::seconds_now() - start));
    processor.push_back(1e3 * (processor_seconds() - used));
    for (const gpu::Timing& t : engine.timings()) passes[t.label].push_back(t.milliseconds);
  }
  Measured out{median(clock), *std::min_element(clock.begin(), clock.end()), median(processor), {}};
  for (const auto& [label, values] : passes) out.passes[label] = median(values);
  return out;
}

// Pictures of the scene with other Gaussians as 8-bit targets, so that every term has a gradient.
std::vector<capture::PackedView> make_targets(splat::Engine& engine, const Scene& scene, const Case& what,
                                              std::uint64_t seed) {
  std::vector<capture::PackedView> targets;
  for (const splat::Picture& picture : engine.draw(make_scene(what, seed).gaussians, scene.views)) {
    capture::View view;
    view.width = picture.width, view.height = picture.height;
    view.rgba.resize(picture.rgba.size());
    for (std::size_t k = 0; k < picture.rgba.size(); ++k)
      view.rgba[k] = static_cast<std::uint8_t>(std::lround(255.0f * std::clamp(picture.rgba[k], 0.0f, 1.0f)));
    for (std::size_t k = 3; k < view.rgba.size(); k += 4) {
      const bool object = view.rgba[k] >= image_model::kObjectMask;
      view.rgba[k] = object ? 255 : 0;
      if (!object) std::fill_n(view.rgba.begin() + static_cast<std::ptrdiff_t>(k) - 3, 3, 0);
    }
    targets.push_back(capture::packed(view));
  }
  return targets;
}

Json rates_json(const MachineRates& rates) {
  return {{"gflops", rates.gflops}, {"gigabytes_per_second", rates.gigabytes_per_second}};
}

std::string passes_text(const std::map<std::string, double>& passes) {
  std::vector<std::pair<double, std::string>> order;
  for (const auto& [label, milliseconds] : passes) order.emplace_back(-milliseconds, label);
  std::sort(order.begin(), order.end());
  std::ostringstream text;
  text << std::fixed << std::setprecision(1);
  constexpr std::size_t kShown = 6;
  for (std::size_t k = 0; k < std::min(kShown, order.size()); ++k)
    text << (k ? ", " : "") << order[k].second << " " << -order[k].first;
  return text.str();
}

Json bench_case(gpu::Device& device, const Case& what, int repeats, std::uint64_t seed, bool table) {
  const MachineRates machine = measure_machine();
  const Scene scene = make_scene(what, seed + 1);
  splat::Engine engine(device);
  const std::vector<capture::PackedView> targets = make_targets(engine, scene, what, seed + 2);
  std::vector<const capture::PackedView*> pointers;
  for (const capture::PackedView& target : targets) pointers.push_back(&target);
  engine.set_views(scene.views, pointers);
  engine.set_gaussians(scene.gaussians);
  std::vector<int> batch(what.views);
  for (int v = 0; v < what.views; ++v) batch[v] = v;
  const splat::AdamRates rates{};  // all zero: the scene stays the same
  const std::array<std::pair<const char*, Measured>, 3> works = {
      std::pair{"draw", measure(engine, repeats, [&] { engine.draw_views(batch); })},
      std::pair{"step", measure(engine, repeats,
                                [&] {
                                  engine.step(batch, {1.0f, 0.0f, 0.3f}, rates, true);
                                })},
      std::pair{"step_dssim", measure(engine, repeats, [&] {
                  engine.step(batch, {0.8f, 0.2f, 0.3f}, rates, true);
                })}};
  Json entry;
  entry["scene"] = what.close ? "close" : "far";
  entry["gaussians"] = what.gaussians;
  entry["views"] = what.views;
  entry["links"] = what.joints + 1;
  entry["cropped"] = !what.whole;
  entry["machine"] = rates_json(machine);
  for (const auto& [name, measured] : works) {
    entry[name] = {{"median_ms", measured.median}, {"least_ms", measured.least}, {"processor_ms", measured.processor}};
    for (const auto& [label, milliseconds] : measured.passes) entry[name]["passes_ms"][label] = milliseconds;
  }
  if (table) {
    std::ostringstream line;
    line << std::fixed << std::setprecision(1) << std::left << std::setw(6) << (what.close ? "close" : "far")
         << std::setw(8) << (what.whole ? "whole" : "cropped") << std::right << std::setw(10) << what.gaussians
         << std::setw(6) << what.views << std::setw(6) << what.joints + 1;
    for (const auto& [name, measured] : works) line << std::setw(9) << measured.median;
    line << std::setw(9) << works[2].second.least << std::setw(9) << works[2].second.processor << std::setw(9)
         << machine.gflops << std::setw(7) << machine.gigabytes_per_second << "   "
         << passes_text(works[2].second.passes);
    std::cout << line.str() << std::endl;
  }
  return entry;
}

// The whole work on a capture: training by stage, drawing every frame (no files), and following the rope from its first
// camera. Single runs, s.
Json bench_capture(gpu::Device& device, const Path& folder, std::uint64_t seed) {
  Json entry;
  entry["name"] = folder.filename().string();
  entry["machine"] = rates_json(measure_machine());
  double start = core::seconds_now(), used = processor_seconds();
  const auto lap = [&](const char* stage) {
    if (const int signal = core::stop_requested()) throw Interrupted(signal);
    entry["seconds"][stage] = core::seconds_now() - start;
    entry["processor_seconds"][stage] = processor_seconds() - used;
    start = core::seconds_now(), used = processor_seconds();
  };
  const capture::Capture capture = capture::load(folder);
  lap("load");
  recognition::Options options;
  options.seed = seed;
  recognition::Result found = recognition::recognize(device, capture, options);
  lap("recognize");
  twin::Twin twin = pipeline::twin_in_scene(capture);
  twin.chain = std::move(found.chain);
  twin.gaussians = std::move(found.gaussians);
  twin.states = std::move(found.states);
  pipeline::identify_states(twin, capture.base, false, seed);
  lap("identify");
  {
    const capture::Capture recorded = capture::load_recorded(capture, folder);
    splat::Engine engine(device);
    eval::evaluate(engine, twin.gaussians, twin.chain, twin.states, recorded);
    eval::evaluate(engine, twin.gaussians, twin.chain, twin.rollout, recorded);
  }
  lap("evaluate");
  splat::Engine engine(device);
  std::size_t drawn = 0;
  for (std::size_t c = 0; c < capture.cameras.size(); ++c)
    render::for_batches(engine, twin.gaussians, twin.chain, twin.rollout, capture.base, capture.cameras[c],
                        static_cast<int>(c), capture.times[c], {},
                        [&](std::vector<render::Frame>& batch) { drawn += batch.size(); });
  lap("render");
  entry["frames_drawn"] = drawn;
  estimation::Filter filter(
      twin, {capture.cameras.front()}, [&](double time) { return capture.base.at(time); }, capture.base.start());
  std::vector<double> latency;
  for (const capture::PackedView& packed : capture.views) {
    if (packed.camera != 0) continue;
    const capture::View view = capture::unpacked(packed);
    const std::array<const capture::View*, 1> one = {&view};
    const double begun = core::seconds_now();
    filter.update(one);
    latency.push_back(1e3 * (core::seconds_now() - begun));
  }
  std::sort(latency.begin(), latency.end());
  const double total = std::accumulate(latency.begin(), latency.end(), 0.0);
  entry["estimate"] = {{"frames", latency.size()},
                       {"frames_per_second", 1e3 * static_cast<double>(latency.size()) / total},
                       {"median_ms", latency[latency.size() / 2]},
                       {"p99_ms", latency[latency.size() * 99 / 100]}};
  return entry;
}

void bench(const Globals& globals, const BenchRequest& request) {
  if (request.scene != "far" && request.scene != "close" && request.scene != "both")
    throw InputError("--scene", "'" + request.scene + "' is not a scene", "name far, close or both");
  std::vector<Case> cases(kCases.begin(), kCases.end());
  if (!request.gaussians.empty() || !request.views.empty()) {
    cases.clear();
    constexpr int kMostGaussians = 2000000, kMostViews = 1000;
    for (const int count :
         counts(request.gaussians.empty() ? "2000" : request.gaussians, "--gaussians", kMostGaussians))
      for (const int views : counts(request.views.empty() ? "1" : request.views, "--views", kMostViews))
        for (const bool close : {false, true}) cases.push_back({close, count, views, 8, request.whole});
  }
  if (request.only_capture && request.capture.empty())
    throw InputError("--only-capture", "there is no capture", "name one with --capture");
  if (request.only_capture) cases.clear();
  if (request.scene != "both")
    std::erase_if(cases, [&](const Case& what) { return what.close != (request.scene == "close"); });
  const gpu::DevicePtr device = gpu::open_device({.selector = globals.device});
  Json document;
  document["version"] = CHAINSPLAT_VERSION;
  document["device"] = gpu::info(*device).name;
  document["driver"] = gpu::info(*device).driver;
  document["threads"] = core::threads();
  document["repeats"] = request.repeats;
  document["results"] = Json::array();
  if (!globals.json && !cases.empty())
    std::cout
        << gpu::info(*device).name << ", milliseconds a submission, medians of " << request.repeats << "\n"
        << "                                                              with D-SSIM\n"
        << "scene         gaussians views links     draw     step   median    least processor  GFLOP/s   GB/s   its "
           "passes\n";
  for (const Case& what : cases)
    document["results"].push_back(bench_case(*device, what, request.repeats, globals.seed, !globals.json));
  std::vector<double> held;  // MiB after each training
  for (int k = 0; !request.capture.empty() && k < request.trainings; ++k) {
    Json entry = bench_capture(*device, request.capture, globals.seed);
    if (!globals.json) {
      std::cout << "\n" << entry["name"].get<std::string>() << ":";
      for (const auto& [stage, seconds] : entry["seconds"].items())
        std::cout << " " << stage << " " << std::fixed << std::setprecision(2) << seconds.get<double>() << " s,";
      const Json& estimate = entry["estimate"];
      std::cout << " " << entry["frames_drawn"] << " frames drawn; estimate " << std::setprecision(0)
                << estimate["frames_per_second"].get<double>() << " frames/s, 99 % within " << std::setprecision(2)
                << estimate["p99_ms"].get<double>() << " ms; the machine " << std::setprecision(0)
                << entry["machine"]["gflops"].get<double>() << " GFLOP/s, " << std::setprecision(1)
                << entry["machine"]["gigabytes_per_second"].get<double>() << " GB/s\n";
    }
    held.push_back(memory_mib());
    entry["memory_mib"] = held.back();
    document["captures"].push_back(entry);
  }
  if (held.size() >= 4) {
    const double growth = 100.0 * (held.back() / held[held.size() / 2] - 1.0);
    document["memory_growth_percent"] = growth;
    if (!globals.json)
      std::cout << "memory after half of the trainings " << std::fixed << std::setprecision(1) << held[held.size() / 2]
                << " MiB, after all " << held.back() << " MiB: " << std::showpos << growth << std::noshowpos << " %\n";
  }
  document["peak_memory_mib"] = peak_memory_mib();
  if (!globals.json)
    std::cout << "largest memory of the process: " << std::fixed << std::setprecision(0) << peak_memory_mib()
              << " MiB\n";
  if (globals.json) std::cout << core::json_text(document) << "\n";
}

}  // namespace

void add_bench_command(Command app, const Globals& globals, Job& job) {
  Command command = app.add_command("bench", "Measure drawing and training steps on fixed synthetic scenes");
  auto request = std::make_shared<BenchRequest>();
  command.add_option("--gaussians", request->gaussians,
                     "Numbers of Gaussians, with commas between, in place of the fixed cases");
  command.add_option("--views", request->views, "Views a submission, with commas between, in place of the fixed cases");
  command
      .add_option("--capture", request->capture,
                  "Also the whole work on this capture: training by stage, drawing every frame, following the rope")
      .type_name("CAPTURE");
  command
      .add_option("--trainings", request->trainings,
                  "Do the capture's work so many times and say how the memory of the process grows")
      .in_range(1, 10000)
      .shows_default();
  command.add_flag("--only-capture", request->only_capture, "Nothing but the capture's work");
  command.add_flag("--whole", request->whole, "Whole images of 640x480 in these, not crops about the rope");
  command.add_option("--scene", request->scene, "far (1 % of the image), close (8 %) or both").shows_default();
  command.add_option("--repeats", request->repeats, "Measurements of each").in_range(1, 10000).shows_default();
  command.callback([&globals, &job, request] { job = [&globals, request] { bench(globals, *request); }; });
}

}  // namespace chainsplat::tools
