//! The Z24 bridge: a year of weather, then the settlement of a pier.

use modalwatch::process::estimate::BatchEstimate;
use modalwatch::quantity::Timestamp;

use super::estimates::{data, estimate, rows, simulator, Row};
use super::watch::{quantities, reference, watch};

/// First damaged row of the table.
pub(super) const DAMAGED_FROM: usize = 3_474;

/// Rows of a batch: about a day.
pub(super) const ROWS: usize = 24;

/// The time of a batch.
fn at(batch: usize) -> Timestamp {
    Timestamp::from_micros(86_400_000_000 * batch as i64).unwrap()
}

/// The estimates of all batches, and the first batch with damaged rows; `None` without the data.
pub(super) fn batches() -> Option<(Vec<BatchEstimate>, usize)> {
    let csv = data("z24-bridge/z24_frequencies.csv")?;
    let simulator = simulator("z24.toml");
    let is_ordered = |row: &Row| row.frequencies_hz[3].is_none_or(|f4| row.frequencies_hz[2].unwrap() < f4);
    let rows: Vec<Row> = rows(&csv, 4).into_iter().filter(is_ordered).collect();
    let batches: Vec<&[Row]> = rows.chunks(ROWS).collect();
    let damaged = |rows: &&[Row]| rows.iter().any(|row| row.number >= DAMAGED_FROM);
    let first_damaged = batches.iter().position(damaged).unwrap();
    Some((batches.iter().enumerate().map(|(t, rows)| estimate(&simulator, rows, at(t))).collect(), first_damaged))
}

#[test]
fn a_year_of_the_z24_bridge_raises_no_alarm_and_the_settlement_of_its_pier_does() {
    let Some((estimates, first_damaged)) = batches() else { return };
    let quantities = quantities(&["ei", "pier", "gj"], "ln");
    for size in [60, 84, 110] {
        let reference = reference(&quantities, &estimates[..size], 1_000.0);
        let changes = watch(&reference, &estimates[size..]);
        let alarms: Vec<usize> = (size..estimates.len()).filter(|t| changes[t - size].is_some()).collect();
        let first = alarms[0];
        println!(
            "reference {size}: {} factors, limits {:.2?}; damage from batch {first_damaged} on, first alarm with batch {first}",
            reference.process.factors, reference.limits
        );
        let change = changes.last().unwrap().as_ref().expect("the alarm lasts");
        println!("  {}", change.sentence());
        // The first batch with damaged rows has 18 of 24, the second is the first that is damaged throughout.
        assert!((first_damaged..=first_damaged + 2).contains(&first), "{size}: {alarms:?}");
        assert!(
            change.onset_interval[0] <= at(first_damaged + 1) && change.onset <= at(first_damaged + 2),
            "{change:?}"
        );
        // The bending stiffness is within its season: no damaged batch is as low as the lowest healthy one after the reference.
        let ei = |t: usize| estimates[t].mean[0].unwrap();
        let lowest = |range: std::ops::Range<usize>| range.map(ei).fold(f64::INFINITY, f64::min);
        let [healthy, damaged] = [lowest(size..first_damaged), lowest(first_damaged..estimates.len())];
        println!("  lowest ln ei, %: healthy {:.1}, damaged {:.1}", 100.0 * healthy, 100.0 * damaged);
        assert!(damaged > healthy);
        let certain = &change.changes;
        let may_have =
            |name: &str| certain.iter().chain(&change.candidates).any(|c| c.name == name && c.interval[1] < 0.0);
        assert!(may_have("pier") && may_have("gj") && !certain.is_empty(), "{change:?}");
    }
}

#[test]
#[ignore = "a study of some minutes"]
fn references_of_any_length_from_60_batches_on_raise_no_false_alarm_on_the_z24_bridge() {
    let Some((estimates, first_damaged)) = batches() else { return };
    let quantities = quantities(&["ei", "pier", "gj"], "ln");
    for size in (42..=138).step_by(6) {
        let reference = reference(&quantities, &estimates[..size], 1_000.0);
        let changes = watch(&reference, &estimates[size..]);
        let alarms: Vec<usize> = (size..estimates.len()).filter(|t| changes[t - size].is_some()).collect();
        println!("reference {size}: alarms {alarms:?}; damage from batch {first_damaged} on");
        // Shorter references have not seen enough of the winter.
        assert!(size < 60 || (first_damaged..=first_damaged + 2).contains(&alarms[0]), "{size}: {alarms:?}");
    }
}
