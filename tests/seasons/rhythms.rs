//! False alarms by time, for batches every minute to every week. The generator shares no code with the program.

use modalwatch::process::change::Evidence;
use modalwatch::process::estimate::BatchEstimate;
use modalwatch::process::filter::Filter;
use modalwatch::process::limits::{limits, Limits};
use modalwatch::process::reference::{Chain, ReferenceProcess};
use modalwatch::quantity::Timestamp;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use rayon::prelude::*;

use super::watch::{episodes, quantities, reference};

const NAMES: [&str; 3] = ["k1", "k2", "k3"];
const STIFFNESS: [f64; 3] = [4.0, 5.0, 6.0];

/// Sensitivity of each stiffness to the weather and to the time of day that nobody measures, and its own slow scatter.
const WEATHER: [f64; 3] = [0.02, 0.015, 0.01];
const OWN: f64 = 0.002;

/// Error of a batch, as a share.
const ERROR: f64 = 0.003;

/// Days over which the weather and the slow scatter last.
const LASTING_DAYS: [f64; 2] = [9.5, 0.3];

const YEAR_DAYS: f64 = 365.25;

/// Batches below the limits after which an alarm has ended.
const QUIET: usize = 3;

/// Limits above all evidence, at which the chart of all quantities shows its own evidence alone.
const NO_LIMITS: Limits =
    Limits { quantity: Evidence { fast: 1e12, slow: 1e12 }, joint: Evidence { fast: 1e6, slow: 1e6 }, misfit: None };

/// How often batches come, how many are in the reference, and for how many structures and years they are watched.
struct Rhythm {
    name: &'static str,
    days: f64,
    reference: usize,
    worlds: u64,
    years: f64,
    /// Years between two false alarms, short enough to be counted, and long.
    wanted: &'static [f64],
}

const RHYTHMS: [Rhythm; 4] = [
    Rhythm { name: "week", days: 7.0, reference: 60, worlds: 40, years: 60.0, wanted: &[10.0] },
    Rhythm { name: "day", days: 1.0, reference: 200, worlds: 24, years: 50.0, wanted: &[1.0, 10.0] },
    Rhythm { name: "hour", days: 1.0 / 24.0, reference: 400, worlds: 16, years: 2.0, wanted: &[0.3, 1.0, 10.0] },
    Rhythm {
        name: "minute",
        days: 1.0 / 1_440.0,
        reference: 600,
        worlds: 12,
        years: 0.03,
        wanted: &[0.01, 0.03, 10.0],
    },
];

/// Batches of a structure; the stiffness k2 is multiplied by `factor` of the batch.
fn world(
    rhythm: &Rhythm,
    seed: u64,
    count: usize,
    factor: impl Fn(usize) -> f64,
) -> impl Iterator<Item = BatchEstimate> {
    let mut stream = ChaCha8Rng::seed_from_u64(7_000 + seed);
    let keeps = LASTING_DAYS.map(|days| (-rhythm.days / days).exp());
    let mut normal = move || stream.sample::<f64, _>(StandardNormal);
    let mut states: [f64; 4] = std::array::from_fn(|_| normal());
    let variance = |place: usize| if place.is_multiple_of(4) { (ERROR * STIFFNESS[place / 4]).powi(2) } else { 0.0 };
    let covariance: Vec<f64> = (0..9).map(variance).collect();
    let step_us = (rhythm.days * 86_400e6) as i64;
    (0..count).map(move |t| {
        for (place, state) in states.iter_mut().enumerate() {
            let keep = keeps[usize::from(place > 0)];
            *state = keep * *state + (1.0 - keep * keep).sqrt() * normal();
        }
        let mean = |k: usize| {
            let healthy = STIFFNESS[k] * (1.0 + WEATHER[k] * states[0] + OWN * states[k + 1]);
            let lost = if k == 1 { factor(t) } else { 1.0 };
            Some(healthy * lost + STIFFNESS[k] * ERROR * normal())
        };
        BatchEstimate {
            at: Timestamp::from_micros(step_us * t as i64).unwrap(),
            mean: (0..3).map(mean).collect(),
            covariance: covariance.clone(),
            covariates: Vec::new(),
        }
    })
}

/// Largest evidence on the charts of single quantities and of all together, fast and slow, of each batch behind the reference.
fn evidence(made: &ReferenceProcess, batches: impl Iterator<Item = BatchEstimate>) -> Vec<[Evidence; 2]> {
    let mut free = made.clone();
    free.limits = NO_LIMITS;
    let filter = Filter::of(&free.process);
    let mut batches = batches.peekable();
    let first = batches.peek().unwrap().at;
    let mut chain = Chain::start(&free, &filter, first);
    let largest = |own: &mut dyn Iterator<Item = Evidence>| {
        own.fold(Evidence::NONE, |a, b| Evidence { fast: a.fast.max(b.fast), slow: a.slow.max(b.slow) })
    };
    batches
        .map(|batch| {
            let found = chain.take(&batch).unwrap().evidence;
            [largest(&mut found.quantities.into_iter().flatten()), largest(&mut found.joint.into_iter())]
        })
        .collect()
}

fn above(found: &[[Evidence; 2]], limits: &Limits) -> Vec<bool> {
    let over = |own: Evidence, limit: Evidence| own.fast > limit.fast || own.slow > limit.slow;
    found.iter().map(|[quantity, joint]| over(*quantity, limits.quantity) || over(*joint, limits.joint)).collect()
}

/// Days from a loss of k2 to its alarm, from 2 % on; at most 200 batches.
fn delay(made: &ReferenceProcess, rhythm: &Rhythm, seed: u64, loss: f64) -> f64 {
    let onset = rhythm.reference + 100;
    let batches = world(rhythm, seed, onset + 200, |t| if t < onset { 1.0 } else { 1.0 - loss });
    let filter = Filter::of(&made.process);
    let mut batches = batches.skip(rhythm.reference).peekable();
    let mut chain = Chain::start(made, &filter, batches.peek().unwrap().at).alarming_from(2.0);
    let limits = made.limits.joint;
    let mut raises = |batch: BatchEstimate| {
        chain.take(&batch).and_then(|p| p.evidence.joint).is_some_and(|e| e.fast > limits.fast || e.slow > limits.slow)
    };
    let found: Vec<bool> = batches.map(&mut raises).collect();
    let first = found[100..].iter().position(|raised| *raised);
    first.map_or(f64::INFINITY, |t| (t + 1) as f64 * rhythm.days)
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

#[test]
#[ignore = "a study of some minutes"]
fn structures_alarm_falsely_as_many_years_apart_as_wanted() {
    let of = quantities(&NAMES, "N/m");
    for rhythm in &RHYTHMS {
        let batches = (rhythm.years * YEAR_DAYS / rhythm.days) as usize;
        let runs: Vec<f64> = rhythm.wanted.iter().map(|years| years * YEAR_DAYS / rhythm.days).collect();
        let of_world = |seed: u64| {
            let all = rhythm.reference + batches;
            let first: Vec<BatchEstimate> = world(rhythm, seed, rhythm.reference, |_| 1.0).collect();
            let mut made = reference(&of, &first, 1_000.0);
            let by_batches = made.limits;
            let found = evidence(&made, world(rhythm, seed, all, |_| 1.0).skip(rhythm.reference));
            let at = |run: &f64| limits(&made.process, &of.directions, *run, 1).unwrap();
            let by_years: Vec<Limits> = runs.iter().map(at).collect();
            let count = |limits: &Limits| episodes(&above(&found, limits), QUIET).len();
            let alarms: Vec<usize> = by_years.iter().chain([&by_batches]).map(count).collect();
            let losses = [0.02, 0.05, 0.1];
            let before = losses.map(|loss| delay(&made, rhythm, seed, loss));
            made.limits = *by_years.last().unwrap();
            let delays = losses.map(|loss| delay(&made, rhythm, seed, loss));
            (alarms, by_years, before, delays)
        };
        let found: Vec<_> = (0..rhythm.worlds).into_par_iter().map(of_world).collect();
        let years = rhythm.years * rhythm.worlds as f64;
        println!(
            "a batch each {}: {years:.0} structure-years, references of {} batches",
            rhythm.name, rhythm.reference
        );
        for (place, wanted) in rhythm.wanted.iter().enumerate() {
            let alarms: usize = found.iter().map(|(alarms, ..)| alarms[place]).sum();
            let limit = median(found.iter().map(|(_, limits, ..)| limits[place].joint.fast).collect());
            println!("  wanted {wanted} years: {alarms} alarms, expected {:.1}; limit {limit:.2}", years / wanted);
        }
        let by_batches: usize = found.iter().map(|(alarms, ..)| *alarms.last().unwrap()).sum();
        println!(
            "  one in 1000 batches: {by_batches} alarms, expected {:.1}",
            batches as f64 * rhythm.worlds as f64 / 1_000.0
        );
        for (place, loss) in [2, 5, 10].into_iter().enumerate() {
            let before = median(found.iter().map(|(.., before, _)| before[place]).collect());
            let now = median(found.iter().map(|(.., delays)| delays[place]).collect());
            println!("  loss of {loss} %: median delay {now:.4} days, {before:.4} with one in 1000 batches");
        }
    }
}
