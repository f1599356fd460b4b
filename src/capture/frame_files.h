// src/capture/frame_files.h - the files that a capture names: found, counted and timed, but none is decoded.
#pragma once
#include <optional>
#include <string>

#include "src/capture/manifest.h"
#include "src/capture/object_reader.h"

namespace chainsplat::capture {

bool is_file(const Path& file);
// Throws InputError unless `file` is a regular file, because reading a pipe or a device might never end.
void require_file(const Path& file);
// The same for a file that a capture names, which must also lie in its folder.
void require_own_file(const Path& folder, const Path& file);

// Reads 'cam0.mp4' as a video and 'cam0/%06d.png' as a pattern of image files; none and a problem for anything else.
std::optional<ImageSource> image_source(const ObjectReader& reader, const std::string& key, const Path& folder,
                                        bool required);

// Counts the frames of all cameras and sets their times. `masked` false: mask files are ignored.
void survey_frames(Manifest& manifest, bool masked, Findings& findings);

}  // namespace chainsplat::capture
