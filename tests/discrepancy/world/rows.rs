//! The weather, and the times, covariates and settings of the measurements.

use std::f64::consts::TAU;

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::numbers::{mean, mean_and_sd, normal, rounded, EPOCH_2024_S};
use super::structure::{Structure, PRIOR};

/// Share of the rows, in order of time, that models are fitted to.
const TRAINING_SHARE: f64 = 0.75;

/// Rows that models are fitted to: all but the last share, as the program rounds it.
pub fn training_rows(rows: usize) -> usize {
    rows - ((1.0 - TRAINING_SHARE) * rows as f64).round() as usize
}

/// Hourly temperature, which starts [`WARM_UP_DAYS`] before the first measurement.
pub struct Weather {
    pub start_s: i64,
    pub days: f64,
    pub hourly_c: Vec<f64>,
}

/// Days of weather before the first measurement, so that the start of a slow process no longer has an influence.
const WARM_UP_DAYS: f64 = 120.0;

impl Weather {
    /// The sum of a yearly wave that is coldest in mid-January, a daily wave and a slow random process.
    pub fn draw(rng: &mut ChaCha8Rng) -> Self {
        let start_day = rng.random_range(0.0..365.0_f64);
        let days = rng.random_range(200.0..500.0);
        let (year_c, day_c) = (rng.random_range(8.0..11.0), rng.random_range(2.0..4.0));
        let (mean_c, slow_c) = (rng.random_range(9.0..12.0), rng.random_range(1.5..2.5));
        let keep = (-1.0 / (24.0 * rng.random_range(2.0..5.0_f64))).exp();
        let mut slow = slow_c * normal(rng);
        let hourly_c = (0..=((WARM_UP_DAYS + days) * 24.0) as usize + 1)
            .map(|hour| {
                let day = start_day - WARM_UP_DAYS + hour as f64 / 24.0;
                slow = keep * slow + slow_c * (1.0 - keep * keep).sqrt() * normal(rng);
                let year = -(TAU * (day - 15.0) / 365.25).cos();
                let daily = -(TAU * (day - 3.0 / 24.0)).cos();
                mean_c + year_c * year + day_c * daily + slow
            })
            .collect();
        Self { start_s: EPOCH_2024_S + (start_day * 86_400.0) as i64, days, hourly_c }
    }

    /// Value of an hourly series on a day after the first measurement.
    pub fn at(series: &[f64], day: f64) -> f64 {
        let hour = (WARM_UP_DAYS + day) * 24.0;
        let index = (hour as usize).min(series.len() - 2);
        let share = hour - index as f64;
        series[index] * (1.0 - share) + series[index + 1] * share
    }

    /// The hourly temperature behind a first-order lag.
    pub fn lagged_c(&self, tau_days: f64) -> Vec<f64> {
        let gain = 1.0 - (-1.0 / (24.0 * tau_days)).exp();
        let mut state = mean(&self.hourly_c[..(24.0 * tau_days) as usize]);
        self.hourly_c
            .iter()
            .map(|c| {
                state += gain * (c - state);
                state
            })
            .collect()
    }
}

#[derive(Debug, Clone)]
pub struct Row {
    pub index: usize,
    pub day: f64,
    pub at_s: i64,
    pub temperature_c: f64,
    pub humidity_percent: f64,
    pub amplitude_um: f64,
    pub operator: &'static str,
    /// Value of the setting; 0 without one.
    pub set: f64,
    /// Stiffnesses of the free springs; empty before the row is measured.
    pub free: Vec<f64>,
    /// Natural logarithms of the measured frequencies; `None` if missing.
    pub log_f: Vec<Option<f64>>,
    pub outlier: bool,
}

impl Row {
    pub fn column(&self, name: &str) -> f64 {
        match name {
            "temperature_c" => self.temperature_c,
            "humidity_percent" => self.humidity_percent,
            _ => self.amplitude_um,
        }
    }
}

/// Draws the times, covariates and settings of all rows.
pub fn draw_rows(rng: &mut ChaCha8Rng, structure: &Structure, weather: &Weather) -> Vec<Row> {
    let n = rng.random_range(150..=600);
    let mut days = (0..n).map(|_| rng.random_range(0.0..weather.days)).collect::<Vec<_>>();
    days.sort_by(f64::total_cmp);
    let raw = [(); 3].map(|()| rng.random_range(0.05..1.0_f64));
    let shares = raw.map(|r| 0.18 + 0.46 * r / raw.iter().sum::<f64>());
    let correlation: f64 = rng.random_range(0.4..0.7);
    let log_sd = rng.random_range(0.25..0.5);
    let (mean_c, sd_c) = mean_and_sd(&weather.hourly_c);
    let mut last_s = 0;
    days.into_iter()
        .enumerate()
        .map(|(index, day)| {
            let at_s = (weather.start_s + (day * 86_400.0).round() as i64).max(last_s + 1);
            last_s = at_s;
            let temperature_c = Weather::at(&weather.hourly_c, day);
            let own = (1.0 - correlation * correlation).sqrt() * normal(rng);
            let z = own - correlation * (temperature_c - mean_c) / sd_c;
            let pick = rng.random_range(0.0..1.0);
            let operator = match pick {
                p if p < shares[0] => "A",
                p if p < shares[0] + shares[1] => "B",
                _ => "C",
            };
            let set = structure.setting.map_or(0.0, |s| {
                let share = rng.random_range(0.2..0.8);
                rounded((PRIOR.0 + share * (PRIOR.1 - PRIOR.0)) * structure.springs[s].n_per_m, 8)
            });
            Row {
                index,
                day,
                at_s,
                temperature_c,
                humidity_percent: (65.0 + 14.0 * z).clamp(5.0, 100.0),
                amplitude_um: (log_sd * normal(rng) - 0.5 * log_sd * log_sd).exp(),
                operator,
                set,
                free: Vec::new(),
                log_f: Vec::new(),
                outlier: false,
            }
        })
        .collect()
}
