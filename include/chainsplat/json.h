// chainsplat/json.h - JSON from outside, read with bounds, and written. Not installed: no header that is names the JSON library.
#pragma once
#include <cstdint>
#include <nlohmann/json_fwd.hpp>
#include <string>
#include <string_view>

namespace chainsplat::core {

// Parses JSON from outside with a bound on its nesting: the JSON library frees, copies and prints a document by
// recursion, so a file of nothing but brackets would overflow the stack. Throws nlohmann::json::exception when the text
// is not JSON, has a number beyond double, or is nested deeper than kDeepestJson.
constexpr int kDeepestJson = 64;
nlohmann::ordered_json parse_json(std::string_view text);
// As parse_json(), but returns a value whose is_discarded() is true instead of throwing.
nlohmann::ordered_json parse_json_or_discard(std::string_view text);
// The value of an integer. The JSON library turns any number into an int, and one that does not fit into an undefined
// one. Throws nlohmann::json::exception where it is none, or does not fit.
int whole_number(const nlohmann::ordered_json& value);
// The same of a whole number from 0 on.
std::uint64_t unsigned_number(const nlohmann::ordered_json& value);

// The text of a document, with `indent` spaces per level; below 0: on one line. Bytes that are no UTF-8, as names of
// files may have, become U+FFFD.
std::string json_text(const nlohmann::ordered_json& document, int indent = 1);
std::string json_text(const nlohmann::json& document, int indent = 1);

}  // namespace chainsplat::core
