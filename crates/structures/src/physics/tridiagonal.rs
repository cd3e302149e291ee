//! Eigenvalues of eight symmetric matrices at once, one in each SIMD lane: reduction to tridiagonal form, then Sturm sequences and
//! Newton's method for the lowest.

use super::lanes::{Lanes, LANES};

/// Most passes through the Sturm sequences. About ten suffice for separate eigenvalues; halving alone takes about 53 to reach the rounding
/// errors of the largest eigenvalue.
const MOST_PASSES: usize = 80;

/// Passes after which only every second point is that of Newton's method, so that the intervals shrink whatever it does.
const PASSES_OF_NEWTON: usize = 16;

/// Relative length of the last Newton step. The error that is left is about its square, divided by the relative distance to the next
/// eigenvalue.
const LAST_STEP: f64 = 1e-11;

/// Symmetric tridiagonal matrices, one in each lane.
pub(super) struct Tridiagonal {
    /// Diagonal, `[n]`.
    pub(super) diagonal: Vec<Lanes>,
    /// Entries beside the diagonal, the first of them 0, `[n]`, and their squares.
    pub(super) beside: Vec<Lanes>,
    pub(super) beside_squared: Vec<Lanes>,
    /// 1/h of the reflection of each row, `[n]`; 0 for the first two rows, which have none.
    pub(super) reflections: Vec<Lanes>,
}

/// The lowest eigenvalues of each matrix, and a bound of all.
pub(super) struct Lowest {
    /// Ascending in each lane, `[count]`.
    pub(super) eigenvalues: Vec<Lanes>,
    /// No eigenvalue is larger, and the largest is at least half as large if none is negative; not finite if an entry of the matrix is not.
    pub(super) bound: Lanes,
}

impl Tridiagonal {
    /// Reduces the matrices whose lower triangle is `lower`, row by row, `[n(n+1)/2]`, by Householder reflections, from the last row to
    /// the first. The entries of `lower` are overwritten; from the third row on, those before the diagonal are v.
    ///
    /// ```text
    ///  v = x − g e_l,   g = −sgn(x_l)|x|,   h = vᵀv/2       x: entries of row i before the diagonal, the last of them x_l
    ///  p = A v/h,   q = p − (vᵀp/2h) v,   A ← A − v qᵀ − q vᵀ
    /// ```
    ///
    /// Source: Golub & Van Loan (2013), Matrix Computations, §8.3.
    pub(super) fn of(lower: &mut [Lanes], n: usize) -> Self {
        let zeros = || vec![Lanes::ZERO; n];
        let mut result = Self { diagonal: zeros(), beside: zeros(), beside_squared: zeros(), reflections: zeros() };
        let mut work = vec![Lanes::ZERO; n];
        reduce(lower, &mut work, &mut result);
        result
    }

    /// The lowest `count` eigenvalues of matrices without negative eigenvalues. The number of negative q_i is that of the eigenvalues
    /// below x, which narrows an interval about each; where an interval holds a single one, Newton's method finds it.
    ///
    /// ```text
    ///  q_1 = d_1 − x,   q_i = d_i − x − e_i²/q_{i−1},      q'_1 = −1,   q'_i = −1 + e_i² q'_{i−1}/q_{i−1}²
    ///  p(x) = Π_i q_i,   x ← x − p/p' = x − 1/Σ_i (q'_i/q_i)      as long as it stays in the interval
    /// ```
    ///
    /// The eigenvalues of a lane do not depend on the matrices in the others.
    ///
    /// Source: Golub & Van Loan (2013), §8.4, for the sequences.
    pub(super) fn lowest(&self, count: usize) -> Lowest {
        let mut found = Lowest { eigenvalues: vec![Lanes::ZERO; count], bound: Lanes::ZERO };
        let mut searches: Vec<Search> = (0..count).map(|index| Search { index, ..Search::default() }).collect();
        search(self, &mut searches, &mut found);
        found
    }
}

/// The search for one eigenvalue in each lane.
#[derive(Default)]
struct Search {
    /// Its number, counted from 0.
    index: usize,
    /// The interval that holds it, and the numbers of eigenvalues below its ends.
    low: Lanes,
    high: Lanes,
    below_low: Lanes,
    below_high: Lanes,
    /// Where the sequence is evaluated.
    x: Lanes,
    /// q_i, q'_i, the sum of q'/q, and the number of negative q so far.
    q: Lanes,
    slope: Lanes,
    sum: Lanes,
    below: Lanes,
    /// Whether the eigenvalue is found: 0 or 1.
    is_found: Lanes,
}

impl Search {
    /// Where the sequence is evaluated next in a lane, if not at the point of Newton's method: eigenvalues that are wanted divide their
    /// interval evenly in x^¼, in which those of a beam are evenly spaced.
    #[inline(always)]
    fn between(&self, lane: usize, count: usize) -> f64 {
        let (low, high) = (self.low.0[lane].sqrt().sqrt(), self.high.0[lane].sqrt().sqrt());
        let (first, end) = (self.below_low.0[lane], self.below_high.0[lane].min(count as f64));
        let root = low + (self.index as f64 - first + 0.5) / (end - first) * (high - low);
        (root * root) * (root * root)
    }

    /// Narrows the interval by `below` eigenvalues below `x`.
    #[expect(
        clippy::needless_bitwise_bool,
        reason = "without branches, a loop over the lanes becomes vector instructions"
    )]
    #[inline(always)]
    fn narrow(&mut self, x: &Lanes, below: &Lanes) {
        let index = self.index as f64;
        for lane in 0..LANES {
            let (x, below) = (x.0[lane], below.0[lane]);
            let from_above = (below > index) & (x < self.high.0[lane]);
            let from_below = (below <= index) & (x > self.low.0[lane]);
            self.high.0[lane] = if from_above { x } else { self.high.0[lane] };
            self.below_high.0[lane] = if from_above { below } else { self.below_high.0[lane] };
            self.low.0[lane] = if from_below { x } else { self.low.0[lane] };
            self.below_low.0[lane] = if from_below { below } else { self.below_low.0[lane] };
        }
    }

    /// Chooses the next x, and stores the eigenvalue as far as it is known. Returns whether it is found in all lanes.
    #[expect(
        clippy::needless_bitwise_bool,
        reason = "without branches, a loop over the lanes becomes vector instructions"
    )]
    #[inline(always)]
    fn advance(&mut self, bound: &[f64; LANES], count: usize, take_newton: bool, eigenvalues: &mut [Lanes]) -> bool {
        let eigenvalue = &mut eigenvalues[self.index].0;
        let mut are_found = 0.0;
        for lane in 0..LANES {
            let (low, high, x) = (self.low.0[lane], self.high.0[lane], self.x.0[lane]);
            let is_alone = self.below_high.0[lane] - self.below_low.0[lane] < 1.5;
            let newton = x - 1.0 / self.sum.0[lane];
            // False for NaN. Newton's method leaves the interval where it is drawn to another eigenvalue.
            let is_near = is_alone & (newton >= low) & (newton <= high);
            let is_last = is_near & ((newton - x).abs() <= LAST_STEP * newton);
            let is_narrow = high - low <= f64::EPSILON * bound[lane];
            let was_found = self.is_found.0[lane] > 0.0;
            let known = if is_last { newton } else { 0.5 * (low + high) };
            eigenvalue[lane] = if was_found { eigenvalue[lane] } else { known };
            let is_found = was_found | is_last | is_narrow;
            let next = if is_near & take_newton { newton } else { self.between(lane, count) };
            // Where the eigenvalue is found, x stays, so that its sequence tells the others nothing new.
            self.x.0[lane] = if is_found { x } else { next };
            self.is_found.0[lane] = if is_found { 1.0 } else { 0.0 };
            are_found += self.is_found.0[lane];
        }
        are_found > LANES as f64 - 0.5
    }
}

/// See [`Tridiagonal::of`].
#[pulp::with_simd(reduce = pulp::Arch::new())]
#[inline(always)]
fn reduce_simd<S: pulp::Simd>(_: S, lower: &mut [Lanes], p: &mut [Lanes], result: &mut Tridiagonal) {
    let n = result.diagonal.len();
    for i in (1..n).rev() {
        // Rows before row i, and row i itself.
        let (before, row) = lower.split_at_mut(i * (i + 1) / 2);
        let (v, diagonal) = row[..=i].split_at_mut(i);
        result.diagonal[i] = diagonal[0];
        if i == 1 {
            result.beside[1] = v[0];
            for lane in 0..LANES {
                result.beside_squared[1].0[lane] = v[0].0[lane] * v[0].0[lane];
            }
            continue;
        }
        let mut squares = [0.0; LANES];
        for x in v.iter() {
            for (squares, x) in squares.iter_mut().zip(&x.0) {
                *squares += x * x;
            }
        }
        let last = &mut v[i - 1].0;
        // 1/h; of a row of zeros, which needs no reflection, a finite number that is multiplied by zeros.
        let (mut inverse, mut beside) = ([0.0; LANES], [0.0; LANES]);
        for lane in 0..LANES {
            let x = last[lane];
            let g = -squares[lane].sqrt().copysign(x);
            inverse[lane] = 1.0 / (squares[lane] - x * g).max(f64::MIN_POSITIVE);
            last[lane] = x - g;
            beside[lane] = g;
        }
        (result.beside[i].0, result.beside_squared[i].0, result.reflections[i].0) = (beside, squares, inverse);
        p[..i].fill(Lanes::ZERO);
        for j in 0..i {
            let entries = &before[j * (j + 1) / 2..=j * (j + 1) / 2 + j];
            let (of_v, mut sum) = (v[j].0, [0.0; LANES]);
            for k in 0..j {
                for lane in 0..LANES {
                    sum[lane] += entries[k].0[lane] * v[k].0[lane];
                    p[k].0[lane] += entries[k].0[lane] * of_v[lane];
                }
            }
            for lane in 0..LANES {
                p[j].0[lane] += sum[lane] + entries[j].0[lane] * of_v[lane];
            }
        }
        let mut along = [0.0; LANES];
        for (p, v) in p[..i].iter_mut().zip(v.iter()) {
            for lane in 0..LANES {
                p.0[lane] *= inverse[lane];
                along[lane] += p.0[lane] * v.0[lane];
            }
        }
        for (p, v) in p[..i].iter_mut().zip(v.iter()) {
            for lane in 0..LANES {
                p.0[lane] -= 0.5 * along[lane] * inverse[lane] * v.0[lane];
            }
        }
        for j in 0..i {
            let entries = &mut before[j * (j + 1) / 2..=j * (j + 1) / 2 + j];
            let (of_v, of_p) = (v[j].0, p[j].0);
            for (k, entry) in entries.iter_mut().enumerate() {
                for lane in 0..LANES {
                    entry.0[lane] -= of_v[lane] * p[k].0[lane] + of_p[lane] * v[k].0[lane];
                }
            }
        }
    }
    result.diagonal[0] = lower[0];
}

/// Bounds of all eigenvalues by Gershgorin's circles, from above; NaN if an entry is not finite.
#[inline(always)]
fn bound(matrix: &Tridiagonal) -> [f64; LANES] {
    let n = matrix.diagonal.len();
    let (mut most, mut sum, mut before) = ([f64::NEG_INFINITY; LANES], [0.0; LANES], [0.0; LANES]);
    for i in 0..n {
        for lane in 0..LANES {
            let after = if i + 1 < n { matrix.beside_squared[i + 1].0[lane].sqrt() } else { 0.0 };
            let (d, radius) = (matrix.diagonal[i].0[lane], before[lane] + after);
            most[lane] = most[lane].max(d + radius);
            // `max` ignores NaN.
            sum[lane] += d.abs() + radius;
            before[lane] = after;
        }
    }
    for lane in 0..LANES {
        most[lane] = if sum[lane].is_finite() { most[lane] } else { f64::NAN };
    }
    most
}

/// See [`Tridiagonal::lowest`]. All eigenvalues are searched together, because each step of a sequence waits for a division, and because
/// each sequence tells of all of them.
#[pulp::with_simd(search = pulp::Arch::new())]
#[inline(always)]
fn search_simd<S: pulp::Simd>(_: S, matrix: &Tridiagonal, searches: &mut [Search], found: &mut Lowest) {
    let (n, count) = (matrix.diagonal.len(), searches.len());
    let bound = bound(matrix);
    found.bound.0 = bound;
    for one in searches.iter_mut() {
        (one.high.0, one.below_high.0) = (bound, [n as f64; LANES]);
        for (lane, bound) in bound.iter().enumerate() {
            // A matrix of zeros, or one that is not finite.
            one.is_found.0[lane] = if *bound > 0.0 { 0.0 } else { 1.0 };
            one.x.0[lane] = one.between(lane, count);
        }
    }
    // The searches before this one go on.
    let mut open = count;
    for pass in 1..=MOST_PASSES {
        evaluate(matrix, &mut searches[..open]);
        for j in 0..open {
            for i in 0..open {
                let (x, below) = (searches[i].x, searches[i].below);
                searches[j].narrow(&x, &below);
            }
        }
        let take_newton = pass < PASSES_OF_NEWTON || pass.is_multiple_of(2);
        let mut j = 0;
        while j < open {
            let is_done = searches[j].advance(&bound, count, take_newton, &mut found.eigenvalues);
            if is_done {
                open -= 1;
                searches.swap(j, open);
            } else {
                j += 1;
            }
        }
        if open == 0 {
            return;
        }
    }
}

/// Evaluates the sequences and their slopes at each x.
#[inline(always)]
fn evaluate(matrix: &Tridiagonal, searches: &mut [Search]) {
    // Keeps the division finite without changing the sign.
    let inverse = |q: f64| 1.0 / q.abs().max(f64::MIN_POSITIVE).copysign(q);
    for one in searches.iter_mut() {
        for lane in 0..LANES {
            let q = matrix.diagonal[0].0[lane] - one.x.0[lane];
            one.q.0[lane] = q;
            one.below.0[lane] = if q < 0.0 { 1.0 } else { 0.0 };
        }
        (one.slope.0, one.sum.0) = ([-1.0; LANES], [0.0; LANES]);
    }
    for (d, squared) in matrix.diagonal.iter().zip(&matrix.beside_squared).skip(1) {
        for one in searches.iter_mut() {
            for lane in 0..LANES {
                let inverse = inverse(one.q.0[lane]);
                let relative = one.slope.0[lane] * inverse;
                let coupling = squared.0[lane] * inverse;
                let next = d.0[lane] - one.x.0[lane] - coupling;
                one.sum.0[lane] += relative;
                one.slope.0[lane] = coupling * relative - 1.0;
                one.below.0[lane] += if next < 0.0 { 1.0 } else { 0.0 };
                one.q.0[lane] = next;
            }
        }
    }
    for one in searches.iter_mut() {
        for lane in 0..LANES {
            one.sum.0[lane] += one.slope.0[lane] * inverse(one.q.0[lane]);
        }
    }
}
