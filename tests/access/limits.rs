//! Rate limits, and the headers of every answer.

use serde_json::json;

use crate::access::world::{first_token, World};
use crate::helpers::{created, measurements, problem};

const LIST: &str = "/v1/structures";

/// Repeats a request until it is answered 429; returns the number of other answers.
async fn until_429(ask: impl AsyncFn() -> reqwest::Response, expected: u16, code: &str) -> usize {
    for answered in 0..60 {
        let response = ask().await;
        if response.status() == 429 {
            let field = |name: &str| response.headers()[name].to_str().unwrap().to_owned();
            let retry_after: u32 = field("retry-after").parse().unwrap();
            assert!(retry_after >= 1, "{retry_after}");
            assert!(field("ratelimit").contains(";r=0;t=") && field("ratelimit-policy").contains(";q="));
            problem(response, 429, code).await;
            return answered;
        }
        assert_eq!(response.status(), expected);
    }
    panic!("no limit in 60 requests");
}

#[tokio::test]
async fn tokens_cannot_be_tried_one_after_the_other_and_a_known_one_still_passes() {
    let world = World::with(|command| command.env("MODALWATCH__HTTP__TRUSTED_PROXIES", "[\"127.0.0.1\"]"));
    let elsewhere = tempfile::tempdir().unwrap();
    let unknown = first_token(elsewhere.path());
    let from = |address: &'static str, token: String| {
        let request = world.service.get(LIST).bearer_auth(token).header("x-forwarded-for", address);
        async move { request.send().await.unwrap() }
    };
    let tried = until_429(async || from("203.0.113.9", unknown.clone()).await, 401, "too_many_failures").await;
    assert!((10..20).contains(&tried), "{tried} were tried");
    assert_eq!(from("203.0.113.9", world.admin.clone()).await.status(), 200);
    // Another address has its own allowance; addresses that the client writes into the header itself are ignored.
    problem(from("203.0.113.10", unknown.clone()).await, 401, "unauthorized").await;
    let spoofed = from("198.51.100.1, 203.0.113.9", unknown.clone()).await;
    problem(spoofed, 429, "too_many_failures").await;
}

#[tokio::test]
async fn each_token_has_its_own_allowance_of_requests() {
    let world = World::with(|command| {
        command.env("MODALWATCH__HTTP__RATE_LIMIT__REQUESTS_PER_S", "1");
        command.env("MODALWATCH__HTTP__RATE_LIMIT__BURST", "4")
    });
    let reader = world.token(&["read"], &[]).await;
    let answered = until_429(async || world.get(LIST, &reader).await, 200, "too_many_requests").await;
    assert!(answered >= 4, "{answered} were answered");
    assert_eq!(world.get(LIST, &world.admin).await.status(), 200);
}

#[tokio::test]
async fn a_batch_costs_its_measurements_and_one_beyond_is_not_stored() {
    let world = World::with(|command| {
        command.env("MODALWATCH__HTTP__RATE_LIMIT__MEASUREMENTS_PER_S", "1");
        command.env("MODALWATCH__MONITOR__MAX_MEASUREMENTS", "30")
    });
    let gateway = world.token(&["ingest"], &[]).await;
    let post = async |start_s: usize| {
        let body = json!({ "measurements": measurements([4.0, 5.0, 6.0], 20, start_s) });
        world.post("/v1/structures/three-dof/batches", &gateway, &body).await
    };
    created(post(0).await).await;
    let refused = post(86_400).await;
    assert!(refused.headers().contains_key("retry-after"));
    problem(refused, 429, "too_many_measurements_a_second").await;
    let history = world.read("/v1/structures/three-dof/history", &world.admin).await;
    assert_eq!(history["items"].as_array().unwrap().len(), 1);
}

#[tokio::test]
async fn each_line_of_ndjson_costs_its_measurements() {
    let world = World::with(|command| {
        command.env("MODALWATCH__HTTP__RATE_LIMIT__MEASUREMENTS_PER_S", "1");
        command.env("MODALWATCH__MONITOR__MAX_MEASUREMENTS", "30")
    });
    let gateway = world.token(&["ingest"], &[]).await;
    let line = |day: usize| json!({ "measurements": measurements([4.0, 5.0, 6.0], 20, day * 86_400) }).to_string();
    let body = format!("{}\n{}\n{}\n", line(0), line(1), line(2));
    let request = world.ask(reqwest::Method::POST, "/v1/structures/three-dof/batches", &gateway);
    let refused = request.header("content-type", "application/x-ndjson").body(body).send().await.unwrap();
    assert!(refused.headers().contains_key("retry-after"));
    let answer = problem(refused, 429, "too_many_measurements_a_second").await;
    assert_eq!((&answer["done"]["stored"], &answer["done"]["refused"]), (&json!(1), &json!(0)), "{answer}");
}

#[tokio::test]
async fn every_answer_carries_the_security_headers() {
    let world = World::start();
    let answers = [
        (200, true, world.get(LIST, &world.admin).await),
        (401, true, world.service.get(LIST).send().await.unwrap()),
        (404, true, world.get("/v1/structures/nothing", &world.admin).await),
        (404, false, world.service.get("/nothing").send().await.unwrap()),
        (200, false, world.get("/metrics", &world.admin).await),
        (200, false, world.service.get("/readyz").send().await.unwrap()),
    ];
    for (status, api, answer) in answers {
        assert_eq!(answer.status(), status);
        let header = |name: &str| answer.headers().get(name).map(|value| value.to_str().unwrap());
        assert_eq!(header("x-content-type-options"), Some("nosniff"));
        assert_eq!(header("referrer-policy"), Some("no-referrer"));
        assert_eq!(header("x-frame-options"), Some("DENY"));
        assert_eq!(header("cross-origin-opener-policy"), Some("same-origin"));
        assert_eq!(header("cross-origin-resource-policy"), Some("same-origin"));
        assert_eq!(header("content-security-policy"), Some("default-src 'none'; frame-ancestors 'none'"));
        assert_eq!(header("cache-control"), api.then_some("no-store"));
        assert_eq!(header("access-control-allow-origin"), None);
    }
}
