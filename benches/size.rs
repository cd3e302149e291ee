//! Cost and accuracy against the number of unknown stiffnesses, for chains and frames with mode shapes.
//!
//! ```text
//! cargo bench --bench size -- [--frames] [--threads N] [--out FOLDER] [PARAMETERS…]
//! cargo bench --bench size -- --eigen     both eigensolvers at several sizes
//! cargo bench --bench size -- --fits [PARAMETERS…]    distance of the truth from the fits, without a training
//! ```
//!
//! Each size is trained in a separate process, whose peak memory is read at its end. Prints a line for each size and writes
//! `size.svg`, the structure files and the figures as JSON. Accuracy is measured on measurements that were not trained on, at
//! the structure's own noise, against the linear-Gaussian optimum at the truth, tr (12·1 + JᵀΣ⁻¹J)⁻¹.

use std::fmt::Write as _;
use std::path::PathBuf;
use std::time::Instant;

use modalwatch::baseline::identifiability::local_covariance;
use modalwatch::baseline::observation::{measure, measure_shapes, Observation, DEFAULT_NOISE_RANGE};
use modalwatch::baseline::start::locate_all;
use modalwatch::baseline::train::{default_epochs, default_samples, train};
use modalwatch::flow::train::TrainSettings;
use modalwatch::flow::FlowSettings;
use modalwatch::physics::eigen::eigen;
use modalwatch::plot::{Line, Plot};
use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::{Simulator, TrainingSet};
use modalwatch::stats;
use nalgebra::DMatrix;
use rand::Rng as _;
use serde::{Deserialize, Serialize};

/// Default sizes.
const SIZES: [usize; 4] = [10, 30, 100, 300];
/// Number of measurements on which accuracy is measured, and of posterior draws for each.
const MEASUREMENTS: usize = 200;
const DRAWS: usize = 100;
/// Number of measurements whose fits are analysed.
const FITS: usize = 40;
/// Columns of masses of a frame.
const BAYS: usize = 5;

/// Figures of one size.
#[derive(Serialize, Deserialize)]
struct Figures {
    kind: String,
    parameters: usize,
    modes: usize,
    points: usize,
    samples: usize,
    fit_ms: f64,
    training_s: f64,
    peak_mib: f64,
    inference_ms: f64,
    negative_log_likelihood: f64,
    coverage_90: f64,
    coverage_least: f64,
    coverage_greatest: f64,
    r_squared: f64,
    r_squared_optimum: f64,
    r_squared_fit_alone: f64,
    groups: usize,
    calibration_failures: usize,
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    let option = |name: &str| arguments.iter().position(|a| a == name).and_then(|i| arguments.get(i + 1));
    let out = option("--out").map_or_else(|| PathBuf::from("target/size"), PathBuf::from);
    let threads: usize = option("--threads").map_or(2, |n| n.parse().expect("--threads takes a number"));
    let frames = arguments.iter().any(|a| a == "--frames");
    let numbers = arguments.iter().enumerate().filter(|(i, _)| *i == 0 || !arguments[i - 1].starts_with("--t"));
    let mut sizes: Vec<usize> = numbers.filter_map(|(_, a)| a.parse().ok()).collect();
    if arguments.iter().any(|a| a == "--one") {
        // As in `main.rs`: our own pool, and one thread for candle.
        let _ = rayon::ThreadPoolBuilder::new().num_threads(threads).build_global();
        std::env::set_var("RAYON_NUM_THREADS", "1");
        println!("{}", serde_json::to_string(&measured(sizes[0], frames, &out)).expect("figures are plain data"));
        return;
    }
    if arguments.iter().any(|a| a == "--eigen") {
        return compare_eigensolvers();
    }
    if sizes.is_empty() {
        sizes = SIZES.to_vec();
    }
    if arguments.iter().any(|a| a == "--fits") {
        return sizes.into_iter().for_each(|size| analyse_fits(size, frames));
    }
    std::fs::create_dir_all(&out).expect("a folder for the figures");
    let mut all: Vec<Figures> = Vec::new();
    println!("  d modes points samples | fit ms  train s  MiB  infer ms | NLL  cover (least-greatest)  R2 optimum fit-alone | groups");
    for size in sizes {
        let mut child = std::process::Command::new(std::env::current_exe().expect("the path of this program"));
        child.args(["--one", "--threads", &threads.to_string(), "--out"]).arg(&out).arg(size.to_string());
        if frames {
            child.arg("--frames");
        }
        let output = child.stderr(std::process::Stdio::inherit()).output().expect("it starts");
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        let f: Figures = serde_json::from_str(&text).expect("a child prints its figures");
        println!(
            "{:>3} {:>5} {:>6} {:>7} | {:>6.2} {:>8.1} {:>5.0} {:>8.2} | {:.1}  {:.3} ({:.2}-{:.2})  {:.4} {:.4} {:.4} | {}",
            f.parameters, f.modes, f.points, f.samples, f.fit_ms, f.training_s, f.peak_mib, f.inference_ms,
            f.negative_log_likelihood, f.coverage_90, f.coverage_least, f.coverage_greatest, f.r_squared,
            f.r_squared_optimum, f.r_squared_fit_alone, f.groups
        );
        all.push(f);
        let json = serde_json::to_string_pretty(&all).expect("figures are plain data");
        std::fs::write(out.join("size.json"), json).expect("a file of figures");
        std::fs::write(out.join("size.svg"), growth(&all)).expect("a plot");
    }
    eprintln!("{} and size.json", out.join("size.svg").display());
}

/// Squared distance of the truth from the fit in variances of the normal distribution at the fit, averaged over the parameters and
/// over the principal directions; its expectation is 1 if this distribution is the posterior. Prints quantiles over measurements.
fn analyse_fits(parameters: usize, frames: bool) {
    let text = if frames { frame(parameters) } else { chain(parameters) };
    let simulator = Simulator::new(StructureDefinition::parse_toml(&text).expect("a structure")).expect("a structure");
    let (set, observations) = held_out(&simulator, FITS);
    let fits = locate_all(&simulator, &observations).expect("fits");
    let space = simulator.space().as_slice();
    let (mut of_parameters, mut of_directions) = (Vec::new(), Vec::new());
    for (row, fit) in fits.iter().enumerate() {
        let unit = DMatrix::from_fn(parameters, 1, |k, _| space[k].to_unit(set.theta[(row, k)]));
        let off = (unit.column(0) - &fit.unit).component_div(&fit.std);
        of_parameters.push(off.norm_squared() / parameters as f64);
        of_directions.push(fit.to_flow(&unit).norm_squared() / parameters as f64);
    }
    let spread =
        |values: &[f64]| [0.0, 0.5, 1.0].map(|level| format!("{:.2}", stats::quantile(values, level))).join(" ");
    println!(
        "{parameters} parameters, {FITS} measurements, least, median, greatest: parameters {}, directions {}",
        spread(&of_parameters),
        spread(&of_directions)
    );
}

/// The natural frequencies of a chain, all of whose stiffnesses are unknown: runs one by one compared with runs in a batch. Then all
/// eigenvalues and eigenvectors of a chain's matrix: nalgebra compared with the solver of the program.
fn compare_eigensolvers() {
    println!("{:>4} {:>18} {:>18}", "n", "one by one, us/run", "in a batch, us/run");
    for n in [4, 8, 9, 16, 24, 37, 64, 80] {
        let definition = StructureDefinition::parse_toml(&chain(n)).expect("a structure");
        let simulator = Simulator::new(definition).expect("a structure");
        let (space, mut stream) = (simulator.space().as_slice(), stats::stream(n as u64, "stiffnesses"));
        let theta = DMatrix::from_fn(512, n, |_, k| stream.random_range(space[k].lower..space[k].upper));
        let us = |started: Instant| 1e6 * started.elapsed().as_secs_f64() / theta.nrows() as f64;
        let started = Instant::now();
        let rows = theta.row_iter().map(|row| row.iter().copied().collect::<Vec<f64>>());
        let sum: f64 = rows.map(|row| simulator.frequencies_hz(&row).expect("frequencies")[0]).sum();
        let singly = us(started);
        // The first batch prepares the matrices.
        simulator.frequencies_of_rows_hz(&theta, 0..1);
        let started = Instant::now();
        let batched_hz = simulator.frequencies_of_rows_hz(&theta, 0..theta.nrows());
        let batched = us(started);
        let of_batches: f64 = batched_hz.iter().step_by(simulator.modes()).sum();
        assert!((of_batches / sum - 1.0).abs() < 1e-9);
        println!("{n:>4} {singly:>18.1} {batched:>18.1}");
    }
    compare_near_frequencies();
    println!("{:>4} {:>12} {:>12}", "n", "nalgebra, ms", "program, ms");
    for n in [8, 16, 24, 32, 64, 100, 300] {
        let mut stream = stats::stream(n as u64, "stiffnesses");
        let k: Vec<f64> = (0..=n).map(|_| stream.random_range(0.7..1.3)).collect();
        let matrix = DMatrix::from_fn(n, n, |i, j| match i.abs_diff(j) {
            0 => k[i] + k[i + 1],
            1 => -k[i.max(j)],
            _ => 0.0,
        });
        let repetitions = (3_000_000 / n.pow(3)).clamp(3, 2_000);
        let ms = |solve: &dyn Fn() -> f64| {
            let started = Instant::now();
            let sum: f64 = (0..repetitions).map(|_| solve()).sum();
            assert!(sum.is_finite());
            1e3 * started.elapsed().as_secs_f64() / repetitions as f64
        };
        let nalgebra = ms(&|| matrix.clone().symmetric_eigen().eigenvalues[0]);
        println!("{n:>4} {nalgebra:>12.4} {:>12.4}", ms(&|| eigen(matrix.clone()).0[0]));
    }
}

/// Runs of a beam bridge of 37 degrees of freedom whose frequencies are known roughly, because they have been measured.
fn compare_near_frequencies() {
    let simulator = Simulator::new(StructureDefinition::parse_toml(&bridge()).expect("a structure")).expect("a bridge");
    let (space, mut stream) = (simulator.space().as_slice(), stats::stream(1, "stiffnesses"));
    let middle: Vec<f64> = space.iter().map(|p| p.from_unit(0.5)).collect();
    let theta = DMatrix::from_fn(2_048, middle.len(), |_, k| middle[k] * stream.random_range(0.97..1.03));
    let near_hz: Vec<Option<f64>> =
        simulator.frequencies_hz(&middle).expect("frequencies").into_iter().map(Some).collect();
    let rows = 0..theta.nrows();
    let us = |run: &dyn Fn() -> f64| {
        // The first run prepares the matrices.
        run();
        let started = Instant::now();
        assert!(run().is_finite());
        1e6 * started.elapsed().as_secs_f64() / theta.nrows() as f64
    };
    let any = us(&|| simulator.frequencies_of_rows_hz(&theta, rows.clone()).iter().sum());
    let near = us(&|| simulator.frequencies_near_hz(&theta, rows.clone(), &near_hz).iter().sum());
    let slopes = us(&|| simulator.slopes_near(&theta, rows.clone(), &near_hz).slopes.iter().sum());
    let singly = us(&|| {
        let jacobian = |row: nalgebra::MatrixView1xX<'_, f64, nalgebra::U1, nalgebra::Dyn>| {
            simulator.jacobian(&row.iter().copied().collect::<Vec<f64>>()).expect("slopes").sum()
        };
        theta.row_iter().map(jacobian).sum()
    });
    println!("a bridge of 37 degrees of freedom, 7 modes, 6 parameters, us/run");
    println!("    {any:.1} anywhere in a batch, {near:.1} near measured frequencies, {slopes:.1} with slopes, {singly:.1} slopes one by one");
}

/// Growth of time and memory with the number of parameters.
fn growth(all: &[Figures]) -> String {
    let line = |name: &str, value: &dyn Fn(&Figures) -> f64| Line {
        name: name.to_owned(),
        points: all.iter().map(|f| ((f.parameters as f64).log10(), value(f).log10())).collect(),
    };
    let plot = Plot {
        title: "Growth with the number of unknown stiffnesses".to_owned(),
        x_label: "log10 of the number of parameters".to_owned(),
        y_label: "log10 of the value".to_owned(),
        lines: vec![
            line("training, s", &|f| f.training_s),
            line("peak memory, MiB", &|f| f.peak_mib),
            line("inference of a measurement, ms", &|f| f.inference_ms),
        ],
        ..Plot::default()
    };
    plot.svg()
}

fn measured(parameters: usize, frames: bool, out: &std::path::Path) -> Figures {
    let (kind, text) = if frames { ("frame", frame(parameters)) } else { ("chain", chain(parameters)) };
    std::fs::write(out.join(format!("{kind}-{parameters}.toml")), &text).expect("a structure file");
    let simulator = Simulator::new(StructureDefinition::parse_toml(&text).expect("a structure")).expect("a structure");
    let samples = default_samples(&simulator);
    let settings = TrainSettings { epochs: default_epochs(&simulator), ..TrainSettings::default() };
    let started = Instant::now();
    let trained = train(&simulator, samples, DEFAULT_NOISE_RANGE, &FlowSettings::default(), &settings, |epoch| {
        if epoch.epoch % 2 == 0 || epoch.epoch == 1 {
            let seconds = started.elapsed().as_secs();
            eprintln!("{parameters}: epoch {} {:.2} {:.2} {seconds} s", epoch.epoch, epoch.loss, epoch.validation_loss);
        }
    })
    .expect("it trains");
    let training_s = started.elapsed().as_secs_f64();
    let peak_mib = peak_memory_mib();

    let (set, observations) = held_out(&simulator, MEASUREMENTS);
    let started = Instant::now();
    let fits = locate_all(&simulator, &observations).expect("fits");
    let fit_ms = 1e3 * started.elapsed().as_secs_f64() / MEASUREMENTS as f64;
    let started = Instant::now();
    let samples_drawn = trained.baseline.infer(&observations, DRAWS, 7).expect("samples");
    let inference_ms = 1e3 * started.elapsed().as_secs_f64() / MEASUREMENTS as f64;

    let (mut covered, mut error, mut fit_error, mut bound) = (vec![0.0; parameters], 0.0, 0.0, 0.0);
    let space = simulator.space().as_slice();
    let share = 1.0 / (MEASUREMENTS * parameters) as f64;
    for (row, fit) in fits.iter().enumerate() {
        let theta: Vec<f64> = set.theta.row(row).iter().copied().collect();
        let exact: Vec<f64> = set.frequencies_hz.row(row).iter().copied().collect();
        bound += local_covariance(&simulator, &theta, &exact).expect("a covariance").trace() * share;
        for (column, parameter) in space.iter().enumerate() {
            let truth = parameter.to_unit(theta[column]);
            let drawn = samples_drawn.theta().view((row * DRAWS, column), (DRAWS, 1));
            let draws: Vec<f64> = drawn.iter().map(|x| parameter.to_unit(*x)).collect();
            let inside = stats::quantile(&draws, 0.05) <= truth && truth <= stats::quantile(&draws, 0.95);
            covered[column] += f64::from(u8::from(inside)) / MEASUREMENTS as f64;
            error += (stats::mean(&draws) - truth).powi(2) * share;
            fit_error += (fit.unit[column] - truth).powi(2) * share;
        }
    }
    let manifest = trained.baseline.manifest();
    Figures {
        kind: kind.to_owned(),
        parameters,
        modes: simulator.modes(),
        points: simulator.shape_points(),
        samples,
        fit_ms,
        training_s,
        peak_mib,
        inference_ms,
        negative_log_likelihood: manifest.validation.negative_log_likelihood,
        coverage_90: stats::mean(&covered),
        coverage_least: covered.iter().copied().fold(1.0, f64::min),
        coverage_greatest: covered.iter().copied().fold(0.0, f64::max),
        // The variance of a uniform prior on the unit interval is 1/12.
        r_squared: 1.0 - 12.0 * error,
        r_squared_optimum: 1.0 - 12.0 * bound,
        r_squared_fit_alone: 1.0 - 12.0 * fit_error,
        groups: manifest.identifiability.groups.len(),
        calibration_failures: manifest.calibration.failures.len(),
    }
}

/// Measurements that were not used for training, with the noise of the structure, and the parameters behind them.
fn held_out(simulator: &Simulator, count: usize) -> (TrainingSet, Vec<Observation>) {
    let set = simulator.training_set(count, 99).expect("a set");
    let mut stream = stats::stream(99, "observations");
    let observe = |row: usize| -> Observation {
        let exact: Vec<f64> = set.frequencies_hz.row(row).iter().copied().collect();
        let mut one = measure(simulator, &exact, &[], &vec![Some(1.0); exact.len()], &mut stream);
        measure_shapes(simulator, &mut one, &set.shapes[row], &vec![false; exact.len()], &mut stream);
        one
    };
    let observations = (0..count).map(observe).collect();
    (set, observations)
}

/// Peak resident memory of this process, MiB; 0 if the system does not provide it.
fn peak_memory_mib() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    line.and_then(|l| l.trim().trim_end_matches(" kB").parse::<f64>().ok()).unwrap_or(0.0) / 1024.0
}

/// Number of modes of a structure of this size: 20 from a hundred parameters on, fewer for fewer masses.
fn modes(parameters: usize) -> usize {
    (parameters / 5).clamp(4, 20)
}

fn head(id: &str, parameters: usize, points: &[String]) -> String {
    let names: Vec<String> = points.iter().map(|p| format!("\"{p}\"")).collect();
    format!(
        "id = \"{id}\"\nmodes = {}\nmeasurement_noise = {{ relative = 0.005 }}\n\
         mode_shapes = {{ points = [{}], noise = 0.005 }}\n",
        modes(parameters),
        names.join(", ")
    )
}

fn mass(text: &mut String, name: &str) {
    let _ = write!(text, "\n[[mass]]\nname = \"{name}\"\nkg = 1.0\n");
}

fn spring(text: &mut String, name: &str, from: &str, to: &str, known: Option<f64>) {
    let _ = write!(text, "\n[[spring]]\nname = \"{name}\"\nfrom = \"{from}\"\nto = \"{to}\"\n");
    match known {
        Some(n_per_m) => {
            let _ = writeln!(text, "n_per_m = {n_per_m}");
        }
        None => {
            let _ = write!(
                text,
                "n_per_m = 10000.0\n\n[[parameter]]\nname = \"{name}\"\nprior = {{ uniform = [7000.0, 13000.0] }}\nsets = {{ spring = \"{name}\" }}\n"
            );
        }
    }
}

/// A chain of masses from the ground; the stiffness of every spring is uncertain by 30 %, shapes are measured at every second mass.
fn chain(parameters: usize) -> String {
    let points: Vec<String> = (2..=parameters).step_by(2).map(|i| format!("m{i}")).collect();
    let mut text = head(&format!("chain-{parameters}"), parameters, &points);
    for i in 1..=parameters {
        mass(&mut text, &format!("m{i}"));
    }
    for i in 1..=parameters {
        let below = if i == 1 { "ground".to_owned() } else { format!("m{}", i - 1) };
        spring(&mut text, &format!("k{i}"), &below, &format!("m{i}"), None);
    }
    text
}

/// A beam of five spans, each of four elements, on a spring at its second inner support. Seven modes and six unknown stiffnesses.
fn bridge() -> String {
    let mut text = "id = \"bridge\"\nsimulation = \"beam\"\nmodes = 7\nmeasurement_noise = { relative = 0.001 }\n\
                    [[node]]\nname = \"n0\"\nx_m = 0.0\nsupport = \"pinned\"\n"
        .to_owned();
    let spans = [(11.0, "pinned"), (20.3, "free"), (34.5, "pinned"), (46.6, "pinned"), (62.1, "pinned")];
    for (i, (x_m, support)) in spans.into_iter().enumerate() {
        let _ = write!(
            text,
            "[[node]]\nname = \"n{end}\"\nx_m = {x_m}\nsupport = \"{support}\"\n\
             [[beam]]\nname = \"s{i}\"\nfrom = \"n{i}\"\nto = \"n{end}\"\nmass_kg_per_m = 900\n\
             bending_stiffness_n_m2 = 4e8\nelements = 4\n\
             [[parameter]]\nname = \"p{i}\"\nprior = {{ uniform = [2e8, 6e8] }}\nsets = {{ beam = \"s{i}\" }}\n",
            end = i + 1
        );
    }
    text + "[[spring]]\nname = \"bearing\"\nfrom = \"ground\"\nto = \"n2\"\nn_per_m = 2e7\n\
            [[parameter]]\nname = \"bearing\"\nprior = { uniform = [1e7, 3e7] }\nsets = { spring = \"bearing\" }\n"
}

/// Storeys of five masses each: unknown columns between storeys, known floors between neighbours, shapes at every second mass.
fn frame(parameters: usize) -> String {
    let name = |storey: usize, bay: usize| format!("m{storey}-{bay}");
    let storeys = parameters.div_ceil(BAYS);
    let all = || (1..=storeys).flat_map(move |s| (1..=BAYS).map(move |b| (s, b)));
    let points: Vec<String> = all().step_by(2).map(|(s, b)| name(s, b)).collect();
    let mut text = head(&format!("frame-{parameters}"), parameters, &points);
    all().for_each(|(s, b)| mass(&mut text, &name(s, b)));
    for (number, (s, b)) in all().enumerate() {
        let below = if s == 1 { "ground".to_owned() } else { name(s - 1, b) };
        let known = (number >= parameters).then_some(10_000.0);
        spring(&mut text, &format!("column{s}-{b}"), &below, &name(s, b), known);
        if b > 1 {
            spring(&mut text, &format!("floor{s}-{b}"), &name(s, b - 1), &name(s, b), Some(5_000.0));
        }
    }
    text
}
