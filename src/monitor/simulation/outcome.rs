//! What must hold when faults have ended and everything was done.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use super::history::{structure, Content, Kind};
use super::world::{Seen, World, WEBHOOK};
use crate::assessment::{Assessment, BatchState};
use crate::monitor::Monitor;
use crate::quantity::{Digest, Timestamp};
use crate::store::{
    BatchRecord, Delivery, Episode, EpisodeQuery, HistoryQuery, InsertBatch, ReferenceRecord, StoredChartPoint,
};

/// A stored batch.
pub(super) struct Stored {
    record: BatchRecord,
    content: Content,
    assessment: Option<Assessment>,
}

/// Everything that is stored, read again.
pub(super) struct Outcome {
    /// In the order of their arrival.
    batches: Vec<Stored>,
    reference: Option<Arc<ReferenceRecord>>,
    /// Digest of the trained model in use.
    model: Digest,
    charts: Vec<StoredChartPoint>,
    episodes: Vec<Episode>,
    messages: Vec<Delivery>,
}

type Violation = Result<(), String>;

fn ensure(holds: bool, violation: impl FnOnce() -> String) -> Violation {
    if holds {
        Ok(())
    } else {
        Err(violation())
    }
}

impl Outcome {
    pub async fn read(monitor: &Monitor) -> Self {
        let (id, store) = (structure(), monitor.store());
        let query = HistoryQuery { limit: 1_000, ..HistoryQuery::default() };
        let mut batches = Vec::new();
        for entry in monitor.records().history(&id, &query).await.unwrap() {
            // Compares the measurements with their digest.
            let view = monitor.records().batch(&id, &entry.batch_id).await.unwrap();
            let record = view.record;
            let place = Content::place_of(record.batch.time_span().0);
            let kinds = [Kind::Healthy, Kind::Damaged, Kind::Unusable, Kind::Other];
            let content = kinds.map(|kind| Content { place, kind });
            let content = content.into_iter().find(|content| content.measurements() == record.batch.measurements);
            let content = content.expect("a stored batch is one that was posted, and complete");
            batches.push(Stored { record, content, assessment: view.assessment });
        }
        batches.sort_by(|a, b| a.record.batch_id.cmp(&b.record.batch_id));
        let query = EpisodeQuery { before: None, open_only: false, superseded: true, limit: 1_000 };
        let mut messages = store.outbox().deliveries(WEBHOOK, None, None, 10_000).await.unwrap();
        messages.reverse();
        Self {
            batches,
            reference: store.reference().undamaged(&id).await.unwrap(),
            model: monitor.structure(&id).unwrap().trained_baseline().unwrap().digest().clone(),
            charts: monitor.alarms().charts(&id, 10_000).await.unwrap(),
            episodes: monitor.alarms().episodes(&id, query).await.unwrap(),
            messages,
        }
    }

    /// Digest of the trained model in use.
    pub fn model(&self) -> &Digest {
        &self.model
    }

    /// The newest reference, if it was made with the model in use.
    fn usable_reference(&self) -> Option<&ReferenceRecord> {
        self.reference.as_deref().filter(|reference| reference.model_digest == self.model)
    }

    fn content_of(&self, id: Option<&String>) -> Option<Content> {
        self.batches.iter().find(|stored| Some(&stored.record.batch_id) == id).map(|stored| stored.content)
    }

    /// What holds for each outcome by itself.
    pub fn check(&self, seen: &Seen) -> Violation {
        ensure(seen.violations.is_empty(), || seen.violations.join("; "))?;
        for (content, ids) in &seen.acknowledged {
            let found: Vec<&Stored> = self.batches.iter().filter(|stored| stored.content == *content).collect();
            let deleted = found.is_empty() && content.place < seen.retained_from;
            ensure(found.len() == 1 || deleted, || format!("{content:?} is stored {} times", found.len()))?;
            let id = found.first().map(|stored| &stored.record.batch_id);
            ensure(deleted || id == ids.last() || content.place < seen.retained_from, || {
                format!("{content:?} was acknowledged as {ids:?} and is stored as {id:?}")
            })?;
        }
        let places: BTreeSet<usize> = self.batches.iter().map(|stored| stored.content.place).collect();
        ensure(places.len() == self.batches.len(), || "a measurement is stored twice".to_owned())?;
        for stored in &self.batches {
            self.check_batch(stored)?;
        }
        self.check_episodes()?;
        self.check_messages()
    }

    /// A batch is assessed, or failed for a reason that its data justify, and is compared with the newest reference.
    fn check_batch(&self, Stored { record, content, assessment }: &Stored) -> Violation {
        let expected = if content.kind == Kind::Unusable { BatchState::Failed } else { BatchState::Assessed };
        ensure(record.state == expected, || format!("{content:?} is {:?}: {:?}", record.state, record.failure))?;
        ensure((expected == BatchState::Assessed) == assessment.is_some(), || format!("{content:?}: its assessment"))?;
        let (Some(assessment), Some(reference)) = (assessment, self.usable_reference()) else { return Ok(()) };
        let (member, version) = (reference.batches.contains(&record.batch_id), reference.state.version);
        let current = assessment.undamaged_version == Some(version) && assessment.model_digest == self.model;
        ensure(member || current, || {
            let (model, compared) = (&assessment.model_digest, assessment.undamaged_version);
            format!("{content:?} has an assessment of {model} and {compared:?} and not of reference {version}")
        })?;
        ensure(!(member && current), || format!("{content:?} is compared with a reference that contains it"))
    }

    /// No two episodes of a series overlap.
    fn check_episodes(&self) -> Violation {
        let mut of_series = BTreeMap::<_, Vec<(Timestamp, Option<Timestamp>)>>::new();
        for episode in self.episodes.iter().filter(|episode| !episode.withdrawn) {
            let series = (episode.undamaged_version, &episode.series);
            of_series.entry(series).or_default().push((episode.opened_at, episode.ended_at));
        }
        for ((version, series), mut times) in of_series {
            times.sort_unstable_by_key(|(opened, _)| *opened);
            let newest = self.reference.as_ref().map_or(0, |reference| reference.state.version);
            for pair in times.windows(2) {
                let before = pair[0].1.is_some_and(|ended| ended <= pair[1].0);
                // A reference ends the alarms of the one before it at the time of its declaration, whenever they were measured.
                let superseded = version != 0 && version < newest;
                ensure(pair[0].0 != pair[1].0 && (before || superseded), || {
                    format!("two episodes of {series} overlap: {times:?}")
                })?;
            }
        }
        Ok(())
    }

    /// The messages about each alarm are its history, each change once.
    fn check_messages(&self) -> Violation {
        for episode in &self.episodes {
            let of_alarm = self.messages.iter().filter(|message| message.event.alarm == episode.number);
            let kinds: Vec<&str> = of_alarm.map(|message| message.event.kind.as_str()).collect();
            let states: Vec<&str> = kinds.iter().copied().filter(|kind| STATES.contains(kind)).collect();
            let opened = states.first() == Some(&"alarm.opened");
            let changes = states.windows(2).all(|pair| pair[0] != pair[1] && pair[1] != "alarm.opened");
            let is = match (episode.withdrawn, episode.ended_at) {
                (true, _) => states.last() == Some(&"alarm.withdrawn"),
                (false, Some(_)) => states.last() == Some(&"alarm.ended"),
                (false, None) => ["alarm.opened", "alarm.reopened"].contains(states.last().unwrap_or(&"")),
            };
            let acknowledged = kinds.iter().filter(|kind| **kind == "alarm.acknowledged").count();
            let right = opened && changes && is && acknowledged == usize::from(episode.acknowledgement.is_some());
            ensure(right, || format!("the messages about {episode:?} are {kinds:?}"))?;
        }
        let known: BTreeSet<i64> = self.episodes.iter().map(|episode| episode.number).collect();
        let of_none = self.messages.iter().find(|message| !known.contains(&message.event.alarm));
        ensure(of_none.is_none(), || format!("there is a message about no alarm: {of_none:?}"))
    }

    /// Takes the same batches without faults, in the order in which they arrived, and compares. Returns how many assessments were equal.
    pub fn compare(&self, seen: &Seen, without_faults: &mut World<'_>) -> Result<usize, String> {
        let other = self.repeat(without_faults)?;
        let version = self.usable_reference().map_or(0, |reference| reference.state.version);
        let mut equal = 0;
        for (own, others) in self.batches.iter().zip(&other.batches) {
            let content = own.content;
            ensure(others.content == content, || format!("{content:?} came before {:?}", others.content))?;
            ensure(own.record.failure == others.record.failure, || format!("{content:?} failed for another reason"))?;
            let (Some(a), Some(b)) = (&own.assessment, &others.assessment) else { continue };
            // The batch that it repeats may have been deleted after its assessment.
            if content.repeats() && seen.retained_from >= content.place {
                continue;
            }
            let (one, two) = (a.undamaged_version.unwrap_or(0), b.undamaged_version.unwrap_or(0));
            // A batch of the reference keeps what it was before it became one.
            let same_reference = (one, two) == (0, 0) || (one, two) == (version, 1);
            if a.model_digest == b.model_digest && same_reference {
                let (a, b) = (fields(a), fields(b));
                ensure(a == b, || format!("{content:?} differs from that without faults:\n{a}\n{b}"))?;
                equal += 1;
            }
        }
        // After another model, or where batches were deleted, charts depend on what was assessed before.
        if seen.swapped || seen.retained_from > 0 {
            return Ok(equal);
        }
        let (one, two) = (self.points(), other.points());
        ensure(one == two, || format!("the charts differ from those without faults:\n{one:#?}\n{two:#?}"))?;
        let (one, two) = (self.alarms(version), other.alarms(1));
        ensure(one == two, || format!("the alarms differ from those without faults:\n{one:#?}\n{two:#?}"))?;
        Ok(equal)
    }

    fn repeat(&self, world: &mut World<'_>) -> Result<Self, String> {
        let life = world.life.as_ref().expect("the process runs");
        let (monitor, id) = (&life.monitor, structure());
        let outcome = life.runtime.block_on(async {
            let mut ids = BTreeMap::new();
            for Stored { record, content, .. } in &self.batches {
                let (own, at) = (uuid::Uuid::now_v7().to_string(), record.received_at);
                let stored = monitor.store().batches().insert_batch(&content.batch(None), &own, at).await.unwrap();
                assert!(matches!(stored, InsertBatch::Inserted { .. }));
                ids.insert(&record.batch_id, own);
            }
            if let Some(ReferenceRecord { state, model_digest, created_at, batches }) = self.usable_reference() {
                let batches: Vec<String> = batches.iter().map(|id| ids[id].clone()).collect();
                let reference = monitor.store().reference();
                reference.insert_undamaged(&id, state, model_digest, &batches, *created_at).await.unwrap();
            }
            monitor.replay().resume_all();
            life.idle().await?;
            Ok::<_, String>(Self::read(monitor).await)
        })?;
        Ok(outcome)
    }

    /// The points of the charts, each with its batch.
    fn points(&self) -> BTreeSet<String> {
        let point = |point: &StoredChartPoint| {
            let mut own = point.clone();
            own.batch_id.clear();
            format!("{:?} {own:?}", self.content_of(Some(&point.batch_id)))
        };
        self.charts.iter().map(point).collect()
    }

    /// The alarms of the newest reference and of the fit.
    fn alarms(&self, version: u32) -> BTreeSet<String> {
        let present = |episode: &&Episode| !episode.withdrawn && [0, version].contains(&episode.undamaged_version);
        let alarm = |e: &Episode| {
            let batch = self.content_of(e.opened_batch.as_ref());
            format!("{} {} {} {batch:?} {:?} {:?}", e.kind, e.series, e.opened_at, e.ended_at, e.peak_shift)
        };
        self.episodes.iter().filter(present).map(alarm).collect()
    }

    /// Number of batches, and of alarms that were not withdrawn.
    pub fn size(&self) -> (usize, usize) {
        (self.batches.len(), self.episodes.iter().filter(|episode| !episode.withdrawn).count())
    }
}

/// Kinds of messages about the state of an alarm.
const STATES: [&str; 4] = ["alarm.opened", "alarm.reopened", "alarm.ended", "alarm.withdrawn"];

/// All fields of an assessment except its time and the number of its reference. `Debug` prints the shortest text that parses to the same
/// float, so the texts differ if a single bit differs.
fn fields(assessment: &Assessment) -> String {
    let mut own = assessment.clone();
    own.assessed_at = Timestamp::from_micros(0).unwrap();
    own.undamaged_version = own.undamaged_version.map(|_| 1);
    format!("{own:?}")
}
