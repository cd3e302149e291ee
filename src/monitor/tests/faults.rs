//! Faults at the n-th call, for all n: wherever the processing of a batch fails, a retry stores it once and assesses it.

use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::Arc;

use super::{batch, is_compared, only_batch_is_assessed, open, reference, stored, structure};
use crate::assessment::BatchState;
use crate::baseline::library::Library;
use crate::clock;
use crate::fault::Faults;
use crate::measurement::MeasurementBatch;
use crate::monitor::structures::ActiveStructure;
use crate::monitor::{Error, IngestError, Ingested, Missing, Monitor, MonitorSettings};
use crate::quantity::StructureId;
use crate::simulator::definition::StructureDefinition;
use crate::simulator::Simulator;
use crate::store::{self, NewVersion, Store, DATABASE_FILE};

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
        monitor.store().batches().insert_batch(&number, &first, clock::now()).await.unwrap();
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
    only_batch_is_assessed(&monitor).await;
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
                batches.insert_batch(&given, &batch_id, clock::now()).await.unwrap();
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
    only_batch_is_assessed(&monitor).await;
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
    is_compared(&monitor, &ids[3]).await;
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
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("models");
    let ids = Library::open(None).unwrap().iter().map(|(id, _)| id.to_string()).collect::<Vec<_>>();
    assert_eq!(ids.len(), 3);
    for damaged in &ids {
        let folder = tempfile::tempdir().unwrap();
        let models = folder.path().join("models");
        std::fs::create_dir_all(models.join(damaged)).unwrap();
        for file in std::fs::read_dir(shipped.join(damaged)).unwrap().map(|entry| entry.unwrap().path()) {
            std::fs::copy(&file, models.join(damaged).join(file.file_name().unwrap())).unwrap();
        }
        let weights = models.join(damaged).join("baseline.safetensors");
        let bytes = std::fs::read(&weights).unwrap();
        std::fs::write(&weights, &bytes[..bytes.len() / 2]).unwrap();
        let library = Library::open(Some(&models)).unwrap();
        assert_eq!(library.refusals().len(), 1, "{damaged}");
        assert_eq!(library.iter().filter(|(_, entry)| entry.baseline.is_some()).count(), 2);
        let store = Store::open(&folder.path().join("data")).await.unwrap();
        let monitor = Monitor::open(store, library, MonitorSettings::default()).await.unwrap();
        assert_eq!(monitor.upkeep().baselines_in_use(), 2);
    }
}
