//! `modalwatch doctor` finds defects and reports the next step for each.

use serde_json::Value;

use crate::helpers::{measurements, repository, spawn};
use crate::operations::world::{program, run, text};

/// Findings of the doctor: verdict and text of each check by name, and whether the exit status was 0.
async fn doctor(arguments: &[&str], environment: &[(&str, &str)]) -> (Vec<(String, String, String)>, bool) {
    let mut command = program(&[&["doctor", "--json"], arguments].concat());
    // The default port may be taken on this machine.
    command.env("MODALWATCH__HTTP__LISTEN", "127.0.0.1:0").envs(environment.iter().copied());
    let output = tokio::task::spawn_blocking(move || command.output().unwrap()).await.unwrap();
    let report: Value = serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|e| panic!("{e}: {}", String::from_utf8_lossy(&output.stderr)));
    let field = |check: &Value, key: &str| check[key].as_str().unwrap_or_default().to_owned();
    let checks = report["checks"].as_array().unwrap().iter().map(|check| {
        assert!(check["verdict"] == "ok" || !field(check, "next_step").is_empty(), "no next step: {check}");
        (field(check, "check"), field(check, "verdict"), field(check, "found"))
    });
    (checks.collect(), output.status.success())
}

fn verdict<'a>(checks: &'a [(String, String, String)], name: &str) -> (&'a str, &'a str) {
    let found = checks.iter().find(|(check, ..)| check == name).unwrap_or_else(|| panic!("no {name} in {checks:#?}"));
    (&found.1, &found.2)
}

#[tokio::test]
async fn a_healthy_folder_passes_with_and_without_its_service() {
    let (mut service, folder) = spawn();
    service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 4, 0)).await;
    let data_dir = text(folder.path());
    let url = format!("http://{}", service.address());
    let (checks, well) = doctor(&["--data-dir", data_dir, "--url", &url], &[]).await;
    assert!(well, "{checks:#?}");
    assert_eq!(verdict(&checks, "service").0, "ok");
    assert!(verdict(&checks, "database").1.contains("in use by a running service"));
    service.stop("TERM");
    let (checks, well) = doctor(&["--data-dir", data_dir], &[]).await;
    assert!(well, "{checks:#?}");
    for name in ["configuration", "data folder", "integrity", "schema", "SQLite", "clock", "port", "model of three-dof"]
    {
        assert_eq!(verdict(&checks, name).0, "ok", "{name}: {checks:#?}");
    }
    assert_eq!(verdict(&checks, "backups").0, "warn");
    run(&["backup", "--data-dir", data_dir]).await;
    assert_eq!(verdict(&doctor(&["--data-dir", data_dir], &[]).await.0, "backups").0, "ok");
    let mut table = program(&["doctor", "--data-dir", data_dir]);
    let table = table.env("MODALWATCH__HTTP__LISTEN", "127.0.0.1:0").output().unwrap();
    let table = String::from_utf8(table.stdout).unwrap();
    assert!(table.lines().any(|line| line.starts_with("ok") && line.contains("integrity")), "{table}");
}

#[tokio::test]
async fn each_defect_is_found_and_ends_with_status_1() {
    let (mut service, folder) = spawn();
    service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 50, 0)).await;
    service.stop("TERM");
    let data_dir = text(folder.path()).to_owned();
    let finds = async |arguments: &[&str], environment: &[(&str, &str)], name: &str, part: &str| {
        let (checks, well) = doctor(arguments, environment).await;
        let (outcome, found) = verdict(&checks, name);
        assert!(!well && outcome == "fail" && found.contains(part), "{name}: {checks:#?}");
    };
    let here = ["--data-dir", data_dir.as_str()];
    finds(&here, &[("MODALWATCH__HTTP__LISTN", "x")], "configuration", "listn").await;
    finds(&here, &[("MODALWATCH__LOG__LEVEL", "==")], "configuration", "log.level").await;
    finds(&here, &[("MODALWATCH__STORE__MIN_FREE_BYTES", "9000000000000000000")], "free disk", "are free").await;
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    finds(&here, &[("MODALWATCH__HTTP__LISTEN", &address)], "port", "cannot listen on").await;

    let models = tempfile::tempdir().unwrap();
    let bad = models.path().join("three-dof");
    std::fs::create_dir(&bad).unwrap();
    for name in ["structure.toml", "baseline.json"] {
        std::fs::copy(repository("models/three-dof").join(name), bad.join(name)).unwrap();
    }
    std::fs::write(bad.join("baseline.safetensors"), "half").unwrap();
    finds(&[&here[..], &["--models", text(models.path())]].concat(), &[], "models", "SHA-256").await;

    let other = tempfile::tempdir().unwrap();
    std::fs::write(other.path().join("modalwatch.sqlite"), "just some text, longer than a header").unwrap();
    finds(&["--data-dir", text(other.path())], &[], "database", "is not a SQLite database").await;
    let file = folder.path().join("modalwatch.sqlite");
    let mut bytes = std::fs::read(&file).unwrap();
    // A page in the middle of the file.
    let half = bytes.len() / 2 / 4_096 * 4_096;
    bytes[half..half + 2_000].fill(0xa5);
    std::fs::write(&file, &bytes).unwrap();
    let (checks, well) = doctor(&here, &[]).await;
    let found =
        checks.iter().any(|(name, verdict, _)| (name == "integrity" || name == "database") && verdict == "fail");
    assert!(!well && found, "{checks:#?}");
    assert_eq!(std::fs::read(&file).unwrap(), bytes, "the doctor changed the file");
}
