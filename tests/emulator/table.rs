//! Tables that allow no emulator, and unusual ones that do.

use modalwatch::emulator::{Emulator, FitError, Runs};
use nalgebra::DMatrix;

use super::structures::rig;
use super::{latin_hypercube, runs};

fn refused(change: impl Fn(&mut Runs)) -> String {
    let mut table = runs(latin_hypercube(60, 2, 2), rig);
    change(&mut table);
    Emulator::fit(&table).unwrap_err().to_string()
}

#[test]
fn a_table_with_a_mistake_is_refused_and_the_mistake_is_named() {
    for (said, expected) in [
        (refused(|t| t.parameters[(4, 1)] = f64::NAN), "run 5, parameter 2: NaN is not a finite number"),
        (refused(|t| t.parameters.column_mut(1).fill(0.3)), "parameter 2 is 0.3 in every run"),
        (refused(|t| t.frequencies_hz[(6, 2)] = f64::INFINITY), "run 7, mode 3: the frequency inf Hz"),
        (refused(|t| t.frequencies_hz[(6, 0)] = 0.0), "run 7, mode 1: the frequency 0 Hz must be positive and finite"),
        (refused(|t| t.frequencies_hz.swap((9, 0), (9, 2))), "run 10: mode 2 has"),
        (refused(|t| t.frequencies_hz = DMatrix::from_element(59, 3, 1.0)), "of 60 runs, but frequencies of 59"),
        (refused(|t| t.parameters = DMatrix::zeros(60, 0)), "the table has 0 parameters and 3 frequencies"),
    ] {
        assert!(said.contains(expected), "{said}");
    }
}

#[test]
fn too_few_runs_are_refused_and_the_number_needed_is_enough() {
    let refused = Emulator::fit(&runs(latin_hypercube(5, 2, 2), rig)).unwrap_err();
    assert_eq!(refused, FitError::TooFewRuns { runs: 5, parameters: 2, needed: 6 });
    assert!(refused.to_string().contains("at least 6"), "{refused}");
    assert!(Emulator::fit(&runs(latin_hypercube(6, 2, 2), rig)).unwrap().relative_error(0).is_finite());
}

#[test]
fn a_frequency_that_no_parameter_moves_is_a_constant() {
    let emulator = Emulator::fit(&runs(latin_hypercube(30, 2, 2), |u| vec![0.7, 3.0 + u[0], 9.0])).unwrap();
    let (frequencies, jacobian) = emulator.frequencies_and_jacobian(&[0.3, 0.4]);
    assert!((frequencies[0] - 0.7).abs() < 1e-14 && (frequencies[2] - 9.0).abs() < 1e-13);
    assert!(jacobian.row(0).norm() < 1e-12);
    assert!((emulator.r_squared(0) - 1.0).abs() < 1e-9);
    assert_eq!(emulator.crossings(), []);
}

#[test]
fn a_parameter_run_at_two_values_only_is_emulated() {
    let mut parameters = latin_hypercube(40, 2, 3);
    parameters.column_mut(0).apply(|u| *u = u.round());
    let emulator = Emulator::fit(&runs(parameters, |u| vec![(1.0 + 0.2 * u[0] + 0.1 * u[1]).exp()])).unwrap();
    assert!((emulator.ln_frequencies(&[0.0, 0.4])[0] - 1.04).abs() < 1e-9);
    assert!((emulator.ln_frequencies(&[1.0, 0.4])[0] - 1.24).abs() < 1e-9);
}
