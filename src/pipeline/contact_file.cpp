#include "pipeline/contact_file.h"

#include <algorithm>
#include <cmath>
#include <string>

#include "chainsplat/core.h"
#include "chainsplat/run_folder.h"

namespace chainsplat::pipeline {

std::vector<ContactPoint> read_contacts(const Path& file) {
  const std::string text = core::read_file(input_path(file));
  const std::string mend = "leave x, y and z empty when nothing touches";
  std::vector<ContactPoint> out;
  const std::vector<core::TableLine> lines = core::table_lines(text);
  for (std::size_t k = 1; k < lines.size(); ++k) {  // below the head
    const std::vector<double> row = core::table_numbers(file, lines[k], 4, mend, true);
    const int given =
        static_cast<int>(std::count_if(row.begin() + 1, row.end(), [](double x) { return !std::isnan(x); }));
    if (std::isnan(row[0]) || (given != 0 && given != 3) || (!out.empty() && row[0] <= out.back().time))
      throw InputError(file.string() + ":" + std::to_string(lines[k].number),
                       "is not 'time,x,y,z' with increasing times", mend);
    out.push_back({row[0], std::nullopt});
    if (given == 3) out.back().point = math::Vector3(row[1], row[2], row[3]);
  }
  if (out.empty()) throw InputError(file.string(), "has no rows", "give 'time,x,y,z' lines below a head line");
  return out;
}

}  // namespace chainsplat::pipeline
