// The plan as a drawing: a side view in free space, the view from above on a table.
#include <algorithm>
#include <cmath>
#include <cstdio>

#include "base_motion.h"

namespace chainsplat::planning {
namespace {

constexpr double kWidth = 800.0, kBorder = 40.0;  // px
constexpr int kRopes = 9;                         // drawn at equal times
constexpr int kPathSteps = 200;

struct View {
  int right = 0, up = 0;  // world axes on the paper
  double scale = 1.0, left = 0.0, top = 0.0;
  double x(const Vector3& p) const { return kBorder + scale * (p[right] - left); }
  double y(const Vector3& p) const { return kBorder + scale * (top - p[up]); }
};

std::string text(const char* format, auto... values) {
  char out[256];
  std::snprintf(out, sizeof out, format, values...);
  return out;
}

std::string polyline(const View& view, const std::vector<Vector3>& points, const char* style) {
  std::string out = "<polyline fill=\"none\" " + std::string(style) + " points=\"";
  for (const Vector3& p : points) out += text("%.1f,%.1f ", view.x(p), view.y(p));
  return out + "\"/>\n";
}

}  // namespace

std::string picture_svg(const Problem& problem, const Options& options, const Plan& plan) {
  const chain::Chain& chain = problem.model.chain;
  const double end = plan.motion.end();
  std::vector<double> times;
  for (int k = 0; k <= kPathSteps; ++k) times.push_back(end * k / kPathSteps);
  const chain::States states = predict(problem, plan.motion, times);
  std::vector<Vector3> base, tip;
  std::vector<std::vector<Vector3>> ropes;
  const auto rope_at = [&](double time) {
    std::vector<Vector3> points;
    const MatrixX nodes = chain::nodes(
        chain, chain::link_motions(chain, chain::interpolate(states, time), base_at(plan.motion, time).pose));
    for (Eigen::Index i = 0; i < nodes.cols(); ++i) points.emplace_back(nodes.col(i));
    return points;
  };
  for (double time : times) {
    base.push_back(base_at(plan.motion, time).pose.translation);
    tip.push_back(rope_at(time).back());
  }
  for (int k = 0; k < kRopes; ++k) ropes.push_back(rope_at(end * k / (kRopes - 1)));

  View view{0, problem.tabletop ? 1 : 2};
  Vector3 low = base.front(), high = base.front();
  const auto include = [&](const Vector3& p) { low = low.cwiseMin(p), high = high.cwiseMax(p); };
  for (const auto* path : {&base, &tip})
    for (const Vector3& p : *path) include(p);
  for (const auto& rope : ropes)
    for (const Vector3& p : rope) include(p);
  for (const Vector3& p : problem.targets) include(p);
  // in free space the side that shows more of the motion
  if (!problem.tabletop && high.y() - low.y() > high.x() - low.x()) view.right = 1;
  view.left = low[view.right], view.top = high[view.up];
  view.scale = kWidth / std::max(high[view.right] - low[view.right], 0.1);
  const double width = kWidth + 2 * kBorder, height = view.scale * (high[view.up] - low[view.up]) + 2 * kBorder + 30;

  std::string out = text(
      "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 %.0f %.0f\" width=\"%.0f\" height=\"%.0f\" "
      "font-family=\"sans-serif\" font-size=\"14\">\n<rect width=\"100%%\" height=\"100%%\" fill=\"white\"/>\n",
      width, height, width, height);
  for (const Sphere& s : options.spheres)
    out += text("<circle cx=\"%.1f\" cy=\"%.1f\" r=\"%.1f\" fill=\"#d9534f\" fill-opacity=\"0.3\"/>\n",
                view.x(s.center), view.y(s.center), view.scale * s.radius);
  for (const Box& b : options.boxes)
    out += text("<rect x=\"%.1f\" y=\"%.1f\" width=\"%.1f\" height=\"%.1f\" fill=\"#d9534f\" fill-opacity=\"0.3\"/>\n",
                view.x(b.low), view.y(b.high), view.scale * (b.high - b.low)[view.right],
                view.scale * (b.high - b.low)[view.up]);
  out += polyline(view, base, "stroke=\"#888888\" stroke-width=\"2\"");
  out += polyline(view, tip, "stroke=\"#88aadd\" stroke-width=\"1\" stroke-dasharray=\"4 3\"");
  for (std::size_t k = 0; k < ropes.size(); ++k) {
    const int light = 200 - static_cast<int>(160 * k / (ropes.size() - 1));  // later is darker
    out += polyline(view, ropes[k], text("stroke=\"rgb(%d,%d,230)\" stroke-width=\"3\"", light, light).c_str());
  }
  for (const Hit& hit : plan.hits) out += polyline(view, rope_at(hit.time), "stroke=\"#e08020\" stroke-width=\"3\"");
  for (const Vector3& p : problem.targets)
    out += text("<circle cx=\"%.1f\" cy=\"%.1f\" r=\"7\" fill=\"none\" stroke=\"#208040\" stroke-width=\"3\"/>\n",
                view.x(p), view.y(p));
  out +=
      text("<text x=\"%.0f\" y=\"%.0f\">miss %.2f mm, %.2f s; %c right, %c up; orange: at the hit; bar: 0.1 m</text>\n",
           kBorder, height - 12, plan.hits.empty() ? 0.0 : 1e3 * plan.hits.front().miss, end, "xyz"[view.right],
           "xyz"[view.up]);
  out += text("<line x1=\"%.1f\" y1=\"%.1f\" x2=\"%.1f\" y2=\"%.1f\" stroke=\"black\" stroke-width=\"2\"/>\n", kBorder,
              height - 34, kBorder + 0.1 * view.scale, height - 34);
  return out + "</svg>\n";
}

}  // namespace chainsplat::planning
