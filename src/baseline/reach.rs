//! Can the simulation produce a measurement at all, and if not, what comes nearest.

use nalgebra::{DMatrix, DVector};

use crate::physics;
use crate::simulator::Simulator;

/// Below this relative residual at the posterior mean, a measurement counts as reached without a closer look: a trained
/// flow is that exact on noise-free data, and a box edge shows as far more.
const FLOW_ACCURACY: f64 = 0.003;

/// Relative residual that remains at the nearest point of a measurement that is reached exactly.
const EXACT: f64 = 1e-4;

/// Noise, as a multiple of its standard deviation, that is no sign of being outside: one in 16,000 frequencies.
const NOISE_MULTIPLE: f64 = 4.0;

const ITERATIONS: usize = 40;

/// Whether some parameters inside the prior box give a measurement.
#[derive(Debug, Clone, PartialEq)]
pub enum Reach {
    /// Some do, within the noise.
    Inside,
    /// None do.
    Outside {
        /// Frequencies of the nearest point of the prior box, Hz.
        nearest_hz: Vec<f64>,
    },
}

/// Looks for the measurement in the prior box, beginning at `start` (`[d]`, parameter units).
///
/// ```text
///  minimise Σ_i ( ln f_i − ln f_i(x) )²   over the prior box, by projected Levenberg–Marquardt
/// ```
///
/// # Errors
/// [`physics::Error`], which a checked prior rules out.
pub fn reach(simulator: &Simulator, frequencies_hz: &[f64], start: &[f64]) -> Result<Reach, physics::Error> {
    let fits = |simulated: &[f64], accuracy: f64| {
        frequencies_hz.iter().zip(simulated).all(|(measured, simulated)| {
            let noise = NOISE_MULTIPLE * simulator.noise().std_hz(*measured) / measured;
            (measured / simulated - 1.0).abs() <= accuracy + noise
        })
    };
    let simulated = simulator.frequencies_hz(start)?;
    if fits(&simulated, FLOW_ACCURACY) {
        return Ok(Reach::Inside);
    }
    let nearest_hz = nearest(simulator, frequencies_hz, start)?;
    if fits(&nearest_hz, EXACT) {
        return Ok(Reach::Inside);
    }
    Ok(Reach::Outside { nearest_hz })
}

/// Frequencies of the point of the prior box that comes nearest, Hz.
fn nearest(simulator: &Simulator, target_hz: &[f64], start: &[f64]) -> Result<Vec<f64>, physics::Error> {
    let parameters = simulator.space().as_slice();
    let theta = |u: &DVector<f64>| -> Vec<f64> { parameters.iter().zip(u).map(|(p, u)| p.from_unit(*u)).collect() };
    let residual = |frequencies: &[f64]| {
        DVector::from_iterator(target_hz.len(), target_hz.iter().zip(frequencies).map(|(t, f)| (t / f).ln()))
    };
    let mut u = DVector::from_iterator(start.len(), parameters.iter().zip(start).map(|(p, x)| p.to_unit(*x)));
    let mut frequencies = simulator.frequencies_hz(&theta(&u))?;
    let mut error = residual(&frequencies);
    let mut damping = 1e-3;
    for _ in 0..ITERATIONS {
        let jacobian = simulator.jacobian(&theta(&u))?;
        // d ln f / du: the box becomes the unit cube, the residuals become relative.
        let scaled = DMatrix::from_fn(jacobian.nrows(), jacobian.ncols(), |mode, column| {
            let width = parameters[column].upper - parameters[column].lower;
            jacobian[(mode, column)] * width / frequencies[mode]
        });
        let descent = scaled.transpose() * &error;
        // A parameter at an edge that wants to leave stays there and out of the step of the others.
        let free: Vec<usize> = (0..u.len())
            .filter(|&i| !((u[i] <= 0.0 && descent[i] < 0.0) || (u[i] >= 1.0 && descent[i] > 0.0)))
            .collect();
        if free.is_empty() {
            break;
        }
        let columns = scaled.select_columns(&free);
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
        if next_error.norm_squared() < error.norm_squared() {
            (u, frequencies, error) = (next, next_frequencies, next_error);
            damping = (damping / 5.0).max(1e-12);
        } else {
            damping *= 5.0;
        }
        if moved < 1e-10 || damping > 1e8 {
            break;
        }
    }
    Ok(frequencies)
}
