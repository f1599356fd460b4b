#include "src/silhouette/observations.h"

#include <algorithm>
#include <cmath>

namespace chainsplat::silhouette {

using math::MatrixX;
using math::Pose;
using math::Vector3;
using math::VectorX;

namespace {

// the two stages
constexpr int kReverseSamples = 4;            // centerline samples a link that must lie in the mask
constexpr double kReverseWeight = 0.5;        // of all of them together, against all mask pixels of the view
constexpr double kAligned = 0.7;              // least cosine between outline and tube normals
constexpr double kLeastArm = 1.0;             // px, from a joint, to tell a direction from it
constexpr double kLinkOffsetDeviation = 0.2;  // px, of a link's outline in one view about the common offset
constexpr double kEndReach = 2.0;             // half widths from the free end within which an outline may be the end's

// blobs
constexpr double kGap = 3.0;  // diameters, that an occluder may hide between two blobs of the rope
constexpr double kLeastArea = 0.05, kLargestArea = 2.0;  // of the straight rope's area: what can be the rope alone

struct Nearest {  // place on the projected centerline nearest to a pixel
  int segment = -1;
  double t = 0.0;  // along the segment in the image, 0 to 1
  double distance2 = 1e300;
};

Vector2 image_of(const capture::Camera& camera, const Vector3& x) {
  return {camera.fx * x.x() / x.z() + camera.cx, camera.fy * x.y() / x.z() + camera.cy};
}

// d(m . u)/dx of a camera-frame point.
Vector3 projected_gradient(const capture::Camera& camera, const Vector3& x, const Vector2& m) {
  const double gx = camera.fx * m.x() / x.z(), gy = camera.fy * m.y() / x.z();
  return {gx, gy, -(gx * x.x() + gy * x.y()) / x.z()};
}

Nearest nearest(const std::vector<Segment>& segments, const Vector2& pixel) {
  Nearest best;
  for (int i = 0; i < static_cast<int>(segments.size()); ++i) {
    const Segment& s = segments[i];
    const Vector2 offset = pixel - s.from;
    const double t = std::clamp(offset.dot(s.step) * s.per_length2, 0.0, 1.0);
    const double distance2 = (offset - t * s.step).squaredNorm();
    if (distance2 < best.distance2) best = {i, t, distance2};
  }
  return best;
}

// Camera-frame point of image position t along a segment.
Vector3 point_at(const Segment& s, double t) {
  const double from = t * s.a.z(), to = (1.0 - t) * s.b.z();
  return s.a + from / (from + to) * (s.b - s.a);
}

// `outward`: of an outline, whose place depends on the edge offset and the mask's shift; zero: of something else.
void add(LinkSums& sums, int link, const Vector3& x, const Vector3& g, const Vector2& outward, double residual,
         double weight) {
  Vector9 row;
  row << x.cross(g), g, outward.squaredNorm(), outward;
  sums.normal[link].noalias() += (weight * row) * row.transpose();
  sums.right[link] += (weight * residual) * row;
}

double huber_weight(double residual, double cut) { return residual <= cut ? 1.0 : cut / residual; }

double tukey_weight(double residual, double cut) {
  const double u = residual / cut;
  return std::abs(u) >= 1.0 ? 0.0 : (1.0 - u * u) * (1.0 - u * u);
}

bool past_end(const ViewWork& work, const Nearest& at) {
  return at.segment + 1 == static_cast<int>(work.segments.size()) && at.t >= 1.0;
}

bool near(const MaskPoints& mask, const Blob& a, const Blob& b, double gap) {
  for (int i = a.first_pixel; i < a.last_pixel; ++i)
    for (int j = b.first_pixel; j < b.last_pixel; ++j)
      if ((mask.pixels[i] - mask.pixels[j]).squaredNorm() <= gap * gap) return true;
  return false;
}

// The blobs that hold the rope when nothing else is known: of those that could be a rope, the one nearest to the grasp,
// and those that follow within an occluder's width.
void choose_anchor(ViewWork& work, double straight_area) {
  const MaskPoints& mask = *work.view->mask;
  const int count = static_cast<int>(mask.blobs.size());
  const Vector2 grasp = work.segments.empty() ? Vector2(0, 0) : work.segments[0].from;
  std::vector<char> possible(count, 0);
  int first = 0;
  double best_distance2 = 1e300;
  for (int b = 0; b < count; ++b) {
    const Blob& blob = mask.blobs[b];
    possible[b] = blob.area >= kLeastArea * straight_area && blob.area <= kLargestArea * straight_area;
    if (!possible[b]) continue;
    for (int i = blob.first_pixel; i < blob.last_pixel; ++i) {
      const double distance2 = (mask.pixels[i] - grasp).squaredNorm();
      if (distance2 < best_distance2) {
        best_distance2 = distance2;
        first = b;
      }
    }
  }
  std::vector<int> queue{first};
  work.active[first] = 1;
  for (std::size_t done = 0; done < queue.size(); ++done) {
    for (int b = 0; b < count; ++b) {
      if (work.active[b] || !possible[b] || !near(mask, mask.blobs[queue[done]], mask.blobs[b], kGap * work.diameter))
        continue;
      work.active[b] = 1;
      queue.push_back(b);
    }
  }
}

void clear(LinkSums& sums) {
  std::fill(sums.normal.begin(), sums.normal.end(), Matrix9::Zero());
  std::fill(sums.right.begin(), sums.right.end(), Vector9::Zero());
}

// Nearest sampled pixel of the active blobs.
Vector2 nearest_pixel(const ViewWork& work, const Vector2& to) {
  const MaskPoints& mask = *work.view->mask;
  Vector2 best = to;
  double best_distance2 = 1e300;
  for (std::size_t b = 0; b < mask.blobs.size(); ++b) {
    if (!work.active[b]) continue;
    for (int i = mask.blobs[b].first_pixel; i < mask.blobs[b].last_pixel; ++i) {
      const double distance2 = (mask.pixels[i] - to).squaredNorm();
      if (distance2 < best_distance2) {
        best_distance2 = distance2;
        best = mask.pixels[i];
      }
    }
  }
  return best;
}

// Calls body(segment, image t, pixel) for the centerline samples that should be seen: in the image.
template <typename Body>
void for_each_sample(const ViewWork& work, const Body& body) {
  const capture::Camera& camera = *work.view->camera;
  for (const Segment& s : work.segments) {
    for (int i = 0; i < kReverseSamples; ++i) {
      const double t = (i + 1.0) / kReverseSamples;
      const Vector2 pixel = s.from + t * s.step;
      if (pixel.x() < 0 || pixel.y() < 0 || pixel.x() >= camera.width || pixel.y() >= camera.height) continue;
      body(s, t, pixel);
    }
  }
}

bool in_mask(const ViewWork& work, const Vector2& pixel) {
  const int blob = work.view->mask->blob_at(pixel);
  return blob >= 0 && work.active[blob];
}

void add_coarse(ViewWork& work, double cut) {
  const capture::Camera& camera = *work.view->camera;
  const MaskPoints& mask = *work.view->mask;
  int count = 0;
  for (std::size_t b = 0; b < mask.blobs.size(); ++b) {
    if (!work.active[b]) continue;
    count += mask.blobs[b].last_pixel - mask.blobs[b].first_pixel;
    for (int i = mask.blobs[b].first_pixel; i < mask.blobs[b].last_pixel; ++i) {
      const Nearest at = nearest(work.segments, mask.pixels[i]);
      if (at.segment < 0) return;
      const Segment& s = work.segments[at.segment];
      const Vector2 offset = mask.pixels[i] - (s.from + at.t * s.step);
      const Vector3 x = point_at(s, at.t);
      const double weight = huber_weight(std::sqrt(at.distance2), cut);
      add(work.sums, s.link, x, projected_gradient(camera, x, s.normal), Vector2::Zero(), s.normal.dot(offset), weight);
      if (past_end(work, at))
        add(work.sums, s.link, x, projected_gradient(camera, x, s.tangent), Vector2::Zero(), s.tangent.dot(offset),
            weight);
    }
  }
  if (count == 0) return;
  const double share = kReverseWeight * count / (kReverseSamples * static_cast<double>(work.segments.size()));
  for_each_sample(work, [&](const Segment& s, double t, const Vector2& pixel) {
    if (in_mask(work, pixel)) return;
    const Vector2 offset = nearest_pixel(work, pixel) - pixel;
    const double size = offset.norm();
    const double weight = share * huber_weight(size, cut);
    const Vector3 x = point_at(s, t);
    for (const Vector2& m : {s.normal, s.tangent})
      add(work.sums, s.link, x, projected_gradient(camera, x, m), Vector2::Zero(), m.dot(offset), weight);
  });
}

void add_fine(Problem& problem, ViewWork& work, double offset, double cut, FineSums& total) {
  const capture::Camera& camera = *work.view->camera;
  const MaskPoints& mask = *work.view->mask;
  const double radius = 0.5 * problem.chain->diameter;
  if (work.segments.empty()) return;
  const Segment& last = work.segments.back();
  const bool has_end = last.link + 1 == problem.chain->links();
  const Vector2 end = last.from + last.step;
  const double end_radius = radius * projected_gradient(camera, last.b, last.normal).norm();
  // the end is a flat disk, seen as an ellipse: this is its half axis along the rope
  const double end_depth = end_radius * std::abs((last.b - last.a).normalized().dot(last.b.normalized()));
  constexpr double kWorst = kLargestCut * kLargestCut;
  const auto observe = [&](const Segment& s, const Vector3& x, const Vector3& g, const Vector2& outward,
                           double distance, double length) {
    const double residual = distance - offset - outward.dot(work.shift);
    const double weight = length * tukey_weight(residual, cut);
    problem.sizes.push_back(std::abs(residual));
    total.capped_square += length * (std::min(residual * residual, kWorst) - kWorst);
    if (weight == 0.0) return;
    add(work.sums, s.link, x, g, outward, residual, weight);
    total.weighted_square += weight * residual * residual;
    total.weight += weight;
  };
  for (std::size_t b = 0; b < mask.blobs.size(); ++b) {
    if (!work.active[b]) continue;
    for (int i = mask.blobs[b].first_edge; i < mask.blobs[b].last_edge; ++i) {
      const Edge& edge = mask.edges[i];
      total.length += edge.weight;
      total.capped_square += edge.weight * kWorst;
      const Vector2 from_end = edge.point - end;
      if (has_end && from_end.norm() < kEndReach * end_radius && edge.outward.dot(last.tangent) > kAligned) {
        const double side = last.normal.dot(from_end) / end_radius;
        const double bulge = end_depth * std::sqrt(std::max(0.0, 1.0 - side * side));
        observe(last, last.b, projected_gradient(camera, last.b, last.tangent), last.tangent,
                last.tangent.dot(from_end) - bulge, edge.weight);
        continue;
      }
      const Nearest at = nearest(work.segments, edge.point);
      if (past_end(work, at)) continue;
      const Segment& s = work.segments[at.segment];
      const Vector2 from_center = edge.point - (s.from + at.t * s.step);
      // the side of the tube is the one the outline faces; about a bend's outer corner the tube is round
      Vector2 m = s.normal.dot(edge.outward) < 0 ? Vector2(-s.normal) : s.normal;
      const double distance = std::sqrt(at.distance2);
      if ((at.t <= 0.0 || at.t >= 1.0) && distance > kLeastArm && from_center.dot(edge.outward) > 0.0)
        m = from_center / distance;
      if (m.dot(edge.outward) < kAligned) continue;  // an occluder's outline, or a corner
      const Vector3 x = point_at(s, at.t);
      Vector3 g = projected_gradient(camera, x, m);
      const double half_width = radius * g.norm();
      g.z() -= half_width / x.z();  // farther is thinner
      observe(s, x, g, m, m.dot(from_center) - half_width, edge.weight);
    }
  }
}

// Masks are not equally much wider than the rope everywhere: each link has an unknown offset of its own in each view,
// about the common one, eliminated here. Otherwise one camera would take small errors of the width for depth.
void eliminate_link_offsets(LinkSums& sums) {
  constexpr double kPrior = 1.0 / (kLinkOffsetDeviation * kLinkOffsetDeviation);
  for (std::size_t link = 0; link < sums.normal.size(); ++link) {
    Matrix9& normal = sums.normal[link];
    const Vector9 coupling = normal.col(6) / std::sqrt(normal(6, 6) + kPrior);
    sums.right[link] -= coupling * (sums.right[link][6] / std::sqrt(normal(6, 6) + kPrior));
    normal -= coupling * coupling.transpose();
  }
}

// Normal equations of the angles from those of the links, by suffix sums (mathematics.md 2.3).
void assemble(Problem& problem) {
  const chain::Chain& chain = *problem.chain;
  const int n = chain.angles();
  const int unknowns = problem.unknowns(), offset = unknowns - 1;
  problem.normal.setZero(unknowns, unknowns);
  problem.right.setZero(unknowns);
  MatrixX columns = MatrixX::Zero(9, n);  // of one view: the axes in camera coordinates, and 0 for offset and shift
  int shift = n;                          // of the view
  for (ViewWork& work : problem.views) {
    for (int k = 0; k < n; ++k)
      columns.col(k).head<6>() = math::transform_twist(work.camera_from_base, problem.axes.col(k));
    LinkSums& sums = work.sums;
    for (int link = chain.links() - 2; link >= 0; --link) {
      sums.normal[link] += sums.normal[link + 1];
      sums.right[link] += sums.right[link + 1];
    }
    for (int k = 0; k < n; ++k) {
      const int link = chain.child_link[k];
      const Vector9 moved = sums.normal[link] * columns.col(k);
      for (int l = 0; l <= k; ++l) problem.normal(l, k) += moved.dot(columns.col(l));
      problem.normal(k, offset) += moved[6];
      if (problem.shifts) problem.normal.block<1, 2>(k, shift) += moved.tail<2>().transpose();
      problem.right[k] += sums.right[link].dot(columns.col(k));
    }
    problem.normal(offset, offset) += sums.normal[0](6, 6);
    problem.right[offset] += sums.right[0][6];
    if (!problem.shifts) continue;
    problem.normal.block<2, 2>(shift, shift) += sums.normal[0].bottomRightCorner<2, 2>();
    problem.normal.block<2, 1>(shift, offset) += sums.normal[0].block<2, 1>(7, 6);
    problem.right.segment<2>(shift) += sums.right[0].tail<2>();
    shift += 2;
  }
  problem.normal.triangularView<Eigen::StrictlyLower>() = problem.normal.transpose();
}

}  // namespace

void pose(Problem& problem, const VectorX& theta) {
  const chain::Chain& chain = *problem.chain;
  const std::vector<Pose> motions = chain::link_motions(chain, theta, Pose{});
  const MatrixX nodes = chain::nodes(chain, motions);
  problem.axes = chain::world_axes(chain, theta, Pose{});
  for (ViewWork& work : problem.views) {
    const capture::Camera& camera = *work.view->camera;
    work.segments.clear();
    for (int link = 0; link < chain.links(); ++link) {
      Segment s;
      s.link = link;
      s.a = work.camera_from_base * Vector3(nodes.col(link));
      s.b = work.camera_from_base * Vector3(nodes.col(link + 1));
      if (!(chain.link_end(link) > chain.link_start(link)) || s.a.z() < kNear || s.b.z() < kNear) continue;
      s.from = image_of(camera, s.a);
      s.step = image_of(camera, s.b) - s.from;
      const double length2 = std::max(s.step.squaredNorm(), 1e-12);
      s.per_length2 = 1.0 / length2;
      s.tangent = s.step / std::sqrt(length2);
      s.normal = Vector2(-s.tangent.y(), s.tangent.x());
      work.segments.push_back(s);
    }
  }
}

void choose_blobs(Problem& problem, double reach) {
  for (ViewWork& work : problem.views) {
    const MaskPoints& mask = *work.view->mask;
    work.active.assign(mask.blobs.size(), 0);
    bool any = false;
    for (std::size_t b = 0; b < mask.blobs.size(); ++b) {
      const Blob& blob = mask.blobs[b];
      problem.sizes.clear();
      for (int i = blob.first_pixel; i < blob.last_pixel; ++i)
        problem.sizes.push_back(nearest(work.segments, mask.pixels[i]).distance2);
      if (problem.sizes.empty()) continue;
      const auto middle = problem.sizes.begin() + problem.sizes.size() / 2;
      std::nth_element(problem.sizes.begin(), middle, problem.sizes.end());
      const double limit = reach * work.diameter;
      work.active[b] = *middle <= limit * limit;
      any = any || work.active[b];
    }
    if (any || mask.blobs.empty()) continue;
    const double pixels_per_meter = work.diameter / problem.chain->diameter;
    choose_anchor(work, problem.chain->length * pixels_per_meter * work.diameter);
  }
}

void coarse_equations(Problem& problem, double cut) {
  for (ViewWork& work : problem.views) {
    clear(work.sums);
    add_coarse(work, cut);
  }
  assemble(problem);
}

FineSums fine_equations(Problem& problem, double offset, double cut) {
  problem.sizes.clear();
  FineSums total;
  for (ViewWork& work : problem.views) {
    clear(work.sums);
    add_fine(problem, work, offset, cut, total);
    eliminate_link_offsets(work.sums);
  }
  assemble(problem);
  return total;
}

void judge(const Problem& problem, FrameSolution& out) {
  constexpr double kMargin = 2.0;  // px, of `covered`
  constexpr double kCap = 3.0;     // diameters
  const double radius = 0.5 * problem.chain->diameter;
  double pixels = 0, covered = 0, samples = 0, inside = 0, cost = 0;
  int seen = 0;
  out.mask_pixels = 0;
  for (const ViewWork& work : problem.views) {
    const MaskPoints& mask = *work.view->mask;
    out.mask_pixels += mask.area;
    if (mask.pixels.empty() || work.segments.empty()) continue;
    ++seen;
    const double cap = kCap * work.diameter;
    double view_cost = 0;
    const double area = static_cast<double>(mask.area) / mask.pixels.size();  // px a sample stands for
    for (std::size_t b = 0; b < mask.blobs.size(); ++b) {
      for (int i = mask.blobs[b].first_pixel; i < mask.blobs[b].last_pixel; ++i) {
        const Nearest at = nearest(work.segments, mask.pixels[i]);
        const Segment& s = work.segments[at.segment];
        const Vector3 x = point_at(s, at.t);
        const double half_width = radius * projected_gradient(*work.view->camera, x, s.normal).norm();
        const double away = std::sqrt(at.distance2) - half_width;
        pixels += area;
        if (away <= kMargin) covered += area;
        const double size = std::clamp(away, 0.0, cap);
        view_cost += size * size / mask.pixels.size();
      }
    }
    double reverse = 0;
    int count = 0;
    for_each_sample(work, [&](const Segment&, double, const Vector2& pixel) {
      ++samples;
      ++count;
      if (mask.blob_at(pixel) >= 0) {
        ++inside;
        return;
      }
      const double size = std::min(cap, (nearest_pixel(work, pixel) - pixel).norm());
      reverse += size * size;
    });
    cost += view_cost + (count > 0 ? reverse / count : cap * cap);
  }
  out.fit.covered = pixels > 0 ? covered / pixels : 0.0;
  out.fit.inside = samples > 0 ? inside / samples : 0.0;
  out.cost = seen > 0 ? cost / seen : 0.0;
}

}  // namespace chainsplat::silhouette
