//! The likelihood of the measurements under a model with or without the hidden effects, and its maximum.

use std::collections::BTreeMap;
use std::f64::consts::PI;

use super::effect::Effect;
use super::numbers::mean;
use super::rows::Row;
use super::structure::{Structure, PRIOR};

/// Population means and factors of the effects, spreads of the population, and noise.
pub struct Fit {
    pub theta: Vec<f64>,
    pub spreads: Vec<f64>,
    pub noise: f64,
    pub log_likelihood: f64,
}

/// Rows with the same effects, setting and missing frequencies.
struct Cell {
    point: usize,
    present: Vec<usize>,
    rows: f64,
    /// Mean of the log frequencies.
    mean: Vec<f64>,
    /// Sum of the products of deviations from the mean.
    scatter: Vec<f64>,
}

/// Log frequencies at a point and their derivatives, one vector per parameter.
struct Expansion {
    value: Vec<f64>,
    slopes: Vec<Vec<f64>>,
}

/// The rows in the form that the likelihood needs: without outliers, and equal rows combined.
pub struct Data<'a> {
    structure: &'a Structure,
    effects: &'a [&'a Effect],
    /// Setting, then the value of each effect.
    points: Vec<Vec<f64>>,
    cells: Vec<Cell>,
}

impl<'a> Data<'a> {
    pub fn new(structure: &'a Structure, effects: &'a [&'a Effect], rows: &[Row]) -> Self {
        let mut data = Self { structure, effects, points: Vec::new(), cells: Vec::new() };
        let mut point_of = BTreeMap::new();
        let mut rows_of = BTreeMap::<_, Vec<&Row>>::new();
        for row in rows.iter().filter(|r| !r.outlier) {
            let point = data.point(row);
            let bits = point.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
            let point = *point_of.entry(bits).or_insert_with(|| {
                data.points.push(point);
                data.points.len() - 1
            });
            let present = (0..structure.modes).filter(|&m| row.log_f[m].is_some()).collect::<Vec<_>>();
            rows_of.entry((point, present)).or_default().push(row);
        }
        data.cells = rows_of.into_iter().map(|((point, present), rows)| Cell::new(point, present, &rows)).collect();
        data
    }

    /// Setting, then the value of each effect, in a row.
    fn point(&self, row: &Row) -> Vec<f64> {
        [row.set].into_iter().chain(self.effects.iter().map(|e| e.signal[row.index])).collect()
    }

    fn value(&self, point: &[f64], theta: &[f64]) -> Option<Vec<f64>> {
        let (free, factors) = theta.split_at(self.structure.free.len());
        let gains = self.effects.iter().zip(&point[1..]).zip(factors).map(|((e, g), factor)| (&e.target, g * factor));
        self.structure.log_frequencies(point[0], free, &gains.collect::<Vec<_>>())
    }

    fn expand(&self, theta: &[f64]) -> Option<Vec<Expansion>> {
        let slope = |point: &Vec<f64>, index: usize| {
            let step = 1e-4 * theta[index];
            let shifted = |by: f64| {
                let mut theta = theta.to_vec();
                theta[index] += by;
                self.value(point, &theta)
            };
            let (up, down) = (shifted(step)?, shifted(-step)?);
            Some(up.iter().zip(&down).map(|(u, d)| (u - d) / (2.0 * step)).collect())
        };
        let expansion = |point| {
            let slopes = (0..theta.len()).map(|index| slope(point, index)).collect::<Option<_>>()?;
            Some(Expansion { value: self.value(point, theta)?, slopes })
        };
        self.points.iter().map(expansion).collect()
    }

    /// Log density of the log frequencies, with all constants: normal, with the spread of the population and the noise.
    fn log_likelihood(&self, expansions: &[Expansion], spreads: &[f64], noise: f64) -> f64 {
        let of_cell = |cell: &Cell| {
            let expansion = &expansions[cell.point];
            let m = cell.present.len();
            let Some((inverse, log_det)) = inverse(&cell.covariance(expansion, spreads, noise), m) else {
                return f64::NEG_INFINITY;
            };
            let off = cell.deviation(expansion);
            let square =
                |i: usize, j: usize| inverse[i * m + j] * (cell.rows * off[i] * off[j] + cell.scatter[i * m + j]);
            let squares: f64 = (0..m).flat_map(|i| (0..m).map(move |j| (i, j))).map(|(i, j)| square(i, j)).sum();
            -0.5 * (cell.rows * (m as f64 * (2.0 * PI).ln() + log_det) + squares)
        };
        self.cells.iter().map(of_cell).sum()
    }

    pub fn log_likelihood_of(&self, fit: &Fit) -> Option<f64> {
        Some(self.log_likelihood(&self.expand(&fit.theta)?, &fit.spreads, fit.noise))
    }

    /// Maximum-likelihood means, factors, spreads and noise: the best result of several starts.
    pub fn fit(&self, true_theta: &[f64]) -> Option<Fit> {
        let free = &self.structure.free;
        let start = |share: &dyn Fn(usize) -> f64| {
            let means = free.iter().enumerate().map(|(i, &s)| share(i) * self.structure.springs[s].n_per_m);
            means.chain(self.effects.iter().map(|_| 1.0)).collect::<Vec<_>>()
        };
        let mut truth = start(&|_| 1.0);
        truth[..free.len()].copy_from_slice(&true_theta[..free.len()]);
        let mut starts = vec![truth];
        // With few different points a fit is cheap, and the best means of a wrong model may be far from the true ones.
        if self.points.len() < 10 {
            starts.push(start(&|_| 0.75));
            starts.push(start(&|_| 1.3));
            starts.push(start(&|i| if i % 2 == 0 { 0.75 } else { 1.3 }));
            starts.push(start(&|i| if i % 2 == 0 { 1.3 } else { 0.75 }));
        }
        let fits = starts.into_iter().filter_map(|theta| self.climb(theta));
        fits.max_by(|a, b| a.log_likelihood.total_cmp(&b.log_likelihood))
    }

    /// Alternates Gauss-Newton steps of the means and factors with a search over log spreads and log noise.
    fn climb(&self, theta: Vec<f64>) -> Option<Fit> {
        let free = self.structure.free.len();
        let mut log_sds =
            theta[..free].iter().map(|mean| (0.01 * mean).ln()).chain([0.01_f64.ln()]).collect::<Vec<_>>();
        let mut theta = theta;
        let mut expansions = self.expand(&theta)?;
        let mut best = f64::NEG_INFINITY;
        for _ in 0..40 {
            let before = best;
            best = self.search_sds(&expansions, &mut log_sds);
            let (spreads, noise) = split_sds(&log_sds);
            let step = self.newton_step(&expansions, &spreads, noise)?;
            for share in [1.0, 0.5, 0.25, 0.1, 0.02] {
                let next = self.within_prior(&theta, &step, share);
                let Some(trial) = self.expand(&next) else { continue };
                let log_likelihood = self.log_likelihood(&trial, &spreads, noise);
                if log_likelihood > best {
                    (best, theta, expansions) = (log_likelihood, next, trial);
                    break;
                }
            }
            if best - before < 1e-3 {
                break;
            }
        }
        let (spreads, noise) = split_sds(&log_sds);
        Some(Fit { theta, spreads, noise, log_likelihood: best })
    }

    /// Compass search: a step along each axis, halved if none improves the likelihood.
    fn search_sds(&self, expansions: &[Expansion], log_sds: &mut [f64]) -> f64 {
        let value = |log_sds: &[f64]| {
            let (spreads, noise) = split_sds(log_sds);
            self.log_likelihood(expansions, &spreads, noise)
        };
        let mut best = value(log_sds);
        let mut step = 0.4;
        while step > 0.01 {
            let mut better = false;
            for axis in 0..log_sds.len() {
                for by in [step, -step] {
                    let kept = log_sds[axis];
                    log_sds[axis] = (kept + by).max(-12.0);
                    let trial = value(log_sds);
                    if trial > best + 1e-6 {
                        (best, better) = (trial, true);
                        break;
                    }
                    log_sds[axis] = kept;
                }
            }
            if !better {
                step *= 0.5;
            }
        }
        best
    }

    fn newton_step(&self, expansions: &[Expansion], spreads: &[f64], noise: f64) -> Option<Vec<f64>> {
        let n = expansions.first()?.slopes.len();
        let (mut curvature, mut slope) = (vec![0.0; n * n], vec![0.0; n]);
        for cell in &self.cells {
            let expansion = &expansions[cell.point];
            let m = cell.present.len();
            let (inverse, _) = inverse(&cell.covariance(expansion, spreads, noise), m)?;
            let off = cell.deviation(expansion);
            let column = |p: usize, i: usize| expansion.slopes[p][cell.present[i]];
            for p in 0..n {
                let weighted = (0..m).map(|j| (0..m).map(|i| column(p, i) * inverse[i * m + j]).sum::<f64>());
                let weighted = weighted.collect::<Vec<_>>();
                slope[p] += cell.rows * weighted.iter().zip(&off).map(|(w, o)| w * o).sum::<f64>();
                for q in 0..n {
                    curvature[p * n + q] += cell.rows * (0..m).map(|j| weighted[j] * column(q, j)).sum::<f64>();
                }
            }
        }
        // Scaled to a unit diagonal with a small ridge, because two parameters may have the same influence.
        let scale = (0..n).map(|p| curvature[p * n + p].max(1e-300).sqrt()).collect::<Vec<_>>();
        for p in 0..n {
            for q in 0..n {
                curvature[p * n + q] /= scale[p] * scale[q];
            }
            curvature[p * n + p] += 1e-8;
        }
        let (covariance, _) = inverse(&curvature, n)?;
        let step = |p: usize| (0..n).map(|q| covariance[p * n + q] * slope[q] / scale[q]).sum::<f64>() / scale[p];
        Some((0..n).map(step).collect())
    }

    /// A share of a step, limited to the prior and, for factors, to 0.05 to 5.
    fn within_prior(&self, theta: &[f64], step: &[f64], share: f64) -> Vec<f64> {
        let next = |index: usize| {
            let bounds = self.structure.free.get(index).map_or((0.05, 5.0), |&s| {
                let nominal = self.structure.springs[s].n_per_m;
                (PRIOR.0 * nominal, PRIOR.1 * nominal)
            });
            (theta[index] + share * step[index]).clamp(bounds.0, bounds.1)
        };
        (0..theta.len()).map(next).collect()
    }

    /// Mean over the modes of the rms relative error of prediction.
    pub fn rms_percent(structure: &Structure, effects: &[&Effect], rows: &[Row], fit: &Fit) -> Option<f64> {
        let data = Data { structure, effects, points: Vec::new(), cells: Vec::new() };
        let (mut squares, mut counts) = (vec![0.0; structure.modes], vec![0.0; structure.modes]);
        for row in rows.iter().filter(|r| !r.outlier) {
            let predicted = data.value(&data.point(row), &fit.theta)?;
            for (mode, log_f) in row.log_f.iter().enumerate() {
                if let Some(log_f) = log_f {
                    squares[mode] += (predicted[mode] - log_f).exp_m1().powi(2);
                    counts[mode] += 1.0;
                }
            }
        }
        Some(100.0 * mean(&squares.iter().zip(&counts).map(|(s, c)| (s / c).sqrt()).collect::<Vec<_>>()))
    }
}

impl Cell {
    fn new(point: usize, present: Vec<usize>, rows: &[&Row]) -> Self {
        let m = present.len();
        let of_mode = |mode: usize| rows.iter().filter_map(move |r| r.log_f[mode]).collect::<Vec<_>>();
        let columns = present.iter().map(|&mode| of_mode(mode)).collect::<Vec<_>>();
        let mean = columns.iter().map(|c| mean(c)).collect::<Vec<_>>();
        let product = |i: usize, j: usize| {
            let pairs = columns[i].iter().zip(&columns[j]);
            pairs.map(|(a, b)| (a - mean[i]) * (b - mean[j])).sum::<f64>()
        };
        let scatter = (0..m * m).map(|k| product(k / m, k % m)).collect();
        Self { point, present, rows: rows.len() as f64, mean, scatter }
    }

    fn deviation(&self, expansion: &Expansion) -> Vec<f64> {
        self.present.iter().zip(&self.mean).map(|(&mode, mean)| mean - expansion.value[mode]).collect()
    }

    /// J diag(spreads²) Jᵀ + noise² I for the modes present, `[m * m]`.
    fn covariance(&self, expansion: &Expansion, spreads: &[f64], noise: f64) -> Vec<f64> {
        let m = self.present.len();
        let mut covariance = vec![0.0; m * m];
        for i in 0..m {
            covariance[i * m + i] = noise * noise;
            for j in 0..m {
                let parts = expansion.slopes.iter().zip(spreads);
                covariance[i * m + j] +=
                    parts.map(|(slope, sd)| slope[self.present[i]] * slope[self.present[j]] * sd * sd).sum::<f64>();
            }
        }
        covariance
    }
}

fn split_sds(log_sds: &[f64]) -> (Vec<f64>, f64) {
    let (log_noise, log_spreads) = log_sds.split_last().expect("the noise is always there");
    (log_spreads.iter().map(|l| l.exp()).collect(), log_noise.exp())
}

/// Inverse and log determinant of a symmetric positive definite matrix, by its Cholesky factor.
fn inverse(a: &[f64], n: usize) -> Option<(Vec<f64>, f64)> {
    let mut l = vec![0.0; n * n];
    for i in 0..n {
        for j in 0..=i {
            let rest = a[i * n + j] - (0..j).map(|k| l[i * n + k] * l[j * n + k]).sum::<f64>();
            if i == j && !(rest > 0.0 && rest.is_finite()) {
                return None;
            }
            l[i * n + j] = if i == j { rest.sqrt() } else { rest / l[j * n + j] };
        }
    }
    let mut lower = vec![0.0; n * n];
    for j in 0..n {
        lower[j * n + j] = 1.0 / l[j * n + j];
        for i in j + 1..n {
            lower[i * n + j] = -(j..i).map(|k| l[i * n + k] * lower[k * n + j]).sum::<f64>() / l[i * n + i];
        }
    }
    let product = |i: usize, j: usize| (i.max(j)..n).map(|k| lower[k * n + i] * lower[k * n + j]).sum();
    let log_det = 2.0 * (0..n).map(|i| l[i * n + i].ln()).sum::<f64>();
    Some(((0..n * n).map(|k| product(k / n, k % n)).collect(), log_det))
}
