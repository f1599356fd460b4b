// The paper's procedure, so that it can be compared with the fast one in one table: random Gaussians with uniform link
// probabilities, all angles zero, Adam on one random view an iteration, two asynchronous resets. What the paper does
// not print is 3DGS' and ScrewSplat's (design.md, 'Recognition', `--mode paper`). SH degree 0.
#include <algorithm>
#include <cmath>
#include <numeric>

#include "chainsplat/image_model.h"
#include "src/recognition/checkpoint.h"
#include "src/recognition/modes.h"
#include "src/recognition/step_watch.h"

namespace chainsplat::recognition {

namespace {

constexpr int kJoints = 8;
constexpr int kOpacityReset = 3000, kLastOpacityReset = 12000;  // iterations
constexpr float kResetOpacity = 0.01f;
constexpr int kLinkResets[] = {1500, 4500, 7500, 10500};
constexpr float kMeanRateFirst = 1.6e-4f, kMeanRateLast = 1.6e-6f;  // of the scene's extent
constexpr double kAngleRate = 0.01;                                 // rad

capture::View padded(const capture::View& view, int x0, int y0, int width, int height) {
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
  return out;
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
    for (int n = 0; n < kCells * kCells * kCells; ++n) {
      const int column = n % kCells, row = n / kCells % kCells, layer = n / kCells / kCells;
      const math::Vector3 home = cell * (math::Vector3(column, row, layer).array() + 0.5 - 0.5 * kCells).matrix();
      bool inside = !frames[k].views.empty();
      for (const int v : frames[k].views) {
        const capture::View& view = capture.views[v];
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

}  // namespace

Result recognize_paper(gpu::Device& device, const capture::Capture& capture, const Options& options) {
  Result result;
  const std::string job = job_text(capture, options);
  result.bending.bending = options.bending.value_or(chain::Bending::planar);
  result.chain = chain::make_chain(capture.length, capture.diameter, capture.direction, capture.bending_axis,
                                   options.joints.value_or(kJoints), result.bending.bending, options.twist);
  const chain::Chain& chain = result.chain;
  chain::States states;
  std::vector<double> times;
  for (const capture::View& view : capture.views)
    if (view.camera == 0) times.push_back(view.time);
  states.time = times;
  states.theta.assign(times.size(), math::VectorX::Zero(chain.angles()));
  const std::vector<FrameViews> frames = assign_views(capture, times);
  std::vector<int> training;
  for (int k = 0; k < static_cast<int>(frames.size()); k += std::max(1, options.every))
    if (!frames[k].views.empty()) training.push_back(k);
  if (training.empty())
    throw WorkError(capture.name, "no training frame shows the object", "use `every` 1 or check the masks");

  // views on the union of their camera's crops
  std::vector<int> x0(capture.cameras.size(), 1 << 30), y0 = x0, x1(capture.cameras.size(), 0), y1 = x1;
  for (const capture::View& view : capture.views) {
    if (view.width == 0) continue;
    x0[view.camera] = std::min(x0[view.camera], view.x0);
    y0[view.camera] = std::min(y0[view.camera], view.y0);
    x1[view.camera] = std::max(x1[view.camera], view.x0 + view.width);
    y1[view.camera] = std::max(y1[view.camera], view.y0 + view.height);
  }
  std::vector<capture::View> views;
  std::vector<int> frame_of;
  for (const int k : training) {
    for (const int v : frames[k].views) {
      const int c = capture.views[v].camera;
      views.push_back(padded(capture.views[v], x0[c], y0[c], x1[c] - x0[c], y1[c] - y0[c]));
      frame_of.push_back(k);
    }
  }
  const auto motions_of = [&](std::size_t i) {
    return chain::link_motions(chain, states.theta[frame_of[i]], capture.base.pose(views[i].time));
  };
  std::vector<splat::ViewSpec> specs;
  std::vector<const std::vector<std::uint8_t>*> targets;
  for (std::size_t i = 0; i < views.size(); ++i) {
    specs.push_back(view_spec(capture, views[i], motions_of(i)));
    targets.push_back(&views[i].rgba);
  }
  splat::Engine engine(device);
  engine.set_views(specs, targets, true);

  std::vector<solve::AdamState> moments(frames.size());  // of each time step's angles; steps: its visits
  for (auto& m : moments) m.first = m.second = math::VectorX::Zero(chain.angles());
  core::Random random(options.seed * 1000003 + 7);
  int first = 0;
  StepWatch watch;
  std::optional<Checkpoint> before;
  if (options.resume && !options.checkpoint.empty()) before = load_checkpoint(options.checkpoint, job);
  if (before) {
    states = before->states;
    first = before->stage;
    watch = before->watch;
    engine.restore(before->snapshot);
    const double* from = before->extra.data();
    for (auto& m : moments) {
      m.first = Eigen::Map<const math::VectorX>(from, chain.angles());
      m.second = Eigen::Map<const math::VectorX>(from + chain.angles(), chain.angles());
      m.steps = static_cast<int>(from[2 * chain.angles()]);
      from += 2 * chain.angles() + 1;
    }
  } else {
    math::Vector3 low, high;
    hull_bounds(capture, frames, training, low, high);
    if ((high - low).minCoeff() <= 0)
      throw WorkError(capture.name, "the cameras' masks have no common volume",
                      "check the calibration with 'chainsplat check'");
    splat::Gaussians g;
    g.resize(options.paper_gaussians, chain.links(), 0);
    const double spacing = std::cbrt((high - low).prod() / options.paper_gaussians);
    constexpr float kStartOpacityLogit = -2.1972246f;  // opacity 0.1
    for (int i = 0; i < g.count; ++i) {
      for (int c = 0; c < 3; ++c) {
        g.mean[3 * i + c] = static_cast<float>(random.uniform(low[c], high[c]));
        g.log_scale[3 * i + c] = static_cast<float>(std::log(spacing));
        g.sh[3 * i + c] = static_cast<float>(random.normal() / 255.0 / image_model::kSh0);
      }
      g.opacity_logit[i] = kStartOpacityLogit;
    }
    engine.set_gaussians(g);
  }

  const double extent = scene_extent(capture);
  const splat::LossWeights weights{0.8f, 0.2f, 0.0f};
  const auto checkpoint = [&](int iteration) {
    if (options.checkpoint.empty()) return;
    Checkpoint c;
    c.job = job;
    c.stage = iteration;
    c.spatial = result.bending.bending == chain::Bending::spatial;
    c.watch = watch;
    c.states = states;
    c.snapshot = engine.snapshot();
    for (const auto& m : moments) {
      c.extra.insert(c.extra.end(), m.first.data(), m.first.data() + m.first.size());
      c.extra.insert(c.extra.end(), m.second.data(), m.second.data() + m.second.size());
      c.extra.push_back(m.steps);
    }
    save_checkpoint(c, options.checkpoint);
  };
  std::vector<int> order;
  for (int iteration = first; iteration < options.paper_iterations; ++iteration) {
    if (const int signal = core::stop_requested()) {
      checkpoint(iteration);
      throw Interrupted(signal);
    }
    // one random view without repetition until all were used; a function of the iteration alone, so that a resumed run
    // draws the same ones
    const std::size_t count = views.size(), place = static_cast<std::size_t>(iteration) % count;
    if (place == 0 || order.empty()) {
      core::Random random_order(options.seed * 1000003 + 17 + static_cast<std::uint64_t>(iteration) / count * 7919);
      order.resize(count);
      std::iota(order.begin(), order.end(), 0);
      shuffle(order, random_order);
    }
    const auto v = static_cast<std::size_t>(order[place]);
    const double fraction = static_cast<double>(iteration) / options.paper_iterations;
    splat::AdamRates rates;
    rates.mean = static_cast<float>(extent * kMeanRateFirst * std::pow(kMeanRateLast / kMeanRateFirst, fraction));
    rates.rotation = 1e-3f;
    rates.log_scale = 5e-3f;
    rates.opacity = 0.025f;
    rates.sh0 = 2.5e-3f;
    rates.link_logits = 0.1f;
    constexpr int kReadEvery = 50;
    const bool read = iteration % kReadEvery == 0;
    engine.set_motions(static_cast<int>(v), motions_of(v));
    const int batch[] = {static_cast<int>(v)};
    std::vector<math::MatrixX> twists;
    const splat::LossValues values = engine.step(batch, weights, rates, read, &twists);
    // no restart with smaller steps: the paper's rates are what this mode is for
    if (watch_gradients(watch, values.not_finite, iteration + 1) == Course::diverged ||
        (read && !std::isfinite(values.total)))
      throw WorkError("recognize", "losses or gradients are not finite at iteration " + std::to_string(iteration + 1),
                      "try `mode` fast or another `seed`");
    if (read)
      core::report(
          {"recognize", iteration, options.paper_iterations, values.total, values.psnr_object[0], "paper mode"});
    // Adam on this time step's angles
    const int k = frame_of[v];
    const math::VectorX gradient = chain::theta_gradient(
        chain, chain::world_axes(chain, states.theta[k], capture.base.pose(views[v].time)), twists[0]);
    if (gradient.allFinite()) solve::adam_step(moments[k], gradient, {.rate = kAngleRate}, states.theta[k]);
    const int done = iteration + 1;
    if (done % kOpacityReset == 0 && done <= kLastOpacityReset) engine.reset_opacity(kResetOpacity);
    if (std::find(std::begin(kLinkResets), std::end(kLinkResets), done) != std::end(kLinkResets)) engine.reset_links();
    constexpr int kCheckpointEvery = 1000;
    if (done % kCheckpointEvery == 0) checkpoint(done);
  }
  result.gaussians = engine.gaussians();

  // the frames between: interpolated, then refined with the Gaussians held
  core::report({"recognize", options.paper_iterations, options.paper_iterations, NAN, NAN, "all frames"});
  chain::States trained;
  for (const int k : training) {
    trained.time.push_back(states.time[k]);
    trained.theta.push_back(states.theta[k]);
  }
  std::vector<int> others;
  for (int k = 0; k < static_cast<int>(frames.size()); ++k) {
    if (std::find(training.begin(), training.end(), k) != training.end()) continue;
    states.theta[k] = chain::interpolate(trained, states.time[k]);
    if (!frames[k].views.empty()) others.push_back(k);
  }
  constexpr int kIterations = 8;  // Gauss-Newton steps from the interpolated angles
  result.summary = refine_all(engine, chain, capture, frames, result.gaussians, others, kIterations, {}, states);
  states.covariance.clear();  // nothing says how sure the training frames are
  differentiate(states);
  result.states = std::move(states);
  return result;
}

}  // namespace chainsplat::recognition
