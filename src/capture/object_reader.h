// src/capture/object_reader.h - one JSON object of a file that people write: typed access that records what is missing
// or wrong, and continues with a default, so that one reading names all mistakes.
//
// `expected` says in a message what belongs there, as in "meters from the grasp to the free end".
#pragma once
#include <limits>
#include <nlohmann/json.hpp>
#include <optional>
#include <string>
#include <vector>

#include "src/capture/manifest.h"

namespace chainsplat::capture {

using Json = nlohmann::ordered_json;

// Parses a text that must be one JSON object without repeated keys; `file` is for the messages. Throws InputError.
Json parse_object(const std::string& text, const std::string& file, const char* expected);

// The text in quotes, cut to a length that fits on a line.
std::string in_quotes(const std::string& text);

class ObjectReader {
 public:
  // `object`: null where it is missing, which has been recorded; then everything in it is missing in silence.
  ObjectReader(const Json* object, std::string where, Findings& findings)
      : object_(object), where_(std::move(where)), findings_(findings) {}

  bool present() const { return object_ != nullptr; }
  bool has(const std::string& key) const { return object_ && object_->contains(key); }
  std::string at(const std::string& key) const { return where_ + (where_.ends_with(": ") ? "" : ".") + key; }
  void problem(const std::string& key, const std::string& what, const std::string& mend) const;
  void doubt(const std::string& key, const std::string& what) const;
  // Doubts unknown keys, and suggests the nearest known one where it is similar.
  void know(const std::vector<std::string>& known) const;

  const Json* find(const std::string& key, bool required, const char* expected) const;
  ObjectReader child(const std::string& key, bool required, const char* expected) const;
  std::optional<std::string> text(const std::string& key, bool required, const char* expected) const;
  // A relative path that stays inside the capture's folder.
  std::optional<std::string> path(const std::string& key, bool required, const char* expected) const;

  // All numbers are finite.
  std::optional<double> number(const std::string& key, bool required, const char* expected) const;
  // A positive number, or 0 and a problem. It may be at most `most`; `reason` ends the sentence that says so.
  double positive(const std::string& key, const char* expected, double most = std::numeric_limits<double>::max(),
                  const char* reason = "") const;
  std::optional<std::vector<double>> numbers(const std::string& key, std::size_t count, bool required,
                                             const char* expected) const;
  std::optional<math::Vector3> vector(const std::string& key, bool required, const char* expected) const;
  // A direction, normalized; a length other than 1 is doubted.
  std::optional<math::Vector3> direction(const std::string& key, const char* expected) const;
  // The frames per second, or 0 and a problem.
  double rate() const;
  // The side of an image in pixels, or 0 and a problem.
  int pixels(const std::string& key) const;
  // Whether a place in the world (m) is near enough to the origin that enough digits remain for the rope; else a
  // problem is recorded.
  bool near(const std::string& key, const math::Vector3& place) const;

 private:
  const Json* object_;
  std::string where_;
  Findings& findings_;
};

}  // namespace chainsplat::capture
