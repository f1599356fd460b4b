#include "chainsplat/twin.h"

#include <doctest/doctest.h>

#include <cstring>
#include <limits>
#include <nlohmann/json.hpp>

#include "chainsplat/properties.h"
#include "error_of.h"
#include "small_twin.h"

using namespace chainsplat;
using test::contains;
using test::error_of;
using Json = nlohmann::json;

namespace {

// Equality bit by bit; NaN equals NaN.
bool same(double a, double b) { return std::memcmp(&a, &b, sizeof a) == 0 || (std::isnan(a) && std::isnan(b)); }

template <class A>
bool same_all(const A& a, const A& b) {
  if (a.size() != b.size()) return false;
  for (decltype(a.size()) i = 0; i < a.size(); ++i)
    if (!same(a[i], b[i])) return false;
  return true;
}

void check_same_states(const chain::States& a, const chain::States& b) {
  REQUIRE(a.time.size() == b.time.size());
  REQUIRE(a.thetadot.size() == b.thetadot.size());
  CHECK(same_all(a.time, b.time));
  for (std::size_t i = 0; i < a.theta.size(); ++i) CHECK(same_all(a.theta[i], b.theta[i]));
  for (std::size_t i = 0; i < a.thetadot.size(); ++i) CHECK(same_all(a.thetadot[i], b.thetadot[i]));
  REQUIRE(a.roll.size() == b.roll.size());
  for (std::size_t i = 0; i < a.roll.size(); ++i) CHECK(same_all(a.roll[i], b.roll[i]));
}

twin::Twin full_twin() {
  twin::Twin twin = test::small_twin();
  twin.estimates.names = {"log_stiffness", "rest_angle_3"};
  twin.estimates.values = {-7.0 / 3.0, 0.1};
  twin.estimates.standard_errors = {0.01, std::numeric_limits<double>::quiet_NaN()};
  twin.estimates.covariance = math::MatrixX::Identity(2, 2) / 3.0;
  twin.estimates.covariance(1, 0) = 1e-300;
  twin.estimates.weak = {{0.25, {{"rest_angle_3", 0.8}, {"log_stiffness", -0.6}}}};  // not in alphabetical order
  twin.estimates.held = {{"mass", "given by the capture"}, {"twist", "not observed, \"held\""}};
  twin.estimates.misfit = 0.7;
  twin.estimates.solver = {solve::Reason::no_decrease, 7, std::numeric_limits<double>::quiet_NaN(), 2.0 / 3.0, 1e-300};
  twin::Provenance& p = twin.provenance;
  p.version = "1.2.3", p.capture = "free \xc3\xa4", p.capture_hash = "00ff", p.device = "llvmpipe", p.driver = "Mesa";
  p.mass = 1.0 / 3.0, p.frames = {12, -1}, p.every = 5, p.mode = twin::Mode::paper, p.path = "../captures/a",
  p.joint = true;
  p.options = {{"joints", "5"}};
  p.seed = std::numeric_limits<std::uint64_t>::max();
  p.seconds = {{"recognize", 61.25}, {"identify", 1.0 / 3.0}};
  return twin;
}

}  // namespace

TEST_CASE("a twin reads back bit by bit") {
  const test::TemporaryFolder folder("twin");
  const twin::Twin twin = full_twin();
  twin::save(twin, folder.path / "run");
  const twin::Twin read = twin::load(folder.path / "run");

  CHECK(read.tabletop == false);
  CHECK(same(read.chain.length, twin.chain.length));
  CHECK(same(read.chain.diameter, twin.chain.diameter));
  CHECK(same_all(read.chain.direction, twin.chain.direction));
  CHECK(same_all(read.chain.bending_axis, twin.chain.bending_axis));
  CHECK(same_all(read.chain.joint_arclength, twin.chain.joint_arclength));
  CHECK(read.chain.child_link == twin.chain.child_link);
  REQUIRE(read.chain.axes.size() == twin.chain.axes.size());
  for (std::size_t k = 0; k < read.chain.axes.size(); ++k) CHECK(read.chain.axes[k] == twin.chain.axes[k]);

  REQUIRE(read.parameters.has_value());
  const dynamics::Parameters &p = *read.parameters, &q = *twin.parameters;
  CHECK(same_all(p.link_mass, q.link_mass));
  CHECK(same_all(p.viscous_friction, q.viscous_friction));
  CHECK(same_all(p.coulomb_friction, q.coulomb_friction));
  CHECK(same_all(p.air_linear, q.air_linear));
  CHECK(same_all(p.air_quadratic, q.air_quadratic));
  CHECK(same_all(p.stiffness, q.stiffness));
  CHECK(same_all(p.rest_angle, q.rest_angle));
  CHECK(same_all(p.damping, q.damping));
  CHECK(same_all(p.gravity, q.gravity));
  CHECK(same(p.tip_mass, q.tip_mass));
  CHECK(same(p.radius, q.radius));
  CHECK(!p.table_normal);
  CHECK(same(p.coulomb_speed, q.coulomb_speed));
  CHECK(same(p.drag_speed, q.drag_speed));
  CHECK(p.integrator == q.integrator);
  CHECK(p.substeps == q.substeps);

  REQUIRE(read.initial.has_value());
  CHECK(same(read.initial->time, twin.initial->time));
  CHECK(same_all(read.initial->theta, twin.initial->theta));
  CHECK(same_all(read.initial->thetadot, twin.initial->thetadot));
  CHECK(read.known_mass);
  CHECK(read.estimates.names == twin.estimates.names);
  CHECK(same_all(read.estimates.values, twin.estimates.values));
  CHECK(same_all(read.estimates.standard_errors, twin.estimates.standard_errors));
  CHECK(read.estimates.covariance == twin.estimates.covariance);
  CHECK(read.estimates.held == twin.estimates.held);
  REQUIRE(read.estimates.weak.size() == 1);
  CHECK(read.estimates.weak[0].singular_value == 0.25);
  CHECK(read.estimates.weak[0].parts == twin.estimates.weak[0].parts);
  CHECK(read.estimates.misfit == 0.7);
  REQUIRE(read.estimates.solver);
  CHECK(read.estimates.solver->reason == solve::Reason::no_decrease);
  CHECK(read.estimates.solver->iterations == 7);
  CHECK(std::isnan(read.estimates.solver->initial_cost));
  CHECK(read.estimates.solver->final_cost == 2.0 / 3.0);
  CHECK(read.estimates.solver->worst_step == 1e-300);
  CHECK(read.provenance.capture == twin.provenance.capture);
  CHECK(read.provenance.mass == twin.provenance.mass);
  CHECK(read.provenance.frames == twin.provenance.frames);
  CHECK(read.provenance.every == twin.provenance.every);
  CHECK(read.provenance.mode == twin.provenance.mode);
  CHECK(read.provenance.path == twin.provenance.path);
  CHECK(read.provenance.joint);
  CHECK(read.provenance.options == twin.provenance.options);
  CHECK(twin::option_texts(read.provenance) == std::map<std::string, std::string>{{"every", "5"},
                                                                                  {"frames", "12:"},
                                                                                  {"joint", "yes"},
                                                                                  {"joints", "5"},
                                                                                  {"mass", core::exact(1.0 / 3.0)},
                                                                                  {"mode", "paper"},
                                                                                  {"path", "../captures/a"}});
  CHECK(read.provenance.seed == twin.provenance.seed);
  CHECK(read.provenance.seconds == twin.provenance.seconds);

  CHECK(read.gaussians.degree == 1);
  CHECK(read.gaussians.mean == twin.gaussians.mean);
  CHECK(read.gaussians.rotation == twin.gaussians.rotation);
  CHECK(read.gaussians.log_scale == twin.gaussians.log_scale);
  CHECK(read.gaussians.opacity_logit == twin.gaussians.opacity_logit);
  CHECK(read.gaussians.sh == twin.gaussians.sh);
  CHECK(read.gaussians.link_logits == twin.gaussians.link_logits);
  check_same_states(read.states, twin.states);
  check_same_states(read.rollout, twin.rollout);

  // writing what was read gives the same bytes
  twin::save(read, folder.path / "again");
  for (const char* name : {"twin.json", "gaussians.ply", "states.csv", "rollout.csv"})
    CHECK(core::read_file(folder.path / "run" / name) == core::read_file(folder.path / "again" / name));
}

TEST_CASE("torsion, friction in bending and a payload read back, in a file that an older program refuses") {
  const test::TemporaryFolder folder("twin");
  twin::Twin twin = full_twin();
  const auto format = [&] {
    return nlohmann::json::parse(core::read_file(folder.path / "run/twin.json"))["format"].get<std::string>();
  };
  twin::save(twin, folder.path / "run");
  CHECK(format() == "chainsplat-twin/1");
  CHECK(twin::load(folder.path / "run").parameters->bending_friction.empty());
  dynamics::Parameters& p = *twin.parameters;
  const int n = twin.chain.angles();
  for (int k = 0; k < n; ++k) p.bending_friction.push_back(0.01 / (k + 3)), p.bending_friction_angle.push_back(0.1 / 3);
  twin.initial->internal_state = math::VectorX::LinSpaced(n, -1.0, 0.7);
  twin.provenance.payload = {0.1 / 3, 0.01 / 3, 0.02 / 3};
  twin::save(twin, folder.path / "run");
  CHECK(format() == "chainsplat-twin/2");
  dynamics::Parameters reaching;
  std::swap(reaching, p);
  p = full_twin().parameters.value();
  p.tip_length = 0.02 / 3;
  twin::save(twin, folder.path / "run");
  CHECK(format() == "chainsplat-twin/2");
  p = reaching, p.tip_length = 0.02 / 3;
  p.torsional_stiffness.assign(twin.chain.links() - 1, 0.01 / 3);
  twin::save(twin, folder.path / "run");
  const twin::Twin read = twin::load(folder.path / "run");
  CHECK(same_all(read.parameters->bending_friction, p.bending_friction));
  CHECK(same_all(read.parameters->bending_friction_angle, p.bending_friction_angle));
  CHECK(same_all(read.parameters->torsional_stiffness, p.torsional_stiffness));
  CHECK(same_all(read.initial->internal_state, twin.initial->internal_state));
  REQUIRE(read.provenance.payload.has_value());
  CHECK(same(read.provenance.payload->mass, 0.1 / 3));
  CHECK(same(read.provenance.payload->sigma, 0.01 / 3));
  REQUIRE(read.provenance.payload->length.has_value());
  CHECK(same(*read.provenance.payload->length, 0.02 / 3));
  CHECK(same(read.parameters->tip_length, 0.02 / 3));
  const auto properties = nlohmann::json::parse(core::read_file(folder.path / "run/twin.json"))["properties"];
  CHECK(properties["bending_stiffness"]["unit"] == "N m^2");
  CHECK(properties["tip_mass"]["value"] == p.tip_mass);
  CHECK(properties["tip_length"]["value"] == p.tip_length);
  CHECK(properties["first_frequency"]["value"] > 0.5);
}

TEST_CASE("a corrected length makes the mass per length less sure, and a negative deviation is refused") {
  const test::TemporaryFolder folder("twin");
  constexpr double kDeviation = 0.001;  // m
  twin::Twin twin = full_twin();
  capture::Correction longer;
  longer.quantity = &capture::corrected_quantity("object", "length");
  longer.subject = "object";
  longer.value = longer.deviation = math::VectorX::Constant(1, kDeviation);
  const auto mass_per_length = [&] {
    for (const twin::Property& p : twin::properties(twin))
      if (p.name == "mass_per_length") return p;
    return twin::Property{};
  };
  const twin::Property before = mass_per_length();
  twin.corrections = {longer};
  const twin::Property after = mass_per_length();
  CHECK(after.value == before.value);
  CHECK(after.sigma == doctest::Approx(std::hypot(before.sigma, kDeviation / twin.chain.length * before.value)));
  twin::save(twin, folder.path);
  CHECK(twin::load(folder.path).corrections.at(0).deviation[0] == kDeviation);
  twin.corrections[0].deviation[0] = -kDeviation;
  twin::save(twin, folder.path);
  CHECK_THROWS_WITH_AS(twin::load(folder.path), doctest::Contains("sigma: is negative"), InputError);
}

TEST_CASE("corrections have the same bytes when they were read, in whatever order they were found") {
  const test::TemporaryFolder folder("twin");
  twin::Twin twin = full_twin();
  for (const char* const name : {"gain", "readout", "rotation", "bias", "time"}) {
    capture::Correction c;
    c.quantity = &capture::corrected_quantity("camera", name);
    c.subject = "cam0";
    c.value = c.deviation = math::VectorX::Constant(c.quantity->size, 0.001);
    c.calibration = "0123456789abcdef";
    twin.corrections.push_back(std::move(c));
  }
  const auto written = [&] {
    twin::save(twin, folder.path);
    return core::read_file(folder.path / "twin.json");
  };
  const std::string once = written();
  twin.corrections = twin::load(folder.path).corrections;
  CHECK(written() == once);
}

TEST_CASE("a chain alone is read from a whole file or from its part, held as another rope") {
  const test::TemporaryFolder folder("chain");
  const twin::Twin twin = full_twin();
  twin::save(twin, folder.path);
  const Path whole = folder.path / "twin.json", part = folder.path / "chain.json", bare = folder.path / "bare.json";
  Json chain = Json::parse(core::read_file(whole))["chain"];
  core::write_file(part, chain.dump());
  for (const Path& file : {whole, part}) {
    const twin::Twin read = twin::load_chain(file, twin.chain);
    CHECK(read.chain.joint_arclength == twin.chain.joint_arclength);
    CHECK(read.parameters->stiffness == twin.parameters->stiffness);
    CHECK(read.parameters->radius == twin.parameters->radius);
    CHECK(read.gaussians.count == 0);
  }
  chain["joints"][1]["damping"] = -1.0;
  core::write_file(part, chain.dump());
  CHECK(contains(error_of([&] { twin::load_chain(part, twin.chain); }), "chain.json: chain.joints[1].damping"));
  for (Json& link : chain["links"]) link.erase("mass");
  core::write_file(bare, chain.dump());
  CHECK_FALSE(twin::load_chain(bare, twin.chain).parameters.has_value());
  chain::Chain other = twin.chain;  // its axes do not pass through a rope that goes another way
  other.direction = -other.direction;
  CHECK(contains(error_of([&] { twin::load_chain(bare, other); }), "does not pass through its joint"));
}

TEST_CASE("tabletop twins keep their table, thin links and paper's integrator") {
  const test::TemporaryFolder folder("table");
  twin::Twin twin = full_twin();
  twin.tabletop = true;
  twin.table_point = math::Vector3(0.1, 0.2, 1.0 / 3.0);
  twin.parameters->table_normal = math::Vector3(0.6, 0, 0.8);
  twin.parameters->gravity = {0, 0.1, -9.7};
  twin.parameters->radius = 0.0;
  twin.parameters->integrator = dynamics::Integrator::implicit_velocity_euler;
  twin.parameters->substeps = 1;
  twin.known_mass = false;
  twin::save(twin, folder.path);
  const twin::Twin read = twin::load(folder.path);
  CHECK(read.tabletop);
  CHECK(*read.table_point == *twin.table_point);
  CHECK(*read.parameters->table_normal == math::Vector3(0.6, 0, 0.8));
  CHECK(read.gravity == math::Vector3(0, 0.1, -9.7));
  CHECK(read.parameters->radius == 0.0);
  CHECK(read.parameters->integrator == dynamics::Integrator::implicit_velocity_euler);
  CHECK(read.parameters->substeps == 1);
  CHECK(!read.known_mass);
  // a radius that is neither 0 nor half the diameter is found from the inertia
  twin.parameters->radius = 0.007;
  twin::save(twin, folder.path);
  CHECK(twin::load(folder.path).parameters->radius == doctest::Approx(0.007).epsilon(1e-9));
}

TEST_CASE("a recognized twin without parameters, and an empty one, load") {
  const test::TemporaryFolder folder("recognized");
  twin::Twin twin = full_twin();
  twin.parameters.reset();
  twin.initial.reset();
  twin.rollout = {};
  twin.gravity = {0, 0, -1.6};
  twin::save(twin, folder.path / "a");
  CHECK(!std::filesystem::exists(folder.path / "a" / "rollout.csv"));
  const twin::Twin read = twin::load(folder.path / "a");
  CHECK(!read.parameters);
  CHECK(!read.initial);
  CHECK(read.known_mass);
  CHECK(read.gravity == math::Vector3(0, 0, -1.6));
  CHECK(read.rollout.time.empty());
  check_same_states(read.states, twin.states);

  twin.gaussians = {};
  twin.states = {};
  twin::save(twin, folder.path / "b");
  CHECK(twin::load(folder.path / "b").gaussians.count == 0);
}

TEST_CASE("twin.json has the keys that other programs read") {
  const test::TemporaryFolder folder("keys");
  twin::save(full_twin(), folder.path);
  const Json json = Json::parse(core::read_file(folder.path / "twin.json"));
  const auto keys = [](const Json& object) {
    std::vector<std::string> out;
    for (const auto& [key, value] : object.items()) out.push_back(key);
    return out;  // sorted by nlohmann::json
  };
  using Keys = std::vector<std::string>;
  CHECK(keys(json) == Keys{"about", "chain", "format", "gaussians", "grasp", "identification", "properties",
                           "provenance", "rollout", "states"});
  CHECK(keys(json["chain"]) == Keys{"air_drag", "diameter", "gravity", "initial_state", "integrator", "joints",
                                    "length", "links", "regularization", "scenario", "tip_mass"});
  CHECK(keys(json["chain"]["joints"][0]) ==
        Keys{"axis", "child_link", "damping", "parent_link", "rest_angle", "stiffness"});
  CHECK(keys(json["chain"]["links"][0]) ==
        Keys{"center_of_mass", "coulomb_friction", "inertia", "length", "mass", "viscous_friction"});
  CHECK(json["chain"]["joints"].size() == 10);
  CHECK(json["chain"]["links"].size() == 6);
  // both axes of a joint name the same links
  CHECK(json["chain"]["joints"][3]["parent_link"] == 1);
  CHECK(json["chain"]["joints"][3]["child_link"] == 2);
  // a cylinder along z, by hand from mathematics.md 3.1
  const Json& link = json["chain"]["links"][2];
  const double m = link["mass"], l = link["length"], r = 0.01;
  CHECK(link["inertia"][0].get<double>() == doctest::Approx(m * (l * l / 12 + r * r / 4)));
  CHECK(link["inertia"][2].get<double>() == doctest::Approx(m * r * r / 2));
  CHECK(link["center_of_mass"][2].get<double>() == doctest::Approx(-l / 2));
  CHECK(json["chain"]["air_drag"]["quadratic"].get<double>() == doctest::Approx(0.0144 / 3));
}

TEST_CASE("air drag that is not proportional to length becomes its mean per meter") {
  const test::TemporaryFolder folder("drag");
  twin::Twin twin = full_twin();
  double sum = 0.0;
  for (std::size_t j = 0; j < 5; ++j) sum += twin.parameters->air_quadratic[j] = 1e-3 * static_cast<double>(1 + j);
  twin::save(twin, folder.path);
  const auto read = twin::load(folder.path).parameters->air_quadratic;
  double total = 0.0;
  for (const double value : read) total += value;
  CHECK(total == doctest::Approx(sum).epsilon(1e-12));
}

TEST_CASE("damage to twin.json is named by file and key") {
  const test::TemporaryFolder folder("damage");
  twin::save(full_twin(), folder.path);
  const Path file = folder.path / "twin.json";
  const Json good = Json::parse(core::read_file(file));
  const auto error_with = [&](const char* pointer, const Json& value) {
    Json bad = good;
    const Json::json_pointer at(pointer);
    Json& parent = bad[at.parent_pointer()];
    if (!value.is_discarded())
      bad[at] = value;
    else if (parent.is_array())
      parent.erase(std::stoul(at.back()));
    else
      parent.erase(at.back());
    core::write_file(file, bad.dump());
    return error_of([&] { twin::load(folder.path); });
  };
  const Json removed(Json::value_t::discarded);
  const std::tuple<const char*, Json, const char*> cases[] = {
      {"/format", "chainsplat-twin/9", "format"},
      {"/chain", removed, "chain is missing"},
      {"/chain/length", "0.3", "chain.length"},
      {"/chain/length", -0.3, "chain.length"},
      {"/chain/diameter", nullptr, "chain.diameter"},
      {"/chain/gravity", Json::array({0, 0}), "chain.gravity"},
      {"/chain/scenario", "water", "chain.scenario"},
      {"/chain/scenario", "tabletop", "chain.table is missing"},
      {"/chain/joints/3/axis", removed, "chain.joints[3].axis is missing"},
      {"/chain/joints/3/axis/1", "x", "chain.joints[3].axis[1]"},
      {"/chain/joints/3/axis/4", 0.2, "chain.joints[3].axis"},
      {"/chain/joints/3/child_link", 4, "chain.joints[3].child_link"},
      {"/chain/joints/3/parent_link", 0, "chain.joints[3].parent_link"},
      {"/chain/joints/3/stiffness", -1, "chain.joints[3].stiffness"},
      {"/chain/joints", Json::array(), "chain.joints"},
      {"/chain/joints", 5, "chain.joints"},
      {"/chain/links/2/length", 0.01, "chain."},
      {"/chain/links/2/mass", true, "chain.links[2].mass"},
      {"/chain/links/2/inertia/0", 1.0, "inertia"},
      {"/chain/links/2/center_of_mass/0", 1.0, "chain.links[2].center_of_mass"},
      {"/chain/links/5", removed, "chain.links"},
      {"/chain/integrator/name", "euler", "chain.integrator.name"},
      {"/chain/integrator/substeps", 1.5, "chain.integrator.substeps"},
      {"/chain/initial_state/theta", Json::array({1, 2}), "chain.initial_state.theta"},
      {"/grasp/direction/0", 3.0, "grasp.direction"},
      {"/grasp/bending_axis", Json::array({0, 0, 1}), "grasp.bending_axis"},
      {"/identification/estimates", Json::array({1}), "identification.estimates"},
      {"/identification/covariance/0/0", -0.1, "identification.covariance"},
      {"/identification/covariance/0/1", 0.1, "identification.covariance"},
      {"/identification/held/0/reason", removed, "identification.held[0].reason"},
      {"/identification/misfit", -1, "identification.misfit"},
      {"/identification/solver/reason", "tired", "identification.solver.reason"},
      {"/identification/solver/iterations", -1, "identification.solver.iterations"},
      {"/provenance/seed", -1, "provenance.seed"},
      {"/provenance/options/mass", "abc", "provenance.options.mass"},
      {"/provenance/options/mass", "", "provenance.options.mass"},
      {"/provenance/options/mass", "0.06 kg", "provenance.options.mass"},
      {"/provenance/options/mass", "-0.06", "provenance.options.mass"},
      {"/provenance/options/mass", "inf", "provenance.options.mass"},
      {"/provenance/options/mass", 0.06, "provenance.options.mass"},
      {"/provenance/options/every", "five", "provenance.options.every"},
      {"/provenance/options/every", "0", "provenance.options.every"},
      {"/provenance/options/every", "99999999999", "provenance.options.every"},
      {"/provenance/options/mode", "slow", "provenance.options.mode"},
      {"/provenance/options/frames", "12", "provenance.options.frames"},
      {"/gaussians", "../elsewhere.ply", "gaussians"},
      {"/states", "absent.csv", "absent.csv"},
  };
  for (const auto& [pointer, value, expected] : cases) {
    const std::string message = error_with(pointer, value);
    std::string flat = message;  // treats "file: key: what" and "file: key is missing" alike
    for (std::size_t at; (at = flat.find(": is missing")) != std::string::npos;) flat.erase(at, 1);
    const std::string changed = std::string(pointer) + " -> " + message;
    INFO(changed);
    CHECK(contains(flat, expected));
    CHECK(contains(message, folder.path.string()));
    CHECK(!contains(message, "\n"));
  }
  // a file that is cut off anywhere is an error, never a crash
  const std::string text = good.dump();
  for (std::size_t size = 0; size < text.size(); size += 97) {
    core::write_file(file, text.substr(0, size));
    CHECK(contains(error_of([&] { twin::load(folder.path); }), "twin.json"));
  }
  CHECK(contains(error_of([&] { twin::load(folder.path / "absent"); }), "twin.json"));
}

TEST_CASE("what a rope is known by is printed with its error, or as what was held") {
  const std::string text = twin::describe({{"mass_per_length", "kg/m", 0.2, 4e-14},
                                           {"tip_mass", "kg", 0.0, 0.0},
                                           {"friction_coefficient", "1", 0.28, 0.21},
                                           {"first_frequency", "Hz", 1.5, std::numeric_limits<double>::quiet_NaN()}});
  CHECK(contains(text, "mass_per_length       0.2 (held)                kg/m\n"));
  CHECK(contains(text, "tip_mass              0 (held)                  kg\n"));
  CHECK(contains(text, "friction_coefficient  0.28 +- 0.21\n"));
  CHECK(contains(text, "first_frequency       1.5 +- nan                Hz\n"));
}

TEST_CASE("how a rope rolls is kept, and refused of a chain that bends in space") {
  const test::TemporaryFolder folder("rolling");
  twin::Twin twin = test::small_twin(chain::Bending::planar, 20);
  const int links = twin.chain.links();
  twin.tabletop = true;
  twin.table_point = math::Vector3::Zero(), twin.table_normal = math::Vector3::UnitZ();
  twin.parameters->table_normal = twin.table_normal;
  twin.rolling = dynamics::Rolling{
      0.7, 1.0 / 3.0, 0.01, std::vector<double>(links - 1, -0.1), std::vector<double>(links, 0.2), 0.04};
  for (int j = 0; j < links; ++j) twin.chain.lift.push_back(-1e-3 / (1.0 + j));
  splat::Light& light = twin.gaussians.light;
  light = {twin.chain.direction, 0.625, {0.1, -1.0 / 3.0, 0.25}, {}};
  light.quadratic << 0.1, 0.2, 0.3, 0.2, 0.4, 0.5, 0.3, 0.5, -0.6;
  twin.gaussians.pixel_footprint = 0.00125;
  twin::save(twin, folder.path);
  const twin::Twin read = twin::load(folder.path);
  CHECK(read.chain.lift == twin.chain.lift);
  REQUIRE(read.rolling);
  CHECK(read.rolling->torsion == 0.7);
  CHECK(read.rolling->friction == 1.0 / 3.0);
  CHECK(read.rolling->speed == 0.01);
  CHECK(read.rolling->set == twin.rolling->set);
  CHECK(read.rolling->texture == twin.rolling->texture);
  CHECK(read.rolling->deviation == 0.04);
  CHECK(read.gaussians.light.axis == light.axis);
  CHECK(read.gaussians.light.constant == light.constant);
  CHECK(read.gaussians.light.linear == light.linear);
  CHECK(read.gaussians.light.quadratic == light.quadratic);
  CHECK(read.gaussians.pixel_footprint == 0.00125);
  const Path file = folder.path / "twin.json";
  const std::string good = core::read_file(file);
  for (const auto& [from, to, expected] : std::initializer_list<std::array<const char*, 3>>{
           {"\"torsion\": 0.7", "\"torsion\": 0", "rolling.torsion: 0 is not positive"},
           {"\"deviation\": 0.04", "\"deviation\": -1", "rolling.deviation: -1 is negative"},
           {"\"torsion\": 0.7", "\"torsion\": 1e300", "rolling.torsion: is more than any rope has"},
           {"\"constant\": 0.625", "\"constant\": 1e4", "light.constant: is more than any light has"},
           {"\"constant\": 0.625", "\"constants\": 1", "light.constant: is missing"},
           {"\"pixel_footprint\": 0.00125", "\"pixel_footprint\": 0", "pixel_footprint: 0 is not positive"},
           {"\"pixel_footprint\": 0.00125", "\"pixel_footprint\": 1e300", "pixel_footprint: is more than a pixel"},
           {"\"lift\": [-0.001", "\"lift\": [-9", "chain.lift: holds -9, which no rope has"}}) {
    std::string text = good;
    REQUIRE(text.find(from) != std::string::npos);
    core::write_file(file, text.replace(text.find(from), std::string(from).size(), to));
    CHECK(contains(error_of([&] { twin::load(folder.path); }), expected));
  }
  twin::Twin spatial = test::small_twin(chain::Bending::spatial, 20);
  spatial.rolling = twin.rolling;
  twin::save(spatial, folder.path);
  CHECK(contains(error_of([&] { twin::load(folder.path); }), "rolling: is of no identified planar chain on a table"));
  spatial.rolling.reset();
  spatial.chain.lift.assign(spatial.chain.links(), 0.001);
  twin::save(spatial, folder.path);
  CHECK(
      contains(error_of([&] { twin::load(folder.path); }), "lift: is given of a chain that does not bend in a plane"));
}

TEST_CASE("states keep their digits, and damage is named by line") {
  const test::TemporaryFolder folder("states");
  const Path file = folder.path / "states.csv";
  const chain::Chain chain = chain::make_chain(0.3, 0.02, {0, 0, -1}, {0, 1, 0}, 3, chain::Bending::planar, false);
  chain::States states = test::swing(chain, 0.5);
  states.theta[2][1] = 1e-310;
  CHECK(twin::states_csv(states).starts_with("time,theta_1,theta_2,theta_3,thetadot_1,thetadot_2,thetadot_3\n0,"));
  core::write_file(file, twin::states_csv(states));
  check_same_states(twin::read_states(file, chain), states);
  states.thetadot.clear();
  CHECK(twin::states_csv(states).starts_with("time,theta_1,theta_2,theta_3\n"));
  core::write_file(file, twin::states_csv(states));
  check_same_states(twin::read_states(file, chain), states);
  const auto planar = [](int joints) {
    return chain::make_chain(0.3, 0.02, {0, 0, -1}, {0, 1, 0}, joints, chain::Bending::planar, false);
  };
  CHECK(contains(error_of([&] { twin::read_states(file, planar(8)); }), "8 angles"));
  states.roll.assign(states.time.size(), Eigen::Vector4d(0.0, 0.1, -2e-300, 0.25));
  CHECK(twin::states_csv(states).starts_with("time,theta_1,theta_2,theta_3,roll_0,roll_1,roll_2,roll_3\n"));
  core::write_file(file, twin::states_csv(states));
  check_same_states(twin::read_states(file, chain), states);
  CHECK(contains(error_of([&] { twin::read_states(file, planar(4)); }), "5 links"));

  const std::string head = "time,theta_1\n";
  for (const auto& [text, expected] :
       std::initializer_list<std::pair<std::string, const char*>>{{head + "0,1\r\n0.1,\n", ":3: column 2"},
                                                                  {head + "0,1\n0.1,x\n", ":3: column 2"},
                                                                  {head + "0,1\n0.1,nan\n", ":3: column 2"},
                                                                  {head + "0,1\n0.1,2,3\n", ":3: 3 columns"},
                                                                  {head + "0.1,1\n\n0.1,2\n", ":4: its time"},
                                                                  {"t,theta_1\n0,1\n", ":1: is not the header"},
                                                                  {head, "no state"},
                                                                  {"", "no state"}}) {
    core::write_file(file, text);
    const std::string message = error_of([&] { twin::read_states(file, planar(1)); });
    INFO(message);
    CHECK(contains(message, expected));
  }
  CHECK(contains(error_of([&] { twin::read_states(folder.path / "absent.csv", planar(1)); }), "absent.csv"));
}

TEST_CASE("centerlines are the nodes in the world") {
  const chain::Chain chain = chain::make_chain(0.4, 0.02, {0, 0, -1}, {0, 1, 0}, 2, chain::Bending::planar, false);
  chain::States states;
  states.time = {0.5};
  // 90 degrees about y at the grasp turn -z to -x; the second joint turns it further, to +z
  states.theta = {math::Vector2(M_PI / 2, M_PI / 2)};
  const auto base = trajectory::fit({{0.0, {math::Matrix3::Identity(), {1, 2, 3}}}}, "base");
  const std::string text = twin::centerline_csv(chain, states, base);
  CHECK(text.starts_with("time,x_0,y_0,z_0,x_1,y_1,z_1,x_2,y_2,z_2,x_3,y_3,z_3\n0.5,"));
  std::vector<double> numbers;
  std::string row = text.substr(text.find('\n') + 1);
  for (char& c : row) c = c == ',' ? ' ' : c;
  std::istringstream in(row);
  for (double x; in >> x;) numbers.push_back(x);
  const std::vector<double> expected{0.5, 1, 2, 3, 1, 2, 3, 0.8, 2, 3, 0.8, 2, 3.2};
  REQUIRE(numbers.size() == expected.size());
  for (std::size_t i = 0; i < expected.size(); ++i) CHECK(numbers[i] == doctest::Approx(expected[i]).epsilon(1e-12));
}

TEST_CASE("gaussians.ply has the layout of 3DGS") {
  splat::Gaussians g;
  g.resize(2, 3, 1);
  for (std::size_t i = 0; i < g.sh.size(); ++i)
    g.sh[i] = 100.0f + static_cast<float>(i);  // 100 + 12 gaussian + 3 coefficient + channel
  for (int i = 0; i < 8; ++i) g.rotation[i] = 0.1f * static_cast<float>(i + 1);
  g.mean = {1, 2, 3, 4, 5, 6};
  g.log_scale = {-1, -2, -3, -4, -5, -6};
  g.opacity_logit = {7, 8};
  g.link_logits = {20, 21, 22, 30, 31, 32};
  const std::string bytes = twin::gaussians_ply(g);
  const std::size_t data = bytes.find("end_header\n") + 11;
  std::string properties;
  for (std::size_t at = 0; (at = bytes.find("property float ", at)) < data; at += 15)
    properties += bytes.substr(at + 15, bytes.find('\n', at) - at - 15) + " ";
  CHECK(properties ==
        "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 f_rest_0 f_rest_1 f_rest_2 f_rest_3 f_rest_4 f_rest_5 f_rest_6 f_rest_7 "
        "f_rest_8 "
        "opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3 link_0 link_1 link_2 ");
  REQUIRE(bytes.size() - data == 2 * 29 * sizeof(float));
  float second[29];
  std::memcpy(second, bytes.data() + data + sizeof second, sizeof second);
  const float expected[29] = {4,   5,   6,   0,   0,    0,    112,      113,  114,  // coefficient 0
                              115, 118, 121, 116, 119,  122,  117,      120,  123,  // all red, all green, all blue
                              8,   -4,  -5,  -6,  0.5f, 0.6f, 0.1f * 7, 0.8f, 30,  31, 32};
  for (int i = 0; i < 29; ++i) {
    INFO(i);
    CHECK(second[i] == expected[i]);
  }
}

TEST_CASE("other programs' splats are read; damaged ones are refused") {
  const test::TemporaryFolder folder("ply");
  const Path file = folder.path / "g.ply";
  // another order, a property of another type, no normals, no link_*
  std::string bytes = "ply\r\nformat binary_little_endian 1.0\nelement vertex 1\nproperty double time\n";
  const char* const names[] = {"rot_0",   "rot_1",   "rot_2",   "rot_3",   "x",      "y",      "z",
                               "opacity", "scale_0", "scale_1", "scale_2", "f_dc_0", "f_dc_1", "f_dc_2"};
  for (const char* name : names) bytes += std::string("property float ") + name + "\n";
  bytes += "element face 0\nproperty list uchar int vertex_indices\nend_header\n";
  const double time = 5.0;
  bytes.append(reinterpret_cast<const char*>(&time), sizeof time);
  for (int i = 0; i < 14; ++i) {
    const float value = static_cast<float>(i + 1);
    bytes.append(reinterpret_cast<const char*>(&value), sizeof value);
  }
  core::write_file(file, bytes);
  const splat::Gaussians g = twin::read_ply(file);
  CHECK(g.count == 1);
  CHECK(g.links == 0);
  CHECK(g.degree == 0);
  CHECK(g.rotation == std::vector<float>{1, 2, 3, 4});
  CHECK(g.mean == std::vector<float>{5, 6, 7});
  CHECK(g.sh == std::vector<float>{12, 13, 14});

  // which are guessed is told only where some are
  splat::Gaussians some = test::small_twin(chain::Bending::planar, 20).gaussians;
  CHECK(twin::gaussians_ply(some).find("guessed") == std::string::npos);
  some.guessed[7] = 1;
  core::write_file(file, twin::gaussians_ply(some));
  CHECK(twin::read_ply(file).guessed == some.guessed);
  CHECK(twin::read_ply(file).link_logits == some.link_logits);

  const std::string good = twin::gaussians_ply(test::small_twin(chain::Bending::planar, 20).gaussians);
  for (std::size_t size = 0; size < good.size(); size += 53) {
    core::write_file(file, good.substr(0, size));
    CHECK(contains(error_of([&] { twin::read_ply(file); }), "g.ply"));
  }
  const auto replaced = [&](const std::string& from, const std::string& to) {
    std::string bad = good;
    bad.replace(bad.find(from), from.size(), to);
    core::write_file(file, bad);
    return error_of([&] { twin::read_ply(file); });
  };
  CHECK(contains(replaced("binary_little_endian", "ascii"), "format 'ascii'"));
  CHECK(contains(replaced("vertex 20", "vertex 99999999999999999"), "ends before"));
  CHECK(contains(replaced("vertex 20", "vertex -1"), "number of vertices"));
  CHECK(contains(replaced("float opacity", "float opagness"), "'opacity'"));
  CHECK(contains(replaced("float f_rest_8", "float g_rest_8"), "f_rest"));
  CHECK(contains(replaced("float f_dc_0", "list uchar"), "is not understood"));
  std::string bad = good;
  const float nan = std::numeric_limits<float>::quiet_NaN();
  std::memcpy(bad.data() + bad.size() - 4, &nan, 4);
  core::write_file(file, bad);
  CHECK(contains(error_of([&] { twin::read_ply(file); }), "link_5 of Gaussian 19"));
}

TEST_CASE("point clouds of other programs are read") {
  const test::TemporaryFolder folder("points");
  const Path file = folder.path / "hand.ply";
  const math::Vector3 first(0.25, -1.5, 3.0), second(1e-3, 2.0, -0.125);
  const auto read = [&](const std::string& bytes) {
    core::write_file(file, bytes);
    const math::MatrixX points = twin::read_points(file);
    REQUIRE(points.cols() == 2);
    CHECK((points.col(0) - first).norm() < 1e-7);
    CHECK((points.col(1) - second).norm() < 1e-7);
  };
  read(
      "ply\nformat ascii 1.0\ncomment a hand\nelement vertex 3\nproperty uchar red\nproperty float x\n"
      "property float y\nproperty float z\nend_header\n255 0.25 -1.5 3\n0 nan nan nan\n7 1e-3 2.0 -0.125");
  for (const bool big : {false, true})
    for (const bool doubles : {false, true}) {
      const std::string type = doubles ? "double" : "float";
      std::string bytes = std::string("ply\nformat binary_") + (big ? "big" : "little") +
                          "_endian 1.0\nelement vertex 2\nproperty " + type + " z\nproperty uchar red\nproperty " +
                          type + " y\nproperty " + type + " x\nelement face 0\nend_header\n";
      const auto add = [&](double value) {
        const auto single = static_cast<float>(value);
        std::string number = doubles ? std::string(reinterpret_cast<const char*>(&value), sizeof value)
                                     : std::string(reinterpret_cast<const char*>(&single), sizeof single);
        if (big) std::reverse(number.begin(), number.end());
        bytes += number;
      };
      for (const math::Vector3& point : {first, second}) {
        add(point.z());
        bytes += '\x7f';
        add(point.y());
        add(point.x());
      }
      read(bytes);
      for (std::size_t size = 0; size < bytes.size(); ++size) {
        core::write_file(file, bytes.substr(0, size));
        CHECK(contains(error_of([&] { twin::read_points(file); }), "hand.ply"));
      }
    }
  const auto refused = [&](const std::string& bytes) {
    core::write_file(file, bytes);
    return error_of([&] { twin::read_points(file); });
  };
  const std::string head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n";
  CHECK(contains(refused(head + "end_header\n1 2\n3 4\n"), "'z'"));
  CHECK(contains(refused(head + "property float z\nend_header\n1 2 3\n4 five 6\n"), "point 1"));
  CHECK(contains(refused(head + "property float z\nend_header\n1 2 3\n"), "ends before its 2 points"));
  CHECK(contains(refused("ply\nformat binary 1.0\nelement vertex 0\nproperty float x\nend_header\n"), "'binary'"));
}
