// train.cpp - a twin from a capture by one call: train CAPTURE RUN
#include <cstdio>

#include "chainsplat/pipeline.h"

using namespace chainsplat;

int main(int count, char** arguments) {
  if (count != 3) {
    std::fprintf(stderr, "usage: %s CAPTURE RUN\n", arguments[0]);
    return 2;
  }
  pipeline::TrainOptions options;
  options.joints = 3;
  options.bending = chain::Bending::planar;
  options.frames = {0, 8};
  options.force = true;  // also where there is a run

  core::Listener listener;
  listener.progress = [](const core::Progress& progress) {
    if (progress.step == 0) std::printf("%s\n", progress.stage.c_str());
  };
  try {
    const pipeline::TrainResult result = pipeline::train(arguments[1], arguments[2], options, listener);
    const dynamics::Estimates& found = result.twin.estimates;
    for (std::size_t i = 0; i < found.names.size(); ++i)
      std::printf("%-24s %10.4g +- %.2g\n", found.names[i].c_str(), found.values[i], found.standard_errors[i]);
    std::printf("IoU of the rollout: %.3f\n", result.rollout->mean.iou);
  } catch (const Error& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
  }
}
