// paper_choices.cpp - what can be changed of the paper's procedure, read from text and written.
#include <algorithm>
#include <charconv>
#include <sstream>

#include "chainsplat/recognition.h"

namespace chainsplat::recognition {

namespace {

constexpr const char* kGrowth[] = {"no", "yes"};

constexpr const char* kBackgrounds[] = {"black", "white", "random"};
constexpr const char* kResets[] = {"none", "opacity", "links", "both"};  // by 1: of opacities, 2: of links

int resets_of(const PaperChoices& c) { return (c.opacity_resets ? 1 : 0) + (c.link_resets ? 2 : 0); }

}  // namespace

PaperChoices read_paper_choices(const std::string& text, const std::string& where) {
  PaperChoices out;
  std::istringstream words(text);
  for (std::string word; std::getline(words, word, ',');) {
    const std::string key = word.substr(0, word.find('=')), value = word.substr(std::min(word.size(), key.size() + 1));
    const auto one_of = [&](const auto& choices) {
      const auto at = std::find(std::begin(choices), std::end(choices), value);
      std::string all;
      for (const char* choice : choices) all += (all.empty() ? "" : ", ") + std::string(choice);
      if (at == std::end(choices))
        throw InputError(where, "'" + word + "' is not there to choose", "give one of " + all);
      return static_cast<int>(at - std::begin(choices));
    };
    const auto number = [&] {
      int result = 0;
      const auto [end, error] = std::from_chars(value.data(), value.data() + value.size(), result);
      if (error != std::errc() || end != value.data() + value.size() || result < 1 || result > 1000000)
        throw InputError(where, "'" + word + "' is no whole number from 1 to 1000000", "give for example 5000");
      return result;
    };
    if (key == "background")
      out.background = static_cast<Background>(one_of(kBackgrounds));
    else if (key == "growth")
      out.growth = one_of(kGrowth) == 1;
    else if (key == "resets")
      out.opacity_resets = one_of(kResets) % 2 == 1, out.link_resets = one_of(kResets) >= 2;
    else if (key == "gaussians")
      out.gaussians = number();
    else if (key == "iterations")
      out.iterations = number();
    else
      throw InputError(where, "there is no choice '" + key + "'",
                       "give some of background=, growth=, resets=, gaussians=, iterations=");
  }
  return out;
}

std::string text_of(const PaperChoices& c) {
  const PaperChoices usual;
  std::string text;
  const auto add = [&](const char* key, const std::string& value, bool differs) {
    if (differs) text += (text.empty() ? "" : ",") + std::string(key) + "=" + value;
  };
  add("background", kBackgrounds[static_cast<int>(c.background)], c.background != usual.background);
  add("growth", kGrowth[c.growth ? 1 : 0], c.growth != usual.growth);
  add("resets", kResets[resets_of(c)], resets_of(c) != resets_of(usual));
  add("gaussians", std::to_string(c.gaussians), c.gaussians != usual.gaussians);
  add("iterations", std::to_string(c.iterations), c.iterations != usual.iterations);
  return text;
}

}  // namespace chainsplat::recognition
