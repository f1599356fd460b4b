// batch_plan.cpp - a job file becomes a list of jobs, or one line that says what is wrong with it.
#include <glob.h>

#define TOML_MAX_NESTED_VALUES 16                     // lists in lists; a document is freed by recursion
#define TOML_ASSERT(expression) static_cast<void>(0)  // they fail for text from outside, which it then refuses
#include <toml++/toml.h>

#include <algorithm>
#include <cstdio>
#include <map>
#include <nlohmann/json.hpp>
#include <set>

#include "chainsplat/batch.h"
#include "chainsplat/json.h"
#include "chainsplat/pipeline.h"
#include "src/pipeline/toml_text.h"

namespace chainsplat::pipeline {

namespace {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;

constexpr const char* kPlanFile = "batch.json";
constexpr std::size_t kMostJobs = 100000;  // a slip of the pen, not a plan

// One value of one setting, as train takes it.
struct Value {
  std::string key, text;
  bool in_name = false;  // the file lists several
};
using Combination = std::vector<Value>;

std::size_t edit_distance(const std::string& a, const std::string& b) {
  std::vector<std::size_t> row(b.size() + 1);
  for (std::size_t j = 0; j <= b.size(); ++j) row[j] = j;
  for (std::size_t i = 1; i <= a.size(); ++i) {
    std::size_t corner = row[0];
    row[0] = i;
    for (std::size_t j = 1; j <= b.size(); ++j) {
      const std::size_t above = row[j];
      row[j] = std::min({above + 1, row[j - 1] + 1, corner + (a[i - 1] == b[j - 1] ? 0 : 1)});
      corner = above;
    }
  }
  return row.back();
}

InputError unknown_key(const std::string& where, const std::string& key, const std::vector<std::string>& known) {
  const auto nearest = std::min_element(known.begin(), known.end(), [&](const auto& a, const auto& b) {
    return edit_distance(key, a) < edit_distance(key, b);
  });
  std::string all;
  for (const std::string& name : known) all += (all.empty() ? "" : ", ") + name;
  return {where, "unknown key '" + key + "'", "the nearest one is '" + *nearest + "'; there are " + all};
}

// Fields of TrainOptions and arguments of train that a batch sets itself.
const std::set<std::string> kOwn = {"output", "force", "resume", "picture", "help"};

std::vector<std::string> setting_names() {
  std::vector<std::string> names;
  for (const Setting& setting : settings()) names.push_back(setting.name);
  return names;
}

std::string scalar_text(const toml::node& node, const std::string& where) {
  if (const auto text = node.as_string()) return text->get();
  if (const auto whole = node.as_integer()) return std::to_string(whole->get());
  if (const auto real = node.as_floating_point()) return core::exact(real->get());
  if (const auto truth = node.as_boolean()) return truth->get() ? "true" : "false";
  throw InputError(where, "is neither text, number nor true or false", "write one of these, or a list of them");
}

// All combinations of one [settings] table.
std::vector<Combination> grid(const toml::table& table, const std::string& file) {
  std::vector<Combination> all = {{}};
  const std::vector<std::string> known = setting_names();
  for (const auto& [key_node, node] : table) {
    const std::string key(key_node.str());
    const std::string where = file + ": settings." + key;
    if (key == "seed") throw InputError(where, "is not a setting", "write seeds = [0, 1] above the settings");
    if (kOwn.count(key)) throw InputError(where, "is chosen by the batch itself", "leave it out");
    if (std::find(known.begin(), known.end(), key) == known.end()) throw unknown_key(file + ": settings", key, known);
    std::vector<std::string> texts;
    if (const toml::array* list = node.as_array()) {
      for (const toml::node& element : *list) texts.push_back(scalar_text(element, where));
      if (texts.empty()) throw InputError(where, "is an empty list", "give a value or leave the key out");
    } else {
      texts.push_back(scalar_text(node, where));
    }
    std::vector<Combination> next;
    for (const Combination& before : all)
      for (const std::string& text : texts) {
        next.push_back(before);
        next.back().push_back({key, text, node.is_array()});
      }
    all = std::move(next);
    if (all.size() > kMostJobs) throw InputError(where, "makes too many combinations", "shorten the lists");
  }
  return all;
}

// The combination as arguments of train. Throws InputError where train would refuse it.
std::vector<std::string> arguments_of(const Combination& combination, const std::string& file) {
  std::vector<std::string> arguments;
  TrainOptions options;
  for (const Value& value : combination) {
    set(options, value.key, value.text, file + ": settings." + value.key);
    const auto setting =
        std::find_if(settings().begin(), settings().end(), [&](const Setting& s) { return s.name == value.key; });
    if (!setting->flag)
      arguments.push_back("--" + value.key + "=" + value.text);  // by '=': the value can begin with a dash
    else if (value.text == "true")
      arguments.push_back("--" + value.key);
  }
  try {
    options.check();
  } catch (const InputError& error) {
    throw InputError(file + ": settings", error.where + " " + error.problem, error.mend);
  }
  return arguments;
}

std::string word_for_a_name(const std::string& text) {
  std::string word;
  for (const char letter : text)
    word += std::isalnum(static_cast<unsigned char>(letter)) || letter == '.' || letter == '+' ? letter : '_';
  return word;
}

std::vector<Path> matches(const std::string& pattern, const Path& file) {
  const Path full = Path(pattern).is_absolute() ? Path(pattern) : fs::absolute(file).parent_path() / pattern;
  glob_t found{};
  std::vector<Path> captures;
  if (::glob(full.c_str(), GLOB_TILDE, nullptr, &found) == 0)
    for (std::size_t i = 0; i < found.gl_pathc; ++i) {
      Path path = fs::path(found.gl_pathv[i]).lexically_normal();
      if (path.filename() == "capture.json") path = path.parent_path();
      if (path.filename().empty()) path = path.parent_path();  // 'captures/free/'
      std::error_code error;
      if (fs::is_directory(path, error)) captures.push_back(path);  // a README beside the captures is none
    }
  ::globfree(&found);
  if (captures.empty())
    throw InputError(file.string() + ": captures", "'" + pattern + "' matches no folder",
                     "patterns count from the job file's folder");
  return captures;
}

std::vector<std::string> texts_of(const toml::node* node, const std::string& where) {
  std::vector<std::string> texts;
  if (!node) return texts;
  if (const auto text = node->as_string()) return {text->get()};
  const toml::array* list = node->as_array();
  bool good = list != nullptr;
  if (list)
    for (const toml::node& element : *list) {
      good = good && element.is_string();
      if (good) texts.push_back(element.as_string()->get());
    }
  if (!good || texts.empty()) throw InputError(where, "is no list of texts", "write [\"captures/*\"]");
  return texts;
}

}  // namespace

BatchPlan read_job_file(const Path& file) {
  const std::string name = file.string();
  toml::table document;
  try {
    const std::string text = core::read_file(file);
    check_toml_dots(text, name);
    static_cast<void>(toml::parse(toml_with_x(text), name));  // throws where it is no TOML
    document = toml::parse(toml_with_escapes(text, name), name);
  } catch (const toml::parse_error& error) {
    throw InputError(name + ": line " + std::to_string(error.source().begin.line), std::string(error.description()),
                     "write it as TOML, see 'chainsplat batch --help'");
  }
  for (const auto& [key, node] : document)
    if (key.str() != "captures" && key.str() != "settings" && key.str() != "seeds")
      throw unknown_key(name, std::string(key.str()), {"captures", "settings", "seeds"});
  const std::vector<std::string> patterns = texts_of(document.get("captures"), name + ": captures");
  if (patterns.empty()) throw InputError(name + ": captures", "is missing", "write captures = [\"captures/*\"]");

  std::vector<std::uint64_t> seeds = {0};
  const toml::node* seed_node = document.get("seeds");
  if (seed_node) {
    const toml::array* list = seed_node->as_array();
    seeds.clear();
    if (list)
      for (const toml::node& element : *list)
        if (element.is_integer() && element.as_integer()->get() >= 0)
          seeds.push_back(static_cast<std::uint64_t>(element.as_integer()->get()));
    if (!list || list->empty() || seeds.size() != list->size())
      throw InputError(name + ": seeds", "is no list of whole numbers from 0 on", "write seeds = [0, 1, 2]");
  }

  std::vector<Combination> combinations;
  const toml::node* const tables_node = document.get("settings");
  if (!tables_node) {
    combinations = {{}};
  } else if (const toml::table* table = tables_node->as_table()) {
    combinations = grid(*table, name);
  } else if (const toml::array* tables = tables_node->as_array(); tables && tables->is_array_of_tables()) {
    for (const toml::node& one : *tables) {
      const auto more = grid(*one.as_table(), name);
      combinations.insert(combinations.end(), more.begin(), more.end());
    }
    // which of the tables a job is of must be in its name
    if (tables->size() > 1)
      for (Combination& combination : combinations)
        for (Value& value : combination) value.in_name = true;
  } else {
    throw InputError(name + ": settings", "is no table", "write [settings] and below it 'joints = [6, 8]'");
  }

  BatchPlan plan;
  std::map<std::string, std::string> taken;
  for (const std::string& pattern : patterns)
    for (const Path& capture : matches(pattern, file))
      for (const Combination& combination : combinations)
        for (const std::uint64_t seed : seeds) {
          BatchJob job;
          job.capture = capture.string();
          job.name = capture.filename().string();
          job.seed = seed;
          job.arguments = arguments_of(combination, name);
          for (const Value& value : combination)
            if (value.in_name) {
              job.name += "-" + value.key + "_" + word_for_a_name(value.text);
              job.settings += (job.settings.empty() ? "" : " ") + value.key + "=" + value.text;
            }
          if (seed_node) job.name += "-seed_" + std::to_string(seed);
          const auto [at, fresh] = taken.emplace(job.name, job.capture);
          if (!fresh)
            throw InputError(name,
                             "the same output '" + job.name + "' twice, from " + at->second + " and " + job.capture,
                             "rename one of the captures, or name it once");
          plan.jobs.push_back(std::move(job));
          if (plan.jobs.size() > kMostJobs) throw InputError(name, "makes too many jobs", "shorten the lists");
        }
  return plan;
}

void save_plan(const BatchPlan& plan, const Path& folder) {
  Json jobs = Json::array();
  for (const BatchJob& job : plan.jobs)
    jobs.push_back({{"name", job.name},
                    {"capture", job.capture},
                    {"settings", job.settings},
                    {"seed", job.seed},
                    {"arguments", job.arguments}});
  core::write_file(folder / kPlanFile, core::json_text(Json{{"format", "chainsplat-batch/1"}, {"jobs", jobs}}) + "\n");
}

BatchPlan load_plan(const Path& folder) {
  const Path file = folder / kPlanFile;
  std::error_code error;
  if (!fs::exists(file, error))
    throw InputError(folder.string(), "is not the folder of a batch", "run 'chainsplat batch' into it first");
  BatchPlan plan;
  try {
    const Json document = core::parse_json(core::read_file(file));
    for (const Json& entry : document.at("jobs"))
      plan.jobs.push_back({entry.at("name"), entry.at("capture"), entry.at("settings"),
                           core::unsigned_number(entry.at("seed")),
                           entry.at("arguments").get<std::vector<std::string>>()});
    for (const BatchJob& job : plan.jobs)  // names a folder in this one
      if (job.name.empty() || job.name.find_first_of(std::string_view("/\0", 2)) != std::string::npos ||
          job.name == "." || job.name == "..")
        throw InputError(file.string(), "a job's name is '" + job.name + "', which is no folder's",
                         "run 'chainsplat batch' again, it is made anew");
  } catch (const Json::exception&) {
    throw InputError(file.string(), "is damaged", "run 'chainsplat batch' again, it is made anew");
  }
  return plan;
}

}  // namespace chainsplat::pipeline
