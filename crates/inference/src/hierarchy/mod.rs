//! The population behind a batch: mean and spread of the parameters over its measurements, without the noise of the single
//! measurements.
//!
//! The posterior samples of each measurement j follow q(x | y_j) ∝ p(y_j | x) p(x) under the prior p(x). They suffice to
//! compute the likelihood of a normal population (μ, Σ):
//!
//! ```text
//!  L(μ, Σ) = Π_j ∫ p(y_j | x) N(x; μ, Σ) dx ∝ Π_j 1/S Σ_s N(x_js; μ, Σ)/p(x_js)
//! ```
//!
//! A uniform prior is a constant factor. Any other one is divided by once for each measurement, so that it does not count as often as
//! there are measurements, and then counts once, as the prior of the mean μ.
//!
//! The parameters of a healthy structure move together, with temperature for example, so that Σ is a full matrix where the batch
//! determines one.
//!
//! The pool of all samples contains the noise twice, in the positions and in the widths of the posteriors. The population
//! contains only the variation between measurements.
//!
//! Source: D. W. Hogg, A. D. Myers, J. Bovy (2010), Inferring the eccentricity distribution, The Astrophysical Journal 725,
//! 2166–2175.
//!
//! # Example
//!
//! Thirty measurements of a stiffness that varies by 0.2 N/m, each with a posterior of standard deviation 0.1 N/m:
//!
//! ```
//! use inference::hierarchy::populations;
//! use structures::parameter::{DamageDirection, Parameter, ParameterSpace, PriorForm};
//! use inference::posterior::PosteriorSamples;
//! use structures::stats;
//! use nalgebra::DMatrix;
//! use rand::Rng as _;
//! use rand_distr::StandardNormal;
//!
//! let (name, unit) = ("k1".to_owned(), "N/m".to_owned());
//! let (damage, form) = (DamageDirection::Decrease, PriorForm::Uniform);
//! let stiffness = Parameter { name, unit, lower: 3.0, upper: 7.0, damage, form };
//! let space = ParameterSpace::new(vec![stiffness]);
//!
//! let (measurements, draws) = (30, 64);
//! let mut stream = stats::stream(1, "example");
//! let mut normal = |std: f64| std * stream.sample::<f64, _>(StandardNormal);
//! let centres: Vec<f64> = (0..measurements).map(|_| 5.0 + normal(0.2) + normal(0.1)).collect();
//! let theta = DMatrix::from_fn(measurements * draws, 1, |row, _| centres[row / draws] + normal(0.1));
//!
//! let found = populations(&PosteriorSamples::new(theta, draws), None, &space, 1);
//! let k1 = &found.parameters[0];
//! // The standard errors are 0.04 N/m for the mean and 0.03 N/m for the standard deviation.
//! assert!((k1.mean - 5.0).abs() < 0.2);
//! assert!((k1.std.unwrap() - 0.2).abs() < 0.15);
//! ```

mod block;
mod coordinates;
mod correlation;
mod estimate;
mod gibbs;
mod importance;
mod joint;
mod joint_chain;
mod kernel;
mod linear;
mod linear_chain;
mod normal;
mod population;
mod populations;
mod problem;
mod proposal;
mod serial;
mod small;
#[cfg(test)]
mod tests;
mod widths;

pub use correlation::Correlations;
pub use estimate::{estimate, populations, populations_of_each, populations_with, UsualSpread};
pub use linear_chain::{LinearBatch, LinearMeasurements, Spread};
pub use population::{interval, PopulationEstimate, DRAWS, INTERVAL};
pub use populations::Populations;
pub use proposal::proposals;
pub use serial::{Effective, Serial};
