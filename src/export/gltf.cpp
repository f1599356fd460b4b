// glTF 2.0 with KHR_gaussian_splatting (Khronos' extension registry): the splats are attached to the nodes of the
// chain.
#include <tiny_gltf.h>

#include <array>
#include <cmath>
#include <cstring>
#include <sstream>
#include <type_traits>

#include "chainsplat/export.h"
#include "chainsplat/image_model.h"
#include "parts.h"
#include "tube.h"

namespace chainsplat::exports {

using math::Vector3;

namespace {

constexpr const char* kExtension = "KHR_gaussian_splatting";
const double kHalfRoot = std::sqrt(0.5);

double sigmoid(double x) { return 1.0 / (1.0 + std::exp(-x)); }

// Unit quaternion x, y, z, w with the sign nearer to `previous`: viewers differ in how they interpolate across a flip.
std::array<double, 4> quaternion(const math::Matrix3& rotation, const std::array<double, 4>& previous) {
  const Eigen::Quaterniond q = Eigen::Quaterniond(rotation).normalized();
  std::array<double, 4> out{q.x(), q.y(), q.z(), q.w()};
  double dot = 0.0;
  for (int c = 0; c < 4; ++c) dot += out[c] * previous[c];
  if (dot < 0.0)
    for (double& c : out) c = -c;
  return out;
}

// Appends arrays of floats to the one buffer and describes them. glTF requires bounds of positions and of key times.
class Builder {
 public:
  explicit Builder(tinygltf::Model& model) : model_(model) { model_.buffers.emplace_back(); }

  template <class Number>
  int accessor(const std::vector<Number>& values, int components, int target, bool with_bounds) {
    std::vector<unsigned char>& data = model_.buffers[0].data;
    tinygltf::BufferView view;
    view.buffer = 0;
    view.byteOffset = data.size();
    view.byteLength = values.size() * sizeof(Number);
    view.target = target;
    const auto* const bytes = reinterpret_cast<const unsigned char*>(values.data());
    data.insert(data.end(), bytes, bytes + view.byteLength);
    data.resize((data.size() + 3) / 4 * 4);  // floats begin at multiples of four bytes
    model_.bufferViews.push_back(view);

    tinygltf::Accessor accessor;
    accessor.bufferView = static_cast<int>(model_.bufferViews.size()) - 1;
    accessor.componentType =
        std::is_same_v<Number, float> ? TINYGLTF_COMPONENT_TYPE_FLOAT : TINYGLTF_COMPONENT_TYPE_UNSIGNED_SHORT;
    accessor.count = values.size() / components;
    constexpr int kTypes[] = {0, TINYGLTF_TYPE_SCALAR, TINYGLTF_TYPE_VEC2, TINYGLTF_TYPE_VEC3, TINYGLTF_TYPE_VEC4};
    accessor.type = kTypes[components];
    for (int c = 0; with_bounds && c < components; ++c) {
      Number low = values[c], high = values[c];
      for (std::size_t i = c; i < values.size(); i += components) {
        low = std::min(low, values[i]);
        high = std::max(high, values[i]);
      }
      accessor.minValues.push_back(low);
      accessor.maxValues.push_back(high);
    }
    model_.accessors.push_back(accessor);
    return static_cast<int>(model_.accessors.size()) - 1;
  }

  int vertices(const std::vector<float>& values, int components, bool with_bounds = false) {
    return accessor(values, components, TINYGLTF_TARGET_ARRAY_BUFFER, with_bounds);
  }
  // The inverses of the links' poses at home, which are pure translations.
  int inverse_bind_matrices(const chain::Chain& chain) {
    std::vector<float> matrices;
    for (int j = 0; j < chain.links(); ++j) {
      const Vector3 origin = -chain.link_start(j) * chain.direction;
      for (int i = 0; i < 16; ++i)  // column by column
        matrices.push_back(i % 5 == 0 ? 1.0f : i >= 12 ? static_cast<float>(origin[i - 12]) : 0.0f);
    }
    const int made = accessor(matrices, 4, 0, false);
    model_.accessors[made].type = TINYGLTF_TYPE_MAT4;
    model_.accessors[made].count = chain.links();
    return made;
  }
  int keys(const std::vector<float>& values, int components, bool with_bounds = false) {
    return accessor(values, components, 0, with_bounds);
  }

 private:
  tinygltf::Model& model_;
};

constexpr double kFar = 1000.0;  // m, beyond every scene; the writer always writes one

tinygltf::Primitive primitive(Builder& builder, const splat::Gaussians& g, const std::vector<int>& members,
                              const Vector3& link_origin) {
  const int coefficients = g.sh_coefficients();
  std::vector<float> position, rotation, scale, opacity, color;
  std::vector<std::vector<float>> sh(coefficients);

  // attributes in glTF's units: linear scale, opacity, quaternion xyzw
  for (const int i : members) {
    double norm = 0.0;
    for (int c = 0; c < 4; ++c) norm += static_cast<double>(g.rotation[4 * i + c]) * g.rotation[4 * i + c];
    norm = std::sqrt(norm);
    for (int c = 0; c < 3; ++c) position.push_back(static_cast<float>(g.mean[3 * i + c] - link_origin[c]));
    for (const int c : {1, 2, 3, 0})
      rotation.push_back(static_cast<float>(g.rotation[4 * i + c] / norm));  // wxyz to xyzw
    for (int c = 0; c < 3; ++c) scale.push_back(std::exp(g.log_scale[3 * i + c]));
    opacity.push_back(static_cast<float>(sigmoid(g.opacity_logit[i])));
    for (int l = 0; l < coefficients; ++l)
      for (int c = 0; c < 3; ++c) sh[l].push_back(g.sh[3 * (static_cast<std::size_t>(coefficients) * i + l) + c]);
    for (const double srgb : splat::base_color(g, i)) color.push_back(static_cast<float>(linear_from_srgb(srgb)));
    color.push_back(opacity.back());
  }

  const std::string prefix = std::string(kExtension) + ":";
  tinygltf::Primitive out;
  out.mode = TINYGLTF_MODE_POINTS;
  out.attributes["POSITION"] = builder.vertices(position, 3, true);
  out.attributes["COLOR_0"] = builder.vertices(color, 4);  // for viewers that do not know the extension
  out.attributes[prefix + "ROTATION"] = builder.vertices(rotation, 4);
  out.attributes[prefix + "SCALE"] = builder.vertices(scale, 3);
  out.attributes[prefix + "OPACITY"] = builder.vertices(opacity, 1);
  for (int degree = 0, l = 0; degree <= g.degree; ++degree)
    for (int n = 0; n < 2 * degree + 1; ++n, ++l)
      out.attributes[prefix + "SH_DEGREE_" + std::to_string(degree) + "_COEF_" + std::to_string(n)] =
          builder.vertices(sh[l], 3);
  tinygltf::Value::Object extension;
  for (const auto& [key, value] : {std::pair{"kernel", "ellipse"},
                                   {"colorSpace", "srgb_rec709_display"},
                                   {"projection", "perspective"},
                                   {"sortingMethod", "cameraDistance"}})
    extension[key] = tinygltf::Value(std::string(value));
  out.extensions[kExtension] = tinygltf::Value(extension);
  return out;
}

// The rope as a skinned mesh in a node of its own beside the chain: a skin is where its joints are.
void add_tube(tinygltf::Model& model, Builder& builder, const splat::Gaussians& gaussians, const chain::Chain& chain) {
  const Tube tube = make_tube(gaussians, chain);
  tinygltf::Primitive primitive;
  primitive.mode = TINYGLTF_MODE_TRIANGLES;
  primitive.attributes["POSITION"] = builder.vertices(tube.position, 3, true);
  primitive.attributes["NORMAL"] = builder.vertices(tube.normal, 3);
  primitive.attributes["COLOR_0"] = builder.vertices(tube.color, 4);
  primitive.attributes["JOINTS_0"] = builder.accessor(tube.link, 4, TINYGLTF_TARGET_ARRAY_BUFFER, false);
  primitive.attributes["WEIGHTS_0"] = builder.vertices(tube.weight, 4);
  primitive.indices = builder.accessor(tube.triangles, 1, TINYGLTF_TARGET_ELEMENT_ARRAY_BUFFER, false);
  tinygltf::Material material;
  material.name = "rope";
  material.pbrMetallicRoughness.metallicFactor = 0.0;
  material.pbrMetallicRoughness.roughnessFactor = 0.8;
  primitive.material = static_cast<int>(model.materials.size());
  model.materials.push_back(material);
  tinygltf::Skin skin;
  skin.inverseBindMatrices = builder.inverse_bind_matrices(chain);
  for (int j = 0; j < chain.links(); ++j) skin.joints.push_back(1 + j);
  model.skins.push_back(skin);
  tinygltf::Mesh mesh;
  mesh.name = "tube";
  mesh.primitives.push_back(primitive);
  tinygltf::Node node;
  node.name = "tube";
  node.mesh = static_cast<int>(model.meshes.size());
  node.skin = 0;
  model.meshes.push_back(mesh);
  model.scenes[0].nodes.push_back(static_cast<int>(model.nodes.size()));
  model.nodes.push_back(node);
}

// A camera below the root. glTF's look along -z with y up, and know neither a lens nor a principal point beside the
// middle: both stand in its extras.
void add_camera(tinygltf::Model& model, const capture::Camera& from) {
  tinygltf::Camera camera;
  camera.type = "perspective";
  camera.name = from.name;
  camera.perspective.yfov = 2.0 * std::atan(0.5 * from.height / from.fy);
  camera.perspective.aspectRatio = from.width * from.fy / (from.fx * from.height);
  camera.perspective.znear = image_model::kNear;
  camera.perspective.zfar = kFar;
  tinygltf::Value::Object extras;
  for (const auto& [name, value] : {std::pair{"fx", from.fx}, {"fy", from.fy}, {"cx", from.cx}, {"cy", from.cy}})
    extras[name] = tinygltf::Value(value);
  extras["width"] = tinygltf::Value(from.width), extras["height"] = tinygltf::Value(from.height);
  tinygltf::Value::Array lens;
  for (const double coefficient : from.distortion) lens.emplace_back(coefficient);
  extras["distortion"] = tinygltf::Value(lens);
  camera.extras = tinygltf::Value(extras);
  tinygltf::Node node;
  node.name = from.name;
  node.camera = static_cast<int>(model.cameras.size());
  math::Matrix3 rotation = from.world_from_camera.rotation;
  rotation.rightCols<2>() *= -1.0;
  const std::array<double, 4> turn = quaternion(rotation, {0, 0, 0, 1});
  node.rotation.assign(turn.begin(), turn.end());
  node.translation.assign(from.world_from_camera.translation.begin(), from.world_from_camera.translation.end());
  model.cameras.push_back(camera);
  model.nodes[0].children.push_back(static_cast<int>(model.nodes.size()));
  model.nodes.push_back(node);
}

// What the rope is, for programs that read extras: lengths in m, properties as in twin.json.
tinygltf::Value about(const chain::Chain& chain, const std::vector<twin::Property>& properties) {
  tinygltf::Value::Object rope, all;
  rope["length"] = tinygltf::Value(chain.length), rope["diameter"] = tinygltf::Value(chain.diameter);
  for (const twin::Property& p : properties) {
    tinygltf::Value::Object one{{"value", tinygltf::Value(p.value)}, {"unit", tinygltf::Value(p.unit)}};
    if (std::isfinite(p.sigma)) one["sigma"] = tinygltf::Value(p.sigma);
    all[p.name] = tinygltf::Value(one);
  }
  if (!all.empty()) rope["properties"] = tinygltf::Value(all);
  return tinygltf::Value(tinygltf::Value::Object{{"rope", tinygltf::Value(rope)}});
}

}  // namespace

std::string gltf(const splat::Gaussians& gaussians, const chain::Chain& chain, const chain::States& motion,
                 const trajectory::Trajectory& base, bool binary, const Options& options) {
  CHAINSPLAT_CHECK(gaussians.links == chain.links(), std::to_string(gaussians.links));
  const int links = chain.links();
  tinygltf::Model model;
  model.asset.version = "2.0";
  model.asset.generator = std::string("chainsplat ") + CHAINSPLAT_VERSION;
  model.extensionsUsed = {kExtension};
  Builder builder(model);

  const bool moving = !motion.time.empty();
  const auto base_pose = [&](double time) { return base.samples().empty() ? math::Pose() : base.pose(time); };
  const math::VectorX home = math::VectorX::Zero(chain.angles());
  const double start = moving ? motion.time[0] : base.start();

  // nodes: node 0 turns z-up to y-up; node 1 + j is link j, a child of the node before
  tinygltf::Node root;
  root.name = "z_up";
  root.rotation = {-kHalfRoot, 0.0, 0.0, kHalfRoot};
  root.children = {1};
  root.extras = about(chain, options.properties);
  model.nodes.push_back(root);
  std::vector<std::vector<int>> members(links);
  for (int i = 0; i < gaussians.count; ++i) members[surest_link(gaussians, i)].push_back(i);
  const std::vector<math::Pose> first =
      moving ? local_poses(chain, motion, 0, base_pose(start)) : local_poses(chain, home, {}, base_pose(start));
  constexpr std::array<double, 4> kIdentity{0, 0, 0, 1};
  std::vector<std::array<double, 4>> turns;
  for (int j = 0; j < links; ++j) {
    turns.push_back(quaternion(first[j].rotation, kIdentity));
    tinygltf::Node node;
    node.name = "link_" + std::to_string(j);
    node.rotation.assign(turns[j].begin(), turns[j].end());
    node.translation.assign(first[j].translation.begin(), first[j].translation.end());
    if (j + 1 < links) node.children = {j + 2};
    if (!members[j].empty()) {  // glTF allows no empty accessor: a link without Gaussians has no mesh
      tinygltf::Mesh mesh;
      mesh.name = node.name;
      mesh.primitives.push_back(primitive(builder, gaussians, members[j], chain.link_start(j) * chain.direction));
      node.mesh = static_cast<int>(model.meshes.size());
      model.meshes.push_back(mesh);
    }
    model.nodes.push_back(node);
  }
  tinygltf::Scene scene;
  scene.nodes = {0};
  model.scenes.push_back(scene);
  model.defaultScene = 0;
  for (const capture::Camera& camera : options.cameras) add_camera(model, camera);
  if (options.mesh) add_tube(model, builder, gaussians, chain);

  // animation: translation of the base, rotation of every link
  if (moving) {
    std::vector<float> times, base_translation;
    std::vector<std::vector<float>> rotation(links);
    for (std::size_t k = 0; k < motion.time.size(); ++k) {
      const auto time = static_cast<float>(motion.time[k] - start);
      if (!times.empty() && !(time > times.back())) continue;  // equal in float
      times.push_back(time);
      const std::vector<math::Pose> local = local_poses(chain, motion, k, base_pose(motion.time[k]));
      for (const double x : local[0].translation) base_translation.push_back(static_cast<float>(x));
      for (int j = 0; j < links; ++j) {
        turns[j] = quaternion(local[j].rotation, turns[j]);
        for (const double x : turns[j]) rotation[j].push_back(static_cast<float>(x));
      }
    }
    tinygltf::Animation animation;
    animation.name = "motion";
    const int input = builder.keys(times, 1, true);
    const auto channel = [&](int node, const char* path, int output) {
      tinygltf::AnimationSampler sampler;
      sampler.input = input;
      sampler.output = output;
      sampler.interpolation = "LINEAR";
      tinygltf::AnimationChannel target;
      target.sampler = static_cast<int>(animation.samplers.size());
      target.target_node = node;
      target.target_path = path;
      animation.samplers.push_back(sampler);
      animation.channels.push_back(target);
    };
    channel(1, "translation", builder.keys(base_translation, 3));
    for (int j = 0; j < links; ++j) channel(1 + j, "rotation", builder.keys(rotation[j], 4));
    model.animations.push_back(animation);
  }

  std::ostringstream stream;
  tinygltf::TinyGLTF writer;
  const bool written = writer.WriteGltfSceneToStream(&model, stream, !binary, binary);
  CHAINSPLAT_CHECK(written, "tinygltf could not write the model");
  return std::move(stream).str();
}

}  // namespace chainsplat::exports
