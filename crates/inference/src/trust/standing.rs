//! Findings that hold for every batch of a trained baseline.

use super::finding::{Finding, FindingCode, FindingEffect};
use crate::baseline::manifest::{CalibrationRecord, Outcome};
use crate::baseline::Baseline;

/// What a model means whose calibration was not measured.
const STARTING_MODEL: &str = "there is no trained model in use: the samples start at those of a network that was trained for a second, and the simulation \
     weighs each of them; whether the intervals hold the stated share of the true values was not measured, and they may be too narrow";

/// Failures of a calibration that a finding quotes.
const SHOWN_FAILURES: usize = 3;

/// What a calibration that did not pass means for the answers, with a few of its reasons; `None` for one that passed.
pub fn calibration_in_words(record: &CalibrationRecord) -> Option<String> {
    let (meaning, reasons) = match record.outcome() {
        Outcome::Passed | Outcome::NotMeasured => return None,
        Outcome::Cautious => (
            "the trained model in use is cautious: some intervals are wider than they need to be, and none is too narrow",
            &record.cautions,
        ),
        Outcome::Overconfident => (
            "the trained model in use is overconfident: some intervals are too narrow, and it is used only because it was accepted",
            &record.failures,
        ),
    };
    // A flow that was trained far too short fails in dozens of places; a few of them are enough to read.
    let some = reasons.iter().take(SHOWN_FAILURES).cloned().collect::<Vec<_>>().join("; ");
    let more = reasons.len().saturating_sub(SHOWN_FAILURES);
    let more = if more > 0 { format!("; and {more} more, see its manifest") } else { String::new() };
    Some(format!("{meaning}: {some}{more}"))
}

/// Findings about the trained baseline itself: overconfidence, parameters that it cannot distinguish, a doubtful emulator.
pub fn standing_findings(baseline: &Baseline) -> Vec<Finding> {
    let record = &baseline.manifest().calibration;
    let overconfident = record.outcome() == Outcome::Overconfident;
    let uncalibrated = calibration_in_words(record)
        .filter(|_| overconfident)
        .map(|message| Finding::new(FindingCode::Uncalibrated, FindingEffect::Note, message));
    let starting = (record.outcome() == Outcome::NotMeasured)
        .then(|| Finding::new(FindingCode::StartingModel, FindingEffect::Note, STARTING_MODEL.to_owned()));
    let grouped = baseline.groups().into_iter().map(|group| {
        let names: Vec<&str> = group.columns.iter().map(|&k| baseline.space().as_slice()[k].name.as_str()).collect();
        let message = format!(
            "these modes cannot distinguish {}: damage is assessed for their mean, {}, and not for each of them",
            names.join(" and "),
            group.name
        );
        Finding::new(FindingCode::NotIdentifiable, FindingEffect::Note, message)
    });
    // Parameters of different kinds cannot be averaged: the pair is reported, and each keeps its own figures.
    let parameters = &baseline.manifest().identifiability.parameters;
    let grouped_names: Vec<&String> = baseline.manifest().identifiability.groups.iter().flatten().collect();
    let confused = parameters.iter().filter(|p| !grouped_names.contains(&&p.name) && p.is_confused()).map(|p| {
        let other = p.confused_with.as_ref().map_or("another parameter", |(name, _)| name.as_str());
        let message =
            format!("these modes hardly distinguish {} from {other}: damage of one may appear in the other", p.name);
        Finding::new(FindingCode::NotIdentifiable, FindingEffect::Note, message)
    });
    let simulation = baseline.simulator().warnings().into_iter();
    let doubtful = simulation.map(|message| Finding::new(FindingCode::EmulatorDoubtful, FindingEffect::Note, message));
    uncalibrated.into_iter().chain(starting).chain(grouped).chain(confused).chain(doubtful).collect()
}
