//! Reading a stored model and checking it.

use candle_core::DType;

use super::conditions::fit_features;
use super::error::{LoadError, SELF_TEST_TOLERANCE};
use super::manifest::{Manifest, SelfTest, FORMAT};
use super::model::Baseline;
use super::observation::Observation;
use crate::flow::checkpoint;
use structures::quantity::Digest;
use structures::simulator::Simulator;

impl Baseline {
    /// Reads a stored model from the contents of its manifest (JSON) and of its weight file (safetensors), and runs its
    /// self-test. `simulator` is the structure that the model must have been trained for.
    ///
    /// # Errors
    /// [`LoadError`], with one variant for each way in which the files can be wrong.
    pub fn load(manifest_bytes: &[u8], weights: &[u8], simulator: &Simulator) -> Result<Self, LoadError> {
        let manifest: Manifest = serde_json::from_slice(manifest_bytes)?;
        if manifest.format != FORMAT {
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
        let scales = manifest.spread.iter().flat_map(|cell| &cell.scales);
        if let Some(scale) = scales.copied().find(|scale| !(*scale > 0.0 && scale.is_finite())) {
            return Err(LoadError::Spread(scale));
        }
        let flow = checkpoint::from_bytes(weights, &manifest.architecture, DType::F32)?;
        let digest = Digest::of_file(manifest_bytes);
        let baseline = Self::new(flow, simulator, manifest, digest).map_err(checkpoint::Error::from)?;
        baseline.self_test()?;
        Ok(baseline)
    }

    /// Draws the posterior of a stored measurement with a stored seed and compares the draws with the stored ones.
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
        // Not `>`: NaN must fail too.
        if difference <= SELF_TEST_TOLERANCE && !expected.is_empty() {
            Ok(())
        } else {
            Err(LoadError::SelfTest { difference })
        }
    }
}

/// Every list of a manifest whose length depends on the structure: its name, its length, and the required length.
fn lengths(manifest: &Manifest, simulator: &Simulator) -> Vec<(&'static str, usize, usize)> {
    let (d, m) = (simulator.space().len(), simulator.modes());
    let Manifest { architecture, conditions, whitening, self_test, calibration, spread, .. } = manifest;
    // Earlier versions of this program trained flows that start at the best fit without the sizes of the effects as inputs.
    let before_effects = conditions.starts_at_fit && architecture.fixed_context == fit_features(d);
    let fixed_context = if before_effects { fit_features(d) } else { conditions.fixed_context(d) };
    let mut all = vec![
        ("architecture.parameters", architecture.parameters, d),
        ("architecture.modes", architecture.modes, m),
        ("architecture.channels", architecture.channels, conditions.channels()),
        ("architecture.permutations", architecture.permutations.len(), architecture.units),
        ("architecture.fixed_context", architecture.fixed_context, fixed_context),
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
    all.extend(spread.iter().map(|cell| ("scales of spread", cell.scales.len(), d)));
    all
}
