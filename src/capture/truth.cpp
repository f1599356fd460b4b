#include <algorithm>

#include "chainsplat/capture.h"

namespace chainsplat::capture {

namespace {

// The header line of a file with so many points per row.
std::string truth_header(std::size_t points) {
  std::string text = "frame,time";
  for (std::size_t i = 0; i < points; ++i)
    for (const char* axis : {",x", ",y", ",z"}) text += axis + std::to_string(i);
  return text;
}

}  // namespace

std::optional<TrueCenterline> load_true_centerline(const Path& capture_folder) {
  std::error_code error;
  const Path folder =
      std::filesystem::is_directory(capture_folder, error) ? capture_folder : capture_folder.parent_path();
  const Path file = folder / "truth" / "centreline.csv";
  if (capture_folder.empty()) return std::nullopt;  // a recording in memory
  if (!std::filesystem::exists(file, error)) return std::nullopt;
  const std::string text = core::read_file(file);
  TrueCenterline truth;
  const std::string mend = "take the file as the simulation wrote it, or remove it";
  std::size_t columns = 0;
  for (const core::TableLine& line : core::table_lines(text)) {
    const auto fail = [&](const std::string& what) {
      throw InputError(file.string() + ":" + std::to_string(line.number), what, mend);
    };
    if (columns == 0) {
      columns = static_cast<std::size_t>(std::count(line.text.begin(), line.text.end(), ',')) + 1;
      if (columns < 5 || line.text != truth_header((columns - 2) / 3))
        fail("is not the header 'frame,time,x0,y0,z0,x1,...', three columns a point");
      continue;
    }
    const std::vector<double> numbers = core::table_numbers(file, line, columns, mend);
    if (!truth.time.empty() && !(numbers[1] > truth.time.back()))
      fail("its time does not come after the one before it");
    truth.time.push_back(numbers[1]);
    truth.points.push_back(
        Eigen::Map<const math::MatrixX>(numbers.data() + 2, 3, static_cast<Eigen::Index>((columns - 2) / 3)));
  }
  if (truth.time.empty()) throw InputError(file.string(), "has no row below a header", mend);
  return truth;
}

}  // namespace chainsplat::capture
