// page.cpp - the data of the page, and the page around them.
#include <algorithm>
#include <cmath>
#include <string_view>

#include "chainsplat/image_model.h"
#include "chainsplat/json.h"
#include "chainsplat/render.h"
#include "chainsplat/report.h"
#include "chainsplat/twin_json.h"
#include "report_page.h"

namespace chainsplat::report {

using Json = nlohmann::ordered_json;
using math::Matrix3;
using math::Vector3;
using math::VectorX;

namespace {

std::string base64(std::string_view bytes) {
  constexpr char kDigits[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  std::string out;
  out.reserve((bytes.size() + 2) / 3 * 4);
  for (std::size_t i = 0; i < bytes.size(); i += 3) {
    std::uint32_t three = 0;
    for (std::size_t k = 0; k < 3; ++k)
      three = three << 8 | (i + k < bytes.size() ? static_cast<std::uint8_t>(bytes[i + k]) : 0u);
    for (std::size_t k = 0; k < 4; ++k) out += i + k <= bytes.size() ? kDigits[three >> (18 - 6 * k) & 63] : '=';
  }
  return out;
}

// Numbers as little-endian binary in base64.
template <class Number, class Values>
std::string binary(const Values& values) {
  std::vector<Number> numbers;
  for (const auto& value : values) numbers.push_back(static_cast<Number>(value));
  return base64({reinterpret_cast<const char*>(numbers.data()), numbers.size() * sizeof(Number)});
}

std::string rows(const std::vector<VectorX>& vectors) {
  std::vector<double> all;
  for (const VectorX& each : vectors) all.insert(all.end(), each.begin(), each.end());
  return binary<float>(all);
}

Json list(const Vector3& v) { return {v.x(), v.y(), v.z()}; }

Json pose_json(const math::Pose& pose) {
  Json out = Json::array();
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 3; ++column) out.push_back(pose.rotation(row, column));
  for (const double x : pose.translation) out.push_back(x);
  return out;
}

Json chain_json(const chain::Chain& chain) {
  Json screws = Json::array(), child = Json::array(), names = Json::array(), starts = Json::array(),
       lifts = Json::array();  // base frame, m
  int rank = 0;
  for (int k = 0; k < chain.angles(); ++k) {
    for (const double x : chain.axes[k]) screws.push_back(x);
    child.push_back(chain.child_link[k]);
    rank = k > 0 && chain.child_link[k] == chain.child_link[k - 1] ? rank + 1 : 0;
    names.push_back("joint " + std::to_string(chain.child_link[k]) +
                    (chain::is_twist(chain, k) ? ", twist"
                     : rank == 0               ? ""
                                               : ", second axis"));
  }
  for (int j = 0; j < chain.links(); ++j) {
    starts.push_back(chain.link_start(j));
    lifts.push_back(list(Vector3(chain.link_lift(j) * chain.bending_axis)));
  }
  return {{"length", chain.length},
          {"diameter", chain.diameter},
          {"direction", list(chain.direction)},
          {"screws", screws},
          {"child", child},
          {"angles", names},
          {"starts", starts},
          {"lifts", lifts}};
}

// A Gaussian on a link, as the page draws it: center 3, covariance xx xy xz yy yz zz, opacity, colors. What can never
// be seen is left out (mathematics.md 2.4).
Json splats_json(const splat::Gaussians& g) {
  const int coefficients = g.sh_coefficients();
  std::vector<float> values;
  std::vector<std::uint8_t> link, guessed;
  for (int i = 0; i < g.count; ++i) {
    Eigen::Quaterniond q(g.rotation[4 * i], g.rotation[4 * i + 1], g.rotation[4 * i + 2], g.rotation[4 * i + 3]);
    Matrix3 half = q.normalized().toRotationMatrix();
    for (int c = 0; c < 3; ++c) half.col(c) *= std::exp(static_cast<double>(g.log_scale[3 * i + c]));
    const Matrix3 covariance = half * half.transpose();
    const double opacity = 1.0 / (1.0 + std::exp(-static_cast<double>(g.opacity_logit[i])));
    const auto first = g.link_logits.begin() + static_cast<std::ptrdiff_t>(g.links) * i;
    const float most = *std::max_element(first, first + g.links);
    double sum = 0.0;
    for (int j = 0; j < g.links; ++j) sum += std::exp(static_cast<double>(first[j] - most));
    for (int j = 0; j < g.links; ++j) {
      const double alpha = opacity * std::exp(static_cast<double>(first[j] - most)) / sum;
      if (alpha <= image_model::kLeastAlpha) continue;
      link.push_back(static_cast<std::uint8_t>(j));
      guessed.push_back(g.guessed[i]);
      for (int c = 0; c < 3; ++c) values.push_back(g.mean[3 * i + c]);
      for (int row = 0; row < 3; ++row)
        for (int column = row; column < 3; ++column) values.push_back(static_cast<float>(covariance(row, column)));
      values.push_back(static_cast<float>(alpha));
      for (int c = 0; c < 3 * coefficients; ++c)
        values.push_back(g.sh[3 * static_cast<std::size_t>(coefficients) * i + c]);
    }
  }
  Json light = nullptr;
  if (g.light.known())
    light = {{"axis", list(g.light.axis)},
             {"constant", g.light.constant},
             {"linear", list(g.light.linear)},
             {"quadratic", std::vector<double>(g.light.quadratic.data(), g.light.quadratic.data() + 9)}};
  return {{"count", link.size()},
          {"light", light},
          {"pixelFootprint", g.pixel_footprint},
          {"gaussians", g.count},
          {"degree", g.degree},
          {"stride", 10 + 3 * coefficients},
          {"link", binary<std::uint8_t>(link)},
          {"guessed", binary<std::uint8_t>(guessed)},
          {"values", binary<float>(values)}};
}

// The overlap of every frame, camera by camera, out of metrics.json.
Json overlap_json(const Json& metrics) {
  struct Frames {
    std::vector<double> times, values;
    std::vector<int> numbers;
  };
  std::vector<std::pair<std::string, Frames>> cameras;
  for (const Json& frame : metrics["frames"]) {
    const std::string name = frame["camera"].get<std::string>();
    if (cameras.empty() || cameras.back().first != name) cameras.emplace_back(name, Frames{});
    Frames& frames = cameras.back().second;
    frames.times.push_back(frame["time"].get<double>());
    frames.values.push_back(frame["iou"].get<double>());
    frames.numbers.push_back(frame["frame"].get<int>());
  }
  Json out = Json::object();
  for (const auto& [name, frames] : cameras)
    out[name] = {{"times", binary<double>(frames.times)},
                 {"values", binary<float>(frames.values)},
                 {"numbers", binary<std::int32_t>(frames.numbers)}};
  return out;
}

Json motion_json(const std::string& name, const chain::States& states, const std::vector<VectorX>& sigma,
                 const std::vector<math::Pose>& base, const Json& metrics) {
  std::vector<double> poses;
  Eigen::Quaterniond before(1, 0, 0, 0);
  for (const math::Pose& pose : base) {
    Eigen::Quaterniond q(pose.rotation);
    if (q.dot(before) < 0.0) q.coeffs() *= -1.0;  // cubics between them need one sign
    before = q;
    poses.insert(poses.end(), pose.translation.begin(), pose.translation.end());
    poses.insert(poses.end(), q.coeffs().begin(), q.coeffs().end());  // x, y, z, w
  }
  Json out{{"name", name},
           {"time", binary<double>(states.time)},
           {"theta", rows(states.theta)},
           {"base", binary<float>(poses)}};
  if (!sigma.empty()) out["sigma"] = rows(sigma);
  if (!states.roll.empty()) out["roll"] = rows(states.roll);
  if (metrics.is_object()) {
    out["metrics"] = {{"mean", metrics["mean"]}, {"cameras", metrics["cameras"]}};
    out["overlap"] = overlap_json(metrics);
  }
  return out;
}

std::vector<math::Pose> poses_at(const trajectory::Trajectory& base, const std::vector<double>& times) {
  std::vector<math::Pose> out;
  for (const double time : times) out.push_back(base.samples().empty() ? math::Pose() : base.pose(time));
  return out;
}

// Every n-th, where all would be too many to draw.
template <class Value>
std::vector<Value> thinned(const std::vector<Value>& values, std::size_t every) {
  std::vector<Value> out;
  for (std::size_t k = 0; k < values.size(); k += every) out.push_back(values[k]);
  return out;
}

std::size_t step_through(std::size_t count) {
  constexpr std::size_t kMost = 10000;  // five minutes at 30 Hz, and what a browser draws in a frame
  return (count + kMost - 1) / kMost;
}

// A step in time that is longer is one over frames in which the rope was lost.
double longest_step(const std::vector<double>& times) {
  constexpr double kLost = 3.5;  // median steps: a few frames that a busy machine drops are no gap
  return kLost * render::median_interval(times);
}

Json followed_json(const Followed& followed) {
  const std::size_t every = step_through(followed.states.time.size());
  chain::States states;
  states.time = thinned(followed.states.time, every);
  states.theta = thinned(followed.states.theta, every);
  Json out = motion_json("followed", states, thinned(followed.sigma, followed.sigma.empty() ? 1 : every),
                         thinned(followed.base, every), {});
  out["gap"] = longest_step(states.time);
  out["frames"] = followed.states.time.size();
  out["own"] = followed.own_recording;
  return out;
}

Json motions_json(const Contents& contents) {
  const twin::Twin& twin = contents.twin;
  const auto metrics = [&](const char* key) {
    return contents.metrics.is_object() && contents.metrics.contains(key) ? contents.metrics[key] : Json();
  };
  std::vector<VectorX> sigma;
  for (const math::MatrixX& covariance : twin.states.covariance)
    sigma.push_back(covariance.diagonal().cwiseMax(0.0).cwiseSqrt());
  Json out = Json::array();
  out.push_back(
      motion_json("recognized", twin.states, sigma, poses_at(contents.base, twin.states.time), metrics("recognized")));
  if (!twin.rollout.time.empty())
    out.push_back(motion_json("rolled out", twin.rollout, rollout_deviations(twin, contents.base),
                              poses_at(contents.base, twin.rollout.time), metrics("rollout")));
  if (contents.followed) out.push_back(followed_json(*contents.followed));
  return out;
}

// Forces at their times: `values` has point 3, force 3, covariance xx xy xz yy yz zz, size, its error, least and most.
Json forces_json(const twin::Twin& twin, const std::vector<force::Estimate>& forces) {
  constexpr std::uint8_t kTouching = 1, kMoving = 2;
  constexpr double kLongest = 0.8;  // of the rope, the longest arrow: it shall stay in the picture
  const force::Estimate* const most = largest(forces);
  // a force as large as the rope's weight is as long as the rope
  const double weight = dynamics::total_mass(*twin.parameters) * twin.parameters->gravity.norm();
  double length = weight > 0.0 ? twin.chain.length / weight : twin.chain.length;
  if (most) length = std::min(length, kLongest * twin.chain.length / size_of(*most).value);
  std::vector<double> values, times;
  std::vector<std::uint8_t> flags;
  for (const force::Estimate& e : thinned(forces, step_through(forces.size()))) {
    times.push_back(e.time);
    values.insert(values.end(), e.point.begin(), e.point.end());
    values.insert(values.end(), e.force.begin(), e.force.end());
    for (int row = 0; row < 3; ++row)
      for (int column = row; column < 3; ++column) values.push_back(e.covariance(row, column));
    const ForceSize size = size_of(e);
    for (const double each : {size.value, size.error, size.least, size.most}) values.push_back(each);
    flags.push_back(static_cast<std::uint8_t>((e.touching ? kTouching : 0) | (e.moving ? kMoving : 0)));
  }
  Json out{
      {"time", binary<double>(times)},
      {"values", binary<float>(values)},
      {"flags", binary<std::uint8_t>(flags)},
      {"gap", longest_step(times)},
      {"length", length},
      {"unit", twin.known_mass ? "N" : "N/kg"},
      {"hidden", std::any_of(forces.begin(), forces.end(), [](const force::Estimate& e) { return e.low != e.high; })}};
  if (most) {
    const ForceSize size = size_of(*most);
    out["largest"] = {{"time", most->time},
                      {"value", size.value},
                      {"error", size.error},
                      {"least", size.least},
                      {"most", size.most},
                      {"arclength", most->contact.arclength},
                      {"arclength_error", most->arclength_sigma}};
  }
  return out;
}

Json cameras_json(const Contents& contents) {
  Json out = Json::array();
  for (std::size_t c = 0; c < contents.cameras.size(); ++c) {
    const capture::Camera& camera = contents.cameras[c];
    out.push_back({{"name", camera.name},
                   {"width", camera.width},
                   {"height", camera.height},
                   {"fx", camera.fx},
                   {"fy", camera.fy},
                   {"cx", camera.cx},
                   {"cy", camera.cy},
                   {"pose", pose_json(camera.world_from_camera)},
                   {"distorted", camera.distorted()},
                   {"times", binary<double>(contents.times[c])}});
  }
  return out;
}

Json videos_json(const Contents& contents) {
  Json out = Json::array();
  for (const Video& video : contents.videos) {
    Json frames = Json::array();
    for (const std::string& jpeg : video.jpegs) frames.push_back(base64(jpeg));
    out.push_back({{"camera", video.camera}, {"times", binary<double>(video.times)}, {"frames", frames}});
  }
  return out;
}

void add_identification(const Contents& contents, Json& out) {
  const twin::Twin& twin = contents.twin;
  if (!twin.parameters) return;
  out["identified"] = Json::array();
  for (const Quantity& q : identified(twin))
    out["identified"].push_back({{"name", q.name},
                                 {"value", q.value},
                                 {"error", q.error ? Json(*q.error) : Json()},
                                 {"unit", q.unit},
                                 {"note", q.note}});
  Json held = Json::array(), weak = Json::array();
  for (const auto& [name, reason] : twin.estimates.held) held.push_back({{"name", name}, {"reason", reason}});
  for (const auto& each : twin.estimates.weak) {
    Json parts = Json::array();
    for (const auto& [name, component] : each.parts) parts.push_back(name);
    weak.push_back(parts);
  }
  out["estimates"] = {{"names", twin.estimates.names},
                      {"values", twin.estimates.values},
                      {"errors", twin.estimates.standard_errors},
                      {"held", held}};
  out["weak"] = weak;
}

Json document(const Contents& contents) {
  const twin::Twin& twin = contents.twin;
  Json out{{"name", twin.provenance.capture},
           {"version", twin.provenance.version},
           {"seed", twin.provenance.seed},
           {"device", twin.provenance.device},
           {"scenario", twin.tabletop ? "on a table" : "in free space"},
           {"gravity", list(twin.gravity)},
           {"known_mass", twin.known_mass},
           {"model",
            {{"near", image_model::kNear},
             {"lowPass", image_model::kLowPass},
             {"leastFootprint", image_model::kLeastFootprint},
             {"clampMargin", image_model::kClampMargin},
             {"leastAlpha", image_model::kLeastAlpha},
             {"leastBrightness", image_model::kLeastBrightness},
             {"mostAlpha", image_model::kMostAlpha}}},
           {"chain", chain_json(twin.chain)},
           {"motions", motions_json(contents)},
           {"cameras", cameras_json(contents)},
           {"videos", videos_json(contents)},
           {"seconds", twin.provenance.seconds}};
  if (twin.tabletop)
    out["table"] = {{"point", list(twin.table_point.value_or(Vector3::Zero()))},
                    {"normal", list(twin.table_normal.value_or(Vector3::UnitZ()))}};
  if (contents.followed && !contents.followed->forces.empty())
    out["forces"] = forces_json(twin, contents.followed->forces);
  if (twin.gaussians.count > 0) out["splats"] = splats_json(twin.gaussians);
  if (!twin.corrections.empty()) {
    out["corrections"] = twin::to_json(twin.corrections);
    out["verdict"] = twin::to_json(twin.verdict);
    out["trusted"] = twin.trusted();
  }
  add_identification(contents, out);
  return out;
}

}  // namespace

std::string page(const Contents& contents) {
  constexpr std::string_view kPlace = "@DATA@", kWhole = kPage;
  CHAINSPLAT_CHECK(!contents.twin.states.time.empty(), contents.twin.provenance.capture);
  CHAINSPLAT_CHECK(!contents.followed || contents.followed->forces.empty() || contents.twin.parameters,
                   "forces of a twin without dynamics");
  const std::size_t place = kWhole.find(kPlace);
  CHAINSPLAT_CHECK(place != std::string_view::npos, "the page has no place for data");
  std::string out(kWhole.substr(0, place));
  // a name with "</script>" in it would end the data
  for (const char letter : core::json_text(document(contents), -1))
    if (letter == '<')
      out += "\\u003c";
    else
      out += letter;
  return out.append(kWhole.substr(place + kPlace.size()));
}

}  // namespace chainsplat::report
