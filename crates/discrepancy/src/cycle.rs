//! The time of the day and of the year as covariates: whatever swings with them and was not recorded, such as traffic or sunshine.
//!
//! ```text
//!  g = a cos φ + b sin φ,    φ = 2π c/period
//! ```

use std::f64::consts::TAU;

use structures::quantity::Timestamp;
use structures::simulator::law::Input;
use structures::stats;

/// A cycle of the time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cycle {
    /// The time of the day, in hours.
    Day,
    /// The time of the year, in days.
    Year,
}

/// Rows that follow each other within this many days, in the median, show a daily swing.
pub(super) const DAILY_DAYS: f64 = 0.26;

/// Days of a year.
pub(super) const YEAR_DAYS: f64 = 365.25;

impl Cycle {
    /// Name of its column.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Day => "time of day",
            Self::Year => "time of year",
        }
    }

    /// Its length in the unit of its column.
    pub(super) const fn period(self) -> f64 {
        match self {
            Self::Day => 24.0,
            Self::Year => YEAR_DAYS,
        }
    }

    /// The cycles that rows show, with the time in each of them in UTC, `[rows]`: the day, if successive rows are at most about six hours apart,
    /// and the year, if the rows cover one. `measured_at`: ascending.
    pub(super) fn shown(measured_at: &[Timestamp]) -> Vec<(Self, Vec<f64>)> {
        let days: Vec<f64> = measured_at.iter().map(|at| at.micros() as f64 / 86_400e6).collect();
        let (Some(first), Some(last)) = (days.first(), days.last()) else { return Vec::new() };
        let gaps: Vec<f64> = days.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let mut found = Vec::new();
        if last - first >= 1.0 && stats::quantile(&gaps, 0.5) <= DAILY_DAYS {
            found.push((Self::Day, days.iter().map(|at| 24.0 * at.rem_euclid(1.0)).collect()));
        }
        if last - first >= YEAR_DAYS {
            found.push((Self::Year, days.iter().map(|at| at.rem_euclid(YEAR_DAYS)).collect()));
        }
        found
    }

    /// cos φ and sin φ at a time of the cycle, as the input of a law.
    pub(super) fn input(self, time: f64) -> Input {
        let (sine, cosine) = (TAU * time / self.period()).sin_cos();
        Input::Pair(cosine, sine)
    }

    /// cos φ and sin φ at several times, `[2][times]`.
    pub(super) fn waves(self, times: impl Iterator<Item = f64>) -> [Vec<f64>; 2] {
        let phases: Vec<f64> = times.map(|time| TAU * time / self.period()).collect();
        [f64::cos, f64::sin].map(|wave| phases.iter().copied().map(wave).collect())
    }

    /// When a swing with the numbers a and b is highest, in words.
    pub(super) fn highest_in_words(self, psi: &[f64]) -> String {
        let share = (psi[1].atan2(psi[0]) / TAU).rem_euclid(1.0);
        match self {
            Self::Day => format!("about {:.0} h UTC", (share * 24.0).round() % 24.0),
            Self::Year => format!("about {:.0} days after 1 January", (share * YEAR_DAYS).round()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_swing_is_highest_where_its_cosine_and_sine_say() {
        for (hour, words) in [(0.0, "about 0 h UTC"), (14.2, "about 14 h UTC"), (23.8, "about 0 h UTC")] {
            let Input::Pair(cosine, sine) = Cycle::Day.input(hour) else { panic!("a pair") };
            assert_eq!(Cycle::Day.highest_in_words(&[0.02 * cosine, 0.02 * sine]), words, "{hour}");
        }
    }

    #[test]
    fn only_times_that_are_covered_are_covariates() {
        let every = |hours: i64, count: i64| -> Vec<Timestamp> {
            (0..count).map(|row| Timestamp::from_micros(row * hours * 3_600_000_000).unwrap()).collect()
        };
        let names =
            |times: &[Timestamp]| Cycle::shown(times).into_iter().map(|(cycle, _)| cycle.name()).collect::<Vec<_>>();
        assert!(names(&[]).is_empty() && names(&every(24, 200)).is_empty());
        assert_eq!(names(&every(1, 200)), ["time of day"]);
        assert_eq!(names(&every(24, 400)), ["time of year"]);
        assert_eq!(names(&every(6, 2_000)), ["time of day", "time of year"]);
    }
}
