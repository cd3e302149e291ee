//! Diagnosis: which effect a simulation lacks, with what probability, and how much the predictions improve with it.
//!
//! [`diagnose`] fits the simulation to measurements, ranks every combination of target, law and covariate as a possible cause of
//! the deviations, and measures on rows held out what the causes gain.
//!
//! - [`data`]: measurements, covariates and settings by row; [`holdout`]: the rows held out;
//! - [`grammar`]: the candidates; [`effect`]: an effect whose numbers are fitted;
//! - [`model`]: the likelihood and its maximum, computed by `problem`, `row` and [`response`]; [`study`] and [`fit`]: its input
//!   and its result;
//! - [`screen`], [`rank`], [`mod@select`]: score tests, evidence, and forward selection of causes;
//! - [`misfit`]: deviations before and after; [`gain`]: errors before and after on rows held out;
//! - [`diagnosis`]: the result; [`describe`], `naming`, `discriminate` and `notes`: its text; [`report`]: the HTML page;
//! - [`extend`]: a new version of the structure with the causes as effects;
//! - [`learned`]: a discrepancy learned from the data, where no cause explains the deviation.
//!
//! # Words
//!
//! | word | here |
//! |---|---|
//! | row | one measurement: its frequencies, covariates and settings |
//! | modes present | the modes that were measured in a row |
//! | setting | value of a parameter that the experimenter set; a parameter that is not set in every row is free |
//! | cause | an effect that the simulation lacks; a candidate is a possible cause |
//! | numbers ψ | the coefficients of the law of an effect, and the tuning frequency of an oscillator |
//! | known effects | the effects that the structure file has already; they come first in every fit |
//! | spread | standard deviation of a parameter between rows |
//! | tails | degrees of freedom ν of the t distribution of the residuals |
//!
//! The frequencies cannot be computed where the structure is a mechanism, or where an effect leaves less than 2 % of a stiffness,
//! mass or frequency. A fit that needs them there returns `None`.

pub mod data;
pub mod describe;
pub mod diagnosis;
mod discriminate;
pub mod effect;
pub mod extend;
pub mod fit;
pub mod gain;
pub mod grammar;
pub mod holdout;
pub mod learned;
pub mod misfit;
pub mod model;
mod naming;
mod notes;
mod problem;
pub mod progress;
pub mod rank;
pub mod report;
pub mod response;
mod row;
pub mod screen;
pub mod select;
pub mod study;

pub use diagnosis::{Alternative, Diagnosis, DiagnosisVerdict, Outcome};
pub use holdout::Holdout;
pub use progress::{Progress, Step};

use crate::simulator::Simulator;
use data::Data;
use effect::FittedEffect;
use grammar::candidates;
use misfit::{misfits, remainder, Remainder};
use naming::{name, Named};
use select::select;
use study::Study;

/// Smallest number of rows that a verdict can be based on.
const FEWEST_ROWS: usize = 30;

/// A remainder is reported if its p-value lies below this, without and with causes.
const REMAINDER: f64 = 1e-3;
const REMAINDER_WITH_CAUSES: f64 = 1e-4;

/// A misfit is reported if its p-value lies below this.
const MISFIT_SHOWN: f64 = 0.01;

/// Why a diagnosis is not possible.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// Too few rows.
    #[error(
        "{rows} measurements remain for the search for causes ({held_out} are held out): a verdict needs at least {FEWEST_ROWS}"
    )]
    TooFew {
        /// Rows left for the search.
        rows: usize,
        /// Rows held out.
        held_out: usize,
    },
    /// The rows to hold out are not in the data.
    #[error("the hold-out {0}")]
    Holdout(String),
    /// The natural frequencies cannot be computed for parameters near the best fit.
    #[error("the simulation cannot be fitted to these data: its natural frequencies cannot be computed for parameters near the best fit")]
    NoFit,
    /// Threads cannot be started.
    #[error("the threads to compute on cannot be started: {0}")]
    Threads(String),
}

/// Finds the effects that a simulation lacks to explain measurements, with their probabilities and their gain on rows held out.
///
/// Causes are found by forward selection on the rows that are not held out. Each candidate is a [`FittedEffect`] that is fitted
/// together with the free parameters of the structure, and compared by its evidence (see [`model`] for the likelihood and
/// [`rank::rank`] for the probabilities). The seed only affects the bootstrap intervals of the gain. `progress` is called at
/// each step.
///
/// # Errors
/// Fewer than 30 rows to search; a hold-out that names a column or category that the data do not have; natural frequencies
/// that cannot be computed near the best fit; threads that cannot be started.
///
/// # Example
/// The second spring of a chain of three masses softens with temperature, which the structure file does not know:
///
/// ```
/// use std::collections::BTreeMap;
///
/// use modalwatch::discrepancy::data::Data;
/// use modalwatch::discrepancy::{diagnose, Holdout};
/// use modalwatch::measurement::{CovariateValue, ModalMeasurement};
/// use modalwatch::physics::effect::Target;
/// use modalwatch::quantity::{Hertz, Timestamp};
/// use modalwatch::simulator::definition::StructureDefinition;
/// use modalwatch::simulator::Simulator;
///
/// let chain = r#"
///     id = "chain"
///     modes = 3
///     measurement_noise = { relative = 0.001 }
///     mass = [{ name = "m1", kg = 1.0 }, { name = "m2", kg = 1.2 }, { name = "m3", kg = 0.8 }]
///     spring = [
///         { name = "k1", from = "ground", to = "m1", n_per_m = 4000.0 },
///         { name = "k2", from = "m1", to = "m2", n_per_m = 3000.0 },
///         { name = "k3", from = "m2", to = "m3", n_per_m = 2000.0 },
///     ]
///     parameter = [{ name = "k1", prior = { uniform = [2000.0, 6000.0] }, sets = { spring = "k1" } }]
///     covariate = [{ name = "temperature_c" }]
/// "#;
/// let simulator = Simulator::new(StructureDefinition::parse_toml(chain)?)?;
/// let mut measurements = Vec::new();
/// for hour in 0..48 {
///     let temperature_c = 10.0 + 8.0 * (2.399 * f64::from(hour)).sin();
///     let softening = Target::Springs(vec![1]);
///     let response = simulator.respond(&[4000.0], 3, &[softening], &[-0.01 * (temperature_c - 10.0)])?;
///     let noise = |mode: usize| 1.0 + 0.001 * (f64::from(37 * hour) * (1.3 + mode as f64)).sin();
///     let frequencies = response.frequencies_hz.iter().enumerate();
///     measurements.push(ModalMeasurement {
///         measured_at: Timestamp::from_micros(3_600_000_000 * i64::from(hour))?,
///         frequencies_hz: frequencies.map(|(mode, hz)| Hertz::new(hz * noise(mode)).map(Some)).collect::<Result<_, _>>()?,
///         std_hz: None,
///         mode_shapes: None,
///         covariates: BTreeMap::from([("temperature_c".to_owned(), CovariateValue::Number(temperature_c))]),
///         settings: BTreeMap::new(),
///     });
/// }
/// let data = Data::new(&simulator, &measurements);
/// let outcome = diagnose(&simulator, &data, &Holdout::Last(0.25), 1, &|step| println!("{step}"))?;
///
/// let cause = &outcome.diagnosis.causes[0];
/// println!("{}", outcome.diagnosis.summary);
/// assert_eq!(cause.target.name, "k2");
/// assert_eq!(cause.covariate.as_deref(), Some("temperature_c"));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn diagnose(
    simulator: &Simulator,
    data: &Data,
    holdout: &Holdout,
    seed: u64,
    progress: &Progress<'_>,
) -> Result<Outcome, Error> {
    let (training, held) = holdout.split(data).map_err(Error::Holdout)?;
    if training.len() < FEWEST_ROWS {
        return Err(Error::TooFew { rows: training.len(), held_out: held.len() });
    }
    let threads = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    let pool = pool.map_err(|e| Error::Threads(e.to_string()))?;
    pool.install(|| run(simulator, data, training, held, seed, progress))
}

fn run(
    simulator: &Simulator,
    data: &Data,
    training: Vec<usize>,
    holdout: Vec<usize>,
    seed: u64,
    progress: &Progress<'_>,
) -> Result<Outcome, Error> {
    let bare = simulator.without_effects();
    let known: Vec<FittedEffect> = simulator.effects().iter().map(FittedEffect::known).collect();
    let study = Study::new(&bare, data);
    progress(Step::Showing);
    let candidates = candidates(simulator, data, &training);
    let selection = select(&study, &training, &known, &candidates, progress).ok_or(Error::NoFit)?;
    let mut misfit = misfits(&study, &training, &selection.base).ok_or(Error::NoFit)?;
    misfit.retain(|m| m.p_value < MISFIT_SHOWN);
    let share = selection.independent_share;
    let left = remainder(&study, &training, &selection.fit, share).ok_or(Error::NoFit)?;
    let found = !selection.slots.is_empty();
    let limit = if found { REMAINDER_WITH_CAUSES } else { REMAINDER };
    let left = left.filter(|r| r.p_value < limit);

    let Named { causes, alternatives, ambiguous, maybe_damage } = name(simulator, data, &selection, known.len());
    progress(Step::Measuring);
    let gain = if found && holdout.len() >= 2 {
        gain::gain(&study, &training, &holdout, &selection.base, &selection.fit, seed)
    } else {
        None
    };
    let mut notes = notes::notes(simulator, data, &training, &selection.fit, share);
    if found && gain.is_none() {
        notes.push(why_no_gain(holdout.len()).to_owned());
    }
    let verdict = verdict(selection.slots.len(), ambiguous, left.as_ref());
    let offered = if verdict == DiagnosisVerdict::NoneOfThese {
        let offered = learned::offer::offer(&study, &training, &holdout, &selection.base);
        offered.map_err(|why| notes.push(format!("the deviation cannot be predicted either: {why}"))).ok()
    } else {
        None
    };
    let mut diagnosis = Diagnosis {
        structure: simulator.id().to_string(),
        verdict,
        summary: String::new(),
        misfit,
        causes,
        alternatives,
        remainder: left,
        gain,
        learned: offered.as_ref().map(|offered| offered.offer.clone()),
        notes,
        training_rows: training.len(),
        holdout_rows: holdout.len(),
        candidates: selection.tried,
        independent_share: share,
        seed,
        data_digest: data.digest.clone(),
        structure_digest: simulator.digest().clone(),
    };
    diagnosis.summary = diagnosis.in_words();
    let chosen = selection.slots.into_iter().map(|slot| slot.ranked.into_iter().next()).collect::<Option<Vec<_>>>();
    Ok(Outcome {
        diagnosis,
        before: selection.base,
        after: selection.fit,
        causes: chosen.unwrap_or_default(),
        maybe_damage,
        holdout,
        training,
        offered,
    })
}

/// The verdict for a number of causes, whether one of them is ambiguous, and a deviation that they do not explain.
fn verdict(causes: usize, ambiguous: bool, remainder: Option<&Remainder>) -> DiagnosisVerdict {
    match causes {
        _ if remainder.is_some() => DiagnosisVerdict::NoneOfThese,
        0 => DiagnosisVerdict::NothingFound,
        1 if ambiguous => DiagnosisVerdict::Ambiguous,
        1 => DiagnosisVerdict::Cause,
        _ => DiagnosisVerdict::Several,
    }
}

/// The note that says why the gain was not measured.
fn why_no_gain(held_out: usize) -> &'static str {
    if held_out < 2 {
        "no rows are held out: the gain is not measured"
    } else {
        "the causes cannot be extrapolated to the rows held out, because at their covariates a stiffness or mass would not be positive: \
         the gain is not measured"
    }
}
