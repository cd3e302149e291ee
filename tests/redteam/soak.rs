//! A load of new batches beside the attacks of slow readers, of definitions full of mistakes and of details, all at once.
//!
//! | variable | default | meaning |
//! |---|---|---|
//! | `MODALWATCH_SOAK_S` | 120 | length, seconds: a quarter without attacks, half with them, a quarter without |
//! | `MODALWATCH_SOAK_BATCHES_PER_S` | 8 | batches of 20 measurements due each second |
//! | `MODALWATCH_SOAK_ATTACKS` | readers,definitions,details | the attacks |

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use reqwest::{Client, Method};
use rustix::process::setpriority_process;
use serde_json::{json, Value};
use sqlx::Connection as _;
use sqlx_sqlite::{SqliteConnectOptions, SqliteConnection};
use tokio::runtime::Builder;
use tokio::sync::oneshot;
use tokio::task::JoinSet;

use crate::helpers::{measurements, time};
use crate::redteam::definitions::mistakes;
use crate::redteam::target::Target;
use crate::redteam::{details, slow_readers};

const PER_BATCH: usize = 20;

/// Springs of a definition full of mistakes.
const SPRINGS: usize = 20_000;

const PATIENCE: Duration = Duration::from_mins(1);

/// Largest ratio of the times within which 99 % of the batches are acknowledged, with the attacks and without.
const MOST_TIMES: f64 = 3.0;

fn setting(name: &str, default: f64) -> f64 {
    std::env::var(name).map_or(default, |text| text.parse().unwrap())
}

/// What a gateway has seen.
#[derive(Default)]
struct Seen {
    acknowledged: Vec<String>,
    /// From the moment at which a batch was due to its 201, s.
    took_s: Vec<f64>,
    /// Refusals that told to come again.
    refused: usize,
}

/// Posts a batch until it is acknowledged, as a gateway does.
async fn deliver(client: Client, url: String, token: String, body: Value, seen: Arc<Mutex<Seen>>) {
    let due = Instant::now();
    loop {
        let posted = client.post(&url).bearer_auth(&token).json(&body).send().await;
        let answer = posted.unwrap();
        let status = answer.status().as_u16();
        if status == 201 {
            let stored: Value = answer.json().await.unwrap();
            let mut seen = seen.lock().unwrap();
            seen.acknowledged.push(stored["batch"].as_str().unwrap().to_owned());
            seen.took_s.push(due.elapsed().as_secs_f64());
            return;
        }
        assert!(status == 503 && answer.headers().contains_key("retry-after"), "{status}");
        seen.lock().unwrap().refused += 1;
        tokio::time::sleep(Duration::from_millis(500)).await;
    }
}

/// A load for a time; `number` counts all batches.
async fn load(target: &Target, token: &str, during: Duration, number: &mut usize) -> Seen {
    let every = Duration::from_secs_f64(1.0 / setting("MODALWATCH_SOAK_BATCHES_PER_S", 8.0));
    let client: Client = modalwatch::notify::client_builder().timeout(PATIENCE).build().unwrap();
    let url = format!("http://{}/v1/structures/three-dof/batches", target.service.address());
    let (seen, mut posts, started) = (Arc::new(Mutex::new(Seen::default())), JoinSet::new(), Instant::now());
    let mut ticks = tokio::time::interval(every);
    while started.elapsed() < during {
        ticks.tick().await;
        let mut rows = measurements([4.0, 5.0, 6.0], PER_BATCH, 0);
        for (index, row) in rows.iter_mut().enumerate() {
            row["measured_at"] = json!(time(PER_BATCH * *number + index));
        }
        let body = json!({ "source": "gateway", "measurements": rows });
        *number += 1;
        posts.spawn(deliver(client.clone(), url.clone(), token.to_owned(), body, Arc::clone(&seen)));
    }
    while let Some(done) = posts.join_next().await {
        done.unwrap();
    }
    Arc::into_inner(seen).unwrap().into_inner().unwrap()
}

/// Names of the attacks.
const ATTACKS: [&str; 3] = ["readers", "definitions", "details"];

/// The attacks, on a thread of their own, until the answer is dropped. The attackers of a real service have processors of their own; here
/// they share two with it, so that their thread yields to everybody.
fn attacks(target: &Arc<Target>, reader: &str, batches: &[String]) -> oneshot::Sender<()> {
    let (target, reader, batches) = (Arc::clone(target), reader.to_owned(), batches.to_vec());
    let (sender, ended) = oneshot::channel();
    std::thread::spawn(move || {
        setpriority_process(None, 19).unwrap();
        let runtime = Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let all = begin(&target, &reader, &batches);
            let _ = ended.await;
            drop(all);
        });
    });
    sender
}

fn begin(target: &Arc<Target>, reader: &str, batches: &[String]) -> JoinSet<()> {
    let chosen = std::env::var("MODALWATCH_SOAK_ATTACKS").unwrap_or_else(|_| ATTACKS.join(","));
    let is_chosen = |name: &str| chosen.split(',').any(|own| own == name);
    let mut all = JoinSet::new();
    if is_chosen("details") {
        all = details::attack(target, reader, batches, 100);
    }
    if is_chosen("readers") {
        let own = Arc::clone(target);
        all.spawn(async move {
            loop {
                let sockets = slow_readers::attack(&own, 1_040).await;
                tokio::time::sleep(Duration::from_secs(15)).await;
                drop(sockets);
            }
        });
    }
    if is_chosen("definitions") {
        let own = Arc::clone(target);
        all.spawn(async move {
            let text = mistakes(SPRINGS);
            loop {
                let put = own.ask(Method::PUT, "/v1/structures/bad", Some(&own.admin), PATIENCE);
                if put.header("content-type", "application/toml").body(text.clone()).send().await.is_err() {
                    tokio::time::sleep(Duration::from_millis(100)).await;
                }
            }
        });
    }
    all
}

fn percentile(took_s: &mut [f64], percent: usize) -> f64 {
    took_s.sort_by(f64::total_cmp);
    took_s[(took_s.len() * percent / 100).min(took_s.len() - 1)]
}

/// `MODALWATCH_SOAK_S=1800 cargo test --release --test robustness redteam::soak -- --ignored --nocapture`
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "two minutes, or half an hour in its full length"]
async fn a_load_beside_all_attacks_loses_nothing_and_stays_quick() {
    slow_readers::allow_many_sockets();
    let mut target = Arc::new(Target::start(&[]));
    let (gateway, reader) = (target.token("ingest", &["three-dof"]).await, target.token("read", &[]).await);
    let large = details::batches(&target, 4, 2_000).await;
    let quarter = Duration::from_secs_f64(setting("MODALWATCH_SOAK_S", 120.0) / 4.0);
    let mut number = 0;
    let mut alone = load(&target, &gateway, quarter, &mut number).await;
    let running = attacks(&target, &reader, &large);
    let mut attacked = load(&target, &gateway, 2 * quarter, &mut number).await;
    drop(running);
    // What the attackers have left behind ends first.
    tokio::time::sleep(Duration::from_secs(5)).await;
    let after = load(&target, &gateway, quarter, &mut number).await;
    alone.took_s.extend(&after.took_s);
    let mut figures = Vec::new();
    for (name, seen) in [("alone", &mut alone), ("attacked", &mut attacked)] {
        let [median, high] = [50, 99].map(|percent| percentile(&mut seen.took_s, percent));
        let (count, most) = (seen.took_s.len(), seen.took_s.last().unwrap());
        println!(
            "{name}: {count} batches, acknowledged after {:.0} ms (median), {:.0} ms (99 %), {:.0} ms (slowest), {} refusals",
            1e3 * median,
            1e3 * high,
            1e3 * most,
            seen.refused
        );
        figures.push(high);
    }
    // Tasks of the attack that were given up may hold the target for a moment.
    while Arc::get_mut(&mut target).is_none() {
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    let target = Arc::into_inner(target).unwrap();
    let Target { mut service, folder, .. } = target;
    assert!(service.stop("TERM").success());
    let options = SqliteConnectOptions::new().filename(folder.path().join("modalwatch.sqlite")).read_only(true);
    let mut database = SqliteConnection::connect_with(&options).await.unwrap();
    let rows: Vec<(String, String)> =
        sqlx::query_as("select batch_id, state from measurement_batch").fetch_all(&mut database).await.unwrap();
    let stored: BTreeMap<String, String> = rows.into_iter().collect();
    let acknowledged: Vec<&String> =
        [&alone, &attacked, &after].into_iter().flat_map(|seen| &seen.acknowledged).collect();
    assert_eq!((acknowledged.len(), stored.len()), (number, number + large.len()), "each batch is stored once");
    assert!(acknowledged.iter().all(|id| stored.get(*id).is_some_and(|state| state == "assessed")));
    let ratio = figures[1] / figures[0];
    println!("{number} batches, each stored once and assessed; 99 % beside the attacks after {ratio:.1} times as long");
    assert!(ratio <= MOST_TIMES, "{ratio:.1} times");
}
