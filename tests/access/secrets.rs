//! No secret is ever stored in plain text: not in the log at its most verbose level, not in the database, not in the
//! metrics.

use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::Stdio;

use reqwest::Method;
use serde_json::{json, Value};

use crate::access::world::{first_token, id_of, program};
use crate::helpers::command;

fn contains(haystack: &[u8], needle: &str) -> bool {
    haystack.windows(needle.len()).any(|window| window == needle.as_bytes())
}

/// All files of the data folder, those of the write-ahead log included.
fn files(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let entries = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    entries.map(|path| (path.display().to_string(), std::fs::read(&path).unwrap())).collect()
}

#[tokio::test]
async fn no_secret_is_in_log_database_or_metrics() {
    let folder = tempfile::tempdir().unwrap();
    let (data, log) = (folder.path().join("data"), folder.path().join("log"));
    std::fs::create_dir(&data).unwrap();
    let first = first_token(&data);
    let file = folder.path().join("admin");
    assert!(program(&["token", "file", file.to_str().unwrap()], &data).status.success());
    let from_file = std::fs::read_to_string(&file).unwrap().trim().to_owned();

    let mut command = command(&data);
    command.env("MODALWATCH__LOG__LEVEL", "trace").env("MODALWATCH_ADMIN_TOKEN_FILE", &file);
    let mut child = command.stdout(Stdio::piped()).stderr(std::fs::File::create(&log).unwrap()).spawn().unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    let url = line.trim().split_once("listens on ").unwrap().1.to_owned();
    let (client, mut secrets) =
        (modalwatch::notify::client_builder().build().unwrap(), vec![first.clone(), from_file.clone()]);
    let ask =
        |method: Method, path: &str, token: &str| client.request(method, format!("{url}{path}")).bearer_auth(token);

    let body = json!({ "name": "gateway", "scopes": ["read"] });
    let made: Value = ask(Method::POST, "/v1/tokens", &first).json(&body).send().await.unwrap().json().await.unwrap();
    secrets.push(made["token"].as_str().unwrap().to_owned());
    let rotation = format!("/v1/tokens/{}/rotation", id_of(&secrets[2]));
    let rotated = ask(Method::POST, &rotation, &from_file).json(&json!({ "overlap_s": 60 })).send().await.unwrap();
    let rotated: Value = rotated.json().await.unwrap();
    secrets.push(rotated["token"].as_str().unwrap().to_owned());
    let elsewhere = tempfile::tempdir().unwrap();
    let unknown = first_token(elsewhere.path());
    secrets.push(unknown.clone());
    let mut statuses = Vec::new();
    for (path, token) in [
        ("/v1/structures".to_owned(), &secrets[2]),
        ("/v1/structures".to_owned(), &secrets[3]),
        ("/v1/structures".to_owned(), &unknown),
        (format!("/v1/structures?token={unknown}"), &first),
        (format!("/v1/structures/{first}"), &first),
    ] {
        let request = ask(Method::GET, &path, token).header("x-request-id", token.chars().take(40).collect::<String>());
        statuses.push(request.send().await.unwrap().status().as_u16());
    }
    assert_eq!(statuses, [200, 200, 401, 400, 400]);
    let mistake = json!({ "name": format!("old: {first}"), "scopes": ["read"] });
    assert_eq!(ask(Method::POST, "/v1/tokens", &first).json(&mistake).send().await.unwrap().status(), 422);
    let metrics = ask(Method::GET, "/metrics", &first).send().await.unwrap().text().await.unwrap();

    let while_running = files(&data);
    let status = std::process::Command::new("kill").args(["-TERM", &child.id().to_string()]).status().unwrap();
    let ended = child.wait().unwrap();
    assert!(status.success() && ended.success(), "{ended}");
    let log = std::fs::read(&log).unwrap();
    assert!(log.len() > 2_000, "the log should be verbose: {} bytes", log.len());
    let database: Vec<_> = while_running.into_iter().chain(files(&data)).collect();
    assert!(database.iter().any(|(_, bytes)| contains(bytes, id_of(&secrets[2]))), "the ids are in the database");
    for secret in &secrets {
        // The second half of a token would be sufficient for an attacker who has the first.
        let secret = &secret.rsplit('_').next().unwrap()[26..];
        assert!(!contains(&log, secret), "a secret is in the log");
        assert!(!contains(metrics.as_bytes(), secret), "a secret is in the metrics");
        for (name, bytes) in &database {
            assert!(!contains(bytes, secret), "a secret is in {name}");
        }
    }
}
