// USD as text: the rope as capsules that move, for viewers and for scenes of simulators. What it is made of, and how it
// would move otherwise, is not in it.
#include <algorithm>
#include <cmath>

#include "chainsplat/export.h"
#include "parts.h"

namespace chainsplat::exports {

using math::Vector3;

namespace {

constexpr double kRestRate = 24.0;  // time codes per second where no motion says another one; USD's own
constexpr double kCodes = 1e6;      // parts of a time code that are told apart: even frames have whole ones

// A text between double quotes.
std::string quoted(const std::string& text) {
  std::string out = "\"";
  for (const char letter : core::printable(text)) {
    if (letter == '"' || letter == '\\') out += '\\';
    out += letter;
  }
  return out + "\"";
}

template <class Values>
std::string tuple(const Values& values) {
  std::string out;
  for (const double value : values) out.append(out.empty() ? "(" : ", ").append(core::exact(value + 0.0));
  return out + ")";
}

// w, x, y, z with the sign nearer to `previous`, which it becomes: not all readers go the short way between samples.
std::string quaternion(const math::Matrix3& rotation, Eigen::Quaterniond& previous) {
  Eigen::Quaterniond q = Eigen::Quaterniond(rotation).normalized();
  if (q.dot(previous) < 0.0) q.coeffs() *= -1.0;
  previous = q;
  return tuple(std::array{q.w(), q.x(), q.y(), q.z()});
}

// An attribute with one value, or with one a time.
std::string attribute(const std::string& indent, const std::string& name, const std::vector<std::string>& times,
                      const std::vector<std::string>& values) {
  if (times.empty()) return indent + name + " = " + values[0] + "\n";
  std::string out = indent + name + ".timeSamples = {\n";
  for (std::size_t k = 0; k < times.size(); ++k) out += indent + "    " + times[k] + ": " + values[k] + ",\n";
  return out + indent + "}\n";
}

// The link from its joint to its end, balls about both.
std::string capsule(const splat::Gaussians& gaussians, const chain::Chain& chain, int link, const std::string& indent) {
  const double radius = 0.5 * chain.diameter, length = chain.link_end(link) - chain.link_start(link);
  const Vector3 reach(radius, radius, radius + 0.5 * length);
  Eigen::Quaterniond turn = Eigen::Quaterniond::FromTwoVectors(Vector3::UnitZ(), chain.direction);
  Vector3 color;
  const std::array<double, 4> srgb = color_of_link(gaussians, link);
  for (int c = 0; c < 3; ++c) color[c] = linear_from_srgb(srgb[c]);
  const std::string inner = indent + "    ";
  return indent + "def Capsule \"shape\"\n" + indent + "{\n" + inner + "uniform token axis = \"Z\"\n" + inner +
         "float3[] extent = [" + tuple(Vector3(-reach)) + ", " + tuple(reach) + "]\n" + inner +
         "double height = " + core::exact(length) + "\n" + inner + "double radius = " + core::exact(radius) + "\n" +
         inner + "color3f[] primvars:displayColor = [" + tuple(color) + "]\n" + inner +
         "double3 xformOp:translate = " + tuple(Vector3(0.5 * length * chain.direction)) + "\n" + inner +
         "quatd xformOp:orient = " + quaternion(turn.toRotationMatrix(), turn) + "\n" + inner +
         "uniform token[] xformOpOrder = [\"xformOp:translate\", \"xformOp:orient\"]\n" + indent + "}\n";
}

}  // namespace

std::string usd(const twin::Twin& twin, const chain::States& motion, const trajectory::Trajectory& base) {
  const chain::Chain& chain = twin.chain;
  const int links = chain.links();

  // time codes are frames of the motion, counted from 0
  const std::size_t frames = motion.time.size();
  const double start = frames > 0 ? motion.time.front() : base.start();
  const double rate = frames > 1
                          ? std::max(1.0, std::round(static_cast<double>(frames - 1) / (motion.time.back() - start)))
                          : kRestRate;
  double last = 0.0;
  std::vector<std::string> times;
  std::vector<std::vector<std::string>> places(links), turns(links);
  std::vector<Eigen::Quaterniond> previous(links, Eigen::Quaterniond::Identity());
  for (std::size_t k = 0; k < std::max<std::size_t>(frames, 1); ++k) {
    const double time = frames > 0 ? motion.time[k] : start;
    if (frames > 0) {
      const double code = std::round((time - start) * rate * kCodes) / kCodes;
      if (!times.empty() && !(code > last)) continue;  // equal
      times.push_back(core::exact(code));
      last = code;
    }
    const math::Pose at = base.samples().empty() ? math::Pose() : base.pose(time);
    const std::vector<math::Pose> local = frames > 0 ? local_poses(chain, motion, k, at)
                                                     : local_poses(chain, math::VectorX::Zero(chain.angles()), {}, at);
    for (int j = 0; j < links; ++j) {
      places[j].push_back(tuple(local[j].translation));
      turns[j].push_back(quaternion(local[j].rotation, previous[j]));
    }
  }

  std::string out = "#usda 1.0\n(\n    doc = " +
                    quoted("The rope " + twin.provenance.capture +
                           " by chainsplat " CHAINSPLAT_VERSION ": how it moves and looks, without physics.") +
                    "\n    defaultPrim = \"rope\"\n    metersPerUnit = 1\n    upAxis = \"Z\"\n    startTimeCode = 0\n" +
                    "    endTimeCode = " + (times.empty() ? "0" : times.back()) +
                    "\n    timeCodesPerSecond = " + core::exact(rate) + "\n    framesPerSecond = " + core::exact(rate) +
                    "\n)\n\ndef Xform \"rope\" (\n    kind = \"component\"\n)\n{\n";
  std::string indent = "    ";
  for (int j = 0; j < links; ++j, indent += "    ") {
    const std::string inner = indent + "    ";
    out += indent + "def Xform \"link_" + std::to_string(j) + "\"\n" + indent + "{\n";
    // beyond the base a link keeps its place in the one before
    out += j == 0 ? attribute(inner, "double3 xformOp:translate", times, places[j])
                  : attribute(inner, "double3 xformOp:translate", {}, places[j]);
    out += attribute(inner, "quatd xformOp:orient", times, turns[j]);
    out += inner + "uniform token[] xformOpOrder = [\"xformOp:translate\", \"xformOp:orient\"]\n";
    out += capsule(twin.gaussians, chain, j, inner);
  }
  for (int j = 0; j < links; ++j) {
    indent.resize(indent.size() - 4);
    out += indent + "}\n";
  }
  return out + "}\n";
}

}  // namespace chainsplat::exports
