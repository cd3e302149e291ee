//! A spreadsheet file with German dates and decimal commas is dragged onto the page, checked, and stored as batches.

use std::fmt::Write as _;

use serde_json::{json, Value};

use crate::chromium::Page;
use crate::dashboard::{at, axe_findings, turn};
use crate::helpers::{measurements, spawn};

const DAYS: usize = 3;

/// Four rows a day as a German spreadsheet writes them, and one without values.
fn german() -> String {
    let mut table = "Datum;Mode 1 (Hz);Mode 2 (Hz);Mode 3 (Hz);Bemerkung\r\n".to_owned();
    for row in (0..DAYS).flat_map(|day| measurements([4.0, 5.0, 6.0], 4, 86_400 * day + 36_000)) {
        let time = row["measured_at"].as_str().unwrap();
        let f: Vec<String> = row["frequencies_hz"].as_array().unwrap().iter().map(Value::to_string).collect();
        let date = format!("{}.{}.{} {}", &time[8..10], &time[5..7], &time[..4], &time[11..16]);
        write!(table, "{date};{};gemessen\r\n", f.join(";").replace('.', ",")).unwrap();
    }
    table + "04.01.2026 12:00;n/a;n/a;n/a;Ausfall\r\n"
}

/// Sets a field of the dialog as a user does.
fn set(page: &mut Page, id: &str, value: &str) {
    page.evaluate(&format!(
        "{{ const field = document.getElementById('{id}'); field.value = '{value}'; field.dispatchEvent(new Event('change')); }}"
    ));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_german_spreadsheet_file_is_dragged_checked_and_stored_as_days() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    let mut page = Page::open();
    page.look("light", 1280);
    page.visit(&at(&service, "#/structures/three-dof"));
    page.wait_for("document.querySelector('#upload .drop') !== null");
    // Windows-1252, as spreadsheets save: the ü is one byte.
    let text = json!(german().replace("Bemerkung", "Prufung")).to_string();
    page.evaluate(&format!(
        "{{ const bytes = Uint8Array.from([...{text}.replace('Prufung', 'Pr\\u00fcfung')].map((c) => c.charCodeAt(0)));
           const data = new DataTransfer();
           data.items.add(new File([bytes], 'messung.csv', {{ type: 'text/csv' }}));
           document.querySelector('#upload .drop').dispatchEvent(new DragEvent('drop', {{ dataTransfer: data, cancelable: true }})); }}"
    ));
    let status = "document.querySelector('.upload-status')?.textContent";
    // What the table does not say is asked for, at the fields that answer it.
    page.wait_for(&format!("{status}?.includes('do not say their time zone')"));
    page.wait_for(&format!("{status}.includes('A column is not recognised')"));
    assert_eq!(page.evaluate("document.getElementById('upload-zone').getAttribute('aria-invalid')"), json!("true"));
    assert_eq!(page.evaluate("document.querySelector('.upload-dialog button[type=submit]').disabled"), json!(true));
    assert!(page.evaluate("document.querySelector('dialog').textContent").as_str().unwrap().contains("Windows-1252"));
    set(&mut page, "upload-zone", "Europe/Berlin");
    page.evaluate(
        "{ const choice = document.querySelector('select[aria-label^=\"Column 5, Pr\\u00fcfung\"]'); choice.value = 'ignore'; choice.dispatchEvent(new Event('change')); }",
    );
    page.wait_for(&format!("{status}.includes('span more than 48 hours')"));
    set(&mut page, "upload-split", "1d");
    page.wait_for(&format!("{status}.includes('13 rows: 12 taken, 1 refused, in 3 batches')"));
    let shown = page.evaluate("document.querySelector('dialog').textContent");
    for words in
        ["decimal comma", "times in Europe/Berlin", "Line 14: all modes are missing", "3 batches would be made"]
    {
        assert!(shown.as_str().unwrap().contains(words), "{words}: {shown}");
    }
    for (theme, width) in [("light", 1280), ("dark", 1280), ("light", 400), ("dark", 400)] {
        page.look(theme, width);
        let seen = format!("{theme}, {width} px");
        if let Some(found) = axe_findings(&mut page) {
            assert_eq!(found, json!([]), "axe: {seen}");
        }
        let over = "(() => { const d = document.querySelector('dialog'); return d.scrollWidth - d.clientWidth; })()";
        assert_eq!(page.evaluate(over), json!(0), "the dialog scrolls sideways: {seen}");
    }
    page.evaluate("document.querySelector('.upload-dialog button[type=submit]').focus()");
    page.press("Enter");
    page.wait_for("document.querySelector('[data-upload=done]')?.textContent.includes('3 batches stored.')");
    let history = service.read("/v1/structures/three-dof/history").await;
    let items = history["items"].as_array().unwrap();
    assert_eq!(items.len(), DAYS, "{history}");
    // Ten o'clock in Berlin in winter.
    assert!(items.iter().any(|batch| batch["measured_from"] == "2026-01-01T09:00:00Z"), "{history}");
    page.press("Escape");
    page.wait_for("document.querySelector('dialog') === null");
    // The batches appear without a reload.
    page.wait_for("document.querySelectorAll('figure canvas').length > 3");
    assert_eq!(page.complaints(), Vec::<String>::new());
}
