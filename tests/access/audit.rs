//! The audit: it contains every change and nothing else.

use std::io::Write as _;
use std::time::Duration;

use reqwest::Method;
use serde_json::{json, Value};

use crate::access::world::{id_of, World};
use crate::helpers::{created, eventually, measurements, problem, Service};

async fn entries(world: &World, query: &str) -> Vec<Value> {
    let page = world.read(&format!("/v1/audit{query}"), &world.admin).await;
    page["items"].as_array().unwrap().clone()
}

#[tokio::test]
async fn each_change_is_recorded_with_token_address_and_outcome() {
    let world = World::start();
    let keeper = world.token(&["admin"], &["three-dof"]).await;
    let window = json!({ "from": "2026-01-01T00:00:00Z", "to": "2026-01-02T00:00:00Z", "reason": "bolts" });
    let path = "/v1/structures/three-dof/maintenance";
    let request = world.ask(Method::POST, path, &keeper).header("x-request-id", "window-1").json(&window);
    created(request.send().await.unwrap()).await;
    // None of these is a change: a batch, a read, a request that is refused before its handler.
    let batch = json!({ "measurements": measurements([4.0, 5.0, 6.0], 12, 0) });
    let batch = created(world.post("/v1/structures/three-dof/batches", &world.admin, &batch).await).await;
    world.read("/v1/structures", &world.admin).await;
    problem(world.post("/v1/tokens", &keeper, &json!({})).await, 403, "forbidden_structure").await;
    // These are attempted changes, one of them successful.
    let undamaged = json!({ "batches": [batch["batch"]] });
    created(world.post("/v1/structures/three-dof/reference", &world.admin, &undamaged).await).await;
    let acknowledgement = "/v1/structures/three-dof/alarms/999/acknowledgement";
    problem(world.post(acknowledgement, &keeper, &json!({ "by": "me" })).await, 404, "unknown_alarm").await;

    let items = entries(&world, "").await;
    let seen: Vec<(&str, &str, &str)> = items
        .iter()
        .map(|e| (e["action"].as_str().unwrap(), e["actor"].as_str().unwrap(), e["outcome"].as_str().unwrap()))
        .collect();
    let (admin, keeper) = (id_of(&world.admin), id_of(&keeper));
    let expected = [
        ("POST /v1/structures/{id}/alarms/{alarm}/acknowledgement", keeper, "refused"),
        ("POST /v1/structures/{id}/reference", admin, "done"),
        ("POST /v1/structures/{id}/maintenance", keeper, "done"),
        ("POST /v1/tokens", admin, "done"),
        ("modalwatch token create", "local", "done"),
    ];
    assert_eq!(seen, expected);
    assert_eq!(items[0]["subject"], acknowledgement);
    let window = &items[2];
    assert_eq!((&window["structure"], &window["status"]), (&json!("three-dof"), &json!(201)));
    assert_eq!((&window["peer"], &window["request_id"]), (&json!("127.0.0.1"), &json!("window-1")));
    assert_eq!(window["actor_name"], "admin three-dof");
    assert_eq!(items[3]["subject"], format!("/v1/tokens/{keeper}"), "the new token itself, not only the list");
    assert_eq!(items[4]["subject"], format!("/v1/tokens/{admin}"));
}

#[tokio::test]
async fn the_audit_is_paged_and_cut_by_time() {
    let world = World::start();
    for number in 0..7 {
        let window =
            json!({ "from": "2026-01-01T00:00:00Z", "to": "2026-01-02T00:00:00Z", "reason": format!("{number}") });
        created(world.post("/v1/structures/three-dof/maintenance", &world.admin, &window).await).await;
    }
    let all = entries(&world, "").await;
    assert_eq!(all.len(), 8);
    let (mut paged, mut cursor) = (Vec::new(), String::new());
    loop {
        let page = world.read(&format!("/v1/audit?limit=3{cursor}"), &world.admin).await;
        paged.extend(page["items"].as_array().unwrap().clone());
        let Some(next) = page["next"].as_str() else { break };
        cursor = format!("&cursor={next}");
    }
    assert_eq!(paged, all);
    let at = all[3]["at"].as_str().unwrap();
    let (from, to) = (entries(&world, &format!("?from={at}")).await, entries(&world, &format!("?to={at}")).await);
    assert_eq!((from, to), (all[..4].to_vec(), all[4..].to_vec()));
    for wrong in ["?from=yesterday", "?limit=0", "?cursor=x"] {
        problem(world.get(&format!("/v1/audit{wrong}"), &world.admin).await, 422, "invalid").await;
    }
}

#[tokio::test]
async fn a_client_that_disconnects_leaves_a_complete_entry() {
    let world = World::start();
    for day in 10..30 {
        let (from, to) = ("2026-01-01T00:00:00Z", format!("2026-01-{day}T00:00:00Z"));
        let body = json!({ "from": from, "to": to, "reason": "gone" }).to_string();
        let request = format!(
            "POST /v1/structures/three-dof/maintenance HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {}\r\n\
             Content-Type: application/json\r\nContent-Length: {}\r\n\r\n{body}",
            world.admin,
            body.len()
        );
        let mut connection = std::net::TcpStream::connect(world.service.address()).unwrap();
        connection.write_all(request.as_bytes()).unwrap();
        // The client disconnects after 0 to 19 ms; a request that was never received leaves no entry.
        std::thread::sleep(Duration::from_millis(day - 10));
    }
    eventually("an entry for each window that is stored", async || {
        let windows = world.read("/v1/structures/three-dof/maintenance", &world.admin).await;
        let stored = windows["items"].as_array().unwrap().len();
        let entries = entries(&world, "").await;
        let done = entries.iter().filter(|e| e["structure"] == "three-dof" && e["outcome"] == "done").count();
        let whole = stored > 0 && stored == done && !entries.iter().any(|e| e["outcome"] == "unknown");
        whole.then_some(())
    })
    .await;
}

#[tokio::test]
async fn entries_outlive_a_kill() {
    let mut world = World::start();
    let token = world.token(&["read"], &[]).await;
    world.service.kill();
    world.service = Service::start(world.folder.path());
    let items = entries(&world, "").await;
    assert_eq!(items[0]["subject"], format!("/v1/tokens/{}", id_of(&token)));
    assert_eq!(items[0]["outcome"], "done");
}
