//! Frequencies and mode shapes of a structure under effects.

use nalgebra::DMatrix;

use super::effect::{columns, Changed, Response, Target};
use super::modes::{frequency_sensitivity, modes};
use super::shapes::{shape_sensitivity, shapes_at};
use super::structure::{Error, Structure};

/// Frequencies and mode shapes of a structure under effects, and their derivatives.
#[derive(Debug, Clone)]
pub struct Shaped {
    /// Frequencies as the instrument reports them, and their derivatives.
    pub response: Response,
    /// Shapes of unit norm over the points, `[points, m]`; the sign of each is arbitrary.
    pub shapes: DMatrix<f64>,
    /// Derivatives of the shape of each mode with respect to the stiffnesses that were asked for, of the structure without effects,
    /// per N/m, `[points, springs]`.
    pub shape_slopes: Vec<DMatrix<f64>>,
}

/// As [`super::effect::respond`], with the shapes of the modes at the degrees of freedom `points` and their derivatives with respect
/// to the stiffness of `springs`. An order of modes ([`Target::ModeOrder`]) that has fewer than `count` modes is continued by the
/// other modes in ascending order.
///
/// ```text
///  k' = k (1 + g):   ∂φ/∂k = (1 + g) ∂φ/∂k'
/// ```
///
/// Scales and offsets of the instrument do not change shapes.
///
/// # Errors
/// As [`super::effect::respond`].
///
/// # Panics
/// If the number of sizes is not that of the targets.
pub fn respond_shaped(
    structure: &Structure,
    count: usize,
    (targets, sizes): (&[Target], &[f64]),
    points: &[usize],
    springs: &[usize],
) -> Result<Shaped, Error> {
    let columns = columns(targets);
    let mut changed = Changed::new(structure, count, &columns, sizes)?;
    let further: Vec<usize> = (0..count).filter(|mode| !changed.order.contains(mode)).collect();
    let missing = count.saturating_sub(changed.order.len());
    changed.order.extend(further.into_iter().take(missing));
    let needed = changed.order.iter().max().map_or(count, |highest| highest + 1);
    let modes = modes(&changed.structure, needed)?;
    let sensitivity = frequency_sensitivity(&changed.structure, &modes);
    let response = changed.response(&columns, sizes, &modes.frequencies_hz, &sensitivity);
    let shapes = shapes_at(&modes, points).select_columns(&changed.order);
    let shape_slopes = if springs.is_empty() {
        vec![DMatrix::zeros(points.len(), 0); changed.order.len()]
    } else {
        let all = shape_sensitivity(&changed.structure, &modes, points, springs);
        let of_mode = |mode: &usize| {
            let mut slopes = all[*mode].clone();
            for (mut slope, spring) in slopes.column_iter_mut().zip(springs) {
                slope *= changed.spring_factor[*spring];
            }
            slopes
        };
        changed.order.iter().map(of_mode).collect()
    };
    Ok(Shaped { response, shapes, shape_slopes })
}
