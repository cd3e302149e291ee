//! Writing and reading weights in the safetensors format.

use std::collections::HashMap;

use candle_core::{DType, Device, Tensor};
use candle_nn::VarBuilder;
use safetensors::{Dtype, SafeTensors, View};

use super::architecture::Architecture;
use super::model::Flow;
use super::weights::{untrained_flow, Weights};

/// Largest weight file that is accepted, bytes. A larger file is refused before it fills the memory.
pub const LARGEST_FILE_BYTES: usize = 256 << 20;

/// Why a weight file is refused.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file is not in the safetensors format, or is truncated.
    #[error("not a complete safetensors file: {0}")]
    Format(#[from] safetensors::SafeTensorError),
    /// The file is larger than any weight file.
    #[error("the file has {bytes} bytes, more than the {LARGEST_FILE_BYTES} that are accepted")]
    TooLarge {
        /// Size of the file.
        bytes: usize,
    },
    /// A weight is not stored as f32.
    #[error("weight {name} is stored as {found:?}, expected F32")]
    Precision {
        /// Name of the weight.
        name: String,
        /// Type found.
        found: Dtype,
    },
    /// A weight contains NaN or an infinite value.
    #[error("weight {name} has a value that is not finite at index {index}")]
    NotFinite {
        /// Name of the weight.
        name: String,
        /// Index in row-major order.
        index: usize,
    },
    /// The architecture has no weight of this name.
    #[error("weight {name} does not belong to this architecture")]
    Foreign {
        /// Name of the weight.
        name: String,
    },
    /// A weight is missing or has the wrong shape.
    #[error("the weights do not fit the architecture: {0}")]
    Misfit(#[from] candle_core::Error),
}

/// The contents of a safetensors file with the weights, f32. Equal weights give equal bytes.
///
/// # Errors
/// [`Error::Format`], which would be a bug.
pub fn to_bytes(weights: &Weights) -> Result<Vec<u8>, Error> {
    let views = weights.iter().map(|(name, var)| {
        let flat = var.as_tensor().flatten_all()?.to_dtype(DType::F32)?.to_vec1::<f32>()?;
        let bytes = flat.iter().flat_map(|v| v.to_le_bytes()).collect();
        Ok((name.as_str(), FloatView { shape: var.dims().to_vec(), bytes }))
    });
    let views = views.collect::<Result<Vec<_>, candle_core::Error>>()?;
    Ok(safetensors::serialize(views, None)?)
}

/// Reads a flow from `bytes`, the contents of a safetensors file with f32 weights, and converts the weights to `dtype`.
///
/// # Errors
/// [`Error`], with one variant for each way a file can be wrong: truncated, of another architecture, not finite.
pub fn from_bytes(bytes: &[u8], architecture: &Architecture, dtype: DType) -> Result<Flow, Error> {
    if bytes.len() > LARGEST_FILE_BYTES {
        return Err(Error::TooLarge { bytes: bytes.len() });
    }
    let file = SafeTensors::deserialize(bytes)?;
    let mut tensors = HashMap::new();
    for (name, view) in file.tensors() {
        if view.dtype() != Dtype::F32 {
            return Err(Error::Precision { name, found: view.dtype() });
        }
        let values: Vec<f32> =
            view.data().chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
        if let Some(index) = values.iter().position(|v| !v.is_finite()) {
            return Err(Error::NotFinite { name, index });
        }
        tensors.insert(name, Tensor::from_vec(values, view.shape(), &Device::Cpu)?.to_dtype(dtype)?);
    }
    let names: Vec<String> = tensors.keys().cloned().collect();
    // The flow is built from the file first: a damaged architecture of enormous size fails here, before its weights are
    // drawn.
    let flow = Flow::new(architecture, &VarBuilder::from_tensors(tensors, dtype, &Device::Cpu))?;
    let (_, expected) = untrained_flow(architecture, DType::F32, 0)?;
    if let Some(name) = names.into_iter().find(|name| !expected.contains_key(name)) {
        return Err(Error::Foreign { name });
    }
    Ok(flow)
}

/// Shape and bytes of one tensor, for the writer.
struct FloatView {
    shape: Vec<usize>,
    bytes: Vec<u8>,
}

impl View for FloatView {
    fn dtype(&self) -> Dtype {
        Dtype::F32
    }

    fn shape(&self) -> &[usize] {
        &self.shape
    }

    fn data(&self) -> std::borrow::Cow<'_, [u8]> {
        (&self.bytes).into()
    }

    fn data_len(&self) -> usize {
        self.bytes.len()
    }
}
