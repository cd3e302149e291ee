//! Programs, files and rights that some tests need. If one is missing, the test is recorded as skipped; with `CI=true` a missing
//! program or file of `.ci/tools` fails the test.

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// Path of a program on the search path or in Debian's folders for administrators; `None` if it is missing.
pub fn program(name: &str) -> Option<PathBuf> {
    let search_path = std::env::var_os("PATH").unwrap_or_default();
    let more = ["/usr/sbin", "/usr/local/sbin"].map(PathBuf::from);
    let found = std::env::split_paths(&search_path).chain(more).map(|folder| folder.join(name)).find(|p| p.is_file());
    if found.is_none() {
        missing_tool(name);
    }
    found
}

/// Whether a file that `.ci/tools` installs exists.
pub fn installed(file: &Path) -> bool {
    let there = file.is_file();
    if !there {
        missing_tool(&file.display().to_string());
    }
    there
}

/// Records the test as skipped, because it lacks data that are not part of the repository or a right on this machine.
pub fn missing(what: &str) {
    record(what);
}

fn missing_tool(name: &str) {
    record(&format!("{name} is missing (.ci/tools installs it)"));
    assert!(!in_ci(), "CI=true, and {name} is missing (.ci/tools installs it)");
}

pub fn in_ci() -> bool {
    std::env::var("CI").as_deref() == Ok("true")
}

/// The file of skipped tests. Its first line identifies the run of `cargo test` to which they belong.
fn file() -> PathBuf {
    Path::new(env!("CARGO_TARGET_TMPDIR")).join("skipped")
}

fn run() -> String {
    format!("cargo test, process {}", std::os::unix::process::parent_id())
}

/// The records of this run of `cargo test` so far: the name of the test and what is missing.
pub fn skipped() -> Vec<String> {
    let text = std::fs::read_to_string(file()).unwrap_or_default();
    match text.split_once('\n') {
        Some((first, rest)) if first == run() => rest.lines().map(str::to_owned).collect(),
        _ => Vec::new(),
    }
}

fn record(what: &str) {
    static TURN: Mutex<()> = Mutex::new(());
    let _turn = TURN.lock();
    let test = std::thread::current().name().unwrap_or("a test").to_owned();
    let line = format!("{}::{test}: {what}", env!("CARGO_CRATE_NAME"));
    let mut lines = skipped();
    if !lines.contains(&line) {
        // Written to stderr directly, because the test harness shows the output of a test only if it fails.
        let _ = writeln!(std::io::stderr(), "skipped: {line}");
        lines.push(line);
        std::fs::write(file(), format!("{}\n{}\n", run(), lines.join("\n"))).unwrap();
    }
}
