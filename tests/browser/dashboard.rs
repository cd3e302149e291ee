//! Every view is complete, without errors, accessible, updated live and usable by keyboard.

use std::sync::OnceLock;

use serde_json::{json, Value};
use tempfile::TempDir;
use tokio::sync::{Mutex, MutexGuard};

use crate::chromium::Page;
use crate::helpers::{created, measurements, repository, spawn, Service};
use crate::needs;

const UNDAMAGED: [f64; 3] = [4.0, 5.0, 6.0];
const DAMAGED: [f64; 3] = [3.2, 5.0, 6.0];
const DAY_S: usize = 86_400;
const PER_BATCH: usize = 20;

/// One browser at a time, because each uses a core. Without Chromium returns `None` and records the test as skipped.
pub async fn turn() -> Option<MutexGuard<'static, ()>> {
    static TURN: OnceLock<Mutex<()>> = OnceLock::new();
    needs::program("chromium")?;
    Some(TURN.get_or_init(Mutex::default).lock().await)
}

async fn post(service: &Service, k: [f64; 3], day: usize) -> String {
    let answer = service.post_batch("three-dof", &measurements(k, PER_BATCH, day * DAY_S)).await;
    answer["batch"].as_str().unwrap().to_owned()
}

/// An undamaged reference, healthy days, a pause, a batch in another unit, and a loss of k1 that raises an alarm.
async fn watched_bridge(service: &Service) {
    let mut batches = vec![post(service, UNDAMAGED, 0).await, post(service, UNDAMAGED, 1).await];
    let reference = json!({ "batches": batches });
    created(service.post("/v1/structures/three-dof/reference", &reference).await).await;
    for day in [2, 3, 12, 13] {
        batches.push(post(service, UNDAMAGED, day).await);
    }
    let mut swapped = measurements(UNDAMAGED, PER_BATCH, 14 * DAY_S);
    for measurement in &mut swapped {
        measurement["frequencies_hz"].as_array_mut().unwrap().swap(0, 1);
    }
    let rejected = service.post_batch("three-dof", &swapped).await;
    assert_eq!(rejected["assessment"]["trust"], "rejected", "{rejected}");
    for day in 15..18 {
        post(service, DAMAGED, day).await;
    }
    let alarms = service.read("/v1/structures/three-dof/alarms?state=open").await;
    assert_eq!(alarms["items"][0]["parameter"], "k1", "{alarms}");
}

pub fn at(service: &Service, view: &str) -> String {
    format!("http://{}/{view}", service.address())
}

/// The page of the structure, with its charts drawn.
fn visit_structure(page: &mut Page, service: &Service) {
    page.visit(&at(service, "#/structures/three-dof"));
    page.wait_for("document.querySelectorAll('figure canvas').length >= 12");
    page.wait_for("document.querySelectorAll('[data-figure^=density] canvas').length === 3");
}

/// Figures whose canvas is missing or empty.
const BLANK_FIGURES: &str = "
    [...document.querySelectorAll('figure')].filter((figure) => figure.offsetParent !== null).filter((figure) => {
        const canvases = [...figure.querySelectorAll('canvas')];
        return canvases.length === 0 || canvases.some((canvas) => {
            if (canvas.width === 0 || canvas.height === 0) return true;
            const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
            const seen = new Set();
            for (let i = 0; i < data.length; i += 4) if (data[i + 3] > 0) seen.add(data[i] << 16 | data[i + 1] << 8 | data[i + 2]);
            return seen.size < 3;
        });
    }).map((figure) => figure.dataset.figure)";

/// Text alternatives that are missing: an image needs a name and a description, and its table.
const FIGURES_WITHOUT_TEXT: &str = "
    [...document.querySelectorAll('figure')].filter((figure) => figure.offsetParent !== null).filter((figure) => {
        const plot = figure.querySelector('[role=img]');
        const summary = document.getElementById(plot.getAttribute('aria-describedby'))?.textContent ?? '';
        const button = figure.querySelector('.as-table');
        button.click();
        const rows = figure.querySelectorAll('.table-wrap tbody tr').length;
        button.click();
        return summary.length < 20 || rows === 0;
    }).map((figure) => figure.dataset.figure)";

/// All findings of axe-core, with their impact; `None` where it is not installed.
pub fn axe_findings(page: &mut Page) -> Option<Value> {
    let file = repository("target/browser/node_modules/axe-core/axe.min.js");
    let source = needs::installed(&file).then(|| std::fs::read_to_string(file).unwrap())?;
    page.evaluate(&format!("{source}; undefined"));
    let run = "axe.run(document).then(({ violations, passes }) => ({
        rules: passes.length,
        findings: violations.map((v) => [v.impact, v.id, v.nodes.map((n) => n.html.slice(0, 200) + ' ' + n.failureSummary)]),
    }))";
    let outcome = page.evaluate(run);
    assert!(outcome["rules"].as_u64().unwrap() > 10, "axe checked too few elements: {outcome}");
    Some(outcome["findings"].clone())
}

fn check_view(page: &mut Page, what: &str) {
    assert_eq!(page.evaluate(BLANK_FIGURES), json!([]), "empty figures: {what}");
    assert_eq!(page.evaluate(FIGURES_WITHOUT_TEXT), json!([]), "figures without a text alternative: {what}");
    let overflow = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth");
    assert_eq!(overflow, json!(0), "the page scrolls sideways: {what}");
    if let Some(found) = axe_findings(page) {
        assert_eq!(found, json!([]), "axe: {what}");
    }
    assert_eq!(page.complaints(), Vec::<String>::new(), "console: {what}");
}

#[tokio::test(flavor = "multi_thread")]
async fn every_view_is_complete_quiet_and_accessible_in_both_themes_and_on_a_phone() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder): (Service, TempDir) = spawn();
    watched_bridge(&service).await;
    let diagnosis = service.post("/v1/structures/three-dof/diagnoses", &json!({})).await.json::<Value>().await.unwrap();
    let diagnosis = diagnosis["diagnosis"].as_str().unwrap().to_owned();
    let mut page = Page::open();
    page.visit(&at(&service, "#/jobs"));
    page.wait_for(&format!("document.querySelector('[data-job=\"{diagnosis}\"]')?.textContent.includes('Done')"));

    for (theme, width) in [("light", 1400), ("dark", 1400), ("light", 400), ("dark", 400)] {
        page.look(theme, width);
        let seen = |view: &str| format!("{view}, {theme}, {width} px");
        page.visit(&at(&service, ""));
        page.wait_for("document.querySelectorAll('table.fleet tbody tr').length === 3");
        page.wait_for("document.querySelector('tr[data-structure=three-dof]').textContent.includes('Alarm')");
        let ground = page.evaluate("getComputedStyle(document.body).backgroundColor");
        let dark = ["rgb(13, 19, 25)", "rgb(244, 246, 248)"][usize::from(theme == "light")];
        assert_eq!(ground, json!(dark), "{}", seen("colours"));
        check_view(&mut page, &seen("fleet"));

        visit_structure(&mut page, &service);
        for figure in ["parameter-k1", "control", "heat", "trust", "tracks", "density-k1", "modes"] {
            page.wait_for(&format!("document.querySelectorAll('[data-figure=\"{figure}\"] canvas').length > 0"));
        }
        for section in ["condition", "tracks", "batch", "model", "diagnosis", "maintenance"] {
            page.evaluate(&format!("document.querySelector('.jumps [data-section={section}]').click()"));
            // A chart takes its width when it becomes visible.
            page.wait_for("document.querySelectorAll('.jumps [aria-current]').length === 1");
            page.wait_for(
                "[...document.querySelectorAll('figure .plot')].filter((plot) => plot.offsetParent !== null)
                 .every((plot) => { const c = plot.querySelector('canvas'); return !c || Math.abs(c.clientWidth - plot.clientWidth) < 2; })",
            );
            check_view(&mut page, &seen(&format!("structure, {section}")));
            let screens = page.evaluate("document.documentElement.scrollHeight / 900").as_f64().unwrap();
            println!("{}: {screens:.1} screens of 900 px", seen(section));
            assert!(width < 1400 || screens <= 3.0, "{}: {screens:.1} screens of 900 px", seen(section));
        }

        // A structure without measurements shows the next step.
        page.visit(&at(&service, "#/structures/rig"));
        page.wait_for("document.querySelector('main .blank')?.textContent.includes('curl')");
        check_view(&mut page, &seen("structure without batches"));

        page.visit(&at(&service, "#/jobs"));
        page.wait_for("document.querySelectorAll('[data-job]').length > 0");
        check_view(&mut page, &seen("jobs"));

        page.visit(&at(&service, &format!("#/diagnoses/{diagnosis}")));
        page.wait_for("document.querySelector('.report')?.shadowRoot.textContent.includes('In short')");
        check_view(&mut page, &seen("report"));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_batch_posted_elsewhere_appears_without_a_reload() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    watched_bridge(&service).await;
    let mut page = Page::open();
    visit_structure(&mut page, &service);
    page.wait_for("document.getElementById('live').textContent === 'Live'");
    let before = page.evaluate("document.querySelectorAll('#batch-picker option').length").as_u64().unwrap();
    page.evaluate("window.sameLoad = true");

    let batch = post(&service, UNDAMAGED, 19).await;
    page.wait_for(&format!("document.querySelectorAll('#batch-picker option').length === {}", before + 1));
    page.wait_for(&format!("document.getElementById('batch').textContent.includes('{batch}')"));
    assert_eq!(page.evaluate("window.sameLoad"), json!(true), "the page was loaded again");
    assert_eq!(page.complaints(), Vec::<String>::new());

    page.visit(&at(&service, ""));
    page.wait_for("document.querySelector('tr[data-structure=three-dof]')?.textContent.includes('11 batches')");
    post(&service, UNDAMAGED, 20).await;
    page.wait_for("document.querySelector('tr[data-structure=three-dof]').textContent.includes('12 batches')");
}

/// The dialog has been answered and is gone.
const NO_DIALOG: &str = "document.querySelector('dialog') === null";

/// The focused element: its tag, its text and whether the focus is visible.
const FOCUSED: &str = "(() => {
    const element = document.activeElement;
    const { outlineStyle, outlineWidth } = getComputedStyle(element);
    return { tag: element.tagName, text: element.textContent.trim(), label: element.getAttribute('aria-label'),
             row: element.closest('tr')?.dataset.structure ?? null,
             visible: outlineStyle !== 'none' && parseFloat(outlineWidth) >= 2 };
})()";

/// Presses Tab until `wanted` has the focus; each element on the way must show its focus.
fn tab_to(page: &mut Page, wanted: impl Fn(&Value) -> bool) -> Value {
    for _ in 0..120 {
        page.press("Tab");
        let focused = page.evaluate(FOCUSED);
        if focused["tag"] == "BODY" {
            continue;
        }
        assert_eq!(focused["visible"], true, "the focus cannot be seen: {focused}");
        if wanted(&focused) {
            return focused;
        }
    }
    panic!("Tab does not lead there");
}

#[tokio::test(flavor = "multi_thread")]
async fn everything_is_reached_and_done_by_keyboard() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    watched_bridge(&service).await;
    let mut page = Page::open();
    page.visit(&at(&service, ""));
    page.wait_for("document.querySelectorAll('table.fleet tbody tr').length === 3");
    page.wait_for("document.querySelectorAll('.alarms li').length > 0");

    tab_to(&mut page, |f| f["text"] == "Skip to the content");
    tab_to(&mut page, |f| f["text"] == "Fleet");
    tab_to(&mut page, |f| f["text"].as_str().unwrap().starts_with("Jobs"));
    tab_to(&mut page, |f| f["label"].as_str().is_some_and(|l| l.starts_with("Colours")));
    tab_to(&mut page, |f| f["text"].as_str().unwrap().starts_with("Acknowledge"));
    page.press("Enter");
    page.wait_for("document.querySelector('dialog[open]') !== null");
    page.press("Escape");
    page.wait_for(NO_DIALOG);
    let back = page.evaluate(FOCUSED);
    assert!(back["text"].as_str().unwrap().starts_with("Acknowledge"), "the focus is lost: {back}");

    tab_to(&mut page, |f| f["row"] == "three-dof");
    page.press("Enter");
    page.wait_for("document.querySelector('[data-page=structure]') !== null");
    page.wait_for("document.querySelectorAll('[data-figure=control] canvas').length > 0");
    tab_to(&mut page, |f| f["text"] == "1 week");
    page.press("Enter");
    page.wait_for("[...document.querySelectorAll('.spans button')].some((b) => b.ariaPressed === 'true' && b.textContent === '1 week')");
    // The arrow keys move through a chart.
    page.evaluate("document.querySelector('[data-figure=control] .plot').focus()");
    // The chart is drawn again when the week has arrived.
    page.wait_for("!document.querySelector('.spans .fine').textContent.includes('10 batches')");
    page.evaluate("document.querySelector('[data-figure=control] .plot').focus()");
    page.press("ArrowRight");
    page.wait_for("document.querySelector('[data-figure=control] .readout').textContent.includes('shift')");
    tab_to(&mut page, |f| f["text"] == "Show as table");
    page.press("Enter");
    page.wait_for("document.querySelectorAll('[data-figure=control] .table-wrap tbody tr').length > 0");
    tab_to(&mut page, |f| f["text"] == "Diagnosis");
    page.press("Enter");
    tab_to(&mut page, |f| f["text"] == "Diagnose");
    page.press("Enter");
    page.wait_for("document.querySelector('dialog[open]')?.textContent.includes('held out')");
    page.press("Escape");
    page.wait_for(NO_DIALOG);
    assert_eq!(page.complaints(), Vec::<String>::new());
}

#[tokio::test(flavor = "multi_thread")]
async fn the_address_says_what_is_shown_and_shows_it_again() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    let mut ids = Vec::new();
    for day in 0..6 {
        ids.push(post(&service, UNDAMAGED, day).await);
    }
    let mut page = Page::open();
    page.look("light", 1280);
    visit_structure(&mut page, &service);
    assert_eq!(page.evaluate("location.hash"), json!("#/structures/three-dof"));
    page.evaluate("document.querySelector('.jumps [data-section=batch]').click()");
    page.evaluate(&format!(
        "(() => {{ const picker = document.getElementById('batch-picker'); picker.value = '{}'; picker.dispatchEvent(new Event('change')); }})()",
        ids[2]
    ));
    page.evaluate(
        "[...document.querySelectorAll('.spans button')].find((b) => b.textContent === 'From … to …').click()",
    );
    page.wait_for("document.querySelector('dialog[open] input[name=from]') !== null");
    page.evaluate("document.querySelector('input[name=from]').value = '2026-01-02T00:00'");
    page.evaluate("document.querySelector('input[name=to]').value = '2026-01-05T00:00'");
    page.evaluate("document.querySelector('dialog .primary').click()");
    page.wait_for("document.querySelectorAll('#batch-picker option').length === 3");
    let address = page.evaluate("location.hash").as_str().unwrap().to_owned();
    for part in ["section=batch", "from=2026-01-0", &format!("batch={}", ids[2])] {
        assert!(address.contains(part), "{part} is not in {address}");
    }
    // Another page, and back by the address alone.
    page.visit(&at(&service, "#/jobs"));
    page.wait_for("document.querySelector('[data-page=structure]') === null");
    page.visit(&at(&service, &address));
    page.wait_for("document.querySelectorAll('#batch-picker option').length === 3");
    page.wait_for(&format!("document.getElementById('batch').textContent.includes('{}')", ids[2]));
    assert_eq!(page.evaluate("document.getElementById('batch').offsetParent !== null"), json!(true));
    assert_eq!(page.evaluate("document.getElementById('condition').offsetParent"), Value::Null);
    assert_eq!(page.evaluate("location.hash"), json!(address));
    assert_eq!(page.complaints(), Vec::<String>::new());
}

#[tokio::test(flavor = "multi_thread")]
async fn an_alarm_is_acknowledged_and_a_maintenance_window_added_from_the_page() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    watched_bridge(&service).await;
    let mut page = Page::open();
    visit_structure(&mut page, &service);
    page.evaluate("document.querySelector('#alarms button.primary').click()");
    page.wait_for("document.querySelector('dialog[open] input[name=by]') !== null");
    page.evaluate("document.querySelector('input[name=by]').focus()");
    page.type_text("Ines Vogel");
    page.press("Enter");
    page.wait_for("document.getElementById('alarms').textContent.includes('acknowledged by Ines Vogel')");
    // The list may follow the event of the service before the dialog has its answer; until then, a person could not press anything else.
    page.wait_for(NO_DIALOG);
    let alarms = service.read("/v1/structures/three-dof/alarms").await;
    assert_eq!(alarms["items"][0]["acknowledgement"]["by"], "Ines Vogel", "{alarms}");

    // The name is remembered; the alarm is closed with a reason and is then found by the filter.
    let button = |word: &str| {
        format!("[...document.querySelectorAll('#alarms li button')].find((b) => b.textContent.startsWith('{word}')).click()")
    };
    page.evaluate(&button("Close"));
    page.wait_for("document.querySelector('dialog[open] select[name=reason]') !== null");
    page.evaluate("document.querySelector('dialog select').value = 'other'");
    page.evaluate("document.querySelector('dialog .primary').click()");
    page.wait_for("document.querySelector('dialog .problem')?.textContent.includes('/text')");
    page.evaluate("document.querySelector('dialog textarea').value = 'a test of\\nthe alarm'");
    page.evaluate("document.querySelector('dialog .primary').click()");
    page.wait_for("document.getElementById('alarms').textContent.includes('closed by Ines Vogel')");
    page.wait_for(NO_DIALOG);
    page.evaluate("document.querySelector('#alarms [data-filter=closed]').click()");
    page.wait_for("document.querySelectorAll('#alarms > div > ul.alarms > li').length === 1");
    assert_eq!(
        service.read("/v1/structures/three-dof/alarms").await["items"][0]["closing"]["text"],
        "a test of\nthe alarm"
    );
    assert!(page.complaints().iter().all(|c| c.contains("422")), "only the refused request is reported");

    page.evaluate("document.querySelector('#maintenance button').click()");
    page.wait_for("document.querySelector('dialog[open] input[name=reason]') !== null");
    page.evaluate("document.querySelector('input[name=reason]').focus()");
    page.type_text("new bearings");
    // An end before the beginning is refused by the service, and the dialog shows the reason.
    page.evaluate("document.querySelector('input[name=to]').value = '2020-01-01T00:00'");
    page.press("Enter");
    page.wait_for("document.querySelector('dialog .problem')?.textContent.includes('/to')");
    assert!(page.complaints().iter().all(|c| c.contains("422")), "only the refused request is reported");
    page.evaluate("document.querySelector('input[name=to]').value = '2100-01-01T00:00'");
    page.evaluate("document.querySelector('dialog .primary').click()");
    page.wait_for("document.getElementById('maintenance').textContent.includes('new bearings')");
    let windows = service.read("/v1/structures/three-dof/maintenance").await;
    assert_eq!(windows["items"][0]["reason"], "new bearings", "{windows}");
    assert_eq!(page.complaints(), Vec::<String>::new());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_lost_service_is_shown_and_the_page_recovers_by_itself() {
    let Some(_turn) = turn().await else { return };
    let (mut service, folder) = spawn();
    let mut page = Page::open();
    page.visit(&at(&service, ""));
    page.wait_for("document.getElementById('live').textContent === 'Live'");
    service.kill();
    page.wait_for("document.getElementById('live').textContent === 'Reconnecting'");

    let address = service.address().to_owned();
    let mut again = std::process::Command::new(env!("CARGO_BIN_EXE_modalwatch"));
    again.args(["serve", "--listen", &address, "--data-dir"]).arg(folder.path());
    let service = Service::spawn(&mut again);
    post(&service, UNDAMAGED, 0).await;
    page.wait_for("document.getElementById('live').textContent === 'Live'");
    page.wait_for("document.querySelector('tr[data-structure=three-dof]').textContent.includes('1 batch')");
}
