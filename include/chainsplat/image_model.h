// chainsplat/image_model.h - the numbers of the image model (mathematics.md 2.4 to 2.7) that the host and the shaders
// share. C++ and GLSL both read this file: the host gets double, the device float.
#ifndef CHAINSPLAT_IMAGE_MODEL_H
#define CHAINSPLAT_IMAGE_MODEL_H
#ifdef __cplusplus
namespace chainsplat::image_model {
#define REAL inline constexpr double
#else
#define REAL const float
#endif

// Projection: EWA splatting with the numbers of 3DGS, except for the nearest depth.
REAL kNear = 0.01;        // m; what is nearer than this is not in front of a camera
REAL kLowPass = 0.3;      // px^2; added to a projected variance, so that no splat falls between the pixels' centers
REAL kLeastFootprint = 0.6;  // px that splat::Gaussians::pixel_footprint counts for at least: however far away the rope
                             // is, the low pass keeps 0.36 of that variance, a third of a pixel as standard deviation
REAL kClampMargin = 1.3;  // half images; bound of x/z and y/z in the projection's Jacobian, which is linear in them and
                          // would make splats far outside the image very large

// Blending, as in 3DGS.
REAL kLeastAlpha = 1.0 / 255.0;   // a smaller alpha changes no picture of 8 bits and is skipped
REAL kMostAlpha = 0.99;           // keeps 1 - alpha, by which gradients divide, away from 0
REAL kLeastTransmittance = 1e-4;  // what would lie behind less than this is not drawn

// Least coverage, 0..255, of a pixel of the object in a mask (formats.md 1.5).
const int kObjectMask = 128;

// Least brightness of a side of the rope (mathematics.md 2.4): what lies around it reaches every side, and where no
// picture shows a side, what is known of the light must not make it black.
REAL kLeastBrightness = 0.2;

// Spherical harmonic of degree 0, 1 / (2 sqrt(pi)): without higher degrees a color is 0.5 + kSh0 * coefficient.
REAL kSh0 = 0.28209479177387814;

// SSIM (Wang et al. 2004) of colors in 0..1: reach of the window in px, its weights by distance from the center (a
// Gaussian of sigma 1.5 px, normalized to sum 1 over both sides), and the constants that keep the quotients finite.
const int kSsimReach = 5;
REAL kSsimWindow[6] = {0.26601172486179436,  0.21300553771125369,   0.10936068950970002,
                       0.036000772128430829, 0.007598758135239185, 0.0010283800844791101};
REAL kSsimC1 = 0.01 * 0.01, kSsimC2 = 0.03 * 0.03;

#ifdef __cplusplus
#undef REAL
}  // namespace chainsplat::image_model
#endif
#endif
