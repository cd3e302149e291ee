//! Coupling stiffnesses of a chain of three masses from two of its measured frequencies.
//!
//! The three masses have springs to the ground and two unknown coupling springs between them:
//!
//! ```text
//!      ┌ g1 + k12      −k12          0     ┐
//!  K = │  −k12    g2 + k12 + k23   −k23    │      M = diag(m1, m2, m3)
//!      └   0          −k23       g3 + k23  ┘
//! ```
//!
//! Source: Wang et al. (2025), Eq. 23 and 24.

use std::f64::consts::PI;

use nalgebra::{Matrix2, Matrix3};
use serde::Serialize;

/// Relative difference below which an eigenvalue is identified with a measured one. Rounding errors are about 1e-13, and their
/// square root where two solutions coincide.
const SAME_EIGENVALUE: f64 = 1e-6;

/// Rounding error of b² − 4ac as a share of b².
const ROUNDING: f64 = 1e-13;

/// Coupling stiffnesses for which the chain has two measured frequencies.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CouplingStiffness {
    /// Between the first and the second mass, N/m.
    pub k12_n_per_m: f64,
    /// Between the second and the third mass, N/m.
    pub k23_n_per_m: f64,
    /// First natural frequency of the chain with these stiffnesses, Hz.
    pub first_hz: f64,
    /// Derivatives ∂k/∂ln f, N/m: rows for k12 and k23, columns for the second and the third frequency. They are unbounded where
    /// two solutions coincide.
    pub sensitivity_n_per_m: [[f64; 2]; 2],
}

impl CouplingStiffness {
    /// Standard deviations of k12 and k23, N/m, to first order, for independent noise of both frequencies with the relative
    /// standard deviation `relative_noise`.
    ///
    /// ```text
    ///  std(k)² = relative_noise² Σ_i (∂k/∂ln f_i)²,    i = 2, 3
    /// ```
    pub fn std_n_per_m(&self, relative_noise: f64) -> [f64; 2] {
        self.sensitivity_n_per_m.map(|row| relative_noise * row[0].hypot(row[1]))
    }
}

/// Why coupling stiffnesses cannot be computed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ChainError {
    /// A mass is not above 0, or the ground springs are negative or all absent.
    #[error("masses of {masses_kg:?} kg on ground springs of {ground_n_per_m:?} N/m: masses must be above 0, ground springs not negative, and one of them above 0")]
    Chain {
        /// Masses given, kg.
        masses_kg: [f64; 3],
        /// Ground springs given, N/m.
        ground_n_per_m: [f64; 3],
    },
    /// Frequencies are not above 0, or not ascending.
    #[error("the second and third frequency are {second_hz} and {third_hz} Hz: they must be above 0 and ascend")]
    Frequencies {
        /// Second frequency given, Hz.
        second_hz: f64,
        /// Third frequency given, Hz.
        third_hz: f64,
    },
    /// The first frequency is not above 0, or not below the second.
    #[error("the first frequency is {first_hz} Hz: it must be above 0 and below the second")]
    FirstFrequency {
        /// First frequency given, Hz.
        first_hz: f64,
    },
}

/// All positive coupling stiffnesses for which the chain has the given second and third frequencies.
///
/// ```text
///  |K − λ2 M| = |K − λ3 M| = 0,    λ_i = (2π f_i)²
///  |K − λM| = P + Q k12 + R k23 + S k12 k23,    d_i = g_i − λ m_i
///  P = d1 d2 d3,    Q = d3 (d1 + d2),    R = d1 (d2 + d3),    S = d1 + d2 + d3
/// ```
///
/// `masses_kg`: the three masses, kg; `ground_n_per_m`: the sum of the springs from each mass to the ground, N/m; `first_hz`,
/// `second_hz`, `third_hz`: measured frequencies, Hz.
///
/// The determinant is linear in each stiffness, so that eliminating k23 leaves a quadratic equation for k12 with up to two
/// solutions. Solutions for which the given frequencies are not the second and third modes are discarded. If `first_hz` is
/// given, the solution with the nearest first frequency comes first, otherwise the one with the smallest k12. There may be no
/// solution because of measurement noise; near such frequencies two solutions almost coincide and their
/// [`CouplingStiffness::std_n_per_m`] is large. A symmetric chain has mirrored pairs of solutions with the same first
/// frequency, which cannot be distinguished.
///
/// Source: Wang et al. (2025), Eq. 24, which does not mention the second solution; on their rig it is often positive, too.
///
/// # Errors
/// [`ChainError`] for masses, ground springs or frequencies that are not valid.
pub fn coupling_stiffness(
    masses_kg: [f64; 3],
    ground_n_per_m: [f64; 3],
    first_hz: Option<f64>,
    second_hz: f64,
    third_hz: f64,
) -> Result<Vec<CouplingStiffness>, ChainError> {
    let positive = |value: f64| value > 0.0 && value.is_finite();
    let held = ground_n_per_m.iter().all(|g| *g >= 0.0 && g.is_finite()) && ground_n_per_m.iter().any(|g| *g > 0.0);
    if !held || !masses_kg.into_iter().all(positive) {
        return Err(ChainError::Chain { masses_kg, ground_n_per_m });
    }
    if !(positive(second_hz) && positive(third_hz) && second_hz < third_hz) {
        return Err(ChainError::Frequencies { second_hz, third_hz });
    }
    if let Some(first_hz) = first_hz.filter(|f| !(positive(*f) && *f < second_hz)) {
        return Err(ChainError::FirstFrequency { first_hz });
    }
    let chain = Chain { masses_kg, ground_n_per_m };
    let eigenvalues = [second_hz, third_hz].map(|f| (2.0 * PI * f).powi(2));
    let mut solutions: Vec<CouplingStiffness> = chain
        .roots(eigenvalues)
        .into_iter()
        .filter_map(|[k12, k23]| {
            let found = chain.eigenvalues(k12, k23);
            let same = |found: f64, given: f64| (found / given - 1.0).abs() < SAME_EIGENVALUE;
            (same(found[1], eigenvalues[0]) && same(found[2], eigenvalues[1])).then(|| CouplingStiffness {
                k12_n_per_m: k12,
                k23_n_per_m: k23,
                first_hz: found[0].max(0.0).sqrt() / (2.0 * PI),
                sensitivity_n_per_m: chain.sensitivity(eigenvalues, k12, k23),
            })
        })
        .collect();
    let rank = |solution: &CouplingStiffness| match first_hz {
        Some(measured) => (solution.first_hz - measured).abs(),
        None => solution.k12_n_per_m,
    };
    solutions.sort_by(|a, b| rank(a).total_cmp(&rank(b)));
    Ok(solutions)
}

struct Chain {
    masses_kg: [f64; 3],
    ground_n_per_m: [f64; 3],
}

/// |K − λM| = p + q k12 + r k23 + s k12 k23.
struct Determinant {
    p: f64,
    q: f64,
    r: f64,
    s: f64,
}

impl Determinant {
    /// From the diagonal d of K − λM without coupling springs.
    fn new([d1, d2, d3]: [f64; 3]) -> Self {
        Self { p: d1 * d2 * d3, q: d3 * (d1 + d2), r: d1 * (d2 + d3), s: d1 + d2 + d3 }
    }

    fn at(&self, k12: f64, k23: f64) -> f64 {
        self.p + self.q * k12 + self.r * k23 + self.s * k12 * k23
    }
}

impl Chain {
    /// Diagonal d of K − λM without coupling springs.
    fn diagonal(&self, eigenvalue: f64) -> [f64; 3] {
        std::array::from_fn(|i| self.ground_n_per_m[i] - eigenvalue * self.masses_kg[i])
    }

    /// Positive k12 and k23 for which both determinants vanish.
    fn roots(&self, eigenvalues: [f64; 2]) -> Vec<[f64; 2]> {
        // Scaled by the largest diagonal entry, all coefficients are of the order of 1.
        let diagonals = eigenvalues.map(|eigenvalue| self.diagonal(eigenvalue));
        let unit = diagonals.iter().flatten().fold(0.0_f64, |unit, d| unit.max(d.abs()));
        let [second, third] = diagonals.map(|diagonal| Determinant::new(diagonal.map(|d| d / unit)));
        let k12 = quadratic_roots(
            third.q * second.s - second.q * third.s,
            third.p * second.s + third.q * second.r - second.p * third.s - second.q * third.r,
            third.p * second.r - second.p * third.r,
        );
        let k23 = |k12: f64| {
            let (by_second, by_third) = (second.r + second.s * k12, third.r + third.s * k12);
            // Both equations give k23; the one with the larger coefficient is better conditioned.
            if by_second.abs() > by_third.abs() {
                -(second.p + second.q * k12) / by_second
            } else {
                -(third.p + third.q * k12) / by_third
            }
        };
        let both = k12.into_iter().map(|k12| [k12 * unit, k23(k12) * unit]);
        both.filter(|pair| pair.iter().all(|k| *k > 0.0 && k.is_finite())).collect()
    }

    /// Eigenvalues λ of K φ = λ M φ, ascending.
    fn eigenvalues(&self, k12: f64, k23: f64) -> [f64; 3] {
        let [g1, g2, g3] = self.ground_n_per_m;
        let stiffness = Matrix3::new(g1 + k12, -k12, 0.0, -k12, g2 + k12 + k23, -k23, 0.0, -k23, g3 + k23);
        let scaled = Matrix3::from_fn(|i, j| stiffness[(i, j)] / (self.masses_kg[i].sqrt() * self.masses_kg[j].sqrt()));
        let mut eigenvalues: [f64; 3] = scaled.symmetric_eigenvalues().into();
        eigenvalues.sort_by(f64::total_cmp);
        eigenvalues
    }

    /// Derivatives ∂k/∂ln f of k12 and k23 with respect to the second and the third frequency, N/m; infinite where two solutions
    /// coincide.
    ///
    /// ```text
    ///  Σ_j ∂D_i/∂k_j dk_j + ∂D_i/∂λ_i dλ_i = 0,    dλ = 2λ d ln f,    D_i = |K − λ_i M|
    /// ```
    fn sensitivity(&self, eigenvalues: [f64; 2], k12: f64, k23: f64) -> [[f64; 2]; 2] {
        let diagonals = eigenvalues.map(|eigenvalue| self.diagonal(eigenvalue));
        let [second, third] = diagonals.map(Determinant::new);
        let by_stiffness = Matrix2::new(
            second.q + second.s * k23,
            second.r + second.s * k12,
            third.q + third.s * k23,
            third.r + third.s * k12,
        );
        let by_log_frequency = |i: usize| {
            let [d1, d2, d3] = diagonals[i];
            let [m1, m2, m3] = self.masses_kg;
            let slope = Determinant {
                p: m1 * d2 * d3 + d1 * m2 * d3 + d1 * d2 * m3,
                q: m3 * (d1 + d2) + d3 * (m1 + m2),
                r: m1 * (d2 + d3) + d1 * (m2 + m3),
                s: m1 + m2 + m3,
            };
            -2.0 * eigenvalues[i] * slope.at(k12, k23)
        };
        let Some(inverse) = by_stiffness.try_inverse() else { return [[f64::INFINITY; 2]; 2] };
        let sensitivity = -inverse * Matrix2::from_diagonal(&[by_log_frequency(0), by_log_frequency(1)].into());
        [[sensitivity[(0, 0)], sensitivity[(0, 1)]], [sensitivity[(1, 0)], sensitivity[(1, 1)]]]
    }
}

/// Real roots of a x² + b x + c; a double root is returned once.
fn quadratic_roots(a: f64, b: f64, c: f64) -> Vec<f64> {
    let mut discriminant = b * b - 4.0 * a * c;
    if discriminant.abs() < ROUNDING * b * b {
        discriminant = 0.0;
    }
    if discriminant < 0.0 {
        return Vec::new();
    }
    // Both terms of the sum have the same sign, so that no digits cancel. For a = 0 the first root is infinite and is discarded
    // by the caller.
    let sum = -0.5 * (b + discriminant.sqrt().copysign(b));
    let mut roots = vec![sum / a, c / sum];
    if discriminant == 0.0 {
        roots.pop();
    }
    roots
}
