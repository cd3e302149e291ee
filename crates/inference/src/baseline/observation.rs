//! One measurement as the flow sees it: log-frequencies, their noise level, and a mask of missing modes.

use candle_core::{Device, Tensor};
use nalgebra::{DMatrix, DVector};
use rand::Rng as _;
use rand_distr::StandardNormal;

use super::conditions::{Conditions, NoiseRange, Whitening};
use structures::measurement::shape::unit_shape;
use structures::simulator::Simulator;
use structures::stats::Stream;

/// Default noise range of a trained model, as multiples of the structure's noise.
pub const DEFAULT_NOISE_RANGE: NoiseRange = NoiseRange { lowest: 0.1, highest: 5.0 };

/// Frequencies and mode shapes of one measurement, their noise, and the sizes of the effects at its time.
#[derive(Debug, Clone, PartialEq)]
pub struct Observation {
    /// One entry per mode, Hz; `None` where the mode was not identified. At least one is present.
    pub frequencies_hz: Vec<Option<f64>>,
    /// Standard deviation of each frequency as a multiple of the structure's noise; 1 where the mode is missing.
    pub noise_multiple: Vec<f64>,
    /// Shape of each mode at the instrumented points, of unit norm; `None` where it was not identified. Empty without
    /// shapes.
    pub shapes: Vec<Option<Vec<f64>>>,
    /// Sizes of the structure's effects at the covariates of the measurement; empty where the structure has no effects or
    /// their sizes are unknown.
    pub effect_sizes: Vec<f64>,
    /// Equally probable effect sizes to marginalise over, where a covariate is missing; else empty.
    pub sizes_to_marginalise: Vec<Vec<f64>>,
}

impl Observation {
    /// A measurement of all modes, `frequencies_hz` in Hz, `[m]`, each with the structure's noise.
    pub fn complete(frequencies_hz: &[f64]) -> Self {
        Self {
            frequencies_hz: frequencies_hz.iter().copied().map(Some).collect(),
            noise_multiple: vec![1.0; frequencies_hz.len()],
            shapes: Vec::new(),
            effect_sizes: Vec::new(),
            sizes_to_marginalise: Vec::new(),
        }
    }

    /// Whether the posterior is marginalised over a missing covariate.
    pub fn is_marginalised(&self) -> bool {
        !self.sizes_to_marginalise.is_empty()
    }

    /// This measurement with each of the possible effect sizes.
    pub(super) fn at_each_size(&self) -> Vec<Self> {
        let at =
            |sizes: &Vec<f64>| Self { effect_sizes: sizes.clone(), sizes_to_marginalise: Vec::new(), ..self.clone() };
        self.sizes_to_marginalise.iter().map(at).collect()
    }

    /// The simulation with the effects of this measurement.
    pub fn simulator(&self, simulator: &Simulator) -> Simulator {
        if simulator.effects().is_empty() {
            simulator.clone()
        } else {
            simulator.under(&self.effect_sizes)
        }
    }

    /// Number of modes present.
    pub fn modes_present(&self) -> usize {
        self.frequencies_hz.iter().flatten().count()
    }

    /// Geometric mean of the noise multiples of the modes present.
    pub fn mean_noise_multiple(&self) -> f64 {
        let present = self.frequencies_hz.iter().zip(&self.noise_multiple).filter(|(f, _)| f.is_some());
        (present.map(|(_, multiple)| multiple.ln()).sum::<f64>() / self.modes_present() as f64).exp()
    }

    /// Shape of mode `mode` (counted from 0) at the instrumented points, of unit norm, `[points]`; `None` unless both the mode
    /// and its shape were identified.
    pub fn shape(&self, mode: usize) -> Option<&[f64]> {
        self.frequencies_hz[mode]?;
        self.shapes.get(mode)?.as_deref()
    }

    /// Whether at least one mode has a shape.
    pub fn has_shapes(&self) -> bool {
        (0..self.frequencies_hz.len()).any(|mode| self.shape(mode).is_some())
    }

    /// Standard deviation of the measured frequency of mode `mode` (counted from 0), Hz; `None` where it is missing.
    pub fn std_hz(&self, simulator: &Simulator, mode: usize) -> Option<f64> {
        Some(simulator.std_hz(mode, self.frequencies_hz[mode]?) * self.noise_multiple[mode])
    }
}

/// Simulates a measurement: adds noise to the exact frequencies of the modes that are present.
///
/// ```text
///  f̃_i = f_i + a_i·s_i(f_i)·N(0, 1),    a_i the noise multiple, s_i the standard deviation of the structure's noise, Hz
/// ```
///
/// `exact_hz`: frequencies without noise, Hz, `[m]`; `multiples`: noise multiple of each mode, `[m]`, `None` for a missing mode;
/// `effect_sizes`: sizes of all effects in the units of their targets, `[sizes]`.
pub fn measure(
    simulator: &Simulator,
    exact_hz: &[f64],
    effect_sizes: &[f64],
    multiples: &[Option<f64>],
    stream: &mut Stream,
) -> Observation {
    let one = |(mode, (exact, multiple)): (usize, (&f64, &Option<f64>))| {
        // Drawn for missing modes too, so that the stream does not depend on the mask.
        let normal: f64 = stream.sample(StandardNormal);
        let std_hz = simulator.std_hz(mode, *exact);
        // The few negative draws are reflected: noise is far smaller than a frequency.
        multiple.map(|multiple| (exact + multiple * std_hz * normal).abs().max(f64::MIN_POSITIVE))
    };
    Observation {
        frequencies_hz: exact_hz.iter().zip(multiples).enumerate().map(one).collect(),
        noise_multiple: multiples.iter().map(|m| m.unwrap_or(1.0)).collect(),
        shapes: Vec::new(),
        effect_sizes: effect_sizes.to_vec(),
        sizes_to_marginalise: Vec::new(),
    }
}

/// Adds noisy mode shapes to a simulated measurement. `exact`: shapes without noise, `[points, m]`, columns of unit norm;
/// `missing`: whether each shape is missing, `[m]`.
///
/// ```text
///  φ̃ = (φ + s·N(0, 1))/|…|,    s: standard deviation of each component of a shape of unit norm
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
        // Drawn for missing shapes too, as above.
        let noisy: Vec<f64> = shape.iter().map(|x| x + std * stream.sample::<f64, _>(StandardNormal)).collect();
        unit_shape(&noisy).filter(|_| !missing)
    };
    observation.shapes = exact.column_iter().zip(missing).map(one).collect();
}

/// Converts observations to the input of the flow.
#[derive(Debug, Clone)]
pub struct Encoder {
    whitening: Whitening,
    conditions: Conditions,
    /// Covariance of ln f over the prior, `[m, m]`, for the conditional mean of missing modes.
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

    /// Input of the flow, f64 `[n, channels, m]`. The channels are: the whitened log-frequencies; with noise, the position
    /// of the noise in its trained range (logarithmic, −1 to 1) and the mask (1 for a missing mode); the position of each
    /// effect's size in its trained range (−1 to 1).
    ///
    /// A missing log-frequency is replaced by its conditional mean given the others, under the normal distribution with the
    /// moments of the prior. Together with the mask this loses no information.
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
            for position in self.conditions.effect_positions(&observation.effect_sizes) {
                values.extend(std::iter::repeat_n(position, modes));
            }
        }
        Tensor::from_vec(values, (observations.len(), channels, modes), &Device::Cpu)
    }

    /// ln f of each mode, with the conditional mean for missing modes.
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
