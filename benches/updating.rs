//! Reference methods compared with the trained flow on the same measurements of three masses on springs, without stated noise.
//!
//! `cargo bench --bench updating`; compare within one run.

use criterion::{criterion_group, criterion_main, Criterion, Throughput};
use modalwatch::baseline::library::Library;
use modalwatch::baseline::observation::Observation;
use modalwatch::quantity::StructureId;
use modalwatch::simulator::population::Population as Drawn;
use modalwatch::updating::sensitivity::{prior_lattice, update_all};
use modalwatch::updating::stochastic::{settings, simulated_for, Population};
use modalwatch::updating::tmcmc::Target as _;

const MEASUREMENTS: usize = 500;

fn updating(criterion: &mut Criterion) {
    // As in `main.rs`: our own pool on all cores, and one thread for candle.
    let _ = rayon::ThreadPoolBuilder::new().build_global();
    std::env::set_var("RAYON_NUM_THREADS", "1");
    let library = Library::open(None).expect("the shipped models");
    let id = StructureId::parse("three-dof").expect("an id");
    let baseline = library.get(&id).and_then(|entry| entry.baseline.clone()).expect("a shipped model");
    let simulator = baseline.simulator().clone();
    let moments = [("k1", 4.0, 0.3), ("k2", 5.0, 0.1), ("k3", 6.0, 0.2)].map(|(k, m, s)| (k.to_owned(), m, s));
    let population = Drawn::new(simulator.space(), &moments).expect("a population");
    let drawn = population.draw(&simulator, MEASUREMENTS, 1.0, 1).expect("measurements");
    let rows: Vec<Vec<f64>> = drawn.frequencies_hz.row_iter().map(|row| row.iter().copied().collect()).collect();

    let mut group = criterion.benchmark_group("500 measurements");
    group.throughput(Throughput::Elements(MEASUREMENTS as u64));
    let known: Vec<Vec<Option<f64>>> = rows.iter().map(|row| row.iter().copied().map(Some).collect()).collect();
    let lattice = prior_lattice(&simulator);
    group.bench_function("sensitivity updating", |b| {
        b.iter(|| update_all(&simulator, &known, &lattice).expect("a checked prior"));
    });
    let observations: Vec<Observation> = rows.iter().map(|row| Observation::complete(row)).collect();
    group.bench_function("trained flow, 10 samples each", |b| {
        b.iter(|| baseline.infer(&observations, 10, 1).expect("samples"));
    });
    let modes = [0, 1, 2];
    let target = Population::new(&simulator, &drawn.frequencies_hz, &modes, 1.0, simulated_for(MEASUREMENTS), 1)
        .expect("a distribution");
    group.bench_function("one evaluation of TMCMC's likelihood", |b| {
        b.iter(|| target.log_likelihood(&[4.0, 5.0, 6.0, 0.3, 0.1, 0.2]));
    });
    group.sample_size(10);
    group.bench_function("TMCMC, 1000 samples", |b| {
        b.iter(|| target.sample(&settings(1_000), 1, &|_| {}).expect("a posterior"));
    });
    group.finish();
}

criterion_group!(benches, updating);
criterion_main!(benches);
