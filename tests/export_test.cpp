#include "chainsplat/export.h"

#include <doctest/doctest.h>
#include <tiny_gltf.h>

#include <cstdlib>
#include <cstring>

#include "small_twin.h"

using namespace chainsplat;

namespace {

tinygltf::Model loaded(const std::string& bytes, bool binary) {
  tinygltf::Model model;
  tinygltf::TinyGLTF loader;
  std::string error, warning;
  const bool good =
      binary
          ? loader.LoadBinaryFromMemory(&model, &error, &warning, reinterpret_cast<const unsigned char*>(bytes.data()),
                                        static_cast<unsigned>(bytes.size()))
          : loader.LoadASCIIFromString(&model, &error, &warning, bytes.data(), static_cast<unsigned>(bytes.size()), "");
  INFO(error << warning);
  REQUIRE(good);
  CHECK(error.empty());
  CHECK(warning.empty());
  return model;
}

std::vector<float> floats(const tinygltf::Model& model, int accessor, int components) {
  const tinygltf::Accessor& a = model.accessors[accessor];
  const tinygltf::BufferView& view = model.bufferViews[a.bufferView];
  REQUIRE(a.componentType == TINYGLTF_COMPONENT_TYPE_FLOAT);
  REQUIRE(tinygltf::GetNumComponentsInType(a.type) == components);
  REQUIRE(view.byteLength == a.count * components * sizeof(float));
  REQUIRE((view.byteOffset + a.byteOffset) % 4 == 0);
  std::vector<float> out(a.count * components);
  std::memcpy(out.data(), model.buffers[view.buffer].data.data() + view.byteOffset + a.byteOffset,
              out.size() * sizeof(float));
  return out;
}

math::Matrix3 rotation_of(const double* xyzw) {
  return Eigen::Quaterniond(xyzw[3], xyzw[0], xyzw[1], xyzw[2]).toRotationMatrix();
}

// World transforms of all nodes at key `key` of the animation (key < 0: without it), computed as a viewer does.
std::vector<math::Pose> world_transforms(const tinygltf::Model& model, int key) {
  std::vector<tinygltf::Node> nodes = model.nodes;
  if (key >= 0) {
    for (const tinygltf::AnimationChannel& channel : model.animations[0].channels) {
      const tinygltf::AnimationSampler& sampler = model.animations[0].samplers[channel.sampler];
      const int components = channel.target_path == "rotation" ? 4 : 3;
      const std::vector<float> values = floats(model, sampler.output, components);
      std::vector<double>& to =
          components == 4 ? nodes[channel.target_node].rotation : nodes[channel.target_node].translation;
      to.assign(values.begin() + components * key, values.begin() + components * (key + 1));
    }
  }
  std::vector<math::Pose> world(nodes.size());
  const std::function<void(int, const math::Pose&)> visit = [&](int n, const math::Pose& parent) {
    math::Pose local;
    if (!nodes[n].rotation.empty()) local.rotation = rotation_of(nodes[n].rotation.data());
    if (!nodes[n].translation.empty()) local.translation = Eigen::Map<const math::Vector3>(nodes[n].translation.data());
    CHECK(nodes[n].scale.empty());
    CHECK(nodes[n].matrix.empty());
    world[n] = parent * local;
    for (const int child : nodes[n].children) visit(child, world[n]);
  };
  for (const int n : model.scenes[model.defaultScene].nodes) visit(n, {});
  return world;
}

// glTF is y-up: our world point (x, y, z) is (x, z, -y) there.
math::Pose y_up() {
  math::Matrix3 turn;
  turn << 1, 0, 0, 0, 0, 1, 0, -1, 0;
  return {turn, math::Vector3::Zero()};
}

int link_node(const tinygltf::Model& model, int link) {
  for (std::size_t n = 0; n < model.nodes.size(); ++n)
    if (model.nodes[n].name == "link_" + std::to_string(link)) return static_cast<int>(n);
  return -1;
}

double apart(const math::Pose& a, const math::Pose& b) {
  return std::max((a.rotation - b.rotation).cwiseAbs().maxCoeff(),
                  (a.translation - b.translation).cwiseAbs().maxCoeff());
}

}  // namespace

TEST_CASE("the animated nodes are where the chain's links are") {
  for (const chain::Bending bending : {chain::Bending::planar, chain::Bending::spatial}) {
    twin::Twin twin = test::small_twin(bending, 60);
    if (bending == chain::Bending::planar)
      for (int j = 0; j < twin.chain.links(); ++j) twin.chain.lift.push_back(-0.001 * j);
    const trajectory::Trajectory base = test::moving_base(1.2);
    const chain::States motion = test::swing(twin.chain, 1.0, 0.1);
    const std::string bytes = exports::gltf(twin.gaussians, twin.chain, motion, base, true);
    const tinygltf::Model model = loaded(bytes, true);
    REQUIRE(model.animations.size() == 1);
    const std::vector<float> times = floats(model, model.animations[0].samplers[0].input, 1);
    REQUIRE(times.size() == motion.time.size());
    for (std::size_t k = 0; k < times.size(); ++k)
      CHECK(times[k] == doctest::Approx(motion.time[k] - motion.time[0]).epsilon(1e-6));
    CHECK(times[0] == 0.0f);
    for (const int key : {-1, 0, 7, 30}) {
      const std::vector<math::Pose> world = world_transforms(model, key);
      const std::size_t k = static_cast<std::size_t>(std::max(0, key));
      const auto motions = chain::link_motions(twin.chain, motion.theta[k], base.pose(motion.time[k]));
      for (int j = 0; j < twin.chain.links(); ++j) {
        const math::Pose home{math::Matrix3::Identity(), twin.chain.link_start(j) * twin.chain.direction};
        CHECK(apart(world[link_node(model, j)], y_up() * motions[j] * home) < 2e-6);
      }
    }
  }
}

TEST_CASE("nodes turn with the material of a rope that rolls") {
  const twin::Twin twin = test::small_twin(chain::Bending::planar, 60);
  const trajectory::Trajectory base = test::moving_base(1.2);
  chain::States motion = test::swing(twin.chain, 1.0, 0.1);
  for (std::size_t k = 0; k < motion.time.size(); ++k)
    motion.roll.push_back(0.04 * static_cast<double>(k) * math::VectorX::LinSpaced(twin.chain.links(), 0.0, 1.0));
  const tinygltf::Model model = loaded(exports::gltf(twin.gaussians, twin.chain, motion, base, true), true);
  for (const int key : {-1, 7, 30}) {
    const std::vector<math::Pose> world = world_transforms(model, key);
    const std::size_t k = static_cast<std::size_t>(std::max(0, key));
    const auto motions = chain::link_motions(twin.chain, motion.theta[k], base.pose(motion.time[k]));
    for (int j = 0; j < twin.chain.links(); ++j) {
      const Eigen::AngleAxisd turn(motion.roll[k][j], twin.chain.direction);
      const math::Pose home{turn.toRotationMatrix(), twin.chain.link_start(j) * twin.chain.direction};
      CHECK(apart(world[link_node(model, j)], y_up() * motions[j] * home) < 2e-6);
    }
  }
}

TEST_CASE("the animation is what viewers need") {
  const twin::Twin twin = test::small_twin(chain::Bending::spatial, 60);
  chain::States motion = test::swing(twin.chain, 1.0);
  // the base turns by more than half a turn, so quaternions would flip their sign if their signs were not continued
  std::vector<trajectory::Sample> samples;
  for (int k = 0; k <= 60; ++k)
    samples.push_back({k / 60.0, {math::exp_so3({0, 0, 5.0 * k / 60.0}), math::Vector3::Zero()}});
  const tinygltf::Model model =
      loaded(exports::gltf(twin.gaussians, twin.chain, motion, trajectory::fit(samples, "turning"), true), true);
  const tinygltf::Animation& animation = model.animations.at(0);
  CHECK(animation.channels.size() == 1 + 6);  // translation of the base, rotation of all links
  for (const tinygltf::AnimationSampler& sampler : animation.samplers) {
    CHECK(sampler.input == animation.samplers[0].input);
    CHECK(sampler.interpolation == "LINEAR");
  }
  const tinygltf::Accessor& input = model.accessors[animation.samplers[0].input];
  REQUIRE(input.minValues.size() == 1);
  CHECK(input.minValues[0] == 0.0);
  CHECK(input.maxValues.at(0) == doctest::Approx(1.0));
  CHECK(model.bufferViews[input.bufferView].target == 0);
  for (const tinygltf::AnimationChannel& channel : animation.channels) {
    if (channel.target_path != "rotation") continue;
    const std::vector<float> q = floats(model, animation.samplers[channel.sampler].output, 4);
    for (std::size_t k = 0; k < q.size(); k += 4) {
      const Eigen::Map<const Eigen::Vector4f> now(&q[k]);
      CHECK(now.norm() == doctest::Approx(1.0f).epsilon(1e-6));
      if (k > 0) CHECK(now.dot(Eigen::Map<const Eigen::Vector4f>(&q[k - 4])) > 0.0f);
    }
  }
}

TEST_CASE("every Gaussian is on its link, in the extension's units") {
  twin::Twin twin = test::small_twin(chain::Bending::planar, 90);
  splat::Gaussians& g = twin.gaussians;
  const tinygltf::Model model = loaded(exports::gltf(g, twin.chain, {}, {}, true), true);
  CHECK(model.animations.empty());
  CHECK(model.extensionsUsed == std::vector<std::string>{"KHR_gaussian_splatting"});
  CHECK(model.extensionsRequired.empty());
  const std::vector<math::Pose> world = world_transforms(model, -1);
  const std::string prefix = "KHR_gaussian_splatting:";
  std::size_t total = 0;
  for (int j = 0; j < twin.chain.links(); ++j) {
    const tinygltf::Node& node = model.nodes[link_node(model, j)];
    // the members follow from the arclength: each Gaussian of the spiral is certain of the link that contains it
    std::vector<int> members;
    for (int i = 0; i < g.count; ++i) {
      const double s = twin.chain.length * (i + 0.5) / g.count;
      if (s >= twin.chain.link_start(j) && s < twin.chain.link_end(j)) members.push_back(i);
    }
    REQUIRE(node.mesh >= 0);
    REQUIRE(model.meshes[node.mesh].primitives.size() == 1);
    const tinygltf::Primitive& primitive = model.meshes[node.mesh].primitives[0];
    CHECK(primitive.mode == 0);
    const tinygltf::Value& extension = primitive.extensions.at("KHR_gaussian_splatting");
    CHECK(extension.Get("kernel").Get<std::string>() == "ellipse");
    CHECK(extension.Get("colorSpace").Get<std::string>() == "srgb_rec709_display");
    const auto attribute = [&](const std::string& name, int components) {
      const tinygltf::BufferView& view = model.bufferViews[model.accessors[primitive.attributes.at(name)].bufferView];
      CHECK(view.target == 34962);
      return floats(model, primitive.attributes.at(name), components);
    };
    const auto position = attribute("POSITION", 3), color = attribute("COLOR_0", 4);
    const auto rotation = attribute(prefix + "ROTATION", 4), scale = attribute(prefix + "SCALE", 3);
    const auto opacity = attribute(prefix + "OPACITY", 1);
    const tinygltf::Accessor& bounds = model.accessors[primitive.attributes.at("POSITION")];
    REQUIRE(bounds.minValues.size() == 3);
    REQUIRE(opacity.size() == members.size());
    total += members.size();
    for (std::size_t m = 0; m < members.size(); ++m) {
      const int i = members[m];
      const math::Vector3 in_link(position[3 * m], position[3 * m + 1], position[3 * m + 2]);
      const math::Vector3 home(g.mean[3 * i], g.mean[3 * i + 1], g.mean[3 * i + 2]);
      CHECK((world[link_node(model, j)] * in_link - y_up() * home).norm() < 1e-6);
      for (int c = 0; c < 3; ++c) {
        CHECK(position[3 * m + c] >= bounds.minValues[c]);
        CHECK(position[3 * m + c] <= bounds.maxValues[c]);
      }
      // the input was ln 0.004 and ln 0.006, a logit of 2, and quaternions wxyz of length 1.3
      CHECK(scale[3 * m] == doctest::Approx(0.004));
      CHECK(scale[3 * m + 2] == doctest::Approx(0.006));
      CHECK(opacity[m] == doctest::Approx(0.8807970779778823));
      CHECK(rotation[4 * m + 3] * 1.3f == doctest::Approx(g.rotation[4 * i]));
      CHECK(rotation[4 * m] * 1.3f == doctest::Approx(g.rotation[4 * i + 1]));
      CHECK(color[4 * m + 3] == opacity[m]);
    }
    const auto dc = attribute(prefix + "SH_DEGREE_0_COEF_0", 3);
    const auto last = attribute(prefix + "SH_DEGREE_1_COEF_2", 3);
    CHECK(dc[0] == g.sh[12 * members[0]]);
    CHECK(last[2] == g.sh[12 * members[0] + 3 * 3 + 2]);
    CHECK(!primitive.attributes.contains(prefix + "SH_DEGREE_2_COEF_0"));
  }
  CHECK(total == 90);
}

TEST_CASE("the points' fallback color is linear") {
  twin::Twin twin = test::small_twin(chain::Bending::planar, 12);
  // sRGB 0.5 is 0.21404114 linear; 2 is clamped to 1, -1 to 0
  for (int i = 0; i < 12; ++i)
    for (int c = 0; c < 3; ++c)
      twin.gaussians.sh[12 * i + c] = static_cast<float>(c == 0 ? 0.0 : (c == 1 ? 1.5 : -1.5) / 0.28209479177387814);
  const tinygltf::Model model = loaded(exports::gltf(twin.gaussians, twin.chain, {}, {}, false), false);
  const std::vector<float> color = floats(model, model.meshes[0].primitives[0].attributes.at("COLOR_0"), 4);
  CHECK(color[0] == doctest::Approx(0.21404114));
  CHECK(color[1] == 1.0f);
  CHECK(color[2] == 0.0f);
}

TEST_CASE("links without Gaussians have no mesh but keep their place in the chain") {
  twin::Twin twin = test::small_twin(chain::Bending::planar, 30);
  for (int i = 0; i < 30; ++i) twin.gaussians.link_logits[6 * i + 3] = 50.0f;
  const tinygltf::Model model = loaded(exports::gltf(twin.gaussians, twin.chain, twin.states, {}, true), true);
  CHECK(model.meshes.size() == 1);
  CHECK(model.nodes[link_node(model, 3)].mesh == 0);
  CHECK(model.nodes[link_node(model, 4)].mesh == -1);
  CHECK(model.nodes[link_node(model, 2)].children == std::vector<int>{link_node(model, 3)});
  CHECK(model.animations[0].channels.size() == 7);
}

TEST_CASE("files by ending") {
  const test::TemporaryFolder folder("export");
  const twin::Twin twin = test::small_twin();
  const trajectory::Trajectory base = test::moving_base(1.0);
  exports::write(twin, twin.rollout, base, folder.path / "a.PLY");
  CHECK(core::read_file(folder.path / "a.PLY") == twin::gaussians_ply(twin.gaussians));
  exports::write(twin, twin.rollout, base, folder.path / "a.csv");
  CHECK(core::read_file(folder.path / "a.csv") == twin::states_csv(twin.rollout));
  CHECK(core::read_file(folder.path / "a.centerline.csv") == twin::centerline_csv(twin.chain, twin.rollout, base));
  exports::write(twin, twin.rollout, base, folder.path / "a.glb");
  const std::string glb = core::read_file(folder.path / "a.glb");
  CHECK(glb.starts_with("glTF"));
  CHECK(glb == exports::gltf(twin.gaussians, twin.chain, twin.rollout, base, true));
  exports::write(twin, twin.rollout, base, folder.path / "a.gltf");
  loaded(core::read_file(folder.path / "a.gltf"), false);
  // for tools/test-gltf, which checks the file with an outside program
  if (const char* const kept = std::getenv("CHAINSPLAT_TEST_GLB")) core::write_file(kept, glb);

  const auto message = [&](const char* name, const twin::Twin& of) -> std::string {
    try {
      exports::write(of, {}, base, folder.path / name);
    } catch (const InputError& error) {
      return error.what();
    }
    return "";
  };
  CHECK(message("a.obj", twin).find(".glb, .gltf, .ply, .csv") != std::string::npos);
  CHECK(message("a", twin).find("no ending") != std::string::npos);
  CHECK(message("b.csv", twin).find("no motion") != std::string::npos);
  twin::Twin bare = twin;
  bare.gaussians = {};
  CHECK(message("b.glb", bare).find("no Gaussians") != std::string::npos);
  CHECK(!std::filesystem::exists(folder.path / "b.glb"));
}

TEST_CASE("glTF's cameras see points where the capture's do, and the root tells what the rope is") {
  const twin::Twin twin = test::small_twin();
  capture::Camera camera;
  camera.name = "left";
  camera.width = 640, camera.height = 480;
  camera.fx = 500.0, camera.fy = 520.0, camera.cx = 320.0, camera.cy = 240.0;
  camera.world_from_camera = {Eigen::AngleAxisd(2.0, math::Vector3(1, 2, -2) / 3.0).toRotationMatrix(),
                              math::Vector3(0.4, -0.7, 0.5)};
  exports::Options options;
  options.cameras = {camera};
  options.properties = {{"bending_stiffness", "N m^2", 4e-4, 1e-5}, {"tip_mass", "kg", 0.0, NAN}};
  const tinygltf::Model model =
      loaded(exports::gltf(twin.gaussians, twin.chain, twin.states, test::moving_base(1.0), true, options), true);
  REQUIRE(model.cameras.size() == 1);
  const tinygltf::PerspectiveCamera& lens = model.cameras[0].perspective;
  const std::vector<math::Pose> world = world_transforms(model, 0);
  const math::Pose seen_from = world.back();
  REQUIRE(model.nodes.back().name == "left");
  const math::Vector3 in_camera(0.1, -0.05, 0.8), point = camera.world_from_camera * in_camera;
  const math::Vector3 there = seen_from.inverse() * (y_up() * point);
  REQUIRE(there.z() < 0.0);  // in front
  const double half = std::tan(0.5 * lens.yfov);
  const math::Vector2 pixel(320.0 * (1.0 + there.x() / -there.z() / (half * lens.aspectRatio)),
                            240.0 * (1.0 - there.y() / -there.z() / half));
  CHECK((pixel - capture::project(camera, in_camera)).norm() < 1e-6);
  CHECK(model.cameras[0].extras.Get("cx").GetNumberAsDouble() == 320.0);
  const tinygltf::Value rope = model.nodes[0].extras.Get("rope");
  CHECK(rope.Get("length").GetNumberAsDouble() == twin.chain.length);
  CHECK(rope.Get("properties").Get("bending_stiffness").Get("sigma").GetNumberAsDouble() == 1e-5);
  CHECK(!rope.Get("properties").Get("tip_mass").Has("sigma"));
}

TEST_CASE("a tube rides on the links: where a vertex has one link, it is where the chain carries it") {
  const twin::Twin twin = test::small_twin();
  const trajectory::Trajectory base = test::moving_base(1.0);
  const tinygltf::Model model = loaded(exports::gltf(twin.gaussians, twin.chain, twin.states, base, true,
                                                     {.mesh = true, .cameras = {}, .properties = {}}),
                                       true);
  REQUIRE(model.skins.size() == 1);
  const tinygltf::Node& node = model.nodes.back();
  REQUIRE(node.name == "tube");
  const tinygltf::Primitive& tube = model.meshes[node.mesh].primitives[0];
  const std::vector<float> position = floats(model, tube.attributes.at("POSITION"), 3),
                           normal = floats(model, tube.attributes.at("NORMAL"), 3),
                           weight = floats(model, tube.attributes.at("WEIGHTS_0"), 4),
                           color = floats(model, tube.attributes.at("COLOR_0"), 4);
  const auto shorts = [&](int accessor) {
    const tinygltf::Accessor& a = model.accessors[accessor];
    REQUIRE(a.componentType == TINYGLTF_COMPONENT_TYPE_UNSIGNED_SHORT);
    const tinygltf::BufferView& view = model.bufferViews[a.bufferView];
    std::vector<std::uint16_t> out(a.count * tinygltf::GetNumComponentsInType(a.type));
    std::memcpy(out.data(), model.buffers[0].data.data() + view.byteOffset, 2 * out.size());
    return out;
  };
  const std::vector<std::uint16_t> joint = shorts(tube.attributes.at("JOINTS_0")), corner = shorts(tube.indices);
  const std::vector<math::Pose> world = world_transforms(model, 7);
  const std::vector<math::Pose> motions =
      chain::link_motions(twin.chain, twin.states.theta[7], base.pose(twin.states.time[7]));
  int of_one = 0, of_two = 0;
  for (std::size_t i = 0; i < position.size() / 3; ++i) {
    const math::Vector3 home(position[3 * i], position[3 * i + 1], position[3 * i + 2]);
    math::Vector3 skinned = math::Vector3::Zero(), carried = math::Vector3::Zero();
    for (int c = 0; c < 4; ++c) {
      const int link = joint[4 * i + c];
      const math::Pose inverse{math::Matrix3::Identity(), -twin.chain.link_start(link) * twin.chain.direction};
      skinned += weight[4 * i + c] * (world[model.skins[0].joints[link]] * (inverse * home));
      carried += weight[4 * i + c] * (y_up() * (motions[link] * home));
    }
    CHECK((skinned - carried).norm() < 1e-6);
    (weight[4 * i] > 0.0f && weight[4 * i + 1] > 0.0f ? of_two : of_one) += 1;
    for (int c = 0; c < 3; ++c) CHECK((color[4 * i + c] >= 0.0f && color[4 * i + c] <= 1.0f));
  }
  CHECK(of_one > of_two);
  CHECK(of_two > 0);
  // every triangle looks outward
  for (std::size_t t = 0; t < corner.size(); t += 3) {
    math::Vector3 p[3], n = math::Vector3::Zero();
    for (int c = 0; c < 3; ++c) {
      p[c] =
          math::Vector3(position[3 * corner[t + c]], position[3 * corner[t + c] + 1], position[3 * corner[t + c] + 2]);
      n += math::Vector3(normal[3 * corner[t + c]], normal[3 * corner[t + c] + 1], normal[3 * corner[t + c] + 2]);
    }
    CHECK((p[1] - p[0]).cross(p[2] - p[0]).dot(n) > 0.0);
  }
}
