//! Diagnosis: which effect a simulation lacks, with what probability, and how much the predictions improve with it.
//!
//! [`diagnose`] fits the simulation to measurements, ranks every combination of target, law and covariate as a possible cause of
//! the deviations, and measures on rows held out what the causes gain.
//!
//! - [`data`]: measurements, covariates and settings by row; [`shapes`]: their mode shapes; [`holdout`]: the rows held out;
//! - [`grammar`]: the candidates; `missing_springs` and `cycle`: springs to add, and the times of day and year as
//!   covariates; [`effect`]: an effect whose numbers are fitted;
//! - [`model`]: the likelihood and its maximum, computed by `problem`, `row` and [`response`]; [`study`] and [`fit`]: its input
//!   and its result;
//! - [`screen`], [`rank`], [`mod@select`]: score tests, evidence, and forward selection of causes; `everywhere`: a simulation that is
//!   off by a little in all its parts, which every cause competes with, and `mixture`, its priors; `onset`: the time of a step;
//! - `mistaken_unit`: frequencies, masses and stiffnesses in another unit than stated; [`outside`]: settings outside their priors;
//!   `setting_candidates`, `setting_starts` and `corrected`: corrections of settings;
//! - [`misfit`]: deviations before and after; [`scatter`]: modes that scatter more than stated; [`mode_numbers`]: modes whose shapes
//!   are those of other modes;
//! - [`lasting`]: the test of all rows for a lasting change, and which rows may be used nevertheless; `most_probable`: a time with its interval;
//! - [`gain`]: errors before and after on rows held out, or left out in turn (`blocks`); `gain_words`: the same in sentences;
//!   [`mod@left_out_modes`]: errors of modes left out in turn, for constant causes;
//! - [`diagnosis`]: the result; [`describe`], `units`, `naming`, `notes` and [`chance`]: its text; [`report`]: the HTML page;
//! - [`next`]: the measurement that would decide between candidates; [`declared`] and `weighing`: what was done for it, as data;
//! - [`extend`]: a new version of the structure with the causes as effects;
//! - [`learned`]: a discrepancy learned from the data, where no cause explains the deviation.
//!
//! # Words
//!
//! | word | here |
//! |---|---|
//! | row | one measurement: its frequencies, covariates and settings |
//! | modes present | the modes that were measured in a row |
//! | outputs | what the simulation predicts for a row: ln f of each mode and, if shapes were measured, their coordinates |
//! | setting | value of a parameter that the experimenter set; a parameter that is not set in every row is free |
//! | cause | an effect that the simulation lacks; a candidate is a possible cause |
//! | numbers ψ | the coefficients of the law of an effect, and the tuning frequency of an oscillator |
//! | known effects | the effects that the structure file has already; they come first in every fit |
//! | spread | standard deviation of a parameter between rows |
//! | tails | degrees of freedom ν of the t distribution of the residuals |
//!
//! The frequencies cannot be computed where the structure is a mechanism, or where an effect leaves less than 2 % of a stiffness,
//! mass or frequency. A fit that needs them there returns `None`.

mod blocks;
pub mod chance;
mod corrected;
mod cycle;
pub mod data;
pub mod declared;
pub mod describe;
pub mod diagnosis;
pub mod effect;
mod everywhere;
pub mod extend;
pub mod fit;
pub mod gain;
mod gain_words;
pub mod grammar;
pub mod holdout;
pub mod lasting;
pub mod learned;
pub mod left_out_modes;
pub mod misfit;
mod missing_springs;
mod mistaken_unit;
mod mixture;
pub mod mode_numbers;
pub mod model;
mod most_probable;
mod naming;
pub mod next;
mod notes;
mod number_words;
mod onset;
pub mod outside;
mod problem;
pub mod progress;
pub mod rank;
pub mod report;
pub mod response;
mod row;
pub mod scatter;
pub mod screen;
pub mod select;
mod sentence;
mod setting_candidates;
mod setting_starts;
pub mod shapes;
pub mod study;
pub mod target_name;
mod units;
mod weighing;

pub use diagnosis::{Alternative, Diagnosis, DiagnosisVerdict, Outcome};
pub use holdout::Holdout;
pub use next::experiment::NextMeasurement;
pub use progress::{Progress, Step};

use blocks::Blocks;
use data::{Data, TIME};
use effect::FittedEffect;
use fit::Fit;
use gain::Unseen;
use grammar::candidates;
use lasting::found::LastingChange;
use lasting::usable::{Held, Split, FEWEST_BESIDE_HOLDOUT};
use lasting::Examined;
use learned::offer::Offered;
use left_out_modes::left_out_modes;
use misfit::{misfits, remainder, Remainder};
use mode_numbers::mode_numbers;
use naming::{name, Named};
use outside::outside_settings;
use scatter::{scatter, Scatter};
use select::{select, Selection, Slot};
use structures::physics::effect::Target;
use structures::simulator::Simulator;
use study::Study;

/// Smallest number of rows that a verdict can be based on.
pub const FEWEST_ROWS: usize = 8;

/// Share of the rows that may have a setting outside its prior after all corrections without changing the verdict.
const FEW_OUTSIDE: f64 = 0.05;

/// A remainder is reported if its p-value lies below this.
const REMAINDER: f64 = 1e-3;

/// A misfit is reported if its p-value lies below this.
const MISFIT_SHOWN: f64 = 0.01;

/// Why a diagnosis is not possible.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// Too few rows.
    #[error("{rows} measurements: a diagnosis needs at least {FEWEST_ROWS}")]
    TooFew {
        /// Number of rows.
        rows: usize,
    },
    /// The rows to hold out are not in the data.
    #[error("the hold-out {0}")]
    Holdout(String),
    /// The natural frequencies cannot be computed for parameters near the best fit.
    #[error("the simulation cannot be fitted to these data: its natural frequencies cannot be computed for parameters near the best fit")]
    NoFit,
    /// The frequencies, or the masses or stiffnesses of the structure file, are given in another unit.
    #[error("the frequencies are far from those of the simulation, and fit when {0}")]
    Unit(String),
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
/// If fewer than 30 rows would remain beside those held out, all rows are searched and the gain is measured by cross-validation.
///
/// All rows are tested for a lasting change in time that neither the causes found nor the recorded covariates nor the seasons explain
/// ([`lasting`]). The rows since then are used neither for causes nor for the gain, unless a change in time is among the causes.
///
/// # Errors
/// Fewer than 8 rows; a hold-out that names a column or category that the data do not have; frequencies in another unit than Hz; natural
/// frequencies that cannot be computed near the best fit; threads that cannot be started.
///
/// # Example
/// The second spring of a chain of three masses softens with temperature, which the structure file does not know:
///
/// ```
/// use std::collections::BTreeMap;
///
/// use discrepancy::data::Data;
/// use discrepancy::{diagnose, Holdout};
/// use structures::measurement::{CovariateValue, ModalMeasurement};
/// use structures::physics::effect::Target;
/// use structures::quantity::{Hertz, Timestamp};
/// use structures::simulator::definition::StructureDefinition;
/// use structures::simulator::Simulator;
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
    let (mut training, mut held) = holdout.split(data).map_err(Error::Holdout)?;
    if data.rows() < FEWEST_ROWS {
        return Err(Error::TooFew { rows: data.rows() });
    }
    if training.len() < FEWEST_BESIDE_HOLDOUT {
        (training, held) = ((0..data.rows()).collect(), Vec::new());
    }
    let threads = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    let pool = pool.map_err(|e| Error::Threads(e.to_string()))?;
    pool.install(|| run(simulator, data, Split::as_asked(training, held), seed, progress))
}

/// The search for causes, and the rows that it used.
struct Searched {
    selection: Selection,
    /// The lasting change; with `None`, why it was not looked for, if it was not.
    change: Option<LastingChange>,
    untested: Option<String>,
    split: Split,
}

/// Searches for causes, tests all rows for a lasting change, and searches again before it where rows after it were searched. `None`
/// if the frequencies cannot be computed.
fn search(
    simulator: &Simulator,
    study: &Study<'_>,
    known: &[FittedEffect],
    asked: Split,
    progress: &Progress<'_>,
) -> Option<Searched> {
    let data = study.data;
    let select = |rows: &[usize]| select(study, rows, known, &candidates(simulator, data, rows), progress);
    let selection = select(&asked.training)?;
    progress(Step::Comparing);
    let rows: Vec<usize> = (0..data.rows()).filter(|row| !data.further[*row]).collect();
    // Under the causes found, the frequencies may not exist in rows that were held out.
    let examined =
        lasting::examine(study, &rows, &selection.fit).unwrap_or_else(|| Examined::Untested(NO_STEP.to_owned()));
    let mut change = match examined {
        Examined::Changed(change) => change,
        Examined::Unchanged => return Some(Searched { selection, change: None, untested: None, split: asked }),
        Examined::Untested(why) => {
            return Some(Searched { selection, change: None, untested: Some(why), split: asked });
        }
    };
    let in_time = |slot: &Slot| slot.ranked[0].candidate.covariate.as_deref() == Some(TIME);
    let explained = selection.slots.iter().any(in_time);
    let split = asked.before(&change, explained, data);
    change.describe(data, &split.in_words(&change, explained));
    let selection = if split.training == asked.training { selection } else { select(&split.training)? };
    Some(Searched { selection, change: Some(*change), untested: None, split })
}

fn run(simulator: &Simulator, data: &Data, asked: Split, seed: u64, progress: &Progress<'_>) -> Result<Outcome, Error> {
    let bare = simulator.without_effects();
    let known = known_effects(simulator, data);
    let study = Study::new(&bare, data);
    progress(Step::Showing);
    mistaken_unit::suspected(&study, &asked.training, &known).map_or(Ok(()), |unit| Err(Error::Unit(unit)))?;
    let searched = search(simulator, &study, &known, asked, progress).ok_or(Error::NoFit)?;
    let Searched { selection, change, untested, split } = searched;
    let Split { training, holdout, set_aside, held } = split;
    let mut misfit = misfits(&study, &training, &selection.base).ok_or(Error::NoFit)?;
    let constant = Remainder::constant(&misfit, simulator.modes()).filter(|left| left.p_value < MISFIT_SHOWN);
    misfit.retain(|m| m.p_value < MISFIT_SHOWN);
    let share = selection.independent_share;
    let mut left = remainder(&study, &training, &selection.fit, share).ok_or(Error::NoFit)?;
    left = left.filter(|r| r.p_value < REMAINDER);
    let Scatter { excess: scatter, of_differences } = scatter(&study, &training, &selection.fit);
    if of_differences.is_some() && scatter.is_empty() && selection.slots.is_empty() && left.is_none() {
        left = constant;
    }
    let corrected = study.corrected_settings(&training, &selection.fit);
    let settings_outside = outside_settings(simulator, data, &training, &corrected);
    let many_outside = selection.fit.outside.rows as f64 > FEW_OUTSIDE * training.len() as f64;

    let Named { causes, alternatives, ambiguous, maybe_damage, next_measurements } =
        name(simulator, &study, &training, &selection, known.len());
    progress(Step::Measuring);
    let mut notes = notes::of_change(change.as_ref(), untested);
    notes.extend(notes::notes(&study, &training, &selection.fit, of_differences.as_ref(), share));
    let gain = measured_gain(&study, (&training, &holdout, held), &selection, seed, &mut notes);
    let left_out_modes = left_out_modes(&study, &training, (&selection.base, &selection.fit), known.len());
    let unexplained = left.is_some() || many_outside;
    let verdict = verdict(&selection.slots, ambiguous, unexplained, !scatter.is_empty());
    // Beside a lasting change in the rows, which may be damage, a deviation is not accepted.
    let changes = change.is_some() && set_aside.is_empty();
    let everywhere = (verdict == DiagnosisVerdict::Distributed && !changes).then_some(&selection.fit);
    let offered = if verdict == DiagnosisVerdict::NoneOfThese || everywhere.is_some() {
        offered(&study, (&training, &holdout), &selection.base, everywhere, &mut notes)
    } else {
        None
    };
    let mut diagnosis = Diagnosis {
        structure: simulator.id().to_string(),
        verdict,
        summary: String::new(),
        lasting_change: change,
        settings_outside,
        mode_numbers: mode_numbers(&study, &selection.fit),
        scatter,
        misfit,
        causes,
        alternatives,
        next_measurements,
        remainder: left,
        gain,
        left_out_modes,
        learned: offered.as_ref().map(|offered| offered.offer.clone()),
        notes,
        training_rows: training.len(),
        holdout_rows: holdout.len(),
        set_aside_rows: set_aside.len(),
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
        set_aside,
        offered,
    })
}

/// The gain of the causes; `None` without a cause, or, with a note, where it cannot be measured.
fn measured_gain(
    study: &Study<'_>,
    (training, holdout, held): (&[usize], &[usize], Held),
    selection: &Selection,
    seed: u64,
    notes: &mut Vec<String>,
) -> Option<gain::Gain> {
    if selection.slots.is_empty() {
        return None;
    }
    if held == Held::Nothing {
        notes.push(NO_ROWS.to_owned());
        return None;
    }
    let blocks = Blocks::new(study.data, training);
    let unseen = if holdout.len() >= 2 { Unseen::HeldOut(holdout) } else { Unseen::LeftOut(&blocks) };
    let gain = gain::gain(study, training, &unseen, (&selection.base, &selection.fit), seed);
    match &gain {
        Some(gain) => notes.extend(gain_words::notes(gain)),
        None => notes.push(NO_GAIN.to_owned()),
    }
    gain
}

/// The discrepancy that could be learned; `None`, with a note, if none can.
fn offered(
    study: &Study<'_>,
    (training, holdout): (&[usize], &[usize]),
    base: &Fit,
    everywhere: Option<&Fit>,
    notes: &mut Vec<String>,
) -> Option<Offered> {
    let offered = learned::offer::offer(study, training, holdout, base, everywhere);
    offered.map_err(|why| notes.push(format!("the deviation cannot be predicted either: {why}"))).ok()
}

/// The effects of the structure, then the known masses that were hung.
fn known_effects(simulator: &Simulator, data: &Data) -> Vec<FittedEffect> {
    let hung = data.hung.iter().map(|(dof, column)| FittedEffect::hung(*dof, &column.name));
    simulator.effects().iter().map(FittedEffect::known).chain(hung).collect()
}

/// The verdict for the causes found, whether one of them is ambiguous, whether a deviation remains that they do not explain, and
/// whether the rows scatter more than noise and spread explain.
fn verdict(causes: &[Slot], ambiguous: bool, remainder: bool, scatter: bool) -> DiagnosisVerdict {
    let everywhere = |slot: &Slot| matches!(slot.ranked[0].candidate.target, Target::Everywhere(_));
    match causes {
        _ if remainder => DiagnosisVerdict::NoneOfThese,
        // How its modes follow the parameters is off as well, so that they may scatter more.
        [only] if everywhere(only) && !ambiguous => DiagnosisVerdict::Distributed,
        _ if scatter => DiagnosisVerdict::UnexplainedScatter,
        [] => DiagnosisVerdict::NothingFound,
        [_] if ambiguous => DiagnosisVerdict::Ambiguous,
        [_] => DiagnosisVerdict::Cause,
        _ => DiagnosisVerdict::Several,
    }
}

/// Why a lasting change is not looked for under causes that cannot be extrapolated.
const NO_STEP: &str = "with the causes found, a stiffness or mass would not be positive in some of them";

/// The note where no rows are left to measure the gain on.
const NO_ROWS: &str =
    "too few rows lie before the change in time to measure the gain on: what was found may be a part of that change";

/// The note that says why the gain was not measured.
const NO_GAIN: &str = "the causes cannot be extrapolated to the rows they were not fitted to, because at their covariates a stiffness or mass \
                       would not be positive: the gain is not measured";
