//! Some natural frequencies of eight structures at once, one in each SIMD lane, near values that are known roughly: Rayleigh quotient
//! iteration on the banded matrices.
//!
//! Where frequencies have been measured, those of a run that could explain them are near. The work then grows with n b² for n degrees of
//! freedom and b entries beside the diagonal, and not with n³.
//!
//! ```text
//!  (K − σ M) y = r,    θ = σ + yᵀr/yᵀMy,    then σ ← θ, r ← M y/√(yᵀMy)          K − σ M = L D Lᵀ
//! ```
//!
//! The number of negative d_i is that of the eigenvalues below σ (Sylvester), which tells whether the eigenvalues that were found are the
//! wanted ones. Runs of which others were found are left to the solver that needs no start, see `crates/structures/src/physics/tridiagonal.rs`.
//!
//! Source: B. N. Parlett (1998), The symmetric eigenvalue problem, SIAM, §4.6 and §3.3.

#![allow(clippy::needless_range_loop, reason = "a loop over the lanes becomes vector instructions")]

use nalgebra::DMatrix;

use super::assembly::{mass_matrix, stiffness_matrix_with};
use super::lanes::{Lanes, LANES};
use super::modes::modes;
use super::structure::Structure;

/// Most entries beside the diagonal in a row of the lower triangle.
const MOST_BESIDE: usize = 8;

/// Most iterations. From a start with an error of a hundredth, three suffice; one that takes more has mostly another end.
const MOST_ITERATIONS: usize = 5;

/// Relative length of the last step. The error that is left is of the order of its third power.
const LAST_STEP: f64 = 1e-6;

/// Relative distance from an eigenvalue at which the eigenvalues below are counted: far more than its error.
const ASIDE: f64 = 1e-7;

/// A structure some of whose stiffnesses change from run to run.
#[derive(Debug, Clone)]
pub(super) struct Banded {
    n: usize,
    /// Entries of a row: those beside the diagonal, and the diagonal, which is the last.
    width: usize,
    /// The rows of the lower triangles of M and of K without the springs that change, `[n·width]`.
    mass: Vec<f64>,
    fixed: Vec<f64>,
    /// Place in a lower triangle and entry for a unit of each stiffness that changes.
    units: Vec<Vec<(usize, f64)>>,
    /// r at the start: the sum of M φ over the wanted modes at the stiffnesses of the structure.
    start: Vec<f64>,
    /// Row of each degree of freedom.
    places: Vec<usize>,
}

/// The eigenvalues that were found.
pub(super) struct Near {
    /// `[wanted]`; only right in the lanes in which all are found.
    pub(super) eigenvalues: Vec<Lanes>,
    /// Their shapes φ, φᵀMφ = 1, `[wanted, n]`.
    pub(super) shapes: Vec<Lanes>,
    /// Whether all are found: 0 or 1.
    pub(super) are_found: Lanes,
}

/// What the iteration works on.
struct Work {
    stiffness: Vec<Lanes>,
    /// L without its diagonal, in the places of the lower triangle; 1/d_i in the place of the diagonal.
    factor: Vec<Lanes>,
    right: Vec<Lanes>,
    solution: Vec<Lanes>,
}

impl Banded {
    /// `None` if the matrices are not banded, or if the structure has no modes.
    pub(super) fn new(structure: &Structure, springs: &[usize], count: usize) -> Option<Self> {
        let n = structure.dofs();
        let all: Vec<(usize, f64)> = springs.iter().map(|spring| (*spring, 1.0)).collect();
        let mass = mass_matrix(structure);
        let pattern = stiffness_matrix_with(structure, &all);
        let is_used = |i: usize, j: usize| i != j && (mass[(i, j)] != 0.0 || pattern[(i, j)] != 0.0);
        let neighbours: Vec<Vec<usize>> = (0..n).map(|i| (0..n).filter(|j| is_used(i, *j)).collect()).collect();
        let places = places(&neighbours);
        let distance = |i: usize| neighbours[i].iter().map(|j| places[i].abs_diff(places[*j])).max();
        let beside = (0..n).filter_map(distance).max().unwrap_or(0);
        if beside > MOST_BESIDE.min(n / 3) {
            return None;
        }
        let width = beside + 1;
        let place = |i: usize, j: usize| {
            let (row, column) = (places[i].max(places[j]), places[i].min(places[j]));
            row * width + beside + column - row
        };
        let rows = |matrix: &DMatrix<f64>| {
            let mut band = vec![0.0; n * width];
            for (i, j) in (0..n).flat_map(|i| (0..=i).map(move |j| (i, j))).filter(|(i, j)| i == j || is_used(*i, *j)) {
                band[place(i, j)] = matrix[(i, j)];
            }
            band
        };
        let zeros: Vec<(usize, f64)> = springs.iter().map(|spring| (*spring, 0.0)).collect();
        let unit = |spring: &usize| {
            let mut band = vec![0.0; n * width];
            structure.springs()[*spring].form.entries(|i, j, value| {
                if j <= i {
                    band[place(i, j)] += value;
                }
            });
            band.into_iter().enumerate().filter(|(_, value)| *value != 0.0).collect()
        };
        let of_dofs = &mass * modes(structure, count).ok()?.shapes().column_sum();
        let mut start = vec![0.0; n];
        places.iter().zip(&of_dofs).for_each(|(place, value)| start[*place] = *value);
        Some(Self {
            n,
            width,
            mass: rows(&mass),
            fixed: rows(&stiffness_matrix_with(structure, &zeros)),
            units: springs.iter().map(unit).collect(),
            start,
            places,
        })
    }

    /// The eigenvalues with the numbers `wanted`, counted from 0, from starts near them, at the stiffnesses that change, `[springs]`. Those of
    /// a lane do not depend on the others.
    pub(super) fn near(&self, stiffnesses: &[Lanes], wanted: &[(usize, f64)]) -> Near {
        let zeros = |count: usize| vec![Lanes::ZERO; count];
        let mut work = Work {
            stiffness: zeros(self.n * self.width),
            factor: zeros(self.n * self.width),
            right: zeros(self.n),
            solution: zeros(self.n),
        };
        let mut near = Near {
            eigenvalues: zeros(wanted.len()),
            shapes: zeros(wanted.len() * self.n),
            are_found: Lanes([1.0; LANES]),
        };
        let mut shape = zeros(self.n);
        assemble(self, stiffnesses, &mut work.stiffness);
        for (index, (number, start)) in wanted.iter().enumerate() {
            find(self, *start, &mut work, (&mut near.eigenvalues[index], &mut shape, &mut near.are_found));
            let of_dofs = &mut near.shapes[index * self.n..(index + 1) * self.n];
            of_dofs.iter_mut().zip(&self.places).for_each(|(value, place)| *value = shape[*place]);
            let is_first = index == 0 || wanted[index - 1].0 + 1 < *number;
            let is_last = wanted.get(index + 1).is_none_or(|next| number + 1 < next.0);
            let (eigenvalue, found) = (near.eigenvalues[index], &mut near.are_found);
            if is_first && *number > 0 {
                verify(self, (&eigenvalue, 1.0 - ASIDE, *number), &mut work, found);
            }
            if is_last {
                verify(self, (&eigenvalue, 1.0 + ASIDE, number + 1), &mut work, found);
            }
            if index > 0 {
                ascend(&near.eigenvalues[index - 1], &eigenvalue, found);
            }
        }
        near
    }
}

/// A row for each degree of freedom, so that those that act on each other have rows near each other.
///
/// Source: E. Cuthill, J. McKee (1969), Reducing the bandwidth of sparse symmetric matrices, Proc. 24th National Conference of the ACM,
/// 157–172.
fn places(neighbours: &[Vec<usize>]) -> Vec<usize> {
    let outwards = |root: usize| {
        let (mut order, mut is_reached) = (vec![root], vec![false; neighbours.len()]);
        is_reached[root] = true;
        let mut next = 0;
        while next < order.len() {
            let mut new: Vec<usize> = neighbours[order[next]].iter().copied().filter(|j| !is_reached[*j]).collect();
            new.sort_by_key(|j| neighbours[*j].len());
            for j in &new {
                is_reached[*j] = true;
            }
            order.extend(new);
            next += 1;
        }
        order
    };
    let (mut places, mut count) = (vec![usize::MAX; neighbours.len()], 0);
    while let Some(any) = places.iter().position(|place| *place == usize::MAX) {
        // Twice from an end that was reached last: from one end of the structure to the other.
        let first_end = *outwards(any).last().unwrap_or(&any);
        let other_end = *outwards(first_end).last().unwrap_or(&any);
        for dof in outwards(other_end) {
            places[dof] = count;
            count += 1;
        }
    }
    places
}

#[pulp::with_simd(assemble = pulp::Arch::new())]
#[inline(always)]
fn assemble_simd<S: pulp::Simd>(_: S, banded: &Banded, stiffnesses: &[Lanes], stiffness: &mut [Lanes]) {
    for (entry, fixed) in stiffness.iter_mut().zip(&banded.fixed) {
        entry.0 = [*fixed; LANES];
    }
    for (unit, value) in banded.units.iter().zip(stiffnesses) {
        for (place, entry) in unit {
            for lane in 0..LANES {
                stiffness[*place].0[lane] += entry * value.0[lane];
            }
        }
    }
}

/// Writes 0 to the lanes of `are_found` in which the number of eigenvalues below `eigenvalue` times `factor` is not `count`.
#[pulp::with_simd(verify = pulp::Arch::new())]
#[inline(always)]
fn verify_simd<S: pulp::Simd>(
    _: S,
    banded: &Banded,
    (eigenvalue, factor, count): (&Lanes, f64, usize),
    work: &mut Work,
    are_found: &mut Lanes,
) {
    let below = factorise(banded, &eigenvalue.0.map(|eigenvalue| factor * eigenvalue), work);
    for lane in 0..LANES {
        are_found.0[lane] *= if (below[lane] - count as f64).abs() < 0.5 { 1.0 } else { 0.0 };
    }
}

/// Writes 0 to the lanes of `are_found` in which `next` is not larger than `before`.
fn ascend(before: &Lanes, next: &Lanes, are_found: &mut Lanes) {
    for lane in 0..LANES {
        let is_larger = next.0[lane] * (1.0 - 2.0 * ASIDE) > before.0[lane];
        are_found.0[lane] *= if is_larger { 1.0 } else { 0.0 };
    }
}

/// Searches an eigenvalue near `start`, with its shape; writes 0 to the lanes of `are_found` in which none is found.
#[pulp::with_simd(find = pulp::Arch::new())]
#[inline(always)]
fn find_simd<S: pulp::Simd>(
    _: S,
    banded: &Banded,
    start: f64,
    work: &mut Work,
    (eigenvalue, shape, are_found): (&mut Lanes, &mut [Lanes], &mut Lanes),
) {
    let (mut shift, mut is_open) = ([start; LANES], [1.0; LANES]);
    for (right, start) in work.right.iter_mut().zip(&banded.start) {
        right.0 = [*start; LANES];
    }
    for _ in 0..MOST_ITERATIONS {
        factorise(banded, &shift, work);
        let (along, square) = solve(banded, work);
        let (mut scale, was_open) = ([0.0; LANES], is_open);
        let mut still_open = 0.0;
        for lane in 0..LANES {
            let next = shift[lane] + along[lane] / square[lane];
            scale[lane] = 1.0 / square[lane].sqrt();
            // False for NaN, as all comparisons.
            let is_near = (next - shift[lane]).abs() <= LAST_STEP * next;
            let is_last = was_open[lane] > 0.5 && is_near;
            eigenvalue.0[lane] = if was_open[lane] > 0.5 { next } else { eigenvalue.0[lane] };
            is_open[lane] = if is_last { 0.0 } else { was_open[lane] };
            shift[lane] = if is_open[lane] > 0.5 { next } else { shift[lane] };
            still_open += is_open[lane];
        }
        for (shape, solution) in shape.iter_mut().zip(&work.solution) {
            for lane in 0..LANES {
                let new = scale[lane] * solution.0[lane];
                shape.0[lane] = if was_open[lane] > 0.5 { new } else { shape.0[lane] };
            }
        }
        if still_open < 0.5 {
            return;
        }
        for right in &mut work.right {
            for lane in 0..LANES {
                right.0[lane] *= scale[lane];
            }
        }
    }
    for lane in 0..LANES {
        are_found.0[lane] *= 1.0 - is_open[lane];
    }
}

/// Factorises K − σ M. Returns the number of negative d_i.
#[inline(always)]
fn factorise(banded: &Banded, shift: &[f64; LANES], work: &mut Work) -> [f64; LANES] {
    let (width, beside) = (banded.width, banded.width - 1);
    let mut below = [0.0; LANES];
    // l_ij d_j of the row.
    let mut scaled = [[0.0; LANES]; MOST_BESIDE];
    for i in 0..banded.n {
        let (before, row) = work.factor.split_at_mut(i * width);
        let (stiffness, mass) = (&work.stiffness[i * width..(i + 1) * width], &banded.mass[i * width..(i + 1) * width]);
        let mut pivot = [0.0; LANES];
        for lane in 0..LANES {
            pivot[lane] = stiffness[beside].0[lane] - shift[lane] * mass[beside];
        }
        let first = beside - beside.min(i);
        for t in first..beside {
            let of_column = &before[(i + t - beside) * width..(i + t - beside + 1) * width];
            let mut entry = [0.0; LANES];
            for lane in 0..LANES {
                entry[lane] = stiffness[t].0[lane] - shift[lane] * mass[t];
            }
            for s in first..t {
                for lane in 0..LANES {
                    entry[lane] -= scaled[s][lane] * of_column[beside + s - t].0[lane];
                }
            }
            scaled[t] = entry;
            for lane in 0..LANES {
                let l = entry[lane] * of_column[beside].0[lane];
                row[t].0[lane] = l;
                pivot[lane] -= entry[lane] * l;
            }
        }
        for lane in 0..LANES {
            below[lane] += if pivot[lane] < 0.0 { 1.0 } else { 0.0 };
            // Keeps the division finite without changing the sign.
            row[beside].0[lane] = 1.0 / pivot[lane].abs().max(f64::MIN_POSITIVE).copysign(pivot[lane]);
        }
    }
    below
}

/// Solves (K − σ M) y = r. Returns yᵀr and yᵀMy, and leaves M y in the place of r.
#[inline(always)]
fn solve(banded: &Banded, work: &mut Work) -> ([f64; LANES], [f64; LANES]) {
    let (n, width, beside) = (banded.n, banded.width, banded.width - 1);
    let y = &mut work.solution;
    for i in 0..n {
        let mut sum = work.right[i].0;
        for t in beside - beside.min(i)..beside {
            for lane in 0..LANES {
                sum[lane] -= work.factor[i * width + t].0[lane] * y[i + t - beside].0[lane];
            }
        }
        y[i].0 = sum;
    }
    for i in (0..n).rev() {
        let mut sum = [0.0; LANES];
        for lane in 0..LANES {
            sum[lane] = y[i].0[lane] * work.factor[i * width + beside].0[lane];
        }
        for below in i + 1..n.min(i + width) {
            for lane in 0..LANES {
                sum[lane] -= work.factor[below * width + beside + i - below].0[lane] * y[below].0[lane];
            }
        }
        y[i].0 = sum;
    }
    let (mut along, mut square) = ([0.0; LANES], [0.0; LANES]);
    for i in 0..n {
        for lane in 0..LANES {
            along[lane] += y[i].0[lane] * work.right[i].0[lane];
        }
    }
    for i in 0..n {
        let mut sum = [0.0; LANES];
        for t in beside - beside.min(i)..width {
            for lane in 0..LANES {
                sum[lane] += banded.mass[i * width + t] * y[i + t - beside].0[lane];
            }
        }
        for below in i + 1..n.min(i + width) {
            for lane in 0..LANES {
                sum[lane] += banded.mass[below * width + beside + i - below] * y[below].0[lane];
            }
        }
        work.right[i].0 = sum;
        for lane in 0..LANES {
            square[lane] += y[i].0[lane] * sum[lane];
        }
    }
    (along, square)
}
