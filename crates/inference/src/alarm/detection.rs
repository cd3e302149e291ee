//! Performance of the charts: false alarms, delay of detection, and the loss that is detected with 90 % probability.

use rand::Rng as _;
use rand_distr::{ChiSquared, StandardNormal};
use rayon::prelude::*;
use serde::Serialize;

use super::chart::{ChartPoint, Series};
use super::limits::{Limits, Situation};
use super::machine::State;
use super::AlarmSettings;
use structures::stats::{self, Stream};

/// Operations simulated for the run length to a false alarm.
const HEALTHY_OPERATIONS: usize = 400;
/// Fewest of them, where the runs are long, and the number of batches of all together that decides.
const FEWEST_OPERATIONS: usize = 40;
const HEALTHY_BATCHES: f64 = 2e7;
/// Longest healthy run that is simulated, in batches.
const LONGEST_HEALTHY: f64 = 5e5;
/// Operations simulated for each size of damage.
const DAMAGED_OPERATIONS: usize = 1_000;
/// Healthy runs are cut at this many times the target run length.
const LONGEST: f64 = 5.0;
/// Healthy batches before the damage, so that the moving average is stationary.
const BEFORE: usize = 15;
/// Runs to an alarm are cut at this many batches.
const LONGEST_WAIT: usize = 300;
/// Simulated shifts, in standard errors of a batch.
const SHIFTS: [f64; 22] = [
    0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 5.5, 6.0, 7.0, 8.0, 9.0, 10.0, 12.0,
];

/// How well the charts of a structure detect a shift of one parameter.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Detection {
    /// Mean number of healthy batches to the first false alarm, each operation with its own undamaged reference; runs are cut at
    /// five times the target, and at 500,000 batches.
    pub healthy_run_batches: f64,
    /// Its standard error.
    pub healthy_run_error: f64,
    /// One entry for each shift.
    pub curve: Vec<DetectionPoint>,
}

/// Detection of one size of damage.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DetectionPoint {
    /// Shift of the mean, in standard errors of the comparison of a batch with the undamaged reference.
    pub shift: f64,
    /// Probability of an alarm with the first damaged batch.
    pub first_batch: f64,
    /// Probability of an alarm within the given number of batches.
    pub within: f64,
    /// Mean number of damaged batches to the alarm (ARL1), each cut at 300.
    pub mean_run: f64,
    /// Median number of damaged batches to the alarm.
    pub median_run: f64,
}

impl Detection {
    /// Smallest shift that is detected within the given number of batches with this probability, interpolated, in standard errors;
    /// `None` when even the largest simulated shift is not.
    pub fn shift_found(&self, probability: f64) -> Option<f64> {
        let behind = self.curve.iter().position(|p| p.within >= probability)?;
        let (Some(before), after) = (behind.checked_sub(1).map(|i| &self.curve[i]), &self.curve[behind]) else {
            return Some(self.curve[behind].shift);
        };
        let part = (probability - before.within) / (after.within - before.within).max(1e-12);
        Some(before.shift + part * (after.shift - before.shift))
    }

    /// Median number of damaged batches to the alarm for a shift in standard errors, interpolated; `None` where it is as long as a run is
    /// simulated.
    pub fn median_run_of(&self, shift: f64) -> Option<f64> {
        let (before, run) = self.interpolated(shift, |p| p.median_run);
        (before < LONGEST_WAIT as f64).then_some(run)
    }

    /// Probability of an alarm within the given number of batches for a shift in standard errors, interpolated.
    pub fn probability_within(&self, shift: f64) -> f64 {
        self.interpolated(shift, |p| p.within).1
    }

    /// A value of the curve at the simulated shift before this one, and interpolated at it.
    fn interpolated(&self, shift: f64, of: impl Fn(&DetectionPoint) -> f64) -> (f64, f64) {
        let behind = self.curve.iter().position(|p| p.shift >= shift).unwrap_or(self.curve.len() - 1);
        let (before, after) = (&self.curve[behind.saturating_sub(1)], &self.curve[behind]);
        let part = ((shift - before.shift) / (after.shift - before.shift).max(1e-12)).clamp(0.0, 1.0);
        (of(before), of(before) + part * (of(after) - of(before)))
    }
}

/// What the charts are asked for.
#[derive(Debug, Clone, Copy)]
pub struct Wanted {
    /// Mean number of healthy batches to a false alarm.
    pub run_batches: f64,
    /// Number of damaged batches within which an alarm is wanted.
    pub within: usize,
}

/// Simulates healthy and damaged operation with given limits.
pub fn detection(
    situation: Situation,
    limits: &Limits,
    settings: &AlarmSettings,
    Wanted { run_batches, within: batches }: Wanted,
    seed: u64,
) -> Detection {
    let longest = (LONGEST * run_batches).min(LONGEST_HEALTHY) as usize;
    let operations = ((HEALTHY_BATCHES / longest as f64) as usize).clamp(FEWEST_OPERATIONS, HEALTHY_OPERATIONS);
    let healthy = |operation: usize| {
        let mut stream = stats::stream(seed, &format!("healthy operation {operation}"));
        let mut operation = Operation::new(situation, settings, &mut stream);
        (1..=longest).find(|_| operation.next(0.0, limits, &mut stream)).unwrap_or(longest) as f64
    };
    let runs: Vec<f64> = (0..operations).into_par_iter().map(healthy).collect();
    let damaged = |shift: f64| {
        let one = |operation: usize| {
            let mut stream = stats::stream(seed, &format!("damaged operation {operation}, shift {shift}"));
            let mut operation = Operation::new(situation, settings, &mut stream);
            // An operation with an alarm before the damage is left out, because it does not show whether the damage is detected.
            let quiet = (0..BEFORE).all(|_| !operation.next(0.0, limits, &mut stream));
            quiet.then(|| {
                (1..=LONGEST_WAIT).find(|_| operation.next(shift, limits, &mut stream)).unwrap_or(LONGEST_WAIT)
            })
        };
        let runs: Vec<f64> = (0..DAMAGED_OPERATIONS).into_par_iter().filter_map(one).map(|run| run as f64).collect();
        let share = |most: usize| runs.iter().filter(|run| **run <= most as f64).count() as f64 / runs.len() as f64;
        DetectionPoint {
            shift,
            first_batch: share(1),
            within: share(batches),
            mean_run: stats::mean(&runs),
            median_run: stats::quantile(&runs, 0.5),
        }
    };
    Detection {
        healthy_run_batches: stats::mean(&runs),
        healthy_run_error: stats::sample_std(&runs).unwrap_or(f64::NAN) / (runs.len() as f64).sqrt(),
        curve: SHIFTS.into_iter().map(damaged).collect(),
    }
}

/// A structure in operation: its charts, and the errors of its undamaged reference.
struct Operation {
    charts: Vec<(f64, f64, Series)>,
    own: f64,
}

impl Operation {
    fn new(situation: Situation, settings: &AlarmSettings, stream: &mut Stream) -> Self {
        let degrees = situation.degrees_of_freedom.max(1) as f64;
        let chi_squared = ChiSquared::new(degrees).expect("degrees of freedom are positive");
        let chart = |_| {
            let e: f64 = stream.sample(StandardNormal);
            let s = (stream.sample(chi_squared) / degrees).sqrt();
            (situation.shared.sqrt() * e, s, Series::new(*settings))
        };
        Self { charts: (0..situation.charts.max(1)).map(chart).collect(), own: (1.0 - situation.shared).sqrt() }
    }

    /// Adds a batch in which the first parameter is shifted; true when some chart raises an alarm.
    fn next(&mut self, shift: f64, limits: &Limits, stream: &mut Stream) -> bool {
        let mut alarm = false;
        for (index, (shared, s, series)) in self.charts.iter_mut().enumerate() {
            let damage = if index == 0 { shift } else { 0.0 };
            let z = (*shared + self.own * stream.sample::<f64, _>(StandardNormal) + damage) / *s;
            alarm |= series.take(&ChartPoint::damage(z, limits, false)).state == State::Alarming;
        }
        alarm
    }
}

#[cfg(test)]
mod tests {
    use super::super::limits::limits;
    use super::*;

    #[test]
    fn healthy_operation_runs_as_long_as_wanted_and_larger_shifts_are_found_sooner() {
        let settings = AlarmSettings::default();
        let situation = Situation { shared: 0.1, degrees_of_freedom: 99, charts: 2 };
        let found = detection(
            situation,
            &limits(situation, &settings, 150.0),
            &settings,
            Wanted { run_batches: 150.0, within: 3 },
            7,
        );
        // Runs are longer than wanted where the undamaged reference is not known well (a share of 0.1 here), never shorter; 400
        // runs are known to 5 to 7 %.
        assert!((0.85..2.0).contains(&(found.healthy_run_batches / 150.0)), "{}", found.healthy_run_batches);
        let within: Vec<f64> = found.curve.iter().map(|p| p.within).collect();
        assert!(within.windows(2).all(|pair| pair[1] >= pair[0] - 0.05), "{within:?}");
        let found_90 = found.shift_found(0.9).unwrap();
        assert!((2.0..5.0).contains(&found_90), "{found_90}");
        assert!((found.probability_within(found_90) - 0.9).abs() < 1e-9);
    }
}
