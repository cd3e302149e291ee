//! Posterior samples of measurements: draws of the flow, corrected by the simulation, and marginalised over missing
//! covariates.

use nalgebra::DMatrix;
use rand::RngCore as _;

use super::error::InferenceError;
use super::model::Baseline;
use super::observation::Observation;
use super::resample::Resampled;
use super::start::weighs_every_draw;
use super::{project, resample};
use crate::posterior::PosteriorSamples;
use structures::quantity::Digest;
use structures::stats;

/// Draws of the flow for each sample that is kept, where the draws are resampled by importance.
const PROPOSALS: usize = 2;

/// Number of measurements with a missing covariate that are inferred together. Each is expanded into one observation per
/// possible value of the covariate.
const MARGINALISED_AT_A_TIME: usize = 64;

/// Seed of the draws for a batch: the same data and model always give the same draws.
pub fn assessment_seed(content: &Digest, baseline: &Digest) -> u64 {
    stats::stream(0, &format!("assessment:{content}:{baseline}")).next_u64()
}

/// Posterior samples, and which of them the simulation has corrected.
pub(super) struct Corrected {
    pub(super) samples: PosteriorSamples,
    /// Whether the samples of each observation are weighted by their likelihood, `[n]`; the others are draws of the flow.
    pub(super) weighted: Vec<bool>,
}

impl Baseline {
    /// Posterior samples of each measurement, `[n·draws, d]` for n observations, in parameter units.
    ///
    /// The flow proposes two draws for each sample, and sampling–importance resampling corrects them by the exact
    /// likelihood; see `crates/inference/src/baseline/resample.rs` for where this is done. Where fewer than half of them are effective, a mixture of local
    /// normal approximations about them proposes others, see `crates/inference/src/baseline/local.rs`, or the proposals adapt to the posterior, see
    /// `crates/inference/src/baseline/adapt.rs`. Draws of the flow that the simulation has not corrected are stretched as the manifest's
    /// [`spread`](super::manifest::Manifest::spread) says. Where a covariate is missing, the samples go through its possible values in
    /// turn:
    ///
    /// ```text
    ///  p(x | y) ≈ 1/C Σ_c p(x | y, c)
    /// ```
    ///
    /// Source: Wang et al. (2025), §3.2; resampling: D. B. Rubin (1988), Using the SIR algorithm to simulate posterior
    /// distributions, Bayesian Statistics 3, 395–402.
    ///
    /// # Errors
    /// [`InferenceError`] for another number of modes or a draw that is not finite.
    pub fn infer(
        &self,
        observations: &[Observation],
        draws: usize,
        seed: u64,
    ) -> Result<PosteriorSamples, InferenceError> {
        self.infer_from(observations, draws, PROPOSALS, seed)
    }

    /// As [`Self::infer`], `[n·draws, d]` in parameter units, in almost half the time: where draws are resampled, the flow
    /// proposes only one draw per sample, so that draws with a large weight occur repeatedly.
    ///
    /// # Errors
    /// As [`Self::infer`].
    pub fn infer_with_repeats(
        &self,
        observations: &[Observation],
        draws: usize,
        seed: u64,
    ) -> Result<PosteriorSamples, InferenceError> {
        self.infer_from(observations, draws, 1, seed)
    }

    /// Logarithm of the likelihood at `draws` rows of `theta` for each observation, nats, up to a constant for each observation. It is
    /// that of the simulation where the draws are resampled by it, otherwise the density of the flow, stretched as its draws are, over
    /// that of the prior.
    ///
    /// `theta`: `[n·draws, d]`; `observations`: n. Returns n·draws values.
    ///
    /// # Errors
    /// [`InferenceError`] for another number of modes.
    pub fn log_likelihood_of_draws(
        &self,
        theta: &DMatrix<f64>,
        observations: &[Observation],
    ) -> Result<Vec<f64>, InferenceError> {
        if self.is_resampled() && !observations.iter().any(Observation::is_marginalised) {
            return Ok(resample::log_likelihoods(&self.simulator, observations, theta));
        }
        let mut logs = if self.stretches(observations) {
            let (before, log_stretch) = self.before_stretching(theta, observations)?;
            let density = self.log_density_of_draws(&before, observations)?;
            density.into_iter().zip(log_stretch).map(|(log_q, stretch)| log_q - stretch).collect()
        } else {
            self.log_density_of_draws(theta, observations)?
        };
        let space = self.space();
        if !space.is_uniform() {
            logs.iter_mut().zip(theta.row_iter()).for_each(|(log, row)| *log -= space.log_prior(row.iter()));
        }
        Ok(logs)
    }

    /// As [`Self::infer`], with `proposals` draws of the flow for each sample.
    fn infer_from(
        &self,
        observations: &[Observation],
        draws: usize,
        proposals: usize,
        seed: u64,
    ) -> Result<PosteriorSamples, InferenceError> {
        let (marginalised, known): (Vec<usize>, Vec<usize>) =
            (0..observations.len()).partition(|row| observations[*row].is_marginalised());
        if marginalised.is_empty() {
            return self.infer_known(observations, draws, proposals, seed);
        }
        let mut theta = DMatrix::zeros(observations.len() * draws, self.space().len());
        let mut simulations = 0;
        let of_known: Vec<Observation> = known.iter().map(|row| observations[*row].clone()).collect();
        if !known.is_empty() {
            let samples = self.infer_known(&of_known, draws, proposals, seed)?;
            simulations += samples.simulations();
            for (index, row) in known.iter().enumerate() {
                for draw in 0..draws {
                    theta.set_row(row * draws + draw, &samples.theta().row(index * draws + draw));
                }
            }
        }
        for (chunk, rows) in marginalised.chunks(MARGINALISED_AT_A_TIME).enumerate() {
            let seed = seed.wrapping_add(1 + chunk as u64);
            let values = rows.iter().map(|row| observations[*row].sizes_to_marginalise.len()).max().unwrap_or(1);
            // Each possible value of the covariate becomes one observation, which gets an equal share of the draws.
            let each = draws.div_ceil(values.min(draws.max(1)));
            let expanded: Vec<Observation> = rows.iter().flat_map(|row| observations[*row].at_each_size()).collect();
            let samples = self.infer_known(&expanded, each, proposals, seed)?;
            simulations += samples.simulations();
            let mut first = 0;
            for row in rows {
                let count = observations[*row].sizes_to_marginalise.len();
                let stride = spread_stride(count);
                for draw in 0..draws {
                    // Any few consecutive draws cover the whole range of values.
                    let source = (first + draw * stride % count) * each + (draw / count) % each;
                    theta.set_row(row * draws + draw, &samples.theta().row(source));
                }
                first += count;
            }
        }
        Ok(PosteriorSamples::new(theta, draws).after(simulations))
    }

    /// Samples of measurements with all covariates. With noise the flow's draws are resampled by their likelihood; without
    /// noise they are moved to parameters that reproduce the measurement. What the simulation does not correct is stretched.
    fn infer_known(
        &self,
        observations: &[Observation],
        draws: usize,
        proposals: usize,
        seed: u64,
    ) -> Result<PosteriorSamples, InferenceError> {
        let Corrected { samples, weighted } = self.infer_unstretched(observations, draws, proposals, seed)?;
        if !self.stretches(observations) {
            return Ok(samples);
        }
        let simulations = samples.simulations();
        let mut theta = samples.into_theta();
        for (row, observation) in observations.iter().enumerate().filter(|(row, _)| !weighted[*row]) {
            self.stretch(observation, theta.rows_mut(row * draws, draws));
        }
        Ok(PosteriorSamples::new(theta, draws).after(simulations))
    }

    /// As [`Self::infer`] for measurements with all covariates, before draws of the flow are stretched.
    ///
    /// # Errors
    /// As [`Self::infer`].
    pub(super) fn infer_as_known(
        &self,
        observations: &[Observation],
        draws: usize,
        seed: u64,
    ) -> Result<Corrected, InferenceError> {
        self.infer_unstretched(observations, draws, PROPOSALS, seed)
    }

    fn infer_unstretched(
        &self,
        observations: &[Observation],
        draws: usize,
        proposals: usize,
        seed: u64,
    ) -> Result<Corrected, InferenceError> {
        let uncorrected = || vec![false; observations.len()];
        if self.starts_at_fit() {
            let samples = PosteriorSamples::new(self.propose_from_fit(observations, draws, seed)?.theta, draws);
            return Ok(Corrected { samples, weighted: uncorrected() });
        }
        if self.is_resampled() {
            return self.infer_weighted(observations, draws, proposals, seed);
        }
        let mut theta = self.propose(observations, draws, seed)?.theta;
        let simulations = match self.manifest.conditions.noise_range {
            None if self.is_corrected() => project::project(&self.simulator, observations, &mut theta),
            _ => 0,
        };
        let samples = PosteriorSamples::new(theta, draws).after(simulations);
        Ok(Corrected { samples, weighted: uncorrected() })
    }

    /// Sampling–importance resampling of the flow's draws, and importance sampling with other proposals for the measurements for which
    /// they do not suffice.
    fn infer_weighted(
        &self,
        observations: &[Observation],
        draws: usize,
        proposals: usize,
        seed: u64,
    ) -> Result<Corrected, InferenceError> {
        let first = self.propose(observations, proposals * draws, seed)?;
        let mut simulations = first.theta.nrows();
        let Resampled { mut theta, mut weighted } =
            resample::resample(&self.simulator, observations, &first, draws, seed);
        // Draws that were moved to the bounds of the prior tell of a measurement outside it, which has no posterior to adapt to.
        // The draws of the flow are too narrow for noise beyond its training, whatever their weights say.
        let is_poor = |row: &usize| {
            (!weighted[*row] && !first.moved[*row]) || self.noise_beyond_training(&observations[*row]) > 1.0
        };
        let poor: Vec<usize> = (0..observations.len()).filter(is_poor).collect();
        if !poor.is_empty() {
            let of_poor: Vec<Observation> = poor.iter().map(|row| observations[*row].clone()).collect();
            let adapted = self.adapt(&of_poor, draws, seed)?;
            simulations += adapted.simulations;
            for (row, found) in poor.into_iter().zip(adapted.found) {
                if let Some(found) = found {
                    weighted[row] = found.complete;
                    theta.rows_mut(row * draws, draws).copy_from(&found.theta);
                }
            }
        }
        Ok(Corrected { samples: PosteriorSamples::new(theta, draws).after(simulations), weighted })
    }

    /// Whether draws are resampled by importance. Without noise there is no likelihood to weight them by.
    pub fn is_resampled(&self) -> bool {
        self.manifest.conditions.noise_range.is_some() && self.is_corrected()
    }

    /// Whether the simulation corrects the flow's draws. There is no correction in three cases:
    /// - the coefficients of the effects are uncertain, and the flow was trained to average over them;
    /// - solving the eigenproblem for every draw would take too long;
    /// - the flow starts at the best fit, which is computed by the simulation already. With a hundred parameters, importance
    ///   weights would leave a single draw.
    fn is_corrected(&self) -> bool {
        weighs_every_draw(&self.simulator) && !self.starts_at_fit()
    }
}

/// A step near 0.6·`count` that is coprime to `count`: walking by it visits every index, and the first few lie far apart.
fn spread_stride(count: usize) -> usize {
    let divisor = |mut a: usize, mut b: usize| {
        while b > 0 {
            (a, b) = (b, a % b);
        }
        a
    };
    let wanted = (count * 3 / 5).max(1);
    (wanted..count.max(2)).find(|stride| divisor(*stride, count) == 1).unwrap_or(1)
}
