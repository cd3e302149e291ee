//! Batches that are cheap to generate, a client that records acknowledgements, and a check of the database afterwards.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::OnceLock;

use modalwatch::measurement::{MeasurementBatch, ModalMeasurement};
use modalwatch::quantity::{Hertz, StructureId, Timestamp};
use modalwatch::store::Store;
use serde_json::{json, Value};

use crate::helpers::{eventually, repository, Service};

pub const BATCHES: &str = "/v1/structures/three-dof/batches";
pub const STRUCTURE: &str = "three-dof";
/// The same structure under another id, without a trained model: its batches are stored and wait.
pub const PLAIN: &str = "plain";

/// 2026-01-01T00:00:00Z, µs.
const EPOCH_MICROS: i64 = 1_767_225_600_000_000;

/// Frequencies of the structure at stiffnesses spread by ±2 %, Hz.
fn bank() -> &'static [Vec<f64>] {
    static BANK: OnceLock<Vec<Vec<f64>>> = OnceLock::new();
    BANK.get_or_init(|| {
        let simulator = modalwatch::baseline::library::find_structure(STRUCTURE).unwrap();
        let wave = |i: usize, phase: usize| 1.0 + 0.02 * (3.883 * i as f64 + 3.0 * phase as f64).sin();
        let one = |i| simulator.frequencies_hz(&[4.0 * wave(i, 0), 5.0 * wave(i, 1), 6.0 * wave(i, 2)]).unwrap();
        (0..32).map(one).collect()
    })
}

/// Batch `number` of a source: `count` measurements ten seconds apart, none at a time of another number.
pub fn batch(source: &str, number: usize, count: usize) -> MeasurementBatch {
    let one = |i: usize| {
        let row = number * count + i;
        let jitter = 1.0 + 1e-4 * ((row % 9_973) as f64).sin();
        ModalMeasurement {
            measured_at: Timestamp::from_micros(EPOCH_MICROS + 10_000_000 * row as i64).unwrap(),
            frequencies_hz: bank()[row % 32].iter().map(|f| Some(Hertz::new(f * jitter).unwrap())).collect(),
            std_hz: None,
            mode_shapes: None,
            covariates: BTreeMap::new(),
            settings: BTreeMap::new(),
        }
    };
    MeasurementBatch {
        structure: StructureId::parse(STRUCTURE).unwrap(),
        source: source.to_owned(),
        idempotency_key: None,
        posted_by: None,
        measurements: (0..count).map(one).collect(),
    }
}

/// A batch of the structure without a trained model, for tests that only store.
pub fn plain_batch(source: &str, number: usize, count: usize) -> MeasurementBatch {
    MeasurementBatch { structure: StructureId::parse(PLAIN).unwrap(), ..batch(source, number, count) }
}

/// Defines the structure without a trained model.
pub async fn define_plain(service: &Service) {
    define_as(service, PLAIN).await;
}

/// Defines the structure under another id.
pub async fn define_as(service: &Service, id: &str) {
    let text = std::fs::read_to_string(repository("models/three-dof/structure.toml")).unwrap();
    let text = text.replace("id = \"three-dof\"", &format!("id = \"{id}\""));
    let request = service.request(reqwest::Method::PUT, &format!("/v1/structures/{id}"));
    let answer = request.header("content-type", "application/toml").body(text).send().await.unwrap();
    assert!(answer.status().is_success(), "{}", answer.text().await.unwrap());
}

/// The body that posts a batch.
pub fn body(batch: &MeasurementBatch) -> Value {
    json!({ "source": batch.source, "measurements": batch.measurements })
}

/// Posts a batch; the status, and the answer if it is JSON. `None` when the connection broke.
pub async fn post(service: &Service, batch: &MeasurementBatch) -> Option<(u16, Value)> {
    let path = format!("/v1/structures/{}/batches", batch.structure);
    let response = service.request(reqwest::Method::POST, &path).json(&body(batch)).send().await.ok()?;
    let status = response.status().as_u16();
    Some((status, response.json().await.unwrap_or(Value::Null)))
}

/// Acknowledged batches: digest of the content by the id that the service assigned.
#[derive(Default)]
pub struct Acknowledged(pub BTreeMap<String, String>);

impl Acknowledged {
    /// Records a 201.
    pub fn add(&mut self, batch: &MeasurementBatch, answer: &Value) {
        let digest = batch.content_digest().to_string();
        assert_eq!(answer["content_digest"], digest.as_str(), "another batch was acknowledged: {answer}");
        let id = answer["batch"].as_str().unwrap().to_owned();
        if let Some(other) = self.0.insert(id, digest.clone()) {
            assert_eq!(other, digest, "an id was assigned to two batches");
        }
    }
}

/// Content of a database about the monitored structure.
pub struct Audit {
    pub stored: usize,
    pub unassessed: usize,
}

/// Checks the database of a service that has stopped: SQLite finds no error, every batch is complete and agrees with its digest,
/// no measurement is stored twice, and everything acknowledged is stored.
pub async fn audit(data_dir: &Path, acknowledged: &Acknowledged) -> Audit {
    use sqlx::Connection as _;
    let options = sqlx_sqlite::SqliteConnectOptions::new().filename(data_dir.join("modalwatch.sqlite"));
    let mut connection = sqlx_sqlite::SqliteConnection::connect_with(&options).await.unwrap();
    let (found,): (String,) = sqlx::query_as("pragma integrity_check").fetch_one(&mut connection).await.unwrap();
    assert_eq!(found, "ok");
    let orphans = sqlx::query("pragma foreign_key_check").fetch_all(&mut connection).await.unwrap();
    assert!(orphans.is_empty(), "{} rows refer to nothing", orphans.len());
    let (halves,): (i64,) = sqlx::query_as(
        "select count(*) from measurement_batch b where measurement_count <>
             (select count(*) from measurement m where (m.structure_id, m.batch_id) = (b.structure_id, b.batch_id))",
    )
    .fetch_one(&mut connection)
    .await
    .unwrap();
    assert_eq!(halves, 0, "incomplete batches");
    let (doubled,): (i64,) = sqlx::query_as(
        "select count(*) from (select 1 from measurement group by structure_id, source, measured_at_us having count(*) > 1)",
    )
    .fetch_one(&mut connection)
    .await
    .unwrap();
    assert_eq!(doubled, 0, "measurements that are stored twice");
    let rows: Vec<(String, String, String, String)> =
        sqlx::query_as("select structure_id, batch_id, content_digest, state from measurement_batch")
            .fetch_all(&mut connection)
            .await
            .unwrap();
    connection.close().await.unwrap();
    let stored: BTreeMap<&str, &str> = rows.iter().map(|(_, id, digest, _)| (id.as_str(), digest.as_str())).collect();
    let lost: Vec<&String> = acknowledged
        .0
        .iter()
        .filter(|(id, digest)| stored.get(id.as_str()) != Some(&digest.as_str()))
        .map(|(id, _)| id)
        .collect();
    assert!(lost.is_empty(), "{} of {} acknowledged batches are lost: {lost:?}", lost.len(), acknowledged.0.len());
    // The measurements themselves: reading a batch compares them with its digest.
    let store = Store::open(data_dir).await.unwrap();
    for (structure, id, ..) in &rows {
        let structure = StructureId::parse(structure).unwrap();
        store.batches().batch(&structure, id).await.unwrap().expect("a listed batch is there");
    }
    store.close().await;
    let of_monitored = || rows.iter().filter(|(structure, ..)| structure == STRUCTURE);
    Audit {
        stored: of_monitored().count(),
        unassessed: of_monitored().filter(|(.., state)| state != "assessed").count(),
    }
}

/// Ids in the history of the monitored structure, from first to last; none may occur twice.
pub async fn history(service: &Service) -> BTreeSet<String> {
    history_of(service, STRUCTURE).await
}

/// Ids in the history of a structure.
pub async fn history_of(service: &Service, structure: &str) -> BTreeSet<String> {
    let (mut ids, mut path) = (BTreeSet::new(), format!("/v1/structures/{structure}/history?limit=1000"));
    loop {
        let page = service.read(&path).await;
        for item in page["items"].as_array().unwrap() {
            assert!(ids.insert(item["batch"].as_str().unwrap().to_owned()), "twice in the history: {item}");
        }
        let Some(cursor) = page["next"].as_str() else { return ids };
        path = format!("/v1/structures/{structure}/history?limit=1000&cursor={cursor}");
    }
}

/// Waits until no batch of the history waits for its assessment.
pub async fn all_assessed(service: &Service) {
    eventually("the assessment of all batches", async || {
        let page = service.read(&format!("/v1/structures/{STRUCTURE}/history?limit=1000")).await;
        let items = page["items"].as_array().unwrap();
        assert!(page["next"].is_null(), "more batches than one page");
        if items.iter().any(|item| item["state"] == "received") {
            return None;
        }
        assert!(items.iter().all(|item| item["state"] == "assessed"), "{page}");
        Some(())
    })
    .await;
}

/// Whether `/readyz` reports that the service is ready, and its reasons if not.
pub async fn ready(service: &Service) -> (bool, Value) {
    let response = service.get("/readyz").send().await.unwrap();
    let ready = response.status() == 200;
    let answer: Value = response.json().await.unwrap();
    assert_eq!(answer["ready"], ready, "{answer}");
    (ready, answer["reasons"].clone())
}

/// Waits until the service is ready.
pub async fn ready_again(service: &Service) {
    eventually("ready", async || ready(service).await.0.then_some(())).await;
}

/// Resident memory of a process, MiB.
pub fn resident_mib(pid: u32) -> f64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    line.split_whitespace().next().unwrap().parse::<f64>().unwrap() / 1024.0
}

/// Number of open file handles of a process.
pub fn open_files(pid: u32) -> usize {
    std::fs::read_dir(format!("/proc/{pid}/fd")).unwrap().count()
}

/// Sets no minimum of free space, so that the service writes until its disk is full.
pub fn without_floor(command: &mut std::process::Command) -> &mut std::process::Command {
    let defaults = std::process::Command::new(env!("CARGO_BIN_EXE_modalwatch")).args(["config", "print"]).output();
    if String::from_utf8(defaults.unwrap().stdout).unwrap().contains("min_free_bytes") {
        command.env("MODALWATCH__STORE__MIN_FREE_BYTES", "0");
    }
    command
}
