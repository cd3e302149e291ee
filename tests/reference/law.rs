#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::f64::consts::PI;

use modalwatch::stats;
use modalwatch::updating::chain::{coupling_stiffness, ChainError, CouplingStiffness};
use modalwatch::updating::law::{fit_exponential, Estimate, ExponentialFit, FitError, Weighting};
use nalgebra::Matrix3;
use rand_distr::{Distribution as _, StandardNormal};

/// The rig of Wang et al. (2025), Table 7: two springs of 2477 N/m connect each mass to the ground.
const MASSES_KG: [f64; 3] = [1.52, 2.30, 1.08];
const GROUND_N_PER_M: [f64; 3] = [2.0 * 2477.0; 3];

/// A, B, C of k12 and of k23: Eq. 26.
const LAWS: [[f64; 3]; 2] = [[221.75, 31.64, 855.75], [300.45, 28.89, 725.37]];

fn law([a, b, c]: [f64; 3], p: f64) -> f64 {
    a * (b * p).exp() + c
}

fn frequencies_hz(masses: [f64; 3], ground: [f64; 3], k12: f64, k23: f64) -> [f64; 3] {
    let [g1, g2, g3] = ground;
    let stiffness = Matrix3::new(g1 + k12, -k12, 0.0, -k12, g2 + k12 + k23, -k23, 0.0, -k23, g3 + k23);
    let root = Matrix3::from_diagonal(&masses.map(|m: f64| 1.0 / m.sqrt()).into());
    let mut frequencies: [f64; 3] =
        (root * stiffness * root).symmetric_eigenvalues().map(|eigenvalue| eigenvalue.sqrt() / (2.0 * PI)).into();
    frequencies.sort_by(f64::total_cmp);
    frequencies
}

/// The 61 configurations of the paper: 6 × 6 positions over 0.02–0.07 m, and the 5 × 5 between them.
fn configurations() -> Vec<[f64; 2]> {
    let square = |count: u32, start: f64| {
        let at = move |i: u32| start + 0.01 * f64::from(i);
        (0..count).flat_map(move |i| (0..count).map(move |j| [at(i), at(j)]))
    };
    square(6, 0.02).chain(square(5, 0.025)).collect()
}

/// Points (p, k) of both laws with the standard deviations of k, from frequencies with this relative noise.
struct Identified {
    points: [Vec<(f64, f64)>; 2],
    stds: [Vec<f64>; 2],
    unsolved: usize,
}

fn identified(relative_noise: f64, seed: u64) -> Identified {
    let mut stream = stats::stream(seed, "frequency noise");
    let mut result = Identified { points: [vec![], vec![]], stds: [vec![], vec![]], unsolved: 0 };
    for positions in configurations() {
        let exact = frequencies_hz(MASSES_KG, GROUND_N_PER_M, law(LAWS[0], positions[0]), law(LAWS[1], positions[1]));
        let [first, second, third] = exact.map(|f| {
            let z: f64 = StandardNormal.sample(&mut stream);
            f * (relative_noise * z).exp()
        });
        let solutions = coupling_stiffness(MASSES_KG, GROUND_N_PER_M, Some(first), second, third).unwrap();
        let Some(nearest) = solutions.first() else {
            result.unsolved += 1;
            continue;
        };
        let std = nearest.std_n_per_m(1.0);
        for (i, stiffness) in [nearest.k12_n_per_m, nearest.k23_n_per_m].into_iter().enumerate() {
            result.points[i].push((positions[i], stiffness));
            result.stds[i].push(std[i]);
        }
    }
    result
}

fn constants(fit: &ExponentialFit) -> [Estimate; 3] {
    [fit.a, fit.b, fit.c]
}

fn covers([lower, upper]: [f64; 2], truth: f64) -> bool {
    lower <= truth && truth <= upper
}

#[test]
fn frequencies_of_the_papers_configurations_give_back_stiffnesses_and_laws() {
    let Identified { points, stds, unsolved } = identified(0.0, 0);
    assert_eq!((points[0].len(), unsolved), (61, 0));
    for i in 0..2 {
        for (p, k) in &points[i] {
            assert!((k / law(LAWS[i], *p) - 1.0).abs() < 1e-8, "p = {p}: {k}");
        }
        for weighting in [Weighting::Absolute, Weighting::Relative, Weighting::Std(&stds[i])] {
            let fit = fit_exponential(&points[i], weighting).unwrap();
            for (estimate, exact) in constants(&fit).iter().zip(LAWS[i]) {
                assert!((estimate.value / exact - 1.0).abs() < 1e-6, "{estimate:?} for {exact}");
            }
            assert!((fit.curve(0.1) / law(LAWS[i], 0.1) - 1.0).abs() < 1e-6);
        }
    }
}

#[test]
fn the_first_frequency_distinguishes_two_solutions() {
    // Above 0.035 m, the second solution of the rig is positive, too.
    let (k12, k23) = (law(LAWS[0], 0.05), law(LAWS[1], 0.05));
    let [first, second, third] = frequencies_hz(MASSES_KG, GROUND_N_PER_M, k12, k23);
    let solve = |first| coupling_stiffness(MASSES_KG, GROUND_N_PER_M, first, second, third).unwrap();
    let solutions = solve(Some(first));
    assert_eq!(solutions.len(), 2);
    assert!((solutions[0].k12_n_per_m / k12 - 1.0).abs() < 1e-8 && (solutions[0].first_hz / first - 1.0).abs() < 1e-8);
    for CouplingStiffness { k12_n_per_m, k23_n_per_m, first_hz, .. } in &solutions {
        let again = frequencies_hz(MASSES_KG, GROUND_N_PER_M, *k12_n_per_m, *k23_n_per_m);
        for (found, exact) in again.iter().zip([*first_hz, second, third]) {
            assert!((found / exact - 1.0).abs() < 1e-9);
        }
    }
    let other = solve(Some(solutions[1].first_hz));
    assert_eq!((&other[0], &other[1]), (&solutions[1], &solutions[0]));
    let unordered = solve(None);
    assert!(unordered[0].k12_n_per_m < unordered[1].k12_n_per_m);
}

#[test]
fn a_chain_that_is_the_same_from_both_ends_has_mirrored_solutions() {
    let (masses, ground) = ([1.0, 2.0, 1.0], [5000.0; 3]);
    let [first, second, third] = frequencies_hz(masses, ground, 1000.0, 3000.0);
    let solutions = coupling_stiffness(masses, ground, Some(first), second, third).unwrap();
    assert_eq!(solutions.len(), 2);
    assert!((solutions[0].k12_n_per_m - solutions[1].k23_n_per_m).abs() < 1e-6);
    assert!((solutions[0].first_hz - solutions[1].first_hz).abs() < 1e-9);
}

#[test]
fn frequencies_of_other_modes_give_no_stiffness() {
    // The first and third frequencies of a chain are given as the second and third.
    let [first, _, third] = frequencies_hz(MASSES_KG, GROUND_N_PER_M, 2000.0, 2000.0);
    let solutions = coupling_stiffness(MASSES_KG, GROUND_N_PER_M, None, first, third).unwrap();
    let is_second = |s: &CouplingStiffness| {
        (frequencies_hz(MASSES_KG, GROUND_N_PER_M, s.k12_n_per_m, s.k23_n_per_m)[1] / first - 1.0).abs() < 1e-9
    };
    assert!(solutions.iter().all(is_second));
}

#[test]
fn sensitivities_are_finite_differences_of_the_solution() {
    let [_, second, third] = frequencies_hz(MASSES_KG, GROUND_N_PER_M, 1900.0, 2000.0);
    let solve = |second, third| {
        let first = coupling_stiffness(MASSES_KG, GROUND_N_PER_M, None, second, third).unwrap().swap_remove(0);
        ([first.k12_n_per_m, first.k23_n_per_m], first)
    };
    let step = 1e-6_f64;
    let (_, at) = solve(second, third);
    for column in 0..2 {
        let scale = |sign: f64| if column == 0 { [(sign * step).exp(), 1.0] } else { [1.0, (sign * step).exp()] };
        let at_scaled = |[s, t]: [f64; 2]| solve(second * s, third * t).0;
        let (above, below) = (at_scaled(scale(1.0)), at_scaled(scale(-1.0)));
        for row in 0..2 {
            let difference = (above[row] - below[row]) / (2.0 * step);
            let error = (at.sensitivity_n_per_m[row][column] - difference).abs();
            assert!(error < 1e-5 * at.std_n_per_m(1.0)[row], "row {row}, column {column}: {difference}, {at:?}");
        }
    }
}

#[test]
fn intervals_of_the_constants_and_the_band_cover_ninety_five_percent() {
    const SEEDS: u64 = 1000;
    let mut covered = [[0_u32; 4]; 2];
    for seed in 0..SEEDS {
        let Identified { points, stds, unsolved } = identified(1e-3, seed);
        // At (0.07, 0.02) m two solutions almost coincide: with half of all noise draws there is no solution.
        assert!(unsolved <= 5, "{unsolved}");
        for i in 0..2 {
            let fit = fit_exponential(&points[i], Weighting::Std(&stds[i])).unwrap();
            for (count, (estimate, exact)) in covered[i].iter_mut().zip(constants(&fit).iter().zip(LAWS[i])) {
                *count += u32::from(covers(estimate.interval_95, exact));
            }
            covered[i][3] += u32::from(covers(fit.band_95(0.045), law(LAWS[i], 0.045)));
        }
    }
    // Three standard errors of a share of 0.95 over 1000 seeds are 0.021.
    let tolerance = 3.0 * (0.95 * 0.05 / SEEDS as f64).sqrt();
    for count in covered.into_iter().flatten() {
        assert!((f64::from(count) / SEEDS as f64 - 0.95).abs() < tolerance, "{covered:?} of {SEEDS}");
    }
}

#[test]
fn without_standard_deviations_the_intervals_cover_at_least_the_stated_share() {
    const SEEDS: u64 = 1000;
    let mut covered = [[[0_u32; 3]; 2]; 2];
    for seed in 0..SEEDS {
        let points = identified(1e-3, seed).points;
        for (w, weighting) in [Weighting::Absolute, Weighting::Relative].into_iter().enumerate() {
            for i in 0..2 {
                let fit = fit_exponential(&points[i], weighting).unwrap();
                for (count, (estimate, exact)) in covered[w][i].iter_mut().zip(constants(&fit).iter().zip(LAWS[i])) {
                    *count += u32::from(covers(estimate.interval_95, exact));
                }
            }
        }
    }
    // The errors of single points differ by a factor of 25 here; s²(JᵀJ)⁻¹ covers 86 to 94 %, HC3 96 to 98 %.
    let least = 0.95 - 3.0 * (0.95 * 0.05 / SEEDS as f64).sqrt();
    assert!(covered.iter().flatten().flatten().all(|count| f64::from(*count) / SEEDS as f64 > least), "{covered:?}");
}

#[test]
fn falling_curves_far_positions_and_other_units_are_fitted_alike() {
    for [a, b, c] in [[5.0, -40.0, 2.0], [-3.0, 12.0, 40.0], [-2.0, -0.3, 7.0], [1e9, 60.0, 1e10], [1e-6, 1.0, 1e-5]] {
        let width = 3.0 / f64::abs(b);
        let points: Vec<(f64, f64)> = (0..9)
            .map(|i| {
                let p = width * (2.0 + f64::from(i) / 8.0);
                (p, law([a, b, c], p))
            })
            .collect();
        let fit = fit_exponential(&points, Weighting::Absolute).unwrap();
        for (estimate, exact) in constants(&fit).iter().zip([a, b, c]) {
            assert!((estimate.value / exact - 1.0).abs() < 1e-6, "{estimate:?} for {exact}");
        }
    }
}

#[test]
fn points_that_determine_no_exponential_are_refused_with_the_reason() {
    let at = |k: &dyn Fn(f64) -> f64| -> Vec<(f64, f64)> { (0..12).map(f64::from).map(|p| (p, k(p))).collect() };
    let refused = |points: &[(f64, f64)]| fit_exponential(points, Weighting::Absolute).unwrap_err();
    assert_eq!(refused(&at(&|p| 3.0 * p - 7.0)), FitError::StraightLine);
    assert_eq!(refused(&at(&|_| 5.0)), FitError::StraightLine);
    assert_eq!(refused(&at(&|p| if p > 10.5 { 2.0 } else { 1.0 })), FitError::Step);
    assert_eq!(refused(&at(&|p| if p < 0.5 { 2.0 } else { 1.0 })), FitError::Step);
    // A line with noise of alternating sign is not curved beyond its noise.
    assert_eq!(refused(&at(&|p| p + 0.1 * (7.0 * p * p).cos())), FitError::StraightLine);
    assert_eq!(refused(&[]), FitError::Positions { distinct: 0 });
    let repeated = [(1.0, 1.0), (1.0, 1.1), (2.0, 2.0), (2.0, 2.1), (3.0, 4.0), (3.0, 4.1)];
    assert_eq!(refused(&repeated), FitError::Positions { distinct: 3 });
    let mut points = at(&|p| (0.1 * p).exp());
    assert_eq!(
        fit_exponential(&points, Weighting::Std(&[1.0])).unwrap_err(),
        FitError::Weights { given: 1, points: 12 }
    );
    let zero = [0.0; 12];
    assert!(matches!(fit_exponential(&points, Weighting::Std(&zero)), Err(FitError::Point { point: 0, .. })));
    let far: Vec<(f64, f64)> = points.iter().map(|(p, k)| (p + 1e5, *k)).collect();
    assert_eq!(refused(&far), FitError::FarFromZero);
    points[4].1 = f64::NAN;
    assert!(matches!(refused(&points), FitError::Point { point: 4, .. }));
}

#[test]
fn four_points_are_enough_and_have_one_degree_of_freedom() {
    let points = [(0.0, 1.0), (1.0, 2.01), (2.0, 3.99), (3.0, 8.01)];
    let fit = fit_exponential(&points, Weighting::Std(&[1.0; 4])).unwrap();
    assert_eq!(fit.degrees_of_freedom, 1);
    assert!(covers(fit.b.interval_95, std::f64::consts::LN_2), "{fit:?}");
}

#[test]
fn a_structure_that_is_not_a_chain_is_refused() {
    let solve = |masses, ground, first, second, third| coupling_stiffness(masses, ground, first, second, third);
    for (masses, ground) in [([0.0, 1.0, 1.0], GROUND_N_PER_M), (MASSES_KG, [0.0; 3]), (MASSES_KG, [-1.0, 9.0, 9.0])] {
        let error = solve(masses, ground, None, 10.0, 12.0).unwrap_err();
        assert_eq!(error, ChainError::Chain { masses_kg: masses, ground_n_per_m: ground });
    }
    for (second, third) in [(0.0, 12.0), (12.0, 12.0), (12.0, 10.0), (f64::NAN, 12.0), (10.0, f64::INFINITY)] {
        let error = solve(MASSES_KG, GROUND_N_PER_M, None, second, third).unwrap_err();
        assert!(matches!(error, ChainError::Frequencies { .. }), "{error}");
    }
    let error = solve(MASSES_KG, GROUND_N_PER_M, Some(11.0), 10.5, 12.0).unwrap_err();
    assert_eq!(error, ChainError::FirstFrequency { first_hz: 11.0 });
}
