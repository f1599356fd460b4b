// Of decompositions.h: those by orthogonal matrices.
#include "src/math/decompositions.h"

namespace Eigen {

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

}  // namespace Eigen
