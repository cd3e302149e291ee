//! Draws on the CPU without candle: the inverse of a single-precision flow in tiles that stay in the cache, on all threads.
//!
//! candle makes a tensor of every step, and concatenates the condition to every draw. Here each tile of draws passes all
//! units in a few buffers of its own, and what a first layer makes of the condition is computed once for each measurement.
//! [`Flow::inverse`] remains the readable form; both agree to single precision.

use std::ops::Range;

use candle_core::{DType, Result, Tensor};
use nalgebra::{DMatrix, DMatrixView, DVector};
use rayon::prelude::*;

use super::activation::silu_in_place;
use super::coupling::Subnet;
use super::dense::Dense;
use super::Flow;
use crate::stats::exp_f32;

/// Draws that pass the flow together: with width 64, the buffers of a tile fill half of a core's first-level cache.
const TILE: usize = 64;

/// The weights of a flow as plain matrices, read once for a call.
pub struct Sampler {
    dimensions: usize,
    units: Vec<Unit>,
}

/// A coupling unit with the permutation in front of it.
struct Unit {
    /// Column j of the unit's input is parameter `order[j]`.
    order: Vec<usize>,
    /// Number of columns in the first half.
    first: usize,
    on_second: Net,
    on_first: Option<Net>,
}

/// A [`Subnet`], its first layer split between the passive half and the condition.
struct Net {
    of_passive: DMatrix<f32>,
    of_context: DMatrix<f32>,
    input_bias: DVector<f32>,
    hidden: DMatrix<f32>,
    hidden_bias: DVector<f32>,
    output: DMatrix<f32>,
    output_bias: DVector<f32>,
    active: usize,
    clamp: f32,
}

/// Least size of a matrix's side: the blocked product takes over from there, which is five times as fast as plain loops. Thinner
/// matrices are filled up with zeros.
const LEAST_SIDE: usize = 8;

/// What a tile writes on its way; columns are draws.
#[derive(Default)]
struct Buffers {
    passive: DMatrix<f32>,
    input: DMatrix<f32>,
    hidden: DMatrix<f32>,
    output: DMatrix<f32>,
}

impl Sampler {
    /// The weights of `flow`; `None` where its numbers are not single precision.
    ///
    /// # Errors
    /// A candle error when weights lie on a device that cannot be read.
    pub fn new(flow: &Flow) -> Result<Option<Self>> {
        if flow.dtype != DType::F32 {
            return Ok(None);
        }
        let unit = |(order, (_, unit)): (&Vec<u32>, &(_, super::coupling::CouplingUnit))| {
            let first = flow.architecture.parameters / 2;
            let on_first = unit.on_first().map(|net| Net::new(net, flow.architecture.parameters - first));
            Ok(Unit {
                order: order.iter().map(|&from| from as usize).collect(),
                first,
                on_second: Net::new(unit.on_second(), first)?,
                on_first: on_first.transpose()?,
            })
        };
        let units = flow.architecture.permutations.iter().zip(&flow.units).map(unit).collect::<Result<_>>()?;
        Ok(Some(Self { dimensions: flow.architecture.parameters, units }))
    }

    /// z to x in place, and log|det ∂z/∂x| of each draw.
    ///
    /// `values`: the d numbers of each draw one after another; `context`: S(y), one column for each measurement; the draws of a
    /// measurement lie one after another, as many for each.
    pub fn inverse(&self, values: &mut [f32], context: &DMatrix<f32>) -> Vec<f32> {
        let d = self.dimensions;
        let draws = values.len() / d / context.ncols().max(1);
        let mut log_det = vec![0.0; values.len() / d];
        // Tiles of one size, whatever the number of threads: the same bits on each machine of a kind.
        let tiles = values.par_chunks_mut(TILE * d).zip(log_det.par_chunks_mut(TILE)).enumerate();
        tiles.for_each(|(tile, (values, log_det))| {
            let measurement = |draw: usize| (tile * TILE + draw) / draws;
            let rows = measurement(0)..measurement(log_det.len() - 1) + 1;
            let context = context.columns(rows.start, rows.len());
            let owner: Vec<usize> = (0..log_det.len()).map(|draw| measurement(draw) - rows.start).collect();
            let mut x = DMatrix::from_column_slice(d, log_det.len(), values);
            let mut buffers = Buffers::default();
            for unit in self.units.iter().rev() {
                unit.inverse(&mut x, &context, &owner, log_det, &mut buffers);
            }
            values.copy_from_slice(x.as_slice());
        });
        log_det
    }
}

impl Unit {
    fn inverse(
        &self,
        x: &mut DMatrix<f32>,
        context: &DMatrixView<'_, f32>,
        owner: &[usize],
        log_det: &mut [f32],
        buffers: &mut Buffers,
    ) {
        let (first, second) = (self.first, x.nrows() - self.first);
        if let Some(net) = &self.on_first {
            net.scale_and_shift(&x.rows(first, second), context, owner, buffers);
            undo(x, 0..first, &buffers.output, log_det);
        }
        self.on_second.scale_and_shift(&x.rows(0, first), context, owner, buffers);
        undo(x, first..x.nrows(), &buffers.output, log_det);
        for mut column in x.column_iter_mut() {
            let permuted: Vec<f32> = column.iter().copied().collect();
            self.order.iter().zip(permuted).for_each(|(&to, value)| column[to] = value);
        }
    }
}

/// x ← (x − t)·exp(−s) in `rows`; `scale_and_shift` holds s over t.
fn undo(x: &mut DMatrix<f32>, rows: Range<usize>, scale_and_shift: &DMatrix<f32>, log_det: &mut [f32]) {
    for ((mut column, own), log_det) in x.column_iter_mut().zip(scale_and_shift.column_iter()).zip(log_det) {
        for (place, row) in rows.clone().enumerate() {
            let (scale, shift) = (own[place], own[rows.len() + place]);
            column[row] = (column[row] - shift) * exp_f32(-scale);
            *log_det += scale;
        }
    }
}

impl Net {
    fn new(subnet: &Subnet, passive: usize) -> Result<Self> {
        let (input, input_bias) = plain(subnet.input())?;
        let (hidden, hidden_bias) = plain(subnet.hidden())?;
        let (output, output_bias) = plain(subnet.output())?;
        let (active, rows) = (output.nrows() / 2, output.nrows().max(LEAST_SIDE));
        Ok(Self {
            of_passive: input.columns(0, passive).into_owned().resize_horizontally(passive.max(LEAST_SIDE), 0.0),
            of_context: input.columns(passive, input.ncols() - passive).into_owned(),
            input_bias,
            hidden,
            hidden_bias,
            output: output.resize_vertically(rows, 0.0),
            output_bias: output_bias.resize_vertically(rows, 0.0),
            active,
            clamp: subnet.clamp() as f32,
        })
    }

    /// s over t, one column for each draw, into `buffers.output`.
    fn scale_and_shift(
        &self,
        passive: &DMatrixView<'_, f32, nalgebra::Const<1>, nalgebra::Dyn>,
        context: &DMatrixView<'_, f32>,
        owner: &[usize],
        buffers: &mut Buffers,
    ) {
        let mut of_context = DMatrix::from_fn(self.input_bias.len(), context.ncols(), |row, _| self.input_bias[row]);
        of_context.gemm(1.0, &self.of_context, context, 1.0);
        let Buffers { passive: padded, input, hidden, output } = buffers;
        if padded.shape() != (self.of_passive.ncols(), owner.len()) {
            *padded = DMatrix::zeros(self.of_passive.ncols(), owner.len());
        }
        padded.rows_mut(0, passive.nrows()).copy_from(passive);
        padded.rows_mut(passive.nrows(), padded.nrows() - passive.nrows()).fill(0.0);
        fill(input, self.input_bias.len(), owner.len(), |draw| of_context.column(owner[draw]).data.into_slice());
        input.gemm(1.0, &self.of_passive, &*padded, 1.0);
        silu_in_place(input.as_mut_slice());
        fill(hidden, self.hidden_bias.len(), owner.len(), |_| self.hidden_bias.as_slice());
        hidden.gemm(1.0, &self.hidden, &*input, 1.0);
        silu_in_place(hidden.as_mut_slice());
        fill(output, self.output_bias.len(), owner.len(), |_| self.output_bias.as_slice());
        output.gemm(1.0, &self.output, &*hidden, 1.0);
        for mut column in output.column_iter_mut() {
            for scale in column.rows_mut(0, self.active).iter_mut() {
                *scale = self.clamp * (*scale / self.clamp).tanh();
            }
        }
    }
}

/// Gives `matrix` this shape and these columns, in its own memory where that is large enough.
fn fill<'a>(matrix: &mut DMatrix<f32>, rows: usize, columns: usize, column: impl Fn(usize) -> &'a [f32]) {
    if matrix.shape() != (rows, columns) {
        *matrix = DMatrix::zeros(rows, columns);
    }
    for (index, own) in matrix.as_mut_slice().chunks_exact_mut(rows).enumerate() {
        own.copy_from_slice(column(index));
    }
}

/// Weight and bias of a layer.
fn plain(layer: &Dense) -> Result<(DMatrix<f32>, DVector<f32>)> {
    let matrix = |tensor: &Tensor| -> Result<DMatrix<f32>> {
        let (rows, columns) = tensor.dims2()?;
        Ok(DMatrix::from_row_slice(rows, columns, &tensor.flatten_all()?.to_vec1::<f32>()?))
    };
    Ok((matrix(layer.weight())?, DVector::from_vec(layer.bias().to_vec1()?)))
}
