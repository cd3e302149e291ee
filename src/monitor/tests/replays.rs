//! Batches that are assessed again: by another reference or model, on any number of threads, also after the clock was set back.

use std::collections::{BTreeMap, BTreeSet};

use super::{batch, eventually, is_compared, open, open_with, reference, structure};
use crate::assessment::BatchState;
use crate::clock;
use crate::fault::Faults;
use crate::monitor::compute::ComputeSettings;
use crate::monitor::events::News;
use crate::monitor::MonitorSettings;
use crate::quantity::Timestamp;
use crate::store::NewVersion;

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
    faults.set("clock", &format!("return({})", clock::now().micros() - 365 * 86_400_000_000));
    monitor.replay().declare_reference(&structure(), reference(&ids[..5])).await.unwrap();
    is_compared(&monitor, &ids[5]).await;
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
    let version = NewVersion {
        digest: digest.clone(),
        definition_json: active.simulator.definition().canonical_json(),
        parent: None,
        diagnosis: None,
        baseline: None,
    };
    monitor.store().reference().made_by_another_model(&structure()).await;
    let structures = monitor.store().structures();
    assert!(structures.switch_version(&structure(), &digest, version, clock::now()).await.unwrap());
    monitor.replay().resume_later(structure());
    let nothing_waits = async || monitor.store().batches().pending(&structure(), 10).await.unwrap().is_empty();
    eventually("the end of the replay", nothing_waits).await;
    let after = compared().await;
    for id in &ids {
        let renewed = before[id].0.map(|version| version + 2);
        assert_eq!((after[id].0, &after[id].1), (renewed, &before[id].1), "batch {id}");
    }
}
