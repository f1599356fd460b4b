// control_loop.cpp - follows a camera, and plans anew from where the rope is: control_loop RUN CAPTURE X,Y,Z
//
// A recording plays the camera's and the robot's part here. In a robot's program the frames come from a driver, the
// poses from its controller, and the planned motion goes there.
#include <cstdio>

#include "chainsplat/estimation.h"
#include "chainsplat/follow.h"
#include "chainsplat/rope.h"

using namespace chainsplat;

int main(int count, char** arguments) {
  math::Vector3 target;
  if (count != 4 || std::sscanf(arguments[3], "%lf,%lf,%lf", &target[0], &target[1], &target[2]) != 3) {
    std::fprintf(stderr, "usage: %s RUN CAPTURE X,Y,Z\n", arguments[0]);
    return 2;
  }
  try {
    const pipeline::Rope rope = pipeline::load_rope(arguments[1]);
    capture::LoadOptions load;
    load.images = false;
    load.camera = capture::load(arguments[2], load).cameras.front().name;
    load.images = true;
    const capture::Capture recorded = capture::load(arguments[2], load);

    pipeline::LiveBase gripper;
    gripper.add(recorded.views.front().time, recorded.base.pose(recorded.views.front().time));
    pipeline::Tracker tracker(
        rope.twin, pipeline::as_corrected(rope.twin.corrections, recorded.cameras),
        [&](double time) { return gripper.at(time); }, recorded.views.front().time);

    planning::Options options;
    options.horizon = 1.0;
    options.starts = 4;
    for (const capture::PackedView& packed : recorded.views) {
      const capture::View view = capture::unpacked(packed);
      const math::Pose pose = recorded.base.pose(view.time);
      if (view.frame > 0) gripper.add(view.time, pose);
      const estimation::Estimate found = tracker.update({&view, 1});
      if (view.frame % 15 != 14 || found.lost) continue;
      planning::Problem problem = pipeline::planning_problem(rope);
      problem.base = pose;
      problem.initial = pipeline::state_at(problem.model, pose, 0.0, found.theta, found.thetadot);
      problem.targets = {target};
      const planning::Plan plan = planning::plan(problem, options);
      std::printf("%.3f s: %s, a plan from here misses by %.2f mm\n", view.time, estimation::status(found),
                  1e3 * plan.hits.front().miss);
    }
  } catch (const Error& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
  }
}
