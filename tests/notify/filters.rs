//! Webhooks as a resource: their filters, and the targets that are refused.

use serde_json::{json, Value};

use crate::helpers::{created, problem, spawn};
use crate::notify::receiver::{Answer, Receiver};
use crate::notify::webhooks::{damage, declare_undamaged, settled, start};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_webhook_gets_only_the_messages_that_it_selects() {
    let folder = tempfile::tempdir().unwrap();
    let service = start(folder.path(), &[]);
    let receiver = Receiver::start(Answer::Status(200)).await;
    let mut hooks = Vec::new();
    for (path, filter) in [
        ("/all", json!({})),
        ("/wanted", json!({ "events": ["alarm.opened"], "alarm_kinds": ["damage"], "structures": ["three-dof"] })),
        ("/other-event", json!({ "events": ["alarm.ended", "alarm.withdrawn"] })),
        ("/other-kind", json!({ "alarm_kinds": ["silence"] })),
        ("/other-structure", json!({ "structures": ["ruler-frame-4dof"] })),
        ("/off", json!({ "enabled": false })),
        ("/deleted", json!({})),
        ("/changed", json!({ "structures": ["ruler-frame-4dof"] })),
    ] {
        let mut body = filter;
        body["url"] = json!(receiver.url(path));
        hooks.push(created(service.post("/v1/webhooks", &body).await).await);
    }
    let path = |i: usize| format!("/v1/webhooks/{}", hooks[i]["webhook"].as_str().unwrap());
    let deleted = service.request(reqwest::Method::DELETE, &path(6)).send().await.unwrap();
    assert_eq!(deleted.status(), 204);
    problem(service.get(&path(6)).send().await.unwrap(), 404, "unknown_webhook").await;
    let changed = service.request(reqwest::Method::PUT, &path(7)).json(&json!({ "url": receiver.url("/new") }));
    let changed: Value = changed.send().await.unwrap().json().await.unwrap();
    assert_eq!((&changed["structures"], &changed["enabled"]), (&json!([]), &json!(true)), "{changed}");
    assert_eq!(service.read("/v1/webhooks").await["items"].as_array().unwrap().len(), 7);

    declare_undamaged(&service).await;
    damage(&service).await;
    receiver.wait_for(3).await;
    for hook in [0, 1, 2, 3, 4, 7] {
        settled(&service, &hooks[hook], "pending", 0).await;
    }
    let mut paths: Vec<String> = receiver.all().into_iter().map(|r| r.path).collect();
    paths.sort();
    assert_eq!(paths, ["/all", "/new", "/wanted"]);
}

#[tokio::test]
async fn an_invalid_webhook_is_a_422_with_the_reason() {
    let (service, _folder) = spawn();
    for (body, pointer, reason) in [
        (json!({ "url": "http://127.0.0.1:9/" }), "/url", "loopback"),
        (json!({ "url": "http://localhost:9/" }), "/url", "loopback"),
        (json!({ "url": "http://169.254.169.254/latest/meta-data/" }), "/url", "link-local"),
        (json!({ "url": "http://[::ffff:10.0.0.1]/" }), "/url", "private"),
        (json!({ "url": "http://0x0a000001/" }), "/url", "private"),
        (json!({ "url": "ftp://example.org/" }), "/url", "only http and https"),
        (json!({ "url": "https://u:p@example.org/" }), "/url", "user name"),
        (json!({ "url": "hook" }), "/url", "not a valid URL"),
        (json!({ "url": format!("https://93.184.216.34/{}", "a".repeat(3_000)) }), "/url", "at most 2000"),
        (json!({ "url": "https://93.184.216.34/", "events": ["alarm.shouted"] }), "/events/0", "alarm.opened"),
        (json!({ "url": "https://93.184.216.34/", "alarm_kinds": ["fire"] }), "/alarm_kinds/0", "damage"),
        (json!({ "url": "https://93.184.216.34/", "structures": ["nowhere"] }), "/structures/0", "no structure"),
        (json!({ "url": "https://93.184.216.34/", "structures": ["../x"] }), "/structures/0", "no structure"),
        (json!({ "url": "https://93.184.216.34/", "secret": "mine" }), "/secret", "unknown field"),
        (json!({}), "/", "missing field `url`"),
    ] {
        let answer = problem(service.post("/v1/webhooks", &body).await, 422, "invalid").await;
        let found = &answer["errors"][0];
        assert_eq!(found["pointer"], pointer, "{body}: {answer}");
        assert!(found["message"].as_str().unwrap().contains(reason), "{body}: {answer}");
    }
    assert_eq!(service.read("/v1/webhooks").await["items"], json!([]));
    let hook = created(service.post("/v1/webhooks", &json!({ "url": "https://93.184.216.34/" })).await).await;
    let path = format!("/v1/webhooks/{}/deliveries", hook["webhook"].as_str().unwrap());
    problem(service.get(&format!("{path}?state=lost")).send().await.unwrap(), 422, "invalid").await;
    problem(service.post(&format!("{path}/7/retry"), &json!({})).await, 404, "unknown_delivery").await;
    problem(service.post("/v1/webhooks/nobody/test", &json!({})).await, 404, "unknown_webhook").await;
    problem(service.get("/v1/quarantine/1").send().await.unwrap(), 404, "unknown_message").await;
}

/// A webhook that was created while its address was allowed gets no messages once the address is not: the address is
/// checked for every message.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_address_that_is_no_longer_allowed_is_not_reached() {
    let folder = tempfile::tempdir().unwrap();
    let receiver = Receiver::start(Answer::Status(200)).await;
    let mut service = start(folder.path(), &[]);
    let named = format!("http://localhost:{}/", receiver.address.port());
    let mut paths = Vec::new();
    for url in [named, receiver.url("/")] {
        let hook = created(service.post("/v1/webhooks", &json!({ "url": url })).await).await;
        paths.push(format!("/v1/webhooks/{}/test", hook["webhook"].as_str().unwrap()));
    }
    for path in &paths {
        let answer: Value = service.post(path, &json!({})).await.json().await.unwrap();
        assert_eq!(answer["delivered"], true, "{answer}");
    }
    service.stop("TERM");
    let service = start(folder.path(), &[("ALLOW_PRIVATE_TARGETS", "[]")]);
    for path in &paths {
        let answer: Value = service.post(path, &json!({})).await.json().await.unwrap();
        assert_eq!((&answer["delivered"], &answer["status"]), (&json!(false), &Value::Null), "{answer}");
        assert!(answer["error"].as_str().unwrap().contains("loopback"), "{answer}");
    }
    assert_eq!(receiver.all().len(), 2);
}
