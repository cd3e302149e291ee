//! Symmetric eigenproblems and matrix products: nalgebra for small matrices, faer for large ones.

use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par, Side};
use nalgebra::{DMatrix, Matrix2, Matrix3, Matrix4, Matrix5, Matrix6, SymmetricEigen};

/// Number of degrees of freedom from which faer is faster; `cargo bench --bench size -- --eigen` measures both.
const MANY: usize = 32;

/// Eigenvalues of a symmetric matrix `[n, n]`, ascending, `[n]`; all NaN if the iteration does not converge.
pub fn eigenvalues(symmetric: &DMatrix<f64>) -> Vec<f64> {
    let n = symmetric.nrows();
    if n >= MANY {
        let found = view(symmetric).self_adjoint_eigenvalues(Side::Lower);
        return found.unwrap_or_else(|_| vec![f64::NAN; n]);
    }
    // Matrices of a size known at compile time need no heap memory, and their loops are unrolled.
    macro_rules! of_size {
        ($matrix:ty) => {
            <$matrix>::from_column_slice(symmetric.as_slice()).symmetric_eigenvalues().as_slice().to_vec()
        };
    }
    let mut values: Vec<f64> = match n {
        2 => of_size!(Matrix2<f64>),
        3 => of_size!(Matrix3<f64>),
        4 => of_size!(Matrix4<f64>),
        5 => of_size!(Matrix5<f64>),
        6 => of_size!(Matrix6<f64>),
        _ => symmetric.symmetric_eigenvalues().as_slice().to_vec(),
    };
    // nalgebra returns them unsorted.
    values.sort_by(f64::total_cmp);
    values
}

/// Eigenvalues of a symmetric matrix `[n, n]`, ascending, and its eigenvectors as columns in the same order, `[n, n]`. The
/// eigenvalues are NaN if the iteration does not converge.
pub fn eigen(symmetric: DMatrix<f64>) -> (Vec<f64>, DMatrix<f64>) {
    let n = symmetric.nrows();
    if n >= MANY {
        return match view(&symmetric).self_adjoint_eigen(Side::Lower) {
            Ok(found) => {
                let values = (0..n).map(|i| found.S()[i]).collect();
                (values, DMatrix::from_fn(n, n, |row, column| found.U()[(row, column)]))
            }
            Err(_) => (vec![f64::NAN; n], symmetric),
        };
    }
    let SymmetricEigen { eigenvalues, eigenvectors } = symmetric.symmetric_eigen();
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|a, b| eigenvalues[*a].total_cmp(&eigenvalues[*b]));
    let values = order.iter().map(|i| eigenvalues[*i]).collect();
    (values, eigenvectors.select_columns(&order))
}

/// The product a·b, `[rows of a, columns of b]`.
pub fn product(a: &DMatrix<f64>, b: &DMatrix<f64>) -> DMatrix<f64> {
    let mut result = DMatrix::zeros(a.nrows(), b.ncols());
    matmul(view_mut(&mut result), Accum::Replace, view(a), view(b), 1.0, Par::Seq);
    result
}

/// The product aᵀ·b, `[columns of a, columns of b]`.
pub fn transposed_product(a: &DMatrix<f64>, b: &DMatrix<f64>) -> DMatrix<f64> {
    let mut result = DMatrix::zeros(a.ncols(), b.ncols());
    matmul(view_mut(&mut result), Accum::Replace, view(a).transpose(), view(b), 1.0, Par::Seq);
    result
}

fn view(matrix: &DMatrix<f64>) -> MatRef<'_, f64> {
    MatRef::from_column_major_slice(matrix.as_slice(), matrix.nrows(), matrix.ncols())
}

fn view_mut(matrix: &mut DMatrix<f64>) -> MatMut<'_, f64> {
    let (rows, columns) = matrix.shape();
    MatMut::from_column_major_slice_mut(matrix.as_mut_slice(), rows, columns)
}
