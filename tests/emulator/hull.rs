//! Where the emulator says that it extrapolates.

use modalwatch::emulator::{Emulator, Runs};
use nalgebra::DMatrix;

use super::structures::{long_chain, rig};
use super::{latin_hypercube, runs};

/// The runs of a Latin hypercube for which `keep` holds.
fn part(n: usize, keep: impl Fn(f64, f64) -> bool) -> Runs {
    let all = latin_hypercube(n, 2, 6);
    let kept: Vec<usize> = (0..n).filter(|&run| keep(all[(run, 0)], all[(run, 1)])).collect();
    runs(all.select_rows(&kept), rig)
}

fn rows(parameters: &DMatrix<f64>) -> Vec<Vec<f64>> {
    parameters.row_iter().map(|row| row.iter().copied().collect()).collect()
}

#[test]
fn the_empty_corner_of_a_table_is_outside_and_no_run_is() {
    let triangle = part(300, |a, b| a + b <= 1.0);
    let l_shape = part(200, |a, b| a <= 0.4 || b <= 0.4);
    for table in [triangle, l_shape] {
        let emulator = Emulator::fit(&table).unwrap();
        assert!(rows(&table.parameters).iter().all(|theta| !emulator.is_outside(theta)));
        assert!(!emulator.is_outside(&[0.2, 0.3]));
        for corner in [[0.95, 0.95], [0.9, 0.9], [0.95, 0.8]] {
            assert!(emulator.is_outside(&corner), "{corner:?}");
        }
    }
}

#[test]
fn beyond_the_range_of_a_parameter_is_outside() {
    let emulator = Emulator::fit(&runs(latin_hypercube(100, 2, 6), rig)).unwrap();
    for theta in [[-0.02, 0.5], [0.5, 1.02], [f64::NAN, 0.5], [0.5, f64::INFINITY]] {
        assert!(emulator.is_outside(&theta), "{theta:?}");
    }
}

#[test]
fn few_points_among_the_runs_are_called_outside_even_with_few_runs_in_many_dimensions() {
    for n in [50, 300] {
        let table = runs(latin_hypercube(n, 20, 9), long_chain);
        let emulator = Emulator::fit(&table).unwrap();
        assert!(rows(&table.parameters).iter().all(|theta| !emulator.is_outside(theta)));
        let fresh = latin_hypercube(1000, 20, 10);
        // The range of 50 runs in 20 parameters leaves out 1 − (1 − 2/51)^20 = 55 % of the unit cube.
        let within: Vec<Vec<f64>> =
            rows(&fresh).into_iter().map(|theta| theta.iter().map(|u| 0.5 + 0.94 * (u - 0.5)).collect()).collect();
        let outside = within.iter().filter(|theta| emulator.is_outside(theta)).count();
        assert!(outside < 100, "{n} runs: {outside} of 1000");
    }
}
