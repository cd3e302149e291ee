//! A table as people export it, with the options of its sender: any bytes give batches or problems that name an option, a column or a
//! line, never a panic. Every row is in exactly one batch or refused, and no batch spans more than its sender allows.
//!
//! The first line of the input is the query, such as `columns=f1=Erste Biegung,time=#1&zone=UTC&split=1d`; the rest is the table.
#![no_main]

use std::collections::BTreeSet;
use std::sync::OnceLock;

use libfuzzer_sys::fuzz_target;
use modalwatch::baseline::library::find_structure;
use modalwatch::measurement::check::{EachCheck, Problem};
use modalwatch::measurement::table::options::{OptionTexts, TableOptions};
use modalwatch::measurement::table::plan::{plan, too_long, PlannedBatch};
use modalwatch::measurement::table::refused::Refused;
use modalwatch::measurement::table::{read, Layout};
use modalwatch::measurement::{Covariate, CovariateKind};
use modalwatch::quantity::Timestamp;
use modalwatch::simulator::Simulator;

/// Largest number of measurements of a batch.
const MOST: usize = 50;

fn simulator() -> &'static Simulator {
    static SIMULATOR: OnceLock<Simulator> = OnceLock::new();
    SIMULATOR.get_or_init(|| find_structure("three-dof").unwrap())
}

fn named(problems: &[Problem]) {
    for problem in problems {
        assert!(!problem.pointer.is_empty() && !problem.message.is_empty(), "{problem:?}");
        assert!(problem.message.len() < 4_000, "{problem:?}");
    }
}

fuzz_target!(|bytes: &[u8]| {
    let end = bytes.iter().position(|byte| *byte == b'\n').unwrap_or(bytes.len());
    let Ok(query) = std::str::from_utf8(&bytes[..end]) else { return };
    let table = bytes.get(end + 1..).unwrap_or_default();
    let mut texts = OptionTexts::default();
    for (name, value) in query.split('&').filter_map(|part| part.split_once('=')) {
        let place = match name {
            "columns" => &mut texts.columns,
            "ignore" => &mut texts.ignore,
            "zone" => &mut texts.zone,
            "date_order" => &mut texts.date_order,
            "decimal" => &mut texts.decimal,
            "unit" => &mut texts.unit,
            "time_unit" => &mut texts.time_unit,
            "split" => &mut texts.split,
            _ => continue,
        };
        *place = Some(value);
    }
    let options = match TableOptions::parse(&texts) {
        Ok(options) => options,
        Err(problems) => {
            assert!(problems.iter().all(|problem| problem.pointer.starts_with("query/")), "{problems:?}");
            return named(&problems);
        }
    };
    let points = ["m1".to_owned(), "m2".to_owned()];
    let covariates =
        [Covariate::new("temperature_c", CovariateKind::Number), Covariate::new("Operator", CovariateKind::Category)];
    let layout = Layout { modes: 3, covariates: &covariates, points: &points };
    let reading = read(table, &layout, &options);
    named(&reading.problems);
    let (mut rows, mut unreadable) = (0, Refused::new(0));
    reading.each_row(&mut unreadable, |_, _| rows += 1);
    rows += unreadable.count();
    assert!(reading.problems.is_empty() || rows == 0, "rows beside {:?}", reading.problems);
    assert!(reading.needs.is_empty() || !reading.problems.is_empty(), "{:?}", reading.needs);
    let is_read = reading.problems.is_empty();

    let now = Timestamp::from_micros(1_800_000_000_000_000).unwrap();
    let mut expectation = simulator().expectation(now, usize::MAX);
    expectation.covariates = &covariates;
    let mut check = EachCheck::new(expectation);
    let planned = plan(reading, options.split, MOST, |raw| check.check(raw));
    named(&planned.problems);
    named(planned.refused.first());
    if !is_read {
        assert!(planned.batches.is_empty());
        return;
    }
    assert_eq!(planned.understood.rows, rows, "rows that are neither read nor refused");
    let taken: usize = planned.batches.iter().map(PlannedBatch::count).sum();
    assert_eq!(taken + planned.refused.count(), rows);
    assert_eq!((planned.understood.accepted, planned.understood.refused), (taken, planned.refused.count()));
    let mut times = Vec::new();
    for batch in &planned.batches {
        let mut check = EachCheck::new(expectation);
        let measurements = planned.measurements(table, batch, |raw| check.check(raw));
        assert!(!measurements.is_empty() && measurements.len() == batch.count());
        let ends = (measurements[0].measured_at, measurements[measurements.len() - 1].measured_at);
        assert_eq!(ends, (batch.from, batch.to));
        times.extend(measurements.iter().map(|measurement| measurement.measured_at.micros()));
    }
    assert_eq!(times.iter().collect::<BTreeSet<_>>().len(), taken, "a time is in two places");
    assert!(times.is_sorted(), "batches are in the order of time");
    if planned.problems.is_empty() {
        assert!(taken > 0 && planned.batches.iter().all(|batch| batch.count() <= MOST));
        let span = (planned.batches[0].from, planned.batches[planned.batches.len() - 1].to);
        assert!(options.split.is_some() || too_long(taken, span).is_none());
    }
});
