//! From the measured frequencies of a batch to stiffnesses, the probability of damage, and alarms.
//!
//! [`baseline`] trains a [`flow`] on simulations and draws [`posterior`] samples with it; [`hierarchy`] estimates the population behind them,
//! [`damage`] compares it with the undamaged reference and [`process`] with the way in which the healthy structure moves in time.
//! [`trust`] says whether the answer can be relied on, [`alarm`] keeps the control charts, and [`assessment`] does all of this for one batch.

pub mod alarm;
pub mod assessment;
pub mod baseline;
pub mod damage;
pub mod flow;
pub mod hierarchy;
pub mod posterior;
pub mod process;
pub mod trust;
