//! The likelihood of a normal population with full covariance, and its maximum.

use std::f64::consts::LOG2_E;

use super::kernel::{cross_moment, moments, weigh, Lanes, Terms, LANES};
use super::problem::{Problem, Weights, EM_ITERATIONS, WIDEST};
use super::small::{SmallMatrix, SmallVector, MOST};

/// Change of mean and standard deviation (in standard deviations) and of correlations at which expectation–maximisation stops.
const CONVERGED: f64 = 1e-4;
const CONVERGED_CORRELATION: f64 = 1e-3;

/// A normal distribution N(μ, Σ) of all parameters in the unit box.
#[derive(Debug, Clone)]
pub(super) struct Normal {
    /// μ.
    pub mean: SmallVector,
    /// Σ.
    pub covariance: SmallMatrix,
    /// The lower triangular root V of the precision matrix: Σ⁻¹ = Vᵀ V.
    pub root: SmallMatrix,
    /// ln |V| = −½ ln |Σ|.
    pub log_root: f64,
}

impl Normal {
    /// The normal distribution with this mean and covariance; `None` where the covariance is not positive definite.
    pub fn new(mean: SmallVector, covariance: &SmallMatrix) -> Option<Self> {
        let root = covariance.cholesky()?.lower_inverse();
        let log_root = (0..root.size).map(|k| root.rows[k][k].ln()).sum();
        Some(Self { mean, covariance: *covariance, root, log_root })
    }

    /// Number of parameters.
    pub fn size(&self) -> usize {
        self.covariance.size
    }

    /// Standard deviation of parameter k.
    pub fn std(&self, k: usize) -> f64 {
        self.covariance.rows[k][k].sqrt()
    }

    /// Correlation of parameters k and l.
    pub fn correlation(&self, k: usize, l: usize) -> f64 {
        self.covariance.rows[k][l] / (self.std(k) * self.std(l))
    }

    /// Σ⁻¹.
    pub fn precision(&self) -> SmallMatrix {
        self.root.transposed().squared()
    }
}

/// Sums over the measurements under the weights of a population: about its mean, and about the mean of each measurement.
pub(super) struct Moments {
    /// Σ_j E_j (x − μ).
    pub first: SmallVector,
    /// Σ_j E_j (x − μ)(x − μ)ᵀ.
    pub second: SmallMatrix,
    /// Σ_j cov_j x.
    pub within: SmallMatrix,
}

impl Problem {
    /// Whether mean and standard deviation of every parameter are within the prior, and no standard deviation is below what the
    /// samples can resolve.
    pub(super) fn allows(&self, normal: &Normal) -> bool {
        normal.mean.iter().all(|mean| (0.0..=1.0).contains(mean)) && self.allows_stds(normal)
    }

    /// As [`Self::allows`], for the standard deviations alone.
    pub(super) fn allows_stds(&self, normal: &Normal) -> bool {
        (0..normal.size()).all(|k| (self.floor[k]..=WIDEST).contains(&normal.std(k)))
    }

    /// Computes the weights of all samples under a normal population with full covariance.
    ///
    /// ```text
    ///  ln w_s = offset_s − ½ (x_s − μ)ᵀ Σ⁻¹ (x_s − μ) + ½ (c − μ)ᵀ Σ⁻¹ (c − μ)
    /// ```
    pub(super) fn weigh_normal(&self, normal: &Normal, weights: &mut Weights) {
        let Weights { values, logarithms, blocks, of_centres, squares, linears, crosses, .. } = weights;
        let (d, precision) = (normal.size(), normal.precision());
        for (k, square) in squares.iter_mut().enumerate() {
            *square = (-0.5 * LOG2_E * precision.rows[k][k]) as f32;
        }
        crosses.clear();
        crosses.extend(
            (0..d).flat_map(|k| (0..k).map(move |l| (k, l))).map(|(k, l)| (-LOG2_E * precision.rows[k][l]) as f32),
        );
        of_centres.fill(0.0);
        for ((block, centres), weighed) in self.blocks.iter().zip(self.lane_centres.chunks(d)).zip(blocks) {
            let mut off = [[0.0; LANES]; MOST];
            for (k, (off, centres)) in off.iter_mut().zip(centres).enumerate() {
                off.iter_mut().zip(centres).for_each(|(off, centre)| *off = normal.mean[k] - centre);
            }
            for (k, linear) in linears.iter_mut().enumerate() {
                let mut sums = [0.0; LANES];
                for (off, factor) in off.iter().zip(&precision.rows[k]).take(d) {
                    sums.iter_mut().zip(off).for_each(|(sum, off)| *sum += factor * off);
                }
                let measured = block.measurements.len();
                of_centres[k] += sums.iter().zip(&off[k]).take(measured).map(|(sum, off)| sum * off).sum::<f64>();
                *linear = Lanes(sums.map(|sum| (LOG2_E * sum) as f32));
            }
            let places = block.places.clone();
            let (values, logarithms) = (&mut values[places.clone()], &mut logarithms[places.clone()]);
            let to = &self.offsets[places.clone()];
            let terms = Terms { to, deviations: &self.deviations, places, squares, linears, crosses };
            *weighed = weigh(values, logarithms, &terms, block.width, &weighed.divisor);
        }
    }

    /// ln L(μ, Σ) up to a constant. `weights`: those under the same population.
    pub(super) fn log_likelihood_of_normal(&self, normal: &Normal, weights: &Weights) -> f64 {
        self.log_sums(weights) + self.measurements as f64 * normal.log_root
    }

    /// The most probable normal population, by expectation–maximisation as in `populations`, but with the full matrix of second
    /// moments.
    ///
    /// ```text
    ///  C = 1/n [ Σ_js w_js (x_js − μ)(x_js − μ)ᵀ + Σ − W ],    W = 1/n Σ_j cov_w(x_j)
    ///  Σ: variances of C, correlations of C + G,    G = 1/n diag(C_kk + d/(Σ⁻¹)_kk)
    /// ```
    ///
    /// G corresponds to the prior of the correlations and to one further measurement without correlation: it keeps Σ regular where
    /// the samples do not determine a correlation.
    pub(super) fn maximise_normal(&self) -> Normal {
        let mut normal = self.start();
        let mut weights = self.buffers();
        for _ in 0..EM_ITERATIONS {
            self.weigh_normal(&normal, &mut weights);
            let next = self.improved(&normal, &self.moments(&normal, &weights));
            let d = normal.size();
            let moved = (0..d).map(|k| {
                let shift = (next.mean[k] - normal.mean[k]).abs() / next.std(k);
                shift.max((next.std(k) / normal.std(k) - 1.0).abs())
            });
            let turned = (0..d).flat_map(|k| (0..k).map(move |l| (k, l)));
            let turned = turned.map(|(k, l)| (next.correlation(k, l) - normal.correlation(k, l)).abs());
            let done = moved.fold(0.0, f64::max) < CONVERGED && turned.fold(0.0, f64::max) < CONVERGED_CORRELATION;
            normal = next;
            if done {
                break;
            }
        }
        normal
    }

    /// Effective sample size (Σw)²/Σw² under a population, averaged over the measurements.
    pub(super) fn effective_sample_size_of_normal(&self, normal: &Normal) -> f64 {
        let mut weights = self.buffers();
        self.weigh_normal(normal, &mut weights);
        self.effective_sample_size_of(&weights)
    }

    /// Mean and covariance of the centres of the measurements, with which the iterations begin.
    fn start(&self) -> Normal {
        let (n, d) = (self.measurements as f64, self.deviations.len());
        let mut mean = [0.0; MOST];
        for centres in self.centres.chunks(d) {
            mean.iter_mut().zip(centres).for_each(|(mean, centre)| *mean += centre / n);
        }
        let mut sums = SmallMatrix::from_fn(d, |_, _| 0.0);
        for centres in self.centres.chunks(d) {
            for (k, row) in sums.rows.iter_mut().enumerate().take(d) {
                for (l, sum) in row.iter_mut().enumerate().take(d) {
                    *sum += (centres[k] - mean[k]) * (centres[l] - mean[l]) / (n - 1.0);
                }
            }
        }
        self.regular(mean, &sums, &[0.0; MOST])
    }

    /// N(`mean`, Σ) with the correlations of `from` + G and the standard deviations of `from` within their limits. `conditional`:
    /// 1/(Σ⁻¹)_kk.
    fn regular(&self, mean: SmallVector, from: &SmallMatrix, conditional: &SmallVector) -> Normal {
        let (n, d) = (self.measurements as f64, from.size);
        let of_each =
            |f: &dyn Fn(usize) -> f64| -> SmallVector { std::array::from_fn(|k| if k < d { f(k) } else { 0.0 }) };
        let std = of_each(&|k| from.rows[k][k].max(0.0).sqrt().clamp(self.floor[k], WIDEST));
        let wider = of_each(&|k| {
            let own = from.rows[k][k].max(std[k] * std[k]);
            (own + (own + d as f64 * conditional[k].min(own)) / n).sqrt()
        });
        let correlation = |k: usize, l: usize| (from.rows[k][l] / (wider[k] * wider[l])).clamp(-1.0, 1.0);
        // Sums over weighted samples need not be positive definite where the noise dominates.
        let reduced = |share: f64| {
            let entry = |k: usize, l: usize| std[k] * std[l] * if k == l { 1.0 } else { share * correlation(k, l) };
            Normal::new(mean, &SmallMatrix::from_fn(d, entry))
        };
        let found = [1.0, 0.95, 0.8, 0.5].into_iter().find_map(reduced);
        found.unwrap_or_else(|| reduced(0.0).expect("all standard deviations are positive"))
    }

    /// The sums under the weights of `normal`.
    pub(super) fn moments(&self, normal: &Normal, weights: &Weights) -> Moments {
        let d = normal.size();
        let zero = SmallMatrix::from_fn(d, |_, _| 0.0);
        let mut sums = Moments { first: [0.0; MOST], second: zero, within: zero };
        for (block, weighed) in self.blocks.iter().zip(&weights.blocks) {
            let values = &weights.values[block.places.clone()];
            let own: Vec<&[Lanes]> = self.deviations.iter().map(|x| &x[block.places.clone()]).collect();
            let diagonal: Vec<(Lanes, Lanes)> = own.iter().map(|x| moments(values, x)).collect();
            let pairs = (0..d).flat_map(|k| (0..k).map(move |l| (k, l)));
            let crosses: Vec<Lanes> = pairs.map(|(k, l)| cross_moment(values, own[k], own[l])).collect();
            for (measurement, lanes) in block.lanes() {
                let sum = weighed.sum.of(lanes.clone());
                let centres = self.centres(measurement);
                let first = |k: usize| diagonal[k].0.of(lanes.clone()) / sum;
                let first: SmallVector = std::array::from_fn(|k| if k < d { first(k) } else { 0.0 });
                for k in 0..d {
                    let off_k = centres[k] - normal.mean[k];
                    sums.first[k] += off_k + first[k];
                    for l in 0..=k {
                        let product = if l == k { &diagonal[k].1 } else { &crosses[k * (k.max(1) - 1) / 2 + l] };
                        let (product, off_l) = (product.of(lanes.clone()) / sum, centres[l] - normal.mean[l]);
                        sums.second.rows[k][l] += product + off_k * first[l] + off_l * first[k] + off_k * off_l;
                        sums.within.rows[k][l] += product - first[k] * first[l];
                    }
                }
            }
        }
        let full = |half: &SmallMatrix| SmallMatrix::from_fn(d, |k, l| half.rows[k.max(l)][k.min(l)]);
        Moments { second: full(&sums.second), within: full(&sums.within), ..sums }
    }

    /// One maximisation step.
    fn improved(&self, old: &Normal, sums: &Moments) -> Normal {
        let (n, d) = (self.measurements as f64, old.size());
        let shift = sums.first.map(|sum| sum / n);
        let within = |k: usize, l: usize| sums.within.rows[k][l] / n;
        let is_absorbed = |k: usize| old.covariance.rows[k][k] > within(k, k);
        let entry = |k: usize, l: usize| {
            let both = is_absorbed(k) && is_absorbed(l);
            let absorbed = if both { old.covariance.rows[k][l] - within(k, l) } else { 0.0 };
            (sums.second.rows[k][l] - n * shift[k] * shift[l] + absorbed) / n
        };
        let mean = std::array::from_fn(|k| if k < d { (old.mean[k] + shift[k]).clamp(0.0, 1.0) } else { 0.0 });
        let precision = old.precision();
        let conditional = std::array::from_fn(|k| if k < d { 1.0 / precision.rows[k][k] } else { 0.0 });
        self.regular(mean, &SmallMatrix::from_fn(d, entry), &conditional)
    }
}
