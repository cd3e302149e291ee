//! Initial weights of a flow, drawn from seeded streams.

use std::collections::BTreeMap;
use std::sync::Mutex;

use candle_core::{DType, Device, Result, Shape, Tensor, Var};
use candle_nn::init::NormalOrUniform;
use candle_nn::var_builder::SimpleBackend;
use candle_nn::{Init, VarBuilder};
use rand::Rng as _;
use rand_distr::StandardNormal;

use super::architecture::Architecture;
use super::model::Flow;
use structures::stats;

/// The trainable weights of a flow by name, in alphabetical order.
pub type Weights = BTreeMap<String, Var>;

/// Draws the weights that a flow requests and keeps them as variables. Each weight has its own random stream, named after
/// it.
///
/// candle's generator cannot be seeded on the CPU (0.11). Separate streams make the weights independent of the order in
/// which the layers are built.
pub struct SeededWeights<'a> {
    seed: u64,
    drawn: &'a Mutex<Weights>,
}

/// A new flow with weights drawn from `seed`, and these weights as variables.
///
/// # Errors
/// A candle error, which would be a bug: all shapes come from `architecture`.
pub fn untrained_flow(architecture: &Architecture, dtype: DType, seed: u64) -> Result<(Flow, Weights)> {
    let drawn = Mutex::new(Weights::new());
    let flow = {
        let backend: Box<dyn SimpleBackend> = Box::new(SeededWeights { seed, drawn: &drawn });
        Flow::new(architecture, &VarBuilder::from_backend(backend, dtype, Device::Cpu))?
    };
    Ok((flow, drawn.into_inner().expect("no thread panicked while drawing weights")))
}

impl SimpleBackend for SeededWeights<'_> {
    fn get(&self, shape: Shape, name: &str, init: Init, dtype: DType, device: &Device) -> Result<Tensor> {
        let mut stream = stats::stream(self.seed, &format!("weights:{name}"));
        let mut draw = |init: &Init| -> f64 {
            match *init {
                Init::Const(value) => value,
                Init::Uniform { lo, up } => stream.random_range(lo..up),
                Init::Randn { mean, stdev } => mean + stdev * stream.sample::<f64, _>(StandardNormal),
                Init::Kaiming { dist, fan, non_linearity } => {
                    let std = non_linearity.gain() / (fan.for_shape(&shape) as f64).sqrt();
                    match dist {
                        NormalOrUniform::Normal => std * stream.sample::<f64, _>(StandardNormal),
                        NormalOrUniform::Uniform => {
                            let bound = 3.0_f64.sqrt() * std;
                            stream.random_range(-bound..bound)
                        }
                    }
                }
            }
        };
        let values: Vec<f64> = (0..shape.elem_count()).map(|_| draw(&init)).collect();
        let var = Var::from_tensor(&Tensor::from_vec(values, shape.clone(), device)?.to_dtype(dtype)?)?;
        let tensor = var.as_tensor().clone();
        self.drawn.lock().expect("no thread panicked while drawing weights").insert(name.to_owned(), var);
        Ok(tensor)
    }

    fn get_unchecked(&self, name: &str, _: DType, _: &Device) -> Result<Tensor> {
        let drawn = self.drawn.lock().expect("no thread panicked while drawing weights");
        let found = drawn.get(name).map(|var| var.as_tensor().clone());
        found.ok_or_else(|| candle_core::Error::CannotFindTensor { path: name.to_owned() })
    }

    fn contains_tensor(&self, name: &str) -> bool {
        self.drawn.lock().expect("no thread panicked while drawing weights").contains_key(name)
    }
}
