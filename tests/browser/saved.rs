//! Every kind of figure as a file, notes that stay, and two structures compared.

use serde_json::{json, Value};

use crate::chromium::Page;
use crate::dashboard::{at, turn};
use crate::extension::press_and_fill;
use crate::figures::{column, damaged, saved};
use crate::helpers::{created, eventually, spawn};
use crate::labels::table;
use crate::units::both_sizes;

/// The views of a structure with a temperature, with the figures in each.
const VIEWS: [(&str, &[&str]); 4] = [
    ("#/structures/warm", &["parameter-k1", "control", "heat", "trust"]),
    ("#/structures/warm?section=tracks", &["tracks", "scatter"]),
    ("#/structures/warm?section=batch", &["density-k1", "modes"]),
    ("#/compare?a=warm/k1&b=micro/k1", &["compare"]),
];

/// The cells of a CSV line, of which some are quoted.
fn cells(line: &str) -> Vec<String> {
    let mut cells = vec![String::new()];
    let mut quoted = false;
    for c in line.chars() {
        match c {
            '"' => quoted = !quoted,
            ',' if !quoted => cells.push(String::new()),
            c => cells.last_mut().unwrap().push(c),
        }
    }
    cells
}

/// A CSV has as many cells in each row as names of columns, units at columns of numbers, and no cell that only a program can read.
fn assert_is_a_table(csv: &str, figure: &str) {
    let lines: Vec<Vec<String>> = csv.split_terminator("\r\n").map(cells).collect();
    assert!(lines.len() > 1 && lines[0].len() > 1, "{figure}: {csv}");
    for line in &lines {
        assert_eq!(line.len(), lines[0].len(), "{figure}: {line:?} under {:?}", lines[0]);
        let unreadable =
            |cell: &String| ["NaN", "Infinity", "undefined", "null", "[object"].iter().any(|w| cell.contains(w));
        assert!(!line.iter().any(unreadable), "{figure}: {line:?}");
    }
    let is_number = |column: usize| lines[1..].iter().any(|line| line[column].parse::<f64>().is_ok());
    for (_, name) in lines[0].iter().enumerate().filter(|(column, _)| is_number(*column)) {
        let counted = ["mode", "measurement"].contains(&name.as_str());
        assert!(name.ends_with(')') || counted, "{figure}: {name:?} has no unit: {csv}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn every_kind_of_figure_is_saved_as_picture_and_table() {
    let Some(_turn) = turn().await else { return };
    let folder = tempfile::tempdir().unwrap();
    let service = both_sizes(folder.path()).await;
    let mut page = Page::open();
    page.look("light", 1280);
    for (view, figures) in VIEWS {
        page.visit(&at(&service, view));
        for figure in figures {
            page.wait_for(&format!("document.querySelectorAll('[data-figure=\"{figure}\"] canvas').length > 0"));
            let (_, csv) = saved(&mut page, figure, "csv");
            assert_is_a_table(&csv, figure);
            let (_, svg) = saved(&mut page, figure, "svg");
            let parsed = format!("new DOMParser().parseFromString({}, 'image/svg+xml')", json!(svg));
            assert_eq!(page.evaluate(&format!("{parsed}.querySelector('parsererror')")), Value::Null, "{figure}");
            assert!(!svg.contains("NaN") && !svg.contains("undefined"), "{figure}: {svg}");
            let (_, png) = saved(&mut page, figure, "png");
            let drawn = "(async (png) => { const image = new Image(); image.src = png; await image.decode();
                const canvas = document.createElement('canvas'); canvas.width = image.width; canvas.height = image.height;
                const pen = canvas.getContext('2d'); pen.drawImage(image, 0, 0);
                return new Set(new Uint32Array(pen.getImageData(0, 0, image.width, image.height).data.buffer)).size; })";
            let colours = page.evaluate(&format!("{drawn}({})", json!(png))).as_u64().unwrap();
            assert!(colours > 10, "{figure}: the picture has {colours} colours");
        }
    }
    assert_eq!(page.complaints(), Vec::<String>::new());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_note_is_listed_after_a_reload_as_well() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    damaged(&service).await;
    let mut page = Page::open();
    page.look("light", 1280);
    page.visit(&at(&service, "#/structures/three-dof"));
    page.wait_for("document.querySelector('#notes')?.textContent.includes('No notes so far')");
    let fields = [("from", "2026-01-05T12:00"), ("text", "scaffold on the east side"), ("author", "Ines Vogel")];
    press_and_fill(&mut page, "notes", "Add a note", &fields);
    let listed = "document.querySelector('#notes li')?.textContent.includes('scaffold on the east side')";
    page.wait_for(listed);
    let stored = service.read("/v1/structures/three-dof/notes").await["items"].clone();
    assert_eq!((&stored[0]["text"], &stored[0]["author"]), (&json!("scaffold on the east side"), &json!("Ines Vogel")));
    page.visit(&at(&service, "#/structures/three-dof"));
    page.wait_for(listed);
    assert_eq!(page.evaluate("document.querySelectorAll('#notes li').length"), json!(1));
    assert!(page.evaluate("document.querySelector('#notes li').textContent").as_str().unwrap().contains("Ines Vogel"));
    assert_eq!(page.complaints(), Vec::<String>::new());
}

#[tokio::test(flavor = "multi_thread")]
async fn parameters_of_two_structures_are_compared_in_one_figure() {
    let Some(_turn) = turn().await else { return };
    let (service, folder) = spawn();
    damaged(&service).await;
    let stored = service.post_text("/v1/structures/rig/batches?split=1d", "text/csv", table(folder.path())).await;
    assert!(stored.status().is_success(), "{}", stored.text().await.unwrap());
    let period = json!({ "from": "2026-01-01T00:00:00Z", "to": "2026-01-12T00:00:00Z" });
    created(service.post("/v1/structures/rig/reference", &period).await).await;
    eventually("all batches of the rig are judged", async || {
        let overview = service.read("/v1/overview").await;
        let items = overview["items"].as_array().unwrap().clone();
        items.into_iter().find(|item| item["id"] == "rig" && item["waiting_batches"] == 0)
    })
    .await;
    let mut page = Page::open();
    page.look("light", 1280);
    page.visit(&at(&service, "#/compare?a=three-dof/k2&b=rig/p12"));
    page.wait_for("document.querySelectorAll('[data-figure=compare] canvas').length === 1");
    let (_, csv) = saved(&mut page, "compare", "csv");
    let last = |name: &str| -> f64 { column(&csv, name).iter().rev().find_map(|cell| cell.parse().ok()).unwrap() };
    // k2 has lost 10 %, p12 30 %; the batches of both have other times.
    let (k2, p12) = (last("change of three-dof k2 (%)"), last("change of rig p12 (%)"));
    assert!((k2 + 10.0).abs() < 3.0 && (p12 + 30.0).abs() < 5.0, "{k2} {p12}: {csv}");
    for chosen in ["a-structure", "b-structure"] {
        let value = page.evaluate(&format!("document.getElementById('compare-{chosen}').value"));
        assert_eq!(value, json!(if chosen.starts_with('a') { "three-dof" } else { "rig" }));
    }
    assert_eq!(page.complaints(), Vec::<String>::new());
}
