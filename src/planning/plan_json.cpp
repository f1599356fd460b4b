// plan_json.cpp - a plan as text.
#include <algorithm>
#include <nlohmann/json.hpp>

#include "chainsplat/json.h"
#include "chainsplat/motion_files.h"
#include "chainsplat/solve_json.h"

namespace chainsplat::planning {

using Json = nlohmann::ordered_json;

const Hit& worst_hit(const Plan& plan) {
  return *std::max_element(plan.hits.begin(), plan.hits.end(),
                           [](const Hit& a, const Hit& b) { return a.miss < b.miss; });
}

namespace {

Json json_of(const math::Vector3& v) { return {v.x(), v.y(), v.z()}; }

Json document_of(const Problem& problem, const Options& options, const Plan& plan, const std::string& horizon) {
  Json out;
  out["targets"] = Json::array();
  for (const math::Vector3& target : problem.targets) out["targets"].push_back(json_of(target));
  const Hit& worst = worst_hit(plan);
  out["miss"] = worst.miss;
  out["miss_time"] = worst.time;
  out["miss_point"] = json_of(worst.point);
  out["miss_arclength"] = worst.arclength;
  constexpr const char* kParts[] = {"tip", "last-link", "rope"};
  out["hit"] = kParts[static_cast<int>(options.part.value_or(problem.tabletop ? Part::rope : Part::tip))];
  out["reached"] = plan.reached;
  if (!plan.reached) out["reason"] = plan.reason;
  out["tolerance"] = options.tolerance;
  if (plan.hits.size() > 1) {
    out["hits"] = Json::array();
    for (const Hit& hit : plan.hits)
      out["hits"].push_back({{"miss", hit.miss},
                             {"miss_time", hit.time},
                             {"miss_point", json_of(hit.point)},
                             {"miss_arclength", hit.arclength}});
  }
  if (options.samples > 0) {
    out["samples"] = options.samples;
    out["expected_miss"] = worst.mean_miss;
    out["worst_miss"] = worst.worst_miss;
  }
  const bool yaw = std::find(plan.motion.axes.begin(), plan.motion.axes.end(), Axis::yaw) != plan.motion.axes.end();
  out["peak_velocity"] = plan.peaks.velocity;
  out["peak_acceleration"] = plan.peaks.acceleration;
  out["peak_jerk"] = plan.peaks.jerk;
  out["peak_stroke"] = plan.peaks.stroke;
  if (yaw) {
    out["peak_yaw_velocity"] = plan.peaks.yaw_velocity;
    out["peak_yaw_acceleration"] = plan.peaks.yaw_acceleration;
    out["peak_yaw_jerk"] = plan.peaks.yaw_jerk;
    out["peak_turn"] = plan.peaks.turn;
  }
  const Limits& l = options.limits;
  out["limits"] = {{"velocity", l.velocity}, {"acceleration", l.acceleration}, {"jerk", l.jerk}, {"stroke", l.stroke}};
  if (yaw) {
    out["limits"]["yaw_velocity"] = l.yaw_velocity;
    out["limits"]["yaw_acceleration"] = l.yaw_acceleration;
    out["limits"]["yaw_jerk"] = l.yaw_jerk;
    out["limits"]["turn"] = l.turn;
  }
  constexpr const char* kNames[] = {"x", "y", "z", "yaw"};
  out["axes"] = Json::array();
  for (Axis axis : plan.motion.axes) out["axes"].push_back(kNames[static_cast<int>(axis)]);
  out["horizon"] = horizon;
  out["window"] = options.window == Window::smooth ? "smooth" : "paper";
  // a stretch for each target: rows of weights by axis
  out["weights"] = Json::array();
  out["terminal"] = Json::array();
  out["stretches"] = Json::array();
  for (const Piece& piece : plan.motion.pieces) {
    Json weights = Json::array(), terminal = Json::array();
    for (Eigen::Index a = 0; a < piece.terminal.size(); ++a) {
      Json row = Json::array();
      for (int i = 0; i < kBasisCount; ++i) row.push_back(piece.weights(i, a));
      weights.push_back(row);
      terminal.push_back(piece.terminal[a]);
    }
    out["weights"].push_back(weights);
    out["terminal"].push_back(terminal);
    out["stretches"].push_back({{"start", piece.start}, {"duration", piece.duration}});
  }
  out["starts"] = plan.starts;
  out["iterations"] = plan.iterations;
  out["solver"] = plan.summary;
  out["seconds"] = plan.seconds;
  return out;
}

Json loop_json(const LoopResult& loop, double tolerance) {
  Json out{{"miss", loop.hit.miss},
           {"miss_time", loop.hit.time},
           {"miss_point", json_of(loop.hit.point)},
           {"peak_velocity", loop.peaks.velocity},
           {"peak_acceleration", loop.peaks.acceleration},
           {"peak_jerk", loop.peaks.jerk}};
  if (!loop.peaks.over.empty()) out["over_limit"] = loop.peaks.over;
  if (loop.out_of_reach > tolerance) out["out_of_reach"] = loop.out_of_reach;
  if (loop.replans > 0) {
    out["replans"] = loop.replans;
    out["mean_replan_seconds"] = loop.mean_replan;
    out["longest_replan_seconds"] = loop.longest_replan;
    out["foretold_miss"] = loop.foretold;
    out["solver"] = loop.summary;
  }
  return out;
}

}  // namespace

std::string plan_json(const Problem& problem, const Options& options, const Plan& plan, const std::string& horizon,
                      std::span<const Simulated> simulated) {
  Json document = document_of(problem, options, plan, horizon);
  for (const Simulated& s : simulated) document["simulated"][s.name] = loop_json(s.loop, options.tolerance);
  return core::json_text(document) + "\n";
}

}  // namespace chainsplat::planning
