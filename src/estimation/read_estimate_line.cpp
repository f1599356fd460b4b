#include "chainsplat/estimate_lines.h"

#include <cmath>
#include <istream>
#include <nlohmann/json.hpp>
#include <vector>

#include "chainsplat/core.h"
#include "chainsplat/json.h"

namespace chainsplat::estimation {

namespace {

using Json = nlohmann::ordered_json;

// No rope turns so far or so fast, and no clock runs so long: far below, squares and products could overflow.
constexpr double kMostAngle = 1e6;      // rad, rad/s
constexpr double kMostTime = 1e12;      // s, thirty thousand years
constexpr double kLatest = 60.0;        // s, of the base's stamps
constexpr double kLargestShift = 10.0;  // m, of the rope in the grasp

[[noreturn]] void refuse(const std::string& where, const char* field, const std::string& what) {
  throw InputError(where + ": " + field, what, "give the output of 'chainsplat estimate'");
}

double number(const Json& value, const std::string& where, const char* field, double most) {
  if (!value.is_number()) refuse(where, field, "is no finite number");
  const double out = value.get<double>();
  if (!(std::abs(out) <= most)) refuse(where, field, core::exact(out) + " is beyond " + core::exact(most));
  return out;
}

// Empty where the field is missing.
math::VectorX numbers(const Json& object, const std::string& where, const char* field, double most) {
  const auto found = object.find(field);
  if (found == object.end()) return {};
  if (!found->is_array()) refuse(where, field, "is no list of numbers");
  math::VectorX out(static_cast<Eigen::Index>(found->size()));
  for (Eigen::Index i = 0; i < out.size(); ++i)
    out[i] = number((*found)[static_cast<std::size_t>(i)], where, field, most);
  return out;
}

}  // namespace

BaseCorrection base_correction(const capture::Corrections& corrections) {
  return {capture::value_of(corrections, "base", "time"), capture::grasp_in_base(corrections)};
}

BaseCorrection operator*(const BaseCorrection& first, const BaseCorrection& second) {
  return {first.late + second.late, first.grasp * second.grasp};
}

BaseCorrection inverse(const BaseCorrection& correction) { return {-correction.late, correction.grasp.inverse()}; }

BaseCorrection remaining(const std::optional<BaseCorrection>& said, const BaseCorrection& known) {
  return said ? inverse(known) * *said : BaseCorrection{};
}

trajectory::BaseMotion corrected(const std::function<trajectory::BaseMotion(double time)>& given,
                                 const BaseCorrection& correction, double time) {
  trajectory::BaseMotion out = given(time + correction.late);
  const math::Pose from_base = correction.grasp.inverse();
  out.pose = out.pose * correction.grasp;
  out.velocity = math::transform_twist(from_base, out.velocity);
  out.acceleration = math::transform_twist(from_base, out.acceleration);
  return out;
}

std::optional<EstimateLine> read_estimate_line(const std::string& line, const std::string& where, int angles,
                                               double before) {
  const Json object = core::parse_json_or_discard(line);
  if (!object.is_object())
    throw InputError(where, "is no line of 'chainsplat estimate'", "give its output: a JSON object a frame");
  if (const auto lost = object.find("lost"); lost != object.end()) {
    if (!lost->is_boolean()) refuse(where, "lost", "is not true or false");
    if (lost->get<bool>()) return {};
  }
  if (const auto status = object.find("status"); status != object.end()) {
    if (!status->is_string()) refuse(where, "status", "is no text");
    if (status->get<std::string>() != "following") return {};
  }
  if (const auto settling = object.find("settling"); settling != object.end()) {
    if (!settling->is_boolean()) refuse(where, "settling", "is not true or false");
    if (settling->get<bool>()) return {};
  }
  for (const char* field : {"time", "theta"})
    if (!object.contains(field)) refuse(where, field, "is missing");
  EstimateLine out;
  out.time = number(object["time"], where, "time", kMostTime);
  if (!(out.time > before))
    throw InputError(where + ": time",
                     core::exact(out.time) + " s is not after the " + core::exact(before) + " s of the line before",
                     "give the lines in order");
  out.theta = numbers(object, where, "theta", kMostAngle);
  out.thetadot = numbers(object, where, "thetadot", kMostAngle);
  out.sigma = numbers(object, where, "sigma", kMostAngle);
  for (const auto& [field, values] :
       {std::pair("theta", &out.theta), {"thetadot", &out.thetadot}, {"sigma", &out.sigma}})
    if (values->size() != angles && (values->size() > 0 || values == &out.theta))
      throw InputError(where + ": " + field,
                       "has " + std::to_string(values->size()) + " angles, the twin " + std::to_string(angles),
                       "give estimates of this twin");
  for (const char* field : {"base_late", "grasp_rotation", "grasp_shift"})
    if (object.contains(field)) out.base.emplace();
  if (const auto late = object.find("base_late"); late != object.end())
    out.base->late = number(*late, where, "base_late", kLatest);
  if (const auto sigma = object.find("base_late_sigma"); sigma != object.end())
    out.late_sigma = number(*sigma, where, "base_late_sigma", kLatest);
  if (out.late_sigma < 0.0) refuse(where, "base_late_sigma", "is negative");
  out.theta_by_late = numbers(object, where, "theta_by_base_late", kMostAngle);
  if (out.theta_by_late.size() != angles && out.theta_by_late.size() > 0)
    refuse(where, "theta_by_base_late", "has not the number of the angles");
  if (const math::VectorX turn = numbers(object, where, "grasp_rotation", M_PI); turn.size() > 0) {
    if (turn.size() != 3) refuse(where, "grasp_rotation", "is no rotation vector");
    out.base->grasp.rotation = math::exp_so3(turn);
  }
  if (const math::VectorX shift = numbers(object, where, "grasp_shift", kLargestShift); shift.size() > 0) {
    if (shift.size() != 3) refuse(where, "grasp_shift", "is no vector");
    out.base->grasp.translation = shift;
  }
  if ((out.sigma.array() < 0.0).any()) refuse(where, "sigma", "is negative");

  const math::VectorX triangle = numbers(object, where, "covariance", kMostAngle * kMostAngle);
  if (triangle.size() == 0) return out;
  const Eigen::Index own = angles, all = 2 * own;  // with the rates: their rows follow
  if (triangle.size() != own * (own + 1) / 2 && triangle.size() != all * (all + 1) / 2)
    refuse(where, "covariance", "is no lower triangle of the angles");
  out.covariance.resize(own, own);
  for (Eigen::Index row = 0, i = 0; row < own; ++row)
    for (Eigen::Index column = 0; column <= row; ++column, ++i)
      out.covariance(row, column) = out.covariance(column, row) = triangle[i];
  if (!math::is_covariance(out.covariance)) refuse(where, "covariance", "is not positive semidefinite");
  return out;
}

bool next_line(std::istream& in, std::string& line, const std::string& where, const std::string& command) {
  constexpr std::size_t kLongest =
      64 << 20;  // bytes; an estimate of a thousand angles, with covariance, has half of it
  line.clear();
  for (char letter = 0; in.get(letter);) {
    if (letter == '\n') return true;
    if (line.size() == kLongest)
      throw InputError(where, "has a line of more than 64 MiB", "give the output of 'chainsplat " + command + "'");
    line += letter;
  }
  if (in.bad()) throw InputError(where, "cannot be read", "give the output of 'chainsplat " + command + "'");
  return !line.empty();
}

}  // namespace chainsplat::estimation
