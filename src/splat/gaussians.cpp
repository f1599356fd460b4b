#include <algorithm>
#include <cmath>

#include "chainsplat/image_model.h"
#include "chainsplat/splat.h"
#include "shaders/shared/gaussian.h"

namespace chainsplat::splat {

double brightness(const Light& light, const math::Vector3& normal) {
  if (!light.known()) return 1.0;
  return std::max(image_model::kLeastBrightness,
                  light.constant + light.linear.dot(normal) + normal.dot(light.quadratic * normal));
}

void Gaussians::resize(int new_count, int new_links, int new_degree) {
  CHAINSPLAT_CHECK(links == 0 || links == new_links, std::to_string(links));
  const int old_coefficients = sh_coefficients(), old_count = std::min(count, new_count);
  links = new_links;
  degree = new_degree;
  const int coefficients = sh_coefficients();
  std::vector<float> old_sh = std::move(sh);
  sh.assign(static_cast<std::size_t>(new_count) * coefficients * 3, 0.0f);
  for (int i = 0; i < old_count; ++i) {
    const int shared = 3 * std::min(coefficients, old_coefficients);
    std::copy_n(old_sh.begin() + 3 * old_coefficients * i, shared, sh.begin() + 3 * coefficients * i);
  }
  mean.resize(3 * new_count, 0.0f);
  log_scale.resize(3 * new_count, 0.0f);
  opacity_logit.resize(new_count, 0.0f);
  link_logits.resize(static_cast<std::size_t>(new_count) * links, 0.0f);
  rotation.resize(4 * new_count, 0.0f);
  guessed.resize(new_count, 0);
  for (int i = old_count; i < new_count; ++i) rotation[4 * i] = 1.0f;
  count = new_count;
}

void copy_row(const Gaussians& from, int i, Gaussians& to, int k) {
  const auto copy = [&](auto Gaussians::*values, int width) {
    std::copy_n((from.*values).begin() + static_cast<std::ptrdiff_t>(width) * i, width,
                (to.*values).begin() + static_cast<std::ptrdiff_t>(width) * k);
  };
  copy(&Gaussians::mean, 3);
  copy(&Gaussians::rotation, 4);
  copy(&Gaussians::log_scale, 3);
  copy(&Gaussians::opacity_logit, 1);
  copy(&Gaussians::sh, 3 * from.sh_coefficients());
  copy(&Gaussians::link_logits, from.links);
  copy(&Gaussians::guessed, 1);
}

Gaussians rows_of(const Gaussians& gaussians, std::span<const int> rows, int more) {
  Gaussians out;
  const int count = static_cast<int>(rows.size());
  out.resize(count + more, gaussians.links, gaussians.degree);
  out.light = gaussians.light;
  out.pixel_footprint = gaussians.pixel_footprint;
  for (int k = 0; k < count; ++k) copy_row(gaussians, rows[k], out, k);
  return out;
}

int surest_link(const Gaussians& gaussians, int index) {
  const auto first = gaussians.link_logits.begin() + static_cast<std::ptrdiff_t>(gaussians.links) * index;
  return static_cast<int>(std::max_element(first, first + gaussians.links) - first);
}

math::Vector3 sh_color(const Gaussians& gaussians, int index, const math::Vector3& r) {
  math::Vector3 color = math::Vector3::Constant(0.5);
  const int coefficients = gaussians.sh_coefficients();
  for (int l = 0; l < coefficients; ++l) {
    const double basis = shared::sh_basis(static_cast<unsigned>(l), {r.x(), r.y(), r.z()});
    for (int c = 0; c < 3; ++c) color[c] += basis * gaussians.sh[3 * (coefficients * index + l) + c];
  }
  return color.cwiseMax(0.0);
}

math::Vector3 base_color(const Gaussians& gaussians, int index) {
  const float* const sh = &gaussians.sh[3 * static_cast<std::size_t>(gaussians.sh_coefficients()) * index];
  return (math::Vector3::Constant(0.5) + image_model::kSh0 * math::Vector3(sh[0], sh[1], sh[2]))
      .cwiseMax(0.0)
      .cwiseMin(1.0);
}

void set_base_color(Gaussians& gaussians, int index, const math::Vector3& color) {
  float* const sh = &gaussians.sh[3 * static_cast<std::size_t>(gaussians.sh_coefficients()) * index];
  for (int c = 0; c < 3; ++c) sh[c] = static_cast<float>((color[c] - 0.5) / image_model::kSh0);
}

double brightness(const Gaussians& gaussians, int index, const math::Matrix3& rotation) {
  const math::Vector3& axis = gaussians.light.axis;
  const float* const mean = &gaussians.mean[3 * static_cast<std::size_t>(index)];
  const math::Vector3 at(mean[0], mean[1], mean[2]), off = at - at.dot(axis) * axis;
  return brightness(gaussians.light, rotation * off.normalized());
}

}  // namespace chainsplat::splat
