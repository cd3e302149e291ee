//! The point of the prior box that fits a measurement best, and the misfit that remains.

use nalgebra::{DMatrix, DVector};

use super::observation::Observation;
use super::start::{locate, Located};
use structures::physics;
use structures::simulator::Simulator;

/// Smallest relative standard deviation used to scale residuals: the residual of a converged search is of this order.
const RESOLUTION: f64 = 2.5e-5;

/// A measurement with no more modes than parameters is accepted as reproducible, without a search, where the relative
/// residual of the posterior mean exceeds the noise by no more than this. A trained flow is this accurate, and a bound of
/// the box causes a far larger residual.
const FLOW_ACCURACY: f64 = 0.003;

/// A direction of the prior box absorbs a degree of freedom of the residuals if it moves the frequencies by at least this
/// many standard deviations of the noise over its whole width. A weaker direction reaches the bounds before it absorbs
/// anything.
const ABSORBING: f64 = 6.0;

/// Residual, in standard deviations of the noise, that is still attributed to noise: one in 16,000 frequencies exceeds it.
const NOISE_MULTIPLE: f64 = 4.0;

/// Most iterations of the search.
const ITERATIONS: usize = 40;

/// The point of the prior box that fits a measurement best.
#[derive(Debug, Clone, PartialEq)]
pub struct Nearest {
    /// Simulated frequencies of all modes at that point, Hz, `[m]`.
    pub frequencies_hz: Vec<f64>,
    /// Σ over the modes present of ((ln f_i − ln f_i(x))/s_i)², s_i the relative standard deviation of the noise.
    pub chi_squared: f64,
    /// Expected value of `chi_squared`: the number of modes present minus the number of directions in which parameters away from
    /// the bounds absorb noise.
    pub degrees_of_freedom: usize,
    /// (ln f_i − ln f_i(x))/s_i of each mode, `[m]`; 0 where it is missing.
    pub standardised_residuals: DVector<f64>,
    /// Covariance of these residuals under noise alone, `[m, m]`: the projector on the directions that the parameters
    /// cannot absorb.
    pub projector: DMatrix<f64>,
}

/// The result for measured mode shapes, which is the fit that the flow starts at. It contains the sum of the squared residuals of
/// frequencies and shapes, but no residuals of single modes. `known`: the sizes of all effects are known; otherwise the measurement
/// cannot be compared with the simulation.
fn of_fit(fit: Located, modes: usize, known: bool) -> Nearest {
    Nearest {
        frequencies_hz: fit.frequencies_hz,
        chi_squared: if known { fit.chi_squared } else { 0.0 },
        degrees_of_freedom: if known { fit.degrees_of_freedom.round() as usize } else { 0 },
        standardised_residuals: DVector::zeros(modes),
        projector: DMatrix::zeros(modes, modes),
    }
}

/// Finds the point of the prior box that fits a measurement best, starting from `start` (`[d]`, parameter units).
///
/// ```text
///  minimise Σ_i ( (ln f_i − ln f_i(x))/s_i )²   over the prior box, by projected Levenberg–Marquardt
/// ```
///
/// For a linear model with normal noise the minimum is χ²-distributed; its degrees of freedom are the modes present less
/// the parameters that are free at the minimum. If the truth lies inside the box, the minimum is at most that.
///
/// # Errors
/// [`physics::Error`], which cannot occur inside a checked prior.
pub fn nearest(simulator: &Simulator, observation: &Observation, start: &[f64]) -> Result<Nearest, physics::Error> {
    if observation.has_shapes() {
        let known = !observation.is_marginalised();
        locate(simulator, observation).map(|fit| of_fit(fit, simulator.modes(), known))
    } else {
        nearest_by_frequencies(simulator, observation, start)
    }
}

/// [`nearest`] for a measurement without mode shapes.
fn nearest_by_frequencies(
    simulator: &Simulator,
    observation: &Observation,
    start: &[f64],
) -> Result<Nearest, physics::Error> {
    let simulator = &observation.simulator(simulator);
    let search = Search::new(simulator, observation, RESOLUTION);
    let (present, parameters) = (search.modes.len(), simulator.space().len());
    // With a missing covariate the size of its effect is unknown, so that the measurement cannot be compared with the simulation.
    let known = !observation.is_marginalised();
    let determined = known && present > parameters;
    let mut found = search.at(search.unit(start))?;
    let (mut at_bound, mut absorbed) = (0, if known { present.min(parameters) } else { present });
    let mut projector = DMatrix::zeros(present, present);
    if known && (determined || !search.reaches(&found)) {
        found = search.descend(found)?;
        let slopes = search.slopes(&found)?;
        let free = found.free(&slopes);
        at_bound = parameters - free.len();
        absorbed = 0;
        if determined || free.is_empty() {
            projector = DMatrix::identity(present, present);
        }
        if !free.is_empty() {
            let svd = slopes.select_columns(&free).svd(determined, false);
            absorbed = svd.singular_values.iter().filter(|strength| **strength > ABSORBING).count();
            let directions = svd.u.iter().flat_map(|u| u.column_iter()).zip(&svd.singular_values);
            for (direction, _) in directions.filter(|(_, strength)| **strength > ABSORBING) {
                projector -= direction * direction.transpose();
            }
        }
    }
    let tested = known && (determined || at_bound > 0 || !search.reaches(&found));
    let chi_squared = if tested { found.error.norm_squared() } else { 0.0 };
    let (mut standardised_residuals, mut expanded) =
        (DVector::zeros(simulator.modes()), DMatrix::zeros(simulator.modes(), simulator.modes()));
    for (row, &mode) in search.modes.iter().enumerate() {
        standardised_residuals[mode] = if known { found.error[row] } else { 0.0 };
        for (column, &other) in search.modes.iter().enumerate() {
            expanded[(mode, other)] = projector[(row, column)];
        }
    }
    // With as many parameters as modes, no residual is expected. If one remains, the simulation cannot produce the measurement,
    // because it lies beyond a fold of the map from parameters to frequencies. As for a parameter at a bound, at least one degree
    // of freedom then remains.
    let beyond = usize::from(chi_squared > 0.0 && !search.reaches(&found));
    Ok(Nearest {
        chi_squared,
        degrees_of_freedom: present.saturating_sub(absorbed).max(beyond),
        frequencies_hz: found.frequencies_hz,
        standardised_residuals,
        projector: expanded,
    })
}

/// A least-squares search for the frequencies of a measurement in the unit box of the prior.
pub(super) struct Search<'a> {
    simulator: &'a Simulator,
    /// Indices of the modes present.
    modes: Vec<usize>,
    /// Their frequencies, Hz.
    measured_hz: Vec<f64>,
    /// Relative standard deviations of their noise.
    relative_std: Vec<f64>,
}

/// A point of the unit box.
struct Point {
    /// Position, `[d]`.
    u: DVector<f64>,
    /// Frequencies of all modes, Hz.
    frequencies_hz: Vec<f64>,
    /// (ln f_i − ln f_i(x))/s_i of the modes present.
    error: DVector<f64>,
    /// Simulations that the search has taken.
    simulations: usize,
}

/// Where a search ended.
pub(super) struct Descent {
    /// Parameters, `[d]`.
    pub theta: Vec<f64>,
    /// Largest absolute relative residual of a frequency.
    pub residual: f64,
    /// Simulations that the search has taken.
    pub simulations: usize,
}

impl Point {
    /// Parameters that are not held at a bound by the descent direction; `slopes` as given by [`Search::slopes`].
    fn free(&self, slopes: &DMatrix<f64>) -> Vec<usize> {
        let descent = slopes.tr_mul(&self.error);
        let leaves = |i: usize| (self.u[i] <= 0.0 && descent[i] < 0.0) || (self.u[i] >= 1.0 && descent[i] > 0.0);
        (0..self.u.len()).filter(|&i| !leaves(i)).collect()
    }
}

impl<'a> Search<'a> {
    /// A search for `observation` with the simulator under its effects. The relative residual of a converged search is
    /// about a hundredth of `resolution`, or of the noise where that is larger.
    pub(super) fn new(simulator: &'a Simulator, observation: &Observation, resolution: f64) -> Self {
        let frequencies = observation.frequencies_hz.iter().enumerate();
        let (modes, measured_hz): (Vec<usize>, Vec<f64>) =
            frequencies.filter_map(|(mode, f)| f.map(|f| (mode, f))).unzip();
        let relative =
            |(&mode, f): (&usize, &f64)| observation.std_hz(simulator, mode).map_or(1.0, |std| std / f).max(resolution);
        let relative_std = modes.iter().zip(&measured_hz).map(relative).collect();
        Self { simulator, modes, measured_hz, relative_std }
    }

    /// Position of parameters in the unit box, clamped to it.
    fn unit(&self, theta: &[f64]) -> DVector<f64> {
        let parameters = self.simulator.space().iter();
        DVector::from_iterator(theta.len(), parameters.zip(theta).map(|(p, x)| p.to_unit(*x).clamp(0.0, 1.0)))
    }

    /// The parameters at a position of the unit box.
    fn theta(&self, u: &DVector<f64>) -> Vec<f64> {
        self.simulator.space().iter().zip(u).map(|(p, u)| p.from_unit(*u)).collect()
    }

    /// Simulates the point at a position `u` of the unit box, `[d]`.
    fn at(&self, u: DVector<f64>) -> Result<Point, physics::Error> {
        let frequencies_hz = self.simulator.frequencies_hz(&self.theta(&u))?;
        let one = |(i, measured): (usize, &f64)| (measured / frequencies_hz[self.modes[i]]).ln() / self.relative_std[i];
        let error = DVector::from_iterator(self.modes.len(), self.measured_hz.iter().enumerate().map(one));
        Ok(Point { u, frequencies_hz, error, simulations: 1 })
    }

    /// (d ln f/du)/s, `[modes present, d]`: derivatives over the unit box, in standard deviations of the noise.
    fn slopes(&self, point: &Point) -> Result<DMatrix<f64>, physics::Error> {
        let jacobian = self.simulator.jacobian(&self.theta(&point.u))?;
        let parameters = self.simulator.space().as_slice();
        Ok(DMatrix::from_fn(self.modes.len(), parameters.len(), |row, column| {
            let (mode, width) = (self.modes[row], parameters[column].upper - parameters[column].lower);
            jacobian[(mode, column)] * width / (point.frequencies_hz[mode] * self.relative_std[row])
        }))
    }

    /// Whether a point reproduces the measurement within its noise and the accuracy of a flow.
    fn reaches(&self, point: &Point) -> bool {
        let near = |(error, std): (&f64, &f64)| error.abs() * std <= FLOW_ACCURACY + NOISE_MULTIPLE * std;
        point.error.iter().zip(&self.relative_std).all(near)
    }

    /// Descends from a point to a local minimum of the squared errors, by projected Levenberg–Marquardt.
    fn descend(&self, start: Point) -> Result<Point, physics::Error> {
        let (mut point, mut damping) = (start, 1e-3);
        let mut simulations = point.simulations;
        let mut slopes = self.slopes(&point)?;
        for _ in 0..ITERATIONS {
            // A parameter held at a bound stays there and takes no part in the step.
            let free = point.free(&slopes);
            if free.is_empty() {
                break;
            }
            let columns = slopes.select_columns(&free);
            let mut normal = columns.tr_mul(&columns);
            for i in 0..free.len() {
                normal[(i, i)] += damping * (normal[(i, i)] + 1e-12);
            }
            let Some(step) = normal.cholesky().map(|c| c.solve(&columns.tr_mul(&point.error))) else { break };
            let mut u = point.u.clone();
            for (i, &column) in free.iter().enumerate() {
                u[column] = (u[column] + step[i]).clamp(0.0, 1.0);
            }
            let moved = (&u - &point.u).amax();
            let next = self.at(u)?;
            simulations += 1;
            let gain = point.error.norm_squared() - next.error.norm_squared();
            if gain > 0.0 {
                slopes = self.slopes(&next)?;
                (point, damping) = (next, (damping / 5.0).max(1e-12));
            } else {
                damping *= 5.0;
            }
            if moved < 1e-10 || damping > 1e8 || (0.0..1e-4).contains(&gain) {
                break;
            }
        }
        Ok(Point { simulations, ..point })
    }

    /// Descends from parameters `theta` (`[d]`) to a local minimum of the squared errors.
    ///
    /// # Errors
    /// [`physics::Error`], which cannot occur inside a checked prior.
    pub(super) fn descend_from(&self, theta: &[f64]) -> Result<Descent, physics::Error> {
        let point = self.descend(self.at(self.unit(theta))?)?;
        let residual =
            point.error.iter().zip(&self.relative_std).map(|(error, std)| (error * std).abs()).fold(0.0, f64::max);
        Ok(Descent { theta: self.theta(&point.u), residual, simulations: point.simulations })
    }
}
