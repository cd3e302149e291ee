//! Frequencies of a small structure at many parameters in one batch.

use std::ops::Range;

use nalgebra::DMatrix;

use super::model::{Binding, Matrices, SimulationModel};
use crate::physics::batched::{BatchedEigensolver, FrequenciesAndSlopes};

/// A small structure without effects, prepared for the batched eigensolver.
#[derive(Debug)]
pub(super) struct BatchedRuns {
    solver: BatchedEigensolver,
    /// What sets each of the stiffnesses that change.
    bindings: Vec<Binding>,
}

impl BatchedRuns {
    /// `None` for a simulation that the batched eigensolver cannot run.
    pub fn new(model: &SimulationModel, modes: usize) -> Option<Self> {
        let SimulationModel::Matrices(Matrices { structure, bindings, sizes }) = model else { return None };
        if bindings.is_empty() || !sizes.is_empty() {
            return None;
        }
        let springs: Vec<usize> = bindings.iter().map(|binding| binding.spring).collect();
        let solver = BatchedEigensolver::new(structure, &springs, modes)?;
        Some(Self { solver, bindings: bindings.clone() })
    }

    /// Frequencies, Hz, row-major `[rows, m]`, at some rows of `theta` (`[n, d]`, parameter units); NaN for a row that has none.
    pub fn frequencies_hz(&self, theta: &DMatrix<f64>, rows: Range<usize>) -> Vec<f64> {
        self.solver.frequencies_hz(&self.stiffnesses(theta, rows))
    }

    /// As [`Self::frequencies_hz`], for the modes whose measured frequency, Hz, `near_hz` gives, `[m]`.
    pub fn frequencies_near_hz(&self, theta: &DMatrix<f64>, rows: Range<usize>, near_hz: &[Option<f64>]) -> Vec<f64> {
        self.solver.frequencies_near_hz(&self.stiffnesses(theta, rows), near_hz)
    }

    /// As [`Self::frequencies_near_hz`], with the derivatives with respect to the parameters, row-major `[rows, m, d]`.
    pub fn slopes_near(
        &self,
        theta: &DMatrix<f64>,
        rows: Range<usize>,
        near_hz: &[Option<f64>],
    ) -> FrequenciesAndSlopes {
        let (d, springs) = (theta.ncols(), self.bindings.len());
        let found = self.solver.frequencies_and_slopes_near(&self.stiffnesses(theta, rows.clone()), near_hz);
        let modes = found.frequencies_hz.len() / rows.len().max(1);
        let mut slopes = vec![0.0; rows.len() * modes * d];
        for (index, (own, by_spring)) in slopes.chunks_mut(d).zip(found.slopes.chunks(springs)).enumerate() {
            let row = rows.start + index / modes;
            for (binding, by_spring) in self.bindings.iter().zip(by_spring) {
                own[binding.parameter] += by_spring * binding.slope(theta[(row, binding.parameter)]);
            }
        }
        FrequenciesAndSlopes { slopes, ..found }
    }

    /// Stiffnesses that change, in each of some rows of `theta`.
    fn stiffnesses(&self, theta: &DMatrix<f64>, rows: Range<usize>) -> Vec<f64> {
        let stiffness =
            |row: usize| self.bindings.iter().map(move |binding| binding.stiffness(theta[(row, binding.parameter)]));
        rows.flat_map(stiffness).collect()
    }
}
