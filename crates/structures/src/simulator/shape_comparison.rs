//! Measured mode shapes of a batch beside those of the simulation, with their modal assurance criterion.

use nalgebra::{DMatrix, SymmetricEigen};

use super::simulate::Simulator;
use crate::measurement::ModalMeasurement;
use crate::physics;
use crate::physics::shapes::pair_modes;
use crate::quantity::Hertz;
use crate::stats::{self, squared_cosine};

/// Measured and simulated mode shapes at the instrumented points.
#[derive(Debug, Clone, PartialEq)]
pub struct ShapeComparison {
    /// Names of the instrumented points, in the order of the components of the shapes.
    pub points: Vec<String>,
    /// The simulated modes: the measured ones, and a few above, which can swap with them.
    pub simulated: Vec<SimulatedShape>,
    /// The measured modes that have a shape.
    pub measured: Vec<MeasuredShape>,
}

/// A simulated mode.
#[derive(Debug, Clone, PartialEq)]
pub struct SimulatedShape {
    /// Its natural frequency, Hz.
    pub frequency_hz: f64,
    /// Its shape of unit norm, `[points]`.
    pub shape: Vec<f64>,
}

/// The shapes that were measured of one mode.
#[derive(Debug, Clone, PartialEq)]
pub struct MeasuredShape {
    /// The mode of the data, from 0.
    pub mode: usize,
    /// Number of measurements with a shape of this mode.
    pub measurements: usize,
    /// The shape of unit norm that resembles the measured ones best, see [`mean_shape`], `[points]`; its sign is that of the simulated
    /// mode.
    pub shape: Vec<f64>,
    /// MAC of `shape` with each simulated mode, `[simulated]`.
    pub mac: Vec<f64>,
    /// The simulated mode that it belongs to, from 0; each simulated mode belongs to at most one measured mode.
    pub simulated_mode: usize,
    /// Lowest and highest MAC of a single measured shape with that simulated mode.
    pub mac_range: [f64; 2],
}

impl Simulator {
    /// Compares the shapes of `measurements` with those at the parameters `theta` (`[d]`, parameter units) under the effects of the
    /// structure, on the instrumented points. `None` if no measurement has a shape.
    ///
    /// ```text
    ///  MAC = |φᵀψ|²/(φᵀφ ψᵀψ)      φ: measured, ψ: simulated; 1 for equal shapes of any norm and sign, 0 for orthogonal ones
    /// ```
    ///
    /// Source: Allemang & Brown (1982).
    ///
    /// # Errors
    /// As [`Simulator::frequencies_hz`].
    pub fn compare_shapes(
        &self,
        theta: &[f64],
        measurements: &[ModalMeasurement],
    ) -> Result<Option<ShapeComparison>, physics::Error> {
        let Some(instrumented) = self.instrumented_points() else { return Ok(None) };
        let of_mode = |mode: usize| -> Vec<&[f64]> {
            let shapes = measurements.iter().filter_map(|m| m.mode_shapes.as_ref()?.get(mode)?.as_deref());
            shapes.collect()
        };
        let shapes: Vec<(usize, Vec<&[f64]>)> = (0..self.modes()).map(|mode| (mode, of_mode(mode))).collect();
        let mean = |(mode, own): &(usize, Vec<&[f64]>)| Some((*mode, mean_shape(own)?));
        let means: Vec<(usize, Vec<f64>)> = shapes.iter().filter_map(mean).collect();
        if means.is_empty() {
            return Ok(None);
        }
        let found = self.linearise(theta, self.modes_to_pair(), true)?;
        let frequency = |mode: usize| {
            let known: Vec<f64> = measurements.iter().filter_map(|m| m.frequencies_hz[mode].map(Hertz::get)).collect();
            stats::mean(&known)
        };
        let to_pair: Vec<(f64, Option<&[f64]>)> =
            means.iter().map(|(mode, shape)| (frequency(*mode), Some(shape.as_slice()))).collect();
        let pairs = pair_modes(&to_pair, &found.frequencies_hz, &found.shapes);
        let simulated: Vec<SimulatedShape> = (found.frequencies_hz.iter().zip(found.shapes.column_iter()))
            .map(|(f, shape)| SimulatedShape { frequency_hz: *f, shape: shape.iter().copied().collect() })
            .collect();
        let one = |((mode, shape), pair): ((usize, Vec<f64>), usize)| {
            let own = &simulated[pair].shape;
            let along: f64 = shape.iter().zip(own).map(|(a, b)| a * b).sum();
            let single = || shapes[mode].1.iter().map(|shape| squared_cosine(shape, own));
            MeasuredShape {
                mode,
                measurements: shapes[mode].1.len(),
                mac: simulated.iter().map(|s| squared_cosine(&shape, &s.shape)).collect(),
                shape: shape.into_iter().map(|x| if along < 0.0 { -x } else { x }).collect(),
                simulated_mode: pair,
                mac_range: [single().fold(f64::INFINITY, f64::min), single().fold(0.0, f64::max)],
            }
        };
        let measured = means.into_iter().zip(pairs).map(one).collect();
        Ok(Some(ShapeComparison { points: instrumented.names.clone(), simulated, measured }))
    }
}

/// The shape of unit norm with the greatest mean MAC with the given shapes, `[n][points]`: the eigenvector of the largest eigenvalue of
/// Σ φφᵀ/φᵀφ. It does not depend on the norms and signs of the shapes. `None` if no shape differs from zero.
pub fn mean_shape(shapes: &[&[f64]]) -> Option<Vec<f64>> {
    let points = shapes.first()?.len();
    let mut sum = DMatrix::<f64>::zeros(points, points);
    for shape in shapes {
        let squared: f64 = shape.iter().map(|x| x * x).sum();
        if squared > 0.0 && squared.is_finite() {
            for i in 0..points {
                for j in 0..points {
                    sum[(i, j)] += shape[i] * shape[j] / squared;
                }
            }
        }
    }
    if sum.trace() <= 0.0 {
        return None;
    }
    let found = SymmetricEigen::new(sum);
    let largest = found.eigenvalues.imax();
    Some(found.eigenvectors.column(largest).iter().copied().collect())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::quantity::Timestamp;
    use crate::simulator::definition::StructureDefinition;

    /// Two equal masses on two equal springs: ω² = k/m·(3 ∓ √5)/2, shapes (1, (1 + √5)/2) and (1, (1 − √5)/2), which are orthogonal.
    const TWO: &str = r#"
id = "two"
modes = 2
measurement_noise = { relative = 0.001 }
mode_shapes = { points = ["m1", "m2"], noise = 0.01 }
mass = [{ name = "m1", kg = 2.0 }, { name = "m2", kg = 2.0 }]
spring = [
    { name = "k1", from = "ground", to = "m1", n_per_m = 800.0 },
    { name = "k2", from = "m1", to = "m2", n_per_m = 800.0 },
]
parameter = [{ name = "k1", prior = { uniform = [400.0, 1200.0] }, sets = { spring = "k1" } }]
"#;

    fn measured(frequencies: [f64; 2], shapes: &[Option<Vec<f64>>; 2]) -> ModalMeasurement {
        ModalMeasurement {
            measured_at: Timestamp::from_micros(0).unwrap(),
            frequencies_hz: frequencies.iter().map(|f| Some(Hertz::new(*f).unwrap())).collect(),
            std_hz: None,
            mode_shapes: Some(shapes.to_vec()),
            covariates: BTreeMap::new(),
            settings: BTreeMap::new(),
        }
    }

    #[test]
    fn the_mac_of_equal_shapes_is_one_and_of_orthogonal_ones_zero() {
        let simulator = Simulator::new(StructureDefinition::parse_toml(TWO).unwrap()).unwrap();
        let golden = 0.5 * (1.0 + 5.0_f64.sqrt());
        let hz = [-1.0, 1.0].map(|s| (400.0 * (3.0 + s * 5.0_f64.sqrt()) / 2.0).sqrt() / std::f64::consts::TAU);
        // Any norm and sign.
        let rows = [
            measured(hz, &[Some(vec![-3.0, -3.0 * golden]), None]),
            measured(hz, &[Some(vec![0.01, 0.01 * golden]), Some(vec![golden, -1.0])]),
        ];
        let found = simulator.compare_shapes(&[800.0], &rows).unwrap().unwrap();
        assert_eq!(found.points, ["m1", "m2"]);
        assert!((found.simulated[0].frequency_hz - hz[0]).abs() < 1e-12, "{found:?}");
        let [first, second] = &found.measured[..] else { panic!("{found:?}") };
        assert_eq!((first.measurements, second.measurements), (2, 1));
        assert_eq!((first.simulated_mode, second.simulated_mode), (0, 1));
        for (mac, exact) in first.mac.iter().chain(&second.mac).zip([1.0, 0.0, 0.0, 1.0]) {
            assert!((mac - exact).abs() < 1e-12, "{found:?}");
        }
        assert!(first.mac_range.iter().all(|mac| (mac - 1.0).abs() < 1e-12), "{found:?}");
        for (mine, own) in first.shape.iter().zip(&found.simulated[0].shape) {
            assert!((mine - own).abs() < 1e-9, "the sign is that of the simulated mode: {found:?}");
        }
    }

    #[test]
    fn swapped_modes_are_paired_by_their_shapes_and_a_tilted_shape_has_the_mac_of_its_angle() {
        let simulator = Simulator::new(StructureDefinition::parse_toml(TWO).unwrap()).unwrap();
        let golden = 0.5 * (1.0 + 5.0_f64.sqrt());
        let norm = golden.hypot(1.0);
        let turned = |angle: f64| {
            let (a, b) = ([1.0 / norm, golden / norm], [golden / norm, -1.0 / norm]);
            vec![angle.cos() * a[0] + angle.sin() * b[0], angle.cos() * a[1] + angle.sin() * b[1]]
        };
        // Frequencies in the middle of the simulated ones say nothing about the order.
        let rows = [measured([3.2, 3.2], &[Some(vec![golden, -1.0]), Some(turned(0.3))])];
        let found = simulator.compare_shapes(&[800.0], &rows).unwrap().unwrap();
        assert_eq!(found.measured[0].simulated_mode, 1);
        assert_eq!(found.measured[1].simulated_mode, 0);
        let exact = 0.3_f64.cos().powi(2);
        assert!((found.measured[1].mac[0] - exact).abs() < 1e-12, "{found:?}");
        assert!((found.measured[1].mac[1] - (1.0 - exact)).abs() < 1e-12, "{found:?}");
    }

    #[test]
    fn no_shapes_give_no_comparison_and_the_mean_shape_lies_between_two() {
        let simulator = Simulator::new(StructureDefinition::parse_toml(TWO).unwrap()).unwrap();
        let rows = [measured([2.0, 5.0], &[None, None])];
        assert_eq!(simulator.compare_shapes(&[800.0], &rows).unwrap(), None);
        assert_eq!(mean_shape(&[&[0.0, 0.0]]), None);
        let mean = mean_shape(&[&[2.0, 2.0 * 0.1_f64.tan()], &[-1.0, 0.1_f64.tan()]]).unwrap();
        assert!((mean[0].abs() - 1.0).abs() < 1e-12 && mean[1].abs() < 1e-12, "{mean:?}");
    }
}
