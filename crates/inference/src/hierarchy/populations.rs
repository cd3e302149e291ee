//! The populations of all parameters of a batch, and those of means of several parameters.

use super::correlation::Correlations;
use super::population::PopulationEstimate;
use super::small::{SmallMatrix, MOST};

/// The populations of all parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct Populations {
    /// One entry per parameter, in the order of the space.
    pub parameters: Vec<PopulationEstimate>,
    /// Correlations of the parameters; `None` for one parameter, for more than eight, for fewer than max(8, 2d + 4, 2(d − 1)²) measurements, and
    /// where no estimate with correlations was found.
    pub correlations: Option<Correlations>,
    /// Effective sample size (Σw)²/Σw² of each measurement under the estimated population, averaged over the measurements.
    pub effective_sample_size: f64,
}

impl Populations {
    /// The population of the mean of the parameters `columns`, with their correlations where these are known, and as if they varied
    /// independently otherwise.
    ///
    /// ```text
    ///  μ = 1/K Σ_k μ_k,    σ² = 1/K² Σ_kl ρ_kl σ_k σ_l
    /// ```
    #[must_use]
    pub fn average(&self, columns: &[usize]) -> PopulationEstimate {
        let parts: Vec<&PopulationEstimate> = columns.iter().map(|&column| &self.parameters[column]).collect();
        let Some(correlations) = self.correlations.as_ref().filter(|c| c.draws() > 0) else {
            return PopulationEstimate::average(&parts);
        };
        let count = columns.len() as f64;
        let std = |std: &dyn Fn(usize) -> f64, correlation: &dyn Fn(usize, usize) -> f64| {
            let row = |&k: &usize| columns.iter().map(|&l| correlation(k, l) * std(k) * std(l)).sum::<f64>();
            columns.iter().map(row).sum::<f64>().max(0.0).sqrt() / count
        };
        let drawn = |draw: usize| std(&|k| self.parameters[k].std_draws[draw], &|k, l| correlations.drawn(draw, k, l));
        let averaged = PopulationEstimate::average(&parts);
        let point = std(&|k| self.parameters[k].std.unwrap_or(0.0), &|k, l| correlations.point(k, l));
        PopulationEstimate {
            std: averaged.std.map(|_| point),
            std_draws: (0..averaged.std_draws.len()).map(drawn).collect(),
            ..averaged
        }
    }

    /// Correlations of means of parameters: one mean for each list of columns, without a column in two of them. `None` where the
    /// correlations of the parameters are unknown, or for more than eight means.
    ///
    /// ```text
    ///  ρ_AB = Σ_{k∈A, l∈B} ρ_kl σ_k σ_l / √( Σ_{k,l∈A} ρ_kl σ_k σ_l · Σ_{k,l∈B} ρ_kl σ_k σ_l )
    /// ```
    #[must_use]
    pub fn correlations_of(&self, means: &[Vec<usize>]) -> Option<Correlations> {
        let own = self.correlations.as_ref().filter(|own| own.draws() > 0 && means.len() <= MOST)?;
        let one = |draw: usize| {
            let std = |k: usize| self.parameters[k].std_draws[draw];
            let product = |k: usize, l: usize| own.drawn(draw, k, l) * std(k) * std(l);
            let all = |a: &[usize], b: &[usize]| -> f64 {
                a.iter().map(|&k| b.iter().map(|&l| product(k, l)).sum::<f64>()).sum()
            };
            let covariance = SmallMatrix::from_fn(means.len(), |a, b| all(&means[a], &means[b]));
            let correlation = |a: usize, b: usize| {
                let scale = (covariance.rows[a][a] * covariance.rows[b][b]).sqrt();
                (covariance.rows[a][b] / scale).clamp(-1.0, 1.0)
            };
            (0..means.len())
                .flat_map(|a| (0..a).map(move |b| (a, b)))
                .map(|(a, b)| correlation(a, b))
                .collect::<Vec<_>>()
        };
        let draws: Vec<f64> = (0..own.draws()).flat_map(one).collect();
        Some(Correlations::from_draws(means.len(), draws))
    }
}
