//! Where each weight lies in the one long vector that the optimiser works on.

use std::collections::BTreeMap;
use std::ops::Range;

use candle_core::{Device, Result, Tensor};
use faer::MatRef;

use crate::flow::kernel::Layer;
use crate::flow::weights::Weights;

/// Places of all weights by name, one after another in alphabetical order.
pub(super) struct Layout {
    places: BTreeMap<String, Range<usize>>,
}

/// A dense layer in the long vector.
#[derive(Clone)]
pub(super) struct Place {
    pub weight: Range<usize>,
    pub bias: Range<usize>,
    pub inputs: usize,
    pub outputs: usize,
}

impl Layout {
    /// The layout of `weights`, and their values in it.
    pub(super) fn read(weights: &Weights) -> Result<(Self, Vec<f32>)> {
        let mut values = Vec::new();
        let mut places = BTreeMap::new();
        for (name, var) in weights {
            let start = values.len();
            values.extend(var.flatten_all()?.to_vec1::<f32>()?);
            places.insert(name.clone(), start..values.len());
        }
        Ok((Self { places }, values))
    }

    /// Gives `weights` these values.
    pub(super) fn write(&self, values: &[f32], weights: &Weights) -> Result<()> {
        for (name, place) in &self.places {
            let var = &weights[name];
            var.set(&Tensor::from_slice(&values[place.clone()], var.shape().clone(), &Device::Cpu)?)?;
        }
        Ok(())
    }

    /// The layer `name`, which must be there.
    pub(super) fn place(&self, name: &str) -> Place {
        let [weight, bias] = ["weight", "bias"].map(|part| self.places[&format!("{name}.{part}")].clone());
        Place { inputs: weight.len() / bias.len(), outputs: bias.len(), weight, bias }
    }
}

impl Place {
    pub(super) fn layer<'a>(&self, values: &'a [f32]) -> Layer<'a> {
        // As in candle's tensors and in the weight files.
        let weight = MatRef::from_row_major_slice(&values[self.weight.clone()], self.outputs, self.inputs);
        Layer { weight, bias: &values[self.bias.clone()] }
    }
}
