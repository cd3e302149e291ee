//! The population behind measurements whose frequencies are linear in the parameters over its width.
//!
//! Where modes are missing or the noise is large, the posterior of a single measurement is far wider than the population, and samples of it
//! hardly ever lie where the population is. Linearised about a point c near the mean of the population, all measurements together are a
//! normal model that needs no such samples:
//!
//! ```text
//!  y_n = f_n(c) + J_n (x_n − c) + e_n,   e_n ~ N(0, R_n),   x_n ~ N(μ, Σ)
//!  I_n = J_nᵀ R_n⁻¹ J_n,   g_n = J_nᵀ R_n⁻¹ (y_n − f_n(c)),   P_n = Σ⁻¹ + I_n
//! ```
//!
//! Its posterior is drawn by a Gibbs sampler, in which μ is drawn without the x_n, so that it moves along directions that no measurement
//! confines:
//!
//! ```text
//!  μ | Σ       precision  Λ + Σ_n (Σ⁻¹ − Σ⁻¹ P_n⁻¹ Σ⁻¹),   its product with the mean  Λ m + Σ_n Σ⁻¹ P_n⁻¹ g_n
//!  x_n | μ, Σ  ~ N(P_n⁻¹ (g_n + Σ⁻¹ μ), P_n⁻¹)
//!  Σ | x, μ    ~ inverse Wishart(ν_0 + n, V_0 + Σ_n (x_n − μ)(x_n − μ)ᵀ)
//! ```
//!
//! Where noise dominates the spread, the x_n determine Σ almost completely, so that these draws hardly move it. Metropolis steps on the
//! likelihood without the x_n follow, which need the sums of the g_n and of their products alone:
//!
//! ```text
//!  Σ → A Σ Aᵀ,    A the identity but for one entry: e^ε on the diagonal, or ε beside it
//!  ln L = Σ_n ½ (g_n + Σ⁻¹ μ)ᵀ P_n⁻¹ (g_n + Σ⁻¹ μ) − ½ μᵀ Σ⁻¹ μ − ½ ln |P_n| + ½ ln |Σ⁻¹|
//! ```
//!
//! μ and x_n count from c here, and μ has the prior N(m, Λ⁻¹). The spread Σ has that of a healthy structure as its prior where it is known
//! ([`Spread::Usual`]), otherwise one with half-t distributed standard deviations and uniform correlations ([`Spread::Unknown`]).
//!
//! Source: A. Gelman et al. (2014), Bayesian Data Analysis, 3rd ed., ch. 15; prior of an unknown spread: A. Huang, M. P. Wand (2013), Simple
//! marginally noninformative prior distributions for covariance matrices, Bayesian Analysis 8, 439–452.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};
use rand::Rng as _;
use rand_distr::{Gamma, StandardNormal};

use super::correlation::Correlations;
use super::population::{PopulationEstimate, DRAWS};
use super::populations::Populations;
use super::problem::WIDEST;
use super::small::MOST;
use structures::parameter::{Parameter, ParameterSpace};
use structures::stats::{self, Stream};

/// Sweeps before the first draw that is kept.
const BURN_IN: usize = 200;

/// Sweeps for each draw that is kept; one where there are so many measurements that Σ hardly depends on its last value.
const SWEEPS_PER_DRAW: usize = 4;
const MANY: usize = 500;

/// Sizes of the Metropolis steps, from which one is chosen at random.
const STEPS: [f64; 3] = [0.1, 0.3, 1.0];

/// Most groups of measurements for which the Metropolis steps follow each sweep; with more, they follow as often as keeps their work.
const GROUPS: usize = 32;

/// Degrees of freedom of the half-t distributions of unknown standard deviations.
const HALF_T: f64 = 2.0;

/// Smallest standard deviation that a known spread has, as a share of the prior's width: Σ must be positive definite.
const LEAST_SPREAD: f64 = 1e-4;

/// How often a mean outside the prior is drawn again before it is moved to its bounds.
const ATTEMPTS: usize = 20;

/// Measurements with the same modes, noise and effects, in the unit box of the prior.
#[derive(Debug, Clone)]
pub struct LinearMeasurements {
    /// I_n, `[d, d]`.
    pub information: DMatrix<f64>,
    /// g_n of each, `[d, measurements]`.
    pub gradients: DMatrix<f64>,
}

/// What is known of Σ beside the measurements.
#[derive(Debug, Clone)]
pub enum Spread {
    /// Nothing.
    Unknown,
    /// It is likely to be that of a healthy structure.
    Usual {
        /// Its covariance in the unit box, `[d, d]`.
        covariance: DMatrix<f64>,
        /// Number of measurements that this knowledge is worth.
        degrees: f64,
    },
}

/// A batch of measurements, linearised about a point.
#[derive(Debug, Clone)]
pub struct LinearBatch {
    /// The measurements; at least one.
    pub alike: Vec<LinearMeasurements>,
    /// c in the unit box, `[d]`.
    pub about: DVector<f64>,
    /// m, counted from c, `[d]`.
    pub prior_mean: DVector<f64>,
    /// Diagonal of Λ, `[d]`.
    pub prior_precision: DVector<f64>,
    /// What is known of Σ.
    pub spread: Spread,
}

/// V_0 and ν_0 of the inverse Wishart distribution of Σ, with the scales of an unknown spread.
struct SpreadPrior {
    degrees: f64,
    scale: DMatrix<f64>,
    unknown: bool,
}

impl SpreadPrior {
    fn of(spread: &Spread, d: usize) -> Self {
        match spread {
            Spread::Unknown => Self {
                degrees: HALF_T + d as f64 - 1.0,
                scale: DMatrix::identity(d, d) * (2.0 * HALF_T * WIDEST * WIDEST),
                unknown: true,
            },
            // Of this distribution the mean is the covariance itself.
            Spread::Usual { covariance, degrees } => Self {
                degrees: degrees + d as f64 + 1.0,
                scale: (covariance + DMatrix::identity(d, d) * LEAST_SPREAD.powi(2)) * *degrees,
                unknown: false,
            },
        }
    }

    /// Draws Σ⁻¹ given Σ_n (x_n − μ)(x_n − μ)ᵀ of n measurements; `None` where the sum is not finite.
    fn precision(&mut self, squares: &DMatrix<f64>, n: usize, stream: &mut Stream) -> Option<DMatrix<f64>> {
        let d = squares.nrows();
        let degrees = self.degrees + n as f64;
        // L⁻¹ of V = L Lᵀ: with A as below, L⁻ᵀ A Aᵀ L⁻¹ has a Wishart distribution of scale V⁻¹ (Bartlett's decomposition).
        let factor = (&self.scale + squares).cholesky()?.l().solve_lower_triangular(&DMatrix::identity(d, d))?;
        let mut triangle = DMatrix::zeros(d, d);
        for i in 0..d {
            triangle[(i, i)] = gamma(0.5 * (degrees - i as f64), 2.0, stream).sqrt();
            (0..i).for_each(|j| triangle[(i, j)] = stream.sample(StandardNormal));
        }
        let root = factor.tr_mul(&triangle);
        let precision = &root * root.transpose();
        if self.unknown {
            for k in 0..d {
                let rate = HALF_T * precision[(k, k)] + WIDEST.powi(-2);
                let inverse_scale = gamma(0.5 * (HALF_T + d as f64), 1.0 / rate, stream);
                self.scale[(k, k)] = 2.0 * HALF_T * inverse_scale;
            }
        }
        Some(precision)
    }
}

fn gamma(shape: f64, scale: f64, stream: &mut Stream) -> f64 {
    Gamma::new(shape, scale).map_or(f64::NAN, |gamma| stream.sample(gamma))
}

/// L⁻ᵀ Z of standard normal Z, `[d, columns]`: columns with the covariance of the inverse of L Lᵀ.
fn deviates(factor: &Cholesky<f64, Dyn>, columns: usize, stream: &mut Stream) -> Option<DMatrix<f64>> {
    let normal = DMatrix::from_fn(factor.l_dirty().nrows(), columns, |_, _| stream.sample(StandardNormal));
    factor.l().tr_solve_lower_triangular(&normal)
}

/// Sums over the measurements of a group.
struct Sums {
    count: f64,
    /// Σ g_n, `[d]`.
    sum: DVector<f64>,
    /// Σ g_n g_nᵀ, `[d, d]`.
    products: DMatrix<f64>,
}

impl Sums {
    fn of(alike: &LinearMeasurements) -> Self {
        let gradients = &alike.gradients;
        Self {
            count: gradients.ncols() as f64,
            sum: gradients.column_sum(),
            products: gradients * gradients.transpose(),
        }
    }
}

/// μ and Σ of one sweep.
struct Swept {
    mean: DVector<f64>,
    covariance: DMatrix<f64>,
}

impl LinearBatch {
    /// The population behind the batch: means and standard deviations in the units of `space`, with [`DRAWS`] draws of both, and their
    /// correlations for up to eight parameters. `None` where the matrices are not finite.
    pub fn populations(&self, space: &ParameterSpace, seed: u64) -> Option<Populations> {
        let draws = self.draws(seed)?;
        let one = |(k, parameter): (usize, &Parameter)| {
            let width = parameter.upper - parameter.lower;
            let std = |draw: &Swept| draw.covariance[(k, k)].sqrt().min(WIDEST);
            let mean_draws: Vec<f64> = draws.iter().map(|d| parameter.from_unit(self.about[k] + d.mean[k])).collect();
            let std_draws: Vec<f64> = draws.iter().map(|draw| width * std(draw)).collect();
            let (mean, std) = (stats::mean(&mean_draws), Some(stats::quantile(&std_draws, 0.5)));
            PopulationEstimate { mean, std, mean_draws, std_draws }
        };
        let d = space.len();
        let correlations = |draw: &Swept| {
            let covariance = draw.covariance.clone();
            let pairs = (0..d).flat_map(|k| (0..k).map(move |l| (k, l)));
            pairs.map(move |(k, l)| {
                (covariance[(k, l)] / (covariance[(k, k)] * covariance[(l, l)]).sqrt()).clamp(-1.0, 1.0)
            })
        };
        let correlated = (2..=MOST).contains(&d);
        Some(Populations {
            parameters: space.iter().enumerate().map(one).collect(),
            correlations: correlated
                .then(|| Correlations::from_draws(d, draws.iter().flat_map(correlations).collect())),
            effective_sample_size: DRAWS as f64,
        })
    }

    fn draws(&self, seed: u64) -> Option<Vec<Swept>> {
        let d = self.about.len();
        let count: usize = self.alike.iter().map(|alike| alike.gradients.ncols()).sum();
        let sweeps = if count < MANY { SWEEPS_PER_DRAW } else { 1 };
        let mut stream = stats::stream(seed, "population of linear measurements");
        let mut prior = SpreadPrior::of(&self.spread, d);
        // The mean of the prior of Σ⁻¹ for a known spread; a twentieth of the prior's width for an unknown one.
        let mut precision = match &self.spread {
            Spread::Unknown => DMatrix::identity(d, d) * 400.0,
            Spread::Usual { degrees, .. } => (prior.scale.clone() / *degrees).cholesky()?.inverse(),
        };
        let mut kept = Vec::with_capacity(DRAWS);
        let sums: Vec<Sums> = self.alike.iter().map(Sums::of).collect();
        let every = self.alike.len().div_ceil(GROUPS);
        for sweep in 0..BURN_IN + sweeps * DRAWS {
            let mean = self.sweep(&mut precision, &mut prior, &mut stream)?;
            if sweep % every == 0 {
                self.collapsed(&sums, &mean, &mut precision, &prior, &mut stream)?;
            }
            if sweep >= BURN_IN && (sweep - BURN_IN) % sweeps == sweeps - 1 {
                kept.push(Swept { mean, covariance: precision.clone().cholesky()?.inverse() });
            }
        }
        Some(kept)
    }

    /// ln L of the spread Σ, without the x_n.
    fn log_likelihood(&self, sums: &[Sums], mean: &DVector<f64>, precision: &DMatrix<f64>) -> Option<f64> {
        let pulled = precision * mean;
        let own = precision.clone().cholesky()?.ln_determinant() - mean.dot(&pulled);
        let mut total = 0.0;
        for (alike, sums) in self.alike.iter().zip(sums) {
            let factor = (precision + &alike.information).cholesky()?;
            // Σ_n (g_n + p)ᵀ P⁻¹ (g_n + p) = tr P⁻¹ Σ_n g_n g_nᵀ + pᵀ P⁻¹ (2 Σ_n g_n + n p).
            let with_pulled = factor.solve(&pulled).dot(&(&sums.sum * 2.0 + &pulled * sums.count));
            total += factor.solve(&sums.products).trace() + with_pulled + sums.count * (own - factor.ln_determinant());
        }
        Some(0.5 * total)
    }

    /// A Metropolis step for the scale of each parameter, and one for its correlation with another one.
    fn collapsed(
        &self,
        sums: &[Sums],
        mean: &DVector<f64>,
        precision: &mut DMatrix<f64>,
        prior: &SpreadPrior,
        stream: &mut Stream,
    ) -> Option<()> {
        let d = mean.len();
        let log_density = |precision: &DMatrix<f64>| {
            let likelihood = self.log_likelihood(sums, mean, precision)?;
            Some(likelihood - 0.5 * prior.scale.component_mul(precision).sum())
        };
        let mut here = log_density(precision)?;
        for k in 0..d {
            for other in [k, stream.random_range(0..d)] {
                let step = STEPS[stream.random_range(0..STEPS.len())] * stream.sample::<f64, _>(StandardNormal);
                // Σ⁻¹ changes by A⁻¹. The volume of the space of Σ changes by |A| to the power d + 1, and its density by |Σ| to the power
                // −(ν + d + 1)/2: ν ε is left of both.
                let mut inverse = DMatrix::identity(d, d);
                inverse[(k, other)] = if other == k { (-step).exp() } else { -step };
                let next = inverse.tr_mul(precision) * &inverse;
                let threshold: f64 = stream.random();
                let Some(there) = log_density(&next) else { continue };
                let volume = if other == k { -prior.degrees * step } else { 0.0 };
                if threshold.ln() < there - here + volume {
                    (*precision, here) = (next, there);
                }
            }
        }
        Some(())
    }

    /// One sweep of the Gibbs sampler, which replaces Σ⁻¹ and returns μ.
    fn sweep(
        &self,
        precision: &mut DMatrix<f64>,
        prior: &mut SpreadPrior,
        stream: &mut Stream,
    ) -> Option<DVector<f64>> {
        let d = self.about.len();
        let mut information = DMatrix::from_diagonal(&self.prior_precision);
        let mut gradient = self.prior_precision.component_mul(&self.prior_mean);
        let mut factors = Vec::with_capacity(self.alike.len());
        for alike in &self.alike {
            let factor = (&*precision + &alike.information).cholesky()?;
            // Σ⁻¹ P_n⁻¹, transposed.
            let shrunk = factor.solve(precision);
            information += (&*precision - precision.tr_mul(&shrunk)) * alike.gradients.ncols() as f64;
            gradient += shrunk.tr_mul(&alike.gradients.column_sum());
            factors.push(factor);
        }
        let of_mean = information.cholesky()?;
        let centre = of_mean.solve(&gradient);
        let within = |mean: &DVector<f64>| (0..d).all(|k| (0.0..=1.0).contains(&(self.about[k] + mean[k])));
        let mut mean = centre.clone();
        for attempt in 0..ATTEMPTS {
            mean = &centre + deviates(&of_mean, 1, stream)?.column(0);
            if within(&mean) {
                break;
            }
            if attempt + 1 == ATTEMPTS {
                mean = DVector::from_fn(d, |k, _| (self.about[k] + mean[k]).clamp(0.0, 1.0) - self.about[k]);
            }
        }
        let pulled = &*precision * &mean;
        let (mut squares, mut count) = (DMatrix::zeros(d, d), 0);
        for (alike, factor) in self.alike.iter().zip(&factors) {
            let mut right = alike.gradients.clone();
            right.column_iter_mut().for_each(|mut column| column += &pulled);
            let mut off = factor.solve(&right) + deviates(factor, right.ncols(), stream)?;
            off.column_iter_mut().for_each(|mut column| column -= &mean);
            squares += &off * off.transpose();
            count += off.ncols();
        }
        *precision = prior.precision(&squares, count, stream)?;
        Some(mean)
    }
}

#[cfg(test)]
mod tests {
    use rayon::prelude::*;

    use super::*;
    use structures::parameter::{DamageDirection, PriorForm};

    /// Which of two frequencies measurement n has.
    type Measures = fn(usize) -> [bool; 2];

    /// Two parameters between 0 and 1, so that the unit box is in their unit.
    fn space() -> ParameterSpace {
        let one = |name: &str| Parameter {
            name: name.to_owned(),
            unit: "N/m".to_owned(),
            lower: 0.0,
            upper: 1.0,
            damage: DamageDirection::Decrease,
            form: PriorForm::Uniform,
        };
        ParameterSpace::new(vec![one("a"), one("b")])
    }

    const MEAN: [f64; 2] = [0.47, 0.52];
    const STD: [f64; 2] = [0.02, 0.01];
    const CORRELATION: f64 = 0.5;

    fn covariance() -> DMatrix<f64> {
        let cross = CORRELATION * STD[0] * STD[1];
        DMatrix::from_row_slice(2, 2, &[STD[0].powi(2), cross, cross, STD[1].powi(2)])
    }

    /// Measurements of two linear frequencies of the parameters with `noise`, linearised about the middle of the prior; `measures` tells
    /// which of both measurement n has.
    fn batch(
        count: usize,
        noise: f64,
        measures: impl Fn(usize) -> [bool; 2],
        spread: Spread,
        seed: u64,
    ) -> LinearBatch {
        let slopes = DMatrix::from_row_slice(2, 2, &[0.6, 0.4, 0.3, -0.7]);
        let mut stream = stats::stream(seed, "test");
        let root = covariance().cholesky().unwrap().l();
        let one = |number: usize| {
            let mut normal = |_: usize, _: usize| stream.sample::<f64, _>(StandardNormal);
            let off = DVector::from_fn(2, |k, _| MEAN[k] - 0.5) + &root * DVector::from_fn(2, &mut normal);
            let measured = &slopes * off + DVector::from_fn(2, normal) * noise;
            let rows: Vec<usize> = (0..2).filter(|mode| measures(number)[*mode]).collect();
            let own = slopes.select_rows(&rows) / noise;
            let residuals = DVector::from_fn(rows.len(), |row, _| measured[rows[row]] / noise);
            let gradients = DMatrix::from_columns(&[own.tr_mul(&residuals)]);
            LinearMeasurements { information: own.tr_mul(&own), gradients }
        };
        LinearBatch {
            alike: (0..count).map(one).collect(),
            about: DVector::from_element(2, 0.5),
            prior_mean: DVector::zeros(2),
            prior_precision: DVector::from_element(2, 12.0),
            spread,
        }
    }

    /// Shares of 200 batches whose 90 % intervals of means and standard deviations hold the truth.
    fn coverage(make: impl Fn(u64) -> LinearBatch + Sync) -> [f64; 2] {
        let space = space();
        let held = |seed: u64| {
            let found = make(seed).populations(&space, seed).unwrap();
            let inside = |[low, high]: [f64; 2], truth: f64| f64::from(u8::from((low..=high).contains(&truth)));
            let of_parameter = |k: usize| {
                let own = &found.parameters[k];
                [inside(own.mean_interval(), MEAN[k]), inside(own.std_interval().unwrap(), STD[k])]
            };
            [of_parameter(0), of_parameter(1)]
        };
        let all: Vec<[f64; 2]> = (0..200).into_par_iter().flat_map_iter(held).collect();
        [0, 1].map(|what| all.iter().map(|held| held[what]).sum::<f64>() / all.len() as f64)
    }

    /// Four binomial errors of 200 batches, which is more than those of 400 intervals of correlated parameters.
    const ERROR: f64 = 4.0 * 0.0212;

    #[test]
    fn intervals_of_a_known_spread_hold_the_truth_whichever_frequencies_are_missing() {
        let usual = || Spread::Usual { covariance: covariance(), degrees: 30.0 };
        let complete = |_: usize| [true, true];
        let in_turns = |number: usize| [number.is_multiple_of(2), !number.is_multiple_of(2)];
        let mostly_one = |number: usize| [true, number.is_multiple_of(10)];
        let cases: [(usize, f64, Measures); 5] = [
            (2, 0.001, complete),
            (20, 0.05, complete),
            (20, 0.001, in_turns),
            (20, 0.001, mostly_one),
            (300, 0.01, in_turns),
        ];
        for (index, (count, noise, measures)) in cases.into_iter().enumerate() {
            let [means, stds] = coverage(|seed| batch(count, noise, measures, usual(), seed));
            assert!((means - 0.9).abs() < ERROR, "case {index}: {means} of the means");
            // The prior of the spread is the truth here: its intervals hold it more often.
            assert!(stds > 0.9 - ERROR, "case {index}: {stds} of the standard deviations");
        }
    }

    #[test]
    fn intervals_of_an_unknown_spread_hold_the_truth() {
        let in_turns = |number: usize| [!number.is_multiple_of(3), !number.is_multiple_of(2)];
        let cases: [(usize, f64, Measures); 4] = [
            (10, 0.002, |_| [true, true]),
            (40, 0.002, in_turns),
            (50, 0.02, |_| [true, true]),
            (300, 0.05, |_| [true, true]),
        ];
        for (count, noise, measures) in cases {
            let found = coverage(|seed| batch(count, noise, measures, Spread::Unknown, seed));
            assert!(found.iter().all(|share| (share - 0.9).abs() < ERROR), "{count}: {found:?}");
        }
    }

    #[test]
    fn what_no_measurement_confines_is_as_uncertain_as_the_prior() {
        let usual = Spread::Usual { covariance: covariance(), degrees: 30.0 };
        let found = batch(50, 0.001, |_| [true, false], usual, 1).populations(&space(), 1).unwrap();
        let [low, high] = found.parameters[1].mean_interval();
        // The prior has a standard deviation of 0.29, and its 90 % interval is 0.9 wide.
        assert!(high - low > 0.6, "{low} to {high}");
        // The combination that is measured is known: 0.6 a + 0.4 b.
        let draws = found.parameters[0].mean_draws.iter().zip(&found.parameters[1].mean_draws);
        let combined: Vec<f64> = draws.map(|(a, b)| 0.6 * a + 0.4 * b).collect();
        let truth = 0.6 * MEAN[0] + 0.4 * MEAN[1];
        let error = stats::sample_std(&combined).unwrap();
        assert!(error < 0.003 && (stats::mean(&combined) - truth).abs() < 4.0 * error, "{error}");
    }
}
