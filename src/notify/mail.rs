//! A mail about an alarm: plain text in sentences.

use lettre::message::header::ContentType;
use lettre::message::Mailbox;
use lettre::{Address, Message};
use sha2::{Digest as _, Sha256};

use super::facts::{ActionFacts, Facts};
use crate::alarm::chart::parameter_of;
use crate::alarm::severity::{Severity, SeverityLimits};
use crate::parameter::in_words;
use crate::process::lasting::{LastingChange, QuantityChange};
use crate::quantity::Timestamp;
use crate::store::{DueMail, OutboxEvent};

/// Maximum length of a subject, characters: about two lines of a phone.
const LONGEST_SUBJECT: usize = 120;

/// Subject and text of a mail.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Letter {
    /// The subject, one line.
    pub subject: String,
    /// The text.
    pub text: String,
}

/// A text on one line without control characters, at most so many characters long.
fn one_line(text: &str, most: usize) -> String {
    let plain: String = text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    let mut words = plain.split_whitespace().collect::<Vec<_>>().join(" ");
    if words.chars().count() > most {
        words = words.chars().take(most - 1).collect::<String>() + "…";
    }
    words
}

/// The severity of the alarm of an event.
pub fn severity(facts: &Facts, limits: SeverityLimits) -> Severity {
    limits.severity(facts.alarm())
}

/// What has happened, in a phrase after "the alarm".
fn happened(kind: &str, action: Option<&ActionFacts>) -> String {
    match (kind, action) {
        (_, Some(action)) => action.phrase(),
        ("alarm.opened", _) => "was opened".to_owned(),
        ("alarm.worsened", _) => "has become more severe".to_owned(),
        ("alarm.reopened", _) => "was opened again by measurements that arrived later".to_owned(),
        ("alarm.ended", _) => "has ended: the measurements are inside the limits again".to_owned(),
        ("alarm.withdrawn", _) => "was withdrawn: measurements that arrived later show that there was none".to_owned(),
        ("alarm.acknowledged", _) => "was acknowledged".to_owned(),
        (other, _) => other.replace('.', " "),
    }
}

/// What the alarm is about, in a sentence.
fn what(facts: &Facts) -> String {
    match (facts.kind.as_str(), &facts.change, parameter_of(facts.series.clone())) {
        ("silence", ..) => "No measurements have arrived for longer than is usual or configured.".to_owned(),
        ("not_assessed", ..) => {
            "The newest batches could not be judged; the reason is stated with each of them.".to_owned()
        }
        ("simulation_does_not_fit", ..) => "The simulation does not fit the measurements.".to_owned(),
        (_, Some(change), _) => change.sentence(),
        (_, None, Some(name)) => {
            match facts.batch_change {
                Some(batch) => {
                    let [low, high] = batch.interval.map(|end| 100.0 * end);
                    let change = 100.0 * batch.change;
                    format!("{} has changed by {change:+.1} % ({low:+.1} to {high:+.1} %) in the newest batch of the alarm.", in_words(&name))
                }
                None => format!("{} has shifted towards damage.", in_words(&name)),
            }
        }
        (_, None, None) => "The parameters together have shifted towards damage.".to_owned(),
    }
}

/// What the alarm is about, in a few words.
fn in_short(facts: &Facts) -> String {
    let of_change = |change: &LastingChange| {
        let phrase = |q: &QuantityChange| format!("{} {} %", in_words(&q.name), q.signed_percent(q.change));
        let phrases = |of: &[QuantityChange]| of.iter().map(phrase).collect::<Vec<_>>();
        if change.changes.is_empty() {
            phrases(&change.candidates).join(" or ")
        } else {
            phrases(&change.changes).join(", ")
        }
    };
    let short = match facts.kind.as_str() {
        "silence" => return "no measurements".to_owned(),
        "not_assessed" => return "batches cannot be judged".to_owned(),
        "simulation_does_not_fit" => return "the simulation does not fit".to_owned(),
        _ => facts.change.as_ref().map(of_change).filter(|text| !text.is_empty()),
    };
    short.unwrap_or_else(|| match (parameter_of(facts.series.clone()), facts.batch_change) {
        (Some(name), Some(batch)) => format!("{} {:+.1} %", in_words(&name), 100.0 * batch.change).replace('-', "−"),
        (Some(name), None) => format!("{} shifted", in_words(&name)),
        (None, _) => "several parameters shifted".to_owned(),
    })
}

/// Subject and text of the mail about an event; `public_url` leads to the dashboard.
pub fn letter(event: &OutboxEvent, facts: &Facts, limits: SeverityLimits, public_url: &str) -> Letter {
    let (structure, number) = (&event.structure, event.alarm);
    let severity = severity(facts, limits);
    let short_event = event.kind.strip_prefix("alarm.").unwrap_or(&event.kind);
    let subject = format!("{structure}: {} alarm {short_event}, {}", severity.grade.as_str(), in_short(facts));
    let time = |micros: i64| {
        Timestamp::from_micros(micros).map_or_else(
            |_| "an unknown time".to_owned(),
            |at| at.to_string().chars().take(16).collect::<String>().replace('T', " ") + " UTC",
        )
    };
    let mut lines = vec![
        format!("Alarm {number} of the structure {structure} {}.", happened(&event.kind, facts.action.as_ref())),
        String::new(),
        format!("What: {}", one_line(&what(facts), 2_000)),
        match facts.ended_at_us {
            None => format!("Since: the alarm was raised by the measurements of {}.", time(facts.opened_at_us)),
            Some(end) => format!("Since: from the measurements of {} to {}.", time(facts.opened_at_us), time(end)),
        },
        format!("Severity: {}", one_line(&severity.sentence, 500)),
    ];
    if let Some(text) = facts.action.as_ref().and_then(|action| action.text.as_deref()) {
        lines.extend([String::new(), text.replace('\r', "")]);
    }
    let root = public_url.trim_end_matches('/');
    let place = if root.is_empty() {
        format!("Where to look: the page of {structure} on the dashboard of modalwatch.")
    } else {
        format!("Where to look: {root}/#/structures/{structure}")
    };
    lines.extend([String::new(), place]);
    Letter { subject: one_line(&subject, LONGEST_SUBJECT), text: lines.join("\n") + "\n" }
}

/// Id of a mail, the same at every attempt: from the event and the address.
fn message_id(event: &OutboxEvent, address: &str, domain: &str) -> String {
    let digest = data_encoding::HEXLOWER.encode(&Sha256::digest(address.as_bytes())[..8]);
    format!("<{}.{digest}@{domain}>", event.message_id)
}

/// The mail about an event.
///
/// # Errors
/// A sentence, if the address of the recipient is none or the mail cannot be built.
pub fn mail(due: &DueMail, letter: Letter, sender: &Mailbox) -> Result<Message, String> {
    let address: Address = due.address.parse().map_err(|e| format!("{} is no address: {e}", due.address))?;
    let created =
        std::time::UNIX_EPOCH + std::time::Duration::from_micros(due.event.created_at.micros().max(0).unsigned_abs());
    Message::builder()
        .from(sender.clone())
        .to(Mailbox::new(None, address))
        .subject(letter.subject)
        .date(created)
        .message_id(Some(message_id(&due.event, &due.address, sender.email.domain())))
        .header(ContentType::TEXT_PLAIN)
        .body(letter.text)
        .map_err(|e| format!("the mail cannot be built: {e}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::quantity::StructureId;

    fn due(series: &str, action: &str) -> DueMail {
        let facts = serde_json::json!({
            "kind": "damage", "series": series, "undamaged_version": 1, "opened_at_us": 1_700_000_000_000_000_i64,
            "opened_batch": "b", "ended_at_us": null, "withdrawn": 0, "peak_shift": 7.0, "noticed_at_us": 5,
            "acknowledged_at_us": null, "acknowledged_by": null, "acknowledgement_note": null, "change": null,
            "batch_change": [-0.12, -0.15, -0.08],
            "action": serde_json::from_str::<serde_json::Value>(action).unwrap(),
        });
        DueMail {
            id: 1,
            address: "ann@example.org".to_owned(),
            event: OutboxEvent {
                message_id: "msg_1".to_owned(),
                kind: "alarm.opened".to_owned(),
                structure: StructureId::parse("bridge").unwrap(),
                alarm: 3,
                facts: facts.to_string(),
                created_at: Timestamp::from_micros(1_700_000_000_000_000).unwrap(),
            },
            attempts: 0,
            started_at: Timestamp::from_micros(0).unwrap(),
        }
    }

    fn formatted(due: &DueMail) -> String {
        let facts: Facts = serde_json::from_str(&due.event.facts).unwrap();
        let letter = letter(&due.event, &facts, SeverityLimits::default(), "https://shm.example.org/");
        let sender = "Watch <watch@example.org>".parse().unwrap();
        String::from_utf8(mail(due, letter, &sender).unwrap().formatted()).unwrap()
    }

    #[test]
    fn a_mail_says_structure_change_severity_and_where_to_look() {
        let facts: Facts = serde_json::from_str(&due("k2", "null").event.facts).unwrap();
        let found = letter(&due("k2", "null").event, &facts, SeverityLimits::default(), "https://shm.example.org/");
        assert_eq!(found.subject, "bridge: severe alarm opened, k2 −12.0 %");
        for part in [
            "Alarm 3 of the structure bridge was opened.",
            "k2 has changed by -12.0 % (-15.0 to -8.0 %)",
            "2023-11-14 22:13 UTC",
            "Severity: Severe: ",
            "https://shm.example.org/#/structures/bridge",
        ] {
            assert!(found.text.contains(part), "{part}: {}", found.text);
        }
        let first = formatted(&due("k2", "null"));
        assert_eq!(first, formatted(&due("k2", "null")), "an attempt differs from the one before");
        assert!(first.contains("Message-ID: <msg_1."), "{first}");
    }

    #[test]
    fn a_line_break_in_a_name_begins_no_header() {
        let text = formatted(&due("k2\r\nBcc: all@example.org\r\n\r\nbody", "null"));
        let head = text.split("\r\n\r\n").next().unwrap();
        assert!(!head.lines().any(|line| line.starts_with("Bcc")), "{head}");
        assert!(head.contains("Subject:") && head.contains("To: ann@example.org"), "{head}");
    }

    #[test]
    fn the_action_of_a_person_is_told_with_its_text() {
        let action = r#"{"kind": "closing", "at_us": 7, "author": "Ann", "text": "new bearing\nfixed", "reason": "repaired",
            "assignee": null}"#;
        let found = due("k2", action);
        let facts: Facts = serde_json::from_str(&found.event.facts).unwrap();
        let text = letter(&found.event, &facts, SeverityLimits::default(), "").text;
        assert!(text.contains("was closed by Ann (repaired)") && text.contains("new bearing\nfixed"), "{text}");
    }
}
