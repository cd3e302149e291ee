//! A trained baseline: the flow of one structure, with everything needed to use it and to trust it.

pub mod calibration;
mod fitted;
pub mod identifiability;
pub mod library;
pub mod manifest;
pub mod nearest;
pub mod observation;
mod project;
mod resample;
pub mod start;
pub mod train;

use candle_core::{DType, Device, Tensor};
use nalgebra::{DMatrix, DVector};
use rand::RngCore as _;
use rayon::prelude::*;

use crate::flow::sampler::Sampler;
use crate::flow::{checkpoint, Flow};
use crate::measurement::shape::unit_shape;
use crate::measurement::ModalMeasurement;
use crate::parameter::{Parameter, ParameterSpace};
use crate::posterior::PosteriorSamples;
use crate::quantity::{Digest, Hertz};
use crate::simulator::Simulator;
use crate::stats::{self, Stream};
use identifiability::Group;
use manifest::{Manifest, SelfTest, Whitening};
use observation::{Admitted, Encoder, Observation};
use resample::Proposals;

/// Largest difference of a self-test draw, as a share of the prior's width: f32 kernels differ between processors by
/// some 1e-5, a wrong weight by far more.
const SELF_TEST_TOLERANCE: f64 = 1e-3;

/// Times that draws beyond the prior are drawn again.
const ROUNDS: usize = 12;

/// Draws of the flow for each sample that is kept, where the simulation weighs them.
const PROPOSALS: usize = 2;

/// Most degrees of freedom of a structure whose eigenproblem is solved for every draw: a millisecond each beyond.
const MOST_FREEDOMS_WEIGHED: usize = 80;

/// Rows that go through the flow together: more fill no cache, and gigabytes where every step is remembered for training.
const ROWS_AT_A_TIME: usize = 8_192;

/// Draws that estimate which share of a posterior lies inside the prior.
const SHARE_DRAWS: usize = 200;

/// Why a stored baseline is refused.
#[derive(Debug, thiserror::Error)]
pub enum LoadError {
    /// The manifest is no manifest.
    #[error("the manifest is not readable: {0}")]
    Manifest(#[from] serde_json::Error),
    /// A manifest of another format.
    #[error("the manifest has format {found}; this program reads format {}", manifest::FORMAT)]
    Format {
        /// Format found.
        found: u32,
    },
    /// The weights are not those the manifest was written for.
    #[error("the weights have SHA-256 {found}, the manifest says {expected}: the files do not belong together or one is damaged")]
    WeightsDigest {
        /// From the manifest.
        expected: Digest,
        /// Of the file.
        found: Digest,
    },
    /// Trained for another structure, or another version of it.
    #[error("it was trained for structure {trained_for} (digest {expected}), but the structure here has digest {found}: train again")]
    Structure {
        /// Id in the manifest.
        trained_for: String,
        /// Digest in the manifest.
        expected: Digest,
        /// Digest of the structure at hand.
        found: Digest,
    },
    /// Sizes that do not fit the structure.
    #[error("{what} has {found} entries, expected {expected}")]
    Shape {
        /// Part of the manifest.
        what: &'static str,
        /// Entries found.
        found: usize,
        /// Entries expected.
        expected: usize,
    },
    /// The weight file is damaged or foreign.
    #[error(transparent)]
    Weights(#[from] checkpoint::Error),
    /// The self-test gave other draws than when it was trained.
    #[error(
        "the self-test differs by {difference:.2e} of the prior's width (at most {SELF_TEST_TOLERANCE:.0e} is allowed)"
    )]
    SelfTest {
        /// Largest difference, as a share of the prior's width.
        difference: f64,
    },
    /// Inference in the self-test failed.
    #[error("the self-test failed: {0}")]
    Inference(#[from] InferenceError),
}

/// Why an inference failed; each is a bug or a damaged baseline, never bad input, which is refused before.
#[derive(Debug, thiserror::Error)]
pub enum InferenceError {
    /// Another number of modes than the baseline was trained for.
    #[error("{found} frequencies in a measurement of {expected} modes")]
    Modes {
        /// Modes found.
        found: usize,
        /// Modes of the baseline.
        expected: usize,
    },
    /// A draw that is not finite.
    #[error("draw {row} of parameter {parameter} is not finite")]
    NotFinite {
        /// Row of the sample matrix.
        row: usize,
        /// Name of the parameter.
        parameter: String,
    },
    /// The simulation failed inside the prior.
    #[error("the simulation failed: {0}")]
    Simulation(String),
    /// A tensor error.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}

/// A flow with its standardisers, its structure and its record.
pub struct Baseline {
    flow: Flow,
    /// The flow's weights as draws need them; `None` where they are not single precision.
    sampler: Option<Sampler>,
    encoder: Encoder,
    simulator: Simulator,
    /// The box it was trained in, which its real line stands for.
    training_space: ParameterSpace,
    manifest: Manifest,
    digest: Digest,
}

/// Measurements without a covariate that are drawn from at a time: each stands for as many as there are possible values.
const BLIND_AT_A_TIME: usize = 64;

/// One observation for each of the possible sizes.
fn at_possible_sizes(observation: &Observation) -> Vec<Observation> {
    let at = |sizes: &Vec<f64>| Observation {
        effect_sizes: sizes.clone(),
        possible_sizes: Vec::new(),
        ..observation.clone()
    };
    observation.possible_sizes.iter().map(at).collect()
}

/// A step near 0.6 of `count` without a common divisor: walking by it visits all, and the first few lie far apart.
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

impl Baseline {
    /// Reads a stored baseline and runs its self-test.
    ///
    /// # Errors
    /// [`LoadError`], one variant for each way it can be wrong.
    pub fn load(manifest_bytes: &[u8], weights: &[u8], simulator: &Simulator) -> Result<Self, LoadError> {
        fault_point!("baseline::load", |_| Err(LoadError::SelfTest { difference: 1.0 }));
        let manifest: Manifest = serde_json::from_slice(manifest_bytes)?;
        if manifest.format != manifest::FORMAT {
            return Err(LoadError::Format { found: manifest.format });
        }
        let found = Digest::of_file(weights);
        if found != manifest.weights_sha256 {
            return Err(LoadError::WeightsDigest { expected: manifest.weights_sha256, found });
        }
        let found = simulator.digest().clone();
        if found != manifest.structure_digest {
            return Err(LoadError::Structure {
                trained_for: manifest.structure.to_string(),
                expected: manifest.structure_digest,
                found,
            });
        }
        let lengths = lengths(&manifest, simulator);
        if let Some((what, found, expected)) = lengths.into_iter().find(|(_, found, expected)| found != expected) {
            return Err(LoadError::Shape { what, found, expected });
        }
        let flow = checkpoint::from_bytes(weights, &manifest.architecture, DType::F32)?;
        let sampler = Sampler::new(&flow).map_err(checkpoint::Error::from)?;
        let baseline = Self {
            flow,
            sampler,
            encoder: Encoder::new(&manifest.whitening, &manifest.conditions),
            training_space: training_space(simulator.space(), &manifest.conditions),
            simulator: simulator.clone(),
            digest: Digest::of_file(manifest_bytes),
            manifest,
        };
        baseline.self_test()?;
        Ok(baseline)
    }

    /// Posterior samples of each measurement, `draws` for each.
    ///
    /// Where a covariate is not known, the samples go through its possible values in turn:
    ///
    /// ```text
    ///  p(x | y) ≈ mean over c of p(x | y, c)
    /// ```
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

    /// As [`Self::infer`], in nearly half the time: where the simulation weighs the draws, the flow makes but as many as are kept,
    /// and those of much weight come repeatedly.
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

    /// As [`Self::infer`], from so many proposals for each draw.
    fn infer_from(
        &self,
        observations: &[Observation],
        draws: usize,
        proposals: usize,
        seed: u64,
    ) -> Result<PosteriorSamples, InferenceError> {
        if observations.iter().all(|o| o.possible_sizes.is_empty()) {
            return self.infer_known(observations, draws, proposals, seed);
        }
        let (mut known, mut blind): (Vec<usize>, Vec<usize>) = (Vec::new(), Vec::new());
        for (row, observation) in observations.iter().enumerate() {
            if observation.possible_sizes.is_empty() { &mut known } else { &mut blind }.push(row);
        }
        let mut theta = DMatrix::zeros(observations.len() * draws, self.space().len());
        let mut simulations = 0;
        let of_known: Vec<Observation> = known.iter().map(|row| observations[*row].clone()).collect();
        if !known.is_empty() {
            let samples = self.infer_known(&of_known, draws, proposals, seed)?;
            simulations += samples.simulations();
            for (place, row) in known.iter().enumerate() {
                for draw in 0..draws {
                    theta.set_row(row * draws + draw, &samples.theta().row(place * draws + draw));
                }
            }
        }
        for (chunk, rows) in blind.chunks(BLIND_AT_A_TIME).enumerate() {
            let seed = seed.wrapping_add(1 + chunk as u64);
            let values = rows.iter().map(|row| observations[*row].possible_sizes.len()).max().unwrap_or(1);
            // Each possible value is an observation of its own, and gives its share of the draws.
            let each = draws.div_ceil(values.min(draws.max(1)));
            let expanded: Vec<Observation> =
                rows.iter().flat_map(|row| at_possible_sizes(&observations[*row])).collect();
            let samples = self.infer_known(&expanded, each, proposals, seed)?;
            simulations += samples.simulations();
            let mut first = 0;
            for row in rows {
                let count = observations[*row].possible_sizes.len();
                let stride = spread_stride(count);
                for draw in 0..draws {
                    // Any few draws in a row go through the whole range of values.
                    let source = (first + draw * stride % count) * each + (draw / count) % each;
                    theta.set_row(row * draws + draw, &samples.theta().row(source));
                }
                first += count;
            }
        }
        Ok(PosteriorSamples::new(theta, draws).after(simulations))
    }

    /// Samples where all covariates are known: the flow's draws, set right by the simulation, which weighs them where there is
    /// noise and moves them where there is none.
    fn infer_known(
        &self,
        observations: &[Observation],
        draws: usize,
        proposals: usize,
        seed: u64,
    ) -> Result<PosteriorSamples, InferenceError> {
        if self.starts_at_fit() {
            return Ok(PosteriorSamples::new(self.propose_from_fit(observations, draws, seed)?.theta, draws));
        }
        if self.is_weighed() {
            let proposals = self.propose(observations, proposals * draws, seed)?;
            let theta = resample::resample(&self.simulator, observations, &proposals, draws, seed);
            return Ok(PosteriorSamples::new(theta, draws).after(proposals.theta.nrows()));
        }
        let mut theta = self.propose(observations, draws, seed)?.theta;
        let simulations = match self.manifest.conditions.noise_range {
            None if self.is_set_right() => project::project(&self.simulator, observations, &mut theta),
            _ => 0,
        };
        Ok(PosteriorSamples::new(theta, draws).after(simulations))
    }

    /// Whether the simulation weighs the flow's draws: not without noise, of which there is none to weigh them by.
    fn is_weighed(&self) -> bool {
        self.manifest.conditions.noise_range.is_some() && self.is_set_right()
    }

    /// Whether the simulation sets the flow's draws right: not where it depends on numbers of effects that are themselves
    /// uncertain, over which the flow has learnt to average; not where it would take longer than anybody waits; and not where the
    /// flow starts at the best fit, which the simulation has had its say in: of a hundred parameters, weights would leave a single
    /// draw.
    fn is_set_right(&self) -> bool {
        let certain = self.simulator.effects().iter().all(|effect| effect.psi_std().iter().all(|std| *std <= 0.0));
        let quick = self.simulator.structure().is_none_or(|structure| structure.dofs() <= MOST_FREEDOMS_WEIGHED);
        certain && quick && !self.starts_at_fit()
    }

    /// Logarithm of the posterior density of `draws` rows of `theta` for each observation, in the unit box of the prior and up
    /// to a constant for each observation, nats: of the simulation where it weighs the draws too, else of the flow.
    ///
    /// # Errors
    /// [`InferenceError`] for another number of modes.
    pub fn log_posterior_of_draws(
        &self,
        theta: &DMatrix<f64>,
        observations: &[Observation],
    ) -> Result<Vec<f64>, InferenceError> {
        if self.is_weighed() && observations.iter().all(|o| o.possible_sizes.is_empty()) {
            return Ok(resample::log_likelihoods(&self.simulator, observations, theta));
        }
        self.log_density_of_draws(theta, observations)
    }

    /// The flow's own draws, `draws` for each observation.
    ///
    /// # Errors
    /// [`InferenceError`] for another number of modes or a draw that is not finite.
    fn propose(&self, observations: &[Observation], draws: usize, seed: u64) -> Result<Proposals, InferenceError> {
        if self.starts_at_fit() {
            return self.propose_from_fit(observations, draws, seed);
        }
        let d = self.space().len();
        let context = self.flow.summarise(&self.condition(observations)?)?;
        let mut stream = stats::stream(seed, "latent");
        let mut theta = DMatrix::from_element(observations.len() * draws, d, f64::NAN);
        let mut log_density = vec![0.0; observations.len() * draws];
        let mut filled = vec![0; observations.len()];
        let mut moved = vec![false; observations.len()];
        // Draws beyond the prior, in the margin of the training box, are drawn again. Where hardly any falls inside, the
        // measurement lies outside, and the nearest point of the box has to do.
        for round in 1..=ROUNDS {
            let pending: Vec<u32> =
                (0..observations.len() as u32).filter(|&row| filled[row as usize] < draws).collect();
            // Few are missing after the first round: twice as many as the row that lacks most, or all where most fall outside.
            let Some(missing) = pending.iter().map(|&row| draws - filled[row as usize]).max() else { break };
            let count = draws.min(2 * missing);
            let (mut real, mut log_q) = (Vec::new(), Vec::new());
            for part in pending.chunks((ROWS_AT_A_TIME / count).max(1)) {
                let rows = Tensor::from_slice(part, part.len(), &Device::Cpu)?;
                let (x, own) = self.draw_from_flow(&context.index_select(&rows, 0)?, count, &mut stream)?;
                real.extend(x.to_dtype(DType::F64)?.flatten_all()?.to_vec1::<f64>()?);
                log_q.extend(own.to_dtype(DType::F64)?.to_vec1::<f64>()?);
            }
            from_real_line(&mut real, &mut log_q, &self.training_space);
            for (place, values) in real.chunks_exact(d).enumerate() {
                let row = pending[place / count] as usize;
                if filled[row] == draws {
                    continue;
                }
                let mut inside = true;
                for (value, parameter) in values.iter().zip(self.space()) {
                    if !value.is_finite() {
                        return Err(InferenceError::NotFinite { row: place, parameter: parameter.name.clone() });
                    }
                    inside &= parameter.prior().contains(value);
                }
                if inside || round == ROUNDS {
                    let target = row * draws + filled[row];
                    for (column, (value, parameter)) in values.iter().zip(self.space()).enumerate() {
                        theta[(target, column)] = value.clamp(parameter.lower, parameter.upper);
                    }
                    moved[row] |= !inside;
                    log_density[target] = log_q[place];
                    filled[row] += 1;
                }
            }
        }
        Ok(Proposals { theta, log_density, moved })
    }

    /// A measurement as this baseline takes it, with the structure's noise where none is given.
    ///
    /// Less noise than it was trained for counts as the least it knows: the answer is wider than need be. A mode with more
    /// counts as missing: the answer is wider too. Neither is extrapolated.
    pub fn admit(&self, measurement: &ModalMeasurement) -> Admitted {
        let mut frequencies_hz: Vec<Option<f64>> =
            measurement.frequencies_hz.iter().map(|f| f.map(Hertz::get)).collect();
        let mut noise_multiple = vec![1.0; frequencies_hz.len()];
        let (mut below_range, mut above_range) = (false, false);
        match &self.manifest.conditions.noise_range {
            Some(range) => {
                for (mode, frequency) in frequencies_hz.iter_mut().enumerate() {
                    let given = measurement.std_hz.as_ref().and_then(|stds| stds[mode]);
                    let own = frequency.map(|f| self.simulator.std_hz(mode, f));
                    let given = given.zip(*frequency).map(|(std, f)| self.simulator.with_emulator_error(mode, f, std));
                    let multiple = given.zip(own).map_or(1.0, |(given, own)| given / own);
                    // The ends of the range belong to it, whatever the last digit of a division.
                    below_range |= frequency.is_some() && multiple < range.lowest * (1.0 - 1e-6);
                    if frequency.is_some() && multiple > range.highest * (1.0 + 1e-6) {
                        above_range = true;
                        *frequency = None;
                    } else if frequency.is_some() {
                        noise_multiple[mode] = multiple.clamp(range.lowest, range.highest);
                    }
                }
            }
            // Trained on exact and complete measurements only.
            None if frequencies_hz.iter().any(Option::is_none) => frequencies_hz.fill(None),
            None => noise_multiple.fill(0.0),
        }
        let shapes = measurement.mode_shapes.iter().flatten().map(|shape| unit_shape(shape.as_ref()?)).collect();
        let sizes = self.simulator.effect_sizes(&measurement.covariates);
        let possible_sizes = if sizes.missing.is_empty() {
            Vec::new()
        } else {
            self.simulator.marginalised_sizes(&measurement.covariates)
        };
        let observation =
            Observation { frequencies_hz, noise_multiple, shapes, effect_sizes: sizes.values, possible_sizes };
        Admitted {
            observation: (observation.modes_present() > 0).then_some(observation),
            below_range,
            above_range,
            covariates_missing: sizes.missing,
            covariates_beyond: sizes.beyond,
        }
    }

    /// Log-density of each row of `theta` given the observation of the same row, in the unit box of the prior, nats.
    ///
    /// ```text
    ///  log q(u | y) = log q(ℓ | y) − Σ log(v(1 − v)) − Σ log(wide/prior width) − log P(inside the prior | y)
    ///  ℓ = logit v,    v = (θ − lower)/width of the training box
    /// ```
    ///
    /// The share inside the prior is estimated by drawing; where the flow starts at the best fit it counts as 1, so that what
    /// the flow has beyond the prior makes the density too low.
    ///
    /// `theta`: `[n, d]` inside the prior box; `observations`: n.
    ///
    /// # Errors
    /// [`InferenceError`] for another number of modes.
    pub fn log_density_unit_box(
        &self,
        theta: &DMatrix<f64>,
        observations: &[Observation],
    ) -> Result<Vec<f64>, InferenceError> {
        if self.starts_at_fit() {
            return self.log_density_from_fit(theta, observations);
        }
        let context = self.flow.summarise(&self.condition(observations)?)?;
        let (drawn, _) = self.draw_from_flow(&context, SHARE_DRAWS, &mut stats::stream(0, "share inside the prior"))?;
        let drawn = drawn.to_dtype(DType::F64)?.to_vec2::<f64>()?;
        let inside = |values: &&Vec<f64>| {
            let pairs = values.iter().zip(self.training_space.iter().zip(self.space()));
            { pairs }.all(|(x, (wide, prior))| (prior.lower..=prior.upper).contains(&wide.from_unit(logistic(*x))))
        };
        let share = |row: usize| {
            let count = drawn[row * SHARE_DRAWS..(row + 1) * SHARE_DRAWS].iter().filter(inside).count();
            (count.max(1) as f64 / SHARE_DRAWS as f64).ln()
        };
        let density = self.log_density(theta, &context)?;
        Ok(density.into_iter().enumerate().map(|(row, log_q)| log_q - share(row)).collect())
    }

    /// Log-density of `draws` rows of `theta` for each observation, in the unit box of the prior and up to the share of the
    /// posterior inside the prior, which is the same for all rows of one observation; nats.
    ///
    /// # Errors
    /// [`InferenceError`] for another number of modes.
    pub fn log_density_of_draws(
        &self,
        theta: &DMatrix<f64>,
        observations: &[Observation],
    ) -> Result<Vec<f64>, InferenceError> {
        if self.starts_at_fit() && observations.iter().all(|o| o.possible_sizes.is_empty()) {
            return self.log_density_from_fit(theta, observations);
        }
        let draws = theta.nrows() / observations.len().max(1);
        if observations.iter().any(|o| !o.possible_sizes.is_empty()) {
            return self.log_density_of_blind_draws(theta, observations, draws);
        }
        let context = self.flow.summarise(&self.condition(observations)?)?;
        let (rows, features) = context.dims2()?;
        let repeated = context.unsqueeze(1)?.expand((rows, draws, features))?.reshape((rows * draws, features))?;
        self.log_density(theta, &repeated)
    }

    /// The same where covariates are missing: the mean of the densities at their possible values, one measurement at a time.
    fn log_density_of_blind_draws(
        &self,
        theta: &DMatrix<f64>,
        observations: &[Observation],
        draws: usize,
    ) -> Result<Vec<f64>, InferenceError> {
        let mut all = Vec::with_capacity(theta.nrows());
        for (row, observation) in observations.iter().enumerate() {
            let own = theta.rows(row * draws, draws);
            let possible = if observation.possible_sizes.is_empty() {
                vec![observation.clone()]
            } else {
                at_possible_sizes(observation)
            };
            let count = possible.len();
            let repeated = DMatrix::from_fn(count * draws, own.ncols(), |i, k| own[(i % draws, k)]);
            let known: Vec<Observation> =
                possible.into_iter().map(|o| Observation { possible_sizes: Vec::new(), ..o }).collect();
            let densities = self.log_density_of_draws(&repeated, &known)?;
            for draw in 0..draws {
                let values = || (0..count).map(|value| densities[value * draws + draw]);
                let largest = values().fold(f64::NEG_INFINITY, f64::max);
                let sum: f64 = values().map(|v| (v - largest).exp()).sum();
                all.push(largest + (sum / count as f64).ln());
            }
        }
        Ok(all)
    }

    fn log_density(&self, theta: &DMatrix<f64>, context: &Tensor) -> Result<Vec<f64>, InferenceError> {
        let x = to_real_line(theta, &self.training_space)?.to_dtype(self.flow.dtype())?;
        let log_q = self.flow.log_prob(&x, context)?.to_dtype(DType::F64)?.to_vec1::<f64>()?;
        let stretch = |row: usize| -> f64 {
            let one = |(column, (wide, prior)): (usize, (&Parameter, &Parameter))| {
                let v = wide.to_unit(theta[(row, column)]);
                (v * (1.0 - v)).ln() + ((wide.upper - wide.lower) / (prior.upper - prior.lower)).ln()
            };
            self.training_space.iter().zip(self.space()).enumerate().map(one).sum()
        };
        Ok(log_q.into_iter().enumerate().map(|(row, log_q)| log_q - stretch(row)).collect())
    }

    /// The structure it was trained for.
    pub fn simulator(&self) -> &Simulator {
        &self.simulator
    }

    /// Its parameters.
    pub fn space(&self) -> &ParameterSpace {
        self.simulator.space()
    }

    /// How it was made and what was measured of it.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// Parameters that cannot be told apart.
    pub fn groups(&self) -> Vec<Group> {
        self.manifest.identifiability.resolve(self.space())
    }

    /// SHA-256 of the manifest file, which holds that of the weights: the name of this baseline in every result.
    pub fn digest(&self) -> &Digest {
        &self.digest
    }

    /// As [`Flow::sample`], by the sampler that is kept.
    fn draw_from_flow(
        &self,
        context: &Tensor,
        draws: usize,
        stream: &mut Stream,
    ) -> Result<(Tensor, Tensor), candle_core::Error> {
        match &self.sampler {
            Some(sampler) => sampler.sample(context, draws, stream),
            None => self.flow.sample(context, draws, stream),
        }
    }

    fn condition(&self, observations: &[Observation]) -> Result<Tensor, InferenceError> {
        let expected = self.simulator.modes();
        if let Some(o) = observations.iter().find(|o| o.frequencies_hz.len() != expected) {
            return Err(InferenceError::Modes { found: o.frequencies_hz.len(), expected });
        }
        Ok(self.encoder.encode(observations)?.to_dtype(self.flow.dtype())?)
    }

    fn self_test(&self) -> Result<(), LoadError> {
        let SelfTest { frequencies_hz, shapes, seed, expected } = &self.manifest.self_test;
        let shapes = shapes.iter().cloned().map(Some).collect();
        let observation = Observation { shapes, ..Observation::complete(frequencies_hz) };
        let samples = self.propose(&[observation], expected.len().max(1), *seed)?;
        let width = |column: usize| self.space().as_slice()[column].upper - self.space().as_slice()[column].lower;
        let mut difference = 0.0_f64;
        for (row, values) in expected.iter().enumerate() {
            if values.len() != self.space().len() {
                let (found, expected) = (values.len(), self.space().len());
                return Err(LoadError::Shape { what: "self_test.expected", found, expected });
            }
            for (column, value) in values.iter().enumerate() {
                difference = difference.max((samples.theta[(row, column)] - value).abs() / width(column));
            }
        }
        // Not `>`: a NaN must fail too.
        if difference <= SELF_TEST_TOLERANCE && !expected.is_empty() {
            Ok(())
        } else {
            Err(LoadError::SelfTest { difference })
        }
    }
}

/// What has a length in a manifest: its name, how long it is, and how long it must be for this structure.
fn lengths(manifest: &Manifest, simulator: &Simulator) -> Vec<(&'static str, usize, usize)> {
    let (d, m) = (simulator.space().len(), simulator.modes());
    let Manifest { architecture, conditions, whitening, self_test, calibration, .. } = manifest;
    let mut all = vec![
        ("architecture.parameters", architecture.parameters, d),
        ("architecture.modes", architecture.modes, m),
        ("architecture.channels", architecture.channels, conditions.channels()),
        ("architecture.permutations", architecture.permutations.len(), architecture.units),
        ("architecture.fixed_context", architecture.fixed_context, conditions.fixed_context(d)),
        ("conditions.training_box", conditions.training_box.len(), d),
        ("whitening.mean", whitening.mean.len(), m),
        ("whitening.factor", whitening.factor.len(), m),
        ("self_test.frequencies_hz", self_test.frequencies_hz.len(), m),
    ];
    all.extend(whitening.factor.iter().map(|row| ("a row of whitening.factor", row.len(), m)));
    if !self_test.shapes.is_empty() {
        all.push(("self_test.shapes", self_test.shapes.len(), m));
        let points = simulator.shape_points();
        all.extend(self_test.shapes.iter().map(|shape| ("a shape of self_test.shapes", shape.len(), points)));
    }
    all.extend(calibration.cells.iter().map(|cell| ("parameters of calibration.cells", cell.parameters.len(), d)));
    all
}

/// Seed of the draws for a batch: the same data and baseline always give the same draws.
pub fn assessment_seed(content: &Digest, baseline: &Digest) -> u64 {
    stats::stream(0, &format!("assessment:{content}:{baseline}")).next_u64()
}

/// The logistic function, inverse of the logit.
fn logistic(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// The box a flow was trained in.
fn training_space(prior: &ParameterSpace, conditions: &manifest::Conditions) -> ParameterSpace {
    let wide = |(p, [lower, upper]): (&Parameter, &[f64; 2])| Parameter { lower: *lower, upper: *upper, ..p.clone() };
    ParameterSpace::new(prior.iter().zip(&conditions.training_box).map(wide).collect())
}

/// Draws that are taken off the real line together.
const OFF_THE_LINE: usize = 512;

/// Draws x of the real line to θ of the box `space`, and their log-densities to those of the unit box.
///
/// ```text
///  u = 1/(1 + e⁻ˣ),    ln q ← ln q − Σ ln u(1 − u) = ln q + Σ |x| + 2 ln Π (1 + e^−|x|)
/// ```
fn from_real_line(values: &mut [f64], log_density: &mut [f64], space: &ParameterSpace) {
    let d = space.len();
    let parts = values.par_chunks_mut(OFF_THE_LINE * d).zip(log_density.par_chunks_mut(OFF_THE_LINE));
    parts.for_each(|(values, log_density)| {
        for (values, log_q) in values.chunks_exact_mut(d).zip(log_density) {
            let mut product = 1.0_f64;
            for (value, parameter) in values.iter_mut().zip(space) {
                let e = (-value.abs()).exp();
                *log_q += value.abs();
                product *= 1.0 + e;
                if product > 1e200 {
                    *log_q += 2.0 * product.ln();
                    product = 1.0;
                }
                let unit = if *value < 0.0 { e / (1.0 + e) } else { 1.0 / (1.0 + e) };
                *value = parameter.from_unit(unit);
            }
            *log_q += 2.0 * product.ln();
        }
    });
}

/// θ of the box `space` to the real line by the logit of its position, f64 `[n, d]`.
fn to_real_line(theta: &DMatrix<f64>, space: &ParameterSpace) -> Result<Tensor, candle_core::Error> {
    let (rows, columns) = theta.shape();
    let mut values = Vec::with_capacity(rows * columns);
    for row in 0..rows {
        for (column, parameter) in space.iter().enumerate() {
            // A draw exactly on an edge would go to infinity.
            let unit = parameter.to_unit(theta[(row, column)]).clamp(1e-9, 1.0 - 1e-9);
            values.push((unit / (1.0 - unit)).ln());
        }
    }
    Tensor::from_vec(values, (rows, columns), &Device::Cpu)
}

impl Whitening {
    /// Whitening of log-frequencies by their full covariance over the training set.
    ///
    /// ```text
    ///  w = L⁻¹ (ln f − mean),    L Lᵀ = covariance of ln f
    /// ```
    ///
    /// `None` when a frequency does not vary over the prior, or two vary as one.
    fn fit(frequencies_hz: &[Vec<f64>]) -> Option<Self> {
        let modes = frequencies_hz.first()?.len();
        let logs: Vec<DVector<f64>> =
            frequencies_hz.iter().map(|row| DVector::from_iterator(modes, row.iter().map(|f| f.ln()))).collect();
        let count = logs.len() as f64;
        let mean = logs.iter().fold(DVector::zeros(modes), |sum, row| sum + row) / count;
        let covariance = logs.iter().fold(DMatrix::zeros(modes, modes), |sum, row| {
            let deviation = row - &mean;
            sum + &deviation * deviation.transpose() / count
        });
        let factor = covariance.cholesky()?.l();
        let rows = (0..modes).map(|i| factor.row(i).iter().copied().collect()).collect();
        Some(Self { mean: mean.iter().copied().collect(), factor: rows })
    }
}
