//! Conditional affine coupling: each half of x is scaled and shifted by functions of the other half and of the context.

use candle_core::{Result, Tensor, D};
use candle_nn::VarBuilder;

use super::activation::silu;
use super::architecture::Architecture;
use super::dense::Dense;

/// Conditional affine coupling unit (cACL): two affine couplings, so that both halves of x = (x₁, x₂) are transformed.
///
/// ```text
///  z₂ = x₂ ⊙ exp s₁(x₁, c) + t₁(x₁, c)
///  z₁ = x₁ ⊙ exp s₂(z₂, c) + t₂(z₂, c)
///  ln|det ∂z/∂x| = Σ s₁ + Σ s₂
/// ```
///
/// With one parameter the first half is empty and only the second is transformed.
///
/// Source: Wang et al. (2025), Eq. 11 and 12; L. Dinh, J. Sohl-Dickstein, S. Bengio (2017), Density estimation using Real
/// NVP, ICLR. The soft clamp of the log-scales is not in the paper.
pub struct CouplingUnit {
    first: usize,
    second: usize,
    on_second: Subnet,
    on_first: Option<Subnet>,
}

impl CouplingUnit {
    /// Builds a unit for `architecture.parameters` columns and `context` context features from the weights of `vb`.
    ///
    /// # Errors
    /// A candle error when a weight is missing or has the wrong shape.
    pub fn new(architecture: &Architecture, context: usize, vb: &VarBuilder<'_>) -> Result<Self> {
        let first = architecture.parameters / 2;
        let second = architecture.parameters - first;
        let subnet = |passive: usize, active: usize, name: &str| {
            let clamp = f64::from(architecture.clamp_tenths) / 10.0;
            Subnet::new(passive + context, architecture.width, active, clamp, &vb.pp(name))
        };
        let on_second = subnet(first, second, "on_second")?;
        let on_first = if first > 0 { Some(subnet(second, first, "on_first")?) } else { None };
        Ok(Self { first, second, on_second, on_first })
    }

    /// Maps x to z. `x`: `[n, d]`; `context`: `[n, context]`. Returns z `[n, d]` and ln|det ∂z/∂x| `[n]`.
    ///
    /// # Errors
    /// A candle error when the shapes do not fit together.
    pub fn forward(&self, x: &Tensor, context: &Tensor) -> Result<(Tensor, Tensor)> {
        let Some(on_first) = &self.on_first else {
            let (s, t) = self.on_second.scale_and_shift(context)?;
            return Ok((((x * s.exp()?)? + t)?, s.sum(D::Minus1)?));
        };
        let (x1, x2) = self.halves(x)?;
        let (s1, t1) = self.on_second.scale_and_shift(&Tensor::cat(&[&x1, context], 1)?)?;
        let z2 = ((x2 * s1.exp()?)? + t1)?;
        let (s2, t2) = on_first.scale_and_shift(&Tensor::cat(&[&z2, context], 1)?)?;
        let z1 = ((x1 * s2.exp()?)? + t2)?;
        let log_det = (s1.sum(D::Minus1)? + s2.sum(D::Minus1)?)?;
        Ok((Tensor::cat(&[&z1, &z2], 1)?, log_det))
    }

    /// Maps z back to x; the inverse of [`Self::forward`]. Returns x `[n, d]` and ln|det ∂z/∂x| `[n]`.
    ///
    /// # Errors
    /// A candle error when the shapes do not fit together.
    pub fn inverse(&self, z: &Tensor, context: &Tensor) -> Result<(Tensor, Tensor)> {
        let Some(on_first) = &self.on_first else {
            let (s, t) = self.on_second.scale_and_shift(context)?;
            return Ok((((z - t)? * s.neg()?.exp()?)?, s.sum(D::Minus1)?));
        };
        let (z1, z2) = self.halves(z)?;
        let (s2, t2) = on_first.scale_and_shift(&Tensor::cat(&[&z2, context], 1)?)?;
        let x1 = ((z1 - t2)? * s2.neg()?.exp()?)?;
        let (s1, t1) = self.on_second.scale_and_shift(&Tensor::cat(&[&x1, context], 1)?)?;
        let x2 = ((z2 - t1)? * s1.neg()?.exp()?)?;
        let log_det = (s1.sum(D::Minus1)? + s2.sum(D::Minus1)?)?;
        Ok((Tensor::cat(&[&x1, &x2], 1)?, log_det))
    }

    /// The network that scales and shifts the second half.
    pub(super) fn on_second(&self) -> &Subnet {
        &self.on_second
    }

    /// The network that scales and shifts the first half; `None` where that is empty.
    pub(super) fn on_first(&self) -> Option<&Subnet> {
        self.on_first.as_ref()
    }

    /// Splits the columns of `x` `[n, d]` into x₁ and x₂.
    fn halves(&self, x: &Tensor) -> Result<(Tensor, Tensor)> {
        Ok((x.narrow(1, 0, self.first)?, x.narrow(1, self.first, self.second)?))
    }
}

/// Three-layer network that computes log-scale s and shift t of one half.
///
/// ```text
///  (s̃, t) = W₃ silu(W₂ silu(W₁ u + b₁) + b₂) + b₃,    s = α·tanh(s̃/α)
/// ```
///
/// The clamp α bounds each scale to exp(±α), which prevents overflow early in training and for conditions far from the
/// training set. W₃ and b₃ are 0 at first, so that an untrained unit is the identity.
pub(super) struct Subnet {
    input: Dense,
    hidden: Dense,
    output: Dense,
    active: usize,
    clamp: f64,
}

impl Subnet {
    fn new(inputs: usize, width: usize, active: usize, clamp: f64, vb: &VarBuilder<'_>) -> Result<Self> {
        Ok(Self {
            input: Dense::new(inputs, width, &vb.pp("input"))?,
            hidden: Dense::new(width, width, &vb.pp("hidden"))?,
            output: Dense::zero(width, 2 * active, &vb.pp("output"))?,
            active,
            clamp,
        })
    }

    pub(super) fn input(&self) -> &Dense {
        &self.input
    }

    pub(super) fn hidden(&self) -> &Dense {
        &self.hidden
    }

    pub(super) fn output(&self) -> &Dense {
        &self.output
    }

    pub(super) fn clamp(&self) -> f64 {
        self.clamp
    }

    /// Log-scale s and shift t, both `[n, active]`, for `input`, `[n, inputs]`.
    fn scale_and_shift(&self, input: &Tensor) -> Result<(Tensor, Tensor)> {
        let hidden = silu(&self.hidden.forward(&silu(&self.input.forward(input)?)?)?)?;
        let output = self.output.forward(&hidden)?;
        let raw_scale = output.narrow(1, 0, self.active)?;
        let scale = ((raw_scale / self.clamp)?.tanh()? * self.clamp)?;
        Ok((scale, output.narrow(1, self.active, self.active)?))
    }
}
