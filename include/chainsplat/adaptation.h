// chainsplat/adaptation.h - parameters that follow a rope while it is estimated (identification, recursive).
//
// An extended Kalman filter on (theta, thetadot, parameters): the rope is predicted from frame to frame with the
// derivatives of the variational equation, and each estimated theta corrects state and parameters together. Old frames
// are forgotten: with every second the parameters' information fades by exp(-1/memory) towards what a rope of this kind
// is expected to keep, so that a direction that nothing excites returns to that and not beyond.
#pragma once
#include <string>
#include <vector>

#include "chainsplat/dynamics.h"

namespace chainsplat::adaptation {

using math::MatrixX;
using math::VectorX;

struct Options {
  double memory = 5.0;        // s; infinite: nothing is forgotten
  double spread = 0.5;        // sd of a log or logit, or 0.1 rad of a rest angle times this over 0.5, when all is
                              // forgotten: how far a parameter may have moved
  double disturbance = 2.0;   // rad/s^2 a frame, accelerations that the model lacks (SPEC 6)
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

class Adaptation {
 public:
  // `estimates`: the start, names and covariance. Throws InputError where they have no parameter.
  Adaptation(const chain::Chain& chain, const dynamics::Parameters& parameters, const dynamics::Estimates& estimates,
             const Options& options);
  // Throws InputError where times do not increase or sizes do not fit. False where the frame was left out (gate).
  bool observe(const Observation& seen, const dynamics::BaseFunction& base);

  const dynamics::Parameters& parameters() const { return now_; }
  // The given ones with values, standard errors and covariance brought up to date.
  dynamics::Estimates estimates() const;
  dynamics::InitialState state() const { return {time_, theta_, thetadot_}; }
  int used() const { return used_; }
  int left_out() const { return left_out_; }
  int restarts() const { return restarts_; }

 private:
  void start(const Observation& seen);
  void forget(double interval);
  bool predict(double time, const dynamics::BaseFunction& base);
  VectorX sigma_of(const Observation& seen) const;

  chain::Chain chain_;
  dynamics::Parameters first_, now_;
  dynamics::Estimates known_;
  Options options_;
  std::vector<std::string> names_;    // of the parameters among the estimates
  std::vector<Eigen::Index> places_;  // of those in the estimates
  VectorX change_;                    // of the parameters since the start
  MatrixX covariance_;                // of (theta, thetadot, change)
  VectorX expected_;                  // variance when all is forgotten
  VectorX theta_, thetadot_;
  double time_ = 0.0;
  bool started_ = false;
  int used_ = 0, left_out_ = 0, restarts_ = 0;
  int rejected_in_a_row_ = 0;
};

}  // namespace chainsplat::adaptation
