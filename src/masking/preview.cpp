// The contact sheet of masks.
#include <algorithm>
#include <cstdio>
#include <opencv2/core.hpp>
#include <opencv2/imgproc.hpp>

#include "chainsplat/image_model.h"
#include "chainsplat/masking.h"

namespace chainsplat::masking {

namespace {

constexpr int kTileWidth = 640;  // px
constexpr int kMostColumns = 4;
const cv::Scalar kGood(40, 220, 60), kPoor(255, 60, 40);  // red, green, blue

// The picture made smaller, with the mask's outline and a caption.
cv::Mat drawn(const PreviewTile& tile) {
  const cv::Mat picture(tile.picture.height, tile.picture.width, CV_8UC3,
                        const_cast<std::uint8_t*>(tile.picture.pixels.data()));
  const cv::Mat mask(tile.mask.height, tile.mask.width, CV_8UC1, const_cast<std::uint8_t*>(tile.mask.pixels.data()));
  const double scale = std::min(1.0, 1.0 * kTileWidth / picture.cols);
  cv::Mat out;
  cv::resize(picture, out, cv::Size(), scale, scale, cv::INTER_AREA);
  // the outline in the small picture: where a pixel's neighborhood has both
  cv::Mat small, wide, narrow;
  cv::resize(mask, small, out.size(), 0, 0, cv::INTER_AREA);
  cv::threshold(small, small, image_model::kObjectMask - 1, 255, cv::THRESH_BINARY);
  cv::dilate(small, wide, cv::Mat::ones(3, 3, CV_8U));
  const bool poor = tile.score && *tile.score < kDoubtful;
  const cv::Scalar color = poor ? kPoor : kGood;
  out.setTo(color, wide & ~small);
  char caption[160];
  std::snprintf(caption, sizeof caption, "%.60s %d%s", tile.camera.c_str(), tile.frame, poor ? " poor" : "");
  std::string text = caption;
  if (tile.score) {
    std::snprintf(caption, sizeof caption, "  score %.2f", *tile.score);
    text += caption;
  }
  cv::rectangle(out, cv::Rect(0, 0, out.cols, 22), cv::Scalar(0, 0, 0), cv::FILLED);
  cv::putText(out, text, cv::Point(6, 16), cv::FONT_HERSHEY_SIMPLEX, 0.5, color, 1, cv::LINE_AA);
  return out;
}

}  // namespace

capture::Image8 contact_sheet(const std::vector<PreviewTile>& tiles) {
  std::vector<cv::Mat> pictures;
  int width = 1, height = 1;
  for (const PreviewTile& tile : tiles) {
    pictures.push_back(drawn(tile));
    width = std::max(width, pictures.back().cols), height = std::max(height, pictures.back().rows);
  }
  const int count = std::max<int>(1, static_cast<int>(pictures.size())), columns = std::min(kMostColumns, count);
  const int rows = (count + columns - 1) / columns;
  capture::Image8 out{columns * width, rows * height, 3, {}};
  out.pixels.assign(static_cast<std::size_t>(3) * out.width * out.height, 0);
  cv::Mat sheet(out.height, out.width, CV_8UC3, out.pixels.data());
  for (int i = 0; i < static_cast<int>(pictures.size()); ++i)
    pictures[i].copyTo(
        sheet(cv::Rect((i % columns) * width, (i / columns) * height, pictures[i].cols, pictures[i].rows)));
  return out;
}

}  // namespace chainsplat::masking
