//! Which parameters the modes of a structure can tell apart, at its noise.

use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};

use super::observation::{measure, measure_shapes, Observation};
use super::{Baseline, InferenceError};
use crate::physics::eigen::transposed_product;
use crate::simulator::Simulator;
use crate::stats;

/// Points of the prior that are looked at.
const POINTS: usize = 200;

/// Posterior draws at each.
const DRAWS: usize = 60;

/// Correlation of two parameters, over posteriors of measurements from the whole prior, beyond which they form a group.
const GROUP_CORRELATION: f64 = 0.8;

/// Share of the prior variance that must remain of a parameter before it can be grouped: one that is known well needs no
/// group, whatever its correlation.
const UNRESOLVED: f64 = 0.02;

/// What the modes say of each parameter of one complete measurement at the structure's noise; part of the manifest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IdentifiabilityRecord {
    /// One entry a parameter.
    pub parameters: Vec<ParameterIdentifiability>,
    /// Groups of parameters that cannot be told apart, by name: their damage is told for the group.
    pub groups: Vec<Vec<String>>,
}

/// What one measurement says of one parameter, over the prior.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ParameterIdentifiability {
    /// Name of the parameter.
    pub name: String,
    /// Median standard deviation by the local Fisher information with the prior, in the parameter's unit.
    pub fisher_std: f64,
    /// Root mean posterior variance of the flow, in the parameter's unit: more than `fisher_std` where several distant
    /// points give the same frequencies.
    pub posterior_std: f64,
    /// Share of the prior variance that one measurement leaves, by the flow: 0 known, 1 unknown.
    pub variance_left: f64,
    /// The parameter that it is confused with most, and their correlation.
    pub confused_with: Option<(String, f64)>,
}

/// A group of parameters that the modes cannot tell apart.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Group {
    /// `group:` and the names, joined by `+`.
    pub name: String,
    /// Their columns.
    pub columns: Vec<usize>,
}

/// Measures what can be told apart, from the Fisher information and from the flow's posterior.
///
/// ```text
///  F = Jᵀ R⁻¹ J,    J = ∂ ln f/∂u, ∂φ/∂u over the prior's width,    C = (F + 12·1)⁻¹    (1/12: variance of a uniform prior)
/// ```
///
/// # Errors
/// [`InferenceError`] when a draw is not finite or a simulation fails inside the prior.
pub fn identifiability(baseline: &Baseline, seed: u64) -> Result<IdentifiabilityRecord, InferenceError> {
    let simulator = baseline.simulator();
    let space = baseline.space();
    let failed = |e: &dyn std::fmt::Display| InferenceError::Simulation(e.to_string());
    let set = simulator.training_set(POINTS, seed).map_err(|e| failed(&e))?;
    let mut stream = stats::stream(seed, "identifiability");
    let (mut fisher, mut observations) = (Vec::new(), Vec::new());
    for row in 0..POINTS {
        let theta: Vec<f64> = set.theta.row(row).iter().copied().collect();
        let exact: Vec<f64> = set.frequencies_hz.row(row).iter().copied().collect();
        let sizes = &set.effect_sizes[row];
        let there = simulator.under(sizes);
        fisher.push(local_covariance(&there, &theta, &exact).map_err(|e| failed(&e))?);
        observations.push(match baseline.manifest().conditions.noise_range {
            Some(_) => {
                let mut one = measure(simulator, &exact, sizes, &vec![Some(1.0); exact.len()], &mut stream);
                if let Some(shapes) = set.shapes.get(row) {
                    measure_shapes(simulator, &mut one, shapes, &vec![false; exact.len()], &mut stream);
                }
                one
            }
            None => Observation {
                noise_multiple: vec![0.0; exact.len()],
                effect_sizes: sizes.clone(),
                ..Observation::complete(&exact)
            },
        });
    }
    // Without noise the simulation makes points of the draws, which would leave rounding errors to be told apart.
    let theta = match baseline.manifest().conditions.noise_range {
        Some(_) => baseline.infer(&observations, DRAWS, seed)?.theta().clone(),
        None => baseline.propose(&observations, DRAWS, seed)?.theta,
    };
    let d = space.len();
    let unit = |row: usize, column: usize| space.as_slice()[column].to_unit(theta[(row, column)]);
    let mut covariance = DMatrix::<f64>::zeros(d, d);
    for point in 0..POINTS {
        let rows = point * DRAWS..(point + 1) * DRAWS;
        let mean: Vec<f64> = (0..d).map(|k| rows.clone().map(|row| unit(row, k)).sum::<f64>() / DRAWS as f64).collect();
        for row in rows {
            for i in 0..d {
                for j in 0..d {
                    covariance[(i, j)] +=
                        (unit(row, i) - mean[i]) * (unit(row, j) - mean[j]) / (POINTS * (DRAWS - 1)) as f64;
                }
            }
        }
    }
    let correlation =
        |i: usize, j: usize| covariance[(i, j)] / (covariance[(i, i)] * covariance[(j, j)]).sqrt().max(1e-300);
    let parameters = space.iter().enumerate().map(|(k, p)| {
        let width = p.upper - p.lower;
        let local: Vec<f64> = fisher.iter().map(|c| c[(k, k)].sqrt() * width).collect();
        let partner =
            (0..d).filter(|&j| j != k).max_by(|&a, &b| correlation(k, a).abs().total_cmp(&correlation(k, b).abs()));
        ParameterIdentifiability {
            name: p.name.clone(),
            fisher_std: stats::quantile(&local, 0.5),
            posterior_std: covariance[(k, k)].sqrt() * width,
            variance_left: (12.0 * covariance[(k, k)]).min(1.0),
            confused_with: partner.map(|j| (space.as_slice()[j].name.clone(), correlation(k, j))),
        }
    });
    let parameters: Vec<ParameterIdentifiability> = parameters.collect();
    let together = |i: usize, j: usize| {
        let alike = space.as_slice()[i].unit == space.as_slice()[j].unit
            && space.as_slice()[i].damage == space.as_slice()[j].damage;
        alike
            && parameters[i].variance_left > UNRESOLVED
            && parameters[j].variance_left > UNRESOLVED
            && correlation(i, j).abs() > GROUP_CORRELATION
    };
    let mut group_of: Vec<usize> = (0..d).collect();
    for i in 0..d {
        for j in 0..i {
            if together(i, j) {
                let (from, to) = (group_of[i], group_of[j]);
                group_of.iter_mut().filter(|g| **g == from).for_each(|g| *g = to);
            }
        }
    }
    let members = |g: usize| -> Vec<String> {
        (0..d).filter(|&k| group_of[k] == g).map(|k| space.as_slice()[k].name.clone()).collect()
    };
    let groups = (0..d).map(members).filter(|names| names.len() > 1).collect();
    Ok(IdentifiabilityRecord { parameters, groups })
}

/// Covariance of one measurement's parameters in the unit box, by the Fisher information and the prior's variance.
///
/// # Errors
/// [`crate::physics::Error`] where the simulation fails.
pub fn local_covariance(
    simulator: &Simulator,
    theta: &[f64],
    exact_hz: &[f64],
) -> Result<DMatrix<f64>, crate::physics::Error> {
    let there = simulator.linearise(theta, simulator.modes(), simulator.shape_points() > 0)?;
    let parameters = simulator.space().as_slice();
    let width = |k: usize| parameters[k].upper - parameters[k].lower;
    let scaled = DMatrix::from_fn(exact_hz.len(), parameters.len(), |mode, k| {
        // A structure without noise is looked at with that of a very good test.
        let std_hz = simulator.std_hz(mode, exact_hz[mode]).max(1e-5 * exact_hz[mode]);
        there.frequency_slopes[(mode, k)] * width(k) / std_hz
    });
    let d = parameters.len();
    let mut precision = scaled.transpose() * scaled + DMatrix::identity(d, d) * 12.0;
    for slopes in there.shape_slopes {
        let scaled =
            DMatrix::from_fn(slopes.nrows(), d, |point, k| slopes[(point, k)] * width(k) / simulator.shape_std());
        precision += transposed_product(&scaled, &scaled);
    }
    Ok(precision.cholesky().map_or_else(|| DMatrix::identity(d, d) / 12.0, |c| c.inverse()))
}

impl ParameterIdentifiability {
    /// True when one measurement leaves much of it open, because it cannot be told from another.
    pub fn is_confused(&self) -> bool {
        let strongly = |(_, correlation): &(String, f64)| correlation.abs() > GROUP_CORRELATION;
        self.variance_left > UNRESOLVED && self.confused_with.as_ref().is_some_and(strongly)
    }
}

impl IdentifiabilityRecord {
    /// The groups with their columns in the space of `baseline`.
    pub fn resolve(&self, space: &crate::parameter::ParameterSpace) -> Vec<Group> {
        let group = |names: &Vec<String>| Group {
            name: format!("group:{}", names.join("+")),
            columns: names.iter().filter_map(|name| space.position(name)).collect(),
        };
        self.groups.iter().map(group).filter(|group| group.columns.len() > 1).collect()
    }
}
