// src/calibration/look.h - from videos to views of the board: which frames are looked at, and which of them are used.
#pragma once
#include <map>
#include <string>
#include <vector>

#include "bundle.h"
#include "chainsplat/media.h"
#include "tags.h"

namespace chainsplat::calibration {

struct Frame {  // in which the board was found
  int frame = 0;
  double time = 0.0;  // s, by the camera's clock
  std::vector<Tag> tags;
};

struct Recording {
  std::string name;
  importing::Media media;
  std::vector<double> times;  // s, of all frames
  bool stamped = false;       // the times were recorded, not counted
  double interval = 0.0;      // s, between two frames, the median
  int looked = 0;
  std::vector<Frame> seen;
};

// Opens a camera's frames and their times; adds a sentence to `notes`. Throws InputError.
Recording open_recording(const CameraRequest& request, const std::string& time_unit, double origin,
                         std::vector<std::string>& notes);

// Looks for the board in at most kMostLooked frames of each, at the same times in all where they have them. Throws
// InputError for a camera that never sees it, with what it sees instead.
constexpr int kMostLooked = 450;
void look(std::vector<Recording>& recordings, const Board& board);

// The views of each camera that differ enough from the one before, for a robot's motion.
std::vector<View> thinned(const Recording& recording, int camera);
// Views of several cameras at one time, in the order of time: views that lie within half of `interval` are one moment.
// `clocks` are added to their times.
std::vector<Moment> grouped(std::vector<View> views, const std::vector<double>& clocks, double interval);
// Without a robot: moments in which the board is as still as possible, each unlike the others. The first view of the
// first camera is among them.
std::vector<Moment> chosen(const std::vector<Recording>& recordings);

// The corners of a view by the edges of its frame's tags, with this lens.
void set_corners(View& view, const Recording& recording, const Board& board, const capture::Camera& lens);

}  // namespace chainsplat::calibration
