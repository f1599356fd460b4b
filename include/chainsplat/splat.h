// chainsplat/splat.h - link-aware 3-D Gaussians on the device: replicate, project, bin, sort, blend, loss, backward,
// Adam (mathematics.md 2.4-2.8; paper, "Link-aware Gaussian splatting").
//
// Recognition trains the Gaussians here, rendering draws them, and state estimation measures against their colors. The
// unit of work is a batch of views in one submission: crops of different sizes, each with its camera and the link poses
// of its time. The device computes in float without float atomics, so on one device equal input gives equal bits.
// Lengths are meters, image lengths pixels; cameras have OpenCV axes, and the center of pixel (0, 0) is (0.5, 0.5).
#pragma once
#include <cstdint>
#include <memory>
#include <span>
#include <vector>
#include "chainsplat/capture.h"
#include "chainsplat/chain.h"
#include "chainsplat/gpu.h"

namespace chainsplat::splat {

// How bright the light around a rope makes each of its sides. A rope that rolls carries its texture along, and not the
// light on it: what is drawn of a Gaussian is its color times the brightness of the side that it is on, which is
// constant + linear . n + n^T quadratic n for the direction n from the rope's axis to the Gaussian in the world. A dull
// convex body in any light has little more than that (mathematics.md 2.4). It is 1 on the brightest side that was seen.
struct Light {
  math::Vector3 axis = math::Vector3::Zero();  // of the rope at home, unit; zero: every side has the brightness 1
  double constant = 1.0;
  math::Vector3 linear = math::Vector3::Zero();     // world axes, as is
  math::Matrix3 quadratic = math::Matrix3::Zero();  // symmetric
  bool known() const { return !axis.isZero(0.0); }
};
// At a unit normal in world axes; at least kLeastBrightness of image_model.h.
double brightness(const Light& light, const math::Vector3& normal);

// Gaussians in the home configuration (all angles 0), base frame. Row i of every array belongs to Gaussian i.
struct Gaussians {
  int count = 0;
  int links = 0;                     // n_l + 1, with the base link
  int degree = 0;                    // of the spherical harmonics (SH), 0..3
  std::vector<float> mean;           // count x 3, m
  std::vector<float> rotation;       // count x 4, quaternion wxyz (normalized before use)
  std::vector<float> log_scale;      // count x 3, ln m
  std::vector<float> opacity_logit;  // count
  std::vector<float> sh;             // count x (degree+1)^2 x 3: RGB of one coefficient after the other
  std::vector<float> link_logits;    // count x links
  // count; 1: no camera saw it, or hardly any picture, its place and color are guessed. What trained or drew them does
  // not give it back.
  std::vector<std::uint8_t> guessed;
  Light light;
  // What a pixel of the nearest pictures that these were fitted to covered of the rope, m: the splats' low pass is that
  // wide on the rope, from wherever it is drawn. 0: not known, and it is as wide as a pixel is, so that a rope becomes
  // thinner as a camera comes nearer (mathematics.md 2.5).
  double pixel_footprint = 0.0;
  int sh_coefficients() const { return (degree + 1) * (degree + 1); }
  void resize(int count, int links, int degree);  // keeps existing rows; new ones are zero, with rotation (1, 0, 0, 0)
};

// Makes Gaussian k of `to` Gaussian i of `from`; both have the same links and degree.
void copy_row(const Gaussians& from, int i, Gaussians& to, int k);
// These Gaussians, in this order, and `more` new ones after them, as Gaussians::resize() makes them.
Gaussians rows_of(const Gaussians& gaussians, std::span<const int> rows, int more);

// One picture to draw: a pinhole camera, the crop [x0, x0+width) x [y0, y0+height) of its image, and the link motions.
struct ViewSpec {
  const capture::Camera* camera = nullptr;  // its distortion is ignored: crops are of undistorted images
  int x0 = 0, y0 = 0, width = 0, height = 0;
  std::vector<math::Pose> motions;  // E_j of every link, base link first (mathematics.md 2.2)
};

// Color from which on a camera records nothing brighter: 1 where its gain and bias were found. Of another camera
// nothing is known of them, and the Gaussians' colors, which nothing bounds above, take up what it does.
double recorded_white(const capture::Camera& camera);

// Row-major picture of one view. Colors are premultiplied by alpha, over a black background.
struct Picture {
  int width = 0, height = 0;
  std::vector<float> rgba;   // 4 x pixels: red, green, blue (not clamped above), alpha = 1 - T_end
  std::vector<float> depth;  // m, alpha-weighted mean z where alpha > 0.5, else 0; empty unless asked for
};

// Gradients of one loss: by the Gaussians summed over the views, by the link motions per view (mathematics.md 2.8).
struct Gradients {
  Gaussians gaussians;                     // same layout; rotation holds d/dq of the unnormalized quaternion
  std::vector<math::MatrixX> link_twists;  // 6 x links per view: moment, force; world axes, about the world origin
};

struct LossWeights {
  float l1 = 0.8f;          // weight of mean |I^ - I|
  float dssim = 0.2f;       // weight of 1 - mean SSIM
  float mask = 0.0f;        // weight of mean |alpha - mask|
  float background = 0.0f;  // gray, 0..1, that drawn and wanted colors are laid over; `psnr_object` is over black
};

struct LossValues {
  double total = 0.0;
  std::vector<double> l1, ssim, mask;  // one entry per view: means over `normalizer` pixels
  std::vector<double> psnr_object;     // dB, one entry per view: over the pixels with mask >= 128
  int not_finite = 0;                  // step() only: parameters not updated because their gradient is NaN or infinite
};

// The normal equations of the colors inside a view's mask, for second-order refinement (mathematics.md 6). The residual
// is r = gain * drawn + bias - observed, colors 0..1, over the channels of the pixels that lie away from the edges of
// the mask and of the drawn rope; w are Huber's weights. A pixel that shows the surface point x moves with the link
// whose axis is nearest to x: dr/d(twist) = -grad . d(pixel)/d(twist), where grad is the mean of the gradients of
// gain * drawn and of the observed image (efficient second-order minimization, ESM, of Malis).
struct ColorSums {
  using Vector8 = Eigen::Matrix<double, 8, 1>;  // world twist about the world origin (mathematics.md 2.3), gain, bias
  using Matrix8 = Eigen::Matrix<double, 8, 8>;
  std::vector<Matrix8> normal;        // per link: sum of w J^T J
  std::vector<Vector8> right;         // per link: sum of w J^T r
  double weight = 0.0, square = 0.0;  // sums of w and of w r^2
  double gain = 1.0, bias = 0.0;      // at which all sums were formed: one robust step from gain 1 and bias 0
  int pixels = 0;                     // that count; and their second central moments, summed over pixels and channels:
  double covariance = 0.0, drawn_variance = 0.0, seen_variance = 0.0;
};

struct Settings {
  int tile = 0;                  // px, 8 or 16; 0: chosen for the device
  int pixels_per_lane = 0;       // of the blending passes; 0: chosen for the device
  bool projection_clamp = true;  // of mathematics.md 2.5; false for comparison with a reference that has none
  bool exact_cutoffs = true;     // 1/255 cut, 0.99 cap, 1e-4 stop; false: none of them (for finite-difference tests)
};

struct AdamRates {  // step sizes in the units of their parameters (mean: m)
  float mean = 0, rotation = 0, log_scale = 0, opacity = 0, sh0 = 0, sh_rest = 0, link_logits = 0;
};

// Renderer and trainer with their device buffers, for one set of views at a time.
class Engine {
 public:
  Engine(gpu::Device& device, const Settings& settings = {});
  ~Engine();
  Engine(Engine&&) noexcept;

  // --- drawing -----------------------------------------------------------------------------------------------------
  std::vector<Picture> draw(const Gaussians& gaussians, std::span<const ViewSpec> views, bool depth = false);

  // --- loss and gradients of some views (tests, paper mode, refinement) ----------------------------------------------
  // targets[v]: RGBA8 of the crop, A = mask. `normalizer` is the number of pixels that means are taken over: that of
  // the full image for mathematics.md 2.7; 0: that of each crop.
  LossValues loss(const Gaussians& gaussians, std::span<const ViewSpec> views,
                  std::span<const std::vector<std::uint8_t>* const> targets, const LossWeights& weights,
                  double normalizer, Gradients* gradients, std::vector<Picture>* pictures = nullptr);

  // --- training: parameters and moments stay on the device -----------------------------------------------------------
  // Names the targets of all views of the training; step() and others refer to them by their index in `views`. Motions
  // can be changed later. `targets` are taken to the device when they are needed, since all of them together may not
  // have room there: they must last as long as the training. Only tiles near the mask are drawn and contribute to the
  // loss; with `everywhere` the whole crop does, but D-SSIM is still taken near the mask only: elsewhere L1 is enough
  // to charge stray splats.
  void set_views(std::span<const ViewSpec> views, std::span<const capture::PackedView* const> targets,
                 bool everywhere = false);
  void set_motions(int view, const std::vector<math::Pose>& motions);
  void set_gaussians(const Gaussians& gaussians);  // resets Adam's moments and step count
  Gaussians gaussians() const;
  Gaussians gradient() const;  // of the last step's mean loss
  // Takes one Adam step on the mean loss of the views in `batch`. `twists`, if not null, gets the gradient of the mean
  // loss with respect to each view's link motions (as Gradients::link_twists).
  LossValues step(std::span<const int> batch, const LossWeights& weights, const AdamRates& rates, bool read_losses,
                  std::vector<math::MatrixX>* twists = nullptr);
  std::vector<Picture> draw_views(std::span<const int> batch, bool depth = false);

  // --- colors as a measurement ---------------------------------------------------------------------------------------
  // The Gaussians of set_gaussians() stay on the device; one submission uploads motions and crops and reads back the
  // sums, no picture. `observed`: RGBA8 of the crops, A = mask. `chain` must have as many links as the Gaussians.
  // Replaces the views of set_views().
  std::vector<ColorSums> color_sums(const chain::Chain& chain, std::span<const ViewSpec> views,
                                    std::span<const std::vector<std::uint8_t>* const> observed);
  // Draws those Gaussians. Replaces the views of set_views(), too.
  std::vector<Picture> draw_set(std::span<const ViewSpec> views, bool depth = false);

  // The paper's resets: of opacities to at most `largest`, of link probabilities to uniform. Both also zero Adam's
  // moments of these parameters.
  void reset_opacity(float largest);
  void reset_links();
  // Goes on with the rows `kept`, which keep Adam's moments, and then `added`, which begin without.
  void change_gaussians(std::span<const int> kept, const Gaussians& added);
  // For checkpoints: everything that a later step depends on.
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

// The link with the largest probability, for where a Gaussian needs one (mathematics.md 2.4).
int surest_link(const Gaussians& gaussians, int index);
// Color of one Gaussian by its spherical harmonics (mathematics.md 2.4), seen along `direction` (unit, home frame).
math::Vector3 sh_color(const Gaussians& gaussians, int index, const math::Vector3& direction);
// The part of it that is the same from everywhere, RGB in 0..1; setting it leaves the higher degrees as they are.
math::Vector3 base_color(const Gaussians& gaussians, int index);
void set_base_color(Gaussians& gaussians, int index, const math::Vector3& color);
// Of the side that it is on where its link has this rotation, from home to world.
double brightness(const Gaussians& gaussians, int index, const math::Matrix3& rotation);

}  // namespace chainsplat::splat
