//! Frequencies of a small structure at many parameters in one batch.

use std::ops::Range;

use nalgebra::DMatrix;

use super::model::{Binding, SimulationModel};
use crate::physics::batched::BatchedEigensolver;

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
        let SimulationModel::Matrices { structure, bindings } = model else { return None };
        if bindings.is_empty() {
            return None;
        }
        let springs: Vec<usize> = bindings.iter().map(|binding| binding.spring).collect();
        let solver = BatchedEigensolver::new(structure, &springs, modes)?;
        Some(Self { solver, bindings: bindings.clone() })
    }

    /// Frequencies, Hz, row-major `[rows, m]`, at some rows of `theta` (`[n, d]`, parameter units); NaN for a row that has none.
    pub fn frequencies_hz(&self, theta: &DMatrix<f64>, rows: Range<usize>) -> Vec<f64> {
        let stiffness =
            |row: usize| self.bindings.iter().map(move |binding| binding.stiffness(theta[(row, binding.parameter)]));
        let n_per_m: Vec<f64> = rows.flat_map(stiffness).collect();
        self.solver.frequencies_hz(&n_per_m)
    }
}
