#include "window.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <deque>
#include <mutex>
#include <nlohmann/json.hpp>
#include <optional>

#include "chainsplat/core.h"
#include "chainsplat/image_model.h"
#include "chainsplat/json.h"
#include "page_server.h"
#include "window_page.h"

namespace chainsplat::tools {

namespace {

using Json = nlohmann::ordered_json;

constexpr std::size_t kHistory = 300;  // frames of the latency plot: ten seconds at 30 Hz
constexpr double kPatience = 0.5;      // s, until a browser without news is told so
constexpr double kAsking = 2.0;        // s after the last request in which pictures are still copied

// The masked object on black, as far as there is no picture.
void draw(const capture::View& view, int width, int height, std::string& rgb) {
  for (int y = 0; y < view.height && view.y0 + y < height; ++y)
    for (int x = 0; x < view.width && view.x0 + x < width; ++x) {
      const std::uint8_t* const from = &view.rgba[4 * (static_cast<std::size_t>(y) * view.width + x)];
      if (from[3] == 0) continue;
      std::copy_n(from, 3, rgb.begin() + 3 * ((static_cast<std::ptrdiff_t>(view.y0) + y) * width + view.x0 + x));
    }
}

}  // namespace

struct Window::Implementation {
  std::mutex mutex;
  bool over = false;
  int width = 0, height = 0;
  std::string title;
  std::int64_t count = 0;                  // frames shown so far; also the number of the last one
  std::atomic<double> asked{-1e9};         // when a browser last asked, core::seconds_now()
  Json state;                              // of the last frame
  std::shared_ptr<const std::string> rgb;  // its picture; none when nobody asked for one
  std::deque<double> latency;              // ms, the last of them of frame `count`
  std::optional<PageServer> server;        // last: it uses all others

  std::optional<PageAnswer> respond(const PageRequest& request) {
    PageAnswer out;
    if (request.path == "/") {
      out.type = "text/html; charset=utf-8";
      out.body = kWindowPage;
    } else if (request.path == "/next") {
      return next(request);
    } else {
      out.status = 404;
    }
    return out;
  }

  // The first frame after the number in 'after=N'. Four bytes of length, JSON, then the picture's RGB: what the page's
  // script reads.
  std::optional<PageAnswer> next(const PageRequest& request) {
    const std::int64_t after = std::strtoll(request.after.c_str(), nullptr, 10);
    PageAnswer out;
    std::unique_lock lock(mutex);
    asked = core::seconds_now();
    if (count <= after || count == 0) {
      out.status = over ? 410 : 204;
      return over || request.waited >= kPatience ? std::optional(out) : std::nullopt;
    }
    Json document = state;
    document["number"] = count;
    document["width"] = width;
    document["height"] = height;
    document["title"] = title;
    document["picture"] = rgb != nullptr;
    document["latency"] = latency;
    out.rest = rgb;
    lock.unlock();  // the estimator waits for no text
    const std::string text = core::json_text(document, -1);
    out.type = "application/octet-stream";
    out.body.assign(4, '\0');
    for (int i = 0; i < 4; ++i) out.body[i] = static_cast<char>(text.size() >> 8 * i & 0xff);
    out.body += text;
    return out;
  }
};

Window::Window(int port, int width, int height, const std::string& title)
    : implementation_(std::make_unique<Implementation>()) {
  Implementation& self = *implementation_;
  self.width = width, self.height = height, self.title = core::printable(title);
  self.server.emplace(port, [&self](const PageRequest& request) { return self.respond(request); });
}

Window::~Window() {
  const std::lock_guard lock(implementation_->mutex);
  implementation_->over = true;
}

void Window::show(const Shown& shown) {
  Implementation& self = *implementation_;
  const auto points = [](const std::vector<math::Vector2>& list) {
    Json out = Json::array();
    for (const math::Vector2& p : list)
      out.push_back({std::round(10.0 * p.x()) / 10.0, std::round(10.0 * p.y()) / 10.0});
    return out;
  };
  Json state = {{"frame", shown.frame},       {"time", shown.time},           {"iou", shown.iou},
                {"residual", shown.residual}, {"seen", shown.seen},           {"status", shown.status},
                {"line", points(shown.line)}, {"force", points(shown.force)}, {"force_text", shown.force_text}};
  std::shared_ptr<std::string> rgb;
  if (core::seconds_now() - self.asked < kAsking) {
    if (shown.picture) {
      rgb = std::make_shared<std::string>(shown.picture->pixels.begin(), shown.picture->pixels.end());
    } else if (shown.view) {
      rgb = std::make_shared<std::string>(static_cast<std::size_t>(3) * self.width * self.height, '\0');
      draw(*shown.view, self.width, self.height, *rgb);
    }
  }
  {
    const std::lock_guard lock(self.mutex);
    ++self.count;
    self.latency.push_back(1e3 * shown.latency);
    if (self.latency.size() > kHistory) self.latency.pop_front();
    self.state = std::move(state);
    self.rgb = std::move(rgb);
  }
  self.server->wake();
}

std::vector<math::Vector2> recorded_line(const capture::Camera& camera, const math::MatrixX& world_points) {
  std::vector<math::Vector2> line;
  const math::Pose camera_from_world = camera.world_from_camera.inverse();
  for (Eigen::Index i = 0; i < world_points.cols(); ++i) {
    const math::Vector3 p = camera_from_world * math::Vector3(world_points.col(i));
    if (p.z() > image_model::kNear) line.push_back(capture::distort(camera, capture::project(camera, p)));
  }
  return line;
}

}  // namespace chainsplat::tools
