//! Export of raw measurements: pages, files, and importing them again.

use std::collections::BTreeSet;

use reqwest::Method;
use serde_json::{json, Value};

use crate::helpers::{created, measurements, of_two_masses, problem, spawn, time, Service, TWO_MASSES};

const MEASUREMENTS: &str = "/v1/structures/three-dof/measurements";
const BATCHES: &str = "/v1/structures/three-dof/batches";

/// Batches whose times overlap: 4 sources of 7 measurements each, and one batch with all optional fields.
async fn with_batches() -> (Service, tempfile::TempDir) {
    let (service, folder) = spawn();
    for source in 0..4 {
        let body = json!({
            "source": format!("s{source}"), "measurements": measurements([4.0, 5.0, 6.0], 7, source * 1_000),
        });
        created(service.post(BATCHES, &body).await).await;
    }
    let full = json!({ "source": "full", "measurements": [{
        "measured_at": time(90_000), "frequencies_hz": [0.4949, null, 1.2434], "std_hz": [0.001, null, null],
        "settings": { "k2": 5.0 },
    }]});
    created(service.post(BATCHES, &full).await).await;
    (service, folder)
}

async fn text(service: &Service, query: &str, content_type: &str) -> String {
    let answer = service.get(&format!("{MEASUREMENTS}?{query}")).send().await.unwrap();
    assert_eq!(answer.status(), 200, "{query}");
    assert!(answer.headers()["content-type"].to_str().unwrap().starts_with(content_type), "{query}");
    let ending = content_type.rsplit(['/', '-']).next().unwrap();
    let disposition = answer.headers()["content-disposition"].to_str().unwrap().to_owned();
    assert_eq!(disposition, format!("attachment; filename=\"three-dof-measurements.{ending}\""));
    answer.text().await.unwrap()
}

#[tokio::test]
async fn pages_walk_every_measurement_once() {
    let (service, _folder) = with_batches().await;
    let all = service.read(&format!("{MEASUREMENTS}?limit=1000")).await;
    let all = all["items"].as_array().unwrap().clone();
    assert_eq!(all.len(), 29);
    let keys: BTreeSet<String> = all.iter().map(|m| format!("{} {}", m["source"], m["measured_at"])).collect();
    assert_eq!(keys.len(), 29);
    let full = all.last().unwrap();
    assert_eq!(full["frequencies_hz"], json!([0.4949, null, 1.2434]));
    assert_eq!((&full["std_hz"], &full["settings"]), (&json!([0.001, null, null]), &json!({ "k2": 5.0 })));
    // Pages that end inside batches and at the ends of batches.
    for limit in [1, 3, 7, 28, 29] {
        let (mut walked, mut path) = (Vec::new(), format!("{MEASUREMENTS}?limit={limit}"));
        for _ in 0..40 {
            let response = service.get(&path).send().await.unwrap();
            let link = response.headers().get("link").map(|l| l.to_str().unwrap().to_owned());
            let page: Value = response.json().await.unwrap();
            walked.extend(page["items"].as_array().unwrap().clone());
            assert_eq!(link.is_some(), page["next"].is_string());
            let Some(link) = link else { break };
            path = link.split(['<', '>']).nth(1).unwrap().to_owned();
        }
        assert_eq!(walked, all, "limit {limit}");
    }
}

#[tokio::test]
async fn a_window_cuts_by_the_time_of_the_measurement_not_of_its_batch() {
    let (service, _folder) = with_batches().await;
    let (from, to) = (time(1_200), time(3_600));
    let page = service.read(&format!("{MEASUREMENTS}?from={from}&to={to}&limit=1000")).await;
    let times: Vec<&str> =
        page["items"].as_array().unwrap().iter().map(|m| m["measured_at"].as_str().unwrap()).collect();
    // Four sources with a measurement each 600 s, beginning at 0, 1000, 2000 and 3000 s.
    assert_eq!(times.len(), 4 + 4 + 3 + 1, "{times:?}");
    assert!(times.iter().all(|t| (from.as_str()..to.as_str()).contains(t)), "{times:?}");
}

#[tokio::test]
async fn the_files_hold_the_same_and_csv_goes_back_in() {
    let (service, _folder) = with_batches().await;
    let all = service.read(&format!("{MEASUREMENTS}?limit=1000")).await;
    let lines = text(&service, "format=ndjson", "application/x-ndjson").await;
    let lines: Vec<Value> = lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(json!(lines), all["items"]);

    let table = text(&service, "format=csv", "text/csv").await;
    let header = "measured_at,source,batch,f1_hz,f2_hz,f3_hz,std_f1_hz,std_f2_hz,std_f3_hz,set_k1,set_k2,set_k3";
    assert_eq!(table.lines().next(), Some(header));
    assert_eq!(table.lines().count(), 30);
    let last = table.lines().last().unwrap();
    assert!(last.starts_with("2026-01-02T01:00:00Z,full,") && last.ends_with(",0.4949,,1.2434,0.001,,,,5,"), "{last}");

    let chosen = service.get(MEASUREMENTS).header("accept", "text/csv").send().await.unwrap().text().await.unwrap();
    assert_eq!(chosen, table);
    let limited = text(&service, "format=csv&limit=5", "text/csv").await;
    assert_eq!(limited.lines().collect::<Vec<_>>(), table.lines().take(6).collect::<Vec<_>>());
    let none = text(&service, "format=csv&from=2027-01-01T00:00:00Z", "text/csv").await;
    assert_eq!(none, format!("{header}\n"));

    // One source of the table, posted to a fresh service.
    let (other, _folder) = spawn();
    let rows: Vec<&str> = table.lines().filter(|l| l.starts_with("measured_at") || l.contains(",s2,")).collect();
    let path = format!("{BATCHES}?source=s2&ignore=source,batch");
    let posted = created(other.post_text(&path, "text/csv", rows.join("\n")).await).await;
    let original = service.read("/v1/structures/three-dof/history").await;
    let original = original["items"].as_array().unwrap().iter().find(|b| b["source"] == "s2").unwrap().clone();
    let original = service.read(&format!("{BATCHES}/{}", original["batch"].as_str().unwrap())).await;
    assert_eq!(posted["content_digest"], original["content_digest"]);
}

#[tokio::test]
async fn a_text_that_a_spreadsheet_would_compute_is_a_text_in_the_table_and_comes_back_as_it_was() {
    let (service, _folder) = spawn();
    let definition = json!({
        "id": "tower-1", "modes": 1,
        "mass": [{ "name": "m", "kg": 100.0 }],
        "spring": [{ "name": "k", "from": "ground", "to": "m" }],
        "parameter": [{ "name": "k", "prior": { "uniform": [1000.0, 9000.0] }, "sets": { "spring": "k" } }],
        "covariate": [{ "name": "operator", "kind": "category" }],
    });
    let put = service.request(reqwest::Method::PUT, "/v1/structures/tower-1").json(&definition);
    assert_eq!(put.send().await.unwrap().status(), 201);
    // Each with the cell that it is written to.
    let cells = [
        ("=HYPERLINK(1)", "'=HYPERLINK(1)"),
        ("+1", "'+1"),
        ("-1", "'-1"),
        ("@A1", "'@A1"),
        ("'=1", "''=1"),
        // A spreadsheet with German settings ends the cell at the semicolon, whether there are quotation marks or not.
        (";=1", "\";'=1\""),
        ("a;'-1", "\"a;''-1\""),
        (" =1", "' =1"),
        ("\u{feff}=1", "'\u{feff}=1"),
        ("\u{200b}+1", "'\u{200b}+1"),
        ("＝1", "'＝1"),
        ("ann", "ann"),
        ("a;b", "\"a;b\""),
    ];
    let texts = cells.map(|(text, _)| text);
    let one = |(index, text): (usize, &&str)| json!({ "measured_at": time(600 * index), "frequencies_hz": [1.1 + 0.001 * index as f64], "covariates": { "operator": text } });
    let sent: Vec<Value> = texts.iter().enumerate().map(one).collect();
    service.post_batch("tower-1", &sent).await;
    let path = "/v1/structures/tower-1/measurements?format=csv";
    let table = service.get(path).send().await.unwrap().text().await.unwrap();
    for (text, cell) in cells {
        assert!(table.contains(&format!(",{cell},")), "{text}: {table}");
        assert!(text == cell || !table.contains(&format!(",{text},")), "{text}: {table}");
    }

    let (other, _folder) = spawn();
    let put = other.request(reqwest::Method::PUT, "/v1/structures/tower-1").json(&definition);
    assert_eq!(put.send().await.unwrap().status(), 201);
    let posted = other.post_text("/v1/structures/tower-1/batches?ignore=source,batch", "text/csv", table).await;
    let batch = created(posted).await["batch"].clone();
    let stored = other.read(&format!("/v1/structures/tower-1/batches/{}", batch.as_str().unwrap())).await;
    let operators: Vec<&Value> =
        (stored["measurements"].as_array().unwrap().iter()).map(|m| &m["covariates"]["operator"]).collect();
    assert_eq!(json!(operators), json!(texts));
}

#[tokio::test]
async fn a_file_of_many_pages_is_complete() {
    let (service, _folder) = spawn();
    let mut sent = BTreeSet::new();
    for batch in 0..3 {
        let body =
            json!({ "source": format!("s{batch}"), "measurements": measurements([4.0, 5.0, 6.0], 1_500, batch * 60) });
        sent.extend(body["measurements"].as_array().unwrap().iter().map(|m| m["measured_at"].to_string()));
        created(service.post(BATCHES, &body).await).await;
    }
    let lines = text(&service, "format=ndjson", "application/x-ndjson").await;
    let read: Vec<Value> = lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(read.len(), 4_500);
    assert_eq!(read.iter().map(|m| m["measured_at"].to_string()).collect::<BTreeSet<_>>(), sent);
}

async fn define_two_masses(service: &Service) {
    let put = service.request(Method::PUT, "/v1/structures/tiny").header("content-type", "application/toml");
    assert_eq!(put.body(TWO_MASSES).send().await.unwrap().status(), 201);
}

#[tokio::test]
async fn a_file_of_a_structure_that_is_deleted_or_made_anew_meanwhile_is_broken_off() {
    let (service, _folder) = spawn();
    for (format, is_made_anew) in [("csv", false), ("ndjson", true)] {
        define_two_masses(&service).await;
        // Megabytes, of which the system takes a few hundred kilobytes from the service before somebody reads them.
        for batch in 0..8 {
            service.post_batch("tiny", &of_two_masses(5_000, 300_000 * batch)).await;
        }
        let path = format!("/v1/structures/tiny/measurements?format={format}");
        let mut file = service.get(&path).send().await.unwrap();
        assert_eq!(file.status(), 200);
        file.chunk().await.unwrap().unwrap();
        let deleted = service.request(Method::DELETE, "/v1/structures/tiny?confirm=tiny").send().await.unwrap();
        assert_eq!(deleted.status(), 200);
        if is_made_anew {
            define_two_masses(&service).await;
            service.post_batch("tiny", &of_two_masses(500, 0)).await;
        }
        let end = loop {
            match file.chunk().await {
                Ok(Some(_)) => {}
                end => break end,
            }
        };
        assert!(end.is_err(), "the {format} ends as if it were whole");
    }
    let whole = service.get("/v1/structures/tiny/measurements?format=csv").send().await.unwrap();
    assert_eq!(whole.text().await.unwrap().lines().count(), 501);
}

#[tokio::test]
async fn invalid_queries_are_refused_with_their_place() {
    let (service, _folder) = spawn();
    for (query, place) in [
        ("format=xml", "query/format"),
        ("limit=0", "query/limit"),
        ("from=now", "query/from"),
        ("cursor=1~2", "query/cursor"),
        ("parameter=k1", "query"),
    ] {
        let answer = service.get(&format!("{MEASUREMENTS}?{query}")).send().await.unwrap();
        assert_eq!(problem(answer, 422, "invalid").await["errors"][0]["pointer"], place, "{query}");
    }
    let unknown = service.get("/v1/structures/none/measurements").send().await.unwrap();
    problem(unknown, 404, "unknown_structure").await;
}

#[cfg(not(feature = "parquet"))]
#[tokio::test]
async fn parquet_that_is_not_built_in_is_a_406() {
    let (service, _folder) = spawn();
    for path in [MEASUREMENTS, "/v1/structures/three-dof/history"] {
        let answer = service.get(&format!("{path}?format=parquet")).send().await.unwrap();
        let body = problem(answer, 406, "not_acceptable").await;
        assert!(body["detail"].as_str().unwrap().contains("parquet"), "{body}");
    }
}

#[cfg(feature = "parquet")]
mod parquet_files {
    use bytes::Bytes;
    use parquet::file::reader::{FileReader as _, SerializedFileReader};
    use parquet::record::Field;

    use super::*;

    /// Rows of a Parquet answer as (column, value).
    async fn rows(service: &Service, path: &str) -> Vec<Vec<(String, Field)>> {
        let answer = service.get(path).send().await.unwrap();
        assert_eq!(answer.headers()["content-type"], "application/vnd.apache.parquet");
        let bytes: Bytes = answer.bytes().await.unwrap();
        let reader = SerializedFileReader::new(bytes).unwrap();
        let row = |row: parquet::record::Row| row.into_columns();
        reader.get_row_iter(None).unwrap().map(|r| row(r.unwrap())).collect()
    }

    fn cell<'a>(row: &'a [(String, Field)], name: &str) -> &'a Field {
        &row.iter().find(|(column, _)| column == name).unwrap().1
    }

    #[tokio::test]
    async fn measurements_are_read_back() {
        let (service, _folder) = with_batches().await;
        let all = service.read(&format!("{MEASUREMENTS}?limit=1000")).await;
        let all = all["items"].as_array().unwrap();
        let read = rows(&service, &format!("{MEASUREMENTS}?format=parquet")).await;
        assert_eq!(read.len(), all.len());
        for (row, item) in read.iter().zip(all) {
            let micros =
                modalwatch::quantity::Timestamp::parse(item["measured_at"].as_str().unwrap()).unwrap().micros();
            assert_eq!(cell(row, "measured_at"), &Field::TimestampMicros(micros));
            assert_eq!(cell(row, "source"), &Field::Str(item["source"].as_str().unwrap().to_owned()));
            for mode in 0..3 {
                let expected = item["frequencies_hz"][mode].as_f64().map_or(Field::Null, Field::Double);
                assert_eq!(cell(row, &format!("f{}_hz", mode + 1)), &expected);
            }
        }
        let full = read.last().unwrap();
        assert_eq!(cell(full, "std_f1_hz"), &Field::Double(0.001));
        assert_eq!((cell(full, "set_k1"), cell(full, "set_k2")), (&Field::Null, &Field::Double(5.0)));
    }

    #[tokio::test]
    async fn the_history_is_read_back() {
        let (service, _folder) = with_batches().await;
        let history = service.read("/v1/structures/three-dof/history").await;
        let history = history["items"].as_array().unwrap();
        let read = rows(&service, "/v1/structures/three-dof/history?format=parquet").await;
        assert_eq!(read.len(), 3 * history.len());
        for (rows, item) in read.chunks(3).zip(history) {
            for (row, parameter) in rows.iter().zip(item["assessment"]["parameters"].as_array().unwrap()) {
                assert_eq!(cell(row, "batch"), &Field::Str(item["batch"].as_str().unwrap().to_owned()));
                assert_eq!(cell(row, "mean"), &Field::Double(parameter["mean"].as_f64().unwrap()));
                assert_eq!(cell(row, "measurement_count"), &Field::Long(item["measurement_count"].as_i64().unwrap()));
                assert_eq!(cell(row, "probability_of_damage"), &Field::Null);
            }
        }
    }
}
