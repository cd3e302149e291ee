//! Control charts: the distance of a batch mean from the undamaged reference in standard errors, and its moving average.

use serde::Serialize;

use super::limits::{Limits, CLIP};
use super::machine::{Event, State};
use super::AlarmSettings;
use crate::damage::{ChartReference, UndamagedQuantity};
use crate::process::lasting::LastingChange;
use structures::parameter::DamageDirection;
use structures::stats;

/// Smallest variance of a measurement in a batch, as a share of the undamaged variance, even if its measurements state a very small
/// noise.
const LEAST_VARIANCE: f64 = 0.1;

/// Series of the chart of the simulation's fit; no parameter can have a colon in its name.
pub const FIT_SERIES: &str = "simulation:fit";

/// The parameter or the group of parameters that a chart belongs to; `None` for charts of the structure as a whole, whose names begin
/// with `structure:` or `simulation:`.
pub fn parameter_of(series: String) -> Option<String> {
    (!series.starts_with("structure:") && !series.starts_with("simulation:")).then_some(series)
}

/// The parameter that an alarm of a series is about: the only one that has certainly changed, or without a lasting change that of its chart.
pub fn parameter_of_alarm(series: &str, change: Option<&LastingChange>) -> Option<String> {
    change.map_or_else(|| parameter_of(series.to_owned()), |change| change.only().map(str::to_owned))
}

/// The point of a batch on the chart of one series, before the neighbouring points in time are known.
#[derive(Debug, Clone, PartialEq)]
pub struct ChartPoint {
    /// Shift towards damage, in standard errors; for the fit, 1 when rejected and 0 otherwise.
    pub shift: f64,
    /// Limit of a single shift.
    pub limit: f64,
    /// Limit of the moving average, or of the slow chart of a process.
    pub ewma_limit: f64,
    /// Evidence on the slow chart of a process, which takes the place of the moving average; `None` on other charts.
    pub slow: Option<f64>,
    /// True when the batch does not enter the chart.
    pub held: bool,
}

/// The state of a series after a point.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ChartStatus {
    /// Moving average of the shifts up to this point.
    pub ewma: f64,
    /// True when shift or moving average is above its limit.
    pub above: bool,
    /// State after this point.
    pub state: State,
}

/// Shift of a batch towards damage.
///
/// ```text
///  z = ±(μ_ud − x̄)/se
/// ```
///
/// x̄: mean of the batch (`mean`); se: standard error of its difference from the reference (`error`), see [`standard_error`].
///
/// `None` when no change of the quantity indicates damage or the undamaged reference has no scatter.
pub fn shift(reference: &ChartReference, direction: DamageDirection, mean: f64, error: f64) -> Option<f64> {
    let towards = match direction {
        DamageDirection::Decrease => 1.0,
        DamageDirection::Increase => -1.0,
        DamageDirection::None => return None,
    };
    (error > 0.0 && error.is_finite()).then(|| towards * (reference.mean - mean) / error)
}

/// Standard error of the difference between the mean of a batch and the undamaged reference, in the quantity's unit.
///
/// ```text
///  se² = v + τ² + s²/n_ud + τ²/B
/// ```
///
/// v: variance of the error of the mean of the batch (`of_mean`), unit², at least a tenth of s²/n; s²: variance of a
/// measurement in the undamaged reference (worth n_ud independent ones, in B batches); τ: standard deviation between batches. The batch is
/// worth n independent measurements (`measurements`).
pub fn standard_error(reference: &ChartReference, of_mean: f64, measurements: f64) -> f64 {
    let least = LEAST_VARIANCE * reference.std.powi(2) / measurements;
    let between = reference.between_batches_std.powi(2);
    (of_mean.max(least) + between + undamaged_variance(reference)).sqrt()
}

/// Variance of the error of the mean of a batch that is worth n independent measurements, unit², where only its samples are known.
///
/// ```text
///  v = (s² + w − w_ud)/n
/// ```
///
/// w and w_ud: mean posterior variance of a measurement in the batch and in the reference. The spread of the batch itself does not enter,
/// because few measurements hardly determine it.
pub fn variance_of_mean(reference: &ChartReference, within: f64, measurements: f64) -> f64 {
    (reference.std.powi(2) + within - reference.within) / measurements
}

/// Share ρ in [0, 1] of the square of a [`standard_error`] that comes from the undamaged reference and is the same in all batches.
pub fn shared(reference: &ChartReference, error: f64) -> f64 {
    (undamaged_variance(reference) / error.powi(2)).clamp(0.0, 1.0)
}

fn undamaged_variance(reference: &ChartReference) -> f64 {
    let between = reference.between_batches_std.powi(2);
    reference.std.powi(2) / reference.independent() + between / reference.batches.max(1) as f64
}

/// The limit of the chart expressed as a probability of damage: that of a batch whose mean lies on the limit and whose spread is
/// the undamaged one. `error`: [`standard_error`]. `None` when the quantity has no damage threshold.
pub fn probability_limit(quantity: &UndamagedQuantity, limit: f64, error: f64) -> Option<f64> {
    let threshold = quantity.threshold?;
    let distance = (quantity.mean - threshold).abs() / quantity.std;
    let moved = limit * error / quantity.std;
    Some(stats::normal_cdf(moved - distance))
}

/// A series of points in the order of their measurement.
#[derive(Debug, Clone)]
pub struct Series {
    settings: AlarmSettings,
    ewma: f64,
    /// Whether the last points were above a limit, the newest last.
    recent: Vec<bool>,
    state: State,
}

impl Series {
    /// A series without points.
    pub fn new(settings: AlarmSettings) -> Self {
        Self { settings, ewma: 0.0, recent: Vec::new(), state: State::Normal }
    }

    /// A series that continues after stored points: the moving average and state of the last, and whether the last ones were
    /// above a limit, the newest last.
    pub fn resume(settings: AlarmSettings, ewma: f64, state: State, recent: Vec<bool>) -> Self {
        Self { settings, ewma, recent, state }
    }

    /// Number of previous points that [`Self::resume`] needs.
    pub fn memory(settings: &AlarmSettings) -> usize {
        settings.window.max(settings.recovery)
    }

    /// Adds the next point of the series and returns the status after it.
    pub fn take(&mut self, point: &ChartPoint) -> ChartStatus {
        if point.held {
            return ChartStatus { ewma: self.ewma, above: false, state: self.state };
        }
        let weight = self.settings.ewma_weight;
        let moved = (1.0 - weight) * self.ewma + weight * point.shift.clamp(-CLIP, CLIP);
        self.ewma = point.slow.unwrap_or(moved);
        let lasting = (weight > 0.0 || point.slow.is_some()) && self.ewma > point.ewma_limit;
        let single = point.shift > point.limit;
        let above = single || lasting;
        self.recent.push(above);
        let memory = Self::memory(&self.settings);
        if self.recent.len() > memory {
            self.recent.remove(0);
        }
        let near = self.recent.iter().rev().take(self.settings.window).filter(|a| **a).count();
        let clear = self.recent.iter().rev().take_while(|a| !**a).count();
        // The moving average includes earlier points already, so it needs no second point above its limit.
        let event = match above {
            true if lasting || near >= self.settings.needed => Event::Confirmed,
            true => Event::Exceeds,
            false if clear >= self.settings.recovery => Event::Cleared,
            // A point above the limit that no other point confirmed has no effect any more once it has left the window.
            false if near == 0 && !self.state.in_episode() => Event::Cleared,
            false => Event::Clears,
        };
        self.state = self.state.after(event);
        ChartStatus { ewma: self.ewma, above, state: self.state }
    }
}

impl ChartPoint {
    /// A point of a damage chart.
    pub fn damage(shift: f64, limits: &Limits, held: bool) -> Self {
        Self { shift, limit: limits.single, ewma_limit: limits.ewma, slow: None, held }
    }

    /// A point of the chart of the simulation's fit.
    pub fn fit(rejected: bool) -> Self {
        Self { shift: f64::from(u8::from(rejected)), limit: 0.5, ewma_limit: f64::INFINITY, slow: None, held: false }
    }
}

/// Rules of the charts of a process: one point above a limit raises an alarm, because the limits were simulated for that.
pub fn process_settings(settings: &AlarmSettings) -> AlarmSettings {
    AlarmSettings { needed: 1, window: 1, ewma_weight: 0.0, ..*settings }
}

/// Rules of the chart of the fit: two of three batches, so that the 1 % of healthy batches that are rejected raise no alarm.
pub fn fit_settings(settings: &AlarmSettings) -> AlarmSettings {
    AlarmSettings { needed: 2, window: 3, ewma_weight: 0.0, ..*settings }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn states(settings: AlarmSettings, shifts: &[f64]) -> Vec<State> {
        let mut series = Series::new(settings);
        let point =
            |shift: &f64| ChartPoint { shift: *shift, limit: 3.0, ewma_limit: 1.0, slow: None, held: shift.is_nan() };
        shifts.iter().map(|shift| series.take(&point(shift)).state).collect()
    }

    #[test]
    fn two_of_three_points_make_an_alarm_and_three_clear_ones_end_it() {
        use State::{Alarming, Normal, Pending, Recovering};
        let settings = AlarmSettings { needed: 2, window: 3, ewma_weight: 0.0, ..AlarmSettings::default() };
        let found = states(settings, &[0.0, 4.0, 0.0, 4.0, 0.0, 0.0, 5.0, 0.0, 0.0, 0.0, 4.0, 0.0, 0.0, 0.0]);
        let expected = [
            Normal, Pending, Pending, Alarming, Recovering, Recovering, Alarming, Recovering, Recovering, Normal,
            Pending, Pending, Pending, Normal,
        ];
        assert_eq!(found, expected);
    }

    #[test]
    fn a_small_lasting_shift_is_found_by_the_moving_average() {
        let settings = AlarmSettings::default();
        let found = states(settings, &[1.5; 12]);
        // 1.5·(1 − 0.8^k) passes 1.0 at k = 5.
        assert_eq!(found.iter().position(|s| *s == State::Alarming), Some(4));
        assert!(states(settings, &[0.9; 50]).iter().all(|s| *s == State::Normal));
    }

    #[test]
    fn a_held_batch_changes_nothing() {
        let settings = AlarmSettings::default();
        assert_eq!(states(settings, &[0.0, f64::NAN, 4.0, f64::NAN, f64::NAN]).last(), Some(&State::Alarming));
    }

    #[test]
    fn a_resumed_series_continues_like_an_uninterrupted_one() {
        let settings = AlarmSettings { needed: 2, window: 3, ..AlarmSettings::default() };
        let shifts = [0.3, 4.0, 0.1, 3.5, 0.0, -1.0, 2.0, 0.0, 0.0, 0.0, 0.5, 3.1, 3.2];
        let point = |shift: f64| ChartPoint { shift, limit: 3.0, ewma_limit: 1.5, slow: None, held: false };
        let mut whole = Series::new(settings);
        let all: Vec<ChartStatus> = shifts.iter().map(|s| whole.take(&point(*s))).collect();
        for cut in 1..shifts.len() {
            let recent = all[..cut].iter().map(|s| s.above).collect::<Vec<_>>();
            let recent = recent[cut.saturating_sub(Series::memory(&settings))..].to_vec();
            let mut rest = Series::resume(settings, all[cut - 1].ewma, all[cut - 1].state, recent);
            let found: Vec<ChartStatus> = shifts[cut..].iter().map(|s| rest.take(&point(*s))).collect();
            assert_eq!(found, all[cut..], "cut at {cut}");
        }
    }

    #[test]
    fn charts_of_parameters_and_groups_have_a_parameter_and_those_of_the_structure_have_none() {
        let parameter = |series: &str| parameter_of(series.to_owned());
        for series in ["k1", "group:k1+k2"] {
            assert_eq!(parameter(series).as_deref(), Some(series));
        }
        for series in [FIT_SERIES, "structure:joint", "structure:silence", "structure:not_assessed"] {
            assert_eq!(parameter(series), None, "{series}");
        }
    }
}
