// Of decompositions.h: eigenvalues of symmetric matrices.
#include "src/math/decompositions.h"

namespace Eigen {

template class SelfAdjointEigenSolver<MatrixXd>;
template SelfAdjointEigenSolver<MatrixXd>& SelfAdjointEigenSolver<MatrixXd>::compute<MatrixXd>(
    const EigenBase<MatrixXd>&, int);
template class GeneralizedSelfAdjointEigenSolver<MatrixXd>;
template class SelfAdjointEigenSolver<Matrix2d>;
template SelfAdjointEigenSolver<Matrix2d>& SelfAdjointEigenSolver<Matrix2d>::compute<Matrix2d>(
    const EigenBase<Matrix2d>&, int);
template class SelfAdjointEigenSolver<Matrix3d>;
template SelfAdjointEigenSolver<Matrix3d>& SelfAdjointEigenSolver<Matrix3d>::compute<Matrix3d>(
    const EigenBase<Matrix3d>&, int);

}  // namespace Eigen
