// The silhouette fit against masks drawn from a known chain (surface points, no code in common with the fit) and
// against the truth of the demo capture.
#include "chainsplat/silhouette.h"
#include "chainsplat/correction_fit.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>

namespace {

using namespace chainsplat;
using chain::Bending;
using chain::Chain;
using math::MatrixX;
using math::Pose;
using math::Vector3;
using math::VectorX;

constexpr double kPi = 3.14159265358979323846;
constexpr double kLength = 0.30, kDiameter = 0.02;

Chain rope(Bending bending, bool twist = false) {
  return chain::make_chain(kLength, kDiameter, -Vector3::UnitZ(), Vector3::UnitY(), 8, bending, twist);
}

// A camera at `eye` that looks at `at`, world z up.
capture::Camera camera(const Vector3& eye, const Vector3& at) {
  capture::Camera c;
  c.name = "cam";
  c.width = 320;
  c.height = 240;
  c.fx = c.fy = 305.0;
  c.cx = 161.0;
  c.cy = 119.0;
  const Vector3 forward = (at - eye).normalized(), right = forward.cross(Vector3::UnitZ()).normalized();
  c.world_from_camera.rotation << right, forward.cross(right), forward;
  c.world_from_camera.translation = eye;
  return c;
}

std::vector<capture::Camera> three_cameras() {
  const Vector3 at(0.0, 0.0, 0.40);
  return {camera({0.05, 0.85, 0.6}, at), camera({-0.75, 0.5, 0.75}, at), camera({0.65, 0.4, 0.65}, at)};
}

Pose base_pose() {
  Pose base;
  base.rotation = math::exp_so3(Vector3(0.1, -0.15, 0.3));
  base.translation = Vector3(0.03, -0.02, 0.55);
  return base;
}

// Mask of the tube about the chain: dense surface points drawn at four times the resolution, half coverage decides.
capture::View draw(const Chain& chain, const VectorX& theta, const Pose& base, const capture::Camera& c, int index = 0,
                   int frame = 0, double time = 0.0) {
  constexpr int kFine = 4, kAround = 240, kAlong = 1200, kRings = 40;
  const int w = c.width * kFine, h = c.height * kFine;
  std::vector<std::uint8_t> fine(static_cast<std::size_t>(w) * h, 0);
  const std::vector<Pose> motions = chain::link_motions(chain, theta, base);
  const Vector3 a = chain.bending_axis, b = chain.direction.cross(a);
  const Pose camera_from_world = c.world_from_camera.inverse();
  std::vector<Vector3> normals;
  for (int i = 0; i < kAround; ++i) {
    const double angle = 2 * kPi * i / kAround;
    normals.push_back(std::cos(angle) * a + std::sin(angle) * b);
  }
  int top = h, bottom = 0;  // rows that the rope is in
  const auto plot = [&](double s, double radius) {
    const Pose motion = camera_from_world * motions[chain::link_at(chain, s)];
    const Vector3 center = s * chain.direction;
    for (const Vector3& normal : normals) {
      const Vector3 x = motion * (center + radius * normal);
      const int u = static_cast<int>(kFine * (c.fx * x.x() / x.z() + c.cx));
      const int v = static_cast<int>(kFine * (c.fy * x.y() / x.z() + c.cy));
      if (u < 0 || v < 0 || u >= w || v >= h) continue;
      fine[static_cast<std::size_t>(v) * w + u] = 1;
      top = std::min(top, v), bottom = std::max(bottom, v + 1);
    }
  };
  const double last = std::nextafter(chain.length, 0.0);
  for (int i = 0; i <= kAlong; ++i) plot(last * i / kAlong, 0.5 * chain.diameter);
  for (int i = 0; i <= kRings; ++i) plot(last, 0.5 * chain.diameter * i / kRings);
  // fill between surface points: a row's inside is what lies between hits less than a tube's width apart
  for (int y = top; y < bottom; ++y) {
    int before = -1;
    for (int x = 0; x < w; ++x) {
      std::uint8_t& pixel = fine[static_cast<std::size_t>(y) * w + x];
      if (pixel == 0) continue;
      if (before >= 0 && x - before < 4) std::fill(&pixel - (x - before), &pixel, std::uint8_t{1});
      before = x;
    }
  }
  capture::View view;
  view.camera = index;
  view.frame = frame;
  view.time = time;
  view.width = c.width;
  view.height = c.height;
  view.rgba.assign(4 * static_cast<std::size_t>(c.width) * c.height, 0);
  for (int y = top / kFine; y * kFine < bottom; ++y) {
    for (int x = 0; x < c.width; ++x) {
      int sum = 0;
      for (int dy = 0; dy < kFine; ++dy)
        for (int dx = 0; dx < kFine; ++dx) sum += fine[static_cast<std::size_t>(y * kFine + dy) * w + x * kFine + dx];
      if (2 * sum >= kFine * kFine) view.rgba[4 * (static_cast<std::size_t>(y) * c.width + x) + 3] = 255;
    }
  }
  return view;
}

void paint_disk(capture::View& view, double x0, double y0, double radius, std::uint8_t value) {
  for (int y = 0; y < view.height; ++y)
    for (int x = 0; x < view.width; ++x)
      if (std::hypot(x - x0, y - y0) < radius) view.rgba[4 * (y * view.width + x) + 3] = value;
}

// A smooth bend of both kinds.
VectorX bent(const Chain& chain, double in_plane, double out_of_plane = 0.0) {
  VectorX theta = VectorX::Zero(chain.angles());
  const int turns = chain.angles() / (chain.links() - 1);
  for (int j = 0; j < chain.links() - 1; ++j) {
    theta[turns * j] = in_plane * (0.12 + 0.1 * std::sin(0.8 * j));
    if (turns > 1) theta[turns * j + 1] = out_of_plane * (0.1 + 0.08 * std::cos(0.6 * j));
  }
  return theta;
}

double rms(const MatrixX& a, const MatrixX& b) { return std::sqrt((a - b).squaredNorm() / a.cols()); }

MatrixX points(const Chain& chain, const VectorX& theta, const Pose& base) {
  return chain::centerline(chain, chain::link_motions(chain, theta, base), chain::equal_arclengths(chain, 97));
}

struct Scene {
  std::vector<capture::Camera> cameras = three_cameras();
  std::vector<capture::View> views;
  Pose base = base_pose();
  Scene(const Chain& chain, const VectorX& theta) {
    for (int i = 0; i < 3; ++i) views.push_back(draw(chain, theta, base, cameras[i], i));
  }
  silhouette::FrameFit fit(const Chain& chain, const VectorX& start, bool warm, std::vector<int> which = {0, 1, 2},
                           const silhouette::Options& options = {}) const {
    std::vector<const capture::View*> seen;
    for (const int i : which) seen.push_back(&views[i]);
    return silhouette::fit_frame(chain, base, seen, cameras, start, warm, options);
  }
};

// Frames of a chain swinging with `theta_at`, base at rest, as a loaded capture.
template <typename Function>
capture::Capture film(const Chain& chain, int frames, const Function& theta_at,
                      const std::vector<trajectory::Sample>& base = {{0.0, base_pose()}}) {
  capture::Capture c;
  c.name = "film";
  c.length = chain.length;
  c.diameter = chain.diameter;
  c.direction = chain.direction;
  c.bending_axis = chain.bending_axis;
  c.cameras = three_cameras();
  c.base = trajectory::fit(base, "film");
  for (int i = 0; i < 3; ++i) {
    c.cameras[i].name += std::to_string(i);
    c.times.emplace_back();
    for (int f = 0; f < frames; ++f) {
      const double time = f / 30.0;
      c.times[i].push_back(time);
      c.views.push_back(capture::packed(draw(chain, theta_at(time), c.base.pose(time), c.cameras[i], i, f, time)));
    }
  }
  return c;
}

}  // namespace

TEST_CASE("a bent rope is found from the straight one") {
  for (const Bending bending : {Bending::planar, Bending::spatial}) {
    const Chain chain = rope(bending);
    for (const double size : {1.0, -1.0, 2.5}) {
      CAPTURE(size);
      const VectorX theta = bent(chain, size, 0.8);
      const Scene scene(chain, theta);
      const silhouette::FrameFit fit = scene.fit(chain, VectorX::Zero(chain.angles()), false);
      CHECK(rms(points(chain, fit.theta, scene.base), points(chain, theta, scene.base)) < 0.3e-3);
      CHECK(fit.covered > 0.99);
      CHECK(fit.inside > 0.99);
      CHECK(fit.residual_pixels < 0.4);
      CHECK(std::abs(fit.edge_offset) < 0.3);
      // three deviations hold for every angle
      for (int k = 0; k < chain.angles(); ++k)
        CHECK(std::abs(fit.theta[k] - theta[k]) < 3.0 * std::sqrt(fit.covariance(k, k)));
    }
  }
}

TEST_CASE("a warm start follows a fast rope") {
  const Chain chain = rope(Bending::spatial);
  const VectorX theta = bent(chain, 1.5, 0.6);
  const Scene scene(chain, theta);
  VectorX before = bent(chain, 1.0, 0.9);
  before[0] += 0.15;  // the free end is some 8 cm away
  REQUIRE(rms(points(chain, before, scene.base), points(chain, theta, scene.base)) > 0.03);
  const silhouette::FrameFit fit = scene.fit(chain, before, true);
  CHECK(rms(points(chain, fit.theta, scene.base), points(chain, theta, scene.base)) < 0.3e-3);
}

TEST_CASE("one camera: a planar rope is known, a spatial one only as far as its covariance says") {
  const Chain planar = rope(Bending::planar);
  const VectorX flat = bent(planar, 1.2);
  const Scene flat_scene(planar, flat);
  for (const int view : {0, 1, 2}) {
    const silhouette::FrameFit fit = flat_scene.fit(planar, VectorX::Zero(planar.angles()), false, {view});
    CHECK(rms(points(planar, fit.theta, flat_scene.base), points(planar, flat, flat_scene.base)) < 1.5e-3);
  }
  const Chain spatial = rope(Bending::spatial);
  const VectorX theta = bent(spatial, 0.8, 0.5);
  const Scene scene(spatial, theta);
  VectorX near = theta;
  near.array() += 0.02;
  const silhouette::FrameFit one = scene.fit(spatial, near, true, {0});
  const silhouette::FrameFit all = scene.fit(spatial, near, true);
  CHECK(one.covariance.trace() > 5.0 * all.covariance.trace());
  for (int k = 0; k < spatial.angles(); ++k)
    CHECK(std::abs(one.theta[k] - theta[k]) < 3.0 * std::sqrt(one.covariance(k, k)));
  // what is known beforehand decides where the view does not
  silhouette::Options options;
  options.prior.mean = theta;
  options.prior.information = MatrixX::Identity(spatial.angles(), spatial.angles()) * 1e4;
  const silhouette::FrameFit guided = scene.fit(spatial, near, true, {0}, options);
  CHECK(rms(points(spatial, guided.theta, scene.base), points(spatial, theta, scene.base)) < 1e-3);
  CHECK(guided.covariance.trace() < one.covariance.trace());
}

TEST_CASE("empty masks, false blobs, occluders and wide masks") {
  const Chain chain = rope(Bending::spatial);
  const VectorX theta = bent(chain, 1.0, 0.7), zero = VectorX::Zero(chain.angles());
  const Scene clean(chain, theta);
  const MatrixX truth = points(chain, theta, clean.base);
  const auto error = [&](const Scene& scene, bool warm) {
    return rms(points(chain, scene.fit(chain, warm ? theta : zero, warm).theta, scene.base), truth);
  };
  for (const bool warm : {false, true}) {
    CAPTURE(warm);
    Scene empty = clean;
    std::fill(empty.views[1].rgba.begin(), empty.views[1].rgba.end(), std::uint8_t{0});
    CHECK(error(empty, warm) < 0.5e-3);
    Scene blobs = clean;
    paint_disk(blobs.views[0], 25, 25, 14, 255);
    paint_disk(blobs.views[2], 290, 200, 18, 255);
    CHECK(error(blobs, warm) < 0.5e-3);
    Scene hidden = clean;  // a finger across the rope, a different place in each view
    const auto hide = [&](int view, double s) {
      const capture::Camera& c = hidden.cameras[view];
      const Vector3 x = c.world_from_camera.inverse() * Vector3(truth.col(static_cast<int>(96 * s)));
      paint_disk(hidden.views[view], c.fx * x.x() / x.z() + c.cx, c.fy * x.y() / x.z() + c.cy, 8, 0);
    };
    hide(0, 0.5);
    hide(1, 0.35);
    CHECK(error(hidden, warm) < 0.6e-3);
    Scene wide = clean;  // one pixel wider all around
    for (std::size_t v = 0; v < wide.views.size(); ++v)
      for (int y = 1; y + 1 < 240; ++y)
        for (int x = 1; x + 1 < 320; ++x)
          for (const int step : {-320, -1, 1, 320})
            if (clean.views[v].rgba[4 * (y * 320 + x + step) + 3]) wide.views[v].rgba[4 * (y * 320 + x) + 3] = 255;
    CHECK(error(wide, warm) < 0.5e-3);
    const double offset = wide.fit(chain, theta, true).edge_offset;
    CHECK(offset > 0.6);
    CHECK(offset < 1.5);
  }
  Scene nothing = clean;
  for (capture::View& view : nothing.views) std::fill(view.rgba.begin(), view.rgba.end(), std::uint8_t{0});
  const silhouette::FrameFit blind = nothing.fit(chain, theta, true);
  CHECK(blind.theta.allFinite());
  CHECK(blind.covered == 0.0);
}

TEST_CASE("masks that are known to be wider in one camera than in another fit the rope as right ones do") {
  const Chain chain = rope(Bending::planar);
  const VectorX theta = bent(chain, 1.0);
  Scene scene(chain, theta);
  const silhouette::FrameFit right = scene.fit(chain, theta, true);
  for (int c = 0; c < 3; ++c) {
    const double wider = c == 0 ? 1.0 : -1.0;  // px on each side
    const double distance = (scene.cameras[c].world_from_camera.translation - scene.base.translation).norm();
    Chain drawn = chain;
    drawn.diameter += 2.0 * wider * distance / scene.cameras[c].fx;
    scene.views[c] = draw(drawn, theta, scene.base, scene.cameras[c], c);
  }
  const silhouette::FrameFit unknown = scene.fit(chain, theta, true);
  for (int c = 0; c < 3; ++c) scene.cameras[c].mask_offset = c == 0 ? 1.0 : -1.0;
  const silhouette::FrameFit known = scene.fit(chain, theta, true);
  CHECK(known.residual_pixels < 1.2 * right.residual_pixels);
  CHECK(std::abs(known.edge_offset - right.edge_offset) < 0.1);
  CHECK(unknown.residual_pixels > 2.0 * right.residual_pixels);
  CHECK(rms(points(chain, known.theta, scene.base), points(chain, theta, scene.base)) < 0.5e-3);
}

TEST_CASE("a mask that is shifted in the image is told from a rope that is elsewhere, by the grasp") {
  const Chain chain = rope(Bending::planar);
  const int n = chain.angles();
  const VectorX theta = bent(chain, 1.0), zero = VectorX::Zero(n);
  const Scene scene(chain, theta);
  const MatrixX truth = points(chain, theta, scene.base);
  constexpr double kDeviation = 0.5;  // px, of the shift a priori
  for (const math::Vector2& shift : {math::Vector2(0.0, 0.0), math::Vector2(0.6, 0.8)}) {
    CAPTURE(shift.x());
    Scene shifted = scene;
    // a camera whose optical axis is elsewhere draws the rope elsewhere
    shifted.cameras[0].cx += shift.x();
    shifted.cameras[0].cy += shift.y();
    shifted.views[0] = draw(chain, theta, scene.base, shifted.cameras[0], 0, 0, 0.0);
    shifted.cameras[0] = scene.cameras[0];
    silhouette::Options in_place, free;
    in_place.prior.mean = zero;
    in_place.prior.information = MatrixX::Identity(n, n);
    free.prior.mean = VectorX::Zero(n + 2);
    free.prior.information = MatrixX::Identity(n + 2, n + 2);
    free.prior.information.bottomRightCorner(2, 2) /= kDeviation * kDeviation;
    const silhouette::FrameFit held = shifted.fit(chain, theta, true, {0}, in_place);
    const silhouette::FrameFit found = shifted.fit(chain, theta, true, {0}, free);
    CHECK(held.mask_shift.size() == 0);
    REQUIRE(found.mask_shift.size() == 2);
    REQUIRE(found.covariance.rows() == n + 2);
    for (const int axis : {0, 1}) {
      const double deviation = std::sqrt(found.covariance(n + axis, n + axis));
      CHECK(std::abs(found.mask_shift[axis] - shift[axis]) < 3.0 * deviation);
      CHECK(deviation < kDeviation);
    }
    const double error = rms(points(chain, found.theta, scene.base), truth);
    if (shift.norm() > 0.0) CHECK(error < 0.7 * rms(points(chain, held.theta, scene.base), truth));
  }
}

TEST_CASE("twist is held") {
  const Chain chain = rope(Bending::spatial, true);
  VectorX theta = VectorX::Zero(chain.angles());
  for (int j = 0; j < 8; ++j) theta[3 * j] = 0.15, theta[3 * j + 1] = 0.05;
  const Scene scene(chain, theta);
  const silhouette::FrameFit fit = scene.fit(chain, VectorX::Zero(chain.angles()), false);
  for (int j = 0; j < 8; ++j) {
    CHECK(fit.theta[3 * j + 2] == 0.0);
    CHECK(fit.covariance(3 * j + 2, 3 * j + 2) > 0.01);
  }
  CHECK(rms(points(chain, fit.theta, scene.base), points(chain, theta, scene.base)) < 0.4e-3);
}

TEST_CASE("a sequence: velocity, frames without masks, bending") {
  const Chain planar = rope(Bending::planar), spatial = rope(Bending::spatial);
  constexpr int kFrames = 14;
  constexpr double kRate = 2.5;  // rad/s
  const auto swing = [&](double t) -> VectorX { return bent(planar, 1.2 * std::sin(kRate * t) + 0.2); };
  const auto swing_rate = [&](double t) -> VectorX {
    return 1.2 * kRate * std::cos(kRate * t) * (bent(planar, 1.0) - bent(planar, 0.0));
  };
  capture::Capture flat = film(planar, kFrames, swing);
  for (capture::PackedView& view : flat.views)
    if (view.frame == 6) std::fill(view.rgba.begin(), view.rgba.end(), std::uint8_t{0});
  int warnings = 0;
  core::Listener listener;
  listener.warning = [&](const std::string&) { ++warnings; };
  core::set_listener(listener);
  const silhouette::SequenceFit fit = silhouette::fit_sequence(planar, flat);
  core::set_listener({});
  CHECK(warnings == 1);
  REQUIRE(fit.states.theta.size() == kFrames);
  REQUIRE(fit.states.thetadot.size() == kFrames);
  for (int f = 0; f < kFrames; ++f) {
    CAPTURE(f);
    const double t = f / 30.0;
    CHECK(rms(points(planar, fit.states.theta[f], base_pose()), points(planar, swing(t), base_pose())) < 0.6e-3);
    CHECK((fit.states.thetadot[f] - swing_rate(t)).norm() < 0.35 * swing_rate(0).norm());
  }

  const silhouette::SequenceFit loose = silhouette::fit_sequence(spatial, flat);
  const silhouette::BendingChoice choice = silhouette::choose_bending(spatial, flat, loose);
  CHECK(choice.bending == Bending::planar);
  CHECK(choice.out_of_plane_rms < 1e-3);

  const capture::Capture full = film(spatial, 4, [&](double t) { return bent(spatial, 1.0 + t, 0.4); });
  const silhouette::BendingChoice other =
      silhouette::choose_bending(spatial, full, silhouette::fit_sequence(spatial, full));
  CHECK(other.bending == Bending::spatial);
  CHECK(other.out_of_plane_rms > 5.0 * other.deviation);

  for (capture::PackedView& view : flat.views) std::fill(view.rgba.begin(), view.rgba.end(), std::uint8_t{0});
  CHECK_THROWS_AS(silhouette::fit_sequence(planar, flat), InputError);
}

// Paints over what these cameras see within `radius` px of a point of the world.
void hide(capture::Capture& capture, const Vector3& point, double radius, const std::vector<int>& cameras) {
  for (capture::PackedView& packed : capture.views) {
    if (std::find(cameras.begin(), cameras.end(), packed.camera) == cameras.end()) continue;
    capture::View view = capture::unpacked(packed);
    const capture::Camera& c = capture.cameras[view.camera];
    const Vector3 x = c.world_from_camera.inverse() * point;
    paint_disk(view, c.fx * x.x() / x.z() + c.cx, c.fy * x.y() / x.z() + c.cy, radius, 0);
    packed = capture::packed(view);
  }
}

TEST_CASE("a rope does not leave the frames beside it for one that shows another thing") {
  const Chain planar = rope(Bending::planar);
  constexpr int kFrames = 20, kOther = 11;
  const auto swing = [&](double t) -> VectorX { return bent(planar, 0.8 * std::sin(2.0 * t) + 0.2); };
  capture::Capture other = film(planar, kFrames, swing);
  for (capture::PackedView& packed : other.views)
    if (packed.frame == kOther)
      packed = capture::packed(draw(planar, bent(planar, -1.8), base_pose(), other.cameras[packed.camera],
                                    packed.camera, packed.frame, packed.time));
  std::string warning;
  core::Listener listener;
  listener.warning = [&](const std::string& text) { warning += text; };
  core::set_listener(listener);
  const silhouette::SequenceFit fit = silhouette::fit_sequence(planar, other);
  core::set_listener({});
  CHECK(warning.find("1 of 20 frames show no rope near") != std::string::npos);
  for (int f = 0; f < kFrames; ++f) {
    CAPTURE(f);
    CHECK(rms(points(planar, fit.states.theta[f], base_pose()), points(planar, swing(f / 30.0), base_pose())) < 1e-3);
  }
}

TEST_CASE("a rope whose end goes behind the gripper is not turned back on itself in front of it") {
  const Chain planar = rope(Bending::planar);
  constexpr int kFrames = 40;
  constexpr double kGripper = 20.0;            // px, radius of what hides
  constexpr double kLeast = 1.2, kMost = 4.8;  // rad, whole bend: an arc that closes to nearly a ring
  const auto curl = [&](double t) -> VectorX {
    const double share = 0.5 - 0.5 * std::cos(2.0 * kPi * 30.0 * t / (kFrames - 1));
    return VectorX::Constant(planar.angles(), (kLeast + (kMost - kLeast) * share) / planar.angles());
  };
  capture::Capture film_of_curl = film(planar, kFrames, curl);
  const VectorX most = curl(0.5 * (kFrames - 1) / 30.0);
  const Vector3 behind = chain::link_motions(planar, most, base_pose()).back() * (kLength * planar.direction);
  hide(film_of_curl, behind, kGripper, {1, 2});  // camera 0 is the only one that sees all of the rope
  const silhouette::SequenceFit fit = silhouette::fit_sequence(planar, film_of_curl);
  for (int f = 0; f < kFrames; ++f) {
    CAPTURE(f);
    CHECK(rms(points(planar, fit.states.theta[f], base_pose()), points(planar, curl(f / 30.0), base_pose())) < 3e-3);
  }
}

TEST_CASE("a rope in a loop whose beginning is hidden is not laid the other way round where other things are seen") {
  const Chain planar = rope(Bending::planar);
  constexpr int kFrames = 40, kFirst = 17, kLast = 22;  // frames, and those that show other things
  constexpr double kGripper = 18.0, kBlob = 5.0;        // px, radii of what hides, and of what is taken for rope
  constexpr double kLeast = 1.2, kMost = 5.7;           // rad, whole bend
  const auto curl = [&](double t) -> VectorX {
    const double share = 0.5 - 0.5 * std::cos(2.0 * kPi * 30.0 * t / (kFrames - 1));
    return VectorX::Constant(planar.angles(), (kLeast + (kMost - kLeast) * share) / planar.angles());
  };
  capture::Capture loop = film(planar, kFrames, curl);
  for (capture::PackedView& packed : loop.views) {
    if (packed.frame < kFirst || packed.frame > kLast) continue;
    capture::View view = capture::unpacked(packed);
    const capture::Camera& c = loop.cameras[view.camera];
    const Vector3 x = c.world_from_camera.inverse() * (base_pose() * (0.03 * planar.direction));
    paint_disk(view, c.fx * x.x() / x.z() + c.cx, c.fy * x.y() / x.z() + c.cy, kGripper, 0);
    for (const double y : {0.1, 0.9}) paint_disk(view, 0.1 * view.width, y * view.height, kBlob, 255);
    packed = capture::packed(view);
  }
  const silhouette::SequenceFit fit = silhouette::fit_sequence(planar, loop);
  for (int f = 0; f < kFrames; ++f) {
    CAPTURE(f);
    CHECK(rms(points(planar, fit.states.theta[f], base_pose()), points(planar, curl(f / 30.0), base_pose())) < 3e-3);
  }
}

// Corrections are fitted to whole recordings: of the suite "whole".
TEST_CASE("what no camera sees of a rope goes on as it did, and makes the rope neither shorter nor longer" *
          doctest::test_suite("whole")) {
  constexpr int kJoints = 16;  // eight bend in corners here
  const Chain planar =
      chain::make_chain(kLength, kDiameter, -Vector3::UnitZ(), Vector3::UnitY(), kJoints, Bending::planar, false);
  constexpr int kFrames = 60;
  constexpr double kGripper = 18.0;            // px, radius of what hides
  constexpr double kLeast = 1.2, kMost = 6.6;  // rad, whole bend: its end passes by the gripper
  const auto curl = [&](double t) -> VectorX {
    const double share = std::min(1.0, 1.1 - 1.1 * std::cos(2.0 * kPi * 30.0 * t / (kFrames - 1)));
    VectorX along = VectorX::LinSpaced(planar.angles(), 1.0, 0.0);  // no moment bends the free end
    along[0] *= 0.5;                                                // the joint at the clamp stands for half a link
    return (kLeast + (kMost - kLeast) * share) / along.sum() * along;
  };
  capture::Capture hidden = film(planar, kFrames, curl);
  hide(hidden, base_pose() * (0.03 * planar.direction), kGripper, {0, 1, 2});
  const silhouette::SequenceFit fit = silhouette::fit_sequence(planar, hidden);
  double most_hidden = 0.0;
  for (int f = 0; f < kFrames; ++f) {
    CAPTURE(f);
    most_hidden = std::max(most_hidden, 1.0 - fit.frames[f].inside);
    CHECK(rms(points(planar, fit.states.theta[f], base_pose()), points(planar, curl(f / 30.0), base_pose())) < 2e-3);
  }
  CHECK(most_hidden > 0.3);
  const silhouette::CorrectionFit corrected = silhouette::fit_corrections(planar, hidden, fit);
  CHECK(std::abs(capture::value_of(corrected.corrections, "object", "length")) < 0.005 * kLength);
}

// A rope that friction drags behind bends most at the clamp, where straight links lie behind its arc: as if the base
// were late. Corrections are fitted to whole recordings: of the suite "whole".
TEST_CASE("a rope that bends at its clamp is not taken for a base that is late" * doctest::test_suite("whole")) {
  constexpr int kFrames = 40, kFine = 60, kJoints = 10;
  constexpr double kTravel = 0.06, kRate = 2.0 * kPi * 0.8;  // m, rad/s
  constexpr double kBent = 30.0;                             // 1/m of curvature at the clamp per m/s
  const auto chain_of = [](int joints) {
    return chain::make_chain(kLength, kDiameter, -Vector3::UnitZ(), Vector3::UnitY(), joints, Bending::planar, false);
  };
  const Chain fine = chain_of(kFine), coarse = chain_of(kJoints);
  std::vector<trajectory::Sample> base;
  for (int i = 0; i <= 4 * kFrames; ++i) {
    const double time = i / 120.0;
    base.push_back({time, base_pose()});
    base.back().pose.translation += base_pose().rotation * Vector3(kTravel * std::sin(kRate * time), 0.0, 0.0);
  }
  const auto dragged = [&](double time) {
    const double at_clamp = kBent * kTravel * kRate * std::cos(kRate * time);
    VectorX theta(kFine);
    for (int k = 0; k < kFine; ++k) {
      const double left = 1.0 - fine.joint_arclength[k] / kLength;
      theta[k] = at_clamp * left * left * chain::bent_length(fine, k + 1);
    }
    return theta;
  };
  const capture::Capture pulled = film(fine, kFrames, dragged, base);
  const silhouette::CorrectionFit found =
      silhouette::fit_corrections(coarse, pulled, silhouette::fit_sequence(coarse, pulled));
  CHECK(std::abs(capture::value_of(found.corrections, "base", "time")) < 0.8e-3);  // 1.37e-3 as chords
}

TEST_CASE("of one camera that sees a rope's end hidden, a cold start believes what is known beforehand") {
  const Chain planar = rope(Bending::planar);
  const VectorX theta = VectorX::Constant(planar.angles(), 3.6 / planar.angles());
  const Vector3 end = chain::link_motions(planar, theta, base_pose()).back() * (kLength * planar.direction);
  silhouette::Options known;
  known.prior.mean = VectorX::Constant(planar.angles(), 3.4 / planar.angles());
  known.prior.information = MatrixX::Identity(planar.angles(), planar.angles()) / (0.1 * 0.1);
  const MatrixX truth = points(planar, theta, base_pose());
  for (int view = 0; view < 3; ++view)
    for (const double gripper : {25.0, 30.0, 35.0, 40.0}) {  // px, radius of what hides
      CAPTURE(view);
      CAPTURE(gripper);
      Scene scene(planar, theta);
      const capture::Camera& c = scene.cameras[view];
      const Vector3 x = c.world_from_camera.inverse() * end;
      paint_disk(scene.views[view], c.fx * x.x() / x.z() + c.cx, c.fy * x.y() / x.z() + c.cy, gripper, 0);
      const silhouette::FrameFit fit = scene.fit(planar, known.prior.mean, false, {view}, known);
      CHECK(rms(points(planar, fit.theta, base_pose()), truth) < 8e-3);
    }
}

TEST_CASE("a rope has as many joints as its bends ask for and its masks can tell") {
  constexpr int kJoints = 12;
  constexpr double kBend = 0.2;  // rad at every joint
  for (const Bending bending : {Bending::planar, Bending::spatial}) {
    const Chain fine = chain::make_chain(kLength, kDiameter, -Vector3::UnitZ(), Vector3::UnitY(), kJoints, bending,
                                         bending == Bending::spatial);
    silhouette::SequenceFit fit;
    for (int f = 0; f < 4; ++f) {
      fit.states.time.push_back(f / 30.0);
      VectorX theta = VectorX::Zero(fine.angles());
      for (int i = 0; i < fine.angles(); ++i) theta[i] = chain::is_twist(fine, i) ? 1.0 : 0.0;  // which bends nothing
      const int axes = fine.angles() / kJoints;
      for (int j = 0; j < kJoints; ++j) theta[j * axes + (axes > 1 && j % 2 ? 1 : 0)] = kBend;
      fit.states.theta.push_back(theta);
      silhouette::FrameFit frame;
      frame.residual_pixels = 0.5;
      frame.covariance = math::MatrixX::Identity(fine.angles(), fine.angles());
      fit.frames.push_back(frame);
    }
    // neighboring joints of a rope whose curvature changes steadily differ by the square of a link's length
    CHECK(chain::neighbor_difference(fine, 0.3) == doctest::Approx(0.3 * std::pow(8.0 / kJoints, 2)));
    // a circle's arc and the line that fits it best, by numbers
    constexpr int kSamples = 20001;
    double mean = 0.0, square = 0.0;
    for (int i = 0; i < kSamples; ++i) {
      const double height = kLength / kJoints / kBend * std::cos(kBend * (i / (kSamples - 1.0) - 0.5));
      mean += height / kSamples;
      square += height * height / kSamples;
    }
    silhouette::JointChoice choice = silhouette::choose_joints(fine, fit);
    CHECK(choice.bow == doctest::Approx(std::sqrt(square - mean * mean)).epsilon(0.01));
    CHECK(choice.joints == 8);  // angles that are open to a radian
    // the deviation shrinks with the angles'; the bow of n joints is that of 12 times (12 / n)^2
    const double unit = choice.deviation;
    const auto joints_at = [&](double deviation) {
      for (silhouette::FrameFit& frame : fit.frames)
        frame.covariance = math::MatrixX::Identity(fine.angles(), fine.angles()) * std::pow(deviation / unit, 2);
      return silhouette::choose_joints(fine, fit).joints;
    };
    CHECK(joints_at(2.26 * choice.bow) == 8);
    CHECK(joints_at(2.24 * choice.bow) == 12);
    CHECK(joints_at(1.01 * choice.bow) == 12);
    CHECK(joints_at(0.99 * choice.bow) == 16);
    CHECK(joints_at(0.1 * choice.bow) == 24);  // 16 would leave 0.105 mm
    const auto bend_by = [&](double ratio) {
      for (VectorX& theta : fit.states.theta)
        for (int i = 0; i < fine.angles(); ++i)
          if (!chain::is_twist(fine, i)) theta[i] *= ratio;
    };
    bend_by(0.9);  // 0.095 mm
    CHECK(joints_at(0.1 * choice.bow) == 16);
    bend_by(1.0 / 0.9);
    // twice the frames that say nothing change nothing; four times as many that do halve what is open
    const double before = silhouette::choose_joints(fine, fit).deviation;
    for (int f = 0; f < 4; ++f) {
      fit.states.theta.push_back(VectorX::Zero(fine.angles()));
      fit.frames.emplace_back();
    }
    CHECK(silhouette::choose_joints(fine, fit).deviation == before);
    for (int f = 0; f < 12; ++f) {
      fit.states.theta.push_back(fit.states.theta[0]);
      fit.frames.push_back(fit.frames[0]);
    }
    CHECK(silhouette::choose_joints(fine, fit).deviation == doctest::Approx(0.5 * before));
  }
}

TEST_CASE("of one camera a planar fit must be clearly worse before a rope is spatial") {
  // a planar rope that is given 6 % too long, which depth alone would explain
  const Chain planar = rope(Bending::planar), spatial = rope(Bending::spatial);
  const Chain given =
      chain::make_chain(1.06 * kLength, kDiameter, -Vector3::UnitZ(), Vector3::UnitY(), 8, Bending::spatial, false);
  capture::Capture still = film(planar, 2, [&](double) { return bent(planar, 0.9); });
  std::erase_if(still.views, [](const capture::PackedView& view) { return view.camera != 0; });
  silhouette::SequenceFit fit = silhouette::fit_sequence(given, still);
  for (silhouette::FrameFit& frame : fit.frames) frame.covariance *= 0.01;  // as sure as no real outline allows
  const silhouette::BendingChoice choice = silhouette::choose_bending(given, still, fit);
  CHECK(choice.out_of_plane_rms > 3.0 * choice.deviation);  // which alone would make it spatial
  CHECK(choice.out_of_plane_rms > 1e-3);
  CHECK(choice.bending == Bending::planar);
  // a rope that leaves its plane sideways in the picture is spatial, whatever the number of cameras
  capture::Capture out = film(spatial, 2, [&](double) { return bent(spatial, 0.2, 1.2); });
  std::erase_if(out.views, [](const capture::PackedView& view) { return view.camera != 1; });
  CHECK(silhouette::choose_bending(spatial, out, silhouette::fit_sequence(spatial, out)).bending == Bending::spatial);
}

TEST_CASE(
    "of one camera a carried rope is believed to leave its plane, and a still, however often it is shown, is not") {
  const Chain planar = rope(Bending::planar), spatial = rope(Bending::spatial);
  const auto choice = [&](const Chain& chain, double out_of_plane, double way) {
    constexpr int kFrames = 24;
    const VectorX theta = bent(chain, 0.3, out_of_plane);
    capture::Capture one = film(chain, 1, [&](double) { return theta; });
    one.views.clear();
    std::vector<trajectory::Sample> samples;
    for (int f = 0; f < kFrames; ++f) {
      Pose base = base_pose();
      base.translation.x() -= way * f / (kFrames - 1);
      samples.push_back({f / 30.0, base});
      one.views.push_back(capture::packed(draw(chain, theta, base, one.cameras[0], 0, f, f / 30.0)));
      if (f > 0) one.times[0].push_back(f / 30.0);
    }
    one.base = trajectory::fit(samples, "film");
    return silhouette::choose_bending(spatial, one, silhouette::fit_sequence(spatial, one)).bending;
  };
  CHECK(choice(spatial, 1.2, 0.12) == Bending::spatial);
  CHECK(choice(spatial, 1.2, 0.0) == Bending::planar);
  CHECK(choice(planar, 0.0, 0.12) == Bending::planar);
}

TEST_CASE("the demo capture is recognized to a fraction of a millimeter, whatever the number of threads") {
  const Path folder = Path(CHAINSPLAT_SOURCE_DIR) / "assets/demo_free_30";
  const capture::Capture demo = capture::load(folder);
  const auto truth = capture::load_true_centerline(folder);
  REQUIRE(truth);
  const auto error = [&](const Chain& chain, const chain::States& states) {
    double square = 0;
    for (std::size_t f = 0; f < states.time.size(); ++f) {
      REQUIRE(std::abs(truth->time[f] - states.time[f]) < 1e-3);
      const MatrixX& given = truth->points[f];
      MatrixX expected(3, 97);
      for (int i = 0; i < 97; ++i) {
        const double at = i / 96.0 * (given.cols() - 1);
        const int k = std::min(static_cast<int>(at), static_cast<int>(given.cols()) - 2);
        expected.col(i) = given.col(k) + (at - k) * (given.col(k + 1) - given.col(k));
      }
      square += std::pow(rms(points(chain, states.theta[f], demo.base.pose(states.time[f])), expected), 2);
    }
    return std::sqrt(square / states.time.size());
  };
  const auto chain_of = [&](Bending bending) {
    return chain::make_chain(demo.length, demo.diameter, demo.direction, demo.bending_axis, 8, bending, false);
  };
  // floors of eight joints: 0.26 mm (first joint at the grasp; design.md, 'The simulated captures') spatial, 3.27 mm
  // planar
  const Chain spatial = chain_of(Bending::spatial), planar = chain_of(Bending::planar);
  const int threads = core::threads();
  core::set_threads(1);
  const silhouette::SequenceFit fit = silhouette::fit_sequence(spatial, demo);
  core::set_threads(3);
  const silhouette::SequenceFit again = silhouette::fit_sequence(spatial, demo);
  core::set_threads(threads);
  REQUIRE(fit.states.theta.size() == 60);
  for (std::size_t f = 0; f < 60; ++f) CHECK(fit.states.theta[f] == again.states.theta[f]);
  CHECK(error(spatial, fit.states) < 0.3e-3);
  CHECK(fit.summary.final_cost == doctest::Approx(fit.summary.initial_cost).epsilon(0.05));  // coarse was near
  CHECK(fit.summary.worst_step < 1e-2);  // rad; a frame has a few fine steps, so some stop at their last
  const silhouette::BendingChoice choice = silhouette::choose_bending(spatial, demo, fit);
  CHECK(choice.bending == Bending::spatial);
  CHECK(choice.out_of_plane_rms == doctest::Approx(3.3e-3).epsilon(0.1));
  CHECK(error(planar, silhouette::fit_sequence(planar, demo).states) < 3.5e-3);
}

TEST_CASE("how far a rope lies beside the plane of its grasp is found from outlines of several cameras") {
  const Chain flat = rope(Bending::planar);
  const auto theta_at = [&](double time) { return VectorX(std::sin(4.0 * time) * bent(flat, 1.0)); };
  for (const double height : {0.0, -0.0012, 0.003}) {  // m; a pixel is 2 mm
    CAPTURE(height);
    Chain lying = flat;
    lying.lift = silhouette::lying_down(flat, height);
    const capture::Capture recording = film(lying, 12, theta_at);
    const silhouette::SequenceFit fit = silhouette::fit_sequence(flat, recording);
    const double found = silhouette::fit_height(flat, recording, fit, 0.0);
    CHECK(std::abs(found - height) < 0.0003);
    Chain as_found = flat;
    as_found.lift = silhouette::lying_down(flat, found);
    const silhouette::SequenceFit again = silhouette::fit_sequence(as_found, recording);
    double square = 0.0, square_flat = 0.0;
    for (std::size_t f = 0; f < again.states.theta.size(); ++f) {
      const MatrixX truth = points(lying, theta_at(again.states.time[f]), base_pose());
      square += std::pow(rms(points(as_found, again.states.theta[f], base_pose()), truth), 2) / 12.0;
      square_flat += std::pow(rms(points(flat, fit.states.theta[f], base_pose()), truth), 2) / 12.0;
    }
    if (height != 0.0) CHECK(std::sqrt(square) < 0.5 * std::sqrt(square_flat));
  }
  // the rope leaves its grasp level and lies level
  const std::vector<double> lift =
      silhouette::lying_down(chain::make_chain(0.3, 0.02, {1, 0, 0}, {0, 0, 1}, 60, Bending::planar, false), -0.001);
  CHECK(lift[0] == 0.0);
  CHECK(std::abs(lift[1]) < 2e-5);
  CHECK(lift.back() == -0.001);
  CHECK(std::is_sorted(lift.rbegin(), lift.rend()));
  CHECK(silhouette::lying_down(flat, 0.0).empty());

  // what the capture's table says, and nothing where that cannot be
  capture::Capture given = film(flat, 2, theta_at);
  CHECK(silhouette::height_by_table(given) == 0.0);
  given.tabletop = true;
  const math::Vector3 normal = base_pose().rotation * flat.bending_axis;
  const auto below_the_grasp = [&](double depth) {
    given.table = capture::Table{base_pose().translation - depth * normal, normal};
    return silhouette::height_by_table(given);
  };
  CHECK(below_the_grasp(0.025) == doctest::Approx(0.5 * flat.diameter - 0.025));
  CHECK(below_the_grasp(2.0) == 0.0);
  CHECK(below_the_grasp(-0.1) == 0.0);
}
