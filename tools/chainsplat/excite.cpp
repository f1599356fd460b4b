// excite.cpp - excite: the base motion that is to be recorded next.
#include <CLI/CLI.hpp>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>

#include "chainsplat/excitation.h"
#include "chainsplat/motion_files.h"
#include "chainsplat/run_folder.h"
#include "chainsplat/twin.h"
#include "cli.h"

namespace chainsplat::tools {

namespace {

using Json = nlohmann::ordered_json;

struct Request {
  std::string run, out, axes;
  double rate = 100.0, noise = 0.0;  // rows per second; mm, 0: from the recording
  bool force = false;
  excitation::Options options;
};

// What the identified rollout leaves of the recording, as the sd of one coordinate of a point, m.
double noise_of(const twin::Twin& twin, const trajectory::Trajectory& base) {
  constexpr double kLeast = 0.5e-3, kUnknown = 2e-3;  // m
  double sum = 0.0;
  std::size_t count = 0;
  for (std::size_t k = 0; k < std::min(twin.states.time.size(), twin.rollout.time.size()); ++k) {
    if (twin.states.time[k] != twin.rollout.time[k]) return kUnknown;
    const math::Pose pose = base.pose(twin.states.time[k]);
    const auto place = [&](const math::VectorX& theta) {
      return chain::nodes(twin.chain, chain::link_motions(twin.chain, theta, pose));
    };
    const math::MatrixX off = place(twin.states.theta[k]) - place(twin.rollout.theta[k]);
    sum += off.rightCols(twin.chain.links() - 1).squaredNorm();
    count += 3 * (twin.chain.links() - 1);
  }
  return count == 0 ? kUnknown : std::max(kLeast, std::sqrt(sum / static_cast<double>(count)));
}

Json document_of(const excitation::Result& result, const Request& request) {
  const excitation::Prediction& p = result.prediction;
  Json out;
  out["duration"] = request.options.duration;
  out["noise"] = request.options.noise;
  out["gain"] = p.gain;
  if (!p.repeated.empty()) out["repeated_gain"] = p.repeated_gain;
  out["parameters"] = Json::array();
  for (std::size_t i = 0; i < p.names.size(); ++i) {
    Json row{{"name", p.names[i]}, {"standard_error", p.now[i]}, {"after_excitation", p.excited[i]}};
    if (!p.repeated.empty()) row["after_repetition"] = p.repeated[i];
    out["parameters"].push_back(row);
  }
  out["peak_velocity"] = result.peaks.velocity;
  out["peak_acceleration"] = result.peaks.acceleration;
  out["peak_jerk"] = result.peaks.jerk;
  out["peak_stroke"] = result.peaks.stroke;
  out["peak_yaw_velocity"] = result.peaks.yaw_velocity;
  out["peak_yaw_acceleration"] = result.peaks.yaw_acceleration;
  out["peak_yaw_jerk"] = result.peaks.yaw_jerk;
  out["peak_turn"] = result.peaks.turn;
  const planning::Limits& l = request.options.limits;
  out["limits"] = {{"velocity", l.velocity},
                   {"acceleration", l.acceleration},
                   {"jerk", l.jerk},
                   {"stroke", l.stroke},
                   {"yaw_velocity", l.yaw_velocity},
                   {"yaw_acceleration", l.yaw_acceleration},
                   {"yaw_jerk", l.yaw_jerk},
                   {"turn", l.turn}};
  return out;
}

void excite(const Globals& globals, Request& request) {
  watch_signals();
  excitation::Options& options = request.options;
  planning::check_rate(request.rate, options.duration, "give rows a second, for example 100");
  options.seed = globals.seed;
  if (!request.axes.empty()) options.axes = planning::parse_axes(request.axes);
  const Path out = request.out;
  const bool single = out.extension() == ".tum";
  if (single)
    pipeline::check_output_file(request.out);
  else
    pipeline::check_output_folder(request.out, request.force, "name another folder or give --force to write into it");

  const twin::Twin twin = pipeline::load_twin(request.run);
  const trajectory::Trajectory base = pipeline::own_base(request.run);
  excitation::Problem problem;
  problem.model = pipeline::model_of(twin, request.run);
  problem.tabletop = twin.tabletop;
  problem.base = base.pose(base.start());
  problem.estimates = twin.estimates;
  problem.initial.thetadot = math::VectorX::Zero(twin.chain.angles());
  if (twin.tabletop)
    problem.initial.theta = twin.initial ? twin.initial->theta : twin.states.theta.front();
  else
    problem.initial.theta = dynamics::static_equilibrium(problem.model, problem.base).theta;
  problem.recorded = [&](double t) { return base.at(t); };
  problem.recorded_start = twin.states.time.front();
  problem.recorded_end = twin.states.time.back();
  constexpr int kMostFrames = 100000;  // each has the derivatives of all angles by all parameters: some 10 kB
  if (const double seconds = std::max(options.duration, problem.recorded_end - problem.recorded_start);
      options.frame_rate * seconds > kMostFrames)
    throw InputError("--frame-rate",
                     core::exact(options.frame_rate) + " frames a second for " + core::exact(seconds) +
                         " s are more than the " + std::to_string(kMostFrames) + " frames that fit into memory",
                     "give those of the camera, for example 30");
  options.noise = request.noise > 0.0 ? 1e-3 * request.noise : noise_of(twin, base);

  const excitation::Result result = excitation::excite(problem, options);
  end_progress();
  const std::vector<double> times = planning::row_times(options.duration, request.rate);
  const Json document = document_of(result, request);
  const auto beside = [&](const char* name, const char* extension) {
    return single ? Path(out).replace_extension(extension) : out / name;
  };
  if (!single) core::make_folder(out);
  core::write_file(beside("base.tum", ".tum"), planning::motion_tum(result.motion, times));
  core::write_file(beside("base.csv", ".csv"), planning::motion_csv(result.motion, times));
  if (!single) {
    core::write_file(out / "states.csv", twin::states_csv(result.states));
    core::write_file(out / "excite.json", document.dump(1) + "\n");
  }
  if (globals.json) {
    std::cout << document.dump(1, ' ', false, Json::error_handler_t::replace) << "\n";
    return;
  }
  const excitation::Prediction& p = result.prediction;
  const bool compare = !p.repeated.empty();
  std::cout << "parameter                    standard error   after excitation"
            << (compare ? "   after the old motion again" : "") << "\n";
  char line[200];
  for (std::size_t i = 0; i < p.names.size(); ++i) {
    std::snprintf(line, sizeof line, "%-28.60s %14.3g %12.3g (%.2f)", p.names[i].c_str(), p.now[i], p.excited[i],
                  p.excited[i] / p.now[i]);
    std::cout << line;
    if (compare) {
      std::snprintf(line, sizeof line, " %12.3g (%.2f)", p.repeated[i], p.repeated[i] / p.now[i]);
      std::cout << line;
    }
    std::cout << "\n";
  }
  std::snprintf(line, sizeof line, "standard errors shrink to %.2f in the geometric mean of the uncertain directions",
                std::exp(-0.5 * p.gain));
  std::cout << line;
  if (compare) {
    std::snprintf(line, sizeof line, " (the old motion again: %.2f)", std::exp(-0.5 * p.repeated_gain));
    std::cout << line;
  }
  std::snprintf(line, sizeof line,
                "\npeaks: %.2f m/s, %.1f m/s^2, %.0f m/s^3, %.2f m from the start; motion: ", result.peaks.velocity,
                result.peaks.acceleration, result.peaks.jerk, result.peaks.stroke);
  std::cout << line << request.out << "\n";
}

}  // namespace

void add_excite_command(CLI::App& app, const Globals& globals, Job& job) {
  CLI::App* command =
      app.add_subcommand("excite", "Propose the base motion to record next: the parameters' errors shrink most");
  auto request = std::make_shared<Request>();
  excitation::Options& options = request->options;
  options.limits.stroke = 0.2;
  command->add_option("RUN", request->run, "Run folder of an identified twin")->required();
  command
      ->add_option(
          "-o,--output", request->out,
          "Folder for base.tum, base.csv, states.csv, excite.json; or a file NAME.tum, with NAME.csv beside it")
      ->required()
      ->type_name("MOTION");
  command
      ->add_option("--axes", request->axes,
                   "What moves (default: x, for a chain with two bending axes x,y, on a table x,y,yaw)")
      ->type_name("x,y,z,yaw");
  command->add_option("--duration", options.duration, "Of the motion, s (default 5)");
  command->add_option("--velocity", options.limits.velocity, "Limit of the base, m/s (default 1.5)");
  command->add_option("--acceleration", options.limits.acceleration, "Limit of the base, m/s^2 (default 10)");
  command->add_option("--jerk", options.limits.jerk, "Limit of the base, m/s^3 (default 200)");
  command->add_option("--stroke", options.limits.stroke,
                      "Farthest from the start along an axis, m (default 0.2): keep the rope where the cameras see it");
  command->add_option("--yaw-velocity", options.limits.yaw_velocity, "Limit, rad/s (default 3.1)");
  command->add_option("--yaw-acceleration", options.limits.yaw_acceleration, "Limit, rad/s^2 (default 20)");
  command->add_option("--yaw-jerk", options.limits.yaw_jerk, "Limit, rad/s^3 (default 400)");
  command->add_option("--turn", options.limits.turn, "Farthest yaw from the start, rad (default 1.6)");
  command->add_option("--max-bend", options.max_bend, "Largest change of a joint's angle, rad (default 1.2)");
  command
      ->add_option("--noise", request->noise,
                   "What a recorded point will be off the model, mm (default: as in the twin's own recording)")
      ->check(CLI::PositiveNumber);
  command->add_option("--frame-rate", options.frame_rate, "Frames a second of the recording to come (default 30)");
  command->add_option("--rate", request->rate, "Rows a second of the files (default 100)")->type_name("HZ");
  command->add_flag("--force", request->force, "Write into a folder that is not empty");
  command->callback([&globals, &job, request] { job = [&globals, request] { excite(globals, *request); }; });
}

}  // namespace chainsplat::tools
