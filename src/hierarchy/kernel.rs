//! Loops over the samples of a measurement, compiled once for each width of vectors (`pulp::with_simd`).
//!
//! Single precision, about the centre of the measurement's own samples: what is lost is lost of differences between samples of
//! one posterior, however far away the population lies. Sums and maxima run in lanes, since one after the other each addition
//! would wait for the one before; sample s is in lane s mod [`LANES`] on every processor, so that the bits are the same.

use std::ops::Range;

use crate::stats::exp_f32;

/// Numbers of the widest vector.
const LANES: usize = 16;

/// Weights of the samples of a measurement under a normal population, the greatest 1.
pub(super) struct Weighed {
    /// Logarithm of what the weights were divided by.
    pub largest: f32,
    /// Sum of all weights.
    pub sum: f64,
    /// Sum of the weights of each lane.
    of_lanes: [f32; LANES],
}

impl Weighed {
    /// A sample by its weight; `share`, from 0 to below 1, is how much of all weight comes before it, lane after lane.
    pub fn choose(&self, weights: &[f32], share: f64) -> usize {
        // Counting what ends before the target leaves the processor nothing to guess.
        let target = (share * self.sum) as f32;
        let (mut lane, mut before, mut passed) = (0, 0.0, 0.0);
        for sum in &self.of_lanes[..LANES.min(weights.len()) - 1] {
            passed += sum;
            let ends_before = passed <= target;
            lane += usize::from(ends_before);
            before = if ends_before { passed } else { before };
        }
        let (mut place, mut passed) = (lane, before);
        for next in (lane + LANES..weights.len()).step_by(LANES) {
            passed += weights[next - LANES];
            place += if passed <= target { LANES } else { 0 };
        }
        place
    }
}

/// Lane by lane, then halves onto halves: the same order for every width of vectors.
#[inline(always)]
fn folded(mut lanes: [f32; LANES], combine: impl Fn(f32, f32) -> f32) -> f32 {
    let mut half = LANES / 2;
    while half > 0 {
        for lane in 0..half {
            lanes[lane] = combine(lanes[lane], lanes[lane + half]);
        }
        half /= 2;
    }
    lanes[0]
}

/// w_s of the samples `rows`, those of a measurement, from the logarithms of what they weigh without the population (`weights`).
///
/// ```text
///  ln w_s = offset_s − Σ_k ½((x_sk − μ_k)/σ_k)² + ½((c_k − μ_k)/σ_k)²
/// ```
///
/// `deviations`: x − c of each parameter; `centres`: c of each; `mean`, `std`: μ and σ of each.
#[pulp::with_simd(weigh = pulp::Arch::new())]
#[inline(always)]
pub(super) fn weigh_simd<S: pulp::Simd>(
    _: S,
    weights: &mut [f32],
    deviations: &[Vec<f32>],
    rows: Range<usize>,
    centres: &[f64],
    mean: &[f64],
    std: &[f64],
) -> Weighed {
    for (((deviations, centre), mean), std) in deviations.iter().zip(centres).zip(mean).zip(std) {
        let precision = 1.0 / (std * std);
        let (square, linear) = ((-0.5 * precision) as f32, ((mean - centre) * precision) as f32);
        for (weight, x) in weights.iter_mut().zip(&deviations[rows.clone()]) {
            *weight = x.mul_add(x.mul_add(square, linear), *weight);
        }
    }
    let larger = |a: f32, b: f32| if b > a { b } else { a };
    let mut lanes = [f32::NEG_INFINITY; LANES];
    let (blocks, rest) = weights.as_chunks::<LANES>();
    for block in blocks {
        for (lane, weight) in lanes.iter_mut().zip(block) {
            *lane = larger(*lane, *weight);
        }
    }
    for (lane, weight) in lanes.iter_mut().zip(rest) {
        *lane = larger(*lane, *weight);
    }
    let largest = folded(lanes, larger);
    let mut of_lanes = [0.0; LANES];
    let (blocks, rest) = weights.as_chunks_mut::<LANES>();
    for block in blocks {
        for (weight, sum) in block.iter_mut().zip(&mut of_lanes) {
            *weight = exp_f32(*weight - largest);
            *sum += *weight;
        }
    }
    for (weight, sum) in rest.iter_mut().zip(&mut of_lanes) {
        *weight = exp_f32(*weight - largest);
        *sum += *weight;
    }
    Weighed { largest, sum: f64::from(folded(of_lanes, |a, b| a + b)), of_lanes }
}

/// Σ w x and Σ w x²
#[pulp::with_simd(moments = pulp::Arch::new())]
#[inline(always)]
pub(super) fn moments_simd<S: pulp::Simd>(_: S, weights: &[f32], x: &[f32]) -> (f64, f64) {
    let (mut first, mut second) = ([0.0_f32; LANES], [0.0_f32; LANES]);
    let ((weights, more_weights), (x, more)) = (weights.as_chunks::<LANES>(), x.as_chunks::<LANES>());
    for (weights, x) in weights.iter().zip(x) {
        for lane in 0..LANES {
            let weighed = weights[lane] * x[lane];
            first[lane] += weighed;
            second[lane] += weighed * x[lane];
        }
    }
    for (lane, (weight, x)) in more_weights.iter().zip(more).enumerate() {
        first[lane] += weight * x;
        second[lane] += weight * x * x;
    }
    let sum = |lanes| f64::from(folded(lanes, |a, b| a + b));
    (sum(first), sum(second))
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
    fn lanes_and_what_is_left_over_count_alike() {
        for count in [1, 15, 16, 17, 64, 100] {
            let x: Vec<f64> = (0..count).map(|i| (f64::from(i) * 0.7).sin()).collect();
            let offsets: Vec<f64> = (0..count).map(|i| (f64::from(i) * 1.3).cos()).collect();
            // The population lies twenty of its own standard deviations away from the centre.
            let (mean, std) = (8.0, 0.4_f64);
            let exponent = |place: usize| offsets[place] - 0.5 * ((x[place] - mean) / std).powi(2);
            let exponents: Vec<f64> = (0..x.len()).map(exponent).collect();
            let largest = exponents.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let expected: Vec<f64> = exponents.iter().map(|e| (e - largest).exp()).collect();

            let deviations: Vec<f32> = x.iter().map(|x| *x as f32).collect();
            let mut weights: Vec<f32> = offsets.iter().map(|o| *o as f32).collect();
            let columns = std::slice::from_ref(&deviations);
            let found = weigh(&mut weights, columns, 0..x.len(), &[0.0], &[mean], &[std]);
            // Exponents of some fifty in single precision: 50 · 6e-8 · some operations.
            for (found, expected) in weights.iter().zip(&expected) {
                assert!((f64::from(*found) - expected).abs() < 3e-5, "{count}: {found}, expected {expected}");
            }
            let sum: f64 = expected.iter().sum();
            assert!((found.sum / sum - 1.0).abs() < 3e-5, "{count}");
            let log_sum = f64::from(found.largest) - 0.5 * (mean / std).powi(2) + found.sum.ln();
            assert!((log_sum - largest - sum.ln()).abs() < 1e-4, "{count}");
            let direct =
                expected.iter().zip(&x).fold((0.0, 0.0), |(first, second), (w, x)| (first + w * x, second + w * x * x));
            let moments = moments(&weights, &deviations);
            assert!((moments.0 - direct.0).abs() + (moments.1 - direct.1).abs() < 1e-4 * sum, "{count}: {moments:?}");

            // Through all shares each sample comes as often as it weighs.
            let shares = 200_000;
            let mut counts = vec![0.0; x.len()];
            (0..shares).for_each(|i| counts[found.choose(&weights, (f64::from(i) + 0.5) / f64::from(shares))] += 1.0);
            for (count, weight) in counts.iter().zip(&weights) {
                let expected = f64::from(*weight) / found.sum * f64::from(shares);
                assert!((count - expected).abs() < 2.0, "{count}, expected {expected}");
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
