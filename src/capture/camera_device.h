// src/capture/camera_device.h - a camera behind a character device such as /dev/video0, read by V4L2.
#pragma once
#include <memory>

#include "chainsplat/capture.h"

namespace chainsplat::capture {

// What VideoReader does with a camera.
class CameraDevice {
 public:
  // Asks for raw frames where the camera has them in the wanted size and rate, otherwise for JPEG if that comes nearer.
  // Throws InputError. A rate that is not reached is warned of.
  CameraDevice(const Path& file, const DeviceFormat& wanted);
  ~CameraDevice();
  CameraDevice(CameraDevice&&) noexcept;
  CameraDevice& operator=(CameraDevice&&) noexcept;
  // The newest frame, waiting for one that has not been handed out. null: without the conversion to RGB. Throws
  // WorkError when the camera is gone or gives no good frame for 5 s, Interrupted when a stop is requested.
  bool next(Image8* rgb);
  int frames() const;         // until the last one, passed-over ones included
  double rate() const;        // frames per second, 0 when unknown
  double time() const;        // s, of the last frame by the driver's clock
  double first_time() const;  // s, of the first one

 private:
  struct Implementation;
  std::unique_ptr<Implementation> implementation_;
};

}  // namespace chainsplat::capture
