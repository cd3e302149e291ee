//! Fits an exponential law for stiffness as a function of a position to stiffnesses identified by [`super::chain`].
//!
//! Source: Wang et al. (2025), Eq. 25 and 26.

use nalgebra::{Matrix3, Vector3};
use serde::Serialize;

use crate::stats;

/// Largest |B| multiplied by the range of the positions: beyond it, all change is within 2 % of the range.
const STEEPEST: f64 = 50.0;

/// Smallest |B| multiplied by the range of the positions: below it, the curve differs from a straight line by less than 0.1 %.
const FLATTEST: f64 = 0.01;

/// Number of starting values of B of each sign.
const STARTS: usize = 40;

/// Largest number of Levenberg–Marquardt iterations.
const ITERATIONS: usize = 200;

/// Root mean square of the residuals, as a share of that of the values, up to which the fit of a line counts as exact.
const EXACT: f64 = 1e-10;

/// How residuals are weighted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Weighting<'a> {
    /// All points are equally accurate.
    Absolute,
    /// The standard deviation of a point is proportional to its stiffness.
    Relative,
    /// Standard deviation of each point up to a common factor, `[n]`, such as
    /// [`super::chain::CouplingStiffness::std_n_per_m`].
    Std(&'a [f64]),
}

/// An estimated constant.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Estimate {
    /// Estimated value.
    pub value: f64,
    /// Standard error.
    pub standard_error: f64,
    /// 95 % confidence interval from Student's t.
    pub interval_95: [f64; 2],
}

/// A fit of k(p) = A·exp(B·p) + C.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ExponentialFit {
    /// A, in the unit of the stiffness.
    pub a: Estimate,
    /// B, in the inverse unit of the position.
    pub b: Estimate,
    /// C, in the unit of the stiffness.
    pub c: Estimate,
    /// Standard deviation of the weighted residuals: in the unit of the stiffness, as a share of the stiffness, or as a
    /// multiple of the given standard deviations, depending on the [`Weighting`].
    pub residual_std: f64,
    /// Number of points minus the three constants.
    pub degrees_of_freedom: usize,
    #[serde(skip)]
    shape: Shape,
    #[serde(skip)]
    covariance: Matrix3<f64>,
}

/// Why an exponential cannot be fitted.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FitError {
    /// A position, stiffness or standard deviation is not valid.
    #[error("point {point} is ({position}, {stiffness}): both must be finite, and its standard deviation above 0")]
    Point {
        /// Its number, from 0.
        point: usize,
        /// Its position.
        position: f64,
        /// Its stiffness.
        stiffness: f64,
    },
    /// The numbers of standard deviations and points differ.
    #[error("{given} standard deviations for {points} points: there must be one for each point")]
    Weights {
        /// Standard deviations given.
        given: usize,
        /// Points given.
        points: usize,
    },
    /// There are fewer than four different positions, which three constants and a residual need.
    #[error("{distinct} different positions: at least 4 are needed")]
    Positions {
        /// Different positions given.
        distinct: usize,
    },
    /// A straight line fits equally well within the noise, so that A, B and C are not determined.
    #[error(
        "the points are on a straight line within their noise: the constants of an exponential are not determined"
    )]
    StraightLine,
    /// All change is at one end of the positions, so that B is not determined.
    #[error("all change is at one end of the positions: the exponent is not determined")]
    Step,
    /// A, which is defined at position 0, is outside the range of f64.
    #[error("position 0 is too far from the points: the constant A is outside the range of floating-point numbers")]
    FarFromZero,
}

/// The curve in parameters of similar size and small correlation:
///
/// ```text
///  k(p) = level + rise·g(z),    g(z) = (e^(βz) − 1)/(e^β − 1),    z = (p − start)/width
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Shape {
    start: f64,
    width: f64,
    level: f64,
    rise: f64,
    beta: f64,
}

impl Shape {
    /// k(p).
    fn at(&self, position: f64) -> f64 {
        self.level + self.rise * rising(self.beta, (position - self.start) / self.width).0
    }

    /// Derivatives of k with respect to level, rise and β·rise.
    fn gradient(&self, position: f64) -> Vector3<f64> {
        let (g, slope) = rising(self.beta, (position - self.start) / self.width);
        Vector3::new(1.0, g, slope)
    }

    /// The curve after a step in level, rise and β·rise.
    fn moved(&self, step: &Vector3<f64>) -> Self {
        Self { level: self.level + step[0], rise: self.rise + step[1], beta: self.beta + step[2] / self.rise, ..*self }
    }

    /// A, B and C, and in rows their derivatives with respect to level, rise and β·rise.
    fn constants(&self) -> ([f64; 3], Matrix3<f64>) {
        let Self { start, width, level, rise, beta } = *self;
        let growth = beta.exp_m1();
        let a = rise / growth * (-beta * start / width).exp();
        let by_beta = -a * (beta.exp() / growth + start / width);
        let derivatives = Matrix3::new(
            0.0,
            a / rise,
            by_beta / rise,
            0.0,
            0.0,
            1.0 / (width * rise),
            1.0,
            -1.0 / growth,
            beta.exp() / growth.powi(2),
        );
        ([a, beta / width, level - rise / growth], derivatives)
    }
}

/// g(z) and ∂g/∂β of [`Shape`]; g(z) = z for β = 0.
fn rising(beta: f64, z: f64) -> (f64, f64) {
    if beta == 0.0 {
        return (z, 0.5 * z * (z - 1.0));
    }
    let (growth, part) = (beta.exp_m1(), (beta * z).exp_m1());
    (part / growth, (z * (beta * z).exp() - part * beta.exp() / growth) / growth)
}

/// Checked points.
struct Data<'a> {
    points: &'a [(f64, f64)],
    /// One over the standard deviation of each point.
    weights: Vec<f64>,
    start: f64,
    width: f64,
}

impl Data<'_> {
    /// Weighted residuals, `[n]`.
    fn residuals(&self, shape: &Shape) -> Vec<f64> {
        self.points.iter().zip(&self.weights).map(|((p, k), w)| w * (k - shape.at(*p))).collect()
    }

    fn sum_of_squares(&self, shape: &Shape) -> f64 {
        self.residuals(shape).iter().map(|r| r * r).sum()
    }

    /// Rows of the weighted Jacobian J.
    fn rows(&self, shape: &Shape) -> Vec<Vector3<f64>> {
        self.points.iter().zip(&self.weights).map(|((p, _), w)| *w * shape.gradient(*p)).collect()
    }

    /// (JᵀJ)⁻¹.
    fn inverse_normal(&self, shape: &Shape) -> Result<Matrix3<f64>, FitError> {
        let normal: Matrix3<f64> = self.rows(shape).iter().map(|row| row * row.transpose()).sum();
        normal.try_inverse().ok_or(FitError::Step)
    }

    /// The heteroscedasticity-consistent covariance HC3.
    fn robust_covariance(&self, shape: &Shape, residuals: &[f64]) -> Result<Matrix3<f64>, FitError> {
        // A point that alone determines a constant has leverage 1 and residual 0: with this limit, 0/0 becomes 0.
        const LEAST_REMAINDER: f64 = 1e-9;
        let inverse = self.inverse_normal(shape)?;
        let weighted = |(row, residual): (&Vector3<f64>, &f64)| {
            let leverage = (row.transpose() * inverse * row)[0];
            row * row.transpose() * (residual / (1.0 - leverage).max(LEAST_REMAINDER)).powi(2)
        };
        let between: Matrix3<f64> = self.rows(shape).iter().zip(residuals).map(weighted).sum();
        Ok(inverse * between * inverse)
    }

    /// Optimal level and rise for a given β, by weighted linear regression.
    fn best(&self, beta: f64) -> Shape {
        let (mut sums, mut centre) = (0.0, [0.0; 2]);
        let g = |p: f64| rising(beta, (p - self.start) / self.width).0;
        for ((p, k), w) in self.points.iter().zip(&self.weights) {
            sums += w * w;
            centre[0] += w * w * g(*p);
            centre[1] += w * w * k;
        }
        let centre = centre.map(|c| c / sums);
        let (mut covariance, mut variance) = (0.0, 0.0);
        for ((p, k), w) in self.points.iter().zip(&self.weights) {
            let from_centre = w * (g(*p) - centre[0]);
            covariance += from_centre * w * (k - centre[1]);
            variance += from_centre * from_centre;
        }
        let rise = covariance / variance;
        Shape { start: self.start, width: self.width, level: centre[1] - rise * centre[0], rise, beta }
    }
}

/// Fits k(p) = A·exp(B·p) + C to n `points` (p, k), p: position, k: stiffness; the constants are in the units of p and k.
///
/// ```text
///  minimise Σ r_i²,    r_i = (k_i − k(p_i))/s_i,    s_i by `weighting`
///  Std:                 Cov = s² (JᵀJ)⁻¹,    s² = Σ r_i²/(n − 3)
///  Absolute, Relative:  Cov = (JᵀJ)⁻¹ Jᵀ diag(r_i²/(1 − h_i)²) J (JᵀJ)⁻¹,    h_i = J_i (JᵀJ)⁻¹ J_iᵀ
/// ```
///
/// J contains the derivatives of k(p_i)/s_i with respect to the constants. If standard deviations are given, only their ratios
/// matter, because s² scales them. Otherwise the errors may differ from point to point (HC3); with ten points or fewer the
/// intervals are then rather too wide than too narrow. The minimum is found by the Levenberg–Marquardt method, starting from the
/// best point of a grid over B of both signs, with the optimal A and C for each.
///
/// `Std` is recommended for stiffnesses from [`super::chain::coupling_stiffness`]: on the rig of the paper their errors differ by
/// a factor of 25, and the weights reduce the errors of the constants by a quarter to almost a half.
///
/// Source: Wang et al. (2025), Eq. 25, which gives no intervals; MacKinnon & White (1985) for HC3.
///
/// # Errors
/// [`FitError`] for points that are not valid or do not determine an exponential.
pub fn fit_exponential(points: &[(f64, f64)], weighting: Weighting<'_>) -> Result<ExponentialFit, FitError> {
    let data = checked(points, weighting)?;
    let shape = best_shape(&data)?;
    let degrees_of_freedom = points.len() - 3;
    let residuals = data.residuals(&shape);
    let variance = residuals.iter().map(|r| r * r).sum::<f64>() / degrees_of_freedom as f64;
    let covariance = match weighting {
        Weighting::Std(_) => data.inverse_normal(&shape)? * variance,
        Weighting::Absolute | Weighting::Relative => data.robust_covariance(&shape, &residuals)?,
    };
    let (values, derivatives) = shape.constants();
    if !values[0].is_normal() {
        return Err(FitError::FarFromZero);
    }
    let t = stats::student_t_quantile(0.975, degrees_of_freedom);
    let of_constants = derivatives * covariance * derivatives.transpose();
    let estimate = |i: usize| {
        let (value, standard_error) = (values[i], of_constants[(i, i)].max(0.0).sqrt());
        Estimate { value, standard_error, interval_95: [value - t * standard_error, value + t * standard_error] }
    };
    Ok(ExponentialFit {
        a: estimate(0),
        b: estimate(1),
        c: estimate(2),
        residual_std: variance.sqrt(),
        degrees_of_freedom,
        shape,
        covariance,
    })
}

impl ExponentialFit {
    /// Fitted stiffness k(p) at a position, in the unit of the stiffnesses that were given.
    pub fn curve(&self, position: f64) -> f64 {
        self.shape.at(position)
    }

    /// Pointwise 95 % confidence interval of the curve at a position, in the unit of the stiffness. It is not a simultaneous
    /// band and not a prediction interval.
    pub fn band_95(&self, position: f64) -> [f64; 2] {
        let gradient = self.shape.gradient(position);
        let variance = (gradient.transpose() * self.covariance * gradient)[0];
        let half_width = stats::student_t_quantile(0.975, self.degrees_of_freedom) * variance.max(0.0).sqrt();
        [self.curve(position) - half_width, self.curve(position) + half_width]
    }
}

/// Checks the points, and computes their weights and the range of their positions.
fn checked<'a>(points: &'a [(f64, f64)], weighting: Weighting<'_>) -> Result<Data<'a>, FitError> {
    let stds: Vec<f64> = match weighting {
        Weighting::Absolute => vec![1.0; points.len()],
        Weighting::Relative => points.iter().map(|(_, k)| k.abs()).collect(),
        Weighting::Std(stds) if stds.len() != points.len() => {
            return Err(FitError::Weights { given: stds.len(), points: points.len() });
        }
        Weighting::Std(stds) => stds.to_vec(),
    };
    for (point, (&(position, stiffness), std)) in points.iter().zip(&stds).enumerate() {
        if !(position.is_finite() && stiffness.is_finite() && *std > 0.0 && std.is_finite()) {
            return Err(FitError::Point { point, position, stiffness });
        }
    }
    let mut positions: Vec<f64> = points.iter().map(|(p, _)| *p).collect();
    positions.sort_by(f64::total_cmp);
    positions.dedup();
    if positions.len() < 4 {
        return Err(FitError::Positions { distinct: positions.len() });
    }
    let (start, end) = (positions[0], positions[positions.len() - 1]);
    Ok(Data { points, weights: stds.iter().map(|std| 1.0 / std).collect(), start, width: end - start })
}

/// The curve with the smallest sum of squares.
fn best_shape(data: &Data<'_>) -> Result<Shape, FitError> {
    let line = data.best(0.0);
    let of_line = data.sum_of_squares(&line);
    let of_values: f64 = data.points.iter().zip(&data.weights).map(|((_, k), w)| (w * k).powi(2)).sum();
    if of_line <= EXACT * EXACT * of_values {
        return Err(FitError::StraightLine);
    }
    let ratio = (2.0 * STEEPEST / FLATTEST).powf(1.0 / (STARTS - 1) as f64);
    let starts = (0..STARTS).flat_map(|i| [1.0, -1.0].map(|sign| sign * FLATTEST * ratio.powi(i as i32)));
    let mut shape = starts
        .map(|beta| data.best(beta))
        .min_by(|a, b| data.sum_of_squares(a).total_cmp(&data.sum_of_squares(b)))
        .expect("there are starts");
    let mut least = data.sum_of_squares(&shape);
    let mut damping = 1e-3;
    for _ in 0..ITERATIONS {
        let (rows, residuals) = (data.rows(&shape), data.residuals(&shape));
        let descent: Vector3<f64> = rows.iter().zip(&residuals).map(|(row, r)| row * *r).sum();
        let mut normal: Matrix3<f64> = rows.iter().map(|row| row * row.transpose()).sum();
        for i in 0..3 {
            normal[(i, i)] *= 1.0 + damping;
        }
        let Some(step) = normal.cholesky().map(|c| c.solve(&descent)) else { break };
        let next = shape.moved(&step);
        let sum = data.sum_of_squares(&next);
        // The comparison is false for NaN, which rejects the step.
        if sum < least {
            let small = (next.beta - shape.beta).abs() < 1e-14 * shape.beta.abs();
            (shape, least) = (next, sum);
            damping = (damping / 5.0).max(1e-15);
            if small {
                break;
            }
        } else {
            damping *= 5.0;
            if damping > 1e8 {
                break;
            }
        }
    }
    if shape.beta.abs() > STEEPEST {
        return Err(FitError::Step);
    }
    // An F test of the improvement over a straight line by one further constant.
    let degrees_of_freedom = data.points.len() - 3;
    let t = stats::student_t_quantile(0.975, degrees_of_freedom);
    if shape.beta.abs() < FLATTEST || of_line - least < t * t * least / degrees_of_freedom as f64 {
        return Err(FitError::StraightLine);
    }
    Ok(shape)
}
