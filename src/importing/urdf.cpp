// Forward kinematics of a serial arm. A joint's pose is its origin in the parent link, then the turn or slide along its
// axis; rpy are turns about fixed x, y and z, in this order.
#include <tinyxml2.h>

#include <algorithm>
#include <map>
#include <set>

#include "base_log.h"
#include "document.h"

namespace chainsplat::importing {

namespace {

using tinyxml2::XMLElement;

constexpr int kMostJoints = 1000;

math::Vector3 triple(const char* text, const std::string& where) {
  math::Vector3 out = math::Vector3::Zero();
  std::string_view rest = text ? text : "0 0 0";
  for (int i = 0; i < 3; ++i) {
    const std::size_t from = std::min(rest.find_first_not_of(" \t\r\n"), rest.size());
    rest.remove_prefix(from);
    const std::size_t end = std::min(rest.find_first_of(" \t\r\n"), rest.size());
    const auto value = number_of(rest.substr(0, end));
    if (!value) throw InputError(where, "is no three numbers", "write the URDF out without macros (xacro)");
    out[i] = *value;
    rest.remove_prefix(end);
  }
  return out;
}

math::Matrix3 from_rpy(const math::Vector3& rpy) {
  using Eigen::AngleAxisd, math::Vector3;
  return (AngleAxisd(rpy.z(), Vector3::UnitZ()) * AngleAxisd(rpy.y(), Vector3::UnitY()) *
          AngleAxisd(rpy.x(), Vector3::UnitX()))
      .toRotationMatrix();
}

struct Entry {
  Arm::Joint joint;
  std::string parent;
};

std::string attribute(const XMLElement* element, const char* child, const char* name) {
  const XMLElement* inner = element->FirstChildElement(child);
  const char* text = inner ? inner->Attribute(name) : nullptr;
  return text ? text : "";
}

Entry read_joint(const XMLElement* element, const std::string& file) {
  Entry entry;
  Arm::Joint& joint = entry.joint;
  const char* name = element->Attribute("name");
  const char* type = element->Attribute("type");
  joint.name = name ? name : "";
  const std::string where = file + ": joint '" + joint.name + "'", kind = type ? type : "";
  if (kind == "revolute" || kind == "continuous" || kind == "prismatic")
    joint.moves = true, joint.slides = kind == "prismatic";
  else if (kind != "fixed")
    throw InputError(where, "is of type '" + kind + "', which has more than one angle", "name a flange before it");
  if (const XMLElement* origin = element->FirstChildElement("origin"))
    joint.origin = {from_rpy(triple(origin->Attribute("rpy"), where)), triple(origin->Attribute("xyz"), where)};
  if (const XMLElement* axis = element->FirstChildElement("axis")) joint.axis = triple(axis->Attribute("xyz"), where);
  if (joint.moves && !(joint.axis.norm() > 1e-6)) throw InputError(where, "its axis has no length", "correct the URDF");
  joint.axis.normalize();
  if (const XMLElement* mimic = element->FirstChildElement("mimic")) {
    joint.follows = attribute(element, "mimic", "joint");
    joint.factor = mimic->DoubleAttribute("multiplier", 1.0), joint.offset = mimic->DoubleAttribute("offset", 0.0);
  }
  entry.parent = attribute(element, "parent", "link");
  return entry;
}

}  // namespace

std::vector<std::string> Arm::moving() const {
  std::vector<std::string> names;
  for (const Joint& joint : joints)
    if (joint.moves && joint.follows.empty()) names.push_back(joint.name);
  return names;
}

Arm read_urdf(const Path& file, const std::string& flange) {
  tinyxml2::XMLDocument document;
  const std::string text = core::read_file(file);
  const XMLElement* robot =
      document.Parse(text.data(), text.size()) == tinyxml2::XML_SUCCESS ? document.FirstChildElement("robot") : nullptr;
  if (!robot) throw InputError(file.string(), "is no URDF", "give the arm's URDF, written out without macros (xacro)");
  std::map<std::string, Entry> by_child;  // every link but the root has one joint above it
  std::vector<std::string> links;
  int count = 0;
  for (const XMLElement* e = robot->FirstChildElement("joint"); e && count < kMostJoints;
       e = e->NextSiblingElement("joint"), ++count) {
    if (!e->FirstChildElement("parent") || !e->FirstChildElement("child")) continue;
    by_child[attribute(e, "child", "link")] = read_joint(e, file.string());
    links.push_back(attribute(e, "child", "link"));
  }
  const auto way_to = [&](const std::string& link) {
    std::vector<Arm::Joint> way;
    std::string at = link;
    while (by_child.count(at) && way.size() <= by_child.size()) {
      way.insert(way.begin(), by_child.at(at).joint);
      at = by_child.at(at).parent;
    }
    return std::pair(way, at);
  };
  Arm arm;
  arm.flange = flange;
  if (flange.empty()) {  // the link with the most moving joints above it, the last of these
    std::size_t most = 0;
    for (const std::string& link : links) {
      Arm trial;
      trial.joints = way_to(link).first;
      if (const std::size_t moving = trial.moving().size(); moving >= most) {
        const bool longer = moving > most || trial.joints.size() > arm.joints.size();
        most = moving;
        if (longer) arm.flange = link, arm.joints = trial.joints;
      }
    }
  } else if (std::find(links.begin(), links.end(), flange) == links.end()) {
    throw InputError("`flange`", file.string() + " has no link '" + flange + "'", "it has " + list_of(links));
  }
  std::tie(arm.joints, arm.root) = way_to(arm.flange);
  if (arm.moving().empty())
    throw InputError(file.string(), "no joint moves '" + arm.flange + "'", "name another link with `flange`");
  return arm;
}

math::Pose forward(const Arm& arm, const math::VectorX& angles) {
  const std::vector<std::string> names = arm.moving();
  const auto own = [&](const std::string& name) {
    const auto found = std::find(names.begin(), names.end(), name);
    return found == names.end() ? 0.0 : angles[found - names.begin()];
  };
  math::Pose pose;
  for (const Arm::Joint& joint : arm.joints) {
    pose = pose * joint.origin;
    if (!joint.moves) continue;
    const double value = joint.follows.empty() ? own(joint.name) : joint.factor * own(joint.follows) + joint.offset;
    if (joint.slides)
      pose.translation += pose.rotation * (value * joint.axis);
    else
      pose.rotation = pose.rotation * math::exp_so3(value * joint.axis);
  }
  return pose;
}

}  // namespace chainsplat::importing
