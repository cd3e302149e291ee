//! The Consoli Palace: two years without damage, one of them as reference.

use modalwatch::process::change::AGES;
use modalwatch::process::estimate::BatchEstimate;
use modalwatch::process::limits::Steady;
use modalwatch::quantity::Timestamp;
use modalwatch::simulator::definition::StructureDefinition;
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
    let (rows, days) = (rows(&csv, 5), days(&csv));
    println!("== walls and upper parts");
    study(&simulator("consoli-palace.toml"), &rows, &days, &["walls", "upper"]);
    println!("== one stiffness for each mode");
    study(&modal(), &rows, &days, &["k1", "k2", "k3", "k4", "k5"]);
}

/// One body for each mode, each with a stiffness of its own: the frequencies without a model of the palace.
fn modal() -> Simulator {
    let stiffness = [210_540.7, 348_618.4, 475_539.7, 683_145.7, 1_799_037.5];
    let mass = |i: usize| format!("{{ name = \"mode{i}\", kg = 1000.0 }}");
    let spring = |i: usize| {
        format!("{{ name = \"s{i}\", from = \"ground\", to = \"mode{i}\", n_per_m = {} }}", stiffness[i - 1])
    };
    let parameter = |i: usize| {
        let law = format!("{{ exponential = {{ a = {}, b = 1.0, c = 0.0 }} }}", stiffness[i - 1]);
        format!("{{ name = \"k{i}\", unit = \"ln\", prior = {{ uniform = [-0.3, 0.3] }}, sets = {{ spring = \"s{i}\", law = {law} }} }}")
    };
    let list = |one: &dyn Fn(usize) -> String| (1..=5).map(one).collect::<Vec<_>>().join(", ");
    let text = format!(
        "id = \"consoli-modes\"\nmodes = 5\nmeasurement_noise = {{ relative = 0.003 }}\nmass = [{}]\nspring = [{}]\nparameter = [{}]\n",
        list(&mass),
        list(&spring),
        list(&parameter)
    );
    Simulator::new(StructureDefinition::parse_toml(&text).unwrap()).unwrap()
}

fn study(simulator: &Simulator, rows: &[Row], days: &[i64], names: &[&str]) {
    // Shares of the walls in the stiffness of each mode, from the structure file: what a loss of the walls does to each mode.
    let shares = if names.len() == 2 { vec![1.0, 0.0] } else { vec![0.8, 0.7, 0.4, 0.3, 0.6] };
    let healthy = daily(simulator, rows, days);
    let split = healthy.iter().position(|(day, _)| *day >= 365).unwrap();
    let all: Vec<BatchEstimate> = healthy.iter().map(|(_, e)| e.clone()).collect();
    let quantities = quantities(names, "ln");
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
    let damaged = daily(simulator, &lowered, days);
    let estimates: Vec<BatchEstimate> = damaged[split..].iter().map(|(_, e)| e.clone()).collect();
    let changes = watch(&reference, &estimates);
    let first = damaged[split..].iter().zip(&changes).find(|((day, _), c)| *day >= onset && !c.is_empty());
    let scale: Vec<f64> = reference.process.scales.iter().map(|s| 100.0 * s.unit).collect();
    let errors = Steady::new(&reference.process).unwrap().standard_errors();
    for (age, errors) in AGES.iter().zip(errors) {
        let percent: Vec<f64> = errors.iter().zip(&scale).map(|(e, s)| e * s).collect();
        println!("  standard error of a loss that has lasted {age} days, %: {percent:.2?}");
    }
    println!("f1 lowered from day {onset}: {:?}", first.map(|((day, _), c)| (day - onset, c[0].1.sentence())));
    let (mut found, mut quiet) = (0, 0);
    for placement in 0..20 {
        let onset = 395 + placement * 17;
        let lost = |(day, e): &(i64, BatchEstimate)| {
            let mut e = e.clone();
            if *day >= onset {
                for (mean, share) in e.mean.iter_mut().zip(&shares) {
                    *mean = mean.map(|mean| mean + f64::ln(1.0 - 0.03 * share));
                }
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
    println!("loss of 3 %: found within 10 days in {found} of {quiet} placements without an alarm before");
}
