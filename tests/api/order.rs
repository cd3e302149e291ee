//! The order in which batches arrive changes no assessment, and neither does an import elsewhere.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

use serde_json::{json, Value};

use crate::helpers::{created, eventually, measurements, program, spawn, time, Service};

const BATCHES: &str = "/v1/structures/three-dof/batches";
const HEALTHY: [f64; 3] = [4.0, 5.0, 6.0];

/// A batch: its source and its measurements.
#[derive(Clone)]
struct Sent {
    source: &'static str,
    measurements: Vec<Value>,
}

impl Sent {
    fn new(source: &'static str, count: usize, start_s: usize) -> Self {
        Self { source, measurements: measurements(HEALTHY, count, start_s) }
    }

    /// With the frequencies of some measurements of another batch, from an index on.
    fn repeating(mut self, from: usize, other: &[Value]) -> Self {
        for (own, other) in self.measurements[from..].iter_mut().zip(other) {
            own["frequencies_hz"] = other["frequencies_hz"].clone();
        }
        self
    }

    async fn post(&self, service: &Service) -> Value {
        let body = json!({ "source": self.source, "measurements": self.measurements });
        created(service.post(BATCHES, &body).await).await
    }
}

/// The assessments of all batches by source and first measurement, when none waits for another one.
async fn assessments(service: &Service) -> BTreeMap<String, Value> {
    let history = eventually("the assessment of all batches", async || {
        let page = service.read("/v1/structures/three-dof/history?limit=1000").await;
        let items = page["items"].as_array().unwrap().clone();
        items.iter().all(|item| item["state"] == "assessed").then_some(items)
    });
    let mut all = BTreeMap::new();
    for item in history.await {
        let batch = service.read(&format!("{BATCHES}/{}", item["batch"].as_str().unwrap())).await;
        let mut assessment = batch["assessment"].clone();
        assessment.as_object_mut().unwrap().remove("assessed_at");
        let key = format!("{} {}", item["source"].as_str().unwrap(), item["measured_from"].as_str().unwrap());
        assert!(all.insert(key, assessment).is_none(), "{item}");
    }
    all
}

/// Runs a command of the program that must succeed.
async fn run(arguments: &[&str]) {
    let mut command = Command::new(program());
    command.args(arguments);
    let output = tokio::task::spawn_blocking(move || command.output().unwrap()).await.unwrap();
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
}

/// The assessments of another installation that imports the structure.
async fn imported(mut service: Service, data: &Path) -> BTreeMap<String, Value> {
    let elsewhere = tempfile::tempdir().unwrap();
    let (file, target) = (elsewhere.path().join("archive.ndjson"), elsewhere.path().join("data"));
    std::fs::create_dir(&target).unwrap();
    assert!(service.stop("TERM").success());
    let [data, file, target] = [data, &file, &target].map(|path| path.to_str().unwrap());
    run(&["export", "--structure", "three-dof", "--data-dir", data, "--out", file]).await;
    run(&["import", "--from", file, "--data-dir", target]).await;
    assessments(&Service::start(Path::new(target))).await
}

/// A gateway that hangs for a moment, one that sends old rows again, a table from two sources, single measurements, and what is between them.
fn sent() -> Vec<Sent> {
    let first = Sent::new("logger", 9, 1_000_000);
    let second = Sent::new("logger", 10, 1_010_000);
    let second = second.repeating(0, &first.measurements[8..]);
    let third = Sent::new("gateway", 10, 1_020_000).repeating(4, &second.measurements[1..6]);
    let twice = Sent { source: "copy", ..third.clone() };
    let pair = Sent::new("logger", 2, 1_030_000);
    let single = Sent::new("logger", 1, 1_040_000).repeating(0, &pair.measurements[1..]);
    vec![first, second, third, twice, pair, single]
}

const ORDERS: [[usize; 6]; 4] = [[0, 1, 2, 3, 4, 5], [5, 4, 3, 2, 1, 0], [3, 1, 5, 0, 2, 4], [4, 2, 0, 5, 1, 3]];

/// The assessments after posts in some orders, here and where the structure is imported; all must be equal.
async fn in_all_orders(with_reference: bool) -> BTreeMap<String, Value> {
    let mut expected: Option<BTreeMap<String, Value>> = None;
    for order in ORDERS {
        let (service, folder) = spawn();
        if with_reference {
            let mut healthy = Vec::new();
            for day in 0..3 {
                healthy.push(Sent::new("logger", 20, 86_400 * day).post(&service).await["batch"].clone());
            }
            let declared = service.post("/v1/structures/three-dof/reference", &json!({ "batches": healthy })).await;
            created(declared).await;
        }
        for place in order {
            sent()[place].post(&service).await;
        }
        let here = assessments(&service).await;
        let there = imported(service, folder.path()).await;
        let first = &*expected.get_or_insert_with(|| here.clone());
        for (batch, assessment) in first {
            assert_eq!(here.get(batch), Some(assessment), "{batch}, posted in the order {order:?}");
            assert_eq!(there.get(batch), Some(assessment), "{batch}, posted in the order {order:?} and imported");
        }
        assert_eq!([here.len(), there.len()], [first.len(); 2], "{order:?}");
    }
    expected.unwrap()
}

fn counts(assessment: &Value) -> (u64, u64) {
    let count = |key: &str| assessment[key].as_u64().unwrap();
    (count("measurements_used"), count("measurements_left_out"))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn batches_in_any_order_and_imported_elsewhere_have_the_same_assessments() {
    let found = in_all_orders(false).await;
    let of = |source: &str, start_s: usize| &found[&format!("{source} {}", time(start_s))];
    assert_eq!(counts(of("logger", 1_010_000)), (9, 1), "its first measurement repeats the last one before it");
    // Of the same table from two sources, the one counts whose source comes first in the alphabet.
    assert_eq!(counts(of("copy", 1_020_000)), (5, 5), "a run of five measurements is an old one");
    assert_eq!(of("gateway", 1_020_000)["trust"], "rejected", "all of it came from the other source");
    assert_eq!(of("logger", 1_040_000)["trust"], "rejected", "it repeats the measurement before it");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn batches_in_any_order_are_compared_with_the_reference_in_the_same_way() {
    let found = in_all_orders(true).await;
    let compared = found.values().filter(|assessment| assessment["undamaged_version"] == 1).count();
    assert_eq!(compared, sent().len());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_waits_because_of_a_late_batch_is_assessed_after_a_kill() {
    let (mut service, folder) = spawn();
    let [first, second, ..] = &sent()[..] else { panic!("there are more") };
    assert_eq!(counts(&second.post(&service).await["assessment"]), (10, 0), "nothing is before it");
    first.post(&service).await;
    service.kill();
    let service = Service::start(folder.path());
    let found = assessments(&service).await;
    assert_eq!(counts(&found[&format!("logger {}", time(1_010_000))]), (9, 1));
}
