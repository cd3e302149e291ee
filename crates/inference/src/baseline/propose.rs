//! Draws of the flow inside the prior, before the simulation weights or moves them.

use candle_core::{DType, Device, Tensor};
use nalgebra::DMatrix;

use super::error::InferenceError;
use super::model::Baseline;
use super::observation::Observation;
use super::real_line::from_real_line;
use super::resample::Proposals;
use structures::stats;

/// How often draws outside the prior are replaced before they are moved to its boundary.
const ROUNDS: usize = 12;

/// Rows that pass through the flow at a time. More would not fit into the cache and, with candle, take gigabytes of memory.
const ROWS_AT_A_TIME: usize = 8_192;

impl Baseline {
    /// The flow's own draws, `draws` per observation, without correction by the simulation.
    ///
    /// Draws in the margin of the training box outside the prior are drawn again. Where hardly any draw falls inside, the
    /// measurement lies outside the prior, and its draws are clamped to the box after [`ROUNDS`] rounds.
    ///
    /// # Errors
    /// [`InferenceError`] for another number of modes or a draw that is not finite.
    pub(super) fn propose(
        &self,
        observations: &[Observation],
        draws: usize,
        seed: u64,
    ) -> Result<Proposals, InferenceError> {
        if self.starts_at_fit() {
            return self.propose_from_fit(observations, draws, seed);
        }
        let d = self.space().len();
        let context = self.condition(observations)?;
        let mut stream = stats::stream(seed, "latent");
        let mut theta = DMatrix::from_element(observations.len() * draws, d, f64::NAN);
        let mut log_density = vec![0.0; observations.len() * draws];
        let mut filled = vec![0; observations.len()];
        let mut moved = vec![false; observations.len()];
        for round in 1..=ROUNDS {
            let pending: Vec<u32> =
                (0..observations.len() as u32).filter(|&row| filled[row as usize] < draws).collect();
            // After the first round few draws are missing: twice the largest number that any observation lacks is enough.
            let Some(missing) = pending.iter().map(|&row| draws - filled[row as usize]).max() else { break };
            let count = draws.min(2 * missing);
            let (mut real, mut log_q) = (Vec::new(), Vec::new());
            for part in pending.chunks((ROWS_AT_A_TIME / count).max(1)) {
                let rows = Tensor::from_slice(part, part.len(), &Device::Cpu)?;
                let (x, own) = self.draw_from_flow(&context.index_select(&rows, 0)?, count, &mut stream)?;
                real.extend(x.to_dtype(DType::F64)?.flatten_all()?.to_vec1::<f64>()?);
                log_q.extend(own.to_dtype(DType::F64)?.to_vec1::<f64>()?);
            }
            from_real_line(&mut real, &mut log_q, &self.training_space);
            for (index, values) in real.chunks_exact(d).enumerate() {
                let row = pending[index / count] as usize;
                if filled[row] == draws {
                    continue;
                }
                let mut inside = true;
                for (value, parameter) in values.iter().zip(self.space()) {
                    if !value.is_finite() {
                        return Err(InferenceError::NotFinite { row: index, parameter: parameter.name.clone() });
                    }
                    inside &= parameter.prior().contains(value);
                }
                if inside || round == ROUNDS {
                    let target = row * draws + filled[row];
                    for (column, (value, parameter)) in values.iter().zip(self.space()).enumerate() {
                        theta[(target, column)] = value.clamp(parameter.lower, parameter.upper);
                    }
                    moved[row] |= !inside;
                    log_density[target] = log_q[index];
                    filled[row] += 1;
                }
            }
        }
        Ok(Proposals { theta, log_density, moved })
    }
}
