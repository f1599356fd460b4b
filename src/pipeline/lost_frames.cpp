#include "pipeline/lost_frames.h"

#include <algorithm>
#include <cstdio>

#include "chainsplat/correction_fit.h"

namespace chainsplat::pipeline {

namespace {

constexpr int kMostLost = 30;         // frames of all cameras
constexpr std::ptrdiff_t kTried = 3;  // places where one may be lost, before it is taken that none is
// Where the outlines' mean square over all frames is more than so many times that of the median frame, some lost frame
// was missed or restored in the wrong place.
constexpr double kAllFound = 3.0;
constexpr Eigen::Index kSurelyLost = 1;  // of one camera: where it lost more, some are missed or a few frames off

// Frames that cameras lost, and what outlines show where these alone are restored.
struct Restored {
  std::vector<silhouette::LostFrame> lost;
  silhouette::SequenceFit sequence;
  silhouette::LostFrames found;
};
// Changes the times of `capture` and puts them back: a copy with all its pictures would double the memory that a long
// recording needs.
Restored restored(const chain::Chain& chain, capture::Capture& capture, std::vector<silhouette::LostFrame> lost) {
  const std::vector<std::vector<double>> times = capture.times;
  std::vector<double> of_views;
  for (const capture::PackedView& view : capture.views) of_views.push_back(view.time);
  for (const silhouette::LostFrame& one : lost)
    capture::restore_lost(math::VectorX::Constant(1, one.frame), one.camera, capture);
  silhouette::SequenceFit sequence = silhouette::fit_sequence(chain, capture);
  silhouette::LostFrames found = silhouette::find_lost_frames(chain, capture, sequence);
  capture.times = times;
  for (std::size_t v = 0; v < of_views.size(); ++v) capture.views[v].time = of_views[v];
  return {std::move(lost), std::move(sequence), std::move(found)};
}

// Takes it where the outlines fit better.
bool improve(Restored& now, Restored other) {
  if (!(other.found.misfit < now.found.misfit)) return false;
  now = std::move(other);
  return true;
}

// One more, the likeliest that makes the outlines fit better.
bool add_lost_frame(const chain::Chain& chain, capture::Capture& capture, Restored& now) {
  const std::vector<silhouette::LostFrame> likely = now.found.likely;
  const auto last = likely.begin() + std::min<std::ptrdiff_t>(kTried, std::ssize(likely));
  return std::any_of(likely.begin(), last, [&](const silhouette::LostFrame& one) {
    std::vector<silhouette::LostFrame> lost = now.lost;
    lost.push_back(one);
    return improve(now, restored(chain, capture, std::move(lost)));
  });
}

// Moves each to where the outlines show it once the others are restored: before, they hid it.
void move_lost_frames(const chain::Chain& chain, capture::Capture& capture, Restored& now) {
  for (std::size_t i = 0; i < now.lost.size(); ++i) {
    std::vector<silhouette::LostFrame> others = now.lost;
    others.erase(others.begin() + static_cast<std::ptrdiff_t>(i));
    const Restored without = restored(chain, capture, others);
    std::ptrdiff_t tried = 0;
    for (const silhouette::LostFrame& one : without.found.likely) {
      if (one.camera != now.lost[i].camera || one.frame == now.lost[i].frame) continue;
      std::vector<silhouette::LostFrame> lost = others;
      lost.insert(lost.begin() + static_cast<std::ptrdiff_t>(i), one);
      if (improve(now, restored(chain, capture, std::move(lost))) || ++tried == kTried) break;
    }
  }
}

// Mean square distance of the outlines of a frame, px^2, in the median.
double usual_misfit(const silhouette::SequenceFit& sequence) {
  std::vector<double> squares;
  for (const silhouette::FrameFit& frame : sequence.frames)
    if (frame.residual_pixels > 0.0) squares.push_back(frame.residual_pixels * frame.residual_pixels);
  return squares.empty() ? 0.0 : math::median(squares);
}

}  // namespace

capture::Corrections restore_lost_frames(const chain::Chain& chain, capture::Capture& capture,
                                         silhouette::SequenceFit& sequence, std::vector<capture::Finding>& verdict) {
  if (capture.cameras.size() < 2) return {};
  silhouette::LostFrames found = silhouette::find_lost_frames(chain, capture, sequence);
  Restored now{{}, std::move(sequence), std::move(found)};
  for (int count = 0; count < kMostLost && add_lost_frame(chain, capture, now); ++count) continue;
  move_lost_frames(chain, capture, now);
  sequence = std::move(now.sequence);
  const bool all_found = now.found.misfit <= kAllFound * usual_misfit(sequence);
  std::vector<std::vector<double>> lost(capture.cameras.size());
  for (const silhouette::LostFrame& one : now.lost) lost[one.camera].push_back(one.frame);
  capture::Corrections out;
  for (std::size_t c = 0; c < lost.size(); ++c) {
    if (lost[c].empty()) continue;
    std::sort(lost[c].begin(), lost[c].end());
    capture::Correction correction;
    correction.quantity = &capture::lost_frames();
    correction.subject = capture.cameras[c].name;
    correction.value = Eigen::Map<math::VectorX>(lost[c].data(), static_cast<Eigen::Index>(lost[c].size()));
    correction.deviation = math::VectorX::Zero(correction.value.size());
    correction.calibration = capture::hash_text(capture.hash);
    capture::restore_lost(correction.value, static_cast<int>(c), capture);
    const auto count = correction.value.size();
    const int first = static_cast<int>(lost[c].front());
    const bool sure = count <= kSurelyLost && all_found;
    char many[32] = "a frame", text[240];
    if (count > 1) std::snprintf(many, sizeof many, "%d frames, one", static_cast<int>(count));
    std::snprintf(
        text, sizeof text,
        "%s lost %s before frame %d, so that its stamps are early from there on: corrected; give the stamps of "
        "its frames (`timestamps`)%s",
        correction.subject.c_str(), many, first, sure ? "" : "; some may be missed, do not trust it");
    verdict.push_back(
        {"lost-frames", correction.subject, static_cast<double>(count), 0.0, "frames", true, sure, false, first, text});
    out.push_back(std::move(correction));
  }
  return out;
}

}  // namespace chainsplat::pipeline
