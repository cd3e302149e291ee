//! Export of a structure and import into another installation.

use std::collections::BTreeMap;
use std::io::{BufRead as _, BufReader, Write as _};
use std::net::TcpListener;

use serde_json::Value;
use sha2::Digest as _;

use crate::helpers::{problem, spawn, Service};
use crate::operations::world::{answers, fails, run, text, with_past, without};

/// Fields that differ between installations: times at which something was computed or noticed, and the largest grade of an alarm while it was
/// watched.
pub const OF_THE_INSTALLATION: [&str; 5] = ["assessed_at", "noticed_at", "created_at", "updated_at", "highest_grade"];

/// Compares the answers of two services field by field, except for some fields.
pub fn assert_same(expected: &BTreeMap<String, Value>, found: &BTreeMap<String, Value>, except: &[&str]) {
    for (path, expected) in expected {
        let (mut expected, mut found) = (expected.clone(), found.get(path).cloned().unwrap_or(Value::Null));
        without(&mut expected, except);
        without(&mut found, except);
        assert_eq!(expected, found, "{path}");
    }
    assert_eq!(expected.len(), found.len());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn another_installation_answers_the_same_to_the_last_bit() {
    let (mut service, folder) = spawn();
    with_past(&service, 8).await;
    let expected = answers(&service).await;
    let elsewhere = tempfile::tempdir().unwrap();
    let (online, offline) = (elsewhere.path().join("online.ndjson"), elsewhere.path().join("offline.ndjson"));
    let url = format!("http://{}", service.address());
    let data_dir = text(folder.path());
    run(&["export", "--structure", "three-dof", "--data-dir", data_dir, "--url", &url, "--out", text(&online)]).await;
    service.stop("TERM");
    run(&["export", "--structure", "three-dof", "--data-dir", data_dir, "--out", text(&offline)]).await;
    let lines = |path| std::fs::read_to_string(path).unwrap().lines().map(str::to_owned).collect::<Vec<_>>();
    let (online_lines, offline_lines) = (lines(&online), lines(&offline));
    // The first and the last line contain the time of the export.
    assert_eq!(online_lines[1..online_lines.len() - 1], offline_lines[1..offline_lines.len() - 1]);

    let target = elsewhere.path().join("data");
    std::fs::create_dir(&target).unwrap();
    let import = ["import", "--from", text(&online), "--data-dir", text(&target), "--json"];
    let done: Value = serde_json::from_str(&run(&import).await).unwrap();
    assert_eq!((&done["batches"], &done["batches_new"]), (&10.into(), &10.into()), "{done}");
    assert_eq!((&done["undamaged_states"], &done["maintenance_windows"]), (&1.into(), &1.into()), "{done}");
    assert_eq!(done["acknowledgements"], 1, "{done}");
    assert_eq!((&done["alarm_actions"], &done["notes"]), (&3.into(), &1.into()), "{done}");
    assert_eq!(done["warnings"], serde_json::json!([]), "{done}");
    let mut second = Service::start(&target);
    assert_same(&expected, &answers(&second).await, &OF_THE_INSTALLATION);
    second.stop("TERM");

    // A second import changes nothing.
    let again: Value = serde_json::from_str(&run(&import).await).unwrap();
    for what in [
        "versions",
        "models",
        "batches_new",
        "undamaged_states",
        "maintenance_windows",
        "acknowledgements",
        "alarm_actions",
        "notes",
    ] {
        assert_eq!(again[what], 0, "{what}: {again}");
    }
    assert_same(&expected, &answers(&Service::start(&target)).await, &OF_THE_INSTALLATION);
}

#[tokio::test]
async fn an_incomplete_or_altered_archive_is_refused_with_its_line() {
    let (service, folder) = spawn();
    with_past(&service, 4).await;
    let file = folder.path().join("export.ndjson");
    let url = format!("http://{}", service.address());
    run(&[
        "export",
        "--structure",
        "three-dof",
        "--data-dir",
        text(folder.path()),
        "--url",
        &url,
        "--out",
        text(&file),
    ])
    .await;
    let whole = std::fs::read_to_string(&file).unwrap();
    let lines: Vec<&str> = whole.lines().collect();
    let refused = async |content: String| {
        let target = tempfile::tempdir().unwrap();
        let file = target.path().join("changed.ndjson");
        std::fs::write(&file, content).unwrap();
        let data_dir = target.path().join("data");
        std::fs::create_dir(&data_dir).unwrap();
        let said = fails(&["import", "--from", text(&file), "--data-dir", text(&data_dir)]).await;
        let second = Service::start(&data_dir);
        let history = second.read("/v1/structures/three-dof/history").await;
        assert_eq!(history["items"], serde_json::json!([]), "something was stored");
        said
    };
    let cut = refused(lines[..lines.len() - 1].join("\n") + "\n").await;
    assert!(cut.contains("its last line is missing"), "{cut}");
    let half = refused(whole[..whole.len() / 2].to_owned()).await;
    assert!(half.contains("line ") && half.contains("not a record of an archive"), "{half}");
    let dropped = [&lines[..5], &lines[6..]].concat().join("\n") + "\n";
    assert!(refused(dropped).await.contains("incomplete or was changed"));
    let empty = refused(String::new()).await;
    assert!(empty.contains("incomplete or was changed"), "{empty}");

    // Changed by somebody who also adapts the checksum: what cannot be read is refused before anything is stored.
    let changed = |from: &str, to: &str| {
        assert!(whole.contains(from), "{from} is not in the archive");
        let body: String = lines[..lines.len() - 1].iter().map(|line| line.replace(from, to) + "\n").collect();
        let mut end: serde_json::Value = serde_json::from_str(lines[lines.len() - 1]).unwrap();
        end["sha256"] = serde_json::json!(data_encoding::HEXLOWER.encode(&sha2::Sha256::digest(body.as_bytes())));
        body + &end.to_string() + "\n"
    };
    let intact = changed("\"record\":\"archive\"", "\"record\":\"archive\"");
    assert_eq!(intact.lines().count(), lines.len());
    for (from, to) in [("\"doubts\":\"[", "\"doubts\":\"}{["), ("\"conditions\":\"{", "\"conditions\":\"[{")] {
        let said = refused(changed(from, to)).await;
        assert!(said.contains("line ") && said.contains("undamaged reference"), "{said}");
    }

    // The same for each time that an archive carries beside the batches: a month 13 is found before the structure is stored.
    for kind in ["maintenance", "acknowledgement", "alarm_action", "note"] {
        let position = lines.iter().position(|line| line.contains(&format!("\"record\":\"{kind}\""))).unwrap();
        let record: serde_json::Map<String, Value> = serde_json::from_str(lines[position]).unwrap();
        let is_time = |value: &&Value| value.as_str().is_some_and(|text| text.parse::<jiff::Timestamp>().is_ok());
        let times: Vec<&str> = record.values().filter(is_time).filter_map(Value::as_str).collect();
        assert!(!times.is_empty(), "{kind}");
        for time in times {
            let wrong = lines[position].replacen(time, &time.replacen("2026-", "2026-13", 1), 1);
            let said = refused(changed(lines[position], &wrong)).await;
            assert!(said.contains("line "), "{kind} at {time}: {said}");
        }
    }

    let unknown = service.get("/v1/structures/bridge/export").send().await.unwrap();
    problem(unknown, 404, "unknown_structure").await;
    let out = folder.path().join("never.ndjson");
    fails(&["export", "--structure", "bridge", "--data-dir", text(folder.path()), "--url", &url, "--out", text(&out)])
        .await;
    assert!(!out.exists(), "an incomplete file was left behind");
}

/// Answers one connection after the other with texts, which are HTTP as it is sent; returns the URL.
fn answering(answers: &'static [&'static str]) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    std::thread::spawn(move || {
        for answer in answers {
            let (mut stream, _) = listener.accept().unwrap();
            let request = BufReader::new(stream.try_clone().unwrap());
            let head = request.lines().take_while(|line| line.as_ref().is_ok_and(|line| !line.is_empty()));
            assert!(head.count() > 1);
            stream.write_all(answer.as_bytes()).unwrap();
        }
    });
    url
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_export_that_breaks_begins_again_and_one_that_is_refused_then_leaves_no_file() {
    const AWAY: &str =
        "HTTP/1.1 503 Service Unavailable\r\nretry-after: 0\r\nconnection: close\r\ncontent-length: 26\r\n\r\n\
                        {\"detail\":\"nobody serves\"}";
    const BROKEN: &str = "HTTP/1.1 200 OK\r\ntransfer-encoding: chunked\r\n\r\n15\r\na longer line, and...\r\n";
    const WHOLE: &str = "HTTP/1.1 200 OK\r\nconnection: close\r\ncontent-length: 6\r\n\r\nwhole\n";
    const REFUSED: &str =
        "HTTP/1.1 404 Not Found\r\nconnection: close\r\ncontent-length: 25\r\n\r\n{\"detail\":\"was deleted\"}\n";
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("bridge.ndjson");
    let export = |url: &str| ["export", "--structure", "bridge", "--url", url, "--out", text(&out)].map(str::to_owned);

    let refused = export(&answering(&[BROKEN, REFUSED]));
    let said = fails(&refused.each_ref().map(String::as_str)).await;
    assert!(said.contains("broke") && said.contains("was deleted"), "{said}");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "nothing is left of what had arrived");

    let given = export(&answering(&[AWAY, BROKEN, AWAY, WHOLE]));
    run(&given.each_ref().map(String::as_str)).await;
    assert_eq!(std::fs::read_to_string(&out).unwrap(), "whole\n");
}
