//! Responses of rows whose settings are corrected, or in which the response of a mode to a setting has a gain.

use nalgebra::DMatrix;

use super::response::Responses;
use structures::physics::effect::Target;
use structures::physics::tracked::ReferenceMode;
use structures::simulator::settings::{groups_of_modes, CorrectedParameters};
use structures::simulator::Simulator;

/// Responses of rows with parameters `theta`, `[d, rows]`, under targets of sizes `sizes`, `[sizes, rows]`; with `reference` modes,
/// the coordinates of the shapes as well.
///
/// Settings are corrected first and then limited to `limits`, `[d]`; the response of the other targets is computed at the result,
/// so that neither the number of corrections nor their sizes add dimensions to its interpolation. The derivatives follow from the
/// chain rule, x being the corrected parameters:
///
/// ```text
///  ∂ln f/∂θ = ∂ln f/∂x · ∂x/∂θ,    ∂ln f/∂g = ∂ln f/∂x · ∂x/∂g
/// ```
///
/// `None` if the frequencies cannot be computed in some row.
pub(super) fn corrected_responses(
    simulator: &Simulator,
    reference: Option<&[ReferenceMode]>,
    targets: &[Target],
    (theta, sizes): (&DMatrix<f64>, &DMatrix<f64>),
    limits: &[Option<[f64; 2]>],
) -> Option<Responses> {
    let rows = Rows::new(simulator, reference, targets, (theta, sizes), limits);
    if rows.corrections.is_empty() {
        let limited = |k: usize, row: usize| limits[k].map_or(theta[(k, row)], |[a, b]| theta[(k, row)].clamp(a, b));
        let theta = DMatrix::from_fn(theta.nrows(), theta.ncols(), limited);
        return Responses::new(simulator, reference, targets, &theta, sizes);
    }
    rows.responses()
}

/// The rows, with the targets divided into corrections of settings and all others.
struct Rows<'a> {
    simulator: &'a Simulator,
    reference: Option<&'a [ReferenceMode]>,
    theta: &'a DMatrix<f64>,
    sizes: &'a DMatrix<f64>,
    limits: &'a [Option<[f64; 2]>],
    /// Targets that correct settings or have a gain, and the index of each of their sizes.
    corrections: Vec<Target>,
    correction_sizes: Vec<usize>,
    /// All other targets, and the index of each of their sizes.
    others: Vec<Target>,
    other_sizes: Vec<usize>,
}

impl<'a> Rows<'a> {
    fn new(
        simulator: &'a Simulator,
        reference: Option<&'a [ReferenceMode]>,
        targets: &[Target],
        (theta, sizes): (&'a DMatrix<f64>, &'a DMatrix<f64>),
        limits: &'a [Option<[f64; 2]>],
    ) -> Self {
        let (mut corrections, mut correction_sizes) = (Vec::new(), Vec::new());
        let (mut others, mut other_sizes) = (Vec::new(), Vec::new());
        let mut first = 0;
        for target in targets {
            let own = first..first + target.sizes();
            first = own.end;
            if matches!(target, Target::ModeGain { .. }) || !target.settings().is_empty() {
                corrections.push(target.clone());
                correction_sizes.extend(own);
            } else {
                others.push(target.clone());
                other_sizes.extend(own);
            }
        }
        Self { simulator, reference, theta, sizes, limits, corrections, correction_sizes, others, other_sizes }
    }

    /// The parameters of a row after the corrections, as they hold for a mode.
    fn corrected(&self, row: usize, mode: usize) -> CorrectedParameters {
        let sizes: Vec<f64> = self.correction_sizes.iter().map(|size| self.sizes[(*size, row)]).collect();
        let theta: Vec<f64> = self.theta.column(row).iter().copied().collect();
        let mut corrected = CorrectedParameters::new(&theta, &self.corrections, &sizes, mode);
        for (k, limits) in self.limits.iter().enumerate() {
            if let Some(limits) = limits {
                corrected.clamp(k, *limits);
            }
        }
        corrected
    }

    /// The response of the other targets at the corrected parameters of all rows.
    fn at(&self, corrected: &[CorrectedParameters]) -> Option<Responses> {
        let theta = DMatrix::from_fn(self.theta.nrows(), corrected.len(), |k, row| corrected[row].theta[k]);
        Responses::new(self.simulator, self.reference, &self.others, &theta, &self.sizes.select_rows(&self.other_sizes))
    }

    fn responses(&self) -> Option<Responses> {
        let (modes, d) = (self.simulator.modes(), self.theta.nrows());
        let (count, rows) = self.sizes.shape();
        let width = 1 + d + count;
        let (mut outputs, mut values) = (modes, Vec::new());
        for mut group in groups_of_modes(&self.corrections, modes) {
            let Some(first) = group.first() else { continue };
            let corrected: Vec<CorrectedParameters> = (0..rows).map(|row| self.corrected(row, *first)).collect();
            let responses = self.at(&corrected)?;
            if values.is_empty() {
                outputs = responses.outputs();
                values.resize(rows * outputs * width, 0.0);
                // Corrections of single modes concern their frequencies only.
                group.extend(modes..outputs);
            }
            for (row, corrected) in corrected.iter().enumerate() {
                for output in &group {
                    let start = (row * outputs + output) * width;
                    self.write(&mut values[start..start + width], corrected, &responses, (row, *output));
                }
            }
        }
        self.apply_gains(&mut values, outputs, width)?;
        Some(Responses::from_values((modes, outputs), d, count, values))
    }

    /// Writes one output of a row and its derivatives, `[1 + d + sizes]`.
    fn write(
        &self,
        line: &mut [f64],
        corrected: &CorrectedParameters,
        responses: &Responses,
        (row, output): (usize, usize),
    ) {
        let d = self.theta.nrows();
        let by_corrected = responses.by_parameter(row, output);
        line[0] = responses.value(row, output);
        let along = |column: &[f64]| by_corrected.iter().zip(column).map(|(a, b)| a * b).sum::<f64>();
        for (k, column) in corrected.by_theta.column_iter().enumerate() {
            line[1 + k] = along(column.as_slice());
        }
        for (size, column) in self.correction_sizes.iter().zip(corrected.by_size.column_iter()) {
            line[1 + d + size] = along(column.as_slice());
        }
        for (size, slope) in self.other_sizes.iter().zip(responses.by_size(row, output)) {
            line[1 + d + size] = *slope;
        }
    }

    /// Applies the gains: ln f' = (1 + g) ln f − g ln f_r + h, with f_r the response at the reference of the parameter.
    fn apply_gains(&self, values: &mut [f64], outputs: usize, width: usize) -> Option<()> {
        let (d, rows) = (self.theta.nrows(), self.theta.ncols());
        let mut place = 0;
        for target in &self.corrections {
            let sizes = &self.correction_sizes[place..place + target.sizes()];
            place += target.sizes();
            let Target::ModeGain { mode, column, reference } = target else { continue };
            let at_reference = |row: usize| {
                let mut corrected = self.corrected(row, *mode);
                corrected.clamp(*column, [*reference; 2]);
                corrected
            };
            let corrected: Vec<CorrectedParameters> = (0..rows).map(at_reference).collect();
            let responses = self.at(&corrected)?;
            let mut other = vec![0.0; width];
            for (row, corrected) in corrected.iter().enumerate() {
                other.fill(0.0);
                self.write(&mut other, corrected, &responses, (row, *mode));
                let (gain, level) = (self.sizes[(sizes[0], row)], self.sizes[(sizes[1], row)]);
                let start = (row * outputs + mode) * width;
                let line = &mut values[start..start + width];
                let beyond = line[0] - other[0];
                for (own, reference) in line.iter_mut().zip(&other) {
                    *own = (1.0 + gain) * *own - gain * reference;
                }
                line[0] += level;
                line[1 + d + sizes[0]] += beyond;
                line[1 + d + sizes[1]] += 1.0;
            }
        }
        Some(())
    }
}
