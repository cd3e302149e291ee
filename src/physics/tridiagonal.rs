//! Eigenvalues of eight symmetric matrices at once, one in each SIMD lane: reduction to tridiagonal form, then bisection for the lowest.

use super::lanes::{Lanes, LANES};

/// Most bisections of an interval; each halves it, and about 53 reach the rounding errors of the largest eigenvalue.
const MOST_BISECTIONS: usize = 80;

/// Symmetric tridiagonal matrices, one in each lane.
pub(super) struct Tridiagonal {
    /// Diagonal, `[n]`.
    diagonal: Vec<Lanes>,
    /// Squares of the entries beside the diagonal, the first of them 0, `[n]`.
    beside_squared: Vec<Lanes>,
}

/// The lowest eigenvalues of one matrix, and a bound of all.
pub(super) struct Lowest {
    /// Ascending in each lane, `[count]`.
    pub(super) eigenvalues: Vec<Lanes>,
    /// No eigenvalue is larger, and the largest is at least half as large if none is negative; not finite if an entry of the matrix is not.
    pub(super) bound: Lanes,
}

impl Tridiagonal {
    /// Reduces the matrices whose lower triangle is `lower`, row by row, `[n(n+1)/2]`, by Householder reflections, from the last row to
    /// the first. The entries of `lower` are overwritten.
    ///
    /// ```text
    ///  v = x − g e_l,   g = −sgn(x_l)|x|,   h = vᵀv/2       x: entries of row i before the diagonal, the last of them x_l
    ///  p = A v/h,   q = p − (vᵀp/2h) v,   A ← A − v qᵀ − q vᵀ
    /// ```
    ///
    /// Source: Golub & Van Loan (2013), Matrix Computations, §8.3.
    pub(super) fn of(lower: &mut [Lanes], n: usize) -> Self {
        let mut result = Self { diagonal: vec![Lanes::ZERO; n], beside_squared: vec![Lanes::ZERO; n] };
        let mut work = vec![Lanes::ZERO; n];
        reduce(lower, &mut work, &mut result);
        result
    }

    /// The lowest `count` eigenvalues by bisection with Sturm sequences: the number of negative q_i is that of the eigenvalues below x.
    ///
    /// ```text
    ///  q_1 = d_1 − x,   q_i = d_i − x − e_i²/q_{i−1}
    /// ```
    ///
    /// Source: Golub & Van Loan (2013), §8.4.
    pub(super) fn lowest(&self, count: usize) -> Lowest {
        let mut found = Lowest { eigenvalues: vec![Lanes::ZERO; count], bound: Lanes::ZERO };
        let mut work = vec![Lanes::ZERO; 4 * count];
        bisect(self, &mut work, &mut found);
        found
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
        let mut inverse = [0.0; LANES];
        for ((inverse, last), squares) in inverse.iter_mut().zip(last).zip(&squares) {
            let x = *last;
            let g = -squares.sqrt().copysign(x);
            *inverse = 1.0 / (squares - x * g).max(f64::MIN_POSITIVE);
            *last = x - g;
        }
        result.beside_squared[i].0 = squares;
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

/// See [`Tridiagonal::lowest`]. All intervals are halved together, because each step of a sequence waits for a division.
#[pulp::with_simd(bisect = pulp::Arch::new())]
#[inline(always)]
fn bisect_simd<S: pulp::Simd>(_: S, matrix: &Tridiagonal, work: &mut [Lanes], found: &mut Lowest) {
    let (n, count) = (matrix.diagonal.len(), found.eigenvalues.len());
    // Gershgorin's circles.
    let (mut least, mut most, mut sum) = ([f64::INFINITY; LANES], [f64::NEG_INFINITY; LANES], [0.0; LANES]);
    let mut before = [0.0; LANES];
    for i in 0..n {
        for lane in 0..LANES {
            let after = if i + 1 < n { matrix.beside_squared[i + 1].0[lane].sqrt() } else { 0.0 };
            let (d, radius) = (matrix.diagonal[i].0[lane], before[lane] + after);
            least[lane] = least[lane].min(d - radius);
            most[lane] = most[lane].max(d + radius);
            // `min` and `max` ignore NaN.
            sum[lane] += d.abs() + radius;
            before[lane] = after;
        }
    }
    let mut bound = [0.0; LANES];
    for lane in 0..LANES {
        bound[lane] = if sum[lane].is_finite() { most[lane] } else { f64::NAN };
    }
    found.bound.0 = bound;
    let (low, rest) = work.split_at_mut(count);
    let (high, rest) = rest.split_at_mut(count);
    let (q, below) = rest.split_at_mut(count);
    for j in 0..count {
        (low[j].0, high[j].0) = (least, most);
    }
    for _ in 0..MOST_BISECTIONS {
        let mut open = false;
        for j in 0..count {
            for lane in 0..LANES {
                let scale = most[lane].abs().max(least[lane].abs());
                open |= high[j].0[lane] - low[j].0[lane] > f64::EPSILON * scale;
                found.eigenvalues[j].0[lane] = 0.5 * (low[j].0[lane] + high[j].0[lane]);
                q[j].0[lane] = matrix.diagonal[0].0[lane] - found.eigenvalues[j].0[lane];
                below[j].0[lane] = if q[j].0[lane] < 0.0 { 1.0 } else { 0.0 };
            }
        }
        if !open {
            return;
        }
        for i in 1..n {
            let (d, squared) = (matrix.diagonal[i].0, matrix.beside_squared[i].0);
            for j in 0..count {
                for lane in 0..LANES {
                    let before = q[j].0[lane];
                    // Keeps the division finite without changing the sign.
                    let before = before.abs().max(f64::MIN_POSITIVE).copysign(before);
                    let next = d[lane] - found.eigenvalues[j].0[lane] - squared[lane] / before;
                    below[j].0[lane] += if next < 0.0 { 1.0 } else { 0.0 };
                    q[j].0[lane] = next;
                }
            }
        }
        for j in 0..count {
            for lane in 0..LANES {
                let middle = found.eigenvalues[j].0[lane];
                let is_above = below[j].0[lane] > j as f64;
                high[j].0[lane] = if is_above { middle } else { high[j].0[lane] };
                low[j].0[lane] = if is_above { low[j].0[lane] } else { middle };
            }
        }
    }
}
