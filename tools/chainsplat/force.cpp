// force.cpp - the force that the outside exerts on the rope, from angles over time: one JSON line a time step.
#include <CLI/CLI.hpp>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <functional>
#include <iostream>
#include <limits>
#include <map>
#include <memory>
#include <sstream>

#include "chainsplat/estimate_lines.h"
#include "chainsplat/force.h"
#include "chainsplat/run_folder.h"
#include "chainsplat/twin.h"
#include "cli.h"

namespace chainsplat::tools {

namespace {

constexpr double kNear = 3.0;       // diameters from the rope within which something may touch it
constexpr double kLiveApart = 0.1;  // s, how far from a state a line of a contact file may be, where states come in

struct ForceRequest {
  std::string run, states, estimate, base, contact = "auto", hand;
  bool live = false;
};

// A state, and the covariance of the error that stays for many frames, if that is known.
struct State {
  double time = 0.0;
  math::VectorX theta;
  math::MatrixX standing;  // n x n, or empty
  std::optional<estimation::BaseCorrection> base = {};
};

// A line of `estimate`; none where it is lost. `before`: time of the state before.
std::optional<State> read_estimate(const std::string& text, const std::string& where, const chain::Chain& chain,
                                   double before) {
  const std::optional<estimation::EstimateLine> line =
      estimation::read_estimate_line(text, where, chain.angles(), before);
  if (!line) return {};
  State out{line->time, line->theta, {}, line->base};
  if (line->sigma.size() == 0) return out;  // as estimate's solver adam writes it
  out.standing =
      line->covariance.size() > 0 ? line->covariance : force::angle_covariance(chain, line->theta, line->sigma);
  return out;
}

// Gives every state to `take`, as soon as its line is there.
void each_state(const ForceRequest& request, const chain::Chain& chain, const std::function<void(const State&)>& take) {
  if (request.estimate.empty()) {
    const chain::States states = twin::read_states(input_path(request.states), chain.angles());
    for (std::size_t f = 0; f < states.time.size(); ++f) take({states.time[f], states.theta[f], {}});
    return;
  }
  std::ifstream in(input_path(request.estimate));
  if (!in) throw InputError(request.estimate, "cannot be read", "give the output of estimate, or - for standard input");
  double before = -std::numeric_limits<double>::infinity();
  std::optional<bool> known;  // whether the lines have deviations
  std::string line;
  for (int number = 1; estimation::next_line(in, line, request.estimate); ++number) {
    if (line.empty()) continue;
    const auto state = read_estimate(line, request.estimate + ": line " + std::to_string(number), chain, before);
    if (!state) continue;
    before = state->time;
    if (!known) known = state->standing.size() > 0;
    if (*known != (state->standing.size() > 0))
      throw InputError(
          request.estimate + ": line " + std::to_string(number),
          *known ? "has no deviations, unlike the lines before" : "has deviations, unlike the lines before",
          "give the output of one run of estimate");
    take(*state);
  }
}

// 'time,x,y,z' a line with a head; x, y, z empty when nothing touches.
struct ContactPoint {
  double time;
  std::optional<math::Vector3> point;
};

std::vector<ContactPoint> read_contacts(const std::string& name) {
  const std::string text = core::read_file(input_path(name));
  const std::string mend = "leave x, y and z empty when nothing touches";
  std::vector<ContactPoint> out;
  const std::vector<core::TableLine> lines = core::table_lines(text);
  for (std::size_t k = 1; k < lines.size(); ++k) {  // below the head
    const std::vector<double> row = core::table_numbers(name, lines[k], 4, mend, true);
    const int given =
        static_cast<int>(std::count_if(row.begin() + 1, row.end(), [](double x) { return !std::isnan(x); }));
    if (std::isnan(row[0]) || (given != 0 && given != 3) || (!out.empty() && row[0] <= out.back().time))
      throw InputError(name + ":" + std::to_string(lines[k].number), "is not 'time,x,y,z' with increasing times", mend);
    out.push_back({row[0], std::nullopt});
    if (given == 3) out.back().point = math::Vector3(row[1], row[2], row[3]);
  }
  if (out.empty()) throw InputError(name, "has no rows", "give 'time,x,y,z' lines below a head line");
  return out;
}

// What is said to touch; empty for 'auto'.
// `nearest`: of points (world, columns) at a time. `apart`: s, how far from a time a line of a file may be.
force::ContactAt contact_of(
    const ForceRequest& request,
    const std::function<force::Contact(double, const math::VectorX&, const math::MatrixX&)>& nearest, double apart) {
  if (!request.hand.empty()) {
    const math::MatrixX points = twin::read_points(request.hand);
    if (points.cols() == 0) throw InputError(request.hand, "has no point", "give a point cloud of the hand");
    return [=](double time, const math::VectorX& theta) { return nearest(time, theta, points); };
  }
  if (request.contact.ends_with(".csv") || request.contact == "-") {
    const std::vector<ContactPoint> given = read_contacts(request.contact);
    return [=](double time, const math::VectorX& theta) -> std::optional<force::Contact> {
      const auto at = std::min_element(given.begin(), given.end(), [&](const ContactPoint& a, const ContactPoint& b) {
        return std::abs(a.time - time) < std::abs(b.time - time);
      });
      if (!at->point || std::abs(at->time - time) > apart) return {};
      return nearest(time, theta, *at->point);
    };
  }
  if (request.contact == "auto") return {};
  math::Vector3 point;
  char rest = 0;
  if (std::sscanf(request.contact.c_str(), "%lf,%lf,%lf%c", &point[0], &point[1], &point[2], &rest) != 3 ||
      !point.allFinite())
    throw InputError("--contact", "'" + request.contact + "' is no point", "give X,Y,Z in meters, a FILE.csv or auto");
  return [=](double time, const math::VectorX& theta) { return nearest(time, theta, point); };
}

void force(const Globals& globals, const ForceRequest& request) {
  if (globals.json)
    throw InputError("--json", "force writes one JSON line a time step, not one document", "leave it out");
  if (request.states.empty() == request.estimate.empty())
    throw InputError("--states, --estimate", "one of the two is needed", "give the angles over time");
  const twin::Twin twin = pipeline::load_twin(request.run);
  const dynamics::Model model = pipeline::model_of(twin, request.run);
  const trajectory::Trajectory base =
      request.base.empty() ? pipeline::own_base(request.run) : pipeline::read_base(input_path(request.base));
  if (request.base.empty()) core::warn("--base: is missing; the base motion of the twin's own capture is assumed");
  const std::string source = request.estimate.empty() ? request.states : request.estimate;
  const std::string where = !request.hand.empty()                            ? request.hand
                            : request.contact.find(',') != std::string::npos ? "--contact"
                                                                             : request.contact;
  const estimation::BaseCorrection known =
      request.base.empty() ? estimation::base_correction(twin.corrections) : estimation::BaseCorrection{};
  // what the states say of the base: the last one before a time, or the first
  std::map<double, estimation::BaseCorrection> corrections;
  const dynamics::BaseFunction given = [&](double time) { return base.at(time); };
  const dynamics::BaseFunction base_at = [&](double time) {
    auto at = corrections.upper_bound(time);
    if (at != corrections.begin()) --at;
    return estimation::corrected(given, at == corrections.end() ? estimation::BaseCorrection{} : at->second, time);
  };
  const double near = kNear * twin.chain.diameter;
  double least = std::numeric_limits<double>::infinity();  // m, of what is said to touch, from the rope
  const auto nearest = [&](double time, const math::VectorX& theta, const math::MatrixX& points) {
    return force::nearest_contact(twin.chain, twin.gaussians, base_at(time).pose, theta, points);
  };
  // what is far from the rope does not touch it; what always is was meant otherwise
  const auto with_near = [&](const force::ContactAt& contact) -> force::ContactAt {
    if (!contact) return {};
    return [&least, near, contact](double time, const math::VectorX& theta) {
      std::optional<force::Contact> out = contact(time, theta);
      if (!out) return out;
      least = std::min(least, out->distance);
      if (out->distance > near) out.reset();
      return out;
    };
  };
  const auto check_near = [&] {
    if (!std::isfinite(least)) throw InputError(where, "names no contact at any of the states' times", "correct it");
    if (least > near)
      throw InputError(where, "never comes nearer to the rope than " + core::exact(least) + " m",
                       "give meters in the world frame, and the base motion of the states");
  };
  const double slack = 1.0 / 30.0;  // s, a frame beyond the last sample
  const auto check_time = [&](double first, double last) {
    if (base.samples().size() > 1 && (first < base.start() - slack || last > base.end() + slack))
      throw InputError(request.base.empty() ? request.run : request.base,
                       "the base motion covers " + core::exact(base.start()) + " to " + core::exact(base.end()) +
                           " s, the states " + core::exact(first) + " to " + core::exact(last) + " s",
                       "give the base motion of these states with --base");
  };
  std::size_t lines = 0, touching = 0;
  const auto check = [&](const force::Estimate& e) {
    if (!force::is_finite(e))
      throw InputError(source, "the force at " + core::exact(e.time) + " s is not a finite number",
                       "check the states about that time and the twin's parameters");
  };
  const auto write = [&](const force::Estimate& e) {
    check(e);
    std::cout << force::to_json(e, twin.known_mass) << "\n";
    flush_output();
    ++lines;
    touching += e.touching;
  };
  const std::string few = "has fewer than three states", more = "give more: forces need accelerations";
  const std::vector<dynamics::Model> deviations = force::deviations(model, twin.estimates);

  if (request.live) {
    const force::ContactAt contact = with_near(contact_of(request, nearest, kLiveApart));
    force::LiveForce live(model, deviations, base_at, contact);
    double first = std::numeric_limits<double>::infinity();
    try {
      each_state(request, twin.chain, [&](const State& state) {
        first = std::min(first, state.time);
        check_time(first, state.time);
        corrections = {
            {state.time, estimation::remaining(state.base, known)}};  // it goes for the few states before it, too
        if (const auto line = live.update(state.time, state.theta, state.standing)) write(*line);
      });
      if (live.taken() < 3) throw InputError(source, few, more);
      for (const force::Estimate& line : live.finish()) write(line);
    } catch (const InputError& error) {
      if (lines == 0) throw;
      throw pipeline::broken_off(error, "the lines so far are kept");
    }
    if (contact) check_near();
  } else {
    chain::States states;
    each_state(request, twin.chain, [&](const State& state) {
      corrections[state.time] = estimation::remaining(state.base, known);
      states.time.push_back(state.time);
      states.theta.push_back(state.theta);
      if (state.standing.size() > 0) states.covariance.push_back(state.standing);
    });
    const std::size_t count = states.time.size();
    if (count < 3) throw InputError(source, few, more);
    check_time(states.time.front(), states.time.back());
    twin::warn_beyond(twin.validity, twin::validity_of(twin.chain, base, states), source);
    const force::Motion motion = force::smooth(states);
    const force::ContactAt contact =
        with_near(contact_of(request, nearest, (states.time.back() - states.time.front()) / (count - 1.0)));
    std::vector<std::optional<force::Contact>> contacts;
    for (std::size_t f = 0; f < count && contact; ++f) contacts.push_back(contact(motion.time[f], motion.theta[f]));
    if (contact) check_near();
    const std::vector<force::Estimate> found = force::estimate(model, deviations, base_at, motion, contacts);
    std::for_each(found.begin(), found.end(), check);
    std::for_each(found.begin(), found.end(), write);
  }
  if (!twin.known_mass) core::warn(request.run + ": the rope's mass is not known; forces are per kilogram of rope");
  say(std::to_string(lines) + " time steps, touched in " + std::to_string(touching) + ".");
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
      ->excludes("--contact")
      ->type_name("FILE.ply");
  command->add_flag("--live", request->live,
                    "While states come in: a line is written two states after its own, from these and earlier ones");
  command->callback([&globals, &job, request] { job = [&globals, request] { force(globals, *request); }; });
}

}  // namespace chainsplat::tools
