//! Natural frequencies, mode shapes, and their derivatives.

use std::f64::consts::PI;
use std::sync::Arc;

use nalgebra::{DMatrix, DVector};

use super::assembly::{mass_matrix, stiffness_matrix_with};
use super::eigen::{eigen, eigenvalues};
use super::structure::{Error, Form, Node, Structure};

/// If the smallest eigenvalue is below this share of the largest, it is rounding error: the structure is a mechanism.
pub(super) const SINGULAR: f64 = 1e-12;

/// Relative gap below which two eigenvalues are treated as repeated: rounding errors are about 1e-13.
pub(super) const REPEATED: f64 = 1e-8;

/// Modes of a structure, of which the lowest were asked for.
#[derive(Debug, Clone)]
pub struct Modes {
    /// Natural frequencies of the modes asked for, Hz, ascending, `[modes]`.
    pub frequencies_hz: Vec<f64>,
    /// All eigenvalues λ = (2πf)², rad²/s², ascending, `[n]`.
    pub(super) eigenvalues: Vec<f64>,
    /// All mode shapes as columns, mass-normalised (φᵀMφ = 1), kg^-½, `[n, n]`.
    pub(super) all_shapes: DMatrix<f64>,
    /// For a structure with flexibilities in series with its springs, what the springs take part in.
    elastic: Option<Elastic>,
}

/// The part of each mode that deforms the springs, where further flexibilities are in series with them.
#[derive(Debug, Clone)]
struct Elastic {
    /// Shapes that deform the springs as the mode does, K_s⁻¹ M φ λ, as columns, `[n, n]`. K_s: stiffness of the springs alone.
    shapes: DMatrix<f64>,
    /// Forces of inertia M φ λ, as columns, `[n, n]`.
    forces: DMatrix<f64>,
}

impl Modes {
    /// Shapes of the modes asked for, `[n, count]`, mass-normalised, kg^-½; the sign of each is arbitrary.
    pub fn shapes(&self) -> DMatrix<f64> {
        self.all_shapes.columns(0, self.frequencies_hz.len()).into_owned()
    }

    /// All shapes as far as they deform the springs, as columns, `[n, n]`: φᵢᵀ A φⱼ of these is φᵢᵀ ∂K φⱼ, with A the matrix of a unit of
    /// a stiffness.
    pub(super) fn at_springs(&self) -> &DMatrix<f64> {
        self.elastic.as_ref().map_or(&self.all_shapes, |elastic| &elastic.shapes)
    }

    /// Forces of inertia of all modes as columns, `[n, n]`, of a structure with flexibilities g B: φᵢᵀ ∂K/∂g φⱼ = −fᵢᵀ B fⱼ.
    pub(super) fn forces(&self) -> Option<&DMatrix<f64>> {
        self.elastic.as_ref().map(|elastic| &elastic.forces)
    }
}

/// Derivatives ∂f/∂k and ∂f/∂m of each mode.
#[derive(Debug, Clone)]
pub struct FrequencySensitivity {
    /// Hz per N/m (or per unit of another stiffness), `[modes, springs]`.
    pub by_spring: DMatrix<f64>,
    /// Hz per kg, `[modes, masses]`.
    pub by_mass: DMatrix<f64>,
    /// Hz per unit of each flexibility in series with the springs, `[modes, flexibilities]`.
    pub(super) by_flexibility: DMatrix<f64>,
}

/// The lowest `count` natural frequencies, Hz, ascending, `[count]`.
///
/// ```text
///  K φ = λ M φ,    f = √λ / 2π
/// ```
///
/// # Errors
/// [`Error::TooFewModes`] if `count` exceeds the number of degrees of freedom, [`Error::NearMechanism`] if an eigenvalue is
/// zero within rounding, [`Error::Massless`] if a degree of freedom has no mass.
pub fn natural_frequencies_hz(structure: &Structure, count: usize) -> Result<Vec<f64>, Error> {
    natural_frequencies_with(structure, &[], count)
}

/// [`natural_frequencies_hz`] with some stiffnesses replaced: Hz, ascending, `[count]`. `changes` holds the index of each changed
/// spring and its stiffness in the unit of [`super::Spring::n_per_m`]. The structure is not copied, because stochastic model
/// updating calls this millions of times.
///
/// # Errors
/// As [`natural_frequencies_hz`], and [`Error::Stiffness`] for a stiffness that is negative or not finite.
pub fn natural_frequencies_with(
    structure: &Structure,
    changes: &[(usize, f64)],
    count: usize,
) -> Result<Vec<f64>, Error> {
    structure.check_changes(changes)?;
    let scaled = Scaled::new(structure, changes)?;
    frequencies(&eigenvalues(&scaled.stiffness), count)
}

/// The lowest `count` modes: natural frequencies, Hz, `[count]`, and mass-normalised mode shapes, kg^-½, `[n, count]`.
///
/// ```text
///  K φ = λ M φ,    f = √λ / 2π,    φᵀ M φ = 1
/// ```
///
/// # Errors
/// As [`natural_frequencies_hz`].
pub fn modes(structure: &Structure, count: usize) -> Result<Modes, Error> {
    let Scaled { stiffness, mass_root } = Scaled::new(structure, &[])?;
    let (eigenvalues, eigenvectors) = eigen(stiffness);
    let all_shapes = mass_root.shapes(&eigenvectors);
    let frequencies_hz = frequencies(&eigenvalues, count)?;
    let elastic = if structure.flexibilities.is_empty() {
        None
    } else {
        let mut forces = mass_matrix(structure) * &all_shapes;
        forces.column_iter_mut().zip(&eigenvalues).for_each(|(mut force, eigenvalue)| force *= *eigenvalue);
        let springs = stiffness_matrix_with(structure, &[]).cholesky().ok_or_else(unstable)?;
        Some(Elastic { shapes: springs.solve(&forces), forces })
    };
    Ok(Modes { frequencies_hz, eigenvalues, all_shapes, elastic })
}

/// Derivatives of the natural frequencies with respect to every stiffness and every mass.
///
/// ```text
///  ∂λ_i/∂k = φ_iᵀ A φ_i,    ∂λ_i/∂m = −λ_i φ_iᵀ B φ_i      A, B: ∂K/∂k, ∂M/∂m
///  ∂f_i = ∂λ_i / (8π² f_i),    ∂λ_i/∂g = −f_iᵀ B f_i,  f_i = λ_i M φ_i,  for K⁻¹ + g B
/// ```
///
/// The mode shapes of r repeated eigenvalues are not unique, and the formula above would depend on their choice. The
/// derivatives with respect to a single parameter are then the eigenvalues of the r × r matrix Φᵀ(∂K − λ∂M)Φ over these
/// modes. They are returned in ascending order, which gives the right-hand derivatives of the ascending frequencies (the
/// left-hand ones are the same in descending order). With respect to several parameters at once, sorted frequencies are not
/// differentiable there.
///
/// Source: Nelson (1976) for single, Ojalvo (1988) for repeated eigenvalues.
pub fn frequency_sensitivity(structure: &Structure, modes: &Modes) -> FrequencySensitivity {
    let count = modes.frequencies_hz.len();
    let shapes = &modes.all_shapes;
    let clusters = clusters(&modes.eigenvalues);
    let derivative = |columns: usize, form: &dyn Fn(usize, usize, usize, f64) -> f64| {
        let mut result = DMatrix::zeros(count, columns);
        for &(start, end) in clusters.iter().filter(|(start, _)| *start < count) {
            let size = end - start;
            let eigenvalue = modes.eigenvalues[start..end].iter().sum::<f64>() / size as f64;
            for column in 0..columns {
                let projected = DMatrix::from_fn(size, size, |i, j| form(column, start + i, start + j, eigenvalue));
                let mut slopes: Vec<f64> = if size == 1 {
                    vec![projected[(0, 0)]]
                } else {
                    projected.symmetric_eigenvalues().iter().copied().collect()
                };
                slopes.sort_by(f64::total_cmp);
                for mode in start..end.min(count) {
                    result[(mode, column)] = slopes[mode - start] / (8.0 * PI * PI * modes.frequencies_hz[mode]);
                }
            }
        }
        result
    };
    let product = |shapes: &DMatrix<f64>, form: &Form, i: usize, j: usize| {
        let mut sum = 0.0;
        form.entries(|row, column, value| sum += shapes[(row, i)] * value * shapes[(column, j)]);
        sum
    };
    let (springs, masses) = (structure.springs(), structure.masses());
    let deflections = deflections(structure, modes);
    FrequencySensitivity {
        by_spring: derivative(springs.len(), &|spring, i, j, _| {
            product(modes.at_springs(), &springs[spring].form, i, j)
        }),
        by_mass: derivative(masses.len(), &|mass, i, j, eigenvalue| {
            -eigenvalue * product(shapes, &masses[mass].form, i, j)
        }),
        by_flexibility: derivative(deflections.len(), &|number, i, j, _| {
            let forces = modes.forces().expect("a structure with flexibilities has forces");
            -forces.column(i).dot(&deflections[number].column(j))
        }),
    }
}

/// B f under the forces of inertia of all modes for each flexibility g B in series with the springs, `[n, n]`.
pub(super) fn deflections(structure: &Structure, modes: &Modes) -> Vec<DMatrix<f64>> {
    let Some(forces) = modes.forces() else { return Vec::new() };
    structure.flexibilities.iter().map(|(_, further)| further.as_ref() * forces).collect()
}

/// K of springs with flexibilities in series: (K⁻¹ + Σ g B)⁻¹.
///
/// # Errors
/// [`Error::NearMechanism`] if a negative flexibility exceeds that of the springs.
fn in_series(stiffness: DMatrix<f64>, flexibilities: &[(f64, Arc<DMatrix<f64>>)]) -> Result<DMatrix<f64>, Error> {
    if flexibilities.is_empty() {
        return Ok(stiffness);
    }
    let mut flexibility = stiffness.cholesky().ok_or_else(unstable)?.inverse();
    for (size, further) in flexibilities {
        flexibility += further.as_ref() * *size;
    }
    Ok(flexibility.cholesky().ok_or_else(unstable)?.inverse())
}

/// The error for a stiffness matrix that is not positive definite.
fn unstable() -> Error {
    Error::NearMechanism { smallest: f64::NAN, largest: f64::NAN }
}

/// The standard eigenproblem A v = λ v with A = R⁻¹ K R⁻ᵀ and M = R Rᵀ, which is equivalent to K φ = λ M φ with φ = R⁻ᵀ v.
pub(super) struct Scaled {
    pub stiffness: DMatrix<f64>,
    mass_root: MassRoot,
}

/// The factor of M = R Rᵀ: the diagonal of R⁻¹ if M is diagonal, otherwise the Cholesky factor R.
enum MassRoot {
    InverseDiagonal(DVector<f64>),
    Lower(DMatrix<f64>),
}

impl Scaled {
    /// Assembles K with the stiffnesses `changes` (index of the spring, value) and M, and reduces the eigenproblem to standard
    /// form.
    ///
    /// # Errors
    /// [`Error::Massless`] if M is not positive definite; [`Error::NearMechanism`] if a flexibility exceeds what there is.
    pub fn new(structure: &Structure, changes: &[(usize, f64)]) -> Result<Self, Error> {
        let mut stiffness = in_series(stiffness_matrix_with(structure, changes), &structure.flexibilities)?;
        let mass = mass_matrix(structure);
        let n = mass.nrows();
        let coupled = structure.masses().iter().any(|m| !matches!(m.form, Form::Spring(Node::Ground, _)));
        if !coupled {
            let inverse_root = DVector::from_fn(n, |i, _| 1.0 / mass[(i, i)].sqrt());
            for row in 0..n {
                for column in 0..n {
                    stiffness[(row, column)] *= inverse_root[row] * inverse_root[column];
                }
            }
            return Ok(Self { stiffness, mass_root: MassRoot::InverseDiagonal(inverse_root) });
        }
        let lower = mass.cholesky().ok_or(Error::Massless)?.l();
        let solvable = "a Cholesky factor has no zero on its diagonal";
        let left = lower.solve_lower_triangular(&stiffness).expect(solvable);
        let scaled = lower.solve_lower_triangular(&left.transpose()).expect(solvable);
        // Rounding errors leave it slightly asymmetric.
        let symmetric = 0.5 * (&scaled + scaled.transpose());
        Ok(Self { stiffness: symmetric, mass_root: MassRoot::Lower(lower) })
    }

    /// R, `[n, n]`, lower triangular.
    pub fn mass_root(&self) -> DMatrix<f64> {
        match &self.mass_root {
            MassRoot::InverseDiagonal(inverse) => DMatrix::from_diagonal(&inverse.map(f64::recip)),
            MassRoot::Lower(lower) => lower.clone(),
        }
    }
}

impl MassRoot {
    /// φ = R⁻ᵀ v of each column v.
    fn shapes(&self, eigenvectors: &DMatrix<f64>) -> DMatrix<f64> {
        match self {
            Self::InverseDiagonal(inverse) => {
                DMatrix::from_fn(eigenvectors.nrows(), eigenvectors.ncols(), |i, j| inverse[i] * eigenvectors[(i, j)])
            }
            Self::Lower(lower) => {
                lower.tr_solve_lower_triangular(eigenvectors).expect("a Cholesky factor has no zero on its diagonal")
            }
        }
    }
}

/// f = √λ/2π of the lowest `count` eigenvalues, Hz.
fn frequencies(sorted_eigenvalues: &[f64], count: usize) -> Result<Vec<f64>, Error> {
    let available = sorted_eigenvalues.len();
    if count > available {
        return Err(Error::TooFewModes { asked: count, available });
    }
    let (smallest, largest) = (sorted_eigenvalues[0], sorted_eigenvalues[available - 1]);
    // This form of the condition also rejects NaN.
    let positive = smallest > SINGULAR * largest && largest.is_finite();
    if !positive {
        return Err(Error::NearMechanism { smallest, largest });
    }
    Ok(sorted_eigenvalues[..count].iter().map(|lambda| lambda.sqrt() / (2.0 * PI)).collect())
}

/// Groups of repeated eigenvalues as half-open index ranges; a simple eigenvalue is a group of one.
fn clusters(sorted: &[f64]) -> Vec<(usize, usize)> {
    let mut clusters = Vec::new();
    let mut start = 0;
    for end in 1..=sorted.len() {
        if end == sorted.len() || sorted[end] - sorted[end - 1] > REPEATED * sorted[end] {
            clusters.push((start, end));
            start = end;
        }
    }
    clusters
}
