// camera_options.h - options that import and calibrate have in common: values by camera, and numbers with units.
#pragma once
#include <algorithm>
#include <filesystem>
#include <functional>
#include <span>
#include <string>
#include <vector>

#include "cli.h"

namespace chainsplat::tools {

// 'NAME=VALUE'; a value alone is for every camera that has none of its own.
template <class Camera>
void give_to_cameras(std::vector<Camera>& cameras, const std::vector<std::string>& texts, const std::string& option,
                     const std::function<void(Camera&, const std::string&)>& set) {
  for (const bool named : {false, true})
    for (const std::string& text : texts) {
      const std::size_t equals = text.find('=');
      const std::string name = text.substr(0, equals);
      const auto camera = std::find_if(cameras.begin(), cameras.end(), [&](const auto& c) { return c.name == name; });
      const bool own = equals != std::string::npos && camera != cameras.end();
      if (own && named) set(*camera, text.substr(equals + 1));
      if (own || named) continue;
      std::error_code error;
      if (equals != std::string::npos && !std::filesystem::exists(text, error)) {
        std::string list;
        for (const auto& c : cameras) list += (list.empty() ? "" : ", ") + c.name;
        throw InputError(option, "'" + name + "' is no camera", "there are " + list);
      }
      for (Camera& each : cameras) set(each, text);
    }
}

// '0.3', '30cm', '300 mm': a number and one of the units, of which the first is meant where none is named.
struct Unit {
  const char* name;
  double scale;
};
constexpr Unit kLengths[] = {{"m", 1.0}, {"cm", 1e-2}, {"mm", 1e-3}}, kMasses[] = {{"kg", 1.0}, {"g", 1e-3}},
               kTimes[] = {{"s", 1.0}, {"ms", 1e-3}};

inline double quantity(const std::string& text, const std::string& option, std::span<const Unit> units) {
  const std::size_t digit = text.find_last_of("0123456789.");
  const std::size_t end = digit == std::string::npos ? 0 : digit + 1;
  std::string unit = text.substr(end);
  unit.erase(0, unit.find_first_not_of(' '));
  if (unit.empty()) unit = units.front().name;
  for (const Unit& known : units)
    if (unit == known.name) return known.scale * numbers(text.substr(0, end), option, 1)[0];
  throw InputError(option, "'" + text + "' has no unit that is known",
                   std::string("write a number, in ") + units.front().name);
}

}  // namespace chainsplat::tools
