#include "src/silhouette/observations.h"

#include <algorithm>
#include <cmath>

#include "src/silhouette/outline.h"

namespace chainsplat::silhouette {

using math::MatrixX;
using math::Pose;
using math::Vector3;
using math::VectorX;

namespace {

// the two stages
constexpr int kReverseSamples = 4;      // centerline samples per link that must lie in the mask
constexpr double kReverseWeight = 0.5;  // of all of them together, against all mask pixels of the view

// blobs
constexpr double kGap = 3.0;  // diameters, that an occluder may hide between two blobs of the rope
constexpr double kLeastArea = 0.05, kLargestArea = 2.0;  // of the straight rope's area: what can be the rope alone

// `outward`: of an outline, whose place depends on the edge offset and the mask's shift; zero: of something else.
void add(LinkSums& sums, int link, const Vector3& x, const Vector3& g, const Vector2& outward, double residual,
         double weight) {
  Vector9 row;
  row << x.cross(g), g, outward.squaredNorm(), outward;
  sums.normal[link].noalias() += (weight * row) * row.transpose();
  sums.right[link] += (weight * residual) * row;
}

double huber_weight(double residual, double cut) { return residual <= cut ? 1.0 : cut / residual; }

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
  // where it is known what is hidden, the rest of the mask is not where that should be
  if (count == 0 || !work.hidden.empty()) return;
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
  constexpr double kWorst = kLargestCut * kLargestCut;
  offset += work.view->camera->mask_offset;
  const auto each = [&](const Edge& edge) {
    total.length += edge.weight;
    total.capped_square += edge.weight * kWorst;
  };
  for_each_outline_point(*problem.chain, work, each, [&](const OutlinePoint& p) {
    const double residual = p.distance - offset - p.outward.dot(work.shift);
    const double weight = p.length * tukey_weight(residual, cut);
    problem.sizes.push_back(std::abs(residual));
    total.capped_square += p.length * (std::min(residual * residual, kWorst) - kWorst);
    if (weight == 0.0) return;
    add(work.sums, p.segment->link, p.x, p.gradient, p.outward, residual, weight);
    total.weighted_square += weight * residual * residual;
    total.weight += weight;
  });
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

void place(Segment& s, const capture::Camera& camera, const Vector3& a, const Vector3& b) {
  s.a = a;
  s.b = b;
  s.from = image_of(camera, a);
  s.step = image_of(camera, b) - s.from;
  const double length2 = std::max(s.step.squaredNorm(), 1e-12);
  s.per_length2 = 1.0 / length2;
  s.tangent = s.step / std::sqrt(length2);
  s.normal = Vector2(-s.tangent.y(), s.tangent.x());
}

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
      const Vector3 a = work.camera_from_base * Vector3(nodes.col(link));
      const Vector3 b = work.camera_from_base * Vector3(nodes.col(link + 1));
      if (!(chain.link_end(link) > chain.link_start(link)) || a.z() < kNear || b.z() < kNear) continue;
      place(s, camera, a, b);
      s.hidden = !work.hidden.empty() && work.hidden[link];
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
      const double limit = reach * work.diameter;
      work.active[b] = math::median(problem.sizes) <= limit * limit;
      any = any || work.active[b];
    }
    if (any || mask.blobs.empty()) continue;
    const double pixels_per_meter = work.diameter / problem.chain->diameter;
    choose_anchor(work, problem.chain->length * pixels_per_meter * work.diameter);
  }
}

namespace {

// Share of the active blobs' pixels that lie within `distance` px of the projected chain.
double covered_share(const ViewWork& work, double distance) {
  const MaskPoints& mask = *work.view->mask;
  int near = 0, all = 0;
  for (std::size_t b = 0; b < mask.blobs.size(); ++b) {
    if (!work.active[b]) continue;
    for (int i = mask.blobs[b].first_pixel; i < mask.blobs[b].last_pixel; ++i, ++all)
      near += nearest(work.segments, mask.pixels[i]).distance2 <= distance * distance;
  }
  return all > 0 ? static_cast<double>(near) / all : 0.0;
}

// Whether a mask lies on a segment or within `distance` px on either side, as far as no link apart from it explains it.
bool shows(const ViewWork& work, const Segment& s, double distance) {
  constexpr double kMostAlong = 400.0;  // places: a link that comes near the camera's plane is endless in the image
  const double spacing = std::max(1.0, 0.25 * work.diameter);  // px, finer than what is left of a rope's mask
  const int across = static_cast<int>(std::ceil(distance / spacing));
  const int along = static_cast<int>(std::clamp(std::ceil(s.step.norm() / spacing), 1.0, kMostAlong));
  const double half_width2 = 0.25 * work.diameter * work.diameter;
  const auto explained = [&](const Vector2& pixel) {
    const double nearer = std::min(half_width2, nearest_on(s, pixel).distance2);
    return std::any_of(work.segments.begin(), work.segments.end(), [&](const Segment& other) {
      return std::abs(other.link - s.link) > 1 && nearest_on(other, pixel).distance2 < nearer;
    });
  };
  for (int i = 0; i <= along; ++i)
    for (int j = -across; j <= across; ++j) {
      const Vector2 pixel = s.from + static_cast<double>(i) / along * s.step + j * distance / across * s.normal;
      if (in_mask(work, pixel) && !explained(pixel)) return true;
    }
  return false;
}

}  // namespace

void find_hidden(Problem& problem, double reach, double least) {
  constexpr double kNearlyAll = 0.97;  // share of a mask's pixels
  for (ViewWork& work : problem.views) {
    work.hidden.clear();
    for (Segment& s : work.segments) s.hidden = false;
    const double distance = std::max(reach * work.diameter, least);
    if (covered_share(work, distance) < kNearlyAll) continue;
    work.hidden.assign(problem.chain->links(), 0);
    for (Segment& s : work.segments) work.hidden[s.link] = s.hidden = !shows(work, s, distance);
    if (std::any_of(work.segments.begin(), work.segments.end(), [](const Segment& s) { return !s.hidden; })) continue;
    work.hidden.clear();  // what is in the mask is beyond the chain's ends
    for (Segment& s : work.segments) s.hidden = false;
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
  double pixels = 0, covered = 0, foreign = 0, samples = 0, inside = 0, cost = 0;
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
    for (const Blob& blob : mask.blobs) {
      double here = 0;
      for (int i = blob.first_pixel; i < blob.last_pixel; ++i) {
        const Nearest at = nearest(work.segments, mask.pixels[i]);
        const Segment& s = work.segments[at.segment];
        const Vector3 x = point_at(s, at.t);
        const double half_width = radius * projected_gradient(*work.view->camera, x, s.normal).norm();
        const double away = std::sqrt(at.distance2) - half_width;
        pixels += area;
        if (away <= kMargin) here += area;
        const double size = std::clamp(away, 0.0, cap);
        view_cost += size * size / mask.pixels.size();
      }
      covered += here;
      if (here == 0) foreign += area * (blob.last_pixel - blob.first_pixel);
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
  out.fit.foreign = pixels > 0 ? foreign / pixels : 0.0;
  out.fit.inside = samples > 0 ? inside / samples : 0.0;
  out.cost = seen > 0 ? cost / seen : 0.0;
}

}  // namespace chainsplat::silhouette
