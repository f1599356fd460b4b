// Networks with OpenCV's dnn.
#include "src/eval/networks.h"

#include <algorithm>
#include <exception>
#include <memory>
#include <mutex>
#include <opencv2/core.hpp>
#include <opencv2/core/utils/logger.hpp>
#include <opencv2/dnn.hpp>

namespace chainsplat::eval::networks {

struct Network {
  Path file;
  cv::dnn::Net net;
  std::vector<cv::String> outputs;  // names, in the file's order
};

namespace {

constexpr int kColors = 3;

// As long as one lives, OpenCV writes no lines to standard error and works on the thread that calls it. Both are
// settings of the whole process, which gets its own back when the last is gone.
class Quietly {
 public:
  Quietly() {
    const std::lock_guard guard(lock);
    if (users++ > 0) return;
    level = cv::utils::logging::setLogLevel(cv::utils::logging::LOG_LEVEL_SILENT);
    threads = cv::getNumThreads();
    if (threads != 1) cv::setNumThreads(1);
  }
  ~Quietly() {
    const std::lock_guard guard(lock);
    if (--users > 0) return;
    if (threads != 1) cv::setNumThreads(threads);
    cv::utils::logging::setLogLevel(level);
  }
  Quietly(const Quietly&) = delete;
  Quietly& operator=(const Quietly&) = delete;

 private:
  static inline std::mutex lock;
  static inline int users = 0, threads = 1;  // threads, level: the process's own
  static inline cv::utils::logging::LogLevel level;
};

// What OpenCV says, without the place in its own sources.
std::string reason(const std::exception& error) {
  const auto* const of_opencv = dynamic_cast<const cv::Exception*>(&error);
  std::string text = of_opencv ? of_opencv->err : error.what();
  std::replace(text.begin(), text.end(), '\n', ' ');
  while (!text.empty() && text.back() == ' ') text.pop_back();
  return text;
}

Network* open(const Path& file, const std::string& bytes) {
  const Quietly quietly;
  auto network = std::make_unique<Network>();
  network->file = file;
  try {
    network->net = cv::dnn::readNetFromONNX(bytes.data(), bytes.size());
    network->net.setPreferableBackend(cv::dnn::DNN_BACKEND_OPENCV);
    network->net.setPreferableTarget(cv::dnn::DNN_TARGET_CPU);
    network->outputs = network->net.getUnconnectedOutLayersNames();
  } catch (const std::exception& error) {
    throw InputError(file.string(), "is no network that OpenCV reads (" + reason(error) + ")",
                     "name a file in ONNX's format");
  }
  return network.release();
}

void close(Network* network) { delete network; }

[[noreturn]] void refuse(const Network& network, int height, int width, const std::string& why) {
  throw InputError(
      network.file.string(),
      "takes no image of " + std::to_string(width) + "x" + std::to_string(height) + " pixels in color (" + why + ")",
      "name a network that takes images of any size");
}

std::vector<Map> run(Network& network, std::vector<float>& planes, int height, int width) {
  CHAINSPLAT_CHECK(planes.size() == static_cast<std::size_t>(kColors) * height * width, network.file.string());
  const Quietly quietly;
  std::vector<Map> maps;
  try {
    const int sides[] = {1, kColors, height, width};
    network.net.setInput(cv::Mat(4, sides, CV_32F, planes.data()));
    std::vector<cv::Mat> outputs;
    network.net.forward(outputs, network.outputs);
    for (const cv::Mat& output : outputs) {
      if (output.dims != 4 || output.size[0] != 1 || output.type() != CV_32F || !output.isContinuous())
        refuse(network, height, width, "an output is no image");
      const auto* const values = output.ptr<float>();
      maps.push_back({output.size[1], output.size[2], output.size[3], {values, values + output.total()}});
    }
  } catch (const cv::Exception& error) {
    refuse(network, height, width, reason(error));
  }
  return maps;
}

std::vector<Map> shapes(Network& network, int height, int width) {
  const Quietly quietly;
  std::vector<Map> maps;
  try {
    for (const cv::String& name : network.outputs) {
      std::vector<cv::dnn::MatShape> in, out;
      network.net.getLayerShapes({1, kColors, height, width}, network.net.getLayerId(name), in, out);
      if (out.size() != 1 || out[0].size() != 4) refuse(network, height, width, "an output is no image");
      maps.push_back({out[0][1], out[0][2], out[0][3], {}});
    }
  } catch (const cv::Exception& error) {
    refuse(network, height, width, reason(error));
  }
  return maps;
}

}  // namespace

const NetworkLibrary chainsplat_networks = {
    .version = CHAINSPLAT_VERSION, .open = open, .close = close, .run = run, .shapes = shapes};

}  // namespace chainsplat::eval::networks
