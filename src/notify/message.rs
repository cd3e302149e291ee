//! A message: CloudEvents 1.0 as JSON, signed according to Standard Webhooks.
//!
//! Source: CNCF (2022), CloudEvents – Version 1.0.2, §3.1 and JSON event format §3; Standard Webhooks specification 1.0.0.

use serde::Serialize;
use standardwebhooks::{Webhook, WebhookError};

use super::facts::{ActionFacts, Facts};
use crate::alarm::chart::parameter_of_alarm;
use crate::alarm::severity::{Severity, SeverityLimits};
use crate::process::lasting::LastingChange;
use crate::quantity::{StructureId, Timestamp};
use crate::store::{OutboxEvent, Secret};

/// Kinds of events, as in the table `outbox_event`.
pub const EVENT_KINDS: [&str; 9] = [
    "alarm.opened",
    "alarm.worsened",
    "alarm.reopened",
    "alarm.ended",
    "alarm.withdrawn",
    "alarm.acknowledged",
    "alarm.commented",
    "alarm.assigned",
    "alarm.closed",
];

/// Prefix of the kind of an event in the CloudEvents type.
const TYPE_PREFIX: &str = "org.modalwatch.";

/// Source of the events if the service has no public URL.
const NAMELESS_SOURCE: &str = "urn:modalwatch";

/// Why a stored event cannot be read: the database was changed by another program, or there is a programming error.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Its JSON has another form than the triggers write.
    #[error("the stored event cannot be read: {0}")]
    Facts(#[from] serde_json::Error),
    /// A time is outside the range of the calendar.
    #[error("the stored event cannot be read: {0}")]
    Time(#[from] crate::quantity::OutOfRange),
}

/// A message that is ready to be signed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Message {
    id: String,
    body: String,
}

/// CloudEvents envelope.
#[derive(Debug, Serialize)]
#[serde(rename_all = "lowercase")]
struct CloudEvent<'a, D> {
    specversion: &'static str,
    id: &'a str,
    source: &'a str,
    r#type: String,
    subject: String,
    time: Timestamp,
    datacontenttype: &'static str,
    data: D,
}

/// An alarm as it is sent to receivers.
#[derive(Debug, Serialize)]
struct AlarmData<'a> {
    structure: &'a StructureId,
    alarm: i64,
    kind: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    parameter: Option<String>,
    /// Why the alarm was raised; only with a process behind the undamaged reference.
    #[serde(skip_serializing_if = "Option::is_none")]
    sentence: Option<String>,
    state: &'static str,
    opened_at: Timestamp,
    opened_batch: Option<String>,
    ended_at: Option<Timestamp>,
    noticed_at: Timestamp,
    #[serde(skip_serializing_if = "Option::is_none")]
    peak_shift_standard_errors: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    undamaged_version: Option<u32>,
    severity: Severity,
    acknowledgement: Option<AcknowledgementData>,
    /// What a person did; only in events about that.
    #[serde(skip_serializing_if = "Option::is_none")]
    action: Option<ActionData>,
    /// URL of the alarm.
    alarm_url: String,
    /// URL of the batch that raised the alarm.
    batch_url: Option<String>,
}

#[derive(Debug, Serialize)]
struct AcknowledgementData {
    at: Timestamp,
    by: String,
    note: Option<String>,
}

/// What a person did with the alarm.
#[derive(Debug, Serialize)]
struct ActionData {
    kind: String,
    at: Timestamp,
    author: String,
    text: Option<String>,
    reason: Option<String>,
    assignee: Option<String>,
}

#[derive(Debug, Serialize)]
struct TestData {
    message: &'static str,
}

impl Message {
    /// The message of an event; its bytes are the same at every attempt.
    ///
    /// # Errors
    /// [`Error`] if the stored event cannot be read.
    pub fn of_event(event: &OutboxEvent, limits: SeverityLimits, public_url: &str) -> Result<Self, Error> {
        let facts: Facts = serde_json::from_str(&event.facts)?;
        let severity = limits.severity(facts.alarm());
        let (structure, number) = (&event.structure, event.alarm);
        let time = |micros: i64| Timestamp::from_micros(micros);
        let root = public_url.trim_end_matches('/');
        let acknowledgement = match (facts.acknowledged_at_us, facts.acknowledged_by) {
            (Some(at), Some(by)) => Some(AcknowledgementData { at: time(at)?, by, note: facts.acknowledgement_note }),
            _ => None,
        };
        let damage = facts.kind == "damage";
        let action = |ActionFacts { kind, at_us, author, text, reason, assignee }| {
            Ok::<_, Error>(ActionData { kind, at: time(at_us)?, author, text, reason, assignee })
        };
        let data = AlarmData {
            structure,
            alarm: number,
            parameter: parameter_of_alarm(&facts.series, facts.change.as_ref()),
            sentence: facts.change.as_ref().map(LastingChange::sentence),
            state: match (facts.withdrawn, facts.ended_at_us) {
                (0, None) => "open",
                (0, Some(_)) => "ended",
                _ => "withdrawn",
            },
            opened_at: time(facts.opened_at_us)?,
            ended_at: facts.ended_at_us.map(time).transpose()?,
            noticed_at: time(facts.noticed_at_us)?,
            peak_shift_standard_errors: facts.peak_shift.filter(|_| damage),
            undamaged_version: damage.then_some(facts.undamaged_version),
            severity,
            acknowledgement,
            action: facts.action.map(action).transpose()?,
            // The alarm is on the page of one item that begins after the next number.
            alarm_url: format!("{root}/v1/structures/{structure}/alarms?limit=1&cursor={}", number + 1),
            batch_url: facts.opened_batch.as_ref().map(|id| format!("{root}/v1/structures/{structure}/batches/{id}")),
            opened_batch: facts.opened_batch,
            kind: facts.kind,
        };
        let subject = format!("structures/{structure}/alarms/{number}");
        Ok(Self::new(&event.message_id, &event.kind, subject, event.created_at, public_url, data))
    }

    /// A test message, which is not about an alarm.
    pub fn test(id: &str, public_url: &str, now: Timestamp) -> Self {
        let data = TestData { message: "This is a test: messages about alarms are sent in the same way." };
        Self::new(id, "test", "test".to_owned(), now, public_url, data)
    }

    fn new(id: &str, kind: &str, subject: String, time: Timestamp, public_url: &str, data: impl Serialize) -> Self {
        let event = CloudEvent {
            specversion: "1.0",
            id,
            source: if public_url.is_empty() { NAMELESS_SOURCE } else { public_url },
            r#type: format!("{TYPE_PREFIX}{kind}"),
            subject,
            time,
            datacontenttype: "application/json",
            data,
        };
        let body = serde_json::to_string(&event).expect("texts, times and finite numbers are plain data");
        Self { id: id.to_owned(), body }
    }

    /// Id by which the receiver recognises a message that it receives twice.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Body of the request, JSON.
    pub fn body(&self) -> &str {
        &self.body
    }

    /// Value of the header `webhook-signature`: one signature for each secret, separated by spaces.
    ///
    /// # Errors
    /// [`WebhookError`] if a secret is not valid Base64.
    pub fn signature<'a>(
        &self,
        secrets: impl Iterator<Item = &'a Secret>,
        now: Timestamp,
    ) -> Result<String, WebhookError> {
        let sign = |secret: &Secret| Webhook::new(secret.reveal())?.sign(&self.id, seconds(now), self.body.as_bytes());
        Ok(secrets.map(sign).collect::<Result<Vec<_>, _>>()?.join(" "))
    }
}

/// Seconds since 1970, as the Standard Webhooks sign them.
pub(super) fn seconds(at: Timestamp) -> i64 {
    at.micros().div_euclid(1_000_000)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The example of the Standard Webhooks specification.
    #[test]
    fn the_signature_is_that_of_the_specification() {
        let message =
            Message { id: "msg_p5jXN8AQM9LWM0D4loKWxJek".to_owned(), body: "{\"test\": 2432232314}".to_owned() };
        let secret = Secret::new("whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw".to_owned());
        let now = Timestamp::from_micros(1_614_265_330_000_000).unwrap();
        let signature = message.signature(std::iter::once(&secret), now).unwrap();
        assert_eq!(signature, "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE=");
        assert!(!format!("{secret:?}").contains("MfKQ"), "a secret shows itself in a log");
    }

    #[test]
    fn a_stored_event_of_an_alarm_becomes_a_message() {
        let event = |facts: &str| OutboxEvent {
            message_id: "msg_1".to_owned(),
            kind: "alarm.opened".to_owned(),
            structure: StructureId::parse("bridge").unwrap(),
            alarm: 3,
            facts: facts.to_owned(),
            created_at: Timestamp::from_micros(1_700_000_000_000_000).unwrap(),
        };
        let silence = r#"{"kind":"silence","series":"structure:silence","undamaged_version":0,"opened_at_us":0,
            "opened_batch":null,"ended_at_us":1000000,"withdrawn":0,"peak_shift":0.0,"noticed_at_us":5,
            "acknowledged_at_us":7000000,"acknowledged_by":"Ann","acknowledgement_note":null}"#;
        let message =
            Message::of_event(&event(silence), SeverityLimits::default(), "https://shm.example.org/").unwrap();
        let body: serde_json::Value = serde_json::from_str(message.body()).unwrap();
        assert_eq!(body["type"], "org.modalwatch.alarm.opened");
        assert_eq!(body["source"], "https://shm.example.org/");
        assert_eq!(body["subject"], "structures/bridge/alarms/3");
        let data = &body["data"];
        assert_eq!((&data["state"], &data["parameter"]), (&"ended".into(), &serde_json::Value::Null));
        assert_eq!((&data["acknowledgement"]["by"], &data["severity"]["grade"]), (&"Ann".into(), &"moderate".into()));
        assert_eq!(data["alarm_url"], "https://shm.example.org/v1/structures/bridge/alarms?limit=1&cursor=4");
        assert!(Message::of_event(&event("{}"), SeverityLimits::default(), "").is_err());
    }
}
