//! Draws of a flow moved to where the simulation gives an exact measurement.

use nalgebra::DMatrix;
use rayon::prelude::*;

use super::nearest::{Descent, Search};
use super::observation::Observation;
use crate::simulator::Simulator;

/// Relative distance from a measurement that counts as one. Near a fold of x → f(x) the distance of the parameters goes with its
/// root: a coarser one would end on the way.
const RESOLUTION: f64 = 1e-10;

/// Relative distance within which parameters give a measurement.
const GIVEN: f64 = 1e-8;

/// Moves each draw, `[n·draws, d]`, downhill to parameters that give its measurement; simulations that it took.
///
/// ```text
///  x → argmin over the prior box, downhill from x, of Σ_i ( ln f_i − ln f_i(x) )²
/// ```
///
/// The posterior of a measurement without noise lies on {x: f(x) = y}, a few points where there are as many modes as
/// parameters. A flow is blurred where the frequencies hardly change along a direction, and leaves draws between such points:
/// its draws tell which of the points there are, the simulation where they are. A draw that ends at an edge of the prior, short
/// of its measurement, takes the place of one that did not; where none gives the measurement, nothing better is known.
pub(super) fn project(simulator: &Simulator, observations: &[Observation], theta: &mut DMatrix<f64>) -> usize {
    let draws = theta.nrows() / observations.len().max(1);
    let of_one = |(row, observation): (usize, &Observation)| {
        let simulator = observation.simulator(simulator);
        let search = Search::new(&simulator, observation, RESOLUTION);
        let one = |draw: usize| {
            let theta: Vec<f64> = theta.row(row * draws + draw).iter().copied().collect();
            // Where the simulation fails there is nothing to go by.
            search.descend_from(&theta).unwrap_or(Descent { theta, off: f64::INFINITY, simulations: 0 })
        };
        (0..draws).map(one).collect::<Vec<_>>()
    };
    let ends: Vec<Vec<Descent>> = observations.par_iter().enumerate().map(of_one).collect();
    for (row, ends) in ends.iter().enumerate() {
        let mut given = ends.iter().filter(|end| end.off <= GIVEN).cycle();
        for (draw, end) in ends.iter().enumerate() {
            let there = if end.off <= GIVEN { end } else { given.next().unwrap_or(end) };
            there.theta.iter().enumerate().for_each(|(k, value)| theta[(row * draws + draw, k)] = *value);
        }
    }
    ends.iter().flatten().map(|end| end.simulations).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulator::definition::StructureDefinition;

    fn three_dof() -> Simulator {
        let text = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/models/three-dof/structure.toml"));
        let exact = text.unwrap().replace("relative = 0.001", "relative = 0.0");
        Simulator::new(StructureDefinition::parse_toml(&exact).unwrap()).unwrap()
    }

    fn exact(frequencies_hz: &[f64]) -> Observation {
        Observation { noise_multiple: vec![0.0; 3], ..Observation::complete(frequencies_hz) }
    }

    fn moved(observation: Observation, draws: &[[f64; 3]]) -> (DMatrix<f64>, usize) {
        let mut theta = DMatrix::from_fn(draws.len(), 3, |row, k| draws[row][k]);
        let simulations = project(&three_dof(), &[observation], &mut theta);
        (theta, simulations)
    }

    fn distance(theta: &DMatrix<f64>, row: usize, point: [f64; 3]) -> f64 {
        (0..3).map(|k| (theta[(row, k)] - point[k]).abs()).fold(0.0, f64::max)
    }

    #[test]
    fn draws_go_to_the_points_that_give_the_measurement() {
        // Two points of the prior with the same frequencies, found by another program (many starts of Newton's method).
        let (one, other) = ([6.914_217_86, 3.029_716_03, 3.145_239_17], [6.765_661_3, 3.148_597_95, 3.137_577_11]);
        let frequencies_hz = three_dof().frequencies_hz(&one).unwrap();
        let draws = [[6.95, 3.0, 3.15], [6.72, 3.19, 3.13], one];
        let (theta, simulations) = moved(exact(&frequencies_hz), &draws);
        assert!(distance(&theta, 0, one) < 1e-6 && distance(&theta, 2, one) < 1e-6, "{theta}");
        assert!(distance(&theta, 1, other) < 1e-6, "{theta}");
        assert!(simulations >= 6, "each draw takes some: {simulations}");
        for row in theta.row_iter() {
            let there = three_dof().frequencies_hz(&row.iter().copied().collect::<Vec<_>>()).unwrap();
            assert!(there.iter().zip(&frequencies_hz).all(|(f, y)| (f / y - 1.0).abs() < 1e-9));
        }
    }

    #[test]
    fn a_draw_that_ends_short_of_the_measurement_takes_the_place_of_one_that_does_not() {
        // The twin of this point lies beyond the prior: from behind the fold, the way down ends at an edge.
        let truth = [6.62, 3.306, 3.787];
        let frequencies_hz = three_dof().frequencies_hz(&truth).unwrap();
        let towards_the_twin = |i: u32| [6.62 + 0.02 * f64::from(i), 3.306 - 0.016 * f64::from(i), 3.787];
        let starts: Vec<[f64; 3]> = (1..=30).map(|i| towards_the_twin(i).map(|x| x.clamp(3.0, 7.0))).collect();
        let short = |theta: &DMatrix<f64>| {
            let off = |row: usize| {
                let there = three_dof().frequencies_hz(&theta.row(row).iter().copied().collect::<Vec<_>>()).unwrap();
                there.iter().zip(&frequencies_hz).map(|(f, y)| (f / y - 1.0).abs()).fold(0.0, f64::max)
            };
            (0..theta.nrows()).filter(|row| off(*row) > GIVEN).count()
        };
        let alone: usize = starts.iter().map(|start| short(&moved(exact(&frequencies_hz), &[*start]).0)).sum();
        assert!(0 < alone && alone < starts.len(), "{alone} of the draws end short of it by themselves");
        assert_eq!(short(&moved(exact(&frequencies_hz), &starts).0), 0);
    }

    #[test]
    fn a_measurement_that_nothing_gives_ends_inside_the_prior() {
        let beyond: Vec<f64> = three_dof().frequencies_hz(&[7.0, 7.0, 7.0]).unwrap().iter().map(|f| 1.02 * f).collect();
        let (theta, _) = moved(exact(&beyond), &[[6.0, 6.5, 6.8], [5.0, 5.0, 5.0]]);
        assert!(theta.iter().all(|value| (3.0..=7.0).contains(value)), "{theta}");
        // Both are at the nearest point, as near as the frequencies tell.
        assert!((theta.row(0) - theta.row(1)).amax() < 0.05, "{theta}");
    }
}
