//! One measurement as the flow sees it: log-frequencies, the size of their noise, and which modes are missing.

use candle_core::{Device, Tensor};
use nalgebra::{DMatrix, DVector};
use rand::Rng as _;
use rand_distr::StandardNormal;

use super::manifest::{Conditions, EffectRange, NoiseRange, Whitening};
use crate::measurement::shape::unit_shape;
use crate::simulator::Simulator;
use crate::stats::Stream;

/// Noise a trained flow covers unless asked otherwise, as multiples of the structure's own.
pub const DEFAULT_NOISE_RANGE: NoiseRange = NoiseRange { lowest: 0.1, highest: 5.0 };

/// Share of the training measurements that have all modes.
const SHARE_COMPLETE: f64 = 0.6;
/// Share of the training measurements without any mode shape, of a structure with instrumented points.
const SHARE_WITHOUT_SHAPES: f64 = 0.2;
/// Share of the shapes that are missing in the others.
const SHARE_SHAPE_MISSING: f64 = 0.02;
/// Share of the training measurements whose modes all have the same noise, as a multiple of the structure's.
const SHARE_COMMON_NOISE: f64 = 0.6;

/// Frequencies of one measurement and the standard deviation of each.
#[derive(Debug, Clone, PartialEq)]
pub struct Observation {
    /// One entry a mode, Hz; `None` where the mode was not identified. At least one is present.
    pub frequencies_hz: Vec<Option<f64>>,
    /// Standard deviation of each frequency as a multiple of the structure's own; 1 where a mode is missing.
    pub noise_multiple: Vec<f64>,
    /// Shape of each mode at the instrumented points, of unit norm; `None` where it was not identified. Empty without any.
    pub shapes: Vec<Option<Vec<f64>>>,
    /// Sizes of the structure's effects under the covariates of the measurement; empty where nothing is known of them, or
    /// there are none.
    pub effect_sizes: Vec<f64>,
    /// Sizes to go through, each as probable as the others, where a covariate is not known.
    pub possible_sizes: Vec<Vec<f64>>,
}

impl Observation {
    /// All modes, each with the structure's own noise.
    pub fn complete(frequencies_hz: &[f64]) -> Self {
        Self {
            frequencies_hz: frequencies_hz.iter().copied().map(Some).collect(),
            noise_multiple: vec![1.0; frequencies_hz.len()],
            shapes: Vec::new(),
            effect_sizes: Vec::new(),
            possible_sizes: Vec::new(),
        }
    }

    /// The simulation under the effects of this measurement.
    pub fn simulator(&self, simulator: &Simulator) -> Simulator {
        if simulator.effects().is_empty() {
            simulator.clone()
        } else {
            simulator.under(&self.effect_sizes)
        }
    }

    /// Modes that are there.
    pub fn modes_present(&self) -> usize {
        self.frequencies_hz.iter().flatten().count()
    }

    /// Shape of mode `mode`, where the mode is there and its shape is known.
    pub fn shape(&self, mode: usize) -> Option<&[f64]> {
        self.frequencies_hz[mode]?;
        self.shapes.get(mode)?.as_deref()
    }

    /// True when some mode has a shape.
    pub fn has_shapes(&self) -> bool {
        (0..self.frequencies_hz.len()).any(|mode| self.shape(mode).is_some())
    }

    /// Standard deviation of mode `mode`, Hz; `None` where it is missing.
    pub fn std_hz(&self, simulator: &Simulator, mode: usize) -> Option<f64> {
        Some(simulator.std_hz(mode, self.frequencies_hz[mode]?) * self.noise_multiple[mode])
    }
}

/// A measurement as a baseline takes it.
#[derive(Debug, Clone, PartialEq)]
pub struct Admitted {
    /// What the flow is asked; `None` when no mode is left.
    pub observation: Option<Observation>,
    /// Some mode had less noise than the baseline was trained for.
    pub below_range: bool,
    /// Some mode had more, and is left out.
    pub above_range: bool,
    /// Covariates that an effect needs and the measurement lacks.
    pub covariates_missing: Vec<String>,
    /// Covariates beyond what an effect was learnt from.
    pub covariates_beyond: Vec<String>,
}

impl Conditions {
    /// Numbers the flow is given for each mode: the whitened log-frequency, with noise its size and the mask,
    /// and the size of each effect that a covariate moves.
    pub fn channels(&self) -> usize {
        let own = if self.noise_range.is_some() { 3 } else { 1 };
        own + self.effects.len()
    }

    /// Which shapes of one simulated measurement are missing.
    pub fn draw_shapes(modes: usize, stream: &mut Stream) -> Vec<bool> {
        let without = stream.random::<f64>() < SHARE_WITHOUT_SHAPES;
        (0..modes).map(|_| stream.random::<f64>() < SHARE_SHAPE_MISSING || without).collect()
    }

    /// Numbers that a flow of `parameters` parameters is told of a best fit; 0 where it does not start there.
    pub fn fixed_context(&self, parameters: usize) -> usize {
        if self.starts_at_fit {
            super::start::features(parameters)
        } else {
            0
        }
    }

    /// Noise multiples and a mask for one simulated measurement: `None` where a mode is missing.
    ///
    /// Without noise, all modes are there and exact: posteriors of fewer exact modes than parameters have no density.
    pub fn draw(&self, modes: usize, stream: &mut Stream) -> Vec<Option<f64>> {
        let Some(range) = &self.noise_range else { return vec![Some(0.0); modes] };
        let level = |stream: &mut Stream| range.lowest * (range.highest / range.lowest).powf(stream.random::<f64>());
        let common = level(stream);
        let mut multiples = vec![Some(common); modes];
        if stream.random::<f64>() >= SHARE_COMMON_NOISE {
            for multiple in &mut multiples {
                *multiple = Some(level(stream));
            }
        }
        if modes > 1 && stream.random::<f64>() >= SHARE_COMPLETE {
            // One missing mode is the common case: half of the incomplete measurements.
            let missing = if stream.random::<bool>() { 1 } else { stream.random_range(1..modes) };
            for _ in 0..missing {
                let mode = stream.random_range(0..modes);
                if multiples.iter().flatten().count() > 1 {
                    multiples[mode] = None;
                }
            }
        }
        multiples
    }
}

/// A simulated measurement of exact frequencies: noise added to the modes that are there.
///
/// ```text
///  f̃_i = f_i + a_i·s_i(f_i)·N(0, 1),    a_i the noise multiple, s_i the structure's own standard deviation
/// ```
pub fn measure(
    simulator: &Simulator,
    exact_hz: &[f64],
    effect_sizes: &[f64],
    multiples: &[Option<f64>],
    stream: &mut Stream,
) -> Observation {
    let one = |(mode, (exact, multiple)): (usize, (&f64, &Option<f64>))| {
        // Drawn for missing modes too: the stream then does not depend on the masks.
        let normal: f64 = stream.sample(StandardNormal);
        let std_hz = simulator.std_hz(mode, *exact);
        // The mirror image of the few draws that would be negative: noise is far smaller than a frequency.
        multiple.map(|multiple| (exact + multiple * std_hz * normal).abs().max(f64::MIN_POSITIVE))
    };
    Observation {
        frequencies_hz: exact_hz.iter().zip(multiples).enumerate().map(one).collect(),
        noise_multiple: multiples.iter().map(|m| m.unwrap_or(1.0)).collect(),
        shapes: Vec::new(),
        effect_sizes: effect_sizes.to_vec(),
        possible_sizes: Vec::new(),
    }
}

/// Gives a simulated measurement the shapes of its modes, with noise; those of `exact` where they are not missing.
///
/// ```text
///  φ̃ = (φ + s·N(0, 1))/|…|,    s: standard deviation of each number of a shape of unit norm
/// ```
pub fn measure_shapes(
    simulator: &Simulator,
    observation: &mut Observation,
    exact: &DMatrix<f64>,
    missing: &[bool],
    stream: &mut Stream,
) {
    let std = simulator.shape_std();
    let one = |(shape, missing): (nalgebra::DVectorView<'_, f64>, &bool)| {
        // Drawn for missing ones too, as above.
        let noisy: Vec<f64> = shape.iter().map(|x| x + std * stream.sample::<f64, _>(StandardNormal)).collect();
        unit_shape(&noisy).filter(|_| !missing)
    };
    observation.shapes = exact.column_iter().zip(missing).map(one).collect();
}

/// Turns observations into the input of the flow.
#[derive(Debug, Clone)]
pub struct Encoder {
    whitening: Whitening,
    conditions: Conditions,
    /// Covariance of ln f over the prior, for the conditional mean of missing modes.
    covariance: DMatrix<f64>,
}

impl Encoder {
    /// The encoder of a manifest.
    pub fn new(whitening: &Whitening, conditions: &Conditions) -> Self {
        let modes = whitening.mean.len();
        let factor = DMatrix::from_fn(modes, modes, |i, j| if j <= i { whitening.factor[i][j] } else { 0.0 });
        let covariance = &factor * factor.transpose();
        Self { whitening: whitening.clone(), conditions: conditions.clone(), covariance }
    }

    /// Input `[n, channels, m]`, f64: whitened log-frequencies; with noise, the position of the noise in its trained
    /// range (logarithmic, −1 to 1) and the mask.
    ///
    /// A missing log-frequency is replaced by its mean given the others, under the normal distribution that has the
    /// moments of the prior: with the mask it holds all that is known.
    ///
    /// # Errors
    /// A candle error, which would be a bug.
    pub fn encode(&self, observations: &[Observation]) -> Result<Tensor, candle_core::Error> {
        let (modes, channels) = (self.whitening.mean.len(), self.conditions.channels());
        let mut values = Vec::with_capacity(observations.len() * channels * modes);
        for observation in observations {
            let logs = self.completed_logs(observation);
            let start = values.len();
            for (i, (log, mean)) in logs.iter().zip(&self.whitening.mean).enumerate() {
                // Forward substitution with the lower triangular factor.
                let known: f64 = (0..i).map(|j| self.whitening.factor[i][j] * values[start + j]).sum();
                values.push((log - mean - known) / self.whitening.factor[i][i]);
            }
            if let Some(range) = &self.conditions.noise_range {
                let present = |mode: usize| observation.frequencies_hz[mode].is_some();
                values.extend((0..modes).map(|mode| {
                    if present(mode) {
                        range.position(observation.noise_multiple[mode])
                    } else {
                        0.0
                    }
                }));
                values.extend((0..modes).map(|mode| if present(mode) { 0.0 } else { 1.0 }));
            }
            for effect in &self.conditions.effects {
                let position = observation.effect_sizes.get(effect.column).map_or(0.0, |size| effect.position(*size));
                values.extend(std::iter::repeat_n(position, modes));
            }
        }
        Tensor::from_vec(values, (observations.len(), channels, modes), &Device::Cpu)
    }

    /// ln f of each mode, missing ones by their conditional mean.
    fn completed_logs(&self, observation: &Observation) -> Vec<f64> {
        let frequencies = &observation.frequencies_hz;
        let mean = &self.whitening.mean;
        let present: Vec<usize> = (0..frequencies.len()).filter(|&i| frequencies[i].is_some()).collect();
        let ln = |mode: usize| frequencies[mode].map_or(mean[mode], f64::ln);
        if present.len() == frequencies.len() || present.is_empty() {
            return (0..frequencies.len()).map(ln).collect();
        }
        let known = DMatrix::from_fn(present.len(), present.len(), |i, j| self.covariance[(present[i], present[j])]);
        let deviation = DVector::from_iterator(present.len(), present.iter().map(|&i| ln(i) - mean[i]));
        let weights = known.cholesky().map_or_else(|| DVector::zeros(present.len()), |c| c.solve(&deviation));
        let conditional = |mode: usize| {
            let shift: f64 = present.iter().zip(&weights).map(|(&i, w)| self.covariance[(mode, i)] * w).sum();
            mean[mode] + shift
        };
        (0..frequencies.len())
            .map(|mode| if frequencies[mode].is_some() { ln(mode) } else { conditional(mode) })
            .collect()
    }
}

impl EffectRange {
    /// Position of a size in the range, −1 at the lowest and 1 at the highest.
    pub fn position(&self, size: f64) -> f64 {
        (2.0 * size - self.lowest - self.highest) / (self.highest - self.lowest)
    }
}

impl NoiseRange {
    /// Position of a multiple in the range, −1 at the lowest and 1 at the highest, by its logarithm.
    pub fn position(&self, multiple: f64) -> f64 {
        2.0 * (multiple / self.lowest).ln() / (self.highest / self.lowest).ln() - 1.0
    }
}
