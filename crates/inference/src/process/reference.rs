//! The process of an undamaged reference, and the chain of batches that are compared with it.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::change::{change, evidence, score, signs, Evidence, LossEvidence, AGES, WINDOW};
use super::detectable::{detectable, Detectable};
use super::estimate::BatchEstimate;
use super::filter::{Filter, Innovation, Known};
use super::fit::{fit, observations, Error, Quantities, Watch};
use super::followed::{Followed, Memory};
use super::limits::{self, Limits};
use super::model::Process;
use structures::parameter::DamageDirection;
use structures::quantity::Timestamp;

/// Name of the chart of all quantities together; no parameter can have a colon in its name.
pub const JOINT_SERIES: &str = "structure:joint";

/// Seed of the simulated limits. It is fixed, so that they depend on nothing but the reference and the wanted run length.
const SEED: u64 = 1;

/// 95 % quantile of the normal distribution, for intervals of 90 %.
const NORMAL_95: f64 = 1.645;

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
    /// The states after the last batch of the reference, as [`Known::to_numbers`] writes them.
    pub(super) end: Vec<f64>,
}

/// A lasting change on a chart that is above its limit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct LastingChange {
    /// Whether the fast chart is above its limit, which finds steps; otherwise only the slow one is, which finds small lasting losses.
    pub fast: bool,
    /// Time of the first batch after the most probable onset.
    pub onset: Timestamp,
    /// Interval of 90 % for the onset: from the last batch before it to the first one after it.
    pub onset_interval: [Timestamp; 2],
    /// Change of each quantity that takes part.
    pub changes: Vec<QuantityChange>,
    /// Conditions of the newest batch that the reference has not seen, each in some words: they may be a part of the cause.
    #[serde(default)]
    pub not_seen: Vec<String>,
}

/// The change of a quantity since an onset.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct QuantityChange {
    /// Its name.
    pub name: String,
    /// Its unit.
    pub unit: String,
    /// Most probable change that the process does not explain, in the unit of the quantity.
    pub change: f64,
    /// Its interval of 90 %.
    pub interval: [f64; 2],
    /// Mean of the quantity in the reference, in its unit.
    pub reference_mean: f64,
    /// Difference from that mean that the weather and other healthy causes explain at the newest batch, in its unit.
    pub explained: f64,
}

/// A batch on the charts of a process.
#[derive(Debug, Clone, PartialEq)]
pub struct ProcessPoint {
    /// Evidence for a loss.
    pub evidence: LossEvidence,
    /// The changes by the series of the charts that are above a limit.
    pub changes: BTreeMap<String, LastingChange>,
}

/// Batches that are compared with the process, in the order of their times.
#[derive(Clone)]
pub struct Chain<'a> {
    reference: &'a ReferenceProcess,
    filter: &'a Filter,
    signs: Vec<f64>,
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
        let process = fit(quantities, covariates, &estimates, watch)?;
        let singular = || Error::Search("a covariance is not positive definite".to_owned());
        let limits = limits::watched(&process, &signs(&quantities.directions), mean_run_batches, SEED, watch);
        let limits = limits.ok_or_else(singular)?;
        let filter = Filter::of(&process);
        let mut known = filter.start();
        for observation in observations(&process, &estimates) {
            known = filter.step(&known, &observation).ok_or_else(singular)?.0;
        }
        Ok(Self {
            detectable: detectable(&process, &limits),
            process,
            directions: quantities.directions.clone(),
            limits,
            mean_run_batches,
            usual_misfit,
            scatter: Vec::new(),
            noise: Vec::new(),
            end: known.to_numbers(),
        })
    }

    /// The first lasting change that its charts show in batches outside the reference, in any order. The joint chart is preferred,
    /// because it names all quantities that take part.
    pub fn first_change(&self, mut estimates: Vec<BatchEstimate>) -> Option<LastingChange> {
        let filter = Filter::of(&self.process);
        estimates.sort_by_key(|estimate| estimate.at);
        let mut chain = Chain::start(self, &filter, estimates.first()?.at);
        estimates.iter().find_map(|estimate| {
            let mut changes = chain.take(estimate)?.changes;
            let joint = changes.remove(JOINT_SERIES);
            joint.or_else(|| changes.into_values().next())
        })
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

impl Known {
    /// Mean, then covariance by columns.
    pub fn to_numbers(&self) -> Vec<f64> {
        self.mean.iter().chain(self.covariance.iter()).copied().collect()
    }

    /// The inverse of [`Self::to_numbers`]; `None` if the number of values does not fit.
    pub fn from_numbers(numbers: &[f64]) -> Option<Self> {
        let n = (1..=numbers.len()).find(|n| n + n * n >= numbers.len()).filter(|n| n + n * n == numbers.len())?;
        let (mean, covariance) = numbers.split_at(n);
        Some(Self { mean: DVector::from_column_slice(mean), covariance: DMatrix::from_column_slice(n, n, covariance) })
    }
}

impl<'a> Chain<'a> {
    /// The chain before its first batch, which was measured at `first`: after the reference it continues from the states there.
    pub fn start(reference: &'a ReferenceProcess, filter: &'a Filter, first: Timestamp) -> Self {
        let end = reference.process.period[1];
        let continued = Known::from_numbers(&reference.end).filter(|_| first > end);
        let before = continued.as_ref().map(|_| end);
        Self {
            known: continued.unwrap_or_else(|| filter.start()),
            before,
            signs: signs(&reference.directions),
            reference,
            filter,
            innovations: Vec::new(),
            times: Vec::new(),
            memory: Memory::default(),
        }
    }

    /// The chain after a batch at `at`, where the states were `known`.
    pub fn resume(reference: &'a ReferenceProcess, filter: &'a Filter, known: Known, at: Timestamp) -> Self {
        Self { known, before: Some(at), ..Self::start(reference, filter, at) }
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
        if self.has_gone() {
            // What the states took of the change for weather is given back.
            if let Some(followed) = self.memory.followed.take() {
                self.known.mean -= followed.taken(&self.signs);
            }
            self.memory.begin = Some(estimate.at);
            self.forget();
        }
        let mut found = evidence(&self.innovations, self.filter.contributions(), &self.signs);
        let in_window = found.clone();
        if let Some((alone, joint)) = self.memory.followed.as_ref().map(|followed| followed.score.evidence(&self.signs))
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
        let point = ProcessPoint { evidence: found, changes: BTreeMap::new() };
        let above: Vec<(String, Evidence)> = self
            .reference
            .series()
            .into_iter()
            .filter_map(|series| Some((series.clone(), self.above(&point, &series)?)))
            .collect();
        self.follow(&above, &in_window);
        let not_seen = self.not_seen(estimate);
        let change = |(series, evidence): (String, Evidence)| {
            let fast = evidence.fast > self.reference.limits_of(&series).fast;
            let change = self.change(&series, fast)?;
            Some((series, LastingChange { not_seen: not_seen.clone(), ..change }))
        };
        Some(ProcessPoint { changes: above.into_iter().filter_map(change).collect(), ..point })
    }

    /// The evidence of a series if it is above a limit.
    fn above(&self, point: &ProcessPoint, series: &str) -> Option<Evidence> {
        let limits = self.reference.limits_of(series);
        point.of_series(self.reference, series).filter(|e| e.fast > limits.fast || e.slow > limits.slow)
    }

    /// Whether the change that is followed has gone, as after a repair: the last batches do not show it, or a change of the same
    /// proportions in the opposite direction shows. Both are compared with the limits of all quantities together.
    fn has_gone(&self) -> bool {
        let Some(followed) = &self.memory.followed else { return false };
        let limits = self.reference.limits.joint;
        if followed.gone(&self.signs) > limits.fast {
            return true;
        }
        let ages = AGES.into_iter().filter(|age| *age <= self.innovations.len());
        let mut found = Evidence::NONE;
        for age in ages {
            let since = score(&self.innovations[self.innovations.len() - age..], self.filter.contributions());
            found.take(age, followed.opposite(&since, &self.signs));
        }
        found.fast > limits.fast || found.slow > limits.slow
    }

    /// Follows the change of the series that are above a limit: the one that is followed already, or that of the window if its evidence
    /// is larger.
    fn follow(&mut self, above: &[(String, Evidence)], in_window: &LossEvidence) {
        let largest = |e: &Evidence| e.fast.max(e.slow);
        let Some((series, strongest)) = above.iter().max_by(|a, b| largest(&a.1).total_cmp(&largest(&b.1))) else {
            self.memory.followed = None;
            return;
        };
        let point = ProcessPoint { evidence: in_window.clone(), changes: BTreeMap::new() };
        let own = point.of_series(self.reference, series).map_or(0.0, |e| largest(&e));
        if self.memory.followed.is_some() && own < largest(strongest) {
            return;
        }
        let only = self.reference.process.quantities.iter().position(|name| name == series);
        let found = change(&self.innovations, self.filter.contributions(), &self.signs, only);
        // A change that began before the window looks as if it had begun with its first batch.
        let is_older = self.memory.followed.as_ref().is_some_and(|followed| followed.onset < self.times[0][1]);
        if is_older && found.as_ref().is_some_and(|found| found.onset_interval[0] == 0) {
            return;
        }
        self.memory.followed = found.map(|found| {
            let [first, last] = found.onset_interval;
            let interval = [self.times[first][0], self.times[last][1]];
            let since = &self.innovations[found.onset..];
            Followed::since(self.times[found.onset][1], interval, since, self.filter.contributions())
        });
    }

    /// Conditions of the newest batch that the reference has not seen.
    fn not_seen(&self, estimate: &BatchEstimate) -> Vec<String> {
        let process = &self.reference.process;
        process.coverage.as_ref().map_or_else(Vec::new, |seen| seen.not_seen(&process.covariates, estimate))
    }

    /// The change on a chart that is above its limit.
    fn change(&self, series: &str, fast: bool) -> Option<LastingChange> {
        let process = &self.reference.process;
        let only = process.quantities.iter().position(|name| name == series);
        let in_window = change(&self.innovations, self.filter.contributions(), &self.signs, only)?;
        // A change that began before the window is known by its score alone.
        let followed = self.memory.followed.as_ref().filter(|followed| followed.onset < self.times[0][1]);
        let predicted = followed.map_or_else(
            || score(&self.innovations[in_window.onset..], self.filter.contributions()).predicted,
            |followed| followed.score.predicted.clone(),
        );
        let losses = followed.map_or(in_window.losses, |followed| followed.losses(&self.signs, only));
        let change = |k: usize, _: usize| losses[k].map_or(0.0, |(mean, _)| self.signs[k] * mean);
        // The filter takes a part of the change for weather.
        let taken = predicted * DVector::from_fn(losses.len(), change);
        let onset = followed.map_or(self.times[in_window.onset][1], |followed| followed.onset);
        let ends = in_window.onset_interval;
        let onset_interval =
            followed.map_or([self.times[ends[0]][0], self.times[ends[1]][1]], |followed| followed.onset_interval);
        let newest = self.innovations.last()?;
        let numbers = self.filter.numbers();
        let quantity = |(k, loss): (usize, &Option<(f64, f64)>)| {
            let (mean, std) = (*loss)?;
            let (scale, sign) = (process.scales[k], self.signs[k]);
            let ends = [mean - NORMAL_95 * std, mean + NORMAL_95 * std].map(|end| sign * scale.unit * end);
            Some(QuantityChange {
                name: process.quantities[k].clone(),
                unit: process.units[k].clone(),
                change: sign * scale.unit * mean,
                interval: [ends[0].min(ends[1]), ends[0].max(ends[1])],
                reference_mean: scale.origin + scale.unit * numbers.mean[k],
                explained: scale.unit * (newest.predicted[k] - numbers.mean[k] - taken[k]),
            })
        };
        Some(LastingChange {
            fast,
            onset,
            onset_interval,
            changes: losses.iter().enumerate().filter_map(quantity).collect(),
            not_seen: Vec::new(),
        })
    }
}
