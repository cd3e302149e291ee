//! A token that may only read keeps the service computing.

use std::sync::Arc;
use std::time::{Duration, Instant};

use reqwest::Method;
use serde_json::json;
use tokio::task::JoinSet;

use crate::helpers::{measurements, within};
use crate::redteam::target::Target;

const PATIENCE: Duration = Duration::from_mins(1);

fn detail_of(batch: &str) -> String {
    format!("/v1/structures/three-dof/batches/{batch}/detail")
}

/// Asks for details of these batches, many at a time, until the set is dropped.
pub fn attack(target: &Arc<Target>, reader: &str, batches: &[String], at_a_time: usize) -> JoinSet<()> {
    let mut asking = JoinSet::new();
    for number in 0..at_a_time {
        let (target, reader) = (Arc::clone(target), reader.to_owned());
        let path = detail_of(&batches[number % batches.len()]);
        asking.spawn(async move {
            loop {
                let answered = target.get(&path, Some(&reader), PATIENCE).await;
                if !matches!(answered, Ok((200, _))) {
                    tokio::time::sleep(Duration::from_millis(100)).await;
                }
            }
        });
    }
    asking
}

/// Batches of different sizes about `size`, so that none is like another.
pub async fn batches(target: &Target, count: usize, size: usize) -> Vec<String> {
    let mut all = Vec::new();
    for number in 0..count {
        let days_s = 86_400 * 60 * number;
        all.push(target.batch(&target.admin, &measurements([4.0, 5.0, 6.0], size + number, days_s)).await);
    }
    all
}

/// Posts batches one after the other while the attack lasts; returns how long each took.
async fn post_meanwhile(target: &Target, during: Duration, first_s: usize) -> Vec<Duration> {
    let gateway = target.token("ingest", &["three-dof"]).await;
    let (started, mut took) = (Instant::now(), Vec::new());
    while started.elapsed() < during {
        let posted = Instant::now();
        let start_s = first_s + 12_000 * took.len();
        target.batch(&gateway, &measurements([4.0, 5.0, 6.0], 20, start_s)).await;
        took.push(posted.elapsed());
    }
    took.sort();
    took
}

/// The attack of 2026 in a smaller size: 100 details at a time, of batches of 800 instead of 5,000 measurements.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn details_leave_the_places_of_new_batches_alone() {
    let target = Arc::new(Target::start(&[]));
    let reader = target.token("read", &[]).await;
    let batches = batches(&target, 3, 800).await;
    let attack = attack(&target, &reader, &batches, 100);
    tokio::time::sleep(Duration::from_millis(500)).await;
    // Every post must be a 201: `batch` fails for a 503.
    let took = post_meanwhile(&target, Duration::from_secs(5), 10_000_000).await;
    println!(
        "{} batches were stored, the median after {:?}, the slowest {:?}",
        took.len(),
        took[took.len() / 2],
        took.last()
    );
    assert!(took.len() >= 5, "{} batches in 5 s", took.len());
    drop(attack);
    // What was computed for the attacker is kept for others.
    let (status, took) = target.get(&detail_of(&batches[0]), Some(&target.admin), PATIENCE).await.unwrap();
    assert_eq!(status, 200);
    println!("a detail that was asked for before took {took:?}");
}

/// `cargo test --release --test robustness details_of_the_largest -- --ignored --nocapture`: the attack in its full size.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "a minute and a half: batches of 5,000 measurements"]
async fn details_of_the_largest_batches_do_not_stop_new_ones() {
    let target = Arc::new(Target::start(&[]));
    let reader = target.token("read", &[]).await;
    let batches = {
        let mut all = Vec::new();
        for number in 0..4_usize {
            let rows: Vec<_> = measurements([4.0, 5.0, 6.0], 4_990 + number, 0)
                .into_iter()
                .enumerate()
                .map(|(index, mut row)| {
                    row["measured_at"] = json!(crate::helpers::time(number * 1_000_000 + index * 60));
                    row
                })
                .collect();
            all.push(target.batch(&target.admin, &rows).await);
        }
        all
    };
    let alone = post_meanwhile(&target, Duration::from_secs(10), 10_000_000).await;
    let attack = attack(&target, &reader, &batches, 100);
    tokio::time::sleep(Duration::from_secs(1)).await;
    let attacked = post_meanwhile(&target, Duration::from_secs(25), 14_000_000).await;
    for (name, took) in [("alone", &alone), ("beside 100 details", &attacked)] {
        let at = |share: usize| took[(took.len() * share / 100).min(took.len() - 1)];
        println!("{name}: {} batches, median {:?}, 99 % {:?}", took.len(), at(50), at(99));
    }
    assert!(attacked.len() >= 25, "{} batches in 25 s", attacked.len());
    drop(attack);
}

/// One client has 32 computations at a time, and those that nobody waits for any more are given up.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_has_its_share_and_who_leaves_gives_it_back() {
    let target = Arc::new(Target::start(&[]));
    let (reader, other) = (target.token("read", &[]).await, target.token("read", &[]).await);
    // A machine may compute one detail before 40 requests have arrived; what is kept then is not computed again.
    let mut refused = None;
    for path in batches(&target, 4, 2_500).await.iter().map(|batch| detail_of(batch)) {
        let mut asking = JoinSet::new();
        for _ in 0..40 {
            let request = target.ask(Method::GET, &path, Some(&reader), PATIENCE);
            asking.spawn(async move { request.send().await.unwrap() });
        }
        let first = asking.join_next().await.unwrap().unwrap();
        if first.status() == 503 {
            assert_eq!(first.headers()["retry-after"], "5");
            refused = Some((path, asking));
            break;
        }
        assert_eq!(first.status(), 200);
    }
    let (path, mut asking) = refused.expect("one of 40 requests at once is refused");
    // Another client waits its turn.
    let waits = target.get(&path, Some(&other), Duration::from_millis(300)).await;
    assert!(waits.is_err() || waits.is_ok_and(|(status, _)| status == 200));
    asking.abort_all();
    let (status, took) = within(Duration::from_secs(10), "the shares of those who left", async || {
        let answer = target.get(&path, Some(&reader), PATIENCE).await.unwrap();
        (answer.0 == 200).then_some(answer)
    })
    .await;
    println!("{status} after {took:?}");
}
