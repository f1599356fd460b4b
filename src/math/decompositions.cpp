#include "src/math/decompositions.h"

namespace Eigen {

template class LDLT<MatrixXd>;
template LDLT<MatrixXd>& LDLT<MatrixXd>::compute<MatrixXd>(const EigenBase<MatrixXd>&);
template void LDLT<MatrixXd>::_solve_impl_transposed<true>(const VectorXd&, VectorXd&) const;
template void LDLT<MatrixXd>::_solve_impl_transposed<true>(const MatrixXd&, MatrixXd&) const;
template void LDLT<MatrixXd>::_solve_impl_transposed<true>(const MatrixXd::IdentityReturnType&, MatrixXd&) const;

template class LLT<MatrixXd>;
template LLT<MatrixXd>& LLT<MatrixXd>::compute<MatrixXd>(const EigenBase<MatrixXd>&);
template void LLT<MatrixXd>::_solve_impl_transposed<true>(const VectorXd&, VectorXd&) const;
template void LLT<MatrixXd>::_solve_impl_transposed<true>(const MatrixXd&, MatrixXd&) const;
template void LLT<MatrixXd>::_solve_impl_transposed<true>(const MatrixXd::IdentityReturnType&, MatrixXd&) const;

template class ColPivHouseholderQR<MatrixXd>;
template ColPivHouseholderQR<MatrixXd>& ColPivHouseholderQR<MatrixXd>::compute<MatrixXd>(const EigenBase<MatrixXd>&);
template void ColPivHouseholderQR<MatrixXd>::_solve_impl(const VectorXd&, VectorXd&) const;
template void ColPivHouseholderQR<MatrixXd>::_solve_impl(const MatrixXd&, MatrixXd&) const;

template class HouseholderQR<MatrixXd>;
template void HouseholderQR<MatrixXd>::_solve_impl(const VectorXd&, VectorXd&) const;
template void HouseholderQR<MatrixXd>::_solve_impl(const MatrixXd&, MatrixXd&) const;

template class CompleteOrthogonalDecomposition<MatrixXd>;
template CompleteOrthogonalDecomposition<MatrixXd>& CompleteOrthogonalDecomposition<MatrixXd>::compute<MatrixXd>(
    const EigenBase<MatrixXd>&);
template void CompleteOrthogonalDecomposition<MatrixXd>::_solve_impl(const VectorXd&, VectorXd&) const;
template void CompleteOrthogonalDecomposition<MatrixXd>::_solve_impl(const MatrixXd&, MatrixXd&) const;

template class PartialPivLU<MatrixXd>;

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

template class LDLT<Matrix3d>;
template LDLT<Matrix3d>& LDLT<Matrix3d>::compute<Matrix3d>(const EigenBase<Matrix3d>&);
template void LDLT<Matrix3d>::_solve_impl_transposed<true>(const Vector3d&, Vector3d&) const;

}  // namespace Eigen
