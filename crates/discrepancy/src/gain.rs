//! The gain from the causes, measured on rows that were used neither to choose nor to fit them.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector};
use rand::Rng as _;
use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF as _, StudentsT};

use super::blocks::Blocks;
use super::fit::Fit;
use super::model::RowView;
use super::study::Study;
use structures::parameter::DamageDirection;
use structures::stats;

/// Number of rows of a batch, for shifts of parameters and for alarms.
const BATCH: usize = 10;

/// Share of undamaged batches that may raise an alarm.
const ALARM_RATE: f64 = 0.001;

/// Number of bootstrap samples.
const BOOTSTRAPS: usize = 500;

/// A figure without and with the causes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Change<T> {
    /// Simulation without the causes.
    pub before: T,
    /// Simulation with the causes.
    pub after: T,
}

/// Log predictive density, nats per row.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct DensityChange {
    /// Simulation without the causes.
    pub before: f64,
    /// Simulation with the causes.
    pub after: f64,
    /// After minus before.
    pub difference: f64,
    /// Standard error of the difference, over blocks of rows.
    pub standard_error: f64,
}

/// How a gain was measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum GainMethod {
    /// On rows that were used neither to choose nor to fit the causes.
    #[default]
    HeldOut,
    /// By cross-validation: each block of rows is predicted by a fit to the others. The causes were chosen with all rows, so that
    /// the gain is measured a little too large.
    CrossValidation,
}

/// Figures without and with the causes, on rows that were not used to fit them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Gain {
    /// How it was measured.
    #[serde(default)]
    pub method: GainMethod,
    /// Number of rows that it was measured on.
    pub holdout_rows: usize,
    /// Root mean square of the residual ln y − M of each mode, per cent.
    pub rms_error_percent: Change<Vec<f64>>,
    /// 90 % interval of the change of that error for each mode, by bootstrap over blocks.
    pub rms_difference_interval90: Vec<[f64; 2]>,
    /// Log predictive density of the logarithms of the frequencies and of the coordinates of mode shapes.
    pub log_density_per_row: DensityChange,
    /// Share of the frequencies inside their predicted 90 % interval.
    pub coverage90: Change<f64>,
    /// Standard deviation of each parameter between batches of ten rows, per cent of the stiffness that it sets.
    pub spread_of_parameters_percent: Change<BTreeMap<String, f64>>,
    /// Rows among them that are part of the declared undamaged reference. Of all others it is not known whether the structure was
    /// undamaged.
    #[serde(default)]
    pub undamaged_rows: usize,
    /// Of 1000 batches of ten of these rows, those beyond a control limit that 1 in 1000 should exceed; the limit is set from the first
    /// quarter of the other rows. They are false alarms only where the structure was undamaged: see `undamaged_rows`. `null` for
    /// fewer than 20 rows.
    pub false_alarms_per_1000: Option<Change<f64>>,
    /// Smallest loss of the stiffness that is identified worst which one batch of ten rows detects with a probability of 90 %, at
    /// a limit that 1 in 1000 should exceed without a loss. `null` for fewer than 20 rows.
    pub smallest_detectable_loss_percent: Option<Change<f64>>,
}

impl Gain {
    /// What is known about the condition of the structure in its rows, as a clause.
    pub fn condition(&self) -> String {
        match self.undamaged_rows {
            rows if rows == self.holdout_rows => {
                "all of them are in the declared undamaged reference, so that these would be false alarms".to_owned()
            }
            0 => "whether the structure was undamaged in these rows is not known, so that they may be false alarms or right ones"
                .to_owned(),
            rows => format!(
                "{rows} of these {} rows are in the declared undamaged reference; of the others it is not known whether the structure \
                 was undamaged",
                self.holdout_rows
            ),
        }
    }
}

/// The figures of one fit.
struct FitFigures {
    rms: Vec<f64>,
    densities: Vec<f64>,
    coverage: f64,
    spread: BTreeMap<String, f64>,
    false_alarms: f64,
    detectable: f64,
    errors: Vec<Vec<f64>>,
    /// Rows in the declared undamaged reference.
    undamaged: usize,
}

/// What a gain is measured on.
pub(super) enum Unseen<'a> {
    /// These rows are held out of the search and of the fits.
    HeldOut(&'a [usize]),
    /// Each row that was searched is predicted by fits without its block.
    LeftOut(&'a Blocks),
}

/// The gain of the fit `after` over the fit `before`, both to the rows `training`, whose scatter sets the alarm limits.
///
/// The standard error of the difference in log density is that of the mean over blocks of rows, and the intervals of the errors
/// come from a bootstrap over the same blocks, because successive rows are correlated. With rows left out, the causes are chosen
/// with all rows and only their numbers are fitted without the block. `None` if the frequencies cannot be computed in some row.
pub(super) fn gain(
    study: &Study<'_>,
    training: &[usize],
    unseen: &Unseen<'_>,
    (before, after): (&Fit, &Fit),
    seed: u64,
) -> Option<Gain> {
    let of = |fit: &Fit| {
        let views = match unseen {
            Unseen::HeldOut(rows) => study.view(rows, fit)?,
            Unseen::LeftOut(blocks) => blocks.predicted(study, training, fit)?,
        };
        figures_of(study, training, &views, fit)
    };
    let (a, b) = (of(before)?, of(after)?);
    let n = a.densities.len();
    let successive = Blocks::successive(n);
    let (blocks, method) = match unseen {
        Unseen::HeldOut(_) => (&successive, GainMethod::HeldOut),
        Unseen::LeftOut(blocks) => (*blocks, GainMethod::CrossValidation),
    };
    let differences: Vec<f64> = b.densities.iter().zip(&a.densities).map(|(b, a)| b - a).collect();
    let mean = stats::mean(&differences);

    let mut stream = stats::stream(seed, "bootstrap of the gain");
    let modes = a.rms.len();
    let places: Vec<Vec<usize>> = (0..blocks.count()).map(|block| blocks.places(block).collect()).collect();
    let mut draws: Vec<Vec<f64>> = vec![Vec::new(); modes];
    for _ in 0..BOOTSTRAPS {
        let chosen: Vec<usize> = places.iter().map(|_| stream.random_range(0..places.len())).collect();
        for (mode, draws) in draws.iter_mut().enumerate() {
            let rms = |errors: &[Vec<f64>]| {
                let (mut sum, mut count) = (0.0, 0.0);
                for place in chosen.iter().flat_map(|block| &places[*block]) {
                    let error = errors[*place][mode];
                    if error.is_finite() {
                        sum += error * error;
                        count += 1.0;
                    }
                }
                100.0 * (sum / f64::max(count, 1.0)).sqrt()
            };
            draws.push(rms(&b.errors) - rms(&a.errors));
        }
    }
    let interval = |d: &Vec<f64>| [stats::quantile(d, 0.05), stats::quantile(d, 0.95)];
    let enough = n >= 2 * BATCH;
    Some(Gain {
        method,
        holdout_rows: n,
        rms_error_percent: Change { before: a.rms, after: b.rms },
        rms_difference_interval90: draws.iter().map(interval).collect(),
        log_density_per_row: DensityChange {
            before: stats::mean(&a.densities),
            after: stats::mean(&b.densities),
            difference: mean,
            standard_error: blocks.standard_error(&differences, mean),
        },
        coverage90: Change { before: a.coverage, after: b.coverage },
        spread_of_parameters_percent: Change { before: a.spread, after: b.spread },
        false_alarms_per_1000: enough.then_some(Change { before: a.false_alarms, after: b.false_alarms }),
        undamaged_rows: a.undamaged,
        smallest_detectable_loss_percent: enough.then_some(Change { before: a.detectable, after: b.detectable }),
    })
}

/// The figures of one fit for rows that it has not seen, `views`, with alarm limits from the rows `training`.
fn figures_of(study: &Study<'_>, training: &[usize], views: &[RowView], fit: &Fit) -> Option<FitFigures> {
    let modes = study.simulator.modes();
    let error = |view: &RowView| {
        let mut errors = vec![f64::NAN; modes];
        for (place, mode) in view.present[..view.frequencies].iter().enumerate() {
            errors[*mode] = view.residual[place];
        }
        errors
    };
    let errors: Vec<Vec<f64>> = views.iter().map(error).collect();
    let rms = |mode: usize| {
        let known: Vec<f64> = errors.iter().map(|e| e[mode]).filter(|e| e.is_finite()).map(|e| e * e).collect();
        100.0 * stats::mean(&known).sqrt()
    };
    let edge = if fit.tails.is_finite() {
        StudentsT::new(0.0, 1.0, fit.tails).ok()?.inverse_cdf(0.95)
    } else {
        stats::normal_quantile(0.95)
    };
    let inside = |view: &RowView| {
        let within = |place: usize| view.residual[place].abs() <= edge * view.covariance[(place, place)].sqrt();
        (0..view.frequencies).filter(|p| within(*p)).count()
    };
    let cells: usize = views.iter().map(|v| v.frequencies).sum();
    let coverage = views.iter().map(inside).sum::<usize>() as f64 / cells.max(1) as f64;

    let space = study.simulator.space().as_slice();
    let shifts = shifts(study, views);
    let training_views = study.view(training, fit)?;
    let training_shifts = self::shifts(study, &training_views);
    let level = ALARM_RATE / study.free().len().max(1) as f64;
    let limit = -stats::normal_quantile(level);
    let undamaged = reference(&training_shifts);
    let damaging = |k: usize, value: f64| match space[k].damage {
        DamageDirection::Decrease => -value,
        DamageDirection::Increase => value,
        DamageDirection::None => f64::NEG_INFINITY,
    };
    let alarms = undamaged.map_or(0, |undamaged| {
        // Prediction limit for one further batch, when mean and scatter are estimated from `count` batches.
        let count = undamaged.count as f64;
        let t = StudentsT::new(0.0, 1.0, count - 1.0).map_or(limit, |t| -t.inverse_cdf(level));
        let factor = t * (1.0 + 1.0 / count).sqrt();
        let beyond = |s: &Vec<(usize, f64, f64)>| {
            s.iter()
                .zip(&undamaged.moments)
                .any(|((k, shift, _), (mean, std))| damaging(*k, (shift - mean) / std) > factor)
        };
        shifts.iter().filter(|s| beyond(s)).count()
    });
    let mut spread = BTreeMap::new();
    let mut detectable: f64 = 0.0;
    for (place, &k) in study.free().iter().enumerate() {
        let of_stiffness = study.simulator.stiffness_share(k, fit.mean[k]);
        let share = |s: &Vec<(usize, f64, f64)>| s[place].1 * of_stiffness;
        let held: Vec<f64> = shifts.iter().map(share).collect();
        spread.insert(space[k].name.clone(), 100.0 * stats::sample_std(&held).unwrap_or(f64::NAN));
        let known: Vec<f64> = training_shifts.iter().map(share).map(|s| s * s).collect();
        let scatter = stats::mean(&known).sqrt();
        if !study.simulator.is_stiffness(k) {
            continue;
        }
        detectable = detectable.max(100.0 * (limit + stats::normal_quantile(0.9)) * scatter);
    }
    Some(FitFigures {
        rms: (0..modes).map(rms).collect(),
        densities: views.iter().map(|v| v.log_density).collect(),
        coverage,
        spread,
        false_alarms: 1000.0 * alarms as f64 / shifts.len().max(1) as f64,
        detectable,
        errors,
        undamaged: views.iter().filter(|view| study.data.declared_undamaged[view.row]).count(),
    })
}

/// Mean and standard deviation of the shift of each free parameter over the first batches.
struct Reference {
    moments: Vec<(f64, f64)>,
    count: usize,
}

/// The reference from the first quarter of the training rows in separate batches of ten, at least five batches; `None` if there
/// are fewer than two batches.
fn reference(shifts: &[Vec<(usize, f64, f64)>]) -> Option<Reference> {
    let apart: Vec<&Vec<(usize, f64, f64)>> = shifts.iter().step_by(BATCH).collect();
    let count = (apart.len() / 4).max(5).min(apart.len());
    if count < 2 {
        return None;
    }
    let moment = |place: usize| {
        let values: Vec<f64> = apart[..count].iter().map(|s| s[place].1).collect();
        (stats::mean(&values), stats::sample_std(&values).unwrap_or(f64::INFINITY))
    };
    Some(Reference { moments: (0..apart[0].len()).map(moment).collect(), count })
}

/// For every ten successive rows and each free parameter: index of the parameter, shift of its mean, standard error of the
/// shift, the last two in the parameter's unit.
///
/// ```text
///  δ = (W⁻² + Σ w JᵀV⁻¹J)⁻¹ Σ w JᵀV⁻¹e
/// ```
///
/// e: residuals of a row; V: their covariance; J: derivatives by the free parameters; w: weight of the row; W: width of each
/// prior, diagonal.
fn shifts(study: &Study<'_>, views: &[RowView]) -> Vec<Vec<(usize, f64, f64)>> {
    let free = study.free();
    let d = free.len();
    let parts: Vec<(DMatrix<f64>, DVector<f64>)> = views
        .iter()
        .map(|view| {
            let mut slopes = view.by_parameter.select_columns(free);
            for (column, k) in free.iter().enumerate() {
                if study.data.settings[view.row][*k].is_some() {
                    slopes.column_mut(column).fill(0.0);
                }
            }
            let solved = view.covariance.clone().cholesky().expect("the noise of a row is never 0");
            let information = slopes.tr_mul(&solved.solve(&slopes)) * view.weight;
            (information, slopes.tr_mul(&solved.solve(&view.residual)) * view.weight)
        })
        .collect();
    if d == 0 || parts.is_empty() {
        return Vec::new();
    }
    let size = BATCH.min(parts.len());
    parts
        .windows(size)
        .filter_map(|window| {
            // Without the prior, the information would be singular for fewer modes than parameters.
            let width =
                |k: usize| study.simulator.space().as_slice()[k].upper - study.simulator.space().as_slice()[k].lower;
            let mut information = DMatrix::from_fn(d, d, |i, j| if i == j { width(free[i]).powi(-2) } else { 0.0 });
            let mut along = DVector::zeros(d);
            for (i, a) in window {
                information += i;
                along += a;
            }
            let covariance = information.try_inverse()?;
            let shift = &covariance * along;
            Some(free.iter().enumerate().map(|(p, k)| (*k, shift[p], covariance[(p, p)].sqrt())).collect())
        })
        .collect()
}
