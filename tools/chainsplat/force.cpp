// force.cpp - the force that the outside exerts on the rope, from angles over time: one JSON line a time step.
#include "chainsplat/force.h"

#include <cstdio>
#include <iostream>
#include <memory>

#include "chainsplat/pipeline.h"
#include "cli.h"
#include "command_line.h"

namespace chainsplat::tools {

namespace {

struct ForceRequest {
  std::string run, states, estimate, base, contact = "auto", hand;
  bool live = false;
};

pipeline::ForceOptions options_of(const ForceRequest& request) {
  pipeline::ForceOptions options;
  options.states = request.states;
  options.estimate = request.estimate;
  options.base = request.base;
  options.hand = request.hand;
  options.live = request.live;
  options.check();
  if (request.contact == "auto") return options;
  if (request.contact.ends_with(".csv") || request.contact == "-") {
    options.contacts = request.contact;
    return options;
  }
  math::Vector3 point;
  char rest = 0;
  if (std::sscanf(request.contact.c_str(), "%lf,%lf,%lf%c", &point[0], &point[1], &point[2], &rest) != 3 ||
      !point.allFinite())
    throw InputError("--contact", "'" + request.contact + "' is no point", "give X,Y,Z in meters, a FILE.csv or auto");
  options.contact = point;
  return options;
}

void force(const Globals& globals, const ForceRequest& request) {
  if (globals.json)
    throw InputError("--json", "force writes one JSON line a time step, not one document", "leave it out");
  const auto write = [](const force::Estimate& estimate, bool known_mass) {
    std::cout << force::to_json(estimate, known_mass) << "\n";
    flush_output();
  };
  const pipeline::ForceResult found = pipeline::forces(request.run, options_of(request), write, terminal());
  say(std::to_string(found.states) + " time steps, touched in " + std::to_string(found.touching) + ".");
}

}  // namespace

void add_force_commands(Command app, const Globals& globals, Job& job) {
  Command command = app.add_command("force", "The outside's force on the rope: one JSON line a time step");
  auto request = std::make_shared<ForceRequest>();
  command.add_option("RUN", request->run, "Run folder of an identified twin").required();
  command.add_option("--states", request->states, "Angles over time; - is standard input").type_name("STATES.csv");
  command.add_option("--estimate", request->estimate, "Output of 'chainsplat estimate'; - is standard input")
      .type_name("FILE.jsonl");
  command.add_option("--base", request->base, "Base motion (default: that of the twin's own capture)")
      .type_name("FILE.tum");
  command
      .add_option("--contact", request->contact,
                  "Where it is touched: X,Y,Z in the world, FILE.csv with time,x,y,z, or auto (default).\n"
                  "Points farther than three diameters from the rope do not touch it")
      .type_name("X,Y,Z|FILE.csv|auto");
  command.add_option("--hand", request->hand, "Point cloud of the hand; the nearest Gaussian is touched")
      .excludes("--contact")
      .type_name("FILE.ply");
  command.add_flag("--live", request->live,
                   "While states come in: a line is written two states after its own, from these and earlier ones");
  command.callback([&globals, &job, request] { job = [&globals, request] { force(globals, *request); }; });
}

}  // namespace chainsplat::tools
