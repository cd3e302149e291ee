//! Which parameters the modes of a structure can distinguish at its noise.

use nalgebra::{DMatrix, DVector};

use super::error::InferenceError;
use super::manifest::{IdentifiabilityRecord, ParameterIdentifiability, GROUP_CORRELATION, UNRESOLVED};
use super::model::Baseline;
use super::observation::{measure, measure_shapes, Observation};
use structures::parameter::{Parameter, ParameterSpace};
use structures::physics;
use structures::physics::eigen::transposed_product;
use structures::simulator::{Simulator, TrainingSet};
use structures::stats;

/// Points of the prior at which identifiability is measured.
const POINTS: usize = 200;

/// Posterior draws at each point.
const DRAWS: usize = 60;

/// Measures which parameters one measurement can distinguish, from the Fisher information ([`local_covariance`]) and from
/// the posterior of the flow, averaged over the prior.
///
/// # Errors
/// [`InferenceError`] when a draw is not finite or a simulation fails inside the prior.
pub fn identifiability(baseline: &Baseline, seed: u64) -> Result<IdentifiabilityRecord, InferenceError> {
    let (simulator, space) = (baseline.simulator(), baseline.space());
    let failed = |e: &dyn std::fmt::Display| InferenceError::Simulation(e.to_string());
    let set = simulator.training_set(POINTS, seed).map_err(|e| failed(&e))?;
    let local = |row: usize| {
        let theta: Vec<f64> = set.theta.row(row).iter().copied().collect();
        let exact: Vec<f64> = set.frequencies_hz.row(row).iter().copied().collect();
        local_covariance(&simulator.under(&set.effect_sizes[row]), &theta, &exact)
    };
    let fisher = (0..POINTS).map(local).collect::<Result<Vec<_>, _>>().map_err(|e| failed(&e))?;
    let noisy = baseline.manifest().conditions.noise_range.is_some();
    let observations = observe(simulator, &set, noisy, seed);
    // Without noise the simulation would shrink the draws to points, whose covariance is rounding error.
    let theta = if noisy {
        baseline.infer(&observations, DRAWS, seed)?.theta().clone()
    } else {
        baseline.propose(&observations, DRAWS, seed)?.theta
    };
    let covariance = mean_covariance(&theta, space);
    let d = space.len();
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
            variance_left: (p.box_precision() * covariance[(k, k)]).min(1.0),
            confused_with: partner.map(|j| (space.as_slice()[j].name.clone(), correlation(k, j))),
        }
    });
    let parameters: Vec<ParameterIdentifiability> = parameters.collect();
    let groups = groups(space, |i, j| {
        parameters[i].variance_left > UNRESOLVED
            && parameters[j].variance_left > UNRESOLVED
            && correlation(i, j).abs() > GROUP_CORRELATION
    });
    Ok(IdentifiabilityRecord { parameters, groups })
}

/// One complete measurement of each pair of a training set, with the structure's noise or, if `noisy` is false, without noise.
fn observe(simulator: &Simulator, set: &TrainingSet, noisy: bool, seed: u64) -> Vec<Observation> {
    let mut stream = stats::stream(seed, "identifiability");
    let one = |(row, sizes): (usize, &Vec<f64>)| {
        let exact: Vec<f64> = set.frequencies_hz.row(row).iter().copied().collect();
        if !noisy {
            let noise_multiple = vec![0.0; exact.len()];
            return Observation { noise_multiple, effect_sizes: sizes.clone(), ..Observation::complete(&exact) };
        }
        let mut one = measure(simulator, &exact, sizes, &vec![Some(1.0); exact.len()], &mut stream);
        if let Some(shapes) = set.shapes.get(row) {
            measure_shapes(simulator, &mut one, shapes, &vec![false; exact.len()], &mut stream);
        }
        one
    };
    set.effect_sizes.iter().enumerate().map(one).collect()
}

/// Covariance of the posterior in the unit box, averaged over the points, `[d, d]`. `theta`: `[POINTS·DRAWS, d]`.
fn mean_covariance(theta: &DMatrix<f64>, space: &ParameterSpace) -> DMatrix<f64> {
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
    covariance
}

/// Groups of parameters, by name, that are linked by `confused`. Only parameters of the same unit and direction of damage
/// can form a group.
fn groups(space: &ParameterSpace, confused: impl Fn(usize, usize) -> bool) -> Vec<Vec<String>> {
    let parameters = space.as_slice();
    let alike =
        |i: usize, j: usize| parameters[i].unit == parameters[j].unit && parameters[i].damage == parameters[j].damage;
    let mut group_of: Vec<usize> = (0..parameters.len()).collect();
    for i in 0..parameters.len() {
        for j in 0..i {
            if alike(i, j) && confused(i, j) {
                let (from, to) = (group_of[i], group_of[j]);
                group_of.iter_mut().filter(|g| **g == from).for_each(|g| *g = to);
            }
        }
    }
    let members = |g: usize| -> Vec<String> {
        (0..parameters.len()).filter(|&k| group_of[k] == g).map(|k| parameters[k].name.clone()).collect()
    };
    (0..parameters.len()).map(members).filter(|names| names.len() > 1).collect()
}

/// Covariance of the parameters given one complete measurement at the structure's noise, `[d, d]`, in the unit box of the
/// prior, by the Fisher information; see [`fisher_covariance`]. Mode shapes are included where the structure has
/// instrumented points.
///
/// `theta`: `[d]`, parameter units; `exact_hz`: its frequencies without noise, Hz, `[m]`. A relative noise below 1e-5 is replaced
/// by 1e-5.
///
/// # Errors
/// [`physics::Error`] where the simulation fails.
pub fn local_covariance(
    simulator: &Simulator,
    theta: &[f64],
    exact_hz: &[f64],
) -> Result<DMatrix<f64>, physics::Error> {
    let there = simulator.linearise(theta, simulator.modes(), simulator.shape_points() > 0)?;
    let std_hz = exact_hz.iter().enumerate().map(|(mode, f)| simulator.std_hz(mode, *f).max(1e-5 * f));
    let covariance =
        fisher_covariance(simulator, &there.frequency_slopes, &std_hz.collect::<Vec<_>>(), &there.shape_slopes);
    let of_prior = || DMatrix::from_diagonal(&prior_precision(simulator).map(f64::recip));
    Ok(covariance.unwrap_or_else(of_prior))
}

/// Covariance of the parameters in the unit box of the prior, `[d, d]`, by the Fisher information of one measurement and
/// the variance of the prior.
///
/// ```text
///  C = (Jᵀ R⁻¹ J + P)⁻¹,    J: derivatives of frequencies and shapes by u,   R: variances of their noise
/// ```
///
/// P: diagonal matrix of one over the variance of the prior, 12 for a uniform one.
///
/// `frequency_slopes`: ∂f/∂θ, `[modes, d]`, Hz per parameter unit; `std_hz`: standard deviation of each frequency, Hz, `[modes]`;
/// `shape_slopes`: ∂φ/∂θ of each mode, `[points, d]`, per parameter unit; empty without shapes. Returns `None` only if a value is
/// not finite.
pub fn fisher_covariance(
    simulator: &Simulator,
    frequency_slopes: &DMatrix<f64>,
    std_hz: &[f64],
    shape_slopes: &[DMatrix<f64>],
) -> Option<DMatrix<f64>> {
    let parameters = simulator.space().as_slice();
    let d = parameters.len();
    let width = |k: usize| parameters[k].upper - parameters[k].lower;
    let scaled = DMatrix::from_fn(std_hz.len(), d, |mode, k| frequency_slopes[(mode, k)] * width(k) / std_hz[mode]);
    let mut precision = scaled.transpose() * scaled + DMatrix::from_diagonal(&prior_precision(simulator));
    for slopes in shape_slopes {
        let scaled =
            DMatrix::from_fn(slopes.nrows(), d, |point, k| slopes[(point, k)] * width(k) / simulator.shape_std());
        precision += transposed_product(&scaled, &scaled);
    }
    Some(precision.cholesky()?.inverse())
}

/// One over the variance of the prior of each parameter in the unit box, `[d]`.
fn prior_precision(simulator: &Simulator) -> DVector<f64> {
    DVector::from_iterator(simulator.space().len(), simulator.space().iter().map(Parameter::box_precision))
}
