#include "chainsplat/eval.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <fstream>
#include <nlohmann/json.hpp>

#include "small_twin.h"
#include "src/eval/depth_image.h"

using namespace chainsplat;
using Json = nlohmann::json;
using math::Vector3;

namespace {

struct Pair {
  int width = 0, height = 0;
  std::vector<float> x, y;
};

// Row-major RGB image of a case of ssim.json, placed at (left, top) of a black canvas.
Pair pair_of(const Json& example, int left = 0, int top = 0, int right = 0, int bottom = 0) {
  const int width = example["width"], height = example["height"];
  Pair out{width + left + right, height + top + bottom, {}, {}};
  out.x.assign(3u * out.width * out.height, 0.0f);
  out.y = out.x;
  for (int v = 0; v < height; ++v)
    for (int u = 0; u < width; ++u)
      for (int c = 0; c < 3; ++c) {
        const std::size_t k = 3u * (static_cast<std::size_t>(out.width) * (v + top) + u + left) + c;
        out.x[k] = example["x"][v][u][c].get<float>();
        out.y[k] = example["y"][v][u][c].get<float>();
      }
  return out;
}

Json cases() {
  std::ifstream file(std::string(CHAINSPLAT_SOURCE_DIR) + "/tests/data/vectors/ssim.json");
  REQUIRE(file.good());
  return Json::parse(file)["cases"];
}

capture::Camera small_camera() {
  capture::Camera camera;
  camera.name = "cam0";
  camera.width = 40;
  camera.height = 30;
  camera.fx = camera.fy = 50;
  camera.cx = 20;
  camera.cy = 15;
  camera.world_from_camera.translation = {1, 2, 3};
  return camera;
}

// A view whose mask is the rectangle [x0, x1) x [y0, y1) of one gray, inside a crop with a margin.
capture::View rectangle_view(int x0, int y0, int x1, int y1, std::uint8_t gray, float depth) {
  capture::View view;
  view.x0 = x0 - 2;
  view.y0 = y0 - 1;
  view.width = x1 - x0 + 4;
  view.height = y1 - y0 + 2;
  view.rgba.assign(4u * view.width * view.height, 0);
  view.depth.assign(static_cast<std::size_t>(view.width) * view.height, 0.0f);
  for (int y = y0; y < y1; ++y)
    for (int x = x0; x < x1; ++x) {
      const std::size_t k = static_cast<std::size_t>(y - view.y0) * view.width + x - view.x0;
      for (int c = 0; c < 3; ++c) view.rgba[4 * k + c] = gray;
      view.rgba[4 * k + 3] = 255;
      view.depth[k] = depth;
    }
  return view;
}

render::Frame rectangle_frame(int x0, int y0, int x1, int y1, float value, float depth) {
  render::Frame frame;
  frame.x0 = x0;
  frame.y0 = y0;
  frame.picture.width = x1 - x0;
  frame.picture.height = y1 - y0;
  const std::size_t pixels = static_cast<std::size_t>(frame.picture.width) * frame.picture.height;
  for (std::size_t k = 0; k < pixels; ++k) {
    frame.picture.rgba.insert(frame.picture.rgba.end(), {value, value, value, 0.9f});
    frame.picture.depth.push_back(depth);
  }
  return frame;
}

}  // namespace

TEST_CASE("SSIM equals the vectors") {
  for (const Json& example : cases()) {
    const Pair pair = pair_of(example);
    const double pixels = static_cast<double>(pair.width) * pair.height;
    // the images are rounded to float
    CHECK(std::abs(eval::ssim(pair.x, pair.y, pair.width, pair.height, pixels) - example["ssim"].get<double>()) < 1e-6);
    CHECK(eval::ssim(pair.x, pair.x, pair.width, pair.height, pixels) == doctest::Approx(1.0).epsilon(1e-14));
  }
}

TEST_CASE("SSIM of a crop is that of the image around it") {
  const Json example = cases()[0];
  const Pair image = pair_of(example, 31, 17, 9, 23), crop = pair_of(example, 5, 5, 5, 5);
  const double pixels = static_cast<double>(image.width) * image.height;
  const double whole = eval::ssim(image.x, image.y, image.width, image.height, pixels);
  CHECK(whole < 0.999);
  CHECK(std::abs(whole - eval::ssim(crop.x, crop.y, crop.width, crop.height, pixels)) < 1e-14);
  // content at the image's border, which has zero padding as well
  const Pair corner = pair_of(example, 0, 0, 12, 12), corner_crop = pair_of(example, 0, 0, 5, 5);
  const double corner_pixels = static_cast<double>(corner.width) * corner.height;
  CHECK(std::abs(eval::ssim(corner.x, corner.y, corner.width, corner.height, corner_pixels) -
                 eval::ssim(corner_crop.x, corner_crop.y, corner_crop.width, corner_crop.height, corner_pixels)) <
        1e-14);
}

TEST_CASE("chamfer equals the double loop") {
  core::Random random(5);
  for (const int count : {1, 2, 9, 700}) {
    math::MatrixX p(3, count), q(3, 2 * count + 1);
    for (double& x : p.reshaped()) x = random.normal();
    for (double& x : q.reshaped()) x = random.normal();
    q.row(2) *= 0.01;  // flat, like the surface of a rope
    double forward = 0.0, backward = 0.0;
    for (const auto& a : p.colwise())
      forward += (q.colwise() - a).colwise().norm().minCoeff() / static_cast<double>(p.cols());
    for (const auto& b : q.colwise())
      backward += (p.colwise() - b).colwise().norm().minCoeff() / static_cast<double>(q.cols());
    CHECK(eval::chamfer(p, q) == doctest::Approx(0.5 * (forward + backward)).epsilon(1e-12));
  }
  // many equal points
  const math::MatrixX same = Vector3(1, 2, 3).replicate(1, 50);
  CHECK(eval::chamfer(same, same) == 0.0);
  CHECK(eval::chamfer(same, (same.colwise() + Vector3(0, 3, 4)).eval()) == doctest::Approx(5.0));
  CHECK(std::isnan(eval::chamfer(same, math::MatrixX(3, 0))));
}

TEST_CASE("chamfer of depth images equals that of their points, near and far, straight and through a lens") {
  core::Random random(6);
  capture::Camera camera = small_camera();
  for (const bool lens : {false, true}) {
    if (lens) camera.distortion[0] = 0.1;
    for (const int shift : {0, 1, 3, 20}) {  // px
      eval::DepthImage p{2, 3, 36, 24, std::vector<float>(36 * 24)}, q = p;
      math::MatrixX clouds[2] = {math::MatrixX(3, 0), math::MatrixX(3, 0)};
      for (int k = 0; k < 36 * 24; ++k) {
        const int x = k % 36, y = k / 36;
        for (int which = 0; which < 2; ++which) {
          const int left = which * shift;
          if (x < left || x >= left + 12 || y < 6 || y >= 18 || random.uniform() < 0.2) continue;
          const auto z = static_cast<float>(2.0 + 0.02 * random.normal() + 0.005 * x);
          (which == 0 ? p : q).depth[k] = z;
          math::Vector2 pixel(2 + x + 0.5, 3 + y + 0.5);
          if (lens) pixel = capture::undistort(camera, pixel);
          clouds[which].conservativeResize(3, clouds[which].cols() + 1);
          clouds[which].rightCols<1>() =
              z * Vector3((pixel.x() - camera.cx) / camera.fx, (pixel.y() - camera.cy) / camera.fy, 1.0);
        }
      }
      CHECK(eval::chamfer(p, q, camera) == doctest::Approx(eval::chamfer(clouds[0], clouds[1])).epsilon(1e-9));
    }
  }
}

TEST_CASE("metrics of a frame, by hand") {
  const capture::Camera camera = small_camera();
  // recorded: 10 x 6 pixels of 102/255 = 0.4; drawn: the same rectangle shifted by 5 columns, of 0.6
  const capture::View view = rectangle_view(10, 8, 20, 14, 102, 2.0f);
  const render::Frame frame = rectangle_frame(15, 8, 25, 14, 0.6f, 2.0f);
  const eval::FrameMetrics m = eval::compare(frame, view, camera);
  // 30 pixels of 0.4 against 0, 30 of 0.4 against 0.6, 30 of 0 against 0.6; means over all 1200 pixels
  const double squared = 30 * 0.16 + 30 * 0.04 + 30 * 0.36;
  CHECK(m.psnr == doctest::Approx(-10 * std::log10(squared / 1200)).epsilon(1e-6));
  CHECK(m.psnr_object == doctest::Approx(-10 * std::log10((30 * 0.16 + 30 * 0.04) / 60)).epsilon(1e-6));
  CHECK(m.iou == doctest::Approx(30.0 / 90.0));
  // pixels are 2/50 m apart at 2 m: columns 0..4 of the true cloud are 5..1 columns from the drawn one, the others 0
  CHECK(m.chamfer == doctest::Approx(0.04 * (1 + 2 + 3 + 4 + 5) / 10.0).epsilon(1e-9));
  CHECK(m.ssim < 0.95);
  CHECK(std::isnan(m.tip_rms));

  // equal pictures: every metric is perfect
  const eval::FrameMetrics same =
      eval::compare(rectangle_frame(10, 8, 20, 14, static_cast<float>(0.4), 2.0f), view, camera);
  CHECK(same.psnr == eval::kMostPsnr);
  CHECK(same.iou == 1.0);
  CHECK(same.ssim == doctest::Approx(1.0).epsilon(1e-12));
  CHECK(same.chamfer < 1e-12);

  // only the depth is wrong, by 1 cm along the axis: nearest points are about as far apart
  const eval::FrameMetrics nearer = eval::compare(rectangle_frame(10, 8, 20, 14, 0.4f, 2.01f), view, camera);
  CHECK(nearer.chamfer == doctest::Approx(0.01).epsilon(0.02));

  // nothing is drawn and nothing is recorded
  capture::View nothing;
  const eval::FrameMetrics empty = eval::compare({}, nothing, camera);
  CHECK(empty.psnr == eval::kMostPsnr);
  CHECK(empty.ssim == 1.0);
  CHECK(empty.iou == 1.0);
  CHECK(std::isnan(empty.psnr_object));
  CHECK(std::isnan(empty.chamfer));
  // everything drawn is wrong: psnr counts it, psnr_object has no pixel to count
  const eval::FrameMetrics spurious = eval::compare(frame, nothing, camera);
  CHECK(spurious.iou == 0.0);
  CHECK(spurious.psnr == doctest::Approx(-10 * std::log10(60 * 0.36 / 1200)).epsilon(1e-6));
  CHECK(std::isnan(spurious.psnr_object));
}

TEST_CASE("alpha and colors are clamped and thresholded as mathematics.md 9 says") {
  const capture::Camera camera = small_camera();
  const capture::View view = rectangle_view(10, 8, 20, 14, 255, 0.0f);
  render::Frame frame = rectangle_frame(10, 8, 20, 14, 1.7f, 0.0f);
  CHECK(eval::compare(frame, view, camera).psnr == eval::kMostPsnr);  // 1.7 is shown as 1
  for (std::size_t k = 3; k < frame.picture.rgba.size(); k += 4) frame.picture.rgba[k] = k < 120 ? 0.5f : 0.499f;
  CHECK(eval::compare(frame, view, camera).iou == doctest::Approx(0.5));
}

TEST_CASE("distorted pixels are straightened before they are projected back") {
  capture::Camera camera = small_camera();
  camera.distortion = {-0.3, 0.1, 0.003, -0.002, 0.0};
  // if the same pixel is recorded and drawn, the points are equal; with the next pixel drawn, their distance is depth /
  // f times that of the undistorted pixels
  const eval::FrameMetrics same =
      eval::compare(rectangle_frame(33, 25, 34, 26, 0.4f, 1.0f), rectangle_view(33, 25, 34, 26, 102, 1.0f), camera);
  CHECK(same.chamfer == 0.0);
  const eval::FrameMetrics next =
      eval::compare(rectangle_frame(34, 25, 35, 26, 0.4f, 1.0f), rectangle_view(33, 25, 34, 26, 102, 1.0f), camera);
  const math::Vector2 a = capture::undistort(camera, {33.5, 25.5}), b = capture::undistort(camera, {34.5, 25.5});
  CHECK((b - a).norm() > 1.05);
  CHECK(next.chamfer == doctest::Approx((b - a).norm() / 50.0).epsilon(1e-9));
}

TEST_CASE("a twin explains pictures of itself, and the metrics know by how much another does not") {
  const gpu::DevicePtr device = gpu::open_device();
  splat::Engine engine(*device);
  const test::TemporaryFolder folder("eval");
  const twin::Twin twin = test::small_twin(chain::Bending::spatial, 400);
  capture::Capture recorded;
  recorded.folder = folder.path;
  recorded.pixels = capture::Pixels::recorded;
  recorded.base = test::moving_base(1.0);
  recorded.has_depth = true;
  capture::Camera camera = small_camera();
  camera.width = 160;
  camera.height = 121;
  camera.fx = camera.fy = 150;
  camera.cx = 80;
  camera.cy = 60;
  camera.world_from_camera.rotation << 1, 0, 0, 0, 0, 1, 0, -1, 0;
  camera.world_from_camera.translation = {0.02, -0.6, 0.4};
  recorded.cameras.push_back(camera);
  camera.name = "cam1";
  camera.distortion = {-0.2, 0.05, 0.001, -0.002, 0.0};
  camera.world_from_camera = math::Pose{math::exp_so3({0, 0, -0.9}), Vector3::Zero()} * camera.world_from_camera;
  recorded.cameras.push_back(camera);
  recorded.times.resize(2);
  render::Options options;
  options.depth = true;
  for (int c = 0; c < 2; ++c) {
    for (int k = 0; k < 40; ++k) recorded.times[c].push_back(k / 30.0 + 0.01 * c);  // the states end at 1 s
    for (render::Frame& frame : render::frames(engine, twin.gaussians, twin.chain, twin.states, recorded.base,
                                               recorded.cameras[c], c, recorded.times[c], options)) {
      capture::View view;
      view.camera = c;
      view.frame = frame.frame;
      view.time = frame.time;
      view.x0 = frame.x0;
      view.y0 = frame.y0;
      view.width = frame.picture.width;
      view.height = frame.picture.height;
      for (std::size_t k = 0; k < frame.picture.rgba.size(); k += 4) {
        const bool in_mask = frame.picture.rgba[k + 3] >= 0.5f;
        for (int i = 0; i < 3; ++i)
          view.rgba.push_back(
              in_mask ? static_cast<std::uint8_t>(std::lround(255 * std::min(1.0f, frame.picture.rgba[k + i]))) : 0);
        view.rgba.push_back(in_mask ? 255 : 0);
      }
      view.depth = frame.picture.depth;
      recorded.views.push_back(capture::packed(view));
    }
  }
  // two views that no state covers
  capture::PackedView late = recorded.views.back();
  late.frame = 39;
  late.time = recorded.times[1][39];
  recorded.views.push_back(late);
  late.frame = 38;
  late.time = recorded.times[1][38];
  recorded.views.insert(recorded.views.end() - 1, late);

  // the truth is the chain, with nodes at 0, 13 mm and every 57.4 mm from there; its 301 points are 1 mm apart
  std::filesystem::create_directories(folder.path / "truth");
  std::string text = "frame,time";
  for (int i = 0; i <= 300; ++i)
    for (const char* axis : {",x", ",y", ",z"}) text += axis + std::to_string(i);
  text += "\n";
  for (int k = 0; k <= 30; ++k) {
    const auto motions = chain::link_motions(twin.chain, twin.states.theta[k], recorded.base.pose(k / 30.0));
    const math::MatrixX points = chain::centerline(twin.chain, motions, chain::equal_arclengths(twin.chain, 301));
    text.append(std::to_string(k)).append(",").append(core::exact(k / 30.0));
    for (const double x : points.reshaped()) text.append(",").append(core::exact(x));
    text += "\n";
  }
  core::write_file(folder.path / "truth" / "centreline.csv", text);

  std::vector<std::string> warnings;
  core::Listener listener;
  listener.warning = [&](const std::string& line) { warnings.push_back(line); };
  core::set_listener(listener);
  const eval::Metrics metrics = eval::evaluate(engine, twin.gaussians, twin.chain, twin.states, recorded);
  core::set_listener({});
  REQUIRE(warnings.size() == 1);
  CHECK(warnings[0].find("cam1: 2 of 33") != std::string::npos);
  REQUIRE(metrics.frames.size() == 62);
  CHECK(metrics.camera_names == std::vector<std::string>{"cam0", "cam1"});
  CHECK(metrics.mean.iou == 1.0);
  CHECK(metrics.mean.psnr_object > 52.0);  // 8 bits: 20 log10(255 sqrt(12)) = 58.9
  CHECK(metrics.mean.psnr > 35.0);         // lower, because the faint rim outside the mask is black in the recording
  CHECK(metrics.mean.ssim > 0.98);
  CHECK(metrics.mean.chamfer < 1e-7);
  CHECK(metrics.empty_clouds == 0);
  CHECK(metrics.cameras[0].centerline_rms < 1e-4);
  CHECK(metrics.cameras[0].tip_rms < 1e-12);
  CHECK(metrics.cameras[1].tip_rms < 1e-3);  // between the truth's times, where it is interpolated by cubics
  CHECK(metrics.cameras[1].tip_rms > 1e-9);

  // a base that is off by 5 mm moves the centerline by exactly as much, and the picture noticeably
  capture::Capture shifted = recorded;
  std::vector<trajectory::Sample> samples = recorded.base.samples();
  for (trajectory::Sample& sample : samples) sample.pose.translation += Vector3(0.003, 0, 0.004);
  shifted.base = trajectory::fit(samples, "shifted");
  const eval::Metrics off = eval::evaluate(engine, twin.gaussians, twin.chain, twin.states, shifted);
  CHECK(off.cameras[0].centerline_rms == doctest::Approx(0.005).epsilon(0.002));
  CHECK(off.cameras[0].tip_rms == doctest::Approx(0.005).epsilon(0.001));
  CHECK(off.mean.iou < 0.95);
  CHECK(off.mean.psnr_object < metrics.mean.psnr_object - 15.0);
  CHECK(off.mean.ssim < metrics.mean.ssim);
  CHECK(off.mean.chamfer > 2e-4);
  CHECK(off.mean.chamfer < 5e-3);
  // cam1's last frame is after the truth's last time
  const auto with_truth =
      std::count_if(off.frames.begin(), off.frames.end(), [](const auto& f) { return !std::isnan(f.tip_rms); });
  CHECK(with_truth == 61);
  double squares = 0.0;
  for (const eval::FrameMetrics& frame : off.frames)
    if (!std::isnan(frame.tip_rms)) squares += frame.tip_rms * frame.tip_rms;
  CHECK(off.mean.tip_rms == doctest::Approx(std::sqrt(squares / 61)));

  // the result is the same on one thread
  const int threads = core::threads();
  core::set_threads(1);
  CHECK(eval::to_json(eval::evaluate(engine, twin.gaussians, twin.chain, twin.states, shifted)) == eval::to_json(off));
  core::set_threads(threads);
  CHECK_THROWS_AS(eval::evaluate(engine, twin.gaussians, twin.chain, test::swing(twin.chain, 0.1, 5.0), recorded),
                  InputError);
}

TEST_CASE("metrics.json has the keys of its documentation") {
  eval::Metrics metrics;
  metrics.camera_names = {"cam0", "left"};
  eval::FrameMetrics frame;
  frame.camera = 1;
  frame.frame = 12;
  frame.time = 0.4;
  frame.psnr = 30.5;
  frame.chamfer = std::numeric_limits<double>::quiet_NaN();
  metrics.frames = {frame};
  metrics.cameras = {frame, frame};
  metrics.mean = frame;
  const Json json = Json::parse(eval::to_json(metrics));
  CHECK(json.size() == 3);
  CHECK(json["mean"]["psnr"] == 30.5);
  CHECK(!json["mean"].contains("chamfer"));
  CHECK(json["mean"].contains("centerline_rms"));
  CHECK(json["cameras"]["left"]["psnr"] == 30.5);
  CHECK(json["frames"][0]["camera"] == "left");
  CHECK(json["frames"][0]["frame"] == 12);
  CHECK(json["frames"][0]["time"] == 0.4);
  CHECK(json["frames"][0].contains("iou"));
}
