//! From an alarm to the receiver: once, signed, in order, also if the receiver fails or the service is killed.

use std::collections::BTreeSet;
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::process::Command;

use serde_json::{json, Value};

use crate::helpers::{command, created, measurements, problem, Service};
use crate::notify::receiver::{Answer, Received, Receiver};
use crate::notify::{eventually, metric};

pub const HEALTHY: [f64; 3] = [4.0, 5.0, 6.0];
const DAMAGED: [f64; 3] = [4.0, 4.4, 6.0];

/// A service that may send to this machine and retries every second.
pub fn start(data_dir: &Path, settings: &[(&str, &str)]) -> Service {
    Service::spawn(&mut prepared(data_dir, settings))
}

/// The command line of such a service.
pub fn prepared(data_dir: &Path, settings: &[(&str, &str)]) -> Command {
    let mut command = command(data_dir);
    command.env("MODALWATCH__NOTIFY__ALLOW_PRIVATE_TARGETS", "[\"127.0.0.0/8\", \"::1\"]");
    command.env("MODALWATCH__NOTIFY__FIRST_RETRY_S", "1").env("MODALWATCH__NOTIFY__LONGEST_RETRY_S", "1");
    command.envs(settings.iter().map(|(key, value)| (format!("MODALWATCH__NOTIFY__{key}"), *value)));
    command
}

pub async fn webhook(service: &Service, url: &str) -> Value {
    created(service.post("/v1/webhooks", &json!({ "url": url })).await).await
}

/// Declares an undamaged reference.
pub async fn declare_undamaged(service: &Service) {
    let healthy = service.post_batch("three-dof", &measurements(HEALTHY, 50, 0)).await;
    created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": [healthy["batch"]] })).await).await;
}

/// Posts a batch with a loss of k2, which raises alarm 1.
pub async fn damage(service: &Service) -> Value {
    let answer = service.post_batch("three-dof", &measurements(DAMAGED, 20, 100_000)).await;
    let k2 = answer["charts"].as_array().unwrap().iter().find(|c| c["chart"] == "k2").unwrap();
    assert_eq!(k2["state"], "alarming", "{answer}");
    answer
}

pub async fn acknowledge(service: &Service) {
    let path = "/v1/structures/three-dof/alarms/1/acknowledgement";
    assert_eq!(service.post(path, &json!({ "by": "A. Engineer", "note": "seen" })).await.status(), 200);
}

pub async fn deliveries(service: &Service, webhook: &Value, state: &str) -> Vec<Value> {
    let path = format!("/v1/webhooks/{}/deliveries?state={state}", webhook["webhook"].as_str().unwrap());
    service.read(&path).await["items"].as_array().unwrap().clone()
}

/// Waits until so many deliveries of a webhook are in a state.
pub async fn settled(service: &Service, webhook: &Value, state: &str, count: usize) -> Vec<Value> {
    eventually(state, async || Some(deliveries(service, webhook, state).await).filter(|found| found.len() == count))
        .await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn messages_of_an_alarm_are_sent_once_signed_and_in_order() {
    let folder = tempfile::tempdir().unwrap();
    let service = start(folder.path(), &[("PUBLIC_URL", "https://shm.example.org")]);
    let receiver = Receiver::start(Answer::Status(200)).await;
    let hook = webhook(&service, &receiver.url("/hook")).await;
    declare_undamaged(&service).await;
    let batch = damage(&service).await;
    let opened = receiver.wait_for(1).await.remove(0);
    assert!(opened.is_signed_with(&hook["secret"]), "{opened:?}");
    let other = json!("whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw");
    assert!(!opened.is_signed_with(&other), "the check of the signature can fail");
    assert_eq!(opened.headers["content-type"], "application/cloudevents+json; charset=utf-8");
    let event = opened.json();
    assert_eq!(
        (&event["specversion"], &event["type"], &event["source"], &event["subject"], &event["id"]),
        (
            &json!("1.0"),
            &json!("org.modalwatch.alarm.opened"),
            &json!("https://shm.example.org"),
            &json!("structures/three-dof/alarms/1"),
            &json!(opened.id()),
        ),
    );
    let data = &event["data"];
    assert_eq!(
        (&data["structure"], &data["alarm"], &data["kind"], &data["parameter"], &data["state"], &data["opened_batch"]),
        (&json!("three-dof"), &json!(1), &json!("damage"), &json!("k2"), &json!("open"), &batch["batch"]),
    );
    assert!(data["peak_shift_standard_errors"].as_f64().unwrap() > 3.0, "{event}");
    // Its link leads to the alarm.
    let page = service.read(data["alarm_url"].as_str().unwrap().strip_prefix("https://shm.example.org").unwrap()).await;
    assert_eq!((&page["items"][0]["alarm"], page["items"].as_array().unwrap().len()), (&json!(1), 1));

    // The alarm is acknowledged twice, its batch is posted twice, and healthy batches end it: each event is sent once.
    acknowledge(&service).await;
    acknowledge(&service).await;
    damage(&service).await;
    for i in 2..=9 {
        service.post_batch("three-dof", &measurements(HEALTHY, 20, 100_000 * i)).await;
    }
    settled(&service, &hook, "delivered", 3).await;
    settled(&service, &hook, "pending", 0).await;
    let received = receiver.all();
    let kinds: Vec<String> = received.iter().map(Received::kind).collect();
    assert_eq!(
        kinds,
        ["org.modalwatch.alarm.opened", "org.modalwatch.alarm.acknowledged", "org.modalwatch.alarm.ended"]
    );
    assert_eq!(received.iter().map(|r| r.id().to_owned()).collect::<BTreeSet<_>>().len(), 3);
    assert_eq!(received[1].json()["data"]["acknowledgement"]["by"], "A. Engineer");
    assert!(received[2].json()["data"]["ended_at"].is_string());
    let count = metric(&service, "modalwatch_webhook_deliveries_total{outcome=\"delivered\"}").await;
    assert!((count - 3.0).abs() < 0.5, "{count}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_receiver_that_fails_gets_the_same_message_again_and_a_redirect_is_not_followed() {
    let folder = tempfile::tempdir().unwrap();
    let service = start(folder.path(), &[]);
    let (receiver, bait) = (Receiver::start(Answer::Status(500)).await, Receiver::start(Answer::Status(200)).await);
    let hook = webhook(&service, &receiver.url("/")).await;
    declare_undamaged(&service).await;
    damage(&service).await;
    receiver.wait_for(1).await;
    // The attempt is stored after the answer has arrived.
    let tried = eventually("an attempt that failed", async || {
        deliveries(&service, &hook, "pending").await.into_iter().find(|d| d["last_status"] == 500)
    });
    let tried = tried.await;
    assert!(tried["attempts"].as_i64().unwrap() >= 1, "{tried}");
    receiver.answer(Answer::RedirectTo(bait.url("/")));
    let refused = eventually("a refused redirect", async || {
        deliveries(&service, &hook, "pending").await.into_iter().find(|d| d["last_status"] == 307)
    });
    let refused = refused.await;
    assert!(refused["last_error"].as_str().unwrap().contains("redirects are not followed"), "{refused}");
    receiver.answer(Answer::Status(200));
    settled(&service, &hook, "delivered", 1).await;
    assert_eq!(receiver.taken().len(), 1);
    let ids: BTreeSet<String> = receiver.all().iter().map(|r| r.id().to_owned()).collect();
    assert_eq!((ids.len(), bait.all().len()), (1, 0), "one message, and no redirect was followed");
    assert!(receiver.all().len() >= 3);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_receiver_that_never_answers_delays_no_other() {
    let folder = tempfile::tempdir().unwrap();
    let service = start(folder.path(), &[("TIMEOUT_S", "120")]);
    let (slow, fast) = (Receiver::start(Answer::Never).await, Receiver::start(Answer::Status(200)).await);
    let slow_hook = webhook(&service, &slow.url("/")).await;
    let fast_hook = webhook(&service, &fast.url("/")).await;
    declare_undamaged(&service).await;
    damage(&service).await;
    slow.wait_for(1).await;
    acknowledge(&service).await;
    settled(&service, &fast_hook, "delivered", 2).await;
    // The other receiver has not yet answered the first message and was not sent the second one.
    assert_eq!(slow.all().len(), 1);
    let waiting = deliveries(&service, &slow_hook, "pending").await;
    assert!(waiting.len() == 2 && waiting.iter().all(|d| d["attempts"] == 0), "{waiting:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_undeliverable_message_becomes_a_dead_letter_that_can_be_sent_again() {
    let folder = tempfile::tempdir().unwrap();
    let service = start(folder.path(), &[("GIVE_UP_AFTER_S", "2")]);
    let receiver = Receiver::start(Answer::Status(503)).await;
    let hook = webhook(&service, &receiver.url("/")).await;
    declare_undamaged(&service).await;
    damage(&service).await;
    let dead = settled(&service, &hook, "dead", 1).await.remove(0);
    assert_eq!((&dead["event"], &dead["last_status"]), (&json!("alarm.opened"), &json!(503)));
    assert!(dead["attempts"].as_u64().unwrap() >= 2 && dead["next_attempt_at"].is_null(), "{dead}");
    eventually("the figure of dead letters", async || {
        (metric(&service, "modalwatch_webhook_dead").await > 0.5).then_some(())
    })
    .await;
    let attempts = receiver.all().len();

    receiver.answer(Answer::Status(200));
    let path = format!("/v1/webhooks/{}/deliveries/{}/retry", hook["webhook"].as_str().unwrap(), dead["delivery"]);
    let again = service.post(&path, &json!({})).await;
    assert_eq!(again.status(), 202);
    settled(&service, &hook, "delivered", 1).await;
    assert_eq!((receiver.taken().len(), receiver.all().len()), (1, attempts + 1));
    assert_eq!(receiver.taken()[0].id(), dead["message"].as_str().unwrap());
    problem(service.post(&path, &json!({})).await, 409, "already_delivered").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_alarm_raised_just_before_a_kill_is_sent_after_the_restart() {
    let folder = tempfile::tempdir().unwrap();
    let mut service = start(folder.path(), &[]);
    let receiver = Receiver::start(Answer::Status(503)).await;
    let hook = webhook(&service, &receiver.url("/")).await;
    declare_undamaged(&service).await;
    damage(&service).await;
    service.kill();
    assert!(receiver.taken().is_empty());
    receiver.answer(Answer::Status(200));
    let service = start(folder.path(), &[]);
    settled(&service, &hook, "delivered", 1).await;
    settled(&service, &hook, "pending", 0).await;
    let taken = receiver.taken();
    assert_eq!((taken.len(), taken[0].kind().as_str()), (1, "org.modalwatch.alarm.opened"));
    assert!(taken[0].is_signed_with(&hook["secret"]));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn during_a_rotation_both_secrets_sign_and_only_the_answer_that_makes_one_shows_it() {
    let folder = tempfile::tempdir().unwrap();
    let service = start(folder.path(), &[("SECRET_OVERLAP_S", "2")]);
    let receiver = Receiver::start(Answer::Status(204)).await;
    let first = webhook(&service, &receiver.url("/")).await;
    let path = format!("/v1/webhooks/{}", first["webhook"].as_str().unwrap());
    let test = async || service.post(&format!("{path}/test"), &json!({})).await.json::<Value>().await.unwrap();
    let answer = test().await;
    assert_eq!((&answer["delivered"], &answer["status"]), (&json!(true), &json!(204)), "{answer}");
    assert!(answer["latency_ms"].as_f64().unwrap() > 0.0);

    let response = service.post(&format!("{path}/secret"), &json!({})).await;
    let second: Value = response.json().await.unwrap();
    assert_ne!(first["secret"], second["secret"]);
    test().await;
    eventually("the end of the overlap", async || {
        service.read(&path).await["previous_secret_until"].is_null().then_some(())
    })
    .await;
    test().await;
    let received = receiver.all();
    assert_eq!(received.iter().map(Received::kind).collect::<Vec<_>>(), ["org.modalwatch.test"; 3]);
    let signed: Vec<[bool; 2]> =
        received.iter().map(|r| [r.is_signed_with(&first["secret"]), r.is_signed_with(&second["secret"])]).collect();
    assert_eq!(signed, [[true, false], [true, true], [false, true]]);
    for path in [path.as_str(), "/v1/webhooks"] {
        assert!(!service.read(path).await.to_string().contains("whsec_"), "{path} shows a secret");
    }

    // Only its owner can read the file that contains them.
    for name in ["modalwatch.sqlite", "modalwatch.sqlite-wal"] {
        let mode = std::fs::metadata(folder.path().join(name)).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600, "{name}");
    }
}
