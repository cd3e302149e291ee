//! Moves draws of a flow to parameters that reproduce a measurement without noise.

use nalgebra::DMatrix;
use rayon::prelude::*;

use super::nearest::{Descent, Search};
use super::observation::Observation;
use structures::simulator::Simulator;

/// Scale of the relative residuals in the search. Near a fold of x → f(x) the error of the parameters is proportional to
/// the square root of the residual, so that a coarser scale would end the search too early.
const RESOLUTION: f64 = 1e-10;

/// Largest relative residual for which parameters reproduce a measurement.
const REPRODUCED: f64 = 1e-8;

/// Moves each draw of `theta`, `[n·draws, d]`, downhill to parameters that reproduce its measurement. Returns the number of
/// simulations.
///
/// ```text
///  x → argmin over the prior box, downhill from x, of Σ_i ( ln f_i − ln f_i(x) )²
/// ```
///
/// The posterior of a measurement without noise lies on {x: f(x) = y}: isolated points where there are as many modes as
/// parameters. A flow is inaccurate in directions along which the frequencies hardly change, and leaves draws between these
/// points. The draws therefore only determine which point is approached; the simulation determines its position. A draw
/// that ends at a bound of the prior without reproducing its measurement is replaced by one that does. Where no draw does,
/// all stay where they ended.
pub(super) fn project(simulator: &Simulator, observations: &[Observation], theta: &mut DMatrix<f64>) -> usize {
    let draws = theta.nrows() / observations.len().max(1);
    let of_one = |(row, observation): (usize, &Observation)| {
        let simulator = observation.simulator(simulator);
        let search = Search::new(&simulator, observation, RESOLUTION);
        let one = |draw: usize| {
            let theta: Vec<f64> = theta.row(row * draws + draw).iter().copied().collect();
            // Where the simulation fails, the draw stays where it is.
            search.descend_from(&theta).unwrap_or(Descent { theta, residual: f64::INFINITY, simulations: 0 })
        };
        (0..draws).map(one).collect::<Vec<_>>()
    };
    let ends: Vec<Vec<Descent>> = observations.par_iter().enumerate().map(of_one).collect();
    for (row, ends) in ends.iter().enumerate() {
        let mut reproduced = ends.iter().filter(|end| end.residual <= REPRODUCED).cycle();
        for (draw, end) in ends.iter().enumerate() {
            let there = if end.residual <= REPRODUCED { end } else { reproduced.next().unwrap_or(end) };
            there.theta.iter().enumerate().for_each(|(k, value)| theta[(row * draws + draw, k)] = *value);
        }
    }
    ends.iter().flatten().map(|end| end.simulations).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use structures::simulator::definition::StructureDefinition;

    fn three_dof() -> Simulator {
        let text =
            std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../../models/three-dof/structure.toml"));
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
    fn draws_move_to_the_points_that_reproduce_the_measurement() {
        // Two points of the prior with the same frequencies, found by another program (Newton's method from many starts).
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
    fn a_draw_that_does_not_reproduce_the_measurement_is_replaced_by_one_that_does() {
        // The second point with these frequencies lies outside the prior: from behind the fold, the descent ends at a
        // bound.
        let truth = [6.62, 3.306, 3.787];
        let frequencies_hz = three_dof().frequencies_hz(&truth).unwrap();
        let towards_the_twin = |i: u32| [6.62 + 0.02 * f64::from(i), 3.306 - 0.016 * f64::from(i), 3.787];
        let starts: Vec<[f64; 3]> = (1..=30).map(|i| towards_the_twin(i).map(|x| x.clamp(3.0, 7.0))).collect();
        let short = |theta: &DMatrix<f64>| {
            let off = |row: usize| {
                let there = three_dof().frequencies_hz(&theta.row(row).iter().copied().collect::<Vec<_>>()).unwrap();
                there.iter().zip(&frequencies_hz).map(|(f, y)| (f / y - 1.0).abs()).fold(0.0, f64::max)
            };
            (0..theta.nrows()).filter(|row| off(*row) > REPRODUCED).count()
        };
        let alone: usize = starts.iter().map(|start| short(&moved(exact(&frequencies_hz), &[*start]).0)).sum();
        assert!(0 < alone && alone < starts.len(), "{alone} of the draws do not reproduce it by themselves");
        assert_eq!(short(&moved(exact(&frequencies_hz), &starts).0), 0);
    }

    #[test]
    fn draws_of_a_measurement_that_nothing_reproduces_stay_inside_the_prior() {
        let beyond: Vec<f64> = three_dof().frequencies_hz(&[7.0, 7.0, 7.0]).unwrap().iter().map(|f| 1.02 * f).collect();
        let (theta, _) = moved(exact(&beyond), &[[6.0, 6.5, 6.8], [5.0, 5.0, 5.0]]);
        assert!(theta.iter().all(|value| (3.0..=7.0).contains(value)), "{theta}");
        // Both are at the nearest point, as accurately as the frequencies determine it.
        assert!((theta.row(0) - theta.row(1)).amax() < 0.05, "{theta}");
    }
}
