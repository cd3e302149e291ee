//! Layout of all weights in the single vector that the optimiser works on.

use std::collections::BTreeMap;
use std::ops::Range;

use candle_core::{Device, Result, Tensor};
use faer::MatRef;

use crate::flow::kernel::Layer;
use crate::flow::weights::Weights;

/// Range of each weight, by name. The weights follow each other in alphabetical order.
pub(super) struct Layout {
    ranges: BTreeMap<String, Range<usize>>,
}

/// Ranges of the weight and bias of a dense layer in the vector of all weights.
#[derive(Clone)]
pub(super) struct DenseWeights {
    pub weight: Range<usize>,
    pub bias: Range<usize>,
    pub inputs: usize,
    pub outputs: usize,
}

impl Layout {
    /// The layout of `weights`, and the vector of their values.
    pub(super) fn read(weights: &Weights) -> Result<(Self, Vec<f32>)> {
        let mut values = Vec::new();
        let mut ranges = BTreeMap::new();
        for (name, var) in weights {
            let start = values.len();
            values.extend(var.flatten_all()?.to_vec1::<f32>()?);
            ranges.insert(name.clone(), start..values.len());
        }
        Ok((Self { ranges }, values))
    }

    /// Writes these values to `weights`.
    pub(super) fn write(&self, values: &[f32], weights: &Weights) -> Result<()> {
        for (name, range) in &self.ranges {
            let var = &weights[name];
            var.set(&Tensor::from_slice(&values[range.clone()], var.shape().clone(), &Device::Cpu)?)?;
        }
        Ok(())
    }

    /// The layer `name`, which must exist.
    pub(super) fn dense(&self, name: &str) -> DenseWeights {
        let [weight, bias] = ["weight", "bias"].map(|part| self.ranges[&format!("{name}.{part}")].clone());
        DenseWeights { inputs: weight.len() / bias.len(), outputs: bias.len(), weight, bias }
    }
}

impl DenseWeights {
    /// The layer in `values`, the vector of all weights.
    pub(super) fn layer<'a>(&self, values: &'a [f32]) -> Layer<'a> {
        // Row-major, as in candle's tensors and in the weight files.
        let weight = MatRef::from_row_major_slice(&values[self.weight.clone()], self.outputs, self.inputs);
        Layer { weight, bias: &values[self.bias.clone()] }
    }
}
