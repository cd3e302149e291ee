//! The population behind a batch: mean and spread of the parameters over its measurements, free of the noise of each.
//!
//! A flow answers for each measurement j with samples of q(x | y_j) ∝ p(y_j | x) under a uniform prior. The likelihood of
//! a normal population (μ, σ) needs nothing more:
//!
//! ```text
//!  L(μ, σ) = Π_j ∫ p(y_j | x) N(x; μ, diag σ²) dx ∝ Π_j 1/S Σ_s N(x_js; μ, diag σ²)
//! ```
//!
//! The pool of all samples counts the noise twice, once in where each posterior sits and once in its width; here it
//! counts not at all. Source: Hogg, Myers & Bovy (2010).

mod block;
mod kernel;

use std::f64::consts::{LN_2, LOG2_E};

use nalgebra::{DMatrix, DVector};
use rand::Rng as _;
use rand_distr::{Gamma, StandardNormal};
use rayon::prelude::*;

use self::block::Block;
use self::kernel::{exponentials, moments, off_centre, weigh, Lanes, Terms, Weighed, LANES};
use crate::parameter::ParameterSpace;
use crate::posterior::PosteriorSamples;
use crate::stats::{self, Stream};

/// Probability of every credible interval of the crate.
pub const INTERVAL: f64 = 0.90;

/// Draws of (μ, σ) that are kept.
pub const DRAWS: usize = 400;

/// Markov chains that they come from, side by side.
const CHAINS: usize = 2;

/// Sweeps of each before the first draw that is kept. All after them are: intervals of every eighth cover no better.
const BURN_IN: usize = 40;

/// Share of the spread between measurements that the posterior of one must have for the noise to matter.
const NOISY: f64 = 0.3;

const EM_ITERATIONS: usize = 200;

/// Largest standard deviation considered, as a share of the prior's width: a uniform spread over the prior has 0.29.
const WIDEST: f64 = 0.5;

/// Fewest measurements for which σ is drawn from its gamma distribution; below, its tail is cut off too often.
const GAMMA_FROM: f64 = 5.0;

/// Points of the grid of ln σ that σ is drawn from else.
const GRID: usize = 64;

/// Mean and spread of one quantity over the population behind a batch.
#[derive(Debug, Clone, PartialEq)]
pub struct PopulationEstimate {
    /// Mean μ, in the quantity's unit.
    pub mean: f64,
    /// Standard deviation σ, in the quantity's unit; `None` for one measurement, which says nothing of it.
    pub std: Option<f64>,
    /// Posterior draws of μ.
    pub mean_draws: Vec<f64>,
    /// Posterior draws of σ, paired with those of μ; empty for one measurement.
    pub std_draws: Vec<f64>,
}

/// The population of all parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct Populations {
    /// One entry a parameter, in the order of the space.
    pub parameters: Vec<PopulationEstimate>,
    /// Mean over the measurements of the effective number of samples each contributes, (Σw)²/Σw² with weights under the
    /// estimated population.
    pub effective_sample_size: f64,
}

impl PopulationEstimate {
    /// Credible interval of μ.
    pub fn mean_interval(&self) -> [f64; 2] {
        interval(&self.mean_draws)
    }

    /// Credible interval of σ.
    pub fn std_interval(&self) -> Option<[f64; 2]> {
        (!self.std_draws.is_empty()).then(|| interval(&self.std_draws))
    }

    /// The population of a monotone function of the quantity.
    ///
    /// ```text
    ///  mean and standard deviation of g(x), x ~ N(μ, σ²), at the normal quantiles of equal probability
    /// ```
    #[must_use]
    pub fn through(&self, function: impl Fn(f64) -> f64) -> Self {
        const NODES: usize = 41;
        let nodes: Vec<f64> = (0..NODES).map(|i| stats::normal_quantile((i as f64 + 0.5) / NODES as f64)).collect();
        // The nodes' own spread falls short of 1 by what lies beyond the outermost.
        let scale = 1.0 / (nodes.iter().map(|z| z * z).sum::<f64>() / NODES as f64).sqrt();
        let moments = |mean: f64, std: f64| {
            let values: Vec<f64> = nodes.iter().map(|z| function(mean + std * scale * z)).collect();
            let centre = stats::mean(&values);
            let variance = values.iter().map(|v| (v - centre).powi(2)).sum::<f64>() / NODES as f64;
            (centre, variance.sqrt())
        };
        let Some(std) = self.std else {
            let mean_draws: Vec<f64> = self.mean_draws.iter().map(|x| function(*x)).collect();
            return Self { mean: stats::mean(&mean_draws), std: None, mean_draws, std_draws: Vec::new() };
        };
        let (mean, std) = moments(self.mean, std);
        let draws = self.mean_draws.iter().zip(&self.std_draws).map(|(m, s)| moments(*m, *s));
        let (mean_draws, std_draws) = draws.unzip();
        Self { mean, std: Some(std), mean_draws, std_draws }
    }
}

impl PopulationEstimate {
    /// The population of the mean of several quantities, whose spreads are independent.
    #[must_use]
    pub fn average(parts: &[&Self]) -> Self {
        let count = parts.len() as f64;
        let mean_of = |draw: usize| parts.iter().map(|p| p.mean_draws[draw]).sum::<f64>() / count;
        let std_of = |draw: usize| parts.iter().map(|p| p.std_draws[draw].powi(2)).sum::<f64>().sqrt() / count;
        let draws = parts.iter().map(|p| p.mean_draws.len()).min().unwrap_or(0);
        let spread = parts.iter().all(|p| p.std.is_some());
        Self {
            mean: parts.iter().map(|p| p.mean).sum::<f64>() / count,
            std: spread.then(|| parts.iter().filter_map(|p| p.std).map(|s| s * s).sum::<f64>().sqrt() / count),
            mean_draws: (0..draws).map(mean_of).collect(),
            std_draws: if spread { (0..draws).map(std_of).collect() } else { Vec::new() },
        }
    }
}

/// The central interval of [`INTERVAL`].
pub fn interval(draws: &[f64]) -> [f64; 2] {
    [stats::quantile(draws, 0.5 * (1.0 - INTERVAL)), stats::quantile(draws, 0.5 * (1.0 + INTERVAL))]
}

/// Estimates the population behind posterior samples: point by expectation–maximisation, draws by a Gibbs sampler.
///
/// ```text
///  E:      w_js ∝ N(x_js; μ, diag σ²)
///  M:      μ = 1/n Σ_js w_js x_js,   σ² = 1/n [ Σ_js w_js (x_js − μ)² + (1 − B) σ² ],   B = 1/n Σ_j var_w(x_j)/σ²
///  Gibbs:  s_j ~ w_j·,   σ | s ∝ σ^{1−n} exp(−Σ_j (x_j − x̄)²/2σ²),   μ | σ, s ~ N(x̄, σ²/n)
/// ```
///
/// Where noise hides much of the spread, the chosen samples hold σ where it is and the Gibbs sampler hardly moves; there a
/// Metropolis step on L(μ, σ) itself, one such parameter after the other, goes with every second sweep.
///
/// Priors: μ uniform in the prior box, σ uniform up to half the width of the prior (Gelman 2006). The second
/// term of σ² is ours, the restricted likelihood of a normal population: it gives back what the fitted mean has absorbed,
/// σ²/n for data without noise.
///
/// `log_weights`: where the samples were drawn from another density r_j than q(· | y_j), ln q(x_js | y_j) − ln r_j(x_js) up to a
/// constant for each measurement; they go with each w_js and into L.
pub fn populations(
    samples: &PosteriorSamples,
    log_weights: Option<&[f64]>,
    space: &ParameterSpace,
    seed: u64,
) -> Populations {
    let problem = Problem::new(samples, log_weights, space);
    let dimension = space.len();
    let to_units = |column: usize, u: f64| space.as_slice()[column].from_unit(u);
    let width = |column: usize| space.as_slice()[column].upper - space.as_slice()[column].lower;
    if problem.measurements < 2 {
        // The posterior of the one measurement is that of the mean, and nothing is known of a spread.
        let one = |column: usize| {
            let mean_draws: Vec<f64> = samples.column(column);
            PopulationEstimate { mean: stats::mean(&mean_draws), std: None, mean_draws, std_draws: Vec::new() }
        };
        let effective_sample_size = problem.draws as f64;
        return Populations { parameters: (0..dimension).map(one).collect(), effective_sample_size };
    }
    let point = problem.maximise();
    let effective_sample_size = problem.effective_sample_size(&point);
    let chains: Vec<Vec<State>> = (0..CHAINS)
        .into_par_iter()
        .map(|chain| problem.chain(&point, DRAWS / CHAINS, stats::stream(seed, &format!("population draws {chain}"))))
        .collect();
    let (mut means, mut stds) =
        (vec![Vec::with_capacity(DRAWS); dimension], vec![Vec::with_capacity(DRAWS); dimension]);
    for state in chains.iter().flatten() {
        for column in 0..dimension {
            means[column].push(to_units(column, state.mean[column]));
            stds[column].push(state.std[column] * width(column));
        }
    }
    // Of few measurements the most probable σ can lie below all that is probable: the median then stands for it.
    let within = |point: f64, draws: &[f64]| {
        let [low, high] = interval(draws);
        if (low..=high).contains(&point) {
            point
        } else {
            stats::quantile(draws, 0.5)
        }
    };
    let one = |(column, (mean_draws, std_draws)): (usize, (Vec<f64>, Vec<f64>))| PopulationEstimate {
        mean: within(to_units(column, point.mean[column]), &mean_draws),
        std: Some(within(point.std[column] * width(column), &std_draws)),
        mean_draws,
        std_draws,
    };
    let parameters = means.into_iter().zip(stds).enumerate().map(one).collect();
    Populations { parameters, effective_sample_size }
}

/// The population of each parameter by itself, those of all others flat over the prior: for many parameters, of which the
/// samples are too few to be weighed by all populations at once.
///
/// ```text
///  L_k(μ_k, σ_k) ∝ Π_j 1/S Σ_s N(x_jsk; μ_k, σ_k²)
/// ```
pub fn populations_of_each(samples: &PosteriorSamples, space: &ParameterSpace, seed: u64) -> Populations {
    use rand::RngCore as _;
    let one = |(column, parameter): (usize, &crate::parameter::Parameter)| {
        let own = DMatrix::from_iterator(samples.theta().nrows(), 1, samples.theta().column(column).iter().copied());
        let seed = stats::stream(seed, &format!("population of {}", parameter.name)).next_u64();
        populations(
            &PosteriorSamples::new(own, samples.draws()),
            None,
            &ParameterSpace::new(vec![parameter.clone()]),
            seed,
        )
    };
    let each: Vec<Populations> = space.as_slice().par_iter().enumerate().map(one).collect();
    // The least tells whether some parameter stands on few samples.
    let effective_sample_size = each.iter().map(|p| p.effective_sample_size).fold(f64::INFINITY, f64::min);
    Populations { parameters: each.into_iter().flat_map(|p| p.parameters).collect(), effective_sample_size }
}

/// The point estimate of [`populations`] alone, without draws, and its effective sample size.
pub fn estimate(samples: &PosteriorSamples, log_weights: Option<&[f64]>, space: &ParameterSpace) -> Populations {
    let problem = Problem::new(samples, log_weights, space);
    let point = problem.maximise();
    let effective_sample_size = problem.effective_sample_size(&point);
    let one = |(column, p): (usize, &crate::parameter::Parameter)| PopulationEstimate {
        mean: p.from_unit(point.mean[column]),
        std: Some(point.std[column] * (p.upper - p.lower)),
        mean_draws: Vec::new(),
        std_draws: Vec::new(),
    };
    Populations { parameters: space.iter().enumerate().map(one).collect(), effective_sample_size }
}

/// Widths of the normal distributions that proposals come from, and the turns that eight proposals take among them: wide ones reach
/// what a posterior has beyond its moments.
const WIDTHS: [f64; 3] = [1.0, 1.6, 3.0];
const TURNS: [usize; 8] = [0, 1, 0, 1, 0, 1, 0, 2];

/// Samples near where posterior and population meet, for batches whose noise hides the spread: few samples of the posterior
/// itself fall there. Returns them with the logarithm of their density in the unit box.
///
/// ```text
///  r_j = Σ_w share_w N(x; c_j, w² C_j),    C_j = (V_j⁻¹ + Σ⁻¹)⁻¹,    c_j = C_j (V_j⁻¹ m_j + Σ⁻¹ μ)
/// ```
///
/// m_j, V_j: moments of the posterior samples of measurement j; μ, Σ: the population estimated from them, its spread at least
/// half that of one posterior. The points are of a scrambled Sobol' sequence, each measurement's its own, and take the widths
/// in turn: they stand for an integral as well as several times as many random ones (Owen & Zhou 2000, Safe and effective
/// importance sampling).
pub fn proposals(
    samples: &PosteriorSamples,
    found: &Populations,
    space: &ParameterSpace,
    draws: usize,
    seed: u64,
) -> (PosteriorSamples, Vec<f64>) {
    let (d, parameters) = (space.len(), space.as_slice());
    let width = |k: usize| parameters[k].upper - parameters[k].lower;
    let within = within(&unit_columns(samples, space), samples.draws());
    let mean = DVector::from_fn(d, |k, _| parameters[k].to_unit(found.parameters[k].mean));
    let precision = DMatrix::from_fn(d, d, |i, j| {
        // A first estimate of nearly nothing must leave room to look for another.
        let std = (found.parameters[i].std.unwrap_or(WIDEST) / width(i)).max(0.5 * within[i]).max(1e-6);
        if i == j {
            std.powi(-2)
        } else {
            0.0
        }
    });
    let turn = |draw: usize| TURNS[draw % TURNS.len()];
    // How many have each width, over its volume.
    let volumes: [f64; WIDTHS.len()] = std::array::from_fn(|own| {
        let count = (0..draws).filter(|draw| turn(*draw) == own).count();
        count as f64 / draws as f64 / WIDTHS[own].powi(d as i32)
    });
    let of_one = |(measurement, scrambling): (usize, u32)| {
        let rows = measurement * samples.draws()..(measurement + 1) * samples.draws();
        let unit = |row: usize, k: usize| parameters[k].to_unit(samples.theta()[(row, k)]);
        let count = samples.draws() as f64;
        let centre = DVector::from_fn(d, |k, _| rows.clone().map(|row| unit(row, k)).sum::<f64>() / count);
        let deviations = DMatrix::from_fn(d, samples.draws(), |k, draw| unit(rows.start + draw, k) - centre[k]);
        let covariance = DMatrix::identity(d, d) * 1e-12 + &deviations * deviations.transpose() / count;
        let own = covariance.cholesky().map_or_else(|| DMatrix::identity(d, d) * 12.0, |c| c.inverse());
        let together = (&own + &precision).cholesky().expect("a sum of positive definite matrices is one");
        let (centre, covariance) = (together.solve(&(&own * &centre + &precision * &mean)), together.inverse());
        let factor = covariance.cholesky().expect("the inverse of a positive definite matrix is one").unpack();
        let log_volume: f64 = factor.diagonal().iter().map(|x| x.ln()).sum();
        let (mut points, mut log_density) = (Vec::with_capacity(draws * d), Vec::with_capacity(draws));
        let mut stretched = vec![0.0; d];
        for draw in 0..draws {
            // In the middle of its cell of 2⁻²⁴: no level is 0 or 1.
            let level =
                |k: usize| f64::from(sobol_burley::sample(draw as u32, k as u32, scrambling)) + 0.5_f64.powi(25);
            for (k, stretched) in stretched.iter_mut().enumerate() {
                *stretched = WIDTHS[turn(draw)] * stats::normal_quantile(level(k));
            }
            let mut inside = true;
            for k in 0..d {
                let position = centre[k] + (0..=k).map(|l| factor[(k, l)] * stretched[l]).sum::<f64>();
                inside &= (0.0..=1.0).contains(&position);
                points.push(parameters[k].from_unit(position.clamp(0.0, 1.0)));
            }
            let squared: f64 = stretched.iter().map(|z| z * z).sum();
            let density = |(width, volume): (&f64, f64)| volume * (-0.5 * squared / (width * width)).exp();
            let density: f64 = WIDTHS.iter().zip(volumes).map(density).sum();
            // Beyond the prior nothing is possible.
            log_density.push(if inside { density.ln() - log_volume } else { IMPOSSIBLE });
        }
        (points, log_density)
    };
    let mut stream = stats::stream(seed, "population proposals");
    let scramblings: Vec<u32> = (0..samples.measurements()).map(|_| stream.random()).collect();
    let (points, log_density): (Vec<_>, Vec<_>) = scramblings.into_par_iter().enumerate().map(of_one).unzip();
    let theta = DMatrix::from_row_iterator(samples.measurements() * draws, d, points.into_iter().flatten());
    (PosteriorSamples::new(theta, draws), log_density.concat())
}

/// Logarithm of a density of a sample that counts for nothing.
const IMPOSSIBLE: f64 = 1e9;

/// μ and σ of every parameter in the unit box.
#[derive(Debug, Clone)]
struct State {
    mean: Vec<f64>,
    std: Vec<f64>,
}

/// Samples in the unit box, those of several measurements side by side.
struct Problem {
    /// Mean of the samples of each measurement, `[measurement·parameters + parameter]`.
    centres: Vec<f64>,
    /// The same in the lanes of each block, `[block·parameters + parameter]`.
    lane_centres: Vec<[f64; LANES]>,
    /// What each sample lies off that, `[parameter][place]`; what is left over of the last block is 0.
    deviations: Vec<Vec<Lanes>>,
    /// Logarithms to base 2 of the weights that the samples have by themselves, the greatest of each measurement 0, `[place]`.
    offsets: Vec<Lanes>,
    blocks: Vec<Block>,
    measurements: usize,
    draws: usize,
    /// Least σ of each column that the samples can resolve.
    floor: Vec<f64>,
    /// Mean posterior standard deviation of one measurement, for each column.
    within: Vec<f64>,
    /// Columns of whose spread that is much.
    noisy: Vec<usize>,
}

/// Weights of all samples under a population, and room for what they are made of.
struct Weights {
    /// `[place]`
    values: Vec<Lanes>,
    /// Their logarithms to base 2, not divided, `[place]`.
    logarithms: Vec<Lanes>,
    /// `[block]`
    blocks: Vec<Weighed>,
    /// Σ ((c − μ)/σ)² over the measurements, `[parameter]`.
    of_centres: Vec<f64>,
    squares: Vec<f32>,
    linears: Vec<Lanes>,
}

/// The samples of each parameter in the unit box.
fn unit_columns(samples: &PosteriorSamples, space: &ParameterSpace) -> Vec<Vec<f64>> {
    let unit = |(column, p): (usize, &crate::parameter::Parameter)| -> Vec<f64> {
        samples.theta().column(column).iter().map(|x| p.to_unit(*x)).collect()
    };
    space.iter().enumerate().map(unit).collect()
}

/// Mean posterior standard deviation of one measurement, for each column.
fn within(columns: &[Vec<f64>], draws: usize) -> Vec<f64> {
    let variance = |chunk: &[f64]| {
        let centre = stats::mean(chunk);
        chunk.iter().map(|x| (x - centre).powi(2)).sum::<f64>() / chunk.len() as f64
    };
    let within = |column: &Vec<f64>| {
        let variances = column.chunks(draws).map(variance);
        (variances.sum::<f64>() * draws as f64 / column.len() as f64).sqrt()
    };
    columns.iter().map(within).collect()
}

impl Problem {
    fn new(samples: &PosteriorSamples, log_weights: Option<&[f64]>, space: &ParameterSpace) -> Self {
        let (draws, measurements) = (samples.draws(), samples.measurements());
        let columns = unit_columns(samples, space);
        let within = within(&columns, draws);
        let means = |column: &Vec<f64>| -> Vec<f64> { column.chunks(draws).map(stats::mean).collect() };
        let means: Vec<Vec<f64>> = columns.iter().map(means).collect();
        let hides = |(means, within): &(&Vec<f64>, &f64)| {
            stats::sample_std(means).is_none_or(|spread| **within > NOISY * spread)
        };
        let noisy = means.iter().zip(&within).enumerate().filter(|(_, column)| hides(column));
        let noisy = noisy.map(|(column, _)| column).collect();
        // A spread far below what one measurement leaves open cannot be told from none: the floor keeps it above zero.
        let floor = within.iter().map(|within| (0.25 * within).clamp(1e-7, 0.1 * WIDEST)).collect();
        let blocks = Block::all(measurements, draws);
        let places = blocks.last().map_or(0, |block| block.places.end);
        // Each value less that of its measurement, times a factor.
        let side_by_side = |values: &[f64], centres: &[f64], factor: f64| {
            let mut all = vec![Lanes::ZERO; places];
            for block in &blocks {
                for measurement in block.measurements.clone() {
                    let own = &values[measurement * draws..(measurement + 1) * draws];
                    for (draw, value) in own.iter().enumerate() {
                        let (place, lane) = block.place(measurement, draw);
                        all[place].0[lane] = (factor * (value - centres[measurement])) as f32;
                    }
                }
            }
            all
        };
        let off_centre = |(column, means): (&Vec<f64>, &Vec<f64>)| side_by_side(column, means, 1.0);
        let deviations: Vec<Vec<Lanes>> = columns.iter().zip(&means).map(off_centre).collect();
        let relative = |weights: &[f64]| {
            let largest: Vec<f64> =
                weights.chunks(draws).map(|own| own.iter().copied().fold(f64::NEG_INFINITY, f64::max)).collect();
            side_by_side(weights, &largest, LOG2_E)
        };
        let offsets = log_weights.map_or_else(|| vec![Lanes::ZERO; places], relative);
        let centres = (0..measurements).flat_map(|j| means.iter().map(move |own| own[j])).collect();
        let in_lanes = |block: &Block, own: &Vec<f64>| {
            let mut all = [0.0; LANES];
            for (measurement, lanes) in block.lanes() {
                lanes.for_each(|lane| all[lane] = own[measurement]);
            }
            all
        };
        let lane_centres = blocks.iter().flat_map(|block| means.iter().map(|own| in_lanes(block, own))).collect();
        Self { centres, lane_centres, deviations, offsets, blocks, measurements, draws, floor, within, noisy }
    }

    fn centres(&self, measurement: usize) -> &[f64] {
        let d = self.deviations.len();
        &self.centres[measurement * d..(measurement + 1) * d]
    }

    fn room(&self) -> Weights {
        let d = self.deviations.len();
        Weights {
            values: vec![Lanes::ZERO; self.offsets.len()],
            logarithms: vec![Lanes::ZERO; self.offsets.len()],
            blocks: vec![Weighed { divisor: Lanes::ZERO, sum: Lanes::ZERO }; self.blocks.len()],
            of_centres: vec![0.0; d],
            squares: vec![0.0; d],
            linears: vec![Lanes::ZERO; d],
        }
    }

    /// Weights of all samples under a population.
    ///
    /// ```text
    ///  ln w_s = offset_s − Σ_k ½((x_sk − μ_k)/σ_k)² + ½((c_k − μ_k)/σ_k)²
    /// ```
    fn weigh(&self, state: &State, weights: &mut Weights) {
        let Weights { values, logarithms, blocks, of_centres, squares, linears } = weights;
        let precisions: Vec<f64> = state.std.iter().map(|std| std.powi(-2)).collect();
        for (square, precision) in squares.iter_mut().zip(&precisions) {
            *square = (-0.5 * LOG2_E * precision) as f32;
        }
        of_centres.fill(0.0);
        let d = self.deviations.len();
        for ((block, centres), weighed) in self.blocks.iter().zip(self.lane_centres.chunks(d)).zip(blocks) {
            for (k, (linear, centres)) in linears.iter_mut().zip(centres).enumerate() {
                let squared = off_centre(linear, centres, state.mean[k], precisions[k]);
                of_centres[k] += squared[..block.measurements.len()].iter().sum::<f64>();
            }
            let places = block.places.clone();
            let deviations: Vec<&[Lanes]> = self.deviations.iter().map(|all| &all[places.clone()]).collect();
            let terms = Terms { to: &self.offsets[places.clone()], deviations: &deviations, squares, linears };
            let (values, logarithms) = (&mut values[places.clone()], &mut logarithms[places]);
            *weighed = weigh(values, logarithms, &terms, block.width, &weighed.divisor);
        }
    }

    /// As [`Self::weigh`] under `next`, which differs from `state` in parameter k only; `weights` are those under `state`.
    fn weigh_changed(&self, k: usize, (state, weights): (&State, &Weights), next: &State, others: &mut Weights) {
        let [before, after] = [state, next].map(|state| (state.mean[k], state.std[k].powi(-2)));
        let square = (-0.5 * LOG2_E * (after.1 - before.1)) as f32;
        others.of_centres.clone_from(&weights.of_centres);
        others.of_centres[k] = 0.0;
        for (index, (block, old)) in self.blocks.iter().zip(&weights.blocks).enumerate() {
            let centres = &self.lane_centres[index * self.deviations.len() + k];
            let (mut linear, mut old_linear) = (Lanes::ZERO, Lanes::ZERO);
            off_centre(&mut old_linear, centres, before.0, before.1);
            let squared = off_centre(&mut linear, centres, after.0, after.1);
            others.of_centres[k] += squared[..block.measurements.len()].iter().sum::<f64>();
            linear.0.iter_mut().zip(old_linear.0).for_each(|(own, old)| *own -= old);
            let places = block.places.clone();
            let (to, deviations) = (&weights.logarithms[places.clone()], &self.deviations[k][places.clone()]);
            let terms = Terms { to, deviations: &[deviations], squares: &[square], linears: &[linear] };
            let (values, logarithms) = (&mut others.values[places.clone()], &mut others.logarithms[places]);
            others.blocks[index] = weigh(values, logarithms, &terms, block.width, &old.divisor);
        }
    }

    fn maximise(&self) -> State {
        let (n, d) = (self.measurements as f64, self.deviations.len());
        let start = |k: usize| {
            let means: Vec<f64> = self.centres.iter().skip(k).step_by(d).copied().collect();
            let std = stats::sample_std(&means).unwrap_or(WIDEST);
            (stats::mean(&means), std.clamp(self.floor[k], WIDEST))
        };
        let (mean, std) = (0..d).map(start).unzip();
        let mut state = State { mean, std };
        let mut weights = self.room();
        for _ in 0..EM_ITERATIONS {
            let mut sums = vec![(0.0, 0.0, 0.0); d];
            self.weigh(&state, &mut weights);
            for (block, weighed) in self.blocks.iter().zip(&weights.blocks) {
                let places = block.places.clone();
                for ((k, deviations), sums) in self.deviations.iter().enumerate().zip(&mut sums) {
                    let (first, second) = moments(&weights.values[places.clone()], &deviations[places.clone()]);
                    for (measurement, lanes) in block.lanes() {
                        let sum = weighed.sum.of(lanes.clone());
                        let (first, second) = (first.of(lanes.clone()) / sum, second.of(lanes) / sum);
                        // About the last mean: differences of large squares would lose a small spread.
                        let off = self.centres(measurement)[k] - state.mean[k];
                        sums.0 += off + first;
                        sums.1 += second + 2.0 * off * first + off * off;
                        sums.2 += (second - first * first).max(0.0);
                    }
                }
            }
            let mut moved = 0.0_f64;
            for (k, (first, second, within)) in sums.into_iter().enumerate() {
                let shift = first / n;
                let old = state.std[k].powi(2);
                let absorbed = (1.0 - within / n / old).clamp(0.0, 1.0) * old;
                let variance = ((second - n * shift * shift).max(0.0) + absorbed) / n;
                let std = variance.sqrt().clamp(self.floor[k], WIDEST);
                moved = moved.max(shift.abs() / std).max((std / state.std[k] - 1.0).abs());
                state.mean[k] = (state.mean[k] + shift).clamp(0.0, 1.0);
                state.std[k] = std;
            }
            if moved < 1e-4 {
                break;
            }
        }
        state
    }

    fn effective_sample_size(&self, state: &State) -> f64 {
        let (mut weights, mut all) = (self.room(), 0.0);
        self.weigh(state, &mut weights);
        for (block, weighed) in self.blocks.iter().zip(&weights.blocks) {
            let values = &weights.values[block.places.clone()];
            for (_, lanes) in block.lanes() {
                let squares =
                    lanes.clone().flat_map(|lane| values.iter().map(move |w| f64::from(w.0[lane] * w.0[lane])));
                all += weighed.sum.of(lanes).powi(2) / squares.sum::<f64>();
            }
        }
        all / self.measurements as f64
    }

    /// ln L(μ, σ) up to a constant; `weights` under the same population.
    fn log_likelihood(&self, state: &State, weights: &Weights) -> f64 {
        // One logarithm for many measurements: the product of their sums.
        let (mut likelihood, mut product) = (-0.5 * weights.of_centres.iter().sum::<f64>(), 1.0_f64);
        for (block, weighed) in self.blocks.iter().zip(&weights.blocks) {
            for (first, (_, lanes)) in block.lanes().enumerate() {
                likelihood += LN_2 * f64::from(weighed.divisor.0[first]);
                product *= weighed.sum.of(lanes);
                if !(1e-200..=1e200).contains(&product) {
                    likelihood += product.ln();
                    product = 1.0;
                }
            }
        }
        likelihood + product.ln() - self.measurements as f64 * state.std.iter().map(|std| std.ln()).sum::<f64>()
    }

    /// `draws` states of a Markov chain that begins at `point`.
    fn chain(&self, point: &State, draws: usize, mut stream: Stream) -> Vec<State> {
        let (mut state, mut weights, mut others) = (point.clone(), self.room(), self.room());
        let mut kept = Vec::with_capacity(draws);
        self.weigh(&state, &mut weights);
        for sweep in 0..BURN_IN + draws {
            self.sweep(&mut state, &weights, &mut stream);
            self.weigh(&state, &mut weights);
            if !self.noisy.is_empty() && sweep.is_multiple_of(2) {
                self.collapsed(&mut state, &mut weights, &mut others, &mut stream);
            }
            if sweep >= BURN_IN {
                kept.push(state.clone());
            }
        }
        kept
    }

    /// One Metropolis step for each noisy parameter on the likelihood with all samples in it. `weights` are those under the state, and
    /// stay so; `others` are room for those under another.
    fn collapsed(&self, state: &mut State, weights: &mut Weights, others: &mut Weights, stream: &mut Stream) {
        let mut current = self.log_likelihood(state, weights);
        for &k in &self.noisy {
            // Steps of several sizes: how wide the likelihood is depends on how much the noise hides.
            let size = [0.3, 1.0, 2.0][stream.random_range(0..3)];
            let spread = ((state.std[k].powi(2) + self.within[k].powi(2)) / self.measurements as f64).sqrt();
            let mut next = state.clone();
            next.mean[k] += size * spread * stream.sample::<f64, _>(StandardNormal);
            let ln_step =
                size * (1.0 + self.within[k] / state.std[k]).min(4.0) / (2.0 * self.measurements as f64).sqrt();
            next.std[k] *= (ln_step * stream.sample::<f64, _>(StandardNormal)).exp();
            let threshold: f64 = stream.random();
            if !(0.0..=1.0).contains(&next.mean[k]) || !(self.floor[k]..=WIDEST).contains(&next.std[k]) {
                continue;
            }
            self.weigh_changed(k, (state, weights), &next, others);
            let likelihood = self.log_likelihood(&next, others);
            // The step is symmetric in ln σ but its size depends on σ, and σ is uniform a priori.
            let back = size * (1.0 + self.within[k] / next.std[k]).min(4.0) / (2.0 * self.measurements as f64).sqrt();
            let moved = (next.std[k] / state.std[k]).ln();
            let sizes = (ln_step / back).ln() + 0.5 * moved * moved * (ln_step.powi(-2) - back.powi(-2));
            let next_spread = ((next.std[k].powi(2) + self.within[k].powi(2)) / self.measurements as f64).sqrt();
            let shifted = (next.mean[k] - state.mean[k]) / size;
            let shifts =
                (spread / next_spread).ln() + 0.5 * shifted * shifted * (spread.powi(-2) - next_spread.powi(-2));
            if threshold.ln() < likelihood - current + moved + sizes + shifts {
                *state = next;
                current = likelihood;
                std::mem::swap(weights, others);
            }
        }
    }

    /// One sweep of the Gibbs sampler; `weights` are those under the state.
    fn sweep(&self, state: &mut State, weights: &Weights, stream: &mut Stream) {
        let n = self.measurements as f64;
        // Place and lane of the sample of each measurement.
        let mut chosen = Vec::with_capacity(self.measurements);
        for (block, weighed) in self.blocks.iter().zip(&weights.blocks) {
            block.choose(&weights.values, weighed, || stream.random(), &mut chosen);
        }
        for (k, deviations) in self.deviations.iter().enumerate() {
            let value = |(measurement, (place, lane)): (usize, &(usize, usize))| {
                self.centres(measurement)[k] + f64::from(deviations[*place].0[*lane])
            };
            let values: Vec<f64> = chosen.iter().enumerate().map(value).collect();
            let centre = stats::mean(&values);
            let squares: f64 = values.iter().map(|x| (x - centre).powi(2)).sum();
            state.std[k] = draw_std(squares, n, self.floor[k], stream);
            let spread = state.std[k] / n.sqrt();
            let mut draw = || centre + spread * stream.sample::<f64, _>(StandardNormal);
            let inside = (0..20).map(|_| draw()).find(|mean| (0.0..=1.0).contains(mean));
            state.mean[k] = inside.unwrap_or(centre);
        }
    }
}

/// Draws σ given the sum of squares about the mean of n values, μ integrated out.
///
/// ```text
///  p(ln σ) ∝ σ · σ^{1−n} · exp(−SS/2σ²)   between the floor and the widest
/// ```
fn draw_std(squares: f64, n: f64, floor: f64, stream: &mut Stream) -> f64 {
    // Without the ends it is a gamma distribution of 1/σ², which nearly always falls between them.
    if n >= GAMMA_FROM && squares > 0.0 {
        let gamma = Gamma::new(0.5 * (n - 2.0), 2.0 / squares).expect("shape and scale are positive");
        let draws = (0..8).map(|_| 1.0 / stream.sample(gamma).sqrt());
        if let Some(std) = { draws }.find(|std| (floor..=WIDEST).contains(std)) {
            return std;
        }
    }
    // The bulk lies within a few widths 1/√(2n) about the mode; the grid covers it and no more, to stay fine.
    let mode = if n > 2.0 { (squares / (n - 2.0)).sqrt() } else { WIDEST };
    let reach = (8.0 / (2.0 * n).sqrt()).max(0.5);
    let low = if n > 2.0 { (mode.clamp(floor, WIDEST).ln() - reach).max(floor.ln()) } else { floor.ln() };
    // With few values the tail towards wide spreads is long.
    let high = if n < 12.0 { WIDEST.ln() } else { (mode.clamp(floor, WIDEST).ln() + 1.5 * reach).min(WIDEST.ln()) };
    let step = (high - low).max(1e-12) / GRID as f64;
    let mut densities = [0.0; GRID];
    // 1/σ² of the cells is a geometric sequence.
    let (mut precision, ratio) = ((-2.0 * (low + 0.5 * step)).exp(), (-2.0 * step).exp());
    for (i, density) in densities.iter_mut().enumerate() {
        *density = (2.0 - n) * (low + (i as f64 + 0.5) * step) - 0.5 * squares * precision;
        precision *= ratio;
    }
    let mut left = exponentials(&mut densities) * stream.random::<f64>();
    let cell = densities.iter().position(|density| {
        left -= density;
        left < 0.0
    });
    let place = cell.unwrap_or(GRID - 1) as f64 + stream.random::<f64>();
    (low + place * step).exp().clamp(floor, WIDEST)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_likelihood_is_the_same_whichever_way_a_population_was_reached() {
        let parameter = |name: &str| crate::parameter::Parameter {
            name: name.to_owned(),
            unit: "N/m".to_owned(),
            lower: 0.0,
            upper: 1.0,
            damage: crate::parameter::DamageDirection::Decrease,
        };
        let space = ParameterSpace::new(["a", "b", "c"].map(parameter).to_vec());
        let (measurements, draws) = (21, 16);
        let mut stream = stats::stream(1, "test: populations");
        let theta = DMatrix::from_fn(measurements * draws, 3, |_, k| {
            0.5 + [0.02, 0.1, 0.05][k] * stream.sample::<f64, _>(StandardNormal)
        });
        let samples = PosteriorSamples::new(theta.clone(), draws);
        let problem = Problem::new(&samples, None, &space);
        let state = |mean: [f64; 3], std: [f64; 3]| State { mean: mean.to_vec(), std: std.to_vec() };
        let direct = |state: &State| -> f64 {
            let density = |row: usize| -> f64 {
                let one = |k: usize| {
                    let z = (theta[(row, k)] - state.mean[k]) / state.std[k];
                    (-0.5 * z * z).exp() / state.std[k]
                };
                (0..3).map(one).product()
            };
            (0..measurements).map(|j| (j * draws..(j + 1) * draws).map(density).sum::<f64>().ln()).sum()
        };
        let start = state([0.5, 0.5, 0.5], [0.05, 0.1, 0.03]);
        let (mut weights, mut others) = (problem.room(), problem.room());
        problem.weigh(&start, &mut weights);
        let of_start = problem.log_likelihood(&start, &weights);
        // A small step, and one so large that what the weights were divided by is of no use any more.
        for (k, next) in [(1, state([0.5, 0.48, 0.5], [0.05, 0.07, 0.03])), (2, state([0.5; 3], [0.05, 0.1, 0.001]))] {
            problem.weigh_changed(k, (&start, &weights), &next, &mut others);
            let changed = problem.log_likelihood(&next, &others) - of_start;
            let mut anew = problem.room();
            problem.weigh(&next, &mut anew);
            let weighed = problem.log_likelihood(&next, &anew) - of_start;
            let expected = direct(&next) - direct(&start);
            // Logarithms of up to some hundreds for each measurement, in single precision: 6e-8 of each.
            let tolerance = 1e-6 * (expected.abs() + measurements as f64);
            assert!((changed - expected).abs() < tolerance, "{k}: {changed}, expected {expected}");
            assert!((weighed - expected).abs() < tolerance, "{k}: {weighed}, expected {expected}");
        }
    }
}
