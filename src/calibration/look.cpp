#include "look.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "chainsplat/text.h"

namespace chainsplat::calibration {

using math::Vector2;

namespace {

constexpr int kBatch = 32;                              // frames that are held at once
constexpr int kOtherLooks = 12;                         // frames in which other families are sought
constexpr double kMoved = 0.004;                        // of the image's width: less is the same view again
constexpr double kUnlike = 0.02;                        // the same, between any two views without a robot
constexpr std::size_t kMostViews = 250;                 // of a camera
constexpr int kEnough = 20;                             // moments for each camera, before faster motion is let in
constexpr double kStill[] = {0.5, 1.0, 2.0, 4.0, 1e9};  // px from frame to frame

// Mean distance of the tags' corners that both frames have, px; infinite where they have none in common.
double distance(const Frame& a, const Frame& b) {
  double sum = 0.0;
  int count = 0;
  for (const Tag& one : a.tags)
    for (const Tag& other : b.tags)
      if (one.id == other.id) {
        for (int k = 0; k < 4; ++k) sum += (one.rough[k] - other.rough[k]).norm();
        count += 4;
      }
  return count > 0 ? sum / count : std::numeric_limits<double>::infinity();
}

const Frame& frame_of(const Recording& recording, int frame) {
  const auto at = std::lower_bound(recording.seen.begin(), recording.seen.end(), frame,
                                   [](const Frame& f, int number) { return f.frame < number; });
  CHAINSPLAT_CHECK(at != recording.seen.end() && at->frame == frame, std::to_string(frame));
  return *at;
}

// Frames nearest to times that are the same for all cameras.
std::vector<int> frames_to_look_at(const Recording& recording, double first, double step) {
  std::vector<int> frames;
  std::vector<double> away;
  long last = std::numeric_limits<long>::min();
  for (int k = 0; k < recording.media.frames; ++k) {
    const double place = (recording.times[k] - first) / step;
    const long slot = std::lround(place);
    const double off = std::abs(place - static_cast<double>(slot));
    if (slot != last)
      frames.push_back(k), away.push_back(off), last = slot;
    else if (off < away.back())
      frames.back() = k, away.back() = off;
  }
  return frames;
}

std::string list_of(const std::map<int, int>& ids) {
  std::string text;
  int listed = 0;
  for (const auto& [id, count] : ids)
    if (++listed <= 8) text += (text.empty() ? "" : ", ") + std::to_string(id);
  return text + (listed > 8 ? ", ..." : "");
}

[[noreturn]] void never_seen(const Recording& recording, const Board& board, const std::map<int, int>& others) {
  const std::string where = recording.media.source.string();
  const std::string looked = recording.name + " never sees the board in " + std::to_string(recording.looked) +
                             (recording.looked == 1 ? " frame" : " frames");
  if (!others.empty())
    throw InputError(where,
                     looked + ", but the tags " + list_of(others) + ", and the board has " +
                         std::to_string(board.first_id) + " to " + std::to_string(board.first_id + board.tags() - 1),
                     "give the file of the board that was held");
  std::map<std::string, int> families;
  const int every = std::max(1, recording.media.frames / kOtherLooks);
  importing::for_each_frame(recording.media, {0, recording.media.frames}, [&](int frame, const capture::Image8& image) {
    if (frame % every == 0)
      for (const std::string& family : other_families(gray(image))) families[family] += 1;
  });
  const auto most = std::max_element(families.begin(), families.end(),
                                     [](const auto& a, const auto& b) { return a.second < b.second; });
  if (most != families.end() && most->second > 1)
    throw InputError(where, looked + ", but tags of " + most->first, "print the board with --board-svg: tag36h11");
  throw InputError(where, looked + ", and no other tag",
                   "hold it nearer (a tag 20 px wide or more), flat, with its white margin, in even light");
}

}  // namespace

Recording open_recording(const CameraRequest& request, const std::string& time_unit, double origin,
                         std::vector<std::string>& notes) {
  Recording out;
  out.name = request.name;
  out.media = importing::open_media(request.images);
  const int frames = out.media.frames;
  std::string note;
  if (!request.stamps.empty()) {
    out.times = importing::read_stamps(request.stamps.file, request.stamps.key, time_unit, note);
    if (static_cast<int>(out.times.size()) < frames)
      throw InputError(request.stamps.file.string(),
                       "has " + std::to_string(out.times.size()) + " times for " + std::to_string(frames) + " frames",
                       "write one per frame");
    out.times.resize(frames);
    for (int k = 1; k < frames; ++k)
      if (!(out.times[k] > out.times[k - 1]))
        throw InputError(request.stamps.file.string(),
                         "time " + std::to_string(k + 1) + " does not come after the one before",
                         "write one time per frame, increasing");
    out.stamped = true;
    for (double& time : out.times) time += request.start.value_or(0.0) - origin;
    if (request.start) note += ", plus " + core::brief(*request.start) + " s";
  } else {
    const double rate = request.rate.value_or(out.media.rate > 0.0 ? out.media.rate : 1.0);
    if (!(rate >= capture::kSlowestRate && rate <= capture::kFastestRate))
      throw InputError("`rate`", core::exact(rate) + " frames per second are not supported", "give 0.1 to 1e6");
    for (int k = 0; k < frames; ++k) out.times.push_back(request.start.value_or(0.0) - origin + k / rate);
    note = core::brief(rate) + " frames per second" +
           (request.rate           ? ""
            : out.media.rate > 0.0 ? " by the video's header"
                                   : ", assumed, since images have no rate") +
           (request.find_start ? ", start to be found"
                               : ", frame 0 at " + core::brief(request.start.value_or(0.0)) + " s" +
                                     (request.start ? "" : ", assumed (`start`, `timestamps`)"));
  }
  std::vector<double> steps;
  for (int k = 1; k < frames; ++k) steps.push_back(out.times[k] - out.times[k - 1]);
  out.interval = steps.empty() ? 1.0 : math::median(steps);
  notes.push_back(request.name + ": " + std::to_string(frames) + " frames of " + std::to_string(out.media.width) + "x" +
                  std::to_string(out.media.height) + ", " + note);
  return out;
}

void look(std::vector<Recording>& recordings, const Board& board) {
  double first = std::numeric_limits<double>::infinity(), last = -first, interval = first;
  for (const Recording& recording : recordings) {
    first = std::min(first, recording.times.front()), last = std::max(last, recording.times.back());
    interval = std::min(interval, recording.interval);
  }
  // each camera by its own times where these have nothing in common
  for (Recording& recording : recordings) {
    const double span = recording.times.back() - recording.times.front();
    double step = std::max(interval, span / kMostLooked);
    for (const Recording& other : recordings)
      step = std::max(step, (other.times.back() - other.times.front()) / kMostLooked);
    const std::vector<int> frames = frames_to_look_at(recording, first, step);
    recording.looked = static_cast<int>(frames.size());
    std::vector<std::pair<int, Gray>> batch;
    std::map<int, int> others;
    std::size_t next = 0;
    const std::size_t fewest = std::min(2, board.tags());
    const auto flush = [&] {
      std::vector<std::vector<Tag>> found(batch.size());
      std::vector<std::map<int, int>> strangers(batch.size());
      core::parallel_for(static_cast<std::int64_t>(batch.size()),
                         [&](std::int64_t i) { found[i] = find_tags(batch[i].second, board, strangers[i]); });
      for (std::size_t i = 0; i < batch.size(); ++i) {
        for (const auto& [id, count] : strangers[i]) others[id] += count;
        if (found[i].size() >= fewest)
          recording.seen.push_back({batch[i].first, recording.times[batch[i].first], std::move(found[i])});
      }
      core::report({"look " + recording.name, static_cast<std::int64_t>(next), recording.looked, NAN, NAN,
                    std::to_string(recording.seen.size()) + " frames with the board"});
      core::stop_if_requested();
      batch.clear();
    };
    importing::for_each_frame(recording.media, {0, frames.back() + 1}, [&](int frame, const capture::Image8& image) {
      if (next >= frames.size() || frame != frames[next]) return;
      ++next;
      batch.emplace_back(frame, gray(image));
      if (batch.size() == kBatch) flush();
    });
    flush();
    if (recording.seen.empty()) never_seen(recording, board, others);
  }
}

std::vector<View> thinned(const Recording& recording, int camera) {
  std::vector<View> views;
  const Frame* last = nullptr;
  for (const Frame& frame : recording.seen) {
    if (last && distance(*last, frame) < kMoved * recording.media.width) continue;
    views.push_back({camera, frame.frame, frame.time, {}});
    last = &frame;
  }
  if (views.size() <= kMostViews) return views;
  std::vector<View> fewer;
  for (std::size_t i = 0; i < kMostViews; ++i) fewer.push_back(views[i * views.size() / kMostViews]);
  return fewer;
}

std::vector<Moment> grouped(std::vector<View> views, const std::vector<double>& clocks, double interval) {
  const auto time = [&](const View& view) { return view.time + clocks[view.camera]; };
  std::sort(views.begin(), views.end(),
            [&](const View& a, const View& b) { return time(a) != time(b) ? time(a) < time(b) : a.camera < b.camera; });
  std::vector<Moment> moments;
  double begin = -std::numeric_limits<double>::infinity();
  for (View& view : views) {
    const bool other =
        time(view) - begin > 0.5 * interval || std::any_of(moments.back().views.begin(), moments.back().views.end(),
                                                           [&](const View& v) { return v.camera == view.camera; });
    if (other) moments.emplace_back(), begin = time(view);
    moments.back().views.push_back(std::move(view));
  }
  return moments;
}

std::vector<Moment> chosen(const std::vector<Recording>& recordings) {
  std::vector<View> views;
  std::vector<std::vector<double>> speeds;  // px from frame to frame, of each frame that was seen
  double interval = std::numeric_limits<double>::infinity();
  for (std::size_t c = 0; c < recordings.size(); ++c) {
    const Recording& recording = recordings[c];
    interval = std::min(interval, recording.interval);
    std::vector<double> own;
    for (std::size_t i = 0; i < recording.seen.size(); ++i) {
      const Frame& frame = recording.seen[i];
      views.push_back({static_cast<int>(c), frame.frame, frame.time, {}});
      double speed = std::numeric_limits<double>::infinity();
      for (const std::size_t other : {i - 1, i + 1}) {
        if (other >= recording.seen.size()) continue;
        const double frames = std::max(1.0, std::abs(recording.seen[other].time - frame.time) / recording.interval);
        speed = std::min(speed, distance(frame, recording.seen[other]) / frames);
      }
      own.push_back(std::isfinite(speed) ? speed : 0.0);  // stills
    }
    speeds.push_back(std::move(own));
  }
  std::vector<Moment> all = grouped(views, std::vector<double>(recordings.size(), 0.0), interval);
  const auto speed_of = [&](const Moment& moment) {
    double speed = 0.0;
    for (const View& view : moment.views) {
      const Recording& recording = recordings[view.camera];
      speed = std::max(speed, speeds[view.camera][&frame_of(recording, view.frame) - recording.seen.data()]);
    }
    return speed;
  };
  std::vector<std::pair<double, std::size_t>> order;
  std::size_t first = 0;
  while (first < all.size() && all[first].views[0].camera != 0) ++first;
  for (std::size_t m = 0; m < all.size(); ++m) order.emplace_back(m == first ? -1.0 : speed_of(all[m]), m);
  std::sort(order.begin(), order.end());
  std::vector<std::size_t> taken;
  std::vector<int> counts(recordings.size(), 0);
  const auto unlike = [&](const Moment& moment) {
    return std::all_of(taken.begin(), taken.end(), [&](std::size_t other) {
      for (const View& view : moment.views) {
        const auto same = std::find_if(all[other].views.begin(), all[other].views.end(),
                                       [&](const View& v) { return v.camera == view.camera; });
        const Recording& recording = recordings[view.camera];
        if (same == all[other].views.end() ||
            distance(frame_of(recording, view.frame), frame_of(recording, same->frame)) >
                kUnlike * recording.media.width)
          return true;
      }
      return false;
    });
  };
  std::size_t next = 0;
  for (const double limit : kStill) {
    for (; next < order.size() && order[next].first <= limit && taken.size() < kMostViews; ++next) {
      const Moment& moment = all[order[next].second];
      if (!unlike(moment)) continue;
      taken.push_back(order[next].second);
      for (const View& view : moment.views) ++counts[view.camera];
    }
    if (*std::min_element(counts.begin(), counts.end()) >= kEnough) break;
  }
  std::sort(taken.begin(), taken.end());
  std::vector<Moment> moments;
  for (const std::size_t m : taken) moments.push_back(std::move(all[m]));
  return moments;
}

void set_corners(View& view, const Recording& recording, const Board& board, const capture::Camera& lens) {
  view.corners.clear();
  for (const Tag& tag : frame_of(recording, view.frame).tags)
    if (const auto four = corners(tag, lens))
      for (int k = 0; k < 4; ++k)
        view.corners.push_back({board.corner(tag.id, k), (*four)[k].pixel, (*four)[k].deviation});
}

}  // namespace chainsplat::calibration
