//! The Z24 bridge: a year of weather, then the settlement of a pier.

use modalwatch::parameter::DamageDirection;
use modalwatch::process::change::{change, evidence, signs, WINDOW};
use modalwatch::process::filter::Filter;
use modalwatch::process::fit::{fit, observations, Quantities};
use modalwatch::process::limits::limits;
use modalwatch::quantity::Timestamp;

use super::estimates::{data, estimate, rows, simulator, Row};

/// First damaged row of the table.
const DAMAGED_FROM: usize = 3_474;

/// Rows of a batch: about a day.
const ROWS: usize = 24;

#[test]
#[ignore = "a study, of which the program's own test runs the case that the documentation states"]
fn charts_of_the_process_over_the_year_of_the_z24_bridge() {
    let Some(csv) = data("z24-bridge/z24_frequencies.csv") else { return };
    let simulator = simulator("z24.toml");
    let is_ordered = |row: &Row| row.frequencies_hz[3].is_none_or(|f4| row.frequencies_hz[2].unwrap() < f4);
    let rows: Vec<Row> = rows(&csv, 4).into_iter().filter(is_ordered).collect();
    let at = |batch: usize| Timestamp::from_micros(86_400_000_000 * batch as i64).unwrap();
    let batches: Vec<&[Row]> = rows.chunks(ROWS).collect();
    let estimates: Vec<_> = batches.iter().enumerate().map(|(t, rows)| estimate(&simulator, rows, at(t))).collect();
    let names: Vec<String> = simulator.space().iter().map(|p| p.name.clone()).collect();
    let quantities = Quantities {
        names: names.clone(),
        units: vec!["ln".to_owned(); 3],
        directions: vec![DamageDirection::Decrease; 3],
    };
    let signs = signs(&[DamageDirection::Decrease; 3]);
    let first_damaged = batches.iter().position(|rows| rows.iter().any(|r| r.number >= DAMAGED_FROM)).unwrap();
    for reference in [60, 84, 110] {
        let started = std::time::Instant::now();
        let process = fit(&quantities, &[], &estimates[..reference]).unwrap();
        let fitted = started.elapsed();
        let mut certain = process.clone();
        certain.draws = vec![process.unknowns.clone()];
        println!("with certain numbers {:.2?}", limits(&certain, &signs, 1_000.0, 1).unwrap());
        for place in 0..process.unknowns.len() {
            let own: Vec<f64> = process.draws.iter().map(|d| d[place]).collect();
            print!(" {:.2}±{:.2}", process.unknowns[place], modalwatch::stats::sample_std(&own).unwrap());
        }
        let mut different: Vec<f64> = process.draws.iter().map(|d| d[0]).collect();
        different.sort_by(f64::total_cmp);
        different.dedup();
        println!(" different draws {}", different.len());
        let limits = limits(&process, &signs, 1_000.0, 1).unwrap();
        let numbers = process.numbers();
        println!(
            "reference {reference}: {} factors, persistence {:.2?}, noise {:.2}, fit {fitted:.1?}, limits {:.1?} {limits:.2?}",
            process.factors,
            numbers.persistence.as_slice(),
            numbers.noise,
            started.elapsed() - fitted,
        );
        let (filter, contributions) = (Filter::of(&process), process.in_operation().contributions());
        let mut known = filter.start();
        let mut innovations = Vec::new();
        for (t, observation) in observations(&process, &estimates).iter().enumerate() {
            let (next, innovation) = filter.step(&known, observation).unwrap();
            known = next;
            innovations.push(innovation);
            if t < reference {
                continue;
            }
            let window = &innovations[(t + 1).saturating_sub(WINDOW)..];
            let found = evidence(window, &contributions, &signs);
            let joint = found.joint.unwrap();
            let above = found
                .quantities
                .iter()
                .flatten()
                .any(|e| e.fast > limits.quantity.fast || e.slow > limits.quantity.slow)
                || joint.fast > limits.joint.fast
                || joint.slow > limits.joint.slow;
            if above || t >= first_damaged {
                let onset = change(window, &contributions, &signs, None).unwrap();
                let first = t + 1 - window.len();
                let losses: Vec<String> = (0..3)
                    .map(|k| {
                        onset.losses[k].map_or("-".to_owned(), |(mean, std)| {
                            let unit = 100.0 * process.scales[k].unit;
                            format!("{} {:.1} ± {:.1} %", names[k], mean * unit, std * unit)
                        })
                    })
                    .collect();
                println!(
                    "  {t} {} {}: joint {joint:.2?}, single {:.2?}; onset {} in {}..{}, {losses:?}",
                    if t >= first_damaged { "damaged" } else { "healthy" },
                    if above { "ALARM" } else { "quiet" },
                    found.quantities,
                    first + onset.onset,
                    first + onset.onset_interval[0],
                    first + onset.onset_interval[1],
                );
            }
        }
    }
}
