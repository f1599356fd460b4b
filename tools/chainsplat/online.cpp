// online.cpp - identify --online: parameters that follow what estimate prints.
#include "online.h"

#include <cmath>
#include <cstdio>
#include <fstream>
#include <iostream>
#include <limits>
#include <nlohmann/json.hpp>

#include "chainsplat/adaptation.h"
#include "estimate_lines.h"
#include "run_folder.h"

namespace chainsplat::tools {

void identify_online(const Globals& globals, const OnlineRequest& request) {
  watch_signals();
  twin::Twin twin = twin::load(request.run);
  if (!twin.parameters) throw InputError(request.run, "has no parameters yet", "identify it first");
  const trajectory::Trajectory base = request.base.empty() ? own_base(request.run) : read_base(request.base);
  const dynamics::BaseFunction base_at = [&](double time) { return base.at(time); };
  adaptation::Options options;
  options.memory = request.memory;
  adaptation::Adaptation online(twin.chain, *twin.parameters, twin.estimates, options);

  std::ifstream file;
  if (request.file != "-") {
    file.open(request.file);
    if (!file)
      throw InputError(request.file, "cannot be read", "give what 'estimate' printed, or - for standard input");
  }
  std::istream& in = request.file == "-" ? std::cin : file;
  std::string line;
  double first = NAN, last = NAN, before_line = -std::numeric_limits<double>::infinity();
  int row = 0;
  // a stream that is stopped by Ctrl-C has still taught what it has
  while (!core::stop_requested() && next_line(in, line, request.file)) {
    ++row;
    if (line.find_first_not_of(" \t\r") == std::string::npos) continue;
    const std::string where = request.file + ":" + std::to_string(row);
    const std::optional<EstimateLine> read = read_estimate_line(line, where, twin.chain.angles(), before_line);
    if (!read) continue;
    before_line = read->time;
    const adaptation::Observation seen{read->time, read->theta, read->thetadot, read->sigma};
    try {
      online.observe(seen, base_at);
    } catch (const InputError& error) {
      const std::string text = error.what();  // WHERE: WHAT; HOW TO MEND
      const std::size_t colon = text.find(": "), mend = text.rfind("; ");
      throw InputError(where, text.substr(colon + 2, mend - colon - 2), text.substr(mend + 2));
    }
    if (std::isnan(first)) first = seen.time;
    last = seen.time;
  }
  if (online.used() == 0)
    throw InputError(request.file, "has no two frames in a row that fit the twin",
                     "check that it is of this rope and of this base motion");
  if (!math::is_covariance(online.estimates().covariance))
    throw WorkError(request.file, "leads to parameters whose covariance has no meaning",
                    "check that it is of this rope; the twin is as it was");
  const dynamics::Estimates before = twin.estimates;
  const dynamics::Integrator integrator = twin.parameters->integrator;
  twin.parameters = online.parameters();
  twin.parameters->integrator = integrator;
  twin.estimates = online.estimates();
  twin.provenance.options["online"] = request.file == "-" ? "-" : Path(request.file).filename().string();
  twin::save(twin, request.run);

  const dynamics::Estimates& now = twin.estimates;
  if (globals.json) {
    nlohmann::ordered_json document;
    document["run"] = request.run;
    document["from"] = first, document["to"] = last;
    document["frames"] = online.used(), document["left_out"] = online.left_out();
    document["restarts"] = online.restarts();
    document["names"] = now.names;
    document["before"] = before.values;
    document["estimates"] = now.values;
    document["standard_errors"] = now.standard_errors;
    std::cout << document.dump(1, ' ', false, nlohmann::ordered_json::error_handler_t::replace) << "\n";
    return;
  }
  char text[200];
  std::cout << "parameter                          before          now   standard error\n";
  for (std::size_t i = 0; i < now.names.size() && i < now.values.size() && i < now.standard_errors.size(); ++i) {
    if (now.values[i] == before.values[i]) continue;
    std::snprintf(text, sizeof text, "%-28.60s %12.5g %12.5g %16.3g\n", now.names[i].c_str(), before.values[i],
                  now.values[i], now.standard_errors[i]);
    std::cout << text;
  }
  std::snprintf(text, sizeof text, "%d frames from %g to %g s used, %d left out, %d restarts; twin: ", online.used(),
                first, last, online.left_out(), online.restarts());
  std::cout << text << request.run << "\n";
}

}  // namespace chainsplat::tools
