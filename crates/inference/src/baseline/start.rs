//! The starting point of a flow with many parameters: the best fit of each measurement and the normal distribution about
//! it.
//!
//! A flow with a hundred parameters would spend its training on learning what Newton's method computes: which parameters
//! fit a measurement best. Each measurement is therefore fitted first, with the simulation and its derivatives, and the
//! flow only learns how the posterior differs from the normal distribution at the fit:
//!
//! ```text
//!  û    = argmin ½ |r(u)|² + ½ (u − m)ᵀ P (u − m)    r: residuals in standard deviations, u: position in the prior box
//!  R Rᵀ = JᵀJ/a² + P                                J = −∂r/∂u at û
//!  x    = Rᵀ (u − û),    flow:  x ⟷ z | û, ln std of each parameter, ln a
//! ```
//!
//! m and P⁻¹ are mean and (diagonal) variance of the prior: ½ and 1/12 where it is uniform. a² is the misfit at û beyond what the noise explains, and 1 where the fit is good: where the search stops in a local
//! minimum, the starting distribution is wide. Modes are paired anew at each step, by MAC and frequency, so that a
//! measurement may have its modes in another order than the simulation, or lack modes or shapes.

use nalgebra::{DMatrix, DVector};
use rand::Rng as _;
use rayon::prelude::*;

use super::observation::Observation;
use structures::parameter::Parameter;
use structures::physics;
use structures::physics::eigen::transposed_product;
use structures::physics::shapes::pair_modes;
use structures::simulator::{Linearised, Simulator};
use structures::stats::{normal_cdf, normal_quantile, Stream};

/// Number of parameters from which on a flow starts at the best fit.
pub const MANY_PARAMETERS: usize = 17;

/// Most steps of the search. It takes five or six steps where the noise is small.
const STEPS: usize = 20;

/// Far from the minimum, residuals are scaled so that their root mean square is one over this number: full Newton steps on
/// residuals of many standard deviations overshoot.
const CAUTION: f64 = 0.8;

/// The search ends with a step whose expected gain is less than this, nats; the step itself is still taken. With a hundred
/// parameters a gain of 2 means less than a standard deviation in a single direction.
const LEAST_GAIN: f64 = 2.0;

/// Number of standard deviations of χ² by which the misfit may exceed its mean before the starting distribution is widened.
const MISFIT_ALLOWED: f64 = 3.0;

/// Rounds of redrawing the parameters of a draw that lie outside the prior.
const ROUNDS: usize = 2;

/// Whether the flow of a structure starts at the best fit: where it has many parameters or its mode shapes are measured.
/// The fit needs measurement noise to weight the residuals.
pub fn starts_at_fit(simulator: &Simulator) -> bool {
    simulator.is_noisy() && (simulator.space().len() >= MANY_PARAMETERS || simulator.shape_points() > 0)
}

/// Most degrees of freedom of a structure whose eigenproblem is solved for every draw: beyond it takes milliseconds per
/// draw.
const MOST_DOFS_WEIGHED: usize = 80;

/// Whether the likelihood of every draw of a structure can be computed: the coefficients of its effects are known, and its simulation takes
/// microseconds.
pub fn weighs_every_draw(simulator: &Simulator) -> bool {
    let certain = simulator.effects().iter().all(|effect| effect.psi_std().iter().all(|std| *std <= 0.0));
    certain && simulator.structure().is_none_or(|structure| structure.dofs() <= MOST_DOFS_WEIGHED)
}

/// The best fit of a measurement.
#[derive(Debug, Clone)]
pub struct Located {
    /// û: position of the parameters in the prior box, `[d]`. It may lie slightly outside.
    pub unit: DVector<f64>,
    /// Precision R Rᵀ of the normal distribution about û, `[d, d]`.
    pub precision: DMatrix<f64>,
    /// Lower triangular Cholesky factor R, `[d, d]`.
    pub factor: DMatrix<f64>,
    /// Standard deviation of each position under that distribution, `[d]`.
    pub std: DVector<f64>,
    /// Sum of the squared residuals, in standard deviations of the noise.
    pub chi_squared: f64,
    /// Number of residuals less the directions in which parameters absorb them.
    pub degrees_of_freedom: f64,
    /// a² − 1 ≥ 0: the misfit beyond what the noise explains.
    pub excess: f64,
    /// Simulated frequency of each mode of the measurement, Hz.
    pub frequencies_hz: Vec<f64>,
    /// Mean m and precision P of the prior of each position.
    pub prior: BoxPrior,
}

/// Mean and precision (one over the variance) of the prior of each position in the box, `[d]`.
#[derive(Debug, Clone)]
pub struct BoxPrior {
    mean: DVector<f64>,
    precision: DVector<f64>,
}

impl BoxPrior {
    fn of(parameters: &[Parameter]) -> Self {
        let of_each =
            |value: fn(&Parameter) -> f64| DVector::from_iterator(parameters.len(), parameters.iter().map(value));
        Self { mean: of_each(Parameter::box_mean), precision: of_each(Parameter::box_precision) }
    }
}

/// Residuals of a measurement at one point and their derivatives.
struct Residuals {
    /// (measured − simulated)/std: logarithms of the frequencies, then components of the shape, mode by mode, `[rows]`.
    values: DVector<f64>,
    /// Derivatives of the simulated values by u, in standard deviations of the noise, `[rows, d]`.
    slopes: DMatrix<f64>,
    /// Number of rows, less one for each shape, since the norm of a shape is not measured.
    free: f64,
    frequencies_hz: Vec<f64>,
}

/// [`locate`] for n measurements in parallel, `[n]`. The result does not depend on the number of threads.
///
/// # Errors
/// [`physics::Error`], which cannot occur inside a checked prior.
pub fn locate_all(simulator: &Simulator, observations: &[Observation]) -> Result<Vec<Located>, physics::Error> {
    observations.par_iter().map(|observation| locate(simulator, observation)).collect()
}

/// Finds the best fit û of one measurement and the normal distribution about it, by Gauss–Newton steps on the tempered posterior.
///
/// ```text
///  û    = argmin ½ |r(u)|² + ½ (u − m)ᵀ P (u − m)
///  R Rᵀ = JᵀJ/a² + P,    J = −∂r/∂u at û
/// ```
///
/// r: residuals in standard deviations of the noise; u: position in the prior box, `[d]`; m, P, a: see the module.
///
/// # Errors
/// [`physics::Error`], which cannot occur inside a checked prior.
pub fn locate(simulator: &Simulator, observation: &Observation) -> Result<Located, physics::Error> {
    let simulator = &observation.simulator(simulator);
    let prior = simulator.space().as_slice();
    // The search may leave the prior as far as a flow is trained: the simulation is valid there.
    let wide = simulator.training_space();
    let limits: Vec<(f64, f64)> =
        prior.iter().zip(wide.iter()).map(|(p, w)| (p.to_unit(w.lower), p.to_unit(w.upper))).collect();
    let of_prior = BoxPrior::of(prior);
    let mut u = of_prior.mean.clone();
    let (mut residuals, mut step);
    let mut taken = 0;
    loop {
        residuals = residuals_at(simulator, observation, prior, &u)?;
        taken += 1;
        let rms = (residuals.values.norm_squared() / residuals.values.len() as f64).sqrt();
        let tempering = (CAUTION * rms).max(1.0).powi(-2);
        let descent = residuals.slopes.tr_mul(&residuals.values) * tempering
            - (&u - &of_prior.mean).component_mul(&of_prior.precision);
        let normal = transposed_product(&residuals.slopes, &residuals.slopes);
        let (_, factor) = precision(&normal, tempering, &of_prior);
        step = solve(&factor, &descent);
        let gain = descent.dot(&step);
        for (position, (change, (lowest, highest))) in u.iter_mut().zip(step.iter().zip(&limits)) {
            *position = (*position + change).clamp(*lowest, *highest);
        }
        // With this form of the condition, NaN ends the search too.
        let goes_on = gain >= LEAST_GAIN || tempering < 1.0;
        if taken == STEPS || !goes_on {
            return Ok(located(u, residuals, &normal, &step, of_prior));
        }
    }
}

/// The normal distribution at the end of the search. The derivatives before the last step are used, because that step is small.
fn located(
    unit: DVector<f64>,
    residuals: Residuals,
    normal: &DMatrix<f64>,
    step: &DVector<f64>,
    prior: BoxPrior,
) -> Located {
    let left = residuals.values - &residuals.slopes * step;
    let chi_squared = left.norm_squared();
    let (_, full) = precision(normal, 1.0, &prior);
    // The number of directions that are determined by the data rather than by the prior: d − tr(P C).
    let mut left = inverse(&full);
    for (mut column, precision) in left.column_iter_mut().zip(&prior.precision) {
        column *= (precision / prior.precision[0]).sqrt();
    }
    let absorbed = unit.len() as f64 - prior.precision[0] * left.norm_squared();
    let degrees_of_freedom = (residuals.free - absorbed).max(0.0);
    let expected = degrees_of_freedom + MISFIT_ALLOWED * (2.0 * degrees_of_freedom.max(1.0)).sqrt();
    let excess = (chi_squared / expected - 1.0).max(0.0);
    let (precision, factor) = precision(normal, 1.0 / (1.0 + excess), &prior);
    let inverse = inverse(&factor);
    let std = DVector::from_iterator(unit.len(), inverse.column_iter().map(|column| column.norm()));
    let frequencies_hz = residuals.frequencies_hz;
    Located { unit, precision, factor, std, chi_squared, degrees_of_freedom, excess, frequencies_hz, prior }
}

/// JᵀJ·weight + P, `[d, d]`, and its lower triangular factor.
fn precision(normal: &DMatrix<f64>, weight: f64, prior: &BoxPrior) -> (DMatrix<f64>, DMatrix<f64>) {
    let mut precision = normal * weight;
    for i in 0..precision.nrows() {
        precision[(i, i)] += prior.precision[i];
    }
    let factor = precision.clone().cholesky().expect("squares plus a positive diagonal are positive definite").unpack();
    (precision, factor)
}

/// Solves R Rᵀ s = b.
fn solve(factor: &DMatrix<f64>, right: &DVector<f64>) -> DVector<f64> {
    let regular = "a Cholesky factor has no zero on its diagonal";
    factor.tr_solve_lower_triangular(&factor.solve_lower_triangular(right).expect(regular)).expect(regular)
}

/// R⁻¹. The squared norms of its columns are the variances.
fn inverse(factor: &DMatrix<f64>) -> DMatrix<f64> {
    let identity = DMatrix::identity(factor.nrows(), factor.nrows());
    factor.solve_lower_triangular(&identity).expect("a Cholesky factor has no zero on its diagonal")
}

/// Residuals and derivatives at the position `u` of the prior box, with the modes of measurement and simulation paired.
fn residuals_at(
    simulator: &Simulator,
    observation: &Observation,
    prior: &[Parameter],
    u: &DVector<f64>,
) -> Result<Residuals, physics::Error> {
    let theta: Vec<f64> = prior.iter().zip(u).map(|(p, u)| p.from_unit(*u)).collect();
    let with_shapes = observation.has_shapes();
    let count = if with_shapes { simulator.modes_to_pair() } else { simulator.modes() };
    let there = simulator.linearise(&theta, count, with_shapes)?;
    let present: Vec<(usize, f64)> =
        observation.frequencies_hz.iter().enumerate().filter_map(|(mode, f)| Some((mode, (*f)?))).collect();
    let pairs: Vec<usize> = if with_shapes {
        let measured: Vec<_> = present.iter().map(|&(mode, f)| (f, observation.shape(mode))).collect();
        pair_modes(&measured, &there.frequencies_hz, &there.shapes)
    } else {
        present.iter().map(|(mode, _)| *mode).collect()
    };
    let shaped = present.iter().filter(|(mode, _)| observation.shape(*mode).is_some()).count();
    let points = simulator.shape_points();
    let rows = present.len() + shaped * points;
    let mut values = DVector::zeros(rows);
    let mut slopes = DMatrix::zeros(rows, u.len());
    let mut frequencies_hz: Vec<f64> = simulator.nominal_frequencies_hz();
    let mut row = 0;
    for (&(mode, measured_hz), &own) in present.iter().zip(&pairs) {
        let Linearised { frequencies_hz: simulated, frequency_slopes, shapes, shape_slopes } = &there;
        frequencies_hz[mode] = simulated[own];
        let std = observation.std_hz(simulator, mode).unwrap_or(measured_hz) / measured_hz;
        values[row] = (measured_hz / simulated[own]).ln() / std;
        for (column, parameter) in prior.iter().enumerate() {
            let width = parameter.upper - parameter.lower;
            slopes[(row, column)] = frequency_slopes[(own, column)] * width / (simulated[own] * std);
        }
        row += 1;
        let Some(measured) = observation.shape(mode) else { continue };
        let along: f64 = measured.iter().zip(shapes.column(own).iter()).map(|(a, b)| a * b).sum();
        let sign = if along < 0.0 { -1.0 } else { 1.0 } / simulator.shape_std();
        for (point, value) in measured.iter().enumerate() {
            values[row + point] = value / simulator.shape_std() - sign * shapes[(point, own)];
        }
        for (column, parameter) in prior.iter().enumerate() {
            let scale = sign * (parameter.upper - parameter.lower);
            let mut target = slopes.view_mut((row, column), (points, 1));
            target.copy_from(&shape_slopes[own].column(column));
            target *= scale;
        }
        row += points;
    }
    Ok(Residuals { values, slopes, free: (rows - shaped) as f64, frequencies_hz })
}

impl Located {
    /// Condition of the flow: û and the logarithms of the standard deviations, both in units of the prior's standard
    /// deviation, and ln a.
    pub(super) fn features(&self) -> impl Iterator<Item = f64> + '_ {
        let prior = || self.prior.mean.iter().zip(&self.prior.precision);
        let position = self.unit.iter().zip(prior()).map(|(u, (mean, precision))| precision.sqrt() * (u - mean));
        let std = self.std.iter().zip(prior()).map(|(std, (_, precision))| (precision.sqrt() * std).ln());
        position.chain(std).chain(std::iter::once(0.5 * self.excess.ln_1p()))
    }

    /// x = Rᵀ (u − û) of positions u in the prior box, one column each, `[d, n]`.
    pub fn to_flow(&self, unit: &DMatrix<f64>) -> DMatrix<f64> {
        let mut deviation = unit.clone();
        for mut column in deviation.column_iter_mut() {
            column -= &self.unit;
        }
        transposed_product(&self.factor, &deviation)
    }

    /// u = û + R⁻ᵀ x, one column each, `[d, n]`; the inverse of [`Self::to_flow`]. Positions may lie outside the box.
    pub fn from_flow(&self, x: &DMatrix<f64>) -> DMatrix<f64> {
        let solvable = "a Cholesky factor has no zero on its diagonal";
        let mut unit = self.factor.tr_solve_lower_triangular(x).expect(solvable);
        for mut column in unit.column_iter_mut() {
            column += &self.unit;
        }
        unit
    }

    /// ln|det ∂x/∂u| = Σ ln R_ii.
    pub fn log_det(&self) -> f64 {
        self.factor.diagonal().iter().map(|r| r.ln()).sum()
    }

    /// Redraws the positions of `draw` (`[d]`) that lie outside the prior, each given all others, from the normal
    /// distribution truncated to the prior. Returns whether there were any.
    ///
    /// ```text
    ///  u_i | others ~ N(u_i − (P(u − û))_i/P_ii, 1/P_ii) on [0, 1],    P = R Rᵀ
    /// ```
    ///
    /// With a hundred parameters, nearly every draw has some parameters outside the prior: rejecting whole draws would not
    /// end.
    pub fn draw_back(&self, draw: &mut [f64], stream: &mut Stream) -> bool {
        let beyond: Vec<usize> = (0..draw.len()).filter(|&i| !(0.0..=1.0).contains(&draw[i])).collect();
        for _ in 0..ROUNDS {
            for &i in &beyond {
                let pull: f64 = self
                    .precision
                    .column(i)
                    .iter()
                    .zip(draw.iter().zip(&self.unit))
                    .map(|(p, (u, c))| p * (u - c))
                    .sum();
                let own = self.precision[(i, i)];
                let (mean, std) = (draw[i] - pull / own, own.sqrt().recip());
                let (low, high) = (normal_cdf(-mean / std), normal_cdf((1.0 - mean) / std));
                let level = low + (high - low) * stream.random::<f64>();
                // Far outside, both levels are 0 or 1, and the result is the bound.
                let level = level.clamp(f64::MIN_POSITIVE, 1.0 - f64::EPSILON);
                draw[i] = (mean + std * normal_quantile(level)).clamp(0.0, 1.0);
            }
        }
        !beyond.is_empty()
    }
}
