//! Posteriors of the shipped models compared with the exact posterior, and the population behind a batch.

mod alarms;
mod common_factor;
mod coverage;
mod dependence;
mod exact;
mod identifiability;
mod instrument;
mod manners;
mod noise;
mod parts;
mod population;
mod priors;
mod thin;
mod trust;

use std::sync::Arc;

use modalwatch::baseline::library::Library;
use modalwatch::baseline::observation::{measure, Observation};
use modalwatch::baseline::Baseline;
use modalwatch::quantity::StructureId;
use modalwatch::stats;
use rand::Rng as _;
use statrs::distribution::{ChiSquared, ContinuousCDF as _};

fn shipped(id: &str) -> Arc<Baseline> {
    let library = Library::open(None).unwrap();
    library.get(&StructureId::parse(id).unwrap()).unwrap().baseline.clone().unwrap()
}

/// Simulated measurements from the prior: parameters and observations.
fn prior_measurements(
    baseline: &Baseline,
    count: usize,
    multiple: f64,
    missing: Option<usize>,
    seed: u64,
) -> (Vec<Vec<f64>>, Vec<Observation>) {
    let set = baseline.simulator().training_set(count, seed).unwrap();
    let mut stream = exact::stream(seed);
    let mut one = |row: usize| {
        let f: Vec<f64> = set.frequencies_hz.row(row).iter().copied().collect();
        let multiples: Vec<Option<f64>> = (0..f.len()).map(|i| (Some(i) != missing).then_some(multiple)).collect();
        measure(baseline.simulator(), &f, &[], &multiples, &mut stream)
    };
    let observations = (0..count).map(&mut one).collect();
    (set.theta.row_iter().map(|r| r.iter().copied().collect()).collect(), observations)
}

/// Mean over 100 measurements of |mean − exact mean| and |std/exact std − 1|, in exact standard deviations, by parameter.
fn disagreement(baseline: &Baseline, relative_std: f64, starts: usize, draws: usize) -> Vec<(f64, f64)> {
    let own = baseline.simulator().noise().std_hz(1.0);
    let count = 50;
    let (_, observations) = prior_measurements(baseline, count, relative_std / own, None, 4_711);
    // The Monte Carlo error, 0.8 standard deviations over the root of the number of draws, is part of the disagreement.
    let samples = baseline.infer(&observations, draws, 1).unwrap();
    let mut stream = exact::stream(1);
    let d = baseline.space().len();
    let mut sums = vec![(0.0, 0.0); d];
    let mut poor = 0;
    for (row, observation) in observations.iter().enumerate() {
        let truth =
            exact::posterior(baseline.simulator(), &observation.frequencies_hz, relative_std, starts, &mut stream);
        poor += usize::from(truth.effective < 1_000.0);
        for (k, sum) in sums.iter_mut().enumerate() {
            let own = &samples.column(k)[row * draws..(row + 1) * draws];
            sum.0 += (stats::mean(own) - truth.mean[k]).abs() / truth.std[k] / count as f64;
            sum.1 += (stats::sample_std(own).unwrap() / truth.std[k] - 1.0).abs() / count as f64;
        }
    }
    assert!(poor <= 3, "the reference is inaccurate for {poor} of {count} measurements");
    sums
}

#[test]
fn posteriors_agree_with_the_exact_ones() {
    // Structure, starting points of the search per axis, noise levels. A measurement of the rig often has a second mode
    // nearby, and up to 1 % of the draws of the flow alone are in spurious modes, which resampling must remove.
    let cases = [("three-dof", 3, [0.0001, 0.001, 0.005]), ("rig", 8, [0.0005, 0.005, 0.02])];
    for (id, starts, levels) in cases {
        let baseline = shipped(id);
        for relative_std in levels {
            let sums = disagreement(&baseline, relative_std, starts, 10_000);
            let mean = |part: fn(&(f64, f64)) -> f64| sums.iter().map(part).sum::<f64>() / sums.len() as f64;
            let (means, stds) = (mean(|s| s.0), mean(|s| s.1));
            println!("{id} at {} %: mean off by {means:.3}, std by {stds:.3} exact standard deviations; by parameter {sums:.3?}", 100.0 * relative_std);
            assert!(means <= 0.05 && stds <= 0.05, "{id} at {relative_std}: {means}, {stds}");
        }
    }
}

/// Noise of twice to six times what the models were trained for: the flow proposes as for the largest trained noise, wider in proportion, and
/// the draws are weighted by the likelihood of the stated noise. Such posteriors end at the bounds of the prior, where many of the searches
/// do not find enough effective draws and keep flattened weights; how far that is from the exact posterior is printed.
#[test]
#[ignore = "prints figures and checks nothing"]
fn posteriors_of_noise_beyond_the_training_beside_the_exact_ones() {
    for relative_std in [0.01, 0.03] {
        let sums = disagreement(&shipped("three-dof"), relative_std, 3, 2_000);
        let mean = |part: fn(&(f64, f64)) -> f64| sums.iter().map(part).sum::<f64>() / sums.len() as f64;
        let (means, stds) = (mean(|s| s.0), mean(|s| s.1));
        println!("{} %: mean off by {means:.3}, std by {stds:.3} exact standard deviations", 100.0 * relative_std);
    }
}

/// p-value of χ² that counts 0..=draws are uniform, in 20 bins.
fn uniform(ranks: &[usize], draws: usize) -> f64 {
    let mut counts = [0.0; 20];
    for rank in ranks {
        counts[rank * 20 / (draws + 1)] += 1.0;
    }
    let expected = ranks.len() as f64 / 20.0;
    let statistic: f64 = counts.iter().map(|c| (c - expected).powi(2) / expected).sum();
    ChiSquared::new(19.0).unwrap().sf(statistic)
}

#[test]
fn intervals_of_single_measurements_cover_and_ranks_are_uniform() {
    let (draws, count) = (99, 1_500);
    let (mut p_values, mut lowest, mut highest) = (Vec::new(), 1.0_f64, 0.0_f64);
    for (id, multiples) in [("three-dof", [0.2, 1.0, 5.0]), ("rig", [0.2, 1.0, 4.0])] {
        let baseline = shipped(id);
        let space = baseline.space().as_slice();
        for multiple in multiples {
            for missing in [None, Some(0), Some(1), Some(2)] {
                let seed = 77 + (multiple * 10.0) as u64 + missing.map_or(0, |m| 1_000 * (m as u64 + 1));
                let (theta, observations) = prior_measurements(&baseline, count, multiple, missing, seed);
                let samples = baseline.infer(&observations, draws, seed).unwrap();
                let unit = |row: usize, k: usize| space[k].to_unit(samples.theta()[(row, k)]);
                let mut stream = exact::stream(seed + 1);
                let (mut tarp, mut line) = (Vec::new(), Vec::new());
                for (i, truth) in theta.iter().enumerate() {
                    let far: Vec<f64> = (0..space.len()).map(|_| stream.random::<f64>()).collect();
                    let distance = |at: &dyn Fn(usize) -> f64| {
                        far.iter().enumerate().map(|(k, r)| (at(k) - r).powi(2)).sum::<f64>()
                    };
                    let own = distance(&|k| space[k].to_unit(truth[k]));
                    tarp.push((i * draws..(i + 1) * draws).filter(|row| distance(&|k| unit(*row, k)) < own).count());
                }
                p_values.push(uniform(&tarp, draws));
                for k in 0..space.len() {
                    let rank = |(i, truth): (usize, &Vec<f64>)| {
                        let x = space[k].to_unit(truth[k]);
                        (i * draws..(i + 1) * draws).filter(|row| unit(*row, k) < x).count()
                    };
                    let ranks: Vec<usize> = theta.iter().enumerate().map(rank).collect();
                    // Of 100 equally probable ranks, 5 ..= 94 are those inside the central 90 %.
                    let covered = ranks.iter().filter(|rank| (5..=94).contains(*rank)).count() as f64 / count as f64;
                    (lowest, highest) = (lowest.min(covered), highest.max(covered));
                    p_values.push(uniform(&ranks, draws));
                    line.push(format!("{} {covered:.3}", space[k].name));
                    // The standard error of the share with 1,500 simulations is 0.0077.
                    assert!(
                        (0.87..=0.93).contains(&covered),
                        "{id} × {multiple}, missing {missing:?}, {}: {covered}",
                        space[k].name
                    );
                }
                println!("{id} noise × {multiple}, missing {missing:?}: 90 % intervals cover {}", line.join(", "));
            }
        }
    }
    let smallest = p_values.iter().copied().fold(1.0, f64::min);
    println!(
        "coverage {lowest:.3} to {highest:.3}; smallest of {} p-values of ranks and TARP: {smallest:.4}",
        p_values.len()
    );
    // Uniform ranks everywhere are not rejected at 1 % (Bonferroni over all tests).
    assert!(smallest * p_values.len() as f64 > 0.01, "{smallest}");
}
