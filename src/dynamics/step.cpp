// RODAS3 and the implicit-in-velocity Euler step (SPEC 4).
#include "step.h"

#include <cmath>

namespace chainsplat::dynamics {
namespace {

constexpr double kAngleBound = 1e3;  // rad, beyond which a motion counts as diverged
constexpr double kRateBound = 1e5;   // rad/s

}  // namespace

Step::Step(const Model& model)
    : engine_(make_engine(model)),
      stage_(make_engine(model)),
      engine(*engine_),
      factor(model.chain.angles()),
      rodas_(model.parameters.integrator == Integrator::rodas3) {
  const int n = model.chain.angles();
  for (VectorX* v : {&right_theta_, &stage_theta_, &stage_thetadot_, &stage_acceleration_, &work_}) v->setZero(n);
  for (int i = 0; i < 4; ++i) k_theta_[i].setZero(n), k_rate_[i].setZero(n);
}

bool Step::bounded(const VectorX& theta, const VectorX& thetadot) {
  // written so that NaN fails
  for (Eigen::Index k = 0; k < theta.size(); ++k)
    if (!(std::abs(theta[k]) < kAngleBound && std::abs(thetadot[k]) < kRateBound)) {
      bad_angle = static_cast<int>(k);
      return false;
    }
  return true;
}

bool Step::factor_mass(Engine& at) {
  if (at.factor_mass()) return true;
  bad_angle = at.singular_angle, singular = true;
  return false;
}

bool Step::linearize(const BaseGrid::Node& now, const VectorX& theta, const VectorX& thetadot) {
  engine.place(now.motion, theta, thetadot, true);
  // M a = force, so the first stage needs no factor of M; the tangents need a itself
  if (!factor_mass(engine)) return false;
  engine.accelerate();
  engine.linearize(now.jerk);
  if (now.step == 0.0) return true;
  const double g = rodas_ ? 0.5 * now.step : now.step;
  factor.matrix = engine.mass + g * engine.damping;
  if (rodas_) factor.matrix += (g * g) * engine.stiffness;
  return factor.factor();
}

// Acceleration at the stage's state under the base motion of the next node.
bool Step::evaluate(const trajectory::BaseMotion& motion) {
  if (!bounded(stage_theta_, stage_thetadot_)) return false;
  stage_->place(motion, stage_theta_, stage_thetadot_, false);
  if (!factor_mass(*stage_)) return false;
  stage_->accelerate();
  return true;
}

// (1/G - J) k = r for r = (right_theta, M^-1 of `work`), G = gamma H: SPEC 4
void Step::solve_stage(int i, double g) {
  work_.noalias() -= g * (engine.stiffness * right_theta_);
  work_ *= g;
  factor.solve(work_);
  k_rate_[i] = work_;
  k_theta_[i] = g * (right_theta_ + work_);
}

bool Step::advance(double h, const trajectory::BaseMotion& next, VectorX& theta, VectorX& thetadot) {
  const double g = 0.5 * h;
  if (!rodas_) {
    work_ = h * engine.force;
    factor.solve(work_);
    thetadot += work_;
    theta += h * thetadot;
    return true;
  }
  // stages 1 and 2: f = (thetadot, a), f_t = (0, M^-1 drive_rate)
  right_theta_ = thetadot;
  work_ = engine.force + (0.5 * h) * engine.drive_rate;
  solve_stage(0, g);
  right_theta_ = thetadot + (4.0 / h) * k_theta_[0];
  work_ = engine.force + (1.5 * h) * engine.drive_rate;
  work_.noalias() += (4.0 / h) * (engine.mass * k_rate_[0]);
  solve_stage(1, g);
  // stage 3
  stage_theta_ = theta + 2.0 * k_theta_[0];
  stage_thetadot_ = thetadot + 2.0 * k_rate_[0];
  if (!evaluate(next)) return false;
  right_theta_ = stage_thetadot_ + (k_theta_[0] - k_theta_[1]) / h;
  stage_acceleration_ = stage_->acceleration + (k_rate_[0] - k_rate_[1]) / h;
  work_.noalias() = engine.mass * stage_acceleration_;
  solve_stage(2, g);
  // stage 4
  stage_theta_ += k_theta_[2];
  stage_thetadot_ += k_rate_[2];
  if (!evaluate(next)) return false;
  right_theta_ = stage_thetadot_ + (k_theta_[0] - k_theta_[1] - (8.0 / 3.0) * k_theta_[2]) / h;
  stage_acceleration_ = stage_->acceleration + (k_rate_[0] - k_rate_[1] - (8.0 / 3.0) * k_rate_[2]) / h;
  work_.noalias() = engine.mass * stage_acceleration_;
  solve_stage(3, g);
  theta = stage_theta_ + k_theta_[3];
  thetadot = stage_thetadot_ + k_rate_[3];
  return true;
}

Stepper::Stepper(const Model& model) : step_(std::make_unique<Step>(model)) {}
Stepper::~Stepper() = default;

const VectorX& Stepper::acceleration(const trajectory::BaseMotion& base, const VectorX& theta,
                                     const VectorX& thetadot) {
  step_->engine.place(base, theta, thetadot, false);
  if (!step_->engine.factor_mass())
    step_->engine.acceleration.setConstant(NAN);
  else
    step_->engine.accelerate();
  return step_->engine.acceleration;
}

bool Stepper::step(const BaseGrid::Node& now, const trajectory::BaseMotion& next, VectorX& theta, VectorX& thetadot) {
  return step_->linearize(now, theta, thetadot) && step_->advance(now.step, next, theta, thetadot) &&
         step_->bounded(theta, thetadot);
}

}  // namespace chainsplat::dynamics
