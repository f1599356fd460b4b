// inspect.cpp - check and doctor: what is in a capture, what this machine can do.
#include <algorithm>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>
#include <optional>
#include <sstream>

#include "chainsplat/capture.h"
#include "chainsplat/gpu.h"
#include "chainsplat/json.h"
#include "chainsplat/pipeline.h"
#include "chainsplat/twin_json.h"
#include "cli.h"
#include "command_line.h"

namespace chainsplat::tools {

namespace {

using Json = nlohmann::ordered_json;

void check(const Globals& globals, const std::string& path) {
  const CheckReport report = check_report(path, true);
  if (globals.json)
    std::cout << core::json_text(report.document) << "\n";
  else
    std::cout << report.text;
  if (report.problems == 0) return;
  std::cout.flush();
  throw InputError(path, std::to_string(report.problems) + (report.problems == 1 ? " problem" : " problems"),
                   "mend what is listed as a problem");
}

void doctor(const Globals& globals) {
  const gpu::Doctor found = gpu::examine(globals.device);
  if (!globals.json) {
    std::cout << "chainsplat " CHAINSPLAT_VERSION "\n" << with_options(gpu::doctor_text(found));
    return;
  }
  Json document;
  document["version"] = CHAINSPLAT_VERSION;
  document["devices"] = Json::array();
  for (const gpu::DeviceInfo& device : found.devices) {
    Json entry;
    entry["index"] = device.index;
    entry["name"] = device.name;
    entry["driver"] = device.driver;
    entry["type"] = device.type;
    entry["api_version"] = device.api_version;
    entry["subgroup_size"] = device.subgroup_size;
    entry["max_workgroup_invocations"] = device.max_workgroup_invocations;
    entry["shared_memory_bytes"] = device.shared_memory_bytes;
    entry["max_storage_range"] = device.max_storage_range;
    entry["heap_bytes"] = device.heap_bytes;
    entry["software"] = device.software;
    entry["unified_memory"] = device.unified_memory;
    entry["timestamps"] = device.timestamps;
    entry["refused"] = device.refused;
    document["devices"].push_back(entry);
  }
  document["chosen"] = found.chosen >= 0 ? Json(found.chosen) : Json(nullptr);
  document["reason"] = with_options(found.reason);
  document["missing"] = found.missing;
  document["validation_layer"] = found.validation_layer;
  document["pipeline_cache"] = found.pipeline_cache;
  std::cout << core::json_text(document) << "\n";
}

}  // namespace

CheckReport check_report(const std::string& path, bool with_masks) {
  capture::CheckReport report;
  if (with_masks) report = capture::check(path);
  // what is wrong by too little to see in one camera alone
  std::optional<pipeline::Examination> found;
  if (report.problems.empty() && with_masks) {
    try {
      found = pipeline::examine(path);
      for (const capture::Finding& finding : found->verdict)
        if (finding.impossible) report.problems.push_back(finding.text);
    } catch (const InputError& error) {
      report.problems.push_back(error.what());
    }
  }
  const bool trusted = found && std::all_of(found->verdict.begin(), found->verdict.end(),
                                            [](const capture::Finding& finding) { return finding.trusted; });
  const bool clean = report.doubts.empty() && (!found || found->verdict.empty());
  CheckReport out;
  out.problems = static_cast<int>(report.problems.size());
  Json& document = out.document;
  document["capture"] = path;
  document["facts"] = report.facts;
  document["doubts"] = report.doubts;
  document["problems"] = report.problems;
  if (found) {
    document["verdict"] = twin::to_json(found->verdict);
    document["trusted"] = trusted;
  }
  document["usable"] = report.problems.empty();
  // names come from the files
  std::ostringstream text;
  for (const std::string& line : report.facts) text << core::printable(line) << "\n";
  for (const std::string& line : report.doubts) text << "doubt: " << core::printable(line) << "\n";
  for (const std::string& line : report.problems) text << "problem: " << core::printable(line) << "\n";
  if (found)
    for (const capture::Finding& finding : found->verdict)
      if (!finding.impossible)
        text << (finding.trusted ? "found: " : "doubt: ") << core::printable(finding.text) << "\n";
  if (report.problems.empty() && with_masks)
    text << (clean                              ? "Nothing is wrong with it.\n"
             : trusted && !report.poses_doubted ? "It can be used; see the doubts.\n"
                                                : "A twin made from it is not to be trusted; see the doubts.\n");
  out.text = text.str();
  return out;
}

void add_inspection_commands(Command app, const Globals& globals, Job& job) {
  Command checker = app.add_command("check", "Say what is in a capture, and what is wrong with it");
  auto path = std::make_shared<std::string>();
  checker.add_option("CAPTURE", *path, "The capture's folder or its capture.json").required();
  checker.callback([&globals, &job, path] { job = [&globals, path] { check(globals, *path); }; });

  Command examiner = app.add_command("doctor", "List the Vulkan devices, which is chosen and why, what is missing");
  examiner.callback([&globals, &job] { job = [&globals] { doctor(globals); }; });
}

}  // namespace chainsplat::tools
