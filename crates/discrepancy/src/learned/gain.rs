//! The gain from a learned discrepancy on rows that it was not learned from.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF as _, StudentsT};

use super::constant::constant;
use super::input::{choose, standardised, Chosen};
use super::learn::{learn, Learned};
use crate::blocks::{Blocks, FOLDS};
use crate::effect::FittedEffect;
use crate::fit::{Fit, Start};
use crate::gain::{Change, DensityChange};
use crate::model::RowView;
use crate::study::Study;
use structures::stats;

/// Figures without and with a learned discrepancy, on rows that it was not learned from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct LearnedGain {
    /// Number of these rows.
    pub rows: usize,
    /// Whether they were held out. Otherwise blocks of the other rows were left out in turn.
    pub held_out: bool,
    /// Root mean square of the residual of each mode, per cent.
    pub rms_error_percent: Change<Vec<f64>>,
    /// Log predictive density of the logarithms of the frequencies.
    pub log_density_per_row: DensityChange,
    /// Share of the frequencies inside their predicted 90 % interval.
    pub coverage90: Change<f64>,
}

impl LearnedGain {
    /// Whether the discrepancy predicts better by more than two standard errors.
    pub fn is_clear(&self) -> bool {
        let density = &self.log_density_per_row;
        density.difference > 2.0 * density.standard_error
    }
}

/// One row under a fit.
struct Predicted {
    log_density: f64,
    /// Residual of each mode, NaN if missing, `[m]`.
    residuals: Vec<f64>,
    inside: usize,
    present: usize,
}

/// The gain on the rows `held`, from a discrepancy that was learned from others. `None` if the frequencies cannot be computed in
/// some row.
pub fn held_out_gain(
    study: &Study<'_>,
    held: &[usize],
    base: &Fit,
    learned: &Learned,
    u: &[Option<Vec<f64>>],
) -> Option<LearnedGain> {
    let before = predicted(study, held, base)?;
    let after = with_discrepancy(study, held, learned, u)?;
    Some(figures(study.simulator.modes(), &before, &after, true))
}

/// The gain on all of `rows`, by leaving out blocks of successive rows in five folds and learning from the others: also the inputs
/// are chosen anew. A fold in which nothing can be learned predicts as the simulation alone does. `None` if the simulation cannot
/// be fitted in some fold. `everywhere`: the fit with a deviation of all parts, whose constants are then learned.
pub fn left_out_gain(
    study: &Study<'_>,
    rows: &[usize],
    known: &[FittedEffect],
    everywhere: Option<&Fit>,
) -> Option<LearnedGain> {
    let blocks = Blocks::successive(rows.len());
    let fold = |number: usize| {
        let (out, kept) = blocks.fold(number);
        let kept: Vec<usize> = kept.iter().map(|p| rows[*p]).collect();
        let left: Vec<usize> = out.iter().map(|p| rows[*p]).collect();
        let base = study.fit(&kept, known, None)?;
        let before = predicted(study, &left, &base)?;
        let chosen = everywhere.map_or_else(|| choose(study.simulator, study.data, &kept), |_| Chosen::default());
        let u = standardised(study.simulator, study.data, &chosen.inputs);
        let learned = match everywhere {
            Some(all) => constant(study, &kept, &study.fit(&kept, &all.effects, Some(&Start::at(all)))?),
            None => learn(study, &kept, &base, &chosen.inputs, &u),
        };
        let after = match learned {
            Ok(learned) => with_discrepancy(study, &left, &learned, &u)?,
            Err(_) => predicted(study, &left, &base)?,
        };
        Some(out.into_iter().zip(before.into_iter().zip(after)).collect::<Vec<_>>())
    };
    let folds: Vec<_> = (0..FOLDS).into_par_iter().map(fold).collect::<Option<Vec<_>>>()?;
    let mut all: Vec<_> = folds.into_iter().flatten().collect();
    all.sort_by_key(|(place, _)| *place);
    let (before, after): (Vec<_>, Vec<_>) = all.into_iter().map(|(_, both)| both).unzip();
    Some(figures(study.simulator.modes(), &before, &after, false))
}

fn with_discrepancy(
    study: &Study<'_>,
    rows: &[usize],
    learned: &Learned,
    u: &[Option<Vec<f64>>],
) -> Option<Vec<Predicted>> {
    let corrected = learned.corrected(study.data, u);
    predicted(&Study::new(study.simulator, &corrected), rows, &learned.fit)
}

fn predicted(study: &Study<'_>, rows: &[usize], fit: &Fit) -> Option<Vec<Predicted>> {
    let edge = if fit.tails.is_finite() {
        StudentsT::new(0.0, 1.0, fit.tails).ok()?.inverse_cdf(0.95)
    } else {
        stats::normal_quantile(0.95)
    };
    let one = |view: RowView| {
        let mut residuals = vec![f64::NAN; study.simulator.modes()];
        let mut inside = 0;
        for (i, mode) in view.present[..view.frequencies].iter().enumerate() {
            residuals[*mode] = view.residual[i];
            inside += usize::from(view.residual[i].abs() <= edge * view.covariance[(i, i)].sqrt());
        }
        Predicted { log_density: view.log_density, residuals, inside, present: view.frequencies }
    };
    Some(study.view(rows, fit)?.into_iter().map(one).collect())
}

fn figures(modes: usize, before: &[Predicted], after: &[Predicted], held_out: bool) -> LearnedGain {
    let rms = |rows: &[Predicted]| {
        let of_mode = |mode: usize| {
            let known = rows.iter().map(|row| row.residuals[mode]).filter(|e| e.is_finite());
            let squares: Vec<f64> = known.map(|e| e * e).collect();
            100.0 * stats::mean(&squares).sqrt()
        };
        (0..modes).map(of_mode).collect::<Vec<f64>>()
    };
    let coverage = |rows: &[Predicted]| {
        let cells: usize = rows.iter().map(|row| row.present).sum();
        rows.iter().map(|row| row.inside).sum::<usize>() as f64 / cells.max(1) as f64
    };
    let density = |rows: &[Predicted]| stats::mean(&rows.iter().map(|row| row.log_density).collect::<Vec<f64>>());
    let differences: Vec<f64> = after.iter().zip(before).map(|(b, a)| b.log_density - a.log_density).collect();
    let (n, mean) = (differences.len(), stats::mean(&differences));
    LearnedGain {
        rows: n,
        held_out,
        rms_error_percent: Change { before: rms(before), after: rms(after) },
        log_density_per_row: DensityChange {
            before: density(before),
            after: density(after),
            difference: mean,
            standard_error: Blocks::successive(n).standard_error(&differences, mean),
        },
        coverage90: Change { before: coverage(before), after: coverage(after) },
    }
}
