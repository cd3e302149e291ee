//! Training and inference of the shipped `three-dof`, in process, on one thread. `cargo bench --bench flow`

use std::hint::black_box;

use criterion::{criterion_group, criterion_main, Criterion};
use modalwatch::baseline::library::Library;
use modalwatch::baseline::observation::{Observation, DEFAULT_NOISE_RANGE};
use modalwatch::baseline::train::train;
use modalwatch::flow::train::TrainSettings;
use modalwatch::flow::FlowSettings;
use modalwatch::hierarchy::populations;
use modalwatch::quantity::StructureId;

/// Rows of ten steps of 256.
const TEN_STEPS: usize = 2_560;

fn flow(criterion: &mut Criterion) {
    // As the program does at its start: candle on one thread, see `main.rs`.
    std::env::set_var("RAYON_NUM_THREADS", "1");
    let library = Library::open(None).expect("no folder is read");
    let id = StructureId::parse("three-dof").expect("it is an id");
    let baseline = library.get(&id).and_then(|e| e.baseline.clone()).expect("it is shipped");
    let set = baseline.simulator().training_set(50, 1).expect("the prior holds no mechanism");
    let complete = |row: usize| Observation::complete(&set.frequencies_hz.row(row).iter().copied().collect::<Vec<_>>());
    let rows: Vec<Observation> = (0..50).map(complete).collect();
    criterion.bench_function("inference of 50 measurements x 10 draws", |bencher| {
        bencher.iter(|| baseline.infer(black_box(&rows), 10, 1).expect("the shipped baseline infers"));
    });

    let samples = baseline.infer(&rows, 64, 1).expect("the shipped baseline infers");
    criterion.bench_function("population behind 50 measurements x 64 draws", |bencher| {
        bencher.iter(|| populations(black_box(&samples), None, baseline.space(), 1));
    });

    let mut training = criterion.benchmark_group("training");
    training.sample_size(10);
    for steps in [10, 110] {
        let settings = TrainSettings { epochs: steps / 10, ..TrainSettings::default() };
        // The difference of the two, over 100, is one step with its share of the validation.
        training.bench_function(format!("simulate, train {steps} steps of 256, measure"), |bencher| {
            bencher.iter(|| {
                train(baseline.simulator(), TEN_STEPS, DEFAULT_NOISE_RANGE, &FlowSettings::default(), &settings, |_| {})
                    .expect("it trains")
            });
        });
    }
    training.finish();
}

criterion_group!(benches, flow);
criterion_main!(benches);
