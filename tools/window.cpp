#include "window.h"

#include <httplib.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <condition_variable>
#include <deque>
#include <mutex>
#include <nlohmann/json.hpp>
#include <thread>

#include "chainsplat/core.h"
#include "window_page.h"

namespace chainsplat::tools {

namespace {

using Json = nlohmann::ordered_json;

constexpr std::size_t kHistory = 300;                       // frames of the latency plot: ten seconds at 30 Hz
constexpr auto kPatience = std::chrono::milliseconds(500);  // until a browser without news is told so
constexpr double kAsking = 2.0;  // s after the last request in which pictures are still copied

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
  httplib::Server server;
  std::thread thread;
  std::mutex mutex;
  std::condition_variable news;
  bool over = false;
  int width = 0, height = 0;
  std::string title;
  std::int64_t count = 0;                  // frames shown so far; also the number of the last one
  std::atomic<double> asked{-1e9};         // when a browser last asked, core::seconds_now()
  Json state;                              // of the last frame
  std::shared_ptr<const std::string> rgb;  // its picture; none when nobody asked for one
  std::deque<double> latency;              // ms, the last of them of frame `count`

  // Four bytes of length, JSON, then the picture's RGB: what the page's script reads.
  void next(const httplib::Request& request, httplib::Response& response) {
    const std::int64_t after = std::strtoll(request.get_param_value("after").c_str(), nullptr, 10);
    std::unique_lock lock(mutex);
    asked = core::seconds_now();
    news.wait_for(lock, kPatience, [&] { return over || count > after; });
    if (count <= after || count == 0) {
      response.status = over ? 410 : 204;
      return;
    }
    Json document = state;
    document["number"] = count;
    document["width"] = width;
    document["height"] = height;
    document["title"] = title;
    document["picture"] = rgb != nullptr;
    document["latency"] = latency;
    const std::shared_ptr<const std::string> picture = rgb;
    lock.unlock();  // the estimator waits for no copy
    const std::string text = document.dump();
    std::string body(4, '\0');
    for (int i = 0; i < 4; ++i) body[i] = static_cast<char>(text.size() >> 8 * i & 0xff);
    body += text;
    if (picture) body += *picture;
    response.set_header("Cache-Control", "no-store");
    response.set_content(body, "application/octet-stream");
  }
};

Window::Window(int port, int width, int height, const std::string& title)
    : implementation_(std::make_unique<Implementation>()) {
  Implementation& self = *implementation_;
  self.width = width, self.height = height, self.title = title;
  // the library's default would let a second program share the port without a word
  self.server.set_socket_options([](socket_t socket) {
    int yes = 1;
    setsockopt(socket, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes);
  });
  // a page from elsewhere that calls itself by another name must not see the camera
  self.server.set_pre_routing_handler([](const httplib::Request& request, httplib::Response& response) {
    const std::string host = request.get_header_value("Host");
    const std::string name = host.substr(0, host.rfind(':'));
    if (name == "127.0.0.1" || name == "localhost") return httplib::Server::HandlerResponse::Unhandled;
    response.status = 403;
    return httplib::Server::HandlerResponse::Handled;
  });
  self.server.Get("/", [](const httplib::Request&, httplib::Response& response) {
    response.set_content(kWindowPage, sizeof kWindowPage - 1, "text/html; charset=utf-8");
  });
  self.server.Get(
      "/next", [&self](const httplib::Request& request, httplib::Response& response) { self.next(request, response); });
  if (!self.server.bind_to_port("127.0.0.1", port))
    throw InputError("--serve " + std::to_string(port), "the port cannot be had; another program may use it",
                     "name another port, for example 8765");
  self.thread = std::thread([&self] { self.server.listen_after_bind(); });
}

Window::~Window() {
  {
    const std::lock_guard lock(implementation_->mutex);
    implementation_->over = true;
  }
  implementation_->news.notify_all();
  implementation_->server.stop();
  implementation_->thread.join();
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
                {"residual", shown.residual}, {"seen", shown.seen},           {"lost", shown.lost},
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
  self.news.notify_all();
}

std::vector<math::Vector2> recorded_line(const capture::Camera& camera, const math::MatrixX& world_points) {
  constexpr double kNearest = 0.01;  // m
  std::vector<math::Vector2> line;
  const math::Pose camera_from_world = camera.world_from_camera.inverse();
  for (Eigen::Index i = 0; i < world_points.cols(); ++i) {
    const math::Vector3 p = camera_from_world * math::Vector3(world_points.col(i));
    if (p.z() > kNearest) line.push_back(capture::distort(camera, capture::project(camera, p)));
  }
  return line;
}

}  // namespace chainsplat::tools
