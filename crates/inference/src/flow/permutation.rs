//! Fixed permutations between the units, so that each unit splits the parameters into different halves.

use candle_core::{Device, Result, Tensor, D};
use rand::seq::SliceRandom as _;

use structures::stats::Stream;

/// A random order of `0..count`.
pub fn random_order(count: usize, stream: &mut Stream) -> Vec<u32> {
    let mut order: Vec<u32> = (0..count as u32).collect();
    order.shuffle(stream);
    order
}

/// A fixed permutation of columns; ln|det| = 0.
pub struct Permutation {
    order: Tensor,
    inverse_order: Tensor,
}

impl Permutation {
    /// Builds the permutation from `order`, `[d]`: entry j is the source of column j.
    ///
    /// # Errors
    /// A candle error when `order` is not a permutation of `0..order.len()`.
    pub fn new(order: &[u32], device: &Device) -> Result<Self> {
        let mut inverse = vec![u32::MAX; order.len()];
        for (to, &from) in order.iter().enumerate() {
            *inverse.get_mut(from as usize).ok_or_else(|| candle_core::Error::Msg(not_a_permutation(order)))? =
                to as u32;
        }
        if inverse.contains(&u32::MAX) {
            return Err(candle_core::Error::Msg(not_a_permutation(order)));
        }
        Ok(Self { order: Tensor::new(order, device)?, inverse_order: Tensor::new(inverse, device)? })
    }

    /// Permutes the columns of `x` `[n, d]`: column j of the result is column `order[j]` of `x`.
    ///
    /// # Errors
    /// A candle error when the number of columns is wrong.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        x.index_select(&self.order, D::Minus1)
    }

    /// The inverse of [`Self::forward`]: column `order[j]` of the result is column j of `x` `[n, d]`.
    ///
    /// # Errors
    /// A candle error when the number of columns is wrong.
    pub fn inverse(&self, x: &Tensor) -> Result<Tensor> {
        x.index_select(&self.inverse_order, D::Minus1)
    }
}

fn not_a_permutation(order: &[u32]) -> String {
    format!("{order:?} is not a permutation of 0..{}", order.len())
}
