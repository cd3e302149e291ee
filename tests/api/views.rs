//! The routes used by the dashboard: overview, series, details, jobs and events.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use reqwest::{Method, Response};
use serde_json::{json, Value};

use crate::helpers::{created, eventually, measurements, problem, spawn, three_dof_hz, time, Service, PATIENCE};

const SERIES: &str = "/v1/structures/three-dof/series";

/// A structure without a trained model: its batches are stored and wait.
const BARE: &str = r#"
id = "bare"
modes = 2
measurement_noise = { relative = 0.002 }
mass = [{ name = "m1", kg = 1.0 }, { name = "m2", kg = 0.8 }]
spring = [
    { name = "k1", from = "ground", to = "m1", n_per_m = 1000.0 },
    { name = "k2", from = "m1", to = "m2", n_per_m = 1400.0 },
]
parameter = [{ name = "k1", prior = { uniform = [500.0, 1500.0] }, sets = { spring = "k1" } }]
covariate = [{ name = "temperature_c" }, { name = "operator", kind = "category" }]
"#;

/// Puts [`BARE`].
async fn put_bare(service: &Service) {
    let put = service.request(Method::PUT, "/v1/structures/bare").header("content-type", "application/toml");
    created(put.body(BARE).send().await.unwrap()).await;
}

/// Three healthy batches, the first of which is the undamaged reference, one with a loss of 10 % in k2, and one in
/// rad/s.
async fn with_a_damage() -> (Service, tempfile::TempDir, Vec<Value>) {
    let (service, folder) = spawn();
    let mut batches = vec![service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 50, 0)).await];
    let reference = json!({ "batches": [batches[0]["batch"]] });
    created(service.post("/v1/structures/three-dof/reference", &reference).await).await;
    for (i, k2) in [(1, 5.0), (2, 5.0), (3, 4.5)] {
        batches.push(service.post_batch("three-dof", &measurements([4.0, k2, 6.0], 20, 100_000 * i)).await);
    }
    let wrong_unit = |i: usize| {
        let f = three_dof_hz([4.0, 5.0, 6.0 + 0.01 * i as f64]).map(|f| f * std::f64::consts::TAU);
        json!({ "measured_at": time(400_000 + 600 * i), "frequencies_hz": f })
    };
    let rows: Vec<Value> = (0..5).map(wrong_unit).collect();
    batches.push(service.post_batch("three-dof", &rows).await);
    (service, folder, batches)
}

fn numbers(value: &Value) -> Vec<Option<f64>> {
    value.as_array().unwrap().iter().map(Value::as_f64).collect()
}

fn length(value: &Value) -> usize {
    value.as_array().unwrap_or_else(|| panic!("{value} is not a list")).len()
}

/// The items of a list by a text in them.
fn by<'a>(list: &'a Value, key: &str) -> BTreeMap<&'a str, &'a Value> {
    list.as_array().unwrap().iter().map(|item| (item[key].as_str().unwrap(), item)).collect()
}

#[tokio::test]
async fn the_overview_has_one_word_for_each_structure_and_its_newest_answer() {
    let (service, _folder) = spawn();
    put_bare(&service).await;
    let all = service.read("/v1/overview").await;
    assert_eq!(all["jobs_running"], 0);
    let items = by(&all["items"], "id");
    let (bare, fresh) = (items["bare"], items["three-dof"]);
    assert_eq!((&bare["state"], &bare["model_digest"]), (&json!("no_model"), &Value::Null));
    assert!(bare["model_missing"].as_str().unwrap().contains("modalwatch train"), "{bare}");
    assert_eq!((&bare["calibration_passed"], &bare["latest"]), (&Value::Null, &Value::Null));
    assert_eq!((&fresh["state"], &fresh["batches"]), (&json!("unassessed"), &json!(0)));
    assert_eq!((&fresh["last_measured_at"], &fresh["undamaged_version"]), (&Value::Null, &Value::Null));
    assert!(fresh["model_digest"].is_string() && fresh["calibration_passed"].is_boolean(), "{fresh}");
    assert!(fresh.get("model_missing").is_none());

    let (service, _folder, batches) = with_a_damage().await;
    let all = service.read("/v1/overview").await;
    let item = by(&all["items"], "id")["three-dof"];
    assert_eq!(item["state"], "alarming", "{item}");
    let counts = ["batches", "open_alarms", "unacknowledged_alarms", "undamaged_version"].map(|key| &item[key]);
    assert_eq!(counts, [&json!(5), &json!(1), &json!(1), &json!(1)], "{item}");
    assert_eq!(item["last_measured_at"], time(400_000 + 4 * 600));
    assert!(item["last_received_at"].as_str().unwrap() >= batches[4]["received_at"].as_str().unwrap());
    let latest = &item["latest"];
    assert_eq!((&latest["batch"], &latest["trust"]), (&batches[4]["batch"], &json!("rejected")), "{item}");
    assert_eq!((&latest["exceeds"], &latest["max_probability_of_damage"]), (&json!(false), &Value::Null));
    assert_eq!(latest["findings"].as_u64().unwrap() as usize, length(&batches[4]["assessment"]["findings"]));
    service.post("/v1/structures/three-dof/alarms/1/acknowledgement", &json!({ "by": "A. Engineer" })).await;
    let last = service.post_batch("three-dof", &measurements([4.0, 4.5, 6.0], 20, 500_000)).await;
    let item = &by(&service.read("/v1/overview").await["items"], "id")["three-dof"].clone();
    assert_eq!((&item["open_alarms"], &item["unacknowledged_alarms"]), (&json!(1), &json!(0)), "{item}");
    let latest = &item["latest"];
    assert_eq!((&latest["batch"], &latest["exceeds"]), (&last["batch"], &json!(true)));
    assert_eq!(latest["max_parameter"], "k2");
    assert!(latest["max_probability_of_damage"].as_f64().unwrap() > 0.999_99, "{latest}");
}

#[tokio::test]
async fn a_series_holds_all_that_can_be_drawn_over_time() {
    let (service, _folder, batches) = with_a_damage().await;
    let window = json!({ "from": time(900_000), "to": time(1_000_000), "reason": "new bearings" });
    created(service.post("/v1/structures/three-dof/maintenance", &window).await).await;
    let all = service.read(SERIES).await;
    assert_eq!((&all["structure"], &all["batches"], &all["reduced"]), (&json!("three-dof"), &json!(5), &json!(false)));
    assert_eq!((&all["from"], &all["to"]), (&json!(time(0)), &json!(time(402_400))));
    assert_eq!((length(&all["alarms"]), length(&all["maintenance"])), (1, 0), "the maintenance is after the window");

    let f = &all["frequencies"];
    assert_eq!((&f["modes"], length(&f["nominal_hz"])), (&json!(3), 3));
    // 115 measurements, and an empty entry in each of the four gaps between batches.
    assert_eq!((length(&f["times"]), length(&f["values_hz"]), &f["covariates"]), (119, 119, &json!({})));
    let empty: Vec<usize> = (0..119).filter(|i| f["values_hz"][i] == json!([null, null, null])).collect();
    assert_eq!(empty, [50, 71, 92, 113]);
    assert_eq!(f["values_hz"][0], measurements([4.0, 5.0, 6.0], 1, 0)[0]["frequencies_hz"]);
    let times: Vec<&str> = f["times"].as_array().unwrap().iter().map(|t| t.as_str().unwrap()).collect();
    assert!(times.is_sorted());

    let parameters = by(&all["parameters"], "name");
    assert_eq!(parameters.keys().copied().collect::<Vec<_>>(), ["k1", "k2", "k3"]);
    let ids: Vec<&Value> = batches.iter().map(|batch| &batch["batch"]).collect();
    for (k, (name, track)) in parameters.iter().enumerate() {
        assert_eq!(track["batches"].as_array().unwrap().iter().collect::<Vec<_>>(), ids, "{name}");
        assert_eq!((&track["unit"], &track["kind"]), (&json!("N/m"), &json!("parameter")));
        for key in ["times", "mean", "low", "high", "probability_of_damage", "pod_low", "pod_high"] {
            assert_eq!(length(&track[key]), 5, "{name} {key}");
        }
        let assessed = &batches[3]["assessment"]["parameters"][k];
        assert_eq!(track["threshold"], assessed["threshold"]);
        assert_eq!((&track["times"][3], &track["mean"][3]), (&batches[3]["measured_to"], &assessed["mean"]));
        assert_eq!([&track["low"][3], &track["high"][3]], [0, 1].map(|end| &assessed["mean_interval"][end]));
        assert_eq!(track["probability_of_damage"][3], assessed["probability_of_damage"]);
        let interval = [0, 1].map(|end| &assessed["probability_of_damage_interval"][end]);
        assert_eq!([&track["pod_low"][3], &track["pod_high"][3]], interval);
        // The first is the undamaged reference itself, the last is rejected.
        let pod = numbers(&track["probability_of_damage"]);
        assert_eq!(pod.iter().map(Option::is_some).collect::<Vec<_>>(), [false, true, true, true, false], "{pod:?}");
        assert!(track["undamaged_mean"].as_f64().unwrap() > track["threshold"].as_f64().unwrap());
    }
    let charts = by(&all["charts"], "chart");
    assert_eq!(charts.keys().copied().collect::<Vec<_>>(), ["k1", "k2", "k3", "simulation:fit"]);
    let k2 = charts["k2"];
    assert_eq!(k2["state"], json!(["normal", "normal", "alarming"]), "{k2}");
    for key in ["times", "batches", "shift", "shift_limit", "ewma", "ewma_limit", "held"] {
        assert_eq!(length(&k2[key]), 3, "{key}");
    }
    assert!(k2["shift"][2].as_f64() > k2["shift_limit"][2].as_f64());
    assert_eq!(k2["batches"][2], batches[3]["batch"]);

    let trust = all["trust"].as_array().unwrap();
    let verdicts: Vec<&str> = trust.iter().map(|t| t["verdict"].as_str().unwrap()).collect();
    assert_eq!(verdicts, ["accepted", "accepted", "accepted", "accepted", "rejected"]);
    assert!(trust[4]["findings"].as_array().unwrap().contains(&json!("unit_suspected")), "{}", trust[4]);
    assert!(trust[4].get("p_value").is_some() && trust[4]["time"] == batches[4]["measured_to"]);
    let alarm = &all["alarms"][0];
    assert_eq!((&alarm["alarm"], &alarm["kind"], &alarm["parameters"]), (&json!(1), &json!("damage"), &json!(["k2"])));
    assert_eq!((&alarm["state"], &alarm["ended_at"]), (&json!("open"), &Value::Null));
    assert_eq!(alarm["opened_at"], batches[3]["measured_to"]);

    // A part of it, selected by the start of the batches.
    let part = service.read(&format!("{SERIES}?from={}&to={}", time(100_000), time(300_000))).await;
    assert_eq!((&part["batches"], &part["from"]), (&json!(2), &json!(time(100_000))));
    assert_eq!(length(&part["alarms"]), 0, "the alarm was opened later");
    let part = service.read(&format!("{SERIES}?from={}", time(950_000))).await;
    assert_eq!((&part["batches"], length(&part["maintenance"])), (&json!(0), 1));
    assert_eq!((length(&part["parameters"]), length(&part["frequencies"]["times"])), (0, 0));
}

#[tokio::test]
async fn a_spike_among_twenty_thousand_measurements_is_in_the_reduced_series() {
    let (service, _folder) = spawn();
    put_bare(&service).await;
    let (count, spike, warm) = (20_000, 13_579, 4_321);
    for first in (0..count).step_by(5_000) {
        let one = |i: usize| {
            let f1 = if i == spike { 9.0 } else { 3.0 + 0.01 * (i as f64).sin() };
            let f2 = if i % 50 == 7 { Value::Null } else { json!(9.5 + 0.01 * (i as f64).cos()) };
            let t = if i == warm { 35.5 } else { 10.0 + (i % 11) as f64 };
            let covariates = json!({ "temperature_c": t, "operator": "A" });
            json!({ "measured_at": time(600 * i), "frequencies_hz": [f1, f2], "covariates": covariates })
        };
        let rows: Vec<Value> = (first..first + 5_000).map(one).collect();
        service.post_batch("bare", &rows).await;
    }
    let all = service.read("/v1/structures/bare/series?points=400").await;
    assert_eq!((&all["batches"], &all["measurements"], &all["reduced"]), (&json!(4), &json!(count), &json!(true)));
    let f = &all["frequencies"];
    let kept = length(&f["values_hz"]);
    assert!((400..=2 * 400 * 3).contains(&kept), "{kept} of {count} are left");
    let row_at = |i: usize| f["times"].as_array().unwrap().iter().position(|t| *t == time(600 * i).as_str());
    assert_eq!(f["values_hz"][row_at(spike).unwrap()][0], 9.0);
    assert_eq!(f["covariates"]["temperature_c"][row_at(warm).unwrap()], 35.5);
    assert!(f["covariates"].get("operator").is_none(), "a category is not a number");
    let missing = f["values_hz"].as_array().unwrap().iter().filter(|row| row[1].is_null()).count();
    assert!(missing >= 100, "{missing} missing modes are left of 400");
    assert_eq!(
        (length(&all["parameters"]), length(&all["trust"])),
        (0, 0),
        "nothing is assessed without a trained model"
    );
}

#[tokio::test]
async fn an_invalid_query_is_refused_with_its_place() {
    let (service, _folder) = spawn();
    for (query, place) in [
        ("from=yesterday", "query/from"),
        ("to=2026-01-01T00:00:00", "query/to"),
        ("from=2026-01-02T00:00:00Z&to=2026-01-01T00:00:00Z", "query/to"),
        ("points=9", "query/points"),
        ("points=5001", "query/points"),
        ("points=many", "query/points"),
        ("point=100", "query"),
    ] {
        let body = problem(service.get(&format!("{SERIES}?{query}")).send().await.unwrap(), 422, "invalid").await;
        assert_eq!(body["errors"][0]["pointer"], place, "{body}");
    }
    let ask = |path: &'static str| service.get(path).send();
    problem(ask("/v1/structures/nothing/series").await.unwrap(), 404, "unknown_structure").await;
    problem(ask("/v1/structures/No%20thing/series").await.unwrap(), 422, "invalid_id").await;
    problem(ask("/v1/structures/nothing/batches/b/detail").await.unwrap(), 404, "unknown_structure").await;
    problem(ask("/v1/structures/three-dof/batches/b/detail").await.unwrap(), 404, "unknown_batch").await;
    put_bare(&service).await;
    let rows = [json!({ "measured_at": time(0), "frequencies_hz": [3.0, 9.5] })];
    let waiting = service.post_batch("bare", &rows).await;
    let path = format!("/v1/structures/bare/batches/{}/detail", waiting["batch"].as_str().unwrap());
    problem(service.get(&path).send().await.unwrap(), 409, "no_model").await;
}

#[tokio::test]
async fn a_detail_has_the_densities_of_the_assessment_and_what_they_predict() {
    let (service, _folder, batches) = with_a_damage().await;
    let batch = &batches[3];
    let path = format!("/v1/structures/three-dof/batches/{}/detail", batch["batch"].as_str().unwrap());
    let detail = service.read(&path).await;
    assert_eq!((&detail["structure"], &detail["batch"]), (&json!("three-dof"), &batch["batch"]));
    assert_eq!(detail["model_digest"], batch["assessment"]["model_digest"]);
    assert_eq!([&detail["measurement_count"], &detail["measurements_shown"]], [&json!(20), &json!(20)]);
    let space = [("k1", 4.0), ("k2", 4.5), ("k3", 6.0)];
    for (k, (name, _)) in space.iter().enumerate() {
        let (p, assessed) = (&detail["parameters"][k], &batch["assessment"]["parameters"][k]);
        assert_eq!((&p["name"], &p["unit"], &p["threshold"]), (&json!(name), &json!("N/m"), &assessed["threshold"]));
        let column = |key: &str| -> Vec<f64> { numbers(&p[key]).into_iter().map(Option::unwrap).collect() };
        let (grid, posterior) = (column("grid"), column("posterior"));
        assert!(grid.len() >= 200 && grid.windows(2).all(|w| w[0] < w[1]));
        let integral = |f: &dyn Fn(usize) -> f64| {
            (1..grid.len()).map(|i| 0.5 * (f(i) + f(i - 1)) * (grid[i] - grid[i - 1])).sum::<f64>()
        };
        for key in ["prior", "posterior", "undamaged"] {
            let density = column(key);
            let area = integral(&|i| density[i]);
            // Edges of the box lie between places, and the pool's kernels are cut at 4.5 standard deviations.
            assert!((area - 1.0).abs() < 0.03, "the {key} of {name} has area {area}");
        }
        // From the samples of the assessment, bit for bit: the mean of their density is the mean of the pooled samples.
        let mean = integral(&|i| grid[i] * posterior[i]) / integral(&|i| posterior[i]);
        let (pooled, std) = (&assessed["pooled"]["mean"], assessed["pooled"]["std"].as_f64().unwrap());
        assert!((mean - pooled.as_f64().unwrap()).abs() < 0.02 * std, "{name}: {mean}, {pooled}, {std}");
    }
    for (index, mode) in detail["modes"].as_array().unwrap().iter().enumerate() {
        assert_eq!((&mode["mode"], length(&mode["measured_hz"])), (&json!(index + 1), 20));
        let [low, mean, high] =
            ["predicted_low_hz", "predicted_mean_hz", "predicted_high_hz"].map(|key| mode[key].as_f64().unwrap());
        let exact = three_dof_hz([4.0, 4.5, 6.0])[index];
        assert!(low < mean && mean < high && (mean / exact - 1.0).abs() < 0.01, "{mode}");
        let inside = numbers(&mode["measured_hz"]).into_iter().flatten().filter(|f| (low..high).contains(f)).count();
        assert!(inside >= 14, "{inside} of 20 measured values lie within what is predicted: {mode}");
    }
    assert_eq!(length(&detail["modes"]), 3);
    assert_eq!(service.read(&path).await, detail, "a repeated request has the same answer");
    // Nothing for the reference before there is one, and at most 200 values of a mode.
    let (service, _folder) = spawn();
    let batch = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 300, 0)).await;
    let path = format!("/v1/structures/three-dof/batches/{}/detail", batch["batch"].as_str().unwrap());
    let detail = service.read(&path).await;
    assert_eq!(
        (&detail["parameters"][0]["undamaged"], &detail["parameters"][0]["threshold"]),
        (&Value::Null, &Value::Null)
    );
    assert_eq!([&detail["measurement_count"], &detail["measurements_shown"]], [&json!(300), &json!(200)]);
    assert_eq!(length(&detail["modes"][2]["measured_hz"]), 200);
}

/// A stream of events.
struct Watcher {
    response: Response,
    text: String,
}

impl Watcher {
    async fn open(service: &Service) -> Self {
        let response = service.get("/v1/events").send().await.unwrap();
        assert_eq!(response.status(), 200);
        assert_eq!(response.headers()["content-type"], "text/event-stream");
        Self { response, text: String::new() }
    }

    /// The next event; `None` at the end.
    async fn next(&mut self) -> Option<(String, Value)> {
        loop {
            if let Some((block, rest)) = self.text.split_once("\n\n").map(|(a, b)| (a.to_owned(), b.to_owned())) {
                self.text = rest;
                let field = |name: &str| block.lines().find_map(|line| line.strip_prefix(name)).map(str::to_owned);
                let Some(event) = field("event: ") else { continue };
                return Some((event, serde_json::from_str(&field("data: ").unwrap()).unwrap()));
            }
            let wait = tokio::time::timeout(PATIENCE, self.response.chunk());
            let chunk = wait.await.expect("an event comes within 30 s").unwrap()?;
            self.text.push_str(std::str::from_utf8(&chunk).unwrap());
        }
    }

    /// All events up to the first of a kind for which `is` holds.
    async fn until(&mut self, kind: &str, is: impl Fn(&Value) -> bool) -> Vec<(String, Value)> {
        let mut seen = Vec::new();
        loop {
            let event = self.next().await.unwrap_or_else(|| panic!("no {kind} among {seen:?}"));
            let found = event.0 == kind && is(&event.1);
            seen.push(event);
            if found {
                return seen;
            }
        }
    }
}

#[tokio::test]
async fn events_report_batches_alarms_structures_and_jobs() {
    let (service, _folder) = spawn();
    let mut watcher = Watcher::open(&service).await;
    let healthy = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 50, 0)).await;
    let expected = json!({ "structure": "three-dof", "batch": healthy["batch"], "state": "assessed" });
    assert_eq!(watcher.next().await.unwrap(), ("batch".to_owned(), expected));
    created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": [healthy["batch"]] })).await).await;
    assert_eq!(watcher.next().await.unwrap(), ("structure".to_owned(), json!({ "structure": "three-dof" })));

    let damaged = service.post_batch("three-dof", &measurements([4.0, 4.4, 6.0], 20, 100_000)).await;
    assert_eq!(watcher.next().await.unwrap().1["batch"], damaged["batch"]);
    let alarm = |state: &str| json!({ "structure": "three-dof", "alarm": 1, "kind": "damage", "state": state });
    // The replay after the declaration may compute the batch as well, which is not reported again.
    let next_alarm = async |watcher: &mut Watcher| watcher.next().await.unwrap().1;
    assert_eq!(next_alarm(&mut watcher).await, alarm("open"));
    service.post("/v1/structures/three-dof/alarms/1/acknowledgement", &json!({ "by": "A. Engineer" })).await;
    assert_eq!(next_alarm(&mut watcher).await, alarm("acknowledged"));
    for i in 2..=4 {
        service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 20, 100_000 * i)).await;
    }
    let seen = watcher.until("alarm", |_| true).await;
    assert_eq!(seen.last().unwrap().1, alarm("ended"));
    assert_eq!(seen.len(), 4, "three batches and then the end: {seen:?}");

    put_bare(&service).await;
    assert_eq!(watcher.next().await.unwrap(), ("structure".to_owned(), json!({ "structure": "bare" })));
    let rows = [json!({ "measured_at": time(0), "frequencies_hz": [3.0, 9.5] })];
    let waiting = service.post_batch("bare", &rows).await;
    let expected = json!({ "structure": "bare", "batch": waiting["batch"], "state": "received" });
    assert_eq!(watcher.next().await.unwrap(), ("batch".to_owned(), expected));
}

#[tokio::test]
async fn events_follow_a_job_from_beginning_to_end_and_it_is_listed() {
    let (service, _folder) = spawn();
    assert_eq!(service.read("/v1/jobs").await, json!({ "items": [] }));
    for i in 0..6 {
        service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 10, 100_000 * i)).await;
    }
    let mut watcher = Watcher::open(&service).await;
    let asked = service.post("/v1/structures/three-dof/diagnoses", &json!({})).await;
    assert_eq!(asked.status(), 202);
    let id = asked.json::<Value>().await.unwrap()["diagnosis"].clone();
    let seen = watcher.until("job", |data| !["waiting", "running"].contains(&data["state"].as_str().unwrap())).await;
    assert!(seen.len() >= 3, "{seen:?}");
    let expected = json!({
        "job": id, "structure": "three-dof", "kind": "diagnosis", "state": "waiting", "progress": "waiting", "place": 1,
        "trigger": "requested"
    });
    assert_eq!(seen[0], ("job".to_owned(), expected));
    let state = seen.last().unwrap().1["state"].clone();
    assert_eq!(seen.last().unwrap().1["progress"], Value::Null);
    let jobs = service.read("/v1/jobs").await;
    let job = &jobs["items"][0];
    assert_eq!(length(&jobs["items"]), 1);
    assert_eq!((&job["job"], &job["structure"], &job["kind"]), (&id, &json!("three-dof"), &json!("diagnosis")));
    assert_eq!((&job["state"], &job["progress"]), (&state, &Value::Null));
    assert!(job["created_at"].as_str() < job["finished_at"].as_str(), "{job}");
    let diagnosis = service.read(&format!("/v1/diagnoses/{}", id.as_str().unwrap())).await;
    assert_eq!((&job["verdict"], &job["summary"]), (&diagnosis["result"]["verdict"], &diagnosis["result"]["summary"]));
    assert_eq!(service.read("/v1/overview").await["jobs_running"], 0);
}

#[tokio::test]
async fn sigterm_ends_an_open_stream_of_events_and_does_not_wait_for_it() {
    let (mut service, _folder) = spawn();
    let mut watcher = Watcher::open(&service).await;
    let started = Instant::now();
    service.signal("TERM");
    assert_eq!(watcher.next().await, None, "the stream ends regularly and the connection does not break");
    assert!(service.wait(PATIENCE).success());
    // If the stream did not end by itself, it would be aborted after the 30 s that open requests have.
    assert!(started.elapsed() < Duration::from_secs(25), "stopping took {:?}", started.elapsed());
}

#[tokio::test]
async fn streams_are_counted_and_a_closed_one_makes_room() {
    let (service, _folder) = spawn();
    let mut watchers = Vec::new();
    for _ in 0..64 {
        watchers.push(Watcher::open(&service).await);
    }
    let refused = service.get("/v1/events").send().await.unwrap();
    assert!(refused.headers()["retry-after"].to_str().unwrap().parse::<u32>().unwrap() > 0);
    problem(refused, 503, "too_many_streams").await;
    watchers.pop();
    eventually("the place of a closed stream", async || {
        (service.get("/v1/events").send().await.unwrap().status() == 200).then_some(())
    })
    .await;
}

/// Two equal masses on two equal springs, whose shapes are orthogonal: (1, 1.618…) and (1, −0.618…).
const SHAPES: &str = r#"
id = "shapes"
modes = 2
measurement_noise = { relative = 0.002 }
mode_shapes = { points = ["m1", "m2"], noise = 0.01 }
mass = [{ name = "m1", kg = 2.0 }, { name = "m2", kg = 2.0 }]
spring = [
    { name = "k1", from = "ground", to = "m1", n_per_m = 800.0 },
    { name = "k2", from = "m1", to = "m2", n_per_m = 800.0 },
]
parameter = [{ name = "low", scale = true, prior = { uniform = [0.5, 1.5] }, sets = { spring = "k1" } }]
covariate = [{ name = "air", unit = "°C" }, { name = "wind_m_per_s" }, { name = "load" }]
"#;

#[tokio::test]
async fn measured_shapes_are_drawn_with_their_mac_and_covariates_have_their_units() {
    let (service, _folder) = spawn();
    let put = service.request(Method::PUT, "/v1/structures/shapes").header("content-type", "application/toml");
    let stored = created(put.body(SHAPES).send().await.unwrap()).await;
    assert_eq!(stored.get("notes"), None, "{stored}");
    let hz = numbers(&stored["nominal_frequencies_hz"]);
    let golden = 0.5 * (1.0 + 5.0_f64.sqrt());
    let row = json!({ "measured_at": time(0), "frequencies_hz": hz, "mode_shapes": [[-2.0, -2.0 * golden], null],
        "covariates": { "air": 12.5, "wind_m_per_s": 3.0, "load": 1.0 } });
    let batch = service.post_batch("shapes", &[row]).await;
    let batch = batch["batch"].as_str().unwrap();

    let drawn = async |query: &str| {
        let answer = service.request(Method::GET, &format!("/v1/structures/shapes/drawing.svg?{query}")).send().await;
        answer.unwrap()
    };
    let svg = drawn(&format!("mode=1&batch={batch}")).await.text().await.unwrap();
    assert!(svg.contains("measured mode 1, MAC 1.000") && svg.contains("class=\"measured-shape\""), "{svg}");
    // The measured points lie on the simulated ones, whatever the norm and sign that were sent.
    let of = |class: &str| -> Vec<String> {
        let group = svg.split(&format!("class=\"{class}\"")).nth(1).unwrap().split("</g>").next().unwrap();
        let moved = group.split("<circle ").skip(1).map(|c| c.split("data-moved=\"").nth(1).unwrap());
        moved.map(|m| m.split('"').next().unwrap().to_owned()).collect()
    };
    let simulated = of("shape");
    assert_eq!(of("measured-shape"), simulated[simulated.len() - 2..], "{svg}");
    // A mode without a measured shape is drawn alone, and a batch needs a mode.
    let alone = drawn(&format!("mode=2&batch={batch}")).await.text().await.unwrap();
    assert!(alone.contains("mode 2, ") && !alone.contains("MAC"), "{alone}");
    let refused = problem(drawn(&format!("batch={batch}")).await, 422, "invalid").await;
    assert!(refused.to_string().contains("query/batch"), "{refused}");
    assert_eq!(drawn("mode=1&batch=none").await.status(), 404);

    let series = service.read("/v1/structures/shapes/series").await;
    assert_eq!(series["frequencies"]["covariate_units"], json!({ "air": "°C", "wind_m_per_s": "m/s" }), "{series}");

    // A prior in factors without `scale` is stored with a question.
    let doubtful = SHAPES.replace("scale = true, ", "").replacen("\"shapes\"", "\"doubtful\"", 1);
    let put = service.request(Method::PUT, "/v1/structures/doubtful").header("content-type", "application/toml");
    let answer: Value = put.body(doubtful).send().await.unwrap().json().await.unwrap();
    assert!(answer["notes"][0].as_str().is_some_and(|note| note.contains("did you mean `scale = true`")), "{answer}");
}
