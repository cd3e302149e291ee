//! The time from which an effect acts.
//!
//! ```text
//!  p(τ | data) ∝ Π_{t < τ} p(row without it) · Π_{t ≥ τ} p(row with it)
//! ```
//!
//! with all numbers at the maximum of the fit, and every time of a row as probable beforehand. The screening tries a few times only, and a
//! time that is wrong by some rows makes another target fit better than the true one.

use super::data::Values;
use super::effect::FittedEffect;
use super::fit::{Fit, Start};
use super::most_probable::{most_probable, MostProbable};
use super::study::Study;
use structures::simulator::law::LawKind;

/// Greatest number of fits with a better time.
const MOST_MOVES: usize = 3;

/// The most probable time of a step.
struct Onset {
    /// Time of the first row with the effect.
    at: f64,
    /// 90 % interval.
    interval: [f64; 2],
    /// −ln of the mean over all times of p relative to that of the most probable one, nats: what its evidence loses because the time is not known
    /// beforehand.
    cost_nats: f64,
}

/// The fit with the last of its effects, if that is a step, from its most probable time on, and what the evidence loses because that is
/// chosen, nats; 0 for another law.
pub(super) fn at_its_onset(study: &Study<'_>, rows: &[usize], mut fit: Fit) -> (Fit, f64) {
    let mut cost_nats = 0.0;
    for _ in 0..MOST_MOVES {
        let Some(onset) = onset(study, rows, &fit) else { break };
        cost_nats = onset.cost_nats;
        let mut effects = fit.effects.clone();
        let Some(last) = effects.last_mut() else { break };
        last.onset90 = Some(onset.interval);
        let is_there = same_rows(study, rows, last, onset.at);
        last.law.reference = onset.at;
        if is_there {
            fit.effects = effects;
            break;
        }
        let moved = study.fit(rows, &effects, Some(&Start::at(&fit)));
        let Some(moved) = moved.filter(|moved| moved.log_evidence > fit.log_evidence) else { break };
        fit = moved;
    }
    (fit, cost_nats)
}

/// The times of the rows, in the unit of a step.
fn times<'a>(study: &'a Study<'_>, effect: &FittedEffect) -> Option<&'a [f64]> {
    if effect.law.kind != LawKind::Step {
        return None;
    }
    match &study.data.column(effect.law.covariate.as_deref()?)?.values {
        Values::Numbers(times) => Some(times),
        Values::Categories(..) => None,
    }
}

/// Whether a step acts in the same rows from another time on.
fn same_rows(study: &Study<'_>, rows: &[usize], effect: &FittedEffect, at: f64) -> bool {
    let times = times(study, effect).unwrap_or_default();
    rows.iter().all(|row| (times[*row] >= at) == (times[*row] >= effect.law.reference))
}

/// The most probable time of a step.
fn onset(study: &Study<'_>, rows: &[usize], fit: &Fit) -> Option<Onset> {
    let times = times(study, fit.effects.last()?)?;
    let from = |reference: f64| {
        let mut moved = fit.clone();
        moved.effects.last_mut()?.law.reference = reference;
        study.view(rows, &moved)
    };
    let (with, without) = (from(f64::NEG_INFINITY)?, from(f64::INFINITY)?);
    let mut order: Vec<usize> = (0..rows.len()).filter(|place| times[rows[*place]].is_finite()).collect();
    order.sort_by(|a, b| times[rows[*a]].total_cmp(&times[rows[*b]]));
    // ln p of each time but the first, at which it would be no step, up to a constant.
    let mut log = 0.0;
    let mut logs: Vec<(f64, f64)> = Vec::new();
    for pair in order.windows(2) {
        log += without[pair[0]].log_density - with[pair[0]].log_density;
        let [before, after] = [0, 1].map(|end| times[rows[pair[end]]]);
        if after > before {
            logs.push((after, log));
        }
    }
    let MostProbable { value, interval, total } = most_probable(&logs)?;
    Some(Onset { at: value, interval, cost_nats: (logs.len() as f64 / total).ln() })
}

/// Since when a step acts: "from day 130 (between 128 and 131) of the data on".
pub(super) fn in_words(effect: &FittedEffect, unit: &str) -> String {
    let shown = |time: f64| format!("{time:.0}");
    let at = shown(effect.law.reference);
    match effect.onset90.map(|interval| interval.map(shown)) {
        Some([low, high]) if low != high => format!("from {unit} {at} (between {low} and {high}) of the data on"),
        _ => format!("from {unit} {at} of the data on"),
    }
}
