//! Emulators against functions known in closed form, against new points, and tables with mistakes.

mod crossings;
mod error;
mod hull;
mod structures;
mod table;

use modalwatch::emulator::{Emulator, Runs};
use modalwatch::stats;
use nalgebra::DMatrix;
use rand::seq::SliceRandom as _;
use rand::Rng as _;

/// Latin hypercube in the unit cube, `[n, d]`.
fn latin_hypercube(n: usize, d: usize, seed: u64) -> DMatrix<f64> {
    let mut stream = stats::stream(seed, "latin hypercube");
    let mut points = DMatrix::zeros(n, d);
    for mut column in points.column_iter_mut() {
        let mut strata: Vec<usize> = (0..n).collect();
        strata.shuffle(&mut stream);
        for (value, stratum) in column.iter_mut().zip(strata) {
            *value = (stratum as f64 + stream.random::<f64>()) / n as f64;
        }
    }
    points
}

/// Runs of `frequencies` at the rows of `parameters`.
fn runs(parameters: DMatrix<f64>, frequencies: impl Fn(&[f64]) -> Vec<f64>) -> Runs {
    let rows: Vec<Vec<f64>> =
        parameters.row_iter().map(|row| frequencies(&row.iter().copied().collect::<Vec<f64>>())).collect();
    let frequencies_hz = DMatrix::from_fn(rows.len(), rows[0].len(), |run, mode| rows[run][mode]);
    Runs { parameters, frequencies_hz }
}

/// ln f of two modes: polynomials of degree 4 in three parameters of different units.
fn polynomials(theta: &[f64]) -> Vec<f64> {
    let (a, b, c) = (theta[0] - 2.0, theta[1] / 1e9, theta[2] * 100.0);
    let first = 1.0 + 0.3 * a - 0.2 * b * c + 0.05 * a * a * b - 0.02 * c.powi(4);
    vec![first.exp(), (first + 2.0 + 0.1 * b + 0.07 * a * b * c).exp()]
}

fn polynomial_runs(n: usize) -> Runs {
    let mut parameters = latin_hypercube(n, 3, 1);
    for mut row in parameters.row_iter_mut() {
        row[0] = 1.0 + 2.0 * row[0];
        row[1] = (2.0 * row[1] - 1.0) * 1e9;
        row[2] *= 0.01;
    }
    runs(parameters, polynomials)
}

#[test]
fn a_polynomial_is_reproduced_to_rounding() {
    let emulator = Emulator::fit(&polynomial_runs(150)).unwrap();
    assert_eq!((emulator.modes(), emulator.parameters()), (2, 3));
    for fresh in polynomial_runs(40).parameters.row_iter() {
        let theta: Vec<f64> = fresh.iter().map(|x| x * 0.9).collect();
        for (emulated, exact) in emulator.frequencies_hz(&theta).iter().zip(polynomials(&theta)) {
            assert!((emulated / exact - 1.0).abs() < 1e-9, "{emulated} {exact}");
        }
    }
    for mode in 0..2 {
        assert!(emulator.relative_error(mode) < 1e-9, "{}", emulator.relative_error(mode));
        assert!(emulator.r_squared(mode) > 1.0 - 1e-12);
    }
}

fn assert_jacobian_is_the_slope(emulator: &Emulator, theta: &[f64], widths: &[f64]) {
    let (frequencies, jacobian) = emulator.frequencies_and_jacobian(theta);
    for (value, other) in frequencies.iter().zip(emulator.frequencies_hz(theta)) {
        assert!((value / other - 1.0).abs() < 1e-14);
    }
    for (parameter, width) in widths.iter().enumerate() {
        let shifted = |share: f64| {
            let mut theta = theta.to_vec();
            theta[parameter] += share * width;
            emulator.frequencies_hz(&theta)
        };
        let (above, below) = (shifted(1e-5), shifted(-1e-5));
        for mode in 0..emulator.modes() {
            let slope = (above[mode] - below[mode]) / (2e-5 * width);
            let scale = frequencies[mode] / width;
            assert!((jacobian[(mode, parameter)] - slope).abs() < 1e-7 * scale, "mode {mode}, parameter {parameter}");
        }
    }
}

#[test]
fn the_jacobian_is_the_slope_of_the_frequencies() {
    let smooth = Emulator::fit(&polynomial_runs(150)).unwrap();
    assert_jacobian_is_the_slope(&smooth, &[1.7, 3e8, 0.004], &[2.0, 2e9, 0.01]);
    // Two of the modes veer and are emulated as a pair.
    let veering = Emulator::fit(&runs(latin_hypercube(100, 2, 1), structures::rig)).unwrap();
    for theta in [[0.3, 0.8], [0.51, 0.02], [0.5, 0.5]] {
        assert_jacobian_is_the_slope(&veering, &theta, &[1.0; 2]);
    }
}

#[test]
fn the_same_runs_give_the_same_emulator_on_any_number_of_threads() {
    let runs = runs(latin_hypercube(80, 2, 5), structures::rig);
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        format!("{:?}", pool.install(|| Emulator::fit(&runs).unwrap()))
    };
    assert_eq!(on(1), on(3));
}
