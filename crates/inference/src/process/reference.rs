//! The process of an undamaged reference, and the chain of batches that are compared with it.

use serde::{Deserialize, Serialize};

use super::change::{change, evidence, signs, Change, Evidence, LossEvidence, AGES, WINDOW};
use super::contained::Fitted;
use super::detectable::{detectable, Detectable};
use super::estimate::{percent, BatchEstimate, LOGARITHM};
use super::filter::{Filter, Innovation, Known};
use super::fit::{fit_with_evidence, observations, Error, Quantities, Watch};
use super::followed::{Followed, Memory};
use super::lasting::{LastingChange, QuantityChange, NORMAL_95};
use super::limits::{self, Limits};
use super::model::Process;
use super::one_factor::FactorPoint;
use super::parts::ChangePrior;
use super::score::{score, Courses};
use structures::parameter::{DamageDirection, ALL_FREQUENCIES};
use structures::quantity::Timestamp;

/// Name of the chart of all quantities together; no parameter can have a colon in its name.
pub const JOINT_SERIES: &str = "structure:joint";

/// Seed of the simulated limits. It is fixed, so that they depend on nothing but the reference and the wanted run length.
const SEED: u64 = 1;

/// A quantity has certainly changed if it has with a higher probability than this.
const NAMED: f64 = 0.9;

/// Where others certainly have, a quantity is a candidate above this probability.
const PROBABLE: f64 = 0.5;

/// Where none certainly has, a quantity is a candidate above this probability.
const POSSIBLE: f64 = 0.05;

/// The process of an undamaged reference with the limits of its charts.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ReferenceProcess {
    /// The process.
    pub process: Process,
    /// Which change of each quantity indicates damage, `[d]`.
    pub directions: Vec<DamageDirection>,
    /// Limits of the charts.
    pub limits: Limits,
    /// Mean number of healthy batches to a false alarm for which the limits were computed.
    pub mean_run_batches: f64,
    /// The smallest lasting losses that the charts find; empty in references of earlier versions of the program.
    #[serde(default)]
    pub detectable: Vec<Detectable>,
    /// Misfit of the simulation that its batches show: both statistics of the test of fit divided by their degrees of freedom, 1 where
    /// the simulation fits.
    pub usual_misfit: [f64; 2],
    /// Covariance of single measurements of the parameters about the mean of their batch, without their noise, by columns; empty where it is
    /// not computed, and in references of earlier versions of the program.
    #[serde(default)]
    pub scatter: Vec<f64>,
    /// Noise of each mode as a multiple of the stated one, `[modes]`, which the batches of the reference show and with which later ones are
    /// judged; empty where it is as stated, and in references of earlier versions of the program.
    #[serde(default)]
    pub noise: Vec<f64>,
    /// What one factor of all frequencies does to the quantities, in their units, in ascending order; empty where it is not computed, and in
    /// references of earlier versions of the program.
    #[serde(default)]
    pub one_factor: Vec<FactorPoint>,
    /// The change that lies in its batches, if one does; known only where it has just been made.
    #[serde(skip)]
    pub contained: Option<LastingChange>,
    /// The states after the last batch of the reference, as [`Known::to_numbers`] writes them.
    pub(super) end: Vec<f64>,
}

/// A batch on the charts of a process.
#[derive(Debug, Clone, PartialEq)]
pub struct ProcessPoint {
    /// Evidence for a loss.
    pub evidence: LossEvidence,
    /// The change, if the chart that raises alarms is above a limit.
    pub change: Option<LastingChange>,
}

/// Batches that are compared with the process, in the order of their times.
#[derive(Clone)]
pub struct Chain<'a> {
    reference: &'a ReferenceProcess,
    filter: &'a Filter,
    prior: ChangePrior,
    /// A change that is certainly smaller raises no alarm, in per cent.
    smallest_percent: f64,
    known: Known,
    before: Option<Timestamp>,
    /// The last innovations with the times of their batches and of the batches before, at most [`WINDOW`].
    innovations: Vec<Innovation>,
    times: Vec<[Timestamp; 2]>,
    memory: Memory,
}

impl ReferenceProcess {
    /// Fits the process to the batches of a reference, in any order, and simulates its limits.
    ///
    /// # Errors
    /// [`Error`], see its variants.
    pub fn new(
        quantities: &Quantities,
        covariates: &[String],
        estimates: Vec<BatchEstimate>,
        mean_run_batches: f64,
        usual_misfit: [f64; 2],
    ) -> Result<Self, Error> {
        Self::watched(quantities, covariates, estimates, (mean_run_batches, usual_misfit), &|_| {})
    }

    /// [`Self::new`], which takes seconds to minutes, with its progress.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn watched(
        quantities: &Quantities,
        covariates: &[String],
        mut estimates: Vec<BatchEstimate>,
        (mean_run_batches, usual_misfit): (f64, [f64; 2]),
        watch: Watch<'_>,
    ) -> Result<Self, Error> {
        estimates.sort_by_key(|estimate| estimate.at);
        let (process, log_evidence) = fit_with_evidence(quantities, covariates, &estimates, watch)?;
        let singular = || Error::Search("a covariance is not positive definite".to_owned());
        let limits = limits::watched(&process, &signs(&quantities.directions), mean_run_batches, SEED, watch);
        let limits = limits.ok_or_else(singular)?;
        let filter = Filter::of(&process);
        let mut known = filter.start();
        for observation in observations(&process, &estimates) {
            known = filter.step(&known, &observation).ok_or_else(singular)?.0;
        }
        let mut found = Self {
            detectable: detectable(&process, &limits),
            process,
            directions: quantities.directions.clone(),
            limits,
            mean_run_batches,
            usual_misfit,
            scatter: Vec::new(),
            noise: Vec::new(),
            one_factor: Vec::new(),
            contained: None,
            end: known.to_numbers(),
        };
        let fitted = Fitted { process: &found.process, log_evidence, quantities, estimates: &estimates };
        found.contained = fitted.change(&found.change_prior());
        Ok(found)
    }

    /// The first lasting change that its charts show in batches outside the reference, in any order.
    pub fn first_change(&self, mut estimates: Vec<BatchEstimate>) -> Option<LastingChange> {
        let filter = Filter::of(&self.process);
        estimates.sort_by_key(|estimate| estimate.at);
        let mut chain = Chain::start(self, &filter, estimates.first()?.at);
        estimates.iter().find_map(|estimate| chain.take(estimate)?.change)
    }

    /// The names of its charts: each quantity with a damage direction, then all together if there are several.
    pub fn series(&self) -> Vec<String> {
        let charted =
            self.process.quantities.iter().zip(&self.directions).filter(|(_, d)| **d != DamageDirection::None);
        let mut names: Vec<String> = charted.map(|(name, _)| name.clone()).collect();
        if names.len() > 1 {
            names.push(JOINT_SERIES.to_owned());
        }
        names
    }

    /// The series whose chart raises alarms: that of all quantities together, or of the only one. An event thus raises one alarm.
    pub fn alarm_series(&self) -> Option<String> {
        self.series().pop()
    }

    /// What is known of changes before batches are looked at.
    fn change_prior(&self) -> ChangePrior {
        let Process { scales, units, .. } = &self.process;
        let mean = self.process.numbers().mean;
        let size = |k: usize| {
            let share = percent(&units[k], scales[k].origin + scales[k].unit * mean[k], scales[k].unit).abs() / 100.0;
            // The mean of a quantity may be 0: the scatter of the reference is its size then.
            share.recip().max(1.0)
        };
        let standardised = |point: &FactorPoint| {
            let changes = point.changes.iter().zip(scales).map(|(change, scale)| change / scale.unit);
            FactorPoint { ln_factor: point.ln_factor, changes: changes.collect() }
        };
        ChangePrior {
            signs: signs(&self.directions),
            sizes: (0..mean.len()).map(size).collect(),
            one_factor: self.one_factor.iter().map(standardised).collect(),
        }
    }

    /// The limits of a series.
    pub fn limits_of(&self, series: &str) -> Evidence {
        if series == JOINT_SERIES {
            self.limits.joint
        } else {
            self.limits.quantity
        }
    }
}

impl ProcessPoint {
    /// The evidence on a chart; `None` if the batch does not inform its quantity.
    pub fn of_series(&self, reference: &ReferenceProcess, series: &str) -> Option<Evidence> {
        if series == JOINT_SERIES {
            return self.evidence.joint;
        }
        let k = reference.process.quantities.iter().position(|name| name == series)?;
        self.evidence.quantities[k]
    }
}

impl<'a> Chain<'a> {
    /// The chain before its first batch, which was measured at `first`: after the reference it continues from the states there.
    pub fn start(reference: &'a ReferenceProcess, filter: &'a Filter, first: Timestamp) -> Self {
        let end = reference.process.period[1];
        let continued = Known::from_numbers(&reference.end).filter(|_| first > end);
        let before = continued.as_ref().map(|_| end);
        Self {
            known: continued.map_or_else(|| filter.start(), |known| filter.with_covariates(known)),
            before,
            prior: reference.change_prior(),
            smallest_percent: 0.0,
            reference,
            filter,
            innovations: Vec::new(),
            times: Vec::new(),
            memory: Memory::default(),
        }
    }

    /// The chain after a batch at `at`, where the states were `known`.
    pub fn resume(reference: &'a ReferenceProcess, filter: &'a Filter, known: Known, at: Timestamp) -> Self {
        Self { known: filter.with_covariates(known), before: Some(at), ..Self::start(reference, filter, at) }
    }

    /// The chain, in which a change that is certainly smaller than this raises no alarm, in per cent of the mean of the reference. Until a
    /// change is larger, the charts stay at their limits; an alarm that it has raised lasts as long as the change.
    #[must_use]
    pub fn alarming_from(mut self, percent: f64) -> Self {
        self.smallest_percent = percent;
        self
    }

    /// What is known about the states after the last batch.
    pub fn known(&self) -> &Known {
        &self.known
    }

    /// What it remembers after the last batch, beside the batches of the window.
    pub fn memory(&self) -> &Memory {
        &self.memory
    }

    /// The chain with what it remembered after its last batch.
    #[must_use]
    pub fn remembering(mut self, memory: Memory) -> Self {
        self.memory = memory;
        if let Some(Followed { score, .. }) = &mut self.memory.followed {
            let states = self.filter.contributions().ncols();
            score.taken = std::mem::take(&mut score.taken).resize_vertically(states, 0.0);
        }
        self.forget();
        self
    }

    /// Takes batches before the begin of the test out of the window.
    fn forget(&mut self) {
        let begin = self.memory.begin;
        let old = self.times.iter().take_while(|[_, at]| begin.is_some_and(|begin| *at < begin)).count();
        self.times.drain(..old);
        self.innovations.drain(..old);
    }

    /// Adds a batch, without its evidence. Returns whether it could be added.
    pub fn pass(&mut self, estimate: &BatchEstimate) -> bool {
        let end = self.reference.process.period[1];
        if self.before.is_some_and(|before| before <= end) && estimate.at > end && !self.innovations.is_empty() {
            // The batches so far were measured before the end of the reference, which says more about the states after it.
            *self = Self::start(self.reference, self.filter, estimate.at);
        }
        let observation = self.reference.process.observation(estimate, self.before);
        if observation.informed.is_empty() {
            return false;
        }
        let Some((known, innovation)) = self.filter.step(&self.known, &observation) else { return false };
        self.known = known;
        if self.innovations.len() == WINDOW {
            self.innovations.remove(0);
            self.times.remove(0);
        }
        self.innovations.push(innovation);
        self.times.push([self.before.unwrap_or(estimate.at), estimate.at]);
        self.before = Some(estimate.at);
        true
    }

    /// Adds a batch and returns its point on the charts; `None` if it informs no quantity.
    pub fn take(&mut self, estimate: &BatchEstimate) -> Option<ProcessPoint> {
        if !self.pass(estimate) {
            return None;
        }
        let newest = self.innovations.last()?;
        if let Some(followed) = &mut self.memory.followed {
            followed.add(newest, self.filter.contributions());
        }
        let signs = &self.prior.signs;
        if self.has_gone() {
            // What the states took of the change for weather is given back.
            if let Some(followed) = self.memory.followed.take() {
                self.known.mean -= followed.taken(signs);
            }
            self.memory.begin = Some(estimate.at);
            self.forget();
        }
        let mut found = evidence(&self.innovations, self.filter.contributions(), &self.prior.signs);
        let in_window = self.raised(&found);
        if let Some((alone, joint)) =
            self.memory.followed.as_ref().map(|followed| followed.score.evidence(&self.prior.signs))
        {
            for (own, z) in found.quantities.iter_mut().zip(&alone) {
                if let Some(own) = own {
                    own.slow = own.slow.max(*z);
                }
            }
            if let Some(own) = &mut found.joint {
                own.slow = own.slow.max(joint);
            }
        }
        let raised = self.raised(&found);
        if let Some(joint) = &mut found.joint {
            *joint = raised?;
        }
        let limits = self.reference.limits_of(&self.reference.alarm_series()?);
        let above = raised.filter(|evidence| evidence.fast > limits.fast || evidence.slow > limits.slow);
        // What began before the window and shows more than the window does is known by its score alone.
        let shows = |e: Evidence| e.fast.max(e.slow);
        let known = self.is_older() && in_window.map(shows) < above.map(shows);
        let sought = above.filter(|_| !known);
        let changed = sought.and_then(|_| change(&self.innovations, self.filter.contributions(), &self.prior));
        self.follow(above, in_window.zip(changed.as_ref()));
        let change = above.and_then(|evidence| self.change(estimate, evidence.fast > limits.fast, changed));
        let slight = change.as_ref().is_some_and(|change| change.is_below(self.smallest_percent));
        self.memory.alarmed = above.is_some() && (self.memory.alarmed || !slight);
        if let Some(change) = &change {
            self.spare(&mut found, change);
        }
        if slight && !self.memory.alarmed {
            let limits = self.reference.limits;
            found.quantities.iter_mut().flatten().for_each(|own| *own = own.at_most(limits.quantity));
            found.joint.iter_mut().for_each(|own| *own = own.at_most(limits.joint));
        }
        Some(ProcessPoint { evidence: found, change })
    }

    /// The evidence on the chart that raises alarms: the largest of all charts as multiples of their limits, so that it is above its own
    /// limit whenever one of them is.
    fn raised(&self, found: &LossEvidence) -> Option<Evidence> {
        let Some(joint) = found.joint else { return found.quantities.iter().flatten().next().copied() };
        let limits = self.reference.limits;
        let mut raised = joint;
        for own in found.quantities.iter().flatten() {
            raised.fast = raised.fast.max(own.fast * limits.joint.fast / limits.quantity.fast);
            raised.slow = raised.slow.max(own.slow * limits.joint.slow / limits.quantity.slow);
        }
        Some(raised)
    }

    /// Takes from the charts of quantities that have probably not changed what the change of others explains.
    fn spare(&self, found: &mut LossEvidence, change: &LastingChange) {
        let may_have_changed =
            |name: &String| change.changes.iter().chain(&change.candidates).any(|own| own.name == *name);
        for (name, own) in self.reference.process.quantities.iter().zip(&mut found.quantities) {
            if let Some(own) = own.as_mut().filter(|_| !may_have_changed(name)) {
                *own = own.at_most(self.reference.limits.quantity);
            }
        }
    }

    /// Whether the change that is followed has gone, as after a repair: the last batches do not show it, or a change of the same
    /// proportions in the opposite direction shows. Both are compared with the limits of all quantities together.
    fn has_gone(&self) -> bool {
        let Some(followed) = &self.memory.followed else { return false };
        let limits = self.reference.limits.joint;
        if followed.gone(&self.prior.signs) > limits.fast {
            return true;
        }
        let ages = AGES.into_iter().filter(|age| *age <= self.innovations.len());
        let mut found = Evidence::NONE;
        for age in ages {
            let since = &self.innovations[self.innovations.len() - age..];
            let since = score(since, self.filter.contributions(), Courses::Step);
            found.take(age, followed.opposite(&since, &self.prior.signs));
        }
        found.fast > limits.fast || found.slow > limits.slow
    }

    /// Follows the change while its evidence is `above` a limit: the one that is followed already, or that of the window if its evidence is
    /// not smaller.
    fn follow(&mut self, above: Option<Evidence>, in_window: Option<(Evidence, &Change)>) {
        let largest = |e: Evidence| e.fast.max(e.slow);
        let Some(above) = above else {
            self.memory.followed = None;
            return;
        };
        if self.memory.followed.is_some() && in_window.map_or(0.0, |(evidence, _)| largest(evidence)) < largest(above) {
            return;
        }
        let found = in_window.map(|(_, found)| found);
        // A change that began before the window looks as if it had begun with its first batch.
        if self.is_older() && found.is_some_and(|found| found.onset_interval[0] == 0) {
            return;
        }
        self.memory.followed = found.map(|found| {
            let [first, last] = found.onset_interval;
            let interval = [self.times[first][0], self.times[last][1]];
            let since = &self.innovations[found.onset..];
            Followed::since(self.times[found.onset][1], interval, since, self.filter.contributions())
        });
    }

    /// Whether the change that is followed began before the window.
    fn is_older(&self) -> bool {
        self.memory.followed.as_ref().is_some_and(|followed| followed.onset < self.times[0][1])
    }

    /// Conditions of the newest batch that the reference has not seen.
    fn not_seen(&self, estimate: &BatchEstimate) -> Vec<String> {
        let process = &self.reference.process;
        process.coverage.as_ref().map_or_else(Vec::new, |seen| seen.not_seen(&process.covariates, estimate))
    }

    /// The change that the charts show with a batch. `found`: as the window shows it.
    fn change(&self, estimate: &BatchEstimate, fast: bool, found: Option<Change>) -> Option<LastingChange> {
        // A change that began before the window is known by its score alone.
        let followed = self.memory.followed.as_ref().filter(|_| self.is_older());
        let (parts, predicted, onset, onset_interval) = if let Some(followed) = followed {
            let parts = followed.parts(&self.prior)?;
            (parts, followed.score.predicted.clone(), followed.onset, followed.onset_interval)
        } else {
            let found = found?;
            let since = &self.innovations[found.onset..];
            let predicted = score(since, self.filter.contributions(), Courses::StepAndGrowth).predicted;
            let [first, last] = found.onset_interval;
            (found.parts, predicted, self.times[found.onset][1], [self.times[first][0], self.times[last][1]])
        };
        // The filter takes a part of the change for weather.
        let taken = predicted * &parts.coefficients;
        let (newest, process) = (self.innovations.last()?, &self.reference.process);
        let usual = &self.filter.numbers().mean;
        let quantity = |k: usize| {
            let (mean, std) = parts.change[k]?;
            let scale = process.scales[k];
            let ends = [mean - NORMAL_95 * std, mean + NORMAL_95 * std].map(|end| scale.unit * end);
            Some(QuantityChange {
                name: process.quantities[k].clone(),
                unit: process.units[k].clone(),
                probability: parts.probability[k],
                towards_damage: self.prior.signs[k] * mean > 0.0,
                change: scale.unit * mean,
                interval: ends,
                reference_mean: scale.origin + scale.unit * usual[k],
                explained: scale.unit * (newest.predicted[k] - usual[k] - taken[k]),
            })
        };
        let of_factor = |[probability, mean, std]: [f64; 3]| QuantityChange {
            name: ALL_FREQUENCIES.to_owned(),
            unit: LOGARITHM.to_owned(),
            probability,
            towards_damage: false,
            change: mean,
            interval: [mean - NORMAL_95 * std, mean + NORMAL_95 * std],
            reference_mean: 0.0,
            explained: 0.0,
        };
        let mut all: Vec<QuantityChange> = (0..usual.len()).filter_map(quantity).collect();
        all.extend(parts.factor.map(of_factor));
        let changes: Vec<QuantityChange> = all.extract_if(.., |own| own.probability > NAMED).collect();
        let least = if changes.is_empty() { POSSIBLE } else { PROBABLE };
        all.retain(|own| own.probability > least);
        all.sort_by(|a, b| b.probability.total_cmp(&a.probability));
        let (candidates, not_seen, coinciding) = (all, self.not_seen(estimate), Vec::new());
        Some(LastingChange { fast, onset, onset_interval, changes, candidates, not_seen, coinciding })
    }
}
