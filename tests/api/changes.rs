//! A change that is too small for an alarm is shown, and an alarm names what coincides with its onset.

use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use serde_json::{json, Value};

use crate::helpers::{created, eventually, spawn, three_dof_hz, time, Service};

const HEALTHY: [f64; 3] = [4.0, 5.0, 6.0];
const DAY_S: usize = 86_400;

/// Batches of the reference, one a day.
const REFERENCE: usize = 24;

/// Ten measurements of a day, with a scatter of 0.3 % of each stiffness and noise of 0.02 % of each frequency.
fn rows(k: [f64; 3], day: usize) -> Vec<Value> {
    let mut stream = ChaCha8Rng::seed_from_u64(4_800 + day as u64);
    let mut normal = || stream.sample::<f64, _>(StandardNormal);
    let one = |i: usize| {
        let stiffness = k.map(|k| k * (1.0 + 0.003 * normal()));
        let frequencies = three_dof_hz(stiffness).map(|f| f * (1.0 + 0.0002 * normal()));
        json!({ "measured_at": time(day * DAY_S + 600 * i), "frequencies_hz": frequencies })
    };
    (0..10).map(one).collect()
}

async fn post(service: &Service, rows: &[Value], source: &str) -> Value {
    let body = json!({ "source": source, "measurements": rows });
    created(service.post("/v1/structures/three-dof/batches", &body).await).await
}

async fn watched() -> (Service, tempfile::TempDir) {
    let (service, folder) = spawn();
    let mut ids = Vec::new();
    for day in 0..REFERENCE {
        ids.push(post(&service, &rows(HEALTHY, day), "logger-a").await["batch"].clone());
    }
    let made = created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": ids })).await).await;
    assert!(!made["doubts"].to_string().contains("a change lies"), "{made}");
    // Ten years of one batch a day.
    assert_eq!(made["process"]["mean_run_batches"], 3_652.5, "{made}");
    for day in REFERENCE..REFERENCE + 3 {
        post(&service, &rows(HEALTHY, day), "logger-a").await;
    }
    (service, folder)
}

async fn item(service: &Service) -> Value {
    let all = service.read("/v1/overview").await;
    all["items"].as_array().unwrap().iter().find(|item| item["id"] == "three-dof").unwrap().clone()
}

#[tokio::test]
async fn a_change_that_is_too_small_for_an_alarm_is_shown_and_becomes_one_when_it_grows() {
    let (service, _folder) = watched().await;
    for day in 27..35 {
        post(&service, &rows([4.0, 4.95, 6.0], day), "logger-a").await;
    }
    let small = item(&service).await;
    assert_eq!((&small["state"], &small["open_alarms"]), (&json!("normal"), &json!(0)), "{small}");
    let said = small["verdict"].as_str().unwrap();
    assert!(said.starts_with("No alarm. What has changed is too small for one: k2 −1.0 %"), "{said}");
    assert_eq!(small["change"]["changes"][0]["name"], "k2", "{small}");
    let alarms = service.read("/v1/structures/three-dof/alarms").await;
    assert_eq!(alarms["items"], json!([]), "{alarms}");

    for day in 35..40 {
        post(&service, &rows([4.0, 4.75, 6.0], day), "logger-a").await;
    }
    let alarm = eventually("the larger loss is alarmed", async || {
        let alarms = service.read("/v1/structures/three-dof/alarms?state=open").await;
        alarms["items"].get(0).cloned()
    });
    let alarm = alarm.await;
    assert_eq!(alarm["parameter"], "k2", "{alarm}");
    assert_eq!(item(&service).await["state"], "alarming");
}

#[tokio::test]
async fn a_loss_inside_a_reference_is_said_as_what_it_is() {
    let (service, _folder) = spawn();
    let mut ids = Vec::new();
    for day in 0..REFERENCE {
        let k2 = if day < 14 { 5.0 } else { 4.5 };
        ids.push(post(&service, &rows([4.0, k2, 6.0], day), "logger-a").await["batch"].clone());
    }
    let made = created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": ids })).await).await;
    let doubts = made["doubts"].to_string();
    assert!(doubts.contains("a change lies in its batches: k2 has fallen by 10."), "{doubts}");
    assert!(
        doubts.contains("since 2026-01-15") && !doubts.contains("k1 has") && !doubts.contains("k3 has"),
        "{doubts}"
    );
    assert!(doubts.contains("declare the part before it"), "{doubts}");
}

#[tokio::test]
async fn an_alarm_names_what_coincides_with_its_onset() {
    let (service, _folder) = watched().await;
    let note = json!({ "at": time(27 * DAY_S + 3_600), "text": "new logger", "author": "A. Engineer" });
    created(service.post("/v1/structures/three-dof/notes", &note).await).await;
    let maintenance = json!({ "from": time(27 * DAY_S), "to": time(28 * DAY_S), "reason": "joint greased" });
    created(service.post("/v1/structures/three-dof/maintenance", &maintenance).await).await;
    // Nothing for a week, then another source, which does not identify mode 3.
    for day in 34..38 {
        let mut rows = rows([4.0, 4.5, 6.0], day);
        for row in &mut rows {
            row["frequencies_hz"][2] = Value::Null;
        }
        post(&service, &rows, "logger-b").await;
    }
    let alarms = service.read("/v1/structures/three-dof/alarms?state=open").await;
    let alarm = &alarms["items"][0];
    let said = alarm["sentence"].as_str().unwrap_or_else(|| panic!("{alarms}"));
    let coinciding: Vec<&str> =
        alarm["change"]["coinciding"].as_array().unwrap().iter().filter_map(Value::as_str).collect();
    for words in [
        "the batches come from the source \"logger-b\" instead of \"logger-a\"",
        "no batch was measured from 2026-01-27T01:30:00Z to 2026-02-04T00:00:00Z",
        "modes are missing from then on: mode 3",
        "maintenance from 2026-01-28T00:00:00Z to 2026-01-29T00:00:00Z (joint greased)",
        "the note of 28 January 2026 \"new logger\"",
    ] {
        assert!(coinciding.contains(&words), "{words}: {coinciding:?}");
        assert!(said.contains(words), "{said}");
    }
    assert_eq!(coinciding.len(), 5, "{coinciding:?}");

    // A loss beside which nothing happens coincides with nothing.
    let (service, _folder) = watched().await;
    for day in 27..30 {
        post(&service, &rows([4.0, 4.5, 6.0], day), "logger-a").await;
    }
    let alarms = service.read("/v1/structures/three-dof/alarms?state=open").await;
    assert_eq!(alarms["items"][0]["change"]["coinciding"], json!([]), "{alarms}");
    assert!(!alarms["items"][0]["sentence"].as_str().unwrap().contains("coincide"), "{alarms}");
}
