//! Lasting changes that a process does not explain: test and onset.

use std::collections::BTreeMap;

use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};

use super::direction::ChangeDirection;
use super::filter::Innovation;
use super::parts::{shares, ChangePrior, Hypothesis, Parts};
use super::score::{score, Courses, Score};

/// Ages of a change, in batches since its onset, that are tested.
pub const AGES: [usize; 10] = [1, 2, 3, 5, 8, 13, 20, 30, 45, 60];

/// Ages up to this one make the fast chart, which finds steps; the others make the slow chart, which finds small lasting losses.
pub const FAST_AGE: usize = 3;

/// Number of batches, the newest included, in which the onset of a change is looked for.
pub const WINDOW: usize = AGES[AGES.len() - 1];

/// Onsets that are less likely than the best one by this logarithm are not examined.
const LEAST_LIKELY: f64 = 12.0;

/// Most onsets that are examined, those among them at which the end of a growth is sought first, and most ends of each.
const MOST_ONSETS: usize = 12;
const ONSETS_WITH_END: usize = 3;
const MOST_ENDS: usize = 3;

/// Beyond an onset that is less likely than the best one by this logarithm, the end of a growth is not sought.
const HARDLY_LESS_LIKELY: f64 = 4.0;

/// A hypothesis with its onset and the end of its growth.
type WithOnset = (usize, Option<f64>, Hypothesis);

/// Evidence of a change on the two charts, in standard deviations.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Evidence {
    /// Largest over the ages up to [`FAST_AGE`].
    pub fast: f64,
    /// Largest over the other ages.
    pub slow: f64,
}

impl Evidence {
    /// No evidence at any age.
    pub const NONE: Self = Self { fast: 0.0, slow: 0.0 };

    /// The evidence, or the limits where it is above them.
    pub(super) fn at_most(self, limits: Self) -> Self {
        Self { fast: self.fast.min(limits.fast), slow: self.slow.min(limits.slow) }
    }

    /// Takes the evidence at an age into account.
    pub(super) fn take(&mut self, age: usize, z: f64) {
        let chart = if age <= FAST_AGE { &mut self.fast } else { &mut self.slow };
        *chart = chart.max(z);
    }
}

/// Evidence for a loss.
#[derive(Debug, Clone, PartialEq)]
pub struct LossEvidence {
    /// In each quantity alone, `[d]`; `None` without a damage direction, or if the newest batch does not inform it.
    pub quantities: Vec<Option<Evidence>>,
    /// In any of them together; `None` if there is only one, and no misfit.
    pub joint: Option<Evidence>,
    /// In the misfit; `None` if there is none, or if the newest batch does not inform it.
    pub misfit: Option<Evidence>,
}

/// The evidence for a loss in the newest of some successive innovations, at most [`WINDOW`]. A loss of one quantity is evidence for
/// losses of others with a similar effect, too; which of them have changed is the question of [`parts`](super::parts).
pub fn evidence(
    innovations: &[Innovation],
    contributions: &DMatrix<f64>,
    directions: &[ChangeDirection],
) -> LossEvidence {
    let newest = innovations.last();
    let informed = |k: usize| newest.is_some_and(|newest| newest.informed.contains(&k));
    let charted = |k: usize| directions[k].is_damage();
    let mut quantities: Vec<Option<Evidence>> =
        (0..directions.len()).map(|k| (charted(k) && informed(k)).then_some(Evidence::NONE)).collect();
    let several = directions.iter().filter(|own| **own != ChangeDirection::None).count() > 1;
    let has_misfit = (0..directions.len()).any(|k| directions[k] == ChangeDirection::Either && informed(k));
    let mut misfit = has_misfit.then_some(Evidence::NONE);
    let mut joint = (several && quantities.iter().any(Option::is_some)).then_some(Evidence::NONE);
    for age in AGES.into_iter().filter(|age| *age <= innovations.len()) {
        let found = score(&innovations[innovations.len() - age..], contributions, Courses::Step);
        let (alone, [together, of_misfit]) = found.evidence(directions);
        for (evidence, z) in quantities.iter_mut().zip(alone) {
            if let Some(evidence) = evidence {
                evidence.take(age, z);
            }
        }
        if let Some(joint) = &mut joint {
            joint.take(age, together);
        }
        if let Some(misfit) = &mut misfit {
            misfit.take(age, of_misfit);
        }
    }
    LossEvidence { quantities, joint, misfit }
}

/// Onset of a change, and which quantities take part in it.
#[derive(Debug, Clone, PartialEq)]
pub struct Change {
    /// Index of the first changed innovation: the most probable one.
    pub onset: usize,
    /// 5 % and 95 % quantiles of the index.
    pub onset_interval: [usize; 2],
    /// Time from the onset to the end of its growth, in steps of the process, where it has most probably ended.
    pub growth_ends: Option<f64>,
    /// Which quantities have changed, and by how much.
    pub parts: Parts,
}

/// Onset, parts and size of a change in some successive innovations: the posterior over all onsets, with a uniform prior, over all sets of
/// quantities, and over the end of their growth. `None` without innovations that inform any.
///
/// The sets are examined at the onsets and ends at which a change of all quantities explains the innovations hardly less than at the best.
pub fn change(innovations: &[Innovation], contributions: &DMatrix<f64>, prior: &ChangePrior) -> Option<Change> {
    let of_onset = |first: usize| score(&innovations[first..], contributions, Courses::StepAndGrowth(None));
    let scores: Vec<Score> = (0..innovations.len()).map(of_onset).collect();
    let best = |score: &Score| prior.widest(score).map_or(f64::NEG_INFINITY, |widest| widest.log_weight);
    let best: Vec<f64> = scores.iter().map(best).collect();
    let mut sorted = best.clone();
    sorted.sort_by(|a, b| b.total_cmp(a));
    let highest = *sorted.first()?;
    let least = (highest - LEAST_LIKELY).max(sorted[(MOST_ONSETS - 1).min(sorted.len() - 1)]);
    let is_examined = |(onset, _): &(usize, &Score)| best[*onset] >= least && best[*onset].is_finite();
    let mut found: Vec<WithOnset> = Vec::new();
    for (onset, score) in scores.iter().enumerate().filter(is_examined) {
        found.extend(prior.hypotheses(score).into_iter().map(|own| (onset, None, own)));
    }
    found.extend(ended_growths(innovations, contributions, prior, (&scores, &best)));
    let all = || found.iter().map(|(.., own)| own);
    let weights = shares(all());
    let mut onsets = vec![0.0; innovations.len()];
    found.iter().zip(&weights).for_each(|((onset, ..), weight)| onsets[*onset] += weight);
    let parts = Parts::of(all())?;
    let best = (0..onsets.len()).max_by(|a, b| onsets[*a].total_cmp(&onsets[*b]))?;
    let onset_interval = [0.05, 0.95].map(|level| quantile(&onsets, level));
    let at_best = found.iter().zip(&weights).filter(|((onset, ..), _)| *onset == best);
    let ((_, growth_ends, _), _) = at_best.max_by(|a, b| a.1.total_cmp(b.1))?;
    Some(Change { onset: best, onset_interval, growth_ends: *growth_ends, parts })
}

/// The hypotheses that a growth has ended.
///
/// The ends are sought at the onsets at which a growth that goes on explains the innovations best, and then, from the best of them, at its
/// neighbours on both sides, as long as these explain the innovations hardly less: a growth that is taken to go on begins later than one
/// that has ended. `scores` and `best`: for each onset, of a growth that goes on.
fn ended_growths(
    innovations: &[Innovation],
    contributions: &DMatrix<f64>,
    prior: &ChangePrior,
    (scores, best): (&[Score], &[f64]),
) -> Vec<WithOnset> {
    let mut next: Vec<usize> = (0..best.len()).filter(|onset| best[*onset].is_finite()).collect();
    next.sort_by(|a, b| best[*b].total_cmp(&best[*a]));
    next.truncate(ONSETS_WITH_END);
    let mut found = Vec::new();
    let mut examined: BTreeMap<usize, f64> = BTreeMap::new();
    while let Some(onset) = next.pop() {
        let mut highest = f64::NEG_INFINITY;
        if prior.grows(&scores[onset], best[onset]) {
            let since = &innovations[onset..];
            for score in ended(since, contributions, prior) {
                for mut own in prior.hypotheses(&score) {
                    // All ends are equally probable.
                    own.log_weight -= (since.len() as f64).ln();
                    highest = highest.max(own.log_weight);
                    found.push((onset, score.growth_ends, own));
                }
            }
        }
        examined.insert(onset, highest);
        if next.is_empty() && examined.len() < MOST_ONSETS {
            next = beside(&examined, scores.len());
        }
    }
    found
}

/// The next of some onsets on both sides of the best of those that were examined, beyond those that are hardly less likely.
fn beside(examined: &BTreeMap<usize, f64>, onsets: usize) -> Vec<usize> {
    let likely = examined.iter().filter(|(_, log_weight)| log_weight.is_finite());
    let Some((best, highest)) = likely.max_by(|a, b| a.1.total_cmp(b.1)) else { return Vec::new() };
    let is_likely = |onset: &usize| examined.get(onset).is_some_and(|own| *own > highest - HARDLY_LESS_LIKELY);
    let before = (0..*best).rev().find(|onset| !is_likely(onset));
    let after = (best + 1..onsets).find(|onset| !is_likely(onset));
    before.into_iter().chain(after).filter(|onset| !examined.contains_key(onset)).collect()
}

/// The scores of a change with the first of some innovations whose growth has ended, at the ends at which it explains them best.
///
/// The ends are sought among those that lie some of [`AGES`] back, and then between the neighbours of the best one.
fn ended(innovations: &[Innovation], contributions: &DMatrix<f64>, prior: &ChangePrior) -> Vec<Score> {
    let at = |end: usize| {
        let steps = innovations[1..=end].iter().map(|own| own.steps).sum();
        let found = score(innovations, contributions, Courses::StepAndGrowth(Some(steps)));
        let log_weight = prior.widest(&found).map_or(f64::NEG_INFINITY, |widest| widest.log_weight);
        (log_weight, found)
    };
    let back = |age: &usize| innovations.len().checked_sub(age + 1).filter(|end| *end > 0);
    let mut tried: BTreeMap<usize, (f64, Score)> = AGES.iter().filter_map(back).map(|end| (end, at(end))).collect();
    while let Some((best, _)) = tried.iter().max_by(|(_, a), (_, b)| a.0.total_cmp(&b.0)) {
        let before = tried.range(..best).next_back().map_or(0, |(end, _)| *end);
        let after = tried.range(best + 1..).next().map_or(innovations.len() - 1, |(end, _)| *end);
        let between = [usize::midpoint(before, *best), usize::midpoint(*best, after)];
        let new: Vec<usize> = between.into_iter().filter(|end| *end > 0 && !tried.contains_key(end)).collect();
        if new.is_empty() {
            break;
        }
        tried.extend(new.into_iter().map(|end| (end, at(end))));
    }
    let mut found: Vec<(f64, Score)> = tried.into_values().filter(|(log_weight, _)| log_weight.is_finite()).collect();
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    found.into_iter().take(MOST_ENDS).map(|(_, score)| score).collect()
}

/// The index at which the sum of some weights, whose total is 1, reaches a level.
pub(super) fn quantile(weights: &[f64], level: f64) -> usize {
    let mut sum = 0.0;
    let reached = weights.iter().position(|weight| {
        sum += weight;
        sum >= level
    });
    reached.unwrap_or(weights.len() - 1)
}
