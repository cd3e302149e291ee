//! Weights of tempered samples, and the choice of the next tempering exponent.

/// Weights of samples, which are a power of their likelihood L.
pub(super) struct Weights {
    /// Normalised weights W, with sum 1, `[n]`.
    pub normalised: Vec<f64>,
    /// Logarithm of the mean weight, nats.
    pub log_mean: f64,
    /// Effective sample size 1/Σ W².
    pub effective_sample_size: f64,
    /// Coefficient of variation of the weights.
    variation: f64,
}

impl Weights {
    /// Weights L^step of samples with the logarithms `log_likelihood` of their likelihoods, nats, `[n]`. They are zero where L is
    /// zero, even for a step of 0. At least one L must be positive.
    pub fn new(log_likelihood: &[f64], step: f64) -> Self {
        let n = log_likelihood.len() as f64;
        let largest = log_likelihood.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        // Relative to the largest, so that neither an overflow nor a sum of zero can occur.
        let relative = |l: &f64| if l.is_infinite() { 0.0 } else { (step * (l - largest)).exp() };
        let mut normalised: Vec<f64> = log_likelihood.iter().map(relative).collect();
        let sum: f64 = normalised.iter().sum();
        for weight in &mut normalised {
            *weight /= sum;
        }
        let squares: f64 = normalised.iter().map(|w| w * w).sum();
        let variance: f64 = normalised.iter().map(|w| (n * w - 1.0).powi(2)).sum::<f64>() / n;
        Self {
            normalised,
            log_mean: (sum / n).ln() + step * largest,
            effective_sample_size: 1.0 / squares,
            variation: variance.sqrt(),
        }
    }

    /// Σ_families (Σ_i∈family W_i)², where the families are numbered from 0 to n − 1.
    pub fn family_sum_of_squares(&self, families: impl Iterator<Item = usize>) -> f64 {
        let mut sums = vec![0.0; self.normalised.len()];
        for (family, weight) in families.zip(&self.normalised) {
            sums[family] += weight;
        }
        sums.iter().map(|s| s * s).sum()
    }
}

/// The largest exponent up to 1 for which the coefficient of variation of the weights is at most `wanted`. If zeros of the
/// likelihood alone exceed it, the present exponent is returned.
pub(super) fn next_exponent(log_likelihood: &[f64], present: f64, wanted: f64) -> f64 {
    let variation = |exponent: f64| Weights::new(log_likelihood, exponent - present).variation;
    if variation(1.0) <= wanted {
        return 1.0;
    }
    if variation(present) > wanted {
        return present;
    }
    // Bisection: the variation increases with the exponent.
    let (mut below, mut above) = (present, 1.0);
    while above - below > 1e-9 * (above - present) {
        let middle = f64::midpoint(below, above);
        if middle <= below || middle >= above {
            break;
        }
        if variation(middle) <= wanted {
            below = middle;
        } else {
            above = middle;
        }
    }
    // If even the smallest representable step is too large, it is taken nevertheless.
    if below > present {
        below
    } else {
        above
    }
}
