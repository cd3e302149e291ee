//! New damage in the measurements that a diagnosis holds out by default, through HTTP: it is named, and nothing calls it healthy.

use std::time::Duration;

use rand::SeedableRng as _;
use serde_json::{json, Value};

use super::tower::{batch, STRUCTURE};
use crate::helpers::{command, created, problem, within, Service};

/// A diagnosis that has ended, with its report.
async fn diagnosed(service: &Service, request: &Value) -> (Value, String) {
    let asked = service.post("/v1/structures/tower/diagnoses", request).await;
    assert_eq!(asked.status(), 202);
    let id = asked.json::<Value>().await.unwrap()["diagnosis"].as_str().unwrap().to_owned();
    let answer = within(Duration::from_mins(5), "the diagnosis", async || {
        Some(service.read(&format!("/v1/diagnoses/{id}")).await).filter(|answer| answer["state"] != "running")
    });
    let answer = answer.await;
    let report = service.get(&format!("/v1/diagnoses/{id}/report")).send().await.unwrap().text().await.unwrap();
    (answer, report)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn damage_in_the_last_quarter_is_named_by_the_default_diagnosis() {
    let folder = tempfile::tempdir().unwrap();
    let models = folder.path().join("models");
    std::fs::create_dir_all(models.join("tower")).unwrap();
    std::fs::write(models.join("tower/structure.toml"), STRUCTURE).unwrap();
    let service = Service::spawn(command(&folder.path().join("data")).arg("--models").arg(&models));
    let mut rng = rand_chacha::ChaCha12Rng::seed_from_u64(2_210);
    for first in (0..360).step_by(10) {
        let measurements = batch(first, &mut rng);
        created(service.post("/v1/structures/tower/batches", &json!({ "measurements": measurements })).await).await;
    }

    let (answer, report) = diagnosed(&service, &json!({})).await;
    let result = &answer["result"];
    let summary = result["summary"].as_str().unwrap_or_else(|| panic!("{answer}"));
    println!("{summary}");
    let change = &result["lasting_change"];
    let since = change["since"].as_str().unwrap();
    assert!(("2024-09-24".."2024-09-30").contains(&since), "{change}");
    assert_eq!(change["stiffness"][0]["name"], "k2", "{change}");
    let cause = &result["causes"][0];
    assert_eq!((&cause["target"]["name"], &cause["covariate"]), (&json!("k1"), &json!("temperature_c")), "{summary}");
    assert!(result["set_aside_rows"].as_u64().unwrap() >= 90, "{result}");
    // Where the damaged rows were the hold-out, no mode was predicted to 1 %.
    let after = result["gain"]["rms_error_percent"]["after"].as_array().unwrap();
    assert!(after.iter().all(|error| error.as_f64().unwrap() < 0.5), "{result}");
    assert_eq!(result["gain"]["undamaged_rows"], 0);
    for text in [summary, &report] {
        assert!(text.contains("may be damage") && text.contains("behave differently from those before"), "{text}");
        assert!(text.contains("September 2024") && text.contains("mode 4 from"), "{text}");
        assert!(!text.to_lowercase().contains("healthy") && !text.contains("1000 undamaged"), "{text}");
    }
    let listed = service.read("/v1/structures/tower/diagnoses").await;
    assert!(listed["items"][0]["summary"].as_str().unwrap().contains("may be damage"), "{listed}");

    // The period and the hold-out are those of the request.
    let request = json!({ "from": "2024-02-01", "to": "2024-09-27", "holdout": "since:2024-08-01" });
    let (answer, _) = diagnosed(&service, &request).await;
    let result = &answer["result"];
    assert_eq!(result["lasting_change"], Value::Null, "{answer}");
    assert_eq!((&result["training_rows"], &result["holdout_rows"]), (&json!(182), &json!(57)), "{result}");
    assert!(
        result["notes"].to_string().contains("from 2024-02-01T00:00:00Z to before 2024-09-27T00:00:00Z"),
        "{result}"
    );
    let (answer, _) = diagnosed(&service, &json!({ "from": "2024-12-20" })).await;
    assert_eq!(answer["state"], "failed");
    assert!(answer["failure"].as_str().unwrap().contains("these are 6 of 360"), "{answer}");

    let path = "/v1/structures/tower/diagnoses";
    for (request, pointer) in [
        (json!({ "from": "1.2.2024" }), "/from"),
        (json!({ "to": "soon" }), "/to"),
        (json!({ "from": "2024-09-27", "to": "2024-02-01" }), "/to"),
        (json!({ "holdout": "since:soon" }), "/holdout"),
    ] {
        let refused = problem(service.post(path, &request).await, 422, "invalid").await;
        assert!(refused.to_string().contains(pointer), "{refused}");
    }
}
