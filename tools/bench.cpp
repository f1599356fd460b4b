// bench.cpp - fixed benchmarks of drawing and training, defined here and seeded, so that two machines measure the same
// work.
#include <CLI/CLI.hpp>
#include <algorithm>
#include <cmath>
#include <iomanip>
#include <iostream>
#include <map>
#include <memory>
#include <nlohmann/json.hpp>
#include <numbers>
#include <sstream>

#include "chainsplat/splat.h"
#include "cli.h"

namespace chainsplat::tools {

namespace {

using Json = nlohmann::ordered_json;

struct Request {
  std::string gaussians = "2000,20000", views = "1,9,30", scene = "both";
  int repeats = 7;
};

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

Scene make_scene(bool close, int count, int views, std::uint64_t seed) {
  constexpr int kJoints = 8;
  constexpr double kLength = 0.3, kDiameter = 0.02, kFocal = 615.0;  // m, m, px
  Scene scene;
  const chain::Chain chain = chain::make_chain(kLength, kDiameter, -math::Vector3::UnitZ(), math::Vector3::UnitY(),
                                               kJoints, chain::Bending::planar, false);
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
  const double distance = close ? 0.36 : 1.0;
  scene.cameras.reserve(views);
  std::vector<math::VectorX> theta;
  for (int v = 0; v < views; ++v) {
    const double around = std::numbers::pi * (v + 0.5) / views;
    scene.cameras.push_back(
        camera_at({distance * std::cos(around), distance * std::sin(around), -0.15}, {0, 0, -0.15}, kFocal));
    const math::VectorX bent = math::VectorX::Constant(chain.angles(), 0.1 * std::sin(1.0 + v));
    // the crop: the rope's projection and 24 px
    const auto motions = chain::link_motions(chain, bent, math::Pose{});
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

std::vector<int> numbers(const std::string& text, const char* option) {
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
  }
  return out;
}

void bench(const Globals& globals, const Request& request) {
  if (request.scene != "far" && request.scene != "close" && request.scene != "both")
    throw InputError("--scene", "'" + request.scene + "' is not a scene", "name far, close or both");
  if (request.repeats < 1) throw InputError("--repeats", "is less than 1", "measure at least once");
  const gpu::DevicePtr device = gpu::open_device({.selector = globals.device});
  Json document;
  document["version"] = CHAINSPLAT_VERSION;
  document["device"] = gpu::info(*device).name;
  document["driver"] = gpu::info(*device).driver;
  document["threads"] = core::threads();
  document["results"] = Json::array();
  if (!globals.json) {
    std::cout << gpu::info(*device).name << ", medians of " << request.repeats << ", milliseconds a submission\n"
              << "scene  gaussians  views   draw  step  step with D-SSIM   passes of the step\n";
  }
  for (const bool close : {false, true}) {
    if (request.scene != "both" && close != (request.scene == "close")) continue;
    for (const int count : numbers(request.gaussians, "--gaussians")) {
      for (const int views : numbers(request.views, "--views")) {
        const Scene scene = make_scene(close, count, views, globals.seed + 1);
        splat::Engine engine(*device);
        // targets: the scene itself, a little off, so that every term has a gradient
        Scene other = make_scene(close, count, views, globals.seed + 2);
        std::vector<std::vector<std::uint8_t>> targets;
        for (const splat::Picture& picture : engine.draw(other.gaussians, scene.views)) {
          targets.emplace_back(picture.rgba.size());
          for (std::size_t k = 0; k < picture.rgba.size(); ++k)
            targets.back()[k] =
                static_cast<std::uint8_t>(std::lround(255.0f * std::clamp(picture.rgba[k], 0.0f, 1.0f)));
          for (std::size_t k = 3; k < targets.back().size(); k += 4) {
            const bool object = targets.back()[k] >= 128;
            targets.back()[k] = object ? 255 : 0;
            if (!object) std::fill_n(targets.back().begin() + static_cast<std::ptrdiff_t>(k) - 3, 3, 0);
          }
        }
        std::vector<const std::vector<std::uint8_t>*> pointers;
        for (const auto& target : targets) pointers.push_back(&target);
        engine.set_views(scene.views, pointers);
        engine.set_gaussians(scene.gaussians);
        std::vector<int> batch(views);
        for (int v = 0; v < views; ++v) batch[v] = v;
        const auto measure = [&](auto&& work, std::map<std::string, std::vector<double>>* passes) {
          constexpr int kWarm = 2;  // kernels compile and buffers grow
          std::vector<double> milliseconds;
          for (int k = 0; k < kWarm + request.repeats; ++k) {
            if (const int signal = core::stop_requested()) throw Interrupted(signal);
            const double start = core::seconds_now();
            work();
            if (k < kWarm) continue;
            milliseconds.push_back(1e3 * (core::seconds_now() - start));
            if (passes)
              for (const gpu::Timing& t : engine.timings()) (*passes)[t.label].push_back(t.milliseconds);
          }
          return median(milliseconds);
        };
        const splat::AdamRates rates{};  // all zero: the scene stays the same
        std::map<std::string, std::vector<double>> passes;
        const double draw = measure([&] { engine.draw_views(batch); }, nullptr);
        const double step = measure([&] { engine.step(batch, {1.0f, 0.0f, 0.3f}, rates, true); }, &passes);
        const double dssim = measure([&] { engine.step(batch, {0.8f, 0.2f, 0.3f}, rates, true); }, nullptr);
        Json entry;
        entry["scene"] = close ? "close" : "far";
        entry["gaussians"] = count;
        entry["views"] = views;
        entry["draw_ms"] = draw;
        entry["step_ms"] = step;
        entry["step_dssim_ms"] = dssim;
        for (const auto& [label, values] : passes) entry["passes_ms"][label] = median(values);
        document["results"].push_back(entry);
        if (globals.json) continue;
        std::ostringstream line;
        line << std::fixed << std::setprecision(1) << std::left << std::setw(7) << (close ? "close" : "far")
             << std::right << std::setw(9) << count << std::setw(7) << views << std::setw(7) << draw << std::setw(6)
             << step << std::setw(18) << dssim << "   ";
        std::vector<std::pair<double, std::string>> order;
        for (const auto& [label, values] : passes) order.emplace_back(-median(values), label);
        std::sort(order.begin(), order.end());
        for (std::size_t k = 0; k < std::min<std::size_t>(5, order.size()); ++k)
          line << (k ? ", " : "") << order[k].second << " " << -order[k].first;
        std::cout << line.str() << std::endl;
      }
    }
  }
  if (globals.json) std::cout << document.dump(1) << "\n";
}

}  // namespace

void add_bench_command(CLI::App& app, const Globals& globals, Job& job) {
  CLI::App* command = app.add_subcommand("bench", "Measure drawing and training steps on fixed synthetic scenes");
  auto request = std::make_shared<Request>();
  command->add_option("--gaussians", request->gaussians, "Numbers of Gaussians, with commas between")
      ->capture_default_str();
  command->add_option("--views", request->views, "Views a submission, with commas between")->capture_default_str();
  command->add_option("--scene", request->scene, "far (1 % of the image), close (8 %) or both")->capture_default_str();
  command->add_option("--repeats", request->repeats, "Measurements of each")->capture_default_str();
  command->callback([&globals, &job, request] { job = [&globals, request] { bench(globals, *request); }; });
}

}  // namespace chainsplat::tools
