//! From assessed batches to alarms: charts with a known rate of false alarms, and one table of states.
//!
//! A probability of damage above its threshold is an exceedance, and of healthy batches nearly half exceed. An alarm is
//! something else: [`chart`] sets the mean of a batch against the undamaged state in units of its standard error,
//! [`limits`] finds the limit that healthy operation reaches once in ARL0 batches, [`machine`] turns points above the limit
//! into states and episodes, and [`detection`] says what losses are found.

pub mod chart;
pub mod detection;
pub mod limits;
pub mod machine;

use serde::{Deserialize, Serialize};

/// How alarms are raised.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AlarmSettings {
    /// Wanted mean run of healthy batches to a false alarm, over all parameters of a structure (ARL0).
    pub mean_run_batches: f64,
    /// Points above the limit that make an alarm …
    pub needed: usize,
    /// … among this many points in a row.
    pub window: usize,
    /// Weight of the newest batch in the moving average that finds small lasting losses (EWMA); 0 switches it off.
    pub ewma_weight: f64,
    /// Points in a row below the limit that end an alarm.
    pub recovery: usize,
    /// Seconds without a batch after which a structure counts as silent; 0 switches it off.
    pub silence_after_s: u64,
}

impl Default for AlarmSettings {
    fn default() -> Self {
        Self { mean_run_batches: 1_000.0, needed: 1, window: 1, ewma_weight: 0.2, recovery: 3, silence_after_s: 0 }
    }
}

impl AlarmSettings {
    /// What must hold for the settings, as (key, value, what is right); `None` when all is well.
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
