//! σ and ℓ of the process of one mode, at the maximum of their posterior given the residuals of that mode.
//!
//! ```text
//!  y ~ N(0, Λ + σ² ΦᵀΦ),    Λ_j = s_j + σ²(1 − |φ_j|²)
//! ```
//!
//! y: residuals, `[n]`; s: their variance under the population of the fit, noise and spread of the parameters; φ_j: basis of the
//! support points at row j. The modes are treated one at a time: their residuals are correlated through the spread of the
//! parameters, which [`super::posterior`] accounts for. The priors of ln ℓ and ln σ are normal and wide.
//!
//! Source: Snelson and Ghahramani (2006), NIPS 18, for the marginal likelihood with support points and its derivatives.

use nalgebra::{DMatrix, DVector};

use structures::simulator::discrepancy::process::Support;

/// Median and standard deviation of the logarithm of the prior of a length, in standard deviations of the input.
const LENGTH: (f64, f64) = (3.0, 1.0);

/// Standard deviation of the logarithm of the prior of σ.
const STD_LN_STD: f64 = 1.5;

/// Range of a length and of σ.
const LENGTHS: (f64, f64) = (0.1, 100.0);
const STDS: (f64, f64) = (1e-7, 0.5);

/// Greatest number of steps, and the gain in log posterior below which they end, nats.
const STEPS: usize = 60;
const ENOUGH_NATS: f64 = 1e-3;

/// σ and ℓ of one mode.
#[derive(Debug, Clone, PartialEq)]
pub struct Hyperparameters {
    /// σ, a share of the frequency.
    pub std: f64,
    /// ℓ, `[inputs]`.
    pub lengths: Vec<f64>,
    /// Log marginal likelihood minus that without a discrepancy, nats.
    pub nats: f64,
}

/// Residuals of one mode at the rows where it and the inputs are known.
pub struct ModeRows<'a> {
    /// Standardised inputs, `[n][inputs]`.
    pub u: Vec<&'a [f64]>,
    /// y, `[n]`.
    pub residual: DVector<f64>,
    /// s, `[n]`.
    pub variance: DVector<f64>,
}

/// x = (ln σ, ln ℓ) with the same length along all inputs.
fn start_at(inputs: usize, ln_std: f64, ln_length: f64) -> DVector<f64> {
    DVector::from_fn(1 + inputs, |i, _| if i == 0 { ln_std } else { ln_length })
}

impl ModeRows<'_> {
    /// The most probable hyperparameters, from `start` if it is given; `None` if the correlations are not finite.
    pub fn fit(&self, support: &Support, start: Option<&Hyperparameters>) -> Option<Hyperparameters> {
        let inputs = self.u.first()?.len();
        let size = (self.residual.norm_squared() / self.u.len() as f64).sqrt();
        let std = (0.5 * size).clamp(STDS.0, STDS.1);
        let middle = start_at(inputs, std.ln(), LENGTH.0.ln());
        let mut best: Option<(DVector<f64>, f64)> = None;
        let starts: Vec<DVector<f64>> = match start {
            Some(s) => vec![DVector::from_iterator(
                1 + inputs,
                std::iter::once(s.std.ln()).chain(s.lengths.iter().map(|l| l.ln())),
            )],
            // A smooth and a rough function can both be local maxima.
            None => vec![middle.clone(), start_at(inputs, std.ln(), 0.0)],
        };
        for start in starts {
            let found = self.ascend(support, start, &middle)?;
            if best.as_ref().is_none_or(|b| found.1 > b.1) {
                best = Some(found);
            }
        }
        let (x, _) = best?;
        let nats = self.log_marginal(support, &x)?.0 - self.without();
        Some(Hyperparameters { std: x[0].exp(), lengths: x.iter().skip(1).map(|l| l.exp()).collect(), nats })
    }

    /// Log marginal likelihood without a discrepancy, nats, without the constant.
    fn without(&self) -> f64 {
        let one = |(y, s): (&f64, &f64)| -0.5 * (y * y / s + s.ln());
        self.residual.iter().zip(self.variance.iter()).map(one).sum()
    }

    /// Log posterior of x = (ln σ, ln ℓ) and its gradient; `middle`: the means of the priors.
    fn log_posterior(&self, support: &Support, x: &DVector<f64>, middle: &DVector<f64>) -> Option<(f64, DVector<f64>)> {
        let inside = |(i, v): (usize, &f64)| {
            let (low, high) = if i == 0 { STDS } else { LENGTHS };
            (low.ln()..=high.ln()).contains(v)
        };
        if !x.iter().enumerate().all(inside) {
            return None;
        }
        let (mut value, mut gradient) = self.log_marginal(support, x)?;
        for i in 0..x.len() {
            let std = if i == 0 { STD_LN_STD } else { LENGTH.1 };
            let off = (x[i] - middle[i]) / std;
            value -= 0.5 * off * off;
            gradient[i] -= off / std;
        }
        value.is_finite().then_some((value, gradient))
    }

    /// Log marginal likelihood at x = (ln σ, ln ℓ), nats, without the constant, and its gradient.
    ///
    /// ```text
    ///  Σ = Λ + σ²ΦᵀΦ,   A = 1 + σ²ΦΛ⁻¹Φᵀ,   α = Σ⁻¹y,   W = ααᵀ − Σ⁻¹,   ln p = −½ (yᵀα + ln|Λ| + ln|A|)
    ///  ∂ ln p = ½ tr(W ∂Σ),    ΦΣ⁻¹ = A⁻¹ΦΛ⁻¹,    T = (Φα)αᵀ − A⁻¹ΦΛ⁻¹ − Φ diag(W)
    ///  ∂ by ln ℓ:  σ² ( ⟨L⁻ᵀT, ∂ρ(Z, U)⟩ − ½ ⟨L⁻ᵀTΦᵀL⁻¹, ∂R⟩ )
    /// ```
    pub fn log_marginal(&self, support: &Support, x: &DVector<f64>) -> Option<(f64, DVector<f64>)> {
        let variance = (2.0 * x[0]).exp();
        let lengths: Vec<f64> = x.iter().skip(1).map(|l| l.exp()).collect();
        let (across, across_slopes) = support.correlations_of(&self.u, &lengths);
        let (own, own_slopes) = support.own_correlations(&lengths);
        let factor = own.cholesky()?.l();
        let basis = factor.solve_lower_triangular(&across)?;
        let n = self.u.len();
        let rest = DVector::from_fn(n, |j, _| (1.0 - basis.column(j).norm_squared()).max(0.0));
        let lambda = &self.variance + &rest * variance;
        let mut scaled = basis.clone();
        for (mut column, lambda) in scaled.column_iter_mut().zip(lambda.iter()) {
            column /= *lambda;
        }
        let mut inner = &scaled * basis.transpose() * variance;
        for i in 0..support.len() {
            inner[(i, i)] += 1.0;
        }
        let inner = inner.cholesky()?;
        let mean = inner.solve(&(&scaled * &self.residual));
        let fitted = basis.tr_mul(&mean) * variance;
        let alpha = (&self.residual - fitted).component_div(&lambda);
        let log_det: f64 = lambda.iter().map(|l| l.ln()).sum::<f64>()
            + 2.0 * inner.l_dirty().diagonal().iter().map(|l| l.ln()).sum::<f64>();
        let value = -0.5 * (self.residual.dot(&alpha) + log_det);

        // A⁻¹ΦΛ⁻¹ = ΦΣ⁻¹.
        let solved = inner.solve(&scaled);
        let diagonal = DVector::from_fn(n, |j, _| {
            let inverse = 1.0 / lambda[j] - variance * solved.column(j).dot(&basis.column(j)) / lambda[j];
            alpha[j] * alpha[j] - inverse
        });
        let along = &basis * &alpha;
        let mut gradient = DVector::zeros(x.len());
        let trace = solved.component_mul(&basis).sum();
        gradient[0] = variance * (diagonal.dot(&rest) + along.norm_squared() - trace);
        let mut t = &along * alpha.transpose() - solved;
        for ((mut column, own), w) in t.column_iter_mut().zip(basis.column_iter()).zip(diagonal.iter()) {
            column.axpy(-w, &own, 1.0);
        }
        let t = factor.tr_solve_lower_triangular(&t)?;
        let square = factor.tr_solve_lower_triangular(&(&basis * t.transpose()))?;
        for (i, (across, own)) in across_slopes.iter().zip(&own_slopes).enumerate() {
            gradient[1 + i] = variance * (t.dot(across) - 0.5 * square.dot(own));
        }
        Some((value, gradient))
    }

    /// Climbs the log posterior by the method of Broyden, Fletcher, Goldfarb and Shanno from x; returns the end and its value.
    fn ascend(&self, support: &Support, x: DVector<f64>, middle: &DVector<f64>) -> Option<(DVector<f64>, f64)> {
        let mut x = x;
        let (mut value, mut gradient) = self.log_posterior(support, &x, middle)?;
        let size = x.len();
        let start = || DMatrix::identity(size, size) * 0.1;
        let mut inverse: DMatrix<f64> = start();
        for _ in 0..STEPS {
            let mut step = &inverse * &gradient;
            if step.dot(&gradient) <= 0.0 {
                inverse = start();
                step = &inverse * &gradient;
            }
            // A step by more than a factor of e² in any number leaves the range in which the slope says anything.
            step *= (2.0 / step.amax().max(f64::MIN_POSITIVE)).min(1.0);
            let mut next = None;
            for halvings in 0..12 {
                let trial = &x + &step * 0.5_f64.powi(halvings);
                let found = self.log_posterior(support, &trial, middle).filter(|f| f.0 > value);
                if let Some((better, slope)) = found {
                    next = Some((trial, better, slope));
                    break;
                }
            }
            let Some((moved, better, slope)) = next else { break };
            let (by, change) = (&moved - &x, &gradient - &slope);
            let curvature = by.dot(&change);
            if curvature > 1e-12 {
                let left = DMatrix::identity(size, size) - &by * change.transpose() / curvature;
                inverse = &left * &inverse * left.transpose() + &by * by.transpose() / curvature;
            }
            let gained = better - value;
            (x, value, gradient) = (moved, better, slope);
            if gained < ENOUGH_NATS {
                break;
            }
        }
        Some((x, value))
    }
}

#[cfg(test)]
mod tests {
    use rand::Rng as _;

    use super::*;
    use structures::stats;

    fn example() -> (Support, Vec<Vec<f64>>, DVector<f64>, DVector<f64>) {
        let mut stream = stats::stream(3, "hyperparameters");
        let mut random = |low: f64, high: f64| stream.random_range(low..high);
        let u: Vec<Vec<f64>> = (0..40).map(|_| vec![random(-2.0, 2.0), random(-2.0, 2.0)]).collect();
        let y = DVector::from_fn(40, |j, _| (1.3 * u[j][0]).sin() * u[j][1] + random(-0.2, 0.2));
        let s = DVector::from_fn(40, |_, _| random(0.01, 0.04));
        let points = DMatrix::from_fn(15, 2, |i, k| u[2 * i][k]);
        (Support::new(points, vec![false, false]), u, y, s)
    }

    /// The marginal likelihood with dense matrices, of which the formulas with support points are a rearrangement.
    #[test]
    fn the_marginal_likelihood_is_that_of_dense_matrices() {
        let (support, u, residual, variance) = example();
        let rows = ModeRows { u: u.iter().map(Vec::as_slice).collect(), residual, variance };
        let x = DVector::from_vec(vec![0.7_f64.ln(), 1.1_f64.ln(), 1.9_f64.ln()]);
        let lengths: Vec<f64> = x.iter().skip(1).map(|l| l.exp()).collect();
        let across = support.correlations_of(&rows.u, &lengths).0;
        let own = support.own_correlations(&lengths).0;
        let q = across.transpose() * own.try_inverse().unwrap() * &across;
        let sigma = DMatrix::from_fn(40, 40, |i, j| {
            0.49 * if i == j { 1.0 } else { q[(i, j)] } + if i == j { rows.variance[i] } else { 0.0 }
        });
        let factor = sigma.cholesky().unwrap();
        let log_det: f64 = 2.0 * factor.l().diagonal().iter().map(|l| l.ln()).sum::<f64>();
        let dense = -0.5 * (rows.residual.dot(&factor.solve(&rows.residual)) + log_det);
        let (value, gradient) = rows.log_marginal(&support, &x).unwrap();
        assert!((value - dense).abs() < 1e-5 * dense.abs(), "{value} {dense}");
        for i in 0..3 {
            let moved = |by: f64| {
                let mut x = x.clone();
                x[i] += by;
                rows.log_marginal(&support, &x).unwrap().0
            };
            let difference = (moved(1e-5) - moved(-1e-5)) / 2e-5;
            assert!(
                (difference - gradient[i]).abs() < 1e-4 * (1.0 + gradient[i].abs()),
                "{i}: {difference} {}",
                gradient[i]
            );
        }
    }

    #[test]
    fn a_function_is_found_and_noise_has_none() {
        let (support, u, residual, variance) = example();
        let own = || u.iter().map(Vec::as_slice).collect::<Vec<_>>();
        let rows = ModeRows { u: own(), residual: residual.clone(), variance: variance.clone() };
        let found = rows.fit(&support, None).unwrap();
        assert!(found.nats > 10.0 && found.std > 0.2, "{found:?}");
        let mut stream = stats::stream(4, "noise");
        let noise =
            DVector::from_fn(40, |j, _| variance[j].sqrt() * stats::normal_quantile(stream.random_range(0.001..0.999)));
        let found = ModeRows { u: own(), residual: noise, variance }.fit(&support, None).unwrap();
        // Twice the gain of one number that must be positive has half a χ² distribution with 1 degree of freedom: 3 nats are
        // exceeded with a probability of 0.7 %.
        assert!(found.nats < 3.0, "{found:?}");
    }
}
