//! Assembly of the stiffness matrix and the mass matrix.

use nalgebra::DMatrix;

use super::structure::{Form, Structure};

/// Stiffness matrix K, `[n, n]`, symmetric, in the units of the stiffnesses.
///
/// ```text
///  K = Σ k A(form),    a spring between nodes a and b:  A = (e_a − e_b)(e_a − e_b)ᵀ,  e_b = 0 for the ground
/// ```
pub fn stiffness_matrix(structure: &Structure) -> DMatrix<f64> {
    stiffness_matrix_with(structure, &[])
}

/// [`stiffness_matrix`] with some stiffnesses replaced: K, `[n, n]`. `changes` holds the index of each changed spring and its
/// stiffness in the unit of [`super::Spring::n_per_m`]; if an index occurs more than once, its last value is used.
pub fn stiffness_matrix_with(structure: &Structure, changes: &[(usize, f64)]) -> DMatrix<f64> {
    let changed = |index: usize| changes.iter().rev().find(|(spring, _)| *spring == index).map(|(_, value)| *value);
    let springs = structure.springs().iter().enumerate();
    assemble(structure.dofs(), springs.map(|(i, s)| (&s.form, changed(i).unwrap_or(s.n_per_m))))
}

/// Mass matrix M, `[n, n]`, symmetric, kg: diagonal for rigid bodies, the consistent mass matrix for beam spans.
pub fn mass_matrix(structure: &Structure) -> DMatrix<f64> {
    assemble(structure.dofs(), structure.masses().iter().map(|m| (&m.form, m.kg)))
}

/// Sum of the patterns of all parts, each multiplied by its stiffness or mass, `[n, n]`.
fn assemble<'a>(dofs: usize, parts: impl Iterator<Item = (&'a Form, f64)>) -> DMatrix<f64> {
    let mut matrix = DMatrix::zeros(dofs, dofs);
    for (form, value) in parts {
        form.entries(|row, column, entry| matrix[(row, column)] += value * entry);
    }
    matrix
}
