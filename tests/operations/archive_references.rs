//! Archives of structures whose undamaged reference was declared more than once, imports that are interrupted, and archives that somebody
//! has changed.

use std::path::Path;
use std::time::Duration;

use serde_json::{json, Value};
use sha2::Digest as _;

use crate::helpers::{created, measurements, spawn, Service};
use crate::operations::archive::{assert_same, OF_THE_INSTALLATION};
use crate::operations::world::{answers, fails, program, run, settled, text, with_past};

const DAY_S: usize = 86_400;

/// A structure that was repaired: a reference, a loss, a second reference after it, a further loss, and a batch that arrived late. Returns
/// the batch that arrived late.
async fn with_two_references(service: &Service) -> Value {
    let day = async |number: usize, k2: f64, count: usize| {
        service.post_batch("three-dof", &measurements([4.0, k2, 6.0], count, DAY_S * number)).await["batch"].clone()
    };
    let first = [day(0, 5.0, 20).await, day(1, 5.0, 20).await];
    created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": first })).await).await;
    for (number, k2) in [(2, 5.0), (3, 5.0), (5, 4.4), (6, 4.4), (7, 4.4), (8, 4.4)] {
        day(number, k2, 10).await;
    }
    settled(service).await;
    let alarms = service.read("/v1/structures/three-dof/alarms").await;
    let alarm = alarms["items"][0]["alarm"].as_i64().unwrap_or_else(|| panic!("no alarm: {alarms}"));
    let comment = json!({ "text": "the bearing is new since day 5", "author": "Ida" });
    created(service.post(&format!("/v1/structures/three-dof/alarms/{alarm}/comments"), &comment).await).await;
    let second = [day(9, 4.4, 20).await, day(10, 4.4, 20).await];
    let declared = json!({ "batches": second, "reason": "new bearing" });
    created(service.post("/v1/structures/three-dof/reference", &declared).await).await;
    for (number, k2) in [(11, 4.4), (12, 4.4), (13, 3.9), (14, 3.9), (15, 3.9), (16, 3.9)] {
        day(number, k2, 10).await;
    }
    let late = day(4, 5.0, 10).await;
    settled(service).await;
    late
}

/// The answers with the alarms of both references.
async fn all_answers(service: &Service) -> std::collections::BTreeMap<String, Value> {
    let mut all = answers(service).await;
    for path in ["/alarms?superseded=true", "/references"] {
        let path = format!("/v1/structures/three-dof{path}");
        let answer = service.read(&path).await;
        all.insert(path, answer);
    }
    all
}

async fn export(service: &Service, folder: &Path) -> std::path::PathBuf {
    let (file, url) = (folder.join("export.ndjson"), format!("http://{}", service.address()));
    let arguments =
        ["export", "--structure", "three-dof", "--data-dir", text(folder), "--url", &url, "--out", text(&file)];
    run(&arguments).await;
    file
}

async fn import(file: &Path, data_dir: &Path) -> Value {
    std::fs::create_dir_all(data_dir).unwrap();
    let done = run(&["import", "--from", text(file), "--data-dir", text(data_dir), "--json"]).await;
    serde_json::from_str(&done).unwrap()
}

/// The versions of the undamaged references that the batches are compared with.
fn versions(answers: &std::collections::BTreeMap<String, Value>) -> Vec<Option<u64>> {
    let batches = answers.iter().filter(|(path, _)| path.contains("/batches/"));
    batches.map(|(_, batch)| batch["assessment"]["undamaged_version"].as_u64()).collect()
}

/// Changes the lines of an archive, and the checksum with them.
fn rewritten(archive: &str, mut change: impl FnMut(&mut Value)) -> String {
    let mut lines: Vec<Value> = archive.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    lines.iter_mut().for_each(&mut change);
    let mut end = lines.pop().unwrap();
    let body: String = lines.iter().map(|line| line.to_string() + "\n").collect();
    end["sha256"] = json!(data_encoding::HEXLOWER.encode(&sha2::Sha256::digest(body.as_bytes())));
    body + &end.to_string() + "\n"
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_batch_is_compared_with_the_reference_that_it_was_compared_with() {
    let (service, folder) = spawn();
    let late = with_two_references(&service).await;
    let expected = all_answers(&service).await;
    let found = versions(&expected);
    for version in [Some(1), Some(2)] {
        assert!(found.contains(&version), "a test of several references needs batches of all of them: {found:?}");
    }
    let late = service.read(&format!("/v1/structures/three-dof/batches/{}", late.as_str().unwrap())).await;
    assert_eq!(late["assessment"]["undamaged_version"], 2, "a late batch is compared with the newest");
    let file = export(&service, folder.path()).await;

    let elsewhere = tempfile::tempdir().unwrap();
    let target = elsewhere.path().join("data");
    let done = import(&file, &target).await;
    assert_eq!((&done["undamaged_states"], &done["warnings"]), (&json!(2), &json!([])), "{done}");
    assert_same(&expected, &all_answers(&Service::start(&target)).await, &OF_THE_INSTALLATION);
    let again = import(&file, &target).await;
    assert_eq!((&again["undamaged_states"], &again["batches_new"]), (&json!(0), &json!(0)), "{again}");
    assert_same(&expected, &all_answers(&Service::start(&target)).await, &OF_THE_INSTALLATION);

    // Archives of the earlier format do not say what was compared: the rule of the service is followed.
    let earlier = rewritten(&std::fs::read_to_string(&file).unwrap(), |line| {
        line.as_object_mut().unwrap().retain(|name, _| name != "compared_with");
        match line["record"].as_str() {
            Some("archive") => line["format"] = json!(2),
            Some("acknowledgement" | "alarm_action") => {
                line.as_object_mut().unwrap().remove("undamaged_version");
            }
            _ => {}
        }
    });
    let file = elsewhere.path().join("earlier.ndjson");
    std::fs::write(&file, earlier).unwrap();
    let target = elsewhere.path().join("of-earlier");
    import(&file, &target).await;
    assert_eq!(versions(&expected), versions(&all_answers(&Service::start(&target)).await));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_import_that_is_killed_has_stored_nothing_or_is_completed_by_the_next_start() {
    let (service, folder) = spawn();
    with_past(&service, 40).await;
    let expected = answers(&service).await;
    let batches = service.read("/v1/structures/three-dof/history?limit=1000").await["items"].as_array().unwrap().len();
    let file = export(&service, folder.path()).await;
    let elsewhere = tempfile::tempdir().unwrap();
    let begun = std::time::Instant::now();
    import(&file, &elsewhere.path().join("whole")).await;
    let whole = begun.elapsed();
    let (mut nothing, mut completed) = (0, 0);
    for kill in 1..=12 {
        let target = elsewhere.path().join(format!("killed-{kill}"));
        std::fs::create_dir(&target).unwrap();
        let mut running = program(&["import", "--from", text(&file), "--data-dir", text(&target), "--json"])
            .stdout(std::process::Stdio::null())
            .stderr(std::process::Stdio::null())
            .spawn()
            .unwrap();
        // From a hundredth of the time to one and a half times as long: another load may have made the whole import slower or faster.
        tokio::time::sleep(whole * (kill * kill) / 96).await;
        running.kill().unwrap();
        running.wait().unwrap();
        let second = Service::start(&target);
        let stored =
            second.read("/v1/structures/three-dof/history?limit=1000").await["items"].as_array().unwrap().len();
        if stored == 0 {
            nothing += 1;
            continue;
        }
        assert_eq!(stored, batches, "a part of the archive was stored");
        completed += 1;
        crate::helpers::within(Duration::from_secs(40), "the end of the import", async || {
            settled(&second).await;
            let alarms = second.read("/v1/structures/three-dof/alarms").await;
            let actions = alarms["items"].as_array().unwrap().iter();
            actions.clone().any(|alarm| !alarm["actions"].as_array().is_none_or(Vec::is_empty)).then_some(())
        })
        .await;
        assert_same(&expected, &answers(&second).await, &OF_THE_INSTALLATION);
    }
    println!("of 12 imports killed over {whole:?}, {nothing} had stored nothing and {completed} were completed by the next start");
    assert!(
        nothing > 0 && completed > 0,
        "{nothing} had stored nothing, {completed} all: the kills do not cover the import"
    );
}

/// Kind of the record that is changed first, the change, and what the refusal says.
type Change<'c> = (&'c str, &'c dyn Fn(&mut Value), &'c str);

/// Each of the changes makes an archive that is refused with a reason and the line, and of which nothing is stored.
async fn are_refused(whole: &str, changes: &[Change<'_>]) {
    for (record, change, expected) in changes {
        let mut changed = 0;
        let archive = rewritten(whole, |line| {
            if line["record"] == *record && changed == 0 {
                change(line);
                changed += 1;
            }
        });
        assert_eq!(changed, 1, "the archive has no {record}");
        let target = tempfile::tempdir().unwrap();
        let file = target.path().join("changed.ndjson");
        std::fs::write(&file, archive).unwrap();
        let data_dir = target.path().join("data");
        std::fs::create_dir(&data_dir).unwrap();
        let said = fails(&["import", "--from", text(&file), "--data-dir", text(&data_dir)]).await;
        assert!(
            said.contains(expected) && said.contains("line "),
            "{record}, {expected}: {}",
            &said[..said.len().min(500)]
        );
        let second = Service::start(&data_dir);
        let structures = second.read("/v1/structures").await;
        let stored = structures["items"].as_array().unwrap().iter().find(|item| item["id"] == "three-dof").unwrap();
        assert_eq!(stored["batches"], 0, "{record}, {expected}: something was stored");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_archive_that_contradicts_what_is_stored_or_cannot_be_true_stores_nothing() {
    let (service, folder) = spawn();
    with_past(&service, 4).await;
    let file = export(&service, folder.path()).await;
    let whole = std::fs::read_to_string(&file).unwrap();

    // This installation has another reference under the same number.
    let (mut other, there) = spawn();
    let first = other.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 30, 400 * DAY_S / 10)).await;
    let declared = json!({ "batches": [first["batch"]] });
    created(other.post("/v1/structures/three-dof/reference", &declared).await).await;
    settled(&other).await;
    let before = answers(&other).await;
    other.stop("TERM");
    let said = fails(&["import", "--from", text(&file), "--data-dir", text(there.path())]).await;
    assert!(said.contains("already has a different undamaged reference 1"), "{said}");
    assert_same(&before, &answers(&Service::start(there.path())).await, &[]);

    let long = "x".repeat(1 << 20);
    let late = json!("9999-01-01T00:00:00Z");
    let changes: [Change<'_>; 6] = [
        ("batch", &|line: &mut Value| line["idempotency_key"] = json!(long), "128 visible ASCII characters"),
        ("batch", &|line: &mut Value| line["source"] = json!("a b"), "/source"),
        ("batch", &|line: &mut Value| line["received_at"] = late.clone(), "in the future"),
        ("batch", &|line: &mut Value| line["compared_with"] = json!([7]), "undamaged reference 7"),
        ("note", &|line: &mut Value| line["created_at"] = late.clone(), "in the future"),
        ("maintenance", &|line: &mut Value| line["to"] = line["from"].clone(), "not after its beginning"),
    ];
    are_refused(&whole, &changes).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_archive_with_a_reference_that_nothing_can_be_compared_with_stores_nothing() {
    let (service, folder) = spawn();
    with_past(&service, 4).await;
    let file = export(&service, folder.path()).await;
    let whole = std::fs::read_to_string(&file).unwrap();
    let long = "x".repeat(1 << 20);
    let late = json!("9999-01-01T00:00:00Z");
    let base64 = |values: &[f64]| {
        let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        json!(data_encoding::BASE64.encode(&bytes))
    };
    let draws = |line: &mut Value, mean: &[f64], std: &[f64]| {
        let quantity = &mut line["quantities"][0];
        (quantity["mean_draws"], quantity["std_draws"]) = (base64(mean), base64(std));
    };
    // Texts with JSON in them.
    let within = |line: &mut Value, pointer: &str, change: &dyn Fn(&mut Value)| {
        let text = line.pointer_mut(pointer).unwrap();
        let mut inner: Value = serde_json::from_str(text.as_str().unwrap_or("{}")).unwrap();
        change(&mut inner);
        *text = json!(inner.to_string());
    };
    let reference = "undamaged_reference";
    let detail = "/quantities/0/detail";
    let changes: [Change<'_>; 16] = [
        (reference, &|line: &mut Value| line["created_at"] = late.clone(), "in the future"),
        (reference, &|line: &mut Value| line["threshold_probability"] = json!(-0.1), "threshold probability"),
        (reference, &|line: &mut Value| line["quantities"][0]["std"] = json!(-1.0), "is negative"),
        (reference, &|line: &mut Value| draws(line, &[f64::NAN], &[1.0]), "not finite"),
        (reference, &|line: &mut Value| draws(line, &[1.0], &[-1.0]), "is negative"),
        (reference, &|line: &mut Value| draws(line, &[], &[]), "no draws"),
        (reference, &|line: &mut Value| draws(line, &[1.0], &[]), "different numbers"),
        (reference, &|line: &mut Value| line["quantities"] = json!([]), "no quantities"),
        (
            reference,
            &|line: &mut Value| within(line, detail, &|detail| detail["reference"]["std"] = json!(-1.0)),
            "of its chart is negative",
        ),
        (
            reference,
            &|line: &mut Value| {
                within(line, detail, &|detail| detail["reference"]["between_batches_std"] = json!(-1.0));
            },
            "of its chart is negative",
        ),
        (
            reference,
            &|line: &mut Value| within(line, "/joint", &|joint| joint["probability"] = json!(-0.5)),
            "joint probability",
        ),
        (
            reference,
            &|line: &mut Value| {
                line["quantities"][0]["quantity"] = json!(long);
                within(line, detail, &|detail| detail["name"] = json!(long));
            },
            "more than 10000 characters",
        ),
        (reference, &|line: &mut Value| line["model_digest"] = json!(long), "more than 10000 characters"),
        (reference, &|line: &mut Value| line["without_process"] = json!(long), "more than 10000 characters"),
        (
            reference,
            &|line: &mut Value| line["doubts"] = json!(json!([long]).to_string()),
            "more than 10000 characters",
        ),
        (
            reference,
            &|line: &mut Value| {
                line["origin"] = json!(json!({ "extends": null, "first": null, "reason": long }).to_string());
            },
            "more than 10000 characters",
        ),
    ];
    are_refused(&whole, &changes).await;
}
