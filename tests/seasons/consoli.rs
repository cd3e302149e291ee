//! The Consoli Palace: two years without damage, one of them as reference.

use modalwatch::process::change::AGES;
use modalwatch::process::estimate::BatchEstimate;
use modalwatch::process::limits::Steady;
use modalwatch::process::reference::ReferenceProcess;
use modalwatch::quantity::Timestamp;
use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::Simulator;

use super::estimates::{changed, data, effects, estimate, rows, simulator, Row};
use super::watch::{episodes, quantities, reference, watch, Changes};

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
    let found = study(&simulator("consoli-palace.toml"), &rows, &days, &["walls", "upper"]);
    // At least nine of ten, where the chart does not ring anyway.
    assert!(
        found.episodes <= 2 && found.named.iter().all(|[named, silent]| 10 * named >= 9 * silent),
        "{:?}",
        found.named
    );
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

fn study(simulator: &Simulator, rows: &[Row], days: &[i64], names: &[&str]) -> Found {
    // What a loss of 3 % does to the parameters: of the walls or the upper parts; of the walls by their shares in the stiffness of each
    // mode, from the structure file.
    let losses: Vec<Vec<f64>> =
        if names.len() == 2 { vec![vec![1.0, 0.0], vec![0.0, 1.0]] } else { vec![vec![0.8, 0.7, 0.4, 0.3, 0.6]] };
    let healthy = daily(simulator, rows, days);
    let split = healthy.iter().position(|(day, _)| *day >= 365).unwrap();
    let all: Vec<BatchEstimate> = healthy.iter().map(|(_, e)| e.clone()).collect();
    let quantities = quantities(names, "ln", Some(effects(simulator)));
    let reference = reference(&quantities, &all[..split], 1_095.0);
    let numbers = reference.process.numbers();
    println!(
        "{} days, {split} of them reference; frequencies {}, {} factors, persistence {:.3?}, noise {:.2}, limits {:.2?}",
        all.len(),
        reference.process.modes.is_some(),
        reference.process.factors,
        numbers.persistence.as_slice(),
        numbers.noise,
        reference.limits
    );
    let second_year = SecondYear { simulator, names, reference: &reference, batches: &healthy[split..] };
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
    let lowered = watch(&reference, &estimates);
    let is_new = |t: usize| lowered[t].iter().any(|(series, _)| !changes[t].iter().any(|(other, _)| other == series));
    // The first chart that rings because of the loss: it is silent in the same batch without it.
    let first = (0..lowered.len()).find(|t| damaged[split + t].0 >= onset && is_new(*t));
    let scale: Vec<f64> = reference.process.scales.iter().map(|s| 100.0 * s.unit).collect();
    let errors = Steady::new(&reference.process).unwrap().standard_errors();
    for (age, errors) in AGES.iter().zip(errors) {
        let percent: Vec<f64> = errors.iter().zip(&scale).map(|(e, s)| e * s).collect();
        println!("  standard error of a loss that has lasted {age} days, %: {percent:.2?}");
    }
    println!(
        "f1 lowered from day {onset}: days to a chart that rings for it {:?}",
        first.map(|t| (damaged[split + t].0 - onset, lowered[t][0].1.sentence()))
    );
    let named = losses.iter().map(|shares| second_year.placements(&changes, shares)).collect();
    Found { episodes: begins.len(), named }
}

/// What a study found.
struct Found {
    /// False alarms in the second year.
    episodes: usize,
    /// For each loss of 3 %, placements in which its own chart found it, and those in which this chart is silent without the loss.
    named: Vec<[usize; 2]>,
}

/// The second year, which is compared with the first.
struct SecondYear<'a> {
    simulator: &'a Simulator,
    names: &'a [&'a str],
    reference: &'a ReferenceProcess,
    batches: &'a [(i64, BatchEstimate)],
}

impl SecondYear<'_> {
    /// Puts a loss of 3 % times `shares`, `[d]`, into 20 places of the year. `healthy`: the charts without a loss.
    fn placements(&self, healthy: &[Changes], shares: &[f64]) -> [usize; 2] {
        let change: Vec<f64> = shares.iter().map(|share| f64::ln(1.0 - 0.03 * share)).collect();
        let lost = self.names.iter().zip(shares).filter(|(_, share)| **share > 0.0);
        let lost: Vec<&str> = lost.map(|(name, _)| *name).collect();
        let (mut found, mut quiet, mut named, mut silent) = (0, 0, 0, 0);
        for placement in 0..20 {
            let onset = 395 + placement * 17;
            let after = |(day, e): &(i64, BatchEstimate)| {
                if *day >= onset {
                    changed(self.simulator, e, &change)
                } else {
                    e.clone()
                }
            };
            let estimates: Vec<BatchEstimate> = self.batches.iter().map(after).collect();
            let after = watch(self.reference, &estimates);
            let alarm = |changes: &[Changes], only: Option<&[&str]>, from: i64, to: i64| {
                let rings = |c: &Changes| c.iter().any(|(s, _)| only.is_none_or(|only| only.contains(&s.as_str())));
                self.batches.iter().zip(changes).any(|((day, _), c)| (from..to).contains(day) && rings(c))
            };
            if !alarm(&after, None, onset - 30, onset) {
                quiet += 1;
                found += usize::from(alarm(&after, None, onset, onset + 10));
            }
            if !alarm(healthy, Some(&lost), onset - 1, onset + 10) {
                silent += 1;
                named += usize::from(alarm(&after, Some(&lost), onset, onset + 10));
            }
        }
        println!("loss of 3 % of {lost:?}: found within 10 days in {found} of {quiet} placements without an alarm in the 30 days before");
        println!("  on its own chart in {named} of {silent} placements where this is silent without the loss");
        [named, silent]
    }
}
