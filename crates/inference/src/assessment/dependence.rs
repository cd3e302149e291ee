//! How the measurements of a batch or a reference follow one another, and what that means for its intervals and limits.

use crate::damage::{Informed, QuantitySamples, UndamagedReference};
use crate::hierarchy::Serial;
use crate::trust::{Finding, FindingCode, FindingEffect};
use structures::measurement::ModalMeasurement;
use structures::quantity::Timestamp;

/// A reference over less time than this has not seen how batches differ from day to day, s.
const SHORT_PERIOD_S: f64 = 86_400.0;

/// A longer pause between two batches than this multiple of the median is an outage.
const MOST_PAUSE: f64 = 10.0;

/// Length of a year, s.
const YEAR_S: f64 = 365.25 * 86_400.0;

/// Median time between successive measurements of some batches, s; `None` where their times are equal.
fn step_s(batches: &[&[ModalMeasurement]]) -> Option<f64> {
    let steps = |batch: &&[ModalMeasurement]| {
        let mut times: Vec<i64> = batch.iter().map(|m| m.measured_at.micros()).collect();
        times.sort_unstable();
        times.windows(2).map(|pair| pair[1] - pair[0]).collect::<Vec<i64>>()
    };
    let mut all: Vec<i64> = batches.iter().flat_map(steps).collect();
    all.sort_unstable();
    all.get(all.len() / 2).filter(|step| **step > 0).map(|step| *step as f64 / 1e6)
}

/// Number of batches in a year at the rhythm of some batches; `None` where their times do not tell.
///
/// ```text
///  rate = 1/mean of min(pause, 10 × median pause)
/// ```
///
/// An outage of weeks is thus no part of the rhythm, and missing days are.
pub(super) fn batches_per_year(batches: &[&[ModalMeasurement]]) -> Option<f64> {
    let mut times: Vec<i64> =
        batches.iter().filter_map(|batch| batch.iter().map(|m| m.measured_at.micros()).max()).collect();
    times.sort_unstable();
    let mut pauses: Vec<f64> = times.windows(2).map(|pair| (pair[1] - pair[0]) as f64 / 1e6).collect();
    pauses.sort_by(f64::total_cmp);
    let median = *pauses.get(pauses.len() / 2)?;
    let most = if median > 0.0 { MOST_PAUSE * median } else { f64::INFINITY };
    let mean = pauses.iter().map(|pause| pause.min(most)).sum::<f64>() / pauses.len() as f64;
    (mean > 0.0).then(|| YEAR_S / mean)
}

/// The correlation of the measurements of each quantity. A spring has that of its parameter.
fn serials(samples: &[QuantitySamples], sizes: &[usize], step_s: Option<f64>) -> Vec<Option<Serial>> {
    let tested = samples.iter().filter(|sample| sample.is_judged()).count();
    let one = |sample: &QuantitySamples| {
        let Informed { means, sizes, .. } = sample.informed(sizes);
        let mut start = 0;
        let cut = |size: &usize| {
            start += size;
            &means[start - size..start]
        };
        Serial::of(&sizes.iter().map(cut).collect::<Vec<_>>(), tested, step_s)
    };
    samples.iter().map(one).collect()
}

/// Number of independent measurements that those of batches of these sizes are worth, the fewest of all quantities.
pub(super) fn fewest(samples: &[QuantitySamples], sizes: &[usize]) -> Option<f64> {
    samples.iter().map(|sample| sample.effective(sizes).of_mean).reduce(f64::min)
}

/// Widens the populations behind the batches of a reference. The batches are pooled in `samples` one after another, each in the order of
/// time.
pub(super) fn within_batches(samples: &mut [QuantitySamples], sizes: &[usize], batches: &[&[ModalMeasurement]]) {
    let found = serials(samples, sizes, step_s(batches));
    for (sample, serial) in samples.iter_mut().zip(found) {
        sample.correlate(serial, sizes);
    }
}

/// Widens the populations behind a batch, and says so. What its reference knows about the correlation of successive measurements holds for
/// the batch as well, since few measurements do not show it by themselves; of both, the stronger correlation counts.
pub(super) fn within_batch(
    samples: &mut [QuantitySamples],
    measurements: &[ModalMeasurement],
    undamaged: Option<&UndamagedReference>,
) -> Option<Finding> {
    let count = samples.first().map_or(0, |sample| sample.pool.len() / sample.draws);
    let step = step_s(&[measurements]);
    let found = serials(samples, &[count], step);
    let known = |name: &str| {
        let quantity = undamaged?.quantities.iter().find(|q| q.name == name)?;
        Some(quantity.reference.serial?.at_step(step))
    };
    let mut correlated: Vec<&str> = Vec::new();
    let mut effective = count as f64;
    for (sample, own) in samples.iter_mut().zip(found) {
        let both = [own, known(&sample.name)];
        let strongest =
            both.into_iter().flatten().max_by(|a, b| a.inefficiency(count).total_cmp(&b.inefficiency(count)));
        sample.correlate(strongest, &[count]);
        if strongest.is_some() && sample.is_judged() {
            effective = effective.min(sample.effective(&[count]).of_mean);
            correlated.push(&sample.name);
        }
    }
    if correlated.is_empty() || count < 2 {
        return None;
    }
    let message = format!(
        "successive measurements of {} are correlated, so that {count} measurements are worth only {effective:.1} independent ones: \
         intervals and limits are wider",
        correlated.join(", ")
    );
    Some(Finding::new(FindingCode::CorrelatedMeasurements, FindingEffect::Note, message))
}

/// A doubt about a reference that has not seen how batches differ.
pub(super) fn short_period(batches: &[&[ModalMeasurement]]) -> Option<String> {
    let times = || batches.iter().flat_map(|batch| batch.iter()).map(|m| m.measured_at);
    let (first, last): (Timestamp, Timestamp) = (times().min()?, times().max()?);
    let hours = (last.micros() - first.micros()) as f64 / 3.6e9;
    let what = match batches.len() {
        1 => "all its measurements are of one batch".to_owned(),
        _ if hours * 3600.0 < SHORT_PERIOD_S => format!("its batches were measured within {hours:.1} hours"),
        _ => return None,
    };
    Some(format!(
        "{what}: how batches differ from day to day, with the weather for example, is not in it, and may raise false alarms; declare \
         batches of further days as soon as there are some"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn batch(hour: f64) -> Vec<ModalMeasurement> {
        let measured_at = Timestamp::from_micros((hour * 3.6e9) as i64).unwrap();
        let (frequencies_hz, std_hz, mode_shapes) = (vec![None], None, None);
        let (covariates, settings) = Default::default();
        vec![ModalMeasurement { measured_at, frequencies_hz, std_hz, mode_shapes, covariates, settings }]
    }

    fn rate(hours: impl IntoIterator<Item = f64>) -> Option<f64> {
        let batches: Vec<Vec<ModalMeasurement>> = hours.into_iter().map(batch).collect();
        batches_per_year(&batches.iter().map(Vec::as_slice).collect::<Vec<_>>())
    }

    #[test]
    fn an_outage_is_no_part_of_the_rhythm_and_missing_days_are() {
        let is = |found: Option<f64>, wanted: f64| assert!((found.unwrap() / wanted - 1.0).abs() < 0.03, "{found:?}");
        is(rate((0..60).map(|day| 24.0 * f64::from(day))), 365.25);
        is(rate((0..400).map(|day| 24.0 * f64::from(day) + if day < 200 { 0.0 } else { 5_000.0 })), 365.25);
        is(rate((0..200).filter(|day| day % 3 > 0).map(|day| 24.0 * f64::from(day))), 365.25 * 2.0 / 3.0);
        assert_eq!(rate([5.0]), None);
        assert_eq!(rate([5.0, 5.0, 5.0]), None);
    }
}
