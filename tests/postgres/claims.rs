//! Claims of shared computations: no two of the same piece, leases by the clock of the server, and fences.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use modalwatch::measurement::{MeasurementBatch, ModalMeasurement};
use modalwatch::quantity::{Digest, Hertz, StructureId, Timestamp};
use modalwatch::store::{open_beside, Computations, ComputedResult, ComputedWith, LiveWorkers, PieceState, Store};

use crate::postgres::database::{open_store, url_of};
use crate::postgres::server::Server;

const LEASE: Duration = Duration::from_mins(1);

/// 2026-01-15T00:00:00Z, µs.
const MIDDLE_OF_JANUARY: i64 = 1_768_435_200_000_000;
const DAY: i64 = 86_400_000_000;

fn bridge() -> StructureId {
    StructureId::parse("bridge").unwrap()
}

fn with(model: &str) -> ComputedWith {
    ComputedWith {
        program: "this".to_owned(),
        structure_digest: Digest::of(&[b"v1"]),
        model_digest: Digest::of(&[model.as_bytes()]),
        draws_per_measurement: 10,
        draws_for_population: 64,
    }
}

/// The store of the service, one of a worker beside it, and batches `b00` … of which three are in each month.
async fn stores(months: i64) -> (Store, Store, tempfile::TempDir) {
    let folder = tempfile::tempdir().unwrap();
    let serving = open_store(folder.path()).await;
    let beside = open_beside(folder.path(), &url_of(folder.path()).await).await.unwrap();
    let at = |micros: i64| Timestamp::from_micros(micros).unwrap();
    serving.structures().put_structure(&bridge(), "{}", &Digest::of(&[b"v1"]), at(MIDDLE_OF_JANUARY)).await.unwrap();
    for number in 0..3 * months {
        let measured_at = at(MIDDLE_OF_JANUARY + number / 3 * 30 * DAY + number % 3 * DAY);
        let measurement = ModalMeasurement {
            measured_at,
            frequencies_hz: vec![Some(Hertz::new(1.0).unwrap())],
            std_hz: None,
            mode_shapes: None,
            covariates: BTreeMap::new(),
            settings: BTreeMap::new(),
        };
        let batch = MeasurementBatch {
            structure: bridge(),
            source: "logger".to_owned(),
            idempotency_key: None,
            posted_by: None,
            measurements: vec![measurement],
        };
        serving.batches().insert_batch(&batch, &format!("b{number:02}"), at(1_000_000 * number)).await.unwrap();
    }
    (serving, beside, folder)
}

fn result(batch: &str, text: &str) -> ComputedResult {
    ComputedResult { batch_id: batch.to_owned(), inputs: Digest::of(&[b"inputs"]), outcome: Ok(text.to_owned()) }
}

/// A result that is not there.
const NOTHING: Option<Result<String, String>> = None;

#[expect(clippy::unnecessary_wraps, reason = "compared with results, of which some are failures")]
fn done(text: &str) -> Result<String, String> {
    Ok(text.to_owned())
}

fn failed(text: &str) -> Result<String, String> {
    Err(text.to_owned())
}

async fn contents(store: &Store, batches: &[&str]) -> Vec<Option<Result<String, String>>> {
    let ids: Vec<String> = batches.iter().map(|id| (*id).to_owned()).collect();
    let awaited = Computations::of(store).unwrap().awaited(&bridge(), &ids).await.unwrap();
    awaited.into_iter().map(|awaited| awaited.result.map(|result| result.outcome)).collect()
}

async fn piece(store: &Store, batch: &str) -> PieceState {
    let awaited = Computations::of(store).unwrap().awaited(&bridge(), &[batch.to_owned()]).await.unwrap();
    awaited[0].piece
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn two_claims_never_get_the_same_piece_and_each_has_a_larger_number() {
    if !Server::is_installed() {
        return;
    }
    let (serving, beside, _folder) = stores(6).await;
    let offers = Computations::of(&serving).unwrap();
    offers.offer(&bridge(), &with("m"), 100).await.unwrap();
    // Offered again with the same, nothing changes; of another program, nothing is claimed.
    offers.offer(&bridge(), &with("m"), 100).await.unwrap();
    assert_eq!(Computations::of(&beside).unwrap().claim("w", "another", LEASE, &[]).await.unwrap(), None);
    let claims: Vec<_> = (0..8)
        .map(|worker| {
            let beside = beside.clone();
            tokio::spawn(async move {
                let (computations, mut claimed) = (Computations::of(&beside).unwrap(), Vec::new());
                while let Some(claim) = computations.claim(&format!("w{worker}"), "this", LEASE, &[]).await.unwrap() {
                    claimed.push(claim);
                }
                claimed
            })
        })
        .collect();
    let mut all = Vec::new();
    for claimed in claims {
        let claimed = claimed.await.unwrap();
        assert!(claimed.windows(2).all(|pair| pair[0].fence < pair[1].fence));
        all.extend(claimed);
    }
    let months: BTreeSet<i64> = all.iter().map(|claim| claim.from_us).collect();
    let fences: BTreeSet<i64> = all.iter().map(|claim| claim.fence).collect();
    assert_eq!((all.len(), months.len(), fences.len()), (6, 6, 6), "{all:?}");
    // Each batch is in one of them, and they are the months.
    let mut batches = Vec::new();
    for claim in &all {
        assert_eq!(claim.with, with("m"));
        assert!((28..=31).contains(&((claim.to_us - claim.from_us) / DAY)), "{claim:?}");
        batches.extend(Computations::of(&beside).unwrap().waiting(claim).await.unwrap());
    }
    batches.sort();
    assert_eq!(batches, (0..18).map(|number| format!("b{number:02}")).collect::<Vec<_>>());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_written_under_a_claim_that_was_lost_is_refused_and_changes_nothing() {
    if !Server::is_installed() {
        return;
    }
    let (serving, beside, _folder) = stores(1).await;
    let (offers, worker) = (Computations::of(&serving).unwrap(), Computations::of(&beside).unwrap());
    offers.offer(&bridge(), &with("m"), 100).await.unwrap();
    assert!(matches!(piece(&serving, "b00").await, PieceState::Free(since) if since < LEASE));

    // The lease runs out without a renewal, by the clock of the server.
    let short = Duration::from_millis(300);
    let lost = worker.claim("slow", "this", short, &[]).await.unwrap().unwrap();
    assert_eq!(piece(&serving, "b00").await, PieceState::Held);
    assert_eq!(worker.claim("quick", "this", LEASE, &[]).await.unwrap(), None, "it is held");
    assert!(worker.deliver(&lost, &[result("b00", "first")]).await.unwrap());
    tokio::time::sleep(2 * short).await;
    assert!(matches!(piece(&serving, "b00").await, PieceState::Free(since) if since >= short / 2));
    let held = worker.claim("quick", "this", LEASE, &[]).await.unwrap().unwrap();
    assert!(held.fence > lost.fence);
    assert_eq!(worker.waiting(&held).await.unwrap(), ["b01", "b02"], "what was delivered is not computed again");

    // The first one wakes up.
    for results in [&[result("b00", "late")][..], &[result("b01", "late"), result("b02", "late")]] {
        assert!(!worker.deliver(&lost, results).await.unwrap());
    }
    assert!(!worker.renew(&lost, LEASE).await.unwrap());
    worker.complete(&lost).await.unwrap();
    worker.release(&lost).await.unwrap();
    assert_eq!(piece(&serving, "b00").await, PieceState::Held, "the claim of another was ended");
    assert_eq!(contents(&serving, &["b00", "b01"]).await, [Some(done("first")), NOTHING]);
    let without = ComputedResult { outcome: Err("no measurement".to_owned()), ..result("b01", "") };
    assert!(worker.deliver(&held, &[without]).await.unwrap() && worker.renew(&held, LEASE).await.unwrap());
    assert_eq!(contents(&serving, &["b01"]).await, [Some(failed("no measurement"))]);

    // The service offers it with another model: its holder has lost it, too.
    offers.offer(&bridge(), &with("another"), 100).await.unwrap();
    assert!(!worker.deliver(&held, &[result("b02", "of the old model")]).await.unwrap());
    assert!(!worker.renew(&held, LEASE).await.unwrap());
    assert_eq!(contents(&serving, &["b02"]).await, [NOTHING]);
    let lacking = [with("another").model_digest];
    assert_eq!(worker.claim("quick", "this", LEASE, &lacking).await.unwrap(), None, "its model is missing there");
    let again = worker.claim("quick", "this", LEASE, &[]).await.unwrap().unwrap();
    assert_eq!((again.with.clone(), again.fence > held.fence), (with("another"), true));
    worker.release(&again).await.unwrap();
    assert!(matches!(piece(&serving, "b00").await, PieceState::Free(_)));
    let last = worker.claim("quick", "this", LEASE, &[]).await.unwrap().unwrap();
    worker.complete(&last).await.unwrap();
    assert_eq!(piece(&serving, "b02").await, PieceState::NotOffered);
    // It was complete without a result of b02: it is offered again, because b02 waits.
    offers.offer(&bridge(), &with("another"), 100).await.unwrap();
    let last = worker.claim("quick", "this", LEASE, &[]).await.unwrap().unwrap();
    assert_eq!(worker.waiting(&last).await.unwrap(), ["b02"]);

    // What the service has taken is removed; at the end everything is.
    offers.remove(&bridge(), &["b00".to_owned()]).await.unwrap();
    assert_eq!(contents(&serving, &["b00", "b01"]).await, [NOTHING, Some(failed("no measurement"))]);
    offers.tidy().await.unwrap();
    assert_eq!(contents(&serving, &["b01"]).await.len(), 1, "it waits, and its result holds");
    offers.withdraw(&bridge(), true).await.unwrap();
    assert_eq!(contents(&serving, &["b00", "b01", "b02"]).await, [NOTHING, NOTHING, NOTHING]);
    assert!(!worker.deliver(&last, &[result("b02", "late")]).await.unwrap());
    assert_eq!(contents(&serving, &["b02"]).await, [NOTHING]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn workers_are_known_while_they_are_heard_of_and_only_the_service_offers() {
    if !Server::is_installed() {
        return;
    }
    let (serving, beside, _folder) = stores(2).await;
    let (offers, worker) = (Computations::of(&serving).unwrap(), Computations::of(&beside).unwrap());
    let live = async |lease| offers.workers("this", "own", lease).await.unwrap();
    assert_eq!(live(LEASE).await, LiveWorkers::default());
    worker.hear("own", "this").await.unwrap();
    worker.hear("one", "this").await.unwrap();
    worker.hear("old", "an earlier program").await.unwrap();
    assert_eq!(live(LEASE).await, LiveWorkers { others: 1, idle: 2 });
    offers.offer(&bridge(), &with("m"), 1).await.unwrap();
    worker.claim("one", "this", LEASE, &[]).await.unwrap().unwrap();
    assert_eq!(live(LEASE).await, LiveWorkers { others: 1, idle: 1 });
    assert_eq!(worker.claim("own", "this", LEASE, &[]).await.unwrap(), None, "only the first month was offered");
    worker.leave("own").await.unwrap();
    assert_eq!(live(LEASE).await, LiveWorkers { others: 1, idle: 0 });
    tokio::time::sleep(Duration::from_millis(300)).await;
    assert_eq!(live(Duration::from_millis(200)).await, LiveWorkers::default());
    // Beside the service nothing can be written that only it may write.
    let refused = worker.offer(&bridge(), &with("another"), 100).await;
    assert!(refused.is_err(), "{refused:?}");
}
