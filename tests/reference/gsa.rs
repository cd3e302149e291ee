#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::convert::Infallible;
use std::f64::consts::PI;
use std::sync::Mutex;

use modalwatch::gsa::{sobol_indices, Error, Index, Input, Sensitivity, Settings};

const A: f64 = 7.0;
const B: f64 = 0.1;

fn inputs(count: usize, lower: f64, upper: f64) -> Vec<Input> {
    (1..=count).map(|i| Input { name: format!("x{i}"), lower, upper }).collect()
}

fn settings(samples: usize, seed: u64) -> Settings {
    Settings { samples, replicates: 10, seed }
}

fn indices(inputs: &[Input], settings: &Settings, model: impl Fn(&[f64]) -> Vec<f64> + Sync) -> Sensitivity {
    sobol_indices(inputs, settings, |x| Ok::<_, Infallible>(model(x)), None).unwrap()
}

fn ishigami(x: &[f64]) -> Vec<f64> {
    vec![x[0].sin() + A * x[1].sin().powi(2) + B * x[2].powi(4) * x[0].sin()]
}

/// Variance, first-order and total indices of the Ishigami function; Ishigami & Homma (1990).
fn ishigami_closed_form() -> (f64, [f64; 3], [f64; 3]) {
    let v1 = 0.5 * (1.0 + B * PI.powi(4) / 5.0).powi(2);
    let v2 = A * A / 8.0;
    let v13 = B * B * PI.powi(8) * (1.0 / 18.0 - 1.0 / 50.0);
    let v = v1 + v2 + v13;
    (v, [v1 / v, v2 / v, 0.0], [(v1 + v13) / v, v2 / v, v13 / v])
}

/// Largest standard error of a first-order index of both functions with 4096 samples and 10 replicates. The error of the estimator
/// of Jansen does not decrease with the index.
const FIRST_ERROR: f64 = 0.0015;

/// Asserts a difference below 1 % or below `floor`, whichever is larger.
fn assert_close(found: &[Index], closed_form: &[f64], floor: f64) {
    for (i, (found, exact)) in found.iter().zip(closed_form).enumerate() {
        assert!((found.value - exact).abs() < floor.max(0.01 * exact), "input {i}: {found:?} against {exact}");
    }
}

#[test]
fn indices_of_ishigami_are_the_closed_forms_within_one_percent() {
    let (variance, first, total) = ishigami_closed_form();
    let found = indices(&inputs(3, -PI, PI), &Settings::default(), ishigami);
    let output = &found.outputs[0];
    let of = output.indices.as_ref().unwrap();
    assert!((output.variance / variance - 1.0).abs() < 1e-3, "{}", output.variance);
    assert_close(&of.first, &first, 4.0 * FIRST_ERROR);
    assert_close(&of.total, &total, 0.0);
    assert_eq!(found.evaluations, 4096 * 5 * 10 + 1);
}

#[test]
fn indices_of_the_g_function_are_the_closed_forms_within_one_percent() {
    // Sobol' (1993): f = Π (|4x_i − 2| + a_i)/(1 + a_i), V_i = 1/(3(1 + a_i)²), V = Π(1 + V_i) − 1.
    let a = [0.0, 1.0, 4.5, 9.0, 99.0, 99.0, 99.0, 99.0];
    let parts = a.map(|a: f64| 1.0 / (3.0 * (1.0 + a).powi(2)));
    let product: f64 = parts.iter().map(|v| 1.0 + v).product();
    let first = parts.map(|v| v / (product - 1.0));
    let total = parts.map(|v| v / (1.0 + v) * product / (product - 1.0));
    let g = |x: &[f64]| vec![x.iter().zip(a).map(|(x, a)| ((4.0 * x - 2.0).abs() + a) / (1.0 + a)).product()];
    let found = indices(&inputs(8, 0.0, 1.0), &Settings::default(), g);
    let of = found.outputs[0].indices.as_ref().unwrap();
    assert_close(&of.first, &first, 4.0 * FIRST_ERROR);
    // The small indices are 1e-4; the tolerance is 4 standard errors of 1e-6.
    assert_close(&of.total, &total, 4e-6);
}

#[test]
fn an_additive_model_has_equal_first_and_total_indices_that_sum_to_one() {
    let weights = [1.0, 2.0, 3.0];
    let linear = |x: &[f64]| vec![x.iter().zip(weights).map(|(x, w)| w * x).sum()];
    let found = indices(&inputs(3, -1.0, 3.0), &settings(1024, 1), linear);
    let of = found.outputs[0].indices.as_ref().unwrap();
    let closed_form = weights.map(|w| w * w / 14.0);
    assert_close(&of.first, &closed_form, 0.0);
    assert_close(&of.total, &closed_form, 0.0);
    for list in [&of.first, &of.total] {
        let sum: f64 = list.iter().map(|index| index.value).sum();
        assert!((sum - 1.0).abs() < 1e-3, "{sum}");
    }
}

#[test]
fn an_input_without_effect_has_no_total_index() {
    let found = indices(&inputs(4, -PI, PI), &settings(512, 3), ishigami);
    let of = found.outputs[0].indices.as_ref().unwrap();
    let dummy = of.total[3];
    // The outputs at A and A_B^i have the same bits.
    assert!(dummy.value == 0.0 && dummy.interval_90[0] <= 0.0 && dummy.interval_90[1] >= 0.0, "{dummy:?}");
    assert!(of.first[3].value.abs() < 0.01, "{:?}", of.first[3]);
}

#[test]
fn ninety_percent_intervals_cover_ninety_percent() {
    const SEEDS: u64 = 400;
    let (_, first, total) = ishigami_closed_form();
    let mut covered = [[0_u32; 3]; 2];
    for seed in 0..SEEDS {
        let found = indices(&inputs(3, -PI, PI), &settings(256, seed), ishigami);
        let of = found.outputs[0].indices.as_ref().unwrap();
        for i in 0..3 {
            for (kind, (index, exact)) in [(of.first[i], first[i]), (of.total[i], total[i])].into_iter().enumerate() {
                covered[kind][i] += u32::from(index.interval_90[0] <= exact && exact <= index.interval_90[1]);
            }
        }
    }
    // Three standard errors of a share of 0.9 over 400 seeds are 0.045.
    let tolerance = 3.0 * (0.9 * 0.1 / SEEDS as f64).sqrt();
    for count in covered.into_iter().flatten() {
        let share = f64::from(count) / SEEDS as f64;
        assert!((share - 0.9).abs() < tolerance, "{covered:?} of {SEEDS}");
    }
}

#[test]
fn the_same_seed_gives_the_same_bits_on_any_number_of_threads() {
    let on = |threads, seed| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| indices(&inputs(3, -PI, PI), &settings(128, seed), ishigami))
    };
    assert_eq!(on(1, 7), on(5, 7));
    assert_ne!(on(1, 7), on(1, 8));
}

#[test]
fn each_output_has_its_own_indices_and_a_constant_one_has_null() {
    let model = |x: &[f64]| vec![x[0], 1e6 + 1e-12 * x[1], 1e8 + 1e-3 * x[1]];
    let found = indices(&inputs(2, 0.0, 1.0), &settings(256, 1), model);
    let total = |output: usize, input: usize| found.outputs[output].indices.as_ref().unwrap().total[input].value;
    assert!((total(0, 0) - 1.0).abs() < 1e-3 && total(0, 1) == 0.0);
    // Four standard errors of 0.002.
    assert!((total(2, 1) - 1.0).abs() < 0.008 && total(2, 0) == 0.0, "{found:?}");
    let json = serde_json::to_value(&found).unwrap();
    assert!(json["outputs"][1]["indices"].is_null());
    assert_eq!(json["inputs"], serde_json::json!(["x1", "x2"]));
    assert!(json["outputs"][0]["indices"]["first"][0]["interval_90"].is_array());
}

#[test]
fn progress_reaches_the_number_of_runs() {
    let seen = Mutex::new(Vec::new());
    let progress = |done, of| seen.lock().unwrap().push((done, of));
    let model = |x: &[f64]| Ok::<_, Infallible>(vec![x[0]]);
    sobol_indices(&inputs(1, 0.0, 1.0), &settings(64, 0), model, Some(&progress)).unwrap();
    let runs = 64 * 3 * 10;
    assert_eq!(seen.lock().unwrap().iter().max(), Some(&(runs, runs)));
}

#[test]
fn what_cannot_be_sampled_is_refused() {
    let refused = |inputs: &[Input], settings: &Settings| {
        sobol_indices(inputs, settings, |_| Ok::<_, Infallible>(vec![0.0]), None).unwrap_err()
    };
    let (usual, few) = (inputs(2, 0.0, 1.0), settings(64, 0));
    assert_eq!(refused(&[], &few), Error::Inputs { inputs: 0 });
    assert_eq!(refused(&inputs(129, 0.0, 1.0), &few), Error::Inputs { inputs: 129 });
    for samples in [0, 1, 1000, 1 << 17] {
        assert_eq!(refused(&usual, &settings(samples, 0)), Error::Samples { samples });
    }
    assert_eq!(refused(&usual, &Settings { replicates: 1, ..few.clone() }), Error::Replicates { replicates: 1 });
    for (lower, upper) in [(1.0, 1.0), (2.0, 1.0), (f64::NAN, 1.0), (0.0, f64::INFINITY), (-1e308, 1e308)] {
        assert!(matches!(refused(&inputs(1, lower, upper), &few), Error::Range { .. }), "[{lower}, {upper}]");
    }
}

#[test]
fn the_most_inputs_and_the_most_samples_are_within_the_sequence() {
    let sum = |x: &[f64]| vec![x.iter().sum()];
    let found = indices(&inputs(128, 0.0, 1.0), &Settings { samples: 2048, replicates: 2, seed: 1 }, sum);
    let total: f64 = found.outputs[0].indices.as_ref().unwrap().total.iter().map(|index| index.value).sum();
    // In 256 dimensions this is plain Monte Carlo: the standard error of a variance of 8192 values is √(2/8192) = 1.6 %; the tolerance is four times
    // that.
    assert!((total - 1.0).abs() < 0.063, "{total}");
    let found = indices(&inputs(1, 0.0, 1.0), &Settings { samples: 1 << 16, replicates: 2, seed: 1 }, sum);
    assert!((found.outputs[0].variance * 12.0 - 1.0).abs() < 1e-6);
}

#[test]
fn a_model_that_fails_is_reported_with_its_inputs_and_always_the_same_ones() {
    #[derive(Debug, PartialEq, thiserror::Error)]
    #[error("too far")]
    struct TooFar;
    let model = |x: &[f64]| if x[0] > 0.95 { Err(TooFar) } else { Ok(vec![x[0]]) };
    let fails = || sobol_indices(&inputs(2, 0.0, 1.0), &settings(256, 5), model, None).unwrap_err();
    let error = fails();
    assert!(matches!(&error, Error::Model { at, source: TooFar } if at[0] > 0.95), "{error:?}");
    assert!((0..20).all(|_| fails() == error));

    let nan = |x: &[f64]| Ok::<_, TooFar>(vec![1.0, if x[1] > 0.9 { f64::NAN } else { 0.0 }]);
    let error = sobol_indices(&inputs(2, 0.0, 1.0), &settings(256, 5), nan, None).unwrap_err();
    assert!(matches!(&error, Error::NotFinite { at, output: 1, .. } if at[1] > 0.9), "{error:?}");

    let ragged = |x: &[f64]| Ok::<_, TooFar>(vec![1.0; if x[0] > 0.9 { 2 } else { 1 }]);
    let error = sobol_indices(&inputs(2, 0.0, 1.0), &settings(256, 5), ragged, None).unwrap_err();
    assert!(matches!(error, Error::Outputs { found: 2, expected: 1, .. }), "{error:?}");
    let none = sobol_indices(&inputs(2, 0.0, 1.0), &settings(256, 5), |_| Ok::<_, TooFar>(vec![]), None);
    assert_eq!(none.unwrap_err(), Error::NoOutputs);
}
