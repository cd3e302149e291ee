//! NDJSON: many batches in one request, each with its own answer.

use reqwest::Response;
use serde_json::{json, Value};

use crate::helpers::{command, eventually, measurements, problem, spawn, Service};

const BATCHES: &str = "/v1/structures/three-dof/batches";

/// A line with `count` measurements of the day `day`.
fn line(day: usize, count: usize) -> Value {
    json!({ "source": "tower", "measurements": measurements([4.0, 5.0, 6.0], count, day * 86_400) })
}

async fn post(service: &Service, body: impl Into<reqwest::Body>) -> Response {
    service.post_text(BATCHES, "application/x-ndjson", body).await
}

async fn answer(response: Response) -> Value {
    let status = response.status();
    let body: Value = response.json().await.unwrap();
    assert_eq!(status, 200, "{body}");
    body
}

fn statuses(answer: &Value) -> Vec<(u64, u64)> {
    let of = |item: &Value| (item["line"].as_u64().unwrap(), item["status"].as_u64().unwrap());
    answer["items"].as_array().unwrap().iter().map(of).collect()
}

async fn stored(service: &Service) -> usize {
    service.read("/v1/structures/three-dof/history").await["items"].as_array().unwrap().len()
}

#[tokio::test]
async fn each_line_is_answered_in_its_place() {
    let (service, _folder) = spawn();
    let mut wrong = line(3, 2);
    wrong["measurements"][1]["frequencies_hz"] = json!([0.4, 0.7]);
    let unknown_key = json!({ "source": "tower", "measurements": [], "colour": "red" });
    let bad_key = json!({ "idempotency_key": "a b", "measurements": line(4, 1)["measurements"] });
    // A byte order mark, CRLF, blank lines and no newline at the end, as files often have.
    let body = format!(
        "\u{feff}{}\r\n\r\n{}\nhello\n{wrong}\n{unknown_key}\n{bad_key}\n[]\n   \n{}",
        line(1, 2),
        line(1, 2),
        line(2, 3)
    );
    let answer = answer(post(&service, body).await).await;
    assert_eq!(
        statuses(&answer),
        [(1, 201), (3, 201), (4, 400), (5, 422), (6, 422), (7, 422), (8, 422), (10, 201)],
        "{answer:#}"
    );
    assert_eq!((&answer["stored"], &answer["replayed"], &answer["refused"]), (&json!(2), &json!(1), &json!(5)));
    let items = answer["items"].as_array().unwrap();
    assert_eq!((&items[0]["replayed"], &items[1]["replayed"]), (&json!(false), &json!(true)));
    assert_eq!(items[0]["batch"], items[1]["batch"]);
    assert_eq!(items[0]["state"], "assessed");
    let batch = service.read(items[7]["location"].as_str().unwrap()).await;
    assert_eq!((&batch["measurement_count"], &batch["source"]), (&json!(3), &json!("tower")));
    for (item, code, pointer) in [
        (2, "malformed_json", Value::Null),
        (3, "invalid", json!("/measurements/1/frequencies_hz")),
        (4, "invalid", json!("/colour")),
        (5, "invalid", json!("/idempotency_key")),
        (6, "invalid", json!("/")),
    ] {
        let problem = &items[item]["problem"];
        assert_eq!((&problem["code"], &problem["errors"][0]["pointer"]), (&json!(code), &pointer), "{problem}");
        assert_eq!(problem["status"], items[item]["status"], "{problem}");
        assert!(items[item]["batch"].is_null() && items[item]["location"].is_null(), "{}", items[item]);
    }
    assert_eq!(stored(&service).await, 2);
}

#[tokio::test]
async fn posting_the_same_again_stores_nothing_and_keys_are_kept() {
    let (service, _folder) = spawn();
    let with_key = |day: usize, key: &str| {
        let mut line = line(day, 2);
        line["idempotency_key"] = json!(key);
        line
    };
    let body = format!("{}\n{}\n", with_key(1, "one"), with_key(2, "two"));
    assert_eq!(answer(post(&service, body.clone()).await).await["stored"], 2);
    let again = answer(post(&service, body).await).await;
    assert_eq!((&again["stored"], &again["replayed"], &again["refused"]), (&json!(0), &json!(2), &json!(0)));
    let other = answer(post(&service, format!("{}\n", with_key(3, "one"))).await).await;
    assert_eq!(other["items"][0]["problem"]["code"], "idempotency_key_reused", "{other}");
    assert_eq!(stored(&service).await, 2);
}

#[tokio::test]
async fn the_source_of_the_query_applies_to_lines_without_one() {
    let (service, _folder) = spawn();
    let own = line(2, 1);
    let none = json!({ "measurements": line(1, 1)["measurements"] });
    let path = format!("{BATCHES}?source=bridge");
    let response = service.post_text(&path, "application/x-ndjson", format!("{none}\n{own}")).await;
    let answer = answer(response).await;
    for (item, source) in [(0, "bridge"), (1, "tower")] {
        let batch = service.read(answer["items"][item]["location"].as_str().unwrap()).await;
        assert_eq!(batch["source"], source);
    }
}

#[tokio::test]
async fn limits_of_lines_and_bodies() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = command(folder.path());
    command.env("MODALWATCH__HTTP__MAX_BODY_BYTES", "2000").env("MODALWATCH__HTTP__MAX_BULK_BYTES", "20000");
    let service = Service::spawn(&mut command);
    // A line that is too long is refused by itself.
    let long = format!("{{\"source\": \"{}\"}}", "x".repeat(3_000));
    let taken = answer(post(&service, format!("{}\n{long}\n{}\n", line(1, 2), line(2, 2))).await).await;
    assert_eq!(statuses(&taken), [(1, 201), (2, 413), (3, 201)]);
    assert_eq!(taken["items"][1]["problem"]["code"], "line_too_large");
    // A body that announces too large a size stores nothing.
    let body =
        problem(post(&service, format!("{}\n{}", line(3, 2), " ".repeat(20_000))).await, 413, "body_too_large").await;
    assert_eq!(body["done"], Value::Null, "{body}");
    assert_eq!(stored(&service).await, 2);
    // A body without an announced size is answered with what was stored.
    let parts = [format!("{}\n", line(3, 2)), "x".repeat(1_000), " ".repeat(19_500)];
    let stream = futures_util::stream::iter(parts.map(Ok::<_, std::io::Error>));
    let refused = problem(post(&service, reqwest::Body::wrap_stream(stream)).await, 413, "body_too_large").await;
    assert_eq!((&refused["done"]["stored"], statuses(&refused["done"])), (&json!(1), vec![(1, 201)]), "{refused}");
    assert_eq!(stored(&service).await, 3);
    // More lines than the answer may have entries.
    let body = problem(post(&service, "1\n".repeat(10_000) + "2\n").await, 413, "body_too_large").await;
    assert_eq!(body["done"], Value::Null);
}

#[tokio::test]
async fn too_many_lines_are_refused_with_the_results_so_far() {
    let (service, _folder) = spawn();
    let body = format!("{}\n{}", line(1, 1), "1\n".repeat(10_000));
    let refused = problem(post(&service, body).await, 413, "too_many_lines").await;
    assert!(refused["detail"].as_str().unwrap().contains("10001"), "{}", refused["detail"]);
    assert_eq!((&refused["done"]["stored"], &refused["done"]["refused"]), (&json!(1), &json!(9_999)));
}

#[tokio::test]
async fn an_invalid_request_as_a_whole_is_a_problem() {
    let (service, _folder) = spawn();
    let text = line(1, 1).to_string();
    let request = |path: &str| {
        service.request(reqwest::Method::POST, path).header("content-type", "application/x-ndjson").body(text.clone())
    };
    let keyed = request(BATCHES).header("idempotency-key", "k").send().await.unwrap();
    let keyed = problem(keyed, 422, "invalid").await;
    assert_eq!(keyed["errors"][0]["pointer"], "header/Idempotency-Key");
    let packed = request(BATCHES).header("content-encoding", "gzip").send().await.unwrap();
    problem(packed, 415, "unsupported_encoding").await;
    let unknown = request("/v1/structures/none/batches").send().await.unwrap();
    problem(unknown, 404, "unknown_structure").await;
    assert_eq!(
        answer(post(&service, "").await).await,
        json!({ "items": [], "stored": 0, "replayed": 0, "refused": 0 })
    );
    assert_eq!(stored(&service).await, 0);
}

#[tokio::test]
async fn lines_wait_for_a_place_in_the_queue_instead_of_being_refused() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = command(folder.path());
    let service = Service::spawn(command.env("MODALWATCH__MONITOR__COMPUTE__QUEUE", "1"));
    let body = |from: usize| (from..from + 12).map(|day| line(day, 10).to_string()).collect::<Vec<_>>().join("\n");
    let (one, other) = tokio::join!(post(&service, body(1)), post(&service, body(20)));
    for response in [one, other] {
        assert_eq!(answer(response).await["stored"], 12);
    }
}

#[tokio::test]
async fn a_client_that_disconnects_ends_the_request_between_two_lines() {
    let (service, _folder) = spawn();
    let (sender, receiver) = tokio::sync::mpsc::channel::<Result<String, std::io::Error>>(1);
    let lines = futures_util::stream::unfold(receiver, |mut receiver| async {
        receiver.recv().await.map(|line| (line, receiver))
    });
    let request = service.request(reqwest::Method::POST, BATCHES).header("content-type", "application/x-ndjson");
    let sending = tokio::spawn(request.body(reqwest::Body::wrap_stream(lines)).send());
    sender.send(Ok(format!("{}\n", line(1, 2)))).await.unwrap();
    sender.send(Ok("{\"measurements\": [{".to_owned())).await.unwrap();
    // A line is stored before the next has come.
    eventually("one stored line", async || (stored(&service).await == 1).then_some(())).await;
    sending.abort();
    // The service continues, and what was acknowledged is stored.
    let batch = service.read("/v1/structures/three-dof/history").await["items"][0].clone();
    assert_eq!(batch["measurement_count"], 2);
    assert_eq!(answer(post(&service, line(1, 2).to_string()).await).await["replayed"], 1);
}
