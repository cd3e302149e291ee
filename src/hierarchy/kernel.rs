//! Loops over the samples of sixteen measurements at a time, one in each lane, or of fewer, each of which has several lanes;
//! compiled once for each width of vectors (`pulp::with_simd`).
//!
//! Single precision, about the centre of each measurement's own samples: what is lost is lost of differences between samples of
//! one posterior, however far away the population lies. Lanes are summed one by one, so that the bits are the same on every
//! processor.

use std::ops::Range;

use crate::stats::exp_f32;

/// Measurements side by side: the numbers of the widest vector.
pub(super) const LANES: usize = 16;

/// A number of each of the measurements side by side; on a line of the cache, which half of all loads would straddle else.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(C, align(64))]
pub(super) struct Lanes(pub [f32; LANES]);

impl Lanes {
    pub const ZERO: Self = Self([0.0; LANES]);

    /// The sum of some.
    pub fn of(&self, lanes: impl Iterator<Item = usize>) -> f64 {
        lanes.map(|lane| f64::from(self.0[lane])).sum()
    }
}

/// Weights of the samples of some measurements under a normal population, the greatest of each measurement 1.
#[derive(Clone, Copy)]
pub(super) struct Weighed {
    /// Logarithm of what the weights were divided by, the same in all lanes of a measurement.
    pub largest: Lanes,
    /// Sum of the weights of each lane.
    pub sum: Lanes,
}

/// w_s, one entry a sample.
///
/// ```text
///  ln w_s = offset_s + Σ_k x_sk (x_sk square_k + linear_k)
/// ```
///
/// `offsets`: logarithms of what the samples weigh without the population; `deviations`: x of each parameter; `squares`: −1/2σ²
/// of each; `linears`: (μ − c)/σ² of each, c the centre. A measurement has every lane `width` further.
#[pulp::with_simd(weigh = pulp::Arch::new())]
#[inline(always)]
pub(super) fn weigh_simd<S: pulp::Simd>(
    simd: S,
    weights: &mut [Lanes],
    offsets: &[Lanes],
    deviations: &[&[Lanes]],
    squares: &[f32],
    linears: &[Lanes],
    width: usize,
) -> Weighed {
    let mut largest = Lanes::ZERO;
    // Spelt out: left to itself the compiler makes vectors of samples instead, and gathers and scatters them.
    for first in (0..LANES).step_by(S::F32_LANES) {
        let part = first..first + S::F32_LANES;
        let of = |lanes: &Lanes| S::as_simd_f32s(&lanes.0[part.clone()]).0[0];
        for (k, deviations) in deviations.iter().enumerate() {
            let (square, linear) = (simd.splat_f32s(squares[k]), of(&linears[k]));
            let added = |x: &Lanes, to: S::f32s| {
                let x = of(x);
                simd.mul_add_f32s(x, simd.mul_add_f32s(x, square, linear), to)
            };
            for ((weights, offset), x) in weights.iter_mut().zip(offsets).zip(*deviations) {
                let weight = &mut S::as_mut_simd_f32s(&mut weights.0[part.clone()]).0[0];
                *weight = added(x, if k == 0 { of(offset) } else { *weight });
            }
        }
        let most = in_fours(simd, weights, &part, f32::NEG_INFINITY, |a, b| simd.max_f32s(a, b));
        S::as_mut_simd_f32s(&mut largest.0[part]).0[0] = most;
    }
    let mut most = [f32::NEG_INFINITY; LANES];
    for (lane, own) in largest.0.iter().enumerate() {
        most[lane % width] = most[lane % width].max(*own);
    }
    largest.0 = std::array::from_fn(|lane| most[lane % width]);
    // Four sums that do not wait for each other.
    let mut sums = [Lanes::ZERO; 4];
    for four in weights.chunks_mut(4) {
        for (weights, sum) in four.iter_mut().zip(&mut sums) {
            for ((weight, largest), sum) in weights.0.iter_mut().zip(&largest.0).zip(&mut sum.0) {
                *weight = exp_f32(*weight - largest);
                *sum += *weight;
            }
        }
    }
    let sum = std::array::from_fn(|lane| (sums[0].0[lane] + sums[1].0[lane]) + (sums[2].0[lane] + sums[3].0[lane]));
    Weighed { largest, sum: Lanes(sum) }
}

/// The lanes `part` of all entries combined, in four rows that do not wait for each other.
#[inline(always)]
fn in_fours<S: pulp::Simd>(
    simd: S,
    all: &[Lanes],
    part: &Range<usize>,
    neutral: f32,
    combine: impl Fn(S::f32s, S::f32s) -> S::f32s,
) -> S::f32s {
    let of = |lanes: &Lanes| S::as_simd_f32s(&lanes.0[part.clone()]).0[0];
    let mut rows = [simd.splat_f32s(neutral); 4];
    let (fours, rest) = all.as_chunks::<4>();
    for four in fours {
        for (row, lanes) in rows.iter_mut().zip(four) {
            *row = combine(*row, of(lanes));
        }
    }
    for lanes in rest {
        rows[0] = combine(rows[0], of(lanes));
    }
    combine(combine(rows[0], rows[1]), combine(rows[2], rows[3]))
}

/// How many samples of each lane come before as much weight as `targets`.
#[pulp::with_simd(count_before = pulp::Arch::new())]
#[inline(always)]
pub(super) fn count_before_simd<S: pulp::Simd>(_: S, weights: &[Lanes], targets: &Lanes) -> [u32; LANES] {
    // Counting what ends before the target leaves the processor nothing to guess.
    let (mut passed, mut places) = ([0.0_f32; LANES], [0_u32; LANES]);
    for weights in weights {
        for (((weight, passed), place), target) in weights.0.iter().zip(&mut passed).zip(&mut places).zip(&targets.0) {
            *passed += weight;
            *place += u32::from(*passed <= *target);
        }
    }
    places
}

/// Σ w x and Σ w x² of each lane.
#[pulp::with_simd(moments = pulp::Arch::new())]
#[inline(always)]
pub(super) fn moments_simd<S: pulp::Simd>(_: S, weights: &[Lanes], x: &[Lanes]) -> (Lanes, Lanes) {
    let (mut first, mut second) = (Lanes::ZERO, Lanes::ZERO);
    for (weights, x) in weights.iter().zip(x) {
        for (((weight, x), first), second) in weights.0.iter().zip(&x.0).zip(&mut first.0).zip(&mut second.0) {
            let weighed = weight * x;
            *first += weighed;
            *second = weighed.mul_add(*x, *second);
        }
    }
    (first, second)
}

/// w ← exp(w − max w); returns their sum.
#[pulp::with_simd(exponentials = pulp::Arch::new())]
#[inline(always)]
pub(super) fn exponentials_simd<S: pulp::Simd>(_: S, weights: &mut [f64]) -> f64 {
    let largest = weights.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    for weight in weights.iter_mut() {
        *weight = f64::from(exp_f32((*weight - largest) as f32));
    }
    weights.iter().sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_lane_is_a_measurement_of_its_own() {
        for count in [1_usize, 15, 64, 100] {
            // The population lies up to twenty of its own standard deviations away from the centre, another way in each lane.
            let std = 0.4_f64;
            let off = |lane: usize| 8.0 * (lane as f64 * 0.9).cos();
            let x = |sample: usize, lane: usize| (sample as f64 * 0.7 + lane as f64).sin();
            let offset = |sample: usize, lane: usize| (sample as f64 * 1.3 - lane as f64).cos();
            let lanes = |f: &dyn Fn(usize) -> f64| -> Lanes { Lanes(std::array::from_fn(|lane| f(lane) as f32)) };
            let deviations: Vec<Lanes> = (0..count).map(|s| lanes(&|lane| x(s, lane))).collect();
            let offsets: Vec<Lanes> = (0..count).map(|s| lanes(&|lane| offset(s, lane))).collect();
            let mut weights = vec![Lanes::ZERO; count];
            let square = (-0.5 / (std * std)) as f32;
            let linear = lanes(&|lane| off(lane) / (std * std));
            let found = weigh(&mut weights, &offsets, &[&deviations], &[square], &[linear], LANES);
            let moments = moments(&weights, &deviations);
            let shares = 20_000_u32;
            let mut counts = vec![0.0; count * LANES];
            for i in 0..shares {
                let share = ((f64::from(i) + 0.5) / f64::from(shares)) as f32;
                let targets = Lanes(found.sum.0.map(|sum| share * sum));
                for (lane, place) in count_before(&weights, &targets).iter().enumerate() {
                    counts[(*place as usize).min(count - 1) * LANES + lane] += 1.0;
                }
            }
            for lane in 0..LANES {
                let exponent = |s: usize| offset(s, lane) - 0.5 * ((x(s, lane) - off(lane)) / std).powi(2);
                let largest = (0..count).map(exponent).fold(f64::NEG_INFINITY, f64::max);
                let expected: Vec<f64> = (0..count).map(|s| (exponent(s) - largest).exp()).collect();
                // Exponents of some two hundred in single precision: 200 · 6e-8 · some operations.
                for (sample, expected) in expected.iter().enumerate() {
                    let found = f64::from(weights[sample].0[lane]);
                    assert!((found - expected).abs() < 1e-4, "{count}: {found}, expected {expected}");
                }
                let sum: f64 = expected.iter().sum();
                assert!((f64::from(found.sum.0[lane]) / sum - 1.0).abs() < 1e-4, "{count}");
                let log_sum = f64::from(found.largest.0[lane]) - 0.5 * (off(lane) / std).powi(2) + sum.ln();
                assert!((log_sum - largest - sum.ln()).abs() < 2e-4, "{count}");
                let direct = |power: i32| -> f64 { (0..count).map(|s| expected[s] * x(s, lane).powi(power)).sum() };
                assert!((f64::from(moments.0 .0[lane]) - direct(1)).abs() < 1e-4 * sum, "{count}");
                assert!((f64::from(moments.1 .0[lane]) - direct(2)).abs() < 1e-4 * sum, "{count}");
                // Through all shares each sample comes as often as it weighs.
                for sample in 0..count {
                    let expected =
                        f64::from(weights[sample].0[lane]) / f64::from(found.sum.0[lane]) * f64::from(shares);
                    assert!((counts[sample * LANES + lane] - expected).abs() < 3.0, "{count}: {expected}");
                }
            }
        }
    }

    #[test]
    fn exponentials_are_relative_to_the_greatest() {
        let logarithms: Vec<f64> = (0..37).map(|i| f64::from(i).sin() * 5.0 - 400.0).collect();
        let largest = logarithms.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let mut weights = logarithms.clone();
        let sum = exponentials(&mut weights);
        for (weight, logarithm) in weights.iter().zip(&logarithms) {
            assert!((weight - (logarithm - largest).exp()).abs() < 1e-5, "{weight} of {logarithm}");
        }
        assert!((sum - weights.iter().sum::<f64>()).abs() < 1e-12 * sum);
    }
}
