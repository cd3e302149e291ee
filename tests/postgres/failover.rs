//! Services on one database: one serves, the others wait for it; servers and services that end, hang or come back.

use std::time::Duration;

use serde_json::{json, Value};

use crate::helpers::{eventually, measurements, problem, refusal, Service, PATIENCE};
use crate::postgres::database::url_of;
use crate::postgres::node::{serving, Node};
use crate::postgres::server::Server;
use crate::postgres::world::{database_with_tables, pending, serve};

const BATCHES: &str = "/v1/structures/three-dof/batches";

fn batch(number: usize) -> Value {
    json!({ "measurements": measurements([4.0, 5.0, 6.0], 3, number * 3_600), "source": "gateway" })
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_second_service_is_refused_or_waits_and_takes_over_with_all_that_was_acknowledged() {
    if !Server::is_installed() {
        return;
    }
    let folders = [(); 3].map(|()| tempfile::tempdir().unwrap());
    let url = url_of(folders[0].path()).await.to_string();
    let mut first = Service::spawn(&mut serve(folders[0].path(), &url));
    let said = refusal(&mut serve(folders[1].path(), &url));
    assert!(
        said.contains(&format!("is served by modalwatch {}@", first.pid())) && said.contains("store.standby"),
        "{said}"
    );

    let waiting = [1, 2].map(|i| Node::start(folders[i].path(), &url, "10"));
    for standby in &waiting {
        standby.becomes("standby").await;
    }
    for number in 0..5 {
        assert_eq!(first.post(BATCHES, &batch(number)).await.status(), 201);
    }
    first.kill();
    // Exactly one takes over.
    let which = serving(&waiting).await;
    let history = waiting[which].read("/v1/structures/three-dof/history?limit=100").await;
    assert_eq!(history["items"].as_array().unwrap().len(), 5, "{history}");
    assert!(history["items"].as_array().unwrap().iter().all(|item| item["state"] == "assessed"), "{history}");
    let other = &waiting[1 - which];
    other.becomes("standby").await;
    assert!(waiting[which].is("serving").await);
    waiting[which].signal("TERM");
    other.becomes("serving").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_service_that_hangs_is_replaced_and_ends_when_it_wakes_up() {
    if !Server::is_installed() {
        return;
    }
    let folders = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let url = url_of(folders[0].path()).await.to_string();
    let mut first = Service::spawn(&mut serve(folders[0].path(), &url));
    let standby = Node::start(folders[1].path(), &url, "2");
    standby.becomes("standby").await;
    assert_eq!(first.post(BATCHES, &batch(0)).await.status(), 201);
    // As long as it lives, nobody takes over from it, however little it has to do.
    tokio::time::sleep(Duration::from_secs(5)).await;
    assert!(standby.is("standby").await);
    first.signal("STOP");
    standby.becomes("serving").await;
    let posted = standby.client.post(format!("{}{BATCHES}", standby.url)).json(&batch(1)).send().await.unwrap();
    assert_eq!(posted.status(), 201);
    first.signal("CONT");
    assert!(!first.wait(PATIENCE).success(), "it has to end as a failure, so that its supervisor starts it again");
    let history = standby.read("/v1/structures/three-dof/history?limit=100").await;
    assert_eq!(history["items"].as_array().unwrap().len(), 2, "{history}");
}

/// The lock is free when the first one wakes up, and yet it must not go on with what it knew.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_service_that_was_replaced_ends_also_if_its_successor_has_ended_meanwhile() {
    if !Server::is_installed() {
        return;
    }
    let folders = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let url = url_of(folders[0].path()).await.to_string();
    let mut first = Service::spawn(&mut serve(folders[0].path(), &url));
    assert_eq!(first.post(BATCHES, &batch(0)).await.status(), 201);
    let mut second = Node::start(folders[1].path(), &url, "2");
    second.becomes("standby").await;
    first.signal("STOP");
    second.becomes("serving").await;
    assert_eq!(second.post(BATCHES, &batch(1)).await.status(), 201);
    second.kill();
    first.signal("CONT");
    assert!(!first.wait(PATIENCE).success(), "it served what it knew before the other one wrote");
    let third = Service::spawn(&mut serve(folders[0].path(), &url));
    let history = third.read("/v1/structures/three-dof/history?limit=100").await;
    assert_eq!(history["items"].as_array().unwrap().len(), 2, "{history}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn while_the_server_is_away_requests_are_told_to_come_back_and_then_it_goes_on() {
    if !Server::is_installed() {
        return;
    }
    // A server of its own, whose data survive a crash.
    let server = Server::start(&[]);
    let folder = tempfile::tempdir().unwrap();
    let url = database_with_tables(&server, folder.path());
    let service = Service::spawn(&mut serve(folder.path(), &url));
    let mut acknowledged = 0;
    for round in 0..3 {
        assert_eq!(service.post(BATCHES, &batch(10 * round)).await.status(), 201);
        if round == 1 {
            server.kill();
        } else {
            server.stop();
        }
        let refused = problem(service.post(BATCHES, &batch(10 * round + 1)).await, 503, "database_unreachable").await;
        assert!(refused["detail"].as_str().unwrap().contains("repeat it"), "{refused}");
        let response = service.get("/v1/structures/three-dof/history").send().await.unwrap();
        assert!(response.headers().contains_key("retry-after"));
        problem(response, 503, "database_unreachable").await;
        let health = service.get("/readyz").send().await.unwrap();
        assert_eq!(health.status(), 503);
        let health: Value = health.json().await.unwrap();
        assert_eq!(health["reasons"][0]["code"], "database_unreachable", "{health}");
        assert_eq!(service.get("/healthz").send().await.unwrap().status(), 200);
        server.start_again();
        eventually("it is ready again", async || {
            (service.get("/readyz").send().await.unwrap().status() == 200).then_some(())
        })
        .await;
        let response = service.post(BATCHES, &batch(10 * round + 1)).await;
        assert!([200, 201].contains(&response.status().as_u16()), "{}", response.text().await.unwrap());
        acknowledged += 2;
    }
    eventually("all are assessed", async || (pending(&service).await == 0.0).then_some(())).await;
    let history = service.read("/v1/structures/three-dof/history?limit=100").await;
    let items = history["items"].as_array().unwrap();
    assert_eq!(items.len(), acknowledged, "{history}");
    assert!(items.iter().all(|item| item["state"] == "assessed"), "{history}");
}
