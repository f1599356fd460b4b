#include "chainsplat/synth.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <limits>
#include <nlohmann/json.hpp>
#include <optional>

#include "chainsplat/encode.h"

namespace chainsplat::synth {

using Json = nlohmann::ordered_json;

namespace {

constexpr double kDepthScale = 1e-4;  // m per unit: 16 bits reach 6.5 m
constexpr int kTruePoints = 49;       // per centerline
constexpr double kEvenTimes = 1e-9;   // s; largest difference from start + k / rate of evenly spaced times
constexpr double kUsualRate = 30.0;   // frames per second, for a camera with a single frame

Json list(const math::Vector3& v) { return {v.x(), v.y(), v.z()}; }

std::string number(int frame) {
  char text[16];
  std::snprintf(text, sizeof text, "%06d", frame);
  return text;
}

Json camera_json(const capture::Camera& camera, const std::vector<double>& times, const Options& options,
                 const Path& folder) {
  const std::string& name = camera.name;
  Json out{{"name", name},    {"width", camera.width}, {"height", camera.height}, {"fx", camera.fx},
           {"fy", camera.fy}, {"cx", camera.cx},       {"cy", camera.cy},         {"distortion", camera.distortion}};
  const math::Pose& pose = camera.world_from_camera;
  Json matrix = Json::array();
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column) matrix.push_back(pose.rotation(row, column));
    matrix.push_back(pose.translation[row]);
  }
  for (const double value : {0.0, 0.0, 0.0, 1.0}) matrix.push_back(value);
  out["world_from_camera"] = matrix;
  out["images"] = options.video ? name + ".mp4" : name + "/%06d.png";
  out["masks"] = "masks/" + name + "/%06d.png";
  if (options.depth) {
    out["depth"] = "depth/" + name + "/%06d.png";
    out["depth_scale"] = kDepthScale;
  }

  // frame times by rate and start if they are even, else in a file
  const double rate =
      times.size() > 1 ? static_cast<double>(times.size() - 1) / (times.back() - times.front()) : kUsualRate;
  const double nominal = std::round(rate * 1000.0) / 1000.0;  // 30, not 29.999999999999996
  const auto even = [&](double candidate) {
    for (std::size_t k = 0; k < times.size(); ++k)
      if (std::abs(times.front() + static_cast<double>(k) / candidate - times[k]) > kEvenTimes) return false;
    return true;
  };
  if (even(nominal) || even(rate)) {
    out["rate"] = even(nominal) ? nominal : rate;
    out["start"] = times.front();
  } else {
    std::string text;
    for (const double time : times) text += core::exact(time) + "\n";
    core::write_file(folder / (name + ".txt"), text);
    out["timestamps"] = name + ".txt";
  }
  return out;
}

Json scene_json(const twin::Twin& twin, const capture::Capture& scene, const Options& options) {
  const chain::Chain& chain = twin.chain;
  Json out{{"format", "chainsplat-capture/1"},
           {"name", options.name},
           {"scenario", twin.tabletop ? "tabletop" : "free"},
           {"gravity", list(twin.parameters ? twin.parameters->gravity : scene.gravity)},
           {"object", {{"length", chain.length}, {"diameter", chain.diameter}}},
           {"grasp", {{"direction", list(chain.direction)}, {"bending_axis", list(chain.bending_axis)}}}};
  if (twin.known_mass && twin.parameters) {
    const std::optional<capture::Payload>& payload = twin.provenance.payload;
    out["object"]["mass"] = dynamics::total_mass(*twin.parameters) - (payload ? twin.parameters->tip_mass : 0.0);
    if (payload) out["object"]["tip_mass"] = twin.parameters->tip_mass;
    if (payload) out["object"]["tip_length"] = twin.parameters->tip_length;
  }
  if (twin.tabletop) {
    const capture::Table table = scene.table.value_or(capture::Table{});
    out["table"] = {{"point", list(twin.table_point.value_or(table.point))},
                    {"normal", list(twin.table_normal.value_or(table.normal))}};
  }
  out["base"] = "base.tum";
  return out;
}

std::string true_centerline(const chain::Chain& chain, const chain::States& states, const trajectory::Trajectory& base,
                            const std::vector<double>& times) {
  std::string text = "frame,time";
  for (int i = 0; i < kTruePoints; ++i)
    for (const char* axis : {",x", ",y", ",z"}) text += axis + std::to_string(i);
  text += '\n';
  const std::vector<double> arclengths = chain::equal_arclengths(chain, kTruePoints);
  for (std::size_t k = 0; k < times.size(); ++k) {
    const auto motions = chain::link_motions(chain, chain::interpolate(states, times[k]), base.pose(times[k]));
    const math::MatrixX points = chain::centerline(chain, motions, arclengths);
    text += std::to_string(k) + "," + core::exact(times[k]);
    for (const double x : points.reshaped()) text.append(",").append(core::exact(x));
    text += '\n';
  }
  return text;
}

}  // namespace

void write(splat::Engine& engine, const twin::Twin& twin, const chain::States& states, const capture::Capture& scene,
           const Path& folder, const Options& options) {
  // frame times that the states cover, per camera
  std::vector<std::vector<double>> times(scene.cameras.size());
  std::size_t total = 0;
  for (std::size_t c = 0; c < scene.cameras.size(); ++c) {
    const double interval = render::median_interval(scene.times[c]);
    for (const double time : scene.times[c])
      if (render::covered(states, time, interval)) times[c].push_back(time);
    if (times[c].empty())
      throw InputError(scene.folder.string(), "no frame of " + scene.cameras[c].name + " lies within the states' times",
                       "give states for the times of these cameras");
    total += times[c].size();
  }

  // images, masks and depth of each camera
  core::make_folder(folder);
  Json json = scene_json(twin, scene, options);
  json["cameras"] = Json::array();
  std::size_t done = 0;
  for (std::size_t c = 0; c < scene.cameras.size(); ++c) {
    const capture::Camera& camera = scene.cameras[c];
    const std::string& name = camera.name;  // loading has checked that it can be a file name
    core::make_folder(folder / "masks" / name);
    if (options.depth) core::make_folder(folder / "depth" / name);
    if (!options.video) core::make_folder(folder / name);
    json["cameras"].push_back(camera_json(camera, times[c], options, folder));
    render::Options drawing;
    drawing.depth = options.depth;
    drawing.interval = render::median_interval(scene.times[c]);
    const double interval = render::median_interval(times[c]);
    std::optional<capture::VideoWriter> movie;
    if (options.video) movie.emplace(folder / (name + ".mp4"), interval > 0.0 ? 1.0 / interval : kUsualRate);
    render::for_batches(engine, twin.gaussians, twin.chain, states, scene.base, camera, static_cast<int>(c), times[c],
                        drawing, [&](std::vector<render::Frame>& batch) {
                          std::vector<capture::Image8> images(batch.size());
                          core::parallel_for(static_cast<std::int64_t>(batch.size()), [&](std::int64_t k) {
                            const render::Frame& frame = batch[k];
                            const std::string file = number(frame.frame) + ".png";
                            images[k] = render::color_image(frame, camera);
                            if (!options.video) capture::write_png(folder / name / file, images[k]);
                            capture::write_png(folder / "masks" / name / file, render::mask_image(frame, camera));
                            if (options.depth)
                              capture::write_depth_png(folder / "depth" / name / file, camera.width, camera.height,
                                                       render::depth_image(frame, camera), kDepthScale);
                          });
                          if (movie)
                            for (const capture::Image8& image : images) movie->add(image);
                          done += batch.size();
                          constexpr double kNone = std::numeric_limits<double>::quiet_NaN();
                          core::report({"synth", static_cast<std::int64_t>(done), static_cast<std::int64_t>(total),
                                        kNone, kNone, camera.name});
                        });
    if (movie) movie->finish();
  }

  // the base trajectory that the frames were drawn with (smoothed, at its sample times), the truth, and capture.json
  std::vector<trajectory::Sample> samples = scene.base.samples();
  for (trajectory::Sample& sample : samples) sample.pose = scene.base.pose(sample.time);
  core::write_file(folder / "base.tum", trajectory::write_tum(samples));
  core::make_folder(folder / "truth");
  core::write_file(folder / "truth" / "centreline.csv", true_centerline(twin.chain, states, scene.base, times[0]));
  core::write_file(folder / "capture.json", json.dump(1) + "\n");
}

}  // namespace chainsplat::synth
