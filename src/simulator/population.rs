//! Populations to simulate measurements from: a normal distribution for each parameter.

use nalgebra::DMatrix;
use rand::Rng as _;
use rand_distr::StandardNormal;

use super::{Error as SimulationError, Simulator};
use crate::parameter::ParameterSpace;
use crate::quantity::shown;
use crate::stats;

/// Mean and standard deviation of each parameter, independent and normal.
#[derive(Debug, Clone, PartialEq)]
pub struct Population {
    mean: Vec<f64>,
    std: Vec<f64>,
}

/// Measurements of a population, and the parameters behind them.
#[derive(Debug, Clone, PartialEq)]
pub struct SimulatedMeasurements {
    /// Parameters of each measurement, `[n, d]`.
    pub theta: DMatrix<f64>,
    /// Measured frequencies, Hz, `[n, m]`.
    pub frequencies_hz: DMatrix<f64>,
}

/// Why there is no population.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// A name that is no parameter.
    #[error("{} is no parameter: the parameters are {known}", shown(.name))]
    Unknown {
        /// The name given.
        name: String,
        /// The names there are.
        known: String,
    },
    /// A parameter given twice.
    #[error("parameter {0} is given twice")]
    Repeated(String),
    /// A parameter not given.
    #[error("parameter {0} is not given: a population needs mean and std of every parameter")]
    Missing(String),
    /// Moments that are none.
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
    /// From (name, mean, std) of every parameter, in any order, in parameter units.
    ///
    /// # Errors
    /// [`Error`] naming the parameter.
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

    /// Draws measurements with `noise_multiple` times the structure's measurement noise; 0 makes them exact.
    ///
    /// The draws are not cut off at the prior: a population may leave it, as a damaged one does.
    ///
    /// # Errors
    /// [`SimulationError`] for a draw that gives a negative stiffness or a mechanism.
    pub fn draw(
        &self,
        simulator: &Simulator,
        measurements: usize,
        noise_multiple: f64,
        seed: u64,
    ) -> Result<SimulatedMeasurements, SimulationError> {
        let mut stream = stats::stream(seed, "population");
        let mut one = || -> Vec<f64> {
            let moments = self.mean.iter().zip(&self.std);
            moments.map(|(mean, std)| mean + std * stream.sample::<f64, _>(StandardNormal)).collect()
        };
        let rows: Vec<Vec<f64>> = (0..measurements).map(|_| one()).collect();
        let theta = DMatrix::from_fn(measurements, self.mean.len(), |row, column| rows[row][column]);
        Ok(SimulatedMeasurements { frequencies_hz: simulator.measure(&rows, noise_multiple, seed)?, theta })
    }
}
