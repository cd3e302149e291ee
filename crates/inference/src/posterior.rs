//! Posterior samples of the structural parameters for each measurement of a batch, from any method of inference.

use nalgebra::DMatrix;

use structures::parameter::{Parameter, ParameterSpace};

/// Posterior samples of n measurements, `draws` for each.
#[derive(Debug, Clone)]
pub struct PosteriorSamples {
    theta: DMatrix<f64>,
    draws: usize,
    simulations: usize,
}

impl PosteriorSamples {
    /// `theta`: `[n·draws, d]` in parameter units; the rows of one measurement are contiguous.
    ///
    /// # Panics
    /// If the number of rows is not a multiple of `draws`: a programming error in the caller.
    pub fn new(theta: DMatrix<f64>, draws: usize) -> Self {
        assert!(draws > 0 && theta.nrows().is_multiple_of(draws), "{} rows of {draws} draws each", theta.nrows());
        Self { theta, draws, simulations: 0 }
    }

    /// The same samples, with the number of simulations that were used to weight or move them.
    #[must_use]
    pub const fn after(mut self, simulations: usize) -> Self {
        self.simulations = simulations;
        self
    }

    /// Number of simulations that were used to weight or move the samples; 0 for unmodified draws of a flow.
    pub const fn simulations(&self) -> usize {
        self.simulations
    }

    /// Number of measurements n.
    pub fn measurements(&self) -> usize {
        self.theta.nrows() / self.draws
    }

    /// Number of samples for each measurement.
    pub fn draws(&self) -> usize {
        self.draws
    }

    /// All samples, `[n·draws, d]`, parameter units.
    pub fn theta(&self) -> &DMatrix<f64> {
        &self.theta
    }

    /// All samples, `[n·draws, d]`, parameter units, as a matrix of their own.
    pub fn into_theta(self) -> DMatrix<f64> {
        self.theta
    }

    /// All samples of one parameter, given by its column, `[n·draws]`, in the unit of the parameter.
    pub fn column(&self, parameter: usize) -> Vec<f64> {
        self.theta.column(parameter).iter().copied().collect()
    }

    /// The first `draws` samples of each of the n measurements, `[n·draws, d]`.
    ///
    /// # Panics
    /// If there are fewer: a programming error in the caller.
    #[must_use]
    pub fn first(&self, draws: usize) -> Self {
        assert!(draws <= self.draws, "{draws} of {} draws", self.draws);
        let source = |row: usize| row / draws * self.draws + row % draws;
        let rows = self.measurements() * draws;
        Self::new(DMatrix::from_fn(rows, self.theta.ncols(), |row, column| self.theta[(source(row), column)]), draws)
            .after(self.simulations)
    }

    /// For each measurement, its samples followed by those of `further` for the same measurement: `[n·k, d]`, where k is the sum of
    /// both numbers of draws.
    ///
    /// # Panics
    /// If `further` has another number of measurements: a programming error in the caller.
    #[must_use]
    pub fn joined(&self, further: &Self) -> Self {
        assert!(self.measurements() == further.measurements(), "samples of the same measurements");
        let draws = self.draws + further.draws;
        let value = |row: usize, column: usize| {
            let (measurement, draw) = (row / draws, row % draws);
            match draw.checked_sub(self.draws) {
                None => self.theta[(measurement * self.draws + draw, column)],
                Some(draw) => further.theta[(measurement * further.draws + draw, column)],
            }
        };
        Self::new(DMatrix::from_fn(self.measurements() * draws, self.theta.ncols(), value), draws)
            .after(self.simulations + further.simulations)
    }

    /// Posterior mean of each measurement, `[n, d]`, parameter units.
    pub fn means(&self) -> DMatrix<f64> {
        DMatrix::from_fn(self.measurements(), self.theta.ncols(), |measurement, parameter| {
            self.theta.view((measurement * self.draws, parameter), (self.draws, 1)).mean()
        })
    }

    /// Posterior mass at the ends of the prior, `[d]`: the share of the samples of each parameter for which
    /// [`Parameter::is_at_end`] holds.
    pub fn prior_bound_mass(&self, space: &ParameterSpace) -> Vec<f64> {
        let share = |(index, parameter): (usize, &Parameter)| {
            let at_end = |value: &&f64| parameter.is_at_end(**value);
            self.theta.column(index).iter().filter(at_end).count() as f64 / self.theta.nrows() as f64
        };
        space.iter().enumerate().map(share).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joined_samples_stay_with_their_measurement() {
        // Each value is measurement · 10 + draw; the further samples begin at draw 2.
        let of = |first: usize, draws: usize| {
            let value = |row: usize, _| (row / draws * 10 + first + row % draws) as f64;
            PosteriorSamples::new(DMatrix::from_fn(3 * draws, 1, value), draws)
        };
        let joined = of(0, 2).joined(&of(2, 3));
        assert_eq!((joined.measurements(), joined.draws()), (3, 5));
        assert_eq!(joined.column(0), of(0, 5).column(0));
        assert_eq!(joined.first(2).column(0), of(0, 2).column(0));
    }
}
