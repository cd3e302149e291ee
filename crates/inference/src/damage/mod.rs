//! Damage from posterior samples: hyperparameters, damage thresholds, probability of damage, exceedances.
//!
//! The threshold δ comes from the undamaged population, and the probability of damage is the share of the present population beyond
//! it. With the numbers of Wang et al. (2025), a stiffness of 4.0 ± 0.3 MN/m that falls to a mean of 3.6 MN/m:
//!
//! ```
//! use inference::damage::{probability_of_damage, threshold};
//! use structures::parameter::DamageDirection;
//! use structures::quantity::Probability;
//!
//! let level = Probability::new(0.05).unwrap();
//! let delta = threshold(4.0, 0.3, DamageDirection::Decrease, level).unwrap();
//! assert!((delta - 3.5065).abs() < 1e-4);
//!
//! let samples = [3.2, 3.4, 3.6, 3.8, 4.0];
//! assert_eq!(probability_of_damage(&samples, delta, DamageDirection::Decrease), Some(0.4));
//! ```

mod comparison;
mod doubts;
mod joint;
mod joint_comparison;
mod orthant;
mod pool;
mod reference;
mod threshold;

pub use comparison::{assess, Damage, QuantityAssessment};
pub use joint::{Correlation, JointReference, JointSamples};
pub use joint_comparison::{assess_jointly, Carrier, JointAssessment, JointDamage};
pub use pool::{Hyperparameters, Informed, QuantityKind, QuantitySamples};
pub use reference::{
    ChartReference, Error, ReferenceOrigin, SeenCovariate, UndamagedQuantity, UndamagedReference, MINIMUM_MEASUREMENTS,
};
pub use threshold::{probability_of_damage, threshold};
