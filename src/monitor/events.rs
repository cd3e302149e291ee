//! News for whoever watches: what was stored, assessed, alarmed, computed. Nobody waits for them, and they may be missed; the
//! store has what happened.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, RwLock};

use serde::Serialize;
use tokio::sync::broadcast;
use tracing::error;

use super::Monitor;
use crate::assessment::BatchState;
use crate::quantity::StructureId;
use crate::store::{Episode, JobKind, JobState};

/// News kept for a watcher who is slow; one who falls further behind is told so and goes on with the newest.
const KEPT: usize = 1_024;

/// Something that happened.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(untagged)]
pub enum News {
    /// A batch was assessed, failed, or is stored and has to wait.
    Batch {
        /// Its structure.
        structure: StructureId,
        /// Its id.
        batch: String,
        /// How far it has come.
        state: BatchState,
    },
    /// An alarm was opened, ended, withdrawn or acknowledged.
    Alarm {
        /// Its structure.
        structure: StructureId,
        /// Its number.
        alarm: i64,
        /// `damage`, `simulation_does_not_fit` or `silence`.
        kind: String,
        /// `open`, `ended`, `withdrawn`, or `acknowledged` for one that somebody has just seen.
        state: &'static str,
    },
    /// A job began, went on or ended.
    Job {
        /// Its id, that of the diagnosis.
        job: String,
        /// Its structure.
        structure: StructureId,
        /// What it does.
        kind: JobKind,
        /// How far it has come.
        state: JobState,
        /// What it does now; `None` when it has ended.
        progress: Option<String>,
    },
    /// A structure was defined, has another version, or another undamaged state.
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

/// The bus: a cheap handle.
#[derive(Debug, Clone)]
pub struct Events {
    /// `None` when the service stops: watchers see the end of their streams then.
    sender: Arc<RwLock<Option<broadcast::Sender<News>>>>,
}

impl Default for Events {
    fn default() -> Self {
        Self { sender: Arc::new(RwLock::new(Some(broadcast::channel(KEPT).0))) }
    }
}

impl Events {
    /// Tells all who watch now.
    pub fn publish(&self, news: News) {
        if let Some(sender) = &*self.sender.read().expect("no holder of this lock panics") {
            // An error means that nobody watches.
            let _ = sender.send(news);
        }
    }

    /// What happens from now on; `None` when the service stops.
    pub fn watch(&self) -> Option<broadcast::Receiver<News>> {
        self.sender.read().expect("no holder of this lock panics").as_ref().map(broadcast::Sender::subscribe)
    }

    /// Ends all streams once they have been told what happened so far.
    pub fn close(&self) {
        self.sender.write().expect("no holder of this lock panics").take();
    }
}

/// Alarms as watchers know them.
#[derive(Debug, Clone, Default)]
pub(super) struct KnownAlarms(Arc<Mutex<BTreeMap<StructureId, Known>>>);

#[derive(Debug, Clone, Default)]
struct Known {
    /// Number of the newest.
    newest: i64,
    open: BTreeSet<i64>,
}

impl KnownAlarms {
    fn of(&self, structure: &StructureId) -> Known {
        self.0.lock().expect("no holder of this lock panics").get(structure).cloned().unwrap_or_default()
    }

    /// Takes in what the store says; what is new in it.
    fn learn(&self, structure: &StructureId, episodes: &[Episode]) -> Vec<News> {
        let mut all = self.0.lock().expect("no holder of this lock panics");
        let known = all.entry(structure.clone()).or_default();
        let mut news = Vec::new();
        for episode in episodes {
            let open = episode.state() == "open";
            let was_open = known.open.contains(&episode.number);
            if open != was_open || episode.number > known.newest {
                news.push(alarm_news(structure, episode, episode.state()));
            }
            if open {
                known.open.insert(episode.number);
            } else {
                known.open.remove(&episode.number);
            }
        }
        known.newest = episodes.iter().map(|e| e.number).max().unwrap_or(0).max(known.newest);
        news
    }
}

fn alarm_news(structure: &StructureId, episode: &Episode, state: &'static str) -> News {
    News::Alarm { structure: structure.clone(), alarm: episode.number, kind: episode.kind.clone(), state }
}

impl Monitor {
    /// The bus of news.
    pub fn events(&self) -> &Events {
        &self.events
    }

    /// Tells that somebody has seen an alarm.
    pub fn tell_acknowledged(&self, structure: &StructureId, episode: &Episode) {
        self.events.publish(alarm_news(structure, episode, "acknowledged"));
    }

    pub(super) fn tell_batch(&self, structure: &StructureId, batch: &str, state: BatchState) {
        self.events.publish(News::Batch { structure: structure.clone(), batch: batch.to_owned(), state });
    }

    pub(super) fn tell_structure(&self, structure: &StructureId) {
        self.events.publish(News::Structure { structure: structure.clone() });
    }

    /// Tells of the alarms that were opened, ended or withdrawn since the last look; those that last.
    pub(super) async fn tell_alarms(&self, structure: &StructureId) -> Vec<Episode> {
        let (news, open) = self.look_at_alarms(structure).await;
        for news in news {
            self.events.publish(news);
        }
        open
    }

    /// Takes in the alarms of a structure; what is new, and those that last.
    pub(super) async fn look_at_alarms(&self, structure: &StructureId) -> (Vec<News>, Vec<Episode>) {
        let Known { newest, open } = self.known_alarms.of(structure);
        let open: Vec<i64> = open.into_iter().collect();
        match self.store.alarms().episodes_since(structure, newest, &open).await {
            Ok(mut episodes) => {
                let news = self.known_alarms.learn(structure, &episodes);
                episodes.retain(|episode| episode.state() == "open");
                (news, episodes)
            }
            Err(failure) => {
                error!(structure.id = %structure, error = %failure, "Could not look for changed alarms of {structure}: {failure}");
                Default::default()
            }
        }
    }
}
