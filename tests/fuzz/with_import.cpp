// Files of other programs, as import reads them.
#include "importing/base_log.h"
#include "importing/calibration.h"
#include "importing/lens.h"
#include "importing/table.h"
#include "readers.h"

namespace chainsplat::fuzz {

void calibration(std::string_view bytes) {
  const Path file = folder() / "calibration.yaml";
  put(file, bytes);
  const importing::Calibration found = importing::read_calibration({file, ""}, "cam0");
  require(!found.pose || found.pose->matrix.translation.allFinite(), "a pose is finite");
  if (found.width > 0 && found.height > 0 && found.lens.fx > 1 && found.lens.fy > 1)
    importing::as_capture_lens(found.lens, found.width, found.height);
}

void pose(std::string_view bytes) {
  const Path file = folder() / "pose.txt";
  put(file, bytes);
  const math::Pose found = importing::read_pose({file, ""}, "cam0").matrix;
  require((found.rotation * found.rotation.transpose() - math::Matrix3::Identity()).norm() < 1e-6, "a rotation");
}

// images.bin, beside a cameras.bin that is whole
void colmap(std::string_view bytes) {
  std::string cameras(8, '\0');
  cameras[0] = 1;
  cameras += std::string("\1\0\0\0\1\0\0\0", 8) + std::string("\x80\2\0\0\0\0\0\0\xe0\1\0\0\0\0\0\0", 16) +
             std::string(32, '\x40');
  const Path model = folder() / "colmap";
  std::filesystem::create_directories(model);
  put(model / "cameras.bin", cameras);
  put(model / "images.bin", bytes);
  importing::read_calibration({model, ""}, "cam0");
}

void robot_log(std::string_view bytes) {
  importing::Options options;
  options.base = {folder() / "log.csv", ""};
  put(options.base.file, bytes);
  std::vector<std::string> notes;
  for (const trajectory::Sample& sample : importing::read_base_log(options, notes))
    require(sample.pose.rotation.allFinite() && std::isfinite(sample.time), "poses are finite");
}

void urdf(std::string_view bytes) {
  const Path file = folder() / "arm.urdf";
  put(file, bytes);
  const importing::Arm arm = importing::read_urdf(file, "");
  importing::forward(arm, math::VectorX::Zero(static_cast<Eigen::Index>(arm.moving().size())));
}

}  // namespace chainsplat::fuzz
