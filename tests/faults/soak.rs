//! Mixed load with repeated `kill -9`, and a client that records every 201.
//!
//! A fixed number of batches of 20 measurements is due each second, 20 readers send requests, one diagnosis runs, and its extension
//! replaces the trained model of a structure under load. No acknowledged batch may be lost or stored twice, no answer may be a 5xx
//! except 503 with `Retry-After`, and the memory must not grow.
//!
//! | variable | default | meaning |
//! |---|---|---|
//! | `MODALWATCH_SOAK_S` | 120 | length, seconds; 1800 for the run described in docs/accuracy.md |
//! | `MODALWATCH_SOAK_KILL_EVERY_S` | 60, or a fifth of a shorter run | mean time between kills |
//! | `MODALWATCH_SOAK_BATCHES_PER_S` | 50 | batches due each second |

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, RwLock};
use std::time::{Duration, Instant};

use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::Simulator;
use rand::Rng as _;
use rand_distr::StandardNormal;
use reqwest::{Client, Method, Response};
use serde_json::{json, Value};

use crate::faults::kit::{audit, batch, body, resident_mib, Acknowledged, BATCHES};
use crate::helpers::{command, Service};

const PER_BATCH: usize = 20;
const READERS: usize = 20;

/// Maximum number of posts in progress; a gateway with more batches waits.
const MOST_POSTS: usize = 48;

/// Maximum time after the last kill until all batches are assessed and the model is replaced.
const SETTLING: Duration = Duration::from_secs(150);

/// Maximum memory of the process, and its maximum growth from the middle of a process life to its end, MiB.
const MOST_MIB: f64 = 700.0;
const GROWTH_MIB: f64 = 150.0;

fn setting(name: &str, default: f64) -> f64 {
    std::env::var(name).map_or(default, |text| text.parse().unwrap_or_else(|_| panic!("{name}={text} is not a number")))
}

/// A service that is killed and started again while its clients use it.
#[derive(Clone)]
struct Target {
    url: Arc<RwLock<String>>,
    client: Client,
    /// Set when the load ends.
    over: Arc<AtomicBool>,
    /// Answers that are not allowed: status and text.
    forbidden: Arc<Mutex<Vec<String>>>,
    counts: Arc<Mutex<BTreeMap<u16, usize>>>,
}

impl Target {
    /// One request; `None` if the connection broke, as it does at a kill.
    async fn send(&self, method: Method, path: &str, body: Option<&Value>) -> Option<Response> {
        let url = format!("{}{path}", self.url.read().unwrap());
        let request = self.client.request(method.clone(), url);
        let request = body.into_iter().fold(request, reqwest::RequestBuilder::json);
        let response = request.send().await.ok()?;
        let status = response.status().as_u16();
        *self.counts.lock().unwrap().entry(status).or_default() += 1;
        // A 503 of `/readyz` is its regular answer while the service is not ready.
        let allowed =
            status < 500 || (status == 503 && (response.headers().contains_key("retry-after") || path == "/readyz"));
        if !allowed {
            let text = response.text().await.unwrap_or_default();
            self.forbidden.lock().unwrap().push(format!("{method} {path}: {status} {text}"));
            return None;
        }
        Some(response)
    }

    async fn read(&self, path: &str) -> Option<Value> {
        let response = self.send(Method::GET, path, None).await?;
        response.status().is_success().then_some(response)?.json().await.ok()
    }

    fn is_over(&self) -> bool {
        self.over.load(Ordering::Relaxed)
    }
}

/// Posts one batch until it is acknowledged, however often the service is killed.
async fn deliver(target: &Target, number: usize, acknowledged: &Mutex<Acknowledged>, replays: &AtomicUsize) {
    let given = batch("soak", number, PER_BATCH);
    let json = body(&given);
    loop {
        if let Some(response) = target.send(Method::POST, BATCHES, Some(&json)).await {
            match response.status().as_u16() {
                201 => {
                    // The status line is the acknowledgement, even if the body is incomplete: then the retry must find the batch.
                    if let Ok(answer) = response.json::<Value>().await {
                        acknowledged.lock().unwrap().add(&given, &answer);
                        if !number.is_multiple_of(20) {
                            return;
                        }
                        // A gateway that repeats its post gets the same batch again.
                        let Some(again) = target.send(Method::POST, BATCHES, Some(&json)).await else { continue };
                        if again.status() == 201 {
                            assert_eq!(again.headers()["idempotency-replayed"], "true");
                            if let Ok(again) = again.json::<Value>().await {
                                assert_eq!(again["batch"], answer["batch"]);
                                replays.fetch_add(1, Ordering::Relaxed);
                            }
                        }
                        return;
                    }
                }
                429 | 503 => tokio::time::sleep(Duration::from_secs(1)).await,
                status => panic!("{status}: {}", response.text().await.unwrap_or_default()),
            }
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

/// A reader that requests all routes in turn until the load ends.
async fn request_in_turn(target: Target, reader: usize) {
    let structure = "/v1/structures/three-dof";
    for round in reader.. {
        if target.is_over() {
            return;
        }
        let path = match round % 8 {
            0 => "/v1/structures".to_owned(),
            1 => format!("{structure}/history?limit=50"),
            2 => format!("{structure}/alarms"),
            3 => format!("{structure}/charts?limit=50"),
            4 => "/readyz".to_owned(),
            5 => "/metrics".to_owned(),
            6 => format!("{structure}/exceedances?limit=20"),
            _ => "/v1/structures/soft/history?limit=20".to_owned(),
        };
        target.send(Method::GET, &path, None).await;
        tokio::time::sleep(Duration::from_millis(300)).await;
    }
}

/// A chain whose second spring softens with the temperature, which its definition does not contain.
const SOFT: &str = r#"
id = "soft"
modes = 3
measurement_noise = { relative = 0.002 }
mass = [{ name = "m1", kg = 1.0 }, { name = "m2", kg = 0.8 }, { name = "m3", kg = 1.2 }]
spring = [
    { name = "k1", from = "ground", to = "m1", n_per_m = 1000.0 },
    { name = "k2", from = "m1", to = "m2", n_per_m = 1400.0 },
    { name = "k3", from = "m2", to = "m3", n_per_m = 900.0 },
    { name = "k4", from = "ground", to = "m3", n_per_m = 700.0 },
]
parameter = [
    { name = "k1", prior = { uniform = [500.0, 1500.0] }, sets = { spring = "k1" } },
    { name = "k2", prior = { uniform = [700.0, 2100.0] }, sets = { spring = "k2" } },
]
covariate = [{ name = "temperature_c" }]
"#;

/// Error message of a job that several kills in a row interrupted.
const STOPPED: &str = "ended unexpectedly several times in a row";

const SOFT_BATCHES: usize = 30;

/// A batch of the chain: one day with its temperature.
fn soft_batch(simulator: &Simulator, number: usize, rng: &mut impl rand::Rng) -> Value {
    let day = 12.0 * number as f64;
    let mut one = |i: usize| {
        let mut normal = || rng.sample::<f64, _>(StandardNormal);
        let temperature_c = 10.0 - 13.0 * (std::f64::consts::TAU * day / 365.0).cos() + 2.0 * normal();
        let k1 = 1000.0 * (1.0 + 0.006 * normal());
        let k2 = 1400.0 * (1.0 - 0.004 * (temperature_c - 10.0)) * (1.0 + 0.006 * normal());
        let exact = simulator.frequencies_hz(&[k1, k2]).unwrap();
        let noisy: Vec<f64> = exact.iter().map(|f| f * (1.0 + 0.002 * normal())).collect();
        let micros = 1_704_067_200_000_000 + (day * 86_400e6) as i64 + 600_000_000 * i as i64;
        let time = modalwatch::quantity::Timestamp::from_micros(micros).unwrap();
        json!({ "measured_at": time, "frequencies_hz": noisy, "covariates": { "temperature_c": temperature_c } })
    };
    json!({ "measurements": (0..15).map(&mut one).collect::<Vec<Value>>() })
}

/// Diagnoses the chain and extends it by the cause that was found; jobs that a kill interrupts are requested again. Returns the
/// digest of the structure before and after.
async fn swap_model(target: &Target) -> (String, String) {
    let pause = || tokio::time::sleep(Duration::from_millis(300));
    let definition = StructureDefinition::parse_toml(SOFT).unwrap();
    let simulator = Simulator::new(definition.clone()).unwrap();
    let put = serde_json::to_value(&definition).unwrap();
    while target.send(Method::PUT, "/v1/structures/soft", Some(&put)).await.is_none_or(|r| !r.status().is_success()) {
        pause().await;
    }
    let mut rng = modalwatch::stats::stream(7, "a softening chain");
    for number in 0..SOFT_BATCHES {
        let json = soft_batch(&simulator, number, &mut rng);
        while target
            .send(Method::POST, "/v1/structures/soft/batches", Some(&json))
            .await
            .is_none_or(|r| r.status() != 201)
        {
            pause().await;
        }
    }
    let structure = loop {
        match target.read("/v1/structures/soft").await {
            Some(structure) => break structure,
            None => pause().await,
        }
    };
    let before = structure["digest"].as_str().unwrap().to_owned();
    loop {
        pause().await;
        // The kill may have come directly after the switch.
        let Some(structure) = target.read("/v1/structures/soft").await else { continue };
        let present = structure["digest"].as_str().unwrap();
        if present != before {
            return (before, present.to_owned());
        }
        let asked = target.send(Method::POST, "/v1/structures/soft/diagnoses", Some(&json!({}))).await;
        let Some(response) = asked.filter(|response| response.status() == 202) else { continue };
        let Ok(asked) = response.json::<Value>().await else { continue };
        let path = format!("/v1/diagnoses/{}", asked["diagnosis"].as_str().unwrap());
        let diagnosis = ended(target, &path, "/state").await;
        if diagnosis["state"] != "done" {
            assert!(diagnosis["failure"].as_str().unwrap_or_default().contains(STOPPED), "{diagnosis}");
            continue;
        }
        assert_eq!(diagnosis["result"]["causes"][0]["covariate"], "temperature_c", "{diagnosis}");
        let training = json!({ "samples": 1_000, "epochs": 1, "accept_uncalibrated": true });
        if target.send(Method::POST, &format!("{path}/extension"), Some(&training)).await.is_none() {
            continue;
        }
        let extended = ended(target, &path, "/extension/state").await;
        let why = extended["extension"]["failure"].as_str().unwrap_or(STOPPED);
        assert!(extended["extension"]["state"] == "done" || why.contains(STOPPED), "{extended}");
    }
}

/// Waits until a state is neither "running" nor "waiting", as a job is that begins again.
async fn ended(target: &Target, path: &str, pointer: &str) -> Value {
    loop {
        tokio::time::sleep(Duration::from_millis(300)).await;
        let Some(answer) = target.read(path).await else { continue };
        if !matches!(answer.pointer(pointer).and_then(Value::as_str), Some("running" | "waiting")) {
            return answer;
        }
    }
}

/// Memory of the service in the middle of each process life and at its end, MiB.
#[derive(Default)]
struct Lives {
    memory_mib: Vec<(f64, f64)>,
}

impl Lives {
    fn check(&self) {
        for (middle, end) in &self.memory_mib {
            let flat = *end < MOST_MIB && *end < middle + GROWTH_MIB;
            assert!(flat, "the memory grows: {middle:.0} MiB in the middle of a process life, {end:.0} MiB at its end");
        }
        let most = self.memory_mib.iter().map(|(_, end)| *end).fold(0.0, f64::max);
        println!("{} lives, at most {most:.0} MiB", self.memory_mib.len());
    }
}

fn start(data: &Path) -> Service {
    let mut command = command(data);
    Service::spawn(command.env("MODALWATCH__LOG__LEVEL", "error"))
}

/// Kills and restarts the service until the time is over; the last process keeps running.
async fn live_and_die(target: &Target, data: PathBuf, length: Duration, kill_every: f64) -> (Service, Lives) {
    let mut stream = modalwatch::stats::stream(20_261_121, "times of death under load");
    let mut lives = Lives::default();
    let ends = Instant::now() + length;
    loop {
        let data = data.clone();
        let mut service = tokio::task::spawn_blocking(move || start(&data)).await.unwrap();
        *target.url.write().unwrap() = format!("http://{}", service.address());
        let life = Duration::from_secs_f64(kill_every * stream.random_range(0.5..1.5));
        let last = Instant::now() + life >= ends;
        let life = life.min(ends.saturating_duration_since(Instant::now()));
        tokio::time::sleep(life / 2).await;
        let middle = resident_mib(service.pid());
        tokio::time::sleep(life / 2).await;
        lives.memory_mib.push((middle, resident_mib(service.pid())));
        if last {
            return (service, lives);
        }
        service.kill();
    }
}

/// Number of batches of both structures that wait for their assessment.
async fn unassessed(data: &Path) -> i64 {
    use sqlx::Connection as _;
    let options = sqlx_sqlite::SqliteConnectOptions::new().filename(data.join("modalwatch.sqlite")).read_only(true);
    let mut connection = sqlx_sqlite::SqliteConnection::connect_with(&options).await.unwrap();
    let count = "select count(*) from measurement_batch where state <> 'assessed'";
    let (count,): (i64,) = sqlx::query_as(count).fetch_one(&mut connection).await.unwrap();
    count
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn under_load_and_kills_nothing_acknowledged_is_lost_or_doubled() {
    let length_s = setting("MODALWATCH_SOAK_S", 120.0);
    let kill_every_s = setting("MODALWATCH_SOAK_KILL_EVERY_S", (length_s / 5.0).min(60.0));
    let batches_per_s = setting("MODALWATCH_SOAK_BATCHES_PER_S", 50.0);
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("data");
    let target = Target {
        url: Arc::new(RwLock::new("http://127.0.0.1:1".to_owned())),
        client: modalwatch::notify::client_builder().timeout(Duration::from_secs(20)).build().unwrap(),
        over: Arc::default(),
        forbidden: Arc::default(),
        counts: Arc::default(),
    };
    let (acknowledged, replays) = (Arc::new(Mutex::new(Acknowledged::default())), Arc::new(AtomicUsize::new(0)));

    let readers: Vec<_> = (0..READERS).map(|reader| tokio::spawn(request_in_turn(target.clone(), reader))).collect();
    let swap = tokio::spawn({
        let target = target.clone();
        async move { swap_model(&target).await }
    });
    let due = tokio::spawn({
        let (target, acknowledged, replays) = (target.clone(), Arc::clone(&acknowledged), Arc::clone(&replays));
        async move {
            let places = Arc::new(tokio::sync::Semaphore::new(MOST_POSTS));
            let mut ticks = tokio::time::interval(Duration::from_secs_f64(1.0 / batches_per_s));
            let mut posts = tokio::task::JoinSet::new();
            for number in 0.. {
                ticks.tick().await;
                let place = Arc::clone(&places).acquire_owned().await.unwrap();
                if target.is_over() {
                    break;
                }
                let (target, acknowledged, replays) = (target.clone(), Arc::clone(&acknowledged), Arc::clone(&replays));
                posts.spawn(async move {
                    deliver(&target, number, &acknowledged, &replays).await;
                    drop(place);
                });
                while let Some(done) = posts.try_join_next() {
                    done.unwrap();
                }
            }
            // Posts in progress are completed.
            while let Some(done) = posts.join_next().await {
                done.unwrap();
            }
        }
    });
    let (mut service, lives) =
        live_and_die(&target, data.clone(), Duration::from_secs_f64(length_s), kill_every_s).await;
    target.over.store(true, Ordering::Relaxed);
    let settled = tokio::time::timeout(SETTLING, async {
        due.await.unwrap();
        for reader in readers {
            reader.await.unwrap();
        }
        let (before, after) = swap.await.unwrap();
        assert_ne!(before, after);
        let now = target.read("/v1/structures/soft").await.unwrap();
        assert_eq!(now["digest"], after.as_str(), "{now}");
        while unassessed(&data).await > 0 {
            tokio::time::sleep(Duration::from_millis(200)).await;
        }
    });
    settled.await.expect("everything is assessed and the model is replaced soon after the load");

    assert!(service.stop("TERM").success());
    let acknowledged = std::mem::take(&mut *acknowledged.lock().unwrap());
    let audit = audit(&data, &acknowledged).await;
    let (counts, forbidden) = (target.counts.lock().unwrap().clone(), target.forbidden.lock().unwrap().clone());
    println!(
        "{length_s} s: {} batches acknowledged, {} stored, {} posted again and replayed; answers by status: {counts:?}",
        acknowledged.0.len(),
        audit.stored,
        replays.load(Ordering::Relaxed)
    );
    lives.check();
    assert!(
        forbidden.is_empty(),
        "{} answers that may not be: {:#?}",
        forbidden.len(),
        &forbidden[..forbidden.len().min(10)]
    );
    assert_eq!(audit.stored, acknowledged.0.len(), "each batch was posted until it was acknowledged");
    assert_eq!(audit.unassessed, 0);
    let kills = lives.memory_mib.len() - 1;
    assert!(kills >= 2 && audit.stored as f64 > 2.0 * length_s, "{kills} kills, {} batches: too little", audit.stored);
}
