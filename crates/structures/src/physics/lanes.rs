//! Numbers of eight runs side by side, so that a loop over them compiles to vector instructions.

/// Runs per batch: the number of `f64` lanes in the widest vector register.
pub(super) const LANES: usize = 8;

/// One number of each run, aligned to a cache line.
#[derive(Clone, Copy, Default)]
#[repr(C, align(64))]
pub(super) struct Lanes(pub(super) [f64; LANES]);

impl Lanes {
    pub(super) const ZERO: Self = Self([0.0; LANES]);
}
