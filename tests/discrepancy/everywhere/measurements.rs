//! Modes of structures by their matrices, and how their measurements come.

use std::fmt::Write as _;
use std::ops::Range;

use nalgebra::{DMatrix, DVector};
use rand::Rng as _;
use rand_chacha::ChaCha8Rng;

use super::super::world::{rfc3339, EPOCH_2024_S};

/// Standard deviation of a number of a measured shape, as a share of the root mean square of the shape.
const SHAPE_NOISE: f64 = 0.01;

/// Frequencies of a structure, Hz, and its shapes at all bodies, a column each.
#[derive(Debug, Clone)]
pub(super) struct Modes {
    pub(super) hz: Vec<f64>,
    pub(super) shapes: DMatrix<f64>,
}

impl Modes {
    /// The lowest `count` solutions of K φ = ω² M φ.
    pub(super) fn new(k: &DMatrix<f64>, m: &DMatrix<f64>, count: usize) -> Self {
        let inverse = m.clone().cholesky().unwrap().l().try_inverse().unwrap();
        let eigen = (&inverse * k * inverse.transpose()).symmetric_eigen();
        let mut order: Vec<usize> = (0..k.nrows()).collect();
        order.sort_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]));
        order.truncate(count);
        let hz = order.iter().map(|i| eigen.eigenvalues[*i].sqrt() / std::f64::consts::TAU).collect();
        let shapes = inverse.transpose() * eigen.eigenvectors.select_columns(&order);
        Self { hz, shapes }
    }
}

/// The first lines of a structure file.
pub(super) fn head(id: &str, modes: usize, noise: f64, instrumented: &[usize]) -> String {
    let mut text = format!("id = \"{id}\"\nmodes = {modes}\nmeasurement_noise = {{ relative = {noise:.5} }}\n");
    text +=
        "covariate = [{ name = \"temperature_c\" }, { name = \"wind_m_per_s\" }, { name = \"humidity_percent\" }]\n";
    if !instrumented.is_empty() {
        let points: Vec<String> = instrumented.iter().map(|floor| format!("\"m{}\"", floor + 1)).collect();
        let _ = writeln!(text, "mode_shapes = {{ points = [{}], noise = {SHAPE_NOISE} }}", points.join(", "));
    }
    text
}

/// A parameter of a structure file: a factor of the stiffness of the parts in `sets`.
pub(super) fn factor(name: &str, sets: impl Iterator<Item = String>) -> String {
    factor_with(name, "{ uniform = [0.5, 1.6] }", sets)
}

/// As [`factor`], with another prior.
pub(super) fn factor_with(name: &str, prior: &str, sets: impl Iterator<Item = String>) -> String {
    let sets = sets.collect::<Vec<_>>().join(", ");
    format!("[[parameter]]\nname = \"{name}\"\nscale = true\nprior = {prior}\nsets = [{sets}]\n")
}

/// How measurements come.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Manner {
    /// 200 complete rows, six a day.
    Complete,
    EightRows,
    TwentyRows,
    FiveHundredRows,
    /// A quarter of the values is missing, each by itself.
    ValuesMissing,
    /// 3 % of the values are other peaks, by up to a fifth above or below.
    WrongPeaks,
    /// Frequencies with two decimals.
    TwoDecimals,
    /// Each row comes a second time, ten minutes later.
    Copies,
    /// The noise is three times what the file states.
    MoreNoise,
    /// The noise is a third of what the file states.
    LessNoise,
    /// A year in which the stiffness follows the temperature, 0.3 % per °C.
    Season,
    /// Shapes at every second floor.
    Shapes,
}

impl Manner {
    pub(super) const ALL: [Self; 12] = [
        Self::Complete,
        Self::EightRows,
        Self::TwentyRows,
        Self::FiveHundredRows,
        Self::ValuesMissing,
        Self::WrongPeaks,
        Self::TwoDecimals,
        Self::Copies,
        Self::MoreNoise,
        Self::LessNoise,
        Self::Season,
        Self::Shapes,
    ];

    pub(super) fn rows(self) -> i64 {
        match self {
            Self::EightRows => 8,
            Self::TwentyRows => 20,
            Self::FiveHundredRows => 500,
            _ => 200,
        }
    }

    /// Noise that the file states, where `noise` is that of the measurements.
    pub(super) fn stated(self, noise: f64) -> f64 {
        match self {
            Self::MoreNoise => noise / 3.0,
            Self::LessNoise => noise * 3.0,
            _ => noise,
        }
    }

    /// Floors at which shapes are measured.
    pub(super) fn instrumented(self, floors: usize) -> Vec<usize> {
        (0..floors).filter(|floor| self == Self::Shapes && (floors - 1 - floor).is_multiple_of(2)).collect()
    }
}

/// One measurement.
#[derive(Clone)]
struct Row {
    time_s: i64,
    hz: Vec<Option<f64>>,
    /// Components of the shapes at the instrumented bodies, one mode after the other.
    shapes: Vec<f64>,
    weather: [f64; 3],
}

/// Measurements of a structure whose parameters scatter by 1 % from row to row about `means`, as CSV: the rows with these numbers.
/// `modes`: modes with the factors of two parameters.
pub(super) fn measured(
    modes: &dyn Fn([f64; 2]) -> Modes,
    (noise, manner): (f64, Manner),
    means: [f64; 2],
    rows: Range<i64>,
    stream: &mut ChaCha8Rng,
) -> String {
    let season = manner == Manner::Season;
    let hours = if season { 44 } else { 4 };
    let instrumented = manner.instrumented(modes([1.0; 2]).shapes.nrows());
    let mut all: Vec<Row> = Vec::new();
    for row in rows {
        let mut normal = || stream.sample::<f64, _>(rand_distr::StandardNormal);
        let factors = means.map(|mean| mean * (1.0 + 0.01 * normal()));
        let time_s = 3_600 * hours * row;
        let day = time_s as f64 / 86_400.0;
        let warm = if season { 12.0 * (day / 365.25 * std::f64::consts::TAU).sin() + 3.0 * normal() } else { 0.0 };
        let factors = factors.map(|factor| factor * (1.0 - 0.003 * warm));
        let Modes { hz, shapes } = modes(factors);
        let hz = hz.iter().map(|f| Some(f * (1.0 + noise * normal()))).collect();
        let mut components = Vec::new();
        for shape in shapes.column_iter() {
            let at: Vec<f64> = instrumented.iter().map(|floor| shape[*floor]).collect();
            let scale = (at.iter().map(|c| c * c).sum::<f64>() / at.len().max(1) as f64).sqrt();
            components.extend(at.iter().map(|c| c / scale + SHAPE_NOISE * normal()));
        }
        let weather =
            [10.0 + warm + if season { 0.0 } else { 8.0 * normal() }, 3.0 * normal().abs(), 60.0 + 10.0 * normal()];
        all.push(Row { time_s, hz, shapes: components, weather });
    }
    spoiled(manner, &mut all, stream);
    csv(manner, &all, &instrumented)
}

/// What happens to values on their way.
fn spoiled(manner: Manner, rows: &mut Vec<Row>, stream: &mut ChaCha8Rng) {
    match manner {
        Manner::ValuesMissing => {
            for row in rows {
                let kept = stream.random_range(0..row.hz.len());
                for (mode, hz) in row.hz.iter_mut().enumerate() {
                    if stream.random_bool(0.25) && mode != kept {
                        *hz = None;
                    }
                }
            }
        }
        Manner::WrongPeaks => {
            for hz in rows.iter_mut().flat_map(|row| row.hz.iter_mut().flatten()) {
                if stream.random_bool(0.03) {
                    *hz *= stream.random_range(0.8..1.2);
                }
            }
        }
        Manner::Copies => {
            let again = |row: &Row| [row.clone(), Row { time_s: row.time_s + 600, ..row.clone() }];
            *rows = rows.iter().flat_map(again).collect();
        }
        _ => {}
    }
}

fn csv(manner: Manner, rows: &[Row], instrumented: &[usize]) -> String {
    let modes = rows[0].hz.len();
    let decimals = if manner == Manner::TwoDecimals { 2 } else { 6 };
    let names: Vec<String> = (1..=modes).map(|m| format!("f{m}_hz")).collect();
    let mut csv = format!("measured_at,{},temperature_c,wind_m_per_s,humidity_percent", names.join(","));
    for (mode, floor) in (1..=modes).flat_map(|mode| instrumented.iter().map(move |floor| (mode, floor + 1))) {
        let _ = write!(csv, ",phi{mode}_m{floor}");
    }
    csv.push('\n');
    for row in rows {
        let hz: Vec<String> = row.hz.iter().map(|f| f.map_or(String::new(), |f| format!("{f:.decimals$}"))).collect();
        let [temperature, wind, humidity] = row.weather;
        let time = rfc3339(EPOCH_2024_S + row.time_s);
        let _ = write!(csv, "{time},{},{temperature:.2},{wind:.2},{humidity:.1}", hz.join(","));
        for component in &row.shapes {
            let _ = write!(csv, ",{component:.6}");
        }
        csv.push('\n');
    }
    csv
}

/// Largest deviation over the modes that is left by the best factors of two parameters, by Gauss–Newton, per cent.
pub(super) fn off_percent(wanted_hz: &[f64], simulated_hz: impl Fn([f64; 2]) -> Vec<f64>) -> f64 {
    let logs = |hz: &[f64]| DVector::from_iterator(hz.len(), hz.iter().map(|f| f.ln()));
    let wanted = logs(wanted_hz);
    let mut factors = [1.0; 2];
    let mut left = wanted.clone();
    for _ in 0..20 {
        let here = logs(&simulated_hz(factors));
        left = &wanted - &here;
        let column = |which: usize| {
            let mut moved = factors;
            moved[which] *= 1.0 + 1e-6;
            (logs(&simulated_hz(moved)) - &here) / 1e-6
        };
        let slopes = DMatrix::from_columns(&[column(0), column(1)]);
        let step = (slopes.transpose() * &slopes).try_inverse().unwrap() * slopes.transpose() * &left;
        factors = [factors[0] * step[0].clamp(-0.2, 0.2).exp(), factors[1] * step[1].clamp(-0.2, 0.2).exp()];
    }
    100.0 * left.amax()
}
