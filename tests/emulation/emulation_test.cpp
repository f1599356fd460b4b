// Runs the kernels that use subgroups on the host (lanes.h, kernels.h): sorting, blending and its backward pass, and
// the sums over colors. They are laid out as the engine does for devices whose subgroups have 4 to 64 lanes, run with
// subgroups of that width and of larger ones, and compared with std::sort and the reference renderer.
#include "kernels.h"
// after kernels.h, which configures GLM
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <random>

#include "reference_renderer.h"
#include "src/splat/engine.h"

using namespace chainsplat;
namespace kernels = emulation::kernels;
using emulation::Bindings;
using emulation::Layout;
using glm::uvec2;
using glm::uvec4;
using glm::vec4;
using shared::SplatPush;
using shared::SplatTile;
using shared::SplatView;
using splat::TileLanes;
using std::uint32_t;

namespace {

constexpr uint32_t kWidths[] = {4, 8, 16, 32, 64};  // lanes per subgroup: SwiftShader, lavapipe, Intel, NVIDIA, AMD

// Tolerances for float rounding, as in splat_test.cpp.
constexpr double kImageTolerance = 2e-5, kGradientTolerance = 1e-3;

// The ways in which subgroups of `width` lanes can be laid out in a work group and run.
std::vector<Layout> layouts(uint32_t width) { return {{width, false, false}, {width, true, true}}; }

uint32_t bits(float x) {
  uint32_t out;
  std::memcpy(&out, &x, sizeof out);
  return out;
}

template <class Push>
Bindings with(const Push& push) {
  Bindings bound;
  bound.push = std::as_bytes(std::span(&push, 1));
  return bound;
}

// --- lists ----------------------------------------------------------------------------------------------------------

struct Lists {  // the output of splat_bin.comp
  std::vector<uint32_t> prefix, block, count;
  std::vector<uvec4> entries;                    // depth bits, replica, splat, instance
  std::vector<uint32_t> sorted, instance_place;  // the output of the sorting kernels
};

std::vector<uvec4> sorted_by_standard(const Lists& lists, std::size_t tile) {
  const auto first = lists.entries.begin() + lists.prefix[tile] + lists.block[0];
  std::vector<uvec4> list(first, first + lists.count[tile]);
  std::sort(list.begin(), list.end(),
            [](const uvec4& a, const uvec4& b) { return a.x != b.x ? a.x < b.x : a.y < b.y; });
  return list;
}

template <TileLanes kLaidOut>
uint32_t groups_of(uint32_t tiles) {
  return (tiles + kLaidOut.tiles - 1) / kLaidOut.tiles;
}

// Both sorting passes, as the engine dispatches them.
template <TileLanes kLaidOut>
void sort(const Layout& layout, Lists& lists, uint32_t stride) {
  const auto tiles = static_cast<uint32_t>(lists.count.size());
  SplatPush push{};
  push.tiles = tiles;
  push.tile_stride = stride;
  push.flags = shared::kFlagGradients;
  std::vector<uint32_t> counters(shared::kCounters, 0), long_tiles(tiles, 0);
  std::vector<uvec2> scratch(2 * lists.entries.size());
  lists.sorted.assign(lists.entries.size(), ~0u);
  uint32_t instances = 0;
  for (const uvec4& entry : lists.entries) instances = std::max(instances, entry.w + 1);
  lists.instance_place.assign(instances, ~0u);
  Bindings bound = with(push);
  bound.bind("tile_prefix", lists.prefix);
  bound.bind("tile_block", lists.block);
  bound.bind("tile_count", lists.count);
  bound.bind("entries", lists.entries);
  bound.bind("long_tiles", long_tiles);
  bound.bind("sorted", lists.sorted);
  bound.bind("instance_place", lists.instance_place);
  bound.bind("counters", counters);
  emulation::dispatch<kernels::SplatSort<kLaidOut.tiles * kLaidOut.sort_lanes, kLaidOut.rank_limit, kLaidOut.sort_share,
                                         kLaidOut.sort_lanes>>(layout, bound, groups_of<kLaidOut>(tiles));
  bound.bind("sort_scratch", scratch);
  if (counters[shared::kCounterLongTiles] > 0)
    emulation::dispatch<kernels::SplatSortLong<kLaidOut.sort_lanes>>(layout, bound,
                                                                     counters[shared::kCounterLongTiles]);
}

// Lists of these lengths with shuffled entries and runs of equal depths, short ones and some longer than a lane's part.
Lists random_lists(const std::vector<uint32_t>& lengths, uint32_t seed) {
  std::mt19937 random(seed);
  constexpr uint32_t kBefore = 3;  // entries of the blocks of tiles before this one
  Lists lists;
  lists.block = {kBefore};
  lists.entries.resize(kBefore);
  for (const uint32_t length : lengths) {
    lists.prefix.push_back(static_cast<uint32_t>(lists.entries.size()) - kBefore);
    lists.count.push_back(length);
    const bool long_runs = random() % 2 == 0;
    std::vector<uvec4> list;
    float depth = 0.3f;
    for (uint32_t k = 0; k < length; ++k) {
      if (random() % 4 != 0 && !(long_runs && k > length / 4 && k < length / 4 + 20)) depth += 1e-3f * (random() % 100);
      list.emplace_back(bits(depth), k, 1000 + k, static_cast<uint32_t>(lists.entries.size()) + k);
    }
    std::shuffle(list.begin(), list.end(), random);
    for (uint32_t k = 0; k < length; ++k) list[k].y = (k * 7919u) % 32771u;  // orders replicas unlike depths
    lists.entries.insert(lists.entries.end(), list.begin(), list.end());
  }
  return lists;
}

template <bool kSoftware, uint32_t kAsked>
void check_sort() {
  // where subgroups may be wider than asked for, and where they are not
  constexpr TileLanes kAny = splat::tile_lanes(8, kSoftware ? 8 : 2, kAsked, false, kSoftware);
  constexpr TileLanes kExact = splat::tile_lanes(8, kSoftware ? 8 : 2, kAsked, true, kSoftware);
  // lengths around the lanes of a work group and around the limits of sorting by rank; the latter take long
  const Lists few = random_lists({0, 1, 2, 7, 8, 31, 33, 64, 100}, kAsked);
  const Lists many = random_lists({191, 192, 193, 512, 513, 700}, kAsked);
  for (const uint32_t width : kWidths) {
    if (width < kAsked) continue;
    for (const Layout& layout : layouts(width)) {
      Lists lists = width == kAsked && layout.scattered ? many : few;
      CAPTURE(kSoftware);
      CAPTURE(kAsked);
      CAPTURE(width);
      CAPTURE(layout.scattered);
      CAPTURE(layout.backward);
      width == kAsked ? sort<kExact>(layout, lists, 5) : sort<kAny>(layout, lists, 5);
      for (std::size_t tile = 0; tile < lists.count.size(); ++tile) {
        CAPTURE(lists.count[tile]);
        const auto wanted = sorted_by_standard(lists, tile);
        const uint32_t first = lists.prefix[tile] + lists.block[0];
        bool as_wanted = true;
        for (uint32_t k = 0; k < wanted.size(); ++k)
          as_wanted =
              as_wanted && lists.sorted[first + k] == wanted[k].z && lists.instance_place[wanted[k].w] == first + k;
        CHECK(as_wanted);
      }
    }
  }
}

// --- pictures -------------------------------------------------------------------------------------------------------

using Reference = reference::Splat<double>;

struct View {
  int width, height;
  std::vector<Reference> splats;  // in any order
  std::vector<double> target;     // rgba
};

// A view with splats from faint to opaque, few of which are small, and a target.
View random_view(int width, int height, int count, uint32_t seed) {
  std::mt19937 generator(seed);
  const auto uniform = [&](double from, double to) {
    return from + (to - from) * std::generate_canonical<double, 32>(generator);
  };
  View view{width, height, {}, {}};
  for (int k = 0; k < count; ++k) {
    Reference s;
    s.replica = k;
    s.center = {static_cast<float>(uniform(-2.0, width + 2.0)), static_cast<float>(uniform(-2.0, height + 2.0))};
    const double a = uniform(0.6, 4.0), b = uniform(0.6, 4.0), turn = uniform(0.0, 3.1);  // px, half axes and direction
    const double c = std::cos(turn), d = std::sin(turn);
    const double xx = c * c * a * a + d * d * b * b + 0.3, yy = d * d * a * a + c * c * b * b + 0.3,
                 xy = c * d * (a * a - b * b), determinant = xx * yy - xy * xy;
    s.conic = {static_cast<float>(yy / determinant), static_cast<float>(-xy / determinant),
               static_cast<float>(xx / determinant)};
    const double inverse = s.conic[0] * s.conic[2] - s.conic[1] * s.conic[1];
    s.covariance = {s.conic[2] / inverse, -s.conic[1] / inverse, s.conic[0] / inverse};
    for (double& x : s.color) x = static_cast<float>(uniform(0.0, 1.2));
    s.opacity = static_cast<float>(k % 5 == 0 ? uniform(0.9, 0.995) : uniform(0.02, 0.9));
    s.depth = static_cast<float>(uniform(0.3, 0.4));
    view.splats.push_back(s);
  }
  for (int k = 0; k < 4 * width * height; ++k) view.target.push_back(static_cast<int>(uniform(0.0, 256.0)) / 255.0);
  return view;
}

std::vector<Reference> in_order(std::vector<Reference> splats) {
  std::stable_sort(splats.begin(), splats.end(), [](const auto& a, const auto& b) { return a.depth < b.depth; });
  return splats;
}

// Views whose pixels are all away from the rules' thresholds, where float and double may differ (reference::Doubt).
std::vector<View> clear_views(int count) {
  constexpr int kSizes[][2] = {{13, 11}, {20, 9}};  // not multiples of a tile
  std::vector<View> views;
  uint32_t seed = 0;
  for (const auto& size : kSizes) {
    for (;;) {
      View view = random_view(size[0], size[1], count, ++seed);
      if (reference::picture(in_order(view.splats), view.width, view.height, {}).doubtful_count() > 0) continue;
      views.push_back(std::move(view));
      break;
    }
  }
  return views;
}

constexpr float kL1 = 0.7f, kMask = 0.4f;

struct Wanted {
  std::vector<reference::Picture> pictures;                 // per view
  std::vector<std::vector<std::array<double, 9>>> partial;  // per view and splat, in the order of a partial's floats
};

// Stands for the output of the D-SSIM passes at a pixel.
vec4 dssim_gradient(std::size_t view, int x, int y) {
  return {0.3f * std::sin(static_cast<float>(x + 2 * y) + view), 0.2f * std::cos(static_cast<float>(3 * x - y)), -0.1f,
          0};
}

bool has_dssim(int tile_x) { return tile_x == 0; }

Wanted wanted_of(const std::vector<View>& views, int tile) {
  using reference::independent;
  using reference::Variable;
  reference::Tape& tape = reference::tape();
  Wanted wanted;
  for (std::size_t v = 0; v < views.size(); ++v) {
    const View& view = views[v];
    const std::vector<Reference> ordered = in_order(view.splats);
    wanted.pictures.push_back(reference::picture(ordered, view.width, view.height, {}));
    const std::size_t bottom = tape.size();
    std::vector<reference::Splat<Variable>> splats;
    for (const Reference& s : ordered) {
      reference::Splat<Variable> on;
      on.replica = s.replica;
      for (int k = 0; k < 2; ++k) on.center[k] = independent(s.center[k]);
      for (int k = 0; k < 3; ++k) on.covariance[k] = independent(s.covariance[k]);
      for (int k = 0; k < 3; ++k) on.color[k] = independent(s.color[k]);
      on.opacity = independent(s.opacity);
      on.depth = s.depth;
      splats.push_back(on);
    }
    const std::size_t conics = tape.size();
    for (auto& s : splats) {
      const auto& c = s.covariance;
      const Variable determinant = c[0] * c[2] - c[1] * c[1];
      s.conic = {c[2] / determinant, -c[1] / determinant, c[0] / determinant};
    }
    const std::size_t top = tape.size();
    for (int y = 0; y < view.height; ++y) {
      for (int x = 0; x < view.width; ++x) {
        const std::size_t at = static_cast<std::size_t>(y) * view.width + x;
        const auto sign = [&](int c) {
          const double error = wanted.pictures[v].rgba[4 * at + c] - view.target[4 * at + c];
          return error > 0.0 ? 1.0 : error < 0.0 ? -1.0 : 0.0;
        };
        const auto pixel = reference::blend(splats, x + 0.5, y + 0.5, reference::Rules{});
        const vec4 more = has_dssim(x / tile) ? dssim_gradient(v, x, y) : vec4(0);
        for (int c = 0; c < 3; ++c) tape.add(pixel.color[c].index, kL1 * sign(c) + more[c]);
        tape.add(pixel.alpha.index, kMask * sign(3));
        tape.sweep(top);
      }
    }
    tape.sweep(conics);
    std::vector<std::array<double, 9>> partial(splats.size());
    for (const auto& s : splats) {
      const auto by = [&](const Variable& x) { return tape.adjoint(x.index); };
      // partials hold 2 dL/dSigma'; the tape's derivative by xy already contains both entries xy and yx
      partial[s.replica] = {by(s.center[0]),         by(s.center[1]),         by(s.opacity),
                            by(s.color[0]),          2 * by(s.covariance[0]), by(s.covariance[1]),
                            2 * by(s.covariance[2]), by(s.color[1]),          by(s.color[2])};
    }
    wanted.partial.push_back(std::move(partial));
    tape.forget(bottom);
  }
  return wanted;
}

// The device's buffers for some views; every splat is in the list of every tile of its view.
struct Scene {
  std::vector<SplatTile> tiles;
  std::vector<SplatView> views;
  std::vector<vec4> splats;
  std::vector<uint32_t> targets;
  std::vector<vec4> dssim;
  Lists lists;
  std::vector<std::size_t> first_pixel, first_splat;  // per view
  std::vector<std::size_t> splat_of_instance;
  uint32_t near_tiles = 0, pixels = 0;
};

Scene scene_of(const std::vector<View>& views, int tile) {
  Scene s;
  std::mt19937 random(7);
  for (std::size_t v = 0; v < views.size(); ++v) {
    const View& view = views[v];
    SplatView placed{};
    placed.width = static_cast<uint32_t>(view.width);
    placed.height = static_cast<uint32_t>(view.height);
    placed.tiles_x = static_cast<uint32_t>((view.width + tile - 1) / tile);
    placed.tiles_y = static_cast<uint32_t>((view.height + tile - 1) / tile);
    placed.pixel = placed.target = s.pixels;
    s.first_pixel.push_back(s.pixels);
    s.pixels += placed.width * placed.height;
    for (int y = 0; y < view.height; ++y)
      for (int x = 0; x < view.width; ++x) s.dssim.push_back(dssim_gradient(v, x, y));
    s.first_splat.push_back(s.splats.size() / shared::kSplatRows);
    for (const Reference& r : view.splats) {
      s.splats.emplace_back(r.center[0], r.center[1], r.opacity, r.depth);
      s.splats.emplace_back(r.conic[0], r.conic[1], r.conic[2], 0.0f);
      s.splats.emplace_back(r.color[0], r.color[1], r.color[2], 0.0f);
    }
    for (std::size_t k = 0; k < view.target.size(); k += 4) {
      uint32_t packed = 0;
      for (std::size_t c = 0; c < 4; ++c)
        packed |= static_cast<uint32_t>(std::lround(255.0 * view.target[k + c])) << (8 * c);
      s.targets.push_back(packed);
    }
    s.views.push_back(placed);
  }
  for (const bool near : {true, false})  // those with a D-SSIM term first
    for (uint32_t v = 0; v < views.size(); ++v)
      for (uint32_t y = 0; y < s.views[v].tiles_y; ++y)
        for (uint32_t x = 0; x < s.views[v].tiles_x; ++x)
          if (has_dssim(static_cast<int>(x)) == near) {
            s.tiles.push_back({v, x, y, 0});
            s.near_tiles += near ? 1 : 0;
          }
  s.lists.block = {0};
  for (const SplatTile& t : s.tiles) {
    const std::size_t first = s.first_splat[t.view];
    s.lists.prefix.push_back(static_cast<uint32_t>(s.lists.entries.size()));
    s.lists.count.push_back(static_cast<uint32_t>(views[t.view].splats.size()));
    for (std::size_t k = 0; k < views[t.view].splats.size(); ++k) {
      const auto instance = static_cast<uint32_t>(s.splat_of_instance.size());
      s.lists.entries.emplace_back(bits(static_cast<float>(views[t.view].splats[k].depth)), k, first + k, instance);
      s.splat_of_instance.push_back(first + k);
    }
    std::shuffle(s.lists.entries.begin() + s.lists.prefix.back(), s.lists.entries.end(), random);
  }
  return s;
}

struct Drawn {
  std::vector<vec4> image;
  std::vector<float> depth, partials;
};

// Sorting, blending and its backward pass, as the engine specializes and dispatches them.
template <TileLanes kLaidOut, uint32_t kTile, uint32_t kPixels, uint32_t kDepth>
Drawn draw(const Layout& layout, Scene& scene) {
  const auto tiles = static_cast<uint32_t>(scene.tiles.size());
  SplatPush push{};
  push.tiles = tiles;
  push.tile_stride = tiles > 1 ? tiles - 1 : 1;
  push.slots = kLaidOut.slots;
  push.near_tiles = scene.near_tiles;
  push.flags = shared::kFlagGradients;
  push.weight_l1 = kL1;
  push.weight_mask = kMask;
  push.weight_dssim = 1.0f;
  sort<kLaidOut>(layout, scene.lists, push.tile_stride);
  Drawn out;
  out.image.assign(scene.pixels, vec4(-1));
  out.depth.assign(scene.pixels, -1.0f);
  // fill with a value that cannot pass for a sum that a lane has written
  out.partials.assign(shared::kPartial * kLaidOut.slots * scene.splat_of_instance.size(), NAN);
  std::vector<uint32_t> counters(shared::kCounters, 0), used(tiles, 0);
  Bindings bound = with(push);
  bound.bind("tiles", scene.tiles);
  bound.bind("views", scene.views);
  bound.bind("tile_prefix", scene.lists.prefix);
  bound.bind("tile_block", scene.lists.block);
  bound.bind("tile_count", scene.lists.count);
  bound.bind("sorted", scene.lists.sorted);
  bound.bind("splats", scene.splats);
  bound.bind("counters", counters);
  bound.bind("image", out.image);
  bound.bind("tile_used", used);
  bound.bind("depth_image", out.depth);
  emulation::dispatch<
      kernels::SplatBlend<kLaidOut.tiles * kLaidOut.lanes, kTile, kTile, kPixels, 1u, kDepth, kLaidOut.share>>(
      layout, bound, groups_of<kLaidOut>(tiles));
  bound.bind("target", scene.targets);
  bound.bind("pixel_gradient", scene.dssim);
  bound.bind("partials", out.partials);
  emulation::dispatch<kernels::SplatBlendBackward<kLaidOut.tiles * kLaidOut.lanes, kTile, kTile, kPixels, 1u,
                                                  kLaidOut.subgroup, kLaidOut.share>>(layout, bound,
                                                                                      groups_of<kLaidOut>(tiles));
  return out;
}

// Sums the partials as splat_project_backward.comp does.
std::vector<std::array<double, 9>> summed(const Scene& scene, const Drawn& drawn, uint32_t slots) {
  std::vector<std::array<double, 9>> out(scene.splats.size() / shared::kSplatRows);
  for (std::size_t k = 0; k < scene.splat_of_instance.size(); ++k)
    for (std::size_t slot = 0; slot < slots; ++slot)
      for (std::size_t m = 0; m < shared::kPartial; ++m)
        out[scene.splat_of_instance[k]][m] +=
            drawn.partials[shared::kPartial * (slots * scene.lists.instance_place[k] + slot) + m];
  return out;
}

struct Inputs {
  std::vector<View> views = clear_views(40);
  Wanted small = wanted_of(views, 8), large = wanted_of(views, 16);
};
const Inputs& inputs() {
  static const Inputs made;
  return made;
}

template <bool kSoftware, uint32_t kTile, uint32_t kPixels, uint32_t kAsked>
void check_pictures() {
  constexpr TileLanes kAny = splat::tile_lanes(kTile, kPixels, kAsked, false, kSoftware);
  constexpr TileLanes kExact = splat::tile_lanes(kTile, kPixels, kAsked, true, kSoftware);
  constexpr uint32_t kDepth = kSoftware ? 1 : 0;
  const Wanted& wanted = kTile == 8 ? inputs().small : inputs().large;
  Scene scene = scene_of(inputs().views, kTile);
  Drawn first;
  for (const uint32_t width : kWidths) {
    if (width < kAsked) continue;
    for (const Layout& layout : layouts(width)) {
      CAPTURE(kSoftware);
      CAPTURE(kTile);
      CAPTURE(kAsked);
      CAPTURE(width);
      CAPTURE(layout.scattered);
      CAPTURE(layout.backward);
      const Drawn drawn = width == kAsked ? draw<kExact, kTile, kPixels, kDepth>(layout, scene)
                                          : draw<kAny, kTile, kPixels, kDepth>(layout, scene);
      if (first.image.empty()) first = drawn;
      CHECK(drawn.image == first.image);  // one lane computes a pixel, whatever its subgroup
      double worst = 0.0;
      for (std::size_t v = 0; v < scene.views.size(); ++v) {
        const reference::Picture& picture = wanted.pictures[v];
        for (std::size_t k = 0; k < picture.depth.size(); ++k) {
          const std::size_t at = scene.first_pixel[v] + k;
          for (int c = 0; c < 4; ++c)
            worst = std::max(worst, std::abs(static_cast<double>(drawn.image[at][c]) - picture.rgba[4 * k + c]));
          if (kDepth) worst = std::max(worst, std::abs(drawn.depth[at] - picture.depth[k]));
        }
      }
      CHECK(worst <= kImageTolerance);
      const auto sums = summed(scene, drawn, kAny.slots);
      for (std::size_t m = 0; m < 9; ++m) {
        CAPTURE(m);
        double largest = 0.0, error = 0.0;
        for (std::size_t v = 0; v < scene.views.size(); ++v) {
          for (std::size_t k = 0; k < wanted.partial[v].size(); ++k) {
            const double got = sums[scene.first_splat[v] + k][m], want = wanted.partial[v][k][m];
            largest = std::max(largest, std::abs(want));
            error = std::max(error, std::isfinite(got) ? std::abs(got - want) : INFINITY);
          }
        }
        CHECK(error <= kGradientTolerance * largest);
      }
    }
  }
}

// --- sums over colors -----------------------------------------------------------------------------------------------

// A rope of three links across a view of whole tiles, drawn and observed.
struct Colors {
  static constexpr uint32_t kWidth = 24, kHeight = 16, kTile = 8, kLinks = 3;
  std::vector<SplatTile> tiles;
  std::vector<SplatView> views{1};
  std::vector<shared::ColorView> color_views{1};
  std::vector<vec4> segments, image;
  std::vector<float> depth;
  std::vector<uint32_t> target;

  Colors() {
    std::mt19937 random(3);
    const auto uniform = [&] { return static_cast<float>(random() % 10000) / 10000.0f; };
    views[0].intrinsics = {60.0f, 62.0f, 12.3f, 7.6f};
    views[0].width = kWidth;
    views[0].height = kHeight;
    for (uint32_t y = 0; y < kHeight / kTile; ++y)
      for (uint32_t x = 0; x < kWidth / kTile; ++x) tiles.push_back({0, x, y, 0});
    color_views[0].tiles = static_cast<uint32_t>(tiles.size());
    for (uint32_t j = 0; j < kLinks; ++j) {
      const float length = 0.05f;
      segments.emplace_back(-0.075f + length * j, 0.004f * j, 0.4f, length);
      segments.emplace_back(1.0f, 0.0f, 0.0f, 0.0f);
    }
    for (uint32_t k = 0; k < kWidth * kHeight; ++k) {
      image.emplace_back(uniform(), uniform(), uniform(), k % 11 == 0 ? 0.5f : 0.99f);
      depth.push_back(0.38f + 0.02f * uniform());
      const uint32_t mask = k % kWidth == 17 && k / kWidth == 3 ? 0u : 255u;
      target.push_back(random() % (1u << 24) | mask << 24);
    }
  }
};

struct ColorResult {
  std::vector<double> pixel_sums, link_sums;  // over slices
};

template <TileLanes kLaidOut>
ColorResult color_sums(const Layout& layout, Colors& scene) {
  constexpr uint32_t kTile = Colors::kTile, kLanes = kLaidOut.color_lanes;
  const shared::ColorPush push{Colors::kLinks, 2, 2, 0};  // slices
  std::vector<uint32_t> tile_pixels(Colors::kWidth * Colors::kHeight);
  std::vector<uvec2> summary(scene.tiles.size());
  std::vector<vec4> pixel_sums(shared::kColorPixelRows * push.pixel_slices);
  std::vector<float> link_sums(4 * shared::kColorRows * push.equation_slices * push.links, NAN);
  Bindings bound = with(push);
  bound.bind("tiles", scene.tiles);
  bound.bind("views", scene.views);
  bound.bind("color_views", scene.color_views);
  bound.bind("segments", scene.segments);
  bound.bind("image", scene.image);
  bound.bind("depth_image", scene.depth);
  bound.bind("target", scene.target);
  bound.bind("tile_pixels", tile_pixels);
  bound.bind("tile_summary", summary);
  bound.bind("pixel_sums", pixel_sums);
  bound.bind("link_sums", link_sums);
  emulation::dispatch<kernels::ColorPixels<kLanes, kTile, kTile, kLanes, kLaidOut.color_columns, kLaidOut.color_rows>>(
      layout, bound, push.pixel_slices);
  emulation::dispatch<kernels::ColorEquations<kLanes, kTile, kTile, kLanes>>(layout, bound, push.links,
                                                                             push.equation_slices);
  ColorResult out{std::vector<double>(4 * shared::kColorPixelRows), {}};
  for (std::size_t k = 0; k < 4 * pixel_sums.size(); ++k)
    out.pixel_sums[k % out.pixel_sums.size()] += pixel_sums[k / 4][static_cast<int>(k % 4)];
  constexpr std::size_t kRow = 4 * shared::kColorRows;
  out.link_sums.resize(kRow * push.links);
  for (std::size_t k = 0; k < link_sums.size(); ++k)
    out.link_sums[k / (kRow * push.equation_slices) * kRow + k % kRow] += link_sums[k];
  return out;
}

void check_close(const std::vector<double>& got, const std::vector<double>& wanted) {
  REQUIRE(got.size() == wanted.size());
  double largest = 0.0, worst = 0.0;
  for (std::size_t k = 0; k < got.size(); ++k) {
    largest = std::max(largest, std::abs(wanted[k]));
    worst = std::max(worst, std::isfinite(got[k]) ? std::abs(got[k] - wanted[k]) : INFINITY);
  }
  constexpr double kRounding = 1e-6;  // for sums of a few hundred floats
  CHECK(worst <= kRounding * largest);
}

template <uint32_t kAsked>
void check_colors(const ColorResult& wanted) {
  constexpr TileLanes kLaidOut = splat::tile_lanes(Colors::kTile, 2, kAsked, false, false);
  Colors scene;
  for (const uint32_t width : kWidths) {
    if (width < kAsked) continue;
    for (const Layout& layout : layouts(width)) {
      CAPTURE(kAsked);
      CAPTURE(width);
      CAPTURE(layout.scattered);
      CAPTURE(layout.backward);
      const ColorResult got = color_sums<kLaidOut>(layout, scene);
      CHECK(got.pixel_sums[5] == wanted.pixel_sums[5]);  // how many pixels
      check_close(got.pixel_sums, wanted.pixel_sums);
      check_close(got.link_sums, wanted.link_sums);
    }
  }
}

}  // namespace

TEST_CASE("prefix sums over subgroups of any width") {
  constexpr uint32_t kCount = 300;
  std::vector<uint32_t> values(kCount), wanted(kCount);
  for (uint32_t k = 0; k < kCount; ++k) values[k] = k * k % 37;
  std::partial_sum(values.begin(), values.end(), wanted.begin());
  for (const uint32_t width : kWidths) {
    for (const bool backward : {false, true}) {
      std::vector<uint32_t> prefix(kCount, 0), size(1, 0);
      Bindings bound = with(kCount);
      bound.bind("values", values);
      bound.bind("prefix", prefix);
      bound.bind("size", size);
      emulation::dispatch<kernels::TestPrefix<128u>>({width, false, backward}, bound, 1);
      CHECK(prefix == wanted);
      CHECK(size[0] == width);
    }
  }
}

TEST_CASE("lists are sorted as by std::sort, whatever the subgroups") {
  check_sort<true, 4>();
  check_sort<true, 8>();
  check_sort<true, 16>();
  check_sort<false, 4>();
  check_sort<false, 8>();
  check_sort<false, 16>();
  check_sort<false, 32>();
  check_sort<false, 64>();
}

TEST_CASE("blending and its backward pass equal the reference, laid out as on a software device") {
  check_pictures<true, 8, 8, 4>();
  check_pictures<true, 8, 8, 8>();
  check_pictures<true, 8, 8, 16>();
  check_pictures<true, 16, 4, 8>();
}

TEST_CASE("blending and its backward pass equal the reference, laid out as on a GPU") {
  check_pictures<false, 8, 2, 4>();
  check_pictures<false, 8, 2, 8>();
  check_pictures<false, 8, 2, 16>();
  check_pictures<false, 8, 2, 32>();
  check_pictures<false, 8, 2, 64>();
  check_pictures<false, 16, 4, 4>();
  check_pictures<false, 16, 4, 32>();
  check_pictures<false, 16, 4, 64>();
}

// Compares subgroup widths with each other only; splat_colors_test.cpp compares the available device with the host.
TEST_CASE("sums over colors do not depend on the subgroups") {
  Colors scene;
  const ColorResult narrow = color_sums<splat::tile_lanes(Colors::kTile, 2, 4, false, false)>({4, false, false}, scene);
  CHECK(narrow.pixel_sums[5] > 50);
  check_colors<4>(narrow);
  check_colors<8>(narrow);
  check_colors<16>(narrow);
  check_colors<32>(narrow);
  check_colors<64>(narrow);
}
