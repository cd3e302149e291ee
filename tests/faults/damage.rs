//! Damaged databases are refused with instructions or read correctly. They are never repaired, cause no panic and give no wrong
//! measurement.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use modalwatch::quantity::StructureId;
use modalwatch::store::{EpisodeQuery, HistoryQuery, Store};
use rand::Rng as _;
use serde_json::json;

use crate::faults::kit::{all_assessed, audit, batch, history, post, Acknowledged, STRUCTURE};
use crate::helpers::{command, created, Service};

/// Bits that are flipped, one in each copy.
const FLIPS: usize = 400;

fn database(folder: &Path) -> std::path::PathBuf {
    folder.join("modalwatch.sqlite")
}

/// A database with batches, assessments, an undamaged reference and charts; and what was acknowledged.
async fn filled(folder: &Path) -> Acknowledged {
    let mut service = Service::start(folder);
    let mut acknowledged = Acknowledged::default();
    for number in 0..12 {
        let given = batch("a", number, 10);
        let (_, answer) = post(&service, &given).await.unwrap();
        acknowledged.add(&given, &answer);
        if number == 3 {
            let ids: Vec<&String> = acknowledged.0.keys().collect();
            created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": ids })).await).await;
        }
    }
    all_assessed(&service).await;
    assert!(service.stop("TERM").success());
    acknowledged
}

/// Result of opening a damaged copy and reading all its content.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Outcome {
    /// The store was not opened.
    Refused,
    /// It was opened, and some row was refused.
    RowRefused,
    /// It was opened, and every batch is as it was acknowledged.
    Intact,
    /// It was opened, and a batch is missing or different without an error.
    Wrong(String),
}

async fn read_all(folder: &Path, acknowledged: &Acknowledged) -> Outcome {
    let structure = StructureId::parse(STRUCTURE).unwrap();
    let store = match Store::open(folder).await {
        Ok(store) => store,
        Err(error) => {
            assert!(error.to_string().len() > 10);
            return Outcome::Refused;
        }
    };
    let mut outcome = Outcome::Intact;
    let query = HistoryQuery { limit: 1_000, ..HistoryQuery::default() };
    match store.history().page(&structure, &query).await {
        Err(_) => outcome = Outcome::RowRefused,
        Ok(items) => {
            let found: Vec<&String> = items.iter().map(|item| &item.batch_id).collect();
            if !acknowledged.0.keys().all(|id| found.contains(&id)) {
                // One whose row cannot be read is left out, and named.
                outcome = if store.file().unreadable_rows().is_empty() {
                    Outcome::Wrong("the history lacks a batch".to_owned())
                } else {
                    Outcome::RowRefused
                };
            }
            if items.iter().any(|item| item.unreadable.is_some()) {
                outcome = outcome.max_of(Outcome::RowRefused);
            }
        }
    }
    for (id, digest) in &acknowledged.0 {
        match store.batches().batch(&structure, id).await {
            Err(_) => outcome = outcome.max_of(Outcome::RowRefused),
            Ok(Some(record)) if record.content_digest.as_str() == digest => {}
            Ok(_) => outcome = Outcome::Wrong(format!("batch {id} is missing or another")),
        }
        // Results may be refused, because they can be computed again from the measurements.
        let _ = store.assessments().assessment(&structure, id).await;
        let _ = store.alarms().chart_points(&structure, id).await;
    }
    let _ = store
        .alarms()
        .episodes(&structure, EpisodeQuery { before: None, open_only: false, superseded: true, limit: 100 })
        .await;
    let _ = store.alarms().charts(&structure, 100).await;
    let _ = store.reference().undamaged(&structure).await;
    let _ = store.structures().list().await;
    let _ = store.batches().pending(&structure, 100).await;
    let _ = store.history().exceedances(&structure, &query).await;
    store.close().await;
    outcome
}

impl Outcome {
    /// A wrong answer is an error of the test even if other rows are refused.
    fn max_of(self, other: Self) -> Self {
        self.max(other)
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_flipped_bit_is_refused_or_harms_no_measurement() {
    let folder = tempfile::tempdir().unwrap();
    let acknowledged = filled(folder.path()).await;
    let good = std::fs::read(database(folder.path())).unwrap();
    assert_eq!(read_all(folder.path(), &acknowledged).await, Outcome::Intact);
    let mut stream = modalwatch::stats::stream(20_261_121, "places of flipped bits");
    let mut counts = BTreeMap::<String, usize>::new();
    let mut wrong = Vec::new();
    for flip in 0..FLIPS {
        let mut bad = good.clone();
        // One bit in eight is in the header and the schema of the file, the others are anywhere.
        let place = stream.random_range(0..if flip % 8 == 0 { 4_096 } else { good.len() });
        let bit = stream.random_range(0..8);
        bad[place] ^= 1 << bit;
        let copy = tempfile::tempdir().unwrap();
        std::fs::write(database(copy.path()), &bad).unwrap();
        let outcome = read_all(copy.path(), &acknowledged).await;
        if outcome == Outcome::Refused {
            let left = std::fs::read(database(copy.path())).unwrap();
            // The first hundred bytes contain counters of SQLite.
            assert!(
                left.len() == bad.len() && left[100..] == bad[100..],
                "bit {bit} of byte {place}: it was written to"
            );
        }
        if let Outcome::Wrong(what) = &outcome {
            wrong.push(format!("bit {bit} of byte {place}: {what}"));
        }
        let name = format!("{outcome:?}");
        *counts.entry(name.split('(').next().unwrap().to_owned()).or_default() += 1;
    }
    println!("{FLIPS} flipped bits: {counts:?}");
    assert!(wrong.is_empty(), "{wrong:#?}");
    assert!(counts["Refused"] >= 10, "{counts:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_database_cut_anywhere_is_refused_and_names_the_backup() {
    let folder = tempfile::tempdir().unwrap();
    let acknowledged = filled(folder.path()).await;
    let good = std::fs::read(database(folder.path())).unwrap();
    let mut stream = modalwatch::stats::stream(20_261_122, "places of cuts");
    for cut in 0..40 {
        let length = match cut {
            0 => 1,
            1 => 99,
            2 => 4_096,
            _ => stream.random_range(16..good.len()),
        };
        let copy = tempfile::tempdir().unwrap();
        std::fs::write(database(copy.path()), &good[..length]).unwrap();
        let outcome = read_all(copy.path(), &acknowledged).await;
        assert_eq!(outcome, Outcome::Refused, "cut to {length} of {} bytes", good.len());
        assert!(std::fs::read(database(copy.path())).unwrap() == good[..length], "cut to {length}: it was written to");
    }
    // The message of the program.
    let copy = tempfile::tempdir().unwrap();
    std::fs::write(database(copy.path()), &good[..good.len() / 2]).unwrap();
    let output = command(copy.path()).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success() && said.contains("restore it from a backup"), "{said}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_log_that_is_cut_or_garbled_gives_whole_batches_or_none() {
    let folder = tempfile::tempdir().unwrap();
    let mut service = Service::start(folder.path());
    let mut acknowledged = Acknowledged::default();
    for number in 0..8 {
        let given = batch("a", number, 10);
        let (_, answer) = post(&service, &given).await.unwrap();
        acknowledged.add(&given, &answer);
    }
    service.kill();
    let log = std::fs::read(folder.path().join("modalwatch.sqlite-wal")).unwrap();
    let main = std::fs::read(database(folder.path())).unwrap();
    let mut stream = modalwatch::stats::stream(20_261_123, "damage of the log");
    for round in 0..24 {
        let copy = tempfile::tempdir().unwrap();
        std::fs::write(database(copy.path()), &main).unwrap();
        let mut bad = log.clone();
        let place = stream.random_range(0..log.len());
        if round % 2 == 0 {
            bad.truncate(place);
        } else {
            bad[place] ^= 0x10;
        }
        std::fs::write(copy.path().join("modalwatch.sqlite-wal"), &bad).unwrap();
        // Batches after the damage are lost, as after a power loss on a disk that acknowledges writes too early; those before it are
        // complete.
        if let Ok(store) = Store::open(copy.path()).await {
            store.close().await;
            drop(store);
            audit(copy.path(), &Acknowledged::default()).await;
        }
    }
    // The undamaged copy has all of them.
    Service::start(folder.path()).stop("TERM");
    audit(folder.path(), &acknowledged).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_first_start_can_be_killed_at_any_moment_and_repeated() {
    let folder = tempfile::tempdir().unwrap();
    let mut stream = modalwatch::stats::stream(20_261_124, "moments of the first start");
    for _ in 0..25 {
        let mut child = command(folder.path()).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        std::thread::sleep(Duration::from_micros(stream.random_range(0..120_000)));
        child.kill().unwrap();
        child.wait().unwrap();
    }
    let mut service = Service::start(folder.path());
    let mut acknowledged = Acknowledged::default();
    let given = batch("a", 0, 5);
    acknowledged.add(&given, &post(&service, &given).await.unwrap().1);
    assert_eq!(history(&service).await.len(), 1);
    assert!(service.stop("TERM").success());
    audit(folder.path(), &acknowledged).await;
}
