//! The test for a change of a stiffness in time among the rows that a discrepancy is learned from.
//!
//! A discrepancy is learned as a function of the inputs, but a loss of stiffness that begins among the rows and goes with an input
//! for a while would become a part of it. Each stiffness is therefore tested for a step at many times and for a slope:
//!
//! ```text
//!  r = Ψv + Jμ + e,    T = (dᵀΣ⁻¹r)²/(dᵀΣ⁻¹d),    Σ = V + ΨΨᵀ + J W² Jᵀ
//! ```
//!
//! d: derivative of ln f by the stiffness at the rows after the step; the process and the means μ of the parameters, with the width W
//! of their priors, compete for what the step explains. T, times the share of independent rows, has a χ² distribution with 1 degree
//! of freedom by chance; the p-value is multiplied by the number of tests.
//!
//! Source: Rao (1948), Proc. Cambridge Phil. Soc. 44, for score tests.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};
use serde::{Deserialize, Serialize};
use statrs::distribution::{ChiSquared, ContinuousCDF as _};

use super::posterior::Basis;
use super::rows::{along, ByMode, Precision, Rows};
use crate::fit::Fit;
use crate::study::Study;
use structures::physics::effect::Target;

/// Number of times at which a step is tested, and the share of the rows before the first and after the last of them.
const STEPS: usize = 40;
const MARGIN: f64 = 0.06;

/// Greatest number of springs that are tested one by one; of a larger structure only the parameters are.
const MOST_SPRINGS: usize = 60;

/// A change is reported if its p-value lies below this.
const REPORTED: f64 = 1e-3;

/// A change in time among the rows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct ChangeInTime {
    /// Spring or parameter whose stiffness explains the change best.
    pub target: String,
    /// Days from the first row, or the index of the row without times, after which it is changed; `null` for a slope.
    pub after: Option<f64>,
    /// Change of the stiffness, per cent.
    pub size_percent: f64,
    /// Probability of at least this change by chance, times the number of tests (Bonferroni), at most 1.
    pub p_value: f64,
}

/// A stiffness: its name, and the derivatives of ln f by the logarithm of it.
struct Direction {
    name: String,
    by: ByMode,
}

/// The most significant change of a stiffness in time; `None` if none is significant. The outer `None` means that the frequencies
/// cannot be computed in some row. `rows` are the rows with the indices `indices` under `fit`, in order of time.
pub fn change_in_time(
    study: &Study<'_>,
    indices: &[usize],
    fit: &Fit,
    rows: &Rows,
    basis: &Basis,
) -> Option<Option<ChangeInTime>> {
    let directions = directions(study, indices, fit, rows)?;
    let competitors = Competitors::new(study, rows, basis)?;
    let times: Vec<f64> = indices.iter().map(|row| study.data.times_days[*row]).collect();
    let functions = functions(&times);
    let share = competitors.independent_share(rows, basis);
    let tests = (directions.len() * functions.ncols()) as f64;
    let chi = ChiSquared::new(1.0).ok()?;
    let mut best: Option<ChangeInTime> = None;
    for direction in &directions {
        for (column, (size, statistic)) in competitors.scores(rows, basis, &direction.by, &functions).iter().enumerate()
        {
            let p_value = (chi.sf(statistic * share) * tests).min(1.0);
            if best.as_ref().is_none_or(|b| p_value < b.p_value) {
                let step = functions.column(column).iter().position(|v| *v > 0.5).filter(|_| column > 0);
                best = Some(ChangeInTime {
                    target: direction.name.clone(),
                    after: step.map(|place| times[place.saturating_sub(1)]),
                    size_percent: 100.0 * size,
                    p_value,
                });
            }
        }
    }
    Some(best.filter(|b| b.p_value < REPORTED))
}

/// The functions of time that are tested, `[n, 1 + steps]`: a slope from −½ to ½, then steps from 0 to 1.
fn functions(times: &[f64]) -> DMatrix<f64> {
    let n = times.len();
    let (first, last) = (times[0], times[n - 1]);
    let mut places: Vec<usize> = (0..STEPS)
        .map(|i| {
            let share = MARGIN + (1.0 - 2.0 * MARGIN) * i as f64 / (STEPS - 1) as f64;
            ((share * n as f64) as usize).clamp(2.min(n - 1), n - 1)
        })
        .collect();
    places.dedup();
    DMatrix::from_fn(n, 1 + places.len(), |row, column| match column.checked_sub(1) {
        None => (times[row] - first) / (last - first).max(f64::MIN_POSITIVE) - 0.5,
        Some(step) => f64::from(u8::from(row >= places[step])),
    })
}

/// The stiffnesses that can change: those that parameters set, and every spring of a structure with few of them.
fn directions(study: &Study<'_>, indices: &[usize], fit: &Fit, rows: &Rows) -> Option<Vec<Direction>> {
    let simulator = study.simulator;
    let zero = || vec![DVector::zeros(rows.len()); rows.modes];
    let mut found = Vec::new();
    for (slopes, k) in rows.slopes.iter().zip(study.free()).filter(|(_, k)| simulator.is_stiffness(**k)) {
        let per_share = 1.0 / simulator.stiffness_share(*k, fit.mean[*k]);
        let by = slopes.iter().map(|of_mode| of_mode * per_share).collect();
        found.push(Direction { name: simulator.space().as_slice()[*k].name.clone(), by });
    }
    let Some(structure) = simulator.structure() else {
        // Of a table only the parameters are known: the frequency of each mode stands for every other stiffness.
        for mode in 0..rows.modes {
            let mut by = zero();
            by[mode].fill(1.0);
            found.push(Direction { name: format!("the frequency of mode {}", mode + 1), by });
        }
        return Some(found);
    };
    let springs = structure.springs();
    let others: Vec<usize> = (0..springs.len()).filter(|s| found.iter().all(|d| d.name != springs[*s].name)).collect();
    if others.len() > MOST_SPRINGS {
        return Some(found);
    }
    let targets: Vec<Target> = others.iter().map(|spring| Target::Springs(vec![*spring])).collect();
    let slopes = study.directions(indices, fit, &targets)?;
    for (column, spring) in others.iter().enumerate() {
        let mut by = zero();
        for (place, slopes) in slopes.iter().enumerate() {
            for (mode, of_mode) in by.iter_mut().enumerate() {
                of_mode[place] = slopes[(mode, column)];
            }
        }
        found.push(Direction { name: springs[*spring].name.clone(), by });
    }
    Some(found)
}

/// The process and the means of the parameters, which compete with a change in time.
struct Competitors {
    precision: Precision,
    /// J times the width of each prior, by mode.
    means: Vec<ByMode>,
    /// 1 + (Ψ, JW)ᵀV⁻¹(Ψ, JW), factorised.
    inner: Cholesky<f64, Dyn>,
    /// Its solution for (Ψ, JW)ᵀV⁻¹r.
    solved: DVector<f64>,
}

impl Competitors {
    fn new(study: &Study<'_>, rows: &Rows, basis: &Basis) -> Option<Self> {
        let precision = rows.precision(&basis.extra)?;
        let width = |k: &usize| study.simulator.space().as_slice()[*k].as_normal().1;
        let means: Vec<ByMode> = rows
            .slopes
            .iter()
            .zip(study.free())
            .map(|(slopes, k)| slopes.iter().map(|of_mode| of_mode * width(k)).collect())
            .collect();
        let own = basis.information(&precision);
        let (process, size) = (own.nrows(), own.nrows() + means.len());
        let mut inner = DMatrix::identity(size, size);
        let mut corner = inner.view_mut((0, 0), (process, process));
        corner += own;
        let weighed: Vec<ByMode> = means.iter().map(|m| precision.times(m)).collect();
        let all = DMatrix::from_element(rows.len(), 1, 1.0);
        for (a, x) in weighed.iter().enumerate() {
            let across = basis.transposed_times(x, &all);
            for i in 0..process {
                inner[(i, process + a)] = across[(i, 0)];
                inner[(process + a, i)] = across[(i, 0)];
            }
            for (b, other) in means.iter().enumerate() {
                inner[(process + a, process + b)] += along(x, other).sum();
            }
        }
        let inner = inner.cholesky()?;
        let mut found = Self { precision, means, inner, solved: DVector::zeros(size) };
        let right = found.transposed_times(basis, &found.precision.times(&rows.residual), &all);
        found.solved = found.inner.solve(&right).column(0).into_owned();
        Some(found)
    }

    /// (Ψ, JW)ᵀx for each column of `mask`, `[competitors, columns]`.
    fn transposed_times(&self, basis: &Basis, x: &ByMode, mask: &DMatrix<f64>) -> DMatrix<f64> {
        let process = basis.transposed_times(x, mask);
        let first = process.nrows();
        let mut all = process.resize_vertically(first + self.means.len(), 0.0);
        for (a, means) in self.means.iter().enumerate() {
            all.row_mut(first + a).copy_from(&mask.tr_mul(&along(means, x)).transpose());
        }
        all
    }

    /// Estimated size and T of a stiffness that changes by each of the `functions` of the row, `[n, columns]`.
    fn scores(&self, rows: &Rows, basis: &Basis, by: &ByMode, functions: &DMatrix<f64>) -> Vec<(f64, f64)> {
        let weighed = self.precision.times(by);
        let (with_residual, with_itself) = (along(&weighed, &rows.residual), along(&weighed, by));
        let across = self.transposed_times(basis, &weighed, functions);
        let solved = self.inner.solve(&across);
        let squares = functions.map(|v| v * v);
        (0..functions.ncols())
            .map(|column| {
                let score = functions.column(column).dot(&with_residual) - across.column(column).dot(&self.solved);
                let alone = squares.column(column).dot(&with_itself);
                let information = alone - across.column(column).dot(&solved.column(column));
                // A change that the process or the parameters explain as well cannot be tested.
                if information > 1e-6 * alone {
                    (score / information, score * score / information)
                } else {
                    (0.0, 0.0)
                }
            })
            .collect()
    }

    /// Effective number of independent rows as a share of all rows, (1 − ρ)/(1 + ρ) with the correlation ρ of successive rows after
    /// the process and the means.
    fn independent_share(&self, rows: &Rows, basis: &Basis) -> f64 {
        let fitted = basis.times(&self.solved);
        let process = self.solved.len() - self.means.len();
        let mut left = rows.residual.clone();
        for (mode, of_mode) in left.iter_mut().enumerate() {
            *of_mode -= &fitted[mode];
            for (a, means) in self.means.iter().enumerate() {
                *of_mode -= &means[mode] * self.solved[process + a];
            }
        }
        let (mut products, mut squares) = (0.0, 0.0);
        for (mode, of_mode) in left.iter().enumerate() {
            let scale = self.precision.of(mode, mode).map(f64::sqrt);
            let unit = of_mode.component_mul(&scale);
            products += unit.as_slice().windows(2).map(|w| w[0] * w[1]).sum::<f64>();
            squares += unit.norm_squared();
        }
        let correlation = (products / squares.max(f64::MIN_POSITIVE)).clamp(0.0, 0.95);
        (1.0 - correlation) / (1.0 + correlation)
    }
}
