#include <algorithm>
#include <cmath>
#include <cstdio>
#include <future>
#include <numeric>

#include "chainsplat/image_model.h"
#include "src/math/usual.h"
#include "src/recognition/checkpoint.h"
#include "src/recognition/hold_colors.h"
#include "src/recognition/light.h"
#include "src/recognition/modes.h"
#include "src/recognition/place_gaussians.h"
#include "src/recognition/rolls.h"
#include "src/recognition/step_watch.h"
#include "src/recognition/unseen.h"

namespace chainsplat::recognition {

namespace {

// The schedule: rounds of Adam on the Gaussians, each followed by additions where the images ask and by Gauss-Newton on
// the angles; then a polish; then a last round, in which what was seen settles beside what was guessed and cut.
constexpr int kRounds = 4;
constexpr int kPolish = kRounds, kSettle = kRounds + 1, kDone = kRounds + 2;  // as rounds
constexpr int kSteps = 50;                                                    // Adam steps a round
constexpr int kPolishSteps = 80;
constexpr int kSettleSteps = 60;
constexpr double kGaussiansADiameter =
    100.0;  // of the rope's length, when no budget is given: more gain little (design.md, 'Recognition')
constexpr double kFirstShare = 0.8;  // of the budget, placed at the start; the rest goes where the images ask
constexpr int kAngleIterations = 1;  // Gauss-Newton steps a round and frame
constexpr int kAngleRound =
    2;  // the first with such steps: before, colors know less of the angles than the outlines do
constexpr int kFinalIterations = 1;        // for every frame, at the end
constexpr double kPastJoint = 0.1;         // diameters that Gaussians may reach past their joints before a round
constexpr double kPastJointAtLast = 0.25;  // and at last: few steps follow that would close the gaps
constexpr int kMostRestarts = 3;           // of a round that runs away, each with smaller steps
constexpr int kShRound = 1;  // from this round on colors depend on the view (SH degree 1): +0.7 dB in the object

}  // namespace

splat::AdamRates rates(double fraction, double scale) {
  const auto fall = static_cast<float>(scale * std::pow(0.1, fraction));
  splat::AdamRates r;
  r.mean = 2e-4f * fall;  // m: a twelfth of a Gaussian's spacing on the rope
  r.rotation = 0.03f * fall;
  r.log_scale = 0.05f * fall;
  r.opacity = 0.12f * fall;
  r.sh0 = 0.06f * fall;  // 0.017 in color
  r.sh_rest = 0.03f * fall;
  r.link_logits = 0.0f;  // hard on their link: soft gained nothing (design.md, 'Recognition')
  return r;
}

namespace {

constexpr int kTotalSteps = kRounds * kSteps + kPolishSteps + kSettleSteps;
constexpr int steps_of(int round) { return round < kRounds ? kSteps : round == kPolish ? kPolishSteps : kSettleSteps; }
constexpr int steps_before(int round) {
  return std::min(round, kRounds) * kSteps + (round == kSettle ? kPolishSteps : 0);
}

struct TrainingViews {
  std::vector<int> frames;    // that train
  std::vector<int> views;     // capture view of every training view
  std::vector<int> frame_of;  // its frame
  std::vector<int> index_of;  // capture view -> training view or -1
};

// Of these frames those in which no more of the rope is hidden than in most: Gaussians become transparent where
// something is in front of them. All where there are too few. `states` by silhouettes.
std::vector<int> unhidden(const chain::Chain& chain, const capture::Capture& capture,
                          const std::vector<FrameViews>& frames, const chain::States& states,
                          const std::vector<int>& candidates) {
  constexpr int kPoints = 97;           // along the rope
  constexpr double kMoreHidden = 0.05;  // share of them, above what is usual
  const std::vector<double> along = chain::equal_arclengths(chain, kPoints);
  std::vector<double> hidden(candidates.size(), 0.0);  // mean over the views
  core::parallel_for(static_cast<std::int64_t>(candidates.size()), [&](std::int64_t i) {
    const int k = candidates[i];
    for (const int v : frames[k].views) {
      const capture::View view = capture::unpacked(capture.views[v]);
      const auto motions = view_motions(chain, capture, states, frames[k], k, states.theta[k], view);
      const std::vector<char> seen = shown(chain, capture.cameras[view.camera], view, motions, along);
      hidden[i] += static_cast<double>(std::count(seen.begin(), seen.end(), 0)) /
                   static_cast<double>(seen.size() * frames[k].views.size());
    }
  });
  std::vector<int> out;
  for (const int i : math::usual_ones(hidden, kMoreHidden)) out.push_back(candidates[i]);
  return out;
}

TrainingViews training_views(const chain::Chain& chain, const capture::Capture& capture,
                             const std::vector<FrameViews>& frames, const chain::States& states, int every) {
  constexpr std::size_t kMost = static_cast<std::size_t>(kBatch) * kTotalSteps;  // views: the steps draw no more
  TrainingViews t;
  t.index_of.assign(capture.views.size(), -1);
  std::vector<int> used;
  for (int k = 0; k < static_cast<int>(frames.size()); k += every)
    if (!frames[k].views.empty()) used.push_back(k);
  used = unhidden(chain, capture, frames, states, used);
  std::size_t views = 0;
  for (const int k : used) views += frames[k].views.size();
  for (std::size_t i = 0; i < used.size(); i += (views + kMost - 1) / kMost) {
    const int k = used[i];
    t.frames.push_back(k);
    for (const int v : frames[k].views) {
      t.index_of[v] = static_cast<int>(t.views.size());
      t.views.push_back(v);
      t.frame_of.push_back(k);
    }
  }
  return t;
}

// The loss of each training view where nothing is drawn.
std::vector<double> empty_losses(const capture::Capture& capture, const TrainingViews& training) {
  std::vector<double> out;
  double object_pixels = 0.0;
  for (const int v : training.views) {
    double sum = 0.0;
    const std::vector<std::uint8_t>& rgba = capture.views[v].rgba;
    for (std::size_t i = 0; i < rgba.size(); i += 4) {
      sum += kLossWeights.l1 * (rgba[i] + rgba[i + 1] + rgba[i + 2]) / 3.0 + kLossWeights.mask * rgba[i + 3];
      object_pixels += rgba[i + 3] >= image_model::kObjectMask ? 1.0 : 0.0;
    }
    out.push_back(sum / 255.0);
  }
  for (double& loss : out) loss /= std::max(1.0, object_pixels / static_cast<double>(out.size()));
  return out;
}

double mean(const std::vector<double>& values) {
  return values.empty() ? 0.0 : std::accumulate(values.begin(), values.end(), 0.0) / static_cast<double>(values.size());
}

// What the rounds share.
struct Job {
  const capture::Capture& capture;
  const Options& options;
  std::string text = job_text(capture, options);  // by which its checkpoints are known
  Result result = {};                             // the chain, and how it was chosen
  chain::States states = {};
  std::vector<math::VectorX> coarse = {};  // by the silhouettes; what later steps correct goes to all frames
  // What the silhouettes know stays known: appearance alone would pull angles to explain rolling and shading.
  AnglePrior prior = {};
  splat::Gaussians gaussians = {};  // at the round's start
  StepWatch watch = {};
  int first_round = 0, first_step = 0;    // where a resumed job goes on,
  splat::Engine::Snapshot snapshot = {};  // and from what, within a round
  std::vector<FrameViews> frames = {};    // as assigned to states.time
  TrainingViews training = {};
  std::vector<double> empty = {};  // empty_losses()
  double loss = NAN, psnr = NAN;   // last read
};

int budget_of(const capture::Capture& capture, const Options& options) {
  constexpr double kLeast = 300, kMost = 6000;  // of the automatic choice: short stubs and thin cables
  if (options.budget > 0) return options.budget;
  return static_cast<int>(
      std::lround(std::clamp(kGaussiansADiameter * capture.length / capture.diameter, kLeast, kMost)));
}

// What the table and the grasp say of where the rope lies is not what cameras see: one of them is given wrongly.
constexpr double kTableOff = 0.1;  // diameters
void warn_of_height(const capture::Capture& capture, double off) {
  char text[200];
  const bool lower =
      off * (capture.base.pose(capture.base.start()).rotation * capture.bending_axis).dot(capture.table->normal) < 0.0;
  std::snprintf(text, sizeof text,
                "the rope lies %.1f mm %s than table, grasp and diameter say: it is taken as the cameras see it",
                1e3 * std::abs(off), lower ? "lower" : "higher");
  core::warn(capture.name + ": " + text);
}

// A rope that lies on a table, and bends in its plane alone: it may lie lower than its grasp, and roll.
bool lies_flat(const Job& job, chain::Bending bending) {
  return job.capture.tabletop && bending == chain::Bending::planar && !job.options.twist;
}

// The chain that the silhouettes ask for, and the angles that they show.
void begin(Job& job) {
  constexpr int kFirstJoints = 12;  // which most ropes end with
  const capture::Capture& capture = job.capture;
  const Options& options = job.options;
  Result& result = job.result;
  core::report({"recognize", 0, kTotalSteps, NAN, NAN, "silhouettes"});
  const bool decide = !options.bending && !capture.tabletop;
  const chain::Bending first =
      options.bending.value_or(capture.tabletop ? chain::Bending::planar : chain::Bending::spatial);
  result.bending.bending = first;
  int joints = options.joints.value_or(kFirstJoints);
  result.chain = chain_of(capture, options, first, joints);
  const double given = lies_flat(job, first) ? silhouette::height_by_table(capture) : 0.0;
  double height = given;
  result.chain.lift = silhouette::lying_down(result.chain, height);
  silhouette::SequenceFit fit = silhouette::fit_sequence(result.chain, capture);
  if (decide) result.bending = silhouette::choose_bending(result.chain, capture, fit);
  if (!options.joints) {
    result.joints = silhouette::choose_joints(result.chain, fit);
    joints = result.joints.joints;
  }
  if (lies_flat(job, first) && options.height) height = silhouette::fit_height(result.chain, capture, fit, given);
  if (capture.table && std::abs(height - given) > kTableOff * capture.diameter) warn_of_height(capture, height - given);
  if (result.bending.bending != first || joints != result.chain.links() - 1 || height != given) {
    result.chain = chain_of(capture, options, result.bending.bending, joints);
    result.chain.lift = silhouette::lying_down(result.chain, height);
    fit = silhouette::fit_sequence(result.chain, capture);
  }
  job.states = fit.states;
  job.coarse = job.states.theta;
  job.prior = prior_of(fit);
}

void resume(Job& job, Checkpoint before) {
  Result& result = job.result;
  result.bending = {before.spatial ? chain::Bending::spatial : chain::Bending::planar, before.out_of_plane_rms,
                    before.deviation};
  const chain::Chain joint = chain_of(job.capture, job.options, result.bending.bending, 1);
  const Eigen::Index n = before.states.theta.at(0).size();
  result.chain = chain_of(job.capture, job.options, result.bending.bending, static_cast<int>(n) / joint.angles());
  result.chain.lift = std::move(before.lift);
  job.states = std::move(before.states);
  job.gaussians = std::move(before.gaussians);
  job.first_round = before.stage;
  job.first_step = before.step;
  job.snapshot = std::move(before.snapshot);
  job.watch = before.watch;
  const double* from = before.extra.data();
  for (std::size_t k = 0; k < job.states.time.size(); ++k, from += n)
    job.coarse.emplace_back(Eigen::Map<const math::VectorX>(from, n));
  for (std::size_t k = 0; k < job.states.time.size(); ++k, from += n * n)
    job.prior.information.emplace_back(Eigen::Map<const math::MatrixX>(from, n, n));
  job.prior.mean = job.coarse;
}

// `step`: Adam's steps done of the round.
void save(const Job& job, splat::Engine& engine, int round, int step) {
  if (job.options.checkpoint.empty()) return;
  Checkpoint c;
  c.job = job.text;
  c.stage = round;
  c.step = step;
  c.watch = job.watch;
  c.spatial = job.result.bending.bending == chain::Bending::spatial;
  c.out_of_plane_rms = job.result.bending.out_of_plane_rms;
  c.deviation = job.result.bending.deviation;
  c.lift = job.result.chain.lift;
  c.states = job.states;
  c.gaussians = job.gaussians;
  if (step > 0) c.snapshot = engine.snapshot();
  std::size_t numbers = 0;  // so that they are there once, which for many angles is a large part of all memory
  for (const math::VectorX& theta : job.coarse) numbers += static_cast<std::size_t>(theta.size());
  for (const math::MatrixX& m : job.prior.information) numbers += static_cast<std::size_t>(m.size());
  c.extra.reserve(numbers);
  for (const math::VectorX& theta : job.coarse)
    c.extra.insert(c.extra.end(), theta.data(), theta.data() + theta.size());
  for (const math::MatrixX& m : job.prior.information) c.extra.insert(c.extra.end(), m.data(), m.data() + m.size());
  save_checkpoint(c, job.options.checkpoint);
}

// The training views with the links where the states put them.
std::vector<splat::ViewSpec> posed_views(const Job& job, const chain::States& states) {
  std::vector<splat::ViewSpec> specs;
  for (std::size_t i = 0; i < job.training.views.size(); ++i) {
    const int k = job.training.frame_of[i];
    const capture::PackedView& view = job.capture.views[job.training.views[i]];
    specs.push_back(
        view_spec(job.capture, view,
                  view_motions(job.result.chain, job.capture, states, job.frames[k], k, states.theta[k], view)));
  }
  return specs;
}

// Adam's steps of one round, from `first_step`. Which views make a batch depends on the round alone: a resumed one
// draws those of the steps before again. False: the optimization ran away.
bool train_gaussians(Job& job, splat::Engine& engine, int round, int first_step, core::Random& random) {
  constexpr int kReadEvery = 10;
  const std::string note = round < kRounds    ? "round " + std::to_string(round + 1) + " of " + std::to_string(kRounds)
                           : round == kPolish ? "polish"
                                              : "settle";
  const int steps = steps_of(round), before = steps_before(round);
  ViewDeck deck;
  for (int step = 0; step < steps; ++step) {
    const std::vector<int> batch = draw_batch(deck, kBatch, static_cast<int>(job.training.views.size()), random);
    if (step < first_step) continue;
    if (const int signal = core::stop_requested()) {
      save(job, engine, round, step);
      throw Interrupted(signal);
    }
    const bool read = step % kReadEvery == 0;
    const int done = before + step + 1;
    const splat::LossValues values =
        engine.step(batch, kLossWeights,
                    rates(static_cast<double>(done - 1) / kTotalSteps, job.options.step * step_scale(job.watch)), read);
    if (watch_gradients(job.watch, values.not_finite, done) == Course::diverged) return false;
    if (!read) continue;
    job.loss = values.total / static_cast<double>(batch.size());
    job.psnr = mean(values.psnr_object);
    double nothing = 0.0;
    for (const int v : batch) nothing += job.empty[v];
    // masks of a batch may all be empty
    if (nothing > 0.0 && watch_loss(job.watch, values.total / nothing) == Course::diverged) return false;
    core::report({"recognize", done, kTotalSteps, job.loss, job.psnr, note});
  }
  return true;
}

// A round that ran away is done again from its start, with smaller steps from here on.
void slow_down(StepWatch& watch, int round) {
  ++watch.restarts;
  const std::string trouble = std::string(watch.bad_in_a_row > 0 ? "gradients are not finite" : "the loss runs away") +
                              " in round " + std::to_string(round + 1);
  const std::string size = core::exact(step_scale(watch)) + " of the usual ones";
  if (watch.restarts > kMostRestarts)
    throw WorkError("recognize", trouble + " at step sizes down to " + size,
                    "look at the capture with 'chainsplat check'; if it is sound, report it");
  core::warn("recognize: " + trouble + "; it is repeated from its start with steps of " + size);
  watch.bad_in_a_row = 0;
}

// One round of Adam, again where it runs away. Leaves what it began with in job.gaussians, the rest in the engine.
// Returns the round's random numbers as the steps leave them.
core::Random train_round(Job& job, splat::Engine& engine, int round) {
  constexpr int kFirstSeed = 100, kPolishSeed = 999;  // of the rounds
  for (bool resumed = round == job.first_round && job.first_step > 0;; resumed = false) {
    core::Random random(job.options.seed * 1000003 + (round == kPolish ? kPolishSeed : kFirstSeed + round));
    if (resumed) {
      engine.restore(job.snapshot);
    } else {
      begin_round(job.watch);
      save(job, engine, round, 0);
      engine.set_gaussians(job.gaussians);
    }
    if (train_gaussians(job, engine, round, resumed ? job.first_step : 0, random)) return random;
    slow_down(job.watch, round);
  }
}

// Calls `part` with the training frames, so many at a time as are drawn together.
template <class Part>
void for_training_parts(const Job& job, Part&& part) {
  const std::vector<int>& frames = job.training.frames;
  for (std::size_t from = 0; from < frames.size();) {
    std::size_t to = from, pixels = 0;
    for (; to < frames.size() && pixels < kPartPixels; ++to)
      for (const int v : job.frames[frames[to]].views)
        pixels += static_cast<std::size_t>(job.capture.views[v].width) * job.capture.views[v].height;
    part(std::span(frames).subspan(from, to - from));
    from = to;
  }
}

// Draws the training frames, and moves their angles by Gauss-Newton, with the engine's Gaussians held, if `move`.
// Returns, by training view, what the picture that was drawn last does not explain, if `keep`: Gaussians are missing
// there. Else steps that cannot go far are trusted, and not drawn.
std::vector<Unexplained> refine_training(Job& job, splat::Engine& engine, bool move, bool keep) {
  std::vector<Unexplained> last(keep ? job.training.views.size() : 0);
  const Draw draw = [&](std::span<const int> views, std::span<const std::vector<math::Pose>> motions) {
    std::vector<int> batch;
    for (std::size_t v = 0; v < views.size(); ++v) {
      batch.push_back(job.training.index_of[views[v]]);
      engine.set_motions(batch.back(), motions[v]);
    }
    std::vector<splat::Picture> pictures = engine.draw_views(batch, true);
    if (keep)
      core::parallel_for(static_cast<std::int64_t>(views.size()), [&](std::int64_t v) {
        last[batch[v]] = unexplained(job.capture.views[views[v]], pictures[v], motions[v]);
      });
    return pictures;
  };
  RefineOptions refine;
  refine.iterations = kAngleIterations;
  refine.mask_weight = kAngleMaskWeight;
  if (!keep) refine.trusted = kTrustedStep;
  for_training_parts(job, [&](std::span<const int> part) {
    if (move) {
      refine_angles(job.result.chain, job.capture, job.frames, part, draw, refine, job.prior, job.states);
      return;
    }
    std::vector<int> views;
    std::vector<std::vector<math::Pose>> motions;
    for (const int k : part)
      for (const int v : job.frames[k].views) {
        views.push_back(v);
        motions.push_back(view_motions(job.result.chain, job.capture, job.states, job.frames[k], k, job.states.theta[k],
                                       job.capture.views[v]));
      }
    draw(views, motions);
  });
  return last;
}

// Gaussians go where the images ask for more of them.
void add_gaussians(Job& job, const std::vector<Unexplained>& last, int budget, int round, core::Random& random) {
  std::vector<Drawn> drawn;
  for (std::size_t i = 0; i < last.size(); ++i) drawn.push_back({&job.capture.views[job.training.views[i]], &last[i]});
  add_and_prune(job.gaussians, job.result.chain, job.capture, drawn, budget, std::max(1, budget / 10), random);
  if (round + 1 == kShRound && job.gaussians.degree == 0)
    job.gaussians.resize(job.gaussians.count, job.gaussians.links, 1);
}

std::vector<Viewpoint> viewpoints_of(const Job& job, const std::vector<splat::ViewSpec>& specs) {
  std::vector<Viewpoint> viewpoints;
  for (std::size_t i = 0; i < specs.size(); ++i)
    viewpoints.push_back({specs[i].camera, &job.capture.views[job.training.views[i]], specs[i].motions});
  return viewpoints;
}

void guess_unseen(Job& job, const std::vector<splat::ViewSpec>& specs) {
  const int unseen = finish_unseen(job.result.chain, viewpoints_of(job, specs), job.gaussians);
  core::say_more("recognize: " + std::to_string(unseen) + " of " + std::to_string(job.gaussians.count) +
                 " Gaussians lie where no camera saw the rope; their colors are guessed");
}

// All frames are refined, from the silhouettes plus the correction of the training frames around each.
void refine_all_frames(Job& job, splat::Engine& engine) {
  core::report({"recognize", kTotalSteps, kTotalSteps, job.loss, job.psnr, "all frames"});
  const std::vector<int>& trained = job.training.frames;
  chain::States correction;
  for (const int k : trained) {
    correction.time.push_back(job.states.time[k]);
    correction.theta.push_back(job.states.theta[k] - job.coarse[k]);
  }
  std::vector<int> all;
  for (int k = 0; k < static_cast<int>(job.frames.size()); ++k) {
    if (job.frames[k].views.empty()) continue;
    all.push_back(k);
    if (!std::binary_search(trained.begin(), trained.end(), k))
      job.states.theta[k] = job.coarse[k] + chain::interpolate(correction, job.states.time[k]);
  }
  job.result.summary = refine_all(engine, job.result.chain, job.capture, job.frames, job.gaussians, all,
                                  kFinalIterations, job.prior, job.states);
  differentiate(job.states);
}

}  // namespace

Result recognize_fast(gpu::Device& device, const capture::Capture& capture, const Options& options) {
  Job job{capture, options};
  // the kernels are made ready while the silhouettes are fitted on one core
  std::future<splat::Engine> opening = std::async(std::launch::async, [&device] { return splat::Engine(device); });
  std::optional<Checkpoint> before;
  if (options.resume && !options.checkpoint.empty()) before = load_checkpoint(options.checkpoint, job.text);
  const bool resumed = before.has_value();
  if (resumed)
    resume(job, std::move(*before));
  else
    begin(job);
  job.frames = assign_views(capture, job.states.time);
  splat::Light light;
  if (!resumed && lies_flat(job, job.result.bending.bending))
    job.states.roll = rolls_in(job.result.chain, capture, job.frames, job.states);
  if (!resumed) light = light_on(job.result.chain, capture, job.frames, job.states);
  chain::States by_silhouettes = job.states;  // as they were when the job began, whether it is resumed or not
  by_silhouettes.theta = job.coarse;
  job.training = training_views(job.result.chain, capture, job.frames, by_silhouettes, std::max(1, options.every));
  if (job.training.views.empty())
    throw WorkError(capture.name, "no training frame shows the object", "use `every` 1 or check the masks");
  job.empty = empty_losses(capture, job.training);

  splat::Engine engine = opening.get();
  std::vector<splat::ViewSpec> specs = posed_views(job, job.states);
  std::vector<const capture::PackedView*> targets;
  for (const int v : job.training.views) targets.push_back(&capture.views[v]);
  engine.set_views(specs, targets);
  const Radii radii = radii_in(job.result.chain, viewpoints_of(job, posed_views(job, by_silhouettes)));
  const int budget = budget_of(capture, options);
  if (!resumed) {
    core::Random random(options.seed * 1000003 + 1);
    job.gaussians = place_along_chain(job.result.chain, capture, job.states, job.frames, job.training.frames, light,
                                      static_cast<int>(kFirstShare * budget), random);
    job.gaussians.pixel_footprint = pixel_footprint(job.result.chain, viewpoints_of(job, specs));
  }

  for (int round = job.first_round; round < kRounds; ++round) {
    core::Random random = train_round(job, engine, round);
    const bool adding = round + 1 < kRounds;
    const std::vector<Unexplained> last = refine_training(job, engine, round >= kAngleRound, adding);
    specs = posed_views(job, job.states);
    for (std::size_t i = 0; i < specs.size(); ++i) engine.set_motions(static_cast<int>(i), specs[i].motions);
    job.gaussians = engine.gaussians();
    bound_gaussians(job.result.chain, job.gaussians, kPastJoint * job.result.chain.diameter, &radii);
    if (adding)
      add_gaussians(job, last, budget, round, random);
    else
      guess_unseen(job, specs);
  }
  if (job.first_round <= kPolish) {
    train_round(job, engine, kPolish);
    job.gaussians = engine.gaussians();
    bound_gaussians(job.result.chain, job.gaussians, kPastJointAtLast * job.result.chain.diameter, &radii);
    guess_unseen(job, specs);  // again: without a gradient Adam moves them, too
  }
  if (job.first_round <= kSettle) {
    train_round(job, engine, kSettle);
    splat::Gaussians settled = engine.gaussians();
    keep_guessed(job.gaussians, settled);
    job.gaussians = std::move(settled);
    bound_gaussians(job.result.chain, job.gaussians, kPastJointAtLast * job.result.chain.diameter, &radii);
    save(job, engine, kDone, 0);
  }
  hold_colors(job.result.chain, viewpoints_of(job, specs), job.gaussians);
  refine_all_frames(job, engine);
  job.result.gaussians = std::move(job.gaussians);
  job.result.states = std::move(job.states);
  return std::move(job.result);
}

}  // namespace chainsplat::recognition
