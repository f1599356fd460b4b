#include "src/recognition/checkpoint.h"

#include <cstring>
#include <deque>
#include <sstream>

#include "chainsplat/recognition.h"
#include "src/core/write_parts.h"

namespace chainsplat::recognition {

namespace {

constexpr char kMagic[] = "chainsplat-checkpoint/10\n";
constexpr char kFile[] = "recognize.bin";
constexpr char kFileBefore[] = "recognize.before.bin";
constexpr const char* kFiles[] = {kFile, kFileBefore};  // the newest first

// The bytes of a checkpoint in parts: those of long lists stay where they are, since they can be a large part of all
// memory.
struct Writer {
  std::vector<std::string_view> parts;
  std::deque<std::string> own;  // of the parts that lie nowhere else

  template <class T>
  void put(const T& value) {
    parts.push_back(own.emplace_back(reinterpret_cast<const char*>(&value), sizeof value));
  }
  template <class T>
  void put_all(const std::vector<T>& values) {
    put<std::uint64_t>(values.size());
    parts.emplace_back(reinterpret_cast<const char*>(values.data()), values.size() * sizeof(T));
  }
  // values of equal length, one after the other
  void put_all(const std::vector<math::VectorX>& rows) {
    std::uint64_t count = 0;
    for (const math::VectorX& row : rows) count += static_cast<std::uint64_t>(row.size());
    put(count);
    for (const math::VectorX& row : rows)
      parts.emplace_back(reinterpret_cast<const char*>(row.data()), row.size() * sizeof(double));
  }
};

struct Reader {
  std::string_view bytes;
  template <class T>
  T get() {
    if (bytes.size() < sizeof(T)) throw std::out_of_range("checkpoint");
    T value;
    std::memcpy(&value, bytes.data(), sizeof value);
    bytes.remove_prefix(sizeof value);
    return value;
  }
  template <class T>
  std::vector<T> get_all() {
    const auto count = get<std::uint64_t>();
    if (bytes.size() / sizeof(T) < count) throw std::out_of_range("checkpoint");
    std::vector<T> values(count);
    if (count > 0) std::memcpy(values.data(), bytes.data(), count * sizeof(T));
    bytes.remove_prefix(count * sizeof(T));
    return values;
  }
};

void put_gaussians(Writer& w, const splat::Gaussians& g) {
  w.put(g.count);
  w.put(g.links);
  w.put(g.degree);
  for (const auto* part : {&g.mean, &g.rotation, &g.log_scale, &g.opacity_logit, &g.sh, &g.link_logits})
    w.put_all(*part);
  w.put_all(g.guessed);
  w.put(g.pixel_footprint);
  w.put(g.light.constant);
  for (const math::Vector3* part : {&g.light.axis, &g.light.linear})
    for (const double x : *part) w.put(x);
  for (const double x : g.light.quadratic.reshaped()) w.put(x);
}

splat::Gaussians get_gaussians(Reader& r) {
  splat::Gaussians g;
  g.count = r.get<int>();
  g.links = r.get<int>();
  g.degree = r.get<int>();
  for (auto* part : {&g.mean, &g.rotation, &g.log_scale, &g.opacity_logit, &g.sh, &g.link_logits})
    *part = r.get_all<float>();
  g.guessed = r.get_all<std::uint8_t>();
  g.pixel_footprint = r.get<double>();
  g.light.constant = r.get<double>();
  for (math::Vector3* part : {&g.light.axis, &g.light.linear})
    for (double& x : *part) x = r.get<double>();
  for (double& x : g.light.quadratic.reshaped()) x = r.get<double>();
  constexpr int kHighestDegree = 3;
  const auto holds = [&](const std::vector<float>& part, std::size_t a_gaussian) {
    return part.size() == a_gaussian * static_cast<std::size_t>(g.count);
  };
  if (g.count < 0 || g.links < 0 || g.degree < 0 || g.degree > kHighestDegree || !holds(g.mean, 3) ||
      !holds(g.rotation, 4) || !holds(g.log_scale, 3) || !holds(g.opacity_logit, 1) ||
      !holds(g.sh, 3 * static_cast<std::size_t>(g.sh_coefficients())) ||
      !holds(g.link_logits, static_cast<std::size_t>(g.links)) || g.guessed.size() != static_cast<std::size_t>(g.count))
    throw std::out_of_range("checkpoint");
  return g;
}

std::vector<math::VectorX> rows_of(const std::vector<double>& all, std::size_t count) {
  std::vector<math::VectorX> rows;
  if (count == 0 ? !all.empty() : all.size() % count != 0) throw std::out_of_range("checkpoint");
  const std::size_t width = count == 0 ? 0 : all.size() / count;
  for (std::size_t k = 0; width > 0 && k < count; ++k)
    rows.push_back(Eigen::Map<const math::VectorX>(all.data() + width * k, static_cast<Eigen::Index>(width)));
  return rows;
}

// None when it is damaged.
std::optional<Checkpoint> parse(const std::string& bytes) {
  const std::size_t head = sizeof kMagic - 1 + sizeof(std::uint64_t);
  if (bytes.size() < head || bytes.compare(0, sizeof kMagic - 1, kMagic) != 0) return std::nullopt;
  Reader sum{std::string_view(bytes).substr(sizeof kMagic - 1)};
  if (sum.get<std::uint64_t>() != core::fnv1a(std::string_view(bytes).substr(head))) return std::nullopt;
  Reader r{std::string_view(bytes).substr(head)};
  try {
    Checkpoint c;
    const auto name = r.get_all<char>();
    c.job.assign(name.begin(), name.end());
    c.stage = r.get<int>();
    c.step = r.get<int>();
    c.watch.smooth_loss = r.get<double>();
    c.watch.least_loss = r.get<double>();
    c.watch.losses = r.get<int>();
    c.watch.bad_steps = r.get<int>();
    c.watch.bad_in_a_row = r.get<int>();
    c.watch.restarts = r.get<int>();
    c.spatial = r.get<std::uint8_t>() != 0;
    c.out_of_plane_rms = r.get<double>();
    c.deviation = r.get<double>();
    c.lift = r.get_all<double>();
    c.states.time = r.get_all<double>();
    c.states.theta = rows_of(r.get_all<double>(), c.states.time.size());
    c.states.thetadot = rows_of(r.get_all<double>(), c.states.time.size());
    c.states.roll = rows_of(r.get_all<double>(), c.states.time.size());
    c.gaussians = get_gaussians(r);
    c.snapshot.gaussians = get_gaussians(r);
    c.snapshot.first_moment = r.get_all<float>();
    c.snapshot.second_moment = r.get_all<float>();
    c.snapshot.step = r.get<int>();
    c.extra = r.get_all<double>();
    return c;
  } catch (const std::out_of_range&) {
    return std::nullopt;
  }
}

// The first line in which two jobs differ: 'NAME VALUE, not VALUE'; a name that begins with dashes is a field's.
std::string difference(const std::string& had, const std::string& asked) {
  std::istringstream had_lines(had), asked_lines(asked);
  std::string before, now;
  do {
    std::getline(had_lines, before);
    std::getline(asked_lines, now);
  } while (before == now && had_lines && asked_lines);
  const std::size_t value = now.rfind(' ') + 1;
  const std::string other = before.compare(0, value, now, 0, value) == 0 ? now.substr(value) : now;
  if (const std::size_t end = before.find(' '); before.starts_with("--") && end != std::string::npos)
    before = "`" + before.substr(2, end - 2) + "`" + before.substr(end);
  return before + ", not " + other;
}

}  // namespace

void save_checkpoint(const Checkpoint& c, const Path& folder) {
  Writer w;
  w.put<std::uint64_t>(c.job.size());
  w.parts.push_back(c.job);
  w.put(c.stage);
  w.put(c.step);
  w.put(c.watch.smooth_loss);
  w.put(c.watch.least_loss);
  w.put(c.watch.losses);
  w.put(c.watch.bad_steps);
  w.put(c.watch.bad_in_a_row);
  w.put(c.watch.restarts);
  w.put(c.spatial);
  w.put(c.out_of_plane_rms);
  w.put(c.deviation);
  w.put_all(c.lift);
  w.put_all(c.states.time);
  w.put_all(c.states.theta);
  w.put_all(c.states.thetadot);
  w.put_all(c.states.roll);
  put_gaussians(w, c.gaussians);
  put_gaussians(w, c.snapshot.gaussians);
  w.put_all(c.snapshot.first_moment);
  w.put_all(c.snapshot.second_moment);
  w.put(c.snapshot.step);
  w.put_all(c.extra);
  std::uint64_t hash = core::fnv1a("");
  for (const std::string_view part : w.parts) hash = core::fnv1a(part, hash);
  Writer head;
  head.parts.emplace_back(kMagic);
  head.put(hash);
  w.parts.insert(w.parts.begin(), head.parts.begin(), head.parts.end());
  std::erase_if(w.parts, [](std::string_view part) { return part.empty(); });
  std::filesystem::create_directories(folder);
  // a kill between the two leaves the one before, which is as good
  std::error_code absent;
  std::filesystem::rename(folder / kFile, folder / kFileBefore, absent);
  core::write_parts(folder / kFile, [&, at = std::size_t{0}]() mutable {
    return at < w.parts.size() ? w.parts[at++] : std::string_view();
  });
}

std::optional<Checkpoint> load_checkpoint(const Path& folder, const std::string& job) {
  bool damaged = false;
  for (const char* name : kFiles) {
    const Path file = folder / name;
    std::error_code error;
    if (!std::filesystem::exists(file, error)) continue;
    std::optional<Checkpoint> found = parse(core::read_file(file));
    if (found && found->job != job)
      throw InputError(file.string(), "the checkpoint is of another job (" + difference(found->job, job) + ")",
                       "resume with the capture, the frames and the options that it was begun with, or begin again "
                       "with `force`");
    if (found) return found;
    damaged = true;
    core::warn(file.string() + ": the checkpoint is damaged or of another version and is passed over");
  }
  if (damaged) core::warn(folder.string() + ": no checkpoint is whole, recognition begins anew");
  return std::nullopt;
}

bool is_checkpoint(const std::string& file_name) { return file_name == kFile || file_name == kFileBefore; }

void remove_checkpoint(const Path& folder) {
  std::error_code ignored;
  for (const char* name : kFiles) std::filesystem::remove(folder / name, ignored);
}

}  // namespace chainsplat::recognition
