//! Posting, reading and repeating a batch.

use std::io::{Read as _, Write as _};
use std::time::Duration;

use serde_json::{json, Value};

use crate::helpers::{created, eventually, measurements, problem, spawn, time, two_masses_hz, TWO_MASSES};

const BATCHES: &str = "/v1/structures/three-dof/batches";

#[tokio::test]
async fn from_the_first_batch_to_the_probability_of_damage() {
    let (service, _folder) = spawn();
    let healthy = measurements([4.0, 5.0, 6.0], 20, 0);
    let first = service.post_batch("three-dof", &healthy).await;
    assert_eq!(first["state"], "assessed", "{first}");
    assert!(first["next_step"].as_str().unwrap().contains("POST /v1/structures/three-dof/reference"), "{first}");
    let k1 = &first["assessment"]["parameters"][0];
    assert!((k1["mean"].as_f64().unwrap() - 4.0).abs() < 0.05, "{k1}");
    assert_eq!(k1["probability_of_damage"], Value::Null);

    let reference = json!({ "batches": [first["batch"]] });
    let undamaged = created(service.post("/v1/structures/three-dof/reference", &reference).await).await;
    assert_eq!(undamaged["version"], 1);
    assert_eq!(undamaged["measurement_count"], 20);
    let delta = undamaged["parameters"][1]["threshold"].as_f64().unwrap();
    let (mean, std) = (&undamaged["parameters"][1]["mean"], &undamaged["parameters"][1]["std"]);
    assert!((delta - (mean.as_f64().unwrap() - 1.645 * std.as_f64().unwrap())).abs() < 1e-4, "{undamaged}");

    // A loss of 10 % in k2 alone.
    let damaged = service.post_batch("three-dof", &measurements([4.0, 4.5, 6.0], 20, 100_000)).await;
    let parameters = damaged["assessment"]["parameters"].as_array().unwrap();
    // The population has a spread, so that the probability is not exactly 1.
    assert!(parameters[1]["probability_of_damage"].as_f64().unwrap() > 0.999_99, "{damaged}");
    assert_eq!(parameters[1]["exceeds"], true);
    assert!(parameters[1]["probability_of_damage_interval"][0].as_f64().unwrap() > 0.99, "{damaged}");
    assert!((parameters[1]["relative_change"].as_f64().unwrap() + 0.1).abs() < 0.01, "{damaged}");
    for other in [0, 2] {
        // The uncertainty of the means is a small part of their already small spread.
        let least = parameters[other]["probability_of_damage_interval"][0].as_f64().unwrap();
        assert!(least < 0.05, "only k2 lost stiffness: {damaged}");
    }
    assert_eq!(damaged["assessment"]["exceeds"], true);

    let alarms = service.read("/v1/structures/three-dof/exceedances?parameter=k2").await;
    assert_eq!(alarms["items"].as_array().unwrap().len(), 1, "{alarms}");
    assert_eq!(alarms["items"][0]["batch"], damaged["batch"]);

    let path = format!("{BATCHES}/{}", damaged["batch"].as_str().unwrap());
    let read = service.read(&path).await;
    assert_eq!(read["assessment"], damaged["assessment"]);
    assert_eq!(read["measurements"].as_array().unwrap().len(), 20);
    assert_eq!(read["measurements"][0]["frequencies_hz"].as_array().unwrap().len(), 3);
}

#[tokio::test]
async fn the_example_of_the_readme_is_accepted() {
    let readme = include_str!("../../README.md");
    let (_, rest) = readme.split_once(" -d '").unwrap();
    let (body, _) = rest.split_once("'\n").unwrap();
    let (service, _folder) = spawn();
    let answer = created(service.post_text(BATCHES, "application/json", body).await).await;
    assert_eq!(answer["measurement_count"], 2);
    let assessment = &answer["assessment"];
    assert_eq!(
        (&assessment["measurements_outside"], &assessment["trust"]),
        (&json!(0), &json!("accepted")),
        "{answer}"
    );
    // The mean of the population depends on the reference, which the demo has and this service has not.
    let mean = assessment["parameters"][0]["pooled"]["mean"].as_f64().unwrap();
    assert!(
        readme.contains(&format!("\"pooled\": {{\"mean\": {mean:.4}")),
        "README shows another mean of k1 than {mean}"
    );
}

#[tokio::test]
async fn batches_from_before_the_undamaged_reference_are_compared_with_it_afterwards() {
    let (service, _folder) = spawn();
    let healthy = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 20, 0)).await;
    let damaged = service.post_batch("three-dof", &measurements([4.0, 4.0, 6.0], 20, 100_000)).await;
    assert_eq!(damaged["assessment"]["undamaged_version"], Value::Null);
    created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": [healthy["batch"]] })).await).await;
    let path = |batch: &Value| format!("{BATCHES}/{}", batch["batch"].as_str().unwrap());
    let compared = eventually("the comparison", async || {
        Some(service.read(&path(&damaged)).await).filter(|batch| batch["assessment"]["undamaged_version"] == 1)
    });
    let compared = compared.await;
    assert_eq!(compared["assessment"]["parameters"][1]["probability_of_damage"], 1.0, "{compared}");
    let own = service.read(&path(&healthy)).await;
    assert_eq!(own["assessment"]["undamaged_version"], Value::Null, "{own}");
    assert!(own["next_step"].as_str().unwrap().contains("and is not compared with it"), "{own}");
}

#[tokio::test]
async fn an_undamaged_reference_declared_among_posts_misses_none_of_them() {
    let (service, _folder) = spawn();
    let healthy = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 20, 0)).await;
    let bodies = (1..40).map(|i| json!({ "measurements": measurements([4.0, 5.0, 6.0], 5, i * 20_000) }));
    let mut tasks: Vec<_> = bodies
        .map(|body| service.request(reqwest::Method::POST, BATCHES).json(&body).send())
        .map(tokio::spawn)
        .collect();
    let reference = json!({ "batches": [healthy["batch"]] });
    let path = "/v1/structures/three-dof/reference";
    tasks.insert(20, tokio::spawn(service.request(reqwest::Method::POST, path).json(&reference).send()));
    for task in tasks {
        created(task.await.unwrap().unwrap()).await;
    }
    eventually("the comparison of all batches", async || {
        let history = service.read("/v1/structures/three-dof/history?limit=100").await;
        let mut others = history["items"].as_array().unwrap().iter().filter(|item| item["batch"] != healthy["batch"]);
        let all = others.clone().count() == 39 && others.all(|item| item["assessment"]["undamaged_version"] == 1);
        all.then_some(())
    })
    .await;
}

#[tokio::test]
async fn the_same_batch_sent_twice_is_stored_once_and_answered_the_same() {
    let (service, _folder) = spawn();
    let body = json!({ "source": "logger-1", "measurements": measurements([4.0, 5.0, 6.0], 5, 0) });
    let post = |key: Option<&'static str>, body: Value| {
        let mut request = service.request(reqwest::Method::POST, BATCHES).json(&body);
        if let Some(key) = key {
            request = request.header("idempotency-key", key);
        }
        async { request.send().await.unwrap() }
    };
    let first = post(Some("a-1"), body.clone()).await;
    assert!(first.headers().get("idempotency-replayed").is_none());
    let first = created(first).await;
    // With the same key, without a key, and with another key: it is the same batch.
    for key in [Some("a-1"), None, Some("a-2")] {
        let again = post(key, body.clone()).await;
        assert_eq!(again.headers()["idempotency-replayed"], "true", "{key:?}");
        assert_eq!(created(again).await, first, "{key:?}");
    }
    let history = service.read("/v1/structures/three-dof/history").await;
    assert_eq!(history["items"].as_array().unwrap().len(), 1);

    let mut other = body.clone();
    other["measurements"] = json!(measurements([4.1, 5.0, 6.0], 5, 50_000));
    problem(post(Some("a-1"), other).await, 422, "idempotency_key_reused").await;

    let mut overlapping = body.clone();
    overlapping["measurements"] = json!(measurements([4.0, 5.0, 6.0], 6, 0));
    let refused = problem(post(None, overlapping.clone()).await, 422, "measurement_exists").await;
    assert_eq!(refused["errors"][0]["pointer"], "/measurements/0", "{refused}");
    // Nothing of it was stored: from another source the whole batch is new.
    overlapping["source"] = json!("logger-2");
    assert_eq!(created(post(None, overlapping).await).await["measurement_count"], 6);
}

#[tokio::test]
async fn two_clients_that_post_the_same_batch_at_once_store_it_once() {
    let (service, _folder) = spawn();
    let body = json!({ "measurements": measurements([4.0, 5.0, 6.0], 10, 0) });
    let post = || tokio::spawn(service.request(reqwest::Method::POST, BATCHES).json(&body).send());
    let posts: Vec<_> = (0..8).map(|_| post()).collect();
    let mut ids = Vec::new();
    for answer in posts {
        ids.push(created(answer.await.unwrap().unwrap()).await["batch"].clone());
    }
    assert!(ids.iter().all(|id| *id == ids[0]), "{ids:?}");
    assert_eq!(service.read("/v1/structures/three-dof/history").await["items"].as_array().unwrap().len(), 1);
}

#[tokio::test]
async fn csv_in_every_dialect_is_the_same_batch_as_json() {
    let (service, _folder) = spawn();
    let rows = measurements([4.0, 5.0, 6.0], 3, 0);
    let first =
        created(service.post(&format!("{BATCHES}?source=x"), &json!({ "measurements": rows, "source": "x" })).await)
            .await;
    let table = |separator: &str, comma: bool, end: &str| {
        let mut text = ["measured_at", "f1_hz", "f2_hz", "f3_hz"].join(separator) + end;
        for row in &rows {
            let f = row["frequencies_hz"].as_array().unwrap().iter().map(ToString::to_string);
            let f = f.map(|f| if comma { f.replace('.', ",") } else { f }).collect::<Vec<_>>().join(separator);
            text += &[row["measured_at"].as_str().unwrap(), separator, &f, end].concat();
        }
        text
    };
    let dialects = [
        ("plain", table(",", false, "\n")),
        ("CRLF", table(",", false, "\r\n")),
        ("BOM", format!("\u{feff}{}", table(",", false, "\n"))),
        ("semicolon", table(";", false, "\n")),
        ("decimal comma", table(";", true, "\r\n")),
        ("tab", table("\t", false, "\n")),
        ("no last newline", table(",", false, "\n").trim_end().to_owned()),
        ("upper case and blanks", table(",", false, " \n").replace("f1_hz", " F1_Hz ")),
        ("blank lines", table(",", false, "\n\n")),
    ];
    for (name, text) in dialects {
        let again = service.post_text(&format!("{BATCHES}?source=x"), "text/csv; charset=utf-8", text).await;
        assert!(again.headers().contains_key("idempotency-replayed"), "{name}");
        assert_eq!(created(again).await["batch"], first["batch"], "{name}");
    }
}

#[tokio::test]
async fn a_missing_mode_widens_the_answer_and_leaves_nothing_out() {
    let (service, _folder) = spawn();
    let complete = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 4, 0)).await;
    let mut rows = measurements([4.0, 5.0, 6.0], 4, 50_000);
    for row in &mut rows {
        row["frequencies_hz"][0] = Value::Null;
    }
    let answer = service.post_batch("three-dof", &rows).await;
    let assessment = &answer["assessment"];
    assert_eq!(
        (&assessment["measurements_used"], &assessment["measurements_left_out"]),
        (&json!(4), &json!(0)),
        "{answer}"
    );
    assert_eq!(assessment["misfit_percent"][0], Value::Null);
    let within = |answer: &Value| answer["assessment"]["parameters"][0]["pooled"]["variance_within"].as_f64().unwrap();
    assert!(within(&answer) > 2.0 * within(&complete), "{answer}");
}

/// Codes of the findings of an answer.
fn codes(answer: &Value) -> Vec<&str> {
    let findings = answer["assessment"]["findings"].as_array().unwrap();
    findings.iter().map(|f| f["code"].as_str().unwrap()).collect()
}

#[tokio::test]
async fn an_untrusted_batch_has_findings_and_no_probability_of_damage() {
    let (service, _folder) = spawn();
    let healthy = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 20, 0)).await;
    created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": [healthy["batch"]] })).await).await;
    let changed = |start: usize, change: &dyn Fn(&mut Vec<f64>)| {
        let mut rows = measurements([4.0, 5.0, 6.0], 10, start);
        for row in &mut rows {
            let mut f: Vec<f64> = serde_json::from_value(row["frequencies_hz"].clone()).unwrap();
            change(&mut f);
            row["frequencies_hz"] = json!(f);
        }
        rows
    };
    let first = std::cell::Cell::new(Vec::new());
    let cases: [(&str, Vec<Value>); 4] = [
        ("unit_suspected", changed(100_000, &|f| f.iter_mut().for_each(|f| *f *= 2.0 * std::f64::consts::PI))),
        ("modes_swapped", changed(200_000, &|f| f.swap(0, 1))),
        ("simulation_does_not_fit", changed(300_000, &|f| f[1] *= 0.8)),
        (
            "no_scatter",
            changed(400_000, &|f| {
                let seen = first.take();
                if !seen.is_empty() {
                    f.clone_from(&seen);
                }
                first.set(f.clone());
            }),
        ),
    ];
    for (code, rows) in cases {
        let answer = service.post_batch("three-dof", &rows).await;
        assert!(codes(&answer).contains(&code), "{code}: {answer}");
        assert_eq!(answer["assessment"]["trust"], "rejected", "{code}: {answer}");
        for p in answer["assessment"]["parameters"].as_array().unwrap() {
            assert_eq!((&p["probability_of_damage"], &p["exceeds"]), (&Value::Null, &Value::Null), "{code}: {answer}");
        }
        let refused =
            service.post("/v1/structures/three-dof/reference", &json!({ "batches": [answer["batch"]] })).await;
        problem(refused, 422, "unusable_baseline").await;
    }
    // Three consecutive misfits are an event of their own kind, not damage.
    let alarms = service.read("/v1/structures/three-dof/alarms?state=open").await;
    let kinds: Vec<&str> = alarms["items"].as_array().unwrap().iter().map(|a| a["kind"].as_str().unwrap()).collect();
    assert_eq!(kinds, ["simulation_does_not_fit"], "{alarms}");
}

#[tokio::test]
async fn one_wrong_frequency_is_named_and_the_rest_is_used() {
    let (service, _folder) = spawn();
    let mut rows = measurements([4.0, 5.0, 6.0], 12, 0);
    rows[7]["frequencies_hz"][0] = json!(0.47);
    let answer = service.post_batch("three-dof", &rows).await;
    let finding = &answer["assessment"]["findings"][0];
    assert_eq!((&finding["code"], &finding["measurements"]), (&json!("outlier"), &json!([7])), "{answer}");
    let said = finding["message"].as_str().unwrap();
    assert!(said.starts_with("1 frequency is an outlier and is set aside: measurement 7 has mode 1 at 0.47"), "{said}");
    assert_eq!(
        (&answer["assessment"]["measurements_used"], &answer["assessment"]["trust"]),
        (&json!(12), &json!("accepted"))
    );

    // A measurement of which most frequencies are wrong says nothing.
    let mut rows = measurements([4.01, 5.0, 6.0], 12, 100_000);
    rows[7]["frequencies_hz"] = json!([0.47, 1.05, 1.24]);
    let answer = service.post_batch("three-dof", &rows).await;
    let finding = &answer["assessment"]["findings"][0];
    assert_eq!((&finding["code"], &finding["measurements"]), (&json!("outlier"), &json!([7])), "{answer}");
    assert_eq!(
        (&answer["assessment"]["measurements_used"], &answer["assessment"]["trust"]),
        (&json!(11), &json!("accepted"))
    );
}

#[tokio::test]
async fn a_measurement_without_any_frequency_is_kept_and_left_out() {
    let (service, _folder) = spawn();
    let mut rows = measurements([4.0, 5.0, 6.0], 12, 0);
    rows[7]["frequencies_hz"] = json!([null, null, null]);
    rows[3]["frequencies_hz"] = json!([null, null, null]);
    let answer = service.post_batch("three-dof", &rows).await;
    let finding = &answer["assessment"]["findings"][0];
    assert_eq!((&finding["code"], &finding["measurements"]), (&json!("not_usable"), &json!([3, 7])), "{answer}");
    assert_eq!(finding["message"], "2 of 12 measurements have no frequency and are left out");
    assert_eq!((&answer["assessment"]["measurements_used"], &answer["measurement_count"]), (&json!(10), &json!(12)));
    let read = service.read(&format!("{BATCHES}/{}", answer["batch"].as_str().unwrap())).await;
    assert_eq!(read["measurements"].as_array().map(Vec::len), Some(12), "{read}");
}

#[tokio::test]
async fn damage_becomes_one_alarm_that_can_be_acknowledged() {
    let (service, _folder) = spawn();
    let healthy = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 50, 0)).await;
    created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": [healthy["batch"]] })).await).await;
    for i in 1..=2 {
        let answer = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 20, 100_000 * i)).await;
        let states: Vec<&Value> = answer["charts"].as_array().unwrap().iter().map(|c| &c["state"]).collect();
        assert!(states.len() == 4 && states.iter().all(|s| **s == "normal"), "{answer}");
    }
    for i in 3..=4 {
        let answer = service.post_batch("three-dof", &measurements([4.0, 4.4, 6.0], 20, 100_000 * i)).await;
        let k2 = answer["charts"].as_array().unwrap().iter().find(|c| c["chart"] == "k2").unwrap();
        assert_eq!(k2["state"], "alarming", "{answer}");
        assert!(k2["shift"].as_f64() > k2["shift_limit"].as_f64());
        // The answer is made from the stored values without reading them back: a later read must return the same.
        let read = service.read(&format!("{BATCHES}/{}", answer["batch"].as_str().unwrap())).await;
        for part in ["state", "assessment", "charts", "next_step"] {
            assert_eq!(read[part], answer[part], "{part}");
        }
    }
    let alarms = service.read("/v1/structures/three-dof/alarms").await;
    let item = &alarms["items"][0];
    assert_eq!(alarms["items"].as_array().unwrap().len(), 1, "one alarm, one episode: {alarms}");
    assert_eq!((&item["kind"], &item["parameter"], &item["state"]), (&json!("damage"), &json!("k2"), &json!("open")));
    let path = "/v1/structures/three-dof/alarms/1/acknowledgement";
    let seen = service.post(path, &json!({ "by": "A. Engineer", "note": "inspection ordered" })).await;
    assert_eq!(seen.json::<Value>().await.unwrap()["acknowledgement"]["by"], "A. Engineer");
    let unknown = service.post(&path.replace("/1/", "/7/"), &json!({ "by": "x" })).await;
    problem(unknown, 404, "unknown_alarm").await;
    problem(service.post(path, &json!({ "by": "" })).await, 422, "invalid").await;

    // During maintenance no chart changes.
    let window = json!({ "from": time(900_000), "to": time(1_000_000), "reason": "new bearings" });
    created(service.post("/v1/structures/three-dof/maintenance", &window).await).await;
    let answer = service.post_batch("three-dof", &measurements([4.0, 5.0, 5.0], 20, 910_000)).await;
    assert!(answer["charts"].as_array().unwrap().iter().all(|c| c["held"] == true), "{answer}");
    let charts = service.read("/v1/structures/three-dof/charts").await;
    assert_eq!(
        charts["items"].as_array().unwrap().len(),
        4 * 5 + 1,
        "four charts, five batches, and the fit of the first"
    );
}

#[tokio::test]
async fn one_measurement_has_a_mean_and_no_spread() {
    let (service, _folder) = spawn();
    let answer = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 1, 0)).await;
    assert!(answer["assessment"]["parameters"][0]["mean"].is_f64(), "{answer}");
    assert_eq!(answer["assessment"]["parameters"][0]["std"], Value::Null);
    let refused = service.post("/v1/structures/three-dof/reference", &json!({ "batches": [answer["batch"]] })).await;
    let refused = problem(refused, 422, "unusable_baseline").await;
    assert!(refused["detail"].as_str().unwrap().contains("at least 10"), "{refused}");
}

#[tokio::test]
async fn a_structure_is_defined_over_http_and_its_batches_wait_for_a_model() {
    let (service, _folder) = spawn();
    let definition = json!({
        "id": "tower-1", "modes": 1,
        "mass": [{ "name": "m", "kg": 100.0 }],
        "spring": [{ "name": "k", "from": "ground", "to": "m" }],
        "parameter": [{ "name": "k", "prior": { "uniform": [1000.0, 9000.0] }, "sets": { "spring": "k" } }],
        "covariate": [{ "name": "temperature_c" }, { "name": "operator", "kind": "category" }],
    });
    let put = |body: Value| service.request(reqwest::Method::PUT, "/v1/structures/tower-1").json(&body).send();
    assert_eq!(put(definition.clone()).await.unwrap().status(), 201);
    assert_eq!(put(definition.clone()).await.unwrap().status(), 200);

    let measurement = json!({
        "measured_at": time(0), "frequencies_hz": [1.1], "std_hz": [0.01],
        "covariates": { "temperature_c": -3.5, "operator": "B" }, "settings": { "k": 5000.0 },
    });
    let answer = service.post_batch("tower-1", std::slice::from_ref(&measurement)).await;
    assert_eq!(answer["state"], "received", "{answer}");
    assert!(answer["next_step"].as_str().unwrap().contains("modalwatch train"), "{answer}");
    let path = format!("/v1/structures/tower-1/batches/{}", answer["batch"].as_str().unwrap());
    assert_eq!(service.read(&path).await["measurements"][0], measurement);

    let reference = service.post("/v1/structures/tower-1/reference", &json!({ "batches": [answer["batch"]] })).await;
    problem(reference, 409, "no_model").await;
    let mut heavier = definition.clone();
    heavier["mass"][0]["kg"] = json!(101.0);
    problem(put(heavier).await.unwrap(), 409, "structure_in_use").await;

    let list = service.read("/v1/structures").await;
    let ids: Vec<&str> = list["items"].as_array().unwrap().iter().map(|s| s["id"].as_str().unwrap()).collect();
    assert_eq!(ids, ["rig", "ruler-frame-4dof", "three-dof", "tower-1"]);
    assert_eq!(list["items"][3]["batches"], 1);
}

#[tokio::test]
async fn toml_defines_a_structure_too() {
    let (service, _folder) = spawn();
    let text = include_str!("../../models/three-dof/structure.toml").replace("id = \"three-dof\"", "id = \"copy\"");
    let put = service.request(reqwest::Method::PUT, "/v1/structures/copy");
    let answer = put.header("content-type", "application/toml").body(text).send().await.unwrap();
    assert_eq!(answer.status(), 201);
    let nominal = service.read("/v1/structures/copy").await["nominal_frequencies_hz"].clone();
    let expected = crate::helpers::three_dof_hz([4.0, 5.0, 6.0]);
    for (mode, f) in expected.iter().enumerate() {
        assert!((nominal[mode].as_f64().unwrap() - f).abs() < 1e-9, "{nominal} {expected:?}");
    }
}

/// A post whose body comes slowly, while the structure is defined anew: the batch is checked against the version that it is stored under.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_batch_is_stored_only_under_a_version_that_it_fits() {
    let (service, _folder) = spawn();
    let put = async |definition: String| {
        let put =
            service.request(reqwest::Method::PUT, "/v1/structures/tiny").header("content-type", "application/toml");
        put.body(definition).send().await.unwrap().status()
    };
    let one_mode = TWO_MASSES.replace("modes = 2", "modes = 1");
    // Whether the post that was begun under two modes is stored, with the modes that the structure has at its end.
    for (then, status) in [(one_mode.as_str(), "409"), (TWO_MASSES, "201")] {
        put(TWO_MASSES.to_owned()).await;
        let body =
            json!({ "measurements": [{ "measured_at": time(0), "frequencies_hz": two_masses_hz(1000.0, 1400.0) }] })
                .to_string();
        let mut slow = std::net::TcpStream::connect(service.address()).unwrap();
        let head = format!(
            "POST /v1/structures/tiny/batches HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nConnection: close\r\nContent-Length: {}\r\n\r\n",
            body.len()
        );
        slow.write_all(head.as_bytes()).unwrap();
        slow.write_all(&body.as_bytes()[..10]).unwrap();
        tokio::time::sleep(Duration::from_millis(300)).await;
        put(then.to_owned()).await;
        slow.write_all(&body.as_bytes()[10..]).unwrap();
        let mut answer = String::new();
        slow.read_to_string(&mut answer).unwrap();
        assert!(answer.starts_with(&format!("HTTP/1.1 {status} ")), "{then}: {answer}");
        let stored = service.read("/v1/structures/tiny/history").await;
        assert_eq!(stored["items"].as_array().unwrap().len(), usize::from(status == "201"), "{stored}");
        if status == "409" {
            assert!(answer.contains("version_changed"), "{answer}");
        }
    }
}
