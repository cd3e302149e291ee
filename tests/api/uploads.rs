//! Tables posted by HTTP and by `modalwatch post`: cut into batches, previewed, sent as a form, posted twice.

use std::fmt::Write as _;
use std::path::Path;
use std::process::{Command, Output};

use reqwest::Method;
use serde_json::{json, Value};

use crate::helpers::{created, measurements, problem, spawn, Service};

const BATCHES: &str = "/v1/structures/three-dof/batches";
const PREVIEW: &str = "/v1/structures/three-dof/tables/preview";
const DAY_S: usize = 86_400;

/// Measurements of some days, four a day, as a German spreadsheet writes them, in UTC.
fn german(days: usize) -> String {
    let mut table = "Datum;Uhrzeit;Mode 1 (Hz);Mode 2 (Hz);Mode 3 (Hz);Bemerkung\r\n".to_owned();
    for row in rows(days) {
        let time = row["measured_at"].as_str().unwrap();
        let date = [&time[8..10], &time[5..7], &time[..4]].join(".");
        let f: Vec<String> = row["frequencies_hz"].as_array().unwrap().iter().map(Value::to_string).collect();
        write!(table, "{date};{};{};ok\r\n", &time[11..16], f.join(";").replace('.', ",")).unwrap();
    }
    table
}

fn rows(days: usize) -> Vec<Value> {
    (0..days).flat_map(|day| measurements([4.0, 5.0, 6.0], 4, day * DAY_S)).collect()
}

async fn many(service: &Service, query: &str, table: impl Into<reqwest::Body>) -> Value {
    let response = service.post_text(&format!("{BATCHES}?{query}"), "text/csv", table).await;
    let (status, body): (_, Value) = (response.status(), response.json().await.unwrap());
    assert_eq!(status, 200, "{body}");
    body
}

async fn batches(service: &Service) -> usize {
    let history = service.read("/v1/structures/three-dof/history?limit=1000").await;
    history["items"].as_array().unwrap().len()
}

const GERMAN: &str = "zone=UTC&ignore=Bemerkung";

#[tokio::test]
async fn a_table_is_cut_into_days_and_posting_it_again_stores_nothing() {
    let (service, _folder) = spawn();
    let answer = many(&service, &format!("split=1d&{GERMAN}"), german(5)).await;
    assert_eq!(
        (&answer["stored"], &answer["replayed"], &answer["refused"]),
        (&json!(5), &json!(0), &json!(0)),
        "{answer}"
    );
    assert_eq!(answer["items"][1]["line"], 6, "{answer}");
    assert_eq!(answer["items"][1]["from"], "2026-01-02T00:00:00Z");
    let table = &answer["table"];
    assert_eq!(
        (&table["separator"], &table["decimal_sign"], &table["zone"]),
        (&json!(";"), &json!(","), &json!("UTC"))
    );
    assert_eq!((&table["rows"], &table["accepted"], &table["refused"]), (&json!(20), &json!(20), &json!(0)));
    let roles: Vec<&str> = table["columns"].as_array().unwrap().iter().map(|c| c["role"].as_str().unwrap()).collect();
    assert_eq!(roles, ["time", "time", "mode", "mode", "mode", "ignored"]);
    assert_eq!(batches(&service).await, 5);

    let again = many(&service, &format!("split=1d&{GERMAN}"), german(5)).await;
    assert_eq!((&again["stored"], &again["replayed"]), (&json!(0), &json!(5)), "{again}");
    for (item, first) in again["items"].as_array().unwrap().iter().zip(answer["items"].as_array().unwrap()) {
        assert_eq!(item["batch"], first["batch"]);
    }
    // A day as JSON is the same batch, whichever way it came first.
    let json = service.post(BATCHES, &json!({ "measurements": rows(5)[4..8] })).await;
    assert!(json.headers().contains_key("idempotency-replayed"));
    assert_eq!(created(json).await["batch"], answer["items"][1]["batch"]);
    // A longer file adds only its new days.
    let longer = many(&service, &format!("split=1d&{GERMAN}"), german(7)).await;
    assert_eq!((&longer["stored"], &longer["replayed"]), (&json!(2), &json!(5)), "{longer}");
    assert_eq!(batches(&service).await, 7);
}

#[tokio::test]
async fn a_table_of_more_than_two_days_is_refused_without_a_rule_and_nothing_is_stored() {
    let (service, _folder) = spawn();
    let long = service.post_text(&format!("{BATCHES}?{GERMAN}"), "text/csv", german(4)).await;
    let refused = problem(long, 422, "invalid").await;
    assert_eq!(refused["errors"][0]["pointer"], "query/split");
    assert!(refused["detail"].as_str().unwrap().contains("write split=1d for a batch a day"), "{refused}");
    assert_eq!(batches(&service).await, 0);
    let short = service.post_text(&format!("{BATCHES}?{GERMAN}"), "text/csv", german(2)).await;
    let short = created(short).await;
    assert_eq!((&short["measurement_count"], &short["table"]["accepted"]), (&json!(8), &json!(8)), "{short}");
    // JSON says itself what a batch is.
    created(service.post(&format!("{BATCHES}?source=json"), &json!({ "measurements": rows(4) })).await).await;
    let one = many(&service, &format!("split=none&source=whole&{GERMAN}"), german(4)).await;
    assert_eq!(one["items"][0]["measurements"], 16, "{one}");
}

#[tokio::test]
async fn rows_that_cannot_be_used_are_left_out_and_listed_or_refuse_the_table() {
    let (service, _folder) = spawn();
    let mut table = german(3);
    for minute in 0..150 {
        write!(table, "05.01.2026;{:02}:{:02};0,4;abc;0,9;ok\r\n", minute / 60, minute % 60).unwrap();
    }
    let path = format!("{BATCHES}?split=1d&strict=true&{GERMAN}");
    let strict = problem(service.post_text(&path, "text/csv", table.clone()).await, 422, "invalid").await;
    assert_eq!(strict["errors"].as_array().unwrap().len(), 21);
    assert_eq!(strict["errors"][0]["pointer"], "line 14, column Mode 2 (Hz)");
    assert_eq!(strict["errors"][20]["message"], "and 130 more problems");
    assert_eq!(batches(&service).await, 0);

    let answer = many(&service, &format!("split=1d&{GERMAN}"), table).await;
    let understood = &answer["table"];
    assert_eq!(
        (&understood["rows"], &understood["accepted"], &understood["refused"]),
        (&json!(162), &json!(12), &json!(150))
    );
    assert_eq!(understood["refused_rows"].as_array().unwrap().len(), 100);
    let first = json!({ "line": 14, "column": "Mode 2 (Hz)", "reason": "\"abc\" is not a number" });
    assert_eq!(understood["refused_rows"][0], first);
    assert_eq!(answer["stored"], 3);
    let none = service.post_text(&format!("{BATCHES}?split=1d"), "text/csv", "time,f1,f2,f3\nnoon,1,1,1\n").await;
    assert!(problem(none, 422, "invalid").await["detail"].as_str().unwrap().contains("none of the 1 rows can be used"));
}

#[tokio::test]
async fn a_key_of_the_request_names_the_batches_and_other_content_is_noticed() {
    let (service, _folder) = spawn();
    let post = async |table: String| {
        let request = service.request(Method::POST, &format!("{BATCHES}?split=1d&{GERMAN}"));
        let request = request.header("idempotency-key", "January").header("content-type", "text/csv").body(table);
        request.send().await.unwrap().json::<Value>().await.unwrap()
    };
    assert_eq!(post(german(3)).await["stored"], 3);
    assert_eq!(post(german(3)).await["replayed"], 3);
    let changed = post(german(3).replacen("0,4", "0,5", 1)).await;
    assert_eq!((&changed["replayed"], &changed["refused"]), (&json!(2), &json!(1)), "{changed}");
    assert_eq!(changed["items"][0]["problem"]["code"], "idempotency_key_reused");
}

#[tokio::test]
async fn a_preview_says_what_would_be_made_and_stores_nothing() {
    let (service, _folder) = spawn();
    let preview = async |query: &str, table: String| -> Value {
        let response = service.post_text(&format!("{PREVIEW}?{query}"), "text/csv", table).await;
        assert_eq!(response.status(), 200);
        response.json().await.unwrap()
    };
    let asked = preview("", german(5)).await;
    assert_eq!(asked["needs"], json!(["zone", "columns"]), "{asked}");
    assert_eq!(asked["understood"]["columns"][5]["role"], "unknown");
    assert_eq!(asked["understood"]["columns"][5]["examples"], json!(["ok", "ok", "ok"]));
    let split = preview(GERMAN, german(5)).await;
    assert_eq!(split["needs"], json!(["split"]));
    let ready = preview(&format!("split=1d&{GERMAN}"), german(5)).await;
    assert_eq!((&ready["needs"], &ready["problems"]), (&json!([]), &json!([])), "{ready}");
    let second = json!({ "line": 6, "from": "2026-01-02T00:00:00Z", "to": "2026-01-02T00:30:00Z", "measurements": 4 });
    assert_eq!((ready["batches"].as_array().unwrap().len(), &ready["batches"][1]), (5, &second));
    assert!(ready["targets"].as_array().unwrap().contains(&json!("set_k1")));
    assert_eq!(batches(&service).await, 0);
    problem(service.post_text(PREVIEW, "application/json", "{}").await, 415, "unsupported_media_type").await;
    problem(service.post_text(&format!("{PREVIEW}?zone=Mars"), "text/csv", german(1)).await, 422, "invalid").await;
}

/// A form as a browser sends it; `parts` are headers and content.
fn form(parts: &[(&str, &str)]) -> String {
    let part = |(header, content): &(&str, &str)| {
        format!("--x7\r\nContent-Disposition: form-data; {header}\r\n\r\n{content}\r\n")
    };
    parts.iter().map(part).collect::<String>() + "--x7--\r\n"
}

#[tokio::test]
async fn a_form_with_one_file_is_taken_and_any_other_is_refused() {
    let (service, _folder) = spawn();
    let table = german(3);
    let file = "name=\"file\"; filename=\"messung.csv\"";
    let kind = "multipart/form-data; boundary=x7";
    let path = format!("{BATCHES}?split=1d&{GERMAN}");
    let answer = service.post_text(&path, kind, form(&[(file, &table)])).await.json::<Value>().await.unwrap();
    assert_eq!(answer["stored"], 3, "{answer}");
    for (parts, words) in [
        (&[][..], "the form has no file"),
        (&[(file, "a"), (file, "b")][..], "more than one file"),
        (
            &[("name=\"split\"", "1d"), (file, &table)][..],
            "\\\"split\\\" is not a file: options such as split and zone are in the query",
        ),
    ] {
        let refused = problem(service.post_text(&path, kind, form(parts)).await, 422, "invalid").await;
        assert!(refused.to_string().contains(words), "{refused}");
    }
    let broken = problem(service.post_text(&path, kind, "--x7\r\nnothing").await, 422, "invalid").await;
    assert!(broken["detail"].as_str().unwrap().contains("the form cannot be read"), "{broken}");
    let bare =
        problem(service.post_text(&path, "multipart/form-data", form(&[(file, &table)])).await, 422, "invalid").await;
    assert!(bare["detail"].as_str().unwrap().contains("needs a boundary"), "{bare}");
}

/// Runs `modalwatch post` against a service.
fn post(service: &Service, file: &Path, more: &[&str]) -> Output {
    let url = format!("http://{}", service.address());
    let mut command = Command::new(env!("CARGO_BIN_EXE_modalwatch"));
    command.args(["post", "--url", &url, "--structure", "three-dof"]).args(more).arg(file);
    command.output().unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_command_line_posts_a_table_says_what_it_understood_and_stores_once() {
    let (service, _folder) = spawn();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("messung.csv");
    std::fs::write(
        &file,
        format!("{}06.01.2026;12:00;n/a;-;;ok\r\n", german(5)).replace("Mode 1 (Hz)", "Erste Biegung, gemessen"),
    )
    .unwrap();
    let run = |more: &[&str]| {
        let output = post(&service, &file, more);
        let (out, err) = (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap());
        (output.status.success(), out, err)
    };
    let (done, _, err) = run(&[]);
    assert!(!done);
    for words in [
        "line 2, column Datum: ",
        "(--zone on the command line)",
        "unknown column \"Bemerkung\": write ignore=Bemerkung",
        "missing column f1_hz",
    ] {
        assert!(err.contains(words), "{words}: {err}");
    }
    let named = ["--zone", "UTC", "--ignore", "Bemerkung", "--column", "f1=#3"];
    let (done, out, err) = run(&[&named[..], &["--preview"]].concat());
    assert!(!done && err.contains("--split: the 20 measurements span"), "{out}{err}");
    let split = [&named[..], &["--split", "1d"]].concat();
    let (done, out, err) = run(&[&split[..], &["--preview"]].concat());
    assert!(done && out.contains("2026-01-02T00:00:00Z to 2026-01-02T00:30:00Z: 4 measurements"), "{out}{err}");
    assert_eq!(batches(&service).await, 0);
    let (done, _, err) = run(&[&split[..], &["--strict"]].concat());
    assert!(!done && err.contains("line 22: all modes are missing: omit the measurement"), "{err}");
    assert_eq!(batches(&service).await, 0);

    let (done, out, err) = run(&split);
    assert!(done, "{err}");
    for words in [
        "cells separated by ';', decimal sign ','",
        "times in the zone UTC",
        "\"Erste Biegung, gemessen\" -> f1_hz (read as f1, as asked; in Hz, because the header names no unit)",
        "\"Mode 2 (Hz)\" -> f2_hz (mode 2 by its name; in Hz, as the header says)",
        "21 rows: 20 accepted, 1 refused",
        "line 22: all modes are missing: omit the measurement",
        "5 batches stored, 0 already there, 0 refused",
    ] {
        assert!(out.contains(words), "{words}: {out}");
    }
    let (done, out, _) = run(&split);
    assert!(done && out.contains("0 batches stored, 5 already there, 0 refused"), "{out}");
    assert_eq!(batches(&service).await, 5);
    let (done, out, _) = run(&[&split[..], &["--json"]].concat());
    assert!(done && serde_json::from_str::<Value>(&out).unwrap()["replayed"] == 5, "{out}");

    // Other rows at times that are stored: the exit status says so.
    std::fs::write(&file, german(1).replacen("0,4", "0,5", 1)).unwrap();
    let (done, _, err) = run(&["--zone", "UTC", "--ignore", "Bemerkung", "--split", "1d"]);
    assert!(!done && err.contains("batches refused: 1\n") && err.contains("line 2"), "{err}");
    let nowhere = post(&service, Path::new("no-such-file.csv"), &[]);
    assert!(
        !nowhere.status.success() && String::from_utf8_lossy(&nowhere.stderr).contains("cannot read no-such-file.csv")
    );
}
