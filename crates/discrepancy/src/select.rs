//! Naming causes: forward selection by evidence, with a check on blocks of rows left out.

use super::blocks::Blocks;
use super::effect::FittedEffect;
use super::everywhere::supported_nats;
use super::fit::{Fit, Start};
use super::grammar::Candidate;
use super::mixture::log_sum;
use super::progress::{Progress, Step};
use super::rank::{rank, Ranked};
use super::study::Study;
use structures::stats;

/// A further cause is accepted if the log odds of all candidates together against no further cause exceed this, nats.
const ACCEPTED_NATS: f64 = 3.0;

/// Greatest number of causes.
const MOST_CAUSES: usize = 4;

/// An accepted cause with the candidates that it was ranked with.
#[derive(Debug, Clone)]
pub struct Slot {
    /// Candidates, the most probable first; that one is the cause.
    pub ranked: Vec<Ranked>,
    /// Mean gain in log predictive density on blocks left out, nats per row, and its standard error.
    pub cross_validation: (f64, f64),
}

/// The result of the search.
pub struct Selection {
    /// Fit with the effects that the structure already has.
    pub base: Fit,
    /// Fit with all causes as well; the effects of the slots come last, in the same order.
    pub fit: Fit,
    /// The causes.
    pub slots: Vec<Slot>,
    /// Number of candidates, each law counted.
    pub tried: usize,
    /// Effective number of independent rows as a share of all rows, from the correlation of residuals in time.
    pub independent_share: f64,
}

/// Searches for causes in the rows with the indices `rows`, one after another, then for each again with the others in place.
///
/// A cause is accepted if the candidates together have odds above exp(3) against no further cause, and if it does not clearly
/// worsen the prediction of rows left out. `known`: the effects that the structure already has. `None` if the frequencies
/// cannot be computed in some row.
pub fn select(
    study: &Study<'_>,
    rows: &[usize],
    known: &[FittedEffect],
    candidates: &[Candidate],
    progress: &Progress<'_>,
) -> Option<Selection> {
    let base = study.fit(rows, known, None)?;
    let mut fit = base.clone();
    let mut slots: Vec<Slot> = Vec::new();
    let tried = candidates.iter().map(|c| c.laws(study.data).len()).sum();
    let mut independent_share = 1.0;
    for number in 0..MOST_CAUSES {
        progress(Step::Searching { cause: number + 1, of: MOST_CAUSES });
        let (ranked, share) = rank(study, rows, &fit, candidates, known.len())?;
        independent_share = share;
        let total = log_sum(ranked.iter().map(|r| r.log_odds));
        let Some(best) = ranked.first().filter(|_| total > ACCEPTED_NATS) else { break };
        // A cause that cannot be evaluated on the rows left out is not accepted.
        let cross_validation = cross_validate(study, rows, &fit, &best.fit).unwrap_or((f64::NEG_INFINITY, 0.0));
        // A cause that clearly worsens their prediction is not accepted either, however much it explains in the other rows.
        if cross_validation.0 + 2.0 * cross_validation.1 <= 0.0 {
            break;
        }
        fit = best.fit.clone();
        slots.push(Slot { ranked, cross_validation });
    }
    if slots.len() > 1 {
        fit = reselect_each(study, rows, candidates, known.len(), fit, &mut slots, progress)?;
    }
    Some(Selection { base, fit, slots, tried, independent_share })
}

/// Removes each cause in turn and searches for it again with the others in place, because the first causes were chosen while the
/// effects of the later ones still added to the scatter.
fn reselect_each(
    study: &Study<'_>,
    rows: &[usize],
    candidates: &[Candidate],
    known: usize,
    mut fit: Fit,
    slots: &mut Vec<Slot>,
    progress: &Progress<'_>,
) -> Option<Fit> {
    let found = slots.len();
    for number in 0..found {
        progress(Step::LookingAgain { cause: number + 1, of: found });
        // The first slot is removed and its successor appended, so that slots and effects keep the same order.
        let old = slots.remove(0);
        let without = refit_without(study, rows, &fit, known)?;
        let (ranked, _) = rank(study, rows, &without, candidates, known)?;
        let needed = log_sum(ranked.iter().map(|r| r.log_odds)) > ACCEPTED_NATS;
        let Some(best) = ranked.first().filter(|_| needed) else {
            fit = without;
            continue;
        };
        fit = best.fit.clone();
        slots.push(Slot { ranked, cross_validation: old.cross_validation });
    }
    // Beside a simulation that is off everywhere, an effect may no longer be needed.
    let mut index = 0;
    while index < slots.len() {
        let without = refit_without(study, rows, &fit, known + index)?;
        if supported_nats(&fit, known + index, &without) <= ACCEPTED_NATS {
            fit = without;
            slots.remove(index);
            index = 0;
        } else {
            index += 1;
        }
    }
    for (index, slot) in slots.iter_mut().enumerate() {
        let without = refit_without(study, rows, &fit, known + index)?;
        slot.cross_validation = cross_validate(study, rows, &without, &fit).unwrap_or((f64::NEG_INFINITY, 0.0));
    }
    Some(fit)
}

/// The fit without one of its effects.
fn refit_without(study: &Study<'_>, rows: &[usize], fit: &Fit, effect: usize) -> Option<Fit> {
    let (mut effects, mut psi) = (fit.effects.clone(), fit.psi.clone());
    effects.remove(effect);
    psi.remove(effect);
    let start = Start { fit, psi: psi.into_iter().map(Some).collect(), noise_as_stated: false };
    study.fit(rows, &effects, Some(&start))
}

/// Mean gain in log predictive density of rows left out, second fit minus first, nats per row, and its standard error over
/// blocks. `None` if the frequencies of either model cannot be computed in some row.
fn cross_validate(study: &Study<'_>, rows: &[usize], before: &Fit, after: &Fit) -> Option<(f64, f64)> {
    let blocks = Blocks::new(study.data, rows);
    let densities = |fit: &Fit| -> Option<Vec<f64>> {
        Some(blocks.predicted(study, rows, fit)?.iter().map(|view| view.log_density).collect())
    };
    let (before, after) = (densities(before)?, densities(after)?);
    let gains: Vec<f64> = after.iter().zip(&before).map(|(after, before)| after - before).collect();
    let mean = stats::mean(&gains);
    Some((mean, blocks.standard_error(&gains, mean)))
}
