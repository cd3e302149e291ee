//! The misfit of the simulation: what a batch shows of its modes that no state of the structure gives.
//!
//! With more modes than the parameters determine, the frequencies have coordinates beside the parameters:
//!
//! ```text
//!  ln f_i = ln f_i(θ) + Σ_j B_ij v_j
//! ```
//!
//! v: misfit, `[r]`, in standard deviations of the noise of one measurement; B: its effect on the frequencies, `[modes, r]`, orthogonal to
//! that of all parameters. A real structure differs from its simulation, and by how much moves with the weather: v enters the process as
//! further quantities. A lasting change of it, in either direction, is a change of the structure or of the instrument that the parameters
//! do not describe, such as damage of a part that the structure file does not have.

use serde::{Deserialize, Serialize};

use super::lasting::{ModeChange, QuantityChange, NORMAL_95};
use structures::parameter::MISFIT;

/// The coordinates of the misfit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MisfitBasis {
    /// Number of modes.
    pub modes: usize,
    /// B, `[modes, r]`, by columns.
    pub effects: Vec<f64>,
}

impl MisfitBasis {
    /// Effects on the modes of each coordinate, `[r]` of `[modes]`.
    pub fn columns(&self) -> impl Iterator<Item = &[f64]> {
        self.effects.chunks_exact(self.modes.max(1))
    }

    /// Number of coordinates, r.
    pub fn count(&self) -> usize {
        self.columns().count()
    }

    /// The change of coordinate j that changes a frequency by half of itself.
    pub(super) fn size(&self, j: usize) -> f64 {
        let effects = self.columns().nth(j).unwrap_or_default();
        let largest = effects.iter().fold(0.0, |largest: f64, effect| largest.max(effect.abs()));
        if largest > 0.0 {
            0.5 / largest
        } else {
            1.0
        }
    }

    /// Names of the coordinates.
    pub fn names(&self) -> impl Iterator<Item = String> + '_ {
        (1..=self.count()).map(|j| format!("{MISFIT}:{j}"))
    }

    /// What the changes of its coordinates, `[r]` with mean and standard deviation, do to the frequencies.
    pub(super) fn change(&self, probability: f64, coordinates: &[(f64, f64)]) -> QuantityChange {
        let of_mode = |mode: usize| {
            let parts = || self.columns().map(|effects| effects[mode]).zip(coordinates);
            let mean: f64 = parts().map(|(effect, (mean, _))| effect * mean).sum();
            let std = parts().map(|(effect, (_, std))| (effect * std).powi(2)).sum::<f64>().sqrt();
            let percent = |ln: f64| 100.0 * ln.exp_m1();
            let interval_percent = [mean - NORMAL_95 * std, mean + NORMAL_95 * std].map(percent);
            ModeChange { mode: mode + 1, percent: percent(mean), interval_percent }
        };
        let modes: Vec<ModeChange> = (0..self.modes).map(of_mode).collect();
        let largest = modes.iter().max_by(|a, b| a.percent.abs().total_cmp(&b.percent.abs()));
        let ln = |percent: f64| (percent / 100.0).ln_1p();
        QuantityChange {
            name: MISFIT.to_owned(),
            unit: super::estimate::LOGARITHM.to_owned(),
            probability,
            towards_damage: false,
            change: largest.map_or(0.0, |own| ln(own.percent)),
            interval: largest.map_or([0.0; 2], |own| own.interval_percent.map(ln)),
            reference_mean: 0.0,
            explained: 0.0,
            modes,
        }
    }
}
