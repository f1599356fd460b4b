// lines.cpp - a force as a line of JSON, written and read back.
#include <cmath>
#include <nlohmann/json.hpp>

#include "chainsplat/force.h"
#include "chainsplat/json.h"

namespace chainsplat::force {

namespace {

using Json = nlohmann::ordered_json;

// Nothing that a rope is told by is larger: far below, squares and products could overflow.
constexpr double kMostTime = 1e12;  // s, thirty thousand years
constexpr double kMostPlace = 1e6;  // m
constexpr double kMostForce = 1e9;  // N or N/kg
constexpr double kRounding = 1e-6;  // relative, of what was computed twice, or by another program in few digits

Json list(const Vector3& v) { return {v.x(), v.y(), v.z()}; }

// The fields of a line.
struct Fields {
  const Json& object;
  const std::string& where;

  [[noreturn]] void refuse(const char* field, const std::string& what) const {
    throw InputError(where + ": " + field, what, "give the output of 'chainsplat force'");
  }
  const Json& at(const char* field) const {
    const auto found = object.find(field);
    if (found == object.end()) refuse(field, "is missing");
    return *found;
  }
  double within(const Json& value, const char* field, double least, double most) const {
    if (!value.is_number()) refuse(field, "is no finite number");
    const double out = value.get<double>();
    if (!(out >= least && out <= most))
      refuse(field, core::exact(out) + " is not from " + core::exact(least) + " to " + core::exact(most));
    return out;
  }
  double number(const char* field, double least, double most) const { return within(at(field), field, least, most); }
  bool flag(const char* field) const {
    if (!at(field).is_boolean()) refuse(field, "is not true or false");
    return at(field).get<bool>();
  }
  template <int count>
  Eigen::Vector<double, count> numbers(const char* field, double least, double most) const {
    const Json& values = at(field);
    if (!values.is_array() || values.size() != count)
      refuse(field, "is no list of " + std::to_string(count) + " numbers");
    Eigen::Vector<double, count> out;
    for (int i = 0; i < count; ++i) out[i] = within(values[static_cast<std::size_t>(i)], field, least, most);
    return out;
  }
};

}  // namespace

bool is_finite(const Estimate& e) {
  for (const Vector3& v : {e.point, e.force, e.sigma, e.low, e.high, e.observed})
    if (!v.allFinite()) return false;
  return e.covariance.allFinite() && std::isfinite(e.time) && std::isfinite(e.contact.arclength) &&
         std::isfinite(e.probability) && std::isfinite(e.arclength_sigma);
}

std::string to_json(const Estimate& e, bool known_mass) {
  Json triangle = Json::array();
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column <= row; ++column) triangle.push_back(e.covariance(row, column));
  const Json line{{"time", e.time},
                  {"link", e.contact.link},
                  {"arclength", e.contact.arclength},
                  {"point", list(e.point)},
                  {"force", list(e.force)},
                  {"sigma", list(e.sigma)},
                  {"covariance", std::move(triangle)},
                  {"touching", e.touching},
                  {"probability", e.probability},
                  {"observed", list(e.observed)},
                  {"low", list(e.low)},
                  {"high", list(e.high)},
                  {"arclength_sigma", e.arclength_sigma},
                  {"moving", e.moving},
                  {"unit", known_mass ? "N" : "N/kg"}};
  return line.dump();
}

Line from_json(const std::string& line, const std::string& where, const chain::Chain& chain, double before) {
  const Json object = core::parse_json_or_discard(line);
  if (!object.is_object())
    throw InputError(where, "is no line of 'chainsplat force'", "give its output: a JSON object a state");
  const Fields fields{object, where};
  Line out;
  Estimate& e = out.estimate;
  e.time = fields.number("time", -kMostTime, kMostTime);
  if (!(e.time > before))
    throw InputError(where + ": time",
                     core::exact(e.time) + " s is not after the " + core::exact(before) + " s of the line before",
                     "give the lines in order");
  const double link = fields.number("link", 0.0, chain.links() - 1.0);
  if (link != std::floor(link)) fields.refuse("link", "is no whole number");
  e.contact.link = static_cast<int>(link);
  e.contact.arclength = fields.number("arclength", 0.0, (1.0 + kRounding) * chain.length);
  e.arclength_sigma = fields.number("arclength_sigma", 0.0, chain.length);
  e.point = fields.numbers<3>("point", -kMostPlace, kMostPlace);
  e.force = fields.numbers<3>("force", -kMostForce, kMostForce);
  e.sigma = fields.numbers<3>("sigma", 0.0, kMostForce);
  const auto triangle = fields.numbers<6>("covariance", -kMostForce * kMostForce, kMostForce * kMostForce);
  for (int row = 0, i = 0; row < 3; ++row)
    for (int column = 0; column <= row; ++column, ++i)
      e.covariance(row, column) = e.covariance(column, row) = triangle[i];
  if (!math::is_covariance(e.covariance)) fields.refuse("covariance", "is not positive semidefinite");
  if (((e.covariance.diagonal().cwiseSqrt() - e.sigma).array().abs() > kRounding * e.sigma.array()).any())
    fields.refuse("sigma", "is not that of the covariance");
  e.low = fields.numbers<3>("low", -kMostForce, kMostForce);
  e.high = fields.numbers<3>("high", -kMostForce, kMostForce);
  if ((e.low.array() > e.high.array()).any()) fields.refuse("low", "is above high");
  e.observed = fields.numbers<3>("observed", 0.0, 1.0);
  e.probability = fields.number("probability", 0.0, 1.0);
  e.touching = fields.flag("touching");
  e.moving = fields.flag("moving");
  const Json& unit = fields.at("unit");
  if (unit != "N" && unit != "N/kg") fields.refuse("unit", "is not N or N/kg");
  out.known_mass = unit == "N";
  return out;
}

}  // namespace chainsplat::force
