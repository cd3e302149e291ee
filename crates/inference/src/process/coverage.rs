//! The conditions that the batches of a reference have seen, and what lies beyond them.

use nalgebra::{DMatrix, DVector, RowDVector};
use serde::{Deserialize, Serialize};

use super::estimate::{BatchEstimate, Scale};
use structures::measurement::unit_of_name;

/// Beyond the range seen, the slope of a quantity over a covariate is known to within this multiple of itself: it may vanish or double.
/// The stiffness of a bridge deck that freezes, for example, rises several times faster below 0 °C than above.
const BEND: f64 = 1.0;

/// Names of the months.
const MONTHS: [&str; 12] = [
    "January",
    "February",
    "March",
    "April",
    "May",
    "June",
    "July",
    "August",
    "September",
    "October",
    "November",
    "December",
];

/// The conditions that the batches of a reference have seen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Coverage {
    /// Months of the year in which a batch was measured, 1 to 12, in UTC, ascending.
    pub months: Vec<u8>,
    /// Smallest and largest mean of each covariate over a batch, in its unit, `[m]`; `None` where it was never measured.
    pub covariates: Vec<Option<[f64; 2]>>,
    /// Units of the covariates, `[m]`; `None` where there is none. Empty in references of earlier versions of the program.
    #[serde(default)]
    pub units: Vec<Option<String>>,
}

impl Coverage {
    /// What the batches behind a process have seen.
    pub(super) fn of(covariates: usize, estimates: &[BatchEstimate]) -> Self {
        let mut months: Vec<u8> = estimates.iter().map(|e| e.at.month()).collect();
        months.sort_unstable();
        months.dedup();
        let covariate = |j: usize| range(estimates.iter().filter_map(|e| e.covariates[j]));
        Self { months, covariates: (0..covariates).map(covariate).collect(), units: Vec::new() }
    }

    /// Variances by which the prediction of each quantity is wider, because covariates c lie beyond what was seen, `[d]`, standardised.
    ///
    /// ```text
    ///  BEND² Σ_j B_kj² e(c_j)²,    e: distance from the range that was seen
    /// ```
    ///
    /// `slopes`: B, `[d, m]`; `covariates`: `[m]`; both standardised by `scales`. The common factors are not treated so: a loss moves
    /// them as well, and would hide itself.
    pub(super) fn widening(&self, slopes: &DMatrix<f64>, scales: &[Scale], covariates: &DVector<f64>) -> DVector<f64> {
        let beyond = |j: usize| {
            self.covariates[j]
                .map_or(0.0, |range| distance(covariates[j], range.map(|end| scales[j].standardised(end))))
        };
        let beyond: Vec<f64> = (0..self.covariates.len()).map(beyond).collect();
        let variance = |slopes: RowDVector<f64>| -> f64 {
            slopes.iter().zip(&beyond).map(|(slope, distance)| (BEND * slope * distance).powi(2)).sum()
        };
        DVector::from_iterator(slopes.nrows(), slopes.row_iter().map(|row| variance(row.into_owned())))
    }

    /// The conditions of a batch that were not seen, each in some words. `names`: names of the covariates.
    pub(super) fn not_seen(&self, names: &[String], estimate: &BatchEstimate) -> Vec<String> {
        let month = estimate.at.month();
        let mut found = Vec::new();
        if !self.months.contains(&month) {
            found.push(MONTHS[usize::from(month) - 1].to_owned());
        }
        for (j, ((name, range), value)) in names.iter().zip(&self.covariates).zip(&estimate.covariates).enumerate() {
            let (Some([low, high]), Some(value)) = (range, value) else { continue };
            if distance(*value, [*low, *high]) > 0.0 {
                let stated = self.units.get(j).and_then(Option::as_deref);
                let unit = stated.or_else(|| unit_of_name(name)).map_or_else(String::new, |unit| format!(" {unit}"));
                let seen = format!("{value:.1}{unit} (seen: {low:.1} to {high:.1}{unit})").replace('-', "−");
                found.push(format!("{name} of {seen}"));
            }
        }
        found
    }
}

/// Distance of a value from a range; 0 inside.
fn distance(value: f64, [low, high]: [f64; 2]) -> f64 {
    (low - value).max(value - high).max(0.0)
}

/// Smallest and largest value; `None` without any.
fn range(values: impl Iterator<Item = f64>) -> Option<[f64; 2]> {
    values.fold(None, |range, value| match range {
        None => Some([value; 2]),
        Some([low, high]) => Some([f64::min(low, value), f64::max(high, value)]),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use structures::quantity::Timestamp;

    fn january(value: f64) -> BatchEstimate {
        let at = Timestamp::parse("2026-01-10T00:00:00Z").unwrap();
        BatchEstimate { at, mean: Vec::new(), covariance: Vec::new(), covariates: vec![Some(value)] }
    }

    /// What is said of a value of 8.8 in January, of a covariate that was between −4.6 and 8.6 then.
    fn said(name: &str, units: Vec<Option<String>>) -> Vec<String> {
        let coverage = Coverage { units, ..Coverage::of(1, &[january(-4.6), january(8.6)]) };
        coverage.not_seen(&[name.to_owned()], &january(8.8))
    }

    #[test]
    fn weather_that_was_not_seen_is_said_with_its_unit() {
        let stated = said("temperature", vec![Some("°C".to_owned())]);
        assert_eq!(stated, ["temperature of 8.8 °C (seen: −4.6 to 8.6 °C)"]);
        // References of earlier versions of the program have no units; those of names with a known ending are certain.
        assert_eq!(said("temperature_c", Vec::new()), ["temperature_c of 8.8 °C (seen: −4.6 to 8.6 °C)"]);
        assert_eq!(said("moisture", vec![None]), ["moisture of 8.8 (seen: −4.6 to 8.6)"]);
    }

    #[test]
    fn a_reference_of_an_earlier_version_without_units_is_read() {
        let read: Coverage = serde_json::from_str(r#"{"months": [1], "covariates": [[-4.6, 8.6]]}"#).unwrap();
        assert_eq!(read, Coverage::of(1, &[january(-4.6), january(8.6)]));
    }
}
