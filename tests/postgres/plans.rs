//! What the server reads for an answer: a few rows by their keys, however much is stored.

use serde_json::Value;

use crate::helpers::{measurements, time, within, Service, PATIENCE};
use crate::server::Server;
use crate::world::{done, serve};

const STRUCTURE: &str = "/v1/structures/three-dof";

/// Number of stored batches, ten minutes apart.
const BATCHES: usize = 20_000;

/// Tables with this many rows or more are large.
const LARGE: usize = 10_000;

/// Five measurements ten seconds apart.
fn five(start_s: usize) -> Vec<Value> {
    let mut rows = measurements([4.0, 5.0, 6.0], 5, start_s);
    for (i, row) in rows.iter_mut().enumerate() {
        row["measured_at"] = time(start_s + 10 * i).into();
    }
    rows
}

/// Copies the only batch, with all that belongs to it, to later times.
fn copied(server: &Server, database: &str) {
    for table in ["measurement_batch", "measurement", "assessment", "quantity_assessment", "chart_point"] {
        let moved = |column: &str| format!("'{column}', (to_jsonb(t) ->> '{column}')::bigint + n * 600000000::bigint");
        let times = ["measured_from_us", "measured_to_us", "measured_at_us"].map(moved).join(", ");
        server.sql(
            database,
            &format!(
                "insert into modalwatch.{table} select copied.* from modalwatch.{table} t
                 cross join generate_series(1, {BATCHES} - 1) n cross join lateral
                 jsonb_populate_record(t, jsonb_build_object('batch_id', t.batch_id || '-' || n, {times})) copied"
            ),
        );
    }
    // The server does this by itself some minutes later.
    server.sql(database, "vacuum analyze");
}

/// How often each large table was read as a whole, and the number of rows that were read by keys.
fn reads(server: &Server, database: &str) -> (String, usize) {
    let large = format!(
        "from pg_stat_user_tables s join pg_class c on c.oid = s.relid where c.reltuples >= {LARGE} and schemaname = 'modalwatch'"
    );
    let whole = format!("select coalesce(string_agg(s.relname || ' ' || seq_scan, ', '), '') {large} and seq_scan > 0");
    let by_key = format!("select coalesce(sum(idx_tup_fetch), 0) {large}");
    (server.sql(database, &whole), server.sql(database, &by_key).parse().unwrap())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_question_about_a_structure_reads_a_large_table_as_a_whole() {
    if !Server::is_installed() {
        return;
    }
    let data = tempfile::tempdir().unwrap();
    let server = Server::get();
    let url = server.database_of(data.path());
    let database = url.rsplit_once('/').unwrap().1;
    done(&["migrate", "schema", "--url", &url]);
    let mut service = Service::spawn(&mut serve(data.path(), &url));
    let posted = service.post_batch("three-dof", &five(0)).await;
    let batch = posted["batch"].as_str().unwrap().to_owned();
    within(PATIENCE, "the assessment", async || {
        let state = service.read(&format!("{STRUCTURE}/batches/{batch}")).await["state"].clone();
        (state == "assessed").then_some(())
    })
    .await;
    copied(server, database);
    let large = "select count(*) from pg_class where reltuples >= 10000 and relnamespace = 'modalwatch'::regnamespace
                 and relkind = 'r'";
    assert_eq!(server.sql(database, large), "5", "tables");
    server.sql(database, "select pg_stat_reset()");

    let to = time(BATCHES / 10 * 600);
    let series = service.read(&format!("{STRUCTURE}/series?to={to}")).await;
    assert_eq!(series["batches"], BATCHES / 10, "the window");
    for path in [
        format!("{STRUCTURE}/history?limit=100"),
        format!("{STRUCTURE}/history?limit=100&from={to}"),
        format!("{STRUCTURE}/batches/{batch}"),
        format!("{STRUCTURE}/alarms"),
        "/v1/overview".to_owned(),
    ] {
        service.read(&path).await;
    }
    service.post_batch("three-dof", &five(13_000_000)).await;
    // What a session has read is counted when it ends at the latest.
    assert!(service.stop("TERM").success());
    let (whole, by_key) = within(PATIENCE, "the counts of the server", async || {
        let (whole, by_key) = reads(server, database);
        (by_key >= BATCHES / 2).then_some((whole, by_key))
    })
    .await;
    assert_eq!(whole, "", "tables read as a whole, with {by_key} rows read by keys");
}
