// NumPy's .npz: a zip archive of .npy arrays, stored as they are.
#include <zlib.h>

#include <cmath>

#include "chainsplat/export.h"
#include "chainsplat/image_model.h"
#include "little_endian.h"
#include "scripts.h"

namespace chainsplat::exports {

using math::MatrixX;

namespace {

// A zip archive of stored members, below 4 GiB; dates are 1 January 1980, so that the same twin gives the same bytes.
class Archive {
 public:
  void add(const std::string& name, const std::string& bytes) {
    const auto crc =
        static_cast<std::uint32_t>(::crc32_z(0, reinterpret_cast<const unsigned char*>(bytes.data()), bytes.size()));
    const auto offset = static_cast<std::uint32_t>(data_.size());
    const std::string shared = common(name, crc, static_cast<std::uint32_t>(bytes.size()));
    put<std::uint32_t>(data_, 0x04034b50);
    data_ += shared + name + bytes;
    put<std::uint32_t>(directory_, 0x02014b50);
    put<std::uint16_t>(directory_, 20);  // made by version 2.0
    directory_ += shared;
    directory_.append(10, '\0');  // comment, disk, attributes
    put<std::uint32_t>(directory_, offset);
    directory_ += name;
    ++members_;
  }
  std::string finish() {
    const auto start = static_cast<std::uint32_t>(data_.size()), size = static_cast<std::uint32_t>(directory_.size());
    data_ += directory_;
    put<std::uint32_t>(data_, 0x06054b50);
    put<std::uint32_t>(data_, 0);  // disks
    put<std::uint16_t>(data_, members_);
    put<std::uint16_t>(data_, members_);
    put<std::uint32_t>(data_, size);
    put<std::uint32_t>(data_, start);
    put<std::uint16_t>(data_, 0);  // comment
    return std::move(data_);
  }

 private:
  // What the local and the central header of a member share: version to the lengths of name and extra field.
  static std::string common(const std::string& name, std::uint32_t crc, std::uint32_t size) {
    constexpr std::uint16_t kFirstDay = 1 << 5 | 1;
    std::string out;
    for (const std::uint16_t each :
         {std::uint16_t{20}, std::uint16_t{0}, std::uint16_t{0}, std::uint16_t{0}, kFirstDay})
      put(out, each);  // version, flags, stored, time, date
    for (const std::uint32_t each : {crc, size, size}) put(out, each);
    put(out, static_cast<std::uint16_t>(name.size()));
    put<std::uint16_t>(out, 0);
    return out;
  }
  std::string data_, directory_;
  std::uint16_t members_ = 0;
};

// The bytes of a .npy: magic, version 1.0, a header padded to 64 bytes, the data in C order.
std::string npy(const std::string& type, const std::vector<std::size_t>& shape, const std::string& data) {
  std::string text = "{'descr': '" + type + "', 'fortran_order': False, 'shape': (";
  for (const std::size_t size : shape) text += std::to_string(size) + ",";
  text += "), }";
  constexpr std::size_t kBefore = 10, kBlock = 64;  // bytes of magic, version and length
  text.append(kBlock - (kBefore + text.size() + 1) % kBlock, ' ').append("\n");
  std::string out("\x93NUMPY\x01\x00", 8);
  put(out, static_cast<std::uint16_t>(text.size()));
  return out + text + data;
}

class Arrays {
 public:
  template <class Number, class Values>
  void add(const std::string& name, const std::vector<std::size_t>& shape, const Values& values, const char* type) {
    std::string data;
    for (const auto& value : values) put(data, static_cast<Number>(value));
    std::size_t count = 1;
    for (const std::size_t size : shape) count *= size;
    CHAINSPLAT_CHECK(data.size() == count * sizeof(Number), name);
    archive_.add(name + ".npy", npy(type, shape, data));
  }
  template <class Values>
  void numbers(const std::string& name, const std::vector<std::size_t>& shape, const Values& values) {
    add<double>(name, shape, values, "<f8");
  }
  void number(const std::string& name, double value) { numbers(name, {}, std::vector<double>{value}); }
  void floats(const std::string& name, const std::vector<std::size_t>& shape, const std::vector<float>& values) {
    add<float>(name, shape, values, "<f4");
  }
  // ASCII texts of one length, padded by zeros
  void texts(const std::string& name, const std::vector<std::string>& values) {
    std::size_t longest = 1;
    for (const std::string& value : values) longest = std::max(longest, value.size());
    std::string data;
    for (const std::string& value : values)
      for (std::size_t i = 0; i < longest; ++i)
        put(data, static_cast<std::uint32_t>(i < value.size() ? static_cast<unsigned char>(value[i]) : 0u));
    archive_.add(name + ".npy", npy("<U" + std::to_string(longest), {values.size()}, data));
  }
  std::string finish() { return archive_.finish(); }

 private:
  Archive archive_;
};

template <class Vectors>
std::vector<double> flat(const Vectors& vectors) {
  std::vector<double> out;
  for (const auto& each : vectors)
    for (Eigen::Index row = 0; row < each.rows(); ++row)
      for (Eigen::Index column = 0; column < each.cols(); ++column) out.push_back(each(row, column));
  return out;
}

MatrixX matrix(const math::Pose& pose) {
  MatrixX out = MatrixX::Identity(4, 4);
  out.topLeftCorner(3, 3) = pose.rotation;
  out.topRightCorner(3, 1) = pose.translation;
  return out;
}

// `prefix`: "" for the motion asked for, "rollout_".
void add_motion(Arrays& arrays, const std::string& prefix, const chain::Chain& chain, const chain::States& states,
                const trajectory::Trajectory& base) {
  const std::size_t frames = states.time.size(), angles = chain.angles(), links = chain.links();
  arrays.numbers(prefix + "time", {frames}, states.time);
  arrays.numbers(prefix + "theta", {frames, angles}, flat(states.theta));
  if (!states.thetadot.empty()) arrays.numbers(prefix + "thetadot", {frames, angles}, flat(states.thetadot));
  if (!states.roll.empty()) arrays.numbers(prefix + "roll", {frames, links}, flat(states.roll));
  if (!states.covariance.empty())
    arrays.numbers(prefix + "theta_covariance", {frames, angles, angles}, flat(states.covariance));
  std::vector<MatrixX> bases, poses;
  for (std::size_t k = 0; k < frames; ++k) {
    const math::Pose at = base.samples().empty() ? math::Pose() : base.pose(states.time[k]);
    bases.push_back(matrix(at));
    const std::vector<math::Pose> motions = chain::link_motions(chain, states.theta[k], at);
    for (int j = 0; j < chain.links(); ++j)
      poses.push_back(
          matrix(motions[j] * math::Pose{math::Matrix3::Identity(), chain.link_start(j) * chain.direction}));
  }
  arrays.numbers(prefix + "base_pose", {frames, 4, 4}, flat(bases));
  arrays.numbers(prefix + "link_pose", {frames, links, 4, 4}, flat(poses));
}

void add_chain(Arrays& arrays, const twin::Twin& twin) {
  const chain::Chain& chain = twin.chain;
  const std::size_t angles = chain.angles(), links = chain.links();
  std::vector<double> starts;
  for (int j = 0; j < chain.links(); ++j) starts.push_back(chain.link_start(j));
  arrays.number("length", chain.length);
  arrays.number("diameter", chain.diameter);
  arrays.numbers("direction", {3}, chain.direction);
  arrays.numbers("bending_axis", {3}, chain.bending_axis);
  arrays.numbers("axes", {angles, 6}, flat(chain.axes));
  arrays.add<std::int64_t>("child_link", {angles}, chain.child_link, "<i8");
  arrays.numbers("link_start", {links}, starts);
  if (!chain.lift.empty()) arrays.numbers("link_lift", {links}, chain.lift);
  arrays.numbers("gravity", {3}, twin.gravity);
  if (twin.tabletop) {
    arrays.numbers("table_point", {3}, twin.table_point.value_or(math::Vector3::Zero()));
    arrays.numbers("table_normal", {3}, twin.table_normal.value_or(math::Vector3::UnitZ()));
  }
}

void add_parameters(Arrays& arrays, const twin::Twin& twin) {
  if (!twin.parameters) return;
  const dynamics::Parameters& p = *twin.parameters;
  const std::size_t angles = p.stiffness.size(), links = p.link_mass.size();
  for (const auto& [name, values] :
       {std::pair("stiffness", &p.stiffness), std::pair("rest_angle", &p.rest_angle), std::pair("damping", &p.damping)})
    arrays.numbers(name, {angles}, *values);
  if (!p.roll_lever.empty()) arrays.numbers("roll_lever", {angles}, p.roll_lever);
  if (!p.torsional_stiffness.empty())
    arrays.numbers("torsional_stiffness", {p.torsional_stiffness.size()}, p.torsional_stiffness);
  if (!p.bending_friction.empty()) {
    arrays.numbers("bending_friction", {angles}, p.bending_friction);
    arrays.numbers("bending_friction_angle", {angles}, p.bending_friction_angle);
  }
  for (const auto& [name, values] :
       {std::pair("link_mass", &p.link_mass), std::pair("viscous_friction", &p.viscous_friction),
        std::pair("coulomb_friction", &p.coulomb_friction), std::pair("air_linear", &p.air_linear),
        std::pair("air_quadratic", &p.air_quadratic)})
    arrays.numbers(name, {links}, *values);
  arrays.number("tip_mass", p.tip_mass);
  arrays.number("tip_length", p.tip_length);
  arrays.number("radius", p.radius);
  arrays.number("coulomb_speed", p.coulomb_speed);
  arrays.number("drag_speed", p.drag_speed);
  arrays.number("known_mass", twin.known_mass);
  const dynamics::Estimates& e = twin.estimates;
  if (e.names.empty()) return;
  arrays.texts("estimate_names", e.names);
  arrays.numbers("estimates", {e.values.size()}, e.values);
  arrays.numbers("standard_errors", {e.standard_errors.size()}, e.standard_errors);
  const auto side = static_cast<std::size_t>(e.covariance.rows());
  if (side > 0) arrays.numbers("estimate_covariance", {side, side}, flat(std::vector<MatrixX>{e.covariance}));
}

void add_gaussians(Arrays& arrays, const splat::Gaussians& g) {
  if (g.count == 0) return;
  const std::size_t count = g.count, links = g.links, terms = g.sh_coefficients();
  std::vector<float> scale, opacity, rotation, probability;
  for (const float value : g.log_scale) scale.push_back(std::exp(value));
  for (const float value : g.opacity_logit) opacity.push_back(1.0f / (1.0f + std::exp(-value)));
  for (std::size_t i = 0; i < count; ++i) {
    const Eigen::Vector4f q = Eigen::Map<const Eigen::Vector4f>(&g.rotation[4 * i]).normalized();
    rotation.insert(rotation.end(), q.begin(), q.end());
    Eigen::ArrayXf p = Eigen::Map<const Eigen::ArrayXf>(&g.link_logits[links * i], g.links);
    p = (p - p.maxCoeff()).exp();
    p /= p.sum();
    probability.insert(probability.end(), p.begin(), p.end());
  }
  arrays.floats("gaussian_mean", {count, 3}, g.mean);
  arrays.floats("gaussian_rotation", {count, 4}, rotation);
  arrays.floats("gaussian_scale", {count, 3}, scale);
  arrays.floats("gaussian_opacity", {count}, opacity);
  arrays.floats("gaussian_sh", {count, terms, 3}, g.sh);
  arrays.floats("gaussian_link_probability", {count, links}, probability);
  arrays.number("gaussian_pixel_footprint", g.pixel_footprint);
  if (g.light.known()) {
    arrays.numbers("light_constant", {1}, std::vector<double>{g.light.constant});
    arrays.numbers("light_least", {1}, std::vector<double>{image_model::kLeastBrightness});
    arrays.numbers("light_linear", {3}, g.light.linear);
    arrays.numbers("light_quadratic", {3, 3}, g.light.quadratic.reshaped());
  }
  arrays.floats("gaussian_guessed", {count}, {g.guessed.begin(), g.guessed.end()});
}

}  // namespace

std::string npz(const twin::Twin& twin, const chain::States& motion, const trajectory::Trajectory& base) {
  Arrays arrays;
  add_chain(arrays, twin);
  add_motion(arrays, "", twin.chain, motion, base);
  if (!twin.rollout.time.empty()) add_motion(arrays, "rollout_", twin.chain, twin.rollout, base);
  add_parameters(arrays, twin);
  add_gaussians(arrays, twin.gaussians);
  return arrays.finish();
}

std::string npz_script() { return kTwinPoses; }

}  // namespace chainsplat::exports
