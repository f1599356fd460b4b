#include <algorithm>
#include <cstdio>
#include <iterator>
#include <nlohmann/json.hpp>

#include "chainsplat/solve.h"
#include "chainsplat/solve_json.h"

namespace chainsplat::solve {
namespace {

constexpr struct {
  Reason reason;
  const char *name, *text;
} kReasons[] = {
    {Reason::goal, "goal", "good enough"},
    {Reason::gradient, "gradient", "converged by its gradient"},
    {Reason::step, "step", "converged by its step"},
    {Reason::cost, "cost", "converged by its cost"},
    {Reason::no_decrease, "no_decrease", "no step lowers the cost"},
    {Reason::last_iteration, "last_iteration", "stopped at its last iteration"},
    {Reason::singular, "singular", "its equations are singular"},
    {Reason::not_finite, "not_finite", "not finite"},
    {Reason::cancelled, "cancelled", "cancelled"},
};

}  // namespace

bool converged(const Summary& summary) { return summary.reason <= Reason::cost; }

const char* name(Reason reason) { return kReasons[static_cast<int>(reason)].name; }

std::optional<Reason> reason_of(const std::string& name) {
  for (const auto& known : kReasons)
    if (name == known.name) return known.reason;
  return std::nullopt;
}

std::string describe(const Summary& summary) {
  char text[200];
  std::snprintf(text, sizeof text, "%s (%d): cost %.6g to %.6g, last step %.2g",
                kReasons[static_cast<int>(summary.reason)].text, summary.iterations, summary.initial_cost,
                summary.final_cost, summary.worst_step);
  return text;
}

void to_json(nlohmann::ordered_json& out, const Summary& summary) {
  out = {{"reason", name(summary.reason)},
         {"iterations", summary.iterations},
         {"initial_cost", summary.initial_cost},
         {"final_cost", summary.final_cost},
         {"worst_step", summary.worst_step}};
}

Summary together(std::span<const Summary> fits) {
  Summary out{.reason = Reason::goal, .initial_cost = 0.0, .final_cost = 0.0};
  for (const Summary& fit : fits) {
    out.reason = std::max(out.reason, fit.reason);
    out.iterations = std::max(out.iterations, fit.iterations);
    out.initial_cost += fit.initial_cost;
    out.final_cost += fit.final_cost;
    out.worst_step = std::max(out.worst_step, fit.worst_step);
  }
  return out;
}

}  // namespace chainsplat::solve
