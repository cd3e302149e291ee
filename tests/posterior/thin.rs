//! Posteriors that are thin curves: a mode is missing, and the frequencies are five to twenty times as accurate as any that the network
//! was trained on, so that its draws are far wider than the posterior.

use modalwatch::stats;

use super::{prior_measurements, shipped};

/// Measurements of each situation.
const COUNT: usize = 400;

/// Draws for each measurement, so that a rank takes one of 100 values.
const DRAWS: usize = 99;

#[test]
fn intervals_hold_their_share_of_the_truths_where_the_posterior_is_a_thin_curve() {
    let baseline = shipped("three-dof");
    let mut tests = Vec::new();
    for (multiple, missing) in [(0.02, 0), (0.02, 1), (0.02, 2), (0.005, 1)] {
        let (truths, observations) = prior_measurements(&baseline, COUNT, multiple, Some(missing), 77);
        let samples = baseline.infer(&observations, DRAWS, 5).unwrap();
        for (column, parameter) in baseline.space().iter().enumerate() {
            let rank = |row: usize| {
                let own = samples.theta().column(column);
                own.rows(row * DRAWS, DRAWS).iter().filter(|draw| **draw < truths[row][column]).count()
            };
            let ranks: Vec<usize> = (0..COUNT).map(rank).collect();
            for (inside, nominal) in [(5..=94, 0.9_f64), (25..=74, 0.5)] {
                let share = ranks.iter().filter(|rank| inside.contains(*rank)).count() as f64 / COUNT as f64;
                let errors = (share - nominal) / (nominal * (1.0 - nominal) / COUNT as f64).sqrt();
                println!(
                    "noise × {multiple}, mode {} missing, {}: {share:.3} of {nominal} ({errors:+.1} errors)",
                    missing + 1,
                    parameter.name
                );
                tests.push(errors);
            }
        }
    }
    // Two-sided, with a level of 1 % over all tests together (Bonferroni).
    let most = -stats::normal_quantile(0.005 / tests.len() as f64);
    let worst = tests.iter().copied().fold(0.0, |worst: f64, errors| worst.max(errors.abs()));
    assert!(
        worst < most,
        "a share is {worst:.1} of its binomial errors from the nominal one, and at most {most:.1} are likely"
    );
}
