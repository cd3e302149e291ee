//! Measured mode shapes in the form that a diagnosis uses: coordinates about the mean measured shape of each mode.

use nalgebra::DMatrix;

use crate::measurement::ModalMeasurement;
use crate::physics::shapes::pair_modes;
use crate::physics::tangent::TangentSpace;
use crate::physics::tracked::ReferenceMode;
use crate::simulator::Simulator;
use crate::stats;

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
    centre.iter_mut().for_each(|x| *x *= largest.signum());
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
