//! The test for a lasting change in time, and what follows from it for the rows of a diagnosis.
//!
//! New damage must not be taken for a cause, and not for the condition in which the gain is measured. All rows are therefore tested
//! together, those held out as well:
//!
//! - `series`: what is tested: the residual of each mode, and the best value of each free parameter in each row;
//! - `competitors`: what else may explain it: recorded quantities and the seasons;
//! - `step`: the test for a step at many times, with its onset;
//! - `stiffness`: the stiffness whose change looks like it;
//! - `found`: the finding in numbers and words; `usable`: the rows that may be used nevertheless.

pub(super) mod competitors;
pub mod found;
pub(super) mod series;
pub(super) mod step;
pub(super) mod stiffness;
pub(super) mod usable;

use competitors::competitors;
use found::{LastingChange, ModeChange};
use series::{binned, Quantity, Series};
use statrs::distribution::{ContinuousCDF as _, StudentsT};
use step::{Stepped, Tested};

use super::data::Data;
use super::fit::Fit;
use super::study::Study;
use structures::stats;

/// Smallest number of rows that are tested.
const FEWEST_ROWS: usize = 40;

/// Share of the data sets without a change in which one is found by chance. It holds where the scatter is correlated over days; where it
/// persists for weeks, or in short series, it was up to 0.04 in simulations.
pub const ERROR_RATE: f64 = 0.01;

/// The answer of the test.
pub(super) enum Examined {
    /// The rows could not be tested; the reason as a sentence without capital and full stop.
    Untested(String),
    /// No change was found.
    Unchanged,
    /// A change was found.
    Changed(Box<LastingChange>),
}

/// Tests the rows with the indices `rows`, in order of time, for a step in time that the effects of `fit`, the recorded quantities
/// and the seasons do not explain. `None` if the frequencies cannot be computed in some row.
///
/// ```text
///  y = Qβ + δ s_τ + v,    t = s_τᵀM y/√(ω² s_τᵀM s_τ),    M = 1 − QQᵀ,    p = Σ over the tests of P(|t_ν| ≥ |t|)
/// ```
///
/// y: the residual of a mode, or the best value of a parameter, in each row; Q: orthonormal competitors; s_τ: 1 from row τ on; ω²: the
/// variance of v with its correlation in time (see [`step`]). The p-value is that of the clearest step times the number of steps and
/// quantities tested (Bonferroni), and a change is found where it lies below [`ERROR_RATE`].
pub(super) fn examine(study: &Study<'_>, rows: &[usize], fit: &Fit) -> Option<Examined> {
    let data = study.data;
    if data.measured_at.is_empty() {
        return Some(Examined::Untested("the rows have no times".to_owned()));
    }
    if rows.len() < FEWEST_ROWS {
        return Some(Examined::Untested(format!("with {} rows it needs at least {FEWEST_ROWS}", rows.len())));
    }
    let views = study.view(rows, fit)?;
    let size = series::bin_size(rows.len());
    let columns: Vec<Vec<f64>> = competitors(data, rows, fit).iter().map(|c| binned(c, size)).collect();
    let all: Vec<(Series, Tested)> = series::series(study, &views, fit)
        .into_iter()
        .filter_map(|one| {
            let tested = Tested::new(&binned(&one.values, size), &columns)?;
            Some((one, tested))
        })
        .collect();
    let (mut tests, mut best): (usize, Option<(usize, Stepped, f64)>) = (0, None);
    for (index, (_, tested)) in all.iter().enumerate() {
        for step in tested.steps() {
            tests += 1;
            let p = StudentsT::new(0.0, 1.0, step.degrees_of_freedom).map_or(1.0, |t| 2.0 * t.sf(step.t.abs()));
            if best.as_ref().is_none_or(|b| p < b.2) {
                best = Some((index, step, p));
            }
        }
    }
    let Some((index, clearest, p)) = best else {
        return Some(Examined::Untested("too many recorded quantities or too few rows with a mode".to_owned()));
    };
    let p_value = (p * tests as f64).min(1.0);
    if p_value >= ERROR_RATE {
        return Some(Examined::Unchanged);
    }
    let tested = &all[index].1;
    let onset = tested.onset(&clearest);
    let row_of = |place: usize| rows[(tested.bin(place) * size).min(rows.len() - 1)];
    let first = row_of(onset.place);
    let from_bin = tested.bin(onset.place);
    let sizes: Vec<(&Series, &Tested, Stepped)> = all
        .iter()
        .filter_map(|(series, tested)| Some((series, tested, tested.step_at(tested.place_of(from_bin))?)))
        .collect();
    let modes: Vec<ModeChange> = sizes
        .iter()
        .filter_map(|(series, _, step)| match series.quantity {
            Quantity::Mode(mode) => Some(ModeChange {
                mode: mode + 1,
                percent: 100.0 * step.size.exp_m1(),
                standard_error_percent: 100.0 * step.standard_error,
                measured_percent: measured_percent(data, rows, mode, first),
            }),
            Quantity::Parameter(_) => None,
        })
        .collect();
    let place_in_rows = |row: usize| rows.iter().position(|r| *r == row).unwrap_or_default();
    Some(Examined::Changed(Box::new(LastingChange {
        since: data.measured_at[first],
        since_interval90: [row_of(onset.interval[0]), row_of(onset.interval[1])].map(|row| data.measured_at[row]),
        since_days: data.times_days[first],
        first_row: first,
        first_possible_row: row_of(onset.interval[0]),
        rows_before: place_in_rows(first),
        rows_since: rows.len() - place_in_rows(first),
        clearest_in: all[index].0.name(study),
        modes,
        stiffness: stiffness::candidates(study, rows, fit, &views, &sizes)?,
        p_value,
        error_rate: ERROR_RATE,
        covered_years: data.times_days[rows[rows.len() - 1]] / 365.25,
        consequence: String::new(),
        sentence: String::new(),
    })))
}

/// Difference between the mean frequencies of a mode in the `rows` from row `first` on and in those before, per cent, by the means of ln f;
/// `None` if the mode was not measured on both sides.
fn measured_percent(data: &Data, rows: &[usize], mode: usize, first: usize) -> Option<f64> {
    let mean = |since: bool| {
        let side = rows.iter().filter(|row| (**row >= first) == since).map(|row| data.log_frequencies[*row][mode]);
        let measured: Vec<f64> = side.filter(|value| value.is_finite()).collect();
        (!measured.is_empty()).then(|| stats::mean(&measured))
    };
    Some(100.0 * (mean(true)? - mean(false)?).exp_m1())
}
