//! The fit that a trained model starts at, and a chain of ten stiffnesses trained from it.

use std::sync::LazyLock;

use modalwatch::baseline::identifiability::local_covariance;
use modalwatch::baseline::observation::{measure, measure_shapes, Observation, DEFAULT_NOISE_RANGE};
use modalwatch::baseline::start::locate;
use modalwatch::baseline::train::{train, Trained};
use modalwatch::flow::train::TrainSettings;
use modalwatch::flow::FlowSettings;
use modalwatch::simulator::{Simulator, TrainingSet};
use modalwatch::stats;
use nalgebra::DMatrix;

use crate::size::chain_simulator;

/// Ten stiffnesses, five modes, five points: seconds of training.
pub static CHAIN: LazyLock<Trained> = LazyLock::new(|| {
    let settings = TrainSettings { epochs: 8, ..TrainSettings::default() };
    let simulator = chain_simulator(10, 5);
    train(&simulator, 10_000, DEFAULT_NOISE_RANGE, &FlowSettings::default(), &settings, |_| {}).unwrap()
});

fn exact(set: &TrainingSet, row: usize) -> Observation {
    let frequencies: Vec<f64> = set.frequencies_hz.row(row).iter().copied().collect();
    let shapes = set.shapes[row].column_iter().map(|shape| Some(shape.iter().copied().collect())).collect();
    Observation { shapes, ..Observation::complete(&frequencies) }
}

fn noisy(simulator: &Simulator, set: &TrainingSet, row: usize, stream: &mut stats::Stream) -> Observation {
    let frequencies: Vec<f64> = set.frequencies_hz.row(row).iter().copied().collect();
    let all = vec![Some(1.0); frequencies.len()];
    let mut one = measure(simulator, &frequencies, &[], &all, stream);
    measure_shapes(simulator, &mut one, &set.shapes[row], &vec![false; all.len()], stream);
    one
}

#[test]
fn the_fit_is_the_same_for_shapes_turned_around_and_modes_in_another_order() {
    let simulator = chain_simulator(12, 5);
    let set = simulator.training_set(5, 3).unwrap();
    let mut stream = stats::stream(3, "test");
    for row in 0..5 {
        let observation = noisy(&simulator, &set, row, &mut stream);
        let fit = locate(&simulator, &observation).unwrap();
        let mut other = observation.clone();
        other.frequencies_hz.reverse();
        other.noise_multiple.reverse();
        other.shapes.reverse();
        for shape in other.shapes.iter_mut().flatten() {
            for x in shape {
                *x = -*x;
            }
        }
        let turned = locate(&simulator, &other).unwrap();
        assert!((&turned.unit - &fit.unit).amax() < 1e-9, "row {row}");
        assert!((turned.chi_squared - fit.chi_squared).abs() < 1e-6 * (1.0 + fit.chi_squared), "row {row}");
    }
}

/// The fit has the standard errors that it states, and its remaining misfit is χ²-distributed.
#[test]
fn fits_of_noisy_measurements_scatter_as_they_say() {
    let simulator = chain_simulator(10, 5);
    let set = simulator.training_set(300, 5).unwrap();
    let mut stream = stats::stream(5, "test");
    let (mut whitened, mut misfit) = (0.0, 0.0);
    for row in 0..300 {
        let fit = locate(&simulator, &noisy(&simulator, &set, row, &mut stream)).unwrap();
        let truth = DMatrix::from_fn(10, 1, |k, _| simulator.space().as_slice()[k].to_unit(set.theta[(row, k)]));
        // The mean over the parameters of a square that is 1 on average.
        whitened += fit.to_flow(&truth).norm_squared() / 3_000.0;
        misfit += fit.chi_squared / fit.degrees_of_freedom / 300.0;
    }
    println!("mean of whitened squares {whitened:.3}, of χ² over its degrees of freedom {misfit:.3}");
    // 3,000 squares have a standard error of 0.026; a prior of finite width and a nonlinear map add to it.
    assert!((0.9..1.2).contains(&whitened), "{whitened}");
    // Fifteen degrees of freedom, 300 times: standard error 0.021.
    assert!((misfit - 1.0).abs() < 0.07, "{misfit}");
}

#[test]
fn draws_beyond_the_prior_come_back_as_the_normal_distribution_that_is_cut_off_there() {
    let simulator = chain_simulator(4, 3);
    let set = simulator.training_set(1, 1).unwrap();
    let mut fit = locate(&simulator, &exact(&set, 0)).unwrap();
    // Independent parameters: the first within one standard deviation of an edge.
    fit.unit.fill(0.5);
    fit.unit[0] = 0.05;
    fit.precision = DMatrix::identity(4, 4) * 100.0;
    let mut stream = stats::stream(2, "test");
    let mut drawn = Vec::new();
    for _ in 0..20_000 {
        let mut draw = [-0.02, 0.4, 0.5, 0.6];
        assert!(fit.draw_back(&mut draw, &mut stream));
        assert!((0.0..=1.0).contains(&draw[0]));
        assert_eq!([draw[1], draw[2], draw[3]].map(f64::to_bits), [0.4_f64, 0.5, 0.6].map(f64::to_bits));
        drawn.push(draw[0]);
    }
    // Mean of N(0.05, 0.1²) on [0, 1]: μ + σ φ(a)/(1 − Φ(a)), a = −μ/σ.
    let density = (-0.125_f64).exp() / (2.0 * std::f64::consts::PI).sqrt();
    let expected = 0.05 + 0.1 * density / (1.0 - stats::normal_cdf(-0.5));
    let error = stats::sample_std(&drawn).unwrap() / 20_000.0_f64.sqrt();
    assert!((stats::mean(&drawn) - expected).abs() < 4.0 * error, "{} ± {error}, {expected}", stats::mean(&drawn));
    let mut inside = [0.3, 0.4, 0.5, 0.6];
    assert!(!fit.draw_back(&mut inside, &mut stream));
    assert_eq!(inside.map(f64::to_bits), [0.3_f64, 0.4, 0.5, 0.6].map(f64::to_bits));
}

#[test]
fn the_map_to_the_flow_is_invertible_and_its_volume_is_the_determinant() {
    let simulator = chain_simulator(6, 4);
    let set = simulator.training_set(1, 4).unwrap();
    let fit = locate(&simulator, &exact(&set, 0)).unwrap();
    let unit = DMatrix::from_fn(6, 3, |k, draw| 0.1 * (k + draw) as f64);
    assert!((fit.from_flow(&fit.to_flow(&unit)) - &unit).amax() < 1e-9);
    assert!((fit.log_det() - 0.5 * fit.precision.determinant().ln()).abs() < 1e-9);
}

/// The Fisher information of frequencies and shapes compared with that of finite differences.
#[test]
fn the_fisher_information_is_that_of_differences() {
    let simulator = chain_simulator(8, 4);
    let set = simulator.training_set(1, 8).unwrap();
    let theta: Vec<f64> = set.theta.row(0).iter().copied().collect();
    let (exact_hz, shapes) = simulator.frequencies_and_shapes(&theta).unwrap();
    let parameters = simulator.space().as_slice();
    let at = |k: usize, step: f64| {
        let mut moved = theta.clone();
        moved[k] += step * (parameters[k].upper - parameters[k].lower);
        let (hz, mut there) = simulator.frequencies_and_shapes(&moved).unwrap();
        for (mut shape, own) in there.column_iter_mut().zip(shapes.column_iter()) {
            let sign = shape.dot(&own).signum();
            shape *= sign;
        }
        let frequencies = hz.iter().zip(&exact_hz).map(|(hz, exact)| hz / (0.005 * exact));
        let all: Vec<f64> = frequencies.chain(there.iter().map(|x| x / simulator.shape_std())).collect();
        nalgebra::DVector::from_vec(all)
    };
    let columns: Vec<_> = (0..8).map(|k| (at(k, 1e-5) - at(k, -1e-5)) / 2e-5).collect();
    let jacobian = DMatrix::from_columns(&columns);
    let expected = (jacobian.transpose() * &jacobian + DMatrix::identity(8, 8) * 12.0).try_inverse().unwrap();
    let found = local_covariance(&simulator, &theta, &exact_hz).unwrap();
    assert!((&found - &expected).amax() < 1e-5 * expected.amax(), "{found} {expected}");
}

#[test]
fn a_chain_of_ten_is_learnt_to_the_optimum_with_intervals_that_cover() {
    const MEASUREMENTS: usize = 400;
    const DRAWS: usize = 100;
    let baseline = &CHAIN.baseline;
    let simulator = baseline.simulator();
    let set = simulator.training_set(MEASUREMENTS, 77).unwrap();
    let mut stream = stats::stream(77, "test");
    let observations: Vec<Observation> =
        (0..MEASUREMENTS).map(|row| noisy(simulator, &set, row, &mut stream)).collect();
    let samples = baseline.infer(&observations, DRAWS, 7).unwrap();
    let (mut covered, mut error, mut bound) = (0.0, 0.0, 0.0);
    let share = 1.0 / (10 * MEASUREMENTS) as f64;
    for row in 0..MEASUREMENTS {
        let theta: Vec<f64> = set.theta.row(row).iter().copied().collect();
        let exact_hz: Vec<f64> = set.frequencies_hz.row(row).iter().copied().collect();
        bound += local_covariance(simulator, &theta, &exact_hz).unwrap().trace() * share;
        for (column, parameter) in simulator.space().iter().enumerate() {
            let drawn = samples.theta().view((row * DRAWS, column), (DRAWS, 1));
            let draws: Vec<f64> = drawn.iter().map(|x| parameter.to_unit(*x)).collect();
            let truth = parameter.to_unit(theta[column]);
            covered +=
                f64::from(u8::from((stats::quantile(&draws, 0.05)..=stats::quantile(&draws, 0.95)).contains(&truth)))
                    * share;
            error += (stats::mean(&draws) - truth).powi(2) * share;
        }
    }
    let (reached, optimum) = (1.0 - 12.0 * error, 1.0 - 12.0 * bound);
    println!("coverage of 90 % intervals {covered:.3}, R² {reached:.5}, optimum {optimum:.5}");
    // 400 measurements of ten correlated parameters: at worst 400 independent trials, standard error 0.015.
    assert!((covered - 0.9).abs() < 0.05, "{covered}");
    assert!(reached > 0.95 * optimum, "{reached}, {optimum}");
}

#[test]
fn without_shapes_the_same_model_gives_wider_intervals() {
    let baseline = &CHAIN.baseline;
    let set = baseline.simulator().training_set(20, 9).unwrap();
    let with: Vec<Observation> = (0..20).map(|row| exact(&set, row)).collect();
    let without: Vec<Observation> = with.iter().map(|o| Observation { shapes: Vec::new(), ..o.clone() }).collect();
    let spread = |observations: &[Observation]| {
        let samples = baseline.infer(observations, 100, 3).unwrap();
        let of = |row: usize, k: usize| {
            let draws: Vec<f64> = samples.theta().view((row * 100, k), (100, 1)).iter().copied().collect();
            stats::sample_std(&draws).unwrap()
        };
        (0..20).flat_map(|row| (0..10).map(move |k| (row, k))).map(|(row, k)| of(row, k)).sum::<f64>() / 200.0
    };
    let (narrow, wide) = (spread(&with), spread(&without));
    println!("mean standard deviation {narrow:.1} N/m with shapes, {wide:.1} N/m without");
    assert!(wide > 2.0 * narrow, "{wide}, {narrow}");
}
