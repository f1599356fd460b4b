#include <algorithm>
#include <charconv>
#include <cmath>

#include "chainsplat/capture.h"

namespace chainsplat::capture {

std::optional<TrueCenterline> load_true_centerline(const Path& capture_folder) {
  std::error_code error;
  const Path folder =
      std::filesystem::is_directory(capture_folder, error) ? capture_folder : capture_folder.parent_path();
  const Path file = folder / "truth" / "centreline.csv";
  if (!std::filesystem::exists(file, error)) return std::nullopt;
  const std::string text = core::read_file(file);
  TrueCenterline truth;
  std::size_t columns = 0;
  int line_number = 0;
  for (std::size_t begin = 0; begin < text.size();) {
    const std::size_t end = std::min(text.find('\n', begin), text.size());
    std::string_view line(text.data() + begin, end - begin);
    begin = end + 1;
    ++line_number;
    if (line.ends_with('\r')) line.remove_suffix(1);
    if (line.empty()) continue;
    const auto fail = [&](const std::string& what) {
      throw InputError(file.string() + ":" + std::to_string(line_number), what,
                       "take the file as the simulation wrote it");
    };
    if (columns == 0) {
      constexpr std::string_view kHeader = "frame,time,x0,y0,z0";
      if (!line.starts_with(kHeader)) fail("does not start with 'frame,time,x0,y0,z0,...'");
      columns = static_cast<std::size_t>(std::count(line.begin(), line.end(), ',')) + 1;
      if ((columns - 2) % 3 != 0) fail("does not have three columns a point");
      continue;
    }
    std::vector<double> numbers;
    for (const char *c = line.data(), *stop = c + line.size(); c < stop; ++c) {
      double number = 0.0;
      const auto [after, code] = std::from_chars(c, stop, number);
      if (code != std::errc() || (after != stop && *after != ',') || !std::isfinite(number))
        fail("column " + std::to_string(numbers.size() + 1) + " is not a finite number");
      numbers.push_back(number);
      c = after;
    }
    if (numbers.size() != columns)
      fail(std::to_string(numbers.size()) + " columns instead of " + std::to_string(columns));
    truth.time.push_back(numbers[1]);
    truth.points.push_back(
        Eigen::Map<const math::MatrixX>(numbers.data() + 2, 3, static_cast<Eigen::Index>((columns - 2) / 3)));
  }
  return truth;
}

}  // namespace chainsplat::capture
