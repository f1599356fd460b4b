// excite.cpp - excite: the base motion that is to be recorded next.
#include <cmath>
#include <cstdio>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>

#include "chainsplat/excitation.h"
#include "chainsplat/json.h"
#include "chainsplat/motion_files.h"
#include "chainsplat/rope.h"
#include "chainsplat/run_folder.h"
#include "chainsplat/twin.h"
#include "cli.h"
#include "command_line.h"

namespace chainsplat::tools {

namespace {

using Json = nlohmann::ordered_json;

struct ExciteRequest {
  std::string run, out, axes;
  double rate = 100.0, noise = 0.0;  // rows per second; mm, 0: from the recording
  bool force = false;
  excitation::Options options;
};

// One file for the base's motion, and its table beside it.
bool is_single(const ExciteRequest& request) { return Path(request.out).extension() == ".tum"; }

Json document_of(const excitation::Result& result, const ExciteRequest& request) {
  const excitation::Prediction& p = result.prediction;
  Json out;
  out["duration"] = request.options.duration;
  out["noise"] = result.noise;
  out["spread"] = result.spread;
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

// Writes the motion, and into a folder also the states that it predicts and `document`.
void write_files(const ExciteRequest& request, const excitation::Result& result, const Json& document) {
  const Path out = request.out;
  const bool single = is_single(request);
  const auto beside = [&](const char* name, const char* extension) {
    return single ? Path(out).replace_extension(extension) : out / name;
  };
  if (!single) core::make_folder(out);
  const std::vector<double> times = planning::row_times(request.options.duration, request.rate);
  core::write_file(beside("base.tum", ".tum"), planning::motion_tum(result.motion, times));
  core::write_file(beside("base.csv", ".csv"), planning::motion_csv(result.motion, times));
  if (single) return;
  core::write_file(out / "states.csv", twin::states_csv(result.states));
  core::write_file(out / "excite.json", core::json_text(document) + "\n");
}

void print(const ExciteRequest& request, const excitation::Result& result) {
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
                "\nthe twin predicts it within %.2g mm by its own errors\n"
                "peaks: %.2f m/s, %.1f m/s^2, %.0f m/s^3, %.2f m from the start; motion: ",
                1e3 * result.spread, result.peaks.velocity, result.peaks.acceleration, result.peaks.jerk,
                result.peaks.stroke);
  std::cout << line << request.out << "\n";
}

void excite(const Globals& globals, ExciteRequest& request) {
  watch_signals();
  excitation::Options& options = request.options;
  planning::check_rate(request.rate, options.duration, "give rows a second, for example 100");
  options.seed = globals.seed;
  if (!request.axes.empty()) options.axes = planning::parse_axes(request.axes);
  if (is_single(request))
    pipeline::check_output_file(request.out);
  else
    pipeline::check_output_folder(request.out, request.force, "name another folder or give --force to write into it");

  const pipeline::Rope rope = pipeline::load_rope(request.run);
  const excitation::Problem problem = pipeline::excitation_problem(rope);
  if (request.noise > 0.0) options.noise = 1e-3 * request.noise;
  const excitation::Result result = excitation::excite(problem, options);
  end_progress();

  const Json document = document_of(result, request);
  write_files(request, result, document);
  if (globals.json)
    std::cout << core::json_text(document) << "\n";
  else
    print(request, result);
}

}  // namespace

void add_excite_command(Command app, const Globals& globals, Job& job) {
  Command command =
      app.add_command("excite", "Propose the base motion to record next: the parameters' errors shrink most");
  auto request = std::make_shared<ExciteRequest>();
  excitation::Options& options = request->options;
  options.limits.stroke = 0.2;
  command.add_option("RUN", request->run, "Run folder of an identified twin").required();
  command
      .add_option("-o,--output", request->out,
                  "Folder for base.tum, base.csv, states.csv, excite.json; or a file NAME.tum, with NAME.csv beside it")
      .required()
      .type_name("MOTION");
  command
      .add_option("--axes", request->axes,
                  "What moves (default: x, for a chain with two bending axes x,y, on a table x,y,yaw)")
      .type_name("x,y,z,yaw");
  command.add_option("--duration", options.duration, "Of the motion, s (default 5)");
  command.add_option("--velocity", options.limits.velocity, "Limit of the base, m/s (default 1.5)");
  command.add_option("--acceleration", options.limits.acceleration, "Limit of the base, m/s^2 (default 10)");
  command.add_option("--jerk", options.limits.jerk, "Limit of the base, m/s^3 (default 200)");
  command.add_option("--stroke", options.limits.stroke,
                     "Farthest from the start along an axis, m (default 0.2): keep the rope where the cameras see it");
  command.add_option("--yaw-velocity", options.limits.yaw_velocity, "Limit, rad/s (default 3.1)");
  command.add_option("--yaw-acceleration", options.limits.yaw_acceleration, "Limit, rad/s^2 (default 20)");
  command.add_option("--yaw-jerk", options.limits.yaw_jerk, "Limit, rad/s^3 (default 400)");
  command.add_option("--turn", options.limits.turn, "Farthest yaw from the start, rad (default 1.6)");
  command.add_option("--max-bend", options.max_bend,
                     "Largest change of a joint's angle, rad (default 1.2; never around less than two diameters)");
  command
      .add_option("--noise", request->noise,
                  "What a recorded point will be off the model, mm (default: as in the twin's own recording)")
      .positive();
  command.add_option("--frame-rate", options.frame_rate, "Frames a second of the recording to come (default 30)");
  command.add_option("--rate", request->rate, "Rows a second of the files (default 100)").type_name("HZ");
  command.add_flag("--force", request->force, "Write into a folder that is not empty");
  command.callback([&globals, &job, request] { job = [&globals, request] { excite(globals, *request); }; });
}

}  // namespace chainsplat::tools
