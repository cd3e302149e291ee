//! What the simulation leaves unexplained of a batch, set against what noise alone would leave.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use statrs::distribution::{ChiSquared, ContinuousCDF as _};

use super::{too_many, Code, Effect, Finding};
use crate::baseline::nearest::{nearest, Nearest};
use crate::baseline::observation::Observation;
use crate::physics;
use crate::simulator::Simulator;

/// Share of healthy batches that are rejected.
pub const LEVEL: f64 = 0.01;

/// Share of healthy batches in which some measurement counts as not reached.
const SINGLE_LEVEL: f64 = 0.001;

/// Relative misfit beyond which a measurement that no parameters give is an outlier and no neighbour of the prior.
const GROSS: f64 = 0.05;

/// How well the simulation reproduces the measurements of a batch.
#[derive(Debug, Clone)]
pub struct Fit {
    /// Nearest point of the prior box for each measurement.
    pub nearest: Vec<Nearest>,
    /// Measurements that no parameters of the prior give within the noise, but nearly.
    pub outside: Vec<usize>,
    /// Measurements far from anything the simulation gives.
    pub gross: Vec<usize>,
    /// Probability of a misfit at least this large; `None` without degrees of freedom.
    pub p_value: Option<f64>,
    /// √(χ²/degrees of freedom).
    pub distance: Option<f64>,
    /// Degrees of freedom over the measurements that are reached.
    pub degrees_of_freedom: usize,
}

/// Looks for each measurement in the prior box, beginning at `starts`.
///
/// ```text
///  T = Σ_j min_x Σ_i r_ij²,   r_ij = (ln f_ij − ln f_i(x))/s_ij,   p_T = P(χ²_ν ≥ T),   ν = Σ_j (modes − free parameters)
///  M = Rᵀ P⁺ R,   R = Σ_j r_j,   P = Σ_j P_j,   p_M = P(χ²_rank ≥ M),      p = 2·min(p_T, p_M)
/// ```
///
/// T sees measurements that do not fit, each in its own way; M, with the projectors P_j on what the parameters cannot absorb,
/// sees a mode that is off by the same little in all of them.
///
/// A measurement whose own p falls below 0.001/n does not enter T: it is named instead, so that one bad record does not
/// take the others with it. Nor do measurements with no more modes than parameters, which leave something over only at an
/// edge of the prior.
///
/// # Errors
/// [`physics::Error`], which a checked prior rules out.
pub fn fit(simulator: &Simulator, observations: &[Observation], starts: &[Vec<f64>]) -> Result<Fit, physics::Error> {
    let look = |(observation, start): (&Observation, &Vec<f64>)| nearest(simulator, observation, start);
    let nearest = observations.par_iter().zip(starts).map(look).collect::<Result<Vec<_>, _>>()?;
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
    Ok(Fit {
        nearest,
        outside,
        gross,
        p_value: testable.then(|| {
            let each = upper_tail(chi_squared, degrees_of_freedom);
            (2.0 * each.min(common_misfit(&sum, covariance))).min(1.0)
        }),
        distance: testable.then(|| (chi_squared / degrees_of_freedom as f64).sqrt()),
        degrees_of_freedom,
    })
}

impl Fit {
    /// Whether the batch as a whole is something the simulation produces.
    pub fn rejected(&self) -> bool {
        let bad = self.outside.len() + self.gross.len();
        self.p_value.is_some_and(|p| p < LEVEL) || too_many(bad, self.nearest.len())
    }

    /// What the fit says, in findings; `indices` are those of the measurements in their batch.
    pub fn findings(&self, simulator: &Simulator, indices: &[usize]) -> Vec<Finding> {
        let mut findings = Vec::new();
        let count = self.nearest.len();
        let named = |rows: &[usize]| -> Vec<usize> { rows.iter().map(|&row| indices[row]).collect() };
        if self.rejected() {
            let bad = self.outside.len() + self.gross.len();
            let message = if too_many(bad, count) {
                format!("{bad} of {count} measurements cannot come from this simulation with any parameters of the prior: units, modes or the simulation are wrong")
            } else {
                format!(
                    "what the simulation leaves unexplained is {:.2} times the noise (p = {:.1e}): it does not fit these measurements{}",
                    self.distance.unwrap_or_default(),
                    self.p_value.unwrap_or_default(),
                    self.worst_mode()
                )
            };
            findings.push(Finding::new(Code::SimulationDoesNotFit, Effect::Reject, message));
        }
        if !self.gross.is_empty() {
            let message = format!(
                "{} of {count} measurements are outliers and left out: no parameters of the prior come within {:.0} % of them",
                self.gross.len(),
                100.0 * GROSS
            );
            findings.push(Finding::new(Code::Outlier, Effect::Note, message).of(named(&self.gross)));
        }
        if !self.outside.is_empty() {
            let message = format!(
                "{} of {count} measurements lie beyond the prior; they count as its nearest point. Widen the prior if the \
                 structure can be there",
                self.outside.len()
            );
            findings.push(Finding::new(Code::OutsidePrior, Effect::Note, message).of(named(&self.outside)));
        }
        if self.p_value.is_none() && !self.rejected() {
            let message = format!(
                "{} modes against {} parameters: the parameters can absorb nearly any measurement, so that only what \
                 leaves the prior shows as a misfit",
                simulator.modes(),
                simulator.space().len()
            );
            findings.push(Finding::new(Code::FitNotTestable, Effect::Note, message));
        }
        findings
    }

    /// The mode that is off the same way in most measurements, in words.
    fn worst_mode(&self) -> String {
        let modes = self.nearest.first().map_or(0, |n| n.standardised_residuals.len());
        let mean = |mode: usize| {
            let sum: f64 = self.nearest.iter().map(|n| n.standardised_residuals[mode]).sum();
            let variance: f64 = self.nearest.iter().map(|n| n.projector[(mode, mode)]).sum();
            (mode, if variance > 0.01 { sum / variance.sqrt() } else { 0.0 })
        };
        let worst = (0..modes).map(mean).max_by(|a, b| a.1.abs().total_cmp(&b.1.abs()));
        worst.filter(|(_, z)| z.abs() > 3.0).map_or_else(String::new, |(mode, z)| {
            format!("; mode {} is {} the simulation's", mode + 1, if z > 0.0 { "above" } else { "below" })
        })
    }
}

/// p-value of a misfit that is the same in all measurements: residuals summed, against the sum of their covariances.
fn common_misfit(sum: &DVector<f64>, covariance: DMatrix<f64>) -> f64 {
    let largest = covariance.diagonal().max();
    let eigen = covariance.symmetric_eigen();
    let (mut statistic, mut rank) = (0.0, 0);
    for (value, direction) in eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()) {
        // Directions in which only some measurements have anything left over are no common ones.
        if *value > 0.3 * largest {
            statistic += direction.dot(sum).powi(2) / value;
            rank += 1;
        }
    }
    upper_tail(statistic, rank)
}

/// P(χ²_ν ≥ x); 1 without degrees of freedom.
fn upper_tail(x: f64, degrees_of_freedom: usize) -> f64 {
    ChiSquared::new(degrees_of_freedom as f64).map_or(1.0, |distribution| distribution.sf(x))
}
