//! The undamaged reference: declared by batches or by period, with doubtful batches named all at once or left out.

use serde_json::{json, Value};

use crate::helpers::{created, eventually, measurements, problem, spawn, time, Service, PATIENCE};

const REFERENCE: &str = "/v1/structures/three-dof/reference";
const UNDAMAGED: [f64; 3] = [4.0, 5.0, 6.0];
const DAY_S: usize = 86_400;

/// A batch of twelve measurements of a day, changed by `change`.
async fn day(service: &Service, day: usize, change: impl Fn(usize, &mut Value)) -> String {
    let mut rows = measurements(UNDAMAGED, 12, day * DAY_S);
    for (index, row) in rows.iter_mut().enumerate() {
        // No measurement repeats one of an earlier day to the last digit.
        for f in row["frequencies_hz"].as_array_mut().unwrap() {
            *f = json!(f.as_f64().unwrap() * (1.0 + 1e-6 * day as f64));
        }
        change(index, row);
    }
    service.post_batch("three-dof", &rows).await["batch"].as_str().unwrap().to_owned()
}

fn swap_modes(_: usize, row: &mut Value) {
    row["frequencies_hz"].as_array_mut().unwrap().swap(0, 1);
}

/// One peak was taken for two modes in the measurements below `count`.
fn coincide(count: usize) -> impl Fn(usize, &mut Value) {
    move |index, row| {
        if index < count {
            row["frequencies_hz"][1] = row["frequencies_hz"][0].clone();
        }
    }
}

fn untouched(_: usize, _: &mut Value) {}

#[tokio::test]
async fn doubtful_batches_are_all_named_at_once_and_can_be_left_out() {
    let (service, _folder) = spawn();
    let mut ids = Vec::new();
    for number in 0..3 {
        ids.push(day(&service, number, untouched).await);
    }
    ids.push(day(&service, 3, swap_modes).await);
    // Half of the measurements say nothing; the others are as good as ever.
    ids.push(day(&service, 4, coincide(6)).await);
    ids.push(day(&service, 5, coincide(7)).await);

    let some = service.read(&format!("/v1/structures/three-dof/batches/{}", ids[4])).await;
    let findings = some["assessment"]["findings"].as_array().unwrap();
    let finding = findings.iter().find(|f| f["code"] == "modes_coincide").unwrap_or_else(|| panic!("{some}"));
    assert_eq!((&finding["effect"], finding["measurements"].as_array().unwrap().len()), (&json!("note"), 6), "{some}");
    assert_eq!(some["assessment"]["trust"], "accepted");
    assert_eq!(some["assessment"]["measurements_used"], 6);
    let most = service.read(&format!("/v1/structures/three-dof/batches/{}", ids[5])).await;
    assert_eq!(most["assessment"]["trust"], "rejected", "{most}");

    let refused = problem(service.post(REFERENCE, &json!({ "batches": ids })).await, 422, "unusable_baseline").await;
    let errors = refused["errors"].as_array().unwrap();
    let pointers: Vec<&str> = errors.iter().map(|e| e["pointer"].as_str().unwrap()).collect();
    assert_eq!(pointers, ["/batches/3", "/batches/5"], "{refused}");
    let message = |index: usize| errors[index]["message"].as_str().unwrap();
    assert!(message(0).contains(&ids[3]) && message(0).contains("out of order"), "{refused}");
    assert!(message(1).contains(&ids[5]) && message(1).contains("same frequency"), "{refused}");
    let detail = refused["detail"].as_str().unwrap();
    assert!(detail.starts_with("2 of 6 batches") && detail.contains("leave_out_doubtful"), "{refused}");

    let body = json!({ "batches": ids, "leave_out_doubtful": true });
    let declared = created(service.post(REFERENCE, &body).await).await;
    assert_eq!(declared["batches"].as_array().unwrap().len(), 4, "{declared}");
    let left_out: Vec<&Value> = declared["left_out"].as_array().unwrap().iter().map(|l| &l["batch"]).collect();
    assert_eq!(left_out, [&json!(ids[3]), &json!(ids[5])], "{declared}");
    // Three batches of twelve, and one of which six are used.
    assert_eq!(declared["measurement_count"], 42);

    // Without a usable batch the reasons are given too.
    let body = json!({ "batches": [ids[3]], "leave_out_doubtful": true });
    let refused = problem(service.post(REFERENCE, &body).await, 422, "unusable_baseline").await;
    assert!(refused["detail"].as_str().unwrap().contains("at least 10"), "{refused}");
    assert_eq!(refused["errors"][0]["pointer"], "/batches/0", "{refused}");
}

#[tokio::test]
async fn a_period_is_declared_and_what_is_doubtful_in_it_is_listed() {
    let (service, _folder) = spawn();
    let maintenance = json!({ "from": time(4 * DAY_S), "to": time(5 * DAY_S), "reason": "new bearings" });
    created(service.post("/v1/structures/three-dof/maintenance", &maintenance).await).await;
    let mut ids = Vec::new();
    for number in 0..8 {
        ids.push(match number {
            2 => day(&service, number, swap_modes).await,
            // More noise than any model was trained for.
            5 => day(&service, number, |_, row| row["std_hz"] = json!([0.2, 0.2, 0.2])).await,
            _ => day(&service, number, untouched).await,
        });
    }
    // From the second batch to the middle of the seventh.
    let (from, to) = (time(DAY_S), time(6 * DAY_S + 1800));
    let declared = created(service.post(REFERENCE, &json!({ "from": from, "to": to })).await).await;
    let batches: Vec<&str> = declared["batches"].as_array().unwrap().iter().map(|b| b.as_str().unwrap()).collect();
    assert_eq!(batches, [&ids[1], &ids[3]], "{declared}");
    assert_eq!(declared["measurement_count"], 24);
    let left_out = declared["left_out"].as_array().unwrap();
    let reason = |number: usize| {
        let of = left_out.iter().find(|l| l["batch"] == ids[number]).unwrap_or_else(|| panic!("{number}: {declared}"));
        of["reason"].as_str().unwrap()
    };
    assert_eq!(left_out.len(), 4, "{declared}");
    assert!(reason(2).contains("out of order"), "{declared}");
    assert!(reason(4).contains("new bearings"), "{declared}");
    assert!(reason(5).contains("assessment failed"), "{declared}");
    assert!(reason(6).contains("only in part in the period"), "{declared}");
    // The structure shows the reference, and the batches outside it are compared with it.
    let structure = service.read("/v1/structures/three-dof").await;
    assert_eq!(structure["undamaged"]["batches"], declared["batches"]);

    // The same period, if nothing may be left out.
    let strict = json!({ "from": from, "to": to, "leave_out_doubtful": false });
    let refused = problem(service.post(REFERENCE, &strict).await, 422, "unusable_baseline").await;
    assert_eq!(refused["errors"].as_array().unwrap().len(), 4, "{refused}");
    assert!(refused["detail"].as_str().unwrap().starts_with("4 of 6 batches"), "{refused}");

    let put = service.request(reqwest::Method::PUT, REFERENCE).json(&json!({ "from": from, "to": to }));
    assert_eq!(created(put.send().await.unwrap()).await["version"], 2);
}

#[tokio::test]
async fn a_period_that_makes_no_sense_is_refused_with_the_field() {
    let (service, _folder) = spawn();
    let id = day(&service, 0, untouched).await;
    let (early, late) = (time(0), time(DAY_S));
    for (body, pointer, words) in [
        (json!({}), "/batches", "or the period"),
        (json!({ "batches": [] }), "/batches", "at least one batch"),
        (json!({ "from": early }), "/to", "is missing"),
        (json!({ "to": late }), "/from", "is missing"),
        (json!({ "from": late, "to": early }), "/to", "must be after"),
        (json!({ "from": early, "to": early }), "/to", "must be after"),
        (json!({ "from": "yesterday", "to": late }), "/from", "RFC 3339"),
        (json!({ "from": early, "to": "2026-01-05" }), "/to", "RFC 3339"),
        (json!({ "batches": [id], "from": early, "to": late }), "/batches", "not both"),
    ] {
        let refused = problem(service.post(REFERENCE, &body).await, 422, "invalid").await;
        assert_eq!(refused["errors"][0]["pointer"], pointer, "{refused}");
        assert!(refused["detail"].as_str().unwrap().contains(words), "{refused}");
    }
    let empty = json!({ "from": time(50 * DAY_S), "to": time(60 * DAY_S) });
    let refused = problem(service.post(REFERENCE, &empty).await, 422, "unusable_baseline").await;
    assert!(refused["detail"].as_str().unwrap().contains("no batch was measured from 2026-02-20"), "{refused}");
}

/// Each declaration lets the batches be assessed again, while those of the declaration before are still being assessed.
#[tokio::test]
async fn references_declared_in_quick_succession_do_not_block_the_service() {
    let (service, _folder) = spawn();
    let mut ids = Vec::new();
    for number in 0..24 {
        ids.push(day(&service, number, untouched).await);
    }
    for _ in 0..8 {
        created(service.post(REFERENCE, &json!({ "batches": ids[..2] })).await).await;
    }
    let posted = tokio::time::timeout(PATIENCE, day(&service, 24, untouched));
    posted.await.expect("a batch is assessed while others are assessed again");
    eventually("all batches are compared with the last reference", async || {
        let history = service.read("/v1/structures/three-dof/history?limit=100").await;
        let items = history["items"].as_array().unwrap();
        items[2..].iter().all(|item| item["state"] == "assessed").then_some(())
    })
    .await;
}
