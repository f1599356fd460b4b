// Tests of the filter on masks drawn from a known motion: a rope of the twin's kind with other parameters, seen by one
// camera.
#include "chainsplat/estimation.h"

#include <doctest/doctest.h>

#include <cmath>
#include <functional>
#include <nlohmann/json.hpp>

#include "chainsplat/gpu.h"
#include "reference_colors.h"
#include "src/estimation/color.h"
#include "src/estimation/predict.h"
#include "src/estimation/setup.h"
#include "src/math/decompositions.h"

namespace {

using namespace chainsplat;
using math::MatrixX;
using math::Pose;
using math::Vector2;
using math::Vector3;
using math::VectorX;

constexpr double kInterval = 1.0 / 30.0;

estimation::Belief moved_to(const estimation::State& state, const estimation::Belief& belief, double time,
                            estimation::Contact contact) {
  return estimation::predict(state, belief, estimation::move(state, belief, time), contact);
}

twin::Twin rope_twin() {
  twin::Twin twin;
  twin.chain = chain::make_chain(0.3, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), 6, chain::Bending::spatial, false);
  dynamics::Parameters p;
  for (auto* list : {&p.viscous_friction, &p.coulomb_friction, &p.air_linear, &p.air_quadratic}) list->assign(6, 0.0);
  p.link_mass.assign(6, 0.01);
  p.stiffness.assign(12, 0.012);
  p.damping.assign(12, 1e-3);
  p.rest_angle.assign(12, 0.0);
  p.radius = 0.01;
  twin.parameters = p;
  return twin;
}

// The base swings along x and the camera looks along y, so that motion out of that plane is depth.
trajectory::BaseMotion moving_base(double t) {
  const double a = 0.05, w = 3.0;
  trajectory::BaseMotion base;
  base.pose.translation = Vector3(a * (1.0 - std::cos(w * t)), 0.0, 0.55);
  base.velocity[3] = a * w * std::sin(w * t);
  base.acceleration[3] = a * w * w * std::cos(w * t);
  return base;
}

capture::Camera front_camera() {
  capture::Camera c;
  c.name = "front";
  c.width = 320;
  c.height = 240;
  c.fx = c.fy = 300.0;
  c.cx = 160.0;
  c.cy = 120.0;
  c.world_from_camera.rotation << 1, 0, 0, 0, 0, 1, 0, -1, 0;  // x right, z down, looks along +y
  c.world_from_camera.translation = Vector3(0.05, -0.7, 0.4);
  return c;
}

struct Box {
  int left, right, top, bottom;  // px, [left, right), [top, bottom)
};

// Where in the camera's image a rope about these nodes may be seen, with room to spare: nothing else need be asked.
Box box_of(const MatrixX& nodes, double radius, const capture::Camera& c) {
  Box box{c.width, 0, c.height, 0};
  const Pose camera_from_world = c.world_from_camera.inverse();
  for (int i = 0; i < nodes.cols(); ++i) {
    const Vector3 x = camera_from_world * Vector3(nodes.col(i));
    if (x.z() < 0.1) return {0, c.width, 0, c.height};
    const double u = c.fx * x.x() / x.z() + c.cx, v = c.fy * x.y() / x.z() + c.cy, room = 3.0 * radius * c.fx / x.z();
    box.left = std::min(box.left, static_cast<int>(u - room)),
    box.right = std::max(box.right, static_cast<int>(u + room));
    box.top = std::min(box.top, static_cast<int>(v - room)),
    box.bottom = std::max(box.bottom, static_cast<int>(v + room));
  }
  return {std::max(box.left, 0), std::min(box.right, c.width), std::max(box.top, 0), std::min(box.bottom, c.height)};
}

// Draws the mask of the pixels whose rays pass within the radius of the rope's axis, tried at 3 x 3 places per pixel.
capture::View draw(const chain::Chain& chain, const VectorX& theta, double time, int frame, const capture::Camera& c) {
  const MatrixX nodes = chain::nodes(chain, chain::link_motions(chain, theta, moving_base(time).pose));
  const Vector3 eye = c.world_from_camera.translation;
  const double radius = 0.5 * chain.diameter;
  const auto hit = [&](double u, double v) {
    const Vector3 ray =
        (c.world_from_camera.rotation * Vector3((u - c.cx) / c.fx, (v - c.cy) / c.fy, 1.0)).normalized();
    for (int i = 0; i + 1 < nodes.cols(); ++i) {
      const Vector3 a = nodes.col(i), d = nodes.col(i + 1) - nodes.col(i);
      if (d.norm() <= 0.0) continue;
      // distance between the ray and the axis at their nearest points
      const Vector3 across = ray.cross(d);
      const double t = across.dot(ray.cross(eye - a)) / across.squaredNorm();
      if (t < (i == 0 ? 0.0 : -0.02) || t > 1.0) continue;
      if (std::abs(across.normalized().dot(eye - a)) <= radius) return true;
    }
    return false;
  };
  capture::View view;
  view.time = time;
  view.frame = frame;
  view.width = c.width;
  view.height = c.height;
  view.rgba.assign(4 * static_cast<std::size_t>(c.width) * c.height, 0);
  const Box box = box_of(nodes, radius, c);
  for (int y = box.top; y < box.bottom; ++y)
    for (int x = box.left; x < box.right; ++x) {
      int hits = 0;
      for (int i = 0; i < 9; ++i) hits += hit(x + (i % 3 + 0.5) / 3.0, y + (i / 3 + 0.5) / 3.0);
      if (hits >= 5) view.rgba[4 * (static_cast<std::size_t>(y) * c.width + x) + 3] = 255;
    }
  return view;
}

// The true motion, from a bend out of the plane that the twin does not know.
chain::States true_motion(const twin::Twin& twin, int frames) {
  dynamics::InitialState initial;
  initial.theta = VectorX::Zero(12);
  initial.thetadot = VectorX::Zero(12);
  for (int k = 1; k < 12; k += 2) initial.theta[k] = 0.03;
  std::vector<double> times;
  for (int f = 0; f < frames; ++f) times.push_back(f * kInterval);
  dynamics::Parameters p = *twin.parameters;
  p.stiffness.assign(12, 0.010);
  p.damping.assign(12, 1.2e-3);
  return dynamics::rollout(dynamics::make_model(twin.chain, p), moving_base, initial, times);
}

double rms(const chain::Chain& chain, const VectorX& a, const VectorX& b) {
  const std::vector<double> arclengths = chain::equal_arclengths(chain, 31);
  const MatrixX p = chain::centerline(chain, chain::link_motions(chain, a, Pose{}), arclengths);
  const MatrixX q = chain::centerline(chain, chain::link_motions(chain, b, Pose{}), arclengths);
  return std::sqrt((p - q).squaredNorm() / p.cols());
}

// The standard deviation of the centerline over the same points as in rms().
double deviation(const chain::Chain& chain, const estimation::Estimate& e) {
  const std::vector<double> arclengths = chain::equal_arclengths(chain, 31);
  const MatrixX p = chain::centerline(chain, chain::link_motions(chain, e.theta, Pose{}), arclengths);
  const MatrixX axes = chain::world_axes(chain, e.theta, Pose{});
  const int n = chain.angles();
  double variance = 0.0;
  for (int i = 0; i < p.cols(); ++i) {
    const MatrixX j = chain::point_jacobian(chain, axes, chain::link_at(chain, arclengths[i]), p.col(i));
    variance += (j * e.covariance.topLeftCorner(n, n) * j.transpose()).trace() / p.cols();
  }
  return std::sqrt(variance);
}

using Views = std::span<const capture::View* const>;

std::vector<estimation::Estimate> follow(const std::function<estimation::Estimate(Views)>& update,
                                         const std::vector<capture::View>& views) {
  std::vector<estimation::Estimate> out;
  for (const capture::View& view : views) {
    const capture::View* const one[] = {&view};
    out.push_back(update(one));
  }
  return out;
}

std::vector<estimation::Estimate> follow(estimation::Filter& filter, const std::vector<capture::View>& views) {
  return follow([&](Views moment) { return filter.update(moment); }, views);
}

// The same with the filter's inside in sight.
std::vector<estimation::Estimate> follow(estimation::State& state, const std::vector<capture::View>& views) {
  return follow([&](Views moment) { return estimation::update(state, moment); }, views);
}

const twin::Twin& shared_twin() {
  static const twin::Twin twin = rope_twin();
  return twin;
}
const chain::States& shared_truth() {
  static const chain::States truth = true_motion(shared_twin(), 45);
  return truth;
}
const std::vector<capture::View>& shared_views() {
  static const std::vector<capture::View> views = [] {
    std::vector<capture::View> drawn;
    for (int f = 0; f < 45; ++f)
      drawn.push_back(draw(shared_twin().chain, shared_truth().theta[f], f * kInterval, f, front_camera()));
    return drawn;
  }();
  return views;
}

TEST_CASE("one camera and the dynamics follow a rope in space, with honest deviations") {
  const twin::Twin& twin = shared_twin();
  for (const int drop : {1, 2}) {
    CAPTURE(drop);
    estimation::Filter filter(twin, {front_camera()}, moving_base, 0.0);
    std::vector<capture::View> views;
    for (std::size_t f = 0; f < shared_views().size(); f += drop) views.push_back(shared_views()[f]);
    double square = 0.0;
    int used = 0, honest = 0;
    for (const estimation::Estimate& e : follow(filter, views)) {
      CHECK_FALSE(e.lost);
      CHECK(e.seen);
      CHECK(e.iou > 0.85);
      const double error = rms(twin.chain, e.theta, shared_truth().theta[e.frame]);
      honest += error <= 3.0 * deviation(twin.chain, e);
      CHECK(error < 8e-3);
      if (e.frame < 10) continue;
      square += error * error;
      ++used;
    }
    CHECK(std::sqrt(square / used) < 4e-3);  // 1 pixel is 2.3 mm here
    CHECK(honest >= 0.95 * static_cast<double>(views.size()));
  }
}

// The rope with rings of irregular width painted on it, drawn on the host: the color and the depth where each ray meets
// the tube.
double paint(double arclength) { return 0.5 + 0.2 * std::sin(500.0 * arclength) + 0.2 * std::sin(313.0 * arclength); }

splat::Picture painted(const chain::Chain& chain, const std::vector<Pose>& motions, const capture::View& view,
                       const capture::Camera& c) {
  const MatrixX nodes = chain::nodes(chain, motions);
  const Pose camera_from_world = c.world_from_camera.inverse();
  splat::Picture picture;
  picture.width = view.width;
  picture.height = view.height;
  picture.rgba.assign(4 * static_cast<std::size_t>(view.width) * view.height, 0.0f);
  picture.depth.assign(static_cast<std::size_t>(view.width) * view.height, 0.0f);
  const double radius = 0.5 * chain.diameter;
  std::vector<Vector3> places;
  for (int i = 0; i < nodes.cols(); ++i) places.push_back(camera_from_world * Vector3(nodes.col(i)));
  const Box box = box_of(nodes, radius, c);
  for (int y = std::max(0, box.top - view.y0); y < std::min(view.height, box.bottom - view.y0); ++y)
    for (int x = std::max(0, box.left - view.x0); x < std::min(view.width, box.right - view.x0); ++x) {
      const std::size_t k = static_cast<std::size_t>(y) * view.width + x;
      const Vector3 ray((view.x0 + x + 0.5 - c.cx) / c.fx, (view.y0 + y + 0.5 - c.cy) / c.fy, 1.0);
      for (int i = 0; i + 1 < nodes.cols(); ++i) {
        const Vector3 &a = places[i], &b = places[i + 1];
        if ((b - a).norm() <= 0.0) continue;
        const Vector3 d = (b - a).normalized();
        // solve |(z ray - a) across d| = radius for the depth z
        const Vector3 u = ray - d * d.dot(ray), v = a - d * d.dot(a);
        const double p = u.dot(v), q = u.squaredNorm(), root = p * p - q * (v.squaredNorm() - radius * radius);
        if (root < 0.0) continue;
        const double z = (p - std::sqrt(root)) / q, s = d.dot(z * ray - a);
        if (s < -0.02 * (b - a).norm() || s > (b - a).norm()) continue;
        if (picture.depth[k] > 0.0f && z > picture.depth[k]) continue;
        picture.depth[k] = static_cast<float>(z);
        for (int channel = 0; channel < 3; ++channel)
          picture.rgba[4 * k + channel] = static_cast<float>(paint(chain.link_start(i) + s));
        picture.rgba[4 * k + 3] = 1.0f;
      }
    }
  return picture;
}

// The shared views with the painted rope in them, under a changing exposure.
std::vector<capture::View> painted_views() {
  std::vector<capture::View> views = shared_views();
  for (capture::View& view : views) {
    const splat::Picture picture =
        painted(shared_twin().chain,
                chain::link_motions(shared_twin().chain, shared_truth().theta[view.frame], moving_base(view.time).pose),
                view, front_camera());
    const double gain = 1.0 + 0.2 * std::sin(0.5 * view.frame), bias = 0.05 * std::cos(0.3 * view.frame);
    for (std::size_t k = 0; k < view.rgba.size(); ++k)
      if (k % 4 != 3 && picture.rgba[k / 4 * 4 + 3] > 0.0f)
        view.rgba[k] =
            static_cast<std::uint8_t>(std::clamp(std::round(255.0 * (gain * picture.rgba[k] + bias)), 0.0, 255.0));
  }
  return views;
}

// Compares colors as a device would, with the painted rope as the twin.
std::vector<splat::ColorSums> compare_painted(std::span<const capture::View* const> views,
                                              std::span<const capture::Camera> cameras,
                                              std::span<const std::vector<Pose>> motions) {
  const capture::Camera& camera = cameras[0];
  const chain::Chain& chain = shared_twin().chain;
  std::vector<splat::ColorSums> out;
  for (std::size_t v = 0; v < views.size(); ++v) {
    const capture::View& view = *views[v];
    const splat::ViewSpec spec{&camera, view.x0, view.y0, view.width, view.height, motions[v]};
    out.push_back(reference::color_sums(chain, spec, view.rgba, painted(chain, motions[v], view, camera)));
  }
  return out;
}

TEST_CASE("marks on the rope tell its slope in depth, and the exposure is found") {
  const std::vector<capture::View> views = painted_views();
  estimation::Filter outlines(shared_twin(), {front_camera()}, moving_base, 0.0);
  estimation::Filter colors(shared_twin(), {front_camera()}, moving_base, 0.0, {}, {}, compare_painted);
  const auto a = follow(outlines, views), b = follow(colors, views);
  double without = 0.0, with = 0.0;
  int honest = 0;
  for (std::size_t f = 0; f < b.size(); ++f) {
    const double error = rms(shared_twin().chain, b[f].theta, shared_truth().theta[f]);
    honest += error <= 3.0 * b[f].centerline_sigma;
    CHECK_FALSE(b[f].lost);
    CHECK(b[f].gain == doctest::Approx(1.0 + 0.2 * std::sin(0.5 * f)).epsilon(0.05));
    CHECK(std::abs(b[f].bias - 0.05 * std::cos(0.3 * f)) < 0.03);
    if (f < 10) continue;
    with += error * error;
    without += std::pow(rms(shared_twin().chain, a[f].theta, shared_truth().theta[f]), 2);
  }
  CHECK(with < 0.5 * without);
  CHECK(honest >= 0.95 * static_cast<double>(b.size()));
  CHECK(b.back().centerline_sigma < a.back().centerline_sigma);
}

TEST_CASE("what has the rope's outline and not its marks is not the rope: lost in time, and found again") {
  std::vector<capture::View> views = painted_views();
  for (int f = 8; f < 24; ++f)
    for (std::size_t k = 0; k < views[f].rgba.size(); ++k)
      if (k % 4 != 3) views[f].rgba[k] = k / 4 % 7 < 3 ? 150 : 120;  // stripes of its own
  estimation::Filter filter(shared_twin(), {front_camera()}, moving_base, 0.0, {}, {}, compare_painted);
  const auto found = follow(filter, views);
  for (int f = 0; f < 12; ++f) CHECK_FALSE(found[f].lost);  // for some frames it may be a glint
  for (int f = 16; f < 24; ++f) CHECK(found[f].lost);
  for (std::size_t f = 26; f < found.size(); ++f) CHECK_FALSE(found[f].lost);
  CHECK(found[4].likeness.value() > 0.9);
  CHECK(found[20].likeness.value() < 0.5);
}

TEST_CASE("Adam on the rendering loss finds the rope from near, and says nothing of its deviations") {
  const chain::Chain& chain = shared_twin().chain;
  const Pose base = moving_base(0.0).pose;
  const capture::Camera camera = front_camera();
  // three Gaussians abreast in 60 rows along the rope, in the colors of paint()
  splat::Gaussians gaussians;
  gaussians.resize(180, chain.links(), 0);
  constexpr float kSh0 = 0.28209479f;
  for (int i = 0; i < gaussians.count; ++i) {
    const double s = (i / 3 + 0.5) / 60.0 * chain.length;
    const float place[3] = {0.006f * static_cast<float>(i % 3 - 1), 0.0f, -static_cast<float>(s)};
    for (int c = 0; c < 3; ++c) {
      gaussians.mean[3 * i + c] = place[c];
      gaussians.log_scale[3 * i + c] = std::log(0.003f);
      gaussians.sh[3 * i + c] = static_cast<float>((c == 0 ? paint(s) : 1.0 - paint(s)) - 0.5) / kSh0;
    }
    gaussians.opacity_logit[i] = 3.0f;
    gaussians.link_logits[chain.links() * i + chain::link_at(chain, s)] = 10.0f;
  }
  const gpu::DevicePtr device = gpu::open_device();
  splat::Engine engine(*device);
  const VectorX truth = shared_truth().theta[12];
  capture::View view;
  // as of a capture, a cut-out about the rope
  const Box box = box_of(chain::nodes(chain, chain::link_motions(chain, truth, base)), 3.0 * chain.diameter, camera);
  view.x0 = box.left, view.width = box.right - box.left;
  view.y0 = box.top, view.height = box.bottom - box.top;
  const auto spec = [&](const std::vector<Pose>& motions) {
    return splat::ViewSpec{&camera, view.x0, view.y0, view.width, view.height, motions};
  };
  const splat::ViewSpec true_spec = spec(chain::link_motions(chain, truth, base));
  const splat::Picture picture = engine.draw(gaussians, {&true_spec, 1}).front();
  for (std::size_t k = 0; k < picture.rgba.size(); ++k)
    view.rgba.push_back(k % 4 == 3
                            ? (picture.rgba[k] >= 0.5f ? 255 : 0)
                            : static_cast<std::uint8_t>(std::lround(255.0f * std::clamp(picture.rgba[k], 0.0f, 1.0f))));

  twin::Twin near = shared_twin();  // without dynamics, so that it begins at its first angles
  near.parameters.reset();
  near.initial.emplace().theta = truth;
  for (int k = 0; k < 12; k += 2) near.initial->theta[k] += 0.03;  // bends in the image plane
  int asked = 0;
  const auto gradient = [&](const capture::View& target, const capture::Camera&, const std::vector<Pose>& motions) {
    ++asked;
    const splat::ViewSpec drawn = spec(motions);
    const std::vector<std::uint8_t>* const pixels = &target.rgba;
    splat::Gradients gradients;
    engine.loss(gaussians, {&drawn, 1}, {&pixels, 1}, {}, 0.0, &gradients);
    return gradients.link_twists.front();
  };
  estimation::AdamFollower adam(near, {camera}, moving_base, 0.0, gradient, {.first_steps = 10});
  CHECK_FALSE(adam.expected(0.0));
  std::vector<double> errors{rms(chain, near.initial->theta, truth)};
  for (int frame = 0; frame < 5; ++frame) {
    view.time = frame * kInterval * 1e-6;  // so short that the base stays
    const capture::View* const one[] = {&view};
    const estimation::Estimate e = adam.update(one);
    CHECK(asked == 10 * (frame + 1));
    CHECK_FALSE(e.lost);
    CHECK(e.covariance.size() == 0);
    CHECK(*adam.expected(1.0) == e.theta);
    errors.push_back(rms(chain, e.theta, truth));
    CHECK(nlohmann::json::parse(estimation::to_json(e, 0.0))["sigma"].empty());
  }
  CHECK(errors[0] > 10e-3);
  // steps of 0.01 rad do not converge, so that some millimeters remain
  for (int frame = 2; frame <= 5; ++frame) CHECK(errors[frame] < 0.4 * errors[0]);
}

TEST_CASE("a clock whose zero is elsewhere changes nothing: frames may have negative times") {
  std::vector<capture::View> views = painted_views();
  for (int f = 0; f < 3; ++f) std::fill(views[f].rgba.begin(), views[f].rgba.end(), std::uint8_t{0});  // not there yet
  for (int f = 3; f < 6; ++f)
    for (std::size_t k = 0; k < views[f].rgba.size(); ++k)
      if (k % 4 != 3) views[f].rgba[k] = k / 4 % 7 < 3 ? 150 : 120;  // something else
  views.resize(30);
  const auto followed = [&](double zero) {
    estimation::State state = estimation::start(
        shared_twin(), {front_camera()}, [=](double time) { return moving_base(time - zero); }, zero, {}, {},
        compare_painted);
    std::vector<std::pair<estimation::Estimate, bool>> out;  // with whether a contact is assumed
    for (capture::View view : views) {
      view.time += zero;
      const capture::View* const one[] = {&view};
      const estimation::Estimate e = estimation::update(state, one);
      out.emplace_back(e, state.contact_until >= e.time);
    }
    return out;
  };
  const auto a = followed(5.0), b = followed(-10.0);
  int lost = 0;
  for (std::size_t f = 0; f < views.size(); ++f) {
    CAPTURE(f);
    CHECK((a[f].first.theta - b[f].first.theta).norm() < 1e-6);
    CHECK((a[f].first.covariance - b[f].first.covariance).norm() < 1e-6 * a[f].first.covariance.norm());
    CHECK(a[f].first.lost == b[f].first.lost);
    CHECK(a[f].second == b[f].second);
    lost += a[f].first.lost;
  }
  CHECK(lost >= 1);
  CHECK_FALSE(a.back().first.lost);
  CHECK_FALSE(a.back().second);
}

TEST_CASE("what hides a part of the rope is not 'no rope'") {
  std::vector<capture::View> views = shared_views();
  for (int f = 12; f < 40; ++f)  // a hand in front of the middle of the rope
    for (int y = 105; y < 150; ++y)
      for (int x = 0; x < views[f].width; ++x) views[f].rgba[4 * (y * views[f].width + x) + 3] = 0;
  estimation::Filter filter(shared_twin(), {front_camera()}, moving_base, 0.0);
  int honest = 0;
  for (const estimation::Estimate& e : follow(filter, views)) {
    CHECK_FALSE(e.lost);
    const double error = rms(shared_twin().chain, e.theta, shared_truth().theta[e.frame]);
    CHECK(error < 8e-3);
    honest += error <= 3.0 * e.centerline_sigma;
  }
  CHECK(honest >= 0.95 * static_cast<double>(views.size()));
}

TEST_CASE("a rope whose lower part leaves the image is followed by the rest") {
  capture::Camera camera = front_camera();
  camera.height = 150;  // the free end hangs below it
  std::vector<capture::View> views = shared_views();
  int shown = 0;
  for (capture::View& view : views) {
    view.height = camera.height;
    view.rgba.resize(4 * static_cast<std::size_t>(view.width) * view.height);
    for (int x = 0; x < view.width; ++x) shown += view.rgba[4 * ((view.height - 1) * view.width + x) + 3] != 0;
  }
  REQUIRE(shown > 0);
  estimation::Filter filter(shared_twin(), {camera}, moving_base, 0.0);
  int honest = 0;
  for (const estimation::Estimate& e : follow(filter, views)) {
    CHECK_FALSE(e.lost);
    const double error = rms(shared_twin().chain, e.theta, shared_truth().theta[e.frame]);
    honest += error <= 3.0 * e.centerline_sigma;
    CHECK(error < 15e-3);
  }
  CHECK(honest >= 0.95 * static_cast<double>(views.size()));
}

TEST_CASE("a rope that is elsewhere at once is found again") {
  std::vector<capture::View> views = shared_views();
  VectorX thrown = VectorX::Zero(12);
  for (int k = 0; k < 12; k += 2) thrown[k] = 0.25;  // bent by 1.5 rad, from frame 20 on, and held there
  for (int f = 20; f < 30; ++f) {
    views[f] = draw(shared_twin().chain, thrown, f * kInterval, f, front_camera());
  }
  views.resize(30);
  estimation::Filter filter(shared_twin(), {front_camera()}, moving_base, 0.0);
  const auto found = follow(filter, views);
  CHECK(rms(shared_twin().chain, found[19].theta, thrown) > 50e-3);
  CHECK_FALSE(found[29].lost);
  CHECK(rms(shared_twin().chain, found[29].theta, thrown) < 10e-3);
}

// Stops the end of a link instantly, as a rod in its way would.
void strike(const dynamics::Model& model, const trajectory::BaseMotion& base, int link, dynamics::InitialState& state) {
  const MatrixX axes = chain::world_axes(model.chain, state.theta, base.pose);
  const MatrixX nodes = chain::nodes(model.chain, chain::link_motions(model.chain, state.theta, base.pose));
  const MatrixX j = chain::point_jacobian(model.chain, axes, link, nodes.col(link + 1));
  const Vector3 velocity = j * state.thetadot + base.velocity.tail<3>();  // the base does not turn
  const MatrixX mass = dynamics::linearize(model, base, math::Vector6::Zero(), state.theta, state.thetadot).mass;
  const VectorX push = mass.llt().solve(VectorX(j.transpose() * velocity));
  state.thetadot -= push * (velocity.squaredNorm() / velocity.dot(j * push));
}

// Returns the links' ends by a belief that is conditioned on their positions across `ray`, as a camera that looks along
// it measures them to 1 mm.
MatrixX seen_from(const chain::Chain& chain, const Pose& base, const estimation::Belief& belief, const Vector3& ray,
                  const MatrixX& true_nodes) {
  const int n = chain.angles(), count = static_cast<int>(true_nodes.cols());
  const VectorX theta = belief.mean.head(n);
  const MatrixX nodes = chain::nodes(chain, chain::link_motions(chain, theta, base));
  const MatrixX axes = chain::world_axes(chain, theta, base);
  const Vector3 right = ray.unitOrthogonal(), down = ray.cross(right);
  MatrixX rows(2 * count, n);
  VectorX residual(2 * count);
  for (int i = 0; i < count; ++i) {
    const MatrixX j = chain::point_jacobian(chain, axes, std::max(0, i - 1), nodes.col(i));
    const Vector3 off = true_nodes.col(i) - nodes.col(i);
    rows.row(2 * i) = right.transpose() * j;
    rows.row(2 * i + 1) = down.transpose() * j;
    residual[2 * i] = right.dot(off);
    residual[2 * i + 1] = down.dot(off);
  }
  const MatrixX prior = belief.covariance.topLeftCorner(n, n);
  const MatrixX innovation = rows * prior * rows.transpose() + 1e-6 * MatrixX::Identity(2 * count, 2 * count);
  const VectorX found = theta + prior * rows.transpose() * innovation.llt().solve(residual);
  return chain::nodes(chain, chain::link_motions(chain, found, base));
}

TEST_CASE("a rope that swung into something is found where one camera does not see it: along the rays") {
  const twin::Twin& twin = shared_twin();
  const int n = twin.chain.angles();
  const dynamics::Model model = dynamics::make_model(twin.chain, *twin.parameters);
  const Vector3 ray = Vector3(1.0, 0.5, -0.2).normalized();  // the rope swings along x
  for (const int link : {3, 5}) {
    CAPTURE(link);
    dynamics::InitialState state{0.4, VectorX::Zero(n), VectorX::Zero(n)};
    for (int k = 0; k < n; k += 2) state.thetadot[k] = -1.0;
    const estimation::State before = estimation::start(twin, {front_camera()}, moving_base, 0.0);
    estimation::Belief belief{state.time, VectorX::Zero(3 * n), 1e-4 * MatrixX::Identity(3 * n, 3 * n),
                              MatrixX::Zero(3 * n, before.setup.mean.size())};
    belief.mean.segment(n, n) = state.thetadot;
    strike(model, moving_base(state.time), link, state);
    const double time = state.time + kInterval;
    const VectorX truth = dynamics::rollout(model, moving_base, state, {time}).theta[0];
    const Pose base = moving_base(time).pose;
    const MatrixX true_nodes = chain::nodes(twin.chain, chain::link_motions(twin.chain, truth, base));
    const estimation::Belief touched = moved_to(before, belief, time, estimation::Contact::touched);
    const estimation::Belief struck = moved_to(before, belief, time, estimation::Contact::struck);
    const auto surprise = [&](const estimation::Belief& predicted) {  // the squared Mahalanobis distance
      const VectorX off = truth - predicted.mean.head(n);
      return off.dot(VectorX(predicted.covariance.topLeftCorner(n, n).llt().solve(off)));
    };
    CHECK(surprise(touched) > 2.0 * n);
    CHECK(surprise(struck) < n);
    const auto error = [&](const estimation::Belief& predicted) {
      return (seen_from(twin.chain, base, predicted, ray, true_nodes) - true_nodes).norm();
    };
    CHECK(error(struck) < 0.5 * error(touched));
  }
}

TEST_CASE("depth comes from the dynamics: without them it is worse, and said to be less sure") {
  twin::Twin still = shared_twin();
  still.parameters.reset();
  estimation::Filter with(shared_twin(), {front_camera()}, moving_base, 0.0);
  estimation::Filter without(still, {front_camera()}, moving_base, 0.0);
  const auto a = follow(with, shared_views()), b = follow(without, shared_views());
  CHECK(deviation(still.chain, b.back()) > 2.0 * deviation(still.chain, a.back()));
  double error_with = 0.0, error_without = 0.0;
  for (std::size_t f = 15; f < a.size(); ++f) {
    error_with += rms(still.chain, a[f].theta, shared_truth().theta[f]);
    error_without += rms(still.chain, b[f].theta, shared_truth().theta[f]);
  }
  CHECK(error_with < error_without);
}

TEST_CASE("a rope out of sight is predicted, counts as lost in time, and is found again") {
  std::vector<capture::View> views = shared_views();
  for (int f = 10; f < 32; ++f) std::fill(views[f].rgba.begin(), views[f].rgba.end(), std::uint8_t{0});
  estimation::Filter filter(shared_twin(), {front_camera()}, moving_base, 0.0);
  const auto found = follow(filter, views);
  CHECK_FALSE(found[12].seen);
  CHECK_FALSE(found[12].lost);
  CHECK(rms(shared_twin().chain, found[12].theta, shared_truth().theta[12]) < 8e-3);
  CHECK(deviation(shared_twin().chain, found[30]) > deviation(shared_twin().chain, found[9]));
  CHECK(found[30].lost);
  CHECK_FALSE(found[33].lost);
  CHECK(rms(shared_twin().chain, found[40].theta, shared_truth().theta[40]) < 4e-3);
}

TEST_CASE("first masks that end half-way down the rope are not believed, and said to be doubtful") {
  std::vector<capture::View> views(shared_views().begin(), shared_views().begin() + 30);
  for (int f = 0; f < 10; ++f) {
    capture::View& view = views[f];
    int top = view.height, bottom = 0;
    const auto row = [&](int y) { return view.rgba.begin() + 4L * y * view.width; };
    for (int y = 0; y < view.height; ++y)
      for (int x = 0; x < view.width; ++x)
        if (row(y)[4 * x + 3] != 0) top = std::min(top, y), bottom = y;
    std::fill(row((top + bottom) / 2), view.rgba.end(), std::uint8_t{0});
  }
  estimation::Filter filter(shared_twin(), {front_camera()}, moving_base, 0.0);
  const auto found = follow(filter, views);
  const chain::Chain& chain = shared_twin().chain;
  for (int f = 0; f < 10; ++f) {
    CHECK(std::string(estimation::status(found[f])) == "doubtful");
    CHECK(rms(chain, found[f].theta, shared_truth().theta[f]) < 3.0 * deviation(chain, found[f]));
  }
  for (int f = 15; f < 30; ++f) CHECK(std::string(estimation::status(found[f])) == "following");
  CHECK(rms(chain, found[25].theta, shared_truth().theta[25]) < 5e-3);
}

TEST_CASE("masks of a motion that no rope makes are doubtful after a while, and not when it ends") {
  constexpr int kFirst = 20, kLast = 32;  // frames in which what is seen shakes by more than a rope can
  const chain::Chain& chain = shared_twin().chain;
  std::vector<capture::View> views(shared_views().begin(), shared_views().begin() + 45);
  for (int f = kFirst; f < kLast; ++f) {
    VectorX theta = shared_truth().theta[f];
    for (int k = 0; k < theta.size(); k += 2) theta[k] += 0.25 * std::sin(3.1 * f * f + k);
    views[f] = draw(chain, theta, f * kInterval, f, front_camera());
  }
  estimation::Filter filter(shared_twin(), {front_camera()}, moving_base, 0.0);
  const auto found = follow(filter, views);
  for (int f = 12; f < kFirst + 3; ++f) CHECK_FALSE(found[f].doubtful);
  for (int f = kFirst + 8; f < kLast; ++f) {
    CHECK(std::string(estimation::status(found[f])) == "doubtful");
    CHECK(deviation(chain, found[f]) > 10.0 * deviation(chain, found[kFirst - 1]));
  }
  for (int f = kLast + 8; f < 45; ++f) CHECK_FALSE(found[f].doubtful);
}

TEST_CASE("a base whose stamps are late is found to be so while it moves") {
  constexpr double kLate = 0.02;
  const auto late_base = [](double time) { return moving_base(time - kLate); };
  estimation::State state = estimation::start(shared_twin(), {front_camera()}, late_base, 0.0);
  const auto found = follow(state, shared_views());
  CHECK(std::abs(state.setup.mean[0] - kLate) < 6e-3);  // in a second of motion
  CHECK(found[1].settling);                             // nobody knows yet that nothing pushes
  CHECK_FALSE(found.back().settling);
  CHECK(state.setup.information(0, 0) > 1.0 / (5e-3 * 5e-3));
  const std::size_t last = found.size() - 1;
  CHECK(rms(shared_twin().chain, found[last].theta, shared_truth().theta[last]) < 5e-3);
  estimation::State right = estimation::start(shared_twin(), {front_camera()}, moving_base, 0.0);
  follow(right, shared_views());
  CHECK(std::abs(right.setup.mean[0]) < 3e-3);
}

TEST_CASE("while a base's clock is not known, it may begin to move a little before or after it says so") {
  constexpr double kBegin = 1.0;  // s
  const auto base = [](double time) {
    trajectory::BaseMotion out;
    out.pose.translation = Vector3(0.2 * std::max(0.0, time - kBegin), 0.0, 0.55);
    out.velocity[3] = time > kBegin ? 0.2 : 0.0;
    return out;
  };
  estimation::State state = estimation::start(shared_twin(), {front_camera()}, base, 0.0);
  for (const double time : {0.5, kBegin - 0.09, kBegin + 0.09, 1.5}) CHECK_FALSE(may_go_otherwise(state, time));
  for (const double time : {kBegin - 0.05, kBegin + 0.05}) CHECK(may_go_otherwise(state, time));
  state.setup.information(0, 0) = 1.0 / (2e-3 * 2e-3);
  CHECK_FALSE(may_go_otherwise(state, kBegin));
}

TEST_CASE("how a belief follows clock and camera is its derivative by them") {
  using silhouette::SetupEquations;
  constexpr double kSure = 1e9;  // times as much as is known beforehand: nothing is learned
  constexpr int kFrames = 12;
  estimation::CompareColors compare;
  std::vector<capture::View> views = shared_views();
  SUBCASE("by outlines") {}
  SUBCASE("by outlines and colors") {
    views = painted_views();
    compare = compare_painted;
  }
  views.resize(kFrames);
  const auto believing = [&](int unknown, double value) {
    estimation::State state = estimation::start(shared_twin(), {front_camera()}, moving_base, 0.0, {}, {1}, compare);
    state.setup.information *= kSure;
    state.setup.mean[unknown] = value;
    state.setup.right = state.setup.information * state.setup.mean;
    const int camera = SetupEquations::kCameras;
    state.cameras[0].world_from_camera =
        capture::moved(state.cameras[0].world_from_camera, state.setup.mean.segment<3>(camera),
                       state.setup.mean.segment<3>(camera + 3));
    follow(state, views);
    return state.belief.value();
  };
  const int n = shared_twin().chain.angles();
  std::vector<int> unknowns{SetupEquations::kClock};
  // along the rope a step on painted colors is no smooth function of the camera
  for (const int i : {1, 2, 3}) unknowns.push_back(SetupEquations::kCameras + i);
  for (const int i : {0, 4, 5})
    if (!compare) unknowns.push_back(SetupEquations::kCameras + i);
  const MatrixX by_setup = believing(SetupEquations::kClock, 0.0).by_setup;  // whichever unknown is 0
  for (const int unknown : unknowns) {
    CAPTURE(unknown);
    const double step = unknown == SetupEquations::kClock ? 1e-3 : 2e-4;
    const estimation::Belief after = believing(unknown, step), before = believing(unknown, -step);
    const VectorX slope = ((after.mean - before.mean) / (2.0 * step)).head(n);
    const VectorX told = by_setup.col(unknown).head(n);
    CHECK((told - slope).norm() < 0.2 * slope.norm());
  }
}

TEST_CASE("what colors say of the setup is what the joint Gaussian says") {
  constexpr int kAngles = 3, kState = 7, kSetup = 4, kPixels = 20;
  const auto numbers = [](int rows, int columns, double phase) {
    MatrixX out(rows, columns);
    for (int i = 0; i < rows; ++i)
      for (int j = 0; j < columns; ++j) out(i, j) = std::sin(phase + 1.7 * i + 0.6 * j * j + 0.3 * i * j);
    return out;
  };
  const MatrixX by_setup = numbers(kState, kSetup, 0.1), half = numbers(kState, kState, 0.5);
  const MatrixX covariance = half * half.transpose() + 0.1 * MatrixX::Identity(kState, kState);
  const MatrixX known = 2.0 * MatrixX::Identity(kSetup, kSetup);  // information
  const MatrixX by_angles = numbers(kPixels, kAngles, 1.0), by_rope = numbers(kPixels, kSetup, 2.0);
  const VectorX residual = numbers(kPixels, 1, 3.0);

  // state and setup at once, as one dense least squares of unit weights about the means before
  MatrixX information = MatrixX::Zero(kState + kSetup, kState + kSetup), differs(kState, kState + kSetup);
  MatrixX seen = MatrixX::Zero(kPixels, kState + kSetup);
  differs << MatrixX::Identity(kState, kState), -by_setup;
  seen.leftCols(kAngles) = by_angles;
  seen.rightCols(kSetup) = by_rope;
  information = differs.transpose() * covariance.inverse() * differs + seen.transpose() * seen;
  information.bottomRightCorner(kSetup, kSetup) += known;
  const MatrixX joint = information.inverse();
  const VectorX change = -joint * seen.transpose() * residual;
  const MatrixX setup = joint.bottomRightCorner(kSetup, kSetup);

  estimation::ColorEvidence colors;
  colors.normal = by_angles.transpose() * by_angles;
  colors.coupling = by_angles.transpose() * by_rope;
  colors.shared = by_rope.transpose() * by_rope;
  colors.right = by_angles.transpose() * residual;
  colors.shared_right = by_rope.transpose() * residual;
  colors.gain =
      covariance.leftCols(kAngles) *
      (MatrixX::Identity(kAngles, kAngles) + colors.normal * covariance.topLeftCorner(kAngles, kAngles)).inverse();
  MatrixX follows = by_setup;
  silhouette::SetupEquations equations{MatrixX::Zero(kSetup, kSetup), VectorX::Zero(kSetup), {}};
  estimation::add_colors(colors, follows, equations);
  const MatrixX found = (known + equations.information).inverse();
  CHECK((found - setup).norm() < 1e-9 * setup.norm());
  CHECK((-found * equations.gradient - change.tail(kSetup)).norm() < 1e-9 * change.norm());
  const MatrixX expected = joint.topRightCorner(kState, kSetup) * setup.inverse();
  CHECK((follows - expected).norm() < 1e-9 * expected.norm());
}

TEST_CASE("a camera that the twin does not know is found to stand where it does") {
  const capture::Camera right = front_camera();
  capture::Camera off = right;
  off.world_from_camera.rotation *= math::exp_so3(Vector3(0.003, 0.005, -0.002));
  off.world_from_camera.translation += Vector3(0.002, -0.002, -0.003);
  const chain::Chain& chain = shared_twin().chain;
  const auto follow_with = [&](const std::vector<char>& unverified) {
    estimation::Filter filter(shared_twin(), {off}, moving_base, 0.0, {}, unverified);
    const auto found = follow(filter, shared_views());
    double error = 0.0;
    for (std::size_t f = 20; f < found.size(); ++f) error += rms(chain, found[f].theta, shared_truth().theta[f]);
    return std::tuple{error / static_cast<double>(found.size() - 20), found, filter.cameras()[0]};
  };
  const auto [as_given, trusting, given] = follow_with({});
  const auto [error, found, believed] = follow_with({1});
  CHECK(error < 0.5 * as_given);
  for (std::size_t f = 0; f < found.size(); ++f)
    CHECK(rms(chain, found[f].theta, shared_truth().theta[f]) < 3.0 * deviation(chain, found[f]));
  // while it is learned the rope seems to move
  CHECK(found[0].settling);
  CHECK_FALSE(found.back().settling);
  // where the rope is, both cameras now see the same
  const Vector3 middle = moving_base(1.0).pose.translation - Vector3(0.0, 0.0, 0.15);
  const auto pixel = [&](const capture::Camera& camera) {
    return Vector2(capture::project(camera, camera.world_from_camera.inverse() * middle));
  };
  const double before = (pixel(off) - pixel(right)).norm(), after = (pixel(believed) - pixel(right)).norm();
  CHECK(before > 1.5);
  CHECK(after < 0.4 * before);
}

TEST_CASE("a rope on a table lies in its plane, however the gripper's pose is tilted") {
  twin::Twin twin = shared_twin();
  twin.chain = chain::make_chain(0.3, 0.02, Vector3::UnitX(), Vector3::UnitZ(), 6, chain::Bending::planar, false);
  twin.parameters.reset();
  twin.tabletop = true;
  trajectory::BaseMotion tilted;
  tilted.pose.rotation = math::exp_so3(Vector3(0.02, -0.015, 0.3));
  tilted.velocity << 0.1, 0.2, 0.3, 0.4, 0.5, 0.6;
  const estimation::Filter filter(
      twin, {front_camera()}, [&](double) { return tilted; }, 0.0);
  const trajectory::BaseMotion believed = filter.base_at(0.0);
  CHECK((believed.pose.rotation.col(2) - Vector3::UnitZ()).norm() < 0.001);
  CHECK((tilted.pose.rotation.col(2) - Vector3::UnitZ()).norm() > 0.02);
  // the same motion of the gripper, told in the turned frame
  CHECK(
      (believed.pose.rotation * believed.velocity.head<3>() - tilted.pose.rotation * tilted.velocity.head<3>()).norm() <
      1e-12);
  CHECK(
      (believed.pose.rotation * believed.velocity.tail<3>() - tilted.pose.rotation * tilted.velocity.tail<3>()).norm() <
      1e-12);
}

TEST_CASE("blobs apart from a rope that is seen whole are no reason to doubt it") {
  std::vector<capture::View> views(shared_views().begin(), shared_views().begin() + 6);
  estimation::Filter alone(shared_twin(), {front_camera()}, moving_base, 0.0);
  const auto expected = follow(alone, views);
  for (capture::View& view : views)
    for (int x0 : {10, 260})
      for (int y = 20; y < 60; ++y)
        for (int x = x0; x < x0 + 40; ++x) view.rgba[4 * (y * view.width + x) + 3] = 255;
  estimation::Filter filter(shared_twin(), {front_camera()}, moving_base, 0.0);
  const auto found = follow(filter, views);
  for (std::size_t f = 0; f < found.size(); ++f) {
    CHECK(std::string(estimation::status(found[f])) == "following");
    CHECK(rms(shared_twin().chain, found[f].theta, expected[f].theta) < 0.5e-3);
  }
}

TEST_CASE("a mask elsewhere is not the rope: lost, and the prediction stays") {
  std::vector<capture::View> views(shared_views().begin(), shared_views().begin() + 14);
  for (int f = 8; f < 11; ++f) {
    std::fill(views[f].rgba.begin(), views[f].rgba.end(), std::uint8_t{0});
    for (int y = 5; y < 25; ++y)
      for (int x = 270; x < 310; ++x) views[f].rgba[4 * (y * views[f].width + x) + 3] = 255;
  }
  estimation::Filter filter(shared_twin(), {front_camera()}, moving_base, 0.0);
  const auto found = follow(filter, views);
  for (int f = 8; f < 11; ++f) {
    CHECK(found[f].lost);
    CHECK(rms(shared_twin().chain, found[f].theta, shared_truth().theta[f]) < 10e-3);
  }
  CHECK_FALSE(found[13].lost);
  CHECK(rms(shared_twin().chain, found[13].theta, shared_truth().theta[13]) < 5e-3);
}

TEST_CASE("a mask that is too wide on a table is thought to be so on the rope's lower side") {
  twin::Twin twin = shared_twin();
  twin.tabletop = true;
  twin.parameters.reset();  // nothing moves
  const int n = twin.chain.angles();
  capture::Camera camera = front_camera();  // turned to look 45 degrees down at the grasp, which is at the origin
  const double half = std::sqrt(0.5);
  camera.world_from_camera.rotation << 1, 0, 0, 0, -half, half, 0, -half, -half;
  camera.world_from_camera.translation = -0.7 * camera.world_from_camera.rotation.col(2);
  estimation::State state = estimation::start(
      twin, {camera}, [](double) { return trajectory::BaseMotion{}; }, 0.0);
  state.edge_offset = 0.5;
  estimation::Belief belief{0.0, VectorX::Zero(3 * n + 2), 1e-4 * MatrixX::Identity(3 * n + 2, 3 * n + 2),
                            MatrixX::Zero(3 * n + 2, state.setup.mean.size())};
  belief.mean.tail(2) << 1.0, -1.0;  // forgotten by the time of the prediction
  const VectorX shift = moved_to(state, belief, 100.0, estimation::Contact::none).mean.tail(2);
  CHECK(shift[0] == doctest::Approx(0.0).epsilon(1e-6));
  CHECK(shift[1] > 0.3);  // downward, as image rows count
  CHECK(shift[1] <= 0.5);
}

TEST_CASE("the predicted covariance is that of the predicted mean's derivative") {
  const int n = 12;
  const estimation::State state = estimation::start(shared_twin(), {front_camera()}, moving_base, 0.0);
  estimation::Belief belief;
  belief.time = 0.3;
  belief.mean = VectorX::Zero(3 * n);
  belief.by_setup = MatrixX::Zero(3 * n, state.setup.mean.size());
  for (int k = 0; k < 3 * n; ++k) belief.mean[k] = 0.1 * std::sin(1.0 + k);
  VectorX direction(3 * n);  // smooth along the rope: the variational equation is of second order in stiff modes only
  for (int k = 0; k < 3 * n; ++k) direction[k] = 1.0 + 0.3 * std::cos(0.2 * k);
  const double size = 1e4;  // so large that the process noise is negligible
  belief.covariance = size * size * direction * direction.transpose();
  const estimation::Belief moved = moved_to(state, belief, 0.3 + kInterval, estimation::Contact::none);
  const double step = 1e-5;
  estimation::Belief a = belief, b = belief;
  a.mean += step * direction;
  b.mean -= step * direction;
  const VectorX slope = (moved_to(state, a, 0.3 + kInterval, estimation::Contact::none).mean -
                         moved_to(state, b, 0.3 + kInterval, estimation::Contact::none).mean) /
                        (2.0 * step);
  const VectorX expected = size * slope.cwiseAbs(), got = moved.covariance.diagonal().cwiseSqrt();
  CHECK((got - expected).norm() <= 0.05 * expected.norm());
}

TEST_CASE("the tube covers its own mask, and half of it when the other half is hidden") {
  const twin::Twin& twin = shared_twin();
  capture::View view = shared_views()[20];
  const VectorX theta = shared_truth().theta[20];
  const Pose base = moving_base(20 * kInterval).pose;
  const double whole = estimation::tube_iou(twin.chain, base, theta, view, front_camera());
  CHECK(whole > 0.93);
  int mask = 0, kept = 0;
  for (int y = 0; y < view.height; ++y)
    for (int x = 0; x < view.width; ++x) {
      std::uint8_t& a = view.rgba[4 * (y * view.width + x) + 3];
      mask += a != 0;
      if (y > 120) a = 0;
      kept += a != 0;
    }
  CHECK(estimation::tube_iou(twin.chain, base, theta, view, front_camera()) ==
        doctest::Approx(whole * kept / mask).epsilon(0.05));
}

TEST_CASE("what a line says of the base is read back, and refused where it cannot be") {
  const auto read = [](const char* more) {
    return estimation::read_estimate_line(std::string(R"({"time": 1.0, "theta": [0.1, 0.2])") + more + "}", "here", 2,
                                          0.0);
  };
  CHECK_FALSE(read(R"(, "settling": true)"));
  CHECK(read(R"(, "base_late": 0.02)")->base->late == 0.02);
  CHECK_FALSE(read("")->base);
  CHECK(read("")->late_sigma == 0.0);
  CHECK(read("")->theta_by_late.size() == 0);
  const estimation::EstimateLine late = *read(R"(, "base_late_sigma": 0.03, "theta_by_base_late": [0.4, -2])");
  CHECK(late.late_sigma == 0.03);
  CHECK(late.theta_by_late == Vector2(0.4, -2.0));
  const estimation::EstimateLine held = *read(R"(, "grasp_rotation": [0.1, 0, 0.2], "grasp_shift": [0, 0.01, 0])");
  CHECK((math::log_so3(held.base->grasp.rotation) - Vector3(0.1, 0.0, 0.2)).norm() < 1e-12);
  CHECK(held.base->grasp.translation == Vector3(0.0, 0.01, 0.0));
  for (const char* wrong :
       {R"(, "base_late": "x")", R"(, "base_late": 1e9)", R"(, "grasp_rotation": [0.1])",
        R"(, "grasp_rotation": [9, 9, 9])", R"(, "grasp_shift": [0, 0])", R"(, "base_late_sigma": -0.1)",
        R"(, "base_late_sigma": "x")", R"(, "theta_by_base_late": [1])", R"(, "theta_by_base_late": [1, 1e9])"})
    CHECK_THROWS_AS(read(wrong), InputError);
}

TEST_CASE("what a line says of the base goes for a base that the twin has mended, too") {
  const auto given = [](double time) { return moving_base(time); };
  const estimation::BaseCorrection known{0.02, {math::exp_so3(Vector3(0.1, 0.2, -0.1)), Vector3(0.003, 0.0, 0.001)}};
  const estimation::BaseCorrection said{0.05, {math::exp_so3(Vector3(0.0, -0.1, 0.3)), Vector3(0.0, 0.002, 0.004)}};
  const auto own = [&](double time) { return estimation::corrected(given, known, time); };
  const trajectory::BaseMotion wanted = estimation::corrected(given, said, 0.4);
  const trajectory::BaseMotion found = estimation::corrected(own, estimation::remaining(said, known), 0.4);
  CHECK((found.pose.rotation - wanted.pose.rotation).norm() < 1e-12);
  CHECK((found.pose.translation - wanted.pose.translation).norm() < 1e-12);
  CHECK((found.velocity - wanted.velocity).norm() < 1e-12);
  CHECK((found.acceleration - wanted.acceleration).norm() < 1e-12);
  CHECK(estimation::remaining({}, known).late == 0.0);  // a line that says nothing
}

TEST_CASE("a line of JSON holds what formats.md 3.1 names") {
  estimation::Estimate e;
  e.frame = 12;
  e.time = 0.4;
  e.theta = VectorX::Constant(2, 0.5);
  e.thetadot = VectorX::Constant(2, -1.0);
  e.covariance = 0.04 * MatrixX::Identity(4, 4);
  e.iou = 0.94;
  e.residual = 0.25;
  const auto line = nlohmann::json::parse(estimation::to_json(e, 0.0079));
  CHECK(line["frame"] == 12);
  CHECK(line["time"] == 0.4);
  CHECK(line["theta"].size() == 2);
  CHECK(line["thetadot"][1] == -1.0);
  CHECK(line["sigma"][0].get<double>() == doctest::Approx(0.2));
  REQUIRE(line["covariance"].size() == 3);
  CHECK(line["covariance"][1] == 0.0);
  CHECK(line["covariance"][2].get<double>() == doctest::Approx(0.04));
  CHECK(line["iou"] == 0.94);
  CHECK(line["residual"] == 0.25);
  CHECK(line["lost"] == false);
  CHECK(line["latency_ms"].get<double>() == doctest::Approx(7.9));
  e.theta[1] = NAN;  // JSON has no such number
  e.covariance(1, 0) = INFINITY;
  CHECK(line["base_late"] == 0.0);
  CHECK(line["base_late_sigma"] == 0.0);
  CHECK(line["theta_by_base_late"].empty());
  CHECK(line["grasp_rotation"].size() == 3);
  const auto broken = nlohmann::json::parse(estimation::to_json(e, 0.0079));
  CHECK(broken["theta"][1].is_null());
  CHECK(broken["covariance"][1].is_null());
}

}  // namespace
