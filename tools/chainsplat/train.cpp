// train.cpp - train, recognize: load -> recognize -> identify -> roll out -> evaluate -> save.
#include <CLI/CLI.hpp>
#include <algorithm>
#include <array>
#include <cmath>
#include <iostream>
#include <limits>
#include <memory>
#include <nlohmann/json.hpp>
#include <sstream>

#include "chainsplat/capture.h"
#include "chainsplat/eval.h"
#include "chainsplat/recognition.h"
#include "chainsplat/twin.h"
#include "cli.h"
#include "identify.h"
#include "joint.h"
#include "memory.h"
#include "picture.h"
#include "run_folder.h"

namespace chainsplat::tools {

namespace {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;

constexpr std::array<const char*, 4> kStages = {"recognize", "identify", "rollout", "evaluate"};
constexpr int kMostJoints = 64;

struct Request {
  std::string capture, out, picture;
  std::string stages;  // empty: all
  std::string bending = "auto", mode = "fast", frames;
  int joints = 8, every = 5;
  bool twist = false, joint = false, resume = false, force = false;
};

struct Stages {
  bool named = false;  // by the user: what is done already is done again (all but recognition)
  bool recognize = true, identify = true, rollout = true, evaluate = true;
};

Stages parse_stages(const std::string& text) {
  Stages stages;
  if (text.empty()) return stages;
  stages = {true, false, false, false, false};
  const std::array<bool*, 4> wanted = {&stages.recognize, &stages.identify, &stages.rollout, &stages.evaluate};
  std::string word;
  std::istringstream words(text);
  while (std::getline(words, word, ',')) {
    const auto at = std::find(kStages.begin(), kStages.end(), word);
    if (at == kStages.end())
      throw InputError("--stages", "'" + word + "' is not a stage", "name some of recognize,identify,rollout,evaluate");
    *wanted[at - kStages.begin()] = true;
  }
  return stages;
}

// What recognition depends on; also written as provenance.
std::map<std::string, std::string> recognition_options(const Request& request) {
  return {
      {"joints", std::to_string(request.joints)}, {"bending", request.bending}, {"twist", request.twist ? "yes" : "no"},
      {"every", std::to_string(request.every)},   {"frames", request.frames},   {"mode", request.mode}};
}

void stop_if_asked() {
  if (const int signal = core::stop_requested()) throw Interrupted(signal);
}

recognition::Options settings_of(const Request& request, const Globals& globals) {
  recognition::Options options;
  options.joints = request.joints;
  if (request.bending != "auto")
    options.bending = request.bending == "planar" ? chain::Bending::planar : chain::Bending::spatial;
  options.twist = request.twist;
  options.every = request.every;
  options.mode = request.mode == "paper" ? recognition::Mode::paper : recognition::Mode::fast;
  options.seed = globals.seed;
  options.checkpoint = Path(request.out) / kCheckpointFolder;
  options.resume = request.resume;
  return options;
}

void recognize_stage(twin::Twin& twin, std::vector<math::MatrixX>& covariances, gpu::Device& device,
                     const capture::Capture& capture, const Request& request, const recognition::Options& settings) {
  const Stopwatch watch(twin, "recognize");
  recognition::Result found = recognition::recognize(device, capture, settings);
  twin.chain = std::move(found.chain);
  twin.gaussians = std::move(found.gaussians);
  twin.states = std::move(found.states);
  covariances = std::move(found.covariances);
  // exactly symmetric, as they are read back
  for (math::MatrixX& covariance : covariances) covariance = math::MatrixX(covariance.selfadjointView<Eigen::Lower>());
  if (request.bending == "auto" && request.mode == "fast") {
    char text[96];
    std::snprintf(text, sizeof text, " bending (out of plane: %.2f mm)", 1e3 * found.bending.out_of_plane_rms);
    say((found.bending.bending == chain::Bending::planar ? "planar" : "spatial") + std::string(text));
  }
}

// What the capture and the command line say of a new twin.
twin::Twin new_twin(const capture::Capture& capture, const Request& request, const Globals& globals) {
  twin::Twin twin = twin_in_scene(capture);
  twin.provenance.version = CHAINSPLAT_VERSION;
  twin.provenance.capture = capture.name;
  twin.provenance.capture_hash = hash_text(capture.hash);
  twin.provenance.seed = globals.seed;
  for (const auto& [name, value] : recognition_options(request)) twin.provenance.options[name] = value;
  // from the run folder, so that the two can be moved together
  twin.provenance.options["path"] =
      fs::proximate(fs::absolute(request.capture), fs::absolute(request.out)).lexically_normal().generic_string();
  return twin;
}

// Throws InputError where the run folder's twin is not what is asked for now.
void check_same_work(const twin::Twin& twin, const capture::Capture& capture, const Request& request,
                     const Stages& stages, std::uint64_t seed) {
  if (twin.provenance.capture_hash != hash_text(capture.hash))
    throw InputError(request.out,
                     "was made from another capture (" + twin.provenance.capture + ") or it has changed since",
                     "name that one, or begin again with --force");
  if (!stages.recognize) return;
  const auto compare = [&](const std::string& name, const std::string& had, const std::string& value) {
    if (had != value)
      throw InputError(request.out, "was begun with --" + name + " '" + had + "', not '" + value + "'",
                       "give the same options, or begin again with --force");
  };
  for (const auto& [name, value] : recognition_options(request))
    if (const auto had = twin.provenance.options.find(name); had != twin.provenance.options.end())
      compare(name, had->second, value);
  compare("seed", std::to_string(twin.provenance.seed), std::to_string(seed));
}

Json summary_json(const twin::Twin& twin, const Path& out, const eval::Metrics* recognized,
                  const eval::Metrics* rollout) {
  Json document;
  document["run"] = out.string();
  document["capture"] = twin.provenance.capture;
  document["frames"] = twin.states.time.size();
  document["joints"] = twin.chain.links() - 1;
  document["angles"] = twin.chain.angles();
  document["gaussians"] = twin.gaussians.count;
  for (const auto& [name, metrics] : {std::pair("recognized", recognized), std::pair("rollout", rollout)})
    if (metrics) document[name] = Json::parse(eval::to_json(*metrics))["mean"];
  document["seconds"] = twin.provenance.seconds;
  return document;
}

// Throws InputError where the frames asked for do not exist, or a camera shows nothing of the object in them.
void check_views(const capture::Capture& capture, const Request& request) {
  if (capture.views.empty())
    throw InputError("--frames", "'" + request.frames + "' holds none of the capture's frames",
                     capture.cameras.front().name + " has " + std::to_string(capture.times.front().size()));
  for (std::size_t c = 0; c < capture.cameras.size(); ++c) {
    const auto sees = [&](const capture::View& view) {
      if (view.camera != static_cast<int>(c)) return false;
      for (std::size_t i = 3; i < view.rgba.size(); i += 4)
        if (view.rgba[i] != 0) return true;
      return false;
    };
    if (std::none_of(capture.views.begin(), capture.views.end(), sees))
      throw InputError(request.capture, capture.cameras[c].name + " never sees the object in these frames",
                       "correct its masks, or take the camera out of capture.json");
  }
}

// Times of the first camera's frames that were asked for: those of the states.
std::vector<double> times_of(const capture::Capture& capture) {
  std::vector<double> times;
  for (const capture::View& view : capture.views)
    if (view.camera == 0) times.push_back(view.time);
  return times;
}

void train(const Globals& globals, const Request& request) {
  const Stages stages = parse_stages(request.stages);
  const Path out = request.out;
  const auto [first, last] = parse_frames(request.frames);
  check_output_folder(out, request.force || request.resume,
                      "name another folder, or give --force to begin again or --resume to continue");
  check_run_files(out);
  if (!request.picture.empty()) check_output_file(request.picture);
  if (request.force && request.resume)
    throw InputError("--force, --resume", "contradict each other", "give one of them");
  watch_signals();

  // everything that can be wrong with the request is found before anything is written
  const double load_start = core::seconds_now();
  capture::LoadOptions load_options;
  load_options.first = first;
  load_options.last = last;
  load_options.depth = stages.evaluate;  // read now, because a file that is wrong must not end a work that is done
  capture::Capture capture = capture::load(request.capture, load_options);
  check_not_capture(out, capture.folder);
  if (stages.recognize) check_views(capture, request);
  if (stages.evaluate) capture::load_true_centerline(capture.folder);  // to find what is wrong with it
  std::error_code error;
  const bool continued = request.resume && fs::exists(out / "twin.json", error);
  if (request.resume && !continued && fs::exists(out, error) && !fs::is_empty(out, error) &&
      !fs::exists(out / kCheckpointFolder, error))
    throw InputError(out.string(), "holds no run to resume, but other files",
                     "name another folder, or begin in this one with --force");
  twin::Twin twin = continued ? load_twin(out) : new_twin(capture, request, globals);
  if (continued) check_same_work(twin, capture, request, stages, globals.seed);
  if (continued && stages.evaluate) check_drawable(twin, out);
  if (!continued && !stages.recognize)
    throw InputError(out.string(), "holds no recognized twin to go on from",
                     "add recognize to --stages, or give --resume");
  twin.provenance.seconds["load"] += core::seconds_now() - load_start;
  const bool recognize = stages.recognize && !continued;
  const bool identify = stages.identify && (stages.named || recognize || !twin.parameters);
  const bool joint = request.joint && !twin.provenance.options.count("joint");
  if (joint && !identify && !twin.parameters)
    throw InputError("--joint", "needs identified dynamics", "add identify to --stages");
  if (joint && request.mode == "paper") throw InputError("--joint", "goes with --mode fast", "leave one of them out");
  const bool roll_out = stages.rollout && (stages.named || identify || joint || twin.rollout.time.empty());
  if (roll_out && !identify && !(twin.parameters && twin.initial))
    throw InputError("--stages", "nothing is identified that could be rolled out", "add identify");
  const std::vector<double> times = recognize ? times_of(capture) : twin.states.time;
  if ((identify || joint) && times.size() < kLeastFrames)
    throw InputError(request.frames.empty() ? request.capture : "--frames",
                     "identification needs " + std::to_string(kLeastFrames) + " frames of " +
                         capture.cameras.front().name + " or more, and there are " + std::to_string(times.size()),
                     "give more frames, or leave identification out with --stages recognize,evaluate");
  if (continued && joint && times_of(capture) != times)
    throw InputError("--frames", "--joint needs the frames that " + out.string() + " was recognized from",
                     "give the same --frames as then");
  const recognition::Options settings = settings_of(request, globals);
  if (recognize) recognition::check_checkpoint(capture, settings);
  std::vector<math::MatrixX> covariances;
  if (continued && (identify || joint)) covariances = read_covariances(out / kCovarianceFile, twin.states);
  if (continued && joint) check_joint(twin, covariances, out);
  gpu::DevicePtr device;
  if (recognize || joint || stages.evaluate) {
    device = gpu::open_device({.selector = globals.device});
    const gpu::DeviceInfo& info = gpu::info(*device);
    twin.provenance.device = info.name;
    twin.provenance.driver = info.driver;
    say_more("device " + std::to_string(info.index) + ": " + info.name + " (" + info.type + ", " + info.driver + ")");
  }
  stop_if_asked();

  const bool was_there = fs::exists(out, error);
  make_folder(out / kCheckpointFolder);
  const FolderLock lock(out / kLockFile);
  remove_half_written(out);
  if (request.force) {
    remove_run_files(out);
    recognition::remove_checkpoint(out / kCheckpointFolder);
  }
  const std::string kept = "what exists so far is kept in " + out.string() + ", and --resume goes on from there";
  bool saved = continued;  // from then on nothing is removed, whatever happens
  const auto save = [&] {
    saved = true;
    twin::save(twin, out);
  };
  try {
    log_to(out / kLogFile);
    core::write_file(out / kBaseFile, trajectory::write_tum(capture.base.samples()));
    if (recognize) {
      recognize_stage(twin, covariances, *device, capture, request, settings);
      trim_memory();  // or the next stage's need comes on top
      if (!covariances.empty()) core::write_file(out / kCovarianceFile, covariance_csv(twin.states, covariances));
      save();  // what comes later can fail without losing this
      stop_if_asked();
    }
    if (identify) {
      identify_stage(twin, capture.base, covariances, request.mode == "paper", globals.seed);
      save();
      stop_if_asked();
    }
    if (joint) {
      joint_stage(twin, covariances, capture, *device, globals.seed);
      core::write_file(out / kCovarianceFile, covariance_csv(twin.states, covariances));
      save();
      stop_if_asked();
    }
    if (roll_out) {
      rollout_stage(twin, capture.base, out);
      save();
      stop_if_asked();
    }
    eval::Metrics recognized, rolled_out;
    const bool has_rollout = !twin.rollout.time.empty();
    if (stages.evaluate) {
      const Stopwatch watch(twin, "evaluate");
      core::report({"evaluate", 0, 0, NAN, NAN, "drawing every frame and comparing"});
      const capture::Capture recorded = capture::load_recorded(std::move(capture), request.capture, load_options);
      splat::Engine engine(*device);
      recognized = eval::evaluate(engine, twin.gaussians, twin.chain, twin.states, recorded);
      if (has_rollout) rolled_out = eval::evaluate(engine, twin.gaussians, twin.chain, twin.rollout, recorded);
      core::write_file(out / kMetricsFile, metrics_json(&recognized, has_rollout ? &rolled_out : nullptr));
      if (!request.picture.empty()) capture::write_png(request.picture, comparison(engine, twin, recorded));
    }
    save();  // with all durations
    remove_checkpoint_folder(out);

    end_progress();
    const eval::Metrics* const shown[] = {stages.evaluate ? &recognized : nullptr,
                                          stages.evaluate && has_rollout ? &rolled_out : nullptr};
    if (globals.json) {
      std::cout << summary_json(twin, out, shown[0], shown[1]).dump(1) << "\n";
    } else {
      std::vector<MetricsRow> rows;
      if (shown[0]) rows.push_back({"recognized", shown[0]->mean});
      if (shown[1]) rows.push_back({"rollout", shown[1]->mean});
      if (!rows.empty()) std::cout << metrics_table(rows);
      std::cout << "twin: " << out.string() << "\n";
      if (!request.picture.empty() && stages.evaluate) std::cout << "picture: " << request.picture << "\n";
    }
  } catch (const Interrupted&) {
    end_progress();
    say("stopped; a checkpoint is in " + out.string() + ": the same command with --resume continues");
    throw;
  } catch (const InputError& wrong) {
    if (saved || was_there) throw broken_off(wrong, kept);
    // nothing is left where nothing was
    remove_run_files(out);
    remove_checkpoint_folder(out);
    fs::remove(out, error);
    throw;
  } catch (const WorkError& failure) {
    throw broken_off(failure, kept);
  } catch (const std::bad_alloc&) {
    throw WorkError("memory", "there is not enough of it", "use fewer --frames or a machine with more; " + kept);
  } catch (const std::exception& defect) {
    throw WorkError("internal", defect.what(), "this is a defect, please report the command; " + kept);
  }
}

void add_recognition_options(CLI::App& command, Request& request) {
  command.add_option("CAPTURE", request.capture, "The capture's folder or its capture.json")->required();
  command.add_option("-o,--output", request.out, "Run folder to make: the twin")->required()->type_name("RUN");
  command.add_flag("--force", request.force, "Begin again in a run folder that is not empty");
  command.add_flag("--resume", request.resume, "Continue in a run folder that was left unfinished");
  command.add_option("--joints", request.joints, "Joints along the rope (default 8)")
      ->check(CLI::Range(1, kMostJoints))
      ->type_name("N");
  command
      .add_option(
          "--bending", request.bending,
          "Axes a joint: planar (one), spatial (two) or auto (default: planar on a table; in free space spatial\n"
          "unless the rope hardly leaves its plane)")
      ->check(CLI::IsMember({"auto", "planar", "spatial"}))
      ->type_name("KIND");
  command.add_flag("--twist", request.twist, "Also a twist axis a joint");
  command.add_option("--every", request.every, "Train the Gaussians on every N-th frame (default 5)")
      ->check(CLI::PositiveNumber)
      ->type_name("N");
  command.add_option("--frames", request.frames, "Only these frames: from A up to, not including, B")->type_name("A:B");
  command.add_option("--mode", request.mode, "fast (default) or paper: the paper's own procedure, slow")
      ->check(CLI::IsMember({"fast", "paper"}))
      ->type_name("MODE");
}

}  // namespace

void add_training_commands(CLI::App& app, const Globals& globals, Job& job) {
  CLI::App* trainer =
      app.add_subcommand("train", "Make a twin from a capture: recognize, identify, roll out, evaluate");
  auto request = std::make_shared<Request>();
  add_recognition_options(*trainer, *request);
  trainer->add_option("--stages", request->stages, "Only these, by comma: recognize,identify,rollout,evaluate")
      ->type_name("LIST");
  trainer->add_flag("--joint", request->joint,
                    "Refine angles, Gaussians and dynamics together: helps where a single camera hardly sees depth");
  trainer->add_option("--picture", request->picture, "Also make a picture: observed beside rendered frames")
      ->type_name("FILE.png");
  trainer->callback([&globals, &job, request] { job = [&globals, request] { train(globals, *request); }; });

  CLI::App* recognizer =
      app.add_subcommand("recognize", "The first stage of train alone: Gaussians and angles from images");
  auto recognition = std::make_shared<Request>();
  add_recognition_options(*recognizer, *recognition);
  recognizer->callback([&globals, &job, recognition] {
    recognition->stages = "recognize";
    job = [&globals, recognition] { train(globals, *recognition); };
  });
}

}  // namespace chainsplat::tools
