//! Frequencies at many parameters.

use std::ops::Range;

use nalgebra::DMatrix;

use super::{Binding, Model, Simulator};
use crate::physics::side_by_side::SideBySide;

/// A small structure, run at many parameters side by side.
#[derive(Debug)]
pub(super) struct Runs {
    structure: SideBySide,
    /// What sets each of the stiffnesses that change.
    bindings: Vec<Binding>,
}

impl Runs {
    fn new(simulator: &Simulator) -> Option<Self> {
        let Model::Matrices { structure, bindings } = simulator.model() else { return None };
        if !simulator.effects().is_empty() || bindings.is_empty() {
            return None;
        }
        let springs: Vec<usize> = bindings.iter().map(|binding| binding.spring).collect();
        let structure = SideBySide::new(structure, &springs, simulator.modes())?;
        Some(Self { structure, bindings: bindings.clone() })
    }
}

impl Simulator {
    /// [`Self::frequencies_hz`] at some rows of `theta` (`[n, d]`, parameter units): `[rows·m]`, Hz, those of one row together;
    /// NaN for a row that has none.
    pub fn frequencies_of_rows_hz(&self, theta: &DMatrix<f64>, rows: Range<usize>) -> Vec<f64> {
        if let Some(runs) = self.parts.side_by_side.get_or_init(|| Runs::new(self)) {
            let stiffness = |row: usize| {
                runs.bindings.iter().map(move |binding| binding.stiffness(theta[(row, binding.parameter)]))
            };
            let n_per_m: Vec<f64> = rows.flat_map(stiffness).collect();
            return runs.structure.frequencies_hz(&n_per_m);
        }
        let mut of_row = vec![0.0; theta.ncols()];
        let mut frequencies = Vec::with_capacity(rows.len() * self.modes());
        for row in rows {
            of_row.iter_mut().zip(theta.row(row).iter()).for_each(|(own, value)| *own = *value);
            match self.frequencies_hz(&of_row) {
                Ok(found) => frequencies.extend(found),
                Err(_) => frequencies.resize(frequencies.len() + self.modes(), f64::NAN),
            }
        }
        frequencies
    }
}
