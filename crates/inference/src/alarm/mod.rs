//! From assessed batches to alarms: control charts with a known rate of false alarms, and a state machine.
//!
//! A probability of damage above its threshold is an exceedance, and nearly half of the healthy batches exceed. An alarm needs
//! more: [`chart`] compares the mean of a batch with the undamaged reference in units of its standard error, [`limits`] computes
//! the limit that healthy operation reaches once in ARL0 batches (average run length), [`machine`] turns points above the limit
//! into states and episodes, [`severity`] grades them, and [`detection`] computes which losses are detected.

pub mod chart;
pub mod detection;
pub mod limits;
pub mod machine;
pub mod severity;

use serde::{Deserialize, Serialize};

/// Names of the kinds of alarms, as stored and as used in the API.
pub const ALARM_KINDS: [&str; 4] = ["damage", "simulation_does_not_fit", "silence", "not_assessed"];

/// Least mean number of healthy batches to a false alarm that follows from years: a false alarm in every tenth batch of a yearly inspection
/// would be rare in time and useless.
const LEAST_RUN: f64 = 100.0;

/// Greatest one: a batch every 20 s for ten years.
const MOST_RUN: f64 = 1.6e7;

/// The same where the times of the batches of a reference do not tell their rhythm.
const RUN_WITHOUT_RHYTHM: f64 = 1_000.0;

/// How alarms are raised.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AlarmSettings {
    /// Mean number of years between two false alarms of a structure, at the rhythm of the batches of its undamaged reference.
    pub false_alarm_years: f64,
    /// Target mean number of healthy batches to a false alarm, over all parameters of a structure (ARL0), whatever their rhythm. `None`:
    /// it follows from the years.
    pub mean_run_batches: Option<f64>,
    /// With a process behind the undamaged reference, a change that is certainly smaller than this raises no alarm, in per cent of the mean of
    /// the reference; 0: every change does. `None`: as the limit of moderate severity.
    pub smallest_percent: Option<f64>,
    /// Number of points above the limit, among the last `window` points, that raise an alarm.
    pub needed: usize,
    /// Number of consecutive points among which `needed` points must be above the limit.
    pub window: usize,
    /// Weight of the newest batch in the exponentially weighted moving average (EWMA), which detects small lasting losses; 0
    /// switches it off.
    pub ewma_weight: f64,
    /// Consecutive points below the limit that end an alarm.
    pub recovery: usize,
    /// Seconds without a batch after which a structure is reported as silent; 0 switches this off. `None`: learned from the rhythm of its
    /// batches.
    pub silence_after_s: Option<u64>,
}

impl Default for AlarmSettings {
    fn default() -> Self {
        Self {
            false_alarm_years: 10.0,
            mean_run_batches: None,
            smallest_percent: None,
            needed: 1,
            window: 1,
            ewma_weight: 0.2,
            recovery: 3,
            silence_after_s: None,
        }
    }
}

impl AlarmSettings {
    /// Wanted mean number of healthy batches to a false alarm, for a reference with this number of batches a year; `None`: the times of its
    /// batches do not tell.
    ///
    /// ```text
    ///  W = years × batches a year,    at least 100; 1,000 where the rhythm is not known
    /// ```
    pub fn run_batches(&self, batches_per_year: Option<f64>) -> f64 {
        let of_years = |rate: f64| (self.false_alarm_years * rate).clamp(LEAST_RUN, MOST_RUN);
        self.mean_run_batches.unwrap_or_else(|| batches_per_year.map_or(RUN_WITHOUT_RHYTHM, of_years))
    }

    /// The first setting out of range, as (key, value, allowed range); `None` when all are in range.
    pub fn problem(&self) -> Option<(&'static str, String, &'static str)> {
        let Self {
            false_alarm_years, mean_run_batches, smallest_percent, needed, window, ewma_weight, recovery, ..
        } = *self;
        if !(0.01..=1_000.0).contains(&false_alarm_years) {
            return Some(("monitor.alarm.false_alarm_years", false_alarm_years.to_string(), "between 0.01 and 1000"));
        }
        if let Some(run) = mean_run_batches.filter(|run| !(10.0..=1e7).contains(run)) {
            return Some(("monitor.alarm.mean_run_batches", run.to_string(), "between 10 and 10000000"));
        }
        if let Some(percent) = smallest_percent.filter(|percent| !(0.0..=100.0).contains(percent)) {
            return Some(("monitor.alarm.smallest_percent", percent.to_string(), "between 0 and 100"));
        }
        if !(1..=window).contains(&needed) {
            return Some(("monitor.alarm.needed", needed.to_string(), "at least 1 and at most monitor.alarm.window"));
        }
        if window > 20 {
            return Some(("monitor.alarm.window", window.to_string(), "at most 20"));
        }
        if !(0.0..=1.0).contains(&ewma_weight) {
            return Some(("monitor.alarm.ewma_weight", ewma_weight.to_string(), "between 0 and 1"));
        }
        if !(1..=100).contains(&recovery) {
            return Some(("monitor.alarm.recovery", recovery.to_string(), "between 1 and 100"));
        }
        None
    }
}
