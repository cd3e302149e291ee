//! Models of extended structures whose training starts from the weights of the parent.

use std::sync::LazyLock;

use modalwatch::baseline::extension::{ExtensionPlan, Progress};
use modalwatch::baseline::observation::{measure, Observation, DEFAULT_NOISE_RANGE};
use modalwatch::baseline::train::{train, Trained};
use modalwatch::baseline::warm::{Unlike, WarmStart};
use modalwatch::baseline::Baseline;
use modalwatch::flow::train::TrainSettings;
use modalwatch::flow::FlowSettings;
use modalwatch::measurement::CovariateKind;
use modalwatch::simulator::definition::{CovariateDefinition, EffectDefinition, StructureDefinition, TargetDefinition};
use modalwatch::simulator::law::LawKind;
use modalwatch::simulator::Simulator;
use modalwatch::stats;
use nalgebra::DMatrix;
use rand::Rng as _;

/// The structure `base` whose springs `springs` change linearly with a covariate, by `slope` per unit of 0 ± 20.
fn extended(base: &StructureDefinition, covariate: &str, springs: &[&str], slope: f64) -> StructureDefinition {
    let mut definition = base.clone();
    definition.covariates.push(CovariateDefinition {
        name: covariate.to_owned(),
        kind: CovariateKind::Number,
        unit: None,
        range: None,
    });
    definition.effects.push(EffectDefinition {
        name: format!("effect-of-{covariate}"),
        description: None,
        target: TargetDefinition::Springs(springs.iter().map(|&name| name.to_owned()).collect()),
        law: LawKind::Linear,
        covariate: Some(covariate.to_owned()),
        reference: 0.0,
        numbers: [("slope_per_unit".to_owned(), slope)].into(),
        covariance: vec![vec![(0.02 * slope).powi(2)]],
        seen: vec![-20.0, 0.0, 20.0],
    });
    definition
}

fn simulator(definition: &StructureDefinition) -> Simulator {
    Simulator::new(definition.clone()).unwrap()
}

/// One parameter and two modes.
pub const PAIR: &str = r#"
id = "pair"
modes = 2
measurement_noise = { relative = 0.003 }
mass = [{ name = "m1", kg = 1.0 }, { name = "m2", kg = 2.0 }]
spring = [
    { name = "k1", from = "ground", to = "m1" },
    { name = "k2", from = "m1", to = "m2", n_per_m = 20.0 },
]
parameter = [{ name = "k1", prior = { uniform = [5.0, 15.0] }, sets = { spring = "k1" } }]
"#;

/// A small flow, from which all others start: its calibration and theirs take a few seconds.
static PAIR_MODEL: LazyLock<Trained> = LazyLock::new(|| {
    let flow =
        FlowSettings { units: 1, width: 16, context_channels: 4, context_features: 8, ..FlowSettings::default() };
    let settings = TrainSettings { epochs: 4, seed: 5, ..TrainSettings::default() };
    train(&simulator(&pair()), 2_000, DEFAULT_NOISE_RANGE, &flow, &settings, |_| {}).unwrap()
});

fn pair() -> StructureDefinition {
    StructureDefinition::parse_toml(PAIR).unwrap()
}

/// A training whose steps are too small to change the weights.
fn standing_still(seed: u64) -> TrainSettings {
    TrainSettings { epochs: 1, learning_rate: 1e-30, seed, ..TrainSettings::default() }
}

/// Log-densities of parameters in the middle of the prior given simulated measurements, for each of the effect sizes, `[n]`.
fn log_densities(baseline: &Baseline, of: &Simulator, sizes: &[Vec<f64>]) -> Vec<f64> {
    let mut stream = stats::stream(9, "measurements");
    let parameters = of.space().as_slice();
    let (mut theta, mut observations) = (Vec::new(), Vec::new());
    for sizes in sizes {
        let unit: Vec<f64> = parameters.iter().map(|_| stream.random_range(0.35..0.65)).collect();
        let truth: Vec<f64> = parameters.iter().zip(&unit).map(|(p, u)| p.from_unit(*u)).collect();
        let exact = of.frequencies_hz(&truth).unwrap();
        let all = vec![Some(1.0); exact.len()];
        observations.push(Observation { effect_sizes: sizes.clone(), ..measure(of, &exact, &[], &all, &mut stream) });
        theta.extend(truth);
    }
    let theta = DMatrix::from_row_slice(sizes.len(), parameters.len(), &theta);
    baseline.log_density_unit_box(&theta, &observations).unwrap()
}

#[test]
fn an_extension_answers_as_its_parent_until_it_is_trained() {
    let parent: &Baseline = &PAIR_MODEL.baseline;
    let definition = extended(parent.simulator().definition(), "temperature_c", &["k2"], -0.004);
    let extension = simulator(&definition);
    let start = WarmStart::new(parent, &extension).unwrap();
    let trained = start.train(&extension, 256, &standing_still(2), |_| {}).unwrap();
    let count = 200;
    let known = log_densities(parent, parent.simulator(), &vec![Vec::new(); count]);
    let sizes: Vec<Vec<f64>> = (0..count).map(|row| vec![-0.08 + 0.16 * row as f64 / count as f64]).collect();
    // Whatever the size of the effect is, its weights are 0.
    let found = log_densities(&trained.baseline, parent.simulator(), &sizes);
    for (found, known) in found.iter().zip(&known) {
        // The weights are single precision; the tests of the flow compare to twelve digits in double precision.
        assert!((found - known).abs() < 1e-3, "{found}, parent {known}");
    }
    let (own, of_parent) = (trained.baseline.manifest(), parent.manifest());
    assert_eq!(own.training.parent.as_ref(), Some(parent.digest()));
    assert_eq!((&own.whitening, own.conditions.noise_range), (&of_parent.whitening, of_parent.conditions.noise_range));
    assert_eq!(own.conditions.training_box, of_parent.conditions.training_box);
    assert_eq!((own.architecture.channels, own.conditions.effects.len()), (of_parent.architecture.channels + 1, 1));
    assert_eq!(of_parent.training.parent, None);
}

#[test]
fn an_extension_of_an_extension_keeps_the_inputs_of_both() {
    let first = extended(&pair(), "temperature_c", &["k2"], -0.004);
    let parent = simulator(&first);
    let start = WarmStart::new(&PAIR_MODEL.baseline, &parent).unwrap();
    let settings = TrainSettings { learning_rate: 0.01, ..start.settings(2, 3) };
    let of_first = start.train(&parent, 2_000, &settings, |_| {}).unwrap();
    assert_eq!(start.size(), (2_000, 1), "a quarter of four epochs");

    // The second effect comes before the first one, whose number has changed a little.
    let mut definition = extended(&first, "load_t", &["k1", "k2"], 0.002);
    definition.effects.swap(0, 1);
    definition.effects[1].numbers.insert("slope_per_unit".to_owned(), -0.0041);
    let extension = simulator(&definition);
    let start = WarmStart::new(&of_first.baseline, &extension).unwrap();
    assert_eq!(start.size(), (2_000, 2), "as many as the training that itself started from another model");
    let of_second = start.train(&extension, 256, &standing_still(4), |_| {}).unwrap();
    let [new, kept] = of_second.baseline.manifest().conditions.effects[..] else { panic!("two effects are inputs") };
    let known = of_first.baseline.manifest().conditions.effects[0];
    assert_eq!((kept.column, kept.lowest, kept.highest), (1, known.lowest, known.highest));
    assert!(new.column == 0 && new.lowest < new.highest);
    let count = 100;
    let warm = |row: usize| -0.08 + 0.16 * row as f64 / count as f64;
    let of_parent: Vec<Vec<f64>> = (0..count).map(|row| vec![warm(row)]).collect();
    let of_child: Vec<Vec<f64>> = (0..count).map(|row| vec![0.01, warm(row)]).collect();
    let bare = simulator(&pair());
    let (known, found) =
        (log_densities(&of_first.baseline, &bare, &of_parent), log_densities(&of_second.baseline, &bare, &of_child));
    for (found, known) in found.iter().zip(&known) {
        assert!((found - known).abs() < 1e-3, "{found}, parent {known}");
    }
    // The first effect is no idle input.
    let other: Vec<Vec<f64>> = (0..count).map(|row| vec![0.01, -warm(row)]).collect();
    let turned = log_densities(&of_second.baseline, &bare, &other);
    assert!(turned.iter().zip(&found).any(|(a, b)| (a - b).abs() > 0.01));
}

#[test]
fn the_same_seed_and_parent_give_the_same_files_on_one_and_on_two_threads() {
    let extension = simulator(&extended(&pair(), "temperature_c", &["k2"], -0.004));
    let files = |threads: usize, seed: u64| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let start = WarmStart::new(&PAIR_MODEL.baseline, &extension).unwrap();
        let trained = pool.install(|| start.train(&extension, 600, &start.settings(2, seed), |_| {})).unwrap();
        (trained.manifest_json, trained.weights)
    };
    let one = files(1, 7);
    assert!(one == files(2, 7), "files differ between one and two threads");
    assert!(one.1 != files(1, 8).1, "another seed should give other weights");
}

#[test]
fn a_model_with_inputs_of_another_meaning_is_not_started_from_and_the_log_says_why() {
    let parent = &PAIR_MODEL.baseline;
    let refused = |text: &str| {
        let definition = StructureDefinition::parse_toml(text).unwrap();
        let simulator = simulator(&extended(&definition, "temperature_c", &["k2"], -0.004));
        (WarmStart::new(parent, &simulator).unwrap_err(), simulator)
    };
    let cases = [
        (PAIR.replace("parameter = [{ name = \"k1\"", "parameter = [{ name = \"base\""), "base"),
        (PAIR.replace("[5.0, 15.0]", "[5.0, 16.0]"), "trained for k1 from 4 to 16, and the structure needs"),
        (PAIR.replace("modes = 2", "modes = 1"), "2 modes, and the structure has 1"),
        (PAIR.replace("0.003", "0.004"), "other measurement noise"),
        (format!("mode_shapes = {{ points = [\"m1\", \"m2\"], noise = 0.01 }}\n{PAIR}"), "best fit"),
    ];
    for (text, message) in &cases {
        let (why, _) = refused(text);
        assert!(why.to_string().contains(message), "{why}");
    }
    let first = simulator(&extended(&pair(), "temperature_c", &["k2"], -0.004));
    let start = WarmStart::new(parent, &first).unwrap();
    let of_first = start.train(&first, 256, &standing_still(4), |_| {}).unwrap().baseline;
    let lost = simulator(&extended(&pair(), "load_t", &["k2"], -0.004));
    let why = WarmStart::new(&of_first, &lost).unwrap_err();
    assert_eq!(why, Unlike::Effect("effect-of-temperature_c".to_owned()));

    // The training then starts from random weights, with one line that says why.
    let said = |parent: Option<&Baseline>, from_scratch: bool, samples: usize, simulator: &Simulator| {
        let plan = ExtensionPlan { parent, from_scratch, samples: Some(samples), epochs: Some(1), seed: 1 };
        let mut lines = Vec::new();
        let trained = plan.train(simulator, &mut |progress| {
            if let Progress::Start(line) = progress {
                lines.push(line);
            }
        });
        let [line] = &lines[..] else { panic!("{lines:?}") };
        (line.clone(), trained.map(|trained| trained.baseline.manifest().training.parent.clone()))
    };
    let (line, from) = said(Some(parent), false, 200, &refused(&cases[3].0).1);
    assert!(line.contains("random weights") && line.contains("other measurement noise"), "{line}");
    assert_eq!(from.unwrap(), None);
    // With too few samples the training ends behind the line.
    let (line, none) = said(None, false, 50, &first);
    assert!(line.contains("random weights") && line.contains("no trained model") && none.is_err(), "{line}");
    let (line, none) = said(Some(parent), true, 50, &first);
    assert!(line.contains("random weights") && line.contains("as requested") && none.is_err(), "{line}");
    let (line, from) = said(Some(parent), false, 200, &first);
    assert!(line.contains(&parent.digest().to_string()) && line.contains("200 samples, 1 epochs"), "{line}");
    assert_eq!(from.unwrap().as_ref(), Some(parent.digest()));
}
