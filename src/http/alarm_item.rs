//! An alarm as the API answers it.

use serde::Serialize;
use utoipa::ToSchema;

use crate::alarm::chart::parameter_of_alarm;
use crate::alarm::severity::{Grade, Severity, SeverityLimits};
use crate::monitor::stored::{AlarmAction, ClosingReason, Episode, Handling, JobState};
use crate::process::lasting::LastingChange;
use crate::quantity::Timestamp;

/// An alarm episode, from its start to its end.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Alarm)]
pub struct AlarmItem {
    /// Its number.
    alarm: i64,
    /// `damage`, `simulation_does_not_fit`, `silence` or `not_assessed`.
    kind: String,
    /// Only for a damage alarm: the parameter that has changed; absent if several have, or if the measurements do not tell for certain which
    /// one: `change` has them all.
    #[serde(skip_serializing_if = "Option::is_none")]
    parameter: Option<String>,
    /// `open`, `ended`, `withdrawn` if data that arrived later showed that there was no alarm, or `superseded` if the charts of a later
    /// undamaged reference cover its time.
    state: &'static str,
    /// Version of the undamaged reference that has superseded it.
    #[serde(skip_serializing_if = "Option::is_none")]
    superseded_by: Option<u32>,
    /// The alarm of an earlier undamaged reference about the same time.
    #[serde(skip_serializing_if = "Option::is_none")]
    continues: Option<i64>,
    opened_at: Timestamp,
    opened_batch: Option<String>,
    ended_at: Option<Timestamp>,
    noticed_at: Timestamp,
    #[serde(skip_serializing_if = "Option::is_none")]
    peak_shift_standard_errors: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    undamaged_version: Option<u32>,
    /// Why the alarm was raised, in one sentence; only with a process behind the undamaged reference.
    #[serde(skip_serializing_if = "Option::is_none")]
    sentence: Option<String>,
    /// Onset and size of the change, as the newest batch of the alarm shows them.
    #[serde(skip_serializing_if = "Option::is_none")]
    change: Option<LastingChange>,
    severity: Severity,
    /// The largest grade that it has had; `null` before the first batch was graded.
    #[schema(required)]
    highest_grade: Option<Grade>,
    acknowledgement: Option<AcknowledgementItem>,
    /// Who takes care of it.
    #[schema(required)]
    assignee: Option<String>,
    /// The closing by a person, while it is closed. It does not change `state`, which follows from the measurements.
    #[schema(required)]
    closing: Option<ActionItem>,
    /// What people did with it and with the earlier alarms that it continues, in order.
    actions: Vec<ActionItem>,
    /// The latest diagnosis that the service started because of this alarm.
    #[schema(required)]
    diagnosis: Option<AlarmDiagnosis>,
}

/// The diagnosis that the service started because of an alarm.
#[derive(Debug, Serialize, ToSchema)]
struct AlarmDiagnosis {
    diagnosis: String,
    state: JobState,
    /// Its verdict, once it is done.
    #[schema(required)]
    verdict: Option<String>,
}

/// Acknowledgement of an alarm.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Acknowledgement)]
struct AcknowledgementItem {
    at: Timestamp,
    by: String,
    note: Option<String>,
}

/// What a person did with an alarm.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = AlarmAction)]
pub struct ActionItem {
    /// Its number: later actions have larger ones.
    action: i64,
    /// The alarm on which it was done: an earlier one that this alarm continues, or this one.
    alarm: i64,
    /// `comment`, `assignment`, `closing` or `reopening`.
    kind: &'static str,
    at: Timestamp,
    author: String,
    /// Comment or explanation.
    #[serde(skip_serializing_if = "Option::is_none")]
    text: Option<String>,
    /// Why the alarm was closed.
    #[serde(skip_serializing_if = "Option::is_none")]
    reason: Option<ClosingReason>,
    /// The assignee of an assignment; absent if it is nobody any more.
    #[serde(skip_serializing_if = "Option::is_none")]
    assignee: Option<String>,
}

impl From<AlarmAction> for ActionItem {
    fn from(a: AlarmAction) -> Self {
        Self {
            action: a.number,
            alarm: a.alarm,
            kind: a.kind.name(),
            at: a.at,
            text: a.kind.text().map(str::to_owned),
            reason: a.kind.reason(),
            assignee: a.kind.assignee().map(str::to_owned),
            author: a.author,
        }
    }
}

impl AlarmItem {
    /// An alarm with what people did with it.
    pub fn new(e: Episode, handling: Handling, limits: SeverityLimits) -> Self {
        let damage = e.kind == "damage";
        Self {
            severity: e.severity(limits),
            highest_grade: e.highest_grade,
            assignee: handling.assignee,
            closing: handling.closing.map(ActionItem::from),
            actions: handling.actions.into_iter().map(ActionItem::from).collect(),
            alarm: e.number,
            state: e.state(),
            superseded_by: e.superseded_by,
            continues: e.continues,
            parameter: parameter_of_alarm(&e.series, e.change.as_ref()),
            sentence: e.change.as_ref().map(LastingChange::sentence),
            change: e.change,
            peak_shift_standard_errors: (damage && e.peak_shift.is_finite()).then_some(e.peak_shift),
            undamaged_version: damage.then_some(e.undamaged_version),
            kind: e.kind,
            opened_at: e.opened_at,
            opened_batch: e.opened_batch,
            ended_at: e.ended_at,
            noticed_at: e.noticed_at,
            acknowledgement: e.acknowledgement.map(|a| AcknowledgementItem { at: a.at, by: a.by, note: a.note }),
            diagnosis: e.diagnosis.map(|d| AlarmDiagnosis { diagnosis: d.id, state: d.state, verdict: d.verdict }),
        }
    }
}
