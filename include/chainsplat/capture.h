// chainsplat/capture.h - a recording: cameras, object-masked image crops, depth, base trajectory (INTERFACE 2).
//
// Everything downstream works on crops: a rope covers 1-3 % of an image. Loading masks the images (black outside the
// object), optionally undistorts them once, and crops every view to its mask's bounds plus a margin.
#pragma once
#include <array>
#include <memory>
#include <optional>
#include <string>
#include <vector>
#include "chainsplat/chain.h"
#include "chainsplat/core.h"
#include "chainsplat/math.h"
#include "chainsplat/trajectory.h"

namespace chainsplat::capture {

// Pinhole camera with OpenCV axes (x right, y down, z forward). Pixel (0,0) covers [0,1)^2, its center is (0.5, 0.5).
struct Camera {
  std::string name;
  int width = 0, height = 0;
  double fx = 0, fy = 0, cx = 0, cy = 0;  // px
  std::array<double, 5> distortion{};     // OpenCV k1 k2 p1 p2 k3
  math::Pose world_from_camera;
  bool distorted() const;
};

// Pixel of a camera-frame point through the pinhole (no distortion).
math::Vector2 project(const Camera& camera, const math::Vector3& camera_point);
// Recorded (distorted) pixel of an undistorted pixel, and the inverse (fixed-point iteration to 1e-9 px).
math::Vector2 distort(const Camera& camera, const math::Vector2& undistorted_pixel);
math::Vector2 undistort(const Camera& camera, const math::Vector2& recorded_pixel);

// One image of one camera, cropped: pixel (0,0) of the crop is pixel (x0, y0) of the image.
struct View {
  int camera = 0;     // index into Capture::cameras
  int frame = 0;      // the camera's frame number
  double time = 0.0;  // s
  int x0 = 0, y0 = 0, width = 0, height = 0;
  std::vector<std::uint8_t> rgba;  // 4 * width * height, row-major; RGB is 0 where A is 0; A = mask coverage, 0..255
  std::vector<float> depth;        // width * height, m along z, 0 = none; empty when not loaded
};

struct Table {
  math::Vector3 point = math::Vector3::Zero();
  math::Vector3 normal = math::Vector3::UnitZ();  // unit, world
};

struct Capture {
  Path folder;
  std::string name;
  bool tabletop = false;
  math::Vector3 gravity{0, 0, -9.81};     // world
  double length = 0, diameter = 0;        // m
  std::optional<double> mass;             // kg
  math::Vector3 direction, bending_axis;  // unit, base frame
  std::optional<Table> table;
  std::vector<Camera> cameras;
  std::vector<std::vector<double>> times;  // frame times of each camera, s (all frames, loaded or not)
  std::vector<View> views;                 // sorted by camera, then frame; only the frames asked for
  trajectory::Trajectory base;
  std::uint64_t hash = 0;  // of capture.json, base file and the image files' sizes
  bool has_depth = false;
};

// What a capture may be at most; the reasons stand where it is checked (src/capture/manifest.cpp).
constexpr double kSlowestRate = 0.1, kFastestRate = 1e6;  // frames a second
constexpr int kMostFrames = 1000000;                      // of a camera
constexpr int kMostPixels = 1 << 27;                      // of an image

// Frames [first, last) of every camera, by its own numbering; last < 0: to the end.
struct FrameRange {
  int first = 0, last = -1;
  bool operator==(const FrameRange&) const = default;
};
// "A:B", "A:" or ":B"; empty: all. Throws InputError, which says by `where` whose text it is.
FrameRange read_frame_range(const std::string& text, const std::string& where);
std::string frame_range_text(const FrameRange& range);  // as it is read; empty: all

struct LoadOptions {
  bool images = true;     // false: capture.json and base only
  bool undistort = true;  // false: recorded pixels (evaluation)
  bool depth = false;
  bool masked = true;        // false: whole frames, RGB as recorded, A = 255; masks are not looked for (to make them)
  int margin = 24;           // px around the mask's bounds
  int first = 0, last = -1;  // frames [first, last), last < 0: to the end (of each camera, by its own numbering)
  std::string camera;        // only this one (`cameras` then holds it alone, at index 0); empty: all
};

// Loads and checks. `path` is the folder or its capture.json. Throws InputError; unknown keys and other doubts warn.
Capture load(const Path& path, const LoadOptions& options = {});

// Nothing that a capture names may lie outside its folder. Where a symbolic link on the way to `file`, which is named in
// `folder`, leads out of it: which one and where to, in words; else empty. The folder itself may be reached by links.
std::string link_out_of(const Path& folder, const Path& file);

// One camera object as in capture.json, alone in a file: what is needed of a camera whose frames come from elsewhere.
struct Calibration {
  Camera camera;
  double rate = 0.0;   // frames a second; 0: not given
  double start = 0.0;  // s, of the first frame
};
// Throws InputError; unknown keys and other doubts warn.
Calibration read_calibration(const Path& file);

// What evaluation compares with: recorded pixels, and depth where the capture has it. `loaded` came from the same path
// and options; where no camera has lens distortion it shows these pixels already, and nothing is decoded again.
Capture load_recorded(Capture loaded, const Path& path, LoadOptions options = {});

// The text and the verdict of `chainsplat check`. `problems` would make load() throw, `doubts` are warnings.
struct CheckReport {
  std::vector<std::string> facts, doubts, problems;
};
CheckReport check(const Path& path);

// truth/centreline.csv of a synthetic capture, for evaluation only: at every time, points x 3 (columns are points).
struct TrueCenterline {
  std::vector<double> time;
  std::vector<math::MatrixX> points;  // 3 x count, equally spaced in arclength from the grasp to the free end
};
std::optional<TrueCenterline> load_true_centerline(const Path& capture_folder);

// 8-bit PNG / float EXR in and out through OpenImageIO. Pixels row-major, interleaved.
struct Image8 {
  int width = 0, height = 0, channels = 0;
  std::vector<std::uint8_t> pixels;
};
Image8 read_image8(const Path& file);
void write_png(const Path& file, const Image8& image);
void write_depth_exr(const Path& file, int width, int height, const std::vector<float>& meters);
// 16-bit, value x scale = m; 0 = none (what is <= 0 or does not fit).
void write_depth_png(const Path& file, int width, int height, const std::vector<float>& meters, double scale);

// H.264 mp4 through libav (MPEG-4 part 2 where libx264 is missing), yuv420p (odd sizes: yuv444p), BT.601 limited range,
// tagged. Frames RGB or RGBA of one size. The same frames give the same bytes.
void write_video(const Path& file, double rate, const std::vector<Image8>& frames);

// Decodes a video frame by frame, in display order. Colors: swscale's default bicubic, matrix and range from the
// stream's tags, else BT.601 limited. Throws InputError (missing, not a video, a frame that cannot be decoded).
struct DeviceFormat {  // asked of a camera; 0: its own choice
  int width = 0, height = 0;
  double rate = 0.0;  // frames a second
};

class VideoReader {
 public:
  // A file or pipe (MP4, MOV, MKV, WebM, AVI, MPEG, Ogg, FLV, ASF, or a bare stream of H.264, HEVC, AV1, MJPEG or
  // Y4M: nothing that names further files), or the camera behind a character device (V4L2), of which `format` is asked. Of a camera every frame
  // is the newest: those that came meanwhile are passed over, and so are damaged ones. next() throws WorkError when it
  // disappears or is silent for 5 s, Interrupted when a stop is requested while it waits.
  explicit VideoReader(const Path& file, int threads = 1, const DeviceFormat& format = {});
  ~VideoReader();
  VideoReader(VideoReader&&) noexcept;
  VideoReader& operator=(VideoReader&&) noexcept;
  bool next(Image8& rgb);     // false at the end; reuses the memory of `rgb`
  bool skip();                // the same without the conversion to RGB
  bool device() const;        // a camera, not a recording
  int frames() const;         // that came so far, with those that were passed over
  double rate() const;        // mean frames a second that the stream claims, 0 when unknown
  double time() const;        // s, of the last frame by the stream's clock; NaN when it has none
  double first_time() const;  // s, of a camera's first frame, which may have been passed over

 private:
  struct Implementation;
  std::unique_ptr<Implementation> implementation_;
};

// What the container says, without decoding.
struct VideoFacts {
  int width = 0, height = 0, frames = 0;
  double rate = 0.0;  // mean frames a second, 0 when unknown
};
VideoFacts video_facts(const Path& file);

}  // namespace chainsplat::capture
