//! Adaptive importance sampling in the latent space of the flow, for measurements whose posterior the flow does not match.
//!
//! The flow maps z to parameters x, and its own draws have z ~ N(0, I). A flow that is wider than the posterior, or lies beside it,
//! leaves few effective draws: accurate frequencies give a thin curved posterior. The first draws are then moved onto the posterior, and a
//! mixture of local normal approximations about them proposes, see `crates/inference/src/baseline/local.rs`.
//!
//! Where that does not give enough effective draws, as with many directions that the frequencies do not determine, the proposals adapt
//! in the space of z, in which the posterior is nearer to a normal distribution than in that of x, because the flow has removed most of
//! the curvature. Stage by stage, a Student distribution of z is fitted to the weighted draws of all stages before and proposes the next
//! ones:
//!
//! ```text
//!  q_0 = N(0, I),    q_t = t_ν(m_t, S_t),    q(z) = Σ_t n_t q_t(z) / Σ_t n_t
//!  w(z) = p(y | x(z)) p(x(z)) |∂x/∂z| / q(z) inside the prior, 0 outside
//!  m_t, S_t: mean and covariance of z under the weights w^β, β ≤ 1 the largest exponent that leaves enough effective draws
//! ```
//!
//! The draws of N(0, I) stay in the mixture q, so that no weight grows beyond that of a draw of the flow times the number of stages.
//!
//! Source: J.-M. Cornuet, J.-M. Marin, A. Mira, C. P. Robert (2012), Adaptive multiple importance sampling, Scandinavian Journal of
//! Statistics 39, 798–812.

use std::ops::Range;

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::error::InferenceError;
use super::local::{Target, STARTS};
use super::model::Baseline;
use super::observation::Observation;
use super::proposal::Proposal;
use super::real_line::from_real_line;
use super::resample::log_posteriors;
use structures::stats::{self, Stream};

/// Stages of a measurement, the first one included.
const STAGES: usize = 8;

/// Stages after which a measurement is given up of whose draws less than [`HOPEFUL`] are effective.
const STAGES_BEFORE_DOUBT: usize = 4;

/// Share of the draws, see [`STAGES_BEFORE_DOUBT`].
const HOPEFUL: f64 = 0.01;

/// Draws of a stage.
const DRAWS_PER_STAGE: usize = 512;

/// Fewest effective draws for which the draws are resampled; and at least as many as are kept.
const EFFECTIVE: f64 = 64.0;

/// Effective draws for each number of a mean and each of its covariance, at which both can be estimated.
const EFFECTIVE_PER_DIMENSION: f64 = 6.0;

/// Smallest variance in any direction, as a share of the mean variance, so that the covariance can be inverted.
const RIDGE: f64 = 1e-8;

/// Measurements that are treated together, which bounds the memory.
const AT_A_TIME: usize = 128;

/// Samples of measurements by adaptive importance sampling.
pub(super) struct Adapted {
    /// The samples of each measurement; `None` where no draw has a weight.
    pub(super) found: Vec<Option<Found>>,
    /// Simulations that were computed.
    pub(super) simulations: usize,
}

/// Samples of one measurement.
pub(super) struct Found {
    /// `[draws, d]`, parameter units.
    pub(super) theta: DMatrix<f64>,
    /// Whether the weights left enough effective draws. Otherwise the samples have the weights w^β of [`tempered`]: they lie about the
    /// posterior, wider than it, and the conformal factors of the model apply to them.
    pub(super) complete: bool,
}

impl Baseline {
    /// `draws` samples of the posterior of each observation, by adaptive importance sampling.
    ///
    /// # Errors
    /// [`InferenceError`] for another number of modes.
    pub(super) fn adapt(
        &self,
        observations: &[Observation],
        draws: usize,
        seed: u64,
    ) -> Result<Adapted, InferenceError> {
        let many = DRAWS_PER_STAGE;
        // Where many draws are kept, more stages are needed.
        let stages = STAGES.max((8 * draws).div_ceil(many));
        let needed = EFFECTIVE.max(draws as f64);
        let mut adapted = Adapted { found: Vec::with_capacity(observations.len()), simulations: 0 };
        for (chunk, part) in observations.chunks(AT_A_TIME).enumerate() {
            let stream = |row: usize| stats::stream(seed, &format!("adapted proposals {}", chunk * AT_A_TIME + row));
            let mut searches: Vec<Search> =
                (part.iter().enumerate()).map(|(row, one)| self.search(one, stream(row))).collect();
            let context = self.condition(part)?;
            for stage in 0..stages {
                let open: Vec<u32> = (0..part.len() as u32).filter(|&row| searches[row as usize].is_open()).collect();
                if open.is_empty() {
                    break;
                }
                let mapped = self.mapped(&context, &open, many, &mut searches)?;
                if stage == 0 {
                    // Whether these draws have weights does not matter for a start from them, and most need none.
                    let started = searches.par_iter_mut().zip(part).enumerate();
                    let simulations = started.map(|(row, (search, one))| {
                        let starts = mapped.inside(row * many..(row + 1) * many, STARTS);
                        self.sample_locally(search, one, &starts, (draws, needed))
                    });
                    adapted.simulations += simulations.sum::<usize>();
                }
                adapted.simulations += self.weigh(part, &open, &mapped, &mut searches);
                let judge = |search: &mut Search| search.judge(stage + 1, needed);
                searches.par_iter_mut().filter(|search| search.is_open()).for_each(judge);
            }
            adapted.found.extend(searches.iter_mut().map(|search| search.resampled(draws)));
        }
        Ok(adapted)
    }

    /// Ends a search where the mixture about points from `starts`, `[n, d]` in parameter units, gives as many effective draws as needed, see
    /// `crates/inference/src/baseline/local.rs`. Returns the number of simulations.
    fn sample_locally(
        &self,
        search: &mut Search,
        observation: &Observation,
        starts: &DMatrix<f64>,
        (draws, needed): (usize, f64),
    ) -> usize {
        let mut target = Target::new(&self.simulator, observation);
        if let Some(theta) = target.sample(starts, draws, needed, &mut search.stream) {
            search.state = State::Sampled(theta);
        }
        target.simulations
    }

    /// A search that begins with the draws of the flow; for noise beyond the training, for which these are too narrow, with draws that
    /// are wider in proportion. Too narrow ones would have nearly equal weights and hide what they miss.
    fn search(&self, observation: &Observation, stream: Stream) -> Search {
        let (d, beyond) = (self.space().len(), self.noise_beyond_training(observation));
        let wide = || Proposal::student(DVector::zeros(d), DMatrix::identity(d, d) * beyond.powi(2));
        let first = if beyond > 1.0 { wide() } else { None };
        Search::new(first.unwrap_or_else(|| Proposal::of_flow(d)), stream)
    }

    /// Draws `many` further proposals of each of the measurements `open`, and maps them to parameters.
    fn mapped(
        &self,
        context: &candle_core::Tensor,
        open: &[u32],
        many: usize,
        searches: &mut [Search],
    ) -> Result<Mapped, InferenceError> {
        let d = self.space().len();
        let mut active = chosen(searches, open);
        let latent: Vec<f32> = active.par_iter_mut().flat_map_iter(|search| search.propose(many)).collect();
        let rows = candle_core::Tensor::from_slice(open, open.len(), context.device())?;
        let (mut real, mut log_jacobian) = self.map_latent(latent, &context.index_select(&rows, 0)?)?;
        from_real_line(&mut real, &mut log_jacobian, &self.training_space);
        let prior = self.space().as_slice();
        let mut theta = DMatrix::zeros(open.len() * many, d);
        let mut is_inside = vec![true; open.len() * many];
        for (row, values) in real.chunks_exact(d).enumerate() {
            for (column, (value, parameter)) in values.iter().zip(prior).enumerate() {
                // A value that is not a number is not inside.
                is_inside[row] &= parameter.prior().contains(value);
                let middle = 0.5 * (parameter.lower + parameter.upper);
                let finite = if value.is_finite() { *value } else { middle };
                theta[(row, column)] = finite.clamp(parameter.lower, parameter.upper);
            }
        }
        Ok(Mapped { theta, log_jacobian, is_inside })
    }

    /// Weighs the newest proposals of the measurements `drawn`, of which only those that are still open need it. Returns the number of
    /// simulations.
    fn weigh(&self, observations: &[Observation], drawn: &[u32], mapped: &Mapped, searches: &mut [Search]) -> usize {
        let many = mapped.theta.nrows() / drawn.len();
        let open: Vec<(usize, u32)> =
            drawn.iter().copied().enumerate().filter(|(_, row)| searches[*row as usize].is_open()).collect();
        let of_open: Vec<Observation> = open.iter().map(|(_, row)| observations[*row as usize].clone()).collect();
        let source = |row: usize| open[row / many].0 * many + row % many;
        let theta = DMatrix::from_fn(open.len() * many, mapped.theta.ncols(), |row, k| mapped.theta[(source(row), k)]);
        let log_posteriors = log_posteriors(&self.simulator, &of_open, &theta);
        let rows: Vec<u32> = open.iter().map(|(_, row)| *row).collect();
        chosen(searches, &rows).par_iter_mut().enumerate().for_each(|(index, search)| {
            for (draw, log_posterior) in log_posteriors[index * many..][..many].iter().enumerate() {
                let of_mapped = source(index * many + draw);
                let log_target = log_posterior - mapped.log_jacobian[of_mapped];
                let usable = mapped.is_inside[of_mapped] && log_target.is_finite();
                search.log_target.push(if usable { log_target } else { f64::NEG_INFINITY });
                search.theta.extend(mapped.theta.row(of_mapped).iter());
            }
        });
        theta.nrows()
    }
}

/// Proposals as parameters, as many for each of some measurements, `[n]` in all.
struct Mapped {
    /// `[n, d]`, parameter units; those outside the prior are moved to its bounds.
    theta: DMatrix<f64>,
    /// ln |∂z/∂x|, `[n]`.
    log_jacobian: Vec<f64>,
    /// Whether they lie inside the prior, `[n]`.
    is_inside: Vec<bool>,
}

impl Mapped {
    /// The first proposals inside the prior of some rows, at most `most`. They are independent, so that the first ones are a sample as well.
    fn inside(&self, rows: Range<usize>, most: usize) -> DMatrix<f64> {
        let rows: Vec<usize> = rows.filter(|row| self.is_inside[*row]).take(most).collect();
        self.theta.select_rows(&rows)
    }
}

/// The searches of the measurements `rows`, which ascend.
fn chosen<'s>(searches: &'s mut [Search], rows: &[u32]) -> Vec<&'s mut Search> {
    let all = (0_u32..).zip(searches);
    all.filter_map(|(row, search)| rows.binary_search(&row).is_ok().then_some(search)).collect()
}

/// The draws of one measurement so far.
struct Search {
    d: usize,
    stream: Stream,
    proposals: Vec<Proposal>,
    /// z of each draw, `[n·d]`.
    latent: Vec<f64>,
    /// Parameters of each draw, `[n·d]`.
    theta: Vec<f64>,
    /// ln p(y | x) p(x) |∂x/∂z| of each draw up to a constant, −∞ outside the prior, `[n]`.
    log_target: Vec<f64>,
    /// ln Σ_t q_t of each draw, `[n]`. Each stage has the same number of draws.
    log_mixture: Vec<f64>,
    state: State,
}

#[derive(PartialEq)]
enum State {
    Open,
    /// The weights of the draws, which have enough effective ones.
    Enough(Vec<f64>),
    /// Samples of the mixture about the first draws, `[draws, d]`, parameter units.
    Sampled(DMatrix<f64>),
    GivenUp,
}

impl Search {
    fn new(first: Proposal, stream: Stream) -> Self {
        Self {
            d: first.mean.len(),
            stream,
            proposals: vec![first],
            latent: Vec::new(),
            theta: Vec::new(),
            log_target: Vec::new(),
            log_mixture: Vec::new(),
            state: State::Open,
        }
    }

    fn is_open(&self) -> bool {
        self.state == State::Open
    }

    /// Draws of the newest proposal, `[many·d]`, in the precision of the flow.
    fn propose(&mut self, many: usize) -> Vec<f32> {
        let newest = self.proposals.last().expect("there is one from the start");
        let drawn: Vec<f32> = (0..many)
            .flat_map(|_| newest.draw(&mut self.stream).iter().map(|value| *value as f32).collect::<Vec<f32>>())
            .collect();
        for (z, log_mixture) in self.latent.chunks_exact(self.d).zip(&mut self.log_mixture) {
            *log_mixture = log_sum(*log_mixture, newest.log_density(z));
        }
        let first = self.latent.len();
        // The densities are those of the numbers that pass through the flow.
        self.latent.extend(drawn.iter().map(|value| f64::from(*value)));
        for z in self.latent[first..].chunks_exact(self.d) {
            let densities = self.proposals.iter().map(|proposal| proposal.log_density(z));
            self.log_mixture.push(densities.fold(f64::NEG_INFINITY, log_sum));
        }
        drawn
    }

    /// Logarithm of the importance weight of each draw, up to a constant, `[n]`.
    fn log_weights(&self) -> Vec<f64> {
        self.log_target.iter().zip(&self.log_mixture).map(|(target, mixture)| target - mixture).collect()
    }

    /// Ends the search where the draws of `stages` stages suffice or give no hope, otherwise fits the next proposal.
    fn judge(&mut self, stages: usize, needed: f64) {
        let log_weights = self.log_weights();
        let Some(weights) = stats::weights(&log_weights, 0.0) else {
            self.state = State::GivenUp;
            return;
        };
        let effective = stats::effective_number(&weights);
        if effective >= needed {
            self.state = State::Enough(weights);
            return;
        }
        let hopeless = stages >= STAGES_BEFORE_DOUBT && effective < HOPEFUL * weights.len() as f64;
        match self.fitted(&log_weights).filter(|_| !hopeless) {
            Some(proposal) => self.proposals.push(proposal),
            None => self.state = State::GivenUp,
        }
    }

    /// The Student distribution with the moments of the draws under w^β.
    fn fitted(&self, log_weights: &[f64]) -> Option<Proposal> {
        let weights = stats::tempered_weights(log_weights, EFFECTIVE_PER_DIMENSION * (self.d + 1) as f64)?;
        let total: f64 = weights.iter().sum();
        let draws = || self.latent.chunks_exact(self.d).zip(&weights).filter(|(_, weight)| **weight > 0.0);
        let mut mean = DVector::zeros(self.d);
        for (z, weight) in draws() {
            mean.iter_mut().zip(z).for_each(|(mean, z)| *mean += weight / total * z);
        }
        let mut covariance = DMatrix::zeros(self.d, self.d);
        for (z, weight) in draws() {
            let off = DVector::from_fn(self.d, |i, _| z[i] - mean[i]);
            covariance.ger(weight / total, &off, &off, 1.0);
        }
        let ridge = RIDGE * covariance.trace() / self.d as f64;
        for i in 0..self.d {
            covariance[(i, i)] += ridge;
        }
        Proposal::student(mean, covariance)
    }

    /// `draws` samples by systematic resampling.
    fn resampled(&mut self, draws: usize) -> Option<Found> {
        let (weights, complete) = match &self.state {
            State::Enough(weights) => (weights.clone(), true),
            State::Sampled(theta) => return Some(Found { theta: theta.clone(), complete: true }),
            State::Open | State::GivenUp => {
                let log_weights = self.log_weights();
                let usable = stats::weights(&log_weights, 0.0)?.iter().filter(|weight| **weight > 0.0).count() as f64;
                (stats::tempered_weights(&log_weights, EFFECTIVE.max(draws as f64).min(0.5 * usable))?, false)
            }
        };
        let chosen = stats::systematic(&weights, draws, &mut self.stream);
        let theta = DMatrix::from_fn(draws, self.d, |row, column| self.theta[chosen[row] * self.d + column]);
        Some(Found { theta, complete })
    }
}

/// ln(eᵃ + eᵇ).
fn log_sum(a: f64, b: f64) -> f64 {
    let (low, high) = if a < b { (a, b) } else { (b, a) };
    if low == f64::NEG_INFINITY {
        return high;
    }
    high + (low - high).exp().ln_1p()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::baseline::observation::DEFAULT_NOISE_RANGE;
    use crate::baseline::train::train;
    use crate::flow::train::TrainSettings;
    use crate::flow::FlowSettings;
    use structures::simulator::definition::StructureDefinition;
    use structures::simulator::Simulator;

    /// Searches the target ln p(z) = `log_target`; the parameters are z itself.
    fn search(d: usize, seed: u64, needed: usize, log_target: impl Fn(&[f64]) -> f64) -> Option<DMatrix<f64>> {
        let mut search = Search::new(Proposal::of_flow(d), stats::stream(seed, "test"));
        for stage in 0..STAGES {
            if search.is_open() {
                let drawn: Vec<f64> = search.propose(2 * needed).into_iter().map(f64::from).collect();
                search.log_target.extend(drawn.chunks_exact(d).map(&log_target));
                search.theta.extend(drawn);
                search.judge(stage + 1, needed as f64);
            }
        }
        search.resampled(needed).filter(|found| found.complete).map(|found| found.theta)
    }

    #[test]
    fn a_narrow_target_beside_the_flow_is_found_with_its_moments() {
        // N(m, S) with a correlation of 0.9, thirty times narrower than the flow and two of its standard deviations away.
        let (mean, std, correlation) = ([2.0, -1.0], [0.03, 0.1], 0.9);
        let log_target = |z: &[f64]| {
            let [a, b] = [0, 1].map(|i| (z[i] - mean[i]) / std[i]);
            -0.5 * (a * a - 2.0 * correlation * a * b + b * b) / (1.0 - correlation * correlation)
        };
        let (repeats, draws) = (100, 100);
        let (mut off, mut squares, mut product) = ([0.0; 2], [0.0; 2], 0.0);
        for seed in 0..repeats {
            let found = search(2, seed, draws, log_target).expect("the target is within reach");
            for row in found.row_iter() {
                let [a, b] = [0, 1].map(|i| (row[i] - mean[i]) / std[i]);
                off = [off[0] + a, off[1] + b];
                squares = [squares[0] + a * a, squares[1] + b * b];
                product += a * b;
            }
        }
        let count = (repeats as usize * draws) as f64;
        // Resampled draws repeat: at least half of them count, since as many effective draws were found as are kept. Four errors.
        let error = 4.0 * (2.0 / count).sqrt();
        for i in 0..2 {
            assert!((off[i] / count).abs() < error, "mean {i}: {}", off[i] / count);
            assert!((squares[i] / count - 1.0).abs() < error * 2.0_f64.sqrt(), "variance {i}: {}", squares[i] / count);
        }
        assert!((product / count - correlation).abs() < error * 2.0_f64.sqrt(), "correlation {}", product / count);
    }

    #[test]
    fn a_target_outside_the_prior_is_given_up() {
        assert!(search(2, 1, 100, |_| f64::NEG_INFINITY).is_none());
        // A single draw inside is no sample either.
        let number = std::cell::Cell::new(0);
        let once = |_: &[f64]| {
            number.set(number.get() + 1);
            if number.get() == 1 {
                0.0
            } else {
                f64::NEG_INFINITY
            }
        };
        assert!(search(2, 1, 100, once).is_none());
    }

    #[test]
    fn samples_about_a_target_that_is_not_reached_are_wider_than_it_and_in_its_place() {
        // A thin shell about a point: no Student distribution is near it.
        let centre = [1.5, -0.5, 0.8, 0.0, -1.0, 0.5];
        let radius = |z: &[f64]| z.iter().zip(&centre).map(|(z, c)| (z - c).powi(2)).sum::<f64>().sqrt();
        let log_target = |z: &[f64]| -0.5 * ((radius(z) - 2.0) / 1e-3).powi(2);
        let mut search = Search::new(Proposal::of_flow(6), stats::stream(7, "test"));
        for stage in 0..STAGES {
            if search.is_open() {
                let drawn: Vec<f64> = search.propose(256).into_iter().map(f64::from).collect();
                search.log_target.extend(drawn.chunks_exact(6).map(log_target));
                search.theta.extend(drawn);
                search.judge(stage + 1, 256.0);
            }
        }
        let found = search.resampled(256).unwrap();
        assert!(!found.complete);
        let radii: Vec<f64> =
            found.theta.row_iter().map(|row| radius(&row.iter().copied().collect::<Vec<f64>>())).collect();
        // The draws of N(0, I) alone have a mean radius of about 3.2 about this point, with a standard deviation of 0.9.
        let off = |radii: &[f64]| stats::mean(&radii.iter().map(|r| (r - 2.0).abs()).collect::<Vec<f64>>());
        let mut stream = stats::stream(8, "test");
        let flow = Proposal::of_flow(6);
        let of_flow: Vec<f64> = (0..256).map(|_| radius(flow.draw(&mut stream).as_slice())).collect();
        assert!(off(&radii) < 0.5 * off(&of_flow), "{} against {}", off(&radii), off(&of_flow));
        assert!(off(&radii) > 1e-3, "they are wider than the target");
    }

    #[test]
    fn a_hardly_trained_flow_gives_the_posterior_of_a_grid() {
        let text = "id = \"two\"\nmodes = 2\nmeasurement_noise = { relative = 0.002 }\n\
                    [[mass]]\nname = \"a\"\nkg = 1.0\n[[mass]]\nname = \"b\"\nkg = 1.5\n\
                    [[spring]]\nname = \"k1\"\nfrom = \"ground\"\nto = \"a\"\nn_per_m = 100.0\n\
                    [[spring]]\nname = \"k2\"\nfrom = \"a\"\nto = \"b\"\nn_per_m = 60.0\n\
                    [[parameter]]\nname = \"p1\"\nprior = { uniform = [50.0, 150.0] }\nsets = { spring = \"k1\" }\n\
                    [[parameter]]\nname = \"p2\"\nprior = { uniform = [30.0, 90.0] }\nsets = { spring = \"k2\" }\n";
        let simulator = Simulator::new(StructureDefinition::parse_toml(text).unwrap()).unwrap();
        let settings = TrainSettings { epochs: 3, ..TrainSettings::default() };
        let flow = FlowSettings::default();
        let baseline = train(&simulator, 3_000, DEFAULT_NOISE_RANGE, &flow, &settings, |_| {}).unwrap().baseline;
        let exact = simulator.frequencies_hz(&[104.0, 55.0]).unwrap();
        let observation = Observation::complete(&exact);
        let draws = 2_000;
        let found = baseline.adapt(std::slice::from_ref(&observation), draws, 1).unwrap();
        let found = found.found[0].as_ref().expect("the flow draws inside the prior");
        assert!(found.complete, "two parameters are within reach");
        let found = &found.theta;
        // Two frequencies of two masses have two solutions, so that the grid covers the whole prior. Its steps are smaller than a tenth of
        // the width of each mode.
        let steps = 901;
        let grid = DMatrix::from_fn(steps * steps, 2, |row, column| {
            let step = if column == 0 { row / steps } else { row % steps };
            [50.0, 30.0][column] * (1.0 + 2.0 * step as f64 / (steps - 1) as f64)
        });
        let logs = log_posteriors(&simulator, std::slice::from_ref(&observation), &grid);
        let weights = stats::weights(&logs, 0.0).unwrap();
        let total: f64 = weights.iter().sum();
        for column in 0..2 {
            let moment = |power: i32, about: f64| {
                let terms = grid.column(column).into_iter().zip(&weights).map(|(x, w)| w * (x - about).powi(power));
                terms.collect::<Vec<f64>>().iter().sum::<f64>() / total
            };
            let mean = moment(1, 0.0);
            let std = moment(2, mean).sqrt();
            let own: Vec<f64> = found.column(column).iter().copied().collect();
            // As many effective draws as are kept, of which some repeat: five errors of half as many.
            let error = 5.0 / (0.5 * draws as f64).sqrt();
            assert!((stats::mean(&own) - mean).abs() < error * std, "{} {mean} ± {std}", stats::mean(&own));
            let ratio = stats::sample_std(&own).unwrap() / std;
            assert!((ratio - 1.0).abs() < error / 2.0_f64.sqrt(), "{ratio}");
        }
    }
}
