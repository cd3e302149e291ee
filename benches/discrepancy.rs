//! Time of a diagnosis against the number of rows and of candidates.
//!
//! `cargo bench --bench discrepancy`

use std::hint::black_box;

use criterion::{criterion_group, criterion_main, BenchmarkId, Criterion};
use modalwatch::discrepancy::data::Data;
use modalwatch::discrepancy::{diagnose, Holdout};
use modalwatch::measurement::{CovariateValue, ModalMeasurement};
use modalwatch::quantity::{Hertz, Timestamp};
use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::Simulator;
use modalwatch::stats;
use rand::Rng as _;
use rand_distr::StandardNormal;

/// A chain with ties to the ground; the first two springs are unknown.
fn simulator(masses: usize) -> Simulator {
    let mass = |i: usize| format!("{{ name = \"m{i}\", kg = {} }}", 1.0 + 0.1 * i as f64);
    let tie = |i: usize| format!("{{ name = \"g{i}\", from = \"ground\", to = \"m{i}\", n_per_m = {} }}", 300 + 70 * i);
    let link =
        |i: usize| format!("{{ name = \"c{i}\", from = \"m{i}\", to = \"m{}\", n_per_m = {} }}", i + 1, 900 + 50 * i);
    let unknown = |name: &str, low: f64, high: f64| {
        format!("{{ name = \"{name}\", prior = {{ uniform = [{low}, {high}] }}, sets = {{ spring = \"{name}\" }} }}")
    };
    let text = format!(
        "id = \"bench\"\nmodes = {masses}\nmeasurement_noise = {{ relative = 0.002 }}\nmass = [{}]\nspring = [{}, {}]\nparameter = [{}, {}]\n",
        (0..masses).map(mass).collect::<Vec<_>>().join(", "),
        (0..masses).map(tie).collect::<Vec<_>>().join(", "),
        (0..masses - 1).map(link).collect::<Vec<_>>().join(", "),
        unknown("g0", 150.0, 450.0),
        unknown("c0", 450.0, 1350.0),
    );
    Simulator::new(StructureDefinition::parse_toml(&text).expect("a structure")).expect("a structure")
}

/// Rows of one year in which the last tie softens with temperature.
fn data(simulator: &Simulator, rows: usize) -> Data {
    let mut stream = stats::stream(1, "benchmark of diagnosis");
    let last = simulator.modes() - 1;
    let measurement = |row: usize| {
        let mut normal = || stream.sample::<f64, _>(StandardNormal);
        let day = 365.0 * row as f64 / rows as f64;
        let celsius = 10.0 - 12.0 * (std::f64::consts::TAU * day / 365.0).cos() + 3.0 * normal();
        let theta = [300.0 * (1.0 + 0.01 * normal()), 900.0 * (1.0 + 0.01 * normal())];
        let target = modalwatch::physics::effect::Target::Springs(vec![last]);
        let exact = simulator.respond(&theta, last + 1, &[target], &[-0.004 * (celsius - 10.0)]).expect("frequencies");
        let hertz = |f: &f64| Hertz::new(f * (1.0 + 0.002 * normal())).ok();
        let operator = ["A", "B", "C"][row % 3].to_owned();
        ModalMeasurement {
            frequencies_hz: exact.frequencies_hz.iter().map(hertz).collect(),
            measured_at: Timestamp::from_micros((day * 86_400e6) as i64).expect("a time"),
            std_hz: None,
            mode_shapes: None,
            covariates: [
                ("temperature_c".to_owned(), CovariateValue::Number(celsius)),
                ("humidity_percent".to_owned(), CovariateValue::Number(60.0 - celsius + 5.0 * normal())),
                ("operator".to_owned(), CovariateValue::Category(operator)),
            ]
            .into(),
            settings: [].into(),
        }
    };
    Data::new(simulator, &(0..rows).map(measurement).collect::<Vec<_>>())
}

fn diagnosis(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("diagnose, rows x modes");
    group.sample_size(10);
    for (rows, modes) in [(100, 4), (400, 4), (1_600, 4), (400, 8), (10_000, 5)] {
        let simulator = simulator(modes);
        let data = data(&simulator, rows);
        let run = || diagnose(&simulator, &data, &Holdout::Last(0.25), 1, &|_| {}).expect("a diagnosis");
        println!("{rows} x {modes}: {} candidates", run().diagnosis.candidates);
        group.bench_function(BenchmarkId::from_parameter(format!("{rows} x {modes}")), |bencher| {
            bencher.iter(|| black_box(run()));
        });
    }
    group.finish();
}

criterion_group!(benches, diagnosis);
criterion_main!(benches);
