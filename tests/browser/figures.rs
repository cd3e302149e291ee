//! What figures give away besides their picture: files of what is plotted, help at terms, a comparison, and frequencies against covariates.

use serde_json::{json, Value};

use crate::chromium::Page;
use crate::dashboard::{at, axe_findings, turn};
use crate::helpers::{created, measurements, spawn, Service};

const DAY_S: usize = 86_400;

/// A reference of four days, and three days with a loss of 10 % in k2.
pub async fn damaged(service: &Service) {
    let mut ids = Vec::new();
    for day in 0..7 {
        let k2 = if day < 4 { 5.0 } else { 4.5 };
        let batch = service.post_batch("three-dof", &measurements([4.0, k2, 6.0], 20, day * DAY_S)).await;
        ids.push(batch["batch"].clone());
        if day == 3 {
            created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": ids })).await).await;
        }
    }
}

/// Saves a figure by its menu; returns the name of the file and its content as text, that of a PNG as a data URL.
pub fn saved(page: &mut Page, figure: &str, format: &str) -> (String, String) {
    let script = "(async (figure, format) => {
        const { createObjectURL } = URL;
        const { click } = HTMLAnchorElement.prototype;
        try {
            return await new Promise((resolve, reject) => {
                let content = null;
                URL.createObjectURL = (blob) => ((content = blob), 'blob:kept');
                HTMLAnchorElement.prototype.click = function () {
                    const reader = new FileReader();
                    reader.onload = () => resolve([this.download, reader.result]);
                    if (format === 'png') reader.readAsDataURL(content);
                    else reader.readAsText(content);
                };
                setTimeout(() => reject(new Error('no file')), 20000);
                document.querySelector(`[data-figure='${figure}'] [data-format=${format}]`).click();
            });
        } finally {
            URL.createObjectURL = createObjectURL;
            HTMLAnchorElement.prototype.click = click;
        }
    })";
    let file = page.evaluate(&format!("{script}('{figure}', '{format}')"));
    [0, 1].map(|i| file[i].as_str().unwrap().to_owned()).into()
}

/// The columns of a CSV without quoted cells.
pub fn column<'a>(csv: &'a str, name: &str) -> Vec<&'a str> {
    let mut lines = csv.split_terminator("\r\n").map(|line| line.split(','));
    let index = lines.next().unwrap().position(|cell| cell == name).unwrap_or_else(|| panic!("{name} is not in {csv}"));
    lines.map(|mut cells| cells.nth(index).unwrap()).collect()
}

/// Colour of a curve of the style sheet as an SVG has it.
fn curve_colour(page: &mut Page, name: &str) -> String {
    let script = format!(
        "(() => {{ const e = document.body.appendChild(document.createElement('span')); e.style.color = 'var(--{name})';
            const c = getComputedStyle(e).color; e.remove(); const pen = document.createElement('canvas').getContext('2d');
            pen.fillStyle = c; return pen.fillStyle; }})()"
    );
    page.evaluate(&script).as_str().unwrap().to_owned()
}

#[tokio::test(flavor = "multi_thread")]
async fn the_files_of_a_figure_hold_what_it_shows() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    damaged(&service).await;
    let series = service.read("/v1/structures/three-dof/series?points=1000").await;
    let mut page = Page::open();
    page.look("light", 1280);
    page.visit(&at(&service, "#/structures/three-dof"));
    page.wait_for("document.querySelectorAll('[data-figure=\"parameter-k2\"] canvas').length === 2");

    let (name, csv) = saved(&mut page, "parameter-k2", "csv");
    assert_eq!(name, "three-dof-k2.csv");
    let k2 = series["parameters"].as_array().unwrap().iter().find(|p| p["name"] == "k2").unwrap();
    for (header, key) in [("mean of k2 (N/m)", "mean"), ("probability of damage (1)", "probability_of_damage")] {
        let read: Vec<Option<f64>> = column(&csv, header).iter().map(|cell| cell.parse().ok()).collect();
        let plotted: Vec<Option<f64>> = k2[key].as_array().unwrap().iter().map(Value::as_f64).collect();
        assert_eq!(read, plotted, "{header}");
    }
    assert_eq!(json!(column(&csv, "time")), k2["times"]);

    let curve = curve_colour(&mut page, "curve-1");
    for figure in ["parameter-k2", "control", "heat", "trust"] {
        let (_, svg) = saved(&mut page, figure, "svg");
        let parsed = format!("new DOMParser().parseFromString({}, 'image/svg+xml')", json!(svg));
        assert_eq!(page.evaluate(&format!("{parsed}.querySelector('parsererror')")), Value::Null, "{figure}");
        assert!(!svg.contains("NaN") && !svg.contains("undefined"), "{figure}: {svg}");
        let (_, png) = saved(&mut page, figure, "png");
        let size = "(async (png) => { const image = new Image(); image.src = png; await image.decode();
            const canvas = document.createElement('canvas'); canvas.width = image.width; canvas.height = image.height;
            const pen = canvas.getContext('2d'); pen.drawImage(image, 0, 0);
            const seen = new Set(new Uint32Array(pen.getImageData(0, 0, image.width, image.height).data.buffer));
            return [image.width, image.height, seen.size]; })";
        let size = page.evaluate(&format!("{size}({})", json!(png)));
        let drawn = page.evaluate(&format!("(() => {{ const s = {parsed}.documentElement; return [2 * s.getAttribute('width'), 2 * s.getAttribute('height')]; }})()"));
        assert_eq!(json!([size[0], size[1]]), drawn, "{figure}");
        assert!(size[2].as_u64().unwrap() > 10, "{figure}: the picture is empty: {size}");
        if figure == "parameter-k2" {
            // One point for each batch on the line of the mean; the circles at the points are paths with arcs.
            let line = format!("Math.max(...[...{parsed}.querySelectorAll('path')].filter((p) => p.getAttribute('stroke') === '{curve}' && !p.getAttribute('d').includes('A')).map((p) => p.getAttribute('d').split(/[ML]/).length - 1))");
            assert_eq!(page.evaluate(&line), json!(7), "{svg}");
        }
    }
    assert_eq!(page.complaints(), Vec::<String>::new());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_term_is_explained_in_place_by_keyboard_in_the_words_of_the_glossary() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    damaged(&service).await;
    let mut page = Page::open();
    page.look("light", 390);
    page.visit(&at(&service, "#/structures/three-dof"));
    page.wait_for("document.querySelectorAll('[data-figure=control] canvas').length > 0");
    page.evaluate("document.querySelector('[data-figure=control] button.help').focus()");
    page.press("Enter");
    page.wait_for(
        "document.querySelector('.help-text')?.textContent.includes('has shifted from the undamaged reference')",
    );
    assert_help_is_of_the_glossary(&mut page, "Control chart");
    let outside = page.evaluate("(() => { const { left, right } = document.querySelector('.help-text').getBoundingClientRect(); return left < 0 || right > innerWidth; })()");
    assert_eq!(outside, json!(false));
    if let Some(found) = axe_findings(&mut page) {
        assert_eq!(found, json!([]));
    }
    page.press("Tab");
    assert_eq!(page.evaluate("document.activeElement.getAttribute('href')"), json!("docs/glossary#control-chart"));
    page.press("Escape");
    page.wait_for("document.querySelector('.help-text') === null");
    assert_eq!(page.evaluate("document.activeElement.className"), json!("help"));
    assert_explained(&mut page, "#alarms", "Severity");
    assert_explained(&mut page, "[data-figure=control]", "Moving average");
    assert_eq!(page.complaints(), Vec::<String>::new());
}

/// The help that is open has the first paragraph of an entry of the glossary.
fn assert_help_is_of_the_glossary(page: &mut Page, title: &str) {
    let glossary = std::fs::read_to_string(crate::helpers::repository("docs/glossary.md")).unwrap();
    let entry = glossary.split(&format!("### {title}\n\n")).nth(1).unwrap().split("\n\n").next().unwrap();
    let shown = page.wait_for("(() => { const text = document.querySelector('.help-text > span')?.textContent; return text !== '…' && text; })()");
    let words = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ");
    assert_eq!(words(shown.as_str().unwrap()), words(entry));
}

/// The button “?” inside `place` explains the term of an entry of the glossary.
pub fn assert_explained(page: &mut Page, place: &str, title: &str) {
    let term = if title == "MAC" { title.to_owned() } else { title.to_lowercase() };
    let button = format!("document.querySelector({})", json!(format!("{place} [data-term='{term}'] button.help")));
    page.wait_for(&format!("Boolean({button})"));
    page.evaluate(&format!("{button}.click()"));
    assert_help_is_of_the_glossary(page, title);
    page.evaluate(&format!("{button}.click()"));
    page.wait_for("document.querySelector('.help-text') === null");
}

#[tokio::test(flavor = "multi_thread")]
async fn two_parameters_are_compared_and_the_address_holds_the_choice() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    damaged(&service).await;
    let mut page = Page::open();
    for (theme, width) in [("light", 1280), ("dark", 390)] {
        page.look(theme, width);
        page.visit(&at(&service, "#/compare?a=three-dof/k2&b=three-dof/k3"));
        page.wait_for("document.querySelectorAll('[data-figure=compare] canvas').length === 1");
        let (_, csv) = saved(&mut page, "compare", "csv");
        let last = |name: &str| column(&csv, name).last().unwrap().parse::<f64>().unwrap();
        // k2 has lost 10 %; k3 is as it was.
        let (lost, kept) = (last("change of three-dof k2 (%)"), last("change of three-dof k3 (%)"));
        assert!((lost + 10.0).abs() < 3.0 && kept.abs() < 3.0, "{lost} {kept}");
        if let Some(found) = axe_findings(&mut page) {
            assert_eq!(found, json!([]), "{theme}, {width} px");
        }
        let overflow = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth");
        assert_eq!(overflow, json!(0), "{theme}, {width} px");
    }
    page.evaluate("{ const s = document.getElementById('compare-b-parameter'); s.value = 'k1'; s.dispatchEvent(new Event('change')); }");
    page.wait_for("decodeURIComponent(location.hash).includes('b=three-dof/k1')");
    page.wait_for(
        "document.querySelector('[data-figure=compare] [role=img] ~ p').textContent.includes('three-dof k1')",
    );
    page.visit(&at(&service, "#/structures/three-dof?section=tracks"));
    page.wait_for("document.getElementById('tracks')?.textContent.includes('No covariates recorded')");
    assert_eq!(page.complaints(), Vec::<String>::new());
}

/// Two masses on two springs with a temperature, trained in seconds.
pub const WARM: &str = r#"
id = "warm"
modes = 2
measurement_noise = { relative = 0.002 }
mass = [{ name = "m1", kg = 1000.0 }, { name = "m2", kg = 800.0 }]
spring = [
    { name = "k1", from = "ground", to = "m1", n_per_m = 1.0e7 },
    { name = "k2", from = "m1", to = "m2", n_per_m = 1.4e7 },
]
parameter = [{ name = "k1", prior = { uniform = [5.0e6, 1.5e7] }, sets = { spring = "k1" } }]
covariate = [{ name = "temperature_c" }]
"#;

#[tokio::test(flavor = "multi_thread")]
async fn a_frequency_is_shown_against_the_temperature_and_saved_with_units() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    // Frequencies are shown without a trained model as well.
    let stored = service.request(reqwest::Method::PUT, "/v1/structures/warm");
    let stored = stored.header("content-type", "application/toml").body(WARM).send().await.unwrap();
    assert!(stored.status().is_success(), "{}", stored.text().await.unwrap());
    let one = |i: usize| {
        let temperature_c = 20.0 * (i as f64 * 0.7).sin();
        json!({ "measured_at": crate::helpers::time(3600 * i), "frequencies_hz": [11.0 - 0.005 * temperature_c, 30.5],
                "covariates": { "temperature_c": temperature_c } })
    };
    let sent: Vec<Value> = (0..40).map(one).collect();
    service.post_batch("warm", &sent).await;
    let mut page = Page::open();
    page.look("light", 1280);
    page.visit(&at(&service, "#/structures/warm?section=tracks"));
    page.wait_for("document.querySelectorAll('[data-figure=scatter] canvas').length === 1");
    let (_, csv) = saved(&mut page, "scatter", "csv");
    let [x, y] = ["temperature (°C)", "mode 1 (Hz)"]
        .map(|name| column(&csv, name).iter().map(|v| v.parse::<f64>().unwrap()).collect::<Vec<f64>>());
    assert_eq!(x.len(), 40, "{csv}");
    assert!(x.iter().zip(&y).all(|(x, y)| (y - (11.0 - 0.005 * x)).abs() < 1e-12), "{csv}");
    assert!(x.is_sorted());
    page.evaluate(
        "{ const s = document.getElementById('scatter-mode'); s.value = '1'; s.dispatchEvent(new Event('change')); }",
    );
    page.wait_for("document.querySelector('[data-figure=scatter]').textContent.includes('of mode 2 against')");
    assert_eq!(page.complaints(), Vec::<String>::new());
}
