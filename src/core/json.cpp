#include "chainsplat/json.h"

#include <cstdint>
#include <limits>
#include <nlohmann/json.hpp>
#include <string>

namespace chainsplat::core {

namespace {

constexpr int kOtherType = 302;  // the library's own id for a value of another type

// Returns the byte at which the nesting exceeds kDeepestJson, or npos where it never does. Brackets inside strings do
// not count.
std::size_t too_deep(std::string_view text) {
  int depth = 0;
  bool in_string = false;
  for (std::size_t i = 0; i < text.size(); ++i) {
    const char c = text[i];
    if (in_string) {
      if (c == '\\')
        ++i;
      else if (c == '"')
        in_string = false;
    } else if (c == '"') {
      in_string = true;
    } else if (c == '[' || c == '{') {
      if (++depth > kDeepestJson) return i;
    } else if (c == ']' || c == '}') {
      --depth;
    }
  }
  return std::string_view::npos;
}

}  // namespace

nlohmann::ordered_json parse_json(std::string_view text) {
  using Json = nlohmann::ordered_json;
  if (const std::size_t at = too_deep(text); at != std::string_view::npos)
    // 101 is the library's own id for a syntax error
    throw nlohmann::json::parse_error::create(
        101, at, "nested deeper than " + std::to_string(kDeepestJson) + " brackets", nullptr);
  return Json::parse(text);
}

nlohmann::ordered_json parse_json_or_discard(std::string_view text) {
  try {
    return parse_json(text);
  } catch (const nlohmann::json::exception&) {
    return nlohmann::ordered_json(nlohmann::ordered_json::value_t::discarded);
  }
}

std::uint64_t unsigned_number(const nlohmann::ordered_json& value) {
  if (!value.is_number_unsigned())
    throw nlohmann::json::type_error::create(kOtherType, "is no whole number from 0 on", &value);
  return value.get<std::uint64_t>();
}

int whole_number(const nlohmann::ordered_json& value) {
  constexpr std::int64_t kMost = std::numeric_limits<int>::max();
  if (!value.is_number_integer() || value > kMost || value < -kMost)
    throw nlohmann::json::type_error::create(kOtherType, "is no whole number that fits", &value);
  return value.get<int>();
}

std::string json_text(const nlohmann::ordered_json& document, int indent) {
  return document.dump(indent, ' ', false, nlohmann::ordered_json::error_handler_t::replace);
}
std::string json_text(const nlohmann::json& document, int indent) {
  return document.dump(indent, ' ', false, nlohmann::json::error_handler_t::replace);
}

}  // namespace chainsplat::core
