// Writes twin.json and the run folder as a whole. The keys are documented in twin.h.
#include <cmath>
#include <nlohmann/json.hpp>

#include "chainsplat/json.h"
#include "chainsplat/properties.h"
#include "chainsplat/solve_json.h"
#include "chainsplat/twin.h"
#include "chainsplat/twin_json.h"
#include "src/twin/file_format.h"

namespace chainsplat::twin {

using Json = nlohmann::ordered_json;
using math::Vector3;

namespace {

constexpr const char *kGaussians = "gaussians.ply", *kStates = "states.csv", *kRollout = "rollout.csv";

template <class Vector>
Json list(const Vector& values) {
  Json out = Json::array();
  for (const double value : values) out.push_back(value);  // nlohmann::json writes non-finite numbers as null
  return out;
}

Json list(const math::VectorX& values) { return list(std::vector<double>(values.begin(), values.end())); }

// JSON text of a value. Bytes of file names that are not UTF-8 are replaced, because JSON cannot represent them.
std::string text_of(const Json& value) { return core::json_text(value, -1); }

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

nlohmann::ordered_json to_json(const capture::Corrections& given) {
  // As they are read, so that a run that was interrupted has the same bytes as one that was not.
  const auto& order = capture::corrected_quantities();
  const auto place = [&](const capture::Correction& c) {
    return c.quantity == &capture::lost_frames() ? order.size() : static_cast<std::size_t>(c.quantity - order.data());
  };
  capture::Corrections corrections = given;
  std::stable_sort(corrections.begin(), corrections.end(),
                   [&](const auto& a, const auto& b) { return place(a) < place(b); });
  Json out{{"cameras", Json::object()}};
  for (const capture::Correction& c : corrections) {
    const bool camera = std::string(c.quantity->subject) == "camera";
    Json& subject = camera ? out["cameras"][c.subject] : out[c.subject];
    if (c.quantity == &capture::lost_frames()) {
      subject[c.quantity->name] = {{"value", list(c.value)}, {"recording", c.calibration}};
      continue;
    }
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

  if (!chain.lift.empty()) out["lift"] = chain.lift;
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
    if (p->tip_length > 0.0) out["tip_length"] = p->tip_length;
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
  Json laws{
      {"joint", "torque = -stiffness (theta - rest_angle) - damping thetadot"},
      {"inertia", "links are uniform cylinders; tip_mass is a thin rod of tip_length that goes on at the free end"}};
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
    if (twin.rolling)
      laws["rolling"] =
          "the material turns within the links as friction, torsion and its set out of the table's plane ask, and "
          "carries the texture along (docs/mathematics.md 3.14)";
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
  if (std::isfinite(e.misfit)) out["misfit"] = e.misfit;
  if (e.solver) out["solver"] = *e.solver;
  return out;
}

// Of a twin that can be set in motion; numbers that cannot are saved all the same.
Json properties_json(const Twin& twin) {
  Json out = Json::object();
  try {
    for (const Property& p : properties(twin))
      out[p.name] = {{"value", p.value}, {"sigma", std::isfinite(p.sigma) ? Json(p.sigma) : Json()}, {"unit", p.unit}};
  } catch (const InputError&) {
  }
  return out;
}

}  // namespace

std::string mode_text(Mode mode) { return mode == Mode::paper ? "paper" : "fast"; }

std::map<std::string, std::string> option_texts(const Provenance& p) {
  std::map<std::string, std::string> texts = p.options;
  if (p.mass) texts["mass"] = core::exact(*p.mass);
  if (p.payload) {
    texts["tip_mass"] = core::exact(p.payload->mass);
    if (p.payload->sigma > 0.0) texts["tip_mass"] += "," + core::exact(p.payload->sigma);
    if (p.payload->length) texts["tip_length"] = core::exact(*p.payload->length);
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
  const dynamics::Parameters* const known = twin.parameters ? &*twin.parameters : nullptr;
  const splat::Light& light = twin.gaussians.light;
  const bool plain =
      !light.known() && twin.gaussians.pixel_footprint == 0.0 &&
      (!known || (known->bending_friction.empty() && known->torsional_stiffness.empty() && known->tip_length == 0.0));
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
  if (twin.rolling)
    out["rolling"] = {{"torsion", twin.rolling->torsion}, {"friction", twin.rolling->friction},
                      {"speed", twin.rolling->speed},     {"set", twin.rolling->set},
                      {"texture", twin.rolling->texture}, {"deviation", twin.rolling->deviation}};
  if (light.known()) {
    const math::Matrix3& q = light.quadratic;
    out["light"] = {{"constant", light.constant},
                    {"linear", list(light.linear)},
                    {"quadratic", {q(0, 0), q(0, 1), q(0, 2), q(1, 1), q(1, 2), q(2, 2)}}};
  }
  if (twin.gaussians.pixel_footprint > 0.0) out["pixel_footprint"] = twin.gaussians.pixel_footprint;
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

}  // namespace chainsplat::twin
