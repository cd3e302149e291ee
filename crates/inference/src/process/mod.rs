//! The undamaged reference as a process in time: how the parameters of a healthy structure move with the weather.
//!
//! Batches of a real structure follow one another: their means are correlated in time, and the parameters rise and fall together
//! with temperature and humidity, whether these are measured or not. A limit for independent batches is therefore wrong in both
//! directions: it alarms in every warm week, and overlooks a loss that is small compared with the seasons. The process describes
//! what is usual:
//!
//! ```text
//!  x_t = μ + B c_t + Λ h_t + u_t,      x̂_t = x_t + v_t,    v_t ~ N(0, κ V_t)
//!  h_j,t = φ_j^Δ h_j,t−1 + w_t,        stationary with variance 1
//!  u_k,t = ρ_k^Δ u_k,t−1 + w_t,        stationary with variance s_k²
//! ```
//!
//! x: parameters, `[d]`, standardised by the mean and scatter of the reference; c: measured covariates, `[m]`; h: common factors
//! without a measured cause, `[q]`; u: what each parameter does by itself; x̂_t and V_t: estimate of a batch and its covariance;
//! κ: factor of the stated noise; Δ: time since the batch before, in steps of the reference.
//!
//! - [`estimate`]: the estimate of a batch; [`model`]: the process; [`filter`]: its Kalman filter; `smoother` and `likelihood`: its
//!   likelihood with derivatives; [`fit`]: the most probable process and the number of its factors; `draws`: what the reference leaves possible;
//! - [`coverage`]: the conditions that the reference has seen, beyond which the predictions are wider;
//! - [`score`](mod@score): how well a change explains what followed; [`change`]: lasting changes that the process does not explain, and their onset; [`parts`]: which quantities changed, and by how much;
//!   [`one_factor`]: all frequencies off by one factor; [`misfit`]: what no parameter explains; [`direction`]: where changes are looked for;
//!   `stated` and [`lasting`]: the change that is stated; [`followed`]: a change as long as it lasts; `contained`: a change inside the reference;
//! - [`limits`]: what healthy operation reaches; [`detectable`]: the smallest losses that the charts find;
//! - [`mod@reference`]: the process of an undamaged reference with its limits, and the batches that are compared with it.
//!
//! Sources: A. C. Harvey (1989), Forecasting, Structural Time Series Models and the Kalman Filter, Cambridge, ch. 3 and 8, for the
//! model; R. H. Shumway, D. S. Stoffer (1982), An approach to time series smoothing and forecasting using the EM algorithm, J. Time
//! Series Analysis 3, 253–264, for its smoother; A. S. Willsky, H. L. Jones (1976), A generalized likelihood ratio approach to the
//! detection and estimation of jumps in linear systems, IEEE Trans. Automatic Control 21, 108–112, for the changes.

pub mod change;
mod check;
mod contained;
pub mod coverage;
pub mod detectable;
pub mod direction;
mod draws;
pub mod estimate;
pub mod filter;
pub mod fit;
pub mod followed;
pub mod lasting;
mod likelihood;
pub mod limits;
pub mod misfit;
pub mod model;
pub mod one_factor;
pub mod parts;
pub mod reference;
pub mod score;
mod smoother;
mod stated;
#[cfg(test)]
mod tests;
