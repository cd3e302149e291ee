//! Modes that cross are reported, and only those.

use modalwatch::emulator::Emulator;

use super::structures::rig;
use super::{latin_hypercube, runs};

fn sorted(mut frequencies: Vec<f64>) -> Vec<f64> {
    frequencies.sort_by(f64::total_cmp);
    frequencies
}

#[test]
fn two_lines_that_cross_are_one_crossing_at_the_closest_run() {
    for d in [2, 6, 12] {
        let lines = |u: &[f64]| sorted(vec![2.0, 5.0 + u[0], 6.3 - u[1], 20.0 + u[0]]);
        let table = runs(latin_hypercube(200, d, 11), lines);
        let emulator = Emulator::fit(&table).unwrap();
        let [crossing] = emulator.crossings() else { panic!("{d} parameters: {:?}", emulator.crossings()) };
        assert_eq!(crossing.lower_mode, 1);
        let gap = |run| table.frequencies_hz[(run, 2)] / table.frequencies_hz[(run, 1)] - 1.0;
        assert!((0..200).all(|run| gap(run) >= gap(crossing.run)));
        assert!((crossing.gap - gap(crossing.run)).abs() < 1e-12);
    }
}

#[test]
fn modes_that_cross_are_followed_through_the_crossing() {
    let lines = |u: &[f64]| sorted(vec![5.0 + u[0], 6.3 - u[1]]);
    let emulator = Emulator::fit(&runs(latin_hypercube(200, 2, 14), lines)).unwrap();
    assert_eq!(emulator.crossings().len(), 1);
    // On the line u1 = 0.6 the two cross at u0 = 0.7: the lower frequency has the slope 1 before it, 0 after it.
    for (u, hz, slopes) in [([0.68, 0.6], 5.68, [1.0, 0.0]), ([0.72, 0.6], 5.7, [0.0, -1.0])] {
        let (frequencies, jacobian) = emulator.frequencies_and_jacobian(&u);
        assert!((frequencies[0] - hz).abs() < 1e-4, "{frequencies:?}");
        assert!((0..2).all(|j| (jacobian[(0, j)] - slopes[j]).abs() < 0.01), "{jacobian}");
    }
    assert!(emulator.relative_error(0) < 1e-4);
}

#[test]
fn a_crossing_in_a_corner_and_a_sharp_veering_are_reported() {
    let corner = |u: &[f64]| sorted(vec![5.0 + u[0], 6.7 - u[1]]);
    assert_eq!(Emulator::fit(&runs(latin_hypercube(200, 2, 12), corner)).unwrap().crossings().len(), 1);
    let veering = |u: &[f64]| {
        let half = ((u[0] - 0.5).powi(2) + 0.01_f64.powi(2)).sqrt();
        vec![10.0 - half, 10.0 + half]
    };
    assert_eq!(Emulator::fit(&runs(latin_hypercube(200, 2, 13), veering)).unwrap().crossings().len(), 1);
}

#[test]
fn modes_that_keep_apart_do_not_cross() {
    let apart = |u: &[f64]| vec![5.0 + u[0], 7.0 + u[1], 9.0 + 3.0 * u[0]];
    // The gap is smallest at an edge of the box and would close only outside it.
    let edge = |u: &[f64]| vec![5.0, 5.2 + u[0] + 0.3 * u[1]];
    // Two modes that approach each other and separate slowly.
    let slow = |u: &[f64]| vec![10.0, 11.0 + 4.0 * (u[0] - 0.5).powi(2)];
    for seed in 0..5 {
        for n in [60, 200] {
            let crossings = |f: &dyn Fn(&[f64]) -> Vec<f64>| {
                Emulator::fit(&runs(latin_hypercube(n, 2, seed), f)).unwrap().crossings().to_vec()
            };
            assert_eq!(crossings(&apart), []);
            assert_eq!(crossings(&edge), []);
            assert_eq!(crossings(&slow), []);
            assert_eq!(crossings(&rig), []);
        }
    }
}
