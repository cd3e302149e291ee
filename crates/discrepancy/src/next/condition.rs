//! The conditions in which a further measurement is made.

use std::collections::{BTreeMap, BTreeSet};

use crate::data::{Column, Data, Origin, Values, TIME};
use crate::rank::Ranked;
use structures::measurement::CovariateValue;
use structures::stats;

/// Levels of the two quantiles of a numeric covariate at which its effect is measured.
const LOW_AND_HIGH: (f64, f64) = (0.05, 0.95);

/// Greatest number of conditions of one measurement.
const MOST_CONDITIONS: usize = 6;

/// Greatest number of categories in which the effect of a category is measured.
const MOST_CATEGORIES: usize = 4;

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

/// A covariate that candidates depend on, with values at which their predictions differ: two numbers, or categories.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Contrast {
    pub(super) covariate: String,
    pub(super) values: Vec<CovariateValue>,
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
    /// The contrast of a covariate in `rows`: two quantiles of a number; the category `level` and the most frequent other one; or,
    /// without a `level`, the most frequent categories, each of which may have an effect of its own. `None` for time and the time of day or year, which cannot
    /// be chosen, and for a covariate that does not vary.
    fn new(data: &Data, rows: &[usize], covariate: &str, level: Option<&str>) -> Option<Self> {
        let column = data.column(covariate).filter(|c| c.name != TIME && c.origin.cycle().is_none())?;
        let values = match &column.values {
            Values::Numbers(_) => {
                let numbers = column.numbers(rows);
                if numbers.is_empty() {
                    return None;
                }
                [LOW_AND_HIGH.0, LOW_AND_HIGH.1].map(|q| CovariateValue::Number(stats::quantile(&numbers, q))).to_vec()
            }
            Values::Categories(names, _) => {
                let counts = counts(column, rows);
                let mut frequent: Vec<usize> = counts.keys().copied().collect();
                frequent.sort_by_key(|index| std::cmp::Reverse(counts[index]));
                let mut chosen: Vec<&str> = frequent.into_iter().map(|index| names[index].as_str()).collect();
                if let Some(level) = level {
                    chosen.retain(|name| *name != level);
                    chosen.insert(0, level);
                }
                chosen.truncate(if level.is_some() { 2 } else { MOST_CATEGORIES });
                chosen.into_iter().map(|name| CovariateValue::Category(name.to_owned())).collect()
            }
        };
        (values.len() > 1 && values[0] != values[1]).then(|| Self { covariate: covariate.to_owned(), values })
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

/// The contrasts of the covariates that can be chosen on their own: those of `contrasts`, and the factors of the products among
/// them.
pub(super) fn single_covariates(data: &Data, rows: &[usize], contrasts: &[Contrast]) -> Vec<Contrast> {
    let mut all: Vec<Contrast> = Vec::new();
    for contrast in contrasts {
        let Some(column) = data.column(&contrast.covariate) else { continue };
        let own = match column.origin {
            Origin::Covariate => vec![contrast.clone()],
            Origin::Product(first, second) => {
                let factors = [first, second].map(|c| &data.columns[c]);
                let free = factors.into_iter().filter(|factor| factor.origin == Origin::Covariate);
                free.filter_map(|factor| Contrast::new(data, rows, &factor.name, None)).collect()
            }
            _ => Vec::new(),
        };
        for contrast in own {
            if !all.iter().any(|known| known.covariate == contrast.covariate) {
                all.push(contrast);
            }
        }
    }
    all
}

/// The rows nearest to the values of each contrast, at most [`MOST_CONDITIONS`]; the last row if there is no contrast.
pub(super) fn anchors(data: &Data, rows: &[usize], contrasts: &[Contrast]) -> Vec<Condition> {
    let mut chosen: Vec<usize> = Vec::new();
    for contrast in contrasts {
        let column = data.column(&contrast.covariate).expect("a contrast is one of a column");
        for value in &contrast.values {
            let row = nearest(column, rows, value);
            let represented = |known: &usize| same_category(column, *known, value);
            if let Some(row) = row.filter(|row| !chosen.contains(row) && !chosen.iter().any(represented)) {
                chosen.push(row);
            }
        }
    }
    chosen.truncate(MOST_CONDITIONS);
    if chosen.is_empty() {
        chosen.extend(rows.last());
    }
    chosen.into_iter().map(Condition::of_row).collect()
}

/// Whether a row has the category `value`.
fn same_category(column: &Column, row: usize, value: &CovariateValue) -> bool {
    match (&column.values, value) {
        (Values::Categories(names, indices), CovariateValue::Category(wanted)) => {
            indices[row].is_some_and(|index| names[index] == *wanted)
        }
        _ => false,
    }
}

/// The row whose value is nearest; of several the last.
fn nearest(column: &Column, rows: &[usize], value: &CovariateValue) -> Option<usize> {
    match (&column.values, value) {
        (Values::Numbers(values), CovariateValue::Number(wanted)) => {
            let known = rows.iter().copied().filter(|row| values[*row].is_finite());
            known.min_by(|a, b| (values[*a] - wanted).abs().total_cmp(&(values[*b] - wanted).abs()))
        }
        (Values::Categories(..), CovariateValue::Category(_)) => {
            rows.iter().rev().copied().find(|row| same_category(column, *row, value))
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
    all.truncate(MOST_CONDITIONS);
    all
}
