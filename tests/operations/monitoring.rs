//! Every metric that the shipped dashboard and the alert rules name exists from the first scrape on.

use std::collections::BTreeSet;

use serde_json::{json, Value};

use crate::helpers::{command, created, measurements, repository, spawn, Service};

/// Names of the program's metrics in a text, without the suffixes of histogram series.
fn names(text: &str) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    for (start, _) in text.match_indices("modalwatch_") {
        let name: String = text[start..].chars().take_while(|c| c.is_ascii_alphanumeric() || *c == '_').collect();
        let base = ["_bucket", "_sum", "_count"].iter().find_map(|end| name.strip_suffix(end)).unwrap_or(&name);
        found.insert(base.to_owned());
    }
    found
}

async fn scraped() -> String {
    let (service, _folder) = spawn();
    watched(&service).await;
    service.read("/readyz").await;
    text_of(&service).await
}

/// A reference of one batch, and a batch that is compared with it.
async fn watched(service: &Service) {
    let first = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 12, 0)).await;
    let reference = json!({ "batches": [first["batch"]] });
    created(service.post("/v1/structures/three-dof/reference", &reference).await).await;
    service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 12, 86_400)).await;
}

async fn text_of(service: &Service) -> String {
    let response = service.get("/metrics").send().await.unwrap();
    assert_eq!(response.status(), 200);
    response.text().await.unwrap()
}

#[tokio::test]
async fn dashboard_and_alerts_name_only_metrics_that_are_there() {
    let text = scraped().await;
    let there = names(&text);
    let dashboard = std::fs::read_to_string(repository("docker/grafana/modalwatch.json")).unwrap();
    let parsed: Value = serde_json::from_str(&dashboard).unwrap();
    let panels = parsed["panels"].as_array().unwrap();
    let mut asked = BTreeSet::new();
    for panel in panels.iter().filter(|panel| panel["type"] != "row") {
        let targets = panel["targets"].as_array().unwrap();
        assert!(!targets.is_empty(), "{panel}");
        for target in targets {
            let named = names(target["expr"].as_str().unwrap());
            assert!(!named.is_empty(), "{target}");
            asked.extend(named);
        }
    }
    let alerts = std::fs::read_to_string(repository("docker/prometheus/alerts.yml")).unwrap();
    let rules: BTreeSet<String> =
        alerts.lines().filter(|line| line.trim_start().starts_with("expr:")).flat_map(names).collect();
    assert!(asked.len() > 15 && rules.len() > 8, "{asked:?} {rules:?}");
    let missing: Vec<&String> = asked.union(&rules).filter(|name| !there.contains(*name)).collect();
    assert!(missing.is_empty(), "metrics that are used but not in /metrics: {missing:?}");
    // Panels do not overlap.
    let mut places = BTreeSet::new();
    for panel in panels {
        let at = |key: &str| panel["gridPos"][key].as_u64().unwrap();
        for x in at("x")..at("x") + at("w") {
            for y in at("y")..at("y") + at("h") {
                assert!(places.insert((x, y)), "{}", panel["title"]);
            }
        }
    }
}

#[tokio::test]
async fn metrics_say_what_the_service_is_and_what_it_holds() {
    let text = scraped().await;
    let value = |line: &str| -> f64 {
        let found = text.lines().find_map(|l| l.strip_prefix(line)).unwrap_or_else(|| panic!("no {line} in {text}"));
        found.trim().parse().unwrap()
    };
    assert!((value("modalwatch_batches_received_total ") - 2.0).abs() < 0.5);
    assert!((value("modalwatch_measurements_received_total ") - 24.0).abs() < 0.5);
    assert!((value("modalwatch_pending_batches ") - 0.0).abs() < 0.5);
    assert!((value("modalwatch_structures ") - 3.0).abs() < 0.5);
    assert!((value("modalwatch_open_alarms{kind=\"damage\"} ") - 0.0).abs() < 0.5);
    assert!(value("modalwatch_database_bytes ") > 0.0 && value("modalwatch_disk_free_bytes ") > 0.0);
    assert!(value("modalwatch_resident_memory_bytes ") > 1e6 && value("modalwatch_open_files ") > 5.0);
    let build = text.lines().find(|line| line.starts_with("modalwatch_build_info")).unwrap();
    assert!(build.contains(env!("CARGO_PKG_VERSION")) && build.contains("sqlite_version=\"3."), "{build}");
    let nameless: Vec<String> =
        names(&text).into_iter().filter(|name| !text.contains(&format!("# HELP {name} "))).collect();
    assert!(nameless.is_empty(), "metrics without a description: {nameless:?}");
}

#[tokio::test]
async fn the_values_of_each_structure_are_those_of_the_api_and_their_number_is_bounded() {
    let (service, _folder) = spawn();
    watched(&service).await;
    let text = text_of(&service).await;
    let value = |line: &str| -> f64 {
        let found = text.lines().find_map(|l| l.strip_prefix(line)).unwrap_or_else(|| panic!("no {line} in {text}"));
        found.trim().parse().unwrap()
    };
    let history = service.read("/v1/structures/three-dof/history").await;
    let parameters = history["items"][1]["assessment"]["parameters"].as_array().unwrap();
    assert_eq!(parameters.len(), 3);
    for p in parameters {
        let labels = format!("{{structure=\"three-dof\",parameter={},unit=\"N/m\"}} ", p["name"]);
        for (metric, key) in [
            ("mean", "mean"),
            ("relative_change", "relative_change"),
            ("probability_of_damage", "probability_of_damage"),
        ] {
            let found = value(&format!("modalwatch_parameter_{metric}{labels}"));
            assert!((found - p[key].as_f64().unwrap()).abs() < 1e-12, "{metric}{labels}");
        }
    }
    let charts = service.read("/v1/structures/three-dof/charts").await;
    for point in charts["items"].as_array().unwrap() {
        let line = format!("modalwatch_chart_shift{{structure=\"three-dof\",chart={}}} ", point["chart"]);
        assert!((value(&line) - point["shift"].as_f64().unwrap()).abs() < 1e-12, "{line}");
    }
    let overview = service.read("/v1/overview").await;
    for item in overview["items"].as_array().unwrap() {
        let line = format!("modalwatch_structure_state{{structure={},state={}}} ", item["id"], item["state"]);
        assert!((value(&line) - 1.0).abs() < 1e-12, "{line}");
    }
    // As many structures as the settings allow, the first ones by id.
    for (most, with, without) in [("0", None, "structure="), ("1", Some(&overview["items"][0]["id"]), "three-dof")] {
        let folder = tempfile::tempdir().unwrap();
        let service = Service::spawn(command(folder.path()).env("MODALWATCH__HTTP__METRICS_STRUCTURES", most));
        watched(&service).await;
        let text = text_of(&service).await;
        assert!(!text.contains(without), "{most}: {text}");
        assert!(with.is_none_or(|id| text.contains(&format!("structure={id}"))), "{most}: {text}");
    }
}
