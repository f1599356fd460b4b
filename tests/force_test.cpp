// Tests of external forces against vectors computed without this code (tests/data/vectors), motions known in closed
// form, and ropes in balance with a force.
#include "chainsplat/force.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <functional>
#include <nlohmann/json.hpp>
#include <optional>

#include "chainsplat/identification.h"
#include "src/math/decompositions.h"

namespace {

using namespace chainsplat;
using math::Matrix3;
using math::MatrixX;
using math::Vector3;
using math::VectorX;
using Json = nlohmann::json;

VectorX vector_of(const Json& list) {
  const auto values = list.get<std::vector<double>>();
  return Eigen::Map<const VectorX>(values.data(), static_cast<Eigen::Index>(values.size()));
}

dynamics::Parameters uniform(int joints, int angles, double mass, double stiffness, double damping, double radius) {
  dynamics::Parameters p;
  for (auto* list : {&p.viscous_friction, &p.coulomb_friction, &p.air_linear, &p.air_quadratic})
    list->assign(joints, 0.0);
  p.link_mass.assign(joints, mass / joints);
  p.stiffness.assign(angles, stiffness);
  p.damping.assign(angles, damping);
  p.rest_angle.assign(angles, 0.0);
  p.radius = radius;
  return p;
}

// The elastic rope of the simulated captures, hanging, with rest angles that balance it at `theta` with a force.
struct Balanced {
  dynamics::Model model;
  math::Pose base;
  VectorX theta;
};

Balanced balance(chain::Bending bending, const VectorX& theta, double arclength, const Vector3& force) {
  Balanced out;
  const chain::Chain rope = chain::make_chain(0.3, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), 8, bending, false);
  dynamics::Parameters p = uniform(8, rope.angles(), 0.06, 0.012, 1e-3, 0.01);
  out.base.translation = Vector3(0.1, 0.0, 0.55);
  out.theta = theta;
  out.model = dynamics::make_model(rope, p);
  const int link = chain::link_at(rope, arclength);
  const auto motions = chain::link_motions(rope, theta, out.base);
  // the contact's point on the side of the rope that is pushed
  const Vector3 push = motions[link].rotation.transpose() * force;
  const Vector3 across = push - rope.direction.dot(push) * rope.direction;
  Vector3 home = arclength * rope.direction;
  if (across.norm() > 0.0) home -= p.radius * across.normalized();
  const MatrixX jacobian =
      chain::point_jacobian(rope, chain::world_axes(rope, theta, out.base), link, motions[link] * home);
  const VectorX zero = VectorX::Zero(theta.size());
  const VectorX gravity = dynamics::inverse_dynamics(out.model, dynamics::at_rest(out.base), theta, zero, zero);
  // solve J^T f = gravity + K (theta - rest) for the rest angles
  for (int k = 0; k < theta.size(); ++k)
    p.rest_angle[k] = theta[k] + (gravity[k] - jacobian.col(k).dot(force)) / p.stiffness[k];
  out.model = dynamics::make_model(rope, p);
  return out;
}

force::Motion at_rest(const VectorX& theta, int count) {
  chain::States states;
  for (int f = 0; f < count; ++f) {
    states.time.push_back(f / 30.0);
    states.theta.push_back(theta);
  }
  return force::smooth(states);
}

VectorX bent(int angles) {
  VectorX theta(angles);
  for (int k = 0; k < angles; ++k) theta[k] = 0.04 * std::cos(0.7 * k) + 0.02;
  return theta;
}

TEST_CASE("Jacobian, residual torque and force of the vectors") {
  const Json file = Json::parse(core::read_file(Path(CHAINSPLAT_SOURCE_DIR) / "tests/data/vectors/force.json"));
  const Json& c = file["chain"];
  const int links = c["links"];
  const chain::Chain rope = chain::make_chain(c["length"], 0.02, vector_of(c["direction"]), vector_of(c["axis"]), links,
                                              chain::Bending::planar, false);
  const dynamics::Model model =
      dynamics::make_model(rope, uniform(links, links, c["mass"], c["stiffness"], c["damping"], c["radius"]));
  for (const Json& test : file["cases"]) {
    CAPTURE(test["name"].get<std::string>());
    trajectory::BaseMotion base;
    for (int r = 0; r < 3; ++r) {
      for (int column = 0; column < 3; ++column) base.pose.rotation(r, column) = test["T_b"][r][column];
      base.pose.translation[r] = test["T_b"][r][3];
    }
    base.velocity = vector_of(test["V_b"]);
    base.acceleration = vector_of(test["Vdot_b"]);
    const VectorX theta = vector_of(test["theta"]);
    const VectorX residual =
        force::residual_torque(model, base, theta, vector_of(test["thetadot"]), vector_of(test["thetaddot"]));
    const VectorX expected = vector_of(test["residual_torque"]);
    CHECK((residual - expected).norm() <= 1e-10 * expected.norm());

    const int link = test["link"];
    const auto motions = chain::link_motions(rope, theta, base.pose);
    const Vector3 home = rope.link_start(link) * rope.direction + Vector3(vector_of(test["point_in_link"]));
    const MatrixX jacobian =
        chain::point_jacobian(rope, chain::world_axes(rope, theta, base.pose), link, motions[link] * home);
    for (int r = 0; r < 3; ++r) CHECK((jacobian.row(r).transpose() - vector_of(test["jacobian"][r])).norm() <= 1e-12);
    const force::Fit fit =
        force::solve(jacobian, residual, 1e-8 * MatrixX::Identity(links, links), 1e6 * Matrix3::Identity());
    CHECK((fit.force - Vector3(vector_of(test["estimate"]))).norm() <= 1e-6);
    // the bending axis is unobservable, and the covariance shows it
    CHECK(fit.covariance(1, 1) == doctest::Approx(1e6));
  }
}

TEST_CASE("smoothing finds angle, rate and acceleration of a swing, and its own errors") {
  chain::States states;
  core::Random random(3);
  const double w = 2.5, noise = 0.005;
  const int count = 120;
  for (int f = 0; f < count; ++f) {
    const double t = f / 30.0;
    states.time.push_back(t);
    states.theta.push_back(VectorX::Constant(1, 0.4 * std::sin(w * t) + noise * random.normal()));
  }
  const force::Motion motion = force::smooth(states);
  double rate = 0.0, acceleration = 0.0;
  int inside = 0, used = 0;
  for (int f = 20; f + 20 < count; ++f) {
    const double t = states.time[f];
    const double a = motion.thetaddot[f][0] + 0.4 * w * w * std::sin(w * t);
    rate += std::pow(motion.thetadot[f][0] - 0.4 * w * std::cos(w * t), 2);
    acceleration += a * a;
    inside += std::abs(a) <= 3.0 * std::sqrt(motion.noise(0, 0) * motion.covariance[f](2, 2));
    ++used;
  }
  CHECK(std::sqrt(rate / used) < 0.04);
  CHECK(std::sqrt(acceleration / used) < 0.5);  // second differences have 11 rad/s^2
  CHECK(inside >= 0.95 * used);
}

TEST_CASE("angles seen by where the rope is: a straight chain's angles are second differences of its ends") {
  const int joints = 5;
  const chain::Chain rope =
      chain::make_chain(0.3, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), joints, chain::Bending::planar, false);
  MatrixX differences = MatrixX::Zero(joints, joints);
  for (int k = 0; k < joints; ++k) {
    differences(k, k) = 1.0;
    if (k > 0) differences(k, k - 1) = -2.0;
    if (k > 1) differences(k, k - 2) = 1.0;
  }
  const MatrixX expected = differences * differences.transpose();
  const VectorX sigma = 0.01 * expected.diagonal().cwiseSqrt();
  const MatrixX covariance = force::angle_covariance(rope, VectorX::Zero(joints), sigma);
  CHECK((covariance - 1e-4 * expected).norm() < 0.01 * covariance.norm());
}

TEST_CASE("noise that two angles share is found as such") {
  chain::States states;
  core::Random random(5);
  for (int f = 0; f < 200; ++f) {
    states.time.push_back(f / 30.0);
    const double common = 0.01 * random.normal(), own = 0.002 * random.normal();
    states.theta.push_back(math::Vector2(common, own - common));
  }
  const MatrixX noise = force::smooth(states).noise;
  CHECK(std::sqrt(noise(0, 0)) == doctest::Approx(0.01).epsilon(0.15));
  CHECK(noise(0, 1) / std::sqrt(noise(0, 0) * noise(1, 1)) < -0.9);
}

TEST_CASE("a force is found where it acts, automatically") {
  for (const double arclength : {0.12, 0.18, 0.26}) {
    CAPTURE(arclength);
    const Vector3 force(0.10, 0.04, -0.01);
    const Balanced rope = balance(chain::Bending::spatial, bent(16), arclength, force);
    const auto base = [&](double) { return dynamics::at_rest(rope.base); };
    const std::vector<force::Estimate> found =
        force::estimate(rope.model, force::deviations(rope.model, {}), base, at_rest(rope.theta, 9), {});
    for (const force::Estimate& e : found) {
      CHECK(e.touching);
      CHECK(std::abs(e.contact.arclength - arclength) < 0.015);
      // along the rope, which hangs nearly straight, a force can hardly be distinguished from a change of its place
      CHECK((e.force - force).head<2>().norm() < 0.1 * force.norm());
      CHECK((e.force - force).norm() < 0.5 * force.norm());
      for (int i = 0; i < 3; ++i) CHECK(std::abs(e.force[i] - force[i]) <= 3.0 * e.sigma[i]);
    }
  }
}

TEST_CASE("nothing touches a rope in balance with its weight alone") {
  const Balanced rope = balance(chain::Bending::spatial, bent(16), 0.2, Vector3::Zero());
  const auto base = [&](double) { return dynamics::at_rest(rope.base); };
  for (const force::Estimate& e :
       force::estimate(rope.model, force::deviations(rope.model, {}), base, at_rest(rope.theta, 5), {})) {
    CHECK_FALSE(e.touching);
    CHECK(e.force.norm() < 0.05 * 0.06 * 9.81);
  }
}

TEST_CASE("a planar chain says that it does not see the force along its bending axis") {
  const double arclength = 0.2;
  const Balanced rope = balance(chain::Bending::planar, bent(8), arclength, Vector3(0.08, 0.0, 0.0));
  const auto base = [&](double) { return dynamics::at_rest(rope.base); };
  std::vector<std::optional<force::Contact>> contacts(5, force::Contact{});
  contacts[2].reset();
  for (auto& contact : contacts)
    if (contact)
      contact = force::Contact{chain::link_at(rope.model.chain, arclength), arclength,
                               arclength * rope.model.chain.direction};
  const auto found =
      force::estimate(rope.model, force::deviations(rope.model, {}), base, at_rest(rope.theta, 5), contacts);
  CHECK(found[0].observed.y() < 0.01);
  CHECK(found[0].observed.x() > 0.9);
  CHECK(found[0].sigma.y() > 0.4);
  CHECK(found[0].force.x() == doctest::Approx(0.08).epsilon(0.1));
  CHECK(found[2].force.norm() == 0.0);
  CHECK_FALSE(found[2].touching);
  const Json line = Json::parse(force::to_json(found[0], false));
  CHECK(line["unit"] == "N/kg");
  CHECK(line["link"] == found[0].contact.link);
  CHECK(line["force"][0] == found[0].force.x());
}

// A rope of many links under a moving base and a force, and noisy angles of the nearest chain of few links.
struct Swing {
  trajectory::Trajectory base;
  chain::States observed;
  std::vector<Vector3> push;  // N, at the observed times
};

Swing swing(const dynamics::Model& rope, const chain::Chain& twin, double amplitude, double frequency, int frames,
            double place, const std::function<Vector3(double)>& push_at, core::Random& random) {
  constexpr int kSubsteps = 4;
  constexpr double kRate = 30.0, kNoise = 0.003;  // 1/s, rad
  // the base's motion
  Swing out;
  std::vector<trajectory::Sample> samples;
  for (int i = 0; i <= 4 * frames; ++i) {
    const double time = i / (4.0 * kRate);
    const double x = amplitude * (1.0 - std::cos(2.0 * M_PI * frequency * time));
    samples.push_back({time, {Matrix3::Identity(), Vector3(x, 0.0, 0.5)}});
  }
  out.base = trajectory::fit(samples, "test");
  const auto base = [&](double time) { return out.base.at(time); };
  const int links = rope.chain.angles(), link = chain::link_at(rope.chain, place);
  const double h = 1.0 / (kRate * kSubsteps);
  const std::vector<double> arclengths = chain::equal_arclengths(rope.chain, 31);
  VectorX theta = VectorX::Zero(links), thetadot = VectorX::Zero(links), angles = VectorX::Zero(twin.angles());
  for (int step = 0; step < frames * kSubsteps; ++step) {
    const double time = step * h;
    const math::Pose pose = out.base.pose(time);
    const auto motions = chain::link_motions(rope.chain, theta, pose);
    // fit the twin's angles to the rope's centerline at every frame
    if (step % kSubsteps == 0) {
      const MatrixX curve = chain::centerline(rope.chain, motions, arclengths);
      for (int iteration = 0; iteration < 4; ++iteration) {
        const auto at = chain::link_motions(twin, angles, pose);
        const MatrixX axes = chain::world_axes(twin, angles, pose);
        const MatrixX points = chain::centerline(twin, at, arclengths);
        MatrixX normal = 1e-9 * MatrixX::Identity(twin.angles(), twin.angles());
        VectorX gradient = VectorX::Zero(twin.angles());
        for (std::size_t i = 0; i < arclengths.size(); ++i) {
          const MatrixX jacobian =
              chain::point_jacobian(twin, axes, chain::link_at(twin, arclengths[i]), points.col(i));
          normal += jacobian.transpose() * jacobian;
          gradient += jacobian.transpose() * (curve.col(i) - points.col(i));
        }
        angles += normal.ldlt().solve(gradient);
      }
      out.observed.time.push_back(time);
      out.observed.theta.push_back(angles);
      for (int k = 0; k < twin.angles(); ++k) out.observed.theta.back()[k] += kNoise * random.normal();
      out.push.push_back(push_at(time));
    }
    // integrate, with the push as a shift of the rest angles
    const MatrixX jacobian = chain::point_jacobian(rope.chain, chain::world_axes(rope.chain, theta, pose), link,
                                                   motions[link] * Vector3(place * rope.chain.direction));
    dynamics::Model pushed = rope;
    for (int k = 0; k < links; ++k)
      pushed.parameters.rest_angle[k] += jacobian.col(k).dot(push_at(time + 0.5 * h)) / rope.parameters.stiffness[k];
    chain::States next;
    REQUIRE(dynamics::simulate(pushed, dynamics::sample_base(base, time, {time + h}, 4), theta, thetadot, next));
    theta = next.theta.back();
    thetadot = next.thetadot.back();
  }
  return out;
}

// The twin is identified from another, untouched swing of a rope with less damping. The rope is then pushed twice, by a
// force that grows and falls.
TEST_CASE("pushes on a swinging rope that is finer and more damped than its twin") {
  const double length = 0.3, mass = 0.06, bending = 4.5e-4, place = 0.19;  // m, kg, N m^2, m
  const chain::Chain fine =
      chain::make_chain(length, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), 40, chain::Bending::planar, false);
  const chain::Chain coarse =
      chain::make_chain(length, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), 8, chain::Bending::planar, false);
  const auto rope_of = [&](double damping_time) {
    const double stiffness = bending * 40 / length;
    dynamics::Parameters p = uniform(40, 40, mass, stiffness, damping_time * stiffness, 0.01);
    p.stiffness[0] *= 2.0, p.damping[0] *= 2.0;  // at the grasp half as much rope bends
    return dynamics::make_model(fine, p);
  };
  const auto push_at = [](double time) {
    const double since = std::fmod(time, 2.5) - 1.0;
    const double size = since > 0.0 && since < 1.0 ? 0.15 * std::pow(std::sin(M_PI * since), 2) : 0.0;
    return Vector3(time < 2.5 ? size : -size, 0.0, 0.2 * size);
  };
  core::Random random(2);
  const Swing alone = swing(
      rope_of(0.08), coarse, 0.15, 0.5, 120, place, [](double) { return Vector3(Vector3::Zero()); }, random);
  const Swing pushed = swing(rope_of(0.10), coarse, 0.08, 0.4, 150, place, push_at, random);
  identification::Options options;
  options.mass = mass;
  const identification::Result twin = identification::identify(coarse, alone.base, alone.observed, options);
  const dynamics::Model model = dynamics::make_model(coarse, twin.parameters);
  const std::vector<dynamics::Model> deviations = force::deviations(model, twin.estimates);
  const auto base = [&](double time) { return pushed.base.at(time); };

  const auto median = [](std::vector<double> values) {
    std::nth_element(values.begin(), values.begin() + values.size() / 2, values.end());
    return values[values.size() / 2];
  };
  for (const bool live : {false, true}) {
    CAPTURE(live);
    std::vector<force::Estimate> found;
    if (live) {
      force::LiveForce follower(model, deviations, base);
      for (std::size_t f = 0; f < pushed.observed.time.size(); ++f)
        if (const auto line = follower.update(pushed.observed.time[f], pushed.observed.theta[f], {}))
          found.push_back(*line);
      for (const force::Estimate& line : follower.finish()) found.push_back(line);
    } else {
      found = force::estimate(model, deviations, base, force::smooth(pushed.observed), {});
    }
    REQUIRE(found.size() == pushed.observed.time.size());
    std::vector<double> angle, share, away, feigned;
    int honest = 0;
    for (std::size_t f = 0; f < found.size(); ++f) {
      const Vector3 &truth = pushed.push[f], &force = found[f].force;
      if (truth.norm() == 0.0) feigned.push_back(force.norm() / (mass * 9.81));
      if (truth.norm() < 0.03) continue;
      angle.push_back(std::atan2(truth.cross(force).norm(), truth.dot(force)) * 180.0 / M_PI);
      share.push_back(std::abs(force.norm() / truth.norm() - 1.0));
      away.push_back(std::abs(found[f].contact.arclength - place));
      honest += ((force - truth).cwiseAbs().array() <= 3.0 * found[f].sigma.array()).all();
    }
    CHECK(median(angle) < 15.0);
    CHECK(median(share) < 0.15);
    CHECK(median(away) < 0.025);
    CHECK(median(feigned) < 0.05);
    CHECK(honest >= 0.9 * share.size());
  }
}

// The twin is the rope itself, so that nothing but the base's clock is wrong: its stamps are a frame late, and the
// first joint bends as cameras see it with the base where it is believed to be.
TEST_CASE("a rope whose base is stamped late is not called touched, and is when it is pushed") {
  constexpr double kLate = 1.0 / 30.0;
  const chain::Chain coarse =
      chain::make_chain(0.3, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), 8, chain::Bending::planar, false);
  const dynamics::Model model = dynamics::make_model(coarse, uniform(8, 8, 0.06, 0.02, 2e-3, 0.01));
  for (const double size : {0.0, 0.2}) {  // N
    CAPTURE(size);
    core::Random random(4);
    const auto push_at = [&](double time) {
      const double since = time - 1.5;
      return Vector3(since > 0.0 && since < 1.0 ? size * std::pow(std::sin(M_PI * since), 2) : 0.0, 0.0, 0.0);
    };
    const Swing made = swing(model, coarse, 0.1, 0.6, 120, 0.2, push_at, random);
    const auto late_base = [&](double time) { return made.base.at(time - kLate); };
    chain::States states = made.observed;
    std::vector<force::Clock> clock;
    for (std::size_t f = 0; f < states.time.size(); ++f) {
      clock.push_back({kLate, VectorX::Zero(8)});
      clock[f].theta[0] = late_base(states.time[f]).velocity[3] / 0.1;  // rad/s, about a point 0.1 m below
      states.theta[f] -= kLate * clock[f].theta;
    }
    const auto trusting = force::estimate(model, {}, late_base, force::smooth(states), {});
    const auto found = force::estimate(model, {}, late_base, force::smooth(states, clock), {});
    force::LiveForce follower(model, {}, late_base);
    std::vector<force::Estimate> live;
    for (std::size_t f = 0; f < clock.size(); ++f)
      if (const auto line = follower.update(states.time[f], states.theta[f], {}, clock[f])) live.push_back(*line);
    for (const force::Estimate& line : follower.finish()) live.push_back(line);
    const auto wrong = [&](const std::vector<force::Estimate>& lines) {
      int out = 0;
      for (std::size_t f = 0; f < lines.size(); ++f) out += made.push[f].norm() == 0.0 && lines[f].touching;
      return out;
    };
    CHECK(wrong(trusting) > 30);
    CHECK(wrong(found) <= 1);
    CHECK(wrong(live) <= 1);
    for (std::size_t f = 0; f < found.size(); ++f) {
      if (made.push[f].norm() < 0.5 * size || size == 0.0) continue;
      CHECK(found[f].touching);
      CHECK(live[f].touching);
      CHECK(((found[f].force - made.push[f]).cwiseAbs().array() <= 3.0 * found[f].sigma.array()).all());
      CHECK(std::abs(found[f].force.x() / made.push[f].x() - 1.0) < 0.25);
    }
  }
}

// A straight rope of eight planar joints that lies on a table.
dynamics::Model table_rope(std::vector<double> roll_lever = {}) {
  dynamics::Parameters p = uniform(8, 8, 0.06, 0.012, 1e-3, 0.01);
  p.table_normal = Vector3::UnitZ();
  p.coulomb_friction.assign(8, 0.35);
  if (!roll_lever.empty()) p.roll_lever = std::move(roll_lever);
  return dynamics::make_model(
      chain::make_chain(0.3, 0.02, Vector3::UnitX(), Vector3::UnitZ(), 8, chain::Bending::planar, false), p);
}

TEST_CASE("on a table friction at rest hides forces, and the interval says how much") {
  const dynamics::Model model = table_rope();
  const chain::Chain& rope = model.chain;
  const auto base = [](double) { return dynamics::at_rest({}); };
  const force::Contact contact{chain::link_at(rope, 0.2), 0.2, 0.2 * rope.direction};
  const std::vector<std::optional<force::Contact>> contacts(5, contact);
  const Vector3 push(0.0, 0.1, 0.0);
  // with these rest angles the rope lies straight under the push, and friction balances none, half or all of it
  const MatrixX jacobian = chain::point_jacobian(rope, chain::world_axes(rope, VectorX::Zero(8), {}), contact.link,
                                                 contact.arclength * rope.direction);
  for (const double held : {0.0, 0.5, 1.0}) {
    CAPTURE(held);
    dynamics::Model bent = model;
    for (int k = 0; k < 8; ++k)
      bent.parameters.rest_angle[k] = -(1.0 - held) * jacobian.col(k).dot(push) / bent.parameters.stiffness[k];
    for (const force::Estimate& e :
         force::estimate(bent, force::deviations(bent, {}), base, at_rest(VectorX::Zero(8), 5), contacts)) {
      CHECK_FALSE(e.moving);
      CHECK(e.low.y() < push.y());
      CHECK(e.high.y() > push.y());
      CHECK(e.high.y() - e.low.y() < 0.5);  // friction of 0.2 N on either side, and the shrinkage by the prior
      CHECK(e.low.z() == doctest::Approx(e.high.z()));
    }
  }
}

TEST_CASE("on a table friction that may as well act the other way is no touch") {
  const dynamics::Model model = table_rope();
  const auto base = [](double) { return dynamics::at_rest({}); };
  // the rope turns about the grasp, and is said to turn the other way; where it does so, its rest angles balance it
  const VectorX theta = VectorX::Zero(8), thetadot = 0.1 * VectorX::Unit(8, 0);
  const VectorX off = force::residual_torque(model, base(0.0), theta, thetadot, VectorX::Zero(8));
  dynamics::Model balanced = model;
  for (int k = 0; k < 8; ++k) balanced.parameters.rest_angle[k] = off[k] / model.parameters.stiffness[k];
  for (const bool sure : {true, false}) {
    CAPTURE(sure);
    force::Motion motion = at_rest(theta, 5);
    for (VectorX& rates : motion.thetadot) rates = -thetadot;
    motion.noise = 1e-4 * MatrixX::Identity(8, 8);
    for (Matrix3& covariance : motion.covariance) covariance = Vector3(1e-4, sure ? 1e-4 : 1e3, 1e-4).asDiagonal();
    const std::vector<force::Estimate> found = force::estimate(balanced, {}, base, motion, {});
    CHECK(found[2].touching == sure);
  }
}

// A finger that pushes a sliding rope presses it down, and one that brakes it lifts it, because the rolling rope rubs
// at the finger.
TEST_CASE("on a table a push is told with what it presses the rope down") {
  dynamics::Model model = table_rope({0.0, 0.03, 0.03, 0.03, 0.03, 0.03, 0.03, 0.03});
  const chain::Chain& rope = model.chain;
  const auto base = [](double) { return dynamics::at_rest({}); };
  const VectorX theta = VectorX::LinSpaced(8, 0.25, 0.05), thetadot = VectorX::Constant(8, 0.1);
  const force::Contact contact{chain::link_at(rope, 0.2), 0.2, 0.2 * rope.direction};
  const MatrixX axes = chain::world_axes(rope, theta, {});
  const auto motions = chain::link_motions(rope, theta, {});
  const MatrixX jacobian = chain::point_jacobian(rope, axes, contact.link, motions[contact.link] * contact.home);
  const Vector3 slip = (jacobian * thetadot).normalized();
  const Vector3 across = Vector3::UnitZ().cross(motions[contact.link].rotation * rope.direction);
  const force::Options options;
  for (const double push : {0.15, -0.15}) {  // N, along the slip, and against it to brake it
    CAPTURE(push);
    const Vector3 force = push * slip;
    const double pressed = options.pressing * push;
    // the torque by the push, by the friction of what presses the rope down, and by the impeded roll
    VectorX torque = jacobian.transpose() * (force - 0.35 * pressed * slip);
    for (int k = 0; k < 8; ++k)
      torque[k] -= model.parameters.roll_lever[k] * std::min(rope.link_start(rope.child_link[k]), 0.2) / 0.3 * pressed *
                   slip.dot(across);
    // the rope's rest angles balance it
    dynamics::Model bent = model;
    const VectorX off = force::residual_torque(model, base(0.0), theta, thetadot, VectorX::Zero(8)) - torque;
    for (int k = 0; k < 8; ++k) bent.parameters.rest_angle[k] += off[k] / model.parameters.stiffness[k];
    force::Motion motion = at_rest(theta, 5);
    for (VectorX& rates : motion.thetadot) rates = thetadot;
    const std::vector<std::optional<force::Contact>> contacts(5, contact);
    for (const force::Estimate& e : force::estimate(bent, {}, base, motion, contacts)) {
      const Vector3 flat(e.force.x(), e.force.y(), 0.0);
      CHECK(e.moving);
      CHECK((flat - force).norm() < 0.1 * std::abs(push));
      CHECK(e.force.z() == doctest::Approx(-pressed).epsilon(0.1));
      CHECK(e.observed.z() < 1e-6);  // inferred from the push alone
    }
  }
}

TEST_CASE("the contact is the nearest Gaussian on its most probable link, else the nearest point of the centerline") {
  const chain::Chain rope =
      chain::make_chain(0.3, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), 4, chain::Bending::planar, false);
  splat::Gaussians gaussians;
  gaussians.resize(2, rope.links(), 0);
  const float mean[] = {0.01f, 0.0f, -0.1f, -0.01f, 0.0f, -0.25f};
  std::copy(mean, mean + 6, gaussians.mean.begin());
  gaussians.link_logits[0 * rope.links() + 2] = 5.0f;
  gaussians.link_logits[1 * rope.links() + 4] = 5.0f;
  const VectorX theta = VectorX::Zero(4);
  const MatrixX point = Vector3(0.05, 0.0, -0.20);
  const force::Contact surface = force::nearest_contact(rope, gaussians, math::Pose{}, theta, point);
  CHECK(surface.link == 4);
  CHECK(surface.arclength == doctest::Approx(0.25));
  const force::Contact axis = force::nearest_contact(rope, {}, math::Pose{}, theta, point);
  CHECK(axis.arclength == doctest::Approx(0.20));
  CHECK(axis.link == 3);
}

TEST_CASE("a covariance that is none gives an error, never a force") {
  const Matrix3 prior = Matrix3::Identity();
  const MatrixX jacobian = MatrixX::Ones(3, 4);
  const VectorX residual = VectorX::Ones(4);
  MatrixX covariance = MatrixX::Identity(4, 4);
  CHECK(force::solve(jacobian, residual, covariance, prior).force.allFinite());
  for (const double variance : {-1.0, 0.0, static_cast<double>(NAN), static_cast<double>(INFINITY)}) {
    covariance(1, 1) = variance;
    CHECK_THROWS_AS(force::solve(jacobian, residual, covariance, prior), InputError);
  }
}

TEST_CASE("what is not known of the parameters' covariance is named, and the rest is kept") {
  const Balanced rope = balance(chain::Bending::planar, bent(8), 0.2, Vector3::Zero());
  std::vector<std::string> warnings;
  core::Listener listener;
  listener.warning = [&](const std::string& line) { warnings.push_back(line); };
  core::set_listener(listener);
  dynamics::Estimates estimates;
  estimates.names = {"log_stiffness", "theta_1", "log_damping"};
  estimates.covariance = 0.01 * MatrixX::Identity(3, 3);
  CHECK(force::deviations(rope.model, estimates).size() == 2);
  estimates.covariance.row(1).setConstant(NAN), estimates.covariance.col(1).setConstant(NAN);
  CHECK(force::deviations(rope.model, estimates).size() == 2);  // an initial angle is not a parameter
  CHECK(warnings.empty());
  estimates.covariance(2, 2) = NAN;
  const auto kept = force::deviations(rope.model, estimates);
  REQUIRE(kept.size() == 1);
  CHECK(kept[0].parameters.stiffness[0] == doctest::Approx(std::exp(0.1) * rope.model.parameters.stiffness[0]));
  REQUIRE(warnings.size() == 1);
  CHECK(warnings[0].find("null for log_damping;") != std::string::npos);
  estimates.covariance(0, 0) = NAN;
  CHECK(force::deviations(rope.model, estimates).size() == 16);  // as if nothing had been identified
  CHECK(warnings.size() == 2);
  core::set_listener({});
}

TEST_CASE("a line is JSON, whatever its numbers are") {
  force::Estimate e;
  e.time = 0.4;
  e.contact = {5, 0.18, Vector3::Zero(), 0.0};
  e.force = Vector3(0.1, -2.0, 1e-5);
  CHECK(force::is_finite(e));
  Json line = Json::parse(force::to_json(e, true));
  CHECK(line["force"] == Json({0.1, -2.0, 1e-5}));
  CHECK(line["link"] == 5);
  CHECK(line["unit"] == "N");
  e.contact.arclength = NAN;
  e.sigma[1] = INFINITY;
  CHECK_FALSE(force::is_finite(e));
  line = Json::parse(force::to_json(e, false));
  CHECK(line["arclength"].is_null());
  CHECK(line["sigma"][1].is_null());
  CHECK(line["unit"] == "N/kg");
}

// What a push on a rope of two links is told as.
force::Estimate told() {
  force::Estimate e;
  e.time = 0.1 + 0.2;  // no short decimal
  e.contact = {2, 0.15, Vector3::Zero(), 0.0};
  e.point = Vector3(0.1, 0.0, 1.0 / 3.0);
  e.force = Vector3(0.1, -2.0, 1e-5);
  e.covariance << 4e-4, 1e-5, 0.0, 1e-5, 9e-4, -2e-4, 0.0, -2e-4, 0.09;
  e.sigma = e.covariance.diagonal().cwiseSqrt();
  e.low = e.force - Vector3(0.01, 0.0, 0.0), e.high = e.force + Vector3(0.0, 0.3, 0.0);
  e.observed = Vector3(0.99, 0.5, 0.0);
  e.probability = 0.97, e.arclength_sigma = 0.004;
  e.touching = true, e.moving = false;
  return e;
}

const chain::Chain& two_links() {
  static const chain::Chain rope =
      chain::make_chain(0.2, 0.02, -Vector3::UnitZ(), Vector3::UnitY(), 2, chain::Bending::planar, false);
  return rope;
}

TEST_CASE("a line that is read back is the estimate that it was written from") {
  const force::Estimate e = told();
  for (const bool known : {true, false}) {
    const force::Line line = force::from_json(force::to_json(e, known), "forces.jsonl: line 1", two_links(), -1.0);
    CHECK(line.known_mass == known);
    const force::Estimate& read = line.estimate;
    CHECK(read.time == e.time);
    CHECK(read.contact.link == e.contact.link);
    CHECK(read.contact.arclength == e.contact.arclength);
    for (const auto member : {&force::Estimate::point, &force::Estimate::force, &force::Estimate::sigma,
                              &force::Estimate::low, &force::Estimate::high, &force::Estimate::observed})
      CHECK(read.*member == e.*member);
    CHECK(read.covariance == e.covariance);
    CHECK(read.probability == e.probability);
    CHECK(read.arclength_sigma == e.arclength_sigma);
    CHECK(read.touching == e.touching);
    CHECK(read.moving == e.moving);
  }
}

TEST_CASE("a line that no force can have is refused with its place and field") {
  const Json sound = Json::parse(force::to_json(told(), true));
  // without a value the field is left out
  const auto refused = [&](const std::string& field, const std::optional<Json>& value, const std::string& says) {
    CAPTURE(field);
    CAPTURE(says);
    Json line = sound;
    if (value)
      line[field] = *value;
    else
      line.erase(field);
    try {
      force::from_json(line.dump(), "forces.jsonl: line 7", two_links(), 0.0);
      FAIL("it was taken");
    } catch (const InputError& error) {
      const std::string text = error.what();
      CHECK(text.find("forces.jsonl: line 7: " + field) != std::string::npos);
      CHECK(text.find(says) != std::string::npos);
      CHECK(text.find('\n') == std::string::npos);
    }
  };
  CHECK_NOTHROW(force::from_json(sound.dump(), "line", two_links(), 0.0));
  for (const auto& item : sound.items()) {
    const std::string& field = item.key();
    CAPTURE(field);
    refused(field, std::nullopt, "is missing");
    refused(field, Json(), "is no");  // what is not finite is written as null
    refused(field, Json::object(), "is no");
  }
  refused("time", 0.0, "is not after");
  refused("time", 1e300, "is not from");
  refused("link", 3, "is not from 0 to 2");
  refused("link", -1, "is not from 0 to 2");
  refused("link", 1.5, "is no whole number");
  refused("link", 4294967297, "is not from 0 to 2");
  refused("arclength", 0.21, "is not from 0 to");
  refused("arclength_sigma", -1e-9, "is not from 0 to");
  refused("point", Json({0.0, 1e7, 0.0}), "is not from");
  refused("force", Json({0.0, 0.0}), "is no list of 3 numbers");
  refused("force", Json({0.0, nullptr, 0.0}), "is no finite number");
  refused("force", Json({0.0, 1e10, 0.0}), "is not from");
  refused("sigma", Json({-0.02, 0.03, 0.3}), "is not from 0 to");
  refused("sigma", Json({0.02, 0.03, 0.4}), "is not that of the covariance");
  refused("covariance", Json({1, 2, 1, 0, 0, 1}), "is not positive semidefinite");
  refused("covariance", Json({1, 0, 1, 0, 0, -1}), "is not positive semidefinite");
  refused("covariance", Json({{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}), "is no list of 6 numbers");
  refused("covariance", Json({1, 0, 1, 0, 0, 1e300}), "is not from");
  refused("low", Json({1, 1, 1}), "is above high");
  refused("observed", Json({0.0, 1.5, 0.0}), "is not from 0 to 1");
  refused("probability", 1.5, "is not from 0 to 1");
  refused("touching", 1, "is not true or false");
  refused("moving", "yes", "is not true or false");
  refused("unit", "lbf", "is not N or N/kg");
  for (const char* line : {"", "[]", "{", "nan", "{\"time\":1e999}"})
    CHECK_THROWS_AS(force::from_json(line, "line", two_links(), 0.0), InputError);
  CHECK_THROWS_AS(force::from_json(std::string(1 << 20, '['), "line", two_links(), 0.0), InputError);
}

}  // namespace
