//! New damage in the measurements that a diagnosis holds out by default, from the page: it is named, and nothing calls it healthy.

use std::time::Duration;

use rand::SeedableRng as _;
use serde_json::json;

use crate::chromium::Page;
use crate::dashboard::{at, turn};
use crate::extension::press_and_fill;
use crate::figures::assert_explained;
use crate::helpers::{command, created, Service};
use crate::tower::{batch, STRUCTURE};

#[tokio::test(flavor = "multi_thread")]
async fn the_page_names_the_day_from_which_data_behave_differently_and_calls_nothing_healthy() {
    let Some(_turn) = turn().await else { return };
    let folder = tempfile::tempdir().unwrap();
    let models = folder.path().join("models");
    std::fs::create_dir_all(models.join("tower")).unwrap();
    std::fs::write(models.join("tower/structure.toml"), STRUCTURE).unwrap();
    let service = Service::spawn(command(&folder.path().join("data")).arg("--models").arg(&models));
    let mut rng = rand_chacha::ChaCha12Rng::seed_from_u64(2_210);
    for first in (0..360).step_by(10) {
        let measurements = json!({ "measurements": batch(first, &mut rng) });
        created(service.post("/v1/structures/tower/batches", &measurements).await).await;
    }

    let mut page = Page::open();
    page.look("light", 1280);
    page.visit(&at(&service, "#/structures/tower?section=diagnosis"));
    page.evaluate(
        "[...document.querySelectorAll('#diagnosis button')].find((b) => b.textContent === 'Diagnose').click()",
    );
    assert_explained(&mut page, "dialog", "Hold-out");
    page.evaluate("document.querySelector('dialog button[type=button]:not(.help)').click()");
    page.wait_for("document.querySelector('dialog') === null");
    press_and_fill(&mut page, "diagnosis", "Diagnose", &[]);
    let change = "document.querySelector('#latest-diagnosis:not([hidden]) [data-finding=lasting-change]')?.textContent";
    let shown = page.wait_within(change, Duration::from_mins(5));
    let listed = service.read("/v1/structures/tower/diagnoses").await;
    let id = listed["items"][0]["diagnosis"].as_str().unwrap().to_owned();
    let result = service.read(&format!("/v1/diagnoses/{id}")).await["result"].clone();
    assert_eq!(shown, result["lasting_change"]["sentence"], "{result}");
    let shown = shown.as_str().unwrap();
    assert!(shown.contains("k2") && shown.contains("September 2024"), "{shown}");
    let card = page.evaluate("document.getElementById('latest-diagnosis').textContent");
    let card = card.as_str().unwrap();
    assert!(card.contains("k1") && card.contains("whether the structure was undamaged there is not known"), "{card}");
    let calls_healthy = |text: &str| text.to_lowercase().contains("healthy");
    assert!(!calls_healthy(card), "{card}");

    assert_explained(&mut page, "#latest-diagnosis", "Gain");

    // The report, which the card links to.
    page.evaluate(
        "[...document.querySelectorAll('#latest-diagnosis a')].find((a) => a.textContent === 'Report').click()",
    );
    let report = "document.querySelector('.report')?.shadowRoot";
    page.wait_for(&format!("{report}?.textContent.includes('In short')"));
    let text = page.evaluate(&format!("{report}.textContent"));
    let text = text.as_str().unwrap();
    assert!(text.contains("may be damage") && text.contains("September 2024"), "{text}");
    assert!(!calls_healthy(text), "{text}");
    assert_eq!(page.evaluate("location.hash"), json!(format!("#/diagnoses/{id}")));
    assert_eq!(page.complaints(), Vec::<String>::new());
}
