//! The verdict about a structure: one state and one sentence, from the alarm charts of the newest undamaged reference alone.
//!
//! A probability of damage above that of the reference is no verdict: one of twenty healthy batches shows it.

use std::fmt::Write as _;
use std::sync::Arc;

use serde::Serialize;
use utoipa::ToSchema;

use crate::alarm::chart::FIT_SERIES;
use crate::alarm::machine::State as AlarmState;
use crate::baseline::Baseline;
use crate::clock;
use crate::monitor::stored::{Episode, RelativeChange, StructureOverview};
use crate::monitor::{Error, Monitor};
use crate::parameter::in_words;
use crate::process::lasting::{LastingChange, QuantityChange};
use crate::process::reference::JOINT_SERIES;
use crate::quantity::{Digest, Timestamp};

/// A batch that waits longer for its assessment than this is not one that has just arrived, µs.
const JUST_ARRIVED_US: i64 = 5_000_000;

/// What is known about the condition of a structure.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub(super) enum Condition {
    /// A chart is in alarm.
    Alarming,
    /// A chart was in alarm and is below its limit again, but not yet for long enough.
    Recovering,
    /// No measurement for longer than is usual or configured.
    Silent,
    /// There is no trained model.
    NoModel,
    /// No batch has been assessed.
    Unassessed,
    /// Batches wait for their assessment, for example after a new model or a new undamaged reference.
    Judging,
    /// There is no undamaged reference for the trained model in use, or no batch was compared with it, or none of the newest could be.
    NotJudged,
    /// A point is above a limit, but not yet enough of them for an alarm.
    Pending,
    /// All charts are inside their limits.
    Normal,
}

impl Condition {
    /// Its name in answers and metrics.
    pub(super) const fn as_str(self) -> &'static str {
        match self {
            Self::Alarming => "alarming",
            Self::Recovering => "recovering",
            Self::Silent => "silent",
            Self::NoModel => "no_model",
            Self::Unassessed => "unassessed",
            Self::Judging => "judging",
            Self::NotJudged => "not_judged",
            Self::Pending => "pending",
            Self::Normal => "normal",
        }
    }
}

/// The verdict about a structure.
#[derive(Debug)]
pub(super) struct Verdict {
    /// The most serious condition that applies.
    pub condition: Condition,
    /// The verdict in one or two sentences: what has changed by how much since when, or why there is no verdict.
    pub sentence: String,
    /// Opening of the oldest open damage alarm.
    pub alarm_since: Option<Timestamp>,
}

/// A structure with its verdict.
pub(super) struct Judged {
    pub found: StructureOverview,
    /// The trained model in use, or why there is none.
    pub model: Result<Arc<Baseline>, String>,
    pub verdict: Verdict,
}

impl Judged {
    /// All structures, by id.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub(super) async fn all(monitor: &Monitor) -> Result<Vec<Self>, Error> {
        let (structures, mut open) = monitor.records().overview().await?;
        let now = clock::now();
        let judged = |found: StructureOverview| {
            let active = monitor.structure(&found.id).map_err(|refused| refused.to_string());
            let model = active.and_then(|active| active.baseline.clone());
            let open = open.remove(&found.id).unwrap_or_default();
            let verdict = verdict(&found, model.as_ref().ok().map(|model| model.digest()), &open, now);
            Self { found, model, verdict }
        };
        Ok(structures.into_iter().map(judged).collect())
    }
}

/// The verdict about a structure at a time: `model` is the digest of the trained model in use, `open` are its open damage alarms.
fn verdict(found: &StructureOverview, model: Option<&Digest>, open: &[Episode], now: Timestamp) -> Verdict {
    let condition = condition(found, model, now);
    Verdict {
        sentence: sentence(found, model, open, condition),
        condition,
        alarm_since: open.iter().map(|episode| episode.opened_at).min(),
    }
}

fn condition(found: &StructureOverview, model: Option<&Digest>, now: Timestamp) -> Condition {
    // With a process, the chart of all parameters together raises the alarms.
    let together = found.charts.contains_key(JOINT_SERIES);
    let raises = |series: &str| !together || [JOINT_SERIES, FIT_SERIES].contains(&series);
    let on_a_chart = |state: AlarmState| found.charts.iter().any(|(series, own)| raises(series) && *own == state);
    let waits = found.waiting_since.is_some_and(|since| since.micros() < now.micros() - JUST_ARRIVED_US);
    if on_a_chart(AlarmState::Alarming) {
        Condition::Alarming
    } else if on_a_chart(AlarmState::Recovering) {
        Condition::Recovering
    } else if found.silent {
        Condition::Silent
    } else if model.is_none() {
        Condition::NoModel
    } else if found.failing {
        Condition::NotJudged
    } else if waits {
        Condition::Judging
    } else if found.latest.is_none() {
        Condition::Unassessed
    } else if why_not_judged(found, model).is_some() {
        Condition::NotJudged
    } else if on_a_chart(AlarmState::Pending) {
        Condition::Pending
    } else {
        Condition::Normal
    }
}

/// Why the batches are not judged, if they are not.
fn why_not_judged(found: &StructureOverview, model: Option<&Digest>) -> Option<String> {
    if found.failing && found.undamaged_model.as_ref().is_none_or(|own| Some(own) == model) {
        let latest = found.latest.as_ref().and_then(|latest| latest.unjudged.as_ref());
        return Some(match latest {
            Some(reason) => {
                format!("Not judged: none of the newest batches moves a chart. The latest that was assessed: {reason}.")
            }
            None => "Not judged: none of the newest batches moves a chart; the reason is stated with each of them."
                .to_owned(),
        });
    }
    let Some(version) = found.undamaged_version else {
        return Some("Not judged: no undamaged reference has been declared.".to_owned());
    };
    if found.undamaged_model.as_ref() != model {
        return Some(format!(
            "Not judged: the undamaged reference, version {version}, was made with another trained model. Declare it again."
        ));
    }
    let compared = found.charts.keys().any(|series| series != FIT_SERIES);
    (!compared)
        .then(|| format!("Not judged yet: no batch has been compared with the undamaged reference, version {version}."))
}

fn sentence(found: &StructureOverview, model: Option<&Digest>, open: &[Episode], condition: Condition) -> String {
    let mut sentence = match condition {
        Condition::Alarming | Condition::Recovering => in_alarm(found, open),
        Condition::Silent => match found.last_measured_at {
            Some(at) => format!("No measurement since {}.", at.day()),
            None => "No measurement for longer than is usual or configured.".to_owned(),
        },
        Condition::NoModel if found.batches == 0 => {
            "Not judged: there are no measurements yet, and no trained model.".to_owned()
        }
        Condition::NoModel => "Not judged: there is no trained model for this structure.".to_owned(),
        Condition::Unassessed => "No batch has been assessed yet.".to_owned(),
        Condition::Judging => {
            format!("Judging: {} of {} batches are assessed.", found.batches - found.waiting, found.batches)
        }
        Condition::NotJudged => why_not_judged(found, model).unwrap_or_default(),
        Condition::Pending => format!(
            "{} above its limit; the next batches decide whether this is an alarm.",
            names_in(found, AlarmState::Pending)
        ),
        Condition::Normal => match &found.change {
            Some(change) => {
                format!("No alarm. What has changed is too small for one: {}.", of_change(change).join("; "))
            }
            None => "No alarm: all charts are inside their limits.".to_owned(),
        },
    };
    if condition == Condition::Recovering {
        sentence.push_str(" The latest batches are below the limit again; the alarm has not ended yet.");
    }
    if matches!(condition, Condition::Alarming | Condition::Recovering) && found.waiting > 1 {
        let _ = write!(sentence, " {} of {} batches are assessed.", found.batches - found.waiting, found.batches);
    }
    let unjudged = found.latest.as_ref().and_then(|latest| latest.unjudged.as_ref());
    if let Some(reason) = unjudged.filter(|_| matches!(condition, Condition::Pending | Condition::Normal)) {
        let _ = write!(sentence, " The latest batch is not judged: {reason}.");
    }
    sentence
}

/// The charts in a state, in words.
fn names_in(found: &StructureOverview, state: AlarmState) -> String {
    let of_state = found.charts.iter().filter(|(_, own)| **own == state).map(|(series, _)| match series.as_str() {
        FIT_SERIES => "the fit of the simulation".to_owned(),
        JOINT_SERIES => "the chart of all parameters together".to_owned(),
        name => format!("the chart of {}", in_words(name)),
    });
    let names: Vec<String> = of_state.collect();
    let mut text = names.join(" and ");
    if let Some(first) = text.get(..1).map(str::to_uppercase) {
        text.replace_range(..1, &first);
    }
    format!("{text} {}", if names.len() == 1 { "is" } else { "are each" })
}

/// What has changed, as the open damage alarms show it, and whether the simulation fits.
fn in_alarm(found: &StructureOverview, open: &[Episode]) -> String {
    let of_latest = found.latest.as_ref().map_or(&[][..], |latest| &latest.changes);
    let mut parts: Vec<String> = Vec::new();
    for episode in open {
        match &episode.change {
            Some(change) => parts.extend(of_change(change)),
            None if episode.series.starts_with("structure:") => {}
            None => parts.push(of_batch(episode, of_latest.iter().find(|c| c.quantity == episode.series))),
        }
    }
    if parts.is_empty() {
        if let Some(since) = open.iter().map(|episode| episode.opened_at).min() {
            parts.push(format!("the parameters together have shifted towards damage since {}", since.day()));
        }
    }
    let fits = !found.charts.get(FIT_SERIES).is_some_and(|state| state.in_episode());
    if !fits {
        parts.push("the simulation does not fit the measurements".to_owned());
    }
    let mut text = parts.join("; ");
    text.push('.');
    text
}

fn signed(percent: f64) -> String {
    format!("{percent:+.1}").replace('-', "−")
}

/// What a lasting change says has changed.
fn of_change(change: &LastingChange) -> Vec<String> {
    if change.changes.is_empty() && !change.candidates.is_empty() {
        return vec![one_of(&change.candidates, change.onset)];
    }
    change.changes.iter().map(|own| of_process(own, change.onset)).collect()
}

/// The changes of quantities of which the measurements do not tell which one has changed.
fn one_of(candidates: &[QuantityChange], onset: Timestamp) -> String {
    let possible = |own: &QuantityChange| {
        if own.is_of_misfit() {
            return format!("{} ({})", in_words(&own.name), own.in_modes());
        }
        format!("{} {} %", in_words(&own.name), own.signed_percent(own.change))
    };
    let each: Vec<String> = candidates.iter().map(possible).collect();
    format!("{} since {}: the measurements do not tell for certain which", each.join(" or "), onset.day())
}

/// The change of a quantity that the process of the reference does not explain.
fn of_process(change: &QuantityChange, onset: Timestamp) -> String {
    if change.is_of_misfit() {
        let (modes, since) = (change.in_modes(), onset.day());
        return format!("frequencies that no parameter explains since {since}: {modes}");
    }
    let [low, high] = change.interval.map(|end| change.signed_percent(end));
    let mut text = format!(
        "{} {} % ({low} to {high} %) since {}",
        in_words(&change.name),
        change.signed_percent(change.change),
        onset.day()
    );
    if change.is_of_all_frequencies() {
        text.push_str(", by one factor: an instrument or its clock may be off");
    }
    let explained = change.percent(change.explained);
    if explained.abs() >= 0.05 {
        let _ = write!(text, ", beside {} % that weather and seasons explain", signed(explained));
    }
    text
}

/// The change of a quantity in the latest batch, beside the opening of its alarm.
fn of_batch(episode: &Episode, latest: Option<&RelativeChange>) -> String {
    let name = in_words(&episode.series);
    let since = episode.opened_at.day();
    match latest {
        None => format!("{name} has shifted towards damage, alarm since {since}"),
        Some(RelativeChange { change, interval, .. }) => {
            let interval = interval.map_or_else(String::new, |[low, high]| {
                format!(" ({} to {} %)", signed(100.0 * low), signed(100.0 * high))
            });
            format!("{name} {} %{interval} in the latest batch, alarm since {since}", signed(100.0 * change))
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::monitor::stored::LatestAssessment;
    use crate::quantity::StructureId;
    use crate::trust::TrustVerdict;

    fn at(day: i64) -> Timestamp {
        Timestamp::from_micros(1_780_000_000_000_000 + day * 86_400_000_000).unwrap()
    }

    fn digest() -> Digest {
        Digest::of(&[b"model"])
    }

    /// A structure with a reference for its model, whose charts are all normal.
    fn healthy() -> StructureOverview {
        let latest = LatestAssessment {
            batch_id: "b".to_owned(),
            verdict: TrustVerdict::Accepted,
            findings: 0,
            unjudged: None,
            exceeds: true,
            worst: Some((0.4, "k1".to_owned())),
            changes: Vec::new(),
        };
        StructureOverview {
            id: StructureId::parse("bridge").unwrap(),
            batches: 20,
            last_measured_at: Some(at(20)),
            last_received_at: Some(at(20)),
            latest: Some(latest),
            open_alarms: 0,
            unacknowledged_alarms: 0,
            silent: false,
            failing: false,
            undamaged_version: Some(1),
            undamaged_model: Some(digest()),
            charts: BTreeMap::from([
                (FIT_SERIES.to_owned(), AlarmState::Normal),
                ("k1".to_owned(), AlarmState::Normal),
            ]),
            change: None,
            waiting: 0,
            waiting_since: None,
        }
    }

    fn episode(series: &str, change: Option<LastingChange>) -> Episode {
        Episode {
            number: 1,
            kind: "damage".to_owned(),
            series: series.to_owned(),
            undamaged_version: 1,
            opened_at: at(15),
            opened_batch: None,
            ended_at: None,
            withdrawn: false,
            peak_shift: 5.0,
            noticed_at: at(15),
            acknowledgement: None,
            diagnosis: None,
            change,
            superseded_by: None,
            continues: None,
            batch_change: None,
            highest_grade: None,
        }
    }

    #[test]
    fn a_probability_of_damage_above_that_of_the_reference_is_no_verdict() {
        let found = verdict(&healthy(), Some(&digest()), &[], at(21));
        assert_eq!(found.condition, Condition::Normal);
        assert_eq!(found.sentence, "No alarm: all charts are inside their limits.");
    }

    #[test]
    fn without_a_reference_of_the_model_in_use_nothing_is_judged() {
        let none = StructureOverview { undamaged_version: None, undamaged_model: None, ..healthy() };
        let other = StructureOverview { undamaged_model: Some(Digest::of(&[b"another"])), ..healthy() };
        let fresh =
            StructureOverview { charts: BTreeMap::from([(FIT_SERIES.to_owned(), AlarmState::Normal)]), ..healthy() };
        for (found, words) in [(none, "no undamaged reference"), (other, "another trained model"), (fresh, "no batch")]
        {
            let found = verdict(&found, Some(&digest()), &[], at(21));
            assert_eq!(found.condition, Condition::NotJudged, "{words}");
            assert!(found.sentence.contains(words), "{}", found.sentence);
        }
    }

    #[test]
    fn batches_that_wait_are_counted_and_one_that_has_just_arrived_is_not() {
        let mut found = StructureOverview { batches: 2_920, waiting: 2_420, waiting_since: Some(at(3)), ..healthy() };
        let judging = verdict(&found, Some(&digest()), &[], at(21));
        assert_eq!(judging.condition, Condition::Judging);
        assert_eq!(judging.sentence, "Judging: 500 of 2920 batches are assessed.");
        (found.waiting, found.waiting_since) = (1, Some(at(21)));
        assert_eq!(verdict(&found, Some(&digest()), &[], at(21)).condition, Condition::Normal);
        // An alarm is not hidden by batches that wait.
        found = StructureOverview { waiting: 20, waiting_since: Some(at(3)), ..found };
        found.charts.insert("k1".to_owned(), AlarmState::Alarming);
        let alarm = verdict(&found, Some(&digest()), &[episode("k1", None)], at(21));
        assert_eq!(alarm.condition, Condition::Alarming);
        assert!(alarm.sentence.contains("2900 of 2920 batches are assessed"), "{}", alarm.sentence);
    }

    #[test]
    fn an_alarm_is_a_change_with_its_interval_and_its_onset() {
        let mut found = healthy();
        found.charts.insert("k1".to_owned(), AlarmState::Alarming);
        let change = |name: &str, change: f64, half: f64, explained: f64| QuantityChange {
            name: name.to_owned(),
            unit: "N/m".to_owned(),
            probability: 0.95,
            towards_damage: true,
            change,
            interval: [change - half, change + half],
            reference_mean: 100.0,
            explained,
            modes: Vec::new(),
        };
        let lasting = LastingChange {
            fast: true,
            onset: at(14),
            onset_interval: [at(13), at(14)],
            changes: vec![change("k1", -7.9, 0.5, 0.4)],
            candidates: Vec::new(),
            not_seen: Vec::new(),
            coinciding: Vec::new(),
        };
        let open = [episode("structure:joint", Some(lasting.clone()))];
        let alarm = verdict(&found, Some(&digest()), &open, at(21));
        assert_eq!(alarm.alarm_since, Some(at(15)));
        assert_eq!(
            alarm.sentence,
            "k1 −7.9 % (−8.4 to −7.4 %) since 11 June 2026, beside +0.4 % that weather and seasons explain."
        );

        let changes = vec![change("k1", -0.4, 0.1, 0.0)];
        let slight = StructureOverview { change: Some(LastingChange { changes, ..lasting.clone() }), ..healthy() };
        let normal = verdict(&slight, Some(&digest()), &[], at(21));
        assert_eq!(normal.condition, Condition::Normal);
        assert_eq!(
            normal.sentence,
            "No alarm. What has changed is too small for one: k1 −0.4 % (−0.5 to −0.3 %) since 11 June 2026."
        );

        let candidates = vec![change("k1", -7.9, 0.5, 0.4), change("k3", -4.0, 0.5, 0.4)];
        let either = LastingChange { changes: Vec::new(), candidates, ..lasting };
        let alarm = verdict(&found, Some(&digest()), &[episode("structure:joint", Some(either))], at(21));
        assert_eq!(
            alarm.sentence,
            "k1 −7.9 % or k3 −4.0 % since 11 June 2026: the measurements do not tell for certain which."
        );

        let changes = vec![RelativeChange { quantity: "k1".to_owned(), change: -0.08, interval: Some([-0.1, -0.06]) }];
        found.latest.as_mut().unwrap().changes = changes;
        let alarm = verdict(&found, Some(&digest()), &[episode("k1", None)], at(21));
        assert_eq!(alarm.sentence, "k1 −8.0 % (−10.0 to −6.0 %) in the latest batch, alarm since 12 June 2026.");
    }
}
