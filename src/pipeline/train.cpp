// train.cpp - load -> recognize -> identify -> refine -> roll out -> evaluate -> save.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <future>
#include <nlohmann/json.hpp>

#include "chainsplat/comparison.h"
#include "chainsplat/in_memory.h"
#include "chainsplat/recognition.h"
#include "chainsplat/run_folder.h"
#include "chainsplat/shutter.h"
#include "chainsplat/silhouette.h"
#include "pipeline/decide.h"
#include "pipeline/workspace.h"

namespace chainsplat::pipeline {

namespace {

namespace fs = std::filesystem;

// All that one call works on.
struct Training {
  Path capture_path, run;
  const capture::InMemory* recording = nullptr;  // instead of capture_path, which is then a name for messages
  TrainOptions options;
  capture::LoadOptions load;
  capture::Capture capture;
  twin::Twin twin;
  Workspace* workspace = nullptr;
  gpu::DevicePtr own_device;            // where there is no workspace
  gpu::Device* device = nullptr;        // that, or the workspace's
  math::MatrixX correction_covariance;  // of what was corrected in this call; empty: nothing
  bool continued = false;               // the twin was in the run folder
  bool recognize = false, identify = false, joint = false, roll_out = false, evaluate = false;  // what is to be done
  bool saved = false;  // from then on nothing is removed, whatever happens
  TrainResult result;
};

bool asked_for(const Training& t, Stage stage) {
  const std::vector<Stage>& stages = t.options.stages;
  return stages.empty() || std::find(stages.begin(), stages.end(), stage) != stages.end();
}

recognition::Options recognition_options(const Training& t) {
  recognition::Options options;
  options.joints = t.options.joints;
  options.bending = t.options.bending;
  options.twist = t.options.twist;
  // else the rope lies where the grasp says
  options.height = !is_fixed(t.options.fixed, "all") && !is_fixed(t.options.fixed, "grasp");
  options.every = t.options.every;
  options.mode = t.options.mode == twin::Mode::paper ? recognition::Mode::paper : recognition::Mode::fast;
  options.paper = recognition::read_paper_choices(t.options.paper, "`paper`");
  options.seed = t.options.seed;
  options.checkpoint = t.run / kCheckpointFolder;
  options.resume = t.options.resume;
  return options;
}

// What recognition depends on, as provenance.
twin::Provenance recognition_provenance(const TrainOptions& options) {
  twin::Provenance p;
  p.seed = options.seed;
  p.every = options.every;
  p.frames = options.frames;
  p.mode = options.mode;
  p.options = {{"joints", options.joints ? std::to_string(*options.joints) : "auto"},
               {"bending", !options.bending                             ? "auto"
                           : *options.bending == chain::Bending::planar ? "planar"
                                                                        : "spatial"},
               {"twist", options.twist ? "yes" : "no"}};
  std::string held;
  for (const std::string& group : options.fixed) held += (held.empty() ? "" : ",") + group;
  if (!held.empty()) p.options["fixed"] = held;
  const std::string choices = recognition::text_of(recognition::read_paper_choices(options.paper, "`paper`"));
  if (!choices.empty()) p.options["paper"] = choices;
  return p;
}

// What the capture and the options say of a new twin.
twin::Twin new_twin(const Training& t) {
  twin::Twin twin = twin_in_scene(t.capture);
  const twin::Provenance scene = twin.provenance;
  twin.provenance = recognition_provenance(t.options);
  twin.provenance.mass = scene.mass;
  twin.provenance.payload = scene.payload;
  twin.provenance.version = CHAINSPLAT_VERSION;
  twin.provenance.capture = t.capture.name;
  twin.provenance.capture_hash = capture::hash_text(t.capture.hash);
  // from the run folder, so that the two can be moved together
  if (!t.recording)
    twin.provenance.path =
        fs::proximate(fs::absolute(t.capture_path), fs::absolute(t.run)).lexically_normal().generic_string();
  return twin;
}

// --- what can be wrong with the request is found before anything is written ------------------------------------------

void check_outputs(const Training& t) {
  check_output_folder(t.run, t.options.force || t.options.resume,
                      "name another folder, or give `force` to begin again or `resume` to continue");
  check_run_files(t.run);
  if (!t.options.picture.empty()) check_output_file(t.options.picture.string());
}

// Throws InputError where the frames asked for do not exist, or a camera shows nothing of the object in them.
void check_views(const Training& t) {
  const capture::Capture& capture = t.capture;
  if (capture.views.empty())
    throw InputError("`frames`",
                     "'" + capture::frame_range_text(t.options.frames) + "' holds none of the capture's frames",
                     capture.cameras.front().name + " has " + std::to_string(capture.times.front().size()));
  for (std::size_t c = 0; c < capture.cameras.size(); ++c) {
    const auto sees = [&](const capture::PackedView& view) {
      if (view.camera != static_cast<int>(c)) return false;
      for (std::size_t i = 3; i < view.rgba.size(); i += 4)
        if (view.rgba[i] != 0) return true;
      return false;
    };
    if (std::none_of(capture.views.begin(), capture.views.end(), sees))
      throw InputError(t.capture_path.string(), capture.cameras[c].name + " never sees the object in these frames",
                       "correct its masks, or take the camera out of capture.json");
  }
}

// Which capture it is, in which state, and what of it is asked for.
std::string capture_key(const Training& t) {
  capture::LoadOptions nothing;
  nothing.images = false;
  const std::string name = t.recording ? "in memory" : fs::absolute(t.capture_path).lexically_normal().string();
  const std::uint64_t state = t.recording ? capture::load(*t.recording, nothing).hash : capture::stamp(t.capture_path);
  return name + " " + std::to_string(state) + " " + capture::frame_range_text(t.options.frames) +
         (t.load.depth ? " depth" : "");
}

void load_capture(Training& t) {
  t.load.first = t.options.frames.first, t.load.last = t.options.frames.last;
  // read now, because a file that is wrong must not end a work that is done
  t.load.depth = t.load.recorded_too = asked_for(t, Stage::evaluate);
  const auto load = [&] {
    return t.recording ? capture::load(*t.recording, t.load) : capture::load(t.capture_path, t.load);
  };
  if (t.workspace) {
    Workspace& kept = *t.workspace;
    const std::string key = capture_key(t);
    if (kept.capture_key != key) {
      kept.capture_key.clear(), kept.correction_key.clear();
      kept.read = {}, kept.mended = {}, kept.corrected = {};  // before the next one needs the memory
      kept.said_reading.clear();
      const core::SaidScope scope(kept.said_reading);
      kept.read = load();
      kept.capture_key = key;
    } else {
      core::say_again(kept.said_reading);
    }
    t.capture = kept.read;
  } else {
    t.capture = load();
  }
  check_not_capture(t.run, t.capture.folder);
  if (asked_for(t, Stage::recognize)) check_views(t);
  if (asked_for(t, Stage::evaluate)) capture::load_true_centerline(t.capture.folder);  // to find what is wrong with it
}

// Throws InputError where the run folder's twin is not what is asked for now.
void check_same_work(const Training& t) {
  const twin::Provenance &had = t.twin.provenance, wanted = recognition_provenance(t.options);
  if (had.capture_hash != capture::hash_text(t.capture.hash))
    throw InputError(t.run.string(), "was made from another capture (" + had.capture + ") or it has changed since",
                     "name that one, or begin again with `force`");
  if (!asked_for(t, Stage::recognize)) return;
  const auto compare = [&](const std::string& name, const std::string& before, const std::string& now) {
    if (before != now)
      throw InputError(t.run.string(), "was begun with `" + name + "` '" + before + "', not '" + now + "'",
                       "give the same options, or begin again with `force`");
  };
  const std::map<std::string, std::string> before = option_texts(had);
  for (const auto& [name, text] : option_texts(wanted))
    if (const auto at = before.find(name); at != before.end()) compare(name, at->second, text);
  for (const char* name : {"fixed", "paper"}) {
    const auto named = [&](const twin::Provenance& p) {
      const auto at = p.options.find(name);
      return at == p.options.end() ? std::string("nothing") : at->second;
    };
    compare(name, named(had), named(wanted));
  }
  compare("seed", std::to_string(had.seed), std::to_string(wanted.seed));
}

// The twin that the folder holds where the work goes on from there, else a new one.
void begin_or_continue(Training& t) {
  std::error_code error;
  t.continued = t.options.resume && fs::exists(t.run / "twin.json", error);
  if (t.options.resume && !t.continued && fs::exists(t.run, error) && !fs::is_empty(t.run, error) &&
      !fs::exists(t.run / kCheckpointFolder, error))
    throw InputError(t.run.string(), "holds no run to resume, but other files",
                     "name another folder, or begin in this one with `force`");
  t.twin = t.continued ? load_twin(t.run) : new_twin(t);
  if (t.continued) check_same_work(t);
  if (t.continued && asked_for(t, Stage::evaluate)) check_drawable(t.twin, t.run);
  if (!t.continued && !asked_for(t, Stage::recognize))
    throw InputError(t.run.string(), "holds no recognized twin to go on from",
                     "add recognize to `stages`, or give `resume`");
}

// Times of the first camera's frames that were asked for: those of the states.
std::vector<double> times_of(const capture::Capture& capture) {
  std::vector<double> times;
  for (const capture::ViewPlace& view : capture.views)
    if (view.camera == 0) times.push_back(view.time);
  return times;
}

void choose_work(Training& t) {
  const bool named = !t.options.stages.empty();
  t.recognize = asked_for(t, Stage::recognize) && !t.continued;
  t.identify = asked_for(t, Stage::identify) && (named || t.recognize || !t.twin.parameters);
  t.joint = t.options.joint && !t.twin.provenance.joint;
  if (t.joint && !t.identify && !t.twin.parameters)
    throw InputError("`joint`", "needs identified dynamics", "add identify to `stages`");
  if (t.joint && t.options.mode == twin::Mode::paper)
    throw InputError("`joint`", "goes with `mode` fast", "leave one of them out");
  t.roll_out = asked_for(t, Stage::rollout) && (named || t.identify || t.joint || t.twin.rollout.time.empty());
  if (t.roll_out && !t.identify && !(t.twin.parameters && t.twin.initial))
    throw InputError("`stages`", "nothing is identified that could be rolled out", "add identify");
  t.evaluate = asked_for(t, Stage::evaluate);
  // a few stills: a twin that looks like the rope, and of whose motion nothing is known
  const std::size_t frames = (t.recognize ? times_of(t.capture) : t.twin.states.time).size();
  if (t.identify && !named && !t.joint && frames < kLeastFrames) {
    t.identify = t.roll_out = false;
    core::warn(std::to_string(frames) + (frames == 1 ? " frame: " : " frames: ") +
               "the rope is recognized, and its dynamics are not identified, for which " +
               std::to_string(kLeastFrames) + " frames or more of a motion are needed");
  }
}

void check_work(Training& t) {
  const std::vector<double> times = t.recognize ? times_of(t.capture) : t.twin.states.time;
  const bool all_frames = t.options.frames == capture::FrameRange{};
  if ((t.identify || t.joint) && times.size() < kLeastFrames)
    throw InputError(all_frames ? t.capture_path.string() : "`frames`",
                     "identification needs " + std::to_string(kLeastFrames) + " frames of " +
                         t.capture.cameras.front().name + " or more, and there are " + std::to_string(times.size()),
                     "give more frames, or leave identification out with `stages` recognize,evaluate");
  if (t.continued && t.joint && times_of(t.capture) != times)
    throw InputError("`frames`", "`joint` needs the frames that " + t.run.string() + " was recognized from",
                     "give the same `frames` as then");
  if (t.recognize) recognition::check_checkpoint(t.capture, recognition_options(t));
  if (t.continued && (t.identify || t.joint))
    t.twin.states.covariance = read_covariances(t.run / kCovarianceFile, t.twin.states);
  if (t.continued && t.joint) check_joint(t.twin, t.run);
}

// Corrects the capture but for what is held, and says where the recording contradicts that.
Corrected correct_but_held(Training& t) {
  const std::vector<std::string>& fixed = t.options.fixed;
  std::vector<capture::Finding> held;
  if (!fixed.empty()) held = contradictions(t.capture, fixed);
  Corrected out;
  if (!is_fixed(fixed, "all")) out = correct(t.capture, fixed, t.options.anyway);
  out.verdict.insert(out.verdict.end(), held.begin(), held.end());
  return out;
}

// The same, or what an earlier training found.
Corrected corrected_by_now(Training& t) {
  const std::vector<std::string>& fixed = t.options.fixed;
  if (!t.workspace) return correct_but_held(t);
  Workspace& kept = *t.workspace;
  const bool rolling = silhouette::has_rolling_shutter(t.capture.cameras);  // as given: the views are made for that
  std::string key = t.options.anyway ? "anyway" : "else";
  for (const std::string& group : fixed) key += " " + group;
  std::vector<capture::PackedView> views, recorded;
  if (kept.correction_key != key) {
    kept.correction_key.clear();
    kept.said_correcting.clear();
    const core::SaidScope scope(kept.said_correcting);
    kept.corrected = correct_but_held(t);
    views = std::move(t.capture.views), recorded = std::move(t.capture.recorded);
    kept.mended = t.capture;
    kept.correction_key = key;
  } else {
    core::say_again(kept.said_correcting);
    views = std::move(t.capture.views), recorded = std::move(t.capture.recorded);
    t.capture = kept.mended;
    for (capture::PackedView& view : views) view.time = t.capture.times[view.camera][view.frame];
    t.capture.views = std::move(views), t.capture.recorded = std::move(recorded);
    if (!rolling) read_at_once(t.capture);
    return kept.corrected;
  }
  t.capture.views = std::move(views), t.capture.recorded = std::move(recorded);
  return kept.corrected;
}

// What the capture was given wrongly: estimated for a new twin, known of one that goes on.
void correct_capture(Training& t) {
  if (!t.recognize) {
    capture::apply(t.twin.corrections, t.capture);
    silhouette::read_at_once(t.capture, t.twin.chain, t.twin.states);
    return;
  }
  read_at_once(t.capture);
  if (t.options.mode == twin::Mode::paper) return;
  core::report({"recognize", 0, 0, NAN, NAN, "cameras, clocks, grasp and size"});
  Corrected found = corrected_by_now(t);
  t.twin.corrections = std::move(found.corrections);
  t.twin.verdict = std::move(found.verdict);
  t.correction_covariance = std::move(found.covariance);
  for (const capture::Finding& finding : t.twin.verdict)
    if (finding.impossible && !t.options.anyway)
      throw InputError(t.capture_path.string(), finding.text, "or give `anyway`, and do not trust the twin");
  t.twin.chain.length = t.capture.length;
  t.twin.chain.diameter = t.capture.diameter;
}

void open_device(Training& t) {
  if (!t.recognize && !t.joint && !t.evaluate) return;
  gpu::DevicePtr& device = t.workspace ? t.workspace->device : t.own_device;
  if (t.workspace && t.workspace->selector != t.options.device) device.reset();
  if (!device) device = gpu::open_device({.selector = t.options.device});
  if (t.workspace) t.workspace->selector = t.options.device;
  t.device = device.get();
  const gpu::DeviceInfo& info = gpu::info(*t.device);
  t.twin.provenance.device = info.name;
  t.twin.provenance.driver = info.driver;
  core::say_more("device " + std::to_string(info.index) + ": " + info.name + " (" + info.type + ", " + info.driver +
                 ")");
}

void prepare(Training& t) {
  const double start = core::seconds_now();
  load_capture(t);
  begin_or_continue(t);
  t.twin.provenance.seconds["load"] += core::seconds_now() - start;
  choose_work(t);
  const double begun = core::seconds_now();
  correct_capture(t);
  t.twin.provenance.seconds["correct"] += core::seconds_now() - begun;
  check_work(t);
  open_device(t);
  core::stop_if_requested();
}

// --- the stages ------------------------------------------------------------------------------------------------------

void save(Training& t) {
  t.saved = true;
  twin::save(t.twin, t.run);
}

// What comes later can fail without losing this.
void save_and_go_on(Training& t) {
  save(t);
  core::stop_if_requested();
}

void write_covariances(const Training& t) {
  if (!t.twin.states.covariance.empty()) pipeline::write_covariances(t.run / kCovarianceFile, t.twin.states);
}

// What the pictures' noise does not say: straight links stand for arcs, and what was corrected is not sure.
void add_model_errors(Training& t) {
  chain::States& states = t.twin.states;
  const chain::Chain& chain = t.twin.chain;
  for (std::size_t k = 0; k < states.covariance.size(); ++k)
    states.covariance[k] +=
        chain::shape_covariance(chain, chain::shape_variances(chain, states.theta[k]), states.theta[k]);
  if (t.correction_covariance.size() == 0 || states.covariance.empty()) return;
  const std::vector<math::MatrixX> more =
      silhouette::covariances_by_corrections(chain, t.capture, states, t.twin.corrections, t.correction_covariance);
  for (std::size_t k = 0; k < states.covariance.size(); ++k) states.covariance[k] += more[k];
}

void recognize(Training& t) {
  const Stopwatch watch(t.twin, "recognize");
  recognition::Result found = recognition::recognize(*t.device, t.capture, recognition_options(t));
  t.twin.chain = std::move(found.chain);
  t.twin.gaussians = std::move(found.gaussians);
  t.twin.states = std::move(found.states);
  add_model_errors(t);
  // exactly symmetric, as they are read back
  for (math::MatrixX& covariance : t.twin.states.covariance)
    covariance = math::MatrixX(covariance.selfadjointView<Eigen::Lower>());
  if (t.options.mode == twin::Mode::fast) judge_hidden(t.twin, t.capture);
  if (!t.options.bending && t.options.mode == twin::Mode::fast) {
    char text[96];
    std::snprintf(text, sizeof text, " bending (out of plane: %.2f mm)", 1e3 * found.bending.out_of_plane_rms);
    judge_bending(t.twin, found.bending);
    widen_by_unseen_bends(t.twin, found.bending);
    core::say((found.bending.bending == chain::Bending::planar ? "planar" : "spatial") + std::string(text));
  }
  if (found.joints.joints > 0) {
    char text[160];
    std::snprintf(text, sizeof text,
                  "%d joints (with %d the rope would curve %.2f mm beside its links; the masks leave %.2f mm open)",
                  found.joints.joints, found.joints.tried, 1e3 * found.joints.bow, 1e3 * found.joints.deviation);
    core::say_more(text);
  }
  tell_fit("recognize", found.summary);
  t.result.fits.emplace_back("recognize", found.summary);
}

// What evaluation works on, and what it found of the recognized motion.
struct Comparison {
  capture::Capture recorded;
  splat::Engine engine;
  eval::Metrics recognized;
};

// What was recorded, as evaluation compares it. `capture`: as it was recognized, with `states` of `chain`.
capture::Capture recorded_of(const Training& t, capture::Capture capture, const chain::Chain& chain,
                             const chain::States& states) {
  if (!silhouette::has_rolling_shutter(capture.cameras))
    return t.recording ? capture::load_recorded(std::move(capture), *t.recording, t.load)
                       : capture::load_recorded(std::move(capture), t.capture_path, t.load);
  // read again, since its views are not as they were recorded, and now with depth
  capture::LoadOptions load = t.load;
  load.pixels = capture::Pixels::recorded, load.recorded_too = false;
  capture = t.recording ? capture::load(*t.recording, load) : capture::load(t.capture_path, load);
  capture::apply(t.twin.corrections, capture);
  silhouette::read_at_once(capture, chain, states);
  return capture;
}

// Begins to compare the recognized motion with the recording, in a thread of its own: identification, which comes next,
// keeps one core busy and the device not at all. Takes the capture's frames; the thread reads nothing that changes.
std::future<Comparison> begin_comparison(Training& t) {
  chain::States shown;  // without covariances, which of many angles fill the memory
  shown.time = t.twin.states.time;
  shown.theta = t.twin.states.theta;
  shown.roll = t.twin.states.roll;
  return std::async(std::launch::async, [&t, &device = *t.device, capture = std::move(t.capture), chain = t.twin.chain,
                                         gaussians = t.twin.gaussians, shown = std::move(shown)]() mutable {
    Comparison c{recorded_of(t, std::move(capture), chain, shown), splat::Engine(device), {}};
    c.recognized = eval::evaluate(c.engine, gaussians, chain, shown, c.recorded);
    return c;
  });
}

void evaluate(Training& t, std::future<Comparison> comparison) {
  const Stopwatch watch(t.twin, "evaluate");
  core::report({"evaluate", 0, 0, NAN, NAN, "drawing every frame and comparing"});
  Comparison c = comparison.get();
  const twin::Twin& twin = t.twin;
  TrainResult& r = t.result;
  r.recognized = std::move(c.recognized);
  if (!twin.rollout.time.empty())
    r.rollout = eval::evaluate(c.engine, twin.gaussians, twin.chain, twin.rollout, c.recorded);
  core::write_file(t.run / kMetricsFile, metrics_json(&*r.recognized, r.rollout ? &*r.rollout : nullptr));
  if (!t.options.picture.empty()) capture::write_png(t.options.picture, eval::comparison(c.engine, twin, c.recorded));
}

void run_stages(Training& t) {
  const trajectory::Trajectory base = t.capture.base;
  core::write_file(t.run / kBaseFile, trajectory::write_tum(base.samples()));
  if (t.recognize) {
    recognize(t);
    core::trim_memory();  // or the next stage's need comes on top
    write_covariances(t);
    save_and_go_on(t);
  }
  std::future<Comparison> comparison;
  if (t.evaluate && !t.joint) comparison = begin_comparison(t);  // refinement by images changes what is compared
  if (t.identify) {
    identify_states(t.twin, base, t.options.mode == twin::Mode::paper, t.options.seed);
    t.result.fits.emplace_back("identify", *t.twin.estimates.solver);
    save_and_go_on(t);
  }
  if (t.joint) {
    t.result.fits.emplace_back("joint", refine(t.twin, t.capture, *t.device, t.options.seed));
    write_covariances(t);
    save_and_go_on(t);
  }
  if (t.roll_out) {
    roll_out(t.twin, base, t.run);
    save_and_go_on(t);
  }
  if (t.evaluate) evaluate(t, comparison.valid() ? std::move(comparison) : begin_comparison(t));
  save(t);  // with all durations
  write_report(t.run);
  remove_checkpoint_folder(t.run);
}

// The stages with their log, and what becomes of the folder where they fail. `was_there`: before this call.
void run_logged(Training& t, bool was_there, core::Listener listener) {
  const std::string kept = "what exists so far is kept in " + t.run.string() + ", and `resume` goes on from there";
  try {
    ProgressLog log(t.run / kLogFile);
    const auto shown = listener.progress;
    listener.progress = [&](const core::Progress& progress) {
      if (shown) shown(progress);
      log.write(progress);
    };
    const auto recorded = listener.record;
    listener.record = [&](const std::string& json) {
      if (recorded) recorded(json);
      log.write(json);
    };
    const core::ListenerScope logged(listener);
    run_stages(t);
  } catch (const Interrupted&) {
    core::say("stopped; a checkpoint is in " + t.run.string() + ": the same with `resume` continues");
    throw;
  } catch (const InputError& wrong) {
    if (t.saved || was_there) throw broken_off(wrong, kept);
    // nothing is left where nothing was
    std::error_code ignored;
    remove_run_files(t.run);
    remove_checkpoint_folder(t.run);
    fs::remove(t.run, ignored);
    throw;
  } catch (const WorkError& failure) {
    throw broken_off(failure, kept);
  } catch (const std::bad_alloc&) {
    throw WorkError("memory", "there is not enough of it", "use fewer `frames` or a machine with more; " + kept);
  } catch (const std::exception& defect) {
    throw WorkError("internal", defect.what(), "this is a defect, please report the command; " + kept);
  }
}

// `t` has the request.
TrainResult run_training(Training t, const core::Listener& listener) {
  const core::ListenerScope scope(listener);
  const Path run = t.run;
  const TrainOptions options = t.options;
  options.check();
  check_outputs(t);
  prepare(t);
  std::error_code error;
  const bool was_there = fs::exists(run, error);
  core::make_folder(run / kCheckpointFolder);
  const FolderLock lock(run / kLockFile);
  remove_half_written(run);
  if (options.force) {
    remove_run_files(run);
    recognition::remove_checkpoint(run / kCheckpointFolder);
  }
  t.saved = t.continued;
  try {
    run_logged(t, was_there, listener);
  } catch (...) {
    if (t.workspace) t.workspace->device.reset();  // it may be lost
    throw;
  }
  t.result.twin = std::move(t.twin);
  return std::move(t.result);
}

}  // namespace

std::shared_ptr<Workspace> make_workspace() { return std::make_shared<Workspace>(); }

TrainResult train(const Path& capture, const Path& run, const TrainOptions& options, const core::Listener& listener,
                  Workspace* workspace) {
  Training t;
  t.capture_path = capture, t.run = run, t.options = options, t.workspace = workspace;
  return run_training(std::move(t), listener);
}

TrainResult train(const capture::InMemory& capture, const Path& run, const TrainOptions& options,
                  const core::Listener& listener, Workspace* workspace) {
  Training t;
  t.recording = &capture, t.capture_path = "`capture`", t.run = run, t.options = options, t.workspace = workspace;
  return run_training(std::move(t), listener);
}

}  // namespace chainsplat::pipeline
