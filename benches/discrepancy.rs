//! Time of a diagnosis against the number of rows and of candidates.
//!
//! `cargo bench --bench discrepancy`

use std::hint::black_box;

use criterion::{criterion_group, criterion_main, BenchmarkId, Criterion};
use modalwatch::discrepancy::data::Data;
use modalwatch::discrepancy::{diagnose, Holdout};
use modalwatch::measurement::{CovariateValue, ModalMeasurement};
use modalwatch::physics::modes;
use modalwatch::physics::shapes::shapes_at;
use modalwatch::quantity::{Hertz, Timestamp};
use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::Simulator;
use modalwatch::stats;
use rand::Rng as _;
use rand_distr::StandardNormal;

/// A chain with ties to the ground; the first two springs are unknown. With `shapes`, they are measured at every second mass.
fn simulator(masses: usize, shapes: bool) -> Simulator {
    let mass = |i: usize| format!("{{ name = \"m{i}\", kg = {} }}", 1.0 + 0.1 * i as f64);
    let tie = |i: usize| format!("{{ name = \"g{i}\", from = \"ground\", to = \"m{i}\", n_per_m = {} }}", 300 + 70 * i);
    let link =
        |i: usize| format!("{{ name = \"c{i}\", from = \"m{i}\", to = \"m{}\", n_per_m = {} }}", i + 1, 900 + 50 * i);
    let unknown = |name: &str, low: f64, high: f64| {
        format!("{{ name = \"{name}\", prior = {{ uniform = [{low}, {high}] }}, sets = {{ spring = \"{name}\" }} }}")
    };
    let points = points(masses).map(|i| format!("\"m{i}\"")).collect::<Vec<_>>().join(", ");
    let declared =
        if shapes { format!("mode_shapes = {{ points = [{points}], noise = 0.02 }}\n") } else { String::new() };
    let text = format!(
        "id = \"bench\"\nmodes = {masses}\nmeasurement_noise = {{ relative = 0.002 }}\n{declared}mass = [{}]\nspring = [{}, {}]\nparameter = [{}, {}]\n",
        (0..masses).map(mass).collect::<Vec<_>>().join(", "),
        (0..masses).map(tie).collect::<Vec<_>>().join(", "),
        (0..masses - 1).map(link).collect::<Vec<_>>().join(", "),
        unknown("g0", 150.0, 450.0),
        unknown("c0", 450.0, 1350.0),
    );
    Simulator::new(StructureDefinition::parse_toml(&text).expect("a structure")).expect("a structure")
}

/// The masses at which shapes are measured.
fn points(masses: usize) -> impl Iterator<Item = usize> {
    (0..masses).step_by(2)
}

/// Shapes with noise at the points of a structure whose last tie has changed by a share `change`, `[modes][points]`.
fn shapes(
    simulator: &Simulator,
    theta: [f64; 2],
    change: f64,
    normal: &mut impl FnMut() -> f64,
) -> Vec<Option<Vec<f64>>> {
    let nominal = simulator.structure().expect("a structure of masses and springs");
    let masses = nominal.masses().len();
    let last = nominal.springs()[masses - 1].n_per_m * (1.0 + change);
    let changes = [(0, theta[0]), (masses, theta[1]), (masses - 1, last)];
    let changed = nominal.with_stiffness(&changes).expect("positive stiffnesses");
    let points: Vec<usize> = points(masses).collect();
    let exact = shapes_at(&modes(&changed, simulator.modes()).expect("modes"), &points);
    let mut noisy = |x: &f64| x + simulator.shape_std() * normal();
    exact.column_iter().map(|shape| Some(shape.iter().map(&mut noisy).collect())).collect()
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
        let frequencies_hz = exact.frequencies_hz.iter().map(hertz).collect();
        let operator = ["A", "B", "C"][row % 3].to_owned();
        ModalMeasurement {
            frequencies_hz,
            measured_at: Timestamp::from_micros((day * 86_400e6) as i64).expect("a time"),
            std_hz: None,
            mode_shapes: (simulator.shape_points() > 0)
                .then(|| shapes(simulator, theta, -0.004 * (celsius - 10.0), &mut normal)),
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
    let cases =
        [(100, 4, false), (400, 4, false), (400, 4, true), (1_600, 4, false), (400, 8, false), (10_000, 5, false)];
    for (rows, modes, shapes) in cases {
        let simulator = simulator(modes, shapes);
        let data = data(&simulator, rows);
        let run = || diagnose(&simulator, &data, &Holdout::Last(0.25), 1, &|_| {}).expect("a diagnosis");
        let name = format!("{rows} x {modes}{}", if shapes { " with shapes" } else { "" });
        println!("{name}: {} candidates", run().diagnosis.candidates);
        group.bench_function(BenchmarkId::from_parameter(name), |bencher| {
            bencher.iter(|| black_box(run()));
        });
    }
    group.finish();
}

criterion_group!(benches, diagnosis);
criterion_main!(benches);
