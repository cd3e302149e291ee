//! Simulated years with unmeasured weather. The generator shares no code with the program.

use modalwatch::process::estimate::BatchEstimate;
use modalwatch::quantity::Timestamp;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use modalwatch::process::limits::limits;

use super::watch::{episodes, named as named_in, quantities, reference, watch};

const DAYS: usize = 1_095;
const REFERENCE: usize = 365;
const WORLDS: u64 = 20;
/// A wanted run that is short enough to be measured.
const SHORT_RUN: f64 = 200.0;
/// Batches below the limits after which an alarm has ended.
const QUIET: usize = 3;
pub(super) const NAMES: [&str; 4] = ["k1", "k2", "k3", "k4"];
const STIFFNESS: [f64; 4] = [4.0, 5.0, 6.0, 3.0];
/// Sensitivity of each stiffness to the weather.
const SENSITIVITY: [f64; 4] = [1.0, 0.8, 0.6, 0.9];

/// One batch a day: weather of 5 % with a correlation of 0.9 from day to day, 0.5 % of each stiffness by itself, errors of 0.4 %. The
/// stiffness `lost` is multiplied by `factor` of the day.
pub(super) fn world(seed: u64, lost: usize, factor: impl Fn(usize) -> f64) -> Vec<BatchEstimate> {
    let mut stream = ChaCha8Rng::seed_from_u64(900 + seed);
    let mut weather: f64 = stream.sample(StandardNormal);
    let one = |day: usize| {
        let jump: f64 = stream.sample(StandardNormal);
        weather = 0.9 * weather + (1.0_f64 - 0.81).sqrt() * jump;
        let stiffness = |k: usize| {
            let (own, error): (f64, f64) = (stream.sample(StandardNormal), stream.sample(StandardNormal));
            let usual = STIFFNESS[k] * (1.0 + 0.05 * SENSITIVITY[k] * weather + 0.005 * own);
            Some(usual * if k == lost { factor(day) } else { 1.0 } + STIFFNESS[k] * 0.004 * error)
        };
        let mean = (0..4).map(stiffness).collect();
        let variance =
            |place: usize| if place.is_multiple_of(5) { (0.004 * STIFFNESS[place / 5]).powi(2) } else { 0.0 };
        BatchEstimate {
            at: Timestamp::from_micros(86_400_000_000 * day as i64).unwrap(),
            mean,
            covariance: (0..16).map(variance).collect(),
            covariates: Vec::new(),
        }
    };
    (0..DAYS).map(one).collect()
}

#[test]
#[ignore = "a study of half a minute"]
fn simulated_years_alarm_as_rarely_as_wanted_and_losses_are_found() {
    let quantities = quantities(&NAMES, "N/m");
    let (mut alarms, mut batches, mut found, mut delays, mut slow) = (0_u32, 0, 0, Vec::new(), Vec::new());
    let (mut named, mut short_alarms) = (0, 0_u32);
    for seed in 0..WORLDS {
        let healthy = world(seed, 0, |_| 1.0);
        let reference = reference(&quantities, &healthy[..REFERENCE], 1_000.0);
        let above: Vec<bool> = watch(&reference, &healthy[REFERENCE..]).iter().map(Option::is_some).collect();
        alarms += episodes(&above, QUIET).len() as u32;
        batches += above.len();
        // Short runs, of which there are more.
        let mut short = reference.clone();
        short.limits = limits(&short.process, &quantities.directions, SHORT_RUN, 1).unwrap();
        let above: Vec<bool> = watch(&short, &healthy[REFERENCE..]).iter().map(Option::is_some).collect();
        short_alarms += episodes(&above, QUIET).len() as u32;
        // A lasting loss of 5 % in one spring, at some time of the second year.
        let (lost, onset) = ((seed % 4) as usize, 400 + 15 * seed as usize);
        let damaged = world(seed, lost, |day| if day >= onset { 0.95 } else { 1.0 });
        let changes = watch(&reference, &damaged[REFERENCE..onset + 60]);
        let first = (onset..onset + 60).find(|day| changes[day - REFERENCE].is_some());
        let delay = first.map_or(60, |day| day - onset + 1);
        delays.push(delay);
        found += usize::from(delay <= 15);
        named +=
            usize::from(first.is_some_and(|day| named_in(changes[day - REFERENCE].as_ref())[0].contains(&NAMES[lost])));
        // A loss of 1 % a month.
        let begin = 400;
        let share = |day: usize| 1.0 - 0.01 * (day as f64 - begin as f64).max(0.0) / 30.4;
        let falling = watch(&reference, &world(seed, lost, share)[REFERENCE..]);
        let first = (begin..DAYS).find(|day| falling[day - REFERENCE].is_some());
        slow.push(first.map_or(f64::NAN, |day| 100.0 * (1.0 - share(day))));
    }
    println!("{alarms} false alarms in {batches} batches: run {:.0}", batches as f64 / f64::from(alarms.max(1)));
    println!("wanted run {SHORT_RUN}: {:.0}", batches as f64 / f64::from(short_alarms.max(1)));
    println!("5 % found within 15 batches in {found} of {WORLDS} (named in {named}), delays {delays:?}");
    println!("1 % a month found at {slow:.1?} %");
    // Poisson: 14.6 alarms are expected, with a standard deviation of 3.8.
    let run = batches as f64 / f64::from(alarms.max(1));
    assert!((700.0..1_500.0).contains(&run), "{run}");
    assert!(found >= 18 && slow.iter().all(|percent| *percent < 6.0));
}
