// URDF as its readers take it: a small reader here, which shares no code with the writer, poses the links and sums up
// their inertia.
#include <doctest/doctest.h>

#include <map>
#include <sstream>

#include "chainsplat/export.h"
#include "small_twin.h"

using namespace chainsplat;

namespace {

struct Element {
  std::string name;
  std::map<std::string, std::string> attributes;
  std::vector<Element> children;

  const Element* child(const std::string& wanted) const {
    for (const Element& each : children)
      if (each.name == wanted) return &each;
    return nullptr;
  }
  const Element& at(const std::string& wanted) const {
    const Element* const found = child(wanted);
    REQUIRE_MESSAGE(found, name << " has no " << wanted);
    return *found;
  }
  const std::string& text(const std::string& attribute) const {
    REQUIRE_MESSAGE(attributes.contains(attribute), name << " has no " << attribute);
    return attributes.at(attribute);
  }
  std::vector<double> numbers(const std::string& attribute) const {
    std::istringstream stream(text(attribute));
    std::vector<double> out;
    for (std::string word; stream >> word;) {
      std::size_t used = 0;
      out.push_back(std::stod(word, &used));
      CHECK(used == word.size());
      CHECK(std::isfinite(out.back()));
    }
    return out;
  }
  double number(const std::string& attribute) const { return numbers(attribute).at(0); }
  math::Vector3 vector(const std::string& attribute) const {
    const std::vector<double> all = numbers(attribute);
    REQUIRE(all.size() == 3);
    return {all[0], all[1], all[2]};
  }
};

// As much of XML as the file may have: elements, attributes in double quotes, one declaration and comments. Fails where
// it is not well-formed.
Element parsed(const std::string& text) {
  std::vector<Element> open{{"document", {}, {}}};
  std::size_t at = 0;
  const auto skip_to = [&](const std::string& end) {
    const std::size_t found = text.find(end, at);
    REQUIRE_MESSAGE(found != std::string::npos, end << " is missing after " << text.substr(at, 40));
    const std::string between = text.substr(at, found - at);
    at = found + end.size();
    return between;
  };
  while (at < text.size()) {
    if (text[at] != '<') {
      ++at;
    } else if (text.compare(at, 4, "<!--") == 0) {
      at += 4;
      const std::string comment = skip_to("--");
      CHECK(text[at] == '>');  // no two hyphens within
      CHECK(!comment.ends_with('-'));
    } else if (text.compare(at, 2, "<?") == 0) {
      CHECK(at == 0);
      skip_to("?>");
    } else if (text.compare(at, 2, "</") == 0) {
      at += 2;
      REQUIRE(skip_to(">") == open.back().name);
      REQUIRE(open.size() > 1);
      Element done = std::move(open.back());
      open.pop_back();
      open.back().children.push_back(std::move(done));
    } else {
      ++at;
      std::string tag = skip_to(">");
      const bool closed = tag.ends_with('/');
      if (closed) tag.pop_back();
      CHECK(tag.find('<') == std::string::npos);
      Element made{tag.substr(0, tag.find(' ')), {}, {}};
      for (std::size_t i = tag.find('"'), start = made.name.size(); i != std::string::npos;) {
        const std::size_t end = tag.find('"', i + 1);
        REQUIRE(end != std::string::npos);
        const std::string key = tag.substr(start + 1, i - start - 2);
        CHECK(!made.attributes.contains(key));
        made.attributes[key] = tag.substr(i + 1, end - i - 1);
        start = end + 1;
        i = tag.find('"', end + 1);
      }
      (closed ? open.back().children : open).push_back(std::move(made));
    }
  }
  REQUIRE(open.size() == 1);
  REQUIRE(open[0].children.size() == 1);
  return open[0].children[0];
}

math::Pose pose(const Element& origin) {
  const math::Vector3 turn = origin.vector("rpy");
  const Eigen::Quaterniond q = Eigen::AngleAxisd(turn.z(), math::Vector3::UnitZ()) *
                               Eigen::AngleAxisd(turn.y(), math::Vector3::UnitY()) *
                               Eigen::AngleAxisd(turn.x(), math::Vector3::UnitX());
  return {q.toRotationMatrix(), origin.vector("xyz")};
}

// Poses of all links by name, and the mass matrix: sum of J^T G J over the links.
struct Posed {
  std::map<std::string, math::Pose> links;
  math::MatrixX mass;
  double total = 0.0;                            // kg
  math::Vector3 moment = math::Vector3::Zero();  // kg m, of all masses
};
Posed posed(const Element& robot, const math::VectorX& theta) {
  std::map<std::string, std::vector<const Element*>> joints_of;  // by parent
  std::map<std::string, const Element*> links;
  std::string root;
  std::map<std::string, int> parents;
  for (const Element& each : robot.children) {
    if (each.name == "link") {
      CHECK(links.emplace(each.text("name"), &each).second);
    } else if (each.name == "joint") {
      joints_of[each.at("parent").text("link")].push_back(&each);
      CHECK(++parents[each.at("child").text("link")] == 1);
    }
  }
  for (const auto& [name, link] : links) {
    if (parents.contains(name)) continue;
    CHECK(root.empty());
    root = name;
  }
  CHECK(root == "link_0");
  CHECK(parents.size() + 1 == links.size());

  Posed out;
  out.mass = math::MatrixX::Zero(theta.size(), theta.size());
  const std::function<void(const std::string&, const math::Pose&, math::MatrixX)> visit =
      [&](const std::string& name, const math::Pose& world, const math::MatrixX& axes) {
        REQUIRE(links.contains(name));
        out.links[name] = world;
        const Element& inertial = links[name]->at("inertial");
        const Element& i = inertial.at("inertia");
        math::Matrix3 about;
        about << i.number("ixx"), i.number("ixy"), i.number("ixz"), i.number("ixy"), i.number("iyy"), i.number("iyz"),
            i.number("ixz"), i.number("iyz"), i.number("izz");
        const math::Vector3 moments = Eigen::SelfAdjointEigenSolver<math::Matrix3>(about).eigenvalues();
        CHECK(moments[0] > 1e-15);                               // MuJoCo's bound
        CHECK(moments[2] <= (moments[0] + moments[1]) * 1.001);  // it could be a body
        const double mass = inertial.at("mass").number("value");
        CHECK(mass > 0.0);
        out.total += mass;
        const math::Pose center = world * pose(inertial.at("origin"));
        const math::MatrixX turning = axes.topRows(3);
        math::MatrixX going = axes.bottomRows(3);
        for (Eigen::Index k = 0; k < going.cols(); ++k)
          going.col(k) += math::Vector3(axes.col(k).head<3>()).cross(center.translation);
        out.moment += mass * center.translation;
        out.mass += mass * going.transpose() * going +
                    turning.transpose() * center.rotation * about * center.rotation.transpose() * turning;
        for (const Element* const joint : joints_of[name]) {
          CHECK(joint->text("type") == "continuous");
          const int k = std::stoi(joint->text("name").substr(6)) - 1;
          CHECK(joint->text("name") == "theta_" + std::to_string(k + 1));
          const math::Pose here = world * pose(joint->at("origin"));
          const math::Vector3 axis = joint->at("axis").vector("xyz");
          math::MatrixX next = axes;
          next.col(k).head<3>() = here.rotation * axis;
          next.col(k).tail<3>() = -(here.rotation * axis).cross(here.translation);
          const math::Pose turn{Eigen::AngleAxisd(theta[k], axis).toRotationMatrix(), math::Vector3::Zero()};
          visit(joint->at("child").text("link"), here * turn, next);
        }
      };
  visit(root, {}, math::MatrixX::Zero(6, theta.size()));
  CHECK(out.links.size() == links.size());
  return out;
}

twin::Twin with_chain(const chain::Chain& chain) {
  twin::Twin twin = test::small_twin();
  twin.chain = chain;
  twin.gaussians = test::spiral_gaussians(chain, 100);
  dynamics::Parameters& p = *twin.parameters;
  p.stiffness.resize(chain.angles(), 2e-3), p.rest_angle.resize(chain.angles(), 0.1);
  p.damping.resize(chain.angles(), 1e-4);
  twin.initial->theta = twin.initial->thetadot = math::VectorX::Constant(chain.angles(), 0.3);
  return twin;
}

}  // namespace

TEST_CASE("URDF: links stand where the chain's do, and weigh as the twin does") {
  const math::Vector3 down = -math::Vector3::UnitZ(), side = math::Vector3::UnitY();
  const math::Vector3 slanted = math::Vector3(1, 2, -2) / 3.0, across = math::Vector3(2, 1, 2) / 3.0;
  const auto make = [](const math::Vector3& d, const math::Vector3& a, chain::Bending bending, bool twist,
                       double first) {
    return with_chain(chain::make_chain(0.3, 0.02, d, a, 5, bending, twist, first));
  };
  twin::Twin rod = make(down, side, chain::Bending::spatial, false, 0.0);
  rod.parameters->radius = 0.0, rod.parameters->tip_mass = 0.0;
  twin::Twin loaded = make(down, side, chain::Bending::spatial, false, 0.0);
  loaded.parameters->tip_mass = 0.02, loaded.parameters->tip_length = 0.04;
  for (const twin::Twin& twin : {make(side, down, chain::Bending::planar, false, 0.013), rod, loaded,
                                 make(slanted, across, chain::Bending::spatial, false, 0.013),
                                 make(down, side, chain::Bending::spatial, true, 0.0)}) {
    const chain::Chain& chain = twin.chain;
    const Element robot = parsed(exports::urdf(twin));
    CHECK(robot.name == "robot");
    core::Random random(5);
    math::VectorX theta(chain.angles());
    for (double& each : theta) each = random.uniform(-1.0, 1.0);
    const Posed found = posed(robot, theta);
    CHECK(static_cast<int>(found.links.size()) == chain.angles() + 1);
    const std::vector<math::Pose> motions = chain::link_motions(chain, theta, {});
    for (int j = 0; j < chain.links(); ++j) {
      const math::Pose wanted =
          motions[j] * math::Pose{math::Matrix3::Identity(), chain.link_start(j) * chain.direction};
      const math::Pose& is = found.links.at("link_" + std::to_string(j));
      CHECK((is.translation - wanted.translation).norm() < 1e-14);
      CHECK((is.rotation - wanted.rotation).norm() < 1e-14);
    }
    CHECK(found.total == doctest::Approx(dynamics::total_mass(*twin.parameters)).epsilon(1e-14));
    // the base too: a rope that hangs on a robot's arm is felt by it
    const double end = chain.length + 0.5 * twin.parameters->tip_length;
    math::Vector3 moment = twin.parameters->tip_mass * (motions.back() * (end * chain.direction));
    for (int j = 1; j < chain.links(); ++j)
      moment += twin.parameters->link_mass[j - 1] *
                (motions[j] * (0.5 * (chain.link_start(j) + chain.link_end(j)) * chain.direction));
    CHECK((found.moment - moment).norm() < 1e-15);
    const math::MatrixX mass = dynamics::mass_matrix(dynamics::make_model(chain, *twin.parameters), theta);
    // each entry beside the angles' own ones; what twists a rope has little of it, which the links before add to
    const math::VectorX own = mass.diagonal().cwiseSqrt();
    const math::MatrixX error = own.cwiseInverse().asDiagonal() * (found.mass - mass) * own.cwiseInverse().asDiagonal();
    CHECK(error.cwiseAbs().maxCoeff() < 1e-5);
    CHECK(error.cwiseAbs().maxCoeff() > 0.0);  // it is not compared with itself
  }
}

TEST_CASE("URDF: shapes cover the links in the twin's colors, joints have its damping and friction") {
  twin::Twin twin = with_chain(chain::make_chain(0.3, 0.02, math::Vector3(1, 2, -2) / 3.0, math::Vector3(2, 1, 2) / 3.0,
                                                 5, chain::Bending::spatial, false, 0.013));
  dynamics::Parameters& p = *twin.parameters;
  for (int k = 0; k < twin.chain.angles(); ++k) {
    p.damping[k] = 1e-4 * (k + 1);
    p.bending_friction.push_back(1e-3 * (k + 1)), p.bending_friction_angle.push_back(0.05);
  }
  const Element robot = parsed(exports::urdf(twin));
  std::map<std::string, std::vector<double>> colors;
  int links = 0, springs = 0;
  for (const Element& each : robot.children) {
    if (each.name == "material") {
      colors[each.text("name")] = each.at("color").numbers("rgba");
      for (const double value : colors[each.text("name")]) CHECK((value >= 0.0 && value <= 1.0));
    } else if (each.name == "joint") {
      const int k = std::stoi(each.text("name").substr(6)) - 1;
      CHECK(each.at("dynamics").number("damping") == p.damping[k]);
      CHECK(each.at("dynamics").number("friction") == p.bending_friction[k]);
    } else if (each.name == "gazebo") {
      ++springs;
    } else if (each.name == "link" && each.text("name").starts_with("link_")) {
      ++links;
      const int j = std::stoi(each.text("name").substr(5));
      const double length = twin.chain.link_end(j) - twin.chain.link_start(j);
      std::map<std::string, int> shapes;
      for (const Element& shape : each.children) {
        if (shape.name == "inertial") continue;
        const math::Pose place = pose(shape.at("origin"));
        const bool ball = shape.at("geometry").child("sphere") != nullptr;
        const Element& body = shape.at("geometry").at(ball ? "sphere" : "cylinder");
        CHECK(body.number("radius") == 0.5 * twin.chain.diameter);
        if (!ball) {
          CHECK(body.number("length") == length);
          CHECK((place.rotation.col(2) - twin.chain.direction).norm() < 1e-12);
        }
        CHECK((place.translation - (ball ? 1.0 : 0.5) * length * twin.chain.direction).norm() < 1e-15);
        if (shape.name == "visual") CHECK(colors.contains(shape.at("material").text("name")));
        ++shapes[shape.name + (ball ? " ball" : " cylinder")];
      }
      CHECK(shapes ==
            std::map<std::string, int>{
                {"visual ball", 1}, {"visual cylinder", 1}, {"collision ball", 1}, {"collision cylinder", 1}});
    }
  }
  CHECK(links == twin.chain.links());
  CHECK(springs == twin.chain.angles());
  CHECK(static_cast<int>(colors.size()) == links);
  CHECK(colors["color_1"] != colors["color_4"]);
}

TEST_CASE("URDF: what it cannot say stands at its head, and no name breaks it") {
  twin::Twin twin = test::small_twin();
  twin.known_mass = false;
  dynamics::Parameters& p = *twin.parameters;
  p.torsional_stiffness = {1.25e-3, 2.5e-3, 3.75e-3, 5e-3, 6.25e-3};
  const auto head = [&] {
    const std::string text = exports::urdf(twin);
    parsed(text);
    CHECK(text.find("nan") == std::string::npos);
    return text.substr(0, text.find("-->"));
  };
  const std::string free = head();
  CHECK(free.find("counts as 1 kg") != std::string::npos);
  for (const double size : {p.stiffness[3], p.rest_angle[2], p.torsional_stiffness[1], p.air_quadratic[4],
                            twin.initial->theta[1], twin.initial->thetadot[0]})
    CHECK(free.find(" " + core::exact(size)) != std::string::npos);
  CHECK(free.find("table") == std::string::npos);
  CHECK(free.find("N s/m:") == std::string::npos);  // this rope has no linear drag

  twin.tabletop = true;
  twin.table_point = math::Vector3(0, 0, 0.54);
  p.table_normal = twin.table_normal = math::Vector3::UnitZ();
  CHECK(head().find("coefficients: " + core::exact(p.coulomb_friction[0])) != std::string::npos);
  CHECK(parsed(exports::urdf(twin)).at("mujoco").at("option").vector("gravity").norm() == 0.0);

  twin.provenance.capture = "\"/>--><x a='&";
  CHECK(parsed(exports::urdf(twin)).text("name") == "&quot;/&gt;- -&gt;&lt;x a='&amp;");
  twin.provenance.capture.clear();
  CHECK(parsed(exports::urdf(twin)).text("name") == "rope");

  // one file; not without dynamics
  CHECK(exports::files("a/rope.URDF") == std::vector<Path>{"a/rope.URDF"});
  const test::TemporaryFolder folder("urdf");
  exports::write(twin, twin.states, {}, folder.path / "rope.urdf");
  CHECK(core::read_file(folder.path / "rope.urdf") == exports::urdf(twin));
  twin.parameters.reset();
  CHECK_THROWS_AS(exports::write(twin, twin.states, {}, folder.path / "bare.urdf"), InputError);
  CHECK(!std::filesystem::exists(folder.path / "bare.urdf"));
}
