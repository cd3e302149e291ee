//! The estimated error of an emulator agrees with its actual error at new points.

use modalwatch::emulator::{Emulator, Runs};
use modalwatch::stats;
use nalgebra::DMatrix;
use rand::Rng as _;

use super::structures::{long_chain, rig};
use super::{latin_hypercube, runs};

/// Root mean square of ln f̂ − ln f of each mode at 1,000 new points of the unit cube that are not outside.
fn actual_error(emulator: &Emulator, truth: impl Fn(&[f64]) -> Vec<f64>) -> Vec<f64> {
    let mut stream = stats::stream(17, "fresh points");
    let mut squares = vec![0.0; emulator.modes()];
    let mut points = 0;
    while points < 1000 {
        let u: Vec<f64> = (0..emulator.parameters()).map(|_| stream.random()).collect();
        if emulator.is_outside(&u) {
            continue;
        }
        points += 1;
        for ((square, emulated), exact) in squares.iter_mut().zip(emulator.ln_frequencies(&u)).zip(truth(&u)) {
            *square += (emulated - exact.ln()).powi(2);
        }
    }
    squares.iter().map(|square| (square / 1000.0).sqrt()).collect()
}

#[test]
fn the_estimated_error_of_the_rig_is_small_and_right_at_new_points() {
    for seed in 0..4 {
        let emulator = Emulator::fit(&runs(latin_hypercube(200, 2, seed), rig)).unwrap();
        for (mode, actual) in actual_error(&emulator, rig).iter().enumerate() {
            let estimated = emulator.relative_error(mode);
            assert!(estimated < 1e-5, "seed {seed}, mode {mode}: {estimated}");
            assert!(*actual < 2.0 * estimated, "seed {seed}, mode {mode}: estimated {estimated}, actual {actual}");
            // The error falls tenfold per degree, so that a fit to nine tenths of the runs is far less accurate than one to all: the
            // estimate is above the actual error.
            assert!(
                estimated < 2.0 * actual || estimated < 1e-6,
                "seed {seed}, mode {mode}: estimated {estimated}, actual {actual}"
            );
        }
    }
}

#[test]
fn the_estimated_error_with_twenty_parameters_is_right_at_new_points() {
    let emulator = Emulator::fit(&runs(latin_hypercube(300, 20, 0), long_chain)).unwrap();
    for (mode, actual) in actual_error(&emulator, long_chain).iter().enumerate() {
        let estimated = emulator.relative_error(mode);
        assert!(estimated < 0.01, "mode {mode}: {estimated}");
        assert!((0.5..2.0).contains(&(estimated / actual)), "mode {mode}: estimated {estimated}, actual {actual}");
    }
}

#[test]
fn noise_shows_in_the_estimated_error_and_repeated_runs_are_accepted() {
    let once = latin_hypercube(100, 2, 4);
    let twice = DMatrix::from_fn(200, 2, |run, j| once[(run / 2, j)]);
    let exact = runs(twice.clone(), rig);
    assert!(Emulator::fit(&exact).unwrap().relative_error(0) < 1e-3);
    let mut stream = stats::stream(4, "noise");
    let noisy = exact.frequencies_hz.map(|f| f * (1.0 + 0.01 * (stream.random::<f64>() - 0.5)));
    let emulator = Emulator::fit(&Runs { parameters: twice, frequencies_hz: noisy }).unwrap();
    for mode in 0..3 {
        // A uniform error of ±0.5 % has the standard deviation 0.01/√12 = 0.0029; 200 runs determine it to about 5 %.
        let estimated = emulator.relative_error(mode);
        assert!((0.0024..0.0036).contains(&estimated), "mode {mode}: {estimated}");
    }
}

#[test]
fn the_residuals_of_runs_left_out_give_the_estimated_error() {
    let emulator = Emulator::fit(&runs(latin_hypercube(60, 2, 8), rig)).unwrap();
    assert_eq!(emulator.held_out_residuals().len(), 3);
    for (mode, missed) in emulator.held_out_residuals().iter().enumerate() {
        assert_eq!(missed.len(), 60);
        let plain = (missed.iter().map(|e| e * e).sum::<f64>() / 60.0).sqrt();
        // For selected terms it is the same; for whole sets the correction increases it.
        assert!(emulator.relative_error(mode) > 0.999 * plain && emulator.relative_error(mode) < 5.0 * plain);
    }
}
