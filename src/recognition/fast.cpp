#include <algorithm>
#include <cmath>
#include <numeric>

#include "chainsplat/image_model.h"
#include "src/recognition/checkpoint.h"
#include "src/recognition/modes.h"
#include "src/recognition/place_gaussians.h"
#include "src/recognition/step_watch.h"
#include "src/recognition/unseen.h"

namespace chainsplat::recognition {

namespace {

// The schedule: rounds of Adam on the Gaussians, additions where the images ask, and Gauss-Newton on the angles.
constexpr int kRounds = 4;
constexpr int kSteps = 100;  // Adam steps a round
constexpr double kGaussiansADiameter =
    100.0;  // of the rope's length, when no budget is given: more gain little (design.md, 'Recognition')
constexpr double kFirstShare = 0.8;  // of the budget, placed at the start; the rest goes where the images ask
constexpr int kAngleIterations = 1;  // Gauss-Newton steps a round and frame
constexpr int kFinalIterations = 1;  // for every frame, at the end
constexpr int kFinalSteps = 120;     // Adam steps after the last round, rates falling
constexpr int kMostRestarts = 3;     // of a round that runs away, each with smaller steps
constexpr int kShRound = 1;  // from this round on colors depend on the view (SH degree 1): +0.7 dB in the object

}  // namespace

splat::AdamRates rates(double fraction, double scale) {
  const auto fall = static_cast<float>(scale * std::pow(0.1, fraction));
  splat::AdamRates r;
  r.mean = 2.5e-4f * fall;  // m: a tenth of a Gaussian's spacing on the rope
  r.rotation = 0.02f * fall;
  r.log_scale = 0.03f * fall;
  r.opacity = 0.08f * fall;
  r.sh0 = 0.06f * fall;  // 0.017 in color
  r.sh_rest = 0.01f * fall;
  r.link_logits = 0.0f;  // hard on their link: soft gained nothing (design.md, 'Recognition')
  return r;
}

namespace {

struct TrainingViews {
  std::vector<int> frames;    // that train
  std::vector<int> views;     // capture view of every training view
  std::vector<int> frame_of;  // its frame
  std::vector<int> index_of;  // capture view -> training view or -1
};

TrainingViews training_views(const capture::Capture& capture, const std::vector<FrameViews>& frames, int every) {
  TrainingViews t;
  t.index_of.assign(capture.views.size(), -1);
  for (int k = 0; k < static_cast<int>(frames.size()); k += every) {
    if (frames[k].views.empty()) continue;
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

}  // namespace

Result recognize_fast(gpu::Device& device, const capture::Capture& capture, const Options& options) {
  Result result;
  const std::string job = job_text(capture, options);
  const auto make = [&](chain::Bending bending, int joints) {
    return chain::make_chain(capture.length, capture.diameter, capture.direction, capture.bending_axis, joints, bending,
                             options.twist);
  };
  const int total_steps = kRounds * kSteps + kFinalSteps;
  constexpr double kLeastBudget = 300, kMostBudget = 6000;  // of the automatic choice: short stubs and thin cables
  const double by_size = std::clamp(kGaussiansADiameter * capture.length / capture.diameter, kLeastBudget, kMostBudget);
  const int budget = options.budget > 0 ? options.budget : static_cast<int>(std::lround(by_size));
  const int added_a_round = std::max(1, budget / 10);
  constexpr int kFirstJoints = 12;  // which most ropes end with
  int first_round = 0;
  StepWatch watch;
  splat::Gaussians gaussians;
  chain::States states;
  AnglePrior prior;

  std::optional<Checkpoint> before;
  if (options.resume && !options.checkpoint.empty()) before = load_checkpoint(options.checkpoint, job);
  if (before) {
    result.bending = {before->spatial ? chain::Bending::spatial : chain::Bending::planar, before->out_of_plane_rms,
                      before->deviation};
    const chain::Chain joint = make(result.bending.bending, 1);
    result.chain = make(result.bending.bending, static_cast<int>(before->states.theta.at(0).size()) / joint.angles());
    states = before->states;
    gaussians = before->gaussians;
    first_round = before->stage;
    watch = before->watch;
  } else {
    // coarse: silhouettes
    core::report({"recognize", 0, total_steps, NAN, NAN, "silhouettes"});
    const bool decide = !options.bending && !capture.tabletop;
    const chain::Bending first =
        options.bending.value_or(capture.tabletop ? chain::Bending::planar : chain::Bending::spatial);
    result.bending.bending = first;
    int joints = options.joints.value_or(kFirstJoints);
    result.chain = make(first, joints);
    silhouette::SequenceFit fit = silhouette::fit_sequence(result.chain, capture);
    if (decide) result.bending = silhouette::choose_bending(result.chain, capture, fit);
    if (!options.joints) {
      result.joints = silhouette::choose_joints(result.chain, fit);
      joints = result.joints.joints;
    }
    if (result.bending.bending != first || joints != result.chain.links() - 1) {
      result.chain = make(result.bending.bending, joints);
      fit = silhouette::fit_sequence(result.chain, capture);
    }
    states = fit.states;
    // what the silhouettes know stays known: appearance alone would pull angles to explain rolling and shading
    prior = prior_of(fit);
  }
  std::vector<math::VectorX> coarse = states.theta;  // to carry corrections to the frames that do not train
  if (before) {
    const Eigen::Index n = result.chain.angles();
    const double* from = before->extra.data();
    for (math::VectorX& theta : coarse) {
      theta = Eigen::Map<const math::VectorX>(from, n);
      from += n;
    }
    for (std::size_t k = 0; k < coarse.size(); ++k, from += n * n)
      prior.information.push_back(Eigen::Map<const math::MatrixX>(from, n, n));
    prior.mean = coarse;
  }
  const std::vector<FrameViews> frames = assign_views(capture, states.time);
  const TrainingViews training = training_views(capture, frames, std::max(1, options.every));
  if (training.views.empty())
    throw WorkError(capture.name, "no training frame shows the object", "use `every` 1 or check the masks");
  const chain::Chain& chain = result.chain;

  splat::Engine engine(device);
  std::vector<splat::ViewSpec> specs;
  std::vector<const std::vector<std::uint8_t>*> targets;
  const auto pose_views = [&] {
    specs.clear();
    for (std::size_t i = 0; i < training.views.size(); ++i) {
      const int k = training.frame_of[i];
      const capture::View& view = capture.views[training.views[i]];
      specs.push_back(
          view_spec(capture, view, view_motions(chain, capture, states, frames[k], k, states.theta[k], view)));
    }
  };
  pose_views();
  for (const int v : training.views) targets.push_back(&capture.views[v].rgba);
  engine.set_views(specs, targets);
  if (!before) {
    core::Random random(options.seed * 1000003 + 1);
    gaussians = place_along_chain(chain, capture, states, frames, training.frames,
                                  static_cast<int>(kFirstShare * budget), random);
  }

  double loss = NAN, psnr = NAN;
  const auto checkpoint = [&](int round, int step) {
    if (options.checkpoint.empty()) return;
    Checkpoint c;
    c.job = job;
    c.stage = round;
    c.step = step;
    c.watch = watch;
    c.spatial = result.bending.bending == chain::Bending::spatial;
    c.out_of_plane_rms = result.bending.out_of_plane_rms;
    c.deviation = result.bending.deviation;
    c.states = states;
    c.gaussians = gaussians;
    if (step > 0) c.snapshot = engine.snapshot();
    for (const math::VectorX& theta : coarse) c.extra.insert(c.extra.end(), theta.data(), theta.data() + theta.size());
    for (const math::MatrixX& m : prior.information) c.extra.insert(c.extra.end(), m.data(), m.data() + m.size());
    save_checkpoint(c, options.checkpoint);
  };
  const std::vector<double> empty = empty_losses(capture, training);
  // Adam's steps of one round (the last is the polish). Which views make a batch depends on the round alone: a resumed
  // one draws those of the steps before `first_step` again. False: the optimization ran away.
  const auto adam = [&](int round, int first_step, core::Random& random) {
    const std::string note =
        round < kRounds ? "round " + std::to_string(round + 1) + " of " + std::to_string(kRounds) : "last polish";
    ViewDeck deck;
    for (int step = 0; step < (round < kRounds ? kSteps : kFinalSteps); ++step) {
      const std::vector<int> batch = draw_batch(deck, kBatch, static_cast<int>(training.views.size()), random);
      if (step < first_step) continue;
      if (const int signal = core::stop_requested()) {
        checkpoint(round, step);
        throw Interrupted(signal);
      }
      constexpr int kReadEvery = 10;
      const bool read = step % kReadEvery == 0;
      const int done_steps = round * kSteps + step + 1;
      const splat::LossValues values =
          engine.step(batch, kLossWeights,
                      rates(static_cast<double>(done_steps - 1) / total_steps, options.step * step_scale(watch)), read);
      if (watch_gradients(watch, values.not_finite, done_steps) == Course::diverged) return false;
      if (read) {
        loss = values.total / static_cast<double>(batch.size());
        psnr = mean(values.psnr_object);
        double nothing = 0.0;
        for (const int v : batch) nothing += empty[v];
        // masks of a batch may all be empty
        if (nothing > 0.0 && watch_loss(watch, values.total / nothing) == Course::diverged) return false;
        core::report({"recognize", done_steps, total_steps, loss, psnr, note});
      }
    }
    return true;
  };
  // what the angles' refinement drew last of every training view: it shows where Gaussians are missing, too
  struct LastDrawn {
    std::vector<math::Pose> motions;
    splat::Picture picture;
  };
  std::vector<LastDrawn> last_drawn(training.views.size());
  const auto draw_training = [&](std::span<const int> views, std::span<const std::vector<math::Pose>> motions,
                                 bool keep) {
    std::vector<int> batch;
    for (std::size_t v = 0; v < views.size(); ++v) {
      batch.push_back(training.index_of[views[v]]);
      engine.set_motions(batch.back(), motions[v]);
    }
    std::vector<splat::Picture> pictures = engine.draw_views(batch, true);
    for (std::size_t v = 0; keep && v < views.size(); ++v)
      last_drawn[batch[v]] = {motions[v], {pictures[v].width, pictures[v].height, pictures[v].rgba, {}}};
    return pictures;
  };
  for (int round = first_round; round <= kRounds; ++round) {
    const bool polish = round == kRounds;
    core::Random random(options.seed * 1000003 + (polish ? 999 : 100 + round));
    int first_step = 0;
    if (before && round == first_round && before->step > 0) {
      first_step = before->step;
      engine.restore(before->snapshot);
    } else {
      begin_round(watch);
      checkpoint(round, 0);
      engine.set_gaussians(gaussians);
    }
    if (!adam(round, first_step, random)) {
      // once more from the round's start, with smaller steps from here on
      ++watch.restarts;
      const std::string trouble = watch.bad_in_a_row > 0 ? "gradients are not finite" : "the loss runs away";
      if (watch.restarts > kMostRestarts)
        throw WorkError("recognize",
                        trouble + " in round " + std::to_string(round + 1) + " at step sizes down to " +
                            core::exact(step_scale(watch)) + " of the usual ones",
                        "look at the capture with 'chainsplat check'; if it is sound, report it");
      core::warn("recognize: " + trouble + " in round " + std::to_string(round + 1) +
                 "; it is repeated from its start with steps of " + core::exact(step_scale(watch)) +
                 " of the usual ones");
      watch.bad_in_a_row = 0;
      before.reset();
      --round;
      continue;
    }
    if (polish) {
      gaussians = engine.gaussians();
      checkpoint(kRounds + 1, 0);
      break;
    }
    RefineOptions refine;
    refine.iterations = kAngleIterations;
    refine.mask_weight = kAngleMaskWeight;
    const bool adding = round + 1 < kRounds;
    if (!adding) {
      refine.trusted = kTrustedStep;
      last_drawn = {};
    }
    const Draw draw = [&](std::span<const int> views, std::span<const std::vector<math::Pose>> motions) {
      return draw_training(views, motions, adding);
    };
    refine_angles(chain, capture, frames, training.frames, draw, refine, prior, states);
    pose_views();
    for (std::size_t i = 0; i < specs.size(); ++i) engine.set_motions(static_cast<int>(i), specs[i].motions);
    gaussians = engine.gaussians();
    if (adding) {
      std::vector<Drawn> drawn;
      for (std::size_t i = 0; i < last_drawn.size(); ++i)
        drawn.push_back({&capture.views[training.views[i]], &last_drawn[i].motions, &last_drawn[i].picture});
      add_and_prune(gaussians, chain, capture, drawn, budget, added_a_round, random);
      if (round + 1 == kShRound && gaussians.degree == 0) gaussians.resize(gaussians.count, gaussians.links, 1);
    } else {
      std::vector<Viewpoint> viewpoints;
      for (const splat::ViewSpec& spec : specs)
        viewpoints.push_back({spec.camera->world_from_camera.translation, spec.motions});
      const int unseen = finish_unseen(chain, viewpoints, gaussians);
      core::say_more("recognize: " + std::to_string(unseen) + " of " + std::to_string(gaussians.count) +
                     " Gaussians lie where no camera saw the rope; their colors are guessed");
    }
  }
  // every frame: start from the silhouettes plus the correction of the training frames around it
  core::report({"recognize", total_steps, total_steps, loss, psnr, "all frames"});
  chain::States correction;
  for (const int k : training.frames) {
    correction.time.push_back(states.time[k]);
    correction.theta.push_back(states.theta[k] - coarse[k]);
  }
  std::vector<int> all_frames;
  for (int k = 0; k < static_cast<int>(frames.size()); ++k) {
    if (frames[k].views.empty()) continue;
    all_frames.push_back(k);
    if (std::find(training.frames.begin(), training.frames.end(), k) == training.frames.end())
      states.theta[k] = coarse[k] + chain::interpolate(correction, states.time[k]);
  }
  result.summary = refine_all(engine, chain, capture, frames, gaussians, all_frames, kFinalIterations, prior, states);
  differentiate(states);
  result.gaussians = std::move(gaussians);
  result.states = std::move(states);
  return result;
}

}  // namespace chainsplat::recognition
