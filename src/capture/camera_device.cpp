#include "src/capture/camera_device.h"

#include <fcntl.h>
#include <linux/videodev2.h>
#include <poll.h>
#include <sys/ioctl.h>
#include <sys/mman.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <chrono>
#include <cmath>
#include <condition_variable>
#include <cstring>
#include <limits>
#include <mutex>
#include <optional>
#include <span>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "src/capture/descriptor.h"
#include "src/capture/jpeg.h"
#include "src/capture/ycbcr.h"

namespace chainsplat::capture {

namespace {

// The formats that are read, the first that serves is taken. Raw ones come first, because nothing is lost in them. On
// USB 2 many cameras have only small or slow raw frames, and larger or faster ones as JPEG. Gray is last, since masks
// are made by color.
constexpr std::uint32_t kFormats[] = {V4L2_PIX_FMT_YUYV,   V4L2_PIX_FMT_UYVY,  V4L2_PIX_FMT_NV12,
                                      V4L2_PIX_FMT_YUV420, V4L2_PIX_FMT_RGB24, V4L2_PIX_FMT_BGR24,
                                      V4L2_PIX_FMT_MJPEG,  V4L2_PIX_FMT_JPEG,  V4L2_PIX_FMT_GREY};
// One is being read, one is the newest, and the driver fills the rest: some begin only with three.
constexpr int kBuffers = 6;
constexpr double kEnough = 0.95;                     // share of the wanted rate that counts as reached
constexpr double kSilence = 5.0;                     // s without a good frame, after which the camera counts as lost
constexpr std::chrono::milliseconds kAttention{50};  // between two looks for a request to stop
constexpr std::chrono::milliseconds kPause{1};       // after a wait that was over without a frame

// A system call to the driver. Returns 0, or the error's number.
template <class Argument>
int call(int device, unsigned long request, Argument* argument) {
  while (::ioctl(device, request, argument) != 0)
    if (errno != EINTR) return errno;
  return 0;
}

template <class T>
T of_capture() {
  T made{};
  made.type = V4L2_BUF_TYPE_VIDEO_CAPTURE;
  return made;
}

v4l2_buffer empty_buffer(std::uint32_t index) {
  v4l2_buffer made = of_capture<v4l2_buffer>();
  made.memory = V4L2_MEMORY_MMAP;
  made.index = index;
  return made;
}

std::string format_name(std::uint32_t format) {
  std::string name;
  for (int shift = 0; shift < 32; shift += 8) name += static_cast<char>(format >> shift & 0x7f);
  return name;
}

// What a camera was set to.
struct Setting {
  std::uint32_t format = 0;
  int width = 0, height = 0;
  std::size_t row = 0;   // bytes from one row to the next, of luma where it is apart
  std::size_t size = 1;  // bytes of a whole frame, at least
  bool full_range = false;
  double rate = 0.0;  // frames per second; 0: unknown
};

bool is_compressed(std::uint32_t format) { return format == V4L2_PIX_FMT_MJPEG || format == V4L2_PIX_FMT_JPEG; }

// Sets row and size of a raw format.
void lay_out(Setting& set, std::size_t driver_row) {
  if (is_compressed(set.format)) return;
  const std::size_t even = set.width + set.width % 2, half_height = (set.height + 1) / 2;
  std::size_t row = even;  // where each pixel has a byte of luma
  if (set.format == V4L2_PIX_FMT_YUYV || set.format == V4L2_PIX_FMT_UYVY) row = 2 * even;
  if (set.format == V4L2_PIX_FMT_RGB24 || set.format == V4L2_PIX_FMT_BGR24) row = std::size_t{3} * set.width;
  if (set.format == V4L2_PIX_FMT_GREY) row = set.width;
  set.row = std::max(row, driver_row);
  set.size = set.row * set.height;
  if (set.format == V4L2_PIX_FMT_NV12 || set.format == V4L2_PIX_FMT_YUV420) set.size += set.row * half_height;
}

[[noreturn]] void refuse(const Path& file, int error) {
  throw InputError(file.string(),
                   std::string("is no camera that V4L2 can read in this format (") + std::strerror(error) + ")",
                   "'v4l2-ctl --list-devices' and '--list-formats-ext' show what there is");
}

// Sets the camera to a format, 0: the one that it has, and returns what its driver makes of that, which may be another
// one. None where it refuses.
std::optional<Setting> set_format(int device, const Path& file, std::uint32_t format, const DeviceFormat& wanted) {
  v4l2_format asked = of_capture<v4l2_format>();
  v4l2_pix_format& pixels = asked.fmt.pix;
  if (call(device, VIDIOC_G_FMT, &asked) != 0) return std::nullopt;
  if (format != 0) {
    const bool sized = wanted.width > 0 && wanted.height > 0;
    const std::uint32_t width = sized ? wanted.width : pixels.width, height = sized ? wanted.height : pixels.height;
    pixels = {};
    pixels.width = width, pixels.height = height;
    pixels.pixelformat = format;
    pixels.field = V4L2_FIELD_ANY;
    const int error = call(device, VIDIOC_S_FMT, &asked);
    if (error == EBUSY) refuse(file, error);  // another program reads it, whatever the format
    if (error != 0) return std::nullopt;
  }
  if (pixels.width == 0 || pixels.height == 0 || std::uint64_t{pixels.width} * pixels.height > kMostPixels)
    return std::nullopt;
  Setting set;
  set.format = pixels.pixelformat;
  set.width = static_cast<int>(pixels.width), set.height = static_cast<int>(pixels.height);
  set.full_range = pixels.quantization == V4L2_QUANTIZATION_FULL_RANGE;
  constexpr std::uint32_t kLongestRow = 1u << 30;  // bytes; no driver has such rows
  lay_out(set, std::min(pixels.bytesperline, kLongestRow));
  // the rate, which some drivers cannot tell
  v4l2_streamparm stream = of_capture<v4l2_streamparm>();
  v4l2_fract& interval = stream.parm.capture.timeperframe;
  if (call(device, VIDIOC_G_PARM, &stream) != 0) return set;
  if (wanted.rate > 0.0 && stream.parm.capture.capability & V4L2_CAP_TIMEPERFRAME) {
    constexpr double kOver = 1000.0;  // rates are told to a thousandth
    interval = {static_cast<std::uint32_t>(kOver), static_cast<std::uint32_t>(std::lround(kOver * wanted.rate))};
    if (call(device, VIDIOC_S_PARM, &stream) != 0) return set;
  }
  if (interval.numerator > 0) set.rate = static_cast<double>(interval.denominator) / interval.numerator;
  return set;
}

// Sets the camera to the first format that has the wanted size and rate, else to the one that comes nearest.
Setting choose_format(int device, const Path& file, const DeviceFormat& wanted) {
  v4l2_capability able{};
  if (const int error = call(device, VIDIOC_QUERYCAP, &able)) refuse(file, error);
  const std::uint32_t what = able.capabilities & V4L2_CAP_DEVICE_CAPS ? able.device_caps : able.capabilities;
  if (!(what & V4L2_CAP_VIDEO_CAPTURE) || !(what & V4L2_CAP_STREAMING)) refuse(file, ENODEV);
  const auto merit = [&](const Setting& set) {
    const bool sized = wanted.width <= 0 || (set.width == wanted.width && set.height == wanted.height);
    return std::pair(sized, std::min(wanted.rate, set.rate));
  };
  const std::pair enough(true, kEnough * wanted.rate);
  std::optional<Setting> best;
  std::uint32_t tried = 0;  // last
  for (const std::uint32_t format : kFormats) {
    const std::optional<Setting> set = set_format(device, file, format, wanted);
    tried = format;
    if (!set || set->format != format) continue;
    if (!best || merit(*set) > merit(*best)) best = set;
    if (merit(*best) >= enough) break;
  }
  if (!best) {
    const std::optional<Setting> other = set_format(device, file, 0, {});
    if (!other) refuse(file, EINVAL);
    throw InputError(file.string(), "sends " + format_name(other->format) + ", which is not read",
                     "set it to raw frames (YUYV, UYVY, NV12, YU12, RGB3, BGR3, GREY) or MJPEG");
  }
  if (tried != best->format) best = set_format(device, file, best->format, wanted);
  if (!best) refuse(file, EINVAL);
  if (const auto [sized, rate] = merit(*best); sized && rate > 0.0 && rate < kEnough * wanted.rate)
    core::warn(file.string() + ": gives " + core::exact(rate) + " frames a second in this size instead of " +
               core::exact(wanted.rate));
  return *best;
}

// Memory that the driver fills.
struct Mapped {
  void* start = MAP_FAILED;
  std::size_t length = 0;
  Mapped(int device, const v4l2_buffer& buffer)
      : start(::mmap(nullptr, buffer.length, PROT_READ | PROT_WRITE, MAP_SHARED, device, buffer.m.offset)),
        length(buffer.length) {}
  Mapped(Mapped&& other) noexcept : start(std::exchange(other.start, MAP_FAILED)), length(other.length) {}
  ~Mapped() {
    if (start != MAP_FAILED) ::munmap(start, length);
  }
};

// Converts a frame to RGB. Returns false where it is damaged.
bool read_frame(const Setting& set, std::span<const std::uint8_t> bytes, Image8& rgb) {
  if (bytes.size() < set.size) return false;
  if (is_compressed(set.format)) return read_jpeg(bytes, set.width, set.height, rgb);
  const std::uint8_t* const at = bytes.data();
  YCbCr from;
  from.full = set.full_range;
  from.luma = at;
  from.luma_row = from.chroma_row = set.row;
  switch (set.format) {
    case V4L2_PIX_FMT_YUYV:
    case V4L2_PIX_FMT_UYVY: {
      const int chroma = set.format == V4L2_PIX_FMT_YUYV ? 1 : 0;  // where it begins
      from.luma = at + 1 - chroma;
      from.cb = at + chroma, from.cr = from.cb + 2;
      from.luma_step = 2, from.chroma_step = 4;
      from.across = 1;
      break;
    }
    case V4L2_PIX_FMT_NV12:
      from.cb = at + set.row * set.height, from.cr = from.cb + 1;
      from.chroma_step = 2;
      from.across = from.down = 1;
      break;
    case V4L2_PIX_FMT_YUV420:
      from.chroma_row = set.row / 2;
      from.cb = at + set.row * set.height, from.cr = from.cb + from.chroma_row * ((set.height + 1) / 2);
      from.across = from.down = 1;
      break;
    case V4L2_PIX_FMT_RGB24:
    case V4L2_PIX_FMT_BGR24: {
      const int red = set.format == V4L2_PIX_FMT_RGB24 ? 0 : 2;
      rgb.width = set.width, rgb.height = set.height, rgb.channels = 3;
      rgb.pixels.resize(std::size_t{3} * set.width * set.height);
      std::uint8_t* out = rgb.pixels.data();
      for (int y = 0; y < set.height; ++y)
        for (int x = 0; x < set.width; ++x, out += 3) {
          const std::uint8_t* const pixel = at + y * set.row + std::size_t{3} * x;
          out[0] = pixel[red], out[1] = pixel[1], out[2] = pixel[2 - red];
        }
      return true;
    }
    default:  // gray
      break;
  }
  to_rgb(from, set.width, set.height, rgb);
  return true;
}

double seconds(const v4l2_buffer& buffer) {
  return static_cast<double>(buffer.timestamp.tv_sec) + 1e-6 * static_cast<double>(buffer.timestamp.tv_usec);
}

}  // namespace

// A thread takes the frames from the driver as they come and keeps the newest; without it the driver's buffers would be
// full of old ones while the program works on one.
struct CameraDevice::Implementation {
  Path file;
  Descriptor device;
  Setting set;
  std::vector<Mapped> buffers;
  int frames = 0;                                          // of the last frame handed out,
  double time = std::numeric_limits<double>::quiet_NaN();  // and its stamp
  std::atomic<bool> stop{false};
  std::mutex mutex;  // of what follows
  std::condition_variable came;
  std::optional<v4l2_buffer> newest;
  int received = 0;  // frames up to the newest one
  int error = 0;     // of the driver, which ends it all
  double first_time = std::numeric_limits<double>::quiet_NaN();
  std::thread thread;

  Implementation(const Path& path, const DeviceFormat& wanted);
  ~Implementation();
  void give_back(const v4l2_buffer& buffer);
  void fetch();
  v4l2_buffer wait_for_newest(double until, bool damaged);
};

CameraDevice::Implementation::Implementation(const Path& path, const DeviceFormat& wanted)
    : file(path), device(::open(path.c_str(), O_RDWR | O_NONBLOCK | O_CLOEXEC | O_NOCTTY)) {
  if (device.number() < 0) refuse(file, errno);
  set = choose_format(device.number(), file, wanted);
  v4l2_requestbuffers asked = of_capture<v4l2_requestbuffers>();
  asked.memory = V4L2_MEMORY_MMAP;
  asked.count = kBuffers;
  if (const int failed = call(device.number(), VIDIOC_REQBUFS, &asked)) refuse(file, failed);
  for (std::uint32_t index = 0; index < asked.count; ++index) {
    v4l2_buffer buffer = empty_buffer(index);
    if (const int failed = call(device.number(), VIDIOC_QUERYBUF, &buffer)) refuse(file, failed);
    buffers.emplace_back(device.number(), buffer);
    if (buffers.back().start == MAP_FAILED) refuse(file, errno);
    if (const int failed = call(device.number(), VIDIOC_QBUF, &buffer)) refuse(file, failed);
  }
  int type = V4L2_BUF_TYPE_VIDEO_CAPTURE;
  if (const int failed = call(device.number(), VIDIOC_STREAMON, &type)) refuse(file, failed);
  thread = std::thread([this] { fetch(); });
}

CameraDevice::Implementation::~Implementation() {
  stop = true;
  if (thread.joinable()) thread.join();
}

// Lets the driver fill a buffer again. Where that fails the camera is gone, as the next frame tells.
void CameraDevice::Implementation::give_back(const v4l2_buffer& buffer) {
  v4l2_buffer empty = empty_buffer(buffer.index);
  call(device.number(), VIDIOC_QBUF, &empty);
}

void CameraDevice::Implementation::fetch() {
  int count = 0;
  std::uint32_t sequence = 0;  // of the last frame
  for (;;) {
    pollfd waiting{device.number(), POLLIN, 0};
    ::poll(&waiting, 1, static_cast<int>(kAttention.count()));
    if (stop) return;
    // take all that there is
    std::optional<v4l2_buffer> last;
    int last_count = 0, failed = 0;
    for (;;) {
      v4l2_buffer buffer = empty_buffer(0);
      failed = call(device.number(), VIDIOC_DQBUF, &buffer);
      if (failed == 0 && buffer.index >= buffers.size()) failed = ENODEV;  // which no driver does
      if (failed != 0) break;
      // numbers that the driver left out are frames that it had no buffer for; some drivers do not count
      const auto ahead = static_cast<std::int32_t>(buffer.sequence - sequence);
      constexpr int kMostAhead = 1 << 16;  // frames; where it is more the driver counts anew
      if (count == 0) {
        const std::lock_guard lock(mutex);
        first_time = seconds(buffer);
      }
      count += count > 0 && ahead > 0 && ahead < kMostAhead ? ahead : 1;
      sequence = buffer.sequence;
      const bool damaged = buffer.flags & V4L2_BUF_FLAG_ERROR || buffer.bytesused < set.size;
      if (damaged) {
        give_back(buffer);
        continue;
      }
      if (last) give_back(*last);
      last = buffer, last_count = count;
    }
    // a driver may say EIO of a frame that it could not get, and go on
    const bool goes_on = failed == EAGAIN || failed == EIO;
    if (last || !goes_on) {
      const std::lock_guard lock(mutex);
      if (last) {
        if (newest) give_back(*newest);
        newest = last;
        received = last_count;
      }
      if (!goes_on) error = failed;
      came.notify_one();
    } else {
      std::this_thread::sleep_for(kPause);
    }
    if (!goes_on) return;
  }
}

// `damaged`: whether the last frame was. Throws.
v4l2_buffer CameraDevice::Implementation::wait_for_newest(double until, bool damaged) {
  const auto lost = [&](const std::string& how) {
    return WorkError(file.string(), "gives no more frames after " + std::to_string(received) + " (" + how + ")",
                     "check the camera and its cable");
  };
  std::unique_lock lock(mutex);
  while (!newest) {
    if (error != 0) throw lost(std::strerror(error));
    core::stop_if_requested();
    if (core::seconds_now() > until) throw lost(damaged ? "all are damaged" : "silent");
    came.wait_for(lock, kAttention);
  }
  const v4l2_buffer buffer = *newest;
  newest.reset();
  frames = received;
  time = seconds(buffer);
  return buffer;
}

CameraDevice::CameraDevice(const Path& file, const DeviceFormat& wanted)
    : implementation_(std::make_unique<Implementation>(file, wanted)) {}
CameraDevice::~CameraDevice() = default;
CameraDevice::CameraDevice(CameraDevice&&) noexcept = default;
CameraDevice& CameraDevice::operator=(CameraDevice&&) noexcept = default;

bool CameraDevice::next(Image8* rgb) {
  Implementation& camera = *implementation_;
  const double until = core::seconds_now() + kSilence;
  for (bool damaged = false;; damaged = true) {
    const v4l2_buffer buffer = camera.wait_for_newest(until, damaged);
    const Mapped& memory = camera.buffers[buffer.index];
    const std::span bytes(static_cast<const std::uint8_t*>(memory.start),
                          std::min<std::size_t>(buffer.bytesused, memory.length));
    const bool good = !rgb || read_frame(camera.set, bytes, *rgb);
    camera.give_back(buffer);
    if (good) return true;
  }
}

int CameraDevice::frames() const { return implementation_->frames; }
double CameraDevice::rate() const { return implementation_->set.rate; }
double CameraDevice::time() const { return implementation_->time; }
double CameraDevice::first_time() const {
  const std::lock_guard lock(implementation_->mutex);
  return implementation_->first_time;
}

}  // namespace chainsplat::capture
