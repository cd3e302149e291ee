//! What the server reads for an answer: a few rows by their keys, however much is stored.

use serde_json::Value;

use crate::helpers::{measurements, time, within, Service, PATIENCE};
use crate::postgres::server::Server;
use crate::postgres::world::{database_with_tables, serve};

const STRUCTURE: &str = "/v1/structures/three-dof";

/// Number of stored batches of the structure, ten minutes apart.
const BATCHES: usize = 20_000;

/// Number of other structures, with one batch each, so that an average structure has few rows.
const OTHERS: usize = 400;

/// A connection keeps the plan of a statement from its sixth call on. The service has some connections.
const TIMES: usize = 40;

/// Number of batches of a page of the history, and of a short series.
const PAGE: usize = 100;

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

/// Copies the only batch, with all that belongs to it, to later times and to other structures.
fn copied(server: &Server, database: &str) {
    let of_others = "jsonb_build_object('structure_id', 'other-' || n)";
    let copy = |table: &str, rows: usize, changes: &str| {
        let copies = format!(
            "insert into modalwatch.{table} select copied.* from modalwatch.{table} t cross join generate_series(1, {rows}) n
             cross join lateral jsonb_populate_record(t, {changes}) copied where t.structure_id = 'three-dof'"
        );
        server.sql(database, &copies);
    };
    copy("structure", OTHERS, of_others);
    for table in ["measurement_batch", "measurement", "assessment", "quantity_assessment", "chart_point"] {
        copy(table, OTHERS, of_others);
        let moved = |column: &str| format!("'{column}', (to_jsonb(t) ->> '{column}')::bigint + n * 600000000::bigint");
        let times = ["measured_from_us", "measured_to_us", "measured_at_us"].map(moved).join(", ");
        copy(table, BATCHES - 1, &format!("jsonb_build_object('batch_id', t.batch_id || '-' || n, {times})"));
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
    let url = database_with_tables(server, data.path());
    let database = url.rsplit_once('/').unwrap().1;
    let mut service = Service::spawn(&mut serve(data.path(), &url));
    let posted = service.post_batch("three-dof", &five(0)).await;
    let batch = posted["batch"].as_str().unwrap().to_owned();
    within(PATIENCE, "the assessment", async || {
        let state = service.read(&format!("{STRUCTURE}/batches/{batch}")).await["state"].clone();
        (state == "assessed").then_some(())
    })
    .await;
    // A session that is idle tells the server only after some seconds what it has read, and these tables were small: it ends before the counts begin.
    assert!(service.stop("TERM").success());
    copied(server, database);
    let large = "select count(*) from pg_class where reltuples >= 10000 and relnamespace = 'modalwatch'::regnamespace
                 and relkind = 'r'";
    assert_eq!(server.sql(database, large), "5", "tables");
    server.sql(database, "select pg_stat_reset()");

    let mut service = Service::spawn(&mut serve(data.path(), &url));
    let window = BATCHES / 10;
    let to = time(window * 600);
    let series = service.read(&format!("{STRUCTURE}/series?to={to}")).await;
    assert_eq!(series["batches"], window, "the window");
    for path in [format!("{STRUCTURE}/batches/{batch}"), format!("{STRUCTURE}/alarms"), "/v1/overview".to_owned()] {
        service.read(&path).await;
    }
    let pages = [
        format!("{STRUCTURE}/history?limit={PAGE}"),
        format!("{STRUCTURE}/history?limit={PAGE}&from={to}"),
        format!("{STRUCTURE}/measurements?limit={PAGE}&from={to}"),
        format!("{STRUCTURE}/series?to={}", time(PAGE * 600)),
    ];
    for _ in 0..TIMES {
        for page in &pages {
            service.read(page).await;
        }
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
    // A batch has five measurements, three quantities, an assessment, which is compared with its others, and some points of charts.
    let of_batches = window + pages.len() * TIMES * PAGE;
    assert!(by_key < 30 * of_batches, "{by_key} rows read for {of_batches} batches");
}
