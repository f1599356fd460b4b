// Of decompositions.h: Cholesky and LU.
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

template class PartialPivLU<MatrixXd>;

template class LDLT<Matrix3d>;
template LDLT<Matrix3d>& LDLT<Matrix3d>::compute<Matrix3d>(const EigenBase<Matrix3d>&);
template void LDLT<Matrix3d>::_solve_impl_transposed<true>(const Vector3d&, Vector3d&) const;

}  // namespace Eigen
