//! Measured and simulated mode shapes on the page, in motion, and the parts of a drawing by keyboard.

use serde_json::{json, Value};

use crate::chromium::Page;
use crate::dashboard::{at, turn};
use crate::figures::{assert_explained, damaged};
use crate::helpers::{command, spawn, time, train_model, Service};

/// Two equal masses on two equal springs, whose shapes are orthogonal: (1, 1.618…) and (1, −0.618…). Trained in a second.
const SHAPES: &str = r#"
id = "shapes"
modes = 2
measurement_noise = { relative = 0.002 }
mode_shapes = { points = ["m1", "m2"], noise = 0.01 }
mass = [{ name = "m1", kg = 2.0 }, { name = "m2", kg = 2.0 }]
spring = [
    { name = "k1", from = "ground", to = "m1", n_per_m = 800.0 },
    { name = "k2", from = "m1", to = "m2", n_per_m = 800.0 },
]
parameter = [{ name = "low", scale = true, prior = { uniform = [0.5, 1.5] }, sets = { spring = "k1" } }]
"#;

/// Places of the points of the simulated shape in the drawing of the batch.
const PLACES: &str = "[...document.querySelectorAll('[data-shapes] .shape circle')].map((c) => [c.getAttribute('cx'), c.getAttribute('cy')].join())";

#[tokio::test(flavor = "multi_thread")]
async fn shapes_move_until_they_are_stopped_and_their_mac_is_a_table() {
    let Some(_turn) = turn().await else { return };
    let folder = tempfile::tempdir().unwrap();
    let model = folder.path().join("models/shapes");
    train_model(&model, SHAPES, "0.5,2", 3_000, 8);
    let models = folder.path().join("models");
    let service = Service::spawn(command(&folder.path().join("data")).arg("--models").arg(&models));
    let nominal = service.read("/v1/structures/shapes").await["nominal_frequencies_hz"].clone();
    let golden = 0.5 * (1.0 + 5.0_f64.sqrt());
    let one = |i: usize| {
        let hz: Vec<f64> = [0, 1].map(|mode| nominal[mode].as_f64().unwrap() * (1.0 + 0.001 * (i as f64).sin())).into();
        json!({ "measured_at": time(600 * i), "frequencies_hz": hz, "mode_shapes": [[1.0, golden], [1.0, 1.0 - golden]] })
    };
    let measurements: Vec<Value> = (0..10).map(one).collect();
    let batch = service.post_batch("shapes", &measurements).await;
    assert_eq!(batch["state"], "assessed", "{batch}");

    let mut page = Page::open();
    page.look("light", 1280);
    page.visit(&at(&service, "#/structures/shapes?section=batch"));
    page.wait_for("document.querySelectorAll('[data-shapes] table tbody tr').length === 2");
    // MAC of each measured shape with its own simulated one, and with the other, to which it is orthogonal.
    let mac = page.evaluate(
        "[...document.querySelectorAll('[data-shapes] tbody tr')].map((row) => [...row.querySelectorAll('td')].slice(0, 2).map((cell) => Number(cell.textContent)))",
    );
    for (row, other) in [(0, 1), (1, 0)] {
        let value = |column: usize| mac[row][column].as_f64().unwrap();
        assert!(value(row) > 0.99 && value(other) < 0.01, "{mac}");
    }
    assert_explained(&mut page, "[data-shapes]", "MAC");

    // While the shape moves, its points are at other places than at first, again and again.
    let button = "document.querySelector('[data-shapes] button:not(.help)')";
    page.wait_for(&format!("{button}?.textContent === 'Pause motion'"));
    page.wait_for(&format!("{PLACES}.length > 0"));
    for _ in 0..3 {
        let before = page.evaluate(PLACES);
        page.wait_for(&format!("{PLACES}.join(';') !== {before}.join(';')"));
    }
    page.evaluate(&format!("{button}.click()"));
    assert_eq!(page.evaluate(&format!("{button}.textContent")), json!("Play motion"));
    // A frame that was asked for before the click may still be drawn; after it, none is.
    let frames = "new Promise((done) => { let left = 10; const next = () => (left-- > 0 ? requestAnimationFrame(next) : done(true)); next(); })";
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))");
    let stopped = page.evaluate(PLACES);
    page.evaluate(frames);
    assert_eq!(page.evaluate(PLACES), stopped);
    page.evaluate(&format!("{button}.click()"));
    page.wait_for(&format!("{PLACES}.join(';') !== {stopped}.join(';')"));
    assert_eq!(page.complaints(), Vec::<String>::new());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_part_of_the_drawing_is_reached_by_tab_and_shows_its_chart_by_enter() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    damaged(&service).await;
    let mut page = Page::open();
    page.look("light", 1280);
    page.visit(&at(&service, "#/structures/three-dof"));
    page.wait_for("document.querySelectorAll('[data-figure=control] canvas').length > 0");
    page.wait_for("document.querySelector('[data-drawing] [data-name=k2]') !== null");
    let pressed = "document.querySelector('[data-figure=control] .picker [aria-pressed=true]').dataset.chart";
    for part in ["k1", "k2"] {
        page.evaluate("document.getElementById('drawing-mode').focus()");
        let focused = "document.activeElement.dataset.name ?? null";
        let reached = (0..40).any(|_| {
            page.press("Tab");
            page.evaluate(focused) == part
        });
        assert!(reached, "Tab does not lead to {part}");
        let name = page.evaluate("document.activeElement.textContent.trim()");
        assert!(name.as_str().unwrap().starts_with(&format!("{part} ")), "{name}");
        assert_eq!(page.evaluate("document.activeElement.getAttribute('role')"), json!("button"));
        page.press("Enter");
        page.wait_for(&format!("{pressed} === '{part}'"));
    }
    assert_eq!(page.complaints(), Vec::<String>::new());
}
