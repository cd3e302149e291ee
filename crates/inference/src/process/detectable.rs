//! The smallest lasting losses that the charts of a process find.

use serde::{Deserialize, Serialize};

use super::change::{AGES, FAST_AGE};
use super::direction::ChangeDirection;
use super::estimate::percent;
use super::limits::{Limits, Steady};
use super::model::Process;

/// 90 % quantile of the normal distribution.
const NORMAL_90: f64 = 1.2816;

/// The smallest lasting loss of a quantity that its chart finds with a probability of 90 %.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Detectable {
    /// Name of the quantity.
    pub name: String,
    /// Its unit.
    pub unit: String,
    /// Number of batches since the loss.
    pub batches: usize,
    /// Size of the loss, in the unit.
    pub loss: f64,
    /// The same in per cent of the mean of the quantity in the reference.
    pub loss_percent: f64,
}

/// The losses that the charts of single quantities find with 90 % within 1 to 60 batches, for each quantity.
///
/// ```text
///  loss = (limit + 1.28) · standard error of a loss that has lasted for so many batches
/// ```
///
/// The chart of all quantities together, and ages between, find a little more.
pub(super) fn detectable(process: &Process, directions: &[ChangeDirection], limits: &Limits) -> Vec<Detectable> {
    let Some(steady) = Steady::new(process) else { return Vec::new() };
    let numbers = process.numbers();
    let errors = steady.standard_errors();
    let one = |k: usize, (age, errors): (&usize, &Vec<f64>)| {
        let limit = if *age <= FAST_AGE { limits.quantity.fast } else { limits.quantity.slow };
        let scale = process.scales[k];
        let loss = (limit + NORMAL_90) * errors[k] * scale.unit;
        let unit = process.units[k].clone();
        let mean = scale.origin + scale.unit * numbers.mean[k];
        Detectable {
            name: process.quantities[k].clone(),
            batches: *age,
            loss,
            loss_percent: percent(&unit, mean, -loss).abs(),
            unit,
        }
    };
    // A loss that a longer time does not make easier to find is found as well as before.
    let of_quantity = |k: usize| {
        let mut all: Vec<Detectable> = AGES.iter().zip(&errors).map(|entry| one(k, entry)).collect();
        for later in 1..all.len() {
            if all[later].loss > all[later - 1].loss {
                (all[later].loss, all[later].loss_percent) = (all[later - 1].loss, all[later - 1].loss_percent);
            }
        }
        all
    };
    let is_parameter = |k: &usize| directions[*k] != ChangeDirection::Either;
    (0..process.quantities.len()).filter(is_parameter).flat_map(of_quantity).collect()
}
