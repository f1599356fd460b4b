// options.cpp - what a field of the library's options structs is called on the command line.
#include <algorithm>
#include <map>

#include "chainsplat/capture.h"
#include "cli.h"
#include "command_line.h"

namespace chainsplat::tools {

namespace {

// Fields that are not named as their options are: target_velocity is --target-velocity without a line here.
const std::map<std::string, std::string> kOtherNames = {
    {"boxes", "--keep-out-box"},
    {"contacts", "--contact"},
    {"loop.rate", "--mpc-rate"},
    {"loop.target_velocity", "--target-velocity"},
    {"output", "-o"},
    {"spheres", "--keep-out-sphere"},
    {"targets", "--target"},
    {"truth", "--simulate"},
};

std::string option_of(const std::string& field) {
  if (const auto other = kOtherNames.find(field); other != kOtherNames.end()) return other->second;
  std::string name = "--" + field;
  std::replace(name.begin(), name.end(), '_', '-');
  return name;
}

}  // namespace

std::string with_options(const std::string& text) {
  std::string out;
  for (std::size_t at = 0; at < text.size();) {
    const std::size_t open = text.find('`', at), close = text.find('`', std::min(open, text.size() - 1) + 1);
    const std::string field = close == std::string::npos ? "" : text.substr(open + 1, close - open - 1);
    const bool plain = !field.empty() && field.find_first_not_of("abcdefghijklmnopqrstuvwxyz_") == std::string::npos;
    if (!plain && !kOtherNames.count(field)) {
      const std::size_t end = open == std::string::npos ? text.size() : open + 1;
      out.append(text, at, end - at);
      at = end;
      continue;
    }
    out.append(text, at, open - at).append(option_of(field));
    at = close + 1;
  }
  return out;
}

void add_payload_options(Command command, PayloadRequest& request) {
  command
      .add_option(
          "--tip-mass", request.mass,
          "kg, of what hangs at the free end beside the rope, and its standard deviation after a comma; 0: nothing\n"
          "(default: not known; found where the motion tells it)")
      .delimiter(',')
      .expected(1, 2)
      .type_name("KG");
  command
      .add_option("--tip-length", request.length,
                  "m, how far that reaches beyond the rope's end, a rod that goes on there; 0: a point (default: not\n"
                  "known; as long as things of its mass are, which leaves the stiffness less sure)")
      .expected(1)
      .type_name("M");
}

std::optional<capture::Payload> payload_of(const PayloadRequest& request) {
  constexpr double kHeaviest = 1e4, kLongest = 10.0;  // kg and m, as in capture.json
  const std::vector<double>& numbers = request.mass;
  const bool known = !request.length.empty();
  if (numbers.empty() && known)
    throw InputError("--tip-length", "says nothing without a payload's mass", "give --tip-mass, too");
  if (numbers.empty()) return {};
  if (known && !(request.length[0] >= 0.0 && request.length[0] <= kLongest))
    throw InputError("--tip-length", core::exact(request.length[0]) + " m is no length of a payload",
                     "give meters from 0 to " + core::exact(kLongest));
  for (const double number : numbers)
    if (!(number >= 0.0 && number <= kHeaviest))
      throw InputError("--tip-mass", core::exact(number) + " kg is no mass of a payload",
                       "give kilograms from 0 to " + core::exact(kHeaviest));
  capture::Payload payload{numbers[0], numbers.size() > 1 ? numbers[1] : 0.0};
  if (known) payload.length = request.length[0];
  return payload;
}

std::string shell_quoted(const std::string& text, const std::string& also) {
  std::string out = "'";
  for (const char letter : text) {
    if (also.find(letter) != std::string::npos) out += '\\';
    out += letter == '\'' ? "'\\''" : std::string(1, letter);
  }
  return out + "'";
}

}  // namespace chainsplat::tools
