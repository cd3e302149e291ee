//! Training on the CPU without candle: loss, gradient and optimiser implemented by hand in single precision.
//!
//! candle allocates a tensor for every operation of the forward and the backward pass, and adds the gradients of shared
//! inputs one by one. Here a tile of the batch passes through the whole flow, forward and backward, in reused buffers, and
//! all weights are in one vector. `Flow::forward` with candle's gradient remains the readable implementation, and the
//! reference in the tests.
//!
//! ```text
//!  loss = 1/M Σ ( ½|z|² − Σ s ),   ∂loss/∂z = z/M,   ∂loss/∂s = −1/M plus the part through exp(s)
//! ```

mod context;
mod layout;
mod net;
mod optimiser;
#[cfg(test)]
mod tests;

use candle_core::{Result, Tensor};
use rayon::prelude::*;

use super::model::Flow;
use super::pairs::Pairs;
use super::weights::Weights;
use context::Context;
use layout::Layout;
use net::{Gradients, Net};
use optimiser::AdamW;

/// Rows per tile: with width 64, the traces of a tile stay in the second-level cache until the backward pass.
const TILE: usize = 64;

/// Number of partial sums of the gradient. They are computed in parallel and added in a fixed order, so that the bits of
/// the result do not depend on the number of threads.
const LANES: usize = 8;

/// A flow in training.
pub struct Fused {
    layout: Layout,
    weights: Vec<f32>,
    dimensions: usize,
    context: Context,
    units: Vec<Unit>,
    lanes: Vec<Lane>,
    optimiser: AdamW,
}

/// A coupling unit with the permutation before it.
struct Unit {
    /// Column j of the unit's input is parameter `order[j]`.
    order: Vec<usize>,
    nets: Vec<Net>,
}

/// Buffers for one partial sum of the gradient.
struct Lane {
    gradient: Vec<f32>,
    loss: f64,
    context: Vec<f32>,
    context_gradient: Vec<f32>,
    state: Vec<f32>,
    context_trace: context::Trace,
    /// One trace per net, in the order of the forward pass.
    traces: Vec<net::Trace>,
    scratch: net::Scratch,
}

/// Training pairs as plain numbers, row by row.
pub struct Rows {
    count: usize,
    x: Vec<f32>,
    /// The inputs of each observation, mode by mode.
    y: Vec<f32>,
    shortcut: Vec<f32>,
}

impl Fused {
    /// Reads the flow with its current weights.
    ///
    /// # Errors
    /// A candle error when the weights are not in single precision, or cannot be read.
    pub fn new(flow: &Flow, weights: &Weights) -> Result<Self> {
        let (layout, values) = Layout::read(weights)?;
        let architecture = flow.architecture();
        let dimensions = architecture.parameters;
        let first = dimensions / 2;
        let context = Context::new(&layout, architecture, flow.context().shortcut_width());
        let clamp = architecture.clamp_tenths as f32 / 10.0;
        let unit = |(index, order): (usize, &Vec<u32>)| {
            let net =
                |name: &str, passive, active| Net::new(&layout, &format!("unit{index}.{name}"), passive, active, clamp);
            let mut nets = vec![net("on_second", 0..first, first..dimensions)];
            if first > 0 {
                nets.push(net("on_first", first..dimensions, 0..first));
            }
            Unit { order: order.iter().map(|&from| from as usize).collect(), nets }
        };
        let units: Vec<Unit> = architecture.permutations.iter().enumerate().map(unit).collect();
        let optimiser = AdamW::new(values.len());
        Ok(Self { layout, weights: values, dimensions, context, units, lanes: Vec::new(), optimiser })
    }

    /// Converts `pairs` to plain numbers.
    ///
    /// # Errors
    /// A candle error when the shapes do not fit together.
    pub fn rows(&self, flow: &Flow, pairs: &Pairs) -> Result<Rows> {
        let plain = |tensor: &Tensor| tensor.flatten_all()?.to_vec1::<f32>();
        Ok(Rows {
            count: pairs.x.dim(0)?,
            x: plain(&pairs.x)?,
            y: if self.context.has_network() { plain(&pairs.y.transpose(1, 2)?.contiguous()?)? } else { Vec::new() },
            shortcut: plain(&flow.context().shortcut(&pairs.y)?)?,
        })
    }

    /// Mean loss over all rows, nats.
    pub fn loss(&mut self, rows: &Rows) -> f64 {
        let all: Vec<u32> = (0..rows.count as u32).collect();
        self.pass(rows, &all, false)
    }

    /// Makes one step of the optimiser on the rows with the indices `chosen`, `[M]`, and returns their mean loss before the step,
    /// nats. If that loss is not finite, no step is made.
    pub fn step(&mut self, rows: &Rows, chosen: &[u32], learning_rate: f64) -> f64 {
        let loss = self.pass(rows, chosen, true);
        if loss.is_finite() {
            let gradients: Vec<&[f32]> = self.lanes[..lanes(chosen.len())].iter().map(|lane| &*lane.gradient).collect();
            self.optimiser.step(&mut self.weights, &gradients, learning_rate);
        }
        loss
    }

    /// The current weights as one vector, `[weights]`, in alphabetical order of their names.
    pub fn weights(&self) -> &[f32] {
        &self.weights
    }

    /// Writes `values`, obtained from [`Self::weights`], to the variables of the flow.
    ///
    /// # Errors
    /// A candle error when `weights` belong to another flow.
    pub fn write(&self, values: &[f32], weights: &Weights) -> Result<()> {
        self.layout.write(values, weights)
    }

    /// Mean loss of the `chosen` rows, nats. If `back` is true, the lanes then contain the partial sums of its gradient.
    fn pass(&mut self, rows: &Rows, chosen: &[u32], back: bool) -> f64 {
        let mut own = std::mem::take(&mut self.lanes);
        while own.len() < lanes(chosen.len()) {
            own.push(self.lane());
        }
        let tiles: Vec<&[u32]> = chosen.chunks(TILE).collect();
        let share = 1.0 / chosen.len() as f32;
        let count = lanes(chosen.len());
        own[..count].par_iter_mut().enumerate().for_each(|(index, lane)| {
            lane.loss = 0.0;
            if back {
                lane.gradient.fill(0.0);
            }
            for tile in tiles.iter().skip(index).step_by(count) {
                self.tile(rows, tile, back.then_some(share), lane);
            }
        });
        let sum: f64 = own[..count].iter().map(|lane| lane.loss).sum();
        self.lanes = own;
        sum / chosen.len() as f64
    }

    /// Forward pass of one tile and, with `share` (1/M), its backward pass.
    fn tile(&self, rows: &Rows, tile: &[u32], share: Option<f32>, lane: &mut Lane) {
        let (d, count, weights) = (self.dimensions, tile.len(), &self.weights);
        let (of_y, of_shortcut) = (rows.y.len() / rows.count, rows.shortcut.len() / rows.count);
        let observation = |index: usize| {
            let row = tile[index] as usize;
            (&rows.y[row * of_y..][..of_y], &rows.shortcut[row * of_shortcut..][..of_shortcut])
        };
        let context = &mut lane.context[..self.context.width() * count];
        self.context.forward(weights, observation, count, &mut lane.context_trace, context);

        let state = &mut lane.state[..d * count];
        for (own, &row) in state.chunks_exact_mut(d).zip(tile) {
            own.copy_from_slice(&rows.x[row as usize * d..][..d]);
        }
        let mut permuted = vec![0.0; d];
        let mut traces = lane.traces.iter_mut();
        let mut log_det = 0.0;
        for unit in &self.units {
            for column in state.chunks_exact_mut(d) {
                permuted.copy_from_slice(column);
                column.iter_mut().zip(&unit.order).for_each(|(to, &from)| *to = permuted[from]);
            }
            for net in &unit.nets {
                let trace = traces.next().expect("there is a trace for each net");
                log_det += net.forward(weights, state, context, count, trace);
            }
        }
        lane.loss += 0.5 * state.iter().map(|z| f64::from(*z).powi(2)).sum::<f64>() - log_det;

        let Some(share) = share else { return };
        let context_gradient = &mut lane.context_gradient[..self.context.width() * count];
        context_gradient.fill(0.0);
        // ∂loss/∂z = z/M.
        for z in state.iter_mut() {
            *z *= share;
        }
        let weights_gradient = &mut lane.gradient;
        let mut gradients = Gradients { state, context: context_gradient, weights: weights_gradient, share, count };
        let mut traces = lane.traces.iter().rev();
        for unit in self.units.iter().rev() {
            for net in unit.nets.iter().rev() {
                let trace = traces.next().expect("there is a trace for each net");
                net.backward(weights, &mut gradients, trace, &mut lane.scratch);
            }
            for column in gradients.state.chunks_exact_mut(d) {
                permuted.copy_from_slice(column);
                unit.order.iter().zip(&permuted).for_each(|(&to, &value)| column[to] = value);
            }
        }
        let Gradients { context, weights: gradient, .. } = gradients;
        self.context.backward(weights, context, gradient, count, &mut lane.context_trace);
    }

    fn lane(&self) -> Lane {
        let nets: Vec<&Net> = self.units.iter().flat_map(|unit| &unit.nets).collect();
        Lane {
            gradient: vec![0.0; self.weights.len()],
            loss: 0.0,
            context: vec![0.0; self.context.width() * TILE],
            context_gradient: vec![0.0; self.context.width() * TILE],
            state: vec![0.0; self.dimensions * TILE],
            context_trace: self.context.trace(TILE),
            traces: nets.iter().map(|net| net.trace(TILE)).collect(),
            scratch: Net::scratch(&nets, TILE),
        }
    }
}

/// Number of partial sums for a batch of `rows`.
fn lanes(rows: usize) -> usize {
    rows.div_ceil(TILE).min(LANES)
}
