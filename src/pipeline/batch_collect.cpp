// batch_collect.cpp - the metrics of all runs of a batch in one table, laid out like the paper's.
#include <array>
#include <cmath>
#include <cstdio>
#include <ctime>
#include <map>
#include <nlohmann/json.hpp>
#include <optional>

#include "chainsplat/batch.h"
#include "chainsplat/json.h"
#include "chainsplat/run_folder.h"

namespace chainsplat::pipeline {

namespace {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;
using Kind = JobState::Kind;

// mathematics.md 9, in the order of the paper's tables and then ours.
struct Column {
  const char* key;
  const char* title;
  const char* unit;
  int digits;
  double scale;  // of what metrics.json holds
  bool paper;    // a column of the paper's tables
  bool less_better;
};
constexpr std::array kColumns{
    Column{"chamfer", "CD", "m", 4, 1.0, true, true},
    Column{"iou", "IoU", "", 3, 1.0, true, false},
    Column{"psnr", "PSNR", "dB", 2, 1.0, true, false},
    Column{"ssim", "SSIM", "", 3, 1.0, true, false},
    Column{"lpips", "LPIPS", "", 4, 1.0, true, true},
    Column{"psnr_object", "PSNR in the object", "dB", 2, 1.0, false, false},
    Column{"centerline_rms", "centerline", "mm", 2, 1e3, false, true},
    Column{"tip_rms", "tip", "mm", 2, 1e3, false, true},
    Column{"shape_rms", "from grasp", "mm", 2, 1e3, false, true},
};
constexpr std::size_t kPaperColumns = 5;
constexpr std::array kParts{"recognized", "rollout"};

// The paper's tables dynamics_learning_tabletop and dynamics_learning_freespace: 20, 30, 40 cm x CD, IoU, PSNR, SSIM,
// LPIPS. Real recordings, rollout.
struct PaperRow {
  bool tabletop;
  const char* method;
  std::array<std::array<double, kPaperColumns>, 3> values;
};
constexpr std::array<double, 3> kPaperLengths{0.20, 0.30, 0.40};  // m
constexpr std::array kPaper{
    PaperRow{true,
             "PGND",
             {{{0.0348, 0.402, 25.11, 0.986, 0.0171},
               {0.0261, 0.511, 24.85, 0.982, 0.0212},
               {0.0302, 0.466, 22.90, 0.973, 0.0315}}}},
    PaperRow{true,
             "PhysTwin w/o 3D",
             {{{0.0201, 0.578, 27.58, 0.990, 0.0093},
               {0.0171, 0.636, 26.84, 0.985, 0.0133},
               {0.0212, 0.569, 24.37, 0.978, 0.0193}}}},
    PaperRow{true,
             "PhysTwin w/ 3D",
             {{{0.0301, 0.434, 25.78, 0.988, 0.0123},
               {0.0240, 0.520, 25.23, 0.983, 0.0159},
               {0.0241, 0.528, 24.04, 0.977, 0.0204}}}},
    PaperRow{true,
             "ChainSplat",
             {{{0.0263, 0.616, 29.54, 0.992, 0.0083},
               {0.0220, 0.661, 28.69, 0.988, 0.0114},
               {0.0333, 0.503, 24.61, 0.980, 0.0215}}}},
    PaperRow{false,
             "PGND",
             {{{0.0680, 0.273, 28.06, 0.985, 0.0193},
               {0.0722, 0.228, 26.21, 0.979, 0.0255},
               {0.0852, 0.216, 25.52, 0.974, 0.0324}}}},
    PaperRow{false,
             "PhysTwin w/o 3D",
             {{{0.0347, 0.573, 31.12, 0.989, 0.0103},
               {0.0329, 0.549, 29.28, 0.984, 0.0143},
               {0.0446, 0.475, 27.85, 0.979, 0.0205}}}},
    PaperRow{false,
             "PhysTwin w/ 3D",
             {{{0.0380, 0.549, 30.96, 0.988, 0.0113},
               {0.0440, 0.472, 28.48, 0.982, 0.0179},
               {0.0435, 0.481, 28.06, 0.979, 0.0198}}}},
    PaperRow{false,
             "ChainSplat",
             {{{0.0293, 0.704, 33.65, 0.992, 0.0084},
               {0.0265, 0.678, 31.84, 0.988, 0.0115},
               {0.0329, 0.670, 31.08, 0.985, 0.0144}}}},
};

struct Row {
  const BatchJob* job;
  JobState state;
  std::string scenario;
  double length = NAN;
  std::string version, device;
  std::array<std::array<double, kColumns.size()>, kParts.size()> values;  // NaN: none
  bool report = false;                                                    // its page is there
};

struct Spread {
  int count = 0;
  double sum = 0, squares = 0;
  void add(double value) {
    if (std::isnan(value)) return;
    ++count;
    sum += value;
    squares += value * value;
  }
  double mean() const { return count > 0 ? sum / count : NAN; }
  double deviation() const {  // of the sample; NaN below two
    return count > 1 ? std::sqrt(std::max(0.0, (squares - sum * sum / count) / (count - 1))) : NAN;
  }
};

Row read_row(const BatchJob& job, const Path& folder) {
  Row row{&job, state_of(folder, job), "", NAN, "", "", {}, false};
  for (auto& part : row.values) part.fill(NAN);
  const Path run = folder / job.name;
  std::error_code error;
  if (row.state.kind != Kind::done) return row;
  row.report = fs::exists(run / kReportFile, error);
  Path file = run / "twin.json";
  try {
    const Json twin = core::parse_json(core::read_file(file));
    row.scenario = twin.at("chain").value("scenario", "");
    row.length = twin.at("chain").value("length", static_cast<double>(NAN));
    row.version = twin.at("provenance").value("version", "");
    row.device = twin.at("provenance").value("device", "");
    file = run / kMetricsFile;
    if (!fs::exists(file, error)) return row;  // stages without evaluate
    const Json metrics = core::parse_json(core::read_file(file));
    for (std::size_t p = 0; p < kParts.size(); ++p)
      for (std::size_t c = 0; c < kColumns.size(); ++c)
        if (metrics.contains(kParts[p]))
          row.values[p][c] = metrics.at(kParts[p]).at("mean").value(kColumns[c].key, static_cast<double>(NAN));
  } catch (const Json::exception&) {
    core::warn(file.string() + ": is damaged; its numbers are left out");
  }
  return row;
}

std::string number(double value, int digits) {
  if (std::isnan(value)) return "";
  char text[64];
  std::snprintf(text, sizeof text, "%.*f", digits, value);
  return text;
}

std::string csv_text(const std::string& text) {
  if (text.find_first_of(",\"\n") == std::string::npos) return text;
  std::string out = "\"";
  for (const char letter : text) out += letter == '"' ? std::string("\"\"") : std::string(1, letter);
  return out + "\"";
}

std::string csv(const std::vector<Row>& rows) {
  std::string text = "job,capture,scenario,length,settings,seed,state,reason,seconds";
  for (const char* part : kParts)
    for (const Column& column : kColumns) text += std::string(",") + part + "_" + column.key;
  text += "\n";
  const auto exact = [](double value) { return std::isnan(value) ? std::string() : core::exact(value); };
  for (const Row& row : rows) {
    text += csv_text(row.job->name) + "," + csv_text(row.job->capture) + "," + row.scenario + "," + exact(row.length) +
            "," + csv_text(row.job->settings) + "," + std::to_string(row.job->seed) + "," + kind_name(row.state.kind) +
            "," + csv_text(row.state.detail) + "," + exact(row.state.seconds);
    for (const auto& part : row.values)
      for (const double value : part) text += "," + exact(value);
    text += "\n";
  }
  return text;
}

struct Group {
  std::array<std::array<Spread, kColumns.size()>, kParts.size()> values;
  Spread seconds;
};
// settings -> tabletop? -> length (mm) -> group
using Groups = std::map<std::string, std::map<bool, std::map<long, Group>>>;

Groups group(const std::vector<Row>& rows) {
  Groups groups;
  for (const Row& row : rows) {
    if (row.state.kind != Kind::done || row.scenario.empty()) continue;
    Group& g = groups[row.job->settings][row.scenario == "tabletop"][std::lround(1e3 * row.length)];
    g.seconds.add(row.state.seconds);
    for (std::size_t p = 0; p < kParts.size(); ++p)
      for (std::size_t c = 0; c < kColumns.size(); ++c) g.values[p][c].add(row.values[p][c]);
  }
  return groups;
}

Json json(const std::vector<Row>& rows, const Groups& groups) {
  const auto value = [](double number) { return std::isnan(number) ? Json() : Json(number); };
  Json jobs = Json::array(), means = Json::array();
  for (const Row& row : rows) {
    Json entry{{"job", row.job->name},
               {"capture", row.job->capture},
               {"scenario", row.scenario},
               {"length", value(row.length)},
               {"settings", row.job->settings},
               {"seed", row.job->seed},
               {"state", kind_name(row.state.kind)},
               {"reason", row.state.detail},
               {"seconds", row.state.seconds},
               {"version", row.version},
               {"device", row.device}};
    for (std::size_t p = 0; p < kParts.size(); ++p)
      for (std::size_t c = 0; c < kColumns.size(); ++c)
        if (!std::isnan(row.values[p][c])) entry[kParts[p]][kColumns[c].key] = row.values[p][c];
    jobs.push_back(std::move(entry));
  }
  for (const auto& [settings, scenarios] : groups)
    for (const auto& [tabletop, lengths] : scenarios)
      for (const auto& [millimeters, g] : lengths) {
        Json entry{{"settings", settings}, {"scenario", tabletop ? "tabletop" : "free"}, {"length", millimeters / 1e3}};
        for (std::size_t p = 0; p < kParts.size(); ++p)
          for (std::size_t c = 0; c < kColumns.size(); ++c)
            if (const Spread& s = g.values[p][c]; s.count > 0)
              entry[kParts[p]][kColumns[c].key] = {
                  {"mean", s.mean()}, {"deviation", value(s.deviation())}, {"runs", s.count}};
        means.push_back(std::move(entry));
      }
  return {{"format", "chainsplat-results/1"}, {"jobs", jobs}, {"means", means}};
}

std::string escaped(const std::string& text) {
  std::string out;
  for (const char letter : text) {
    if (letter == '&')
      out += "&amp;";
    else if (letter == '<')
      out += "&lt;";
    else if (letter == '>')
      out += "&gt;";
    else if (letter == '"')
      out += "&quot;";
    else
      out += letter;
  }
  return out;
}

// Percent-encoded, for a link to a folder beside the page.
std::string link_to(const std::string& name) {
  std::string out;
  for (const char letter : name) {
    if (std::isalnum(static_cast<unsigned char>(letter)) ||
        std::string_view("-_.~").find(letter) != std::string_view::npos) {
      out += letter;
    } else {
      char code[8];
      std::snprintf(code, sizeof code, "%%%02X", static_cast<unsigned char>(letter));
      out += code;
    }
  }
  return out;
}

std::string heading(const Column& column) {
  return std::string(column.title) + (*column.unit ? std::string(" ") + column.unit : "") +
         (column.less_better ? " &darr;" : " &uarr;");
}

std::string spread_cell(const Spread& spread, const Column& column) {
  if (spread.count == 0) return "<td>&ndash;</td>";
  std::string text = "<td>" + number(column.scale * spread.mean(), column.digits);
  if (spread.count > 1)
    text += "<small> &plusmn; " + number(column.scale * spread.deviation(), column.digits) + "</small>";
  return text + "</td>";
}

// One table of the paper: methods down, lengths x metrics across.
std::string paper_table(bool tabletop, const std::map<long, Group>& lengths) {
  std::string text = "<table><thead><tr><th rowspan=2>method</th>";
  for (const auto& [millimeters, g] : lengths)
    text += "<th class=group colspan=" + std::to_string(kPaperColumns) + ">" +
            number(millimeters / 10.0, millimeters % 10 ? 1 : 0) + " cm, " + std::to_string(g.seconds.count) +
            (g.seconds.count == 1 ? " run</th>" : " runs</th>");
  text += "</tr><tr>";
  for (std::size_t l = 0; l < lengths.size(); ++l)
    for (std::size_t c = 0; c < kPaperColumns; ++c)
      text += std::string(c == 0 ? "<th class=first>" : "<th>") + heading(kColumns[c]) + "</th>";
  text += "</tr></thead><tbody>\n";
  for (const PaperRow& row : kPaper) {
    if (row.tabletop != tabletop) continue;
    text += "<tr class=paper><th>" + std::string(row.method) + ", paper</th>";
    for (const auto& [millimeters, g] : lengths) {
      std::size_t at = 0;
      constexpr double kSameLength = 0.005;  // m
      while (at < kPaperLengths.size() && std::abs(kPaperLengths[at] - millimeters / 1e3) > kSameLength) ++at;
      for (std::size_t c = 0; c < kPaperColumns; ++c)
        text += std::string(c == 0 ? "<td class=first>" : "<td>") +
                (at < kPaperLengths.size() ? number(row.values[at][c], kColumns[c].digits) : "&ndash;") + "</td>";
    }
    text += "</tr>\n";
  }
  for (std::size_t p = kParts.size(); p-- > 0;) {
    text += std::string("<tr class=ours><th>this batch, ") + kParts[p] + "</th>";
    for (const auto& [millimeters, g] : lengths)
      for (std::size_t c = 0; c < kPaperColumns; ++c) {
        std::string cell = spread_cell(g.values[p][c], kColumns[c]);
        if (c == 0) cell.insert(3, " class=first");
        text += cell;
      }
    text += "</tr>\n";
  }
  return text + "</tbody></table>\n";
}

// What the paper does not have.
std::string further_table(const std::map<long, Group>& lengths) {
  std::string text = "<table><thead><tr><th>this batch</th>";
  for (std::size_t c = kPaperColumns; c < kColumns.size(); ++c) text += "<th>" + heading(kColumns[c]) + "</th>";
  text += "<th>training s</th></tr></thead><tbody>\n";
  for (const auto& [millimeters, g] : lengths)
    for (std::size_t p = kParts.size(); p-- > 0;) {
      text += "<tr><th>" + number(millimeters / 10.0, millimeters % 10 ? 1 : 0) + " cm, " + kParts[p] + "</th>";
      for (std::size_t c = kPaperColumns; c < kColumns.size(); ++c) text += spread_cell(g.values[p][c], kColumns[c]);
      text += "<td>" + (p == 1 ? number(g.seconds.mean(), 1) : std::string()) + "</td></tr>\n";
    }
  return text + "</tbody></table>\n";
}

std::string html(const std::vector<Row>& rows, const Groups& groups) {
  std::array<int, 5> count{};
  for (const Row& row : rows) ++count[static_cast<std::size_t>(row.state.kind)];
  std::string text =
      "<!DOCTYPE html>\n<html lang=en><head><meta charset=utf-8><title>chainsplat batch</title>\n"
      "<meta name=viewport content=\"width=device-width\">\n<style>\n"
      "body{font:15px/1.45 system-ui,sans-serif;margin:2rem auto;max-width:90rem;padding:0 1rem;color:#1b1f24;"
      "background:#fff}\n"
      "h1{font-size:1.5rem}h2{font-size:1.2rem;margin-top:2rem}h3{font-size:1rem;margin-bottom:.3rem}\n"
      ".wide{overflow-x:auto}table{border-collapse:collapse;margin:.4rem 0 1rem}\n"
      "th,td{padding:.2rem .55rem;text-align:right;white-space:nowrap;font-variant-numeric:tabular-nums}\n"
      "tbody th,thead tr:first-child th:first-child,td.text{text-align:left;font-weight:normal}"
      "thead th{border-bottom:1px solid #8a9099;"
      "font-weight:600}\n"
      "th.group{text-align:center}.first,th.group{border-left:1px solid #c9ced6}\n"
      ".paper td,.paper th{color:#5b626c}.ours td,.ours th:first-child{background:#eef5ff;font-weight:600}\n"
      "small{font-weight:normal;color:#5b626c}tr.failed td{color:#a11}tr.failed td.text{white-space:normal}\n"
      "tbody tr:hover td{background:#f4f6f8}\n</style></head><body>\n<h1>chainsplat batch</h1>\n<p>" +
      std::to_string(rows.size()) + " jobs";
  for (std::size_t k = 0; k < count.size(); ++k)
    if (count[k] > 0) text += ", " + std::to_string(count[k]) + " " + kind_name(static_cast<Kind>(k));
  for (const Row& row : rows)
    if (!row.version.empty()) {
      text += "; version " + escaped(row.version) + " on " + escaped(row.device);
      break;
    }
  text += ".</p>\n";
  for (const auto& [settings, scenarios] : groups) {
    text += "<h2>" + (settings.empty() ? "All runs" : escaped(settings)) + "</h2>\n";
    for (const bool tabletop : {true, false}) {
      const auto at = scenarios.find(tabletop);
      if (at == scenarios.end()) continue;
      text += std::string("<h3>") + (tabletop ? "Tabletop" : "Free space") + "</h3>\n<div class=wide>" +
              paper_table(tabletop, at->second) + "</div>\n<div class=wide>" + further_table(at->second) + "</div>\n";
    }
  }
  text +=
      "<p><small>Mean &plusmn; standard deviation over the runs (captures and seeds) of one scenario and length; "
      "metrics "
      "of a run are means over its cameras and frames. The paper's rows are its rollouts of real recordings "
      "(640&times;480, "
      "5 s), not of the captures of this batch: compare orders of magnitude. CD: symmetric mean distance, unsquared; "
      "the "
      "paper does not define its own.</small></p>\n"
      "<h2>Jobs</h2>\n<div class=wide><table><thead><tr><th>run</th><th>state</th><th>s</th>";
  for (const Column& column : kColumns) text += "<th>" + heading(column) + "</th>";
  text += "</tr></thead><tbody>\n";
  for (const Row& row : rows) {
    const bool failed = row.state.kind == Kind::failed;
    const std::string page = row.report ? " <a href=\"" + link_to(row.job->name) + "/report.html\">report</a>" : "";
    text += std::string(failed ? "<tr class=failed>" : "<tr>") + "<td class=text><a href=\"" + link_to(row.job->name) +
            "/\">" + escaped(row.job->name) + "</a> <small><a href=\"logs/" + link_to(row.job->name) +
            ".txt\">log</a>" + page + "</small></td><td class=text>" + kind_name(row.state.kind) + "</td><td>" +
            number(row.state.seconds, 1) + "</td>";
    if (row.state.kind != Kind::done) {
      text += "<td class=text colspan=" + std::to_string(kColumns.size()) + ">" + escaped(row.state.detail) +
              "</td></tr>\n";
      continue;
    }
    for (std::size_t c = 0; c < kColumns.size(); ++c)
      text += "<td>" + number(kColumns[c].scale * row.values[1][c], kColumns[c].digits) + "</td>";
    text += "</tr>\n";
  }
  return text +
         "</tbody></table></div>\n<p><small>Metrics of the rollout. All numbers: <a "
         "href=\"results.csv\">results.csv</a>, "
         "<a href=\"results.json\">results.json</a>.</small></p>\n</body></html>\n";
}

}  // namespace

void collect(const BatchPlan& plan, const Path& folder) {
  std::vector<Row> rows;
  for (const BatchJob& job : plan.jobs) rows.push_back(read_row(job, folder));
  const Groups groups = group(rows);
  core::write_file(folder / "results.csv", csv(rows));
  core::write_file(folder / "results.json", core::json_text(json(rows, groups)) + "\n");
  core::write_file(folder / "results.html", html(rows, groups));
}

}  // namespace chainsplat::pipeline
