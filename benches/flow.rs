//! Inference of the shipped model `three-dof` in process. `cargo bench --bench flow`; `benches/training.rs` is about training.

use std::hint::black_box;

use criterion::{criterion_group, criterion_main, Criterion};
use modalwatch::baseline::library::Library;
use modalwatch::baseline::observation::Observation;
use modalwatch::hierarchy::populations;
use modalwatch::quantity::StructureId;

fn flow(criterion: &mut Criterion) {
    // As in `main.rs`: candle uses one thread, our own loops use the threads of the pool in which they run.
    std::env::set_var("RAYON_NUM_THREADS", "1");
    let library = Library::open(None).expect("no folder is read");
    let id = StructureId::parse("three-dof").expect("it is an id");
    let baseline = library.get(&id).and_then(|e| e.baseline.clone()).expect("it is shipped");
    let set = baseline.simulator().training_set(50, 1).expect("the prior holds no mechanism");
    let complete = |row: usize| Observation::complete(&set.frequencies_hz.row(row).iter().copied().collect::<Vec<_>>());
    let observations: Vec<Observation> = (0..50).map(complete).collect();

    for threads in [1, 2] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool of threads");
        criterion.bench_function(&format!("inference of 50 measurements x 10 draws, {threads} thread(s)"), |bencher| {
            pool.install(|| bencher.iter(|| baseline.infer(black_box(&observations), 10, 1).expect("it infers")));
        });
    }
    let samples = baseline.infer(&observations, 64, 1).expect("it infers");
    criterion.bench_function("population behind 50 measurements x 64 draws", |bencher| {
        bencher.iter(|| populations(black_box(&samples), None, baseline.space(), 1));
    });
}

criterion_group!(benches, flow);
criterion_main!(benches);
