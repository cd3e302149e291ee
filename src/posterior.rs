//! Samples of the structural parameters of each measurement of a batch, whoever produced them.

use nalgebra::DMatrix;

use crate::parameter::ParameterSpace;

/// Distance to a prior edge below which a sample counts as lying at the edge, as a share of the prior's width.
pub const EDGE: f64 = 0.01;

/// Posterior samples of n measurements: `draws` rows each, in the order of the measurements.
#[derive(Debug, Clone)]
pub struct PosteriorSamples {
    theta: DMatrix<f64>,
    draws: usize,
    simulations: usize,
}

impl PosteriorSamples {
    /// `theta`: `[n·draws, d]`, the rows of one measurement together, in parameter units.
    ///
    /// # Panics
    /// When the number of rows is no multiple of `draws`: a bug.
    pub fn new(theta: DMatrix<f64>, draws: usize) -> Self {
        assert!(draws > 0 && theta.nrows().is_multiple_of(draws), "{} rows of {draws} draws each", theta.nrows());
        Self { theta, draws, simulations: 0 }
    }

    /// The same, weighed or moved by so many simulations.
    #[must_use]
    pub const fn after(mut self, simulations: usize) -> Self {
        self.simulations = simulations;
        self
    }

    /// Simulations that weighed or moved the samples; 0 where they are those of a flow as it drew them.
    pub const fn simulations(&self) -> usize {
        self.simulations
    }

    /// Number of measurements n.
    pub fn measurements(&self) -> usize {
        self.theta.nrows() / self.draws
    }

    /// Samples for each measurement.
    pub fn draws(&self) -> usize {
        self.draws
    }

    /// All samples, `[n·draws, d]`.
    pub fn theta(&self) -> &DMatrix<f64> {
        &self.theta
    }

    /// All samples of one parameter.
    pub fn column(&self, parameter: usize) -> Vec<f64> {
        self.theta.column(parameter).iter().copied().collect()
    }

    /// The first `draws` samples of each measurement.
    ///
    /// # Panics
    /// When there are fewer: a bug.
    #[must_use]
    pub fn first(&self, draws: usize) -> Self {
        assert!(draws <= self.draws, "{draws} of {} draws", self.draws);
        let source = |row: usize| row / draws * self.draws + row % draws;
        let rows = self.measurements() * draws;
        Self::new(DMatrix::from_fn(rows, self.theta.ncols(), |row, column| self.theta[(source(row), column)]), draws)
            .after(self.simulations)
    }

    /// These samples of each measurement, then those of `further`.
    ///
    /// # Panics
    /// When those are of other measurements or parameters: a bug.
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

    /// Posterior mean of each measurement, `[n, d]`.
    pub fn means(&self) -> DMatrix<f64> {
        DMatrix::from_fn(self.measurements(), self.theta.ncols(), |measurement, parameter| {
            self.theta.view((measurement * self.draws, parameter), (self.draws, 1)).mean()
        })
    }

    /// Share of the samples of each parameter that lie within [`EDGE`] of an end of its prior.
    pub fn prior_bound_mass(&self, space: &ParameterSpace) -> Vec<f64> {
        let share = |(index, parameter): (usize, &crate::parameter::Parameter)| {
            let at_edge = |value: &&f64| !(EDGE..=1.0 - EDGE).contains(&parameter.to_unit(**value));
            self.theta.column(index).iter().filter(at_edge).count() as f64 / self.theta.nrows() as f64
        };
        space.iter().enumerate().map(share).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joined_samples_stay_with_their_measurement() {
        // Measurement · 10 + draw; the further ones begin at draw 2.
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
