#include "document.h"

#include <tinyxml2.h>
#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <cctype>
#include <charconv>
#include <cmath>

#include "chainsplat/json.h"

namespace chainsplat::importing {

namespace {

constexpr std::size_t kMostText = std::size_t{64} << 20;  // bytes; transforms.json of many thousand frames fit
constexpr std::size_t kMostYaml = std::size_t{4} << 20;   // bytes; its reader takes far more memory than the text
constexpr int kMostNodes = 200'000;                       // an alias of aliases would grow without bound
constexpr int kMostElements = 64;                         // of a matrix of a calibration

// Counts down, since a short YAML file can stand for an endless tree.
Json tree_of(const YAML::Node& node, int depth, int& left, const std::string& file) {
  if (depth > core::kDeepestJson || --left < 0)
    throw InputError(file, "is nested too deep or grows without bound", "give the file of a calibration");
  if (node.IsMap()) {
    Json object = Json::object();
    for (const auto& item : node)
      if (item.first.IsScalar()) object[item.first.Scalar()] = tree_of(item.second, depth + 1, left, file);
    return object;
  }
  if (node.IsSequence()) {
    Json array = Json::array();
    for (const auto& item : node) array.push_back(tree_of(item, depth + 1, left, file));
    return array;
  }
  if (!node.IsScalar()) return nullptr;
  const bool quoted = node.Tag() == "!";
  if (const auto value = quoted ? std::nullopt : number_of(node.Scalar())) return *value;
  return node.Scalar();
}

// OpenCV's XML: an element is an object of its children, or numbers between spaces, or a text.
Json tree_of(const tinyxml2::XMLElement& element, int depth, const std::string& file) {
  if (depth > core::kDeepestJson) throw InputError(file, "is nested too deep", "give the file of a calibration");
  Json object = Json::object();
  for (const auto* child = element.FirstChildElement(); child; child = child->NextSiblingElement())
    object[child->Name()] = tree_of(*child, depth + 1, file);
  if (!object.empty()) return object;
  const char* const inside = element.GetText();
  const std::string text = inside ? inside : "";
  Json numbers = Json::array();
  for (std::size_t at = 0; at < text.size();) {
    const std::size_t from = text.find_first_not_of(" \t\r\n", at);
    if (from == std::string::npos) break;
    at = std::min(text.find_first_of(" \t\r\n", from), text.size());
    const auto value = number_of(std::string_view(text).substr(from, at - from));
    if (!value) return text;
    numbers.push_back(*value);
  }
  return numbers.size() == 1 ? numbers[0] : numbers;
}

}  // namespace

std::optional<double> number_of(std::string_view text) {
  const auto space = [](char c) { return c == ' ' || c == '\t' || c == '\r'; };
  while (!text.empty() && space(text.front())) text.remove_prefix(1);
  while (!text.empty() && space(text.back())) text.remove_suffix(1);
  if (!text.empty() && text.front() == '+') text.remove_prefix(1);
  double value = 0.0;
  const auto [after, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (text.empty() || error != std::errc() || after != text.data() + text.size() || !std::isfinite(value))
    return std::nullopt;
  return value;
}

std::string lower(std::string_view text) {
  std::string out(text);
  for (char& c : out) c = static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
  return out;
}

std::vector<std::string> words(std::string_view name) {
  std::vector<std::string> out;
  bool open = false;
  for (std::size_t i = 0; i < name.size(); ++i) {
    const auto c = static_cast<unsigned char>(name[i]);
    if (!std::isalnum(c)) {
      open = false;
      continue;
    }
    // a capital behind a small letter begins a word
    if (i > 0 && std::isupper(c) && std::islower(static_cast<unsigned char>(name[i - 1]))) open = false;
    if (!open) out.emplace_back();
    open = true;
    out.back() += static_cast<char>(std::tolower(c));
  }
  return out;
}

std::string list_of(const std::vector<std::string>& names) {
  constexpr std::size_t kMost = 12;
  std::string out;
  for (std::size_t i = 0; i < std::min(names.size(), kMost); ++i) out += (i ? ", " : "") + names[i];
  return names.size() > kMost ? out + ", ..." : out;
}

Json read_document(const Path& file) {
  std::string text = core::read_file(file);
  if (text.size() > kMostText)
    throw InputError(file.string(), "is larger than " + std::to_string(kMostText >> 20) + " MiB, too large for numbers",
                     "give the file of a calibration");
  const std::size_t first = text.find_first_not_of(" \t\r\n");
  if (first != std::string::npos && (text[first] == '{' || text[first] == '[')) {
    Json json = core::parse_json_or_discard(text);
    if (!json.is_discarded()) return json;
  }
  if (first != std::string::npos && text[first] == '<') {
    tinyxml2::XMLDocument document;
    if (document.Parse(text.data(), text.size()) == tinyxml2::XML_SUCCESS && document.RootElement())
      return tree_of(*document.RootElement(), 0, file.string());
  }
  if (text.size() > kMostYaml)
    throw InputError(file.string(), "is YAML of more than " + std::to_string(kMostYaml >> 20) + " MiB",
                     "give the file of a calibration");
  // OpenCV writes '%YAML:1.0', which is no directive of YAML
  if (text.starts_with("%YAML")) text.erase(0, std::min(text.find('\n'), text.size()));
  try {
    int left = kMostNodes;
    return tree_of(YAML::Load(text), 0, left, file.string());
  } catch (const YAML::Exception& failure) {
    throw InputError(file.string() + (failure.mark.is_null() ? "" : ":" + std::to_string(failure.mark.line + 1)),
                     "is neither YAML, JSON nor OpenCV's XML", "give a file in a known format");
  }
}

const Json* find(const Json& object, std::initializer_list<const char*> names) {
  if (!object.is_object()) return nullptr;
  for (const char* name : names)
    for (const auto& item : object.items())
      if (lower(item.key()) == lower(name)) return &item.value();
  return nullptr;
}

const Json* find_path(const Json& document, const std::string& path) {
  if (document.is_object() && document.contains(path)) return &document[path];
  const std::size_t dot = path.find('.');
  if (dot == std::string::npos || !document.is_object() || !document.contains(path.substr(0, dot))) return nullptr;
  return find_path(document[path.substr(0, dot)], path.substr(dot + 1));
}

std::optional<double> number(const Json* value) {
  if (!value) return std::nullopt;
  if (value->is_number() && std::isfinite(value->get<double>())) return value->get<double>();
  return value->is_string() ? number_of(value->get<std::string>()) : std::nullopt;
}

std::optional<std::vector<double>> list(const Json* value) {
  if (!value || !value->is_array() || value->size() > kMostElements) return std::nullopt;
  std::vector<double> out;
  for (const Json& entry : *value) {
    if (const auto one = number(&entry)) {
      out.push_back(*one);
    } else if (const auto many = list(&entry)) {
      out.insert(out.end(), many->begin(), many->end());
    } else {
      return std::nullopt;
    }
  }
  if (out.size() > kMostElements) return std::nullopt;
  return out;
}

std::optional<math::MatrixX> matrix(const Json& value) {
  std::optional<std::vector<double>> numbers;
  Eigen::Index rows = 0, columns = 0;
  if (const Json* data = find(value, {"data"})) {
    numbers = list(data);
    rows = static_cast<Eigen::Index>(std::clamp(number(find(value, {"rows"})).value_or(0.0), 0.0, 64.0));
    columns = static_cast<Eigen::Index>(std::clamp(number(find(value, {"cols", "columns"})).value_or(0.0), 0.0, 64.0));
  } else if (value.is_array() && !value.empty() && value[0].is_array()) {
    numbers = list(&value);
    rows = static_cast<Eigen::Index>(value.size());
    columns = numbers ? static_cast<Eigen::Index>(numbers->size()) / rows : 0;
  } else {
    numbers = list(&value);
  }
  if (!numbers || numbers->empty()) return std::nullopt;
  const auto count = static_cast<Eigen::Index>(numbers->size());
  if (rows == 0 && columns == 0) {
    rows = count == 9 ? 3 : count == 12 ? 3 : count == 16 ? 4 : count;
    columns = count / rows;
  }
  if (rows * columns != count) return std::nullopt;
  return Eigen::Map<const Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>>(numbers->data(), rows,
                                                                                                  columns);
}

}  // namespace chainsplat::importing
