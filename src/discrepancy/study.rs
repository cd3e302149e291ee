//! The simulation and the measurements that a diagnosis compares.

use super::data::Data;
use crate::physics::effect::Target;
use crate::simulator::Simulator;

/// Share of the width of a prior by which a setting may lie outside it in a computation. A setting farther outside is limited to
/// this range, because neither an emulator nor a stiffness is meaningful there.
const BEYOND_PRIOR: f64 = 0.5;

/// Smallest value of a positive parameter, as a share of the lower end of its prior.
const LEAST_SHARE: f64 = 0.02;

/// A simulation without effects and the measurements that it is compared with.
pub struct Study<'a> {
    /// The simulation.
    pub simulator: &'a Simulator,
    /// The measurements.
    pub data: &'a Data,
    /// Parameters that are not set in every row.
    pub(super) free: Vec<usize>,
    /// Range to which each parameter is limited, `[d]`, in its unit: its prior, extended by half its width on both sides.
    /// `None` for a parameter that is set in no row.
    pub(super) limits: Vec<Option<[f64; 2]>>,
    /// For each row, the modes present and the sum of the logarithms of their stated noise.
    pub(super) present: Vec<(Vec<usize>, f64)>,
}

impl<'a> Study<'a> {
    /// A study of `data` under `simulator`.
    pub fn new(simulator: &'a Simulator, data: &'a Data) -> Self {
        let set = |k: &usize| data.settings.iter().all(|row| row[*k].is_some());
        let free = (0..simulator.space().len()).filter(|k| !set(k)).collect();
        let limit = |k: usize| {
            let p = &simulator.space().as_slice()[k];
            let beyond = BEYOND_PRIOR * (p.upper - p.lower);
            let low = p.lower - beyond;
            let low = if p.lower > 0.0 { low.max(LEAST_SHARE * p.lower) } else { low };
            data.settings.iter().any(|row| row[k].is_some()).then_some([low, p.upper + beyond])
        };
        let limits = (0..simulator.space().len()).map(limit).collect();
        let present = |(y, noise): (&Vec<f64>, &Vec<f64>)| {
            let present: Vec<usize> = (0..y.len()).filter(|mode| y[*mode].is_finite()).collect();
            let log_noise = present.iter().map(|mode| noise[*mode].ln()).sum();
            (present, log_noise)
        };
        let present = data.log_frequencies.iter().zip(&data.noise).map(present).collect();
        Self { simulator, data, free, limits, present }
    }

    /// Columns of the free parameters, which are not set in every row, `[free]`.
    pub fn free(&self) -> &[usize] {
        &self.free
    }

    /// False if the target acts on a setting that was not set in this row; true for every other target.
    pub fn is_set(&self, row: usize, target: &Target) -> bool {
        let columns = if let Target::ModeGain { column, .. } = target { vec![*column] } else { target.settings() };
        columns.iter().all(|k| self.data.settings[row][*k].is_some())
    }
}
