//! The parameters of the prior box that come nearest to a measurement, and how near they come.

use nalgebra::{DMatrix, DVector};

use super::observation::Observation;
use super::start::{locate, Located};
use crate::physics;
use crate::simulator::Simulator;

/// Standard deviation below which a relative residual is not resolved: what is left of a search that has converged.
const RESOLUTION: f64 = 2.5e-5;

/// A measurement with no more modes than parameters counts as reached, without a search, where the posterior mean comes
/// this near (relative) beyond its noise: a trained flow is that exact, and a box edge shows as far more.
const FLOW_ACCURACY: f64 = 0.003;

/// Standard deviations of the noise that a direction of the prior box must move the frequencies by, over its whole width,
/// to count as absorbing a degree of freedom: a weaker one bends before it has absorbed anything.
const ABSORBING: f64 = 6.0;

/// Noise, as a multiple of its standard deviation, that is no sign of being outside: one in 16,000 frequencies.
const NOISE_MULTIPLE: f64 = 4.0;

const ITERATIONS: usize = 40;

/// The point of the prior box nearest to a measurement.
#[derive(Debug, Clone, PartialEq)]
pub struct Nearest {
    /// Its frequencies, all modes, Hz.
    pub frequencies_hz: Vec<f64>,
    /// Σ over the modes present of ((ln f_i − ln f_i(x))/s_i)², s_i the relative standard deviation of the noise.
    pub chi_squared: f64,
    /// Modes present less the directions in which parameters, not at an edge of the box, absorb noise: what `chi_squared` is
    /// compared with.
    pub degrees_of_freedom: usize,
    /// (ln f_i − ln f_i(x))/s_i of each mode, 0 where it is missing.
    pub standardised_residuals: DVector<f64>,
    /// Covariance of these residuals where the noise is all there is, `[m, m]`: the projector on what the parameters cannot
    /// absorb.
    pub projector: DMatrix<f64>,
}

/// The nearest point where mode shapes are measured too: the fit that the flow starts at. Its residuals are of both kinds, and
/// are judged for each measurement by their sum alone.
fn of_fit(fit: Located, modes: usize) -> Nearest {
    Nearest {
        frequencies_hz: fit.frequencies_hz,
        chi_squared: fit.chi_squared,
        degrees_of_freedom: fit.degrees_of_freedom.round() as usize,
        standardised_residuals: DVector::zeros(modes),
        projector: DMatrix::zeros(modes, modes),
    }
}

/// Looks for the nearest point of the prior box, beginning at `start` (`[d]`, parameter units).
///
/// ```text
///  minimise Σ_i ( (ln f_i − ln f_i(x))/s_i )²   over the prior box, by projected Levenberg–Marquardt
/// ```
///
/// The minimum over a linear model with normal noise is χ²-distributed with as many degrees of freedom as there are modes
/// beyond the parameters that are free at the minimum; if the truth lies inside the box it is at most that.
///
/// # Errors
/// [`physics::Error`], which a checked prior rules out.
pub fn nearest(simulator: &Simulator, observation: &Observation, start: &[f64]) -> Result<Nearest, physics::Error> {
    if observation.has_shapes() {
        locate(simulator, observation).map(|fit| of_fit(fit, simulator.modes()))
    } else {
        nearest_by_frequencies(simulator, observation, start)
    }
}

fn nearest_by_frequencies(
    simulator: &Simulator,
    observation: &Observation,
    start: &[f64],
) -> Result<Nearest, physics::Error> {
    let simulator = &observation.simulator(simulator);
    let parameters = simulator.space().as_slice();
    let present: Vec<usize> = (0..simulator.modes()).filter(|&i| observation.frequencies_hz[i].is_some()).collect();
    let measured = |mode: usize| observation.frequencies_hz[mode].expect("only present modes are asked for");
    let relative_std: Vec<f64> = present
        .iter()
        .map(|&mode| observation.std_hz(simulator, mode).map_or(1.0, |std| std / measured(mode)).max(RESOLUTION))
        .collect();
    let theta = |u: &DVector<f64>| -> Vec<f64> { parameters.iter().zip(u).map(|(p, u)| p.from_unit(*u)).collect() };
    let residual = |frequencies: &[f64]| {
        let one = |(&mode, std): (&usize, &f64)| (measured(mode) / frequencies[mode]).ln() / std;
        DVector::from_iterator(present.len(), present.iter().zip(&relative_std).map(one))
    };
    let mut u =
        DVector::from_iterator(start.len(), parameters.iter().zip(start).map(|(p, x)| p.to_unit(*x).clamp(0.0, 1.0)));
    let mut frequencies = simulator.frequencies_hz(&theta(&u))?;
    let mut error = residual(&frequencies);
    // What is not known of the effects may be anything: such a measurement tests nothing.
    let known = observation.possible_sizes.is_empty();
    let determined = known && present.len() > parameters.len();
    let reached = |error: &DVector<f64>| {
        error.iter().zip(&relative_std).all(|(r, std)| r.abs() * std <= FLOW_ACCURACY + NOISE_MULTIPLE * std)
    };
    let (mut at_edge, mut absorbed) = (0, if known { present.len().min(parameters.len()) } else { present.len() });
    let mut projector = DMatrix::zeros(present.len(), present.len());
    if known && (determined || !reached(&error)) {
        let mut damping = 1e-3;
        for _ in 0..ITERATIONS {
            let jacobian = simulator.jacobian(&theta(&u))?;
            // d ln f / du over s: the box becomes the unit cube, the residuals count in standard deviations.
            let scaled = DMatrix::from_fn(present.len(), u.len(), |row, column| {
                let width = parameters[column].upper - parameters[column].lower;
                jacobian[(present[row], column)] * width / (frequencies[present[row]] * relative_std[row])
            });
            let descent = scaled.transpose() * &error;
            // A parameter at an edge that wants to leave stays there and out of the step of the others.
            let free: Vec<usize> = (0..u.len())
                .filter(|&i| !((u[i] <= 0.0 && descent[i] < 0.0) || (u[i] >= 1.0 && descent[i] > 0.0)))
                .collect();
            at_edge = u.len() - free.len();
            if free.is_empty() {
                absorbed = 0;
                projector = DMatrix::identity(present.len(), present.len());
                break;
            }
            let columns = scaled.select_columns(&free);
            if determined {
                let svd = columns.clone().svd(true, false);
                projector = DMatrix::identity(present.len(), present.len());
                absorbed = 0;
                for (direction, strength) in svd.u.iter().flat_map(|u| u.column_iter()).zip(svd.singular_values.iter())
                {
                    if *strength > ABSORBING {
                        projector -= direction * direction.transpose();
                        absorbed += 1;
                    }
                }
            } else {
                absorbed = columns.singular_values().iter().filter(|s| **s > ABSORBING).count();
            }
            let mut normal = columns.transpose() * &columns;
            for i in 0..free.len() {
                normal[(i, i)] += damping * (normal[(i, i)] + 1e-12);
            }
            let Some(step) = normal.cholesky().map(|c| c.solve(&descent.select_rows(&free))) else { break };
            let mut next = u.clone();
            for (i, &column) in free.iter().enumerate() {
                next[column] = (u[column] + step[i]).clamp(0.0, 1.0);
            }
            let moved = (&next - &u).amax();
            let next_frequencies = simulator.frequencies_hz(&theta(&next))?;
            let next_error = residual(&next_frequencies);
            let gain = error.norm_squared() - next_error.norm_squared();
            if gain > 0.0 {
                (u, frequencies, error) = (next, next_frequencies, next_error);
                damping = (damping / 5.0).max(1e-12);
            } else {
                damping *= 5.0;
            }
            if moved < 1e-10 || damping > 1e8 || (0.0..1e-4).contains(&gain) {
                break;
            }
        }
    }
    let tested = known && (determined || at_edge > 0 || !reached(&error));
    let chi_squared = if tested { error.norm_squared() } else { 0.0 };
    let (mut standardised_residuals, mut expanded) =
        (DVector::zeros(simulator.modes()), DMatrix::zeros(simulator.modes(), simulator.modes()));
    for (row, &mode) in present.iter().enumerate() {
        standardised_residuals[mode] = if known { error[row] } else { 0.0 };
        for (column, &other) in present.iter().enumerate() {
            expanded[(mode, other)] = projector[(row, column)];
        }
    }
    // Where nothing should be left over and something is, the measurement lies beyond what the simulation can give (a fold
    // of the map, not an edge of the box): that is told like an edge.
    let beyond = usize::from(chi_squared > 0.0 && !reached(&error));
    let degrees_of_freedom = present.len().saturating_sub(absorbed).max(beyond);
    Ok(Nearest {
        frequencies_hz: frequencies,
        chi_squared,
        degrees_of_freedom,
        standardised_residuals,
        projector: expanded,
    })
}
