//! Frequencies that are rounded: the steps, and what they add to the noise.
//!
//! A value on a grid of step q is off by up to q/2. Where the frequency scatters by a good part of a step from measurement to measurement,
//! these errors are independent, with variance q²/12. Where it does not, they are the same in all n measurements, and the mean does not get
//! better with more of them:
//!
//! ```text
//!  σ² ← σ² + q²/12 (1 + (n − 1) c),    c = exp(−4π² s²/q²)
//! ```
//!
//! s: scatter of the frequency, at least its noise; c: correlation of the errors of two measurements, from the first harmonic of the error
//! as a function of the frequency.
//!
//! Source: B. Widrow, I. Kollár, M.-C. Liu (1996), Statistical theory of quantization, IEEE Trans. Instrumentation and Measurement 45,
//! 353–361.

use super::finding::{Finding, FindingCode, FindingEffect};
use crate::baseline::observation::Observation;
use structures::measurement::ModalMeasurement;
use structures::quantity::Hertz;
use structures::simulator::Simulator;
use structures::stats;

/// Fewest values of a mode from which a grid is recognised that is no decimal one.
const FEWEST: usize = 8;

/// Share of distinct values below which a grid is sought.
const FEW_DISTINCT: f64 = 0.34;

/// Most decimals that are taken for rounding.
const MOST_DECIMALS: i32 = 6;

/// Ratio of step to noise from which rounding is reported.
const REPORTED: f64 = 1.0;

/// Correlation of the errors above which a batch moves no chart: its values hardly change whatever the structure does.
const BLIND: f64 = 0.5;

/// The step of each mode, Hz, `[modes]`; `None` where none is seen.
#[derive(Debug, Clone, PartialEq)]
pub struct Steps(pub Vec<Option<f64>>);

impl Steps {
    /// The steps that the values of a batch lie on: those of its most decimals, which a writer of tables gives to all values, or a coarser grid
    /// of a mode, such as the resolution of a spectrum.
    pub fn of(kept: &[(usize, ModalMeasurement)]) -> Self {
        let all = || kept.iter().flat_map(|(_, m)| &m.frequencies_hz).flatten().map(|f| f.get());
        let fits = |decimals: &i32| {
            let scale = 10.0_f64.powi(*decimals);
            all().all(|f| ((f * scale).round() / scale - f).abs() <= 1e-12 * f)
        };
        let decimal = (0..=MOST_DECIMALS).find(fits).map(|decimals| 10.0_f64.powi(-decimals));
        let modes = kept.first().map_or(0, |(_, m)| m.frequencies_hz.len());
        let of_mode = |mode: usize| {
            let values: Vec<f64> = kept.iter().filter_map(|(_, m)| m.frequencies_hz[mode].map(Hertz::get)).collect();
            grid(values).or(decimal)
        };
        Self((0..modes).map(of_mode).collect())
    }
}

/// The step of a grid on which many values take few places; `None` if there is none.
fn grid(mut values: Vec<f64>) -> Option<f64> {
    let count = values.len();
    values.sort_by(f64::total_cmp);
    values.dedup();
    if count < FEWEST || values.len() < 2 || values.len() as f64 > FEW_DISTINCT * count as f64 {
        return None;
    }
    let smallest = values.windows(2).map(|pair| pair[1] - pair[0]).fold(f64::INFINITY, f64::min);
    on_grid(&values, smallest).then_some(smallest)
}

/// Whether sorted values lie on a grid: the differences of neighbours are multiples of the smallest one or of a half, a third or a quarter
/// of it, to a thousandth. Copies of a few measurements take few values too, but at arbitrary distances.
fn on_grid(sorted: &[f64], smallest: f64) -> bool {
    let fits = |parts: u8| {
        let step = smallest / f64::from(parts);
        let off = |pair: &[f64]| {
            let steps = (pair[1] - pair[0]) / step;
            (steps - steps.round()).abs() < 1e-3 + 1e-12 * pair[1].abs() / step
        };
        sorted.windows(2).all(off)
    };
    (1..=4).any(fits)
}

/// Whether every mode that varies takes few values on a grid, so that measurements coincide by chance.
pub fn is_coarse(kept: &[(usize, ModalMeasurement)]) -> bool {
    let modes = kept.first().map_or(0, |(_, m)| m.frequencies_hz.len());
    let of_mode =
        |mode: usize| kept.iter().filter_map(|(_, m)| m.frequencies_hz[mode].map(Hertz::get)).collect::<Vec<_>>();
    let varies =
        |values: &Vec<f64>| values.len() >= FEWEST && values.iter().any(|value| value.total_cmp(&values[0]).is_ne());
    let varying: Vec<Vec<f64>> = (0..modes).map(of_mode).filter(varies).collect();
    !varying.is_empty() && varying.into_iter().all(|values| grid(values).is_some())
}

/// Adds what rounding contributes to the noise of each frequency, and says so where it is more than the noise itself.
pub fn widened(simulator: &Simulator, observations: &mut [Observation], steps: &Steps, findings: &mut Vec<Finding>) {
    let (mut parts, mut blind) = (Vec::new(), false);
    for (mode, step) in steps.0.iter().enumerate() {
        let Some(step) = *step else { continue };
        let values: Vec<f64> = observations.iter().filter_map(|o| o.frequencies_hz[mode]).collect();
        let stds: Vec<f64> = observations.iter().filter_map(|o| o.std_hz(simulator, mode)).collect();
        if stds.is_empty() || stds.contains(&0.0) {
            continue;
        }
        let noise = stats::quantile(&stds, 0.5);
        let variance = step * step / 12.0;
        let seen = stats::sample_std(&values).filter(|_| values.len() >= FEWEST).unwrap_or(0.0);
        let scatter = (seen * seen - variance).max(noise * noise);
        let same = (-4.0 * std::f64::consts::PI.powi(2) * scatter / (step * step)).exp();
        let added = variance * (1.0 + (values.len() - 1) as f64 * same);
        for observation in observations.iter_mut() {
            if let Some(std) = observation.std_hz(simulator, mode) {
                observation.noise_multiple[mode] *= (1.0 + added / (std * std)).sqrt();
            }
        }
        if step > REPORTED * noise {
            parts.push(format!(
                "mode {} is rounded to steps of {step:.1e} Hz, larger than its noise of {noise:.1e} Hz",
                mode + 1
            ));
            blind |= same > BLIND;
        }
    }
    if !parts.is_empty() {
        let (effect, consequence) = if blind {
            (FindingEffect::HoldAlarm, "which hides how far it scatters: record more digits")
        } else {
            (FindingEffect::Note, "which is part of its noise: record more digits")
        };
        let message = format!("{}, {consequence}", parts.join("; "));
        findings.push(Finding::new(FindingCode::Quantised, effect, message));
    }
}
