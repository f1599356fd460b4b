// mutate_json.cpp - changes JSON as values, not as bytes, for the fuzzers of tools/fuzz.
//
// Nearly every change of one byte makes a text that the parser refuses, so that little reaches what reads the values.
// Here half of the changes remove, copy, swap, rename or replace whole values. libFuzzer calls it for every reader;
// what is not JSON is changed byte by byte, as without this file.
#include <algorithm>
#include <cstdint>
#include <cstring>
#include <limits>
#include <nlohmann/json.hpp>
#include <optional>
#include <random>
#include <string>
#include <string_view>
#include <vector>

extern "C" std::size_t LLVMFuzzerMutate(std::uint8_t* data, std::size_t size, std::size_t most);

namespace {

using Json = nlohmann::ordered_json;
using Random = std::minstd_rand;

std::size_t below(Random& random, std::size_t bound) {
  return std::uniform_int_distribution<std::size_t>(0, bound - 1)(random);
}

// A text and the JSON in it: all of it, what follows its first byte (readers of several files choose one by that), or
// one of its lines.
struct Document {
  std::string before, after;
  Json value;
};

std::optional<Document> parse(std::string_view text, Random& random) {
  const auto parsed = [](std::string_view part) { return Json::parse(part, nullptr, false); };
  const auto holds = [](const Json& value) { return value.is_structured() && !value.empty(); };
  for (const std::size_t skipped : {0u, 1u})
    if (text.size() > skipped)
      if (Json value = parsed(text.substr(skipped)); holds(value))
        return Document{std::string(text.substr(0, skipped)), "", std::move(value)};
  std::vector<std::size_t> begins{0};
  for (std::size_t at = 0; (at = text.find('\n', at)) != std::string_view::npos;) begins.push_back(++at);
  const std::size_t begin = begins[below(random, begins.size())];
  const std::size_t end = std::min(text.find('\n', begin), text.size());
  if (Json value = parsed(text.substr(begin, end - begin)); holds(value))
    return Document{std::string(text.substr(0, begin)), std::string(text.substr(end)), std::move(value)};
  return std::nullopt;
}

// A value and where it stands; the document itself has no parent.
struct Node {
  Json* value;
  Json* parent;
  std::string key;    // in an object
  std::size_t index;  // in an array
};

void collect(Json& value, Json* parent, const std::string& key, std::size_t index, std::vector<Node>& nodes) {
  nodes.push_back({&value, parent, key, index});
  if (value.is_object())
    for (auto& [name, member] : value.items()) collect(member, &value, name, 0, nodes);
  if (value.is_array())
    for (std::size_t i = 0; i < value.size(); ++i) collect(value[i], &value, "", i, nodes);
}

Json hostile(Random& random) {
  static const std::vector<Json> values{nullptr,
                                        true,
                                        false,
                                        0,
                                        -0.0,
                                        1,
                                        -1,
                                        2,
                                        3,
                                        64,
                                        1000,
                                        1e6,
                                        4294967296,
                                        std::numeric_limits<std::int64_t>::min(),
                                        std::numeric_limits<std::uint64_t>::max(),
                                        1e-320,
                                        1e-9,
                                        0.5,
                                        1e308,
                                        -1e308,
                                        "",
                                        "..",
                                        "/",
                                        "a",
                                        "1",
                                        "nan",
                                        "\n",
                                        std::string("\0", 1),
                                        Json::array(),
                                        Json::object(),
                                        Json::array({0}),
                                        Json::array({Json::array()}),
                                        Json::array({0, 0, 0}),
                                        Json::array({0, 0, 0, 1}),
                                        Json::object({{"", nullptr}})};
  return values[below(random, values.size())];
}

void change_leaf(Json& value, Random& random) {
  if (value.is_string()) {
    std::string text = value.get<std::string>();
    const std::size_t size = text.size();
    text.resize(size + 16);  // bytes: room to grow
    text.resize(LLVMFuzzerMutate(reinterpret_cast<std::uint8_t*>(text.data()), size, text.size()));
    value = text;
  } else if (value.is_number()) {
    const double number = value.get<double>();
    const double others[] = {-number,    number + 1,   number - 1,    2 * number,
                             number / 2, number * 1e3, number * 1e-3, number * (1 + 1e-9)};
    value = others[below(random, std::size(others))];
  } else {
    value = hostile(random);
  }
}

void mutate(Json& document, Random& random) {
  std::vector<Node> nodes;
  collect(document, nullptr, "", 0, nodes);
  Node& node = nodes[below(random, nodes.size())];
  Node& other = nodes[below(random, nodes.size())];
  const Json copy = *other.value;
  switch (below(random, 8)) {
    case 0:
      *node.value = hostile(random);
      break;
    case 1:
      if (node.parent && node.parent->is_object())
        node.parent->erase(node.key);
      else if (node.parent)
        node.parent->erase(node.index);
      break;
    case 2:
      *node.value = copy;
      break;
    case 3:  // one more member
      if (node.value->is_array())
        node.value->push_back(copy);
      else if (node.value->is_object())
        (*node.value)[other.key] = copy;
      break;
    case 4:  // another name
      if (node.parent && node.parent->is_object() && other.key != node.key) {
        const Json moved = *node.value;
        Json& parent = *node.parent;
        parent.erase(node.key);
        parent[other.key] = moved;
      }
      break;
    case 5:  // many
      if (node.value->is_array() && !node.value->empty()) {
        const Json member = (*node.value)[below(random, node.value->size())];
        for (std::size_t more = below(random, 32); more > 0; --more) node.value->push_back(member);
      }
      break;
    case 6: {  // a swap; not of a value with what it holds
      const Json first = *node.value;
      if (!node.value->is_structured() && !other.value->is_structured()) {
        *node.value = copy;
        *other.value = first;
      }
      break;
    }
    default:
      change_leaf(*node.value, random);
  }
}

// Returns how long the text is that it wrote, 0 where it is too long.
std::size_t write(const Document& document, std::uint8_t* out, std::size_t most) {
  const std::string text =
      document.before + document.value.dump(-1, ' ', false, Json::error_handler_t::replace) + document.after;
  if (text.size() > most) return 0;
  std::memcpy(out, text.data(), text.size());
  return text.size();
}

std::string_view view(const std::uint8_t* data, std::size_t size) {
  return {reinterpret_cast<const char*>(data), size};
}

}  // namespace

// libFuzzer finds both by their names.
extern "C" std::size_t LLVMFuzzerCustomMutator(std::uint8_t* data, std::size_t size, std::size_t most,
                                               unsigned int seed) {
  Random random(seed);
  if (below(random, 2) == 0)
    if (auto document = parse(view(data, size), random)) {
      for (std::size_t changes = 1 + below(random, 3); changes > 0; --changes) mutate(document->value, random);
      if (const std::size_t written = write(*document, data, most)) return written;
    }
  return LLVMFuzzerMutate(data, size, most);
}

// Puts a value of the second text into the first.
extern "C" std::size_t LLVMFuzzerCustomCrossOver(const std::uint8_t* data, std::size_t size, const std::uint8_t* data2,
                                                 std::size_t size2, std::uint8_t* out, std::size_t most,
                                                 unsigned int seed) {
  Random random(seed);
  auto first = parse(view(data, size), random);
  auto second = parse(view(data2, size2), random);
  if (!first || !second) return 0;
  std::vector<Node> into, from;
  collect(first->value, nullptr, "", 0, into);
  collect(second->value, nullptr, "", 0, from);
  const Node& target = into[below(random, into.size())];
  const Node& source = from[below(random, from.size())];
  if (target.value->is_object() && !source.key.empty())
    (*target.value)[source.key] = *source.value;
  else
    *target.value = Json(*source.value);
  return write(*first, out, most);
}
