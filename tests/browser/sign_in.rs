//! Signing in on the page of a service that requires tokens.

use std::process::Command;

use serde_json::{json, Value};

use crate::chromium::Page;
use crate::dashboard::{at, turn};
use crate::helpers::{command, created, measurements, Service};

/// Creates a token in the data folder of a service that is not running.
fn first_token(data_dir: &std::path::Path) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_modalwatch"));
    command.args(["token", "create", "--name", "first", "--scope", "admin", "--data-dir"]).arg(data_dir);
    let made = command.output().unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    String::from_utf8(made.stdout).unwrap().trim().to_owned()
}

/// Enters a token in the dialog that asks for one.
fn sign_in(page: &mut Page, token: &str) {
    page.wait_for("document.querySelectorAll('dialog[open] input[name=token]').length === 1");
    page.evaluate("document.querySelector('input[name=token]').focus()");
    page.type_text(token);
    page.press("Enter");
    page.wait_for(&format!("sessionStorage.getItem('modalwatch.token') === '{token}'"));
}

/// Asserts that the only errors of the page are those of the browser about answers with this status.
fn only_reports(page: &mut Page, status: u16) {
    let complaints = page.complaints();
    assert!(complaints.iter().all(|complaint| complaint.contains(&format!("status of {status}"))), "{complaints:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_wrong_token_is_refused_with_a_message_and_the_right_one_shows_the_fleet() {
    let Some(_turn) = turn().await else { return };
    let folder = tempfile::tempdir().unwrap();
    let admin = first_token(folder.path());
    let service = Service::start(folder.path());
    let mut page = Page::open();
    page.call("Page.navigate", &json!({ "url": at(&service, "") }));
    page.wait_for("document.querySelector('dialog[open]') !== null");
    let refused = |page: &mut Page| {
        page.evaluate("document.querySelector('dialog').textContent.includes('did not accept the token')")
    };
    assert_eq!(refused(&mut page), json!(false));
    // A token of the right form that the service does not know.
    let wrong = format!("mw_{}_{}", "0".repeat(16), "0".repeat(52));
    sign_in(&mut page, &wrong);
    page.wait_for("document.querySelector('dialog[open]')?.textContent.includes('did not accept the token')");
    assert_eq!(page.evaluate("document.querySelectorAll('table.fleet tbody tr').length"), json!(0));
    only_reports(&mut page, 401);

    sign_in(&mut page, &admin);
    page.wait_for("document.querySelectorAll('table.fleet tbody tr').length === 3");
    page.wait_for("document.getElementById('live').textContent === 'Live'");
    assert_eq!(page.evaluate("document.querySelector('dialog')"), Value::Null);
    assert_eq!(page.evaluate("localStorage.getItem('modalwatch.token')"), Value::Null, "the token outlives the tab");
    only_reports(&mut page, 401);

    page.visit(&at(&service, "#/structures/three-dof"));
    page.wait_for("document.getElementById('sign')?.textContent === 'Sign out'");
    page.evaluate("document.getElementById('sign').click()");
    page.wait_for("document.querySelector('dialog[open] input[name=token]') !== null");
    assert_eq!(page.evaluate("sessionStorage.getItem('modalwatch.token')"), Value::Null);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_read_token_sees_everything_and_a_refused_change_names_the_missing_scope() {
    let Some(_turn) = turn().await else { return };
    let folder = tempfile::tempdir().unwrap();
    let admin = first_token(folder.path());
    let service = Service::spawn(&mut command(folder.path()));
    let post = async |path: &str, body: Value| {
        created(service.request(reqwest::Method::POST, path).bearer_auth(&admin).json(&body).send().await.unwrap())
            .await
    };
    let reader = post("/v1/tokens", json!({ "name": "control room", "scopes": ["read"] })).await;
    let batch = json!({ "measurements": measurements([4.0, 5.0, 6.0], 20, 0) });
    post("/v1/structures/three-dof/batches", batch).await;

    let mut page = Page::open();
    page.call("Page.navigate", &json!({ "url": at(&service, "#/structures/three-dof") }));
    sign_in(&mut page, reader["token"].as_str().unwrap());
    page.wait_for("document.querySelectorAll('figure canvas').length > 0");
    page.wait_for("document.getElementById('live').textContent === 'Live'");
    only_reports(&mut page, 401);
    page.evaluate(
        "[...document.querySelectorAll('#diagnosis button')].find((b) => b.textContent === 'Diagnose').click()",
    );
    page.wait_for("document.querySelector('dialog[open] .primary') !== null");
    page.evaluate("document.querySelector('dialog .primary').click()");
    page.wait_for("document.querySelector('dialog .problem')?.textContent.includes('admin')");
    only_reports(&mut page, 403);
    let jobs = service.get("/v1/jobs").bearer_auth(&admin).send().await.unwrap().json::<Value>().await.unwrap();
    assert_eq!(jobs["items"], json!([]));
    // A 403 does not make the page ask for another token.
    assert!(page.evaluate("document.querySelector('input[name=token]')").is_null());
    assert_eq!(page.evaluate("sessionStorage.getItem('modalwatch.token')"), reader["token"]);
}
