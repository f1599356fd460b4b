#include <algorithm>

#include "manifest.h"
#include "src/capture/repeated.h"

namespace chainsplat::capture {

void throw_first(const Findings& findings) {
  if (findings.problems.empty()) return;
  const Problem& first = findings.problems.front();
  const std::size_t others = findings.problems.size() - 1;
  throw InputError(first.where, first.what,
                   first.mend + (others ? " (and " + std::to_string(others) + " more: see 'chainsplat check')" : ""));
}

namespace {

bool has_lens(const Capture& capture) {
  return std::any_of(capture.cameras.begin(), capture.cameras.end(), [](const Camera& c) { return c.distorted(); });
}

}  // namespace

void require_pixels(const Capture& capture, Pixels pixels) {
  if (capture.pixels == pixels || !has_lens(capture)) return;
  const bool recorded = pixels == Pixels::recorded;
  throw InputError(
      "`capture`", recorded ? "was loaded without its lens distortion" : "was loaded with its lens distortion",
      std::string("load it with LoadOptions::pixels = Pixels::") + (recorded ? "recorded" : "undistorted"));
}

namespace {

// `source`: a path or a recording in memory.
template <class Source>
Capture load_from(const Source& source, const LoadOptions& options) {
  Findings findings;
  Manifest manifest = read_manifest(source, options.camera, options.images, findings);
  throw_first(findings);
  if (manifest.cameras.size() == 1 && options.camera.empty())
    findings.doubts.push_back(manifest.file.string() + ": cameras: only one; depth along its rays is hardly seen");
  std::vector<PackedView> views, recorded;
  if (options.images) load_views(manifest, options, findings, views, recorded);
  for (const std::string& doubt : findings.doubts) core::warn(doubt);
  throw_first(findings);
  Capture capture = std::move(manifest.capture);
  capture.pixels = options.pixels;
  capture.repeated = empty_repeated(capture, views);
  empty_repeated(capture, recorded);
  capture.views = std::move(views);
  capture.recorded = std::move(recorded);
  return capture;
}

template <class Source>
Capture load_recorded_from(Capture loaded, const Source& source, LoadOptions options) {
  options.pixels = Pixels::recorded;
  options.depth = true;
  options.recorded_too = false;
  if (!loaded.recorded.empty()) {
    loaded.views = std::move(loaded.recorded);
    loaded.recorded.clear();
    loaded.pixels = Pixels::recorded;
    for (PackedView& view : loaded.views) view.time = loaded.times[view.camera][view.frame];
    return loaded;
  }
  if (has_lens(loaded)) {
    // as recorded, but poses, clocks and base are those of `loaded`, which may have been corrected
    Capture recorded = load(source, options);
    recorded.cameras = loaded.cameras;
    recorded.times = loaded.times;
    recorded.base = loaded.base;
    recorded.length = loaded.length;
    recorded.diameter = loaded.diameter;
    for (PackedView& view : recorded.views) view.time = recorded.times[view.camera][view.frame];
    return recorded;
  }
  Findings findings;
  const Manifest manifest = read_manifest(source, options.camera, options.images, findings);
  throw_first(findings);
  add_depth(manifest, loaded.views);
  loaded.pixels = Pixels::recorded;
  return loaded;
}

}  // namespace

Capture load(const Path& path, const LoadOptions& options) { return load_from(path, options); }
Capture load(const InMemory& recording, const LoadOptions& options) { return load_from(recording, options); }

Capture load_recorded(Capture loaded, const Path& path, LoadOptions options) {
  return load_recorded_from(std::move(loaded), path, std::move(options));
}
Capture load_recorded(Capture loaded, const InMemory& recording, LoadOptions options) {
  return load_recorded_from(std::move(loaded), recording, std::move(options));
}

}  // namespace chainsplat::capture
