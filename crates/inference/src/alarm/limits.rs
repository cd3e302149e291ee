//! Limits of the charts, from simulated healthy operation.

use std::f64::consts::FRAC_PI_2;

use rand::Rng as _;
use rand_distr::{ChiSquared, StandardNormal};
use rayon::prelude::*;

use super::AlarmSettings;
use crate::process::limits::{continued, CONTINUED_FROM};
use structures::stats::{self, Stream};

/// Share of the target run length within which false alarms are counted.
const EARLY: f64 = 0.1;

/// Largest number of operations that are simulated, each with its own undamaged reference.
const MOST_OPERATIONS: usize = 10_000;

/// Number of batches simulated in total, over all operations and charts.
const BATCHES: usize = 6_000_000;

/// Shifts are clipped at this value before they enter the moving average, because a single extreme batch is already detected by the
/// limit of a single shift.
pub const CLIP: f64 = 4.0;

/// Charts of one structure that are simulated together; a structure with more is treated as several structures.
const MOST_CHARTS: usize = 6;

/// Number of shared parts ρ = sin²θ for which limits are simulated, with common random numbers and at equal steps of θ from 0 to π/2.
const NODES: usize = 16;

/// Longest mean run to a false alarm that is simulated, in batches; longer ones are continued from it, and from one that is
/// [`CONTINUED_FROM`] times shorter.
const LONGEST_RUN: f64 = 1e5;

/// What the limits depend on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Situation {
    /// Share ρ of the variance of a shift that comes from the undamaged reference and is the same in all batches.
    pub shared: f64,
    /// Degrees of freedom of the undamaged standard deviation.
    pub degrees_of_freedom: usize,
    /// Charts of the structure.
    pub charts: usize,
}

/// The limits of a chart.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Limit of a single shift, in standard errors.
    pub single: f64,
    /// Limit of the moving average of the shifts, in standard errors; infinite without a moving average.
    pub ewma: f64,
}

/// Limits at which healthy operation has as many early false alarms as a random process with one alarm in `run_batches`
/// batches; for every shared part ρ of the variance, which depends on the size of a batch.
///
/// ```text
///  shift of batch t:  z_t = (√ρ e + √(1 − ρ) ε_t)/s,    e, ε_t ~ N(0, 1) for each chart,   s² ~ χ²_ν/ν
///  P( first alarm within W/10 batches ) = 1 − exp(−1/10),    W the wanted mean run
/// ```
///
/// e and s are the errors of the undamaged reference, drawn once for each operation. With a well-known reference the mean run is W.
/// With a small reference the run lengths differ by orders of magnitude between operations; their mean is then dominated by a few
/// very long runs and larger than W. An error shared by all batches makes alarms occur in clusters, which alone would lower the
/// limit; the limit is therefore never lower than with ρ = 0. The limits of the single shift and of the moving average would each
/// give twice the target run alone; a common factor then adjusts both together.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LimitCurve {
    nodes: [Limits; NODES],
}

impl LimitCurve {
    /// Simulates healthy operation of `charts` charts whose undamaged standard deviations have ν `degrees_of_freedom`.
    ///
    /// Runs longer than 100,000 batches are not simulated: the squares of the limits grow with the logarithm of the run, as the largest of
    /// many normal deviates does, and are continued in a straight line from those of runs of 10,000 and 100,000.
    pub fn simulate(degrees_of_freedom: usize, charts: usize, settings: &AlarmSettings, run_batches: f64) -> Self {
        let of_run = |run: f64| Self::of_run(degrees_of_freedom, charts, settings, run);
        if run_batches <= LONGEST_RUN {
            return of_run(run_batches);
        }
        let [shorter, longest] = [of_run(LONGEST_RUN / CONTINUED_FROM), of_run(LONGEST_RUN)];
        let node = |node: usize| {
            let [shorter, longest] = [shorter.nodes[node], longest.nodes[node]];
            let single = continued([shorter.single, longest.single], run_batches / LONGEST_RUN);
            let ewma =
                longest.ewma.is_finite().then(|| continued([shorter.ewma, longest.ewma], run_batches / LONGEST_RUN));
            Limits { single, ewma: ewma.unwrap_or(f64::INFINITY) }
        };
        Self { nodes: std::array::from_fn(node) }
    }

    /// As [`Self::simulate`], for a run that is simulated.
    fn of_run(degrees_of_freedom: usize, charts: usize, settings: &AlarmSettings, run_batches: f64) -> Self {
        let wanted_charts = charts.max(1);
        let charts = wanted_charts.min(MOST_CHARTS);
        let wanted = run_batches * wanted_charts as f64 / charts as f64;
        let longest = (EARLY * wanted).ceil().max(1.0) as usize;
        let operations = (BATCHES / (longest * charts)).clamp(300, MOST_OPERATIONS);
        // √ρ and √(1 − ρ).
        let angle = |node: usize| node as f64 / (NODES - 1) as f64 * FRAC_PI_2;
        let shares: [(f64, f64); NODES] = std::array::from_fn(|node| angle(node).sin_cos());
        let one = |operation: usize| {
            let mut stream = stats::stream(operation as u64, "healthy operation");
            records(&shares, degrees_of_freedom, charts, settings, longest, &mut stream)
        };
        let records: Vec<Records> = (0..operations).into_par_iter().map(one).collect();
        let share = |wanted: f64| 1.0 - (-(longest as f64) / wanted).exp();
        let nodes: Vec<Limits> = (0..NODES)
            .into_par_iter()
            .map(|node| {
                // The value of the statistic that this share of the operations exceeds.
                let level = |statistic: &dyn Fn(&Records) -> f64, share: f64| {
                    let mut all: Vec<f64> = records.iter().map(statistic).collect();
                    let exceeding = (share * operations as f64) as usize;
                    let (_, level, _) = all.select_nth_unstable_by(exceeding, |a, b| b.total_cmp(a));
                    level.max(f64::MIN_POSITIVE)
                };
                let (of_single, of_ewma) =
                    (|r: &Records| f64::from(r.single[node]), |r: &Records| f64::from(r.ewma[node]));
                if settings.ewma_weight == 0.0 {
                    return Limits { single: level(&of_single, share(wanted)), ewma: f64::INFINITY };
                }
                let alone = share(2.0 * wanted);
                let (single, ewma) = (level(&of_single, alone), level(&of_ewma, alone));
                let of_both = |r: &Records| (of_single(r) / single).max(of_ewma(r) / ewma);
                let factor = level(&of_both, share(wanted));
                Limits { single: factor * single, ewma: factor * ewma }
            })
            .collect();
        Self { nodes: nodes.try_into().expect("one for each node") }
    }

    /// The limits where a share ρ of the variance comes from the undamaged reference: cubic interpolation in θ through the four
    /// nearest simulated nodes, mirrored at θ = 0, because e and −e are equivalent.
    pub fn at(&self, shared: f64) -> Limits {
        let position = shared.clamp(0.0, 1.0).sqrt().asin() / FRAC_PI_2 * (NODES - 1) as f64;
        let first = (position as isize - 1).min(NODES as isize - 4);
        let about = [0, 1, 2, 3].map(|k| first + k);
        let weights = about.map(|a| {
            let others = about.iter().filter(|b| **b != a);
            others.map(|&b| (position - b as f64) / (a - b) as f64).product::<f64>()
        });
        let unshared = &self.nodes[0];
        let cubic = |of: fn(&Limits) -> f64| {
            let nodes = about.map(|node| of(&self.nodes[node.unsigned_abs()]));
            let found: f64 = nodes.iter().zip(&weights).map(|(node, weight)| node * weight).sum();
            found.max(of(unshared))
        };
        // Without a moving average its limit is infinite, and the interpolation would give NaN.
        let ewma = if unshared.ewma.is_finite() { cubic(|l| l.ewma) } else { f64::INFINITY };
        Limits { single: cubic(|l| l.single), ewma }
    }
}

/// The limits for one situation, for one false alarm in `run_batches` healthy batches.
pub fn limits(situation: Situation, settings: &AlarmSettings, run_batches: f64) -> Limits {
    LimitCurve::simulate(situation.degrees_of_freedom, situation.charts, settings, run_batches).at(situation.shared)
}

/// Largest statistics of one operation, for each node of ρ.
struct Records {
    single: [f32; NODES],
    ewma: [f32; NODES],
}

fn records(
    shares: &[(f64, f64); NODES],
    degrees_of_freedom: usize,
    charts: usize,
    settings: &AlarmSettings,
    longest: usize,
    stream: &mut Stream,
) -> Records {
    let degrees = degrees_of_freedom.max(1) as f64;
    let chi_squared = ChiSquared::new(degrees).expect("degrees of freedom are positive");
    let mut found = Records { single: [f32::NEG_INFINITY; NODES], ewma: [f32::NEG_INFINITY; NODES] };
    for _ in 0..charts {
        let e: f64 = stream.sample(StandardNormal);
        let s = (stream.sample(chi_squared) / degrees).sqrt();
        // z = shared + own·ε, in single precision, of which a vector register holds twice as many numbers.
        let (shared, own) = (shares.map(|(sin, _)| (sin * e / s) as f32), shares.map(|(_, cos)| (cos / s) as f32));
        let (mut average, mut largest) = ([0.0_f32; NODES], [f32::NEG_INFINITY; NODES]);
        let (weight, keep) = (settings.ewma_weight as f32, 1.0 - settings.ewma_weight as f32);
        // k of m points are above a limit when the k-th largest of the window and the newest are. z increases with ε.
        let mut highest = f32::NEG_INFINITY;
        let mut window = vec![f32::NEG_INFINITY; settings.window];
        let mut sorted = Vec::with_capacity(settings.window);
        for batch in 0..longest {
            let epsilon = stream.sample::<f64, _>(StandardNormal) as f32;
            for node in 0..NODES {
                let z = shared[node] + own[node] * epsilon;
                average[node] = keep * average[node] + weight * z.clamp(-CLIP as f32, CLIP as f32);
                largest[node] = largest[node].max(average[node]);
            }
            if settings.window == 1 {
                highest = highest.max(epsilon);
            } else {
                window[batch % settings.window] = epsilon;
                sorted.clone_from(&window);
                sorted.sort_by(|a, b| b.total_cmp(a));
                highest = highest.max(epsilon.min(sorted[settings.needed - 1]));
            }
        }
        for node in 0..NODES {
            found.ewma[node] = found.ewma[node].max(largest[node]);
            // A run with fewer than k points has no statistic.
            if highest > f32::NEG_INFINITY {
                found.single[node] = found.single[node].max(shared[node] + own[node] * highest);
            }
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::super::chart::{ChartPoint, Series};
    use super::super::machine::State;
    use super::*;

    fn settings() -> AlarmSettings {
        AlarmSettings { ewma_weight: 0.0, ..AlarmSettings::default() }
    }

    #[test]
    fn with_a_perfectly_known_undamaged_reference_the_limit_is_the_normal_quantile() {
        let situation = Situation { shared: 0.0, degrees_of_freedom: 1_000_000, charts: 1 };
        let found = limits(situation, &settings(), 200.0).single;
        let run = 1.0 / stats::normal_cdf(-found);
        // 9.5 % of 10,000 operations alarm early: the share, and with it the run, is known to 3 %.
        assert!((run / 200.0 - 1.0).abs() < 0.12, "limit {found}: run {run}");
    }

    #[test]
    fn the_limit_of_a_run_that_is_too_long_to_simulate_is_the_normal_quantile_as_well() {
        let situation = Situation { shared: 0.0, degrees_of_freedom: 1_000_000, charts: 1 };
        let found = limits(situation, &settings(), 5e6).single;
        let run = 1.0 / stats::normal_cdf(-found);
        // The two limits behind it are each known to the error of their share, 10 % of 300 operations or more: 18 % of the run, and
        // the line through them continues it by a factor of 50. A straight line in z² leaves out the slowly varying factor of the tail.
        assert!((0.3..3.0).contains(&(run / 5e6)), "limit {found}: run {run}");
    }

    #[test]
    fn limits_widen_with_charts_and_with_a_small_undamaged_reference() {
        let limit = |shared, degrees_of_freedom, charts| {
            limits(Situation { shared, degrees_of_freedom, charts }, &settings(), 300.0).single
        };
        let easy = limit(0.0, 10_000, 1);
        assert!(limit(0.0, 10_000, 5) > easy + 0.2);
        assert!(limit(0.0, 9, 1) > easy + 0.2);
        // The less precisely the undamaged reference is known, the wider the limits.
        let by_size: Vec<f64> = [(0.0, 1_000), (0.2, 120), (0.5, 29), (0.9, 9)].map(|(s, d)| limit(s, d, 2)).into();
        assert!(by_size.windows(2).all(|pair| pair[1] > pair[0]), "{by_size:?}");
    }

    #[test]
    fn two_of_three_needs_a_lower_limit_than_one_of_one() {
        let situation = Situation { shared: 0.05, degrees_of_freedom: 100, charts: 2 };
        let one = limits(situation, &settings(), 300.0).single;
        let two = limits(situation, &AlarmSettings { needed: 2, window: 3, ..settings() }, 300.0).single;
        assert!(two < one - 0.5 && two > 1.0, "{two} and {one}");
    }

    /// Share of operations with an alarm within `longest` batches, simulated with the charts themselves and with independent random
    /// numbers.
    fn early(situation: Situation, limits: &Limits, settings: &AlarmSettings, operations: u64, longest: usize) -> f64 {
        let chi_squared = ChiSquared::new(situation.degrees_of_freedom as f64).unwrap();
        let alarms = |operation: u64| {
            let mut stream = stats::stream(operation, "test: early alarms");
            (0..situation.charts).any(|_| {
                let e: f64 = stream.sample(StandardNormal);
                let s = (stream.sample(chi_squared) / situation.degrees_of_freedom as f64).sqrt();
                let mut series = Series::new(*settings);
                (0..longest).any(|_| {
                    let epsilon: f64 = stream.sample(StandardNormal);
                    let z = (situation.shared.sqrt() * e + (1.0 - situation.shared).sqrt() * epsilon) / s;
                    series.take(&ChartPoint::damage(z, limits, false)).state == State::Alarming
                })
            })
        };
        (0..operations).into_par_iter().filter(|&operation| alarms(operation)).count() as f64 / operations as f64
    }

    #[test]
    fn between_the_simulated_shared_parts_the_rate_of_false_alarms_is_as_wanted() {
        let operations = 40_000;
        for settings in [AlarmSettings::default(), AlarmSettings { needed: 2, window: 3, ..AlarmSettings::default() }] {
            let curve = LimitCurve::simulate(60, 2, &settings, 300.0);
            let wanted = 1.0 - (-EARLY).exp();
            // Standard error of the share, from the operations simulated here and from those behind the limits.
            let error = (wanted * (1.0 - wanted) * (1.0 / operations as f64 + 1.0 / MOST_OPERATIONS as f64)).sqrt();
            // Positions in the middle between the simulated nodes.
            for position in [0.5, 1.5, 2.5, 4.5, 7.5, 10.5, 13.5, 14.5] {
                let shared = (position / (NODES - 1) as f64 * FRAC_PI_2).sin().powi(2);
                let limits = curve.at(shared);
                let situation = Situation { shared, degrees_of_freedom: 60, charts: 2 };
                let found = early(situation, &limits, &settings, operations, 30);
                assert!(found < wanted + 4.0 * error, "{shared}: {found}");
                // Where the limit of ρ = 0 is the higher one, single shifts raise fewer alarms; the moving average still
                // contributes its half.
                let least = if limits.single > curve.at(0.0).single { wanted } else { 0.5 * wanted };
                assert!(found > least - 4.0 * error, "{shared}: {found}");
            }
        }
    }
}
