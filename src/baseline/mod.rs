//! A trained baseline: the flow of one structure, with everything needed to use it and to trust it.

pub mod library;
pub mod manifest;
pub mod reach;
pub mod train;

use candle_core::{DType, Device, Tensor};
use nalgebra::{DMatrix, DVector};
use rand::RngCore as _;

use crate::flow::{checkpoint, Flow};
use crate::parameter::ParameterSpace;
use crate::posterior::PosteriorSamples;
use crate::quantity::Digest;
use crate::simulator::Simulator;
use crate::stats;
use manifest::{Manifest, SelfTest, Whitening};

/// Largest difference of a self-test draw, as a share of the prior's width: f32 kernels differ between processors by
/// some 1e-5, a wrong weight by far more.
const SELF_TEST_TOLERANCE: f64 = 1e-3;

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
    /// A tensor error.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}

/// A flow with its standardisers, its structure and its record.
pub struct Baseline {
    flow: Flow,
    whitening: Whitening,
    simulator: Simulator,
    manifest: Manifest,
    digest: Digest,
}

impl Baseline {
    /// Reads a stored baseline and runs its self-test.
    ///
    /// # Errors
    /// [`LoadError`], one variant for each way it can be wrong.
    pub fn load(manifest_bytes: &[u8], weights: &[u8], simulator: &Simulator) -> Result<Self, LoadError> {
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
        let (d, m) = (simulator.space().len(), simulator.modes());
        let shapes = [
            ("architecture.parameters", manifest.architecture.parameters, d),
            ("architecture.modes", manifest.architecture.modes, m),
            ("architecture.channels", manifest.architecture.channels, 1),
            ("architecture.permutations", manifest.architecture.permutations.len(), manifest.architecture.units),
            ("whitening.mean", manifest.whitening.mean.len(), m),
            ("whitening.factor", manifest.whitening.factor.len(), m),
            ("self_test.frequencies_hz", manifest.self_test.frequencies_hz.len(), m),
        ];
        if let Some(&(what, found, expected)) = shapes.iter().find(|(_, found, expected)| found != expected) {
            return Err(LoadError::Shape { what, found, expected });
        }
        let flow = checkpoint::from_bytes(weights, &manifest.architecture, DType::F32)?;
        let baseline = Self {
            flow,
            whitening: manifest.whitening.clone(),
            simulator: simulator.clone(),
            digest: Digest::of_file(manifest_bytes),
            manifest,
        };
        baseline.self_test()?;
        Ok(baseline)
    }

    /// Posterior samples of each measurement, `draws` for each.
    ///
    /// `frequencies_hz`: complete measurements, m values each, Hz, positive.
    ///
    /// # Errors
    /// [`InferenceError`] for another number of modes or a draw that is not finite.
    pub fn infer(
        &self,
        frequencies_hz: &[Vec<f64>],
        draws: usize,
        seed: u64,
    ) -> Result<PosteriorSamples, InferenceError> {
        let y = self.condition(frequencies_hz)?;
        let x = self.flow.sample(&y, draws, &mut stats::stream(seed, "latent"))?;
        let real = x.to_dtype(DType::F64)?.to_vec2::<f64>()?;
        let space = self.space();
        let theta = DMatrix::from_fn(real.len(), space.len(), |row, column| {
            space.as_slice()[column].from_unit(logistic(real[row][column]))
        });
        if let Some(place) = theta.iter().position(|v| !v.is_finite()) {
            let parameter = space.as_slice()[place / theta.nrows()].name.clone();
            return Err(InferenceError::NotFinite { row: place % theta.nrows(), parameter });
        }
        Ok(PosteriorSamples::new(theta, draws))
    }

    /// Log-density of each row of `theta` given the frequencies of the same row, in the unit box, nats.
    ///
    /// ```text
    ///  log q(u | y) = log q(ℓ | y) − Σ log(u(1 − u)),    ℓ = logit u,    u = (θ − lower)/(upper − lower)
    /// ```
    ///
    /// `theta`: `[n, d]` inside the prior box; `frequencies_hz`: n rows of m values.
    ///
    /// # Errors
    /// [`InferenceError`] for another number of modes.
    pub fn log_density_unit_box(
        &self,
        theta: &DMatrix<f64>,
        frequencies_hz: &[Vec<f64>],
    ) -> Result<Vec<f64>, InferenceError> {
        let x = to_real_line(theta, self.space())?.to_dtype(self.flow.dtype())?;
        let log_q = self.flow.log_prob(&x, &self.condition(frequencies_hz)?)?.to_dtype(DType::F64)?.to_vec1::<f64>()?;
        let jacobian = |row: usize| -> f64 {
            let unit = |(column, p): (usize, &crate::parameter::Parameter)| p.to_unit(theta[(row, column)]);
            self.space().iter().enumerate().map(unit).map(|u| (u * (1.0 - u)).ln()).sum()
        };
        Ok(log_q.iter().enumerate().map(|(row, log_q)| log_q - jacobian(row)).collect())
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

    /// SHA-256 of the manifest file, which holds that of the weights: the name of this baseline in every result.
    pub fn digest(&self) -> &Digest {
        &self.digest
    }

    fn condition(&self, frequencies_hz: &[Vec<f64>]) -> Result<Tensor, InferenceError> {
        let modes = self.simulator.modes();
        if let Some(row) = frequencies_hz.iter().find(|row| row.len() != modes) {
            return Err(InferenceError::Modes { found: row.len(), expected: modes });
        }
        Ok(self.whitening.apply(frequencies_hz)?.to_dtype(self.flow.dtype())?)
    }

    fn self_test(&self) -> Result<(), LoadError> {
        let SelfTest { frequencies_hz, seed, expected } = &self.manifest.self_test;
        let samples = self.infer(std::slice::from_ref(frequencies_hz), expected.len().max(1), *seed)?;
        let width = |column: usize| self.space().as_slice()[column].upper - self.space().as_slice()[column].lower;
        let mut difference = 0.0_f64;
        for (row, values) in expected.iter().enumerate() {
            if values.len() != self.space().len() {
                let (found, expected) = (values.len(), self.space().len());
                return Err(LoadError::Shape { what: "self_test.expected", found, expected });
            }
            for (column, value) in values.iter().enumerate() {
                difference = difference.max((samples.theta()[(row, column)] - value).abs() / width(column));
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

/// Seed of the draws for a batch: the same data and baseline always give the same draws.
pub fn assessment_seed(content: &Digest, baseline: &Digest) -> u64 {
    stats::stream(0, &format!("assessment:{content}:{baseline}")).next_u64()
}

/// The logistic function, inverse of the logit.
fn logistic(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// θ of the prior box to the real line by the logit of its position, f64 `[n, d]`.
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

    /// Whitened log-frequencies `[n, 1, m]`, f64.
    fn apply(&self, frequencies_hz: &[Vec<f64>]) -> Result<Tensor, candle_core::Error> {
        let modes = self.mean.len();
        let mut values = Vec::with_capacity(frequencies_hz.len() * modes);
        for row in frequencies_hz {
            let start = values.len();
            for (i, frequency) in row.iter().enumerate() {
                // Forward substitution with the lower triangular factor.
                let known: f64 = (0..i).map(|j| self.factor[i][j] * values[start + j]).sum();
                values.push((frequency.ln() - self.mean[i] - known) / self.factor[i][i]);
            }
        }
        Tensor::from_vec(values, (frequencies_hz.len(), 1, modes), &Device::Cpu)
    }
}
