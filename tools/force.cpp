// force.cpp - the force that the outside exerts on the rope, from angles over time: one JSON line a time step.
#include <CLI/CLI.hpp>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <iostream>
#include <limits>
#include <memory>
#include <nlohmann/json.hpp>
#include <sstream>

#include "chainsplat/force.h"
#include "chainsplat/twin.h"
#include "cli.h"
#include "run_folder.h"

namespace chainsplat::tools {

namespace {

using Json = nlohmann::json;

constexpr double kNear = 3.0;  // diameters from the rope within which something may touch it

struct ForceRequest {
  std::string run, states, estimate, base, contact = "auto", hand;
  bool live = false;
};

// Lines of `estimate`.
void read_estimates(const std::string& name, const chain::Chain& chain, chain::States& states,
                    std::vector<math::MatrixX>& standing) {
  const int angles = chain.angles();
  std::istringstream lines(core::read_file(input_path(name)));
  std::string line;
  for (int number = 1; std::getline(lines, line); ++number) {
    if (line.empty()) continue;
    const std::string where = name + ": line " + std::to_string(number);
    try {
      const Json object = Json::parse(line);
      if (object.value("lost", false)) continue;
      const auto theta = object.at("theta").get<std::vector<double>>();
      const auto deviation = object.at("sigma").get<std::vector<double>>();
      const double time = object.at("time").get<double>();
      if (static_cast<int>(theta.size()) != angles || deviation.size() != theta.size())
        throw InputError(where, "has not the twin's " + std::to_string(angles) + " angles",
                         "give estimates of this twin");
      if (!states.time.empty() && !(time > states.time.back()))
        throw InputError(where, "its time does not increase", "give the lines in order");
      states.time.push_back(time);
      states.theta.push_back(Eigen::Map<const math::VectorX>(theta.data(), angles));
      if (!object.contains("covariance")) {
        standing.push_back(force::angle_covariance(chain, states.theta.back(),
                                                   Eigen::Map<const math::VectorX>(deviation.data(), angles)));
        continue;
      }
      const auto triangle = object.at("covariance").get<std::vector<double>>();
      const std::size_t all = 2 * static_cast<std::size_t>(angles);  // with the rates: their rows follow
      if (triangle.size() != angles * (angles + std::size_t{1}) / 2 && triangle.size() != all * (all + 1) / 2)
        throw InputError(where + ": covariance", "is no lower triangle of the angles", "give the output of estimate");
      standing.emplace_back(angles, angles);
      for (int row = 0, i = 0; row < angles; ++row)
        for (int column = 0; column <= row; ++column, ++i)
          standing.back()(row, column) = standing.back()(column, row) = triangle[i];
    } catch (const Json::exception&) {
      throw InputError(where, "is no line of 'chainsplat estimate'", "give its output");
    }
  }
}

// 'time,x,y,z' a line with a head; x, y, z empty when nothing touches.
struct ContactPoint {
  double time;
  std::optional<math::Vector3> point;
};

std::vector<ContactPoint> read_contacts(const std::string& name) {
  std::istringstream lines(core::read_file(input_path(name)));
  std::string line;
  std::vector<ContactPoint> out;
  std::getline(lines, line);  // the head
  for (int number = 2; std::getline(lines, line); ++number) {
    if (line.empty() || line == "\r") continue;
    std::vector<std::string> cells;
    std::istringstream row(line);
    for (std::string cell; std::getline(row, cell, ',');) {
      while (!cell.empty() && (cell.back() == '\r' || cell.back() == ' ')) cell.pop_back();
      cells.push_back(cell);
    }
    cells.resize(std::max<std::size_t>(cells.size(), 4));
    double values[4] = {};
    int given = 0;
    bool good = cells.size() == 4;
    for (int i = 0; i < 4 && good; ++i) {
      if (cells[i].empty()) continue;
      char* end = nullptr;
      values[i] = std::strtod(cells[i].c_str(), &end);
      good = *end == '\0' && (i > 0 || std::isfinite(values[i]));
      given += i > 0 && std::isfinite(values[i]);
    }
    if (!good || cells[0].empty() || (given != 0 && given != 3) || (!out.empty() && values[0] <= out.back().time))
      throw InputError(name + ": line " + std::to_string(number), "is not 'time,x,y,z' with increasing times",
                       "leave x, y and z empty when nothing touches");
    out.push_back({values[0], std::nullopt});
    if (given == 3) out.back().point = math::Vector3(values[1], values[2], values[3]);
  }
  if (out.empty()) throw InputError(name, "has no rows", "give 'time,x,y,z' lines below a head line");
  return out;
}

void force(const Globals& globals, const ForceRequest& request) {
  if (globals.json)
    throw InputError("--json", "force writes one JSON line a time step, not one document", "leave it out");
  if (request.states.empty() == request.estimate.empty())
    throw InputError("--states, --estimate", "one of the two is needed", "give the angles over time");
  const twin::Twin twin = load_twin(request.run);
  const dynamics::Model model = model_of(twin, request.run);
  const trajectory::Trajectory base = request.base.empty() ? own_base(request.run) : read_base(request.base);
  if (request.base.empty()) core::warn("--base: is missing; the base motion of the twin's own capture is assumed");
  chain::States states;
  std::vector<math::MatrixX> standing;
  if (request.estimate.empty())
    states = twin::read_states(input_path(request.states), twin.chain.angles());
  else
    read_estimates(request.estimate, twin.chain, states, standing);
  if (states.time.size() < 3)
    throw InputError(request.estimate.empty() ? request.states : request.estimate, "has fewer than three states",
                     "give more: forces need accelerations");
  const double slack = 1.0 / 30.0;  // s, a frame beyond the last sample
  if (base.samples().size() > 1 &&
      (states.time.front() < base.start() - slack || states.time.back() > base.end() + slack))
    throw InputError(request.base.empty() ? request.run : request.base,
                     "the base motion covers " + core::exact(base.start()) + " to " + core::exact(base.end()) +
                         " s, the states " + core::exact(states.time.front()) + " to " +
                         core::exact(states.time.back()) + " s",
                     "give the base motion of these states with --base");
  const force::Motion motion = force::smooth(states, standing, request.live);

  const std::size_t count = motion.time.size();
  std::vector<std::optional<force::Contact>> contacts;
  const auto nearest = [&](std::size_t f, const math::MatrixX& points) {
    return force::nearest_contact(twin.chain, twin.gaussians, base.pose(motion.time[f]), motion.theta[f], points);
  };
  // what is far from the rope does not touch it; what always is was meant otherwise
  const auto keep_near = [&](const std::string& where) {
    double least = std::numeric_limits<double>::infinity();
    for (std::optional<force::Contact>& contact : contacts) {
      if (!contact) continue;
      least = std::min(least, contact->distance);
      if (contact->distance > kNear * twin.chain.diameter) contact.reset();
    }
    if (!std::isfinite(least)) throw InputError(where, "names no contact at any of the states' times", "correct it");
    if (least > kNear * twin.chain.diameter)
      throw InputError(where, "never comes nearer to the rope than " + core::exact(least) + " m",
                       "give meters in the world frame, and the base motion of the states");
  };
  if (!request.hand.empty()) {
    const splat::Gaussians cloud = twin::read_ply(request.hand);
    if (cloud.count == 0) throw InputError(request.hand, "has no point", "give a point cloud of the hand");
    math::MatrixX points(3, cloud.count);
    for (int i = 0; i < cloud.count; ++i)
      points.col(i) << cloud.mean[3 * i], cloud.mean[3 * i + 1], cloud.mean[3 * i + 2];
    for (std::size_t f = 0; f < count; ++f) contacts.push_back(nearest(f, points));
    keep_near(request.hand);
  } else if (request.contact.ends_with(".csv") || request.contact == "-") {
    const std::vector<ContactPoint> given = read_contacts(request.contact);
    const double most = count > 1 ? (motion.time.back() - motion.time.front()) / (count - 1.0) : 0.0;  // s apart
    for (std::size_t f = 0; f < count; ++f) {
      const auto at = std::min_element(given.begin(), given.end(), [&](const ContactPoint& a, const ContactPoint& b) {
        return std::abs(a.time - motion.time[f]) < std::abs(b.time - motion.time[f]);
      });
      contacts.emplace_back();
      if (at->point && std::abs(at->time - motion.time[f]) <= most) contacts.back() = nearest(f, *at->point);
    }
    keep_near(request.contact);
  } else if (request.contact != "auto") {
    math::Vector3 point;
    char rest = 0;
    if (std::sscanf(request.contact.c_str(), "%lf,%lf,%lf%c", &point[0], &point[1], &point[2], &rest) != 3 ||
        !point.allFinite())
      throw InputError("--contact", "'" + request.contact + "' is no point",
                       "give X,Y,Z in meters, a FILE.csv or auto");
    for (std::size_t f = 0; f < count; ++f) contacts.push_back(nearest(f, point));
    keep_near("--contact");
  }
  const std::vector<force::Estimate> estimates = force::estimate(
      model, [&](double time) { return base.at(time); }, motion, contacts, request.live);
  int touching = 0;
  for (const force::Estimate& e : estimates) {
    std::cout << force::to_json(e, twin.known_mass) << "\n" << std::flush;
    touching += e.touching;
  }
  if (!twin.known_mass) core::warn(request.run + ": the rope's mass is not known; forces are per kilogram of rope");
  say(std::to_string(count) + " time steps, touched in " + std::to_string(touching) + ".");
}

}  // namespace

void add_force_commands(CLI::App& app, const Globals& globals, Job& job) {
  CLI::App* command = app.add_subcommand("force", "The outside's force on the rope: one JSON line a time step");
  auto request = std::make_shared<ForceRequest>();
  command->add_option("RUN", request->run, "Run folder of an identified twin")->required();
  command->add_option("--states", request->states, "Angles over time; - is standard input")->type_name("STATES.csv");
  command->add_option("--estimate", request->estimate, "Output of 'chainsplat estimate'; - is standard input")
      ->type_name("FILE.jsonl");
  command->add_option("--base", request->base, "Base motion (default: that of the twin's own capture)")
      ->type_name("FILE.tum");
  command
      ->add_option("--contact", request->contact,
                   "Where it is touched: X,Y,Z in the world, FILE.csv with time,x,y,z, or auto (default).\n"
                   "Points farther than three diameters from the rope do not touch it")
      ->type_name("X,Y,Z|FILE.csv|auto");
  command->add_option("--hand", request->hand, "Point cloud of the hand; the nearest Gaussian is touched")
      ->type_name("FILE.ply");
  command->add_flag("--live", request->live, "Use the past alone: a filter instead of a smoother");
  command->callback([&globals, &job, request] { job = [&globals, request] { force(globals, *request); }; });
}

}  // namespace chainsplat::tools
