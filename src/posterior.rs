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
}

impl PosteriorSamples {
    /// `theta`: `[n·draws, d]`, the rows of one measurement together, in parameter units.
    ///
    /// # Panics
    /// When the number of rows is no multiple of `draws`: a bug.
    pub fn new(theta: DMatrix<f64>, draws: usize) -> Self {
        assert!(draws > 0 && theta.nrows().is_multiple_of(draws), "{} rows of {draws} draws each", theta.nrows());
        Self { theta, draws }
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
    }

    /// Posterior mean of each measurement, `[n, d]`.
    pub fn means(&self) -> DMatrix<f64> {
        DMatrix::from_fn(self.measurements(), self.theta.ncols(), |measurement, parameter| {
            self.theta.view((measurement * self.draws, parameter), (self.draws, 1)).mean()
        })
    }

    /// Share of the samples of each parameter that lie within [`EDGE`] of an end of its prior.
    pub fn edge_mass(&self, space: &ParameterSpace) -> Vec<f64> {
        let share = |(index, parameter): (usize, &crate::parameter::Parameter)| {
            let at_edge = |value: &&f64| !(EDGE..=1.0 - EDGE).contains(&parameter.to_unit(**value));
            self.theta.column(index).iter().filter(at_edge).count() as f64 / self.theta.nrows() as f64
        };
        space.iter().enumerate().map(share).collect()
    }
}
