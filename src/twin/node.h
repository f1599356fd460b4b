// src/twin/node.h - values of twin.json, checked as they are read.
#pragma once
#include <cmath>
#include <limits>
#include <nlohmann/json.hpp>
#include <string>
#include <utility>
#include <vector>

#include "chainsplat/core.h"
#include "chainsplat/math.h"

namespace chainsplat::twin {

using Json = nlohmann::ordered_json;
inline constexpr double kLengthTolerance = 1e-6;  // m, and for lengths of unit vectors; accepts files edited by hand

// A JSON value and its place in the file. Every access checks the value and throws InputError that names the place.
class Node {
 public:
  Node(const Json& value, std::string file, std::string key)
      : value_(value), file_(std::move(file)), key_(std::move(key)) {}

  [[noreturn]] void fail(const std::string& what, const std::string& mend) const {
    throw InputError(where(), what, mend);
  }
  std::string where() const { return key_.empty() ? file_ : file_ + ": " + key_; }
  bool has(const char* key) const { return value_.is_object() && value_.contains(key); }
  Node operator[](const char* key) const {
    if (!value_.is_object()) fail("is not an object", "restore it from a run that works");
    const Node child(has(key) ? value_[key] : value_, file_, key_.empty() ? key : key_ + "." + key);
    if (!has(key)) child.fail("is missing", "add it or train again");
    return child;
  }
  std::vector<Node> entries() const {
    if (!value_.is_array()) fail("is not a list", "restore it from a run that works");
    std::vector<Node> out;
    for (std::size_t i = 0; i < value_.size(); ++i)
      out.emplace_back(value_[i], file_, key_ + "[" + std::to_string(i) + "]");
    return out;
  }
  double number() const {
    if (!value_.is_number() || !std::isfinite(value_.get<double>())) fail("is not a finite number", "write one");
    return value_.get<double>();
  }
  double not_negative() const {
    const double value = number();
    if (value < 0.0) fail(core::exact(value) + " is negative", "write a number >= 0");
    return value;
  }
  double positive() const {
    const double value = number();
    if (value <= 0.0) fail(core::exact(value) + " is not positive", "write a number > 0");
    return value;
  }
  double number_or_nan() const { return value_.is_null() ? std::numeric_limits<double>::quiet_NaN() : number(); }
  int whole(int least, int most) const {
    const double value = number();
    if (value != std::floor(value) || value < least || value > most)
      fail(core::exact(value) + " is not a whole number from " + std::to_string(least) + " to " + std::to_string(most),
           "correct it");
    return static_cast<int>(value);
  }
  std::uint64_t unsigned_number() const {
    if (!value_.is_number_unsigned()) fail("is not a whole number >= 0", "correct it");
    return value_.get<std::uint64_t>();
  }
  bool boolean() const {
    if (!value_.is_boolean()) fail("is not true or false", "correct it");
    return value_.get<bool>();
  }
  std::string text() const {
    if (!value_.is_string()) fail("is not a text", "write it in quotes");
    return value_.get<std::string>();
  }
  // `count` < 0 accepts any number of entries; `unknown` reads null as NaN.
  std::vector<double> numbers(int count, bool unknown = false) const {
    std::vector<double> out;
    for (const Node& entry : entries()) out.push_back(unknown ? entry.number_or_nan() : entry.number());
    if (count >= 0 && static_cast<int>(out.size()) != count)
      fail("has " + std::to_string(out.size()) + " entries instead of " + std::to_string(count), "correct it");
    return out;
  }
  // None larger than `most` in size.
  std::vector<double> numbers_within(int count, double most) const {
    const std::vector<double> out = numbers(count);
    for (const double value : out)
      if (std::abs(value) > most) fail("holds " + core::exact(value) + ", which no rope has", "correct it");
    return out;
  }
  math::VectorX vector(int count) const {
    const std::vector<double> values = numbers(count);
    return Eigen::Map<const math::VectorX>(values.data(), count);
  }
  math::Vector3 unit() const {
    const math::Vector3 value = vector(3);
    const double error = std::abs(value.norm() - 1.0);
    if (error > kLengthTolerance) fail("is not a unit vector", "divide it by its length");
    // what save() wrote stays bit by bit; what a hand wrote with fewer digits would scale all that is computed with it
    constexpr double kRounding = 1e-14;
    return error > kRounding ? math::Vector3(value.normalized()) : value;
  }
  std::vector<std::pair<std::string, Node>> members() const {  // in the file's order
    if (!value_.is_object()) fail("is not an object", "restore it from a run that works");
    std::vector<std::pair<std::string, Node>> out;
    for (const auto& [key, value] : value_.items()) out.emplace_back(key, Node(value, file_, key_ + "." + key));
    return out;
  }

 private:
  const Json& value_;
  std::string file_, key_;
};

}  // namespace chainsplat::twin
