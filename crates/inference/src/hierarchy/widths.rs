//! Mixtures of normal distributions with a common centre and several widths. The wide components cover the tails of a
//! posterior that is not normal.

/// A mixture of standard normal distributions stretched by several widths, which the draws take in turn.
pub(super) struct Widths<const COUNT: usize> {
    widths: [f64; COUNT],
    /// Index of the width of each of eight draws in a row.
    turns: [usize; 8],
    /// Share of the draws of each width, divided by widthᵈ.
    densities: [f64; COUNT],
}

impl<const COUNT: usize> Widths<COUNT> {
    /// A mixture of the given relative `widths` for `draws` draws in `dimensions` dimensions. `turns`: index of the width of
    /// each of eight draws in a row, `[8]`.
    pub fn new(widths: [f64; COUNT], turns: [usize; 8], draws: usize, dimensions: usize) -> Self {
        let density = |own: usize| {
            let count = (0..draws).filter(|draw| turns[draw % turns.len()] == own).count();
            count as f64 / draws as f64 / widths[own].powi(dimensions as i32)
        };
        Self { widths, turns, densities: std::array::from_fn(density) }
    }

    /// Width of a draw.
    pub fn of(&self, draw: usize) -> f64 {
        self.widths[self.turns[draw % self.turns.len()]]
    }

    /// Log-density of a stretched draw z, up to a constant. `squared`: |z|².
    ///
    /// ```text
    ///  ln Σ_w share_w w^−d exp(−|z|²/2w²)
    /// ```
    pub fn log_density(&self, squared: f64) -> f64 {
        let all = self.widths.iter().zip(&self.densities);
        all.map(|(width, density)| density * (-0.5 * squared / (width * width)).exp()).sum::<f64>().ln()
    }
}
