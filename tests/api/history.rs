//! Pages, filters and CSV of the history.

use reqwest::Method;
use serde_json::{json, Value};

use crate::helpers::{created, measurements, problem, spawn, Service};

const HISTORY: &str = "/v1/structures/three-dof/history";

async fn with_batches(count: usize) -> (Service, tempfile::TempDir) {
    let (service, folder) = spawn();
    let first = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 10, 0)).await;
    created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": [first["batch"]] })).await).await;
    for i in 1..count {
        service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0 - 0.2 * i as f64], 3, i * 86_400)).await;
    }
    (service, folder)
}

fn ids(page: &Value) -> Vec<String> {
    page["items"].as_array().unwrap().iter().map(|b| b["batch"].as_str().unwrap().to_owned()).collect()
}

#[tokio::test]
async fn pages_walk_all_batches_once_in_the_order_of_time() {
    let (service, _folder) = with_batches(7).await;
    let all = service.read(HISTORY).await;
    assert_eq!(ids(&all).len(), 7);
    assert_eq!(all["next"], Value::Null);
    let times: Vec<&str> =
        all["items"].as_array().unwrap().iter().map(|b| b["measured_from"].as_str().unwrap()).collect();
    assert!(times.is_sorted(), "{times:?}");

    let (mut walked, mut path) = (Vec::new(), format!("{HISTORY}?limit=3"));
    for _ in 0..5 {
        let response = service.get(&path).send().await.unwrap();
        let link = response.headers().get("link").map(|l| l.to_str().unwrap().to_owned());
        walked.extend(ids(&response.json().await.unwrap()));
        let Some(link) = link else { break };
        path = link.split(['<', '>']).nth(1).unwrap().to_owned();
    }
    assert_eq!(walked, ids(&all));
}

#[tokio::test]
async fn from_and_to_cut_out_a_part_and_a_parameter_is_picked() {
    let (service, _folder) = with_batches(5).await;
    let page = service.read(&format!("{HISTORY}?from=2026-01-02T00:00:00Z&to=2026-01-04T00:00:00Z&parameter=k3")).await;
    assert_eq!(ids(&page).len(), 2, "{page}");
    for item in page["items"].as_array().unwrap() {
        let parameters = item["assessment"]["parameters"].as_array().unwrap();
        assert_eq!(parameters.len(), 1);
        assert_eq!(parameters[0]["name"], "k3");
    }
    // An unescaped plus sign of an offset is read as a plus sign.
    let page = service.read(&format!("{HISTORY}?from=2026-01-02T01:00:00+01:00")).await;
    assert_eq!(ids(&page).len(), 4);
}

#[tokio::test]
async fn csv_has_a_row_for_each_batch_and_parameter() {
    let (service, _folder) = with_batches(3).await;
    for request in [service.get(&format!("{HISTORY}?format=csv")), service.get(HISTORY).header("accept", "text/csv")] {
        let response = request.send().await.unwrap();
        assert!(response.headers()["content-type"].to_str().unwrap().starts_with("text/csv"));
        let text = response.text().await.unwrap();
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines.len(), 1 + 3 * 3, "{text}");
        assert!(lines[0].starts_with("batch,source,measured_from"), "{text}");
        let columns = lines[0].split(',').count();
        assert!(lines.iter().all(|line| line.split(',').count() == columns), "{text}");
    }
}

#[tokio::test]
async fn a_csv_file_has_the_whole_window_and_not_one_page_of_it() {
    let (service, _folder) = spawn();
    for day in 0..120 {
        service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 1, 86_400 * day)).await;
    }
    let file = async |query: &str| {
        let response = service.get(&format!("{HISTORY}?format=csv{query}")).send().await.unwrap();
        assert!(response.headers().get("link").is_none());
        response.text().await.unwrap()
    };
    let whole = file("").await;
    assert_eq!(whole.lines().count(), 1 + 3 * 120);
    let limited = file("&limit=7").await;
    assert_eq!(limited.lines().count(), 1 + 3 * 7);
    assert!(whole.starts_with(&limited), "{limited}");
}

#[tokio::test]
async fn exceedances_are_paged_newest_first() {
    let (service, _folder) = with_batches(6).await;
    let all = service.read("/v1/structures/three-dof/exceedances?parameter=k3").await;
    let found = ids(&all);
    assert!(found.len() >= 4, "k3 fell by up to 17 %: {all}");
    let times: Vec<&str> =
        all["items"].as_array().unwrap().iter().map(|b| b["measured_from"].as_str().unwrap()).collect();
    assert!(times.iter().rev().is_sorted(), "{times:?}");
    let (mut walked, mut cursor) = (Vec::new(), String::new());
    loop {
        let page = service.read(&format!("/v1/structures/three-dof/exceedances?parameter=k3&limit=2{cursor}")).await;
        walked.extend(ids(&page));
        let Some(next) = page["next"].as_str() else { break };
        cursor = format!("&cursor={next}");
    }
    assert_eq!(walked, found);
}

#[tokio::test]
async fn an_invalid_query_is_refused_with_its_place() {
    let (service, _folder) = spawn();
    for (query, place) in [
        ("limit=0", "query/limit"),
        ("limit=1001", "query/limit"),
        ("limit=many", "query/limit"),
        ("from=yesterday", "query/from"),
        ("to=2026-01-01T00:00:00", "query/to"),
        ("parameter=k9", "query/parameter"),
        ("cursor=abc", "query/cursor"),
        ("format=xml", "query/format"),
        ("lmit=3", "query"),
    ] {
        let response = service.get(&format!("{HISTORY}?{query}")).send().await.unwrap();
        let body = problem(response, 422, "invalid").await;
        assert_eq!(body["errors"][0]["pointer"], place, "{body}");
    }
}

#[tokio::test]
async fn the_earlier_name_of_the_reference_route_answers_the_same_and_is_marked_as_deprecated() {
    let (service, _folder) = spawn();
    let batch = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 10, 0)).await;
    let body = json!({ "batches": [batch["batch"]] });
    let path = |name: &str| format!("/v1/structures/three-dof/{name}");
    let mut answers = Vec::new();
    for (method, name) in [(Method::PUT, "reference"), (Method::POST, "reference"), (Method::POST, "baseline")] {
        let response = service.request(method, &path(name)).json(&body).send().await.unwrap();
        assert_eq!(response.headers().contains_key("deprecation"), name == "baseline");
        let mut answer = created(response).await;
        // Each declaration is a new version, made at another time.
        answer.as_object_mut().unwrap().retain(|key, _| !["version", "created_at"].contains(&key.as_str()));
        answers.push(answer);
    }
    assert!(answers.windows(2).all(|pair| pair[0] == pair[1]), "{answers:#?}");

    let refused = service.post(&path("baseline"), &json!({ "batches": [] })).await;
    assert_eq!(refused.headers()["deprecation"], "@1795392000");
    assert_eq!(refused.headers()["link"], "</v1/structures/three-dof/reference>; rel=\"successor-version\"");
    problem(refused, 422, "invalid").await;

    let document = service.read("/openapi.json").await;
    let paths = &document["paths"];
    let earlier = &paths["/v1/structures/{id}/baseline"]["post"];
    assert_eq!(earlier["deprecated"], true);
    for method in ["put", "post"] {
        let operation = &paths["/v1/structures/{id}/reference"][method];
        assert_ne!(operation["deprecated"], true);
        assert_eq!(operation["requestBody"], earlier["requestBody"]);
    }
}
