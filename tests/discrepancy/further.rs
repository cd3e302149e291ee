//! Hidden effects in data of other kinds of simulation: a table of runs, and a beam.
//!
//! The data are generated with Ritz's method with sine functions and with the explicit matrix of a chain, neither of which the
//! program uses.

use std::fmt::Write as _;

use nalgebra::{DMatrix, DVector};
use rand::seq::SliceRandom as _;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use serde_json::Value;

use super::answer;

const NOISE: f64 = 0.002;
const ROWS: usize = 300;

/// Frequencies, Hz, of K φ = λ φ after scaling by the masses.
fn frequencies_hz(scaled_stiffness: &DMatrix<f64>, modes: usize) -> Vec<f64> {
    let mut lambda: Vec<f64> = scaled_stiffness.symmetric_eigenvalues().iter().copied().collect();
    lambda.sort_by(f64::total_cmp);
    lambda[..modes].iter().map(|l| l.sqrt() / std::f64::consts::TAU).collect()
}

/// Measurements as CSV under a seasonal temperature; `frequencies` gives those at a temperature.
fn season(seed: u64, modes: usize, mut frequencies: impl FnMut(f64, &mut ChaCha8Rng) -> Vec<f64>) -> String {
    let mut stream = ChaCha8Rng::seed_from_u64(seed);
    let names: Vec<String> = (1..=modes).map(|m| format!("f{m}_hz")).collect();
    let mut csv = format!("measured_at,{},temperature_c\n", names.join(","));
    for row in 0..ROWS {
        let day = row as f64 * 1.2;
        let weather: f64 = stream.sample(StandardNormal);
        let temperature_c = 9.0 + 12.0 * (day / 365.25 * std::f64::consts::TAU).sin() + 4.0 * weather;
        let exact = frequencies(temperature_c, &mut stream);
        let noisy: Vec<String> = exact
            .iter()
            .map(|f| format!("{:.6}", f * (1.0 + NOISE * stream.sample::<f64, _>(StandardNormal))))
            .collect();
        let (hour, date) = (row % 24, 1 + row / 24);
        writeln!(csv, "2025-03-{date:02}T{hour:02}:00:00Z,{},{temperature_c:.2}", noisy.join(",")).unwrap();
    }
    csv
}

/// A chain of three bodies; the parameters are the stiffness of its two lower springs.
fn chain_hz(k1: f64, k2: f64) -> Vec<f64> {
    let (k3, kg) = (3.0e6, [1200.0_f64, 900.0, 700.0]);
    let k = [[k1 + k2, -k2, 0.0], [-k2, k2 + k3, -k3], [0.0, -k3, k3]];
    frequencies_hz(&DMatrix::from_fn(3, 3, |i, j| k[i][j] / (kg[i] * kg[j]).sqrt()), 3)
}

fn table_structure(seed: u64) -> String {
    let mut stream = ChaCha8Rng::seed_from_u64(seed);
    let runs = 120;
    let mut order: Vec<usize> = (0..runs).collect();
    order.shuffle(&mut stream);
    let mut csv = "k1,k2,f1_hz,f2_hz,f3_hz\n".to_owned();
    for (run, partner) in order.into_iter().enumerate() {
        let within = |stratum: usize, stream: &mut ChaCha8Rng| {
            2.0e6 + 4.0e6 * (stratum as f64 + stream.random::<f64>()) / runs as f64
        };
        let (k1, k2) = (within(run, &mut stream), within(partner, &mut stream));
        let f = chain_hz(k1, k2);
        writeln!(csv, "{k1},{k2},{},{},{}", f[0], f[1], f[2]).unwrap();
    }
    let parameter = |name: &str| format!("[[parameter]]\nname = \"{name}\"\nprior = {{ uniform = [2.1e6, 5.9e6] }}\n");
    let head = format!(
        "id = \"tower-table\"\nsimulation = \"table\"\nmodes = 3\nmeasurement_noise = {{ relative = {NOISE} }}\n\
         [[covariate]]\nname = \"temperature_c\"\n"
    );
    format!("{head}{}{}[table]\ncsv = '''\n{csv}'''\n", parameter("k1"), parameter("k2"))
}

fn number(answer: &Value, pointer: &str) -> f64 {
    answer.pointer(pointer).and_then(Value::as_f64).unwrap_or_else(|| panic!("no {pointer} in {answer:#}"))
}

/// The slope of the first cause per °C, as a share, and its 90 % interval.
fn slope(answer: &Value) -> (f64, [f64; 2]) {
    let cause = &answer["causes"][0];
    let numbers = cause["parameters"].as_array().unwrap();
    let slope = numbers.iter().find(|n| n["name"].as_str().unwrap().contains("slope")).unwrap();
    let interval = slope["interval90"].as_array().unwrap();
    (slope["value"].as_f64().unwrap(), [interval[0].as_f64().unwrap(), interval[1].as_f64().unwrap()])
}

/// Extends the structure by the causes in the data; a diagnosis of the extended structure must find nothing.
fn extended_finds_nothing(structure: &str, csv: &str) {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    std::fs::write(path("structure.toml"), structure).unwrap();
    std::fs::write(path("data.csv"), csv).unwrap();
    let output = std::process::Command::new(env!("CARGO_BIN_EXE_modalwatch"))
        .args(["extend", "--structure", &path("structure.toml"), "--data", &path("data.csv")])
        .args(["--out", &path("extended"), "--no-training"])
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let output = std::process::Command::new(env!("CARGO_BIN_EXE_modalwatch"))
        .args(["diagnose", "--json", "--structure", &path("extended/structure.json"), "--data", &path("data.csv")])
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let left: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(left["verdict"], "nothing_found", "{}", left["summary"]);
}

#[test]
fn a_table_names_the_parameter_that_follows_the_temperature_and_nothing_in_healthy_data() {
    let structure = table_structure(1);
    let draw = |stream: &mut ChaCha8Rng, mean: f64| mean * (1.0 + 0.01 * stream.sample::<f64, _>(StandardNormal));
    let hidden = season(2, 3, |temperature_c, stream| {
        chain_hz(draw(stream, 4.2e6), draw(stream, 3.6e6) * (1.0 - 0.004 * (temperature_c - 9.0)))
    });
    let found = answer(&structure, &hidden, &[]);
    println!("{}", found["summary"]);
    assert_eq!(found["verdict"], "cause", "{found:#}");
    assert_eq!(found["causes"][0]["target"]["kind"], "parameter", "{found:#}");
    assert_eq!(found["causes"][0]["target"]["name"], "k2");
    assert_eq!(found["causes"][0]["covariate"], "temperature_c");
    let (value, [low, high]) = slope(&found);
    // Twice the half-width of the 90 % interval is allowed.
    println!("slope {value} [{low}, {high}]");
    assert!((value + 0.004).abs() < high - low, "{value} [{low}, {high}]");
    assert!(high < 0.0 && high - low < 0.002, "an interval without information: [{low}, {high}]");
    extended_finds_nothing(&structure, &hidden);

    let healthy = season(3, 3, |_, stream| chain_hz(draw(stream, 4.2e6), draw(stream, 3.6e6)));
    let silent = answer(&structure, &healthy, &[]);
    assert_eq!(silent["verdict"], "nothing_found", "{silent:#}");

    // A fault of the instrument, which acts on the frequencies. With three modes and two parameters, only one direction
    // remains: the mode cannot be identified, but the instrument can.
    let third_off = season(4, 3, |_, stream| {
        let mut f = chain_hz(draw(stream, 4.2e6), draw(stream, 3.6e6));
        f[2] *= 1.01;
        f
    });
    let found = answer(&structure, &third_off, &[]);
    println!("{}", found["summary"]);
    assert_eq!(found["verdict"], "ambiguous", "{found:#}");
    let named = found["causes"].as_array().unwrap().iter().chain(found["alternatives"].as_array().unwrap());
    let of_instrument: Vec<&Value> = named.filter(|c| c["target"]["kind"] == "frequency_scale").collect();
    assert!(of_instrument.iter().any(|c| c["target"]["name"] == "mode 3"), "{found:#}");
}

/// A pinned beam with a bearing at a third of its length, by Ritz's method with sine functions.
fn beam_hz(ei: f64, bearing_n_per_m: f64) -> Vec<f64> {
    let (terms, length_m, kg_per_m) = (60, 18.0, 700.0);
    let sine = |n: usize, x_m: f64| ((n + 1) as f64 * std::f64::consts::PI * x_m / length_m).sin();
    let at_bearing = DVector::from_fn(terms, |n, _| sine(n, length_m / 3.0));
    let modal_kg = kg_per_m * length_m / 2.0;
    let wave = |n: usize| ((n + 1) as f64 * std::f64::consts::PI / length_m).powi(4) * ei * length_m / 2.0;
    let k = DMatrix::from_fn(terms, terms, |i, j| {
        let bending = if i == j { wave(i) } else { 0.0 };
        (bending + bearing_n_per_m * at_bearing[i] * at_bearing[j]) / modal_kg
    });
    frequencies_hz(&k, 4)
}

const BEAM: &str = r#"id = "beam-on-bearing"
simulation = "beam"
modes = 4
measurement_noise = { relative = 0.002 }
[[node]]
name = "west"
x_m = 0.0
support = "pinned"
[[node]]
name = "pier"
x_m = 6.0
[[node]]
name = "east"
x_m = 18.0
support = "pinned"
[[beam]]
name = "short"
from = "west"
to = "pier"
mass_kg_per_m = 700.0
elements = 6
[[beam]]
name = "long"
from = "pier"
to = "east"
mass_kg_per_m = 700.0
elements = 12
[[spring]]
name = "bearing"
from = "ground"
to = "pier"
n_per_m = 6.0e6
[[parameter]]
name = "ei"
prior = { uniform = [3.0e8, 7.0e8] }
sets = [{ beam = "short" }, { beam = "long" }]
[[covariate]]
name = "temperature_c"
"#;

#[test]
fn a_beam_names_the_bearing_that_softens_in_the_warmth() {
    let hidden = season(5, 4, |temperature_c, stream| {
        let ei = 5.0e8 * (1.0 + 0.01 * stream.sample::<f64, _>(StandardNormal));
        beam_hz(ei, 6.0e6 * (1.0 - 0.008 * (temperature_c - 9.0)))
    });
    let found = answer(BEAM, &hidden, &[]);
    println!("{}", found["summary"]);
    assert_eq!(found["verdict"], "cause", "{found:#}");
    let target = &found["causes"][0]["target"];
    assert_eq!((target["kind"].as_str(), target["name"].as_str()), (Some("spring"), Some("bearing")), "{found:#}");
    assert_eq!(found["causes"][0]["covariate"], "temperature_c");
    assert!(number(&found, "/causes/0/probability") > 0.9);
    extended_finds_nothing(BEAM, &hidden);
}
