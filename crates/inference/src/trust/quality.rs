//! Plausibility checks of the measurements that need no simulation: equal modes, order of the modes, repeated values, outliers.

use super::finding::{too_many, Finding, FindingCode, FindingEffect};
use super::rounding::is_coarse;
use structures::measurement::order::Disorder;
use structures::measurement::ModalMeasurement;
use structures::quantity::Hertz;
use structures::stats;

/// Fewest values of a mode from which their scatter is judged.
const FEWEST: usize = 8;

/// Distance from the median, in robust standard deviations, beyond which a value is an outlier.
const FAR: f64 = 8.0;

/// Largest share of the frequencies of a mode that are set aside as outliers.
const MOST_FAR: f64 = 0.25;

/// The findings, and the measurements left to assess.
#[derive(Debug, Clone)]
pub struct Inspection {
    /// The measurements to assess, modes in ascending order, with their index in the batch; empty only if none has a frequency.
    pub kept: Vec<(usize, ModalMeasurement)>,
    /// The findings.
    pub findings: Vec<Finding>,
}

/// Inspects the measurements of a batch; `previous` are the frequencies of the last measurement of the same source before it.
pub fn inspect(measurements: &[ModalMeasurement], previous: Option<&[Option<Hertz>]>) -> Inspection {
    let mut findings = Vec::new();
    let mut kept: Vec<(usize, ModalMeasurement)> = measurements.iter().cloned().enumerate().collect();
    drop_empty(&mut kept, &mut findings);
    drop_coinciding(&mut kept, &mut findings);
    sort_modes(&mut kept, &mut findings);
    // Values rounded to coarse steps coincide by chance.
    if !is_coarse(&kept) {
        drop_repeats(&mut kept, previous, &mut findings);
    }
    set_outliers_aside(&mut kept, &mut findings);
    Inspection { kept, findings }
}

/// Leaves out measurements of which no mode was identified.
fn drop_empty(kept: &mut Vec<(usize, ModalMeasurement)>, findings: &mut Vec<Finding>) {
    let (empty, rest): (Vec<_>, Vec<_>) =
        kept.drain(..).partition(|(_, m)| m.frequencies_hz.iter().all(Option::is_none));
    if !empty.is_empty() {
        let count = empty.len() + rest.len();
        let message = format!("{} of {count} measurements have no frequency and are left out", empty.len());
        let indices = empty.into_iter().map(|(index, _)| index).collect();
        findings.push(Finding::new(FindingCode::NotUsable, FindingEffect::Note, message).of(indices));
    }
    *kept = rest;
}

/// Leaves out measurements with two equal frequencies: one peak was taken for two modes, which says nothing about the other
/// measurements. The batch is rejected if they are more than half of it.
fn drop_coinciding(kept: &mut Vec<(usize, ModalMeasurement)>, findings: &mut Vec<Finding>) {
    let equal = |m: &ModalMeasurement| Disorder::of(&m.frequencies_hz).filter(Disorder::is_equal);
    let found: Vec<(usize, Disorder)> = kept.iter().filter_map(|(index, m)| Some((*index, equal(m)?))).collect();
    let Some((_, example)) = found.first() else { return };
    let (bad, all) = (found.len(), kept.len());
    let many = 2 * bad > all;
    let rest = if many { "" } else { ", and are left out" };
    let message =
        format!("{bad} of {all} measurements have two modes with the same frequency{rest} (in the first, {example})");
    let effect = if many { FindingEffect::Reject } else { FindingEffect::Note };
    let indices: Vec<usize> = found.iter().map(|(index, _)| *index).collect();
    findings.push(Finding::new(FindingCode::ModesCoincide, effect, message).of(indices.clone()));
    if !many {
        kept.retain(|(index, _)| !indices.contains(index));
    }
}

/// Reports measurements whose modes are out of order. A few are left out. When there are many, the batch is rejected, and the modes
/// are sorted so that its figures can still be computed.
fn sort_modes(kept: &mut Vec<(usize, ModalMeasurement)>, findings: &mut Vec<Finding>) {
    let mut swapped = Vec::new();
    let mut example = String::new();
    for (index, measurement) in kept.iter_mut() {
        let present: Vec<usize> =
            (0..measurement.frequencies_hz.len()).filter(|&i| measurement.frequencies_hz[i].is_some()).collect();
        let value = |m: &ModalMeasurement, mode: usize| m.frequencies_hz[mode].map_or(0.0, Hertz::get);
        let Some(pair) = present.windows(2).find(|pair| value(measurement, pair[1]) < value(measurement, pair[0]))
        else {
            continue;
        };
        if swapped.is_empty() {
            let (low, high) = (value(measurement, pair[0]), value(measurement, pair[1]));
            example = format!("mode {} at {low} Hz is not below mode {} at {high} Hz", pair[0] + 1, pair[1] + 1);
        }
        swapped.push(*index);
        let mut order = present.clone();
        order.sort_by(|&a, &b| value(measurement, a).total_cmp(&value(measurement, b)));
        let before = measurement.clone();
        for (&to, &from) in present.iter().zip(&order) {
            measurement.frequencies_hz[to] = before.frequencies_hz[from];
            if let (Some(now), Some(then)) = (&mut measurement.std_hz, &before.std_hz) {
                now[to] = then[from];
            }
            if let (Some(now), Some(then)) = (&mut measurement.mode_shapes, &before.mode_shapes) {
                now[to].clone_from(&then[from]);
            }
        }
    }
    if !swapped.is_empty() {
        let many = too_many(swapped.len(), kept.len());
        let message = format!(
            "modes are out of order in {} of {} measurements (in the first, {example}) and seem to be swapped; {}",
            swapped.len(),
            kept.len(),
            if many { "the figures are computed with ascending frequencies" } else { "these are left out" }
        );
        let effect = if many { FindingEffect::Reject } else { FindingEffect::Note };
        findings.push(Finding::new(FindingCode::ModesSwapped, effect, message).of(swapped.clone()));
        if !many {
            kept.retain(|(index, _)| !swapped.contains(index));
        }
    }
}

/// Leaves out measurements whose frequencies equal those of an earlier one. The batch is rejected if all are equal.
fn drop_repeats(
    kept: &mut Vec<(usize, ModalMeasurement)>,
    previous: Option<&[Option<Hertz>]>,
    findings: &mut Vec<Finding>,
) {
    let count = kept.len();
    let repeats: Vec<usize> = kept
        .iter()
        .enumerate()
        .filter(|(row, (_, m))| {
            let same = |other: &[Option<Hertz>]| other == m.frequencies_hz.as_slice();
            kept[..*row].iter().any(|(_, earlier)| same(&earlier.frequencies_hz)) || previous.is_some_and(same)
        })
        .map(|(row, _)| row)
        .collect();
    if repeats.is_empty() {
        return;
    }
    let indices: Vec<usize> = repeats.iter().map(|&row| kept[row].0).collect();
    // Either all measurements repeat the one before the batch, or all repeat the first one of the batch.
    if repeats.len() == count || (count >= 3 && repeats.len() + 1 == count) {
        let message = match count {
            1 => {
                "the frequencies equal those of the previous measurement to the last digit: the sensor or its gateway hangs"
                    .to_owned()
            }
            _ => format!(
                "all {count} measurements have the same frequencies to the last digit: the sensor or its gateway hangs"
            ),
        };
        findings.push(Finding::new(FindingCode::NoScatter, FindingEffect::Reject, message));
        kept.truncate(1);
        return;
    }
    let message =
        format!("{} of {count} measurements repeat an earlier one to the last digit and are left out", repeats.len());
    findings.push(Finding::new(FindingCode::StaleRepeat, FindingEffect::Note, message).of(indices.clone()));
    kept.retain(|(index, _)| !indices.contains(index));
}

/// Takes a mode out of a measurement.
pub(super) fn drop_mode(measurement: &mut ModalMeasurement, mode: usize) {
    measurement.frequencies_hz[mode] = None;
    if let Some(stds) = &mut measurement.std_hz {
        stds[mode] = None;
    }
    if let Some(shapes) = &mut measurement.mode_shapes {
        shapes[mode] = None;
    }
}

/// A frequency far from those that the other measurements have of the same mode.
struct Far {
    /// Position of the measurement among those kept.
    row: usize,
    mode: usize,
    text: String,
}

/// The frequencies that lie far from those of the other measurements, mode by mode.
fn far_from_the_others(kept: &[(usize, ModalMeasurement)]) -> Vec<Far> {
    let modes = kept.first().map_or(0, |(_, m)| m.frequencies_hz.len());
    let mut far = Vec::new();
    for mode in 0..modes {
        let log = |(row, (_, m)): (usize, &(usize, ModalMeasurement))| Some((row, m.frequencies_hz[mode]?.get().ln()));
        let logs: Vec<(usize, f64)> = kept.iter().enumerate().filter_map(log).collect();
        if logs.len() < FEWEST {
            continue;
        }
        let values: Vec<f64> = logs.iter().map(|(_, x)| *x).collect();
        let median = stats::quantile(&values, 0.5);
        let deviations: Vec<f64> = values.iter().map(|x| (x - median).abs()).collect();
        // 1.4826 times the median absolute deviation of a normal distribution is its standard deviation.
        let spread = 1.4826 * stats::quantile(&deviations, 0.5);
        if spread <= 0.0 {
            continue;
        }
        far.extend(logs.into_iter().filter(|(_, x)| (x - median).abs() > FAR * spread).map(|(row, x)| Far {
            row,
            mode,
            text: format!(
                "measurement {} has mode {} at {:.6} Hz, where the others lie at {:.6} Hz ± {:.2} %",
                kept[row].0,
                mode + 1,
                x.exp(),
                median.exp(),
                100.0 * spread
            ),
        }));
    }
    far
}

/// Sets aside single frequencies far from those of the other measurements: another peak was taken, or a digit mistyped, which says nothing
/// about the other modes. A measurement of which most frequencies are far is left out. The batch is rejected where too many measurements, or
/// too many frequencies of a mode, are far: it then mixes two states of the structure.
fn set_outliers_aside(kept: &mut Vec<(usize, ModalMeasurement)>, findings: &mut Vec<Finding>) {
    let far = far_from_the_others(kept);
    if far.is_empty() {
        return;
    }
    let (count, modes) = (kept.len(), kept[0].1.frequencies_hz.len());
    let of_row = |row: usize| far.iter().filter(|far| far.row == row).count();
    let present = |m: &ModalMeasurement| m.frequencies_hz.iter().flatten().count();
    let whole: Vec<usize> =
        (0..count).filter(|row| of_row(*row) > 1 && 2 * of_row(*row) > present(&kept[*row].1)).collect();
    let crowded = (0..modes).find(|mode| {
        let with_mode = kept.iter().filter(|(_, m)| m.frequencies_hz[*mode].is_some()).count();
        far.iter().filter(|far| far.mode == *mode).count() as f64 > MOST_FAR * with_mode as f64
    });
    let mut indices: Vec<usize> = far.iter().map(|far| kept[far.row].0).collect();
    indices.sort_unstable();
    indices.dedup();
    let examples: Vec<String> = far.iter().take(3).map(|far| far.text.clone()).collect();
    let examples = examples.join("; ");
    if crowded.is_some() || too_many(whole.len(), count) {
        let message = format!(
            "{} of {count} measurements lie far from the others ({examples}): the batch mixes two states or two instruments",
            indices.len()
        );
        findings.push(Finding::new(FindingCode::Outlier, FindingEffect::Reject, message).of(indices));
        return;
    }
    for far in &far {
        drop_mode(&mut kept[far.row].1, far.mode);
    }
    let single = far.iter().filter(|far| !whole.contains(&far.row)).count();
    let mut parts = Vec::new();
    match single {
        0 => {}
        1 => parts.push("1 frequency is an outlier and is set aside".to_owned()),
        _ => parts.push(format!("{single} frequencies are outliers and are set aside")),
    }
    if !whole.is_empty() {
        parts.push(format!("{} of {count} measurements are outliers and are left out", whole.len()));
    }
    let message = format!("{}: {examples}", parts.join("; "));
    findings.push(Finding::new(FindingCode::Outlier, FindingEffect::Note, message).of(indices));
    let mut row = 0;
    kept.retain(|(_, measurement)| {
        row += 1;
        !whole.contains(&(row - 1)) && present(measurement) > 0
    });
}
