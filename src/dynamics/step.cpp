// RODAS3 and the implicit-in-velocity Euler step (mathematics.md 4), with their derivatives.
#include "step.h"

#include <cmath>

namespace chainsplat::dynamics {
namespace {

constexpr double kAngleBound = 1e3;  // rad, beyond which a motion counts as diverged
constexpr double kRateBound = 1e5;   // rad/s
constexpr double kProbe = 3e-6;      // e of the second derivatives: truncation and rounding both below 1e-8

// RODAS3 (mathematics.md 4): stage i adds gamma_i h f_t, and the stages before it as history() says.
constexpr double kTimeWeight[4] = {0.5, 1.5, 0.0, 0.0};  // gamma_i

// What stage i takes of the stages before it, of the angles, the rates or their derivatives.
template <class Value>
void add_history(int i, double h, const Value (&k)[4], Value& to) {
  if (i == 1) to += (4.0 / h) * k[0];
  if (i == 2) to += (k[0] - k[1]) / h;
  if (i == 3) to += (k[0] - k[1] - (8.0 / 3.0) * k[2]) / h;
}

}  // namespace

Step::Step(const Model& model)
    : engine_(make_engine(model)),
      stage_(make_engine(model)),
      engine(*engine_),
      internal(model),
      factor(model.chain.angles()),
      rodas_(model.parameters.integrator == Integrator::rodas3),
      stage_internal_(internal) {
  const int n = model.chain.angles();
  for (VectorX* v : {&right_theta_, &stage_theta_, &stage_thetadot_, &stage_acceleration_, &work_}) v->setZero(n);
  for (int i = 0; i < 4; ++i) k_theta_[i].setZero(n), k_rate_[i].setZero(n);
  if (!internal.present) return;
  for (VectorX* v : {&internal_state, &right_z_, &stage_z_, &k_z_[0], &k_z_[1], &k_z_[2], &k_z_[3]})
    v->setZero(internal.size);
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
  engine.internal_state = internal_state;
  engine.place(now.motion, theta, thetadot, true);
  if (internal.present) internal.linearize(engine, thetadot, internal_state);
  // M a = force, so the first stage needs no factor of M; the tangents need a itself
  if (!factor_mass(engine)) return false;
  engine.accelerate();
  engine.linearize(now.jerk);
  if (now.step == 0.0) return true;
  const double g = rodas_ ? 0.5 * now.step : now.step;
  factor.matrix = engine.mass + g * engine.damping;
  if (rodas_) factor.matrix += (g * g) * engine.stiffness;
  if (internal.present && !internal.prepare(g)) return false;
  if (internal.present) internal.add_to(factor.matrix);
  return factor.factor();
}

// Acceleration at the stage's state under the base motion of the next node.
bool Step::evaluate(const trajectory::BaseMotion& motion, bool slopes) {
  if (!bounded(stage_theta_, stage_thetadot_)) return false;
  stage_->internal_state = stage_z_;
  stage_->place(motion, stage_theta_, stage_thetadot_, slopes);
  if (!factor_mass(*stage_)) return false;
  stage_->accelerate();
  if (slopes) stage_->linearize(Vector6::Zero());
  if (internal.present) stage_internal_.linearize(*stage_, stage_thetadot_, stage_z_);
  return true;
}

// (1/G - J) k = r for r = (right_theta, M^-1 of `work`, right_z), G = gamma H: mathematics.md 4
void Step::solve_stage(int i, double g) {
  work_.noalias() -= g * (engine.stiffness * right_theta_);
  if (internal.present) internal.take_off(right_theta_, right_z_, work_);
  work_ *= g;
  factor.solve(work_);
  k_rate_[i] = work_;
  k_theta_[i] = g * (right_theta_ + work_);
  if (!internal.present) return;
  k_z_[i] = right_z_;
  internal.solve(k_theta_[i], k_rate_[i], k_z_[i]);
}

void Step::right_internal(int i, double h) {
  if (!internal.present) return;
  right_z_ = i < 2 ? internal.rate() : stage_internal_.rate();
  add_history(i, h, k_z_, right_z_);
}

// The derivatives of stage i, of which the stages before it and the value k_i are there.
bool Step::vary_stage(int i, double h, std::size_t node, const VectorX& theta, const VectorX& thetadot, Variation& v) {
  const double g = 0.5 * h;
  // of the right side but for the second derivatives; the part of the rates times M^-1
  if (i < 2) {
    v.right = v.y, v.work = v.acceleration, v.right_z = v.z_rate;
  } else {
    v.right = v.stage_y;
    v.force(*stage_, stage_internal_, node + 1, 0.0, v.stage_x, v.stage_y, v.stage_z, v.work);
    stage_->solve_mass(v.work);
    if (internal.present) stage_internal_.slope(v.stage_x, v.stage_y, v.stage_z, v.right_z);
  }
  add_history(i, h, v.k_x, v.right);
  add_history(i, h, v.k_y, v.work);
  if (internal.present) add_history(i, h, v.k_z, v.right_z);
  for (const double e : {kProbe, -kProbe}) {
    const double after = e * h * kTimeWeight[i];
    v.probe_theta = theta + e * k_theta_[i], v.probe_rate = thetadot + e * k_rate_[i];
    if (internal.present) stage_->internal_state = internal_state + e * k_z_[i];
    stage_->place(v.base(node, after), v.probe_theta, v.probe_rate, true);
    if (!factor_mass(*stage_)) return false;
    stage_->accelerate();
    stage_->linearize(Vector6::Zero());
    if (internal.present) {
      stage_internal_.linearize(*stage_, v.probe_rate, stage_->internal_state);
      stage_internal_.slope(v.x, v.y, v.z, v.k_z[i]);
      v.right_z += v.k_z[i] / (2.0 * e);
    }
    v.force(*stage_, stage_internal_, node, after, v.x, v.y, v.z, v.k_y[i]);
    stage_->solve_mass(v.k_y[i]);
    v.work += v.k_y[i] / (2.0 * e);
  }
  v.k_y[i].noalias() = engine.mass * v.work;
  v.k_y[i].noalias() -= g * (engine.stiffness * v.right);
  if (internal.present) internal.take_off(v.right, v.right_z, v.k_y[i]);
  v.k_y[i] *= g;
  factor.solve_columns(v.k_y[i]);
  v.k_x[i] = g * (v.right + v.k_y[i]);
  if (!internal.present) return true;
  v.k_z[i] = v.right_z;
  internal.solve(v.k_x[i], v.k_y[i], v.k_z[i]);
  return true;
}

bool Step::advance(double h, const trajectory::BaseMotion& next, VectorX& theta, VectorX& thetadot,
                   Variation* variation, std::size_t node) {
  const double g = 0.5 * h;
  if (!rodas_) {
    work_ = h * engine.force;
    factor.solve(work_);
    thetadot += work_;
    theta += h * thetadot;
    return true;
  }
  Variation* const v = variation && variation->exact ? variation : nullptr;
  // stages 1 and 2: f = (thetadot, a), f_t = (0, M^-1 drive_rate)
  for (int i = 0; i < 2; ++i) {
    right_theta_ = thetadot;
    add_history(i, h, k_theta_, right_theta_);
    work_ = engine.force + (kTimeWeight[i] * h) * engine.drive_rate;
    if (i == 1) work_.noalias() += (4.0 / h) * (engine.mass * k_rate_[0]);
    right_internal(i, h);
    solve_stage(i, g);
    if (v && !vary_stage(i, h, node, theta, thetadot, *v)) return false;
  }
  // stages 3 and 4: f at states of their own
  stage_theta_ = theta + 2.0 * k_theta_[0];
  stage_thetadot_ = thetadot + 2.0 * k_rate_[0];
  if (internal.present) stage_z_ = internal_state + 2.0 * k_z_[0];
  if (v) v->stage_x = v->x + 2.0 * v->k_x[0], v->stage_y = v->y + 2.0 * v->k_y[0];
  if (v && internal.present) v->stage_z = v->z + 2.0 * v->k_z[0];
  for (int i = 2; i < 4; ++i) {
    if (!evaluate(next, v)) return false;
    right_theta_ = stage_thetadot_;
    add_history(i, h, k_theta_, right_theta_);
    stage_acceleration_ = stage_->acceleration;
    add_history(i, h, k_rate_, stage_acceleration_);
    work_.noalias() = engine.mass * stage_acceleration_;
    right_internal(i, h);
    solve_stage(i, g);
    if (v && !vary_stage(i, h, node, theta, thetadot, *v)) return false;
    stage_theta_ += k_theta_[i];
    stage_thetadot_ += k_rate_[i];
    if (internal.present) stage_z_ += k_z_[i];
    if (v) v->stage_x += v->k_x[i], v->stage_y += v->k_y[i];
    if (v && internal.present) v->stage_z += v->k_z[i];
  }
  theta = stage_theta_, thetadot = stage_thetadot_;
  if (internal.present) internal_state = stage_z_;
  if (v) v->x = v->stage_x, v->y = v->stage_y;
  if (v && internal.present) v->z = v->stage_z;
  return true;
}

Variation::Variation(int n, Eigen::Index unknowns, Forces forces, Base base_motion, bool is_exact,
                     Eigen::Index internal)
    : forces_of(std::move(forces)), base(std::move(base_motion)), exact(is_exact), mass_(n) {
  for (MatrixX* m : {&x, &y, &acceleration, &forces_, &predicted_x_, &predicted_y_}) m->setZero(n, unknowns);
  if (internal == 0) return;
  for (MatrixX* m : {&z, &z_rate, &predicted_z_, &right_z, &stage_z, &k_z[0], &k_z[1], &k_z[2], &k_z[3]})
    m->setZero(internal, unknowns);
}

void Variation::force(Engine& engine, const InternalState& internal, std::size_t node, double after, const MatrixX& s_x,
                      const MatrixX& s_y, const MatrixX& s_z, MatrixX& forces) {
  forces_of(engine, node, after, forces_);
  forces.noalias() = forces_ - engine.stiffness * s_x - engine.damping * s_y;
  if (internal.present) internal.take_off_moment(s_z, forces);
}

bool Variation::start(Engine& engine, const InternalState& internal, std::size_t node) {
  force(engine, internal, node, 0.0, x, y, z, acceleration);
  mass_.matrix = engine.mass;
  if (!mass_.factor()) return false;
  mass_.solve_columns(acceleration);
  if (!internal.present) return true;
  internal.slope(x, y, z, z_rate);
  internal.add_unknowns(tangents, z_rate);
  return true;
}

void Variation::advance(Engine& engine, const InternalState& internal, const Factor& factor, std::size_t node,
                        double g) {
  forces_of(engine, node, 0.0, forces_);
  predicted_y_ = y + g * acceleration;
  predicted_x_ = x + (2.0 * g) * y + (g * g) * acceleration;
  acceleration.noalias() = -engine.stiffness * predicted_x_;
  acceleration.noalias() -= engine.damping * predicted_y_;
  acceleration += forces_;
  if (internal.present) {
    // z_rate = (z - predicted z) / g; its solve() wants that over g, and the rates' own part
    predicted_z_ = z + g * z_rate;
    z = predicted_z_ / g;
    internal.add_unknowns(tangents, z);
    z_rate = z;
    internal.solve(predicted_x_, predicted_y_, z_rate);
    internal.take_off_moment(z_rate, acceleration);
  }
  factor.solve_columns(acceleration);
  y = predicted_y_ + g * acceleration;
  x = predicted_x_ + (g * g) * acceleration;
  if (!internal.present) return;
  internal.solve(x, y, z);
  z_rate = (z - predicted_z_) / g;
}

Stepper::Stepper(const Model& model) : step_(std::make_unique<Step>(model)) {}
Stepper::~Stepper() = default;

const VectorX& Stepper::acceleration(const trajectory::BaseMotion& base, const VectorX& theta,
                                     const VectorX& thetadot) {
  step_->engine.internal_state.resize(0);
  step_->engine.place(base, theta, thetadot, false);
  if (!step_->engine.factor_mass())
    step_->engine.acceleration.setConstant(NAN);
  else
    step_->engine.accelerate();
  return step_->engine.acceleration;
}

bool Stepper::step(const BaseGrid::Node& now, const trajectory::BaseMotion& next, VectorX& theta, VectorX& thetadot,
                   VectorX* internal_state) {
  if (step_->internal.present)
    step_->internal_state = step_->internal.start(step_->engine, internal_state ? *internal_state : VectorX(), theta);
  const bool good = step_->linearize(now, theta, thetadot) && step_->advance(now.step, next, theta, thetadot) &&
                    step_->bounded(theta, thetadot);
  if (internal_state && step_->internal.present) *internal_state = step_->internal_state;
  return good;
}

}  // namespace chainsplat::dynamics
