//! Mean and spread of a quantity over the measurements of a batch.

use structures::stats;

/// Probability of all credible intervals of the crate.
pub const INTERVAL: f64 = 0.90;

/// Number of posterior draws of (μ, σ).
pub const DRAWS: usize = 400;

/// Mean and spread of one quantity over the population behind a batch.
#[derive(Debug, Clone, PartialEq)]
pub struct PopulationEstimate {
    /// Mean μ, in the quantity's unit.
    pub mean: f64,
    /// Standard deviation σ, in the quantity's unit; `None` for a single measurement, which carries no information on it.
    pub std: Option<f64>,
    /// Posterior draws of μ.
    pub mean_draws: Vec<f64>,
    /// Posterior draws of σ, paired with those of μ; empty for a single measurement.
    pub std_draws: Vec<f64>,
}

impl PopulationEstimate {
    /// Lower and upper end of the central credible interval of μ with probability [`INTERVAL`], in the quantity's unit.
    pub fn mean_interval(&self) -> [f64; 2] {
        interval(&self.mean_draws)
    }

    /// Lower and upper end of the central credible interval of σ with probability [`INTERVAL`], in the quantity's unit; `None`
    /// where σ is unknown.
    pub fn std_interval(&self) -> Option<[f64; 2]> {
        (!self.std_draws.is_empty()).then(|| interval(&self.std_draws))
    }

    /// The population of a monotone function g of the quantity: mean and standard deviation of g(x) for x ~ N(μ, σ²).
    ///
    /// ```text
    ///  mean = 1/N Σ_i g(μ + σ z_i),    z_i = Φ⁻¹((i + ½)/N) scaled to unit variance,    N = 41
    /// ```
    #[must_use]
    pub fn through(&self, function: impl Fn(f64) -> f64) -> Self {
        const NODES: usize = 41;
        let nodes: Vec<f64> = (0..NODES).map(|i| stats::normal_quantile((i as f64 + 0.5) / NODES as f64)).collect();
        // The variance of the nodes is below 1, since the tails beyond the outermost are missing.
        let scale = 1.0 / (nodes.iter().map(|z| z * z).sum::<f64>() / NODES as f64).sqrt();
        let moments = |mean: f64, std: f64| {
            let values: Vec<f64> = nodes.iter().map(|z| function(mean + std * scale * z)).collect();
            let centre = stats::mean(&values);
            let variance = values.iter().map(|v| (v - centre).powi(2)).sum::<f64>() / NODES as f64;
            (centre, variance.sqrt())
        };
        let Some(std) = self.std else {
            let mean_draws: Vec<f64> = self.mean_draws.iter().map(|x| function(*x)).collect();
            return Self { mean: stats::mean(&mean_draws), std: None, mean_draws, std_draws: Vec::new() };
        };
        let (mean, std) = moments(self.mean, std);
        let draws = self.mean_draws.iter().zip(&self.std_draws).map(|(m, s)| moments(*m, *s));
        let (mean_draws, std_draws) = draws.unzip();
        Self { mean, std: Some(std), mean_draws, std_draws }
    }

    /// The population of the mean of K quantities of the same unit, `parts`, that vary independently of each other.
    ///
    /// ```text
    ///  μ = 1/K Σ μ_k,    σ² = 1/K² Σ σ_k²
    /// ```
    #[must_use]
    pub fn average(parts: &[&Self]) -> Self {
        let count = parts.len() as f64;
        let mean_of = |draw: usize| parts.iter().map(|p| p.mean_draws[draw]).sum::<f64>() / count;
        let std_of = |draw: usize| parts.iter().map(|p| p.std_draws[draw].powi(2)).sum::<f64>().sqrt() / count;
        let draws = parts.iter().map(|p| p.mean_draws.len()).min().unwrap_or(0);
        let spread = parts.iter().all(|p| p.std.is_some());
        Self {
            mean: parts.iter().map(|p| p.mean).sum::<f64>() / count,
            std: spread.then(|| parts.iter().filter_map(|p| p.std).map(|s| s * s).sum::<f64>().sqrt() / count),
            mean_draws: (0..draws).map(mean_of).collect(),
            std_draws: if spread { (0..draws).map(std_of).collect() } else { Vec::new() },
        }
    }
}

/// Lower and upper end of the central interval of `draws`, `[n]`, with probability [`INTERVAL`], in their unit.
pub fn interval(draws: &[f64]) -> [f64; 2] {
    [stats::quantile(draws, 0.5 * (1.0 - INTERVAL)), stats::quantile(draws, 0.5 * (1.0 + INTERVAL))]
}
