//! Three nodes under load with a fault each few seconds: kills, a database that stops and crashes, nodes that hang, tokens that are revoked,
//! models that are swapped, structures that are defined and extended.
//!
//! Clients send to all nodes and repeat what was not answered. At the end everything that was acknowledged has to be there once, assessed, with
//! the results of a service that had the same input in a SQLite file and no fault.
//!
//! `MODALWATCH_CLUSTER_S` sets the seconds of load: 20 by default, with a fault every 2 s; from 120 on every 10 s, with nodes that hang for 20 s
//! and an extension of a structure.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::Simulator;
use rand_distr::StandardNormal;
use reqwest::Method;
use serde_json::{json, Value};
use tempfile::TempDir;
use tokio::task::JoinSet;

use crate::helpers::{command, measurements, repository, time, within, Service, PATIENCE};
use crate::postgres::cluster::{Clients, Cluster, SETTINGS};
use crate::postgres::receiver::{Answer, Receiver};
use crate::postgres::server::Server;
use crate::postgres::world::done;

const CHAIN: &str = "/v1/structures/three-dof";
const FRAME: &str = "/v1/structures/ruler-frame-4dof";

/// Seconds after the load in which everything has to be assessed.
const SETTLING: Duration = Duration::from_mins(2);

/// How long a diagnosis and a training may take that begin again after the last fault: on a busy machine none is done between two faults.
const EXTENDING: Duration = Duration::from_mins(8);

/// How long the load lasts, how often a fault comes, and how long a node hangs.
#[derive(Clone, Copy)]
struct Pace {
    load: Duration,
    between_faults: Duration,
    hang: Duration,
    with_extension: bool,
}

impl Pace {
    fn of_environment() -> Self {
        let text = std::env::var("MODALWATCH_CLUSTER_S").ok();
        let seconds: u64 = text.map_or(20, |text| text.parse().unwrap_or_else(|_| panic!("{text} are no seconds")));
        let is_long = seconds >= 120;
        Self {
            load: Duration::from_secs(seconds),
            between_faults: Duration::from_secs(if is_long { 10 } else { 2 }),
            hang: Duration::from_secs(if is_long { 20 } else { 4 }),
            with_extension: is_long,
        }
    }
}

/// Batches of the chain, one each half an hour: forty of a healthy structure, then twenty with a loss of a tenth of k2, and so on.
fn of_chain(number: usize) -> Value {
    let k2 = if number % 60 < 40 { 5.0 } else { 4.5 };
    json!({ "measurements": measurements([4.0, k2, 6.0], 3, 10 * 86_400 + number * 1_800), "source": "gateway" })
}

/// The two batches of the undamaged reference of the chain.
fn references() -> [Value; 2] {
    [0, 1].map(|day| json!({ "measurements": measurements([4.0, 5.0, 6.0], 20, day * 86_400) }))
}

/// A batch of the frame, one each ten minutes.
fn of_frame(simulator: &Simulator, number: usize) -> Value {
    let one = |i: usize| {
        let phase = 3.883 * (3 * number + i) as f64;
        let wave = |storey: usize| 9_106.0 * (1.0 + 0.02 * (phase + 2.0 * storey as f64).sin());
        let frequencies_hz = simulator.frequencies_hz(&[0, 1, 2, 3].map(wave)).unwrap();
        json!({ "measured_at": time(number * 600 + 60 * i), "frequencies_hz": frequencies_hz })
    };
    json!({ "measurements": (0..3).map(one).collect::<Vec<Value>>() })
}

fn frame() -> Simulator {
    let text = std::fs::read_to_string(repository("models/ruler-frame-4dof/structure.toml")).unwrap();
    Simulator::new(StructureDefinition::parse_toml(&text).unwrap()).unwrap()
}

/// A folder with the model of the frame.
fn models() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("ruler-frame-4dof")).unwrap();
    for name in ["structure.toml", "baseline.json", "baseline.safetensors"] {
        let from = repository("models/ruler-frame-4dof").join(name);
        std::fs::copy(from, folder.path().join("ruler-frame-4dof").join(name)).unwrap();
    }
    folder
}

/// Puts one of two models of the frame in the place of the other: the same weights with another manifest, and so another digest, from which the
/// random numbers of its assessments follow.
fn put_model(models: &Path, second: bool) {
    let shipped = std::fs::read(repository("models/ruler-frame-4dof/baseline.json")).unwrap();
    let mut manifest: Value = serde_json::from_slice(&shipped).unwrap();
    if second {
        manifest["program_version"] = json!("0.0.1-other");
    }
    // At once: a node that takes over at this moment reads the one or the other.
    let (draft, place) = (models.join("draft"), models.join("ruler-frame-4dof/baseline.json"));
    std::fs::write(&draft, if second { serde_json::to_vec(&manifest).unwrap() } else { shipped }).unwrap();
    std::fs::rename(draft, place).unwrap();
}

/// Acknowledged batches of a structure: number and id.
type Acknowledged = Arc<Mutex<BTreeMap<usize, String>>>;

/// Posts the batches of the chain in their order, each to another node first.
async fn watch_chain(clients: Clients, acknowledged: Acknowledged) {
    for number in 0.. {
        if clients.is_over() {
            return;
        }
        let id = clients.deliver(number % 3, CHAIN, &of_chain(number)).await;
        acknowledged.lock().unwrap().insert(number, id);
        tokio::time::sleep(Duration::from_millis(40)).await;
    }
}

/// Posts every second batch of the frame, to one node first, each twice.
async fn watch_frame(clients: Clients, which: usize, acknowledged: Acknowledged) {
    let simulator = frame();
    for number in (which..).step_by(2) {
        if clients.is_over() {
            return;
        }
        let body = of_frame(&simulator, number);
        let id = clients.deliver(which + 1, FRAME, &body).await;
        assert_eq!(clients.deliver(which + 2, FRAME, &body).await, id, "the same batch was stored twice");
        acknowledged.lock().unwrap().insert(number, id);
        tokio::time::sleep(Duration::from_millis(60)).await;
    }
}

/// A token is made through one node and revoked through another: within a second no node accepts it.
async fn revoke_a_token(clients: &Clients, number: usize) {
    let new = json!({ "name": format!("reader-{number}"), "scopes": ["read"] });
    let (status, made) = clients.insist(number, Method::POST, "/v1/tokens", Some(&new)).await;
    assert_eq!(status, 201, "{made}");
    let token = made["token"].as_str().unwrap().to_owned();
    let reader = Clients { admin: token.clone(), ..clients.clone() };
    assert_eq!(reader.insist(number, Method::GET, CHAIN, None).await.0, 200);
    let path = format!("/v1/tokens/{}", token.split('_').nth(1).unwrap());
    let (status, answer) = clients.insist(number + 1, Method::DELETE, &path, None).await;
    assert!([200, 204].contains(&status), "{answer}");
    let revoked = Instant::now();
    let mut refused = 0;
    while refused < 3 {
        // A node that hangs, or has nobody to pass the request on to, accepts nothing either.
        refused = 0;
        for node in 0..3 {
            let asked = Instant::now();
            match reader.ask(node, Method::GET, CHAIN, None).await {
                Some((401, _)) | None => refused += 1,
                Some((status, answer)) => {
                    assert!(asked.duration_since(revoked) < Duration::from_secs(1), "node {node}: {status} {answer}");
                }
            }
        }
    }
}

/// A new structure is defined through one node and redefined through another: within a second no node answers with what was before.
async fn define_a_structure(clients: &Clients, number: usize) {
    let mut definition = serde_json::to_value(StructureDefinition::parse_toml(SOFT).unwrap()).unwrap();
    let id = format!("rig-{number}");
    definition["id"] = json!(id);
    let path = format!("/v1/structures/{id}");
    let mut digests = BTreeSet::new();
    for (step, kg) in [1.0, 1.1].into_iter().enumerate() {
        definition["mass"][0]["kg"] = json!(kg);
        let (status, answer) = clients.insist(number + step, Method::PUT, &path, Some(&definition)).await;
        assert!([200, 201].contains(&status), "{status} {answer}");
        let digest = answer["digest"].as_str().unwrap_or_else(|| panic!("{answer}")).to_owned();
        let defined = Instant::now();
        let mut knowing = 0;
        while knowing < 3 {
            knowing = 0;
            for node in 0..3 {
                let asked = Instant::now();
                match clients.ask(node, Method::GET, &path, None).await {
                    None => knowing += 1,
                    Some((200, found)) if found["digest"] == digest.as_str() => knowing += 1,
                    Some((status, found)) => {
                        // A node that has just lost the lock may answer from its memory for a moment.
                        assert!(asked - defined < Duration::from_secs(1), "node {node}: {status} {found}");
                    }
                }
            }
        }
        digests.insert(digest);
    }
    assert_eq!(digests.len(), 2);
}

/// Another model of the frame is put into the folder and taken into use.
async fn swap_the_model(clients: &Clients, models: &Path, second: bool, number: usize) {
    put_model(models, second);
    let path = format!("{FRAME}/model/reload");
    let (status, swapped) = clients.insist(number, Method::POST, &path, Some(&json!({}))).await;
    assert_eq!(status, 200, "{swapped}");
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

/// A batch of the softening chain: one day with its temperature.
fn of_soft(simulator: &Simulator, number: usize, rng: &mut impl rand::Rng) -> Value {
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

/// The softening chain is diagnosed and extended by the cause that was found, and not stepped back from; jobs that faults ended are requested
/// again.
async fn extend(clients: Clients) {
    let definition = StructureDefinition::parse_toml(SOFT).unwrap();
    let simulator = Simulator::new(definition.clone()).unwrap();
    let put = serde_json::to_value(&definition).unwrap();
    let (soft, pause) = ("/v1/structures/soft", Duration::from_millis(300));
    assert_eq!(clients.insist(0, Method::PUT, soft, Some(&put)).await.0, 201);
    let mut rng = modalwatch::stats::stream(7, "a softening chain");
    for number in 0..30 {
        clients.deliver(number, soft, &of_soft(&simulator, number, &mut rng)).await;
    }
    let before = clients.read(soft).await["digest"].clone();
    while clients.read(soft).await["digest"] == before {
        tokio::time::sleep(pause).await;
        let (status, asked) = clients.insist(1, Method::POST, &format!("{soft}/diagnoses"), Some(&json!({}))).await;
        if status != 202 {
            continue;
        }
        let path = format!("/v1/diagnoses/{}", asked["diagnosis"].as_str().unwrap());
        if ended(&clients, &path, "/state").await["state"] != "done" {
            continue;
        }
        let training = json!({ "samples": 1_000, "epochs": 1, "accept_uncalibrated": true });
        clients.insist(2, Method::POST, &format!("{path}/extension"), Some(&training)).await;
        ended(&clients, &path, "/extension/state").await;
    }
    // The version before has never had a trained model, so that it cannot be put into use again; all nodes say so.
    let extended = clients.read(soft).await["digest"].clone();
    for node in 0..3 {
        let (status, said) = clients.insist(node, Method::DELETE, &format!("{soft}/extension"), None).await;
        assert_eq!((status, &said["code"]), (409, &json!("no_model")), "{said}");
        assert!(said["detail"].as_str().unwrap().contains(before.as_str().unwrap()), "{said}");
    }
    assert_eq!(clients.read(soft).await["digest"], extended);
}

/// Waits until a state is neither "running" nor "waiting", as a job is that begins again.
async fn ended(clients: &Clients, path: &str, pointer: &str) -> Value {
    loop {
        tokio::time::sleep(Duration::from_millis(300)).await;
        let answer = clients.read(path).await;
        if !matches!(answer.pointer(pointer).and_then(Value::as_str), Some("running" | "waiting")) {
            return answer;
        }
    }
}

/// Waits until all tasks have ended, while what was killed is started again.
async fn end(cluster: &mut Cluster, mut tasks: JoinSet<()>, limit: Duration, what: &str) {
    within(limit, what, async || {
        cluster.supervise();
        while let Some(joined) = tasks.try_join_next() {
            joined.unwrap();
        }
        tasks.is_empty().then_some(())
    })
    .await;
}

/// The faults, one after the other, until the time is over; returns how often each came.
async fn break_things(
    cluster: &mut Cluster,
    server: &Server,
    clients: &Clients,
    pace: Pace,
) -> BTreeMap<&'static str, usize> {
    let begun = Instant::now();
    let mut counts = BTreeMap::new();
    let mut faults = JoinSet::new();
    let mut number = 0;
    while begun.elapsed() < pace.load {
        let next = pace.between_faults * (number as u32 + 1);
        while begun.elapsed() < next {
            cluster.supervise();
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        let (asking, models) = (clients.clone(), cluster.models.path().to_owned());
        let name = match number % 9 {
            0 => {
                let serving = cluster.some("serving").await;
                cluster.kill(serving);
                "serving node killed"
            }
            1 => {
                faults.spawn(async move { revoke_a_token(&asking, number).await });
                "token revoked"
            }
            2 => {
                tokio::task::block_in_place(|| {
                    server.stop();
                    server.start_again();
                });
                "database stopped and started"
            }
            3 => {
                faults.spawn(async move { swap_the_model(&asking, &models, number / 9 % 2 == 0, number).await });
                "model swapped"
            }
            4 => {
                let serving = cluster.some("serving").await;
                cluster.hang(serving, pace.hang);
                "serving node hung"
            }
            5 => {
                faults.spawn(async move { define_a_structure(&asking, number).await });
                "structure defined and redefined"
            }
            6 => {
                tokio::task::block_in_place(|| {
                    server.kill();
                    server.start_again();
                });
                "database crashed"
            }
            7 => {
                let standby = cluster.some("standby").await;
                cluster.kill(standby);
                "standby killed"
            }
            _ => {
                let standby = cluster.some("standby").await;
                cluster.hang(standby, pace.hang);
                "standby hung"
            }
        };
        *counts.entry(name).or_default() += 1;
        number += 1;
    }
    while let Some(ended) = faults.join_next().await {
        ended.unwrap();
        cluster.supervise();
    }
    counts
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn under_load_and_faults_every_acknowledged_batch_is_there_once_and_as_in_a_file() {
    if !Server::is_installed() {
        return;
    }
    let pace = Pace::of_environment();
    let server = Server::start(&[]);
    let folder = tempfile::tempdir().unwrap();
    let admin_file = folder.path().join("admin-token");
    done(&["token", "file", admin_file.to_str().unwrap()]);
    let admin = std::fs::read_to_string(&admin_file).unwrap().trim().to_owned();
    let mut cluster = Cluster::start(&server, models(), admin_file.to_str().unwrap().to_owned());
    let clients = Clients::new(cluster.ports, admin.clone());

    // An undamaged reference, and a receiver of alarms.
    let receiver = Receiver::start(Answer::Status(200)).await;
    let (status, hook) =
        clients.insist(0, Method::POST, "/v1/webhooks", Some(&json!({ "url": receiver.url("/alarms") }))).await;
    assert_eq!(status, 201, "{hook}");
    let mut healthy = Vec::new();
    for body in references() {
        healthy.push(clients.deliver(1, CHAIN, &body).await);
    }
    let reference = json!({ "batches": healthy });
    assert_eq!(clients.insist(2, Method::POST, &format!("{CHAIN}/reference"), Some(&reference)).await.0, 201);

    let (chain, frames) = (Acknowledged::default(), Acknowledged::default());
    let mut load = JoinSet::new();
    load.spawn(watch_chain(clients.clone(), Arc::clone(&chain)));
    for which in 0..2 {
        load.spawn(watch_frame(clients.clone(), which, Arc::clone(&frames)));
    }
    let mut extension = JoinSet::new();
    if pace.with_extension {
        extension.spawn(extend(clients.clone()));
    }
    let counts = break_things(&mut cluster, &server, &clients, pace).await;
    clients.over.store(true, Ordering::Relaxed);
    let ended = Instant::now();
    end(&mut cluster, load, SETTLING, "the clients that post end").await;
    let name = cluster.database.rsplit_once('/').unwrap().1.to_owned();
    let count = |condition: &str| -> usize {
        let select = format!("select count(*) from modalwatch.measurement_batch where {condition}");
        server.sql(&name, &select).parse().unwrap()
    };
    let of_known = "structure_id in ('three-dof', 'ruler-frame-4dof')";
    let waiting = format!("{of_known} and state <> 'assessed'");
    within(SETTLING.saturating_sub(ended.elapsed()), "all are assessed", async || {
        cluster.supervise();
        (count(&waiting) == 0).then_some(())
    })
    .await;
    let settled = ended.elapsed();
    end(&mut cluster, extension, EXTENDING, "the extension ends").await;

    let odd = clients.odd.lock().unwrap().clone();
    assert!(odd.is_empty(), "answers that no client expects: {:#?}", &odd[..odd.len().min(10)]);
    let (chain, frames) = (chain.lock().unwrap().clone(), frames.lock().unwrap().clone());
    assert_eq!(count(of_known), chain.len() + frames.len() + 2, "a batch is missing or there twice");
    let expected = Expected::of_file(&cluster, &admin, chain.len(), frames.keys().max().unwrap() + 1).await;
    let compared = ended.elapsed();
    for (number, id) in &chain {
        assert_eq!(numbers(&clients.read(&format!("{CHAIN}/batches/{id}")).await), expected.chain[*number], "{number}");
    }
    let mut by_model = BTreeMap::new();
    for (number, id) in &frames {
        let found = clients.read(&format!("{FRAME}/batches/{id}")).await;
        let model = found["assessment"]["model_digest"].as_str().unwrap().to_owned();
        assert_eq!(&numbers(&found), &expected.frames[&model][*number], "{number} of the frame");
        *by_model.entry(model).or_insert(0) += 1;
    }
    assert_eq!(by_model.len(), 2, "both models were in use: {by_model:?}");
    let found = episodes(&clients.read(&format!("{CHAIN}/alarms?limit=1000")).await);
    assert_eq!(found, expected.episodes);
    assert!(found.iter().any(|episode| episode["parameter"] == "k2"), "the hidden loss was not found: {found:?}");
    let messages = messages_are_complete(&clients, &hook, &receiver).await;
    println!(
        "{} s of load: {} batches of the chain, {} of the frame by {} models, {} episodes, {messages} messages; faults: {counts:?}; \
         {} refusals with Retry-After; all was assessed {:.1} s after the load, the file was filled after {:.1} s; answers: {:?}",
        pace.load.as_secs(),
        chain.len(),
        frames.len(),
        by_model.len(),
        found.len(),
        clients.refusals.load(Ordering::Relaxed),
        settled.as_secs_f64(),
        compared.as_secs_f64(),
        clients.statuses.lock().unwrap()
    );
}

/// Every message about an alarm was accepted by the receiver, under one id; returns their number.
async fn messages_are_complete(clients: &Clients, hook: &Value, receiver: &Receiver) -> usize {
    let path = format!("/v1/webhooks/{}/deliveries?limit=1000", hook["webhook"].as_str().unwrap());
    let items = within(PATIENCE, "all messages are delivered", async || {
        let page = clients.read(&path).await;
        let items = page["items"].as_array().unwrap().clone();
        items.iter().all(|item| item["state"] == "delivered").then_some(items)
    })
    .await;
    let sent: BTreeSet<String> = items.iter().map(|item| item["message"].as_str().unwrap().to_owned()).collect();
    assert_eq!(sent.len(), items.len(), "a message has two deliveries");
    let received = receiver.taken();
    let ids: BTreeSet<String> = received.iter().map(|message| message.id().to_owned()).collect();
    assert_eq!(ids, sent, "a message was lost, or came from nowhere");
    // The same event has one id, however often it was sent.
    let mut events: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for message in &received {
        let event = message.json();
        let about = format!("{} {}", event["type"], event["subject"]);
        events.entry(about).or_default().insert(message.id().to_owned());
    }
    let twice: Vec<_> = events.iter().filter(|(_, ids)| ids.len() > 1).collect();
    assert!(twice.is_empty(), "events with several ids: {twice:?}");
    let opened = received.iter().filter(|message| message.kind().ends_with("alarm.opened"));
    assert!(opened.count() > 0, "no alarm was sent");
    ids.len()
}

/// The results of a service with a file, without faults.
struct Expected {
    chain: Vec<Value>,
    /// By the digest of the model.
    frames: BTreeMap<String, Vec<Value>>,
    episodes: Vec<Value>,
}

impl Expected {
    async fn of_file(cluster: &Cluster, admin: &str, chain: usize, frames: usize) -> Self {
        let mut found = Self { chain: Vec::new(), frames: BTreeMap::new(), episodes: Vec::new() };
        let simulator = frame();
        for second in [false, true] {
            let (folder, models) = (tempfile::tempdir().unwrap(), models());
            put_model(models.path(), second);
            let mut command = command(folder.path());
            command.arg("--models").arg(models.path());
            command.env("MODALWATCH__ACCESS__ADMIN_TOKEN_FILE", &cluster.admin_file);
            command.envs(SETTINGS.map(|(name, value)| (format!("MODALWATCH__{name}"), value)));
            let service = Service::spawn(&mut command);
            let post = async |path: &str, body: &Value| -> Value {
                let response = service.request(Method::POST, path).bearer_auth(admin).json(body).send().await.unwrap();
                assert_eq!(response.status(), 201);
                response.json().await.unwrap()
            };
            let read = async |path: &str| -> Value {
                service.get(path).bearer_auth(admin).send().await.unwrap().json().await.unwrap()
            };
            let mut ids = Vec::new();
            for number in 0..frames {
                ids.push(post(&format!("{FRAME}/batches"), &of_frame(&simulator, number)).await["batch"].clone());
            }
            for id in ids {
                let answer = read(&format!("{FRAME}/batches/{}", id.as_str().unwrap())).await;
                let model = answer["assessment"]["model_digest"].as_str().unwrap().to_owned();
                found.frames.entry(model).or_default().push(numbers(&answer));
            }
            if second {
                continue;
            }
            let mut healthy = Vec::new();
            for body in references() {
                healthy.push(post(&format!("{CHAIN}/batches"), &body).await["batch"].clone());
            }
            post(&format!("{CHAIN}/reference"), &json!({ "batches": healthy })).await;
            let mut ids = Vec::new();
            for number in 0..chain {
                ids.push(post(&format!("{CHAIN}/batches"), &of_chain(number)).await["batch"].clone());
            }
            for id in ids {
                found.chain.push(numbers(&read(&format!("{CHAIN}/batches/{}", id.as_str().unwrap())).await));
            }
            found.episodes = episodes(&read(&format!("{CHAIN}/alarms?limit=1000")).await);
        }
        found
    }
}

/// What of a batch follows from its content, its model and its reference.
fn numbers(batch: &Value) -> Value {
    let assessment = &batch["assessment"];
    let mut charts = batch["charts"].clone();
    // The ids of the batches differ.
    for point in charts.as_array_mut().into_iter().flatten() {
        point.as_object_mut().unwrap().remove("batch");
    }
    json!({
        "measurements": batch["measurements"], "state": batch["state"], "charts": charts,
        "parameters": assessment["parameters"], "trust": assessment["trust"], "findings": assessment["findings"],
        "fit": assessment["fit_p_value"], "model": assessment["model_digest"], "reference": assessment["undamaged_version"],
    })
}

/// What of alarms follows from the measurements, in the order of their beginning.
fn episodes(page: &Value) -> Vec<Value> {
    let mut all: Vec<Value> = page["items"]
        .as_array()
        .unwrap()
        .iter()
        .map(|alarm| {
            let of = |name: &str| alarm[name].clone();
            json!({
                "opened_at": of("opened_at"), "ended_at": of("ended_at"), "kind": of("kind"), "parameter": of("parameter"),
                "state": of("state"), "peak": of("peak_shift_standard_errors"), "reference": of("undamaged_version"),
            })
        })
        .collect();
    all.sort_by_key(Value::to_string);
    all
}
