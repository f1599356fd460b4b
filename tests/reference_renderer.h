// reference_renderer.h - mathematics.md 2.4-2.8 in double on the host, pixel by pixel over all replicas: the reference
// for the device. Only the forward formulas are written down; gradients come from reverse-mode differentiation on a
// tape, so that no backward formula can share a mistake with the device's. Header only; for tests.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <numeric>
#include <span>
#include <utility>
#include <vector>

#include "chainsplat/image_model.h"
#include "chainsplat/splat.h"

namespace chainsplat::reference {

// --- reverse-mode differentiation ------------------------------------------------------------------------------------

// Every operation appends a node with its (at most two) operands and the derivatives with respect to them.
class Tape {
 public:
  int append(int a, double da, int b, double db) {
    nodes_.push_back({a, b, da, db});
    adjoints_.push_back(0.0);
    return static_cast<int>(nodes_.size()) - 1;
  }
  std::size_t size() const { return nodes_.size(); }
  void add(int index, double adjoint) {
    if (index >= 0) adjoints_[index] += adjoint;
  }
  double adjoint(int index) const { return index >= 0 ? adjoints_[index] : 0.0; }
  // Propagates the adjoints of the nodes from `first` on to their operands and removes those nodes.
  void sweep(std::size_t first) {
    for (std::size_t k = nodes_.size(); k-- > first;) {
      const double adjoint = adjoints_[k];
      if (adjoint == 0.0) continue;
      add(nodes_[k].a, adjoint * nodes_[k].da);
      add(nodes_[k].b, adjoint * nodes_[k].db);
    }
    forget(first);
  }
  void forget(std::size_t first) {
    nodes_.resize(first);
    adjoints_.resize(first);
  }

 private:
  struct Node {
    int a, b;
    double da, db;
  };
  std::vector<Node> nodes_;
  std::vector<double> adjoints_;
};

inline Tape& tape() {
  static Tape the_tape;
  return the_tape;
}

// A number on the tape; index -1 is a constant.
struct Variable {
  double value = 0.0;
  int index = -1;
  Variable() = default;
  Variable(double constant) : value(constant) {}  // implicit, so that formulas can mix constants with variables
  Variable(double v, int i) : value(v), index(i) {}
};

inline Variable independent(double value) { return {value, tape().append(-1, 0.0, -1, 0.0)}; }

inline Variable made(double value, const Variable& a, double da, const Variable& b, double db) {
  if (a.index < 0 && b.index < 0) return value;
  return {value, tape().append(a.index, da, b.index, db)};
}
inline Variable made(double value, const Variable& a, double da) { return made(value, a, da, {}, 0.0); }

inline Variable operator+(const Variable& a, const Variable& b) { return made(a.value + b.value, a, 1, b, 1); }
inline Variable operator-(const Variable& a, const Variable& b) { return made(a.value - b.value, a, 1, b, -1); }
inline Variable operator-(const Variable& a) { return made(-a.value, a, -1); }
inline Variable operator*(const Variable& a, const Variable& b) {
  return made(a.value * b.value, a, b.value, b, a.value);
}
inline Variable operator/(const Variable& a, const Variable& b) {
  return made(a.value / b.value, a, 1 / b.value, b, -a.value / (b.value * b.value));
}
inline Variable& operator+=(Variable& a, const Variable& b) { return a = a + b; }
inline Variable exp(const Variable& a) { return made(std::exp(a.value), a, std::exp(a.value)); }
inline Variable sqrt(const Variable& a) { return made(std::sqrt(a.value), a, 0.5 / std::sqrt(a.value)); }
inline Variable sin(const Variable& a) { return made(std::sin(a.value), a, std::cos(a.value)); }
inline Variable cos(const Variable& a) { return made(std::cos(a.value), a, -std::sin(a.value)); }
// The derivative at 0 is 0, as that of the device's sign().
inline Variable abs(const Variable& a) {
  return made(std::abs(a.value), a, a.value > 0 ? 1.0 : a.value < 0 ? -1.0 : 0.0);
}

inline double value(double a) { return a; }
inline double value(const Variable& a) { return a.value; }

// sum + weight * term, in one node
inline double plus_weighted(double sum, double weight, double term) { return sum + weight * term; }
inline Variable plus_weighted(const Variable& sum, double weight, const Variable& term) {
  return made(sum.value + weight * term.value, sum, 1.0, term, weight);
}

// --- scene -----------------------------------------------------------------------------------------------------------

template <class S>
using Vec3 = std::array<S, 3>;
template <class S>
using Mat3 = std::array<Vec3<S>, 3>;  // rows

template <class S>
Vec3<S> operator*(const Mat3<S>& a, const Vec3<S>& x) {
  Vec3<S> y;
  for (int r = 0; r < 3; ++r) y[r] = a[r][0] * x[0] + a[r][1] * x[1] + a[r][2] * x[2];
  return y;
}
template <class S>
Mat3<S> operator*(const Mat3<S>& a, const Mat3<S>& b) {
  Mat3<S> c;
  for (int r = 0; r < 3; ++r)
    for (int k = 0; k < 3; ++k) c[r][k] = a[r][0] * b[0][k] + a[r][1] * b[1][k] + a[r][2] * b[2][k];
  return c;
}
template <class S>
Mat3<S> transposed(const Mat3<S>& a) {
  Mat3<S> t;
  for (int r = 0; r < 3; ++r)
    for (int k = 0; k < 3; ++k) t[r][k] = a[k][r];
  return t;
}

template <class S>
struct Motion {  // x -> rotation x + translation
  Mat3<S> rotation;
  Vec3<S> translation;
};
template <class S>
Motion<S> motion(const math::Pose& pose) {
  Motion<S> m;
  for (int r = 0; r < 3; ++r) {
    for (int k = 0; k < 3; ++k) m.rotation[r][k] = S(pose.rotation(r, k));
    m.translation[r] = S(pose.translation[r]);
  }
  return m;
}
template <class S>
Motion<S> operator*(const Motion<S>& a, const Motion<S>& b) {
  Motion<S> c{a.rotation * b.rotation, a.rotation * b.translation};
  for (int r = 0; r < 3; ++r) c.translation[r] = c.translation[r] + a.translation[r];
  return c;
}

// splat::Gaussians with another scalar type, in the same layout.
template <class S>
struct Parameters {
  int count = 0, links = 0, degree = 0;
  std::vector<S> mean, rotation, log_scale, opacity_logit, sh, link_logits;
  splat::Light light = {};
  double pixel_footprint = 0.0;  // m
  int coefficients() const { return (degree + 1) * (degree + 1); }
  std::array<std::vector<S>*, 6> kinds() { return {&mean, &rotation, &log_scale, &opacity_logit, &sh, &link_logits}; }
  std::array<const std::vector<S>*, 6> kinds() const {
    return {&mean, &rotation, &log_scale, &opacity_logit, &sh, &link_logits};
  }
};
constexpr std::array<const char*, 6> kKindNames{"mean", "rotation", "log_scale", "opacity_logit", "sh", "link_logits"};

inline Parameters<double> parameters(const splat::Gaussians& g) {
  const auto wide = [](const std::vector<float>& x) { return std::vector<double>(x.begin(), x.end()); };
  return {g.count,
          g.links,
          g.degree,
          wide(g.mean),
          wide(g.rotation),
          wide(g.log_scale),
          wide(g.opacity_logit),
          wide(g.sh),
          wide(g.link_logits),
          g.light,
          g.pixel_footprint};
}

// The discrete rules of mathematics.md 2.5 and 2.6, each of which can be switched off.
struct Rules {
  bool skip = true;   // entries with alpha < 1/255
  bool cap = true;    // alpha is at most 0.99
  bool stop = true;   // before T falls below 1e-4
  bool clamp = true;  // x/z and y/z in the projection's Jacobian, at 1.3 half images
};
constexpr Rules kNoCutoffs{false, false, false, true};
constexpr double kLeastAlpha = 1.0 / 255.0, kMostAlpha = 0.99, kLeastTransmittance = 1e-4;

// E_j at theta: T_b exp([S_1] theta_1) ... with axes of unit length (mathematics.md 2.2), by Rodrigues' formula.
template <class S>
std::vector<Motion<S>> link_motions(const std::vector<math::Vector6>& axes, const std::vector<S>& theta,
                                    const math::Pose& base) {
  using std::cos;
  using std::sin;
  std::vector<Motion<S>> motions{motion<S>(base)};
  for (std::size_t k = 0; k < axes.size(); ++k) {
    const math::Vector3 w = axes[k].head<3>(), v = axes[k].tail<3>();
    const math::Matrix3 W = math::hat(w), WW = W * W;
    const S s = sin(theta[k]), c = S(1.0) - cos(theta[k]), rest = theta[k] - s;
    Motion<S> e;
    const math::Vector3 wv = W * v, wwv = WW * v;
    for (int r = 0; r < 3; ++r) {
      for (int m = 0; m < 3; ++m) e.rotation[r][m] = S(r == m ? 1.0 : 0.0) + S(W(r, m)) * s + S(WW(r, m)) * c;
      e.translation[r] = S(v[r]) * theta[k] + S(wv[r]) * c + S(wwv[r]) * rest;
    }
    motions.push_back(motions.back() * e);
  }
  return motions;
}

// --- forward ---------------------------------------------------------------------------------------------------------

// Of the side of the rope that Gaussian i is on (mathematics.md 2.4).
template <class S>
S brightness(const Parameters<S>& g, int i, const Motion<S>& motion) {
  using std::sqrt;
  if (!g.light.known()) return S(1.0);
  const math::Vector3& axis = g.light.axis;
  const S along = g.mean[3 * i] * axis[0] + g.mean[3 * i + 1] * axis[1] + g.mean[3 * i + 2] * axis[2];
  Vec3<S> off;
  for (int k = 0; k < 3; ++k) off[k] = g.mean[3 * i + k] - along * axis[k];
  const S radius = sqrt(off[0] * off[0] + off[1] * off[1] + off[2] * off[2]);
  const Vec3<S> n = motion.rotation * Vec3<S>{off[0] / radius, off[1] / radius, off[2] / radius};
  S light(g.light.constant);
  for (int r = 0; r < 3; ++r) {
    light += n[r] * g.light.linear[r];
    for (int k = 0; k < 3; ++k) light += n[r] * n[k] * g.light.quadratic(r, k);
  }
  return value(light) > image_model::kLeastBrightness ? light : S(image_model::kLeastBrightness);
}

// Real spherical harmonics in the order and signs of 3DGS (design.md, 'Reference vectors'); r is a unit vector.
template <class S>
std::vector<S> sh_basis(int degree, const Vec3<S>& r) {
  const S x = r[0], y = r[1], z = r[2], xx = x * x, yy = y * y, zz = z * z;
  const double pi = 3.14159265358979323846;
  const double c0 = std::sqrt(1 / (4 * pi)), c1 = std::sqrt(3 / (4 * pi));
  std::vector<S> b{S(c0)};
  if (degree >= 1)
    for (const S& e : {-c1 * y, c1 * z, -c1 * x}) b.push_back(e);
  if (degree >= 2) {
    const double a = std::sqrt(15 / (4 * pi)), d = std::sqrt(5 / (16 * pi)), e = std::sqrt(15 / (16 * pi));
    for (const S& term : {a * x * y, -a * y * z, d * (2.0 * zz - xx - yy), -a * x * z, e * (xx - yy)})
      b.push_back(term);
  }
  if (degree >= 3) {
    const double a = std::sqrt(35 / (32 * pi)), d = std::sqrt(105 / (4 * pi)), e = std::sqrt(21 / (32 * pi));
    const double f = std::sqrt(7 / (16 * pi)), g = std::sqrt(105 / (16 * pi));
    for (const S& term : {-a * y * (3.0 * xx - yy), d * x * y * z, -e * y * (4.0 * zz - xx - yy),
                          f * z * (2.0 * zz - 3.0 * xx - 3.0 * yy), -e * x * (4.0 * zz - xx - yy), g * z * (xx - yy),
                          -a * x * (xx - 3.0 * yy)})
      b.push_back(term);
  }
  return b;
}

// A replica projected into one view; `center` is in pixels of the crop.
template <class S>
struct Splat {
  int replica = 0;  // gaussian * links + link
  std::array<S, 2> center;
  std::array<S, 3> covariance;  // xx, xy, yy with the low pass, px^2
  std::array<S, 3> conic;       // inverse of it
  Vec3<S> color;
  S opacity, depth;
};

// All replicas that are in front of the camera, in blending order.
template <class S>
std::vector<Splat<S>> project(const Parameters<S>& g, const splat::ViewSpec& view,
                              const std::vector<Motion<S>>& motions, const Rules& rules) {
  using std::exp;
  using std::sqrt;
  constexpr double kNear = 0.01, kLowPass = 0.3, kClamp = 1.3;  // m, px^2, half images (mathematics.md 2.5)
  constexpr double kLeastFootprint = 0.6;                       // px
  const capture::Camera& camera = *view.camera;
  const Motion<S> camera_from_world = motion<S>(camera.world_from_camera.inverse());
  const double limit_x = kClamp * 0.5 * camera.width / camera.fx, limit_y = kClamp * 0.5 * camera.height / camera.fy;
  std::vector<Splat<S>> splats;
  for (int i = 0; i < g.count; ++i) {
    const S opacity = S(1.0) / (S(1.0) + exp(-g.opacity_logit[i]));
    std::vector<S> share(g.links);  // softmax
    double largest = value(g.link_logits[g.links * i]);
    for (int j = 0; j < g.links; ++j) largest = std::max(largest, value(g.link_logits[g.links * i + j]));
    S sum(0.0);
    for (int j = 0; j < g.links; ++j) {
      share[j] = exp(g.link_logits[g.links * i + j] - largest);
      sum += share[j];
    }
    const S* q = &g.rotation[4 * i];
    const S size = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    const S w = q[0] / size, x = q[1] / size, y = q[2] / size, z = q[3] / size;
    const Mat3<S> rotation{{{S(1.0) - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)},
                            {2.0 * (x * y + w * z), S(1.0) - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)},
                            {2.0 * (x * z - w * y), 2.0 * (y * z + w * x), S(1.0) - 2.0 * (x * x + y * y)}}};
    Mat3<S> variance{};  // diag(s^2)
    for (int k = 0; k < 3; ++k) variance[k][k] = exp(2.0 * g.log_scale[3 * i + k]);
    const Mat3<S> home_covariance = rotation * variance * transposed(rotation);
    for (int j = 0; j < g.links; ++j) {
      const Motion<S> from_home = camera_from_world * motions[j];
      Vec3<S> p = from_home.rotation * Vec3<S>{g.mean[3 * i], g.mean[3 * i + 1], g.mean[3 * i + 2]};
      for (int r = 0; r < 3; ++r) p[r] = p[r] + from_home.translation[r];
      if (value(p[2]) < kNear) continue;
      Splat<S> s;
      s.replica = g.links * i + j;
      s.opacity = opacity * (share[j] / sum);
      s.depth = p[2];
      S slope_x = p[0] / p[2], slope_y = p[1] / p[2];
      s.center = {camera.fx * slope_x + (camera.cx - view.x0), camera.fy * slope_y + (camera.cy - view.y0)};
      if (rules.clamp && std::abs(value(slope_x)) > limit_x) slope_x = S(value(slope_x) > 0 ? limit_x : -limit_x);
      if (rules.clamp && std::abs(value(slope_y)) > limit_y) slope_y = S(value(slope_y) > 0 ? limit_y : -limit_y);
      const Mat3<S> covariance = from_home.rotation * home_covariance * transposed(from_home.rotation);
      const Vec3<S> row_x{camera.fx / p[2], S(0.0), -camera.fx * slope_x / p[2]};
      const Vec3<S> row_y{S(0.0), camera.fy / p[2], -camera.fy * slope_y / p[2]};
      const Vec3<S> cx = covariance * row_x, cy = covariance * row_y;
      const auto dot = [](const Vec3<S>& a, const Vec3<S>& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; };
      const auto low_pass = [&](double focal) {
        if (g.pixel_footprint == 0.0) return S(kLowPass);
        const S footprint = g.pixel_footprint * focal / p[2];
        return kLowPass *
               (value(footprint) > kLeastFootprint ? footprint * footprint : S(kLeastFootprint * kLeastFootprint));
      };
      s.covariance = {dot(row_x, cx) + low_pass(camera.fx), dot(row_x, cy), dot(row_y, cy) + low_pass(camera.fy)};
      const S determinant = s.covariance[0] * s.covariance[2] - s.covariance[1] * s.covariance[1];
      s.conic = {s.covariance[2] / determinant, -s.covariance[1] / determinant, s.covariance[0] / determinant};
      // color in the direction from the camera center, in the home frame
      const S distance = sqrt(dot(p, p));
      const Vec3<S> direction =
          transposed(from_home.rotation) * Vec3<S>{p[0] / distance, p[1] / distance, p[2] / distance};
      const std::vector<S> basis = sh_basis(g.degree, direction);
      const S light = brightness(g, i, motions[j]);
      for (int c = 0; c < 3; ++c) {
        S color(0.5);
        for (int l = 0; l < g.coefficients(); ++l) color += basis[l] * g.sh[3 * (g.coefficients() * i + l) + c];
        color = color * light * camera.gain[c] + S(camera.bias[c]);
        s.color[c] = value(color) > 0.0 ? color : S(0.0);
        if (value(color) > splat::recorded_white(camera)) s.color[c] = S(1.0);
      }
      splats.push_back(s);
    }
  }
  std::stable_sort(splats.begin(), splats.end(),
                   [](const Splat<S>& a, const Splat<S>& b) { return value(a.depth) < value(b.depth); });
  return splats;
}

// Whether float and double may decide a discrete rule of a pixel differently, and how much its values can then differ.
struct Doubt {
  // relative widths of the bands in doubt: alpha at the skip, at the cap, transmittance at the stop, depths of
  // neighbors
  double skip = 2e-4, cap = 2e-4, stop = 5e-3, order = 6e-7;
  double change = 0.0;  // bound on the change of a channel (color or alpha)
  bool doubtful = false;
};

template <class S>
struct Pixel {
  Vec3<S> color;
  S alpha, depth_sum;
};

template <class S>
Pixel<S> blend(const std::vector<Splat<S>>& splats, double px, double py, const Rules& rules, Doubt* doubt = nullptr) {
  using std::exp;
  constexpr double kNothing = 200.0;  // exp(-200) vanishes in any sum of doubles here
  struct Blended {
    const Splat<S>* splat;
    double alpha, transmittance;
  };
  std::vector<Blended> blended;
  Pixel<S> pixel{{S(0.0), S(0.0), S(0.0)}, S(0.0), S(0.0)};
  S transmittance(1.0);
  for (const Splat<S>& s : splats) {
    const double u = px - value(s.center[0]), v = py - value(s.center[1]);
    const double power = 0.5 * (value(s.conic[0]) * u * u + value(s.conic[2]) * v * v) + value(s.conic[1]) * u * v;
    if (power > kNothing) continue;
    const double free_alpha = value(s.opacity) * std::exp(-power), T = value(transmittance);
    const double brightest = std::max({1.0, value(s.color[0]), value(s.color[1]), value(s.color[2])});
    if (doubt && rules.skip && std::abs(free_alpha / kLeastAlpha - 1.0) < doubt->skip) {
      doubt->doubtful = true;
      doubt->change += T * free_alpha * brightest;
    }
    if (rules.skip && free_alpha < kLeastAlpha) continue;
    if (doubt && rules.cap && std::abs(free_alpha / kMostAlpha - 1.0) < doubt->cap) doubt->doubtful = true;
    const bool capped = rules.cap && free_alpha > kMostAlpha;
    const double after = T * (1.0 - (capped ? kMostAlpha : free_alpha));
    if (doubt && rules.stop && std::abs(after / kLeastTransmittance - 1.0) < doubt->stop) {
      doubt->doubtful = true;
      doubt->change += T * brightest;
    }
    if (rules.stop && after < kLeastTransmittance) break;
    if (doubt) {
      // two neighbors in depth that may change places (equal depths are ordered by index in float too)
      for (std::size_t k = blended.size(); k-- > 0;) {
        const Blended& other = blended[k];
        const double gap = (value(s.depth) - value(other.splat->depth)) / value(s.depth);
        if (gap > doubt->order) break;
        double difference = 0.0;
        for (int c = 0; c < 3; ++c)
          difference = std::max(difference, std::abs(value(s.color[c]) - value(other.splat->color[c])));
        if (gap == 0.0 || difference == 0.0) continue;
        doubt->doubtful = true;
        doubt->change += other.transmittance * other.alpha * free_alpha * difference;
      }
      blended.push_back({&s, free_alpha, T});
    }
    const S dx = px - s.center[0], dy = py - s.center[1];
    const S alpha = capped
                        ? S(kMostAlpha)
                        : s.opacity * exp(-0.5 * (s.conic[0] * dx * dx + s.conic[2] * dy * dy) - s.conic[1] * dx * dy);
    const S weight = alpha * transmittance;
    for (int c = 0; c < 3; ++c) pixel.color[c] += weight * s.color[c];
    pixel.depth_sum += weight * s.depth;
    transmittance = transmittance * (S(1.0) - alpha);
  }
  pixel.alpha = S(1.0) - transmittance;
  return pixel;
}

// --- loss ------------------------------------------------------------------------------------------------------------

inline std::array<double, 11> ssim_window() {
  std::array<double, 11> w{};
  double sum = 0.0;
  for (int k = 0; k < 11; ++k) sum += w[k] = std::exp(-(k - 5) * (k - 5) / (2.0 * 1.5 * 1.5));
  for (double& x : w) x /= sum;
  return w;
}

// One channel of width x height filtered by the window, with zeros outside.
template <class S>
std::vector<S> filtered(const std::vector<S>& image, int width, int height) {
  static const std::array<double, 11> w = ssim_window();
  std::vector<S> rows(image.size()), out(image.size());
  for (const bool along_x : {true, false}) {
    const std::vector<S>& from = along_x ? image : rows;
    std::vector<S>& to = along_x ? rows : out;
    for (int y = 0; y < height; ++y) {
      for (int x = 0; x < width; ++x) {
        S sum(0.0);
        for (int k = -5; k <= 5; ++k) {
          const int xx = along_x ? x + k : x, yy = along_x ? y : y + k;
          if (xx >= 0 && xx < width && yy >= 0 && yy < height)
            sum = plus_weighted(sum, w[k + 5], from[static_cast<std::size_t>(yy) * width + xx]);
        }
        to[static_cast<std::size_t>(y) * width + x] = sum;
      }
    }
  }
  return out;
}

// SSIM of each pixel of one channel (mathematics.md 2.7); x is the render, y the target.
template <class S>
std::vector<S> ssim_map(const std::vector<S>& x, const std::vector<double>& y, int width, int height) {
  constexpr double c1 = 0.01 * 0.01, c2 = 0.03 * 0.03;
  std::vector<S> xx(x.size()), xy(x.size()), map(x.size());
  std::vector<double> yy(x.size());
  for (std::size_t k = 0; k < x.size(); ++k) {
    xx[k] = x[k] * x[k];
    xy[k] = x[k] * y[k];
    yy[k] = y[k] * y[k];
  }
  const std::vector<S> mx = filtered(x, width, height), sxx = filtered(xx, width, height),
                       sxy = filtered(xy, width, height);
  const std::vector<double> my = filtered(y, width, height), syy = filtered(yy, width, height);
  for (std::size_t k = 0; k < x.size(); ++k) {
    const S a1 = 2.0 * mx[k] * my[k] + c1, a2 = 2.0 * (sxy[k] - mx[k] * my[k]) + c2;
    const S b1 = mx[k] * mx[k] + my[k] * my[k] + c1, b2 = (sxx[k] - mx[k] * mx[k]) + (syy[k] - my[k] * my[k]) + c2;
    map[k] = a1 * a2 / (b1 * b2);
  }
  return map;
}

struct Target {              // of one crop
  std::vector<double> rgb;   // 3 x pixels, 0..1
  std::vector<double> mask;  // pixels, 0..1
};
inline Target target(const std::vector<std::uint8_t>& rgba) {
  Target t;
  for (std::size_t k = 0; k < rgba.size(); ++k) (k % 4 == 3 ? t.mask : t.rgb).push_back(rgba[k] / 255.0);
  return t;
}

template <class S>
struct ViewLoss {
  S l1, ssim, mask;  // means over `normalizer` pixels
};
// `rgba` is 4 x pixels. A normalizer of 0 means the number of pixels of the crop.
template <class S>
ViewLoss<S> view_loss(const std::vector<S>& rgba, const Target& wanted, int width, int height, double normalizer,
                      double background = 0.0) {
  using std::abs;
  const std::size_t pixels = rgba.size() / 4;
  if (normalizer <= 0.0) normalizer = std::max<double>(1.0, static_cast<double>(pixels));
  S l1(0.0), dissimilarity(0.0), mask(0.0);
  for (int c = 0; c < 3; ++c) {
    std::vector<S> x(pixels);
    std::vector<double> y(pixels);
    for (std::size_t k = 0; k < pixels; ++k) {
      x[k] = rgba[4 * k + c] + background * (S(1.0) - rgba[4 * k + 3]);
      y[k] = wanted.rgb[3 * k + c] + background * (1.0 - wanted.mask[k]);
      l1 += abs(x[k] - y[k]);
    }
    for (const S& s : ssim_map(x, y, width, height)) dissimilarity += 1.0 - s;
  }
  for (std::size_t k = 0; k < pixels; ++k) mask += abs(rgba[4 * k + 3] - wanted.mask[k]);
  return {l1 / (3.0 * normalizer), S(1.0) - dissimilarity / (3.0 * normalizer), mask / normalizer};
}

// --- pictures, losses and gradients of some views --------------------------------------------------------------------

struct Picture {
  int width = 0, height = 0;
  std::vector<double> rgba, depth;  // as splat::Picture
  std::vector<double> change;       // Doubt::change per pixel
  std::vector<std::uint8_t> doubtful;
  int doubtful_count() const { return std::accumulate(doubtful.begin(), doubtful.end(), 0); }
};

inline Splat<double> values(const Splat<Variable>& s) {
  Splat<double> out;
  out.replica = s.replica;
  for (int k = 0; k < 2; ++k) out.center[k] = s.center[k].value;
  for (int k = 0; k < 3; ++k) {
    out.covariance[k] = s.covariance[k].value;
    out.conic[k] = s.conic[k].value;
    out.color[k] = s.color[k].value;
  }
  out.opacity = s.opacity.value;
  out.depth = s.depth.value;
  return out;
}

inline Picture picture(const std::vector<Splat<double>>& splats, int width, int height, const Rules& rules) {
  Picture out;
  out.width = width;
  out.height = height;
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x) {
      Doubt doubt;
      const Pixel<double> pixel = blend(splats, x + 0.5, y + 0.5, rules, &doubt);
      out.rgba.insert(out.rgba.end(), {pixel.color[0], pixel.color[1], pixel.color[2], pixel.alpha});
      out.depth.push_back(pixel.alpha > 0.5 ? pixel.depth_sum / pixel.alpha : 0.0);
      out.change.push_back(doubt.change);
      out.doubtful.push_back(doubt.doubtful ? 1 : 0);
    }
  }
  return out;
}

inline Picture draw(const Parameters<double>& g, const splat::ViewSpec& view, const Rules& rules = {}) {
  std::vector<Motion<double>> motions;
  for (const math::Pose& pose : view.motions) motions.push_back(motion<double>(pose));
  return picture(project(g, view, motions, rules), view.width, view.height, rules);
}

struct Evaluation {
  double total = 0.0;  // summed over views
  std::vector<ViewLoss<double>> losses;
  std::vector<Picture> pictures;
  Parameters<double> gradient;                      // summed over views
  std::vector<math::MatrixX> link_twists;           // 6 x links per view
  std::vector<std::vector<double>> image_gradient;  // 4 x pixels per view
};

// `own_motions`, if set, returns the link motions of every view (instead of ViewSpec::motions) as numbers on the tape.
template <class MakeMotions>
Evaluation evaluate(const Parameters<double>& g, std::span<const splat::ViewSpec> views,
                    std::span<const Target> targets, const splat::LossWeights& weights, double normalizer,
                    const Rules& rules, MakeMotions own_motions) {
  Tape& t = tape();
  const std::size_t bottom = t.size();
  Parameters<Variable> v{g.count, g.links, g.degree, {}, {}, {}, {}, {}, {}, g.light, g.pixel_footprint};
  for (int kind = 0; kind < 6; ++kind)
    for (const double x : *g.kinds()[kind]) v.kinds()[kind]->push_back(independent(x));
  Evaluation out;
  for (std::size_t k = 0; k < views.size(); ++k) {
    const splat::ViewSpec& view = views[k];
    // apply a twist of zero size about the world origin to every link motion, e^[xi] E_j, to differentiate by it
    const std::size_t view_start = t.size();
    std::vector<Variable> twist;
    for (int m = 0; m < 6 * g.links; ++m) twist.push_back(independent(0.0));
    const std::vector<Motion<Variable>> unturned = own_motions(view);
    std::vector<Motion<Variable>> motions;
    for (int j = 0; j < g.links; ++j) {
      const Variable* xi = &twist[6 * j];
      const Motion<Variable> turn{{{{1.0, -xi[2], xi[1]}, {xi[2], 1.0, -xi[0]}, {-xi[1], xi[0], 1.0}}},
                                  {xi[3], xi[4], xi[5]}};
      motions.push_back(turn * unturned[j]);
    }
    const std::vector<Splat<Variable>> splats = project(v, view, motions, rules);
    std::vector<Splat<double>> plain;
    for (const Splat<Variable>& s : splats) plain.push_back(values(s));
    out.pictures.push_back(picture(plain, view.width, view.height, rules));

    const std::size_t image_start = t.size();
    std::vector<Variable> image;
    for (const double x : out.pictures.back().rgba) image.push_back(independent(x));
    const std::size_t image_end = t.size();
    const ViewLoss<Variable> loss =
        view_loss(image, targets[k], view.width, view.height, normalizer, weights.background);
    const Variable total = static_cast<double>(weights.l1) * loss.l1 +
                           static_cast<double>(weights.dssim) * (1.0 - loss.ssim) +
                           static_cast<double>(weights.mask) * loss.mask;
    out.total += total.value;
    out.losses.push_back({loss.l1.value, loss.ssim.value, loss.mask.value});
    t.add(total.index, 1.0);
    t.sweep(image_end);
    std::vector<double> gamma;
    for (const Variable& x : image) gamma.push_back(t.adjoint(x.index));
    t.forget(image_start);

    for (int y = 0; y < view.height; ++y) {
      for (int x = 0; x < view.width; ++x) {
        const double* wanted = &gamma[4 * (static_cast<std::size_t>(y) * view.width + x)];
        const Pixel<Variable> pixel = blend(splats, x + 0.5, y + 0.5, rules);
        for (int c = 0; c < 3; ++c) t.add(pixel.color[c].index, wanted[c]);
        t.add(pixel.alpha.index, wanted[3]);
        t.sweep(image_start);
      }
    }
    out.image_gradient.push_back(std::move(gamma));
    t.sweep(view_start + twist.size());
    math::MatrixX twists(6, g.links);
    for (int m = 0; m < 6 * g.links; ++m) twists(m % 6, m / 6) = t.adjoint(twist[m].index);
    out.link_twists.push_back(std::move(twists));
    t.forget(view_start);
  }
  out.gradient = {g.count, g.links, g.degree, {}, {}, {}, {}, {}, {}};
  for (int kind = 0; kind < 6; ++kind)
    for (const Variable& x : *v.kinds()[kind]) out.gradient.kinds()[kind]->push_back(t.adjoint(x.index));
  t.forget(bottom);
  return out;
}

inline Evaluation evaluate(const Parameters<double>& g, std::span<const splat::ViewSpec> views,
                           std::span<const Target> targets, const splat::LossWeights& weights, double normalizer,
                           const Rules& rules = {}) {
  return evaluate(g, views, targets, weights, normalizer, rules, [](const splat::ViewSpec& view) {
    std::vector<Motion<Variable>> motions;
    for (const math::Pose& pose : view.motions) motions.push_back(motion<Variable>(pose));
    return motions;
  });
}

// The loss without a gradient, for finite differences.
inline double loss(const Parameters<double>& g, std::span<const splat::ViewSpec> views, std::span<const Target> targets,
                   const splat::LossWeights& weights, double normalizer, const Rules& rules) {
  double total = 0.0;
  for (std::size_t k = 0; k < views.size(); ++k) {
    const Picture drawn = draw(g, views[k], rules);
    const ViewLoss<double> l =
        view_loss(drawn.rgba, targets[k], drawn.width, drawn.height, normalizer, weights.background);
    total += weights.l1 * l.l1 + weights.dssim * (1.0 - l.ssim) + weights.mask * l.mask;
  }
  return total;
}

// dB over pixels whose mask is at least 128/255, with renders clamped to [0, 1] (mathematics.md 9).
inline double psnr_object(const Picture& drawn, const Target& wanted) {
  double squared = 0.0, count = 0.0;
  for (std::size_t k = 0; k < wanted.mask.size(); ++k) {
    if (wanted.mask[k] < 127.5 / 255.0) continue;
    for (int c = 0; c < 3; ++c)
      squared += std::pow(std::clamp(drawn.rgba[4 * k + c], 0.0, 1.0) - wanted.rgb[3 * k + c], 2);
    count += 3.0;
  }
  return -10.0 * std::log10(squared / count);
}

}  // namespace chainsplat::reference
