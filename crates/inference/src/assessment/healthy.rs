//! The population of a healthy structure, about which its batches are linearised.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::batch_mean::{batch_mean, BatchMean, Healthy};
use crate::baseline::observation::Observation;
use crate::baseline::Baseline;
use crate::damage::UndamagedReference;
use structures::parameter::{Parameter, ParameterSpace};
use structures::stats;

/// Fewest degrees of freedom from which the scatter of single measurements is known.
const FEWEST_DEGREES: usize = 10;

/// A measurement is left out of the scatter if the variance of its estimate exceeds this multiple of the median: it lacks a mode.
const MOST_VARIANCE: f64 = 4.0;

impl Healthy {
    /// A structure of which only the prior is known.
    pub fn unknown(space: &ParameterSpace) -> Self {
        let d = space.len();
        Self { centre: space.iter().map(Parameter::prior_median).collect(), scatter: DMatrix::zeros(d, d) }
    }

    /// The healthy structure behind the batches of a reference, `batches`, each in the order of time and the batches as well; `None` where
    /// [`batch_mean`] is not computed.
    pub fn of_batches(baseline: &Baseline, batches: &[&[Observation]]) -> Option<Self> {
        let d = baseline.space().len();
        let unknown = Self::unknown(baseline.space());
        let mean = |batch: &&[Observation]| batch_mean(baseline, batch, &unknown);
        let means: Vec<BatchMean> = batches.par_iter().map(mean).collect::<Option<_>>()?;
        let median = |k: usize| stats::quantile(&means.iter().map(|found| found.mean[k]).collect::<Vec<_>>(), 0.5);
        let centre: Vec<f64> = if means.is_empty() { return None } else { (0..d).map(median).collect() };
        let scatter = scatter(baseline, batches, &centre)?;
        Some(Self { centre, scatter })
    }

    /// The healthy structure of a reference; `None` where a parameter is not in it.
    pub fn of_reference(baseline: &Baseline, undamaged: &UndamagedReference) -> Option<Self> {
        let quantity = |p: &Parameter| undamaged.quantities.iter().find(|q| q.name == p.name);
        let own = baseline.space().iter().map(quantity).collect::<Option<Vec<_>>>()?;
        let d = own.len();
        let stored = undamaged.process.as_ref().map(|process| process.scatter.as_slice()).filter(|s| s.len() == d * d);
        // A reference without a process states variances only.
        let variance = |k: usize| (own[k].reference.std.powi(2) - own[k].reference.within).max(0.0);
        let variances = || DMatrix::from_fn(d, d, |i, j| if i == j { variance(i) } else { 0.0 });
        Some(Self {
            centre: own.iter().map(|quantity| quantity.mean).collect(),
            scatter: stored.map_or_else(variances, |stored| DMatrix::from_column_slice(d, d, stored)),
        })
    }
}

/// The covariance S of single measurements about the mean of their batch, without their noise, `[d, d]` in parameter units; `None` where
/// [`batch_mean`] is not computed. `batches`: their measurements, each in the order of time; `centre`: a point near their mean, `[d]`.
///
/// ```text
///  S = 1/Σ_b (n_b − 1) Σ_bn (x_bn − x̄_b)(x_bn − x̄_b)ᵀ − W̄,    negative eigenvalues set to 0
/// ```
///
/// x_bn, W_bn: estimate of one measurement and its covariance; W̄: their mean. Where all batches have one measurement, half of the mean square
/// of the differences between successive ones takes the place of the first term, because it does not contain a season. 0 where too few
/// measurements show it.
///
/// Source of the latter: J. von Neumann, R. H. Kent, H. R. Bellinson, B. I. Hart (1941), The mean square successive difference, Annals of
/// Mathematical Statistics 12, 153–162.
fn scatter(baseline: &Baseline, batches: &[&[Observation]], centre: &[f64]) -> Option<DMatrix<f64>> {
    let d = baseline.space().len();
    let exact = Healthy { centre: centre.to_vec(), scatter: DMatrix::zeros(d, d) };
    let rows: Vec<&Observation> = batches.iter().flat_map(|batch| batch.iter()).collect();
    let single = |row: &&Observation| batch_mean(baseline, std::slice::from_ref(*row), &exact);
    let rows: Vec<BatchMean> = rows.par_iter().map(single).collect::<Option<_>>()?;
    let median = |k: usize| {
        let variances: Vec<f64> = rows.iter().map(|row| row.covariance[(k, k)]).collect();
        stats::quantile(&variances, 0.5)
    };
    let most: Vec<f64> = (0..d).map(|k| MOST_VARIANCE * median(k)).collect();
    let informs = |row: &&BatchMean| (0..d).all(|k| row.covariance[(k, k)] <= most[k]);
    let (mut square, mut degrees, mut first) = (DMatrix::zeros(d, d), 0, 0);
    let mut informed: Vec<&BatchMean> = Vec::new();
    for batch in batches {
        let own: Vec<&BatchMean> = rows[first..first + batch.len()].iter().filter(informs).collect();
        first += batch.len();
        let sum = own.iter().fold(DVector::zeros(d), |sum, row| sum + &row.mean);
        let centre = sum / own.len().max(1) as f64;
        for row in &own {
            let off = &row.mean - &centre;
            square.ger(1.0, &off, &off, 1.0);
        }
        degrees += own.len().saturating_sub(1);
        informed.extend(own);
    }
    if batches.iter().all(|batch| batch.len() <= 1) {
        square.fill(0.0);
        for pair in informed.windows(2) {
            let off = &pair[1].mean - &pair[0].mean;
            square.ger(0.5, &off, &off, 1.0);
        }
        degrees = informed.len().saturating_sub(1);
    }
    if degrees < FEWEST_DEGREES {
        return Some(DMatrix::zeros(d, d));
    }
    let noise = informed.iter().fold(DMatrix::zeros(d, d), |sum, row| sum + &row.covariance) / informed.len() as f64;
    let mut eigen = (square / degrees as f64 - noise).symmetric_eigen();
    eigen.eigenvalues.apply(|value| *value = value.max(0.0));
    Some(eigen.recompose())
}
