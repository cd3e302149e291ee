//! Rows that cannot be read: everything else is answered, the answer says what is missing, and the health of the service counts it.

use reqwest::Method;
use serde_json::{json, Value};

use crate::helpers::{created, measurements, problem, spawn, Service};
use crate::operations::stored::{doctor, execute};
use crate::operations::world::with_past;

const STRUCTURE: &str = "/v1/structures/three-dof";

/// A time outside the calendar, in microseconds.
const NO_TIME: &str = "9000000000000000000";

/// The items of an answer.
async fn items(service: &Service, path: &str) -> Vec<Value> {
    service.read(path).await["items"].as_array().unwrap_or_else(|| panic!("{path} has no items")).clone()
}

/// The message of the finding about rows that cannot be read.
async fn finding(service: &Service) -> String {
    let ready = service.read("/readyz").await;
    let found =
        ready["findings"].as_array().unwrap().iter().find(|finding| finding["code"] == "stored_data_unreadable");
    found.unwrap_or_else(|| panic!("no finding: {ready}"))["message"].as_str().unwrap().to_owned()
}

/// All items of a list, read page by page.
async fn paged(service: &Service, path: &str, limit: usize) -> Vec<Value> {
    let mut all = Vec::new();
    let mut next = format!("{path}?limit={limit}");
    loop {
        let page = service.read(&next).await;
        all.extend(page["items"].as_array().unwrap().iter().cloned());
        let Some(cursor) = page["next"].as_str() else { return all };
        next = format!("{path}?limit={limit}&cursor={cursor}");
    }
}

#[tokio::test]
async fn with_damaged_assessments_and_measurements_the_rest_of_a_structure_is_answered() {
    let (mut service, folder) = spawn();
    with_past(&service, 12).await;
    let history = format!("{STRUCTURE}/history");
    let before = items(&service, &format!("{history}?limit=1000")).await;
    let id = |index: usize| before[index]["batch"].as_str().unwrap().to_owned();
    let parameter_points = async |service: &Service| {
        let series = service.read(&format!("{STRUCTURE}/series")).await;
        (series["parameters"][0]["batches"].as_array().unwrap().len(), series)
    };
    let (points, series) = parameter_points(&service).await;
    assert!(series.get("unreadable").is_none(), "{series}");
    let measured = paged(&service, &format!("{STRUCTURE}/measurements"), 7).await.len();
    let exceedances = paged(&service, &format!("{STRUCTURE}/exceedances"), 2).await;
    let condition = async |service: &Service| {
        let all = items(service, "/v1/overview").await;
        let of = all.iter().find(|item| item["id"] == "three-dof").unwrap();
        [&of["state"], &of["alarm_since"], &of["open_alarms"]].map(Clone::clone)
    };
    let before_damage = condition(&service).await;
    service.stop("TERM");

    let last = before.len() - 1;
    for (table, change, row) in [
        ("assessment", "trust = '}{'", id(3)),
        ("assessment", "plotted = zeroblob(16)", id(4)),
        ("assessment", "misfit_percent = zeroblob(7)", id(5)),
        ("assessment", "trust = '}{'", id(last)),
        ("measurement", "covariates = '}{'", id(6)),
        ("measurement", "frequency_hz = zeroblob(23)", id(7)),
        ("process_point", "changes = '}{'", id(8)),
    ] {
        execute(folder.path(), &format!("update {table} set {change} where batch_id = '{row}'")).await;
    }
    // Within the open alarm.
    execute(
        folder.path(),
        "insert into process_point (structure_id, undamaged_version, measured_to_us, batch_id, estimate, held, known, changes)
         select structure_id, undamaged_version, opened_at_us, opened_batch, '{}', 0, zeroblob(0), '}{'
         from alarm_episode where kind = 'damage' and ended_at_us is null and withdrawn = 0
         on conflict (structure_id, undamaged_version, measured_to_us, batch_id) do update set changes = '}{'",
    )
    .await;
    let found = doctor(folder.path());
    for row in [3, 4, 5, 6, 7, last] {
        // A text that is JSON, or a vector of whole numbers, which says something else is found by reading only.
        assert_eq!(found.contains(&id(row)), row != 4, "{row}: {found}");
    }
    let service = Service::start(folder.path());

    // The history has every batch; those that cannot be read are marked.
    for limit in [1000, 3, 1] {
        let after = paged(&service, &history, limit).await;
        assert_eq!(after.len(), before.len());
        for (index, (item, earlier)) in after.iter().zip(&before).enumerate() {
            if [3, 5, last].contains(&index) {
                assert_eq!((&item["state"], &item["assessment"]), (&json!("failed"), &Value::Null), "{item}");
                let failure = item["failure"].as_str().unwrap();
                assert!(failure.contains("cannot be read") && failure.contains("restore a backup"), "{item}");
            } else {
                assert_eq!(item, earlier);
            }
        }
    }
    let csv = service.get(&format!("{history}?format=csv")).send().await.unwrap();
    assert_eq!(csv.status(), 200);
    let csv = csv.text().await.unwrap();
    for index in 0..before.len() {
        let line = csv.lines().find(|line| line.contains(&id(index))).unwrap_or_else(|| panic!("{index}: {csv}"));
        assert_eq!(line.contains(",failed,"), [3, 5, last].contains(&index), "{line}");
    }
    // Series and report lack these batches and say so.
    let (points_after, series) = parameter_points(&service).await;
    assert_eq!(points_after, points - 1, "only the batch whose plotted values are damaged is missing: {series}");
    let sentence = series["unreadable"].as_str().unwrap_or_else(|| panic!("{series}"));
    assert!(sentence.contains("cannot be read") && sentence.contains("left out"), "{sentence}");
    let report = service.get(&format!("{STRUCTURE}/report")).send().await.unwrap();
    assert_eq!(report.status(), 200);
    assert!(report.text().await.unwrap().contains("cannot be read and are left out"));
    // Measurements and exceedances are complete but for what is damaged, also over pages.
    for limit in [1000, 7, 1] {
        let after = paged(&service, &format!("{STRUCTURE}/measurements"), limit).await;
        assert_eq!(after.len(), measured - 20, "two batches of ten");
        assert!(after.iter().all(|item| item["batch"] != id(6) && item["batch"] != id(7)));
    }
    assert_eq!(paged(&service, &format!("{STRUCTURE}/exceedances"), 2).await, exceedances);
    // The verdict, which the charts give, is as before, and so are the alarms.
    assert_eq!(condition(&service).await, before_damage);
    let alarms = items(&service, &format!("{STRUCTURE}/alarms?state=open")).await;
    // People go on working with an alarm that has damaged points, and its messages are made.
    let alarm = format!("{STRUCTURE}/alarms/{}", alarms[0]["alarm"]);
    let closing = json!({ "reason": "other", "text": "test", "author": "Ida" });
    created(service.post(&format!("{alarm}/closing"), &closing).await).await;
    created(service.post(&format!("{alarm}/reopening"), &json!({ "author": "Ida" })).await).await;
    let finding = finding(&service).await;
    assert!(finding.contains("cannot be read") && finding.contains("modalwatch doctor"), "{finding}");
    let metrics = service.get("/metrics").send().await.unwrap();
    assert_eq!(metrics.status(), 200);
    let text = metrics.text().await.unwrap();
    assert!(text.contains("modalwatch_structure_state{structure=\"three-dof\""), "{text}");
    assert!(text.contains("\nmodalwatch_unreadable_rows "), "{text}");
    // Work goes on.
    let next = service.post_batch("three-dof", &measurements([4.0, 4.0, 6.0], 10, 86_400 * 40)).await;
    assert_eq!(next["state"], "assessed", "{next}");
}

#[tokio::test]
async fn with_damaged_rows_of_people_and_of_the_service_every_list_has_the_others() {
    let (mut service, folder) = spawn();
    with_past(&service, 6).await;
    for name in ["first", "second"] {
        let hook = json!({ "url": format!("https://example.com/{name}"), "enabled": false });
        created(service.post("/v1/webhooks", &hook).await).await;
    }
    for day in 1..4 {
        let note = json!({ "at": format!("2026-02-0{day}T00:00:00Z"), "text": "note", "author": "Ida" });
        created(service.post(&format!("{STRUCTURE}/notes"), &note).await).await;
        let window =
            json!({ "from": format!("2027-01-0{day}T00:00:00Z"), "to": "2027-02-01T00:00:00Z", "reason": "works" });
        created(service.post(&format!("{STRUCTURE}/maintenance"), &window).await).await;
    }
    let alarm = items(&service, &format!("{STRUCTURE}/alarms")).await[0]["alarm"].clone();
    service.stop("TERM");
    let job = |id: &str, result: &str| {
        format!(
            "insert into diagnosis (diagnosis_id, structure_id, structure_digest, request, started_by, alarm, state, result, created_at_us)
             values ('{id}', 'three-dof', 'd', '{{}}', 'requested', {alarm}, 'done', '{result}', 1)"
        )
    };
    let quarantined = |topic: &str, at: &str| {
        format!(
            "insert into quarantine (topic, digest, payload, payload_bytes, reason, tries, first_at_us, last_at_us)
             values ('{topic}', '{topic}', zeroblob(3), 3, 'no JSON', 1, {at}, 1)"
        )
    };
    for statement in [
        format!("update note set from_us = {NO_TIME}, to_us = null where note_id = (select max(note_id) from note)"),
        format!("update maintenance_window set to_us = {NO_TIME} where from_us = (select max(from_us) from maintenance_window)"),
        "update webhook set events = '}{' where webhook_id = (select min(webhook_id) from webhook)".to_owned(),
        format!("update alarm_action set at_us = {NO_TIME} where action_id = (select min(action_id) from alarm_action)"),
        format!("update audit_entry set at_us = {NO_TIME} where entry_id in (select entry_id from audit_entry order by 1 limit 2 offset 2)"),
        job("01900000-0000-7000-8000-000000000001", "}{"),
        job("01900000-0000-7000-8000-000000000002", r#"{"verdict": "nothing", "summary": "nothing"}"#),
        "insert into training (training_id, structure_id, structure_digest, request, state, created_at_us)
         values ('01900000-0000-7000-8000-000000000003', 'three-dof', 'd', '}{', 'done', 1)"
            .to_owned(),
        quarantined("first", NO_TIME),
        quarantined("second", "1"),
        quarantined("third", NO_TIME),
    ] {
        execute(folder.path(), &statement).await;
    }
    let found = doctor(folder.path());
    for column in [
        "from_us of note",
        "to_us of maintenance_window",
        "events of webhook",
        "at_us of alarm_action",
        "at_us of audit_entry",
        "result of diagnosis",
        "first_at_us of quarantine",
    ] {
        assert!(found.contains(column), "{column}: {found}");
    }
    let service = Service::start(folder.path());
    assert_eq!(items(&service, &format!("{STRUCTURE}/notes")).await.len(), 3);
    assert_eq!(items(&service, &format!("{STRUCTURE}/maintenance")).await.len(), 3);
    let webhooks = items(&service, "/v1/webhooks").await;
    assert_eq!(webhooks.len(), 1, "{webhooks:?}");
    assert_eq!(webhooks[0]["url"], "https://example.com/second");
    let alarms = items(&service, &format!("{STRUCTURE}/alarms")).await;
    assert!(alarms.iter().any(|item| item["alarm"] == alarm), "{alarms:?}");
    for path in ["/v1/jobs", &format!("{STRUCTURE}/diagnoses"), "/v1/overview", "/v1/structures", STRUCTURE] {
        assert_eq!(service.get(path).send().await.unwrap().status(), 200, "{path}");
    }
    assert_eq!(items(&service, &format!("{STRUCTURE}/trainings")).await, Vec::<Value>::new());
    assert_eq!(items(&service, "/v1/jobs").await.len(), 3, "a job whose result is damaged is still a job");
    // Lists in pages go on behind what is left out.
    let all = paged(&service, "/v1/audit", 1000).await;
    assert!(all.len() > 4);
    assert_eq!(paged(&service, "/v1/audit", 1).await.len(), all.len());
    for limit in [1, 10] {
        let messages = paged(&service, "/v1/quarantine", limit).await;
        assert_eq!(messages.len(), 1, "{messages:?}");
        assert_eq!(messages[0]["topic"], "second");
    }
    for path in ["series", "report", "references", "charts", "trainings", "exceedances", "drawing.svg"] {
        assert_eq!(service.get(&format!("{STRUCTURE}/{path}")).send().await.unwrap().status(), 200, "{path}");
    }
    let finding = finding(&service).await;
    assert!(finding.contains("stored row(s)"), "{finding}");
    // A person can still write and close what the damaged rows are about.
    let closing = json!({ "reason": "other", "text": "test", "author": "Ida" });
    let closed = service.post(&format!("{STRUCTURE}/alarms/{alarm}/closing"), &closing).await;
    assert!(closed.status().is_success(), "{}", closed.text().await.unwrap());
    let damaged =
        service.request(Method::GET, "/v1/diagnoses/01900000-0000-7000-8000-000000000001").send().await.unwrap();
    problem(damaged, 503, "stored_data_unreadable").await;
}

#[tokio::test]
async fn a_webhook_whose_filter_cannot_be_read_does_not_keep_alarms_from_being_stored() {
    let (mut service, folder) = spawn();
    let mut healthy = Vec::new();
    for day in 0..2 {
        let batch = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 20, 86_400 * day)).await;
        healthy.push(batch["batch"].clone());
    }
    created(service.post(&format!("{STRUCTURE}/reference"), &json!({ "batches": healthy })).await).await;
    created(service.post("/v1/webhooks", &json!({ "url": "https://example.com/alarms" })).await).await;
    service.stop("TERM");
    execute(folder.path(), "update webhook set events = '}{'").await;
    let service = Service::start(folder.path());
    for day in 3..9 {
        let batch = service.post_batch("three-dof", &measurements([4.0, 3.5, 6.0], 10, 86_400 * day)).await;
        assert_eq!(batch["state"], "assessed", "{batch}");
    }
    assert!(!items(&service, &format!("{STRUCTURE}/alarms")).await.is_empty());
    assert!(finding(&service).await.contains("webhook"));
}
