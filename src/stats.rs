//! Moments, quantiles and the named random streams every draw of the crate comes from.

use std::sync::OnceLock;

use rand::seq::SliceRandom as _;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha12Rng;
use sha2::{Digest as _, Sha256};
use statrs::distribution::{ContinuousCDF as _, Normal, StudentsT};

/// The random generator of the crate: same seed, same bits, on every machine.
pub type Stream = ChaCha12Rng;

/// An independent random stream for each pair of seed and purpose.
///
/// Purposes keep draws apart: one more training sample does not shift the initial weights.
pub fn stream(seed: u64, purpose: &str) -> Stream {
    let mut hasher = Sha256::new();
    hasher.update(seed.to_le_bytes());
    hasher.update(purpose.as_bytes());
    ChaCha12Rng::from_seed(hasher.finalize().into())
}

/// exp(x) with a relative error below 3e-7; arguments beyond ±87, near the ends of f32, count as that.
///
/// By Cody–Waite reduction to |r| ≤ ½ ln 2 and a polynomial of degree 6, free of branches and calls, so that loops over it
/// become vector instructions where the compiler knows of fused multiplication and addition: inside `pulp::with_simd`.
#[inline(always)]
pub fn exp_f32(x: f32) -> f32 {
    // Adding 1.5·2²³ rounds to the nearest whole number and leaves it in the lowest bits.
    const ROUND: f32 = 12_582_912.0;
    const LN_2_HIGH: f32 = 0.693_359_4;
    const LN_2_LOW: f32 = -2.121_944_4e-4;
    let x = x.clamp(-87.0, 87.0);
    let shifted = x.mul_add(std::f32::consts::LOG2_E, ROUND);
    let whole = shifted - ROUND;
    let r = whole.mul_add(-LN_2_LOW, whole.mul_add(-LN_2_HIGH, x));
    let polynomial = r.mul_add(1.392_695e-3, 8.333_161e-3);
    let polynomial = r.mul_add(polynomial, 4.166_664e-2);
    let polynomial = r.mul_add(polynomial, 1.666_666_7e-1);
    let polynomial = r.mul_add(polynomial, 0.5);
    let polynomial = r.mul_add(polynomial, 1.0);
    let polynomial = r.mul_add(polynomial, 1.0);
    polynomial * f32::from_bits(shifted.to_bits().wrapping_sub(ROUND.to_bits()).wrapping_add(127) << 23)
}

/// 1/x with a relative error below 2e-7, for x from 1 to 8e37.
///
/// By three of Newton's steps from a guess that takes the exponent apart: a division of sixteen numbers takes as long as all
/// the rest of a logistic function.
#[inline(always)]
pub fn reciprocal_f32(x: f32) -> f32 {
    let guess = f32::from_bits(0x7EF3_11C7_u32.wrapping_sub(x.to_bits()));
    let better = |r: f32| r.mul_add((-x).mul_add(r, 1.0), r);
    better(better(better(guess)))
}

/// Squared cosine of the angle between two vectors: 1 for the same up to sign and size, 0 for orthogonal ones or where one is
/// zero. Of two mode shapes it is the modal assurance criterion (MAC).
///
/// ```text
///  (aᵀb)²/(aᵀa · bᵀb)
/// ```
///
/// Source: R. J. Allemang, D. L. Brown (1982), A correlation coefficient for modal vector analysis, IMAC 1, 110–116.
pub fn squared_cosine(a: &[f64], b: &[f64]) -> f64 {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
    let scale = dot(a, a) * dot(b, b);
    if scale > 0.0 {
        dot(a, b).powi(2) / scale
    } else {
        0.0
    }
}

/// Arithmetic mean; NaN for an empty slice.
pub fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Sample standard deviation with n − 1; `None` below two values.
pub fn sample_std(values: &[f64]) -> Option<f64> {
    if values.len() < 2 {
        return None;
    }
    let centre = mean(values);
    let squares: f64 = values.iter().map(|v| (v - centre).powi(2)).sum();
    Some((squares / (values.len() - 1) as f64).sqrt())
}

/// Coefficient of determination of `estimate` for `truth`.
///
/// ```text
///  R² = 1 − Σ (truth − estimate)² / Σ (truth − mean(truth))²
/// ```
pub fn r_squared(truth: &[f64], estimate: &[f64]) -> f64 {
    let centre = mean(truth);
    let residual: f64 = truth.iter().zip(estimate).map(|(t, e)| (t - e).powi(2)).sum();
    let total: f64 = truth.iter().map(|t| (t - centre).powi(2)).sum();
    1.0 - residual / total
}

/// Quantile by linear interpolation between order statistics (Hyndman & Fan type 7); NaN for an empty slice.
pub fn quantile(values: &[f64], level: f64) -> f64 {
    if values.is_empty() {
        return f64::NAN;
    }
    let mut values = values.to_vec();
    let position = level.clamp(0.0, 1.0) * (values.len() - 1) as f64;
    let place = position.floor() as usize;
    let (_, below, rest) = values.select_nth_unstable_by(place, f64::total_cmp);
    let below = *below;
    let above = rest.iter().copied().min_by(f64::total_cmp).unwrap_or(below);
    below + (position - place as f64) * (above - below)
}

/// Cumulative distribution of the standard normal, Φ(z).
pub fn normal_cdf(z: f64) -> f64 {
    Normal::standard().cdf(z)
}

/// Quantile of the standard normal, Φ⁻¹(p).
pub fn normal_quantile(p: f64) -> f64 {
    Normal::standard().inverse_cdf(p)
}

/// Standard normal quantiles from a table, straight lines between: to 1e-5, in a tenth of the time of [`normal_quantile`], which
/// the outermost levels are from.
pub struct NormalQuantiles {
    /// Those of the levels i/CELLS.
    values: Vec<f64>,
}

impl NormalQuantiles {
    const CELLS: usize = 8192;

    /// Level below which, and above one less which, lines are too straight.
    const OUTERMOST: f64 = 0.01;

    /// The table, made at the first call.
    pub fn shared() -> &'static Self {
        static TABLE: OnceLock<NormalQuantiles> = OnceLock::new();
        TABLE.get_or_init(|| {
            let level = |i: usize| (i as f64 / Self::CELLS as f64).clamp(1e-12, 1.0 - 1e-12);
            Self { values: (0..=Self::CELLS).map(|i| normal_quantile(level(i))).collect() }
        })
    }

    /// Φ⁻¹(p), `p` between 0 and 1.
    #[inline]
    pub fn at(&self, p: f64) -> f64 {
        if !(Self::OUTERMOST..=1.0 - Self::OUTERMOST).contains(&p) {
            return normal_quantile(p);
        }
        let place = p * Self::CELLS as f64;
        let cell = place as usize;
        let (low, high) = (self.values[cell], self.values[cell + 1]);
        low + (place - cell as f64) * (high - low)
    }
}

/// Quantile of Student's t with `degrees_of_freedom`, at least 1.
///
/// Above 1,000 by Fisher's expansion about the normal quantile z, to 1e-8:
///
/// ```text
///  t = z + (z³ + z)/4ν + (5z⁵ + 16z³ + 3z)/96ν²
/// ```
pub fn student_t_quantile(p: f64, degrees_of_freedom: usize) -> f64 {
    // statrs is off by 3e-6 at a hundred thousand degrees of freedom, and does not return at a hundred million.
    const EXPANDED: usize = 1000;
    let nu = degrees_of_freedom.max(1) as f64;
    if degrees_of_freedom > EXPANDED {
        let z = normal_quantile(p);
        return z + (z.powi(3) + z) / (4.0 * nu) + (5.0 * z.powi(5) + 16.0 * z.powi(3) + 3.0 * z) / (96.0 * nu * nu);
    }
    StudentsT::new(0.0, 1.0, nu).expect("scale and degrees of freedom are positive").inverse_cdf(p)
}

/// Weights of these logarithms, the greatest 1; `None` where fewer than the share `effective` of the samples would count, by
/// (Σw)²/Σw², or none has a weight.
pub fn weights(log_weights: &[f64], effective: f64) -> Option<Vec<f64>> {
    let largest = log_weights.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if !largest.is_finite() {
        return None;
    }
    let weights: Vec<f64> = log_weights.iter().map(|w| (w - largest).exp()).collect();
    let (sum, squares) = weights.iter().fold((0.0, 0.0), |(s, q), w| (s + w, q + w * w));
    (sum * sum / squares >= effective * weights.len() as f64).then_some(weights)
}

/// `draws` indices by systematic resampling: each as often as its weight says to within one, in random order.
pub fn systematic(weights: &[f64], draws: usize, stream: &mut Stream) -> Vec<usize> {
    let step = weights.iter().sum::<f64>() / draws as f64;
    let offset: f64 = stream.random();
    let (mut index, mut passed) = (0, 0.0);
    let mut chosen: Vec<usize> = (0..draws)
        .map(|draw| {
            let target = (draw as f64 + offset) * step;
            while index + 1 < weights.len() && passed + weights[index] <= target {
                passed += weights[index];
                index += 1;
            }
            index
        })
        .collect();
    chosen.shuffle(stream);
    chosen
}

#[cfg(test)]
mod tests {
    use rand::RngCore as _;

    use super::*;

    #[test]
    fn streams_differ_by_seed_and_by_purpose_and_repeat_by_both() {
        let first = |seed, purpose| stream(seed, purpose).next_u64();
        assert_eq!(first(1, "weights"), first(1, "weights"));
        assert_ne!(first(1, "weights"), first(2, "weights"));
        assert_ne!(first(1, "weights"), first(1, "latent"));
    }

    #[test]
    fn the_fast_exponential_is_the_exponential() {
        for i in -8_600..=8_600 {
            let x = i as f32 / 100.0;
            let exact = f64::from(x).exp();
            assert!((f64::from(exp_f32(x)) / exact - 1.0).abs() < 3e-7, "at {x}");
        }
    }

    #[test]
    fn reciprocals_hold_to_single_precision_over_their_range() {
        for step in 0..=100_000 {
            let x = 10_f32.powf(37.9 * step as f32 / 100_000.0);
            assert!((f64::from(reciprocal_f32(x)) * f64::from(x) - 1.0).abs() < 2e-7, "at {x}");
        }
    }

    #[test]
    fn moments_and_quantiles_of_a_ramp_are_the_closed_forms() {
        let ramp: Vec<f64> = (0..=100).map(f64::from).collect();
        assert!((mean(&ramp) - 50.0).abs() < 1e-12);
        // Σ (i − 50)² over 0..=100 is 100·101·102/12 = 85850.
        assert!((sample_std(&ramp).unwrap() - 858.5_f64.sqrt()).abs() < 1e-12);
        assert!((quantile(&ramp, 0.05) - 5.0).abs() < 1e-12);
        assert!(sample_std(&[1.0]).is_none());
    }

    #[test]
    fn quantiles_of_students_t_are_those_of_the_closed_forms() {
        // One degree of freedom: tan(π(p − ½)). Two: (2p − 1)·√(2/(4p(1 − p))).
        assert!((student_t_quantile(0.95, 1) - (0.45 * std::f64::consts::PI).tan()).abs() < 1e-8);
        assert!((student_t_quantile(0.975, 2) - 0.95 * (2.0 / (4.0 * 0.975 * 0.025_f64)).sqrt()).abs() < 1e-8);
        // Tables: 1.833 at 9, and the normal quantile in the limit.
        assert!((student_t_quantile(0.95, 9) - 1.833_112_93).abs() < 1e-7);
        assert!((student_t_quantile(0.95, 1_000_000_000) - normal_quantile(0.95)).abs() < 1e-8);
        // Both ways meet: from 1,000 to 1,001 it falls by (z³ + z)/4ν² = 1.5e-6.
        assert!((student_t_quantile(0.95, 1000) - student_t_quantile(0.95, 1001) - 1.524e-6).abs() < 2e-8);
    }

    #[test]
    fn the_five_percent_quantile_is_the_papers_factor() {
        assert!((normal_quantile(0.05) + 1.645).abs() < 2e-4);
        assert!((normal_cdf(normal_quantile(0.3)) - 0.3).abs() < 1e-9);
    }

    #[test]
    fn systematic_draws_come_as_often_as_their_weights_say() {
        let weights = [0.5, 0.0, 2.0, 1.0, 0.5];
        for seed in 0..20 {
            let chosen = systematic(&weights, 400, &mut stream(seed, "test"));
            for (index, weight) in weights.iter().enumerate() {
                let count = chosen.iter().filter(|i| **i == index).count() as f64;
                assert!((count - 100.0 * weight).abs() <= 1.0, "{index}: {count}");
            }
        }
    }

    #[test]
    fn tabulated_quantiles_are_those_of_the_normal_distribution() {
        for i in 1..100_000 {
            let p = f64::from(i) / 1e5;
            let found = NormalQuantiles::shared().at(p);
            assert!((found - normal_quantile(p)).abs() < 1e-5, "{p}: {found}");
        }
    }

    #[test]
    fn weights_count_only_where_they_leave_half_of_the_draws() {
        let usual = weights(&[0.0, 0.1, -0.1], 0.5).unwrap();
        assert!((usual[1] / usual[2] - 0.2_f64.exp()).abs() < 1e-12);
        // A few draws in a hump that is none weigh nothing, and change nothing for the others.
        let mut leaked = vec![0.0; 98];
        leaked.extend([-300.0, f64::NEG_INFINITY]);
        let found = weights(&leaked, 0.5).unwrap();
        assert!(found[..98].iter().all(|w| (w - 1.0).abs() < 1e-12) && found[98] < 1e-100 && found[99] <= 0.0);
        let wild: Vec<f64> = (0..100).map(|i| f64::from(i) * 0.3).collect();
        assert!(weights(&wild, 0.5).is_none());
        assert!(weights(&[f64::NEG_INFINITY; 3], 0.5).is_none());
    }
}
