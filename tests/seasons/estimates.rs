//! Batches of measured frequencies and their estimates by weighted least squares, without the trained model of the program.

use std::fs;
use std::path::{Path, PathBuf};

use modalwatch::process::estimate::{BatchEstimate, MeanFrequencies};
use modalwatch::quantity::Timestamp;
use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::Simulator;
use nalgebra::{DMatrix, DVector};

/// A row of a table of frequencies: a number that orders it, and the frequencies, Hz.
pub struct Row {
    pub number: usize,
    pub frequencies_hz: Vec<Option<f64>>,
}

/// A file of the measured data, or `None`, counted as skipped.
pub fn data(name: &str) -> Option<String> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data").join(name);
    if !path.exists() {
        crate::needs::missing(&format!("the data ../shared/data/{name}, which are not part of the repository"));
        return None;
    }
    Some(fs::read_to_string(path).unwrap())
}

/// A structure of the tests of diagnosis.
pub fn simulator(file: &str) -> Simulator {
    let path: PathBuf = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/discrepancy").join(file);
    Simulator::new(StructureDefinition::parse_toml(&fs::read_to_string(path).unwrap()).unwrap()).unwrap()
}

/// Rows of a table in CSV with columns `sample_index` and `f1_hz` to `f<modes>_hz`.
pub fn rows(csv: &str, modes: usize) -> Vec<Row> {
    let mut lines = csv.lines();
    let header: Vec<&str> = lines.next().unwrap().split(',').collect();
    let column = |name: String| header.iter().position(|h| *h == name).unwrap();
    let frequencies: Vec<usize> = (1..=modes).map(|mode| column(format!("f{mode}_hz"))).collect();
    let number = column("sample_index".to_owned());
    let row = |line: &str| {
        let cells: Vec<&str> = line.split(',').collect();
        Row {
            number: cells[number].parse().unwrap(),
            frequencies_hz: frequencies.iter().map(|c| cells[*c].parse().ok()).collect(),
        }
    };
    lines.map(row).collect()
}

/// The estimate of the parameters from some rows, by weighted least squares on the logarithms of the mean frequencies.
///
/// Gauss–Newton with the noise of the structure file; a parameter whose error is above a half of the prior's standard deviation is
/// not informed.
pub fn estimate(simulator: &Simulator, rows: &[Row], at: Timestamp) -> BatchEstimate {
    let (d, modes) = (simulator.space().len(), simulator.modes());
    let mut theta = middle(simulator);
    let means: Vec<(f64, f64)> = (0..modes)
        .map(|mode| {
            let own: Vec<f64> = rows.iter().filter_map(|row| row.frequencies_hz[mode]).map(f64::ln).collect();
            (own.iter().sum::<f64>() / own.len() as f64, own.len() as f64)
        })
        .collect();
    let prior = |k: usize| {
        let parameter = &simulator.space().as_slice()[k];
        (parameter.upper - parameter.lower) / 12.0_f64.sqrt()
    };
    let mut covariance = DMatrix::zeros(d, d);
    for _ in 0..10 {
        let response = simulator.respond(&theta, modes, &[], &[]).unwrap();
        let mut information = DMatrix::from_fn(d, d, |i, j| if i == j { 1e-4 / prior(i).powi(2) } else { 0.0 });
        let mut score = DVector::zeros(d);
        for (mode, (mean, count)) in means.iter().enumerate().filter(|(_, (_, count))| *count > 0.0) {
            let f = response.frequencies_hz[mode];
            let noise = simulator.std_hz(mode, f) / f;
            let slope = response.by_parameter.row(mode).transpose() / f;
            score += &slope * ((mean - f.ln()) * count / noise.powi(2));
            information += &slope * slope.transpose() * (count / noise.powi(2));
        }
        covariance = information.try_inverse().unwrap();
        let step = &covariance * score;
        theta.iter_mut().zip(step.iter()).for_each(|(theta, step)| *theta += step);
    }
    let informed = |k: usize| covariance[(k, k)].sqrt() < 0.5 * prior(k);
    BatchEstimate {
        at,
        mean: (0..d).map(|k| informed(k).then_some(theta[k])).collect(),
        covariance: covariance.transpose().as_slice().to_vec(),
        covariates: Vec::new(),
        frequencies: Some(frequencies(simulator, &means)),
    }
}

/// The middle of the priors.
fn middle(simulator: &Simulator) -> Vec<f64> {
    simulator.space().iter().map(|p| f64::midpoint(p.lower, p.upper)).collect()
}

/// ln of mean measured over simulated frequency of each mode, from mean and number of the logarithms.
fn frequencies(simulator: &Simulator, means: &[(f64, f64)]) -> MeanFrequencies {
    let usual = simulator.frequencies_hz(&middle(simulator)).unwrap();
    let noise = |f: f64| simulator.std_hz(0, f) / f;
    let of = |((mean, count), usual): (&(f64, f64), &f64)| (*count > 0.0).then(|| mean - usual.ln());
    let variance = |((_, count), usual): (&(f64, f64), &f64)| noise(*usual).powi(2) / count.max(1.0);
    MeanFrequencies {
        ln_ratio: means.iter().zip(&usual).map(of).collect(),
        variance: means.iter().zip(&usual).map(variance).collect(),
    }
}

/// ∂ ln f/∂parameter at the middle of the priors, `[modes, d]`.
pub fn effects(simulator: &Simulator) -> DMatrix<f64> {
    let response = simulator.respond(&middle(simulator), simulator.modes(), &[], &[]).unwrap();
    DMatrix::from_fn(simulator.modes(), simulator.space().len(), |mode, k| {
        response.by_parameter[(mode, k)] / response.frequencies_hz[mode]
    })
}

/// The estimate after the parameters have changed by `change`: parameters and, to first order, frequencies.
pub fn changed(simulator: &Simulator, estimate: &BatchEstimate, change: &[f64]) -> BatchEstimate {
    let mut changed = estimate.clone();
    for (mean, change) in changed.mean.iter_mut().zip(change) {
        *mean = mean.map(|mean| mean + change);
    }
    let shift = effects(simulator) * DVector::from_column_slice(change);
    if let Some(frequencies) = &mut changed.frequencies {
        for (ratio, shift) in frequencies.ln_ratio.iter_mut().zip(shift.iter()) {
            *ratio = ratio.map(|ratio| ratio + shift);
        }
    }
    changed
}
