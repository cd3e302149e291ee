//! systemd's readiness and watchdog, SIGHUP, health checks.

use std::io::Read as _;
use std::os::unix::net::UnixDatagram;
use std::process::{Command, Stdio};
use std::time::Duration;

use crate::helpers::{command, spawn, Service};
use crate::operations::world::{fails, program, run};

#[tokio::test]
async fn systemd_is_notified_of_readiness_watchdog_and_stop() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("notify");
    let socket = UnixDatagram::bind(&path).unwrap();
    socket.set_read_timeout(Some(Duration::from_mins(1))).unwrap();
    let service = command(&folder.path().join("data"));
    let mut shell = Command::new("sh");
    // systemd sets the id of the process that it waits for; exec keeps this id.
    shell.args(["-c", "WATCHDOG_PID=$$ exec \"$0\" \"$@\""]).arg(service.get_program()).args(service.get_args());
    shell.env("NOTIFY_SOCKET", &path).env("WATCHDOG_USEC", "300000").env("MODALWATCH__LOG__LEVEL", "warn");
    let mut service = Service::spawn(&mut shell);
    let heard = |socket: &UnixDatagram| {
        let mut message = [0; 256];
        let length = socket.recv(&mut message).unwrap();
        String::from_utf8_lossy(&message[..length]).trim().to_owned()
    };
    assert_eq!(heard(&socket), "READY=1");
    for _ in 0..3 {
        assert_eq!(heard(&socket), "WATCHDOG=1");
    }
    service.stop("TERM");
    let mut last = heard(&socket);
    while last == "WATCHDOG=1" {
        last = heard(&socket);
    }
    assert_eq!(last, "STOPPING=1");
}

#[tokio::test]
async fn a_hangup_applies_a_valid_configuration_and_refuses_an_invalid_one() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("config.toml");
    std::fs::write(&config, "[log]\nlevel = \"info\"\n").unwrap();
    let mut service = program(&["serve", "--listen", "127.0.0.1:0", "--data-dir"]);
    service.arg(folder.path().join("data")).arg("--config").arg(&config);
    service.stdout(Stdio::null()).stderr(Stdio::piped());
    let mut child = service.spawn().unwrap();
    let mut stderr = child.stderr.take().unwrap();
    let (sender, lines) = std::sync::mpsc::channel();
    std::thread::spawn(move || {
        let (mut text, mut piece) = (String::new(), [0; 4096]);
        while let Ok(read @ 1..) = stderr.read(&mut piece) {
            text.push_str(&String::from_utf8_lossy(&piece[..read]));
            while let Some((line, rest)) = text.split_once('\n').map(|(l, r)| (l.to_owned(), r.to_owned())) {
                let _ = sender.send(line);
                text = rest;
            }
        }
    });
    let wait_for = |what: &str| {
        let mut seen = Vec::new();
        loop {
            let line = lines.recv_timeout(Duration::from_mins(1)).unwrap_or_else(|_| panic!("no {what} in {seen:#?}"));
            if line.contains(what) {
                return line;
            }
            seen.push(line);
        }
    };
    let hangup = || {
        let status = Command::new("kill").args(["-HUP", &child.id().to_string()]).status();
        assert!(status.unwrap().success());
    };
    wait_for("Listening on");
    hangup();
    wait_for("applied no changes");
    std::fs::write(&config, "[log]\nlevel = \"info\"\n[http]\nlistn = 3\n").unwrap();
    hangup();
    wait_for("the old one stays in force");
    std::fs::write(&config, "[log]\nlevel = \"==\"\n").unwrap();
    hangup();
    wait_for("log.level");
    std::fs::write(&config, "[log]\nlevel = \"debug\"\n[http]\ndrain_s = 3\n[retention]\nmeasurements_days = 4000\n")
        .unwrap();
    hangup();
    let taken = wait_for("SIGHUP: applied");
    assert!(taken.contains("log.level, retention.measurements_days"), "{taken}");
    assert!(wait_for("at the next start").contains("http.drain_s"));
    child.kill().unwrap();
    child.wait().unwrap();
}

#[tokio::test]
async fn the_health_check_ends_with_the_status_a_watcher_needs() {
    let (service, _folder) = spawn();
    let url = format!("http://{}", service.address());
    assert!(run(&["healthcheck", "--url", &url]).await.contains("\"ready\":true"));
    let listen = service.address().to_owned();
    let output = tokio::task::spawn_blocking(move || {
        program(&["healthcheck"]).env("MODALWATCH__HTTP__LISTEN", listen).output().unwrap()
    });
    assert!(output.await.unwrap().status.success(), "the address comes from the environment, as in a container");
    drop(service);
    assert!(fails(&["healthcheck", "--url", &url]).await.contains("does not answer"));
    // A server that accepts the connection and does not answer.
    let silent = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("http://{}", silent.local_addr().unwrap());
    assert!(fails(&["healthcheck", "--timeout-s", "1", "--url", &url]).await.contains("does not answer"));
}
