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

/// How alarms are raised.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AlarmSettings {
    /// Target mean number of healthy batches to a false alarm, over all parameters of a structure (ARL0).
    pub mean_run_batches: f64,
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
        Self { mean_run_batches: 1_000.0, needed: 1, window: 1, ewma_weight: 0.2, recovery: 3, silence_after_s: None }
    }
}

impl AlarmSettings {
    /// The first setting out of range, as (key, value, allowed range); `None` when all are in range.
    pub fn problem(&self) -> Option<(&'static str, String, &'static str)> {
        let Self { mean_run_batches, needed, window, ewma_weight, recovery, .. } = *self;
        if !(10.0..=1e5).contains(&mean_run_batches) {
            return Some(("monitor.alarm.mean_run_batches", mean_run_batches.to_string(), "between 10 and 100000"));
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
