// diff.cpp - diff: what differs between two runs, and by how much.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>
#include <set>

#include "chainsplat/json.h"
#include "chainsplat/run_folder.h"
#include "cli.h"
#include "command_line.h"

namespace chainsplat::tools {

namespace {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;

struct Difference {
  std::string what, first, second, note;
};

// What has a value of its own beside the twin.
class Comparison {
 public:
  void put(const std::string& what, const std::string& a, const std::string& b, const std::string& note = "") {
    if (a != b) found_.push_back({what, a.empty() ? "-" : a, b.empty() ? "-" : b, note});
  }
  // `note_text` empty: the difference in percent
  void put(const std::string& what, double a, double b, const std::string& note_text = "") {
    if (a == b || (std::isnan(a) && std::isnan(b))) return;
    char first[32], second[32], note[48] = "";
    std::snprintf(first, sizeof first, "%.6g", a);
    std::snprintf(second, sizeof second, "%.6g", b);
    if (a != 0.0 && std::isfinite(a) && std::isfinite(b))
      std::snprintf(note, sizeof note, "%+.3g %%", 100.0 * (b - a) / std::abs(a));
    found_.push_back(
        {what, std::isnan(a) ? "-" : first, std::isnan(b) ? "-" : second, note_text.empty() ? note : note_text});
  }
  const std::vector<Difference>& found() const { return found_; }

 private:
  std::vector<Difference> found_;
};

void compare_provenance(Comparison& out, const twin::Provenance& a, const twin::Provenance& b) {
  out.put("version", a.version, b.version);
  out.put("device", a.device, b.device);
  out.put("driver", a.driver, b.driver);
  out.put("capture", a.capture, b.capture);
  out.put("capture hash", a.capture_hash, b.capture_hash);
  out.put("seed", std::to_string(a.seed), std::to_string(b.seed));
  const std::map<std::string, std::string> options = option_texts(a), other_options = option_texts(b);
  std::set<std::string> names;
  for (const auto& [name, value] : options) names.insert(name);
  for (const auto& [name, value] : other_options) names.insert(name);
  const auto get = [](const auto& texts, const std::string& name) {
    const auto at = texts.find(name);
    return at == texts.end() ? std::string() : at->second.empty() ? std::string("(all)") : at->second;
  };
  for (const std::string& name : names) out.put("option " + name, get(options, name), get(other_options, name));
}

double rms_angle(const chain::States& a, const chain::States& b) {
  double squares = 0.0;
  Eigen::Index count = 0;
  for (std::size_t k = 0; k < a.theta.size(); ++k) {
    squares += (a.theta[k] - b.theta[k]).squaredNorm();
    count += a.theta[k].size();
  }
  return count > 0 ? std::sqrt(squares / static_cast<double>(count)) : 0.0;
}

void compare_states(Comparison& out, const std::string& what, const chain::States& a, const chain::States& b) {
  if (a.time != b.time) {
    out.put(what, std::to_string(a.time.size()) + " times", std::to_string(b.time.size()) + " times",
            a.time.size() == b.time.size() ? "other times" : "");
    if (a.time.size() == b.time.size()) out.put(what, "times", "other times");
    return;
  }
  if (a.theta.empty() || a.theta[0].size() != b.theta[0].size()) return;  // the chain's row tells
  if (const double rms = rms_angle(a, b); rms > 0.0) {
    char text[64];
    std::snprintf(text, sizeof text, "RMS difference %.3g rad", rms);
    out.put(what, "theta", "other theta", text);
  }
}

void compare_chain(Comparison& out, const twin::Twin& a, const twin::Twin& b) {
  out.put("scenario", a.tabletop ? "tabletop" : "free", b.tabletop ? "tabletop" : "free");
  out.put("length, m", a.chain.length, b.chain.length);
  out.put("diameter, m", a.chain.diameter, b.chain.diameter);
  out.put("joints", a.chain.links() - 1, b.chain.links() - 1);
  out.put("angles", a.chain.angles(), b.chain.angles());
  out.put("Gaussians", a.gaussians.count, b.gaussians.count);
  std::vector<std::string> names = a.estimates.names;
  for (const std::string& name : b.estimates.names)
    if (std::find(names.begin(), names.end(), name) == names.end()) names.push_back(name);
  const auto get = [](const dynamics::Estimates& estimates, const std::vector<double>& values,
                      const std::string& name) {
    const auto at = static_cast<std::size_t>(std::find(estimates.names.begin(), estimates.names.end(), name) -
                                             estimates.names.begin());
    return at < values.size() ? values[at] : NAN;
  };
  // a difference of an estimate means something against its standard error
  for (const std::string& name : names) {
    const double first = get(a.estimates, a.estimates.values, name),
                 second = get(b.estimates, b.estimates.values, name);
    const double error = std::hypot(get(a.estimates, a.estimates.standard_errors, name),
                                    get(b.estimates, b.estimates.standard_errors, name));
    char note[64] = "";
    if (error > 0.0 && std::isfinite(second - first))
      std::snprintf(note, sizeof note, "%+.2g standard errors", (second - first) / error);
    out.put("parameter " + name, first, second, note);
  }
  compare_states(out, "recognized states", a.states, b.states);
  compare_states(out, "rollout", a.rollout, b.rollout);
}

Json mean_metrics(const Path& run) {
  std::error_code error;
  if (!fs::exists(run / pipeline::kMetricsFile, error)) return Json::object();
  const Json document = core::parse_json_or_discard(core::read_file(run / pipeline::kMetricsFile));
  const auto require = [&](bool sound, const std::string& what) {
    if (!sound) throw InputError((run / pipeline::kMetricsFile).string(), what, "run 'chainsplat eval' again");
  };
  require(document.is_object(), "is not JSON or is cut off");
  Json means = Json::object();
  for (const auto& [part, metrics] : document.items()) {
    require(metrics.is_object() && metrics.contains("mean") && metrics["mean"].is_object(),
            part + ".mean is no object");
    for (const auto& [key, value] : metrics["mean"].items()) {
      require(value.is_number(), part + ".mean." + key + " is no number");
      means[part + " " + key] = value;
    }
  }
  return means;
}

void compare_metrics(Comparison& out, const Json& a, const Json& b) {
  Json names = a;
  names.update(b);
  for (const auto& [name, value] : names.items())
    out.put(name, a.value(name, static_cast<double>(NAN)), b.value(name, static_cast<double>(NAN)));
}

void diff(const Globals& globals, const std::string& first, const std::string& second) {
  const twin::Twin a = twin::load(first), b = twin::load(second);
  Comparison provenance, result;
  compare_provenance(provenance, a.provenance, b.provenance);
  compare_chain(result, a, b);
  compare_metrics(result, mean_metrics(first), mean_metrics(second));
  for (const char* file : {"gaussians.ply"}) {
    std::error_code error;
    const bool there = fs::exists(Path(first) / file, error) && fs::exists(Path(second) / file, error);
    if (there && core::read_file(Path(first) / file) != core::read_file(Path(second) / file))
      result.put(file, "bytes", "other bytes");
  }
  if (globals.json) {
    Json document{{"first", first}, {"second", second}};
    for (const auto& [key, part] : {std::pair("made with", &provenance), std::pair("result", &result)}) {
      document[key] = Json::array();
      for (const Difference& d : part->found())
        document[key].push_back({{"what", d.what}, {"first", d.first}, {"second", d.second}, {"note", d.note}});
    }
    std::cout << core::json_text(document) << "\n";
    return;
  }
  const auto print = [](const char* title, const Comparison& part, const char* same) {
    if (part.found().empty()) {
      std::cout << title << ": " << same << "\n";
      return;
    }
    std::cout << title << "\n";
    for (const Difference& d : part.found()) {
      char line[400];
      std::snprintf(line, sizeof line, "  %-34.60s %24.70s %24.70s  %s\n", d.what.c_str(), d.first.c_str(),
                    d.second.c_str(), d.note.c_str());
      std::cout << line;
    }
  };
  print("made with", provenance, "the same version, device, capture, options and seed");
  print("result", result, "the same");
}

}  // namespace

void add_diff_command(Command app, const Globals& globals, Job& job) {
  Command command = app.add_command("diff", "What differs between two runs: how they were made, and what came out");
  auto runs = std::make_shared<std::pair<std::string, std::string>>();
  command.add_option("RUN", runs->first, "Run folder").required();
  command.add_option("OTHER", runs->second, "Another run folder").required();
  command.callback([&globals, &job, runs] { job = [&globals, runs] { diff(globals, runs->first, runs->second); }; });
}

}  // namespace chainsplat::tools
