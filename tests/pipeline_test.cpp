// What the program does, by calls. Cases that train twins are of the suite "whole".
#include "chainsplat/pipeline.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>

#include "chainsplat/batch.h"
#include "chainsplat/estimation.h"
#include "chainsplat/follow.h"
#include "chainsplat/force.h"
#include "chainsplat/rope.h"
#include "chainsplat/run_folder.h"
#include "small_twin.h"

using namespace chainsplat;

namespace {

const Path kDemo = Path(CHAINSPLAT_SOURCE_DIR) / "assets/demo_free_30";

pipeline::TrainOptions small() {
  pipeline::TrainOptions options;
  options.joints = 3;
  options.bending = chain::Bending::planar;
  options.frames = {0, 8};
  return options;
}

// The field that an options struct says is wrong; empty: none.
template <class Options>
std::string wrong_field(const Options& options) {
  try {
    options.check();
  } catch (const InputError& error) {
    return error.where;
  }
  return "";
}

std::vector<std::string> files_of(const Path& run) {
  std::vector<std::string> bytes;
  for (const char* name : {"gaussians.ply", "states.csv", "rollout.csv", "covariance.csv", "metrics.json"})
    bytes.push_back(core::read_file(run / name));
  return bytes;
}

}  // namespace

TEST_CASE("check() names the wrong field") {
  pipeline::TrainOptions train;
  CHECK(wrong_field(train) == "");
  train.joints = 0;
  CHECK(wrong_field(train) == "`joints`");
  train = {}, train.every = 0;
  CHECK(wrong_field(train) == "`every`");
  train = {}, train.frames = {5, 5};
  CHECK(wrong_field(train) == "`frames`");
  train = {}, train.force = train.resume = true;
  CHECK(wrong_field(train) == "`force`, `resume`");
  pipeline::RolloutOptions rollout;
  CHECK(wrong_field(rollout) == "");
  rollout.rate = 0.0;
  CHECK(wrong_field(rollout) == "`rate`");
  pipeline::FollowOptions follow;
  follow.drop = 0;
  CHECK(wrong_field(follow) == "`drop`");
  pipeline::ForceOptions force;
  CHECK(wrong_field(force) == "`states`, `estimate`");
  force.states = "states.csv", force.hand = "hand.ply";
  CHECK(wrong_field(force) == "");
  force.contact.emplace(0.0, 0.0, NAN);
  CHECK(wrong_field(force) == "`contact`, `contacts`, `hand`");
  force.hand.clear();
  CHECK(wrong_field(force) == "`contact`");
}

TEST_CASE("settings are read from texts, and refused by the name of where they stand") {
  pipeline::TrainOptions options;
  for (const auto& [name, text] : {std::pair("joints", "6"),
                                   {"bending", "spatial"},
                                   {"twist", "true"},
                                   {"every", "2"},
                                   {"frames", "3:"},
                                   {"mode", "paper"},
                                   {"stages", "identify,rollout"},
                                   {"joint", "true"}})
    pipeline::set(options, name, text, "a");
  CHECK(options.joints == 6);
  CHECK(options.bending == chain::Bending::spatial);
  CHECK(options.twist);
  CHECK(options.every == 2);
  CHECK(options.frames == capture::FrameRange{3, -1});
  CHECK(options.mode == twin::Mode::paper);
  CHECK(options.stages == std::vector{pipeline::Stage::identify, pipeline::Stage::rollout});
  CHECK(options.joint);
  for (const pipeline::Setting& setting : pipeline::settings())
    CHECK_THROWS_WITH_AS(pipeline::set(options, setting.name, "never", "jobs.toml: x"),
                         doctest::Contains("jobs.toml: x: "), InputError);
}

TEST_CASE("a wrong request writes nothing, and an error keeps its three fields") {
  const test::TemporaryFolder folder("wrong");
  pipeline::TrainOptions options = small();
  options.frames = {400, 500};
  try {
    pipeline::train(kDemo, folder.path / "run", options);
    FAIL("frames that are not there");
  } catch (const InputError& error) {
    CHECK(error.where == "`frames`");
    CHECK(error.problem == "'400:500' holds none of the capture's frames");
    CHECK(error.mend.starts_with("cam0 has "));
    CHECK(std::string(error.what()) == error.where + ": " + error.problem + "; " + error.mend);
  }
  CHECK(!std::filesystem::exists(folder.path / "run"));
}

TEST_CASE("train by a call, stopped by the listener and gone on with, then evaluate, roll out and follow" *
          doctest::test_suite("whole")) {
  const test::TemporaryFolder folder("train");
  const Path whole = folder.path / "whole", stopped = folder.path / "stopped";

  std::vector<std::string> stages;
  core::Listener listener;
  listener.progress = [&](const core::Progress& p) {
    if (stages.empty() || stages.back() != p.stage) stages.push_back(p.stage);
  };
  const pipeline::TrainResult result = pipeline::train(kDemo, whole, small(), listener);
  CHECK(stages.front() == "recognize");
  CHECK(stages.back() == "evaluate");
  const twin::Twin& twin = result.twin;
  CHECK(twin.chain.angles() == 3);
  CHECK(twin.states.time.size() == 8);
  CHECK(twin.provenance.frames == capture::FrameRange{0, 8});
  CHECK(twin.provenance.mass.has_value());
  REQUIRE(twin.parameters);
  REQUIRE(result.recognized);
  REQUIRE(result.rollout);
  // three links for a bent rope: 0.906 and 5.0 mm
  CHECK(result.rollout->mean.iou > 0.88);
  CHECK(result.rollout->mean.centerline_rms < 6e-3);
  CHECK(!std::filesystem::exists(whole / "checkpoint"));

  // stopped at the listener's first word after the Gaussians have begun to move, then to the same bits
  bool stop = false;
  core::Listener impatient;
  impatient.progress = [&](const core::Progress& p) { stop = p.stage == "recognize" && std::isfinite(p.loss); };
  impatient.stop = [&] { return stop; };
  CHECK_THROWS_AS(pipeline::train(kDemo, stopped, small(), impatient), Interrupted);
  CHECK(core::stop_requested() == 0);
  CHECK(std::filesystem::exists(stopped / "checkpoint"));
  CHECK(!std::filesystem::exists(stopped / "twin.json"));
  CHECK_THROWS_WITH_AS(pipeline::train(kDemo, stopped, small()), doctest::Contains("not empty"), InputError);
  pipeline::TrainOptions resume = small();
  resume.resume = true;
  resume.every = 2;
  CHECK_THROWS_WITH_AS(pipeline::train(kDemo, stopped, resume), doctest::Contains("`every` 5, not 2"), InputError);
  resume.every = small().every;
  // once more amid the last steps, beside Gaussians whose colors are guessed
  stop = false;
  impatient.progress = [&](const core::Progress& p) { stop = p.note == "settle"; };
  CHECK_THROWS_AS(pipeline::train(kDemo, stopped, resume, impatient), Interrupted);
  pipeline::train(kDemo, stopped, resume);
  CHECK(files_of(stopped) == files_of(whole));

  pipeline::EvaluateOptions evaluation;
  evaluation.frames = {0, 8};
  const pipeline::Evaluation again = pipeline::evaluate(whole, kDemo, evaluation);
  REQUIRE(again.rollout);
  CHECK(again.rollout->mean.iou == result.rollout->mean.iou);

  const pipeline::RolloutResult rolled = pipeline::rollout(whole, {});
  CHECK(rolled.states.time.front() == twin.initial->time);
  CHECK(rolled.states.theta.front().isApprox(twin.initial->theta));

  const pipeline::IdentifyResult identified = pipeline::identify({whole}, {});
  CHECK(identified.twins[0].estimates.values == twin.estimates.values);
  REQUIRE(identified.lost_metrics.size() == 1);
  CHECK(!std::filesystem::exists(whole / "metrics.json"));

  pipeline::FollowOptions follow;
  follow.source.source = kDemo, follow.source.camera = "cam0", follow.source.frames = {0, 8};
  follow.solver = pipeline::Solver::silhouette;
  pipeline::Follower follower(whole, follow);
  int frames = 0;
  follower.follow([&](const pipeline::Followed& followed) {
    CHECK(!followed.estimate.lost);
    CHECK(followed.estimate.theta.size() == 3);
    ++frames;
  });
  CHECK(frames == 8);

  // forces of the files are those of the values; live, each comes two states after its own
  const pipeline::Rope rope = pipeline::load_rope(whole);
  const std::vector<force::Estimate> known = pipeline::forces(rope, rope.twin.states, rope.base);
  pipeline::ForceOptions forces;
  forces.states = whole / "states.csv";
  for (const bool live : {false, true}) {
    forces.live = live;
    std::vector<force::Estimate> found;
    const pipeline::ForceResult summary =
        pipeline::forces(whole, forces, [&](const force::Estimate& estimate, bool) { found.push_back(estimate); });
    REQUIRE(found.size() == 8);
    CHECK(summary.states == 8);
    CHECK(summary.known_mass);
    for (std::size_t f = 0; f < 8; ++f) {
      CHECK(found[f].time == known[f].time);
      if (!live) CHECK((found[f].force - known[f].force).norm() < 1e-9);
    }
  }
  forces.contact.emplace(100.0, 0.0, 0.0);
  CHECK_THROWS_WITH_AS(pipeline::forces(whole, forces, [](const force::Estimate&, bool) {}),
                       doctest::Contains("`contact`: never comes nearer"), InputError);
}

TEST_CASE("trainings that share a workspace have the bits of those that do not, and notice a capture that changes" *
          doctest::test_suite("whole")) {
  const test::TemporaryFolder folder("workspace");
  // the base's clock is late, so that there is something to correct
  const Path capture = folder.path / "capture";
  std::filesystem::copy(kDemo, capture, std::filesystem::copy_options::recursive);
  std::vector<trajectory::Sample> base = trajectory::read_tum(kDemo / "base.tum");
  for (trajectory::Sample& sample : base) sample.time += 0.02;
  core::write_file(capture / "base.tum", trajectory::write_tum(base));
  pipeline::TrainOptions options = small();
  options.frames = {3, 31};  // too few to look for a readout, which takes a while
  const auto late = [](const pipeline::TrainResult& result) {
    const capture::Correction* const found = capture::find(result.twin.corrections, "base", "time");
    return found ? found->value[0] : 0.0;
  };

  std::string description = core::read_file(capture / "capture.json");
  core::write_file(capture / "capture.json", description.insert(1, "\"unheard_of\": 1,"));  // of which reading warns
  std::vector<std::string> told;
  core::Listener listener;
  listener.warning = listener.record = [&](const std::string& line) { told.push_back(line); };

  const pipeline::TrainResult alone = pipeline::train(capture, folder.path / "alone", options, listener);
  CHECK(late(alone) == doctest::Approx(0.02).epsilon(0.2));
  const std::vector<std::string> told_alone = std::exchange(told, {});
  CHECK(told_alone.size() >= 2);
  const std::shared_ptr<pipeline::Workspace> workspace = pipeline::make_workspace();
  for (const char* const name : {"first", "second"}) {
    CAPTURE(name);
    const pipeline::TrainResult shared =
        pipeline::train(capture, folder.path / name, options, listener, workspace.get());
    CHECK(std::exchange(told, {}) == told_alone);  // that the capture was read and corrected before hides nothing
    CHECK(files_of(folder.path / name) == files_of(folder.path / "alone"));
    CHECK(late(shared) == late(alone));
    CHECK(shared.twin.verdict.size() == alone.twin.verdict.size());
    CHECK(shared.twin.chain.length == alone.twin.chain.length);
  }

  // what changes is noticed: what is taken as given,
  pipeline::TrainOptions held = options;
  held.fixed = {"time"};
  CHECK(late(pipeline::train(capture, folder.path / "held", held, {}, workspace.get())) == 0.0);

  // which frames,
  pipeline::TrainOptions fewer = options;
  fewer.frames = {3, 20};
  CHECK(pipeline::train(capture, folder.path / "fewer", fewer, {}, workspace.get()).twin.states.time.size() == 17);

  // a stop, which leaves a workspace that can be used,
  core::Listener stopping;
  stopping.stop = [] { return true; };
  CHECK_THROWS_AS(pipeline::train(capture, folder.path / "stopped", options, stopping, workspace.get()), Interrupted);
  core::clear_stop();
  pipeline::train(capture, folder.path / "after", options, {}, workspace.get());
  CHECK(files_of(folder.path / "after") == files_of(folder.path / "alone"));

  // a mask of the same size,
  const std::uint64_t before = capture::stamp(capture);
  CHECK(capture::stamp(capture) == before);
  const Path mask = std::filesystem::directory_iterator(capture / "masks" / "cam0")->path();
  std::filesystem::last_write_time(mask, std::filesystem::last_write_time(mask) + std::chrono::seconds(5));
  CHECK(capture::stamp(capture) != before);

  // and the base's file
  core::write_file(capture / "base.tum", core::read_file(kDemo / "base.tum"));
  CHECK(std::abs(late(pipeline::train(capture, folder.path / "again", options, {}, workspace.get()))) < 0.004);
}

TEST_CASE("a log has a record for every stage, and the lock is one process's") {
  const test::TemporaryFolder folder("log");
  pipeline::ProgressLog log(folder.path / "log.jsonl");
  log.write({"recognize", 0, 2, 1.0, NAN, ""});
  log.write({"recognize", 1, 2, 1.0, NAN, ""});  // too soon
  log.write({"recognize", 2, 2, 1.0, NAN, ""});  // the last
  log.write({"identify", 0, 0, 1.0, NAN, ""});
  const std::string text = core::read_file(folder.path / "log.jsonl");
  CHECK(std::count(text.begin(), text.end(), '\n') == 3);
  CHECK(text.starts_with(R"({"stage":"recognize","iteration":0,"total":2,"loss":1.0,"psnr":null,"seconds":)"));
  CHECK(pipeline::progress_of(folder.path) == "identify");

  const Path lock = folder.path / "checkpoint" / "lock";
  std::filesystem::create_directories(lock.parent_path());
  CHECK(!pipeline::is_locked(lock));
  {
    const pipeline::FolderLock held(lock);
    CHECK(pipeline::is_locked(lock));
    CHECK_THROWS_WITH_AS(pipeline::FolderLock{lock}, doctest::Contains("another process"), InputError);
  }
  CHECK(!pipeline::is_locked(lock));
}

TEST_CASE("a job file becomes the jobs of a batch") {
  const test::TemporaryFolder folder("jobs");
  std::filesystem::create_directories(folder.path / "captures/a");
  core::write_file(folder.path / "jobs.toml",
                   "captures = [\"captures/*\"]\nseeds = [0, 1]\n[settings]\njoints = [3, 4]\ntwist = true\n");
  const pipeline::BatchPlan plan = pipeline::read_job_file(folder.path / "jobs.toml");
  REQUIRE(plan.jobs.size() == 4);
  CHECK(plan.jobs[1].name == "a-joints_3-seed_1");
  CHECK(plan.jobs[1].seed == 1);
  CHECK(plan.jobs[1].settings == "joints=3");
  CHECK(plan.jobs[1].arguments == std::vector<std::string>{"--joints=3", "--twist"});
  pipeline::save_plan(plan, folder.path);
  CHECK(pipeline::load_plan(folder.path).jobs[3].arguments == plan.jobs[3].arguments);
  CHECK(pipeline::unfinished(plan, folder.path).size() == 4);
  for (const char* const seed : {"-2.0", "-1", "1.5", "\"1\""}) {
    CAPTURE(seed);
    core::write_file(
        folder.path / "batch.json",
        std::string(R"({"jobs": [{"name": "a", "capture": "b", "settings": "", "arguments": [], "seed": )") + seed +
            "}]}");
    CHECK_THROWS_WITH_AS(pipeline::load_plan(folder.path), doctest::Contains("is damaged"), InputError);
  }
  core::write_file(folder.path / "jobs.toml", "captures = [\"captures/*\"]\nsettings = { joints = 0 }\n");
  CHECK_THROWS_WITH_AS(pipeline::read_job_file(folder.path / "jobs.toml"),
                       doctest::Contains("`joints` 0 is not from 1"), InputError);
  // letters beyond ASCII: in texts of every kind and in comments
  for (const char* const name : {"é", "è", "ê", "ë"}) std::filesystem::create_directories(folder.path / "named" / name);
  core::write_file(folder.path / "jobs.toml",
                   "\xEF\xBB\xBF# ü\ncaptures = [\"named/é\", 'named/è', \"\"\"named/\\\nê\"\"\", "
                   "'''named/ë''']\n");
  CHECK(pipeline::read_job_file(folder.path / "jobs.toml").jobs.size() == 4);
  core::write_file(folder.path / "jobs.toml", "captures = [\"a\\\"#\"] # \"\né = 1\n");
  CHECK_THROWS_WITH_AS(pipeline::read_job_file(folder.path / "jobs.toml"),
                       doctest::Contains("line 2: has a letter beyond ASCII outside of quotes"), InputError);
  // what is no TOML even without them, and a text that ends with more quotes than opened it
  for (const char* const text : {"captures = 9'\xC7\xBD'\n", "captures = +[\"b\n\xC4\x8B", "a = 1\n[\"\xC7\xBD\n"}) {
    core::write_file(folder.path / "jobs.toml", text);
    CHECK_THROWS_WITH_AS(pipeline::read_job_file(folder.path / "jobs.toml"), doctest::Contains("line "), InputError);
  }
  core::write_file(folder.path / "jobs.toml", "settings = { a = \"\"\"b\"\"\"\", \xC3\xA9 = 1 }\n");
  CHECK_THROWS_WITH_AS(pipeline::read_job_file(folder.path / "jobs.toml"),
                       doctest::Contains("line 1: has a letter beyond ASCII outside of quotes"), InputError);
}
