// chainsplat/capture.h - a recording of a rope: cameras, object-masked image crops, depth and base trajectory
// (formats.md 1). It is where the data flow begins: a folder or a live camera in, checked and masked views out.
//
// Everything downstream works on crops, because a rope covers 1-3 % of an image. Loading masks the images (black
// outside the object), optionally undistorts them once, and crops every view to its mask's bounds plus a margin.
// Lengths are in meters, times in seconds, image positions in pixels; the world frame is the capture's own.
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
  std::array<double, 5> distortion{};     // OpenCV's k1 k2 p1 p2 k3
  math::Pose world_from_camera;
  // s, from reading the first row to reading the last one, all rows evenly; negative where the last row comes first; 0:
  // all at once
  double readout = 0.0;
  // recorded = gain * color + bias of red, green and blue, colors in 0..1, as corrections say (formats.md 2.1.1)
  math::Vector3 gain = math::Vector3::Ones(), bias = math::Vector3::Zero();
  double mask_offset = 0.0;  // px, by which its masks are wider than the rope on each side, as corrections say
  bool distorted() const;
};

// Returns the undistorted pixel of a point in the camera frame, by the pinhole model.
math::Vector2 project(const Camera& camera, const math::Vector3& camera_point);
// Return the recorded (distorted) pixel of an undistorted pixel, and the inverse (by fixed-point iteration to 1e-9 px).
math::Vector2 distort(const Camera& camera, const math::Vector2& undistorted_pixel);
math::Vector2 undistort(const Camera& camera, const math::Vector2& recorded_pixel);

// What the pixels of a picture are: with the lens distortion taken out, or as the camera recorded them.
enum class Pixels { undistorted, recorded };

// Which image of which camera, and the crop of it: pixel (0,0) of the crop is pixel (x0, y0) of the image.
struct ViewPlace {
  int camera = 0;     // index into Capture::cameras
  int frame = 0;      // the camera's frame number
  double time = 0.0;  // s, when its middle row was read
  int x0 = 0, y0 = 0, width = 0, height = 0;
};

struct View : ViewPlace {
  std::vector<std::uint8_t> rgba;  // 4 * width * height, row-major; RGB is 0 where A is 0; A = mask coverage, 0..255
  std::vector<float> depth;        // width * height, m along the camera's z, 0 = none; empty when not loaded
};

// A view as a capture keeps it: without the black pixels, which are nearly all of a long rope's crop.
struct PackedView : ViewPlace {
  std::vector<std::uint16_t> runs;  // row-major, by turns: how many pixels are black, how many follow that are not
  std::vector<std::uint8_t> rgba;   // 4 a pixel, of those that are not black
  std::vector<float> depth;         // of the same pixels; empty when not loaded
};
PackedView packed(const View& view);  // depth is lost where the view is black
View unpacked(const PackedView& view);
bool shows_object(const PackedView& view);  // whether its mask has a pixel

struct Table {
  math::Vector3 point = math::Vector3::Zero();    // on the surface, world frame, m
  math::Vector3 normal = math::Vector3::UnitZ();  // upward, unit, world frame
};

// How sure one thing that a capture gives is: one standard deviation in the unit of capture::corrected_quantities(),
// of each number; 0: it is exact.
struct GivenSigma {
  std::string subject;  // a camera's name, "base", "grasp" or "object"
  std::string quantity;
  double deviation = 0.0;
};

// What hangs at the free end: kg, and its standard deviation; and how far it reaches on from there, m (none: not
// known).
struct Payload {
  double mass = 0.0, sigma = 0.0;
  std::optional<double> length = {};
};

struct Capture {
  Path folder;
  std::string name;
  bool tabletop = false;
  math::Vector3 gravity{0, 0, -9.81};     // world frame, m/s^2
  double length = 0, diameter = 0;        // m
  std::optional<double> mass;             // kg, of the rope without its payload
  std::optional<Payload> payload;         // none: not known to be there, nor to be absent
  math::Vector3 direction, bending_axis;  // unit, base frame
  std::optional<Table> table;
  std::vector<Camera> cameras;
  // s, by camera when the middle row of each frame was read (of all frames, loaded or not)
  std::vector<std::vector<double>> times;
  std::vector<PackedView> views;           // sorted by camera, then frame; only the frames asked for
  std::vector<PackedView> recorded;        // LoadOptions::recorded_too; empty: not kept
  // Views that show what the one before shows although the base moved on: their masks are empty.
  std::vector<ViewPlace> repeated;
  Pixels pixels = Pixels::undistorted;  // of the views
  trajectory::Trajectory base;
  std::vector<GivenSigma> sigma;  // where the capture says so; else what corrected_quantities() says
  std::uint64_t hash = 0;         // of capture.json, the base file and the sizes of the image and mask files
  bool has_depth = false;
};

// Frames of several cameras that belong to one moment: of each camera the one that is nearest in time, unless it is
// more than half the interval between moments away. A frame in the middle between two moments belongs to both.
double moment_reach(const std::vector<double>& moments);  // s, that half; infinite for a single moment
// By moment the index of its frame among those at `times`, -1: none. `moments` increase; all in s.
std::vector<int> frames_at(const std::vector<double>& moments, const std::vector<double>& times, double reach);
double frame_interval(const Capture& capture, int camera);  // s, the median; 0 of a single frame
// By moment the indices of its views in Capture::views, camera by camera.
std::vector<std::vector<int>> views_at(const Capture& capture, const std::vector<double>& moments);

// Bounds of a capture; the reasons are given where they are checked (src/capture/manifest.cpp).
constexpr double kSlowestRate = 0.1, kFastestRate = 1e6;  // frames per second
constexpr int kMostFrames = 1000000;                      // per camera
constexpr int kMostPixels = 1 << 27;                      // per image
constexpr double kLongestReadout = 0.2;                   // s

// Frames [first, last) of every camera, by its own numbering; last < 0: to the end.
struct FrameRange {
  int first = 0, last = -1;
  bool operator==(const FrameRange&) const = default;
};
// "A:B", "A:" or ":B"; empty: all. Throws InputError, which says by `where` whose text it is.
FrameRange read_frame_range(const std::string& text, const std::string& where);
std::string frame_range_text(const FrameRange& range);  // as it is read; empty: all

struct LoadOptions {
  bool images = true;                   // false: read capture.json and the base only
  Pixels pixels = Pixels::undistorted;  // recorded: for evaluation
  bool depth = false;
  // Undistorted views without depth, and beside them, in Capture::recorded, the same frames as they were recorded, with
  // depth: what training and its evaluation need, read once. Not of so many pixels that memory would be the worse
  // price.
  bool recorded_too = false;
  int margin = 24;           // px around the mask's bounds
  int first = 0, last = -1;  // frames [first, last) of each camera, by its own numbering; last < 0: to the end
  std::string camera;        // load only this one (`cameras` then holds it alone, at index 0); empty: all
};

// Loads and checks a capture. `path` is the folder or its capture.json. Throws InputError at a problem; unknown keys
// and other doubts are warned of.
Capture load(const Path& path, const LoadOptions& options = {});
// A number that changes when capture.json or a file that it names does: of texts, sizes and times of change. Throws as
// load(), without looking into pictures.
std::uint64_t stamp(const Path& path);
// Throws InputError unless the views have such pixels. Where no camera has lens distortion both are the same.
void require_pixels(const Capture& capture, Pixels pixels);

// Nothing that a capture names may lie outside its folder. Where a symbolic link on the way to `file`, which is named
// in `folder`, leads out of it, returns in words which link and where to; else an empty text. The folder itself may be
// reached by links.
std::string link_out_of(const Path& folder, const Path& file);

// One camera object as in capture.json, alone in a file, for a camera whose frames come from elsewhere.
struct Calibration {
  Camera camera;
  double rate = 0.0;   // frames per second; 0: unspecified
  double start = 0.0;  // s, time of the first frame
};
// Reads a calibration, or the one camera of a whole capture.json. Throws InputError; unknown keys and other doubts are
// warned of.
Calibration read_calibration(const Path& file);

// Returns the views for evaluation: recorded pixels, and depth where the capture has it. `loaded` must come from the
// same path and options; where it holds the recorded views, nothing is read, and where no camera has lens distortion,
// only depth.
Capture load_recorded(Capture loaded, const Path& path, LoadOptions options = {});

// The findings of `chainsplat check`: `problems` would make load() throw, `doubts` are warnings.
struct CheckReport {
  std::vector<std::string> facts, doubts, problems;
  bool poses_doubted = false;  // one of the doubts is about where cameras and gripper are
};
CheckReport check(const Path& path);

// The true centerline (truth/centreline.csv) of a synthetic capture, in the world frame, for evaluation only.
struct TrueCenterline {
  std::vector<double> time;           // s
  std::vector<math::MatrixX> points;  // m, one 3 x count per time, equally spaced in arclength, grasp to free end
};
// Returns none where the capture has no truth. Throws InputError for a malformed file.
std::optional<TrueCenterline> load_true_centerline(const Path& capture_folder);

// An image of 8 bits per channel. Pixels are row-major and interleaved. Images are read and written with OpenImageIO;
// readers throw InputError, writers WorkError.
struct Image8 {
  int width = 0, height = 0, channels = 0;
  std::vector<std::uint8_t> pixels;
};
Image8 read_image8(const Path& file);
Image8 rgb(const View& view);  // of its crop
// A frame that is in memory already, as a view: the undistorted crop of a recorded picture (RGB) about its mask (one
// channel, 128 and more: the object). Where the mask is empty the view is (width 0). `margin`: as in LoadOptions.
// Throws InputError for pictures that are not of the camera's size.
View view_of(const Camera& camera, const Image8& picture, const Image8& mask, int margin = 24);
void write_png(const Path& file, const Image8& image);
void write_depth_exr(const Path& file, int width, int height, const std::vector<float>& meters);
// Writes 16-bit values, value x scale = m; 0 stands for none (depths that are <= 0 or do not fit).
void write_depth_png(const Path& file, int width, int height, const std::vector<float>& meters, double scale);

// Writes RGB or RGBA frames of one size as H.264 in MP4 with libav (as MPEG-4 part 2 where libx264 is missing), yuv420p
// (yuv444p for odd sizes), tagged as BT.601 limited range. The same frames give the same bytes. Throws WorkError.
void write_video(const Path& file, double rate, const std::vector<Image8>& frames);

// The format requested from a camera, where 0 leaves the choice to the camera, and the size of bare frames.
struct DeviceFormat {
  int width = 0, height = 0;
  double rate = 0.0;  // frames per second
};

// Frames one by one in display order: of a video with libav (MP4, MOV, MKV, WebM, AVI, MPEG, Ogg, FLV, ASF, or a bare
// stream of H.264, HEVC, AV1 or MJPEG, but nothing that names further files; swscale's bicubic default, matrix and
// range from the stream's tags, else BT.601 limited), of Y4M or of a camera. Throws InputError where it is missing or
// damaged.
class VideoReader {
 public:
  // A file or pipe, which is Y4M by its first bytes, the camera behind a character device (V4L2), from which `format`
  // is requested, or `-`, standard input: Y4M or bare RGB24 of the format's size. From a camera each call gets the
  // newest frame: frames that arrived in between are skipped, and so are damaged ones. next() then throws WorkError
  // when the camera disappears or has no good frame for 5 s. Of all but videos it throws Interrupted when a stop is
  // requested while it waits. Y4M keeps chroma in blocks, by BT.601 in the range that it names, else limited.
  explicit VideoReader(const Path& file, int threads = 1, const DeviceFormat& format = {});
  ~VideoReader();
  VideoReader(VideoReader&&) noexcept;
  VideoReader& operator=(VideoReader&&) noexcept;
  bool next(Image8& rgb);     // returns false at the end; reuses the memory of `rgb`
  bool skip();                // as next(), without the conversion to RGB
  bool device() const;        // whether it is a camera, not a recording
  int frames() const;         // number of frames so far, a camera's skipped ones included
  double rate() const;        // mean frames per second by the stream's header, 0 when unknown
  double time() const;        // s, of the last frame by the stream's clock; NaN when it has none
  double first_time() const;  // s, of a camera's first frame, which may have been skipped; else NaN

 private:
  struct Implementation;
  std::unique_ptr<Implementation> implementation_;
};

// A whole picture of one camera.
struct Frame {
  int frame = 0;      // the camera's frame number
  double time = 0.0;  // s, by capture.json
  Image8 picture;     // RGB
};

// Reads the whole frames of one camera of a capture, one after the other, however long it is; masks are not read.
class FrameReader {
 public:
  // `capture`: the folder or its capture.json; `camera`: its name; `frames`: end where the recording ends. Throws
  // InputError, as next() does where a frame cannot be read.
  FrameReader(const Path& capture, const std::string& camera, const FrameRange& frames, Pixels pixels);
  ~FrameReader();
  FrameReader(FrameReader&&) noexcept;
  FrameReader& operator=(FrameReader&&) noexcept;
  std::optional<Frame> next();  // none at the end

 private:
  struct Implementation;
  std::unique_ptr<Implementation> implementation_;
};

// Properties of a video that its container gives without decoding.
struct VideoFacts {
  int width = 0, height = 0, frames = 0;
  double rate = 0.0;  // mean frames per second, 0 when unknown
};
// Counts at most kMostFrames + 1 frames. Throws InputError.
VideoFacts video_facts(const Path& file);

}  // namespace chainsplat::capture
