// memory_growth.cpp - trains the demo many times in one process and tells how the resident memory grows. By hand:
//   ninja -C build/release memory_growth && build/release/memory_growth [TRAININGS [FRAMES [JOINTS]]]
// Exit code 1 when the last half of the trainings grew it by 1 % or more.
#include <unistd.h>

#include <cstdio>
#include <cstdlib>
#include <fstream>

#include "chainsplat/capture.h"
#include "chainsplat/eval.h"
#include "chainsplat/identification.h"
#include "chainsplat/recognition.h"

using namespace chainsplat;

namespace {

double resident_mebibytes() {
  std::ifstream file("/proc/self/statm");
  long total = 0, resident = 0;
  file >> total >> resident;
  return static_cast<double>(resident) * static_cast<double>(sysconf(_SC_PAGESIZE)) / (1 << 20);
}

// All that 'chainsplat train' does, a device of its own included, but the files.
void train_once(int frames, int joints) {
  capture::LoadOptions load;
  load.last = frames;
  const Path folder = Path(CHAINSPLAT_SOURCE_DIR) / "assets/demo_free_30";
  const capture::Capture capture = capture::load(folder, load);
  const gpu::DevicePtr device = gpu::open_device();
  recognition::Options options;
  options.joints = joints;
  const recognition::Result found = recognition::recognize(*device, capture, options);
  identification::Options identify;
  identify.gravity = capture.gravity;
  identify.mass = capture.mass;
  const identification::Result dynamics =
      identification::identify(found.chain, capture.base, found.states, identify);
  load.depth = true;
  load.pixels = capture::Pixels::recorded;
  const capture::Capture recorded = capture::load(folder, load);
  splat::Engine engine(*device);
  eval::evaluate(engine, found.gaussians, found.chain, found.states, recorded);
  eval::evaluate(engine, found.gaussians, found.chain, dynamics.rollout, recorded);
}

}  // namespace

int main(int argc, char** argv) {
  const int trainings = argc > 1 ? std::atoi(argv[1]) : 50, frames = argc > 2 ? std::atoi(argv[2]) : -1,
            joints = argc > 3 ? std::atoi(argv[3]) : 8;
  double half = 0.0, last = 0.0;
  for (int k = 1; k <= trainings; ++k) {
    train_once(frames, joints);
    last = resident_mebibytes();
    if (k == trainings / 2) half = last;
    std::printf("training %2d: %.2f MiB\n", k, last);
    std::fflush(stdout);
  }
  const double growth = 100.0 * (last - half) / half;
  constexpr double kMostPercent = 1.0;
  std::printf("growth of the last half: %.2f %%\n", growth);
  return growth < kMostPercent ? 0 : 1;
}
