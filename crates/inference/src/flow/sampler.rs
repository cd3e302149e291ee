//! Sampling on the CPU without candle: the inverse of a single-precision flow, in tiles that stay in the cache, on all
//! threads.
//!
//! candle allocates a tensor for every operation and concatenates the condition to every draw. Here each tile of draws
//! passes through all units in a few reused buffers, and the product of the first layer with the condition is computed once
//! per measurement. [`Flow::inverse`] remains the readable form; both agree to single precision.

use std::ops::Range;

use candle_core::{DType, Device, Result, Tensor};
use faer::MatRef;
use rand::Rng as _;
use rand_distr::StandardNormal;
use rayon::prelude::*;

use super::coupling::{CouplingUnit, Subnet};
use super::dense::Dense;
use super::kernel::{add_bias_and_silu, bounded_scales, Layer};
use super::model::{log_density, Flow};
use super::permutation::Permutation;
use structures::stats::Stream;

/// Draws per tile: with width 64, the buffers of a tile fill half of a core's first-level cache.
const TILE: usize = 64;

/// The weights of a trained flow as plain numbers, for sampling.
pub struct Sampler {
    dimensions: usize,
    units: Vec<Unit>,
}

/// A coupling unit with the permutation before it.
struct Unit {
    /// Column j of the unit's input is parameter `order[j]`.
    order: Vec<usize>,
    /// In the order in which the inverse applies them.
    nets: Vec<Net>,
}

/// A [`Subnet`] with the rows of the state that it reads (`passive`) and transforms (`active`).
struct Net {
    passive: Range<usize>,
    active: Range<usize>,
    input: Plain,
    hidden: Plain,
    output: Plain,
    clamp: f32,
}

/// Weight (column-major) and bias of a layer.
struct Plain {
    weight: Vec<f32>,
    bias: Vec<f32>,
}

/// Buffers for one tile.
struct Buffers {
    of_context: Vec<f32>,
    passive: Vec<f32>,
    input: Vec<f32>,
    hidden: Vec<f32>,
    output: Vec<f32>,
    scales: Vec<f32>,
    factors: Vec<f32>,
}

impl Flow {
    /// Draws `draws` samples of x for each row of `context`, S(y) `[n, context]`. Returns x `[n·draws, d]` in the order of
    /// the rows, and the log-density of each sample, nats, `[n·draws]`.
    ///
    /// Each call converts all weights anew. A [`Sampler`] gives the same samples and converts the weights only once.
    ///
    /// # Errors
    /// A candle error when the shape of `context` is wrong, or the weights are not in single precision.
    pub fn sample(&self, context: &Tensor, draws: usize, stream: &mut Stream) -> Result<(Tensor, Tensor)> {
        Sampler::new(self)?.sample(context, draws, stream)
    }
}

/// Standard normal draws, f64 `[rows, columns]`, from a seeded stream (candle's generator cannot be seeded on the CPU).
fn standard_normal(rows: usize, columns: usize, stream: &mut Stream) -> Tensor {
    let draws: Vec<f64> = (0..rows * columns).map(|_| stream.sample(StandardNormal)).collect();
    Tensor::from_vec(draws, (rows, columns), &Device::Cpu).expect("the number of draws is that of the shape")
}

impl Sampler {
    /// Reads the weights of `flow`.
    ///
    /// # Errors
    /// A candle error when they are not in single precision.
    pub fn new(flow: &Flow) -> Result<Self> {
        let dimensions = flow.architecture().parameters;
        let unit = |(order, (_, unit)): (&Vec<u32>, &(Permutation, CouplingUnit))| {
            let first = dimensions / 2;
            let on_first = unit.on_first().map(|net| Net::new(net, first..dimensions, 0..first));
            let on_second = Net::new(unit.on_second(), 0..first, first..dimensions);
            Ok(Unit {
                order: order.iter().map(|&from| from as usize).collect(),
                nets: on_first.into_iter().chain([on_second]).collect::<Result<_>>()?,
            })
        };
        let units = flow.architecture().permutations.iter().zip(flow.units()).map(unit).collect::<Result<_>>()?;
        Ok(Self { dimensions, units })
    }

    /// As [`Flow::sample`]: `context` is `[n, context]`; returns x, `[n·draws, d]`, and the log-density of each sample, nats,
    /// `[n·draws]`.
    ///
    /// # Errors
    /// A candle error when the shape of `context` is wrong.
    pub fn sample(&self, context: &Tensor, draws: usize, stream: &mut Stream) -> Result<(Tensor, Tensor)> {
        let (rows, features) = context.dims2()?;
        let z = standard_normal(rows * draws, self.dimensions, stream).to_dtype(DType::F32)?;
        let context = context.flatten_all()?.to_vec1()?;
        let mut values = z.flatten_all()?.to_vec1()?;
        let log_det = Tensor::new(self.inverse(&mut values, &context, features), &Device::Cpu)?;
        let x = Tensor::from_vec(values, (rows * draws, self.dimensions), &Device::Cpu)?;
        Ok((x, log_density(&z, &log_det)?))
    }

    /// Maps z to x in place. Returns ln|det ∂z/∂x| of each draw, `[n·draws]`.
    ///
    /// `values`: z, row-major `[n·draws, d]`, with the draws of each measurement in contiguous rows; `context`: S(y) of each
    /// measurement, row-major `[n, features]`.
    pub fn inverse(&self, values: &mut [f32], context: &[f32], features: usize) -> Vec<f32> {
        let d = self.dimensions;
        let draws = values.len() / d / (context.len() / features).max(1);
        let mut log_det = vec![0.0; values.len() / d];
        // The size of the tiles does not depend on the number of threads, so that the bits of the result do not either.
        let tiles = values.par_chunks_mut(TILE * d).zip(log_det.par_chunks_mut(TILE)).enumerate();
        tiles.for_each_init(
            || self.buffers(),
            |buffers, (tile, (values, log_det))| {
                let measurement = |draw: usize| (tile * TILE + draw) / draws;
                let rows = measurement(0)..measurement(log_det.len() - 1) + 1;
                let context = &context[rows.start * features..rows.end * features];
                let owner = |draw: usize| measurement(draw) - rows.start;
                for unit in self.units.iter().rev() {
                    for net in &unit.nets {
                        net.inverse(values, context, owner, log_det, buffers);
                    }
                    for column in values.chunks_exact_mut(d) {
                        buffers.passive[..d].copy_from_slice(column);
                        unit.order.iter().zip(&buffers.passive).for_each(|(&to, &value)| column[to] = value);
                    }
                }
            },
        );
        log_det
    }

    /// Buffers that are large enough for every net of the flow.
    fn buffers(&self) -> Buffers {
        let nets = self.units.iter().flat_map(|unit| &unit.nets);
        let width = nets.map(|net| net.hidden.bias.len()).max().unwrap_or(0);
        let buffer = |rows: usize| vec![0.0; rows * TILE];
        Buffers {
            of_context: buffer(width),
            passive: buffer(self.dimensions),
            input: buffer(width),
            hidden: buffer(width),
            output: buffer(2 * self.dimensions),
            scales: buffer(self.dimensions),
            factors: buffer(self.dimensions),
        }
    }
}

impl Net {
    /// Reads the weights of a subnet that transforms the rows `active` as a function of the rows `passive`.
    fn new(subnet: &Subnet, passive: Range<usize>, active: Range<usize>) -> Result<Self> {
        Ok(Self {
            passive,
            active,
            input: Plain::new(subnet.input())?,
            hidden: Plain::new(subnet.hidden())?,
            output: Plain::new(subnet.output())?,
            clamp: subnet.clamp() as f32,
        })
    }

    /// active ← (active − t)·exp(−s) in each column of `state`, where s and t are computed from the passive rows and from
    /// the column of `context` with the index `owner(column)`. Adds Σ s of each column to `log_det`.
    fn inverse(
        &self,
        state: &mut [f32],
        context: &[f32],
        owner: impl Fn(usize) -> usize,
        log_det: &mut [f32],
        buffers: &mut Buffers,
    ) {
        let [input, hidden, output] = [&self.input, &self.hidden, &self.output].map(Plain::layer);
        let (count, width) = (log_det.len(), input.outputs());
        let (dimensions, passive, active) = (state.len() / count, self.passive.len(), self.active.len());
        let measurements = context.len() / (input.inputs() - passive);

        let of_context = &mut buffers.of_context[..width * measurements];
        input.product_of_columns(passive..input.inputs(), context, of_context, false);
        let first = &mut buffers.input[..width * count];
        for (draw, column) in first.chunks_exact_mut(width).enumerate() {
            column.copy_from_slice(&of_context[owner(draw) * width..][..width]);
        }
        let of_passive = &mut buffers.passive[..passive * count];
        if passive > 0 {
            for (own, state) in of_passive.chunks_exact_mut(passive).zip(state.chunks_exact(dimensions)) {
                own.copy_from_slice(&state[self.passive.clone()]);
            }
            input.product_of_columns(0..passive, of_passive, first, true);
        }
        add_bias_and_silu(first, input.bias);
        let second = &mut buffers.hidden[..width * count];
        hidden.product(first, second, false);
        add_bias_and_silu(second, hidden.bias);
        let scale_and_shift = &mut buffers.output[..2 * active * count];
        output.product(second, scale_and_shift, false);
        let scales = &mut buffers.scales[..active * count];
        for (own, scales) in scale_and_shift.chunks_exact(2 * active).zip(scales.chunks_exact_mut(active)) {
            for ((scale, own), bias) in scales.iter_mut().zip(own).zip(output.bias) {
                *scale = own + bias;
            }
        }
        let factors = &mut buffers.factors[..active * count];
        bounded_scales(scales, factors, self.clamp, -1.0);
        let columns = scale_and_shift.chunks_exact(2 * active).zip(state.chunks_exact_mut(dimensions));
        let scales = scales.chunks_exact(active).zip(factors.chunks_exact(active));
        for (((own, state), (scales, factors)), log_det) in columns.zip(scales).zip(log_det) {
            for (row, value) in state[self.active.clone()].iter_mut().enumerate() {
                *value = (*value - own[active + row] - output.bias[active + row]) * factors[row];
                *log_det += scales[row];
            }
        }
    }
}

impl Plain {
    fn new(layer: &Dense) -> Result<Self> {
        let weight = layer.weight().t()?.flatten_all()?.to_vec1()?;
        Ok(Self { weight, bias: layer.bias().to_vec1()? })
    }

    fn layer(&self) -> Layer<'_> {
        let outputs = self.bias.len();
        let weight = MatRef::from_column_major_slice(&self.weight, outputs, self.weight.len() / outputs);
        Layer { weight, bias: &self.bias }
    }
}
