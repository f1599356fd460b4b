// chainsplat/comparison.h - pictures for people: rendered frames as 8-bit images, observed beside rendered.
#pragma once
#include "chainsplat/capture.h"
#include "chainsplat/render.h"
#include "chainsplat/twin.h"

namespace chainsplat::eval {

// The whole image of the camera, black where nothing is drawn.
capture::Image8 whole_image(const render::Frame& frame, const capture::Camera& camera);

// A few moments of the capture (rows, in time); for every camera three pictures side by side: observed, drawn from the
// recognized states, drawn from the rollout (left out where there is none). `recorded`: with recorded pixels.
capture::Image8 comparison(splat::Engine& engine, const twin::Twin& twin, const capture::Capture& recorded);

}  // namespace chainsplat::eval
