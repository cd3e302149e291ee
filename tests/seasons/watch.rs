//! Watching batches with a reference: alarms, and how long they take.

use modalwatch::parameter::DamageDirection;
use modalwatch::process::estimate::BatchEstimate;
use modalwatch::process::filter::Filter;
use modalwatch::process::fit::Quantities;
use modalwatch::process::reference::{Chain, LastingChange, ReferenceProcess};

/// Quantities of which a decrease is damage.
pub fn quantities(names: &[&str], unit: &str) -> Quantities {
    Quantities {
        names: names.iter().map(|name| (*name).to_owned()).collect(),
        units: vec![unit.to_owned(); names.len()],
        directions: vec![DamageDirection::Decrease; names.len()],
    }
}

/// The reference of some batches.
pub fn reference(quantities: &Quantities, estimates: &[BatchEstimate], mean_run_batches: f64) -> ReferenceProcess {
    ReferenceProcess::new(quantities, &[], estimates.to_vec(), mean_run_batches, [1.0; 2]).unwrap()
}

/// The changes on the charts of a batch that are above their limits, with their series.
pub type Changes = Vec<(String, LastingChange)>;

/// [`Changes`] of each batch.
pub fn watch(reference: &ReferenceProcess, estimates: &[BatchEstimate]) -> Vec<Changes> {
    let filter = Filter::of(&reference.process);
    let Some(first) = estimates.first() else { return Vec::new() };
    let mut chain = Chain::start(reference, &filter, first.at);
    let changes = |e: &BatchEstimate| chain.take(e).map_or_else(Vec::new, |p| p.changes.into_iter().collect());
    estimates.iter().map(changes).collect()
}

/// Batches at which an episode begins: above a limit after at least `quiet` batches below.
pub fn episodes(above: &[bool], quiet: usize) -> Vec<usize> {
    let mut last: Option<usize> = None;
    let mut found = Vec::new();
    for (t, _) in above.iter().enumerate().filter(|(_, above)| **above) {
        if last.is_none_or(|last| t > last + quiet) {
            found.push(t);
        }
        last = Some(t);
    }
    found
}
