//! What a trained model is conditioned on: its training box, the noise range, the covariate effects, and the
//! standardisation of the frequencies.

use nalgebra::{DMatrix, DVector};
use rand::Rng as _;
use serde::{Deserialize, Serialize};

use structures::parameter::{Parameter, ParameterSpace};
use structures::stats::Stream;

/// Share of the training measurements in which no mode is missing.
const SHARE_COMPLETE: f64 = 0.6;
/// Share of the training measurements without any mode shape, for a structure with instrumented points.
const SHARE_WITHOUT_SHAPES: f64 = 0.2;
/// Probability that a single shape is missing in the other training measurements.
const SHARE_SHAPE_MISSING: f64 = 0.02;
/// Share of the training measurements whose modes all have the same noise multiple.
const SHARE_COMMON_NOISE: f64 = 0.6;

/// Standard deviation of ln f over the prior below which a frequency does not vary: differences are rounding errors, or as good as none.
const LEAST_VARIATION: f64 = 1e-6;

/// Mean and Cholesky factor of the log-frequencies (ln Hz) over the training set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Whitening {
    /// Mean of ln f, one entry per mode.
    pub mean: Vec<f64>,
    /// Lower triangular factor L of the covariance, row by row.
    pub factor: Vec<Vec<f64>>,
}

/// What the flow is conditioned on besides the frequencies.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Conditions {
    /// Lower and upper end of the training box, one pair per parameter, in parameter units: a uniform prior with a margin. Draws
    /// outside the prior are rejected and drawn again.
    pub training_box: Vec<[f64; 2]>,
    /// Noise of the frequencies; `None` for a structure without noise, whose measurements must be complete and exact.
    pub noise_range: Option<NoiseRange>,
    /// Whether the flow starts at the best fit of each measurement, see `baseline::start`.
    #[serde(default, skip_serializing_if = "is_false")]
    pub starts_at_fit: bool,
    /// Effects that vary with a covariate. Their sizes are inputs of the flow.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub effects: Vec<EffectRange>,
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "serde hands over a reference")]
fn is_false(value: &bool) -> bool {
    !value
}

/// Range of sizes of one effect in the training set.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct EffectRange {
    /// Index among the sizes of all effects of the structure.
    pub column: usize,
    /// Smallest size.
    pub lowest: f64,
    /// Largest size.
    pub highest: f64,
}

/// Range of noise that a flow was trained for, as multiples of the structure's noise. Modes may be missing.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct NoiseRange {
    /// Smallest multiple. A measurement with less noise is treated as if it had this much.
    pub lowest: f64,
    /// Largest multiple. A mode with more noise is treated as missing.
    pub highest: f64,
}

impl Conditions {
    /// Number of inputs of the flow for each mode: the whitened log-frequency; with noise also the noise level and the
    /// mask; and the size of each effect that varies with a covariate.
    pub fn channels(&self) -> usize {
        let own = if self.noise_range.is_some() { 3 } else { 1 };
        own + self.effects.len()
    }

    /// Number of inputs of the flow for each measurement where it starts at the best fit: the features of the fit, and the size of
    /// each effect that varies with a covariate; 0 where it does not start there.
    pub fn fixed_context(&self, parameters: usize) -> usize {
        if self.starts_at_fit {
            fit_features(parameters) + self.effects.len()
        } else {
            0
        }
    }

    /// Position of the size of each effect in its range, from the sizes of all effects of a measurement, `[sizes]`; 0 where they are
    /// unknown.
    pub(super) fn effect_positions<'a>(&'a self, sizes: &'a [f64]) -> impl Iterator<Item = f64> + 'a {
        self.effects.iter().map(|effect| sizes.get(effect.column).map_or(0.0, |size| effect.position(*size)))
    }

    /// The box that the flow was trained in: the parameters of `prior` with the limits of the training box.
    pub(super) fn training_space(&self, prior: &ParameterSpace) -> ParameterSpace {
        let wide =
            |(p, [lower, upper]): (&Parameter, &[f64; 2])| Parameter { lower: *lower, upper: *upper, ..p.clone() };
        ParameterSpace::new(prior.iter().zip(&self.training_box).map(wide).collect())
    }

    /// Draws which shapes of one simulated measurement are missing, one entry per mode.
    pub fn draw_shapes(modes: usize, stream: &mut Stream) -> Vec<bool> {
        let without = stream.random::<f64>() < SHARE_WITHOUT_SHAPES;
        (0..modes).map(|_| stream.random::<f64>() < SHARE_SHAPE_MISSING || without).collect()
    }

    /// Draws the noise multiple of each mode of one simulated measurement; `None` where the mode is missing.
    ///
    /// Without a noise range all modes are present and exact: the posterior given fewer exact modes than parameters has no
    /// density.
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
            // One missing mode is the usual case: half of the incomplete measurements.
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

/// Number of features that describe the best fit of a measurement to a structure with `parameters` parameters: position and
/// standard deviation of each, and the misfit.
pub(super) fn fit_features(parameters: usize) -> usize {
    2 * parameters + 1
}

impl EffectRange {
    /// Position of a size in the range, −1 at the lowest and 1 at the highest.
    pub fn position(&self, size: f64) -> f64 {
        (2.0 * size - self.lowest - self.highest) / (self.highest - self.lowest)
    }
}

impl NoiseRange {
    /// Position of a noise multiple in the range on a logarithmic scale, −1 at the lowest and 1 at the highest.
    pub fn position(&self, multiple: f64) -> f64 {
        2.0 * (multiple / self.lowest).ln() / (self.highest / self.lowest).ln() - 1.0
    }
}

impl Whitening {
    /// Fits the whitening of log-frequencies by their full covariance over the training set. `frequencies_hz`: one row per
    /// sample, one entry per mode; `relative_noise`: standard deviation of the noise of ln f, one entry per mode.
    ///
    /// ```text
    ///  w = L⁻¹ (ln f − mean),    L Lᵀ = Σ, the covariance of ln f, or Σ + diag(noise²)
    /// ```
    ///
    /// The noise is added where Σ leaves a frequency, given those before it, less than a tenth of its noise, as where frequencies vary in
    /// proportion or one does not vary: w would be little but noise, many times as large as everything else.
    ///
    /// `None` where no frequency varies over the prior.
    pub(super) fn fit(frequencies_hz: &[Vec<f64>], relative_noise: &[f64]) -> Option<Self> {
        let modes = frequencies_hz.first()?.len();
        let logs: Vec<DVector<f64>> =
            frequencies_hz.iter().map(|row| DVector::from_iterator(modes, row.iter().map(|f| f.ln()))).collect();
        let count = logs.len() as f64;
        let mean = logs.iter().fold(DVector::zeros(modes), |sum, row| sum + row) / count;
        let covariance = logs.iter().fold(DMatrix::zeros(modes, modes), |sum, row| {
            let deviation = row - &mean;
            sum + &deviation * deviation.transpose() / count
        });
        if covariance.diagonal().iter().all(|variance| *variance < LEAST_VARIATION * LEAST_VARIATION) {
            return None;
        }
        let is_wide = |factor: &DMatrix<f64>| {
            relative_noise.iter().enumerate().all(|(i, noise)| factor[(i, i)] > LEAST_VARIATION.max(0.1 * noise))
        };
        let noise = relative_noise.iter().map(|noise| noise.max(LEAST_VARIATION).powi(2));
        let noisy = &covariance + DMatrix::from_diagonal(&DVector::from_iterator(modes, noise));
        let of_frequencies = covariance.cholesky().map(|cholesky| cholesky.l()).filter(is_wide);
        let factor = of_frequencies.or_else(|| Some(noisy.cholesky()?.l()))?;
        let rows = (0..modes).map(|i| factor.row(i).iter().copied().collect()).collect();
        Some(Self { mean: mean.iter().copied().collect(), factor: rows })
    }
}
