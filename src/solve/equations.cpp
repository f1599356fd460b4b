// Damped normal equations, dense and in the arrow form.
#include "chainsplat/solve.h"
#include "src/math/decompositions.h"

namespace chainsplat::solve {
namespace {

void damp(MatrixX& matrix, const Damping& rule, double damping) {
  if (rule.rule == Damping::Rule::multiply) matrix.diagonal() *= 1.0 + damping;
  if (rule.rule == Damping::Rule::fixed || rule.rule == Damping::Rule::shift) matrix.diagonal().array() += damping;
}

// Of the local unknowns: factored blocks times coupling and times gradient.
struct Eliminated {
  std::vector<MatrixX> coupling;
  std::vector<VectorX> gradient;
  bool positive = true;
};

// Leaves the Schur complement in `shared`. `rule` null: without damping.
Eliminated eliminate(const ArrowEquations& arrow, const Damping* rule, double damping, NormalEquations& shared) {
  Eliminated out;
  shared = {arrow.shared, arrow.gradient};
  if (rule) damp(shared.matrix, *rule, damping);
  MatrixX matrix;
  const auto remove = [&](const ArrowEquations::Local& local, const auto& factor) {
    out.coupling.push_back(factor.solve(local.coupling));
    out.gradient.push_back(factor.solve(local.gradient));
    shared.matrix.noalias() -= local.coupling.transpose() * out.coupling.back();
    shared.gradient.noalias() -= local.coupling.transpose() * out.gradient.back();
  };
  for (const ArrowEquations::Local& local : arrow.local) {
    matrix = local.matrix;
    if (rule) damp(matrix, *rule, damping);
    if (rule && rule->rule == Damping::Rule::shift) {
      const Eigen::LLT<MatrixX> factor(matrix);
      if (!math::is_positive(factor)) {
        out.positive = false;
        return out;
      }
      remove(local, factor);
    } else {
      remove(local, Eigen::LDLT<MatrixX>(matrix));
    }
  }
  return out;
}

// -matrix^-1 gradient of what is damped already.
bool solve_damped(const MatrixX& matrix, const VectorX& gradient, const Damping& rule, VectorX& step) {
  if (rule.rule != Damping::Rule::shift) {
    step = -matrix.ldlt().solve(gradient);
    return true;
  }
  const Eigen::LLT<MatrixX> factor(matrix);
  if (factor.info() != Eigen::Success) return false;
  step = -factor.solve(gradient);
  return true;
}

}  // namespace

NormalEquations dense(const ArrowEquations& arrow) {
  const Eigen::Index shared = arrow.gradient.size();
  Eigen::Index size = shared;
  for (const ArrowEquations::Local& local : arrow.local) size += local.gradient.size();
  NormalEquations out{MatrixX::Zero(size, size), VectorX::Zero(size)};
  out.matrix.topLeftCorner(shared, shared) = arrow.shared;
  out.gradient.head(shared) = arrow.gradient;
  Eigen::Index at = shared;
  for (const ArrowEquations::Local& local : arrow.local) {
    const Eigen::Index own = local.gradient.size();
    out.matrix.block(at, at, own, own) = local.matrix;
    out.matrix.block(at, 0, own, shared) = local.coupling;
    out.matrix.block(0, at, shared, own) = local.coupling.transpose();
    out.gradient.segment(at, own) = local.gradient;
    at += own;
  }
  return out;
}

NormalEquations reduced(const ArrowEquations& arrow) {
  NormalEquations out;
  eliminate(arrow, nullptr, 0.0, out);
  return out;
}

bool damped_step(const NormalEquations& equations, const Damping& rule, double damping, VectorX& step) {
  if (rule.rule == Damping::Rule::none) return solve_damped(equations.matrix, equations.gradient, rule, step);
  MatrixX damped = equations.matrix;
  damp(damped, rule, damping);
  return solve_damped(damped, equations.gradient, rule, step);
}

bool damped_step(const ArrowEquations& equations, const Damping& rule, double damping, VectorX& step) {
  if (equations.local.size() < 2) return damped_step(dense(equations), rule, damping, step);
  NormalEquations shared;
  const Eliminated local = eliminate(equations, &rule, damping, shared);
  VectorX shared_step;
  if (!local.positive || !solve_damped(shared.matrix, shared.gradient, rule, shared_step)) return false;
  Eigen::Index size = shared_step.size();
  for (const VectorX& gradient : local.gradient) size += gradient.size();
  step.resize(size);
  step.head(shared_step.size()) = shared_step;
  Eigen::Index at = shared_step.size();
  for (std::size_t i = 0; i < local.gradient.size(); ++i) {
    step.segment(at, local.gradient[i].size()) = -local.gradient[i] - local.coupling[i] * shared_step;
    at += local.gradient[i].size();
  }
  return true;
}

}  // namespace chainsplat::solve
