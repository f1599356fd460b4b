#include "chainsplat/export.h"

#include <algorithm>
#include <cctype>

namespace chainsplat::exports {

const std::vector<std::string>& endings() {
  static const std::vector<std::string> known{".glb", ".gltf", ".ply", ".csv"};
  return known;
}

void write(const twin::Twin& twin, const chain::States& motion, const trajectory::Trajectory& base, const Path& file) {
  std::string ending = file.extension().string();
  std::transform(ending.begin(), ending.end(), ending.begin(), [](unsigned char c) { return std::tolower(c); });
  if (std::find(endings().begin(), endings().end(), ending) == endings().end()) {
    std::string known;
    for (const std::string& each : endings()) known += (known.empty() ? "" : ", ") + each;
    throw InputError(file.string(), ending.empty() ? "has no ending" : "cannot be written as '" + ending + "'",
                     "choose one of " + known);
  }
  if (ending == ".csv") {
    if (motion.time.empty())
      throw InputError(file.string(), "the twin has no motion yet", "train it, or give one with `states`");
    core::write_file(file, twin::states_csv(motion));
    const trajectory::Trajectory at_rest = trajectory::fit({trajectory::Sample{}}, "rest");
    Path centerline = file;
    centerline.replace_extension(".centerline.csv");
    core::write_file(centerline, twin::centerline_csv(twin.chain, motion, base.samples().empty() ? at_rest : base));
    return;
  }
  if (twin.gaussians.count == 0)
    throw InputError(file.string(), "the twin has no Gaussians yet", "recognize it first, or export .csv");
  core::write_file(file, ending == ".ply" ? twin::gaussians_ply(twin.gaussians)
                                          : gltf(twin.gaussians, twin.chain, motion, base, ending == ".glb"));
}

}  // namespace chainsplat::exports
