//! Tokens that may post under certain sources only, and which token has posted a batch.

use reqwest::{Method, Response};
use serde_json::{json, Value};

use crate::access::world::{id_of, program, World};
use crate::helpers::{created, measurements, problem, spawn, Service};

const BATCHES: &str = "/v1/structures/three-dof/batches";
const DAY_S: usize = 86_400;

/// A token that may post under these sources only.
async fn gateway(world: &World, sources: &[&str]) -> String {
    let body = json!({ "name": "gateway", "scopes": ["ingest"], "sources": sources });
    let made = created(world.post("/v1/tokens", &world.admin, &body).await).await;
    assert_eq!(made["sources"], json!(sources));
    made["token"].as_str().unwrap().to_owned()
}

/// Two measurements of a day.
fn batch(source: Option<&str>, day: usize) -> Value {
    let mut body = json!({ "measurements": measurements([4.0, 5.0, 6.0], 2, day * DAY_S) });
    if let Some(source) = source {
        body["source"] = json!(source);
    }
    body
}

/// The same as CSV.
fn table(day: usize) -> String {
    let row = |measurement: &Value| {
        let frequencies = measurement["frequencies_hz"].as_array().unwrap().iter().map(Value::to_string);
        format!("{},{}\n", measurement["measured_at"].as_str().unwrap(), frequencies.collect::<Vec<_>>().join(","))
    };
    let rows: String = measurements([4.0, 5.0, 6.0], 2, day * DAY_S).iter().map(row).collect();
    format!("measured_at,f1_hz,f2_hz,f3_hz\n{rows}")
}

async fn send(world: &World, token: &str, query: &str, (kind, text): (&str, String)) -> Response {
    let request = world.ask(Method::POST, &format!("{BATCHES}{query}"), token);
    request.header("content-type", kind).body(text).send().await.unwrap()
}

/// What is answered to a post of many batches.
async fn many(world: &World, token: &str, query: &str, (kind, text): (&str, String)) -> Value {
    let response = send(world, token, query, (kind, text)).await;
    assert_eq!(response.status(), 200, "{kind}");
    response.json().await.unwrap()
}

fn ndjson(batches: &[Value]) -> (&'static str, String) {
    ("application/x-ndjson", batches.iter().map(|batch| batch.to_string() + "\n").collect())
}

/// The sources of all stored batches, in the order of the alphabet.
async fn stored(world: &World) -> Vec<String> {
    let history = world.read("/v1/structures/three-dof/history?limit=1000", &world.admin).await;
    let items = history["items"].as_array().unwrap();
    let mut sources: Vec<String> = items.iter().map(|item| item["source"].as_str().unwrap().to_owned()).collect();
    sources.sort();
    sources
}

#[tokio::test]
async fn a_token_posts_under_its_sources_only() {
    let mut world = World::start();
    let token = gateway(&world, &["gateway-1"]).await;
    let json = |body: &Value| ("application/json", body.to_string());
    let csv = || ("text/csv", table(0));
    let refusals = [
        send(&world, &token, "", json(&batch(Some("gateway-2"), 0))).await,
        send(&world, &token, "?source=gateway-2", json(&batch(None, 0))).await,
        send(&world, &token, "?source=gateway-1", json(&batch(Some("default"), 0))).await,
        send(&world, &token, "?source=gateway-2", csv()).await,
        send(&world, &token, "?source=gateway-2&split=1d", csv()).await,
    ];
    for refusal in refusals {
        let refusal = problem(refusal, 403, "forbidden_source").await;
        let detail = refusal["detail"].as_str().unwrap();
        let given = ["\"gateway-2\"", "\"default\""].iter().any(|given| detail.contains(given));
        assert!(given && detail.contains("\"gateway-1\""), "{detail}");
    }
    let preview = world.ask(Method::POST, "/v1/structures/three-dof/tables/preview?source=gateway-2", &token);
    let preview = preview.header("content-type", "text/csv").body(table(0)).send().await.unwrap();
    problem(preview, 403, "forbidden_source").await;
    assert!(stored(&world).await.is_empty());

    let lines = [batch(Some("gateway-2"), 0), batch(Some("gateway-1"), 0), batch(Some("gateway-3"), 1)];
    let answer = many(&world, &token, "", ndjson(&lines)).await;
    assert_eq!((&answer["stored"], &answer["refused"]), (&json!(1), &json!(2)), "{answer}");
    for line in [0, 2] {
        let item = &answer["items"][line];
        assert_eq!((&item["status"], &item["problem"]["code"]), (&json!(403), &json!("forbidden_source")), "{answer}");
    }
    assert_eq!(stored(&world).await, ["gateway-1"]);

    // The limit is stored with the token, and a rotation keeps it.
    world.service.kill();
    world.service = Service::start(world.folder.path());
    let rotation = format!("/v1/tokens/{}/rotation", id_of(&token));
    let rotated = created(world.post(&rotation, &world.admin, &json!({})).await).await;
    for token in [token.as_str(), rotated["token"].as_str().unwrap()] {
        let refusal = send(&world, token, "", json(&batch(Some("gateway-2"), 0))).await;
        problem(refusal, 403, "forbidden_source").await;
    }
    // Whoever is not limited posts under any source.
    let free = world.token(&["ingest"], &[]).await;
    created(send(&world, &free, "", json(&batch(Some("gateway-2"), 0))).await).await;
    created(send(&world, &free, "", json(&batch(None, 0))).await).await;
    assert_eq!(stored(&world).await, ["default", "gateway-1", "gateway-2"]);
}

#[tokio::test]
async fn a_post_without_a_source_has_the_only_one_of_its_token() {
    let world = World::start();
    let token = gateway(&world, &["gateway-1"]).await;
    created(world.post(BATCHES, &token, &batch(None, 0)).await).await;
    created(send(&world, &token, "", ("text/csv", table(1))).await).await;
    let cut = many(&world, &token, "?split=1d", ("text/csv", table(2))).await;
    let lines = many(&world, &token, "", ndjson(&[batch(None, 3), batch(None, 4)])).await;
    assert_eq!((&cut["stored"], &lines["stored"]), (&json!(1), &json!(2)), "{cut} {lines}");
    assert_eq!(stored(&world).await, ["gateway-1"; 5]);

    // Of two, none is guessed.
    let two = gateway(&world, &["gateway-1", "gateway-2"]).await;
    let refusal = problem(world.post(BATCHES, &two, &batch(None, 5)).await, 403, "forbidden_source").await;
    let detail = refusal["detail"].as_str().unwrap();
    assert!(["gateway-1", "gateway-2", "default"].iter().all(|name| detail.contains(name)), "{detail}");
    created(world.post(BATCHES, &two, &batch(Some("gateway-2"), 5)).await).await;
    let default = gateway(&world, &["default", "gateway-1"]).await;
    created(world.post(BATCHES, &default, &batch(None, 6)).await).await;
}

#[tokio::test]
async fn a_key_of_one_source_keeps_no_batch_of_another_from_being_stored() {
    let world = World::start();
    let (first, second) = (gateway(&world, &["gateway-1"]).await, gateway(&world, &["gateway-2"]).await);
    let post = async |token: &str, day: usize| {
        let request = world.ask(Method::POST, BATCHES, token).header("idempotency-key", "gateway-1-000124");
        request.json(&batch(None, day)).send().await.unwrap()
    };
    created(post(&second, 0).await).await;
    // Another time, and the same time.
    let own = created(post(&first, 1).await).await;
    created(world.post(BATCHES, &first, &batch(None, 0)).await).await;
    assert_eq!(created(post(&first, 1).await).await["batch"], own["batch"]);
    problem(post(&first, 2).await, 422, "idempotency_key_reused").await;
    assert_eq!(stored(&world).await, ["gateway-1", "gateway-1", "gateway-2"]);
}

#[tokio::test]
async fn a_batch_tells_the_token_that_posted_it_also_in_another_installation() {
    let mut world = World::start();
    let (first, second) = (gateway(&world, &["gateway-1"]).await, world.token(&["ingest"], &["three-dof"]).await);
    let made = created(world.post(BATCHES, &first, &batch(None, 0)).await).await;
    let again = created(world.post(BATCHES, &second, &batch(Some("gateway-1"), 0)).await).await;
    assert_eq!(again["batch"], made["batch"]);
    let lines = many(&world, &second, "", ndjson(&[batch(None, 1)])).await;
    let cut = many(&world, &second, "?split=1d", ("text/csv", table(2))).await;
    let revoked = world.ask(Method::DELETE, &format!("/v1/tokens/{}", id_of(&first)), &world.admin).send().await;
    assert_eq!(revoked.unwrap().status(), 200);

    let path = |id: &Value| format!("{BATCHES}/{}", id.as_str().unwrap());
    let expected =
        [(&made["batch"], &first), (&lines["items"][0]["batch"], &second), (&cut["items"][0]["batch"], &second)];
    let expected = expected.map(|(batch, token)| (path(batch), json!(id_of(token))));
    for (answer, token) in [(&made, &first), (&again, &first)] {
        assert_eq!(answer["posted_by"], id_of(token), "{answer}");
    }
    let reader = world.token(&["read"], &["three-dof"]).await;
    for (path, token) in &expected {
        assert_eq!(world.read(path, &reader).await["posted_by"], *token, "{path}");
    }

    world.service.stop("TERM");
    let elsewhere = tempfile::tempdir().unwrap();
    let (file, target) = (elsewhere.path().join("archive.ndjson"), elsewhere.path().join("data"));
    let exported =
        program(&["export", "--structure", "three-dof", "--out", file.to_str().unwrap()], world.folder.path());
    assert!(exported.status.success(), "{}", String::from_utf8_lossy(&exported.stderr));
    std::fs::create_dir(&target).unwrap();
    let imported = program(&["import", "--from", file.to_str().unwrap()], &target);
    assert!(imported.status.success(), "{}", String::from_utf8_lossy(&imported.stderr));
    let importing = Service::start(&target);
    for (path, token) in &expected {
        assert_eq!(importing.read(path).await["posted_by"], *token, "{path}");
    }
}

#[tokio::test]
async fn a_batch_that_was_posted_without_a_token_says_so() {
    let (service, _folder) = spawn();
    let made = service.request(Method::POST, BATCHES).json(&batch(None, 0)).send().await.unwrap();
    assert_eq!(created(made).await.get("posted_by"), Some(&json!(null)));
}
