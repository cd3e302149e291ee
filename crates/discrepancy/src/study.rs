//! The simulation and the measurements that a diagnosis compares.

use super::data::Data;
use super::shapes::MeasuredShapes;
use structures::physics::effect::Target;
use structures::simulator::Simulator;

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
    /// What was measured in each row.
    pub(super) present: Vec<Present>,
}

/// What was measured in one row.
///
/// Outputs are the quantities that the simulation predicts: ln f of each mode, then, if mode shapes were measured, their
/// coordinates (see [`super::shapes`]), mode by mode. One unknown factor multiplies the stated noise of all outputs of a group:
/// group j is the frequency of mode j, group m + j the shape of mode j.
pub(super) struct Present {
    /// The outputs measured, ascending; the frequencies come first.
    pub(super) outputs: Vec<usize>,
    /// The group of each of them, ascending.
    pub(super) groups: Vec<usize>,
    /// Sum of the logarithms of their stated noise.
    pub(super) log_noise: f64,
}

/// Of the indices `rows`, at most `most` at equal steps.
pub(super) fn part_of(rows: &[usize], most: usize) -> Vec<usize> {
    rows.iter().step_by(rows.len().div_ceil(most).max(1)).copied().collect()
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
        let mut study = Self { simulator, data, free, limits, present: Vec::new() };
        let present = |row: usize| {
            let outputs: Vec<usize> =
                (0..study.outputs()).filter(|output| study.observed(row, *output).is_finite()).collect();
            let groups = outputs.iter().map(|output| study.group(*output)).collect();
            let log_noise = outputs.iter().map(|output| study.noise(row, *output).ln()).sum();
            Present { outputs, groups, log_noise }
        };
        study.present = (0..data.rows()).map(present).collect();
        study
    }

    /// Number of outputs: ln f of each mode and the coordinates of mode shapes.
    pub fn outputs(&self) -> usize {
        self.simulator.modes() + self.data.shapes.as_ref().map_or(0, MeasuredShapes::count)
    }

    /// Number of groups of outputs with a common noise factor.
    pub(super) fn groups(&self) -> usize {
        self.simulator.modes() * if self.data.shapes.is_some() { 2 } else { 1 }
    }

    /// The group of an output.
    pub(super) fn group(&self, output: usize) -> usize {
        let modes = self.simulator.modes();
        match &self.data.shapes {
            Some(shapes) if output >= modes => modes + shapes.mode(output - modes),
            _ => output,
        }
    }

    /// The measured value of an output in a row: ln f, f in Hz, or the coordinate of a shape, rad; NaN if missing.
    pub(super) fn observed(&self, row: usize, output: usize) -> f64 {
        let frequencies = &self.data.log_frequencies[row];
        match &self.data.shapes {
            Some(shapes) if output >= frequencies.len() => shapes.coordinates[row][output - frequencies.len()],
            _ => frequencies[output],
        }
    }

    /// Stated standard deviation of an output in a row.
    pub(super) fn noise(&self, row: usize, output: usize) -> f64 {
        let noise = &self.data.noise[row];
        match &self.data.shapes {
            Some(shapes) if output >= noise.len() => shapes.std,
            _ => noise[output],
        }
    }

    /// Columns of the free parameters, which are not set in every row, `[free]`.
    pub fn free(&self) -> &[usize] {
        &self.free
    }

    /// Whether an effect on this target acts in a row: one on a setting does not where it was not set, and one of the instrument
    /// does not where a second instrument was used.
    pub fn is_set(&self, row: usize, target: &Target) -> bool {
        let columns = if let Target::ModeGain { column, .. } = target { vec![*column] } else { target.settings() };
        let set = columns.iter().all(|k| self.data.settings[row][*k].is_some());
        set && !(target.is_of_instrument() && self.data.second_instrument[row])
    }
}
