#include "chainsplat/frame_pattern.h"

#include <cctype>
#include <charconv>

namespace chainsplat::capture {

std::string FramePattern::file(int frame) const {
  std::string number = std::to_string(frame);
  if (static_cast<int>(number.size()) < digits) number.insert(0, digits - number.size(), '0');
  return before + number + after;
}

std::optional<FramePattern> read_frame_pattern(const std::string& text) {
  const std::size_t percent = text.find('%');
  if (percent == std::string::npos) return {};
  std::size_t end = percent + 1;
  while (end < text.size() && std::isdigit(static_cast<unsigned char>(text[end]))) ++end;
  const std::string width = text.substr(percent + 1, end - percent - 1);
  const bool valid = end < text.size() && text[end] == 'd' && width.size() <= 3 && (width.empty() || width[0] == '0') &&
                     text.find('%', end) == std::string::npos;
  if (!valid) return {};
  FramePattern pattern{text.substr(0, percent), text.substr(end + 1)};
  if (!width.empty()) std::from_chars(width.data(), width.data() + width.size(), pattern.digits);
  return pattern;
}

}  // namespace chainsplat::capture
