// What changes in outlines when cameras take longer to read their rows.
#include "chainsplat/core.h"
#include "chainsplat/shutter.h"
#include "src/math/decompositions.h"
#include "src/silhouette/correction_equations.h"
#include "src/silhouette/frame.h"

namespace chainsplat::silhouette {

using math::VectorX;

std::vector<VectorX> readout_slopes(const chain::Chain& chain, const capture::Capture& capture,
                                    const SequenceFit& sequence) {
  constexpr double kWidestRows = 30.0;  // px: outlines of another moment still count
  const Frames all = frames_of(capture);
  SharedPlaces readout;  // alone, in seconds
  readout.at.fill(-1);
  readout.at[kReadout] = 0;
  readout.unit[kReadout] = 1.0;
  CorrectionProblem problem{views_of(capture),
                            capture.cameras,
                            [&](double time) { return capture.base.at(time); },
                            std::vector<SharedPlaces>(capture.cameras.size(), readout),
                            1,
                            {},
                            kAsRecognized * joint_prior(chain, {}),
                            {},
                            kWidestRows};
  for (int k = 0; k < chain.angles(); ++k) problem.held.push_back(chain::is_twist(chain, k));
  std::vector<VectorX> out(all.times.size(), VectorX::Zero(chain.angles()));
  core::parallel_for(static_cast<std::int64_t>(out.size()), [&](std::int64_t f) {
    if (all.views[f].empty() || !(sequence.frames[f].residual_pixels > 0.0)) return;
    CorrectedFrame frame{all.times[f], sequence.states.thetadot[f], all.views[f], {}};
    for (const int v : frame.views) frame.masks.push_back(mask_of(capture, v));
    const FrameEquations of = frame_equations(problem, frame, {}, chain, sequence.states.theta[f]);
    out[f] = -of.local.matrix.ldlt().solve(VectorX(of.local.coupling.col(0)));
  });
  return out;
}

}  // namespace chainsplat::silhouette
