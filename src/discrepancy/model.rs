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

use super::data::Data;
use super::response::Responses;
use super::row::{best_tails, weight, Density, RowSums, FIRST_TAILS};
use crate::physics::effect::Target;
use crate::simulator::law::{Input, Law, LawKind};
use crate::simulator::Simulator;

/// Steps of a fit at most.
const MOST_STEPS: usize = 40;

/// Rows from which a fit begins at that of a part of them, some [`FEW_ROWS`]: it takes many steps there, which are cheap, and
/// few with all.
const MANY_ROWS: usize = 1_200;
const FEW_ROWS: usize = 400;

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
    pub fn known(effect: &crate::simulator::effect::SimulationEffect) -> Self {
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

    /// The sizes at one input (`sizes`), and by each number the slope of the one that it moves (`slopes`).
    pub fn sizes(&self, input: Input, psi: &[f64], sizes: &mut [f64], slopes: &mut [f64]) {
        match self.target {
            Target::ModeOrder(_) => {}
            Target::Oscillator(_) => {
                sizes.copy_from_slice(psi);
                slopes.fill(1.0);
            }
            _ => sizes[0] = self.law.size(input, psi, slopes),
        }
    }

    /// Which of the sizes a number moves.
    fn moved(&self, number: usize) -> usize {
        match self.target {
            Target::Oscillator(_) => number,
            _ => 0,
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
    /// Of each row, the modes present and the sum of the logarithms of their stated noise.
    present: Vec<(Vec<usize>, f64)>,
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
        let present = |(y, noise): (&Vec<f64>, &Vec<f64>)| {
            let present: Vec<usize> = (0..y.len()).filter(|mode| y[*mode].is_finite()).collect();
            let log_noise = present.iter().map(|mode| noise[*mode].ln()).sum();
            (present, log_noise)
        };
        let present = data.log_frequencies.iter().zip(&data.noise).map(present).collect();
        Self { simulator, data, free, present }
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
        let problem = Problem::new(self, rows, effects);
        let (mut here, mut tails) = problem.first_point(start)?;
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
        let problem = Problem::new(self, rows, &fit.effects);
        let responses = problem.responses(&fit.mean, &problem.sizes(&fit.psi).values, &[])?;
        let density = Density::new(fit.tails, responses.modes());
        let view = |(place, row): (usize, &usize)| self.row_view(*row, fit, &density, &responses, place);
        Some(rows.iter().enumerate().map(view).collect())
    }

    /// Slopes of ln f by the sizes of `targets` beside the effects of a fit, at sizes 0, `[m, sizes]` for each row of `rows`.
    pub fn directions(&self, rows: &[usize], fit: &Fit, targets: &[Target]) -> Option<Vec<DMatrix<f64>>> {
        let problem = Problem::new(self, rows, &fit.effects);
        let further: usize = targets.iter().map(Target::sizes).sum();
        let sizes = problem.sizes(&fit.psi).values;
        let first = sizes.nrows();
        let sizes = sizes.resize_vertically(first + further, 0.0);
        let responses = problem.responses(&fit.mean, &sizes, targets)?;
        let slopes = |place: usize| {
            DMatrix::from_fn(responses.modes(), further, |mode, column| responses.by_size(place, mode)[first + column])
        };
        Some((0..rows.len()).map(slopes).collect())
    }

    /// Slopes of M by the free means and all ψ, `[m, ·]` for each row, in their own units.
    pub fn nuisance(&self, rows: &[usize], fit: &Fit) -> Option<Vec<DMatrix<f64>>> {
        let problem = Problem::new(self, rows, &fit.effects);
        let sizes = problem.sizes(&fit.psi);
        let responses = problem.responses(&fit.mean, &sizes.values, &[])?;
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
                let by_size = responses.by_size(place, mode);
                for (number, (moved, slope)) in sizes.moved.iter().zip(sizes.slopes.column(place).iter()).enumerate() {
                    by[(mode, free + number)] = by_size[*moved] * slope;
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

    fn row_view(&self, row: usize, fit: &Fit, density: &Density, responses: &Responses, place: usize) -> RowView {
        let y = &self.data.log_frequencies[row];
        let present = self.present[row].0.clone();
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
            log_density: density.log(distance, present.len(), half_log_det),
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
    /// Inputs of each effect at each row; of those with a lag, which moves with ψ, none.
    inputs: Vec<Vec<Input>>,
}

/// Sizes of all effects at each row.
struct Sizes {
    /// `[sizes, rows]`
    values: DMatrix<f64>,
    /// By each number of ψ, the slope of the size that it moves, `[ψ, rows]`.
    slopes: DMatrix<f64>,
    /// Which size that is.
    moved: Vec<usize>,
}

impl<'a> Problem<'a> {
    fn new(study: &'a Study<'a>, rows: &'a [usize], effects: &'a [Effect]) -> Self {
        let inputs = |effect: &Effect| match effect.lag() {
            Some(_) => Vec::new(),
            None => inputs(study.data, rows, effect, None),
        };
        Self { study, rows, effects, inputs: effects.iter().map(inputs).collect() }
    }

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

    /// Where a fit begins, and its tails: at the fit of a part of the rows where they are many, else at `start`.
    fn first_point(&self, start: Option<&Start<'_>>) -> Option<(Point, f64)> {
        if self.rows.len() >= MANY_ROWS {
            let part: Vec<usize> = self.rows.iter().step_by(self.rows.len() / FEW_ROWS).copied().collect();
            if let Some(fit) = self.study.fit(&part, self.effects, start) {
                let psi = fit.psi.iter().cloned().map(Some).collect();
                let mut eta = self.origin();
                self.set_out(&mut eta, &Start { fit: &fit, psi });
                if let Some(point) = self.point(&eta, fit.tails) {
                    return Some((point, fit.tails));
                }
            }
        }
        let mut eta = self.origin();
        let Some(start) = start else { return Some((self.point(&eta, FIRST_TAILS)?, FIRST_TAILS)) };
        self.set_out(&mut eta, start);
        let tails = start.fit.tails;
        // A first guess that leaves no stiffness somewhere is taken nearer to nothing.
        let shares = [1.0, 0.5, 0.2, 0.05, 0.0].into_iter();
        let point = { shares }.find_map(|share| self.point(&self.towards_prior(&eta, start, share), tails));
        Some((point?, tails))
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

    fn sizes(&self, psi: &[Vec<f64>]) -> Sizes {
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

    /// Responses of all rows under the effects and `further` targets; `sizes`: `[sizes, rows]`.
    fn responses(&self, mean: &[f64], sizes: &DMatrix<f64>, further: &[Target]) -> Option<Responses> {
        let targets: Vec<Target> = self.effects.iter().map(|e| &e.target).chain(further).cloned().collect();
        let settings = &self.study.data.settings;
        let set = |k: usize, place: usize| settings[self.rows[place]][k].unwrap_or(mean[k]);
        let theta = DMatrix::from_fn(mean.len(), self.rows.len(), set);
        Responses::new(self.study.simulator, &targets, &theta, sizes)
    }

    /// Value, gradient and information at a point; `None` where the structure has no frequencies.
    fn point(&self, eta: &DVector<f64>, tails: f64) -> Option<Point> {
        let (mean, spread, noise, psi) = self.unpack(eta);
        let data = self.study.data;
        let free = &self.study.free;
        let (means, variances) = (self.means(), free.len() + self.modes());
        let unknowns = means + variances;
        let sizes = self.sizes(&psi);
        let responses = self.responses(&mean, &sizes.values, &[])?;
        let scales: Vec<f64> =
            free.iter().map(|k| self.scale(*k).1).chain(self.numbers().map(|n| n.prior_std)).collect();

        let mut gradient = DVector::zeros(unknowns);
        let mut information = DMatrix::<f64>::zeros(unknowns, unknowns);
        let mut distances = Vec::with_capacity(self.rows.len());
        let log_factors: Vec<f64> = noise.iter().map(|factor| factor.ln()).collect();
        let mut of_row = RowSums::new(means, free.len(), self.modes());
        for (place, &row) in self.rows.iter().enumerate() {
            let (present, log_noise) = &self.study.present[row];
            for (i, &mode) in present.iter().enumerate() {
                let inverse = 1.0 / (noise[mode] * data.noise[row][mode]);
                of_row.residual[i] = inverse * (data.log_frequencies[row][mode] - responses.log_frequency(place, mode));
                let by_parameter = responses.by_parameter(place, mode);
                for (column, k) in free.iter().enumerate() {
                    let slope = if data.settings[row][*k].is_none() { inverse * by_parameter[*k] } else { 0.0 };
                    of_row.slopes[i * means + column] = slope * scales[column];
                    of_row.spreads[i * free.len() + column] = slope * spread[*k];
                }
                let by_size = responses.by_size(place, mode);
                for (number, (moved, slope)) in sizes.moved.iter().zip(sizes.slopes.column(place).iter()).enumerate() {
                    let column = free.len() + number;
                    of_row.slopes[i * means + column] = inverse * by_size[*moved] * slope * scales[column];
                }
            }
            let (distance, log_stretch) = of_row.solve(present.len());
            let log_noise = log_noise + present.iter().map(|mode| log_factors[*mode]).sum::<f64>();
            distances.push((distance, present.len(), log_noise + log_stretch));
            of_row.add(present, distance, tails, &mut gradient, &mut information);
        }
        let log_likelihood = Density::new(tails, self.modes()).total(&distances);
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

/// Inputs of an effect at `rows`.
fn inputs(data: &Data, rows: &[usize], effect: &Effect, lag_days: Option<f64>) -> Vec<Input> {
    let all = data.inputs(&effect.law, lag_days);
    rows.iter().map(|row| all[*row]).collect()
}
