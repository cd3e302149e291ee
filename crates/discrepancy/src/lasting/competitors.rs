//! What else may explain a change in time: recorded quantities, with an arbitrary response of each mode, and the seasons.

use std::f64::consts::TAU;

use crate::cycle::{DAILY_DAYS, YEAR_DAYS};
use crate::data::{Column, Data, Origin, Values, TIME};
use crate::fit::Fit;
use structures::simulator::law::{Input, LawKind};
use structures::stats;

/// Data that cover at least this many days may contain a part of a yearly swing.
const SEASON_DAYS: f64 = 30.0;

/// Data that cover this many years show the form of a yearly swing, which then has two harmonics.
const YEARS_WITH_FORM: f64 = 2.0;

/// Functions of the rows with the indices `rows`, each `[rows]`: every recorded quantity and its square, or its categories; the products,
/// lags and knees that effects of the fit use; a yearly and a daily swing. The constant is not among them.
pub fn competitors(data: &Data, rows: &[usize], fit: &Fit) -> Vec<Vec<f64>> {
    let mut all: Vec<Vec<f64>> = Vec::new();
    let used = |column: &Column| fit.effects.iter().any(|e| e.law.covariate.as_deref() == Some(&column.name));
    for column in data.columns.iter().filter(|c| c.name != TIME && c.origin.cycle().is_none()) {
        let product = matches!(column.origin, Origin::Product(..));
        match &column.values {
            Values::Numbers(_) if product && !used(column) => {}
            Values::Numbers(values) => {
                let unit = standardised(&rows.iter().map(|row| values[*row]).collect::<Vec<f64>>());
                if !product {
                    all.push(unit.iter().map(|u| u * u).collect());
                }
                all.push(unit);
            }
            Values::Categories(names, indices) => all.extend(
                (1..names.len())
                    .map(|level| rows.iter().map(|r| f64::from(u8::from(indices[*r] == Some(level)))).collect()),
            ),
        }
    }
    for (effect, psi) in fit.effects.iter().zip(&fit.psi) {
        if effect.law.covariate.as_deref() == Some(TIME) {
            continue;
        }
        if let Some(lag) = effect.lag() {
            let inputs = data.inputs(&effect.law, Some(psi[lag]));
            let value = |row: &usize| if let Input::Lagged(value, _) = inputs[*row] { value } else { f64::NAN };
            all.push(standardised(&rows.iter().map(value).collect::<Vec<f64>>()));
        }
        let knee = effect.numbers.iter().position(|n| n.name == "knee").map(|place| psi[place]);
        if let (LawKind::Bilinear, Some(knee)) = (effect.law.kind, knee) {
            let inputs = data.inputs(&effect.law, None);
            let value = |row: &usize| if let Input::Number(c) = inputs[*row] { (c - knee).max(0.0) } else { f64::NAN };
            all.push(standardised(&rows.iter().map(value).collect::<Vec<f64>>()));
        }
    }
    all.extend(swings(&rows.iter().map(|row| data.times_days[*row]).collect::<Vec<f64>>()));
    all
}

/// Cosine and sine of the year, with their second harmonics where the data show the form of the swing, and of the day.
fn swings(times_days: &[f64]) -> Vec<Vec<f64>> {
    let span = times_days[times_days.len() - 1] - times_days[0];
    let gaps: Vec<f64> = times_days.windows(2).map(|w| w[1] - w[0]).collect();
    let mut periods = Vec::new();
    if span >= SEASON_DAYS {
        periods.push(YEAR_DAYS);
        if span >= YEARS_WITH_FORM * YEAR_DAYS {
            periods.push(YEAR_DAYS / 2.0);
        }
    }
    if span >= 0.5 && stats::quantile(&gaps, 0.5) <= DAILY_DAYS {
        periods.push(1.0);
    }
    let swing = |period: f64| {
        let of = |wave: fn(f64) -> f64| times_days.iter().map(|t| wave(TAU * t / period)).collect();
        [of(f64::cos), of(f64::sin)]
    };
    periods.into_iter().flat_map(swing).collect()
}

/// (c − mean)/std; 0 for a missing value or a constant.
fn standardised(values: &[f64]) -> Vec<f64> {
    let known: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
    let (mean, std) = (stats::mean(&known), stats::sample_std(&known).unwrap_or(0.0));
    let unit = |v: &f64| if v.is_finite() && std > 0.0 { (v - mean) / std } else { 0.0 };
    values.iter().map(unit).collect()
}
