//! Whether an assessment can be trusted: plausibility of the data, and whether the simulation can produce them at all.
//!
//! [`quality`] examines the measurements alone, [`rounding`] the steps on which their values lie, [`copies`] how they differ beside their
//! noise, [`fit`] the residuals of the simulation, [`noise`] learns from them how large the noise is, and [`cause`] names common mistakes
//! behind a batch that does not fit.

pub mod cause;
pub mod copies;
mod finding;
pub mod fit;
pub mod noise;
pub mod quality;
pub mod rounding;
mod standing;
mod verdict;

pub use finding::{Finding, FindingCode, FindingEffect};
pub use standing::{calibration_in_words, standing_findings};
pub use verdict::{Trust, TrustVerdict};
