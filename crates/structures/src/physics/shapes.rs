//! Mode shapes at instrumented degrees of freedom, and their derivatives.

use nalgebra::DMatrix;

use super::eigen::product;
use super::modes::{Modes, REPEATED};
use super::structure::Structure;
use crate::stats::squared_cosine;

/// Shapes of the modes asked for at the degrees of freedom `points`, `[points, modes]`. Each has unit norm over the points
/// and an arbitrary sign. A mode that does not move any of the points has a shape of zeros.
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

/// Derivatives of [`shapes_at`] with respect to the stiffnesses of `springs`, per N/m: one matrix `[points, springs]` for each
/// mode.
///
/// ```text
///  ∂φ_i = Σ_{j≠i} φ_j (φ_jᵀ A φ_i)/(λ_i − λ_j),    u = φ/|φ|:   ∂u = (1 − u uᵀ) ∂φ/|φ|      over the points
/// ```
///
/// A is the matrix of a unit of the stiffness. Modes whose eigenvalue repeats λ_i are left out of the sum, because their shapes
/// are not unique.
///
/// Source: Fox & Kapoor (1968), Rates of change of eigenvalues and eigenvectors, AIAA Journal 6, 2426–2429.
pub fn shape_sensitivity(
    structure: &Structure,
    modes: &Modes,
    points: &[usize],
    springs: &[usize],
) -> Vec<DMatrix<f64>> {
    let shapes = modes.at_springs();
    let receptances = Receptances::new(modes, points);
    let of_mode = |mode: usize| {
        let receptance = receptances.of_springs(modes, mode);
        let mut slopes = DMatrix::zeros(points.len(), springs.len());
        for (mut slope, &spring) in slopes.column_iter_mut().zip(springs) {
            structure.springs()[spring].form.entries(|row, column, value| {
                slope.axpy(value * shapes[(column, mode)], &receptance.column(row), 1.0);
            });
        }
        let here = receptances.at_points.column(mode);
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

/// The displacements of points under forces, by modal expansion.
pub(super) struct Receptances {
    /// All mode shapes at the points, `[points, n]`, and at all degrees of freedom, transposed, `[n, n]`; kg^-½.
    at_points: DMatrix<f64>,
    transposed: DMatrix<f64>,
    /// The same as far as they deform the springs, and the forces of inertia, where flexibilities are in series with the springs.
    in_series: Option<[DMatrix<f64>; 2]>,
}

impl Receptances {
    pub(super) fn new(modes: &Modes, points: &[usize]) -> Self {
        let in_series = modes.forces().map(|forces| [modes.at_springs().transpose(), forces.transpose()]);
        Self { at_points: modes.all_shapes.select_rows(points), transposed: modes.all_shapes.transpose(), in_series }
    }

    /// Displacement of the points under a unit force at each degree of freedom, without the contribution of the mode itself and of
    /// modes whose eigenvalue repeats its own, `[points, n]`.
    ///
    /// ```text
    ///  Σ_{j≠i} φ_j φ_jᵀ/(λ_i − λ_j)
    /// ```
    pub(super) fn of_mode(&self, modes: &Modes, mode: usize) -> DMatrix<f64> {
        product(&self.weighted(modes, mode), &self.transposed)
    }

    /// As [`Self::of_mode`], under a pair of forces that deforms a spring.
    pub(super) fn of_springs(&self, modes: &Modes, mode: usize) -> DMatrix<f64> {
        let transposed = self.in_series.as_ref().map_or(&self.transposed, |[springs, _]| springs);
        product(&self.weighted(modes, mode), transposed)
    }

    /// Σ_{j≠i} φ_j f_jᵀ/(λ_i − λ_j) with the forces of inertia f, `[points, n]`: times the deflection B f_i, it is minus the derivative of
    /// the shape by the size of a flexibility g B. `None` without flexibilities in series with the springs.
    pub(super) fn of_flexibilities(&self, modes: &Modes, mode: usize) -> Option<DMatrix<f64>> {
        let [_, forces] = self.in_series.as_ref()?;
        Some(product(&self.weighted(modes, mode), forces))
    }

    /// Derivatives of the shape of a mode at the points with respect to every spring, mass and flexibility, without a change along the shape
    /// itself, `[points, springs + masses + flexibilities]`. `deflections`: those of each flexibility ([`super::modes::deflections`]).
    ///
    /// ```text
    ///  K: ∂φ_i = Σ_{j≠i} φ_j (φ_jᵀ ∂K φ_i)/(λ_i − λ_j),    M: ∂φ_i = −λ_i Σ_{j≠i} φ_j (φ_jᵀ ∂M φ_i)/(λ_i − λ_j)
    /// ```
    pub(super) fn slopes(
        &self,
        structure: &Structure,
        modes: &Modes,
        deflections: &[DMatrix<f64>],
        mode: usize,
    ) -> DMatrix<f64> {
        let (springs, masses, shapes) = (structure.springs(), structure.masses(), &modes.all_shapes);
        let (of_masses, of_springs) = (self.of_mode(modes, mode), self.of_springs(modes, mode));
        let points = self.at_points.nrows();
        let mut slopes = DMatrix::zeros(points, springs.len() + masses.len() + deflections.len());
        let springs_moved = springs.iter().map(|spring| (&spring.form, 1.0, modes.at_springs(), &of_springs));
        let eigenvalue = modes.eigenvalues[mode];
        let masses_moved = masses.iter().map(|mass| (&mass.form, -eigenvalue, shapes, &of_masses));
        for (mut slope, (form, factor, shapes, receptance)) in
            slopes.column_iter_mut().zip(springs_moved.chain(masses_moved))
        {
            form.entries(|row, column, value| {
                slope.axpy(factor * value * shapes[(column, mode)], &receptance.column(row), 1.0);
            });
        }
        if let Some(receptance) = self.of_flexibilities(modes, mode) {
            for (number, deflection) in deflections.iter().enumerate() {
                let slope = -(&receptance * deflection.column(mode));
                slopes.set_column(springs.len() + masses.len() + number, &slope);
            }
        }
        slopes
    }

    /// All mode shapes at the points, `[points, n]`, kg^-½.
    pub(super) fn at_points(&self) -> &DMatrix<f64> {
        &self.at_points
    }

    /// Shapes at the points, each with its weight 1/(λ_i − λ_j), `[points, n]`.
    fn weighted(&self, modes: &Modes, mode: usize) -> DMatrix<f64> {
        let eigenvalue = modes.eigenvalues[mode];
        let weight = |other: usize| {
            let gap = eigenvalue - modes.eigenvalues[other];
            if gap.abs() > REPEATED * eigenvalue {
                1.0 / gap
            } else {
                0.0
            }
        };
        let (points, n) = self.at_points.shape();
        let weights: Vec<f64> = (0..n).map(weight).collect();
        DMatrix::from_fn(points, n, |point, other| self.at_points[(point, other)] * weights[other])
    }
}

/// Number of simulated modes to pair with `measured` modes, of `available`: the measured modes and a few above, which can swap
/// with them.
pub fn modes_to_pair(measured: usize, available: usize) -> usize {
    /// Modes above the measured ones.
    const ABOVE: usize = 3;
    (measured + ABOVE).min(available)
}

/// Pairs each measured mode with a different simulated mode: repeatedly takes the pair with the highest score.
///
/// ```text
///  score = MAC − |ln f_measured/f_simulated|
/// ```
///
/// The modal assurance criterion (MAC) of the shapes dominates; the frequencies decide where the shapes at few points are too
/// similar. Measured modes without a shape are paired last, by their frequency alone.
///
/// `measured` holds the frequency (Hz) and, if identified, the shape `[points]` of each mode; `simulated` holds the shapes
/// `[points, modes]`. Returns the index of the simulated mode of each measured mode. Source of the MAC: Allemang & Brown
/// (1982).
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
