//! The condition report: what the API says, on one page, for a period.

use serde_json::json;

use crate::helpers::{created, measurements, problem, spawn, time, Service};

const DAY_S: usize = 86_400;
const REPORT: &str = "/v1/structures/three-dof/report";

/// A reference of three days, two healthy days, and three with a loss of 10 % in k2.
async fn damaged(service: &Service) {
    let mut ids = Vec::new();
    for day in 0..3 {
        let batch = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 20, day * DAY_S)).await;
        ids.push(batch["batch"].clone());
    }
    let reference = json!({ "batches": ids, "reason": "before the <opening>" });
    created(service.post("/v1/structures/three-dof/reference", &reference).await).await;
    for (day, k2) in [(3, 5.0), (4, 5.0), (9, 4.5), (10, 4.5), (11, 4.5)] {
        service.post_batch("three-dof", &measurements([4.0, k2, 6.0], 20, day * DAY_S)).await;
    }
    let note = json!({ "by": "Ines Vogel", "note": "inspection on Monday" });
    service.post("/v1/structures/three-dof/alarms/1/acknowledgement", &note).await;
}

async fn page(service: &Service, query: &str) -> String {
    let response = service.get(&format!("{REPORT}{query}")).send().await.unwrap();
    assert_eq!(response.status(), 200);
    assert!(response.headers()["content-type"].to_str().unwrap().starts_with("text/html"));
    response.text().await.unwrap()
}

#[tokio::test]
async fn a_report_has_the_verdict_the_alarms_with_their_notes_and_what_is_not_known() {
    let (service, _folder) = spawn();
    damaged(&service).await;
    let overview = service.read("/v1/overview").await;
    let item = overview["items"].as_array().unwrap().iter().find(|item| item["id"] == "three-dof").unwrap();
    let whole = page(&service, "").await;
    for part in [
        item["verdict"].as_str().unwrap(),
        "Ines Vogel",
        "inspection on Monday",
        "8 batches with 160 measurements",
        "Rejected: 0 of 8 assessed batches",
        "No batch from 2026-01-05",
        "before the &lt;opening&gt;",
        "What is not known",
    ] {
        assert!(whole.contains(part), "{part} is not in {whole}");
    }
    // The drawing has the change of the spring, which lost 10 %.
    let spring = whole.split("data-name=\"k2\"").nth(1).unwrap_or_else(|| panic!("there is no drawing: {whole}"));
    let label = spring.split("</text>").next().unwrap().rsplit('>').next().unwrap();
    let change = label.strip_prefix("k2 −").and_then(|rest| rest.strip_suffix(" %")).map(str::parse::<f64>);
    assert!(matches!(change, Some(Ok(lost)) if (8.0..12.0).contains(&lost)), "{label}");
    assert!(!whole.contains("<opening>") && whole.matches("<svg class=\"panel\"").count() == 3);

    // The days before the loss: no alarm, and only their batches.
    let (from, to) = (time(0), time(6 * DAY_S));
    let before = page(&service, &format!("?from={from}&to={to}")).await;
    assert!(before.contains("5 batches with 100 measurements") && !before.contains("Ines Vogel"), "{before}");
}

#[tokio::test]
async fn a_structure_without_anything_has_a_report_that_says_so() {
    let (service, _folder) = spawn();
    let text = page(&service, "").await;
    for part in ["No batch has been assessed yet", "no measurements", "nothing to compare with"] {
        assert!(text.contains(part), "{part} is not in {text}");
    }
    let backwards = format!("{REPORT}?from={}&to={}", time(DAY_S), time(0));
    let refused = problem(service.get(&backwards).send().await.unwrap(), 422, "invalid").await;
    assert_eq!(refused["errors"][0]["pointer"], "query/to", "{refused}");
}

#[tokio::test(flavor = "multi_thread")]
async fn the_command_writes_the_page_of_the_service() {
    let (service, folder) = spawn();
    damaged(&service).await;
    let out = folder.path().join("report.html");
    let url = format!("http://{}", service.address());
    let written = |period: &[&str]| {
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_modalwatch"));
        command.args(["report", "--structure", "three-dof", "--url", &url, "--out"]).arg(&out).args(period);
        assert!(command.status().unwrap().success());
        std::fs::read_to_string(&out).unwrap()
    };
    let whole = written(&[]);
    assert!(whole.contains("Ines Vogel") && whole.contains("</html>"));
    assert!(whole.contains("8 batches with 160 measurements"), "{whole}");
    // The days before the loss have fewer batches, and no alarm.
    let before = written(&["--from", "2026-01-01T00:00:00Z", "--to", "2026-01-07T00:00:00Z"]);
    assert!(before.contains("5 batches with 100 measurements") && !before.contains("Ines Vogel"), "{before}");
}
