// What a recording may be given wrongly, as the shared unknowns of one least-squares problem: which corrections vary,
// and where each stands among the unknowns (mathematics.md 6.10).
#pragma once
#include <string>
#include <vector>

#include "src/silhouette/correction_equations.h"

namespace chainsplat::silhouette {

// Where one kind of correction of one subject stands among the shared unknowns, which are in units of its deviation.
struct Column {
  const capture::CorrectedQuantity* quantity = nullptr;
  int camera = -1;         // -1: of base, grasp, object or table
  int number = 0;          // of its first number among those of all columns
  int first = -1;          // among the shared unknowns; -1: held
  double deviation = 0.0;  // in the quantity's unit
};
bool is(const Column& column, const char* name);
bool is_mask_start(const Column& column);

struct Layout {
  std::vector<Column> columns;
  int numbers = 0;  // of all columns
  int size = 0;     // of those that are not held
};

// Outlines say nothing of these.
bool of_colors(const capture::CorrectedQuantity& quantity);

Layout layout_of(const capture::Capture& capture, const chain::Chain& chain, const CorrectionOptions& options);
// The columns that views of each camera depend on, in the order of SharedOfView.
std::vector<SharedPlaces> places_of(const Layout& layout, int cameras);
// The corrections, without deviations, where the shared unknowns are `x`, and the other way round.
capture::Corrections corrections_at(const Layout& layout, const std::vector<capture::Camera>& cameras,
                                    const math::VectorX& x);
math::VectorX shared_of(const Layout& layout, const std::vector<capture::Camera>& cameras,
                        const capture::Corrections& corrections);
// The covariance of all numbers of the corrections, in their units: 0 for those that are held.
math::MatrixX covariance_of_numbers(const Layout& layout, const math::MatrixX& shared);

// One thing that may be all that is wrong with a recording: these directions of the shared unknowns, by column.
struct Direction {
  std::string name, in_doubt;  // as in Cause
  math::MatrixX directions;
};
// What recordings are given wrongly most often, each alone and together with masks that are wider than the rope.
std::vector<Direction> single_causes(const Layout& layout, const std::vector<capture::Camera>& cameras);

}  // namespace chainsplat::silhouette
