// results.cpp - where results may go, and how they get there.
#include <unistd.h>

#include <charconv>
#include <cstdlib>
#include <fstream>
#include <iostream>

#include "cli.h"

namespace chainsplat::tools {

namespace fs = std::filesystem;

Path input_path(const std::string& name) { return name == "-" ? Path("/dev/stdin") : Path(name); }

bool next_line(std::istream& in, std::string& line, const std::string& where) {
  constexpr std::size_t kLongest = 64 << 20;  // bytes; an estimate of a thousand angles, with covariance, has half of it
  line.clear();
  for (char letter = 0; in.get(letter);) {
    if (letter == '\n') return true;
    if (line.size() == kLongest)
      throw InputError(where, "has a line of more than 64 MiB", "give the output of 'chainsplat estimate'");
    line += letter;
  }
  if (in.bad()) throw InputError(where, "cannot be read", "give the output of 'chainsplat estimate'");
  return !line.empty();
}

void write_result(const std::string& name, const std::string& bytes) {
  std::error_code error;
  if (name == "-") {
    std::cout << bytes;
  } else if (fs::exists(name, error) && !fs::is_regular_file(name, error)) {
    // a device or a pipe must be written into, not replaced
    std::ofstream file(name, std::ios::binary);
    file << bytes;
    file.flush();
    if (!file) throw WorkError(name, "writing failed", "make room or name another file");
  } else {
    core::write_file(name, bytes);
  }
}

void check_output_folder(const Path& folder, bool overwrite, const std::string& mend) {
  std::error_code error;
  if (fs::exists(folder, error) && !fs::is_directory(folder, error))
    throw InputError(folder.string(), "is a file, not a folder", "name another folder");
  if (fs::is_symlink(folder, error) && !fs::exists(folder, error))
    throw InputError(folder.string(), "is a link to nothing", "name another folder");
  if (fs::is_directory(folder, error) && !fs::is_empty(folder, error) && !overwrite)
    throw InputError(folder.string(), "is there already and not empty", mend);
  Path above = fs::absolute(folder).lexically_normal();
  while (!fs::exists(above, error) && above.has_relative_path()) above = above.parent_path();
  if (!fs::is_directory(above, error) || ::access(above.c_str(), W_OK | X_OK) != 0)
    throw InputError(folder.string(), "cannot be made in " + above.string(), "name a folder that can be written");
}

void check_not_capture(const Path& folder, const Path& capture) {
  std::error_code error;
  if (fs::equivalent(folder, capture, error))
    throw InputError(folder.string(), "is the capture's own folder", "name another folder");
}

void check_output_file(const std::string& file) {
  std::error_code error;
  if (file == "-") return;
  if (fs::is_directory(file, error)) throw InputError(file, "is a folder, not a file", "name a file");
  const Path folder = fs::absolute(file).parent_path();
  if (!fs::is_directory(folder, error))
    throw InputError(file, "its folder does not exist", "make the folder or name another file");
  if (::access(folder.c_str(), W_OK | X_OK) != 0 && !fs::exists(file, error))
    throw InputError(file, "its folder cannot be written", "name another file");
}

void make_folder(const Path& folder) {
  std::error_code error;
  fs::create_directories(folder, error);
  if (error)
    throw WorkError(folder.string(), "cannot be made (" + error.message() + ")",
                    "make room or choose a folder that can be written");
}

WorkError broken_off(const std::runtime_error& error, const std::string& kept) {
  const std::string text = error.what();
  const std::size_t colon = std::min(text.find(": "), text.size() - 2);
  return WorkError(text.substr(0, colon), text.substr(colon + 2), kept);
}

std::pair<std::string, std::string> split_camera(const std::string& text) {
  std::error_code error;
  const std::size_t colon = text.rfind(':');
  if (colon == std::string::npos || fs::exists(text, error)) return {text, ""};
  return {text.substr(0, colon), text.substr(colon + 1)};
}

std::pair<int, int> parse_frames(const std::string& text, const std::string& where) {
  if (text.empty()) return {0, -1};
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

std::vector<double> numbers(const std::string& text, const std::string& where, std::size_t count) {
  std::vector<double> out;
  const char* at = text.c_str();
  for (;;) {
    char* end = nullptr;
    const double value = std::strtod(at, &end);
    if (end == at) break;
    out.push_back(value);
    at = end;
    if (*at != ',' || at[1] == '\0') break;
    ++at;
  }
  if (*at != '\0' || (count && out.size() != count) || out.empty())
    throw InputError(where, "'" + text + "' is not " + (count ? std::to_string(count) + " numbers" : "numbers"),
                     "give them with commas between, for example 0.1,0,0.3");
  return out;
}

}  // namespace chainsplat::tools
