//! Trainings, diagnoses and extensions by workers: the same results as without them, and one that dies is replaced.

use std::path::Path;
use std::time::Duration;

use reqwest::Method;
use serde_json::{json, Value};

use crate::helpers::{created, problem, time, two_masses_hz, two_masses_with_temperature, within, Service};
use crate::postgres::server::Server;
use crate::postgres::workers::delivered;
use crate::postgres::world::{database_with_tables, serve};

/// Relative change of k2 per °C, which the structure file does not say.
const SOFTENING: f64 = -0.004;

const LONG: Duration = Duration::from_mins(5);

/// Seconds after which a worker that is not heard of loses its job.
const LEASE_S: &str = "2";

/// A process on a database.
fn process(folder: &Path, url: &str, roles: &str) -> Service {
    let mut command = serve(folder, url);
    command.args(["--roles", roles]).env("MODALWATCH__STORE__TAKEOVER_S", LEASE_S);
    Service::spawn(&mut command)
}

async fn put(service: &Service, structure: &str) {
    let path = format!("/v1/structures/{structure}");
    let put = service.request(Method::PUT, &path).header("content-type", "application/toml");
    let body = two_masses_with_temperature().replace("\"tiny\"", &format!("{structure:?}"));
    let put = put.body(body).send().await.unwrap();
    assert_eq!(put.status(), 201, "{}", put.text().await.unwrap());
}

/// Measurements of a day.
fn batch(day: usize) -> Value {
    let one = |i: usize| {
        let wave = |rate: f64| (rate * (10 * day + i) as f64).sin();
        let temperature_c = 10.0 + 12.0 * (0.26 * day as f64).sin() + 2.0 * wave(2.3);
        let k1 = 1000.0 * (1.0 + 0.003 * wave(1.0));
        let k2 = 1400.0 * (1.0 + SOFTENING * (temperature_c - 10.0)) * (1.0 + 0.003 * wave(1.7));
        let exact = two_masses_hz(k1, k2);
        let f = [exact[0] * (1.0 + 0.002 * wave(3.1)), exact[1] * (1.0 + 0.002 * wave(4.7))];
        json!({ "measured_at": time(86_400 * day + 600 * i), "frequencies_hz": f, "covariates": { "temperature_c": temperature_c } })
    };
    json!({ "measurements": (0..10).map(one).collect::<Vec<_>>() })
}

/// Requests a job that must be accepted; returns its id.
async fn begin(service: &Service, path: &str, body: &Value, member: &str) -> String {
    let response = service.post(path, body).await;
    let status = response.status();
    let answer: Value = response.json().await.unwrap();
    assert_eq!(status, 202, "{answer}");
    answer[member].as_str().unwrap().to_owned()
}

/// The answer of a path once a state in it is `done`.
async fn ended(service: &Service, path: &str, state: &str) -> Value {
    within(LONG, path, async || {
        let answer = service.read(path).await;
        match answer.pointer(state).and_then(Value::as_str) {
            Some("done") => Some(answer),
            Some("failed" | "cancelled") => panic!("{path}: {answer}"),
            _ => None,
        }
    })
    .await
}

/// Trains a model, posts a month in which one spring follows the temperature, and diagnoses it; the results.
async fn train_and_diagnose(service: &Service) -> ([Value; 2], String) {
    put(service, "tiny").await;
    let recipe = json!({
        "samples": 10_000, "epochs": 20, "units": 1, "seed": 7, "noise_range": { "lowest": 0.5, "highest": 2.0 }
    });
    let training = begin(service, "/v1/structures/tiny/trainings", &recipe, "training").await;
    let trained = ended(service, &format!("/v1/trainings/{training}"), "/state").await;
    for day in 0..24 {
        created(service.post("/v1/structures/tiny/batches", &batch(day)).await).await;
    }
    let diagnosis = begin(service, "/v1/structures/tiny/diagnoses", &json!({}), "diagnosis").await;
    let found = ended(service, &format!("/v1/diagnoses/{diagnosis}"), "/state").await;
    let page = service.get(&format!("/v1/diagnoses/{diagnosis}/report")).send().await.unwrap().text().await.unwrap();
    assert!(page.contains("<svg"), "the report has figures");
    ([trained["result"]["model_digest"].clone(), found["result"].clone()], diagnosis)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_trains_diagnoses_and_extends_with_the_results_of_a_service_alone() {
    if !Server::is_installed() {
        return;
    }
    let [alone, of_service, of_worker] = [(), (), ()].map(|()| tempfile::tempdir().unwrap());
    let expected = {
        let service = Service::start(alone.path());
        train_and_diagnose(&service).await.0
    };
    let url = database_with_tables(Server::get(), of_service.path());
    let worker = process(of_worker.path(), &url, "worker");
    within(LONG, "the worker is heard of", async || {
        worker.get("/readyz").send().await.unwrap().status().is_success().then_some(())
    })
    .await;
    let service = process(of_service.path(), &url, "api");
    let (found, diagnosis) = train_and_diagnose(&service).await;
    assert_eq!(found, expected, "the model and the diagnosis are the same to the last bit");
    assert_eq!(found[1]["verdict"], "cause", "{}", found[1]);
    assert_eq!(delivered(&worker).await, 2, "the worker has computed both");

    let training = json!({ "samples": 5_000, "epochs": 8, "accept_uncalibrated": true });
    begin(&service, &format!("/v1/diagnoses/{diagnosis}/extension"), &training, "diagnosis").await;
    let extended = ended(&service, &format!("/v1/diagnoses/{diagnosis}"), "/extension/state").await;
    let result = &extended["extension"]["result"];
    assert!(result["added"].to_string().contains("temperature_c"), "{result}");
    assert_eq!(result["trained_from"], found[0], "it starts from the weights of the model in use");
    assert!(delivered(&worker).await >= 3, "the worker has computed the extension");
    let structure = service.read("/v1/structures/tiny").await;
    assert_eq!(structure["digest"], result["structure_digest"]);

    // What a worker cannot do is said as the service itself would say it.
    let few = json!({ "from": "2099-01-01T00:00:00Z" });
    let few = begin(&service, "/v1/structures/tiny/diagnoses", &few, "diagnosis").await;
    let failed = within(LONG, "the failure", async || {
        Some(service.read(&format!("/v1/diagnoses/{few}")).await).filter(|answer| answer["state"] == "failed")
    });
    assert!(failed.await["failure"].as_str().unwrap().contains("a diagnosis needs at least 8"));
}

/// Requests the end of a job.
async fn cancel(service: &Service, job: &str) {
    let cancelled = service.request(Method::DELETE, &format!("/v1/jobs/{job}")).send().await.unwrap();
    assert!(cancelled.status().is_success(), "{}", cancelled.text().await.unwrap());
}

/// Long trainings on a database with workers.
struct Long<'s> {
    server: &'s Server,
    name: String,
}

impl Long<'_> {
    /// Starts a worker. Jobs are offered to workers that the database has heard of.
    async fn worker(&self, folder: &Path, url: &str) -> Service {
        let workers = || self.server.sql(&self.name, "select count(*) from modalwatch.computation_worker");
        let before = workers();
        let worker = process(folder, url, "worker");
        within(LONG, "the worker is heard of", async || (workers() != before).then_some(())).await;
        worker
    }

    fn column(&self, select: &str) -> String {
        self.server.sql(&self.name, &format!("select {select} from modalwatch.computation_job"))
    }

    /// Waits until a worker other than this one has done an epoch; returns the worker and the number of its claim.
    async fn computed_by_another_than(&self, worker: &str) -> (String, String) {
        within(LONG, "another worker computes", async || {
            let row = self.column("worker || ' ' || fence || ' ' || progress");
            let (id, rest) = row.split_once(' ')?;
            let (fence, progress) = rest.split_once(' ')?;
            (id != worker && progress.contains("epoch")).then(|| (id.to_owned(), fence.to_owned()))
        })
        .await
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_whose_worker_or_service_dies_is_gone_on_with_by_another() {
    if !Server::is_installed() {
        return;
    }
    let folders = [(), (), (), ()].map(|()| tempfile::tempdir().unwrap());
    let server = Server::get();
    let url = database_with_tables(server, folders[0].path());
    let job = Long { server, name: url.rsplit_once('/').unwrap().1.to_owned() };
    let worker = async |number: usize| job.worker(folders[number].path(), &url).await;
    let mut service = process(folders[0].path(), &url, "api");
    let mut first = worker(1).await;
    put(&service, "tiny").await;
    let recipe = json!({ "samples": 20_000, "epochs": 2_000 });
    let training = begin(&service, "/v1/structures/tiny/trainings", &recipe, "training").await;
    let path = format!("/v1/trainings/{training}");
    let (one, _) = job.computed_by_another_than("").await;
    let shown = within(LONG, "the progress of the worker", async || {
        let answer = service.read(&path).await;
        answer["progress"].as_str().is_some_and(|progress| progress.contains("epoch")).then_some(answer)
    });
    assert!(shown.await["share"].as_f64().is_some_and(|share| share > 0.0 && share < 1.0));

    // The worker is killed: the other one begins again.
    let mut second = worker(2).await;
    first.kill();
    let (two, claim) = job.computed_by_another_than(&one).await;

    // The service is killed: the worker goes on under the same claim.
    service.kill();
    let service = process(folders[0].path(), &url, "api");
    within(LONG, "the next service shows the progress", async || {
        service.read(&path).await["progress"].as_str().filter(|progress| progress.contains("epoch")).map(|_| ())
    })
    .await;
    assert_eq!(job.column("worker || ' ' || fence"), format!("{two} {claim}"));

    // The worker is told to stop: it gives back the job at once, and the service computes it, because nobody else does.
    assert!(second.stop("TERM").success());
    within(LONG, "the service computes", async || {
        let progress = service.read(&path).await["progress"].as_str().unwrap_or_default().to_owned();
        (job.column("count(*)") == "0" && progress.contains("epoch")).then_some(())
    })
    .await;
    cancel(&service, &training).await;
    within(LONG, "the cancelled state", async || (service.read(&path).await["state"] == "cancelled").then_some(()))
        .await;

    // A training that a worker computes is cancelled: the worker is free for the next one.
    let _third = worker(3).await;
    for _ in 0..2 {
        let training = begin(&service, "/v1/structures/tiny/trainings", &recipe, "training").await;
        job.computed_by_another_than(&two).await;
        let running = service.post("/v1/structures/tiny/trainings", &recipe).await;
        problem(running, 409, "training_runs").await;
        cancel(&service, &training).await;
        within(LONG, "the cancelled state, and nothing of it is left", async || {
            let state = service.read(&format!("/v1/trainings/{training}")).await["state"].clone();
            (state == "cancelled" && job.column("count(*)") == "0").then_some(())
        })
        .await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn several_workers_train_several_structures_at_once_and_the_service_one() {
    if !Server::is_installed() {
        return;
    }
    let folders = [(), (), ()].map(|()| tempfile::tempdir().unwrap());
    let server = Server::get();
    let url = database_with_tables(server, folders[0].path());
    let jobs = Long { server, name: url.rsplit_once('/').unwrap().1.to_owned() };
    let mut workers = [jobs.worker(folders[1].path(), &url).await, jobs.worker(folders[2].path(), &url).await];
    let service = process(folders[0].path(), &url, "api");
    let recipe = json!({ "samples": 20_000, "epochs": 2_000 });
    let mut trainings = Vec::new();
    for structure in ["one", "two", "three"] {
        put(&service, structure).await;
        let path = format!("/v1/structures/{structure}/trainings");
        trainings.push(begin(&service, &path, &recipe, "training").await);
    }
    let [one, two, three] = trainings.try_into().unwrap();
    let read = async |training: &str| service.read(&format!("/v1/trainings/{training}")).await;
    let holders = || {
        let held = "progress like '%epoch%' and lease_until > clock_timestamp()";
        jobs.column(&format!("count(distinct worker) filter (where {held})"))
    };
    let computes = async |training: &str, what: &str| {
        within(LONG, what, async || {
            read(training).await["progress"].as_str().filter(|progress| progress.contains("epoch")).map(|_| ())
        })
        .await;
    };
    within(LONG, "two workers train at the same time", async || (holders() == "2").then_some(())).await;
    let waiting = read(&three).await;
    assert_eq!([&waiting["state"], &waiting["place"]], [&json!("waiting"), &json!(1)], "{waiting}");

    // The worker of the first one is free for the third one.
    cancel(&service, &one).await;
    computes(&three, "a worker trains the third").await;
    within(LONG, "two workers train again", async || (holders() == "2").then_some(())).await;

    // Without workers the service computes one after the other.
    for worker in &mut workers {
        assert!(worker.stop("TERM").success());
    }
    within(LONG, "one of both is computed by the service", async || (jobs.column("count(*)") == "1").then_some(()))
        .await;
    let waits = jobs.column("job_id");
    let computed = if waits == two { &three } else { &two };
    computes(computed, "the service trains").await;
    assert_eq!(read(&waits).await["progress"], "waiting for a worker");
    assert_eq!(jobs.column("job_id"), waits, "it stays offered, for a worker that comes");
    cancel(&service, computed).await;
    computes(&waits, "the service trains the other").await;
    assert_eq!(jobs.column("count(*)"), "0");
    cancel(&service, &waits).await;
}
