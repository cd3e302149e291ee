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

/// The steps that the values of a batch lie on, Hz, `[modes]`, `None` where none is seen: those of its most decimals, which a writer of tables
/// gives to all values, or a coarser grid of a mode, such as the resolution of a spectrum.
pub(super) fn steps_hz(kept: &[(usize, ModalMeasurement)]) -> Vec<Option<f64>> {
    let all = || kept.iter().flat_map(|(_, m)| &m.frequencies_hz).flatten().map(|f| f.get());
    let fits = |decimals: &i32| {
        let scale = 10.0_f64.powi(*decimals);
        all().all(|f| ((f * scale).round() / scale - f).abs() <= 1e-12 * f)
    };
    let decimal = (0..=MOST_DECIMALS).find(fits).map(|decimals| 10.0_f64.powi(-decimals));
    values_of_modes(kept).map(|values| grid(values).or(decimal)).collect()
}

/// The frequencies of each mode, Hz.
fn values_of_modes(kept: &[(usize, ModalMeasurement)]) -> impl Iterator<Item = Vec<f64>> + use<'_> {
    let modes = kept.first().map_or(0, |(_, m)| m.frequencies_hz.len());
    let of_mode = |mode: usize| kept.iter().filter_map(|(_, m)| m.frequencies_hz[mode].map(Hertz::get)).collect();
    (0..modes).map(of_mode)
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
    let varies =
        |values: &Vec<f64>| values.len() >= FEWEST && values.iter().any(|value| value.total_cmp(&values[0]).is_ne());
    let varying: Vec<Vec<f64>> = values_of_modes(kept).filter(varies).collect();
    !varying.is_empty() && varying.into_iter().all(|values| grid(values).is_some())
}

/// Variance that rounding to steps q adds to each of n frequencies with the variance s², and the correlation c of its errors: see the
/// [module](self).
fn added(step: f64, scatter: f64, count: usize) -> (f64, f64) {
    let same = (-4.0 * std::f64::consts::PI.powi(2) * scatter / (step * step)).exp();
    (step * step / 12.0 * (1.0 + (count - 1) as f64 * same), same)
}

/// Adds what the rounding of the measurements `kept` contributes to the noise of each frequency of their observations, and says so where the
/// steps are larger than the noise.
pub fn widened(
    simulator: &Simulator,
    kept: &[(usize, ModalMeasurement)],
    observations: &mut [Observation],
    findings: &mut Vec<Finding>,
) {
    let (mut parts, mut blind) = (Vec::new(), false);
    for (mode, step) in steps_hz(kept).into_iter().enumerate() {
        let Some(step) = step else { continue };
        let values: Vec<f64> = observations.iter().filter_map(|o| o.frequencies_hz[mode]).collect();
        let stds: Vec<f64> = observations.iter().filter_map(|o| o.std_hz(simulator, mode)).collect();
        if stds.is_empty() || stds.contains(&0.0) {
            continue;
        }
        let noise = stats::quantile(&stds, 0.5);
        let seen = stats::sample_std(&values).filter(|_| values.len() >= FEWEST).unwrap_or(0.0);
        let scatter = (seen * seen - step * step / 12.0).max(noise * noise);
        let (added, same) = added(step, scatter, values.len());
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

#[cfg(test)]
mod tests {
    use rand::Rng as _;
    use rand_distr::StandardNormal;

    use super::*;

    /// Variance of the error that rounding to whole numbers adds to the mean of `count` values with the standard deviation `std`, about means
    /// anywhere between two steps.
    fn of_mean(std: f64, count: usize) -> f64 {
        let mut stream = stats::stream(3, "test: means of rounded values");
        let squares: Vec<f64> = (0..20_000)
            .map(|_| {
                let middle: f64 = stream.random();
                let error = |_| {
                    let exact = middle + std * stream.sample::<f64, _>(StandardNormal);
                    exact.round() - exact
                };
                ((0..count).map(error).sum::<f64>() / count as f64).powi(2)
            })
            .collect();
        stats::mean(&squares)
    }

    #[test]
    fn the_mean_of_rounded_values_is_off_by_as_much_as_is_added() {
        for (std, count) in [(0.01, 1), (0.01, 20), (0.1, 20), (0.2, 20), (0.3, 5), (0.5, 20), (2.0, 20)] {
            let (added, _) = added(1.0, std * std, count);
            let ratio = added / count as f64 / of_mean(std, count);
            // The squares of 20,000 errors have a mean that is known to 1 %. Between the limits of equal and of independent errors, the
            // formula counts all of the error as its first harmonic, of which a part of 6/π² has that correlation: up to 1.65 times too much.
            assert!((0.96..1.75).contains(&ratio), "standard deviation {std}, {count} values: {ratio}");
        }
        // A standard deviation s ≪ 1 takes s/√π · 12 of the common error away: 0.7 % here.
        for std in [0.001, 0.5, 2.0] {
            let ratio = added(1.0, std * std, 20).0 / 20.0 / of_mean(std, 20);
            assert!((0.96..1.04).contains(&ratio), "standard deviation {std}: {ratio}");
        }
    }
}
