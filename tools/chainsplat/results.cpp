// results.cpp - texts of the command line, and results on their way out.
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iostream>

#include "chainsplat/eval.h"
#include "chainsplat/run_folder.h"
#include "cli.h"

namespace chainsplat::tools {

namespace fs = std::filesystem;

void write_result(const std::string& name, const std::string& bytes) {
  std::error_code error;
  if (name == "-") {
    std::cout << bytes;
  } else if (fs::exists(name, error) && !fs::is_regular_file(name, error)) {
    // a device or a pipe must be written into, not replaced
    std::ofstream file(name, std::ios::binary);
    file << bytes;
    file.flush();
    if (!file) throw WorkError(name, "writing failed", "make room or name another file");
  } else {
    core::write_file(name, bytes);
  }
}

Path base_beside(const std::string& states) {
  if (states.empty() || states == "-") return {};
  std::error_code error;
  const Path file = states, own = Path(file).replace_extension(".base.tum");
  if (fs::is_regular_file(own, error)) return own;
  const Path folder = file.parent_path() / pipeline::kBaseFile;
  const bool of_a_folder = file.filename() == "states.csv" || file.filename() == "rollout.csv";
  return of_a_folder && fs::is_regular_file(folder, error) ? folder : Path();
}

void check_not_input(const std::string& output, const std::vector<std::string>& inputs) {
  std::error_code error;
  for (const std::string& input : inputs)
    if (!input.empty() && input != "-" && fs::equivalent(output, input, error))
      throw InputError(output, "is a file that is read, and would be overwritten", "name another file");
}

void check_not_input(const std::string& output, const Path& run, std::vector<std::string> inputs) {
  for (const char* name : pipeline::kRunFiles) inputs.push_back((run / name).string());
  check_not_input(output, inputs);
}

void check_one_wants_standard_output(const Globals& globals, const std::string& output) {
  if (globals.json && output == "-")
    throw InputError("--json", "standard output is wanted by '-' too", "name a file, or leave --json out");
}

std::string metrics_table(const std::vector<MetricsRow>& rows) {
  constexpr double kMillimeters = 1e3;
  const bool lpips =
      std::any_of(rows.begin(), rows.end(), [](const auto& row) { return std::isfinite(row.metrics->lpips); });
  std::string text = "                    PSNR dB  object dB    SSIM" + std::string(lpips ? "    LPIPS" : "") +
                     "     IoU  Chamfer mm  centerline mm  from grasp\n";
  const auto cell = [&](int width, int digits, double value) {
    char out[64];
    if (std::isfinite(value))
      std::snprintf(out, sizeof out, "%*.*f", width, digits, value);
    else
      std::snprintf(out, sizeof out, "%*s", width, "-");
    text += out;
  };
  for (const MetricsRow& row : rows) {
    char name[64];
    std::snprintf(name, sizeof name, "%-18.40s", row.name.c_str());
    text += name;
    cell(9, 2, row.metrics->psnr);
    cell(11, 2, row.metrics->psnr_object);
    cell(8, 4, row.metrics->ssim);
    if (lpips) cell(9, 5, row.metrics->lpips);
    cell(8, 3, row.metrics->iou);
    cell(12, 2, kMillimeters * row.metrics->chamfer);
    cell(15, 2, kMillimeters * row.metrics->centerline_rms);
    cell(12, 2, kMillimeters * row.metrics->shape_rms);
    text += "\n";
  }
  return text;
}

std::pair<std::string, std::string> split_camera(const std::string& text) {
  std::error_code error;
  const std::size_t colon = text.rfind(':');
  if (colon == std::string::npos || fs::exists(text, error)) return {text, ""};
  return {text.substr(0, colon), text.substr(colon + 1)};
}

std::vector<double> numbers(const std::string& text, const std::string& where, std::size_t count) {
  std::vector<double> out;
  const char* at = text.c_str();
  for (;;) {
    char* end = nullptr;
    const double value = std::strtod(at, &end);
    if (end == at) break;
    out.push_back(value);
    at = end;
    if (*at != ',' || at[1] == '\0') break;
    ++at;
  }
  if (*at != '\0' || (count && out.size() != count) || out.empty())
    throw InputError(where, "'" + text + "' is not " + (count ? std::to_string(count) + " numbers" : "numbers"),
                     "give them with commas between, for example 0.1,0,0.3");
  return out;
}

}  // namespace chainsplat::tools
