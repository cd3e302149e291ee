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
    let search = Search::new(simulator, observation, RESOLUTION);
    let (present, parameters) = (search.modes.len(), simulator.space().len());
    // What is not known of the effects may be anything: such a measurement tests nothing.
    let known = observation.possible_sizes.is_empty();
    let determined = known && present > parameters;
    let mut found = search.at(search.unit(start))?;
    let (mut at_edge, mut absorbed) = (0, if known { present.min(parameters) } else { present });
    let mut projector = DMatrix::zeros(present, present);
    if known && (determined || !search.reaches(&found)) {
        found = search.descend(found)?;
        let slopes = search.slopes(&found)?;
        let free = found.free(&slopes);
        at_edge = parameters - free.len();
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
    let tested = known && (determined || at_edge > 0 || !search.reaches(&found));
    let chi_squared = if tested { found.error.norm_squared() } else { 0.0 };
    let (mut standardised_residuals, mut expanded) =
        (DVector::zeros(simulator.modes()), DMatrix::zeros(simulator.modes(), simulator.modes()));
    for (row, &mode) in search.modes.iter().enumerate() {
        standardised_residuals[mode] = if known { found.error[row] } else { 0.0 };
        for (column, &other) in search.modes.iter().enumerate() {
            expanded[(mode, other)] = projector[(row, column)];
        }
    }
    // Where nothing should be left over and something is, the measurement lies beyond what the simulation can give (a fold
    // of the map, not an edge of the box): that is told like an edge.
    let beyond = usize::from(chi_squared > 0.0 && !search.reaches(&found));
    Ok(Nearest {
        chi_squared,
        degrees_of_freedom: present.saturating_sub(absorbed).max(beyond),
        frequencies_hz: found.frequencies_hz,
        standardised_residuals,
        projector: expanded,
    })
}

/// The frequencies of a measurement, to be looked for in the unit box of the prior.
pub(super) struct Search<'a> {
    simulator: &'a Simulator,
    /// The modes present,
    modes: Vec<usize>,
    /// their frequencies, Hz,
    measured_hz: Vec<f64>,
    /// and the relative standard deviations of their noise.
    relative_std: Vec<f64>,
}

/// A point of the unit box.
struct Point {
    /// Where it is.
    u: DVector<f64>,
    /// All its frequencies, Hz.
    frequencies_hz: Vec<f64>,
    /// (ln f_i − ln f_i(x))/s_i of the modes present.
    error: DVector<f64>,
    /// Simulations on the way here.
    simulations: usize,
}

/// Where a search ended.
pub(super) struct Descent {
    /// Parameters, `[d]`.
    pub theta: Vec<f64>,
    /// How far the worst of its frequencies is off, relative.
    pub off: f64,
    /// Simulations that it took.
    pub simulations: usize,
}

impl Point {
    /// Parameters that are not at an edge which they want to leave; `slopes` as of [`Search::slopes`].
    fn free(&self, slopes: &DMatrix<f64>) -> Vec<usize> {
        let descent = slopes.tr_mul(&self.error);
        let leaves = |i: usize| (self.u[i] <= 0.0 && descent[i] < 0.0) || (self.u[i] >= 1.0 && descent[i] > 0.0);
        (0..self.u.len()).filter(|&i| !leaves(i)).collect()
    }
}

impl<'a> Search<'a> {
    /// Of a measurement by a simulation under its conditions; what is left of a search that has converged is a hundredth of
    /// `resolution` (relative), or of the noise where that is more.
    pub(super) fn new(simulator: &'a Simulator, observation: &Observation, resolution: f64) -> Self {
        let frequencies = observation.frequencies_hz.iter().enumerate();
        let (modes, measured_hz): (Vec<usize>, Vec<f64>) =
            frequencies.filter_map(|(mode, f)| f.map(|f| (mode, f))).unzip();
        let relative =
            |(&mode, f): (&usize, &f64)| observation.std_hz(simulator, mode).map_or(1.0, |std| std / f).max(resolution);
        let relative_std = modes.iter().zip(&measured_hz).map(relative).collect();
        Self { simulator, modes, measured_hz, relative_std }
    }

    /// Parameters in the unit box, those beyond it at its edge.
    fn unit(&self, theta: &[f64]) -> DVector<f64> {
        let parameters = self.simulator.space().iter();
        DVector::from_iterator(theta.len(), parameters.zip(theta).map(|(p, x)| p.to_unit(*x).clamp(0.0, 1.0)))
    }

    /// The parameters of a point.
    fn theta(&self, u: &DVector<f64>) -> Vec<f64> {
        self.simulator.space().iter().zip(u).map(|(p, u)| p.from_unit(*u)).collect()
    }

    fn at(&self, u: DVector<f64>) -> Result<Point, physics::Error> {
        let frequencies_hz = self.simulator.frequencies_hz(&self.theta(&u))?;
        let one = |(i, measured): (usize, &f64)| (measured / frequencies_hz[self.modes[i]]).ln() / self.relative_std[i];
        let error = DVector::from_iterator(self.modes.len(), self.measured_hz.iter().enumerate().map(one));
        Ok(Point { u, frequencies_hz, error, simulations: 1 })
    }

    /// d ln f/du over s, `[modes present, d]`: the box is the unit cube, the errors count in standard deviations.
    fn slopes(&self, point: &Point) -> Result<DMatrix<f64>, physics::Error> {
        let jacobian = self.simulator.jacobian(&self.theta(&point.u))?;
        let parameters = self.simulator.space().as_slice();
        Ok(DMatrix::from_fn(self.modes.len(), parameters.len(), |row, column| {
            let (mode, width) = (self.modes[row], parameters[column].upper - parameters[column].lower);
            jacobian[(mode, column)] * width / (point.frequencies_hz[mode] * self.relative_std[row])
        }))
    }

    /// Whether a point gives the measurement, as near as a flow comes, beyond its noise.
    fn reaches(&self, point: &Point) -> bool {
        let near = |(error, std): (&f64, &f64)| error.abs() * std <= FLOW_ACCURACY + NOISE_MULTIPLE * std;
        point.error.iter().zip(&self.relative_std).all(near)
    }

    /// The minimum of the errors that lies downhill from a point, by projected Levenberg–Marquardt.
    fn descend(&self, start: Point) -> Result<Point, physics::Error> {
        let (mut point, mut damping) = (start, 1e-3);
        let mut simulations = point.simulations;
        let mut slopes = self.slopes(&point)?;
        for _ in 0..ITERATIONS {
            // A parameter at an edge that wants to leave stays there and out of the step of the others.
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

    /// The minimum of the errors that lies downhill from parameters `[d]`.
    ///
    /// # Errors
    /// [`physics::Error`], which a checked prior rules out.
    pub(super) fn descend_from(&self, theta: &[f64]) -> Result<Descent, physics::Error> {
        let point = self.descend(self.at(self.unit(theta))?)?;
        let off =
            point.error.iter().zip(&self.relative_std).map(|(error, std)| (error * std).abs()).fold(0.0, f64::max);
        Ok(Descent { theta: self.theta(&point.u), off, simulations: point.simulations })
    }
}
