//! Frequencies that vary in proportion, or not at all: one factor for all stiffnesses, and a mode that no parameter moves. The posterior has a
//! closed form.
//!
//! ```text
//!  ln f_i = ln f_i0 + ½ ln k + s_i ε_i      →      ln k | f ~ N( Σ w_i 2 ln(f_i/f_i0)/Σ w_i,  4/Σ w_i ),    w_i = 1/s_i²
//! ```

use modalwatch::baseline::manifest::Outcome;
use modalwatch::baseline::observation::Observation;
use modalwatch::baseline::starting::starting_model;
use modalwatch::baseline::train::Error;
use modalwatch::baseline::Baseline;
use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::Simulator;
use modalwatch::stats;

/// Relative noise of each mode.
const NOISE: f64 = 0.005;

fn simulator(parts: &str) -> Simulator {
    let text = format!(
        "id = \"one\"\nmodes = 3\nmeasurement_noise = {{ relative = {NOISE:?} }}\n\
         mass = [{{ name = \"a\", kg = 1.0 }}, {{ name = \"b\", kg = 1.5 }}, {{ name = \"c\", kg = 1.2 }}]\n{parts}"
    );
    Simulator::new(StructureDefinition::parse_toml(&text).unwrap()).unwrap()
}

const COMMON: &str = r#"
spring = [
    { name = "k1", from = "ground", to = "a", n_per_m = 90.0 }, { name = "k2", from = "a", to = "b", n_per_m = 70.0 },
    { name = "k3", from = "b", to = "c", n_per_m = 80.0 },
]
parameter = [
    { name = "all", scale = true, prior = { uniform = [0.5, 1.5] }, sets = [{ spring = "k1" }, { spring = "k2" }, { spring = "k3" }] },
]
"#;

/// Three bodies that do not act on each other; the second mode stands still.
const BODIES: &str = r#"
spring = [
    { name = "k1", from = "ground", to = "a", n_per_m = 50.0 }, { name = "k2", from = "ground", to = "b", n_per_m = 300.0 },
    { name = "k3", from = "ground", to = "c", n_per_m = 900.0 },
]
parameter = [{ name = "all", scale = true, prior = { uniform = [0.5, 1.5] }, sets = [{ spring = "k1" }, { spring = "k3" }] }]
"#;

/// A model that is made in a second.
fn made(simulator: &Simulator) -> Result<Baseline, Error> {
    starting_model(simulator).map(|made| made.baseline)
}

/// Compares a posterior with the closed form; `moves`: the modes that the parameter moves.
fn compare(baseline: &Baseline, percent: f64, offs: [Option<f64>; 3], multiples: [f64; 3], moves: &[usize]) {
    const DRAWS: usize = 4_000;
    let nominal = baseline.simulator().nominal_frequencies_hz();
    let exact = baseline.simulator().frequencies_hz(&[percent]).unwrap();
    let frequencies_hz: Vec<Option<f64>> =
        exact.iter().zip(offs).map(|(f, off)| off.map(|off| f * (1.0 + off * NOISE))).collect();
    let observation = Observation {
        noise_multiple: multiples.to_vec(),
        frequencies_hz: frequencies_hz.clone(),
        ..Observation::complete(&exact)
    };
    let (mut sum, mut weights) = (0.0, 0.0);
    for mode in moves {
        let Some(f) = frequencies_hz[*mode] else { continue };
        let weight = (multiples[*mode] * NOISE).powi(-2);
        sum += weight * 2.0 * (f / nominal[*mode]).ln();
        weights += weight;
    }
    let (mean, std) = (sum / weights, 2.0 / weights.sqrt());
    let samples = baseline.infer(&[observation], DRAWS, 7).unwrap();
    let logs: Vec<f64> = samples.column(0).iter().map(|p| (p / 100.0).ln()).collect();
    let (found, found_std) = (stats::mean(&logs), stats::sample_std(&logs).unwrap());
    // Four Monte Carlo errors of the mean, and what the prior, which is constant in p and not in ln p, moves it by: std².
    let close = 4.0 * std / (DRAWS as f64).sqrt() + 1.5 * std * std;
    assert!((found - mean).abs() < close, "{percent} {offs:?} {multiples:?}: {found}, exactly {mean} within {close}");
    // The Monte Carlo error is 1.1 %; the noise in proportion to the simulated instead of the measured frequency adds some per cent of std.
    assert!((found_std / std - 1.0).abs() < 0.05, "{percent} {offs:?} {multiples:?}: {found_std}, exactly {std}");
}

#[test]
fn one_factor_for_all_stiffnesses_is_known_from_each_mode_and_better_from_all() {
    let baseline = made(&simulator(COMMON)).unwrap();
    assert_eq!(baseline.manifest().calibration.outcome(), Outcome::NotMeasured);
    let all = [0, 1, 2];
    compare(&baseline, 100.0, [Some(0.0), Some(0.0), Some(0.0)], [1.0; 3], &all);
    compare(&baseline, 70.0, [Some(0.6), Some(-0.8), Some(0.3)], [1.0; 3], &all);
    compare(&baseline, 120.0, [None, Some(0.5), None], [1.0; 3], &all);
    compare(&baseline, 85.0, [Some(0.2), Some(-1.0), Some(0.4)], [0.5, 3.0, 1.0], &all);
}

#[test]
fn a_mode_that_no_parameter_moves_says_nothing_of_it() {
    let baseline = made(&simulator(BODIES)).unwrap();
    for off in [0.0, 1.5, -1.5] {
        compare(&baseline, 90.0, [Some(0.3), Some(off), Some(-0.4)], [1.0; 3], &[0, 2]);
    }
    compare(&baseline, 110.0, [Some(0.3), None, Some(0.8)], [1.0; 3], &[0, 2]);
}

#[test]
fn only_a_structure_of_which_no_frequency_moves_is_refused() {
    // The measured modes are the lowest three of four, and the parameter moves the fourth only.
    let still = BODIES
        .replace("{ name = \"k1\" }", "")
        .replace("sets = [{ spring = \"k1\" }, { spring = \"k3\" }]", "sets = { spring = \"k4\" }")
        .replace("spring = [\n", "spring = [{ name = \"k4\", from = \"ground\", to = \"d\", n_per_m = 1e5 },\n");
    let text = format!(
        "id = \"one\"\nmodes = 3\nmeasurement_noise = {{ relative = {NOISE:?} }}\n\
         mass = [{{ name = \"a\", kg = 1.0 }}, {{ name = \"b\", kg = 1.5 }}, {{ name = \"c\", kg = 1.2 }}, {{ name = \"d\", kg = 1.0 }}]\n{still}"
    );
    let simulator = Simulator::new(StructureDefinition::parse_toml(&text).unwrap()).unwrap();
    let refused = made(&simulator).err().unwrap();
    assert!(matches!(refused, Error::Degenerate), "{refused}");
    assert!(refused.to_string().starts_with("no frequency varies over the prior"), "{refused}");
}
