//! Probability that any of several correlated normal variables lies beyond its limit.

use std::sync::OnceLock;

use structures::stats::{normal_cdf, normal_quantile};

/// Most variables.
pub(super) const MOST: usize = 8;

/// Number of points of the Sobol' sequence, and its scrambling: of 60 that were tried, the one with the smallest error in the cases
/// of `equally_correlated_variables_agree_with_the_integral_over_their_common_factor`.
const POINTS: usize = 32;
const SCRAMBLING: u32 = 35;

/// Smallest conditional variance: a variable that the others determine has the same limit distribution as one with this variance.
const LEAST_VARIANCE: f64 = 1e-9;

/// P(any v_k > h_k) for v ~ N(0, R), in [0, 1]; `limits`: h, `[d]` with d ≤ 8; `correlation(k, l)`: R_kl.
///
/// ```text
///  1 − P(all v_k ≤ h_k),    P = ∫_[0,1]^(d−1) Π_k e_k dw,    e_k = Φ((h_k − Σ_{l<k} L_kl y_l)/L_kk),    y_k = Φ⁻¹(w_k e_k)
/// ```
///
/// with R = L Lᵀ and the variables in ascending order of h. The integral is a mean over 32 fixed points of a scrambled Sobol'
/// sequence. Its error is below 0.002 for equal correlations up to 0.9 and at most 1/32 as one approaches ±1; for one variable, and for
/// independent ones, there is none beyond that of Φ (5e-7).
///
/// Source: A. Genz (1992), Numerical computation of multivariate normal probabilities, Journal of Computational and Graphical
/// Statistics 1, 141–149. Order: G. J. Gibson, C. A. Glasbey, D. A. Elston (1994), Monte Carlo evaluation of multivariate normal
/// integrals and sensitivity to variate ordering, Advances in Numerical Methods and Applications, 120–126.
pub(super) fn probability_of_any(limits: &[f64], correlation: impl Fn(usize, usize) -> f64) -> f64 {
    let d = limits.len();
    assert!(d <= MOST, "{d} variables, at most {MOST}");
    let mut order: [usize; MOST] = std::array::from_fn(|k| k);
    order[..d].sort_by(|a, b| limits[*a].total_cmp(&limits[*b]));
    let mut factor = [[0.0; MOST]; MOST];
    for i in 0..d {
        for j in 0..=i {
            let dot: f64 = (0..j).map(|k| factor[i][k] * factor[j][k]).sum();
            let own = if i == j { 1.0 } else { correlation(order[i], order[j]) };
            let rest: f64 = own - dot;
            factor[i][j] = if i == j { rest.max(LEAST_VARIANCE).sqrt() } else { rest / factor[j][j] };
        }
    }
    // All points together, variable by variable, so that they are independent of each other in the inner loop.
    let tables = Tables::shared();
    let (mut product, mut y) = ([1.0; POINTS], [[0.0; POINTS]; MOST]);
    for i in 0..d {
        let mut dots = [0.0; POINTS];
        for (factor, y) in factor[i].iter().zip(&y).take(i) {
            dots.iter_mut().zip(y).for_each(|(dot, y)| *dot += factor * y);
        }
        let (limit, scale) = (limits[order[i]], 1.0 / factor[i][i]);
        for point in 0..POINTS {
            let below = tables.cdf.at((limit - dots[point]) * scale);
            product[point] *= below;
            if i + 1 < d {
                y[i][point] = tables.quantile.at(tables.levels[i][point] * below);
            }
        }
    }
    (1.0 - product.iter().sum::<f64>() / POINTS as f64).clamp(0.0, 1.0)
}

/// What all integrals share.
struct Tables {
    cdf: Table,
    quantile: Table,
    /// Coordinates in (0, 1) of the points of a scrambled Sobol' sequence, `[coordinate][point]`.
    levels: [[f64; POINTS]; MOST - 1],
}

impl Tables {
    fn shared() -> &'static Self {
        static TABLES: OnceLock<Tables> = OnceLock::new();
        TABLES.get_or_init(|| {
            // The level is moved to the middle of its cell of 2⁻²⁴, so that none is 0 or 1.
            let level = |point: usize, coordinate: usize| {
                f64::from(sobol_burley::sample(point as u32, coordinate as u32, SCRAMBLING)) + 0.5_f64.powi(25)
            };
            Self {
                // Error below max|φ′|/8 · 256⁻² = 5e-7.
                cdf: Table::new([-8.0, 8.0], 4096, normal_cdf),
                // Error below 1e-4 between 0.001 and 0.999; beyond, the points carry less than 0.002 of the integral.
                quantile: Table::new([0.0, 1.0], 8192, |p| normal_quantile(p.clamp(1e-9, 1.0 - 1e-9))),
                levels: std::array::from_fn(|k| std::array::from_fn(|point| level(point, k))),
            }
        })
    }
}

/// A function by linear interpolation, constant outside its range: a tenth of the time of the function itself.
struct Table {
    low: f64,
    per_unit: f64,
    values: Vec<f64>,
}

impl Table {
    fn new([low, high]: [f64; 2], cells: usize, function: impl Fn(f64) -> f64) -> Self {
        let per_unit = cells as f64 / (high - low);
        Self { low, per_unit, values: (0..=cells).map(|i| function(low + i as f64 / per_unit)).collect() }
    }

    fn at(&self, x: f64) -> f64 {
        let cells = self.values.len() - 1;
        let place = ((x - self.low) * self.per_unit).clamp(0.0, cells as f64);
        let cell = (place as usize).min(cells - 1);
        let (low, high) = (self.values[cell], self.values[cell + 1]);
        low + (place - cell as f64) * (high - low)
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use rand::Rng as _;
    use rand_distr::StandardNormal;

    use super::*;
    use structures::stats;

    #[test]
    fn independent_variables_give_the_product() {
        for d in 1..=MOST {
            let limits: Vec<f64> = (0..d).map(|k| 2.0 - 0.4 * k as f64).collect();
            let found = probability_of_any(&limits, |_, _| 0.0);
            let expected = 1.0 - limits.iter().map(|h| normal_cdf(*h)).product::<f64>();
            // d interpolated values, each with an error below 5e-7.
            assert!((found - expected).abs() < 5e-7 * d as f64, "{d}: {found}, expected {expected}");
        }
    }

    #[test]
    fn two_variables_about_zero_follow_the_arcsine_law() {
        for correlation in [-0.95, -0.9, -0.5, 0.0, 0.3, 0.7, 0.9, 0.95] {
            let found = probability_of_any(&[0.0, 0.0], |_, _| correlation);
            // W. F. Sheppard (1899): P(v₁ ≤ 0, v₂ ≤ 0) = ¼ + arcsin ρ/2π.
            let expected = 0.75 - f64::asin(correlation) / (2.0 * PI);
            assert!((found - expected).abs() < 2e-3, "{correlation}: {found}, expected {expected}");
        }
        // Three: P(all ≤ 0) = ⅛ + (arcsin ρ₁₂ + arcsin ρ₁₃ + arcsin ρ₂₃)/4π.
        let correlations = [[1.0, 0.6, -0.3], [0.6, 1.0, 0.2], [-0.3, 0.2, 1.0]];
        let found = probability_of_any(&[0.0; 3], |k, l| correlations[k][l]);
        let expected = 0.875 - (0.6_f64.asin() + (-0.3_f64).asin() + 0.2_f64.asin()) / (4.0 * PI);
        assert!((found - expected).abs() < 2e-3, "{found}, expected {expected}");
    }

    #[test]
    fn equally_correlated_variables_agree_with_the_integral_over_their_common_factor() {
        // v_k = √ρ f + √(1 − ρ) e_k: P(all ≤ h) = ∫ Π Φ((h_k − √ρ f)/√(1 − ρ)) φ(f) df, by the trapezoidal rule.
        for correlation in [0.1, 0.5, 0.8, 0.9_f64] {
            for d in 2..=MOST {
                for limit in [0.0, 1.0, 1.645, 2.5] {
                    let limits: Vec<f64> = (0..d).map(|k| limit + 0.1 * k as f64).collect();
                    let step = 0.01;
                    let integrand = |i: i32| {
                        let f = f64::from(i) * step;
                        let each = |h: &f64| normal_cdf((h - correlation.sqrt() * f) / (1.0 - correlation).sqrt());
                        limits.iter().map(each).product::<f64>() * (-0.5 * f * f).exp() / (2.0 * PI).sqrt()
                    };
                    let expected = 1.0 - (-800..=800).map(integrand).sum::<f64>() * step;
                    let found = probability_of_any(&limits, |_, _| correlation);
                    assert!(
                        (found - expected).abs() < 2e-3,
                        "{d}, {correlation}, {limit}: {found}, expected {expected}"
                    );
                }
            }
        }
    }

    #[test]
    fn any_correlations_agree_with_simulation() {
        const DRAWS: usize = 40_000;
        let mut stream = stats::stream(1, "test: orthant");
        for d in [3, 5, 8] {
            // R from d + 2 random vectors.
            let vectors: Vec<Vec<f64>> =
                (0..d).map(|_| (0..d + 2).map(|_| stream.sample(StandardNormal)).collect()).collect();
            let dot = |k: usize, l: usize| vectors[k].iter().zip(&vectors[l]).map(|(a, b)| a * b).sum::<f64>();
            let limits: Vec<f64> = (0..d).map(|k| 0.8 + 0.2 * k as f64).collect();
            let mut any = 0;
            for _ in 0..DRAWS {
                let z: Vec<f64> = (0..d + 2).map(|_| stream.sample(StandardNormal)).collect();
                let value = |k: usize| vectors[k].iter().zip(&z).map(|(a, b)| a * b).sum::<f64>() / dot(k, k).sqrt();
                any += usize::from((0..d).any(|k| value(k) > limits[k]));
            }
            let expected = any as f64 / DRAWS as f64;
            let found = probability_of_any(&limits, |k, l| dot(k, l) / (dot(k, k) * dot(l, l)).sqrt());
            // A share of 40,000 scatters by at most 0.0025: three times that, and 0.003 for the integral.
            assert!((found - expected).abs() < 0.0075 + 0.003, "{d}: {found}, expected {expected}");
        }
    }

    #[test]
    fn variables_that_move_together_count_once() {
        let found = probability_of_any(&[1.645, 1.645, 2.0], |k, l| if k == l { 1.0 } else { 1.0 - 1e-12 });
        // The integrand is a step, which 32 points resolve to 1/32.
        assert!((found - 0.05).abs() < 0.032, "{found}");
    }
}
