// chainsplat/splat.h - link-aware 3-D Gaussians on the device: replicate, project, bin, sort, blend, loss, backward,
// Adam (SPEC 2.4-2.8; paper, "Link-aware Gaussian splatting").
//
// The unit of work is a batch of views (crops of different sizes, each with its camera and the link poses of its time)
// in one submission. Float on the device, no atomics on floats: the same input gives the same bits on one device.
#pragma once
#include <cstdint>
#include <memory>
#include <span>
#include <vector>
#include "chainsplat/capture.h"
#include "chainsplat/chain.h"
#include "chainsplat/gpu.h"

namespace chainsplat::splat {

// Gaussians in the home configuration (base frame). Arrays of structures-of-rows, row i is Gaussian i.
struct Gaussians {
  int count = 0;
  int links = 0;                     // n_l + 1
  int degree = 0;                    // of the spherical harmonics, 0..3
  std::vector<float> mean;           // count x 3, m
  std::vector<float> rotation;       // count x 4, quaternion wxyz (normalized before use)
  std::vector<float> log_scale;      // count x 3, ln m
  std::vector<float> opacity_logit;  // count
  std::vector<float> sh;             // count x (degree+1)^2 x 3: coefficient-major, RGB inside
  std::vector<float> link_logits;    // count x links
  int sh_coefficients() const { return (degree + 1) * (degree + 1); }
  void resize(int count, int links, int degree);  // keeps rows that exist; new rows are zero (rotation 1,0,0,0)
};

// One picture to draw: pinhole camera, crop [x0, x0+width) x [y0, y0+height) of its image, and the link motions E_j.
struct ViewSpec {
  const capture::Camera* camera = nullptr;  // distortion is ignored here (images are undistorted)
  int x0 = 0, y0 = 0, width = 0, height = 0;
  std::vector<math::Pose> motions;  // links()
};

// Row-major pictures of one view. Color is premultiplied over a black background.
struct Picture {
  int width = 0, height = 0;
  std::vector<float> rgba;   // 4 x pixels: red, green, blue in [0, ..), alpha = 1 - T_end
  std::vector<float> depth;  // sum z alpha T / alpha where alpha > 0.5, else 0; m; empty unless asked for
};

// Gradients of one loss (summed over views) and per view, as SPEC 2.8.
struct Gradients {
  Gaussians gaussians;                     // same layout; rotation holds d/dq of the unnormalized quaternion
  std::vector<math::MatrixX> link_twists;  // one 6 x links a view: world twist about the world origin
};

struct LossWeights {
  float l1 = 0.8f;     // weight of mean |I^ - I|
  float dssim = 0.2f;  // weight of 1 - mean SSIM
  float mask = 0.0f;   // weight of mean |alpha - mask|
};

struct LossValues {
  double total = 0.0;
  std::vector<double> l1, ssim, mask;  // one a view: means over the view's `normalizer` pixels
  std::vector<double> psnr_object;     // dB over pixels with mask >= 128
  int not_finite = 0;                  // step() only: parameters left alone because their gradient was NaN or infinite
};

// The normal equations of the colors inside a view's mask, for second-order refinement (SPEC 6): of the residual
// r = gain * drawn + bias - seen, colors 0..1, over the channels of the pixels away from the mask's and the drawn
// rope's edge, with Huber's weights w. A pixel that shows the surface point x moves with the link whose axis is nearest
// to x: dr/d(twist) = -grad . d(pixel)/d(twist), grad the mean of the slopes of gain * drawn and of seen (Malis' ESM).
struct ColorSums {
  using Vector8 = Eigen::Matrix<double, 8, 1>;  // world twist about the world origin (SPEC 2.3), gain, bias
  using Matrix8 = Eigen::Matrix<double, 8, 8>;
  std::vector<Matrix8> normal;        // one a link: sum of w J^T J
  std::vector<Vector8> right;         // one a link: sum of w J^T r
  double weight = 0.0, square = 0.0;  // sums of w and of w r^2
  double gain = 1.0, bias = 0.0;      // at which all that was formed: one robust step from 1 and 0
  int pixels = 0;                     // that count; sums over them of the colors, each channel about its mean:
  double covariance = 0.0, drawn_variance = 0.0, seen_variance = 0.0;
};

struct Settings {
  int tile = 0;                  // px, 8 or 16; 0: chosen for the device
  int pixels_per_lane = 0;       // 0: chosen for the device
  bool projection_clamp = true;  // of SPEC 2.5; false where a reference has none
  bool exact_cutoffs = true;     // 1/255 cut, 0.99 cap, 1e-4 stop; false: none of them (for finite-difference tests)
};

struct AdamRates {  // step sizes, units of the parameter (mean: m)
  float mean = 0, rotation = 0, log_scale = 0, opacity = 0, sh0 = 0, sh_rest = 0, link_logits = 0;
};

// Renderer, trainer and their device buffers for one set of views at a time.
class Engine {
 public:
  Engine(gpu::Device& device, const Settings& settings = {});
  ~Engine();
  Engine(Engine&&) noexcept;

  // --- drawing -----------------------------------------------------------------------------------------------------
  std::vector<Picture> draw(const Gaussians& gaussians, std::span<const ViewSpec> views, bool depth = false);

  // --- loss and gradients of some views (tests, paper mode, refinement) ----------------------------------------------
  // targets[v]: RGBA8 of the crop, A = mask. `normalizer` is the number of pixels that means are taken over (the full
  // image's for SPEC 2.7; 0: the crop's).
  LossValues loss(const Gaussians& gaussians, std::span<const ViewSpec> views,
                  std::span<const std::vector<std::uint8_t>* const> targets, const LossWeights& weights,
                  double normalizer, Gradients* gradients, std::vector<Picture>* pictures = nullptr);

  // --- training: parameters, moments and targets stay on the device
  // ---------------------------------------------------- Targets of all views that will be used; `views` keep their
  // indices. Poses can be changed later. Only tiles near the mask are drawn and charged; with `everywhere` the whole
  // crop is (D-SSIM still near the mask only: elsewhere L1 says enough).
  void set_views(std::span<const ViewSpec> views, std::span<const std::vector<std::uint8_t>* const> targets,
                 bool everywhere = false);
  void set_motions(int view, const std::vector<math::Pose>& motions);
  void set_gaussians(const Gaussians& gaussians);  // resets Adam's moments and step count
  Gaussians gaussians() const;
  // One Adam step on the mean loss of the views in `batch`.
  // `twists`: also the gradient of the mean loss with respect to each view's link motions (world twists, SPEC 2.3).
  LossValues step(std::span<const int> batch, const LossWeights& weights, const AdamRates& rates, bool read_losses,
                  std::vector<math::MatrixX>* twists = nullptr);
  std::vector<Picture> draw_views(std::span<const int> batch, bool depth = false);

  // --- colors as a measurement: the Gaussians of set_gaussians() stay on the device, a call uploads motions and crops
  // in one submission and reads back sums, no picture. `seen`: RGBA8 of the crops, A = mask. `chain` has the Gaussians'
  // links. Takes the place of set_views().
  std::vector<ColorSums> color_sums(const chain::Chain& chain, std::span<const ViewSpec> views,
                                    std::span<const std::vector<std::uint8_t>* const> seen);

  // The paper's resets: opacity to at most `largest`, link probabilities to uniform; Adam's moments of that section to
  // zero.
  void reset_opacity(float largest);
  void reset_links();
  // Everything that a later step depends on, for checkpoints.
  struct Snapshot {
    Gaussians gaussians;
    std::vector<float> first_moment, second_moment;  // in the order of the device's parameter buffer
    int step = 0;
  };
  Snapshot snapshot() const;
  void restore(const Snapshot& snapshot);

  std::vector<gpu::Timing> timings() const;  // of the last call, by pass
  struct State;

 private:
  std::unique_ptr<State> state_;
};

// Spherical harmonics color of SPEC 2.4 for one direction (unit, home frame): used by export and tests.
math::Vector3 sh_color(const Gaussians& gaussians, int index, const math::Vector3& direction);

}  // namespace chainsplat::splat
