//! The posterior density of a fit's unknowns, with its gradient and information.

use nalgebra::{DMatrix, DVector};

use super::corrected::corrected_responses;
use super::data::Data;
use super::effect::{FittedEffect, Number};
use super::fit::{Fit, Start};
use super::outside::{corrected_settings, outside};
use super::response::Responses;
use super::row::{Density, RowSums};
use super::study::{Present, Study};
use structures::parameter::Parameter;
use structures::physics::effect::Target;
use structures::simulator::law::Input;

/// Prior median of a parameter's standard deviation between rows, as a share of the width of the parameter's prior (of two standard
/// deviations of a prior that is not uniform), and the
/// standard deviation of its logarithm.
const SPREAD_SHARE: f64 = 0.02;
const SPREAD_LN_STD: f64 = 1.5;

/// Share of the width of its prior beyond which the mean of a parameter is not searched, and its smallest value, as a share of the lower end of
/// a prior of positive values.
const BEYOND_PRIOR: f64 = 0.1;
const LEAST_SHARE: f64 = 0.02;

/// With fewer rows than this, the second derivatives of the log posterior replace their expectation in Laplace's approximation.
const FEW_ROWS: usize = 40;

/// Step of the differences that give the second derivatives, in posterior standard deviations.
const DIFFERENCE: f64 = 0.02;

/// Prior standard deviation of the logarithm of a noise factor.
const NOISE_LN_STD: f64 = 0.7;

/// A fit of effects to rows.
///
/// The unknowns η are standardised by their priors, in this order: free means, all ψ, ln spreads of the free parameters, ln
/// noise factors of the frequencies of the modes and, if shapes were measured, of their shapes.
pub(super) struct Problem<'a> {
    study: &'a Study<'a>,
    pub(super) rows: &'a [usize],
    pub(super) effects: &'a [FittedEffect],
    /// Inputs of each effect at each row; empty for a law with a lag, whose inputs change with ψ.
    inputs: Vec<Vec<Input>>,
    /// Whether the noise is held as it is stated.
    pub(super) noise_is_stated: bool,
}

/// Sizes of all effects at each row.
pub(super) struct Sizes {
    /// `[sizes, rows]`
    pub(super) values: DMatrix<f64>,
    /// Derivative of a size by the number of ψ that moves it, `[ψ, rows]`.
    pub(super) slopes: DMatrix<f64>,
    /// Index of the size that each number moves, `[ψ]`.
    pub(super) moved: Vec<usize>,
}

/// Value, gradient and information of the log posterior at one point, in units of the priors.
pub(super) struct Point {
    /// The unknowns, `[unknowns]`.
    pub(super) eta: DVector<f64>,
    log_likelihood: f64,
    pub(super) log_posterior: f64,
    gradient: DVector<f64>,
    information: DMatrix<f64>,
    /// Squared Mahalanobis distance, number of outputs and ½ ln|V| of each row.
    pub(super) distances: Vec<(f64, usize, f64)>,
}

/// A step of Fisher scoring.
pub(super) struct ScoringStep {
    /// Change of the unknowns, `[unknowns]`.
    pub(super) by: DVector<f64>,
    /// Half the product of step and gradient: the expected gain in log posterior, which is exact for a quadratic one, nats.
    pub(super) promised_nats: f64,
}

impl<'a> Problem<'a> {
    pub(super) fn new(study: &'a Study<'a>, rows: &'a [usize], effects: &'a [FittedEffect]) -> Self {
        let inputs = |effect: &FittedEffect| match effect.lag() {
            Some(_) => Vec::new(),
            None => inputs(study.data, rows, effect, None),
        };
        Self { study, rows, effects, inputs: effects.iter().map(inputs).collect(), noise_is_stated: false }
    }

    fn numbers(&self) -> impl Iterator<Item = &Number> {
        self.effects.iter().flat_map(|e| &e.numbers)
    }

    /// Number of unknowns of the mean: free means and all ψ.
    fn means(&self) -> usize {
        self.study.free.len() + self.numbers().count()
    }

    fn unknowns(&self) -> usize {
        self.means() + self.study.free.len() + self.study.groups()
    }

    /// The prior means of all unknowns, `[unknowns]`.
    pub(super) fn origin(&self) -> DVector<f64> {
        DVector::zeros(self.unknowns())
    }

    /// Prior mean and standard deviation of the mean of parameter `k`.
    fn scale(&self, k: usize) -> (f64, f64) {
        self.study.simulator.space().as_slice()[k].as_normal()
    }

    /// Sets the unknowns `eta` to the values of a start.
    pub(super) fn set_out(&self, eta: &mut DVector<f64>, start: &Start<'_>) {
        let free = &self.study.free;
        for (column, k) in free.iter().enumerate() {
            let (middle, scale) = self.scale(*k);
            eta[column] = (start.fit.mean[*k] - middle) / scale;
            eta[self.means() + column] = (start.fit.spread[*k] / (2.0 * scale * SPREAD_SHARE)).ln() / SPREAD_LN_STD;
        }
        let noise = start.fit.noise_factor.iter().chain(&start.fit.shape_noise_factor);
        for (group, factor) in noise.enumerate() {
            eta[self.means() + free.len() + group] = factor.ln() / NOISE_LN_STD;
        }
        let mut column = free.len();
        for (effect, psi) in self.effects.iter().zip(&start.psi) {
            for (place, number) in effect.numbers.iter().enumerate() {
                if let Some(psi) = psi {
                    eta[column + place] = number.score(psi[place]);
                }
            }
            column += effect.numbers.len();
        }
        self.bound(eta);
    }

    /// The same point with the numbers of the last effect, if it is new in this fit, multiplied by `share` in prior units.
    pub(super) fn towards_prior(&self, eta: &DVector<f64>, start: &Start<'_>, share: f64) -> DVector<f64> {
        let mut shrunk = eta.clone();
        let new = start.psi.len() > start.fit.effects.len();
        if let Some(effect) = self.effects.last().filter(|_| new) {
            let first = self.means() - effect.numbers.len();
            for column in first..self.means() {
                shrunk[column] *= share;
            }
        }
        shrunk
    }

    /// Clamps the means to the range in which they are searched, ψ to their bounds, and the logarithms to a finite range.
    pub(super) fn bound(&self, eta: &mut DVector<f64>) {
        let free = self.study.free.len();
        for (column, k) in self.study.free.iter().enumerate() {
            let (middle, scale) = self.scale(*k);
            let [low, high] = searched(&self.study.simulator.space().as_slice()[*k]).map(|end| (end - middle) / scale);
            eta[column] = eta[column].clamp(low, high);
        }
        for (place, number) in self.numbers().enumerate() {
            let (low, high) = number.bounds;
            eta[free + place] = eta[free + place].clamp(number.score(low), number.score(high));
        }
        for column in self.means()..self.unknowns() {
            let most = if self.noise_is_stated && column >= self.means() + free { 0.0 } else { 6.0 };
            eta[column] = eta[column].clamp(-most, most);
        }
    }

    /// Unknowns at a bound at which the gradient points out of the allowed range.
    fn held(&self, point: &Point) -> Vec<usize> {
        let beyond = |column: &usize| {
            let mut moved = point.eta.clone();
            moved[*column] += 1e-6 * point.gradient[*column].signum();
            let wanted = moved[*column];
            self.bound(&mut moved);
            (moved[*column] - wanted).abs() > 1e-9
        };
        (0..self.unknowns()).filter(beyond).collect()
    }

    /// Derivatives of the free means and all ψ by their standard scores, `[free + ψ]`.
    fn scales(&self, psi: &[Vec<f64>]) -> Vec<f64> {
        let of_means = self.study.free.iter().map(|k| self.scale(*k).1);
        of_means.chain(self.numbers().zip(psi.iter().flatten()).map(|(n, psi)| n.by_score(*psi))).collect()
    }

    /// Means `[d]`, spreads `[d]`, noise factors `[groups]` and the ψ of each effect at a point.
    fn unpack(&self, eta: &DVector<f64>) -> (Vec<f64>, Vec<f64>, Vec<f64>, Vec<Vec<f64>>) {
        let d = self.study.simulator.space().len();
        let mut mean: Vec<f64> = (0..d).map(|k| self.scale(k).0).collect();
        let mut spread = vec![0.0; d];
        for (column, k) in self.study.free.iter().enumerate() {
            let (middle, scale) = self.scale(*k);
            mean[*k] = middle + scale * eta[column];
            spread[*k] = 2.0 * scale * SPREAD_SHARE * (SPREAD_LN_STD * eta[self.means() + column]).exp();
        }
        let first = self.means() + self.study.free.len();
        let noise = (0..self.study.groups()).map(|group| (NOISE_LN_STD * eta[first + group]).exp()).collect();
        let mut column = self.study.free.len();
        let psi = self.effects.iter().map(|effect| {
            let value = |(place, n): (usize, &Number)| n.at(eta[column + place]);
            let psi: Vec<f64> = effect.numbers.iter().enumerate().map(value).collect();
            column += psi.len();
            psi
        });
        let psi = psi.collect();
        (mean, spread, noise, psi)
    }

    /// Sizes of all effects at each row, and their derivatives by ψ.
    pub(super) fn sizes(&self, psi: &[Vec<f64>]) -> Sizes {
        let count = self.effects.iter().map(|effect| effect.target.sizes()).sum();
        let mut values = DMatrix::zeros(count, self.rows.len());
        let mut slopes = DMatrix::zeros(psi.iter().map(Vec::len).sum(), self.rows.len());
        let mut moved = Vec::with_capacity(slopes.nrows());
        let mut first = 0;
        for ((effect, inputs_without_lag), psi) in self.effects.iter().zip(&self.inputs).zip(psi) {
            let lagged = effect.lag().map(|lag| inputs(self.study.data, self.rows, effect, Some(psi[lag])));
            let inputs = lagged.as_ref().unwrap_or(inputs_without_lag);
            let own = first..first + effect.target.sizes();
            let numbers = moved.len()..moved.len() + psi.len();
            moved.extend((0..psi.len()).map(|place| first + effect.moved(place)));
            for (place, (row, input)) in self.rows.iter().zip(inputs).enumerate() {
                if self.study.is_set(*row, &effect.target) {
                    let (mut values, mut slopes) = (values.column_mut(place), slopes.column_mut(place));
                    let values = &mut values.as_mut_slice()[own.clone()];
                    effect.sizes(*input, psi, values, &mut slopes.as_mut_slice()[numbers.clone()]);
                }
            }
            first = own.end;
        }
        Sizes { values, slopes, moved }
    }

    /// The parameters of each row after the corrections of its settings, `[rows][d]`; empty if nothing was set.
    pub(super) fn corrected_settings(&self, mean: &[f64], sizes: &DMatrix<f64>) -> Vec<Vec<f64>> {
        if self.study.limits.iter().all(Option::is_none) {
            return Vec::new();
        }
        let targets: Vec<Target> = self.effects.iter().map(|e| e.target.clone()).collect();
        corrected_settings(self.study.data, self.rows, mean, &targets, sizes)
    }

    /// Responses of all rows under the effects and `further` targets; `sizes`: `[sizes, rows]`. `None` if the frequencies
    /// cannot be computed in some row.
    pub(super) fn responses(&self, mean: &[f64], sizes: &DMatrix<f64>, further: &[Target]) -> Option<Responses> {
        let targets: Vec<Target> = self.effects.iter().map(|e| &e.target).chain(further).cloned().collect();
        let settings = &self.study.data.settings;
        let set = |k: usize, place: usize| settings[self.rows[place]][k].unwrap_or(mean[k]);
        let theta = DMatrix::from_fn(mean.len(), self.rows.len(), set);
        let reference = self.study.data.shapes.as_ref().map(|shapes| shapes.reference.as_slice());
        corrected_responses(self.study.simulator, reference, &targets, (&theta, sizes), &self.study.limits)
    }

    /// Value, gradient and information at a point; `None` if the frequencies cannot be computed in some row.
    pub(super) fn point(&self, eta: &DVector<f64>, tails: f64) -> Option<Point> {
        let (mean, spread, noise, psi) = self.unpack(eta);
        let data = self.study.data;
        let free = &self.study.free;
        let (means, unknowns) = (self.means(), self.unknowns());
        let sizes = self.sizes(&psi);
        let responses = self.responses(&mean, &sizes.values, &[])?;
        let scales = self.scales(&psi);

        let mut gradient = DVector::zeros(unknowns);
        let mut information = DMatrix::<f64>::zeros(unknowns, unknowns);
        let mut distances = Vec::with_capacity(self.rows.len());
        let log_factors: Vec<f64> = noise.iter().map(|factor| factor.ln()).collect();
        let mut of_row = RowSums::new(means, free.len(), self.study.outputs());
        for (place, &row) in self.rows.iter().enumerate() {
            let Present { outputs, groups, log_noise } = &self.study.present[row];
            for (i, (&output, &group)) in outputs.iter().zip(groups).enumerate() {
                let inverse = 1.0 / (noise[group] * self.study.noise(row, output));
                of_row.residual[i] = inverse * (self.study.observed(row, output) - responses.value(place, output));
                let by_parameter = responses.by_parameter(place, output);
                for (column, k) in free.iter().enumerate() {
                    let slope = if data.settings[row][*k].is_none() { inverse * by_parameter[*k] } else { 0.0 };
                    of_row.slopes[i * means + column] = slope * scales[column];
                    of_row.spreads[i * free.len() + column] = slope * spread[*k];
                }
                let by_size = responses.by_size(place, output);
                for (number, (moved, slope)) in sizes.moved.iter().zip(sizes.slopes.column(place).iter()).enumerate() {
                    let column = free.len() + number;
                    of_row.slopes[i * means + column] = inverse * by_size[*moved] * slope * scales[column];
                }
            }
            let (distance, half_log_det_scaled) = of_row.solve(outputs.len());
            let log_noise = log_noise + groups.iter().map(|group| log_factors[*group]).sum::<f64>();
            distances.push((distance, outputs.len(), log_noise + half_log_det_scaled));
            of_row.add(groups, distance, tails, &mut gradient, &mut information);
        }
        let log_likelihood = Density::new(tails, self.study.outputs()).total(&distances);
        self.add_prior(eta, &mut gradient, &mut information);
        let log_posterior = log_likelihood - 0.5 * eta.norm_squared();
        log_posterior.is_finite().then_some(Point {
            eta: eta.clone(),
            log_likelihood,
            log_posterior,
            gradient,
            information,
            distances,
        })
    }

    /// Turns the derivatives by ln σ and ln s into prior units, and adds those of the standard normal prior.
    fn add_prior(&self, eta: &DVector<f64>, gradient: &mut DVector<f64>, information: &mut DMatrix<f64>) {
        let (means, free) = (self.means(), self.study.free.len());
        for u in 0..free + self.study.groups() {
            let unit = if u < free { SPREAD_LN_STD } else { NOISE_LN_STD };
            gradient[means + u] *= unit;
            for v in 0..=u {
                let other = if v < free { SPREAD_LN_STD } else { NOISE_LN_STD };
                information[(means + u, means + v)] *= unit * other;
            }
        }
        for a in 0..self.unknowns() {
            information[(a, a)] += 1.0;
            for b in a + 1..self.unknowns() {
                information[(a, b)] = information[(b, a)];
            }
        }
        *gradient -= eta;
    }

    /// The step of Fisher scoring from a point; `None` if the information is singular.
    pub(super) fn step(&self, point: &Point) -> Option<ScoringStep> {
        // An unknown that is held at its bound does not move, and takes no part in the step of the others.
        let (mut information, mut gradient) = (point.information.clone(), point.gradient.clone());
        for held in self.held(point) {
            gradient[held] = 0.0;
            information.row_mut(held).fill(0.0);
            information.column_mut(held).fill(0.0);
            information[(held, held)] = 1.0;
        }
        let by = information.cholesky()?.solve(&gradient);
        Some(ScoringStep { promised_nats: 0.5 * by.dot(&gradient), by })
    }

    /// The information at a maximum for Laplace's approximation: the expected information, or for few rows minus the second
    /// derivatives of the log posterior, by central differences of its gradient, which differ from their expectation there.
    fn information(&self, point: &Point, tails: f64) -> Option<DMatrix<f64>> {
        let expected = &point.information;
        if self.rows.len() >= FEW_ROWS {
            return Some(expected.clone());
        }
        let stds = expected.clone().cholesky()?.inverse().diagonal().map(f64::sqrt);
        let held = self.held(point);
        let mut observed = expected.clone();
        for u in (0..self.unknowns()).filter(|u| !held.contains(u)) {
            let step = DIFFERENCE * stds[u];
            let at = |sign: f64| {
                let mut moved = point.eta.clone();
                moved[u] += sign * step;
                self.point(&moved, tails).map(|p| p.gradient)
            };
            let Some((up, down)) = at(1.0).zip(at(-1.0)) else { return Some(expected.clone()) };
            let column = (down - up) / (2.0 * step);
            for v in (0..self.unknowns()).filter(|v| !held.contains(v)) {
                observed[(v, u)] = column[v];
            }
        }
        let observed = (&observed + observed.transpose()) * 0.5;
        // Away from a maximum, which a fit that ended at its last step may be, the second derivatives may not be definite.
        Some(if observed.clone().cholesky().is_some() { observed } else { expected.clone() })
    }

    /// The fit at a point, with Laplace's approximation of the evidence; `None` if the information is singular.
    pub(super) fn fit_at(&self, point: &Point, tails: f64) -> Option<Fit> {
        let (mean, spread, mut noise_factor, psi) = self.unpack(&point.eta);
        let shape_noise_factor = noise_factor.split_off(self.study.simulator.modes());
        let factor = self.information(point, tails)?.cholesky()?;
        // The priors are standard normal in these units, so that their factors of 2π cancel those of Laplace's integral.
        let half_log_det: f64 = factor.l_dirty().diagonal().iter().map(|l| l.ln()).sum();
        let means = self.means();
        let inverse = factor.inverse();
        let scales = self.scales(&psi);
        let covariance = DMatrix::from_fn(means, means, |a, b| inverse[(a, b)] * scales[a] * scales[b]);
        let first = means + self.study.free.len();
        let ln_std = |mode: usize| NOISE_LN_STD * inverse[(first + mode, first + mode)].max(0.0).sqrt();
        let corrected = self.corrected_settings(&mean, &self.sizes(&psi).values);
        let mut log_evidence = point.log_posterior - half_log_det;
        let mut number = self.study.free.len();
        for (effect, psi) in self.effects.iter().zip(&psi) {
            if let Some(mixture) = &effect.mixture {
                let own = covariance.view((number, number), (psi.len(), psi.len()));
                log_evidence += mixture.log_ratio(psi, &own.into_owned())?;
            }
            number += psi.len();
        }
        Some(Fit {
            effects: self.effects.to_vec(),
            mean,
            spread,
            noise_factor,
            shape_noise_factor,
            psi,
            tails,
            covariance,
            free: self.study.free.clone(),
            noise_factor_ln_std: (0..self.study.simulator.modes()).map(ln_std).collect(),
            outside: outside(self.study.simulator, self.study.data, self.rows, &corrected),
            log_likelihood: point.log_likelihood,
            log_evidence,
            unknowns: self.unknowns(),
        })
    }
}

/// Whether the mean of a parameter is an end of the range in which it is searched.
pub(super) fn is_searched_to_the_end(parameter: &Parameter, mean: f64) -> bool {
    let [low, high] = searched(parameter);
    let margin = 1e-6 * (high - low);
    !(low + margin..=high - margin).contains(&mean)
}

/// Range in which the mean of a parameter is searched, in its unit: the interval of its prior and a tenth of its width beyond either end, but
/// no negative stiffness.
fn searched(parameter: &Parameter) -> [f64; 2] {
    let beyond = BEYOND_PRIOR * (parameter.upper - parameter.lower);
    let low = parameter.lower - beyond;
    let low = if parameter.lower > 0.0 { low.max(LEAST_SHARE * parameter.lower) } else { low };
    [low, parameter.upper + beyond]
}

/// Inputs of an effect at `rows`.
fn inputs(data: &Data, rows: &[usize], effect: &FittedEffect, lag_days: Option<f64>) -> Vec<Input> {
    let all = data.inputs(&effect.law, lag_days);
    rows.iter().map(|row| all[*row]).collect()
}
