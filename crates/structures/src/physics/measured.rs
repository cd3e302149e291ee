//! Effects on a simulation that has no matrices, such as an emulator.

use nalgebra::DMatrix;

use super::direction::LEAST_FACTOR;
use super::effect::{columns, instrument, Target};
use super::structure::Error;

/// Frequencies of a simulation without matrices under effects, and their derivatives.
#[derive(Debug, Clone)]
pub struct Measured {
    /// Frequencies as the instrument reports them, Hz, `[m]`.
    pub frequencies_hz: Vec<f64>,
    /// Derivatives with respect to the parameters, Hz per parameter unit, `[m, d]`.
    pub by_parameter: DMatrix<f64>,
    /// Derivatives with respect to the size of each effect, Hz per unit of the size, `[m, sizes]`.
    pub by_size: DMatrix<f64>,
}

/// Applies effects of the instrument and orders of modes to a simulation that has no matrices, such as an emulator.
///
/// `frequencies_hz` holds all modes of the simulation, Hz, `[modes]`, and `by_parameter` their derivatives with respect to the
/// parameters, `[modes, d]`. The result has `count` modes. Derivatives with respect to the sizes of effects on parameters are
/// left at 0.
///
/// # Errors
/// [`Error::TooFewModes`]; [`Error::Effect`] for an effect on springs or masses, which such a simulation does not have, and for
/// a size that leaves less than 2 % of a frequency or parameter.
pub fn measured(
    frequencies_hz: &[f64],
    by_parameter: &DMatrix<f64>,
    count: usize,
    targets: &[Target],
    sizes: &[f64],
) -> Result<Measured, Error> {
    let columns = columns(targets);
    let mut order: Vec<usize> = (0..count).collect();
    for (number, (first, target)) in columns.iter().enumerate() {
        let size = sizes.get(*first).copied().unwrap_or(0.0);
        match target {
            Target::ModeOrder(modes) => order.clone_from(modes),
            Target::FrequencyScale(_) | Target::ParameterScale(_) | Target::SettingScale(_) => {
                // This form of the condition also rejects NaN.
                let enough = 1.0 + size >= LEAST_FACTOR;
                if !enough {
                    return Err(Error::Effect { number, size });
                }
            }
            Target::Springs(_)
            | Target::Masses(_)
            | Target::AddedSpring(..)
            | Target::AddedMass(_)
            | Target::Oscillator(_) => {
                return Err(Error::Effect { number, size });
            }
            Target::Deviation(_) if !target.is_of_instrument() => return Err(Error::Effect { number, size }),
            _ => {}
        }
    }
    let needed = order.iter().max().map_or(count, |highest| highest + 1);
    if needed > frequencies_hz.len() {
        return Err(Error::TooFewModes { asked: needed, available: frequencies_hz.len() });
    }
    let rows = order.len();
    let (scale, offset_hz) = instrument(&columns, sizes, rows);
    let structural: Vec<f64> = order.iter().map(|mode| frequencies_hz[*mode]).collect();
    let by_parameter =
        DMatrix::from_fn(rows, by_parameter.ncols(), |row, k| scale[row] * by_parameter[(order[row], k)]);
    let mut by_size = DMatrix::zeros(rows, sizes.len());
    for (first, target) in &columns {
        for row in 0..rows {
            let scaled_hz = structural[row] * scale[row];
            match target {
                Target::FrequencyScale(mode) if mode.is_none_or(|mode| mode == row) => {
                    by_size[(row, *first)] = scaled_hz / (1.0 + sizes[*first]);
                }
                Target::FrequencyOffset(mode) if mode.is_none_or(|mode| mode == row) => by_size[(row, *first)] = 1.0,
                _ => {
                    for (which, direction) in target.directions().iter().enumerate() {
                        by_size[(row, first + which)] = scaled_hz * direction.frequencies.get(row).unwrap_or(&0.0);
                    }
                }
            }
        }
    }
    let frequencies_hz = (0..rows).map(|row| structural[row] * scale[row] + offset_hz[row]).collect();
    Ok(Measured { frequencies_hz, by_parameter, by_size })
}
