//! Live events for subscribers: batches stored and assessed, alarms, jobs. Delivery is best effort: a subscriber may miss events,
//! and the database has the complete record.

use std::sync::{Arc, RwLock};

use serde::Serialize;
use tokio::sync::broadcast;

use crate::assessment::BatchState;
use crate::quantity::StructureId;
use crate::store::{DiagnosisTrigger, JobKind, JobState};

/// Number of events buffered for a slow subscriber. A subscriber that falls further behind is notified and continues with the
/// newest events.
const KEPT: usize = 1_024;

/// One event.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(untagged)]
pub enum News {
    /// A batch was assessed, could not be assessed, or was stored and waits for its assessment.
    Batch {
        /// Its structure.
        structure: StructureId,
        /// Its id.
        batch: String,
        /// State of its processing.
        state: BatchState,
    },
    /// An alarm was opened, ended or withdrawn, or a person did something with it.
    Alarm {
        /// Its structure.
        structure: StructureId,
        /// Its number.
        alarm: i64,
        /// `damage`, `simulation_does_not_fit`, `silence` or `not_assessed`.
        kind: String,
        /// `open`, `ended`, `withdrawn`; or what a person just did: `acknowledged`, `commented`, `assigned`, `closed`, `reopened`.
        state: &'static str,
    },
    /// A job began, progressed or ended.
    Job {
        /// Its id, that of the diagnosis or training.
        job: String,
        /// Its structure.
        structure: StructureId,
        /// Its kind.
        kind: JobKind,
        /// Its state.
        state: JobState,
        /// What it is doing now; `None` when it has ended.
        progress: Option<String>,
        /// The share that is done, 0 to 1, where it is known.
        #[serde(skip_serializing_if = "Option::is_none")]
        share: Option<f64>,
        /// Estimated time left, s, where there is something to estimate it from.
        #[serde(skip_serializing_if = "Option::is_none")]
        time_left_s: Option<f64>,
        /// Its place among the waiting jobs of its lane, from 1; `None` for one that does not wait.
        #[serde(skip_serializing_if = "Option::is_none")]
        place: Option<usize>,
        /// Why it was started; `None` for an extension or a training.
        trigger: Option<DiagnosisTrigger>,
    },
    /// A structure was defined, or its version or undamaged reference changed.
    Structure {
        /// Its id.
        structure: StructureId,
    },
}

impl News {
    /// The structure it is about.
    pub fn structure(&self) -> &StructureId {
        match self {
            Self::Batch { structure, .. }
            | Self::Alarm { structure, .. }
            | Self::Job { structure, .. }
            | Self::Structure { structure } => structure,
        }
    }

    /// Name of the kind of event.
    pub const fn name(&self) -> &'static str {
        match self {
            Self::Batch { .. } => "batch",
            Self::Alarm { .. } => "alarm",
            Self::Job { .. } => "job",
            Self::Structure { .. } => "structure",
        }
    }
}

/// The event bus; cloning gives a handle on the same bus.
#[derive(Debug, Clone)]
pub struct Events {
    /// `None` when the service stops, which ends the streams of the subscribers.
    sender: Arc<RwLock<Option<broadcast::Sender<News>>>>,
}

impl Default for Events {
    fn default() -> Self {
        Self { sender: Arc::new(RwLock::new(Some(broadcast::channel(KEPT).0))) }
    }
}

impl Events {
    /// Publishes an event to the present subscribers.
    pub fn publish(&self, news: News) {
        if let Some(sender) = &*self.sender.read().expect("no holder of this lock panics") {
            // An error means that there are no subscribers.
            let _ = sender.send(news);
        }
    }

    /// The events from now on; `None` when the service stops.
    pub fn watch(&self) -> Option<broadcast::Receiver<News>> {
        self.sender.read().expect("no holder of this lock panics").as_ref().map(broadcast::Sender::subscribe)
    }

    /// Ends all streams after the events published so far.
    pub fn close(&self) {
        self.sender.write().expect("no holder of this lock panics").take();
    }

    /// Publishes that a batch was stored, assessed or failed.
    pub(super) fn batch_changed(&self, structure: &StructureId, batch: &str, state: BatchState) {
        self.publish(News::Batch { structure: structure.clone(), batch: batch.to_owned(), state });
    }

    /// Publishes that a structure changed.
    pub(super) fn structure_changed(&self, structure: &StructureId) {
        self.publish(News::Structure { structure: structure.clone() });
    }
}
