//! What a diagnosis says of units, of the time of day and of noise is true.
//!
//! The data are those of a tower of three floors with its own matrix, which the program does not use.

use std::fmt::Write as _;

use nalgebra::DMatrix;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use serde_json::Value;

use super::world::{rfc3339, EPOCH_2024_S};
use super::{answer, refusal};

const NOISE: f64 = 0.0005;
const ROWS: usize = 240;
const N_PER_M: [f64; 3] = [4.2e6, 3.6e6, 3.0e6];
const KG: [f64; 3] = [1_200.0, 900.0, 700.0];

/// Frequencies of the tower, Hz, with factors on its three stiffnesses.
fn hz(factors: [f64; 3]) -> Vec<f64> {
    let [k1, k2, k3] = [0, 1, 2].map(|s| N_PER_M[s] * factors[s]);
    let k = [[k1 + k2, -k2, 0.0], [-k2, k2 + k3, -k3], [0.0, -k3, k3]];
    let scaled = DMatrix::from_fn(3, 3, |i, j| k[i][j] / (KG[i] * KG[j]).sqrt());
    let mut lambda: Vec<f64> = scaled.symmetric_eigenvalues().iter().copied().collect();
    lambda.sort_by(f64::total_cmp);
    lambda.iter().map(|l| l.sqrt() / std::f64::consts::TAU).collect()
}

/// The structure file, with masses that are multiplied by `of_masses`. The stiffness of the first storey is unknown within `prior`.
fn tower(of_masses: f64, prior: [f64; 2]) -> String {
    let mut text = format!(
        "id = \"tower\"\nmodes = 3\nmeasurement_noise = {{ relative = {NOISE} }}\n[[covariate]]\nname = \"temperature_c\"\n\
         [[parameter]]\nname = \"k1\"\nprior = {{ uniform = {prior:?} }}\nsets = {{ spring = \"k1\" }}\n"
    );
    for floor in 0..3 {
        let from = if floor == 0 { "ground".to_owned() } else { format!("m{floor}") };
        let name = floor + 1;
        let _ = writeln!(text, "[[mass]]\nname = \"m{name}\"\nkg = {:?}", KG[floor] * of_masses);
        let _ = writeln!(
            text,
            "[[spring]]\nname = \"k{name}\"\nfrom = \"{from}\"\nto = \"m{name}\"\nn_per_m = {:?}",
            N_PER_M[floor]
        );
    }
    text
}

/// Hourly measurements of about ten days; `frequencies` gives those of an hour at a temperature, whose weather lasts for half a day.
fn hourly(seed: u64, recorded: bool, frequencies: impl Fn(usize, f64) -> Vec<f64>) -> String {
    let mut stream = ChaCha8Rng::seed_from_u64(seed);
    let mut csv = format!("measured_at,f1_hz,f2_hz,f3_hz{}\n", if recorded { ",temperature_c" } else { "" });
    let mut weather = 0.0;
    for row in 0..ROWS {
        let (day, hour) = (1 + row / 24, row % 24);
        weather = 0.92 * weather + 0.39 * stream.sample::<f64, _>(StandardNormal);
        let temperature_c = 12.0 + 5.0 * swing(hour) + 3.0 * weather;
        let _ = write!(csv, "2026-05-{day:02}T{hour:02}:00:00Z");
        for f in frequencies(hour, temperature_c) {
            let _ = write!(csv, ",{:.6}", f * (1.0 + NOISE * stream.sample::<f64, _>(StandardNormal)));
        }
        if recorded {
            let _ = write!(csv, ",{temperature_c:.2}");
        }
        csv.push('\n');
    }
    csv
}

/// A swing of the day that is highest at 15 h.
fn swing(hour: usize) -> f64 {
    ((hour as f64 - 15.0) / 24.0 * std::f64::consts::TAU).cos()
}

fn cause(found: &Value) -> &Value {
    assert_eq!(found["verdict"], "cause", "{}", found["summary"]);
    &found["causes"][0]
}

fn said(cause: &Value) -> &str {
    cause["sentence"].as_str().unwrap()
}

const PRIOR: [f64; 2] = [2.0e6, 8.0e6];

#[test]
fn a_swing_with_the_time_of_day_is_told_with_its_hour_and_a_recorded_temperature_comes_before_it() {
    let structure = tower(1.0, PRIOR);
    let found = answer(&structure, &hourly(1, false, |hour, _| hz([1.0, 1.0 + 0.01 * swing(hour), 1.0])), &[]);
    let swings = cause(&found);
    println!("{}", said(swings));
    assert_eq!((&swings["target"]["name"], &swings["covariate"]), (&"k2".into(), &"time of day".into()));
    assert!(said(swings).contains("about 15 h UTC"), "{}", said(swings));
    let found = answer(&structure, &hourly(2, true, |_, c| hz([1.0, 1.0 - 0.002 * (c - 12.0), 1.0])), &[]);
    let follows = cause(&found);
    assert_eq!((&follows["target"]["name"], &follows["covariate"]), (&"k2".into(), &"temperature_c".into()));
    let found = answer(&structure, &hourly(3, true, |_, _| hz([1.0; 3])), &[]);
    assert_eq!(found["verdict"], "nothing_found", "{}", found["summary"]);
}

#[test]
fn frequencies_in_another_unit_and_weights_for_masses_are_told_as_such() {
    let (exact, structure) = (|_, _| hz([1.0; 3]), tower(1.0, PRIOR));
    let in_unit =
        |unit: fn(f64) -> f64| hourly(4, false, move |hour, c| exact(hour, c).into_iter().map(unit).collect());
    for (unit, name) in [
        (in_unit(|f| f * std::f64::consts::TAU), "rad/s"),
        (in_unit(|f| f * 60.0), "rpm"),
        (in_unit(|f| 1.0 / f), "periods in s"),
    ] {
        let said = refusal(&structure, &unit, &[]);
        assert!(said.contains(&format!("read as {name} instead of Hz")), "{said}");
    }
    let data = hourly(5, false, exact);
    for (factor, words) in
        [(9.806_65, "weights in N"), (386.089, "weights in lbf"), (1e-3, "masses of the structure file are read as t")]
    {
        let said = refusal(&tower(factor, PRIOR), &data, &[]);
        assert!(said.contains(words), "{said}");
    }
    // Half the stiffness everywhere, or twice, is no unit.
    for factor in [0.5, 2.0] {
        let found = answer(&tower(factor, PRIOR), &data, &[]);
        println!("{}", found["summary"]);
    }
}

#[test]
fn a_parameter_at_the_end_of_its_search_is_not_told_as_what_the_data_give() {
    // The stiffness is a third of the smallest value that the prior allows.
    let found = answer(&tower(1.0, [3.5e6, 5.0e6]), &hourly(6, false, |_, _| hz([0.3, 1.0, 1.0])), &[]);
    println!("{}\n{}", found["summary"], found["notes"]);
    let notes: Vec<&str> = found["notes"].as_array().unwrap().iter().filter_map(Value::as_str).collect();
    for note in notes.iter().filter(|note| note.contains("outside its prior")) {
        assert!(note.contains("the search ended at") && note.contains("smaller"), "{note}");
    }
    assert!(notes.iter().any(|note| note.contains("outside its prior")), "{notes:?}");
    // A constant that the prior does not allow is not told as a change with time.
    let causes = found["causes"].as_array().unwrap();
    assert!(causes.iter().all(|cause| cause["covariate"].is_null()), "{}", found["summary"]);
}

#[test]
fn a_loss_beside_an_unrecorded_season_is_told_as_possible_damage_and_a_season_alone_is_not() {
    let days = 400;
    for loss in [0.0, 0.05] {
        let mut stream = ChaCha8Rng::seed_from_u64(7);
        let mut csv = "measured_at,f1_hz,f2_hz,f3_hz\n".to_owned();
        for day in 0..days {
            let season = 1.0 + 0.015 * (f64::from(day) / 365.25 * std::f64::consts::TAU).cos();
            let left = if day >= 250 { 1.0 - loss } else { 1.0 };
            csv += &rfc3339(EPOCH_2024_S + 86_400 * i64::from(day));
            for f in hz([season, season * left, season]) {
                let _ = write!(csv, ",{:.6}", f * (1.0 + NOISE * stream.sample::<f64, _>(StandardNormal)));
            }
            csv.push('\n');
        }
        let found = answer(&tower(1.0, PRIOR), &csv, &[]);
        println!("{}", found["summary"]);
        let causes = found["causes"].as_array().unwrap();
        let any = |key: &str, value: &str| causes.iter().any(|cause| cause[key] == value);
        assert!(any("covariate", "time of year"), "{}", found["summary"]);
        let damage = any("class", "possible_damage") || !found["lasting_change"].is_null();
        assert_eq!(damage, loss > 0.0, "{}", found["summary"]);
    }
}
