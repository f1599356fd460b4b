#include "src/capture/object_reader.h"

#include <algorithm>
#include <cmath>
#include <set>

#include "chainsplat/json.h"
#include "chainsplat/text.h"

namespace chainsplat::capture {

using math::Vector3;

namespace {

// Bounds of what a file may request; see manifest.cpp.
constexpr std::size_t kMostText = std::size_t{4} << 20;  // bytes of capture.json
constexpr std::size_t kMostKeys = 1000;                  // per object, because keys are looked up one by one
constexpr int kLargestSide = 1 << 15;                    // px, of an image
constexpr double kFarthest = 1e6;                        // m from the origin; enough digits remain to resolve a pixel
constexpr int kMostUnknown = 5;                          // unknown keys per object that are named
constexpr double kUnitTolerance = 1e-3;                  // of a direction's length, beyond which it is doubted

// Levenshtein's distance, which finds the key that a misspelled one stands for.
int edit_distance(const std::string& a, const std::string& b) {
  std::vector<int> row(b.size() + 1);
  for (std::size_t j = 0; j <= b.size(); ++j) row[j] = static_cast<int>(j);
  for (std::size_t i = 1; i <= a.size(); ++i) {
    int diagonal = row[0];
    row[0] = static_cast<int>(i);
    for (std::size_t j = 1; j <= b.size(); ++j) {
      const int substituted = diagonal + (a[i - 1] != b[j - 1]);
      diagonal = row[j];
      row[j] = std::min({row[j] + 1, row[j - 1] + 1, substituted});
    }
  }
  return row[b.size()];
}

std::string line_of(const std::string& text, std::size_t byte) {
  const std::size_t end = std::min(byte, text.size());
  return std::to_string(1 + std::count(text.begin(), text.begin() + static_cast<std::ptrdiff_t>(end), '\n'));
}

// Finds what a parsed document hides or cannot bear: of a key that stands twice in an object it keeps only the last
// one, and it looks keys up one by one, so that very many keys in one object would take time quadratic in their number.
struct Keys : nlohmann::json_sax<Json> {
  std::vector<std::set<std::string>> objects;  // keys of the open objects, outermost first
  std::optional<std::string> twice;
  bool many = false;
  bool key(std::string& name) override {
    if (!objects.back().insert(name).second) twice = name;
    many = objects.back().size() > kMostKeys;
    return !twice && !many;
  }
  bool start_object(std::size_t) override {
    objects.emplace_back();
    return true;
  }
  bool end_object() override {
    objects.pop_back();
    return true;
  }
  bool null() override { return true; }
  bool boolean(bool) override { return true; }
  bool number_integer(Json::number_integer_t) override { return true; }
  bool number_unsigned(Json::number_unsigned_t) override { return true; }
  bool number_float(Json::number_float_t, const std::string&) override { return true; }
  bool string(std::string&) override { return true; }
  bool binary(Json::binary_t&) override { return true; }
  bool start_array(std::size_t) override { return true; }
  bool end_array() override { return true; }
  bool parse_error(std::size_t, const std::string&, const nlohmann::detail::exception&) override { return false; }
};

}  // namespace

std::string in_quotes(const std::string& text) {
  constexpr std::size_t kMost = 60;
  std::string out = "'";
  out.append(text, 0, kMost).append(text.size() > kMost ? "...'" : "'");
  return out;
}

Json parse_object(const std::string& text, const std::string& file, const char* expected) {
  if (text.size() > kMostText)
    throw InputError(file,
                     "is larger than " + std::to_string(kMostText >> 20) + " MiB, too large for numbers and names",
                     std::string("write ") + expected);
  Keys keys;
  Json::sax_parse(text, &keys);
  if (keys.twice)
    throw InputError(file, "the key " + in_quotes(*keys.twice) + " stands twice in one object", "remove one of them");
  if (keys.many)
    throw InputError(file, "an object has more than " + std::to_string(kMostKeys) + " keys",
                     std::string("write ") + expected);
  Json json;
  try {
    json = core::parse_json(text);
  } catch (const Json::parse_error& failure) {
    throw InputError(file + ":" + line_of(text, failure.byte),
                     "is not JSON (a comma, bracket or quote is missing, or the file is cut off)",
                     "correct this line or the one before");
  } catch (const Json::exception&) {  // thrown for a number beyond double
    throw InputError(file, "has a number that is too large", "write finite numbers");
  }
  if (!json.is_object()) throw InputError(file, "is not a JSON object", std::string("write ") + expected);
  return json;
}

void ObjectReader::problem(const std::string& key, const std::string& what, const std::string& mend) const {
  findings_.problems.push_back({at(key), what, mend});
}

void ObjectReader::doubt(const std::string& key, const std::string& what) const {
  findings_.doubts.push_back(at(key) + ": " + what);
}

void ObjectReader::know(const std::vector<std::string>& known) const {
  if (!object_ || known.empty()) return;
  int unknown = 0;
  for (const auto& item : object_->items()) {
    const std::string key = item.key().substr(0, 40);  // more characters than any known key has
    if (std::any_of(known.begin(), known.end(), [&](const std::string& k) { return key == k; })) continue;
    if (++unknown > kMostUnknown) continue;
    const auto further = [&](const std::string& a, const std::string& b) {
      return edit_distance(key, a) < edit_distance(key, b);
    };
    const std::string& nearest = *std::min_element(known.begin(), known.end(), further);
    const bool similar = edit_distance(key, nearest) <= std::max<int>(2, static_cast<int>(key.size()) / 3);
    doubt(key, std::string("unknown key, ignored") + (similar ? "; is " + in_quotes(nearest) + " meant?" : ""));
  }
  if (unknown > kMostUnknown)
    findings_.doubts.push_back(where_ + (where_.ends_with(": ") ? "" : ": ") + std::to_string(unknown) +
                               " unknown keys, all ignored");
}

const Json* ObjectReader::find(const std::string& key, bool required, const char* expected) const {
  if (!object_) return nullptr;
  const auto found = object_->find(key);
  if (found != object_->end()) return &*found;
  if (required) problem(key, "is missing", std::string("add it: ") + expected);
  return nullptr;
}

ObjectReader ObjectReader::child(const std::string& key, bool required, const char* expected) const {
  const Json* value = find(key, required, expected);
  if (value && !value->is_object()) {
    problem(key, "is not an object", std::string("write ") + expected);
    value = nullptr;
  }
  return ObjectReader(value, at(key), findings_);
}

std::optional<std::string> ObjectReader::text(const std::string& key, bool required, const char* expected) const {
  const Json* value = find(key, required, expected);
  if (!value) return std::nullopt;
  if (value->is_string()) return value->get<std::string>();
  problem(key, "is not a text", std::string("write ") + expected);
  return std::nullopt;
}

std::optional<std::string> ObjectReader::path(const std::string& key, bool required, const char* expected) const {
  const auto value = text(key, required, expected);
  if (!value) return std::nullopt;
  const Path normal = Path(*value).lexically_normal();
  if (value->empty() || value->find('\0') != std::string::npos || normal.is_absolute() || normal == "." ||
      *normal.begin() == "..") {
    problem(key, in_quotes(*value) + " is not a path inside the capture's folder", "put the file into the folder");
    return std::nullopt;
  }
  constexpr std::size_t kLongestPath = 4096;  // bytes, Linux's limit
  if (value->size() > kLongestPath) {
    problem(key, in_quotes(*value) + " is longer than a path can be", "shorten it");
    return std::nullopt;
  }
  return value;
}

std::optional<double> ObjectReader::number(const std::string& key, bool required, const char* expected) const {
  const Json* value = find(key, required, expected);
  if (!value) return std::nullopt;
  if (value->is_number() && std::isfinite(value->get<double>())) return value->get<double>();
  problem(key, value->is_number() ? "is not finite" : "is not a number", std::string("write ") + expected);
  return std::nullopt;
}

double ObjectReader::positive(const std::string& key, const char* expected, double most, const char* reason) const {
  const auto value = number(key, true, expected);
  if (!value) return 0.0;
  if (*value <= 0.0) problem(key, core::exact(*value) + " is not positive", std::string("write ") + expected);
  if (*value > most)
    problem(key, core::exact(*value) + " is more than " + core::exact(most) + reason, std::string("write ") + expected);
  return *value;
}

std::optional<std::vector<double>> ObjectReader::numbers(const std::string& key, std::size_t count, bool required,
                                                         const char* expected) const {
  const Json* value = find(key, required, expected);
  if (!value) return std::nullopt;
  if (!value->is_array() || value->size() != count) {
    problem(key,
            value->is_array() ? "has " + std::to_string(value->size()) + " entries instead of " + std::to_string(count)
                              : "is not a list",
            std::string("write ") + expected);
    return std::nullopt;
  }
  std::vector<double> out;
  for (const Json& entry : *value) {
    if (!entry.is_number() || !std::isfinite(entry.get<double>())) {
      problem(key + "[" + std::to_string(out.size()) + "]", "is not a finite number", std::string("write ") + expected);
      return std::nullopt;
    }
    out.push_back(entry.get<double>());
  }
  return out;
}

std::optional<Vector3> ObjectReader::vector(const std::string& key, bool required, const char* expected) const {
  const auto values = numbers(key, 3, required, expected);
  if (!values) return std::nullopt;
  return Vector3((*values)[0], (*values)[1], (*values)[2]);
}

std::optional<Vector3> ObjectReader::direction(const std::string& key, const char* expected) const {
  const auto value = vector(key, true, expected);
  if (!value) return std::nullopt;
  const double length = value->norm();
  if (!(length > 0.0)) {
    problem(key, "has no length", std::string("write ") + expected);
    return std::nullopt;
  }
  if (std::abs(length - 1.0) > kUnitTolerance)
    doubt(key, "has length " + core::brief(length) + ", taken as a direction");
  return *value / length;
}

double ObjectReader::rate() const {
  const double value = positive("rate", "frames a second");
  if (value >= kSlowestRate && value <= kFastestRate) return value;
  if (value > 0.0)
    problem("rate",
            core::exact(value) + " is not between " + core::exact(kSlowestRate) + " and " +
                std::to_string(static_cast<int>(kFastestRate)) +
                " frames a second, between which cameras record motion",
            "write frames a second");
  return 0.0;
}

int ObjectReader::pixels(const std::string& key) const {
  const auto value = number(key, true, "a whole number of pixels");
  if (!value) return 0;
  if (*value < 1 || *value > kLargestSide || *value != std::floor(*value)) {
    problem(key, core::exact(*value) + " is not an image size", "write a whole number of pixels");
    return 0;
  }
  return static_cast<int>(*value);
}

bool ObjectReader::near(const std::string& key, const Vector3& place) const {
  if (place.cwiseAbs().maxCoeff() <= kFarthest) return true;
  problem(key,
          "lies more than " + std::to_string(static_cast<int>(kFarthest)) +
              " m from the world's origin, too far for exact numbers",
          "write meters from an origin near the rope");
  return false;
}

}  // namespace chainsplat::capture
