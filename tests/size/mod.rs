//! Many parameters and mode shapes: laws of shapes and their derivatives, the fit that a trained model starts at, and a chain of ten
//! stiffnesses from training to the service.

use std::f64::consts::PI;

use modalwatch::physics::shapes::{pair_modes, shape_sensitivity, shapes_at};
use modalwatch::physics::{modes, Mass, Node, Spring, Structure};
use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::Simulator;
use modalwatch::stats;
use rand::Rng as _;

mod effects;
mod service;
mod start;

/// A chain of equal masses from the ground.
fn chain(stiffnesses: &[f64]) -> Structure {
    let count = stiffnesses.len();
    let masses = (0..count).map(|i| Mass::at(format!("m{i}"), i, 2.0)).collect();
    let below = |i: usize| if i == 0 { Node::Ground } else { Node::Dof(i - 1) };
    let spring = |(i, k): (usize, &f64)| Spring::between(format!("k{i}"), below(i), Node::Dof(i), *k);
    Structure::new(masses, stiffnesses.iter().enumerate().map(spring).collect()).unwrap()
}

fn random_stiffnesses(count: usize, seed: u64) -> Vec<f64> {
    let mut stream = stats::stream(seed, "stiffnesses");
    (0..count).map(|_| stream.random_range(700.0..1300.0)).collect()
}

/// The structure file of a chain with unknown stiffnesses, 30 % either way, and shapes at every second mass.
pub fn chain_file(count: usize, modes: usize) -> String {
    use std::fmt::Write as _;
    let points: Vec<String> = (2..=count).step_by(2).map(|i| format!("\"m{i}\"")).collect();
    let mut text = format!(
        "id = \"chain\"\nmodes = {modes}\nmeasurement_noise = {{ relative = 0.005 }}\n\
         mode_shapes = {{ points = [{}], noise = 0.005 }}\n",
        points.join(", ")
    );
    for i in 1..=count {
        let below = if i == 1 { "ground".to_owned() } else { format!("m{}", i - 1) };
        write!(
            text,
            "[[mass]]\nname = \"m{i}\"\nkg = 1.0\n\
             [[spring]]\nname = \"k{i}\"\nfrom = \"{below}\"\nto = \"m{i}\"\n\
             [[parameter]]\nname = \"k{i}\"\nprior = {{ uniform = [700.0, 1300.0] }}\nsets = {{ spring = \"k{i}\" }}\n"
        )
        .unwrap();
    }
    text
}

/// The simulator of such a chain.
pub fn chain_simulator(count: usize, modes: usize) -> Simulator {
    Simulator::new(StructureDefinition::parse_toml(&chain_file(count, modes)).unwrap()).unwrap()
}

/// Both eigensolvers, below and above the size at which the program changes from one to the other.
#[test]
fn a_uniform_chain_has_the_frequencies_and_shapes_of_the_closed_form() {
    for count in [10, 31, 32, 120] {
        let structure = chain(&vec![1000.0; count]);
        let found = modes(&structure, 8).unwrap();
        let points: Vec<usize> = (0..count).step_by(3).collect();
        let shapes = shapes_at(&found, &points);
        for mode in 0..8 {
            // Fixed at one end, free at the other: φ_j = sin((2i − 1)πj/(2n + 1)), ω = 2√(k/m) sin(half of that angle).
            let angle = (2 * mode + 1) as f64 * PI / (2 * count + 1) as f64;
            let exact_hz = (1000.0_f64 / 2.0).sqrt() * (0.5 * angle).sin() / PI;
            assert!((found.frequencies_hz[mode] / exact_hz - 1.0).abs() < 1e-9, "{count} masses, mode {mode}");
            let exact: Vec<f64> = points.iter().map(|j| (angle * (j + 1) as f64).sin()).collect();
            let alike = stats::squared_cosine(&exact, shapes.column(mode).as_slice());
            assert!((alike - 1.0).abs() < 1e-10, "{count} masses, mode {mode}: MAC {alike}");
            assert!((shapes.column(mode).norm() - 1.0).abs() < 1e-12);
        }
    }
}

#[test]
fn derivatives_of_shapes_are_those_of_differences() {
    for count in [9, 40] {
        let stiffnesses = random_stiffnesses(count, 3);
        let structure = chain(&stiffnesses);
        let points: Vec<usize> = (1..count).step_by(2).collect();
        let springs: Vec<usize> = (0..count).collect();
        let found = modes(&structure, 5).unwrap();
        let here = shapes_at(&found, &points);
        let slopes = shape_sensitivity(&structure, &found, &points, &springs);
        for &spring in &springs {
            let step = 1e-4 * stiffnesses[spring];
            let moved = |sign: f64| {
                let there = structure.with_stiffness(&[(spring, stiffnesses[spring] + sign * step)]).unwrap();
                let mut shapes = shapes_at(&modes(&there, 5).unwrap(), &points);
                for (mut shape, own) in shapes.column_iter_mut().zip(here.column_iter()) {
                    let sign = shape.dot(&own).signum();
                    shape *= sign;
                }
                shapes
            };
            let difference = (moved(1.0) - moved(-1.0)) / (2.0 * step);
            for (mode, slopes) in slopes.iter().enumerate() {
                let error = (difference.column(mode) - slopes.column(spring)).amax();
                let scale = slopes.amax();
                assert!(
                    error < 1e-5 * scale,
                    "{count} masses, mode {mode}, spring {spring}: {error:.1e} of {scale:.1e}"
                );
            }
        }
    }
}

#[test]
fn shapes_turned_around_and_in_another_order_are_paired_back() {
    let structure = chain(&random_stiffnesses(30, 5));
    let points: Vec<usize> = (1..30).step_by(2).collect();
    let found = modes(&structure, 9).unwrap();
    let shapes = shapes_at(&found, &points);
    let order = [4, 0, 7, 1];
    let turned: Vec<Vec<f64>> =
        order.iter().map(|&mode| shapes.column(mode).iter().map(|x| -3.0 * x).collect()).collect();
    let measured: Vec<(f64, Option<&[f64]>)> =
        order.iter().zip(&turned).map(|(&mode, shape)| (found.frequencies_hz[mode], Some(shape.as_slice()))).collect();
    assert_eq!(pair_modes(&measured, &found.frequencies_hz, &shapes), order);
    // Without shapes the frequencies decide.
    let blind: Vec<(f64, Option<&[f64]>)> = measured.iter().map(|(hz, _)| (hz * 1.001, None)).collect();
    assert_eq!(pair_modes(&blind, &found.frequencies_hz, &shapes), order);
}

#[test]
fn a_shape_unlike_every_mode_is_reported_with_the_closest_mode() {
    let simulator = chain_simulator(30, 3);
    let points = simulator.instrumented_points().unwrap();
    for (mode, shape) in points.nominal.iter().enumerate() {
        assert_eq!(points.mistake(shape), None);
        assert_eq!(points.nearest(shape).map(|(nearest, _)| nearest), Some(mode));
    }
    let alternating: Vec<f64> = (0..15).map(|i| if i % 2 == 0 { 1.0 } else { -1.0 }).collect();
    let mistake = points.mistake(&alternating).unwrap();
    assert!(mistake.contains("its highest MAC is 0.0") && mistake.contains("those of m2, m4, m6, …"), "{mistake}");
}

#[test]
fn mistakes_in_instrumented_points_are_reported() {
    let right = chain_file(6, 3);
    let wrong = |from: &str, to: &str| {
        let text = right.replace(from, to);
        assert_ne!(text, right);
        StructureDefinition::parse_toml(&text).unwrap_err().to_string()
    };
    let table = [
        (
            wrong("\"m4\", ", "\"m9\", "),
            "/mode_shapes/points/1: \"m9\" is not the name of a mass or of a node that can deflect",
        ),
        (wrong("\"m4\", ", "\"m2\", "), "/mode_shapes/points/1: \"m2\" is listed twice"),
        (wrong("[\"m2\", \"m4\", \"m6\"]", "[\"m2\"]"), "/mode_shapes/points: 1 points: a shape needs at least 2"),
        (
            wrong("noise = 0.005", "noise = 0.0"),
            "/mode_shapes/noise: a noise of 0 is not valid: it is a share of the shape's root mean square",
        ),
    ];
    for (message, expected) in table {
        assert!(message.contains(expected), "{message}");
    }
}
