//! Commands in a folder of their own, with a tower of four storeys.

use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use tempfile::TempDir;

/// A tower of four storeys, of which the lower three stiffnesses are unknown.
pub const TOWER: &str = r#"
id = "tower"
modes = 4
measurement_noise = { relative = 0.002 }
mass = [{ name = "m1", kg = 1e5 }, { name = "m2", kg = 1e5 }, { name = "m3", kg = 1e5 }, { name = "m4", kg = 8e4 }]
spring = [
    { name = "k1", from = "ground", to = "m1", n_per_m = 3e7 },
    { name = "k2", from = "m1", to = "m2", n_per_m = 3e7 },
    { name = "k3", from = "m2", to = "m3", n_per_m = 2.5e7 },
    { name = "k4", from = "m3", to = "m4", n_per_m = 2.5e7 },
]
parameter = [
    { name = "k1", prior = { uniform = [1.5e7, 4.5e7] }, sets = { spring = "k1" } },
    { name = "k2", prior = { uniform = [1.5e7, 4.5e7] }, sets = { spring = "k2" } },
    { name = "k3", prior = { uniform = [1.25e7, 3.75e7] }, sets = { spring = "k3" } },
]
covariate = [{ name = "temperature_c" }]
"#;

/// A folder with `tower.toml`, in which commands run.
pub struct World {
    pub folder: TempDir,
}

impl World {
    pub fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("tower.toml"), TOWER).unwrap();
        Self { folder }
    }

    pub fn path(&self, name: &str) -> std::path::PathBuf {
        self.folder.path().join(name)
    }

    /// The program in this folder.
    pub fn command(&self, arguments: &[&str]) -> Command {
        command(self.folder.path(), arguments)
    }

    pub fn output(&self, arguments: &[&str]) -> Output {
        self.command(arguments).stdin(Stdio::null()).output().unwrap()
    }

    /// Runs a command that must succeed; returns its standard output.
    pub fn run(&self, arguments: &[&str]) -> String {
        let output = self.output(arguments);
        assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    }

    /// Runs a command with a text on its standard input.
    pub fn run_with_input(&self, arguments: &[&str], input: &str) -> Output {
        let mut command = self.command(arguments);
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        child.stdin.take().unwrap().write_all(input.as_bytes()).unwrap();
        child.wait_with_output().unwrap()
    }

    /// Runs a command that must fail; returns its status and what it said.
    pub fn fails(&self, arguments: &[&str]) -> (i32, String) {
        let output = self.output(arguments);
        let said = format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
        assert!(!output.status.success(), "{arguments:?} should fail: {said}");
        (output.status.code().unwrap(), said)
    }
}

fn command(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(crate::helpers::program());
    command.args(arguments).current_dir(folder).env("MODALWATCH__LOG__LEVEL", "warn");
    command
}
