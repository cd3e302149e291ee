//! The Sciri Tower: 25 winter days without damage, of which the last quarter must raise no alarm, with and without its temperatures.

use modalwatch::process::direction::ChangeDirection;
use modalwatch::process::estimate::BatchEstimate;
use modalwatch::process::fit::Quantities;
use modalwatch::process::reference::ReferenceProcess;
use modalwatch::quantity::Timestamp;

use super::estimates::{data, estimate, simulator, Row};
use super::watch::{episodes, named, watch};

/// Rows of a batch: about six hours.
const ROWS: usize = 12;

/// The rows, without values that the source interpolated, with time and both temperatures.
fn rows(csv: &str) -> Vec<(Row, Timestamp, [f64; 2])> {
    let row = |(number, line): (usize, &str)| {
        let cells: Vec<&str> = line.split(',').collect();
        let measured = |mode: usize| cells[4 + mode].parse().ok().filter(|_| cells[11 + mode] == "0");
        let frequencies_hz = (0..7).map(measured).collect();
        let at = Timestamp::parse(&format!("{}Z", cells[1])).unwrap();
        (Row { number, frequencies_hz }, at, [2, 3].map(|column| cells[column].parse().unwrap()))
    };
    csv.lines().skip(1).enumerate().map(row).collect()
}

#[test]
fn the_last_quarter_of_the_sciri_tower_raises_no_alarm() {
    let Some(csv) = data("sciri-tower/sciri_frequencies.csv") else { return };
    let (simulator, rows) = (simulator("sciri-tower.toml"), rows(&csv));
    let one = |part: &[(Row, Timestamp, [f64; 2])]| {
        let own: Vec<Row> = part
            .iter()
            .map(|(row, ..)| Row { number: row.number, frequencies_hz: row.frequencies_hz.clone() })
            .collect();
        let mean = |which: usize| part.iter().map(|(.., t)| t[which]).sum::<f64>() / part.len() as f64;
        BatchEstimate {
            covariates: vec![Some(mean(0)), Some(mean(1))],
            ..estimate(&simulator, &own, part.last().unwrap().1)
        }
    };
    let with: Vec<BatchEstimate> = rows.chunks(ROWS).map(one).collect();
    let without: Vec<BatchEstimate> =
        with.iter().map(|e| BatchEstimate { covariates: Vec::new(), ..e.clone() }).collect();
    let quantities = Quantities {
        names: ["stiffness_x", "stiffness_y", "stiffness_t"].map(str::to_owned).to_vec(),
        units: vec!["ln".to_owned(); 3],
        directions: vec![ChangeDirection::Decrease; 3],
        misfit: None,
    };
    let size = 3 * with.len() / 4;
    for (covariates, estimates) in
        [(vec!["temp1_degc".to_owned(), "temp2_degc".to_owned()], with), (Vec::new(), without)]
    {
        let reference =
            ReferenceProcess::new(&quantities, &covariates, estimates[..size].to_vec(), 1_000.0, [1.0; 2]).unwrap();
        let changes = watch(&reference, &estimates[size..]);
        let above: Vec<bool> = changes.iter().map(Option::is_some).collect();
        println!(
            "{} covariates, {size} batches of {}: {} factors, {} episodes",
            covariates.len(),
            estimates.len(),
            reference.process.factors,
            episodes(&above, 3).len()
        );
        for change in changes.iter().flatten() {
            println!("  {}", change.sentence());
        }
        // Without the temperatures there is one false alarm, on 7 March.
        let false_alarms = episodes(&above, 3).len();
        assert!(false_alarms <= usize::from(covariates.is_empty()), "{above:?}");
        // A loss of 3 % in one direction, half way through, is found with the batches that remain.
        let half = estimates.len() - (estimates.len() - size) / 2;
        let lost = |(t, e): (usize, &BatchEstimate)| {
            let mut e = e.clone();
            if t >= half {
                e.mean[1] = e.mean[1].map(|mean| mean + 0.97_f64.ln());
            }
            e
        };
        let damaged: Vec<BatchEstimate> = estimates.iter().enumerate().map(lost).collect();
        let changes = watch(&reference, &damaged[size..]);
        let first = (half..damaged.len()).find(|t| named(changes[t - size].as_ref()).concat().contains(&"stiffness_y"));
        println!("  3 % of stiffness_y lost with batch {half}: found with batch {first:?}");
        assert!(first.is_some());
    }
}
