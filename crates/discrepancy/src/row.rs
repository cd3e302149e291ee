//! The log density of one row, with its contribution to the gradient and information of a fit.
//!
//! Source: Lange, Little and Taylor (1989), JASA 84, for the t distribution and its information.

use nalgebra::{DMatrix, DVector};
use statrs::function::gamma::ln_gamma;

/// Degrees of freedom of the t distribution that a fit chooses from.
const TAILS: [f64; 7] = [3.0, 4.0, 6.0, 10.0, 20.0, 50.0, f64::INFINITY];

/// The value that a fit starts with.
pub(super) const FIRST_TAILS: f64 = TAILS[2];

/// Workspace for one row: solves with its covariance and adds its part of the gradient and information.
///
/// All quantities are divided by the noise of their output, so that V = 1 + U Uᵀ, where U holds the derivatives by the parameters
/// times their spreads, `[p, free]`. e: residual, `[p]`.
///
/// ```text
///  C = 1 + UᵀU = L Lᵀ,   S = L⁻ᵀ,   T = U S:      V⁻¹ = 1 − T Tᵀ,   |V| = |L|²
///  q = Tᵀe,   z = V⁻¹e = e − T q,   UᵀV⁻¹e = S q,   UᵀV⁻¹ = S Tᵀ,   UᵀV⁻¹U = 1 − S Sᵀ
/// ```
pub(super) struct RowSums {
    means: usize,
    free: usize,
    /// e, `[p]`.
    pub(super) residual: Vec<f64>,
    /// Derivatives of the mean by the free means and ψ, `[p][means]`.
    pub(super) slopes: Vec<f64>,
    /// U, `[p][free]`.
    pub(super) spreads: Vec<f64>,
    /// L, `[free][free]`, lower triangle.
    factor: Vec<f64>,
    /// L⁻¹ = Sᵀ, `[free][free]`, lower triangle.
    inverse: Vec<f64>,
    /// T, `[p][free]`.
    absorbed: Vec<f64>,
    /// q, `[free]`.
    along: Vec<f64>,
    /// z, `[p]`.
    solved: Vec<f64>,
    /// Tᵀ times the derivatives of the mean, `[free][means]`.
    slopes_absorbed: Vec<f64>,
    /// GᵀV⁻¹e, `[free + p]`, and GᵀV⁻¹G, `[free + p][free + p]`, for the square root G = (U, 1) of V.
    score: Vec<f64>,
    products: Vec<f64>,
}

impl RowSums {
    /// A workspace for rows of at most `outputs` outputs.
    pub(super) fn new(means: usize, free: usize, outputs: usize) -> Self {
        let (of_free, of_outputs) = (vec![0.0; free * free], vec![0.0; outputs * free]);
        let variances = free + outputs;
        Self {
            means,
            free,
            residual: vec![0.0; outputs],
            slopes: vec![0.0; outputs * means],
            spreads: of_outputs.clone(),
            factor: of_free.clone(),
            inverse: of_free,
            absorbed: of_outputs,
            along: vec![0.0; free],
            solved: vec![0.0; outputs],
            slopes_absorbed: vec![0.0; free * means],
            score: vec![0.0; variances],
            products: vec![0.0; variances * variances],
        }
    }

    /// Factors V and solves for the residual of `p` outputs. Returns eᵀV⁻¹e and ½ ln|V|.
    pub(super) fn solve(&mut self, p: usize) -> (f64, f64) {
        let f = self.free;
        let mut volume = 1.0;
        for a in 0..f {
            for b in 0..=a {
                let mut sum = f64::from(u8::from(a == b));
                sum += self.spreads[..p * f].chunks_exact(f).map(|u| u[a] * u[b]).sum::<f64>();
                for c in 0..b {
                    sum -= self.factor[a * f + c] * self.factor[b * f + c];
                }
                self.factor[a * f + b] = if a == b { sum.sqrt() } else { sum / self.factor[b * f + b] };
            }
            volume *= self.factor[a * f + a];
        }
        for column in 0..f {
            for a in column..f {
                let mut sum = f64::from(u8::from(a == column));
                for c in column..a {
                    sum -= self.factor[a * f + c] * self.inverse[c * f + column];
                }
                self.inverse[a * f + column] = sum / self.factor[a * f + a];
            }
        }
        self.along.fill(0.0);
        for i in 0..p {
            for a in 0..f {
                let sum: f64 = (0..=a).map(|b| self.spreads[i * f + b] * self.inverse[a * f + b]).sum();
                self.absorbed[i * f + a] = sum;
                self.along[a] += sum * self.residual[i];
            }
        }
        let mut distance = 0.0;
        for i in 0..p {
            let taken: f64 = self.absorbed[i * f..(i + 1) * f].iter().zip(&self.along).map(|(t, q)| t * q).sum();
            self.solved[i] = self.residual[i] - taken;
            distance += self.residual[i] * self.solved[i];
        }
        (distance.max(0.0), volume.ln())
    }

    /// Adds the gradient and the lower triangle of the expected information of this row.
    ///
    /// ```text
    ///  means:       w Dᵀ V⁻¹ e,      a Dᵀ V⁻¹ D
    ///  ln scales:   w h_u² − B_uu,   2a B_uv² − b B_uu B_vv,    h = Gᵀ V⁻¹ e,   B = Gᵀ V⁻¹ G
    ///  w = (ν + p)/(ν + eᵀ V⁻¹ e),   a = (ν + p)/(ν + p + 2),   b = 2/(ν + p + 2)
    /// ```
    ///
    /// D: derivatives of the mean; G = (U, 1); the ln scales are those of the columns of G: spreads, then noise factors. Outputs of
    /// one group have one noise factor, whose score is the sum of theirs. `groups`: the group of each output, ascending.
    pub(super) fn add(
        &mut self,
        groups: &[usize],
        distance: f64,
        tails: f64,
        gradient: &mut DVector<f64>,
        information: &mut DMatrix<f64>,
    ) {
        let (p, f, means) = (groups.len(), self.free, self.means);
        let weight = weight(distance, p, tails);
        let (factor_a, factor_b) = information_factors(p, tails);
        self.slopes_absorbed.fill(0.0);
        for i in 0..p {
            let line = &self.slopes[i * means..(i + 1) * means];
            for (absorbed, own) in
                self.absorbed[i * f..(i + 1) * f].iter().zip(self.slopes_absorbed.chunks_exact_mut(means.max(1)))
            {
                for (sum, slope) in own.iter_mut().zip(line) {
                    *sum += absorbed * slope;
                }
            }
            for (a, slope) in line.iter().enumerate() {
                gradient[a] += weight * slope * self.solved[i];
                let scaled_slope = factor_a * slope;
                for (sum, other) in information.column_mut(a).as_mut_slice()[a..means].iter_mut().zip(&line[a..]) {
                    *sum += scaled_slope * other;
                }
            }
        }
        for line in self.slopes_absorbed.chunks_exact(means.max(1)) {
            for (a, slope) in line.iter().enumerate() {
                let scaled_slope = factor_a * slope;
                for (sum, other) in information.column_mut(a).as_mut_slice()[a..means].iter_mut().zip(&line[a..]) {
                    *sum -= scaled_slope * other;
                }
            }
        }

        let count = f + p;
        for a in 0..f {
            self.score[a] = (a..f).map(|c| self.inverse[c * f + a] * self.along[c]).sum();
            for b in 0..=a {
                let sum: f64 = (a..f).map(|c| self.inverse[c * f + a] * self.inverse[c * f + b]).sum();
                self.products[a * count + b] = f64::from(u8::from(a == b)) - sum;
            }
        }
        for i in 0..p {
            self.score[f + i] = self.solved[i];
            let own = &self.absorbed[i * f..(i + 1) * f];
            let line = &mut self.products[(f + i) * count..(f + i + 1) * count];
            for (a, product) in line[..f].iter_mut().enumerate() {
                *product = (a..f).map(|c| self.inverse[c * f + a] * own[c]).sum();
            }
            for (j, product) in line[f..=f + i].iter_mut().enumerate() {
                let sum: f64 = own.iter().zip(&self.absorbed[j * f..(j + 1) * f]).map(|(a, b)| a * b).sum();
                *product = f64::from(u8::from(i == j)) - sum;
            }
        }
        let place = |u: usize| means + if u < f { u } else { f + groups[u - f] };
        for u in 0..count {
            let own = self.products[u * count + u];
            gradient[place(u)] += weight * self.score[u] * self.score[u] - own;
            // The groups of the outputs ascend, so that the lower triangle for this row maps into the lower triangle of
            // `information`.
            let (twice_a, b_own) = (2.0 * factor_a, factor_b * own);
            for v in 0..=u {
                let shared = self.products[u * count + v];
                let both = twice_a * shared * shared - b_own * self.products[v * count + v];
                // Two outputs of a group meet in both orders.
                let times = if u != v && place(u) == place(v) { 2.0 } else { 1.0 };
                information[(place(u), place(v))] += times * both;
            }
        }
    }
}

/// Weight w of a row with squared Mahalanobis distance `distance`, relative to a normal distribution: (ν + p)/(ν + distance).
pub(super) fn weight(distance: f64, outputs: usize, tails: f64) -> f64 {
    if tails.is_finite() {
        (tails + outputs as f64) / (tails + distance)
    } else {
        1.0
    }
}

/// Factors of the expected information of a t distribution: a = (ν + p)/(ν + p + 2) and b = 2/(ν + p + 2); 1 and 0 for a normal
/// distribution.
fn information_factors(outputs: usize, tails: f64) -> (f64, f64) {
    if tails.is_finite() {
        let total = tails + outputs as f64;
        (total / (total + 2.0), 2.0 / (total + 2.0))
    } else {
        (1.0, 0.0)
    }
}

/// Log density of a multivariate t distribution, normal for ν = ∞.
///
/// ```text
///  ln p = ln Γ((ν + p)/2) − ln Γ(ν/2) − p/2 ln(νπ) − ½ ln|V| − (ν + p)/2 ln(1 + q/ν),    q = eᵀ V⁻¹ e
/// ```
pub(super) struct Density {
    tails: f64,
    /// The terms that depend only on the number of outputs p, `[outputs + 1]`.
    constants: Vec<f64>,
}

impl Density {
    /// The density of rows with at most `most` outputs.
    pub(super) fn new(tails: f64, most: usize) -> Self {
        let constant = |outputs: usize| {
            let m = outputs as f64;
            if tails.is_finite() {
                ln_gamma(0.5 * (tails + m)) - ln_gamma(0.5 * tails) - 0.5 * m * (tails * std::f64::consts::PI).ln()
            } else {
                -0.5 * m * std::f64::consts::TAU.ln()
            }
        };
        Self { tails, constants: (0..=most).map(constant).collect() }
    }

    /// Log density of one row, nats; `distance` is q, `half_log_det` is ½ ln|V|.
    pub(super) fn log(&self, distance: f64, outputs: usize, half_log_det: f64) -> f64 {
        let of_distance = if self.tails.is_finite() {
            0.5 * (self.tails + outputs as f64) * (distance / self.tails).ln_1p()
        } else {
            0.5 * distance
        };
        self.constants[outputs] - half_log_det - of_distance
    }

    /// Sum of the log densities of rows, given as q, number of outputs and ½ ln|V|.
    pub(super) fn total(&self, rows: &[(f64, usize, f64)]) -> f64 {
        // Logarithms are slow: for each number of outputs, their arguments are multiplied first.
        let mut products = vec![1.0; self.constants.len()];
        let mut sum = 0.0;
        for (distance, outputs, half_log_det) in rows {
            sum += self.constants[*outputs] - half_log_det;
            if self.tails.is_finite() {
                let product = &mut products[*outputs];
                *product *= 1.0 + distance / self.tails;
                if *product > 1e150 {
                    sum -= 0.5 * (self.tails + *outputs as f64) * product.ln();
                    *product = 1.0;
                }
            } else {
                sum -= 0.5 * distance;
            }
        }
        let left = |(outputs, product): (usize, &f64)| 0.5 * (self.tails + outputs as f64) * product.ln();
        if self.tails.is_finite() {
            sum -= products.iter().enumerate().map(left).sum::<f64>();
        }
        sum
    }
}

/// The degrees of freedom with the largest likelihood, for rows given as q, number of outputs and ½ ln|V|.
pub(super) fn best_tails(distances: &[(f64, usize, f64)]) -> f64 {
    let most = distances.iter().map(|(_, outputs, _)| *outputs).max().unwrap_or(0);
    let total = |tails: f64| Density::new(tails, most).total(distances);
    TAILS.into_iter().map(|t| (total(t), t)).max_by(|a, b| a.0.total_cmp(&b.0)).map_or(f64::INFINITY, |best| best.1)
}

#[cfg(test)]
mod tests {
    use rand::Rng as _;

    use super::*;
    use structures::stats;

    /// Compares distance, ½ ln|V|, score and information of a row with dense matrices.
    #[test]
    fn score_and_information_equal_those_of_dense_matrices() {
        let cases = [
            (4, 2, 3, 5.0, vec![0, 2, 3, 4]),
            (3, 3, 5, f64::INFINITY, vec![0, 2, 3]),
            (2, 4, 4, 3.0, vec![0, 2]),
            (3, 0, 2, 10.0, vec![0, 2, 3]),
            // Outputs that share a noise factor.
            (6, 2, 3, 5.0, vec![0, 1, 3, 3, 3, 5]),
            (4, 1, 2, f64::INFINITY, vec![2, 2, 4, 4]),
        ];
        for (p, f, means, tails, groups) in cases {
            let mut stream = stats::stream(p as u64, "a row");
            let mut random =
                |rows: usize, columns: usize| DMatrix::from_fn(rows, columns, |_, _| stream.random_range(-1.0..1.0));
            let (e, d, u) = (random(p, 1), random(p, means), random(p, f));
            let mut row = RowSums::new(means, f, 6);
            row.residual[..p].copy_from_slice(e.as_slice());
            row.slopes[..p * means].copy_from_slice(d.transpose().as_slice());
            row.spreads[..p * f].copy_from_slice(u.transpose().as_slice());
            let (distance, half_log_det) = row.solve(p);
            let unknowns = means + f + 6;
            let (mut gradient, mut information) = (DVector::zeros(unknowns), DMatrix::zeros(unknowns, unknowns));
            row.add(&groups, distance, tails, &mut gradient, &mut information);

            let v = DMatrix::identity(p, p) + &u * u.transpose();
            let inverse = v.clone().try_inverse().unwrap();
            assert!((distance - (e.transpose() * &inverse * &e)[(0, 0)]).abs() < 1e-12);
            assert!((half_log_det - 0.5 * v.determinant().ln()).abs() < 1e-12);
            let weight = weight(distance, p, tails);
            let (factor_a, factor_b) = information_factors(p, tails);
            let of_means = d.transpose() * &inverse * &e * weight;
            let between = d.transpose() * &inverse * &d * factor_a;
            let g = DMatrix::from_fn(p, f + p, |i, k| if k < f { u[(i, k)] } else { f64::from(u8::from(i == k - f)) });
            let (h, b) = (g.transpose() * &inverse * &e, g.transpose() * &inverse * &g);
            let mut expected = DVector::zeros(unknowns);
            let mut expected_information = DMatrix::zeros(unknowns, unknowns);
            for k in 0..means {
                expected[k] = of_means[(k, 0)];
                for l in 0..=k {
                    expected_information[(k, l)] = between[(k, l)];
                }
            }
            // The score of a noise factor is the sum of those of its outputs, and so is its information.
            let place = |k: usize| means + if k < f { k } else { f + groups[k - f] };
            for k in 0..f + p {
                expected[place(k)] += weight * h[(k, 0)] * h[(k, 0)] - b[(k, k)];
                for l in (0..f + p).filter(|l| place(*l) <= place(k)) {
                    let shared = b[(k, l)];
                    expected_information[(place(k), place(l))] +=
                        factor_a * 2.0 * shared * shared - factor_b * b[(k, k)] * b[(l, l)];
                }
            }
            assert!((gradient - expected).amax() < 1e-12, "{p} outputs, {f} parameters");
            assert!((information - expected_information).amax() < 1e-12, "{p} outputs, {f} parameters");
        }
    }

    #[test]
    fn densities_of_rows_add_up() {
        let mut stream = stats::stream(1, "densities");
        let mut row = |_| (50.0 * stream.random::<f64>(), stream.random_range(1..5), stream.random::<f64>());
        let rows: Vec<(f64, usize, f64)> = (0..500).map(&mut row).collect();
        for tails in TAILS {
            let density = Density::new(tails, 4);
            let each: f64 = rows.iter().map(|(q, m, half)| density.log(*q, *m, *half)).sum();
            assert!((density.total(&rows) - each).abs() < 1e-9 * each.abs(), "{tails}");
        }
    }
}
