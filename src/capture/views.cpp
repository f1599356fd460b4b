// Decoding, masking, undistorting and cropping: from the files of a capture to its views.
#include <algorithm>
#include <cmath>
#include <tuple>
#include <utility>

#include "chainsplat/image_model.h"
#include "chainsplat/rectangle.h"
#include "image_files.h"
#include "manifest.h"
#include "packed_view.h"
#include "pictures.h"

namespace chainsplat::capture {

using math::Rectangle;
using math::Vector2;

namespace {

// Without masks, pixels brighter than this in any channel are the object. Lossy coding does not keep black at 0.
constexpr std::uint8_t kBlackLossless = 0, kBlackLossy = 16;
constexpr double kMostCovered = 0.5;  // share of an image; more means that nothing was masked

// Pixels of all frames together up to which they are kept both undistorted and as recorded: beyond, a rope that covers
// a fiftieth of them takes 160 MB.
constexpr double kMostKept = 1e9;

using Bytes = std::vector<std::uint8_t>;

// First and last frame, [first, last), of a camera that are asked for.
std::pair<int, int> frames_of(const CameraSource& source, const LoadOptions& options) {
  const int last = options.last < 0 ? source.images.frames : std::min(options.last, source.images.frames);
  return {std::clamp(options.first, 0, last), last};
}

// Returns the bounds of the mask's inside pixels; empty where there are none.
Rectangle bounds_of(const std::uint8_t* mask, int width, int height) {
  Rectangle bounds{width, height, 0, 0};
  const auto inside = [](std::uint8_t value) { return value >= image_model::kObjectMask; };
  for (int y = 0; y < height; ++y) {
    const std::uint8_t* const row = mask + static_cast<std::size_t>(y) * width;
    const std::uint8_t* const first = std::find_if(row, row + width, inside);
    if (first == row + width) continue;
    int last = width;
    while (!inside(row[last - 1])) --last;
    bounds.x0 = std::min(bounds.x0, static_cast<int>(first - row));
    bounds.x1 = std::max(bounds.x1, last);
    bounds.y0 = std::min(bounds.y0, y);
    bounds.y1 = y + 1;
  }
  return bounds;
}

bool recorded(const Camera& camera, const Vector2& position) {
  return position.x() >= 0 && position.y() >= 0 && position.x() <= camera.width && position.y() <= camera.height;
}

// Returns a rectangle of undistorted pixels that holds all that the recorded rectangle shows. Undistorting the border
// suffices, because it maps to the border.
Rectangle undistorted_bounds(const Camera& camera, const Rectangle& bounds) {
  constexpr int kStep = 8;   // px between points of the border
  constexpr int kSlack = 2;  // px, for the curve between the points and the bilinear footprint
  Vector2 low(1e9, 1e9), high(-1e9, -1e9);
  const auto include = [&](double x, double y) {
    const Vector2 p = undistort(camera, {x, y});
    low = low.cwiseMin(p);
    high = high.cwiseMax(p);
  };
  for (int x = bounds.x0; x < bounds.x1 + kStep; x += kStep)
    for (const int y : {bounds.y0, bounds.y1}) include(std::min(x, bounds.x1), y);
  for (int y = bounds.y0; y < bounds.y1 + kStep; y += kStep)
    for (const int x : {bounds.x0, bounds.x1}) include(x, std::min(y, bounds.y1));
  const auto whole = [](double value, int size) {
    return static_cast<int>(std::clamp(value, 0.0, static_cast<double>(size)));
  };
  return {whole(std::floor(low.x()) - kSlack, camera.width), whole(std::floor(low.y()) - kSlack, camera.height),
          whole(std::ceil(high.x()) + kSlack, camera.width), whole(std::ceil(high.y()) + kSlack, camera.height)};
}

// Sets the view's crop and alpha from the full mask in recorded pixels; an empty mask leaves the view empty.
void cut_mask(PackedView& view, const Camera& camera, const Bytes& mask, bool undistorting, int margin) {
  Rectangle bounds = bounds_of(mask.data(), camera.width, camera.height);
  if (bounds.empty()) return;
  // undistort the mask where it may be inside
  Bytes straight;  // the undistorted mask inside `region`
  Rectangle region;
  if (undistorting) {
    region = undistorted_bounds(camera, bounds);
    const int width = region.x1 - region.x0, height = region.y1 - region.y0;
    if (region.empty()) return;
    straight.assign(static_cast<std::size_t>(width) * height, 0);
    for (int y = 0; y < height; ++y)
      for (int x = 0; x < width; ++x) {
        const Vector2 position = distort(camera, center(region.x0 + x, region.y0 + y));
        if (recorded(camera, position) &&
            sample(mask.data(), camera.width, camera.height, 1, 0, position) >= image_model::kObjectMask)
          straight[static_cast<std::size_t>(y) * width + x] = 255;
      }
    bounds = bounds_of(straight.data(), width, height);
    if (bounds.empty()) return;
    bounds = {bounds.x0 + region.x0, bounds.y0 + region.y0, bounds.x1 + region.x0, bounds.y1 + region.y0};
  }
  // crop with a margin and set alpha
  const Rectangle crop = intersection(grown(bounds, margin), {0, 0, camera.width, camera.height});
  view.x0 = crop.x0;
  view.y0 = crop.y0;
  view.width = crop.x1 - crop.x0;
  view.height = crop.y1 - crop.y0;
  set_runs(view, [&](int x, int y) {
    x += crop.x0, y += crop.y0;
    if (x < bounds.x0 || y < bounds.y0 || x >= bounds.x1 || y >= bounds.y1) return false;
    return undistorting
               ? straight[static_cast<std::size_t>(y - region.y0) * (region.x1 - region.x0) + x - region.x0] != 0
               : mask[static_cast<std::size_t>(y) * camera.width + x] >= image_model::kObjectMask;
  });
  for (std::size_t i = 3; i < view.rgba.size(); i += 4) view.rgba[i] = 255;
}

// Sets the colors of the pixels inside the mask. They are sampled from the unmasked image, so that edges are not
// darkened.
void fill_color(PackedView& view, const Camera& camera, const Bytes& rgb, bool undistorting) {
  std::uint8_t* out = view.rgba.data();
  each_pixel(view, [&](int x, int y) {
    if (undistorting)
      straight_color(camera, rgb, view.x0 + x, view.y0 + y, out);
    else
      std::copy_n(&rgb[3 * (static_cast<std::size_t>(view.y0 + y) * camera.width + view.x0 + x)], 3, out);
    out += 4;
  });
}

// Sets the depth from the nearest recorded pixel, because depth must not be blended across edges.
void fill_depth(PackedView& view, const Camera& camera, const std::vector<float>& depth, bool undistorting) {
  view.depth.assign(view.rgba.size() / 4, 0.0f);
  float* out = view.depth.data();
  each_pixel(view, [&](int x, int y) {
    Vector2 position = center(view.x0 + x, view.y0 + y);
    if (undistorting) position = distort(camera, position);
    const int column = static_cast<int>(std::floor(position.x())), row = static_cast<int>(std::floor(position.y()));
    const bool inside = column >= 0 && row >= 0 && column < camera.width && row < camera.height;
    *out++ = inside ? depth[static_cast<std::size_t>(row) * camera.width + column] : 0.0f;
  });
}

Bytes gray_of(const Image8& rgb) {
  Bytes gray(rgb.pixels.size() / 3);
  for (std::size_t i = 0; i < gray.size(); ++i)
    gray[i] = static_cast<std::uint8_t>((rgb.pixels[3 * i] + rgb.pixels[3 * i + 1] + rgb.pixels[3 * i + 2]) / 3);
  return gray;
}

Bytes bright(const Bytes& rgb, std::uint8_t black) {
  Bytes mask(rgb.size() / 3);
  for (std::size_t i = 0; i < mask.size(); ++i)
    mask[i] = std::max({rgb[3 * i], rgb[3 * i + 1], rgb[3 * i + 2]}) > black ? 255 : 0;
  return mask;
}

// The views that are made of the frames [first, last) of a camera.
struct Range {
  int first = 0, last = 0;
  bool undistorting = false;
  PackedView* views = nullptr;
  PackedView* recorded = nullptr;  // the same without undistorting; null: not asked for
};

// Calls `set(view, undistorting)` for each view that is made of a frame.
template <class Set>
void for_views(const Range& range, int frame, Set&& set) {
  set(range.views[frame - range.first], range.undistorting);
  if (range.recorded) set(range.recorded[frame - range.first], false);
}

void cut_masks(const Range& range, int frame, const Camera& camera, const Bytes& mask, int margin) {
  for_views(range, frame,
            [&](PackedView& view, bool undistorting) { cut_mask(view, camera, mask, undistorting, margin); });
}

void fill_colors(const Range& range, int frame, const Camera& camera, const Bytes& rgb) {
  for_views(range, frame, [&](PackedView& view, bool undistorting) { fill_color(view, camera, rgb, undistorting); });
}

// Loads the frames of one camera whose images are a video. Where masks are image files, they have been read before.
void load_video_frames(const CameraSource& source, const LoadOptions& options, const Range& range, int threads) {
  const Camera& camera = source.camera;
  const int first = range.first;
  VideoReader images(source.images.file, threads);
  skip_frames(source.images, first, images);
  std::optional<VideoReader> masks;
  if (source.masks && source.masks->video) {
    masks.emplace(source.masks->file, threads);
    skip_frames(*source.masks, first, *masks);
  }
  Image8 image, mask;
  for (int k = first; k < range.last; ++k) {
    next_frame(source, source.images, k, images, image);
    if (masks) {
      next_frame(source, *source.masks, k, *masks, mask);
      cut_masks(range, k, camera, gray_of(mask), options.margin);
    } else if (!source.masks) {
      cut_masks(range, k, camera, bright(image.pixels, kBlackLossy), options.margin);
    }
    fill_colors(range, k, camera, image.pixels);
  }
}

// The same for the masks alone, where they are a video and the images are not.
void load_mask_video(const CameraSource& source, const LoadOptions& options, const Range& range, int threads) {
  VideoReader masks(source.masks->file, threads);
  skip_frames(*source.masks, range.first, masks);
  Image8 mask;
  for (int k = range.first; k < range.last; ++k) {
    next_frame(source, *source.masks, k, masks, mask);
    cut_masks(range, k, source.camera, gray_of(mask), options.margin);
  }
}

bool lossless(const ImageSource& images) {
  if (images.pictures) return true;
  const std::string& ending = images.names.after;
  return ending.ends_with(".png") || ending.ends_with(".PNG") || ending.ends_with(".bmp") || ending.ends_with(".tif") ||
         ending.ends_with(".tiff");
}

// Views of the frames of all cameras that are asked for, which are empty yet.
std::vector<PackedView> empty_views(const Manifest& manifest, const LoadOptions& options) {
  std::vector<PackedView> views;
  for (int c = 0; c < static_cast<int>(manifest.cameras.size()); ++c) {
    const auto [first, last] = frames_of(manifest.cameras[c], options);
    for (int k = first; k < last; ++k) {
      PackedView view;
      view.camera = c;
      view.frame = k;
      view.time = manifest.cameras[c].times[k];
      views.push_back(std::move(view));
    }
  }
  return views;
}

// By camera; `recorded` is empty where it is not asked for.
std::vector<Range> ranges_in(const Manifest& manifest, const LoadOptions& options, std::vector<PackedView>& views,
                             std::vector<PackedView>& recorded) {
  std::vector<Range> ranges;
  std::size_t offset = 0;
  for (const CameraSource& source : manifest.cameras) {
    Range range;
    std::tie(range.first, range.last) = frames_of(source, options);
    range.undistorting = options.pixels == Pixels::undistorted && source.camera.distorted();
    range.views = views.data() + offset;
    if (!recorded.empty()) range.recorded = recorded.data() + offset;
    offset += static_cast<std::size_t>(range.last - range.first);
    ranges.push_back(range);
  }
  return ranges;
}

// The recorded depth, m, as far down as the view reaches.
std::vector<float> depth_of(const CameraSource& source, const PackedView& view, bool undistorting) {
  const Camera& camera = source.camera;
  const int rows = undistorting ? camera.height : std::min(camera.height, view.y0 + view.height);
  return read_depth(source.depth->frame_file(view.frame), camera.width, camera.height, rows, source.depth_scale);
}

// Color, and the mask of images that are masked already, and depth of one frame, as far as they are image files.
void load_frame_files(const CameraSource& source, const LoadOptions& options, const Range& range, int frame) {
  if (!source.images.video) {
    const Bytes rgb = rgb_of(source, frame);
    if (!source.masks)
      cut_masks(range, frame, source.camera, bright(rgb, lossless(source.images) ? kBlackLossless : kBlackLossy),
                options.margin);
    fill_colors(range, frame, source.camera, rgb);
  }
  if (!options.depth || !source.depth) return;
  const bool undistorting = range.undistorting && !range.recorded;  // of both, the recorded one has it
  PackedView& view = (range.recorded ? range.recorded : range.views)[frame - range.first];
  fill_depth(view, source.camera, depth_of(source, view, undistorting), undistorting);
}

// Masks must neither be full nor all empty.
void check_masks(const Manifest& manifest, const CameraSource& source, const Range& range, Findings& findings) {
  if (range.first == range.last) return;
  int visible = 0;
  double covered = 0.0;
  for (int k = range.first; k < range.last; ++k) {
    const PackedView& view = range.views[k - range.first];
    visible += view.width > 0;
    covered += static_cast<double>(view.rgba.size()) / 4.0;
  }
  covered /= static_cast<double>(range.last - range.first) * source.camera.width * source.camera.height;
  if (covered > kMostCovered)
    findings.problems.push_back({source.where + ".masks",
                                 source.masks ? "the masks cover more than half of the image"
                                              : "is missing and the background of the images is not black",
                                 source.masks ? std::string("the object must be 255 and the rest 0")
                                 : manifest.capture.folder.empty()
                                     ? std::string("give masks")
                                     : "make them: chainsplat mask " + manifest.capture.folder.string()});
  if (visible == 0) {
    const std::string what = source.camera.name + " never sees the object: every mask is empty";
    if (range.first == 0 && range.last == source.images.frames)
      findings.problems.push_back({source.where + ".masks", what, "mend the masks or remove the camera"});
    else
      findings.doubts.push_back(source.where + ".masks: " + what + " in the frames asked for");
  }
}

}  // namespace

void load_views(const Manifest& manifest, const LoadOptions& options, Findings& findings,
                std::vector<PackedView>& views, std::vector<PackedView>& recorded) {
  views = empty_views(manifest, options);
  recorded.clear();
  double pixels = 0.0;
  bool distorted = false;
  for (const PackedView& view : views) {
    const Camera& camera = manifest.cameras[view.camera].camera;
    pixels += static_cast<double>(camera.width) * camera.height;
    distorted |= camera.distorted();
  }
  if (options.recorded_too && distorted && options.pixels == Pixels::undistorted && pixels <= kMostKept)
    recorded = empty_views(manifest, options);
  const std::vector<Range> ranges = ranges_in(manifest, options, views, recorded);
  const auto total = static_cast<std::int64_t>(views.size());
  for (const CameraSource& source : manifest.cameras)
    if (!source.masks)
      findings.doubts.push_back(source.where +
                                ".masks: is missing; the images are taken as masked already (black background)");

  // masks from image files come first, because they decide which part of an image is kept
  for_each_in_parallel(total, [&](std::int64_t i) {
    const int camera = views[i].camera, frame = views[i].frame;
    const CameraSource& source = manifest.cameras[camera];
    if (!source.masks || source.masks->video) return;
    cut_masks(ranges[camera], frame, source.camera, mask_of(source, frame), options.margin);
  });
  // videos, with one task per camera; where the cameras do not fill the threads evenly, the decoders use more threads
  // (their output does not depend on the number)
  const int cameras = static_cast<int>(manifest.cameras.size());
  const int even = cameras % core::threads() == 0 ? 1 : 2;
  const int decoder_threads = std::max(even, (core::threads() + cameras - 1) / std::max(1, cameras));
  for_each_in_parallel(cameras, [&](std::int64_t c) {
    const CameraSource& source = manifest.cameras[c];
    const Range& range = ranges[c];
    if (range.first == range.last) return;
    if (source.images.video)
      load_video_frames(source, options, range, decoder_threads);
    else if (source.masks && source.masks->video)
      load_mask_video(source, options, range, decoder_threads);
  });
  for_each_in_parallel(total, [&](std::int64_t i) {
    const int camera = views[i].camera;
    load_frame_files(manifest.cameras[camera], options, ranges[camera], views[i].frame);
  });
  for (int c = 0; c < cameras; ++c) check_masks(manifest, manifest.cameras[c], ranges[c], findings);
}

void add_depth(const Manifest& manifest, std::vector<PackedView>& views) {
  for_each_in_parallel(static_cast<std::int64_t>(views.size()), [&](std::int64_t i) {
    PackedView& view = views[i];
    const CameraSource& source = manifest.cameras[view.camera];
    if (!source.depth || !view.depth.empty()) return;
    constexpr bool kUndistorting = false;
    fill_depth(view, source.camera, depth_of(source, view, kUndistorting), kUndistorting);
  });
}

View view_of(const Camera& camera, const Image8& picture, const Image8& mask, int margin) {
  const auto check = [&](const char* what, const Image8& image, int channels) {
    const std::size_t pixels = static_cast<std::size_t>(camera.width) * camera.height;
    if (image.width == camera.width && image.height == camera.height && image.channels == channels &&
        image.pixels.size() == pixels * channels)
      return;
    throw InputError(what,
                     "is " + std::to_string(image.width) + "x" + std::to_string(image.height) + " pixels of " +
                         std::to_string(image.channels) + " channels, and " + camera.name + " has " +
                         std::to_string(camera.width) + "x" + std::to_string(camera.height) + " of " +
                         std::to_string(channels),
                     "give whole frames as they were recorded");
  };
  check("`picture`", picture, 3);
  check("`mask`", mask, 1);
  PackedView view;
  cut_mask(view, camera, mask.pixels, camera.distorted(), margin);
  fill_color(view, camera, picture.pixels, camera.distorted());
  return unpacked(view);
}

Image8 rgb(const View& view) {
  Image8 out{view.width, view.height, 3, {}};
  out.pixels.reserve(view.rgba.size() / 4 * 3);
  for (std::size_t i = 0; i < view.rgba.size(); i += 4)
    out.pixels.insert(out.pixels.end(), &view.rgba[i], &view.rgba[i] + 3);
  return out;
}

}  // namespace chainsplat::capture
