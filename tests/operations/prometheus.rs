//! The Grafana board and the alert rules with a real Prometheus that scrapes the service: each expression is asked as Grafana asks it.
//!
//! ```sh
//! apt-get install prometheus    # or MODALWATCH_PROMETHEUS=/path/to/prometheus
//! cargo test --release --test service operations::prometheus -- --ignored --nocapture
//! ```

use std::collections::BTreeSet;
use std::net::TcpListener;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use serde_json::{json, Value};

use crate::helpers::{created, measurements, repository, spawn, within, Service};

/// Grafana's `$__rate_interval` is at least four scrape intervals, here one second each.
const RATE_INTERVAL: &str = "10s";

/// Expressions of which nothing is shown while nothing has gone wrong.
const EMPTY_WHILE_WELL: [&str; 1] = ["5xx responses by route"];

struct Prometheus {
    child: Child,
    url: String,
    client: reqwest::Client,
    _folder: tempfile::TempDir,
}

impl Drop for Prometheus {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Prometheus {
    /// Starts Prometheus with the shipped configuration and rules; only address and intervals are those of the test.
    fn scraping(service: &Service) -> Self {
        let program = std::env::var("MODALWATCH_PROMETHEUS").unwrap_or_else(|_| "prometheus".to_owned());
        let folder = tempfile::tempdir().unwrap();
        let shipped = std::fs::read_to_string(repository("docker/prometheus/prometheus.yml")).unwrap();
        let config = shipped.replace("modalwatch:8080", service.address()).replace(": 15s", ": 1s");
        assert!(config.contains(service.address()) && config.contains("scrape_interval: 1s"), "{config}");
        std::fs::write(folder.path().join("prometheus.yml"), config).unwrap();
        for rules in ["alerts.yml", "alerts.cluster.yml"] {
            std::fs::copy(repository("docker/prometheus").join(rules), folder.path().join(rules)).unwrap();
        }
        let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let mut command = Command::new(&program);
        command.arg(format!("--config.file={}", folder.path().join("prometheus.yml").display()));
        command.arg(format!("--storage.tsdb.path={}", folder.path().join("data").display()));
        command.arg(format!("--web.listen-address={free}"));
        let child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn();
        let child = child.unwrap_or_else(|error| panic!("{program}: {error}"));
        let client = modalwatch::notify::client_builder().build().unwrap();
        Self { child, url: format!("http://{free}"), client, _folder: folder }
    }

    async fn ask(&self, path: &str, query: &[(&str, &str)]) -> Value {
        let url = reqwest::Url::parse_with_params(&format!("{}{path}", self.url), query).unwrap();
        let answer: Value = self.client.get(url).send().await.unwrap().json().await.unwrap();
        assert_eq!(answer["status"], "success", "{path} {query:?}: {answer}");
        answer["data"].clone()
    }

    async fn scrapes(&self) -> Option<usize> {
        let url = format!("{}/api/v1/query?query=count_over_time(modalwatch_build_info[1m])", self.url);
        let answer: Value = self.client.get(url).send().await.ok()?.json().await.ok()?;
        answer["data"]["result"][0]["value"][1].as_str()?.parse().ok()
    }
}

/// An expression with the variables of the board as Grafana puts them in for “All”.
fn filled(expression: &str, structures: &str) -> String {
    expression
        .replace("$__rate_interval", RATE_INTERVAL)
        .replace("$job", "modalwatch")
        .replace("$instance", ".*")
        .replace("$structure", structures)
}

async fn damaged(service: &Service, days: std::ops::Range<usize>) {
    for day in days {
        service.post_batch("three-dof", &measurements([4.0, 4.2, 6.0], 20, day * 86_400)).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs Prometheus"]
async fn every_panel_and_every_rule_is_answered_by_prometheus() {
    let (service, _folder) = spawn();
    let mut ids = Vec::new();
    for day in 0..3 {
        let batch = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 20, day * 86_400)).await;
        ids.push(batch["batch"].clone());
    }
    created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": ids })).await).await;
    damaged(&service, 3..5).await;
    let prometheus = Prometheus::scraping(&service);
    within(Duration::from_secs(30), "two scrapes", async || prometheus.scrapes().await.filter(|n| *n >= 2)).await;
    // Rates need a change between two scrapes.
    damaged(&service, 5..7).await;
    let before = prometheus.scrapes().await.unwrap();
    within(Duration::from_secs(30), "further scrapes", async || {
        prometheus.scrapes().await.filter(|n| *n >= before + 3)
    })
    .await;

    let board: Value =
        serde_json::from_str(&std::fs::read_to_string(repository("docker/grafana/modalwatch.json")).unwrap()).unwrap();
    // The variables: each query has the form label_values(selector, label).
    for variable in board["templating"]["list"].as_array().unwrap().iter().filter(|v| v["type"] == "query") {
        let query = filled(variable["query"]["query"].as_str().unwrap(), "three-dof");
        let inner = query.strip_prefix("label_values(").and_then(|q| q.strip_suffix(')')).unwrap();
        let (selector, label) = inner.rsplit_once(", ").unwrap();
        let values = prometheus.ask(&format!("/api/v1/label/{label}/values"), &[("match[]", selector)]).await;
        assert!(!values.as_array().unwrap().is_empty(), "{query} has no value");
        if label == "structure" {
            assert!(values.as_array().unwrap().contains(&json!("three-dof")), "{values}");
        }
    }
    let mut asked = 0;
    for panel in board["panels"].as_array().unwrap() {
        let title = panel["title"].as_str().unwrap();
        for target in panel["targets"].as_array().into_iter().flatten() {
            let expression = filled(target["expr"].as_str().unwrap(), "three-dof");
            let data = prometheus.ask("/api/v1/query", &[("query", &expression)]).await;
            let found = data["result"].as_array().unwrap();
            asked += 1;
            println!("{title}: {} series of {expression}", found.len());
            if EMPTY_WHILE_WELL.contains(&title) {
                continue;
            }
            assert!(!found.is_empty(), "{title}: nothing for {expression}");
            // Every label of the legend is there, so that no curve is called “{{…}}”.
            let legend = target["legendFormat"].as_str().unwrap_or_default();
            let labels = legend.split("{{").skip(1).map(|part| part.split("}}").next().unwrap().trim());
            for label in labels {
                assert!(found.iter().all(|one| one["metric"][label].is_string()), "{title}: no label {label}: {data}");
            }
            // A value may be missing (NaN) where there is nothing to measure yet, but not in all series.
            let shown = found.iter().filter(|one| one["value"][1] != "NaN").count();
            assert!(shown > 0, "{title}: {data}");
        }
    }
    assert!(asked > 30, "{asked}");
    // The change that the board shows is that of the API.
    let history = service.read("/v1/structures/three-dof/history").await;
    let newest = history["items"].as_array().unwrap().last().unwrap();
    let parameters = newest["assessment"]["parameters"].as_array().unwrap();
    let k2 = parameters.iter().find(|p| p["name"] == "k2").unwrap();
    let asked = "modalwatch_parameter_relative_change{structure=\"three-dof\",parameter=\"k2\"}";
    let data = prometheus.ask("/api/v1/query", &[("query", asked)]).await;
    let shown: f64 = data["result"][0]["value"][1].as_str().unwrap().parse().unwrap();
    assert!((shown - k2["relative_change"].as_f64().unwrap()).abs() < 1e-9, "{data} {k2}");

    let rules = within(Duration::from_secs(30), "the rules are evaluated", async || {
        let data = prometheus.ask("/api/v1/rules", &[]).await;
        let rules = data["groups"][0]["rules"].as_array()?.clone();
        rules.iter().all(|rule| rule["health"] != "unknown").then_some(rules)
    })
    .await;
    let ill: Vec<&Value> = rules.iter().filter(|rule| rule["health"] != "ok").collect();
    assert!(ill.is_empty() && rules.len() > 8, "{ill:?}");
    let firing: BTreeSet<&str> =
        rules.iter().filter(|rule| rule["state"] == "firing").filter_map(|rule| rule["name"].as_str()).collect();
    println!("firing: {firing:?}");
    assert!(firing.contains("ModalwatchDamageAlarm"), "{firing:?}");
    assert!(!firing.contains("ModalwatchDown") && !firing.contains("ModalwatchErrors"), "{firing:?}");
}
