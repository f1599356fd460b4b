#include "src/recognition/unseen.h"

#include <algorithm>
#include <cmath>
#include <optional>
#include <vector>

#include "chainsplat/image_model.h"
#include "src/recognition/place_gaussians.h"
#include "src/recognition/surface.h"

namespace chainsplat::recognition {

namespace {

using math::Vector3;

constexpr double kUnseen = -0.05;    // largest cosine between surface normal and view ray of what no camera saw: what
                                     // lies at the limb shapes the outline
constexpr double kInside = 0.4;      // of the radius: what is closer to the axis has no side
constexpr double kThickness = 0.04;  // diameters, sigma across the surface
constexpr double kCoverage = 0.5;    // sigma along the surface in units of the spacing
constexpr float kOpaque = 3.0f;      // logit, 0.95
constexpr float kHard = 12.0f;       // logit of the own link
constexpr double kHidden = 0.2;      // least share of the pictures that show something else where the rope must be
constexpr double kSteepest = 4.0;    // radii per radian, of a helix
constexpr int kSlopes = 161;         // that are tried
constexpr double kRepeats = 0.3;     // least correlation of a texture with itself along a helix
constexpr double kLit = 0.5;         // least share of what differs around the rope that its light must explain
constexpr double kDarkest = 0.2;     // of the mean light: what lies around a rope reaches every side of it
constexpr double kFew = 0.05;  // of the pictures: a side that no more of them show is as good as unseen, since few
                               // gradients move what lies there

// What was seen of each cell.
struct Surface : Cells {
  std::vector<double> facing;                 // best cosine, but for a few views; what hides it shows nothing
  std::vector<char> hidden;                   // by something that is no rope
  std::vector<std::optional<Vector3>> color;  // of trusted cells

  explicit Surface(const chain::Chain& of) : Cells(of), facing(size(), -1.0), hidden(size()), color(size()) {}
  // Between two rows; none where neither has a color.
  std::optional<Vector3> color_at(double arclength, int column) const {
    const double at = std::clamp(arclength / chain.length * rows - 0.5, 0.0, rows - 1.001);
    const int row = static_cast<int>(at);
    const std::optional<Vector3>&a = color[cell(row, column)], &b = color[cell(row + 1, column)];
    if (a && b) return Vector3((row + 1 - at) * *a + (at - row) * *b);
    return a ? a : b;
  }
};

// A place on or in the tube about the axis.
struct Place {
  double arclength, angle, radius;
};
Place place_of(const Surface& surface, const splat::Gaussians& g, int i) {
  const Vector3 mean(g.mean[3 * i], g.mean[3 * i + 1], g.mean[3 * i + 2]);
  const double x = mean.dot(surface.normal(0.0)), y = mean.dot(surface.normal(0.25 * kTurn));
  const double angle = std::atan2(y, x);
  return {mean.dot(surface.chain.direction), angle < 0.0 ? angle + kTurn : angle, std::hypot(x, y)};
}

// On the tube's side, and not at its axis or on the tip's face, which is seen from below.
bool on_side(const Surface& surface, const Place& at) {
  const double inside = kInside * 0.5 * surface.chain.diameter;
  return at.radius >= inside && at.arclength >= 0.0 && at.arclength <= surface.chain.length - inside;
}

// Colors are those of the texture, without the light.
void look(std::span<const Viewpoint> views, const splat::Light& light, Surface& surface) {
  constexpr double kWithin = 0.8;  // of the radius: masks are a pixel off at the outline
  const double radius = 0.5 * surface.chain.diameter;
  std::vector<double> hidden(surface.facing.size(), 0.0), weights(surface.facing.size(), 0.0);
  std::vector<Vector3> sums(surface.facing.size(), Vector3::Zero());
  std::vector<std::vector<float>> facings(surface.facing.size());
  for (const Viewpoint& from : views) {
    const capture::Camera& camera = *from.camera;
    const capture::View view = capture::unpacked(*from.view);
    core::parallel_for(surface.rows, [&](std::int64_t row) {
      const double s = surface.arclength(static_cast<int>(row));
      const math::Pose& motion = from.motions[chain::link_at(surface.chain, s)];
      for (int column = 0; column < kColumns; ++column) {
        const Vector3 normal = surface.normal(Surface::angle(column)), axis = s * surface.chain.direction;
        const std::size_t cell = surface.cell(static_cast<int>(row), column);
        const Vector3 point = motion * Vector3(axis + radius * normal);
        const Vector3 ray = camera.world_from_camera.translation - point;
        const double facing = (motion.rotation * normal).dot(ray.normalized());
        if (pixel_of(camera, view, motion * Vector3(axis + kWithin * radius * normal)))
          facings[cell].push_back(static_cast<float>(facing));
        else
          hidden[cell] += 1.0;
        const std::uint8_t* seen = facing >= kTrusted ? pixel_of(camera, view, point) : nullptr;
        if (!seen) continue;
        const double counts = facing * facing;  // the area that a pixel averages over grows as 1 / facing
        const double brightness = splat::brightness(light, motion.rotation * normal);
        sums[cell] += counts / (255.0 * brightness) * Vector3(seen[0], seen[1], seen[2]);
        weights[cell] += counts;
      }
    });
  }
  const auto few = static_cast<std::size_t>(kFew * static_cast<double>(views.size()));
  for (std::size_t cell = 0; cell < hidden.size(); ++cell) {
    if (std::vector<float>& all = facings[cell]; few < all.size()) {
      std::nth_element(all.begin(), all.begin() + few, all.end(), std::greater<>());
      surface.facing[cell] = all[few];
    }
    surface.hidden[cell] = hidden[cell] > kHidden * static_cast<double>(views.size());
    if (weights[cell] > 0.0) surface.color[cell] = sums[cell] / weights[cell];
  }
}

// Correlation of the colors with those some columns further and `slope` times that angle along, m per rad.
double repetition(const Surface& surface, double slope) {
  constexpr int kNearest = 3, kFarthest = 9;  // columns: what touches is alike anyway
  Vector3 sum = Vector3::Zero();
  double products = 0.0, squares = 0.0, count = 0.0;
  for (int row = 0; row < surface.rows; ++row)
    for (int column = 0; column < kColumns; ++column) {
      const std::optional<Vector3>& here = surface.color[surface.cell(row, column)];
      for (int apart = kNearest; here && apart <= kFarthest; ++apart) {
        const double s = surface.arclength(row) + slope * apart * kTurn / kColumns;
        if (s < 0.0 || s > surface.chain.length) continue;
        const std::optional<Vector3> there = surface.color_at(s, (column + apart) % kColumns);
        if (!there) continue;
        sum += *here + *there;
        products += 2.0 * here->dot(*there);
        squares += here->squaredNorm() + there->squaredNorm();
        count += 2.0;
      }
    }
  const double mean = count > 0.0 ? sum.squaredNorm() / count : 0.0;
  return squares > mean ? (products - mean) / (squares - mean) : 0.0;
}

double slope_of_texture(const Surface& surface) {
  const double steepest = kSteepest * 0.5 * surface.chain.diameter;
  double best = kRepeats, slope = 0.0;
  for (int i = 0; i < kSlopes; ++i) {
    const double tried = steepest * (2.0 * i / (kSlopes - 1) - 1.0), found = repetition(surface, tried);
    if (found > best) best = found, slope = tried;
  }
  return slope;
}

// How bright the same texture is on each side of the rope, by column; any unit.
using Light = std::vector<double>;

// Along the rope a texture shows all that it has on every side, so that the means of columns differ by their light.
// Where no camera looked, the first two harmonics of the brightness around the rope go on: more of them is hardly in
// the light of a convex, dull thing (Ramamoorthi and Hanrahan 2001). Where the rope was seen only at a slant, the
// Gaussians there say where between that and the nearest measured column the light is; alone they can be far too
// bright, where others hide them.
Light light_of(const Surface& surface, const std::vector<Place>& places, const splat::Gaussians& g) {
  constexpr double kEnough = 20.0;  // Gaussians in a column, for a mean over the texture
  constexpr double kSecond = 0.5;   // columns' worth of a second harmonic of zero: it must be told, not guessed
  using Vector5 = Eigen::Matrix<double, 5, 1>;
  const auto harmonics = [](double side) {
    return Vector5(1.0, std::cos(side), std::sin(side), std::cos(2.0 * side), std::sin(2.0 * side));
  };
  std::vector<double> sums(kColumns, 0.0), counts(kColumns, 0.0);
  for (int i = 0; i < g.count; ++i) {
    const std::size_t cell = surface.cell_at(places[i].arclength, places[i].angle);
    if (!on_side(surface, places[i]) || surface.facing[cell] < kUnseen || surface.hidden[cell]) continue;
    const double opacity = 1.0 / (1.0 + std::exp(-static_cast<double>(g.opacity_logit[i])));
    sums[cell % kColumns] += opacity * splat::base_color(g, i).mean();
    counts[cell % kColumns] += opacity;
  }
  Light light(kColumns, 0.0);
  math::MatrixX design(kColumns, 5);
  math::VectorX means(kColumns);
  Eigen::Index seen = 0;
  for (int column = 0; column < kColumns; ++column) {
    double sum = 0.0;
    int count = 0;
    for (int row = 0; row < surface.rows; ++row)
      if (const std::optional<Vector3>& color = surface.color[surface.cell(row, column)]) sum += color->mean(), ++count;
    if (2 * count < surface.rows) continue;
    light[column] = sum / count;
    design.row(seen) = harmonics(Surface::angle(column));
    means[seen++] = light[column];
  }
  const Light even(kColumns, 1.0);
  if (2 * seen < kColumns) return even;  // less than half of the rope tells nothing of the other
  const auto columns = design.topRows(seen);
  const auto brightness = means.head(seen);
  math::MatrixX normal = columns.transpose() * columns;
  normal.diagonal().tail<2>().array() += kSecond;
  const Vector5 found = normal.ldlt().solve(columns.transpose() * brightness);
  const double left = (columns * found - brightness).squaredNorm();
  const double differs = (brightness.array() - brightness.mean()).square().sum();
  if (!(left < (1.0 - kLit) * differs) || !(found[0] > 0.0)) return even;
  const Light measured = light;
  for (int column = 0; column < kColumns; ++column) {
    if (measured[column] > 0.0) continue;
    double value = found.dot(harmonics(Surface::angle(column)));
    if (counts[column] >= kEnough) {
      double next = 0.0;
      for (int apart = 1; next == 0.0; ++apart)
        next = std::max(measured[(column + apart) % kColumns], measured[(column - apart + 2 * kColumns) % kColumns]);
      value = std::clamp(sums[column] / counts[column], std::min(value, next), std::max(value, next));
    }
    light[column] = std::max(kDarkest * found[0], value);
  }
  return light;
}

// What the seen surface tells of all of it.
struct SeenTexture {
  Surface surface;
  std::vector<Place> places;  // of the Gaussians
  double slope = 0.0;         // of the helix along which colors repeat, m per rad
  Light light;
};
SeenTexture texture_of(const chain::Chain& chain, std::span<const Viewpoint> views, const splat::Gaussians& gaussians) {
  SeenTexture texture{Surface(chain), {}, 0.0, {}};
  look(views, gaussians.light, texture.surface);
  for (int i = 0; i < gaussians.count; ++i) texture.places.push_back(place_of(texture.surface, gaussians, i));
  texture.slope = slope_of_texture(texture.surface);
  texture.light = light_of(texture.surface, texture.places, gaussians);
  return texture;
}

// From the nearest colors along the helix in both directions, the nearer the more, in the light of this side.
std::optional<Vector3> guessed(const SeenTexture& texture, double arclength, double angle) {
  const Surface& surface = texture.surface;
  const Light& light = texture.light;
  const int column = static_cast<int>(angle / kTurn * kColumns);
  Vector3 sum = Vector3::Zero();
  double weight = 0.0;
  for (const int direction : {1, -1})
    for (int apart = 1; apart < kColumns; ++apart) {
      const int there = ((column + direction * apart) % kColumns + kColumns) % kColumns;
      const double turn = direction * apart * kTurn / kColumns, s = arclength + texture.slope * turn;
      const std::optional<Vector3> color =
          s >= 0.0 && s <= surface.chain.length ? surface.color_at(s, there) : std::nullopt;
      if (!color) continue;
      sum += light[column] / light[there] * *color / (turn * turn);
      weight += 1.0 / (turn * turn);
      break;
    }
  if (weight == 0.0) return {};
  return Vector3((sum / weight).cwiseMin(1.0));
}

// Evenly over the part of the surface that no camera saw.
struct Guess {
  double arclength, angle;
  Vector3 color;
};
std::vector<Guess> guesses(const SeenTexture& texture, double radius, double spacing) {
  const Surface& surface = texture.surface;
  const chain::Chain& chain = surface.chain;
  const int rows = std::max(1, static_cast<int>(chain.length / spacing)),
            columns = std::max(3, static_cast<int>(kTurn * radius / spacing));
  std::vector<Guess> out;
  for (int row = 0; row < rows; ++row)
    for (int column = 0; column < columns; ++column) {
      const double s = (row + 0.5) * chain.length / rows;
      const double angle = (column + (row % 2 ? 0.75 : 0.25)) * kTurn / columns;  // every other row between these
      const std::size_t cell = surface.cell_at(s, angle);
      if (surface.facing[cell] >= kUnseen || surface.hidden[cell]) continue;
      if (const std::optional<Vector3> color = guessed(texture, s, angle)) out.push_back({s, angle, *color});
    }
  return out;
}

void put(const Surface& surface, const Guess& guess, double radius, double spacing, int i,
         splat::Gaussians& gaussians) {
  const chain::Chain& chain = surface.chain;
  const Vector3 normal = surface.normal(guess.angle);
  const Vector3 mean = guess.arclength * chain.direction + radius * normal;
  math::Matrix3 axes;  // along the rope, around it, across the surface
  axes << chain.direction, normal.cross(chain.direction), normal;
  const Eigen::Quaterniond turn(axes);
  const double along = kCoverage * spacing;
  const double sizes[3] = {along, along, kThickness * chain.diameter};
  for (int c = 0; c < 3; ++c) {
    gaussians.mean[3 * i + c] = static_cast<float>(mean[c]);
    gaussians.log_scale[3 * i + c] = static_cast<float>(std::log(sizes[c]));
  }
  const double wxyz[4] = {turn.w(), turn.x(), turn.y(), turn.z()};
  for (int c = 0; c < 4; ++c) gaussians.rotation[4 * i + c] = static_cast<float>(wxyz[c]);
  gaussians.opacity_logit[i] = kOpaque;
  gaussians.link_logits[gaussians.links * i + chain::link_at(chain, guess.arclength)] = kHard;
  splat::set_base_color(gaussians, i, guess.color);
  gaussians.guessed[i] = kGuessed;
}

// What was seen only at a slant has the place and size that its outline asks for, but a color that one row of pixels
// tells. It gets the texture's, the more the flatter it was seen, and that from every direction.
void color_slanted(const SeenTexture& texture, splat::Gaussians& g) {
  const Surface& surface = texture.surface;
  const std::size_t size = 3 * static_cast<std::size_t>(g.sh_coefficients());
  for (int i = 0; i < g.count; ++i) {
    const Place& at = texture.places[i];
    const std::size_t cell = surface.cell_at(at.arclength, at.angle);
    if (!on_side(surface, at) || surface.facing[cell] >= kTrusted || surface.hidden[cell]) continue;
    const std::optional<Vector3> color = guessed(texture, at.arclength, at.angle);
    if (!color) continue;
    const double share = std::max(0.0, surface.facing[cell] / kTrusted), own = share * share;
    g.guessed[i] = kSlanted;
    splat::set_base_color(g, i, own * splat::base_color(g, i) + (1.0 - own) * *color);
    for (std::size_t c = 3; c < size; ++c) g.sh[size * i + c] *= static_cast<float>(own);
  }
}

}  // namespace

int finish_unseen(const chain::Chain& chain, std::span<const Viewpoint> views, splat::Gaussians& gaussians) {
  const SeenTexture texture = texture_of(chain, views, gaussians);
  const Surface& surface = texture.surface;
  std::vector<int> kept;
  std::vector<double> radii;
  for (int i = 0; i < gaussians.count; ++i) {
    const Place& at = texture.places[i];
    const std::size_t cell = surface.cell_at(at.arclength, at.angle);
    const bool side = on_side(surface, at);
    if (!side || surface.facing[cell] >= kUnseen || surface.hidden[cell]) kept.push_back(i);
    if (side && surface.facing[cell] >= kTrusted) radii.push_back(at.radius);
  }
  if (radii.empty()) return 0;
  const double radius = math::median(radii);
  color_slanted(texture, gaussians);
  // as dense as where it was seen
  const double cells = static_cast<double>(
      std::count_if(surface.facing.begin(), surface.facing.end(), [](double facing) { return facing >= kTrusted; }));
  const double area = cells / static_cast<double>(surface.facing.size()) * kTurn * radius * chain.length;
  const double spacing = std::sqrt(area / static_cast<double>(radii.size()));
  const std::vector<Guess> found = guesses(texture, radius, spacing);
  if (found.empty()) return 0;
  gaussians = rows_of(gaussians, kept, static_cast<int>(found.size()));
  for (std::size_t i = 0; i < found.size(); ++i)
    put(surface, found[i], radius, spacing, static_cast<int>(kept.size() + i), gaussians);
  return static_cast<int>(found.size());
}

std::vector<std::optional<TextureColor>> texture_colors(const chain::Chain& chain, std::span<const Viewpoint> views,
                                                        const splat::Gaussians& gaussians) {
  const SeenTexture texture = texture_of(chain, views, gaussians);
  std::vector<std::optional<TextureColor>> out(gaussians.count);
  for (int i = 0; i < gaussians.count; ++i) {
    const Place& at = texture.places[i];
    const std::size_t cell = texture.surface.cell_at(at.arclength, at.angle);
    if (!on_side(texture.surface, at) || texture.surface.hidden[cell]) continue;
    if (const std::optional<Vector3> color = guessed(texture, at.arclength, at.angle))
      out[i] = {*color, texture.surface.facing[cell]};
  }
  return out;
}

void keep_guessed(const splat::Gaussians& before, splat::Gaussians& trained) {
  CHAINSPLAT_CHECK(before.count == trained.count && before.degree == trained.degree, std::to_string(trained.count));
  const std::ptrdiff_t size = 3 * before.sh_coefficients();
  for (int i = 0; i < before.count; ++i) {
    if (before.guessed[i] == kGuessed) copy_row(before, i, trained, i);
    if (before.guessed[i] == kSlanted) std::copy_n(before.sh.begin() + size * i, size, trained.sh.begin() + size * i);
  }
}

}  // namespace chainsplat::recognition
