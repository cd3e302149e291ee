//! Draws of (μ, σ) by Markov chains, for populations whose posterior is far from a normal distribution.

use rand::Rng as _;
use rand_distr::{Gamma, StandardNormal};
use rayon::prelude::*;

use super::kernel::exponentials;
use super::population::DRAWS;
use super::problem::{Problem, State, Weights, WIDEST};
use structures::stats::{self, Stream};

/// Number of Markov chains, which run in parallel.
const CHAINS: usize = 2;

/// Sweeps of each chain before the first draw that is kept. All later draws are kept: thinning does not improve the
/// coverage of the intervals.
const BURN_IN: usize = 40;

/// Fewest measurements for which 1/σ² is drawn from a gamma distribution. With fewer, too many draws fall outside the
/// limits.
const GAMMA_FROM: f64 = 5.0;

/// Points of the grid of ln σ that is used otherwise.
const GRID: usize = 64;

/// [`DRAWS`] states of Gibbs samplers that start at `point`.
///
/// ```text
///  s_j ~ w_j,   σ | s ∝ σ^{1−n} exp(−Σ_j (x_j − x̄)²/2σ²),   μ | σ, s ~ N(x̄, σ²/n)
/// ```
///
/// What is known of σ beside the samples adds ν to n and νs² to the sum of squares, see [`KnownSpread`](super::problem::KnownSpread).
///
/// s_j: the sample selected for measurement j with probability proportional to its weight w_js; x_j: its value; x̄: mean of the
/// x_j.
///
/// For noise-dominated parameters the selected samples s_j determine σ almost completely, so that the sampler hardly moves.
/// Every second sweep is therefore followed by a Metropolis step on L(μ, σ) for each of these parameters, with the samples
/// summed out.
pub(super) fn draws(problem: &Problem, point: &State, seed: u64) -> Vec<State> {
    let chain = |chain: usize| {
        let stream = stats::stream(seed, &format!("population draws {chain}"));
        problem.chain(point, DRAWS / CHAINS, stream)
    };
    (0..CHAINS).into_par_iter().map(chain).collect::<Vec<_>>().concat()
}

impl Problem {
    /// `draws` states of a Markov chain that starts at `point`.
    fn chain(&self, point: &State, draws: usize, mut stream: Stream) -> Vec<State> {
        let (mut state, mut weights, mut others) = (point.clone(), self.buffers(), self.buffers());
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

    /// One Metropolis step on L(μ, σ) for each noise-dominated parameter. `weights` are those under the state, before and
    /// after; `others` is a buffer for those under a proposed state.
    fn collapsed(&self, state: &mut State, weights: &mut Weights, others: &mut Weights, stream: &mut Stream) {
        let mut current = self.log_likelihood(state, weights);
        for &k in &self.noisy {
            // Steps of several sizes, since the width of the likelihood depends on the noise.
            let size = [0.3, 1.0, 2.0][stream.random_range(0..3)];
            let spread = ((state.std[k].powi(2) + self.within[k].powi(2)) / self.measurements as f64).sqrt();
            let mut next = state.clone();
            next.mean[k] += size * spread * stream.sample::<f64, _>(StandardNormal);
            let ln_step =
                size * (1.0 + self.within[k] / state.std[k]).min(4.0) / (2.0 * self.measurements as f64).sqrt();
            next.std[k] *= (ln_step * stream.sample::<f64, _>(StandardNormal)).exp();
            let threshold: f64 = stream.random();
            if !self.is_possible(&next, k) {
                continue;
            }
            self.weigh_changed(k, (state, weights), &next, others);
            let likelihood = self.log_likelihood(&next, others);
            // The step is symmetric in ln σ, but its size depends on σ; and σ is uniform a priori.
            let back = size * (1.0 + self.within[k] / next.std[k]).min(4.0) / (2.0 * self.measurements as f64).sqrt();
            let moved = (next.std[k] / state.std[k]).ln();
            let sizes = (ln_step / back).ln() + 0.5 * moved * moved * (ln_step.powi(-2) - back.powi(-2));
            let next_spread = ((next.std[k].powi(2) + self.within[k].powi(2)) / self.measurements as f64).sqrt();
            let shifted = (next.mean[k] - state.mean[k]) / size;
            let shifts =
                (spread / next_spread).ln() + 0.5 * shifted * shifted * (spread.powi(-2) - next_spread.powi(-2));
            let known = self.spreads[k].log_density(next.std[k]) - self.spreads[k].log_density(state.std[k]);
            if threshold.ln() < likelihood - current + known + moved + sizes + shifts {
                *state = next;
                current = likelihood;
                std::mem::swap(weights, others);
            }
        }
    }

    /// One sweep of the Gibbs sampler. `weights`: those under the state.
    fn sweep(&self, state: &mut State, weights: &Weights, stream: &mut Stream) {
        let n = self.measurements as f64;
        // Place and lane of the selected sample of each measurement.
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
            let known = self.spreads[k];
            state.std[k] = draw_std(squares + known.squares, n + known.degrees, self.floor[k], stream);
            let spread = state.std[k] / n.sqrt();
            let mut draw = || centre + spread * stream.sample::<f64, _>(StandardNormal);
            let inside = (0..20).map(|_| draw()).find(|mean| (0.0..=1.0).contains(mean));
            state.mean[k] = inside.unwrap_or(centre);
        }
    }
}

/// Draws σ given the sum of squares SS about the mean of n values, with μ integrated out.
///
/// ```text
///  p(ln σ) ∝ σ · σ^{1−n} · exp(−SS/2σ²)   between the floor and WIDEST
/// ```
fn draw_std(squares: f64, n: f64, floor: f64, stream: &mut Stream) -> f64 {
    // Without the limits, 1/σ² has a gamma distribution, whose draws nearly always fall between them.
    if n >= GAMMA_FROM && squares > 0.0 {
        let gamma = Gamma::new(0.5 * (n - 2.0), 2.0 / squares).expect("shape and scale are positive");
        let draws = (0..8).map(|_| 1.0 / stream.sample(gamma).sqrt());
        if let Some(std) = { draws }.find(|std| (floor..=WIDEST).contains(std)) {
            return std;
        }
    }
    // The mass lies within a few widths 1/√(2n) of the mode. The grid covers no more than that, to remain fine.
    let mode = if n > 2.0 { (squares / (n - 2.0)).sqrt() } else { WIDEST };
    let reach = (8.0 / (2.0 * n).sqrt()).max(0.5);
    let low = if n > 2.0 { (mode.clamp(floor, WIDEST).ln() - reach).max(floor.ln()) } else { floor.ln() };
    // With few values the upper tail is long.
    let high = if n < 12.0 { WIDEST.ln() } else { (mode.clamp(floor, WIDEST).ln() + 1.5 * reach).min(WIDEST.ln()) };
    let step = (high - low).max(1e-12) / GRID as f64;
    let mut densities = [0.0; GRID];
    // The values of 1/σ² at the cells form a geometric sequence.
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
    let position = cell.unwrap_or(GRID - 1) as f64 + stream.random::<f64>();
    (low + position * step).exp().clamp(floor, WIDEST)
}
