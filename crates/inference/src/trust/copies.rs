//! How measurements differ beside their noise: near-copies, which count once, and noise that is stated far too large.

use nalgebra::DMatrix;
use rand::Rng as _;
use rand_distr::StandardNormal;
use statrs::function::gamma::ln_gamma;

use super::finding::{too_many, Finding, FindingCode, FindingEffect};
use super::quality::drop_mode;
use super::rounding::steps_hz;
use crate::baseline::observation::Observation;
use structures::measurement::ModalMeasurement;
use structures::quantity::Hertz;
use structures::simulator::Simulator;
use structures::stats;

/// All measurements are copies of one if they scatter by less than this share of their noise in every direction.
const NO_SCATTER: f64 = 0.005;

/// Fewest measurements, beyond the number of modes, from which copies are told from others.
const FEWEST_BEYOND_MODES: usize = 2;

/// Shares of independent measurements that have another one as close as a threshold, one share for each threshold.
const SHARES_BY_CHANCE: [f64; 3] = [1e-6, 1e-4, 1e-2];

/// Probability of the close pairs by chance, below which they are copies.
const CHANCE: f64 = 3e-5;

/// Squared distances, as shares of that which 95 % of the pairs within a group have whose noise is as stated, at which groups are sought.
const GROUP_DISTANCES: [f64; 3] = [0.01, 0.1, 1.0];

/// Share of the measurements that is left of groups if each counts once, at most, and fewest groups: two or three states of a structure
/// are no copies.
const MOST_LEFT: f64 = 0.4;
const FEWEST_GROUPS: usize = 4;

/// Draws that estimate how many pairs a normal distribution has within a distance.
const DRAWS: usize = 4_000;

/// Probability with which the scatter of a mode is as small by chance, and largest ratio of scatter to stated noise that is reported.
const OVERSTATED_CHANCE: f64 = 1e-4;
const OVERSTATED_RATIO: f64 = 0.5;

/// Step that is assumed for values that are not seen to be rounded, Hz.
const FINEST_HZ: f64 = 1e-7;

/// Expected number of repetitions of earlier batches by chance, below which they are copies.
const REPEATED_CHANCE: f64 = 1e-4;

/// Leaves out measurements that repeat those of earlier batches to the last digit, in the same order, whatever their times and sources: a
/// gateway sends yesterday's table again, or the same table comes from two sources. `kept` is in the order of time, and so are the frequencies
/// of the `earlier` measurements, `[n][modes]`. The batch is rejected if nothing else is in it.
///
/// Values rounded to steps q with noise σ coincide by chance. In N earlier and n own measurements, r successive ones do so
///
/// ```text
///  n N Π_m (q_m/(2 √π σ_m))^r
/// ```
///
/// times at most; only longer runs are copies.
pub fn of_earlier(
    simulator: &Simulator,
    kept: &mut Vec<(usize, ModalMeasurement)>,
    earlier: &[Vec<Option<Hertz>>],
    findings: &mut Vec<Finding>,
) {
    let count = kept.len();
    let equals = |row: usize, other: usize| kept[row].1.frequencies_hz == earlier[other];
    if !(0..count).any(|row| (0..earlier.len()).any(|other| equals(row, other))) {
        return;
    }
    let steps_hz = steps_hz(kept);
    let chance = |(_, measurement): &(usize, ModalMeasurement)| -> f64 {
        let modes = 0..measurement.frequencies_hz.len();
        modes.filter_map(|mode| coincidence(simulator, measurement, mode, steps_hz[mode])).product()
    };
    let chances: Vec<f64> = kept.iter().map(chance).collect();
    let expected = (count * earlier.len()) as f64;
    let mut copied = vec![false; count];
    for row in 0..count {
        for other in 0..earlier.len() {
            let begins = row == 0 || other == 0 || !equals(row - 1, other - 1);
            let run = (0..(count - row).min(earlier.len() - other)).take_while(|i| equals(row + i, other + i)).count();
            let by_chance: f64 = chances[row..row + run].iter().product();
            if begins && run > 0 && expected * by_chance < REPEATED_CHANCE {
                copied[row..row + run].fill(true);
            }
        }
    }
    let indices: Vec<usize> = (0..count).filter(|row| copied[*row]).map(|row| kept[row].0).collect();
    if indices.len() == count {
        let message = format!(
            "all {count} measurements repeat earlier ones to the last digit: the gateway sends old values again, or the same table comes from \
             two sources"
        );
        findings.push(Finding::new(FindingCode::NoScatter, FindingEffect::Reject, message));
    } else if !indices.is_empty() {
        kept.retain(|(index, _)| !indices.contains(index));
        let message = format!(
            "{} of {count} measurements repeat those of an earlier batch to the last digit and are left out",
            indices.len()
        );
        findings.push(Finding::new(FindingCode::StaleRepeat, FindingEffect::Note, message).of(indices));
    }
}

/// Upper bound of the probability that an independent measurement has the same frequency of a mode to the last digit, `q/(2 √π σ)`; `None`
/// where it lacks the mode. `step_hz`: q, `None` where the values are not seen to be rounded.
fn coincidence(
    simulator: &Simulator,
    measurement: &ModalMeasurement,
    mode: usize,
    step_hz: Option<f64>,
) -> Option<f64> {
    let own_hz = simulator.std_hz(mode, measurement.frequencies_hz[mode]?.get());
    let stated_hz = measurement.std_hz.as_ref().and_then(|stds| stds[mode]).unwrap_or(own_hz);
    let step_hz = step_hz.unwrap_or(FINEST_HZ);
    Some((step_hz / (2.0 * std::f64::consts::PI.sqrt() * own_hz.min(stated_hz))).min(1.0))
}

/// Sets a mode aside whose frequency stands still to the last digit while others move: its identification repeats an old value. `kept` and
/// `earlier` are in the order of time. That r measurements in a row have the same value by chance has a probability of `(q/(2 √π σ))^(r−1)`
/// at most.
pub fn standing_still(
    simulator: &Simulator,
    kept: &mut [(usize, ModalMeasurement)],
    earlier: &[Vec<Option<Hertz>>],
    findings: &mut Vec<Finding>,
) {
    let Some((_, last)) = kept.last().cloned() else { return };
    let steps_hz = steps_hz(kept);
    // An earlier version of the structure may have had another number of modes.
    let before = earlier.iter().map(Vec::as_slice).filter(|row| row.len() == last.frequencies_hz.len());
    let rows: Vec<&[Option<Hertz>]> = before.chain(kept.iter().map(|(_, m)| m.frequencies_hz.as_slice())).collect();
    // Number of measurements at the end that have nothing but the last value of a mode, with the others between them.
    let stands = |mode: usize| {
        let value = last.frequencies_hz[mode]?;
        let same = rows.iter().rev().take_while(|row| row[mode].is_none_or(|f| f == value)).count();
        let run = &rows[rows.len() - same..];
        let with_mode = run.iter().filter(|row| row[mode].is_some()).count();
        let moves = |other: usize| {
            let mut values = run.iter().filter_map(|row| row[other]);
            values.next().is_some_and(|first| values.any(|f| f != first))
        };
        let others_move = (0..last.frequencies_hz.len()).any(|other| other != mode && moves(other));
        let chance = coincidence(simulator, &last, mode, steps_hz[mode])?.powi(with_mode as i32 - 1);
        (same >= kept.len() && others_move && chance < REPEATED_CHANCE).then_some((with_mode, value))
    };
    let found: Vec<(usize, usize, Hertz)> =
        (0..last.frequencies_hz.len()).filter_map(|mode| stands(mode).map(|(count, f)| (mode, count, f))).collect();
    for (mode, count, frequency) in found {
        for (_, measurement) in kept.iter_mut() {
            drop_mode(measurement, mode);
        }
        let message = format!(
            "mode {} has had the same frequency of {} Hz to the last digit in {count} measurements, while others have moved: its \
             identification repeats an old value, and the mode is set aside",
            mode + 1,
            frequency.get()
        );
        findings.push(Finding::new(FindingCode::NoScatter, FindingEffect::Note, message));
    }
}

/// Measurements of which near-copies of an earlier one are left out, as repetitions are; a finding tells which.
///
/// Two independent measurements of a structure that does not change differ by √2 times their noise. The deviations of ln f, in standard
/// deviations of the noise, are turned to the directions in which they are uncorrelated, and scaled by the noise or by the scatter itself
/// where that is smaller: D² = |Δ|²/2 of independent measurements is then at least as large as a χ²_m variable, m the number of modes,
/// also where the noise is stated too large.
///
/// - Pairs are copies if there are more of them within a distance than chance gives: N r/2 pairs have D² below the (r/N) quantile.
/// - Groups are copies if at least 2.5 times as many pairs lie within a distance as for a normal distribution of the same covariance,
///   and twice the distance adds fewer pairs than it would in a continuous distribution: many measurements of few states.
pub fn counted_once(
    simulator: &Simulator,
    indices: Vec<usize>,
    observations: Vec<Observation>,
    findings: &mut Vec<Finding>,
) -> (Vec<usize>, Vec<Observation>) {
    let count = observations.len();
    let kept = match deviations(simulator, &observations).map(|deviations| Spread::of(&deviations)) {
        None => return (indices, observations),
        Some(spread) if spread.largest < NO_SCATTER * NO_SCATTER => vec![0],
        Some(spread) => spread.counted(),
    };
    if kept.len() == count {
        return (indices, observations);
    }
    let left_out: Vec<usize> = (0..count).filter(|row| !kept.contains(row)).map(|row| indices[row]).collect();
    let (effect, message) = if kept.len() == 1 {
        let message = format!(
            "all {count} measurements are near-copies of one: they scatter by less than {:.1} % of their noise, whereas independent ones \
             scatter by all of it",
            100.0 * NO_SCATTER
        );
        (FindingEffect::Reject, message)
    } else {
        let effect = if too_many(left_out.len(), count) { FindingEffect::HoldAlarm } else { FindingEffect::Note };
        let message = format!(
            "{} of {count} measurements are near-copies of others: they differ by far less than independent measurements with their noise \
             and scatter would, and {} are counted",
            left_out.len(),
            kept.len()
        );
        (effect, message)
    };
    findings.push(Finding::new(FindingCode::NearCopies, effect, message).of(left_out));
    let all = indices.into_iter().zip(observations).enumerate();
    all.filter(|(row, _)| kept.contains(row)).map(|(_, kept)| kept).unzip()
}

/// ln f of the modes that all measurements have, in standard deviations of their noise, `[n, modes]`; `None` where there are too few
/// measurements.
fn deviations(simulator: &Simulator, observations: &[Observation]) -> Option<DMatrix<f64>> {
    let first = observations.first()?;
    let modes: Vec<usize> = (0..first.frequencies_hz.len())
        .filter(|mode| observations.iter().all(|o| o.frequencies_hz[*mode].is_some()))
        .collect();
    if modes.is_empty() || observations.len() < modes.len() + FEWEST_BEYOND_MODES {
        return None;
    }
    let noise = |mode: usize| {
        let relative = |o: &Observation| o.frequencies_hz[mode].zip(o.std_hz(simulator, mode)).map(|(f, std)| std / f);
        stats::quantile(&observations.iter().filter_map(relative).collect::<Vec<_>>(), 0.5)
    };
    let noises: Vec<f64> = modes.iter().map(|mode| noise(*mode)).collect();
    if noises.iter().any(|noise| noise.is_nan() || *noise <= 0.0) {
        return None;
    }
    let logs = DMatrix::from_fn(observations.len(), modes.len(), |row, column| {
        observations[row].frequencies_hz[modes[column]].map_or(0.0, f64::ln)
    });
    Some(DMatrix::from_fn(logs.nrows(), logs.ncols(), |row, column| {
        (logs[(row, column)] - logs.column(column).mean()) / noises[column]
    }))
}

/// Measurements in the directions in which their deviations are uncorrelated.
struct Spread {
    /// Deviations in units of the smaller of noise and scatter, `[n][m]`.
    rows: Vec<Vec<f64>>,
    /// Variance in each direction in the same units, at least 1, `[m]`.
    wider: Vec<f64>,
    /// Largest variance of all directions, in units of the noise.
    largest: f64,
}

impl Spread {
    fn of(deviations: &DMatrix<f64>) -> Self {
        let n = deviations.nrows();
        let eigen = (deviations.tr_mul(deviations) / (n as f64 - 1.0)).symmetric_eigen();
        let variances: Vec<f64> = eigen.eigenvalues.iter().map(|variance| variance.max(1e-14)).collect();
        let turned = deviations * &eigen.eigenvectors;
        let scaled = |row: usize| -> Vec<f64> {
            variances.iter().enumerate().map(|(k, variance)| turned[(row, k)] / variance.min(1.0).sqrt()).collect()
        };
        Self {
            rows: (0..n).map(scaled).collect(),
            wider: variances.iter().map(|variance| variance.max(1.0)).collect(),
            largest: variances.iter().copied().fold(0.0, f64::max),
        }
    }

    /// D² of two measurements.
    fn distance(&self, a: usize, b: usize) -> f64 {
        0.5 * self.rows[a].iter().zip(&self.rows[b]).map(|(x, y)| (x - y).powi(2)).sum::<f64>()
    }

    /// Numbers of pairs within some squared distances.
    fn pairs(&self, thresholds: &[f64]) -> Vec<usize> {
        let largest = thresholds.iter().copied().fold(0.0, f64::max);
        let mut found = vec![0; thresholds.len()];
        for a in 1..self.rows.len() {
            for b in 0..a {
                let squared = self.distance(a, b);
                // Most pairs are further apart than all of them.
                if squared < largest {
                    for (found, threshold) in found.iter_mut().zip(thresholds) {
                        *found += usize::from(squared < *threshold);
                    }
                }
            }
        }
        found
    }

    /// The measurements that count: the first of each group of copies.
    fn counted(&self) -> Vec<usize> {
        let (n, modes) = (self.rows.len(), self.wider.len());
        let by_chance = SHARES_BY_CHANCE.map(|share| small_quantile(share / (n as f64 - 1.0), modes));
        let groups = GROUP_DISTANCES.map(|share| share * large_quantile(modes));
        let thresholds: Vec<f64> =
            by_chance.into_iter().chain(groups).chain(groups.map(|threshold| 4.0 * threshold)).collect();
        let pairs = self.pairs(&thresholds);
        let (close, rest) = pairs.split_at(by_chance.len());
        let (within, around) = rest.split_at(groups.len());
        let is_beyond_chance =
            |place: &usize| poisson_tail(close[*place], 0.5 * n as f64 * SHARES_BY_CHANCE[*place]) < CHANCE;
        let copies = (0..SHARES_BY_CHANCE.len()).rev().find(is_beyond_chance);
        let mut kept = copies.map_or_else(|| (0..n).collect(), |place| self.leaders(by_chance[place]));
        for (place, threshold) in groups.into_iter().enumerate() {
            let all = n * (n - 1) / 2;
            if within[place] < 10 || within[place] as f64 > 0.6 * all as f64 {
                continue;
            }
            if !self.is_grouped(threshold, within[place], around[place]) {
                continue;
            }
            let leaders = self.leaders(threshold);
            let few = leaders.len() >= FEWEST_GROUPS && (leaders.len() as f64) < MOST_LEFT * n as f64;
            if few && leaders.len() < kept.len() {
                kept = leaders;
            }
        }
        kept
    }

    /// The first measurement, and each that is further than a distance from all of these before it.
    fn leaders(&self, squared: f64) -> Vec<usize> {
        let mut kept: Vec<usize> = Vec::new();
        for row in 0..self.rows.len() {
            if kept.iter().all(|leader| self.distance(row, *leader) >= squared) {
                kept.push(row);
            }
        }
        kept
    }

    /// Whether the pairs within a distance, and within twice that distance, are those of groups.
    fn is_grouped(&self, squared: f64, within: usize, around: usize) -> bool {
        let mut stream = stats::stream(1, "pairs of a normal distribution");
        let mut draw = || {
            self.wider.iter().map(|variance| variance * stream.sample::<f64, _>(StandardNormal).powi(2)).sum::<f64>()
        };
        let draws: Vec<f64> = (0..DRAWS).map(|_| draw()).collect();
        let all = (self.rows.len() * (self.rows.len() - 1) / 2) as f64;
        // One of the draws at least, so that the growth is not overestimated.
        let share = |limit: f64| draws.iter().filter(|d| **d < limit).count().max(1) as f64 / DRAWS as f64;
        let (expected, expected_around) = (all * share(squared), all * share(4.0 * squared));
        let growth = around as f64 / within as f64;
        within as f64 >= 2.5 * expected + 5.0 * expected.sqrt() && growth <= 0.6 * expected_around / expected
    }
}

/// A quantile of χ²_m for a small probability, not above the exact one.
///
/// ```text
///  P(χ²_m < q) ≤ (q/2)^{m/2}/Γ(m/2 + 1)
/// ```
fn small_quantile(probability: f64, degrees: usize) -> f64 {
    let half = 0.5 * degrees as f64;
    2.0 * ((probability.ln() + ln_gamma(half + 1.0)) / half).exp()
}

/// 95 % quantile of χ²_m, by the approximation of Wilson and Hilferty.
fn large_quantile(degrees: usize) -> f64 {
    let part = 2.0 / (9.0 * degrees as f64);
    degrees as f64 * (1.0 - part + stats::normal_quantile(0.95) * part.sqrt()).powi(3)
}

/// P(X ≥ count) of a Poisson variable, 1 for a count of 0.
fn poisson_tail(count: usize, mean: f64) -> f64 {
    let term = |k: usize| (k as f64 * mean.ln() - mean - ln_gamma(k as f64 + 1.0)).exp();
    // Above its mean the terms fall quickly; below it the tail is not small.
    if count as f64 <= mean {
        return 1.0;
    }
    (count..count + 60).map(term).sum()
}

/// A finding about modes whose frequencies scatter by far less than the noise that the measurements state: the intervals are wider than
/// they need to be, and a loss is found later.
pub fn noise_overstated(kept: &[(usize, ModalMeasurement)]) -> Option<Finding> {
    let modes = kept.first()?.1.frequencies_hz.len();
    let mut parts = Vec::new();
    for mode in 0..modes {
        let stated = |(_, m): &(usize, ModalMeasurement)| {
            let frequency = m.frequencies_hz[mode].map(Hertz::get)?;
            Some((frequency.ln(), m.std_hz.as_ref()?.get(mode).copied()?? / frequency))
        };
        let all: Vec<(f64, f64)> = kept.iter().filter_map(stated).collect();
        if all.len() < 2 {
            continue;
        }
        let logs: Vec<f64> = all.iter().map(|(log, _)| *log).collect();
        let noise = stats::quantile(&all.iter().map(|(_, noise)| *noise).collect::<Vec<_>>(), 0.5);
        let Some(scatter) = stats::sample_std(&logs).filter(|scatter| *scatter < OVERSTATED_RATIO * noise) else {
            continue;
        };
        let degrees = all.len() - 1;
        let bound = small_quantile(OVERSTATED_CHANCE / modes as f64, degrees);
        if degrees as f64 * (scatter / noise).powi(2) < bound {
            parts.push(format!("mode {} by {:.2} %, not {:.2} %", mode + 1, 100.0 * scatter, 100.0 * noise));
        }
    }
    (!parts.is_empty()).then(|| {
        let message = format!(
            "the stated noise is far larger than the scatter that is seen, which contains it ({}): intervals are wider than necessary and \
             a loss is found later; check std_hz",
            parts.join("; ")
        );
        Finding::new(FindingCode::NoiseOverstated, FindingEffect::Note, message)
    })
}

#[cfg(test)]
mod tests {
    use statrs::distribution::{ChiSquared, ContinuousCDF as _, DiscreteCDF as _, Poisson};

    use super::*;

    #[test]
    fn quantiles_and_tails_are_those_of_the_distributions() {
        for degrees in [1, 3, 8] {
            let exact = ChiSquared::new(degrees as f64).unwrap();
            for probability in [1e-9, 1e-6, 1e-4] {
                let found = exact.cdf(small_quantile(probability, degrees));
                assert!(found <= probability * 1.000_001 && found > 0.3 * probability, "{degrees}: {found}");
            }
            assert!((exact.cdf(large_quantile(degrees)) - 0.95).abs() < 0.01);
        }
        let poisson = Poisson::new(0.5).unwrap();
        for count in [1, 4, 9] {
            assert!((poisson_tail(count, 0.5) / poisson.sf(count as u64 - 1) - 1.0).abs() < 1e-6);
        }
    }
}
