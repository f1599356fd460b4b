// online.cpp - parameters that follow a rope while it is estimated.
#include <cmath>
#include <istream>
#include <limits>

#include "chainsplat/adaptation.h"
#include "chainsplat/estimate_lines.h"
#include "chainsplat/pipeline.h"
#include "chainsplat/run_folder.h"

namespace chainsplat::pipeline {

namespace {

// Gives every line to `filter`, until they end or a stop is requested: what a stream has taught by then counts.
// `known`: how `base` was mended before.
void follow_lines(adaptation::ParameterFilter& filter, const chain::Chain& chain, const trajectory::Trajectory& base,
                  const estimation::BaseCorrection& known, std::istream& lines, const std::string& name,
                  OnlineResult& result) {
  const dynamics::BaseFunction given = [&](double time) { return base.at(time); };
  estimation::BaseCorrection correction;  // as the lines say
  const dynamics::BaseFunction base_at = [&](double time) { return estimation::corrected(given, correction, time); };
  std::string line;
  double before = -std::numeric_limits<double>::infinity();
  result.from = result.to = NAN;
  for (int row = 1; !core::stop_requested() && estimation::next_line(lines, line, name); ++row) {
    if (line.find_first_not_of(" \t\r") == std::string::npos) continue;
    const std::string where = name + ":" + std::to_string(row);
    const auto read = estimation::read_estimate_line(line, where, chain.angles(), before);
    if (!read) continue;
    before = read->time;
    correction = estimation::remaining(read->base, known);
    try {
      filter.observe({read->time, read->theta, read->thetadot, read->sigma}, base_at);
    } catch (const InputError& error) {
      throw InputError(where, error.problem, error.mend);
    }
    if (std::isnan(result.from)) result.from = read->time;
    result.to = read->time;
  }
}

}  // namespace

OnlineResult identify_online(const Path& run, std::istream& lines, const std::string& name,
                             const OnlineOptions& options, const core::Listener& listener) {
  const core::ListenerScope scope(listener);
  twin::Twin twin = twin::load(run);
  if (!twin.parameters) throw InputError(run.string(), "has no parameters yet", "identify it first");
  const trajectory::Trajectory base = options.base.empty() ? own_base(run) : read_base(options.base);
  adaptation::Options settings;
  settings.memory = options.memory;
  adaptation::ParameterFilter filter(twin.chain, *twin.parameters, twin.estimates, settings);
  if (!lines) throw InputError(name, "cannot be read", "give what 'estimate' printed, or - for standard input");
  OnlineResult result;
  const auto known =
      options.base.empty() ? estimation::base_correction(twin.corrections) : estimation::BaseCorrection{};
  follow_lines(filter, twin.chain, base, known, lines, name, result);
  const adaptation::Result learned = filter.result();
  if (learned.used == 0)
    throw InputError(name, "has no two frames in a row that fit the twin",
                     "check that it is of this rope and of this base motion");
  if (!math::is_covariance(learned.estimates.covariance))
    throw WorkError(name, "leads to parameters whose covariance has no meaning",
                    "check that it is of this rope; the twin is as it was");
  result.before = twin.estimates;
  result.now = learned.estimates;
  result.frames = learned.used, result.left_out = learned.left_out, result.restarts = learned.restarts;
  const dynamics::Integrator integrator = twin.parameters->integrator;
  twin.parameters = learned.parameters;
  twin.parameters->integrator = integrator;
  twin.estimates = result.now;
  twin.provenance.options["online"] = name == "-" ? "-" : Path(name).filename().string();
  twin::save(twin, run);
  return result;
}

}  // namespace chainsplat::pipeline
