//! The drawing of a structure, the condition report, and the dialog that describes a new structure.

use serde_json::{json, Value};

use crate::chromium::Page;
use crate::dashboard::{at, turn};
use crate::helpers::{created, measurements, spawn, Service};

const DAY_S: usize = 86_400;

/// A reference of three days, and three days with a loss of 10 % in k2.
async fn damaged(service: &Service) {
    let mut ids = Vec::new();
    for day in 0..6 {
        let k2 = if day < 3 { 5.0 } else { 4.5 };
        let batch = service.post_batch("three-dof", &measurements([4.0, k2, 6.0], 20, day * DAY_S)).await;
        ids.push(batch["batch"].clone());
        if day == 2 {
            created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": ids })).await).await;
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_drawing_shows_where_the_alarm_is_and_leads_to_its_chart() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    damaged(&service).await;
    let mut page = Page::open();
    page.look("light", 1280);
    page.visit(&at(&service, "#/structures/three-dof"));
    page.wait_for("document.querySelectorAll('.drawing svg [data-name]').length >= 3");
    // The colour of a loss is orange; the springs that have kept their stiffness are nearly grey.
    let colours = "(name) => [...document.querySelectorAll(`.drawing [data-name=${name}] *`)].map((e) => e.getAttribute('stroke'))
        .filter((c) => /^#[0-9a-f]{6}$/.test(c ?? '')).map((c) => [1, 3, 5].map((i) => parseInt(c.slice(i, i + 2), 16)))
        .reduce((most, [r, g, b]) => Math.max(most, r - b), 0)";
    let orange = |page: &mut Page, name: &str| page.evaluate(&format!("({colours})('{name}')")).as_f64().unwrap();
    let [k1, k2] = ["k1", "k2"].map(|name| orange(&mut page, name));
    assert!(k2 > 100.0 && k1 < k2 / 2.0, "k1 {k1}, k2 {k2}");
    page.evaluate(
        "document.querySelector('.drawing [data-name=k1]').dispatchEvent(new MouseEvent('click', { bubbles: true }))",
    );
    page.wait_for("document.querySelector('[data-figure=control] [data-chart=k1]').ariaPressed === 'true'");
    page.evaluate("(() => { const p = document.getElementById('drawing-mode'); p.value = '2'; p.dispatchEvent(new Event('change')); })()");
    page.wait_for("document.querySelector('.drawing svg').textContent.includes('mode 2')");
    assert_eq!(page.complaints(), Vec::<String>::new());
}

#[tokio::test(flavor = "multi_thread")]
async fn the_condition_report_opens_from_the_page_with_its_period_and_verdict() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    damaged(&service).await;
    let overview = service.read("/v1/overview").await;
    let items = overview["items"].as_array().unwrap();
    let verdict = items.iter().find(|item| item["id"] == "three-dof").unwrap()["verdict"].as_str().unwrap();
    let mut page = Page::open();
    for (theme, width) in [("light", 1280), ("dark", 390)] {
        page.look(theme, width);
        page.visit(&at(&service, "#/structures/three-dof"));
        let link = "[...document.querySelectorAll('.spans a')].find((a) => a.textContent === 'Condition report')";
        page.wait_for(&format!("{link}?.getAttribute('href')?.includes('from=')"));
        // The view writes its address between the click and the opening of the report, as it does when an answer of the service arrives then.
        let span = "[...document.querySelectorAll('.picker button')].find((button) => button.textContent === '1 year')";
        page.evaluate(&format!("{{ {link}.click(); {span}.click(); }}"));
        page.wait_for("document.querySelector('.report')?.shadowRoot.textContent.includes('What is not known')");
        let address = page.evaluate("location.hash");
        assert!(address.as_str().unwrap().starts_with("#/structures/three-dof/report?"), "{address}");
        let text = page.evaluate("document.querySelector('.report').shadowRoot.textContent");
        let text = text.as_str().unwrap();
        assert!(text.contains(verdict) && text.contains("6 batches with 120 measurements"), "{text}");
        assert_eq!(page.evaluate("document.querySelectorAll('main button').length"), json!(1));
        let overflow = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth");
        assert_eq!(overflow, json!(0), "{theme}, {width} px");
    }
    assert_eq!(page.complaints(), Vec::<String>::new());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_structure_is_described_from_a_template_and_its_page_says_how_to_train() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    let mut page = Page::open();
    page.visit(&at(&service, ""));
    page.wait_for("document.querySelectorAll('table.fleet tbody tr').length === 3");
    for (template, id) in [("building", "my-building"), ("bridge", "my-bridge")] {
        page.visit(&at(&service, "#/jobs"));
        page.visit(&at(&service, "#/"));
        page.wait_for(
            "[...document.querySelectorAll('main button')].some((b) => b.textContent === 'Describe a structure')",
        );
        page.evaluate("[...document.querySelectorAll('main button')].find((b) => b.textContent === 'Describe a structure').click()");
        page.wait_for("document.getElementById('describe-template') !== null");
        page.evaluate(&format!(
            "(() => {{ const t = document.getElementById('describe-template'); t.value = '{template}'; t.dispatchEvent(new Event('change')); }})()"
        ));
        if template == "building" {
            // A mistake is shown in the dialog, with its place, and nothing is stored.
            page.evaluate("(() => { const t = document.getElementById('describe-text'); t.value = t.value.replace('n_per_m = 9.0e7', 'n_per_m = -9'); })()");
            page.evaluate("document.querySelector('dialog .primary').click()");
            page.wait_for("document.querySelector('dialog .problem')?.textContent.includes('n_per_m')");
            assert!(page.complaints().iter().all(|c| c.contains("422")), "only the refused request is reported");
            page.evaluate("(() => { const t = document.getElementById('describe-text'); t.value = t.value.replace('n_per_m = -9', 'n_per_m = 9.0e7'); })()");
        }
        page.evaluate("document.querySelector('dialog .primary').click()");
        page.wait_for(&format!(
            "document.querySelector('[data-structure=\"{id}\"] #model')?.textContent.includes('modalwatch train')"
        ));
        assert_eq!(page.evaluate("document.getElementById('model').offsetParent !== null"), json!(true));
        let stored: Value = service.read(&format!("/v1/structures/{id}")).await;
        assert!(stored["nominal_frequencies_hz"].as_array().unwrap().len() >= 3, "{stored}");
    }
    assert_eq!(page.complaints(), Vec::<String>::new());
}
