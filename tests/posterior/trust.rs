//! Batches that the simulation can produce, and batches that it cannot.

use modalwatch::assessment::{self, BatchSamples, Context, Draws, Earlier};
use modalwatch::baseline::observation::Observation;
use modalwatch::measurement::ModalMeasurement;
use modalwatch::quantity::Hertz;
use modalwatch::trust::{FindingCode, Trust};

use super::population::{batch, TABLE_2};
use super::shipped;

/// An undamaged rig: both links in the middle of their range.
const RIG: [(f64, f64); 2] = [(0.0475, 0.004), (0.0475, 0.004)];

/// Fewer draws than in the service: only the starting point of a search depends on them.
const DRAWS: Draws = Draws { per_measurement: 10, for_population: 10, seed: 5 };

fn draw(id: &str, measured: &[ModalMeasurement]) -> BatchSamples {
    assessment::draw(&shipped(id), measured, Context::default(), DRAWS).unwrap()
}

fn moments(id: &str) -> &'static [(f64, f64)] {
    if id == "rig" {
        &RIG
    } else {
        &TABLE_2
    }
}

#[test]
fn healthy_batches_are_rejected_at_the_nominal_rate() {
    for (id, count) in [("rig", 2_000), ("three-dof", 500)] {
        let baseline = shipped(id);
        let rejected = (0..count)
            .filter(|seed| draw_with(&baseline, &batch(&baseline, moments(id), 20, 1.0, *seed)).fit.rejected())
            .count();
        let share = rejected as f64 / count as f64;
        println!("{id}: {:.2} % of {count} healthy batches rejected", 100.0 * share);
        // Rejected is below a p-value of 1 %; a share of 2,000 scatters by 0.22 %: 2.2 times that below and 3.5 times above.
        // Three-dof has as many parameters as modes, so that its fit cannot be tested and only what leaves the prior is
        // rejected: none of these 500.
        let (low, high) = if id == "rig" { (0.005, 0.0178) } else { (0.0, 0.001) };
        assert!((low..=high).contains(&share), "{id}: {share}");
    }
}

fn draw_with(baseline: &modalwatch::baseline::Baseline, measured: &[ModalMeasurement]) -> BatchSamples {
    assessment::draw(baseline, measured, Context::default(), DRAWS).unwrap()
}

fn changed(measured: &[ModalMeasurement], change: impl Fn(usize, f64) -> f64) -> Vec<ModalMeasurement> {
    let one = |m: &ModalMeasurement| {
        let f = m.frequencies_hz.iter().enumerate();
        let frequencies_hz = f.map(|(i, f)| f.map(|f| Hertz::new(change(i, f.get())).unwrap())).collect();
        ModalMeasurement { frequencies_hz, std_hz: None, ..m.clone() }
    };
    measured.iter().map(one).collect()
}

#[test]
fn units_and_swapped_modes_are_rejected_and_rightly_named() {
    let repetitions = 100;
    for id in ["three-dof", "rig"] {
        let baseline = shipped(id);
        let (mut radians, mut kilohertz, mut swapped) = (0, 0, 0);
        for seed in 0..repetitions {
            let measured = batch(&baseline, moments(id), 10, 1.0, seed);
            let named = |measured: Vec<ModalMeasurement>, code: FindingCode, word: &str| {
                let samples = draw(id, &measured);
                let trust = Trust::new(&samples.fit, samples.findings.clone());
                let found = trust.findings.iter().any(|f| f.code == code && f.message.contains(word));
                usize::from(found && !trust.accepted())
            };
            radians +=
                named(changed(&measured, |_, f| f * 2.0 * std::f64::consts::PI), FindingCode::UnitSuspected, "rad/s");
            kilohertz += named(changed(&measured, |_, f| f / 1_000.0), FindingCode::UnitSuspected, "kHz");
            let mut other = measured.clone();
            for m in &mut other {
                m.frequencies_hz.swap(1, 2);
            }
            swapped += named(other, FindingCode::ModesSwapped, "swapped");
        }
        println!("{id}, of {repetitions}: rad/s named {radians}, kHz {kilohertz}, swapped modes {swapped}");
        for found in [radians, kilohertz, swapped] {
            assert!(found as f64 >= 0.99 * repetitions as f64, "{id}: {found}");
        }
    }
}

#[test]
fn three_per_cent_in_one_mode_of_the_rig_are_noticed_where_the_links_cannot_absorb_them() {
    let (repetitions, baseline) = (40, shipped("rig"));
    let mut noticed = [0_u64; 3];
    for (mode, noticed) in noticed.iter_mut().enumerate() {
        for seed in 0..repetitions {
            let measured = changed(&batch(&baseline, &RIG, 50, 1.0, seed), |i, f| if i == mode { 1.03 * f } else { f });
            *noticed += u64::from(draw("rig", &measured).fit.rejected());
        }
    }
    println!("3 % in one mode of the rig, batches of 50: rejected {noticed:?} of {repetitions} for modes 1, 2, 3");
    // At least 99 of 100 are noticed; three of 40 that are not would then have a probability of 0.7 %.
    assert!(noticed[0] >= repetitions - 2 && noticed[2] >= repetitions - 2, "{noticed:?}");
    // Mode 2 depends on p12 alone (paper Fig. 17): once p12 is adjusted, a residual of 2.5 % of the shift remains, 0.15
    // standard deviations of the noise. No test of the fit can detect that; it appears as a change of p12.
    let base = draw("rig", &batch(&baseline, &RIG, 50, 1.0, 1)).populations.parameters[0].mean;
    let moved = draw("rig", &changed(&batch(&baseline, &RIG, 50, 1.0, 1), |i, f| if i == 1 { 1.03 * f } else { f }));
    assert!(moved.populations.parameters[0].mean - base > 0.005, "{}", moved.populations.parameters[0].mean);
}

#[test]
fn three_dof_says_that_it_cannot_test_and_rejects_what_leaves_the_prior() {
    let baseline = shipped("three-dof");
    let healthy = draw("three-dof", &batch(&baseline, &TABLE_2, 10, 1.0, 1));
    assert!(healthy.findings.iter().any(|f| f.code == FindingCode::FitNotTestable), "{:?}", healthy.findings);
    assert_eq!(healthy.fit.p_value, None);
    let beyond = draw("three-dof", &batch(&baseline, &[(2.4, 0.1), (5.0, 0.1), (6.0, 0.2)], 10, 1.0, 1));
    assert!(beyond.fit.rejected(), "{:?}", beyond.findings);
}

#[test]
fn a_mode_that_stands_still_is_set_aside() {
    let baseline = shipped("three-dof");
    for decimals in [4, 12] {
        let before = rounded(batch(&baseline, &TABLE_2, 100, 1.0, 71), decimals);
        let hold = |measured: &mut [ModalMeasurement], frequency: Hertz| {
            for m in measured {
                m.frequencies_hz[1] = Some(frequency);
            }
        };
        let drawn = |measured: &[ModalMeasurement], earlier: &[ModalMeasurement]| {
            let rows = earlier.iter().map(|m| m.frequencies_hz.clone()).collect();
            let earlier = Earlier { previous: None, rows };
            let context = Context { undamaged: None, earlier: Some(&earlier) };
            let samples = assessment::draw(&baseline, measured, context, DRAWS).unwrap();
            let stands = samples.findings.iter().any(|f| f.code == FindingCode::NoScatter);
            let present: usize = samples.observations.iter().map(Observation::modes_present).sum();
            assert_eq!(present, samples.observations.len() * if stands { 2 } else { 3 });
            (stands, samples.observations.len())
        };
        // In a batch of its own, and in single rows as soon as several have the same value.
        let mut held = rounded(batch(&baseline, &TABLE_2, 20, 1.0, 72), decimals);
        assert_eq!(drawn(&held, &before), (false, 20), "{decimals} decimals");
        let value = held[0].frequencies_hz[1].unwrap();
        hold(&mut held, value);
        assert_eq!(drawn(&held, &before), (true, 20), "{decimals} decimals");
        let first = drawn(&held[..1], &before).0;
        let sixth = drawn(&held[5..6], &[&before[..], &held[..5]].concat()).0;
        assert_eq!((first, sixth), (false, true), "{decimals} decimals");
    }
}

/// The measurements with frequencies rounded to some decimals.
fn rounded(mut measured: Vec<ModalMeasurement>, decimals: i32) -> Vec<ModalMeasurement> {
    let scale = 10.0_f64.powi(decimals);
    for f in measured.iter_mut().flat_map(|m| &mut m.frequencies_hz).flatten() {
        *f = Hertz::new((f.get() * scale).round() / scale).unwrap();
    }
    measured
}

#[test]
fn copies_of_earlier_measurements_are_told_from_rounded_values_that_coincide() {
    let baseline = shipped("three-dof");
    let rows = |count: usize, seed: u64| batch(&baseline, &TABLE_2, count, 1.0, seed);
    for decimals in [3, 4, 6, 12] {
        let before = rounded(rows(100, 70), decimals);
        let rows_before = before.iter().map(|m| m.frequencies_hz.clone()).collect();
        let earlier = Earlier { previous: None, rows: rows_before };
        let used = |measured: &[ModalMeasurement]| {
            let context = Context { undamaged: None, earlier: Some(&earlier) };
            let samples = assessment::draw(&baseline, measured, context, DRAWS).unwrap();
            (samples.observations.len(), Trust::new(&samples.fit, samples.findings).accepted())
        };
        // Single rows and whole batches of the same structure.
        for seed in 0..100 {
            assert_eq!(used(&rounded(rows(1, 100 + seed), decimals)).0, 1, "{decimals} decimals, seed {seed}");
        }
        for seed in 0..5 {
            assert_eq!(used(&rounded(rows(20, 300 + seed), decimals)).0, 20, "{decimals} decimals, seed {seed}");
        }
        // All of the rows are old, or half of them.
        assert!(!used(&before[40..60]).1, "{decimals} decimals");
        let half = [&before[90..], &rounded(rows(10, 400), decimals)[..]].concat();
        assert_eq!(used(&half).0, 10, "{decimals} decimals");
    }
}
