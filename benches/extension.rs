//! Training the model of an extended structure from the weights of its parent, compared with training from random weights.
//!
//! ```text
//! cargo bench --bench extension [-- three-dof rig] [seeds=1,2] [epochs=20] [samples=200000] [rate=0.0015] [only=warm]
//! ```
//!
//! Each shipped structure is extended by a stiffness that depends on temperature, as `modalwatch extend` would do, with the uncertainty
//! of the coefficient. Both trainings have the defaults unless numbers are given, and the same seed. Times are processor time of this process
//! in user mode, from the simulation of the training set to the end of the calibration. The likelihoods are compared on the same simulated
//! measurements, which neither training has seen.

use std::sync::Arc;

use modalwatch::baseline::library::Library;
use modalwatch::baseline::train::{default_epochs, observe, train, Trained};
use modalwatch::baseline::warm::WarmStart;
use modalwatch::baseline::Baseline;
use modalwatch::flow::train::TrainSettings;
use modalwatch::flow::FlowSettings;
use modalwatch::measurement::CovariateKind;
use modalwatch::quantity::StructureId;
use modalwatch::simulator::definition::{CovariateDefinition, EffectDefinition, StructureDefinition, TargetDefinition};
use modalwatch::simulator::law::LawKind;
use modalwatch::simulator::Simulator;
use modalwatch::stats;

/// Number of simulated measurements on which the likelihoods are compared.
const HELD_OUT: usize = 10_000;

/// Ticks of the clock of /proc/self/stat per second, on every Linux.
const TICKS_PER_S: f64 = 100.0;

fn main() {
    // As in `main.rs`: candle uses one thread.
    let _ = rayon::ThreadPoolBuilder::new().build_global();
    std::env::set_var("RAYON_NUM_THREADS", "1");
    let given: Vec<String> = std::env::args().skip(1).filter(|word| !word.starts_with("--")).collect();
    let value = |key: &str| given.iter().find_map(|word| word.strip_prefix(key)?.strip_prefix('=').map(str::to_owned));
    let number = |key: &str| value(key).map(|text| text.parse::<f64>().expect("a number"));
    let seeds: Vec<u64> =
        value("seeds").map_or_else(|| vec![1, 2], |text| text.split(',').map(|s| s.parse().expect("a seed")).collect());
    let named: Vec<&str> = given.iter().filter(|word| !word.contains('=')).map(String::as_str).collect();
    let only = value("only");
    for id in if named.is_empty() { vec!["three-dof", "rig"] } else { named } {
        let parent = shipped(id);
        let simulator = Simulator::new(extended(&parent)).expect("the extension is a structure");
        for seed in &seeds {
            let start = WarmStart::new(&parent, &simulator).expect("the parent is like its extension");
            let (samples, epochs) = start.size();
            let samples = number("samples").map_or(samples, |n| n as usize);
            let mut settings = start.settings(number("epochs").map_or(epochs, |n| n as usize), *seed);
            settings.learning_rate = number("rate").unwrap_or(settings.learning_rate);
            let warm = (only.as_deref() != Some("scratch")).then(|| {
                let run = || start.train(&simulator, samples, &settings, |_| {});
                timed(&format!("{id}, seed {seed}, from its parent, {} epochs", settings.epochs), run)
            });
            let scratch = (only.as_deref() != Some("warm")).then(|| {
                let settings =
                    TrainSettings { epochs: default_epochs(&simulator), seed: *seed, ..TrainSettings::default() };
                let noise_range = parent.manifest().conditions.noise_range.expect("the shipped structures are noisy");
                let run = || train(&simulator, samples, noise_range, &FlowSettings::default(), &settings, |_| {});
                timed(&format!("{id}, seed {seed}, from scratch, {} epochs", settings.epochs), run)
            });
            if let (Some((warm, warm_s)), Some((scratch, scratch_s))) = (warm, scratch) {
                let losses = |trained: &Trained| held_out(&trained.baseline);
                let gains: Vec<f64> = losses(&scratch).iter().zip(losses(&warm)).map(|(s, w)| s - w).collect();
                let error = stats::sample_std(&gains).expect("there are many") / (gains.len() as f64).sqrt();
                println!(
                    "  processor time {:.2} of that from scratch; held-out log-likelihood higher by {:.3} ± {error:.3} nats",
                    warm_s / scratch_s,
                    stats::mean(&gains)
                );
            }
        }
    }
}

fn shipped(id: &str) -> Arc<Baseline> {
    let library = Library::open(None).expect("the shipped models are readable");
    let entry = library.get(&StructureId::parse(id).expect("an id")).expect("it is shipped");
    entry.baseline.clone().expect("its model is shipped")
}

/// A stiffness that is not a parameter falls by 0.4 % per °C, known to a fiftieth of that; in structures whose springs are all
/// parameters, the stiffness of the first.
fn extended(parent: &Baseline) -> StructureDefinition {
    let mut definition = parent.simulator().definition().clone();
    let set: Vec<&String> =
        definition.parameters.iter().flat_map(|p| &p.sets).filter_map(|s| s.spring.as_ref()).collect();
    let free = definition.springs.iter().map(|spring| &spring.name).find(|name| !set.contains(name));
    let spring = free.unwrap_or(&definition.springs[0].name).clone();
    let covariate = "temperature_c".to_owned();
    definition.parent = Some(parent.simulator().digest().to_string());
    definition.covariates.push(CovariateDefinition {
        name: covariate.clone(),
        kind: CovariateKind::Number,
        unit: None,
        range: None,
    });
    definition.effects.push(EffectDefinition {
        name: "temperature".to_owned(),
        description: None,
        target: TargetDefinition::Springs(vec![spring]),
        law: LawKind::Linear,
        covariate: Some(covariate),
        reference: 10.0,
        numbers: [("slope_per_unit".to_owned(), -0.004)].into(),
        covariance: vec![vec![8e-5_f64.powi(2)]],
        seen: vec![-10.0, 0.0, 10.0, 20.0, 30.0],
    });
    definition
}

/// Runs a training and prints what it took and gave; also returns its processor time, s.
fn timed(what: &str, run: impl FnOnce() -> Result<Trained, modalwatch::baseline::train::Error>) -> (Trained, f64) {
    let before = user_s();
    let trained = run().expect("it trains");
    let took = user_s() - before;
    let manifest = trained.baseline.manifest();
    let (validation, calibration) = (&manifest.validation, &manifest.calibration);
    println!(
        "{what}: {took:.1} s of processor time, held-out negative log-likelihood {:.3} ± {:.3} nats, best epoch {}, calibration {} in {} cells",
        validation.negative_log_likelihood,
        validation.negative_log_likelihood_error,
        manifest.training.best_epoch,
        if calibration.passed() { "passed".to_owned() } else { format!("FAILED ({})", calibration.failures.join("; ")) },
        calibration.cells.len()
    );
    (trained, took)
}

/// −ln q of simulated measurements, nats.
fn held_out(baseline: &Baseline) -> Vec<f64> {
    let simulator = baseline.simulator();
    let set = simulator.training_set(HELD_OUT, 987_654_321).expect("the prior holds no mechanism");
    let mut stream = stats::stream(987_654_321, "held out");
    let observations = observe(simulator, &baseline.manifest().conditions, &set, &mut stream);
    let densities = baseline.log_density_unit_box(&set.theta, &observations).expect("it infers");
    densities.into_iter().map(|log_q| -log_q).collect()
}

/// Processor time of this process in user mode, s.
fn user_s() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").expect("Linux");
    // The name of the program, in parentheses, may contain spaces. User time is the 14th field, the 12th after the name.
    let after_name = stat.rsplit_once(')').expect("a name in parentheses").1;
    let ticks: f64 =
        after_name.split_whitespace().nth(11).and_then(|text| text.parse().ok()).expect("a number of ticks");
    ticks / TICKS_PER_S
}
