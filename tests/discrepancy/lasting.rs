//! New damage must not become a cause, and not the condition in which the gain is measured: an ordinary tower under a year of weather, with
//! and without a loss of stiffness.

use std::fmt::Write as _;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use serde_json::Value;

use super::{answer, diagnose, in_parallel, list, refusal, world};

/// A tower of four storeys. Three stiffnesses are unknown, and the simulation does not depend on temperature.
const TOWER: &str = r#"
id = "tower"
modes = 4
measurement_noise = { relative = 0.002 }
mass = [{ name = "m1", kg = 40e3 }, { name = "m2", kg = 38e3 }, { name = "m3", kg = 36e3 }, { name = "m4", kg = 30e3 }]
spring = [
    { name = "k1", from = "ground", to = "m1", n_per_m = 30e6 },
    { name = "k2", from = "m1", to = "m2", n_per_m = 26e6 },
    { name = "k3", from = "m2", to = "m3", n_per_m = 24e6 },
    { name = "k4", from = "m3", to = "m4", n_per_m = 20e6 },
]
parameter = [
    { name = "k1", prior = { uniform = [20e6, 40e6] }, sets = { spring = "k1" } },
    { name = "k2", prior = { uniform = [18e6, 34e6] }, sets = { spring = "k2" } },
    { name = "k3", prior = { uniform = [16e6, 32e6] }, sets = { spring = "k3" } },
]
covariate = [{ name = "temperature_c" }]
"#;

const DAYS: usize = 360;

/// The day of the loss, from the first row: 2024-09-27.
const LOSS: usize = 270;
const LOSS_DATE: &str = "2024-09-27";

/// Relative change of k1 per °C.
const SOFTENING: f64 = -0.003;

/// A year of daily rows from 2024-01-01.
#[derive(Clone, Copy)]
struct Year {
    seed: u64,
    /// Day from which k2 has lost 8 %.
    loss: Option<usize>,
    /// Correlation of the scatter of the stiffnesses from day to day.
    persistence: f64,
}

impl Year {
    fn csv(self) -> String {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        let mut text = "measured_at,f1_hz,f2_hz,f3_hz,f4_hz,temperature_c\n".to_owned();
        let (mut weather, mut scatter) = (0.0, [0.0; 3]);
        for day in 0..DAYS {
            let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
            // Persistent deviations from the season, and of each stiffness from its mean.
            let follow = |state: f64, persistence: f64, new: f64| {
                persistence * state + (1.0 - persistence * persistence).sqrt() * new
            };
            weather = follow(weather, 0.8, normal());
            for state in &mut scatter {
                *state = follow(*state, self.persistence, normal());
            }
            let temperature = 10.0 - 10.0 * (std::f64::consts::TAU * (day as f64 - 20.0) / 365.0).cos() + 3.0 * weather;
            let left = if self.loss.is_some_and(|loss| day >= loss) { 0.92 } else { 1.0 };
            let k1 = 30e6 * (1.0 + SOFTENING * (temperature - 10.0)) * (1.0 + 0.004 * scatter[0]);
            let k2 = 26e6 * left * (1.0 + 0.004 * scatter[1]);
            let k3 = 24e6 * (1.0 + 0.004 * scatter[2]);
            let springs = [(None, 0, k1), (Some(0), 1, k2), (Some(1), 2, k3), (Some(2), 3, 20e6)];
            let exact = world::frequencies_hz(&[40e3, 38e3, 36e3, 30e3], &springs).unwrap();
            let _ = write!(text, "{}", world::rfc3339(world::EPOCH_2024_S + 86_400 * day as i64 + 43_200));
            for f in exact {
                let _ = write!(text, ",{:.6}", f * (1.0 + 0.002 * normal()));
            }
            let _ = writeln!(text, ",{temperature:.2}");
        }
        text
    }

    fn answer(self, options: &[&str]) -> Value {
        answer(TOWER, &self.csv(), options)
    }
}

/// Days from 2024-01-01 of a time in RFC 3339 of that year.
fn day_of(time: &Value) -> f64 {
    let text = time.as_str().unwrap();
    let number = |range: std::ops::Range<usize>| text[range].parse::<usize>().unwrap();
    assert_eq!(number(0..4), 2024, "{text}");
    let before: usize = [31, 29, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31][..number(5..7) - 1].iter().sum();
    (before + number(8..10) - 1) as f64 + number(11..13) as f64 / 24.0
}

fn percent(value: &Value) -> f64 {
    value["percent"].as_f64().unwrap()
}

fn text(value: &Value) -> &str {
    value.as_str().unwrap()
}

/// Everything that a person reads of an answer: the JSON, the text of the command line and the report.
fn all_texts(csv: &str, json: &Value) -> Vec<String> {
    let folder = tempfile::tempdir().unwrap();
    let report = folder.path().join("report.html");
    let said = diagnose(TOWER, csv, &["--report", report.to_str().unwrap()]);
    assert!(said.status.success(), "{}", String::from_utf8_lossy(&said.stderr));
    let html = std::fs::read_to_string(report).unwrap();
    vec![json.to_string(), String::from_utf8(said.stdout).unwrap(), html]
}

fn is_temperature_on_k1(cause: &Value) -> bool {
    cause["target"]["name"] == "k1" && cause["covariate"] == "temperature_c"
}

#[test]
fn damage_in_the_rows_held_out_is_named_and_not_used_for_the_gain() {
    let year = Year { seed: 2_201, loss: Some(LOSS), persistence: 0.3 };
    let answer = year.answer(&[]);
    println!("{}", text(&answer["summary"]));
    let change = &answer["lasting_change"];
    // Noon of the day of the loss is the first damaged row.
    let since = day_of(&change["since"]);
    assert!((since - LOSS as f64 - 0.5).abs() <= 3.0, "{change}");
    let [low, high] = [0, 1].map(|end| day_of(&change["since_interval90"][end]));
    assert!(low <= since && since <= high && high - low <= 10.0, "{change}");
    let stiffness = &change["stiffness"][0];
    assert_eq!(stiffness["name"], "k2", "{change}");
    assert!((percent(stiffness) + 8.0).abs() < 1.5, "{change}");
    assert_eq!(list(change, "modes").len(), 4);

    // The temperature is found from the rows before.
    assert_eq!(answer["verdict"], "cause");
    assert!(is_temperature_on_k1(&answer["causes"][0]), "{}", answer["causes"][0]);
    let slope = list(&answer["causes"][0], "parameters").iter().find(|p| p["name"] == "slope_per_unit").unwrap();
    assert!((slope["value"].as_f64().unwrap() - SOFTENING).abs() < 0.0005, "{slope}");

    // The gain is measured before the loss: there the prediction is right, after it the error would be above 1 %.
    let gain = &answer["gain"];
    assert_eq!(gain["method"], "held_out");
    let rows = |name: &str| answer[name].as_u64().unwrap();
    assert_eq!(rows("training_rows") + rows("holdout_rows") + rows("set_aside_rows"), DAYS as u64);
    assert!(rows("set_aside_rows") >= (DAYS - LOSS) as u64 && rows("holdout_rows") >= 40, "{answer}");
    let after = list(&gain["rms_error_percent"], "after");
    assert!(after.iter().all(|error| error.as_f64().unwrap() < 0.4), "{gain}");
    let coverage = gain["coverage90"]["after"].as_f64().unwrap();
    // 4 × 68 frequencies: a standard error of 0.018 without correlation; three of them with correlated scatter.
    assert!((0.82..=0.97).contains(&coverage), "{gain}");

    for said in all_texts(&year.csv(), &answer) {
        let lower = said.to_lowercase();
        assert!(lower.contains("since 27 september 2024") || lower.contains("since 26 september 2024"), "{said}");
        assert!(lower.contains("may be damage") && !lower.contains("healthy"), "{said}");
        for word in ["1000 undamaged", "p = ", "0.0e0", "nats", "PossibleDamage", "share per"] {
            // In the JSON, units are for programs.
            assert!(!said.contains(word) || (said.starts_with('{') && word == "share per"), "{word}: {said}");
        }
        for mode in 1..=4 {
            assert!(said.contains(&format!("mode {mode} from ")), "mode {mode}: {said}");
        }
        assert!(said.contains("of 4 modes are predicted clearly better"), "{said}");
    }
}

#[test]
fn a_change_among_the_rows_searched_is_said_and_no_other_cause_stands_for_it() {
    let loss = 130;
    let answer = Year { seed: 2_202, loss: Some(loss), persistence: 0.3 }.answer(&[]);
    println!("{}", text(&answer["summary"]));
    let near = |day: f64| (day - loss as f64).abs() <= 5.0;
    let as_change = answer["lasting_change"]["since"].is_string() && near(day_of(&answer["lasting_change"]["since"]));
    let step = |cause: &&Value| cause["class"] == "possible_damage" && cause["target"]["name"] == "k2";
    let time = |cause: &Value| {
        list(cause, "parameters").iter().find(|p| p["name"] == "time_days").and_then(|p| p["value"].as_f64())
    };
    let as_cause = list(&answer, "causes").iter().filter(step).any(|cause| time(cause).is_some_and(near));
    assert!(as_change || as_cause, "{}", answer["summary"]);
    let others = list(&answer, "causes").iter().filter(|cause| !step(cause));
    assert!(others.clone().all(is_temperature_on_k1), "{}", answer["summary"]);
    assert!(text(&answer["summary"]).contains("may be damage"), "{}", answer["summary"]);
}

#[test]
fn a_period_and_a_date_choose_the_rows() {
    let year = Year { seed: 2_203, loss: Some(LOSS), persistence: 0.0 };
    let csv = year.csv();
    // Before the loss nothing has changed.
    let before = answer(TOWER, &csv, &["--to", LOSS_DATE, "--holdout", "since:2024-08-01"]);
    assert_eq!(before["lasting_change"], Value::Null, "{before}");
    assert_eq!((&before["training_rows"], &before["holdout_rows"]), (&213.into(), &57.into()));
    assert!(is_temperature_on_k1(&before["causes"][0]));
    let notes = before["notes"].to_string();
    assert!(notes.contains("only the 270 of 360 rows before 2024-09-27T00:00:00Z are used"), "{notes}");
    // After it, neither.
    let after = answer(TOWER, &csv, &["--from", "2024-09-27T00:00:00Z"]);
    assert_eq!(after["training_rows"].as_u64().unwrap() + after["holdout_rows"].as_u64().unwrap(), 90);
    assert_eq!(after["lasting_change"], Value::Null, "{after}");

    let refused = refusal(TOWER, &csv, &["--from", "2024-09-27", "--to", "2024-01-01"]);
    assert!(refused.contains("--to 2024-01-01T00:00:00Z must be after --from 2024-09-27T00:00:00Z"), "{refused}");
    let refused = refusal(TOWER, &csv, &["--from", "27.9.2024"]);
    assert!(refused.contains("2025-08-07"), "{refused}");
    let refused = refusal(TOWER, &csv, &["--holdout", "since:yesterday"]);
    assert!(refused.contains("since:2025-08-07"), "{refused}");
    let untimed = csv.lines().map(|line| line.split_once(',').unwrap().1).collect::<Vec<_>>().join("\n");
    let refused = refusal(TOWER, &untimed, &["--from", "2024-09-27"]);
    assert!(refused.contains("--time names it"), "{refused}");
    let said = answer(TOWER, &untimed, &[]);
    assert!(
        said["notes"].to_string().contains("not tested for a lasting change in time: the rows have no times"),
        "{said}"
    );
}

/// Years in which a change was found, of `years` with this correlation from day to day and no loss, with their seeds.
fn false_findings(years: u64, persistence: f64) -> Vec<u64> {
    let seeds: Vec<u64> = (0..years).map(|number| 40_000 + 1_000 * (10.0 * persistence) as u64 + number).collect();
    let found = in_parallel(&seeds, |seed| {
        let answer = Year { seed: *seed, loss: None, persistence }.answer(&[]);
        let change = &answer["lasting_change"];
        if change.is_object() {
            println!("seed {seed}, persistence {persistence}: {}", answer["summary"]);
        }
        change.is_object()
    });
    seeds.into_iter().zip(found).filter(|(_, found)| *found).map(|(seed, _)| seed).collect()
}

#[test]
fn without_damage_a_change_is_found_as_rarely_as_stated() {
    let found = [(10, 0.0), (10, 0.7)].map(|(years, persistence)| false_findings(years, persistence));
    // At the stated 1 in 100, 20 years give 0.2 on average, and more than two with a probability of 0.1 %. None is the usual number:
    // there is no lower bound.
    assert!(found.iter().map(Vec::len).sum::<usize>() <= 2, "{found:?}");
}

/// The figures of the documentation; 8 minutes on two cores.
#[test]
#[ignore = "300 years"]
fn false_findings_of_three_hundred_years() {
    for persistence in [0.0, 0.7, 0.9] {
        let found = false_findings(100, persistence);
        println!("persistence {persistence}: a change in {} of 100 years without one", found.len());
        // 1 is expected at most; 5 or more of 100 have a probability of 0.3 %.
        assert!(found.len() <= 4, "{found:?}");
    }
}

/// A hanger between two hinges, 20 m long, whose tension and bending stiffness are unknown. `tension` is in units of π² EI/L².
const HANGER: &str = r#"
id = "hanger"
simulation = "beam"
modes = 5
measurement_noise = { relative = 0.001 }
node = [{ name = "deck", x_m = 0.0, support = "pinned" }, { name = "arch", x_m = 20.0, support = "pinned" }]
beam = [{ name = "bar", from = "deck", to = "arch", bending_stiffness_n_m2 = 1e5, mass_kg_per_m = 30.0, elements = 30 }]
parameter = [
    { name = "bending_stiffness", scale = true, prior = { uniform = [0.7, 1.3] }, sets = { beam = "bar" }, damage = "none" },
    { name = "tension", prior = { uniform = [0.5, 8.0] }, sets = { deviation = "axial_force" } },
]
covariate = [{ name = "temperature_c" }]
"#;

/// Frequencies of a hinged bar under tension in closed form, Hz: f_n = (nπ/L)² √(EI/m)/2π · √(1 + PL²/(n²π²EI)).
fn hanger_hz(share_of_ei: f64, tension: f64) -> [f64; 5] {
    let (ei, pi) = (1e5 * share_of_ei, std::f64::consts::PI);
    std::array::from_fn(|mode| {
        let n = (mode + 1) as f64;
        let bending = (n * pi / 20.0).powi(2) * (ei / 30.0).sqrt() / (2.0 * pi);
        bending * (1.0 + tension / (share_of_ei * n * n)).sqrt()
    })
}

/// 200 daily rows of the hanger, whose tension follows the temperature by −0.2 % per °C and has a share `left` of it from a day on.
fn hanger_csv(seed: u64, from_day: u32, left: f64) -> String {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut csv = "measured_at,f1_hz,f2_hz,f3_hz,f4_hz,f5_hz,temperature_c\n".to_owned();
    for day in 0..200 {
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        let temperature = 12.0 + 8.0 * (f64::from(day) / 9.0).sin() + 2.0 * normal();
        let left = if day < from_day { 1.0 } else { left };
        let tension = 4.0 * left * (1.0 - 0.002 * (temperature - 12.0)) * (1.0 + 0.003 * normal());
        let _ = write!(csv, "{}", world::rfc3339(world::EPOCH_2024_S + 86_400 * i64::from(day)));
        for f in hanger_hz(1.0 + 0.002 * normal(), tension) {
            let _ = write!(csv, ",{:.6}", f * (1.0 + 0.001 * normal()));
        }
        let _ = writeln!(csv, ",{temperature:.2}");
    }
    csv
}

#[test]
fn a_hanger_that_loses_tension_at_the_end_is_told_as_that_and_not_as_a_stiffness() {
    let found = answer(HANGER, &hanger_csv(3, 165, 0.92), &[]);
    let change = &found["lasting_change"];
    let named = &change["stiffness"];
    assert_eq!((list(change, "stiffness").len(), text(&named[0]["name"])), (1, "tension"), "{change}");
    assert_eq!(named[0]["is_stiffness"], false);
    // The step of the tension is known to some tenths of a per cent.
    assert!((percent(&named[0]) + 8.0).abs() < 1.0, "{named}");
    assert!((day_of(&change["since"]) - 165.0).abs() <= 3.0, "{change}");
    let sentence = text(&change["sentence"]);
    assert!(sentence.contains("this may be damage. It looks like a change of tension (−"), "{sentence}");
}

#[test]
fn a_hanger_that_loses_tension_among_the_rows_searched_has_possible_damage_of_the_parameter_tension() {
    // An end restraint has nearly the same frequencies: a loss of a fifth tells the two apart, one of 3 % does not.
    for (seed, left) in [(1, 0.8), (2, 0.97)] {
        let found = answer(HANGER, &hanger_csv(seed, 60, left), &[]);
        let damage: Vec<&Value> = list(&found, "causes").iter().filter(|c| c["class"] == "possible_damage").collect();
        let [cause] = damage.as_slice() else { panic!("{}", found["summary"]) };
        let number = |name: &str| list(cause, "parameters").iter().find(|p| p["name"] == name).unwrap();
        assert_eq!(number("time_days")["value"], 60.0, "{cause}");
        // 4 is the tension before, in the unit of the size.
        let size = number("size")["value"].as_f64().unwrap();
        assert!((size / (4.0 * (left - 1.0)) - 1.0).abs() < 0.1, "{cause}");
        if left < 0.9 {
            assert_eq!(
                (super::target(cause), cause["probability"].as_f64().unwrap() > 0.99),
                (("axial_force", "tension"), true)
            );
            let told = text(&found["summary"]);
            let end = " % from day 60 of the data on (probability above 0.999)";
            let percent = told.split("What may be damage: the parameter tension falls by ").nth(1).unwrap();
            assert!(
                percent.split(" ± ").next().unwrap().parse::<f64>().is_ok_and(|p| (p - 20.0).abs() < 0.5),
                "{told}"
            );
            assert!(percent.contains(end), "{told}");
        } else {
            let told = text(&found["summary"]);
            assert!(cause["probability"].as_f64().unwrap() < 0.9, "{cause}");
            assert!(
                told.contains("the parameter tension falls by") && told.contains("the restraint of the end supports"),
                "{told}"
            );
            assert!(told.contains(", or instead "), "{told}");
        }
    }
}
