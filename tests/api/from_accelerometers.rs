//! `examples/python`: accelerations are simulated, identified by pyOMA2 and posted to the program.
//!
//! The interpreter is `python3`, or that of `MODALWATCH_PYTHON` (of a virtual environment with `examples/python/requirements.txt`).

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use reqwest::Method;

use crate::helpers::{spawn, Service};
use crate::needs;

fn examples() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/python")
}

/// A command of the interpreter that has the packages; `None`, with the test recorded as skipped, if there is none.
fn interpreter() -> Option<impl Fn() -> Command> {
    let name = std::env::var_os("MODALWATCH_PYTHON").unwrap_or_else(|| "python3".into());
    let has_packages = Command::new(&name).args(["-c", "import pyoma2, requests, pandas, matplotlib"]).output();
    if !has_packages.is_ok_and(|output| output.status.success()) {
        needs::missing("a Python interpreter with examples/python/requirements.txt (MODALWATCH_PYTHON names one)");
        return None;
    }
    Some(move || Command::new(&name))
}

/// Standard output of a command that must succeed.
fn output(command: &mut Command) -> String {
    let Output { status, stdout, stderr } = command.output().unwrap();
    let (stdout, stderr) =
        (String::from_utf8_lossy(&stdout).into_owned(), String::from_utf8_lossy(&stderr).into_owned());
    assert!(status.success(), "{status}: {stdout}{stderr}");
    stdout
}

/// Posts the records of `folder` as the documentation describes it; the last line of the output.
fn post_records(python: &impl Fn() -> Command, service: &Service, folder: &Path) -> String {
    let mut command = python();
    command.current_dir(folder).arg(examples().join("identify_and_post.py"));
    command.args(["--url", &format!("http://{}", service.address()), "--structure", "tower"]);
    command.args(["--channels", "floor1,floor2,floor3,floor4", "--side-file", "records/conditions.csv"]);
    let text = output(command.args(records(folder)));
    text.lines().last().unwrap().to_owned()
}

fn records(folder: &Path) -> Vec<PathBuf> {
    let files = std::fs::read_dir(folder.join("records")).unwrap().map(|entry| entry.unwrap().path());
    files.filter(|path| path.extension().is_some_and(|ending| ending == "npz")).collect()
}

// Several threads, because the scripts block one: the client must notice that the service closes an idle connection meanwhile.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn accelerations_become_measurements_that_a_second_run_does_not_repeat() {
    let Some(python) = interpreter() else { return };
    let (service, _data) = spawn();
    let tower = std::fs::read_to_string(examples().join("tower.toml")).unwrap();
    let put = service.request(Method::PUT, "/v1/structures/tower").header("content-type", "application/toml");
    let put = put.body(tower).send().await.unwrap();
    assert!(put.status().is_success(), "{}", put.text().await.unwrap());

    let folder = tempfile::tempdir().unwrap();
    let mut simulate = python();
    simulate.current_dir(&folder).arg(examples().join("simulate_accelerations.py"));
    output(simulate.args(["--healthy", "2", "--damaged", "1", "--duration-s", "300", "--seed", "7"]));
    let mut learn = python();
    learn.current_dir(&folder).arg(examples().join("identify_and_post.py")).args(["--learn", "2", "--modes", "4"]);
    output(learn.args(["--channels", "floor1,floor2,floor3,floor4"]).args(records(folder.path())));

    assert_eq!(post_records(&python, &service, folder.path()), "3 posted, 0 posted before, 0 refused");
    assert_eq!(post_records(&python, &service, folder.path()), "0 posted, 3 posted before, 0 refused");
    let stored = service.read("/v1/structures/tower/measurements").await;
    let measurements = stored["items"].as_array().unwrap();
    assert_eq!(measurements.len(), 3, "{stored}");
    for measurement in measurements {
        assert_eq!(measurement["frequencies_hz"].as_array().unwrap().len(), 4, "{measurement}");
        assert_eq!(measurement["mode_shapes"][0].as_array().unwrap().len(), 4, "{measurement}");
        assert!(measurement["covariates"]["temperature_c"].is_number(), "{measurement}");
    }
}

#[test]
fn the_scripts_pass_their_own_tests() {
    let Some(python) = interpreter() else { return };
    output(python().current_dir(examples()).args(["-m", "unittest", "-v"]));
}
