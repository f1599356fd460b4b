#include <algorithm>

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
  const std::string mend = "take the file as the simulation wrote it";
  std::size_t columns = 0;
  for (const core::TableLine& line : core::table_lines(text)) {
    if (columns == 0) {
      const auto fail = [&](const std::string& what) {
        throw InputError(file.string() + ":" + std::to_string(line.number), what, mend);
      };
      constexpr std::string_view kHeader = "frame,time,x0,y0,z0";
      if (!line.text.starts_with(kHeader)) fail("does not start with 'frame,time,x0,y0,z0,...'");
      columns = static_cast<std::size_t>(std::count(line.text.begin(), line.text.end(), ',')) + 1;
      if ((columns - 2) % 3 != 0) fail("does not have three columns a point");
      continue;
    }
    const std::vector<double> numbers = core::table_numbers(file, line, columns, mend);
    truth.time.push_back(numbers[1]);
    truth.points.push_back(
        Eigen::Map<const math::MatrixX>(numbers.data() + 2, 3, static_cast<Eigen::Index>((columns - 2) / 3)));
  }
  return truth;
}

}  // namespace chainsplat::capture
