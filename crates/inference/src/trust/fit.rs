//! Test of fit: compares the residuals of the simulation for a batch with those that noise alone would cause.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use statrs::distribution::{ChiSquared, ContinuousCDF as _};

use super::finding::{too_many, Finding, FindingCode, FindingEffect};
use crate::baseline::nearest::{nearest, Nearest};
use crate::baseline::observation::Observation;
use structures::physics;
use structures::simulator::Simulator;
use structures::stats;

/// Significance level: share of healthy batches that are rejected.
pub const LEVEL: f64 = 0.01;

/// Share of healthy batches in which some measurement is reported as beyond the prior.
const SINGLE_LEVEL: f64 = 0.001;

/// Relative misfit above which a measurement that no parameters reproduce is an outlier, rather than close to the prior.
const GROSS: f64 = 0.05;

/// T/ν and M/rank of [`fit`]: 1 on average where the simulation fits.
pub type Misfit = [f64; 2];

/// How well the simulation reproduces the measurements of a batch.
#[derive(Debug, Clone)]
pub struct Fit {
    /// Nearest point of the prior box for each measurement.
    pub nearest: Vec<Nearest>,
    /// Rows of measurements slightly beyond the prior: no parameters reproduce them within the noise, but nearly.
    pub outside: Vec<usize>,
    /// Rows of measurements far from anything the simulation gives.
    pub gross: Vec<usize>,
    /// Probability of a misfit at least this large; `None` without degrees of freedom.
    pub p_value: Option<f64>,
    /// √(χ²/degrees of freedom); `None` without degrees of freedom.
    pub distance: Option<f64>,
    /// Degrees of freedom, summed over the measurements within the prior.
    pub degrees_of_freedom: usize,
    /// T and M of [`fit`] with their degrees of freedom.
    statistics: [(f64, usize); 2],
}

/// Finds the nearest point of the prior box for each measurement, starting at `starts`, `[n][d]`, and tests the residuals.
///
/// ```text
///  T = Σ_j min_x Σ_i r_ij²,   r_ij = (ln f_ij − ln f_i(x))/s_ij,   p_T = P(χ²_ν ≥ T),   ν = Σ_j (modes − free parameters)
///  M = Rᵀ P⁺ R,   R = Σ_j r_j,   P = Σ_j P_j,   p_M = P(χ²_rank ≥ M),      p = 2·min(p_T, p_M)
/// ```
///
/// T detects misfits that differ between the measurements. M detects a small misfit of a mode that is the same in all measurements;
/// P_j is the projector on the residuals that the parameters cannot absorb.
///
/// A measurement with a p-value below 0.001/n does not enter T but is reported, so that one bad record does not reject the others.
/// Measurements with no more modes than parameters do not enter T either: they have residuals only at a bound of the prior.
///
/// # Errors
/// [`physics::Error`], which does not occur inside a checked prior.
pub fn fit(simulator: &Simulator, observations: &[Observation], starts: &[Vec<f64>]) -> Result<Fit, physics::Error> {
    let search = |(observation, start): (&Observation, &Vec<f64>)| nearest(simulator, observation, start);
    let nearest = observations.par_iter().zip(starts).map(search).collect::<Result<Vec<_>, _>>()?;
    let (mut outside, mut gross) = (Vec::new(), Vec::new());
    let (mut chi_squared, mut degrees_of_freedom) = (0.0, 0);
    let modes = simulator.modes();
    let (mut sum, mut covariance) = (DVector::zeros(modes), DMatrix::zeros(modes, modes));
    for (row, (point, observation)) in nearest.iter().zip(observations).enumerate() {
        if upper_tail(point.chi_squared, point.degrees_of_freedom) < SINGLE_LEVEL / observations.len() as f64 {
            let misfit =
                |(mode, f): (usize, &Option<f64>)| f.map_or(0.0, |f| (f / point.frequencies_hz[mode]).ln().abs());
            let largest = observation.frequencies_hz.iter().enumerate().map(misfit).fold(0.0, f64::max);
            if largest > GROSS { &mut gross } else { &mut outside }.push(row);
        } else if observation.has_shapes() || observation.modes_present() > simulator.space().len() {
            chi_squared += point.chi_squared;
            degrees_of_freedom += point.degrees_of_freedom;
            sum += &point.standardised_residuals;
            covariance += &point.projector;
        }
    }
    let testable = degrees_of_freedom > 0;
    let statistics = [(chi_squared, degrees_of_freedom), common_misfit(&sum, covariance)];
    Ok(Fit {
        nearest,
        outside,
        gross,
        p_value: testable.then(|| p_value(statistics)),
        distance: testable.then(|| (chi_squared / degrees_of_freedom as f64).sqrt()),
        degrees_of_freedom,
        statistics,
    })
}

/// p = 2·min(p_T, p_M) of both statistics with their degrees of freedom.
fn p_value(statistics: [(f64, usize); 2]) -> f64 {
    let least = statistics.map(|(statistic, degrees)| upper_tail(statistic, degrees)).into_iter().fold(1.0, f64::min);
    (2.0 * least).min(1.0)
}

impl Fit {
    /// True when the simulation cannot have produced the batch as a whole.
    pub fn rejected(&self) -> bool {
        let bad = self.outside.len() + self.gross.len();
        self.p_value.is_some_and(|p| p < LEVEL) || too_many(bad, self.nearest.len())
    }

    /// Both statistics divided by their degrees of freedom: 1 on average where the simulation fits; `None` where nothing can be tested.
    pub fn misfit(&self) -> Option<Misfit> {
        self.p_value?;
        Some(self.statistics.map(|(statistic, degrees)| statistic / degrees.max(1) as f64))
    }

    /// As [`Self::rejected`], for a simulation that is known to deviate as much as `usual`.
    pub fn rejected_beside(&self, usual: Misfit) -> bool {
        let mut scaled = self.statistics;
        for ((statistic, _), usual) in scaled.iter_mut().zip(usual) {
            *statistic /= usual.max(1.0);
        }
        let bad = self.outside.len() + self.gross.len();
        self.p_value.is_some() && p_value(scaled) < LEVEL || too_many(bad, self.nearest.len())
    }

    /// The findings of the test; `indices` are the indices of the tested measurements in their batch.
    pub fn findings(&self, simulator: &Simulator, indices: &[usize]) -> Vec<Finding> {
        let mut findings = Vec::new();
        let count = self.nearest.len();
        let named = |rows: &[usize]| -> Vec<usize> { rows.iter().map(|&row| indices[row]).collect() };
        if self.rejected() {
            let bad = self.outside.len() + self.gross.len();
            let message = if too_many(bad, count) {
                format!(
                    "{bad} of {count} measurements cannot be reproduced by the simulation with any parameters of the prior: the \
                     units, the order of the modes or the simulation may be wrong"
                )
            } else {
                format!(
                    "the simulation does not fit these measurements: its residuals are {:.2} times the noise ({}){}",
                    self.distance.unwrap_or_default(),
                    stats::by_chance(self.p_value.unwrap_or_default()),
                    self.worst_mode()
                )
            };
            findings.push(Finding::new(FindingCode::SimulationDoesNotFit, FindingEffect::Reject, message));
        }
        if !self.gross.is_empty() {
            let message = format!(
                "{} of {count} measurements are outliers and are left out: no parameters of the prior come within {:.0} % of them",
                self.gross.len(),
                100.0 * GROSS
            );
            findings.push(Finding::new(FindingCode::Outlier, FindingEffect::Note, message).of(named(&self.gross)));
        }
        if !self.outside.is_empty() {
            let message = format!(
                "{} of {count} measurements lie beyond the prior, and its nearest point is used for them: widen the prior if the \
                 structure can have such parameters",
                self.outside.len()
            );
            findings
                .push(Finding::new(FindingCode::OutsidePrior, FindingEffect::Note, message).of(named(&self.outside)));
        }
        if self.p_value.is_none() && !self.rejected() {
            let message = format!(
                "whether the simulation fits cannot be tested: with {} modes, {} parameters can be chosen so that nearly every measurement is \
                 matched. Only measurements beyond the prior show a misfit; more modes or fewer parameters would allow the test",
                simulator.modes(),
                simulator.space().len()
            );
            findings.push(Finding::new(FindingCode::FitNotTestable, FindingEffect::Note, message));
        }
        findings
    }

    /// The mode with the largest misfit common to the measurements, in words; empty when none is significant.
    fn worst_mode(&self) -> String {
        let modes = self.nearest.first().map_or(0, |n| n.standardised_residuals.len());
        let mean = |mode: usize| {
            let sum: f64 = self.nearest.iter().map(|n| n.standardised_residuals[mode]).sum();
            let variance: f64 = self.nearest.iter().map(|n| n.projector[(mode, mode)]).sum();
            (mode, if variance > 0.01 { sum / variance.sqrt() } else { 0.0 })
        };
        let worst = (0..modes).map(mean).max_by(|a, b| a.1.abs().total_cmp(&b.1.abs()));
        worst.filter(|(_, z)| z.abs() > 3.0).map_or_else(String::new, |(mode, z)| {
            let side = if z > 0.0 { "above" } else { "below" };
            format!("; mode {} lies {side} the simulated one", mode + 1)
        })
    }
}

/// Statistic of a misfit common to all measurements, with its degrees of freedom: the sum of the residuals against the sum of their
/// covariances.
fn common_misfit(sum: &DVector<f64>, covariance: DMatrix<f64>) -> (f64, usize) {
    let largest = covariance.diagonal().max();
    let eigen = covariance.symmetric_eigen();
    let (mut statistic, mut rank) = (0.0, 0);
    for (value, direction) in eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()) {
        // Directions in which only some measurements have residuals are not common to all.
        if *value > 0.3 * largest {
            statistic += direction.dot(sum).powi(2) / value;
            rank += 1;
        }
    }
    (statistic, rank)
}

/// P(χ²_ν ≥ x); 1 without degrees of freedom.
fn upper_tail(x: f64, degrees_of_freedom: usize) -> f64 {
    ChiSquared::new(degrees_of_freedom as f64).map_or(1.0, |distribution| distribution.sf(x))
}
