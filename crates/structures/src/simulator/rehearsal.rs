//! Measurements of a structure over seasons: covariates that follow the year, the day and the weather, parameters that depend on them,
//! drift or fall, and measurements with missing modes and outliers.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use rand::Rng as _;
use rand_distr::StandardNormal;
use rayon::prelude::*;

use super::population::Population;
use super::simulate::{Error as SimulationError, Simulator};
use crate::measurement::{CovariateValue, ModalMeasurement};
use crate::quantity::{Hertz, OutOfRange, Timestamp};
use crate::stats::{self, Stream};

/// One day, µs.
const DAY_MICROS: f64 = 86_400e6;

/// Length of a year, days.
const YEAR_DAYS: f64 = 365.2425;

/// Days from 1 January to the coldest day, 15 January, and from midnight in UTC to the coldest time of the day, 03:00.
const COLDEST_DAY: f64 = 14.0;
const COLDEST_TIME: f64 = 0.125;

/// How a covariate changes in time.
#[derive(Debug, Clone, PartialEq)]
pub enum Course {
    /// A number that follows the year, the day and the weather.
    ///
    /// ```text
    ///  c(t) = mean − year · cos 2π(t − 15 January)/year − day · cos 2π(t − 03:00)/day + w(t)
    ///  w: normal, standard deviation `weather_std`, correlation exp(−Δt/lasting)
    /// ```
    Seasons {
        /// Mean, in the unit of the covariate.
        mean: f64,
        /// Amplitude over the year: the largest value is in July, or in January if it is negative.
        year: f64,
        /// Amplitude over the day: the largest value is at 15:00 UTC, or at 03:00 if it is negative.
        day: f64,
        /// Standard deviation of the weather.
        weather_std: f64,
        /// Time after which the correlation of the weather has fallen to 1/e, days.
        lasting_days: f64,
    },
    /// One of these categories, each with the same probability in each measurement.
    Categories(Vec<String>),
}

/// A change of a parameter: it is multiplied by 1 + the change.
#[derive(Debug, Clone, PartialEq)]
pub enum Change {
    /// `−share` from a time on.
    Loss {
        /// Column of the parameter.
        parameter: usize,
        /// Loss as a share of the parameter; negative for a gain.
        share: f64,
        /// Time of the loss.
        from: Timestamp,
    },
    /// `share_per_day` for each day since the first measurement.
    Trend {
        /// Column of the parameter.
        parameter: usize,
        /// Change per day, as a share.
        share_per_day: f64,
    },
    /// `share_per_unit` for each unit of a covariate above the mean of its course.
    Covariate {
        /// Column of the parameter.
        parameter: usize,
        /// Name of a covariate that is a number.
        covariate: String,
        /// Change per unit of the covariate, as a share.
        share_per_unit: f64,
    },
}

/// What happens to a structure and its measurements.
#[derive(Debug, Clone, PartialEq)]
pub struct Rehearsal {
    /// Covariates by name.
    pub covariates: BTreeMap<String, Course>,
    /// Changes of parameters.
    pub changes: Vec<Change>,
    /// Noise as a multiple of that of the structure.
    pub noise_multiple: f64,
    /// Probability that a mode is not identified in a measurement.
    pub missing: f64,
    /// Probability that the frequency of a mode is an outlier.
    pub outliers: f64,
    /// Standard deviation of an outlier, as a share of the frequency.
    pub outlier_std: f64,
}

/// Measurements, and how many had no mode and were left out.
#[derive(Debug, Clone, PartialEq)]
pub struct Rehearsed {
    /// The measurements in the order of their times.
    pub measurements: Vec<ModalMeasurement>,
    /// Number of measurements in which no mode was identified.
    pub without_modes: usize,
    /// Measurements in which a covariate lies outside the range that an effect of the structure was learned from.
    pub beyond_effects: usize,
}

/// Why a rehearsal is not possible.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// An effect of the structure depends on a covariate that has no course.
    #[error("effect {effect} of the structure depends on the covariate {covariate}, which has no course: give it with --covariate")]
    NoCourse {
        /// Name of the effect.
        effect: String,
        /// Name of the covariate.
        covariate: String,
    },
    /// A parameter depends on a covariate that is not a number with a course.
    #[error("{0} is not a covariate with a numeric course: give it with --covariate {0}=MEAN,year=…")]
    NoNumber(String),
    /// The structure has a learned discrepancy.
    #[error("the structure has a learned discrepancy, which takes its covariates from its own support points: rehearse the structure without it")]
    Discrepancy,
    /// A simulation failed.
    #[error(transparent)]
    Simulation(#[from] SimulationError),
    /// A frequency or time is not valid.
    #[error(transparent)]
    Range(#[from] OutOfRange),
}

impl Rehearsal {
    /// Simulates a measurement at each of `times`, which ascend: the parameters are drawn from `population`, changed, and the
    /// frequencies computed under the effects of the structure at the covariates of the time.
    ///
    /// # Errors
    /// [`Error`], see its variants.
    pub fn run(
        &self,
        simulator: &Simulator,
        population: &Population,
        times: &[Timestamp],
        seed: u64,
    ) -> Result<Rehearsed, Error> {
        self.check(simulator)?;
        let covariates = self.covariates_at(times, seed);
        let mut rows = population.parameters(times.len(), seed);
        for ((row, at), covariates) in rows.iter_mut().zip(times).zip(&covariates) {
            self.change(row, (*at, times[0]), covariates);
        }
        let simulate =
            |(theta, covariates): (&Vec<f64>, &BTreeMap<String, CovariateValue>)| -> Result<_, SimulationError> {
                let sizes = simulator.effect_sizes(covariates);
                let here =
                    if simulator.effects().is_empty() { simulator.clone() } else { simulator.under(&sizes.values) };
                let failed = |source| SimulationError::Physics { parameters: theta.clone(), source };
                Ok((here.frequencies_hz(theta).map_err(failed)?, !sizes.beyond.is_empty()))
            };
        let exact = rows.par_iter().zip(&covariates).map(simulate).collect::<Result<Vec<_>, SimulationError>>()?;
        let beyond_effects = exact.iter().filter(|(_, beyond)| *beyond).count();
        let exact: Vec<Vec<f64>> = exact.into_iter().map(|(frequencies, _)| frequencies).collect();
        let noisy = simulator.with_noise(&exact, self.noise_multiple, seed)?;
        let mut stream = stats::stream(seed, "missing modes and outliers");
        let mut measurements = Vec::with_capacity(times.len());
        for ((row, at), covariates) in noisy.row_iter().zip(times).zip(covariates) {
            let frequencies_hz = row.iter().map(|f| self.identified(*f, &mut stream)).collect::<Result<Vec<_>, _>>()?;
            if frequencies_hz.iter().any(Option::is_some) {
                let settings = BTreeMap::new();
                let (std_hz, mode_shapes) = (None, None);
                let measured_at = *at;
                measurements.push(ModalMeasurement {
                    measured_at,
                    frequencies_hz,
                    std_hz,
                    mode_shapes,
                    covariates,
                    settings,
                });
            }
        }
        let without_modes = times.len() - measurements.len();
        Ok(Rehearsed { measurements, without_modes, beyond_effects })
    }

    fn check(&self, simulator: &Simulator) -> Result<(), Error> {
        if simulator.discrepancy().is_some() {
            return Err(Error::Discrepancy);
        }
        for effect in simulator.effects() {
            if let Some(covariate) = effect.law.covariate.as_ref().filter(|name| !self.covariates.contains_key(*name)) {
                return Err(Error::NoCourse { effect: effect.name.clone(), covariate: covariate.clone() });
            }
        }
        for change in &self.changes {
            if let Change::Covariate { covariate, .. } = change {
                if !matches!(self.covariates.get(covariate), Some(Course::Seasons { .. })) {
                    return Err(Error::NoNumber(covariate.clone()));
                }
            }
        }
        Ok(())
    }

    /// All covariates at each time. Each has its own random stream, so that one more covariate does not change the others.
    fn covariates_at(&self, times: &[Timestamp], seed: u64) -> Vec<BTreeMap<String, CovariateValue>> {
        let mut all = vec![BTreeMap::new(); times.len()];
        for (name, course) in &self.covariates {
            let mut stream = stats::stream(seed, &format!("covariate {name}"));
            for (found, value) in all.iter_mut().zip(course.values(times, &mut stream)) {
                found.insert(name.clone(), value);
            }
        }
        all
    }

    /// Applies all changes to the parameters `theta`, `[d]`, of a measurement at a time, given the time of the first measurement.
    fn change(
        &self,
        theta: &mut [f64],
        (at, first): (Timestamp, Timestamp),
        covariates: &BTreeMap<String, CovariateValue>,
    ) {
        for change in &self.changes {
            let (parameter, share) = match change {
                Change::Loss { parameter, share, from } => (*parameter, if at >= *from { -share } else { 0.0 }),
                Change::Trend { parameter, share_per_day } => {
                    (*parameter, share_per_day * (at.micros() - first.micros()) as f64 / DAY_MICROS)
                }
                Change::Covariate { parameter, covariate, share_per_unit } => {
                    let above = match (covariates.get(covariate), self.covariates.get(covariate)) {
                        (Some(CovariateValue::Number(value)), Some(Course::Seasons { mean, .. })) => value - mean,
                        _ => 0.0,
                    };
                    (*parameter, share_per_unit * above)
                }
            };
            theta[parameter] *= 1.0 + share;
        }
    }

    /// The frequency that is reported for a mode of `frequency_hz`; `None` if the mode is not identified.
    fn identified(&self, frequency_hz: f64, stream: &mut Stream) -> Result<Option<Hertz>, OutOfRange> {
        // The same number of draws for each mode, so that a larger probability adds outliers to those that were there.
        let (missing, outlier): (f64, f64) = (stream.random(), stream.random());
        let off: f64 = stream.sample(StandardNormal);
        if missing < self.missing {
            return Ok(None);
        }
        let factor = if outlier < self.outliers { (self.outlier_std * off).exp() } else { 1.0 };
        Hertz::new(frequency_hz * factor).map(Some)
    }
}

impl Course {
    /// The values at ascending times.
    fn values(&self, times: &[Timestamp], stream: &mut Stream) -> Vec<CovariateValue> {
        match self {
            Self::Categories(names) => times
                .iter()
                .map(|_| CovariateValue::Category(names[stream.random_range(0..names.len())].clone()))
                .collect(),
            Self::Seasons { mean, year, day, weather_std, lasting_days } => {
                let mut weather = weather_std * stream.sample::<f64, _>(StandardNormal);
                let mut before = times.first().copied();
                let mut value = |at: &Timestamp| {
                    let days = at.micros() as f64 / DAY_MICROS;
                    let gap = before.map_or(0.0, |before| days - before.micros() as f64 / DAY_MICROS);
                    let keep = (-gap / lasting_days).exp();
                    let jump: f64 = stream.sample(StandardNormal);
                    weather = keep * weather + weather_std * (1.0 - keep * keep).max(0.0).sqrt() * jump;
                    before = Some(*at);
                    let of_year = (TAU * (days - COLDEST_DAY) / YEAR_DAYS).cos();
                    let of_day = (TAU * (days - COLDEST_TIME)).cos();
                    CovariateValue::Number(mean - year * of_year - day * of_day + weather)
                };
                times.iter().map(&mut value).collect()
            }
        }
    }
}
