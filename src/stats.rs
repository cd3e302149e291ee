//! Moments, quantiles and the named random streams every draw of the crate comes from.

use rand::SeedableRng as _;
use rand_chacha::ChaCha12Rng;
use sha2::{Digest as _, Sha256};
use statrs::distribution::{ContinuousCDF as _, Normal};

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
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let position = level.clamp(0.0, 1.0) * (sorted.len() - 1) as f64;
    let below = position.floor() as usize;
    let above = (below + 1).min(sorted.len() - 1);
    sorted[below] + (position - below as f64) * (sorted[above] - sorted[below])
}

/// Cumulative distribution of the standard normal, Φ(z).
pub fn normal_cdf(z: f64) -> f64 {
    Normal::standard().cdf(z)
}

/// Quantile of the standard normal, Φ⁻¹(p).
pub fn normal_quantile(p: f64) -> f64 {
    Normal::standard().inverse_cdf(p)
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
    fn moments_and_quantiles_of_a_ramp_are_the_closed_forms() {
        let ramp: Vec<f64> = (0..=100).map(f64::from).collect();
        assert!((mean(&ramp) - 50.0).abs() < 1e-12);
        // Σ (i − 50)² over 0..=100 is 100·101·102/12 = 85850.
        assert!((sample_std(&ramp).unwrap() - 858.5_f64.sqrt()).abs() < 1e-12);
        assert!((quantile(&ramp, 0.05) - 5.0).abs() < 1e-12);
        assert!(sample_std(&[1.0]).is_none());
    }

    #[test]
    fn the_five_percent_quantile_is_the_papers_factor() {
        assert!((normal_quantile(0.05) + 1.645).abs() < 2e-4);
        assert!((normal_cdf(normal_quantile(0.3)) - 0.3).abs() < 1e-9);
    }
}
