//! A flow with further inputs that takes over the weights of a trained flow.

use candle_core::{bail, Device, Result, Tensor};

use super::architecture::Architecture;
use super::context::KERNEL;
use super::model::Flow;
use super::weights::{untrained_flow, Weights};

/// A flow of the sizes `architecture` with the weights of `parent`, and these weights as variables.
///
/// `inputs` holds one entry for each channel of the observation (without a context network: for each entry of the fixed
/// context): the index of the same input of the parent, or `None` for a new input, whose weights are 0:
///
/// ```text
///  [W 0] [u; v] = W u,    u: inputs of the parent,  v: new inputs
/// ```
///
/// Until it is trained, the flow has the density of its parent, whatever the values of the new inputs. The gradient with
/// respect to the new weights is not 0, because the layers that follow are trained.
///
/// # Errors
/// A candle error when the architectures differ in more than their inputs, or when an input of the parent is left out or taken
/// twice: a bug in the caller.
pub fn inherited_flow(parent: &Flow, architecture: &Architecture, inputs: &[Option<usize>]) -> Result<(Flow, Weights)> {
    let own = parent.architecture();
    let like_parent =
        Architecture { channels: own.channels, fixed_context: own.fixed_context, ..architecture.clone() } == *own;
    if !like_parent || (own.fixed_context == 0) != (architecture.fixed_context == 0) {
        bail!("the flow and its parent differ in more than their inputs");
    }
    if inputs.len() != count(architecture) {
        bail!("{} inputs are described, but the flow has {}", inputs.len(), count(architecture));
    }
    let mut taken: Vec<usize> = inputs.iter().flatten().copied().collect();
    taken.sort_unstable();
    if taken != (0..count(own)).collect::<Vec<_>>() {
        bail!("each of the {} inputs of the parent must be taken over once, found {taken:?}", count(own));
    }

    // Every weight is replaced below, so that the seed has no influence.
    let (flow, weights) = untrained_flow(architecture, parent.dtype(), 0)?;
    for (name, layer) in parent.layers() {
        let (_, width) = layer.weight().dims2()?;
        let columns = if name == "context.conv1" {
            windows(inputs, own.channels)
        } else if name.rsplit('.').next() == Some("input") {
            shortcut(inputs, width, own)
        } else {
            (0..width).map(Some).collect()
        };
        weights[&format!("{name}.weight")].set(&with_columns(layer.weight(), &columns)?)?;
        weights[&format!("{name}.bias")].set(layer.bias())?;
    }
    Ok((flow, weights))
}

/// Number of inputs of a flow: channels of the observation, or entries of the fixed context.
fn count(architecture: &Architecture) -> usize {
    if architecture.fixed_context > 0 {
        architecture.fixed_context
    } else {
        architecture.channels
    }
}

/// Columns of the first convolution, whose input has all channels of one mode after those of another.
fn windows(inputs: &[Option<usize>], channels_of_parent: usize) -> Vec<Option<usize>> {
    (0..KERNEL).flat_map(|k| inputs.iter().map(move |input| input.map(|c| k * channels_of_parent + c))).collect()
}

/// Columns of the first layer of a subnet, whose input ends with the flattened observation; `width`: its number of inputs in
/// the parent.
fn shortcut(inputs: &[Option<usize>], width: usize, parent: &Architecture) -> Vec<Option<usize>> {
    let each = if parent.fixed_context > 0 { 1 } else { parent.modes };
    let before = width - count(parent) * each;
    let observed = inputs.iter().flat_map(|input| (0..each).map(move |mode| input.map(|c| before + c * each + mode)));
    (0..before).map(Some).chain(observed).collect()
}

/// The columns of `weight` `[outputs, inputs]` in the order of `columns`; zeros for `None`.
fn with_columns(weight: &Tensor, columns: &[Option<usize>]) -> Result<Tensor> {
    let (outputs, inputs) = weight.dims2()?;
    let zeros = Tensor::zeros((outputs, 1), weight.dtype(), weight.device())?;
    let from: Vec<u32> = columns.iter().map(|column| column.unwrap_or(inputs) as u32).collect();
    Tensor::cat(&[weight, &zeros], 1)?.index_select(&Tensor::new(from, &Device::Cpu)?, 1)
}
