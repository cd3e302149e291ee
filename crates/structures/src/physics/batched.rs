//! Batched eigensolver: natural frequencies of a structure at many stiffnesses, eight at a time, one in each SIMD lane.
//!
//! Weighting posterior samples takes thousands of runs of the same structure. Solved one by one, most of the time of a run goes into
//! assembly and into the branches of the iteration. Small matrices are diagonalised by rotations, larger ones are reduced to tridiagonal
//! form, see `crates/structures/src/physics/tridiagonal.rs`.

use std::f64::consts::PI;

use super::banded::{Banded, Near};
use super::batched_slopes::SlopePatterns;
use super::lanes::{Lanes, LANES};
use super::modes::{Scaled, SINGULAR};
use super::structure::{Form, Structure};
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
    slope_patterns: SlopePatterns,
    /// Whether each stiffness that changes may be negative, as that of a compression.
    signed: Vec<bool>,
    /// For larger structures whose matrices are banded.
    banded: Option<Banded>,
}

/// Natural frequencies of many runs and their derivatives.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct FrequenciesAndSlopes {
    /// Hz, ascending within each run, row-major `[runs, modes]`; NaN for a run that has none.
    pub frequencies_hz: Vec<f64>,
    /// Derivatives, row-major `[runs, modes, stiffnesses]`, Hz per unit of the stiffness (or of the parameter that sets it). Those of equal
    /// frequencies are finite and not unique.
    pub slopes: Vec<f64>,
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
        let mass_root = Scaled::new(structure, &[]).ok()?.mass_root();
        let forms = springs.iter().map(|spring| &structure.springs()[*spring].form);
        let slope_patterns = SlopePatterns::new(&mass_root, forms);
        let banded = (dofs > MOST_DOFS_ROTATED).then(|| Banded::new(structure, springs, modes)).flatten();
        let signed = springs.iter().map(|spring| matches!(structure.springs()[*spring].form, Form::Slope(_))).collect();
        Some(Self { dofs, modes, fixed, units, slope_patterns, signed, banded })
    }

    /// Natural frequencies, Hz, ascending within each run, as a row-major matrix `[runs, modes]`. `n_per_m` holds the stiffnesses
    /// of the springs that change, as a row-major matrix `[runs, springs]`. The frequencies of a run are NaN if one of its
    /// stiffnesses is not finite, or negative and not that of a compression, or if the structure is a mechanism.
    ///
    /// # Panics
    /// If no spring changes, or if the length of `n_per_m` is not a multiple of the number of springs: a programming error in the
    /// caller.
    pub fn frequencies_hz(&self, n_per_m: &[f64]) -> Vec<f64> {
        let mut frequencies = Vec::with_capacity(n_per_m.len() / self.units.len() * self.modes);
        for batch in self.batches(n_per_m) {
            let mut lower = self.lower(&batch);
            let solved =
                if self.dofs <= MOST_DOFS_ROTATED { self.rotated(&lower) } else { self.tridiagonal(&mut lower) };
            for (given, (eigenvalues, largest)) in batch.runs.chunks(self.units.len()).zip(solved) {
                self.add_frequencies(given, &eigenvalues, largest, &mut frequencies);
            }
        }
        frequencies
    }

    /// [`Self::frequencies_hz`] and their derivatives with respect to the stiffnesses of the springs that change.
    ///
    /// # Panics
    /// As [`Self::frequencies_hz`].
    pub fn frequencies_and_slopes(&self, n_per_m: &[f64]) -> FrequenciesAndSlopes {
        let mut found = FrequenciesAndSlopes::default();
        for batch in self.batches(n_per_m) {
            self.add_with_slopes(&batch, &mut found);
        }
        found
    }

    /// As [`Self::frequencies_and_slopes`], for the modes whose measured frequency, Hz, `near_hz` gives, `[modes]`; NaN for the others. Where
    /// the matrices are banded, this is several times as fast for runs whose frequencies are near.
    ///
    /// # Panics
    /// As [`Self::frequencies_hz`].
    pub fn frequencies_and_slopes_near(&self, n_per_m: &[f64], near_hz: &[Option<f64>]) -> FrequenciesAndSlopes {
        let Some(banded) = &self.banded else { return self.frequencies_and_slopes(n_per_m) };
        let (springs, modes) = (self.units.len(), self.modes);
        let (mut found, mut open) = (FrequenciesAndSlopes::default(), Vec::new());
        for batch in self.batches(n_per_m) {
            let near = banded.near(&batch.stiffnesses, &wanted(near_hz));
            let slopes = self.slope_patterns.of_shapes(&near.eigenvalues, &near.shapes);
            for lane in 0..batch.runs.len() / springs {
                near.note(lane, found.frequencies_hz.len() / modes, &mut open);
                near.add_frequencies(lane, near_hz, &mut found.frequencies_hz);
                let mut rows = slopes.chunks(springs);
                for near_hz in near_hz {
                    let row = near_hz.and_then(|_| rows.next());
                    let slope = |spring: usize| row.map_or(f64::NAN, |row| row[spring].0[lane]);
                    found.slopes.extend((0..springs).map(slope));
                }
            }
        }
        let others = self.frequencies_and_slopes(&chosen(n_per_m, springs, &open));
        replace(&mut found.frequencies_hz, modes, &open, &others.frequencies_hz);
        replace(&mut found.slopes, modes * springs, &open, &others.slopes);
        found
    }

    /// As [`Self::frequencies_hz`], for the modes whose measured frequency, Hz, `near_hz` gives, `[modes]`; the others are NaN, or what they
    /// are. See [`Self::frequencies_and_slopes_near`].
    ///
    /// # Panics
    /// As [`Self::frequencies_hz`].
    pub fn frequencies_near_hz(&self, n_per_m: &[f64], near_hz: &[Option<f64>]) -> Vec<f64> {
        let Some(banded) = &self.banded else { return self.frequencies_hz(n_per_m) };
        let (springs, modes) = (self.units.len(), self.modes);
        let (mut found, mut open) = (Vec::with_capacity(n_per_m.len() / springs * modes), Vec::new());
        for batch in self.batches(n_per_m) {
            let near = banded.near(&batch.stiffnesses, &wanted(near_hz));
            for lane in 0..batch.runs.len() / springs {
                near.note(lane, found.len() / modes, &mut open);
                near.add_frequencies(lane, near_hz, &mut found);
            }
        }
        let others = self.frequencies_hz(&chosen(n_per_m, springs, &open));
        replace(&mut found, modes, &open, &others);
        found
    }

    fn add_with_slopes(&self, batch: &Batch<'_>, found: &mut FrequenciesAndSlopes) {
        let mut lower = self.lower(batch);
        let matrix = Tridiagonal::of(&mut lower, self.dofs);
        let lowest = matrix.lowest(self.modes);
        let slopes = self.slope_patterns.slopes(&matrix, &lower, &lowest);
        for (lane, given) in batch.runs.chunks(self.units.len()).enumerate() {
            let eigenvalues: Vec<f64> = lowest.eigenvalues.iter().map(|all| all.0[lane]).collect();
            self.add_frequencies(given, &eigenvalues, lowest.bound.0[lane], &mut found.frequencies_hz);
            found.slopes.extend(slopes.iter().map(|all| all.0[lane]));
        }
    }

    /// The runs with the stiffnesses `n_per_m`, `[runs, springs]`, up to eight at a time.
    fn batches<'a>(&self, n_per_m: &'a [f64]) -> impl Iterator<Item = Batch<'a>> {
        let springs = self.units.len();
        assert!(n_per_m.len().is_multiple_of(springs), "{} stiffnesses for {springs} springs", n_per_m.len());
        n_per_m.chunks(LANES * springs).map(move |runs| {
            // Unused lanes repeat the last run.
            let count = runs.len() / springs;
            let stiffness =
                |spring: usize| Lanes(std::array::from_fn(|lane| runs[lane.min(count - 1) * springs + spring]));
            Batch { runs, stiffnesses: (0..springs).map(stiffness).collect() }
        })
    }

    /// The lower triangles of the matrices of a batch, row by row.
    fn lower(&self, batch: &Batch<'_>) -> Vec<Lanes> {
        let mut lower = vec![Lanes::ZERO; self.fixed.len()];
        assemble(&mut lower, &self.fixed, &self.units, &batch.stiffnesses);
        lower
    }

    /// Adds the frequencies of a run with the stiffnesses `given`, NaN where it has none. `largest`: the largest eigenvalue, or a bound of it.
    fn add_frequencies(&self, given: &[f64], eigenvalues: &[f64], largest: f64, frequencies: &mut Vec<f64>) {
        let valid = given.iter().zip(&self.signed).all(|(k, signed)| k.is_finite() && (*signed || *k >= 0.0));
        let solved = valid && eigenvalues[0] > SINGULAR * largest && largest.is_finite();
        let frequency = |eigenvalue: &f64| if solved { eigenvalue.sqrt() / (2.0 * PI) } else { f64::NAN };
        frequencies.extend(eigenvalues.iter().map(frequency));
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

/// Up to eight runs.
struct Batch<'a> {
    /// Stiffnesses, `[runs, springs]`.
    runs: &'a [f64],
    /// The same of each spring.
    stiffnesses: Vec<Lanes>,
}

impl Near {
    /// Adds the number of a run in a lane to the runs that are not found, if it is none that is.
    fn note(&self, lane: usize, run: usize, open: &mut Vec<usize>) {
        if self.are_found.0[lane] < 0.5 {
            open.push(run);
        }
    }

    /// Adds the frequencies of a lane; NaN for modes without a frequency that was given.
    fn add_frequencies(&self, lane: usize, near_hz: &[Option<f64>], frequencies_hz: &mut Vec<f64>) {
        let mut all = self.eigenvalues.iter();
        let frequency = |near_hz: &Option<f64>| {
            near_hz.and_then(|_| all.next()).map_or(f64::NAN, |all| all.0[lane].sqrt() / (2.0 * PI))
        };
        frequencies_hz.extend(near_hz.iter().map(frequency));
    }
}

/// The stiffnesses of some runs, `[runs, springs]`.
fn chosen(n_per_m: &[f64], springs: usize, runs: &[usize]) -> Vec<f64> {
    runs.iter().flat_map(|run| &n_per_m[run * springs..(run + 1) * springs]).copied().collect()
}

/// Replaces the rows of some runs, each of `width` numbers.
fn replace(all: &mut [f64], width: usize, runs: &[usize], rows: &[f64]) {
    for (run, row) in runs.iter().zip(rows.chunks(width)) {
        all[run * width..(run + 1) * width].copy_from_slice(row);
    }
}

/// Numbers of the modes whose frequency is given, with its square as an eigenvalue.
fn wanted(near_hz: &[Option<f64>]) -> Vec<(usize, f64)> {
    let modes = near_hz.iter().enumerate();
    modes.filter_map(|(mode, near_hz)| near_hz.map(|near_hz| (mode, (2.0 * PI * near_hz).powi(2)))).collect()
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
