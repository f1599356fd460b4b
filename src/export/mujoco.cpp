// MJCF for MuJoCo, with what it takes to play it as the twin moves: the base's motion, and a player in Python that
// drives the base and adds the forces that MJCF has no law for.
#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

#include "chainsplat/export.h"
#include "parts.h"
#include "scripts.h"
#include "xml_text.h"

namespace chainsplat::exports {

using math::Matrix3;
using math::Vector3;

namespace {

constexpr double kTimestep = 1.0 / 2400.0;  // s; MuJoCo's steps are of first order: 0.002 degrees after 5 s
constexpr double kHeavy = 1e4;              // kg and kg m^2 of the base's joints: no rope moves them
constexpr double kBaseRate = 240.0;         // rows per second of the base's motion, cubic between them
// Drag comes from thin massless ellipsoids in a medium so light that nothing else of it is felt: F = density C pi r h
// |v| v.
constexpr double kDensity = 1e-3, kThin = 1e-4, kHalfLength = 0.1;  // kg/m^3, m, of a link
const std::array<std::pair<double, double>, 3> kGauss{
    {{0.5 * (1.0 - std::sqrt(0.6)), 5.0 / 18}, {0.5, 8.0 / 18}, {0.5 * (1.0 + std::sqrt(0.6)), 5.0 / 18}}};

std::array<double, 4> wxyz(const Matrix3& rotation) {
  const Eigen::Quaterniond q(rotation);
  return {q.w(), q.x(), q.y(), q.z()};
}

// The turn that takes z to a unit vector.
std::array<double, 4> turn_of_z(const Vector3& to) {
  const Eigen::Quaterniond q = Eigen::Quaterniond::FromTwoVectors(Vector3::UnitZ(), to);
  return {q.w(), q.x(), q.y(), q.z()};
}

std::string joints_of(const chain::Chain& chain, const dynamics::Parameters& p, int link, const std::string& indent) {
  std::string out;
  for (int k = 0; k < chain.angles(); ++k) {
    if (chain.child_link[k] != link) continue;
    out += indent + "<joint" + attribute("name", "theta_" + std::to_string(k + 1)) +
           attribute("axis", Vector3(chain.axes[k].head<3>())) + attribute("stiffness", p.stiffness[k]) +
           attribute("springref", p.rest_angle[k]) + attribute("damping", p.damping[k]) + "/>\n";
  }
  return out;
}

std::string body_of(const twin::Twin& twin, int link, const std::string& indent) {
  const chain::Chain& chain = twin.chain;
  const dynamics::Parameters& p = *twin.parameters;
  const double length = chain.link_end(link) - chain.link_start(link);
  const double before = link == 1 ? 0.0 : chain.link_start(link - 1);
  const Vector3 lift = (chain.link_lift(link) - chain.link_lift(link - 1)) * chain.bending_axis;
  const Inertia inertia = inertia_of(chain, p, link);
  const Matrix3& about = inertia.about;
  std::string out = indent + "<body" + attribute("name", "link_" + std::to_string(link)) +
                    attribute("pos", Vector3((chain.link_start(link) - before) * chain.direction + lift)) + ">\n";
  const std::string inner = indent + "  ";
  out += joints_of(chain, p, link, inner);
  out += inner + "<inertial" + attribute("pos", inertia.center) + attribute("mass", inertia.mass) +
         attribute("fullinertia",
                   std::array{about(0, 0), about(1, 1), about(2, 2), about(0, 1), about(0, 2), about(1, 2)}) +
         "/>\n";
  out += inner + "<geom" + attribute("type", std::string("capsule")) +
         attribute("fromto", "0 0 0 " + list(Vector3(length * chain.direction))) +
         attribute("size", 0.5 * chain.diameter) + attribute("rgba", color_of_link(twin.gaussians, link)) + "/>\n";
  for (const auto& [place, weight] : kGauss) {
    if (p.air_quadratic[link - 1] <= 0.0) break;
    const double half = kHalfLength * length;
    const double coefficient = p.air_quadratic[link - 1] * weight / (kDensity * std::numbers::pi * kThin * half);
    out += inner + "<geom" + attribute("class", std::string("drag")) +
           attribute("size", std::array{kThin, kThin, half}) +
           attribute("pos", Vector3(place * length * chain.direction)) + attribute("quat", turn_of_z(chain.direction)) +
           attribute("fluidcoef", std::array{coefficient, 0.0, 0.0, 0.0, 0.0}) + "/>\n";
  }
  return out;
}

std::string numeric(const char* name, const std::vector<double>& values) {
  return "    <numeric" + attribute("name", std::string(name)) + attribute("data", values) + "/>\n";
}

// What the player needs beside the model: the laws that MJCF does not have.
std::string custom(const twin::Twin& twin, double start) {
  const chain::Chain& chain = twin.chain;
  const dynamics::Parameters& p = *twin.parameters;
  const auto three = [](const Vector3& v) { return std::vector<double>{v.x(), v.y(), v.z()}; };
  std::vector<double> lengths, coulomb;
  for (int j = 1; j < chain.links(); ++j) lengths.push_back(chain.link_end(j) - chain.link_start(j));
  std::string out = "  <custom>\n" + numeric("start_time", {start}) + numeric("direction", three(chain.direction)) +
                    numeric("first_joint", {chain.link_start(1)}) + numeric("link_length", lengths) +
                    numeric("air_linear", p.air_linear);
  if (!p.torsional_stiffness.empty()) out += numeric("torsional_stiffness", p.torsional_stiffness);
  if (!p.bending_friction.empty()) {
    std::vector<double> shares(p.bending_friction.size(), 0.0);
    const Eigen::Index known = std::min<Eigen::Index>(twin.initial->internal_state.size(), chain.angles());
    for (Eigen::Index k = 0; k < known; ++k) shares[static_cast<std::size_t>(k)] = twin.initial->internal_state[k];
    out += numeric("bending_friction", p.bending_friction) +
           numeric("bending_friction_angle", p.bending_friction_angle) + numeric("friction_state", shares);
  }
  if (p.table_normal) {
    const double pressure = std::abs(p.gravity.dot(*p.table_normal));
    for (std::size_t j = 0; j < lengths.size(); ++j)
      coulomb.push_back(p.coulomb_friction[j] * p.link_mass[j] * pressure);
    out += numeric("table_normal", three(*p.table_normal)) + numeric("bending_axis", three(chain.bending_axis)) +
           numeric("viscous_friction", p.viscous_friction) + numeric("coulomb_force", coulomb) +
           numeric("coulomb_speed", {p.coulomb_speed});
    if (!p.roll_lever.empty()) out += numeric("roll_lever", p.roll_lever);
  }
  return out + "  </custom>\n";
}

std::string keyframe(const twin::Twin& twin, const trajectory::BaseMotion& base) {
  const Vector3 speed = base.pose.rotation * base.velocity.tail<3>();
  const auto quaternion = wxyz(base.pose.rotation);
  std::vector<double> place(base.pose.translation.begin(), base.pose.translation.end()),
      rate(speed.begin(), speed.end());
  place.insert(place.end(), quaternion.begin(), quaternion.end());
  place.insert(place.end(), twin.initial->theta.begin(), twin.initial->theta.end());
  const Vector3 turning = base.velocity.head<3>();
  rate.insert(rate.end(), turning.begin(), turning.end());
  rate.insert(rate.end(), twin.initial->thetadot.begin(), twin.initial->thetadot.end());
  return "  <keyframe>\n    <key" + attribute("name", std::string("start")) + attribute("time", twin.initial->time) +
         attribute("qpos", place) + attribute("qvel", rate) + "/>\n  </keyframe>\n";
}

std::string head(const twin::Twin& twin, const std::string& stem) {
  const dynamics::Parameters& p = *twin.parameters;
  std::string out =
      "<!-- " + what_it_is(twin) + ".\n     " + escaped(stem) + "_play.py moves the base as " + escaped(stem) +
      "_base.csv says" +
      (p.table_normal ? " and adds the table's friction,\n     which MJCF cannot say: without it the rope "
                        "slides freely. The table carries the weight"
                      : "") +
      (p.torsional_stiffness.empty() ? "" : " and lets the rope twist\n     within its links, which MJCF cannot say") +
      (p.bending_friction.empty() ? "" : " and adds friction in bending,\n     which MJCF cannot say") +
      ".\n     Contacts are off: give geoms contype and conaffinity where the rope is to touch things. -->\n";
  return out + "<mujoco" + attribute("model", escaped(twin.provenance.capture)) + ">\n" +
         "  <compiler angle=\"radian\" autolimits=\"true\" inertiafromgeom=\"false\"/>\n  <option" +
         attribute("timestep", kTimestep) + attribute("gravity", gravity_felt(p)) +
         attribute("integrator", std::string("implicitfast")) + attribute("density", kDensity) +
         attribute("viscosity", 0.0) + "/>\n" +
         "  <default>\n    <geom contype=\"0\" conaffinity=\"0\" mass=\"0\"/>\n    <default class=\"drag\">\n"
         "      <geom type=\"ellipsoid\" fluidshape=\"ellipsoid\" group=\"4\"/>\n    </default>\n  </default>\n";
}

// Rows of the player's table: time, place, speed and acceleration in the world, quaternion, turning and its rate in the
// base.
std::string base_table(const trajectory::Trajectory& base, double start) {
  std::string out = "time,px,py,pz,vx,vy,vz,ax,ay,az,qw,qx,qy,qz,wx,wy,wz,dwx,dwy,dwz\n";
  const double end = std::max(start, base.end());
  const int rows = static_cast<int>(std::ceil((end - start) * kBaseRate - 1e-9));
  Eigen::Quaterniond before(1, 0, 0, 0);
  for (int k = 0; k <= rows; ++k) {
    const double time = k == rows ? end : start + k / kBaseRate;
    const trajectory::BaseMotion at = base.at(time);
    const Vector3 turning = at.velocity.head<3>(), drift = at.velocity.tail<3>();
    const Vector3 speed = at.pose.rotation * drift;
    const Vector3 acceleration = at.pose.rotation * (at.acceleration.tail<3>() + turning.cross(drift));
    Eigen::Quaterniond q(at.pose.rotation);
    if (q.dot(before) < 0.0) q.coeffs() *= -1.0;  // one sign, since the player goes between rows by cubics
    before = q;
    out += core::exact(time);
    for (const Vector3& each : {at.pose.translation, speed, acceleration})
      for (const double x : each) out.append(",").append(core::exact(x));
    for (const double x : {q.w(), q.x(), q.y(), q.z()}) out.append(",").append(core::exact(x));
    for (const Vector3& each : {turning, Vector3(at.acceleration.head<3>())})
      for (const double x : each) out.append(",").append(core::exact(x));
    out += "\n";
  }
  return out;
}

}  // namespace

MujocoFiles mujoco(const twin::Twin& twin, const trajectory::Trajectory& base, const std::string& stem) {
  CHAINSPLAT_CHECK(twin.parameters && twin.initial, stem);
  const trajectory::Trajectory motion = base.samples().empty() ? trajectory::fit({trajectory::Sample{}}, "rest") : base;
  const double start = twin.initial->time;
  std::string out = head(twin, stem) + custom(twin, start) + "  <worldbody>\n    <light pos=\"0 -1 2\"/>\n";
  if (twin.tabletop) {
    const Vector3 normal = twin.parameters->table_normal.value_or(Vector3::UnitZ());
    out += "    <geom name=\"table\" type=\"plane\" size=\"1 1 0.1\"" +
           attribute("pos", twin.table_point.value_or(Vector3::Zero())) + attribute("quat", turn_of_z(normal)) +
           " rgba=\"0.6 0.55 0.5 1\"/>\n";
  }
  out += "    <body name=\"link_0\">\n";
  for (const char* const axis : {"x", "y", "z"})
    out += std::string("      <joint name=\"base_") + axis + "\" type=\"slide\"" +
           attribute("axis", *axis == 'x'   ? Vector3::UnitX()
                             : *axis == 'y' ? Vector3::UnitY()
                                            : Vector3::UnitZ()) +
           attribute("armature", kHeavy) + "/>\n";
  out += "      <joint name=\"base_turn\" type=\"ball\"" + attribute("armature", kHeavy) + "/>\n" +
         "      <inertial pos=\"0 0 0\" mass=\"1e-6\" diaginertia=\"1e-9 1e-9 1e-9\"/>\n" + "      <geom type=\"box\"" +
         attribute("size", Vector3(Vector3::Constant(0.6 * twin.chain.diameter))) + " rgba=\"0.5 0.5 0.5 0.5\"/>\n";
  std::string indent = "      ";
  for (int j = 1; j < twin.chain.links(); ++j, indent += "  ") out += body_of(twin, j, indent);
  for (int j = 1; j < twin.chain.links(); ++j) {
    indent.resize(indent.size() - 2);
    out += indent + "</body>\n";
  }
  out += "    </body>\n  </worldbody>\n" + keyframe(twin, motion.at(start)) + "</mujoco>\n";
  return {out, base_table(motion, start), kRopePlay};
}

}  // namespace chainsplat::exports
