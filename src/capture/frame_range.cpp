#include <charconv>

#include "chainsplat/capture.h"

namespace chainsplat::capture {

FrameRange read_frame_range(const std::string& text, const std::string& where) {
  if (text.empty()) return {};
  const auto fail = [&] {
    return InputError(where, "'" + text + "' is no range of frames",
                      "give A:B, for example 0:60 for the first 60");
  };
  const std::size_t colon = text.find(':');
  if (colon == std::string::npos) throw fail();
  const auto parse = [&](std::string_view part, int absent) {
    if (part.empty()) return absent;
    int value = 0;
    const auto [end, error] = std::from_chars(part.data(), part.data() + part.size(), value);
    if (error != std::errc() || end != part.data() + part.size() || value < 0) throw fail();
    return value;
  };
  const int first = parse(std::string_view(text).substr(0, colon), 0);
  const int last = parse(std::string_view(text).substr(colon + 1), -1);
  if (last >= 0 && last <= first) throw fail();
  return {first, last};
}

std::string frame_range_text(const FrameRange& range) {
  if (range == FrameRange{}) return "";
  return std::to_string(range.first) + ":" + (range.last < 0 ? "" : std::to_string(range.last));
}

}  // namespace chainsplat::capture
