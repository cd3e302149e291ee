//! Springs and masses to matrices.

use nalgebra::{DMatrix, DVector};

use super::{Node, Structure};

/// Stiffness matrix K, N/m, `[n, n]`, symmetric and positive definite.
///
/// ```text
///  K = Σ k (e_a − e_b)(e_a − e_b)ᵀ      over springs between masses a and b;  e_b = 0 for the ground
/// ```
pub fn stiffness_matrix(structure: &Structure) -> DMatrix<f64> {
    let n = structure.masses().len();
    let mut k = DMatrix::zeros(n, n);
    for spring in structure.springs() {
        match (spring.from, spring.to) {
            (Node::Mass(a), Node::Mass(b)) => {
                k[(a, a)] += spring.n_per_m;
                k[(b, b)] += spring.n_per_m;
                k[(a, b)] -= spring.n_per_m;
                k[(b, a)] -= spring.n_per_m;
            }
            (Node::Mass(a), Node::Ground) | (Node::Ground, Node::Mass(a)) => k[(a, a)] += spring.n_per_m,
            (Node::Ground, Node::Ground) => unreachable!("a structure has no spring from the ground to itself"),
        }
    }
    k
}

/// Diagonal of the mass matrix M, kg, `[n]`: the masses are lumped.
pub fn mass_diagonal(structure: &Structure) -> DVector<f64> {
    DVector::from_iterator(structure.masses().len(), structure.masses().iter().map(|m| m.kg))
}
