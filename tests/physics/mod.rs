//! Structures compared with closed forms, derivatives with finite differences, and mistakes in structure files.

mod batched;
mod beam;
mod definition;
mod deviation;
mod effect;
mod factor;
mod prior;
mod runs;
mod sizes;
mod table;

use std::f64::consts::PI;

use modalwatch::physics::{
    assembly, frequency_sensitivity, modes, natural_frequencies_hz, Error, Form, Mass, Node, Spring, Structure,
};
use modalwatch::stats;
use nalgebra::DMatrix;
use rand::Rng as _;

fn mass(index: usize, kg: f64) -> Mass {
    Mass::at(format!("m{index}"), index, kg)
}

fn spring(index: usize, from: Node, to: Node, n_per_m: f64) -> Spring {
    Spring::between(format!("k{index}"), from, to, n_per_m)
}

/// A chain of n equal masses, the first of which is connected to the ground.
fn chain(n: usize, kg: f64, n_per_m: f64) -> Structure {
    let end = |i: usize| if i == 0 { Node::Ground } else { Node::Dof(i - 1) };
    let springs = (0..n).map(|i| spring(i, end(i), Node::Dof(i), n_per_m)).collect();
    Structure::new((0..n).map(|i| mass(i, kg)).collect(), springs).unwrap()
}

/// Masses that are all connected to the ground, with random springs between them.
fn random_structure(seed: u64) -> Structure {
    let mut stream = stats::stream(seed, "test structure");
    let n = stream.random_range(2..6);
    let masses = (0..n).map(|i| mass(i, stream.random_range(0.2..2.0))).collect();
    let mut springs = Vec::new();
    for i in 0..n {
        springs.push(spring(springs.len(), Node::Ground, Node::Dof(i), stream.random_range(1.0..9.0)));
        for j in 0..i {
            if stream.random::<f64>() < 0.6 {
                springs.push(spring(springs.len(), Node::Dof(i), Node::Dof(j), stream.random_range(1.0..9.0)));
            }
        }
    }
    Structure::new(masses, springs).unwrap()
}

fn with_mass(structure: &Structure, index: usize, kg: f64) -> Structure {
    let mut masses = structure.masses().to_vec();
    masses[index].kg = kg;
    Structure::new(masses, structure.springs().to_vec()).unwrap()
}

#[test]
fn a_fixed_free_chain_has_the_frequencies_of_the_closed_form() {
    for n in [1, 2, 10, 500] {
        let (kg, n_per_m) = (0.7, 1300.0_f64);
        let frequencies = natural_frequencies_hz(&chain(n, kg, n_per_m), n).unwrap();
        for (i, f) in frequencies.iter().enumerate() {
            let angle = (2 * i + 1) as f64 * PI / (2 * (2 * n + 1)) as f64;
            let exact = (n_per_m / kg).sqrt() * angle.sin() / PI;
            assert!((f / exact - 1.0).abs() < 1e-9, "{n} masses, mode {i}: {f} Hz, exactly {exact} Hz");
        }
    }
}

#[test]
fn the_four_storey_frame_has_the_published_nominal_frequencies() {
    let frequencies = natural_frequencies_hz(&chain(4, 0.1122, 9106.0), 4).unwrap();
    for (f, published) in frequencies.iter().zip([15.747, 45.342, 69.467, 85.214]) {
        assert!((f - published).abs() < 2e-3, "{f} Hz, published {published} Hz");
    }
}

#[test]
fn every_eigenvalue_makes_the_dynamic_stiffness_singular() {
    for seed in 0..20 {
        let structure = random_structure(seed);
        let n = structure.masses().len();
        let k = assembly::stiffness_matrix(&structure);
        let m = assembly::mass_matrix(&structure);
        let scale = k.determinant();
        for f in natural_frequencies_hz(&structure, n).unwrap() {
            let lambda = (2.0 * PI * f).powi(2);
            let determinant = (&k - &m * lambda).determinant();
            assert!((determinant / scale).abs() < 1e-9, "seed {seed}: {determinant} at {f} Hz");
        }
    }
}

#[test]
fn mode_shapes_are_orthonormal_in_the_masses_and_diagonalise_the_stiffness() {
    for seed in 0..20 {
        let structure = random_structure(seed);
        let n = structure.masses().len();
        let found = modes(&structure, n).unwrap();
        let shapes = found.shapes();
        let m = assembly::mass_matrix(&structure);
        let identity = shapes.transpose() * m * &shapes;
        assert!((identity - DMatrix::identity(n, n)).amax() < 1e-10, "seed {seed}");
        let diagonal = shapes.transpose() * assembly::stiffness_matrix(&structure) * &shapes;
        for (i, f) in found.frequencies_hz.iter().enumerate() {
            let lambda = (2.0 * PI * f).powi(2);
            assert!((diagonal[(i, i)] / lambda - 1.0).abs() < 1e-10, "seed {seed}");
        }
    }
}

#[test]
fn derivatives_agree_with_central_finite_differences() {
    for seed in 0..20 {
        let structure = random_structure(seed);
        let n = structure.masses().len();
        let sensitivity = frequency_sensitivity(&structure, &modes(&structure, n).unwrap());
        let frequencies = |s: &Structure| natural_frequencies_hz(s, n).unwrap();
        let h = 1e-5;
        for (index, spring) in structure.springs().iter().enumerate() {
            let at = |k| frequencies(&structure.with_stiffness(&[(index, k)]).unwrap());
            let (up, down) = (at(spring.n_per_m + h), at(spring.n_per_m - h));
            for mode in 0..n {
                let slope = (up[mode] - down[mode]) / (2.0 * h);
                let error = (sensitivity.by_spring[(mode, index)] - slope).abs();
                assert!(error < 1e-8, "seed {seed}, spring {index}, mode {mode}: {error}");
            }
        }
        for (index, mass) in structure.masses().iter().enumerate() {
            let at = |kg| frequencies(&with_mass(&structure, index, kg));
            let (up, down) = (at(mass.kg + h), at(mass.kg - h));
            for mode in 0..n {
                let slope = (up[mode] - down[mode]) / (2.0 * h);
                let error = (sensitivity.by_mass[(mode, index)] - slope).abs();
                assert!(error < 1e-8, "seed {seed}, mass {index}, mode {mode}: {error}");
            }
        }
    }
}

/// Three equal masses in a ring, each connected to the ground: the upper two frequencies are equal.
fn ring() -> Structure {
    let mut springs: Vec<Spring> = (0..3).map(|i| spring(i, Node::Ground, Node::Dof(i), 4.0)).collect();
    springs.extend((0..3).map(|i| spring(3 + i, Node::Dof(i), Node::Dof((i + 1) % 3), 5.0)));
    Structure::new((0..3).map(|i| mass(i, 0.5)).collect(), springs).unwrap()
}

/// Two equal oscillators that are not coupled.
fn pair() -> Structure {
    let springs = (0..2).map(|i| spring(i, Node::Ground, Node::Dof(i), 4.0)).collect();
    Structure::new((0..2).map(|i| mass(i, 0.5)).collect(), springs).unwrap()
}

#[test]
fn at_repeated_frequencies_the_derivatives_are_the_right_hand_ones() {
    for structure in [ring(), pair()] {
        let n = structure.masses().len();
        let found = modes(&structure, n).unwrap();
        let gap = found.frequencies_hz[n - 1] / found.frequencies_hz[n - 2] - 1.0;
        assert!(gap.abs() < 1e-12, "the two upper frequencies should be equal, they differ by {gap}");
        let sensitivity = frequency_sensitivity(&structure, &found);
        let h = 1e-6;
        for index in 0..structure.springs().len() {
            let stiffer = structure.with_stiffness(&[(index, structure.springs()[index].n_per_m + h)]).unwrap();
            for (mode, f) in natural_frequencies_hz(&stiffer, n).unwrap().iter().enumerate() {
                let slope = (f - found.frequencies_hz[mode]) / h;
                let error = (sensitivity.by_spring[(mode, index)] - slope).abs();
                assert!(error < 1e-6, "spring {index}, mode {mode}: {error}");
            }
        }
        for index in 0..n {
            let heavier = with_mass(&structure, index, structure.masses()[index].kg + h);
            for (mode, f) in natural_frequencies_hz(&heavier, n).unwrap().iter().enumerate() {
                let slope = (f - found.frequencies_hz[mode]) / h;
                // The second derivative is some 10 Hz/kg², so that the error of a step of 1e-6 kg is about 1e-5.
                let error = (sensitivity.by_mass[(mode, index)] - slope).abs();
                assert!(error < 1e-4, "mass {index}, mode {mode}: {error}");
            }
        }
    }
}

#[test]
fn a_cluster_cut_by_the_number_of_modes_asked_for_has_the_same_derivatives() {
    let structure = ring();
    let whole = frequency_sensitivity(&structure, &modes(&structure, 3).unwrap());
    let cut = frequency_sensitivity(&structure, &modes(&structure, 2).unwrap());
    assert!((whole.by_spring.rows(0, 2) - cut.by_spring).amax() < 1e-10);
}

#[test]
fn an_invalid_structure_is_refused_with_the_reason() {
    let two = || vec![mass(0, 1.0), mass(1, 1.0)];
    let tied = || vec![spring(0, Node::Ground, Node::Dof(0), 1.0), spring(1, Node::Dof(0), Node::Dof(1), 1.0)];
    let with = |change: &dyn Fn(&mut Vec<Mass>, &mut Vec<Spring>)| {
        let (mut masses, mut springs) = (two(), tied());
        change(&mut masses, &mut springs);
        Structure::new(masses, springs).unwrap_err()
    };
    assert_eq!(with(&|m, _| m.clear()), Error::NoMass);
    assert!(matches!(with(&|m, _| m[1].kg = -1.0), Error::Mass { .. }));
    assert!(matches!(with(&|m, _| m[1].kg = f64::NAN), Error::Mass { .. }));
    assert!(matches!(with(&|_, s| s[0].n_per_m = -2.0), Error::Stiffness { .. }));
    assert!(matches!(with(&|m, _| m[1].name = "m0".to_owned()), Error::DuplicateName(_)));
    assert!(matches!(with(&|_, s| s[1].form = Form::Spring(Node::Dof(0), Node::Dof(0))), Error::Loop { .. }));
    assert!(matches!(with(&|_, s| s[1].form = Form::Spring(Node::Dof(0), Node::Dof(7))), Error::UnknownMass { .. }));
    assert_eq!(with(&|_, s| s[0].n_per_m = 0.0), Error::Mechanism { mass: "m0".to_owned() });
    assert_eq!(with(&|_, s| s.truncate(1)), Error::Mechanism { mass: "m1".to_owned() });
    let asked = natural_frequencies_hz(&chain(2, 1.0, 1.0), 3).unwrap_err();
    assert_eq!(asked, Error::TooFewModes { asked: 3, available: 2 });
}
