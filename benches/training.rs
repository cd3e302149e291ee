//! Speed of the flow compared with the arithmetic limit of the machine and with PyTorch, in one run. `cargo bench --bench training`
//!
//! PyTorch is timed by `benches/peers/flow.py` if the Python of `MODALWATCH_PYTHON` (default `python3`) has it installed.

use std::collections::BTreeMap;
use std::process::Command;
use std::time::Instant;

use candle_core::{DType, Device, Tensor};
use candle_nn::{AdamW, Optimizer as _};
use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, Par};
use modalwatch::flow::fused::Fused;
use modalwatch::flow::pairs::{mean_loss, Pairs};
use modalwatch::flow::weights::untrained_flow;
use modalwatch::flow::{Architecture, FlowSettings};
use modalwatch::stats;
use rand::Rng as _;
use rand_distr::StandardNormal;

const BATCH: usize = 256;
/// Number of steps in one reading of the clock, and of readings, whose median is used.
const STEPS: usize = 50;
const READINGS: usize = 21;
/// Number of measurements in bulk sampling, and of draws for each.
const BULK: [usize; 2] = [50, 1_000];

fn main() {
    // As in `main.rs`: candle uses one thread.
    let _ = rayon::ThreadPoolBuilder::new().build_global();
    std::env::set_var("RAYON_NUM_THREADS", "1");
    speed();
}

/// Runs `work` on a pool of this number of threads.
fn on<T: Send>(threads: usize, work: impl FnOnce() -> T + Send) -> T {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads start").install(work)
}

/// Median over the readings of the time of one of `count` repetitions of `work`, seconds.
fn seconds(count: usize, mut work: impl FnMut()) -> f64 {
    work();
    let mut reading = || {
        let start = Instant::now();
        (0..count).for_each(|_| work());
        start.elapsed().as_secs_f64() / count as f64
    };
    let readings: Vec<f64> = (0..READINGS).map(|_| reading()).collect();
    stats::quantile(&readings, 0.5)
}

/// Floating-point operations per second of a product of two square matrices.
fn product_rate(threads: usize) -> f64 {
    const SIDE: usize = 768;
    let [a, b] = [1, 2].map(|seed| Mat::<f32>::from_fn(SIDE, SIDE, |i, j| ((i * seed + j) % 7) as f32));
    let mut c = Mat::<f32>::zeros(SIDE, SIDE);
    // Each thread computes its own product, so that the rate is that of independent cores.
    let mut results = vec![c.clone(); threads];
    let took = on(threads, || {
        seconds(1, || {
            rayon::scope(|scope| {
                for c in &mut results {
                    scope.spawn(|_| matmul(c, Accum::Replace, &a, &b, 1.0, Par::Seq));
                }
            });
        })
    });
    matmul(&mut c, Accum::Replace, &a, &b, 1.0, Par::Seq);
    2.0 * (threads * SIDE.pow(3)) as f64 / took
}

/// Number of multiplications and additions in the matrix products of one training step.
fn operations(a: &Architecture) -> f64 {
    let context = a.context_features + a.modes * a.channels;
    let (first, second) = (a.parameters / 2, a.parameters - a.parameters / 2);
    let net = |passive: usize, active: usize| (passive + context) * a.width + a.width * a.width + a.width * 2 * active;
    let nets = a.units * (net(first, second) + net(second, first));
    let unfolded = a.modes * 3 * a.context_channels * (a.channels + a.context_channels);
    let features = a.modes * a.context_channels * a.context_features;
    // Forward pass, gradient of the weights, and gradient of the inputs (which the first convolution does not need).
    2.0 * (BATCH * (3 * (nets + unfolded + features) - a.modes * 3 * a.channels * a.context_channels)) as f64
}

fn random_pairs(architecture: &Architecture, rows: usize) -> Pairs {
    let mut stream = stats::stream(1, "pairs");
    let mut normal = |shape: Vec<usize>| {
        let draws: Vec<f32> = (0..shape.iter().product()).map(|_| stream.sample(StandardNormal)).collect();
        Tensor::from_vec(draws, shape, &Device::Cpu).expect("as many draws as entries")
    };
    let x = normal(vec![rows, architecture.parameters]);
    Pairs { x, y: normal(vec![rows, architecture.channels, architecture.modes]) }
}

fn speed() {
    let architecture = FlowSettings::default().architecture(3, 3, 1, &mut stats::stream(1, "permutations"));
    let (flow, weights) = untrained_flow(&architecture, DType::F32, 1).expect("a flow of these sizes");
    let pairs = random_pairs(&architecture, 10 * BATCH);
    let chosen: Vec<u32> = (0..BATCH as u32).map(|row| row * 7).collect();
    let operations = operations(&architecture);
    println!("training step, batch {BATCH}, width 64, 4 units: {:.1} MFLOP in products", operations / 1e6);
    let mut step_ms = [0.0; 2];
    for threads in [1, 2] {
        let rate = product_rate(threads);
        let limit_ms = 1e3 * operations / rate;
        let mut fused = Fused::new(&flow, &weights).expect("weights in single precision");
        let rows = fused.rows(&flow, &pairs).expect("shapes fit");
        let ms = 1e3 * on(threads, || seconds(STEPS, || _ = std::hint::black_box(fused.step(&rows, &chosen, 1e-5))));
        step_ms[threads - 1] = ms;
        println!(
            "  {threads} thread(s): products {:.0} GFLOP/s, limit {limit_ms:.3} ms; fused {ms:.3} ms, {:.2} times the limit",
            rate / 1e9,
            ms / limit_ms
        );
    }
    println!("  two threads are {:.2} times one", step_ms[0] / step_ms[1]);
    let own = |tensor: &Tensor| tensor.narrow(0, 0, BATCH).expect("so many rows");
    let (x, y) = (own(&pairs.x), own(&pairs.y));
    let mut reference =
        AdamW::new_lr(weights.values().cloned().collect(), 1e-5).expect("an optimiser of these weights");
    let took = seconds(2, || {
        reference.backward_step(&mean_loss(&flow, &x, &y).expect("shapes fit")).expect("a gradient for each weight");
    });
    println!("  candle {:.1} ms (one thread)", 1e3 * took);

    let context = flow.summarise(&pairs.y.narrow(0, 0, BULK[0]).expect("so many rows")).expect("shapes fit");
    let mut rates = [0.0; 2];
    for threads in [1, 2] {
        let mut stream = stats::stream(1, "draws");
        let took = on(threads, || seconds(1, || _ = flow.sample(&context, BULK[1], &mut stream).expect("it samples")));
        rates[threads - 1] = BULK.iter().product::<usize>() as f64 / took / 1e6;
        println!("bulk draws, {threads} thread(s): {:.2} million/s", rates[threads - 1]);
    }
    for threads in [1, 2] {
        let Some(peer) = peer(threads) else {
            println!("PyTorch is not installed (see benches/README.md)");
            return;
        };
        let own = step_ms[threads - 1];
        for (name, value) in &peer {
            let ratio = match name.as_str() {
                "bulk_million_per_s" => format!("; ours is {:.2} of it", rates[threads - 1] / value),
                name if name.starts_with("step") => format!("; ours is {:.2} of it", own / value),
                _ => String::new(),
            };
            println!("PyTorch, {threads} thread(s): {name} {value}{ratio}");
        }
    }
}

/// Output of the PyTorch script; `None` without PyTorch.
fn peer(threads: usize) -> Option<BTreeMap<String, f64>> {
    let python = std::env::var("MODALWATCH_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/benches/peers/flow.py");
    let output = Command::new(python).args([script, &threads.to_string()]).output().ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    let pairs = text.lines().filter_map(|line| line.split_once(' '));
    let found: BTreeMap<String, f64> =
        pairs.filter_map(|(name, value)| Some((name.to_owned(), value.parse().ok()?))).collect();
    (!found.is_empty()).then_some(found)
}
