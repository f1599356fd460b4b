// window.h - a small live window: a page on the loopback address that shows the camera's picture, the chain laid over
// it, whether to trust it, and the latency. A browser asks for the next frame when it has drawn the last one, so a slow
// one skips frames and the estimator waits for nobody.
#pragma once
#include <memory>
#include <string>
#include <vector>

#include "chainsplat/capture.h"

namespace chainsplat::tools {

// What is shown of one frame. Pixels are the recorded picture's.
struct Shown {
  int frame = 0;
  double time = 0.0;     // s
  double latency = 0.0;  // s
  double iou = 0.0, residual = 0.0;
  bool seen = false;
  std::string status = "following";  // or doubtful, lost
  std::vector<math::Vector2> line;           // the chain's joints and ends
  std::vector<math::Vector2> force;          // from the contact to the arrow's head; empty: none known
  std::string force_text = "unknown";        // its size and standard error, or "none"
  const capture::Image8* picture = nullptr;  // RGB, as recorded; null: none
  const capture::View* view = nullptr;       // drawn where there is no picture; null: none
};

class Window {
 public:
  // Serves http://127.0.0.1:PORT/ until destroyed. Throws InputError where the port is not to be had.
  Window(int port, int width, int height, const std::string& title);
  ~Window();
  void show(const Shown& shown);

 private:
  struct Implementation;
  std::unique_ptr<Implementation> implementation_;
};

// The chain's nodes in recorded pixels; those behind the camera are left out.
std::vector<math::Vector2> recorded_line(const capture::Camera& camera, const math::MatrixX& world_points);

}  // namespace chainsplat::tools
