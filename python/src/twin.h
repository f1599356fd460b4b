// twin.h - what Python calls a Twin.
#pragma once
#include <mutex>
#include <optional>
#include <string>
#include <utility>

#include "chainsplat/follow.h"
#include "chainsplat/gpu.h"
#include "chainsplat/rope.h"
#include "chainsplat/splat.h"

namespace chainsplat::python {

struct Twin {
  Twin(pipeline::Rope loaded, std::string device) : rope(std::move(loaded)), device_name(std::move(device)) {}
  pipeline::Rope rope;  // never changed
  std::string device_name;
  std::mutex drawing;  // of what follows, which is opened by the first picture
  gpu::DevicePtr device;
  std::optional<splat::Engine> engine;
};

}  // namespace chainsplat::python
