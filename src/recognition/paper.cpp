// The paper's procedure, so that it can be compared with the fast one in one table: random Gaussians with uniform link
// probabilities, all angles zero, Adam on one random view per iteration, two asynchronous resets. What the paper does
// not print is 3DGS' and ScrewSplat's: rates, a background, growth (figures.md, "The paper's own method"). SH
// degree 0.
#include <algorithm>
#include <cmath>
#include <numeric>

#include "chainsplat/image_model.h"
#include "src/recognition/checkpoint.h"
#include "src/recognition/growth.h"
#include "src/recognition/modes.h"
#include "src/recognition/step_watch.h"

namespace chainsplat::recognition {

namespace {

constexpr int kJoints = 8;
constexpr int kOpacityReset = 3000, kLastOpacityReset = 12000;  // iterations
constexpr float kResetOpacity = 0.01f;
constexpr int kLinkResets[] = {1500, 4500, 7500, 10500};
constexpr int kGrowthFrom = 500, kGrowthUntil = 15000, kGrowthEvery = 100;  // iterations
constexpr float kMeanRateFirst = 1.6e-4f, kMeanRateLast = 1.6e-6f;          // of the scene's extent
constexpr double kAngleRate = 0.01;                                         // rad

capture::PackedView padded(const capture::PackedView& packed, int x0, int y0, int width, int height) {
  const capture::View view = capture::unpacked(packed);
  capture::View out = view;
  out.x0 = x0;
  out.y0 = y0;
  out.width = width;
  out.height = height;
  out.rgba.assign(4u * width * height, 0);
  out.depth.clear();
  for (int y = 0; y < view.height; ++y)
    std::copy_n(view.rgba.begin() + 4 * static_cast<std::ptrdiff_t>(y) * view.width, 4 * view.width,
                out.rgba.begin() + 4 * (static_cast<std::ptrdiff_t>(y + view.y0 - y0) * width + view.x0 - x0));
  return capture::packed(out);
}

// Bounds of the visual hull in the base frame, over all training times: the cells of a grid around the grasp that every
// camera of one time sees inside its mask.
void hull_bounds(const capture::Capture& capture, const std::vector<FrameViews>& frames,
                 const std::vector<int>& training, math::Vector3& low, math::Vector3& high) {
  constexpr int kCells = 48;  // along the edge of a cube of twice the rope's length
  low = math::Vector3::Constant(1e9);
  high = -low;
  const double cell = 2.0 * capture.length / kCells;
  for (const int k : training) {
    std::vector<capture::View> views;
    for (const int v : frames[k].views) views.push_back(capture::unpacked(capture.views[v]));
    for (int n = 0; n < kCells * kCells * kCells; ++n) {
      const int column = n % kCells, row = n / kCells % kCells, layer = n / kCells / kCells;
      const math::Vector3 home = cell * (math::Vector3(column, row, layer).array() + 0.5 - 0.5 * kCells).matrix();
      bool inside = !views.empty();
      for (const capture::View& view : views) {
        const capture::Camera& camera = capture.cameras[view.camera];
        const math::Vector3 x = camera.world_from_camera.inverse() * (capture.base.pose(view.time) * home);
        if (x.z() <= 0) {
          inside = false;
          break;
        }
        const math::Vector2 u = capture::project(camera, x);
        // a cell counts when a mask pixel lies within its projected half size
        const int reach = std::max(1, static_cast<int>(0.5 * cell * camera.fx / x.z()));
        const int cx = static_cast<int>(u.x()) - view.x0, cy = static_cast<int>(u.y()) - view.y0;
        bool any = false;
        for (int dy = -reach; dy <= reach && !any; dy += reach) {
          for (int dx = -reach; dx <= reach && !any; dx += reach) {
            const int px = cx + dx, py = cy + dy;
            any = px >= 0 && py >= 0 && px < view.width && py < view.height &&
                  view.rgba[4 * (static_cast<std::size_t>(py) * view.width + px) + 3] >= image_model::kObjectMask;
          }
        }
        if (!any) {
          inside = false;
          break;
        }
      }
      if (!inside) continue;
      low = low.cwiseMin(home - math::Vector3::Constant(0.5 * cell));
      high = high.cwiseMax(home + math::Vector3::Constant(0.5 * cell));
    }
  }
}

double scene_extent(const capture::Capture& capture) {
  // as 3DGS: 1.1 times the largest distance of a camera from the cameras' mean
  math::Vector3 mean = math::Vector3::Zero();
  for (const auto& camera : capture.cameras)
    mean += camera.world_from_camera.translation / static_cast<double>(capture.cameras.size());
  double extent = 0.0;
  for (const auto& camera : capture.cameras)
    extent = std::max(extent, (camera.world_from_camera.translation - mean).norm());
  return 1.1 * std::max(extent, capture.length);
}

// A training view on the union of its camera's crops.
struct PaperView {
  capture::PackedView view;
  int frame = 0;
};

std::vector<PaperView> views_of(const capture::Capture& capture, const std::vector<FrameViews>& frames,
                                const std::vector<int>& training) {
  std::vector<int> x0(capture.cameras.size(), 1 << 30), y0 = x0, x1(capture.cameras.size(), 0), y1 = x1;
  for (const capture::ViewPlace& view : capture.views) {
    if (view.width == 0) continue;
    x0[view.camera] = std::min(x0[view.camera], view.x0);
    y0[view.camera] = std::min(y0[view.camera], view.y0);
    x1[view.camera] = std::max(x1[view.camera], view.x0 + view.width);
    y1[view.camera] = std::max(y1[view.camera], view.y0 + view.height);
  }
  std::vector<PaperView> views;
  for (const int k : training)
    for (const int v : frames[k].views) {
      const int c = capture.views[v].camera;
      views.push_back({padded(capture.views[v], x0[c], y0[c], x1[c] - x0[c], y1[c] - y0[c]), k});
    }
  return views;
}

// What the iterations share.
struct Job {
  const capture::Capture& capture;
  const Options& options;
  std::string text = job_text(capture, options);  // by which its checkpoints are known
  Result result = {};
  chain::States states = {};
  std::vector<FrameViews> frames = {};         // as assigned to states.time
  std::vector<int> training = {};              // frames
  std::vector<PaperView> views = {};           // of these
  std::vector<solve::AdamState> moments = {};  // of each frame's angles; steps: its visits
  StepWatch watch = {};
  Pull pull = {};  // since the Gaussians were changed
  int first = 0;   // iteration
};

std::vector<math::Pose> motions_of(const Job& job, const PaperView& view) {
  return chain::link_motions(job.result.chain, job.states.theta[view.frame], job.capture.base.pose(view.view.time));
}

// All angles zero at the times of the first camera's frames.
void begin(Job& job) {
  const chain::Bending bending = job.options.bending.value_or(chain::Bending::planar);
  job.result.bending.bending = bending;
  job.result.chain = chain_of(job.capture, job.options, bending, job.options.joints.value_or(kJoints));
  const math::VectorX straight = math::VectorX::Zero(job.result.chain.angles());
  for (const capture::ViewPlace& view : job.capture.views)
    if (view.camera == 0) job.states.time.push_back(view.time);
  job.states.theta.assign(job.states.time.size(), straight);
  job.frames = assign_views(job.capture, job.states.time);
  for (int k = 0; k < static_cast<int>(job.frames.size()); k += std::max(1, job.options.every))
    if (!job.frames[k].views.empty()) job.training.push_back(k);
  if (job.training.empty())
    throw WorkError(job.capture.name, "no training frame shows the object", "use `every` 1 or check the masks");
  job.views = views_of(job.capture, job.frames, job.training);
  job.moments.resize(job.frames.size());
  for (solve::AdamState& m : job.moments) m.first = m.second = straight;
}

void resume(Job& job, Checkpoint before, splat::Engine& engine) {
  job.states = std::move(before.states);
  job.first = before.stage;
  job.watch = before.watch;
  engine.restore(before.snapshot);
  const double* from = before.extra.data();
  const Eigen::Index n = job.result.chain.angles();
  for (solve::AdamState& m : job.moments) {
    m.first = Eigen::Map<const math::VectorX>(from, n);
    m.second = Eigen::Map<const math::VectorX>(from + n, n);
    m.steps = static_cast<int>(from[2 * n]);
    from += 2 * n + 1;
  }
  const auto count = static_cast<std::size_t>(before.extra.data() + before.extra.size() - from) / 2;
  job.pull.sum.assign(from, from + count);
  job.pull.steps.assign(from + count, from + 2 * count);
}

void save(const Job& job, splat::Engine& engine, int iteration) {
  if (job.options.checkpoint.empty()) return;
  Checkpoint c;
  c.job = job.text;
  c.stage = iteration;
  c.spatial = job.result.bending.bending == chain::Bending::spatial;
  c.watch = job.watch;
  c.states = job.states;
  c.snapshot = engine.snapshot();
  for (const solve::AdamState& m : job.moments) {
    c.extra.insert(c.extra.end(), m.first.data(), m.first.data() + m.first.size());
    c.extra.insert(c.extra.end(), m.second.data(), m.second.data() + m.second.size());
    c.extra.push_back(m.steps);
  }
  c.extra.insert(c.extra.end(), job.pull.sum.begin(), job.pull.sum.end());
  c.extra.insert(c.extra.end(), job.pull.steps.begin(), job.pull.steps.end());
  save_checkpoint(c, job.options.checkpoint);
}

// Gaussians anywhere in the bounds of the visual hull.
splat::Gaussians random_gaussians(const Job& job) {
  core::Random random(job.options.seed * 1000003 + 7);
  math::Vector3 low, high;
  hull_bounds(job.capture, job.frames, job.training, low, high);
  if ((high - low).minCoeff() <= 0)
    throw WorkError(job.capture.name, "the cameras' masks have no common volume",
                    "check the calibration with 'chainsplat check'");
  splat::Gaussians g;
  g.resize(job.options.paper.gaussians, job.result.chain.links(), 0);
  const double spacing = std::cbrt((high - low).prod() / job.options.paper.gaussians);
  constexpr float kStartOpacityLogit = -2.1972246f;  // opacity 0.1
  for (int i = 0; i < g.count; ++i) {
    for (int c = 0; c < 3; ++c) {
      g.mean[3 * i + c] = static_cast<float>(random.uniform(low[c], high[c]));
      g.log_scale[3 * i + c] = static_cast<float>(std::log(spacing));
      g.sh[3 * i + c] = static_cast<float>(random.normal() / 255.0 / image_model::kSh0);
    }
    g.opacity_logit[i] = kStartOpacityLogit;
  }
  return g;
}

// One random view without repetition until all were used; a function of the iteration alone, so that a resumed run
// draws the same ones. `order` is kept between iterations.
std::size_t draw_view(const Job& job, int iteration, std::vector<int>& order) {
  const std::size_t count = job.views.size(), place = static_cast<std::size_t>(iteration) % count;
  if (place == 0 || order.empty()) {
    core::Random random(job.options.seed * 1000003 + 17 + static_cast<std::uint64_t>(iteration) / count * 7919);
    order.resize(count);
    std::iota(order.begin(), order.end(), 0);
    shuffle(order, random);
  }
  return static_cast<std::size_t>(order[place]);
}

splat::AdamRates rates_of_paper(double extent, double fraction) {
  splat::AdamRates rates;
  rates.mean = static_cast<float>(extent * kMeanRateFirst * std::pow(kMeanRateLast / kMeanRateFirst, fraction));
  rates.rotation = 1e-3f;
  rates.log_scale = 5e-3f;
  rates.opacity = 0.025f;
  rates.sh0 = 2.5e-3f;
  rates.link_logits = 0.1f;
  return rates;
}

// Over black a Gaussian that is black costs nothing wherever it is, over white a white one; over a gray that changes
// none is free. As draw_view(), a function of the iteration.
float background_of(const Job& job, int iteration) {
  if (job.options.paper.background != Background::random)
    return job.options.paper.background == Background::white ? 1.0f : 0.0f;
  core::Random random(job.options.seed * 1000003 + 23 + static_cast<std::uint64_t>(iteration) * 7919);
  return static_cast<float>(random.uniform(0.0, 1.0));
}

// One step of Adam on the Gaussians and on the angles of one view's frame.
void train_on(Job& job, splat::Engine& engine, std::size_t v, int iteration, const splat::AdamRates& rates) {
  constexpr int kReadEvery = 50;
  const splat::LossWeights weights{0.8f, 0.2f, 0.0f, background_of(job, iteration)};
  const PaperView& view = job.views[v];
  const bool read = iteration % kReadEvery == 0;
  engine.set_motions(static_cast<int>(v), motions_of(job, view));
  const int batch[] = {static_cast<int>(v)};
  std::vector<math::MatrixX> twists;
  const splat::LossValues values = engine.step(batch, weights, rates, read, &twists);
  // no restart with smaller steps: the paper's rates are what this mode is for
  if (watch_gradients(job.watch, values.not_finite, iteration + 1) == Course::diverged ||
      (read && !std::isfinite(values.total)))
    throw WorkError("recognize", "losses or gradients are not finite at iteration " + std::to_string(iteration + 1),
                    "try `mode` fast or another `seed`");
  if (read)
    core::report(
        {"recognize", iteration, job.options.paper.iterations, values.total, values.psnr_object[0], "paper mode"});
  const chain::Chain& chain = job.result.chain;
  math::VectorX& theta = job.states.theta[view.frame];
  const math::VectorX gradient =
      chain::theta_gradient(chain, chain::world_axes(chain, theta, job.capture.base.pose(view.view.time)), twists[0]);
  if (gradient.allFinite()) solve::adam_step(job.moments[view.frame], gradient, {.rate = kAngleRate}, theta);
}

// Pixels of one meter at the grasp, seen by this view.
double pixels_per_meter(const Job& job, const PaperView& view) {
  const capture::Camera& camera = job.capture.cameras[view.view.camera];
  const math::Vector3 grasp = job.capture.base.pose(view.view.time).translation;
  return camera.fx / (camera.world_from_camera.inverse() * grasp).z();
}

// The engine's loss is a mean over the object's pixels; 3DGS' threshold is for one over the whole image.
double of_whole_image(const Job& job) {
  double object = 0.0, whole = 0.0;
  for (const PaperView& view : job.views) {
    const capture::View pixels = capture::unpacked(view.view);
    for (std::size_t i = 3; i < pixels.rgba.size(); i += 4) object += pixels.rgba[i] >= image_model::kObjectMask;
    const capture::Camera& camera = job.capture.cameras[view.view.camera];
    whole += static_cast<double>(camera.width) * camera.height;
  }
  return object / whole;
}

void change_gaussians(Job& job, splat::Engine& engine, int done, double extent) {
  constexpr int kMost = 4000;  // from where on none is added: a step takes as long as there are Gaussians
  GrowthLimits limits;
  limits.extent = extent;
  limits.pixels_per_meter = pixels_per_meter(job, job.views.front());
  limits.prune_large = done > kOpacityReset;
  limits.most = kMost;
  core::Random random(job.options.seed * 1000003 + 29 + static_cast<std::uint64_t>(done) * 7919);
  const Grown grown = grow(engine.gaussians(), job.pull, limits, random);
  job.pull = {};
  if (grown.kept.empty() && grown.added.count == 0)
    throw WorkError("recognize", "no Gaussian is left at iteration " + std::to_string(done),
                    "try `mode` fast or another `seed`");
  engine.change_gaussians(grown.kept, grown.added);
}

// The frames between: interpolated, then refined with the Gaussians held.
void refine_others(Job& job, splat::Engine& engine) {
  constexpr int kIterations = 8;  // Gauss-Newton steps from the interpolated angles
  core::report({"recognize", job.options.paper.iterations, job.options.paper.iterations, NAN, NAN, "all frames"});
  chain::States trained;
  for (const int k : job.training) {
    trained.time.push_back(job.states.time[k]);
    trained.theta.push_back(job.states.theta[k]);
  }
  std::vector<int> others;
  for (int k = 0; k < static_cast<int>(job.frames.size()); ++k) {
    if (std::find(job.training.begin(), job.training.end(), k) != job.training.end()) continue;
    job.states.theta[k] = chain::interpolate(trained, job.states.time[k]);
    if (!job.frames[k].views.empty()) others.push_back(k);
  }
  job.result.summary = refine_all(engine, job.result.chain, job.capture, job.frames, job.result.gaussians, others,
                                  kIterations, {}, job.states);
  job.states.covariance.clear();  // nothing says how sure the training frames are
  differentiate(job.states);
}

}  // namespace

Result recognize_paper(gpu::Device& device, const capture::Capture& capture, const Options& options) {
  constexpr int kCheckpointEvery = 1000;
  Job job{capture, options};
  begin(job);
  std::vector<splat::ViewSpec> specs;
  std::vector<const capture::PackedView*> targets;
  for (const PaperView& view : job.views) {
    specs.push_back(view_spec(capture, view.view, motions_of(job, view)));
    targets.push_back(&view.view);
  }
  splat::Engine engine(device);
  engine.set_views(specs, targets, true);
  std::optional<Checkpoint> before;
  if (options.resume && !options.checkpoint.empty()) before = load_checkpoint(options.checkpoint, job.text);
  if (before)
    resume(job, std::move(*before), engine);
  else
    engine.set_gaussians(random_gaussians(job));

  const double extent = scene_extent(capture), loss_scale = of_whole_image(job);
  std::vector<int> order;
  for (int iteration = job.first; iteration < options.paper.iterations; ++iteration) {
    if (const int signal = core::stop_requested()) {
      save(job, engine, iteration);
      throw Interrupted(signal);
    }
    const double fraction = static_cast<double>(iteration) / options.paper.iterations;
    const std::size_t v = draw_view(job, iteration, order);
    train_on(job, engine, v, iteration, rates_of_paper(extent, fraction));
    const int done = iteration + 1;
    if (options.paper.growth && done < kGrowthUntil) {
      const double width = job.capture.cameras[job.views[v].view.camera].width;
      add_step(engine.gradient(), loss_scale, pixels_per_meter(job, job.views[v]) / (0.5 * width), job.pull);
      if (done % kGrowthEvery == 0 && done > kGrowthFrom) change_gaussians(job, engine, done, extent);
    }
    const bool resets_links = std::find(std::begin(kLinkResets), std::end(kLinkResets), done) != std::end(kLinkResets);
    if (options.paper.opacity_resets && done % kOpacityReset == 0 && done <= kLastOpacityReset)
      engine.reset_opacity(kResetOpacity);
    if (options.paper.link_resets && resets_links) engine.reset_links();
    if (done % kCheckpointEvery == 0) save(job, engine, done);
  }
  job.result.gaussians = engine.gaussians();
  refine_others(job, engine);
  job.result.states = std::move(job.states);
  return std::move(job.result);
}

}  // namespace chainsplat::recognition
