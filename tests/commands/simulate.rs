//! `modalwatch simulate`: a year of a tower, read back from its table.

use std::collections::BTreeMap;

use crate::commands::world::World;

/// The columns of a table by name; an empty cell is NaN, and the times are left out.
fn columns(csv: &str) -> BTreeMap<String, Vec<f64>> {
    let mut lines = csv.lines();
    let names: Vec<&str> = lines.next().unwrap().split(',').collect();
    let mut found: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for line in lines {
        for (name, cell) in names.iter().zip(line.split(',')).skip(1) {
            found.entry((*name).to_owned()).or_default().push(cell.parse().unwrap_or(f64::NAN));
        }
    }
    found
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

const YEAR: &[&str] =
    &["simulate", "tower.toml", "--from", "2026-01-01", "--days", "360", "--every", "1h", "--noise", "0"];

#[test]
fn a_covariate_follows_the_year_the_day_and_lasting_weather() {
    let world = World::new();
    let calm = columns(&world.run(&[YEAR, &["--covariate", "temperature_c=10,year=12,day=4"]].concat()));
    let calm = &calm["temperature_c"];
    assert_eq!(calm.len(), 8_640);
    // 03:00 on 15 January, give or take the day by which calendar years drift, is the coldest; the warmest is half a year and half a
    // day later.
    let coldest = (0..calm.len()).min_by(|a, b| calm[*a].total_cmp(&calm[*b])).unwrap();
    let warmest = (0..calm.len()).max_by(|a, b| calm[*a].total_cmp(&calm[*b])).unwrap();
    assert_eq!((coldest % 24, warmest % 24), (3, 15));
    assert!((13..=15).contains(&(coldest / 24)), "day {}", coldest / 24);
    assert!((195..=198).contains(&(warmest / 24)), "day {}", warmest / 24);
    assert!((calm[coldest] - -6.0).abs() < 0.01 && (calm[warmest] - 26.0).abs() < 0.01);

    let windy = columns(&world.run(&[YEAR, &["--covariate", "temperature_c=10,weather=3,lasting=2d"]].concat()));
    let weather: Vec<f64> = windy["temperature_c"].iter().map(|t| t - 10.0).collect();
    let variance = mean(&weather.iter().map(|w| w * w).collect::<Vec<_>>());
    // 360 days hold about 90 independent values, whose variance is known to 15 %: three of these.
    assert!((variance / 9.0 - 1.0).abs() < 0.45, "{variance}");
    let lagged: Vec<f64> = weather.windows(49).map(|pair| pair[0] * pair[48]).collect();
    let correlation = mean(&lagged) / variance;
    // exp(−1) after the lasting time of two days; a correlation of 90 independent values errs by 0.1.
    assert!((correlation - (-1.0_f64).exp()).abs() < 0.3, "{correlation}");
}

#[test]
fn a_loss_a_trend_and_an_effect_change_frequencies_as_the_structure_does() {
    let world = World::new();
    let rows = |flags: &[&str]| columns(&world.run(&[YEAR, flags].concat()));
    let still = rows(&["--missing", "0.0", "--trend", "k1=0%/year"]);
    let loss = rows(&["--loss", "k2=8%", "--from-date", "2026-08-07"]);
    let first = (31 + 28 + 31 + 30 + 31 + 30 + 31 + 6) * 24;
    for mode in ["f1_hz", "f2_hz", "f3_hz", "f4_hz"] {
        assert_eq!(loss[mode][..first], still[mode][..first], "nothing changes before the date");
        // No frequency rises when a spring becomes softer (Rayleigh); one whose shape hardly strains the spring hardly falls.
        assert!(loss[mode][first..].iter().all(|f| *f <= still[mode][0]), "{mode} does not rise with the loss");
    }
    assert!(loss["f1_hz"][first..].iter().all(|f| *f < still["f1_hz"][0] * 0.999), "the first mode falls");
    // The same structure with 0.92 k2 from the start.
    let reduced = columns(&world.run(&[
        "simulate",
        "tower.toml",
        "--noise",
        "0",
        "--measurements",
        "1",
        "--parameter",
        "k2=2.76e7,0",
    ]));
    assert!((loss["f1_hz"][first] / reduced["f1_hz"][0] - 1.0).abs() < 1e-12);

    // 1 % a month for 12 months is 12 %; 0.5 % per °C above the mean is the same as a loss of 5 % at 10 °C above.
    let trend = rows(&["--trend", "k2=-1%/month"]);
    let at_end = columns(&world.run(&[
        "simulate",
        "tower.toml",
        "--noise",
        "0",
        "--measurements",
        "1",
        "--parameter",
        &format!("k2={},0", 3e7 * (1.0 - 0.01 * (8_639.0 / 24.0) / 30.436_875)),
    ]));
    assert!((trend["f3_hz"][8_639] / at_end["f3_hz"][0] - 1.0).abs() < 1e-9);
    let warm = rows(&["--covariate", "temperature_c=10,year=10", "--effect", "k2=-0.5%/temperature_c"]);
    let place = (0..8_640).find(|i| (warm["temperature_c"][*i] - 15.0).abs() < 0.01).unwrap();
    let k2 = 3e7 * (1.0 - 0.005 * (warm["temperature_c"][place] - 10.0));
    let here = columns(&world.run(&[
        "simulate",
        "tower.toml",
        "--noise",
        "0",
        "--measurements",
        "1",
        "--parameter",
        &format!("k2={k2},0"),
    ]));
    assert!((warm["f2_hz"][place] / here["f2_hz"][0] - 1.0).abs() < 1e-9);
}

#[test]
fn modes_are_missing_and_outliers_occur_as_often_as_wanted_and_seeds_repeat() {
    let world = World::new();
    let flags = ["--missing", "0.1", "--outliers", "0.05", "--seed", "7"];
    let text = world.run(&[YEAR, &flags[..]].concat());
    assert_eq!(text, world.run(&[YEAR, &flags[..]].concat()), "the same seed gives the same table");
    assert_ne!(text, world.run(&[YEAR, &["--missing", "0.1", "--outliers", "0.05", "--seed", "8"]].concat()));
    let found = columns(&text);
    let all: Vec<f64> = ["f1_hz", "f2_hz", "f3_hz", "f4_hz"].iter().flat_map(|mode| found[*mode].clone()).collect();
    let missing = all.iter().filter(|f| f.is_nan()).count() as f64 / all.len() as f64;
    // A share of 0.1 among 34,560 cells is known to 0.0016, and one of 0.05 among 7,776 to 0.0025; four of these.
    assert!((missing - 0.1).abs() < 0.0065, "{missing}");
    let usual = found["f1_hz"].iter().copied().filter(|f| !f.is_nan()).fold(BTreeMap::new(), |mut counts, f| {
        *counts.entry(f.to_bits()).or_insert(0) += 1;
        counts
    });
    // Without noise, every frequency that is no outlier is the same number.
    let (same, every) = (*usual.values().max().unwrap(), usual.values().sum::<usize>());
    let outliers = 1.0 - f64::from(u32::try_from(same).unwrap()) / every as f64;
    assert!((outliers - 0.05).abs() < 0.01, "{outliers}");
}

#[test]
fn the_rehearsal_can_be_posted_as_json_and_read_as_a_table() {
    let world = World::new();
    let flags =
        ["--covariate", "temperature_c=10,year=12", "--loss", "k2=8%@2026-01-02", "--days", "2", "--every", "6h"];
    let json: serde_json::Value =
        serde_json::from_str(&world.run(&[&["simulate", "tower.toml"], &flags[..], &["--json"]].concat())).unwrap();
    let measurements = json["measurements"].as_array().unwrap();
    assert_eq!(measurements.len(), 8);
    assert_eq!(measurements[1]["measured_at"], "2026-01-01T06:00:00Z");
    assert!(measurements[1]["covariates"]["temperature_c"].is_number(), "{json}");
    let table = columns(&world.run(&[&["simulate", "tower.toml"], &flags[..]].concat()));
    assert_eq!(table["f1_hz"][3].to_string(), measurements[3]["frequencies_hz"][0].to_string());
}
