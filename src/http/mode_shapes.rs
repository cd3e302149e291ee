//! Measured and simulated mode shapes in answers, with their modal assurance criterion (MAC).

use serde::Serialize;
use utoipa::ToSchema;

use crate::simulator::shape_comparison::{MeasuredShape, ShapeComparison, SimulatedShape};

/// Measured mode shapes of a batch beside those of the simulation at the mean of its posterior samples, at the instrumented points.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = ModeShapeComparison)]
pub struct ShapeComparisonBody {
    /// Names of the instrumented points, in the order of the components of the shapes.
    points: Vec<String>,
    simulated: Vec<SimulatedShapeBody>,
    measured: Vec<MeasuredShapeBody>,
}

/// A simulated mode, numbered from 1, with its shape of unit norm.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = SimulatedModeShape)]
struct SimulatedShapeBody {
    mode: usize,
    frequency_hz: f64,
    shape: Vec<f64>,
}

/// A measured mode, numbered from 1.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = MeasuredModeShape)]
struct MeasuredShapeBody {
    mode: usize,
    /// Number of measurements with a shape of this mode.
    measurements: usize,
    /// Shape of unit norm with the greatest mean MAC with the measured ones; its sign is that of the simulated mode.
    shape: Vec<f64>,
    /// MAC |φᵀψ|²/(φᵀφ ψᵀψ) of `shape` with each simulated mode, in the order of `simulated`: 1 for equal shapes, 0 for orthogonal ones.
    mac: Vec<f64>,
    /// Number of the simulated mode that it belongs to.
    simulated_mode: usize,
    /// Lowest and highest MAC of a single measured shape with that simulated mode.
    mac_lowest: f64,
    mac_highest: f64,
}

impl From<ShapeComparison> for ShapeComparisonBody {
    fn from(found: ShapeComparison) -> Self {
        let simulated = |(index, s): (usize, SimulatedShape)| SimulatedShapeBody {
            mode: index + 1,
            frequency_hz: s.frequency_hz,
            shape: s.shape,
        };
        let measured = |m: MeasuredShape| MeasuredShapeBody {
            mode: m.mode + 1,
            measurements: m.measurements,
            shape: m.shape,
            mac: m.mac,
            simulated_mode: m.simulated_mode + 1,
            mac_lowest: m.mac_range[0],
            mac_highest: m.mac_range[1],
        };
        Self {
            points: found.points,
            simulated: found.simulated.into_iter().enumerate().map(simulated).collect(),
            measured: found.measured.into_iter().map(measured).collect(),
        }
    }
}
