// Private to identification: a chain of many joints is fitted from the parameters of one with few, and smoothly.
//
// A fit takes hundreds of rollouts with their derivatives, most of them on the way from three starts to the region of
// the minimum, and each costs the third power of the number of joints. What a rope is made of does not depend on into
// how many links it is cut: the way is gone with a few links, and the chain itself takes the last steps, in which what
// varies along the rope does so linearly between a few places (design.md, "Identification of many joints").
#pragma once
#include <optional>
#include <span>
#include <vector>

#include "unknowns.h"

namespace chainsplat::identification {

// The same rope with few joints; none where `chain` has few itself, or its joints are of another kind.
std::optional<chain::Chain> with_few_joints(const chain::Chain& chain, const Options& options);

// Points of the recognized centerline, as markers for the chain `few`. Those that the states hardly know are not seen;
// fewer than three times where nothing is known.
Markers centerline_markers(const chain::Chain& chain, const trajectory::Trajectory& base,
                           const chain::States& recognized, const chain::Chain& few, double deviation);

// The unknowns of `chain` that stand for the same rope as `found` does for `few`. The initial state is that of the
// prior.
VectorX start_from(const chain::Chain& few, const Unknowns& few_unknowns, const VectorX& found,
                   const chain::Chain& chain, const Unknowns& unknowns);

// Unknowns x modes: what varies along the rope, initial states too, as curvatures and between few places linearly; each
// of the others alone. The modes are in the order of the unknowns.
MatrixX smooth_modes(const chain::Chain& chain, const Unknowns& unknowns);

// Derivatives by modes instead of unknowns.
std::vector<dynamics::Tangent> along(std::span<const dynamics::Tangent> tangents, const MatrixX& modes);

}  // namespace chainsplat::identification
