//! Pages of others in a browser on the machine of an open service.

use std::io::{Read as _, Write as _};
use std::net::TcpListener;

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

/// A web server of somebody else, which serves an empty page. Returns its port.
fn web_site() -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    // It ends with the process of the tests.
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let Ok(mut stream) = stream else { continue };
            let _ = stream.read(&mut [0; 4096]);
            let page = "<!doctype html><title>prize</title>";
            let head = "HTTP/1.1 200 OK\r\nContent-Type: text/html\r\nConnection: close";
            let _ = write!(stream, "{head}\r\nContent-Length: {}\r\n\r\n{page}", page.len());
        }
    });
    port
}

/// Loads an address in the page and waits for it.
fn load(page: &mut Page, url: &str) {
    page.call("Page.navigate", &json!({ "url": url }));
    page.wait_for(&format!("location.href.startsWith({}) && document.readyState === 'complete'", json!(url)));
}

/// Sends a form to an address, as a page of any site can, and waits for the answer in the page.
fn send_form(page: &mut Page, url: &str) {
    page.evaluate(&format!(
        "(() => {{
            const form = document.createElement('form');
            Object.assign(form, {{ method: 'POST', enctype: 'text/plain', action: {} }});
            form.append(Object.assign(document.createElement('input'), {{ name: '{{\"a\":\"', value: '\"}}' }}));
            document.body.append(form);
            setTimeout(() => form.submit());
        }})()",
        json!(url)
    ));
    page.wait_for(&format!("location.href === {} && document.readyState === 'complete'", json!(url)));
}

#[tokio::test(flavor = "multi_thread")]
async fn neither_a_form_nor_a_foreign_host_name_reaches_an_open_service() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    let port = service.address().rsplit(':').next().unwrap().to_owned();
    let own = at(&service, "").trim_end_matches('/').to_owned();
    let (backup, reload) = ("/v1/backups", "/v1/structures/three-dof/model/reload");
    // Attempts that the service has carried out: backups, and entries of the audit about a reload that was not refused by origin.
    let carried_out = async || {
        let audit = service.read("/v1/audit?limit=1000").await;
        let reloads = audit["items"].as_array().unwrap().iter();
        let reloads = reloads
            .filter(|entry| entry["action"] == "POST /v1/structures/{id}/model/reload" && entry["status"] != 403)
            .count();
        [service.read(backup).await["items"].as_array().unwrap().len(), reloads]
    };
    // The owner of a domain decides which address it has.
    let mut page =
        Page::open_with(&["--host-resolver-rules=MAP evil.example 127.0.0.1", "--disable-features=HttpsUpgrades"]);
    let foreign = format!("http://evil.example:{}/", web_site());
    for path in [backup, reload] {
        let url = format!("{own}{path}");
        load(&mut page, &foreign);
        page.evaluate(&attack(&url));
        send_form(&mut page, &url);
        assert_eq!(carried_out().await, [0, 0], "a page of another site reached {path}");
    }

    // A page whose host name has become the address of the service is of the same origin as far as the browser can tell.
    load(&mut page, &format!("http://evil.example:{port}/"));
    for (method, path) in [("GET", "/v1/structures"), ("POST", backup), ("POST", reload)] {
        let fetch = format!("fetch('{path}', {{ method: '{method}' }}).then((answer) => answer.status)");
        assert_eq!(page.evaluate(&fetch), json!(403), "{method} {path} by a foreign host name");
    }
    assert_eq!(carried_out().await, [0, 0], "a page with a foreign host name reached the service");

    // The same by the service's own page shows that these attempts would be seen.
    page.visit(&at(&service, ""));
    for path in [backup, reload] {
        page.evaluate(&attack(path));
    }
    let seen = carried_out().await;
    assert!(seen.iter().all(|count| *count > 0), "{seen:?}: the test shows nothing");
}
