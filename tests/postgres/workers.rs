//! Replay of history by workers: the same rows as without them, whatever happens to whom.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use reqwest::Method;
use serde_json::{json, Value};
use tempfile::TempDir;
use tokio::sync::OnceCell;

use crate::helpers::{created, measurements, problem, program, refusal, repository, within, Service};
use crate::postgres::server::Server;
use crate::postgres::world::{answer, database_with_tables, pending};

const STRUCTURE: &str = "/v1/structures/three-dof";
const BATCHES: &str = "/v1/structures/three-dof/batches";

/// How long a replay may take on a machine with other work.
const LONG: Duration = Duration::from_mins(3);

/// Seconds after which a worker that is not heard of loses its piece.
const LEASE_S: u64 = 2;

/// Number of batches of the history, which are in seven months.
const HISTORY: usize = 84;

/// Tables and the columns of them in which two replays agree: all but times of the present day, and the grade of an alarm, which says
/// what its last message said. Several batches may be stored before the alarms are graded, so it depends on the moment.
const COMPARED: [(&str, &str); 8] = [
    ("measurement_batch", "structure_id, batch_id, state, failure"),
    (
        "assessment",
        "structure_id, batch_id, model_digest, undamaged_version, structure_digest, seed, draws_per_measurement, measurements_used,
         measurements_left_out, measurements_outside, misfit_percent, effective_sample_size, trust, plotted, joint",
    ),
    ("quantity_assessment", "*"),
    ("chart_point", "*"),
    ("process_point", "*"),
    ("undamaged_batch", "*"),
    ("kept_comparison", "*"),
    (
        "alarm_episode",
        "structure_id, episode, kind, series, opened_at_us, opened_batch, ended_at_us, withdrawn, peak_shift",
    ),
];

/// A database with a history that was assessed, as a template for others.
struct History {
    server: &'static Server,
    name: String,
}

/// A copy of it in which all batches wait, and nothing of their assessments is there.
struct Copy {
    server: &'static Server,
    name: String,
    url: String,
    folder: TempDir,
}

/// Posterior samples for the population, in the history and in a replay, which has to take some seconds.
const FEW_DRAWS: &str = "64";
const MANY_DRAWS: &str = "400";

/// `modalwatch serve` on a database, with many draws for each batch and short leases.
fn serve(program: &Path, url: &str, folder: &Path, roles: &str) -> Command {
    let mut command = Command::new(program);
    command.args(["serve", "--listen", "127.0.0.1:0", "--roles", roles, "--data-dir"]).arg(folder);
    command.env("MODALWATCH__STORE__URL", url).env("MODALWATCH__STORE__TAKEOVER_S", LEASE_S.to_string());
    command.env("MODALWATCH__MONITOR__DRAWS_FOR_POPULATION", MANY_DRAWS).env("MODALWATCH__LOG__LEVEL", "warn");
    command
}

impl History {
    /// Batches of seven months: a reference of the first ones, a loss towards the end, some of another source.
    async fn new() -> Self {
        let (server, folder) = (Server::get(), tempfile::tempdir().unwrap());
        let url = database_with_tables(server, folder.path());
        let mut command = serve(&program(), &url, folder.path(), "api");
        command.env("MODALWATCH__MONITOR__DRAWS_FOR_POPULATION", FEW_DRAWS);
        let service = Service::spawn(&mut command);
        let mut first = Vec::new();
        for number in 0..HISTORY {
            let k = if number < 60 { [4.0, 5.0, 6.0] } else { [4.0, 4.0, 6.0] };
            let mut rows = measurements(k, 12, number * 216_000);
            if number % 11 == 3 {
                rows[1]["frequencies_hz"][2] = Value::Null;
            }
            let source = if number % 7 == 0 { "logger-2" } else { "gateway" };
            let posted = created(service.post(BATCHES, &json!({ "measurements": rows, "source": source })).await).await;
            if number < 20 {
                first.push(posted["batch"].clone());
            }
            if number == 20 {
                created(service.post(&format!("{STRUCTURE}/reference"), &json!({ "batches": first })).await).await;
            }
        }
        within(LONG, "all are assessed", async || (pending(&service).await == 0.0).then_some(())).await;
        drop(service);
        let name = url.rsplit_once('/').unwrap().1.to_owned();
        // A database that is in use cannot be copied.
        let used = format!("select count(*) from pg_stat_activity where datname = '{name}'");
        within(LONG, "nobody uses it", async || (server.sql("postgres", &used) == "0").then_some(())).await;
        Self { server, name }
    }

    fn copy(&self) -> Copy {
        let folder = tempfile::tempdir().unwrap();
        let name = format!("copy_{}", suffix_of(folder.path()));
        self.server.sql("postgres", &format!("create database {name} template {}", self.name));
        let copy = Copy { server: self.server, url: self.server.url(&name), name, folder };
        copy.sql(
            "set search_path to modalwatch;
             delete from alarm_action; delete from alarm_episode; delete from process_point; delete from chart_point;
             delete from quantity_assessment; delete from assessment;
             update measurement_batch set state = 'received', received_at_us = received_at_us - 3600000000",
        );
        assert_eq!(copy.number("select count(*) from measurement_batch where state = 'received'"), HISTORY);
        copy
    }
}

fn suffix_of(folder: &Path) -> String {
    let bytes: Vec<String> =
        folder.display().to_string().bytes().rev().take(12).map(|byte| format!("{byte:02x}")).collect();
    bytes.concat()
}

impl Copy {
    fn sql(&self, statement: &str) -> String {
        self.server.sql(&self.name, statement)
    }

    fn number(&self, select: &str) -> usize {
        let select = select.replace("from ", "from modalwatch.");
        self.sql(&select).parse().unwrap()
    }

    fn serve(&self, roles: &str) -> Service {
        Service::spawn(&mut self.command(roles))
    }

    fn command(&self, roles: &str) -> Command {
        serve(&program(), &self.url, self.folder.path(), roles)
    }

    /// Starts a worker, and waits until the database has heard of it.
    async fn worker(&self) -> Service {
        let before = self.number("select count(*) from computation_worker");
        let worker = self.serve("worker");
        within(LONG, "the worker is heard of", async || {
            (self.number("select count(*) from computation_worker") > before).then_some(())
        })
        .await;
        worker
    }

    /// Waits until a service has assessed everything.
    async fn replayed(&self, service: &Service) {
        within(LONG, "everything is assessed", async || (pending(service).await == 0.0).then_some(())).await;
        // What was shared is removed at the end.
        within(LONG, "nothing is left of what was shared", async || {
            let left = self.number("select count(*) from computation_piece")
                + self.number("select count(*) from computation_result");
            (left == 0).then_some(())
        })
        .await;
    }

    /// Waits until so many results were computed, stored or not.
    async fn until(&self, computed: usize) {
        within(LONG, "some results", async || {
            let stored = self.number("select count(*) from assessment");
            let delivered = self.number("select count(*) from computation_result");
            (stored + delivered >= computed).then_some(())
        })
        .await;
    }

    /// All rows, as texts: PostgreSQL prints a number so that it is read back as the same bits.
    fn rows(&self) -> Vec<String> {
        let rows = |(table, columns): &(&str, &str)| {
            let select =
                format!("select '{table} ' || r::text from (select {columns} from modalwatch.{table}) r order by 1");
            let rows = self.sql(&select);
            rows.lines().map(str::to_owned).collect::<Vec<_>>()
        };
        COMPARED.iter().flat_map(rows).collect()
    }
}

/// The value of a metric.
async fn metric(process: &Service, name: &str) -> usize {
    let text = process.get("/metrics").send().await.unwrap().text().await.unwrap();
    let line = text.lines().find(|line| line.starts_with(&format!("{name} ")));
    line.map_or(0, |line| line.rsplit_once(' ').unwrap().1.parse().unwrap())
}

/// Number of assessments and jobs that a worker has computed.
pub async fn delivered(worker: &Service) -> usize {
    metric(worker, "modalwatch_computations_delivered_total").await
}

/// The history that all tests replay.
static HISTORY_OF_ALL: OnceCell<History> = OnceCell::const_new();

async fn history() -> &'static History {
    HISTORY_OF_ALL.get_or_init(History::new).await
}

/// What a replay without workers gives, and the history.
async fn expected() -> (&'static History, &'static [String]) {
    static ROWS: OnceCell<Vec<String>> = OnceCell::const_new();
    let history = history().await;
    let rows = ROWS.get_or_init(async || {
        let copy = history.copy();
        let service = copy.serve("api,worker");
        copy.replayed(&service).await;
        let rows = copy.rows();
        assert!(rows.iter().filter(|row| row.starts_with("quantity_assessment ")).count() >= 3 * HISTORY);
        assert!(rows.iter().any(|row| row.starts_with("alarm_episode ")), "the loss raised no alarm");
        rows
    });
    (history, rows.await)
}

fn assert_same(found: &[String], expected: &[String]) {
    assert_eq!(found.len(), expected.len());
    for (found, expected) in found.iter().zip(expected) {
        assert_eq!(found, expected);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn with_one_and_two_workers_and_a_standby_the_same_history_gives_the_same_rows() {
    if !Server::is_installed() {
        return;
    }
    let (history, expected) = expected().await;
    for (count, roles) in [(1, "api"), (2, "api"), (1, "api,worker")] {
        let copy = history.copy();
        let mut workers = Vec::new();
        for _ in 0..count {
            workers.push(copy.worker().await);
        }
        let service = copy.serve(roles);
        copy.replayed(&service).await;
        assert_same(&copy.rows(), expected);
        let mut by_workers = Vec::new();
        for worker in &workers {
            by_workers.push(delivered(worker).await);
            assert_eq!(worker.get("/readyz").send().await.unwrap().status(), 200);
            assert_eq!(worker.read("/healthz").await["status"], "alive");
            problem(worker.get("/v1/structures").send().await.unwrap(), 404, "unknown_route").await;
        }
        println!("roles {roles}, {count} workers: {by_workers:?} of {HISTORY} batches computed by them");
        assert!(by_workers.iter().all(|delivered| *delivered >= HISTORY / 14), "{by_workers:?}");
        if roles == "api" {
            let sum = by_workers.iter().sum::<usize>();
            // The service computes what nobody has claimed for a while.
            assert!((HISTORY / 2..=HISTORY).contains(&sum), "most by the service, or one twice: {sum}");
        }
    }
    // A standby computes while it waits, from the moment at which it comes.
    let copy = history.copy();
    let service = copy.serve("api");
    let folder = tempfile::tempdir().unwrap();
    let mut standby = serve(&program(), &copy.url, folder.path(), "api,worker");
    standby.env("MODALWATCH__STORE__STANDBY", "true").stdout(Stdio::null()).stderr(Stdio::null());
    let mut standby = standby.spawn().unwrap();
    within(LONG, "the standby computes", async || {
        (copy.number("select count(*) from computation_piece where worker is not null") > 0).then_some(())
    })
    .await;
    copy.replayed(&service).await;
    assert_same(&copy.rows(), expected);
    standby.kill().unwrap();
    standby.wait().unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn workers_and_services_that_are_killed_are_replaced_by_the_others() {
    if !Server::is_installed() {
        return;
    }
    let (history, expected) = expected().await;

    // A worker is killed, the other one goes on with its piece.
    let copy = history.copy();
    let (mut one, other) = (copy.worker().await, copy.worker().await);
    let service = copy.serve("api");
    within(LONG, "both work", async || (delivered(&one).await > 0 && delivered(&other).await > 0).then_some(())).await;
    one.kill();
    copy.replayed(&service).await;
    assert_same(&copy.rows(), expected);

    // All workers are killed: the service does the rest.
    let copy = history.copy();
    let mut only = copy.worker().await;
    let service = copy.serve("api");
    copy.until(HISTORY / 4).await;
    only.kill();
    copy.replayed(&service).await;
    assert_same(&copy.rows(), expected);

    // The service is killed: what the workers have computed until then is not computed again, and they go on without it.
    let copy = history.copy();
    let worker = copy.worker().await;
    let mut service = copy.serve("api");
    copy.until(HISTORY / 4).await;
    service.kill();
    let service = copy.serve("api");
    copy.replayed(&service).await;
    assert_same(&copy.rows(), expected);
    let by_worker = delivered(&worker).await;
    assert!(
        (HISTORY / 4..=HISTORY).contains(&by_worker),
        "{by_worker}: a batch was computed twice, or most by the service"
    );

    // A worker that is told to stop gives back its piece at once, with what it has computed.
    let copy = history.copy();
    let mut stopped = copy.worker().await;
    let service = copy.serve("api");
    copy.until(HISTORY / 4).await;
    assert!(stopped.stop("TERM").success());
    assert_eq!(copy.number("select count(*) from computation_worker"), 0);
    assert_eq!(copy.number("select count(*) from computation_piece where worker is not null"), 0);
    copy.replayed(&service).await;
    assert_same(&copy.rows(), expected);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_that_wakes_up_behind_its_lease_changes_nothing() {
    if !Server::is_installed() {
        return;
    }
    let (history, expected) = expected().await;
    let copy = history.copy();
    let slow = copy.worker().await;
    let service = copy.serve("api");
    // In the middle of a piece: some of its batches have no result yet.
    let in_a_piece = "select count(*) from computation_piece p where worker is not null and exists (select 1 from measurement_batch b
        where b.state = 'received' and b.measured_from_us >= p.from_us and b.measured_from_us < p.to_us and not exists
            (select 1 from computation_result r where r.batch_id = b.batch_id))";
    within(LONG, "it works", async || {
        slow.signal("STOP");
        let is_inside = copy.number(in_a_piece) > 0;
        if !is_inside {
            slow.signal("CONT");
        }
        is_inside.then_some(())
    })
    .await;
    let suspended = Instant::now();
    copy.replayed(&service).await;
    assert!(suspended.elapsed() > Duration::from_secs(LEASE_S), "its lease was not waited for");
    let rows = copy.rows();
    assert_same(&rows, expected);
    copy.sql("update modalwatch.computation_worker set heard_at = heard_at - interval '1 minute'");
    slow.signal("CONT");
    within(LONG, "it is heard of again", async || {
        let heard =
            copy.number("select count(*) from computation_worker where heard_at > clock_timestamp() - interval '30 s'");
        (heard == 1).then_some(())
    })
    .await;
    // Its late results are ready, or it has seen that nothing waits any more.
    within(LONG, "it has nothing to do", async || slow.read("/readyz").await["structure"].is_null().then_some(()))
        .await;
    assert_same(&copy.rows(), &rows);
    assert_eq!(copy.number("select count(*) from computation_result"), 0, "its late results were written");
    // It works again.
    within(LONG, "it is ready", async || (slow.get("/readyz").send().await.unwrap().status() == 200).then_some(()))
        .await;
}

/// The shipped model of `three-dof` in a folder, with another digest.
fn another_model(folder: &Path) -> PathBuf {
    let own = folder.join("three-dof");
    std::fs::create_dir_all(&own).unwrap();
    for file in ["structure.toml", "baseline.safetensors", "baseline.json"] {
        let mut bytes = std::fs::read(repository("models/three-dof").join(file)).unwrap();
        if file == "baseline.json" {
            bytes.push(b'\n');
        }
        std::fs::write(own.join(file), bytes).unwrap();
    }
    folder.to_owned()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_of_another_program_or_without_the_model_leaves_its_work_to_others_and_says_so() {
    if !Server::is_installed() {
        return;
    }
    let (history, expected) = expected().await;

    // Another program: the same with one more byte at its end, as far as anybody can tell.
    let folder = tempfile::tempdir().unwrap();
    let other = folder.path().join("modalwatch");
    std::fs::copy(program(), &other).unwrap();
    std::io::Write::write_all(&mut std::fs::OpenOptions::new().append(true).open(&other).unwrap(), b"\n").unwrap();
    let copy = history.copy();
    let worker = Service::spawn(&mut serve(&other, &copy.url, folder.path(), "worker"));
    within(LONG, "it is heard of", async || {
        (copy.number("select count(*) from computation_worker") == 1).then_some(())
    })
    .await;
    let service = copy.serve("api");
    copy.replayed(&service).await;
    assert_eq!(delivered(&worker).await, 0);
    assert_same(&copy.rows(), expected);

    // A model of a folder that the worker has not.
    let models = another_model(&folder.path().join("models"));
    let copy = history.copy();
    let worker = copy.worker().await;
    let service = Service::spawn(copy.command("api").arg("--models").arg(&models));
    let said = within(LONG, "it says what is missing", async || {
        let health = worker.read("/readyz").await;
        let finding = health["findings"][0].clone();
        (finding["code"] == "model_missing").then(|| finding["message"].as_str().unwrap().to_owned())
    })
    .await;
    assert!(said.contains("three-dof") && said.contains("no --models folder"), "{said}");
    copy.replayed(&service).await;
    assert_eq!(delivered(&worker).await, 0);
    let without_models = copy.rows();
    let copy = history.copy();
    let worker = Service::spawn(copy.command("worker").arg("--models").arg(&models));
    within(LONG, "it is heard of", async || {
        (copy.number("select count(*) from computation_worker") == 1).then_some(())
    })
    .await;
    let service = Service::spawn(copy.command("api").arg("--models").arg(&models));
    copy.replayed(&service).await;
    // The service computes what nobody has claimed for a while.
    let by_worker = delivered(&worker).await;
    assert!((HISTORY / 2..=HISTORY).contains(&by_worker), "{by_worker}");
    assert_same(&copy.rows(), &without_models);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn batches_that_arrive_during_a_replay_are_answered_with_their_assessment() {
    if !Server::is_installed() {
        return;
    }
    let (history, _) = expected().await;
    let copy = history.copy();
    let _worker = copy.worker().await;
    let service = copy.serve("api,worker");
    let (mut during, mut number) = (0, 0);
    while pending(&service).await > 0.0 {
        let rows = measurements([4.0, 5.0, 6.0], 5, HISTORY * 216_000 + number * 3_600);
        let posted = created(service.post(BATCHES, &json!({ "measurements": rows })).await).await;
        assert_eq!(posted["state"], "assessed", "{posted}");
        // One that was measured in the middle of what waits: the assessment of its successor depends on it.
        let rows = measurements([4.0, 5.0, 6.0], 2, number * 216_000 + 100_000);
        created(service.post(BATCHES, &json!({ "measurements": rows, "source": "late" })).await).await;
        let verdict = answer(&service, Method::GET, "/v1/overview", None).await;
        during += usize::from(verdict.to_string().contains(" batches are assessed."));
        number += 1;
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    assert!(number > 3 && during > 0, "{number} batches, the progress was said {during} times");
    copy.replayed(&service).await;
    assert_eq!(copy.number("select count(*) from measurement_batch where state = 'assessed'"), HISTORY + 2 * number);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_new_reference_during_a_replay_is_the_one_that_everything_is_compared_with() {
    if !Server::is_installed() {
        return;
    }
    let history = history().await;
    let mut found = Vec::new();
    for workers in [0, 1] {
        let copy = history.copy();
        let worker = if workers == 1 { Some(copy.worker().await) } else { None };
        let service = copy.serve("api");
        copy.until(HISTORY / 3).await;
        let ids = copy.sql("select batch_id from modalwatch.measurement_batch order by batch_id limit 12");
        let batches: Vec<&str> = ids.lines().collect();
        let declared = service.post(&format!("{STRUCTURE}/reference"), &json!({ "batches": batches })).await;
        created(declared).await;
        copy.replayed(&service).await;
        if let Some(worker) = &worker {
            assert!(delivered(worker).await >= HISTORY / 3);
        }
        // The newest assessment of each batch; when a batch was compared with the reference before depends on the moment.
        found.push(copy.sql(
            "select batch_id, quantity, undamaged_version, mean, std, probability_of_damage from modalwatch.quantity_assessment q
             where undamaged_version = (select max(undamaged_version) from modalwatch.quantity_assessment o
                 where o.structure_id = q.structure_id and o.batch_id = q.batch_id) order by 1, 2",
        ));
    }
    assert!(found[0].lines().count() > 3 * (HISTORY - 12));
    assert_eq!(found[0], found[1]);
}

#[test]
fn roles_that_cannot_be_had_are_refused_with_what_to_do() {
    let folder = tempfile::tempdir().unwrap();
    let plain = |roles: &str| {
        let mut command = Command::new(program());
        command.args(["serve", "--listen", "0", "--roles", roles, "--data-dir"]).arg(folder.path());
        refusal(&mut command)
    };
    for (roles, says) in [
        ("worker", "roles is worker: it must be api,worker with a SQLite file"),
        ("api", "store.url"),
        ("alarm", "\"alarm\" is not a role: the roles are api and worker"),
        ("", "at least one role"),
    ] {
        let said = plain(roles);
        assert!(said.contains(says), "{roles}: {said}");
    }
    if !Server::is_installed() {
        return;
    }
    let url = Server::get().database_of(folder.path());
    let said = refusal(&mut serve(&program(), &url, folder.path(), "worker"));
    assert!(said.contains("modalwatch migrate schema"), "{said}");
    let said = refusal(&mut serve(&program(), &format!("{url}_missing"), folder.path(), "worker"));
    assert!(said.contains("check user, password and database"), "{said}");
}
