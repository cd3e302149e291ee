//! Time until the page of a structure with 3,000 batches shows its charts: a second at most, in the median.
//!
//! ```sh
//! cargo test --release --test browser speed -- --ignored --nocapture
//! ```

use std::fmt::Write as _;
use std::time::{Duration, Instant};

use serde_json::json;

use crate::chromium::Page;
use crate::dashboard::{at, turn};
use crate::helpers::{measurements, spawn, within};

const BATCHES: usize = 3_000;
/// Batches of two hours: the helper knows the days from January to August.
const EVERY_S: usize = 6_000;
const LOADS: usize = 9;

#[tokio::test(flavor = "multi_thread")]
#[ignore = "a measurement of two minutes"]
async fn first_paint_of_a_structure_with_3000_batches() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    let mut table = "measured_at,f1_hz,f2_hz,f3_hz\n".to_owned();
    for batch in 0..BATCHES {
        for row in measurements([4.0, 5.0, 6.0], 3, batch * EVERY_S) {
            let f = &row["frequencies_hz"];
            writeln!(table, "{},{},{},{}", row["measured_at"].as_str().unwrap(), f[0], f[1], f[2]).unwrap();
        }
    }
    let stored = service.post_text("/v1/structures/three-dof/batches?split=gap:1h", "text/csv", table).await;
    assert!(stored.status().is_success(), "{}", stored.text().await.unwrap());
    let period = json!({ "from": "2026-01-01T00:00:00Z", "to": "2026-02-01T00:00:00Z" });
    crate::helpers::created(service.post("/v1/structures/three-dof/reference", &period).await).await;
    within(Duration::from_mins(5), "all batches are judged", async || {
        let overview = service.read("/v1/overview").await;
        let items = overview["items"].as_array().unwrap().clone();
        items
            .iter()
            .any(|i| i["id"] == "three-dof" && i["batches"] == BATCHES && i["waiting_batches"] == 0)
            .then_some(())
    })
    .await;

    let mut page = Page::open();
    page.look("light", 1400);
    let mut charts_ms = Vec::new();
    for _ in 0..LOADS {
        page.call("Page.navigate", &json!({ "url": "about:blank" }));
        let begin = Instant::now();
        page.call("Page.navigate", &json!({ "url": at(&service, "#/structures/three-dof") }));
        page.wait_for("document.querySelectorAll('#condition figure canvas').length >= 8");
        charts_ms.push(begin.elapsed().as_millis());
    }
    charts_ms.sort_unstable();
    let screens = page.evaluate("document.documentElement.scrollHeight / 900").as_f64().unwrap();
    println!(
        "{BATCHES} batches: charts after {} ms (median of {LOADS}; {} to {}), page of {screens:.2} screens of 900 px at 1400 px",
        charts_ms[LOADS / 2],
        charts_ms[0],
        charts_ms[LOADS - 1]
    );
    assert!(charts_ms[LOADS / 2] <= 1_000, "the charts are there after {charts_ms:?} ms");
    assert!(screens <= 3.0, "the page has {screens:.2} screens");
}
