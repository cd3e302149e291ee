//! Frequencies and mode shapes of a structure under effects, for modes that are followed by their shapes.

use nalgebra::{DMatrix, DVector};

use super::effect::{columns, Changed, Response, Target};
use super::modes::{deflections, frequency_sensitivity, modes, FrequencySensitivity, Modes};
use super::shapes::{modes_to_pair, pair_modes, shapes_at, Receptances};
use super::structure::{Error, Structure};
use super::tangent::TangentSpace;

/// A mode that simulated modes are paired with.
#[derive(Debug, Clone, PartialEq)]
pub struct ReferenceMode {
    /// Its frequency, Hz.
    pub frequency_hz: f64,
    /// The tangent space at its shape; `None` for a mode without a shape.
    pub shape: Option<TangentSpace>,
}

/// Mode shapes as coordinates about the shapes of the reference modes, and their derivatives. The coordinates of all modes are
/// joined, P − 1 for each at P points; they are 0 for a mode without a reference shape.
#[derive(Debug, Clone)]
pub struct ShapeResponse {
    /// Coordinates, rad, `[m (P − 1)]`.
    pub coordinates: Vec<f64>,
    /// Derivatives with respect to the stiffness of each spring of the structure without effects, rad per N/m,
    /// `[m (P − 1), springs]`.
    pub by_spring: DMatrix<f64>,
    /// Derivatives with respect to the size of each effect, rad per unit of the size, `[m (P − 1), sizes]`.
    pub by_size: DMatrix<f64>,
}

/// As [`super::effect::respond`], but for the modes that resemble the `reference` modes, one for each, `[m]`: each reference mode is
/// paired with a mode of the structure by the modal assurance criterion and the frequency ([`pair_modes`]), so that a mode keeps
/// its place where the order of the modes changes. Orders of modes ([`Target::ModeOrder`]) have no effect. `points`: degrees of
/// freedom of the P instrumented points.
///
/// ```text
///  K: ∂φ_i = Σ_{j≠i} φ_j (φ_jᵀ ∂K φ_i)/(λ_i − λ_j),    M: ∂φ_i = −λ_i Σ_{j≠i} φ_j (φ_jᵀ ∂M φ_i)/(λ_i − λ_j) + … φ_i
/// ```
///
/// Changes along φ_i itself are changes of its norm, which the coordinates do not contain. A mode that moves none of the points
/// has the largest possible angle, π/2, to its reference.
///
/// Source: Fox & Kapoor (1968), AIAA Journal 6, 2426–2429.
///
/// # Errors
/// As [`super::effect::respond`].
///
/// # Panics
/// If the number of sizes is not that of the targets.
pub fn respond_tracked(
    structure: &Structure,
    targets: &[Target],
    sizes: &[f64],
    points: &[usize],
    reference: &[ReferenceMode],
) -> Result<(Response, ShapeResponse), Error> {
    let columns = columns(targets);
    let mut changed = Changed::new(structure, reference.len(), &columns, sizes)?;
    // An oscillator adds a mode.
    let further = targets.iter().filter(|t| matches!(t, Target::Oscillator(_))).count();
    let wanted = modes_to_pair(reference.len() + further, changed.structure.dofs());
    let modes = modes(&changed.structure, wanted)?;
    let paired: Vec<(f64, Option<&[f64]>)> =
        reference.iter().map(|m| (m.frequency_hz, m.shape.as_ref().map(TangentSpace::centre))).collect();
    changed.order = pair_modes(&paired, &modes.frequencies_hz, &shapes_at(&modes, points));
    let sensitivity = frequency_sensitivity(&changed.structure, &modes);
    let response = changed.response(&columns, sizes, &modes.frequencies_hz, &sensitivity);

    let (coordinates, sensitivity) = shape_sensitivity(&changed, &modes, points, reference);
    let mut by_size = DMatrix::zeros(coordinates.len(), sizes.len());
    for (number, (first, target)) in columns.iter().enumerate() {
        let own = &sizes[*first..first + target.sizes()];
        for row in 0..coordinates.len() {
            for which in 0..own.len() {
                by_size[(row, first + which)] = changed.slope((number, target), own, which, row, &sensitivity);
            }
        }
    }
    let by_spring = DMatrix::from_fn(coordinates.len(), structure.springs().len(), |row, spring| {
        sensitivity.by_spring[(row, spring)] * changed.spring_factor[spring]
    });
    Ok((response, ShapeResponse { coordinates, by_spring, by_size }))
}

/// Coordinates of the paired modes, and their derivatives with respect to every spring, mass and flexibility.
fn shape_sensitivity(
    changed: &Changed,
    modes: &Modes,
    points: &[usize],
    reference: &[ReferenceMode],
) -> (Vec<f64>, FrequencySensitivity) {
    let each = points.len() - 1;
    let (springs, masses) = (changed.structure.springs(), changed.structure.masses());
    let mut coordinates = vec![0.0; each * reference.len()];
    let mut by_spring = DMatrix::zeros(coordinates.len(), springs.len());
    let mut by_mass = DMatrix::zeros(coordinates.len(), masses.len());
    let deflections = deflections(&changed.structure, modes);
    let mut by_flexibility = DMatrix::zeros(coordinates.len(), deflections.len());
    let receptances = Receptances::new(modes, points);
    let shapes = &modes.all_shapes;
    for (mode, (known, paired)) in reference.iter().zip(&changed.order).enumerate() {
        let Some(space) = &known.shape else { continue };
        let slopes = receptances.slopes(&changed.structure, modes, &deflections, *paired);
        let here = DVector::from_fn(points.len(), |point, _| shapes[(points[point], *paired)]);
        let first = mode * each;
        if let Some((own, by)) = space.linearised(&here, &slopes) {
            coordinates[first..first + each].copy_from_slice(&own);
            by_spring.rows_mut(first, each).copy_from(&by.columns(0, springs.len()));
            by_mass.rows_mut(first, each).copy_from(&by.columns(springs.len(), masses.len()));
            let further = by.columns(springs.len() + masses.len(), deflections.len());
            by_flexibility.rows_mut(first, each).copy_from(&further);
        } else {
            coordinates[first] = std::f64::consts::FRAC_PI_2;
        }
    }
    (coordinates, FrequencySensitivity { by_spring, by_mass, by_flexibility })
}
