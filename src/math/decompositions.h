// decompositions.h - Eigen's decompositions of matrices of any size, and those of small ones that are costly to
// compile, compiled once, in decompositions.cpp, orthogonal_decompositions.cpp and eigenvalues.cpp. Every source that
// factors a matrix includes this, else it compiles the same code again (design.md, 'Compile time'). The instances are
// for plain matrices: a sum or product is to be evaluated first, as in MatrixX(a + b).ldlt().
#pragma once
#include <Eigen/Dense>

#include "chainsplat/math.h"

namespace Eigen {

extern template class LDLT<MatrixXd>;
extern template LDLT<MatrixXd>& LDLT<MatrixXd>::compute<MatrixXd>(const EigenBase<MatrixXd>&);
extern template void LDLT<MatrixXd>::_solve_impl_transposed<true>(const VectorXd&, VectorXd&) const;
extern template void LDLT<MatrixXd>::_solve_impl_transposed<true>(const MatrixXd&, MatrixXd&) const;
extern template void LDLT<MatrixXd>::_solve_impl_transposed<true>(const MatrixXd::IdentityReturnType&, MatrixXd&) const;

extern template class LLT<MatrixXd>;
extern template LLT<MatrixXd>& LLT<MatrixXd>::compute<MatrixXd>(const EigenBase<MatrixXd>&);
extern template void LLT<MatrixXd>::_solve_impl_transposed<true>(const VectorXd&, VectorXd&) const;
extern template void LLT<MatrixXd>::_solve_impl_transposed<true>(const MatrixXd&, MatrixXd&) const;
extern template void LLT<MatrixXd>::_solve_impl_transposed<true>(const MatrixXd::IdentityReturnType&, MatrixXd&) const;

extern template class ColPivHouseholderQR<MatrixXd>;
extern template ColPivHouseholderQR<MatrixXd>& ColPivHouseholderQR<MatrixXd>::compute<MatrixXd>(
    const EigenBase<MatrixXd>&);
extern template void ColPivHouseholderQR<MatrixXd>::_solve_impl(const VectorXd&, VectorXd&) const;
extern template void ColPivHouseholderQR<MatrixXd>::_solve_impl(const MatrixXd&, MatrixXd&) const;

extern template class HouseholderQR<MatrixXd>;
extern template void HouseholderQR<MatrixXd>::_solve_impl(const VectorXd&, VectorXd&) const;
extern template void HouseholderQR<MatrixXd>::_solve_impl(const MatrixXd&, MatrixXd&) const;

extern template class CompleteOrthogonalDecomposition<MatrixXd>;
extern template CompleteOrthogonalDecomposition<MatrixXd>& CompleteOrthogonalDecomposition<MatrixXd>::compute<MatrixXd>(
    const EigenBase<MatrixXd>&);
extern template void CompleteOrthogonalDecomposition<MatrixXd>::_solve_impl(const VectorXd&, VectorXd&) const;
extern template void CompleteOrthogonalDecomposition<MatrixXd>::_solve_impl(const MatrixXd&, MatrixXd&) const;

extern template class PartialPivLU<MatrixXd>;  // of MatrixXd::inverse()

extern template class SelfAdjointEigenSolver<MatrixXd>;
extern template SelfAdjointEigenSolver<MatrixXd>& SelfAdjointEigenSolver<MatrixXd>::compute<MatrixXd>(
    const EigenBase<MatrixXd>&, int);
extern template class GeneralizedSelfAdjointEigenSolver<MatrixXd>;
extern template class SelfAdjointEigenSolver<Matrix2d>;
extern template SelfAdjointEigenSolver<Matrix2d>& SelfAdjointEigenSolver<Matrix2d>::compute<Matrix2d>(
    const EigenBase<Matrix2d>&, int);
extern template class SelfAdjointEigenSolver<Matrix3d>;
extern template SelfAdjointEigenSolver<Matrix3d>& SelfAdjointEigenSolver<Matrix3d>::compute<Matrix3d>(
    const EigenBase<Matrix3d>&, int);

extern template class LDLT<Matrix3d>;
extern template LDLT<Matrix3d>& LDLT<Matrix3d>::compute<Matrix3d>(const EigenBase<Matrix3d>&);
extern template void LDLT<Matrix3d>::_solve_impl_transposed<true>(const Vector3d&, Vector3d&) const;

}  // namespace Eigen
