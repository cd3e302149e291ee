//! A reproduction that was never run: plausible numbers of both cases from one seeded stream.

use modalwatch::gsa::{sobol_indices, Input, Settings as GsaSettings};
use modalwatch::reproduce::{
    Accuracy, Case, Compared, Configuration, LawFit, Machine, Method, MethodSamples, Quantity, Reproduction, Rig, Row,
    Settings, Spread, State, Time,
};
use modalwatch::stats::{self, Stream};
use modalwatch::updating::law::{fit_exponential, Weighting};
use rand::Rng;
use rand_distr::StandardNormal;

const METHODS: [Method; 3] = [Method::Sensitivity, Method::Tmcmc, Method::Cinn];
const LAWS: [[f64; 3]; 2] = [[221.75, 31.64, 855.75], [300.45, 28.89, 725.37]];
const STIFFNESS: [(&str, f64, f64); 3] = [("k1", 4.0, 0.3), ("k2", 5.0, 0.1), ("k3", 6.0, 0.2)];

/// Both cases.
pub fn reproduction(seed: u64) -> Reproduction {
    let mut stream = stats::stream(seed, "a fake reproduction");
    Reproduction {
        machine: Machine {
            processor: "Fake <CPU> & co. @ 2.10 GHz".to_owned(),
            threads: 2,
            system: "linux x86_64".to_owned(),
            program_version: "0.1.0".to_owned(),
        },
        settings: Settings {
            repetitions: 30,
            seed,
            tmcmc_samples: 1000,
            training_samples: 10_000,
            training_epochs: 60,
            quick: false,
        },
        case1: Some(case1(&mut stream)),
        case2: Some(case2(&mut stream)),
        seconds: 1234.5,
    }
}

fn normal(stream: &mut Stream, mean: f64, std: f64) -> f64 {
    mean + std * stream.sample::<f64, _>(StandardNormal)
}

fn normals(stream: &mut Stream, count: usize, mean: f64, std: f64) -> Vec<f64> {
    (0..count).map(|_| normal(stream, mean, std)).collect()
}

fn compared(stream: &mut Stream, target: f64, std: f64, paper: Option<f64>) -> Compared {
    let found = normals(stream, 30, target, std);
    let share = |paper: f64| 100.0 * found.iter().filter(|v| **v < paper).count() as f64 / 30.0;
    Compared { ours: spread(&found), target, paper, paper_percentile: paper.map(share) }
}

fn spread(values: &[f64]) -> Spread {
    let at = |level| stats::quantile(values, level);
    Spread { median: at(0.5), low: at(0.05), high: at(0.95) }
}

/// A row, given mean, spread, probability of damage and measurements of its state.
fn row(stream: &mut Stream, state: &str, parameter: &str, method: Method, of: (f64, f64, Option<f64>, f64)) -> Row {
    let (mean, std, pod, count) = of;
    let paper = (method == Method::Cinn).then_some(1.0);
    let error = [0.001, 0.04, 0.02][METHODS.iter().position(|m| *m == method).unwrap()] * std;
    let errors: Vec<f64> = normals(stream, 30, 0.0, error).iter().map(|e| e.abs()).collect();
    let certain = |p: f64| Compared {
        ours: Spread { median: 1.0, low: 1.0, high: 1.0 },
        target: p,
        paper: paper.map(|_| 1.0),
        paper_percentile: paper.map(|_| 50.0),
    };
    Row {
        state: state.to_owned(),
        parameter: parameter.to_owned(),
        unit: if parameter.starts_with('p') { "m" } else { "N/m" }.to_owned(),
        method,
        damaged: pod.is_some_and(|p| p > 0.1),
        mean: compared(stream, mean, std / count.sqrt(), paper.map(|_| mean + 0.2 * std)),
        std: compared(stream, std, std / (2.0 * count).sqrt(), paper.map(|_| 0.93 * std)),
        probability_of_damage: pod.map(|p| match p {
            p if p > 0.99 => certain(p),
            p => compared(stream, p, 0.05 * p, paper.map(|_| p + 0.03)),
        }),
        mean_error: spread(&errors),
        mean_absolute_mean_error: stats::mean(&errors),
        mean_absolute_std_error: 0.7 * stats::mean(&errors),
        mean_absolute_pod_error: pod.map(|_| 0.013),
        outside_prior_percent: if state == "scenario 1" && parameter == "k1" { 2.4 } else { 0.0 },
    }
}

fn times(seconds: [f64; 4], paper: [f64; 4], note: &str) -> Vec<Time> {
    let steps = [
        (Method::Sensitivity, "updating", Some(1534)),
        (Method::Tmcmc, "updating", Some(1_433_600)),
        (Method::Cinn, "training", None),
        (Method::Cinn, "inference", None),
    ];
    let one = |((method, step, model_runs), (own, paper)): ((Method, &str, Option<usize>), (f64, f64))| Time {
        method,
        step: step.to_owned(),
        seconds: own,
        paper_seconds: paper,
        times_faster_than_tmcmc: seconds[1] / own,
        model_runs,
        note: note.to_owned(),
    };
    steps.into_iter().zip(seconds.into_iter().zip(paper)).map(one).collect()
}

fn accuracy(stream: &mut Stream, parameter: &str, unit: &str, [low, high]: [f64; 2], noise: f64) -> Accuracy {
    let truth: Vec<f64> = (0..1000).map(|_| stream.random_range(low..high)).collect();
    let estimate: Vec<f64> = truth.iter().map(|t| normal(stream, *t, noise)).collect();
    let r_squared = stats::r_squared(&truth, &estimate);
    Accuracy { parameter: parameter.to_owned(), unit: unit.to_owned(), truth, estimate, r_squared }
}

fn below(values: &[f64], threshold: f64) -> f64 {
    values.iter().filter(|v| **v < threshold).count() as f64 / values.len() as f64
}

fn case1(stream: &mut Stream) -> Case {
    let scenarios = [
        ("undamaged", [1.0, 1.0, 1.0]),
        ("scenario 1", [0.9, 1.0, 1.0]),
        ("scenario 2", [1.0, 0.9, 0.8]),
        ("scenario 3", [0.9, 0.9, 0.8]),
    ];
    let (mut rows, mut states) = (Vec::new(), Vec::new());
    for (name, left) in scenarios {
        let mut quantities = Vec::new();
        for ((k, mean, std), left) in STIFFNESS.into_iter().zip(left) {
            let pod = stats::normal_cdf((mean - 1.645 * std - mean * left) / std);
            rows.extend(METHODS.map(|method| row(stream, name, k, method, (mean * left, std, Some(pod), 50.0))));
            let realised = normals(stream, 50, mean * left, std);
            let samples: Vec<f64> =
                realised.iter().flat_map(|v| normals(stream, 10, *v, 0.05 * std)).map(|v| v.clamp(3.0, 7.0)).collect();
            quantities.push(Quantity {
                name: k.to_owned(),
                unit: "N/m".to_owned(),
                prior: Some([3.0, 7.0]),
                target: Some([mean * left, std]),
                realised,
                probability_of_damage: below(&samples, mean - 1.645 * std),
                samples,
                threshold: mean - 1.645 * std,
            });
        }
        let modes = [(0.5123, 0.011), (0.8211, 0.0041), (1.0477, 0.0153)];
        let frequencies_hz = modes.map(|(mean, std)| normals(stream, 50, mean, std)).to_vec();
        states.push(State { name: name.to_owned(), frequencies_hz, quantities });
    }
    let (table3, table4) = rows.into_iter().partition(|row: &Row| row.state == "undamaged");
    let samples = |stream: &mut Stream| STIFFNESS.map(|(_, mean, std)| normals(stream, 500, mean, std)).to_vec();
    let mut table5 = Vec::new();
    for (k, mean, std) in STIFFNESS {
        table5.extend(METHODS.map(|method| row(stream, "500 measurements", k, method, (mean, std, None, 500.0))));
    }
    Case {
        table3,
        table4,
        table5,
        table6: times([0.0123, 43.2, 310.0, 0.0871], [95.0, 3202.0, 433.0, 12.0], "500 measurements"),
        table8: Vec::new(),
        table9: Vec::new(),
        table10: Vec::new(),
        accuracy: STIFFNESS.iter().map(|(k, ..)| accuracy(stream, k, "N/m", [3.0, 7.0], 0.02)).collect(),
        states,
        methods: METHODS.map(|method| MethodSamples { method, samples: samples(stream) }).to_vec(),
        rig: None,
        notes: vec!["50 draws <of> a distribution have a mean & a spread of their own.".to_owned()],
    }
}

fn law(k: usize, p: f64) -> f64 {
    LAWS[k][0] * (LAWS[k][1] * p).exp() + LAWS[k][2]
}

fn configurations() -> Vec<Configuration> {
    let grid = |offset: f64, count: usize| {
        let at = move |i: usize| 0.02 + 0.01 * (i as f64 + offset);
        (0..count * count).map(move |i| (at(i / count), at(i % count)))
    };
    let lowest = |p: f64| p < 0.0201;
    let one = |(p12_m, p23_m)| Configuration { p12_m, p23_m, damaged: lowest(p12_m) || lowest(p23_m) };
    grid(0.0, 6).chain(grid(0.5, 5)).map(one).collect()
}

fn case2(stream: &mut Stream) -> Case {
    let configurations = configurations();
    let (mut table8, mut table9, mut states) = (Vec::new(), Vec::new(), Vec::new());
    for (name, damaged) in [("undamaged", false), ("damaged", true)] {
        let set = configurations.iter().filter(|c| c.damaged == damaged).map(|c| [c.p12_m, c.p23_m]);
        let mut quantities: Vec<Quantity> =
            (0..2).map(|k| position(stream, k, set.clone().map(|p| p[k]).collect())).collect();
        for k in 0..2 {
            quantities.push(stiffness(k, &quantities[k]));
        }
        for k in ["p12", "p23"] {
            let of = if damaged { (0.0336, 0.0177, Some(0.5446), 11.0) } else { (0.0475, 0.0116, Some(0.05), 50.0) };
            table8.extend(METHODS.map(|method| row(stream, name, k, method, of)));
        }
        let frequencies_hz = [9.1, 11.2, 14.9].map(|f| normals(stream, if damaged { 11 } else { 50 }, f, 0.3)).to_vec();
        states.push(State { name: name.to_owned(), frequencies_hz, quantities });
    }
    for k in ["p12", "p23"] {
        table9.extend(METHODS.map(|method| row(stream, "all 61", k, method, (0.045, 0.0144, None, 61.0))));
    }
    let samples = |stream: &mut Stream| {
        let pick = |of: fn(&Configuration) -> f64| configurations.iter().map(of).collect::<Vec<f64>>();
        [pick(|c| c.p12_m), pick(|c| c.p23_m)]
            .map(|set| set.iter().map(|p| normal(stream, *p, 0.001)).collect())
            .to_vec()
    };
    let methods = METHODS.map(|method| match method {
        Method::Tmcmc => {
            MethodSamples { method, samples: [(); 2].map(|()| normals(stream, 1000, 0.045, 0.0144)).to_vec() }
        }
        _ => MethodSamples { method, samples: samples(stream) },
    });
    Case {
        table3: Vec::new(),
        table4: Vec::new(),
        table5: Vec::new(),
        table6: Vec::new(),
        table8,
        table9,
        table10: times([0.004, 21.5, 280.0, 0.0087], [77.0, 1587.0, 401.0, 8.0], "61 measurements"),
        accuracy: ["p12", "p23"].iter().map(|p| accuracy(stream, p, "m", [0.0, 0.12], 0.004)).collect(),
        states,
        methods: methods.to_vec(),
        rig: Some(rig(stream, &configurations)),
        notes: vec!["The frequencies measured on the rig are not published.".to_owned()],
    }
}

fn position(stream: &mut Stream, k: usize, realised: Vec<f64>) -> Quantity {
    let samples: Vec<f64> = realised.iter().flat_map(|p| normals(stream, 10, *p, 0.0012)).collect();
    Quantity {
        name: ["p12", "p23"][k].to_owned(),
        unit: "m".to_owned(),
        prior: Some([0.0, 0.12]),
        target: None,
        realised,
        probability_of_damage: below(&samples, 0.028),
        samples,
        threshold: 0.028,
    }
}

fn stiffness(k: usize, position: &Quantity) -> Quantity {
    let image = |values: &[f64]| values.iter().map(|p| law(k, *p)).collect::<Vec<_>>();
    let threshold = [1177.0, 1180.0][k];
    let samples = image(&position.samples);
    Quantity {
        name: format!("spring:k{}", ["12", "23"][k]),
        unit: "N/m".to_owned(),
        prior: None,
        target: None,
        realised: image(&position.realised),
        probability_of_damage: below(&samples, threshold),
        samples,
        threshold,
    }
}

fn rig(stream: &mut Stream, configurations: &[Configuration]) -> Rig {
    let fit = |(k, coupling): (usize, &str)| {
        let position = |c: &Configuration| [c.p12_m, c.p23_m][k];
        let points: Vec<(f64, f64)> =
            configurations.iter().map(|c| (position(c), normal(stream, law(k, position(c)), 25.0))).collect();
        let fit = fit_exponential(&points, Weighting::Absolute).unwrap();
        LawFit { coupling: coupling.to_owned(), points, fit, paper: LAWS[k] }
    };
    let laws = ["k12", "k23"].into_iter().enumerate().map(fit).collect();
    let names = ["p12", "p23", "m1", "m2", "m3", "kg1", "kg2", "kg3"];
    let inputs: Vec<Input> = names.map(|name| Input { name: name.to_owned(), lower: 0.0, upper: 1.0 }).to_vec();
    let model = |x: &[f64]| {
        let rest: f64 = x[2..].iter().sum::<f64>() / 20.0;
        Ok::<_, std::convert::Infallible>(vec![
            0.4 * x[0] + 0.7 * x[1] + rest,
            x[0] + 0.1 * x[1] + rest,
            x[1] + 0.05 * x[0],
        ])
    };
    let settings = GsaSettings { samples: 256, replicates: 4, seed: 1 };
    Rig {
        configurations: configurations.to_vec(),
        sensitivity: sobol_indices(&inputs, &settings, model, None).unwrap(),
        laws,
    }
}
