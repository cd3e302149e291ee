//! The Consoli Palace: two years without damage, one of them as reference.

use modalwatch::process::estimate::BatchEstimate;
use modalwatch::quantity::Timestamp;
use modalwatch::simulator::Simulator;

use super::estimates::{data, estimate, rows, simulator, Row};
use super::watch::{episodes, quantities, reference, watch};

/// Fewest frequencies of a mode in a day that make a mean of it.
const FEWEST: usize = 6;

/// Rows of the semi-synthetic loss of f1 in the README of the data, and its size, Hz.
const F1_LOSS: (std::ops::RangeInclusive<usize>, f64) = (24_999..=36_329, 0.029_825_53);

/// Days since the first one of the rows, from the column `time_local`.
fn days(csv: &str) -> Vec<i64> {
    let mut lines = csv.lines();
    let column = lines.next().unwrap().split(',').position(|name| name == "time_local").unwrap();
    let day = |line: &str| {
        let text = format!("{}T12:00:00Z", &line.split(',').nth(column).unwrap()[..10]);
        Timestamp::parse(&text).unwrap().micros().div_euclid(86_400_000_000)
    };
    let all: Vec<i64> = lines.map(day).collect();
    all.iter().map(|day| day - all[0]).collect()
}

/// The estimates of the days with at least three modes, with their days.
fn daily(simulator: &Simulator, rows: &[Row], days: &[i64]) -> Vec<(i64, BatchEstimate)> {
    let mut found = Vec::new();
    let mut start = 0;
    while start < rows.len() {
        let end = start + days[start..].iter().take_while(|day| **day == days[start]).count();
        let own = &rows[start..end];
        let counted: Vec<bool> =
            (0..5).map(|mode| own.iter().filter(|row| row.frequencies_hz[mode].is_some()).count() >= FEWEST).collect();
        if counted.iter().filter(|counted| **counted).count() >= 3 {
            let only = |row: &Row| Row {
                number: row.number,
                frequencies_hz: row.frequencies_hz.iter().zip(&counted).map(|(f, ok)| f.filter(|_| *ok)).collect(),
            };
            let own: Vec<Row> = own.iter().map(only).collect();
            let at = Timestamp::from_micros(86_400_000_000 * days[start]).unwrap();
            found.push((days[start], estimate(simulator, &own, at)));
        }
        start = end;
    }
    found
}

#[test]
#[ignore = "a study of a minute"]
fn charts_of_the_process_over_the_second_year_of_the_consoli_palace() {
    let Some(csv) = data("consoli-palace/consoli_frequencies.csv") else { return };
    let simulator = simulator("consoli-palace.toml");
    let (rows, days) = (rows(&csv, 5), days(&csv));
    let healthy = daily(&simulator, &rows, &days);
    let split = healthy.iter().position(|(day, _)| *day >= 365).unwrap();
    let all: Vec<BatchEstimate> = healthy.iter().map(|(_, e)| e.clone()).collect();
    let quantities = quantities(&["walls", "upper"], "ln");
    let reference = reference(&quantities, &all[..split], 1_095.0);
    let numbers = reference.process.numbers();
    println!(
        "{} days, {split} of them reference; {} factors, persistence {:.3?}, noise {:.2}, limits {:.2?}",
        all.len(),
        reference.process.factors,
        numbers.persistence.as_slice(),
        numbers.noise,
        reference.limits
    );
    let changes = watch(&reference, &all[split..]);
    let above: Vec<bool> = changes.iter().map(|c| !c.is_empty()).collect();
    let begins = episodes(&above, 3);
    println!("healthy: {} episodes, {} days above", begins.len(), above.iter().filter(|a| **a).count());
    for t in &begins {
        println!("  day {}: {}", healthy[split + t].0, changes[*t][0].1.sentence());
    }
    let lowered = |row: &Row| {
        let lower = F1_LOSS.0.contains(&row.number);
        let shift = |(mode, f): (usize, &Option<f64>)| f.map(|f| if lower && mode == 0 { f - F1_LOSS.1 } else { f });
        Row { number: row.number, frequencies_hz: row.frequencies_hz.iter().enumerate().map(shift).collect() }
    };
    let lowered: Vec<Row> = rows.iter().map(lowered).collect();
    let onset = days[rows.iter().position(|row| row.number == *F1_LOSS.0.start()).unwrap()];
    let damaged = daily(&simulator, &lowered, &days);
    let estimates: Vec<BatchEstimate> = damaged[split..].iter().map(|(_, e)| e.clone()).collect();
    let changes = watch(&reference, &estimates);
    let first = damaged[split..].iter().zip(&changes).find(|((day, _), c)| *day >= onset && !c.is_empty());
    println!("f1 lowered from day {onset}: {:?}", first.map(|((day, _), c)| (day - onset, c[0].1.sentence())));
    let (mut found, mut quiet) = (0, 0);
    for placement in 0..20 {
        let onset = 395 + placement * 17;
        for (k, _) in quantities.names.iter().enumerate() {
            let lost = |(day, e): &(i64, BatchEstimate)| {
                let mut e = e.clone();
                if *day >= onset {
                    e.mean[k] = e.mean[k].map(|mean| mean + 0.97_f64.ln());
                }
                e
            };
            let estimates: Vec<BatchEstimate> = healthy[split..].iter().map(lost).collect();
            let changes = watch(&reference, &estimates);
            let alarm = |from: i64, to: i64| {
                healthy[split..].iter().zip(&changes).any(|((day, _), c)| (from..to).contains(day) && !c.is_empty())
            };
            let before = alarm(onset - 30, onset);
            quiet += usize::from(!before);
            found += usize::from(!before && alarm(onset, onset + 10));
        }
    }
    println!("loss of 3 %: found within 10 days in {found} of {quiet} placements without an alarm before");
}
