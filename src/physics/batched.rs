//! Batched eigensolver: natural frequencies of a structure at many stiffnesses, eight at a time, one in each SIMD lane.
//!
//! Weighting posterior samples takes thousands of runs of the same structure. Solved one by one, most of the time of a run goes into
//! assembly and into the branches of the iteration. Small matrices are diagonalised by rotations, larger ones are reduced to tridiagonal
//! form, see `src/physics/tridiagonal.rs`.

use std::f64::consts::PI;

use super::lanes::{Lanes, LANES};
use super::modes::{Scaled, SINGULAR};
use super::structure::Structure;
use super::tridiagonal::Tridiagonal;

/// Largest number of degrees of freedom: beyond it the matrices of eight runs no longer fit into the cache of a core.
pub const MOST_DOFS: usize = 80;

/// Largest number of degrees of freedom whose matrices are diagonalised by rotations: the work of each of the sweeps grows with its cube.
pub const MOST_DOFS_ROTATED: usize = 8;

/// Largest number of sweeps: the iteration converges quadratically from about the third sweep on.
const MOST_SWEEPS: usize = 15;

/// The iteration ends when the norm of the off-diagonal entries, relative to the norm of the matrix, falls below this. The
/// remaining error of an eigenvalue is of the order of its square, divided by the gap to the next eigenvalue.
const NEGLIGIBLE: f64 = 1e-14;

/// The lower triangle of a small symmetric matrix of each run.
type Matrices = [[Lanes; MOST_DOFS_ROTATED]; MOST_DOFS_ROTATED];

/// Solves the eigenproblem of a structure some of whose stiffnesses change from run to run.
///
/// ```text
///  A(k) = A_0 + Σ_s k_s A_s,    M = R Rᵀ
///  A_0 = R⁻¹ K_0 R⁻ᵀ of the springs that do not change,    A_s = R⁻¹ K_s R⁻ᵀ of spring s with unit stiffness
/// ```
#[derive(Debug, Clone)]
pub struct BatchedEigensolver {
    dofs: usize,
    modes: usize,
    /// Lower triangle of A_0, row by row.
    fixed: Vec<f64>,
    /// Lower triangle of each A_s, row by row.
    units: Vec<Vec<f64>>,
}

impl BatchedEigensolver {
    /// Prepares runs of `structure` in which the springs with the indices `springs` change and the lowest `modes` frequencies
    /// are wanted. Returns `None` if the structure has more than [`MOST_DOFS`] or fewer than `modes` degrees of freedom, or if
    /// its mass matrix is not positive definite.
    pub fn new(structure: &Structure, springs: &[usize], modes: usize) -> Option<Self> {
        let dofs = structure.dofs();
        if dofs > MOST_DOFS || modes > dofs {
            return None;
        }
        let lower = |stiffness: &dyn Fn(usize, f64) -> f64| {
            let all = structure.springs().iter().enumerate();
            let changes: Vec<(usize, f64)> = all.map(|(spring, s)| (spring, stiffness(spring, s.n_per_m))).collect();
            let scaled = Scaled::new(structure, &changes).ok()?.stiffness;
            let entries = (0..dofs).flat_map(|row| (0..=row).map(move |column| (row, column)));
            Some(entries.map(|entry| scaled[entry]).collect::<Vec<f64>>())
        };
        let fixed = lower(&|spring, own| if springs.contains(&spring) { 0.0 } else { own })?;
        let unit = |changed: &usize| lower(&|spring, _| f64::from(u8::from(spring == *changed)));
        let units = springs.iter().map(unit).collect::<Option<_>>()?;
        Some(Self { dofs, modes, fixed, units })
    }

    /// Natural frequencies, Hz, ascending within each run, as a row-major matrix `[runs, modes]`. `n_per_m` holds the stiffnesses
    /// of the springs that change, as a row-major matrix `[runs, springs]`. The frequencies of a run are NaN if one of its
    /// stiffnesses is negative or not finite, or if the structure is a mechanism.
    ///
    /// # Panics
    /// If no spring changes, or if the length of `n_per_m` is not a multiple of the number of springs: a programming error in the
    /// caller.
    pub fn frequencies_hz(&self, n_per_m: &[f64]) -> Vec<f64> {
        let springs = self.units.len();
        assert!(n_per_m.len().is_multiple_of(springs), "{} stiffnesses for {springs} springs", n_per_m.len());
        let mut frequencies = Vec::with_capacity(n_per_m.len() / springs * self.modes);
        let mut lower = vec![Lanes::ZERO; self.fixed.len()];
        for runs in n_per_m.chunks(LANES * springs) {
            // Unused lanes repeat the last run.
            let count = runs.len() / springs;
            let stiffness =
                |spring: usize| Lanes(std::array::from_fn(|lane| runs[lane.min(count - 1) * springs + spring]));
            let stiffnesses: Vec<Lanes> = (0..springs).map(stiffness).collect();
            assemble(&mut lower, &self.fixed, &self.units, &stiffnesses);
            let solved =
                if self.dofs <= MOST_DOFS_ROTATED { self.rotated(&lower) } else { self.tridiagonal(&mut lower) };
            for (lane, (eigenvalues, largest)) in solved.into_iter().take(count).enumerate() {
                let given = &runs[lane * springs..(lane + 1) * springs];
                let valid = given.iter().all(|k| k.is_finite() && *k >= 0.0);
                let solved = valid && eigenvalues[0] > SINGULAR * largest && largest.is_finite();
                let frequency = |eigenvalue: &f64| if solved { eigenvalue.sqrt() / (2.0 * PI) } else { f64::NAN };
                frequencies.extend(eigenvalues.iter().map(frequency));
            }
        }
        frequencies
    }

    /// The lowest eigenvalues of each run and its largest.
    fn rotated(&self, lower: &[Lanes]) -> Vec<(Vec<f64>, f64)> {
        let mut matrices = [[Lanes::ZERO; MOST_DOFS_ROTATED]; MOST_DOFS_ROTATED];
        let entries = matrices.iter_mut().enumerate().flat_map(|(row, entries)| &mut entries[..=row]);
        entries.zip(lower).for_each(|(entry, value)| *entry = *value);
        diagonalise(&mut matrices, self.dofs);
        let of_lane = |lane: usize| {
            let mut all: Vec<f64> = (0..self.dofs).map(|i| matrices[i][i].0[lane]).collect();
            all.sort_unstable_by(f64::total_cmp);
            let largest = all[self.dofs - 1];
            all.truncate(self.modes);
            (all, largest)
        };
        (0..LANES).map(of_lane).collect()
    }

    /// The lowest eigenvalues of each run, and a bound of the largest, which is at most twice as large.
    fn tridiagonal(&self, lower: &mut [Lanes]) -> Vec<(Vec<f64>, f64)> {
        let found = Tridiagonal::of(lower, self.dofs).lowest(self.modes);
        let of_lane = |lane: usize| (found.eigenvalues.iter().map(|all| all.0[lane]).collect(), found.bound.0[lane]);
        (0..LANES).map(of_lane).collect()
    }
}

/// Computes A(k) of each run.
#[pulp::with_simd(assemble = pulp::Arch::new())]
#[inline(always)]
fn assemble_simd<S: pulp::Simd>(_: S, lower: &mut [Lanes], fixed: &[f64], units: &[Vec<f64>], stiffnesses: &[Lanes]) {
    for (place, (entry, fixed)) in lower.iter_mut().zip(fixed).enumerate() {
        let mut sum = [*fixed; LANES];
        for (unit, stiffnesses) in units.iter().zip(stiffnesses) {
            let unit = unit[place];
            for (sum, stiffness) in sum.iter_mut().zip(&stiffnesses.0) {
                *sum += unit * stiffness;
            }
        }
        entry.0 = sum;
    }
}

/// Diagonalises the matrix of each run by the cyclic Jacobi method; the eigenvalues are left on the diagonals.
///
/// ```text
///  t = sgn(d)·2a_pq / (|d| + √(d² + 4a_pq²)),   d = a_qq − a_pp,   c = 1/√(1 + t²),   s = t c
///  a_pp −= t a_pq,   a_qq += t a_pq,   (a_rp, a_rq) ← (c a_rp − s a_rq, s a_rp + c a_rq),   a_pq ← 0
/// ```
///
/// The loop over the lanes has no branches, so that it compiles to vector instructions.
///
/// Source: Golub & Van Loan (2013), Matrix Computations, §8.5.
#[pulp::with_simd(diagonalise = pulp::Arch::new())]
#[inline(always)]
fn diagonalise_simd<S: pulp::Simd>(_: S, a: &mut Matrices, n: usize) {
    // Avoids 0/0 where the entry to be eliminated is zero already.
    const LEAST: f64 = f64::MIN_POSITIVE;
    for _ in 0..MOST_SWEEPS {
        let (mut off, mut all) = ([0.0; LANES], [0.0; LANES]);
        for (row, entries) in a[..n].iter().enumerate() {
            for entry in &entries[..row] {
                for (off, entry) in off.iter_mut().zip(&entry.0) {
                    *off += entry * entry;
                }
            }
            for (all, entry) in all.iter_mut().zip(&entries[row].0) {
                *all += entry * entry;
            }
        }
        // A comparison with NaN is false, so that a run without a solution does not delay the others.
        if !off.iter().zip(&all).any(|(off, all)| *off > NEGLIGIBLE * NEGLIGIBLE * all) {
            return;
        }
        for q in 1..n {
            for p in 0..q {
                let (mut first, mut last, between) = (a[p][p].0, a[q][q].0, a[q][p].0);
                let (mut cosine, mut sine) = ([0.0; LANES], [0.0; LANES]);
                for lane in 0..LANES {
                    let (d, b) = (last[lane] - first[lane], 2.0 * between[lane]);
                    let t = b.copysign(b * d) / (d.abs() + (d * d + b * b).sqrt() + LEAST);
                    cosine[lane] = 1.0 / (1.0 + t * t).sqrt();
                    sine[lane] = t * cosine[lane];
                    first[lane] -= t * between[lane];
                    last[lane] += t * between[lane];
                }
                (a[p][p].0, a[q][q].0, a[q][p].0) = (first, last, [0.0; LANES]);
                for r in (0..n).filter(|r| *r != p && *r != q) {
                    let (of_p, of_q) = ((r.max(p), r.min(p)), (r.max(q), r.min(q)));
                    let (mut left, mut right) = (a[of_p.0][of_p.1].0, a[of_q.0][of_q.1].0);
                    for lane in 0..LANES {
                        let (x, y) = (left[lane], right[lane]);
                        left[lane] = cosine[lane] * x - sine[lane] * y;
                        right[lane] = sine[lane] * x + cosine[lane] * y;
                    }
                    (a[of_p.0][of_p.1].0, a[of_q.0][of_q.1].0) = (left, right);
                }
            }
        }
    }
}
