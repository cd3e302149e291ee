//! Derivatives of the eigenvalues of eight structures at once, one in each SIMD lane, from the shapes of their modes.
//!
//! ```text
//!  T w = λ w,    v = H_n ⋯ H_3 w,    φ = R⁻ᵀ v,    ∂λ/∂k_s = φᵀ A_s φ,    ∂f = ∂λ/(8π² f)
//! ```
//!
//! with the tridiagonal matrix T, the reflections H_i that lead to it, M = R Rᵀ, and the matrix A_s of spring s with unit stiffness.
//!
//! Source of ∂λ: R. L. Fox, M. P. Kapoor (1968), Rates of change of eigenvalues and eigenvectors, AIAA Journal 6, 2426–2429.

#![allow(clippy::needless_range_loop, reason = "a loop over the lanes becomes vector instructions")]

use std::collections::BTreeMap;
use std::f64::consts::PI;

use nalgebra::DMatrix;

use super::lanes::{Lanes, LANES};
use super::structure::Form;
use super::tridiagonal::{Lowest, Tridiagonal};

/// What the derivatives need of a structure.
#[derive(Debug, Clone)]
pub(super) struct SlopePatterns {
    /// 1/R_ii and the other entries that are not zero, with their rows, of each column of R.
    mass_root: Vec<(f64, Vec<(usize, f64)>)>,
    /// Entries of the lower triangle of each A_s that are not zero, those below the diagonal twice as large: row, column, value.
    units: Vec<Vec<(usize, usize, f64)>>,
}

impl SlopePatterns {
    /// `mass_root`: R, `[n, n]`, lower triangular; `forms`: the patterns of the springs that change.
    pub(super) fn new<'a>(mass_root: &DMatrix<f64>, forms: impl Iterator<Item = &'a Form>) -> Self {
        let n = mass_root.nrows();
        let column = |j: usize| {
            let below = (j + 1..n).map(|i| (i, mass_root[(i, j)])).filter(|(_, entry)| *entry != 0.0);
            (1.0 / mass_root[(j, j)], below.collect())
        };
        let unit = |form: &Form| {
            let mut sums = BTreeMap::new();
            form.entries(|row, column, value| *sums.entry((row.max(column), row.min(column))).or_insert(0.0) += value);
            sums.into_iter()
                .filter(|(_, value)| *value != 0.0)
                .map(|((row, column), value)| (row, column, value))
                .collect()
        };
        Self { mass_root: (0..n).map(column).collect(), units: forms.map(unit).collect() }
    }

    /// ∂f/∂k of each spring that changes, Hz per unit of its stiffness, `[modes, springs]`. `reflectors` is what [`Tridiagonal::of`] has
    /// left, `lowest` what the matrix has as its lowest eigenvalues.
    ///
    /// The shapes of modes whose eigenvalues are equal within rounding are not unique, nor are these derivatives. Those of a lane do not
    /// depend on the matrices in the others.
    pub(super) fn slopes(&self, matrix: &Tridiagonal, reflectors: &[Lanes], lowest: &Lowest) -> Vec<Lanes> {
        let (n, count) = (self.mass_root.len(), lowest.eigenvalues.len());
        let mut shapes = vec![Lanes::ZERO; count * n];
        let mut work = Pivots { above: vec![Lanes::ZERO; n], below: vec![Lanes::ZERO; n] };
        vectors(matrix, lowest, &mut work, &mut shapes);
        reflect(matrix, reflectors, &mut shapes);
        divide_by_root(self, &mut shapes);
        self.of_shapes(&lowest.eigenvalues, &shapes)
    }

    /// As [`Self::slopes`], from eigenvalues, `[modes]`, and their shapes φ, φᵀMφ = 1, `[modes, n]`.
    pub(super) fn of_shapes(&self, eigenvalues: &[Lanes], shapes: &[Lanes]) -> Vec<Lanes> {
        let mut slopes = vec![Lanes::ZERO; eigenvalues.len() * self.units.len()];
        project(self, eigenvalues, shapes, &mut slopes);
        slopes
    }
}

/// Inverse pivots of T − λ, eliminated from above and from below, `[n]`.
struct Pivots {
    above: Vec<Lanes>,
    below: Vec<Lanes>,
}

/// Computes the eigenvectors of the tridiagonal matrices, of length 1, `[count, n]`, from twisted factorisations.
///
/// ```text
///  q_i = d_i − λ − e_i²/q_{i−1},    p_i = d_i − λ − e_{i+1}²/p_{i+1},    γ_i = d_i − λ − e_i²/q_{i−1} − e_{i+1}²/p_{i+1}
///  w_k = 1 where |γ_k| is least,    w_i = −e_{i+1} w_{i+1}/q_i  for i < k,    w_i = −e_i w_{i−1}/p_i  for i > k
/// ```
///
/// Source: I. S. Dhillon, B. N. Parlett (2004), Multiple representations to compute orthogonal eigenvectors of symmetric tridiagonal
/// matrices, Linear Algebra and its Applications 387, 1–28.
#[pulp::with_simd(vectors = pulp::Arch::new())]
#[inline(always)]
fn vectors_simd<S: pulp::Simd>(_: S, matrix: &Tridiagonal, lowest: &Lowest, work: &mut Pivots, vectors: &mut [Lanes]) {
    let n = matrix.diagonal.len();
    let Pivots { above, below } = work;
    // A pivot that is smaller than the rounding errors of the matrix is one of these.
    let least = lowest.bound.0.map(|bound| f64::EPSILON * bound);
    for (eigenvalue, vector) in lowest.eigenvalues.iter().zip(vectors.chunks_exact_mut(n)) {
        let mut coupling = [0.0; LANES];
        for i in 0..n {
            for lane in 0..LANES {
                let pivot = matrix.diagonal[i].0[lane] - eigenvalue.0[lane] - coupling[lane];
                above[i].0[lane] = 1.0 / pivot.abs().max(least[lane]).copysign(pivot);
                if i + 1 < n {
                    coupling[lane] = matrix.beside_squared[i + 1].0[lane] * above[i].0[lane];
                }
            }
        }
        let (mut coupling, mut smallest, mut at) = ([0.0; LANES], [f64::INFINITY; LANES], [0.0; LANES]);
        for i in (0..n).rev() {
            for lane in 0..LANES {
                let pivot = matrix.diagonal[i].0[lane] - eigenvalue.0[lane] - coupling[lane];
                below[i].0[lane] = 1.0 / pivot.abs().max(least[lane]).copysign(pivot);
                let from_above = if i > 0 { matrix.beside_squared[i].0[lane] * above[i - 1].0[lane] } else { 0.0 };
                let gamma = (pivot - from_above).abs();
                let is_smaller = gamma < smallest[lane];
                smallest[lane] = if is_smaller { gamma } else { smallest[lane] };
                at[lane] = if is_smaller { i as f64 } else { at[lane] };
                coupling[lane] = matrix.beside_squared[i].0[lane] * below[i].0[lane];
            }
        }
        let mut squares = [0.0; LANES];
        let mut next = [0.0; LANES];
        for i in (0..n).rev() {
            for lane in 0..LANES {
                let beside = if i + 1 < n { matrix.beside[i + 1].0[lane] } else { 0.0 };
                let follows = -beside * above[i].0[lane] * next[lane];
                let is_start = (at[lane] - i as f64).abs() < 0.5;
                next[lane] = if is_start { 1.0 } else { follows };
                squares[lane] += next[lane] * next[lane];
            }
            vector[i].0 = next;
        }
        let mut before = [0.0; LANES];
        for i in 0..n {
            for lane in 0..LANES {
                let follows = -matrix.beside[i].0[lane] * below[i].0[lane] * before[lane];
                let is_after = at[lane] < i as f64;
                before[lane] = if is_after { follows } else { vector[i].0[lane] };
                squares[lane] += if is_after { follows * follows } else { 0.0 };
            }
            vector[i].0 = before;
        }
        for entry in vector.iter_mut() {
            for lane in 0..LANES {
                entry.0[lane] /= squares[lane].sqrt();
            }
        }
    }
}

/// Applies the reflections to the eigenvectors of the tridiagonal matrices, `[count, n]`, which become those of the full ones.
#[pulp::with_simd(reflect = pulp::Arch::new())]
#[inline(always)]
fn reflect_simd<S: pulp::Simd>(_: S, matrix: &Tridiagonal, reflectors: &[Lanes], vectors: &mut [Lanes]) {
    let n = matrix.diagonal.len();
    for i in 2..n {
        let v = &reflectors[i * (i + 1) / 2..i * (i + 1) / 2 + i];
        for vector in vectors.chunks_exact_mut(n) {
            let mut along = [0.0; LANES];
            for (v, entry) in v.iter().zip(vector.iter()) {
                for lane in 0..LANES {
                    along[lane] += v.0[lane] * entry.0[lane];
                }
            }
            for lane in 0..LANES {
                along[lane] *= matrix.reflections[i].0[lane];
            }
            for (v, entry) in v.iter().zip(vector.iter_mut()) {
                for lane in 0..LANES {
                    entry.0[lane] -= along[lane] * v.0[lane];
                }
            }
        }
    }
}

/// Makes shapes φ of the eigenvectors v, `[count, n]`.
#[pulp::with_simd(divide_by_root = pulp::Arch::new())]
#[inline(always)]
fn divide_by_root_simd<S: pulp::Simd>(_: S, patterns: &SlopePatterns, vectors: &mut [Lanes]) {
    for shape in vectors.chunks_exact_mut(patterns.mass_root.len()) {
        for (j, (inverse, below)) in patterns.mass_root.iter().enumerate().rev() {
            let mut sum = shape[j].0;
            for (i, entry) in below {
                for lane in 0..LANES {
                    sum[lane] -= entry * shape[*i].0[lane];
                }
            }
            shape[j].0 = sum.map(|sum| inverse * sum);
        }
    }
}

/// Computes the derivatives, `[count, springs]`, from the shapes φ, `[count, n]`.
#[pulp::with_simd(project = pulp::Arch::new())]
#[inline(always)]
fn project_simd<S: pulp::Simd>(
    _: S,
    patterns: &SlopePatterns,
    eigenvalues: &[Lanes],
    shapes: &[Lanes],
    slopes: &mut [Lanes],
) {
    let (n, springs) = (patterns.mass_root.len(), patterns.units.len());
    let of_modes = shapes.chunks_exact(n).zip(slopes.chunks_exact_mut(springs));
    for ((shape, slopes), eigenvalue) in of_modes.zip(eigenvalues) {
        for (unit, slope) in patterns.units.iter().zip(slopes) {
            let mut sum = [0.0; LANES];
            for (row, column, value) in unit {
                for lane in 0..LANES {
                    sum[lane] += value * shape[*row].0[lane] * shape[*column].0[lane];
                }
            }
            for lane in 0..LANES {
                // 8π² f = 4π √λ
                slope.0[lane] = sum[lane] / (4.0 * PI * eigenvalue.0[lane].sqrt());
            }
        }
    }
}
