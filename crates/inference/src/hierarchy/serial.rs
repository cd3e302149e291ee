//! Measurements that follow one another: how many independent ones they are worth.
//!
//! Measurements that are taken in quick succession see the same weather and the same traffic. Their values are modelled as
//!
//! ```text
//!  y_t = μ + x_t + e_t,    var y = σ²,    x first-order autoregressive with correlation ρ and variance sσ²,    e white
//!  var ȳ = σ² τ/n,    τ = 1 + 2s Σ_{k<n} (1 − k/n) ρ^k,    n/τ the effective number of measurements
//! ```
//!
//! ρ and s have a restricted likelihood, in which the mean of each batch is integrated out, so that short series are not biased. It is
//! averaged over a grid; measurements count as independent unless the grid is more probable than independence by far.
//!
//! Source: D. A. Harville (1977), Maximum likelihood approaches to variance component estimation, JASA 72, 320–338; effective number:
//! J. S. Liu (2008), Monte Carlo Strategies in Scientific Computing, Springer, §5.8.

use serde::{Deserialize, Serialize};

use super::population::PopulationEstimate;
use structures::stats;

/// Shares s of the grid.
const SHARES: [f64; 7] = [0.15, 0.3, 0.45, 0.6, 0.75, 0.9, 1.0];

/// Shortest time constant −1/ln ρ of the grid, in measurements, and the factor from one to the next.
const SHORTEST: f64 = 0.5;
const FACTOR: f64 = 1.5157;

/// Evidence of correlation, as a Bayes factor for each of the quantities that are tested together: below 0.5 % of independent batches reach
/// it in one of three quantities (`tests/posterior/dependence.rs`).
const EVIDENCE: f64 = 20.0;

/// Where the evidence is just enough, the estimate is moved towards independence as if that were this much more probable beforehand, as
/// a share of [`EVIDENCE`].
const SHRINKAGE: f64 = 0.08;

/// Fewest measurements, beyond one for each batch, that can show a correlation.
const FEWEST: usize = 7;

/// How measurements of one quantity that follow one another are correlated.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Serial {
    /// Correlation ρ of the slow part of two successive measurements.
    pub correlation: f64,
    /// Share s of the variance that is slow.
    pub share: f64,
    /// Time between successive measurements, s; `None` where their times are equal.
    pub step_s: Option<f64>,
}

/// Effective numbers of independent measurements.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Effective {
    /// For the mean: σ²/var ȳ.
    pub of_mean: f64,
    /// For the standard deviation.
    pub of_spread: f64,
    /// Number of measurements.
    pub measurements: f64,
}

impl Effective {
    /// Independent measurements.
    pub fn all(measurements: usize) -> Self {
        let n = measurements as f64;
        Self { of_mean: n, of_spread: n, measurements: n }
    }

    /// True when the measurements are worth as many independent ones.
    pub fn is_all(&self) -> bool {
        self.of_mean >= self.measurements
    }
}

/// Sums Σ_{k=1}^{n−1} (1 − k/n) r^k.
fn triangle(r: f64, n: f64) -> f64 {
    r / (1.0 - r) - r * (1.0 - r.powf(n)) / (n * (1.0 - r).powi(2))
}

impl Serial {
    /// The correlation of the measurements of one or several batches, each in the order of time; `None` unless it is beyond doubt.
    /// `tested`: number of quantities that are tested together; `step_s`: typical time between successive measurements, s.
    pub fn of(batches: &[&[f64]], tested: usize, step_s: Option<f64>) -> Option<Self> {
        let longest = batches.iter().map(|b| b.len()).max()?;
        let free: usize = batches.iter().map(|b| b.len().saturating_sub(1)).sum();
        let squares: f64 = batches.iter().map(|b| b.iter().map(|y| (y - stats::mean(b)).powi(2)).sum::<f64>()).sum();
        if free < FEWEST || longest < 3 || squares.is_nan() || squares <= 0.0 {
            return None;
        }
        let unit = (squares / free as f64).sqrt();
        let scaled = |b: &&[f64]| -> Vec<f64> {
            let centre = stats::mean(b);
            b.iter().map(|y| (y - centre) / unit).collect()
        };
        let series: Vec<Vec<f64>> = batches.iter().filter(|b| b.len() > 1).map(scaled).collect();
        let independent = log_likelihood(&series, 0.0, 0.0, free);
        let mut times = Vec::new();
        let mut time = SHORTEST;
        while time <= 2.0 * longest as f64 {
            times.push(time);
            time *= FACTOR;
        }
        let grid: Vec<(f64, f64)> = times.iter().flat_map(|t| SHARES.iter().map(|s| (*t, *s))).collect();
        let logs: Vec<f64> = grid.iter().map(|(t, s)| log_likelihood(&series, (-1.0 / t).exp(), *s, free)).collect();
        let largest = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let weights: Vec<f64> = logs.iter().map(|l| (l - largest).exp()).collect();
        let total: f64 = weights.iter().sum();
        let evidence = (largest - independent + (total / grid.len() as f64).ln()).exp();
        let needed = EVIDENCE * tested.max(1) as f64;
        if evidence.is_nan() || evidence < needed {
            return None;
        }
        let mean =
            |of: &dyn Fn(&(f64, f64)) -> f64| grid.iter().zip(&weights).map(|(g, w)| of(g) * w).sum::<f64>() / total;
        let certainty = if evidence.is_finite() { evidence / (evidence + SHRINKAGE * needed) } else { 1.0 };
        let correlation = (-1.0 / mean(&|(t, _)| t.ln()).exp()).exp();
        Some(Self { correlation, share: certainty * mean(&|(_, s)| *s), step_s })
    }

    /// The same correlation of measurements with another time between them.
    #[must_use]
    pub fn at_step(&self, step_s: Option<f64>) -> Self {
        let ratio = self.step_s.zip(step_s).map_or(1.0, |(own, other)| other / own);
        Self { correlation: self.correlation.powf(ratio).min(0.999_999), share: self.share, step_s }
    }

    /// τ for the mean of `n` successive measurements.
    pub fn inefficiency(&self, n: usize) -> f64 {
        1.0 + 2.0 * self.share * triangle(self.correlation, n as f64)
    }

    /// Effective numbers of the measurements of batches of these sizes.
    ///
    /// ```text
    ///  of the mean: N²/Σ n_b τ(n_b),    of the spread: N²/Σ n_b τ₂(n_b),    τ₂ as τ with s²ρ^{2k}
    /// ```
    pub fn effective(&self, sizes: &[usize]) -> Effective {
        let n: f64 = sizes.iter().sum::<usize>() as f64;
        let squared = Self { correlation: self.correlation.powi(2), share: self.share.powi(2), step_s: None };
        let weighed =
            |serial: &Self| sizes.iter().filter(|n| **n > 0).map(|n| *n as f64 * serial.inefficiency(*n)).sum::<f64>();
        Effective { of_mean: n * n / weighed(self), of_spread: n * n / weighed(&squared), measurements: n }
    }
}

/// Restricted log-likelihood of ρ and s, up to a constant, with σ² at its maximum, by the Kalman filter of values and of a constant.
///
/// ```text
///  −½ Σ_b (ln|V_b| + ln 1ᵀV_b⁻¹1) − ½ (N − B) ln Σ_b (yᵀV⁻¹y − (1ᵀV⁻¹y)²/1ᵀV⁻¹1)
/// ```
fn log_likelihood(series: &[Vec<f64>], correlation: f64, share: f64, free: usize) -> f64 {
    let (mut log, mut residual) = (0.0, 0.0);
    for values in series {
        let (mut state, mut of_one, mut variance) = (0.0, 0.0, share);
        let (mut yy, mut y1, mut oo) = (0.0, 0.0, 0.0);
        for y in values {
            let total = variance + 1.0 - share;
            let (v, w) = (y - state, 1.0 - of_one);
            log -= 0.5 * total.ln();
            yy += v * v / total;
            y1 += v * w / total;
            oo += w * w / total;
            let gain = variance / total;
            state = correlation * (state + gain * v);
            of_one = correlation * (of_one + gain * w);
            variance = correlation * correlation * variance * (1.0 - gain) + share * (1.0 - correlation * correlation);
        }
        log -= 0.5 * oo.ln();
        residual += yy - y1 * y1 / oo;
    }
    log - 0.5 * free as f64 * residual.max(f64::MIN_POSITIVE).ln()
}

impl PopulationEstimate {
    /// The estimate if the measurements behind it are worth fewer independent ones. `within`: mean posterior variance of a measurement,
    /// unit².
    ///
    /// ```text
    ///  μ' = μ̂ + (μ − μ̂) √(n/n_e) t(n_e − 1)/t(n − 1),    σ'² = b σ² + (b − 1) within,    b = (1 − 1/n)/(1 − 1/n_e)
    /// ```
    ///
    /// t: 95 % quantile of Student's distribution. Correlated measurements scatter less about their own mean than about that of the
    /// population, which b corrects. The draws of ln σ' are spread by the root of n over the effective number for the spread.
    #[must_use]
    pub fn widened(&self, effective: Effective, within: f64) -> Self {
        if effective.is_all() || self.std.is_none() {
            return self.clone();
        }
        let Effective { of_mean, of_spread, measurements: n } = effective;
        let t = |count: f64| stats::student_t_quantile(0.95, (count - 1.0).round().max(1.0) as usize);
        let stretch = (n / of_mean).sqrt() * t(of_mean) / t(n);
        let centre = stats::mean(&self.mean_draws);
        let bias = (1.0 - 1.0 / n) / (1.0 - 1.0 / of_mean.max(1.05));
        let corrected = |std: f64| (bias * std * std + (bias - 1.0) * within).sqrt();
        let logs: Vec<f64> = self.std_draws.iter().map(|std| corrected(*std).ln()).collect();
        let (middle, spread) = (stats::mean(&logs), (n / of_spread).sqrt().max(1.0));
        Self {
            mean: self.mean,
            std: self.std.map(corrected),
            mean_draws: self.mean_draws.iter().map(|mean| centre + stretch * (mean - centre)).collect(),
            std_draws: logs.iter().map(|log| (middle + spread * (log - middle)).exp()).collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};

    #[test]
    fn the_likelihood_is_that_of_the_covariance_matrix() {
        let series = vec![vec![0.3, -0.2, 1.1, 0.9, -1.4], vec![0.5, 0.6, -0.9]];
        let free = 6;
        let direct = |rho: f64, share: f64| {
            let (mut log, mut residual) = (0.0, 0.0);
            for values in &series {
                let n = values.len();
                let of = |i: usize, j: usize| if i == j { 1.0 } else { share * rho.powi(i.abs_diff(j) as i32) };
                let inverse = DMatrix::from_fn(n, n, of).try_inverse().unwrap();
                let (y, one) = (DVector::from_column_slice(values), DVector::from_element(n, 1.0));
                let oo = one.dot(&(&inverse * &one));
                log += 0.5 * inverse.determinant().ln() - 0.5 * oo.ln();
                residual += y.dot(&(&inverse * &y)) - one.dot(&(&inverse * &y)).powi(2) / oo;
            }
            log - 0.5 * f64::from(free) * residual.ln()
        };
        for (rho, share) in [(0.0, 0.0), (0.5, 0.4), (0.9, 1.0), (0.99, 0.15)] {
            let found = log_likelihood(&series, rho, share, free as usize);
            assert!((found - direct(rho, share)).abs() < 1e-9, "{rho}, {share}: {found}");
        }
    }

    #[test]
    fn the_sum_of_the_correlations_is_that_of_its_terms() {
        let serial = Serial { correlation: 0.8, share: 0.7, step_s: Some(60.0) };
        let direct = 1.0 + 2.0 * 0.7 * (1..20).map(|k| (1.0 - f64::from(k) / 20.0) * 0.8_f64.powi(k)).sum::<f64>();
        assert!((serial.inefficiency(20) - direct).abs() < 1e-12);
        assert!((serial.inefficiency(1) - 1.0).abs() < 1e-12);
        // Half the time between measurements: the correlation of two steps is that of one before.
        assert!((serial.at_step(Some(30.0)).correlation.powi(2) - 0.8).abs() < 1e-12);
        assert_eq!(serial.at_step(None), Serial { step_s: None, ..serial });
    }
}
