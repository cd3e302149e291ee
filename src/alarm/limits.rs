//! Limits of the charts, by simulation of healthy operation.

use rand::Rng as _;
use rand_distr::{ChiSquared, StandardNormal};
use rayon::prelude::*;

use super::AlarmSettings;
use crate::stats::{self, Stream};

/// Share of the wanted run within which false alarms are counted.
const EARLY: f64 = 0.1;

/// Most operations simulated, each with an undamaged state of its own.
const MOST_OPERATIONS: usize = 10_000;

/// Batches simulated in all, over operations and charts.
const BATCHES: usize = 6_000_000;

/// Largest shift that enters the moving average: one wild batch is the business of the single limit.
pub const CLIP: f64 = 4.0;

/// Charts of one structure that are simulated together; more are taken as several such structures.
const MOST_CHARTS: usize = 6;

/// What the limits depend on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Situation {
    /// Share of the variance of a shift that comes from the undamaged state and is the same in all batches.
    pub shared: f64,
    /// Degrees of freedom of the undamaged standard deviation.
    pub degrees_of_freedom: usize,
    /// Charts of the structure.
    pub charts: usize,
}

/// The limits of a chart.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Of one shift, in standard errors.
    pub single: f64,
    /// Of the moving average of shifts.
    pub ewma: f64,
}

/// Limits at which healthy operation has as many early false alarms as if they came at random, one in `mean_run_batches`.
///
/// ```text
///  shift of batch t:  z_t = (√ρ e + √(1 − ρ) ε_t)/s,    e, ε_t ~ N(0, 1) for each chart,   s² ~ χ²_ν/ν
///  P( first alarm within W/10 batches ) = 1 − exp(−1/10),    W the wanted mean run
/// ```
///
/// e and s are the errors of the undamaged state, drawn once for each operation. With a well-known undamaged state the mean
/// run is W. With a small one the runs differ from operation to operation by orders of magnitude; their mean then says
/// little (a few endless ones would pay for many that alarm at once), and comes out longer than W. An error that all batches
/// share makes alarms come together, which alone would lower the limit: what is known less never gets a lower limit than
/// with ρ = 0. Both charts get limits that would have twice the wanted run alone; a common factor then makes both together
/// right.
pub fn limits(situation: Situation, settings: &AlarmSettings) -> Limits {
    let known = simulated(Situation { shared: 0.0, ..situation }, settings);
    let found = if situation.shared > 0.0 { simulated(situation, settings) } else { known };
    Limits { single: found.single.max(known.single), ewma: found.ewma.max(known.ewma) }
}

fn simulated(situation: Situation, settings: &AlarmSettings) -> Limits {
    let charts = situation.charts.clamp(1, MOST_CHARTS);
    let wanted = settings.mean_run_batches * situation.charts.max(1) as f64 / charts as f64;
    let longest = (EARLY * wanted).ceil().max(1.0) as usize;
    let operations = (BATCHES / (longest * charts)).clamp(300, MOST_OPERATIONS);
    let one = |operation: usize| {
        let mut stream = stats::stream(operation as u64, "healthy operation");
        records(situation, charts, settings, longest, &mut stream)
    };
    let records: Vec<Records> = (0..operations).into_par_iter().map(one).collect();
    let early = |single: f64, ewma: f64| {
        let alarmed = |r: &&Records| r.single > single || r.ewma > ewma;
        records.iter().filter(alarmed).count() as f64 / operations as f64
    };
    let share = |wanted: f64| 1.0 - (-(longest as f64) / wanted).exp();
    let both = settings.ewma_weight > 0.0;
    let alone = if both { share(2.0 * wanted) } else { share(wanted) };
    let single = bisect(|limit| early(limit, f64::INFINITY) > alone);
    if !both {
        return Limits { single, ewma: f64::INFINITY };
    }
    let ewma = bisect(|limit| early(f64::INFINITY, limit) > alone);
    let factor = bisect(|factor| early(factor * single, factor * ewma) > share(wanted));
    Limits { single: factor * single, ewma: factor * ewma }
}

/// Largest statistics of one operation.
struct Records {
    single: f64,
    ewma: f64,
}

fn records(
    situation: Situation,
    charts: usize,
    settings: &AlarmSettings,
    longest: usize,
    stream: &mut Stream,
) -> Records {
    let degrees = situation.degrees_of_freedom.max(1) as f64;
    let chi_squared = ChiSquared::new(degrees).expect("degrees of freedom are positive");
    let errors: Vec<(f64, f64)> = (0..charts)
        .map(|_| {
            let e: f64 = stream.sample(StandardNormal);
            let s = (stream.sample(chi_squared) / degrees).sqrt();
            (situation.shared.sqrt() * e, s)
        })
        .collect();
    let own = (1.0 - situation.shared).sqrt();
    let weight = settings.ewma_weight;
    let (mut averages, mut windows) = (vec![0.0; charts], vec![vec![f64::NEG_INFINITY; settings.window]; charts]);
    let mut found = Records { single: f64::NEG_INFINITY, ewma: f64::NEG_INFINITY };
    let mut sorted = Vec::with_capacity(settings.window);
    for batch in 1..=longest {
        for (chart, (shared, s)) in errors.iter().enumerate() {
            let z = (shared + own * stream.sample::<f64, _>(StandardNormal)) / s;
            averages[chart] = (1.0 - weight) * averages[chart] + weight * z.clamp(-CLIP, CLIP);
            found.ewma = found.ewma.max(averages[chart]);
            if settings.window == 1 {
                found.single = found.single.max(z);
            } else {
                // k of m above a limit: the k-th largest of the window is, and the newest with it.
                windows[chart][batch % settings.window] = z;
                sorted.clone_from(&windows[chart]);
                sorted.sort_by(|a, b| b.total_cmp(a));
                found.single = found.single.max(z.min(sorted[settings.needed - 1]));
            }
        }
    }
    found
}

/// Least value at which `too_low` no longer holds.
fn bisect(too_low: impl Fn(f64) -> bool) -> f64 {
    let (mut low, mut high) = (0.0, 40.0);
    for _ in 0..40 {
        let middle = 0.5 * (low + high);
        if too_low(middle) {
            low = middle;
        } else {
            high = middle;
        }
    }
    high
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings(mean_run_batches: f64) -> AlarmSettings {
        AlarmSettings { mean_run_batches, ewma_weight: 0.0, ..AlarmSettings::default() }
    }

    #[test]
    fn with_a_perfectly_known_undamaged_state_the_limit_is_the_normal_quantile() {
        let situation = Situation { shared: 0.0, degrees_of_freedom: 1_000_000, charts: 1 };
        let found = limits(situation, &settings(200.0)).single;
        let run = 1.0 / stats::normal_cdf(-found);
        // 9.5 % of 10,000 operations alarm early: the share, and with it the run, is known to 3 %.
        assert!((run / 200.0 - 1.0).abs() < 0.12, "limit {found}: run {run}");
    }

    #[test]
    fn limits_widen_with_charts_and_with_a_small_undamaged_state() {
        let limit = |shared, degrees_of_freedom, charts| {
            limits(Situation { shared, degrees_of_freedom, charts }, &settings(300.0)).single
        };
        let easy = limit(0.0, 10_000, 1);
        assert!(limit(0.0, 10_000, 5) > easy + 0.2);
        assert!(limit(0.0, 9, 1) > easy + 0.2);
        // The less is known of the undamaged state, the wider.
        let by_size: Vec<f64> = [(0.0, 1_000), (0.2, 120), (0.5, 29), (0.9, 9)].map(|(s, d)| limit(s, d, 2)).into();
        assert!(by_size.windows(2).all(|pair| pair[1] > pair[0]), "{by_size:?}");
    }

    #[test]
    fn two_of_three_needs_a_lower_limit_than_one_of_one() {
        let situation = Situation { shared: 0.05, degrees_of_freedom: 100, charts: 2 };
        let one = limits(situation, &settings(300.0)).single;
        let two = limits(situation, &AlarmSettings { needed: 2, window: 3, ..settings(300.0) }).single;
        assert!(two < one - 0.5 && two > 1.0, "{two} and {one}");
    }
}
