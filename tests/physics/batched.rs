//! The batched eigensolver compared with single runs.

use std::fmt::Write as _;

use modalwatch::baseline::library::find_structure;
use modalwatch::physics::batched::{BatchedEigensolver, MOST_DOFS, MOST_DOFS_ROTATED};
use modalwatch::physics::{frequency_sensitivity, natural_frequencies_with, Node, Structure};
use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::Simulator;
use modalwatch::stats;
use nalgebra::DMatrix;
use rand::Rng as _;

use super::{chain, mass, random_structure, spring};

/// Both are exact to rounding, about 1e-15 of the largest eigenvalue, which here is at most some thirty thousand times the smallest.
const ROUNDING: f64 = 1e-11;

fn agree(found: f64, expected: f64) -> bool {
    (found / expected - 1.0).abs() < ROUNDING
}

/// Random stiffnesses of the springs in each run.
fn stiffnesses(structure: &Structure, springs: &[usize], runs: usize, seed: u64) -> Vec<f64> {
    let mut stream = stats::stream(seed, "stiffnesses");
    let one = |spring: &usize, factor: f64| structure.springs()[*spring].n_per_m * factor;
    (0..runs).flat_map(|_| springs.iter().map(|s| one(s, stream.random_range(0.3..3.0))).collect::<Vec<_>>()).collect()
}

fn as_one_by_one(structure: &Structure, springs: &[usize], runs: usize, seed: u64) {
    let given = stiffnesses(structure, springs, runs, seed);
    let modes = structure.dofs();
    let found = BatchedEigensolver::new(structure, springs, modes).unwrap().frequencies_hz(&given);
    assert_eq!(found.len(), runs * modes);
    for (run, found) in found.chunks(modes).enumerate() {
        let own = &given[run * springs.len()..(run + 1) * springs.len()];
        let changes: Vec<(usize, f64)> = springs.iter().copied().zip(own.iter().copied()).collect();
        let expected = natural_frequencies_with(structure, &changes, modes).unwrap();
        for (found, expected) in found.iter().zip(&expected) {
            assert!(agree(*found, *expected), "seed {seed}, run {run}: {found} Hz, expected {expected} Hz");
        }
    }
}

#[test]
fn batched_frequencies_of_random_structures_are_those_of_single_runs() {
    for seed in 0..40 {
        let structure = random_structure(seed);
        let changing: Vec<usize> =
            (0..structure.springs().len()).filter(|s| !(s + seed as usize).is_multiple_of(3)).collect();
        // Numbers of runs that are multiples of the number of lanes, and others.
        as_one_by_one(&structure, &changing, 1 + seed as usize, seed);
    }
    for dofs in (1..=20).chain([37, MOST_DOFS]) {
        as_one_by_one(&chain(dofs, 0.7, 1300.0), &(0..dofs).collect::<Vec<_>>(), 19, 7);
    }
    assert!(BatchedEigensolver::new(&chain(MOST_DOFS + 1, 0.7, 1300.0), &[0], 1).is_none());
    assert!(BatchedEigensolver::new(&chain(2, 0.7, 1300.0), &[0], 3).is_none());
}

/// Compares the derivatives of random runs with those from the modes of each single run. Both have the rounding errors of the largest
/// eigenvalue, over the gap between two eigenvalues.
fn slopes_as_one_by_one(structure: &Structure, springs: &[usize], modes: usize, seed: u64) {
    let given = stiffnesses(structure, springs, 11, seed);
    let solver = BatchedEigensolver::new(structure, springs, modes).unwrap();
    let found = solver.frequencies_and_slopes(&given);
    let frequencies_hz = solver.frequencies_hz(&given);
    assert_eq!(found.slopes.len(), 11 * modes * springs.len());
    for (run, own) in given.chunks(springs.len()).enumerate() {
        let changes: Vec<(usize, f64)> = springs.iter().copied().zip(own.iter().copied()).collect();
        let changed = structure.with_stiffness(&changes).unwrap();
        let all = modalwatch::physics::modes(&changed, structure.dofs()).unwrap();
        let expected = frequency_sensitivity(&changed, &all).by_spring;
        let squares: Vec<f64> = all.frequencies_hz.iter().map(|f| f * f).collect();
        for mode in 0..modes {
            let at = run * modes + mode;
            let others = (0..squares.len()).filter(|other| *other != mode);
            let gap = others.map(|other| (squares[other] - squares[mode]).abs()).fold(squares[mode], f64::min);
            let rounding = 1e3 * f64::EPSILON * squares[squares.len() - 1] / gap;
            let f = frequencies_hz[at];
            assert!((found.frequencies_hz[at] / f - 1.0).abs() < rounding, "{} Hz, {f} Hz", found.frequencies_hz[at]);
            for (column, spring) in springs.iter().enumerate() {
                // As the share of the frequency that doubling the stiffness would change.
                let share = own[column] / f;
                let [found, expected] =
                    [found.slopes[at * springs.len() + column], expected[(mode, *spring)]].map(|slope| share * slope);
                assert!(
                    (found - expected).abs() < rounding,
                    "seed {seed}, run {run}, mode {mode}, {spring}: {found}, expected {expected} ± {rounding:e}"
                );
            }
        }
    }
}

#[test]
fn batched_slopes_are_those_of_the_modes_of_single_runs() {
    for seed in 0..40 {
        let structure = random_structure(seed);
        let changing: Vec<usize> = (0..structure.springs().len()).filter(|s| s % 3 != 1).collect();
        slopes_as_one_by_one(&structure, &changing, structure.dofs(), seed);
    }
    for dofs in [1, 2, 3, 8, 9, 20, MOST_DOFS] {
        slopes_as_one_by_one(&chain(dofs, 0.7, 1300.0), &(0..dofs).collect::<Vec<_>>(), dofs.min(6), 7);
    }
    let bridge = bridge();
    let structure = bridge.structure().unwrap();
    slopes_as_one_by_one(structure, &(0..structure.springs().len()).collect::<Vec<_>>(), 5, 9);
}

/// Frequencies that are given from a random run, of which each second has no mode 2, in runs that are more and more far from it.
#[test]
fn frequencies_near_given_ones_are_those_of_the_run_however_far_they_are() {
    let bridge = bridge();
    let structures =
        [bridge.structure().unwrap().clone(), chain(12, 0.7, 1300.0), chain(40, 0.7, 1300.0), oscillators(12)];
    for (number, structure) in structures.iter().enumerate() {
        let springs: Vec<usize> = (0..structure.springs().len()).collect();
        let modes = 5;
        let solver = BatchedEigensolver::new(structure, &springs, modes).unwrap();
        let mut stream = stats::stream(number as u64, "near");
        for (round, scatter) in [0.0, 1e-6, 1e-3, 0.03, 0.3, 0.9].into_iter().enumerate() {
            let centre = stiffnesses(structure, &springs, 1, round as u64);
            let factor = |k: &f64, stream: &mut stats::Stream| k * (1.0 + scatter * stream.random_range(-1.0..1.0));
            let given: Vec<f64> =
                (0..19).flat_map(|_| centre.iter().map(|k| factor(k, &mut stream)).collect::<Vec<_>>()).collect();
            let mut near_hz: Vec<Option<f64>> = solver.frequencies_hz(&centre).into_iter().map(Some).collect();
            if round % 2 == 0 {
                near_hz[1] = None;
            }
            let expected = solver.frequencies_and_slopes(&given);
            let found_hz = solver.frequencies_near_hz(&given, &near_hz);
            let found = solver.frequencies_and_slopes_near(&given, &near_hz);
            let alone = |own: &[f64]| solver.frequencies_and_slopes_near(own, &near_hz).frequencies_hz;
            let alone: Vec<f64> = given.chunks(springs.len()).flat_map(alone).collect();
            for (at, expected_hz) in expected.frequencies_hz.iter().enumerate() {
                if near_hz[at % modes].is_none() {
                    continue;
                }
                for found_hz in [found_hz[at], found.frequencies_hz[at]] {
                    assert!(
                        (found_hz / expected_hz - 1.0).abs() < 1e-9,
                        "{number} {scatter}: {found_hz} {expected_hz}"
                    );
                }
                assert_eq!(alone[at].to_bits(), found.frequencies_hz[at].to_bits(), "a run depends on those beside it");
                // Separate oscillators can have nearly equal frequencies, whose shapes mix.
                for (spring, own) in springs.iter().enumerate().filter(|_| number < 3) {
                    let share = given[at / modes * springs.len() + own] / expected_hz;
                    let [found, expected] =
                        [&found.slopes, &expected.slopes].map(|slopes| share * slopes[at * springs.len() + spring]);
                    assert!((found - expected).abs() < 1e-4, "{number} {scatter}: {found} {expected}");
                }
            }
        }
    }
}

/// Separate oscillators on springs of 4 N/m, as many as this.
fn oscillators(count: usize) -> Structure {
    let own = |i: usize| spring(i, Node::Ground, Node::Dof(i), 4.0);
    Structure::new((0..count).map(|i| mass(i, 1.0)).collect(), (0..count).map(own).collect()).unwrap()
}

#[test]
fn equal_eigenvalues_come_out_equal() {
    // All are equal but the last one, which has a much higher frequency.
    for count in [3, MOST_DOFS_ROTATED + 1, 30] {
        let springs: Vec<usize> = (0..count).collect();
        let mut n_per_m = vec![4.0; count];
        n_per_m[count - 1] = 4.0e6;
        let found = BatchedEigensolver::new(&oscillators(count), &springs, count).unwrap().frequencies_hz(&n_per_m);
        for (found, n_per_m) in found.iter().zip(&n_per_m) {
            let expected = n_per_m.sqrt() / (2.0 * std::f64::consts::PI);
            // The search ends at rounding errors of the largest eigenvalue, here a million times the others; rotations do not mix them.
            let close =
                if count > MOST_DOFS_ROTATED { (found / expected - 1.0).abs() < 1e-9 } else { agree(*found, expected) };
            assert!(close, "{count}: {found} Hz, expected {expected} Hz");
        }
        let solver = BatchedEigensolver::new(&oscillators(count), &springs, count).unwrap();
        assert!(solver.frequencies_and_slopes(&n_per_m).slopes.iter().all(|slope| slope.is_finite()), "{count}");
    }
}

/// A bridge of four spans of different lengths, two elements each, on a spring at its second support.
fn bridge() -> Simulator {
    let mut text = String::from(
        "id = \"bridge\"\nsimulation = \"beam\"\nmodes = 5\nmeasurement_noise = { relative = 0.001 }\n\
         [[node]]\nname = \"n0\"\nx_m = 0.0\nsupport = \"pinned\"\n",
    );
    for (i, (x_m, support)) in [(9.0, "pinned"), (21.5, "free"), (30.0, "pinned"), (44.0, "pinned")].iter().enumerate()
    {
        let (from, to) = (format!("n{i}"), format!("n{}", i + 1));
        let _ = write!(
            text,
            "[[node]]\nname = \"{to}\"\nx_m = {x_m}\nsupport = \"{support}\"\n\
             [[beam]]\nname = \"s{i}\"\nfrom = \"{from}\"\nto = \"{to}\"\nmass_kg_per_m = 900\n\
             bending_stiffness_n_m2 = 4e8\nelements = 2\n\
             [[parameter]]\nname = \"p{i}\"\nprior = {{ uniform = [2e8, 6e8] }}\nsets = {{ beam = \"s{i}\" }}\n"
        );
    }
    text += "[[spring]]\nname = \"bearing\"\nfrom = \"ground\"\nto = \"n2\"\nn_per_m = 2e7\n";
    Simulator::new(StructureDefinition::parse_toml(&text).unwrap()).unwrap()
}

#[test]
fn each_frequency_of_a_bridge_has_the_rounding_error_of_the_highest() {
    let simulator = bridge();
    let structure = simulator.structure().unwrap();
    let beams: Vec<usize> =
        (0..structure.springs().len()).filter(|s| structure.springs()[*s].name != "bearing").collect();
    let given = stiffnesses(structure, &beams, 40, 5);
    let dofs = structure.dofs();
    assert!(dofs > MOST_DOFS_ROTATED, "{dofs}");
    // Where the search begins depends on how many frequencies are wanted.
    for modes in [1, 5, dofs] {
        let found = BatchedEigensolver::new(structure, &beams, modes).unwrap().frequencies_hz(&given);
        for (own, found) in given.chunks(beams.len()).zip(found.chunks(modes)) {
            let changes: Vec<(usize, f64)> = beams.iter().copied().zip(own.iter().copied()).collect();
            let expected = natural_frequencies_with(structure, &changes, dofs).unwrap();
            for (found, expected_hz) in found.iter().zip(&expected) {
                // Eigenvalues are squares of frequencies; each method has an error of some units in the last place of the largest one.
                let rounding = 20.0 * f64::EPSILON * (expected[dofs - 1] / expected_hz).powi(2);
                assert!((found / expected_hz - 1.0).abs() < rounding, "{found} Hz, expected {expected_hz} Hz");
            }
        }
    }
}

#[test]
fn a_run_does_not_depend_on_the_runs_beside_it() {
    for dofs in [3, 12, 37] {
        let structure = chain(dofs, 0.7, 1300.0);
        let springs: Vec<usize> = (0..dofs).collect();
        let given = stiffnesses(&structure, &springs, 19, 3);
        let runs = BatchedEigensolver::new(&structure, &springs, dofs.min(5)).unwrap();
        let together = runs.frequencies_hz(&given);
        let alone: Vec<f64> = given.chunks(dofs).flat_map(|own| runs.frequencies_hz(own)).collect();
        assert_eq!(together, alone, "{dofs} degrees of freedom");
        let together = runs.frequencies_and_slopes(&given).slopes;
        let alone: Vec<f64> = given.chunks(dofs).flat_map(|own| runs.frequencies_and_slopes(own).slopes).collect();
        assert_eq!(together, alone, "{dofs} degrees of freedom");
    }
}

#[test]
fn a_run_without_frequencies_spoils_no_other() {
    for dofs in [3, 12] {
        let structure = chain(dofs, 0.5, 100.0);
        let runs = BatchedEigensolver::new(&structure, &[0, 1, 2], 2).unwrap();
        let good = [80.0, 90.0, 110.0];
        let alone = runs.frequencies_hz(&good);
        // A mechanism, and invalid stiffnesses.
        for bad in [[0.0, 90.0, 110.0], [80.0, -1.0, 110.0], [80.0, f64::NAN, 110.0], [f64::INFINITY, 1.0, 1.0]] {
            let found = runs.frequencies_hz(&[good, bad, good].concat());
            assert!(found[2..4].iter().all(|f| f.is_nan()), "{bad:?}: {found:?}");
            for at in [0, 1, 4, 5] {
                assert!(agree(found[at], alone[at % 2]), "{bad:?}: {found:?}, alone {alone:?}");
            }
            let found = runs.frequencies_and_slopes(&[good, bad, good].concat());
            assert!(found.frequencies_hz[2..4].iter().all(|f| f.is_nan()), "{bad:?}: {found:?}");
            let alone = runs.frequencies_and_slopes(&good).slopes;
            assert!(found.slopes[..6] == alone && found.slopes[12..] == alone, "{bad:?}: {found:?}, alone {alone:?}");
        }
    }
}

#[test]
fn rows_of_parameters_have_the_frequencies_of_a_single_run() {
    for name in ["three-dof", "rig", "ruler-frame-4dof"] {
        let simulator = find_structure(name).unwrap();
        let mut stream = stats::stream(3, name);
        let parameters = simulator.space().as_slice();
        let mut theta = DMatrix::from_fn(21, parameters.len(), |_, column| {
            stream.random_range(parameters[column].lower..parameters[column].upper)
        });
        theta[(5, 0)] = -1.0;
        let modes = simulator.modes();
        let found = simulator.frequencies_of_rows_hz(&theta, 2..21);
        assert_eq!(found.len(), 19 * modes, "{name}");
        for (row, found) in (2..21).zip(found.chunks(modes)) {
            let single = simulator.frequencies_hz(&theta.row(row).iter().copied().collect::<Vec<_>>());
            let Ok(single) = single else {
                assert!(found.iter().all(|f| f.is_nan()), "{name}, row {row}: {found:?}");
                continue;
            };
            for (found, expected) in found.iter().zip(&single) {
                assert!(agree(*found, *expected), "{name}, row {row}: {found} Hz, expected {expected} Hz");
            }
        }
    }
}

#[test]
fn rows_of_parameters_have_the_slopes_of_a_single_run() {
    for simulator in [bridge(), find_structure("three-dof").unwrap(), find_structure("ruler-frame-4dof").unwrap()] {
        let mut stream = stats::stream(4, simulator.id().as_str());
        let parameters = simulator.space().as_slice();
        let d = parameters.len();
        let mut theta = DMatrix::from_fn(11, d, |_, column| {
            stream.random_range(parameters[column].lower..parameters[column].upper)
        });
        theta[(5, 0)] = -1.0;
        let modes = simulator.modes();
        let near_hz: Vec<Option<f64>> = simulator.nominal_frequencies_hz().into_iter().map(Some).collect();
        let found = simulator.slopes_near(&theta, 2..11, &near_hz);
        assert_eq!(found.slopes.len(), 9 * modes * d);
        for (row, of_row) in (2..11).zip(found.frequencies_hz.chunks(modes).zip(found.slopes.chunks(modes * d))) {
            let single = simulator.frequencies_and_jacobian(&theta.row(row).iter().copied().collect::<Vec<_>>());
            let Ok((single_hz, single)) = single else {
                assert!(of_row.0.iter().all(|f| f.is_nan()), "row {row}: {found:?}");
                continue;
            };
            for mode in 0..modes {
                assert!((of_row.0[mode] / single_hz[mode] - 1.0).abs() < 1e-9);
                for (k, parameter) in parameters.iter().enumerate() {
                    let width = parameter.upper - parameter.lower;
                    let share = (of_row.1[mode * d + k] - single[(mode, k)]) * width / single_hz[mode];
                    assert!(share.abs() < 1e-9, "row {row}, mode {mode}, parameter {k}: {share:e}");
                }
            }
        }
    }
}
