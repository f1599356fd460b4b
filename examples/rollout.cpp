// rollout.cpp - a twin under a base motion of one's own: rollout RUN MOTION.tum STATES.csv
#include <algorithm>
#include <cstdio>

#include "chainsplat/pipeline.h"
#include "chainsplat/rope.h"

using namespace chainsplat;

int main(int count, char** arguments) {
  if (count != 4) {
    std::fprintf(stderr, "usage: %s RUN MOTION.tum STATES.csv\n", arguments[0]);
    return 2;
  }
  try {
    const pipeline::Rope rope = pipeline::load_rope(arguments[1]);
    const trajectory::Trajectory base = trajectory::fit(trajectory::read_tum(arguments[2]), arguments[2]);
    chain::States states;
    double best = 1e9;  // s
    for (int k = 0; k < 20; ++k) {
      const double begun = core::seconds_now();
      const dynamics::InitialState rest = pipeline::rest_state(rope, base.pose(base.start()), base.start());
      states = dynamics::rollout(pipeline::model_of(rope), base, rest, pipeline::times_of(base, base.start(), 30.0));
      best = std::min(best, core::seconds_now() - begun);
    }
    core::write_file(arguments[3], twin::states_csv(states));
    std::printf("%zu rows, %.3f ms a rollout\n", states.time.size(), 1e3 * best);
  } catch (const Error& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
  }
}
