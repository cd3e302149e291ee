//! Laws of the process: its likelihood against the joint normal density, its gradient against differences, changes against their truth.

use nalgebra::{DMatrix, DVector};
use rand::Rng as _;
use rand_distr::StandardNormal;

use super::change::{change, evidence};
use super::direction::ChangeDirection;
use super::estimate::{BatchEstimate, Observation};
use super::filter::Filter;
use super::fit::{fit, observations, Quantities};
use super::followed::Memory;
use super::likelihood::{log_density, log_posterior};
use super::limits::{limits, Steady};
use super::model::{Numbers, Process, Sizes};
use super::parts::ChangePrior;
use super::reference::{Chain, ReferenceProcess};
use super::score::{score, Courses};
use super::smoother::smooth;
use structures::quantity::Timestamp;
use structures::stats;

const SIZES: Sizes = Sizes { quantities: 3, covariates: 1, factors: 1, log_steps_per_day: 0.0 };

/// μ, B, Λ, logits of φ and ρ, ln s, ln κ.
const UNKNOWNS: [f64; 17] =
    [0.3, -0.2, 0.1, 0.4, 0.0, -0.3, 0.8, 0.5, -0.6, 2.2, -0.5, 0.4, 1.0, -1.0, -1.5, -0.8, 0.2];

/// Observations at uneven times, of which some lack a quantity.
fn uneven(count: usize) -> Vec<Observation> {
    let mut stream = stats::stream(5, "test: observations of a process");
    let mut normal = || stream.sample::<f64, _>(StandardNormal);
    let one = |t: usize| {
        let informed: Vec<usize> = (0..3).filter(|k| !(t + k).is_multiple_of(4)).collect();
        let o = informed.len();
        Observation {
            steps: if t == 0 { 0.0 } else { [1.0, 0.5, 3.0][t % 3] },
            mean: DVector::from_fn(o, |_, _| normal()),
            covariance: DMatrix::from_fn(o, o, |i, j| if i == j { 0.1 + 0.02 * t as f64 } else { 0.03 }),
            covariates: DVector::from_element(1, normal()),
            missing: Vec::new(),
            informed,
        }
    };
    (0..count).map(one).collect()
}

#[test]
fn the_likelihood_is_the_joint_normal_density_of_all_observations() {
    let observations = uneven(7);
    let numbers = Numbers::of(&UNKNOWNS, SIZES);
    let contributions = numbers.contributions();
    let times: Vec<f64> = observations
        .iter()
        .scan(0.0, |time, o| {
            *time += o.steps;
            Some(*time)
        })
        .collect();
    let places: Vec<(usize, usize)> =
        observations.iter().enumerate().flat_map(|(t, o)| (0..o.informed.len()).map(move |i| (t, i))).collect();
    let covariance = |a: usize, b: usize| {
        let ((s, i), (t, j)) = (places[a], places[b]);
        let (k, l) = (observations[s].informed[i], observations[t].informed[j]);
        let of_states: f64 = (0..SIZES.states())
            .map(|state| {
                let decay = numbers.persistence[state].powf((times[s] - times[t]).abs());
                contributions[(k, state)] * contributions[(l, state)] * numbers.variance[state] * decay
            })
            .sum();
        let of_errors = if s == t { numbers.noise * observations[s].covariance[(i, j)] } else { 0.0 };
        of_states + of_errors
    };
    let n = places.len();
    let left = DVector::from_fn(n, |a, _| {
        let (t, i) = places[a];
        let k = observations[t].informed[i];
        let slope = (&numbers.slopes * &observations[t].covariates)[k];
        observations[t].mean[i] - numbers.mean[k] - slope
    });
    let factored = DMatrix::from_fn(n, n, covariance).cholesky().unwrap();
    let log_det = 2.0 * factored.l().diagonal().iter().map(|l| l.ln()).sum::<f64>();
    let expected = -0.5 * (left.dot(&factored.solve(&left)) + log_det + n as f64 * std::f64::consts::TAU.ln());
    let found = smooth(&Filter::exact(numbers), &observations).unwrap().log_likelihood;
    assert!((found - expected).abs() < 1e-8, "{found}, directly {expected}");
}

#[test]
fn the_gradient_is_that_of_finite_differences() {
    let observations = uneven(20);
    let density = |unknowns: &[f64]| log_posterior(unknowns, SIZES, &observations).unwrap();
    let (value, gradient) = density(&UNKNOWNS);
    let without_gradient = log_density(&UNKNOWNS, SIZES, &observations).unwrap();
    assert!((without_gradient - value).abs() < 1e-9, "{without_gradient}, with its gradient {value}");
    for place in 0..UNKNOWNS.len() {
        let h = 1e-5;
        let at = |step: f64| {
            let mut moved = UNKNOWNS;
            moved[place] += step;
            density(&moved).0
        };
        let expected = (at(h) - at(-h)) / (2.0 * h);
        // Central differences err by h² times third derivatives of up to 1e3, and by rounding of 1e-13/h.
        let allowed = 1e-5 * (1.0 + expected.abs());
        assert!(
            (gradient[place] - expected).abs() < allowed,
            "{place}: {}, by differences {expected}",
            gradient[place]
        );
    }
}

/// Healthy batches, one a day: a common factor of 5 % with correlation 0.9, 0.5 % of each parameter by itself, errors of 0.4 %; from
/// batch `onset` on, `loss` is added to each parameter.
pub(super) fn world(seed: u64, batches: usize, onset: usize, loss: [f64; 3]) -> Vec<BatchEstimate> {
    let mut stream = stats::stream(seed, "test: world with seasons");
    let mut normal = || stream.sample::<f64, _>(StandardNormal);
    let (mut factor, mut own) = (normal(), [normal(), normal(), normal()]);
    let one = |t: usize| {
        factor = 0.9 * factor + (1.0_f64 - 0.81).sqrt() * normal();
        let mean = (0..3).map(|k| {
            own[k] = 0.3 * own[k] + (1.0_f64 - 0.09).sqrt() * normal();
            let lost = if t >= onset { loss[k] } else { 0.0 };
            Some(4.0 * (1.0 + 0.05 * [1.0, 0.8, 0.5][k] * factor + 0.005 * own[k] + lost + 0.004 * normal()))
        });
        let mean = mean.collect();
        let covariance = (0..9).map(|place| if place % 4 == 0 { 0.016_f64.powi(2) } else { 0.0 }).collect();
        BatchEstimate {
            at: Timestamp::from_micros(86_400_000_000 * t as i64).unwrap(),
            mean,
            covariance,
            covariates: vec![],
        }
    };
    (0..batches).map(one).collect()
}

fn names() -> Quantities {
    let names = ["k1", "k2", "k3"].map(str::to_owned).to_vec();
    Quantities { names, units: vec!["N/m".to_owned(); 3], directions: vec![ChangeDirection::Decrease; 3], misfit: None }
}

fn fitted(seed: u64, batches: usize) -> Process {
    fit(&names(), &[], &world(seed, batches, usize::MAX, [0.0; 3]), &|_| {}).unwrap()
}

#[test]
fn the_fit_finds_the_common_factor_and_its_correlation() {
    let process = fitted(1, 365);
    let numbers = process.numbers();
    assert_eq!(process.factors, 1);
    // The standard error of a correlation of 0.9 from 365 batches is √((1 − 0.81)/365) = 0.023.
    assert!((numbers.persistence[0] - 0.9).abs() < 0.07, "{}", numbers.persistence[0]);
    let loading = |k: usize| (numbers.loadings[(k, 0)] * process.scales[k].unit / 4.0).abs();
    // A variance with a correlation time of 19 batches is known from about 20 independent ones: to 32 %, its root to 16 %.
    for (k, expected) in [0.05, 0.04, 0.025].into_iter().enumerate() {
        assert!((loading(k) / expected - 1.0).abs() < 0.5, "{k}: {}", loading(k));
    }
    // Ratios of loadings do not depend on how large the factor happened to be.
    assert!((loading(1) / loading(0) - 0.8).abs() < 0.03 && (loading(2) / loading(0) - 0.5).abs() < 0.03);
}

#[test]
fn the_fit_is_the_maximum_of_the_density() {
    let estimates = world(9, 120, usize::MAX, [0.0; 3]);
    let process = fit(&names(), &[], &estimates, &|_| {}).unwrap();
    let (_, gradient) = log_posterior(&process.unknowns, process.sizes(), &observations(&process, &estimates)).unwrap();
    // A slope of 0.01 moves an unknown whose standard deviation is 1 by 0.01 of it.
    assert!(gradient.iter().all(|slope| slope.abs() < 0.01), "{gradient:?}");
}

/// Innovations of the batches of a world after its first `reference`.
fn innovations(process: &Process, estimates: &[BatchEstimate]) -> Vec<super::filter::Innovation> {
    let filter = Filter::of(process);
    let mut known = filter.start();
    let one = |o: &Observation| {
        let (next, innovation) = filter.step(&known, o).unwrap();
        known = next;
        innovation
    };
    observations(process, estimates).iter().map(one).collect()
}

/// Worlds in which a loss is looked for.
const WORLDS: usize = 40;

#[test]
fn onset_and_size_of_a_loss_that_is_smaller_than_the_season_are_found() {
    let process = fitted(2, 365);
    let contributions = process.in_operation().contributions();
    let sizes = process.scales.iter().map(|scale| 4.0 / scale.unit).collect();
    let prior = ChangePrior { directions: vec![ChangeDirection::Decrease; 3], sizes, one_factor: Vec::new() };
    let (mut inside, mut onsets, mut named, mut accused) = (0, 0, 0, 0);
    for seed in 0..WORLDS as u64 {
        let after = innovations(&process, &world(100 + seed, 120, 100, [0.0, -0.03, 0.0]));
        let found = change(&after[60..], &contributions, &prior).unwrap();
        let (mean, std) = found.parts.change[1].unwrap();
        named += usize::from(found.parts.probability[1] > 0.9);
        accused += [0, 2].iter().filter(|k| found.parts.probability[**k] > 0.9).count();
        let percent = |value: f64| 100.0 * value * process.scales[1].unit / 4.0;
        inside += usize::from((percent(mean) + 3.0).abs() < 1.645 * percent(std));
        onsets += usize::from(found.onset_interval[0] <= 40 && 40 <= found.onset_interval[1]);
    }
    // Intervals of 90 %: 36 of 40 are expected with a standard deviation of 1.9; at least 29 is within 3.5 of it. The interval of an
    // onset covers whole batches and is therefore wider.
    assert!(inside >= 29 && onsets >= 29, "{inside} and {onsets} of {WORLDS}");
    // Each healthy quantity is named with a probability below 0.1, and mostly far below; a loss of four standard errors may be ambiguous.
    assert!(named >= 32 && accused <= 2, "{named} named and {accused} accused in {WORLDS}");
}

#[test]
fn a_parameter_that_is_not_informed_has_no_evidence() {
    let process = fitted(3, 200);
    let mut estimates = world(4, 30, usize::MAX, [0.0; 3]);
    estimates[29].mean[2] = None;
    let found = evidence(
        &innovations(&process, &estimates),
        &process.in_operation().contributions(),
        &[ChangeDirection::Decrease; 3],
    );
    assert!(found.quantities[0].is_some() && found.quantities[1].is_some() && found.quantities[2].is_none());
    assert!(found.joint.is_some());
}

#[test]
fn in_steady_operation_the_information_is_that_of_the_filter() {
    let process = fitted(6, 300);
    let steady = Steady::new(&process).unwrap();
    // Batches with the usual errors and the factor at its standard deviation are what the steady filter assumes; the factor of this
    // world wanders, so that only the size is compared.
    let innovations = innovations(&process, &world(7, 300, usize::MAX, [0.0; 3]));
    let found = score(&innovations[299..], &process.in_operation().contributions(), Courses::Step).information;
    for k in 0..3 {
        let ratio = found[(k, k)].sqrt().recip() / steady.standard_errors()[0][k];
        assert!((0.8..1.25).contains(&ratio), "{k}: {ratio}");
    }
}

#[test]
fn healthy_operation_alarms_as_rarely_as_wanted() {
    let wanted = 200.0;
    // The long reference determines the process well, so that the run length of its own worlds is the wanted one.
    let process = fitted(8, 1_000);
    let directions = [ChangeDirection::Decrease; 3];
    let limits = limits(&process, &directions, wanted, 1).unwrap();
    let contributions = process.in_operation().contributions();
    let (mut alarms, mut batches) = (0_i32, 0_i32);
    for seed in 0..20 {
        let after = innovations(&process, &world(1_000 + seed, 500, usize::MAX, [0.0; 3]));
        let mut quiet = 3;
        for t in 60..after.len() {
            batches += 1;
            let found = evidence(&after[(t + 1).saturating_sub(60)..=t], &contributions, &directions);
            let joint = found.joint.unwrap();
            let quantity = found.quantities.iter().flatten();
            let above = joint.fast > limits.joint.fast
                || joint.slow > limits.joint.slow
                || quantity.clone().any(|e| e.fast > limits.quantity.fast || e.slow > limits.quantity.slow);
            alarms += i32::from(above && quiet >= 3);
            quiet = if above { 0 } else { quiet + 1 };
        }
    }
    // 44 alarms are expected. They are a Poisson process with a standard deviation of 6.6; the limits from 2,000 operations, of which
    // 9.5 % alarm, are known to 7 % of the rate.
    let expected = f64::from(batches) / wanted;
    let error = (expected + (0.07 * expected).powi(2)).sqrt();
    assert!((f64::from(alarms) - expected).abs() < 3.5 * error, "{alarms} alarms, {expected} expected");
}

#[test]
fn an_alarm_lasts_as_long_as_the_damage_and_ends_with_the_repair() {
    const REFERENCE: usize = 200;
    const ONSET: usize = 40;
    const REPAIR: usize = 240;
    let estimates = world(31, REFERENCE + 300, usize::MAX, [0.0; 3]);
    let reference = ReferenceProcess::new(&names(), &[], estimates[..REFERENCE].to_vec(), 1_000.0, [1.0; 2]).unwrap();
    let lost = |(t, e): (usize, &BatchEstimate)| {
        let mut e = e.clone();
        if (ONSET..REPAIR).contains(&t) {
            e.mean[1] = e.mean[1].map(|mean| mean - 0.04 * 4.0);
        }
        e
    };
    let batches: Vec<BatchEstimate> = estimates[REFERENCE..].iter().enumerate().map(lost).collect();
    let filter = Filter::of(&reference.process);
    let mut chain = Chain::start(&reference, &filter, batches[0].at);
    let (mut points, mut chains) = (Vec::new(), Vec::new());
    for batch in &batches {
        points.push(chain.take(batch).unwrap());
        chains.push(chain.clone());
    }
    let above = |t: usize| points[t].change.is_some();
    // The window of the test is 60 batches, and the filter takes a lasting change for weather long before the repair.
    assert!((ONSET + 3..REPAIR).all(above), "{:?}", (ONSET..REPAIR).filter(|t| !above(*t)).collect::<Vec<_>>());
    let last = points[REPAIR - 1].change.as_ref().unwrap();
    assert_eq!(last.onset, batches[ONSET].at);
    let own = last.changes.iter().find(|c| c.name == "k2").unwrap();
    // A loss of 4 % of 4; weather explains what it has explained without the damage: within three standard deviations of 4 %.
    assert!(own.interval[0] < -0.16 && own.interval[1] > -0.16, "{own:?}");
    assert!(own.explained.abs() < 3.0 * 0.04 * 4.0, "{own:?}");
    assert!((REPAIR + 4..300).all(|t| !above(t)), "{:?}", (REPAIR..300).filter(|t| above(*t)).collect::<Vec<_>>());

    // A chain that is continued from what the store keeps gives the same points.
    let at = ONSET + 90;
    let before = at - 60;
    let mut resumed = Chain::resume(&reference, &filter, chains[before].known().clone(), batches[before].at);
    batches[before + 1..at].iter().for_each(|batch| assert!(resumed.pass(batch)));
    let text = chains[at - 1].memory().to_json().unwrap();
    let mut resumed = resumed.remembering(Memory::from_json(text.as_deref()).unwrap());
    let again = resumed.take(&batches[at]).unwrap();
    assert_eq!(again.change, points[at].change);
}

#[test]
fn a_stored_process_that_the_filter_cannot_compute_with_has_a_defect() {
    let estimates = world(4, 200, usize::MAX, [0.0; 3]);
    let made = ReferenceProcess::new(&names(), &[], estimates, 200.0, [1.0; 2]).unwrap();
    let stored = serde_json::to_string(&made).unwrap();
    let read = || serde_json::from_str::<ReferenceProcess>(&stored).unwrap();
    assert_eq!(read().defect(), None);
    let changes: [fn(&mut ReferenceProcess); 11] = [
        |r| r.process.unknowns.truncate(3),
        |r| r.process.unknowns.clear(),
        |r| r.process.factors = usize::MAX,
        |r| r.process.draws[0].truncate(1),
        |r| r.process.usual_errors[0] = -1.0,
        |r| r.process.usual_errors.push(0.0),
        |r| r.process.scales[0].unit = 0.0,
        |r| r.process.units.clear(),
        |r| r.directions.truncate(1),
        |r| r.end.clear(),
        |r| r.limits.joint.fast = -1.0,
    ];
    for (number, change) in changes.iter().enumerate() {
        let mut changed = read();
        change(&mut changed);
        assert!(changed.defect().is_some(), "change {number}");
    }
}
