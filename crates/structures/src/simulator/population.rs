//! Populations from which measurements are simulated: an independent normal distribution for each parameter.

use nalgebra::DMatrix;
use rand::Rng as _;
use rand_distr::StandardNormal;

use super::simulate::{Error as SimulationError, Simulator};
use crate::parameter::ParameterSpace;
use crate::quantity::shown;
use crate::stats;

/// Independent normal distributions of the parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct Population {
    mean: Vec<f64>,
    std: Vec<f64>,
}

/// Simulated measurements of a population, and the parameters that they were simulated with.
#[derive(Debug, Clone, PartialEq)]
pub struct SimulatedMeasurements {
    /// Parameters of each measurement, `[n, d]`, parameter units.
    pub theta: DMatrix<f64>,
    /// Measured frequencies, Hz, `[n, m]`.
    pub frequencies_hz: DMatrix<f64>,
}

/// Why a population is not valid.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// A name is not that of a parameter.
    #[error("{} is not a parameter: the parameters are {known}", shown(.name))]
    Unknown {
        /// The name given.
        name: String,
        /// Names of the parameters.
        known: String,
    },
    /// A parameter is given twice.
    #[error("parameter {0} is given twice")]
    Repeated(String),
    /// A parameter is not given.
    #[error("parameter {0} is not given: a population needs mean and std of every parameter")]
    Missing(String),
    /// A mean or standard deviation is not valid.
    #[error("parameter {name} has mean {mean} and std {std}: both must be finite, std not negative")]
    Moments {
        /// Name of the parameter.
        name: String,
        /// Mean given.
        mean: f64,
        /// Standard deviation given.
        std: f64,
    },
}

impl Population {
    /// Builds a population from the `moments` (name, mean, standard deviation) of every parameter, `[d]`, in any order and in
    /// parameter units.
    ///
    /// # Errors
    /// [`Error`] with the name of the parameter.
    pub fn new(space: &ParameterSpace, moments: &[(String, f64, f64)]) -> Result<Self, Error> {
        let mut given: Vec<Option<(f64, f64)>> = vec![None; space.len()];
        for (name, mean, std) in moments {
            let known = || space.iter().map(|p| p.name.as_str()).collect::<Vec<_>>().join(", ");
            let unknown = || Error::Unknown { name: name.clone(), known: known() };
            let column = space.position(name).ok_or_else(unknown)?;
            if !(mean.is_finite() && std.is_finite() && *std >= 0.0) {
                return Err(Error::Moments { name: name.clone(), mean: *mean, std: *std });
            }
            if given[column].replace((*mean, *std)).is_some() {
                return Err(Error::Repeated(name.clone()));
            }
        }
        let complete = given
            .iter()
            .zip(space.iter())
            .map(|(moments, parameter)| moments.ok_or_else(|| Error::Missing(parameter.name.clone())));
        let (mean, std) = complete.collect::<Result<Vec<_>, _>>()?.into_iter().unzip();
        Ok(Self { mean, std })
    }

    /// Draws parameters, `[n][d]`, in their units.
    pub fn parameters(&self, measurements: usize, seed: u64) -> Vec<Vec<f64>> {
        let mut stream = stats::stream(seed, "population");
        let mut one = || -> Vec<f64> {
            let moments = self.mean.iter().zip(&self.std);
            moments.map(|(mean, std)| mean + std * stream.sample::<f64, _>(StandardNormal)).collect()
        };
        (0..measurements).map(|_| one()).collect()
    }

    /// Draws parameters, `[n, d]`, and simulates their frequencies, Hz, `[n, m]`: n = `measurements` measurements with
    /// `noise_multiple` times the measurement noise of the structure; 0 gives exact frequencies. The draws are not truncated at
    /// the prior, because a damaged population can leave it.
    ///
    /// # Errors
    /// [`SimulationError`] for a draw that gives a negative stiffness or a mechanism, and for noise that leaves no positive
    /// frequency.
    pub fn draw(
        &self,
        simulator: &Simulator,
        measurements: usize,
        noise_multiple: f64,
        seed: u64,
    ) -> Result<SimulatedMeasurements, SimulationError> {
        let rows = self.parameters(measurements, seed);
        let theta = DMatrix::from_fn(measurements, self.mean.len(), |row, column| rows[row][column]);
        Ok(SimulatedMeasurements { frequencies_hz: simulator.measure(&rows, noise_multiple, seed)?, theta })
    }
}
