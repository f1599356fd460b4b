#include "chainsplat/export.h"

#include <algorithm>
#include <cctype>

#include "chainsplat/mcap.h"

namespace chainsplat::exports {

namespace {

// The ending in lower case. Throws InputError for one that is not known.
std::string ending_of(const Path& file) {
  std::string ending = file.extension().string();
  std::transform(ending.begin(), ending.end(), ending.begin(), [](unsigned char c) { return std::tolower(c); });
  if (std::find(endings().begin(), endings().end(), ending) != endings().end()) return ending;
  std::string known;
  for (const std::string& each : endings()) known += (known.empty() ? "" : ", ") + each;
  throw InputError(file.string(), ending.empty() ? "has no ending" : "its ending '" + ending + "' is not known",
                   "choose one of " + known);
}

// NAME.xml with `what` instead of its ending: NAME_play.py.
Path beside(Path file, const std::string& what) { return file.replace_filename(file.stem().string() + what); }

void require(bool there, const Path& file, const std::string& what, const std::string& mend) {
  if (!there) throw InputError(file.string(), what, mend);
}

}  // namespace

const std::vector<std::string>& endings() {
  static const std::vector<std::string> known{".glb", ".gltf", ".ply", ".csv", ".npz", ".xml", ".mcap"};
  return known;
}

std::vector<Path> files(const Path& file) {
  const std::string ending = ending_of(file);
  if (ending == ".csv") return {file, beside(file, ".centerline.csv")};
  if (ending == ".npz") return {file, beside(file, ".py")};
  if (ending == ".xml") return {file, beside(file, "_base.csv"), beside(file, "_play.py")};
  return {file};
}

bool for_viewers(const Path& file) {
  const std::string ending = ending_of(file);
  return ending == ".glb" || ending == ".gltf" || ending == ".ply";
}

void write(const twin::Twin& twin, const chain::States& motion, const trajectory::Trajectory& base, const Path& file,
           const Options& options) {
  const std::string ending = ending_of(file);
  const std::vector<Path> names = files(file);
  std::vector<std::string> bytes;
  if (ending == ".mcap") {
    require(!motion.time.empty(), file, "the twin has no motion yet", "train it, or give one with `states`");
    write_mcap(twin, motion, base, file, options.capture);
    return;
  }
  if (ending == ".csv") {
    require(!motion.time.empty(), file, "the twin has no motion yet", "train it, or give one with `states`");
    const trajectory::Trajectory at_rest = trajectory::fit({trajectory::Sample{}}, "rest");
    bytes = {twin::states_csv(motion),
             twin::centerline_csv(twin.chain, motion, base.samples().empty() ? at_rest : base)};
  } else if (ending == ".npz") {
    bytes = {npz(twin, motion, base), npz_script()};
  } else if (ending == ".xml") {
    require(twin.parameters && twin.initial, file, "the twin's dynamics are not identified",
            "run 'chainsplat identify'");
    MujocoFiles made = mujoco(twin, base, file.stem().string());
    bytes = {std::move(made.model), std::move(made.base), std::move(made.player)};
  } else {
    require(twin.gaussians.count > 0, file, "the twin has no Gaussians yet", "recognize it first, or export .csv");
    bytes = {ending == ".ply" ? twin::gaussians_ply(twin.gaussians)
                              : gltf(twin.gaussians, twin.chain, motion, base, ending == ".glb", options)};
  }
  for (std::size_t i = 0; i < names.size(); ++i) core::write_file(names[i], bytes[i]);
}

}  // namespace chainsplat::exports
