// A V4L2 camera that is not there, for tests without one: preloaded (LD_PRELOAD), it answers for the device that
// FAKE_CAMERA names. Its buffers are a memory file, so that mmap() and close() need no help.
//   FAKE_CAMERA          path of the device, for example /dev/video97
//   FAKE_CAMERA_SIZE     the only size that it has, for example 320x240
//   FAKE_CAMERA_YUYV, _UYVY, _NV12, _YU12, _RGB3, _BGR3, _GREY, _MJPG, _H264: frames in that format (see
//                        camera_frames.cpp), over and over; one or several
//   FAKE_CAMERA_RATE     frames a second (30), and the time between two stamps
//   FAKE_CAMERA_YUYV_RATE and so on      the same in that format alone, as where the cable is too slow for it
//   FAKE_CAMERA_ROW      bytes from one row to the next of raw frames, where the driver pads them
//   FAKE_CAMERA_CAN      capabilities in place of V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING
//   FAKE_CAMERA_BUSY     another program reads it
//   FAKE_CAMERA_STRIDE   frames that it takes while the program works on one: then its clock is the lines that the
//   program
//                        flushes to standard output, and no result depends on the machine's load. Without: real time
//   FAKE_CAMERA_EARLY    frames that it takes before the program looks for the first time
//   FAKE_CAMERA_GONE     it disappears after so many frames
//   FAKE_CAMERA_SILENT   it sends nothing any more after so many frames
//   FAKE_CAMERA_DAMAGED  the frame of this number is damaged on its way
//   FAKE_CAMERA_TORN     the second half of the frame of this number is missing, and the driver does not say so
//   FAKE_CAMERA_LOST     the driver has no buffer for the frame of this number
//   FAKE_CAMERA_FULL     it says that its range is 0..255
//   FAKE_CAMERA_BACK     the frame of this number is stamped a second too early
//   FAKE_CAMERA_STOPPED  the frames from this number on are stamped as the one before
#ifndef _GNU_SOURCE
#define _GNU_SOURCE
#endif
#include <dlfcn.h>
#include <fcntl.h>
#include <linux/poll.h>
#include <linux/videodev2.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/sysmacros.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <climits>
#include <cstdarg>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <deque>
#include <fstream>
#include <iterator>
#include <mutex>
#include <string>
#include <vector>

namespace {

constexpr int kBuffers = 4;  // as few as drivers of cameras grant

template <class Function>
Function real(const char* name) {
  return reinterpret_cast<Function>(dlsym(RTLD_NEXT, name));
}

double setting(const char* name, double otherwise) {
  const char* const text = std::getenv(name);
  return text ? std::atof(text) : otherwise;
}

bool is_camera(const char* path) {
  const char* const camera = std::getenv("FAKE_CAMERA");
  return camera && path && std::strcmp(camera, path) == 0;
}

double now() {
  timespec time{};
  clock_gettime(CLOCK_MONOTONIC, &time);
  return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
}

struct Format {
  std::uint32_t name = 0;
  double rate = 30.0;               // frames a second
  std::vector<std::string> frames;  // what a buffer holds
};

struct Camera {
  std::mutex mutex;
  int file = -1;  // of the memory; -1: nobody has opened it
  bool waits = true;
  int width = 0, height = 0;
  std::vector<Format> formats;
  const Format* format = nullptr;
  std::size_t capacity = 0;  // bytes of a buffer
  double begun = 0.0;        // s, monotonic: when frame 0 was taken
  int taken = 0;             // frames, those without a buffer among them
  int damaged = 0;  // and others that the program passes over
  std::deque<v4l2_buffer> empty, full;
} camera;

std::atomic<int> lines{0};  // flushed by the program

void read_settings() {
  std::sscanf(std::getenv("FAKE_CAMERA_SIZE"), "%dx%d", &camera.width, &camera.height);
  camera.formats.clear();
  for (const char* const name : {"YUYV", "UYVY", "NV12", "YU12", "RGB3", "BGR3", "MJPG", "GREY", "H264"}) {
    const std::string frames = std::string("FAKE_CAMERA_") + name;
    const char* const path = std::getenv(frames.c_str());
    if (!path) continue;
    Format format{v4l2_fourcc(name[0], name[1], name[2], name[3]),
                  setting((frames + "_RATE").c_str(), setting("FAKE_CAMERA_RATE", 30.0)), {}};
    std::ifstream file(path, std::ios::binary);
    std::uint32_t size = 0;
    while (file.read(reinterpret_cast<char*>(&size), sizeof size)) {
      format.frames.emplace_back(size, '\0');
      file.read(format.frames.back().data(), size);
    }
    camera.formats.push_back(std::move(format));
  }
  camera.format = &camera.formats.at(0);
  std::size_t most = 0;  // bytes of a frame
  for (const Format& format : camera.formats)
    for (const std::string& frame : format.frames) most = std::max(most, frame.size());
  camera.capacity = (most + 4095u) / 4096u * 4096u;
  camera.empty.clear(), camera.full.clear();
}

// Frames that have been taken until now.
int due() {
  const int stride = static_cast<int>(setting("FAKE_CAMERA_STRIDE", 0));
  const int count = stride > 0
                        ? 1 + static_cast<int>(setting("FAKE_CAMERA_EARLY", 0)) + stride * (lines + camera.damaged)
                        : 1 + static_cast<int>((now() - camera.begun) * camera.format->rate);
  return static_cast<int>(std::min(
      {static_cast<double>(count), setting("FAKE_CAMERA_GONE", INT_MAX), setting("FAKE_CAMERA_SILENT", INT_MAX)}));
}

// What the driver has done since it was last asked: frames into the empty buffers; there is none for the rest.
void fill_buffers() {
  for (const int end = due(); camera.taken < end; ++camera.taken) {
    if (camera.empty.empty()) continue;
    if (camera.taken == setting("FAKE_CAMERA_LOST", -1)) {
      ++camera.damaged;
      continue;
    }
    v4l2_buffer buffer = camera.empty.front();
    camera.empty.pop_front();
    const std::string& frame = camera.format->frames[camera.taken % camera.format->frames.size()];
    pwrite(camera.file, frame.data(), frame.size(), static_cast<off_t>(buffer.index * camera.capacity));
    const double stopped = setting("FAKE_CAMERA_STOPPED", INT_MAX);
    double time = camera.begun + std::min<double>(camera.taken, stopped - 1) / camera.format->rate;
    if (camera.taken == setting("FAKE_CAMERA_BACK", -1)) time -= 1.0;
    camera.damaged += camera.taken == setting("FAKE_CAMERA_BACK", -1) || camera.taken >= stopped;
    buffer.timestamp.tv_sec = static_cast<time_t>(time);
    buffer.timestamp.tv_usec = static_cast<suseconds_t>(1e6 * (time - static_cast<double>(buffer.timestamp.tv_sec)));
    buffer.sequence = camera.taken;
    buffer.bytesused = static_cast<std::uint32_t>(frame.size());
    buffer.flags = V4L2_BUF_FLAG_DONE | V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC;
    if (camera.taken == setting("FAKE_CAMERA_DAMAGED", -1)) {
      buffer.flags |= V4L2_BUF_FLAG_ERROR;
      ++camera.damaged;
    }
    if (camera.taken == setting("FAKE_CAMERA_TORN", -1)) {
      buffer.bytesused /= 2;
      ++camera.damaged;
    }
    camera.full.push_back(buffer);
  }
}

int refuse(int error) {
  errno = error;
  return -1;
}

int dequeue(v4l2_buffer& buffer) {
  for (;;) {
    {
      const std::lock_guard lock(camera.mutex);
      fill_buffers();
      if (!camera.full.empty()) {
        buffer = camera.full.front();
        camera.full.pop_front();
        return 0;
      }
      if (camera.taken >= setting("FAKE_CAMERA_GONE", INT_MAX)) return refuse(ENODEV);
      if (!camera.waits) return refuse(EAGAIN);
    }
    usleep(1000);
  }
}

int answer(unsigned long request, void* argument) {
  if (request == VIDIOC_DQBUF) return dequeue(*static_cast<v4l2_buffer*>(argument));
  const std::lock_guard lock(camera.mutex);
  switch (request) {
    case VIDIOC_QUERYCAP: {
      auto& capability = *static_cast<v4l2_capability*>(argument);
      capability = {};
      std::strcpy(reinterpret_cast<char*>(capability.driver), "fake");
      std::strcpy(reinterpret_cast<char*>(capability.card), "no camera");
      // what the whole device can, and what this file of it
      const double can = setting("FAKE_CAMERA_CAN", V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING);
      capability.device_caps = static_cast<std::uint32_t>(can);
      capability.capabilities = V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING | V4L2_CAP_DEVICE_CAPS;
      return 0;
    }
    case VIDIOC_G_INPUT:
      *static_cast<int*>(argument) = 0;
      return 0;
    case VIDIOC_ENUMINPUT: {
      auto& input = *static_cast<v4l2_input*>(argument);
      if (input.index != 0) return refuse(EINVAL);
      input = {};
      input.type = V4L2_INPUT_TYPE_CAMERA;
      return 0;
    }
    case VIDIOC_S_FMT:
    case VIDIOC_G_FMT: {
      // as the driver of USB cameras: what it does not have becomes what it has
      v4l2_pix_format& pixels = static_cast<v4l2_format*>(argument)->fmt.pix;
      if (request == VIDIOC_S_FMT) {
        if (std::getenv("FAKE_CAMERA_BUSY")) return refuse(EBUSY);
        camera.format = &camera.formats[0];
        for (const Format& format : camera.formats)
          if (format.name == pixels.pixelformat) camera.format = &format;
      }
      pixels = {};
      pixels.width = camera.width, pixels.height = camera.height;
      pixels.pixelformat = camera.format->name;
      pixels.field = V4L2_FIELD_NONE;
      pixels.bytesperline = static_cast<std::uint32_t>(setting("FAKE_CAMERA_ROW", 0));
      if (std::getenv("FAKE_CAMERA_FULL")) pixels.quantization = V4L2_QUANTIZATION_FULL_RANGE;
      pixels.sizeimage = static_cast<std::uint32_t>(camera.capacity);
      return 0;
    }
    case VIDIOC_G_PARM:
    case VIDIOC_S_PARM: {
      v4l2_captureparm& parameters = static_cast<v4l2_streamparm*>(argument)->parm.capture;
      parameters.capability = V4L2_CAP_TIMEPERFRAME;
      parameters.timeperframe = {1000, static_cast<std::uint32_t>(1000.0 * camera.format->rate)};
      return 0;
    }
    case VIDIOC_REQBUFS: {
      auto& wanted = *static_cast<v4l2_requestbuffers*>(argument);
      wanted.count = kBuffers;
      return ftruncate(camera.file, static_cast<off_t>(kBuffers * camera.capacity));
    }
    case VIDIOC_QUERYBUF:
    case VIDIOC_QBUF: {
      auto& buffer = *static_cast<v4l2_buffer*>(argument);
      if (buffer.index >= kBuffers) return refuse(EINVAL);
      buffer.length = static_cast<std::uint32_t>(camera.capacity);
      buffer.m.offset = static_cast<std::uint32_t>(buffer.index * camera.capacity);
      if (request == VIDIOC_QUERYBUF) return 0;
      if (camera.taken > 0) fill_buffers();  // until now this one was not there
      camera.empty.push_back(buffer);
      return 0;
    }
    case VIDIOC_STREAMON:
      camera.begun = now();
      camera.taken = camera.damaged = 0;
      lines = 0;
      return 0;
    case VIDIOC_STREAMOFF:
      return 0;
    default:
      return refuse(ENOTTY);
  }
}

int open_camera(int flags) {
  const std::lock_guard lock(camera.mutex);
  read_settings();
  camera.waits = !(flags & O_NONBLOCK);
  return camera.file = memfd_create("fake camera", 0);
}

int describe(struct stat* facts) {
  *facts = {};
  facts->st_mode = S_IFCHR | 0660;
  facts->st_rdev = makedev(81, 0);
  return 0;
}

}  // namespace

extern "C" {

int open(const char* path, int flags, ...) {
  va_list rest;
  va_start(rest, flags);
  const mode_t mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(rest, mode_t) : 0;
  va_end(rest);
  if (is_camera(path)) return open_camera(flags);
  return real<int (*)(const char*, int, ...)>("open")(path, flags, mode);
}

int open64(const char* path, int flags, ...) {
  va_list rest;
  va_start(rest, flags);
  const mode_t mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(rest, mode_t) : 0;
  va_end(rest);
  if (is_camera(path)) return open_camera(flags);
  return real<int (*)(const char*, int, ...)>("open64")(path, flags, mode);
}

int stat(const char* path, struct stat* facts) noexcept {
  return is_camera(path) ? describe(facts) : real<int (*)(const char*, struct stat*)>("stat")(path, facts);
}

int poll(pollfd* files, unsigned long count, int milliseconds) {
  if (count != 1 || files->fd < 0 || files->fd != camera.file)
    return real<int (*)(pollfd*, unsigned long, int)>("poll")(files, count, milliseconds);
  for (const double end = now() + 1e-3 * milliseconds;; usleep(1000)) {
    const std::lock_guard lock(camera.mutex);
    fill_buffers();
    const bool gone = camera.full.empty() && camera.taken >= setting("FAKE_CAMERA_GONE", INT_MAX);
    files->revents = static_cast<short>(gone ? POLLERR | POLLHUP : camera.full.empty() ? 0 : files->events);
    if (files->revents != 0) return 1;
    if (now() > end) return 0;
  }
}

int ioctl(int file, unsigned long request, ...) noexcept {
  va_list rest;
  va_start(rest, request);
  void* const argument = va_arg(rest, void*);
  va_end(rest);
  if (file >= 0 && file == camera.file) return answer(request, argument);
  return real<int (*)(int, unsigned long, ...)>("ioctl")(file, request, argument);
}

int close(int file) {
  if (file >= 0 && file == camera.file) camera.file = -1;
  return real<int (*)(int)>("close")(file);
}

int fflush(FILE* stream) {
  const int code = real<int (*)(FILE*)>("fflush")(stream);
  if (stream == stdout) ++lines;
  return code;
}
}
