//! Watching batches with a reference: alarms, and how long they take.

use modalwatch::process::direction::ChangeDirection;
use modalwatch::process::estimate::BatchEstimate;
use modalwatch::process::filter::Filter;
use modalwatch::process::fit::Quantities;
use modalwatch::process::lasting::LastingChange;
use modalwatch::process::reference::{Chain, ReferenceProcess};

/// Quantities of which a decrease is damage.
pub fn quantities(names: &[&str], unit: &str) -> Quantities {
    Quantities {
        names: names.iter().map(|name| (*name).to_owned()).collect(),
        units: vec![unit.to_owned(); names.len()],
        directions: vec![ChangeDirection::Decrease; names.len()],
        misfit: None,
    }
}

/// The reference of some batches.
pub fn reference(quantities: &Quantities, estimates: &[BatchEstimate], mean_run_batches: f64) -> ReferenceProcess {
    ReferenceProcess::new(quantities, &[], estimates.to_vec(), mean_run_batches, [1.0; 2]).unwrap()
}

/// The change that the charts show with each batch; `None` while they are inside their limits.
pub fn watch(reference: &ReferenceProcess, estimates: &[BatchEstimate]) -> Vec<Option<LastingChange>> {
    let filter = Filter::of(&reference.process);
    let Some(first) = estimates.first() else { return Vec::new() };
    let mut chain = Chain::start(reference, &filter, first.at);
    estimates.iter().map(|e| chain.take(e)?.change).collect()
}

/// The quantities that have certainly changed, and those that may have.
pub fn named(change: Option<&LastingChange>) -> [Vec<&str>; 2] {
    let Some(change) = change else { return Default::default() };
    [&change.changes, &change.candidates].map(|of| of.iter().map(|own| own.name.as_str()).collect())
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
