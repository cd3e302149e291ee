//! Accuracy of a training against its time, for case 1 of the paper without noise.
//!
//! ```text
//! cargo bench --bench accuracy [-- THREADS EPOCHS SAMPLES UNITS WIDTH CLAMP BATCH]…    seven numbers for each training
//! ```
//!
//! Without noise the exact posterior of a measurement is the point that it was simulated at, so that the distance of a draw from
//! it is an error, except for the few measurements that a second point of the prior gives too. Prints the time of the training
//! alone (without simulations and checks), the held-out negative log-likelihood in the unit box of the prior, the gross outliers
//! among the draws, and the errors of the hyperparameters of fifty measurements with ten draws each, relative to those of the
//! exact posterior.

use std::collections::BTreeSet;
use std::path::Path;
use std::time::Instant;

use modalwatch::baseline::observation::{Observation, DEFAULT_NOISE_RANGE};
use modalwatch::baseline::train::{train, validate};
use modalwatch::baseline::Baseline;
use modalwatch::flow::train::TrainSettings;
use modalwatch::flow::FlowSettings;
use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::population::Population;
use modalwatch::simulator::Simulator;
use modalwatch::stats;
use nalgebra::DMatrix;

/// Number of held-out measurements, and of draws for each when outliers are counted.
const HELD_OUT: usize = 10_000;
const DRAWS: usize = 20;
/// A draw further than this from the truth is a gross outlier. Where k1 is stiff and k2 soft, the map from stiffnesses to frequencies
/// folds: two points of the prior give the same frequencies there. The bench therefore prints how many outliers reproduce the
/// measured frequencies.
const GROSS_N_PER_M: f64 = 0.1;
/// Number of batches of fifty measurements from which hyperparameters are estimated, and of draws for each measurement.
const BATCHES: u64 = 400;
const POOLED: usize = 10;

/// On one thread within 8 s, and on two within 20 s.
const TRAININGS: [[usize; 7]; 2] = [[1, 50, 10_000, 4, 64, 30, 256], [2, 120, 40_000, 4, 64, 50, 256]];

fn main() {
    // As in `main.rs`.
    std::env::set_var("RAYON_NUM_THREADS", "1");
    let numbers: Vec<usize> = std::env::args().skip(1).filter_map(|given| given.parse().ok()).collect();
    let given: Vec<[usize; 7]> = numbers.as_chunks::<7>().0.to_vec();
    let text = Path::new(env!("CARGO_MANIFEST_DIR")).join("models/three-dof/structure.toml");
    let text = std::fs::read_to_string(text).expect("it is shipped").replace("relative = 0.001", "relative = 0.0");
    let simulator = Simulator::new(StructureDefinition::parse_toml(&text).expect("a structure")).expect("it simulates");
    assert!(!simulator.is_noisy(), "the structure file states its noise in other words");
    for settings in if given.is_empty() { TRAININGS.to_vec() } else { given } {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(settings[0]).build().expect("a pool of threads");
        pool.install(|| measure(&simulator, settings));
    }
}

fn measure(simulator: &Simulator, [threads, epochs, samples, units, width, clamp_tenths, batch]: [usize; 7]) {
    let flow = FlowSettings { units, width, clamp_tenths: clamp_tenths as u32, ..FlowSettings::default() };
    let settings = TrainSettings { epochs, batch, ..TrainSettings::default() };
    let (mut first, mut last) = (None, Instant::now());
    let trained = train(simulator, samples, DEFAULT_NOISE_RANGE, &flow, &settings, |_| {
        last = Instant::now();
        first.get_or_insert(last);
    });
    let baseline = trained.expect("it trains").baseline;
    // The time is measured from the end of the first epoch and extrapolated to all epochs.
    let took_s =
        first.map_or(0.0, |first| last.duration_since(first).as_secs_f64()) * epochs as f64 / (epochs - 1) as f64;

    let set = simulator.training_set(HELD_OUT, 987_654_321).expect("the prior holds no mechanism");
    let observations = exact(&set.frequencies_hz);
    let record = validate(&baseline, &set.theta, &observations, 5).expect("it infers");
    println!("{threads} thread(s), {samples} samples, {epochs} epochs of steps of {batch}, {units} units of width {width}, clamp {}", clamp_tenths as f64 / 10.0);
    println!(
        "  training {took_s:.1} s, held out {:.2} ± {:.2} nats, best epoch {}",
        record.negative_log_likelihood,
        record.negative_log_likelihood_error,
        baseline.manifest().training.best_epoch
    );

    let draws = baseline.infer(&observations, DRAWS, 1).expect("draws are finite");
    let error = |row: usize| (draws.theta().row(row) - set.theta.row(row / DRAWS)).amax();
    let gross: Vec<usize> = (0..draws.theta().nrows()).filter(|row| error(*row) > GROSS_N_PER_M).collect();
    let misfit = |row: &usize| {
        let theta: Vec<f64> = draws.theta().row(*row).iter().copied().collect();
        let there = simulator.frequencies_hz(&theta).expect("the prior holds no mechanism");
        let asked = set.frequencies_hz.row(row / DRAWS);
        there.iter().zip(asked.iter()).map(|(f, y)| (f / y - 1.0).abs()).fold(0.0, f64::max)
    };
    let misfits: Vec<f64> = gross.iter().map(misfit).collect();
    let measurements: BTreeSet<usize> = gross.iter().map(|row| row / DRAWS).collect();
    let all = HELD_OUT * DRAWS;
    println!(
        "  {all} draws, all finite: {} gross outliers, {:.4} %, of {} measurements",
        gross.len(),
        100.0 * gross.len() as f64 / all as f64,
        measurements.len()
    );
    if !gross.is_empty() {
        println!(
            "  {} of them reproduce the measured frequencies to ten digits: they lie at the second solution",
            misfits.iter().filter(|misfit| **misfit < 1e-10).count()
        );
    }
    hyperparameters(&baseline);
}

/// Mean error of the hyperparameters of the pooled draws, divided by that of the true values of the same measurements.
fn hyperparameters(baseline: &Baseline) {
    let moments = [("k1", 4.0, 0.3), ("k2", 5.0, 0.1), ("k3", 6.0, 0.2)].map(|(name, m, s)| (name.to_owned(), m, s));
    let population = Population::new(baseline.space(), &moments).expect("it lies in the prior");
    let (mut of_flow, mut of_exact) = ([[0.0; 2]; 3], [[0.0; 2]; 3]);
    for seed in 0..BATCHES {
        let drawn = population.draw(baseline.simulator(), 50, 0.0, seed).expect("the prior holds no mechanism");
        let pool = baseline.infer(&exact(&drawn.frequencies_hz), POOLED, seed).expect("draws are finite");
        for (k, (_, mean, std)) in moments.iter().enumerate() {
            let realised: Vec<f64> = drawn.theta.column(k).iter().copied().collect();
            for (sums, values) in [(&mut of_flow[k], pool.column(k)), (&mut of_exact[k], realised)] {
                sums[0] += (stats::mean(&values) - mean).abs();
                sums[1] += (stats::sample_std(&values).expect("there are many") - std).abs();
            }
        }
    }
    for (k, (name, ..)) in moments.iter().enumerate() {
        let [mean, std] = [0, 1].map(|i| of_flow[k][i] / of_exact[k][i]);
        println!(
            "  {name}: errors relative to those of the exact posterior: mean {mean:.3}, standard deviation {std:.3}"
        );
    }
}

fn exact(frequencies_hz: &DMatrix<f64>) -> Vec<Observation> {
    let modes = frequencies_hz.ncols();
    let one = |row: nalgebra::MatrixView1xX<'_, f64, nalgebra::U1, nalgebra::Dyn>| Observation {
        noise_multiple: vec![0.0; modes],
        ..Observation::complete(&row.iter().copied().collect::<Vec<_>>())
    };
    frequencies_hz.row_iter().map(one).collect()
}
