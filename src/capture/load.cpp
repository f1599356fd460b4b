#include <algorithm>

#include "manifest.h"

namespace chainsplat::capture {

namespace {

// Throws the first problem, if there is one, with the number of the others.
void throw_first(const Findings& findings) {
  if (findings.problems.empty()) return;
  const Problem& first = findings.problems.front();
  const std::size_t others = findings.problems.size() - 1;
  throw InputError(first.where, first.what,
                   first.mend + (others ? " (and " + std::to_string(others) + " more: see 'chainsplat check')" : ""));
}

}  // namespace

Capture load(const Path& path, const LoadOptions& options) {
  Findings findings;
  Manifest manifest = read_manifest(path, options.camera, options.images && options.masked, findings);
  throw_first(findings);
  if (manifest.cameras.size() == 1 && options.camera.empty())
    findings.doubts.push_back(manifest.file.string() + ": cameras: only one; depth along its rays is hardly seen");
  Capture capture = std::move(manifest.capture);
  if (options.images) load_views(manifest, options, findings, capture.views);
  for (const std::string& doubt : findings.doubts) core::warn(doubt);
  throw_first(findings);
  return capture;
}

Capture load_recorded(Capture loaded, const Path& path, LoadOptions options) {
  options.undistort = false;
  options.depth = true;
  if (std::any_of(loaded.cameras.begin(), loaded.cameras.end(), [](const Camera& c) { return c.distorted(); }))
  {
    // as recorded, but poses, clocks and base are those of `loaded`, which may have been corrected
    Capture recorded = load(path, options);
    recorded.cameras = loaded.cameras;
    recorded.times = loaded.times;
    recorded.base = loaded.base;
    recorded.length = loaded.length;
    recorded.diameter = loaded.diameter;
    for (View& view : recorded.views) view.time = recorded.times[view.camera][view.frame];
    return recorded;
  }
  Findings findings;
  const Manifest manifest = read_manifest(path, options.camera, options.images && options.masked, findings);
  throw_first(findings);
  add_depth(manifest, loaded.views);
  return loaded;
}

}  // namespace chainsplat::capture
