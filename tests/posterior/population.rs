//! The population behind a batch: bias, coverage, and the intervals where noise dominates the spread.

use std::collections::BTreeMap;

use modalwatch::alarm::AlarmSettings;
use modalwatch::assessment::{self, Context, Draws};
use modalwatch::baseline::Baseline;
use modalwatch::damage::{self, Hyperparameters, UndamagedReference};
use modalwatch::measurement::ModalMeasurement;
use modalwatch::quantity::{Hertz, Timestamp};
use modalwatch::simulator::population::Population;
use modalwatch::stats;

use super::shipped;

/// Populations of the paper's Table 2.
pub const TABLE_2: [(f64, f64); 3] = [(4.0, 0.3), (5.0, 0.1), (6.0, 0.2)];

pub const DRAWS: Draws = Draws { per_measurement: 10, for_population: 64, seed: 5 };

/// Measurements of a population, with their noise stated.
pub fn batch(
    baseline: &Baseline,
    moments: &[(f64, f64)],
    count: usize,
    multiple: f64,
    seed: u64,
) -> Vec<ModalMeasurement> {
    let named: Vec<(String, f64, f64)> =
        baseline.space().iter().zip(moments).map(|(p, (mean, std))| (p.name.clone(), *mean, *std)).collect();
    let population = Population::new(baseline.space(), &named).unwrap();
    let drawn = population.draw(baseline.simulator(), count, multiple, seed).unwrap();
    let stated = multiple.max(0.1) * baseline.simulator().noise().std_hz(1.0);
    let one = |row: usize| {
        let f: Vec<f64> = drawn.frequencies_hz.row(row).iter().copied().collect();
        ModalMeasurement {
            measured_at: Timestamp::from_micros(row as i64 * 1_000_000).unwrap(),
            frequencies_hz: f.iter().map(|f| Some(Hertz::new(*f).unwrap())).collect(),
            std_hz: Some(f.iter().map(|f| Some(stated * f)).collect()),
            mode_shapes: None,
            covariates: BTreeMap::new(),
            settings: BTreeMap::new(),
        }
    };
    (0..count).map(one).collect()
}

pub fn undamaged(baseline: &Baseline, measurements: &[ModalMeasurement]) -> UndamagedReference {
    // Another seed than that of the batches, as in the service: draws of two populations must be independent.
    assessment::undamaged_reference(
        baseline,
        &[(measurements, Draws { seed: 6, ..DRAWS })],
        0.05,
        &AlarmSettings::default(),
    )
    .unwrap()
}

/// Shares and means over repetitions, for each parameter.
#[derive(Default, Clone, Copy, Debug)]
struct Found {
    mean_covered: f64,
    std_covered: f64,
    probability_covered: f64,
    std: f64,
    pooled_std: f64,
    relative_width: f64,
}

fn repeat(multiple: f64, repetitions: u64) -> [Found; 3] {
    let baseline = shipped("three-dof");
    let mut found = [Found::default(); 3];
    let share = |yes: bool| f64::from(u8::from(yes)) / repetitions as f64;
    for seed in 0..repetitions {
        let state = undamaged(&baseline, &batch(&baseline, &TABLE_2, 50, multiple, 10_000 + seed));
        let measured = batch(&baseline, &TABLE_2, 50, multiple, seed);
        let context = Context { undamaged: Some(&state), earlier: None };
        let assessment = assessment::assess(&baseline, &measured, context, DRAWS, measured[0].measured_at).unwrap();
        for (k, q) in assessment.quantities.iter().enumerate() {
            let (mean, std) = TABLE_2[k];
            let inside = |interval: Option<[f64; 2]>, x: f64| interval.is_some_and(|i| (i[0]..=i[1]).contains(&x));
            let f = &mut found[k];
            f.mean_covered += share(inside(q.mean_interval, mean));
            f.std_covered += share(inside(q.std_interval, std));
            // The same population as the undamaged one: its true probability of damage is 5 %.
            let damage = q.damage.as_ref().unwrap();
            f.probability_covered += share(inside(damage.probability_interval, 0.05));
            f.std += q.std.unwrap() / repetitions as f64;
            f.pooled_std += q.pooled.std.unwrap() / repetitions as f64;
            let interval = q.std_interval.unwrap();
            f.relative_width += (interval[1] - interval[0]) / std / repetitions as f64;
        }
    }
    for (k, f) in found.iter().enumerate() {
        println!("noise × {multiple}: k{} {f:.3?}", k + 1);
    }
    found
}

#[test]
fn the_noise_counts_twice_in_the_pool_and_not_at_all_in_the_population() {
    let found = repeat(1.0, 400);
    for (k, f) in found.iter().enumerate() {
        let std = TABLE_2[k].1;
        // One estimate of σ from 50 measurements scatters by 10 %, of k2 by 17 % because of the noise: the mean of 400 by
        // 0.5 % and 0.8 %. Four times the larger; the estimates are low by up to 0.8 % themselves.
        assert!((f.std / std - 1.0).abs() <= 0.035, "k{}: {f:?}", k + 1);
        // A share of 400 scatters by 0.015 about 0.9: 3.3 times that.
        for covered in [f.mean_covered, f.std_covered, f.probability_covered] {
            assert!((0.85..=0.95).contains(&covered), "k{}: {f:?}", k + 1);
        }
    }
    // The noise of k2 is about 0.08 N/m, and the pool has it twice: √(0.1² + 2·0.08²) = 0.151. The mean of 400 scatters by
    // 0.5 % of it: six times that, as the noise is known to two digits.
    assert!((found[1].pooled_std / 0.151 - 1.0).abs() < 0.03, "the pool of k2 should be 51 % too wide: {found:?}");
}

#[test]
fn where_noise_dominates_the_spread_the_intervals_cover_and_are_wide() {
    let found = repeat(3.0, 200);
    for f in &found {
        for covered in [f.mean_covered, f.std_covered, f.probability_covered] {
            // The program's own values are between 0.857 and 0.953 here (900 repetitions): the intervals of k3 are a little too narrow. A share
            // of 200 scatters by 0.025 and 0.015 about them, so that the limits are 2.3 and 2.5 of these away.
            assert!((0.80..=0.99).contains(&covered), "{found:?}");
        }
    }
    // With noise of 0.24 N/m and a spread of 0.1 N/m, the interval of σ is about as wide as σ or wider.
    assert!(found[1].relative_width > 0.9, "{found:?}");
}

#[test]
fn without_noise_pool_and_population_agree() {
    let baseline = shipped("three-dof");
    for seed in 0..20 {
        let measured = batch(&baseline, &TABLE_2, 50, 0.0, seed);
        let samples = assessment::draw(&baseline, &measured, Context::default(), DRAWS).unwrap();
        for (k, (_, std)) in TABLE_2.iter().enumerate() {
            let pooled = Hyperparameters::from_pool(&samples.posterior.first(10).column(k), 10);
            let population = &samples.populations.parameters[k];
            // The bounds are a fifth of the sampling errors of 50 draws, σ/√50 and σ/√100.
            assert!((pooled.mean - population.mean).abs() < 0.2 * std / 50.0_f64.sqrt(), "k{}: {population:?}", k + 1);
            assert!((pooled.std.unwrap() - population.std.unwrap()).abs() < 0.2 * std / 10.0, "k{}", k + 1);
        }
    }
}

#[test]
fn tiny_batches_and_equal_measurements_stay_finite() {
    let baseline = shipped("three-dof");
    let state = undamaged(&baseline, &batch(&baseline, &TABLE_2, 20, 1.0, 1));
    for count in [1, 2, 3] {
        for spread in [0.0, 1.0] {
            let moments = TABLE_2.map(|(mean, std)| (mean, spread * std));
            let measured = batch(&baseline, &moments, count, 0.0, 3);
            let context = Context { undamaged: Some(&state), earlier: None };
            let assessment = assessment::assess(&baseline, &measured, context, DRAWS, measured[0].measured_at).unwrap();
            for q in &assessment.quantities {
                assert!(q.mean.is_finite() && q.mean_interval.unwrap().iter().all(|x| x.is_finite()), "{q:?}");
                assert_eq!(q.std.is_some(), assessment.measurements_used > 1, "{q:?}");
                if let Some(damage) = &q.damage {
                    assert!((0.0..=1.0).contains(&damage.probability_of_damage), "{q:?}");
                }
            }
        }
    }
}

#[test]
fn an_undamaged_reference_with_damage_in_it_is_doubted_and_one_too_small_refused() {
    let baseline = shipped("three-dof");
    let healthy = batch(&baseline, &TABLE_2, 30, 1.0, 1);
    let two_days_later = |mut batch: Vec<ModalMeasurement>| {
        for measurement in &mut batch {
            measurement.measured_at =
                Timestamp::from_micros(measurement.measured_at.micros() + 2 * 86_400_000_000).unwrap();
        }
        batch
    };
    let later = two_days_later(batch(&baseline, &TABLE_2, 30, 1.0, 2));
    let damaged = two_days_later(batch(&baseline, &[(4.0, 0.3), (4.6, 0.1), (6.0, 0.2)], 30, 1.0, 3));
    let state = |parts: [&[ModalMeasurement]; 2]| {
        assessment::undamaged_reference(&baseline, &parts.map(|part| (part, DRAWS)), 0.05, &AlarmSettings::default())
            .unwrap()
    };
    assert_eq!(state([&healthy, &later]).doubts, Vec::<String>::new());
    let doubts = state([&healthy, &damaged]).doubts;
    assert!(doubts.iter().any(|d| d.starts_with("k2: its batches differ")), "{doubts:?}");
    let small = assessment::undamaged_reference(&baseline, &[(&healthy[..9], DRAWS)], 0.05, &AlarmSettings::default())
        .unwrap_err();
    assert!(small.to_string().contains("at least 10"), "{small}");
    // More measurements determine the threshold more accurately.
    let width = |count: usize| {
        let q = &undamaged(&baseline, &batch(&baseline, &TABLE_2, count, 1.0, 4)).quantities[0];
        q.threshold_interval.unwrap()[1] - q.threshold_interval.unwrap()[0]
    };
    assert!(width(200) < 0.6 * width(20));
    assert!(stats::mean(&[width(20)]).is_finite() && damage::MINIMUM_MEASUREMENTS == 10);
}
