//! Each kind of invalid request over HTTP: it has its own answer, and nothing is stored.

use std::fmt::Write as _;

use serde_json::{json, Value};

use crate::helpers::{command, eventually, measurements, problem, repository, spawn, time, Service};

const BATCHES: &str = "/v1/structures/three-dof/batches";

async fn nothing_is_stored(service: &Service) {
    let history = service.read("/v1/structures/three-dof/history").await;
    assert_eq!(history["items"], json!([]));
}

#[tokio::test]
async fn invalid_json_is_a_400() {
    let (service, _folder) = spawn();
    for body in ["", "{", "{\"measurements\": [}", "[1, 2", "{\"measurements\": []} trailing", "hello", "{'a': 1}"] {
        let answer = problem(service.post_text(BATCHES, "application/json", body).await, 400, "malformed_json").await;
        assert!(answer["detail"].as_str().unwrap().contains("line"), "{body}: {answer}");
    }
    let nested = "[".repeat(1_000_000);
    problem(service.post_text(BATCHES, "application/json", nested).await, 400, "malformed_json").await;
    let nested = format!("{{\"measurements\": {}", "[".repeat(1_000_000));
    let refused = service.post_text(BATCHES, "application/json", nested).await;
    assert!([400, 422].contains(&refused.status().as_u16()));
    nothing_is_stored(&service).await;
}

#[tokio::test]
async fn json_of_another_shape_is_a_422_with_a_pointer() {
    let (service, _folder) = spawn();
    let f = "0.41, 0.74, 0.93";
    let at = "\"measured_at\": \"2026-01-01T00:00:00Z\"";
    let cases: Vec<(String, &str, &str)> = vec![
        ("{}".into(), "/", "missing field `measurements`"),
        ("[]".into(), "/", "must be a JSON object"),
        ("{\"measurements\": 3}".into(), "/measurements", "invalid type"),
        ("{\"measurements\": []}".into(), "/measurements", "empty"),
        ("{\"measurements\": [], \"sorce\": \"a\"}".into(), "/sorce", "unknown field `sorce`"),
        (
            format!("{{\"measurements\": [{{{at}, \"frequencies_hz\": [{f}], \"hz\": 1}}]}}"),
            "/measurements/0/hz",
            "unknown field `hz`",
        ),
        (format!("{{\"measurements\": [{{{at}}}]}}"), "/measurements/0", "missing field `frequencies_hz`"),
        (
            format!("{{\"measurements\": [{{{at}, \"frequencies_hz\": [0.41, \"0.74\", 0.93]}}]}}"),
            "/measurements/0/frequencies_hz/1",
            "invalid type: string",
        ),
        (
            format!("{{\"measurements\": [{{{at}, \"frequencies_hz\": [0.41, NaN, 0.93]}}]}}"),
            "/measurements/0/frequencies_hz/1",
            "NaN is not a JSON number",
        ),
        (
            format!("{{\"measurements\": [{{{at}, \"frequencies_hz\": [0.41, Infinity, 0.93]}}]}}"),
            "/measurements/0/frequencies_hz/1",
            "Infinity is not a JSON number",
        ),
        (
            format!("{{\"measurements\": [{{{at}, \"frequencies_hz\": [0.41, -Infinity, 0.93]}}]}}"),
            "/measurements/0/frequencies_hz/1",
            "Infinity is not a JSON number",
        ),
        (
            format!("{{\"measurements\": [{{{at}, \"frequencies_hz\": [0.41, 1e999, 0.93]}}]}}"),
            "/measurements/0/frequencies_hz/1",
            "number out of range",
        ),
    ];
    for (body, pointer, message) in cases {
        let answer = problem(service.post_text(BATCHES, "application/json", body.clone()).await, 422, "invalid").await;
        assert_eq!(answer["errors"][0]["pointer"], pointer, "{body}: {answer}");
        assert!(answer["errors"][0]["message"].as_str().unwrap().contains(message), "{body}: {answer}");
    }
    nothing_is_stored(&service).await;
}

#[tokio::test]
async fn impossible_values_are_a_422_with_a_pointer() {
    let (service, _folder) = spawn();
    let good = || measurements([4.0, 5.0, 6.0], 3, 0);
    let cases: &[(&str, Value, &str, &str)] = &[
        ("frequencies_hz", json!([0.41, 0.0, 0.93]), "/measurements/2/frequencies_hz/1", "above 0"),
        ("frequencies_hz", json!([0.41, -0.0, 0.93]), "/measurements/2/frequencies_hz/1", "above 0"),
        ("frequencies_hz", json!([-0.41, 0.7, 0.93]), "/measurements/2/frequencies_hz/0", "-0.41 Hz"),
        ("frequencies_hz", json!([0.41, 0.7, 1e6]), "/measurements/2/frequencies_hz/2", "it must be in Hz"),
        ("frequencies_hz", json!([1e-4, 0.7, 0.93]), "/measurements/2/frequencies_hz/0", "it seems to be in kHz"),
        ("frequencies_hz", json!([0.41, 0.93]), "/measurements/2/frequencies_hz", "2 frequencies, expected 3"),
        (
            "frequencies_hz",
            json!([0.41, 0.7, 0.93, 1.2]),
            "/measurements/2/frequencies_hz",
            "4 frequencies, expected 3",
        ),
        ("frequencies_hz", json!([0.00041, 0.00092, 0.0012]), "/measurements/2/frequencies_hz/0", "seems to be in kHz"),
        ("std_hz", json!([0.1, 0.1]), "/measurements/2/std_hz", "expected 3"),
        ("std_hz", json!([0.1, 0.0, 0.1]), "/measurements/2/std_hz/1", "above 0"),
        ("std_hz", json!([0.1, -1.0, 0.1]), "/measurements/2/std_hz/1", "a standard deviation of -1 Hz"),
        ("std_hz", json!([0.01, 0.01, 5.0]), "/measurements/2/std_hz/2", "must be smaller than the frequency"),
        ("measured_at", json!("2026-01-01T00:00:00"), "/measurements/2/measured_at", "offset"),
        ("measured_at", json!("yesterday"), "/measurements/2/measured_at", "RFC 3339"),
        ("measured_at", json!("2199-01-01T00:00:00Z"), "/measurements/2/measured_at", "in the future"),
        ("measured_at", json!("1969-12-31T23:00:00Z"), "/measurements/2/measured_at", "before 1970"),
        ("measured_at", json!(time(600)), "/measurements/2/measured_at", "same time"),
        ("measured_at", Value::Null, "/measurements/2/measured_at", "missing"),
        ("covariates", json!({ "temperature_c": 3 }), "/measurements/2/covariates/temperature_c", "declared: none"),
        ("settings", json!({ "k1": 99.0 }), "/measurements/2/settings/k1", "outside the prior"),
        ("settings", json!({ "k9": 4.0 }), "/measurements/2/settings/k9", "not a parameter of this structure"),
    ];
    for (field, value, pointer, message) in cases {
        let mut rows = good();
        rows[2][*field] = value.clone();
        let answer = problem(service.post(BATCHES, &json!({ "measurements": rows })).await, 422, "invalid").await;
        assert_eq!(answer["errors"][0]["pointer"], *pointer, "{field} {value}: {answer}");
        assert!(answer["errors"][0]["message"].as_str().unwrap().contains(message), "{field} {value}: {answer}");
    }
    let mut rows = good();
    for row in &mut rows {
        row["frequencies_hz"] = json!([null, null, null]);
    }
    let answer = problem(service.post(BATCHES, &json!({ "measurements": rows })).await, 422, "invalid").await;
    assert_eq!(answer["errors"][0]["pointer"], "/measurements", "{answer}");
    assert!(answer["errors"][0]["message"].as_str().unwrap().contains("no measurement has a frequency"), "{answer}");
    for source in ["", "a b", "ü", &"x".repeat(65)] {
        let answer = service.post(BATCHES, &json!({ "source": source, "measurements": good() })).await;
        problem(answer, 422, "invalid").await;
    }
    nothing_is_stored(&service).await;
}

#[tokio::test]
async fn several_mistakes_are_reported_together_and_not_without_end() {
    let (service, _folder) = spawn();
    let mut rows = measurements([4.0, 5.0, 6.0], 40, 0);
    for row in &mut rows {
        row["frequencies_hz"][1] = json!(-1.0);
    }
    let answer = problem(service.post(BATCHES, &json!({ "measurements": rows })).await, 422, "invalid").await;
    let errors = answer["errors"].as_array().unwrap();
    assert_eq!(errors.len(), 21, "{answer}");
    assert!(errors[20]["message"].as_str().unwrap().contains("and 20 more"), "{answer}");
}

#[tokio::test]
async fn a_batch_that_is_too_long_or_a_body_that_is_too_large_is_refused() {
    let (service, _folder) = spawn();
    let row = |i: usize| json!({ "measured_at": time(i), "frequencies_hz": [0.41, 0.74, 0.93] });
    let rows: Vec<Value> = (0..10_000).map(row).collect();
    let answer = problem(service.post(BATCHES, &json!({ "measurements": rows })).await, 422, "invalid").await;
    assert!(
        answer["detail"].as_str().unwrap().contains("10000 measurements: a batch may contain at most 5000"),
        "{answer}"
    );

    let huge = vec![b' '; 5 << 20];
    problem(service.post_text(BATCHES, "application/json", huge.clone()).await, 413, "body_too_large").await;
    // Without a declared length, the size is found while reading.
    let chunks = without_length(&huge);
    problem(service.post_text(BATCHES, "application/json", chunks).await, 413, "body_too_large").await;
    nothing_is_stored(&service).await;
}

/// A body without a known length.
fn without_length(bytes: &[u8]) -> reqwest::Body {
    struct Chunks(std::collections::VecDeque<Vec<u8>>);
    impl http_body::Body for Chunks {
        type Data = bytes::Bytes;
        type Error = std::convert::Infallible;

        fn poll_frame(
            mut self: std::pin::Pin<&mut Self>,
            _: &mut std::task::Context<'_>,
        ) -> std::task::Poll<Option<Result<http_body::Frame<bytes::Bytes>, Self::Error>>> {
            std::task::Poll::Ready(self.0.pop_front().map(|chunk| Ok(http_body::Frame::data(chunk.into()))))
        }
    }
    reqwest::Body::wrap(Chunks(bytes.chunks(64 << 10).map(<[u8]>::to_vec).collect()))
}

#[tokio::test]
async fn other_content_types_are_a_415() {
    let (service, _folder) = spawn();
    for kind in ["text/plain", "application/x-www-form-urlencoded", "application/jsonp", "application/vnd.ms-excel"] {
        let answer = problem(service.post_text(BATCHES, kind, "{}").await, 415, "unsupported_media_type").await;
        assert!(
            answer["detail"]
                .as_str()
                .unwrap()
                .contains("application/json, text/csv, multipart/form-data or application/x-ndjson"),
            "{answer}"
        );
    }
    let compressed = service.request(reqwest::Method::POST, BATCHES).header("content-encoding", "gzip");
    let compressed = compressed.header("content-type", "application/json").body("{}").send().await.unwrap();
    problem(compressed, 415, "unsupported_encoding").await;
    let none = service.request(reqwest::Method::POST, BATCHES).body("{}").send().await.unwrap();
    problem(none, 415, "unsupported_media_type").await;
}

#[tokio::test]
async fn invalid_ids_and_keys_are_refused() {
    let (service, _folder) = spawn();
    let long = "x".repeat(10_000);
    for id in
        ["a%2Fb", "..%2F..%2Fetc", "%F0%9F%8C%89", "Three-Dof", "a%20b", "a%0Ab", "%27%3Bdrop%20table", &long, "-a"]
    {
        let path = format!("/v1/structures/{id}/history");
        let answer = problem(service.get(&path).send().await.unwrap(), 422, "invalid_id").await;
        assert!(answer.to_string().len() < 1_000, "{answer}");
    }
    problem(service.get("/v1/structures/%FF/history").send().await.unwrap(), 422, "invalid").await;
    problem(service.get("/v1/structures/unheard-of").send().await.unwrap(), 404, "unknown_structure").await;
    let body = json!({ "measurements": measurements([4.0, 5.0, 6.0], 1, 0) });
    problem(service.post("/v1/structures/unheard-of/batches", &body).await, 404, "unknown_structure").await;
    problem(service.get(&format!("{BATCHES}/nothing")).send().await.unwrap(), 404, "unknown_batch").await;
    let unknown = json!({ "batches": ["nothing"] });
    problem(service.post("/v1/structures/three-dof/reference", &unknown).await, 404, "unknown_batch").await;
    for key in ["", "a b", "ü", &"k".repeat(129)] {
        let request = service.request(reqwest::Method::POST, BATCHES).json(&body);
        let value = reqwest::header::HeaderValue::from_bytes(key.as_bytes()).unwrap();
        problem(request.header("idempotency-key", value).send().await.unwrap(), 422, "invalid").await;
    }
    problem(service.get("/v2/structures").send().await.unwrap(), 404, "unknown_route").await;
    let delete = service.request(reqwest::Method::DELETE, "/v1/structures/three-dof").send().await.unwrap();
    // Without the confirmation.
    problem(delete, 422, "invalid").await;
    nothing_is_stored(&service).await;
}

#[tokio::test]
async fn an_invalid_reference_is_refused() {
    let (service, _folder) = spawn();
    let batch = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 5, 0)).await["batch"].clone();
    let path = "/v1/structures/three-dof/reference";
    problem(service.post(path, &json!({ "batches": [] })).await, 422, "invalid").await;
    problem(service.post(path, &json!({ "batches": [batch, batch] })).await, 422, "unusable_baseline").await;
    for probability in [0.0, -0.1, 0.6, 2.0] {
        let body = json!({ "batches": [batch], "threshold_probability": probability });
        problem(service.post(path, &body).await, 422, "unusable_baseline").await;
    }
    problem(service.post(path, &json!({ "batch": [batch] })).await, 422, "invalid").await;
}

#[tokio::test]
async fn tables_with_mistakes_are_refused_with_line_and_column() {
    let (service, _folder) = spawn();
    let header = "measured_at,f1_hz,f2_hz,f3_hz\n";
    let row = "2026-01-01T00:00:00Z,0.41,0.74,0.93\n";
    let with = |line: &str| format!("{header}{row}{line}\n");
    let cases: Vec<(Vec<u8>, &str, &str)> = vec![
        (Vec::new(), "line 1", "empty"),
        (header.into(), "/measurements", "empty"),
        (b"measured_at,f1_hz,f2_hz\n".to_vec(), "line 1", "missing column f3_hz"),
        (b"f1_hz,f2_hz,f3_hz\n".to_vec(), "line 1", "missing column measured_at"),
        (b"measured_at,f1_hz,f2_hz,f3_hz,lab\n".to_vec(), "line 1", "unknown column \"lab\""),
        (b"measured_at,f1_hz,f2_hz,f3_hz,f3_hz\n".to_vec(), "line 1", "twice"),
        (b"measured_at,f1_hz,f2_hz,f3_hz,f4_hz\n".to_vec(), "line 1", "3 modes"),
        (with("2026-01-01T00:10:00Z,0.41,0.74").into(), "line 3", "3 cells, but the header has 4"),
        (with("2026-01-01T00:10:00Z,0.41,abc,0.93").into(), "line 3, column f2_hz", "\"abc\" is not a number"),
        (with("2026-01-01T00:10:00Z,0.41,inf,0.93").into(), "line 3, column f2_hz", "leave the cell empty"),
        (with("2026-01-01T00:10:00Z,0.41,-0.74,0.93").into(), "line 3, column f2_hz", "above 0"),
        (with("2026-01-01T00:10:00,0.41,0.74,0.93").into(), "line 3, column measured_at", "offset"),
        (with("\"2026-01-01T00:10:00Z,0.41,0.74,0.93").into(), "line 3", "cells"),
        (with("2026-01-01T00:10:00Z,\"0,41\",0.74,0.93").into(), "line 3, column f1_hz", "decimal comma"),
        ([header.as_bytes(), b"2026-01-01T00:10:00Z,0.41,0.74,\xff\n"].concat(), "line 2", "not UTF-8"),
    ];
    for (body, place, message) in cases {
        let shown = String::from_utf8_lossy(&body).into_owned();
        let answer = problem(service.post_text(BATCHES, "text/csv", body).await, 422, "invalid").await;
        assert_eq!(answer["errors"][0]["pointer"], place, "{shown}: {answer}");
        assert!(answer["errors"][0]["message"].as_str().unwrap().contains(message), "{shown}: {answer}");
    }
    nothing_is_stored(&service).await;
    let ignored = "measured_at,lab,f1_hz,f2_hz,f3_hz\n2026-01-01T00:00:00Z,br,0.41,0.74,0.93\n";
    let answer = service.post_text(&format!("{BATCHES}?ignore=lab"), "text/csv", ignored).await;
    assert_eq!(answer.status(), 201, "{}", answer.text().await.unwrap());
}

#[tokio::test]
async fn a_structure_with_mistakes_is_refused_with_its_place() {
    let (service, _folder) = spawn();
    let put = |kind: &'static str, body: String| {
        let request = service.request(reqwest::Method::PUT, "/v1/structures/x").header("content-type", kind);
        async { request.body(body).send().await.unwrap() }
    };
    let text = include_str!("../../models/three-dof/structure.toml").replace("id = \"three-dof\"", "id = \"x\"");
    let answer = put("application/toml", text.replace("to = \"m3\"", "to = \"m4\"")).await;
    let answer = problem(answer, 422, "invalid_structure").await;
    assert!(answer["errors"][0]["pointer"].as_str().unwrap().contains("line"), "{answer}");
    assert_eq!(answer["errors"].as_array().unwrap().len(), 3, "k3, k5 and k6 go to it: {answer}");
    problem(put("application/json", "{".to_owned()).await, 400, "malformed_json").await;
    problem(put("application/json", "{\"id\": 3}".to_owned()).await, 422, "invalid_structure").await;
    problem(put("application/toml", text.replace("id = \"x\"", "id = \"y\"")).await, 422, "invalid").await;
    problem(put("text/plain", text).await, 415, "unsupported_media_type").await;
    problem(service.get("/v1/structures/x").send().await.unwrap(), 404, "unknown_structure").await;
}

#[tokio::test]
async fn a_normal_prior_is_taken_and_an_impossible_one_is_refused_with_its_reason() {
    let (service, _folder) = spawn();
    let put = |prior: &str| {
        let request =
            service.request(reqwest::Method::PUT, "/v1/structures/x").header("content-type", "application/toml");
        let text = include_str!("../../models/three-dof/structure.toml").replace("id = \"three-dof\"", "id = \"x\"");
        let body = text.replacen("{ uniform = [3.0, 7.0] }", prior, 1);
        async { request.body(body).send().await.unwrap() }
    };
    for (prior, key, part) in [
        ("{ normal = { mean = 4.0, std = -0.5 } }", "/normal/std", "std = -0.5"),
        ("{ normal = { mean = 4.0, std = 2.0 } }", "/normal", "a std below 1 keeps the prior above 0"),
        ("{ log_normal = { median = 4.0, relative_std = 20.0 } }", "/log_normal/relative_std", "did you mean 20 %"),
        ("{ uniform = [3.0, 7.0], normal = { mean = 4.0, std = 0.5 } }", "", "a parameter has one prior"),
    ] {
        let answer = problem(put(prior).await, 422, "invalid_structure").await;
        let error = &answer["errors"][0];
        let pointer = format!("/parameter/0/prior{key}");
        assert!(error["pointer"].as_str().unwrap().ends_with(&pointer), "{answer}");
        assert!(error["message"].as_str().unwrap().contains(part), "{answer}");
    }
    let answer = put("{ normal = { mean = 4.0, std = 0.5 } }").await;
    assert_eq!(answer.status(), 201, "{}", answer.text().await.unwrap());
    let prior = service.read("/v1/structures/x").await["definition"]["parameter"][0]["prior"].clone();
    assert_eq!(prior, json!({ "normal": { "mean": 4.0, "std": 0.5 } }));
}

/// Change of the files of a trained model.
type Change<'a> = Box<dyn Fn(&std::path::Path) + 'a>;

/// A models folder with one model that was changed by `change`.
fn models_with(change: impl Fn(&std::path::Path)) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let target = folder.path().join("three-dof");
    std::fs::create_dir(&target).unwrap();
    for name in ["structure.toml", "baseline.json", "baseline.safetensors"] {
        std::fs::copy(repository("models/three-dof").join(name), target.join(name)).unwrap();
    }
    change(&target);
    folder
}

#[tokio::test]
async fn a_damaged_model_file_is_reported_and_the_other_models_are_used() {
    let weights = |f: &std::path::Path| f.join("baseline.safetensors");
    let rewrite = |path: std::path::PathBuf, change: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = std::fs::read(&path).unwrap();
        change(&mut bytes);
        std::fs::write(path, bytes).unwrap();
    };
    // Changed weights get a matching manifest, so that each case reaches the check that it is meant for.
    let sign = |folder: &std::path::Path| {
        let digest = modalwatch::quantity::Digest::of_file(&std::fs::read(weights(folder)).unwrap());
        let path = folder.join("baseline.json");
        let mut manifest: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
        manifest["weights_sha256"] = json!(digest.as_str());
        std::fs::write(path, serde_json::to_vec(&manifest).unwrap()).unwrap();
    };
    let cases: Vec<(&str, Change, &str)> = vec![
        ("bit flip", Box::new(|f| rewrite(weights(f), &|b| b[5_000] ^= 1)), "SHA-256"),
        (
            "truncated",
            Box::new(|f| {
                rewrite(weights(f), &|b| b.truncate(1_000));
                sign(f);
            }),
            "safetensors",
        ),
        (
            "foreign",
            Box::new(|f| {
                rewrite(weights(f), &|b| *b = b"\x89PNG\r\n".to_vec());
                sign(f);
            }),
            "safetensors",
        ),
        (
            "NaN",
            Box::new(|f| {
                rewrite(weights(f), &|b| {
                    let n = b.len();
                    b[n - 4..].copy_from_slice(&f32::NAN.to_le_bytes());
                });
                sign(f);
            }),
            "not finite",
        ),
        ("no manifest", Box::new(|f| std::fs::remove_file(f.join("baseline.json")).unwrap()), "missing"),
        (
            "empty manifest",
            Box::new(|f| std::fs::write(f.join("baseline.json"), "").unwrap()),
            "manifest is not readable",
        ),
    ];
    for (name, change, reason) in cases {
        let models = models_with(change);
        let folder = tempfile::tempdir().unwrap();
        let service = Service::spawn(command(folder.path()).arg("--models").arg(models.path()));
        let ready = service.get("/readyz").send().await.unwrap();
        assert_eq!(ready.status(), 200, "{name}: the other models are used");
        let ready: Value = ready.json().await.unwrap();
        let refused = ready["baselines_refused"][0].clone();
        assert_eq!(refused["structure"], "three-dof", "{name}: {ready}");
        assert!(refused["reason"].as_str().unwrap().contains(reason), "{name}: {ready}");
        let answer = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 2, 0)).await;
        assert_eq!(answer["state"], "received", "{name}: {answer}");
        assert!(answer["next_step"].as_str().unwrap().contains(reason), "{name}: {answer}");
        let structure = service.read("/v1/structures/three-dof").await;
        assert!(structure["model_missing"].as_str().unwrap().contains(reason), "{name}: {structure}");
    }
}

#[tokio::test]
async fn a_batch_that_waited_is_assessed_when_its_model_is_available() {
    let models = models_with(|f| std::fs::write(f.join("baseline.json"), "").unwrap());
    let folder = tempfile::tempdir().unwrap();
    let mut service = Service::spawn(command(folder.path()).arg("--models").arg(models.path()));
    let batch = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 5, 0)).await["batch"].clone();
    service.stop("TERM");
    let service = Service::start(folder.path());
    let path = format!("{BATCHES}/{}", batch.as_str().unwrap());
    eventually("the assessment", async || (service.read(&path).await["state"] == "assessed").then_some(())).await;
}

#[tokio::test]
async fn foreign_text_in_an_answer_is_short_and_escaped() {
    let (service, _folder) = spawn();
    let mut text = String::from("measured_at,f1_hz,f2_hz,f3_hz,");
    write!(text, "{}\u{7}\u{1b}[31m", "x".repeat(500)).unwrap();
    let answer = problem(service.post_text(BATCHES, "text/csv", text).await, 422, "invalid").await;
    let message = answer["errors"][0]["message"].as_str().unwrap();
    assert!(message.len() < 400 && !message.contains('\u{1b}'), "{message}");
}
