// Checks the double-precision renderer of reference_renderer.h, before anything is measured against it.
#include <doctest/doctest.h>

#include <fstream>
#include <nlohmann/json.hpp>

#include "reference_renderer.h"

using namespace chainsplat;

namespace {

nlohmann::json vectors(const std::string& name) {
  std::ifstream file(std::string(CHAINSPLAT_SOURCE_DIR) + "/tests/data/vectors/" + name);
  REQUIRE(file.good());
  return nlohmann::json::parse(file);
}

// All numbers of nested lists, in their order.
std::vector<double> flat(const nlohmann::json& list) {
  if (list.is_number()) return {list.get<double>()};
  std::vector<double> out;
  for (const auto& item : list)
    for (const double x : flat(item)) out.push_back(x);
  return out;
}

// Largest difference relative to the largest expected entry.
double relative_error(const std::vector<double>& got, const std::vector<double>& wanted) {
  REQUIRE(got.size() == wanted.size());
  double error = 0.0, largest = 0.0;
  for (std::size_t k = 0; k < got.size(); ++k) {
    if (!std::isfinite(got[k])) return INFINITY;
    error = std::max(error, std::abs(got[k] - wanted[k]));
    largest = std::max(largest, std::abs(wanted[k]));
  }
  return error / largest;
}

// The vectors carry 17 digits and their two formulations agree to 1e-14.
constexpr double kVectorTolerance = 1e-12;

}  // namespace

TEST_CASE("the reference equals the splat vectors: replicas, image, loss and every gradient") {
  const auto file = vectors("splat.json");
  capture::Camera camera;
  camera.width = file["width"];
  camera.height = file["height"];
  camera.fx = file["camera"]["fx"];
  camera.fy = file["camera"]["fy"];
  camera.cx = file["camera"]["cx"];
  camera.cy = file["camera"]["cy"];
  math::Pose camera_from_world;
  for (int r = 0; r < 3; ++r) {
    for (int c = 0; c < 3; ++c) camera_from_world.rotation(r, c) = file["camera"]["R_cs"][r][c];
    camera_from_world.translation[r] = file["camera"]["p_cs"][r];
  }
  camera.world_from_camera = camera_from_world.inverse();

  const auto& rows = file["gaussians"];
  reference::Parameters<double> g{12,
                                  4,
                                  file["sh_degree"],
                                  flat(rows["mean"]),
                                  flat(rows["quat"]),
                                  flat(rows["log_scale"]),
                                  flat(rows["opacity_logit"]),
                                  flat(rows["sh"]),
                                  flat(rows["link_logits"])};
  std::vector<math::Vector6> axes;
  for (const auto& s : file["chain"]["S"]) axes.push_back(math::Vector6(flat(s).data()));
  const std::vector<double> theta = flat(file["chain"]["theta"]), base_rows = flat(file["chain"]["T_b"]);
  math::Pose base;
  for (int r = 0; r < 3; ++r) {
    for (int c = 0; c < 3; ++c) base.rotation(r, c) = base_rows[4 * r + c];
    base.translation[r] = base_rows[4 * r + 3];
  }
  splat::ViewSpec view{&camera, 0, 0, camera.width, camera.height, {}};
  std::vector<double> motion_rows;
  const auto motions = reference::link_motions(axes, theta, base);
  for (const auto& m : motions) {
    for (int r = 0; r < 3; ++r) {
      motion_rows.insert(motion_rows.end(), m.rotation[r].begin(), m.rotation[r].end());
      motion_rows.push_back(m.translation[r]);
    }
    motion_rows.insert(motion_rows.end(), {0, 0, 0, 1});
  }
  CHECK(relative_error(motion_rows, flat(file["chain"]["link_motions"])) <= kVectorTolerance);

  // the vectors were computed without the clamp of mathematics.md 2.5
  reference::Rules rules;
  rules.clamp = false;
  const auto splats = reference::project(g, view, motions, rules);
  REQUIRE(splats.size() == 48);
  for (std::size_t k = 0; k < splats.size(); ++k) {
    const auto& s = splats[k];
    CHECK(s.replica == file["order"][k].get<int>());
    const auto& wanted = file["replicas"][s.replica];
    const std::vector<double> got{s.center[0],     s.center[1],     s.covariance[0], s.covariance[1],
                                  s.covariance[1], s.covariance[2], s.depth,         s.opacity};
    std::vector<double> numbers = flat(wanted["mean2d"]);
    for (const char* key : {"cov2d", "depth", "opacity"})
      for (const double x : flat(wanted[key])) numbers.push_back(x);
    for (std::size_t m = 0; m < got.size(); ++m) CHECK(got[m] == doctest::Approx(numbers[m]).epsilon(kVectorTolerance));
    CHECK(relative_error({s.color.begin(), s.color.end()}, flat(wanted["colour"])) <= kVectorTolerance);
  }

  reference::Target target{flat(file["target"]), std::vector<double>(24 * 16, 0.0)};
  // LossWeights are floats, which 0.8 and 0.2 are not: evaluate with weights (1, 0) and (0, 1) and mix in double
  splat::LossWeights weights;
  std::vector<reference::Variable> angles;
  for (const double x : theta) angles.push_back(reference::independent(x));
  const auto evaluate = [&](float l1, float dssim) {
    weights = {l1, dssim, 0.0f};
    return reference::evaluate(g, std::span(&view, 1), std::span(&target, 1), weights, 0.0, rules,
                               [&](const splat::ViewSpec&) { return reference::link_motions(axes, angles, base); });
  };
  const auto theta_gradient = [&] {
    std::vector<double> out;
    for (auto& x : angles) {
      out.push_back(reference::tape().adjoint(x.index));
      reference::tape().add(x.index, -out.back());
    }
    return out;
  };
  const auto l1 = evaluate(1.0f, 0.0f);
  const std::vector<double> theta_l1 = theta_gradient();
  const auto dssim = evaluate(0.0f, 1.0f);
  const std::vector<double> theta_dssim = theta_gradient();
  const auto mixed = [](const std::vector<double>& a, const std::vector<double>& b) {
    std::vector<double> out(a.size());
    for (std::size_t k = 0; k < a.size(); ++k) out[k] = 0.8 * a[k] + 0.2 * b[k];
    return out;
  };
  const reference::Picture& picture = l1.pictures[0];
  CHECK(picture.doubtful_count() == 0);
  std::vector<double> rgb, alpha, image_gradient;
  const std::vector<double> gamma = mixed(l1.image_gradient[0], dssim.image_gradient[0]);
  for (std::size_t k = 0; k < picture.rgba.size(); ++k) {
    (k % 4 == 3 ? alpha : rgb).push_back(picture.rgba[k]);
    if (k % 4 != 3) image_gradient.push_back(gamma[k]);
  }
  CHECK(relative_error(rgb, flat(file["image"])) <= kVectorTolerance);
  CHECK(relative_error(alpha, flat(file["alpha"])) <= kVectorTolerance);
  CHECK(l1.losses[0].l1 == doctest::Approx(file["loss_l1"].get<double>()).epsilon(kVectorTolerance));
  CHECK(l1.losses[0].ssim == doctest::Approx(file["ssim_mean"].get<double>()).epsilon(kVectorTolerance));
  CHECK(0.8 * l1.total + 0.2 * dssim.total == doctest::Approx(file["loss"].get<double>()).epsilon(kVectorTolerance));

  const auto& gradients = file["gradients"];
  CHECK(relative_error(image_gradient, flat(gradients["image"])) <= kVectorTolerance);
  const std::array<const char*, 6> keys{"mean", "quat", "log_scale", "opacity_logit", "sh", "link_logits"};
  for (int kind = 0; kind < 6; ++kind) {
    INFO(keys[kind]);
    CHECK(relative_error(mixed(*l1.gradient.kinds()[kind], *dssim.gradient.kinds()[kind]),
                         flat(gradients[keys[kind]])) <= kVectorTolerance);
  }
  CHECK(relative_error(mixed(theta_l1, theta_dssim), flat(gradients["theta"])) <= kVectorTolerance);
  const math::MatrixX twists = 0.8 * l1.link_twists[0] + 0.2 * dssim.link_twists[0];
  CHECK(relative_error({twists.data(), twists.data() + 24}, flat(gradients["link_twists_world"])) <= kVectorTolerance);
  const math::Vector6 base_twist = twists.rowwise().sum();
  CHECK(relative_error({base_twist.data(), base_twist.data() + 6}, flat(gradients["base_twist_world"])) <=
        kVectorTolerance);
  reference::tape().forget(0);
}

TEST_CASE("the reference's spherical harmonics equal the vectors to degree 3") {
  const auto file = vectors("splat.json")["sh_degree3"];
  const std::vector<double> coefficients = flat(file["coefficients"]);
  for (const auto& c : file["cases"]) {
    const std::vector<double> direction = flat(c["direction"]);
    const auto basis = reference::sh_basis<double>(3, {direction[0], direction[1], direction[2]});
    CHECK(relative_error(basis, flat(c["basis"])) <= kVectorTolerance);
    // the module's own function has float coefficients: rounding of 6e-8 in sums of 16 terms
    for (int degree = 0; degree <= 3; ++degree) {
      splat::Gaussians g;
      g.resize(1, 1, degree);
      for (std::size_t k = 0; k < g.sh.size(); ++k) g.sh[k] = static_cast<float>(coefficients[k]);
      const math::Vector3 color = splat::sh_color(g, 0, {direction[0], direction[1], direction[2]});
      CHECK(relative_error({color.data(), color.data() + 3}, flat(c["colour"][degree])) <= 1e-6);
    }
  }
}

TEST_CASE("the reference's SSIM, L1 and PSNR equal the vectors") {
  const auto file = vectors("ssim.json");
  const auto window = reference::ssim_window();
  CHECK(relative_error({window.begin(), window.end()}, flat(file["window"])) <= kVectorTolerance);
  for (const auto& c : file["cases"]) {
    const int width = c["width"], height = c["height"];
    const std::size_t pixels = static_cast<std::size_t>(width) * height;
    const std::vector<double> x = flat(c["x"]), y = flat(c["y"]);
    std::vector<double> map(3 * pixels), gradient(3 * pixels);
    for (int channel = 0; channel < 3; ++channel) {
      std::vector<reference::Variable> xs(pixels);
      std::vector<double> ys(pixels);
      for (std::size_t k = 0; k < pixels; ++k) {
        xs[k] = reference::independent(x[3 * k + channel]);
        ys[k] = y[3 * k + channel];
      }
      const std::size_t end = reference::tape().size();
      const auto s = reference::ssim_map(xs, ys, width, height);
      for (std::size_t k = 0; k < pixels; ++k) {
        map[3 * k + channel] = s[k].value;
        reference::tape().add(s[k].index, 1.0 / (3.0 * static_cast<double>(pixels)));
      }
      reference::tape().sweep(end);
      for (std::size_t k = 0; k < pixels; ++k) gradient[3 * k + channel] = reference::tape().adjoint(xs[k].index);
      reference::tape().forget(0);
    }
    CHECK(relative_error(map, flat(c["ssim_map"])) <= kVectorTolerance);
    CHECK(relative_error(gradient, flat(c["ssim_grad_x"])) <= kVectorTolerance);
    reference::Picture picture;
    reference::Target target{y, std::vector<double>(pixels, 1.0)};
    for (std::size_t k = 0; k < pixels; ++k)
      picture.rgba.insert(picture.rgba.end(), {x[3 * k], x[3 * k + 1], x[3 * k + 2], 1.0});
    const auto loss = reference::view_loss(picture.rgba, target, width, height, 0.0);
    CHECK(loss.l1 == doctest::Approx(c["l1"].get<double>()).epsilon(kVectorTolerance));
    CHECK(loss.ssim == doctest::Approx(c["ssim"].get<double>()).epsilon(kVectorTolerance));
    CHECK(0.8 * loss.l1 + 0.2 * (1.0 - loss.ssim) ==
          doctest::Approx(c["loss"].get<double>()).epsilon(kVectorTolerance));
    CHECK(reference::psnr_object(picture, target) ==
          doctest::Approx(c["psnr"].get<double>()).epsilon(kVectorTolerance));
  }
}

TEST_CASE("the tape's gradients are those of central differences: degree 3, mask term, active clamp, two views") {
  core::Random random(7);
  capture::Camera camera;
  camera.width = 14;
  camera.height = 10;
  camera.fx = 18;
  camera.fy = 17;
  camera.cx = 7.3;
  camera.cy = 4.6;
  camera.gain = {0.9, 1.2, 1.05};
  camera.bias = {0.03, -0.02, 0.01};
  reference::Parameters<double> g{3, 2, 3, {}, {}, {}, {}, {}, {}};
  const auto fill = [&](std::vector<double>& x, int count, double middle, double spread) {
    for (int k = 0; k < count; ++k) x.push_back(middle + spread * random.normal());
  };
  fill(g.mean, 9, 0.0, 0.05);
  g.mean[6] = 0.25;  // beyond 1.3 half images
  fill(g.rotation, 12, 0.3, 1.0);
  fill(g.log_scale, 9, std::log(0.06), 0.3);
  fill(g.opacity_logit, 3, 1.0, 0.5);
  fill(g.sh, 3 * 3 * 16, 0.1, 0.2);
  fill(g.link_logits, 6, 0.0, 0.7);
  std::vector<splat::ViewSpec> views;
  std::vector<reference::Target> targets;
  for (int k = 0; k < 2; ++k) {
    splat::ViewSpec view{&camera, k, 2 * k, 14 - 2 * k, 10 - 3 * k, {}};
    for (int j = 0; j < 2; ++j) {
      math::Vector6 twist;
      twist << 0.4 * k, -0.2 * j, 0.3, 0.02 * j, -0.01 * k, 0.4;
      view.motions.push_back(math::exp_se3(twist));
    }
    reference::Target target;
    for (int p = 0; p < view.width * view.height; ++p) {
      for (int c = 0; c < 3; ++c) target.rgb.push_back(random.uniform());
      target.mask.push_back(random.uniform());
    }
    views.push_back(view);
    targets.push_back(target);
  }
  const auto center = reference::project(
      g, views[0], {reference::motion<double>(views[0].motions[0]), reference::motion<double>(views[0].motions[1])},
      {});
  REQUIRE(std::any_of(center.begin(), center.end(),
                      [&](const auto& s) { return std::abs(s.center[0] - camera.cx) > 1.3 * 0.5 * camera.width; }));
  const splat::LossWeights weights{0.5f, 0.25f, 0.25f};
  const auto at = [&](const reference::Parameters<double>& p, std::span<const splat::ViewSpec> v) {
    return reference::loss(p, v, targets, weights, 0.0, reference::kNoCutoffs);
  };
  const auto got = reference::evaluate(g, views, targets, weights, 0.0, reference::kNoCutoffs);
  CHECK(got.total == doctest::Approx(at(g, views)).epsilon(1e-13));
  // the error of central differences is about h^2 of the third derivative plus 1e-16/h, each below 1e-9 of the largest
  // entry
  constexpr double kStep = 1e-5, kTolerance = 1e-6;
  for (int kind = 0; kind < 6; ++kind) {
    std::vector<double> differences;
    for (std::size_t k = 0; k < g.kinds()[kind]->size(); ++k) {
      double sides[2];
      for (const int side : {0, 1}) {
        auto moved = g;
        (*moved.kinds()[kind])[k] += side == 0 ? kStep : -kStep;
        sides[side] = at(moved, views);
      }
      differences.push_back((sides[0] - sides[1]) / (2.0 * kStep));
    }
    INFO(reference::kKindNames[kind]);
    CHECK(relative_error(*got.gradient.kinds()[kind], differences) <= kTolerance);
  }
  for (int v = 0; v < 2; ++v) {
    std::vector<double> differences;
    for (int m = 0; m < 12; ++m) {
      double sides[2];
      for (const int side : {0, 1}) {
        auto moved = views;
        math::Vector6 twist = math::Vector6::Zero();
        twist[m % 6] = side == 0 ? kStep : -kStep;
        moved[v].motions[m / 6] = math::exp_se3(twist) * moved[v].motions[m / 6];
        sides[side] = at(g, moved);
      }
      differences.push_back((sides[0] - sides[1]) / (2.0 * kStep));
    }
    const auto& twists = got.link_twists[v];
    CHECK(relative_error({twists.data(), twists.data() + 12}, differences) <= kTolerance);
  }
}
