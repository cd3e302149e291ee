//! Processing of one message: it is stored as a batch or put into quarantine.

use std::time::Duration;

use tracing::{error, warn};

use super::settings::{MqttSettings, SettingError};
use super::topic::Topic;
use crate::clock;
use crate::measurement::body::RawBatch;
use crate::measurement::check::Problem;
use crate::measurement::json::JsonError;
use crate::measurement::MeasurementBatch;
use crate::monitor::{Error, IngestError, Monitor};
use crate::quantity::{shown, StructureId};

/// Maximum number of attempts for a message whose storage fails for reasons outside the message.
const TRIES: u32 = 5;

/// Delay before the second attempt; each further delay is twice as long.
const FIRST_DELAY: Duration = Duration::from_millis(500);

/// Delay when the quarantine cannot be written either.
const DELAY_WITHOUT_STORE: Duration = Duration::from_secs(5);

/// Stores messages.
pub struct Intake {
    monitor: Monitor,
    topic: Topic,
    max_payload_bytes: usize,
}

/// Why a message was not stored.
enum Refused {
    /// It can never be stored.
    Permanent(String),
    /// It may be stored later.
    Temporary(String),
}

impl Intake {
    /// Stores messages in the database of a monitor.
    ///
    /// # Errors
    /// [`SettingError`] for a topic that cannot be used.
    pub fn new(monitor: Monitor, settings: &MqttSettings) -> Result<Self, SettingError> {
        Ok(Self { monitor, topic: settings.topic()?, max_payload_bytes: settings.max_payload_bytes })
    }

    /// Filter of the subscription to the messages.
    pub(super) fn filter(&self) -> String {
        self.topic.filter()
    }

    /// Processes a message. It returns when the message is stored as a batch or in quarantine and may be acknowledged;
    /// while nothing can be written, it waits.
    pub async fn take(&self, topic: &str, payload: impl AsRef<[u8]>) {
        let payload = payload.as_ref();
        loop {
            let Some((reason, tries)) = self.store(topic, payload).await else { return };
            match self.monitor.quarantine().insert(topic, payload, &reason, tries, clock::now()).await {
                Ok(()) => {
                    count("quarantined");
                    warn!(topic = %shown(topic), reason, "Put an MQTT message into quarantine: {reason}");
                    return;
                }
                Err(failure) => {
                    count("waiting");
                    error!(error = %failure, "Could neither store an MQTT message nor put it into quarantine, retrying: {failure}");
                    tokio::time::sleep(DELAY_WITHOUT_STORE).await;
                }
            }
        }
    }

    /// Stores a message as a batch; otherwise returns the reason and the number of attempts.
    async fn store(&self, topic: &str, payload: &[u8]) -> Option<(String, u32)> {
        let mut delay = FIRST_DELAY;
        for tries in 1.. {
            match self.store_once(topic, payload).await {
                Ok(replayed) => {
                    count(if replayed { "replayed" } else { "stored" });
                    return None;
                }
                Err(Refused::Permanent(reason)) => return Some((reason, tries)),
                Err(Refused::Temporary(reason)) if tries >= TRIES => return Some((reason, tries)),
                Err(Refused::Temporary(reason)) => {
                    count("retried");
                    warn!(topic = %shown(topic), reason, tries, "Could not store an MQTT message, retrying: {reason}");
                    tokio::time::sleep(delay).await;
                    delay *= 2;
                }
            }
        }
        None
    }

    /// Returns whether the batch was already stored.
    async fn store_once(&self, topic: &str, payload: &[u8]) -> Result<bool, Refused> {
        let batch = self.batch(topic, payload).await?;
        match self.monitor.ingest().take_when_free(batch).await {
            Ok(ingested) => Ok(ingested.replayed),
            Err(IngestError::Monitor(error @ (Error::Store(_) | Error::QueueFull(_) | Error::Panicked))) => {
                Err(Refused::Temporary(error.to_string()))
            }
            Err(error) => Err(Refused::Permanent(error.to_string())),
        }
    }

    async fn batch(&self, topic: &str, payload: &[u8]) -> Result<MeasurementBatch, Refused> {
        let permanent = |reason: String| Refused::Permanent(reason);
        let id = self
            .topic
            .structure(topic)
            .ok_or_else(|| permanent(format!("the topic {} has another form than mqtt.topic", shown(topic))))?;
        let id = StructureId::parse(id).map_err(|e| permanent(e.to_string()))?;
        let active = self.monitor.structure(&id).map_err(|e| permanent(e.to_string()))?;
        if payload.len() > self.max_payload_bytes {
            let (bytes, most) = (payload.len(), self.max_payload_bytes);
            return Err(permanent(format!(
                "the payload of {bytes} bytes exceeds mqtt.max_payload_bytes = {most}: split the batch"
            )));
        }
        let (monitor, payload) = (self.monitor.clone(), payload.to_vec());
        // Parsing thousands of measurements takes milliseconds, which must not block an async thread.
        let parse = move || {
            let raw = RawBatch::of_message(&payload).map_err(|error| match error {
                JsonError::Malformed(reason) => reason,
                JsonError::Shape(problem) => sentence(&[problem]),
            })?;
            monitor.ingest().check(&active, raw).map_err(|problems| sentence(&problems))
        };
        tokio::task::spawn_blocking(parse)
            .await
            .map_err(|e| Refused::Temporary(e.to_string()))?
            .map_err(Refused::Permanent)
    }
}

/// All problems of a batch as one message.
fn sentence(problems: &[Problem]) -> String {
    problems.iter().map(|p| format!("{}: {}", p.pointer, p.message)).collect::<Vec<_>>().join("; ")
}

fn count(outcome: &'static str) {
    metrics::counter!("modalwatch_mqtt_messages_total", "outcome" => outcome).increment(1);
}
