//! A monitor on a store of its own, and batches of a structure that is shipped; the tests are in the modules.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::OnceLock;

use super::{Monitor, MonitorSettings, ReferenceChoice, ReferenceRequest};
use crate::assessment::BatchState;
use crate::baseline::library::Library;
use crate::measurement::{MeasurementBatch, ModalMeasurement};
use crate::quantity::{Hertz, StructureId, Timestamp};
use crate::simulator::Simulator;
use crate::store::{self, HistoryQuery, Store};

mod faults;
mod replays;

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
        posted_by: None,
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

/// Waits until a condition holds, for at most a minute.
async fn eventually(what: &str, holds: impl AsyncFn() -> bool) {
    for _ in 0..1_200 {
        if holds().await {
            return;
        }
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    }
    panic!("{what} is not reached in a minute");
}

/// Waits until the only batch is assessed.
async fn only_batch_is_assessed(monitor: &Monitor) {
    eventually("an assessment of the only batch", async || {
        let query = HistoryQuery { limit: 10, ..HistoryQuery::default() };
        let items = monitor.store().history().page(&structure(), &query).await.unwrap();
        items.len() == 1 && items[0].state == BatchState::Assessed
    })
    .await;
}

/// Waits until the current assessment of a batch is a comparison with the first reference.
async fn is_compared(monitor: &Monitor, batch: &str) {
    eventually("the comparison of the batch with the reference", async || {
        let view = monitor.records().batch(&structure(), batch).await.unwrap();
        view.assessment.is_some_and(|assessment| assessment.undamaged_version == Some(1))
    })
    .await;
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
