#include "chainsplat/lpips.h"

#include <algorithm>
#include <cmath>
#include <mutex>
#include <numeric>
#include <string>
#include <utility>

#include "src/core/own_library.h"
#include "src/eval/lpips_weights.h"
#include "src/eval/networks.h"
#include "src/eval/onnx.h"

namespace chainsplat::eval {

using math::Rectangle;
using networks::Map;

namespace {

// Steps of the last features in pixels, the product of the strides before them: only a crop that begins at a multiple
// has its features where the whole image has them.
constexpr int kStep = 16;
// Pixels around the object, a multiple of kStep. A pixel reaches 97 px far in the last features, and so does the crop's
// own border, which is padded by zeros and not by black. In random networks what both do to LPIPS is 0.6 % and less for
// recorded ropes; for drawn ones 0.2 %, where a margin of 64 has 1.2 % and one of 32 9 % (figures.md, 'LPIPS').
constexpr int kMargin = 80;
static_assert(kMargin % kStep == 0);

// What the networks of torchvision want, per channel of an image in [-1, 1]. LPIPS has them in this form, rounded.
constexpr std::array kShift{-0.030, -0.088, -0.188};
constexpr std::array kScale{0.458, 0.448, 0.450};
constexpr double kLeastNorm = 1e-10;  // added to norms of features, of which all channels may be 0; LPIPS's own

static_assert(static_cast<int>(std::size(kLpipsWeights)) ==
              std::accumulate(kLpipsChannels.begin(), kLpipsChannels.end(), 0));

constexpr const char* kMakeTrunk = "make it with tools/lpips_trunk";

const networks::NetworkLibrary& library() {
  static const auto& table = core::own_library<networks::NetworkLibrary>(
      "chainsplat_networks", "LPIPS needs it: install chainsplat-media, or evaluate without LPIPS");
  return table;
}

// The image's planes as the trunk wants them.
std::vector<float> planes_of(const std::vector<float>& rgb) {
  const std::size_t pixels = rgb.size() / 3;
  std::vector<float> planes(rgb.size());
  for (int c = 0; c < 3; ++c)
    for (std::size_t k = 0; k < pixels; ++k)
      planes[c * pixels + k] = static_cast<float>((2.0 * rgb[3 * k + c] - 1.0 - kShift[c]) / kScale[c]);
  return planes;
}

std::vector<double> norms_of(const Map& map) {
  std::vector<double> norms(map.positions(), 0.0);
  const float* value = map.values.data();
  for (int c = 0; c < map.channels; ++c)
    for (double& norm : norms) norm += static_cast<double>(*value) * *value, ++value;
  for (double& norm : norms) norm = std::sqrt(norm) + kLeastNorm;
  return norms;
}

// The sum over all positions of the weighted squared difference of normalized features.
double layer_sum(const Map& a, const Map& b, const float* weights) {
  const std::vector<double> a_norms = norms_of(a), b_norms = norms_of(b);
  const int positions = a.positions();
  double sum = 0.0;
  for (int c = 0; c < a.channels; ++c) {
    if (weights[c] == 0.0f) continue;
    const float *const from_a = &a.values[static_cast<std::size_t>(c) * positions],
                       *const from_b = &b.values[static_cast<std::size_t>(c) * positions];
    double channel = 0.0;
    for (int k = 0; k < positions; ++k) {
      const double difference = from_a[k] / a_norms[k] - from_b[k] / b_norms[k];
      channel += difference * difference;
    }
    sum += weights[c] * channel;
  }
  return sum;
}

std::string listed(const std::vector<Map>& maps) {
  std::string text;
  for (std::size_t k = 0; k < maps.size(); ++k) text += (k ? ", " : "") + std::to_string(maps[k].channels);
  return text;
}

}  // namespace

class LpipsTrunk {
 public:
  explicit LpipsTrunk(const Path& file) : file_(file), bytes_(core::read_file(file)) {
    check_trunk(file_, bytes_);
    idle_.push_back(library().open(file_, bytes_));
  }
  ~LpipsTrunk() {
    for (networks::Network* const network : idle_) library().close(network);
  }
  LpipsTrunk(const LpipsTrunk&) = delete;
  LpipsTrunk& operator=(const LpipsTrunk&) = delete;

  std::vector<Map> features(const std::vector<float>& rgb, int width, int height) const {
    std::vector<float> planes = planes_of(rgb);
    return with_network([&](networks::Network& network) { return library().run(network, planes, height, width); });
  }
  std::vector<Map> shapes(int width, int height) const {
    return with_network([&](networks::Network& network) { return library().shapes(network, height, width); });
  }

 private:
  // Networks keep their intermediate values: every thread that is at work has one to itself.
  template <class Work>
  std::vector<Map> with_network(const Work& work) const {
    networks::Network* network = nullptr;
    {
      const std::lock_guard guard(lock_);
      if (!idle_.empty()) {
        network = idle_.back();
        idle_.pop_back();
      }
    }
    if (!network) network = library().open(file_, bytes_);
    const auto give_back = [this](networks::Network* it) {
      const std::lock_guard guard(lock_);
      idle_.push_back(it);
    };
    const std::unique_ptr<networks::Network, decltype(give_back)> borrowed(network, give_back);
    return work(*network);
  }

  Path file_;
  std::string bytes_;
  mutable std::mutex lock_;
  mutable std::vector<networks::Network*> idle_;
};

void LpipsTrunkDeleter::operator()(LpipsTrunk* trunk) const { delete trunk; }

LpipsTrunkPtr open_lpips_trunk(const Path& file) {
  LpipsTrunkPtr trunk(new LpipsTrunk(file));
  constexpr int kSide = kLeastLpipsSide;
  const std::vector<Map> maps = trunk->features(std::vector<float>(3u * kSide * kSide, 0.5f), kSide, kSide);
  if (maps.size() != kLpipsChannels.size())
    throw InputError(file.string(),
                     "has " + std::to_string(maps.size()) + (maps.size() == 1 ? " output" : " outputs") +
                         ", not the features of five layers",
                     kMakeTrunk);
  for (std::size_t l = 0; l < maps.size(); ++l) {
    if (maps[l].channels != kLpipsChannels[l])
      throw InputError(file.string(),
                       "has features of " + listed(maps) + " channels, not AlexNet's 64, 192, 384, 256, 256",
                       kMakeTrunk);
    if (!std::all_of(maps[l].values.begin(), maps[l].values.end(), [](float v) { return std::isfinite(v); }))
      throw InputError(file.string(), "has features that are not finite", kMakeTrunk);
  }
  return trunk;
}

double lpips(const LpipsTrunk& trunk, const std::vector<float>& a_rgb, const std::vector<float>& b_rgb, int width,
             int height, int full_width, int full_height) {
  const std::size_t numbers = 3u * static_cast<std::size_t>(width) * height;
  CHAINSPLAT_CHECK(width >= kLeastLpipsSide && height >= kLeastLpipsSide && full_width >= width &&
                       full_height >= height && a_rgb.size() == numbers && b_rgb.size() == numbers,
                   std::to_string(width) + "x" + std::to_string(height));
  const std::vector<Map> a = trunk.features(a_rgb, width, height), b = trunk.features(b_rgb, width, height);
  const std::vector<Map> whole = trunk.shapes(full_width, full_height);
  double distance = 0.0;
  const float* weights = kLpipsWeights;
  for (std::size_t l = 0; l < a.size(); ++l) {
    distance += layer_sum(a[l], b[l], weights) / whole[l].positions();
    weights += kLpipsChannels[l];
  }
  return distance;
}

Rectangle lpips_crop(const Rectangle& object, int width, int height) {
  const auto down = [](int x) { return std::max(x - kMargin, 0) / kStep * kStep; };
  const auto up = [](int x, int most) { return std::min((x + kMargin + kStep - 1) / kStep * kStep, most); };
  return {down(object.x0), down(object.y0), up(object.x1, width), up(object.y1, height)};
}

}  // namespace chainsplat::eval
