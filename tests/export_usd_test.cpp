// USD as text, read back here line by line; tests/cli/exports.sh has OpenUSD read it where Python has that.
#include <doctest/doctest.h>

#include <sstream>

#include "chainsplat/export.h"
#include "small_twin.h"

using namespace chainsplat;

namespace {

// One link as the file has it: translations and quaternions (w, x, y, z), one or one a time code.
struct Link {
  std::vector<double> time;
  std::vector<std::vector<double>> place, turn;
};

std::vector<double> numbers(std::string text) {
  for (char& letter : text)
    if (letter == '(' || letter == ')' || letter == ',') letter = ' ';
  std::istringstream stream(text);
  std::vector<double> out;
  for (double value = 0.0; stream >> value;) out.push_back(value);
  return out;
}

// The links of the file, outermost first, without their shapes.
std::vector<Link> links_of(const std::string& text) {
  std::vector<Link> out;
  std::istringstream stream(text);
  std::vector<std::vector<double>>* sampled = nullptr;
  std::vector<double> times;
  int open = 0;
  bool in_link = false;
  CHECK(text.starts_with("#usda 1.0\n"));
  CHECK(text.find("nan") == std::string::npos);
  for (std::string line; std::getline(stream, line);) {
    for (const char letter : line) open += letter == '{' || letter == '(' ? 1 : letter == '}' || letter == ')' ? -1 : 0;
    if (line.find("def ") != std::string::npos) {
      in_link = line.find("Xform \"link_" + std::to_string(out.size()) + "\"") != std::string::npos;
      if (in_link) out.emplace_back();
    } else if (sampled) {
      if (const std::size_t colon = line.find(": "); colon != std::string::npos) {
        times.push_back(std::stod(line));
        sampled->push_back(numbers(line.substr(colon + 1)));
      } else {
        sampled = nullptr;
        out.back().time = times;
      }
    } else if (in_link && line.find(" xformOp:") != std::string::npos) {
      std::vector<std::vector<double>>& to =
          line.find("xformOp:orient") != std::string::npos ? out.back().turn : out.back().place;
      const std::size_t equals = line.find(" = ");
      if (line.find(".timeSamples") != std::string::npos)
        sampled = &to, times.clear();
      else
        to.push_back(numbers(line.substr(equals + 2)));
    }
  }
  CHECK(open == 0);
  return out;
}

math::Pose pose(const Link& link, std::size_t k) {
  const auto at = [&](const std::vector<std::vector<double>>& all) { return all.at(all.size() == 1 ? 0 : k); };
  const std::vector<double> place = at(link.place), turn = at(link.turn);
  REQUIRE(place.size() == 3);
  REQUIRE(turn.size() == 4);
  return {Eigen::Quaterniond(turn[0], turn[1], turn[2], turn[3]).toRotationMatrix(), {place[0], place[1], place[2]}};
}

}  // namespace

TEST_CASE("USD: links move as the chain's do, along time codes that are the motion's frames") {
  for (const chain::Bending bending : {chain::Bending::planar, chain::Bending::spatial}) {
    const twin::Twin twin = test::small_twin(bending, 60);
    const chain::Chain& chain = twin.chain;
    const trajectory::Trajectory base = test::moving_base(1.2);
    const chain::States motion = test::swing(chain, 1.0, 0.1);
    const std::string text = exports::usd(twin, motion, base);
    CHECK(text.find("timeCodesPerSecond = 30\n") != std::string::npos);
    const std::vector<Link> links = links_of(text);
    REQUIRE(static_cast<int>(links.size()) == chain.links());
    for (const std::size_t k : {std::size_t{0}, std::size_t{7}, motion.time.size() - 1}) {
      const std::vector<math::Pose> motions = chain::link_motions(chain, motion.theta[k], base.pose(motion.time[k]));
      math::Pose world;
      for (int j = 0; j < chain.links(); ++j) {
        CHECK(links[j].time.at(k) == doctest::Approx(static_cast<double>(k)));
        world = world * pose(links[j], k);
        const math::Pose wanted =
            motions[j] * math::Pose{math::Matrix3::Identity(), chain.link_start(j) * chain.direction};
        CHECK((world.translation - wanted.translation).norm() < 1e-13);
        CHECK((world.rotation - wanted.rotation).norm() < 1e-13);
      }
    }
    for (const Link& link : links)
      for (std::size_t k = 1; k < link.turn.size(); ++k) {
        double along = 0.0;
        for (int c = 0; c < 4; ++c) along += link.turn[k][c] * link.turn[k - 1][c];
        CHECK(along > 0.0);
      }
  }
}

TEST_CASE("USD without motion is the rope at home, and no name breaks it") {
  twin::Twin twin = test::small_twin();
  twin.provenance.capture = "a \"rope\"\\ {\n(";
  const std::string text = exports::usd(twin, {}, {});
  CHECK(text.find("The rope a \\\"rope\\\"\\\\ {") != std::string::npos);
  CHECK(text.find("timeSamples") == std::string::npos);
  twin.provenance.capture = "a rope";
  const std::vector<Link> links = links_of(exports::usd(twin, {}, {}));
  math::Pose world;
  for (int j = 0; j < twin.chain.links(); ++j) {
    world = world * pose(links.at(j), 0);
    CHECK((world.translation - twin.chain.link_start(j) * twin.chain.direction).norm() < 1e-15);
  }
  twin.gaussians = {};  // gray
  CHECK(exports::usd(twin, {}, {}).find("displayColor = [(0.2140411") != std::string::npos);
  const test::TemporaryFolder folder("usd");
  exports::write(twin, twin.states, test::moving_base(1.0), folder.path / "rope.usda");
  CHECK(core::read_file(folder.path / "rope.usda") == exports::usd(twin, twin.states, test::moving_base(1.0)));
}
