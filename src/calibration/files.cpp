#include "files.h"

#include <algorithm>
#include <cmath>
#include <nlohmann/json.hpp>

#include "chainsplat/solve_json.h"

namespace chainsplat::calibration {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;
using math::Vector2;
using math::Vector3;

namespace {

using Color = std::array<std::uint8_t, 3>;
constexpr Color kGreen{60, 230, 60}, kRed{255, 60, 60}, kYellow{255, 220, 0}, kCyan{0, 200, 230};
constexpr double kLonger = 20.0;  // as differences are drawn
constexpr int kCircle = 5;        // px

void dot(capture::Image8& image, const Vector2& at, const Color& color) {
  if (!at.allFinite() || at.cwiseAbs().maxCoeff() > 1e6) return;
  const int x = static_cast<int>(std::floor(at.x())), y = static_cast<int>(std::floor(at.y()));
  if (x < 0 || y < 0 || x >= image.width || y >= image.height) return;
  std::copy(color.begin(), color.end(), &image.pixels[3 * (static_cast<std::size_t>(y) * image.width + x)]);
}

void line(capture::Image8& image, const Vector2& from, const Vector2& to, const Color& color) {
  const double length = std::min((to - from).norm(), 1e4);
  for (int i = 0, n = 1 + static_cast<int>(2.0 * length); i <= n; ++i)
    dot(image, from + (to - from) * (double(i) / n), color);
}

Json pose_json(const math::Pose& pose) {
  Json out = Json::array();
  for (int r = 0; r < 3; ++r) {
    for (int c = 0; c < 3; ++c) out.push_back(pose.rotation(r, c));
    out.push_back(pose.translation(r));
  }
  for (const double last : {0.0, 0.0, 0.0, 1.0}) out.push_back(last);
  return out;
}

Json list(const Vector3& v) { return {v.x(), v.y(), v.z()}; }

// As in capture.json, without images and times.
Json camera_json(const CameraResult& result) {
  const capture::Camera& camera = result.camera;
  Json json{
      {"name", camera.name}, {"width", camera.width}, {"height", camera.height}, {"fx", camera.fx},
      {"fy", camera.fy},     {"cx", camera.cx},       {"cy", camera.cy},         {"distortion", camera.distortion}};
  if (result.placed) json["world_from_camera"] = pose_json(camera.world_from_camera);
  return json;
}

}  // namespace

Path draw(const Path& out, const Recording& recording, const Bundle& bundle, int camera) {
  const View* worst = nullptr;
  const Moment* moment = nullptr;
  double most = -1.0;
  for (const Moment& m : bundle.moments)
    for (const View& view : m.views) {
      if (view.camera != camera) continue;
      const math::MatrixX r = residuals(bundle, m, view, nullptr);
      const double mean = std::sqrt(r.squaredNorm() / static_cast<double>(r.cols()));
      if (mean > most || !worst) most = mean, worst = &view, moment = &m;
    }
  core::make_folder(out / "pictures");
  const Path file = out / "pictures" / (recording.name + ".png");
  if (!worst) return file;
  capture::Image8 image;
  importing::for_each_frame(recording.media, {worst->frame, worst->frame + 1}, [&](int, const capture::Image8& frame) {
    image = {frame.width, frame.height, 3, {}};
    image.pixels.resize(static_cast<std::size_t>(3) * frame.width * frame.height);
    for (std::size_t i = 0; i < image.pixels.size() / 3; ++i)
      for (int c = 0; c < 3; ++c)
        image.pixels[3 * i + c] = frame.pixels[i * frame.channels + (frame.channels >= 3 ? c : 0)];
  });
  for (const Moment& m : bundle.moments)
    for (const View& view : m.views)
      if (view.camera == camera)
        for (const Seen& seen : view.corners) dot(image, seen.pixel, kCyan);
  const math::MatrixX r = residuals(bundle, *moment, *worst, nullptr);
  for (Eigen::Index i = 0; i < r.cols(); ++i) {
    const Vector2& at = worst->corners[i].pixel;
    for (int k = 0; k < 40; ++k)
      dot(image, at + kCircle * Vector2(std::cos(k * M_PI / 20), std::sin(k * M_PI / 20)), kGreen);
    if (!r.col(i).allFinite()) continue;
    const Vector2 computed = at + r.col(i);
    line(image, at, at + kLonger * r.col(i), kYellow);
    for (const Vector2& arm : {Vector2(3, 0), Vector2(0, 3)}) line(image, computed - arm, computed + arm, kRed);
  }
  capture::write_png(file, image);
  return file;
}

Json to_json(const Calibration& calibration) {
  Json json;
  json["format"] = "chainsplat-calibration/1";
  json["trusted"] = calibration.trusted();
  json["findings"] = Json::array();
  for (const Finding& f : calibration.findings) {
    Json one{{"bad", f.bad}, {"code", f.code}};
    if (!f.camera.empty()) one["camera"] = f.camera;
    one["text"] = f.text;
    json["findings"].push_back(std::move(one));
  }
  json["world"] = calibration.world;
  json["board"] = Json::parse(write_board(calibration.board));
  json["cameras"] = Json::array();
  for (const CameraResult& c : calibration.cameras) {
    const Deviation& d = c.deviation;
    Json one = camera_json(c);
    Json sigma{{"fx", d.fx}, {"fy", d.fy}, {"cx", d.cx}, {"cy", d.cy}, {"distortion", d.distortion}};
    if (c.placed) sigma["position"] = list(d.position), sigma["rotation"] = list(d.rotation);
    if (calibration.robot) {
      one["clock"] = c.clock, one["start"] = c.start;
      sigma["clock"] = d.clock;
    }
    one["sigma"] = std::move(sigma);
    one["frames"] = c.frames, one["seen"] = c.seen, one["views"] = c.views, one["corners"] = c.corners;
    one["residual"] = {{"rms_px", c.rms}, {"rms_mm", c.rms_mm}, {"worst_px", c.worst}};
    one["edge_sigma"] = c.edge_deviation, one["covered"] = c.covered, one["tilt"] = c.tilt;
    json["cameras"].push_back(std::move(one));
  }
  if (calibration.robot)
    json["robot"] = {{"flange_from_board", pose_json(calibration.flange_from_board)},
                     {"sigma",
                      {{"position", list(calibration.board_position_deviation)},
                       {"rotation", list(calibration.board_rotation_deviation)}}},
                     {"scatter", {{"position", calibration.robot_position}, {"rotation", calibration.robot_rotation}}}};
  json["moments"] = calibration.moments;
  json["fit"] = calibration.summary;
  json["notes"] = calibration.notes;
  return json;
}

void check_output(const Path& out, bool force) {
  std::error_code error;
  if (!fs::exists(out, error) || (fs::is_directory(out, error) && fs::is_empty(out, error))) return;
  const bool ours = fs::exists(out / "calibration.json", error);
  if (!ours) throw InputError(out.string(), "exists and is no calibration", "name another folder");
  if (!force) throw InputError(out.string(), "exists already", "name another folder, or replace it with `force`");
}

void write_calibration(const Path& out, const Calibration& calibration) {
  core::make_folder(out);
  for (const CameraResult& camera : calibration.cameras) {
    const Path file = out / (camera.camera.name + ".json");
    std::error_code error;
    if (camera.placed)
      core::write_file(file, camera_json(camera).dump(1) + "\n");
    else
      fs::remove(file, error);  // of a calibration before
  }
  core::write_file(out / "calibration.json", to_json(calibration).dump(1) + "\n");
}

}  // namespace chainsplat::calibration
