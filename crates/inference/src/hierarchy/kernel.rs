//! Loops over the samples of up to sixteen measurements at a time, with one or several lanes per measurement; compiled once
//! for each vector width (`pulp::with_simd`).
//!
//! Samples are stored in single precision relative to the mean of their measurement, so that the rounding error is relative
//! to the width of one posterior, however far away the population lies. Lanes are summed one by one, so that the bits are
//! the same on every processor.

use std::f64::consts::LOG2_E;
use std::ops::Range;

use structures::simd;

/// Number of lanes: that of the widest vector.
pub(super) const LANES: usize = 16;

/// One number per lane, aligned to a cache line: half of all loads would straddle two lines otherwise.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(C, align(64))]
pub(super) struct Lanes(pub [f32; LANES]);

impl Lanes {
    pub const ZERO: Self = Self([0.0; LANES]);

    /// The sum of some lanes.
    pub fn of(&self, lanes: impl Iterator<Item = usize>) -> f64 {
        lanes.map(|lane| f64::from(self.0[lane])).sum()
    }
}

/// Divisor and sum of the weights of a block under a normal population.
#[derive(Clone, Copy)]
pub(super) struct Weighed {
    /// Logarithm to base 2 of the divisor of the weights, the same in all lanes of a measurement: the largest weight, or
    /// the previous divisor.
    pub divisor: Lanes,
    /// Sum of the weights of each lane.
    pub sum: Lanes,
}

/// Parameters whose terms are added in one pass.
const PER_PASS: usize = 4;

/// Sums of weights for which the previous divisor is kept: far from overflow and underflow in single precision.
const NEAR_ENOUGH: std::ops::RangeInclusive<f32> = 1e-12..=1e12;

/// Terms of the logarithms of the weights.
///
/// ```text
///  log₂ w_s = to_s + Σ_k x_sk (x_sk square_k + linear_k + Σ_{l<k} x_sl cross_kl)
/// ```
pub(super) struct Terms<'a> {
    /// Logarithms to base 2 that the terms are added to, one entry per place.
    pub to: &'a [Lanes],
    /// x of each parameter, one entry per place.
    pub deviations: &'a [Vec<Lanes>],
    /// Places of the block among those of all blocks.
    pub places: Range<usize>,
    /// −1/2σ² · log₂ e of each parameter; with correlations, −½ P_kk · log₂ e of the precision matrix P.
    pub squares: &'a [f32],
    /// (μ − c)/σ² · log₂ e of each parameter, with the centre c; with correlations, P (μ − c) · log₂ e.
    pub linears: &'a [Lanes],
    /// −P_kl · log₂ e of each parameter k and each l < k, row by row; empty without correlations.
    pub crosses: &'a [f32],
}

/// Computes `weights` and their logarithms, one entry per place. The lanes of a measurement are `width` apart. The weights
/// are divided by `divisor`, or by the largest weight where `divisor` is too far from it.
#[pulp::with_simd(weigh = pulp::Arch::new())]
#[inline(always)]
pub(super) fn weigh_simd<S: pulp::Simd>(
    simd: S,
    weights: &mut [Lanes],
    logarithms: &mut [Lanes],
    terms: &Terms<'_>,
    width: usize,
    divisor: &Lanes,
) -> Weighed {
    if !terms.crosses.is_empty() {
        match terms.deviations {
            [a, b] => add_quadratic(simd, logarithms, terms, [a, b]),
            [a, b, c] => add_quadratic(simd, logarithms, terms, [a, b, c]),
            [a, b, c, d] => add_quadratic(simd, logarithms, terms, [a, b, c, d]),
            [a, b, c, d, e] => add_quadratic(simd, logarithms, terms, [a, b, c, d, e]),
            [a, b, c, d, e, f] => add_quadratic(simd, logarithms, terms, [a, b, c, d, e, f]),
            [a, b, c, d, e, f, g] => add_quadratic(simd, logarithms, terms, [a, b, c, d, e, f, g]),
            [a, b, c, d, e, f, g, h] => add_quadratic(simd, logarithms, terms, [a, b, c, d, e, f, g, h]),
            _ => unreachable!("correlations of two to eight parameters"),
        }
    }
    let apart = if terms.crosses.is_empty() { terms.deviations } else { &[] };
    for (k, some) in apart.chunks(PER_PASS).enumerate() {
        let (squares, linears) = (&terms.squares[PER_PASS * k..], &terms.linears[PER_PASS * k..]);
        let (to, places) = ((k == 0).then_some(terms.to), &terms.places);
        match some {
            [a] => add_terms(simd, logarithms, to, [a], places, squares, linears),
            [a, b] => add_terms(simd, logarithms, to, [a, b], places, squares, linears),
            [a, b, c] => add_terms(simd, logarithms, to, [a, b, c], places, squares, linears),
            [a, b, c, d] => add_terms(simd, logarithms, to, [a, b, c, d], places, squares, linears),
            _ => unreachable!("chunks are no longer"),
        }
    }
    let sum = powers(weights, logarithms, divisor);
    let mut sums = [0.0; LANES];
    sum.0.iter().enumerate().for_each(|(lane, sum)| sums[lane % width] += sum);
    if sums[..width].iter().all(|sum| NEAR_ENOUGH.contains(sum)) {
        return Weighed { divisor: *divisor, sum };
    }
    let mut largest = Lanes::ZERO;
    for first in (0..LANES).step_by(S::F32_LANES) {
        let part = first..first + S::F32_LANES;
        let most = in_fours(simd, logarithms, &part, f32::NEG_INFINITY, |a, b| simd.max_f32s(a, b));
        S::as_mut_simd_f32s(&mut largest.0[part]).0[0] = most;
    }
    let mut most = [f32::NEG_INFINITY; LANES];
    for (lane, own) in largest.0.iter().enumerate() {
        most[lane % width] = most[lane % width].max(*own);
    }
    let divisor = Lanes(std::array::from_fn(|lane| most[lane % width]));
    Weighed { divisor, sum: powers(weights, logarithms, &divisor) }
}

/// Computes the weights from their logarithms and the divisor. Returns the sum of each lane.
#[inline(always)]
fn powers(weights: &mut [Lanes], logarithms: &[Lanes], divisor: &Lanes) -> Lanes {
    let logarithms = &logarithms[..weights.len()];
    // Four independent sums, for instruction-level parallelism.
    let mut sums = [Lanes::ZERO; 4];
    let add_power = |weights: &mut Lanes, logarithms: &Lanes, sum: &mut Lanes| {
        let all = weights.0.iter_mut().zip(&logarithms.0).zip(divisor.0.iter().zip(&mut sum.0));
        for ((weight, logarithm), (divisor, sum)) in all {
            *weight = simd::exp2(*logarithm - divisor);
            *sum += *weight;
        }
    };
    let (fours, rest) = weights.as_chunks_mut::<4>();
    let (logarithms_of_fours, logarithms_of_rest) = logarithms.as_chunks::<4>();
    for ([a, b, c, d], [log_a, log_b, log_c, log_d]) in fours.iter_mut().zip(logarithms_of_fours) {
        let [of_a, of_b, of_c, of_d] = &mut sums;
        add_power(a, log_a, of_a);
        add_power(b, log_b, of_b);
        add_power(c, log_c, of_c);
        add_power(d, log_d, of_d);
    }
    for (weights, logarithms) in rest.iter_mut().zip(logarithms_of_rest) {
        add_power(weights, logarithms, &mut sums[0]);
    }
    Lanes(std::array::from_fn(|lane| (sums[0].0[lane] + sums[1].0[lane]) + (sums[2].0[lane] + sums[3].0[lane])))
}

/// Adds the terms of K parameters to the logarithms `to`, or without these to the previous values of `logarithms`.
///
/// Vector instructions are written out: the compiler would vectorise over samples instead, with gather and scatter.
#[inline(always)]
fn add_terms<S: pulp::Simd, const K: usize>(
    simd: S,
    logarithms: &mut [Lanes],
    to: Option<&[Lanes]>,
    deviations: [&Vec<Lanes>; K],
    places: &Range<usize>,
    squares: &[f32],
    linears: &[Lanes],
) {
    // Equal lengths, so that bounds checks in the loop are removed.
    let deviations = deviations.map(|x| &x[places.clone()][..logarithms.len()]);
    let to = to.map(|to| &to[..logarithms.len()]);
    for first in (0..LANES).step_by(S::F32_LANES) {
        let part = first..first + S::F32_LANES;
        let of = |lanes: &Lanes| S::as_simd_f32s(&lanes.0[part.clone()]).0[0];
        let terms: [(S::f32s, S::f32s); K] = std::array::from_fn(|k| (simd.splat_f32s(squares[k]), of(&linears[k])));
        for (sample, logarithms) in logarithms.iter_mut().enumerate() {
            let own = &mut S::as_mut_simd_f32s(&mut logarithms.0[part.clone()]).0[0];
            let mut sum = to.map_or(*own, |to| of(&to[sample]));
            for (x, (square, linear)) in deviations.iter().zip(terms) {
                let x = of(&x[sample]);
                sum = simd.mul_add_f32s(x, simd.mul_add_f32s(x, square, linear), sum);
            }
            *own = sum;
        }
    }
}

/// Computes the logarithms with the terms of K correlated parameters.
#[inline(always)]
fn add_quadratic<S: pulp::Simd, const K: usize>(
    simd: S,
    logarithms: &mut [Lanes],
    terms: &Terms<'_>,
    deviations: [&Vec<Lanes>; K],
) {
    let count = logarithms.len();
    let (deviations, to) = (deviations.map(|x| &x[terms.places.clone()][..count]), &terms.to[..count]);
    let squares: [S::f32s; K] = std::array::from_fn(|k| simd.splat_f32s(terms.squares[k]));
    let cross = |k: usize, l: usize| simd.splat_f32s(if l < k { terms.crosses[k * (k - 1) / 2 + l] } else { 0.0 });
    let crosses: [[S::f32s; K]; K] = std::array::from_fn(|k| std::array::from_fn(|l| cross(k, l)));
    for first in (0..LANES).step_by(S::F32_LANES) {
        let part = first..first + S::F32_LANES;
        let of = |lanes: &Lanes| S::as_simd_f32s(&lanes.0[part.clone()]).0[0];
        let linears: [S::f32s; K] = std::array::from_fn(|k| of(&terms.linears[k]));
        for (sample, logarithms) in logarithms.iter_mut().enumerate() {
            let x: [S::f32s; K] = std::array::from_fn(|k| of(&deviations[k][sample]));
            let mut sum = of(&to[sample]);
            for k in 0..K {
                let mut factor = simd.mul_add_f32s(x[k], squares[k], linears[k]);
                for l in 0..k {
                    factor = simd.mul_add_f32s(x[l], crosses[k][l], factor);
                }
                sum = simd.mul_add_f32s(x[k], factor, sum);
            }
            S::as_mut_simd_f32s(&mut logarithms.0[part.clone()]).0[0] = sum;
        }
    }
}

/// Combines the lanes `part` of all entries, in four independent rows for instruction-level parallelism.
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

/// Writes (μ − c)/σ² · log₂ e of each lane to `linear`; returns ((μ − c)/σ)² of each lane.
///
/// `centres`: c of each lane; `mean`: μ; `precision`: 1/σ².
#[pulp::with_simd(off_centre = pulp::Arch::new())]
#[inline(always)]
pub(super) fn off_centre_simd<S: pulp::Simd>(
    _: S,
    linear: &mut Lanes,
    centres: &[f64; LANES],
    mean: f64,
    precision: f64,
) -> [f64; LANES] {
    let mut squared = [0.0; LANES];
    for ((linear, centre), squared) in linear.0.iter_mut().zip(centres).zip(&mut squared) {
        let off = mean - centre;
        *squared = off * off * precision;
        *linear = (LOG2_E * off * precision) as f32;
    }
    squared
}

/// Number of samples of each lane whose cumulative weight is at most `targets`.
#[pulp::with_simd(count_before = pulp::Arch::new())]
#[inline(always)]
pub(super) fn count_before_simd<S: pulp::Simd>(simd: S, weights: &[Lanes], targets: &Lanes) -> [f32; LANES] {
    // Counting avoids unpredictable branches.
    let mut counts = Lanes::ZERO;
    let (one, none) = (simd.splat_f32s(1.0), simd.splat_f32s(0.0));
    for first in (0..LANES).step_by(S::F32_LANES) {
        let part = first..first + S::F32_LANES;
        let of = |lanes: &Lanes| S::as_simd_f32s(&lanes.0[part.clone()]).0[0];
        let (target, mut passed, mut count) = (of(targets), none, none);
        for weights in weights {
            passed = simd.add_f32s(passed, of(weights));
            count = simd.add_f32s(count, simd.select_f32s(simd.less_than_or_equal_f32s(passed, target), one, none));
        }
        S::as_mut_simd_f32s(&mut counts.0[part.clone()]).0[0] = count;
    }
    counts.0
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

/// Σ w x y of each lane.
#[pulp::with_simd(cross_moment = pulp::Arch::new())]
#[inline(always)]
pub(super) fn cross_moment_simd<S: pulp::Simd>(_: S, weights: &[Lanes], x: &[Lanes], y: &[Lanes]) -> Lanes {
    let mut sum = Lanes::ZERO;
    for ((weights, x), y) in weights.iter().zip(x).zip(y) {
        for (((weight, x), y), sum) in weights.0.iter().zip(&x.0).zip(&y.0).zip(&mut sum.0) {
            *sum = (weight * x).mul_add(*y, *sum);
        }
    }
    sum
}

/// w ← exp(w − max w); returns the sum.
#[pulp::with_simd(exponentials = pulp::Arch::new())]
#[inline(always)]
pub(super) fn exponentials_simd<S: pulp::Simd>(_: S, weights: &mut [f64]) -> f64 {
    let largest = weights.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    for weight in weights.iter_mut() {
        *weight = f64::from(simd::exp((*weight - largest) as f32));
    }
    weights.iter().sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lanes_are_independent_measurements() {
        for count in [1_usize, 15, 64, 100] {
            // The population is up to twenty of its standard deviations away from the centre, in a different direction in
            // each lane.
            let std = 0.4_f64;
            let off = |lane: usize| 8.0 * (lane as f64 * 0.9).cos();
            let x = |sample: usize, lane: usize| (sample as f64 * 0.7 + lane as f64).sin();
            let offset = |sample: usize, lane: usize| (sample as f64 * 1.3 - lane as f64).cos();
            let lanes = |f: &dyn Fn(usize) -> f64| -> Lanes { Lanes(std::array::from_fn(|lane| f(lane) as f32)) };
            let deviations: Vec<Lanes> = (0..count).map(|s| lanes(&|lane| x(s, lane))).collect();
            let offsets: Vec<Lanes> = (0..count).map(|s| lanes(&|lane| LOG2_E * offset(s, lane))).collect();
            let mut weights = vec![Lanes::ZERO; count];
            let square = (-0.5 * LOG2_E / (std * std)) as f32;
            let linear = lanes(&|lane| LOG2_E * off(lane) / (std * std));
            let mut logarithms = weights.clone();
            let columns = [deviations];
            let terms = Terms {
                to: &offsets,
                deviations: &columns,
                places: 0..count,
                squares: &[square],
                linears: &[linear],
                crosses: &[],
            };
            // The initial divisor is too far from the largest weight.
            let found = weigh(&mut weights, &mut logarithms, &terms, LANES, &Lanes([1e4; LANES]));
            let moments = moments(&weights, &columns[0]);
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
                // Exponents of about 200 in single precision: 200 · 6e-8 times several operations.
                for (sample, expected) in expected.iter().enumerate() {
                    let found = f64::from(weights[sample].0[lane]);
                    assert!((found - expected).abs() < 1e-4, "{count}: {found}, expected {expected}");
                }
                let sum: f64 = expected.iter().sum();
                assert!((f64::from(found.sum.0[lane]) / sum - 1.0).abs() < 1e-4, "{count}");
                let log_sum = f64::from(found.divisor.0[lane]) / LOG2_E - 0.5 * (off(lane) / std).powi(2) + sum.ln();
                assert!((log_sum - largest - sum.ln()).abs() < 2e-4, "{count}");
                let direct = |power: i32| -> f64 { (0..count).map(|s| expected[s] * x(s, lane).powi(power)).sum() };
                assert!((f64::from(moments.0 .0[lane]) - direct(1)).abs() < 1e-4 * sum, "{count}");
                assert!((f64::from(moments.1 .0[lane]) - direct(2)).abs() < 1e-4 * sum, "{count}");
                // Over all shares each sample is selected in proportion to its weight.
                for sample in 0..count {
                    let expected =
                        f64::from(weights[sample].0[lane]) / f64::from(found.sum.0[lane]) * f64::from(shares);
                    assert!((counts[sample * LANES + lane] - expected).abs() < 3.0, "{count}: {expected}");
                }
            }
        }
    }

    #[test]
    fn terms_of_any_number_of_parameters_are_added() {
        for parameters in 1..=9_usize {
            let x = |k: usize, sample: usize, lane: usize| ((k + 2 * sample + 5 * lane) as f64).sin();
            let (square, linear) =
                (|k: usize| -0.3 - 0.1 * k as f64, |k: usize, lane: usize| ((k + lane) as f64).cos());
            let lanes = |f: &dyn Fn(usize) -> f64| -> Lanes { Lanes(std::array::from_fn(|lane| f(lane) as f32)) };
            let column = |k: usize| (0..7).map(|sample| lanes(&|lane| x(k, sample, lane))).collect::<Vec<_>>();
            let columns: Vec<Vec<Lanes>> = (0..parameters).map(column).collect();
            let squares: Vec<f32> = (0..parameters).map(|k| square(k) as f32).collect();
            let linears: Vec<Lanes> = (0..parameters).map(|k| lanes(&|lane| linear(k, lane))).collect();
            // Eight measurements with two lanes each.
            let (mut weights, offsets) = (vec![Lanes::ZERO; 7], vec![Lanes::ZERO; 7]);
            let terms = Terms {
                to: &offsets,
                deviations: &columns,
                places: 0..7,
                squares: &squares,
                linears: &linears,
                crosses: &[],
            };
            let mut logarithms = weights.clone();
            let found = weigh(&mut weights, &mut logarithms, &terms, 8, &Lanes([-100.0; LANES]));
            // Another divisor that is close enough is kept.
            let (others, near) = (&mut weights.clone(), Lanes(std::array::from_fn(|lane| found.divisor.0[lane] + 3.0)));
            let again = weigh(others, &mut logarithms, &terms, 8, &near);
            assert_eq!(again.divisor, near);
            for (weights, others) in weights.iter().zip(others) {
                weights.0.iter().zip(others.0).for_each(|(own, other)| assert!((own - 8.0 * other).abs() < 1e-6));
            }
            for lane in 0..8 {
                let term =
                    |k: usize, s: usize, lane: usize| x(k, s, lane) * (x(k, s, lane) * square(k) + linear(k, lane));
                let exponent = |s: usize, lane: usize| (0..parameters).map(|k| term(k, s, lane)).sum::<f64>();
                let both = |s: usize| exponent(s, lane).max(exponent(s, lane + 8));
                let largest = (0..7).map(both).fold(f64::NEG_INFINITY, f64::max);
                for own in [lane, lane + 8] {
                    assert!((f64::from(found.divisor.0[own]) - largest).abs() < 1e-5, "{parameters}, {own}");
                    let sum: f64 = (0..7).map(|s| (exponent(s, own) - largest).exp2()).sum();
                    assert!((f64::from(found.sum.0[own]) / sum - 1.0).abs() < 1e-5, "{parameters}, {own}");
                }
            }
        }
    }

    #[test]
    fn terms_of_correlated_parameters_are_added() {
        for parameters in 2..=8_usize {
            let x = |k: usize, sample: usize, lane: usize| ((k + 2 * sample + 5 * lane) as f64).sin();
            let (square, cross) =
                (|k: usize| -0.9 - 0.1 * k as f64, |k: usize, l: usize| 0.1 * ((k + 3 * l) as f64).cos());
            let linear = |k: usize, lane: usize| ((k + lane) as f64).cos();
            let lanes = |f: &dyn Fn(usize) -> f64| -> Lanes { Lanes(std::array::from_fn(|lane| f(lane) as f32)) };
            let column = |k: usize| (0..7).map(|sample| lanes(&|lane| x(k, sample, lane))).collect::<Vec<_>>();
            let columns: Vec<Vec<Lanes>> = (0..parameters).map(column).collect();
            let squares: Vec<f32> = (0..parameters).map(|k| square(k) as f32).collect();
            let linears: Vec<Lanes> = (0..parameters).map(|k| lanes(&|lane| linear(k, lane))).collect();
            let pairs = (0..parameters).flat_map(|k| (0..k).map(move |l| (k, l)));
            let crosses: Vec<f32> = pairs.map(|(k, l)| cross(k, l) as f32).collect();
            let (mut weights, offsets) = (vec![Lanes::ZERO; 7], vec![Lanes([0.25; LANES]); 7]);
            let mut logarithms = weights.clone();
            let terms = Terms {
                to: &offsets,
                deviations: &columns,
                places: 0..7,
                squares: &squares,
                linears: &linears,
                crosses: &crosses,
            };
            weigh(&mut weights, &mut logarithms, &terms, LANES, &Lanes::ZERO);
            for (sample, found) in logarithms.iter().enumerate() {
                for (lane, found) in found.0.iter().enumerate() {
                    let mut expected = 0.25;
                    for k in 0..parameters {
                        let own = x(k, sample, lane);
                        expected += own * (own * square(k) + linear(k, lane));
                        expected += (0..k).map(|l| own * x(l, sample, lane) * cross(k, l)).sum::<f64>();
                    }
                    // Up to 44 terms of at most 2 in single precision.
                    let found = f64::from(*found);
                    assert!((found - expected).abs() < 1e-5, "{parameters}: {found}, expected {expected}");
                }
            }
            let direct: f64 =
                (0..7).map(|s| f64::from(weights[s].0[3] * columns[0][s].0[3] * columns[1][s].0[3])).sum();
            let found = f64::from(cross_moment(&weights, &columns[0], &columns[1]).0[3]);
            assert!((found - direct).abs() < 1e-5 * direct.abs().max(1.0), "{found}, expected {direct}");
        }
    }

    #[test]
    fn exponentials_are_relative_to_the_largest() {
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
