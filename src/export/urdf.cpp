// URDF: links, joints, shapes and inertias, which is all that it has of a rope. What it has no element for stands in a
// comment at the file's head, in numbers.
#include <algorithm>
#include <cmath>

#include "chainsplat/export.h"
#include "parts.h"
#include "xml_text.h"

namespace chainsplat::exports {

using math::Matrix3;
using math::Vector3;

namespace {

// URDF has one axis a joint, so that links without length stand between the axes of a joint, and one before the first.
// They cannot be without mass: Gazebo drops them, MuJoCo refuses them, PyBullet takes them for 1 kg. What they have is
// taken from the link behind, at the crossing of the axes, where it moves the same whichever of them carries it. More
// than a quarter, and what is left of a rod would no longer be a body.
constexpr double kTaken = 0.1;  // of a link's mass, by all links without length before it
// Their inertia cannot be moved so. It is added, and so small that nothing else tells.
constexpr double kTurning = 1e-6;  // of the next link's about its joint

std::string name_of(const char* kind, int number) { return kind + std::to_string(number); }

std::string origin(const Vector3& place) { return "<origin" + attribute("xyz", place) + " rpy=\"0 0 0\"/>"; }

std::string inertial(const Inertia& inertia) {
  const Matrix3& about = inertia.about;
  std::string out = "    <inertial>\n      " + origin(inertia.center) + "\n      <mass" +
                    attribute("value", inertia.mass) + "/>\n      <inertia";
  const char* const letters = "xyz";
  for (int row = 0; row < 3; ++row)
    for (int column = row; column < 3; ++column)
      out += attribute(("i" + std::string{letters[row], letters[column]}).c_str(), about(row, column) + 0.0);
  return out + "/>\n    </inertial>\n";
}

// A cylinder from the link's joint to its end, where a ball closes the gap to the next one.
std::string shapes(const chain::Chain& chain, int link) {
  const double length = chain.link_end(link) - chain.link_start(link), radius = 0.5 * chain.diameter;
  const Vector3& d = chain.direction;
  std::vector<std::string> bodies;
  if (length > 0.0) {
    const std::vector<double> turn{0.0, std::atan2(std::hypot(d.x(), d.y()), d.z()), std::atan2(d.y(), d.x())};
    bodies.push_back("<origin" + attribute("xyz", Vector3(0.5 * length * d)) + attribute("rpy", turn) +
                     "/>\n      <geometry><cylinder" + attribute("radius", radius) + attribute("length", length) +
                     "/></geometry>\n");
  }
  bodies.push_back(origin(length * d) + "\n      <geometry><sphere" + attribute("radius", radius) + "/></geometry>\n");
  std::string out;
  for (const std::string& body : bodies)
    out += "    <visual>\n      " + body + "      <material" + attribute("name", name_of("color_", link)) +
           "/>\n    </visual>\n";
  for (const std::string& body : bodies) out += "    <collision>\n      " + body + "    </collision>\n";
  return out;
}

std::string link_text(const std::string& name, const std::string& inside) {
  return "  <link" + attribute("name", name) + ">\n" + inside + "  </link>\n";
}

// The angles that move a link.
std::vector<int> angles_of(const chain::Chain& chain, int link) {
  std::vector<int> out;
  for (int k = 0; k < chain.angles(); ++k)
    if (chain.child_link[k] == link) out.push_back(k);
  return out;
}

// Links without length before this one: between the axes of its joint, and the base before the first.
int before(const chain::Chain& chain, int link) {
  return static_cast<int>(angles_of(chain, link).size()) - (link == 1 ? 0 : 1);
}

Inertia without_length(const chain::Chain& chain, const dynamics::Parameters& p, int link) {
  const double length = chain.link_end(link) - chain.link_start(link), mass = p.link_mass[link - 1];
  return {kTaken * mass / before(chain, link), Vector3::Zero(),
          std::max(kTurning * mass * length * length / 3.0, kLeastInertia) * Matrix3::Identity()};
}

// A link, less what those before it took.
Inertia rest_of(const chain::Chain& chain, const dynamics::Parameters& p, int link) {
  Inertia out = inertia_of(chain, p, link);
  if (before(chain, link) == 0) return out;
  const double mass = out.mass - kTaken * p.link_mass[link - 1];
  const Vector3 center = out.mass / mass * out.center;
  out.about += point_inertia(out.mass, out.center) - point_inertia(mass, center);
  out.mass = mass;
  out.center = center;
  return out;
}

// The joint before a link and what it moves; links without length are named by the angle that moves them.
std::string joint_and_link(const twin::Twin& twin, int link) {
  const chain::Chain& chain = twin.chain;
  const dynamics::Parameters& p = *twin.parameters;
  const std::vector<int> angles = angles_of(chain, link);
  std::string out, parent = name_of("link_", link - 1);
  Vector3 place = (chain.link_start(link) - chain.link_start(link - 1)) * chain.direction +
                  (chain.link_lift(link) - chain.link_lift(link - 1)) * chain.bending_axis;
  for (const int k : angles) {
    const bool last = k == angles.back();
    const std::string child = last ? name_of("link_", link) : name_of("cross_", k + 1);
    out += "  <joint" + attribute("name", name_of("theta_", k + 1)) + " type=\"continuous\">\n    <parent" +
           attribute("link", parent) + "/>\n    <child" + attribute("link", child) + "/>\n    " + origin(place) +
           "\n    <axis" + attribute("xyz", Vector3(chain.axes[k].head<3>())) + "/>\n    <dynamics" +
           attribute("damping", p.damping[k]) +
           attribute("friction", p.bending_friction.empty() ? 0.0 : p.bending_friction[k]) + "/>\n  </joint>\n";
    out += link_text(child, last ? inertial(rest_of(chain, p, link)) + shapes(chain, link)
                                 : inertial(without_length(chain, p, link)));
    parent = child;
    place.setZero();
  }
  return out;
}

// Gazebo's own words for the joints' stiffness.
std::string springs(const dynamics::Parameters& p) {
  std::string out;
  for (std::size_t k = 0; k < p.stiffness.size(); ++k)
    out += "  <gazebo" + attribute("reference", name_of("theta_", static_cast<int>(k) + 1)) + "><springStiffness>" +
           core::exact(p.stiffness[k]) + "</springStiffness><springReference>" + core::exact(p.rest_angle[k]) +
           "</springReference></gazebo>\n";
  return out;
}

// What the twin has and URDF has not; what is zero all along is not of the twin.
std::string left_out(const twin::Twin& twin) {
  const dynamics::Parameters& p = *twin.parameters;
  std::string out;
  const auto line = [&](const char* what, const auto& values) {
    if (std::any_of(values.begin(), values.end(), [](double value) { return value != 0.0; }))
      out += std::string("       ") + what + ": " + list(values) + "\n";
  };
  line("stiffness of the joints, N m/rad", p.stiffness);
  line("angles at rest, rad", p.rest_angle);
  line("bend over which friction builds up to what the joints have, rad", p.bending_friction_angle);
  line("torsional stiffness within the links, N m/rad a joint", p.torsional_stiffness);
  line("drag of the air across the links, N s/m", p.air_linear);
  line("quadratic drag across the links, N s^2/m^2", p.air_quadratic);
  if (p.table_normal) {
    line("the table: a point of it in the world, m", twin.table_point.value_or(Vector3::Zero()));
    line("its normal", *p.table_normal);
    if (p.table_carries_weight) out += "       it carries the weight: gravity has no part along the normal\n";
    line("its dry friction along the links, coefficients", p.coulomb_friction);
    line("its viscous friction along the links, N s/m", p.viscous_friction);
    line("levers by which it rolls the rope, m", p.roll_lever);
  }
  if (twin.initial) {
    out += "       start of the rollout, s: " + core::exact(twin.initial->time) + "\n";
    line("angles there, rad", twin.initial->theta);
    line("rates there, rad/s", twin.initial->thetadot);
    line("shares of friction in bending and rolls within the links there", twin.initial->internal_state);
  }
  return out;
}

}  // namespace

std::string urdf(const twin::Twin& twin) {
  CHAINSPLAT_CHECK(twin.parameters, twin.provenance.capture);
  const chain::Chain& chain = twin.chain;
  const dynamics::Parameters& p = *twin.parameters;
  const std::string name = escaped(twin.provenance.capture);
  std::string out =
      "<?xml version=\"1.0\"?>\n<!-- " + what_it_is(twin) +
      ".\n     link_0 is held by the gripper, its frame that of the grasp; at zero the rope is straight, along " +
      list(chain.direction) +
      ".\n     Neighboring links overlap: leave self-collision off (MuJoCo: contacts are off).\n"
      "     Links cross_K stand between the axes of one joint; they and link_0 have a tenth of the next link's mass,\n"
      "     at its joint, and nearly no inertia.\n"
      "     What else the twin has, and URDF no element for, by theta_1, ... or link_1, ... (Gazebo has springs):\n" +
      left_out(twin) + "     -->\n<robot" + attribute("name", name.empty() ? std::string("rope") : name) + ">\n";
  // MuJoCo would fold link_0 into the world, and let links touch that are neighbors but for a cross
  out += "  <mujoco>\n    <compiler fusestatic=\"false\"/>\n    <option" + attribute("gravity", gravity_felt(p)) +
         "><flag contact=\"disable\"/></option>\n  </mujoco>\n";
  for (int j = 0; j < chain.links(); ++j)
    out += "  <material" + attribute("name", name_of("color_", j)) + "><color" +
           attribute("rgba", color_of_link(twin.gaussians, j)) + "/></material>\n";
  Inertia base = without_length(chain, p, 1);
  base.center = chain.link_start(1) * chain.direction;
  out += link_text("link_0", inertial(base) + shapes(chain, 0));
  for (int j = 1; j < chain.links(); ++j) out += joint_and_link(twin, j);
  return out + springs(p) + "</robot>\n";
}

}  // namespace chainsplat::exports
