// read_back.cpp - results of the last submission, fetched by the host.
#include <algorithm>
#include <cstring>

#include "src/splat/engine.h"

namespace chainsplat::splat {

std::vector<float> Engine::State::trained(const Buffer& buffer) const {
  std::vector<float> values(training.parameter_count);
  gpu::download(device, buffer, values.data(), values.size() * sizeof(float));
  return values;
}

std::vector<ViewSums> Engine::State::sums(std::size_t chunk_views) {
  std::vector<ViewSums> out(chunk_views);
  std::vector<glm::vec4> rows(2 * chunk_tile_view.size());
  if (!rows.empty()) gpu::download(device, tile_loss, rows.data(), rows.size() * sizeof(glm::vec4));
  for (std::size_t t = 0; t < chunk_tile_view.size(); ++t) {
    ViewSums& view = out[chunk_tile_view[t]];
    view.l1 += rows[2 * t].x;
    view.mask += rows[2 * t].y;
    view.squared += rows[2 * t].z;
    view.object += rows[2 * t].w;
    view.dssim += rows[2 * t + 1].x;
  }
  return out;
}

std::vector<Picture> Engine::State::pictures(const Scene& scene, std::span<const int> chunk, bool depth) {
  std::vector<Picture> out(chunk.size());
  const auto fetch = [&](std::int64_t v) {
    const SceneView& view = scene.views[chunk[v]];
    Picture& picture = out[v];
    picture.width = view.width;
    picture.height = view.height;
    const std::size_t pixels = static_cast<std::size_t>(view.width) * view.height;
    picture.rgba.resize(4 * pixels);
    if (pixels == 0) return;
    gpu::download(device, image, picture.rgba.data(), 4 * pixels * sizeof(float), chunk_pixel[v] * sizeof(glm::vec4));
    if (depth) {
      picture.depth.resize(pixels);
      gpu::download(device, depth_image, picture.depth.data(), pixels * sizeof(float), chunk_pixel[v] * sizeof(float));
    }
    // clear the tiles that were not drawn: they hold pixels of an earlier batch
    std::vector<bool> drawn(static_cast<std::size_t>(view.tiles_x) * view.tiles_y, false);
    for (const std::uint32_t cell : view.active) drawn[cell] = true;
    for (std::size_t cell = 0; cell < drawn.size(); ++cell) {
      if (drawn[cell]) continue;
      const int x0 = static_cast<int>(cell % view.tiles_x * tile_width),
                y0 = static_cast<int>(cell / view.tiles_x * tile_height);
      const int x1 = std::min(view.width, x0 + static_cast<int>(tile_width)),
                y1 = std::min(view.height, y0 + static_cast<int>(tile_height));
      for (int y = y0; y < y1; ++y) {
        const std::size_t first = static_cast<std::size_t>(y) * view.width + x0;
        std::fill_n(picture.rgba.begin() + static_cast<std::ptrdiff_t>(4 * first), 4 * (x1 - x0), 0.0f);
        if (depth) std::fill_n(picture.depth.begin() + static_cast<std::ptrdiff_t>(first), x1 - x0, 0.0f);
      }
    }
  };
  const auto count = static_cast<std::int64_t>(chunk.size());
  if (image.mapped()) {
    core::parallel_for(count, fetch);
  } else {  // one after the other: there is one staging buffer
    for (std::int64_t v = 0; v < count; ++v) fetch(v);
  }
  return out;
}

// The device's moments are about the view's base origin, in the camera frame; the result is in world axes, about the
// world origin (mathematics.md 2.3).
std::vector<math::MatrixX> Engine::State::twists(const Scene& scene, std::span<const int> chunk) {
  std::vector<glm::vec4> rows(2 * chunk.size() * scene.links, glm::vec4(0.0f));
  if (scene.count > 0) gpu::download(device, link_twists, rows.data(), rows.size() * sizeof(glm::vec4));
  std::vector<math::MatrixX> out;
  for (std::size_t v = 0; v < chunk.size(); ++v) {
    const SceneView& view = scene.views[chunk[v]];
    const math::Matrix3 world_from_camera = view.camera_from_world.rotation.transpose();
    math::MatrixX twist = math::MatrixX::Zero(6, scene.links);
    for (int j = 0; j < scene.links && scene.count > 0; ++j) {
      const glm::vec4 m = rows[2 * (v * scene.links + j)], f = rows[2 * (v * scene.links + j) + 1];
      const math::Vector3 force = world_from_camera * math::Vector3(f.x, f.y, f.z);
      twist.col(j).head<3>() =
          world_from_camera * math::Vector3(m.x, m.y, m.z) + view.motions[0].translation.cross(force);
      twist.col(j).tail<3>() = force;
    }
    out.push_back(std::move(twist));
  }
  return out;
}

// The device's rows are about the links' starts, in the camera frame; the result is in world axes, about the world
// origin.
std::vector<ColorSums> Engine::State::colors(const Scene& scene, std::span<const int> chunk,
                                             const chain::Chain& chain) {
  const auto floats = [](const std::byte* bytes, std::size_t size) {
    std::vector<float> values(size / sizeof(float));
    std::memcpy(values.data(), bytes, size);
    return values;
  };
  // sums over slices, in double
  const std::vector<float> of_pixels = floats(read_pixel_sums, pixel_sum_bytes);
  const std::vector<float> of_links = floats(read_link_sums, link_sum_bytes);
  const auto sum = [](const std::vector<float>& all, std::size_t at, std::size_t slices, std::size_t rows) {
    math::VectorX total = math::VectorX::Zero(static_cast<Eigen::Index>(4 * rows));
    for (std::size_t k = 0; k < slices; ++k)
      total += Eigen::Map<const Eigen::VectorXf>(&all[(at * slices + k) * 4 * rows], total.size()).cast<double>();
    return total;
  };
  std::vector<ColorSums> out;
  for (std::size_t v = 0; v < chunk.size(); ++v) {
    const SceneView& view = scene.views[chunk[v]];
    ColorSums sums;

    // central moments of the colors, by the sums of color_pixels.comp (shared/color.h)
    const math::VectorX p = sum(of_pixels, v, color_push.pixel_slices, shared::kColorPixelRows);
    sums.pixels = static_cast<int>(p[5]);
    if (sums.pixels > 0) {
      const math::Vector3 drawn = p.segment<3>(8), observed = p.segment<3>(12);
      sums.covariance = p[6] - drawn.dot(observed) / sums.pixels;
      sums.drawn_variance = p[7] - drawn.squaredNorm() / sums.pixels;
      sums.seen_variance = p[11] - observed.squaredNorm() / sums.pixels;
    }

    // normal equations of each link, by the sums of color_equations.comp
    const math::Matrix3 world_from_camera = view.camera_from_world.rotation.transpose();
    for (int j = 0; j < scene.links; ++j) {
      const std::size_t at = v * scene.links + j;
      const math::VectorX s = sum(of_links, at, color_push.equation_slices, shared::kColorRows);
      const float* const exposure = &of_links[4 * shared::kColorRows * color_push.equation_slices * at];
      sums.gain = exposure[shared::kColorExposure];
      sums.bias = exposure[shared::kColorExposure + 1];
      ColorSums::Matrix8 normal;
      ColorSums::Vector8 right;
      for (int row = 0, k = shared::kColorTwist; row < 6; ++row)
        for (int column = row; column < 6; ++column, ++k) normal(row, column) = normal(column, row) = s[k];
      normal.block<6, 1>(0, 6) = s.segment<6>(shared::kColorByGain);
      normal.block<6, 1>(0, 7) = s.segment<6>(shared::kColorByBias);
      normal.block<2, 6>(6, 0) = normal.block<6, 2>(0, 6).transpose();
      const math::Vector6 e = s.segment<6>(shared::kColorGain2);
      normal.bottomRightCorner<2, 2>() << e[0], e[1], e[1], e[2];
      right << s.segment<6>(shared::kColorRight), e[3], e[4];
      sums.weight += e[2];
      sums.square += e[5];
      // to the world frame and origin: moment + start x force
      const math::Vector3 start = view.motions[j] * math::Vector3(chain.link_start(j) * chain.direction);
      ColorSums::Matrix8 world = ColorSums::Matrix8::Identity();
      world.block<3, 3>(0, 0) = world.block<3, 3>(3, 3) = world_from_camera;
      world.block<3, 3>(0, 3) = math::hat(start) * world_from_camera;
      sums.normal.emplace_back(world * normal * world.transpose());
      sums.right.emplace_back(world * right);
    }
    out.push_back(std::move(sums));
  }
  return out;
}

}  // namespace chainsplat::splat
