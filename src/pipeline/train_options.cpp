// train_options.cpp - what train can be asked for, as values and as texts.
#include <algorithm>
#include <array>
#include <charconv>
#include <sstream>

#include "chainsplat/pipeline.h"
#include "chainsplat/recognition.h"

namespace chainsplat::pipeline {

namespace {

constexpr std::array<const char*, 4> kStages = {"recognize", "identify", "rollout", "evaluate"};

int whole_number(const std::string& text, const std::string& where, const std::string& mend = "give one") {
  int value = 0;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (error != std::errc() || end != text.data() + text.size())
    throw InputError(where, "'" + text + "' is not a whole number", mend);
  return value;
}

bool truth(const std::string& text, const std::string& where) {
  if (text != "true" && text != "false") throw InputError(where, "is '" + text + "'", "write true or false");
  return text == "true";
}

std::string choice(const std::string& text, std::initializer_list<const char*> choices, const std::string& where) {
  std::string all;
  for (const char* const one : choices) {
    if (text == one) return text;
    all += (all.empty() ? "" : ", ") + std::string(one);
  }
  throw InputError(where, "'" + text + "' is not there to choose", "give one of " + all);
}

void check_groups(const std::vector<std::string>& groups, const std::string& where) {
  const auto& all = capture::corrected_quantities();
  for (const std::string& group : groups)
    if (group != "all" && std::none_of(all.begin(), all.end(), [&](const auto& q) { return group == q.group; }))
      throw InputError(where, "'" + group + "' is nothing that is estimated",
                       "name some of cameras,focal,time,length,diameter,grasp,table,masks,colors, or all");
}

std::vector<std::string> split(const std::string& text) {
  std::vector<std::string> all;
  std::istringstream words(text);
  for (std::string word; std::getline(words, word, ',');) all.push_back(word);
  return all;
}

}  // namespace

void TrainOptions::check() const {
  if (joints && (*joints < 1 || *joints > kMostJoints))
    throw InputError("`joints`", std::to_string(*joints) + " is not from 1 to " + std::to_string(kMostJoints),
                     "give for example 8");
  if (every < 1) throw InputError("`every`", std::to_string(every) + " is not above 0", "give for example 5");
  if (frames.first < 0 || (frames.last >= 0 && frames.last <= frames.first))
    throw InputError("`frames`", "'" + capture::frame_range_text(frames) + "' is no range of frames",
                     "give A:B, for example 0:60 for the first 60");
  check_groups(fixed, "`fixed`");
  if (!recognition::text_of(recognition::read_paper_choices(paper, "`paper`")).empty() && mode != twin::Mode::paper)
    throw InputError("`paper`", "goes with `mode` paper", "leave it out, or give that mode");
  if (force && resume) throw InputError("`force`, `resume`", "contradict each other", "give one of them");
}

const char* stage_text(Stage stage) { return kStages[static_cast<std::size_t>(stage)]; }

std::vector<Stage> read_stages(const std::string& text, const std::string& where) {
  std::vector<Stage> stages;
  std::istringstream words(text);
  for (std::string word; std::getline(words, word, ',');) {
    std::size_t at = 0;
    while (at < kStages.size() && word != kStages[at]) ++at;
    if (at == kStages.size())
      throw InputError(where, "'" + word + "' is not a stage", "name some of recognize,identify,rollout,evaluate");
    stages.push_back(static_cast<Stage>(at));
  }
  return stages;
}

const std::vector<Setting>& settings() {
  static const std::vector<Setting> all = {{"joints", false}, {"bending", false}, {"twist", true},   {"every", false},
                                           {"frames", false}, {"mode", false},    {"stages", false}, {"joint", true},
                                           {"fixed", false},  {"anyway", true},   {"paper", false}};
  return all;
}

void set(TrainOptions& options, const std::string& name, const std::string& text, const std::string& where) {
  if (name == "joints") {
    options.joints.reset();
    if (text != "auto") options.joints = whole_number(text, where, "give one, or auto");
  } else if (name == "bending") {
    const std::string kind = choice(text, {"auto", "planar", "spatial"}, where);
    options.bending.reset();
    if (kind != "auto") options.bending = kind == "planar" ? chain::Bending::planar : chain::Bending::spatial;
  } else if (name == "twist") {
    options.twist = truth(text, where);
  } else if (name == "every") {
    options.every = whole_number(text, where);
  } else if (name == "frames") {
    options.frames = capture::read_frame_range(text, where);
  } else if (name == "mode") {
    options.mode = choice(text, {"fast", "paper"}, where) == "paper" ? twin::Mode::paper : twin::Mode::fast;
  } else if (name == "stages") {
    options.stages = read_stages(text, where);
  } else if (name == "joint") {
    options.joint = truth(text, where);
  } else if (name == "anyway") {
    options.anyway = truth(text, where);
  } else if (name == "fixed") {
    options.fixed = split(text);
    check_groups(options.fixed, where);
  } else if (name == "paper") {
    recognition::read_paper_choices(text, where);
    options.paper = text;
  } else {
    throw InputError(where, "there is no setting '" + name + "'", "give one of those of train");
  }
}

}  // namespace chainsplat::pipeline
