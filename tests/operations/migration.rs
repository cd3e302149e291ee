//! Databases of every earlier schema can be opened, and their content is answered.

use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use modalwatch::measurement::{at_intervals, MeasurementBatch};
use modalwatch::quantity::{StructureId, Timestamp};
use reqwest::Method;
use serde_json::json;
use sqlx::migrate::Migrator;
use sqlx::{Connection as _, Row as _};
use sqlx_sqlite::{SqliteConnectOptions, SqliteConnection};

use crate::helpers::{command, created, measurements, problem, repository, spawn, Service};
use crate::operations::world::{fails, run, text};

const APPLICATION_ID: i64 = 0x6d64_6c77;
const BATCH: &str = "01890000-0000-7000-8000-000000000001";
const UNDAMAGED: &str = "01890000-0000-7000-8000-000000000002";
/// 2026-01-01T00:00:00Z.
const START_US: i64 = 1_767_225_600_000_000;

fn database(folder: &Path) -> SqliteConnectOptions {
    SqliteConnectOptions::new().filename(folder.join("modalwatch.sqlite"))
}

async fn execute(connection: &mut SqliteConnection, statement: String) {
    sqlx::query(sqlx::AssertSqlSafe(statement.clone()))
        .execute(connection)
        .await
        .unwrap_or_else(|e| panic!("{statement}: {e}"));
}

/// Definition and digest of `three-dof`, as a service stores them.
async fn three_dof() -> (String, String) {
    let (mut service, folder) = spawn();
    service.stop("TERM");
    let mut connection = SqliteConnection::connect_with(&database(folder.path())).await.unwrap();
    let row = sqlx::query("select definition, digest from structure where structure_id = 'three-dof'")
        .fetch_one(&mut connection)
        .await
        .unwrap();
    (row.get(0), row.get(1))
}

/// Digest of the batch of one measurement at a time, which is compared with it whenever it is read.
fn content_digest(at_us: i64) -> String {
    let measurements = at_intervals(&[vec![0.7, 0.9, 1.1]], Timestamp::from_micros(at_us).unwrap(), 1, None).unwrap();
    let structure = StructureId::parse("three-dof").unwrap();
    let source = "default".to_owned();
    let batch = MeasurementBatch { structure, source, idempotency_key: None, posted_by: None, measurements };
    batch.content_digest().to_string()
}

/// A database as a program with the first `schema` migrations wrote it: a batch compared with an
/// undamaged reference.
#[expect(clippy::too_many_lines, reason = "one statement after another")]
async fn of_schema(folder: &Path, schema: i64, (definition, digest): &(String, String)) {
    let options = database(folder).create_if_missing(true).foreign_keys(true);
    let mut connection = SqliteConnection::connect_with(&options).await.unwrap();
    let connection = &mut connection;
    execute(connection, format!("pragma application_id = {APPLICATION_ID}")).await;
    let all = Migrator::new(repository("migrations").as_path()).await.unwrap();
    let earlier: Vec<_> = all.iter().filter(|migration| migration.version <= schema).cloned().collect();
    assert_eq!(earlier.len() as i64, schema);
    Migrator::with_migrations(earlier).run(&mut *connection).await.unwrap();

    sqlx::query("insert into structure values ('three-dof', ?, ?, ?, ?)")
        .bind(definition)
        .bind(digest)
        .bind(START_US)
        .bind(START_US)
        .execute(&mut *connection)
        .await
        .unwrap();
    let frequencies: Vec<u8> = [0.7_f64, 0.9, 1.1].into_iter().flat_map(f64::to_le_bytes).collect();
    let misfit: Vec<u8> = [0.1_f64, f64::NAN, 0.3].into_iter().flat_map(f64::to_le_bytes).collect();
    for (batch, hour) in [(UNDAMAGED, 0), (BATCH, 1)] {
        let at = START_US + hour * 3_600_000_000;
        let content = content_digest(at);
        execute(
            connection,
            format!(
                "insert into measurement_batch values ('three-dof', '{batch}', 'default', 'key-{hour}', '{content}', {at}, {at},
                 {at}, 1, 'assessed', null)"
            ),
        )
        .await;
        sqlx::query("insert into measurement values ('three-dof', ?, 0, 'default', ?, ?, null, '{}', '{}')")
            .bind(batch)
            .bind(at)
            .bind(&frequencies)
            .execute(&mut *connection)
            .await
            .unwrap();
    }
    let columns = "(structure_id, version, model_digest, created_at_us, threshold_probability, measurement_count)";
    execute(
        connection,
        format!("insert into undamaged_state {columns} values ('three-dof', 1, 'model-a', {START_US}, 0.05, 12)"),
    )
    .await;
    execute(connection, format!("insert into undamaged_batch values ('three-dof', 1, '{UNDAMAGED}')")).await;
    execute(
        connection,
        "insert into undamaged_quantity (structure_id, version, quantity, position, mean, std, threshold)
         values ('three-dof', 1, 'k2', 0, 5.0, 0.1, 4.8355)"
            .to_owned(),
    )
    .await;
    let columns =
        "(structure_id, batch_id, model_digest, undamaged_version, structure_digest, seed, draws_per_measurement,
                    measurements_used, measurements_left_out, measurements_outside, misfit_percent, assessed_at_us)";
    let insert =
        format!("insert into assessment {columns} values ('three-dof', ?, 'model-a', 1, ?, 77, 10, 1, 0, 0, ?, ?)");
    sqlx::query(sqlx::AssertSqlSafe(insert))
        .bind(BATCH)
        .bind(digest)
        .bind(&misfit)
        .bind(START_US)
        .execute(&mut *connection)
        .await
        .unwrap();
    let columns = "(structure_id, batch_id, model_digest, undamaged_version, quantity, position, unit, kind, mean, std,
                    variance_within, variance_between, edge_mass, threshold, probability_of_damage, exceeds, relative_change)";
    execute(
        connection,
        format!(
            "insert into quantity_assessment {columns} values ('three-dof', '{BATCH}', 'model-a', 1, 'k2', 0, 'N/m', 'parameter',
             4.5, 0.12, 0.01, 0.0044, 0.0, 4.8355, 0.997, 1, -0.1)"
        ),
    )
    .await;
    if schema >= 2 {
        execute(
            connection,
            format!(
                "insert into alarm_episode values ('three-dof', 1, 'damage', 'k2', 1, {START_US}, '{BATCH}', null, 0, 7.5, {START_US},
                 {START_US}, 'Ida', 'seen')"
            ),
        )
        .await;
        execute(
            connection,
            format!("insert into maintenance_window values ('three-dof', 1, 2, 'bearings', {START_US})"),
        )
        .await;
    }
    if schema >= 3 {
        execute(
            connection,
            format!(
                "insert into diagnosis (diagnosis_id, structure_id, structure_digest, request, state, created_at_us, extension_state)
                 values ('01890000-0000-7000-8000-00000000000d', 'three-dof', '{digest}',
                         '{{\"batches\":[],\"holdout\":\"none\",\"seed\":1}}', 'running', {START_US}, null)"
            ),
        )
        .await;
    }
}

#[tokio::test]
async fn every_earlier_schema_opens_and_its_rows_are_answered() {
    let structure = three_dof().await;
    for schema in 1..=3 {
        let folder = tempfile::tempdir().unwrap();
        of_schema(folder.path(), schema, &structure).await;
        let service = Service::start(folder.path());
        let batch = service.read(&format!("/v1/structures/three-dof/batches/{BATCH}")).await;
        let k2 = &batch["assessment"]["parameters"][0];
        assert_eq!(
            (&batch["state"], &batch["content_digest"]),
            (&json!("assessed"), &json!(content_digest(START_US + 3_600_000_000))),
            "{batch}"
        );
        assert_eq!((&k2["name"], &k2["mean"], &k2["std"]), (&json!("k2"), &json!(4.5), &json!(0.12)), "{batch}");
        assert_eq!(k2["probability_of_damage"], 0.997, "{batch}");
        assert_eq!(batch["assessment"]["model_digest"], "model-a");
        assert_eq!(batch["measurements"][0]["frequencies_hz"], json!([0.7, 0.9, 1.1]));
        let exceedances = service.read("/v1/structures/three-dof/exceedances").await;
        assert_eq!(exceedances["items"].as_array().unwrap().len(), 1, "schema {schema}: {exceedances}");
        let read = service.read("/v1/structures/three-dof").await;
        assert_eq!((&read["undamaged"]["version"], &read["digest"]), (&json!(1), &json!(structure.1)), "{read}");
        let alarms = service.read("/v1/structures/three-dof/alarms").await;
        assert_eq!(alarms["items"].as_array().unwrap().len(), usize::from(schema >= 2), "schema {schema}: {alarms}");
        if schema >= 2 {
            assert_eq!(alarms["items"][0]["acknowledgement"]["by"], "Ida");
        }
        let diagnoses = service.read("/v1/structures/three-dof/diagnoses").await;
        // A job that was running when the program ended is marked as failed, whichever version wrote it.
        let states: Vec<_> = diagnoses["items"].as_array().unwrap().iter().map(|d| d["state"].clone()).collect();
        assert_eq!(states, if schema >= 3 { vec![json!("failed")] } else { Vec::new() }, "{diagnoses}");
        // A batch that a gateway repeats after the upgrade is recognised by its key, which is that of its source.
        let known = service.read("/v1/structures/three-dof/history").await;
        assert_eq!(known["items"].as_array().unwrap().len(), 2);
        let post = async |source: &str| {
            let body = json!({ "source": source, "measurements": measurements([4.0, 5.0, 6.0], 1, 86_400) });
            let request = service.request(Method::POST, "/v1/structures/three-dof/batches").json(&body);
            request.header("idempotency-key", "key-1").send().await.unwrap()
        };
        problem(post("default").await, 422, "idempotency_key_reused").await;
        created(post("another").await).await;
        assert_eq!((batch.get("posted_by"), &batch["source"]), (Some(&json!(null)), &json!("default")), "{batch}");
    }
}

/// A definition that an earlier version accepted and this one refuses is kept and reported, and does not affect other structures.
#[tokio::test]
async fn a_stored_definition_that_is_now_refused_affects_no_other_structure() {
    let structure = three_dof().await;
    let folder = tempfile::tempdir().unwrap();
    of_schema(folder.path(), 3, &structure).await;
    let mut connection = SqliteConnection::connect_with(&database(folder.path())).await.unwrap();
    let strange = structure.0.replace("\"three-dof\"", "\"old\"").replacen("\"mass\"", "\"weight\"", 1);
    sqlx::query("insert into structure values ('old', ?, 'digest-old', ?, ?)")
        .bind(&strange)
        .bind(START_US)
        .bind(START_US)
        .execute(&mut connection)
        .await
        .unwrap();
    connection.close().await.unwrap();
    let service = Service::start(folder.path());
    service.read(&format!("/v1/structures/three-dof/batches/{BATCH}")).await;
    let listed = service.read("/v1/structures").await;
    let old = listed["items"].as_array().unwrap().iter().find(|item| item["id"] == "old").unwrap().clone();
    assert!(old["definition_refused"].as_str().unwrap().contains("weight"), "{old}");
    let overview = service.read("/v1/overview").await;
    let old = overview["items"].as_array().unwrap().iter().find(|item| item["id"] == "old").unwrap().clone();
    assert!(old["model_missing"].as_str().unwrap().contains("weight"), "{old}");
    let ready = service.read("/readyz").await;
    let found = ready["findings"].as_array().unwrap().iter().any(|finding| finding["code"] == "definition_refused");
    assert!(found, "{ready}");
    problem(service.get("/v1/structures/old").send().await.unwrap(), 409, "definition_refused").await;
}

#[tokio::test]
async fn a_backup_of_an_earlier_schema_restores_and_one_of_a_later_one_is_refused() {
    let structure = three_dof().await;
    let (folder, target) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    of_schema(folder.path(), 1, &structure).await;
    let backup = target.path().join("backup");
    run(&["backup", "--data-dir", text(folder.path()), "--out", text(&backup)]).await;
    let record: serde_json::Value =
        serde_json::from_slice(&std::fs::read(backup.join("manifest.json")).unwrap()).unwrap();
    // The database is copied unchanged: a backup made before an upgrade must be usable by the earlier version.
    assert_eq!(record["schema_version"], 1, "{record}");
    let data_dir = target.path().join("data");
    std::fs::create_dir(&data_dir).unwrap();
    run(&["restore", "--from", text(&backup), "--data-dir", text(&data_dir)]).await;
    let service = Service::start(&data_dir);
    service.read(&format!("/v1/structures/three-dof/batches/{BATCH}")).await;

    let mut connection = SqliteConnection::connect_with(&database(folder.path())).await.unwrap();
    let newer = "insert into _sqlx_migrations (version, description, success, checksum, execution_time)
                 values (9999, 'from the future', 1, x'00', 0)";
    sqlx::query(newer).execute(&mut connection).await.unwrap();
    connection.close().await.unwrap();
    let said = fails(&["doctor", "--data-dir", text(folder.path()), "--config", "/dev/null"]).await;
    assert!(said.contains("version 9999, newer than version"), "{said}");
}

/// A program killed while it migrates leaves the schema before or the one after, and the next start completes the migration.
#[tokio::test]
async fn a_migration_that_is_killed_is_completed_by_the_next_start() {
    let structure = three_dof().await;
    let folder = tempfile::tempdir().unwrap();
    of_schema(folder.path(), 1, &structure).await;
    let mut connection = SqliteConnection::connect_with(&database(folder.path())).await.unwrap();
    // Enough rows for the second migration, which rewrites a table, to take several hundred milliseconds.
    let rows = 60_000;
    let newest =
        Migrator::new(repository("migrations").as_path()).await.unwrap().iter().map(|m| m.version).max().unwrap();
    execute(
        &mut connection,
        format!(
            "insert into quantity_assessment
             with recursive n (i) as (select 1 union all select i + 1 from n where i < {rows})
             select structure_id, batch_id, model_digest, undamaged_version, 'q' || i, i, unit, kind, mean + i, std, variance_within,
                    variance_between, edge_mass, threshold, probability_of_damage, 0, relative_change
             from quantity_assessment, n where quantity = 'k2'"
        ),
    )
    .await;
    connection.close().await.unwrap();
    // Each start is killed a little later, until one completes: some kills come in the middle of a migration.
    let mut versions = Vec::new();
    for step in 1..=200 {
        let mut child = command(folder.path()).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        std::thread::sleep(Duration::from_millis(15 * step));
        child.kill().unwrap();
        child.wait().unwrap();
        let mut connection = SqliteConnection::connect_with(&database(folder.path())).await.unwrap();
        let (version, count): (i64, i64) = sqlx::query_as(
            "select (select max(version) from _sqlx_migrations), (select count(*) from quantity_assessment)",
        )
        .fetch_one(&mut connection)
        .await
        .unwrap();
        assert_eq!(count, rows + 1, "schema {version}: rows were lost or duplicated");
        let failed: (i64,) = sqlx::query_as("select count(*) from _sqlx_migrations where success = 0")
            .fetch_one(&mut connection)
            .await
            .unwrap();
        assert_eq!(failed.0, 0, "a migration was left incomplete");
        connection.close().await.unwrap();
        versions.push(version);
        if version == newest {
            break;
        }
    }
    assert!(versions.len() > 3 && versions.last() == Some(&newest), "{versions:?}");
    let service = Service::start(folder.path());
    let batch = service.read(&format!("/v1/structures/three-dof/batches/{BATCH}")).await;
    assert_eq!(batch["assessment"]["parameters"].as_array().unwrap().len() as i64, rows + 1);
    println!("schemas after each kill: {versions:?}");
}
