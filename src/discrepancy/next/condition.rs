//! The conditions in which a further measurement is made.

use std::collections::{BTreeMap, BTreeSet};

use crate::discrepancy::data::{Column, Data, Values, TIME};
use crate::discrepancy::rank::Ranked;
use crate::measurement::CovariateValue;
use crate::stats;

/// Levels of the two quantiles of a numeric covariate at which its effect is measured.
const LOW_AND_HIGH: (f64, f64) = (0.05, 0.95);

/// Greatest number of conditions of one measurement.
const MOST_CONDITIONS: usize = 4;

/// The conditions of one of the rows at hand, with some of them changed. The time is that of the last row.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Condition {
    /// Index of the row.
    pub(super) row: usize,
    /// Covariates with another value than in that row.
    pub(super) changed: BTreeMap<String, CovariateValue>,
    /// Parameters that are set to another value than in that row.
    pub(super) set: BTreeMap<usize, f64>,
}

/// A covariate that candidates depend on, with two values at which their predictions differ.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Contrast {
    pub(super) covariate: String,
    pub(super) values: [CovariateValue; 2],
}

impl Condition {
    /// The conditions of a row.
    pub(super) fn of_row(row: usize) -> Self {
        Self { row, changed: BTreeMap::new(), set: BTreeMap::new() }
    }

    /// The value of a covariate; `None` if it is missing.
    pub(super) fn value(&self, data: &Data, covariate: &str) -> Option<CovariateValue> {
        if let Some(value) = self.changed.get(covariate) {
            return Some(value.clone());
        }
        match &data.column(covariate)?.values {
            Values::Numbers(values) => values[self.row].is_finite().then(|| CovariateValue::Number(values[self.row])),
            Values::Categories(names, indices) => indices[self.row].map(|i| CovariateValue::Category(names[i].clone())),
        }
    }
}

impl Contrast {
    /// The contrast of a covariate in `rows`: two quantiles of a number, or the category `level` and the most frequent other one.
    /// `None` for time, which cannot be chosen, and for a covariate that does not vary.
    fn new(data: &Data, rows: &[usize], covariate: &str, level: Option<&str>) -> Option<Self> {
        let column = data.column(covariate).filter(|c| c.name != TIME)?;
        let values = match &column.values {
            Values::Numbers(_) => {
                let numbers = column.numbers(rows);
                if numbers.is_empty() {
                    return None;
                }
                [LOW_AND_HIGH.0, LOW_AND_HIGH.1].map(|q| CovariateValue::Number(stats::quantile(&numbers, q)))
            }
            Values::Categories(names, _) => {
                let counts = counts(column, rows);
                let most = |without: Option<&str>| {
                    let of = |index: &usize| Some(names[*index].as_str()) != without;
                    counts.keys().copied().filter(of).max_by_key(|index| counts[index]).map(|i| names[i].as_str())
                };
                let first = level.or_else(|| most(None))?;
                [first, most(Some(first))?].map(|name| CovariateValue::Category(name.to_owned()))
            }
        };
        (values[0] != values[1]).then(|| Self { covariate: covariate.to_owned(), values })
    }
}

/// Number of rows of each category.
fn counts(column: &Column, rows: &[usize]) -> BTreeMap<usize, usize> {
    let mut counts = BTreeMap::new();
    if let Values::Categories(_, indices) = &column.values {
        for index in rows.iter().filter_map(|row| indices[*row]) {
            *counts.entry(index).or_default() += 1;
        }
    }
    counts
}

/// The contrasts of the covariates that the candidates depend on, without repetition.
pub(super) fn contrasts(data: &Data, rows: &[usize], ranked: &[&Ranked]) -> Vec<Contrast> {
    let mut seen = BTreeSet::new();
    let mut all = Vec::new();
    for candidate in ranked.iter().map(|r| &r.candidate) {
        if let (Some(covariate), level) = candidate.input() {
            if seen.insert((covariate, level)) {
                all.extend(Contrast::new(data, rows, covariate, level));
            }
        }
    }
    all
}

/// The rows nearest to both values of each contrast, at most [`MOST_CONDITIONS`]; the last row if there is no contrast.
pub(super) fn anchors(data: &Data, rows: &[usize], contrasts: &[Contrast]) -> Vec<Condition> {
    let mut chosen: Vec<usize> = Vec::new();
    for contrast in contrasts.iter().take(MOST_CONDITIONS / 2) {
        let column = data.column(&contrast.covariate).expect("a contrast is one of a column");
        for value in &contrast.values {
            let row = nearest(column, rows, value);
            if let Some(row) = row.filter(|row| !chosen.contains(row)) {
                chosen.push(row);
            }
        }
    }
    if chosen.is_empty() {
        chosen.extend(rows.last());
    }
    chosen.into_iter().map(Condition::of_row).collect()
}

/// The row whose value is nearest; of several the last.
fn nearest(column: &Column, rows: &[usize], value: &CovariateValue) -> Option<usize> {
    match (&column.values, value) {
        (Values::Numbers(values), CovariateValue::Number(wanted)) => {
            let known = rows.iter().copied().filter(|row| values[*row].is_finite());
            known.min_by(|a, b| (values[*a] - wanted).abs().total_cmp(&(values[*b] - wanted).abs()))
        }
        (Values::Categories(names, indices), CovariateValue::Category(wanted)) => {
            rows.iter().rev().copied().find(|row| indices[*row].is_some_and(|index| names[index] == *wanted))
        }
        _ => None,
    }
}

/// All combinations of the values of two contrasts, in the conditions of the last row otherwise.
pub(super) fn combinations(row: usize, a: &Contrast, b: &Contrast) -> Vec<Condition> {
    let mut all = Vec::new();
    for first in &a.values {
        for second in &b.values {
            let mut condition = Condition::of_row(row);
            condition.changed.insert(a.covariate.clone(), first.clone());
            condition.changed.insert(b.covariate.clone(), second.clone());
            all.push(condition);
        }
    }
    all
}
