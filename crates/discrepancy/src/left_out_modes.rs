//! Modes left out in turn: how well constant causes predict a mode that they were not fitted to.
//!
//! Rows of the same state confirm any constant correction, because it was fitted to their mean, right or wrong. A mode that took no part in
//! the fit can contradict it:
//!
//! ```text
//!  e_i = mean over the rows of ln f_i − ln M_i(θ, ψ),    θ, ψ: fitted to all other modes
//!  std(e_i)² = jᵀ C j + s²/n,    j = ∂ ln M_i/∂(θ, ψ),  C: covariance of θ and ψ in that fit,  s: standard deviation of ln f_i − ln M_i over n rows
//! ```

use nalgebra::DVector;
use serde::{Deserialize, Serialize};

use super::fit::{Fit, Start};
use super::gain::Change;
use super::study::{part_of, Study};
use structures::simulator::law::LawKind;
use structures::stats;

/// Greatest number of rows that are used. The error of a mean over so many is small beside that of a simulation.
const MOST_ROWS: usize = 60;

/// A cause is contradicted if the root mean square of the errors with it is above this share of that without it, and an error exceeds so many
/// of its standard errors.
const CONTRADICTED: f64 = 0.5;
const CLEAR: f64 = 3.0;

/// A mode that was left out of the fits.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct LeftOutMode {
    /// Its number, from 1.
    pub mode: usize,
    /// Mean deviation of its measured from its predicted frequency, per cent, without and with the causes.
    pub error_percent: Change<f64>,
    /// Standard error of that deviation, per cent, without and with the causes.
    pub standard_error_percent: Change<f64>,
}

/// Predictions of modes that were left out in turn, with constant causes and without.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct LeftOutModes {
    /// The modes.
    pub modes: Vec<LeftOutMode>,
    /// Root mean square of their errors, per cent.
    pub rms_error_percent: Change<f64>,
    /// Whether the error with the causes is more than half of that without them, and more than its standard errors allow. Otherwise the causes may be right, but with few more modes
    /// than unknown means, others may predict the modes as well.
    pub contradicted: bool,
}

impl LeftOutModes {
    /// The finding as a sentence; `with` names the causes, such as "With it".
    pub(super) fn sentence(&self, with: &str) -> String {
        let Change { before, after } = self.rms_error_percent;
        let verdict = if self.contradicted { "contradicts" } else { "does not contradict" };
        format!(
            "{with}, modes that are left out of the fit in turn are predicted by the other modes to {after:.2} % (root mean square over {} \
             modes), and without to {before:.2} %, which {verdict} the finding.",
            self.modes.len()
        )
    }
}

/// Leaves each measured mode out in turn. `before` and `after`: fits without and with causes; the first `known` effects of both belong to
/// the structure. `None` if a cause is not constant, corrects settings, or is a deviation everywhere, if too few modes were measured to fit
/// the others without one, or if a fit fails.
pub(super) fn left_out_modes(
    study: &Study<'_>,
    rows: &[usize],
    (before, after): (&Fit, &Fit),
    known: usize,
) -> Option<LeftOutModes> {
    let causes = after.effects.get(known..).filter(|causes| !causes.is_empty())?;
    let constant = causes.iter().all(|cause| {
        cause.law.kind == LawKind::Constant && cause.mixture.is_none() && cause.target.settings().is_empty()
    });
    let measured = |mode: &usize| rows.iter().any(|row| study.data.log_frequencies[*row][*mode].is_finite());
    let modes: Vec<usize> = (0..study.simulator.modes()).filter(measured).collect();
    let unknown = study.free().len() + causes.iter().map(|cause| cause.numbers.len()).sum::<usize>();
    if !constant || modes.len() <= unknown {
        return None;
    }
    let rows = part_of(rows, MOST_ROWS);
    let of_mode = |mode: &usize| {
        let ((error, std), (error_with, std_with)) =
            (predicted(study, &rows, before, *mode)?, predicted(study, &rows, after, *mode)?);
        Some(LeftOutMode {
            mode: mode + 1,
            error_percent: Change { before: error, after: error_with },
            standard_error_percent: Change { before: std, after: std_with },
        })
    };
    let modes: Vec<LeftOutMode> = modes.iter().map(of_mode).collect::<Option<_>>()?;
    let rms = |error: &dyn Fn(&LeftOutMode) -> f64| {
        (modes.iter().map(|m| error(m).powi(2)).sum::<f64>() / modes.len() as f64).sqrt()
    };
    let rms_error_percent = Change { before: rms(&|m| m.error_percent.before), after: rms(&|m| m.error_percent.after) };
    let clear = modes.iter().any(|m| m.error_percent.after.abs() > CLEAR * m.standard_error_percent.after);
    let contradicted = clear && rms_error_percent.after > CONTRADICTED * rms_error_percent.before;
    Some(LeftOutModes { modes, rms_error_percent, contradicted })
}

/// Mean deviation of a mode from its prediction by a fit to the other modes with the effects of `fit`, and its standard error, per cent.
fn predicted(study: &Study<'_>, rows: &[usize], fit: &Fit, mode: usize) -> Option<(f64, f64)> {
    let mut data = study.data.clone();
    for row in &mut data.log_frequencies {
        row[mode] = f64::NAN;
    }
    if let Some(shapes) = &mut data.shapes {
        let own = mode * shapes.each..(mode + 1) * shapes.each;
        shapes.coordinates.iter_mut().for_each(|row| row[own.clone()].fill(f64::NAN));
    }
    let others = Study::new(study.simulator, &data);
    let fit = others.fit(rows, &fit.effects, Some(&Start { noise_as_stated: true, ..Start::at(fit) }))?;
    let views = study.view(rows, &fit)?;
    let residual = |view: &super::model::RowView| {
        let place = view.present.iter().position(|output| *output == mode)?;
        Some(view.residual[place])
    };
    let residuals: Vec<f64> = views.iter().filter_map(residual).collect();
    let middle = rows.len() / 2;
    let slopes = study.nuisance(&rows[middle..=middle], &fit)?.pop()?;
    let slope = DVector::from_iterator(slopes.ncols(), slopes.row(mode).iter().copied());
    let of_fit = slope.dot(&(&fit.covariance * &slope)).max(0.0);
    let of_rows = stats::sample_std(&residuals).unwrap_or(0.0).powi(2) / residuals.len() as f64;
    Some((100.0 * stats::mean(&residuals), 100.0 * (of_fit + of_rows).sqrt()))
}
