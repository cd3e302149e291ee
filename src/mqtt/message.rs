//! One message: a batch that is stored, or one that never can be and goes into quarantine.

use std::time::Duration;

use tracing::{error, warn};

use super::Topic;
use crate::measurement::body::RawBatch;
use crate::measurement::check::Problem;
use crate::measurement::json::JsonError;
use crate::measurement::MeasurementBatch;
use crate::monitor::{Error, IngestError, Monitor};
use crate::quantity::{shown, StructureId, Timestamp};

/// Tries of a message that fails for no fault of its own.
const TRIES: u32 = 5;

/// First pause between tries; each further one is twice as long.
const FIRST_PAUSE: Duration = Duration::from_millis(500);

/// Pause when not even the quarantine can be written.
const PAUSE_WITHOUT_STORE: Duration = Duration::from_secs(5);

/// Takes messages in.
pub(super) struct Intake {
    pub(super) monitor: Monitor,
    pub(super) topic: Topic,
    pub(super) max_payload_bytes: usize,
}

/// Why a message is no batch.
enum Refused {
    /// It never will be.
    Poison(String),
    /// It may be at another time.
    Trouble(String),
}

impl Intake {
    /// Settles a message: when this returns it is stored as a batch or in quarantine, and may be acknowledged. It returns only
    /// then: while nothing can be written, it waits.
    pub(super) async fn take(&self, topic: &str, payload: impl AsRef<[u8]>) {
        let payload = payload.as_ref();
        loop {
            let Some((reason, tries)) = self.store(topic, payload).await else { return };
            match self.monitor.store().quarantine().insert(topic, payload, &reason, tries, Timestamp::now()).await {
                Ok(()) => {
                    count("quarantined");
                    warn!(topic = %shown(topic), reason, "Put an MQTT message into quarantine: {reason}");
                    return;
                }
                Err(failure) => {
                    count("waiting");
                    error!(error = %failure, "Could neither store an MQTT message nor put it aside; trying on: {failure}");
                    tokio::time::sleep(PAUSE_WITHOUT_STORE).await;
                }
            }
        }
    }

    /// Stores a message as a batch; else why that failed, and after how many tries.
    async fn store(&self, topic: &str, payload: &[u8]) -> Option<(String, u32)> {
        let mut pause = FIRST_PAUSE;
        for tries in 1.. {
            match self.store_once(topic, payload).await {
                Ok(replayed) => {
                    count(if replayed { "replayed" } else { "stored" });
                    return None;
                }
                Err(Refused::Poison(reason)) => return Some((reason, tries)),
                Err(Refused::Trouble(reason)) if tries >= TRIES => return Some((reason, tries)),
                Err(Refused::Trouble(reason)) => {
                    count("retried");
                    warn!(topic = %shown(topic), reason, tries, "Could not store an MQTT message yet: {reason}");
                    tokio::time::sleep(pause).await;
                    pause *= 2;
                }
            }
        }
        None
    }

    /// Whether the batch was there already.
    async fn store_once(&self, topic: &str, payload: &[u8]) -> Result<bool, Refused> {
        let batch = self.batch(topic, payload).await?;
        match self.monitor.ingest().take_when_free(batch).await {
            Ok(ingested) => Ok(ingested.replayed),
            Err(IngestError::Monitor(error @ (Error::Store(_) | Error::QueueFull(_) | Error::Panicked))) => {
                Err(Refused::Trouble(error.to_string()))
            }
            Err(error) => Err(Refused::Poison(error.to_string())),
        }
    }

    async fn batch(&self, topic: &str, payload: &[u8]) -> Result<MeasurementBatch, Refused> {
        let poison = |reason: String| Refused::Poison(reason);
        let id =
            self.topic.structure(topic).ok_or_else(|| poison(format!("the topic {} is not ours", shown(topic))))?;
        let id = StructureId::parse(id).map_err(|e| poison(e.to_string()))?;
        let active = self.monitor.structure(&id).map_err(|e| poison(e.to_string()))?;
        if payload.len() > self.max_payload_bytes {
            let (bytes, most) = (payload.len(), self.max_payload_bytes);
            return Err(poison(format!("{bytes} bytes are more than mqtt.max_payload_bytes, {most}: split the batch")));
        }
        let (monitor, payload) = (self.monitor.clone(), payload.to_vec());
        // A message of thousands of measurements takes milliseconds to parse: not on an async thread.
        let parse = move || {
            let raw = RawBatch::of_message(&payload).map_err(|error| match error {
                JsonError::Malformed(reason) => reason,
                JsonError::Shape(problem) => sentence(&[problem]),
            })?;
            monitor.ingest().check(&active, raw).map_err(|problems| sentence(&problems))
        };
        tokio::task::spawn_blocking(parse).await.map_err(|e| Refused::Trouble(e.to_string()))?.map_err(Refused::Poison)
    }
}

/// All problems of a batch as one text.
fn sentence(problems: &[Problem]) -> String {
    problems.iter().map(|p| format!("{}: {}", p.pointer, p.message)).collect::<Vec<_>>().join("; ")
}

fn count(outcome: &'static str) {
    metrics::counter!("modalwatch_mqtt_messages_total", "outcome" => outcome).increment(1);
}
