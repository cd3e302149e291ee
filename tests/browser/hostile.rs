//! Pages of others in a browser on the machine of an open service.

use serde_json::json;

use crate::chromium::Page;
use crate::dashboard::{at, turn};
use crate::helpers::spawn;

/// Asks the service to make a backup as a page of any site can: without reading the answer.
fn attack(url: &str) -> String {
    format!(
        "Promise.allSettled([
            fetch('{url}', {{ method: 'POST', mode: 'no-cors' }}),
            fetch('{url}', {{ method: 'POST', mode: 'no-cors', body: '{{}}', headers: {{ 'content-type': 'text/plain' }} }}),
        ])"
    )
}

#[tokio::test(flavor = "multi_thread")]
async fn a_page_or_a_frame_of_somebody_else_cannot_change_an_open_service() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    let (other, _other_folder) = spawn();
    let mut page = Page::open();
    let backups = async || service.read("/v1/backups").await["items"].as_array().unwrap().len();
    let url = at(&service, "").trim_end_matches('/').to_owned() + "/v1/backups";

    // A frame without an origin, as any site can make one.
    let script = format!("<script>{}.finally(() => parent.postMessage('done', '*'))</script>", attack(&url));
    page.call("Page.navigate", &json!({ "url": "about:blank" }));
    page.evaluate(&format!(
        "new Promise((done) => {{
            window.addEventListener('message', () => done(true));
            const frame = document.createElement('iframe');
            frame.setAttribute('sandbox', 'allow-scripts');
            frame.srcdoc = {};
            document.body.append(frame);
        }})",
        json!(script)
    ));
    assert_eq!(backups().await, 0, "a frame without an origin made a backup");

    // A page of another port of the same machine, whose content policy does not reach a page that the test writes.
    page.visit(&at(&other, ""));
    page.evaluate(&attack(&url));
    assert_eq!(backups().await, 0, "a page of another origin made a backup");

    // The page of the service itself may.
    page.visit(&at(&service, ""));
    page.evaluate(&attack(&url));
    assert!(backups().await > 0, "the page of the service cannot make a backup: the test shows nothing");
}
