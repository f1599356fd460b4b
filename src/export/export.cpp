#include "chainsplat/export.h"

#include <algorithm>
#include <cctype>

#include "chainsplat/mcap.h"

namespace chainsplat::exports {

namespace {

constexpr const char* kNotIdentified = "the twin's dynamics are not identified";
constexpr const char* kIdentify = "run 'chainsplat identify'";

// NAME.xml with `what` instead of its ending: NAME_play.py.
Path beside(Path file, const std::string& what) { return file.replace_filename(file.stem().string() + what); }

void require(bool there, const Path& file, const std::string& what, const std::string& mend) {
  if (!there) throw InputError(file.string(), what, mend);
}

}  // namespace

const std::vector<std::string>& endings() {
  static const std::vector<std::string> known{".glb", ".gltf", ".ply",  ".csv", ".npz",
                                              ".xml", ".urdf", ".usda", ".mcap"};
  return known;
}

std::string ending(const Path& file) {
  std::string found = file.extension().string();
  std::transform(found.begin(), found.end(), found.begin(), [](unsigned char c) { return std::tolower(c); });
  if (std::find(endings().begin(), endings().end(), found) != endings().end()) return found;
  std::string known;
  for (const std::string& each : endings()) known += (known.empty() ? "" : ", ") + each;
  throw InputError(file.string(), found.empty() ? "has no ending" : "its ending '" + found + "' is not known",
                   "choose one of " + known);
}

std::vector<Path> files(const Path& file) {
  const std::string kind = ending(file);
  if (kind == ".csv") return {file, beside(file, ".centerline.csv")};
  if (kind == ".npz") return {file, beside(file, ".py")};
  if (kind == ".xml") return {file, beside(file, "_base.csv"), beside(file, "_play.py")};
  return {file};
}

bool for_viewers(const Path& file) {
  const std::string kind = ending(file);
  return kind == ".glb" || kind == ".gltf" || kind == ".ply";
}

void write(const twin::Twin& twin, const chain::States& motion, const trajectory::Trajectory& base, const Path& file,
           const Options& options) {
  const std::string kind = ending(file);
  if (twin.gaussians.light.known() && kind != ".npz") {
    twin::Twin baked = twin;
    baked.gaussians = with_baked_light(twin.gaussians, twin.chain, motion, base, options.cameras);
    write(baked, motion, base, file, options);
    return;
  }
  const std::vector<Path> names = files(file);
  std::vector<std::string> bytes;
  if (kind == ".mcap") {
    require(!motion.time.empty(), file, "the twin has no motion yet", "train it, or give one with `states`");
    write_mcap(twin, motion, base, file, options.capture);
    return;
  }
  if (kind == ".csv") {
    require(!motion.time.empty(), file, "the twin has no motion yet", "train it, or give one with `states`");
    const trajectory::Trajectory at_rest = trajectory::fit({trajectory::Sample{}}, "rest");
    bytes = {twin::states_csv(motion),
             twin::centerline_csv(twin.chain, motion, base.samples().empty() ? at_rest : base)};
  } else if (kind == ".npz") {
    bytes = {npz(twin, motion, base), npz_script()};
  } else if (kind == ".usda") {
    bytes = {usd(twin, motion, base)};
  } else if (kind == ".urdf") {
    require(twin.parameters.has_value(), file, kNotIdentified, kIdentify);
    bytes = {urdf(twin)};
  } else if (kind == ".xml") {
    require(twin.parameters && twin.initial, file, kNotIdentified, kIdentify);
    MujocoFiles made = mujoco(twin, base, file.stem().string());
    bytes = {std::move(made.model), std::move(made.base), std::move(made.player)};
  } else {
    require(twin.gaussians.count > 0, file, "the twin has no Gaussians yet", "recognize it first, or export .csv");
    bytes = {kind == ".ply" ? twin::gaussians_ply(twin.gaussians)
                            : gltf(twin.gaussians, twin.chain, motion, base, kind == ".glb", options)};
  }
  for (std::size_t i = 0; i < names.size(); ++i) core::write_file(names[i], bytes[i]);
}

}  // namespace chainsplat::exports
