//! Rejected batches: the alarm, the diagnosis that it starts, and the way from one to the other.

use serde_json::json;

use crate::chromium::Page;
use crate::dashboard::{at, turn};
use crate::helpers::{command, created, measurements, Service};

#[tokio::test(flavor = "multi_thread")]
async fn the_diagnosis_that_an_alarm_starts_appears_by_itself_and_the_alarm_links_to_it() {
    let Some(_turn) = turn().await else { return };
    let folder = tempfile::tempdir().unwrap();
    let service = Service::spawn(command(folder.path()).env("MODALWATCH__DIAGNOSIS__DELAY_S", "0"));
    let mut page = Page::open();
    page.look("light", 1280);
    page.visit(&at(&service, "#/structures/three-dof"));
    page.evaluate("window.sameLoad = true");
    assert_eq!(page.evaluate("document.getElementById('latest-diagnosis').hidden"), json!(true));

    let day = |number: usize| measurements([4.0, 5.0, 6.0], 10, 86_400 * number);
    let mut ids = Vec::new();
    for number in 0..5 {
        ids.push(service.post_batch("three-dof", &day(number)).await["batch"].clone());
    }
    created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": ids[..2] })).await).await;
    for number in 5..8 {
        let mut rows = day(number);
        for row in &mut rows {
            row["frequencies_hz"][1] = json!(0.8 * row["frequencies_hz"][1].as_f64().unwrap());
        }
        service.post_batch("three-dof", &rows).await;
    }

    let card = "document.querySelector('#latest-diagnosis:not([hidden])')";
    page.wait_for(&format!("{card}?.textContent.includes('because of alarm 1')"));
    page.wait_for(&format!("{card}.querySelector('.callout strong') !== null"));
    let link = "[...document.querySelectorAll('#alarms a')].find((a) => a.textContent === 'Diagnosis')";
    let target = page.wait_for(&format!("{link}?.getAttribute('href')"));
    let listed = service.read("/v1/structures/three-dof/diagnoses").await;
    let id = listed["items"][0]["diagnosis"].as_str().unwrap();
    assert_eq!(target, json!(format!("#/diagnoses/{id}")));
    println!("{}", page.evaluate(&format!("{card}.textContent")));
    page.evaluate(&format!("{link}.click()"));
    page.wait_for("document.querySelector('.report')?.shadowRoot.textContent.includes('In short')");
    assert_eq!(page.evaluate("window.sameLoad"), json!(true), "the page was loaded again");
    assert_eq!(page.complaints_beside_a_change(), Vec::<String>::new());
}
