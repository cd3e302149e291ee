//! A change inside the batches of an undamaged reference: they are then no healthy state, but two.
//!
//! The process that is fitted to such batches takes the change for weather or for the scatter of its quantities, as far as it can. It is
//! therefore compared with a process that has a step at some batch, whose influence on each quantity is learned as that of a covariate is:
//!
//! ```text
//!  ln odds = ln evidence(with the step at τ) − ln evidence(without) − ln(number of possible τ)
//! ```
//!
//! τ: where a change explains what the process without a step did not expect better than anywhere else.

use std::ops::Range;

use rayon::prelude::*;

use super::change::quantile;
use super::direction::ChangeDirection;
use super::estimate::{BatchEstimate, Scale};
use super::filter::Filter;
use super::fit::{observations, Fit, Quantities};
use super::lasting::{LastingChange, QuantityChange, NORMAL_95};
use super::likelihood::log_density;
use super::model::Process;
use super::parts::ChangePrior;
use super::reference::ReferenceProcess;
use super::score::{score, Courses};
use structures::stats;

/// Batches before the onset, and from it on, without which a change is not told from a few unusual batches.
const FEWEST: usize = 5;

/// Most batches in which the onset is looked for, the newest ones: the time grows with the square of their number.
const MOST: usize = 500;

/// Logarithm of the odds, 1,000 to 1, from which on a change is said to lie in the batches.
const CERTAIN_LOG_ODDS: f64 = 6.9;

/// Smaller changes are not mentioned, in per cent of the mean.
const SMALLEST_PERCENT: f64 = 2.0;

/// A quantity takes part in a step whose influence on it is clear by as many standard deviations, and at least this share of the largest
/// one.
const CLEAR: f64 = 4.0;
const LEAST_SHARE: f64 = 0.1;

/// Name of the step among the covariates; none of a structure has a colon in its name.
const STEP: &str = "structure:step";

impl ReferenceProcess {
    /// The step of the parameters that lies in the batches to which it has just been fitted, in any order; `None` if none does, or a small one.
    /// It takes as long as the fit did.
    pub fn change_inside(&self, quantities: &Quantities, mut estimates: Vec<BatchEstimate>) -> Option<LastingChange> {
        estimates.sort_by_key(|estimate| estimate.at);
        let fitted = Fitted { process: &self.process, quantities, estimates: &estimates };
        fitted.change(self.log_evidence, &self.change_prior())
    }
}

/// A process with what it was fitted to, in the order of the times.
struct Fitted<'a> {
    process: &'a Process,
    quantities: &'a Quantities,
    estimates: &'a [BatchEstimate],
}

impl Fitted<'_> {
    /// `without`: logarithm of the evidence without a step; `prior`: of changes of the process.
    fn change(&self, without: f64, prior: &ChangePrior) -> Option<LastingChange> {
        let Self { process, quantities, estimates } = self;
        let onsets = estimates.len().saturating_sub(MOST).max(FEWEST)..estimates.len().saturating_sub(FEWEST - 1);
        let begin = self.likely_onset(prior, onsets.clone())?;
        let names: Vec<String> = process.covariates.iter().cloned().chain([STEP.to_owned()]).collect();
        let fit = Fit::of(quantities, &names, &stepped(estimates, begin), &|_| {}).ok()?;
        if fit.log_evidence - without - (onsets.len() as f64).ln() < CERTAIN_LOG_ODDS {
            return None;
        }
        let stds = fit.stds();
        let with = fit.process;
        // The posterior of the onset, with the other numbers as they are.
        let density = |onset: usize| {
            let observed = observations(&with, &stepped(estimates, onset));
            log_density(&with.unknowns, with.sizes(), &observed).unwrap_or(f64::NEG_INFINITY)
        };
        let densities: Vec<f64> = onsets.clone().into_par_iter().map(density).collect();
        let weights = stats::weights(&densities, 0.0)?;
        let total: f64 = weights.iter().sum();
        let shares: Vec<f64> = weights.into_iter().map(|weight| weight / total).collect();
        let [first, middle, last] = [0.05, 0.5, 0.95].map(|level| onsets.start + quantile(&shares, level));
        let onset = estimates[middle].at;
        let onset_interval = [estimates[first - 1].at, estimates[last].at];
        let (candidates, not_seen, coinciding) = Default::default();
        let changes = self.of_step(&with, &stds);
        let change = LastingChange { fast: true, onset, onset_interval, changes, candidates, not_seen, coinciding };
        (!change.changes.is_empty() && !change.is_below(SMALLEST_PERCENT)).then_some(change)
    }

    /// The onset at which a change explains what the process did not expect best.
    fn likely_onset(&self, prior: &ChangePrior, onsets: Range<usize>) -> Option<usize> {
        let filter = Filter::of(self.process);
        let mut known = filter.start();
        let mut innovations = Vec::new();
        for observation in observations(self.process, self.estimates) {
            let (next, innovation) = filter.step(&known, &observation)?;
            known = next;
            innovations.push(innovation);
        }
        let explained = |onset: usize| {
            let found = score(&innovations[onset..], filter.contributions(), Courses::Step);
            prior.widest(&found).map_or(f64::NEG_INFINITY, |widest| widest.log_weight)
        };
        let all: Vec<(usize, f64)> = onsets.into_par_iter().map(|onset| (onset, explained(onset))).collect();
        all.into_iter().max_by(|a, b| a.1.total_cmp(&b.1)).map(|(onset, _)| onset)
    }

    /// What the step of a process does to each parameter that takes part in it. `stds`: standard deviations of its unknowns.
    fn of_step(&self, with: &Process, stds: &[f64]) -> Vec<QuantityChange> {
        let (sizes, step, directions) = (with.sizes(), with.covariates.len() - 1, &self.quantities.directions);
        let Scale { origin, unit } = with.covariate_scales[step];
        let one = |k: usize| {
            let (scale, numbers) = (with.scales[k], with.numbers());
            let per_unit = scale.unit / unit;
            let (mean, std) = (numbers.slopes[(k, step)], stds[sizes.slope(k, step)]);
            let before = scale.origin + scale.unit * numbers.mean[k] - per_unit * mean * origin;
            let change = QuantityChange {
                name: with.quantities[k].clone(),
                unit: with.units[k].clone(),
                probability: 1.0,
                towards_damage: directions[k].sign() * mean > 0.0,
                change: per_unit * mean,
                interval: [mean - NORMAL_95 * std, mean + NORMAL_95 * std].map(|end| per_unit * end),
                reference_mean: before,
                explained: 0.0,
                modes: Vec::new(),
            };
            (change, mean.abs() > CLEAR * std)
        };
        let is_parameter = |k: &usize| directions[*k] != ChangeDirection::Either;
        let all: Vec<(QuantityChange, bool)> = (0..with.quantities.len()).filter(is_parameter).map(one).collect();
        let size = |own: &QuantityChange| own.percent(own.change).abs();
        let largest = all.iter().filter(|(_, clear)| *clear).map(|(own, _)| size(own)).fold(0.0, f64::max);
        all.into_iter()
            .filter(|(own, clear)| *clear && size(own) >= LEAST_SHARE * largest)
            .map(|(own, _)| own)
            .collect()
    }
}

/// Batches with a further covariate that is 0 before an onset and 1 from it on.
fn stepped(estimates: &[BatchEstimate], onset: usize) -> Vec<BatchEstimate> {
    let with = |(t, own): (usize, &BatchEstimate)| {
        let mut own = own.clone();
        own.covariates.push(Some(if t < onset { 0.0 } else { 1.0 }));
        own
    };
    estimates.iter().enumerate().map(with).collect()
}
