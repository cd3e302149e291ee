//! Training pairs and their loss.

use candle_core::{Result, Tensor, D};

use super::model::Flow;

/// Pairs of parameters x on the real line and whitened observations y.
#[derive(Debug, Clone)]
pub struct Pairs {
    /// `[n, d]`.
    pub x: Tensor,
    /// `[n, channels, modes]`, or `[n, fixed_context]`.
    pub y: Tensor,
}

/// Mean loss of the pairs, a scalar in nats with candle's gradient: the reference for `flow::fused`.
///
/// ```text
///  1/n Σ ( ½|z|² − ln|det ∂z/∂x| ),    z = f(x; S(y))
/// ```
///
/// `x`: `[n, d]`; `y`: `[n, channels, modes]` or `[n, fixed_context]`. Source: Wang et al. (2025), Eq. 20.
///
/// # Errors
/// A candle error when the shapes do not fit together.
pub fn mean_loss(flow: &Flow, x: &Tensor, y: &Tensor) -> Result<Tensor> {
    let (z, log_det) = flow.forward(x, &flow.summarise(y)?)?;
    ((z.sqr()?.sum(D::Minus1)? * 0.5)? - log_det)?.mean(0)
}
