//! The pooled samples of one quantity: mean, spread and hyperparameters of a batch.

use serde::{Deserialize, Serialize};

use crate::hierarchy::{Effective, PopulationEstimate, Serial};
use structures::parameter::DamageDirection;
use structures::stats;

/// Mean and spread of one quantity over the measurements of a batch ("pooled" estimate).
///
/// ```text
///  mean    = mean of all samples x_js        (measurement j of n, sample s of S)
///  within  = mean over j of the variance of x_js about its own mean x̄_j      uncertainty of one measurement
///  between = variance of the x̄_j over j, with n − 1                          variation between measurements
///  std²    = n/(n − 1) · variance of the pool = n/(n − 1)·within + between
/// ```
///
/// Source: Wang et al. (2025), §5.2, which pools the samples. The factor n/(n − 1) is ours: 10 samples of one
/// measurement are not 10 measurements. With one measurement a spread over measurements is not identifiable.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Hyperparameters {
    /// Mean, in the quantity's unit.
    pub mean: f64,
    /// Standard deviation, in the quantity's unit; `None` for one measurement.
    pub std: Option<f64>,
    /// Mean posterior variance of a measurement, unit².
    pub within: f64,
    /// Variance of the posterior means, unit²; `None` for one measurement.
    pub between: Option<f64>,
}

impl Hyperparameters {
    /// Computes them from pooled samples, `[n·draws]`, in which the `draws` samples of each measurement are adjacent.
    pub fn from_pool(pool: &[f64], draws: usize) -> Self {
        let measurements = pool.len() / draws;
        let means: Vec<f64> = pool.chunks(draws).map(stats::mean).collect();
        let spread = pool
            .chunks(draws)
            .zip(&means)
            .map(|(samples, mean)| samples.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / draws as f64);
        let within = spread.sum::<f64>() / measurements as f64;
        let between = stats::sample_std(&means).map(|std| std.powi(2));
        let bessel = measurements as f64 / (measurements as f64 - 1.0);
        let std = between.map(|between| (bessel * within + between).sqrt());
        Self { mean: stats::mean(pool), std, within, between }
    }
}

/// The kind of a monitored quantity.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum QuantityKind {
    /// A parameter of the structure.
    Parameter,
    /// The stiffness of a spring that a parameter sets through a law.
    SpringStiffness,
    /// The mean of parameters that the modes cannot distinguish.
    Group,
}

/// Multiple of the median posterior variance of a measurement above which one counts as not informed. That of ten draws exceeds six times
/// its mean in one of 100,000 measurements.
const MOST_VARIANCE: f64 = 6.0;

/// Samples of one monitored quantity of a batch.
#[derive(Debug, Clone)]
pub struct QuantitySamples {
    /// Name of the parameter, `spring:` with the name of the spring, or `group:` with the parameters of a group.
    pub name: String,
    /// Unit of the samples.
    pub unit: String,
    /// Whether it is a parameter, a spring stiffness or a group.
    pub kind: QuantityKind,
    /// Which change indicates damage.
    pub damage: DamageDirection,
    /// The pooled samples, `[n·draws]`; the samples of each measurement are adjacent.
    pub pool: Vec<f64>,
    /// Number of samples of each measurement in the pool.
    pub draws: usize,
    /// The population behind the pool.
    pub population: PopulationEstimate,
    /// Posterior mass at the ends of the prior: share of the samples within 1 % of the prior's width from a bound, or beyond three
    /// standard deviations of a normal or log-normal prior.
    pub prior_bound_mass: f64,
    /// Name of the group of parameters that this one cannot be distinguished from.
    pub group: Option<String>,
    /// How its successive measurements are correlated; `None` where they count as independent.
    pub serial: Option<Serial>,
}

/// The measurements of some batches that inform a quantity.
pub struct Informed {
    /// Mean of the samples of each, in the quantity's unit.
    pub means: Vec<f64>,
    /// How many there are in each batch.
    pub sizes: Vec<usize>,
    /// Mean posterior variance of one of them, unit².
    pub within: f64,
}

impl QuantitySamples {
    /// The measurements that inform it, in batches of `sizes`. The posterior of a measurement in which a mode is missing is far wider than
    /// usual: its mean is that of a long curve, and says nothing on how measurements scatter or follow one another.
    pub fn informed(&self, sizes: &[usize]) -> Informed {
        let count = self.draws as f64;
        let moments = |own: &[f64]| {
            let mean = stats::mean(own);
            (mean, own.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / count)
        };
        let rows: Vec<(f64, f64)> = self.pool.chunks(self.draws).map(moments).collect();
        let variances: Vec<f64> = rows.iter().map(|(_, variance)| *variance).collect();
        let most = MOST_VARIANCE * stats::quantile(&variances, 0.5);
        let (mut kept, mut found, mut first) = (Vec::new(), Vec::with_capacity(sizes.len()), 0);
        for size in sizes {
            let own = rows[first..first + size].iter().filter(|(_, variance)| *variance <= most);
            first += size;
            let before = kept.len();
            kept.extend(own);
            found.push(kept.len() - before);
        }
        let (means, variances): (Vec<f64>, Vec<f64>) = kept.into_iter().unzip();
        Informed { within: stats::mean(&variances), means, sizes: found }
    }

    /// Whether it has a figure of its own: no parameter of a group, which is judged instead, and no spring, which repeats its parameter.
    pub fn is_judged(&self) -> bool {
        self.group.is_none() && self.kind != QuantityKind::SpringStiffness
    }

    /// Effective number of its measurements, in batches of these sizes.
    pub fn effective(&self, sizes: &[usize]) -> Effective {
        self.serial.map_or_else(|| Effective::all(sizes.iter().sum()), |serial| serial.effective(sizes))
    }

    /// Sets how its successive measurements are correlated, and widens the population accordingly.
    pub fn correlate(&mut self, serial: Option<Serial>, sizes: &[usize]) {
        self.serial = serial;
        let within = Hyperparameters::from_pool(&self.pool, self.draws).within;
        self.population = self.population.widened(self.effective(sizes), within);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pooled_variance_splits_into_within_and_between() {
        let pool = [1.0, 3.0, 4.0, 6.0, 9.0, 13.0];
        let hyper = Hyperparameters::from_pool(&pool, 2);
        // Means 2, 5, 11; variances about them 1, 1, 4.
        assert!((hyper.within - 2.0).abs() < 1e-12);
        assert!((hyper.between.unwrap() - 21.0).abs() < 1e-12);
        let pooled: f64 = pool.iter().map(|x| (x - 6.0_f64).powi(2)).sum::<f64>() / 6.0;
        assert!((hyper.std.unwrap().powi(2) - pooled * 3.0 / 2.0).abs() < 1e-12);
    }

    #[test]
    fn one_measurement_has_a_mean_but_no_spread() {
        let hyper = Hyperparameters::from_pool(&[4.0, 4.2], 2);
        assert!((hyper.mean - 4.1).abs() < 1e-12 && hyper.std.is_none() && hyper.between.is_none());
    }
}
