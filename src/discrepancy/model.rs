//! The likelihood of measurements under a simulation with effects, and its maximum.
//!
//! ```text
//!  ln y_j ~ t_ν( M(μ, c_j; ψ),  J_j diag(σ²) J_jᵀ + diag(s_i r_ij)² ),     J_j = ∂M/∂x at (μ, c_j)
//! ```
//!
//! M: logarithms of the frequencies; μ, σ: mean and spread of the parameters that nobody set; ψ: numbers of the effects;
//! r: stated relative noise, s: one factor of each mode; ν: weight of the tails, normal for ν → ∞. All but ν have a
//! normal prior (σ and s in their logarithms) and are found by Fisher scoring on the logarithm of the posterior. The slope
//! of J itself is left out of the step, not out of the value.

use nalgebra::{DMatrix, DVector};
use statrs::function::gamma::ln_gamma;

use super::data::Data;
use super::response::Responses;
use crate::physics::effect::Target;
use crate::simulator::law::{Input, Law, LawKind};
use crate::simulator::Simulator;

/// Weights of tails that a fit chooses from.
const TAILS: [f64; 7] = [3.0, 4.0, 6.0, 10.0, 20.0, 50.0, f64::INFINITY];

/// Steps of a fit at most.
const MOST_STEPS: usize = 40;

/// A fit ends when a step promises less than this, nats.
const ENOUGH_NATS: f64 = 5e-3;

/// Spread of a parameter before seeing data, as a share of its prior's width, and how far off that may be, ln.
const SPREAD_SHARE: f64 = 0.02;
const SPREAD_LN_STD: f64 = 1.5;

/// How far the noise may be from what is stated, ln.
const NOISE_LN_STD: f64 = 0.7;

/// One fitted number of an effect: its prior is normal, cut off at the bounds.
#[derive(Debug, Clone, PartialEq)]
pub struct Number {
    /// Name, as in the report.
    pub name: String,
    /// Mean of the prior; a fit begins there unless told otherwise.
    pub prior_mean: f64,
    /// Standard deviation of the prior.
    pub prior_std: f64,
    /// Bounds.
    pub bounds: (f64, f64),
}

/// An effect that data may have: what changes, how, and what is known of its numbers before.
#[derive(Debug, Clone, PartialEq)]
pub struct Effect {
    /// What changes.
    pub target: Target,
    /// By how much under which covariate.
    pub law: Law,
    /// Numbers ψ: those of the law, then the frequency of an oscillator.
    pub numbers: Vec<Number>,
}

impl Effect {
    /// An effect that the structure has already, with what is known of its numbers as their prior.
    pub fn known(effect: &crate::simulator::effect::Effect) -> Self {
        let mut names = effect.law.numbers();
        match effect.target {
            Target::Oscillator(_) => names.push("frequency_hz".to_owned()),
            Target::ModeOrder(_) => names.clear(),
            _ => {}
        }
        let number = |((name, mean), std): ((String, &f64), f64)| Number {
            name,
            prior_mean: *mean,
            // An exact number may move by next to nothing.
            prior_std: std.max(1e-6 * mean.abs()).max(1e-12),
            bounds: (f64::NEG_INFINITY, f64::INFINITY),
        };
        let numbers = names.into_iter().zip(&effect.psi).zip(effect.psi_std()).map(number).collect();
        Self { target: effect.target.clone(), law: effect.law.clone(), numbers }
    }

    /// Column of the lag among the numbers.
    pub fn lag(&self) -> Option<usize> {
        (self.law.kind == LawKind::Lagged).then(|| self.numbers.len() - 1)
    }

    /// Sizes at one input and, row by row of the sizes, their derivatives by the numbers.
    pub fn sizes(&self, input: Input, psi: &[f64]) -> (Vec<f64>, Vec<Vec<f64>>) {
        match self.target {
            Target::ModeOrder(_) => (Vec::new(), Vec::new()),
            Target::Oscillator(_) => (psi.to_vec(), vec![vec![1.0, 0.0], vec![0.0, 1.0]]),
            _ => {
                let mut slopes = vec![0.0; psi.len()];
                let size = self.law.size(input, psi, &mut slopes);
                (vec![size], vec![slopes])
            }
        }
    }
}

/// What a fit found.
#[derive(Debug, Clone)]
pub struct Fit {
    /// The effects.
    pub effects: Vec<Effect>,
    /// Mean of each parameter, `[d]`; the middle of the prior for one that is set in every row.
    pub mean: Vec<f64>,
    /// Spread of each parameter, `[d]`; 0 for one that is set in every row.
    pub spread: Vec<f64>,
    /// Factor on the stated noise, `[m]`.
    pub noise_factor: Vec<f64>,
    /// Numbers of each effect.
    pub psi: Vec<Vec<f64>>,
    /// ν.
    pub tails: f64,
    /// Covariance of the free means and all ψ, in that order and in their own units.
    pub covariance: DMatrix<f64>,
    /// Parameters that are free, in the order of `covariance`.
    pub free: Vec<usize>,
    /// ln p(y) at the maximum, nats.
    pub log_likelihood: f64,
    /// ln ∫ p(y) by Laplace's method, nats.
    pub log_evidence: f64,
    /// Unknowns: means, ψ, spreads, noise factors.
    pub unknowns: usize,
}

/// What one row says under a fit; `[present modes]` unless said otherwise.
pub struct RowView {
    /// The row.
    pub row: usize,
    /// Modes present.
    pub present: Vec<usize>,
    /// ln y − M.
    pub residual: DVector<f64>,
    /// V.
    pub covariance: DMatrix<f64>,
    /// Share of a normal row's weight.
    pub weight: f64,
    /// ln p(row), nats.
    pub log_density: f64,
    /// Best estimate of each parameter minus its mean, `[d]`.
    pub deviation: Vec<f64>,
    /// ∂M/∂x, `[present, d]`.
    pub by_parameter: DMatrix<f64>,
}

/// The data of a study and what is fitted to them.
pub struct Study<'a> {
    /// The simulation.
    pub simulator: &'a Simulator,
    /// The measurements.
    pub data: &'a Data,
    free: Vec<usize>,
}

/// Everything at one point: value, gradient and information in prior units.
struct Point {
    eta: DVector<f64>,
    log_likelihood: f64,
    log_posterior: f64,
    gradient: DVector<f64>,
    information: DMatrix<f64>,
    /// Mahalanobis distance, number of modes, and ½ ln|V| of each row.
    distances: Vec<(f64, usize, f64)>,
}

impl<'a> Study<'a> {
    /// A study of `data` under `simulator`.
    pub fn new(simulator: &'a Simulator, data: &'a Data) -> Self {
        let set = |k: &usize| data.settings.iter().all(|row| row[*k].is_some());
        let free = (0..simulator.space().len()).filter(|k| !set(k)).collect();
        Self { simulator, data, free }
    }

    /// Parameters that are not set in every row.
    pub fn free(&self) -> &[usize] {
        &self.free
    }

    /// The maximum of the posterior over `rows` with `effects`, from `start` where it has their numbers.
    ///
    /// # Errors
    /// `None` when the structure has no frequencies at the start.
    pub fn fit(&self, rows: &[usize], effects: &[Effect], start: Option<&Start<'_>>) -> Option<Fit> {
        let problem = Problem { study: self, rows, effects };
        let mut eta = problem.origin();
        let mut tails = TAILS[2];
        if let Some(start) = start {
            problem.set_out(&mut eta, start);
            tails = start.fit.tails;
        }
        let mut here = problem.point(&eta, tails);
        if let (None, Some(start)) = (&here, start) {
            // A first guess that leaves no stiffness somewhere is taken nearer to nothing.
            for share in [0.5, 0.2, 0.05, 0.0] {
                let shrunk = problem.towards_prior(&eta, start, share);
                here = problem.point(&shrunk, tails);
                if here.is_some() {
                    break;
                }
            }
        }
        let mut here = here?;
        for _ in 0..MOST_STEPS {
            // What stands at a bound and wants beyond it stays there, and out of the step of the others.
            let (mut information, mut gradient) = (here.information.clone(), here.gradient.clone());
            for held in problem.held(&here) {
                gradient[held] = 0.0;
                information.row_mut(held).fill(0.0);
                information.column_mut(held).fill(0.0);
                information[(held, held)] = 1.0;
            }
            let Some(factor) = information.cholesky() else { break };
            let step = factor.solve(&gradient);
            let promised = 0.5 * step.dot(&gradient);
            let before = here.log_posterior;
            let mut moved = false;
            let mut scale = 1.0;
            for _ in 0..8 {
                let mut trial = &here.eta + &step * scale;
                problem.bound(&mut trial);
                if let Some(point) = problem.point(&trial, tails).filter(|p| p.log_posterior > before) {
                    here = point;
                    moved = true;
                    break;
                }
                scale *= 0.4;
            }
            let better = best_tails(&here.distances);
            // Exact comparison: both come from the same list.
            #[allow(clippy::float_cmp, reason = "both are taken from one list")]
            let other_tails = better != tails;
            if other_tails {
                tails = better;
                here = problem.point(&here.eta.clone(), tails)?;
            } else if !moved || promised < ENOUGH_NATS {
                break;
            }
        }
        problem.fit_at(&here, tails)
    }

    /// Each row of `rows` under a fit.
    pub fn view(&self, rows: &[usize], fit: &Fit) -> Option<Vec<RowView>> {
        let problem = Problem { study: self, rows, effects: &fit.effects };
        let (sizes, _) = problem.all_sizes(&fit.psi);
        let responses = problem.responses(&fit.mean, &sizes, &[])?;
        Some(rows.iter().enumerate().map(|(place, row)| self.row_view(*row, fit, &responses, place)).collect())
    }

    /// Slopes of ln f by the sizes of `targets` beside the effects of a fit, at sizes 0, `[m, sizes]` for each row of `rows`.
    pub fn directions(&self, rows: &[usize], fit: &Fit, targets: &[Target]) -> Option<Vec<DMatrix<f64>>> {
        let problem = Problem { study: self, rows, effects: &fit.effects };
        let (mut sizes, _) = problem.all_sizes(&fit.psi);
        let further: usize = targets.iter().map(Target::sizes).sum();
        let first = sizes.first().map_or(0, Vec::len);
        for sizes in &mut sizes {
            sizes.extend(std::iter::repeat_n(0.0, further));
        }
        let responses = problem.responses(&fit.mean, &sizes, targets)?;
        let slopes = |place: usize| {
            DMatrix::from_fn(responses.modes(), further, |mode, column| responses.by_size(place, mode)[first + column])
        };
        Some((0..rows.len()).map(slopes).collect())
    }

    /// Slopes of M by the free means and all ψ, `[m, ·]` for each row, in their own units.
    pub fn nuisance(&self, rows: &[usize], fit: &Fit) -> Option<Vec<DMatrix<f64>>> {
        let problem = Problem { study: self, rows, effects: &fit.effects };
        let (sizes, slopes) = problem.all_sizes(&fit.psi);
        let responses = problem.responses(&fit.mean, &sizes, &[])?;
        let free = self.free.len();
        let columns = free + fit.psi.iter().map(Vec::len).sum::<usize>();
        let by = |(place, row): (usize, &usize)| {
            let mut by = DMatrix::zeros(responses.modes(), columns);
            for mode in 0..responses.modes() {
                for (column, k) in self.free.iter().enumerate() {
                    if self.data.settings[*row][*k].is_none() {
                        by[(mode, column)] = responses.by_parameter(place, mode)[*k];
                    }
                }
                for (by_size, slopes) in responses.by_size(place, mode).iter().zip(&slopes[place]) {
                    for (number, slope) in slopes {
                        by[(mode, free + number)] += by_size * slope;
                    }
                }
            }
            by
        };
        Some(rows.iter().enumerate().map(by).collect())
    }

    /// False for the effect on a setting in a row where nobody set it.
    pub fn is_set(&self, row: usize, target: &Target) -> bool {
        match target {
            Target::SettingOffset(k) | Target::SettingScale(k) => self.data.settings[row][*k].is_some(),
            _ => true,
        }
    }

    /// One over the variance of the prior of each free mean and all ψ.
    pub fn prior_information(&self, fit: &Fit) -> Vec<f64> {
        let mean = |k: &usize| {
            let p = &self.simulator.space().as_slice()[*k];
            (0.5 * (p.upper - p.lower)).powi(-2)
        };
        let numbers = fit.effects.iter().flat_map(|e| &e.numbers).map(|n| n.prior_std.powi(-2));
        self.free.iter().map(mean).chain(numbers).collect()
    }

    fn theta(&self, row: usize, mean: &[f64]) -> Vec<f64> {
        mean.iter().enumerate().map(|(k, mean)| self.data.settings[row][k].unwrap_or(*mean)).collect()
    }

    fn row_view(&self, row: usize, fit: &Fit, responses: &Responses, place: usize) -> RowView {
        let y = &self.data.log_frequencies[row];
        let present: Vec<usize> = (0..y.len()).filter(|mode| y[*mode].is_finite()).collect();
        let d = fit.mean.len();
        let spread = |k: usize| if self.data.settings[row][k].is_some() { 0.0 } else { fit.spread[k] };
        let residual = DVector::from_iterator(
            present.len(),
            present.iter().map(|mode| y[*mode] - responses.log_frequency(place, *mode)),
        );
        let by_parameter = DMatrix::from_fn(present.len(), d, |i, k| responses.by_parameter(place, present[i])[k]);
        let mut covariance = DMatrix::zeros(present.len(), present.len());
        for i in 0..present.len() {
            for j in 0..=i {
                let sum: f64 = (0..d).map(|k| by_parameter[(i, k)] * by_parameter[(j, k)] * spread(k).powi(2)).sum();
                covariance[(i, j)] = sum;
                covariance[(j, i)] = sum;
            }
            covariance[(i, i)] += (fit.noise_factor[present[i]] * self.data.noise[row][present[i]]).powi(2);
        }
        let factor = covariance.clone().cholesky().expect("noise is never 0");
        let solved = factor.solve(&residual);
        let distance = residual.dot(&solved);
        let half_log_det: f64 = factor.l_dirty().diagonal().iter().map(|l| l.ln()).sum();
        let deviation = (0..d).map(|k| spread(k).powi(2) * by_parameter.column(k).dot(&solved)).collect();
        RowView {
            row,
            log_density: log_density(distance, present.len(), half_log_det, fit.tails),
            weight: weight(distance, present.len(), fit.tails),
            present,
            residual,
            covariance,
            deviation,
            by_parameter,
        }
    }
}

/// Where a fit begins: at another fit, whose last effects are replaced by given numbers.
pub struct Start<'a> {
    /// The other fit.
    pub fit: &'a Fit,
    /// Numbers of each effect; `None` for the middle of their prior.
    pub psi: Vec<Option<Vec<f64>>>,
}

/// A fit of effects to rows. Unknowns in prior units: free means, ψ, ln spreads, ln noise factors.
struct Problem<'a> {
    study: &'a Study<'a>,
    rows: &'a [usize],
    effects: &'a [Effect],
}

/// Inputs of each effect at each row, and where a lag was tried.
type Inputs = Vec<Vec<Input>>;

/// Slopes of one size: (column of ψ over all effects, value).
type Slopes = Vec<Vec<(usize, f64)>>;

impl Problem<'_> {
    fn modes(&self) -> usize {
        self.study.simulator.modes()
    }

    fn numbers(&self) -> impl Iterator<Item = &Number> {
        self.effects.iter().flat_map(|e| &e.numbers)
    }

    fn means(&self) -> usize {
        self.study.free.len() + self.numbers().count()
    }

    fn unknowns(&self) -> usize {
        self.means() + self.study.free.len() + self.modes()
    }

    fn origin(&self) -> DVector<f64> {
        DVector::zeros(self.unknowns())
    }

    /// Middle and scale of a parameter's mean.
    fn scale(&self, k: usize) -> (f64, f64) {
        let p = &self.study.simulator.space().as_slice()[k];
        (f64::midpoint(p.lower, p.upper), 0.5 * (p.upper - p.lower))
    }

    fn set_out(&self, eta: &mut DVector<f64>, start: &Start<'_>) {
        let free = &self.study.free;
        for (column, k) in free.iter().enumerate() {
            let (middle, scale) = self.scale(*k);
            eta[column] = (start.fit.mean[*k] - middle) / scale;
            eta[self.means() + column] = (start.fit.spread[*k] / (2.0 * scale * SPREAD_SHARE)).ln() / SPREAD_LN_STD;
        }
        for mode in 0..self.modes() {
            eta[self.means() + free.len() + mode] = start.fit.noise_factor[mode].ln() / NOISE_LN_STD;
        }
        let mut column = free.len();
        for (effect, psi) in self.effects.iter().zip(&start.psi) {
            for (place, number) in effect.numbers.iter().enumerate() {
                if let Some(psi) = psi {
                    eta[column + place] = (psi[place] - number.prior_mean) / number.prior_std;
                }
            }
            column += effect.numbers.len();
        }
        self.bound(eta);
    }

    /// The same with the numbers of the last effect, where it is a new one, moved towards the middle of their prior.
    fn towards_prior(&self, eta: &DVector<f64>, start: &Start<'_>, share: f64) -> DVector<f64> {
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

    /// Keeps means in a box a little wider than the prior, ψ in their bounds, and the logarithms finite.
    fn bound(&self, eta: &mut DVector<f64>) {
        let free = self.study.free.len();
        for column in 0..free {
            eta[column] = eta[column].clamp(-1.2, 1.2);
        }
        for (place, number) in self.numbers().enumerate() {
            let unit = |v: f64| (v - number.prior_mean) / number.prior_std;
            eta[free + place] = eta[free + place].clamp(unit(number.bounds.0), unit(number.bounds.1));
        }
        for column in self.means()..self.unknowns() {
            eta[column] = eta[column].clamp(-6.0, 6.0);
        }
    }

    /// Unknowns at a bound whose gradient points beyond it.
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

    /// Mean, spread, noise factor and ψ of a point.
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
        let noise = (0..self.modes()).map(|mode| (NOISE_LN_STD * eta[first + mode]).exp()).collect();
        let mut column = self.study.free.len();
        let psi = self.effects.iter().map(|effect| {
            let value = |(place, n): (usize, &Number)| n.prior_mean + n.prior_std * eta[column + place];
            let psi: Vec<f64> = effect.numbers.iter().enumerate().map(value).collect();
            column += psi.len();
            psi
        });
        let psi = psi.collect();
        (mean, spread, noise, psi)
    }

    fn inputs(&self, psi: &[Vec<f64>]) -> Inputs {
        let of = |(effect, psi): (&Effect, &Vec<f64>)| {
            let all = self.study.data.inputs(&effect.law, effect.lag().map(|lag| psi[lag]));
            self.rows.iter().map(|row| all[*row]).collect()
        };
        self.effects.iter().zip(psi).map(of).collect()
    }

    /// All sizes of each row, and of each its slopes.
    fn all_sizes(&self, psi: &[Vec<f64>]) -> (Vec<Vec<f64>>, Vec<Slopes>) {
        let inputs = self.inputs(psi);
        (0..self.rows.len()).map(|place| self.sizes(&inputs, place, psi)).unzip()
    }

    /// All sizes of one row, and of each its slopes.
    fn sizes(&self, inputs: &Inputs, place: usize, psi: &[Vec<f64>]) -> (Vec<f64>, Slopes) {
        let (mut sizes, mut slopes) = (Vec::new(), Vec::new());
        let mut column = 0;
        for ((effect, inputs), psi) in self.effects.iter().zip(inputs).zip(psi) {
            let (mut own, mut by) = effect.sizes(inputs[place], psi);
            if !self.study.is_set(self.rows[place], &effect.target) {
                own.fill(0.0);
                for slopes in &mut by {
                    slopes.fill(0.0);
                }
            }
            sizes.extend(own);
            slopes.extend(by.into_iter().map(|by| by.into_iter().enumerate().map(|(i, s)| (column + i, s)).collect()));
            column += psi.len();
        }
        (sizes, slopes)
    }

    /// Responses of all rows under the effects and `further` targets.
    fn responses(&self, mean: &[f64], sizes: &[Vec<f64>], further: &[Target]) -> Option<Responses> {
        let targets: Vec<Target> = self.effects.iter().map(|e| &e.target).chain(further).cloned().collect();
        let theta: Vec<Vec<f64>> = self.rows.iter().map(|row| self.study.theta(*row, mean)).collect();
        Responses::new(self.study.simulator, &targets, &theta, sizes)
    }

    /// Value, gradient and information at a point; `None` where the structure has no frequencies.
    fn point(&self, eta: &DVector<f64>, tails: f64) -> Option<Point> {
        let (mean, spread, noise, psi) = self.unpack(eta);
        let data = self.study.data;
        let free = &self.study.free;
        let (means, variances) = (self.means(), free.len() + self.modes());
        let unknowns = means + variances;
        let (sizes, slopes) = self.all_sizes(&psi);
        let responses = self.responses(&mean, &sizes, &[])?;
        let scales: Vec<f64> =
            free.iter().map(|k| self.scale(*k).1).chain(self.numbers().map(|n| n.prior_std)).collect();

        let mut log_likelihood = 0.0;
        let mut gradient = DVector::zeros(unknowns);
        let mut information = DMatrix::<f64>::zeros(unknowns, unknowns);
        let mut distances = Vec::with_capacity(self.rows.len());
        // Columns of one row: residual, slopes of the mean, square root of V; whitened in place.
        let width = 1 + means + variances;
        let mut work: Vec<f64> = Vec::new();
        let mut factor: Vec<f64> = Vec::new();
        let mut products = vec![0.0; variances * variances];
        for (place, &row) in self.rows.iter().enumerate() {
            let y = &data.log_frequencies[row];
            let present: Vec<usize> = (0..y.len()).filter(|mode| y[*mode].is_finite()).collect();
            let p = present.len();
            work.clear();
            work.resize(p * width, 0.0);
            for (i, &mode) in present.iter().enumerate() {
                let line = &mut work[i * width..(i + 1) * width];
                line[0] = y[mode] - responses.log_frequency(place, mode);
                let by_parameter = responses.by_parameter(place, mode);
                for (column, k) in free.iter().enumerate() {
                    if data.settings[row][*k].is_none() {
                        let by = by_parameter[*k];
                        line[1 + column] = by * scales[column];
                        line[1 + means + column] = by * spread[*k];
                    }
                }
                for (by_size, slopes) in responses.by_size(place, mode).iter().zip(&slopes[place]) {
                    for (number, slope) in slopes {
                        let column = free.len() + number;
                        line[1 + column] += by_size * slope * scales[column];
                    }
                }
                line[1 + means + free.len() + mode] = noise[mode] * data.noise[row][mode];
            }
            let root = 1 + means;
            let half_log_det = whiten(&mut work, &mut factor, p, width, root);
            let distance: f64 = (0..p).map(|i| work[i * width].powi(2)).sum();
            let weight = weight(distance, p, tails);
            let (flat, deep) = if tails.is_finite() {
                let total = tails + p as f64;
                (total / (total + 2.0), 2.0 / (total + 2.0))
            } else {
                (1.0, 0.0)
            };
            log_likelihood += log_density(distance, p, half_log_det, tails);
            distances.push((distance, p, half_log_det));
            let row = WhiteRow { values: &work, width, means, variances, weight, flat, deep };
            row.add_means(&mut gradient, &mut information);
            row.add_variances(&mut products, &mut gradient, &mut information);
        }
        // From derivatives by ln σ and ln s to prior units.
        for u in 0..variances {
            let unit = if u < free.len() { SPREAD_LN_STD } else { NOISE_LN_STD };
            gradient[means + u] *= unit;
            for v in 0..=u {
                let other = if v < free.len() { SPREAD_LN_STD } else { NOISE_LN_STD };
                information[(means + u, means + v)] *= unit * other;
            }
        }
        for a in 0..unknowns {
            information[(a, a)] += 1.0;
            for b in a + 1..unknowns {
                information[(a, b)] = information[(b, a)];
            }
        }
        gradient -= eta;
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

    fn fit_at(&self, point: &Point, tails: f64) -> Option<Fit> {
        let (mean, spread, noise_factor, psi) = self.unpack(&point.eta);
        let factor = point.information.clone().cholesky()?;
        // Prior densities are standard normal in these units: their 2π cancels that of Laplace's integral.
        let half_log_det: f64 = factor.l_dirty().diagonal().iter().map(|l| l.ln()).sum();
        let means = self.means();
        let inverse = factor.inverse();
        let scales: Vec<f64> =
            self.study.free.iter().map(|k| self.scale(*k).1).chain(self.numbers().map(|n| n.prior_std)).collect();
        let covariance = DMatrix::from_fn(means, means, |a, b| inverse[(a, b)] * scales[a] * scales[b]);
        Some(Fit {
            effects: self.effects.to_vec(),
            mean,
            spread,
            noise_factor,
            psi,
            tails,
            covariance,
            free: self.study.free.clone(),
            log_likelihood: point.log_likelihood,
            log_evidence: point.log_posterior - half_log_det,
            unknowns: self.unknowns(),
        })
    }
}

impl Fit {
    /// Covariance of the numbers of effect `index`.
    pub fn psi_covariance(&self, index: usize) -> DMatrix<f64> {
        let first = self.free.len() + self.psi[..index].iter().map(Vec::len).sum::<usize>();
        let size = self.psi[index].len();
        self.covariance.view((first, first), (size, size)).into_owned()
    }
}

/// One whitened row: by lines of the modes present, residual, slopes of the mean, square root of V.
struct WhiteRow<'a> {
    values: &'a [f64],
    width: usize,
    means: usize,
    variances: usize,
    /// Of the residual, in the gradient.
    weight: f64,
    /// Of the information: (ν + p)/(ν + p + 2) and 2/(ν + p + 2), 1 and 0 for a normal distribution.
    flat: f64,
    deep: f64,
}

impl WhiteRow<'_> {
    /// Adds w Dᵀ V⁻¹ e and Dᵀ V⁻¹ D.
    fn add_means(&self, gradient: &mut DVector<f64>, information: &mut DMatrix<f64>) {
        for line in self.values.chunks_exact(self.width) {
            for a in 0..self.means {
                let slope = line[1 + a];
                if slope != 0.0 {
                    gradient[a] += self.weight * slope * line[0];
                    for b in 0..=a {
                        information[(a, b)] += self.flat * slope * line[1 + b];
                    }
                }
            }
        }
    }

    /// Adds the score and information of the logarithms of the columns of G: with h = Gᵀ V⁻¹ e and B = Gᵀ V⁻¹ G,
    /// w h_u² − B_uu and 2 B_uv², less what the tails take.
    fn add_variances(&self, products: &mut [f64], gradient: &mut DVector<f64>, information: &mut DMatrix<f64>) {
        let (root, count) = (1 + self.means, self.variances);
        products.fill(0.0);
        for u in 0..count {
            let mut along = 0.0;
            for line in self.values.chunks_exact(self.width) {
                let slope = line[root + u];
                if slope != 0.0 {
                    along += slope * line[0];
                    for v in 0..=u {
                        products[u * count + v] += slope * line[root + v];
                    }
                }
            }
            gradient[self.means + u] += self.weight * along * along - products[u * count + u];
        }
        for u in 0..count {
            for v in 0..=u {
                let shared = products[u * count + v];
                let own = products[u * count + u] * products[v * count + v];
                information[(self.means + u, self.means + v)] += self.flat * 2.0 * shared * shared - self.deep * own;
            }
        }
    }
}

/// Factors V = G Gᵀ = L Lᵀ, G the columns of `work` from `root` on, and multiplies every column by L⁻¹; ½ ln|V|.
fn whiten(work: &mut [f64], factor: &mut Vec<f64>, p: usize, width: usize, root: usize) -> f64 {
    factor.clear();
    factor.resize(p * p, 0.0);
    let mut half_log_det = 0.0;
    for i in 0..p {
        for j in 0..=i {
            let (a, b) = (&work[i * width + root..(i + 1) * width], &work[j * width + root..(j + 1) * width]);
            let mut sum: f64 = a.iter().zip(b).map(|(a, b)| a * b).sum();
            for k in 0..j {
                sum -= factor[i * p + k] * factor[j * p + k];
            }
            factor[i * p + j] = if i == j { sum.max(1e-300).sqrt() } else { sum / factor[j * p + j] };
        }
        half_log_det += factor[i * p + i].ln();
    }
    for i in 0..p {
        let (done, rest) = work.split_at_mut(i * width);
        let line = &mut rest[..width];
        for j in 0..i {
            let l = factor[i * p + j];
            for (value, earlier) in line.iter_mut().zip(&done[j * width..(j + 1) * width]) {
                *value -= l * earlier;
            }
        }
        let inverse = 1.0 / factor[i * p + i];
        for value in line.iter_mut() {
            *value *= inverse;
        }
    }
    half_log_det
}

/// Share of a normal row's weight that a row at `distance` has.
fn weight(distance: f64, modes: usize, tails: f64) -> f64 {
    if tails.is_finite() {
        (tails + modes as f64) / (tails + distance)
    } else {
        1.0
    }
}

/// Logarithm of the density of a multivariate t, or normal, distribution.
fn log_density(distance: f64, modes: usize, half_log_det: f64, tails: f64) -> f64 {
    let m = modes as f64;
    if tails.is_finite() {
        ln_gamma(0.5 * (tails + m))
            - ln_gamma(0.5 * tails)
            - 0.5 * m * (tails * std::f64::consts::PI).ln()
            - half_log_det
            - 0.5 * (tails + m) * (distance / tails).ln_1p()
    } else {
        -0.5 * distance - half_log_det - 0.5 * m * std::f64::consts::TAU.ln()
    }
}

/// The tails that make the rows most probable; distances are those of the present scale.
fn best_tails(distances: &[(f64, usize, f64)]) -> f64 {
    let total = |tails: f64| distances.iter().map(|(q, m, half)| log_density(*q, *m, *half, tails)).sum::<f64>();
    TAILS.into_iter().map(|t| (total(t), t)).max_by(|a, b| a.0.total_cmp(&b.0)).map_or(f64::INFINITY, |best| best.1)
}
