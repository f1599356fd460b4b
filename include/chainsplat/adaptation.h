// chainsplat/adaptation.h - the recursive parameter filter: parameters that follow a rope while it is estimated.
//
// An extended Kalman filter on (theta, thetadot, parameters): the rope is predicted from frame to frame with the
// derivatives of the variational equation, and each estimated theta corrects state and parameters together. Old frames
// are forgotten: with every second the parameters' information fades by exp(-1/memory) towards what a rope of this kind
// is expected to keep, so that a direction that nothing excites returns to that and not beyond.
#pragma once
#include <memory>

#include "chainsplat/dynamics.h"

namespace chainsplat::adaptation {

using math::MatrixX;
using math::VectorX;

struct Options {
  double memory = 5.0;        // s; infinite: nothing is forgotten
  double spread = 0.5;        // sd of a log or logit, or 0.1 rad of a rest angle times this over 0.5, when all is
                              // forgotten: how far a parameter may have moved
  double disturbance = 2.0;   // rad/s^2 per frame, accelerations that the model lacks (mathematics.md 6)
  double least_sigma = 2e-3;  // rad, of an estimated angle, whatever the estimator claims
  double inflation = 2.0;     // of the claimed sigma: errors of neighboring frames go together
  double longest_gap = 0.25;  // s without a frame, after which the state starts anew
  double gate = 5.0;          // sd, of an angle's innovation: beyond, the frame is left out
};

// A frame as `estimate` prints it.
struct Observation {
  double time = 0.0;               // s
  VectorX theta, thetadot, sigma;  // rad, rad/s, rad; thetadot and sigma may be empty
};

// What the frames so far have told.
struct Result {
  dynamics::Parameters parameters;
  // Those of the start with values, standard errors and covariance brought up to date.
  dynamics::Estimates estimates;
  dynamics::InitialState state;                // of the rope, now
  int used = 0, left_out = 0, restarts = 0;  // frames; restarts of the state
};

class ParameterFilter {
 public:
  // `estimates`: the start, names and covariance. Throws InputError where they have no parameter.
  ParameterFilter(const chain::Chain& chain, const dynamics::Parameters& parameters,
                  const dynamics::Estimates& estimates, const Options& options);
  ~ParameterFilter();
  // Throws InputError where times do not increase or sizes do not fit. False where the frame was left out (gate).
  bool observe(const Observation& seen, const dynamics::BaseFunction& base);
  Result result() const;

 private:
  struct Belief;
  std::unique_ptr<Belief> belief_;
};

}  // namespace chainsplat::adaptation
