//! The last resort: a discrepancy that is learned from data, where no cause explains the deviation of the simulation.
//!
//! ```text
//!  ln f_j = ln M(θ_j, c_j) + g(u_j) + ε_j,    g_i ~ GP(0, σ_i² k(u, u'; ℓ_i)) for each mode i,    Σ_j J_jᵀ V_j⁻¹ g(u_j) = 0
//! ```
//!
//! u: settings and covariates, standardised, never time; k: Matérn 5/2 with one length for each input; J = ∂ ln M/∂θ and V as in
//! `model.rs`. The last condition makes the discrepancy orthogonal to the simulation over the observed inputs: without it, a
//! parameter and a constant discrepancy could not be told apart, and the estimate of a stiffness would depend on how the process
//! happens to divide the two. With the weights V⁻¹, the means of the parameters stay those of the best fit of the simulation alone.
//!
//! - [`input`]: the inputs, and those that are refused; [`rows`]: residuals and their precision;
//! - [`hyperparameter`]: σ and ℓ by marginal likelihood, given the population of the fit; [`posterior`]: g given the data;
//! - [`learn`]: the steps in order; [`change`]: the test for a change in time; [`gain`]: errors on rows not seen;
//! - [`constant`]: that of a simulation that is off everywhere;
//! - [`offer`]: what a diagnosis says about it; [`extension`]: the structure with the discrepancy.
//!
//! What is learned is not understood, so it is kept from hiding damage: it is learned from the rows of the search only; inputs that
//! are functions of time are refused; and a change of a stiffness in time among these rows refuses the extension.
//!
//! # Why the process is computed here
//!
//! The crates for Gaussian processes were compared with what is needed: a variance for each row that is a matrix over the modes
//! (noise and spread of the parameters), a mean that is the simulation, the orthogonality, support points with the exact prior
//! variance, and coefficients that can be stored in a structure file with their covariance. egobox-gp 0.36 has one noise variance
//! for all rows and a constant, linear or quadratic mean, and brings linfa and ndarray, a second library of matrices, with an
//! optimiser of its own. friedrich 0.6 has one noise for all rows, one length for all inputs, no support points, and brings
//! chrono. Neither conditions on a linear constraint. Cholesky factors come from nalgebra; the rest is the code in this folder.
//!
//! Source: Kennedy and O'Hagan (2001), JRSS B 63, 425, and Brynjarsdóttir and O'Hagan (2014), Inverse Problems 30, 114007, for the
//! discrepancy; Plumlee (2017), JASA 112, 1274, for the orthogonality.

pub mod change;
pub mod constant;
pub mod extension;
pub mod gain;
pub mod hyperparameter;
pub mod input;
pub mod learn;
pub mod offer;
pub mod posterior;
pub mod rows;
