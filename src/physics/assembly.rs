//! Stiffnesses and masses to matrices.

use nalgebra::DMatrix;

use super::{Form, Structure};

/// Stiffness matrix K, `[n, n]`, symmetric.
///
/// ```text
///  K = Σ k A(form),    a spring between nodes a and b:  A = (e_a − e_b)(e_a − e_b)ᵀ,  e_b = 0 for the ground
/// ```
pub fn stiffness_matrix(structure: &Structure) -> DMatrix<f64> {
    stiffness_matrix_with(structure, &[])
}

/// The same with other stiffnesses, given as (index of the spring, N/m).
pub fn stiffness_matrix_with(structure: &Structure, changes: &[(usize, f64)]) -> DMatrix<f64> {
    let changed = |index: usize| changes.iter().rev().find(|(spring, _)| *spring == index).map(|(_, value)| *value);
    let springs = structure.springs().iter().enumerate();
    assemble(structure.freedoms(), springs.map(|(i, s)| (&s.form, changed(i).unwrap_or(s.n_per_m))))
}

/// Mass matrix M, `[n, n]`, symmetric: diagonal for bodies, consistent for spans of beams.
pub fn mass_matrix(structure: &Structure) -> DMatrix<f64> {
    assemble(structure.freedoms(), structure.masses().iter().map(|m| (&m.form, m.kg)))
}

fn assemble<'a>(freedoms: usize, parts: impl Iterator<Item = (&'a Form, f64)>) -> DMatrix<f64> {
    let mut matrix = DMatrix::zeros(freedoms, freedoms);
    for (form, value) in parts {
        form.entries(|row, column, entry| matrix[(row, column)] += value * entry);
    }
    matrix
}
