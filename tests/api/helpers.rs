//! A running service, a client for it, and measurements to post.

use std::io::{BufRead as _, BufReader, Read as _};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, ExitStatus, Stdio};
use std::sync::{LazyLock, Mutex};
use std::time::{Duration, Instant};

use data_encoding::HEXLOWER;
use reqwest::{Client, Method, RequestBuilder, Response};
use serde_json::{json, Value};
use sha2::{Digest as _, Sha256};
use tempfile::TempDir;

/// A service with its own process, which is ended when this value is dropped.
pub struct Service {
    child: Child,
    url: String,
    stdout: Option<BufReader<ChildStdout>>,
    pub client: Client,
}

/// The program that is tested: that of this build, or the one that `MODALWATCH_BINARY` names.
pub fn program() -> PathBuf {
    std::env::var_os("MODALWATCH_BINARY").map_or_else(|| env!("CARGO_BIN_EXE_modalwatch").into(), PathBuf::from)
}

/// Command line of a service in `data_dir`, on a free port.
pub fn command(data_dir: &Path) -> Command {
    let mut command = Command::new(program());
    command.args(["serve", "--listen", "127.0.0.1:0", "--data-dir"]).arg(data_dir);
    command.env("MODALWATCH__LOG__LEVEL", "warn");
    // Whether a batch of a structure without a model waits would depend on how busy the machine is.
    command.env("MODALWATCH__MONITOR__TRAINING", "on_request");
    command
}

impl Service {
    /// Starts a service in `data_dir`; panics with what it printed when it does not start.
    pub fn start(data_dir: &Path) -> Self {
        Self::spawn(&mut command(data_dir))
    }

    /// Starts a service from a prepared command.
    pub fn spawn(command: &mut Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let mut stdout = BufReader::new(child.stdout.take().unwrap());
        let mut line = String::new();
        stdout.read_line(&mut line).unwrap();
        let Some((_, url)) = line.trim().split_once("listens on ") else {
            let mut text = String::new();
            child.stderr.take().unwrap().read_to_string(&mut text).unwrap();
            panic!("the service did not start: {line}{text}");
        };
        // Its log must be read; otherwise the pipe fills and the service blocks.
        let mut stderr = child.stderr.take().unwrap();
        std::thread::spawn(move || std::io::copy(&mut stderr, &mut std::io::sink()));
        Self {
            url: url.to_owned(),
            child,
            stdout: Some(stdout),
            client: modalwatch::notify::client_builder().build().unwrap(),
        }
    }

    /// Address without scheme.
    pub fn address(&self) -> &str {
        self.url.trim_start_matches("http://")
    }

    /// Id of the process.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    pub fn request(&self, method: Method, path: &str) -> RequestBuilder {
        self.client.request(method, format!("{}{path}", self.url))
    }

    pub fn get(&self, path: &str) -> RequestBuilder {
        self.request(Method::GET, path)
    }

    /// Posts JSON.
    pub async fn post(&self, path: &str, body: &Value) -> Response {
        self.request(Method::POST, path).json(body).send().await.unwrap()
    }

    /// Posts text of any content type.
    pub async fn post_text(&self, path: &str, content_type: &str, body: impl Into<reqwest::Body>) -> Response {
        self.request(Method::POST, path).header("content-type", content_type).body(body).send().await.unwrap()
    }

    /// Reads JSON; the answer must be a success.
    pub async fn read(&self, path: &str) -> Value {
        let response = self.get(path).send().await.unwrap();
        assert!(response.status().is_success(), "GET {path}: {}", response.text().await.unwrap());
        response.json().await.unwrap()
    }

    /// Posts a batch that must be accepted; returns the answer.
    pub async fn post_batch(&self, structure: &str, measurements: &[Value]) -> Value {
        let body = json!({ "measurements": measurements });
        created(self.post(&format!("/v1/structures/{structure}/batches"), &body).await).await
    }

    /// `kill -9`, as a power loss would.
    pub fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// Sends a signal by name and waits for the end; returns the exit status.
    pub fn stop(&mut self, signal: &str) -> ExitStatus {
        self.signal(signal);
        self.wait(PATIENCE)
    }

    pub fn signal(&self, signal: &str) {
        let status = Command::new("kill").args([&format!("-{signal}"), &self.pid().to_string()]).status().unwrap();
        assert!(status.success());
    }

    pub fn wait(&mut self, limit: Duration) -> ExitStatus {
        exit_within(&mut self.child, limit).unwrap_or_else(|| panic!("the service did not stop within {limit:?}"))
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        drop(self.stdout.take());
    }
}

/// The exit status of a process, if it ends within `limit`.
pub fn exit_within(child: &mut Child, limit: Duration) -> Option<ExitStatus> {
    let started = Instant::now();
    loop {
        let status = child.try_wait().unwrap();
        if status.is_some() || started.elapsed() > limit {
            return status;
        }
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// Output of a command that must not start; if it starts nevertheless, it is ended.
pub fn refusal(command: &mut Command) -> String {
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let Some(status) = exit_within(&mut child, PATIENCE) else {
        child.kill().unwrap();
        panic!("it should have refused to start: {command:?}");
    };
    let mut text = String::new();
    child.stderr.take().unwrap().read_to_string(&mut text).unwrap();
    assert!(!status.success(), "{text}");
    text
}

/// How long is waited for what a machine without other work does in seconds: a test that waits for a condition claims nothing about the time
/// that it takes, and other programs may need the processors.
pub const PATIENCE: Duration = Duration::from_mins(1);

/// Repeats `found` until it returns a value, and returns this; panics with `what` after [`PATIENCE`].
pub async fn eventually<T>(what: &str, found: impl AsyncFnMut() -> Option<T>) -> T {
    within(PATIENCE, what, found).await
}

/// As [`eventually`], with another time limit.
pub async fn within<T>(limit: Duration, what: &str, mut found: impl AsyncFnMut() -> Option<T>) -> T {
    let started = Instant::now();
    loop {
        if let Some(value) = found().await {
            return value;
        }
        assert!(started.elapsed() < limit, "{what}: not within {limit:?}");
        tokio::time::sleep(Duration::from_millis(25)).await;
    }
}

/// A service with its own data folder.
pub fn spawn() -> (Service, TempDir) {
    let folder = tempfile::tempdir().unwrap();
    (Service::start(folder.path()), folder)
}

/// The same with the default of the trainings: with the first batch of a structure without a model.
pub fn spawn_that_trains_by_itself() -> (Service, TempDir) {
    let folder = tempfile::tempdir().unwrap();
    (Service::spawn(command(folder.path()).env("MODALWATCH__MONITOR__TRAINING", "automatic")), folder)
}

/// The body of a 201.
pub async fn created(response: Response) -> Value {
    let status = response.status();
    let body: Value = response.json().await.unwrap();
    assert_eq!(status, 201, "{body}");
    body
}

/// The body of a problem, after a check of its form.
pub async fn problem(response: Response, status: u16, code: &str) -> Value {
    let found = response.status().as_u16();
    let content_type = response.headers().get("content-type").map(|v| v.to_str().unwrap().to_owned());
    let id = response.headers().get("x-request-id").map(|v| v.to_str().unwrap().to_owned());
    let text = response.text().await.unwrap();
    let body: Value = serde_json::from_str(&text).unwrap_or_else(|_| panic!("{found} is not problem+json: {text}"));
    assert_eq!(found, status, "{body}");
    assert_eq!(body["code"], code, "{body}");
    assert_eq!(body["status"], status, "{body}");
    assert_eq!(content_type.as_deref(), Some("application/problem+json"), "{body}");
    assert!(body["title"].is_string() && body["detail"].is_string(), "{body}");
    assert_eq!(body["request_id"].as_str(), id.as_deref(), "{body}");
    body
}

/// Frequencies of `three-dof` from its characteristic polynomial, Hz, ascending. This is independent of the program's
/// own physics.
///
/// ```text
///  det(K − λM) = −A λ³ + B λ² − C λ + D
/// ```
///
/// has three positive roots λ = (2πf)², which are found by bisection below, between and above its turning points.
pub fn three_dof_hz(k: [f64; 3]) -> [f64; 3] {
    let (m, c) = ([0.7, 0.5, 0.3], 5.0);
    let d = k.map(|k| k + 2.0 * c);
    let determinant = |lambda: f64| {
        let d = [0, 1, 2].map(|i: usize| d[i] - lambda * m[i]);
        d[0] * d[1] * d[2] - 2.0 * c * c * c - c * c * (d[0] + d[1] + d[2])
    };
    let cubic = m[0] * m[1] * m[2];
    let square = d[0] * m[1] * m[2] + m[0] * d[1] * m[2] + m[0] * m[1] * d[2];
    let linear = d[0] * d[1] * m[2] + d[0] * m[1] * d[2] + m[0] * d[1] * d[2] - c * c * (m[0] + m[1] + m[2]);
    let root = (square * square - 3.0 * cubic * linear).sqrt();
    let turns = [square - root, square + root].map(|above| above / (3.0 * cubic));
    // On a grid first, and then between two of its points.
    let (steps, highest) = (200_000, 200.0);
    let at = |i: usize| highest * i as f64 / steps as f64;
    let [first, second] = turns.map(|turn| (turn / highest * steps as f64) as usize);
    [[0, first], [first, second], [second, steps]].map(|[mut below, mut above]| {
        while above - below > 1 {
            let middle = usize::midpoint(below, above);
            let is_right = determinant(at(below)) * determinant(at(middle)) > 0.0;
            *(if is_right { &mut below } else { &mut above }) = middle;
        }
        let (mut low, mut high) = (at(below), at(above));
        assert!(determinant(low) * determinant(high) <= 0.0, "no root between {low} and {high}");
        for _ in 0..60 {
            let middle = f64::midpoint(low, high);
            if determinant(low) * determinant(middle) <= 0.0 {
                high = middle;
            } else {
                low = middle;
            }
        }
        low.sqrt() / std::f64::consts::TAU
    })
}

/// Two masses on two springs with the id `tiny`: small, so that a model is trained in seconds.
pub const TWO_MASSES: &str = r#"
id = "tiny"
modes = 2
measurement_noise = { relative = 0.002 }
mass = [{ name = "m1", kg = 1.0 }, { name = "m2", kg = 0.8 }]
spring = [
    { name = "k1", from = "ground", to = "m1", n_per_m = 1000.0 },
    { name = "k2", from = "m1", to = "m2", n_per_m = 1400.0 },
]
parameter = [
    { name = "k1", prior = { uniform = [500.0, 1500.0] }, sets = { spring = "k1" } },
    { name = "k2", prior = { uniform = [700.0, 2100.0] }, sets = { spring = "k2" } },
]
"#;

/// As [`TWO_MASSES`], with a temperature of which the simulation knows no effect.
#[allow(dead_code, reason = "for the tests of the dashboard and of PostgreSQL")]
pub fn two_masses_with_temperature() -> String {
    format!("{TWO_MASSES}covariate = [{{ name = \"temperature_c\" }}]\n")
}

/// Frequencies of the two masses with stiffnesses in N/m, Hz, ascending.
///
/// ```text
///  det(K − λM) = 0.8 λ² − (k₂ + 0.8 (k₁ + k₂)) λ + k₁k₂ = 0,  f = √λ / 2π
/// ```
pub fn two_masses_hz(k1: f64, k2: f64) -> [f64; 2] {
    let b = k2 + 0.8 * (k1 + k2);
    let root = (b * b - 3.2 * k1 * k2).sqrt();
    [(b - root) / 1.6, (b + root) / 1.6].map(|lambda: f64| lambda.sqrt() / std::f64::consts::TAU)
}

/// `count` measurements of the two masses a minute apart from `start_s` (seconds after 2026-01-01), not quite the same.
pub fn of_two_masses(count: usize, start_s: usize) -> Vec<Value> {
    let one = |i: usize| {
        let f = two_masses_hz(1_000.0 + (i % 97) as f64, 1_400.0);
        json!({ "measured_at": time(start_s + 60 * i), "frequencies_hz": f })
    };
    (0..count).map(one).collect()
}

/// `count` measurements of `three-dof` ten minutes apart from `start_s` (seconds after 2026-01-01), with stiffnesses
/// spread evenly by ±2 % about `k`, and without a correlation of successive measurements: 3.883 is the golden section of a turn. Those of
/// different times differ.
pub fn measurements(k: [f64; 3], count: usize, start_s: usize) -> Vec<Value> {
    let one = |i: usize| {
        let turns = i as f64 + start_s as f64 / 600.0;
        let wave = |phase: usize| 1.0 + 0.02 * (3.883 * turns + 3.0 * phase as f64).sin();
        let f = three_dof_hz([k[0] * wave(0), k[1] * wave(1), k[2] * wave(2)]);
        json!({ "measured_at": time(start_s + 600 * i), "frequencies_hz": f })
    };
    (0..count).map(one).collect()
}

/// RFC 3339 of seconds after 2026-01-01T00:00:00Z.
pub fn time(seconds: usize) -> String {
    let (day, rest) = (seconds / 86_400, seconds % 86_400);
    let (month, day) = [31, 28, 31, 30, 31, 30, 31, 31]
        .iter()
        .enumerate()
        .try_fold(day, |left, (month, days)| if left < *days { Err((month + 1, left + 1)) } else { Ok(left - days) })
        .unwrap_err();
    format!("2026-{month:02}-{day:02}T{:02}:{:02}:{:02}Z", rest / 3600, rest / 60 % 60, rest % 60)
}

pub fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

/// Writes a structure file and its trained model into a folder. With a narrow range of noise, such as `0.5,2`, a model with
/// little training passes its calibration.
///
/// Each recipe is trained once by each build of the program, by whichever test binary needs it first, and kept in `target/tmp/trained`.
pub fn train_model(folder: &Path, structure_toml: &str, noise_range: &str, samples: usize, epochs: usize) {
    static TURN: Mutex<()> = Mutex::new(());
    let _turn = TURN.lock();
    let (samples, epochs) = (samples.to_string(), epochs.to_string());
    let recipe = ["--samples", &samples, "--epochs", &epochs, "--noise-range", noise_range];
    let digest =
        Sha256::digest([PROGRAM_SHA256.as_bytes(), structure_toml.as_bytes(), recipe.join(" ").as_bytes()].concat());
    let all = Path::new(env!("CARGO_TARGET_TMPDIR")).join("trained");
    let kept = all.join(HEXLOWER.encode(&digest));
    if !kept.is_dir() {
        std::fs::create_dir_all(&all).unwrap();
        let new = tempfile::tempdir_in(&all).unwrap();
        std::fs::write(new.path().join("structure.toml"), structure_toml).unwrap();
        let mut train = Command::new(program());
        train.arg("train").args(recipe).arg("--structure").arg(new.path().join("structure.toml"));
        let trained = train.arg("--out").arg(new.path()).output().unwrap();
        let said = String::from_utf8_lossy(&trained.stdout).into_owned();
        assert!(trained.status.success() && said.contains("calibration passed"), "{said}");
        // Complete or not at all, also for a test binary that looks at the same moment.
        let _ = std::fs::rename(new.path(), &kept);
    }
    std::fs::create_dir_all(folder).unwrap();
    for file in ["structure.toml", "baseline.safetensors", "baseline.json"] {
        std::fs::copy(kept.join(file), folder.join(file)).unwrap();
    }
}

/// Digest of the program that trains.
static PROGRAM_SHA256: LazyLock<String> =
    LazyLock::new(|| HEXLOWER.encode(&Sha256::digest(std::fs::read(program()).unwrap())));
