//! Files that are refused, and rules that the tests in `tests/store` do not cover.

use std::collections::BTreeMap;
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;

use sqlx::Connection as _;
use sqlx_sqlite::{SqliteConnectOptions, SqliteConnection};

use super::comparison::keep;
use super::file::APPLICATION_ID;
use super::{
    schema_version, ComparedWith, Error, HistoryQuery, InsertBatch, PutStructure, Store, WritePriority, DATABASE_FILE,
};
use crate::assessment::{Assessment, NewCharts};
use crate::damage::{Damage, Hyperparameters, QuantityAssessment, QuantityKind, UndamagedReference};
use crate::measurement::{CovariateValue, MeasurementBatch, ModalMeasurement};
use crate::quantity::{Digest, Hertz, StructureId, Timestamp};
use crate::trust::Trust;

pub(super) fn bridge() -> StructureId {
    StructureId::parse("bridge").unwrap()
}

pub(super) fn at(seconds: i64) -> Timestamp {
    Timestamp::from_micros(1_700_000_000_000_000 + seconds * 1_000_000).unwrap()
}

pub(super) fn batch(source: &str, start: i64, key: Option<&str>) -> MeasurementBatch {
    // Batches of different sources or times repeat nothing of each other.
    let of_source: u32 = source.bytes().fold(7, |hash: u32, byte| hash.wrapping_mul(31).wrapping_add(u32::from(byte)));
    let frequency = |i: i64| 1.5 + 1e-3 * (start + i) as f64 + 1e-9 * f64::from(of_source % 1_000_000);
    let measurement = |i: i64| ModalMeasurement {
        measured_at: at(start + i),
        frequencies_hz: vec![None, Some(Hertz::new(frequency(i)).unwrap())],
        std_hz: None,
        mode_shapes: None,
        covariates: [("operator".to_owned(), CovariateValue::Category("é \"x\"".to_owned()))]
            .into_iter()
            .chain([("temperature_c".to_owned(), CovariateValue::Number(0.1 + 0.2))])
            .collect(),
        settings: [].into(),
    };
    MeasurementBatch {
        structure: bridge(),
        source: source.to_owned(),
        idempotency_key: key.map(str::to_owned),
        posted_by: None,
        measurements: (0..2).map(measurement).collect(),
    }
}

pub(super) fn assessment(model: &str, undamaged_version: Option<u32>, assessed_at: Timestamp) -> Assessment {
    let damage = Damage {
        threshold: 3.5,
        probability_of_damage: 0.4,
        probability_interval: Some([0.3, 0.5]),
        pooled_probability: 0.42,
        pooled_exceeds: Some(true),
        exceeds: true,
        relative_change: -0.1,
        relative_change_interval: Some([-0.12, -0.08]),
    };
    let quantity = |name: &str| QuantityAssessment {
        name: name.to_owned(),
        unit: "N/m".to_owned(),
        kind: QuantityKind::Parameter,
        mean: 3.6,
        mean_interval: Some([3.5, 3.7]),
        std: None,
        std_interval: None,
        pooled: Hyperparameters { mean: 3.61, std: None, within: 0.01, between: None },
        group: None,
        prior_bound_mass: 0.0,
        effective_measurements: None,
        damage: undamaged_version.map(|_| damage.clone()),
    };
    Assessment {
        estimate: None,
        model_digest: Digest::of(&[model.as_bytes()]),
        structure_digest: Digest::of(&[b"v1"]),
        undamaged_version,
        seed: u64::MAX,
        draws_per_measurement: 10,
        measurements_used: 1,
        measurements_left_out: 1,
        measurements_outside: 0,
        misfit_percent: vec![Some(0.1), None],
        effective_sample_size: 41.5,
        trust: Trust::unknown(),
        assessed_at,
        quantities: vec![quantity("k2"), quantity("k1")],
        joint: None,
    }
}

fn undamaged() -> UndamagedReference {
    UndamagedReference {
        process: None,
        without_process: None,
        origin: crate::damage::ReferenceOrigin::default(),
        version: 0,
        threshold_probability: 0.05,
        measurements: 2,
        quantities: Vec::new(),
        conditions: BTreeMap::new(),
        doubts: Vec::new(),
        joint: None,
    }
}

pub(super) async fn open() -> (Store, tempfile::TempDir) {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::open(folder.path()).await.unwrap();
    let put = store.structures().put_structure(&bridge(), "{}", &Digest::of(&[b"v1"]), at(0)).await.unwrap();
    assert_eq!(put, PutStructure::Created);
    (store, folder)
}

/// Runs statements on the database file of a folder without opening a store; the file is created if it is missing.
async fn by_hand(folder: &Path, statements: &[&'static str]) {
    let options = SqliteConnectOptions::new().filename(folder.join(DATABASE_FILE)).create_if_missing(true);
    let mut connection = SqliteConnection::connect_with(&options).await.unwrap();
    for statement in statements {
        sqlx::query(*statement).execute(&mut connection).await.unwrap();
    }
    connection.close().await.unwrap();
}

async fn refusal(folder: &Path) -> Error {
    Store::open(folder).await.err().expect("the folder should be refused")
}

#[tokio::test]
async fn a_file_that_is_not_our_database_is_refused_and_not_changed() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join(DATABASE_FILE);
    std::fs::write(&file, "some text that is longer than a header").unwrap();
    assert!(matches!(refusal(folder.path()).await, Error::NotADatabase(_)));
    assert!(std::fs::read_to_string(&file).unwrap().starts_with("some text"));
    std::fs::remove_file(&file).unwrap();
    by_hand(folder.path(), &["create table theirs (a)"]).await;
    assert!(matches!(refusal(folder.path()).await, Error::Foreign { application_id: 0, .. }));
    by_hand(folder.path(), &["drop table theirs", "pragma application_id = 7"]).await;
    assert!(matches!(refusal(folder.path()).await, Error::Foreign { application_id: 7, .. }));
}

#[tokio::test]
async fn a_first_start_that_was_killed_before_it_marked_its_file_can_be_repeated() {
    let folder = tempfile::tempdir().unwrap();
    by_hand(folder.path(), &["pragma journal_mode = wal"]).await;
    assert!(std::fs::metadata(folder.path().join(DATABASE_FILE)).unwrap().len() > 0);
    let store = Store::open(folder.path()).await.unwrap();
    store.file().is_writable().await.unwrap();
    let (id,): (i64,) = super::sql::query_as("pragma application_id").fetch_one(&store.database.reader).await.unwrap();
    assert_eq!(id, APPLICATION_ID);
}

#[tokio::test]
async fn one_folder_has_one_store() {
    let (store, folder) = open().await;
    assert!(matches!(refusal(folder.path()).await, Error::Locked(_)));
    store.close().await;
    drop(store);
    assert_eq!(Store::open(folder.path()).await.unwrap().structures().list().await.unwrap().len(), 1);
}

#[tokio::test]
async fn a_read_only_file_or_folder_is_refused_even_to_root() {
    let (store, folder) = open().await;
    store.close().await;
    drop(store);
    for (path, mode) in [(folder.path().join(DATABASE_FILE), 0o644), (folder.path().to_owned(), 0o755)] {
        let allow = |bits| std::fs::set_permissions(&path, std::fs::Permissions::from_mode(bits)).unwrap();
        allow(mode & 0o555);
        assert!(matches!(refusal(folder.path()).await, Error::ReadOnly(named) if named == path));
        allow(mode);
    }
    Store::open(folder.path()).await.unwrap();
}

#[tokio::test]
async fn a_newer_schema_is_refused_with_both_versions() {
    let (store, folder) = open().await;
    store.close().await;
    drop(store);
    let newer =
        "insert into _sqlx_migrations select 9999, 'x', installed_on, true, checksum, 0 from _sqlx_migrations limit 1";
    by_hand(folder.path(), &[newer]).await;
    let newest = schema_version();
    assert!(matches!(refusal(folder.path()).await, Error::SchemaTooNew { found: 9999, known, .. } if known == newest));
}

#[tokio::test]
async fn a_damaged_or_truncated_file_is_refused_as_corrupt() {
    let (store, folder) = open().await;
    for i in 0..40 {
        store.batches().insert_batch(&batch(&format!("s{i}"), 0, None), &format!("b{i}"), at(0)).await.unwrap();
    }
    store.close().await;
    drop(store);
    let file = folder.path().join(DATABASE_FILE);
    let good = std::fs::read(&file).unwrap();
    for page in 0..good.len() / 4096 {
        let mut bad = good.clone();
        let start = (page * 4096).max(100); // after the file header
        bad[start..start + 60].fill(0xa5);
        std::fs::write(&file, &bad).unwrap();
        let error = refusal(folder.path()).await;
        assert!(matches!(error, Error::Corrupt { .. }), "page {page}: {error}");
        assert!(std::fs::read(&file).unwrap() == bad, "page {page}: a damaged file was written to");
    }
    std::fs::write(&file, &good[..good.len() / 2]).unwrap();
    assert!(matches!(refusal(folder.path()).await, Error::Corrupt { .. }));
}

#[tokio::test]
async fn a_known_key_decides_and_then_the_measurements() {
    let (store, _folder) = open().await;
    let (given, other) = (batch("s", 0, Some("key")), batch("s", 50, Some("key")));
    let insert = async |batch: &MeasurementBatch| store.batches().insert_batch(batch, "b", at(0)).await.unwrap();
    assert!(matches!(insert(&given).await, InsertBatch::Inserted { .. }));
    assert_eq!(store.batches().batch(&bridge(), "b").await.unwrap().unwrap().batch, given);
    assert_eq!(insert(&given).await, InsertBatch::Replayed("b".to_owned()));
    assert_eq!(insert(&batch("s", 0, None)).await, InsertBatch::Replayed("b".to_owned()));
    assert_eq!(insert(&other).await, InsertBatch::KeyConflict { batch_id: "b".to_owned() });
    let nowhere = MeasurementBatch { structure: StructureId::parse("nowhere").unwrap(), ..given };
    assert!(matches!(store.batches().insert_batch(&nowhere, "c", at(0)).await, Err(Error::UnknownStructure(_))));
}

#[tokio::test]
async fn the_speculative_outcome_of_a_batch_holds_only_after_the_commit() {
    let (store, _folder) = open().await;
    let given = batch("s", 0, None);
    let faults = crate::fault::Faults::arm();
    faults.set("store::commit", "1*return");
    let (speculative, outcome) = tokio::sync::oneshot::channel();
    let inserted = store.batches().insert_batch_speculative(&given, "b", at(0), (None, speculative)).await;
    assert!(matches!(outcome.await, Ok(InsertBatch::Inserted { .. })), "it is sent before the commit");
    assert!(inserted.is_err());
    assert_eq!(store.batches().batch(&bridge(), "b").await.unwrap(), None);
    faults.clear("store::commit");
    let (speculative, outcome) = tokio::sync::oneshot::channel();
    let inserted = store.batches().insert_batch_speculative(&given, "b", at(0), (None, speculative)).await.unwrap();
    assert_eq!(outcome.await.unwrap(), inserted);
    assert_eq!(store.batches().batch(&bridge(), "b").await.unwrap().unwrap().batch, given);
}

#[tokio::test]
async fn a_comparison_with_an_earlier_trained_baseline_does_not_prevent_the_next_one() {
    let (store, _folder) = open().await;
    for id in ["b0", "b1"] {
        store.batches().insert_batch(&batch(id, 0, None), id, at(0)).await.unwrap();
    }
    let declare = async |model: &str| {
        let digest = Digest::of(&[model.as_bytes()]);
        store.reference().insert_undamaged(&bridge(), &undamaged(), &digest, &["b0".to_owned()], at(1)).await.unwrap()
    };
    assert_eq!(declare("old").await, 1);
    for (id, assessment) in [
        ("b1", assessment("old", Some(1), at(2))),
        ("b1", assessment("new", None, at(3))),
        ("b0", assessment("new", None, at(3))),
    ] {
        store.assessments().insert_assessment(&bridge(), id, &assessment, NewCharts::default()).await.unwrap();
    }
    assert_eq!(declare("new").await, 2);
    assert_eq!(store.batches().pending(&bridge(), 9).await.unwrap(), ["b1"]);
}

/// Stores a computed assessment of a batch of the present version.
async fn insert_computed(store: &Store, id: &str, assessment: &Assessment, charted: (NewCharts, ComparedWith)) {
    let computed = (charted.0, charted.1, None);
    let inserted =
        store.assessments().insert_computed(&bridge(), id, assessment, computed, WritePriority::Prompt).await.unwrap();
    inserted.unwrap();
}

#[tokio::test]
async fn an_assessment_made_before_a_newer_reference_leaves_its_batch_waiting() {
    let (store, _folder) = open().await;
    for id in ["b0", "b1"] {
        store.batches().insert_batch(&batch(id, 0, None), id, at(0)).await.unwrap();
    }
    // The reference is declared between the computation and the transaction that stores its result.
    let digest = Digest::of(&[b"m"]);
    let declared =
        store.reference().insert_undamaged(&bridge(), &undamaged(), &digest, &["b0".to_owned()], at(1)).await.unwrap();
    let insert = async |id: &str, model: &str, compared: Option<u32>, seen: u32| {
        let (assessment, charted) =
            (assessment(model, compared, at(2)), (NewCharts::default(), ComparedWith::Newest(seen)));
        insert_computed(&store, id, &assessment, charted).await;
        store.batches().pending(&bridge(), 9).await.unwrap()
    };
    assert_eq!(insert("b0", "m", None, 0).await, ["b1"], "a batch of the reference is not compared with it");
    assert_eq!(insert("b1", "m", None, 0).await, ["b1"]);
    assert_eq!(insert("b1", "m", Some(declared), declared).await, [""; 0]);
    assert_eq!(insert("b1", "other", None, 0).await, [""; 0], "the reference is of another trained baseline");
}

#[tokio::test]
async fn the_assessment_that_was_stored_last_is_the_current_one_even_when_the_clock_stands_still() {
    let (store, _folder) = open().await;
    for id in ["b0", "b1"] {
        store.batches().insert_batch(&batch(id, 0, None), id, at(0)).await.unwrap();
    }
    let digest = Digest::of(&[b"m"]);
    let declared =
        store.reference().insert_undamaged(&bridge(), &undamaged(), &digest, &["b0".to_owned()], at(1)).await.unwrap();
    // One task has seen the reference, another has not; the second is stored later, and the batch is assessed once more.
    for (compared, seen) in [(Some(declared), declared), (None, 0), (Some(declared), declared)] {
        let (assessment, charted) =
            (assessment("m", compared, at(2)), (NewCharts::default(), ComparedWith::Newest(seen)));
        insert_computed(&store, "b1", &assessment, charted).await;
        let current = store.assessments().assessment(&bridge(), "b1").await.unwrap().unwrap();
        assert_eq!(current.undamaged_version, compared);
    }
    assert_eq!(store.batches().pending(&bridge(), 9).await.unwrap(), ["b0"]);
}

#[tokio::test]
async fn a_result_that_was_computed_twice_is_a_repetition_with_its_time_unless_the_batch_waited_again() {
    let (store, _folder) = open().await;
    store.batches().insert_batch(&batch("s", 0, None), "b", at(0)).await.unwrap();
    let insert = async |second: i64| {
        let given = assessment("m", None, at(second));
        let stored = store.assessments().insert_assessment(&bridge(), "b", &given, NewCharts::default()).await;
        let read = store.assessments().assessment(&bridge(), "b").await.unwrap().unwrap();
        let stored = stored.unwrap().unwrap();
        assert_eq!(read.assessed_at, stored.assessed_at);
        (stored.assessed_at, stored.repeated)
    };
    assert_eq!(insert(2).await, (at(2), false));
    assert_eq!(insert(3).await, (at(2), true), "the post and the assessment of waiting batches at the same time");
    let requeued = store.database.write(|transaction| {
        Box::pin(async move {
            super::sql::query("update measurement_batch set state = 'received'").execute(transaction).await?;
            Ok(())
        })
    });
    requeued.await.unwrap();
    assert_eq!(insert(4).await, (at(4), false), "assessed anew");
    assert_eq!(insert(1).await, (at(4), true), "the clock was set back");
}

#[tokio::test]
async fn a_batch_is_compared_with_the_references_that_it_keeps_and_then_with_newer_ones() {
    let (store, _folder) = open().await;
    // Only b2 was measured after the batches of the references.
    for (id, begins) in [("b0", 0), ("b1", 0), ("b2", 9)] {
        store.batches().insert_batch(&batch(id, begins, None), id, at(0)).await.unwrap();
    }
    let digest = Digest::of(&[b"m"]);
    let declare = async || {
        let members = ["b0".to_owned()];
        store.reference().insert_undamaged(&bridge(), &undamaged(), &digest, &members, at(1)).await.unwrap()
    };
    assert_eq!((declare().await, declare().await), (1, 2));
    for id in ["b0", "b1", "b2"] {
        let given = assessment("m", Some(1).filter(|_| id != "b0"), at(2));
        store.assessments().insert_assessment(&bridge(), id, &given, NewCharts::default()).await.unwrap();
        let kept = store
            .database
            .write(move |transaction| Box::pin(async move { keep(transaction, (bridge().as_str(), id), &[1]).await }));
        kept.await.unwrap();
    }
    assert_eq!(declare().await, 3);
    let compare = async |id: &str| {
        let kept = store.batches().batch(&bridge(), id).await.unwrap().unwrap().kept_reference?;
        let assessment = assessment("m", Some(kept), at(3));
        let charted = (NewCharts::default(), ComparedWith::Kept(kept));
        insert_computed(&store, id, &assessment, charted).await;
        Some(kept)
    };
    assert_eq!((compare("b1").await, compare("b1").await), (Some(1), None));
    assert_eq!((compare("b2").await, compare("b2").await, compare("b2").await), (Some(1), Some(3), None));
    assert_eq!(compare("b0").await, Some(1));
    assert_eq!(store.batches().pending(&bridge(), 9).await.unwrap(), [""; 0]);
}

#[tokio::test]
async fn batches_assessed_under_another_baseline_are_found_when_that_of_the_reference_is_back() {
    let (store, _folder) = open().await;
    for id in ["b0", "b1", "b2"] {
        store.batches().insert_batch(&batch(id, 0, None), id, at(0)).await.unwrap();
    }
    let digest = Digest::of(&[b"m"]);
    store.reference().insert_undamaged(&bridge(), &undamaged(), &digest, &["b0".to_owned()], at(1)).await.unwrap();
    for (id, assessment) in [
        ("b0", assessment("other", None, at(2))),
        ("b1", assessment("m", Some(1), at(2))),
        ("b2", assessment("m", Some(1), at(2))),
        ("b2", assessment("other", None, at(3))),
    ] {
        store.assessments().insert_assessment(&bridge(), id, &assessment, NewCharts::default()).await.unwrap();
    }
    assert!(store.reference().requeue_uncompared(&bridge(), 1).await.unwrap());
    assert_eq!(store.batches().pending(&bridge(), 9).await.unwrap(), ["b2"]);
    assert!(!store.reference().requeue_uncompared(&bridge(), 1).await.unwrap());
}

#[tokio::test]
async fn a_batch_that_is_deleted_while_it_is_read_is_gone_and_not_damaged() {
    let (store, folder) = open().await;
    store.batches().insert_batch(&batch("s", 0, None), "b", at(0)).await.unwrap();
    let faults = crate::fault::Faults::arm();
    let path = folder.path().join(DATABASE_FILE);
    let delete = async |path: &Path| {
        let mut other = SqliteConnection::connect_with(&SqliteConnectOptions::new().filename(path)).await.unwrap();
        sqlx::query("delete from measurement; delete from measurement_batch").execute(&mut other).await.unwrap();
        other.close().await.unwrap();
    };
    // Between the statement that reads the batch and the one that reads its measurements.
    faults.call("store::read", move || {
        let path = path.clone();
        let runtime = || tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        std::thread::spawn(move || runtime().block_on(delete(&path))).join().unwrap();
    });
    assert_eq!(store.batches().batch(&bridge(), "b").await.unwrap(), None);
}

#[tokio::test]
async fn pages_of_exceedances_contain_each_current_one_once_and_newest_first() {
    let (store, _folder) = open().await;
    for i in 0..12 {
        let id = format!("b{i:02}");
        // Three batches at each time, so that pages end between batches of equal time.
        store.batches().insert_batch(&batch(&format!("s{i}"), i / 3, None), &id, at(0)).await.unwrap();
        if i == 0 {
            store
                .reference()
                .insert_undamaged(&bridge(), &undamaged(), &Digest::of(&[b"m"]), &[id], at(1))
                .await
                .unwrap();
        } else {
            store
                .assessments()
                .insert_assessment(&bridge(), &id, &assessment("m", Some(1), at(1)), NewCharts::default())
                .await
                .unwrap();
        }
    }
    store
        .assessments()
        .insert_assessment(&bridge(), "b07", &assessment("later", None, at(9)), NewCharts::default())
        .await
        .unwrap();
    for limit in 1..6 {
        let mut query = HistoryQuery { limit, from: Some(at(0)), to: Some(at(3)), ..HistoryQuery::default() };
        let mut walked = Vec::new();
        loop {
            let page = store.history().exceedances(&bridge(), &query).await.unwrap();
            let Some(last) = page.last() else { break };
            query.after = Some((last.measured_from, last.batch_id.clone()));
            query.after_quantity = Some(last.quantity.clone());
            walked.extend(page.into_iter().map(|e| (e.measured_from, e.batch_id, e.quantity)));
        }
        // b01 to b08 without b07, whose current assessment exceeds nothing; two quantities each.
        assert_eq!(walked.len(), 14, "limit {limit}");
        assert!(walked.is_sorted_by(|a, b| a > b), "limit {limit}");
    }
}
