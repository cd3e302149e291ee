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

use super::correlation::Correlations;
use super::linear_chain::{draws, LinearBatch, Swept};
use super::population::{PopulationEstimate, DRAWS};
use super::populations::Populations;
use super::problem::WIDEST;
use super::small::MOST;
use structures::parameter::{Parameter, ParameterSpace};
use structures::stats;

impl LinearBatch {
    /// The population behind the batch: means and standard deviations in the units of `space`, with [`DRAWS`] draws of both, and their
    /// correlations for up to eight parameters. `None` where the matrices are not finite.
    pub fn populations(&self, space: &ParameterSpace, seed: u64) -> Option<Populations> {
        let draws = draws(self, seed)?;
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
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};
    use rand::Rng as _;
    use rand_distr::StandardNormal;
    use rayon::prelude::*;

    use super::super::linear_chain::{LinearMeasurements, Spread};
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
