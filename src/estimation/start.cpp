// start.cpp - the filter before its first frame.
#include <algorithm>

#include "src/estimation/setup.h"
#include "src/estimation/state.h"

namespace chainsplat::estimation {

using math::Vector3;
using math::VectorX;

namespace {

// Standard deviation of the masks' edge offset at first.
constexpr double kOffsetDeviation = 0.5;  // px

// Whether the unknown force is estimated: shifts of the rest angles stand for it only where every joint has stiffness,
// and a twin of another integrator (the paper's) is followed without.
bool identified_shifts(const dynamics::Parameters& parameters) {
  return parameters.integrator == dynamics::Integrator::rodas3 &&
         std::all_of(parameters.stiffness.begin(), parameters.stiffness.end(), [](double k) { return k > 0.0; });
}

}  // namespace

Options options_for_live_masks(bool tabletop) {
  Options options;
  if (tabletop) return options;
  // with the usual shares a pushed rope in free space was lost
  options.new_share = 0.1;
  options.color_share = 0.01;
  return options;
}

Given given_by(const twin::Twin& twin, const std::vector<capture::Camera>& cameras, dynamics::BaseFunction base,
               double base_start) {
  Given given;
  given.identified = twin.parameters.has_value();
  if (given.identified) {
    given.model = dynamics::make_model(twin.chain, *twin.parameters);
    given.shifts = identified_shifts(*twin.parameters);
    // sensitivities come from the variational equation of this integrator only
    given.model.parameters.integrator = dynamics::Integrator::rodas3;
  } else {
    given.model.chain = twin.chain;
  }
  given.everywhere = VectorX::Constant(twin.chain.links() - 1, 1.0 / (twin.chain.links() - 1));
  given.cameras = cameras;
  given.base = std::move(base);
  given.base_start = base_start;
  if (twin.tabletop) given.table_normal = twin.table_normal.value_or(Vector3::UnitZ()).normalized();
  if (twin.tabletop || !given.identified) {
    given.rest = twin.initial                ? twin.initial->theta
                 : twin.states.theta.empty() ? VectorX::Zero(twin.chain.angles())
                                             : twin.states.theta.front();
  } else {
    given.rest = dynamics::static_equilibrium(given.model, given.base(base_start).pose).theta;
  }
  return given;
}

State start(const twin::Twin& twin, const std::vector<capture::Camera>& cameras, dynamics::BaseFunction base,
            double base_start, const Options& options, const std::vector<char>& unverified,
            CompareColors compare_colors) {
  State state;
  state.given = given_by(twin, cameras, std::move(base), base_start);
  state.options = options;
  state.compare_colors = std::move(compare_colors);
  state.cameras = cameras;
  state.setup = first_setup(state.given, unverified);
  state.place = state.given.everywhere;
  if (twin.rolling) state.roller.emplace(state.given.model, *twin.rolling);
  state.edge_offset_variance = kOffsetDeviation * kOffsetDeviation;
  return state;
}

trajectory::BaseMotion base_at(const State& state, double time) {
  return corrected(state.given.base, base_correction(state.setup.mean), time);
}

}  // namespace chainsplat::estimation
