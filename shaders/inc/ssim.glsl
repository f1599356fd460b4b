// ssim.glsl - the separable 11-tap window of SSIM (SPEC 2.7): Gaussian, sigma 1.5, weights normalized to sum 1.
const int kReach = 5;
const float kWindow[11] = float[](0.00102838008, 0.00759875814, 0.0360007721, 0.10936069, 0.213005538, 0.266011725,
                                  0.213005538, 0.10936069, 0.0360007721, 0.00759875814, 0.00102838008);
const float kC1 = 0.01 * 0.01, kC2 = 0.03 * 0.03;
