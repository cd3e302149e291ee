//! The likelihood of a normal population of all parameters, and its maximum.

use std::f64::consts::{LN_2, LOG2_E};

use super::block::Block;
use super::kernel::{moments, off_centre, weigh, Lanes, Terms, Weighed, LANES};
use crate::posterior::PosteriorSamples;
use structures::parameter::{Parameter, ParameterSpace};
use structures::stats;

/// Largest standard deviation considered, as a share of the prior's width. A uniform distribution over the prior has 0.29.
pub(super) const WIDEST: f64 = 0.5;

/// A parameter is noise-dominated where the posterior of one measurement is wider than this share of the spread between
/// measurements.
const NOISY: f64 = 0.3;

/// Most iterations of expectation–maximisation.
pub(super) const EM_ITERATIONS: usize = 200;

/// μ and σ of every parameter in the unit box.
#[derive(Debug, Clone)]
pub(super) struct State {
    pub mean: Vec<f64>,
    pub std: Vec<f64>,
}

/// Posterior samples in the unit box of the prior, arranged in SIMD lanes; see [`Block`].
pub(super) struct Problem {
    /// Mean of the samples of each measurement, `[measurement·parameters + parameter]`.
    pub centres: Vec<f64>,
    /// The same in the lanes of each block, `[block·parameters + parameter]`.
    pub lane_centres: Vec<[f64; LANES]>,
    /// Deviation of each sample from that mean, `[parameter][place]`; 0 in unused lanes of the last block.
    pub deviations: Vec<Vec<Lanes>>,
    /// Logarithms to base 2 of the samples' own weights, scaled so that the largest of each measurement is 0, `[place]`.
    pub offsets: Vec<Lanes>,
    pub blocks: Vec<Block>,
    pub measurements: usize,
    pub draws: usize,
    /// Smallest σ of each column that the samples can resolve.
    pub floor: Vec<f64>,
    /// Root mean posterior variance of one measurement, for each column.
    pub within: Vec<f64>,
    /// Noise-dominated columns.
    pub noisy: Vec<usize>,
    /// What is known of σ of each column beside the samples.
    pub spreads: Vec<KnownSpread>,
}

/// Knowledge of a standard deviation σ, worth as much as a sample of ν deviations with variance s²: a factor σ^−ν exp(−νs²/2σ²).
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct KnownSpread {
    /// ν; 0 for none.
    pub degrees: f64,
    /// ν s².
    pub squares: f64,
}

impl KnownSpread {
    /// Its logarithm at σ.
    pub fn log_density(&self, std: f64) -> f64 {
        -self.degrees * std.ln() - 0.5 * self.squares / (std * std)
    }
}

/// Weights of all samples under a population, with buffers for their computation.
pub(super) struct Weights {
    /// Weights, `[place]`.
    pub values: Vec<Lanes>,
    /// Logarithms to base 2 of the weights before division, `[place]`.
    pub logarithms: Vec<Lanes>,
    /// Divisors and sums, `[block]`.
    pub blocks: Vec<Weighed>,
    /// Σ ((c − μ)/σ)² over the measurements, `[parameter]`.
    pub of_centres: Vec<f64>,
    /// 1/σ², `[parameter]`.
    pub precisions: Vec<f64>,
    /// As in [`Terms`].
    pub squares: Vec<f32>,
    /// As in [`Terms`].
    pub linears: Vec<Lanes>,
    /// As in [`Terms`].
    pub crosses: Vec<f32>,
}

/// The samples of each parameter in the unit box, `[parameter][sample]`.
pub(super) fn unit_columns(samples: &PosteriorSamples, space: &ParameterSpace) -> Vec<Vec<f64>> {
    let unit = |(column, p): (usize, &Parameter)| -> Vec<f64> {
        samples.theta().column(column).iter().map(|x| p.to_unit(*x)).collect()
    };
    space.iter().enumerate().map(unit).collect()
}

/// Root mean posterior variance of one measurement, for each column.
pub(super) fn within(columns: &[Vec<f64>], draws: usize) -> Vec<f64> {
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
    /// Arranges the posterior samples, `[n·draws, d]`, in lanes. `log_weights`: logarithms of their own weights, `[n·draws]`,
    /// nats; without them the samples are weighted by one over the density of the prior.
    pub(super) fn new(samples: &PosteriorSamples, log_weights: Option<&[f64]>, space: &ParameterSpace) -> Self {
        let (draws, measurements) = (samples.draws(), samples.measurements());
        let columns = unit_columns(samples, space);
        let within = within(&columns, draws);
        let means = |column: &Vec<f64>| -> Vec<f64> { column.chunks(draws).map(stats::mean).collect() };
        let means: Vec<Vec<f64>> = columns.iter().map(means).collect();
        let dominates = |(means, within): &(&Vec<f64>, &f64)| {
            stats::sample_std(means).is_none_or(|spread| **within > NOISY * spread)
        };
        let noisy = means.iter().zip(&within).enumerate().filter(|(_, column)| dominates(column));
        let noisy = noisy.map(|(column, _)| column).collect();
        // A spread far below the posterior width of one measurement cannot be distinguished from zero: the floor keeps it
        // positive.
        let floor = within.iter().map(|within| (0.25 * within).clamp(1e-7, 0.1 * WIDEST)).collect();
        let blocks = Block::all(measurements, draws);
        let places = blocks.last().map_or(0, |block| block.places.end);
        // The deviation of each value from the centre of its measurement, times a factor, in lanes.
        let deviations_in_lanes = |values: &[f64], centres: &[f64], factor: f64| {
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
        let off_centre = |(column, means): (&Vec<f64>, &Vec<f64>)| deviations_in_lanes(column, means, 1.0);
        let deviations: Vec<Vec<Lanes>> = columns.iter().zip(&means).map(off_centre).collect();
        let relative = |weights: &[f64]| {
            let largest: Vec<f64> =
                weights.chunks(draws).map(|own| own.iter().copied().fold(f64::NEG_INFINITY, f64::max)).collect();
            deviations_in_lanes(weights, &largest, LOG2_E)
        };
        let over_prior = || {
            let log_weights = |row: usize| -space.log_prior(samples.theta().row(row).iter());
            (0..samples.theta().nrows()).map(log_weights).collect::<Vec<f64>>()
        };
        let offsets = match log_weights {
            Some(weights) => relative(weights),
            None if space.is_uniform() => vec![Lanes::ZERO; places],
            None => relative(&over_prior()),
        };
        let centres = (0..measurements).flat_map(|j| means.iter().map(move |own| own[j])).collect();
        let in_lanes = |block: &Block, own: &Vec<f64>| {
            let mut all = [0.0; LANES];
            for (measurement, lanes) in block.lanes() {
                lanes.for_each(|lane| all[lane] = own[measurement]);
            }
            all
        };
        let lane_centres = blocks.iter().flat_map(|block| means.iter().map(|own| in_lanes(block, own))).collect();
        let spreads = vec![KnownSpread::default(); columns.len()];
        Self { centres, lane_centres, deviations, offsets, blocks, measurements, draws, floor, within, noisy, spreads }
    }

    /// The problem with knowledge of the standard deviations beside the samples.
    pub(super) fn knowing(mut self, spreads: Vec<KnownSpread>) -> Self {
        self.spreads = spreads;
        self
    }

    /// Means of the samples of one measurement, `[d]`, in the unit box.
    pub(super) fn centres(&self, measurement: usize) -> &[f64] {
        let d = self.deviations.len();
        &self.centres[measurement * d..(measurement + 1) * d]
    }

    /// Whether μ and σ of parameter k are within the prior, and σ is not below what the samples can resolve.
    pub(super) fn is_possible(&self, state: &State, k: usize) -> bool {
        (0.0..=1.0).contains(&state.mean[k]) && (self.floor[k]..=WIDEST).contains(&state.std[k])
    }

    /// Buffers for the weights.
    pub(super) fn buffers(&self) -> Weights {
        let d = self.deviations.len();
        Weights {
            values: vec![Lanes::ZERO; self.offsets.len()],
            logarithms: vec![Lanes::ZERO; self.offsets.len()],
            blocks: vec![Weighed { divisor: Lanes::ZERO, sum: Lanes::ZERO }; self.blocks.len()],
            of_centres: vec![0.0; d],
            precisions: vec![0.0; d],
            squares: vec![0.0; d],
            linears: vec![Lanes::ZERO; d],
            crosses: Vec::new(),
        }
    }

    /// Computes the weights of all samples under a population.
    ///
    /// ```text
    ///  ln w_s = offset_s − Σ_k ½((x_sk − μ_k)/σ_k)² + ½((c_k − μ_k)/σ_k)²
    /// ```
    pub(super) fn weigh(&self, state: &State, weights: &mut Weights) {
        let Weights { values, logarithms, blocks, of_centres, precisions, squares, linears, .. } = weights;
        for ((square, precision), std) in squares.iter_mut().zip(&mut *precisions).zip(&state.std) {
            *precision = std.powi(-2);
            *square = (-0.5 * LOG2_E * *precision) as f32;
        }
        of_centres.fill(0.0);
        let d = self.deviations.len();
        for ((block, centres), weighed) in self.blocks.iter().zip(self.lane_centres.chunks(d)).zip(blocks) {
            for (k, (linear, centres)) in linears.iter_mut().zip(centres).enumerate() {
                let squared = off_centre(linear, centres, state.mean[k], precisions[k]);
                of_centres[k] += squared[..block.measurements.len()].iter().sum::<f64>();
            }
            let places = block.places.clone();
            let (values, logarithms) = (&mut values[places.clone()], &mut logarithms[places.clone()]);
            let to = &self.offsets[places.clone()];
            let terms = Terms { to, deviations: &self.deviations, places, squares, linears, crosses: &[] };
            *weighed = weigh(values, logarithms, &terms, block.width, &weighed.divisor);
        }
    }

    /// Computes the weights under `next`, which differs from `state` only in parameter k, from `weights`, those under
    /// `state`.
    pub(super) fn weigh_changed(
        &self,
        k: usize,
        (state, weights): (&State, &Weights),
        next: &State,
        others: &mut Weights,
    ) {
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
            let (values, logarithms) = (&mut others.values[places.clone()], &mut others.logarithms[places.clone()]);
            let (to, deviations) = (&weights.logarithms[places.clone()], std::slice::from_ref(&self.deviations[k]));
            let terms = Terms { to, deviations, places, squares: &[square], linears: &[linear], crosses: &[] };
            others.blocks[index] = weigh(values, logarithms, &terms, block.width, &old.divisor);
        }
    }

    /// The most probable population, by expectation–maximisation; see `populations`.
    pub(super) fn maximise(&self) -> State {
        let (n, d) = (self.measurements as f64, self.deviations.len());
        let start = |k: usize| {
            let means: Vec<f64> = self.centres.iter().skip(k).step_by(d).copied().collect();
            let std = stats::sample_std(&means).unwrap_or(WIDEST);
            (stats::mean(&means), std.clamp(self.floor[k], WIDEST))
        };
        let (mean, std) = (0..d).map(start).unzip();
        let mut state = State { mean, std };
        let mut weights = self.buffers();
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
                        // Moments about the previous mean: differences of large squares would lose the digits of a small
                        // spread.
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
                let known = self.spreads[k];
                let variance = ((second - n * shift * shift).max(0.0) + absorbed + known.squares) / (n + known.degrees);
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

    /// Effective sample size (Σw)²/Σw² under a population, averaged over the measurements.
    pub(super) fn effective_sample_size(&self, state: &State) -> f64 {
        let mut weights = self.buffers();
        self.weigh(state, &mut weights);
        self.effective_sample_size_of(&weights)
    }

    /// Effective sample size of weights, averaged over the measurements.
    pub(super) fn effective_sample_size_of(&self, weights: &Weights) -> f64 {
        let mut all = 0.0;
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

    /// ln L(μ, σ) up to a constant. `weights`: those under the same population.
    pub(super) fn log_likelihood(&self, state: &State, weights: &Weights) -> f64 {
        self.log_sums(weights) - self.measurements as f64 * state.std.iter().map(|std| std.ln()).sum::<f64>()
    }

    /// The logarithms of the sums of the weights of each measurement, added.
    pub(super) fn log_sums(&self, weights: &Weights) -> f64 {
        // The sums of many measurements are multiplied, so that few logarithms are needed.
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
        likelihood + product.ln()
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::DMatrix;
    use rand::Rng as _;
    use rand_distr::StandardNormal;

    use super::*;

    #[test]
    fn the_likelihood_does_not_depend_on_how_the_weights_were_computed() {
        let parameter = |name: &str| structures::parameter::Parameter {
            name: name.to_owned(),
            unit: "N/m".to_owned(),
            lower: 0.0,
            upper: 1.0,
            damage: structures::parameter::DamageDirection::Decrease,
            form: structures::parameter::PriorForm::Uniform,
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
        let (mut weights, mut others) = (problem.buffers(), problem.buffers());
        problem.weigh(&start, &mut weights);
        let of_start = problem.log_likelihood(&start, &weights);
        // A small step, and one so large that the previous divisor of the weights cannot be reused.
        for (k, next) in [(1, state([0.5, 0.48, 0.5], [0.05, 0.07, 0.03])), (2, state([0.5; 3], [0.05, 0.1, 0.001]))] {
            problem.weigh_changed(k, (&start, &weights), &next, &mut others);
            let changed = problem.log_likelihood(&next, &others) - of_start;
            let mut anew = problem.buffers();
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
