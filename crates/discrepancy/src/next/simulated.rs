//! Simulated measurements and their normal densities, [`LANES`] measurements at a time.
//!
//! The loops are compiled once for each vector width (`pulp::with_simd`). They multiply and add in separate steps, so that every
//! processor computes the same bits.

use rand::Rng as _;
use rand_distr::StandardNormal;

use super::predict::Prediction;
use structures::stats;

/// Measurements that are simulated at a time.
pub(super) const LANES: usize = 16;

/// One number of each of [`LANES`] measurements.
pub(super) type Lanes = [f64; LANES];

/// Seed of the simulated measurements. It is fixed, so that the ranking depends on nothing but the data.
const SEED: u64 = 1;

/// Added to the variance of every quantity, as a share of it, so that its covariance can be factored.
const RIDGE: f64 = 1e-9;

/// Standard normal numbers for the simulated measurements of each member.
pub(super) struct Normals {
    /// Quantities of one simulated measurement.
    width: usize,
    /// `[members][blocks][width]`
    values: Vec<Vec<Lanes>>,
}

impl Normals {
    /// Numbers for at most `blocks` times [`LANES`] measurements of at most `width` quantities.
    pub(super) fn new(members: usize, blocks: usize, width: usize) -> Self {
        let own = |member: usize| {
            let mut stream = stats::stream(SEED, &format!("next measurement of candidate {member}"));
            let mut values = vec![[0.0; LANES]; blocks * width];
            for draw in 0..blocks * LANES {
                let (block, lane) = (draw / LANES, draw % LANES);
                for place in 0..width {
                    values[block * width + place][lane] = stream.sample(StandardNormal);
                }
            }
            values
        };
        Self { width, values: (0..members).map(own).collect() }
    }

    /// The numbers of one block of measurements of `q` quantities, `[q]`.
    pub(super) fn block(&self, member: usize, block: usize, q: usize) -> &[Lanes] {
        &self.values[member][block * self.width..block * self.width + q]
    }
}

/// The normal distribution of the mean of some rows, with its covariance factored: S = L Lᵀ.
pub(super) struct Factored<'a> {
    /// `[q]`
    mean: &'a [f64],
    /// L, by columns, `[q][q]`.
    lower: Vec<f64>,
    half_log_det: f64,
}

impl<'a> Factored<'a> {
    /// The prediction for `repeats` rows; `None` if its covariance is not positive definite.
    pub(super) fn new(prediction: &'a Prediction, repeats: usize) -> Option<Self> {
        let mut covariance = &prediction.lasting + &prediction.of_row / repeats as f64;
        for place in 0..covariance.nrows() {
            covariance[(place, place)] *= 1.0 + RIDGE;
        }
        let lower = covariance.cholesky()?.l();
        let half_log_det = lower.diagonal().iter().map(|l| l.ln()).sum();
        let lower = lower.as_slice().to_vec();
        Some(Self { mean: prediction.mean.as_slice(), lower, half_log_det })
    }

    /// Writes m + L z to `y`, both `[q]`.
    pub(super) fn simulate(&self, z: &[Lanes], y: &mut [Lanes]) {
        simulate(self.mean, &self.lower, z, y);
    }

    /// ln N(y; m, S) without the factor of 2π, for `y`, `[q]`; `left`, `[q]`, is overwritten.
    pub(super) fn log_densities(&self, y: &[Lanes], left: &mut [Lanes]) -> Lanes {
        squared_distances(self.mean, &self.lower, y, left).map(|distance| -0.5 * distance - self.half_log_det)
    }
}

#[pulp::with_simd(simulate = pulp::Arch::new())]
#[inline(always)]
fn simulate_simd<S: pulp::Simd>(simd: S, mean: &[f64], lower: &[f64], z: &[Lanes], y: &mut [Lanes]) {
    let q = mean.len();
    for (y, mean) in y.iter_mut().zip(mean) {
        *y = [*mean; LANES];
    }
    for (column, z) in z.iter().enumerate() {
        let below = &lower[column * q + column..(column + 1) * q];
        for (y, l) in y[column..].iter_mut().zip(below) {
            let l = simd.splat_f64s(*l);
            let (y, z) = (S::as_mut_simd_f64s(y).0, S::as_simd_f64s(z).0);
            for (y, z) in y.iter_mut().zip(z) {
                *y = simd.add_f64s(*y, simd.mul_f64s(l, *z));
            }
        }
    }
}

/// |L⁻¹ (y − m)|² of each measurement, by forward substitution.
#[pulp::with_simd(squared_distances = pulp::Arch::new())]
#[inline(always)]
fn squared_distances_simd<S: pulp::Simd>(
    simd: S,
    mean: &[f64],
    lower: &[f64],
    y: &[Lanes],
    left: &mut [Lanes],
) -> Lanes {
    let q = mean.len();
    for ((left, y), mean) in left.iter_mut().zip(y).zip(mean) {
        let mean = simd.splat_f64s(*mean);
        for (left, y) in S::as_mut_simd_f64s(left).0.iter_mut().zip(S::as_simd_f64s(y).0) {
            *left = simd.sub_f64s(*y, mean);
        }
    }
    let mut distance = [0.0; LANES];
    for column in 0..q {
        let own = &lower[column * q + column..(column + 1) * q];
        let (here, below) = left[column..].split_at_mut(1);
        let (white, per_unit) = (S::as_mut_simd_f64s(&mut here[0]).0, simd.splat_f64s(1.0 / own[0]));
        for (white, distance) in white.iter_mut().zip(S::as_mut_simd_f64s(&mut distance).0) {
            *white = simd.mul_f64s(*white, per_unit);
            *distance = simd.add_f64s(*distance, simd.mul_f64s(*white, *white));
        }
        for (left, l) in below.iter_mut().zip(&own[1..]) {
            let l = simd.splat_f64s(*l);
            for (left, white) in S::as_mut_simd_f64s(left).0.iter_mut().zip(&*white) {
                *left = simd.sub_f64s(*left, simd.mul_f64s(l, *white));
            }
        }
    }
    distance
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use super::*;

    #[test]
    fn simulated_measurements_have_the_distance_of_their_normal_numbers() {
        let q = 5;
        let lasting = DMatrix::from_fn(q, q, |i, j| 1.0 / (1.0 + (i as f64 - j as f64).abs()));
        let of_row = DMatrix::from_diagonal_element(q, q, 0.3);
        let prediction = Prediction { mean: DVector::from_fn(q, |i, _| i as f64), lasting, of_row };
        let normals = Normals::new(2, 3, q + 2);
        let factored = Factored::new(&prediction, 3).unwrap();
        let (mut y, mut left) = (vec![[0.0; LANES]; q], vec![[0.0; LANES]; q]);
        for block in 0..3 {
            let z = normals.block(1, block, q);
            factored.simulate(z, &mut y);
            let found = factored.log_densities(&y, &mut left);
            let covariance = &prediction.lasting + &prediction.of_row / 3.0;
            let log_det = covariance.determinant().ln();
            for lane in 0..LANES {
                let squares: f64 = z.iter().map(|z| z[lane] * z[lane]).sum();
                // By construction |L⁻¹(y − m)| = |z|; 1e-6 for the ridge of 1e-9 on correlated quantities.
                let expected = -0.5 * (squares + log_det);
                assert!((found[lane] - expected).abs() < 1e-6, "{block} {lane}: {} {expected}", found[lane]);
            }
        }
    }
}
