//! The alarms of a condition report, with what people did with them, and the notes.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use super::words::{list, time};
use crate::alarm::severity::SeverityLimits;
use crate::monitor::stored::{ActionKind, AlarmAction, Episode, Handling, MaintenanceWindow, Note};
use crate::parameter::in_words;
use crate::plot::{escaped, table_of_html};

/// The alarms with their severity, and below them what people did.
pub fn section(alarms: &[Episode], handling: &BTreeMap<i64, Handling>, limits: SeverityLimits) -> String {
    if alarms.is_empty() {
        return "<p>None.</p>".to_owned();
    }
    let mut text = table(alarms, handling, limits);
    for episode in alarms {
        let Some(found) = handling.get(&episode.number).filter(|found| !found.actions.is_empty()) else { continue };
        let actions: Vec<String> = found.actions.iter().map(|action| sentence(action, episode.number)).collect();
        let _ = write!(text, "<h3>What people did with alarm {}</h3>{}", episode.number, list(&actions));
    }
    text
}

/// Maintenance windows.
pub fn maintenance(windows: &[MaintenanceWindow]) -> String {
    if windows.is_empty() {
        return String::new();
    }
    let window = |w: &MaintenanceWindow| format!("{} to {}: {}", time(w.from), time(w.to), w.reason);
    let windows: Vec<String> = windows.iter().map(window).collect();
    format!("<h3>Maintenance, in which batches raise no alarm</h3>{}", list(&windows))
}

/// Notes on the time line.
pub fn notes(notes: &[Note]) -> String {
    if notes.is_empty() {
        return "<p>None.</p>".to_owned();
    }
    let note = |n: &Note| {
        let to = n.to.map_or_else(String::new, |to| format!(" to {}", time(to)));
        format!("{}{to}, {}: {}", time(n.from), n.author, n.text)
    };
    list(&notes.iter().map(note).collect::<Vec<_>>())
}

fn table(alarms: &[Episode], handling: &BTreeMap<i64, Handling>, limits: SeverityLimits) -> String {
    let what = |e: &Episode| match (e.kind.as_str(), &e.change) {
        ("damage", Some(change)) => change.sentence(),
        ("damage", None) => format!("{} has shifted towards damage", in_words(&e.series)),
        ("silence", _) => "no measurement for longer than is usual or configured".to_owned(),
        ("not_assessed", _) => "the newest batches could not be judged".to_owned(),
        _ => "the simulation does not fit the measurements".to_owned(),
    };
    let noted = |e: &Episode| {
        let noted = e.acknowledgement.as_ref().map_or_else(
            || "not acknowledged".to_owned(),
            |a| {
                let note = a.note.as_ref().map_or_else(String::new, |note| format!(": {note}"));
                format!("acknowledged by {}, {}{note}", a.by, time(a.at))
            },
        );
        let found = handling.get(&e.number);
        let assigned = found.and_then(|h| h.assignee.as_ref()).map(|name| format!("assigned to {name}"));
        let closed = found.and_then(|h| h.closing.as_ref()).map(|closing| phrase(&closing.kind));
        [Some(noted), assigned, closed].into_iter().flatten().collect::<Vec<_>>().join("; ")
    };
    let row = |e: &Episode| {
        let when = match e.ended_at {
            None => format!("since {}, still open", time(e.opened_at)),
            Some(ended) => format!("{} to {}", time(e.opened_at), time(ended)),
        };
        let severity = e.severity(limits).sentence;
        [e.number.to_string(), when, what(e), severity, noted(e)].map(|cell| escaped(&cell)).to_vec()
    };
    let rows: Vec<Vec<String>> = alarms.iter().map(row).collect();
    let header = [("Alarm", false), ("When (UTC)", true), ("What", true), ("Severity", true), ("Handled by", true)];
    table_of_html("", &header, &rows)
}

/// What a person did, in a phrase.
fn phrase(kind: &ActionKind) -> String {
    match kind {
        ActionKind::Comment { .. } => "comment".to_owned(),
        ActionKind::Assignment { assignee: Some(name) } => format!("assigned to {name}"),
        ActionKind::Assignment { assignee: None } => "assigned to nobody".to_owned(),
        ActionKind::Closing { reason, .. } => format!("closed ({})", reason.words()),
        ActionKind::Reopening { .. } => "reopened".to_owned(),
    }
}

fn sentence(action: &AlarmAction, alarm: i64) -> String {
    let earlier = if action.alarm == alarm { String::new() } else { format!(" on alarm {}", action.alarm) };
    let text = action.kind.text().map_or_else(String::new, |text| format!(": {text}"));
    format!("{}, {}, {}{earlier}{text}", time(action.at), action.author, phrase(&action.kind))
}
