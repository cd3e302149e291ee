//! A structure with its weather, the way in which its data come, and what it loses. What its data inform is known from its own frequencies.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use modalwatch::baseline::conditions::NoiseRange;
use modalwatch::baseline::train::train;
use modalwatch::baseline::Baseline;
use modalwatch::flow::train::TrainSettings;
use modalwatch::flow::FlowSettings;
use modalwatch::measurement::{CovariateValue, ModalMeasurement};
use modalwatch::quantity::{Hertz, Timestamp};
use modalwatch::simulator::Simulator;
use modalwatch::stats::{self, Stream};
use nalgebra::{DMatrix, DVector};
use rand::Rng as _;
use rand_distr::StandardNormal;

use super::frames::{Frame, Spring};
use super::{AFTER, BEFORE, REFERENCE};

/// Batches over which a slow loss grows.
const SLOW: usize = 15;

/// Days without batches before the loss, where there is a pause.
const PAUSE: usize = 30;

/// Healthy batches from which a world's covariance is known, and the distance in its standard deviations at which one batch tells two states apart.
const HEALTHY: usize = 300;
const TOLD_APART: f64 = 5.0;

/// How the models are trained: briefly, because the simulation corrects their samples.
const SAMPLES: usize = 8_000;
const EPOCHS: usize = 10;
const NOISE_RANGE: NoiseRange = NoiseRange { lowest: 0.5, highest: 2.0 };

/// The model of a structure.
pub(in super::super) fn trained(frame: &Frame) -> Baseline {
    let settings = TrainSettings { epochs: EPOCHS, ..TrainSettings::default() };
    let simulator = Simulator::parse_toml(&frame.file()).unwrap();
    train(&simulator, SAMPLES, NOISE_RANGE, &FlowSettings::default(), &settings, |_| {}).unwrap().baseline
}

/// What moves the stiffnesses of a healthy structure.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Weather {
    Still,
    Unmeasured,
    /// With a season, and a thermometer that shows it.
    Measured,
}

/// How the rows of a batch come.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Rows {
    Complete,
    /// Every value is missing in one row of ten.
    Gaps,
    /// A mode is missing in every second row.
    ModeOften(usize),
    /// A mode is missing in every second batch.
    ModeInBatches(usize),
    /// A few digits behind the point.
    Rounded,
    Twice,
    /// Every second row is the mean of its neighbours.
    Interpolated,
}

/// A structure with its weather, the way in which its data come, and what it loses.
pub struct World<'a> {
    seed: u64,
    frame: &'a Frame,
    pub baseline: &'a Baseline,
    sizes: &'static [usize],
    weather: Weather,
    rows: Rows,
    pause: bool,
    slow: bool,
    /// Share of its stiffness that each part loses.
    pub losses: Vec<f64>,
    /// Factor of each spring while it is healthy, and its sensitivity to the weather.
    healthy: Vec<f64>,
    follows: Vec<f64>,
}

fn normal(stream: &mut Stream) -> f64 {
    stream.sample(StandardNormal)
}

impl<'a> World<'a> {
    pub fn new(seed: u64, frame: &'a Frame, baseline: &'a Baseline) -> Self {
        let mut stream = stats::stream(seed, "test: many worlds");
        let all: [&[usize]; 6] = [&[1], &[2], &[5], &[20], &[50], &[1, 20, 3]];
        let sizes = all[stream.random_range(0..all.len())];
        let weather = [Weather::Still, Weather::Unmeasured, Weather::Measured][stream.random_range(0..3)];
        let mode = stream.random_range(0..frame.modes);
        let rows = match stream.random_range(0..10) {
            0..4 => Rows::Complete,
            4 => Rows::Gaps,
            5 => Rows::ModeOften(mode),
            6 => Rows::ModeInBatches(mode),
            7 => Rows::Rounded,
            8 => Rows::Twice,
            _ => Rows::Interpolated,
        };
        let (pause, slow) = (stream.random_range(0..5) == 0, stream.random_range(0..4) == 0);
        let mut losses = vec![0.0; frame.parts];
        for _ in 0..[0, 1, 1, 1, 2][stream.random_range(0..5)] {
            let part = stream.random_range(0..frame.parts);
            losses[part] = 0.03 * (0.95_f64 / 0.03).powf(stream.random());
        }
        // Each part differs from the file, and each spring from its part: no state of the file is the structure.
        let part: Vec<f64> = (0..frame.parts).map(|_| 0.05 * normal(&mut stream)).collect();
        let healthy = frame.springs.iter().map(|s| 1.0 + part[s.part] + 0.01 * normal(&mut stream)).collect();
        let of_weather = |_| 0.008 * (1.0 + 0.3 * normal(&mut stream));
        let by_part: Vec<f64> = (0..frame.parts).map(of_weather).collect();
        let follows = frame.springs.iter().map(|s| by_part[s.part]).collect();
        Self { seed, frame, baseline, sizes, weather, rows, pause, slow, losses, healthy, follows }
    }

    /// Share of its final loss that a part has lost on a day.
    fn lost_by(&self, day: usize) -> f64 {
        match day.checked_sub(REFERENCE + BEFORE) {
            None => 0.0,
            Some(since) if self.slow => ((since + 1) as f64 / SLOW as f64).min(1.0),
            Some(_) => 1.0,
        }
    }

    /// Frequencies in a state: weather, own deviation and loss of each part.
    fn hz(&self, weather: f64, own: &[f64], losses: &[f64]) -> Vec<f64> {
        let factor = |(s, spring): (usize, &Spring)| {
            self.healthy[s] * (1.0 + self.follows[s] * weather + own[spring.part]) * (1.0 - losses[spring.part])
        };
        let factors: Vec<f64> = self.frame.springs.iter().enumerate().map(factor).collect();
        self.frame.frequencies_hz(&factors)
    }

    /// The rows of a batch, as they come.
    fn measured(&self, day: usize, weather: f64, own: &[f64], stream: &mut Stream) -> Vec<Vec<Option<f64>>> {
        let (frame, share) = (self.frame, self.lost_by(day));
        let losses: Vec<f64> = self.losses.iter().map(|loss| share * loss).collect();
        let mut rows: Vec<Vec<Option<f64>>> = (0..self.sizes[day % self.sizes.len()])
            .map(|_| {
                let now: Vec<f64> = own.iter().map(|own| own + 0.002 * normal(stream)).collect();
                let hz = self.hz(weather, &now, &losses);
                hz.into_iter().map(|f| Some(f * (1.0 + frame.noise * normal(stream)))).collect()
            })
            .collect();
        match self.rows {
            Rows::Complete => {}
            Rows::Gaps => {
                for value in rows.iter_mut().flat_map(|row| row.iter_mut().skip(1)) {
                    *value = value.filter(|_| stream.random_range(0..10) > 0);
                }
            }
            Rows::ModeOften(mode) => {
                for row in &mut rows {
                    row[mode] = row[mode].filter(|_| stream.random());
                }
            }
            Rows::ModeInBatches(mode) => {
                let seen: bool = stream.random();
                for row in &mut rows {
                    row[mode] = row[mode].filter(|_| seen);
                }
            }
            Rows::Rounded => {
                let first = rows[0][0].unwrap();
                let step = 10.0_f64.powf((0.004 * first).log10().floor());
                rows.iter_mut().flatten().flatten().for_each(|f| *f = (*f / step).round() * step);
            }
            Rows::Twice => rows = rows.into_iter().flat_map(|row| [row.clone(), row]).collect(),
            Rows::Interpolated => {
                for i in (1..rows.len().saturating_sub(1)).step_by(2) {
                    let mean = |mode: usize| Some(f64::midpoint(rows[i - 1][mode]?, rows[i + 1][mode]?));
                    rows[i] = (0..frame.modes).map(mean).collect();
                }
            }
        }
        rows
    }

    pub fn batches(&self) -> Vec<Vec<ModalMeasurement>> {
        let mut stream = stats::stream(self.seed, "test: the batches of a world");
        let parts = self.losses.len();
        let (mut drift, mut own) = (normal(&mut stream), vec![0.0; parts]);
        let begin: f64 = TAU * stream.random::<f64>();
        let mut all = Vec::new();
        for day in 0..REFERENCE + BEFORE + AFTER {
            drift = 0.9 * drift + 0.19_f64.sqrt() * normal(&mut stream);
            for own in &mut own {
                *own = 0.8 * *own + 0.6 * 0.001 * normal(&mut stream);
            }
            let late = if self.pause && day >= REFERENCE + BEFORE { PAUSE } else { 0 };
            let weather = match self.weather {
                Weather::Still => 0.0,
                Weather::Unmeasured => drift,
                Weather::Measured => drift + 2.0 * (begin + TAU * (day + late) as f64 / 365.25).sin(),
            };
            let rows = self.measured(day, weather, &own, &mut stream);
            let batch = rows.into_iter().enumerate().map(|(row, hz)| {
                let minutes = 1_440 * (day + late) as i64 + 20 * row as i64;
                let shown = 10.0 - 8.0 * weather + 0.5 * normal(&mut stream);
                let is_measured = self.weather == Weather::Measured;
                ModalMeasurement {
                    measured_at: Timestamp::from_micros(1_767_225_600_000_000 + 60_000_000 * minutes).unwrap(),
                    frequencies_hz: hz.into_iter().map(|f| f.map(|f| Hertz::new(f).unwrap())).collect(),
                    std_hz: None,
                    mode_shapes: None,
                    covariates: BTreeMap::from_iter(
                        is_measured.then(|| ("temperature_celsius".to_owned(), CovariateValue::Number(shown))),
                    ),
                    settings: BTreeMap::new(),
                }
            });
            all.push(batch.collect());
        }
        all
    }

    /// Covariance of the mean logarithms of the frequencies of a healthy batch, apart from weather that is measured.
    fn covariance(&self) -> DMatrix<f64> {
        let mut stream = stats::stream(self.seed, "test: healthy batches of a world");
        let modes = self.frame.modes;
        let mut means: Vec<DVector<f64>> = Vec::new();
        while means.len() < HEALTHY {
            let weather = if self.weather == Weather::Unmeasured { normal(&mut stream) } else { 0.0 };
            let own: Vec<f64> = self.losses.iter().map(|_| 0.001 * normal(&mut stream)).collect();
            let rows = self.measured(means.len() % REFERENCE, weather, &own, &mut stream);
            let mean = |mode: usize| {
                let seen: Vec<f64> = rows.iter().filter_map(|row| row[mode]).map(f64::ln).collect();
                (!seen.is_empty()).then(|| seen.iter().sum::<f64>() / seen.len() as f64)
            };
            let of_modes: Option<Vec<f64>> = (0..modes).map(mean).collect();
            means.extend(of_modes.map(DVector::from_vec));
        }
        let mean: DVector<f64> = means.iter().sum::<DVector<f64>>() / HEALTHY as f64;
        means.iter().map(|own| (own - &mean) * (own - &mean).transpose()).sum::<DMatrix<f64>>() / HEALTHY as f64
    }

    /// The distance of the frequencies after the loss from the nearest ones that losses of these parts alone give, in standard deviations of
    /// one healthy batch.
    fn distance(&self, parts: &[usize], precision: &DMatrix<f64>) -> f64 {
        let still = vec![0.0; self.losses.len()];
        let ln = |losses: &[f64]| -> DVector<f64> {
            DVector::from_vec(self.hz(0.0, &still, losses)).map(|f| f.max(1e-9).ln())
        };
        let target = ln(&self.losses);
        // By logarithms of what is left of the stiffness.
        let losses = |left: &DVector<f64>| {
            let mut all = still.clone();
            parts.iter().zip(left.iter()).for_each(|(part, left)| all[*part] = -left.exp_m1());
            all
        };
        let square = |left: &DVector<f64>| {
            let difference = &target - ln(&losses(left));
            (difference.transpose() * precision * &difference)[0]
        };
        if parts.is_empty() {
            return square(&DVector::zeros(0)).sqrt();
        }
        let mut best = f64::INFINITY;
        for start in [-0.05, -0.5, -2.0] {
            let mut left = DVector::from_element(parts.len(), start);
            let mut least = square(&left);
            for _ in 0..30 {
                let now = ln(&losses(&left));
                let column = |j: usize| {
                    let mut moved = left.clone();
                    moved[j] += 1e-4;
                    (ln(&losses(&moved)) - &now) / 1e-4
                };
                let slopes = DMatrix::from_columns(&(0..parts.len()).map(column).collect::<Vec<_>>());
                let normal = slopes.transpose() * precision * &slopes;
                let Some(inverse) = (normal + DMatrix::identity(parts.len(), parts.len()) * 1e-6).try_inverse() else {
                    break;
                };
                let step = inverse * (slopes.transpose() * precision * (&target - &now));
                let shorter = |halvings: i32| &left + &step * 0.5_f64.powi(halvings);
                let Some(next) = (0..8).map(shorter).find(|next| square(next) < least) else { break };
                (least, left) = (square(&next), next);
            }
            best = best.min(least);
        }
        best.sqrt()
    }

    /// Whether one batch after the loss of a part tells it apart from losses of the other parts that lost and any third one.
    pub fn informs(&self, part: usize) -> bool {
        let others = || (0..self.losses.len()).filter(|own| *own != part && self.losses[*own] > 0.0);
        let instead = (0..self.losses.len()).filter(|own| *own != part && self.losses[*own] == 0.0);
        let sets = instead.map(|own| others().chain([own]).collect::<Vec<_>>()).chain([others().collect()]);
        let precision = self.covariance().cholesky().expect("a covariance of hundreds of batches").inverse();
        sets.map(|parts| self.distance(&parts, &precision)).fold(f64::INFINITY, f64::min) > TOLD_APART
    }

    pub fn in_words(&self) -> String {
        let Self { seed, sizes, weather, rows, pause, slow, losses, .. } = self;
        let id = self.frame.id;
        format!("{seed} {id} {sizes:?} {weather:?} {rows:?} pause {pause} slow {slow} {losses:.3?}")
    }
}
