//! Alarms of healthy and of damaged structures, with measurements that went through the flow.

use modalwatch::alarm::chart::{shift, standard_error, variance_of_mean, ChartPoint, Series};
use modalwatch::alarm::limits::{limits, Limits, Situation};
use modalwatch::alarm::machine::State;
use modalwatch::alarm::AlarmSettings;
use modalwatch::baseline::observation::Observation;
use modalwatch::baseline::Baseline;
use modalwatch::damage::ChartReference;
use modalwatch::parameter::DamageDirection;
use modalwatch::simulator::population::Population;
use modalwatch::stats::{self, Stream};
use rand::Rng as _;

use super::population::TABLE_2;
use super::shipped;

/// Posterior mean and variance of each parameter of many measurements of one population: `[measurement][parameter]`.
struct Bank {
    means: Vec<Vec<f64>>,
    variances: Vec<Vec<f64>>,
}

fn bank(baseline: &Baseline, moments: &[(f64, f64)], count: usize, seed: u64) -> Bank {
    let named: Vec<(String, f64, f64)> =
        baseline.space().iter().zip(moments).map(|(p, (mean, std))| (p.name.clone(), *mean, *std)).collect();
    let population = Population::new(baseline.space(), &named).unwrap();
    let drawn = population.draw(baseline.simulator(), count, 1.0, seed).unwrap();
    let rows = drawn.frequencies_hz.row_iter();
    let observations: Vec<Observation> =
        rows.map(|row| Observation::complete(&row.iter().copied().collect::<Vec<_>>())).collect();
    // The service pools as many.
    let draws = 10;
    let samples = baseline.infer(&observations, draws, seed).unwrap();
    let columns: Vec<Vec<f64>> = (0..moments.len()).map(|k| samples.column(k)).collect();
    let chunk = |k: usize, i: usize| &columns[k][i * draws..(i + 1) * draws];
    let variance = |values: &[f64]| {
        let centre = stats::mean(values);
        values.iter().map(|x| (x - centre).powi(2)).sum::<f64>() / values.len() as f64
    };
    Bank {
        means: (0..count).map(|i| (0..moments.len()).map(|k| stats::mean(chunk(k, i))).collect()).collect(),
        variances: (0..count).map(|i| (0..moments.len()).map(|k| variance(chunk(k, i))).collect()).collect(),
    }
}

impl Bank {
    /// Mean of the means, their standard deviation and mean variance over some drawn measurements.
    fn batch(&self, size: usize, k: usize, rows: &[usize]) -> (f64, f64, f64) {
        let means: Vec<f64> = rows[..size].iter().map(|&i| self.means[i][k]).collect();
        let within = rows[..size].iter().map(|&i| self.variances[i][k]).sum::<f64>() / size as f64;
        (stats::mean(&means), stats::sample_std(&means).unwrap(), within)
    }

    fn rows(&self, size: usize, stream: &mut Stream) -> Vec<usize> {
        (0..size).map(|_| stream.random_range(0..self.means.len())).collect()
    }
}

fn error(reference: &ChartReference, within: f64, size: usize) -> f64 {
    standard_error(reference, variance_of_mean(reference, within, size as f64), size as f64)
}

struct Operation {
    references: Vec<ChartReference>,
    series: Vec<Series>,
    limits: Limits,
}

impl Operation {
    fn new(
        bank: &Bank,
        charts: usize,
        size: usize,
        baseline: usize,
        known: &mut Option<Limits>,
        stream: &mut Stream,
    ) -> Self {
        let settings = AlarmSettings::default();
        let rows = bank.rows(baseline, stream);
        let reference = |k: usize| {
            let (mean, std, within) = bank.batch(baseline, k, &rows);
            ChartReference::of_one_batch(mean, std, within, baseline)
        };
        let references: Vec<ChartReference> = (0..charts).map(reference).collect();
        let error = error(&references[0], references[0].within, size);
        let shared = references[0].std.powi(2) / baseline as f64 / error.powi(2);
        let situation = Situation { shared, degrees_of_freedom: baseline - 1, charts };
        let limits = *known.get_or_insert_with(|| limits(situation, &settings, 1_000.0));
        Self { references, series: vec![Series::new(settings); charts], limits }
    }

    /// Whether the batch raises an alarm.
    fn take(&mut self, bank: &Bank, size: usize, stream: &mut Stream) -> bool {
        let rows = bank.rows(size, stream);
        let mut alarm = false;
        for (k, (reference, series)) in self.references.iter().zip(&mut self.series).enumerate() {
            let (mean, _, within) = bank.batch(size, k, &rows);
            let z = shift(reference, DamageDirection::Decrease, mean, error(reference, within, size)).unwrap();
            alarm |= series.take(&ChartPoint::damage(z, &self.limits, false)).state == State::Alarming;
        }
        alarm
    }
}

#[test]
fn without_damage_the_mean_run_to_a_false_alarm_is_as_required() {
    for (id, moments) in [("three-dof", &TABLE_2[..]), ("rig", &[(0.0475, 0.004), (0.0475, 0.004)][..])] {
        let baseline = shipped(id);
        let healthy = bank(&baseline, moments, 60_000, 1);
        for size in [5, 20, 50] {
            let (operations, longest) = (75, 10_000);
            let mut stream = stats::stream(size as u64, "test: healthy operation");
            let (mut runs, mut known) = (Vec::new(), None);
            for _ in 0..operations {
                // An undamaged reference of a hundred batches: with fewer the mean run is longer, by design.
                let mut operation = Operation::new(&healthy, moments.len(), size, 100 * size, &mut known, &mut stream);
                let run = (1..=longest).find(|_| operation.take(&healthy, size, &mut stream)).unwrap_or(longest);
                runs.push(f64::from(run));
            }
            let (mean, error) = (stats::mean(&runs), stats::sample_std(&runs).unwrap() / f64::from(operations).sqrt());
            println!("{id}, batches of {size}: mean run to a false alarm {mean:.0} ± {error:.0} batches (wanted 1000)");
            // 75 runs scatter by `error`, about 100 to 230 batches. The limits aim at 1,000; what they reach is 1,180 ± 31 (with 150 runs, mean of
            // the six cases here), because an undamaged reference of a hundred batches still lengthens the runs. Three standard
            // errors below the nominal value and above the reached one.
            let (least, most) = (1_000.0 - 3.0 * error, 1_180.0 + 3.0 * error);
            assert!((least..=most).contains(&mean), "{id}, {size}: {mean} ± {error}");
        }
    }
}

#[test]
fn a_tenth_less_of_k1_is_alarmed_within_three_batches() {
    let baseline = shipped("three-dof");
    let healthy = bank(&baseline, &TABLE_2, 20_000, 1);
    let damaged = bank(&baseline, &[(3.6, 0.3), (5.0, 0.1), (6.0, 0.2)], 20_000, 2);
    let (mut stream, mut known, size) = (stats::stream(3, "test: damaged operation"), None, 20);
    let (mut runs, mut naive_healthy) = (Vec::new(), 0);
    let operations = 300;
    for _ in 0..operations {
        let mut operation = Operation::new(&healthy, 3, size, 100, &mut known, &mut stream);
        for _ in 0..10 {
            operation.take(&healthy, size, &mut stream);
        }
        let run = (1..=50).find(|_| operation.take(&damaged, size, &mut stream)).unwrap_or(50);
        runs.push(f64::from(run));
        // The rule of the paper on an undamaged batch: for some parameter, more than 5 % of the measurements are below δ.
        let rows = healthy.rows(size, &mut stream);
        let beyond = |k: usize| {
            let delta = operation.references[k].mean - 1.645 * operation.references[k].std;
            rows.iter().filter(|&&i| healthy.means[i][k] < delta).count() as f64 / size as f64
        };
        naive_healthy += usize::from((0..3).any(|k| beyond(k) > 0.05));
    }
    let naive = naive_healthy as f64 / f64::from(operations);
    println!(
        "k1 − 10 %, batches of 20: median {} batches to the alarm, 90 % within {}; the rule \"PoD above 5 %\" alarms in {:.0} % \
         of undamaged batches",
        stats::quantile(&runs, 0.5),
        stats::quantile(&runs, 0.9),
        100.0 * naive
    );
    // Nine of ten alarms come with the first batch; the 90 % quantile of 300 runs is then 1 or 2.
    assert!(stats::quantile(&runs, 0.9) <= 3.0);
    // 20 measurements of which at least 2 are below the 5 % quantile: 0.26 for one parameter, 0.60 for three that are
    // independent, and more as the quantile is itself estimated, from 100: 0.65. A share of 300 scatters by 0.028: four times
    // that about 0.65.
    assert!((0.54..=0.76).contains(&naive), "{naive}");
}
