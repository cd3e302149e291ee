//! The Z24 bridge by six descriptions: units, bodies, priors and the number of unknowns of a structure file must not decide whether its damage
//! is found.
//!
//! ```text
//!  cargo test --release --test science seasons::z24_descriptions -- --ignored --nocapture
//! ```
//!
//! References and assessments are those of the service, with trained models.

use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::fs;
use std::path::Path;

use modalwatch::alarm::AlarmSettings;
use modalwatch::assessment::{assess, Assessment, Context, Draws, Earlier, ReferenceBatches};
use modalwatch::baseline::conditions::NoiseRange;
use modalwatch::baseline::train::train;
use modalwatch::baseline::Baseline;
use modalwatch::damage::UndamagedReference;
use modalwatch::flow::train::TrainSettings;
use modalwatch::flow::FlowSettings;
use modalwatch::measurement::ModalMeasurement;
use modalwatch::process::change::Evidence;
use modalwatch::process::filter::Filter;
use modalwatch::process::lasting::LastingChange;
use modalwatch::process::reference::{Chain, ProcessPoint, ReferenceProcess};
use modalwatch::quantity::{Hertz, Timestamp};
use modalwatch::simulator::Simulator;
use rayon::prelude::*;

use super::estimates::{data, rows, Row};
use super::watch::{episodes, named};
use super::z24::{DAMAGED_FROM, ROWS};

/// First batch with damaged rows: 6 of its 24. It may alarm; those after it are damaged throughout.
const ONSET: usize = DAMAGED_FROM / ROWS;

/// A change that is certainly smaller raises no alarm, as the service has it by default.
const SMALLEST_PERCENT: f64 = 2.0;

/// Batches below the limits after which an alarm has ended.
const RECOVERY: usize = 3;

/// How the models are trained, as in the test over HTTP.
const SAMPLES: usize = 40_000;
const EPOCHS: usize = 40;
const NOISE_RANGE: NoiseRange = NoiseRange { lowest: 0.5, highest: 2.0 };

/// Frequencies of the four modes in mild weather.
const MODES_HZ: [f64; 4] = [4.0, 5.2, 10.15, 10.83];

/// Nominal stiffness of a spring, N/m.
const STIFFNESS: f64 = 1_000.0;

/// Two bodies in a row for the first and the third mode, and two for the second and the fourth, at the same frequencies.
const COUPLED: &str = r#"
id = "z24-coupled"
modes = 4
measurement_noise = { relative = 0.008 }
mass = [{ name = "a1", kg = 0.6239 }, { name = "a2", kg = 0.58122 }, { name = "b1", kg = 0.44979 }, { name = "b2", kg = 0.25316 }]
spring = [
    { name = "ei", from = "ground", to = "a1", n_per_m = 1000.0 },
    { name = "gj_a", from = "a1", to = "a2", n_per_m = 931.59 },
    { name = "pier", from = "ground", to = "b1", n_per_m = 1000.0 },
    { name = "gj_b", from = "b1", to = "b2", n_per_m = 562.84 },
]
parameter = [
    { name = "ei", scale = true, prior = { uniform = [0.4, 1.6] }, sets = [{ spring = "ei" }] },
    { name = "pier", scale = true, prior = { uniform = [0.4, 1.6] }, sets = [{ spring = "pier" }] },
    { name = "gj", scale = true, prior = { uniform = [0.4, 1.6] }, sets = [{ spring = "gj_a" }, { spring = "gj_b" }] },
]
"#;

/// What is done with a row in which one peak was taken for the third and the fourth mode.
#[derive(Clone, Copy)]
enum OnePeak {
    /// The row is left out where the fourth mode is not above the third.
    LeavesOutRow,
    /// The fourth mode is left out where it is at most 1.002 times the third.
    LeavesOutMode,
}

/// A structure file: its name in the table, its text, and what is done with a row of one peak.
type Description = (&'static str, String, OnePeak);

/// What an unknown is: a factor of its springs, or their stiffness in N/m.
#[derive(Clone, Copy, PartialEq)]
enum Form {
    Factor,
    Stiffness,
}

/// A structure file with one body for each mode, which stands on a spring for each of its unknowns; on two for one that is listed twice.
/// `prior`: the range of each unknown as a share of the nominal stiffness.
fn file(id: &str, bodies: [&[&str]; 4], form: Form, prior: [f64; 2]) -> String {
    let (mut masses, mut springs, mut sets) = (Vec::new(), Vec::new(), BTreeMap::<&str, Vec<String>>::new());
    for (number, (unknowns, hz)) in (1..).zip(bodies.into_iter().zip(MODES_HZ)) {
        let kg = unknowns.len() as f64 * STIFFNESS / (TAU * hz).powi(2);
        masses.push(format!("{{ name = \"mode{number}\", kg = {kg:?} }}"));
        for unknown in unknowns {
            let name = format!("s{}", springs.len() + 1);
            springs.push(format!(
                "{{ name = \"{name}\", from = \"ground\", to = \"mode{number}\", n_per_m = {STIFFNESS:?} }}"
            ));
            sets.entry(*unknown).or_default().push(format!("{{ spring = \"{name}\" }}"));
        }
    }
    let is_factor = form == Form::Factor;
    let [low, high] = prior.map(|share| if is_factor { share } else { share * STIFFNESS });
    let parameter = |(name, sets): (&str, Vec<String>)| {
        let sets = sets.join(", ");
        format!("{{ name = \"{name}\", scale = {is_factor}, prior = {{ uniform = [{low:?}, {high:?}] }}, sets = [{sets}] }}")
    };
    let parameters: Vec<String> = sets.into_iter().map(parameter).collect();
    let (masses, springs, parameters) = (masses.join(", "), springs.join(", "), parameters.join(", "));
    format!(
        "id = \"{id}\"\nmodes = 4\nmeasurement_noise = {{ relative = 0.008 }}\n\
         mass = [{masses}]\nspring = [{springs}]\nparameter = [{parameters}]\n"
    )
}

/// The six descriptions. In none are two frequencies in proportion over the whole prior: a model cannot be trained for such a one.
fn descriptions() -> [Description; 6] {
    use Form::{Factor, Stiffness};
    use OnePeak::{LeavesOutMode, LeavesOutRow};
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/discrepancy/z24.toml");
    let girder_on_two: [&[&str]; 4] = [&["ei"], &["pier"], &["ei"], &["gj"]];
    let each: [&[&str]; 4] = [&["k1"], &["k2"], &["k3"], &["k4"]];
    let both: [&[&str]; 4] =
        [&["ei", "ei", "pier"], &["ei", "pier", "pier"], &["ei", "ei", "ei", "pier"], &["ei", "pier"]];
    let three_stiffnesses = file("z24-three-stiffnesses", girder_on_two, Stiffness, [0.7, 1.6]);
    let four_stiffnesses = file("z24-four-stiffnesses", each, Stiffness, [0.7, 1.3]);
    let two_factors = file("z24-two-factors", both, Factor, [0.7, 1.3]);
    let two_stiffnesses = file("z24-two-stiffnesses", both, Stiffness, [0.4, 1.6]);
    [
        ("z24.toml: three factors, two on each body", fs::read_to_string(shipped).unwrap(), LeavesOutRow),
        ("three in N/m, −30 to +60 %, ei on bodies 1 and 3", three_stiffnesses, LeavesOutMode),
        ("four in N/m, ±30 %, one on each body", four_stiffnesses, LeavesOutRow),
        ("two factors, ±30 %, both on each body", two_factors, LeavesOutRow),
        ("two in N/m, ±60 %, both on each body", two_stiffnesses, LeavesOutRow),
        ("three factors, ±60 %, bodies of two modes each", COUPLED.to_owned(), LeavesOutRow),
    ]
}

/// The trained model of a structure.
pub(super) fn trained(simulator: &Simulator) -> Baseline {
    let settings = TrainSettings { epochs: EPOCHS, ..TrainSettings::default() };
    train(simulator, SAMPLES, NOISE_RANGE, &FlowSettings::default(), &settings, |_| {}).unwrap().baseline
}

/// Batches of consecutive rows, with an hour for each row.
fn batches(csv: &str, one_peak: OnePeak) -> Vec<Vec<ModalMeasurement>> {
    let measurement = |row: &Row| {
        let [f3, f4] = [2, 3].map(|mode: usize| row.frequencies_hz[mode]);
        let is_one_peak = |ratio: f64| f3.zip(f4).is_some_and(|(f3, f4)| f4 <= ratio * f3);
        let left_out = match one_peak {
            OnePeak::LeavesOutRow if is_one_peak(1.0) => return None,
            OnePeak::LeavesOutMode if is_one_peak(1.002) => Some(3),
            _ => None,
        };
        let frequency = |(mode, hz): (usize, &Option<f64>)| {
            let hz = hz.filter(|_| left_out != Some(mode))?;
            Some(Hertz::new(hz).unwrap())
        };
        let micros = 879_202_800_000_000 + 3_600_000_000 * row.number as i64;
        Some(ModalMeasurement {
            measured_at: Timestamp::from_micros(micros).unwrap(),
            frequencies_hz: row.frequencies_hz.iter().enumerate().map(frequency).collect(),
            std_hz: None,
            mode_shapes: None,
            covariates: BTreeMap::new(),
            settings: BTreeMap::new(),
        })
    };
    rows(csv, 4).chunks(ROWS).map(|part| part.iter().filter_map(measurement).collect()).collect()
}

/// The assessments of the batches after a reference of `size` batches.
pub(super) fn assessed(
    baseline: &Baseline,
    undamaged: &UndamagedReference,
    batches: &[Vec<ModalMeasurement>],
    size: usize,
) -> Vec<Assessment> {
    let one = |number: usize| {
        let own = &batches[number];
        let before: Vec<&ModalMeasurement> = batches[..number].iter().flatten().collect();
        let first = before.len().saturating_sub(Earlier::compared_with(own.len()));
        let rows: Vec<Vec<Option<Hertz>>> = before[first..].iter().map(|m| m.frequencies_hz.clone()).collect();
        let earlier = Earlier { previous: rows.last().cloned(), rows };
        let context = Context { undamaged: Some(undamaged), earlier: Some(&earlier) };
        assess(baseline, own, context, Draws::with_seed(number as u64), own[0].measured_at).unwrap()
    };
    (size..batches.len()).into_par_iter().map(one).collect()
}

/// The points of assessed batches on the charts of a process; `None` for a batch that is rejected or held.
pub(super) fn points(
    process: &ReferenceProcess,
    assessed: &[Assessment],
    first: Timestamp,
) -> Vec<Option<ProcessPoint>> {
    let filter = Filter::of(&process.process);
    let mut chain = Chain::start(process, &filter, first).alarming_from(SMALLEST_PERCENT);
    assessed.iter().map(|own| chain.take(own.estimate.as_ref().filter(|_| own.trust.moves_charts())?)).collect()
}

/// Evidence or limits of the fast and of the slow chart.
fn words(evidence: Option<Evidence>) -> String {
    evidence.map_or_else(|| "none".to_owned(), |own| format!("{:.2}/{:.2}", own.fast, own.slow))
}

/// False alarms before the damage, and the first batch with an alarm from its onset on.
type Found = (usize, Option<usize>);

/// A reference of `size` batches and the batches after it, of which it prints a row of the table. The error says why there is no process.
fn study(name: &str, baseline: &Baseline, batches: &[Vec<ModalMeasurement>], size: usize) -> Result<Found, String> {
    let given = |number: usize| (batches[number].as_slice(), Draws::with_seed(number as u64));
    let given: Vec<(&[ModalMeasurement], Draws)> = (0..size).map(given).collect();
    let examined = ReferenceBatches::examine(baseline, &given).map_err(|error| error.to_string())?;
    let doubtful: Vec<usize> = examined.doubtful().iter().map(|own| own.batch).collect();
    let settings = AlarmSettings::default();
    let undamaged = examined.reference(0.05, &settings).map_err(|error| error.to_string())?;
    let process = undamaged.process.as_deref().ok_or_else(|| format!("{:?}", undamaged.without_process))?;
    let assessed = assessed(baseline, &undamaged, batches, size);
    let points = points(process, &assessed, batches[size][0].measured_at);
    let series = process.alarm_series().unwrap_or_default();
    let limits = process.limits_of(&series);
    let of_series = |point: Option<&ProcessPoint>| point?.of_series(process, &series);
    let evidence: Vec<Option<Evidence>> = points.iter().map(Option::as_ref).map(of_series).collect();
    let is_above = |own: Option<Evidence>| own.is_some_and(|own| own.fast > limits.fast || own.slow > limits.slow);
    let above: Vec<bool> = evidence.iter().copied().map(is_above).collect();
    let onset = ONSET - size;
    let false_alarms = episodes(&above[..onset], RECOVERY).len();
    let alarm = (onset..above.len()).find(|t| above[*t]).map(|t| size + t);
    let is_rejected = |number: &usize| !assessed[number - size].trust.accepted();
    let rejected: Vec<usize> = (size..batches.len()).filter(is_rejected).collect();
    let largest = |a: Evidence, b: Evidence| Evidence { fast: a.fast.max(b.fast), slow: a.slow.max(b.slow) };
    let before = evidence[..onset].iter().copied().flatten().reduce(largest);
    let with_damage: Vec<String> = evidence[onset..].iter().copied().map(words).collect();
    let change = points[onset..].iter().rev().flatten().find_map(|point| point.change.as_ref());
    println!(
        "| {name} | {size} | {} {doubtful:?} | {} {rejected:?} | {} factors, misfit {:.2?} | {false_alarms} | {alarm:?} | {} | {} | {} | {:?} |",
        doubtful.len(),
        rejected.len(),
        process.process.factors,
        process.usual_misfit,
        words(Some(limits)),
        words(before),
        with_damage.join(", "),
        named(change)
    );
    println!("  {}", change.map_or_else(String::new, LastingChange::sentence));
    for t in episodes(&above[..onset], RECOVERY) {
        let change = points[t].as_ref().and_then(|point| point.change.as_ref());
        println!("  false, batch {}: {}", size + t, change.map_or_else(String::new, LastingChange::sentence));
    }
    Ok((false_alarms, alarm))
}

/// Mean ratio of the fourth to the third frequency in the rows of a batch, without those of one peak.
fn ratio(batch: &[ModalMeasurement]) -> f64 {
    let of_row = |m: &ModalMeasurement| Some(m.frequencies_hz[3]?.get() / m.frequencies_hz[2]?.get());
    let all: Vec<f64> = batch.iter().filter_map(of_row).collect();
    all.iter().sum::<f64>() / all.len() as f64
}

#[test]
#[ignore = "six models are trained, three minutes; on measured data that are not part of the repository"]
fn the_settlement_of_the_z24_bridge_is_found_by_any_description() {
    let Some(csv) = data("z24-bridge/z24_frequencies.csv") else { return };
    for range in [109..134, 134..ONSET] {
        let all: Vec<f64> = batches(&csv, OnePeak::LeavesOutRow)[range.clone()].iter().map(|own| ratio(own)).collect();
        let (mean, low) = (all.iter().sum::<f64>() / all.len() as f64, all.iter().filter(|own| **own < 1.062).count());
        println!("f4/f3 of batches {range:?}: {mean:.3} on average, {low} of {} below 1.062", all.len());
    }
    println!("Damage from batch {ONSET} on. Evidence and limits: fast/slow chart of all quantities together.");
    println!(
        "| description | reference | batches left out of it | rejected after it | process | false alarms | alarm with batch | limits | \
         largest before | from batch {ONSET} on | certain, perhaps |"
    );
    let mut missed = Vec::new();
    for (name, toml, one_peak) in descriptions() {
        let simulator = Simulator::parse_toml(&toml).unwrap();
        let (baseline, batches) = (trained(&simulator), batches(&csv, one_peak));
        for size in [60, 84, 110] {
            let found = study(name, &baseline, &batches, size);
            if !matches!(found, Ok((0..=1, Some(_)))) {
                missed.push(format!("{name}, {size} batches: {found:?}"));
            }
        }
    }
    // Four damaged batches are few for the reference of 60 of one description.
    assert!(missed.len() <= 1, "{missed:#?}");
}
