#include "force/track.h"

#include <algorithm>
#include <cmath>

namespace chainsplat::force {

MatrixX first_belief(const Track& track) {
  const auto places = static_cast<Eigen::Index>(track.arclengths.size());
  VectorX place = VectorX::Constant(places + 1, 1.0 / (places * (1.0 + track.odds)));
  place[0] = track.odds / (1.0 + track.odds);
  return place * first_clock(track).transpose();
}

VectorX first_clock(const Track& track) {
  const VectorX likely = (-0.5 * track.clock.array().square()).exp();
  return likely / likely.sum();
}

MatrixX transition(const Track& track, double interval) {
  const auto places = static_cast<Eigen::Index>(track.arclengths.size());
  MatrixX out = MatrixX::Zero(places + 1, places + 1);
  const double leave = 1.0 - std::exp(-interval / track.options.contact_time), come = leave / track.odds;
  const double slide = track.options.slide * track.arclengths.back();  // m/sqrt(s); the last arclength is the length
  const double variance = slide * slide * interval;
  out(0, 0) = 1.0 - come;
  out.col(0).tail(places).setConstant(come / places);
  for (Eigen::Index from = 0; from < places; ++from) {
    VectorX to(places);
    for (Eigen::Index i = 0; i < places; ++i)
      to[i] = std::exp(-0.5 * std::pow(track.arclengths[i] - track.arclengths[from], 2) / variance);
    out(0, 1 + from) = leave;
    out.col(1 + from).tail(places) = (1.0 - leave) / to.sum() * to;
  }
  return out;
}

MatrixX likelihood(const Track& track, const MatrixX& logs, double interval) {
  const MatrixX counted = std::min(1.0, interval / track.options.error_memory) * logs;
  return (counted.array() - counted.maxCoeff()).exp();
}

MatrixX posterior(const MatrixX& before, const MatrixX& likely) {
  const MatrixX out = before.cwiseProduct(likely);
  return out / out.sum();
}

}  // namespace chainsplat::force
