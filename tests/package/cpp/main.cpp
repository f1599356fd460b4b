// A program of one's own: own CAPTURE RUN PICTURE - trains, rolls out, draws.
#include <chainsplat/pipeline.h>
#include <chainsplat/render.h>

#include <cstdio>

using namespace chainsplat;

int main(int, char** arguments) {
  try {
    pipeline::TrainOptions options;
    options.joints = 3, options.frames = {0, 8};
    const twin::Twin twin = pipeline::train(arguments[1], arguments[2], options).twin;
    const pipeline::RolloutResult motion = pipeline::rollout(arguments[2], {});
    const capture::Capture capture = capture::load(arguments[1], {.images = false});
    const gpu::DevicePtr device = gpu::open_device();
    splat::Engine engine(*device);
    const render::Images drawn = render::images(engine, twin.gaussians, twin.chain, motion.states, motion.base,
                                                capture.cameras[0], {motion.states.time[5]});
    capture::write_png(arguments[3], {drawn.width, drawn.height, 3, drawn.rgb});
    std::printf("%zu rows\n", motion.states.time.size());
    return 0;
  } catch (const Error& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
  }
}
