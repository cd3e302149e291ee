//! What is written on the pages and reports of a structure has no label that only its authors understand.

use serde_json::{json, Value};

use crate::chromium::Page;
use crate::dashboard::{at, turn};
use crate::helpers::{created, eventually, spawn};

/// Labels that were on the pages, each of which has been replaced or is explained where it stands.
const RIDDLES: [&str; 16] = [
    "not uniform",
    "TARP",
    "noise ×",
    "× nominal",
    "log likelihood",
    "log-likelihood",
    "moved nothing",
    "p of fit",
    "p = ",
    "p < ",
    "spring:",
    "group:",
    "swing",
    "pooled",
    "can absorb",
    "baseline",
];

/// Everything that a page says, what is folded and the names of controls included.
const WORDS: &str = "(() => {
    const words = [];
    const read = (root) => {
        for (const element of root.querySelectorAll('*')) {
            if (['SCRIPT', 'STYLE', 'TEMPLATE', 'CODE', 'PRE'].includes(element.tagName)) continue;
            for (const node of element.childNodes) if (node.nodeType === Node.TEXT_NODE) words.push(node.textContent.trim());
            for (const name of ['aria-label', 'title', 'placeholder']) if (element.hasAttribute(name)) words.push(element.getAttribute(name));
            if (element.shadowRoot) read(element.shadowRoot);
        }
    };
    read(document.querySelector('main'));
    return words.filter(Boolean).join('\\n');
})()";

/// Two weeks of the rig, whose stiffnesses follow from its parameters by a law; from the thirteenth day one is lower.
pub fn table(folder: &std::path::Path) -> String {
    let mut simulate = std::process::Command::new(env!("CARGO_BIN_EXE_modalwatch"));
    simulate.args(["simulate", "rig", "--start", "2026-01-01", "--every", "2h", "--days", "16", "--seed", "4"]);
    simulate.args(["--parameter", "p12=0.05,0.002", "--parameter", "p23=0.05,0.002"]);
    simulate.args(["--loss", "p12=30%", "--from-date", "2026-01-13", "--out"]).arg(folder.join("rig.csv"));
    let done = simulate.output().unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    std::fs::read_to_string(folder.join("rig.csv")).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn pages_and_reports_have_no_names_that_only_the_authors_understand() {
    let Some(_turn) = turn().await else { return };
    let (service, folder) = spawn();
    let stored = service.post_text("/v1/structures/rig/batches?split=1d", "text/csv", table(folder.path())).await;
    assert!(stored.status().is_success(), "{}", stored.text().await.unwrap());
    let period = json!({ "from": "2026-01-01T00:00:00Z", "to": "2026-01-12T00:00:00Z" });
    created(service.post("/v1/structures/rig/reference", &period).await).await;
    eventually("the alarm", async || {
        let overview = service.read("/v1/overview").await;
        let items = overview["items"].as_array().unwrap().clone();
        items.into_iter().find(|item| item["id"] == "rig" && item["state"] == "alarming")
    })
    .await;
    let asked = service.post("/v1/structures/rig/diagnoses", &json!({})).await.json::<Value>().await.unwrap();
    let diagnosis = asked["diagnosis"].as_str().unwrap().to_owned();
    eventually("the diagnosis", async || {
        let answer = service.read(&format!("/v1/diagnoses/{diagnosis}")).await;
        (answer["state"] == "done").then_some(())
    })
    .await;

    let mut page = Page::open();
    page.look("light", 1400);
    let structure = "#/structures/rig";
    let views = [
        (String::new(), "document.querySelectorAll('table.fleet tbody tr').length === 3"),
        (structure.to_owned(), "document.querySelectorAll('[data-figure=control] canvas').length > 0"),
        (format!("{structure}?section=batch"), "document.querySelectorAll('[data-figure^=density] canvas').length > 0"),
        (format!("{structure}?section=tracks"), "document.querySelectorAll('[data-figure=tracks] canvas').length > 0"),
        (format!("{structure}?section=model"), "document.querySelectorAll('#model table').length > 1"),
        (
            format!("{structure}?section=diagnosis"),
            "document.querySelector('#latest-diagnosis:not([hidden])') !== null",
        ),
        (
            format!("{structure}/report"),
            "document.querySelector('.report')?.shadowRoot.textContent.includes('What is not known')",
        ),
        (
            format!("#/diagnoses/{diagnosis}"),
            "document.querySelector('.report')?.shadowRoot.textContent.includes('In short')",
        ),
        (
            "#/compare?a=rig/p12&b=rig/p23".to_owned(),
            "document.querySelectorAll('[data-figure=compare] canvas').length === 1",
        ),
        ("#/jobs".to_owned(), "document.querySelectorAll('[data-job]').length > 0"),
    ];
    for (view, complete) in &views {
        page.visit(&at(&service, view));
        page.wait_for(complete);
        // The tables of the figures are written when they are unfolded.
        page.evaluate("document.querySelectorAll('.as-table').forEach((button) => button.click())");
        let said = page.evaluate(WORDS).as_str().unwrap().to_owned();
        assert!(said.len() > 100, "{view}: {said}");
        for line in said.lines() {
            for riddle in RIDDLES {
                assert!(!line.contains(riddle), "{view} says {riddle:?}: {line}");
            }
            assert!(
                !line.contains('δ') || line.contains("amage threshold") || line.contains("below δ"),
                "{view}: δ is not explained: {line}"
            );
        }
    }
    // The stiffness that follows from the parameter has its own name, and a click on it leads to the chart of the parameter.
    page.visit(&at(&service, structure));
    page.wait_for("document.querySelector('[data-figure=\"parameter-spring:k12\"] h4')?.textContent === 'stiffness of spring k12'");
    page.wait_for("document.querySelector('.drawing [data-name=k12]') !== null");
    page.evaluate("document.querySelector('[data-figure=control] [data-chart=p23]').click()");
    page.evaluate(
        "document.querySelector('.drawing [data-name=k12]').dispatchEvent(new MouseEvent('click', { bubbles: true }))",
    );
    page.wait_for("document.querySelector('[data-figure=control] [data-chart=p12]').ariaPressed === 'true'");
    assert_eq!(page.complaints(), Vec::<String>::new());
}
