// Reads twin.json and the run folder as a whole. The keys are documented in twin.h.
#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <limits>
#include <nlohmann/json.hpp>

#include "chainsplat/json.h"
#include "chainsplat/solve_json.h"
#include "chainsplat/twin.h"
#include "src/twin/file_format.h"
#include "src/twin/node.h"

namespace chainsplat::twin {

using math::Vector3;
using math::Vector6;

namespace {

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
  if (node.has("lift")) {
    chain.lift = node["lift"].numbers_within(chain.links(), chain.length);
    for (const Vector6& axis : chain.axes)
      if (axis.head<3>().cross(chain.bending_axis).norm() > kLengthTolerance)
        node["lift"].fail("is given of a chain that does not bend in a plane", "remove it");
  }
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
  if (node.has("tip_length")) p.tip_length = node["tip_length"].not_negative();
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
  if (node.has("misfit")) {
    e.misfit = node["misfit"].number();
    if (e.misfit < 0.0) node["misfit"].fail("is negative", "restore it or identify again");
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
      if (c.deviation.minCoeff() < 0.0) leaf["sigma"].fail("is negative", "train again");
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
    const capture::CorrectedQuantity& lost = capture::lost_frames();
    if (!camera || !subject.has(lost.name)) return;
    const Node leaf = subject[lost.name];
    capture::Correction c;
    c.quantity = &lost;
    c.subject = name;
    std::vector<double> frames;
    for (const Node& frame : leaf["value"].entries()) frames.push_back(frame.number());
    c.value = Eigen::Map<math::VectorX>(frames.data(), static_cast<Eigen::Index>(frames.size()));
    c.deviation = math::VectorX::Zero(c.value.size());
    c.calibration = leaf["recording"].text();
    if (c.value.size() == 0 || c.value.minCoeff() < 1.0 || c.value.maxCoeff() > lost.most)
      leaf["value"].fail("is no list of frames from 1 on", "train again");
    out.push_back(std::move(c));
  };
  for (const auto& [name, subject] : node["cameras"].members()) read(subject, name, true);
  for (const char* const name : {"base", "grasp", "object", "table"})
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
    if (!p.payload) p.payload.emplace();
    const std::size_t comma = text.find(',');
    const auto part = [&](const char* begin, const char* end, double& value) {
      const auto [after, error] = std::from_chars(begin, end, value);
      if (error != std::errc() || after != end || !(value >= 0.0) || !std::isfinite(value))
        refuse("no mass in kg, nor one with its deviation after a comma");
    };
    const char* const end = text.data() + text.size();
    part(text.data(), comma == std::string::npos ? end : text.data() + comma, p.payload->mass);
    if (comma != std::string::npos) part(text.data() + comma + 1, end, p.payload->sigma);
  } else if (name == "tip_length") {
    if (!p.payload) p.payload.emplace();
    const char* const end = text.data() + text.size();
    double& length = p.payload->length.emplace();
    const auto [after, error] = std::from_chars(text.data(), end, length);
    if (error != std::errc() || after != end || !(length >= 0.0) || !std::isfinite(length))
      refuse("no length of a payload in m");
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

// Scene, chain and parameters, if there are any: what is below "chain".
void read_rope(const Node& node, const Node& grasp, Twin& twin) {
  const std::string scenario = node["scenario"].text();
  if (scenario != "free" && scenario != "tabletop") node["scenario"].fail("is not known", "write free or tabletop");
  twin.tabletop = scenario == "tabletop";
  twin.gravity = node["gravity"].vector(3);
  if (twin.tabletop) {
    twin.table_point = node["table"]["point"].vector(3);
    twin.table_normal = node["table"]["normal"].unit();
  }
  twin.chain = read_chain(node, grasp);
  if (node["links"].entries().back().has("mass")) twin.parameters = read_parameters(node, twin);
}

double read_pixel_footprint(const Node& node) {
  constexpr double kMost = 0.1;  // m: a picture with such pixels shows no rope
  const double value = node.positive();
  if (value > kMost) node.fail("is more than a pixel of any picture that shows a rope", "train again");
  return value;
}

splat::Light read_light(const Node& node, const math::Vector3& axis) {
  constexpr double kMost = 1e3;  // times the brightest side that was seen
  const std::vector<double> linear = node["linear"].numbers_within(3, kMost),
                            q = node["quadratic"].numbers_within(6, kMost);
  const double constant = node["constant"].number();
  if (std::abs(constant) > kMost) node["constant"].fail("is more than any light has", "train again");
  splat::Light light{axis, constant, math::Vector3(linear.data()), {}};
  light.quadratic << q[0], q[1], q[2], q[1], q[3], q[4], q[2], q[4], q[5];
  return light;
}

}  // namespace

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

  Twin twin;
  const Node node = top["chain"];
  read_rope(node, top["grasp"], twin);

  // identification, initial state and provenance
  const Node identification = top["identification"];
  twin.known_mass = identification["known_mass"].boolean();
  if (twin.parameters) twin.estimates = read_estimates(identification);
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
  if (top.has("rolling")) {
    const Node rolling = top["rolling"];
    const int links = twin.chain.links();
    if (!twin.parameters || !twin.parameters->table_normal || twin.chain.angles() + 1 != links)
      rolling.fail("is of no identified planar chain on a table", "remove it or train again");
    constexpr double kMost = 1e3, kSharpest = 1e4, kTurns = 1e3;  // ratios, and m/s; 1/m; rad
    for (const char* const key : {"torsion", "friction", "speed"})
      if (rolling[key].number() > kMost) rolling[key].fail("is more than any rope has", "train again");
    twin.rolling = dynamics::Rolling{rolling["torsion"].positive(),
                                     rolling["friction"].not_negative(),
                                     rolling["speed"].positive(),
                                     rolling["set"].numbers_within(links - 1, kSharpest),
                                     rolling["texture"].numbers_within(links, kTurns),
                                     rolling["deviation"].not_negative()};
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
    if (top.has("pixel_footprint")) twin.gaussians.pixel_footprint = read_pixel_footprint(top["pixel_footprint"]);
    if (top.has("light")) twin.gaussians.light = read_light(top["light"], twin.chain.direction);
  }
  if (const Path states = named_file(top, "states", run); !states.empty())
    twin.states = read_states(states, twin.chain);
  if (const Path rollout = named_file(top, "rollout", run); !rollout.empty())
    twin.rollout = read_states(rollout, twin.chain);
  return twin;
}

Twin load_chain(const Path& path, const chain::Chain& held) {
  const Json document = core::parse_json_or_discard(core::read_file(path));
  if (document.is_discarded()) throw InputError(path.string(), "is not JSON", "give the 'chain' object of a twin.json");
  const auto numbers = [](const Vector3& v) { return Json{v.x(), v.y(), v.z()}; };
  const Json grasp{{"direction", numbers(held.direction)}, {"bending_axis", numbers(held.bending_axis)}};
  const bool whole = document.is_object() && document.contains("chain");
  Twin twin;
  read_rope(Node(whole ? document["chain"] : document, path.string(), "chain"), Node(grasp, path.string(), "grasp"),
            twin);
  return twin;
}

}  // namespace chainsplat::twin
