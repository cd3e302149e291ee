//! What the charts of a process state of a change: which quantities have certainly changed, which may have, by how much, and since when.

use super::change::Change;
use super::estimate::{percent, BatchEstimate, LOGARITHM};
use super::lasting::{LastingChange, QuantityChange, NORMAL_95};
use super::parts::Parts;
use super::reference::Chain;
use structures::parameter::ALL_FREQUENCIES;

/// A quantity has certainly changed if it has with a higher probability than this.
const NAMED: f64 = 0.9;

/// Where others certainly have, a quantity is a candidate above this probability.
const PROBABLE: f64 = 0.5;

/// Where none certainly has, a quantity is a candidate above this probability.
const POSSIBLE: f64 = 0.05;

/// Standard deviation of a change that the error of the simulation leaves, as a share of the change, however many batches show it.
const ERROR_OF_CHANGE: f64 = 0.01;

impl Chain<'_> {
    /// Conditions of the newest batch that the reference has not seen.
    fn not_seen(&self, estimate: &BatchEstimate) -> Vec<String> {
        let process = &self.reference.process;
        process.coverage.as_ref().map_or_else(Vec::new, |seen| seen.not_seen(&process.covariates, estimate))
    }

    /// The change of the misfit, whose coordinates are `places`.
    fn misfit_change(&self, places: &[usize], parts: &Parts) -> Option<QuantityChange> {
        let misfit = self.reference.misfit.as_ref()?;
        let coordinate = |k: &usize| {
            let unit = self.reference.process.scales[*k].unit;
            parts.change[*k].map(|(mean, std)| (unit * mean, unit * std))
        };
        let coordinates = places.iter().map(coordinate).collect::<Option<Vec<_>>>()?;
        Some(misfit.change(parts.probability[*places.first()?], &coordinates))
    }

    /// The change that the charts show with a batch. `found`: as the window shows it.
    pub(super) fn change(&self, estimate: &BatchEstimate, fast: bool, found: Option<Change>) -> Option<LastingChange> {
        // A change that began before the window is known by its score alone.
        let followed = self.memory.followed.as_ref().filter(|_| self.is_older());
        let (parts, onset, onset_interval) = if let Some(followed) = followed {
            (followed.parts(&self.prior)?, followed.onset, followed.onset_interval)
        } else {
            let found = found?;
            let [first, last] = found.onset_interval;
            (found.parts, self.times[found.onset][1], [self.times[first][0], self.times[last][1]])
        };
        let (newest, process) = (self.innovations.last()?, &self.reference.process);
        let usual = &self.filter.numbers().mean;
        let quantity = |k: usize| {
            let (mean, std) = parts.change[k]?;
            let scale = process.scales[k];
            // The filter takes a part of the change for weather.
            let explained = scale.unit * (newest.predicted[k] - usual[k] - parts.predicted[k]);
            let reference_mean = scale.origin + scale.unit * usual[k];
            // What the weather does to a stiffness is a share of what is left of it.
            let of_weather = percent(&process.units[k], reference_mean, explained) / 100.0;
            let std = std.hypot(mean * ERROR_OF_CHANGE.hypot(of_weather));
            let ends = [mean - NORMAL_95 * std, mean + NORMAL_95 * std].map(|end| scale.unit * end);
            Some(QuantityChange {
                name: process.quantities[k].clone(),
                unit: process.units[k].clone(),
                probability: parts.probability[k],
                towards_damage: self.prior.directions[k].sign() * mean > 0.0,
                change: scale.unit * mean,
                interval: ends,
                reference_mean,
                explained,
                modes: Vec::new(),
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
            modes: Vec::new(),
        };
        let (of_misfit, of_parameters): (Vec<usize>, Vec<usize>) =
            (0..usual.len()).partition(|k| self.prior.is_of_misfit(*k));
        // What the parameters show beside a change of the misfit is only what comes nearest to it.
        let of_misfit = self.misfit_change(&of_misfit, &parts);
        let mut all: Vec<QuantityChange> =
            of_misfit.into_iter().chain(of_parameters.into_iter().filter_map(quantity)).collect();
        all.extend(parts.factor.map(of_factor));
        let changes: Vec<QuantityChange> = all.extract_if(.., |own| own.probability > NAMED).collect();
        let least = if changes.is_empty() { POSSIBLE } else { PROBABLE };
        all.retain(|own| own.probability > least);
        all.sort_by(|a, b| b.probability.total_cmp(&a.probability));
        let (candidates, not_seen, coinciding) = (all, self.not_seen(estimate), Vec::new());
        Some(LastingChange { fast, onset, onset_interval, changes, candidates, not_seen, coinciding })
    }
}
