//! Frequencies and mode shapes of a structure under effects.

use nalgebra::DMatrix;

use super::effect::{columns, Changed, Response, Target};
use super::modes::{deflections, frequency_sensitivity, modes, FrequencySensitivity, Modes};
use super::shapes::{shape_sensitivity, shapes_at, Receptances};
use super::structure::{Error, Structure};

/// Frequencies and mode shapes of a structure under effects, and their derivatives.
#[derive(Debug, Clone)]
pub struct Shaped {
    /// Frequencies as the instrument reports them, and their derivatives.
    pub response: Response,
    /// Shapes of unit norm over the points, `[points, m]`; the sign of each is arbitrary.
    pub shapes: DMatrix<f64>,
    /// Derivatives of the shape of each mode with respect to the stiffnesses that were asked for, of the structure without effects, per N/m,
    /// then to the sizes that were asked for, `[points, springs + sizes]`.
    pub shape_slopes: Vec<DMatrix<f64>>,
}

/// As [`super::effect::respond`], with the shapes of the modes at the degrees of freedom `points` and their derivatives with respect
/// to the stiffness of `springs` and to the sizes of the first `first_targets` targets, each of which has one size. An order of modes ([`Target::ModeOrder`]) that has fewer than `count` modes is continued by the
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
    (springs, first_targets): (&[usize], usize),
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
    let of_stiffness = |slopes: DMatrix<f64>| {
        let mut slopes = slopes;
        for (mut slope, spring) in slopes.column_iter_mut().zip(springs) {
            slope *= changed.spring_factor[*spring];
        }
        slopes
    };
    let shape_slopes = if first_targets > 0 {
        let all = Receptances::new(&modes, points);
        let deflections = deflections(&changed.structure, &modes);
        let of_mode = |mode: &usize| {
            let by_part = by_part(&changed, &modes, (&all, &deflections), *mode);
            let by_size = DMatrix::from_fn(points.len(), first_targets, |point, number| {
                changed.slope((number, &targets[number]), &sizes[number..=number], 0, point, &by_part)
            });
            let slopes = of_stiffness(by_part.by_spring.select_columns(springs));
            let wanted = springs.len();
            let mut slopes = slopes.resize_horizontally(wanted + first_targets, 0.0);
            slopes.columns_mut(wanted, first_targets).copy_from(&by_size);
            slopes
        };
        changed.order.iter().map(of_mode).collect()
    } else if springs.is_empty() {
        vec![DMatrix::zeros(points.len(), 0); changed.order.len()]
    } else {
        let all = shape_sensitivity(&changed.structure, &modes, points, springs);
        changed.order.iter().map(|mode| of_stiffness(all[*mode].clone())).collect()
    };
    Ok(Shaped { response, shapes, shape_slopes })
}

/// Derivatives of the shape of a mode, of unit norm over the points, with respect to every spring, mass and flexibility: `[points, parts]`.
fn by_part(
    changed: &Changed,
    modes: &Modes,
    (receptances, deflections): (&Receptances, &[DMatrix<f64>]),
    mode: usize,
) -> FrequencySensitivity {
    let structure = &changed.structure;
    let mut slopes = receptances.slopes(structure, modes, deflections, mode);
    let here = receptances.at_points().column(mode);
    let norm = here.norm();
    if norm > 0.0 {
        let unit = here / norm;
        for mut slope in slopes.column_iter_mut() {
            let along = unit.dot(&slope);
            slope.axpy(-along, &unit, 1.0);
            slope /= norm;
        }
    } else {
        slopes.fill(0.0);
    }
    let (springs, masses) = (structure.springs().len(), structure.masses().len());
    FrequencySensitivity {
        by_spring: slopes.columns(0, springs).into_owned(),
        by_mass: slopes.columns(springs, masses).into_owned(),
        by_flexibility: slopes.columns(springs + masses, deflections.len()).into_owned(),
    }
}
