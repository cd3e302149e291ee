//! Normal distributions about one centre that draws come from in turn: wide ones reach what a posterior has beyond its moments.

/// A mixture of standard normal distributions stretched by a few widths, and how often each of them comes.
pub(super) struct Widths<const COUNT: usize> {
    widths: [f64; COUNT],
    /// Index of the width of each of eight draws in a row.
    turns: [usize; 8],
    /// Share of the draws that have each width, over its volume.
    densities: [f64; COUNT],
}

impl<const COUNT: usize> Widths<COUNT> {
    /// For so many draws in so many dimensions.
    pub fn new(widths: [f64; COUNT], turns: [usize; 8], draws: usize, dimensions: usize) -> Self {
        let density = |own: usize| {
            let count = (0..draws).filter(|draw| turns[draw % turns.len()] == own).count();
            count as f64 / draws as f64 / widths[own].powi(dimensions as i32)
        };
        Self { widths, turns, densities: std::array::from_fn(density) }
    }

    /// What a draw is stretched by.
    pub fn of(&self, draw: usize) -> f64 {
        self.widths[self.turns[draw % self.turns.len()]]
    }

    /// Logarithm of the density of a stretched draw, up to a constant.
    ///
    /// ```text
    ///  ln Σ_w share_w w^−d exp(−|z|²/2w²)      `squared`: |z|²
    /// ```
    pub fn log_density(&self, squared: f64) -> f64 {
        let all = self.widths.iter().zip(&self.densities);
        all.map(|(width, density)| density * (-0.5 * squared / (width * width)).exp()).sum::<f64>().ln()
    }
}
