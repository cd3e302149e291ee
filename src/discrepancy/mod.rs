//! What the simulation gets wrong: show it, name the cause, measure what naming it gains.
//!
//! [`data`] holds the rows, [`grammar`] what could be wrong, [`model`] the likelihood, `row` that of one row, [`screen`] quick tests of every
//! candidate, [`mod@select`] the choice among them, [`misfit`] what is odd before and after, [`gain`] what the extension is
//! worth on rows that nothing has seen, [`describe`] the words, [`report`] the page, [`extend`] the structure with the causes.

pub mod data;
pub mod describe;
pub mod extend;
pub mod gain;
pub mod grammar;
pub mod misfit;
pub mod model;
pub mod report;
pub mod response;
mod row;
pub mod screen;
pub mod select;

use serde::{Deserialize, Serialize};

use crate::quantity::{shown, Digest};
use crate::simulator::Simulator;
use data::{Data, Values, TIME};
use describe::Cause;
use gain::Gain;
use grammar::{candidates, spread, Class};
use misfit::{misfits, remainder, Misfit, Remainder};
use model::{Effect, Fit, Study};
use select::{select, Ranked, Selection};

/// Fewest rows that a verdict can stand on.
const FEWEST_ROWS: usize = 30;

/// A cause is named alone above this probability.
const SURE: f64 = 0.9;

/// Alternatives are named until their probabilities sum to this, at most so many.
const COVERED: f64 = 0.985;
const MOST_NAMED: usize = 3;

/// Alternatives reported beside those that are named.
const MOST_ALTERNATIVES: usize = 5;

/// Beyond those, all that are nearly as probable, up to this many.
const NEARLY_NATS: f64 = 5.0;
const MOST_NEARLY: usize = 20;

/// A remainder counts below these probabilities of chance, without and with causes found.
const REMAINDER: f64 = 1e-3;
const REMAINDER_WITH_CAUSES: f64 = 1e-4;

/// A misfit is told below this probability of chance.
const MISFIT_SHOWN: f64 = 0.01;

/// Two covariates that correlate more than this are named as one.
const COLLINEAR: f64 = 0.98;

/// What was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = DiagnosisVerdict)]
pub enum Verdict {
    /// One cause, nearly sure.
    Cause,
    /// More than one cause at once.
    Several,
    /// One of a few causes that these data cannot tell apart.
    Ambiguous,
    /// Something is wrong that no cause of the grammar explains.
    NoneOfThese,
    /// The simulation explains the data.
    NothingFound,
}

/// A cause that was not chosen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Alternative {
    /// The cause.
    #[serde(flatten)]
    pub cause: Cause,
    /// Number, from 1, of the cause that it would stand for.
    pub instead_of: usize,
    /// Its ln evidence minus that of the chosen one, prior included, nats.
    pub log_evidence_difference: f64,
    /// A measurement that would tell the two apart.
    pub told_apart_by: String,
}

/// The answer to "what does the simulation get wrong?".
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Diagnosis {
    /// The structure.
    pub structure: String,
    /// What was found.
    pub verdict: Verdict,
    /// The answer in one or a few sentences.
    pub summary: String,
    /// Where the simulation as it is deviates, the clearest first.
    pub misfit: Vec<Misfit>,
    /// The causes; with an ambiguous verdict the few that it may be.
    pub causes: Vec<Cause>,
    /// What else it may be.
    pub alternatives: Vec<Alternative>,
    /// What no cause explains.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub remainder: Option<Remainder>,
    /// What the causes gain on rows held out; `null` when nothing was found.
    pub gain: Option<Gain>,
    /// What the reader must know about the data.
    pub notes: Vec<String>,
    /// Rows that causes were looked for in.
    pub training_rows: usize,
    /// Rows held out.
    pub holdout_rows: usize,
    /// Targets × laws × covariates that were considered.
    pub candidates: usize,
    /// Share of the rows that are worth independent ones.
    pub independent_share: f64,
    /// Seed of the bootstrap.
    pub seed: u64,
    /// Digest of the measurements.
    pub data_digest: Digest,
    /// Digest of the structure.
    pub structure_digest: Digest,
}

/// A diagnosis and the fits behind it.
pub struct Outcome {
    /// The answer.
    pub diagnosis: Diagnosis,
    /// The simulation as it is.
    pub before: Fit,
    /// With the causes: after the effects that the structure has, those of `causes`.
    pub after: Fit,
    /// The chosen candidates.
    pub causes: Vec<Ranked>,
    /// Whether a change of stiffness with time is among what each of them may be instead.
    pub maybe_damage: Vec<bool>,
    /// Rows held out.
    pub holdout: Vec<usize>,
    /// Rows that causes were looked for in.
    pub training: Vec<usize>,
}

/// Where a diagnosis is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    /// The simulation as it is is fitted.
    Showing,
    /// A further cause is looked for.
    Searching {
        /// From 1.
        cause: usize,
        /// At most.
        of: usize,
    },
    /// A cause is looked for again with the others in place.
    LookingAgain {
        /// From 1.
        cause: usize,
        /// Causes found.
        of: usize,
    },
    /// The gain is measured.
    Measuring,
}

impl std::fmt::Display for Step {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Showing => f.write_str("fitting the simulation as it is"),
            Self::Searching { cause, of } => write!(f, "looking for cause {cause} of at most {of}"),
            Self::LookingAgain { cause, of } => write!(f, "looking again at cause {cause} of {of}"),
            Self::Measuring => f.write_str("measuring the gain"),
        }
    }
}

/// Called at each step.
pub type Progress<'a> = dyn Fn(Step) + Sync + 'a;

/// Which rows are kept for measuring the gain; written `last:0.25` or `where:lab=de`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Holdout {
    /// The last share of the rows in time.
    Last(f64),
    /// Rows where a category has a value.
    Where {
        /// Covariate.
        covariate: String,
        /// Category.
        level: String,
    },
}

impl std::str::FromStr for Holdout {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || format!("{} must read last:0.25, a share below 1, or where:lab=de", shown(text));
        match text.split_once(':') {
            Some(("last", share)) => {
                let share: f64 = share.parse().map_err(|_| wrong())?;
                (0.0..1.0).contains(&share).then_some(Self::Last(share)).ok_or_else(wrong)
            }
            Some(("where", rest)) => {
                let (covariate, level) = rest.split_once('=').ok_or_else(wrong)?;
                Ok(Self::Where { covariate: covariate.to_owned(), level: level.to_owned() })
            }
            _ => Err(wrong()),
        }
    }
}

/// Why there is no diagnosis.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// Too few rows.
    #[error(
        "{rows} measurements to look for causes in ({held_out} are held out): a verdict needs at least {FEWEST_ROWS}"
    )]
    TooFew {
        /// Rows there are.
        rows: usize,
        /// Rows held out beside them.
        held_out: usize,
    },
    /// The hold-out cannot be made.
    #[error("the hold-out {0}")]
    Holdout(String),
    /// The structure has no frequencies where the data put it.
    #[error("the simulation cannot be fitted to these data: no frequencies at any parameters near them")]
    NoFit,
    /// Threads cannot be started.
    #[error("no threads to compute on: {0}")]
    Threads(String),
}

/// Shows, names and measures.
///
/// # Errors
/// [`Error`].
pub fn diagnose(
    simulator: &Simulator,
    data: &Data,
    holdout: &Holdout,
    seed: u64,
    progress: &Progress<'_>,
) -> Result<Outcome, Error> {
    let (training, held) = split(data, holdout)?;
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
    let known: Vec<Effect> = simulator.effects().iter().map(Effect::known).collect();
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
    let verdict = match selection.slots.len() {
        _ if left.is_some() => Verdict::NoneOfThese,
        0 => Verdict::NothingFound,
        1 if ambiguous => Verdict::Ambiguous,
        1 => Verdict::Cause,
        _ => Verdict::Several,
    };
    progress(Step::Measuring);
    let gain = if found && holdout.len() >= 2 {
        gain::gain(&study, &training, &holdout, &selection.base, &selection.fit, seed)
    } else {
        None
    };
    let mut notes = notes(simulator, data, &training, &selection.fit, share);
    if found && gain.is_none() {
        notes.push(if holdout.len() < 2 {
            "no rows are held out: the gain is not measured".to_owned()
        } else {
            "the causes cannot be carried to the rows held out, whose covariates leave no stiffness or mass: the gain is not \
             measured"
                .to_owned()
        });
    }
    let mut diagnosis = Diagnosis {
        structure: simulator.id().to_string(),
        verdict,
        summary: String::new(),
        misfit,
        causes,
        alternatives,
        remainder: left,
        gain,
        notes,
        training_rows: training.len(),
        holdout_rows: holdout.len(),
        candidates: selection.tried,
        independent_share: share,
        seed,
        data_digest: data.digest.clone(),
        structure_digest: simulator.digest().clone(),
    };
    diagnosis.summary = summary(&diagnosis);
    let chosen = selection.slots.into_iter().map(|slot| slot.ranked.into_iter().next()).collect::<Option<Vec<_>>>();
    Ok(Outcome {
        diagnosis,
        before: selection.base,
        after: selection.fit,
        causes: chosen.unwrap_or_default(),
        maybe_damage,
        holdout,
        training,
    })
}

/// The slots of a selection in words.
struct Named {
    causes: Vec<Cause>,
    alternatives: Vec<Alternative>,
    ambiguous: bool,
    maybe_damage: Vec<bool>,
}

/// Names the causes and their alternatives; the structure has `known` effects already.
fn name(simulator: &Simulator, data: &Data, selection: &Selection, known: usize) -> Named {
    let bare = simulator.without_effects();
    let mut all = Named { causes: Vec::new(), alternatives: Vec::new(), ambiguous: false, maybe_damage: Vec::new() };
    for (index, slot) in selection.slots.iter().enumerate() {
        let best = &slot.ranked[0];
        let described = |r: &Ranked| {
            // The chosen one is described by the final fit, the others by their own.
            let (fit, place) =
                if std::ptr::eq(r, best) { (&selection.fit, known + index) } else { (&r.fit, r.fit.effects.len() - 1) };
            describe::cause(simulator, data, r, fit, place, selection.independent_share)
        };
        let unsure = best.probability <= SURE;
        all.ambiguous |= unsure;
        let named = if unsure { named(&slot.ranked) } else { vec![0] };
        let damage = |place: &usize| slot.ranked[*place].candidate.class == Class::PossibleDamage;
        all.maybe_damage.push(unsure && named.iter().any(damage));
        all.causes.push(described(best));
        if selection.slots.len() == 1 {
            all.causes.extend(named.iter().skip(1).map(|place| described(&slot.ranked[*place])));
        }
        for (place, other) in slot.ranked.iter().enumerate().skip(1) {
            let near = place <= MOST_NEARLY && other.log_odds > best.log_odds - NEARLY_NATS;
            if near || named.contains(&place) || place <= MOST_ALTERNATIVES {
                all.alternatives.push(Alternative {
                    cause: described(other),
                    instead_of: index + 1,
                    log_evidence_difference: other.log_odds - best.log_odds,
                    told_apart_by: told_apart(&bare, data, best, other),
                });
            }
        }
    }
    all
}

/// Places of the candidates that an unsure answer names: the best of each set of exact equivalents first, until they cover
/// nearly all of the probability; then, where there is room, their equivalents.
fn named(ranked: &[Ranked]) -> Vec<usize> {
    let equivalent = |a: &Ranked, b: &Ranked| {
        let same = (&a.candidate.covariate, &a.candidate.level) == (&b.candidate.covariate, &b.candidate.level);
        same && a.candidate.acts_on_all() && b.candidate.acts_on_all()
    };
    let mut places: Vec<usize> = Vec::new();
    let mut covered = 0.0;
    for (place, r) in ranked.iter().enumerate() {
        if places.len() == MOST_NAMED || covered >= COVERED {
            break;
        }
        if !places.iter().any(|p| equivalent(&ranked[*p], r)) {
            places.push(place);
            covered +=
                ranked.iter().filter(|o| std::ptr::eq(*o, r) || equivalent(o, r)).map(|o| o.probability).sum::<f64>();
        }
    }
    for (place, r) in ranked.iter().enumerate() {
        let further = !places.contains(&place) && places.iter().any(|p| equivalent(&ranked[*p], r));
        if places.len() < MOST_NAMED && further {
            places.push(place);
        }
    }
    places
}

fn split(data: &Data, holdout: &Holdout) -> Result<(Vec<usize>, Vec<usize>), Error> {
    let all = 0..data.rows();
    match holdout {
        Holdout::Last(share) => {
            if !(0.0..1.0).contains(share) {
                return Err(Error::Holdout(format!("last:{share} must keep a share from 0 to below 1")));
            }
            let first = data.rows() - (share * data.rows() as f64).round() as usize;
            Ok((all.clone().take(first).collect(), all.skip(first).collect()))
        }
        Holdout::Where { covariate, level } => {
            let column = data.column(covariate).ok_or_else(|| {
                let names: Vec<&str> = data.columns.iter().map(|c| c.name.as_str()).collect();
                Error::Holdout(format!("names the column {covariate}: there are {}", names.join(", ")))
            })?;
            let Values::Categories(names, indices) = &column.values else {
                return Err(Error::Holdout(format!(
                    "names the column {covariate}, which holds numbers: name a category"
                )));
            };
            let Some(wanted) = names.iter().position(|n| n == level) else {
                let names = names.join(", ");
                return Err(Error::Holdout(format!("asks for {covariate} = {level}: its categories are {names}")));
            };
            Ok(all.partition(|row| indices[*row] != Some(wanted)))
        }
    }
}

/// What the reader must know about the data: covariates that say nothing or the same, modes that are never there, settings
/// outside the prior.
fn notes(simulator: &Simulator, data: &Data, rows: &[usize], fit: &Fit, share: f64) -> Vec<String> {
    let mut notes = Vec::new();
    for mode in 0..simulator.modes() {
        let measured = rows.iter().filter(|r| data.log_frequencies[**r][mode].is_finite()).count();
        if measured == 0 {
            notes.push(format!("mode {} was never measured: nothing can be said about it", mode + 1));
        } else if measured * 4 < rows.len() {
            notes.push(format!("mode {} was measured in {measured} of {} rows only", mode + 1, rows.len()));
        }
    }
    let mut numeric: Vec<(&str, Vec<f64>)> = Vec::new();
    for column in &data.columns {
        let name = &column.name;
        match &column.values {
            Values::Numbers(values) => {
                let known = column.numbers(rows);
                if spread(column, rows) <= 0.0 {
                    notes.push(match known.first() {
                        Some(value) => format!("{name} is {value} in every row: no effect of it can be found"),
                        None => format!("{name} is never given: no effect of it can be found"),
                    });
                    continue;
                }
                if known.len() < rows.len() {
                    let missing = rows.len() - known.len();
                    notes.push(format!(
                        "{name} is missing in {missing} of {} rows: its effects count as their level there",
                        rows.len()
                    ));
                }
                let mean = crate::stats::mean(&known);
                let filled: Vec<f64> =
                    rows.iter().map(|r| if values[*r].is_finite() { values[*r] } else { mean }).collect();
                for (other, values) in &numeric {
                    let r = correlation(values, &filled);
                    if r.abs() > COLLINEAR {
                        notes.push(format!(
                            "{other} and {name} go together (correlation {r:.3}): these data cannot tell which of the two acts"
                        ));
                    }
                }
                numeric.push((name, filled));
            }
            Values::Categories(names, indices) => {
                let mut used: Vec<usize> = rows.iter().filter_map(|r| indices[*r]).collect();
                used.sort_unstable();
                used.dedup();
                if used.len() == 1 {
                    notes.push(format!(
                        "{name} is {} in every row: no difference between its categories can be found",
                        names[used[0]]
                    ));
                } else if used.len() > data::MOST_LEVELS {
                    notes.push(format!(
                        "{name} has {} categories: more than {} are not looked at",
                        used.len(),
                        data::MOST_LEVELS
                    ));
                }
            }
        }
    }
    for (k, p) in simulator.space().iter().enumerate() {
        let set: Vec<f64> = rows.iter().filter_map(|r| data.settings[*r][k]).collect();
        let outside = set.iter().filter(|v| !p.prior().contains(*v)).count();
        if outside > 0 {
            notes.push(format!("{outside} settings of {} lie outside its prior, {} to {}", p.name, p.lower, p.upper));
        }
    }
    for &k in &fit.free {
        let p = &simulator.space().as_slice()[k];
        if !p.prior().contains(&fit.mean[k]) {
            notes.push(format!(
                "{} comes out at {:.4} {}, beyond its prior ({} to {}): units, the nominal values or the simulation are far off",
                p.name, fit.mean[k], p.unit, p.lower, p.upper
            ));
        }
    }
    for (mode, factor) in fit.noise_factor.iter().enumerate() {
        if *factor > 2.0 {
            notes.push(format!(
                "mode {} scatters {factor:.1} times as much as its stated noise, beyond what the spread of the parameters \
                 explains",
                mode + 1
            ));
        }
    }
    if share < 0.9 {
        notes.push(format!(
            "residuals follow one another in time: the rows count as {:.0} % of as many independent ones",
            100.0 * share
        ));
    }
    if rows.len() < 100 {
        notes.push(format!("{} rows are few: small effects stay hidden", rows.len()));
    }
    notes
}

fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let (ma, mb) = (crate::stats::mean(a), crate::stats::mean(b));
    let sum = |x: &[f64], mx: f64, y: &[f64], my: f64| x.iter().zip(y).map(|(x, y)| (x - mx) * (y - my)).sum::<f64>();
    sum(a, ma, b, mb) / (sum(a, ma, a, ma) * sum(b, mb, b, mb)).sqrt()
}

/// Modes beyond those measured that may be worth measuring.
const FURTHER_MODES: usize = 5;

/// What would tell two causes apart.
fn told_apart(simulator: &Simulator, data: &Data, a: &Ranked, b: &Ranked) -> String {
    let (ca, cb) = (&a.candidate, &b.candidate);
    if ca.covariate != cb.covariate {
        return match (&ca.covariate, &cb.covariate) {
            (Some(a), Some(b)) => format!("measurements in which {a} and {b} do not go together"),
            (Some(one), None) | (None, Some(one)) => format!("measurements over a wider range of {one}"),
            (None, None) => unreachable!("they differ"),
        };
    }
    let count = simulator.available_modes().min(simulator.modes() + FURTHER_MODES);
    if count > simulator.modes() && a.fit.effects.len() == b.fit.effects.len() {
        if let (Some(fa), Some(fb)) = (extreme(simulator, data, &a.fit, count), extreme(simulator, data, &b.fit, count))
        {
            let best = (simulator.modes()..count).map(|m| (m, 100.0 * (fa[m] / fb[m] - 1.0).abs()));
            if let Some((mode, percent)) = best.max_by(|x, y| x.1.total_cmp(&y.1)).filter(|b| b.1 > 0.1) {
                return format!("mode {}, which they put {percent:.1} % apart at the extremes of these data", mode + 1);
            }
        }
    }
    let instrument = |c: &grammar::Candidate| c.class == Class::Instrument;
    if instrument(ca) != instrument(cb) {
        return "a second instrument beside the first: an instrument's fault shows in one of them only".to_owned();
    }
    let mass = |c: &grammar::Candidate| matches!(c.target, crate::physics::effect::Target::Masses(_));
    if mass(ca) != mass(cb) {
        return "weighing, or a static load test, which sees stiffness and no mass".to_owned();
    }
    "mode shapes, or a further mode".to_owned()
}

/// Frequencies of a fit, all modes, at the row where its last effect is largest.
fn extreme(simulator: &Simulator, data: &Data, fit: &Fit, modes: usize) -> Option<Vec<f64>> {
    let last = fit.effects.len().checked_sub(1)?;
    let targets: Vec<_> = fit.effects.iter().map(|e| e.target.clone()).collect();
    if targets.iter().any(|t| matches!(t, crate::physics::effect::Target::ModeOrder(_))) {
        return None;
    }
    let inputs: Vec<_> =
        fit.effects.iter().zip(&fit.psi).map(|(e, psi)| data.inputs(&e.law, e.lag().map(|l| psi[l]))).collect();
    let size = |e: usize, row: usize| {
        let (effect, psi) = (&fit.effects[e], &fit.psi[e]);
        let mut sizes = vec![0.0; effect.target.sizes()];
        effect.sizes(inputs[e][row], psi, &mut sizes, &mut vec![0.0; psi.len()]);
        sizes
    };
    let row = (0..data.rows()).max_by(|a, b| {
        let abs = |row: usize| size(last, row).first().copied().unwrap_or(0.0).abs();
        abs(*a).total_cmp(&abs(*b))
    })?;
    let sizes: Vec<f64> = (0..fit.effects.len()).flat_map(|e| size(e, row)).collect();
    simulator.respond(&fit.mean, modes, &targets, &sizes).ok().map(|r| r.frequencies_hz)
}

/// The answer in words.
fn summary(d: &Diagnosis) -> String {
    let sure = |p: f64| if p > 0.9995 { "above 0.999".to_owned() } else { format!("{p:.3}") };
    let damage = d.causes.iter().any(|c| c.class == Class::PossibleDamage);
    let mut text = match d.verdict {
        Verdict::NothingFound => {
            "Nothing wrong was found: the simulation explains these data within their noise.".to_owned()
        }
        Verdict::NoneOfThese => {
            let left = d.remainder.as_ref().map_or_else(String::new, |r| r.function.clone());
            let partly = if d.causes.is_empty() {
                String::new()
            } else {
                let each: Vec<&str> = d.causes.iter().map(|c| c.sentence.as_str()).collect();
                format!(" Partly it looks as if {}; that is not the whole of it.", each.join(", and "))
            };
            format!("Your simulation misses something that no cause known here explains: what is left goes with {left}.{partly}")
        }
        Verdict::Cause => {
            let cause = &d.causes[0];
            format!("Your simulation misses that {} (probability {}).", cause.sentence, sure(cause.probability))
        }
        Verdict::Several => {
            let each = |c: &Cause| format!("{} (probability {})", c.sentence, sure(c.probability));
            let each: Vec<String> = d.causes.iter().map(each).collect();
            format!("Your simulation misses {} things: {}.", each.len(), each.join("; and "))
        }
        Verdict::Ambiguous => {
            let each = |c: &Cause| format!("{} (probability {:.2})", c.sentence, c.probability);
            let each: Vec<String> = d.causes.iter().map(each).collect();
            format!("Your simulation misses one thing, and these data cannot tell which: {}.", each.join("; or "))
        }
    };
    if damage {
        text.push_str(" A stiffness that changes with time may be damage: it is reported and not compensated.");
    }
    if let Some(gain) = &d.gain {
        let rms = &gain.rms_error_percent;
        let finite = |m: &usize| rms.before[*m].is_finite() && rms.after[*m].is_finite();
        let most = (0..rms.before.len()).filter(finite).max_by(|a, b| {
            let gained = |m: usize| rms.before[m] - rms.after[m];
            gained(*a).total_cmp(&gained(*b))
        });
        if let Some(mode) = most {
            let (before, after) = (rms.before[mode], rms.after[mode]);
            let moved = if after < before { "falls" } else { "rises" };
            let alarms = &gain.false_alarms_per_1000;
            let gained = format!(
                " With it, the prediction error of mode {} on {} rows held out {moved} from {before:.2} % to {after:.2} %, and \
                 false alarms go from {:.0} to {:.0} per 1000 healthy batches.",
                mode + 1,
                gain.holdout_rows,
                alarms.before,
                alarms.after
            );
            text.push_str(&gained);
        }
    }
    text
}

/// Whether a covariate is time.
fn is_time(name: &str) -> bool {
    name == TIME
}
