// Reads and writes twin.json and the run folder as a whole. The keys are documented in twin.h.
#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <limits>
#include <nlohmann/json.hpp>

#include "chainsplat/json.h"
#include "chainsplat/properties.h"
#include "chainsplat/solve_json.h"
#include "chainsplat/twin.h"
#include "chainsplat/twin_json.h"

namespace chainsplat::twin {

using Json = nlohmann::ordered_json;
using math::Vector3;
using math::Vector6;

namespace {

constexpr const char* kFormat = "chainsplat-twin/1";
// Of twins that a program of format 1 would set in motion wrongly: with friction in bending or torsion.
constexpr const char* kNewFormat = "chainsplat-twin/2";
constexpr const char *kGaussians = "gaussians.ply", *kStates = "states.csv", *kRollout = "rollout.csv";
constexpr double kLengthTolerance = 1e-6;  // m, and for lengths of unit vectors; accepts files edited by hand

const std::pair<dynamics::Integrator, const char*> kIntegrators[] = {
    {dynamics::Integrator::rodas3, "rodas3"},
    {dynamics::Integrator::implicit_velocity_euler, "implicit_velocity_euler"},
};

// The double nearest to `guess`, within a few units in the last place, for which `holds` is true, else `guess`. This
// undoes the rounding of a number that was stored as a difference or a quotient.
template <class Predicate>
double exact_near(double guess, Predicate holds) {
  constexpr int kReach = 4;  // units in the last place
  double low = guess, high = guess;
  if (holds(guess)) return guess;
  for (int i = 0; i < kReach; ++i) {
    low = std::nextafter(low, -std::numeric_limits<double>::infinity());
    high = std::nextafter(high, std::numeric_limits<double>::infinity());
    if (holds(low)) return low;
    if (holds(high)) return high;
  }
  return guess;
}

// Inertia of a cylinder along d about its center of mass (mathematics.md 3.1): xx yy zz xy xz yz.
std::array<double, 6> cylinder_inertia(double mass, double length, double radius, const Vector3& d) {
  const double across = mass * (length * length / 12.0 + 0.25 * radius * radius), along = 0.5 * mass * radius * radius;
  const math::Matrix3 i = across * (math::Matrix3::Identity() - d * d.transpose()) + along * d * d.transpose();
  return {i(0, 0), i(1, 1), i(2, 2), i(0, 1), i(0, 2), i(1, 2)};
}

// --- writing --------------------------------------------------------------------------------

template <class Vector>
Json list(const Vector& values) {
  Json out = Json::array();
  for (const double value : values) out.push_back(value);  // nlohmann::json writes non-finite numbers as null
  return out;
}

Json list(const math::VectorX& values) { return list(std::vector<double>(values.begin(), values.end())); }

// JSON text of a value. Bytes of file names that are not UTF-8 are replaced, because JSON cannot represent them.
std::string text_of(const Json& value) { return value.dump(-1, ' ', false, Json::error_handler_t::replace); }

// Prints objects, and lists of objects or of lists, over several lines, but a list of numbers on one line.
void print(const Json& value, const std::string& indent, std::string& out) {
  const bool object = value.is_object();
  if (!object && !(value.is_array() && !value.empty() && value[0].is_structured())) {
    out += text_of(value);
    return;
  }
  out += object ? "{" : "[";
  bool first = true;
  for (const auto& [key, entry] : value.items()) {
    out.append(first ? "\n" : ",\n").append(indent).append(1, ' ');
    if (object) out.append(text_of(key)).append(": ");
    print(entry, indent + " ", out);
    first = false;
  }
  if (!first) out.append("\n").append(indent);
  out += object ? "}" : "]";
}

// Drag of the whole rope, in N s/m^2 or N s^2/m^3. Reads back exactly if every link's value is one number times its
// length.
double drag_per_meter(const chain::Chain& chain, const std::vector<double>& by_link) {
  double sum = 0.0, length = 0.0;
  const auto link_length = [&](std::size_t j) {
    return chain.link_end(static_cast<int>(j) + 1) - chain.link_start(static_cast<int>(j) + 1);
  };
  for (std::size_t j = 0; j < by_link.size(); ++j) {
    sum += by_link[j];
    length += link_length(j);
  }
  return exact_near(sum / length, [&](double drag) {
    for (std::size_t j = 0; j < by_link.size(); ++j)
      if (drag * link_length(j) != by_link[j]) return false;
    return true;
  });
}

}  // namespace

nlohmann::ordered_json to_json(const std::vector<capture::Finding>& verdict) {
  Json out = Json::array();
  for (const capture::Finding& f : verdict)
    out.push_back({{"code", f.code},
                   {"subject", f.subject},
                   {"value", f.value},
                   {"sigma", f.deviation},
                   {"unit", f.unit},
                   {"corrected", f.corrected},
                   {"trusted", f.trusted},
                   {"frame", f.frame},
                   {"text", f.text}});
  return out;
}

nlohmann::ordered_json to_json(const capture::Corrections& corrections) {
  Json out{{"cameras", Json::object()}};
  for (const capture::Correction& c : corrections) {
    const bool camera = std::string(c.quantity->subject) == "camera";
    Json& subject = camera ? out["cameras"][c.subject] : out[c.subject];
    const auto numbers = [](const math::VectorX& v) { return v.size() == 1 ? Json(v[0]) : list(v); };
    subject[c.quantity->name] = {
        {"value", numbers(c.value)}, {"sigma", numbers(c.deviation)}, {"state", capture::name(c.state)}};
    if (camera) subject["calibration"] = c.calibration;
  }
  return out;
}

bool Twin::trusted() const {
  return std::all_of(verdict.begin(), verdict.end(), [](const capture::Finding& f) { return f.trusted; });
}

namespace {

Json chain_json(const Twin& twin) {
  const chain::Chain& chain = twin.chain;
  const dynamics::Parameters* const p = twin.parameters ? &*twin.parameters : nullptr;
  const auto normal = p ? p->table_normal : twin.table_normal;
  Json out{{"scenario", twin.tabletop ? "tabletop" : "free"},
           {"length", chain.length},
           {"diameter", chain.diameter},
           {"gravity", list(p ? p->gravity : twin.gravity)}};
  if (twin.tabletop)
    out["table"] = {{"point", list(twin.table_point.value_or(Vector3::Zero()))},
                    {"normal", list(normal.value_or(Vector3::UnitZ()))}};

  out["joints"] = Json::array();
  for (int k = 0; k < chain.angles(); ++k) {
    Json joint{
        {"axis", list(chain.axes[k])}, {"parent_link", chain.child_link[k] - 1}, {"child_link", chain.child_link[k]}};
    if (p) {
      joint["stiffness"] = p->stiffness[k];
      joint["rest_angle"] = p->rest_angle[k];
      joint["damping"] = p->damping[k];
      if (!p->roll_lever.empty()) joint["roll_lever"] = p->roll_lever[k];
      if (!p->bending_friction.empty()) {
        joint["bending_friction"] = p->bending_friction[k];
        joint["bending_friction_angle"] = p->bending_friction_angle[k];
      }
    }
    out["joints"].push_back(std::move(joint));
  }

  out["links"] = Json::array();
  for (int j = 0; j < chain.links(); ++j) {
    const double length = chain.link_end(j) - chain.link_start(j);
    Json link{{"length", length}};
    if (p) {
      const double mass = j > 0 ? p->link_mass[j - 1] : 0.0;
      link = {{"mass", mass},
              {"inertia", list(cylinder_inertia(mass, length, p->radius, chain.direction))},
              {"center_of_mass", list(Vector3(0.5 * length * chain.direction))},
              {"length", length},
              {"viscous_friction", j > 0 ? p->viscous_friction[j - 1] : 0.0},
              {"coulomb_friction", j > 0 ? p->coulomb_friction[j - 1] : 0.0}};
    }
    out["links"].push_back(std::move(link));
  }

  if (p) {
    out["air_drag"] = {{"linear", drag_per_meter(chain, p->air_linear)},
                       {"quadratic", drag_per_meter(chain, p->air_quadratic)}};
    out["tip_mass"] = p->tip_mass;
    if (!p->torsional_stiffness.empty()) out["torsional_stiffness"] = list(p->torsional_stiffness);
    out["regularization"] = {{"coulomb_speed", p->coulomb_speed}, {"drag_speed", p->drag_speed}};
    for (const auto& [integrator, name] : kIntegrators)
      if (integrator == p->integrator) out["integrator"] = {{"name", name}, {"substeps", p->substeps}};
  }
  if (twin.initial) {
    out["initial_state"] = {
        {"time", twin.initial->time}, {"theta", list(twin.initial->theta)}, {"thetadot", list(twin.initial->thetadot)}};
    // rolls are not kept: they begin at rest
    if (const Eigen::Index n = twin.chain.angles();
        p && !p->bending_friction.empty() && twin.initial->internal_state.size() >= n)
      out["initial_state"]["friction_state"] = list(math::VectorX(twin.initial->internal_state.head(n)));
  }
  return out;
}

// What the numbers mean, in words, so that a reader of the file alone can use them (formats.md 2.1).
Json about_json(const Twin& twin) {
  Json out{{"units", "m, s, kg, N, rad"},
           {"frames",
            "world as in the capture; base: origin at the grasp; home: all angles 0, the rope straight along "
            "grasp.direction"},
           {"joints",
            "one entry per angle, base to tip; theta_k turns all links from its child_link on about its axis (w, v)"},
           {"base",
            "base.tum, smoothed by a quintic spline, its noise found by cross-validation; velocities and accelerations "
            "are the spline's"}};
  if (!twin.parameters) return out;
  if (!twin.known_mass) out["units"] = "m, s, rad; the total mass counts as 1 kg, forces are N per kg of rope";
  Json laws{{"joint", "torque = -stiffness (theta - rest_angle) - damping thetadot"},
            {"inertia", "links are uniform cylinders; tip_mass is a point at the free end"}};
  if (!twin.parameters->torsional_stiffness.empty())
    laws["torsion"] =
        "the rope twists within its links with torsional_stiffness and the retardation time damping/stiffness "
        "(docs/mathematics.md 3.11)";
  if (!twin.parameters->bending_friction.empty())
    laws["bending_friction"] =
        "torque = -bending_friction z, dz/dt = (thetadot - |thetadot| z) / bending_friction_angle (Dahl); "
        "initial_state.friction_state is z";
  if (twin.tabletop) {
    laws["table"] =
        "force on a link, spread evenly = -(viscous_friction + coulomb_friction mass g_n / sqrt(v_t^2 + "
        "coulomb_speed^2)) v_t; the table carries the weight";
    laws["roll_lever"] =
        "torque = -roll_lever sum over links j of min(arclength of the joint, of the middle of j)/length times the "
        "friction across j: a rope that friction rolls";
  } else {
    laws["air"] =
        "force on a link, spread evenly = -length (linear + quadratic sqrt(v_n^2 + drag_speed^2)) v_n, v_n across the "
        "link";
  }
  out["laws"] = std::move(laws);
  return out;
}

Json identification_json(const Twin& twin) {
  Json out{{"known_mass", twin.known_mass}};
  const dynamics::Estimates& e = twin.estimates;
  if (!twin.parameters) return out;
  out["names"] = e.names;
  out["estimates"] = list(e.values);
  out["standard_errors"] = list(e.standard_errors);
  out["covariance"] = Json::array();
  for (Eigen::Index row = 0; row < e.covariance.rows(); ++row)
    out["covariance"].push_back(list(math::VectorX(e.covariance.row(row))));
  out["held"] = Json::array();
  for (const auto& [name, reason] : e.held) out["held"].push_back({{"name", name}, {"reason", reason}});
  out["weak"] = Json::array();
  for (const auto& weak : e.weak) {
    Json parts = Json::object();
    for (const auto& [name, component] : weak.parts) parts[name] = component;
    out["weak"].push_back({{"singular_value", weak.singular_value}, {"direction", parts}});
  }
  if (e.solver) out["solver"] = *e.solver;
  return out;
}

// Of a twin that can be set in motion; numbers that cannot are saved all the same.
Json properties_json(const Twin& twin) {
  Json out = Json::object();
  try {
    const dynamics::Model model = dynamics::make_model(twin.chain, *twin.parameters);
    for (const Property& p : properties(model, twin.estimates, twin.known_mass))
      out[p.name] = {{"value", p.value}, {"sigma", std::isfinite(p.sigma) ? Json(p.sigma) : Json()}, {"unit", p.unit}};
  } catch (const InputError&) {
  }
  return out;
}

// --- reading --------------------------------------------------------------------------------

// A JSON value and its place in the file. Every access checks the value and throws InputError that names the place.
class Node {
 public:
  Node(const Json& value, std::string file, std::string key)
      : value_(value), file_(std::move(file)), key_(std::move(key)) {}

  [[noreturn]] void fail(const std::string& what, const std::string& mend) const {
    throw InputError(where(), what, mend);
  }
  std::string where() const { return key_.empty() ? file_ : file_ + ": " + key_; }
  bool has(const char* key) const { return value_.is_object() && value_.contains(key); }
  Node operator[](const char* key) const {
    if (!value_.is_object()) fail("is not an object", "restore it from a run that works");
    const Node child(has(key) ? value_[key] : value_, file_, key_.empty() ? key : key_ + "." + key);
    if (!has(key)) child.fail("is missing", "add it or train again");
    return child;
  }
  std::vector<Node> entries() const {
    if (!value_.is_array()) fail("is not a list", "restore it from a run that works");
    std::vector<Node> out;
    for (std::size_t i = 0; i < value_.size(); ++i)
      out.emplace_back(value_[i], file_, key_ + "[" + std::to_string(i) + "]");
    return out;
  }
  double number() const {
    if (!value_.is_number() || !std::isfinite(value_.get<double>())) fail("is not a finite number", "write one");
    return value_.get<double>();
  }
  double not_negative() const {
    const double value = number();
    if (value < 0.0) fail(core::exact(value) + " is negative", "write a number >= 0");
    return value;
  }
  double positive() const {
    const double value = number();
    if (value <= 0.0) fail(core::exact(value) + " is not positive", "write a number > 0");
    return value;
  }
  double number_or_nan() const { return value_.is_null() ? std::numeric_limits<double>::quiet_NaN() : number(); }
  int whole(int least, int most) const {
    const double value = number();
    if (value != std::floor(value) || value < least || value > most)
      fail(core::exact(value) + " is not a whole number from " + std::to_string(least) + " to " + std::to_string(most),
           "correct it");
    return static_cast<int>(value);
  }
  std::uint64_t unsigned_number() const {
    if (!value_.is_number_unsigned()) fail("is not a whole number >= 0", "correct it");
    return value_.get<std::uint64_t>();
  }
  bool boolean() const {
    if (!value_.is_boolean()) fail("is not true or false", "correct it");
    return value_.get<bool>();
  }
  std::string text() const {
    if (!value_.is_string()) fail("is not a text", "write it in quotes");
    return value_.get<std::string>();
  }
  // `count` < 0 accepts any number of entries; `unknown` reads null as NaN.
  std::vector<double> numbers(int count, bool unknown = false) const {
    std::vector<double> out;
    for (const Node& entry : entries()) out.push_back(unknown ? entry.number_or_nan() : entry.number());
    if (count >= 0 && static_cast<int>(out.size()) != count)
      fail("has " + std::to_string(out.size()) + " entries instead of " + std::to_string(count), "correct it");
    return out;
  }
  math::VectorX vector(int count) const {
    const std::vector<double> values = numbers(count);
    return Eigen::Map<const math::VectorX>(values.data(), count);
  }
  Vector3 unit() const {
    const Vector3 value = vector(3);
    if (std::abs(value.norm() - 1.0) > kLengthTolerance) fail("is not a unit vector", "divide it by its length");
    return value;
  }
  std::vector<std::pair<std::string, Node>> members() const {  // in the file's order
    if (!value_.is_object()) fail("is not an object", "restore it from a run that works");
    std::vector<std::pair<std::string, Node>> out;
    for (const auto& [key, value] : value_.items()) out.emplace_back(key, Node(value, file_, key_ + "." + key));
    return out;
  }

 private:
  const Json& value_;
  std::string file_, key_;
};

// Screw axis of a rotation about the unit vector w through a point.
Vector6 space_axis(const Vector3& w, const Vector3& point) {
  Vector6 axis;
  axis << w, -w.cross(point);
  return axis;
}

chain::Chain read_chain(const Node& node, const Node& grasp) {
  chain::Chain chain;
  chain.length = node["length"].positive();
  chain.diameter = node["diameter"].positive();
  chain.direction = grasp["direction"].unit();
  chain.bending_axis = grasp["bending_axis"].unit();
  if (std::abs(chain.direction.dot(chain.bending_axis)) > kLengthTolerance)
    grasp["bending_axis"].fail("is not perpendicular to direction", "choose an axis across the rope");

  for (const Node& joint : node["joints"].entries()) {
    chain.axes.push_back(joint["axis"].vector(6));
    const int previous = chain.child_link.empty() ? 0 : chain.child_link.back();
    chain.child_link.push_back(joint["child_link"].whole(std::max(1, previous), previous + 1));
    joint["parent_link"].whole(chain.child_link.back() - 1, chain.child_link.back() - 1);
  }
  if (chain.axes.empty()) node["joints"].fail("is empty", "a chain has at least one joint");
  const std::vector<Node> links = node["links"].entries();
  if (static_cast<int>(links.size()) != chain.child_link.back() + 1)
    node["links"].fail("has " + std::to_string(links.size()) + " entries, the joints name " +
                           std::to_string(chain.child_link.back() + 1),
                       "list the base link and every moving link");

  // arclengths of the joints by the links' lengths, checked against the axes
  double end = 0.0;
  int k = 0;
  for (std::size_t j = 0; j + 1 < links.size(); ++j) {
    const double length = j == 0 ? links[j]["length"].not_negative() : links[j]["length"].positive();
    const int first = k;
    while (k < chain.angles() && chain.child_link[k] == static_cast<int>(j) + 1) ++k;
    // the arclength that reproduces the axes bit by bit, from which the sum of the lengths may differ by rounding
    const double start = end;
    end = exact_near(start + length, [&](double s) {
      for (int a = first; a < k; ++a)
        if (space_axis(chain.axes[a].head<3>(), s * chain.direction) != chain.axes[a]) return false;
      return s - start == length;
    });
    for (int a = first; a < k; ++a) {
      const Node axis = node["joints"].entries()[a]["axis"];
      if (std::abs(chain.axes[a].head<3>().norm() - 1.0) > kLengthTolerance)
        axis.fail("its first three numbers are no unit vector", "divide them by their length");
      if ((space_axis(chain.axes[a].head<3>(), end * chain.direction) - chain.axes[a]).norm() > kLengthTolerance)
        axis.fail("does not pass through its joint, " + core::exact(end) + " m along the rope",
                  "write v = -w x (s direction)");
    }
    chain.joint_arclength.push_back(end);
  }
  if (std::abs(end + links.back()["length"].positive() - chain.length) > kLengthTolerance)
    node["links"].fail("their lengths do not add up to chain.length", "correct the lengths");
  return chain;
}

// The radius from which the links' inertia was computed. The dynamics knows uniform cylinders only.
double cylinder_radius(const chain::Chain& chain, const std::vector<double>& masses, const std::vector<Node>& links) {
  const auto fits = [&](double radius, double tolerance) {
    for (int j = 1; j < chain.links(); ++j) {
      const std::vector<double> stored = links[j]["inertia"].numbers(6);
      const std::array<double, 6> ours =
          cylinder_inertia(masses[j - 1], chain.link_end(j) - chain.link_start(j), radius, chain.direction);
      const double size = std::max({ours[0], ours[1], ours[2]});
      for (int i = 0; i < 6; ++i)
        if (!(std::abs(stored[i] - ours[i]) <= tolerance * size)) return false;
    }
    return true;
  };
  constexpr double kRounding = 1e-12, kByHand = 1e-3;  // relative tolerances: as written by save(), or edited by hand
  for (const double radius : {0.5 * chain.diameter, 0.0})
    if (fits(radius, kRounding)) return radius;
  // neither half the diameter nor 0: solve for it by the inertia about the rope's own axis, m r^2 / 2
  const std::vector<double> i = links[1]["inertia"].numbers(6);
  const Vector3& d = chain.direction;
  const double along = d[0] * d[0] * i[0] + d[1] * d[1] * i[1] + d[2] * d[2] * i[2] +
                       2 * (d[0] * d[1] * i[3] + d[0] * d[2] * i[4] + d[1] * d[2] * i[5]);
  double radius = masses[0] > 0.0 ? std::sqrt(std::max(0.0, 2.0 * along / masses[0])) : 0.0;
  // the last digits are rounding, and would change each time the twin is saved and loaded
  constexpr double kDigits = 12.0;
  const double half = 0.5 * chain.diameter;
  if (std::abs(radius - half) <= kRounding * half) {
    radius = half;
  } else if (radius > 0.0) {
    const double step = std::pow(10.0, std::floor(std::log10(radius)) - kDigits + 1.0);
    radius = std::round(radius / step) * step;
  }
  if (!fits(radius, kByHand))
    links[1]["inertia"].fail("is, with the other links', not that of uniform cylinders of one radius",
                             "write m (l^2/12 + r^2/4) across and m r^2/2 along the link");
  return radius;
}

dynamics::Parameters read_parameters(const Node& node, const Twin& twin) {
  dynamics::Parameters p;
  p.gravity = twin.gravity;
  if (twin.tabletop) p.table_normal = twin.table_normal;
  const std::vector<Node> links = node["links"].entries();

  for (const Node& joint : node["joints"].entries()) {
    p.stiffness.push_back(joint["stiffness"].not_negative());
    p.rest_angle.push_back(joint["rest_angle"].number());
    p.damping.push_back(joint["damping"].not_negative());
    if (joint.has("roll_lever")) p.roll_lever.push_back(joint["roll_lever"].number());
    if (joint.has("bending_friction")) {
      p.bending_friction.push_back(joint["bending_friction"].not_negative());
      p.bending_friction_angle.push_back(joint["bending_friction_angle"].positive());
    }
  }
  if (!p.bending_friction.empty() && p.bending_friction.size() != p.damping.size())
    node["joints"].fail("has bending_friction for " + std::to_string(p.bending_friction.size()) + " joints of " +
                            std::to_string(p.damping.size()),
                        "give it for all or none");
  if (!p.roll_lever.empty() && p.roll_lever.size() != p.damping.size())
    node["joints"].fail(
        "has roll_lever for " + std::to_string(p.roll_lever.size()) + " joints of " + std::to_string(p.damping.size()),
        "give it for all or none");

  const double linear = node["air_drag"]["linear"].not_negative(),
               quadratic = node["air_drag"]["quadratic"].not_negative();
  for (int j = 1; j < twin.chain.links(); ++j) {
    const double length = twin.chain.link_end(j) - twin.chain.link_start(j);
    p.link_mass.push_back(links[j]["mass"].not_negative());
    p.viscous_friction.push_back(links[j]["viscous_friction"].not_negative());
    p.coulomb_friction.push_back(links[j]["coulomb_friction"].not_negative());
    p.air_linear.push_back(linear * length);
    p.air_quadratic.push_back(quadratic * length);
    const Vector3 center = links[j]["center_of_mass"].vector(3);
    if ((center - 0.5 * length * twin.chain.direction).norm() > kLengthTolerance)
      links[j]["center_of_mass"].fail("is not the middle of the link",
                                      "only uniform links are known; use tip_mass for the rest");
  }

  p.radius = cylinder_radius(twin.chain, p.link_mass, links);
  p.tip_mass = node["tip_mass"].not_negative();
  if (node.has("torsional_stiffness"))
    for (const Node& twist : node["torsional_stiffness"].entries()) p.torsional_stiffness.push_back(twist.positive());
  p.coulomb_speed = node["regularization"]["coulomb_speed"].positive();
  p.drag_speed = node["regularization"]["drag_speed"].positive();
  const Node name = node["integrator"]["name"];
  bool known = false;
  for (const auto& [integrator, text] : kIntegrators)
    if (name.text() == text) {
      p.integrator = integrator;
      known = true;
    }
  if (!known) name.fail("'" + name.text().substr(0, 40) + "' is not known", "write rodas3 or implicit_velocity_euler");
  constexpr int kMostSubsteps = 100000;
  p.substeps = node["integrator"]["substeps"].whole(1, kMostSubsteps);
  return p;
}

dynamics::Estimates read_estimates(const Node& node) {
  dynamics::Estimates e;
  for (const Node& name : node["names"].entries()) e.names.push_back(name.text());
  const int count = static_cast<int>(e.names.size());
  e.values = node["estimates"].numbers(count, true);
  e.standard_errors = node["standard_errors"].numbers(count, true);
  const std::vector<Node> rows = node["covariance"].entries();
  if (!rows.empty() && static_cast<int>(rows.size()) != count)
    node["covariance"].fail("has " + std::to_string(rows.size()) + " rows for " + std::to_string(count) + " names",
                            "correct it");
  e.covariance.resize(static_cast<Eigen::Index>(rows.size()), static_cast<Eigen::Index>(rows.size()));
  for (std::size_t row = 0; row < rows.size(); ++row) {
    const std::vector<double> values = rows[row].numbers(count, true);
    for (int column = 0; column < count; ++column)
      e.covariance(static_cast<Eigen::Index>(row), column) = values[column];
  }
  const std::vector<Eigen::Index> known = math::known_part(e.covariance);
  if (!math::is_covariance(e.covariance(known, known)))
    node["covariance"].fail("is not symmetric and positive semidefinite", "restore it or identify again");
  for (const Node& held : node["held"].entries()) e.held.emplace_back(held["name"].text(), held["reason"].text());
  if (node.has("weak"))  // files of older versions have no such key
    for (const Node& weak : node["weak"].entries()) {
      e.weak.push_back({weak["singular_value"].number(), {}});
      for (const auto& [name, component] : weak["direction"].members())
        e.weak.back().parts.emplace_back(name, component.number());
    }
  if (node.has("solver")) {
    const Node solver = node["solver"];
    const auto reason = solve::reason_of(solver["reason"].text());
    if (!reason) solver["reason"].fail("is not known", "restore it or identify again");
    e.solver = {*reason, solver["iterations"].whole(0, std::numeric_limits<int>::max()),
                solver["initial_cost"].number_or_nan(), solver["final_cost"].number_or_nan(),
                solver["worst_step"].number_or_nan()};
  }
  return e;
}

capture::Corrections read_corrections(const Node& node) {
  capture::Corrections out;
  const auto read = [&](const Node& subject, const std::string& name, bool camera) {
    for (const capture::CorrectedQuantity& quantity : capture::corrected_quantities()) {
      if (camera != (std::string(quantity.subject) == "camera") || (!camera && quantity.subject != name)) continue;
      if (!subject.has(quantity.name)) continue;
      const Node leaf = subject[quantity.name];
      const auto numbers = [&](const char* key) {
        return quantity.size == 1 ? math::VectorX::Constant(1, leaf[key].number())
                                  : math::VectorX(leaf[key].vector(quantity.size));
      };
      capture::Correction c;
      c.quantity = &quantity;
      c.subject = name;
      c.value = numbers("value");
      c.deviation = numbers("sigma");
      if (c.value.cwiseAbs().maxCoeff() > quantity.most)
        leaf["value"].fail("is more than " + core::exact(quantity.most) + " " + quantity.unit, "train again");
      const std::string state = leaf["state"].text();
      bool known = false;
      for (const auto one :
           {capture::CorrectionState::free, capture::CorrectionState::prior, capture::CorrectionState::held})
        if (state == capture::name(one)) c.state = one, known = true;
      if (!known) leaf["state"].fail("is not known", "write free, prior or held");
      if (camera && subject.has("calibration")) c.calibration = subject["calibration"].text();
      out.push_back(std::move(c));
    }
  };
  for (const auto& [name, subject] : node["cameras"].members()) read(subject, name, true);
  for (const char* const name : {"base", "grasp", "object"})
    if (node.has(name)) read(node[name], name, false);
  return out;
}

std::vector<capture::Finding> read_verdict(const Node& node) {
  std::vector<capture::Finding> out;
  for (const Node& entry : node.entries()) {
    capture::Finding f;
    f.code = entry["code"].text();
    f.subject = entry["subject"].text();
    f.value = entry["value"].number();
    f.deviation = entry["sigma"].number();
    f.unit = entry["unit"].text();
    f.corrected = entry["corrected"].boolean();
    f.trusted = entry["trusted"].boolean();
    f.frame = entry["frame"].whole(-1, capture::kMostFrames);
    f.text = entry["text"].text();
    out.push_back(std::move(f));
  }
  return out;
}

// Reads an option, stored as text, into its field. Throws InputError where the text cannot be parsed as what it is.
void read_option(const std::string& name, const Node& node, Provenance& p) {
  const std::string text = node.text();
  const auto refuse = [&](const std::string& what) {
    constexpr std::size_t kShown = 40;  // characters
    node.fail("'" + text.substr(0, kShown) + "' is " + what, "correct it, or train again");
  };
  const auto number = [&](auto& value, const std::string& what) {
    const char* const end = text.data() + text.size();
    const auto [after, error] = std::from_chars(text.data(), end, value);
    if (error != std::errc() || after != end || !std::isfinite(static_cast<double>(value)) || !(value > 0))
      refuse(what);
  };
  if (name == "mass") {
    number(p.mass.emplace(), "not a positive number, the mass in kg");
  } else if (name == "tip_mass") {
    p.payload.emplace();
    const std::size_t comma = text.find(',');
    const auto part = [&](const char* begin, const char* end, double& value) {
      const auto [after, error] = std::from_chars(begin, end, value);
      if (error != std::errc() || after != end || !(value >= 0.0) || !std::isfinite(value))
        refuse("no mass in kg, nor one with its deviation after a comma");
    };
    const char* const end = text.data() + text.size();
    part(text.data(), comma == std::string::npos ? end : text.data() + comma, p.payload->mass);
    if (comma != std::string::npos) part(text.data() + comma + 1, end, p.payload->sigma);
  } else if (name == "every") {
    number(p.every.emplace(), "not a whole number >= 1");
  } else if (name == "mode") {
    if (text != "fast" && text != "paper") refuse("neither fast nor paper");
    p.mode = text == "paper" ? Mode::paper : Mode::fast;
  } else if (name == "frames") {
    p.frames = capture::read_frame_range(text, node.where());
  } else if (name == "path") {
    p.path = text;
  } else if (name == "joint") {
    p.joint = true;
  } else {
    p.options[name] = text;
  }
}

Provenance read_provenance(const Node& node) {
  Provenance p;
  p.version = node["version"].text();
  p.capture = node["capture"].text();
  p.capture_hash = node["capture_hash"].text();
  for (const auto& [name, value] : node["options"].members()) read_option(name, value, p);
  p.seed = node["seed"].unsigned_number();
  p.device = node["device"].text();
  p.driver = node["driver"].text();
  for (const auto& [stage, value] : node["durations"].members()) p.seconds[stage] = value.number();
  return p;
}

// The file that twin.json names under `key`; empty if it names none.
Path named_file(const Node& top, const char* key, const Path& run) {
  if (!top.has(key)) return {};
  const std::string name = top[key].text();
  if (name.empty() || Path(name).filename() != name || name == "." || name == "..")
    top[key].fail("is not the name of a file in the run folder", "move the file there");
  return run / name;
}

}  // namespace

std::string mode_text(Mode mode) { return mode == Mode::paper ? "paper" : "fast"; }

std::map<std::string, std::string> option_texts(const Provenance& p) {
  std::map<std::string, std::string> texts = p.options;
  if (p.mass) texts["mass"] = core::exact(*p.mass);
  if (p.payload) {
    texts["tip_mass"] = core::exact(p.payload->mass);
    if (p.payload->sigma > 0.0) texts["tip_mass"] += "," + core::exact(p.payload->sigma);
  }
  if (p.frames) texts["frames"] = capture::frame_range_text(*p.frames);
  if (p.every) texts["every"] = std::to_string(*p.every);
  if (p.mode) texts["mode"] = mode_text(*p.mode);
  if (p.path) texts["path"] = *p.path;
  if (p.joint) texts["joint"] = "yes";
  return texts;
}

void save(const Twin& twin, const Path& run) {
  std::error_code error;
  std::filesystem::create_directories(run, error);
  if (error)
    throw WorkError(run.string(), "cannot be made (" + error.message() + ")", "choose a folder that can be written");
  const bool plain =
      !twin.parameters || (twin.parameters->bending_friction.empty() && twin.parameters->torsional_stiffness.empty());
  Json out{{"format", plain ? kFormat : kNewFormat},
           {"about", about_json(twin)},
           {"grasp", {{"direction", list(twin.chain.direction)}, {"bending_axis", list(twin.chain.bending_axis)}}},
           {"chain", chain_json(twin)},
           {"identification", identification_json(twin)}};
  if (twin.parameters) out["properties"] = properties_json(twin);
  if (twin.validity)
    out["validity"] = {{"acceleration", {{"value", twin.validity->acceleration}, {"unit", "m/s^2"}}},
                       {"speed", {{"value", twin.validity->speed}, {"unit", "m/s"}}},
                       {"curvature", {{"value", twin.validity->curvature}, {"unit", "1/m"}}}};
  if (!twin.corrections.empty()) out["corrections"] = to_json(twin.corrections);
  if (!twin.corrections.empty() || !twin.verdict.empty()) {
    out["verdict"] = to_json(twin.verdict);
    out["trusted"] = twin.trusted();
  }
  const auto part = [&](bool present, const char* key, const char* name, auto&& bytes) {
    if (!present) return;
    core::write_file(run / name, bytes());
    out[key] = name;
  };
  part(twin.gaussians.count > 0, "gaussians", kGaussians, [&] { return gaussians_ply(twin.gaussians); });
  part(!twin.states.time.empty(), "states", kStates, [&] { return states_csv(twin.states); });
  part(!twin.rollout.time.empty(), "rollout", kRollout, [&] { return states_csv(twin.rollout); });
  const Provenance& p = twin.provenance;
  out["provenance"] = {{"version", p.version},
                       {"capture", p.capture},
                       {"capture_hash", p.capture_hash},
                       {"options", Json(option_texts(p))},
                       {"seed", p.seed},
                       {"device", p.device},
                       {"driver", p.driver},
                       {"durations", Json(p.seconds)}};
  std::string text;
  print(out, "", text);
  core::write_file(run / "twin.json", text + "\n");
}

Twin load(const Path& run) {
  const Path path = run / "twin.json";
  std::error_code error;
  if (!std::filesystem::exists(path, error))
    throw InputError(path.string(), "does not exist", "name the folder of a trained twin");
  const std::string file = path.string();
  const Json document = core::parse_json_or_discard(core::read_file(path));
  if (document.is_discarded()) throw InputError(file, "is not JSON or is cut off", "restore it or train again");
  const Node top(document, file, "");
  if (const std::string format = top["format"].text(); format != kFormat && format != kNewFormat)
    top["format"].fail("is neither '" + std::string(kFormat) + "' nor '" + kNewFormat + "'",
                       "use the program that wrote it");

  // scene and chain
  Twin twin;
  const Node node = top["chain"];
  const std::string scenario = node["scenario"].text();
  if (scenario != "free" && scenario != "tabletop") node["scenario"].fail("is not known", "write free or tabletop");
  twin.tabletop = scenario == "tabletop";
  twin.gravity = node["gravity"].vector(3);
  if (twin.tabletop) {
    twin.table_point = node["table"]["point"].vector(3);
    twin.table_normal = node["table"]["normal"].unit();
  }
  twin.chain = read_chain(node, top["grasp"]);

  // identification, initial state and provenance
  const Node identification = top["identification"];
  twin.known_mass = identification["known_mass"].boolean();
  if (node["links"].entries().back().has("mass")) {
    twin.parameters = read_parameters(node, twin);
    twin.estimates = read_estimates(identification);
  }
  const int angles = twin.chain.angles();
  if (node.has("initial_state")) {
    const Node initial = node["initial_state"];
    twin.initial = dynamics::InitialState{initial["time"].number(), initial["theta"].vector(angles),
                                          initial["thetadot"].vector(angles)};
    if (initial.has("friction_state")) twin.initial->internal_state = initial["friction_state"].vector(angles);
  }
  twin.provenance = read_provenance(top["provenance"]);
  // files of older versions have none of these
  if (top.has("validity")) {
    const Node validity = top["validity"];
    const auto value = [&](const char* key) { return validity[key]["value"].not_negative(); };
    twin.validity = Validity{value("acceleration"), value("speed"), value("curvature")};
  }
  if (top.has("corrections")) twin.corrections = read_corrections(top["corrections"]);
  if (top.has("verdict")) twin.verdict = read_verdict(top["verdict"]);

  // the other files of the run folder
  if (const Path ply = named_file(top, "gaussians", run); !ply.empty()) {
    twin.gaussians = read_ply(ply);
    if (twin.gaussians.links != twin.chain.links())
      throw InputError(ply.string(),
                       "has " + std::to_string(twin.gaussians.links) + " properties link_*, the chain has " +
                           std::to_string(twin.chain.links()) + " links",
                       "take the file of the same run");
  }
  if (const Path states = named_file(top, "states", run); !states.empty()) twin.states = read_states(states, angles);
  if (const Path rollout = named_file(top, "rollout", run); !rollout.empty())
    twin.rollout = read_states(rollout, angles);
  return twin;
}

}  // namespace chainsplat::twin
