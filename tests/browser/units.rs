//! Numbers, units and ticks that can be read, for a stiffness of 10⁷ N/m as for one of 1.5·10⁻³ N/m: on the axes, in the files, in the report.

use std::path::Path;

use serde_json::{json, Value};

use crate::chromium::Page;
use crate::dashboard::{at, turn};
use crate::figures::{column, saved, WARM};
use crate::helpers::{command, created, repository, time, train_model, Service};

/// The stiffness and the mass of the lower spring and storey; the upper ones are 1.4 and 0.8 of them.
struct Size {
    id: &'static str,
    n_per_m: f64,
    kg: f64,
    unit: &'static str,
}

const SIZES: [Size; 2] = [
    Size { id: "warm", n_per_m: 1e7, kg: 1e3, unit: "MN/m" },
    Size { id: "micro", n_per_m: 1.5e-3, kg: 1e-7, unit: "mN/m" },
];

impl Size {
    /// The structure of [`WARM`] in this size.
    fn definition(&self) -> String {
        let (k, m) = (self.n_per_m, self.kg);
        [
            ("\"warm\"", format!("{:?}", self.id)),
            ("kg = 1000.0", format!("kg = {m:e}")),
            ("kg = 800.0", format!("kg = {:e}", 0.8 * m)),
            ("1.0e7", format!("{k:e}")),
            ("1.4e7", format!("{:e}", 1.4 * k)),
            ("5.0e6", format!("{:e}", 0.5 * k)),
            ("1.5e7", format!("{:e}", 1.5 * k)),
        ]
        .iter()
        .fold(WARM.to_owned(), |text, (from, to)| text.replacen(from, to, 1))
    }

    fn train(&self, models: &Path) {
        train_model(&models.join(self.id), &self.definition(), "0.5,2", 10_000, 20);
    }

    /// Frequencies with a remaining part of the lower stiffness: 0.8 m² λ² − (k₂ + 0.8(k₁ + k₂)) m λ + k₁k₂ = 0.
    fn frequencies_hz(&self, left: f64) -> [f64; 2] {
        let (k1, k2) = (left, 1.4);
        let b = k2 + 0.8 * (k1 + k2);
        let root = (b * b - 3.2 * k1 * k2).sqrt();
        let omega = (self.n_per_m / self.kg).sqrt();
        [(b - root) / 1.6, (b + root) / 1.6].map(|lambda: f64| lambda.sqrt() * omega / std::f64::consts::TAU)
    }

    /// Six healthy days, of which four are the reference, and two with a loss of 10 %.
    async fn measure(&self, service: &Service) {
        let mut ids = Vec::new();
        for day in 0..8 {
            let left = if day < 6 { 1.0 } else { 0.9 };
            let one = |i: usize| {
                let wave = 1.0 + 0.01 * (3.9 * (i as f64 + 10.0 * f64::from(day))).sin();
                let covariates = json!({ "temperature_c": 5.0 + (i as f64 + 3.0 * f64::from(day)).cos() });
                let at = time(86_400 * day as usize + 600 * i);
                json!({ "measured_at": at, "frequencies_hz": self.frequencies_hz(left * wave), "covariates": covariates })
            };
            let measurements: Vec<Value> = (0..10).map(one).collect();
            ids.push(service.post_batch(self.id, &measurements).await["batch"].clone());
            if day == 3 {
                let path = format!("/v1/structures/{}/reference", self.id);
                created(service.post(&path, &json!({ "batches": ids })).await).await;
            }
        }
    }
}

/// Structures of both sizes with a trained model and batches.
pub async fn both_sizes(folder: &Path) -> Service {
    let models = folder.join("models");
    for size in &SIZES {
        size.train(&models);
    }
    let service = Service::spawn(command(&folder.join("data")).arg("--models").arg(&models));
    for size in &SIZES {
        size.measure(&service).await;
    }
    service
}

/// The texts of an SVG.
fn texts(page: &mut Page, svg: &str) -> Vec<String> {
    let script =
        "[...new DOMParser().parseFromString(SVG, 'image/svg+xml').querySelectorAll('text')].map((t) => t.textContent)";
    let found = page.evaluate(&script.replace("SVG", &json!(svg).to_string()));
    found.as_array().unwrap().iter().map(|text| text.as_str().unwrap().to_owned()).collect()
}

/// A number as axes and tables write it.
fn read(text: &str) -> Option<f64> {
    text.trim().replace('−', "-").parse().ok()
}

#[tokio::test(flavor = "multi_thread")]
async fn axes_files_and_report_have_units_with_prefixes_for_large_and_small_structures() {
    let Some(_turn) = turn().await else { return };
    let folder = tempfile::tempdir().unwrap();
    let service = both_sizes(folder.path()).await;
    let mut page = Page::open();
    page.look("light", 1280);
    for Size { id, unit, .. } in &SIZES {
        page.visit(&at(&service, &format!("#/structures/{id}")));
        page.wait_for("document.querySelectorAll('[data-figure=\"parameter-k1\"] canvas').length === 2");
        let (_, csv) = saved(&mut page, "parameter-k1", "csv");
        let mean: Vec<f64> =
            column(&csv, &format!("mean of k1 ({unit})")).iter().filter_map(|cell| read(cell)).collect();
        // 10 MN/m or 1.5 mN/m, and a tenth less at the end.
        let first = if *unit == "MN/m" { 10.0 } else { 1.5 };
        assert_eq!(mean.len(), 8, "{csv}");
        assert!((mean[0] / first - 1.0).abs() < 0.02 && (mean[7] / first - 0.9).abs() < 0.02, "{csv}");
        for header in ["damage threshold", "lower end of its 90 % interval", "mean of the undamaged reference"] {
            assert!(column(&csv, &format!("{header} ({unit})")).iter().all(|cell| !cell.is_empty()), "{header}: {csv}");
        }

        let (_, svg) = saved(&mut page, "parameter-k1", "svg");
        let texts = texts(&mut page, &svg);
        assert!(texts.iter().any(|text| *text == format!("k1 ({unit})")), "{texts:?}");
        // The second axis: changes in per cent of the undamaged mean.
        let changes: Vec<f64> = texts.iter().filter_map(|text| read(text.strip_suffix(" %")?)).collect();
        assert!(changes.len() >= 3 && changes.contains(&0.0), "{texts:?}");
        assert!(changes.iter().any(|change| (-15.0..=-5.0).contains(change)), "{texts:?}");
        // A time axis may have the year.
        let ticks = texts.iter().filter(|text| *text != "2026").filter_map(|text| read(text));
        let too_long: Vec<f64> = ticks.filter(|tick| tick.abs() > 1000.0).collect();
        assert_eq!(too_long, Vec::<f64>::new(), "{texts:?}");
        assert!(
            !texts.iter().any(|text| text.contains("·10") || text.contains("e-") || text.contains("e+")),
            "{texts:?}"
        );

        let report = service.get(&format!("/v1/structures/{id}/report")).send().await.unwrap().text().await.unwrap();
        let table = report.split("Damage threshold δ").nth(1).unwrap_or_else(|| panic!("{report}"));
        let table = table.split("</table>").next().unwrap();
        assert!(table.contains(unit), "{table}");
        let words = table.split(|c: char| c.is_whitespace() || "<>()".contains(c));
        let numbers: Vec<f64> = words.filter_map(read).collect();
        assert!(numbers.len() >= 4 && numbers.iter().all(|number| number.abs() <= 1000.0), "{table}");
        assert!(numbers.iter().any(|number| (number / first - 0.9).abs() < 0.02), "{table}");
    }
    assert_eq!(page.complaints(), Vec::<String>::new());
}

#[tokio::test(flavor = "multi_thread")]
async fn the_page_gives_numbers_the_prefixes_that_the_report_gives_them() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = crate::helpers::spawn();
    let table = std::fs::read_to_string(repository("tests/units.json")).unwrap();
    let mut page = Page::open();
    page.visit(&at(&service, ""));
    let script = "import(new URL('assets/format.js', location.href)).then(({ scale }) => TABLE.map(([unit, size]) => {
        const found = scale(unit, size); return [unit, size, found.unit, found.factor]; }))";
    let found = page.evaluate(&script.replace("TABLE", &table));
    let expected: Vec<(String, f64, String, f64)> = serde_json::from_str(&table).unwrap();
    let found: Vec<(String, f64, String, f64)> = serde_json::from_value(found).unwrap();
    assert_eq!(found.len(), expected.len());
    for (found, expected) in found.iter().zip(&expected) {
        assert_eq!(found.2, expected.2, "{found:?}");
        assert!((found.3 / expected.3 - 1.0).abs() < 1e-12, "{found:?} and not {expected:?}");
    }
}
