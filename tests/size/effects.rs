//! Mode shapes of a structure under effects: laws, derivatives, posterior intervals of measurements from an independent simulation,
//! and the same over HTTP.

use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::sync::LazyLock;

use modalwatch::baseline::observation::DEFAULT_NOISE_RANGE;
use modalwatch::baseline::train::{train, Trained};
use modalwatch::baseline::Baseline;
use modalwatch::flow::train::TrainSettings;
use modalwatch::flow::FlowSettings;
use modalwatch::measurement::{CovariateValue, ModalMeasurement};
use modalwatch::physics::effect::{respond, Target};
use modalwatch::physics::shaped::respond_shaped;
use modalwatch::physics::shapes::shapes_at;
use modalwatch::physics::{modes, Node, Structure};
use modalwatch::quantity::{Hertz, Timestamp};
use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::Simulator;
use modalwatch::stats::{self, quantile, squared_cosine, Stream};
use nalgebra::{DMatrix, SymmetricEigen};
use rand::Rng as _;
use rand_distr::StandardNormal;
use serde_json::{json, Value};

use crate::helpers::{command, time, Service};
use crate::size::{chain, random_stiffnesses};

/// A chain of four masses of 1 kg. k4 is known at the reference temperature and softens when it is warm; the second instrument reads
/// mode 2 too high.
const FILE: &str = r#"
id = "warm-chain"
modes = 3
measurement_noise = { relative = 0.002 }
mode_shapes = { points = ["m1", "m2", "m4"], noise = 0.01 }
mass = [{ name = "m1", kg = 1.0 }, { name = "m2", kg = 1.0 }, { name = "m3", kg = 1.0 }, { name = "m4", kg = 1.0 }]
spring = [
    { name = "k1", from = "ground", to = "m1" },
    { name = "k2", from = "m1", to = "m2" },
    { name = "k3", from = "m2", to = "m3" },
    { name = "k4", from = "m3", to = "m4", n_per_m = 1000.0 },
]
parameter = [
    { name = "k1", prior = { uniform = [700.0, 1300.0] }, sets = { spring = "k1" } },
    { name = "k2", prior = { uniform = [700.0, 1300.0] }, sets = { spring = "k2" } },
    { name = "k3", prior = { uniform = [700.0, 1300.0] }, sets = { spring = "k3" } },
]
covariate = [{ name = "temperature_c" }, { name = "instrument", kind = "category" }]

[[effect]]
name = "warm"
target = { springs = ["k4"] }
law = "linear"
covariate = "temperature_c"
reference = 10.0
numbers = { slope_per_unit = -0.012 }
covariance = [[4e-8]]
seen = [-10.0, 0.0, 10.0, 20.0, 30.0]

[[effect]]
name = "second-instrument"
target = { frequency_scale = 2 }
law = "category"
covariate = "instrument"
numbers = { B = 0.02 }
covariance = [[1e-8]]
"#;

/// Means and standard deviations of the numbers above, for the independent simulation.
const SLOPE: [f64; 2] = [-0.012, 2e-4];
const SCALE_B: [f64; 2] = [0.02, 1e-4];

fn simulator() -> Simulator {
    Simulator::new(StructureDefinition::parse_toml(FILE).unwrap()).unwrap()
}

/// A model of this chain: some ten seconds of training.
static TRAINED: LazyLock<Trained> = LazyLock::new(|| {
    let settings = TrainSettings { epochs: 8, ..TrainSettings::default() };
    train(&simulator(), 40_000, DEFAULT_NOISE_RANGE, &FlowSettings::default(), &settings, |_| {}).unwrap()
});

/// One simulated measurement.
struct Measured {
    k: [f64; 3],
    frequencies_hz: Vec<f64>,
    shapes: Vec<Vec<f64>>,
    temperature_c: f64,
    instrument: &'static str,
}

/// Simulates a measurement without any code of the program: K φ = λ φ with unit masses.
fn measured(rng: &mut Stream) -> Measured {
    let k = [0; 3].map(|_| rng.random_range(700.0..1300.0));
    let temperature_c = rng.random_range(-10.0..30.0);
    let instrument = if rng.random::<bool>() { "A" } else { "B" };
    let mut normal = || rng.sample::<f64, _>(StandardNormal);
    let k4 = 1000.0 * (1.0 + (SLOPE[0] + SLOPE[1] * normal()) * (temperature_c - 10.0));
    let scale = if instrument == "B" { 1.0 + SCALE_B[0] + SCALE_B[1] * normal() } else { 1.0 };
    let mut stiffness = DMatrix::<f64>::zeros(4, 4);
    for (i, k) in [k[0], k[1], k[2], k4].into_iter().enumerate() {
        stiffness[(i, i)] += k;
        if i > 0 {
            stiffness[(i - 1, i - 1)] += k;
            stiffness[(i - 1, i)] -= k;
            stiffness[(i, i - 1)] -= k;
        }
    }
    let eigen = SymmetricEigen::new(stiffness);
    let mut order: Vec<usize> = (0..4).collect();
    order.sort_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]));
    let (mut frequencies_hz, mut shapes) = (Vec::new(), Vec::new());
    for (mode, column) in order.into_iter().take(3).enumerate() {
        let exact_hz = eigen.eigenvalues[column].sqrt() / TAU * if mode == 1 { scale } else { 1.0 };
        frequencies_hz.push(exact_hz * (1.0 + 0.002 * normal()));
        let at_points = [0, 1, 3].map(|point| eigen.eigenvectors[(point, column)]);
        let rms = (at_points.iter().map(|x| x * x).sum::<f64>() / 3.0).sqrt();
        // Any norm and sign.
        shapes.push(at_points.iter().map(|x| -1.7 * (x + 0.01 * rms * normal())).collect());
    }
    Measured { k, frequencies_hz, shapes, temperature_c, instrument }
}

impl Measured {
    fn measurement(&self) -> ModalMeasurement {
        ModalMeasurement {
            measured_at: Timestamp::from_micros(0).unwrap(),
            frequencies_hz: self.frequencies_hz.iter().map(|f| Some(Hertz::new(*f).unwrap())).collect(),
            std_hz: None,
            mode_shapes: Some(self.shapes.iter().cloned().map(Some).collect()),
            covariates: BTreeMap::from([
                ("temperature_c".to_owned(), CovariateValue::Number(self.temperature_c)),
                ("instrument".to_owned(), CovariateValue::Category(self.instrument.to_owned())),
            ]),
            settings: BTreeMap::new(),
        }
    }

    fn json(&self, seconds: usize) -> Value {
        json!({
            "measured_at": time(seconds), "frequencies_hz": self.frequencies_hz, "mode_shapes": self.shapes,
            "covariates": { "temperature_c": self.temperature_c, "instrument": self.instrument },
        })
    }
}

/// How the posterior samples agree with the true stiffnesses.
struct Accuracy {
    /// Share of the true values inside the 90 % intervals, for each stiffness.
    inside: [f64; 3],
    /// Mean width of these intervals, N/m.
    width: f64,
    /// Mean absolute error of the posterior mean, N/m.
    error: f64,
}

/// Accuracy over `worlds` as the `measurements` describe them.
fn accuracy(baseline: &Baseline, worlds: &[Measured], measurements: &[ModalMeasurement]) -> Accuracy {
    const DRAWS: usize = 400;
    let observations: Vec<_> = measurements.iter().map(|m| baseline.admit(m).observation.unwrap()).collect();
    let samples = baseline.infer(&observations, DRAWS, 3).unwrap();
    let (mut inside, mut width, mut error) = ([0.0; 3], 0.0, 0.0);
    for (column, inside) in inside.iter_mut().enumerate() {
        for (draws, world) in samples.column(column).chunks_exact(DRAWS).zip(worlds) {
            let (low, high) = (quantile(draws, 0.05), quantile(draws, 0.95));
            *inside += f64::from(u8::from((low..=high).contains(&world.k[column]))) / worlds.len() as f64;
            width += (high - low) / (3 * worlds.len()) as f64;
            error += (stats::mean(draws) - world.k[column]).abs() / (3 * worlds.len()) as f64;
        }
    }
    Accuracy { inside, width, error }
}

#[test]
fn intervals_cover_the_stiffnesses_of_an_independent_simulation_with_shapes_and_effects() {
    let mut rng = stats::stream(11, "worlds");
    let worlds: Vec<Measured> = (0..1_000).map(|_| measured(&mut rng)).collect();
    let given: Vec<ModalMeasurement> = worlds.iter().map(Measured::measurement).collect();
    let Accuracy { inside, width, error } = accuracy(&TRAINED.baseline, &worlds, &given);
    println!("coverage of 90 % intervals {inside:.3?}, mean width {width:.1} N/m, mean error {error:.1} N/m");
    for share in inside {
        // The standard error of a share of 1,000 is 0.0095; four of them. The training is short, and its coverage is not exact.
        assert!((share - 0.9).abs() < 0.038, "{inside:?}");
    }
    // With the covariates of another measurement the estimates are worse. The misfit widens the intervals, so that they still cover.
    let mut exchanged = given.clone();
    for (own, other) in exchanged.iter_mut().zip(given.iter().rev()) {
        own.covariates.clone_from(&other.covariates);
    }
    let wrong = accuracy(&TRAINED.baseline, &worlds, &exchanged);
    println!(
        "covariates exchanged: coverage {:.3?}, mean width {:.1} N/m, mean error {:.1} N/m",
        wrong.inside, wrong.width, wrong.error
    );
    assert!(wrong.error > 1.5 * error && wrong.width > 1.5 * width, "{}, {}", wrong.error, wrong.width);
    // Without shapes the intervals are wider.
    let mut blind = given.clone();
    for measurement in &mut blind {
        measurement.mode_shapes = None;
    }
    let wider = accuracy(&TRAINED.baseline, &worlds, &blind).width;
    println!("mean width without shapes {wider:.1} N/m");
    assert!(wider > 1.2 * width, "{wider} without shapes, {width} with them");
    // Without covariates the posterior is the mean over their possible values.
    let mut unknown = given[..100].to_vec();
    for measurement in &mut unknown {
        measurement.covariates.clear();
    }
    let Accuracy { inside: mixed, width: widest, .. } = accuracy(&TRAINED.baseline, &worlds[..100], &unknown);
    println!("without covariates: {mixed:.3?}, mean width {widest:.1} N/m");
    assert!(widest > 1.2 * width, "{widest} without covariates, {width} with them");
    // Standard error 0.03. Covariates of the worlds are uniform, and so are those that the mean goes over.
    assert!(mixed.iter().all(|share| *share > 0.78), "{mixed:?}");
}

#[test]
fn the_sizes_of_effects_are_conditions_beside_the_fit() {
    let manifest = TRAINED.baseline.manifest();
    assert!(manifest.conditions.starts_at_fit);
    assert_eq!(manifest.conditions.effects.len(), 2);
    // Position and standard deviation of three parameters, the misfit, and two sizes.
    assert_eq!(manifest.architecture.fixed_context, 2 * 3 + 1 + 2);
}

#[test]
fn shapes_under_effects_are_those_of_the_changed_structure() {
    let base = chain(&random_stiffnesses(6, 8));
    let points = [0, 2, 5];
    let shapes_of = |structure: &Structure| shapes_at(&modes(structure, 4).unwrap(), &points);
    let under =
        |targets: &[Target], sizes: &[f64]| respond_shaped(&base, 4, (targets, sizes), &points, (&[], 0)).unwrap();
    let alike = |a: &DMatrix<f64>, b: &DMatrix<f64>| {
        a.shape() == b.shape()
            && a.column_iter().zip(b.column_iter()).all(|(a, b)| {
                let (a, b): (Vec<f64>, Vec<f64>) = (a.iter().copied().collect(), b.iter().copied().collect());
                squared_cosine(&a, &b) > 1.0 - 1e-10
            })
    };
    let softer = base.with_stiffness(&[(2, 0.7 * base.springs()[2].n_per_m)]).unwrap();
    let found = under(&[Target::Springs(vec![2])], &[-0.3]);
    assert!(alike(&found.shapes, &shapes_of(&softer)));
    assert!(!alike(&found.shapes, &shapes_of(&base)));
    let expected = respond(&base, 4, &[Target::Springs(vec![2])], &[-0.3]).unwrap().frequencies_hz;
    assert_eq!(found.response.frequencies_hz, expected);
    // The instrument changes frequencies, not shapes.
    assert!(alike(&under(&[Target::FrequencyScale(None)], &[0.1]).shapes, &shapes_of(&base)));
    // Twice the mass everywhere changes no shape, twice the mass of one body does.
    assert!(alike(&under(&[Target::Masses((0..6).collect())], &[1.0]).shapes, &shapes_of(&base)));
    assert!(!alike(&under(&[Target::Masses(vec![5])], &[1.0]).shapes, &shapes_of(&base)));
    // A mode that was not identified; a list that is too short goes on with the other modes.
    let reordered = under(&[Target::ModeOrder(vec![0, 2])], &[]);
    assert!(alike(&reordered.shapes, &shapes_of(&base).select_columns(&[0, 2, 1, 3])));
    // A rigid tie to the ground stops the point.
    let tied = under(&[Target::AddedSpring(Node::Ground, Node::Dof(5))], &[1e9]);
    assert!(tied.shapes.row(2).amax() < 1e-4);
}

#[test]
fn derivatives_under_effects_are_those_of_differences() {
    let text = FILE.replace("target = { frequency_scale = 2 }", "target = { parameter = \"k2\" }");
    for text in [FILE, text.as_str()] {
        let base = Simulator::new(StructureDefinition::parse_toml(text).unwrap()).unwrap();
        let simulator = base.under(&[-0.2, 0.15]);
        let theta = [900.0, 1_100.0, 800.0];
        let count = simulator.modes_to_pair();
        let here = simulator.linearise(&theta, count, true).unwrap();
        assert_eq!(here.frequencies_hz.len(), count);
        for column in 0..3 {
            let step = 1e-2;
            let moved = |sign: f64| {
                let mut there = theta;
                there[column] += sign * step;
                let mut found = simulator.linearise(&there, count, true).unwrap();
                for (mut shape, own) in found.shapes.column_iter_mut().zip(here.shapes.column_iter()) {
                    let sign = shape.dot(&own).signum();
                    shape *= sign;
                }
                found
            };
            let (up, down) = (moved(1.0), moved(-1.0));
            for mode in 0..count {
                let slope = (up.frequencies_hz[mode] - down.frequencies_hz[mode]) / (2.0 * step);
                assert!((slope - here.frequency_slopes[(mode, column)]).abs() < 1e-8, "mode {mode}, {column}");
                let slopes = (up.shapes.column(mode) - down.shapes.column(mode)) / (2.0 * step);
                assert!((slopes - here.shape_slopes[mode].column(column)).amax() < 1e-8, "mode {mode}, {column}");
            }
        }
        // The training samples are the modes of the simulator under the effects drawn for each of them.
        let without = base.without_effects();
        let set = base.training_set(20, 4).unwrap();
        for row in 0..20 {
            let theta: Vec<f64> = set.theta.row(row).iter().copied().collect();
            assert_eq!(set.shapes[row].shape(), (3, 3));
            let (bare_hz, bare) = without.frequencies_and_shapes(&theta).unwrap();
            let changed = (0..3).any(|mode| {
                (bare_hz[mode] / set.frequencies_hz[(row, mode)] - 1.0).abs() > 1e-6
                    || squared_cosine(bare.column(mode).as_slice(), set.shapes[row].column(mode).as_slice())
                        < 1.0 - 1e-9
            });
            assert!(changed || set.effect_sizes[row].iter().all(|size| size.abs() < 1e-4), "row {row}");
        }
    }
}

#[tokio::test]
async fn a_batch_with_shapes_and_covariates_is_assessed_over_http() {
    let folder = tempfile::tempdir().unwrap();
    let models = folder.path().join("models/warm-chain");
    std::fs::create_dir_all(&models).unwrap();
    std::fs::write(models.join("structure.toml"), FILE).unwrap();
    std::fs::write(models.join("baseline.json"), &TRAINED.manifest_json).unwrap();
    std::fs::write(models.join("baseline.safetensors"), &TRAINED.weights).unwrap();
    let mut command = command(&folder.path().join("data"));
    command.arg("--models").arg(folder.path().join("models"));
    // The calibration of a short training is not what is tested here.
    command.env("MODALWATCH__MONITOR__ACCEPT_UNCALIBRATED", format!("[\"{}\"]", TRAINED.baseline.digest()));
    let service = Service::spawn(&mut command);

    let mut rng = stats::stream(12, "worlds");
    let world = measured(&mut rng);
    let answer = service.post_batch("warm-chain", &[world.json(0)]).await;
    assert_eq!(answer["state"], "assessed", "{answer}");
    let batch = answer["batch"].as_str().unwrap();
    let kept = service.read(&format!("/v1/structures/warm-chain/batches/{batch}")).await;
    assert!(!kept.to_string().contains("covariate_missing"), "{kept}");

    // Without the covariates, the answer has a finding about them.
    let mut blind = measured(&mut rng).json(60);
    blind["covariates"] = json!({});
    let answer = service.post_batch("warm-chain", &[blind]).await;
    assert_eq!(answer["state"], "assessed", "{answer}");
    assert!(answer.to_string().contains("covariate_missing"), "{answer}");

    // With the covariates of the hottest day, a cold measurement does not fit the simulation.
    let mut wrong = Vec::new();
    while wrong.len() < 5 {
        let cold = measured(&mut rng);
        if cold.temperature_c < -5.0 {
            let mut body = cold.json(3_600 + 60 * wrong.len());
            body["covariates"]["temperature_c"] = json!(30.0);
            wrong.push(body);
        }
    }
    let answer = service.post_batch("warm-chain", &wrong).await;
    assert_eq!(answer["assessment"]["trust"], "rejected", "{answer}");
}
