//! Mode shapes as coordinates: the norm and sign of a measured shape carry no information, so that a shape at P points has P − 1
//! numbers.

use nalgebra::{DMatrix, DVector};

/// Angle, rad, below which the coordinates are computed by series.
const SERIES: f64 = 1e-3;

/// Directions near a central direction, as angles in its tangent space.
///
/// The direction of a shape φ is a point of the unit sphere, up to its sign. The logarithmic map takes it to the tangent space at
/// the centre ψ: the distance from 0 is the angle α between the two, at most π/2.
///
/// ```text
///  v = ± φ/|φ| with ψᵀv ≥ 0,    cos α = ψᵀv,    z = (α/sin α) Qᵀ v
///  ∂v = ± (1 − v vᵀ) ∂φ/|φ|,    ∂z = (α/sin α) Qᵀ ∂v + (ψᵀ ∂v) (α cos α − sin α)/sin³α · Qᵀ v
/// ```
///
/// z: coordinates, rad, `[P − 1]`; Q: orthonormal basis of the tangent space, `[P, P − 1]`.
///
/// If each component of a shape of unit norm has an independent error with standard deviation s, each coordinate has an error with
/// standard deviation s, and the errors are independent. This holds exactly for the component of the error along z; across z the
/// standard deviation is s·α/sin α, which exceeds s by α²/6.
///
/// Source: Fletcher et al. (2004), IEEE Transactions on Medical Imaging 23, 995–1005, for the logarithmic map of a sphere.
#[derive(Debug, Clone, PartialEq)]
pub struct TangentSpace {
    centre: DVector<f64>,
    basis: DMatrix<f64>,
}

impl TangentSpace {
    /// The tangent space at a shape with any norm, `[P]`; `None` for a shape of zeros or of a single component.
    pub fn new(centre: &[f64]) -> Option<Self> {
        let centre = DVector::from_column_slice(centre);
        let (points, norm) = (centre.len(), centre.norm());
        if points < 2 || !(norm > 0.0 && norm.is_finite()) {
            return None;
        }
        let centre = centre / norm;
        // The reflection that takes the first unit vector to ∓ψ: its other columns are orthogonal to ψ. The sign avoids the
        // difference of two nearly equal numbers.
        let mut normal = centre.clone();
        normal[0] += if centre[0] < 0.0 { -1.0 } else { 1.0 };
        let scale = 2.0 / normal.norm_squared();
        let reflected = |row: usize, column: usize| {
            f64::from(u8::from(row == column + 1)) - scale * normal[row] * normal[column + 1]
        };
        let basis = DMatrix::from_fn(points, points - 1, reflected);
        Some(Self { centre, basis })
    }

    /// The central direction ψ, `[P]`.
    pub fn centre(&self) -> &[f64] {
        self.centre.as_slice()
    }

    /// Coordinates z of a shape with any norm and sign, rad, `[P − 1]`; `None` for a shape of zeros.
    pub fn coordinates(&self, shape: &[f64]) -> Option<Vec<f64>> {
        let slopes = DMatrix::zeros(shape.len(), 0);
        self.linearised(&DVector::from_column_slice(shape), &slopes).map(|(coordinates, _)| coordinates)
    }

    /// Coordinates z of a shape, `[P]`, and their derivatives, `[P − 1, k]`, from those of the shape, `[P, k]`; `None` for a shape
    /// of zeros.
    pub fn linearised(&self, shape: &DVector<f64>, slopes: &DMatrix<f64>) -> Option<(Vec<f64>, DMatrix<f64>)> {
        let norm = shape.norm();
        if !(norm > 0.0 && norm.is_finite()) {
            return None;
        }
        let scale = if self.centre.dot(shape) < 0.0 { -1.0 } else { 1.0 } / norm;
        let direction = shape * scale;
        let cosine = self.centre.dot(&direction);
        let across = self.basis.tr_mul(&direction);
        let sine = across.norm();
        let angle = sine.atan2(cosine);
        let (stretch, slope) = if angle < SERIES {
            (1.0 + angle * angle / 6.0, -1.0 / 3.0 - 2.0 * angle * angle / 15.0)
        } else {
            (angle / sine, (angle * cosine - sine) / sine.powi(3))
        };
        // Without the change along the direction itself, which is a change of norm.
        let along = direction.tr_mul(slopes);
        let moved = (slopes - &direction * along) * scale;
        let by = self.basis.tr_mul(&moved) * stretch + &across * (self.centre.tr_mul(&moved) * slope);
        Some(((across * stretch).as_slice().to_vec(), by))
    }
}

#[cfg(test)]
mod tests {
    use rand::Rng as _;

    use super::*;
    use crate::stats;

    fn random(stream: &mut stats::Stream, points: usize) -> DVector<f64> {
        DVector::from_fn(points, |_, _| stream.random_range(-1.0..1.0))
    }

    #[test]
    fn coordinates_are_the_angle_to_the_centre_whatever_norm_and_sign() {
        let mut stream = stats::stream(1, "directions");
        for points in 2..7 {
            for _ in 0..50 {
                let (centre, shape) = (random(&mut stream, points), random(&mut stream, points));
                let space = TangentSpace::new(centre.as_slice()).unwrap();
                let z = DVector::from_vec(space.coordinates(shape.as_slice()).unwrap());
                let cosine = centre.dot(&shape).abs() / (centre.norm() * shape.norm());
                assert!((z.norm() - cosine.min(1.0).acos()).abs() < 1e-7, "{points} points");
                let other = DVector::from_vec(space.coordinates((&shape * -3.7).as_slice()).unwrap());
                assert!((z - other).amax() < 1e-13);
                let zero = space.coordinates(centre.as_slice()).unwrap();
                assert!(zero.iter().all(|z| z.abs() < 1e-15));
            }
        }
    }

    #[test]
    fn derivatives_of_coordinates_equal_finite_differences() {
        let mut stream = stats::stream(2, "directions");
        for points in 2..7 {
            // Far from the centre, near it, and on both sides of the angle from which on the series is used.
            for distance in [1.0, 0.1, 2e-3, 0.9e-3, 1e-5] {
                let centre = random(&mut stream, points).normalize();
                let shape = (&centre + random(&mut stream, points) * distance) * 0.4;
                let space = TangentSpace::new(centre.as_slice()).unwrap();
                let (_, by) = space.linearised(&shape, &DMatrix::identity(points, points)).unwrap();
                for component in 0..points {
                    let at = |step: f64| {
                        let mut moved = shape.clone();
                        moved[component] += step;
                        DVector::from_vec(space.coordinates(moved.as_slice()).unwrap())
                    };
                    let difference = (at(1e-6) - at(-1e-6)) / 2e-6;
                    assert!((difference - by.column(component)).amax() < 1e-7, "{points} points, {distance}");
                }
            }
        }
    }

    #[test]
    fn independent_errors_of_components_are_independent_errors_of_coordinates() {
        let mut stream = stats::stream(3, "directions");
        let (points, std, draws) = (4, 0.01, 40_000);
        let centre = random(&mut stream, points).normalize();
        let space = TangentSpace::new(centre.as_slice()).unwrap();
        let mut covariance = DMatrix::zeros(points - 1, points - 1);
        for _ in 0..draws {
            let error = DVector::from_fn(points, |_, _| std * stream.sample::<f64, _>(rand_distr::StandardNormal));
            let z = DVector::from_vec(space.coordinates((&centre + error).as_slice()).unwrap());
            covariance += &z * z.transpose() / f64::from(draws);
        }
        // A variance from n draws has the standard error √(2/n) = 0.7 % of itself, a covariance 0.5 % of the variance; five of them.
        let expected = DMatrix::identity(points - 1, points - 1) * (std * std);
        assert!((covariance - expected).amax() < 5.0 * (2.0 / f64::from(draws)).sqrt() * std * std);
    }
}
