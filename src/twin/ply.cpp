// Gaussians in the PLY layout of 3DGS, followed by the link logits.
#include <algorithm>
#include <array>
#include <bit>
#include <charconv>
#include <cmath>
#include <cstring>
#include <map>
#include <sstream>

#include "chainsplat/twin.h"

namespace chainsplat::twin {

static_assert(std::endian::native == std::endian::little, "PLY files are written as the numbers lie in memory");

namespace {

constexpr int kMostProperties = 4096;  // per vertex; a header with more is damaged

// Index into Gaussians::sh. In the file f_rest_* is channel-major: coefficients 1.. of red, then of green, then of
// blue.
std::size_t rest_index(const splat::Gaussians& g, int gaussian, int channel, int coefficient) {
  return 3u * (static_cast<std::size_t>(g.sh_coefficients()) * gaussian + coefficient) + channel;
}

constexpr const char* kGuessed = "guessed";  // a property that files may have: 1 where no camera saw the Gaussian

std::vector<std::string> property_names(int coefficients, int links) {
  std::vector<std::string> names{"x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"};
  for (int k = 0; k < 3 * (coefficients - 1); ++k) names.push_back("f_rest_" + std::to_string(k));
  for (const char* name : {"opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"})
    names.push_back(name);
  for (int j = 0; j < links; ++j) names.push_back("link_" + std::to_string(j));
  return names;
}

int scalar_bytes(const std::string& type) {
  static const std::map<std::string, int> sizes{{"char", 1},  {"uchar", 1},   {"int8", 1},   {"uint8", 1},
                                                {"short", 2}, {"ushort", 2},  {"int16", 2},  {"uint16", 2},
                                                {"int", 4},   {"uint", 4},    {"int32", 4},  {"uint32", 4},
                                                {"float", 4}, {"float32", 4}, {"double", 8}, {"float64", 8}};
  const auto found = sizes.find(type);
  return found == sizes.end() ? 0 : found->second;
}

struct PlyProperty {
  std::size_t offset = 0;  // in bytes from the start of the vertex (binary)
  int index = 0;           // among the properties of a vertex (ASCII)
  int bytes = 0;
  bool real = false;  // float or double
};

struct Header {
  std::string format;
  std::size_t count = 0, stride = 0, data = 0;    // number of vertices; bytes per vertex; offset of the first one
  std::map<std::string, PlyProperty> properties;  // of a vertex
  bool has_float(const std::string& name) const {
    const auto found = properties.find(name);
    return found != properties.end() && found->second.real && found->second.bytes == sizeof(float);
  }
};

// `things` names the vertices in messages, `mend` says how the file should be written. Throws InputError.
Header read_header(const std::string& bytes, const std::string& file, const char* things, const char* mend) {
  const auto fail = [&](const std::string& what) { throw InputError(file, what, mend); };
  Header header;
  std::size_t at = 0;
  bool in_vertex = false, seen_vertex = false;

  // properties of the vertices, line by line
  for (int number = 0;; ++number) {
    const std::size_t end = bytes.find('\n', at);
    if (end == std::string::npos) fail(number == 0 ? "is not a PLY file" : "its header has no end");
    std::string line = bytes.substr(at, end - at);
    at = end + 1;
    if (line.ends_with('\r')) line.pop_back();
    if (number == 0) {
      if (line != "ply") fail("is not a PLY file");
      continue;
    }
    std::istringstream words(line);
    std::string word;
    words >> word;
    if (word == "end_header") break;
    if (word == "format") {
      words >> header.format;
    } else if (word == "element") {
      std::string name;
      long long count = -1;
      words >> name >> count;
      if (seen_vertex) {
        in_vertex = false;  // elements after the vertices are not read
        continue;
      }
      if (name != "vertex" || !words || count < 0) fail("its first element is not a number of vertices");
      header.count = static_cast<std::size_t>(count);
      in_vertex = seen_vertex = true;
    } else if (word == "property" && in_vertex) {
      std::string type, name;
      words >> type >> name;
      const int size = scalar_bytes(type);
      const int index = static_cast<int>(header.properties.size());
      if (size == 0 || name.empty() || index >= kMostProperties || header.properties.contains(name))
        fail("its property line '" + line.substr(0, 60) + "' is not understood");
      header.properties[name] = {header.stride, index, size, type.starts_with("float") || type.starts_with("double")};
      header.stride += static_cast<std::size_t>(size);
    }
  }

  // the file must be long enough; in ASCII a number has at least a digit and a space, but for the last of the file
  if (header.format.empty() || !seen_vertex) fail("its header names no format or no vertices");
  header.data = at;
  const bool ascii = header.format == "ascii";
  const std::size_t least = ascii ? 2 * header.properties.size() : header.stride;
  if (header.stride == 0 || header.count > (bytes.size() - at + (ascii ? 1 : 0)) / least)
    fail("ends before its " + std::to_string(header.count) + " " + things);
  return header;
}

}  // namespace

std::string gaussians_ply(const splat::Gaussians& g) {
  const int coefficients = g.sh_coefficients();
  std::string bytes =
      "ply\nformat binary_little_endian 1.0\n"
      "comment Gaussians of a chain at home (all angles 0), base frame, meters\n"
      "comment logit opacity, ln scale, quaternion wxyz; link_*: logits of the link probability\n"
      "element vertex " +
      std::to_string(g.count) + "\n";
  std::vector<std::string> names = property_names(coefficients, g.links);
  const bool guessed = std::find(g.guessed.begin(), g.guessed.end(), 1) != g.guessed.end();
  if (guessed) names.push_back(kGuessed);
  for (const std::string& name : names) bytes += "property float " + name + "\n";
  bytes += "end_header\n";
  std::vector<float> row;
  bytes.reserve(bytes.size() + sizeof(float) * names.size() * g.count);
  for (int i = 0; i < g.count; ++i) {
    row.assign(g.mean.begin() + 3 * i, g.mean.begin() + 3 * (i + 1));
    row.insert(row.end(), 3, 0.0f);
    for (int c = 0; c < 3; ++c) row.push_back(g.sh[rest_index(g, i, c, 0)]);
    for (int c = 0; c < 3; ++c)
      for (int l = 1; l < coefficients; ++l) row.push_back(g.sh[rest_index(g, i, c, l)]);
    row.push_back(g.opacity_logit[i]);
    row.insert(row.end(), g.log_scale.begin() + 3 * i, g.log_scale.begin() + 3 * (i + 1));
    row.insert(row.end(), g.rotation.begin() + 4 * i, g.rotation.begin() + 4 * (i + 1));
    const auto links = g.link_logits.begin() + static_cast<std::ptrdiff_t>(g.links) * i;
    row.insert(row.end(), links, links + g.links);
    if (guessed) row.push_back(static_cast<float>(g.guessed[i]));
    bytes.append(reinterpret_cast<const char*>(row.data()), sizeof(float) * row.size());
  }
  return bytes;
}

splat::Gaussians read_ply(const Path& path) {
  const std::string file = path.string();
  const std::string bytes = core::read_file(path);
  const char* const mend = "write it again as binary little-endian 3DGS PLY";
  const Header header = read_header(bytes, file, "Gaussians", mend);
  if (header.format != "binary_little_endian")
    throw InputError(file, "is in the format '" + header.format.substr(0, 30) + "'", mend);

  // degree and number of links by the properties that are present
  int rest = 0, links = 0;
  while (header.has_float("f_rest_" + std::to_string(rest))) ++rest;
  while (header.has_float("link_" + std::to_string(links))) ++links;
  int degree = 0;
  while (degree < 3 && 3 * ((degree + 1) * (degree + 1) - 1) < rest) ++degree;
  const int coefficients = (degree + 1) * (degree + 1);
  if (3 * (coefficients - 1) != rest)
    throw InputError(file, "has " + std::to_string(rest) + " properties f_rest_*, which is no whole degree",
                     "write 0, 9, 24 or 45 of them");
  const std::vector<std::string> names = property_names(coefficients, links);
  std::vector<std::size_t> offsets;
  for (const std::string& name : names) {
    const bool normal = name == "nx" || name == "ny" || name == "nz";
    if (!header.has_float(name) && !normal)
      throw InputError(file, "has no float property '" + name + "'", "write it with the properties of 3DGS");
    offsets.push_back(normal ? 0 : header.properties.at(name).offset);
  }

  const bool guessed = header.has_float(kGuessed);
  if (guessed) offsets.push_back(header.properties.at(kGuessed).offset);

  // values, in the order of property_names()
  splat::Gaussians g;
  g.resize(static_cast<int>(header.count), links, degree);
  for (int i = 0; i < g.count; ++i) {
    const char* const vertex = bytes.data() + header.data + header.stride * i;
    std::size_t next = 0;
    const auto next_value = [&]() {
      float value = 0.0f;
      std::memcpy(&value, vertex + offsets[next], sizeof value);
      if (!std::isfinite(value))
        throw InputError(
            file,
            (next < names.size() ? names[next] : kGuessed) + (" of Gaussian " + std::to_string(i)) + " is not finite",
            "remove the Gaussian");
      ++next;
      return value;
    };
    for (int c = 0; c < 3; ++c) g.mean[3 * i + c] = next_value();
    next += 3;  // normals
    for (int c = 0; c < 3; ++c) g.sh[rest_index(g, i, c, 0)] = next_value();
    for (int c = 0; c < 3; ++c)
      for (int l = 1; l < coefficients; ++l) g.sh[rest_index(g, i, c, l)] = next_value();
    g.opacity_logit[i] = next_value();
    for (int c = 0; c < 3; ++c) g.log_scale[3 * i + c] = next_value();
    float square = 0.0f;
    for (int c = 0; c < 4; ++c) square += std::pow(g.rotation[4 * i + c] = next_value(), 2.0f);
    if (!(square > 0.0f))
      throw InputError(file, "rot_* of Gaussian " + std::to_string(i) + " has no length",
                       "write a quaternion w, x, y, z");
    for (int j = 0; j < links; ++j) g.link_logits[static_cast<std::size_t>(links) * i + j] = next_value();
    g.guessed[i] = guessed && next_value() != 0.0f ? 1 : 0;
  }
  return g;
}

math::MatrixX read_points(const Path& path) {
  const std::string file = path.string();
  const char* const mend = "write a PLY point cloud with x, y and z, ASCII or binary";
  const std::string bytes = core::read_file(path);
  const Header header = read_header(bytes, file, "points", mend);
  const bool ascii = header.format == "ascii", big = header.format == "binary_big_endian";
  if (!ascii && !big && header.format != "binary_little_endian")
    throw InputError(file, "is in the format '" + header.format.substr(0, 30) + "'", mend);

  std::array<PlyProperty, 3> axes;
  for (int d = 0; d < 3; ++d) {
    const std::string name(1, "xyz"[d]);
    const auto found = header.properties.find(name);
    if (found == header.properties.end() || !found->second.real)
      throw InputError(file, "has no float or double property '" + name + "'", mend);
    axes[d] = found->second;
  }

  // points; clouds of depth cameras have holes, which are not finite
  math::MatrixX points(3, static_cast<Eigen::Index>(header.count));
  Eigen::Index kept = 0;
  std::istringstream words(ascii ? bytes.substr(header.data) : std::string());
  std::vector<double> numbers(header.properties.size());
  std::string word;
  for (std::size_t k = 0; k < header.count; ++k) {
    math::Vector3 point;
    if (ascii) {
      for (double& number : numbers) {
        words >> word;
        // from_chars, because a stream does not read "nan"
        if (!words || std::from_chars(word.data(), word.data() + word.size(), number).ec != std::errc())
          throw InputError(file, "point " + std::to_string(k) + " is not written in full", mend);
      }
      for (int d = 0; d < 3; ++d) point[d] = numbers[axes[d].index];
    } else {
      for (int d = 0; d < 3; ++d) {
        std::array<char, sizeof(double)> number{};
        const char* const from = bytes.data() + header.data + header.stride * k + axes[d].offset;
        std::copy_n(from, axes[d].bytes, number.begin());
        if (big) std::reverse(number.begin(), number.begin() + axes[d].bytes);
        float single = 0.0f;
        std::memcpy(&single, number.data(), sizeof single);
        std::memcpy(&point[d], number.data(), sizeof(double));
        if (axes[d].bytes == sizeof single) point[d] = static_cast<double>(single);
      }
    }
    if (point.allFinite()) points.col(kept++) = point;
  }
  return points.leftCols(kept);
}

}  // namespace chainsplat::twin
