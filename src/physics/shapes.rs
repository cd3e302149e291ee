//! Mode shapes at instrumented degrees of freedom, and their derivatives.

use nalgebra::DMatrix;

use super::eigen::product;
use super::modes::{Modes, REPEATED};
use super::Structure;
use crate::stats::squared_cosine;

/// Shapes of the modes asked for at `points`, `[points, modes]`, each of unit norm over the points; the sign of each is
/// arbitrary. A mode that does not move any of the points has a shape of zeros.
pub fn shapes_at(modes: &Modes, points: &[usize]) -> DMatrix<f64> {
    let mut shapes = DMatrix::from_fn(points.len(), modes.frequencies_hz.len(), |point, mode| {
        modes.all_shapes[(points[point], mode)]
    });
    for mut shape in shapes.column_iter_mut() {
        let norm = shape.norm();
        if norm > 0.0 {
            shape /= norm;
        }
    }
    shapes
}

/// Derivatives of [`shapes_at`] with respect to the stiffnesses of `springs`, per N/m: one matrix `[points, springs]` a mode.
///
/// ```text
///  ∂φ_i = Σ_{j≠i} φ_j (φ_jᵀ A φ_i)/(λ_i − λ_j),    u = φ/|φ|:   ∂u = (1 − u uᵀ) ∂φ/|φ|      over the points
/// ```
///
/// A: the matrix of a unit of the stiffness. Pairs of repeated eigenvalues are left out of the sum: their shapes may be any of
/// a plane. Source: Fox & Kapoor (1968), Rates of change of eigenvalues and eigenvectors, AIAA Journal 6, 2426–2429.
pub fn shape_sensitivity(
    structure: &Structure,
    modes: &Modes,
    points: &[usize],
    springs: &[usize],
) -> Vec<DMatrix<f64>> {
    let shapes = &modes.all_shapes;
    let n = shapes.ncols();
    let transposed = shapes.transpose();
    let at_points = shapes.select_rows(points);
    let of_mode = |mode: usize| {
        let own = modes.eigenvalues[mode];
        let weight = |other: usize| {
            let gap = own - modes.eigenvalues[other];
            if gap.abs() > REPEATED * own {
                1.0 / gap
            } else {
                0.0
            }
        };
        let weights: Vec<f64> = (0..n).map(weight).collect();
        let weighted = DMatrix::from_fn(points.len(), n, |point, other| at_points[(point, other)] * weights[other]);
        // What a unit of force at each degree of freedom moves the points by, without the mode itself.
        let receptance = product(&weighted, &transposed);
        let mut slopes = DMatrix::zeros(points.len(), springs.len());
        for (mut slope, &spring) in slopes.column_iter_mut().zip(springs) {
            structure.springs()[spring].form.entries(|row, column, value| {
                slope.axpy(value * shapes[(column, mode)], &receptance.column(row), 1.0);
            });
        }
        let here = at_points.column(mode);
        let norm = here.norm();
        if norm <= 0.0 {
            return DMatrix::zeros(points.len(), springs.len());
        }
        let unit = here / norm;
        for mut slope in slopes.column_iter_mut() {
            let along = unit.dot(&slope);
            slope.axpy(-along, &unit, 1.0);
            slope /= norm;
        }
        slopes
    };
    (0..modes.frequencies_hz.len()).map(of_mode).collect()
}

/// The simulated mode of each measured one, no mode twice: greedily by the greatest score.
///
/// ```text
///  score = MAC − |ln f_measured/f_simulated|
/// ```
///
/// Shapes decide; frequencies decide where few points cannot tell shapes apart. A measured mode without a shape goes by its
/// frequency alone, after the others.
///
/// `measured`: frequency in Hz and, where it is known, shape of each mode.
pub fn pair_modes(measured: &[(f64, Option<&[f64]>)], simulated_hz: &[f64], simulated: &DMatrix<f64>) -> Vec<usize> {
    let mut scores = Vec::with_capacity(measured.len() * simulated_hz.len());
    for (row, (hz, shape)) in measured.iter().enumerate() {
        for (column, simulated_hz) in simulated_hz.iter().enumerate() {
            let distance = (hz / simulated_hz).ln().abs();
            let alike = shape.map(|shape| squared_cosine(shape, simulated.column(column).as_slice()));
            scores.push((alike.is_some(), alike.unwrap_or(0.0) - distance, row, column));
        }
    }
    scores.sort_by(|a, b| b.0.cmp(&a.0).then(b.1.total_cmp(&a.1)));
    let mut pairs = vec![usize::MAX; measured.len()];
    let mut taken = vec![false; simulated_hz.len()];
    for (_, _, row, column) in scores {
        if pairs[row] == usize::MAX && !taken[column] {
            pairs[row] = column;
            taken[column] = true;
        }
    }
    pairs
}
