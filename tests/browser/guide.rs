//! The guide to the first verdict, and the healthy period that is marked by dragging over a chart.

use serde_json::{json, Value};

use crate::chromium::Page;
use crate::dashboard::{at, axe_findings, turn};
use crate::helpers::{
    command, measurements, spawn, spawn_that_trains_by_itself, time, two_masses_hz, Service, TWO_MASSES,
};

const DAY_S: usize = 86_400;

/// What each step of the guide is: done, next or later.
const STEPS: &str = "[...document.querySelectorAll('.guide .steps > li')].map((step) => step.dataset.state)";

/// Presses the button of the step that is next.
pub fn press_next(page: &mut Page) {
    page.evaluate("document.querySelector('.guide [data-state=next] button.primary').click()");
}

/// The ends of a drag over the first chart of k1, from its left edge to a share of its width.
fn over_k1(page: &mut Page, share: f64) -> [[f64; 2]; 2] {
    page.evaluate("document.querySelector('[data-figure=parameter-k1]').scrollIntoView({ block: 'center' })");
    let place = page.evaluate(
        "(() => { const { left, top, width, height } = document.querySelector('[data-figure=parameter-k1] .u-over').getBoundingClientRect();
            return [left, top, width, height]; })()",
    );
    let [left, top, width, height] = [0, 1, 2, 3].map(|i| place[i].as_f64().unwrap());
    let y = top + height / 2.0;
    [[left + 1.0, y], [left + share * width, y]]
}

fn drag_to(page: &mut Page, share: f64) {
    let [from, to] = over_k1(page, share);
    page.drag(from, to);
}

async fn week(service: &Service) -> Vec<Value> {
    let mut ids = Vec::new();
    for day in 0..6 {
        let k2 = if day < 4 { 5.0 } else { 4.5 };
        let rows = measurements([4.0, k2, 6.0], 20, day * DAY_S);
        ids.push(service.post_batch("three-dof", &rows).await["batch"].clone());
    }
    ids
}

#[tokio::test(flavor = "multi_thread")]
async fn an_empty_service_and_a_new_structure_say_what_comes_next() {
    let Some(_turn) = turn().await else { return };
    let folder = tempfile::tempdir().unwrap();
    let models = folder.path().join("models");
    std::fs::create_dir(&models).unwrap();
    let service = Service::spawn(command(&folder.path().join("data")).arg("--models").arg(&models));
    let mut page = Page::open();
    for (theme, width) in [("light", 1400), ("dark", 400)] {
        page.look(theme, width);
        page.visit(&at(&service, ""));
        page.wait_for("document.querySelectorAll('.guide .steps > li').length === 3");
        assert_eq!(page.evaluate(STEPS), json!(["next", "later", "later"]));
        if let Some(found) = axe_findings(&mut page) {
            assert_eq!(found, json!([]), "{theme}, {width} px");
        }
        let overflow = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth");
        assert_eq!(overflow, json!(0), "{theme}, {width} px");
    }
    press_next(&mut page);
    page.wait_for("document.getElementById('describe-text') !== null");
    page.evaluate("document.querySelector('dialog button[type=submit]').click()");
    page.wait_for("location.hash.startsWith('#/structures/my-building')");
    page.wait_for("document.querySelectorAll('.guide .steps > li').length === 4");
    assert_eq!(page.evaluate(STEPS), json!(["done", "next", "later", "later"]));
    press_next(&mut page);
    page.wait_for("document.querySelector('dialog[open] [name=epochs]') !== null");
    assert_eq!(page.complaints(), Vec::<String>::new());
}

#[tokio::test(flavor = "multi_thread")]
async fn where_the_service_trains_by_itself_three_steps_lead_to_the_first_verdict() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn_that_trains_by_itself();
    let put = service.request(reqwest::Method::PUT, "/v1/structures/tiny").header("content-type", "application/toml");
    assert_eq!(put.body(TWO_MASSES).send().await.unwrap().status(), 201);
    let mut page = Page::open();
    page.look("light", 1400);
    page.visit(&at(&service, "#/structures/tiny"));
    page.wait_for("document.querySelectorAll('.guide .steps > li').length === 3");
    assert_eq!(page.evaluate(STEPS), json!(["done", "next", "later"]));
    let hz = two_masses_hz(1000.0, 1400.0);
    let one =
        |i: usize| json!({ "measured_at": time(600 * i), "frequencies_hz": hz.map(|hz| hz * (1.0 + 1e-4 * i as f64)) });
    service.post_batch("tiny", &(0..10).map(one).collect::<Vec<_>>()).await;
    page.wait_for(&format!("JSON.stringify({STEPS}) === JSON.stringify(['done', 'done', 'next'])"));
    assert_eq!(page.complaints(), Vec::<String>::new());
}

#[tokio::test(flavor = "multi_thread")]
async fn dragging_over_a_chart_marks_the_healthy_period() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    let ids = week(&service).await;
    let mut page = Page::open();
    page.look("light", 1400);
    page.visit(&at(&service, "#/structures/three-dof"));
    page.wait_for("document.querySelectorAll('[data-figure=parameter-k1] canvas').length === 2");
    assert_eq!(page.evaluate(STEPS), json!(["done", "done", "done", "next"]));

    // Without the button, dragging zooms; Escape leaves the marking.
    press_next(&mut page);
    page.wait_for("document.querySelector('.marking') !== null");
    page.press("Escape");
    page.wait_for("document.querySelector('.marking') === null");
    drag_to(&mut page, 0.5);
    page.wait_for("location.hash.includes('from=')");
    page.evaluate("[...document.querySelectorAll('.spans button')].find((b) => b.textContent === 'All').click()");
    page.wait_for(
        "!location.hash.includes('from=') && document.querySelector('.spans .fine').textContent.includes('6 batches')",
    );

    // A finger marks as well; giving up leaves everything as it was.
    press_next(&mut page);
    page.wait_for("document.querySelector('.marking') !== null");
    let [from, to] = over_k1(&mut page, 0.5);
    page.swipe(from, to);
    page.wait_for("document.querySelector('dialog[open] input[name=from]') !== null");
    page.press("Escape");
    page.wait_for("document.querySelector('dialog[open]') === null && document.querySelector('.marking') === null");

    // The axis shows five days and three hours with a margin of a hundredth: 68 % of it end between the fourth and the fifth batch.
    press_next(&mut page);
    page.wait_for("document.querySelector('.marking') !== null");
    let [from, to] = over_k1(&mut page, 0.68);
    page.begin_drag(from, to);
    // A batch that arrives during the drag does not end it: the charts are drawn anew after it.
    let answers = "performance.getEntriesByType('resource').filter((entry) => entry.name.includes('/series?')).length";
    let before = page.evaluate(answers);
    service.post_batch("three-dof", &measurements([4.0, 4.5, 6.0], 20, 6 * DAY_S)).await;
    page.wait_for(&format!("{answers} > {before}"));
    page.end_drag(to);
    page.wait_for("document.querySelector('dialog[open] input[name=from]') !== null");
    assert_eq!(page.evaluate("document.querySelectorAll('dialog').length"), json!(1));
    // The marked period stays visible behind the dialog.
    let marked = "Math.max(...[...document.querySelectorAll('.u-select')].map((mark) => mark.clientWidth))";
    assert!(page.evaluate(marked).as_f64().unwrap() > 100.0);
    // Also when the charts are drawn anew, because a batch has arrived.
    let drawn = "document.querySelector('[data-figure=parameter-k1] .u-over')";
    page.evaluate(&format!("window.before = {drawn}"));
    service.post_batch("three-dof", &measurements([4.0, 4.5, 6.0], 20, 7 * DAY_S)).await;
    page.wait_for(&format!("{drawn} !== window.before && {marked} > 100"));
    assert!(!page.evaluate("location.hash").as_str().unwrap().contains("from="), "dragging has zoomed");
    page.evaluate("document.querySelector('dialog button[type=submit]').click()");
    page.wait_for("document.getElementById('notices').textContent.includes('from 4 batches')");
    page.wait_for("document.querySelector('.guide') === null && document.querySelector('.marking') === null");
    assert_eq!(page.evaluate(marked), json!(0));
    let structure = service.read("/v1/structures/three-dof").await;
    assert_eq!(structure["undamaged"]["batches"], json!(ids[..4]), "{structure}");
    page.wait_for("document.querySelector('.headline').textContent.includes('Alarm')");
    assert_eq!(page.complaints_beside_a_change(), Vec::<String>::new());
}
