//! Mixtures of Student distributions, each with axes of its own, from which thin curved posteriors are drawn.

use nalgebra::{DMatrix, DVector};
use rand::Rng as _;
use rand_distr::{ChiSquared, Distribution as _, StandardNormal};

use structures::stats::Stream;

/// Degrees of freedom ν of the components.
const DEGREES_OF_FREEDOM: f64 = 6.0;

/// Squared distance from a component, in its standard deviations, beyond which its density is only computed where no component is
/// nearer.
const FAR: f64 = 2_500.0;

/// A mixture of t_ν(m, S).
///
/// ```text
///  q(u) ∝ Σ_n p_n |S_n|^−½ (1 + |R_n (u − m_n)|²/ν)^−(ν + d)/2,    S_n⁻¹ = R_nᵀ R_n,    Σ p_n = 1
/// ```
pub(super) struct Mixture {
    d: usize,
    components: Vec<Component>,
}

struct Component {
    /// p |S|^−½.
    height: f64,
    /// p.
    share: f64,
    mean: Vec<f64>,
    /// R, row-major, narrowest direction first.
    metric: Vec<f64>,
    /// Columns s_j v_j, row-major.
    axes: Vec<f64>,
}

impl Mixture {
    pub(super) fn new(d: usize) -> Self {
        Self { d, components: Vec::new() }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.components.is_empty()
    }

    /// Adds a component with the share `weight` and the standard deviations `stds`, `[d]`, along the columns of `directions`, `[d, d]`,
    /// which are orthonormal.
    pub(super) fn add(&mut self, weight: f64, mean: &DVector<f64>, directions: &DMatrix<f64>, stds: &[f64]) {
        let d = self.d;
        let mut order: Vec<usize> = (0..d).collect();
        order.sort_by(|a, b| stds[*a].total_cmp(&stds[*b]));
        let (mut metric, mut axes) = (vec![0.0; d * d], vec![0.0; d * d]);
        for (row, &j) in order.iter().enumerate() {
            for i in 0..d {
                metric[row * d + i] = directions[(i, j)] / stds[j];
                axes[i * d + row] = directions[(i, j)] * stds[j];
            }
        }
        let height = weight / stds.iter().product::<f64>();
        if height.is_finite() && height > 0.0 {
            self.components.push(Component { height, share: weight, mean: mean.as_slice().to_vec(), metric, axes });
        }
    }

    /// Makes the shares sum to `total`.
    pub(super) fn scaled_to(mut self, total: f64) -> Self {
        let sum: f64 = self.components.iter().map(|one| one.share).sum();
        for one in &mut self.components {
            one.height *= total / sum;
            one.share *= total / sum;
        }
        self
    }

    /// The components of both.
    pub(super) fn joined(mut self, other: Self) -> Self {
        self.components.extend(other.components);
        self
    }

    /// ln q(u), nats, up to a constant that is the same for all mixtures in d dimensions.
    pub(super) fn log_density(&self, u: &[f64]) -> f64 {
        let near = self.sum(u, FAR);
        if near > 0.0 {
            near.ln()
        } else {
            self.sum(u, f64::INFINITY).max(f64::MIN_POSITIVE).ln()
        }
    }

    fn sum(&self, u: &[f64], far: f64) -> f64 {
        let (d, nu) = (self.d, DEGREES_OF_FREEDOM);
        let mut off = [0.0; super::start::MANY_PARAMETERS];
        let mut sum = 0.0;
        'components: for one in &self.components {
            for i in 0..d {
                off[i] = u[i] - one.mean[i];
            }
            let mut squares = 0.0;
            for row in one.metric.chunks_exact(d) {
                let along: f64 = row.iter().zip(&off).map(|(r, x)| r * x).sum();
                squares += along * along;
                if squares > far {
                    continue 'components;
                }
            }
            sum += one.height * (1.0 + squares / nu).powf(-0.5 * (nu + d as f64));
        }
        sum
    }

    /// `many` draws, `[many, d]`; each component gives its share of them, rounded up or down.
    pub(super) fn draw(&self, many: usize, stream: &mut Stream) -> DMatrix<f64> {
        let (d, nu) = (self.d, DEGREES_OF_FREEDOM);
        let chi = ChiSquared::new(nu).expect("ν is positive");
        let total: f64 = self.components.iter().map(|one| one.share).sum();
        let offset: f64 = stream.random();
        let (mut index, mut passed) = (0, 0.0);
        let mut units = DMatrix::zeros(many, d);
        let mut normal = vec![0.0; d];
        for row in 0..many {
            let target = (row as f64 + offset) * total / many as f64;
            while index + 1 < self.components.len() && passed + self.components[index].share <= target {
                passed += self.components[index].share;
                index += 1;
            }
            let one = &self.components[index];
            let chi_squared: f64 = chi.sample(stream);
            let stretch = (nu / chi_squared).sqrt();
            for z in &mut normal {
                *z = stretch * stream.sample::<f64, _>(StandardNormal);
            }
            for i in 0..d {
                let along: f64 = one.axes[i * d..(i + 1) * d].iter().zip(&normal).map(|(a, z)| a * z).sum();
                units[(row, i)] = one.mean[i] + along;
            }
        }
        units
    }
}

#[cfg(test)]
mod tests {
    use statrs::function::gamma::ln_gamma;

    use super::*;
    use structures::stats;

    /// Two components whose axes are rotated by 0.3 and −0.8, one of them thin.
    fn mixture() -> Mixture {
        let rotated =
            |angle: f64| DMatrix::from_row_slice(2, 2, &[angle.cos(), -angle.sin(), angle.sin(), angle.cos()]);
        let mut one = Mixture::new(2);
        one.add(3.0, &DVector::from_row_slice(&[0.5, 0.0]), &rotated(0.3), &[1.0, 0.6]);
        let mut other = Mixture::new(2);
        other.add(1.0, &DVector::from_row_slice(&[-0.5, 0.2]), &rotated(-0.8), &[0.05, 1.2]);
        one.scaled_to(0.6).joined(other.scaled_to(0.4))
    }

    #[test]
    fn draws_have_the_stated_density() {
        let mixture = mixture();
        let (nu, d) = (DEGREES_OF_FREEDOM, 2.0);
        let log_constant = ln_gamma(0.5 * (nu + d)) - ln_gamma(0.5 * nu) - 0.5 * d * (nu * std::f64::consts::PI).ln();
        let count = 320_000;
        let drawn = mixture.draw(count, &mut stats::stream(4, "test"));
        // E_q[p/q] = ∫ p = 1 for normal densities p whose mass is where that of q is, one of them on each component.
        for (mean, std) in [([0.5, 0.0], 0.5), ([-0.5, 0.2], 0.03), ([0.0, 0.0], 0.3)] {
            let ratio = |row: usize| {
                let u = [drawn[(row, 0)], drawn[(row, 1)]];
                let squares: f64 = u.iter().zip(mean).map(|(u, m): (&f64, f64)| ((u - m) / std).powi(2)).sum();
                let log_p = -0.5 * squares - (2.0 * std::f64::consts::PI * std * std).ln();
                (log_p - log_constant - mixture.log_density(&u)).exp()
            };
            let ratios: Vec<f64> = (0..count).map(ratio).collect();
            let error = stats::sample_std(&ratios).unwrap() / (count as f64).sqrt();
            assert!(error < 0.02, "{error}");
            assert!((stats::mean(&ratios) - 1.0).abs() < 4.0 * error, "{} ± {error}", stats::mean(&ratios));
        }
    }

    #[test]
    fn the_density_far_from_all_components_is_small_and_not_zero() {
        let mixture = mixture();
        let [near, far] = [[0.5, 0.0], [400.0, -300.0]].map(|u| mixture.log_density(&u));
        assert!(far.is_finite() && far < near - 30.0, "{far}, {near}");
    }
}
