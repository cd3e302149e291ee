//! A simulation that lacks an effect: diagnosis, extension and undoing the extension, all from the page.

use std::f64::consts::TAU;
use std::time::Duration;

use rand::{Rng, SeedableRng as _};
use rand_distr::StandardNormal;
use serde_json::{json, Value};

use crate::chromium::Page;
use crate::dashboard::{at, turn};
use crate::helpers::{
    command, created, time, train_model, two_masses_hz, two_masses_with_temperature, within, Service,
};

/// Relative change of k2 per °C.
const SOFTENING: f64 = -0.004;

/// Ten measurements of a day of 2026; k2 softens with the temperature.
pub fn batch(day: usize, rng: &mut impl Rng) -> Vec<Value> {
    let mut one = |i: usize| {
        let mut normal = || rng.sample::<f64, _>(StandardNormal);
        let temperature_c = 10.0 - 13.0 * (TAU * day as f64 / 365.0).cos() + 2.0 * normal();
        let k1 = 1000.0 * (1.0 + 0.006 * normal());
        let k2 = 1400.0 * (1.0 + SOFTENING * (temperature_c - 10.0)) * (1.0 + 0.006 * normal());
        let f = two_masses_hz(k1, k2).map(|f| f * (1.0 + 0.002 * normal()));
        let covariates = json!({ "temperature_c": temperature_c });
        json!({ "measured_at": time(86_400 * day + 600 * i), "frequencies_hz": f, "covariates": covariates })
    };
    (0..10).map(&mut one).collect()
}

/// Waits until the extension of the newest diagnosis has ended.
async fn extension_ended(service: &Service) -> Value {
    within(Duration::from_mins(3), "the end of the extension", async || {
        let listed = service.read("/v1/structures/tiny/diagnoses").await;
        let path = format!("/v1/diagnoses/{}", listed["items"][0]["diagnosis"].as_str().unwrap());
        Some(service.read(&path).await).filter(|diagnosis| diagnosis["extension"]["state"] != "running")
    })
    .await
}

/// Presses a button of a section and confirms what the dialog asks.
fn press_and_confirm(page: &mut Page, section: &str, button: &str) {
    press_and_fill(page, section, button, &[]);
}

/// Presses a button of a section, fills fields of the dialog and confirms it.
pub fn press_and_fill(page: &mut Page, section: &str, button: &str, fields: &[(&str, &str)]) {
    let find = format!(
        "[...document.querySelectorAll('#{section} button')].find((b) => b.textContent === '{button}' && !b.hidden)"
    );
    page.wait_for(&format!("Boolean({find})"));
    page.evaluate(&format!("{find}.click()"));
    page.wait_for("document.querySelector('dialog[open]') !== null");
    for (field, value) in fields {
        page.evaluate(&format!("document.getElementById('field-{field}').value = '{value}'"));
    }
    page.evaluate("document.querySelector('dialog button[type=submit]').click()");
    page.wait_for("document.querySelector('dialog') === null");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_diagnosis_extends_the_model_with_live_progress_and_the_extension_can_be_undone() {
    let Some(_turn) = turn().await else { return };
    let folder = tempfile::tempdir().unwrap();
    let models = folder.path().join("models");
    train_model(&models.join("tiny"), &two_masses_with_temperature(), "0.5,2", 10_000, 20);
    let service = Service::spawn(command(&folder.path().join("data")).arg("--models").arg(&models));
    let mut rng = rand_chacha::ChaCha12Rng::seed_from_u64(7);
    let mut batches = Vec::new();
    for number in 0..40 {
        batches.push(service.post_batch("tiny", &batch(6 * number, &mut rng)).await["batch"].clone());
    }
    created(service.post("/v1/structures/tiny/reference", &json!({ "batches": &batches[..6] })).await).await;
    let before = service.read("/v1/structures/tiny").await;

    let mut page = Page::open();
    page.visit(&at(&service, "#/structures/tiny"));
    page.evaluate("window.sameLoad = true");
    // The dialog offers period and hold-out: 12 July is day 192 of the year, and 32 batches were measured before it.
    let fields = [("from", "2026-01-01"), ("to", "2026-07-11"), ("share", "30")];
    press_and_fill(&mut page, "diagnosis", "Diagnose", &fields);
    page.wait_for("document.querySelector('#diagnosis li')?.textContent.includes('k2 falls by')");
    // The card says what was found, how sure this is, what is gained, and why the diagnosis ran.
    let card = page.wait_for("document.querySelector('#latest-diagnosis:not([hidden])')?.textContent");
    let card = card.as_str().unwrap();
    for part in [
        "The cause is found",
        "k2 falls by",
        "> 99.9 %",
        "mode 1 ",
        " → ",
        "held-out measurements",
        "clearly better",
        "on request",
    ] {
        assert!(card.contains(part), "{part} is not in the card: {card}");
    }
    let listed = service.read("/v1/structures/tiny/diagnoses").await;
    let newest = listed["items"][0]["diagnosis"].as_str().unwrap();
    let result = service.read(&format!("/v1/diagnoses/{newest}")).await["result"].clone();
    assert_eq!((&result["training_rows"], &result["holdout_rows"]), (&json!(224), &json!(96)), "{result}");
    // Long enough that the page, which reads its jobs once a second, shows the training while it runs.
    press_and_fill(&mut page, "latest-diagnosis", "Extend the model", &[("epochs", "150")]);

    // The progress bar of the job grows while the page is shown.
    page.evaluate("location.hash = '#/jobs'");
    let job = "[...document.querySelectorAll('[data-job]')].find((row) => row.textContent.includes('Model extension'))";
    let bar = format!("{job}?.querySelector('progress')?.value");
    let first = page.wait_for(&format!("{job}?.textContent.includes('epoch') && {bar}")).as_f64().unwrap();
    page.wait_for(&format!("({bar} ?? 1) > {first}"));
    let extended = extension_ended(&service).await;
    assert_eq!(extended["extension"]["state"], "done", "{extended}");
    page.wait_for(&format!("{job}.textContent.includes('Done')"));

    page.evaluate("location.hash = '#/structures/tiny'");
    page.wait_for("document.querySelector('#diagnosis li')?.textContent.includes('The model has been extended')");
    page.wait_for(
        "document.getElementById('latest-diagnosis').textContent.includes('has been extended by this diagnosis')",
    );
    let after = service.read("/v1/structures/tiny").await;
    assert_eq!(after["digest"], extended["extension"]["result"]["structure_digest"]);
    assert_ne!(after["digest"], before["digest"]);

    press_and_confirm(&mut page, "diagnosis", "Undo last extension");
    page.wait_for("document.getElementById('notices').textContent.includes('The previous version has been restored')");
    let back = service.read("/v1/structures/tiny").await;
    assert_eq!((&back["digest"], &back["model"]["digest"]), (&before["digest"], &before["model"]["digest"]));
    assert_eq!(page.evaluate("window.sameLoad"), json!(true), "the page was loaded again");
    assert_eq!(page.complaints_beside_a_change(), Vec::<String>::new());
}
