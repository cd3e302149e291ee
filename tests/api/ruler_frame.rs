//! A real structure through HTTP: the four-storey ruler frame of two laboratories.

use serde_json::{json, Value};

use crate::helpers::{created, problem, repository, spawn, time};
use crate::needs;

const BATCHES: &str = "/v1/structures/ruler-frame-4dof/batches";

/// Rows of one laboratory, or `None` if the data are not on this machine.
fn rows(lab: &str) -> Option<Vec<Value>> {
    let path = repository("../shared/data/ruler-frame-4dof/ruler_frame_frequencies.csv");
    let text = std::fs::read_to_string(path).ok()?;
    let mut lines = text.lines();
    let header: Vec<&str> = lines.next()?.split(',').collect();
    let column = |name: &str| header.iter().position(|h| *h == name).unwrap();
    let modes: Vec<usize> = (1..=4).map(|i| column(&format!("f{i}_hz"))).collect();
    let of_lab = lines.map(|l| l.split(',').collect::<Vec<_>>()).filter(|cells| cells[column("lab")] == lab);
    // The file has no times: one test a minute, laboratory de a month after br.
    let start = if lab == "br" { 0 } else { 31 * 86_400 };
    let row = |(i, cells): (usize, Vec<&str>)| {
        let f: Vec<Option<f64>> = modes.iter().map(|m| cells[*m].parse().ok()).collect();
        json!({ "measured_at": time(start + 60 * i), "frequencies_hz": f, "covariates": { "lab": lab } })
    };
    Some(of_lab.enumerate().map(row).collect())
}

#[tokio::test]
async fn two_laboratories_are_taken_with_their_missing_values() {
    let (Some(br), Some(de)) = (rows("br"), rows("de")) else {
        needs::missing("the data ../shared/data/ruler-frame-4dof, which are not part of the repository");
        return;
    };
    let (service, _folder) = spawn();
    let undamaged = service.post_batch("ruler-frame-4dof", &br[..50]).await;
    let path = "/v1/structures/ruler-frame-4dof/reference";
    // The fifty were measured in succession and drift together: they are worth fewer than ten independent ones.
    let refused = service.post(path, &json!({ "batches": [undamaged["batch"]] })).await;
    let refused = problem(refused, 422, "unusable_baseline").await;
    assert!(refused["detail"].as_str().unwrap().contains("successive measurements of"), "{refused}");
    let mut left_out = 0;
    for batch in br[50..].chunks(10).chain(de.chunks(10)) {
        let answer = created(service.post(BATCHES, &json!({ "measurements": batch })).await).await;
        assert_eq!(answer["state"], "assessed", "{answer}");
        left_out += answer["assessment"]["measurements_left_out"].as_u64().unwrap();
    }
    // Rows that lack a mode (four of laboratory de) are used; outliers are reported and excluded.
    println!("{left_out} measurements left out");
    let history = service.read("/v1/structures/ruler-frame-4dof/history").await;
    assert_eq!(history["items"].as_array().unwrap().len(), 16);
    let csv = service.get("/v1/structures/ruler-frame-4dof/history?format=csv").send().await.unwrap();
    println!("{}", csv.text().await.unwrap());
    println!("{}", service.read("/v1/structures/ruler-frame-4dof/history?limit=1").await["items"][0]["assessment"]);
}
