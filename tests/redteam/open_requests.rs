//! Requests that go on while their token is taken away.

use std::io;
use std::time::Duration;

use reqwest::{Method, Response};
use serde_json::{json, Value};
use tokio::sync::mpsc::{channel, Sender};
use tokio::task::JoinHandle;

use crate::helpers::{created, eventually, measurements, of_two_masses, problem, TWO_MASSES};
use crate::redteam::target::{id_of, Target};

const BATCHES: &str = "/v1/structures/three-dof/batches";

const PATIENCE: Duration = Duration::from_mins(1);

/// Number of stored batches.
async fn stored(target: &Target) -> usize {
    let path = "/v1/structures/three-dof/history?limit=1000";
    let history = target.ask(Method::GET, path, Some(&target.admin), PATIENCE).send().await.unwrap();
    history.json::<Value>().await.unwrap()["items"].as_array().unwrap().len()
}

async fn revoke(target: &Target, token: &str) {
    let path = format!("/v1/tokens/{}", id_of(token));
    let revoked = target.ask(Method::DELETE, &path, Some(&target.admin), PATIENCE).send().await.unwrap();
    assert_eq!(revoked.status(), 200);
}

/// A line of NDJSON with a batch of this day.
fn line(day: usize) -> String {
    format!("{}\n", json!({ "measurements": measurements([4.0, 5.0, 6.0], 2, 86_400 * day) }))
}

/// The lines of a post that are still to be sent, and its answer.
type OpenPost = (Sender<io::Result<String>>, JoinHandle<reqwest::Result<Response>>);

/// A post of NDJSON that is open: its first line is stored.
async fn open_post(target: &Target, token: &str, day: usize) -> OpenPost {
    let before = stored(target).await;
    let (lines, receiver) = channel::<io::Result<String>>(1);
    let body = futures_util::stream::unfold(receiver, |mut receiver| async {
        receiver.recv().await.map(|line| (line, receiver))
    });
    let request = target.ask(Method::POST, BATCHES, Some(token), PATIENCE);
    let request = request.header("content-type", "application/x-ndjson").body(reqwest::Body::wrap_stream(body));
    let answer = tokio::spawn(request.send());
    lines.send(Ok(line(day))).await.unwrap();
    eventually("the first line is stored", async || (stored(target).await > before).then_some(())).await;
    (lines, answer)
}

/// Sends another line; the post must end with this problem, which says that only the first line was stored.
async fn ends((lines, answer): OpenPost, day: usize, code: &str) {
    lines.send(Ok(line(day))).await.unwrap();
    drop(lines);
    let answer = problem(answer.await.unwrap().unwrap(), 401, code).await;
    let done = &answer["done"];
    assert_eq!((&done["stored"], &done["refused"], &done["items"][0]["status"]), (&json!(1), &json!(0), &json!(201)));
}

#[tokio::test]
async fn a_post_takes_no_line_after_its_token_was_revoked_or_rotated_or_has_expired() {
    let target = Target::start(&[]);
    let token = target.token("ingest", &[]).await;
    let open = open_post(&target, &token, 1).await;
    revoke(&target, &token).await;
    ends(open, 2, "token_revoked").await;
    assert_eq!(stored(&target).await, 1);

    let token = target.token("ingest", &[]).await;
    let open = open_post(&target, &token, 3).await;
    let rotation = format!("/v1/tokens/{}/rotation", id_of(&token));
    created(target.post(&rotation, &target.admin, &json!({ "overlap_s": 0 })).await).await;
    ends(open, 4, "token_expired").await;
    assert_eq!(stored(&target).await, 2);

    let soon = jiff::Timestamp::now() + Duration::from_secs(8);
    let body = json!({ "name": "short", "scopes": ["ingest"], "expires_at": soon.to_string() });
    let made = created(target.post("/v1/tokens", &target.admin, &body).await).await;
    let token = made["token"].as_str().unwrap();
    let open = open_post(&target, token, 5).await;
    eventually("the token has expired", async || {
        (target.post(BATCHES, token, &json!({})).await.status() == 401).then_some(())
    })
    .await;
    ends(open, 6, "token_expired").await;
    assert_eq!(stored(&target).await, 3);
}

#[tokio::test]
async fn a_table_stores_no_batch_after_its_token_was_revoked() {
    // 400 rows at 20 a second: it would go on for 20 seconds.
    let slowly = [("http.rate_limit.measurements_per_s", "20"), ("monitor.max_measurements", "20")];
    let target = Target::start(&slowly);
    let token = target.token("ingest", &[]).await;
    let row = |measurement: &Value| {
        let f = |mode: usize| measurement["frequencies_hz"][mode].as_f64().unwrap();
        format!("{},{},{},{}\n", measurement["measured_at"].as_str().unwrap(), f(0), f(1), f(2))
    };
    let rows: Vec<String> = measurements([4.0, 5.0, 6.0], 400, 0).iter().map(row).collect();
    let table = format!("measured_at,f1_hz,f2_hz,f3_hz\n{}", rows.concat());
    let request = target.ask(Method::POST, &format!("{BATCHES}?split=1h"), Some(&token), PATIENCE);
    let answer = tokio::spawn(request.header("content-type", "text/csv").body(table).send());
    eventually("a part is stored", async || (stored(&target).await > 0).then_some(())).await;
    revoke(&target, &token).await;
    let answer = problem(answer.await.unwrap().unwrap(), 401, "token_revoked").await;
    let done = answer["done"]["stored"].as_u64().unwrap();
    assert!(done < 60, "{done} of 67 batches are stored");
    assert_eq!(stored(&target).await as u64, done);
}

#[tokio::test]
async fn a_download_is_broken_off_when_its_token_is_revoked() {
    let target = Target::start(&[("monitor.training", "on_request")]);
    let put = target.ask(Method::PUT, "/v1/structures/tiny", Some(&target.admin), PATIENCE);
    created(put.header("content-type", "application/toml").body(TWO_MASSES).send().await.unwrap()).await;
    // Megabytes, of which the system takes a few hundred kilobytes from the service before somebody reads them.
    for batch in 0..8 {
        let body = json!({ "measurements": of_two_masses(5_000, 300_000 * batch) });
        created(target.post("/v1/structures/tiny/batches", &target.admin, &body).await).await;
    }
    for path in ["measurements?format=ndjson", "measurements?format=csv", "export"] {
        let token = target.token("read", &["tiny"]).await;
        let path = format!("/v1/structures/tiny/{path}");
        let mut file = target.ask(Method::GET, &path, Some(&token), PATIENCE).send().await.unwrap();
        assert_eq!(file.status(), 200, "{path}");
        file.chunk().await.unwrap().unwrap();
        revoke(&target, &token).await;
        let end = loop {
            match file.chunk().await {
                Ok(Some(_)) => {}
                end => break end,
            }
        };
        assert!(end.is_err(), "{path} goes on to its end");
    }
}
