//! Faults at the n-th call, for all n: wherever the processing of a batch fails, a retry stores it once and assesses it.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock};

use super::compute::ComputeSettings;
use super::events::News;
use super::structures::ActiveStructure;
use super::{Error, IngestError, Ingested, Missing, Monitor, MonitorSettings, ReferenceChoice, ReferenceRequest};
use crate::assessment::BatchState;
use crate::baseline::library::Library;
use crate::fault::Faults;
use crate::measurement::{MeasurementBatch, ModalMeasurement};
use crate::quantity::{Hertz, StructureId, Timestamp};
use crate::simulator::definition::StructureDefinition;
use crate::simulator::Simulator;
use crate::store::{self, HistoryQuery, NewVersion, Store, DATABASE_FILE};

fn structure() -> StructureId {
    StructureId::parse("three-dof").unwrap()
}

/// Frequencies of the structure in measurement `row`, Hz, with stiffnesses spread by ±2 %.
fn measured_hz(row: usize) -> Vec<Option<Hertz>> {
    static SIMULATOR: OnceLock<Simulator> = OnceLock::new();
    let simulator = SIMULATOR.get_or_init(|| Library::open(None).unwrap().get(&structure()).unwrap().simulator.clone());
    let wave = |phase: usize| 1.0 + 0.02 * ((row * 7 + phase * 3) as f64).sin();
    let exact = simulator.frequencies_hz(&[4.0 * wave(0), 5.0 * wave(1), 6.0 * wave(2)]).unwrap();
    exact.into_iter().map(|f| Hertz::new(f).ok()).collect()
}

/// Measurements of a batch: more than are inserted by one statement.
const MEASUREMENTS: usize = 33;

/// Batch `number`, whose measurement times differ from those of all other batches.
fn batch(number: usize) -> MeasurementBatch {
    let one = |i: usize| ModalMeasurement {
        measured_at: Timestamp::from_micros(1_767_225_600_000_000 + (MEASUREMENTS * number + i) as i64 * 1_000_000)
            .unwrap(),
        frequencies_hz: measured_hz(MEASUREMENTS * number + i),
        std_hz: None,
        mode_shapes: None,
        covariates: BTreeMap::new(),
        settings: BTreeMap::new(),
    };
    MeasurementBatch {
        structure: structure(),
        source: "logger".to_owned(),
        idempotency_key: Some(format!("key-{number}")),
        measurements: (0..MEASUREMENTS).map(one).collect(),
    }
}

/// The declaration of these batches as the undamaged reference.
fn reference(ids: &[String]) -> ReferenceRequest {
    let choice = ReferenceChoice::Batches(ids.to_vec());
    ReferenceRequest { choice, leave_out_doubtful: false, threshold_probability: 0.05, reason: None }
}

async fn open(folder: &Path) -> Monitor {
    open_with(folder, MonitorSettings::default()).await
}

async fn open_with(folder: &Path, settings: MonitorSettings) -> Monitor {
    let mut opened = Store::open(folder).await;
    for _ in 0..1_200 {
        // Background tasks of the previous monitor may still hold the store open.
        if !matches!(opened, Err(store::Error::Locked(_))) {
            break;
        }
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        opened = Store::open(folder).await;
    }
    let store = opened.expect("the store opens");
    Monitor::open(store, Library::open(None).unwrap(), settings).await.unwrap()
}

/// Ids of all batches, each of which must be assessed and complete.
async fn stored(monitor: &Monitor) -> Vec<String> {
    let query = HistoryQuery { limit: 1_000, ..HistoryQuery::default() };
    let items = monitor.store().history().page(&structure(), &query).await.unwrap();
    for item in &items {
        assert_eq!((item.state, item.measurement_count), (BatchState::Assessed, MEASUREMENTS), "{}", item.batch_id);
        assert!(item.assessment.is_some());
        // Compares the measurements with their digest.
        monitor.store().batches().batch(&structure(), &item.batch_id).await.unwrap().unwrap();
    }
    items.into_iter().map(|item| item.batch_id).collect()
}

/// Posts a batch again until it is accepted, as a client does after an error.
async fn retried(monitor: &Monitor, number: usize, tries: usize) -> Ingested {
    for _ in 0..tries {
        match monitor.ingest().take(batch(number)).await {
            Ok(taken) if taken.view.record.state == BatchState::Assessed => return taken,
            _ => {}
        }
    }
    panic!("batch {number} was not taken in {tries} tries");
}

#[tokio::test]
async fn whichever_call_fails_a_retry_stores_the_batch_once_and_assesses_it() {
    let folder = tempfile::tempdir().unwrap();
    let faults = Faults::arm();
    let monitor = open(folder.path()).await;
    let (mut number, mut failures) = (0, 0);
    for point in ["store::begin", "store::measurement", "store::commit", "store::committed", "store::read"] {
        // One error, one panic, and an error that persists until it is cleared.
        for (action, stays) in [("1*return", false), ("1*panic", false), ("return", true)] {
            let (mut call, mut elsewhere) = (0, 0);
            loop {
                let met = calls_of(&faults, point);
                faults.set(point, &format!("{call}*off->{action}"));
                let outcome = monitor.ingest().take(batch(number)).await;
                // A batch whose assessment fails is stored, and answered as such.
                let waits = |outcome: &Result<Ingested, IngestError>| {
                    outcome.as_ref().is_ok_and(|taken| taken.view.record.state == BatchState::Received)
                };
                if outcome.is_ok() && !waits(&outcome) {
                    faults.clear(point);
                    number += 1;
                    // A read behind the last commit: the batch is answered as it was stored.
                    if point == "store::read" && met.load(Ordering::Relaxed) > call {
                        call += 1;
                        continue;
                    }
                    if call < 2 {
                        // The background retry that begins two seconds after an earlier fault has met this fault instead.
                        elsewhere += 1;
                        assert!(elsewhere < 10, "{point} is called {call} times only");
                        continue;
                    }
                    // No call was left to fail.
                    break;
                }
                if let Err(error) = outcome {
                    let expected = matches!(error, IngestError::Monitor(Error::Store(_) | Error::Panicked));
                    assert!(expected, "{point} {action}: {error}");
                }
                if stays {
                    let again = monitor.ingest().take(batch(number)).await;
                    assert!(again.is_err() || waits(&again), "{point} fails still");
                }
                faults.clear(point);
                let taken = retried(&monitor, number, 3).await;
                assert_eq!(taken.view.record.state, BatchState::Assessed, "{point} {action}, call {call}");
                assert!(monitor.ingest().take(batch(number)).await.unwrap().replayed);
                (number, failures) = (number + 1, failures + 1);
                call += 1;
                assert!(call < 50, "{point} never runs out");
            }
        }
    }
    let ids = stored(&monitor).await;
    assert_eq!(ids.len(), number, "each batch once");
    println!("{failures} calls failed over {number} batches");
    drop(faults);
    monitor.store().close().await;
    drop(monitor);
    // The same holds after the store is opened again, which checks the file.
    let monitor = open(folder.path()).await;
    assert_eq!(stored(&monitor).await, ids);
}

/// Counts the calls of a point from now on.
fn calls_of(faults: &Faults, counted: &'static str) -> Arc<AtomicUsize> {
    let calls = Arc::new(AtomicUsize::new(0));
    let counter = Arc::clone(&calls);
    faults.follow(move |point| {
        if point == counted {
            counter.fetch_add(1, Ordering::Relaxed);
        }
        true
    });
    calls
}

#[tokio::test]
async fn a_batch_that_is_stored_is_answered_so_although_no_read_behind_its_commits_succeeds() {
    let folder = tempfile::tempdir().unwrap();
    let faults = Faults::arm();
    let monitor = open(folder.path()).await;
    let (before, after) = (Arc::new(AtomicUsize::new(0)), Arc::new(AtomicUsize::new(0)));
    // The first commit stores the batch, the second its assessment.
    let (mut commits, reads) = (0, [Arc::clone(&before), Arc::clone(&after)]);
    faults.follow(move |point| {
        let strikes = commits >= 2;
        match point {
            "store::committed" => commits += 1,
            "store::read" => _ = reads[usize::from(strikes)].fetch_add(1, Ordering::Relaxed),
            _ => {}
        }
        strikes
    });
    faults.set("store::read", "return");
    let taken = monitor.ingest().take(batch(0)).await.unwrap();
    assert_eq!(taken.view.record.state, BatchState::Assessed);
    assert!(taken.view.assessment.is_some() && taken.view.missing.is_none(), "why it is not compared cannot be read");
    assert!(after.load(Ordering::Relaxed) > 0, "nothing is read behind the second commit: this tests nothing");
    // Each of its own: a structure without a model, whose batches are stored and read.
    let definition = StructureDefinition {
        id: "other".to_owned(),
        ..monitor.structure(&structure()).unwrap().simulator.definition().clone()
    };
    monitor.structures().put(Simulator::new(definition).unwrap()).await.unwrap();
    let without_model = MeasurementBatch { structure: StructureId::parse("other").unwrap(), ..batch(0) };
    let taken = monitor.ingest().take(without_model).await.unwrap();
    assert_eq!(taken.view.record.state, BatchState::Received);
    assert!(matches!(taken.view.missing, Some(Missing::Model(_))));
}

#[tokio::test]
async fn a_waiting_batch_that_is_removed_while_it_is_sent_again_is_stored_again() {
    let faults = Faults::arm();
    let mut stored_again = 0;
    for call in 0.. {
        // In a folder of its own: nothing of an earlier attempt goes on in it while a batch is removed.
        let folder = tempfile::tempdir().unwrap();
        let monitor = open(folder.path()).await;
        let (number, first) = (batch(0), "first".to_owned());
        monitor.store().batches().insert_batch(&number, &first, Timestamp::now()).await.unwrap();
        let (reads, database, removed) = (AtomicUsize::new(0), folder.path().join(DATABASE_FILE), first.clone());
        let remove = move || {
            let remove = store::remove_beside(&database, "three-dof", &removed);
            tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap().block_on(remove);
        };
        let (done, remove) = (Arc::new(AtomicBool::new(false)), Arc::new(remove));
        let was_removed = Arc::clone(&done);
        faults.call("store::read", move || {
            if reads.fetch_add(1, Ordering::Relaxed) == call {
                let remove = Arc::clone(&remove);
                std::thread::spawn(move || remove()).join().unwrap();
                was_removed.store(true, Ordering::Relaxed);
            }
        });
        let taken = monitor.ingest().take(number).await.unwrap_or_else(|e| panic!("removed at read {call}: {e}"));
        faults.clear("store::read");
        assert_eq!(taken.view.record.state, BatchState::Assessed, "removed at read {call}");
        let id = taken.view.record.batch_id;
        if !done.load(Ordering::Relaxed) {
            assert_eq!(id, first);
            break;
        }
        let stored = monitor.store().batches().state(&structure(), &id).await.unwrap();
        if id == first {
            assert_eq!(stored, None, "it was assessed, and then removed");
        } else {
            assert_eq!(stored.map(|(state, _)| state), Some(BatchState::Assessed));
            stored_again += 1;
        }
        monitor.store().close().await;
        assert!(call < 50, "the reads never run out");
    }
    assert!(stored_again >= 2, "{stored_again} removals before the assessment was stored");
}

#[tokio::test]
async fn an_import_that_fails_behind_its_transaction_says_that_everything_is_stored() {
    let (here, there) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let faults = Faults::arm();
    let monitor = open(here.path()).await;
    monitor.ingest().take(batch(0)).await.unwrap();
    let mut lines = monitor.archive().export(&structure()).await.unwrap();
    let (archive, mut bytes) = (here.path().join("archive.ndjson"), Vec::new());
    while let Some(line) = lines.recv().await {
        bytes.extend(line.unwrap());
    }
    std::fs::write(&archive, bytes).unwrap();
    let other = open(there.path()).await;
    let mut committed = false;
    faults.follow(move |point| {
        committed |= point == "store::committed";
        committed && point == "store::query"
    });
    faults.set("store::query", "return");
    let imported = other.archive().import(&archive).await.unwrap();
    assert_eq!(imported.batches_new, 1);
    assert!(imported.warnings.iter().any(|warning| warning.contains("everything is stored")), "{imported:?}");
    faults.clear("store::query");
    // As the next start does.
    other.replay.resume(&structure()).await.unwrap();
    assert_eq!(stored(&other).await.len(), 1);
}

#[tokio::test]
async fn a_batch_whose_assessment_could_not_be_stored_gets_it_without_being_sent_again() {
    let folder = tempfile::tempdir().unwrap();
    let faults = Faults::arm();
    let monitor = open(folder.path()).await;
    // The first commit stores the batch, the second would store its assessment.
    faults.set("store::commit", "1*off->return");
    let taken = monitor.ingest().take(batch(0)).await.unwrap();
    assert_eq!(taken.view.record.state, BatchState::Received, "the batch is stored");
    assert!(taken.view.missing.is_some_and(|missing| missing.to_string().contains("is stored")));
    faults.clear("store::commit");
    for _ in 0..600 {
        tokio::time::sleep(std::time::Duration::from_millis(100)).await;
        let query = HistoryQuery { limit: 10, ..HistoryQuery::default() };
        let items = monitor.store().history().page(&structure(), &query).await.unwrap();
        if items.len() == 1 && items[0].state == BatchState::Assessed {
            return;
        }
    }
    panic!("the batch still waits");
}

/// What a batch that waits goes through when reads fail.
#[tokio::test]
async fn no_error_of_a_read_marks_a_batch_as_failed() {
    let folder = tempfile::tempdir().unwrap();
    let faults = Faults::arm();
    let monitor = open(folder.path()).await;
    let (id, state) = (structure(), async |batch: &str| {
        let record = monitor.store().batches().batch(&structure(), batch).await.unwrap().unwrap();
        record.state
    });
    let mut number = 0;
    for kind in ["", "(busy)", "(interrupted)"] {
        for in_a_row in ["1*", "3*", ""] {
            let mut call = 0;
            loop {
                let batch_id = format!("b{number}");
                let (batches, given) = (monitor.store().batches(), batch(number));
                batches.insert_batch(&given, &batch_id, Timestamp::now()).await.unwrap();
                number += 1;
                faults.set("store::query", &format!("{call}*off->{in_a_row}return{kind}"));
                let resumed = monitor.replay.resume(&id).await;
                faults.clear("store::query");
                let left = state(&batch_id).await;
                if resumed.is_ok() {
                    assert_eq!(left, BatchState::Assessed);
                    break;
                }
                assert_ne!(left, BatchState::Failed, "call {call} fails {in_a_row}{kind}");
                monitor.replay.resume(&id).await.unwrap();
                assert_eq!(state(&batch_id).await, BatchState::Assessed);
                call += 1;
                assert!(call < 50, "the reads never run out");
            }
            assert!(call >= 4, "only {call} reads failed");
        }
    }
}

#[tokio::test]
async fn a_batch_that_was_stored_although_the_call_failed_is_assessed_without_being_sent_again() {
    let folder = tempfile::tempdir().unwrap();
    let faults = Faults::arm();
    let monitor = open(folder.path()).await;
    faults.set("store::committed", "1*return");
    assert!(monitor.ingest().take(batch(0)).await.is_err());
    for _ in 0..600 {
        let query = HistoryQuery { limit: 10, ..HistoryQuery::default() };
        let items = monitor.store().history().page(&structure(), &query).await.unwrap();
        if items.len() == 1 && items[0].state == BatchState::Assessed {
            return;
        }
        tokio::time::sleep(std::time::Duration::from_millis(100)).await;
    }
    panic!("the batch still waits");
}

#[tokio::test]
async fn batches_are_compared_with_a_reference_that_was_stored_although_its_declaration_failed() {
    let folder = tempfile::tempdir().unwrap();
    let faults = Faults::arm();
    let monitor = open(folder.path()).await;
    let mut ids = Vec::new();
    for number in 0..4 {
        ids.push(monitor.ingest().take(batch(number)).await.unwrap().view.record.batch_id);
    }
    faults.set("store::committed", "1*return");
    assert!(monitor.replay().declare_reference(&structure(), reference(&ids[..3])).await.is_err());
    faults.clear("store::committed");
    for _ in 0..1_200 {
        let view = monitor.records().batch(&structure(), &ids[3]).await.unwrap();
        if view.assessment.is_some_and(|a| a.undamaged_version == Some(1)) {
            return;
        }
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    }
    panic!("the batch still waits for the comparison");
}

#[tokio::test]
async fn a_definition_that_was_stored_although_the_call_failed_is_used_after_the_next_call() {
    let folder = tempfile::tempdir().unwrap();
    let faults = Faults::arm();
    let monitor = open(folder.path()).await;
    let active = monitor.structure(&structure()).unwrap();
    let definition = StructureDefinition { id: "other".to_owned(), ..active.simulator.definition().clone() };
    let other = || Simulator::new(definition.clone()).unwrap();
    let id = StructureId::parse("other").unwrap();
    faults.set("store::committed", "1*return");
    assert!(monitor.structures().put(other()).await.is_err());
    faults.clear("store::committed");
    monitor.structures().put(other()).await.unwrap();
    assert_eq!(monitor.structure(&id).unwrap().simulator.id(), &id);
}

/// Another version of the structure, as an extension makes it.
fn another_version(of: &ActiveStructure) -> (NewVersion, Simulator) {
    let description = Some("another version".to_owned());
    let definition = StructureDefinition { description, ..of.simulator.definition().clone() };
    let simulator = Simulator::new(definition).unwrap();
    let version = NewVersion {
        digest: simulator.digest().clone(),
        definition_json: simulator.definition().canonical_json(),
        parent: Some(of.simulator.digest().clone()),
        diagnosis: None,
        baseline: None,
    };
    (version, simulator)
}

#[tokio::test]
async fn a_switch_of_versions_that_was_stored_although_it_failed_is_followed() {
    for reads_fail in [false, true] {
        let folder = tempfile::tempdir().unwrap();
        let faults = Faults::arm();
        let monitor = open(folder.path()).await;
        let before = monitor.structure(&structure()).unwrap();
        let (version, simulator) = another_version(&before);
        let digest = version.digest.clone();
        assert_ne!(digest, *before.simulator.digest());
        faults.set("store::committed", "1*return");
        if reads_fail {
            faults.set("store::query", "1*return");
        }
        let baseline = before.trained_baseline().unwrap();
        let switched = monitor.structures.switch_version(before.simulator.digest(), version, simulator, baseline).await;
        assert_eq!(switched.is_err(), reads_fail, "{switched:?}");
        for point in ["store::committed", "store::query"] {
            faults.clear(point);
        }
        // As every attempt to assess waiting batches does.
        monitor.structures.follow_stored(&structure()).await.unwrap();
        assert_eq!(*monitor.structure(&structure()).unwrap().simulator.digest(), digest);
    }
}

#[tokio::test]
async fn a_model_that_cannot_be_loaded_is_reported_and_the_others_stay_in_use() {
    let faults = Faults::arm();
    for call in 0..3 {
        faults.set("baseline::load", &format!("{call}*off->1*return"));
        let library = Library::open(None).unwrap();
        assert_eq!(library.refusals().len(), 1, "call {call}");
        assert_eq!(library.iter().filter(|(_, entry)| entry.baseline.is_some()).count(), 2);
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).await.unwrap();
        let monitor = Monitor::open(store, library, MonitorSettings::default()).await.unwrap();
        assert_eq!(monitor.upkeep().baselines_in_use(), 2);
    }
}

#[tokio::test]
async fn what_is_decided_after_the_clock_was_set_back_is_the_current_answer() {
    let folder = tempfile::tempdir().unwrap();
    let faults = Faults::arm();
    let monitor = open(folder.path()).await;
    let mut ids = Vec::new();
    for number in 0..6 {
        ids.push(monitor.ingest().take(batch(number)).await.unwrap().view.record.batch_id);
    }
    // A year back.
    faults.set("clock", &format!("return({})", Timestamp::now().micros() - 365 * 86_400_000_000));
    monitor.replay().declare_reference(&structure(), reference(&ids[..5])).await.unwrap();
    for _ in 0..1_200 {
        let view = monitor.records().batch(&structure(), &ids[5]).await.unwrap();
        if view.assessment.is_some_and(|a| a.undamaged_version == Some(1)) {
            return;
        }
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    }
    panic!("the comparison with the undamaged reference is not the current assessment");
}

/// Batches that are assessed again.
const REPLAYED: usize = 40;

/// What a replay on this number of threads stores for each batch: all numbers of its assessment and charts, without ids and times.
async fn replayed(threads: usize) -> Vec<String> {
    let folder = tempfile::tempdir().unwrap();
    let compute = ComputeSettings { threads, ..ComputeSettings::default() };
    let monitor = open_with(folder.path(), MonitorSettings { compute, ..MonitorSettings::default() }).await;
    let mut ids = Vec::new();
    for number in 0..REPLAYED {
        ids.push(monitor.ingest().take(batch(number)).await.unwrap().view.record.batch_id);
    }
    let mut news = monitor.events().watch().unwrap();
    monitor.replay().declare_reference(&structure(), reference(&ids[..5])).await.unwrap();
    let mut assessed = Vec::new();
    while assessed.len() < REPLAYED - 5 {
        if let News::Batch { batch, state, .. } = news.recv().await.unwrap() {
            assert_eq!(state, BatchState::Assessed);
            assessed.push(batch);
        }
    }
    assert_eq!(assessed, ids[5..], "in the order of arrival");
    let mut left = Vec::new();
    let mut times = BTreeSet::new();
    for id in &ids {
        let view = monitor.records().batch(&structure(), id).await.unwrap();
        let (mut assessment, mut charts) = (view.assessment.unwrap(), view.charts);
        times.insert(assessment.assessed_at);
        assessment.assessed_at = Timestamp::from_micros(0).unwrap();
        for point in &mut charts {
            point.batch_id.clear();
        }
        // `Debug` prints the shortest text that parses to the same float, so the texts differ if a single bit differs.
        left.push(format!("{assessment:?} {charts:?}"));
    }
    assert!(times.len() > 1);
    left
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_replay_gives_the_same_bits_in_the_same_order_on_any_number_of_threads() {
    let one = replayed(1).await;
    assert!(one[REPLAYED - 1].contains("undamaged_version: Some(1)"), "{}", one[REPLAYED - 1]);
    for threads in [2, 5] {
        assert_eq!(replayed(threads).await, one, "{threads} threads");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_batch_keeps_its_reference_when_all_are_assessed_by_another_model() {
    let folder = tempfile::tempdir().unwrap();
    let monitor = open(folder.path()).await;
    let mut ids = Vec::new();
    for number in 0..5 {
        ids.push(monitor.ingest().take(batch(number)).await.unwrap().view.record.batch_id);
    }
    monitor.replay().declare_reference(&structure(), reference(&ids[..3])).await.unwrap();
    monitor.replay().resume(&structure()).await.unwrap();
    for number in 5..9 {
        ids.push(monitor.ingest().take(batch(number)).await.unwrap().view.record.batch_id);
    }
    monitor.replay().declare_reference(&structure(), reference(&ids[5..8])).await.unwrap();
    monitor.replay().resume(&structure()).await.unwrap();
    let compared = async || {
        let mut all = BTreeMap::new();
        for id in &ids {
            let assessment = monitor.store().assessments().assessment(&structure(), id).await.unwrap().unwrap();
            all.insert(id.clone(), (assessment.undamaged_version, assessment.quantities));
        }
        all
    };
    let before = compared().await;
    let versions: Vec<Option<u32>> = ids.iter().map(|id| before[id].0).collect();
    // The batches of the first reference are compared with the second, because they were compared with none before.
    let expected = [2, 2, 2, 1, 1, 1, 1, 1, 2].map(Some);
    assert_eq!(versions, expected);

    // The same version of the structure is put into use again, and its references are those of another model.
    let active = monitor.structure(&structure()).unwrap();
    let digest = active.simulator.digest().clone();
    let version = store::NewVersion {
        digest: digest.clone(),
        definition_json: active.simulator.definition().canonical_json(),
        parent: None,
        diagnosis: None,
        baseline: None,
    };
    monitor.store().reference().made_by_another_model(&structure()).await;
    let structures = monitor.store().structures();
    assert!(structures.switch_version(&structure(), &digest, version, Timestamp::now()).await.unwrap());
    monitor.replay().resume_later(structure());
    for _ in 0..200 {
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        if monitor.store().batches().pending(&structure(), 10).await.unwrap().is_empty() {
            break;
        }
    }
    let after = compared().await;
    for id in &ids {
        let renewed = before[id].0.map(|version| version + 2);
        assert_eq!((after[id].0, &after[id].1), (renewed, &before[id].1), "batch {id}");
    }
}
