//! Receivers that refuse some or all messages: which other messages they delay, and how often they are contacted.

use std::collections::BTreeSet;
use std::time::Duration;

use serde_json::Value;

use crate::helpers::{measurements, Service};
use crate::notify::eventually;
use crate::notify::receiver::{Answer, Received, Receiver};
use crate::notify::webhooks::{acknowledge, declare_undamaged, deliveries, settled, start, webhook, HEALTHY};

/// Posts a batch with a loss of all three stiffnesses; returns the number of alarms.
async fn damage_everything(service: &Service) -> usize {
    service.post_batch("three-dof", &measurements([3.4, 4.4, 5.2], 20, 100_000)).await;
    let alarms = service.read("/v1/structures/three-dof/alarms").await["items"].as_array().unwrap().len();
    assert!(alarms >= 3, "{alarms} alarms");
    alarms
}

fn of_first_alarm(received: &Received) -> bool {
    received.subject() == "structures/three-dof/alarms/1"
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_refused_message_holds_back_those_of_its_own_alarm_and_no_other() {
    let folder = tempfile::tempdir().unwrap();
    let service = start(folder.path(), &[]);
    let refusing = Answer::Refusing("\"subject\":\"structures/three-dof/alarms/1\"".to_owned());
    let receiver = Receiver::start(refusing).await;
    let hook = webhook(&service, &receiver.url("/")).await;
    declare_undamaged(&service).await;
    let alarms = damage_everything(&service).await;
    acknowledge(&service).await;
    for i in 2..=9 {
        service.post_batch("three-dof", &measurements(HEALTHY, 20, 100_000 * i)).await;
    }
    // All messages of the other alarms have arrived, and the refused message was retried meanwhile.
    settled(&service, &hook, "delivered", 2 * (alarms - 1)).await;
    let refused = eventually("a second attempt", async || {
        let waiting = deliveries(&service, &hook, "pending").await;
        waiting.iter().any(|d| d["attempts"].as_u64() >= Some(2)).then_some(waiting)
    });
    let refused = refused.await;
    let waiting: Vec<(&Value, bool)> = refused.iter().rev().map(|d| (&d["event"], d["attempts"] == 0)).collect();
    let events: Vec<&str> = waiting.iter().map(|(event, _)| event.as_str().unwrap()).collect();
    assert_eq!(events, ["alarm.opened", "alarm.acknowledged", "alarm.ended"]);
    assert_eq!(waiting.iter().map(|(_, untried)| *untried).collect::<Vec<_>>(), [false, true, true]);
    assert!(receiver.taken().iter().all(|r| !of_first_alarm(r)));

    receiver.answer(Answer::Status(200));
    settled(&service, &hook, "delivered", 2 * alarms + 1).await;
    let taken = receiver.taken();
    let of_first: Vec<String> = taken.iter().filter(|r| of_first_alarm(r)).map(Received::kind).collect();
    assert_eq!(of_first, ["opened", "acknowledged", "ended"].map(|kind| format!("org.modalwatch.alarm.{kind}")));
    assert_eq!(taken.iter().map(Received::id).collect::<BTreeSet<_>>().len(), 2 * alarms + 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_receiver_that_refuses_everything_is_left_alone_for_a_pause_after_each_refusal() {
    let folder = tempfile::tempdir().unwrap();
    let service = start(folder.path(), &[]);
    let receiver = Receiver::start(Answer::Status(500)).await;
    let hook = webhook(&service, &receiver.url("/")).await;
    declare_undamaged(&service).await;
    let alarms = damage_everything(&service).await;
    let received = receiver.wait_for(2 * alarms).await;
    // Each message has its first attempt before any has a second one: none waits for the failure of another.
    assert_eq!(received[..alarms].iter().map(Received::id).collect::<BTreeSet<_>>().len(), alarms);
    // The delay is one second here, however many messages wait.
    let pauses = received.windows(2).map(|pair| pair[1].at - pair[0].at);
    let pauses: Vec<Duration> = pauses.collect();
    assert!(pauses.iter().all(|pause| *pause >= Duration::from_secs(1)), "{pauses:?}");

    receiver.answer(Answer::Status(200));
    settled(&service, &hook, "delivered", alarms).await;
    assert_eq!(receiver.taken().len(), alarms);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_receiver_that_never_answers_has_one_request_at_a_time() {
    let folder = tempfile::tempdir().unwrap();
    let service = start(folder.path(), &[]);
    let (never, fast) = (Receiver::start(Answer::Never).await, Receiver::start(Answer::Status(200)).await);
    let (never_hook, fast_hook) = (webhook(&service, &never.url("/")).await, webhook(&service, &fast.url("/")).await);
    declare_undamaged(&service).await;
    let alarms = damage_everything(&service).await;
    settled(&service, &fast_hook, "delivered", alarms).await;
    assert_eq!(never.all().len(), 1);
    assert_eq!(deliveries(&service, &never_hook, "pending").await.len(), alarms);
}
