//! A change inside the batches of a reference is said, and weather is none.

use modalwatch::process::estimate::BatchEstimate;
use modalwatch::process::lasting::LastingChange;
use rayon::prelude::*;

use super::parts::{Structure, NAMES};
use super::watch::{named, quantities, reference};
use super::{worlds, z24};

/// Sizes of the references.
const SIZES: [usize; 4] = [30, 60, 120, 365];

/// The change that lies in some batches, when they are declared as a reference.
fn contained(names: &[&str], unit: &str, batches: &[BatchEstimate]) -> Option<LastingChange> {
    let quantities = quantities(names, unit);
    reference(&quantities, batches, 1_000.0).change_inside(&quantities, batches.to_vec())
}

/// What is said of references of healthy structures and of those in which a part loses 3 to 20 % at some time, a tenth of the batches from
/// either end.
#[derive(Debug, Default, Clone, Copy)]
struct Counts {
    healthy: usize,
    said_of_healthy: usize,
    lost: usize,
    said: usize,
    named: usize,
    accusing: usize,
    dated: usize,
}

impl Counts {
    fn and(self, o: Self) -> Self {
        Self {
            healthy: self.healthy + o.healthy,
            said_of_healthy: self.said_of_healthy + o.said_of_healthy,
            lost: self.lost + o.lost,
            said: self.said + o.said,
            named: self.named + o.named,
            accusing: self.accusing + o.accusing,
            dated: self.dated + o.dated,
        }
    }
}

fn world(seed: u64) -> Counts {
    let structure = Structure::new(3_000 + seed);
    let names = &NAMES[..structure.parts()];
    let size = SIZES[seed as usize % SIZES.len()];
    let healthy = contained(names, "N/m", &structure.batches(1, size, |_, _| 0.0));
    let part = (seed / 7) as usize % structure.parts();
    let onset = size / 10 + (seed as usize * 37) % (size - 2 * (size / 10));
    let loss = [0.03, 0.05, 0.1, 0.2][(seed / 4) as usize % 4];
    let batches = structure.batches(2, size, |t, k| if k == part && t >= onset { loss } else { 0.0 });
    let found = contained(names, "N/m", &batches);
    let [certain, _] = named(found.as_ref());
    let dated = found.as_ref().is_some_and(|change| {
        let [from, to] = change.onset_interval;
        from <= batches[onset].at && batches[onset].at <= to
    });
    Counts {
        healthy: 1,
        said_of_healthy: usize::from(healthy.is_some()),
        lost: 1,
        said: usize::from(found.is_some()),
        named: usize::from(certain.contains(&NAMES[part])),
        accusing: usize::from(certain.iter().any(|name| *name != NAMES[part])),
        dated: usize::from(dated),
    }
}

fn counts(worlds: impl IntoParallelIterator<Item = u64>) -> Counts {
    let found = worlds.into_par_iter().map(world).reduce(Counts::default, Counts::and);
    println!("{found:?}");
    found
}

#[test]
fn a_loss_inside_a_reference_is_said_and_weather_is_none() {
    // References of 30 and 60 batches, with losses of 5 to 20 %.
    let found = counts([4, 5, 12, 13]);
    assert!(found.said_of_healthy == 0 && found.accusing == 0, "{found:?}");
    assert!(found.said >= 3 && found.named == found.said && found.dated >= found.said - 1, "{found:?}");
}

#[test]
#[ignore = "a study of some minutes"]
fn losses_inside_references() {
    counts(0..48);
    // Weather of 5 % that lasts for nine days, over up to a year.
    let weather = |seed: u64| {
        let batches = worlds::world(seed, 0, |_| 1.0);
        let sizes = [60, 120, 365];
        sizes.map(|size| usize::from(contained(&worlds::NAMES, "N/m", &batches[..size]).is_some()))
    };
    let found: Vec<[usize; 3]> = (0..20).into_par_iter().map(weather).collect();
    let sums: Vec<usize> = (0..3).map(|place| found.iter().map(|own| own[place]).sum()).collect();
    println!("said of 20 healthy structures under weather, 60, 120 and 365 batches: {sums:?}");
    let Some((estimates, first_damaged)) = z24::batches() else { return };
    for size in [60, 84, 110, 130, first_damaged, estimates.len()] {
        let found = contained(&["ei", "pier", "gj"], "ln", &estimates[..size]);
        println!("Z24, {size} batches, damaged from {first_damaged} on: {:?}", found.map(|change| change.happening()));
    }
}
