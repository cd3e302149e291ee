//! What every store must do, through its public interface: batches are stored completely or not at all, also when the caller disconnects.
//!
//! `tests/store` runs these tests on a SQLite file, `tests/postgres` on a PostgreSQL server.

mod alarm_actions;
mod alarms;
mod jobs;
mod process;
mod series;

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use super::database::{open_store, IS_FILE};
use modalwatch::access::{NewToken, Scope, TokenText};
use modalwatch::assessment::{Assessment, BatchState, NewCharts};
use modalwatch::damage::{
    Carrier, ChartReference, Correlation, Damage, Hyperparameters, JointAssessment, JointDamage, JointReference,
    QuantityAssessment, QuantityKind, SeenCovariate,
};
use modalwatch::measurement::{MeasurementBatch, ModalMeasurement};
use modalwatch::quantity::{Digest, Hertz, StructureId, Timestamp};
use modalwatch::store::{HistoryQuery, InsertBatch, PutStructure, Store};
use modalwatch::trust::{Finding, FindingCode, FindingEffect, Trust};

fn bridge() -> StructureId {
    StructureId::parse("bridge").unwrap()
}

fn at(seconds: i64) -> Timestamp {
    Timestamp::from_micros(1_700_000_000_000_000 + seconds * 1_000_000).unwrap()
}

fn batch(source: &str, start: i64, count: i64) -> MeasurementBatch {
    let measurement = |i: i64| ModalMeasurement {
        measured_at: at(start + i),
        frequencies_hz: vec![Some(Hertz::new(1.0 + 0.01 * i as f64).unwrap()), None],
        std_hz: Some(vec![Some(0.01), None]),
        mode_shapes: None,
        covariates: BTreeMap::new(),
        settings: BTreeMap::from([("k".to_owned(), 4.0)]),
    };
    MeasurementBatch {
        structure: bridge(),
        source: source.to_owned(),
        idempotency_key: None,
        posted_by: None,
        measurements: (0..count).map(measurement).collect(),
    }
}

async fn open() -> (Store, tempfile::TempDir) {
    let folder = tempfile::tempdir().unwrap();
    let store = open_store(folder.path()).await;
    let digest = Digest::of(&[b"v1"]);
    assert_eq!(store.structures().put_structure(&bridge(), "{}", &digest, at(0)).await.unwrap(), PutStructure::Created);
    (store, folder)
}

fn correlation() -> Correlation {
    Correlation { first: "k1".to_owned(), second: "k2".to_owned(), correlation: 0.4, interval: [-0.1, 0.7] }
}

fn joint_reference() -> JointReference {
    JointReference {
        quantities: vec!["k1".to_owned(), "k2".to_owned()],
        correlations: vec![correlation()],
        probability: 0.09,
        probability_interval: [0.07, 0.1],
    }
}

fn joint_assessment() -> JointAssessment {
    let carriers = vec![Carrier { name: "k2".to_owned(), probability_of_damage: 0.4, added: 0.4 }];
    let damage = JointDamage {
        probability: 0.43,
        probability_interval: [0.3, 0.6],
        reference_probability: 0.09,
        reference_interval: [0.07, 0.1],
        exceeds: true,
        carriers,
    };
    JointAssessment { correlations: vec![correlation()], damage: Some(damage) }
}

fn assessment(model: &str, undamaged_version: Option<u32>, assessed_at: Timestamp) -> Assessment {
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
    let finding = Finding::new(FindingCode::Outlier, FindingEffect::Note, "one of them").of(vec![2]);
    let quantity = |name: &str| QuantityAssessment {
        name: name.to_owned(),
        unit: "N/m".to_owned(),
        kind: QuantityKind::Parameter,
        mean: 3.6,
        mean_interval: Some([3.5, 3.7]),
        std: Some(0.3),
        std_interval: Some([0.2, 0.5]),
        pooled: Hyperparameters { mean: 3.61, std: Some(0.31), within: 0.01, between: Some(0.08) },
        prior_bound_mass: 0.02,
        group: Some("group:k1+k2".to_owned()),
        effective_measurements: None,
        damage: undamaged_version.map(|_| damage.clone()),
    };
    Assessment {
        estimate: None,
        model_digest: Digest::of(&[model.as_bytes()]),
        structure_digest: Digest::of(&[b"v1"]),
        undamaged_version,
        seed: u64::MAX - 1,
        draws_per_measurement: 10,
        measurements_used: 3,
        measurements_left_out: 1,
        measurements_outside: 2,
        misfit_percent: vec![Some(0.1), None],
        effective_sample_size: 41.5,
        trust: Trust { p_value: Some(0.3), findings: vec![finding], ..Trust::unknown() },
        assessed_at,
        quantities: vec![quantity("k2"), quantity("k1")],
        joint: Some(joint_assessment()),
    }
}

#[tokio::test]
async fn a_batch_comes_back_as_it_was_given() {
    let (store, _folder) = open().await;
    let given = batch("logger", 0, 4);
    assert!(matches!(store.batches().insert_batch(&given, "b1", at(99)).await.unwrap(), InsertBatch::Inserted { .. }));
    let stored = store.batches().batch(&bridge(), "b1").await.unwrap().unwrap();
    assert_eq!((stored.batch, stored.received_at, stored.state), (given.clone(), at(99), BatchState::Received));
    assert_eq!(stored.content_digest, given.content_digest());
    assert!(store.batches().batch(&bridge(), "b2").await.unwrap().is_none());
}

#[tokio::test]
async fn a_key_belongs_to_its_source_and_a_batch_to_the_token_that_posted_it() {
    let (store, _folder) = open().await;
    let keyed = |given: MeasurementBatch, token: &str| MeasurementBatch {
        idempotency_key: Some("key".to_owned()),
        posted_by: Some(token.to_owned()),
        ..given
    };
    let insert =
        async |given: &MeasurementBatch, id: &str| store.batches().insert_batch(given, id, at(0)).await.unwrap();
    // Two come with the key, and two were stored before without it.
    for (source, id) in [("s1", "b1"), ("s2", "b2"), ("s3", "b3"), ("s4", "b4")] {
        let given = match id {
            "b1" | "b2" => keyed(batch(source, 0, 2), id),
            _ => batch(source, 0, 2),
        };
        assert!(matches!(insert(&given, id).await, InsertBatch::Inserted { .. }), "{source}");
        let again = keyed(batch(source, 0, 2), "another");
        assert_eq!(insert(&again, "b9").await, InsertBatch::Replayed(id.to_owned()), "{source}");
        let stored = store.batches().batch(&bridge(), id).await.unwrap().unwrap();
        assert_eq!(stored.batch, given, "whoever posts it again has not posted it");
        let header = store.batches().header(&bridge(), id).await.unwrap().unwrap();
        assert_eq!(header.posted_by, given.posted_by);
    }
    for (source, id) in [("s1", "b1"), ("s2", "b2"), ("s3", "b3"), ("s4", "b4")] {
        let other = insert(&keyed(batch(source, 50, 2), "t"), "b9").await;
        assert_eq!(other, InsertBatch::KeyConflict { batch_id: id.to_owned() }, "{source}");
    }
}

#[tokio::test]
async fn a_token_comes_back_with_the_sources_to_which_it_is_limited() {
    let (store, _folder) = open().await;
    let mut expected = BTreeMap::new();
    for sources in [None, Some(BTreeSet::from(["gateway-1".to_owned(), "gateway-2".to_owned()]))] {
        let text = TokenText::generate().unwrap();
        let scopes = [Scope::Ingest].into_iter().collect();
        let new = NewToken {
            name: "gateway".to_owned(),
            scopes,
            structures: None,
            sources: sources.clone(),
            expires_at: None,
        };
        let record = new.record(&text, at(0));
        store.tokens().insert_token(&record).await.unwrap();
        store.tokens().update_token(&record.rotated(&TokenText::generate().unwrap(), at(9))).await.unwrap();
        expected.insert(record.id, sources);
    }
    let stored = store.tokens().list().await.unwrap().into_iter();
    let stored: BTreeMap<_, _> = stored.map(|token| (token.id, token.sources.as_deref().cloned())).collect();
    assert_eq!(stored, expected);
}

#[tokio::test]
async fn an_assessment_comes_back_as_it_was_given_and_the_newest_is_current() {
    let (store, _folder) = open().await;
    store.batches().insert_batch(&batch("logger", 0, 4), "b1", at(0)).await.unwrap();
    let (old, new) = (assessment("m1", None, at(1)), assessment("m2", None, at(2)));
    for given in [&old, &new, &new] {
        store.assessments().insert_assessment(&bridge(), "b1", given, NewCharts::default()).await.unwrap();
    }
    assert_eq!(store.assessments().assessment(&bridge(), "b1").await.unwrap().unwrap(), new);
    // One that is stored later is the newest, whatever its own time says.
    store.assessments().insert_assessment(&bridge(), "b1", &old, NewCharts::default()).await.unwrap();
    let newest = store.assessments().assessment(&bridge(), "b1").await.unwrap().unwrap();
    assert_eq!((&newest.model_digest, newest.assessed_at > new.assessed_at), (&old.model_digest, true));
    assert_eq!(store.batches().batch(&bridge(), "b1").await.unwrap().unwrap().state, BatchState::Assessed);
}

#[tokio::test]
async fn pages_walk_batches_of_equal_time_once() {
    let (store, _folder) = open().await;
    for i in 0..23 {
        store.batches().insert_batch(&batch(&format!("s{i}"), i / 5, 1), &format!("b{i:02}"), at(i)).await.unwrap();
    }
    let (mut walked, mut after) = (Vec::new(), None);
    loop {
        let query = HistoryQuery { limit: 4, after: after.clone(), ..HistoryQuery::default() };
        let page = store.history().page(&bridge(), &query).await.unwrap();
        let Some(last) = page.last() else { break };
        after = Some((last.measured_from, last.batch_id.clone()));
        walked.extend(page.iter().map(|e| (e.measured_from, e.batch_id.clone())));
    }
    assert_eq!(walked.len(), 23);
    assert!(walked.is_sorted());
}

#[tokio::test]
async fn a_caller_that_disconnects_leaves_complete_batches_and_a_usable_store() {
    let (store, _folder) = open().await;
    for i in 0..60 {
        let given = batch(&format!("s{i}"), 0, 40);
        let id = format!("b{i}");
        // The future is dropped at once, or after some microseconds during the transaction.
        let _ =
            tokio::time::timeout(Duration::from_micros(i * 20), store.batches().insert_batch(&given, &id, at(0))).await;
    }
    // One more write waits for the others and shows that no transaction was left open.
    assert!(matches!(
        store.batches().insert_batch(&batch("last", 0, 40), "last", at(0)).await.unwrap(),
        InsertBatch::Inserted { .. }
    ));
    let query = HistoryQuery { limit: 1_000, ..HistoryQuery::default() };
    let stored = store.history().page(&bridge(), &query).await.unwrap();
    assert!(stored.len() > 1);
    for entry in stored {
        let record = store.batches().batch(&bridge(), &entry.batch_id).await.unwrap().unwrap();
        assert_eq!(record.batch.measurements.len(), 40, "{} is not whole", entry.batch_id);
    }
}

#[tokio::test]
async fn a_refused_batch_leaves_nothing_behind() {
    let (store, _folder) = open().await;
    store.batches().insert_batch(&batch("logger", 10, 5), "b1", at(0)).await.unwrap();
    let overlapping = store.batches().insert_batch(&batch("logger", 7, 5), "b2", at(1)).await.unwrap();
    let expected = InsertBatch::MeasurementConflict { ordinal: 3, measured_at: at(10), batch_id: "b1".to_owned() };
    assert_eq!(overlapping, expected);
    assert!(store.batches().batch(&bridge(), "b2").await.unwrap().is_none());
    // The three measurements without a conflict can be stored by another batch.
    assert!(matches!(
        store.batches().insert_batch(&batch("logger", 7, 3), "b3", at(2)).await.unwrap(),
        InsertBatch::Inserted { .. }
    ));
}

#[tokio::test]
async fn a_new_undamaged_reference_sends_back_only_what_was_never_compared() {
    let (store, _folder) = open().await;
    let model = Digest::of(&[b"m"]);
    for (i, version) in [(0, None), (1, None), (2, Some(1))] {
        let id = format!("b{i}");
        store.batches().insert_batch(&batch(&format!("s{i}"), i, 2), &id, at(i)).await.unwrap();
        if version.is_some() {
            let state = undamaged();
            assert_eq!(
                store.reference().insert_undamaged(&bridge(), &state, &model, &["b0".into()], at(5)).await.unwrap(),
                1
            );
        }
        store
            .assessments()
            .insert_assessment(&bridge(), &id, &assessment("m", version, at(i)), NewCharts::default())
            .await
            .unwrap();
    }
    assert_eq!(store.batches().pending(&bridge(), 9).await.unwrap(), ["b1"]);
    store
        .assessments()
        .insert_assessment(&bridge(), "b1", &assessment("m", Some(1), at(8)), NewCharts::default())
        .await
        .unwrap();
    assert_eq!(
        store.reference().insert_undamaged(&bridge(), &undamaged(), &model, &["b1".into()], at(9)).await.unwrap(),
        2
    );
    assert_eq!(store.batches().pending(&bridge(), 9).await.unwrap(), ["b0"], "b0 was never compared; b2 was");
    let newest = store.reference().undamaged(&bridge()).await.unwrap().unwrap();
    assert_eq!((newest.state.version, newest.batches.as_slice()), (2, &["b1".to_owned()][..]));
    let unknown = store.reference().insert_undamaged(&bridge(), &undamaged(), &model, &["nothing".into()], at(9)).await;
    assert!(unknown.unwrap_err().to_string().contains("no batch nothing"));
    assert_eq!(store.reference().undamaged(&bridge()).await.unwrap().unwrap().state.version, 2);
}

fn undamaged() -> modalwatch::damage::UndamagedReference {
    modalwatch::damage::UndamagedReference {
        process: None,
        without_process: None,
        origin: modalwatch::damage::ReferenceOrigin::default(),
        version: 0,
        threshold_probability: 0.05,
        measurements: 2,
        quantities: vec![modalwatch::damage::UndamagedQuantity {
            name: "k1".to_owned(),
            mean: 4.0,
            std: 0.3,
            threshold: Some(3.5),
            threshold_interval: Some([3.4, 3.6]),
            pooled_threshold: Some(3.49),
            reference: ChartReference {
                mean: 4.0,
                std: 0.31,
                within: 0.004,
                measurements: 20,
                batches: 2,
                degrees_of_freedom: 18,
                between_batches_std: 0.0,
                effective_measurements: None,
                serial: None,
                batches_per_year: None,
            },
            mean_draws: vec![3.9, 4.1],
            std_draws: vec![0.28, 0.33],
        }],
        conditions: [("temperature_c".to_owned(), SeenCovariate::Range([-2.0, 7.5]))].into(),
        doubts: vec!["k1: its batches differ".to_owned()],
        joint: Some(joint_reference()),
    }
}

#[tokio::test]
async fn each_connection_keeps_what_it_acknowledges() {
    use sqlx::Connection as _;
    if !IS_FILE {
        return;
    }
    let (store, folder) = open().await;
    store.batches().insert_batch(&batch("logger", 0, 4), "b1", at(0)).await.unwrap();
    store.close().await;
    let ids: BTreeSet<String> = {
        let options = sqlx_sqlite::SqliteConnectOptions::new().filename(folder.path().join("modalwatch.sqlite"));
        let mut connection = sqlx_sqlite::SqliteConnection::connect_with(&options).await.unwrap();
        let (mode,): (String,) = sqlx::query_as("pragma journal_mode").fetch_one(&mut connection).await.unwrap();
        assert_eq!(mode, "wal");
        let rows: Vec<(String,)> =
            sqlx::query_as("select batch_id from measurement_batch").fetch_all(&mut connection).await.unwrap();
        rows.into_iter().map(|(id,)| id).collect()
    };
    assert_eq!(ids, BTreeSet::from(["b1".to_owned()]));
}
