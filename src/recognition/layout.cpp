#include "src/recognition/layout.h"

#include <cmath>

#include "chainsplat/image_model.h"

namespace chainsplat::recognition {

Layout laid_out(const Grid& grid, const capture::Capture& capture, const FrameViews& frame, int index,
                const chain::States& states) {
  const chain::Chain& chain = grid.chain;
  const double radius = 0.5 * chain.diameter;
  Layout out{std::vector<Color>(grid.size(), Color::Zero()), std::vector<float>(grid.size(), 0.0f)};
  math::Vector3 normals[kColumns];
  for (int column = 0; column < kColumns; ++column) normals[column] = grid.normal(Grid::angle(column));
  for (const int v : frame.views) {
    const capture::View view = capture::unpacked(capture.views[v]);
    const capture::Camera& camera = capture.cameras[view.camera];
    std::vector<math::Pose> motions =
        view_motions(chain, capture, states, frame, index, states.theta[index], capture.views[v]);
    const Color gain = camera.gain.cast<float>(), bias = camera.bias.cast<float>();
    const math::Pose camera_from_world = camera.world_from_camera.inverse();
    for (math::Pose& motion : motions) motion = camera_from_world * motion;
    for (int row = 0; row < grid.rows; ++row) {
      const math::Pose& motion = motions[grid.link[row]];
      const math::Vector3 axis = motion * math::Vector3(grid.arclength(row) * chain.direction);
      for (int column = 0; column < kColumns; ++column) {
        const math::Vector3 normal = motion.rotation * normals[column], point = axis + radius * normal;
        const double facing = -normal.dot(point) / point.norm();
        if (facing < kTrusted || point.z() < image_model::kNear) continue;
        const math::Vector2 pixel = capture::project(camera, point);
        const int x = static_cast<int>(std::floor(pixel.x())) - view.x0,
                  y = static_cast<int>(std::floor(pixel.y())) - view.y0;
        if (x < 0 || y < 0 || x >= view.width || y >= view.height) continue;
        const std::uint8_t* rgba = &view.rgba[4 * (static_cast<std::size_t>(y) * view.width + x)];
        if (rgba[3] < image_model::kObjectMask) continue;
        const std::size_t cell = grid.cell(row, column);
        const float counts = static_cast<float>(facing * facing);
        const Color recorded = Color(rgba[0], rgba[1], rgba[2]) / 255.0f;
        out.color[cell] += counts * (recorded - bias).cwiseQuotient(gain);
        out.weight[cell] += counts;
      }
    }
  }
  for (std::size_t cell = 0; cell < grid.size(); ++cell)
    if (out.weight[cell] > 0.0f) out.color[cell] /= out.weight[cell];
  return out;
}

MaterialColumn material_column(int column, double roll) {
  const double at = column - roll * kColumns / kTurn, floor = std::floor(at);
  const int first = ((static_cast<int>(floor) % kColumns) + kColumns) % kColumns;
  return {first, (first + 1) % kColumns, static_cast<float>(at - floor)};
}

}  // namespace chainsplat::recognition
