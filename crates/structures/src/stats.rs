//! Moments, quantiles, importance weights, and the named random streams from which all random numbers of the crate are drawn.

use std::sync::OnceLock;

use rand::seq::SliceRandom as _;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha12Rng;
use sha2::{Digest as _, Sha256};
use statrs::distribution::{ContinuousCDF as _, Normal, StudentsT};

/// The random generator of the crate: the same seed gives the same bits on every machine.
pub type Stream = ChaCha12Rng;

/// An independent random stream for each pair of seed and purpose: ChaCha12, seeded with SHA-256 of both.
///
/// Separate purposes keep draws independent of each other: one more training sample does not change the initial weights.
pub fn stream(seed: u64, purpose: &str) -> Stream {
    let mut hasher = Sha256::new();
    hasher.update(seed.to_le_bytes());
    hasher.update(purpose.as_bytes());
    ChaCha12Rng::from_seed(hasher.finalize().into())
}

/// Squared cosine of the angle between two vectors of the same length, `[n]`: 1 for parallel vectors, 0 for orthogonal ones and
/// where one of them is zero. For two mode shapes it is the modal assurance criterion (MAC).
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

/// Arithmetic mean of `values`, `[n]`, in their unit; NaN for an empty slice.
pub fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Sample standard deviation of `values`, `[n]`, with the divisor n − 1, in their unit; `None` for fewer than two values.
///
/// ```text
///  s = √( Σ (xᵢ − x̄)²/(n − 1) )
/// ```
pub fn sample_std(values: &[f64]) -> Option<f64> {
    if values.len() < 2 {
        return None;
    }
    let centre = mean(values);
    let squares: f64 = values.iter().map(|v| (v - centre).powi(2)).sum();
    Some((squares / (values.len() - 1) as f64).sqrt())
}

/// Coefficient of determination of `estimate` for `truth`, both `[n]`.
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

/// Quantile of unsorted values, `[n]`, by linear interpolation between order statistics; NaN for an empty slice. `level` is
/// clamped to the interval from 0 to 1.
///
/// ```text
///  h = level·(n − 1),    Q = x₍ₖ₎ + (h − k)(x₍ₖ₊₁₎ − x₍ₖ₎),    k = ⌊h⌋, order statistics counted from 0
/// ```
///
/// Source: R. J. Hyndman, Y. Fan (1996), Sample quantiles in statistical packages, The American Statistician 50, 361–365,
/// definition 7.
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

/// A p-value for people: how often chance alone gives at least this deviation.
pub fn by_chance(p: f64) -> String {
    if p < 0.001 {
        "by chance in fewer than 1 of 1000 cases".to_owned()
    } else if p < 0.1 {
        format!("by chance in about {:.0} of 1000 cases", 1000.0 * p)
    } else {
        format!("by chance in about {:.0} of 100 cases", 100.0 * p)
    }
}

/// Cumulative distribution of the standard normal, Φ(z).
pub fn normal_cdf(z: f64) -> f64 {
    Normal::standard().cdf(z)
}

/// Quantile of the standard normal, Φ⁻¹(p), for p between 0 and 1.
pub fn normal_quantile(p: f64) -> f64 {
    Normal::standard().inverse_cdf(p)
}

/// Standard normal quantiles by linear interpolation in a table. They are accurate to 1e-5 and take a tenth of the time of
/// [`normal_quantile`], which is still used for levels in the tails.
pub struct NormalQuantiles {
    /// Quantiles at the levels i/`CELLS`.
    values: Vec<f64>,
}

impl NormalQuantiles {
    const CELLS: usize = 8192;

    /// Below this level, and above 1 minus this level, linear interpolation is too coarse.
    const OUTERMOST: f64 = 0.01;

    /// The table, computed at the first call and shared afterwards.
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

/// Quantile of Student's t distribution with ν = `degrees_of_freedom`, for p between 0 and 1. ν = 0 is treated as 1.
///
/// Above 1,000 degrees of freedom by Fisher's expansion about the normal quantile z, accurate to 1e-8:
///
/// ```text
///  t = z + (z³ + z)/4ν + (5z⁵ + 16z³ + 3z)/96ν²
/// ```
pub fn student_t_quantile(p: f64, degrees_of_freedom: usize) -> f64 {
    // statrs has an error of 3e-6 at 100,000 degrees of freedom and does not terminate at 100 million.
    const EXPANDED: usize = 1000;
    let nu = degrees_of_freedom.max(1) as f64;
    if degrees_of_freedom > EXPANDED {
        let z = normal_quantile(p);
        return z + (z.powi(3) + z) / (4.0 * nu) + (5.0 * z.powi(5) + 16.0 * z.powi(3) + 3.0 * z) / (96.0 * nu * nu);
    }
    StudentsT::new(0.0, 1.0, nu).expect("scale and degrees of freedom are positive").inverse_cdf(p)
}

/// Importance weights, `[n]`, from their logarithms `log_weights`, nats, `[n]`, scaled so that the largest is 1.
///
/// ```text
///  w_s = exp(ln w_s − max ln w),    effective sample size (Σw)²/Σw²
/// ```
///
/// Returns `None` if the effective sample size is below `effective`·n, or if no logarithm is finite. A logarithm of −∞ gives a
/// weight of 0.
pub fn weights(log_weights: &[f64], effective: f64) -> Option<Vec<f64>> {
    let largest = log_weights.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if !largest.is_finite() {
        return None;
    }
    let weights: Vec<f64> = log_weights.iter().map(|w| (w - largest).exp()).collect();
    (effective_number(&weights) >= effective * weights.len() as f64).then_some(weights)
}

/// Effective number (Σ w)²/Σ w² of draws with the weights w, `[n]`.
pub fn effective_number(weights: &[f64]) -> f64 {
    let (sum, squares) = weights.iter().fold((0.0, 0.0), |(s, q), w| (s + w, q + w * w));
    sum * sum / squares
}

/// The weights w^β for the largest β ≤ 1 that leaves `wanted` effective draws, `[n]`, from ln w, nats, `[n]`; `None` where the draws with a
/// weight are fewer.
pub fn tempered_weights(log_weights: &[f64], wanted: f64) -> Option<Vec<f64>> {
    let raised = |beta: f64| {
        let raised: Vec<f64> = log_weights.iter().map(|weight| weight * beta).collect();
        weights(&raised, 0.0)
    };
    let untempered = raised(1.0)?;
    if effective_number(&untempered) >= wanted {
        return Some(untempered);
    }
    if (log_weights.iter().filter(|weight| weight.is_finite()).count() as f64) < wanted {
        return None;
    }
    // The effective number falls with β, so that bisection in its logarithm finds the largest one.
    let (mut low, mut high) = (-40.0_f64, 0.0_f64);
    for _ in 0..24 {
        let middle = 0.5 * (low + high);
        let enough = raised(middle.exp()).is_some_and(|weights| effective_number(&weights) >= wanted);
        *(if enough { &mut low } else { &mut high }) = middle;
    }
    raised(low.exp())
}

/// Indices of `draws` samples by systematic resampling with the weights w, `[n]`, in random order. Index i occurs `draws`·wᵢ/Σw
/// times, rounded up or down to an integer.
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
    fn p_values_are_written_as_cases_that_chance_alone_gives() {
        let rare = "by chance in fewer than 1 of 1000 cases";
        let texts = [0.0, 1e-300, 0.0004, 0.0123, 0.6].map(by_chance);
        let common = ["by chance in about 12 of 1000 cases", "by chance in about 60 of 100 cases"];
        assert_eq!(texts, [rare, rare, rare, common[0], common[1]]);
    }

    #[test]
    fn streams_differ_by_seed_and_by_purpose_and_repeat_by_both() {
        let first = |seed, purpose| stream(seed, purpose).next_u64();
        assert_eq!(first(1, "weights"), first(1, "weights"));
        assert_ne!(first(1, "weights"), first(2, "weights"));
        assert_ne!(first(1, "weights"), first(1, "latent"));
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
        // The two methods agree at the switch between them: from 1,000 to 1,001 the quantile falls by (z³ + z)/4ν² = 1.5e-6.
        assert!((student_t_quantile(0.95, 1000) - student_t_quantile(0.95, 1001) - 1.524e-6).abs() < 2e-8);
    }

    #[test]
    fn the_five_percent_quantile_is_the_papers_factor() {
        assert!((normal_quantile(0.05) + 1.645).abs() < 2e-4);
        assert!((normal_cdf(normal_quantile(0.3)) - 0.3).abs() < 1e-9);
    }

    #[test]
    fn systematic_resampling_draws_each_index_in_proportion_to_its_weight() {
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
    fn weights_are_rejected_if_the_effective_sample_size_is_too_small() {
        let usual = weights(&[0.0, 0.1, -0.1], 0.5).unwrap();
        assert!((usual[1] / usual[2] - 0.2_f64.exp()).abs() < 1e-12);
        // A few draws in a spurious mode have negligible weight and do not affect the others.
        let mut leaked = vec![0.0; 98];
        leaked.extend([-300.0, f64::NEG_INFINITY]);
        let found = weights(&leaked, 0.5).unwrap();
        assert!(found[..98].iter().all(|w| (w - 1.0).abs() < 1e-12) && found[98] < 1e-100 && found[99] <= 0.0);
        let wild: Vec<f64> = (0..100).map(|i| f64::from(i) * 0.3).collect();
        assert!(weights(&wild, 0.5).is_none());
        assert!(weights(&[f64::NEG_INFINITY; 3], 0.5).is_none());
    }
}
