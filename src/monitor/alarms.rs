//! Reading the alarms of the structures and what people do with them, publishing them as events, and logging them.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Mutex;

use tracing::{error, warn};

use super::error::Error;
use super::events::{Events, News};
use crate::alarm::severity::{Grade, SeverityLimits};
use crate::clock;
use crate::quantity::StructureId;
use crate::store::{
    Acknowledgement, ActionKind, ActionOutcome, Episode, EpisodeQuery, Handling, MaintenanceWindow, NewAction, Note,
    OpenAlarms, Store, StoredChartPoint,
};

/// The alarms of the structures, with a record of those that were already published and logged.
pub struct Alarms {
    store: Store,
    events: Events,
    limits: SeverityLimits,
    published: Mutex<BTreeMap<StructureId, Published>>,
    /// Alarms that this process has logged.
    logged: Mutex<BTreeSet<(StructureId, i64)>>,
}

/// The alarms of a structure that were published.
#[derive(Debug, Clone, Default)]
struct Published {
    /// Number of the newest alarm that was published.
    newest: i64,
    open: BTreeSet<i64>,
}

impl Alarms {
    pub(super) fn new(store: Store, events: Events, limits: SeverityLimits) -> Self {
        Self { store, events, limits, published: Mutex::default(), logged: Mutex::default() }
    }

    /// Alarms of a structure, newest first.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn episodes(&self, structure: &StructureId, query: EpisodeQuery) -> Result<Vec<Episode>, Error> {
        Ok(self.store.alarms().episodes(structure, query).await?)
    }

    /// The open damage alarms of all structures.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn open_damage(&self) -> Result<OpenAlarms, Error> {
        Ok(self.store.alarms().open_damage().await?)
    }

    /// Acknowledges an alarm; only the first acknowledgement is kept. `None` when there is no such alarm.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn acknowledge(
        &self,
        structure: &StructureId,
        number: i64,
        acknowledgement: Acknowledgement,
    ) -> Result<Option<Episode>, Error> {
        let episode = self.store.alarms().acknowledge(structure, number, acknowledgement).await?;
        if let Some(episode) = &episode {
            self.events.publish(event(structure, episode, "acknowledged"));
        }
        Ok(episode)
    }

    /// Limits of the severity of alarms.
    pub fn limits(&self) -> SeverityLimits {
        self.limits
    }

    /// What people have done with alarms of a structure, by the number of the alarm.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn handling(
        &self,
        structure: &StructureId,
        episodes: &[Episode],
    ) -> Result<BTreeMap<i64, Handling>, Error> {
        let numbers: Vec<i64> = episodes.iter().map(|episode| episode.number).collect();
        Ok(self.store.alarm_actions().of(structure, &numbers).await?)
    }

    /// An alarm with what people have done with it; `None` when there is no such alarm.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn one(&self, structure: &StructureId, number: i64) -> Result<Option<(Episode, Handling)>, Error> {
        let query = EpisodeQuery { before: number.checked_add(1), open_only: false, superseded: true, limit: 1 };
        let mut found = self.store.alarms().episodes(structure, query).await?;
        let Some(episode) = found.pop().filter(|episode| episode.number == number) else { return Ok(None) };
        let mut handling = self.store.alarm_actions().of(structure, &[number]).await?;
        Ok(Some((episode, handling.remove(&number).unwrap_or_default())))
    }

    /// Does something with an alarm.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn act(&self, structure: &StructureId, number: i64, action: NewAction) -> Result<ActionOutcome, Error> {
        let state = match action.kind {
            ActionKind::Comment { .. } => "commented",
            ActionKind::Assignment { .. } => "assigned",
            ActionKind::Closing { .. } => "closed",
            ActionKind::Reopening { .. } => "reopened",
        };
        let outcome = self.store.alarm_actions().add(structure, number, action).await?;
        if outcome == ActionOutcome::Stored {
            if let Some((episode, _)) = self.one(structure, number).await? {
                self.events.publish(event(structure, &episode, state));
            }
        }
        Ok(outcome)
    }

    /// Adds a note to the time line; false if there are too many.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn add_note(&self, structure: &StructureId, note: Note) -> Result<bool, Error> {
        let stored = self.store.notes().insert(structure, note).await?;
        if stored {
            self.events.structure_changed(structure);
        }
        Ok(stored)
    }

    /// Notes of a structure, the newest first.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn notes(&self, structure: &StructureId) -> Result<Vec<Note>, Error> {
        Ok(self.store.notes().list(structure).await?)
    }

    /// Deletes a note. Returns whether it existed.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn delete_note(&self, structure: &StructureId, note: &str) -> Result<bool, Error> {
        let deleted = self.store.notes().delete(structure, note).await?;
        if deleted {
            self.events.structure_changed(structure);
        }
        Ok(deleted)
    }

    /// The newest `limit` points of each chart of a structure, oldest first.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn charts(&self, structure: &StructureId, limit: usize) -> Result<Vec<StoredChartPoint>, Error> {
        Ok(self.store.alarms().charts(structure, limit).await?)
    }

    /// Adds a maintenance window: batches measured in it do not enter the charts.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn add_maintenance(&self, structure: &StructureId, window: MaintenanceWindow) -> Result<(), Error> {
        Ok(self.store.alarms().insert_maintenance(structure, window, clock::now()).await?)
    }

    /// Maintenance windows of a structure, newest first.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn maintenance(&self, structure: &StructureId) -> Result<Vec<MaintenanceWindow>, Error> {
        Ok(self.store.alarms().maintenance(structure).await?)
    }

    /// Publishes the alarms that changed since the last call, and logs each open alarm once.
    pub(super) async fn report(&self, structure: &StructureId) {
        let open = self.publish_changes(structure).await;
        self.grade(structure, &open).await;
        for episode in open {
            let key = (structure.clone(), episode.number);
            if !self.logged.lock().expect("no holder of this lock panics").insert(key) {
                continue;
            }
            metrics::counter!("modalwatch_alarms_total", "kind" => episode.kind.clone()).increment(1);
            warn!(
                structure.id = %structure, episode = episode.number, kind = %episode.kind, series = %episode.series,
                "Alarm {} of {structure}: {} ({}), since {}", episode.number, episode.kind, episode.series, episode.opened_at
            );
        }
    }

    /// Stores the grades of open alarms that have become more severe, which sends a message.
    async fn grade(&self, structure: &StructureId, open: &[Episode]) {
        let grade = |episode: &Episode| (episode.number, episode.severity(self.limits).grade);
        let risen = open.iter().filter(|episode| Some(grade(episode).1) > episode.highest_grade);
        let risen: Vec<(i64, Grade)> = risen.map(grade).collect();
        if risen.is_empty() {
            return;
        }
        if let Err(failure) = self.store.alarms().raise_grades(structure, risen).await {
            error!(structure.id = %structure, error = %failure, "Could not store the severity of alarms of {structure}: {failure}");
        }
    }

    /// Publishes the alarms that were opened, ended or withdrawn since the last call, and returns the open alarms.
    pub(super) async fn publish_changes(&self, structure: &StructureId) -> Vec<Episode> {
        let (changes, open) = self.changes(structure).await;
        for news in changes {
            self.events.publish(news);
        }
        open
    }

    /// Returns the events for the alarms of a structure that changed since the last call, and the open alarms. The next call does
    /// not return the same events again.
    pub(super) async fn changes(&self, structure: &StructureId) -> (Vec<News>, Vec<Episode>) {
        let published = || self.published.lock().expect("no holder of this lock panics");
        let Published { newest, open } = published().get(structure).cloned().unwrap_or_default();
        let open: Vec<i64> = open.into_iter().collect();
        match self.store.alarms().episodes_since(structure, newest, &open).await {
            Ok(mut episodes) => {
                let changes = published().entry(structure.clone()).or_default().update(structure, &episodes);
                episodes.retain(|episode| episode.state() == "open");
                (changes, episodes)
            }
            Err(failure) => {
                error!(structure.id = %structure, error = %failure, "Could not read the changed alarms of {structure}: {failure}");
                Default::default()
            }
        }
    }
}

impl Published {
    /// Updates the record of published alarms from the stored ones, and returns the events for the changes.
    fn update(&mut self, structure: &StructureId, episodes: &[Episode]) -> Vec<News> {
        let mut changes = Vec::new();
        for episode in episodes {
            let open = episode.state() == "open";
            let was_open = self.open.contains(&episode.number);
            if open != was_open || episode.number > self.newest {
                changes.push(event(structure, episode, episode.state()));
            }
            if open {
                self.open.insert(episode.number);
            } else {
                self.open.remove(&episode.number);
            }
        }
        self.newest = episodes.iter().map(|e| e.number).max().unwrap_or(0).max(self.newest);
        changes
    }
}

fn event(structure: &StructureId, episode: &Episode, state: &'static str) -> News {
    News::Alarm { structure: structure.clone(), alarm: episode.number, kind: episode.kind.clone(), state }
}
