//! Passwords and certificates of a server: what is refused, what is said, and that no output has the password.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use crate::helpers::{measurements, refusal, Service};
use crate::needs;
use crate::postgres::server::{give_to_server, Server};
use crate::postgres::world::{done, serve};

const PASSWORD: &str = "correct-horse-battery";
const WRONG: &str = "incorrect-horse-battery";

/// A folder of files that the user under whom the server runs can read.
fn readable_folder() -> tempfile::TempDir {
    use std::os::unix::fs::PermissionsExt as _;
    let folder = tempfile::tempdir().unwrap();
    std::fs::set_permissions(folder.path(), std::fs::Permissions::from_mode(0o755)).unwrap();
    folder
}

/// A server that lets everybody but the user of the tests in by the password only (`host`: also without encryption, `hostssl`: not), with a
/// database of the user `watch`.
fn with_passwords(folder: &Path, kind: &str, options: &[&str]) -> Server {
    let rules = folder.join("pg_hba.conf");
    let lines = format!("host all modalwatch 127.0.0.1/32 trust\n{kind} all all 127.0.0.1/32 scram-sha-256\n");
    std::fs::write(&rules, lines).unwrap();
    let rules = format!("hba_file={}", rules.display());
    let server = Server::start(&[&["-c", &rules, "-c", "fsync=off"], options].concat());
    server.sql("postgres", &format!("create role watch login password '{PASSWORD}'"));
    server.sql("postgres", "create database shm owner watch");
    server
}

/// The program with `store.url`, a password in `PGPASSWORD` or none, and the finest log.
fn program(arguments: &[&str], url: &str, password: Option<&str>, folder: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_modalwatch"));
    command.args(arguments).current_dir(folder).env("MODALWATCH__STORE__URL", url);
    command
        .env("MODALWATCH__LOG__LEVEL", "debug,sqlx=trace,modalwatch=trace")
        .env_remove("PGPASSWORD")
        .env("PGPASSFILE", "/dev/null");
    if let Some(password) = password {
        command.env("PGPASSWORD", password);
    }
    command
}

fn text_of(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

/// What each command says that must not work on a server. No output may have a password.
fn refused_everywhere(url: &str, password: Option<&str>) -> Vec<String> {
    let folder = tempfile::tempdir().unwrap();
    let from = format!("sqlite:{}", folder.path().display());
    let commands: [&[&str]; 5] = [
        &["serve", "--listen", "127.0.0.1:0", "--data-dir", "."],
        &["migrate", "schema"],
        &["doctor", "--data-dir", "."],
        &["token", "list"],
        &["migrate", "--from", url, "--to", &from],
    ];
    commands
        .iter()
        .map(|arguments| {
            let output = program(arguments, url, password, folder.path()).output().unwrap();
            let said = text_of(&output);
            assert!(!output.status.success(), "{arguments:?}: {said}");
            assert!(!said.contains("horse"), "{arguments:?} shows the password: {said}");
            assert!(!said.contains("panicked"), "{arguments:?}: {said}");
            said
        })
        .collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_wrong_or_missing_password_is_refused_and_no_output_has_one() {
    if !Server::is_installed() {
        return;
    }
    let (folder, data) = (readable_folder(), tempfile::tempdir().unwrap());
    let server = with_passwords(folder.path(), "host", &[]);
    let address = server.address();
    let without = format!("postgres://watch@{address}/shm");
    for (url, password) in [
        (format!("postgres://watch:{WRONG}@{address}/shm"), None),
        (without.clone(), Some(WRONG)),
        (without.clone(), None),
        (format!("postgres://{address}/shm?user=watch&password={WRONG}"), None),
    ] {
        for said in refused_everywhere(&url, password) {
            assert!(said.contains("password authentication failed for user"), "{url}: {said}");
            assert!(said.contains("check user, password and database of store.url"), "{url}: {said}");
        }
    }

    // The right one, from each of the places where it can be.
    let with = format!("postgres://watch:{PASSWORD}@{address}/shm");
    done(&["migrate", "schema", "--url", &with]);
    let file = folder.path().join("pgpass");
    std::fs::write(&file, format!("127.0.0.1:*:shm:watch:{PASSWORD}\n")).unwrap();
    let private = std::os::unix::fs::PermissionsExt::from_mode(0o600);
    std::fs::set_permissions(&file, private).unwrap();
    let mut by_url = serve(data.path(), &with);
    let mut by_variable = serve(data.path(), &without);
    by_variable.env("PGPASSWORD", PASSWORD);
    let mut by_file = serve(data.path(), &without);
    by_file.env("PGPASSFILE", &file);
    for (number, command) in [&mut by_url, &mut by_variable, &mut by_file].into_iter().enumerate() {
        let mut service = Service::spawn(command);
        service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 3, number * 86_400)).await;
        assert!(service.stop("TERM").success());
    }
    // Nothing of what the program tells about itself has it, at the finest log.
    let printed = program(&["config", "print"], &with, None, folder.path()).output().unwrap();
    let doctor = program(&["doctor", "--data-dir", "."], &with, None, data.path()).output().unwrap();
    for output in [printed, doctor] {
        let said = text_of(&output);
        assert!(output.status.success() && said.contains("watch") && !said.contains("horse"), "{said}");
    }
}

/// Makes an authority and a certificate of it for `localhost` only, and another authority. `None`, and the test is recorded as skipped,
/// where there is no openssl.
fn certificates(folder: &Path) -> Option<[PathBuf; 2]> {
    let openssl = needs::program("openssl")?;
    std::fs::write(folder.join("extensions"), "subjectAltName=DNS:localhost\nbasicConstraints=CA:FALSE\n").unwrap();
    let key = "-newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes";
    for arguments in [
        format!("req -x509 {key} -days 2 -subj /CN=test-authority -keyout authority.key -out authority.pem"),
        format!("req -x509 {key} -days 2 -subj /CN=other-authority -keyout other.key -out other.pem"),
        format!("req {key} -subj /CN=localhost -keyout server.key -out server.csr"),
        "x509 -req -in server.csr -CA authority.pem -CAkey authority.key -CAcreateserial -days 2 -extfile extensions \
         -out server.pem"
            .to_owned(),
    ] {
        let output = Command::new(&openssl).args(arguments.split(' ')).current_dir(folder).output().unwrap();
        assert!(output.status.success(), "{arguments}: {}", String::from_utf8_lossy(&output.stderr));
    }
    Some([folder.join("authority.pem"), folder.join("other.pem")])
}

#[test]
fn encryption_that_is_demanded_is_not_given_up_where_the_server_has_none() {
    if !Server::is_installed() {
        return;
    }
    let folder = readable_folder();
    let server = with_passwords(folder.path(), "host", &[]);
    for mode in ["require", "verify-ca", "verify-full"] {
        let url = format!("postgres://watch:{PASSWORD}@{}/shm?sslmode={mode}", server.address());
        for said in refused_everywhere(&url, None) {
            assert!(said.contains("server does not support TLS"), "{mode}: {said}");
            assert!(said.contains("check sslmode and sslrootcert of store.url"), "{mode}: {said}");
        }
    }
    // What is not demanded is not missed.
    done(&["migrate", "schema", "--url", &format!("postgres://watch:{PASSWORD}@{}/shm", server.address())]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_certificate_of_a_server_is_checked_as_far_as_it_is_demanded() {
    if !Server::is_installed() {
        return;
    }
    let (folder, data) = (readable_folder(), tempfile::tempdir().unwrap());
    let Some([authority, other]) = certificates(folder.path()) else { return };
    give_to_server(&folder.path().join("server.key"));
    let [certificate, key] = [("ssl_cert_file", "server.pem"), ("ssl_key_file", "server.key")]
        .map(|(setting, file)| format!("{setting}={}", folder.path().join(file).display()));
    let server = with_passwords(folder.path(), "hostssl", &["-c", "ssl=on", "-c", &certificate, "-c", &key]);
    let address = server.address();
    let port = address.rsplit_once(':').unwrap().1;
    let url = |host: &str, options: &str| format!("postgres://watch:{PASSWORD}@{host}:{port}/shm?{options}");
    let full = |root: &Path| format!("sslmode=verify-full&sslrootcert={}", root.display());
    let nowhere = folder.path().join("no-such-file.pem");

    for (url, says) in [
        // The authority is another one; it is none that this machine knows; the name is another one; the file is missing.
        (url("localhost", &full(&other)), "certificate"),
        (url("localhost", "sslmode=verify-full"), "certificate"),
        (url("127.0.0.1", &full(&authority)), "certificate"),
        (url("localhost", &full(&nowhere)), "no-such-file.pem"),
        (url("127.0.0.1", &format!("sslmode=verify-ca&sslrootcert={}", other.display())), "certificate"),
    ] {
        for said in refused_everywhere(&url, None) {
            assert!(said.contains(says), "{url}: {said}");
            assert!(said.contains("check sslmode and sslrootcert of store.url"), "{url}: {said}");
        }
    }
    // The server demands encryption itself.
    for said in refused_everywhere(&url("127.0.0.1", "sslmode=disable"), None) {
        assert!(said.contains("no encryption") && said.contains("check user, password and database"), "{said}");
    }

    done(&["migrate", "schema", "--url", &url("localhost", &full(&authority))]);
    let encrypted = "select count(*) filter (where not s.ssl) || ' of ' || (count(*) > 0) from pg_stat_activity a
                     join pg_stat_ssl s using (pid) where a.application_name like 'modalwatch %'";
    let verified = format!("sslmode=verify-ca&sslrootcert={}", authority.display());
    for (number, url) in [
        url("localhost", &full(&authority)),
        // As far as the name is not demanded, or nothing of the certificate.
        url("127.0.0.1", &verified),
        url("127.0.0.1", "sslmode=require"),
        url("127.0.0.1", "sslmode=prefer"),
    ]
    .into_iter()
    .enumerate()
    {
        let mut service = Service::spawn(&mut serve(data.path(), &url));
        service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 3, number * 86_400)).await;
        assert_eq!(server.sql("shm", encrypted), "0 of true", "{url}");
        assert!(service.stop("TERM").success());
    }
    // A password is not sent to a server whose certificate is refused.
    let said = refusal(&mut serve(data.path(), &url("localhost", &full(&other))));
    assert!(!said.contains("password authentication"), "{said}");
}
