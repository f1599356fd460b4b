// src/eval/onnx.h - whether a file's bytes are a trunk as `tools/lpips_trunk` writes it, before OpenCV reads it.
#pragma once
#include <string>

#include "chainsplat/core.h"

namespace chainsplat::eval {

// OpenCV's reader trusts what an ONNX file says of itself, and reads past the end of some that are damaged. Here its
// frame is walked: a graph of convolutions, ReLUs and max poolings, each of what was there before it, whose weights are
// as many as their dimensions say and whose strides, pads and kernels are of a size that a picture can have. Anything
// else is refused by an InputError that names `file`. (ONNX 1.6, protocol buffers' wire format.)
void check_trunk(const Path& file, const std::string& bytes);

}  // namespace chainsplat::eval
