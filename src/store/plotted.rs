//! The values of an assessment that a plot over time needs, packed into one column, so that a window of a hundred thousand
//! batches is plotted without reading the rows of their quantities.

use crate::assessment::Assessment;
use crate::trust::TrustVerdict;

use super::column::{bad_row, to_blob};
use super::error::Error;

/// Number of values of the trust, which come first: p-value, 1 if rejected, number of findings.
const OF_TRUST: usize = 3;
/// Number of values of a quantity: mean and its interval, probability of damage and its interval.
const OF_A_QUANTITY: usize = 6;

/// P-value, 1 if rejected, number of findings. A missing p-value is NaN.
pub(super) fn trust_values(p_value: Option<f64>, verdict: TrustVerdict, findings: usize) -> [f64; OF_TRUST] {
    let rejected = if verdict == TrustVerdict::Rejected { 1.0 } else { 0.0 };
    [p_value.unwrap_or(f64::NAN), rejected, findings as f64]
}

/// The column of an assessment. Missing values are NaN.
pub(super) fn pack(a: &Assessment) -> Vec<u8> {
    let trust = trust_values(a.trust.p_value, a.trust.verdict, a.trust.findings.len());
    let ends = |interval: Option<[f64; 2]>| interval.unwrap_or([f64::NAN; 2]);
    let quantities = a.quantities.iter().flat_map(|q| {
        let [mean_low, mean_high] = ends(q.mean_interval);
        let probability = q.damage.as_ref().map_or(f64::NAN, |d| d.probability_of_damage);
        let [low, high] = ends(q.damage.as_ref().and_then(|d| d.probability_interval));
        [q.mean, mean_low, mean_high, probability, low, high]
    });
    to_blob(trust.into_iter().chain(quantities))
}

/// The column of an assessment, without a copy of its values.
pub(super) struct Plotted<'a> {
    values: &'a [[u8; 8]],
}

/// The values of a quantity in the column.
pub(super) struct PlottedQuantity {
    pub(super) mean: f64,
    pub(super) mean_interval: [Option<f64>; 2],
    pub(super) probability: f64,
    pub(super) probability_interval: [Option<f64>; 2],
}

impl<'a> Plotted<'a> {
    /// Checks the length of the column of an assessment with this number of quantities.
    pub(super) fn read(blob: &'a [u8], quantities: usize) -> Result<Self, Error> {
        let (values, rest) = blob.as_chunks::<8>();
        if rest.is_empty() && values.len() == OF_TRUST + OF_A_QUANTITY * quantities {
            Ok(Self { values })
        } else {
            Err(bad_row("assessment")(&format!(
                "the column for plots has {} bytes, which does not fit {quantities} quantities",
                blob.len()
            )))
        }
    }

    /// As [`trust_values`].
    pub(super) fn trust(&self) -> [f64; OF_TRUST] {
        std::array::from_fn(|i| f64::from_le_bytes(self.values[i]))
    }

    /// A quantity by its position.
    pub(super) fn quantity(&self, position: usize) -> PlottedQuantity {
        let value = |i: usize| f64::from_le_bytes(self.values[OF_TRUST + OF_A_QUANTITY * position + i]);
        let end = |i: usize| Some(value(i)).filter(|v| !v.is_nan());
        PlottedQuantity {
            mean: value(0),
            mean_interval: [end(1), end(2)],
            probability: value(3),
            probability_interval: [end(4), end(5)],
        }
    }
}
