//! The trained model itself: a flow, the standardisation of its inputs, its structure, and its manifest.

use std::borrow::Cow;

use candle_core::Tensor;

use super::conditions::Conditions;
use super::error::InferenceError;
use super::manifest::{Group, Manifest};
use super::observation::{Encoder, Observation};
use super::start::{locate_all, Located};
use crate::flow::sampler::Sampler;
use crate::flow::Flow;
use structures::parameter::ParameterSpace;
use structures::quantity::Digest;
use structures::simulator::Simulator;
use structures::stats::Stream;

/// A trained model: the flow of one structure with its manifest.
pub struct Baseline {
    pub(super) flow: Flow,
    /// The flow's weights in the form that sampling uses; `None` where they are not single precision.
    sampler: Sampler,
    encoder: Encoder,
    pub(super) simulator: Simulator,
    /// The training box. The flow's real line corresponds to this box.
    pub(super) training_space: ParameterSpace,
    pub(super) manifest: Manifest,
    digest: Digest,
}

impl Baseline {
    /// Assembles a model; `digest` identifies it.
    ///
    /// # Errors
    /// A candle error when the weights cannot be read.
    pub(super) fn new(
        flow: Flow,
        simulator: &Simulator,
        manifest: Manifest,
        digest: Digest,
    ) -> Result<Self, candle_core::Error> {
        Ok(Self {
            sampler: Sampler::new(&flow)?,
            flow,
            encoder: Encoder::new(&manifest.whitening, &manifest.conditions),
            training_space: manifest.conditions.training_space(simulator.space()),
            simulator: simulator.clone(),
            manifest,
            digest,
        })
    }

    /// The structure that the model was trained for.
    pub fn simulator(&self) -> &Simulator {
        &self.simulator
    }

    /// The parameters of that structure.
    pub fn space(&self) -> &ParameterSpace {
        self.simulator.space()
    }

    /// How the model was trained and what was measured of it.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// Groups of parameters that the modes cannot distinguish.
    pub fn groups(&self) -> Vec<Group> {
        self.manifest.identifiability.resolve(self.space())
    }

    /// SHA-256 of the manifest file, which in turn contains that of the weights. It identifies the model in every result.
    pub fn digest(&self) -> &Digest {
        &self.digest
    }

    /// Whether the flow starts at the best fit of each measurement: with many parameters or with mode shapes.
    pub fn starts_at_fit(&self) -> bool {
        self.manifest.conditions.starts_at_fit
    }

    /// Samples of the flow, as [`Flow::sample`], but with the weights read once.
    pub(super) fn draw_from_flow(
        &self,
        context: &Tensor,
        draws: usize,
        stream: &mut Stream,
    ) -> Result<(Tensor, Tensor), candle_core::Error> {
        self.sampler.sample(context, draws, stream)
    }

    /// Maps z to the real line x, where `latent` holds z `[n·k·d]`, k rows for each of the n rows of `context`. Returns x and
    /// ln|det ∂z/∂x| of each row.
    ///
    /// # Errors
    /// A candle error, which would be a bug.
    pub(super) fn map_latent(
        &self,
        mut latent: Vec<f32>,
        context: &Tensor,
    ) -> Result<(Vec<f64>, Vec<f64>), candle_core::Error> {
        let (_, features) = context.dims2()?;
        let log_det = self.sampler.inverse(&mut latent, &context.flatten_all()?.to_vec1()?, features);
        let wide = |values: Vec<f32>| values.into_iter().map(f64::from).collect();
        Ok((wide(latent), wide(log_det)))
    }

    /// The summary S(y) of each observation, `[n, context]`, for a flow that does not start at the best fit.
    ///
    /// # Errors
    /// [`InferenceError::Modes`] for another number of modes.
    pub(super) fn condition(&self, observations: &[Observation]) -> Result<Tensor, InferenceError> {
        self.check_modes(observations)?;
        let observations = &*self.within_training(observations);
        Ok(self.flow.summarise(&self.encoder.encode(observations)?.to_dtype(self.flow.dtype())?)?)
    }

    /// The best fit of each observation, and the condition of the flow at these fits, `[n, features]`.
    ///
    /// # Errors
    /// [`InferenceError`] for another number of modes or a simulation that fails.
    pub(super) fn locate(&self, observations: &[Observation]) -> Result<(Vec<Located>, Tensor), InferenceError> {
        self.check_modes(observations)?;
        let observations = &*self.within_training(observations);
        let located =
            locate_all(&self.simulator, observations).map_err(|e| InferenceError::Simulation(e.to_string()))?;
        let (conditions, width) = (&self.manifest.conditions, self.manifest.architecture.fixed_context);
        let context = fit_condition(&located, observations, conditions, width)?.to_dtype(self.flow.dtype())?;
        Ok((located, context))
    }

    /// Noise of an observation as a multiple of the largest that the flow was trained for, geometric mean over the modes present; at
    /// least 1.
    pub(super) fn noise_beyond_training(&self, observation: &Observation) -> f64 {
        let Some(range) = &self.manifest.conditions.noise_range else { return 1.0 };
        let present = observation.frequencies_hz.iter().zip(&observation.noise_multiple).filter(|(f, _)| f.is_some());
        let logs: f64 = present.map(|(_, multiple)| (multiple / range.highest).max(1.0).ln()).sum();
        (logs / observation.modes_present().max(1) as f64).exp()
    }

    /// The observations as the flow is asked about them: noise beyond what it was trained for is replaced by the largest trained one.
    fn within_training<'a>(&self, observations: &'a [Observation]) -> Cow<'a, [Observation]> {
        let Some(range) = &self.manifest.conditions.noise_range else { return Cow::Borrowed(observations) };
        if observations.iter().all(|one| one.noise_multiple.iter().all(|multiple| *multiple <= range.highest)) {
            return Cow::Borrowed(observations);
        }
        let within = |one: &Observation| {
            let noise_multiple = one.noise_multiple.iter().map(|multiple| multiple.min(range.highest)).collect();
            Observation { noise_multiple, ..one.clone() }
        };
        Cow::Owned(observations.iter().map(within).collect())
    }

    fn check_modes(&self, observations: &[Observation]) -> Result<(), InferenceError> {
        let expected = self.simulator.modes();
        match observations.iter().find(|o| o.frequencies_hz.len() != expected) {
            Some(o) => Err(InferenceError::Modes { found: o.frequencies_hz.len(), expected }),
            None => Ok(()),
        }
    }
}

/// Input of a flow that starts at the best fit, `[n, width]`, f64: the features of each fit, then the positions of the effects'
/// sizes in their ranges. Flows that earlier versions of this program trained have the features only.
///
/// # Errors
/// A candle error, which would be a bug.
pub(super) fn fit_condition(
    located: &[Located],
    observations: &[Observation],
    conditions: &Conditions,
    width: usize,
) -> Result<Tensor, candle_core::Error> {
    let mut values = Vec::with_capacity(located.len() * width);
    for (fit, observation) in located.iter().zip(observations) {
        values.extend(fit.features().chain(conditions.effect_positions(&observation.effect_sizes)).take(width));
    }
    Tensor::from_vec(values, (located.len(), width), &candle_core::Device::Cpu)
}
