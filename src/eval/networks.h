// src/eval/networks.h - neural networks are run by chainsplat_networks.so (src/core/own_library.h), which is
// src/eval/networks/networks.cpp and links OpenCV's dnn.
#pragma once
#include <string>
#include <vector>

#include "chainsplat/core.h"

namespace chainsplat::eval::networks {

struct Network;  // an opened one; one call at a time

struct Map {  // an output of a network
  int channels = 0, height = 0, width = 0;
  std::vector<float> values;  // channel by channel, row by row
  int positions() const { return height * width; }
};

struct NetworkLibrary {
  const char* version;
  // A network from the bytes of an ONNX file whose one input is an image; `file` is named in errors. Throws InputError.
  Network* (*open)(const Path& file, const std::string& bytes);
  void (*close)(Network* network);
  // The outputs for an image of 3 x height x width, planes one after the other, of any size. It works on the calling
  // thread alone: OpenCV's sums over small images round otherwise on another number of threads. Throws InputError where
  // the network takes no such image.
  std::vector<Map> (*run)(Network& network, std::vector<float>& planes, int height, int width);
  // The same outputs without their values, in no time.
  std::vector<Map> (*shapes)(Network& network, int height, int width);
};

extern "C" {
extern const NetworkLibrary chainsplat_networks;
}

}  // namespace chainsplat::eval::networks
