//! Every metric that the shipped dashboard and the alert rules name exists from the first scrape on.

use std::collections::BTreeSet;

use serde_json::Value;

use crate::helpers::{measurements, repository, spawn};

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
    service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 4, 0)).await;
    service.read("/readyz").await;
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
    assert!((value("modalwatch_batches_received_total ") - 1.0).abs() < 0.5);
    assert!((value("modalwatch_measurements_received_total ") - 4.0).abs() < 0.5);
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
    // No label grows with the number of structures.
    assert!(!text.contains("three-dof"), "{text}");
}
