//! Frequencies of a small structure at many parameters in one batch.

use std::ops::Range;

use nalgebra::DMatrix;

use super::model::{Binding, Matrices, SimulationModel, SizeBinding};
use crate::physics::batched::{BatchedEigensolver, FrequenciesAndSlopes};
use crate::physics::effect::{instrument_under, structure_under, Target};
use crate::physics::Spring;

/// A small structure under effects of fixed sizes, prepared for the batched eigensolver.
#[derive(Debug)]
pub(super) struct BatchedRuns {
    solver: BatchedEigensolver,
    /// What sets each of the stiffnesses that change.
    changing: Vec<Changing>,
    instrument: Instrument,
}

/// A stiffness that changes with a parameter.
#[derive(Debug)]
enum Changing {
    /// A stiffness that a parameter sets, times the factor of the effects.
    Stiffness(Binding, f64),
    /// A stiffness that grows with the size of a deviation, and what it is at a size of 1.
    Deviation(SizeBinding, f64),
}

impl Changing {
    fn parameter(&self) -> usize {
        match self {
            Self::Stiffness(binding, _) => binding.parameter,
            Self::Deviation(binding, _) => binding.parameter,
        }
    }

    /// The stiffness at a parameter value.
    fn value(&self, p: f64) -> f64 {
        match self {
            Self::Stiffness(binding, factor) => factor * binding.stiffness(p),
            Self::Deviation(binding, at_one) => at_one * binding.size(p),
        }
    }

    /// The derivative of the stiffness at a parameter value.
    fn slope(&self, p: f64) -> f64 {
        match self {
            Self::Stiffness(binding, factor) => factor * binding.slope(p),
            Self::Deviation(binding, at_one) => at_one * binding.per_unit,
        }
    }
}

impl BatchedRuns {
    /// `None` for a simulation that the batched eigensolver cannot run: one without matrices, or whose stiffness matrix is not linear in what
    /// the parameters set, or whose parameters set masses. `effects`: what the effects of the structure file change, and their sizes.
    pub fn new(model: &SimulationModel, (effects, effect_sizes): (&[Target], &[f64]), modes: usize) -> Option<Self> {
        let SimulationModel::Matrices(Matrices { structure, bindings, sizes }) = model else { return None };
        if effects.iter().any(|target| target.acts_on_parameters() || matches!(target, Target::ModeOrder(_))) {
            return None;
        }
        let (mut structure, factors) = structure_under(structure, effects, effect_sizes).ok()?;
        if structure.is_in_series() {
            return None;
        }
        let set = |binding: &Binding| (binding.spring, Changing::Stiffness(binding.clone(), factors[binding.spring]));
        let mut changing: Vec<(usize, Changing)> = bindings.iter().map(set).collect();
        let mut instrument =
            Instrument { modes, varying: Vec::new(), targets: Vec::new(), sizes: effect_sizes.to_vec() };
        for binding in sizes {
            let Target::Deviation(deviation) = &binding.target else { return None };
            if binding.target.is_of_instrument() {
                instrument.varying.push(binding.clone());
                continue;
            }
            for spring in deviation.springs()? {
                changing.push((structure.springs().len(), Changing::Deviation(binding.clone(), spring.n_per_m)));
                structure = structure.with_springs([Spring { n_per_m: 0.0, ..spring.clone() }]);
            }
        }
        if changing.is_empty() {
            return None;
        }
        if !instrument.varying.is_empty() || effects.iter().any(Target::is_of_instrument) {
            let varying = instrument.varying.iter().map(|binding| binding.target.clone());
            instrument.targets = varying.chain(effects.iter().cloned()).collect();
        }
        let (springs, changing): (Vec<usize>, Vec<Changing>) = changing.into_iter().unzip();
        let solver = BatchedEigensolver::new(&structure, &springs, modes)?;
        Some(Self { solver, changing, instrument })
    }

    /// Frequencies, Hz, row-major `[rows, m]`, at some rows of `theta` (`[n, d]`, parameter units); NaN for a row that has none.
    pub fn frequencies_hz(&self, theta: &DMatrix<f64>, rows: Range<usize>) -> Vec<f64> {
        let mut frequencies_hz = self.solver.frequencies_hz(&self.stiffnesses(theta, rows.clone()));
        self.instrument.report(&mut frequencies_hz, theta, rows.start);
        frequencies_hz
    }

    /// As [`Self::frequencies_hz`], for the modes whose measured frequency, Hz, `near_hz` gives, `[m]`.
    pub fn frequencies_near_hz(&self, theta: &DMatrix<f64>, rows: Range<usize>, near_hz: &[Option<f64>]) -> Vec<f64> {
        let near_hz = self.instrument.structural_hz(near_hz, theta, rows.start);
        let mut frequencies_hz = self.solver.frequencies_near_hz(&self.stiffnesses(theta, rows.clone()), &near_hz);
        self.instrument.report(&mut frequencies_hz, theta, rows.start);
        frequencies_hz
    }

    /// As [`Self::frequencies_near_hz`], with the derivatives with respect to the parameters, row-major `[rows, m, d]`.
    pub fn slopes_near(
        &self,
        theta: &DMatrix<f64>,
        rows: Range<usize>,
        near_hz: &[Option<f64>],
    ) -> FrequenciesAndSlopes {
        let (d, springs) = (theta.ncols(), self.changing.len());
        let near_hz = self.instrument.structural_hz(near_hz, theta, rows.start);
        let mut found = self.solver.frequencies_and_slopes_near(&self.stiffnesses(theta, rows.clone()), &near_hz);
        let modes = found.frequencies_hz.len() / rows.len().max(1);
        let mut slopes = vec![0.0; rows.len() * modes * d];
        for (index, (own, by_spring)) in slopes.chunks_mut(d).zip(found.slopes.chunks(springs)).enumerate() {
            let row = rows.start + index / modes;
            for (changing, by_spring) in self.changing.iter().zip(by_spring) {
                let parameter = changing.parameter();
                own[parameter] += by_spring * changing.slope(theta[(row, parameter)]);
            }
        }
        self.instrument.report_slopes(&mut slopes, &found.frequencies_hz, theta, rows.start);
        self.instrument.report(&mut found.frequencies_hz, theta, rows.start);
        FrequenciesAndSlopes { slopes, ..found }
    }

    /// Stiffnesses that change, in each of some rows of `theta`.
    fn stiffnesses(&self, theta: &DMatrix<f64>, rows: Range<usize>) -> Vec<f64> {
        let stiffness =
            |row: usize| self.changing.iter().map(move |changing| changing.value(theta[(row, changing.parameter())]));
        rows.flat_map(stiffness).collect()
    }
}

/// The errors of the instrument, f → scale·f + offset.
#[derive(Debug)]
struct Instrument {
    modes: usize,
    /// Curves of calibration that parameters set.
    varying: Vec<SizeBinding>,
    /// Theirs, then the effects of the structure file; empty if the instrument has no errors.
    targets: Vec<Target>,
    /// Sizes of the effects.
    sizes: Vec<f64>,
}

impl Instrument {
    /// Scale and offset of each mode, `[m]`, at a row of `theta`.
    fn at(&self, theta: &DMatrix<f64>, row: usize) -> (Vec<f64>, Vec<f64>) {
        let varying = self.varying.iter().map(|binding| binding.size(theta[(row, binding.parameter)]));
        let sizes: Vec<f64> = varying.chain(self.sizes.iter().copied()).collect();
        instrument_under(self.modes, &self.targets, &sizes)
    }

    /// Turns frequencies of the structure, `[rows, m]`, into those that the instrument reports; their first row is row `first` of `theta`.
    fn report(&self, frequencies_hz: &mut [f64], theta: &DMatrix<f64>, first: usize) {
        if self.targets.is_empty() {
            return;
        }
        for (index, own) in frequencies_hz.chunks_mut(self.modes).enumerate() {
            let (scale, offset_hz) = self.at(theta, first + index);
            own.iter_mut().zip(scale.iter().zip(&offset_hz)).for_each(|(f, (scale, offset))| *f = *f * scale + offset);
        }
    }

    /// The same of the derivatives, `[rows, m, d]`; `structural_hz`: frequencies of the structure, Hz, `[rows, m]`.
    fn report_slopes(&self, slopes: &mut [f64], structural_hz: &[f64], theta: &DMatrix<f64>, first: usize) {
        if self.targets.is_empty() {
            return;
        }
        let of_rows = slopes.chunks_mut(self.modes * theta.ncols()).zip(structural_hz.chunks(self.modes));
        for (index, (slopes, structural_hz)) in of_rows.enumerate() {
            let (scale, _) = self.at(theta, first + index);
            for (mode, own) in slopes.chunks_mut(theta.ncols()).enumerate() {
                for slope in own.iter_mut() {
                    *slope *= scale[mode];
                }
                for binding in &self.varying {
                    let by_log = binding.target.by_log_frequency(mode);
                    own[binding.parameter] += binding.per_unit * by_log * scale[mode] * structural_hz[mode];
                }
            }
        }
    }

    /// About which frequencies of the structure give these measured ones, Hz, at a row of `theta`.
    fn structural_hz(&self, measured_hz: &[Option<f64>], theta: &DMatrix<f64>, row: usize) -> Vec<Option<f64>> {
        if self.targets.is_empty() || row >= theta.nrows() {
            return measured_hz.to_vec();
        }
        let (scale, offset_hz) = self.at(theta, row);
        let structural = |(mode, hz): (usize, &Option<f64>)| hz.map(|hz| (hz - offset_hz[mode]) / scale[mode]);
        measured_hz.iter().enumerate().map(structural).collect()
    }
}
