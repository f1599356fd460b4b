// new.cpp - a twin without videos: empty, to identify from measured markers, or a rod of known stiffness and mass.
#include <cmath>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>
#include <optional>
#include <utility>

#include "chainsplat/dynamics/rod.h"
#include "chainsplat/json.h"
#include "chainsplat/pipeline.h"
#include "chainsplat/run_folder.h"
#include "cli.h"
#include "command_line.h"

namespace chainsplat::tools {

namespace {

constexpr double kPerpendicular = 1e-6;  // largest cosine between direction and bending axis that is taken as 0

struct NewRequest {
  std::string out, bending;                            // empty: spatial, on a table planar
  double length = 0.0, diameter = 0.02, mass = 0.0;    // m, m, kg; mass 0: unknown
  double bending_stiffness = -1.0, retardation = 0.0;  // EI, N m^2, negative: not given; s
  PayloadRequest payload;
  std::vector<double> table;  // m, a point of it; empty: the rope hangs free
  double friction = -1.0;     // its coefficient, negative: not given
  int joints = 8;
  std::vector<double> direction, bending_axis, gravity{0, 0, -9.81};
  bool force = false;
};

math::Vector3 vector_of(const std::vector<double>& values) { return {values[0], values[1], values[2]}; }

math::Vector3 unit_of(const std::vector<double>& values, const char* option) {
  const math::Vector3 v = vector_of(values);
  if (!v.allFinite() || !(v.norm() > 0.0))
    throw InputError(option, "has no direction", "give three numbers, not all 0");
  return v.normalized();
}

// A uniform straight rod that hangs free, in still air without drag, or lies on a table with this normal.
dynamics::Parameters rod(const chain::Chain& chain, const NewRequest& request, const math::Vector3& gravity,
                         const std::optional<math::Vector3>& table_normal) {
  dynamics::Parameters rod;
  const int links = chain.links() - 1;
  rod.gravity = gravity;
  rod.table_normal = table_normal;
  rod.radius = 0.5 * chain.diameter;
  for (std::vector<double>* zeros : {&rod.viscous_friction, &rod.coulomb_friction, &rod.air_linear, &rod.air_quadratic})
    zeros->assign(links, 0.0);
  if (table_normal) rod.coulomb_friction.assign(links, request.friction);
  for (int j = 1; j <= links; ++j)
    rod.link_mass.push_back(request.mass * (chain.link_end(j) - chain.link_start(j)) / chain.length);
  if (const std::optional<capture::Payload> payload = payload_of(request.payload))
    rod.tip_mass = payload->mass, rod.tip_length = payload->length.value_or(0.0);
  rod.rest_angle.assign(chain.angles(), 0.0);
  const auto stand_for_rod = [&](double tension) {
    rod.stiffness.clear(), rod.damping.clear();
    for (const int link : chain.child_link) {
      const dynamics::RodJoint joint = dynamics::rod_joint(chain, link, request.bending_stiffness, tension);
      rod.stiffness.push_back(joint.stiffness);
      rod.damping.push_back(request.retardation * joint.slope);
    }
  };
  stand_for_rod(0.0);
  if (table_normal || !(request.bending_stiffness > 0.0)) return rod;
  // how it hangs says how taut it is, which changes little how it hangs
  try {
    const math::VectorX hanging = dynamics::static_equilibrium(dynamics::make_model(chain, rod), math::Pose()).theta;
    stand_for_rod(dynamics::grasp_tension(rod, dynamics::first_direction(chain, hanging, math::Pose())));
  } catch (const WorkError&) {
    // it stands on its grasp, where nothing is taut
  }
  return rod;
}

// What CLI11's bounds let pass: no comparison with NaN is true.
void check_numbers(const NewRequest& request) {
  for (const auto& [option, value] : {std::pair("--length", request.length),
                                      {"--diameter", request.diameter},
                                      {"--mass", request.mass},
                                      {"--bending-stiffness", request.bending_stiffness},
                                      {"--retardation", request.retardation},
                                      {"--friction", request.friction}})
    if (std::isnan(value)) throw InputError(option, "is not a number", "give one");
}

void make_new(const Globals& globals, const NewRequest& request) {
  check_numbers(request);
  if (request.bending_stiffness >= 0.0 && !(request.mass > 0.0))
    throw InputError("--bending-stiffness", "moves nothing without a mass", "give --mass too");
  if (request.retardation > 0.0 && request.bending_stiffness < 0.0)
    throw InputError("--retardation", "is damping over stiffness, and there is none", "give --bending-stiffness too");
  const bool on_table = !request.table.empty();
  if (request.friction >= 0.0 && !on_table)
    throw InputError("--friction", "is that of a table, and there is none", "give --table too");
  if (request.friction >= 0.0 && request.bending_stiffness < 0.0)
    throw InputError("--friction", "is that of a rod that is known", "give --bending-stiffness too, or identify both");
  if (on_table && request.bending_stiffness >= 0.0 && request.friction < 0.0)
    throw InputError("--bending-stiffness", "does not say how a rod slides on a table", "give --friction too");
  if (on_table && request.direction.empty())
    throw InputError("--table", "does not say where the rope leaves the grasp", "give --direction, for example 1,0,0");
  pipeline::check_output_folder(request.out, request.force, "name another folder, or give --force");
  const math::Vector3 direction =
      request.direction.empty() ? math::Vector3(-math::Vector3::UnitZ()) : unit_of(request.direction, "--direction");
  math::Vector3 bending_axis;
  if (request.bending_axis.empty()) {
    // any axis across the rope; y where it is one, on a table z, as in the examples of captures
    const math::Vector3 y = math::Vector3::UnitY(), z = math::Vector3::UnitZ();
    const math::Vector3 first = on_table ? z : y, second = on_table ? y : z;
    const math::Vector3 across = std::abs(direction.dot(first)) < 0.9 ? first : second;
    bending_axis = (across - direction * direction.dot(across)).normalized();
  } else {
    bending_axis = unit_of(request.bending_axis, "--bending-axis");
    if (std::abs(bending_axis.dot(direction)) > kPerpendicular)
      throw InputError("--bending-axis", "is not perpendicular to --direction", "give an axis across the rope");
  }
  twin::Twin twin;
  twin.gravity = vector_of(request.gravity);
  if (!twin.gravity.allFinite()) throw InputError("--gravity", "is not finite", "give three finite numbers in m/s^2");
  if (on_table) {
    twin.tabletop = true;
    twin.table_point = vector_of(request.table);
    twin.table_normal = -unit_of(request.gravity, "--gravity");
    if (!twin.table_point->allFinite()) throw InputError("--table", "is not finite", "give three finite numbers in m");
  }
  const std::string bending = !request.bending.empty() ? request.bending : on_table ? "planar" : "spatial";
  twin.chain = chain::make_chain(request.length, request.diameter, direction, bending_axis, request.joints,
                                 bending == "planar" ? chain::Bending::planar : chain::Bending::spatial, false);
  twin.known_mass = request.mass > 0.0;
  if (twin.known_mass) twin.provenance.mass = request.mass;
  twin.provenance.payload = payload_of(request.payload);
  if (twin.provenance.payload && !twin.known_mass)
    throw InputError("--tip-mass", "says nothing beside a rope of unknown mass", "give --mass, too");
  if (request.bending_stiffness >= 0.0) twin.parameters = rod(twin.chain, request, twin.gravity, twin.table_normal);
  if (twin.parameters && on_table) {  // friction holds it in any shape; it begins straight, as it is at rest
    const math::VectorX straight = math::VectorX::Zero(twin.chain.angles());
    twin.initial = {0.0, straight, straight};
  }
  twin.provenance.version = CHAINSPLAT_VERSION;
  twin.provenance.seed = globals.seed;
  twin.provenance.options["bending"] = bending;
  twin.provenance.options["joints"] = std::to_string(request.joints);
  twin::save(twin, request.out);
  if (globals.json) {
    nlohmann::ordered_json document;
    document["run"] = request.out;
    document["joints"] = twin.chain.links() - 1;
    document["angles"] = twin.chain.angles();
    std::cout << core::json_text(document) << "\n";
  } else {
    std::cout << "twin: " << request.out << "\n";
  }
}

}  // namespace

void add_new_command(Command app, const Globals& globals, Job& job) {
  Command command =
      app.add_command("new", "Make a twin without videos: empty, to identify from markers, or of a known rod");
  auto request = std::make_shared<NewRequest>();
  command.add_option("-o,--output", request->out, "Run folder to make: the twin").required().type_name("RUN");
  command.add_option("--length", request->length, "From the grasp to the free end, m")
      .required()
      .positive()
      .type_name("M");
  command.add_option("--diameter", request->diameter, "m (default 0.02)").positive().type_name("M");
  command.add_option("--joints", request->joints, "Joints along the rope (default 8)")
      .in_range(1, pipeline::kMostJoints)
      .type_name("N");
  command
      .add_option("--bending", request->bending,
                  "Axes a joint: planar (one, default on a table) or spatial (two, default)")
      .one_of({"planar", "spatial"})
      .type_name("KIND");
  const auto three = [&](const char* name, std::vector<double>& into, const char* help) {
    command.add_option(name, into, help).delimiter(',').expected(3).type_name("X,Y,Z");
  };
  three("--direction", request->direction,
        "Where the rope leaves the grasp, base frame (default 0,0,-1; to be given with --table)");
  three("--bending-axis", request->bending_axis,
        "Axis of bending, base frame (default: across, near y; on a table near z)");
  three("--gravity", request->gravity, "World frame, m/s^2 (default 0,0,-9.81)");
  three("--table", request->table, "The rope lies on a table, level, through this point of the world, m");
  command.add_option("--friction", request->friction, "Coefficient of that table's friction, with --bending-stiffness")
      .not_negative()
      .type_name("MU");
  command.add_option("--mass", request->mass, "Of the rope, kg (default: unknown, forces are per kilogram)")
      .positive()
      .type_name("KG");
  add_payload_options(command, request->payload);
  command
      .add_option("--bending-stiffness", request->bending_stiffness,
                  "EI of a uniform straight rod, N m^2; with --mass the twin is then ready for rollout")
      .not_negative()
      .type_name("EI");
  command.add_option("--retardation", request->retardation, "Its damping over its stiffness, s (default 0)")
      .not_negative()
      .type_name("S");
  command.add_flag("--force", request->force, "Also into a folder that is not empty");
  command.callback([&globals, &job, request] { job = [&globals, request] { make_new(globals, *request); }; });
}

}  // namespace chainsplat::tools
