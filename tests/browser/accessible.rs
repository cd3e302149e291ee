//! What axe says about the views that are not pages of figures, and about the dialogs: nothing, in both themes and on a phone.

use serde_json::json;

use crate::chromium::Page;
use crate::dashboard::{at, axe_findings, turn};
use crate::figures::damaged;
use crate::guide::press_next;
use crate::helpers::{command, spawn, Service};

const LOOKS: [(&str, u32); 4] = [("light", 1400), ("dark", 1400), ("light", 400), ("dark", 400)];

/// Views with what must be there when a view is complete.
const VIEWS: [(&str, &str); 4] = [
    (
        "#/structures/three-dof/report",
        "document.querySelector('.report')?.shadowRoot.textContent.includes('What is not known')",
    ),
    ("#/structures/three-dof?section=upload", "document.querySelector('#upload .drop')?.offsetParent"),
    (
        "#/compare?a=three-dof/k1&b=three-dof/k2",
        "document.querySelectorAll('[data-figure=compare] canvas').length === 1",
    ),
    ("#/jobs", "document.querySelector('main .view') !== null"),
];

/// Dialogs: the section, the place of the button in it, and the beginning of the words on it.
const DIALOGS: [(&str, &str, &str); 11] = [
    ("condition", "#alarms li", "Acknowledge"),
    ("condition", "#alarms li", "Comment"),
    ("condition", "#alarms li", "Assign"),
    ("condition", "#alarms li", "Close"),
    ("maintenance", "#notes", "Add a note"),
    ("condition", ".spans", "From … to …"),
    ("condition", ".spans", "Use this time span"),
    ("model", "#model", "Train another model"),
    ("model", "#model", "Extend this reference"),
    ("diagnosis", "#diagnosis", "Diagnose"),
    ("maintenance", "#maintenance", "Add a maintenance window"),
];

fn check(page: &mut Page, what: &str) {
    let overflow = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth");
    assert_eq!(overflow, json!(0), "the page scrolls sideways: {what}");
    if let Some(found) = axe_findings(page) {
        assert_eq!(found, json!([]), "axe: {what}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn axe_finds_nothing_in_report_upload_comparison_guide_and_dialogs() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    damaged(&service).await;
    let empty = tempfile::tempdir().unwrap();
    let models = empty.path().join("models");
    std::fs::create_dir(&models).unwrap();
    let new = Service::spawn(command(&empty.path().join("data")).arg("--models").arg(&models));
    let mut page = Page::open();
    for (theme, width) in LOOKS {
        page.look(theme, width);
        for (view, complete) in VIEWS {
            page.visit(&at(&service, view));
            page.wait_for(complete);
            check(&mut page, &format!("{view}, {theme}, {width} px"));
        }
        for (section, place, words) in DIALOGS {
            page.visit(&at(&service, &format!("#/structures/three-dof?section={section}")));
            page.wait_for(&format!("document.querySelector('#{section}')?.offsetParent"));
            // What a button does depends on what has been read.
            page.wait_for("document.querySelectorAll('figure canvas').length > 3");
            let button = format!(
                "[...document.querySelectorAll('{place} button')]
                    .find((b) => b.textContent.trim().startsWith({}) && b.offsetParent !== null && !b.disabled)",
                json!(words)
            );
            page.wait_for(&format!("Boolean({button})"));
            page.evaluate(&format!("{button}.click()"));
            page.wait_for(&format!("document.querySelector('dialog[open]') !== null /* {words} */"));
            check(&mut page, &format!("the dialog “{words}”, {theme}, {width} px"));
            let over =
                "(() => { const d = document.querySelector('dialog'); return d.scrollWidth - d.clientWidth; })()";
            assert_eq!(page.evaluate(over), json!(0), "the dialog “{words}” scrolls sideways: {theme}, {width} px");
        }
        // The guide, and the dialog by which a structure is described.
        page.visit(&at(&new, ""));
        page.wait_for("document.querySelectorAll('.guide .steps > li').length === 3");
        check(&mut page, &format!("the guide, {theme}, {width} px"));
        press_next(&mut page);
        page.wait_for(
            "document.querySelector('dialog[open]') !== null && document.getElementById('describe-text') !== null",
        );
        check(&mut page, &format!("the dialog of a new structure, {theme}, {width} px"));
    }
    assert_eq!(page.complaints(), Vec::<String>::new());
}
