//! What is said about a database that cannot be used: at the start of a service, and while one is running.

use std::path::Path;

use crate::helpers::refusal;
use crate::postgres::database::url_of;
use crate::postgres::server::Server;
use crate::postgres::world::{done, refused, serve};

/// What a service says that must not start on a database.
fn not_served(folder: &Path, url: &str) -> String {
    refusal(&mut serve(folder, url))
}

#[test]
fn a_database_that_cannot_be_used_is_refused_with_a_remedy() {
    if !Server::is_installed() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (server, address) = (Server::get(), Server::get().address());
    let url = server.database_of(folder.path());
    let free = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    for (url, says) in [
        ("mysql://db/shm".to_owned(), "postgres://user:password@host:5432/database"),
        ("sqlite:/var/lib/modalwatch".to_owned(), "leave store.url out and set data_dir"),
        (format!("postgres://modalwatch@{address}"), "names no database"),
        (format!("postgres://modalwatch:secret@127.0.0.1:{free}/shm"), "cannot be reached"),
        (format!("postgres://modalwatch:secret@{address}/no_such_database"), "check user, password and database"),
        (format!("postgres://nobody:secret@{address}/postgres"), "check user, password and database"),
        (url.clone(), "modalwatch migrate schema"),
    ] {
        let said = not_served(folder.path(), &url);
        assert!(said.contains(says), "{url}: {said}");
        assert!(!said.contains("secret"), "{said}");
        assert!(!said.contains("panicked"), "{said}");
    }
    // `doctor` says the same.
    let doctor = std::process::Command::new(env!("CARGO_BIN_EXE_modalwatch"))
        .args(["doctor"])
        .env("MODALWATCH__STORE__URL", &url)
        .current_dir(folder.path())
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&doctor.stdout);
    assert!(!doctor.status.success() && said.contains("modalwatch migrate schema"), "{said}");
    // The settings are printed without the password.
    let printed = std::process::Command::new(env!("CARGO_BIN_EXE_modalwatch"))
        .args(["config", "print"])
        .env("MODALWATCH__STORE__URL", "postgres://watch:correct-horse@db/shm")
        .output()
        .unwrap();
    let printed = String::from_utf8(printed.stdout).unwrap();
    assert!(printed.contains("postgres://watch:***@db/shm") && !printed.contains("correct-horse"), "{printed}");
}

#[test]
fn the_schema_is_made_and_changed_by_its_command_only() {
    if !Server::is_installed() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let server = Server::get();
    let url = server.database_of(folder.path());
    let database = url.rsplit_once('/').unwrap().1.to_owned();
    let sql = |statement: &str| server.sql(&database, statement);

    assert!(done(&["migrate", "schema", "--url", &url]).contains("the tables are made"));
    assert!(done(&["migrate", "schema", "--url", &url]).contains("nothing to do"));
    // The password of nobody is in the schema, but a schema of somebody else in its place is left alone.
    sql("alter schema modalwatch rename to kept; create schema modalwatch; create table modalwatch.invoices (id int)");
    for said in [not_served(folder.path(), &url), refused(&["migrate", "schema", "--url", &url])] {
        assert!(said.contains("belongs to another application"), "{said}");
    }
    assert_eq!(sql("select count(*) from modalwatch.invoices"), "0", "it was changed");
    sql("drop schema modalwatch cascade; alter schema kept rename to modalwatch");

    // The schema of an earlier program.
    sql(
        "create table modalwatch.kept as select * from modalwatch._sqlx_migrations;
         delete from modalwatch._sqlx_migrations where version > 1; update modalwatch._sqlx_migrations set version = 0",
    );
    let said = not_served(folder.path(), &url);
    assert!(said.contains("has schema version 0") && said.contains("modalwatch migrate schema"), "{said}");
    sql("delete from modalwatch._sqlx_migrations; insert into modalwatch._sqlx_migrations select * from modalwatch.kept; drop table modalwatch.kept");

    // That of a later one, which says whether this program can work with it.
    sql("insert into modalwatch._sqlx_migrations select 9999, description, installed_on, success, checksum, execution_time
         from modalwatch._sqlx_migrations limit 1");
    drop(crate::helpers::Service::spawn(&mut serve(folder.path(), &url)));
    sql("update modalwatch.application set compatible_from = 9999");
    for said in [not_served(folder.path(), &url), refused(&["migrate", "schema", "--url", &url])] {
        assert!(said.contains("9999") && said.contains("use the newer modalwatch"), "{said}");
    }
}

#[tokio::test]
async fn commands_use_the_database_of_the_configuration() {
    if !Server::is_installed() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let url = url_of(folder.path()).await.to_string();
    let config = folder.path().join("modalwatch.toml");
    // A command does not wait as a second service would.
    std::fs::write(&config, format!("[store]\nurl = \"{url}\"\nstandby = true\n")).unwrap();
    let config = config.to_str().unwrap();
    let token = done(&["token", "create", "--name", "me", "--scope", "admin", "--config", config]);
    assert!(token.contains("mw_"), "{token}");
    assert!(done(&["token", "list", "--config", config]).contains("me"));
    assert!(done(&["doctor", "--config", config, "--data-dir", folder.path().to_str().unwrap()]).contains("PostgreSQL"));
    let said = refused(&["backup", "--config", config]);
    assert!(said.contains("pg_dump"), "{said}");
    let service = crate::helpers::Service::spawn(&mut serve(folder.path(), &url));
    let said = refused(&["token", "list", "--config", config]);
    assert!(said.contains("is served by modalwatch") && said.contains("POST /v1/tokens"), "{said}");
    drop(service);
}
