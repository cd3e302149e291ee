//! The inputs of a learned discrepancy: covariates and settings that are not functions of time.

use crate::data::{Data, Origin, Values, MOST_LEVELS};
use structures::simulator::discrepancy::definition::InputDefinition;
use structures::simulator::discrepancy::input::MOST_INPUTS;
use structures::simulator::Simulator;
use structures::stats;

/// An input is refused if its rank correlation with time exceeds this.
pub const MOST_RANK_CORRELATION: f64 = 0.8;

/// Smallest share of the rows in which an input must be known.
const LEAST_KNOWN: f64 = 0.5;

/// Inputs for some rows, and those that were not taken.
#[derive(Debug, Clone, Default)]
pub struct Chosen {
    /// The inputs.
    pub inputs: Vec<InputDefinition>,
    /// A sentence for each covariate or setting that was refused because it is a function of time.
    pub refused: Vec<String>,
}

/// Chooses the inputs: every covariate and every setting that varies in the rows with the indices `rows`, except time and what is a
/// function of time there: a number that never falls or never rises, or whose rank correlation with time exceeds 0.8, and a category
/// each of whose values occurs in one period only.
///
/// A discrepancy over such an input could learn a loss of stiffness. In a table without times the order of the rows says nothing
/// about time, and nothing is refused.
pub fn choose(simulator: &Simulator, data: &Data, rows: &[usize]) -> Chosen {
    let mut chosen = Chosen::default();
    let timed = data.time_unit == "day";
    let mut add = |input: InputDefinition, with_time: Option<String>| {
        match with_time.filter(|_| timed) {
        Some(how) => chosen.refused.push(format!(
            "{} {how} in the rows that would be learned from: what depends on it could as well depend on time and be damage, so it \
             is not an input of the discrepancy",
            input.name()
        )),
        None if chosen.inputs.len() < MOST_INPUTS => chosen.inputs.push(input),
        None => {}
    }
    };
    for (k, parameter) in simulator.space().iter().enumerate() {
        let values: Vec<f64> = rows.iter().map(|row| data.settings[*row][k].unwrap_or(f64::NAN)).collect();
        if let Some(mut input) = numeric(&values) {
            input.setting = Some(parameter.name.clone());
            add(input, follows_time(&values));
        }
    }
    for column in data.columns.iter().filter(|c| c.origin == Origin::Covariate) {
        match &column.values {
            Values::Numbers(all) => {
                let values: Vec<f64> = rows.iter().map(|row| all[*row]).collect();
                if let Some(mut input) = numeric(&values) {
                    input.covariate = Some(column.name.clone());
                    add(input, follows_time(&values));
                }
            }
            Values::Categories(names, all) => {
                let indices: Vec<Option<usize>> = rows.iter().map(|row| all[*row]).collect();
                if let Some(mut input) = category(names, &indices) {
                    input.covariate = Some(column.name.clone());
                    let periods = occurs_in_periods(&indices);
                    add(input, periods.then(|| "has each of its values in one period only".to_owned()));
                }
            }
        }
    }
    chosen
}

/// The input for a number with these values, NaN if missing; `None` if it does not vary or is missing in most rows. Its name is not
/// set.
fn numeric(values: &[f64]) -> Option<InputDefinition> {
    let known: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
    if known.is_empty() || (known.len() as f64) < LEAST_KNOWN * values.len() as f64 {
        return None;
    }
    let (centre, scale) = (stats::mean(&known), stats::sample_std(&known)?);
    let size = known.iter().fold(0.0, |a: f64, v| a.max(v.abs()));
    let (low, high) = known.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(*v), h.max(*v)));
    (scale > 1e-9 * size).then(|| InputDefinition {
        covariate: None,
        setting: None,
        centre,
        scale,
        seen: Some([low, high]),
        levels: Vec::new(),
    })
}

/// The input for a category with these values; `None` if it does not vary, has too many categories or is missing in most rows.
fn category(names: &[String], indices: &[Option<usize>]) -> Option<InputDefinition> {
    let mut used: Vec<usize> = indices.iter().copied().flatten().collect();
    if (used.len() as f64) < LEAST_KNOWN * indices.len() as f64 {
        return None;
    }
    used.sort_unstable();
    used.dedup();
    (2..=MOST_LEVELS).contains(&used.len()).then(|| InputDefinition {
        covariate: None,
        setting: None,
        centre: 0.0,
        scale: 1.0,
        seen: None,
        levels: used.into_iter().map(|level| names[level].clone()).collect(),
    })
}

/// How a number follows time, in words, for its values in the order of time; `None` if it does not.
fn follows_time(values: &[f64]) -> Option<String> {
    let known: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
    if known.windows(2).all(|w| w[0] <= w[1]) {
        return Some("never falls with time".to_owned());
    }
    if known.windows(2).all(|w| w[0] >= w[1]) {
        return Some("never rises with time".to_owned());
    }
    let order: Vec<f64> = (0..known.len()).map(|row| row as f64).collect();
    let r = rank_correlation(&order, &known);
    (r.abs() > MOST_RANK_CORRELATION).then(|| format!("follows time (rank correlation {r:.2})"))
}

/// Whether each category occurs in one period only: the category changes no more often than it needs to for all of them to occur.
fn occurs_in_periods(indices: &[Option<usize>]) -> bool {
    let known: Vec<usize> = indices.iter().copied().flatten().collect();
    let changes = known.windows(2).filter(|w| w[0] != w[1]).count();
    let mut used = known;
    used.sort_unstable();
    used.dedup();
    changes < used.len()
}

/// Spearman's rank correlation of two series of the same length; equal values share their mean rank.
pub fn rank_correlation(a: &[f64], b: &[f64]) -> f64 {
    let (a, b) = (ranks(a), ranks(b));
    let (ma, mb) = (stats::mean(&a), stats::mean(&b));
    let sum = |x: &[f64], mx: f64, y: &[f64], my: f64| x.iter().zip(y).map(|(x, y)| (x - mx) * (y - my)).sum::<f64>();
    sum(&a, ma, &b, mb) / (sum(&a, ma, &a, ma) * sum(&b, mb, &b, mb)).sqrt().max(f64::MIN_POSITIVE)
}

fn ranks(values: &[f64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_by(|i, j| values[*i].total_cmp(&values[*j]));
    let mut ranks = vec![0.0; values.len()];
    let mut first = 0;
    while first < order.len() {
        let equal = order[first..].iter().take_while(|i| values[**i] <= values[order[first]]).count();
        for i in &order[first..first + equal] {
            ranks[*i] = first as f64 + 0.5 * (equal - 1) as f64;
        }
        first += equal;
    }
    ranks
}

/// Standardised inputs of all rows, `[n]`; `None` where one is missing or is a category that was not among the rows chosen from.
pub fn standardised(simulator: &Simulator, data: &Data, inputs: &[InputDefinition]) -> Vec<Option<Vec<f64>>> {
    let value = |input: &InputDefinition, row: usize| -> Option<f64> {
        if let Some(k) = input.setting.as_ref().and_then(|name| simulator.space().position(name)) {
            return data.settings[row][k].map(|v| input.standardised(v));
        }
        match &data.column(input.name())?.values {
            Values::Numbers(values) => Some(values[row]).filter(|v| v.is_finite()).map(|v| input.standardised(v)),
            Values::Categories(names, indices) => {
                let name = &names[indices[row]?];
                input.levels.iter().position(|level| level == name).map(|level| level as f64)
            }
        }
    };
    (0..data.rows()).map(|row| inputs.iter().map(|input| value(input, row)).collect()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_follows_time_is_recognised() {
        let wave: Vec<f64> = (0..100).map(|i| (0.3 * f64::from(i)).sin()).collect();
        assert_eq!(follows_time(&wave), None);
        let rising: Vec<f64> = (0..100).map(|i| f64::from(i) + 15.0 * wave[i as usize]).collect();
        assert!(follows_time(&rising).unwrap().contains("rank correlation"));
        let step: Vec<f64> = (0..100).map(|i| f64::from(u8::from(i > 80))).collect();
        assert!(follows_time(&step).unwrap().contains("never falls"));
        assert!(occurs_in_periods(&[Some(0), Some(0), Some(1), None, Some(1)]));
        assert!(!occurs_in_periods(&[Some(0), Some(1), Some(0), Some(1)]));
    }

    #[test]
    fn rank_correlation_ignores_scale_and_shares_ranks() {
        let a = [1.0, 2.0, 3.0, 4.0, 5.0];
        assert!((rank_correlation(&a, &a.map(|x| x.powi(5))) - 1.0).abs() < 1e-12);
        assert!((rank_correlation(&a, &a.map(|x| -x)) + 1.0).abs() < 1e-12);
        // Ranks 0, 1.5, 1.5, 3 against 0, 1, 2, 3: 4.5/√(5·4.5).
        let shared = rank_correlation(&[0.0, 1.0, 2.0, 3.0], &[0.0, 7.0, 7.0, 9.0]);
        assert!((shared - 4.5 / (5.0_f64 * 4.5).sqrt()).abs() < 1e-12);
    }
}
