//! The process of an undamaged reference, and the chain of batches that are compared with it.

use serde::{Deserialize, Serialize};

use super::change::{change, evidence, Change, Evidence, LossEvidence, AGES, WINDOW};
use super::detectable::{detectable, Detectable};
use super::direction::ChangeDirection;
use super::estimate::{percent, BatchEstimate};
use super::filter::{Filter, Innovation, Known};
use super::fit::{observations, Error, Fit, Quantities, Watch};
use super::followed::{Followed, Memory};
use super::lasting::LastingChange;
use super::limits::{self, Limits};
use super::misfit::MisfitBasis;
use super::model::Process;
use super::one_factor::FactorPoint;
use super::parts::ChangePrior;
use super::score::{score, Courses};
use structures::quantity::Timestamp;

/// Name of the chart of all quantities together; no parameter can have a colon in its name.
pub const JOINT_SERIES: &str = "structure:joint";

/// Seed of the simulated limits. It is fixed, so that they depend on nothing but the reference and the wanted run length.
const SEED: u64 = 1;

/// The process of an undamaged reference with the limits of its charts.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ReferenceProcess {
    /// The process.
    pub process: Process,
    /// In which direction a change of each quantity is looked for, `[d]`.
    pub directions: Vec<ChangeDirection>,
    /// Limits of the charts.
    pub limits: Limits,
    /// Mean number of healthy batches to a false alarm for which the limits were computed.
    pub mean_run_batches: f64,
    /// The smallest lasting losses that the charts find; empty in references of earlier versions of the program.
    #[serde(default)]
    pub detectable: Vec<Detectable>,
    /// MisfitBasis of the simulation that its batches show: both statistics of the test of fit divided by their degrees of freedom, 1 where
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
    /// Usual difference of measured and simulated ln f of each mode, `[modes]`, which is taken out of all batches; empty where there is none, and
    /// in references of earlier versions of the program.
    #[serde(default)]
    pub usual_ln: Vec<f64>,
    /// What one factor of all frequencies does to the quantities, in their units, in ascending order; empty where it is not computed, and in
    /// references of earlier versions of the program.
    #[serde(default)]
    pub one_factor: Vec<FactorPoint>,
    /// The coordinates of the misfit, which are its last quantities; `None` where the modes determine nothing beside the parameters, and in
    /// references of earlier versions of the program.
    #[serde(default)]
    pub misfit: Option<MisfitBasis>,
    /// Logarithm of the evidence for the process, nats; 0 in references of earlier versions of the program.
    #[serde(default)]
    pub(super) log_evidence: f64,
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
    pub(super) reference: &'a ReferenceProcess,
    pub(super) filter: &'a Filter,
    pub(super) prior: ChangePrior,
    /// A change that is certainly smaller raises no alarm, in per cent.
    smallest_percent: f64,
    known: Known,
    before: Option<Timestamp>,
    /// The last innovations with the times of their batches and of the batches before, at most [`WINDOW`].
    pub(super) innovations: Vec<Innovation>,
    pub(super) times: Vec<[Timestamp; 2]>,
    pub(super) memory: Memory,
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
        let fit = Fit::of(quantities, covariates, &estimates, watch)?;
        let log_evidence = fit.log_evidence;
        let process = fit.with_draws()?;
        let singular = || Error::Search("a covariance is not positive definite".to_owned());
        let limits = limits::watched(&process, &quantities.directions, mean_run_batches, SEED, watch);
        let limits = limits.ok_or_else(singular)?;
        let filter = Filter::of(&process);
        let mut known = filter.start();
        for observation in observations(&process, &estimates) {
            known = filter.step(&known, &observation).ok_or_else(singular)?.0;
        }
        Ok(Self {
            detectable: detectable(&process, &quantities.directions, &limits),
            process,
            directions: quantities.directions.clone(),
            limits,
            mean_run_batches,
            usual_misfit,
            scatter: Vec::new(),
            noise: Vec::new(),
            usual_ln: Vec::new(),
            one_factor: Vec::new(),
            misfit: quantities.misfit.clone(),
            log_evidence,
            end: known.to_numbers(),
        })
    }

    /// The first lasting change that its charts show in batches outside the reference, in any order.
    pub fn first_change(&self, mut estimates: Vec<BatchEstimate>) -> Option<LastingChange> {
        let filter = Filter::of(&self.process);
        estimates.sort_by_key(|estimate| estimate.at);
        let mut chain = Chain::start(self, &filter, estimates.first()?.at);
        estimates.iter().find_map(|estimate| chain.take(estimate)?.change)
    }

    /// The names of its charts: each quantity with a damage direction, then all and the misfit together if there are several.
    pub fn series(&self) -> Vec<String> {
        let charted = self.process.quantities.iter().zip(&self.directions).filter(|(_, own)| own.is_damage());
        let mut names: Vec<String> = charted.map(|(name, _)| name.clone()).collect();
        let has_misfit = self.directions.contains(&ChangeDirection::Either);
        if names.len() > 1 || !names.is_empty() && has_misfit {
            names.push(JOINT_SERIES.to_owned());
        }
        names
    }

    /// The series whose chart raises alarms: that of all quantities together, or of the only one. An event thus raises one alarm.
    pub fn alarm_series(&self) -> Option<String> {
        self.series().pop()
    }

    /// What is known of changes before batches are looked at.
    pub(super) fn change_prior(&self) -> ChangePrior {
        let Process { scales, units, .. } = &self.process;
        let mean = self.process.numbers().mean;
        let size = |k: usize| {
            if self.directions[k] == ChangeDirection::Either {
                return self.misfit.as_ref().map_or(1.0, |misfit| misfit.size(k - (mean.len() - misfit.count())))
                    / scales[k].unit;
            }
            let share = percent(&units[k], scales[k].origin + scales[k].unit * mean[k], scales[k].unit).abs() / 100.0;
            // The mean of a quantity may be 0: the scatter of the reference is its size then.
            share.recip().max(1.0)
        };
        let standardised = |point: &FactorPoint| {
            let changes = point.changes.iter().zip(scales).map(|(change, scale)| change / scale.unit);
            FactorPoint { ln_factor: point.ln_factor, changes: changes.collect() }
        };
        ChangePrior {
            directions: self.directions.clone(),
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
        let directions = &self.prior.directions;
        if self.has_gone() {
            // What the states took of the change for weather is given back.
            if let Some(followed) = self.memory.followed.take() {
                self.known.mean -= followed.taken(directions);
            }
            self.memory.begin = Some(estimate.at);
            self.forget();
        }
        let mut found = evidence(&self.innovations, self.filter.contributions(), &self.prior.directions);
        let in_window = self.raised(&found);
        if let Some((alone, [joint, misfit])) =
            self.memory.followed.as_ref().map(|followed| followed.score.evidence(&self.prior.directions))
        {
            for (own, z) in found.quantities.iter_mut().zip(&alone) {
                if let Some(own) = own {
                    own.slow = own.slow.max(*z);
                }
            }
            if let Some(own) = &mut found.joint {
                own.slow = own.slow.max(joint);
            }
            if let Some(own) = &mut found.misfit {
                own.slow = own.slow.max(misfit);
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
        if let Some((own, limit)) = found.misfit.zip(limits.misfit) {
            raised.fast = raised.fast.max(own.fast * limits.joint.fast / limit.fast);
            raised.slow = raised.slow.max(own.slow * limits.joint.slow / limit.slow);
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
        if followed.gone(&self.prior.directions) > limits.fast {
            return true;
        }
        let ages = AGES.into_iter().filter(|age| *age <= self.innovations.len());
        let mut found = Evidence::NONE;
        for age in ages {
            let since = &self.innovations[self.innovations.len() - age..];
            let since = score(since, self.filter.contributions(), Courses::Step);
            found.take(age, followed.opposite(&since, &self.prior.directions));
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
            Followed::since(self.times[found.onset][1], interval, found.growth_ends, since, self.filter.contributions())
        });
    }

    /// Whether the change that is followed began before the window.
    pub(super) fn is_older(&self) -> bool {
        self.memory.followed.as_ref().is_some_and(|followed| followed.onset < self.times[0][1])
    }
}
