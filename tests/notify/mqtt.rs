//! Batches from a broker: each is stored once, also if a program is killed; messages that are not batches are
//! quarantined and do not block others.

use std::collections::BTreeSet;
use std::ops::Range;
use std::path::Path;
use std::time::{Duration, Instant};

use rumqttc::QoS;
use serde_json::{json, Value};

use crate::helpers::{command, measurements, problem, within, Service};
use crate::notify::broker::Broker;
use crate::notify::{eventually, metric};

const TOPIC: &str = "modalwatch/three-dof/batches";

fn start(data_dir: &Path, broker: &Broker) -> Service {
    Service::spawn(command(data_dir).env("MODALWATCH__MQTT__URL", broker.url()))
}

/// A batch of three measurements at times that no other `number` has.
fn batch(number: usize) -> Vec<u8> {
    json!({ "measurements": measurements([4.0, 5.0, 6.0], 3, number * 2_000) }).to_string().into_bytes()
}

async fn connected(service: &Service, wanted: bool) {
    eventually("the connection to the broker", async || {
        ((metric(service, "modalwatch_mqtt_connected").await > 0.5) == wanted).then_some(())
    })
    .await;
}

async fn outcome(service: &Service, outcome: &str) -> usize {
    metric(service, &format!("modalwatch_mqtt_messages_total{{outcome=\"{outcome}\"}}")).await as usize
}

async fn count(service: &Service, name: &str, at_least: usize) {
    eventually(name, async || (outcome(service, name).await >= at_least).then_some(())).await;
}

async fn stored(service: &Service) -> Vec<Value> {
    service.read("/v1/structures/three-dof/history?limit=1000").await["items"].as_array().unwrap().clone()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_message_is_a_batch_and_twice_the_same_is_one() {
    let Some(broker) = Broker::start() else { return };
    let folder = tempfile::tempdir().unwrap();
    let service = start(folder.path(), &broker);
    connected(&service, true).await;
    let mut body: Value = serde_json::from_slice(&batch(0)).unwrap();
    body["source"] = json!("gateway-7");
    body["idempotency_key"] = json!("key-1");
    let message = body.to_string().into_bytes();
    broker.publish(&[(TOPIC, message.clone()), (TOPIC, message), (TOPIC, batch(1)), (TOPIC, batch(1))]).await;
    count(&service, "stored", 2).await;
    count(&service, "replayed", 2).await;
    let items = stored(&service).await;
    assert_eq!(items.len(), 2);
    assert!(items.iter().all(|item| item["state"] == "assessed" && item["measurement_count"] == 3), "{items:?}");
    assert_eq!(items.iter().filter(|item| item["source"] == "gateway-7").count(), 1);
    // It is recognised over HTTP too.
    let again = service.post("/v1/structures/three-dof/batches", &serde_json::from_slice(&batch(1)).unwrap()).await;
    assert_eq!(again.headers()["idempotency-replayed"], "true");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_message_without_a_valid_batch_is_quarantined_and_blocks_no_other() {
    let Some(broker) = Broker::start() else { return };
    let folder = tempfile::tempdir().unwrap();
    let service = Service::spawn(
        command(folder.path())
            .env("MODALWATCH__MQTT__URL", broker.url())
            .env("MODALWATCH__MQTT__MAX_PAYLOAD_BYTES", "200000"),
    );
    connected(&service, true).await;
    let mut conflict: Value = serde_json::from_slice(&batch(0)).unwrap();
    conflict["measurements"][0]["frequencies_hz"][0] = json!(0.42);
    let mut negative: Value = serde_json::from_slice(&batch(5)).unwrap();
    negative["measurements"][1]["frequencies_hz"][2] = json!(-1.0);
    let large = vec![b' '; 300_000];
    broker
        .publish(&[
            (TOPIC, batch(0)),
            (TOPIC, b"\xff\x00 hello".to_vec()),
            (TOPIC, b"{\"measurements\": [], \"sorce\": 1}".to_vec()),
            (TOPIC, negative.to_string().into_bytes()),
            (TOPIC, conflict.to_string().into_bytes()),
            (TOPIC, large),
            ("modalwatch/nowhere/batches", batch(6)),
            ("modalwatch/Ünter/batches", batch(7)),
            (TOPIC, batch(1)),
        ])
        .await;
    count(&service, "stored", 2).await;
    count(&service, "quarantined", 7).await;
    let page = service.read("/v1/quarantine").await;
    let items = page["items"].as_array().unwrap();
    assert_eq!(items.len(), 7, "{page}");
    for reason in [
        "the body is not valid JSON",
        "/sorce: unknown field",
        "/measurements/1/frequencies_hz/2",
        "which has other content",
        "exceeds mqtt.max_payload_bytes",
        "no structure nowhere",
        "structure id",
    ] {
        let found = items.iter().filter(|item| item["reason"].as_str().unwrap().contains(reason)).count();
        assert_eq!(found, 1, "{reason}: {page}");
    }
    assert!(items.iter().all(|item| item["tries"] == 1 && item["topic"].as_str().unwrap().ends_with("/batches")));
    let large = items.iter().find(|item| item["payload_bytes"] == 300_000).unwrap();
    let whole = service.read(&format!("/v1/quarantine/{}", large["message"])).await;
    assert_eq!(whole["payload"].as_str().unwrap().len(), 64 * 1024, "the beginning of the payload is kept");

    // The same message again is counted but not stored twice.
    broker.publish(&[(TOPIC, b"\xff\x00 hello".to_vec())]).await;
    count(&service, "quarantined", 8).await;
    let again = service.read("/v1/quarantine?limit=1000").await;
    let again = again["items"].as_array().unwrap();
    assert_eq!((again.len(), again.iter().filter(|item| item["tries"] == 2).count()), (7, 1));
    let path = format!("/v1/quarantine/{}", large["message"]);
    assert_eq!(service.request(reqwest::Method::DELETE, &path).send().await.unwrap().status(), 204);
    problem(service.request(reqwest::Method::DELETE, &path).send().await.unwrap(), 404, "unknown_message").await;
    assert_eq!(stored(&service).await.len(), 2);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_broker_that_comes_back_without_its_memory_is_subscribed_again() {
    let Some(mut broker) = Broker::start() else { return };
    let folder = tempfile::tempdir().unwrap();
    let service = start(folder.path(), &broker);
    connected(&service, true).await;
    broker.publish(&[(TOPIC, batch(0))]).await;
    count(&service, "stored", 1).await;
    broker.stop();
    connected(&service, false).await;
    // HTTP works meanwhile.
    let body = serde_json::from_slice(&batch(1)).unwrap();
    assert_eq!(service.post("/v1/structures/three-dof/batches", &body).await.status(), 201);
    broker.restart();
    connected(&service, true).await;
    broker.publish(&[(TOPIC, batch(2))]).await;
    count(&service, "stored", 2).await;
    assert_eq!(stored(&service).await.len(), 3);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_message_is_stored_exactly_once_whenever_the_service_is_killed() {
    const MESSAGES: usize = 60;
    let Some(broker) = Broker::start() else { return };
    let folder = tempfile::tempdir().unwrap();
    let mut service = start(folder.path(), &broker);
    connected(&service, true).await;
    let messages: Vec<(&str, Vec<u8>)> = (0..MESSAGES).map(|number| (TOPIC, batch(number))).collect();
    broker.publish(&messages).await;
    let mut seen = Vec::new();
    for _ in 0..3 {
        // During processing: at least one more batch is stored, and not all messages are acknowledged.
        eventually("work", async || {
            let working = outcome(&service, "stored").await > 0 || stored(&service).await.len() >= MESSAGES;
            working.then_some(())
        })
        .await;
        seen.push(stored(&service).await.len());
        service.kill();
        service = start(folder.path(), &broker);
    }
    // One more message was published while the service was down.
    service.kill();
    broker.publish(&[(TOPIC, batch(MESSAGES))]).await;
    service = start(folder.path(), &broker);
    eventually("all messages", async || (stored(&service).await.len() > MESSAGES).then_some(())).await;
    // Messages are taken in their order: behind this one nothing is left that could be stored a second time.
    broker.publish(&[(TOPIC, batch(MESSAGES + 1))]).await;
    eventually("the last message", async || (stored(&service).await.len() > MESSAGES + 1).then_some(())).await;
    let items = stored(&service).await;
    let times: BTreeSet<&str> = items.iter().map(|item| item["measured_from"].as_str().unwrap()).collect();
    assert_eq!((items.len(), times.len()), (MESSAGES + 2, MESSAGES + 2));
    println!("stored before each kill: {seen:?}");
    assert!(seen[0] < MESSAGES, "the service was killed after the last message: the test shows nothing");
    assert_eq!(service.read("/v1/quarantine").await["items"], json!([]));
    assert_eq!(service.stop("TERM").code(), Some(0));
}

/// Number of stored batches of the structure.
async fn batches(service: &Service) -> usize {
    let overview = service.read("/v1/overview").await;
    let items = overview["items"].as_array().unwrap();
    items.iter().find(|item| item["id"] == "three-dof").unwrap()["batches"].as_u64().unwrap() as usize
}

/// One measurement, at a time of its own: 200,000 of them lie in the months that [`measurements`] knows.
fn single(number: usize) -> Vec<u8> {
    json!({ "measurements": measurements([4.0, 5.0, 6.0], 1, number * 100) }).to_string().into_bytes()
}

/// Messages in the backlog of each quality of service.
fn backlog() -> usize {
    std::env::var("MODALWATCH_BACKLOG").map_or(600, |text| text.parse().unwrap())
}

/// Publishes a backlog while the service is away.
async fn publish_backlog(broker: &Broker, qos: QoS, numbers: Range<usize>) {
    for first in numbers.clone().step_by(1_000) {
        let end = (first + 1_000).min(numbers.end);
        let messages: Vec<(&str, Vec<u8>)> = (first..end).map(|number| (TOPIC, single(number))).collect();
        broker.publish_as(qos, &messages).await;
    }
}

/// A broker sends its backlog as fast as it can when the service comes back, before anything is acknowledged.
///
/// `MODALWATCH_BACKLOG=100000 cargo test --release --test service backlog -- --nocapture` is the same with 100,000 messages of each
/// quality of service.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_backlog_of_the_broker_is_taken_whole_although_the_broker_restarts_in_between() {
    let each = backlog();
    let Some(mut broker) = Broker::start_persistent() else { return };
    let folder = tempfile::tempdir().unwrap();
    let mut service = start(folder.path(), &broker);
    connected(&service, true).await;
    assert_eq!(service.stop("TERM").code(), Some(0));
    for (half, qos) in [QoS::AtLeastOnce, QoS::ExactlyOnce].into_iter().enumerate() {
        publish_backlog(&broker, qos, half * each..(half + 1) * each).await;
        let begun = Instant::now();
        service = start(folder.path(), &broker);
        let (mut restarted, mut stored, mut progress) = (false, 0, Instant::now());
        while stored < each {
            tokio::time::sleep(Duration::from_millis(200)).await;
            let now = batches(&service).await - half * each;
            if now > stored {
                (stored, progress) = (now, Instant::now());
            }
            assert!(
                progress.elapsed() < Duration::from_mins(1),
                "stopped after {stored} of {each} messages of {qos:?}: {}",
                service.read("/readyz").await
            );
            if !restarted && stored > each / 4 {
                assert!(stored < each, "the broker restarts behind the last message: the test shows nothing");
                broker.bounce();
                restarted = true;
            }
        }
        let elapsed_s = begun.elapsed().as_secs_f64();
        println!("{qos:?}: {stored} messages in {elapsed_s:.0} s, {:.0} a second", stored as f64 / elapsed_s);
        assert!(restarted);
        // What the broker has sent a second time after its restart, up to 65,535 messages, is recognised one by one.
        within(Duration::from_mins(5), "no message waits", async || {
            (metric(&service, "modalwatch_mqtt_waiting_messages").await < 0.5).then_some(())
        })
        .await;
        assert_eq!(service.stop("TERM").code(), Some(0));
    }
    // Behind this message nothing is left that could be stored a second time.
    let service = start(folder.path(), &broker);
    broker.publish(&[(TOPIC, single(2 * each))]).await;
    eventually("the last message", async || (batches(&service).await > 2 * each).then_some(())).await;
    assert_eq!(batches(&service).await, 2 * each + 1, "each message is stored once");
    assert_eq!(service.read("/v1/quarantine").await["items"], json!([]));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn messages_that_cannot_be_stored_are_seen_within_half_a_minute() {
    use sqlx::Connection as _;
    let Some(broker) = Broker::start() else { return };
    let folder = tempfile::tempdir().unwrap();
    let service = start(folder.path(), &broker);
    connected(&service, true).await;
    // Another program locks the database, as a copy tool or an inspection would.
    let options = sqlx_sqlite::SqliteConnectOptions::new().filename(folder.path().join("modalwatch.sqlite"));
    let mut other = sqlx_sqlite::SqliteConnection::connect_with(&options).await.unwrap();
    sqlx::query("begin immediate").execute(&mut other).await.unwrap();
    let begun = Instant::now();
    broker.publish(&[(TOPIC, batch(0)), (TOPIC, batch(1))]).await;
    eventually("the metric", async || (metric(&service, "modalwatch_mqtt_waiting_messages").await > 1.5).then_some(()))
        .await;
    within(Duration::from_secs(30).saturating_sub(begun.elapsed()), "the finding of readiness", async || {
        let answer: Value = service.get("/readyz").send().await.ok()?.json().await.ok()?;
        answer.to_string().contains("2 MQTT messages wait").then_some(())
    })
    .await;
    println!("seen after {:?}", begun.elapsed());
    sqlx::query("rollback").execute(&mut other).await.unwrap();
    other.close().await.unwrap();
    // Whatever was tried meanwhile, both are stored in the end and nothing waits.
    within(Duration::from_mins(1), "the messages", async || {
        let kept = batches(&service).await + service.read("/v1/quarantine").await["items"].as_array().unwrap().len();
        (kept == 2 && metric(&service, "modalwatch_mqtt_waiting_messages").await < 0.5).then_some(())
    })
    .await;
    within(Duration::from_secs(20), "the end of the finding", async || {
        let answer: Value = service.get("/readyz").send().await.ok()?.json().await.ok()?;
        (!answer.to_string().contains("MQTT")).then_some(())
    })
    .await;
}
