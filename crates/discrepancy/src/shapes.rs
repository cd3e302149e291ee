//! Measured mode shapes in the form that a diagnosis uses: coordinates about the mean measured shape of each mode.

use nalgebra::DMatrix;

use structures::measurement::ModalMeasurement;
use structures::physics::shapes::pair_modes;
use structures::physics::tangent::TangentSpace;
use structures::physics::tracked::ReferenceMode;
use structures::simulator::Simulator;
use structures::stats;

/// Number of times that mean shapes are computed and the modes of each row paired with them: where two modes change places in
/// some rows, the first mean is a mixture of both.
const PASSES: usize = 3;

/// Mode shapes of n rows with m modes at P points.
///
/// A shape has P − 1 coordinates in the tangent space at the mean measured shape of its mode ([`TangentSpace`]). They do not depend
/// on the norm and the sign with which a shape is measured, and the coordinates of a simulated shape are a smooth function of the
/// parameters. The error of each coordinate has the standard deviation that the structure file states for a component of a shape
/// of unit norm.
#[derive(Debug, Clone)]
pub struct MeasuredShapes {
    /// Mean frequency and mean shape of each mode, which simulated modes are paired with, `[m]`.
    pub reference: Vec<ReferenceMode>,
    /// Coordinates of the shapes of each row, mode by mode, rad, `[n][m (P − 1)]`; NaN if missing.
    pub coordinates: Vec<Vec<f64>>,
    /// Number of coordinates of a mode, P − 1.
    pub each: usize,
    /// Standard deviation of each coordinate, rad.
    pub std: f64,
    /// Number of rows whose modes were listed in another order than in most rows, as their shapes show.
    pub reordered: usize,
}

/// A row whose modes are assigned to the modes of the data.
struct Row<'a> {
    measurement: &'a ModalMeasurement,
    /// For each mode of the data its index in the measurement; `None` if it was not measured.
    order: Vec<Option<usize>>,
}

impl Row<'_> {
    fn shape(&self, mode: usize) -> Option<&[f64]> {
        self.measurement.mode_shapes.as_ref()?[self.order[mode]?].as_deref()
    }

    fn log_frequency(&self, mode: usize) -> Option<f64> {
        Some(self.measurement.frequencies_hz[self.order[mode]?]?.get().ln())
    }
}

impl MeasuredShapes {
    /// The shapes of measurements, which `rows` refers to in the order of the data, and for each row and mode the index of the mode
    /// in the measurement, `[n][m]`. `None` if no shape was measured.
    ///
    /// Within a row the measured modes are paired with the mean of all rows by their shapes and frequencies ([`pair_modes`]), so
    /// that modes that change places remain the same modes.
    pub(super) fn new(simulator: &Simulator, rows: &[&ModalMeasurement]) -> Option<(Self, Vec<Vec<usize>>)> {
        let points = simulator.instrumented_points()?.names.len();
        let (modes, each) = (simulator.modes(), points - 1);
        let (mut assigned, mut any) = (Vec::with_capacity(rows.len()), false);
        for &measurement in rows {
            let order = (0..modes).map(|mode| measurement.frequencies_hz[mode].map(|_| mode)).collect();
            let with_shapes = measurement.mode_shapes.as_ref().is_some_and(|s| s.iter().any(Option::is_some));
            any |= with_shapes;
            assigned.push((Row { measurement, order }, with_shapes));
        }
        if !any {
            return None;
        }
        let nominal_hz = simulator.nominal_frequencies_hz();
        let mut reference = Vec::new();
        for _ in 0..PASSES {
            let all: Vec<&Row<'_>> = assigned.iter().map(|(row, _)| row).collect();
            reference = (0..modes).map(|mode| mean_mode(&all, mode, points, nominal_hz[mode])).collect();
            for (row, _) in assigned.iter_mut().filter(|(_, with_shapes)| *with_shapes) {
                row.order = paired(row.measurement, &reference, points);
            }
        }
        let mut reordered = 0;
        let (mut coordinates, mut orders) = (Vec::with_capacity(rows.len()), Vec::with_capacity(rows.len()));
        for (row, _) in &assigned {
            let mut own = vec![f64::NAN; modes * each];
            for mode in 0..modes {
                let found =
                    reference[mode].shape.as_ref().zip(row.shape(mode)).and_then(|(s, shape)| s.coordinates(shape));
                if let Some(found) = found {
                    own[mode * each..(mode + 1) * each].copy_from_slice(&found);
                }
            }
            coordinates.push(own);
            let order = complete(&row.order);
            reordered += usize::from(order.iter().enumerate().any(|(mode, listed)| mode != *listed));
            orders.push(order);
        }
        let std = simulator.shape_std();
        Some((Self { reference, coordinates, each, std, reordered }, orders))
    }

    /// The mode that a coordinate belongs to.
    pub fn mode(&self, coordinate: usize) -> usize {
        coordinate / self.each
    }

    /// Number of coordinates of all modes, m (P − 1).
    pub fn count(&self) -> usize {
        self.reference.len() * self.each
    }

    /// Number of the rows with the indices `rows` in which the shape of some mode was measured.
    pub fn rows_with_shapes(&self, rows: &[usize]) -> usize {
        rows.iter().filter(|row| self.coordinates[**row].iter().any(|z| z.is_finite())).count()
    }
}

/// Mean frequency and mean direction of a mode over all rows. The mean direction is that with the largest sum of the modal assurance
/// criteria with all measured shapes: the first eigenvector of Σ u uᵀ, which does not depend on their signs.
fn mean_mode(rows: &[&Row<'_>], mode: usize, points: usize, nominal_hz: f64) -> ReferenceMode {
    let logs: Vec<f64> = rows.iter().filter_map(|row| row.log_frequency(mode)).collect();
    let frequency_hz = if logs.is_empty() { nominal_hz } else { stats::mean(&logs).exp() };
    let mut square = DMatrix::zeros(points, points);
    for shape in rows.iter().filter_map(|row| row.shape(mode)) {
        let norm2: f64 = shape.iter().map(|x| x * x).sum();
        for (i, a) in shape.iter().enumerate() {
            for (j, b) in shape.iter().enumerate() {
                square[(i, j)] += a * b / norm2;
            }
        }
    }
    if square.trace() <= 0.0 {
        return ReferenceMode { frequency_hz, shape: None };
    }
    let eigen = square.symmetric_eigen();
    let mut centre: Vec<f64> = eigen.eigenvectors.column(eigen.eigenvalues.imax()).iter().copied().collect();
    // One sign, whatever the eigenvalue solver returns.
    let largest = centre.iter().copied().fold(0.0, |a: f64, x| if x.abs() > a.abs() { x } else { a });
    for component in &mut centre {
        *component *= largest.signum();
    }
    ReferenceMode { frequency_hz, shape: TangentSpace::new(&centre) }
}

/// For each mode of the data the index of the measured mode that resembles it; `None` if no measured mode is left for it.
fn paired(measurement: &ModalMeasurement, reference: &[ReferenceMode], points: usize) -> Vec<Option<usize>> {
    let shapes = measurement.mode_shapes.as_ref();
    let listed: Vec<usize> = (0..reference.len()).filter(|mode| measurement.frequencies_hz[*mode].is_some()).collect();
    let measured: Vec<(f64, Option<&[f64]>)> = listed
        .iter()
        .filter_map(|&mode| Some((measurement.frequencies_hz[mode]?.get(), shapes.and_then(|s| s[mode].as_deref()))))
        .collect();
    let frequencies_hz: Vec<f64> = reference.iter().map(|m| m.frequency_hz).collect();
    let means = DMatrix::from_fn(points, reference.len(), |point, mode| {
        reference[mode].shape.as_ref().map_or(0.0, |space| space.centre()[point])
    });
    let mut order = vec![None; reference.len()];
    for (listed, mode) in listed.iter().zip(pair_modes(&measured, &frequencies_hz, &means)) {
        order[mode] = Some(*listed);
    }
    order
}

/// The order with the modes that were not measured in the places that are left.
fn complete(order: &[Option<usize>]) -> Vec<usize> {
    let mut left = (0..order.len()).filter(|listed| !order.contains(&Some(*listed)));
    // In ascending order, so that a row in the usual order remains as it is.
    order.iter().map(|listed| listed.or_else(|| left.next()).unwrap_or_default()).collect()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::response::Responses;
    use structures::physics::effect::Target;
    use structures::physics::Node;
    use structures::quantity::{Hertz, Timestamp};
    use structures::simulator::definition::StructureDefinition;

    fn simulator() -> Simulator {
        let text = include_str!("../../../models/three-dof/structure.toml");
        let text = format!("mode_shapes = {{ points = [\"m1\", \"m2\"], noise = 0.02 }}\n{text}");
        Simulator::new(StructureDefinition::parse_toml(&text).unwrap()).unwrap()
    }

    /// Measurements whose shapes have another norm and sign in each row.
    fn measurement(second: i64, frequencies_hz: &[f64], shapes: &DMatrix<f64>) -> ModalMeasurement {
        let norm = [1.0, -2.5, 0.1][second as usize % 3];
        ModalMeasurement {
            measured_at: Timestamp::from_micros(1_000_000 * second).unwrap(),
            frequencies_hz: frequencies_hz.iter().map(|f| Hertz::new(*f).ok()).collect(),
            std_hz: None,
            mode_shapes: Some(shapes.column_iter().map(|s| Some(s.iter().map(|x| norm * x).collect())).collect()),
            covariates: BTreeMap::new(),
            settings: BTreeMap::new(),
        }
    }

    #[test]
    fn a_row_with_its_modes_in_another_order_is_put_in_the_usual_one() {
        let simulator = simulator();
        let (hz, shapes) = simulator.frequencies_and_shapes(&[4.0, 5.0, 6.0]).unwrap();
        let mut rows: Vec<ModalMeasurement> = (0..9).map(|row| measurement(row, &hz, &shapes)).collect();
        rows[4].frequencies_hz.swap(1, 2);
        rows[4].mode_shapes.as_mut().unwrap().swap(1, 2);
        let (measured, orders) = MeasuredShapes::new(&simulator, &rows.iter().collect::<Vec<_>>()).unwrap();
        assert_eq!(measured.reordered, 1);
        for (row, order) in orders.iter().enumerate() {
            assert_eq!(*order, if row == 4 { [0, 2, 1] } else { [0, 1, 2] }, "row {row}");
        }
        let largest = measured.coordinates.iter().flatten().fold(0.0, |a: f64, z| a.max(z.abs()));
        assert!(largest < 1e-12, "all rows have the same shapes, whatever norm and sign: {largest}");
    }

    /// Compares coordinates of shapes and their derivatives with the solution of one eigenproblem for each row.
    #[test]
    fn interpolated_shapes_equal_those_of_single_rows() {
        let simulator = simulator();
        let (hz, shapes) = simulator.frequencies_and_shapes(&[4.0, 5.0, 6.0]).unwrap();
        let (measured, _) = MeasuredShapes::new(&simulator, &[&measurement(0, &hz, &shapes)]).unwrap();
        let reference = &measured.reference;
        let sets: [Vec<Target>; 2] = [
            vec![Target::Springs(vec![3]), Target::FrequencyOffset(Some(1)), Target::Springs((0..6).collect())],
            vec![
                Target::FrequencyScale(Some(2)),
                Target::AddedSpring(Node::Dof(0), Node::Dof(2)),
                Target::Masses(vec![0, 1, 2]),
            ],
        ];
        for targets in sets {
            let row = |i: usize| {
                let (a, b, c) = ((0.37 * i as f64).sin(), (0.91 * i as f64).cos(), (1.7 * i as f64).sin());
                [0.15 * a, 0.1 * b, 0.05 * c]
            };
            let rows: Vec<[f64; 3]> = (0..400).map(row).collect();
            let theta = DMatrix::from_fn(3, rows.len(), |k, _| 4.0 + k as f64);
            let sizes = DMatrix::from_fn(3, rows.len(), |k, row| rows[row][k]);
            let many = Responses::new(&simulator, Some(reference), &targets, &theta, &sizes).unwrap();
            assert_eq!((many.modes(), many.outputs()), (3, 6));
            for (place, sizes) in rows.iter().enumerate().step_by(7) {
                let (one, shapes) = simulator.respond_tracked(&[4.0, 5.0, 6.0], reference, &targets, sizes).unwrap();
                let shapes = shapes.unwrap();
                for (mode, f) in one.frequencies_hz.iter().enumerate() {
                    assert!((many.value(place, mode) - f.ln()).abs() < 1e-6, "{targets:?}");
                }
                for (own, coordinate) in shapes.coordinates.iter().enumerate() {
                    // The smallest noise of a shape that can be reached is about 1e-3.
                    assert!((many.value(place, 3 + own) - coordinate).abs() < 1e-5, "{targets:?}");
                    for k in 0..3 {
                        let (by, exact) = (many.by_parameter(place, 3 + own)[k], shapes.by_parameter[(own, k)]);
                        assert!((by - exact).abs() < 1e-4, "{targets:?}, parameter {k}: {by} {exact}");
                        let (by, exact) = (many.by_size(place, 3 + own)[k], shapes.by_size[(own, k)]);
                        assert!((by - exact).abs() < 1e-3, "{targets:?}, size {k}: {by} {exact}");
                    }
                }
            }
        }
    }
}
