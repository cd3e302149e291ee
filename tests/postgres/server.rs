//! A PostgreSQL server of the tests: Debian's programs, a temporary folder, a free port of this machine.

use std::fmt::Write as _;
use std::io::{BufRead as _, BufReader};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::{Mutex, OnceLock};
use std::time::{Duration, Instant};

use crate::needs;

/// Where Debian has the programs of its version of PostgreSQL, newest first.
const VERSIONS: [u32; 4] = [18, 17, 16, 15];

/// How long a server may take to start or to stop.
const PATIENCE: Duration = Duration::from_mins(1);

/// Makes a cluster in a new folder, unless one is given, and runs its server until the standard input ends, however the tests end; then
/// removes the folder. Arguments: folder of the programs, port, folder of a cluster or nothing, further options of the server. The first line
/// of the output is the folder.
const SCRIPT: &str = r#"
set -eu
programs=$1 port=$2 data=$3; shift 3
folder=$(mktemp -d "${TMPDIR:-/tmp}/modalwatch-postgres-XXXXXX")
trap 'rm -rf "$folder"' EXIT
if [ -z "$data" ]; then
    data=$folder/data
    "$programs/initdb" --pgdata="$data" --username=modalwatch --auth=trust --encoding=UTF8 --locale=C.UTF-8 --no-sync > "$folder/initdb.log"
fi
echo "$folder"
run() {
    "$programs/postgres" -D "$data" -p "$port" -c listen_addresses=127.0.0.1 -c unix_socket_directories= \
        -c max_connections=400 "$@" >> "$folder/log" 2>&1 &
    server=$!
}
run "$@"
while read -r order; do
    case $order in
    stop) kill -INT "$server"; wait "$server" || true; echo stopped ;;
    kill) kill -QUIT "$server"; wait "$server" || true; echo stopped ;;
    start) run "$@"; echo started ;;
    esac
done
kill -QUIT "$server" 2> /dev/null || true
wait "$server" || true
"#;

/// A session of `psql`.
pub struct Session(Child);

impl Drop for Session {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A running server.
pub struct Server {
    port: u16,
    /// Its orders; the server ends when this is closed.
    orders: Mutex<(ChildStdin, BufReader<std::process::ChildStdout>)>,
    _script: Child,
}

impl Server {
    /// Whether PostgreSQL is installed; otherwise the test is recorded as skipped.
    pub fn is_installed() -> bool {
        programs().is_some() || needs::installed(&folder_of(VERSIONS[VERSIONS.len() - 1]).join("postgres"))
    }

    /// The server that the tests of this binary share, whose data need not survive a power failure.
    pub fn get() -> &'static Self {
        static SHARED: OnceLock<Server> = OnceLock::new();
        SHARED.get_or_init(|| Self::start(&["-c", "fsync=off", "-c", "full_page_writes=off"]))
    }

    /// Starts a server with further options.
    pub fn start(options: &[&str]) -> Self {
        Self::start_on("", options)
    }

    /// Starts a server on the folder of an existing cluster.
    pub fn start_on(data: &str, options: &[&str]) -> Self {
        let programs = programs().expect("the test asks for it before");
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        // The server refuses to run as root.
        let mut command = if is_root() {
            let mut command = Command::new("setpriv");
            command.args(["--reuid=postgres", "--regid=postgres", "--clear-groups", "sh"]);
            command
        } else {
            Command::new("sh")
        };
        command
            .args(["-c", SCRIPT, "postgres"])
            .arg(programs)
            .arg(port.to_string())
            .arg(data)
            .args(options)
            .current_dir("/");
        let mut script = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let (orders, mut answers) = (script.stdin.take().unwrap(), BufReader::new(script.stdout.take().unwrap()));
        let mut folder = String::new();
        answers.read_line(&mut folder).unwrap();
        assert!(!folder.is_empty(), "initdb failed");
        let server = Self { port, orders: Mutex::new((orders, answers)), _script: script };
        server.wait_until_ready();
        server
    }

    /// Host and port.
    pub fn address(&self) -> String {
        format!("127.0.0.1:{}", self.port)
    }

    /// The URL of a database.
    pub fn url(&self, database: &str) -> String {
        format!("postgres://modalwatch@{}/{database}", self.address())
    }

    /// The URL of the database that belongs to a folder; it is created if it is missing, without tables.
    pub fn database_of(&self, folder: &Path) -> String {
        let mut name = String::from("db");
        for byte in folder.display().to_string().bytes().rev().take(28) {
            write!(name, "{byte:02x}").unwrap();
        }
        let exists = self.sql("postgres", &format!("select 1 from pg_database where datname = '{name}'"));
        if exists.is_empty() {
            self.sql("postgres", &format!("create database {name}"));
        }
        self.url(&name)
    }

    /// What a statement answers, as `psql` prints it without headings.
    pub fn sql(&self, database: &str, statement: &str) -> String {
        let psql = programs().unwrap().join("psql");
        let port = self.port.to_string();
        let mut command = Command::new(psql);
        command.args([
            "-X",
            "-q",
            "-A",
            "-t",
            "-v",
            "ON_ERROR_STOP=1",
            "-h",
            "127.0.0.1",
            "-p",
            &port,
            "-U",
            "modalwatch",
        ]);
        let output = command.args(["-d", database, "-c", statement]).output().unwrap();
        assert!(output.status.success(), "{statement}: {}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap().trim().to_owned()
    }

    /// Runs one of the programs of the server, as the user under whom it runs.
    pub fn tool_of_server(name: &str, arguments: &[&str]) {
        let program = programs().unwrap().join(name);
        let mut command = if is_root() {
            let mut command = Command::new("setpriv");
            command.args(["--reuid=postgres", "--regid=postgres", "--clear-groups"]).arg(program);
            command
        } else {
            Command::new(program)
        };
        let output = command.args(arguments).current_dir("/").output().unwrap();
        assert!(output.status.success(), "{name}: {}", String::from_utf8_lossy(&output.stderr));
    }

    /// A session that runs a statement until it is dropped.
    pub fn session(&self, database: &str, statement: &str) -> Session {
        let mut command = Command::new(programs().unwrap().join("psql"));
        command.args(["-X", "-q", "-h", "127.0.0.1", "-p", &self.port.to_string(), "-U", "modalwatch", "-d", database]);
        Session(command.args(["-c", statement]).stdout(Stdio::null()).spawn().unwrap())
    }

    /// Runs one of the tools of the server.
    pub fn tool(name: &str, arguments: &[&str]) {
        let output = Command::new(programs().unwrap().join(name)).args(arguments).output().unwrap();
        assert!(output.status.success(), "{name}: {}", String::from_utf8_lossy(&output.stderr));
    }

    /// Stops the server: open transactions are rolled back.
    pub fn stop(&self) {
        self.order("stop");
    }

    /// Stops the server at once, as a power failure of its machine would.
    pub fn kill(&self) {
        self.order("kill");
    }

    /// Starts it again, on the same port and data.
    pub fn start_again(&self) {
        self.order("start");
        self.wait_until_ready();
    }

    fn order(&self, order: &str) {
        use std::io::Write as _;
        let mut orders = self.orders.lock().unwrap();
        writeln!(orders.0, "{order}").unwrap();
        let mut answer = String::new();
        orders.1.read_line(&mut answer).unwrap();
        assert!(!answer.is_empty(), "the server ended by itself");
    }

    fn wait_until_ready(&self) {
        let (programs, port) = (programs().unwrap(), self.port.to_string());
        let begun = Instant::now();
        loop {
            let mut ready = Command::new(programs.join("pg_isready"));
            if ready.args(["-q", "-h", "127.0.0.1", "-p", &port]).status().unwrap().success() {
                return;
            }
            assert!(begun.elapsed() < PATIENCE, "the server is not ready after {PATIENCE:?}");
            std::thread::sleep(Duration::from_millis(50));
        }
    }
}

/// Gives a file or folder of a test, with all in it, to the user under whom servers run.
pub fn give_to_server(path: &Path) {
    if is_root() {
        assert!(Command::new("chown").args(["-R", "postgres:postgres"]).arg(path).status().unwrap().success());
    }
}

fn folder_of(version: u32) -> PathBuf {
    PathBuf::from(format!("/usr/lib/postgresql/{version}/bin"))
}

/// The folder of the newest installed version.
fn programs() -> Option<PathBuf> {
    VERSIONS.into_iter().map(folder_of).find(|folder| folder.join("postgres").is_file())
}

fn is_root() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    status.lines().any(|line| line.strip_prefix("Uid:").is_some_and(|ids| ids.split_whitespace().nth(1) == Some("0")))
}
