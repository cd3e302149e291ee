//! From a structure without a model to assessed batches, by the page alone.

use std::time::Duration;

use reqwest::Method;
use serde_json::json;

use crate::chromium::Page;
use crate::dashboard::{at, axe_findings, turn};
use crate::extension::{batch, press_and_fill};
use crate::helpers::{spawn, two_masses_with_temperature, within};

#[tokio::test(flavor = "multi_thread")]
async fn a_model_is_trained_from_the_page_with_its_progress_and_assesses_what_waited() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    let put = service.request(Method::PUT, "/v1/structures/tiny").header("content-type", "application/toml");
    assert_eq!(put.body(two_masses_with_temperature()).send().await.unwrap().status(), 201);
    let mut rng = rand::SeedableRng::seed_from_u64(7);
    let rng: &mut rand_chacha::ChaCha12Rng = &mut rng;
    let few = batch(0, rng);
    let posted = service.post_batch("tiny", &few[..4]).await;

    let mut page = Page::open();
    page.visit(&at(&service, "#/structures/tiny?section=diagnosis"));
    page.wait_for("document.getElementById('diagnosis').textContent.includes('a diagnosis needs at least 8')");
    let diagnose = "[...document.querySelectorAll('#diagnosis button')].find((b) => b.textContent === 'Diagnose')";
    assert_eq!(page.evaluate(&format!("{diagnose}.disabled")), json!(true), "it could not run");

    page.visit(&at(&service, "#/structures/tiny?section=model"));
    page.wait_for("document.getElementById('model').textContent.includes('No model has been trained here yet')");
    // A wrong number is named, and the dialog stays.
    let find = "[...document.querySelectorAll('#model button')].find((b) => b.textContent === 'Train a model')";
    page.wait_for(&format!("{find} && !{find}.disabled"));
    page.evaluate(&format!("{find}.click()"));
    page.wait_for("document.querySelector('dialog[open]') !== null");
    assert_eq!(page.evaluate("document.getElementById('field-samples').value"), json!("200000"));
    assert_eq!(page.evaluate("document.getElementById('field-rounds').value"), json!("4"));
    page.evaluate("document.getElementById('field-epochs').value = 'many'");
    page.evaluate("document.querySelector('dialog button[type=submit]').click()");
    page.wait_for("document.querySelector('dialog .problem')?.textContent.includes('“many” is not a whole number')");
    for (theme, width) in [("light", 1280), ("dark", 390)] {
        page.look(theme, width);
        if let Some(findings) = axe_findings(&mut page) {
            assert_eq!(findings, json!([]), "{theme} {width}");
        }
    }
    page.evaluate("document.querySelector('dialog button:not([type=submit])').click()");
    // A dialog leaves the page a moment after it is closed.
    page.wait_for("document.querySelector('dialog') === null");

    // A training that is cancelled, then one that is used.
    press_and_fill(&mut page, "model", "Train a model", &[("samples", "20000"), ("epochs", "2000")]);
    page.wait_for("document.querySelector('#model progress') !== null");
    page.wait_for("document.getElementById('model').textContent.includes('left')");
    press_and_fill(&mut page, "model", "Cancel", &[]);
    page.wait_for("document.getElementById('model').textContent.includes('Cancelled')");
    let fields = [("samples", "10000"), ("epochs", "20"), ("rounds", "1"), ("lowest", "0.5"), ("highest", "2")];
    press_and_fill(&mut page, "model", "Train a model", &fields);
    within(Duration::from_mins(3), "the training", async || {
        let trainings = service.read("/v1/structures/tiny/trainings").await;
        (trainings["items"][0]["state"] == "done").then_some(())
    })
    .await;
    page.wait_for("document.getElementById('model').textContent.includes('The model is in use')");
    page.wait_for("document.getElementById('model').textContent.includes('Digest of the model')");
    let path = format!("/v1/structures/tiny/batches/{}", posted["batch"].as_str().unwrap());
    within(Duration::from_mins(1), "the assessment", async || {
        (service.read(&path).await["state"] == "assessed").then_some(())
    })
    .await;
    page.evaluate("location.hash = '#/jobs'");
    page.wait_for("document.querySelectorAll('[data-job]').length === 2");
    if let Some(findings) = axe_findings(&mut page) {
        assert_eq!(findings, json!([]));
    }
    assert_eq!(page.complaints(), Vec::<String>::new());
}
