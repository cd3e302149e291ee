//! The population of a healthy structure, about which its batches are linearised.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use statrs::distribution::{ChiSquared, ContinuousCDF as _};

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

/// Share of normal deviations that the scatter keeps.
const KEPT: f64 = 0.999;

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
    let mut informed: Vec<&BatchMean> = Vec::new();
    // Deviations of single measurements, each with half the variance of a difference where batches have one measurement.
    let (mut off, mut degrees, mut first) = (Vec::new(), 0, 0);
    for batch in batches {
        let own: Vec<&BatchMean> = rows[first..first + batch.len()].iter().filter(informs).collect();
        first += batch.len();
        let sum = own.iter().fold(DVector::zeros(d), |sum, row| sum + &row.mean);
        let centre = sum / own.len().max(1) as f64;
        if own.len() > 1 {
            off.extend(own.iter().map(|row| &row.mean - &centre));
            degrees += own.len() - 1;
        }
        informed.extend(own);
    }
    if batches.iter().all(|batch| batch.len() <= 1) {
        off = informed.windows(2).map(|pair| (&pair[1].mean - &pair[0].mean) * 0.5_f64.sqrt()).collect();
        degrees = off.len();
    }
    if degrees < FEWEST_DEGREES {
        return Some(DMatrix::zeros(d, d));
    }
    let noise = informed.iter().fold(DMatrix::zeros(d, d), |sum, row| sum + &row.covariance) / informed.len() as f64;
    let observed = without_outliers(&off) * (off.len() as f64 / degrees as f64);
    let mut eigen = (observed - noise).symmetric_eigen();
    eigen.eigenvalues.apply(|value| *value = value.max(0.0));
    Some(eigen.recompose())
}

/// Mean of the products of some deviations, `[d, d]`, without those that lie far from all others: measurements with a wrong frequency.
///
/// ```text
///  first those with |x_k| < 3 · 1.4826 median |x_k| for all k, then three times those with xᵀ C⁻¹ x below the quantile of χ²_d
/// ```
///
/// The quantile is so high that the covariance of normal deviations loses less than 1 %.
fn without_outliers(off: &[DVector<f64>]) -> DMatrix<f64> {
    let d = off.first().map_or(0, DVector::len);
    let mean_of = |kept: &[&DVector<f64>]| {
        let mut sum = DMatrix::zeros(d, d);
        for x in kept {
            sum.ger(1.0, x, x, 1.0);
        }
        sum / kept.len().max(1) as f64
    };
    let largest = |k: usize| {
        let sizes: Vec<f64> = off.iter().map(|x| x[k].abs()).collect();
        3.0 * 1.4826 * stats::quantile(&sizes, 0.5)
    };
    let largest: Vec<f64> = (0..d).map(largest).collect();
    let near: Vec<&DVector<f64>> = off.iter().filter(|x| (0..d).all(|k| x[k].abs() <= largest[k])).collect();
    let mut covariance = mean_of(&near);
    let quantile = ChiSquared::new(d as f64).map_or(f64::INFINITY, |chi| chi.inverse_cdf(KEPT));
    for _ in 0..3 {
        let Some(factor) = covariance.clone().cholesky() else { return mean_of(&off.iter().collect::<Vec<_>>()) };
        let kept: Vec<&DVector<f64>> = off.iter().filter(|x| x.dot(&factor.solve(x)) <= quantile).collect();
        covariance = mean_of(&kept);
    }
    covariance
}
